"""A replay that has been done, for tests and notebooks: tracks, predictions and scores, typed, and how they compare.

`replay_log` makes one (replay/replay_cache.py). Its messages are read from the output when they are first asked for.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from replay.check_result import Status
from replay.diff_result import Tolerances
from replay.log_reader import LogReader
from replay.process_lock import held
from replay.reference import BadReference, Comparison, compare, reference_path, write_reference
from replay.score import MIN_LIDAR_POINTS, match
from schemas import codec, topics
from schemas.messages import (
    BoolArray,
    FloatArray,
    GroundTruthFrame,
    IntArray,
    Prediction,
    PredictionFrame,
    Track,
    TrackFrame,
    VehiclePose,
)

TRUTH_TOPIC = next(topic.name for topic in topics.INPUTS if topic.role == "truth")
USUAL = Tolerances()
M = TypeVar("M")


@dataclass(frozen=True)
class Errors:
    """Mean errors of scored predictions; None if none could be scored, as in a drive shorter than the horizon."""

    scored: int = 0
    ade_m: float | None = None  # of the likeliest path, mean over its steps
    fde_m: float | None = None  # at its last step
    mhd_m: float | None = None  # modified Hausdorff distance
    nll: float | None = None  # negative log likelihood of the mixture

    @classmethod
    def of(cls, figures: dict[str, Any]) -> Self:
        """Returns the errors that a part of a summary holds."""
        return cls(**{each.name: figures[each.name] for each in fields(cls) if each.name in figures})


@dataclass(frozen=True)
class Scores:
    """A replay's figures, as in the summary of `pcgan replay --json`.

    Tracking is scored against ground truth: without it, as in any real drive, those figures are None. Predictions are
    scored against where the tracks were measured later.
    """

    hota: float | None = None
    det_a: float | None = None
    ass_a: float | None = None
    idf1: float | None = None
    mota: float | None = None
    id_switches: int | None = None
    missed: int | None = None  # people times frames
    false: int | None = None  # tracks times frames
    ospa_m: float | None = None
    gospa_m: float | None = None
    localisation_m: float | None = None
    people_seen: int | None = None
    people_tracked: int | None = None
    people_predicted: int | None = None
    scored: int = 0
    ade_m: float | None = None
    fde_m: float | None = None
    mhd_m: float | None = None
    nll: float | None = None
    ground_truth: Errors = Errors()  # of the predictions, against where people really were
    tracker: Errors = Errors()  # of the tracker's extrapolation, against where the tracks were: the baseline

    @classmethod
    def of(cls, summary: dict[str, Any]) -> Self:
        """Returns the figures of a summary."""
        truth, errors = summary.get("ground_truth", {}), {each.name for each in fields(Errors)}
        tracking = {each.name for each in fields(cls)} - errors - {"ground_truth", "tracker"}
        return cls(
            **{name: truth.get(name) for name in tracking},
            **{name: summary[name] for name in errors if name in summary},
            ground_truth=Errors.of(truth),
            tracker=Errors.of(summary.get("tracker", {})),
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """One LiDAR scan of a replay: everything that is known at its stamp."""

    at_s: float  # into the log, by log time: what --start counts
    log_time_ns: int
    tracks: TrackFrame
    predictions: PredictionFrame
    pose: VehiclePose
    truth: GroundTruthFrame | None

    @property
    def stamp_ns(self) -> int:
        """The scan's stamp."""
        return self.tracks.stamp_ns

    def range_m(self, positions_m: FloatArray) -> FloatArray:
        """Returns how far positions (..., 2) are from the vehicle's origin (...)."""
        distance: FloatArray = np.linalg.norm(np.asarray(positions_m) - self.pose.position_m[:2], axis=-1)
        return distance


@dataclass(frozen=True, eq=False)
class TrackPath:
    """One track through a replay: T frames that hold it, in order."""

    id: int
    epoch: int
    at_s: FloatArray  # (T,)  into the log
    stamps_ns: IntArray  # (T,)
    positions_m: FloatArray  # (T, 2)  odometry frame
    velocities_mps: FloatArray  # (T, 2)
    coasting: BoolArray  # (T,)  no measurement behind it
    range_m: FloatArray  # (T,)  from the vehicle's origin
    fallback: BoolArray  # (T,)  the prediction is the tracker's extrapolation
    corridor_probability: FloatArray  # (T,)  of entering the vehicle's corridor within the horizon
    corridor_time_s: FloatArray  # (T,)  expected time to that; NaN where it cannot happen
    predictions: tuple[Prediction, ...]  # (T,)

    def __repr__(self) -> str:
        return f"<track {self.id}: {len(self.at_s)} frames from {self.at_s[0]:.3f} to {self.at_s[-1]:.3f} s>"


@dataclass(frozen=True)
class Gap:
    """A time in which a person was there to be seen and no track stood for them."""

    person_id: int  # of the ground truth
    from_s: float  # into the log
    duration_s: float  # to the next frame in which it was otherwise, or to the last
    nearest_m: float  # to the vehicle's origin, within that time


@dataclass(eq=False)
class References:
    """Where references lie, and whether this run writes them."""

    folder: Path
    reason: str | None = None  # why they are rewritten; None: they stay as they are
    remedy: str = "replayed.write_reference(reason)"  # what writes one
    written: list[Path] = field(default_factory=list)  # by this run
    lock: Path | None = None  # shared by all processes that may write them; None: no other one does

    def kept_from_others(self) -> AbstractContextManager[None]:
        """Keeps other processes of a run that writes references from comparing and writing, until the block ends."""
        return nullcontext() if self.lock is None or self.reason is None else held(self.lock)


@dataclass(frozen=True, eq=False, repr=False)
class Replayed:
    """One recording replayed; reads the output when asked for what is in it."""

    name: str  # of the recording, and of the variant if that has a name
    logs: tuple[str, ...]  # paths or URLs
    output: Path  # MCAP; copy it to keep it
    summary: dict[str, Any]  # what `pcgan replay --json` writes
    start_ns: int  # log time of the recording's first message
    truth_file: Path | None = None  # MCAP with the ground truth of each frame, if the recording has any
    references: References | None = None

    def __repr__(self) -> str:
        return f"<replay of {self.name}: {self.summary['frames']} frames, {self.summary['tracks']} tracks>"

    @cached_property
    def scores(self) -> Scores:
        """How well it tracked and predicted."""
        return Scores.of(self.summary)

    @property
    def refused(self) -> int:
        """How many of the recording's messages were refused; `summary["refusals"]` says which and why."""
        return int(self.summary["refused"])

    @cached_property
    def tracks(self) -> tuple[TrackFrame, ...]:
        """One TrackFrame per LiDAR scan."""
        return tuple(message for _, message in self._messages(self.output, topics.TRACKS.name, TrackFrame))

    @cached_property
    def predictions(self) -> tuple[PredictionFrame, ...]:
        """The PredictionFrame that answers each of `tracks`."""
        return tuple(message for _, message in self._messages(self.output, topics.PREDICTIONS.name, PredictionFrame))

    @cached_property
    def poses(self) -> tuple[VehiclePose, ...]:
        """The vehicle's pose at the stamp of each of `tracks`."""
        return tuple(message for _, message in self._messages(self.output, topics.VEHICLE_POSE.name, VehiclePose))

    @cached_property
    def truth(self) -> tuple[GroundTruthFrame | None, ...]:
        """Where people were at the stamp of each of `tracks`; empty if the recording has no ground truth."""
        if self.truth_file is None:
            return ()
        # by both times: stamps come again after a clock reset, and one message may release several frames
        frames = self._messages(self.truth_file, TRUTH_TOPIC, GroundTruthFrame)
        known = {(log_time_ns, truth.stamp_ns): truth for log_time_ns, truth in frames}
        asked = zip(self._log_times_ns, self.tracks, strict=True)
        return tuple(known.get((log_time_ns, frame.stamp_ns)) for log_time_ns, frame in asked)

    @cached_property
    def frames(self) -> tuple[Frame, ...]:
        """All of the above, put together by frame."""
        truth = self.truth or (None,) * len(self.tracks)
        rows = zip(self._log_times_ns, self.tracks, self.predictions, self.poses, truth, strict=True)
        return tuple(Frame((row[0] - self.start_ns) / 1e9, *row) for row in rows)

    def at(self, seconds: float) -> Frame:
        """Returns the newest frame at a time into the log, as `--start` counts it; LookupError before the first."""
        row = int(np.searchsorted(self._log_times_ns, self.start_ns + round(seconds * 1e9), side="right")) - 1
        if row < 0:
            first = f"the first comes at {self.frames[0].at_s:.3f} s" if self.frames else "there is none"
            raise LookupError(f"no frame at {seconds:g} s: {first}")
        return self.frames[row]

    @cached_property
    def track_ids(self) -> tuple[int, ...]:
        """The ids of all tracks, rising."""
        return tuple(sorted({track.id for frame in self.tracks for track in frame.tracks}))

    def track(self, track_id: int, epoch: int = 0) -> TrackPath:
        """Returns a track through all frames that hold it. Raises LookupError if there is none of this id.

        Ids are numbered in the order of confirmation, and another setting may renumber them: `track_near` finds a
        track by where it was. After a clock reset ids begin anew, in another epoch.
        """
        rows = [
            (frame, track, prediction)
            for frame in self.frames
            if frame.tracks.epoch == epoch
            for track, prediction in zip(frame.tracks.tracks, frame.predictions.predictions, strict=True)
            if track.id == track_id
        ]
        if not rows:
            raise LookupError(f"no track {track_id} in epoch {epoch}; there are {', '.join(map(str, self.track_ids))}")
        return _track_path(track_id, epoch, rows)

    def track_near(self, x_m: float, y_m: float, at_s: float, within_m: float = 2.0) -> TrackPath:
        """Returns the track that was nearest to a place, in the odometry frame, at a time into the log.

        Raises LookupError if none was within `within_m` of it, or if there is no frame at that time: before the first,
        or later than the last by more than a frame takes.
        """
        frame = self.at(at_s)
        last = self.frames[-1]
        if at_s > last.at_s + self._frame_s:
            raise LookupError(f"no frame at {at_s:g} s: the last comes at {last.at_s:.3f} s")
        if not frame.tracks.tracks:
            raise LookupError(f"nobody is tracked at {at_s:g} s")
        place = np.array([x_m, y_m])
        away_m = [float(np.linalg.norm(track.state[:2] - place)) for track in frame.tracks.tracks]
        row = int(np.argmin(away_m))
        nearest = frame.tracks.tracks[row]
        if not away_m[row] <= within_m:
            raise LookupError(
                f"nobody is tracked within {within_m:g} m of ({x_m:g}, {y_m:g}) at {at_s:g} s; "
                f"the nearest, track {nearest.id}, is {away_m[row]:.3g} m away"
            )
        return self.track(nearest.id, frame.tracks.epoch)

    def untracked(self, within_m: float = np.inf, min_lidar_points: int = MIN_LIDAR_POINTS) -> list[Gap]:
        """Returns when people near the vehicle had no track, earliest first. Needs ground truth; else ValueError.

        Args:
            within_m: nearer to the vehicle's origin than this.
            min_lidar_points: whoever the scan hit less often is not expected to be tracked.
        """
        if self.truth_file is None:
            raise ValueError(f"{self.name} has no ground truth, so nobody knows who was not tracked")
        gaps: list[Gap] = []
        open_gaps: dict[int, tuple[float, float]] = {}  # person -> since when, nearest so far
        for frame in self.frames:
            missed = _missed(frame, within_m, min_lidar_points)
            for person in sorted(set(open_gaps) - set(missed)):
                gaps.append(_gap(person, *open_gaps.pop(person), frame.at_s))
            for person, range_m in missed.items():
                since_s, nearest_m = open_gaps.get(person, (frame.at_s, range_m))
                open_gaps[person] = (since_s, min(nearest_m, range_m))
        gaps += [_gap(person, *gap, self.frames[-1].at_s) for person, gap in open_gaps.items()]
        return sorted(gaps, key=lambda gap: (gap.from_s, gap.person_id))

    # --- references ------------------------------------------------------------------------------------------------

    @property
    def reference(self) -> Path:
        """Where this replay's reference lies, or will. Raises ValueError if no folder of references is known."""
        if self.references is None:
            raise ValueError(f"no folder of references is known for {self.name}; give the path of one")
        return reference_path(self.references.folder, self.name)

    def compare(
        self,
        reference: Path | None = None,
        *,
        atol: float = USUAL.atol,
        rtol: float = USUAL.rtol,
        ignore: Sequence[str] = USUAL.ignore,
        topics: Sequence[str] | None = USUAL.topics,
        share: float = USUAL.share,
    ) -> Comparison:
        """Returns how the output differs from a reference.

        Args:
            reference: None: `self.reference`.
            atol: numbers a of the reference and b are the same if |a - b| <= atol + rtol |a|.
            rtol: see atol.
            ignore: fields, and all in them, by their dotted names: "predictions.mixture".
            topics: None: all.
            share: of a topic's values that may lie outside, 0 to 1.

        Raises BadReference if the reference cannot be read.
        """
        only = None if topics is None else tuple(topics)
        tolerances = Tolerances(atol=atol, rtol=rtol, ignore=tuple(ignore), topics=only, share=share)
        return compare(reference or self.reference, self.output, self.summary, tolerances)

    def write_reference(self, reason: str, reference: Path | None = None) -> Path:
        """Makes this output the reference, with the reason in it; returns the file."""
        path = reference or self.reference
        write_reference(path, self.output, self.summary, reason)
        return path

    def assert_matches_reference(
        self,
        *,
        atol: float = USUAL.atol,
        rtol: float = USUAL.rtol,
        ignore: Sequence[str] = USUAL.ignore,
        topics: Sequence[str] | None = USUAL.topics,
        share: float = USUAL.share,
    ) -> None:
        """Raises AssertionError, with the first difference per topic, if the output is not as the reference says.

        In a run that updates references, one that is missing, damaged or differs is written instead. The arguments are
        those of `compare`.
        """
        __tracebackhide__ = True  # the test's own line is the one to look at
        with self.references.kept_from_others() if self.references is not None else nullcontext():
            try:
                found = self.compare(atol=atol, rtol=rtol, ignore=ignore, topics=topics, share=share)
                problem = "" if found.status in {Status.IDENTICAL, Status.CLOSE} else _problem(self, found)
            except BadReference as error:
                problem = str(error).partition("; write it anew")[0]  # what follows is how on the command line
            if problem:
                self._mend(problem)

    def _mend(self, problem: str) -> None:
        """Writes the reference in a run that updates them; else raises AssertionError."""
        __tracebackhide__ = True
        references = self.references
        assert references is not None, "self.reference has raised"
        if references.reason is None:
            raise AssertionError(f"{problem}\nif this output is right: {references.remedy}")
        if self.reference in references.written:
            raise AssertionError(
                f"{problem}\nthis run has just written that reference from another replay: two variants of a recording "
                'need a name each, replay_log(..., name="...")'
            )
        references.written.append(self.write_reference(references.reason))

    def _messages(self, path: Path, topic: str, kind: type[M]) -> list[tuple[int, M]]:
        return [(each.log_time_ns, codec.decode(kind, each.data)) for each in LogReader([path]).messages({topic})]

    @property
    def _frame_s(self) -> float:
        """How long a frame usually takes; 0 of a single one."""
        return float(np.median(np.diff(self._log_times_ns))) / 1e9 if len(self.frames) > 1 else 0.0

    @cached_property
    def _log_times_ns(self) -> list[int]:
        return [each.log_time_ns for each in LogReader([self.output]).messages({topics.TRACKS.name})]


def _problem(replayed: Replayed, found: Comparison) -> str:
    """Returns what a reader of a failed test wants to know: what differs first, what was changed, where to look."""
    path = replayed.reference
    if found.status is Status.UNREFERENCED:
        return f"{replayed.name} has no reference {path}\nits output: {replayed.output}"
    unlike = {topic.topic for topic in found.diff.topics if not topic.same} if found.diff is not None else set()
    firsts = [f"  {first}" for first in found.diff.firsts if first.topic in unlike] if found.diff is not None else []
    lines = [
        f"{replayed.name}: its reference (first) and this output (second) differ",
        *(firsts or [f"  {found.problem}"]),
    ]
    if found.reference is not None:
        changed = found.reference.changed or ("nothing: settings, model, version and recording are the same",)
        lines += ["changed since the reference was written:", *(f"  {change}" for change in changed)]
        lines.append(f"why it was written: {found.reference.reason}")
    return "\n".join([*lines, f"look closer: pcgan diff {path} {replayed.output}"])


def _gap(person: int, since_s: float, nearest_m: float, until_s: float) -> Gap:
    """Returns a gap in whole milliseconds and millimetres: it is there to be read in a failed assertion."""
    return Gap(person, round(since_s, 3), round(until_s - since_s, 3), round(nearest_m, 3))


def _missed(frame: Frame, within_m: float, min_lidar_points: int) -> dict[int, float]:
    """Returns who should be tracked in a frame and is not, and how far from the vehicle."""
    truth = frame.truth
    if truth is None:
        return {}
    tracked = set(match(frame.tracks.tracks, truth).tolist())
    return {
        person: range_m
        for person, range_m, points in zip(
            truth.ids.tolist(), frame.range_m(truth.positions_m).tolist(), truth.lidar_points.tolist(), strict=True
        )
        if range_m < within_m and points >= min_lidar_points and person not in tracked
    }


def _track_path(track_id: int, epoch: int, rows: list[tuple[Frame, Track, Prediction]]) -> TrackPath:
    frames, tracks, predictions = zip(*rows, strict=True)
    states = np.array([track.state for track in tracks])  # (T, 4)
    times_s = [prediction.corridor_time_s for prediction in predictions]
    return TrackPath(
        track_id,
        epoch,
        at_s=np.array([frame.at_s for frame in frames]),
        stamps_ns=np.array([frame.stamp_ns for frame in frames], np.int64),
        positions_m=states[:, :2],
        velocities_mps=states[:, 2:],
        coasting=np.array([track.coasting for track in tracks]),
        range_m=np.array([frame.range_m(track.state[:2]) for frame, track, _ in rows]),
        fallback=np.array([prediction.fallback for prediction in predictions]),
        corridor_probability=np.array([prediction.corridor_probability for prediction in predictions]),
        corridor_time_s=np.array([np.nan if time_s is None else time_s for time_s in times_s]),
        predictions=predictions,
    )
