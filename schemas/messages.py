"""Frozen dataclasses over numpy: what every stage takes and returns.

Stamps are integer nanoseconds of the sensor's clock. The odometry frame has x forward/east, y left/north, z up; metres.
One letter per axis: A pedestrians, M detections or clusters, P predicted steps, K components, H history samples.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]
IntArray = NDArray[np.integer]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class CameraDetections:
    """Boxes found in one camera image, in raw (distorted) pixels."""

    stamp_ns: int
    frame_id: str
    boxes_px: FloatArray  # (M, 4)  x_min, y_min, x_max, y_max
    scores: FloatArray  # (M,)    detector's confidence in the label, 0 to 1
    labels: tuple[str, ...]  # (M,)


@dataclass(frozen=True, eq=False)
class LidarClusters:
    """Objects segmented from one LiDAR scan, in the sensor's frame."""

    stamp_ns: int
    frame_id: str
    centroids_m: FloatArray  # (M, 3)
    sizes_m: FloatArray  # (M, 3)  extent of the points along the sensor's axes
    points: IntArray  # (M,)    how many points the cluster has


@dataclass(frozen=True, eq=False)
class PointCloud:
    """One LiDAR scan as points, not yet segmented. What is not finite has been left out."""

    stamp_ns: int
    frame_id: str
    points_m: FloatArray  # (N, 3)


@dataclass(frozen=True, eq=False)
class ObjectTracks:
    """Objects that another tracker follows, at one stamp; in any frame, people and others."""

    stamp_ns: int
    frame_id: str
    ids: tuple[str, ...]  # (A,)  as the other tracker names them
    labels: tuple[str, ...]  # (A,)  class names, in lower case where the format has numbers only
    positions_m: FloatArray  # (A, 3)
    velocities_mps: FloatArray  # (A, 3)  along the axes of `frame_id`; NaN: not given
    covariances: FloatArray  # (A, 4, 4)  of x, y, vx, vy along those axes; NaN: not given
    existence: FloatArray  # (A,)  probability, 0 to 1


@dataclass(frozen=True, eq=False)
class VehiclePose:
    """Pose of the vehicle in the odometry frame; twist in the vehicle's own frame."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    position_m: FloatArray  # (3,)
    quaternion_xyzw: FloatArray  # (4,)  map_from_vehicle
    velocity_mps: FloatArray  # (3,)
    angular_velocity_radps: FloatArray  # (3,)


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """Intrinsics of one camera, as logged; `tracking.camera.CameraModel` does the maths."""

    stamp_ns: int
    frame_id: str
    width_px: int
    height_px: int
    model: str  # plumb_bob, rational_polynomial, equidistant
    distortion: FloatArray  # (D,)    as many as the model has
    intrinsics_px: FloatArray  # (3, 3)  K


@dataclass(frozen=True, eq=False)
class Transform:
    """A rigid transform between two frames: x_parent = R(quaternion) x_child + translation."""

    stamp_ns: int
    parent_frame_id: str
    child_frame_id: str
    translation_m: FloatArray  # (3,)
    quaternion_xyzw: FloatArray  # (4,)


@dataclass(frozen=True)
class CompressedImage:
    """An encoded camera image, passed through to the view untouched."""

    stamp_ns: int
    frame_id: str
    data: bytes
    format: str  # jpeg, png, webp


@dataclass(frozen=True, eq=False)
class VehicleHistory:
    """The vehicle's recent states in the odometry frame, oldest first; may be empty."""

    stamps_ns: IntArray  # (H,)
    states: FloatArray  # (H, 5)  x, y, yaw, vx, vy

    @staticmethod
    def empty() -> "VehicleHistory":
        """Returns a history of no states."""
        return VehicleHistory(np.zeros(0, np.int64), np.zeros((0, 5)))


@dataclass(frozen=True, eq=False)
class VehiclePath:
    """Where the vehicle is going to drive: planned, supposed, or its present motion carried on. Odometry frame."""

    times_s: FloatArray  # (S,)  after the frame's stamp, rising, from 0 on
    poses: FloatArray  # (S, 3)  x, y, yaw of the vehicle's frame
    front_m: float  # how far the vehicle reaches ahead of its frame's origin,
    rear_m: float  # ... behind it,
    width_m: float  # ... and from side to side


@dataclass(frozen=True, eq=False)
class TrackHistory:
    """A track's recent posterior states in the odometry frame, oldest first; the last is the present one."""

    stamps_ns: IntArray  # (H,)
    states: FloatArray  # (H, 4)  x, y, vx, vy
    coasting: BoolArray  # (H,)    True where no measurement was behind the state


@dataclass(frozen=True, eq=False)
class Track:
    """One confirmed pedestrian at the frame's stamp."""

    id: int
    state: FloatArray  # (4,)    x, y, vx, vy
    covariance: FloatArray  # (4, 4)
    existence: float
    age_ns: int
    coasting: bool
    history: TrackHistory


@dataclass(frozen=True, eq=False)
class TrackFrame:
    """The tracker's answer to one LiDAR scan; carries all the history a predictor needs."""

    sequence: int
    stamp_ns: int
    frame_id: str
    vehicle_history: VehicleHistory = field(default_factory=VehicleHistory.empty)
    tracks: tuple[Track, ...] = ()
    pose_extrapolated: bool = False
    epoch: int = 0
    vehicle_path: VehiclePath | None = None  # where the vehicle is going to drive, if that is known


@dataclass(frozen=True, eq=False)
class ModalPath:
    """One likely path of a pedestrian, with its probability."""

    probability: float
    points_m: FloatArray  # (P, 2)


@dataclass(frozen=True, eq=False)
class Mixture:
    """A bivariate Gaussian mixture per predicted step, float32."""

    weights: FloatArray  # (P, K)  sum to 1 over K
    means_m: FloatArray  # (P, K, 2)
    sigmas_m: FloatArray  # (P, K, 2)
    rhos: FloatArray  # (P, K)


@dataclass(frozen=True, eq=False)
class Prediction:
    """What one pedestrian will probably do; `paths` sorted by falling probability, which sums to 1."""

    track_id: int
    fallback: bool
    paths: tuple[ModalPath, ...]
    mixture: Mixture
    corridor_probability: float = 0.0  # of entering the vehicle's corridor within the horizon
    corridor_time_s: float | None = None  # expected time to that, if it happens; None where it cannot


@dataclass(frozen=True, eq=False)
class PredictionFrame:
    """The predictor's answer to the TrackFrame of the same sequence."""

    sequence: int
    stamp_ns: int
    frame_id: str
    model: str
    dt_s: float
    predictions: tuple[Prediction, ...] = ()
    vehicle_path: VehiclePath | None = None  # what the corridor is made of; None without a vehicle


@dataclass(frozen=True)
class NodeHealth:
    """How a live node is doing; rate and latencies over the last second, counts since its start."""

    stamp_ns: int  # the node's clock
    node: str  # track, predict
    model: str
    uptime_s: float
    rate_hz: float
    latency_p50_ms: float  # from a frame's arrival to its result; 0 without frames
    latency_p99_ms: float
    frames: int
    dropped: int  # overtaken by newer ones before their turn
    late: int  # published after their deadline
    refused: int
    problem: str = ""
    input_hz: float = 0.0  # messages that came in


@dataclass(frozen=True, eq=False)
class GroundTruthFrame:
    """Where people really were at a LiDAR scan's stamp; only simulated drives have it."""

    stamp_ns: int
    frame_id: str
    ids: IntArray  # (A,)
    positions_m: FloatArray  # (A, 2)
    velocities_mps: FloatArray  # (A, 2)
    lidar_points: IntArray  # (A,)  points of this scan on the pedestrian; 0 if hidden or out of range
