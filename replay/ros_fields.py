"""What the adapters of ROS messages share: the names of common fields, and checks of their values."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from replay.ros_reader import Values, Wanted
from schemas.codec import LARGEST, CodecError
from schemas.messages import FloatArray

NS_PER_S = 1_000_000_000


class Form(NamedTuple):
    """How a type of message becomes a dataclass."""

    message: str  # name of the dataclass
    wanted: Wanted
    make: Callable[..., Any]  # of the type's name, for errors, and the wanted values


# --- paths ---------------------------------------------------------------------------------------------------------

HEADER = ("header.stamp.sec", "header.stamp.nanosec", "header.frame_id")


def vector(path: str) -> tuple[str, ...]:
    """Returns the paths of a point or vector."""
    return tuple(f"{path}.{axis}" for axis in "xyz")


def quaternion(path: str) -> tuple[str, ...]:
    """Returns the paths of a quaternion, scalar last."""
    return tuple(f"{path}.{axis}" for axis in "xyzw")


def pose(path: str) -> tuple[str, ...]:
    """Returns the paths of a geometry_msgs/Pose: three of position, four of orientation."""
    return (*vector(f"{path}.position"), *quaternion(f"{path}.orientation"))


# --- values --------------------------------------------------------------------------------------------------------


def stamp(sec: int, nanosec: int, name: str, *, required: bool = True) -> int:
    """Returns a stamp in ns; static transforms may have none, for everything else CodecError is raised without."""
    stamp_ns = sec * NS_PER_S + nanosec
    if stamp_ns < 0 or (required and stamp_ns == 0):
        raise CodecError(f"{name} has no stamp (header.stamp {sec} s {nanosec} ns)")
    return stamp_ns


def frame(frame_id: str) -> str:
    """Returns the name of a frame without the leading slash that ROS 1 allowed."""
    return frame_id.removeprefix("/")


def checked(values: object, name: str) -> NDArray[np.float64]:
    """Returns numbers as an array; raises CodecError if one is NaN, infinite or absurdly large."""
    array = np.array(values, float)
    if array.size and not np.abs(array).max() <= LARGEST:  # NaN fails every comparison
        if not np.isfinite(array).all():
            raise CodecError(f"{name} holds NaN or infinity")
        raise CodecError(f"{name} holds {np.abs(array).max():.3g}, more than {LARGEST:g}")
    return array


def checked_rows(rows: Sequence[Values], columns: slice, name: str) -> NDArray[np.float64]:
    """Returns some columns of the numbers of several objects (M, columns), checked."""
    return checked([row[columns] for row in rows], name).reshape(len(rows), columns.stop - columns.start)


def probabilities(values: Sequence[float], name: str) -> FloatArray:
    """Returns numbers as an array; raises CodecError if one is not within 0 to 1."""
    array = np.array(values, float)
    for value in array.tolist():  # there are few: numpy would take longer
        if not 0 <= value <= 1:
            raise CodecError(f"{name} is {value:g}, outside 0 to 1")
    return array


def rotations(quaternions_xyzw: FloatArray, name: str) -> FloatArray:
    """Returns rotation matrices (M, 3, 3); four zeros, which is how ROS 1 leaves a field out, are no rotation.

    Raises CodecError for a quaternion (M, 4) whose length is neither 0 nor near 1.
    """
    squared = (quaternions_xyzw * quaternions_xyzw).sum(axis=1)
    unset = squared == 0
    lengths = np.where(unset, 1.0, np.sqrt(squared))
    if len(wrong := np.flatnonzero(np.abs(lengths - 1) >= 0.05)):
        raise CodecError(
            f"{name} {quaternions_xyzw[wrong[0]].tolist()} has length {lengths[wrong[0]]:.3g} instead of 1"
        )
    x, y, z, w = (quaternions_xyzw / lengths[:, None]).T
    R = np.empty((len(x), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return R
