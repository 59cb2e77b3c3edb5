"""Recordings by name: paths, globs, folders, and URLs of whatever fsspec can open."""

import glob
import os
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from replay.errors import LogError

ENDING = re.compile(r"(?i)(?<=.)\.mcap$")
UNFIT = re.compile(r"[^\w.+@=, -]")  # for file names, on some systems
OUTPUT_ENDING = ".pcgan.mcap"  # our own outputs often lie beside their recordings
SIGNS_OF_CHANGE = (  # as filesystems call them, best first
    "ETag",
    "etag",
    "md5Hash",
    "CRC",
    "mtime",
    "Last-Modified",
    "LastModified",
    "last_modified",
    "created",
)


class UnreachableError(LogError):
    """A recording that cannot be found or fetched now, whatever it holds."""


@dataclass(frozen=True)
class LogSource:
    """A recording, here or elsewhere."""

    url: str  # a path as text, or a URL with its protocol
    name: str  # unique among those found together; fit for a file name

    @property
    def path(self) -> Path | None:
        """Where it lies on this machine; None if it is elsewhere."""
        return None if _is_url(self.url) else Path(self.url)


def find_logs(patterns: Sequence[str], base: Path = Path()) -> list[LogSource]:
    """Returns the recordings that patterns name, sorted by URL, each once, with unique names.

    A pattern is a path, a glob (`**` for any depth), a folder (its *.mcap), or a URL of these that fsspec understands
    (`s3://bucket/drives/*.mcap`, `zip://*.mcap::https://host/drives.zip`). Globs and folders leave out the outputs of
    `pcgan replay`. A name is the file's without `.mcap`, with parent folders before it where two would be the same.

    Args:
        patterns: see above.
        base: relative paths begin here.

    Raises:
        LogError: a pattern finds nothing, or its protocol cannot be used.
    """
    found: dict[str, str] = {}  # what tells whether two are the same -> URL
    for pattern in patterns:
        with _one_line(pattern):
            urls = _remote(pattern) if _is_url(pattern) else _local(pattern, base)
        for url in urls:
            found.setdefault(url if _is_url(url) else os.path.realpath(url), url)
    urls = sorted(found.values())
    return [LogSource(url, name) for url, name in zip(urls, unique_names(urls), strict=True)]


@contextmanager
def local_copy(source: LogSource, folder: Path | None = None) -> Iterator[Path]:
    """Gives a recording as a local file: itself if it is one, else a copy of the same name that is removed afterwards.

    Args:
        source: the recording.
        folder: the copy goes into a folder in here. None: the system's for temporary files.

    Raises:
        UnreachableError: it is not there, did not come whole, or there is no place for a copy.
    """
    if source.path is not None:
        if not source.path.exists():
            raise UnreachableError(f"{source.url} is not there")
        yield source.path
        return
    try:
        scratch = tempfile.TemporaryDirectory(prefix="pcgan-", dir=folder, ignore_cleanup_errors=True)
    except OSError as error:
        place = folder or tempfile.gettempdir()
        raise UnreachableError(f"{source.url} cannot be copied into {place}: {error.strerror or error}") from error
    with scratch as inside:
        copy = Path(inside) / f"{_parts(source.url)[-1]}.mcap"  # outputs hold this name
        with _one_line(source.url):
            filesystem, path = _filesystem(source.url)
            wanted = filesystem.info(path).get("size")
            with filesystem.open(path, "rb") as remote, copy.open("wb") as local:
                shutil.copyfileobj(remote, local, 1 << 20)
        if wanted is not None and copy.stat().st_size != wanted:
            raise UnreachableError(f"{source.url} came with {copy.stat().st_size} bytes of {wanted}; try again")
        yield copy


def identity(source: LogSource) -> str:
    """Returns what changes when the recording does: its size, and the time or tag of its last change.

    Nothing is read, which suits a corpus; a change that keeps both is not noticed. Raises UnreachableError.
    """
    with _one_line(source.url):
        if source.path is not None:
            stat = source.path.stat()
            return f"{stat.st_size} bytes, mtime {stat.st_mtime_ns}"
        filesystem, path = _filesystem(source.url)
        info = filesystem.info(path)
    signs = [f"{sign} {info[sign]}" for sign in SIGNS_OF_CHANGE if info.get(sign)]
    return ", ".join([f"{info.get('size')} bytes", *signs[:1]])


# --- finding -------------------------------------------------------------------------------------------------------


def _is_url(pattern: str) -> bool:
    return "://" in pattern


def _local(pattern: str, base: Path) -> list[str]:
    path = base / Path(pattern).expanduser()
    if path.is_file():  # also one whose name looks like a glob
        return [str(path)]
    if path.is_dir():
        return _some(
            pattern, [str(each) for each in path.glob("*.mcap") if each.is_file()], "is a folder without *.mcap"
        )
    if not glob.has_magic(pattern):
        raise LogError(f"{path} is not there")
    found = glob.glob(str(Path(pattern).expanduser()), root_dir=base, recursive=True)  # noqa: PTH207  base is no glob
    return _some(pattern, [str(base / each) for each in found if (base / each).is_file()], "finds no file")


def _remote(pattern: str) -> list[str]:
    filesystem, path = _filesystem(pattern)
    if _protocols(filesystem) & {"file", "local"}:
        return _local(path, Path())
    if glob.has_magic(path.partition("?")[0] if _is_url(path) else path):  # a query of HTTP is no glob
        found = [each for each, info in filesystem.glob(path, detail=True).items() if info["type"] != "directory"]
        return _some(pattern, [_with_path(pattern, filesystem, each) for each in found], "finds no file")
    # a web server has no folders, and would send a whole file to say so
    if pattern.endswith("/") or filesystem.info(path)["type"] == "directory":
        inside = f"{path.rstrip('/')}/*.mcap" if path else "*.mcap"
        found = [_with_path(pattern, filesystem, each) for each in filesystem.glob(inside)]
        return _some(pattern, found, "is a folder without *.mcap")
    return [pattern]


def _some(pattern: str, found: Iterable[str], problem: str) -> list[str]:
    """Returns what was found, without our outputs unless these were asked for; raises LogError of nothing."""
    every = list(found)
    kept = [url for url in every if pattern.endswith(OUTPUT_ENDING) or not url.endswith(OUTPUT_ENDING)]
    if not kept:
        outputs = f" but {len(every)} outputs of pcgan replay (*{OUTPUT_ENDING})" if every else ""
        raise LogError(f"{pattern} {problem}{outputs}")
    return kept


def _filesystem(url: str) -> tuple[Any, str]:
    """Returns fsspec's filesystem of a URL, and the path in it; raises LogError."""
    import fsspec

    try:
        with _one_line(url):
            filesystem, path = fsspec.core.url_to_fs(url)
    except ImportError as error:
        protocol, package = url.partition(":")[0], getattr(error.__cause__, "name", None)
        install = f"needs the package {package}: pip install {package}" if package else f"cannot be used: {error}"
        raise LogError(f"{protocol}:// {install}") from error
    return filesystem, str(path)


def _protocols(filesystem: Any) -> set[str]:
    return {filesystem.protocol} if isinstance(filesystem.protocol, str) else set(filesystem.protocol)


def _with_path(pattern: str, filesystem: Any, path: str) -> str:
    """Returns a pattern's URL with what was found in its place: zip://*.mcap::a.zip -> zip://b.mcap::a.zip."""
    links = pattern.split("::")
    place = next(i for i, link in enumerate(links) if "://" in link)  # simplecache:: and its like have no path
    links[place] = filesystem.unstrip_protocol(path)
    return "::".join(links)


@contextmanager
def _one_line(url: str) -> Iterator[None]:
    """Turns whatever a filesystem raises into an error of one line; it is of any type, botocore's own among them."""
    try:
        yield
    except (LogError, ImportError):
        raise
    except FileNotFoundError as error:
        raise UnreachableError(f"{url} is not there") from error
    except Exception as error:
        said = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        raise UnreachableError(f"{url} cannot be read: {said}") from error


# --- names ---------------------------------------------------------------------------------------------------------


def unique_names(urls: Sequence[str]) -> list[str]:
    """Returns a name for each URL: the file's, with as many parent folders before it as it takes, or a number after."""
    parts = [_parts(url) for url in urls]
    names = [part[-1] for part in parts]
    for depth in range(2, max(map(len, parts), default=0) + 2):  # once more: a long name may meet a whole path
        for i in _repeated(names):
            names[i] = "-".join(parts[i][-depth:])
    while repeated := _repeated(names):
        for number, i in enumerate(repeated, 1):
            names[i] = f"{names[i]}-{number}"
    return names


def _repeated(names: Sequence[str]) -> list[int]:
    """Returns the indices of names that are no one's alone, on file systems that ignore case, too."""
    times = Counter(name.casefold() for name in names)
    return [i for i, name in enumerate(names) if times[name.casefold()] > 1]


def _parts(url: str) -> list[str]:
    """Returns the folders and the file, without .mcap, that a URL leads to: zip://a/b.mcap::c.zip -> c.zip, a, b."""
    parts: list[str] = []
    for link in reversed(url.split("::") if _is_url(url) else [str(Path(url).absolute())]):
        _, separator, place = link.partition("://")
        path = unquote(re.split("[?#]", place)[0]) if separator else link
        parts += [UNFIT.sub("_", part) for part in path.split("/") if part not in {"", ".", ".."}]
    parts = parts or ["log"]
    return [*parts[:-1], ENDING.sub("", parts[-1])]
