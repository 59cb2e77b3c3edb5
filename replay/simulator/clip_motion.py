"""Drives through annotated clips: one annotated vehicle becomes the recording vehicle, the rest is what it sees.

base_link is put at the annotated reference point (the centre of DUT's cars, a point 1 m behind the front bumper of
CITR's golf cart), so that the vehicle's pose in a drive can be compared with the annotation.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pcgan.clips import TRAJECTORY_SUFFIXES, Clip, VehicleTrajectory, clip_names, load_clip
from replay.simulator.motion import Fixtures, Motion, OtherVehicles, People, Scene, SimulationError, VehicleState
from replay.simulator.surroundings import CELL_M, SHARE, fixtures_from_rows, pole_or_bush
from schemas.messages import FloatArray

# length, width, height and how far the box's centre is ahead of the annotated point, m
_CAR = ((4.5, 1.8, 1.5), 0.0)
_BOXES = {"dut": _CAR, "citr": ((2.2, 1.2, 1.8), -0.1)}  # a car elsewhere
MOVES_MPS = 1.0  # a vehicle that reaches this moves
STEADY_MPS = 0.6  # below this the annotated heading of a vehicle is not trusted
_SMOOTHING_S = 0.4
_FIXTURE_REACH_M = 25.0  # beyond the area that people and vehicles cover
_PEOPLE_CLEARANCE_M = 0.8
_VEHICLE_CLEARANCE_M = 3.0


def clip_motion(name: str, vehicle_id: int | None = None, seed: int = 0, data_dir: Path | None = None) -> Motion:
    """Returns the drive of one annotated vehicle of a clip, from its first frame to its last.

    Args:
        name: e.g. "dut/roundabout_04", or the path of a trajectory file, see `pcgan.clips.load_clip`.
        vehicle_id: which vehicle records; the one that moves and is present longest if None.
        seed: where poles and bushes stand, never nearer than 0.8 m to anybody's path.

    Raises SimulationError naming the clips or vehicles that there are; DataNotFound if the data set or file is missing;
    ClipError if the file is not what it should be.
    """
    return motion_of(_load(name, data_dir), vehicle_id, seed)


def motion_of(clip: Clip, vehicle_id: int | None = None, seed: int = 0) -> Motion:
    """Returns the drive of one vehicle through a clip, as `clip_motion`."""
    vehicle = _choose(clip, vehicle_id)
    frames = len(vehicle.frames)
    if frames < 2:
        raise SimulationError(f"vehicle {vehicle.id} of {clip.name} is there for {frames} frame; a drive needs 2")
    return Motion(clip.name, (frames - 1) / clip.rate_hz, lambda: _scenes(clip, vehicle, seed))


def _load(name: str, data_dir: Path | None) -> Clip:
    if name.endswith(TRAJECTORY_SUFFIXES):
        return load_clip(name)
    dataset = name.partition("/")[0]
    try:
        known = clip_names(dataset, data_dir)
    except ValueError as error:  # no such data set
        raise SimulationError(
            f"no clip {name!r}: {error}; clips are named like dut/roundabout_04, and trajectory files end in"
            f" {', '.join(TRAJECTORY_SUFFIXES)}"
        ) from error
    if name not in known:
        raise SimulationError(f"no clip {name!r}; there are {', '.join(known)}")
    return load_clip(name, data_dir)


def _choose(clip: Clip, vehicle_id: int | None) -> VehicleTrajectory:
    if not clip.vehicles:
        raise SimulationError(f"{clip.name} has no vehicle to drive; choose a clip with one")
    by_id = {vehicle.id: vehicle for vehicle in clip.vehicles}
    if vehicle_id is None:
        moving = [vehicle for vehicle in clip.vehicles if _top_speed(vehicle, clip.rate_hz) > MOVES_MPS]
        return max(moving or clip.vehicles, key=lambda vehicle: (len(vehicle.frames), -vehicle.id))
    if vehicle_id not in by_id:
        raise SimulationError(f"{clip.name} has no vehicle {vehicle_id}; its vehicles are {sorted(by_id)}")
    return by_id[vehicle_id]


def _top_speed(vehicle: VehicleTrajectory, rate_hz: float) -> float:
    velocities = smooth_velocities(vehicle.positions_m, rate_hz)
    return float(np.linalg.norm(velocities, axis=1).max(initial=0.0))


def smooth_velocities(positions_m: FloatArray, rate_hz: float) -> FloatArray:
    """Returns velocities (T, 2) from positions (T, 2): differences, averaged over 0.4 s.

    The annotated speeds lag behind the positions by up to 2 m/s, so they are not used.
    """
    if len(positions_m) < 2:
        return np.zeros_like(positions_m)
    velocities: FloatArray = np.gradient(positions_m, axis=0) * rate_hz
    half = min(round(_SMOOTHING_S * rate_hz / 2), (len(positions_m) - 1) // 2)
    kernel = np.full(2 * half + 1, 1 / (2 * half + 1))
    padded = np.pad(velocities, ((half, half), (0, 0)), mode="edge")
    return np.stack([np.convolve(padded[:, axis], kernel, mode="valid") for axis in (0, 1)], axis=-1)


def steady_yaws(vehicle: VehicleTrajectory, rate_hz: float) -> FloatArray:
    """Returns unwrapped headings (T,), those of slow stretches replaced by what lies between the moving ones.

    A vehicle that never moves keeps its annotated heading.
    """
    moving = np.linalg.norm(smooth_velocities(vehicle.positions_m, rate_hz), axis=1) > STEADY_MPS
    if not moving.any():
        parked: FloatArray = np.unwrap(vehicle.yaw_rad)
        return parked
    # Unwrapped without the slow stretches: turns made up while standing must not count.
    steady: FloatArray = np.interp(np.arange(len(moving)), np.flatnonzero(moving), np.unwrap(vehicle.yaw_rad[moving]))
    return steady


def _scenes(clip: Clip, vehicle: VehicleTrajectory, seed: int) -> Iterator[Scene]:
    """Yields a scene per annotated frame of the recording vehicle."""
    rate = clip.rate_hz
    velocities = smooth_velocities(vehicle.positions_m, rate)
    yaws = steady_yaws(vehicle, rate)
    yaw_rates = np.gradient(yaws) * rate
    size, ahead = _BOXES.get(clip.name.partition("/")[0], _CAR)
    others = [(other, steady_yaws(other, rate)) for other in clip.vehicles if other.id != vehicle.id]
    fixtures = _fixtures(clip, seed)
    for k, frame in enumerate(vehicle.frames):
        ids, positions, speeds = [], [], []
        for person in clip.pedestrians:
            i = int(frame - person.frames[0])
            if 0 <= i < len(person.frames):
                ids.append(person.id)
                positions.append(person.positions_m[i])
                speeds.append(person.velocities_mps[i])
        boxes = []
        for other, other_yaws in others:
            i = int(frame - other.frames[0])
            if 0 <= i < len(other.frames):
                heading = np.array([math.cos(other_yaws[i]), math.sin(other_yaws[i])])
                boxes.append((other.id, *(other.positions_m[i] + ahead * heading), other_yaws[i]))
        table = np.array([box[1:] for box in boxes]).reshape(-1, 3)
        yield Scene(
            k / rate,
            VehicleState(vehicle.positions_m[k], float(yaws[k]), velocities[k], float(yaw_rates[k])),
            People(np.array(ids, np.int64), np.array(positions).reshape(-1, 2), np.array(speeds).reshape(-1, 2)),
            OtherVehicles(
                np.array([box[0] for box in boxes], np.int64), table[:, :2], table[:, 2], np.tile(size, (len(boxes), 1))
            ),
            fixtures,
        )


def _fixtures(clip: Clip, seed: int) -> Fixtures:
    """Returns poles and bushes spread over the clip's surroundings, clear of every annotated path."""
    people = np.concatenate([np.zeros((0, 2)), *(person.positions_m for person in clip.pedestrians)])
    vehicles = np.concatenate([vehicle.positions_m for vehicle in clip.vehicles])
    everything = np.concatenate([people, vehicles])
    low, high = everything.min(axis=0) - _FIXTURE_REACH_M, everything.max(axis=0) + _FIXTURE_REACH_M
    rng = np.random.default_rng([seed, 3])
    rows: list[tuple[int, float, float, float, float]] = []
    count_x, count_y = np.ceil((high - low) / CELL_M).astype(int)
    for i in range(count_x):
        for j in range(count_y):
            place = low + (np.array([i, j]) + rng.random(2)) * CELL_M
            radius, height = pole_or_bush(rng)
            stands = rng.random() < SHARE
            clear = _clear(place, people, _PEOPLE_CLEARANCE_M + radius) and _clear(
                place, vehicles, _VEHICLE_CLEARANCE_M
            )
            if stands and clear:
                rows.append((len(rows), float(place[0]), float(place[1]), radius, height))
    return fixtures_from_rows(rows)


def _clear(place: FloatArray, points: FloatArray, distance_m: float) -> bool:
    return bool(np.linalg.norm(points - place, axis=1).min(initial=np.inf) > distance_m)
