"""A lock between processes, kept for as long as a block runs: a file that nobody reads."""

import contextlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def held(lock: Path) -> Iterator[None]:
    """Keeps others with the same lock out until the block ends, or this process does.

    Where the system, or a file system of the network, has no such locks nobody is kept out.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    with lock.open("a") as stream:
        with contextlib.suppress(OSError):
            fcntl.flock(stream, fcntl.LOCK_EX)
        yield
