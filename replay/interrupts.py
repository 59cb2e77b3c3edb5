"""Ctrl-C and SIGTERM, kept out of the middle of a write."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self


class Interrupted(KeyboardInterrupt):
    """SIGINT or SIGTERM arrived; `signum` says which."""

    def __init__(self, signum: int):
        super().__init__(signal.Signals(signum).name)
        self.signum = signum


class Interrupts:
    """While entered, turns SIGINT and SIGTERM into `Interrupted`; inside `shield()` only at its end.

    Outside the main thread it leaves signals alone.
    """

    def __init__(self) -> None:
        self._shielded = False
        self._ignored = False
        self._pending: int | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # Python lets no other thread set handlers
            for signum in (signal.SIGINT, signal.SIGTERM):
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
            raise Interrupted(self._pending)

    def ignore(self) -> None:
        """Lets what remains to be done finish; a further Ctrl-C changes nothing."""
        self._ignored = True

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:  # noqa: ARG002  given by signal
        if self._shielded:
            self._pending = signum
        elif not self._ignored:
            raise Interrupted(signum)
