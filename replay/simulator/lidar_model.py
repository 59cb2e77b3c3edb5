"""The simulated VLP-16 and the clustering behind it: a scene in, `LidarClusters` and points per pedestrian out."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from replay.simulator.motion import Scene
from replay.simulator.noise import CorrelatedNoise
from replay.simulator.rig import LIDAR_FRAME, planar_pose
from replay.simulator.sensor_model import SensorModelV1
from replay.simulator.visibility import FIXTURE, PERSON, Objects, View, look
from schemas.messages import BoolArray, FloatArray, IntArray, LidarClusters
from tracking.geometry import apply, inverse


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan's clusters, and what only a simulator knows about it."""

    clusters: LidarClusters
    person_ids: IntArray  # (A,)  everybody in the scene
    person_points: IntArray  # (A,)  points on each, before clustering: 0 if hidden or out of range


class SimulatedLidar:
    """Turns scenes into scans, in order of time."""

    def __init__(self, vehicle_from_lidar: FloatArray, model: SensorModelV1, rng: np.random.Generator):
        self._vehicle_from_lidar = vehicle_from_lidar
        self._model = model
        self._rng = rng
        sway = model.sway_correlation_s
        self._noise = CorrelatedNoise((model.miss_correlation_s, sway, sway), rng)

    def scan(self, scene: Scene, objects: Objects, stamp_ns: int) -> Scan:
        """Returns the scan of a scene and its solid objects; clusters are sorted by bearing, as a sweep finds them."""
        model, rng = self._model, self._rng
        map_from_lidar = planar_pose(scene.vehicle.position_m, scene.vehicle.yaw_rad) @ self._vehicle_from_lidar
        offsets = (objects.centres_m - map_from_lidar[:2, 3]) @ _rotation(scene.vehicle.yaw_rad)  # into base_link axes
        in_range = np.hypot(offsets[:, 0], offsets[:, 1]) < model.lidar_range_m
        one_sweep, phase = np.zeros(len(offsets), np.int64), float(rng.random())
        view = look(offsets, objects.radii_m, in_range, one_sweep, columns=model.lidar_columns, phase=phase)
        hits = self._hits(objects, view)
        patches = self._patches(objects, view, hits, map_from_lidar[:2, 3], scene.time_s)
        labels = self._cluster_labels(objects, patches.detected)
        found = _gather(patches, labels, planar_pose(np.zeros(2), scene.vehicle.yaw_rad) @ self._vehicle_from_lidar)
        clutter = self._clutter(map_from_lidar)
        lidar_from_map = inverse(map_from_lidar)
        centroids = np.concatenate(
            [apply(lidar_from_map, found.centroids_m), apply(lidar_from_map, clutter.centroids_m)]
        )
        sizes = np.concatenate([found.sizes_m, clutter.sizes_m])
        counts = np.concatenate([found.points, clutter.points])
        order = np.argsort(np.arctan2(centroids[:, 1], centroids[:, 0]), kind="stable")
        clusters = LidarClusters(stamp_ns, LIDAR_FRAME, centroids[order], sizes[order], counts[order])
        A = len(scene.people.ids)
        return Scan(clusters, scene.people.ids, hits.points[:A])  # the first A discs are the people

    def _p_return(self, distances_m: FloatArray) -> FloatArray:
        model = self._model
        p: FloatArray = model.p_return / (
            1 + np.exp((distances_m - model.return_falloff_range_m) / model.return_falloff_m)
        )
        return p

    def _hits(self, objects: Objects, view: View) -> "_Hits":
        """Returns how many points fall on each disc and how high.

        The sensor is tilted, so elevations are those of the disc's foot and head in the sensor's own frame; rings in
        between are evenly spaced in elevation, and on a person nearly so in height.
        """
        model = self._model
        front = np.maximum(view.distances_m - model.centroid_pull * objects.radii_m, 0.1)  # (J,)
        bearings = view.bearings_rad + view.mean_offset_rad
        heights = objects.heights_m[objects.owners]
        low, high = np.full_like(heights, model.ground_cut_m), np.maximum(heights, model.ground_cut_m)
        sensor_height = self._vehicle_from_lidar[2, 3]
        lidar_from_level = self._vehicle_from_lidar[:3, :3].T
        elevations = []
        for z in (low, high):
            level = np.stack([front * np.cos(bearings), front * np.sin(bearings), z - sensor_height], axis=-1)
            x, y, up = lidar_from_level @ level.T
            elevations.append(np.arctan2(up, np.hypot(x, y)))
        pitch = float(self._rng.normal(0, model.lidar_pitch_jitter_rad))
        lowest, spacing = model.lidar_lowest_ring_rad + pitch, model.lidar_ring_spacing_rad
        first = np.maximum(np.ceil((elevations[0] - lowest) / spacing), 0)
        last = np.minimum(np.floor((elevations[1] - lowest) / spacing), model.lidar_rings - 1)
        rings = np.maximum(last - first + 1, 0).astype(np.int64)
        slope = (high - low) / np.maximum(elevations[1] - elevations[0], 1e-9)  # m of height per rad
        mean = low + slope * (lowest + spacing * (first + last) / 2 - elevations[0])
        points = self._rng.binomial(view.visible * rings, self._p_return(view.distances_m))
        return _Hits(points, mean, slope * spacing * np.maximum(rings - 1, 0))

    def _patches(self, objects: Objects, view: View, hits: "_Hits", sensor_m: FloatArray, time_s: float) -> "_Patches":
        """Returns the visible surface of every disc: where its points are centred and how far they reach.

        sensor_m: (2,) map frame.
        """
        model, rng, points = self._model, self._rng, hits.points
        noise = self._noise.at(objects.keys, time_s)[objects.owners]  # (J, 3)
        n = np.bincount(objects.owners, weights=points, minlength=len(objects.kinds))[objects.owners]
        p_cluster = model.p_cluster * -np.expm1(-np.maximum(n - 2, 0) / model.cluster_growth_points)
        detected = (points > 0) & (n >= model.cluster_min_points) & (ndtr(noise[:, 0]) < p_cluster)

        person = objects.kinds[objects.owners] == PERSON
        foliage = (objects.kinds[objects.owners] == FIXTURE) & (objects.radii_m > 0.25)
        to_disc = objects.centres_m - sensor_m
        sight = to_disc / np.maximum(view.distances_m, 1e-9)[:, None]
        across = np.stack([-sight[:, 1], sight[:, 0]], axis=-1)
        pull = model.centroid_pull * objects.radii_m
        sd = (model.point_noise_sd_m + model.point_noise_sd_per_m * view.distances_m) / np.sqrt(np.maximum(points, 1))
        sd = np.hypot(sd, np.where(foliage, model.foliage_noise_sd_m, 0.0))
        centres = (
            objects.centres_m
            - pull[:, None] * sight
            + (view.distances_m * view.mean_offset_rad)[:, None] * across
            + np.where(person, model.sway_sd_m, 0.0)[:, None] * noise[:, 1:]
            + sd[:, None] * rng.standard_normal((len(points), 2))
        )
        width = view.distances_m * np.maximum(view.last - view.first, 0) * (2 * math.pi / model.lidar_columns)
        return _Patches(
            detected,
            points,
            np.column_stack([centres, hits.heights_m]),
            np.stack([np.minimum(width, 2 * objects.radii_m), pull, hits.extents_m], axis=-1),
            sight,
        )

    def _cluster_labels(self, objects: Objects, detected: BoolArray) -> IntArray:
        """Returns a cluster number per disc, -1 for those that are in none; surfaces that nearly touch share one."""
        model = self._model
        labels = np.where(detected, objects.owners, -1)
        shown = np.flatnonzero(detected)
        centres, radii = objects.centres_m[shown], objects.radii_m[shown]
        gaps = np.linalg.norm(centres[:, None] - centres, axis=-1) - radii[:, None] - radii
        owners = objects.owners[shown]
        near = np.triu(gaps < model.merge_gap_other_m + 4 * model.merge_gap_sd_m, 1) & (owners[:, None] != owners)
        kinds = objects.kinds[owners]
        for i, j in np.argwhere(near):
            both_people = kinds[i] == kinds[j] == PERSON
            limit = model.merge_gap_m if both_people else model.merge_gap_other_m
            if gaps[i, j] < limit + self._rng.normal(0, model.merge_gap_sd_m):
                kept, gone = sorted((labels[shown[i]], labels[shown[j]]))
                labels[labels == gone] = kept
        return labels

    def _clutter(self, map_from_lidar: FloatArray) -> "_Clusters":
        """Returns clusters of this scan alone: leaves, dust, ground that was not removed; map frame."""
        model, rng = self._model, self._rng
        M = int(rng.poisson(model.clutter_per_scan))
        bearings = rng.uniform(-math.pi, math.pi, M)
        ranges = rng.uniform(*model.clutter_range_m, M)
        place = map_from_lidar[:2, 3] + ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
        sizes = np.exp(rng.normal(math.log(0.45), 0.5, (M, 3)))
        height = model.ground_cut_m + sizes[:, 2] / 2 + rng.exponential(0.3, M)
        expected = 600 * sizes[:, 0] * sizes[:, 2] / (1 + ranges**2 / 30)  # falls with range as on real things
        points = np.maximum(rng.poisson(np.minimum(expected, 80)), model.cluster_min_points)
        return _Clusters(np.column_stack([place, height]), sizes, points)


@dataclass(frozen=True, eq=False)
class _Hits:
    """Where on each disc the beams fall."""

    points: IntArray  # (J,)
    heights_m: FloatArray  # (J,)  mean, above ground
    extents_m: FloatArray  # (J,)  from the lowest ring to the highest


@dataclass(frozen=True, eq=False)
class _Patches:
    """The visible surface of each disc."""

    detected: BoolArray  # (J,)
    points: IntArray  # (J,)
    centres_m: FloatArray  # (J, 3)  map frame, of the points
    extents_m: FloatArray  # (J, 3)  across the line of sight, along it, up
    sight: FloatArray  # (J, 2)  unit vector from the sensor to the disc


@dataclass(frozen=True, eq=False)
class _Clusters:
    """Clusters before they are put into the sensor's frame."""

    centroids_m: FloatArray  # (M, 3)  map frame
    sizes_m: FloatArray  # (M, 3)  along the sensor's axes
    points: IntArray  # (M,)


def _rotation(yaw_rad: float) -> FloatArray:
    """Returns R (2, 2) such that rows of map vectors times R are in axes turned by yaw."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s], [s, c]])


def _gather(patches: _Patches, labels: IntArray, level_from_lidar: FloatArray) -> _Clusters:
    """Returns one cluster per label: points added up, centroid weighted by them, size reaching over all patches.

    level_from_lidar (4, 4) turns the sensor's axes into the map's.
    """
    shown = np.flatnonzero(labels >= 0)
    _, cluster = np.unique(labels[shown], return_inverse=True)
    M = int(cluster.max()) + 1 if len(shown) else 0
    points = np.bincount(cluster, weights=patches.points[shown], minlength=M)
    weights = patches.points[shown, None] / points[cluster, None]
    centroids = np.zeros((M, 3))
    np.add.at(centroids, cluster, weights * patches.centres_m[shown])

    # A patch reaches half its extents from its centre, in the map's axes and then in the sensor's.
    along, up = patches.sight[shown], np.zeros(len(shown))
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    half = patches.extents_m[shown] / 2
    arms = np.stack(
        [
            np.column_stack([across * half[:, :1], up]),
            np.column_stack([along * half[:, 1:2], up]),
            np.column_stack([up, up, half[:, 2]]),
        ],
        axis=1,
    )  # (J, 3 arms, 3)
    R = level_from_lidar[:3, :3]
    reach = np.abs(arms @ R).sum(axis=1)  # (J, 3)
    centres = (patches.centres_m[shown]) @ R
    lower, upper = np.full((M, 3), np.inf), np.full((M, 3), -np.inf)
    np.minimum.at(lower, cluster, centres - reach)
    np.maximum.at(upper, cluster, centres + reach)
    return _Clusters(centroids, np.maximum(upper - lower, 0.0), points.astype(np.int64))
