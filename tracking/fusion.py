"""Late fusion: LiDAR clusters and camera boxes -> position measurements with a covariance and a class probability.

One measurement per cluster: a person whom two cameras see is still one measurement.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.optimize import linear_sum_assignment

from schemas.messages import BoolArray, FloatArray, IntArray
from tracking.camera import project_all
from tracking.geometry import apply, inverse
from tracking.measurements import CameraEvidence, Measurements, PredictedTracks, empty_measurements, make_measurements
from tracking.sensor_frame import CameraFrame, SensorFrame
from tracking.visibility import hidden_share

__all__ = ["CameraEvidence", "FusionParams", "Measurements", "PredictedTracks", "fuse"]


class FusionParams(BaseModel):
    """Settings of fusion: the person that is projected, the gates of a match, what a match says, and the noise."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    pedestrian_labels: tuple[str, ...] = ("person", "pedestrian", "Person", "Pedestrian", "PEDESTRIAN")
    radius_m: float = Field(default=0.3, gt=0, description="of the cylinder that stands for a person")
    height_m: float = Field(default=1.75, gt=0)
    ground_below_vehicle_m: float = Field(default=0.0, description="from the vehicle frame's origin down to the ground")
    follow_track_m: float = Field(default=1.0, ge=0, description="a cluster this near a track moves with its velocity")

    min_overlap: float = Field(default=0.3, ge=0, le=1, description="horizontal, intersection over union")
    grown_box: float = Field(default=1.1, ge=1, description="or the centroid lies inside the box grown by this factor")
    max_height_log_ratio: float = Field(default=0.35, gt=0, description="of the box's height to the cylinder's")
    min_in_image: float = Field(default=0.6, ge=0, le=1, description="less of a person than this proves nothing")
    min_height_px: float = Field(default=25.0, ge=0, description="a missing box for anyone smaller proves nothing")

    p_box: float = Field(default=0.7, gt=0, lt=1, description="a camera gives a person in plain view a box")
    p_box_other: float = Field(default=0.05, gt=0, lt=1, description="and anything else")
    max_box_log_odds: float = Field(default=3.0, gt=0)
    min_box_log_odds: float = Field(default=0.5, ge=0)
    max_log_odds: float = Field(default=4.0, gt=0, description="of the sum over cameras")

    base_log_odds: float = Field(default=0.3, description="of a cluster of a person's size being one")
    max_width_m: float = Field(default=1.1, gt=0, description="wider clusters than this are less and less likely")
    max_height_m: float = Field(default=2.1, gt=0, description="so are taller ones")
    pole_width_m: float = Field(default=0.2, ge=0, description="a well-seen cluster thinner than this may be a pole")

    centroid_bias_m: float = Field(default=0.12, description="how far a centroid lies on the near side of a person")
    range_sigma_m: float = Field(default=0.08, gt=0)
    cross_sigma_m: float = Field(default=0.08, gt=0)
    single_point_sigma_m: float = Field(default=0.2, ge=0, description="more for one point; falls with their root")
    bearing_sigma_rad: float = Field(default=0.003, ge=0, description="bearing noise and the pose's yaw")
    extrapolated_pose_sigma_m: float = Field(default=0.05, ge=0)


@dataclass(frozen=True, eq=False)
class _Clusters:
    """The scan's sound clusters, sorted, in the odometry frame."""

    index: IntArray  # (M,)  row in the scan
    centroids_m: FloatArray  # (M, 3)
    offsets_m: FloatArray  # (M, 2)  from the LiDAR to the centroid, seen from above
    sizes_m: FloatArray  # (M, 3)
    width_m: FloatArray  # (M,)  diagonal, seen from above
    points: IntArray  # (M,)
    person_like: FloatArray  # (M,)  log-odds by size alone

    def __len__(self) -> int:
        return len(self.index)


def fuse(frame: SensorFrame, predicted: PredictedTracks, params: FusionParams) -> Measurements:
    """Returns one measurement per LiDAR cluster, with what the cameras say of it.

    Args:
        frame: one scan with the cameras' detections around it, poses resolved.
        predicted: where the tracker expects people at the scan's stamp; clusters near them move with their velocity
            to each camera's own stamp.
        params: settings.

    Returns:
        Measurements in the odometry frame; the order of clusters, cameras and boxes does not matter. Clusters that are
        not finite are left out and counted as `refused`.
    """
    sound = _sound_clusters(frame)
    clusters = _place(frame, np.flatnonzero(sound), params)
    refused = np.flatnonzero(~sound)
    if len(clusters) == 0:
        return _refuse(empty_measurements(), refused)

    positions, covs = _positions(frame, clusters, params)
    log_odds, evidence = _ask_cameras(frame, clusters, positions, _velocities(positions, predicted, params), params)
    total = np.clip(log_odds, -params.max_log_odds, params.max_log_odds) + clusters.person_like
    measurements = make_measurements(positions, covs, 1 / (1 + np.exp(-total)), clusters.index, evidence)
    return _refuse(measurements, refused)


def _refuse(measurements: Measurements, index: IntArray) -> Measurements:
    if len(index) == 0:
        return measurements
    m = measurements
    refused = np.sort(np.concatenate([m.refused_cluster_index, index]))
    return Measurements(
        m.positions_m, m.covariances_m2, m.pedestrian_probability, m.cluster_index, m.evidence, len(refused), refused
    )


def _sound_clusters(frame: SensorFrame) -> BoolArray:
    c = frame.clusters
    numbers = np.concatenate([c.centroids_m, c.sizes_m], axis=1)
    sound: BoolArray = (np.isfinite(numbers) & (np.abs(numbers) < 1e4)).all(axis=1)
    sound &= (c.sizes_m >= 0).all(axis=1)
    return sound


def _place(frame: SensorFrame, rows: IntArray, params: FusionParams) -> _Clusters:
    c = frame.clusters
    centroids, sizes, points = c.centroids_m[rows], c.sizes_m[rows], c.points[rows]
    order = np.lexsort((points, sizes[:, 2], sizes[:, 1], sizes[:, 0], *centroids.T[::-1]))
    rows, sizes, points = rows[order], sizes[order].astype(float), points[order]
    centroids = apply(frame.map_from_lidar, centroids[order])
    offsets = centroids[:, :2] - frame.map_from_lidar[:2, 3]
    width = np.hypot(sizes[:, 0], sizes[:, 1])
    return _Clusters(rows, centroids, offsets, sizes, width, points, _size_log_odds(width, sizes[:, 2], points, params))


def _size_log_odds(width: FloatArray, height: FloatArray, points: IntArray, params: FusionParams) -> FloatArray:
    """A person is up to a metre wide and two tall; walls, cars and trees are not, and poles are thinner."""
    too_wide = np.clip((width - params.max_width_m) / 0.5, 0.0, 1.0)
    too_tall = np.clip((height - params.max_height_m) / 0.5, 0.0, 1.0)
    thin = (width < params.pole_width_m) & (points >= 10)
    log_odds: FloatArray = params.base_log_odds - 4.0 * too_wide - 3.0 * too_tall - 0.8 * thin
    return log_odds


def _positions(frame: SensorFrame, clusters: _Clusters, params: FusionParams) -> tuple[FloatArray, FloatArray]:
    """Returns where people stand (M, 2), the near side's bias taken off, and the covariances (M, 2, 2)."""
    ranges = np.maximum(np.hypot(clusters.offsets_m[:, 0], clusters.offsets_m[:, 1]), 1e-3)
    sight = clusters.offsets_m / ranges[:, None]  # (M, 2)
    bias = np.where(clusters.width_m < params.max_width_m, params.centroid_bias_m, 0.0)
    positions = clusters.centroids_m[:, :2] + bias[:, None] * sight

    few = params.single_point_sigma_m**2 / np.maximum(clusters.points, 1)
    big = (np.maximum(clusters.width_m - params.max_width_m, 0.0) / 4) ** 2
    common = few + big + (params.extrapolated_pose_sigma_m**2 if frame.pose_extrapolated else 0.0)
    along = params.range_sigma_m**2 + common
    across = params.cross_sigma_m**2 + (params.bearing_sigma_rad * ranges) ** 2 + common
    x, y = sight[:, 0], sight[:, 1]
    covs = np.empty((len(clusters), 2, 2))
    covs[:, 0, 0] = along * x * x + across * y * y
    covs[:, 1, 1] = along * y * y + across * x * x
    covs[:, 0, 1] = covs[:, 1, 0] = (along - across) * x * y
    return positions, covs


def _velocities(positions: FloatArray, predicted: PredictedTracks, params: FusionParams) -> FloatArray:
    """Returns each cluster's velocity (M, 2): its nearest predicted track's, or none."""
    if len(predicted.positions_m) == 0:
        return np.zeros_like(positions)
    x = positions[:, 0, None] - predicted.positions_m[:, 0]
    y = positions[:, 1, None] - predicted.positions_m[:, 1]
    squared = x * x + y * y  # (M, A)
    nearest = squared.argmin(axis=1)
    follows = squared[np.arange(len(positions)), nearest] < params.follow_track_m**2
    return np.where(follows[:, None], predicted.velocities_mps[nearest], 0.0)


def _ask_cameras(
    frame: SensorFrame, clusters: _Clusters, positions: FloatArray, velocities: FloatArray, params: FusionParams
) -> tuple[FloatArray, list[tuple[CameraEvidence, ...]]]:
    """Returns class log-odds summed over cameras (M,) and the boxes behind them."""
    M = len(clusters)
    evidence: list[tuple[CameraEvidence, ...]] = [()] * M
    if not frame.cameras:
        return np.zeros(M), evidence
    cameras = sorted(frame.cameras, key=lambda camera: camera.name)
    # The cameras stand close to the LiDAR, so what hides a cluster from it by half hides it from them by half.
    radii = 0.5 * np.maximum(clusters.sizes_m[:, 0], clusters.sizes_m[:, 1])
    covered = hidden_share(clusters.offsets_m, params.radius_m, clusters.offsets_m, radii, nearer_by_m=0.5)
    visible = 1 - covered.max(axis=0)
    rank = (0.2 + 0.8 * visible) / (1 + np.exp(-clusters.person_like - 1))

    delays_s = np.array([camera.detections.stamp_ns - frame.stamp_ns for camera in cameras]) * 1e-9
    moved = positions + velocities * delays_s[:, None, None]  # (C, M, 2)
    outlines, in_image = _outlines(cameras, moved, _ground(frame, clusters, params), params)
    boxes = _pedestrian_boxes(cameras, params)
    # Boxes come in order of camera, so that each camera's rows are one slice.
    likeness = _likeness(outlines[boxes.camera], in_image[boxes.camera] > 0, boxes.corners_px, params) * rank

    starts = np.searchsorted(boxes.camera, np.arange(len(cameras) + 1)).tolist()
    assigned = [_assign(likeness[start:end]) for start, end in pairwise(starts)]
    box = np.concatenate([rows + start for (rows, _), start in zip(assigned, starts, strict=False)])  # (P,)
    cluster = np.concatenate([columns for _, columns in assigned])  # (P,)
    scores, camera = boxes.scores[box], boxes.camera[box]
    for_it = np.minimum(np.maximum(_log_odds(scores), params.min_box_log_odds), params.max_box_log_odds)
    log_odds = np.bincount(cluster, for_it, M)
    matched = np.zeros((len(cameras), M), bool)
    matched[camera, cluster] = True
    names = [camera.name for camera in cameras]
    found = zip(cluster.tolist(), camera.tolist(), boxes.rows[box].tolist(), scores.tolist(), strict=True)
    for m, c, row, score in found:
        evidence[m] = (*evidence[m], CameraEvidence(names[c], row, score))
    # No box where a person should have one speaks against a person, as far as there was a view of it.
    tall = outlines[..., 3] - outlines[..., 1] >= params.min_height_px
    proves = ~matched & tall & (in_image >= params.min_in_image)
    expected = params.p_box * visible
    no_box = np.log((1 - expected) / (1 - np.minimum(params.p_box_other, expected)))
    return log_odds + no_box * proves.sum(axis=0), evidence


def _log_odds(scores: FloatArray) -> FloatArray:
    p = np.minimum(np.maximum(scores, 0.01), 0.99)
    odds: FloatArray = np.log(p / (1 - p))
    return odds


def _ground(frame: SensorFrame, clusters: _Clusters, params: FusionParams) -> FloatArray:
    """Returns the ground's height (M,) under each cluster: the vehicle's plane, unless the cluster contradicts it."""
    up = frame.map_from_vehicle[:3, 2]
    origin = frame.map_from_vehicle[:3, 3] - params.ground_below_vehicle_m * up
    z = clusters.centroids_m[:, 2]
    if up[2] < 0.5:  # lying on its side: there is no plane to speak of
        return z - params.height_m / 2
    tilt = ((clusters.centroids_m[:, :2] - origin[:2]) @ up[:2]) / up[2]
    plane = origin[2] - tilt
    ground: FloatArray = np.clip(plane, z - 0.9 * params.height_m, z - 0.1 * params.height_m)
    return ground


def _outlines(
    cameras: Sequence[CameraFrame], positions: FloatArray, ground: FloatArray, params: FusionParams
) -> tuple[FloatArray, FloatArray]:
    """Returns each person's box (C, M, 4) in each camera, cut at the image's border, and the share inside (C, M).

    `positions` (C, M, 2) are those at each camera's stamp. A person half behind a camera has a box of zeros.
    """
    camera_from_map = np.stack([camera.camera_from_map for camera in cameras])  # (C, 4, 4)
    eyes = inverse(camera_from_map)[:, None, :2, 3]  # (C, 1, 2)
    toward = positions - eyes
    scale = params.radius_m / np.maximum(np.hypot(toward[..., 0], toward[..., 1]), 1e-3)
    C, M = positions.shape[:2]
    side = np.empty((C, M, 2))
    side[..., 0], side[..., 1] = -toward[..., 1] * scale, toward[..., 0] * scale
    corners = np.empty((3, 2, C, M, 3))  # three heights, two sides: a straight edge is curved in a fisheye image
    corners[:, 0, ..., :2], corners[:, 1, ..., :2] = positions - side, positions + side
    corners[..., 2] = (ground + params.height_m * np.array([0.0, 0.5, 1.0])[:, None])[:, None, None, :]
    points = corners.transpose(2, 0, 1, 3, 4).reshape(C, 6 * M, 3)
    points = points @ camera_from_map[:, :3, :3].swapaxes(1, 2) + camera_from_map[:, None, :3, 3]
    pixels, valid = project_all([camera.model for camera in cameras], points)
    pixels, valid = pixels.reshape(C, 6, M, 2), valid.reshape(C, 6, M)
    low = np.fmin.reduce(pixels, axis=1)  # (C, M, 2); fmin and fmax pass over the NaN of corners that are not seen
    high = np.fmax.reduce(pixels, axis=1)
    out_of_view = np.count_nonzero(valid, axis=1) < 4
    low[out_of_view] = high[out_of_view] = 0.0
    area = (high[..., 0] - low[..., 0]) * (high[..., 1] - low[..., 1])
    limits = np.array([(camera.model.width_px, camera.model.height_px) for camera in cameras], float)[:, None]
    outlines = np.empty((C, M, 4))
    outlines[..., :2] = low = np.minimum(np.maximum(low, 0.0), limits)
    outlines[..., 2:] = high = np.minimum(np.maximum(high, 0.0), limits)
    inside = (high[..., 0] - low[..., 0]) * (high[..., 1] - low[..., 1])
    return outlines, inside / np.maximum(area, 1e-9)


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Every camera's pedestrian boxes, sorted by camera, then by place."""

    camera: IntArray  # (B,)  row of the camera
    rows: IntArray  # (B,)  in the camera's message
    corners_px: FloatArray  # (B, 4)
    scores: FloatArray  # (B,)


def _pedestrian_boxes(cameras: Sequence[CameraFrame], params: FusionParams) -> _Boxes:
    """Returns the pedestrian boxes that have a size."""
    messages = [camera.detections for camera in cameras]
    named = np.array([label in params.pedestrian_labels for message in messages for label in message.labels], bool)
    counts = [len(message.labels) for message in messages]
    camera = np.repeat(np.arange(len(messages)), counts)
    rows = np.concatenate([np.arange(count) for count in counts])
    corners = np.concatenate([np.reshape(message.boxes_px, (-1, 4)) for message in messages]).astype(float)
    scores = np.concatenate([message.scores for message in messages]).astype(float)
    keep = named & np.isfinite(corners).all(axis=1) & np.isfinite(scores)
    keep &= (corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1])
    kept = np.flatnonzero(keep)
    kept = kept[np.lexsort((scores[kept], *corners[kept].T[::-1], camera[kept]))]
    return _Boxes(camera[kept], rows[kept], corners[kept], scores[kept])


def _likeness(outlines: FloatArray, in_view: BoolArray, boxes: FloatArray, params: FusionParams) -> FloatArray:
    """Returns how well each box fits each person of its own camera, 0 past the gates.

    Args:
        outlines: (B, M, 4) of the people, in the camera of each box.
        in_view: (B, M)
        boxes: (B, 4)
        params: gates.
    """
    x0, y0, x1, y1 = np.ascontiguousarray(outlines.transpose(2, 0, 1))  # (B, M) each
    u0, v0, u1, v1 = boxes.T[:, :, None]  # (B, 1) each
    width, height = x1 - x0, np.maximum(y1 - y0, 1e-9)
    box_width, box_height = u1 - u0, v1 - v0
    shared_x = np.minimum(x1, u1) - np.maximum(x0, u0)
    shared_y = np.minimum(y1, v1) - np.maximum(y0, v0)
    overlap = np.maximum(shared_x, 0.0) / np.maximum(width + box_width - shared_x, 1e-9)
    inside = np.abs(x0 + x1 - u0 - u1) <= params.grown_box * box_width
    inside &= np.abs(y0 + y1 - v0 - v1) <= params.grown_box * box_height
    ratio = np.log(box_height / height) / params.max_height_log_ratio
    gate = ((overlap >= params.min_overlap) | inside) & (shared_y > 0) & in_view & (np.abs(ratio) < 1)
    return np.where(gate, (0.1 + overlap) * np.exp(-2 * ratio * ratio), 0.0)


def _assign(likeness: FloatArray) -> tuple[IntArray, IntArray]:
    """Returns boxes and their clusters, one to one, with the largest total likeness (B, M)."""
    box, cluster = linear_sum_assignment(likeness, maximize=True)
    real = likeness[box, cluster] > 0
    return box[real], cluster[real]
