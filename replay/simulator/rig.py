"""Where the simulated sensors sit on the vehicle, and the cameras' intrinsics.

Published by USyd (shared FACTS): frame names, intrinsics of A0 and A2, base_link to velodyne_front_link. Chosen here:
the cameras' places on the roof and directions, about 55 degrees apart in front so that 99.5 degree views overlap by
half and all around is covered, each 5 degrees nose down; A1's intrinsics are A2's, the rest A0's.
base_link is on the ground, so that the velodyne is 1.37 m high and the cameras about 1.7 m.
"""

import math
from dataclasses import dataclass

import numpy as np

from schemas.messages import CameraCalibration, FloatArray, Transform
from schemas.topics import CAMERAS
from tracking.camera import CameraModel
from tracking.geometry import quaternion_of, transform_matrix

ODOMETRY_FRAME = "odom"
VEHICLE_FRAME = "base_link"
LIDAR_FRAME = "velodyne_front_link"

_WIDTH_PX, _HEIGHT_PX = 1920, 1208
_CAMERA_PITCH_RAD = math.radians(5.0)  # nose down

# fx, fy, cx, cy and the four coefficients of the equidistant model
_A0 = ((1176.93, 1177.72, 962.275, 612.725), (-0.0540096, -0.0784275, 0.0959641, -0.0515253))
_A2 = ((1178.654, 1182.076, 960.770, 603.960), (-0.094054, 0.086107, -0.170816, 0.098190))
# frame, place in base_link (m), direction (degrees, left positive), intrinsics
_MOUNTINGS = {
    "A0": ("gmsl_centre_link", (1.10, 0.00, 1.72), 0.0, _A0),
    "A1": ("gmsl_left_link", (1.05, 0.45, 1.72), 55.0, _A2),
    "A2": ("gmsl_right_link", (1.05, -0.45, 1.72), -55.0, _A2),
    "A3": ("gmsl_back_link", (-0.70, 0.00, 1.72), 180.0, _A0),
    "B0": ("gmsl_left_side_link", (0.20, 0.60, 1.70), 110.0, _A0),
    "B1": ("gmsl_right_side_link", (0.20, -0.60, 1.70), -110.0, _A0),
}
# A camera looking along the vehicle's x axis: its x is the vehicle's -y, its y is -z, its z is x.
_BODY_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class MountedCamera:
    """One camera of the rig."""

    name: str
    frame_id: str
    calibration: CameraCalibration  # stamp 0: the writer sets it
    model: CameraModel
    vehicle_from_camera: FloatArray  # (4, 4)  camera in its optical frame


@dataclass(frozen=True, eq=False)
class Rig:
    """All sensors of the vehicle."""

    cameras: tuple[MountedCamera, ...]
    vehicle_from_lidar: FloatArray  # (4, 4)

    def static_transforms(self, stamp_ns: int) -> tuple[Transform, ...]:
        """Returns base_link to every sensor's frame, for /tf_static."""
        mounted = [(camera.frame_id, camera.vehicle_from_camera) for camera in self.cameras]
        return tuple(
            Transform(stamp_ns, VEHICLE_FRAME, frame_id, T[:3, 3], quaternion_of(T))
            for frame_id, T in [(LIDAR_FRAME, self.vehicle_from_lidar), *mounted]
        )


def campus_rig() -> Rig:
    """Returns the rig of the USyd-style campus vehicle described at the top of this module."""
    vehicle_from_lidar = transform_matrix((1.2, 0.0, 1.37), (0.0, 0.06096, 0.0, 0.99814))
    return Rig(tuple(_mounted_camera(name) for name in CAMERAS), vehicle_from_lidar)


def planar_pose(position_m: FloatArray, yaw_rad: float) -> FloatArray:
    """Returns map_from_vehicle (4, 4) of a vehicle upright on the ground at position (2,)."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    T = np.eye(4)
    T[:2, :2] = (c, -s), (s, c)
    T[:2, 3] = position_m
    return T


def _mounted_camera(name: str) -> MountedCamera:
    frame_id, place, direction_deg, ((fx, fy, cx, cy), distortion) = _MOUNTINGS[name]
    yaw = math.radians(direction_deg)
    cp, sp = math.cos(_CAMERA_PITCH_RAD), math.sin(_CAMERA_PITCH_RAD)
    nose_down = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    vehicle_from_camera = planar_pose(np.array(place[:2]), yaw)
    vehicle_from_camera[:3, :3] = vehicle_from_camera[:3, :3] @ nose_down @ _BODY_FROM_OPTICAL
    vehicle_from_camera[2, 3] = place[2]
    intrinsics = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    calibration = CameraCalibration(0, frame_id, _WIDTH_PX, _HEIGHT_PX, "equidistant", np.array(distortion), intrinsics)
    return MountedCamera(name, frame_id, calibration, CameraModel.from_calibration(calibration), vehicle_from_camera)
