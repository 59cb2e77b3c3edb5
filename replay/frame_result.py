"""What the pipeline yields, one per LiDAR scan, in stamp order; the writer, the view and the user all consume it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from schemas.messages import CompressedImage, GroundTruthFrame, PredictionFrame, TrackFrame, VehiclePose
from tracking.geometry import quaternion_of
from tracking.measurements import Measurements
from tracking.sensor_frame import SensorFrame


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Everything known about one frame: what was measured, what was tracked and what was predicted."""

    log_time_ns: int  # log time of the message that released the frame: nothing precedes its cause
    sensors: SensorFrame
    measurements: Measurements  # fused, odometry frame
    tracks: TrackFrame
    predictions: PredictionFrame
    images: Mapping[str, CompressedImage]  # camera name -> the logged image nearest the scan; if asked for
    ground_truth: GroundTruthFrame | None  # of this scan, where the log holds it

    @property
    def vehicle_pose(self) -> VehiclePose:
        """The vehicle's pose at the frame's stamp, with its planar velocity."""
        return vehicle_pose(self.sensors, self.tracks)


def vehicle_pose(sensors: SensorFrame, tracks: TrackFrame) -> VehiclePose:
    """Returns the pose the frame was tracked in; the velocity is that of the track frame's vehicle history."""
    map_from_vehicle = sensors.map_from_vehicle
    velocity_map = np.array([*tracks.vehicle_history.states[-1, 3:5], 0.0])
    return VehiclePose(
        sensors.stamp_ns,
        sensors.frame_id,
        sensors.vehicle_frame_id,
        map_from_vehicle[:3, 3],
        quaternion_of(map_from_vehicle),
        map_from_vehicle[:3, :3].T @ velocity_map,
        np.zeros(3),
    )
