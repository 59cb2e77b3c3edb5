"""The tracking stage: one sensor frame in, its measurements and the tracks at its stamp out."""

from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict

from schemas.messages import Track
from tracking.fusion import Candidate, FusionParams, explain, fuse
from tracking.label_report import LabelReport
from tracking.measurements import Measurements
from tracking.sensor_frame import SensorFrame
from tracking.tracker import Tracker, TrackerParams
from tracking.visibility import VisibilityParams, detection_probability


class TrackingSettings(BaseModel):
    """Everything that changes what the stage makes of a drive; `model_dump_json` writes it as JSON."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    fusion: FusionParams = FusionParams()
    visibility: VisibilityParams = VisibilityParams()
    tracker: TrackerParams = TrackerParams()


@dataclass(frozen=True, eq=False)
class TrackingResult:
    """What one scan gave."""

    measurements: Measurements
    tracks: tuple[Track, ...]  # confirmed pedestrians at the frame's stamp, oldest first


class TrackingStage:
    """Fusion and the tracker in a row; the tracker's prediction goes into fusion as data."""

    def __init__(self, settings: TrackingSettings | None = None, first_id: int = 1) -> None:
        self.settings = TrackingSettings() if settings is None else settings
        self._tracker = Tracker(self.settings.tracker, first_id)

    @property
    def next_id(self) -> int:
        """The number that the next published track will get: where a stage after this one goes on."""
        return self._tracker.next_id

    def step(self, frame: SensorFrame) -> TrackingResult:
        """Returns the frame's measurements and the tracks after them.

        Raises:
            LateScanError: the frame is older than the last one; `amend` may still take it in.
        """
        self._tracker.check_in_order(frame.stamp_ns)
        measurements = self._fuse(frame)
        visible = detection_probability(frame, self.settings.visibility)
        return TrackingResult(measurements, self._tracker.step(measurements, frame.stamp_ns, visible))

    def amend(self, frame: SensorFrame) -> Measurements:
        """Takes in a frame that came late, and returns its measurements; the next `step` returns tracks that know it.

        Raises:
            LateScanError: the frame is older than what the tracker remembers.
        """
        measurements = self._fuse(frame)
        self._tracker.amend(measurements, frame.stamp_ns, detection_probability(frame, self.settings.visibility))
        return measurements

    def explain(self, frame: SensorFrame) -> tuple[Candidate, ...]:
        """Returns which boxes and clusters `step` is going to compare in this frame, and which it will match."""
        return explain(frame, self._tracker.predicted(frame.stamp_ns), self.settings.fusion)

    def labels(self) -> LabelReport:
        """Returns what the tracker makes of every label after the latest frame, published or not."""
        return self._tracker.labels()

    def _fuse(self, frame: SensorFrame) -> Measurements:
        return fuse(frame, self._tracker.predicted(frame.stamp_ns), self.settings.fusion)
