"""Who was missed for how long, and whose track changed: where the log holds ground truth."""

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from replay.check_result import MomentKind
from replay.frame_result import FrameResult
from replay.moment_ranking import NEAR, NEAR_M, TURN_RAD, Candidate, WorstOfKind, range_slice, turns
from replay.score import MATCH_M, MAX_GAP_NS, scored_frame
from schemas.messages import FloatArray
from tracking.metrics import ScoredFrame, drop_ignored

FOLLOWED_NS = 4_800_000_000  # how long a picture shows where somebody went, and how far apart a person's moments are
LEAST_MISSED_S = 0.5  # a track takes some scans to be confirmed: nobody is missed before
HIDDEN_NS = 1_000_000_000  # whom the LiDAR has hardly seen for longer is missed anew


@dataclass(eq=False)
class _Followed:
    """A person in a moment, and where it went after that."""

    kind: MomentKind
    person: int
    result: FrameResult
    place_m: FloatArray  # (2,)
    velocity_mps: FloatArray  # (2,)
    range_m: float
    track_ids: tuple[int, ...] = ()
    size: float = 0.0
    text: str = ""
    over: bool = False  # size and text are final
    near: bool = False  # to the vehicle, by now
    last_ns: int = 0  # when it was at the end of its way
    went_m: list[FloatArray] = field(default_factory=list)

    def follow(self, result: FrameResult) -> None:
        """Takes a frame at or after the moment."""
        place = None if self.done(result.tracks.stamp_ns) else _place(result, self.person)
        if place is not None:
            self.near = self.near or _range_m(result, place) < NEAR_M
            if result is not self.result:
                self.went_m.append(place)
                self.last_ns = result.tracks.stamp_ns

    def done(self, now_ns: int) -> bool:
        """Returns whether nothing of the person's way is wanted any more."""
        return now_ns > self.result.tracks.stamp_ns + FOLLOWED_NS

    def candidate(self) -> Candidate:
        """Returns what is known by now."""
        walked = np.array([self.place_m, *self.went_m])
        span_ns = self.last_ns - self.result.tracks.stamp_ns if self.went_m else 0  # shorter if it left
        turned, walks = turns(walked[None], span_ns / 1e9)
        return Candidate(
            kind=self.kind,
            owner=(self.result.tracks.epoch, self.person),
            size=self.size,
            text=self.text,
            result=self.result,
            place_m=self.place_m,
            velocity_mps=self.velocity_mps,
            went_m=walked[1:],
            horizon_ns=FOLLOWED_NS,
            track_ids=self.track_ids,
            person_id=self.person,
            turning=bool(walks[0] and abs(turned[0]) > TURN_RAD),
            near_vehicle=self.near,
        )


@dataclass(eq=False)
class _Stretch:
    """Somebody who is being missed."""

    followed: _Followed  # from the frame in which it was nearest to the vehicle
    last_ns: int
    missed_ns: int = 0


class PeopleWatch:
    """Takes frames with ground truth, and keeps who was missed longest and whose track changed most often.

    Somebody is missed whom the LiDAR sees well enough and no track stands for. Which track stands for whom, and what a
    switch is, is as in the CLEAR metrics (`tracking.metrics.clear`).
    """

    def __init__(self, most: int, few: int):
        self._missed, self._switched = WorstOfKind(most, few), WorstOfKind(most, few)
        self._pairs: dict[int, int] = {}  # person -> track, of the frame before
        self._last: dict[int, tuple[int, int]] = {}  # person -> its last track, and its how many-th that is
        self._stretches: dict[int, _Stretch] = {}
        self._followed: list[_Followed] = []
        self._before_ns: int | None = None

    def add(self, result: FrameResult) -> None:
        """Takes the next frame, without images; one without ground truth says nothing."""
        truth, tracks, stamp_ns = result.ground_truth, result.tracks.tracks, result.tracks.stamp_ns
        if truth is None:
            return
        ids = np.array([track.id for track in tracks], np.int64)
        places_m = np.array([track.state[:2] for track in tracks]).reshape(-1, 2)
        frame = drop_ignored(scored_frame(ids, places_m, truth))
        self._pairs = clear_pairs(frame, self._pairs)
        for person, track in self._pairs.items():
            last, number = self._last.get(person, (track, 1))
            if last != track:
                number += 1
                self._switch(result, person, (last, track), number)
            self._last[person] = track, number
        passed_ns = 0 if self._before_ns is None else min(stamp_ns - self._before_ns, MAX_GAP_NS)
        for person in frame.truth_ids.tolist():
            if person not in self._pairs:
                self._miss(result, person, passed_ns)
        for person, stretch in list(self._stretches.items()):
            if person in self._pairs or stamp_ns - stretch.last_ns > HIDDEN_NS:
                self._end(person)
        for followed in self._followed:
            followed.follow(result)
        self._collect(stamp_ns)
        self._before_ns = stamp_ns

    def end_epoch(self) -> None:
        """Ends what goes on; stamps and ids begin anew after that."""
        for person in list(self._stretches):
            self._end(person)
        self._collect(None)
        self._pairs, self._last, self._before_ns = {}, {}, None

    def ranked(self) -> list[Candidate]:
        """Returns missed people, then switches, each worst first, after the last epoch has ended."""
        return [*self._missed.ranked(), *self._switched.ranked()]

    def _switch(self, result: FrameResult, person: int, tracks: tuple[int, int], number: int) -> None:
        followed = _followed(MomentKind.SWITCH, result, person)
        followed.track_ids, followed.size, followed.over = tracks, float(number), True
        followed.text = f"person {person}: track {tracks[0]} became track {tracks[1]}, its {_ordinal(number)}"
        self._followed.append(followed)

    def _miss(self, result: FrameResult, person: int, passed_ns: int) -> None:
        stamp_ns, now = result.tracks.stamp_ns, _followed(MomentKind.MISSED, result, person)
        stretch = self._stretches.get(person)
        if stretch is not None and stamp_ns - stretch.last_ns > HIDDEN_NS:
            self._end(person)
            stretch = None
        if stretch is None:
            stretch = self._stretches[person] = _Stretch(now, stamp_ns)
            self._followed.append(now)
        elif now.range_m < stretch.followed.range_m:
            self._followed[self._followed.index(stretch.followed)] = now
            stretch.followed = now
        stretch.last_ns = stamp_ns
        stretch.missed_ns += passed_ns

    def _end(self, person: int) -> None:
        stretch = self._stretches.pop(person)
        followed, missed_s = stretch.followed, stretch.missed_ns / 1e9
        followed.size, followed.over = missed_s, True
        followed.text = f"person {person}: without a track for {missed_s:.1f} s, {followed.range_m:.0f} m away"

    def _collect(self, now_ns: int | None) -> None:
        """Offers those who need not be followed any more; everybody without a present time."""
        ended = [f for f in self._followed if now_ns is None or (f.over and f.done(now_ns))]
        for followed in ended:
            self._followed.remove(followed)
            if followed.kind is MomentKind.SWITCH:
                _offer(self._switched, followed.candidate())
            elif followed.size >= LEAST_MISSED_S:
                _offer(self._missed, followed.candidate())
        if now_ns is not None:
            waiting_ns = min((f.result.tracks.stamp_ns for f in self._followed), default=now_ns)
            for worst in (self._missed, self._switched):
                worst.settle(waiting_ns - FOLLOWED_NS)


def _offer(worst: WorstOfKind, candidate: Candidate) -> None:
    """Offers a candidate to the whole and to its slices."""
    worst.whole.offer(candidate)
    worst.within(range_slice(candidate.range_m)).offer(candidate)
    if candidate.near_vehicle:
        worst.within(NEAR).offer(candidate)


def clear_pairs(frame: ScoredFrame, before: dict[int, int], gate_m: float = MATCH_M) -> dict[int, int]:
    """Returns which track stands for each person: a pair of the frame before stays while within the gate.

    The rest is assigned anew, as `tracking.metrics.clear` does it for a whole drive.
    """
    people, tracks, distances_m = frame.truth_ids, frame.track_ids, frame.distances()
    if distances_m.size == 0:
        return {}
    kept = np.array([before.get(person, -1) for person in people.tolist()])[:, None] == tracks
    score = np.where(distances_m <= gate_m, 1000.0 * kept + 1 - distances_m / (2 * gate_m), 0.0)
    rows, columns = linear_sum_assignment(score, maximize=True)
    near = score[rows, columns] > 0
    return dict(zip(people[rows[near]].tolist(), tracks[columns[near]].tolist(), strict=True))


def _followed(kind: MomentKind, result: FrameResult, person: int) -> _Followed:
    row, truth = _row(result, person), result.ground_truth
    assert row is not None, "somebody of this frame"
    assert truth is not None
    place_m, velocity_mps = truth.positions_m[row].astype(float), truth.velocities_mps[row].astype(float)
    return _Followed(kind, person, result, place_m, velocity_mps, _range_m(result, place_m))


def _place(result: FrameResult, person: int) -> FloatArray | None:
    row, truth = _row(result, person), result.ground_truth
    return None if row is None or truth is None else truth.positions_m[row].astype(float)


def _row(result: FrameResult, person: int) -> int | None:
    """Returns where in a frame's ground truth somebody stands; None if nowhere."""
    if result.ground_truth is None:
        return None
    rows = np.flatnonzero(result.ground_truth.ids == person)
    return int(rows[0]) if len(rows) else None


def _range_m(result: FrameResult, place_m: FloatArray) -> float:
    return float(np.hypot(*(place_m - result.sensors.map_from_vehicle[:2, 3])))


def _ordinal(number: int) -> str:
    return f"{number}{'th' if 11 <= number % 100 <= 13 else {1: 'st', 2: 'nd', 3: 'rd'}.get(number % 10, 'th')}"
