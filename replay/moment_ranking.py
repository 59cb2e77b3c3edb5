"""Candidates for a replay's worst moments, and the few of them that are worth keeping."""

import bisect
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from replay.check_result import MomentKind, WorstOf
from replay.frame_result import FrameResult
from schemas.messages import BoolArray, FloatArray

TURN_RAD = math.radians(30)
NEAR_M = 5.0
STANDING_MPS = 0.3
Slice = tuple[str, str]  # by what, and which
LOWS_M = (0.0, 10.0, 20.0, 30.0)  # where the ranges begin
RANGES: tuple[Slice, ...] = (
    ("range", "0 to 10 m"),
    ("range", "10 to 20 m"),
    ("range", "20 to 30 m"),
    ("range", "over 30 m"),
)
NEAR: Slice = "near the vehicle", f"within {NEAR_M:.0f} m"
TURNING: Slice = "turning", f"by over {math.degrees(TURN_RAD):.0f}°"
Owner = tuple[int, int]  # epoch; person of the ground truth, or track where the log has none


@dataclass(frozen=True, eq=False)
class Candidate:
    """A moment that may be among the worst, with all that its picture shows."""

    kind: MomentKind
    owner: Owner
    size: float
    text: str
    result: FrameResult  # without images
    place_m: FloatArray  # (2,)  where the person was
    velocity_mps: FloatArray  # (2,)
    went_m: FloatArray  # (S, 2)  where it was within the horizon after that; S may be 0
    horizon_ns: int  # moments of one person are farther apart
    track_ids: tuple[int, ...]  # whose predictions are drawn, the present one last; none if it had none
    person_id: int  # of the ground truth; -1: the log has none
    turning: bool
    near_vehicle: bool
    horizon_errors_m: tuple[tuple[float, float], ...] = ()
    worst_of: tuple[WorstOf, ...] = ()

    @property
    def stamp_ns(self) -> int:
        """When it was, by the sensors' clock."""
        return self.result.tracks.stamp_ns

    @property
    def range_m(self) -> float:
        """How far away the person was from the vehicle."""
        return float(np.hypot(*(self.place_m - self.result.sensors.map_from_vehicle[:2, 3])))

    def beside(self, other: "Candidate") -> bool:
        """Returns whether both are of one person within one horizon."""
        return self.owner == other.owner and abs(self.stamp_ns - other.stamp_ns) <= self.horizon_ns


class Worst:
    """The `most` largest candidates by some size, one of a person within a horizon."""

    def __init__(self, most: int, size: Callable[[Candidate], float] = attrgetter("size")):
        self._most, self.size = most, size
        self._open: dict[Owner, Candidate] = {}  # the worst of each person lately: a worse one may come
        self._kept: list[Candidate] = []

    @property
    def least(self) -> float:
        """What is no larger than this would not be kept."""
        if len(self._kept) < self._most:
            return -math.inf
        return self.size(self._kept[-1]) if self._kept else math.inf

    def offer(self, candidate: Candidate) -> None:
        """Takes a candidate; those of one person come in order of time."""
        held = self._open.get(candidate.owner)
        if held is not None and candidate.stamp_ns > held.stamp_ns + held.horizon_ns:
            self._keep(held)
            held = None
        if held is None or self.size(candidate) > self.size(held):
            self._open[candidate.owner] = candidate

    def settle(self, before_ns: int) -> None:
        """Decides on candidates before that time, which no later one can be near to any more."""
        for owner in [owner for owner, candidate in self._open.items() if candidate.stamp_ns < before_ns]:
            self._keep(self._open.pop(owner))

    def ranked(self) -> list[Candidate]:
        """Decides on all candidates, and returns the worst, worst first."""
        while self._open:
            self._keep(self._open.popitem()[1])
        return self._kept

    def _keep(self, candidate: Candidate) -> None:
        self._kept = sorted([*self._kept, candidate], key=self.rank)[: self._most]

    def rank(self, candidate: Candidate) -> tuple[float, float, int, int]:
        """Worst first; of equals the one nearer to the vehicle, then the earlier one."""
        return -self.size(candidate), candidate.range_m, candidate.stamp_ns, candidate.owner[1]


class WorstOfKind:
    """The `most` worst candidates of a kind, and the `few` worst within each slice."""

    def __init__(self, most: int, few: int):
        self.whole = Worst(most)
        self._few = few
        self._slices: dict[Slice, Worst] = {}

    def within(self, part: Slice, size: Callable[[Candidate], float] = attrgetter("size")) -> Worst:
        """Returns the worst of a slice, by another size if it has one."""
        if part not in self._slices:
            self._slices[part] = Worst(self._few, size)
        return self._slices[part]

    def settle(self, before_ns: int) -> None:
        """Decides on candidates before that time, which no later one can be near to any more."""
        for worst in (self.whole, *self._slices.values()):
            worst.settle(before_ns)

    def ranked(self) -> list[Candidate]:
        """Decides on all candidates, and returns the worst, worst first, and which slices each is among the worst of.

        Of one person within a horizon one stays, and stands for the others in their slices.
        """
        found: dict[Candidate, list[WorstOf]] = {candidate: [] for candidate in self.whole.ranked()}
        for (by, value), worst in self._slices.items():
            for candidate in worst.ranked():
                stands = next(filter(candidate.beside, found), candidate)
                found.setdefault(stands, []).append(WorstOf(by, value, worst.size(candidate)))
        return [replace(each, worst_of=tuple(found[each])) for each in sorted(found, key=self.whole.rank)]


def range_slice(range_m: float) -> Slice:
    """Returns the slice that a distance from the vehicle is in."""
    return RANGES[bisect.bisect_right(LOWS_M, range_m) - 1]


def turns(walked_m: FloatArray, span_s: float) -> tuple[FloatArray, BoolArray]:
    """Returns by how much people turn, and who walks at all.

    Directions are those of the four quarters of a walk, so that the noise of single positions does not count; a quarter
    in which somebody is slower than STANDING_MPS has none.

    Args:
        walked_m: (n, S, 2) positions, evenly spaced in time.
        span_s: from the first to the last position.

    Returns:
        (n,) largest angle in rad between the first direction and a later one, positive to the left; (n,) True for
        those who have a direction.
    """
    knots = np.linspace(0, walked_m.shape[1] - 1, 5).round().astype(int)
    legs = np.diff(walked_m[:, knots], axis=1)  # (n, 4, 2)
    moving = np.hypot(legs[..., 0], legs[..., 1]) >= max(STANDING_MPS * span_s / 4, 1e-6)
    headings = np.arctan2(legs[..., 1], legs[..., 0])
    each = np.arange(len(legs))
    first = headings[each, moving.argmax(axis=1)]
    angles = np.where(moving, (headings - first[:, None] + np.pi) % (2 * np.pi) - np.pi, 0.0)
    return angles[each, np.abs(angles).argmax(axis=1)], np.asarray(moving.any(axis=1))
