"""What people would look like to each camera: their boxes, and which detected box fits whom."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.messages import FloatArray, IntArray
from tracking.camera import make_rig, project_all
from tracking.geometry import inverse
from tracking.sensor_frame import CameraFrame

# The box of what lies outside the image's cone may still reach into it, by its diagonal against its side at most.
CONE_MARGIN = 1.5


@dataclass(frozen=True, eq=False)
class Outlines:
    """Boxes of people in cameras, for the pairs of the two that see each other, in order of camera, then person."""

    camera: IntArray  # (P,)
    person: IntArray  # (P,)
    corners_px: FloatArray  # (4, P)  cut at the image's border
    share_inside: FloatArray  # (P,)  of the box before the cut, above 0


def outlines(
    cameras: Sequence[CameraFrame], positions_m: FloatArray, ground_m: FloatArray, *, radius_m: float, height_m: float
) -> Outlines:
    """Returns the boxes of upright cylinders as each camera sees them.

    Half a person behind a camera, or past where its distortion stops growing, has no box.

    Args:
        cameras: C of them.
        positions_m: (C, M, 2) odometry frame, at each camera's stamp.
        ground_m: (M,) height of the people's feet.
        radius_m: of the cylinder.
        height_m: of the cylinder.
    """
    rig = make_rig(tuple(camera.model for camera in cameras))
    camera_from_map = np.array([camera.camera_from_map for camera in cameras])  # (C, 4, 4)
    eyes = inverse(camera_from_map)[:, :2, 3]  # (C, 2)
    view_rad = np.array([camera.model.view_rad for camera in cameras])
    camera, person = _in_cone(camera_from_map, view_rad, positions_m, ground_m, radius_m, height_m)

    place = positions_m[camera, person]  # (P, 2)
    toward = place - eyes[camera]
    scale = radius_m / np.maximum(np.hypot(toward[:, 0], toward[:, 1]), 1e-3)
    side = np.empty_like(toward)
    side[:, 0], side[:, 1] = -toward[:, 1] * scale, toward[:, 0] * scale
    corners = np.empty((len(camera), 3, 2, 3))  # three heights, two sides: a straight edge is curved in a fisheye image
    corners[:, :, 0, :2], corners[:, :, 1, :2] = (place - side)[:, None], (place + side)[:, None]
    corners[..., 2] = (ground_m[person, None] + height_m * np.array([0.0, 0.5, 1.0]))[:, :, None]
    R, t = camera_from_map[:, :3, :3].swapaxes(1, 2)[camera], camera_from_map[camera, None, :3, 3]
    points = np.ascontiguousarray((corners.reshape(-1, 6, 3) @ R + t).transpose(2, 1, 0))  # (3, 6, P)
    pixels, valid = project_all(rig, camera, points)

    low = np.fmin.reduce(pixels, axis=1)  # (2, P); fmin and fmax pass over the NaN of corners that are not seen
    high = np.fmax.reduce(pixels, axis=1)
    area = np.maximum((high[0] - low[0]) * (high[1] - low[1]), 1e-9)
    limits = rig.size_px[:, camera]
    low, high = np.minimum(np.maximum(low, 0.0), limits), np.minimum(np.maximum(high, 0.0), limits)
    share = (high[0] - low[0]) * (high[1] - low[1]) / area
    seen = np.flatnonzero((share > 0) & (np.add.reduce(valid, axis=0) >= 4))
    return Outlines(camera[seen], person[seen], np.concatenate([low, high])[:, seen], share[seen])


def _in_cone(
    camera_from_map: FloatArray,
    view_rad: FloatArray,
    positions_m: FloatArray,
    ground_m: FloatArray,
    radius_m: float,
    height_m: float,
) -> tuple[IntArray, IntArray]:
    """Returns cameras (P,) and people (P,) for every pair in which a ball round the person touches the camera's view.

    Most people are in the view of few cameras, and the exact test, the projection, costs much more.
    """
    centres = np.empty((*positions_m.shape[:2], 3))
    centres[..., :2], centres[..., 2] = positions_m, ground_m + height_m / 2
    x, y, z = (centres @ camera_from_map[:, :3, :3].swapaxes(1, 2) + camera_from_map[:, None, :3, 3]).transpose(2, 0, 1)
    # The signed distance to the cone of half angle view_rad; too small, if anything, for what is nearest to its tip.
    outside = np.sqrt(x * x + y * y) * np.cos(view_rad)[:, None] - z * np.sin(view_rad)[:, None]
    near = np.flatnonzero(outside <= CONE_MARGIN * np.hypot(radius_m, height_m / 2))
    camera, person = np.divmod(near, positions_m.shape[1])
    return camera, person
