"""One mutated file at a time through all that reads recordings, and what became of it."""

import contextlib
import itertools
import json
import resource
import signal
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import TypeVar

from mcap.writer import CompressionType

from benchmarks.robustness.hostile import HOSTILE
from benchmarks.robustness.mcap_map import Content
from benchmarks.robustness.mutations import DAMAGE, FORGERIES, mutate
from benchmarks.robustness.sources import Source, write
from replay import PredictorChoice, Replay, record
from replay.errors import Refusals, ReplayError
from replay.export import export
from replay.log_info import describe_log
from replay.log_reader import LogReader
from replay.logged_message import RawMessage

T = TypeVar("T")

PATIENCE_S = 20.0  # any step over one of these small files takes milliseconds
MEMORY_BYTES = 100 << 20  # more than the largest of these files needs, far less than a bomb
REPLAYED_EVERY = 10  # of the damaged files; hostile ones are all replayed

# What may become of a file.
CLEAN = "as if nothing had happened"
NOTED = "salvaged, losses noted"
REFUSED = "messages refused and counted"
ONE_LINE = "one clear line"
UNSEEN = "altered where no CRC guards"
MISNAMED = "under a damaged name, and that noted"
# What must not.
LOST = "intact messages lost"
INVENTED = "messages invented"
SILENT = "something else read, and nothing said"
UNORDERED = "messages out of order"
TRACEBACK = "traceback"
UNCLEAR = "a message that is not one clear line"
HANG = "hang"
MEMORY = "memory blown up"
FORBIDDEN = (LOST, INVENTED, SILENT, UNORDERED, TRACEBACK, UNCLEAR, HANG, MEMORY)


@dataclass(frozen=True)
class Failure:
    """Something forbidden, and how to have it again: the same source, kind and seed give the same file."""

    source: str
    kind: str
    seed: int
    step: str
    what: str
    detail: str


@dataclass
class Report:
    """What became of all files so far."""

    files: Counter[tuple[str, str]] = field(default_factory=Counter)  # kind of mutation, source
    outcomes: Counter[tuple[str, str, str]] = field(default_factory=Counter)  # kind of mutation, step, outcome
    expected: int = 0  # messages of undamaged chunks, which salvage had to read
    failures: list[Failure] = field(default_factory=list)
    peak_bytes: int = 0

    def count(self, what: str) -> int:
        """Returns how often something came of a step."""
        return sum(number for (*_, outcome), number in self.outcomes.items() if outcome == what)


class _Hang(BaseException):
    """Not an Exception, so that no reader takes it for damage."""


JOINED = "two recordings joined"
KINDS = (*DAMAGE, *FORGERIES, JOINED, *HOSTILE)


def run(
    sources: list[Source], folder: Path, files: int, seed: int = 0, tick: Callable[[], None] = lambda: None
) -> Report:
    """Tries so many mutated files, every kind of every source in turn."""
    report = Report()
    pairs = [(source, kind) for source in sources for kind in KINDS]
    Random(seed).shuffle(pairs)
    for number in range(files):
        source, kind = pairs[number % len(pairs)]
        try_one(report, sources, source, kind, seed * 1_000_000 + number, folder, whole=number % REPLAYED_EVERY == 0)
        tick()
    return report


def try_one(
    report: Report, sources: list[Source], source: Source, kind: str, seed: int, folder: Path, *, whole: bool = True
) -> None:
    """Mutates a source in one way and counts what becomes of it."""
    random, path = Random(f"{source.name} {kind} {seed}"), folder / "mutated.mcap"
    expected: Counter[Content] = Counter()
    possible: Counter[Content] | None = None  # what may be read; None: anything
    if kind in HOSTILE:
        write(path, HOSTILE[kind](source.records, random), compression=random.choice(_compressions()))
    elif kind == JOINED:
        other = random.choice(sources)
        path.write_bytes(source.map.data + other.map.data)
        expected, possible = source.map.messages | other.map.messages, source.map.messages + other.map.messages
    else:
        mutation = mutate(source.map, kind, random)
        path.write_bytes(mutation.applied(source.map.data))
        expected = source.map.expected(mutation.kept(), source.guarded and not mutation.forged)
        possible = None if mutation.forged else source.map.messages
    trial = _Trial(report, source, kind, seed, path)
    report.files[kind, source.name] += 1
    report.expected += expected.total()
    trial.read(salvage=False, expected=Counter(), possible=possible)
    trial.read(salvage=True, expected=expected, possible=possible)
    if whole or kind in HOSTILE or kind in FORGERIES:
        for salvage in (False, True) if whole else (True,):
            trial.use(salvage=salvage)
            if whole:
                trial.describe(salvage=salvage)


def _compressions() -> tuple[CompressionType, ...]:
    return (CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD)


class _Trial:
    """One mutated file."""

    def __init__(self, report: Report, source: Source, kind: str, seed: int, path: Path):
        self._report, self._source, self._kind, self._seed, self._path = report, source, kind, seed, path

    def read(self, *, salvage: bool, expected: Counter[Content], possible: Counter[Content] | None) -> None:
        """Reads all messages and compares them with those that must and those that may be there."""
        step = "read with --salvage" if salvage else "read"
        read = self._shielded(step, lambda: self._messages(salvage))
        if read is None:
            if expected:
                self._fail(step, LOST, f"all {expected.total()}, for the file was refused")
            return
        found, notes, ordered = read
        if missing := expected - found:
            self._fail(step, LOST, f"{missing.total()} of {expected.total()}, first {next(iter(missing))[:2]}")
        if not ordered:
            self._fail(step, UNORDERED, f"{found.total()} messages")
        if not all(_is_one_line(note) for note in notes):
            self._fail(step, UNCLEAR, f"notes {notes}")
        if possible is None or found == possible:
            self._count(step, NOTED if notes else CLEAN)
        elif not self._source.guarded and self._kind != JOINED:
            self._count(step, UNSEEN)
        elif invented := found - possible:
            if not _unnamed(invented) - _unnamed(possible) and any("may be misnamed" in note for note in notes):
                self._count(step, MISNAMED)
                return
            self._fail(step, INVENTED, f"{invented.total()}, first {next(iter(invented))}")
        elif not notes:
            self._fail(step, SILENT, f"{(possible - found).total()} of {possible.total()} messages are missing")
        else:
            self._count(step, NOTED)

    def _messages(self, salvage: bool) -> tuple[Counter[Content], list[str], bool]:
        reader = LogReader([self._path], salvage=salvage)
        found = [Content(message.topic, message.log_time_ns, message.data) for message in reader.messages()]
        ordered = all(one.log_time_ns <= other.log_time_ns for one, other in itertools.pairwise(found))
        return Counter(found), reader.losses.notes, ordered or not self._source.guarded

    def describe(self, *, salvage: bool) -> None:
        """Does what `pcgan info` does."""
        step = f"info{' with --salvage' * salvage}"

        def described() -> bool:
            description = describe_log([self._path], salvage=salvage)
            json.dumps(description, allow_nan=False)
            return bool(description["salvage_losses"])

        noted = self._shielded(step, described)
        if noted is not None:
            self._count(step, NOTED if noted else CLEAN)

    def use(self, *, salvage: bool) -> None:
        """Replays the file, or exports it if it is what a replay wrote."""
        what, use = ("export", self._exported) if self._source.output else ("replay", self._replayed)
        step = f"{what}{' with --salvage' * salvage}"
        used = self._shielded(step, lambda: use(salvage))
        if used is not None:
            refused, losses = used
            self._count(step, REFUSED if refused else NOTED if losses else CLEAN)

    def _replayed(self, salvage: bool) -> tuple[int, int]:
        output = self._path.with_name("out.mcap")
        summary = record(Replay([self._path], None, PredictorChoice("inline"), salvage=salvage), output)
        json.dumps(summary.as_json(), allow_nan=False)
        if summary.stopped is not None:
            raise summary.stopped
        written = sum(message.topic == "/pcgan/tracks" for message in _all_messages(output))
        assert written == summary.frames, f"{written} track frames in the output of {summary.frames} frames"
        return summary.refused, len(summary.salvage_losses)

    def _exported(self, salvage: bool) -> tuple[int, int]:
        reader, refusals = LogReader([self._path], salvage=salvage), Refusals()
        with TemporaryDirectory(dir=self._path.parent) as folder:
            export(reader, Path(folder), mixtures=True, refusals=refusals)
        return refusals.total, len(reader.losses.notes)

    def _shielded(self, step: str, call: Callable[[], T]) -> T | None:
        """Calls, within bounds of time and memory; None if it failed, and then that is counted."""
        before = _peak_bytes()
        try:
            with _bounded():
                result = call()
        except ReplayError as error:
            clear = _is_one_line(str(error)) and "MemoryError" not in str(error)
            if clear:
                self._count(step, ONE_LINE)
            else:
                self._fail(step, UNCLEAR, repr(str(error))[:500])
            result = None
        except MemoryError:
            self._fail(step, MEMORY, traceback.format_exc(limit=-3))
            result = None
        except _Hang:
            self._fail(step, HANG, traceback.format_exc(limit=-3))
            result = None
        except Exception:
            self._fail(step, TRACEBACK, traceback.format_exc(limit=-4))
            result = None
        grown = _peak_bytes() - before
        self._report.peak_bytes = max(self._report.peak_bytes, grown)
        if grown > MEMORY_BYTES:
            self._fail(step, MEMORY, f"{grown >> 20} MiB")
        return result

    def _count(self, step: str, outcome: str) -> None:
        self._report.outcomes[self._kind, step, outcome] += 1

    def _fail(self, step: str, what: str, detail: str) -> None:
        self._count(step, what)
        self._report.failures.append(Failure(self._source.name, self._kind, self._seed, step, what, detail))


def _unnamed(messages: Counter[Content]) -> Counter[tuple[int, bytes]]:
    """Returns messages without their topics."""
    counts: Counter[tuple[int, bytes]] = Counter()
    for (_, log_time_ns, data), count in messages.items():
        counts[log_time_ns, data] += count
    return counts


def _all_messages(path: Path) -> Iterator[RawMessage]:
    return LogReader([path]).messages()


def _is_one_line(text: str) -> bool:
    """Tells whether a terminal shows it as one line, and whether somebody would read it."""
    return bool(text) and text.isprintable() and len(text) < MAX_LINE


MAX_LINE = 2000  # characters


@contextlib.contextmanager
def _bounded() -> Iterator[None]:
    """Ends what takes too long or too much memory, and makes warnings errors: a user would see them."""

    def stop(*_: object) -> None:
        raise _Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_used_bytes() + HEADROOM_BYTES, hard))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


HEADROOM_BYTES = 2 << 30  # of addresses; threads and arenas take some that they never touch


def _used_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


def _peak_bytes() -> int:
    """Returns the most memory this process ever had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
