"""Mounts: chains, siblings, replacements, circles, and frames nobody knows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from replay.transform_tree import TransformTree
from schemas.messages import Transform


def transform(parent, child, translation=(0.0, 0.0, 0.0), rotvec=(0.0, 0.0, 0.0)):
    return Transform(1, parent, child, np.array(translation, float), Rotation.from_rotvec(rotvec).as_quat())


def tree(*transforms):
    made = TransformTree()
    for each in transforms:
        made.add(each)
    return made


QUARTER = (0.0, 0.0, np.pi / 2)


def test_one_transform_and_its_inverse():
    made = tree(transform("base", "lidar", (1, 2, 3), QUARTER))
    expected = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    np.testing.assert_allclose(made.transform("base", "lidar"), expected, atol=1e-12)
    np.testing.assert_allclose(made.transform("lidar", "base") @ expected, np.eye(4), atol=1e-12)


def test_a_chain_multiplies():
    made = tree(transform("base", "mast", (1, 0, 0), QUARTER), transform("mast", "camera", (0, 2, 0)))
    point = made.transform("base", "camera") @ [1, 0, 0, 1]  # (1, 0) camera = (1, 2) mast, turned: (-2, 1), shifted
    np.testing.assert_allclose(point, [-1, 1, 0, 1], atol=1e-12)


def test_siblings_meet_in_their_parent():
    made = tree(transform("base", "lidar", (1, 0, 0)), transform("base", "camera", (0, 1, 0)))
    np.testing.assert_allclose(made.transform("camera", "lidar")[:3, 3], [1, -1, 0], atol=1e-12)


numbers = st.lists(st.floats(-3, 3), min_size=6, max_size=6)


@given(st.lists(numbers, min_size=3, max_size=3))
@settings(max_examples=40, deadline=None)
def test_going_round_ends_where_it_began(values):
    a, b, c = (transform(*names, v[:3], v[3:]) for names, v in zip(
        (("root", "a"), ("a", "b"), ("root", "c")), values, strict=True))  # fmt: skip
    made = tree(a, b, c)
    there = made.transform("c", "b") @ made.transform("b", "a") @ made.transform("a", "c")
    np.testing.assert_allclose(there, np.eye(4), atol=1e-9)


def test_a_frame_seen_from_itself_is_identity_even_if_unknown():
    np.testing.assert_array_equal(tree().transform("base", "base"), np.eye(4))


def test_unknown_and_unjoined_frames_give_none():
    made = tree(transform("base", "lidar"), transform("other", "camera"))
    assert made.transform("base", "camera") is None
    assert made.transform("base", "nobody") is None
    assert made.frames == ["base", "camera", "lidar", "other"]


def test_a_missing_link_that_comes_later_joins():
    made = tree(transform("mast", "camera", (1, 0, 0)))
    assert made.transform("base", "camera") is None
    made.add(transform("base", "mast", (0, 0, 2)))
    np.testing.assert_allclose(made.transform("base", "camera")[:3, 3], [1, 0, 2])


def test_a_newer_transform_replaces_the_older():
    made = tree(transform("base", "lidar", (1, 0, 0)))
    assert made.transform("base", "lidar")[0, 3] == 1
    made.add(transform("base", "lidar", (5, 0, 0)))
    assert made.transform("base", "lidar")[0, 3] == 5


@pytest.mark.parametrize("target", ["a", "c", "elsewhere"])
def test_a_circle_ends(target):
    made = tree(transform("a", "b"), transform("b", "c"), transform("c", "a"))
    found = made.transform(target, "b")
    assert found is None if target == "elsewhere" else found.shape == (4, 4)


def test_a_frame_moves_once_its_transform_has_changed():
    made = tree(transform("odom", "base"), transform("base", "lidar", (1, 0, 0)), transform("odom", "base", (0, 1, 0)))
    made.add(transform("base", "lidar", (1, 0, 0)))  # again, as it was
    assert [made.moves(frame) for frame in ("odom", "base", "lidar")] == [False, True, False]
    made.add(transform("mast", "lidar", (1, 0, 0)))
    assert made.moves("lidar")


def test_what_hangs_from_the_vehicle_or_is_joined_to_it_by_mounts_alone_is_fixed_to_it():
    links = [transform("map", "odom"), transform("odom", "base"), transform("base", "imu"), transform("base", "lidar")]
    made = tree(*links, transform("odom", "base", (1, 0, 0)))
    assert [made.is_fixed(frame, "imu") for frame in ("imu", "base", "lidar")] == [True] * 3
    assert [made.is_fixed(frame, "imu") for frame in ("odom", "map", "nobody's")] == [False] * 3
    made.add(transform("base", "lidar", (0, 0, 1)))  # a mast that goes up
    assert made.is_fixed("lidar", "base")
    assert not made.is_fixed("lidar", "imu")
