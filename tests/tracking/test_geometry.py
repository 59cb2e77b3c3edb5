"""Rigid transforms: group laws, and agreement with scipy's rotations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation, Slerp

from tracking.geometry import apply, interpolate_pose, inverse, quaternion_of, transform_matrix, yaw_of

numbers = st.floats(-50, 50, allow_subnormal=False)
quaternions = arrays(float, 4, elements=st.floats(-1, 1, allow_subnormal=False)).filter(
    lambda q: np.linalg.norm(q) > 0.1
)
poses = st.builds(transform_matrix, arrays(float, 3, elements=numbers), quaternions)


@given(arrays(float, 3, elements=numbers), quaternions)
def test_rotation_agrees_with_scipy(translation, quaternion):
    T = transform_matrix(translation, quaternion)
    np.testing.assert_allclose(T[:3, :3], Rotation.from_quat(quaternion).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(T[:, 3], [*translation, 1])


@given(poses, arrays(float, (2, 5, 3), elements=numbers))
def test_inverse_undoes(T, points):
    np.testing.assert_allclose(T @ inverse(T), np.eye(4), atol=1e-10)
    np.testing.assert_allclose(apply(inverse(T), apply(T, points)), points, atol=1e-9)


@given(poses, poses, arrays(float, 3, elements=numbers))
def test_product_is_composition(T, U, point):
    np.testing.assert_allclose(apply(T @ U, point), apply(T, apply(U, point)), atol=1e-8)


@given(poses)
def test_quaternion_of_undoes_transform_matrix(T):
    q = quaternion_of(T)
    assert q[3] >= 0
    assert np.linalg.norm(q) == pytest.approx(1)
    np.testing.assert_allclose(transform_matrix(T[:3, 3], q), T, atol=1e-9)


@pytest.mark.parametrize("axis", np.eye(3))
def test_quaternion_of_half_turns(axis):
    """A half turn has scalar part 0, where the naive formula divides by zero."""
    T = transform_matrix(np.zeros(3), [*axis, 0.0])
    np.testing.assert_allclose(np.abs(quaternion_of(T)), [*axis, 0.0], atol=1e-12)


@given(poses, poses, st.floats(0, 1))
def test_interpolation_agrees_with_scipy_slerp(T0, T1, fraction):
    rotations = Rotation.from_matrix(np.stack([T0[:3, :3], T1[:3, :3]]))
    if (rotations[0].inv() * rotations[1]).magnitude() > 3.1:
        return  # at a half turn either way round is right
    T = interpolate_pose(T0, T1, fraction)
    np.testing.assert_allclose(T[:3, :3], Slerp([0, 1], rotations)(fraction).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(T[:3, 3], (1 - fraction) * T0[:3, 3] + fraction * T1[:3, 3], atol=1e-9)


@given(poses, poses)
def test_interpolation_meets_its_ends(T0, T1):
    np.testing.assert_allclose(interpolate_pose(T0, T1, 0), T0, atol=1e-7)
    np.testing.assert_allclose(interpolate_pose(T0, T1, 1), T1, atol=1e-7)


def test_extrapolation_goes_on_turning():
    T0 = transform_matrix([0, 0, 0], [0, 0, 0, 1])
    T1 = transform_matrix([1, 0, 0], [0, 0, np.sin(0.05), np.cos(0.05)])
    T = interpolate_pose(T0, T1, 1.5)
    assert yaw_of(T) == pytest.approx(0.15)
    np.testing.assert_allclose(T[:3, 3], [1.5, 0, 0])


def test_interpolation_of_equal_poses_is_that_pose():
    T = transform_matrix([1, 2, 3], [0.1, 0.2, 0.3, 0.9])
    np.testing.assert_allclose(interpolate_pose(T, T, 0.3), T, atol=1e-12)


def test_inverse_of_a_stack():
    stack = np.stack([transform_matrix([1, 2, 3], [0, 0, 0, 1]), transform_matrix([0, 1, 0], [0, 0, 1, 1])])
    np.testing.assert_allclose(stack @ inverse(stack), np.broadcast_to(np.eye(4), (2, 4, 4)), atol=1e-12)


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1]])
def test_impossible_quaternion_is_refused(quaternion):
    with pytest.raises(ValueError, match="not a rigid transform"):
        transform_matrix([0, 0, 0], quaternion)


def test_wrong_shape_is_refused():
    with pytest.raises(ValueError, match="got \\(2,\\)"):
        transform_matrix([0, 0], [0, 0, 0, 1])
