"""Files that take their name when they are whole: written as NAME.part, by one process alone, and renamed."""

import errno
import os
from contextlib import suppress
from pathlib import Path
from typing import IO

from replay.errors import OutputError

try:
    import fcntl
except ImportError:  # not on Windows, where nobody can rename a file that is open
    fcntl = None  # type: ignore[assignment]

NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}  # some file systems of the network have none


def part_of(path: Path) -> Path:
    """Returns what a file is called until it is whole."""
    return path.with_name(path.name + ".part")


def open_part(path: Path) -> IO[bytes]:
    """Opens NAME.part, empty, and keeps other processes out until it is closed or this process has ended.

    Two writers of one part would mix their bytes, and the slower one would go on writing after the other has given the
    file its name. A part that a process has left behind, however it ended, makes way. Raises OutputError if somebody
    else is writing it, OSError if it cannot be opened or if its name is taken by what is no file.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "Is a directory")
    if path.exists() and not path.is_file():  # renaming would put a file in the place of a device such as /dev/null
        raise FileExistsError(errno.EEXIST, "Not a regular file")
    part = part_of(path)
    while True:
        number = os.open(part, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            _lock(number, part)
            if _is_still(number, part):  # else it took its name between opening and locking
                if not os.fstat(number).st_size:
                    return os.fdopen(number, "wb")
                part.unlink()  # not emptied: it may have another name, too
        except BaseException:
            os.close(number)
            raise
        os.close(number)


def write_whole(path: Path, data: bytes) -> None:
    """Writes a small file as NAME.part and renames it; an older one of that name stays until then.

    What is no file, such as /dev/stdout, is written to as it is. Raises OutputError, and leaves no part, if the file
    cannot be written.
    """
    try:
        if path.exists() and not path.is_file():
            path.write_bytes(data)
            return
        path = path.resolve()  # a link stays one
        with open_part(path) as stream:
            try:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
                part_of(path).replace(path)
            except OSError:
                part_of(path).unlink(missing_ok=True)
                raise
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error


def same_file(one: Path, other: Path) -> bool:
    """Tells whether two paths lead to one file: by symbolic or hard links, other spellings, or other letter cases."""
    if one.resolve() == other.resolve():
        return True
    with suppress(OSError):  # one of them is not there
        return one.samefile(other)
    return False


def _lock(number: int, part: Path) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OutputError(
            f"{part} is being written by another process; wait until it has ended, or choose another output"
        ) from None
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise


def _is_still(number: int, part: Path) -> bool:
    """Tells whether an open file is the one of that name."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(number), part.stat())
    return False
