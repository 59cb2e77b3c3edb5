"""What of a frame is drawn, and where: geometry that view, picture and scene share. Odometry frame, metres."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pcgan import vehicle_path
from schemas.messages import FloatArray, IntArray, Prediction, PredictionFrame, TrackFrame
from tracking.sensor_frame import CameraFrame

PERSON_RADIUS_M = 0.3
PERSON_HEIGHT_M = 1.75
VEHICLE_LENGTH_M, VEHICLE_WIDTH_M, VEHICLE_HEIGHT_M = vehicle_path.LENGTH_M, vehicle_path.WIDTH_M, 1.9
VEHICLE_CENTRE_M = vehicle_path.CENTRE_M  # from base_link forward
_RING = np.linspace(0, 2 * np.pi, 8, endpoint=False)
_CYLINDER = np.array(
    [(PERSON_RADIUS_M * np.cos(a), PERSON_RADIUS_M * np.sin(a), z) for z in (0.0, PERSON_HEIGHT_M) for a in _RING]
)  # (16, 3)


@dataclass(frozen=True, eq=False)
class PathSet:
    """N polylines one behind another, each with the pedestrian it belongs to."""

    points_m: FloatArray  # (S, 2)  S is the sum of the lengths; a path starts where its track is now
    lengths: IntArray  # (N,)    points of each path
    track_ids: IntArray  # (N,)
    probabilities: FloatArray  # (N,)

    def strips_m(self) -> list[FloatArray]:
        """Returns the polylines one by one, N times (P + 1, 2)."""
        return np.split(self.points_m, np.cumsum(self.lengths)[:-1]) if len(self.lengths) else []


@dataclass(frozen=True, eq=False)
class EllipseSet:
    """E one-sigma ellipses of mixture components, each with the pedestrian it belongs to."""

    centres_m: FloatArray  # (E, 2)
    half_axes_m: FloatArray  # (E, 2)  larger one first
    yaws_rad: FloatArray  # (E,)    direction of the larger one
    weights: FloatArray  # (E,)
    track_ids: IntArray  # (E,)


def modal_paths(tracks: TrackFrame, predictions: Sequence[Prediction]) -> PathSet:
    """Returns every modal path of `predictions`, unlikely ones first so that likely ones are drawn on top of them."""
    places = {track.id: track.state[None, :2] for track in tracks.tracks}
    nowhere = np.zeros((0, 2))
    rows = sorted(
        ((path.probability, p.track_id, path.points_m) for p in predictions for path in p.paths),
        key=lambda row: row[:2],
    )
    if not rows:
        return PathSet(nowhere, np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    pieces = [piece for _, number, points in rows for piece in (places.get(number, nowhere), points)]
    return PathSet(
        np.concatenate(pieces),
        np.array([len(points) + (number in places) for _, number, points in rows], np.int64),
        np.array([number for _, number, _ in rows], np.int64),
        np.array([probability for probability, _, _ in rows], float),
    )


def mixture_ellipses(predictions: Sequence[Prediction], steps: Sequence[int], least_weight: float) -> EllipseSet:
    """Returns the components of at least `least_weight` at some predicted steps, counted from 0; -1 is the last."""
    if not predictions:
        return EllipseSet(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, np.int64))
    mixtures = [prediction.mixture for prediction in predictions]
    kept = [[step for step in steps if -len(m.weights) <= step < len(m.weights)] for m in mixtures]
    pairs = list(zip(mixtures, kept, strict=True))
    weights = np.concatenate([m.weights[s].ravel() for m, s in pairs]).astype(float)
    centres = np.concatenate([m.means_m[s].reshape(-1, 2) for m, s in pairs]).astype(float)
    sigma_x, sigma_y = np.concatenate([m.sigmas_m[s].reshape(-1, 2) for m, s in pairs]).astype(float).T
    rhos = np.concatenate([m.rhos[s].ravel() for m, s in pairs]).astype(float)
    counts = [m.weights[s].size for m, s in pairs]
    ids = np.repeat(np.array([prediction.track_id for prediction in predictions], np.int64), counts)

    # eigenvalues of a 2 x 2 covariance: half its trace, plus and minus
    half_trace = (sigma_x**2 + sigma_y**2) / 2
    half_difference, covariance = (sigma_x**2 - sigma_y**2) / 2, rhos * sigma_x * sigma_y
    root = np.hypot(half_difference, covariance)
    half_axes = np.sqrt(np.maximum(np.column_stack([half_trace + root, half_trace - root]), 0))
    yaws = np.arctan2(covariance, half_difference) / 2

    chosen = weights >= least_weight
    return EllipseSet(centres[chosen], half_axes[chosen], yaws[chosen], weights[chosen], ids[chosen])


def drawn_steps(frame: PredictionFrame) -> tuple[int, ...]:
    """Returns the predicted steps whose mixtures are drawn: half way and the last, so that a crowd stays readable."""
    steps = max((len(prediction.mixture.weights) for prediction in frame.predictions), default=0)
    return (steps // 2 - 1, steps - 1) if steps >= 4 else (steps - 1,) if steps else ()


def dashes(strip_m: FloatArray, dash_m: float = 0.35, gap_m: float = 0.3) -> FloatArray:
    """Cuts a polyline (P, 2) into straight dashes (N, 2, 2): start and end of each. No length, no dashes."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(strip_m, axis=0).T))])
    starts = np.arange(0, along[-1], dash_m + gap_m)
    ends = np.minimum(starts + dash_m, along[-1])
    columns = [np.interp(np.column_stack([starts, ends]), along, strip_m[:, axis]) for axis in range(2)]
    return np.stack(columns, axis=-1)


def split_by_fallback(predictions: Sequence[Prediction]) -> tuple[list[Prediction], list[Prediction]]:
    """Returns the model's own predictions, and those that extrapolate because the track is too young or coasting."""
    return [p for p in predictions if not p.fallback], [p for p in predictions if p.fallback]


def vehicle_outline(map_from_vehicle: FloatArray) -> FloatArray:
    """Returns the vehicle's closed outline (6, 2) from above: a rectangle with a pointed bow."""
    front, back = VEHICLE_CENTRE_M + VEHICLE_LENGTH_M / 2, VEHICLE_CENTRE_M - VEHICLE_LENGTH_M / 2
    side, bow = VEHICLE_WIDTH_M / 2, 0.45
    corners = np.array(
        [(back, side), (front - bow, side), (front, 0), (front - bow, -side), (back, -side), (back, side)]
    )
    return np.asarray(corners @ map_from_vehicle[:2, :2].T + map_from_vehicle[:2, 3])


def people_in_image(
    camera: CameraFrame, states: FloatArray, stamp_ns: int, ground_m: float
) -> tuple[FloatArray, IntArray]:
    """Projects people as cylinders into one camera, at the camera's own stamp.

    Args:
        camera: the camera; its pose is of `camera.detections.stamp_ns`.
        states: (A, 4) [x, y, vx, vy] at `stamp_ns`; each is moved on to the camera's stamp.
        stamp_ns: stamp of the states.
        ground_m: height of the ground in the odometry frame.

    Returns:
        boxes (B, 4) as x_min, y_min, x_max, y_max in raw pixels, cut at the image's border, and the index (B,) of each
        box's person. People behind the camera, past its distortion model or outside its image have none.
    """
    dt_s = (camera.detections.stamp_ns - stamp_ns) * 1e-9
    feet = np.column_stack([states[:, :2] + dt_s * states[:, 2:], np.full(len(states), ground_m)])
    rotation, translation = camera.camera_from_map[:3, :3], camera.camera_from_map[:3, 3]
    index = np.flatnonzero(feet @ rotation[2] + translation[2] > 0)  # roughly those in front; `valid` is exact
    A = len(index)
    if A == 0:
        return np.zeros((0, 4)), index
    points_map = (feet[index, None] + _CYLINDER).reshape(-1, 3)  # (A * 16, 3)
    pixels, valid = camera.model.project(points_map @ rotation.T + translation)
    whole = valid.reshape(A, -1).all(axis=1)  # a body cut by the edge of the model would give a box of no meaning
    pixels = pixels.reshape(A, -1, 2)
    low, high = pixels.min(axis=1), pixels.max(axis=1)

    size = np.array([camera.model.width_px, camera.model.height_px], float)
    inside = whole & (high > 0).all(axis=1) & (low < size).all(axis=1)
    boxes = np.clip(np.concatenate([low, high], axis=1)[inside], 0, np.tile(size, 2))
    return boxes, index[inside]
