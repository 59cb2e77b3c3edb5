"""Sensor frames -> tracks -> predictions: the pipeline, free of files, sockets and clocks."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from replay.errors import Refusals
from replay.frame_result import FrameResult, vehicle_pose
from replay.remote_predictor import AskedPredictor
from replay.stage_clock import StageClock
from replay.time_sync import SyncedFrame
from schemas.messages import PredictionFrame, TrackFrame, VehicleHistory
from tracking.fusion import Candidate
from tracking.label_report import LabelReport
from tracking.measurements import Measurements
from tracking.pipeline import TrackingSettings, TrackingStage
from tracking.tracker import LateScanError

HISTORY_NS = 3_600_000_000


class FrameTracker:
    """Turns synchronised frames into track frames; starts afresh with each epoch of the clock."""

    def __init__(self, settings: TrackingSettings):
        self._settings = settings
        self._stage = TrackingStage(settings)
        self._vehicle: deque[tuple[int, np.ndarray]] = deque()
        self._epoch = 0
        self._sequence = 0

    def step(self, frame: SyncedFrame, *, published: bool = True) -> tuple[Measurements, TrackFrame]:
        """Tracks one frame; unpublished ones, which warm the tracker up, have no sequence of their own."""
        sensors = frame.sensors
        self._enter_epoch(frame)
        self._vehicle.append((sensors.stamp_ns, frame.vehicle_state))
        while self._vehicle[0][0] < sensors.stamp_ns - HISTORY_NS:
            self._vehicle.popleft()
        result = self._stage.step(sensors)
        stamps_ns, states = zip(*self._vehicle, strict=True)
        tracks = TrackFrame(
            self._sequence,
            sensors.stamp_ns,
            sensors.frame_id,
            VehicleHistory(np.array(stamps_ns, np.int64), np.array(states)),
            result.tracks,
            sensors.pose_extrapolated,
            frame.epoch,
        )
        self._sequence += published
        return result.measurements, tracks

    def _enter_epoch(self, frame: SyncedFrame) -> None:
        if frame.epoch != self._epoch:
            self._stage = TrackingStage(self._settings, first_id=self._stage.next_id)  # no id ever means two people
            self._vehicle.clear()
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


def run_pipeline(
    frames: Iterable[SyncedFrame],
    tracker: FrameTracker,
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
        with clock.measure("track"):
            measurements, tracks = tracker.step(frame, published=published(frame))
        for _ in range(measurements.refused):
            refusals.add("lidar clusters", frame.sensors.stamp_ns, "cluster out of reach, or of an impossible shape")
        if not published(frame):
            continue
        predictor.ask(tracks, vehicle_pose(frame.sensors, tracks))
        asked.append((frame, measurements, tracks, time.perf_counter()))
        if len(asked) >= window:
            yield _answered(*asked.popleft(), predictor.answer(), clock)
    while asked:
        yield _answered(*asked.popleft(), predictor.answer(), clock)


def amend(tracker: FrameTracker, frame: SyncedFrame, refusals: Refusals) -> None:
    """Takes a late frame in; one that is too late even for that is refused."""
    try:
        tracker.amend(frame)
    except LateScanError:
        refusals.add("lidar clusters", frame.sensors.stamp_ns, "scan too late to use")


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
