"""The vehicle's corridor, and how probably and when pedestrians enter it.

The corridor at a time t is what the vehicle's footprint, widened by a margin, sweeps from t until the horizon: what the
vehicle has left behind no longer counts. Somebody "enters" it by being there, no matter whether the vehicle arrives
before they have left: that is whom a driver slows down for. Who walks behind a vehicle does not enter it.

Each pedestrian's future is a set of whole trajectories, since one step's mixture does not say where somebody came from:
every modal path, spread by the mixture around it. A trajectory is off its path by the same standard-normal amounts at
every step, so that somebody who is ahead or to the left stays so. The amounts are 64 fixed points, equal from call to
call. Between steps trajectories are straight and the vehicle's speed is constant.

The corridor is a union of pieces, each a rectangle; a straight drive is one, however its speed changes. In curves a
piece turns by 0.15 rad at most and leaves out, or has too much of, 0.2 m at a corner.
"""

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from schemas.messages import FloatArray, VehiclePath

MARGIN_M = 0.3  # a pedestrian's radius: whose middle is this near is touched
SAMPLES = 64  # trajectories around each modal path; a power of 2
_TURN_RAD = 0.15  # of a piece, from its first pose to its last
_SAG_M = 0.1  # how far an arc may lie beside the straight piece that stands for it
_SIDEWAYS_M = 0.2  # how far a vehicle may slip sideways within a piece
_FINE_S = 0.1  # poses are this far apart, at most, when pieces are cut


@dataclass(frozen=True, eq=False)
class Futures:
    """What may become of A pedestrians, as predicted: L modal paths within a mixture of K components at P steps."""

    places_m: FloatArray  # (A, 2)        where they are now,
    covariances_m2: FloatArray  # (A, 2, 2)     ... as well as that is known
    probabilities: FloatArray  # (A, L)        of the paths; 0 where there is none
    paths_m: FloatArray  # (A, L, P, 2)
    weights: FloatArray  # (A, P, K)
    means_m: FloatArray  # (A, P, K, 2)
    sigmas_m: FloatArray  # (A, P, K, 2)
    rhos: FloatArray  # (A, P, K)


@dataclass(frozen=True, eq=False)
class Corridor:
    """What a vehicle sweeps, as J pieces in which it hardly turns: rectangles whose rear ends follow the vehicle.

    In a piece's own frame, x along it, it is low_m[p] <= x <= high_m[p] and |y| <= half_width_m at step p; it is no
    more when the vehicle is in the next one. Places are in the frame of the vehicle's first pose.
    """

    origin_m: tuple[float, float]  # of that frame, in the odometry frame,
    axis: tuple[float, float]  # ... and its x axis, a unit vector
    dt_s: float
    starts_m: FloatArray  # (J, 2)      where the pieces begin
    axes: FloatArray  # (J, 2)      unit vectors along them
    low_m: FloatArray  # (J, P + 1)  rear ends, and
    high_m: FloatArray  # (J, P + 1)  ... front ends; backwards it is the front end that follows
    half_width_m: float
    end_steps: FloatArray  # (J,)        when the vehicle leaves each for the next; inf for the last

    def __len__(self) -> int:
        """Returns the number of pieces."""
        return len(self.starts_m)

    def boxes_m(self) -> FloatArray:
        """Returns left, right, bottom and top (4, J) of upright boxes around the pieces, which are longest at first."""
        low, high = self.axes * self.low_m[:, :1], self.axes * self.high_m[:, :1]  # (J, 2)
        half = self.half_width_m * np.abs(self.axes[:, ::-1])
        least, most = self.starts_m + np.minimum(low, high) - half, self.starts_m + np.maximum(low, high) + half
        return np.stack([least[:, 0], most[:, 0], least[:, 1], most[:, 1]])


def corridor_of(path: VehiclePath, dt_s: float, steps: int, margin_m: float = MARGIN_M) -> Corridor:
    """Returns the corridor of a vehicle that drives along a path, until the last of so many steps.

    Between its poses the path is straight. Before its first pose the vehicle stands there, after its last one likewise;
    what lies beyond the horizon does not count.
    """
    fine = max(1, round(dt_s / _FINE_S))
    times = np.arange(steps * fine + 1) * (dt_s / fine)  # (N,)
    yaws = np.interp(times, path.times_s, _yaws(path))
    c, s = math.cos(yaws[0]), math.sin(yaws[0])
    yaws = yaws - yaws[0]
    x, y = (np.interp(times, path.times_s, path.poses[:, i]) for i in range(2))
    origin = x[0], y[0]
    x, y = x - x[0], y - y[0]
    x, y = c * x + s * y, c * y - s * x

    moved_x, moved_y = x[1:] - x[:-1], y[1:] - y[:-1]  # (N-1,)
    middle = (yaws[1:] + yaws[:-1]) / 2
    cos, sin = np.cos(middle), np.sin(middle)
    driven = np.zeros(len(times))
    np.hypot(moved_x, moved_y).cumsum(out=driven[1:])
    ends = _cuts(np.abs(yaws[1:] - yaws[:-1]), moved_y * cos - moved_x * sin, moved_x * cos + moved_y * sin, driven[-1])
    nodes, first = np.arange(0, len(times), fine), np.array([0, *ends[:-1]])
    last = np.array(ends)
    yaw = (yaws[first] + yaws[last]) / 2
    axes = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)  # (J, 2)
    at = np.minimum(np.maximum(nodes, first[:, None]), last[:, None])  # (J, P + 1)
    starts = np.stack([x[first], y[first]], axis=1)
    a, b = axes.T[..., None]
    # as far as the vehicle has come along a piece, and on at its speed when it has left it between two steps
    place = a * (x[at] - starts[:, :1]) + b * (y[at] - starts[:, 1:])  # (J, P + 1)
    end = a * (x[last] - x[first])[:, None] + b * (y[last] - y[first])[:, None]  # (J, 1)
    place += np.copysign(np.maximum(driven[nodes] - driven[last, None], 0), end)
    low, high = np.where(end >= 0, place, end), np.where(end >= 0, end, place)
    until = last / fine
    until[-1] = np.inf
    return Corridor(
        origin_m=(float(origin[0]), float(origin[1])),
        axis=(c, s),
        dt_s=dt_s,
        starts_m=starts,
        axes=axes,
        low_m=low - (path.rear_m + margin_m),
        high_m=high + (path.front_m + margin_m),
        half_width_m=path.width_m / 2 + margin_m,
        end_steps=until,
    )


def footprints(path: VehiclePath, horizon_s: float, margin_m: float = MARGIN_M, count: int = 49) -> FloatArray:
    """Returns the vehicle's widened outlines (count, 4, 2), evenly in time until the horizon: a corridor to draw."""
    times_s = np.linspace(0, horizon_s, count)
    x, y, yaw = (np.interp(times_s, path.times_s, column) for column in (*path.poses[:, :2].T, _yaws(path)))
    front, back, side = path.front_m + margin_m, -path.rear_m - margin_m, path.width_m / 2 + margin_m
    corners = np.array([(back, -side), (front, -side), (front, side), (back, side)])  # (4, 2)
    c, s = np.cos(yaw), np.sin(yaw)
    turned = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)  # (N, 2, 2)
    return np.asarray(corners @ turned.swapaxes(1, 2) + np.column_stack([x, y])[:, None])


def _yaws(path: VehiclePath) -> FloatArray:
    """Returns the path's yaws (S,) without jumps of 2 pi."""
    yaws = path.poses[:, 2]
    jumps = len(yaws) > 1 and np.abs(yaws[1:] - yaws[:-1]).max() > np.pi
    return np.unwrap(yaws) if jumps else yaws  # unwrap takes longer than all the rest


def _cuts(turned: FloatArray, sideways: FloatArray, along: FloatArray, length_m: float) -> list[int]:
    """(N-1,) rad, m, m between poses -> the pose at which each piece ends, rising; the last one is N - 1."""
    total = float(turned.sum())
    pieces = max(total / _TURN_RAD, np.sqrt(length_m * total / (8 * _SAG_M)))  # an arc's sagitta: length turn / 8
    bent = np.abs(sideways) / _SIDEWAYS_M
    if total > 0:
        bent += turned * (pieces / total)
    direction = np.sign(along) * (np.abs(along) > 1e-6)
    moving = np.flatnonzero(direction)
    turns_back = moving[1:][direction[moving[1:]] != direction[moving[:-1]]]
    bent[turns_back] += 1
    if bent.sum() <= 1 and len(turns_back) == 0:
        return [len(turned)]
    piece = np.floor(np.cumsum(bent) - 1e-9)
    return [*(np.flatnonzero(np.diff(piece) > 0) + 1).tolist(), len(turned)]


def entries(corridor: Corridor, futures: Futures) -> tuple[FloatArray, FloatArray]:
    """Returns how probably each of A pedestrians enters the corridor by the horizon (A,), and when, if so (A,) in s.

    The time is 0 for who is inside already, and NaN where the probability is 0.
    """
    A = len(futures.probabilities)
    real = futures.probabilities > 0  # (A, L)
    owner, share = np.nonzero(real)[0], futures.probabilities[real] / SAMPLES  # (R,)
    nodes, roots = _spread(corridor, futures)  # (2, A, L, P + 1), (3, A, L, P + 1)
    first_s = _first_entries(corridor, _steps_first(nodes[:, real]), _steps_first(roots[:, real]))  # (R, Q)
    entered = np.isfinite(first_s)
    probability = np.bincount(owner, share * entered.sum(axis=1), A)
    total_s = np.bincount(owner, share * np.where(entered, first_s, 0).sum(axis=1), A)
    with np.errstate(invalid="ignore"):
        return np.minimum(probability, 1), total_s / probability


def _spread(corridor: Corridor, futures: Futures) -> tuple[FloatArray, FloatArray]:
    """Returns the modal paths of A pedestrians from now on, and how far off them trajectories are, in float32.

    Every component of a step belongs to the paths near it, the nearer the more. Around a path, the components that
    belong to it have a covariance, differences of their means from the path included; with one path it is that of the
    whole mixture.

    Returns:
        nodes (2, A, L, P + 1) in m, in the corridor's frame, and symmetric square roots of the covariances: xx, xy and
        yy (3, A, L, P + 1) in m.
    """
    c, s = corridor.axis
    A, L, P, _ = futures.paths_m.shape
    places = np.empty((2, A, L, P + 1))
    places[..., 0] = futures.places_m.T[..., None]
    places[..., 1:] = futures.paths_m.transpose(3, 0, 1, 2)
    x, y = places[0] - corridor.origin_m[0], places[1] - corridor.origin_m[1]
    nodes = np.empty((2, A, L, P + 1), np.float32)
    nodes[0], nodes[1] = c * x + s * y, c * y - s * x

    off_x, off_y = (futures.means_m.transpose(3, 0, 1, 2)[:, :, None] - places[..., 1:, None]).astype(np.float32)
    sigma_x, sigma_y = futures.sigmas_m[..., 0], futures.sigmas_m[..., 1]  # (A, P, K)
    xx, xy, yy = sigma_x**2, futures.rhos * sigma_x * sigma_y, sigma_y**2
    share = futures.weights[:, None]  # (A, 1 or L, P, K)
    if L > 1:
        apart = (off_x**2 + off_y**2) / (xx + yy)[:, None]
        apart[futures.probabilities == 0] = np.inf
        near = np.exp(apart.min(axis=1, keepdims=True) - apart)
        share = share * (near / near.sum(axis=1, keepdims=True) + _EVERYWHERE)
    share = share / share.sum(axis=-1, keepdims=True)

    around = np.empty((3, A, L, P + 1), np.float32)
    around[..., 0] = futures.covariances_m2[:, [0, 0, 1], [0, 1, 1]].T[..., None]
    for i, (own, between) in enumerate(((xx, off_x * off_x), (xy, off_x * off_y), (yy, off_y * off_y))):
        around[i, ..., 1:] = np.einsum("alpk,alpk->alp", share, own[:, None] + between)
    xx, xy, yy = around
    turned = c * c * xx + 2 * c * s * xy + s * s * yy, (c * c - s * s) * xy + c * s * (yy - xx)
    return nodes, _square_root(turned[0], turned[1], xx + yy - turned[0])


def _square_root(xx: FloatArray, xy: FloatArray, yy: FloatArray) -> FloatArray:
    """Returns xx, xy and yy (3, ...) of the symmetric square roots of covariances (...)."""
    root_det = np.sqrt(np.maximum(xx * yy - xy * xy, 0))
    scale = 1 / np.sqrt(np.maximum(xx + yy + 2 * root_det, 1e-12))
    roots = np.empty((3, *xx.shape), xx.dtype)
    roots[0], roots[1], roots[2] = (xx + root_det) * scale, xy * scale, (yy + root_det) * scale
    return roots


def _first_entries(corridor: Corridor, nodes: FloatArray, roots: FloatArray) -> FloatArray:
    """(2, P + 1, R), (3, P + 1, R) -> (R, Q): when each trajectory is first in the corridor, in s; inf: never."""
    first = np.full((nodes.shape[2], SAMPLES), np.inf, np.float32)
    x, y = nodes
    xx, xy, yy = roots
    reach_x, reach_y = _FARTHEST * np.hypot(xx, xy), _FARTHEST * np.hypot(xy, yy)
    left, right, bottom, top = corridor.boxes_m()[..., None]  # (J, 1)
    meet = ((x + reach_x).max(axis=0) >= left) & ((x - reach_x).min(axis=0) <= right)  # (J, R)
    meet &= ((y + reach_y).max(axis=0) >= bottom) & ((y - reach_y).min(axis=0) <= top)
    piece, row = np.nonzero(meet)  # M pairs of a piece and a path
    if len(row) == 0:
        return first

    # in the pieces' own frames (P + 1, M): the paths, and how far off them a trajectory is by each of its two amounts
    a, b = corridor.axes.astype(np.float32)[piece].T
    start_x, start_y = corridor.starts_m.astype(np.float32)[piece].T
    low, high = corridor.low_m.astype(np.float32)[piece].T, corridor.high_m.astype(np.float32)[piece].T
    off_x, off_y = x[:, row] - start_x, y[:, row] - start_y
    along, across = a * off_x + b * off_y, a * off_y - b * off_x
    xx, xy, yy = roots[:, :, row]
    along_by, across_by = (a * xx + b * xy, a * xy + b * yy), (a * xy - b * xx, a * yy - b * xy)

    # N steps of pairs in which some trajectory may be inside: all of a path's lie within _FARTHEST amounts of it
    end = corridor.end_steps[piece]
    half = corridor.half_width_m
    reach, side = _FARTHEST * np.hypot(*along_by), _FARTHEST * np.hypot(*across_by)
    lengthwise = (_larger(along + reach) >= _smaller(low)) & (_smaller(along - reach) <= _larger(high))  # (P, M)
    sideways = (_larger(across + side) >= -half) & (_smaller(across - side) <= half)
    step, pair = np.nonzero(lengthwise & sideways & (np.arange(len(low) - 1)[:, None] <= end))
    ends = np.stack([step, step + 1]), pair  # of the steps (2, N)

    def trajectories(middle: FloatArray, by: tuple[FloatArray, FloatArray]) -> FloatArray:
        by_first, by_second = (amount[ends][..., None] for amount in by)
        return np.asarray(middle[ends][..., None] + by_first * _NORMAL[0] + by_second * _NORMAL[1])  # (2, N, Q)

    fraction = _entered(
        trajectories(along, along_by), trajectories(across, across_by), low[ends][..., None], high[ends][..., None],
        half, (end[pair] - step)[:, None],
    )  # fmt: skip
    whose = row[pair]
    order = np.argsort(whose, kind="stable")
    starts = np.flatnonzero(np.diff(whose[order], prepend=-1))
    if len(starts):  # quicker than np.minimum.at
        first[whose[order[starts]]] = np.minimum.reduceat((step[:, None] + fraction)[order], starts)
    return first * np.float32(corridor.dt_s)


def _entered(
    x: FloatArray, y: FloatArray, low: FloatArray, high: FloatArray, half: float, last: FloatArray
) -> FloatArray:
    """(2, N, Q) or such that give it, (N, 1) -> (N, Q): at which part of a step a trajectory enters a piece; inf: not.

    The first axis is the step's begin and end; between them everything moves evenly, so a trajectory is on the inner
    side of each of the four edges during one interval, and inside during what these have in common (Liang and Barsky
    1984, with moving edges). The piece is there until the part `last` of the step.
    """
    before, after = np.stack([x - low, high - x, y + half, half - y], axis=1)  # (4, N, Q)  m
    outside, leaves = before < 0, after < 0
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = before / (before - after)
    enter = np.where(outside, np.where(leaves, np.inf, crossing), 0).max(axis=0)
    leave = np.where(leaves, np.where(outside, -np.inf, crossing), 1).min(axis=0)
    return np.where(enter <= np.minimum(leave, last), enter, np.inf)


def _larger(nodes: FloatArray) -> FloatArray:
    """(P + 1, ...) -> (P, ...): the larger end of each step."""
    return np.maximum(nodes[1:], nodes[:-1])


def _smaller(nodes: FloatArray) -> FloatArray:
    """(P + 1, ...) -> (P, ...): the smaller end of each step."""
    return np.minimum(nodes[1:], nodes[:-1])


def _steps_first(array: FloatArray) -> FloatArray:
    """(C, R, P + 1) -> (C, P + 1, R): numpy's minima over a short last axis are slow."""
    return np.ascontiguousarray(array.transpose(0, 2, 1))


def _normal_points(count: int) -> FloatArray:
    """Returns quasi-random standard-normal points (2, count): Hammersley's set, brought to mean 0 and variance 1."""
    bits = count.bit_length() - 1
    reversed_bits = [int(f"{i:0{bits}b}"[::-1], 2) for i in range(count)]
    uniform = (np.array([range(count), reversed_bits]) + 0.5) / count
    normal = np.vectorize(NormalDist().inv_cdf)(uniform)
    return np.asarray(normal / normal.std(axis=1, keepdims=True))


_NORMAL = _normal_points(SAMPLES).astype(np.float32)  # (2, Q)
_FARTHEST = float(np.hypot(*_NORMAL).max())
_EVERYWHERE = np.float32(1e-6)  # of a component's weight: a path that no component is nearest to has one all the same
