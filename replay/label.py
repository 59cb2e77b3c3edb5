"""A recorded drive -> the smoothed trajectories of its pedestrians, to train a predictor on.

Every track is looked at in hindsight: late scans are put where they belong, and positions and velocities are those that
all measurements of the track speak for, later ones and those from before it was published included.
"""

import heapq
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from threadpoolctl import threadpool_limits

from pcgan.clips import TRAJECTORY_SUFFIXES, ClipError
from pcgan.trajectory_file import LONGEST_GAP_S, TrajectoryRows, write_rows
from replay.errors import LogError, OutputError, Refusals
from replay.label_score import LabelScore, Scores
from replay.session import Replay
from replay.time_sync import SyncedFrame
from schemas.messages import FloatArray, IntArray
from tracking.label_report import LabelReport, Verdict
from tracking.measurements import Measurements
from tracking.smoother import SmootherParams, smooth

NO_ID = -1  # in rows that tell of the vehicle alone


class LabelSettings(BaseModel):
    """Which tracks become trajectories, and how they are smoothed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_duration_s: float = Field(default=1.0, ge=0, description="shorter trajectories are left out")
    min_hits: int = Field(default=5, ge=1, description="so are those of fewer measurements")
    min_published: float = Field(
        default=0.5, ge=0, le=1, description="and tracks taken for a pedestrian in less than this share of their hits"
    )
    max_gap_s: float = Field(
        default=LONGEST_GAP_S, gt=0, description="a trajectory ends where its person is not measured for longer"
    )
    smoother: SmootherParams = SmootherParams()


@dataclass(frozen=True, eq=False)
class Labelled:
    """What a drive gave."""

    rows: TrajectoryRows
    scans: int
    tracks: int  # published as pedestrians
    tracks_kept: int  # of those, the ones long enough for a trajectory
    trajectories: int  # a track gives several if it was lost from sight in between
    score: dict[str, Scores] | None  # "tracker" and "labels"; None without ground truth

    def as_json(self) -> dict[str, object]:
        """Returns everything but the rows under the names that users rely on."""
        people = self.rows.people
        return {
            "scans": self.scans,
            "tracks": self.tracks,
            "tracks_kept": self.tracks_kept,
            "trajectories": self.trajectories,
            "rows": int(people.sum()),
            "vehicle_rows": int((~people).sum()),
            **({} if self.score is None else {"ground_truth": {name: asdict(s) for name, s in self.score.items()}}),
        }


def label(
    run: Replay, settings: LabelSettings | None = None, on_frame: Callable[[SyncedFrame], None] = lambda _: None
) -> Labelled:
    """Returns the trajectories of a drive; no predictor is started, and what is refused is counted in `run.refusals`.

    Raises LogError if the log cannot be used, if there is nothing to write, or if the clock is set back on the way.
    """
    tracker, labeller, truth = run.tracker(), _Labeller(settings or LabelSettings()), LabelScore()
    epoch: int | None = None  # of the first scan that gets rows
    with threadpool_limits(1):  # sums in BLAS depend on how many threads share them
        for frame in in_order(run.frames(), run.settings.tracking.tracker.ring, run.refusals):
            measurements, _ = tracker.step(frame)
            stamp_ns, wanted = frame.sensors.stamp_ns, frame.log_time_ns >= run.start_ns
            for _ in range(measurements.refused):
                run.refusals.add("scans", stamp_ns, "cluster out of reach, or of an impossible shape")
            report = tracker.labels()
            labeller.add(frame, measurements, report, wanted=wanted)
            if wanted:
                epoch = frame.epoch if epoch is None else epoch
                if frame.epoch != epoch:
                    raise LogError(
                        f"the clock was set back {(frame.log_time_ns - run.reader.start_ns) / 1e9:.1f} s into the log:"
                        " label what lies before and after on its own, with --duration and --start"
                    )
                if frame.ground_truth is not None:
                    truth.add(report, frame.ground_truth)
            on_frame(frame)
        return labeller.finish(truth)


def in_order(frames: Iterable[SyncedFrame], depth: int, refusals: Refusals) -> Iterator[SyncedFrame]:
    """Yields frames in stamp order within each epoch: `depth` are held back, and late ones are put between them.

    What comes later than that is refused.
    """
    waiting: list[tuple[int, SyncedFrame]] = []  # heap by stamp; stamps differ
    epoch, last_ns = 0, -1
    for frame in frames:
        if frame.epoch != epoch:
            yield from (held for _, held in sorted(waiting))
            waiting, epoch, last_ns = [], frame.epoch, -1
        stamp_ns = frame.sensors.stamp_ns
        if stamp_ns <= last_ns:
            refusals.add("scans", stamp_ns, "scan too late to use")
            continue
        heapq.heappush(waiting, (stamp_ns, frame))
        if len(waiting) > depth:
            last_ns, first = heapq.heappop(waiting)
            yield first
    yield from (held for _, held in sorted(waiting))


def save(rows: TrajectoryRows, output: Path) -> None:
    """Writes the rows as OUTPUT.part and renames it when it is whole; raises OutputError if that cannot be done."""
    part = part_of(output)
    try:
        write_rows(rows, part)
        part.replace(output)
    except ClipError as error:
        raise OutputError(str(error)) from error
    except OSError as error:
        raise OutputError(f"{output} cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def part_of(output: Path) -> Path:
    """Returns what a trajectory file is called until it is whole; it keeps its ending, which says how to write it."""
    suffix = next(suffix for suffix in TRAJECTORY_SUFFIXES if output.name.endswith(suffix))
    return output.with_name(f"{output.name.removesuffix(suffix)}.part{suffix}")


@dataclass
class _Track:
    """The measurements of one label so far, by the scan they are of."""

    id: int = 0  # 0: never published so far
    published: int = 0  # in how many of the scans below
    scans: list[int] = field(default_factory=list)  # K, rising
    positions_m: list[FloatArray] = field(default_factory=list)  # K of (2,)
    covariances_m2: list[FloatArray] = field(default_factory=list)  # K of (2, 2)


class _Labeller:
    """Collects what each label measured, and smooths it once the label has gone."""

    def __init__(self, settings: LabelSettings):
        self._settings = settings
        self._stamps: list[int] = []  # of every scan
        self._wanted: list[bool] = []  # which scans get rows
        self._vehicles: list[FloatArray] = []  # (4,) at every scan
        self._open: dict[tuple[int, int, int], _Track] = {}  # by epoch and the label's name
        self._trajectories: list[_Trajectory] = []
        self._tracks = self._kept = 0

    def add(self, frame: SyncedFrame, measurements: Measurements, report: LabelReport, *, wanted: bool) -> None:
        """Takes the next scan: a report's labels that are gone have ended."""
        scan = len(self._stamps)
        self._stamps.append(frame.sensors.stamp_ns)
        self._wanted.append(wanted)
        self._vehicles.append(_vehicle_columns(frame.vehicle_state))
        ended = self._open
        self._open = {name: ended.pop(name, _Track()) for name in ((frame.epoch, *name) for name in report.names)}
        self._end(ended.values())
        published = report.verdict == Verdict.PUBLISHED
        columns = zip(report.ids.tolist(), published.tolist(), report.measurement.tolist(), strict=True)
        for track, (id, is_published, row) in zip(self._open.values(), columns, strict=True):
            track.id = id
            if row >= 0:
                track.published += is_published
                track.scans.append(scan)
                track.positions_m.append(measurements.positions_m[row])
                track.covariances_m2.append(measurements.covariances_m2[row])

    def _end(self, tracks: Iterable[_Track]) -> None:
        """Smooths those of the tracks that were published."""
        for track in tracks:
            if track.id and self._wanted[track.scans[-1]]:
                likely = track.published >= self._settings.min_published * len(track.scans)
                found = self._smoothed(track) if likely else []
                self._trajectories += found
                self._tracks += 1
                self._kept += bool(found)

    def _smoothed(self, track: _Track) -> list["_Trajectory"]:
        """Returns what is kept of a track: a trajectory for each stretch without a gap that is too long."""
        scans, last = np.array(track.scans), track.scans[-1] + 1
        first = track.scans[0]
        stamps, wanted = np.array(self._stamps[first:last]), np.array(self._wanted[first:last])
        measured = np.zeros(len(stamps), bool)
        measured[scans - first] = True
        estimate = smooth(
            stamps, measured, np.array(track.positions_m), np.array(track.covariances_m2), self._settings.smoother
        )
        long_gaps = np.diff(stamps[measured]) > self._settings.max_gap_s * 1e9
        kept = []
        for stretch in np.split(scans - first, np.flatnonzero(long_gaps) + 1):
            rows = np.arange(stretch[0], stretch[-1] + 1)
            rows = rows[wanted[rows]]
            hits = np.count_nonzero(measured[rows])
            if hits >= self._settings.min_hits and np.ptp(stamps[rows]) >= self._settings.min_duration_s * 1e9:
                covs = estimate.covariances[rows, :2, :2].reshape(-1, 4)[:, [0, 1, 3]]
                kept.append(_Trajectory(first + rows, np.full(len(rows), track.id), estimate.states[rows], covs))
        return kept

    def finish(self, truth: LabelScore) -> Labelled:
        """Returns the rows of all trajectories, and of the vehicle where there is nobody; sorted by stamp, then id."""
        self._end(self._open.values())
        found = self._trajectories
        scans = np.concatenate([np.zeros(0, np.int64), *(each.scans for each in found)])
        alone = np.setdiff1d(np.flatnonzero(self._wanted), scans)
        unknown = np.full((len(alone), 4), np.nan)
        scans = np.concatenate([scans, alone])
        if len(scans) == 0:
            raise LogError("the log holds no scan that could be used: there is nothing to label")
        ids = np.concatenate([*(each.ids for each in found), np.full(len(alone), NO_ID)])
        states = np.concatenate([*(each.states for each in found), unknown])
        covs = np.concatenate([*(each.position_covs for each in found), unknown[:, :3]])
        stamps, vehicles = np.array(self._stamps)[scans], np.array(self._vehicles)[scans]
        order = np.lexsort((ids, stamps))
        rows = TrajectoryRows(ids[order], stamps[order], states[order], covs[order], vehicles[order])
        score = truth.against(rows)
        return Labelled(rows, sum(self._wanted), self._tracks, self._kept, len(found), score)


@dataclass(frozen=True, eq=False)
class _Trajectory:
    """Part of a track, by scan."""

    scans: IntArray  # (N,)
    ids: IntArray  # (N,)
    states: FloatArray  # (N, 4)
    position_covs: FloatArray  # (N, 3)  xx, xy, yy


def _vehicle_columns(state: FloatArray) -> FloatArray:
    """[x, y, yaw, vx, vy] (5,) -> [x, y, yaw, speed] (4,); backwards the speed is negative."""
    x, y, yaw, vx, vy = state
    return np.array([x, y, yaw, vx * np.cos(yaw) + vy * np.sin(yaw)])
