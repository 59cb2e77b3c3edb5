"""Paths of a vehicle: its motion as seen, carried on, braked and shifted, against what each should do by hand."""

import numpy as np
import pytest

from pcgan.vehicle_path import FRONT_M, REAR_M, WIDTH_M, ManoeuvreError, Motion, brake, drive_on, motion_at, swerve
from schemas.messages import VehicleHistory

STAMP_NS = 1_700_000_000_000_000_000
TIMES_S = 0.1 * np.arange(49)


def history(states, ages_s=None):
    """States at 10 Hz, the last one now unless ages are given."""
    states = np.array(states, float).reshape(-1, 5)
    ages_s = np.arange(len(states) - 1, -1, -1) / 10 if ages_s is None else np.array(ages_s)
    return VehicleHistory(STAMP_NS - np.round(ages_s * 1e9).astype(np.int64), states)


def circling(speed_mps=3.0, yaw_rate_radps=0.4, yaw_rad=3.1, steps=37):
    """A vehicle on a circle through (5, 6), whose yaw jumps from pi to -pi on the way."""
    t = np.arange(1 - steps, 1) / 10
    yaws = yaw_rad + yaw_rate_radps * t
    radius = speed_mps / yaw_rate_radps
    x, y = 5 + radius * (np.sin(yaws) - np.sin(yaw_rad)), 6 - radius * (np.cos(yaws) - np.cos(yaw_rad))
    wrapped = (yaws + np.pi) % (2 * np.pi) - np.pi
    return history(np.column_stack([x, y, wrapped, speed_mps * np.cos(yaws), speed_mps * np.sin(yaws)]))


def speeds(path):
    return np.hypot(*np.diff(path.poses[:, :2], axis=0).T) / np.diff(path.times_s)


# --- the motion ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw_rad", [0.3, 3.1, -3.1, np.pi])
def test_motion_of_a_circling_vehicle(yaw_rad):
    motion = motion_at(circling(yaw_rad=yaw_rad), STAMP_NS)
    assert (motion.x_m, motion.y_m) == pytest.approx((5, 6))
    assert motion.speed_mps == pytest.approx(3)
    assert motion.yaw_rate_radps == pytest.approx(0.4)
    assert motion.curvature_per_m == pytest.approx(0.4 / 3)


def test_reversing_has_a_negative_speed():
    assert motion_at(history([0, 0, np.pi / 2, 0, -1.5]), STAMP_NS).speed_mps == pytest.approx(-1.5)


def test_an_older_state_is_carried_on_and_a_future_one_is_not_known():
    seen = history([[0, 0, 0, 2, 0], [0.5, 0, 0, 2, 0], [99, 99, 0, 2, 0]], [0.5, 0.25, -0.1])
    motion = motion_at(seen, STAMP_NS)
    assert (motion.x_m, motion.y_m, motion.speed_mps) == pytest.approx((1, 0, 2))


def test_nothing_is_known_without_a_recent_finite_state():
    assert motion_at(VehicleHistory.empty(), STAMP_NS) is None
    assert motion_at(history([0, 0, 0, 2, 0], [1.1]), STAMP_NS) is None
    assert motion_at(history([0, 0, np.nan, 2, 0]), STAMP_NS) is None
    assert motion_at(history([0, 0, 0, 2, 0], [0.9]), STAMP_NS) is not None


def test_below_walking_a_vehicle_stands_whatever_its_yaw_does():
    jitter = [[0, 0, 0.01 * (-1) ** i, 0.05, 0.0] for i in range(10)]
    motion = motion_at(history(jitter), STAMP_NS)
    assert (motion.speed_mps, motion.yaw_rate_radps, motion.curvature_per_m) == (0, 0, 0)
    path = drive_on(motion, TIMES_S)
    np.testing.assert_array_equal(path.poses, np.tile(path.poses[0], (49, 1)))


# --- the paths -------------------------------------------------------------------------------------------------------


def test_driving_on_stays_on_the_circle():
    path = drive_on(motion_at(circling(), STAMP_NS), TIMES_S)
    centre = np.array([5, 6]) + 3 / 0.4 * np.array([-np.sin(3.1), np.cos(3.1)])
    np.testing.assert_allclose(np.linalg.norm(path.poses[:, :2] - centre, axis=1), 7.5)
    np.testing.assert_allclose(path.poses[:, 2], 3.1 + 0.4 * TIMES_S)
    np.testing.assert_allclose(path.poses[0, :2], [5, 6])
    assert (path.front_m, path.rear_m, path.width_m) == (FRONT_M, REAR_M, WIDTH_M) == pytest.approx((2.4, 0.6, 1.4))


@pytest.mark.parametrize("speed_mps", [4.0, -4.0])
def test_braking_covers_the_stopping_distance_and_stays(speed_mps):
    path = brake(Motion(0, 0, 0, speed_mps, 0), TIMES_S, 2.0)
    sign = np.sign(speed_mps)
    np.testing.assert_allclose(path.poses[10, 0], sign * (4 - 1))  # after 1 s
    np.testing.assert_allclose(path.poses[20:, 0], sign * 4.0)  # v^2 / 2 a
    assert (sign * np.diff(path.poses[:, 0]) >= -1e-12).all()


def test_braking_keeps_to_the_curve():
    motion = Motion(0, 0, 0, 4, 0.4)
    braked, driven = brake(motion, TIMES_S, 4.0), drive_on(motion, TIMES_S)
    np.testing.assert_allclose(braked.poses[-1], driven.poses[5], atol=1e-9)  # 2 m on


@pytest.mark.parametrize("offset_m", [1.5, -1.5])
@pytest.mark.parametrize("yaw_rad", [0.0, 2.0])
def test_a_swerve_ends_beside_the_course_at_the_same_speed(offset_m, yaw_rad):
    path = swerve(Motion(3, 4, yaw_rad, 5, 0), TIMES_S, offset_m, 2.0)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    along = (path.poses[:, 0] - 3) * c + (path.poses[:, 1] - 4) * s
    across = (path.poses[:, 1] - 4) * c - (path.poses[:, 0] - 3) * s
    np.testing.assert_allclose(across[[0, 10, 20, 48]], [0, offset_m / 2, offset_m, offset_m], atol=1e-9)
    np.testing.assert_allclose(speeds(path), 5, atol=0.02)
    assert (np.diff(along) > 0).all()
    np.testing.assert_allclose(path.poses[[0, 20, 48], 2], yaw_rad, atol=1e-9)
    heading = np.unwrap(np.arctan2(*np.diff(path.poses[:, :2], axis=0).T[::-1]))
    np.testing.assert_allclose(heading, (path.poses[1:, 2] + path.poses[:-1, 2]) / 2, atol=0.01)


def test_a_swerve_may_outlast_the_path():
    path = swerve(Motion(0, 0, 0, 5, 0), TIMES_S[:11], 1.5, 2.0)
    assert path.poses[-1, 1] == pytest.approx(0.75)


@pytest.mark.parametrize("speed_mps", [0.0, 1.0, -5.0])
def test_a_slow_vehicle_cannot_swerve(speed_mps):
    with pytest.raises(ManoeuvreError, match=r"cannot shift 1\.5 m within 2 s: that takes 2\.8 m/s forward"):
        swerve(Motion(0, 0, 0, speed_mps, 0), TIMES_S, -1.5, 2.0)
