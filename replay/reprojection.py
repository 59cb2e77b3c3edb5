"""Where each camera should see the people of a scan: to compare with where it does."""

import numpy as np

from schemas.messages import FloatArray
from tracking.fusion import FusionParams
from tracking.geometry import ground_heights
from tracking.outlines import Outlines, outlines
from tracking.sensor_frame import SensorFrame


def reproject(
    sensors: SensorFrame, positions_m: FloatArray, velocities_mps: FloatArray, params: FusionParams
) -> Outlines:
    """Returns the boxes of people on the vehicle's ground plane, each at the camera's own stamp.

    Args:
        sensors: the scan; `Outlines.camera` counts its cameras.
        positions_m: (M, 2) odometry frame, at the scan's stamp; `Outlines.person` counts them.
        velocities_mps: (M, 2)
        params: of the person, and of the ground below the vehicle.
    """
    if not sensors.cameras or len(positions_m) == 0:
        none = np.zeros(0, np.int64)
        return Outlines(none, none, np.zeros((4, 0)), np.zeros(0))
    delays_s = np.array([camera.detections.stamp_ns - sensors.stamp_ns for camera in sensors.cameras]) * 1e-9
    moved = positions_m + velocities_mps * delays_s[:, None, None]  # (C, M, 2)
    ground = ground_heights(sensors.map_from_vehicle, positions_m, params.ground_below_vehicle_m)  # (M,)
    return outlines(sensors.cameras, moved, ground, radius_m=params.radius_m, height_m=params.height_m)
