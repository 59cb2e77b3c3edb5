"""A temporary folder for a socket: gone when the process that made it is, however that ended.

Whoever makes the folder holds a lock on it, which the system releases with the process. What is not locked any more may
go: the process that was spawned removes it when it finds itself left alone, and every start removes older ones, in case
both were killed.
"""

import os
import shutil
import tempfile
import time
from contextlib import suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # not on Windows: there a folder may outlive a killed process
    fcntl = None  # type: ignore[assignment]

PREFIX = "pcgan-bus-"
YOUNG_S = 60.0  # a folder this young may not have been locked yet
_POLL_S = 0.01


class PrivateFolder:
    """A new folder that only this user can enter, locked until it is removed."""

    def __init__(self) -> None:
        _remove_left_behind()
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX))
        self._lock: int | None = None
        if fcntl is not None:
            self._lock = os.open(self.path, os.O_RDONLY)
            fcntl.flock(self._lock, fcntl.LOCK_EX)

    def give_up(self) -> None:
        """Lets the folder go: whoever was spawned into it removes it when it ends, without waiting for us to end."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def remove(self) -> None:
        """Removes the folder and what is in it; doing so twice does no harm."""
        shutil.rmtree(self.path, ignore_errors=True)
        self.give_up()


def remove_if_abandoned(folder: Path, patience_s: float = 1.0) -> bool:
    """Removes a folder whose process has ended, or ends within the patience; tells whether it did.

    Of a process that is dying its pipes may be closed a moment before its lock is.
    """
    deadline_s = time.monotonic() + patience_s
    while not (abandoned := _is_abandoned(folder)) and time.monotonic() < deadline_s:
        time.sleep(_POLL_S)
    if abandoned:
        shutil.rmtree(folder, ignore_errors=True)
    return abandoned


def _remove_left_behind() -> None:
    """Removes this user's folders that nobody holds any more."""
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with suppress(OSError):  # somebody else removes it, too
            found = folder.lstat()
            if found.st_uid == os.getuid() and time.time() - found.st_mtime > YOUNG_S:
                remove_if_abandoned(folder, patience_s=0)


def _is_abandoned(folder: Path) -> bool:
    if fcntl is None or folder.is_symlink():
        return False
    try:
        lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:  # gone already, or not ours
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(lock)
    return True
