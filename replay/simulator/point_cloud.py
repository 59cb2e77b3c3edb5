"""The simulated VLP-16's raw points: every beam of a scan cast into the scene, which is what clusters are made from.

The same scene, pose, mounting and frozen parameters as `lidar_model`, which draws its clusters without casting beams.
What that model says of patches holds here of points: a body is an upright ellipse, as wide as its disc and so deep
that its visible points lie `centroid_pull` radii before its middle on average. Nothing is said of clustering: that is
for whoever segments the points. One letter per axis: R rings, C columns, J discs, P pairs of a beam and a disc it may
meet.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from replay.simulator.motion import Scene
from replay.simulator.noise import CorrelatedNoise
from replay.simulator.rig import LIDAR_FRAME, planar_pose
from replay.simulator.sensor_model import SensorModelV1
from replay.simulator.visibility import FIXTURE, PERSON, Objects
from schemas.messages import BoolArray, FloatArray, IntArray, PointCloud

FOLIAGE_RADIUS_M = 0.25  # a fixture thicker than this is a bush


class SimulatedPoints:
    """Turns scenes into point clouds, in order of time."""

    def __init__(self, vehicle_from_lidar: FloatArray, model: SensorModelV1, rng: np.random.Generator):
        self._vehicle_from_lidar = vehicle_from_lidar
        self._model = model
        self._rng = rng
        self._sway = CorrelatedNoise((model.sway_correlation_s,) * 2, rng)

    def scan(self, scene: Scene, objects: Objects, stamp_ns: int) -> PointCloud:
        """Returns the points (N, 3) of a scene and its solid objects, float32, column after column as a sweep goes."""
        model, rng = self._model, self._rng
        beams = _beams(model, self._vehicle_from_lidar, float(rng.random()), float(rng.standard_normal()))
        discs = _stacked(self._solids(scene, objects), self._clutter())
        height = float(self._vehicle_from_lidar[2, 3])
        flat = np.minimum(_to_discs(beams, discs, height), _to_ground(beams, height))  # (R, C)
        ranges = flat * np.hypot(1.0, beams.slopes)
        with np.errstate(invalid="ignore"):  # a beam that meets nothing is infinitely long
            noisy = ranges + (model.point_noise_sd_m + model.point_noise_sd_per_m * ranges) * rng.standard_normal(
                ranges.shape
            )
        p_return = model.p_return * expit((model.return_falloff_range_m - ranges) / model.return_falloff_m)
        comes_back = (ranges < model.lidar_range_m) & (rng.random(ranges.shape) < p_return) & (noisy > 0)
        column, ring = np.nonzero(comes_back.T)
        points = beams.directions[ring, column] * noisy[ring, column, None]
        return PointCloud(stamp_ns, LIDAR_FRAME, points.astype(np.float32))

    def _solids(self, scene: Scene, objects: Objects) -> "_Discs":
        """Returns the discs of a scene's objects around the sensor: people sway, and leaves are where the wind is."""
        model = self._model
        sensor = planar_pose(scene.vehicle.position_m, scene.vehicle.yaw_rad) @ self._vehicle_from_lidar[:, 3]
        kinds = objects.kinds[objects.owners]
        foliage = (kinds == FIXTURE) & (objects.radii_m > FOLIAGE_RADIUS_M)
        sway = self._sway.at(objects.keys, scene.time_s)[objects.owners] * model.sway_sd_m
        leaves = self._rng.standard_normal(sway.shape) * model.foliage_noise_sd_m
        moved = np.where((kinds == PERSON)[:, None], sway, 0.0) + np.where(foliage[:, None], leaves, 0.0)
        offsets = objects.centres_m + moved - sensor[:2]
        heights = objects.heights_m[objects.owners]
        into_vehicle = planar_pose(np.zeros(2), scene.vehicle.yaw_rad)[:2, :2]
        return _Discs(offsets @ into_vehicle, objects.radii_m, np.zeros_like(heights), heights)

    def _clutter(self) -> "_Discs":
        """Returns what is there in this scan alone: leaves and dust, as many and as big as the clusters' clutter."""
        model, rng = self._model, self._rng
        M = int(rng.poisson(model.clutter_per_scan))
        bearings, ranges = rng.uniform(-math.pi, math.pi, M), rng.uniform(*model.clutter_range_m, M)
        places = ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
        width, height = np.exp(rng.normal(math.log(0.45), 0.5, (2, M)))
        bottom = model.ground_cut_m + rng.exponential(0.3, M)
        return _Discs(places, width / 2, bottom, bottom + height)


@dataclass(frozen=True, eq=False)
class _Discs:
    """Upright bodies around the sensor, along the vehicle's axes."""

    offsets_m: FloatArray  # (J, 2)  from the sensor
    radii_m: FloatArray  # (J,)
    bottoms_m: FloatArray  # (J,)  above ground
    tops_m: FloatArray  # (J,)


def _stacked(a: _Discs, b: _Discs) -> _Discs:
    return _Discs(
        np.concatenate([a.offsets_m, b.offsets_m]),
        np.concatenate([a.radii_m, b.radii_m]),
        np.concatenate([a.bottoms_m, b.bottoms_m]),
        np.concatenate([a.tops_m, b.tops_m]),
    )


@dataclass(frozen=True, eq=False)
class _Beams:
    """All beams of a scan. Every ring is a cone about the sensor's axis, which is not the vertical one."""

    directions: FloatArray  # (R, C, 3)  unit vectors, the sensor's own frame
    bearings_rad: FloatArray  # (R, C)  along the vehicle's axes, -pi to pi
    slopes: FloatArray  # (R, C)  rise per metre along the ground
    order: IntArray  # (R, C)  columns of each ring by rising bearing
    depth_ratio: float  # how deep bodies are to how wide


def _beams(model: SensorModelV1, vehicle_from_lidar: FloatArray, phase: float, unit_pitch: float) -> _Beams:
    """Returns the beams of a scan whose columns begin at `phase` (0 to 1) of their width.

    The suspension pitches the vehicle by `unit_pitch` deviations while the sensor's frame is taken to be where the
    level vehicle has it.
    """
    azimuths = (np.arange(model.lidar_columns) + phase) * (2 * math.pi / model.lidar_columns) - math.pi
    elevations = model.lidar_lowest_ring_rad + model.lidar_ring_spacing_rad * np.arange(model.lidar_rings)
    directions = np.empty((model.lidar_rings, model.lidar_columns, 3))
    directions[..., 0] = np.cos(elevations)[:, None] * np.cos(azimuths)
    directions[..., 1] = np.cos(elevations)[:, None] * np.sin(azimuths)
    directions[..., 2] = np.sin(elevations)[:, None]
    pitch = unit_pitch * model.lidar_pitch_jitter_rad
    pitched = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    x, y, z = np.moveaxis(directions @ (pitched @ vehicle_from_lidar[:3, :3]).T, -1, 0)
    bearings = np.arctan2(y, x)
    # The mean depth of half an ellipse is pi/4 of its semi-axis.
    depth_ratio = model.centroid_pull * 4 / math.pi
    return _Beams(directions, bearings, z / np.hypot(x, y), np.argsort(bearings, axis=1), depth_ratio)


def _to_ground(beams: _Beams, height_m: float) -> FloatArray:
    """Returns how far (R, C) along the ground beams from a height meet it; infinity for those that rise."""
    distances = np.full_like(beams.slopes, np.inf)
    np.divide(-height_m, beams.slopes, out=distances, where=beams.slopes < 0)
    return distances


def _to_discs(beams: _Beams, discs: _Discs, height_m: float) -> FloatArray:
    """Returns how far (R, C) along the ground beams from a height meet the nearest disc; infinity where they do not.

    A disc that the sensor stands in is not there.
    """
    distances = np.maximum(np.hypot(discs.offsets_m[:, 0], discs.offsets_m[:, 1]), 1e-9)
    there = distances > discs.radii_m + 0.05
    beam, disc = _pairs(beams, discs, distances, there)
    away, radius = distances[disc], discs.radii_m[disc]
    turned = beams.bearings_rad.ravel()[beam] - np.arctan2(discs.offsets_m[disc, 1], discs.offsets_m[disc, 0])
    slope = beams.slopes.ravel()[beam]

    half_depth = beams.depth_ratio * np.sqrt(np.maximum(radius**2 - (away * np.sin(turned)) ** 2, 0.0))
    enters, leaves = away * np.cos(turned) - half_depth, away * np.cos(turned) + half_depth
    in_at, out_at = height_m + slope * enters, height_m + slope * leaves
    top, bottom = discs.tops_m[disc], discs.bottoms_m[disc]
    meets_side = (in_at >= bottom) & (in_at <= top)
    meets_top = (in_at > top) & (out_at < top)  # only a beam that falls: its slope is not 0
    hit = np.where(meets_side, enters, np.inf)
    np.divide(top - height_m, slope, out=hit, where=meets_top)

    nearest = np.full(beams.slopes.size, np.inf)
    np.minimum.at(nearest, beam, hit)
    return nearest.reshape(beams.slopes.shape)


def _pairs(beams: _Beams, discs: _Discs, distances_m: FloatArray, there: BoolArray) -> tuple[IntArray, IntArray]:
    """Returns beams (P,), numbered ring after ring, and discs (P,) for all pairs that share a bearing."""
    C = beams.order.shape[1]
    centres = np.arctan2(discs.offsets_m[:, 1], discs.offsets_m[:, 0])
    half = np.where(there, np.arcsin(np.minimum(discs.radii_m / distances_m, 1.0)), -1.0)
    low = (centres - half + math.pi) % (2 * math.pi) - math.pi
    rising = np.take_along_axis(beams.bearings_rad, beams.order, axis=1)
    twice_round = np.concatenate([rising, rising + 2 * math.pi], axis=1)  # a disc may lie across the turn
    first = np.stack([np.searchsorted(row, low) for row in twice_round])  # (R, J)
    beyond = np.stack([np.searchsorted(row, low + 2 * half) for row in twice_round])
    counts = np.maximum(beyond - first, 0)
    ring, disc = (np.repeat(index, counts.ravel()) for index in np.indices(counts.shape).reshape(2, -1))
    starts = np.cumsum(counts.ravel()) - counts.ravel()
    place = np.arange(len(ring)) - np.repeat(starts - first.ravel(), counts.ravel())
    return ring * C + beams.order[ring, place % C], disc
