"""What a check found, case by case: plain numbers, words and paths, which can be sent to another process."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path

from replay.diff_result import LogDiff

TIMES = frozenset({"wall_s", "startup_s", "realtime_factor", "latency_ms"})  # of a summary: a machine's pace


class Status(StrEnum):
    """How a case went; `passed` says whether that is well."""

    IDENTICAL = "identical"  # byte for byte what the reference was made of
    CLOSE = "close"  # within the tolerances
    UNREFERENCED = "no reference"  # nothing to compare with, and nothing asked for
    NEW = "new"  # this run has written the reference
    UPDATED = "updated"  # this run has rewritten the reference
    MET = "met"  # a variant of a sweep, which is compared with nothing: every expectation is met
    CHANGED = "changed"
    UNMET = "unmet"  # an expectation is not met
    ERROR = "error"  # it could not be replayed

    @property
    def passed(self) -> bool:
        """True unless somebody has to look at it."""
        return self not in {Status.CHANGED, Status.UNMET, Status.ERROR, Status.UNREFERENCED}


@dataclass(frozen=True)
class Judged:
    """An expectation and what came of it."""

    text: str  # "hota >= 0.8"
    value: float | None  # None: the replay has no such figure
    met: bool


class MomentKind(StrEnum):
    """Why a moment is among the worst."""

    ERROR = "prediction error"
    MISSED = "missed person"
    SWITCH = "id switch"


@dataclass(frozen=True)
class WorstOf:
    """A slice that a moment is among the worst few of, of its kind."""

    by: str  # "range"
    value: str  # "0 to 10 m"
    size: float  # the largest there of the person within the horizon: ADE, or for the horizon the error at that step


@dataclass(frozen=True)
class Moment:
    """One of a drive's worst moments; numbers are those of the person it is about."""

    kind: MomentKind
    at_s: float  # seconds into the log, by log time: what --start and --at count
    stamp_ns: int
    size: float  # errors: ADE in m over the horizon; missed: seconds; switches: tracks after each other
    text: str  # "track 7: ADE 1.92 m, FDE 4.10 m; it turned left"
    track_id: int  # 0: none
    person_id: int  # of the ground truth; -1: the log has none
    ahead_m: float  # where, as the vehicle sees it
    left_m: float
    range_m: float
    speed_mps: float
    turning: bool  # the person turns by more than 30 degrees within the horizon
    near_vehicle: bool  # within 5 m of the vehicle at any time within the horizon
    horizon_errors_m: tuple[tuple[float, float], ...] = ()  # (seconds ahead, error), of errors
    picture: Path | None = None  # PNG
    worst_of: tuple[WorstOf, ...] = ()


@dataclass(frozen=True)
class ErrorSlice:
    """The prediction errors of one part of a drive."""

    by: str  # "range", "horizon", "turning", "near the vehicle"
    value: str  # "0 to 10 m"
    count: int
    ade_m: float
    worst_m: float


@dataclass(frozen=True)
class Reference:
    """Where a reference came from."""

    path: Path
    version: str  # of pcgan
    model: str
    model_sha256: str
    reason: str  # why it was last written
    inputs: tuple[tuple[str, str], ...] = ()  # base name, SHA-256
    changed: tuple[str, ...] = ()  # in words: settings, model, version, inputs that differ from this run's


@dataclass(frozen=True)
class CaseResult:
    """One log, or several that belong together, replayed with one variant's settings and judged."""

    case: str  # name, unique in the suite
    variant: str  # name; "" of a suite without a sweep
    logs: tuple[str, ...]  # as in the suite
    status: Status
    problem: str = ""  # one line, unless it passed
    summary: dict[str, object] = field(default_factory=dict)  # of `pcgan replay --json`
    judged: tuple[Judged, ...] = ()
    reference: Reference | None = None
    reference_summary: dict[str, object] = field(default_factory=dict)  # the same figures when it was made
    diff: LogDiff | None = None
    moments: tuple[Moment, ...] = ()  # worst first within each kind
    slices: tuple[ErrorSlice, ...] = ()
    output: Path | None = None
    recording: Path | None = None  # .rrd
    wall_s: float = 0.0
    log_s: float = 0.0
    details: str = ""  # the traceback, of an error that is not the user's
    steps: int = 0  # that a prediction looks ahead; 0: nothing was predicted
    step_s: float = 0.0

    def as_json(self) -> dict[str, object]:
        """Returns everything under the names that users rely on; only `wall_s` differs from run to run."""
        reference = self.reference
        return {
            "case": self.case,
            "variant": self.variant,
            "logs": list(self.logs),
            "status": self.status.value,
            "passed": self.status.passed,
            "problem": self.problem,
            "details": self.details,
            "log_s": self.log_s,
            "wall_s": round(self.wall_s, 3),
            "summary": repeatable(self.summary),
            "expectations": [asdict(judged) for judged in self.judged],
            "reference": None if reference is None else {**asdict(reference), "path": str(reference.path)},
            "reference_summary": self.reference_summary,
            "diff": None if self.diff is None else self.diff.as_json(),
            "moments": [{**asdict(moment), "picture": _text(moment.picture)} for moment in self.moments],
            "slices": [asdict(part) for part in self.slices],
            "output": _text(self.output),
            "recording": _text(self.recording),
        }


def horizon_name(ahead_s: float) -> str:
    """Returns the name of a step's slice: "2.4 s"."""
    return f"{ahead_s:.1f} s"


def repeatable(summary: Mapping[str, object]) -> dict[str, object]:
    """Returns a replay's summary without what differs from run to run: times."""
    return {name: value for name, value in summary.items() if name not in TIMES}


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)
