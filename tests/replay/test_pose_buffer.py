"""Poses between the logged ones: interpolation laws, a cross-check with scipy's Slerp, and where poses end."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from replay.pose_buffer import PoseBuffer
from schemas.messages import VehiclePose

MS = 1_000_000
T0 = 1_700_000_000_000_000_000


def pose(at_ms, position=(0.0, 0.0, 0.0), rotation=None, velocity=(0.0, 0.0, 0.0)):
    quaternion = (rotation or Rotation.identity()).as_quat()
    stamp_ns = T0 + round(at_ms * MS)
    return VehiclePose(stamp_ns, "odom", "base_link", np.array(position), quaternion, np.array(velocity), np.zeros(3))


def buffer(*poses):
    made = PoseBuffer()
    for each in poses:
        made.add(each)
    return made


def at(poses, *times_ms):
    return poses.at([T0 + round(t * MS) for t in times_ms])


def turn(yaw_rad):
    return Rotation.from_euler("z", yaw_rad)


ROTATIONS = st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3).map(Rotation.from_rotvec)


def test_a_logged_stamp_gives_the_logged_pose():
    poses = buffer(pose(0, (1, 2, 3), turn(0.3)), pose(10, (4, 5, 6), turn(0.5)), pose(20, (7, 8, 9), turn(-0.2)))
    found = at(poses, 0, 10, 20)
    assert found.known.all()
    assert not found.extrapolated.any()
    np.testing.assert_allclose(found.map_from_vehicle[:, :3, 3], [[1, 2, 3], [4, 5, 6], [7, 8, 9]], atol=1e-12)
    for T, yaw in zip(found.map_from_vehicle, (0.3, 0.5, -0.2), strict=True):
        np.testing.assert_allclose(T[:3, :3], turn(yaw).as_matrix(), atol=1e-12)
        np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


def test_halfway_is_halfway():
    found = at(buffer(pose(0, (0, 0, 0), turn(0.0)), pose(10, (2, 4, 0), turn(1.0))), 5, 2.5)
    np.testing.assert_allclose(found.map_from_vehicle[:, :3, 3], [[1, 2, 0], [0.5, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(found.map_from_vehicle[0, :3, :3], turn(0.5).as_matrix(), atol=1e-12)


def test_nothing_lies_between_two_frames():
    utm = replace(pose(10, (5e6, 0, 0)), frame_id="utm")
    assert at(buffer(pose(0), pose(5), utm), 5, 10).known.tolist() == [False, False]
    poses = buffer(pose(0), utm, pose(20, (1, 0, 0)), pose(30, (2, 0, 0)))
    np.testing.assert_allclose(at(poses, 25).map_from_vehicle[0, :3, 3], [1.5, 0, 0])


def test_yaw_goes_the_short_way_round():
    found = at(buffer(pose(0, rotation=turn(np.pi - 0.1)), pose(10, rotation=turn(-np.pi + 0.1))), 5)
    np.testing.assert_allclose(found.map_from_vehicle[0, :3, :3], turn(np.pi).as_matrix(), atol=1e-12)


@given(st.lists(ROTATIONS, min_size=2, max_size=6), st.lists(st.floats(0, 1), min_size=1, max_size=8))
@settings(max_examples=60, deadline=None)
def test_rotations_agree_with_scipys_slerp(rotations, fractions):
    times_ms = 10.0 * np.arange(len(rotations))
    poses = buffer(*(pose(t, rotation=r) for t, r in zip(times_ms, rotations, strict=True)))
    asked_ms = np.round(np.array(fractions) * times_ms[-1], 3)
    expected = Slerp(times_ms, Rotation.concatenate(rotations))(asked_ms).as_matrix()
    found = at(poses, *asked_ms)
    assert found.known.all()
    np.testing.assert_allclose(found.map_from_vehicle[:, :3, :3], expected, atol=1e-7)


@given(ROTATIONS, ROTATIONS, st.floats(-5, 15))
@settings(max_examples=60, deadline=None)
def test_every_pose_is_a_rigid_transform(first, second, at_ms):
    found = at(buffer(pose(0, rotation=first), pose(10, rotation=second)), at_ms).map_from_vehicle[0]
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize(("at_ms", "known", "extrapolated"), [
    (0, True, False), (100, True, False), (100.001, True, True), (150, True, True), (150.001, False, False),
    (-0.001, True, True), (-50, True, True), (-50.001, False, False), (5000, False, False),
])  # fmt: skip
def test_at_most_50_ms_are_extrapolated_and_marked(at_ms, known, extrapolated):
    found = at(buffer(*(pose(t) for t in range(0, 101, 10))), at_ms)
    assert (found.known[0], found.extrapolated[0]) == (known, extrapolated)


def test_extrapolation_goes_on_straight():
    found = at(buffer(pose(0, (0, 0, 0), turn(0.0)), pose(10, (1, 0, 0), turn(0.1))), 30, -20)
    np.testing.assert_allclose(found.map_from_vehicle[:, 0, 3], [3, -2], atol=1e-12)
    np.testing.assert_allclose(found.map_from_vehicle[0, :3, :3], turn(0.3).as_matrix(), atol=1e-12)


def test_poses_far_apart_bracket_nothing():
    assert at(buffer(pose(0), pose(500)), 250).known[0]
    assert not at(buffer(pose(0), pose(501)), 250).known[0]


def test_one_pose_is_not_enough_and_none_neither():
    assert not at(buffer(pose(0)), 0).known[0]
    assert not at(buffer(), 0).known[0]
    assert buffer().latest_ns == 0


def test_many_stamps_are_answered_each_by_its_own():
    poses = buffer(*(pose(t, (t, 0, 0)) for t in range(0, 101, 10)))
    asked = [55.0, 400.0, 5.0, -400.0, 120.0]
    found = at(poses, *asked)
    assert found.known.tolist() == [True, False, True, False, True]
    assert found.extrapolated.tolist() == [False, False, False, False, True]
    np.testing.assert_allclose(found.map_from_vehicle[found.known, 0, 3], [55, 5, 120], atol=1e-9)


@given(st.permutations(range(8)))
@settings(max_examples=40, deadline=None)
def test_the_order_of_arrival_does_not_matter(order):
    logged = [pose(10 * i, (i**2, 0, 0), turn(0.1 * i)) for i in range(8)]
    found = at(buffer(*(logged[i] for i in order)), 3, 37, 66)
    expected = at(buffer(*logged), 3, 37, 66)
    np.testing.assert_array_equal(found.map_from_vehicle, expected.map_from_vehicle)


def test_a_second_pose_of_one_stamp_replaces_the_first():
    poses = buffer(pose(0), pose(10, (1, 0, 0)), pose(10, (2, 0, 0)))
    np.testing.assert_allclose(at(poses, 5).map_from_vehicle[0, :3, 3], [1, 0, 0])


def test_old_poses_are_forgotten_and_recent_ones_kept():
    poses = buffer(*(pose(t) for t in range(0, 20_000, 10)))
    assert not at(poses, 10_000).known[0]
    assert at(poses, 17_000, 19_985).known.all()


def test_velocity_is_the_logged_one_turned_into_the_map():
    poses = buffer(pose(0), pose(10, rotation=turn(np.pi / 2), velocity=(3.0, 1.0, 0.0)))
    np.testing.assert_allclose(poses.velocity(T0 + 9 * MS), [-1, 3], atol=1e-12)


def test_velocity_comes_from_positions_where_none_is_logged():
    poses = buffer(*(pose(t, (0.002 * t, -0.001 * t, 0), velocity=(np.nan,) * 3) for t in range(0, 401, 20)))
    np.testing.assert_allclose(poses.velocity(T0 + 200 * MS), [2, -1], atol=1e-9)
    np.testing.assert_allclose(poses.velocity(T0 + 400 * MS), [2, -1], atol=1e-9)
    np.testing.assert_allclose(poses.velocity(T0), [2, -1], atol=1e-9)
    assert buffer(pose(0, velocity=(np.nan,) * 3)).velocity(T0).tolist() == [0, 0]


def test_nearest_prefers_the_nearer_and_of_two_the_older():
    poses = buffer(pose(0, (1, 0, 0)), pose(10, (2, 0, 0)))
    assert [poses.nearest(T0 + round(t * MS)).position_m[0] for t in (-5, 4, 5, 6, 99)] == [1, 1, 1, 2, 2]
