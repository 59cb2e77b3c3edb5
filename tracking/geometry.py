"""Rigid transforms as 4 x 4 matrices, named target_from_source: points_map = apply(map_from_lidar, points_lidar)."""

import math

import numpy as np
from numpy.typing import ArrayLike

from schemas.messages import FloatArray


def transform_matrix(translation: ArrayLike, quaternion_xyzw: ArrayLike) -> FloatArray:
    """Returns the rigid transform (4, 4) that rotates by the quaternion, then moves by the translation.

    Args:
        translation: (3,) m, in the target frame.
        quaternion_xyzw: (4,) scalar last; any length but zero, since logged ones are rounded.

    Raises:
        ValueError: a number is not finite, a shape is wrong, or the quaternion has length zero.
    """
    t, q = np.asarray(translation, float), np.asarray(quaternion_xyzw, float)
    if t.shape != (3,) or q.shape != (4,):
        raise ValueError(f"translation must have shape (3,) and quaternion_xyzw (4,), got {t.shape} and {q.shape}")
    x, y, z, w = map(float, q)
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not (math.isfinite(norm) and norm > 0 and math.isfinite(float(t.sum()))):
        raise ValueError(f"not a rigid transform: translation {t.tolist()}, quaternion {q.tolist()}")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), t[0]],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), t[1]],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), t[2]],
        [0.0, 0.0, 0.0, 1.0],
    ])  # fmt: skip


def inverse(T: FloatArray) -> FloatArray:
    """Returns source_from_target (4, 4) for a rigid target_from_source; a stack (..., 4, 4) gives a stack."""
    T = np.asarray(T, float)
    R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = R_transposed
    out[..., :3, 3] = -(R_transposed @ T[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def apply(T: FloatArray, points: FloatArray) -> FloatArray:
    """Returns points (..., 3) of the source frame in the target frame of T (4, 4)."""
    moved: FloatArray = np.asarray(points, float) @ T[:3, :3].T + T[:3, 3]
    return moved


def yaw_of(T: FloatArray) -> float:
    """Returns the heading in rad, -pi to pi, of the source frame's x axis seen from above in the target frame."""
    return math.atan2(float(T[1, 0]), float(T[0, 0]))


def quaternion_of(T: FloatArray) -> FloatArray:
    """Returns the rotation of T (4, 4) as a unit quaternion (4,), scalar last and not negative."""
    R = [[float(value) for value in row[:3]] for row in T[:3]]
    # Four times each squared component; dividing by the largest one keeps every digit (Shepperd 1978).
    squares = (
        1 + R[0][0] - R[1][1] - R[2][2],
        1 - R[0][0] + R[1][1] - R[2][2],
        1 - R[0][0] - R[1][1] + R[2][2],
        1 + R[0][0] + R[1][1] + R[2][2],
    )
    xy, xz, yz = R[0][1] + R[1][0], R[0][2] + R[2][0], R[1][2] + R[2][1]
    wx, wy, wz = R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1]
    rows = ((squares[0], xy, xz, wx), (xy, squares[1], yz, wy), (xz, yz, squares[2], wz), (wx, wy, wz, squares[3]))
    q = np.array(rows[max(range(4), key=squares.__getitem__)])
    q /= math.sqrt(float(q @ q))
    unit: FloatArray = -q if q[3] < 0 else q
    return unit


def interpolate_pose(T0: FloatArray, T1: FloatArray, fraction: float) -> FloatArray:
    """Returns the pose (4, 4) a fraction of the way from T0 to T1: straight line in position, slerp in rotation.

    A fraction of 0 gives T0 and 1 gives T1; outside 0 to 1 the motion is extrapolated at the same rates. The rotation
    takes the shorter way round.
    """
    q0, q1 = quaternion_of(T0), quaternion_of(T1)
    dot = float(q0 @ q1)
    if dot < 0:
        q1, dot = -q1, -dot
    # atan2 of chord and sum is exact for the tiny angles between neighbouring poses, where acos is not.
    angle = 2 * math.atan2(float(np.linalg.norm(q1 - q0)), float(np.linalg.norm(q1 + q0)))
    if angle < 1e-9:
        q = q0 + fraction * (q1 - q0)
    else:
        q = (math.sin((1 - fraction) * angle) * q0 + math.sin(fraction * angle) * q1) / math.sin(angle)
    translation = T0[:3, 3] + fraction * (T1[:3, 3] - T0[:3, 3])
    return transform_matrix(translation, q)


def ground_heights(map_from_vehicle: FloatArray, places_m: FloatArray, below_m: float = 0.0) -> FloatArray:
    """Returns the height (N,) in m, target frame, of the vehicle's ground plane at places (N, 2) of that frame.

    The plane is parallel to the vehicle's x and y axes and lies `below_m` under its origin. A vehicle on its side has
    none: its own height stands for it.
    """
    up = map_from_vehicle[:3, 2]
    origin = map_from_vehicle[:3, 3] - below_m * up
    if up[2] < 0.5:
        return np.full(len(places_m), origin[2])
    heights: FloatArray = origin[2] - ((places_m - origin[:2]) @ up[:2]) / up[2]
    return heights
