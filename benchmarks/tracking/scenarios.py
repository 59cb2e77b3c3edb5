"""What the trackers are compared on: a crowd of N people, and the two examples of Vo and Ma (2006), section IV-A.

Every scenario is made of a seed: the same arguments give the same truth and the same measurements. Nothing may be
tuned on the reported seeds.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from schemas.messages import BoolArray, FloatArray, IntArray

TUNING_SEEDS = (0, 1, 2, 3)
REPORT_SEEDS = tuple(range(400, 410))
PAIRED_SHARE = 1 / 3  # of the people of a crowd
PAIR_GAP_M = 0.65
_SETTLING_STEPS = 20  # a crowd walks for so long before the first scan


@dataclass(frozen=True)
class Sensor:
    """How a scenario is measured, and what every tracker is told of it."""

    half_m: float  # x and y of what is measured lie between -half_m and half_m
    dt_s: float
    p_detect: float
    sigma_m: float  # of a position, per axis
    clutter: float  # mean false measurements per scan, uniform over the region
    cutoff_m: float  # of OSPA, OSPA(2) and GOSPA

    @property
    def clutter_per_m2(self) -> float:
        """Mean false measurements per scan and square metre."""
        return self.clutter / (2 * self.half_m) ** 2


CROWD = Sensor(half_m=30.0, dt_s=0.1, p_detect=0.9, sigma_m=0.15, clutter=5.0, cutoff_m=2.0)
DENSE_CLUTTER = replace(CROWD, clutter=20.0)
VO_MA = Sensor(half_m=1000.0, dt_s=1.0, p_detect=0.98, sigma_m=10.0, clutter=50.0, cutoff_m=100.0)


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan with its truth."""

    stamp_ns: int
    ids: IntArray  # (A,)
    truth_m: FloatArray  # (A, 2)
    measured_m: FloatArray  # (M, 2)  in no order


Truth = tuple[IntArray, FloatArray]  # ids (A,) and positions (A, 2) in m


def measure(truth: Iterable[Truth], sensor: Sensor, generator: np.random.Generator) -> list[Scan]:
    """Returns a scan of each truth: some are missed, all are noisy, and clutter is added."""
    scans = []
    for k, (ids, positions) in enumerate(truth, start=1):
        seen = positions[generator.random(len(ids)) < sensor.p_detect]
        noisy = seen + generator.normal(0, sensor.sigma_m, seen.shape)
        clutter = generator.uniform(-sensor.half_m, sensor.half_m, (generator.poisson(sensor.clutter), 2))
        measured = generator.permutation(np.concatenate([noisy, clutter]))
        scans.append(Scan(round(k * sensor.dt_s * 1e9), ids, positions, measured))
    return scans


# --- Vo and Ma --------------------------------------------------------------------------------------------------------

# Birth step, position (m) and velocity (m/s), read off the paper's figure 1: the first two cross at k = 53, the third
# is spawned by the first at k = 66.
_STARTS = (
    (1, (250.0, 250.0), (2.5, -12.0)),
    (1, (-250.0, -250.0), (12.0, -2.5)),
    (66, (412.5, -530.0), (-18.0, -6.0)),
)


def vo_ma(scans: int, seed: int, *, spawning: bool) -> list[Scan]:
    """Returns "The Gaussian Mixture Probability Hypothesis Density Filter" (2006), IV-A: example 1, or 2 with spawning.

    Straight lines, as in the paper; only the filters believe in process noise (5 m/s^2).
    """
    starts = _STARTS if spawning else _STARTS[:2]

    def truth() -> Iterator[Truth]:
        for k in range(1, scans + 1):
            alive = [i for i, (birth, _, _) in enumerate(starts) if birth <= k]
            places = [np.array(starts[i][1]) + (k - starts[i][0]) * np.array(starts[i][2]) for i in alive]
            yield np.array(alive), np.array(places)

    return measure(truth(), VO_MA, np.random.default_rng([seed, int(spawning)]))


# --- crowd ------------------------------------------------------------------------------------------------------------


def crowd(N: int, scans: int, seed: int, sensor: Sensor = CROWD) -> list[Scan]:
    """Returns scans of N people in the sensor's square.

    They walk to random places around each other, sometimes stop, leave at the border and are replaced there. A third
    walk in pairs, side by side.
    """
    return measure(walk(N, scans, seed, sensor), sensor, np.random.default_rng([seed, N, round(sensor.clutter)]))


def walk(N: int, steps: int, seed: int, sensor: Sensor = CROWD) -> Iterator[Truth]:
    """Yields the crowd's truth; persons 0 to P - 1 lead the pairs, persons P to 2 P - 1 walk beside them."""
    generator = np.random.default_rng([seed, N])
    half, dt = sensor.half_m, sensor.dt_s
    P = round(N * PAIRED_SHARE / 2)
    leaders, followers = np.arange(P), np.arange(P, 2 * P)
    paired = np.zeros((N, N), bool)
    paired[leaders, followers] = paired[followers, leaders] = True

    ids, next_id = np.arange(N), N
    position, goal = generator.uniform(-half, half, (2, N, 2))
    speed = np.clip(generator.normal(1.3, 0.3, N), 0.4, 2.2)
    velocity, pause = np.zeros((N, 2)), np.zeros(N)
    heading = _unit(goal - position)
    position[followers] = _beside(position[leaders], heading[leaders])
    for step in range(_SETTLING_STEPS + steps):
        distance = np.hypot(*(goal - position).T)
        desired = _unit(goal - position) * (speed * (pause <= 0))[:, None]
        # Whoever walks beside somebody stays on that side, keeps the pace, and makes up for being off in half a second.
        side = ((position[followers] - position[leaders]) * _right(heading[leaders])).sum(axis=1) >= 0
        slot = _beside(position[leaders], heading[leaders] * np.where(side, 1, -1)[:, None])
        desired[followers] = velocity[leaders] + (slot - position[followers]) / 0.5
        velocity = velocity + dt * ((desired - velocity) / 0.7 + _push(position, ~paired))
        velocity += generator.normal(0, 0.05, (N, 2))
        position = position + dt * velocity
        heading = _unit(heading + dt * velocity)  # turns within a second

        pause -= dt
        stops = (pause <= 0) & (generator.random(N) < dt / 60)
        pause = np.where(stops, generator.uniform(1, 5, N), pause)
        # Half of those who arrive go on elsewhere; the others walk out over the border.
        arrived = np.flatnonzero(distance < 1.0)
        goal[arrived] = generator.uniform(-half, half, (len(arrived), 2))
        leaving = arrived[generator.random(len(arrived)) < 0.5]
        goal[leaving] = np.sign(position[leaving]) * (half + 3)
        # A pair leaves when its leader does, and two others come in together.
        outside = (np.abs(position) > half).any(axis=1)
        outside[followers] = outside[leaders]
        gone = np.flatnonzero(outside)
        ids = ids.copy()
        ids[gone] = next_id + np.arange(len(gone))
        next_id += len(gone)
        position[gone] = _on_rim(len(gone), half - 0.1, generator)
        goal[gone] = generator.uniform(-half, half, (len(gone), 2))
        velocity[gone] = 0
        heading[gone] = _unit(goal[gone] - position[gone])
        new = followers[outside[followers]]
        position[new] = _beside(position[new - P], heading[new - P])
        if step >= _SETTLING_STEPS:
            yield ids, position.copy()


def _unit(vectors: FloatArray) -> FloatArray:
    return vectors / np.maximum(np.hypot(*vectors.T), 1e-6)[:, None]


def _right(headings: FloatArray) -> FloatArray:
    return np.stack([headings[:, 1], -headings[:, 0]], axis=1)


def _beside(positions: FloatArray, headings: FloatArray) -> FloatArray:
    """Returns the places (P, 2) to the right of people who head that way."""
    return positions + PAIR_GAP_M * _right(headings)


def _push(positions: FloatArray, strangers: BoolArray) -> FloatArray:
    """Returns the acceleration (N, 2) in m/s^2 away from strangers (N, N) who come near."""
    apart = positions[:, None] - positions[None]
    gap = np.hypot(apart[..., 0], apart[..., 1]) + 1e3 * np.eye(len(positions))
    return (apart / gap[..., None] * (2.0 * np.exp((0.5 - gap) / 0.3) * strangers)[..., None]).sum(axis=1)


def _on_rim(count: int, half_m: float, generator: np.random.Generator) -> FloatArray:
    """Returns places (count, 2) on the square's edge."""
    side, along = generator.integers(0, 4, count), generator.uniform(-half_m, half_m, count)
    rim = half_m * np.where(side % 2 == 0, 1, -1)
    return np.where((side < 2)[:, None], np.stack([rim, along], 1), np.stack([along, rim], 1))
