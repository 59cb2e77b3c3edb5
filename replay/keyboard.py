"""Keys pressed at a terminal, one at a time and without Enter; the terminal is as it was afterwards."""

import os
import re
import select
import sys
import termios
import time
import tty
from collections import deque
from enum import Enum
from types import TracebackType
from typing import Any, Self


class Key(Enum):
    """The keys that mean something."""

    PAUSE = "space"
    STEP = "right arrow"
    FASTER = "up arrow"
    SLOWER = "down arrow"


_KEY = re.compile(rb" |\x1b[\[O][ABC]")  # terminals send arrows as ESC [ A or, in application mode, ESC O A
_MEANING = {b" ": Key.PAUSE, b"A": Key.FASTER, b"B": Key.SLOWER, b"C": Key.STEP}


def keys_in(typed: bytes) -> list[Key]:
    """Returns the keys in what a terminal sent; all others are left out."""
    return [_MEANING[found[-1:]] for found in _KEY.findall(typed)]


class Keyboard:
    """A terminal's keys while entered; without a terminal, or in the background of one, there are none."""

    def __init__(self, fd: int | None = None):
        self._fd = fd
        self._before: list[Any] | None = None  # the terminal's settings, while they are changed
        self._pressed: deque[Key] = deque()

    @property
    def usable(self) -> bool:
        """Whether keys can be pressed at all."""
        return self._before is not None

    def __enter__(self) -> Self:
        if self._fd is None:
            try:
                self._fd = sys.stdin.fileno()
            except (AttributeError, OSError, ValueError):  # no stdin, a closed one, or one that is no file
                return self
        if os.isatty(self._fd) and _in_foreground(self._fd):
            self._before = termios.tcgetattr(self._fd)
            tty.setcbreak(self._fd)  # keys at once and unseen; Ctrl-C still is one
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._before is not None and self._fd is not None and _in_foreground(self._fd):
            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)
        self._before = None

    def press(self, timeout_s: float) -> Key | None:
        """Waits for a key, timeout_s at most; without a terminal it only waits."""
        if not self._pressed:
            self._listen(timeout_s)
        return self._pressed.popleft() if self._pressed else None

    def _listen(self, timeout_s: float) -> None:
        if self._before is None or self._fd is None or not _in_foreground(self._fd):
            time.sleep(timeout_s)
        elif select.select([self._fd], [], [], timeout_s)[0]:
            try:
                typed = os.read(self._fd, 1024)
            except OSError:  # how some systems say that the terminal has gone
                typed = b""
            self._pressed.extend(keys_in(typed))
            if not typed:
                self._before = None


def _in_foreground(fd: int) -> bool:
    """Tells whether this process may read a terminal; one in the background would be stopped for it."""
    try:
        return os.tcgetpgrp(fd) == os.getpgrp()
    except OSError:  # not the terminal that controls this process: nobody is stopped
        return True
