"""Where a vehicle is going to drive: its present motion carried on, or changed by a brake or a swerve.

Paths are of the vehicle's frame, whose origin lies under the rear axle of the USyd vehicle, in the odometry frame.
"""

import math
from dataclasses import dataclass

import numpy as np

from schemas.messages import FloatArray, VehicleHistory, VehiclePath

LENGTH_M = 3.0  # the USyd vehicle is a small electric van
WIDTH_M = 1.4
CENTRE_M = 0.9  # from the frame's origin forward
FRONT_M, REAR_M = CENTRE_M + LENGTH_M / 2, LENGTH_M / 2 - CENTRE_M

STANDSTILL_MPS = 0.1  # odometry of a standing vehicle says no less
YAW_RATE_SPAN_NS = 500_000_000  # the yaw rate is that of the last half second
MAX_AGE_NS = 1_000_000_000  # a vehicle last seen longer ago may be anywhere
STEEPEST_SWERVE = 0.5  # of the speed, sideways: 30 degrees off the course


class ManoeuvreError(ValueError):
    """A manoeuvre that the vehicle cannot drive as it moves now; the message says what it could."""


@dataclass(frozen=True)
class Motion:
    """A vehicle's motion at one moment, in the plane of the odometry frame."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float  # along the vehicle's x axis, negative backwards; 0 at standstill
    yaw_rate_radps: float

    @property
    def curvature_per_m(self) -> float:
        """How sharply it turns to the left, per metre forward; 0 at standstill."""
        return self.yaw_rate_radps / self.speed_mps if self.speed_mps else 0.0


def motion_at(history: VehicleHistory, stamp_ns: int) -> Motion | None:
    """Returns how the vehicle moves at `stamp_ns`, or None if that is not known.

    Speed is the last one logged, the yaw rate a straight line's slope over the last half second. A state that is older
    than `stamp_ns` is carried on to it, by a second at most. Below 0.1 m/s the vehicle stands. States that are not
    finite say nothing.
    """
    late = (history.stamps_ns <= stamp_ns) & (history.stamps_ns >= stamp_ns - MAX_AGE_NS)
    stamps, states = history.stamps_ns[late], history.states[late]
    if len(stamps) == 0 or not np.isfinite(states).all():
        return None
    x, y, yaw, vx, vy = states[-1].tolist()
    speed = vx * math.cos(yaw) + vy * math.sin(yaw)
    if abs(speed) < STANDSTILL_MPS:
        return Motion(x, y, yaw, 0.0, 0.0)
    late = stamps >= stamps[-1] - YAW_RATE_SPAN_NS
    t = (stamps[late] - stamps[-1]) * 1e-9
    t -= t.mean()
    yaws = np.mod(states[late, 2] - yaw + np.pi, 2 * np.pi)  # from the last one, without a jump
    yaw_rate = float((t * yaws).sum() / (t * t).sum()) if len(t) > 1 else 0.0
    seen = Motion(x, y, yaw, speed, yaw_rate)
    age_s = (stamp_ns - int(stamps[-1])) * 1e-9
    if age_s == 0:
        return seen
    [(x, y, yaw)] = _poses_along(seen, np.array([speed * age_s])).tolist()
    return Motion(x, y, yaw, speed, yaw_rate)


def drive_on(motion: Motion, times_s: FloatArray) -> VehiclePath:
    """Returns the path (S,) at constant speed and yaw rate: a circle, a straight line, or standing still."""
    return _path(times_s, _poses_along(motion, motion.speed_mps * times_s))


def brake(motion: Motion, times_s: FloatArray, deceleration_mps2: float) -> VehiclePath:
    """Returns the path of a vehicle that brakes to a stand on its present course, and stays there."""
    speed = abs(motion.speed_mps)
    moving_s = np.minimum(times_s, speed / deceleration_mps2)
    driven = math.copysign(1, motion.speed_mps) * (speed * moving_s - deceleration_mps2 * moving_s**2 / 2)
    return _path(times_s, _poses_along(motion, driven))


def swerve(motion: Motion, times_s: FloatArray, offset_m: float, over_s: float) -> VehiclePath:
    """Returns the path of a vehicle that shifts sideways off its present course, and drives on beside it.

    The shift is `offset_m` to the left (negative: to the right) within `over_s`, a polynomial of fifth degree without
    jumps in velocity or acceleration; the speed stays the same. Raises ManoeuvreError for a vehicle that does not drive
    forward or is too slow for so steep a shift.
    """
    steepest = 1.875 * abs(offset_m) / over_s  # m/s sideways, half way
    if motion.speed_mps * STEEPEST_SWERVE < steepest:
        raise ManoeuvreError(
            f"at {motion.speed_mps:.1f} m/s the vehicle cannot shift {abs(offset_m):g} m within {over_s:g} s: that "
            f"takes {steepest / STEEPEST_SWERVE:.1f} m/s forward; give it more time or less to shift"
        )
    fine_s = np.union1d(np.linspace(0, max(times_s[-1], over_s), 401), times_s)
    u = np.minimum(fine_s / over_s, 1)
    shift = offset_m * u**3 * (10 - 15 * u + 6 * u**2)
    sideways = offset_m * 30 * u**2 * (1 - u) ** 2 / over_s  # m/s
    along = np.sqrt(motion.speed_mps**2 - sideways**2)  # m/s on the course, so that the whole speed is constant
    driven = np.concatenate([[0.0], np.cumsum(np.diff(fine_s) * (along[1:] + along[:-1]) / 2)])
    course = _poses_along(motion, driven)
    left = np.column_stack([-np.sin(course[:, 2]), np.cos(course[:, 2])])
    yaws = course[:, 2] + np.arctan2(sideways, along)
    poses = np.column_stack([course[:, :2] + shift[:, None] * left, yaws])
    return _path(times_s, poses[np.searchsorted(fine_s, times_s)])


def _path(times_s: FloatArray, poses: FloatArray) -> VehiclePath:
    return VehiclePath(times_s, poses, FRONT_M, REAR_M, WIDTH_M)


def _poses_along(motion: Motion, driven_m: FloatArray) -> FloatArray:
    """(S,) metres driven, negative backwards -> (S, 3) x, y, yaw on the circle of the present curvature."""
    turned = motion.curvature_per_m * driven_m
    chord_m, heading = driven_m * np.sinc(turned / (2 * np.pi)), motion.yaw_rad + turned / 2
    x, y = motion.x_m + chord_m * np.cos(heading), motion.y_m + chord_m * np.sin(heading)
    return np.column_stack([x, y, motion.yaw_rad + turned])
