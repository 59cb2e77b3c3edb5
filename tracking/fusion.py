"""Late fusion: LiDAR clusters and camera boxes -> position measurements with a covariance and a class probability.

One measurement per cluster: a person whom two cameras see is still one measurement.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from schemas.messages import BoolArray, FloatArray, IntArray
from tracking.assignment import assign
from tracking.geometry import apply
from tracking.measurements import CameraEvidence, Measurements, PredictedTracks, empty_measurements, make_measurements
from tracking.outlines import Outlines, outlines
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
    total = np.minimum(np.maximum(log_odds, -params.max_log_odds), params.max_log_odds) + clusters.person_like
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
    too_wide = np.minimum(np.maximum((width - params.max_width_m) / 0.5, 0.0), 1.0)
    too_tall = np.minimum(np.maximum((height - params.max_height_m) / 0.5, 0.0), 1.0)
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
    people = outlines(
        cameras, moved, _ground(frame, clusters, params), radius_m=params.radius_m, height_m=params.height_m
    )
    boxes = _pedestrian_boxes(cameras, params)
    box, cluster, likeness = _matches(people, boxes, len(cameras), M, params)
    assigned = assign(box, boxes.camera[box] * M + cluster, likeness * rank[cluster])
    box, cluster = box[assigned], cluster[assigned]
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
    tall = people.corners_px[3] - people.corners_px[1] >= params.min_height_px
    proves = tall & (people.share_inside >= params.min_in_image) & ~matched[people.camera, people.person]
    expected = params.p_box * visible
    no_box = np.log((1 - expected) / (1 - np.minimum(params.p_box_other, expected)))
    return log_odds + no_box * np.bincount(people.person[proves], minlength=M), evidence


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
    ground: FloatArray = np.minimum(np.maximum(plane, z - 0.9 * params.height_m), z - 0.1 * params.height_m)
    return ground


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
    corners = np.concatenate([message.boxes_px.reshape(-1, 4) for message in messages]).astype(float, copy=False)
    scores = np.concatenate([message.scores for message in messages]).astype(float, copy=False)
    keep = named & np.isfinite(corners).all(axis=1) & np.isfinite(scores)
    keep &= (corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1])
    kept = np.flatnonzero(keep)
    kept = kept[np.lexsort((scores[kept], *corners[kept].T[::-1], camera[kept]))]
    return _Boxes(camera[kept], rows[kept], corners[kept], scores[kept])


def _matches(
    people: Outlines, boxes: _Boxes, C: int, M: int, params: FusionParams
) -> tuple[IntArray, IntArray, FloatArray]:
    """Returns boxes (P,), clusters (P,) and how well they fit, for the pairs of one camera that pass the gates.

    Whatever passes touches the box widened by `grown_box`, which is tried first: most pairs are far apart.
    """
    table = np.full((4, C, M), np.nan)  # compares as False where nobody is in view
    table[:, people.camera, people.person] = people.corners_px
    x0, y0, x1, y1 = table[:, boxes.camera]  # (B, M) each
    u0, v0, u1, v1 = boxes.corners_px.T  # (B,) each
    wider = 0.5 * (params.grown_box - 1) * (u1 - u0) + 1.0  # a pixel more, for rounding
    near = (x0 < (u1 + wider)[:, None]) & (x1 > (u0 - wider)[:, None]) & (y0 < v1[:, None]) & (y1 > v0[:, None])
    box, cluster = np.divmod(np.flatnonzero(near), M)
    likeness = _likeness(table[:, boxes.camera[box], cluster], boxes.corners_px[box].T, params)
    fits = np.flatnonzero(likeness)
    return box[fits], cluster[fits], likeness[fits]


def _likeness(outlines_px: FloatArray, boxes_px: FloatArray, params: FusionParams) -> FloatArray:
    """Returns how well people's outlines (4, P) fit boxes (4, P) of the same camera, pair by pair; 0 past the gates."""
    x0, y0, x1, y1 = outlines_px
    u0, v0, u1, v1 = boxes_px
    width, height = x1 - x0, np.maximum(y1 - y0, 1e-9)
    box_width, box_height = u1 - u0, v1 - v0
    shared_x = np.minimum(x1, u1) - np.maximum(x0, u0)
    shared_y = np.minimum(y1, v1) - np.maximum(y0, v0)
    overlap = np.maximum(shared_x, 0.0) / np.maximum(width + box_width - shared_x, 1e-9)
    inside = np.abs(x0 + x1 - u0 - u1) <= params.grown_box * box_width
    inside &= np.abs(y0 + y1 - v0 - v1) <= params.grown_box * box_height
    ratio = np.log(box_height / height) / params.max_height_log_ratio
    gate = ((overlap >= params.min_overlap) | inside) & (shared_y > 0) & (np.abs(ratio) < 1)
    return np.where(gate, (0.1 + overlap) * np.exp(-2 * ratio * ratio), 0.0)
