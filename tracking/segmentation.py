"""Raw LiDAR points in, clusters out: the ground is found and taken away, what stands on it is put together by nearness.

    points, sorted -> plane (RANSAC) -> ground's profile -> linked (k-d tree) -> rows of people apart -> clusters

The sensor may be tilted and the road bent. Points are linked along the ground, up and down far more freely: rings are 2
degrees apart, 0.9 m at 25 m, where a person has two or three. People who touch are told apart by the shape of their
fronts. Points are sorted first, and the plane's trials drawn from a generator that always starts alike: neither the
order of the points nor chance changes anything.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from schemas.messages import BoolArray, FloatArray, IntArray, LidarClusters, PointCloud

_BITS = 19  # of a sorting key, per coordinate: 262 m to either side, in mm
_FARTHEST_M = 180.0

_SECTORS, _PARTS = 36, 10  # the ground is looked for in every 10 degrees; how much of them points cover, in single ones
_SEED_BIN_M, _PROFILE_BIN_M = 1.0, 2.0  # in range
_BEYOND = 1.4  # ground is looked for this many times as far as things are: at the edge, too, it is more than a strip
_TRIALS = 200
_LEAST_VOTES = 6  # cells that a plane must explain
_SAME_M = 0.06  # what is nearer than this along the ground is one place to the k-d tree
_BANDS_M = (0.0, 8.0, 16.0, 28.0, np.inf)  # of range; each has a k-d tree of its own
_ROUGHNESS_M2 = 0.03**2  # no front is smoother than a LiDAR's ranges are exact


class SegmentationParams(BaseModel):
    """Settings of segmentation; the defaults suit a VLP-16 on a low vehicle among pedestrians."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_range_m: float = Field(default=1.5, ge=0, description="what is nearer to the sensor is the vehicle itself")
    max_range_m: float = Field(default=50.0, gt=0, le=_FARTHEST_M, description="farther points are left out")

    max_tilt_deg: float = Field(default=20.0, gt=0, lt=60, description="of the sensor against the ground, at most")
    min_sensor_height_m: float = Field(default=0.3, gt=0, description="of the sensor above the ground, at least")
    max_sensor_height_m: float = Field(default=3.5, gt=0, description="and at most")
    ground_tolerance_m: float = Field(default=0.15, gt=0, description="points this near to a plane may be on it")
    ground_slope: float = Field(
        default=0.08, ge=0, description="how far a road bends away from the plane, in m up or down per m"
    )
    ground_width_m: float = Field(default=2.0, gt=0, description="what is less wide is not ground; nor are people")

    min_height_m: float = Field(default=0.15, gt=0, description="what is lower above the ground is ground")
    max_height_m: float = Field(default=5.0, gt=0, description="what is higher is left out; poles shall show as tall")
    max_base_m: float = Field(default=1.4, gt=0, description="what begins higher than this does not stand there")

    link_along_m: float = Field(default=0.15, gt=0, description="points this near along the line of sight are linked")
    link_along_per_m: float = Field(default=0.006, ge=0, description="and this much farther per m of range")
    link_across_m: float = Field(default=0.04, gt=0, description="likewise across the line of sight")
    link_across_per_m: float = Field(
        default=0.008, ge=0, description="a VLP-16's beams are 0.0035 apart; some are lost"
    )
    link_up_m: float = Field(default=0.3, gt=0, description="likewise up and down")
    link_up_per_m: float = Field(default=0.05, ge=0, description="a VLP-16's rings are 0.035 apart")

    person_width_m: float = Field(default=0.5, gt=0, description="of the fronts that a row of people is made of")
    person_depth_m: float = Field(default=0.15, gt=0, description="how far the middle of a front is before its sides")
    closest_people_m: float = Field(default=0.4, gt=0, description="nobody stands nearer to a neighbour in a row")
    max_row_m: float = Field(default=2.5, ge=0, description="longer things are not rows of people; 0: nothing is")
    max_person_m: float = Field(default=2.3, gt=0, description="nor are taller ones")
    row_evidence: float = Field(
        default=6.0, ge=0, description="by how much a row must explain a front better than one body does (BIC)"
    )

    min_points: int = Field(default=4, ge=1, description="fewer are no cluster")
    max_points: int = Field(default=5000, ge=1, description="more than a person has who stands beside the vehicle")
    max_extent_m: float = Field(default=6.0, gt=0, description="longer things along the ground are walls and buildings")

    @model_validator(mode="after")
    def _rises(self) -> Self:
        for low, high in (
            ("min_range_m", "max_range_m"),
            ("min_sensor_height_m", "max_sensor_height_m"),
            ("min_height_m", "max_height_m"),
            ("min_points", "max_points"),
        ):
            if getattr(self, high) <= getattr(self, low):
                raise ValueError(f"{high} {getattr(self, high):g} must be over {low} {getattr(self, low):g}")
        return self


def segment(cloud: PointCloud, params: SegmentationParams) -> LidarClusters:
    """Returns what stands on the ground in a scan, sorted by bearing; nothing if nothing does.

    Coordinates count to the millimetre. Where no ground can be made out (a handful of points, one wall), the lowest
    point is taken to stand on it.
    """
    points = _sorted_points(cloud.points_m, params)
    level = _above_ground(points, params)
    stands = (level[:, 2] >= params.min_height_m) & (level[:, 2] <= params.max_height_m)
    stands &= np.hypot(level[:, 0], level[:, 1]) <= params.max_range_m
    points, level = points[stands], level[stands]
    labels = _people_apart(level, _linked(level, params), params)
    return _clusters(cloud, points, labels, _wanted(level, labels, params))


def _sorted_points(points_m: FloatArray, params: SegmentationParams) -> FloatArray:
    """Returns the points (N, 3) out to where ground counts, to the mm, sorted: their order says nothing any more."""
    points = np.asarray(points_m, float).reshape(-1, 3)
    squared = np.einsum("ni,ni->n", points, points)
    farthest_m = _BEYOND * params.max_range_m
    points = points[(squared >= params.min_range_m**2) & (squared <= farthest_m**2)]  # NaN is in neither
    half = 1 << (_BITS - 1)
    x, y, z = np.rint(points.T * 1000).astype(np.int64) + half
    keys = np.sort((x << 2 * _BITS) | (y << _BITS) | z)
    mask = (1 << _BITS) - 1
    return (np.stack([keys >> 2 * _BITS, (keys >> _BITS) & mask, keys & mask], axis=-1) - half) / 1000


# --- ground -----------------------------------------------------------------------------------------------------------


def _above_ground(points: FloatArray, params: SegmentationParams) -> FloatArray:
    """Returns points (N, 3) along axes that lie in the ground's plane and stand on it; z counts from the ground."""
    plane = _ground_plane(points, params)
    if plane is None:
        return points - (0.0, 0.0, points[:, 2].min(initial=np.inf)) + (0.0, 0.0, params.min_height_m)
    level = plane.level(points)
    level[:, 2] -= _profile(level, params)
    return level


@dataclass(frozen=True, eq=False)
class _Plane:
    """The ground as a plane, z = offset + slopes . (x, y), in the sensor's frame."""

    offset_m: float
    slopes: FloatArray  # (2,)

    def above(self, points: FloatArray) -> FloatArray:
        """Returns how far (N,) points lie above the plane along z."""
        height: FloatArray = (
            points[:, 2] - self.offset_m - points[:, 0] * self.slopes[0] - points[:, 1] * self.slopes[1]
        )
        return height

    def level(self, points: FloatArray) -> FloatArray:
        """Returns points (N, 3) along axes of the plane: ahead, left, up; the origin is below the sensor."""
        up = np.array([-self.slopes[0], -self.slopes[1], 1.0])
        ahead = np.array([1.0, 0.0, self.slopes[0]])
        up, ahead = up / np.sqrt(up @ up), ahead / np.sqrt(ahead @ ahead)
        left = np.cross(up, ahead)
        foot = up * self.offset_m * up[2]  # the plane's nearest point to the sensor
        levelled: FloatArray = np.einsum("ni,ji->nj", points - foot, np.stack([ahead, left, up]))
        return levelled


def _ground_plane(points: FloatArray, params: SegmentationParams) -> _Plane | None:
    """Returns the plane that most of the lowest points lie on and few below; None without a likely one.

    RANSAC (Fischler and Bolles 1981) among the lowest points of polar cells, then least squares over all points near
    the best trial.
    """
    seeds = _lowest_points(points, params)
    if len(seeds) < _LEAST_VOTES:
        return None
    trials = seeds[np.random.default_rng(0).integers(0, len(seeds), (_TRIALS, 3))]  # (T, 3 points, 3)
    offsets, slopes = _planes_through(trials)
    steepest = np.tan(np.radians(params.max_tilt_deg))
    likely = (-offsets >= params.min_sensor_height_m) & (-offsets <= params.max_sensor_height_m)
    likely &= np.hypot(slopes[:, 0], slopes[:, 1]) <= steepest
    if not likely.any():
        return None
    offsets, slopes = offsets[likely], slopes[likely]
    above = seeds[:, 2] - offsets[:, None]  # (T, seeds)
    for axis in (0, 1):
        above -= slopes[:, axis, None] * seeds[:, axis]
    tolerance = params.ground_tolerance_m
    votes = (np.abs(above) < tolerance).sum(axis=1) - (above < -2 * tolerance).sum(axis=1)
    best = int(votes.argmax())
    if votes[best] < _LEAST_VOTES:
        return None
    plane = _Plane(float(offsets[best]), slopes[best])
    for _ in range(2):
        ground = points[np.abs(plane.above(points)) < tolerance]
        x, y, z = ground.T.copy()
        columns = (np.ones_like(x), x, y)
        # Sums, not `@`: BLAS's threads would show in the last bits.
        normal = np.array([[(a * b).sum() for b in columns] for a in columns])
        fit = np.linalg.lstsq(normal, np.array([(a * z).sum() for a in columns]), rcond=1e-9)[0]
        plane = _Plane(float(fit[0]), fit[1:])
    return plane


def _lowest_points(points: FloatArray, params: SegmentationParams) -> FloatArray:
    """Returns the lowest point of each cell of 10 degrees by 1 m that has any, sorted by cell."""
    bins = int(_BEYOND * params.max_range_m / _SEED_BIN_M) + 1
    ranges = np.hypot(points[:, 0], points[:, 1])
    cell = _degrees(points).astype(np.int64) // _PARTS * bins + (ranges / _SEED_BIN_M).astype(np.int64)
    lowest = np.full(_SECTORS * bins, np.inf)
    np.minimum.at(lowest, cell, points[:, 2])
    rows = np.flatnonzero(points[:, 2] == lowest[cell])
    return points[rows[np.unique(cell[rows], return_index=True)[1]]]


def _degrees(places: FloatArray) -> FloatArray:
    """Returns in which direction each place (N, 2 or more) lies, 0 to less than 360."""
    degrees: FloatArray = (np.degrees(np.arctan2(places[:, 1], places[:, 0])) + 180.0) % 360.0
    return degrees


def _planes_through(triples: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns offsets (T,) and slopes (T, 2) of the planes through three points (T, 3, 3); NaN for those in line."""
    a, b = triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = np.where(np.abs(area) > 1e-6, area, np.nan)
    slopes = np.stack([a[:, 2] * b[:, 1] - a[:, 1] * b[:, 2], a[:, 0] * b[:, 2] - a[:, 2] * b[:, 0]], axis=-1)
    slopes /= area[:, None]
    return triples[:, 0, 2] - (slopes * triples[:, 0, :2]).sum(axis=1), slopes


def _profile(level: FloatArray, params: SegmentationParams) -> FloatArray:
    """Returns the ground's height (N,) over its plane under each point (N, 3).

    Each sector is walked outwards, 2 m at a time, looking at 6: points near to where its ground was last are ground if
    they are spread wider than people are. In between it is interpolated; beyond, it stays as it was.
    """
    bins = int(_BEYOND * params.max_range_m / _PROFILE_BIN_M) + 1
    ranges, heights = np.hypot(level[:, 0], level[:, 1]), level[:, 2]
    bin_ = np.minimum(ranges / _PROFILE_BIN_M, bins - 1).astype(np.int16)
    direction = _degrees(level)
    degree = direction.astype(np.int64)
    order = np.argsort(bin_, kind="stable")
    starts = np.searchsorted(bin_[order], np.arange(bins + 1))

    height, distance = np.zeros(_SECTORS), np.zeros(_SECTORS)  # where each sector's ground was last, and how far out
    steps = [(distance, height)]
    for k in range(bins):
        rows = order[starts[max(k - 1, 0)] : starts[min(k + 2, bins)]]
        sector = degree[rows] // _PARTS
        out_m = (k + 0.5) * _PROFILE_BIN_M
        reach = params.ground_tolerance_m + params.ground_slope * (out_m - distance)
        near = np.abs(heights[rows] - height[sector]) < reach[sector]
        rows, sector = rows[near], sector[near]
        count = np.maximum(np.bincount(sector, minlength=_SECTORS), 1)
        covered = np.zeros((_SECTORS, _PARTS), bool)
        covered.flat[degree[rows]] = True
        is_ground = covered.sum(axis=1) >= min(np.degrees(params.ground_width_m / out_m), _PARTS / 2)
        height = np.where(is_ground, np.bincount(sector, heights[rows], _SECTORS) / count, height)
        new = np.maximum(np.bincount(sector, ranges[rows], _SECTORS) / count, distance)
        distance = np.where(is_ground, new, distance)
        steps.append((distance, height))
    edges = np.arange(bins + 1) * _PROFILE_BIN_M
    walked = np.array(steps)  # (steps, 2, S)
    ground = np.stack([np.interp(edges, *walked[:, :, sector].T) for sector in range(_SECTORS)])
    ground = (np.roll(ground, 1, axis=0) + 2 * ground + np.roll(ground, -1, axis=0)) / 4
    # Between the middles of four cells: a road that falls off to the side has no steps.
    turn = direction / _PARTS - 0.5
    left = np.floor(turn).astype(np.int64)
    across, out = turn - left, ranges / _PROFILE_BIN_M - bin_
    near, far = (
        ground[left % _SECTORS, edge] * (1 - across) + ground[(left + 1) % _SECTORS, edge] * across
        for edge in (bin_, bin_ + 1)
    )
    under: FloatArray = near * (1 - out) + far * out
    return under


# --- clusters ---------------------------------------------------------------------------------------------------------


def _linked(level: FloatArray, params: SegmentationParams) -> IntArray:
    """Returns a label (N,), from 0, per point (N, 3): those of one thing share it.

    Points that are one above the other, without too large a gap, are one node. Two nodes are linked if one lies in an
    ellipse around the other, longer along the line of sight, where ranges scatter, than across it, where bearings are
    exact, and if no large gap parts them up and down.
    """
    if len(level) == 0:
        return np.zeros(0, np.int64)
    x, y = np.floor(level[:, :2] / _SAME_M).astype(np.int64).T
    column = (x << 32) + y
    order = np.lexsort((level[:, 2], column))
    gap = params.link_up_m + params.link_up_per_m * np.hypot(level[order, 0], level[order, 1])
    begins = (np.diff(column[order], prepend=column[order[0]] - 1) != 0) | (
        np.diff(level[order, 2], prepend=level[order[0], 2]) > gap
    )
    first = np.flatnonzero(begins)
    last = np.append(first[1:], len(level)) - 1
    nodes = np.add.reduceat(level[order, :2], first) / (last - first + 1)[:, None]
    low, high = level[order[first], 2], level[order[last], 2]

    pairs = [_near_pairs(nodes, low, high, *band, params) for band in pairwise(_BANDS_M)]
    i, j = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(i), bool), (i, j)), shape=(len(nodes), len(nodes)))
    labels = np.empty(len(level), np.int64)
    labels[order] = connected_components(graph, directed=False)[1][np.cumsum(begins) - 1]
    return labels


def _near_pairs(
    nodes: FloatArray, low: FloatArray, high: FloatArray, from_m: float, to_m: float, params: SegmentationParams
) -> IntArray:
    """Returns the pairs (2, P) of linked nodes (N, 2) of which one or both lie in a band of ranges.

    low, high: (N,) where the nodes begin and end above the ground. Band by band, since far away one looks far around.
    """
    ranges = np.hypot(nodes[:, 0], nodes[:, 1])
    farthest_m = min(to_m, params.max_range_m)
    reach = max(
        params.link_along_m + params.link_along_per_m * farthest_m,
        params.link_across_m + params.link_across_per_m * farthest_m,
    )
    rows = np.flatnonzero((ranges >= from_m - reach) & (ranges < to_m))
    if len(rows) < 2:
        return np.zeros((2, 0), np.int64)
    i, j = rows[cKDTree(nodes[rows]).query_pairs(reach, output_type="ndarray")].T
    (x, y), (to_x, to_y) = (nodes[i] + nodes[j]).T / 2, (nodes[j] - nodes[i]).T
    distance = np.maximum(np.hypot(x, y), 1e-3)
    along = (to_x * x + to_y * y) / distance / (params.link_along_m + params.link_along_per_m * distance)
    across = (to_y * x - to_x * y) / distance / (params.link_across_m + params.link_across_per_m * distance)
    apart_up = np.maximum(low[i], low[j]) - np.minimum(high[i], high[j])
    linked = (along * along + across * across <= 1) & (apart_up <= params.link_up_m + params.link_up_per_m * distance)
    return np.stack([i[linked], j[linked]])


def _people_apart(level: FloatArray, labels: IntArray, params: SegmentationParams) -> IntArray:
    """Returns labels (N,) in which a row of people who touch has one for each of them."""
    low, high, counts = _bounds(level, labels)
    size = high - low
    length = np.hypot(size[:, 0], size[:, 1])
    rows = np.flatnonzero(
        (length > params.person_width_m + params.closest_people_m / 2)
        & (length <= params.max_row_m)
        & (size[:, 2] <= params.max_person_m)
        & (counts >= 2 * params.min_points)
    )
    order = np.argsort(labels, kind="stable")
    ends = np.cumsum(counts)
    labels, following = labels.copy(), len(counts)
    for row in rows:
        points = order[ends[row] - counts[row] : ends[row]]
        person = _person_in_row(level[points, :2], params)
        labels[points[person > 0]] = following - 1 + person[person > 0]
        following += int(person.max())
    return labels


def _person_in_row(places: FloatArray, params: SegmentationParams) -> IntArray:
    """Returns which person of a row, from 0, each place (N, 2) is of; all are 0 where one body is as good a reason.

    People in a row are seen as half ellipses side by side, each at a distance of its own; one body, a bush or a car's
    end, as a parabola. The Bayesian information criterion tells how many people there are, if any.
    """
    N, half = len(places), params.person_width_m / 2
    middle, ranges = places.mean(axis=0), np.hypot(places[:, 0], places[:, 1])
    bearings = np.arctan2(places[:, 1] * middle[0] - places[:, 0] * middle[1], places @ middle)
    across = bearings * ranges.mean()
    left, right = across.min() + half, across.max() - half  # the outermost people's middles
    parabola = np.vander(across, 3)
    rest = ranges - parabola @ np.linalg.lstsq(parabola, ranges, rcond=None)[0]
    person = np.zeros(N, np.int64)
    least = _bic(rest, 3) - params.row_evidence
    for people in range(2, int((right - left) / params.closest_people_m + 0.5) + 2):
        middles = np.linspace(left, right, people)
        nearest = np.abs(across[:, None] - middles).argmin(axis=1)
        aside = np.minimum(np.abs(across - middles[nearest]) / half, 1.0)
        rest = ranges - params.person_depth_m * (1 - np.sqrt(1 - aside * aside))
        counts = np.bincount(nearest, minlength=people)
        rest = rest - (np.bincount(nearest, rest, people) / np.maximum(counts, 1))[nearest]
        score = _bic(rest, people)
        if score < least and counts.min() >= params.min_points:
            person, least = nearest, score
    return person


def _bic(rest_m: FloatArray, parameters: int) -> float:
    """Returns the Bayesian information criterion of a fit that leaves residuals (N,) of unknown variance."""
    N = len(rest_m)
    return float(N * np.log(np.einsum("n,n->", rest_m, rest_m) / N + _ROUGHNESS_M2) + parameters * np.log(N))


def _bounds(values: FloatArray, labels: IntArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Returns the smallest and the largest of values (N, D) per label, (M, D) each, and how many (M,) there are.

    Labels (N,) are 0 to M - 1, and each occurs.
    """
    if len(labels) == 0:
        return np.zeros((0, values.shape[1])), np.zeros((0, values.shape[1])), np.zeros(0, np.int64)
    counts = np.bincount(labels)
    ordered, starts = values[np.argsort(labels, kind="stable")], np.cumsum(counts) - counts
    return np.minimum.reduceat(ordered, starts), np.maximum.reduceat(ordered, starts), counts


def _wanted(level: FloatArray, labels: IntArray, params: SegmentationParams) -> BoolArray:
    """Marks the labels (M,) that have neither too few points nor too many, stand on the ground and are not too long."""
    low, high, counts = _bounds(level, labels)
    wanted: BoolArray = (counts >= params.min_points) & (counts <= params.max_points)
    wanted &= low[:, 2] <= params.max_base_m
    wanted &= np.hypot(high[:, 0] - low[:, 0], high[:, 1] - low[:, 1]) <= params.max_extent_m
    return wanted


def _clusters(cloud: PointCloud, points: FloatArray, labels: IntArray, wanted: BoolArray) -> LidarClusters:
    """Returns the wanted clusters of labelled points (N, 3), sorted by bearing."""
    low, high, counts = _bounds(points, labels)
    sums = np.stack([np.bincount(labels, axis, len(counts)) for axis in points.T], axis=-1)
    # The mean of equal numbers may be off by a bit; a centroid lies within its points.
    centroids = np.clip(sums / counts[:, None], low, high)[wanted]
    order = np.lexsort((*centroids.T, np.arctan2(centroids[:, 1], centroids[:, 0])))
    return LidarClusters(
        cloud.stamp_ns, cloud.frame_id, centroids[order], (high - low)[wanted][order], counts[wanted][order]
    )
