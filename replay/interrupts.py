"""Ctrl-C, SIGTERM and a terminal that is closed, kept out of the middle of a write."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self

SIGHUP: int | None = getattr(signal, "SIGHUP", None)  # a terminal that is closed; not on Windows
REPEAT_S = 3.0


class Interrupted(KeyboardInterrupt):
    """SIGINT, SIGTERM or SIGHUP arrived; `signum` says which."""

    def __init__(self, signum: int):
        super().__init__(signal.Signals(signum).name)
        self.signum = signum


class Interrupts:
    """While entered, turns SIGINT, SIGTERM and SIGHUP into `Interrupted`; inside `shield()` only at its end.

    For REPEAT_S after that a further one changes nothing: whoever presses Ctrl-C twice, or closes a terminal, which
    sends several, must not interrupt the tidying up that the first has begun. Where `nohup` has SIGHUP ignored, it
    stays so, and with SIGHUP a terminal is said no more: writing to one that is closed is an error. Outside the main
    thread signals are left alone.
    """

    def __init__(self) -> None:
        self._shielded = False
        self._ignored = False
        self._pending: int | None = None
        self._obeyed_s = -REPEAT_S
        self._terminal: list[int] = []
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        self._terminal = [number for number in (1, 2) if os.isatty(number)]  # once it is closed nobody can tell
        if threading.current_thread() is threading.main_thread():  # Python lets no other thread set handlers
            for signum in (signal.SIGINT, signal.SIGTERM, SIGHUP):
                if signum is not None and (signum != SIGHUP or signal.getsignal(signum) != signal.SIG_IGN):
                    self._previous[signum] = signal.signal(signum, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for signum, handler in self._previous.items():
            signal.signal(signum, handler)

    @contextmanager
    def shield(self) -> Iterator[None]:
        """Postpones an interruption to the end of the block."""
        self._shielded = True
        try:
            yield
        finally:
            self._shielded = False
        if self._pending is not None:
            self._obey(self._pending)

    def ignore(self) -> None:
        """Lets what remains to be done finish; a further Ctrl-C changes nothing."""
        self._ignored = True

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:  # noqa: ARG002  given by signal
        if signum == SIGHUP:
            for number in self._terminal:
                os.dup2(os.open(os.devnull, os.O_WRONLY), number)
        if self._shielded:
            self._pending = self._pending or signum
        elif not self._ignored:
            self._obey(signum)

    def _obey(self, signum: int) -> None:
        now_s = time.monotonic()
        if now_s >= self._obeyed_s + REPEAT_S:
            self._obeyed_s = now_s
            raise Interrupted(signum)
