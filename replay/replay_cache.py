"""Replays done once and read often: the cache behind the pytest plugin and `replay_log`.

A folder holds a folder per replay, named by what went into it: recordings, settings, model. It is made whole under
another name and then renamed, under a lock, so several processes can share the cache. Where there are no locks two of
them may do the same replay: that costs time and changes nothing.
"""

import atexit
import functools
import hashlib
import json
import shutil
import tempfile
import time
import warnings
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from replay.errors import OutputError
from replay.frame_result import FrameResult
from replay.log_reader import LogReader
from replay.log_source import LogSource, find_logs, identity, local_copy
from replay.process_lock import held
from replay.replay_job import ReplayJob, run_job
from replay.replayed import TRUTH_TOPIC, References, Replayed
from replay.session import ReplaySettings
from replay.settings_file import read_profile, validated
from schemas import codec
from schemas.messages import GroundTruthFrame

KEPT = 4  # replays whose messages stay in memory
Settings = ReplaySettings | Mapping[str, Any] | str | Path | None


@dataclass(frozen=True)
class Asked:
    """A replay that somebody wants: everything that decides what comes out."""

    logs: tuple[LogSource, ...]  # that are read as one recording
    settings: ReplaySettings
    model: str | Path | None = None  # name of a shipped model, or a file; None: the default
    salvage: bool = False

    @property
    def key(self) -> str:
        """What tells this replay from others; files by size and time of change. Raises LogError if one is not there."""
        logs = [(log.url if log.path is None else str(log.path.resolve()), identity(log)) for log in self.logs]
        settings = self.settings.model_dump(mode="json")
        asked = [logs, settings, _model_identity(self.model), self.salvage, version("pcgan")]
        return hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()[:16]


class ReplayCache:
    """Does each replay once; several processes may share the folder. `done`, `found` and `wall_s` count this one's."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._recent: OrderedDict[tuple[str, str, References | None], Replayed] = OrderedDict()
        self.done = 0
        self.found = 0
        self.wall_s = 0.0

    def get(self, asked: Asked, name: str, references: References | None = None) -> Replayed:
        """Returns a replay under a name, done now if it was not before. Raises ReplayError if it cannot be done."""
        key = asked.key
        folder = self._folder / key
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with held(folder.with_suffix(".lock")):
                self._find_or_make(asked, folder)
        except OSError as error:
            raise OutputError(f"no replay can be kept in {self._folder}: {error.strerror or error}") from error
        same = (key, name, references)
        if same not in self._recent:
            self._recent[same] = _read(folder, name, references)
        self._recent.move_to_end(same)
        while len(self._recent) > KEPT:
            self._recent.popitem(last=False)
        return self._recent[same]

    def _find_or_make(self, asked: Asked, folder: Path) -> None:
        if folder.is_dir():
            self.found += 1
            return
        started = time.perf_counter()
        self._make(asked, folder)
        self.wall_s += time.perf_counter() - started
        self.done += 1

    def _make(self, asked: Asked, folder: Path) -> None:
        with tempfile.TemporaryDirectory(
            prefix=f"{folder.name}-", dir=self._folder, ignore_cleanup_errors=True
        ) as part:
            making = Path(part) / "whole"
            making.mkdir()
            _replay_into(asked, making)
            try:
                making.rename(folder)
            except OSError:
                if not folder.is_dir():  # where there are no locks, another process may have been quicker
                    raise


def replay_log(
    logs: str | Path | Sequence[str | Path],
    *,
    model: str | Path | None = None,
    settings: Settings = None,
    salvage: bool = False,
    name: str | None = None,
    folder: Path | None = None,
) -> Replayed:
    """Replays a recording, in this process, and returns what came out; once only, if it is asked for again.

    In tests the pytest fixture of this name is the better one: it knows the test's folder and its references.

    Args:
        logs: paths, globs or fsspec URLs. All that they find is read as one recording.
        model: name of a shipped model, or a file. None: the default.
        settings: whole, as a dict, or the path of a profile in TOML or JSON (`pcgan replay --profile`).
        salvage: read every intact chunk of a damaged file.
        name: added to the recording's name, to tell variants of one recording apart.
        folder: where replays are kept, for later processes, too. What is in it does not notice changes in pcgan's own
            code, only other versions. None: a temporary folder that is removed when this process ends.

    Raises:
        LogError: the recording cannot be found, or not be used.
        PredictorError: there is no such model.
        OutputError: the folder cannot be written.
        ReplayError: the settings make no sense.
    """
    patterns = [logs] if isinstance(logs, str | Path) else list(logs)
    sources = tuple(source for pattern in patterns for source in find_logs([str(pattern)]))
    asked = Asked(sources, read_settings(settings), model, salvage)
    cache = _own_cache() if folder is None else ReplayCache(folder)
    return cache.get(asked, variant_name(sources[0].name, name))


def variant_name(log: str, variant: str | None) -> str:
    """Returns what a replay is called: by its recording, and by the variant if that has a name."""
    return log if variant is None else f"{log}-{variant}"


def read_settings(settings: Settings, *folders: Path) -> ReplaySettings:
    """Returns settings, given whole, as a dict, or as a profile; raises ReplayError saying what is wrong with them.

    Args:
        settings: see above; None is the defaults.
        folders: a profile's relative path begins in the first of these that holds it. None: here.
    """
    if settings is None:
        return ReplaySettings()
    if isinstance(settings, ReplaySettings):
        return settings
    if isinstance(settings, Mapping):
        return validated(ReplaySettings, settings, "settings")
    return read_profile(first_file(settings, folders) or Path(settings))


def first_file(path: str | Path, folders: Sequence[Path]) -> Path | None:
    """Returns the file of a relative path in the first of some folders that holds it; None if none does."""
    return next((folder / path for folder in folders if (folder / path).is_file()), None)


def _model_identity(model: str | Path | None) -> list[object]:
    """Returns what changes when the weights do: of a file its place, size and time of change."""
    if model is None or not (path := Path(model)).is_file():
        return [str(model)]
    stat = path.stat()
    return [str(path.resolve()), stat.st_size, stat.st_mtime_ns]


@functools.cache
def _own_cache() -> ReplayCache:
    folder = tempfile.mkdtemp(prefix="pcgan-replays-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return ReplayCache(Path(folder))


def _replay_into(asked: Asked, folder: Path) -> None:
    """Does a replay: output, summary and ground truth as files of a folder."""
    truth: list[tuple[int, GroundTruthFrame]] = []

    def keep_truth(result: FrameResult) -> None:
        if result.ground_truth is not None:
            truth.append((result.log_time_ns, result.ground_truth))

    with ExitStack() as stack:
        logs = tuple(stack.enter_context(local_copy(log, folder.parent)) for log in asked.logs)
        start_ns = LogReader(logs, salvage=asked.salvage).start_ns
        output = folder / f"{logs[0].stem}.pcgan.mcap"
        # as on the command line: a test run that turns warnings into errors must not change what is computed
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("default")
        summary = run_job(ReplayJob(logs, output, asked.settings, asked.model, asked.salvage), on_frame=keep_truth)
    if truth:
        write_truth(folder / "truth.mcap", truth)
    said = {"summary": summary.as_json(), "logs": [log.url for log in asked.logs], "start_ns": start_ns}
    (folder / "replay.json").write_text(json.dumps({**said, "output": output.name}))


def _read(folder: Path, name: str, references: References | None) -> Replayed:
    said, truth = json.loads((folder / "replay.json").read_text()), folder / "truth.mcap"
    return Replayed(
        name,
        tuple(said["logs"]),
        folder / said["output"],
        said["summary"],
        said["start_ns"],
        truth if truth.is_file() else None,
        references,
    )


def write_truth(path: Path, frames: Sequence[tuple[int, GroundTruthFrame]]) -> None:
    """Writes what a recording knows of the people in each frame: an output holds none of it."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.LZ4)
        writer.start(profile="", library="pcgan")
        definition = build_file_descriptor_set(codec.protobuf_type(GroundTruthFrame)).SerializeToString()
        schema = writer.register_schema(codec.schema_name(GroundTruthFrame), "protobuf", definition)
        channel = writer.register_channel(TRUTH_TOPIC, "protobuf", schema)
        for log_time_ns, truth in frames:
            writer.add_message(channel, log_time_ns, codec.encode(truth), log_time_ns)
        writer.finish()  # type: ignore[no-untyped-call]
