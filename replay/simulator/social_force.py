"""A crowd around a vehicle that drives through it: what a user without any data set gets.

Pedestrians follow a social force model (Helbing & Molnar 1995, "Social force model for pedestrian dynamics"): a pull
towards the desired velocity, and exponential repulsion from others, weaker from behind. Added here: pairs that walk
side by side, people who stand, fixtures to walk around, and a vehicle to make way for. The vehicle follows a winding
lane and slows down for whoever is in front of it. People who fall out of view come in again elsewhere as somebody
new, so that a drive may be of any length.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from replay.simulator.motion import Fixtures, Motion, People, Scene, SimulationError, VehicleState
from replay.simulator.surroundings import Lane, Surroundings
from schemas.messages import FloatArray, IntArray


@dataclass(frozen=True)
class CrowdSettings:
    """How the crowd and its vehicle behave."""

    step_s: float = 0.05
    warm_up_s: float = 4.0

    # Who there is.
    view_range_m: float = 30.0  # people come in here ...
    leave_range_m: float = 33.0  # ... and are replaced out here
    paired_share: float = 0.35
    pausing_share: float = 0.12  # of those present at the start or coming in
    walking_speed_mps: float = 1.3
    walking_speed_sd_mps: float = 0.22
    pause_every_s: float = 70.0
    pause_lasts_s: float = 10.0

    # Forces, in m/s^2 (people weigh nothing).
    relaxation_s: float = 0.6
    repulsion: float = 2.6
    repulsion_length_m: float = 0.38
    repulsion_range_m: float = 3.0  # where it is down to 4 mm/s^2
    contact_m: float = 0.5
    behind_weight: float = 0.25
    pair_distance_m: float = 0.7
    pair_pull: float = 3.0  # per m
    fixture_repulsion: float = 4.0
    fixture_length_m: float = 0.35
    vehicle_repulsion: float = 7.0
    vehicle_length_m: float = 0.6
    heading_drift: float = 0.08  # rad per root second
    jostle: float = 0.25
    fastest_mps: float = 2.4

    # The vehicle: reach of its body from base_link, and how it drives.
    vehicle_front_m: float = 1.9
    vehicle_back_m: float = 0.9
    vehicle_half_width_m: float = 0.7
    cruise_mps: float = 3.0
    comfortable_mps2: float = 1.0
    braking_mps2: float = 3.0
    stop_gap_m: float = 1.5
    corridor_m: float = 1.15  # half width of the lane that has to be free


@dataclass(frozen=True, eq=False)
class Crowd:
    """The state of the simulation. Pairs are the first 2 x `pairs` people, neighbours in the arrays."""

    time_s: float
    x_m: float  # of the vehicle, along the lane's axis
    speed_mps: float
    ids: IntArray  # (A,)
    positions_m: FloatArray  # (A, 2)
    velocities_mps: FloatArray  # (A, 2)
    headings_rad: FloatArray  # (A,)  where they want to go
    speeds_mps: FloatArray  # (A,)  how fast
    pause_until_s: FloatArray  # (A,)
    pairs: int
    next_id: int


def crowd_motion(pedestrians: int, duration_s: float, seed: int, settings: CrowdSettings | None = None) -> Motion:
    """Returns a drive through a crowd of `pedestrians` people, who stay about that many within 30 m all the time.

    The same arguments give the same motion. Raises SimulationError for a negative count or a duration not positive.
    """
    if pedestrians < 0:
        raise SimulationError(f"a crowd needs 0 or more pedestrians, got {pedestrians}")
    if not (math.isfinite(duration_s) and duration_s > 0):
        raise SimulationError(f"a drive needs a positive duration, got {duration_s} s")
    chosen = settings or CrowdSettings()
    return Motion("crowd", duration_s, lambda: _scenes(pedestrians, duration_s, seed, chosen))


def _scenes(pedestrians: int, duration_s: float, seed: int, settings: CrowdSettings) -> Iterator[Scene]:
    rng = np.random.default_rng([seed, 1])
    phases = rng.uniform(0, 2 * math.pi, 2)
    lane = Lane((7.0, 1.5), (90.0, 37.0), (float(phases[0]), float(phases[1])))
    crowd = _first_crowd(pedestrians, lane, settings, rng)
    surroundings = Surroundings(lane, seed)
    for _ in range(round(settings.warm_up_s / settings.step_s)):
        crowd = step(crowd, lane, surroundings.around(vehicle_state(crowd, lane).position_m), settings, rng)
    crowd = replace(crowd, time_s=0.0, pause_until_s=crowd.pause_until_s - crowd.time_s)
    for k in range(math.ceil(duration_s / settings.step_s - 1e-9) + 1):
        fixtures = surroundings.around(vehicle_state(crowd, lane).position_m)
        people = People(crowd.ids, crowd.positions_m, crowd.velocities_mps)
        yield Scene(k * settings.step_s, vehicle_state(crowd, lane), people, fixtures=fixtures)
        crowd = step(crowd, lane, fixtures, settings, rng)


def vehicle_state(crowd: Crowd, lane: Lane) -> VehicleState:
    """Returns the vehicle's state on its lane."""
    y, slope, bend = (float(value) for value in lane.at(crowd.x_m))
    yaw = math.atan(slope)
    heading = np.array([math.cos(yaw), math.sin(yaw)])
    curvature = bend / (1 + slope * slope) ** 1.5
    return VehicleState(np.array([crowd.x_m, y]), yaw, crowd.speed_mps * heading, crowd.speed_mps * curvature)


def step(crowd: Crowd, lane: Lane, fixtures: Fixtures, settings: CrowdSettings, rng: np.random.Generator) -> Crowd:
    """Returns the crowd one step later: everybody moved, those out of view replaced."""
    dt, A = settings.step_s, len(crowd.ids)
    vehicle = vehicle_state(crowd, lane)
    walking = crowd.pause_until_s <= crowd.time_s
    headings = crowd.headings_rad + settings.heading_drift * math.sqrt(dt) * _per_group(rng.standard_normal(A), crowd)
    pause = walking & (_per_group(rng.random(A), crowd) < dt / settings.pause_every_s)
    lasts = _per_group(rng.exponential(settings.pause_lasts_s, A), crowd)
    pause_until = np.where(pause, crowd.time_s + lasts, crowd.pause_until_s)

    speeds = np.where(pause_until <= crowd.time_s, crowd.speeds_mps, 0.0)
    desired = speeds[:, None] * np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    force = (desired - crowd.velocities_mps) / settings.relaxation_s
    force += _from_others(crowd, settings)
    force += _within_pairs(crowd, headings, settings)
    force += _from_fixtures(crowd.positions_m, fixtures, settings)
    force += _from_vehicle(crowd, desired, vehicle, settings)
    force += settings.jostle * rng.standard_normal((A, 2))

    velocities = crowd.velocities_mps + dt * force
    speed = np.linalg.norm(velocities, axis=1, keepdims=True)
    velocities = velocities * np.minimum(1.0, settings.fastest_mps / np.maximum(speed, 1e-9))
    moved = replace(
        crowd,
        time_s=crowd.time_s + dt,
        x_m=crowd.x_m + dt * crowd.speed_mps * math.cos(vehicle.yaw_rad),
        speed_mps=_next_speed(crowd, vehicle, settings),
        positions_m=crowd.positions_m + dt * velocities,
        velocities_mps=velocities,
        headings_rad=headings,
        pause_until_s=pause_until,
    )
    return _replace_leavers(moved, lane, settings, rng)


# --- forces, all (A, 2) in m/s^2 ------------------------------------------------------------------------------------


def _per_group(values: FloatArray, crowd: Crowd) -> FloatArray:
    """Returns values (A,) with the second of each pair given the first's."""
    values[1 : 2 * crowd.pairs : 2] = values[0 : 2 * crowd.pairs : 2]
    return values


def _from_others(crowd: Crowd, settings: CrowdSettings) -> FloatArray:
    A = len(crowd.ids)
    near = cKDTree(crowd.positions_m).query_pairs(settings.repulsion_range_m, output_type="ndarray")
    partners = (near[:, 1] == near[:, 0] + 1) & (near[:, 0] % 2 == 0) & (near[:, 1] < 2 * crowd.pairs)
    near = near[~partners]  # a pair's own distance is kept by _within_pairs
    i, j = np.concatenate([near, near[:, ::-1]]).T  # each feels the other
    apart = crowd.positions_m[i] - crowd.positions_m[j]
    distance = np.maximum(np.hypot(apart[:, 0], apart[:, 1]), 1e-6)
    direction = apart / distance[:, None]
    ahead = np.stack([np.cos(crowd.headings_rad[i]), np.sin(crowd.headings_rad[i])], axis=-1)
    cosine = -(direction * ahead).sum(axis=1)  # 1: j is straight ahead of i
    weight = settings.behind_weight + (1 - settings.behind_weight) * (1 + cosine) / 2
    push = weight * settings.repulsion * np.exp((settings.contact_m - distance) / settings.repulsion_length_m)
    return np.stack([np.bincount(i, weights=push * direction[:, axis], minlength=A) for axis in (0, 1)], axis=-1)


def _within_pairs(crowd: Crowd, headings: FloatArray, settings: CrowdSettings) -> FloatArray:
    """Holds pairs at their distance and side by side, and lets them share their pace."""
    force = np.zeros_like(crowd.positions_m)
    first = np.arange(0, 2 * crowd.pairs, 2)
    apart = crowd.positions_m[first] - crowd.positions_m[first + 1]  # (pairs, 2)
    distance = np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), 1e-6)
    ahead = np.stack([np.cos(headings[first]), np.sin(headings[first])], axis=-1)
    lag = (apart * ahead).sum(axis=1, keepdims=True)
    relative = crowd.velocities_mps[first] - crowd.velocities_mps[first + 1]
    pull = settings.pair_pull * ((settings.pair_distance_m - distance) * apart / distance - 0.5 * lag * ahead)
    force[first] = pull - relative
    force[first + 1] = -force[first]
    return force


def _from_fixtures(positions_m: FloatArray, fixtures: Fixtures, settings: CrowdSettings) -> FloatArray:
    apart = positions_m[:, None] - fixtures.positions_m  # (A, F, 2)
    distance = np.sqrt(np.einsum("ijk,ijk->ij", apart, apart))
    gap = distance - fixtures.radii_m - settings.contact_m / 2
    push = settings.fixture_repulsion * np.exp(-np.maximum(gap, -0.5) / settings.fixture_length_m)
    total: FloatArray = np.einsum("ij,ijk->ik", push / np.maximum(distance, 1e-6), apart)
    return total


def _from_vehicle(crowd: Crowd, desired_mps: FloatArray, vehicle: VehicleState, settings: CrowdSettings) -> FloatArray:
    """Keeps people off the vehicle's body and, to the side, off the stretch it covers within the next second."""
    place = crowd.positions_m - vehicle.position_m
    c, s = math.cos(vehicle.yaw_rad), math.sin(vehicle.yaw_rad)
    along, left = place @ (c, s), place @ (-s, c)
    front = settings.vehicle_front_m + 1.2 * crowd.speed_mps
    beyond_x = along - np.clip(along, -settings.vehicle_back_m, settings.vehicle_front_m)
    beyond_y = left - np.clip(left, -settings.vehicle_half_width_m, settings.vehicle_half_width_m)
    distance = np.hypot(beyond_x, beyond_y)
    push = settings.vehicle_repulsion * np.exp(-np.maximum(distance - 0.25, 0.0) / settings.vehicle_length_m)
    inside = distance < 1e-6
    direction_x = np.where(inside, 0.0, beyond_x / np.maximum(distance, 1e-6))
    middle = left.copy()  # a pair goes to one side together, or it would stand astride the lane
    first = np.arange(0, 2 * crowd.pairs, 2)
    middle[first] = middle[first + 1] = (left[first] + left[first + 1]) / 2
    side = np.where(middle < 0, -1.0, 1.0)
    # In front of a vehicle that waits, who wants to cross does: both waiting for the other would be for ever.
    wish = desired_mps @ (-s, c)
    crossing = (crowd.speed_mps < 1.0) & (np.abs(wish) > 0.3)
    side = np.where(crossing, np.sign(wish), side)
    direction_y = np.where(inside, side, beyond_y / np.maximum(distance, 1e-6))
    # In the vehicle's way, or about to be: step aside, the more the nearer to its middle line.
    ahead = np.clip((front + 3.0 - along) / 3.0, 0.0, 1.0) * (along > 0)
    aside = 2.5 * ahead * np.exp(-np.maximum(np.abs(left) - settings.vehicle_half_width_m, 0.0) / 0.4) * side
    force_x, force_y = push * direction_x, push * direction_y + aside
    return np.stack([c * force_x - s * force_y, s * force_x + c * force_y], axis=-1)


def _next_speed(crowd: Crowd, vehicle: VehicleState, settings: CrowdSettings) -> float:
    """Returns the vehicle's next speed: as fast as it may and still stop short of whoever is in its corridor."""
    place = crowd.positions_m - vehicle.position_m
    c, s = math.cos(vehicle.yaw_rad), math.sin(vehicle.yaw_rad)
    along, left = place @ (c, s), place @ (-s, c)
    gap = along - settings.vehicle_front_m - settings.stop_gap_m
    blocked = (np.abs(left) < settings.corridor_m) & (along > settings.vehicle_front_m - 0.5)
    safe = np.sqrt(2 * settings.comfortable_mps2 * np.maximum(gap[blocked], 0.0))
    wanted = min(settings.cruise_mps, float(safe.min(initial=math.inf)))
    up, down = settings.comfortable_mps2 * settings.step_s, settings.braking_mps2 * settings.step_s
    return float(np.clip(wanted, crowd.speed_mps - down, crowd.speed_mps + up))


# --- coming and going -----------------------------------------------------------------------------------------------


def _first_crowd(pedestrians: int, lane: Lane, settings: CrowdSettings, rng: np.random.Generator) -> Crowd:
    pairs = int(pedestrians * settings.paired_share / 2)
    A = pedestrians
    empty = Crowd(
        0.0, 0.0, settings.cruise_mps, np.arange(1, A + 1), np.full((A, 2), np.inf), np.zeros((A, 2)),
        np.zeros(A), np.zeros(A), np.zeros(A), pairs, A + 1,
    )  # fmt: skip
    crowd = empty
    for group in _groups(empty):
        radius = settings.view_range_m * math.sqrt(rng.random())
        angle = rng.uniform(-math.pi, math.pi)
        place = np.array([0.0, float(lane.at(0.0)[0])]) + max(radius, 3.5) * np.array([np.cos(angle), np.sin(angle)])
        crowd = _placed(crowd, group, place, _heading(rng), settings=settings, rng=rng)
    return replace(crowd, ids=np.arange(1, A + 1), next_id=A + 1)


def _groups(crowd: Crowd) -> list[slice]:
    """Returns the people who come and go together: pairs, then everybody else alone."""
    singles = range(2 * crowd.pairs, len(crowd.ids))
    return [slice(2 * k, 2 * k + 2) for k in range(crowd.pairs)] + [slice(i, i + 1) for i in singles]


def _heading(rng: np.random.Generator) -> float:
    """Returns a direction to walk in: mostly along the road either way, or across it."""
    main = rng.choice([0.0, math.pi, math.pi / 2, -math.pi / 2], p=[0.3, 0.3, 0.2, 0.2])
    return float(main + rng.normal(0, 0.4))


def _placed(
    crowd: Crowd, group: slice, place: FloatArray, heading: float, *, settings: CrowdSettings, rng: np.random.Generator
) -> Crowd:
    """Returns the crowd with a group put somewhere as new people."""
    count = group.stop - group.start
    offset = (np.arange(count) - (count - 1) / 2)[:, None] * settings.pair_distance_m
    speed = max(0.5, rng.normal(settings.walking_speed_mps, settings.walking_speed_sd_mps))
    pausing = rng.random() < settings.pausing_share
    pause = rng.exponential(2 * settings.pause_lasts_s) if pausing else 0.0
    direction = np.array([math.cos(heading), math.sin(heading)])
    arrays = {
        "ids": crowd.next_id + np.arange(count),
        "positions_m": place + offset * (-direction[1], direction[0]),
        "velocities_mps": np.tile(0.0 if pausing else speed * direction, (count, 1)),
        "headings_rad": heading,
        "speeds_mps": speed,
        "pause_until_s": crowd.time_s + pause,
    }
    changed = {}
    for name, values in arrays.items():
        changed[name] = getattr(crowd, name).copy()
        changed[name][group] = values
    return replace(crowd, next_id=crowd.next_id + count, **changed)


def _replace_leavers(crowd: Crowd, lane: Lane, settings: CrowdSettings, rng: np.random.Generator) -> Crowd:
    """Returns the crowd with those beyond leave_range_m replaced by others who come into view.

    Where somebody comes in is drawn in proportion to how fast they would cross the edge of the view, as in a crowd
    that goes on outside: mostly ahead of a moving vehicle.
    """
    vehicle = vehicle_state(crowd, lane)
    distance = np.linalg.norm(crowd.positions_m - vehicle.position_m, axis=1)
    gone = distance > settings.leave_range_m
    if not gone.any():
        return crowd
    for group in _groups(crowd):
        if not gone[group].any():
            continue
        angles = rng.uniform(-math.pi, math.pi, 24)
        headings = np.array([_heading(rng) for _ in angles])
        outward = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        velocities = settings.walking_speed_mps * np.stack([np.cos(headings), np.sin(headings)], axis=-1)
        inflow = np.maximum(-((velocities - vehicle.velocity_mps) * outward).sum(axis=-1), 0.0)
        places = vehicle.position_m + settings.view_range_m * outward
        crowded = np.linalg.norm(places[:, None] - crowd.positions_m, axis=-1).min(axis=1) < 1.2
        weights = np.where(crowded, 1e-6, 1.0) * (inflow + 1e-6)
        chosen = int(rng.choice(len(angles), p=weights / weights.sum()))
        crowd = _placed(crowd, group, places[chosen], float(headings[chosen]), settings=settings, rng=rng)
    return crowd
