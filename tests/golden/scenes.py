"""Who goes where in the golden logs that no simulated crowd gives: a turn at a crossing, and people out of sight."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pcgan.clips import Clip, Trajectory, VehicleTrajectory
from replay.simulator.clip_motion import motion_of
from replay.simulator.motion import Motion, Scene
from replay.simulator.surroundings import fixtures_from_rows
from schemas.messages import FloatArray

RATE_HZ = 20.0
RECORDING, PARKED = 0, 1  # vehicles' ids
SWAY_M = 0.08  # nobody walks along a ruler


def turning_clip(duration_s: float = 12.0) -> Clip:
    """Returns a vehicle that turns left at a crossing, 90 degrees about 7 m, between people who cross both roads.

    It comes along x, at 4 m/s and slower in the bend, and leaves along y at x = 1.
    """
    vehicle = _drive(start_m=(-16.0, 0.0), straight_m=10.0, radius_m=7.0, turn_rad=math.pi / 2, duration_s=duration_s)
    people = [
        _walk(1, (7.0, 13.0), (-1.4, 0.0), 0.0, duration_s),  # cross the road that it turns into, ahead of it
        _walk(2, (6.5, 14.0), (-1.3, 0.0), 0.0, duration_s),
        _walk(3, (-5.5, 15.0), (1.5, 0.1), 0.0, duration_s),
        _walk(4, (8.0, 12.0), (-1.2, 0.0), 5.5, duration_s),  # and behind it
        _walk(5, (-10.0, 5.0), (0.0, -1.3), 2.0, duration_s),  # cross the road that it came along, behind it
        _walk(6, (-11.0, -5.0), (0.05, 1.2), 2.5, duration_s),
        _walk(7, (5.0, -4.5), (0.0, 1.3), 0.0, duration_s),  # along the far pavement, past the bend
        _walk(8, (5.6, 20.0), (0.0, -1.2), 0.0, duration_s),
        _walk(9, (-18.0, 5.0), (1.4, 0.0), 0.0, duration_s),  # along the near pavement
        _walk(10, (-4.2, 5.5), (0.0, 1.1), 1.0, duration_s),  # round the inner corner
        _walk(11, (-4.5, 4.6), (0.0, 0.0), 0.0, duration_s),  # wait at the corners
        _walk(12, (5.2, 5.0), (0.0, 0.0), 0.0, duration_s),
        _walk(13, (6.0, 5.2), (0.0, 0.0), 0.0, duration_s),
        _walk(14, (2.0, -5.5), (-1.3, 0.0), 0.0, duration_s),
    ]
    return Clip("golden/turning", RATE_HZ, tuple(people), (vehicle,))


def turning() -> Motion:
    """Returns the drive of the vehicle that turns."""
    return motion_of(turning_clip(), RECORDING)


def occlusion(duration_s: float = 16.0) -> Motion:
    """Returns a slow drive past a parked car, bushes, a pole and a standing group, with people who pass behind them."""
    frames = np.arange(round(duration_s * RATE_HZ) + 1)
    ahead = np.stack([0.5 * frames / RATE_HZ, np.zeros(len(frames))], axis=-1)
    still = np.zeros(len(frames))
    vehicles = (
        VehicleTrajectory(RECORDING, frames, ahead, still, still + 0.5),
        VehicleTrajectory(PARKED, frames, np.tile((19.0, 3.0), (len(frames), 1)), still, still),
    )
    people = [
        _walk(1, (23.0, -3.0), (0.0, 1.2), 0.0, duration_s),  # behind the car, both ways
        _walk(2, (24.0, 14.0), (0.0, -1.1), 2.0, duration_s),
        _walk(3, (4.0, -9.0), (1.3, 0.0), 0.0, duration_s),  # behind the bushes
        _walk(4, (24.0, -8.5), (-1.2, 0.0), 0.0, duration_s),
        _walk(5, (8.45, 5.55), (0.0, 0.0), 0.0, duration_s),  # the group, shoulder to shoulder
        _walk(6, (8.8, 5.2), (0.0, 0.0), 0.0, duration_s),
        _walk(7, (9.15, 4.85), (0.0, 0.0), 0.0, duration_s),
        _walk(8, (6.0, 9.5), (1.2, 0.0), 0.0, duration_s),  # behind the group, both ways
        _walk(9, (26.0, 9.0), (-1.3, 0.0), 1.0, duration_s),
        _walk(10, (15.0, -4.0), (0.0, 1.0), 6.0, duration_s),  # cross in front, behind the pole
        _walk(11, (-8.0, 4.0), (1.4, 0.0), 0.0, duration_s),  # overtakes, between the vehicle and all of these
    ]
    bushes_and_pole = fixtures_from_rows(
        [(0, 9.0, -5.0, 0.65, 1.8), (1, 15.0, -6.0, 0.6, 1.8), (2, 12.5, -1.9, 0.2, 4.0)]
    )
    motion = motion_of(Clip("golden/occlusion", RATE_HZ, tuple(people), vehicles), RECORDING)

    def scenes() -> Iterator[Scene]:
        return (replace(scene, fixtures=bushes_and_pole) for scene in motion.scenes())

    return Motion(motion.name, motion.duration_s, scenes)


def _walk(
    id: int, start_m: Sequence[float], velocity_mps: Sequence[float], from_s: float, until_s: float
) -> Trajectory:
    """Returns somebody who stands at the start until from_s, and then walks straight on, swaying a little."""
    frames = np.arange(round(until_s * RATE_HZ) + 1)
    going_s = np.maximum(0.0, frames / RATE_HZ - from_s)[:, None]
    sideways = np.array([-velocity_mps[1], velocity_mps[0]])
    sway = SWAY_M * np.sin(1.7 * going_s + id) - SWAY_M * math.sin(id)
    positions = np.array(start_m) + going_s * np.array(velocity_mps) + sway * sideways
    return Trajectory(id, frames, positions, np.gradient(positions, axis=0) * RATE_HZ)


def _drive(
    start_m: tuple[float, float], straight_m: float, radius_m: float, turn_rad: float, duration_s: float
) -> VehicleTrajectory:
    """Returns a vehicle that drives along x, bends left on a circle, and drives straight on; it slows for the bend."""
    frames = np.arange(round(duration_s * RATE_HZ) + 1)
    bend_m = radius_m * turn_rad
    gone_m, speeds = np.zeros(len(frames)), np.zeros(len(frames))
    for i in range(len(frames)):
        to_bend_m = max(straight_m - gone_m[i], gone_m[i] - straight_m - bend_m, 0.0)
        speeds[i] = min(4.0, 2.4 + 0.4 * to_bend_m)
        if i + 1 < len(frames):
            gone_m[i + 1] = gone_m[i] + speeds[i] / RATE_HZ
    yaws: FloatArray = np.clip((gone_m - straight_m) / radius_m, 0.0, turn_rad)
    before = np.minimum(gone_m, straight_m)
    after = np.maximum(gone_m - straight_m - bend_m, 0.0)
    x = start_m[0] + before + radius_m * np.sin(yaws) + after * math.cos(turn_rad)
    y = start_m[1] + radius_m * (1 - np.cos(yaws)) + after * math.sin(turn_rad)
    return VehicleTrajectory(RECORDING, frames, np.stack([x, y], axis=-1), yaws, speeds)
