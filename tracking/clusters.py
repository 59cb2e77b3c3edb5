"""LiDAR clusters on their way to measurements: sound ones, in the odometry frame, where people would stand in them."""

from dataclasses import dataclass

import numpy as np

from schemas.messages import BoolArray, FloatArray, IntArray
from tracking.fusion_params import FusionParams
from tracking.geometry import apply
from tracking.sensor_frame import SensorFrame


@dataclass(frozen=True, eq=False)
class Clusters:
    """A scan's sound clusters, sorted by place, in the odometry frame. Those that were split have several rows."""

    index: IntArray  # (M,)  row in the scan
    centroids_m: FloatArray  # (M, 3)
    offsets_m: FloatArray  # (M, 2)  from the LiDAR to the centroid, seen from above
    sizes_m: FloatArray  # (M, 3)
    width_m: FloatArray  # (M,)  diagonal, seen from above
    points: IntArray  # (M,)
    split: BoolArray  # (M,)  True for one person's part of a cluster

    def __len__(self) -> int:
        return len(self.index)


def sound_clusters(frame: SensorFrame) -> BoolArray:
    """Marks the clusters (M,) of a frame that are finite, within reach and of a possible size."""
    c = frame.clusters
    numbers = np.concatenate([c.centroids_m, c.sizes_m], axis=1)
    sound: BoolArray = (np.isfinite(numbers) & (np.abs(numbers) < 1e4)).all(axis=1)
    sound &= (c.sizes_m >= 0).all(axis=1)
    return sound


def place(frame: SensorFrame, rows: IntArray) -> Clusters:
    """Returns the clusters at `rows` of the scan in the odometry frame, in an order of their own."""
    c = frame.clusters
    centroids, sizes, points = c.centroids_m[rows], c.sizes_m[rows].astype(float), c.points[rows]
    order = np.lexsort((points, sizes[:, 2], sizes[:, 1], sizes[:, 0], *centroids.T[::-1]))
    rows, sizes, points = rows[order], sizes[order], points[order]
    centroids = apply(frame.map_from_lidar, centroids[order])
    offsets = centroids[:, :2] - frame.map_from_lidar[:2, 3]
    width = np.hypot(sizes[:, 0], sizes[:, 1])
    return Clusters(rows, centroids, offsets, sizes, width, points, np.zeros(len(rows), bool))


def size_log_odds(clusters: Clusters, params: FusionParams) -> FloatArray:
    """Returns log-odds (M,) of being a person by size alone.

    A person is up to a metre wide and two tall; walls, cars and trees are not, and poles are thinner.
    """
    too_wide = np.minimum(np.maximum((clusters.width_m - params.max_width_m) / 0.5, 0.0), 1.0)
    too_tall = np.minimum(np.maximum((clusters.sizes_m[:, 2] - params.max_height_m) / 0.5, 0.0), 1.0)
    thin = (clusters.width_m < params.pole_width_m) & (clusters.points >= 10)
    log_odds: FloatArray = params.base_log_odds - 4.0 * too_wide - 3.0 * too_tall - 0.8 * thin
    return log_odds


def positions(clusters: Clusters, params: FusionParams, *, pose_extrapolated: bool) -> tuple[FloatArray, FloatArray]:
    """Returns where people stand (M, 2), the near side's bias taken off, and the covariances (M, 2, 2)."""
    ranges = np.maximum(np.hypot(clusters.offsets_m[:, 0], clusters.offsets_m[:, 1]), 1e-3)
    sight = clusters.offsets_m / ranges[:, None]  # (M, 2)
    bias = np.where(clusters.width_m < params.max_width_m, params.centroid_bias_m, 0.0)
    found = clusters.centroids_m[:, :2] + bias[:, None] * sight

    few = params.single_point_sigma_m**2 / np.maximum(clusters.points, 1)
    big = (np.maximum(clusters.width_m - params.max_width_m, 0.0) / 4) ** 2
    common = few + big + params.split_sigma_m**2 * clusters.split
    common = common + (params.extrapolated_pose_sigma_m**2 if pose_extrapolated else 0.0)
    along = params.range_sigma_m**2 + common
    across = params.cross_sigma_m**2 + (params.bearing_sigma_rad * ranges) ** 2 + common
    return found, ray_covariances(sight, along, across)


def ray_covariances(sight: FloatArray, along: FloatArray, across: FloatArray) -> FloatArray:
    """Returns covariances (M, 2, 2) with the given variances (M,) along unit vectors (M, 2) and across them."""
    x, y = sight[:, 0], sight[:, 1]
    covs = np.empty((len(sight), 2, 2))
    covs[:, 0, 0] = along * x * x + across * y * y
    covs[:, 1, 1] = along * y * y + across * x * x
    covs[:, 0, 1] = covs[:, 1, 0] = (along - across) * x * y
    return covs
