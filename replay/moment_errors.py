"""Where predictions were most wrong, and their errors in slices: by range, horizon, turning, nearness and speed."""

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from operator import attrgetter

import numpy as np

from replay.check_result import ErrorSlice, MomentKind, horizon_name
from replay.frame_result import FrameResult
from replay.moment_ranking import (
    LOWS_M,
    NEAR,
    NEAR_M,
    RANGES,
    STANDING_MPS,
    TURN_RAD,
    TURNING,
    Candidate,
    Slice,
    WorstOfKind,
    turns,
)
from replay.score import (
    FRAMES_AT_A_TIME,
    MAX_GAP_NS,
    Positions,
    lookup,
    match,
    track_positions,
    true_positions,
)
from schemas.messages import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class _Asked:
    """The network's predictions of one frame that can be compared with somebody; A of them."""

    result: FrameResult
    track_ids: IntArray  # (A,)
    owners: IntArray  # (A,)  people of the ground truth, or the tracks themselves
    of_truth: bool
    places_m: FloatArray  # (A, 2)
    velocities_mps: FloatArray  # (A, 2)
    paths_m: FloatArray  # (A, P, 2)  the likeliest

    @property
    def stamp_ns(self) -> int:
        return self.result.tracks.stamp_ns

    @cached_property
    def horizon_ns(self) -> int:
        return round(self.result.predictions.dt_s * 1e9) * int(self.paths_m.shape[1])

    @cached_property
    def known_ns(self) -> int:
        """When it is known where everybody was at the last step."""
        return self.stamp_ns + self.horizon_ns + MAX_GAP_NS


@dataclass(frozen=True, eq=False)
class _Compared:
    """Predictions whose future is known; N of them, over P steps."""

    errors_m: FloatArray  # (N, P)
    ade_m: FloatArray  # (N,)
    walked_m: FloatArray  # (N, P + 1, 2)  where the people were, from now on
    range_m: FloatArray  # (N,)
    turned_rad: FloatArray  # (N,)  positive to the left
    walks: BoolArray  # (N,)
    near: BoolArray  # (N,)
    standing: BoolArray  # (N,)
    dt_s: float

    @property
    def turning(self) -> BoolArray:
        return np.asarray(np.abs(self.turned_rad) > TURN_RAD)

    def parts(self) -> Iterator["_Part"]:
        """Yields what is in each slice."""
        range_of = np.searchsorted(LOWS_M, self.range_m, side="right") - 1
        for number, part in enumerate(RANGES):
            yield _Part(part, range_of == number, self.ade_m)
        everybody, steps = np.ones(len(self.ade_m), bool), self.errors_m.shape[1]
        for step in sorted({math.ceil(steps * quarter / 4) for quarter in (1, 2, 3, 4)}):
            name = horizon_name(step * self.dt_s)
            yield _Part(("horizon", name), everybody, self.errors_m[:, step - 1], partial(_error_at, step=step))
        yield _Part(TURNING, self.walks & self.turning, self.ade_m)
        yield _Part(("turning", "straight on"), self.walks & ~self.turning, self.ade_m)
        yield _Part(NEAR, self.near, self.ade_m)
        yield _Part(("near the vehicle", "farther away"), ~self.near, self.ade_m)
        yield _Part(("speed", "standing"), self.standing, self.ade_m)
        yield _Part(("speed", "walking"), ~self.standing, self.ade_m)


@dataclass(frozen=True, eq=False)
class _Part:
    """Which of N predictions are in a slice, by which error it goes, and how to tell that of a candidate."""

    part: Slice
    inside: BoolArray  # (N,)
    errors_m: FloatArray  # (N,)
    size: Callable[[Candidate], float] = attrgetter("size")


@dataclass(eq=False)
class _Sums:
    """The errors of one slice."""

    count: int = 0
    total_m: float = 0.0
    largest_m: float = 0.0

    def add(self, errors_m: FloatArray) -> None:
        """Takes some more."""
        if len(errors_m):
            self.count += len(errors_m)
            self.total_m += float(errors_m.sum())
            self.largest_m = max(self.largest_m, float(errors_m.max()))


class ErrorWatch:
    """Takes frames, and keeps the worst prediction errors, of all and of each slice, and the sums of all."""

    def __init__(self, most: int, few: int):
        self._worst = WorstOfKind(most, few)
        self._asked: deque[_Asked] = deque()
        self._tracked: deque[Positions] = deque()
        self._true: deque[Positions] = deque()
        self._vehicle: deque[tuple[int, float, float]] = deque()
        self._sums: dict[Slice, _Sums] = {}

    def add(self, result: FrameResult) -> None:
        """Takes the next frame, without images, and compares the predictions that are due."""
        stamp_ns = result.tracks.stamp_ns
        x_m, y_m = result.sensors.map_from_vehicle[:2, 3].tolist()
        self._vehicle.append((stamp_ns, x_m, y_m))
        self._tracked.append(track_positions(stamp_ns, result.tracks.tracks))
        if result.ground_truth is not None:
            self._true.append(true_positions(result.ground_truth))
        asked = _comparable(result)
        if asked is not None:
            self._asked.append(asked)
        self._settle(stamp_ns)

    def end_epoch(self) -> None:
        """Compares what can still be compared; stamps and ids begin anew after that."""
        self._settle(None)
        for seen in (self._tracked, self._true, self._vehicle):
            seen.clear()

    def ranked(self) -> list[Candidate]:
        """Returns the worst errors, worst first, after the last epoch has ended."""
        return self._worst.ranked()

    def slices(self) -> list[ErrorSlice]:
        """Returns the errors of every slice that has any."""
        return [
            ErrorSlice(*part, sums.count, sums.total_m / sums.count, sums.largest_m)
            for part, sums in self._sums.items()
            if sums.count
        ]

    def _settle(self, now_ns: int | None) -> None:
        """Compares the predictions whose last step lies far enough back; all of them without a present time.

        Several frames at once: they are small, and numpy's cost is per call.
        """
        due = list(itertools.takewhile(lambda asked: now_ns is None or asked.known_ns <= now_ns, self._asked))
        if due and (len(due) >= FRAMES_AT_A_TIME or now_ns is None):
            for _ in due:
                self._asked.popleft()
            for of_truth, seen in ((True, self._true), (False, self._tracked)):
                frames = [asked for asked in due if asked.of_truth is of_truth]
                if frames:
                    self._compare(frames, seen)
            self._worst.settle(due[-1].stamp_ns - due[-1].horizon_ns)
        oldest_ns = self._asked[0].stamp_ns if self._asked else now_ns
        if oldest_ns is not None:
            for frames_seen in (self._tracked, self._true):
                while frames_seen and frames_seen[0].stamp_ns < oldest_ns - MAX_GAP_NS:
                    frames_seen.popleft()
            while self._vehicle and self._vehicle[0][0] < oldest_ns - MAX_GAP_NS:
                self._vehicle.popleft()

    def _compare(self, frames: Sequence[_Asked], seen: Sequence[Positions]) -> None:
        """Compares the paths of several frames with where people, or tracks, were seen later."""
        steps = np.arange(1, frames[0].paths_m.shape[1] + 1)
        dt_s = frames[0].result.predictions.dt_s
        frame_of = np.repeat(np.arange(len(frames)), [len(frame.owners) for frame in frames])
        row_of = np.concatenate([np.arange(len(frame.owners)) for frame in frames])
        stamps_ns = np.array([frame.stamp_ns for frame in frames])[frame_of]
        steps_ns = stamps_ns[:, None] + np.round(dt_s * 1e9 * steps).astype(np.int64)
        went, known = lookup(seen, np.concatenate([frame.owners for frame in frames]), steps_ns)
        rows = np.flatnonzero(known.all(axis=1))
        if len(rows) == 0:
            return
        paths, places, velocities = (
            np.concatenate(parts)[rows]
            for parts in zip(*[(f.paths_m, f.places_m, f.velocities_mps) for f in frames], strict=True)
        )
        walked = np.concatenate([places[:, None], went[rows]], axis=1)
        errors = np.linalg.norm(paths - went[rows], axis=-1)
        from_vehicle = np.linalg.norm(walked - self._vehicle_at(np.column_stack([stamps_ns, steps_ns])[rows]), axis=-1)
        turned, walks = turns(walked, dt_s * len(steps))
        compared = _Compared(
            errors,
            errors.mean(axis=1),
            walked,
            from_vehicle[:, 0],
            turned,
            walks,
            (from_vehicle < NEAR_M).any(axis=1),
            np.hypot(*velocities.T) < STANDING_MPS,
            dt_s,
        )

        @cache
        def candidate(i: int) -> Candidate:  # the same one for every slice it is in
            return _candidate(frames[frame_of[rows[i]]], int(row_of[rows[i]]), compared, i)

        for i in np.flatnonzero(compared.ade_m > self._worst.whole.least).tolist():
            self._worst.whole.offer(candidate(i))
        for part in compared.parts():
            self._sums.setdefault(part.part, _Sums()).add(part.errors_m[part.inside])
            worst = self._worst.within(part.part, part.size)
            for i in np.flatnonzero(part.inside & (part.errors_m > worst.least)).tolist():
                worst.offer(candidate(i))

    def _vehicle_at(self, times_ns: IntArray) -> FloatArray:
        """Returns where the vehicle was (..., 2)."""
        stamps_ns = np.array([seen[0] for seen in self._vehicle])
        places_m = np.array([seen[1:] for seen in self._vehicle])
        since_ns = times_ns - stamps_ns[0]
        return np.stack([np.interp(since_ns, stamps_ns - stamps_ns[0], axis) for axis in places_m.T], axis=-1)


def _comparable(result: FrameResult) -> _Asked | None:
    """Returns the network's predictions: with ground truth those of people, without it all; None if there are none."""
    predictions, truth = result.predictions.predictions, result.ground_truth
    wanted = np.array([not prediction.fallback for prediction in predictions], bool)
    tracks, person_of = result.tracks.tracks, None
    if truth is not None:
        person_of = match(tracks, truth)
        wanted &= person_of >= 0
    rows = np.flatnonzero(wanted)
    if len(rows) == 0:
        return None
    ids = np.array([tracks[row].id for row in rows], np.int64)
    paths_m = np.stack([predictions[row].paths[0].points_m for row in rows])
    if truth is None or person_of is None:
        states = np.array([tracks[row].state for row in rows])
        return _Asked(result, ids, ids, False, states[:, :2], states[:, 2:], paths_m)
    owners = person_of[rows]
    order = np.argsort(truth.ids)
    place = order[np.searchsorted(truth.ids, owners, sorter=order)]
    return _Asked(result, ids, owners, True, truth.positions_m[place], truth.velocities_mps[place], paths_m)


def _candidate(frame: _Asked, row: int, compared: _Compared, i: int) -> Candidate:
    track_id, owner, errors_m = int(frame.track_ids[row]), int(frame.owners[row]), compared.errors_m[i]
    turning = bool(compared.turning[i])
    how = f"; it turned {'left' if compared.turned_rad[i] > 0 else 'right'}" if turning else ""
    return Candidate(
        kind=MomentKind.ERROR,
        owner=(frame.result.tracks.epoch, owner),
        size=float(compared.ade_m[i]),
        text=f"track {track_id}: ADE {compared.ade_m[i]:.2f} m, FDE {errors_m[-1]:.2f} m{how}",
        result=frame.result,
        place_m=compared.walked_m[i, 0],
        velocity_mps=frame.velocities_mps[row],
        went_m=compared.walked_m[i, 1:],
        horizon_ns=frame.horizon_ns,
        track_ids=(track_id,),
        person_id=owner if frame.of_truth else -1,
        turning=turning,
        near_vehicle=bool(compared.near[i]),
        horizon_errors_m=tuple(
            (round(step * compared.dt_s, 9), float(error)) for step, error in enumerate(errors_m, 1)
        ),
    )


def _error_at(candidate: Candidate, step: int) -> float:
    return candidate.horizon_errors_m[step - 1][1]
