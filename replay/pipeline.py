"""Sensor frames -> tracks -> predictions: the pipeline, free of files, sockets and clocks."""

import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np

from replay.errors import Refusals
from replay.frame_result import FrameResult, vehicle_pose
from replay.object_tracks import ObjectTracksParams, TrackAssembler
from replay.remote_predictor import AskedPredictor
from replay.stage_clock import StageClock
from replay.time_sync import SyncedFrame
from schemas.messages import PredictionFrame, TrackFrame, VehicleHistory
from tracking.fusion import Candidate
from tracking.label_report import LabelReport
from tracking.measurements import Measurements, empty_measurements
from tracking.pipeline import TrackingSettings, TrackingStage
from tracking.tracker import LateScanError

HISTORY_NS = 3_600_000_000


class FrameRefused(Exception):
    """Another tracker's tracks that make no sense."""


class FrameStage(Protocol):
    """What makes track frames of synchronised frames, in order."""

    def step(self, frame: SyncedFrame, *, published: bool = True) -> tuple[Measurements, TrackFrame]:
        """Returns what was measured and who is there; unpublished frames have no sequence of their own."""
        ...

    def amend(self, frame: SyncedFrame) -> None:
        """Takes in a frame that came after its successors; raises LateScanError if that cannot be."""
        ...


class _VehicleTrail:
    """Where the vehicle has lately been."""

    def __init__(self) -> None:
        self._states: deque[tuple[int, np.ndarray]] = deque()

    def add(self, frame: SyncedFrame) -> VehicleHistory:
        """Returns the history up to and with a frame."""
        stamp_ns = frame.sensors.stamp_ns
        self._states.append((stamp_ns, frame.vehicle_state))
        while self._states[0][0] < stamp_ns - HISTORY_NS:
            self._states.popleft()
        stamps_ns, states = zip(*self._states, strict=True)
        return VehicleHistory(np.array(stamps_ns, np.int64), np.array(states))


class FrameTracker:
    """Turns synchronised frames into track frames; starts afresh with each epoch of the clock."""

    def __init__(self, settings: TrackingSettings):
        self._settings = settings
        self._stage = TrackingStage(settings)
        self._vehicle = _VehicleTrail()
        self._epoch = 0
        self._sequence = 0

    def step(self, frame: SyncedFrame, *, published: bool = True) -> tuple[Measurements, TrackFrame]:
        """Tracks one frame; unpublished ones, which warm the tracker up, have no sequence of their own."""
        sensors = frame.sensors
        self._enter_epoch(frame)
        vehicle = self._vehicle.add(frame)
        result = self._stage.step(sensors)
        tracks = TrackFrame(
            self._sequence,
            sensors.stamp_ns,
            sensors.frame_id,
            vehicle,
            result.tracks,
            sensors.pose_extrapolated,
            frame.epoch,
        )
        self._sequence += published
        return result.measurements, tracks

    def _enter_epoch(self, frame: SyncedFrame) -> None:
        if frame.epoch != self._epoch:
            self._stage = TrackingStage(self._settings, first_id=self._stage.next_id)  # no id ever means two people
            self._vehicle = _VehicleTrail()
            self._epoch = frame.epoch

    def explain(self, frame: SyncedFrame) -> tuple[Candidate, ...]:
        """Returns which boxes and clusters a `step` with this frame is going to compare, and which it will match."""
        self._enter_epoch(frame)
        return self._stage.explain(frame.sensors)

    def labels(self) -> LabelReport:
        """Returns what the tracker makes of every label after the latest frame, published or not."""
        return self._stage.labels()

    def amend(self, frame: SyncedFrame) -> None:
        """Takes in a frame whose successors were tracked before it; raises LateScanError if it is too old for that."""
        if frame.epoch == self._epoch:
            self._stage.amend(frame.sensors)


class TrackFollower:
    """Another tracker's tracks, as track frames with histories: fusion and our tracker are left out."""

    def __init__(self, params: ObjectTracksParams, pedestrian_labels: Collection[str]):
        self._assembler = TrackAssembler(params, pedestrian_labels)
        self._vehicle = _VehicleTrail()
        self._epoch = 0
        self._sequence = 0

    def step(self, frame: SyncedFrame, *, published: bool = True) -> tuple[Measurements, TrackFrame]:
        """Returns no measurements, and the tracks; raises FrameRefused if those make no sense."""
        sensors = frame.sensors
        if frame.epoch != self._epoch:
            self._vehicle, self._epoch = _VehicleTrail(), frame.epoch
        vehicle = self._vehicle.add(frame)
        if isinstance(frame.objects, TrackFrame):
            tracks = replace(frame.objects, sequence=self._sequence, epoch=frame.epoch)
        else:
            assert frame.objects is not None, "a log of tracks gives frames of tracks"
            try:
                tracks = self._assembler.step(
                    frame.objects,
                    sensors.map_from_lidar,
                    vehicle,
                    sensors.frame_id,
                    pose_extrapolated=sensors.pose_extrapolated,
                    epoch=frame.epoch,
                    sequence=self._sequence,
                )
            except ValueError as error:
                raise FrameRefused(str(error)) from error
        self._sequence += published
        return empty_measurements(), tracks

    def amend(self, frame: SyncedFrame) -> None:
        """Refuses: what another tracker has published cannot be amended."""
        raise LateScanError(f"tracks of {frame.sensors.stamp_ns} ns came after newer ones")


def run_pipeline(
    frames: Iterable[SyncedFrame],
    tracker: FrameStage,
    predictor: AskedPredictor,
    *,
    window: int = 8,
    published: Callable[[SyncedFrame], bool] = lambda _: True,
    refusals: Refusals | None = None,
    clock: StageClock | None = None,
) -> Iterator[FrameResult]:
    """Yields one result per published frame, in stamp order; a scan too late even to amend the tracks is refused.

    At most `window` frames are unanswered at any time: that keeps a predictor of its own process busy and loses
    nothing. Results do not depend on the window.
    """
    clock = clock or StageClock()
    refusals = refusals or Refusals()
    asked: deque[tuple[SyncedFrame, Measurements, TrackFrame, float]] = deque()
    for frame in frames:
        if frame.late:
            amend(tracker, frame, refusals)
            continue
        try:
            with clock.measure("track"):
                measurements, tracks = tracker.step(frame, published=published(frame))
        except FrameRefused as error:
            refusals.add("tracks", frame.sensors.stamp_ns, str(error))
            continue
        for _ in range(measurements.refused):
            refusals.add("scans", frame.sensors.stamp_ns, "cluster out of reach, or of an impossible shape")
        if not published(frame):
            continue
        predictor.ask(tracks, vehicle_pose(frame.sensors, tracks))
        asked.append((frame, measurements, tracks, time.perf_counter()))
        if len(asked) >= window:
            yield _answered(*asked.popleft(), predictor.answer(), clock)
    while asked:
        yield _answered(*asked.popleft(), predictor.answer(), clock)


def amend(tracker: FrameStage, frame: SyncedFrame, refusals: Refusals) -> None:
    """Takes a late frame in; one that is too late even for that is refused."""
    try:
        tracker.amend(frame)
    except LateScanError:
        refusals.add("scans", frame.sensors.stamp_ns, "scan too late to use")


def _answered(
    frame: SyncedFrame,
    measurements: Measurements,
    tracks: TrackFrame,
    asked_s: float,
    predictions: PredictionFrame,
    clock: StageClock,
) -> FrameResult:
    clock.add("predict", time.perf_counter() - asked_s)
    return FrameResult(
        frame.log_time_ns, frame.sensors, measurements, tracks, predictions, frame.images, frame.ground_truth
    )
