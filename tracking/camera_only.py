"""People whom a camera sees and the LiDAR does not: a box that lies on no cluster, as a place on the ground."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.messages import BoolArray, FloatArray, IntArray
from tracking.box_matching import Boxes, CameraView
from tracking.clusters import ray_covariances
from tracking.fusion_params import FusionParams
from tracking.geometry import inverse
from tracking.sensor_frame import CameraFrame, SensorFrame

SAME_PLACE = 6.0  # squared Mahalanobis distance below which two cameras' feet are one person's (95 %)
CROSSING_RAD = 0.05  # rays of two cameras that meet at a smaller angle are as good as one ray
NEAREST_M = 0.5
SAME_AS_CLUSTER = 16.0  # and below which a foot may be that of a cluster
BORDER_PX = 3.0  # a box that reaches so near to the image's border is cut there: its foot is not the person's


@dataclass(frozen=True, eq=False)
class GroundPoints:
    """Places where boxes meet the ground, one per person; all arrays have K rows."""

    positions_m: FloatArray  # (K, 2)  odometry frame
    covariances_m2: FloatArray  # (K, 2, 2)  long along the rays
    boxes: tuple[tuple[int, ...], ...]  # (K,)  rows of the boxes: one, or one of each of several cameras
    crossed: BoolArray  # (K,)  whether rays of two cameras cross there


def lonely_boxes(view: CameraView) -> IntArray:
    """Returns the boxes that no cluster fits, not even one that another box got."""
    lonely = np.ones(len(view.boxes), bool)
    lonely[view.pairs.box[view.pairs.likeness > 0]] = False
    return np.flatnonzero(lonely)


def ground_points(
    frame: SensorFrame,
    cameras: Sequence[CameraFrame],
    boxes: Boxes,
    rows: IntArray,
    clusters_m: FloatArray,
    params: FusionParams,
) -> GroundPoints:
    """Returns where the feet of boxes stand on the vehicle's ground plane; boxes of several cameras that agree are one.

    The error along a ray comes from the box's lower edge and the vehicle's pitch, and grows with the distance squared
    over the camera's height.

    Args:
        frame: of the scan; its vehicle's x-y plane is the ground.
        cameras: C of them.
        boxes: of those cameras.
        rows: (R,) which boxes.
        clusters_m: (M, 2) places of clusters; a box that may be one of them, however it failed to match, is left out.
        params: settings.
    """
    corners, camera = boxes.corners_px[rows], boxes.camera[rows]
    size = np.array([(c.model.width_px, c.model.height_px) for c in cameras], float).reshape(-1, 2)[camera]
    whole = (corners[:, :2] >= BORDER_PX).all(axis=1) & (corners[:, 2:] <= size - BORDER_PX).all(axis=1)
    rows, corners, camera = rows[whole], corners[whole], camera[whole]
    eyes, directions = _rays(cameras, camera, np.column_stack([(corners[:, 0] + corners[:, 2]) / 2, corners[:, 3]]))

    up = frame.map_from_vehicle[:3, 2]
    height = (eyes - frame.map_from_vehicle[:3, 3]) @ up + params.ground_below_vehicle_m
    falls = -(directions @ up)
    reach = (directions * (height / np.maximum(falls, 1e-6))[:, None])[:, :2]
    distance = np.hypot(reach[:, 0], reach[:, 1])
    # False for NaN, too: a pixel without a ray
    good = (falls > 1e-6) & (height > 0) & (distance > NEAREST_M) & (distance < params.camera_only_range_m)
    height, distance, reach = height[good], distance[good], reach[good]
    angle = params.foot_sigma_rad + params.foot_sigma * params.height_m / distance
    along = (distance**2 / height * angle) ** 2
    across = params.camera_across_sigma_m**2 + (params.bearing_sigma_rad * distance) ** 2
    covs = ray_covariances(reach / distance[:, None], along, across)
    places = eyes[good, :2] + reach * (1 + params.foot_bias_m / distance)[:, None]
    alone = _mahalanobis(places[:, None] - clusters_m, covs[:, None]).min(axis=1, initial=np.inf) >= SAME_AS_CLUSTER
    bearings = np.arctan2(reach[:, 1], reach[:, 0])
    return _joined(rows[good][alone], camera[good][alone], places[alone], covs[alone], bearings[alone])


def _rays(cameras: Sequence[CameraFrame], camera: IntArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns where rays (K, 3) through pixels (K, 2) of cameras (K,) start and point to, odometry frame."""
    eyes, directions = np.empty((len(pixels), 3)), np.empty((len(pixels), 3))
    for c in np.unique(camera):
        mine = np.flatnonzero(camera == c)
        map_from_camera = inverse(cameras[c].camera_from_map)
        eyes[mine] = map_from_camera[:3, 3]
        directions[mine] = cameras[c].model.ray(pixels[mine]) @ map_from_camera[:3, :3].T
    return eyes, directions


def _mahalanobis(delta: FloatArray, covs: FloatArray) -> FloatArray:
    """Returns squared distances (...) of differences (..., 2) under covariances (..., 2, 2)."""
    x, y = delta[..., 0], delta[..., 1]
    a, b, d = covs[..., 0, 0], covs[..., 0, 1], covs[..., 1, 1]
    squared: FloatArray = (d * x * x - 2 * b * x * y + a * y * y) / (a * d - b * b)
    return squared


def _joined(
    rows: IntArray, camera: IntArray, places_m: FloatArray, covs: FloatArray, bearings_rad: FloatArray
) -> GroundPoints:
    """Joins feet (K,) that are one place within their errors, at most one of each camera, the nearest pairs first."""
    K = len(rows)
    distance = _mahalanobis(places_m[:, None] - places_m, covs[:, None] + covs)  # (K, K)
    close = np.argwhere(np.triu((distance < SAME_PLACE) & (camera[:, None] != camera), 1))
    groups = [[k] for k in range(K)]
    group_of = list(range(K))
    for i, j in close[np.argsort(distance[close[:, 0], close[:, 1]], kind="stable")].tolist():
        one, two = group_of[i], group_of[j]
        cameras = camera[groups[one] + groups[two]]
        if one != two and len(np.unique(cameras)) == len(cameras):
            groups[one] += groups[two]
            for k in groups[two]:
                group_of[k] = one
            groups[two] = []
    found = [sorted(group) for group in groups if group]
    places, joint = np.empty((len(found), 2)), np.empty((len(found), 2, 2))
    for n, group in enumerate(found):
        # Pitch and slope are the vehicle's, so the errors of its cameras are not independent: covariance intersection.
        information = np.linalg.inv(covs[group])
        joint[n] = np.linalg.inv(information.mean(axis=0))
        places[n] = joint[n] @ (information @ places_m[group, :, None]).mean(axis=0)[:, 0]
    crossed = [_spread(bearings_rad[group]) > CROSSING_RAD for group in found]
    boxes = tuple(tuple(rows[group].tolist()) for group in found)
    return GroundPoints(places, joint, boxes, np.array(crossed, bool))


def _spread(bearings_rad: FloatArray) -> float:
    """Returns the largest difference (rad) of bearings from the first."""
    turn = bearings_rad - bearings_rad[0]
    return float(np.abs(np.arctan2(np.sin(turn), np.cos(turn))).max())
