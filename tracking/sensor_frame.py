"""What fusion and the tracker take: one LiDAR scan with everything measured around it, poses resolved."""

from dataclasses import dataclass

from schemas.messages import CameraDetections, FloatArray, LidarClusters
from tracking.camera import CameraModel


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """One camera's detections nearest in time to a scan, with the camera's pose at its own stamp."""

    name: str
    detections: CameraDetections
    model: CameraModel
    camera_from_map: FloatArray  # (4, 4)  at detections.stamp_ns; optical frame: x right, y down, z forward


@dataclass(frozen=True, eq=False)
class SensorFrame:
    """One LiDAR scan, released once every camera in use has passed its stamp. "map" is the odometry frame."""

    stamp_ns: int
    clusters: LidarClusters
    map_from_lidar: FloatArray  # (4, 4)  at stamp_ns
    map_from_vehicle: FloatArray  # (4, 4)  at stamp_ns
    cameras: tuple[CameraFrame, ...]  # one per camera with detections within 50 ms of the scan
    frame_id: str  # name of the odometry frame
    vehicle_frame_id: str = "base_link"
    pose_extrapolated: bool = False
