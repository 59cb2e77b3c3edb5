"""Public data sets, downloaded into a cache and checked: what `pcgan data` does.

Files come from GitHub repositories at the commits that pcgan/data_manifest.json pins, and are known by their sha256. A
file under way is NAME.part; it gets its name once its checksum is right, so that what has its name is whole. Where a
part is there, only the rest is asked for (HTTP Range).
"""

import gzip
import hashlib
import http.client
import json
import os
import shutil
import ssl
import time
import urllib.error
import urllib.request
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from pcgan.clips import DataNotFound, cache_folder, data_folders

BASE_URL = "https://raw.githubusercontent.com"
ATTEMPTS = 4
TIMEOUT_S = 30.0
_CHUNK_BYTES = 1 << 16
_WORTH_ANOTHER_TRY = (408, 425, 429, 500, 502, 503, 504)


class DownloadError(OSError):
    """A data set could not be downloaded; the message names the file and says what to do."""


class _Interrupted(Exception):
    """The connection failed; the same request may well work a little later."""


class _RangeRefused(_Interrupted):
    """The server has nothing that goes on from our part."""


@dataclass(frozen=True)
class Content:
    """What a file must hold."""

    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class DataFile:
    """A file of a data set and where it comes from."""

    local: str  # below the data folder
    content: Content
    repository: str  # owner/name
    commit: str
    path: str  # in the repository
    published: Content  # differs from `content` only where the file is derived from the published one

    def url(self, base_url: str) -> str:
        """Returns the address of the published file."""
        return f"{base_url.rstrip('/')}/{self.repository}/{self.commit}/{quote(self.path)}"


@dataclass(frozen=True)
class AbsentFile:
    """A file of a data set that is not downloaded, and why."""

    local: str
    reason: str
    rebuilt: Content | None  # our own version of it, which counts as a clip; None: the benchmarks do without


@dataclass(frozen=True)
class DataSet:
    """A public data set as the manifest describes it."""

    name: str
    title: str
    licence: str  # as found
    cite: str
    files: tuple[DataFile, ...]
    absent: tuple[AbsentFile, ...]

    @property
    def size_bytes(self) -> int:
        """What its files hold, once there."""
        return sum(file.content.size_bytes for file in self.files)

    @property
    def sources(self) -> tuple[str, ...]:
        """The repositories and commits that its files come from."""
        return tuple(dict.fromkeys(f"github.com/{f.repository} at {f.commit[:7]}" for f in self.files))

    @property
    def clips(self) -> int:
        """How many clips the benchmarks count."""
        return sum(map(_is_clip, [f.local for f in self.files] + [a.local for a in self.absent if a.rebuilt]))


@dataclass(frozen=True)
class Presence:
    """Which of a data set's files a folder holds, by their names."""

    folder: Path
    files: int
    absent: tuple[AbsentFile, ...]  # without the rebuilt ones that are there


@dataclass(frozen=True)
class Fetched:
    """What `get` did."""

    folder: Path
    downloaded: int  # files
    downloaded_bytes: int
    copied: tuple[str, ...]  # rebuilt files that another data folder had
    clips: int  # that are there now
    absent: tuple[AbsentFile, ...]


@cache
def datasets() -> dict[str, DataSet]:
    """Returns the data sets of the manifest by name."""
    manifest = json.loads(resources.files("pcgan").joinpath("data_manifest.json").read_text(encoding="utf-8"))
    return {name: _read_dataset(name, entry, manifest["sources"]) for name, entry in manifest["datasets"].items()}


def find(name: str) -> DataSet:
    """Returns a data set by name; raises ValueError naming those there are."""
    if name not in datasets():
        raise ValueError(f"no data set {name!r}; there are {', '.join(datasets())}")
    return datasets()[name]


def locate(dataset: DataSet) -> Presence | None:
    """Returns the folder that pcgan reads the data set from, and how much of it is there; None if it is nowhere.

    Names are looked at, no contents.
    """
    try:
        folders = data_folders()
    except DataNotFound:
        return None
    for folder in folders:
        if (folder / dataset.name).is_dir():
            return _presence(dataset, folder)
    return None


def get(
    dataset: DataSet,
    folder: Path | None = None,
    *,
    base_url: str | None = None,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
    backoff_s: float = 1.0,
) -> Fetched:
    """Downloads what a folder lacks of a data set; everything it has is checked, and nothing is downloaded twice.

    Args:
        dataset: of the manifest.
        folder: the data folder; the cache if None.
        base_url: a mirror of raw.githubusercontent.com; else PCGAN_DATA_URL, else the original.
        progress: called with the bytes that are done and those of the whole data set.
        backoff_s: the wait after a failed attempt, doubled each time.

    Raises DownloadError if a file cannot be had or is not what it should be, OSError if it cannot be written.
    """
    folder = folder or cache_folder()
    base_url = base_url or os.environ.get("PCGAN_DATA_URL") or BASE_URL
    if not base_url.startswith(("http://", "https://")):
        raise DownloadError(f"PCGAN_DATA_URL must begin with http:// or https://, got {base_url!r}")
    total = sum(file.published.size_bytes for file in dataset.files)
    done = fetched = fetched_bytes = 0
    for file in dataset.files:
        if not _holds(folder / file.local, file.content):

            def report(file_bytes: int, before: int = done) -> None:
                progress(before + file_bytes, total)

            _fetch(file, folder, base_url, backoff_s, report)
            fetched, fetched_bytes = fetched + 1, fetched_bytes + file.published.size_bytes
        done += file.published.size_bytes
        progress(done, total)
    copied = tuple(absent.local for absent in dataset.absent if _copy_rebuilt(absent, folder))
    now = _presence(dataset, folder)
    clips = dataset.clips - sum(absent.rebuilt is not None for absent in now.absent)
    return Fetched(folder, fetched, fetched_bytes, copied, clips, now.absent)


def six_frame_annotation(obsmat: bytes) -> bytes:
    """Returns OpenTraj's obsmat.txt of ETH-Univ as rows `frame ped_id x y`, tabs between, sorted by frame and id."""
    table = np.loadtxt(obsmat.decode("ascii").splitlines(), ndmin=2)[:, [0, 1, 2, 4]]
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    return "".join(f"{int(frame)}\t{id:.1f}\t{x:.4f}\t{y:.4f}\n" for frame, id, x, y in table).encode("ascii")


def _read_dataset(name: str, entry: dict[str, Any], sources: dict[str, dict[str, str]]) -> DataSet:
    def content(given: dict[str, Any]) -> Content:
        return Content(given["bytes"], given["sha256"])

    files = tuple(
        DataFile(f["local"], content(f.get("derived", f)), **sources[f["source"]], path=f["path"], published=content(f))
        for f in entry["files"]
    )
    absent = tuple(AbsentFile(a["local"], a["reason"], content(a) if a["counted"] else None) for a in entry["absent"])
    return DataSet(name, entry["title"], entry["licence"], entry["cite"], files, absent)


def _is_clip(local: str) -> bool:
    return local.endswith((".txt", "_traj_ped_filtered.csv"))


def _presence(dataset: DataSet, folder: Path) -> Presence:
    def there(local: str) -> bool:
        return (folder / local).is_file() or (folder / f"{local}.gz").is_file()

    files = sum(there(file.local) for file in dataset.files)
    return Presence(folder, files, tuple(absent for absent in dataset.absent if not there(absent.local)))


def _holds(path: Path, content: Content) -> bool:
    """Whether a file is there, as it is or gzipped, and holds what it should."""
    gzipped = path.with_name(f"{path.name}.gz")
    try:
        if path.is_file():  # readers take it before the gzipped one
            return path.stat().st_size == content.size_bytes and _sha256(path.read_bytes()) == content.sha256
        return gzipped.is_file() and _sha256(gzip.decompress(gzipped.read_bytes())) == content.sha256
    except (EOFError, zlib.error, gzip.BadGzipFile):
        return False


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _fetch(file: DataFile, folder: Path, base_url: str, backoff_s: float, on_bytes: Callable[[int], None]) -> None:
    """Brings one file: its part completed, checked, derived from if need be, and renamed."""
    target = folder / file.local
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f"{target.name}.part")
    url = file.url(base_url)
    content = _complete(part, url, file.published, backoff_s, on_bytes)
    if file.content == file.published:
        part.replace(target)
        return
    derived = six_frame_annotation(content)
    if _sha256(derived) != file.content.sha256:
        part.unlink()
        raise _not_wanted(f"{target}, made from {url},", file.content, derived)
    derived_part = target.with_name(f"{target.name}.derived.part")
    derived_part.write_bytes(derived)
    derived_part.replace(target)
    part.unlink()


def _complete(part: Path, url: str, published: Content, backoff_s: float, on_bytes: Callable[[int], None]) -> bytes:
    """Downloads what a part lacks and returns its content, checked.

    A part that is wrong is deleted; one that only lacks something stays for the next time.
    """
    resumed = part.is_file() and part.stat().st_size > 0
    for attempt in range(ATTEMPTS):
        try:
            _transfer(part, url, published, on_bytes)
            break
        except _Interrupted as problem:
            if attempt == ATTEMPTS - 1:
                raise DownloadError(
                    f"{url} cannot be downloaded: {problem} ({ATTEMPTS} attempts); what has come is kept, and the same"
                    " command goes on from there"
                ) from problem
        time.sleep(backoff_s * 2**attempt)
    content = part.read_bytes()
    if _sha256(content) == published.sha256:
        return content
    part.unlink()
    if resumed:  # the beginning may have been of something else: once more, from the start
        return _complete(part, url, published, backoff_s, on_bytes)
    raise _not_wanted(url, published, content)


def _not_wanted(what: str, expected: Content, found: bytes) -> DownloadError:
    return DownloadError(
        f"{what} is not the file that is wanted: expected sha256 {expected.sha256} ({expected.size_bytes} bytes), found"
        f" {_sha256(found)} ({len(found)} bytes); nothing of it is kept"
    )


def _transfer(part: Path, url: str, published: Content, on_bytes: Callable[[int], None]) -> None:
    """Makes one request for what a part lacks and appends the answer; raises _Interrupted if not all of it came."""
    have = part.stat().st_size if part.is_file() else 0
    if have >= published.size_bytes:
        return  # whole, or of something else: its checksum tells
    request = urllib.request.Request(url, headers={"User-Agent": "pcgan"})
    if have:
        request.add_header("Range", f"bytes={have}-")
    try:
        opened = _open(request)
    except _RangeRefused:  # the published file ends before our part: that is of something else
        part.unlink()
        raise
    with closing(opened) as response:
        if response.status != http.HTTPStatus.PARTIAL_CONTENT:
            have = 0  # the server sends everything
        elif not (response.headers["Content-Range"] or "").startswith(f"bytes {have}-"):
            part.unlink()
            raise _Interrupted(f"the server sent bytes {response.headers['Content-Range']} instead of {have}-")
        declared = response.headers["Content-Length"]
        wanted = have + int(declared) if (declared or "").isdigit() else published.size_bytes
        with part.open("ab" if have else "wb") as stream:
            for chunk in _chunks(response):
                stream.write(chunk)
                have += len(chunk)
                on_bytes(min(have, published.size_bytes))
                if have > 2 * published.size_bytes + _CHUNK_BYTES:
                    return  # something else altogether: its checksum is wrong, and there is no end to it
    if have < wanted:
        raise _Interrupted(f"the connection ended after {have} of {wanted} bytes")


def _open(request: urllib.request.Request) -> http.client.HTTPResponse:
    """Sends a request; raises _Interrupted if it may work later, DownloadError if not."""
    try:
        response: http.client.HTTPResponse = urllib.request.urlopen(request, timeout=TIMEOUT_S)
        return response
    except urllib.error.HTTPError as error:
        error.close()
        problem = f"{error.code} {error.reason}"
        if error.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            raise _RangeRefused(problem) from error
        if error.code in _WORTH_ANOTHER_TRY:
            raise _Interrupted(problem) from error
        raise DownloadError(f"{request.full_url} cannot be downloaded: {problem}") from error
    except urllib.error.URLError as error:
        if isinstance(error.reason, ssl.SSLCertVerificationError):
            raise DownloadError(f"{request.full_url} cannot be downloaded: {error.reason}") from error
        raise _Interrupted(str(error.reason)) from error
    except (OSError, http.client.HTTPException) as error:
        raise _Interrupted(str(error) or type(error).__name__) from error
    except ValueError as error:
        raise DownloadError(f"{request.full_url} cannot be downloaded: {error}") from error


def _chunks(response: http.client.HTTPResponse) -> Iterator[bytes]:
    """Yields a response's content; raises _Interrupted where the connection fails, so that a full disk is none."""
    while True:
        try:
            chunk = response.read(_CHUNK_BYTES)
        except (OSError, http.client.HTTPException) as error:
            raise _Interrupted(str(error) or type(error).__name__) from error
        if not chunk:
            return
        yield chunk


def _copy_rebuilt(absent: AbsentFile, folder: Path) -> bool:
    """Copies a rebuilt file from another data folder of this machine, if one has it and this one has not."""
    if absent.rebuilt is None or _holds(folder / absent.local, absent.rebuilt):
        return False
    try:
        others = data_folders()
    except DataNotFound:
        return False
    for other in others:
        if _holds(other / absent.local, absent.rebuilt):
            source = next(p for p in (other / absent.local, other / f"{absent.local}.gz") if p.is_file())
            target = (folder / absent.local).with_name(source.name)
            part = target.with_name(f"{target.name}.part")
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, part)
            part.replace(target)
            return True
    return False
