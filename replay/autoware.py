"""Tracks and predictions as Autoware's TrackedObjects and PredictedObjects: ROS 2 messages with their definitions.

Autoware's conventions, where they differ from ours: a pose is the middle of its shape, not the feet; a velocity is
along the object's own axes; a predicted path begins with the present pose, then steps of `time_step` follow.
"""

import math
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from replay.drawing import PERSON_HEIGHT_M, PERSON_RADIUS_M
from schemas.messages import FloatArray, ModalPath, Prediction, PredictionFrame, Track, TrackFrame
from schemas.topics import Topic

PACKAGE = "autoware_perception_msgs"
TRACKED_OBJECTS = Topic("/pcgan/tracked_objects", "tracks", f"{PACKAGE}/msg/TrackedObjects")
PREDICTED_OBJECTS = Topic("/pcgan/predicted_objects", "predictions", f"{PACKAGE}/msg/PredictedObjects")

MOVING_MPS = 0.3  # who is slower has a velocity, but its direction is mostly noise: no heading is given
MAX_PATHS = MAX_POSES = 100  # bounds of autoware_auto_perception_msgs; the present messages have none, their users may
UNKNOWN_HEADING_VARIANCE_RAD2 = math.pi**2 / 3  # of an angle that may be anything


def tracked_objects(tracks: TrackFrame, ground_m: float) -> bytes:
    """Returns the frame's tracks as a TrackedObjects; `ground_m` is the height of the ground in the tracks' frame."""
    types = _types()
    objects = []
    for track in tracks.tracks:
        heading = _heading_rad(track)
        kinematics = types["TrackedObjectKinematics"](
            *_kinematics(track, heading, ground_m),
            orientation_availability=_UNAVAILABLE if heading is None else _AVAILABLE,
            is_stationary=heading is None,
        )
        objects.append(_object("TrackedObject", tracks.epoch, track, kinematics))
    message = types["TrackedObjects"](_header(tracks), objects)
    return bytes(_typestore().serialize_cdr(message, TRACKED_OBJECTS.message, little_endian=True))


def predicted_objects(tracks: TrackFrame, predictions: PredictionFrame, ground_m: float) -> bytes:
    """Returns the frame's tracks with their predicted paths as a PredictedObjects, the likeliest path first.

    A track without a prediction has no paths. At most MAX_PATHS paths of MAX_POSES poses are given, the present one
    counted.
    """
    types = _types()
    prediction_of = {prediction.track_id: prediction for prediction in predictions.predictions}
    time_step = types["Duration"](*divmod(round(predictions.dt_s * 1e9), 1_000_000_000))
    objects = []
    for track in tracks.tracks:
        heading = _heading_rad(track)
        prediction = prediction_of.get(track.id)
        paths = [] if prediction is None else _paths(track, heading, prediction, time_step, ground_m)
        kinematics = types["PredictedObjectKinematics"](*_kinematics(track, heading, ground_m), paths)
        objects.append(_object("PredictedObject", tracks.epoch, track, kinematics))
    message = types["PredictedObjects"](_header(tracks), objects)
    return bytes(_typestore().serialize_cdr(message, PREDICTED_OBJECTS.message, little_endian=True))


def object_id(epoch: int, track_id: int) -> UUID:
    """Returns the UUID of a track, which shows both numbers: version 8 (RFC 9562), epoch in front, id behind.

    Track 42 of epoch 0 is 00000000-0000-8000-8000-00000000002a. Ids from 2**62 on would share theirs with smaller ones.
    """
    return UUID(int=(epoch & 0xFFFF_FFFF) << 80 | 8 << 76 | 2 << 62 | track_id & 0x3FFF_FFFF_FFFF_FFFF)


def definition(message: str) -> str:
    """Returns the definition of a message and of all that it is made of, as MCAP embeds it (encoding ros2msg)."""
    return _typestore().generate_msgdef(message, ros_version=2)[0]


def channel_metadata(message: str, *, named_qos: bool) -> dict[str, str]:
    """Returns the metadata that rosbag2 wants of a channel: what the publisher offered, and the hash of the type.

    Args:
        message: type of the channel's messages.
        named_qos: policies by name, as rosbag2 has them since Jazzy, instead of by number. It reads all channels of a
            file in one way: by name if the file's record "rosbag2" says version 9, else by number.
    """
    policies = ("keep_last", "reliable", "volatile", "automatic") if named_qos else (1, 1, 2, 1)
    history, reliability, durability, liveliness = policies
    forever = "\n    sec: 9223372036\n    nsec: 854775807"
    return {
        "offered_qos_profiles": (
            f"- history: {history}\n  depth: 10\n  reliability: {reliability}\n  durability: {durability}\n"
            f"  deadline:{forever}\n  lifespan:{forever}\n  liveliness: {liveliness}\n"
            f"  liveliness_lease_duration:{forever}\n  avoid_ros_namespace_conventions: false"
        ),
        "topic_type_hash": _typestore().hash_rihs01(message),
    }


# --- objects -------------------------------------------------------------------------------------------------------


def _heading_rad(track: Track) -> float | None:
    """Returns where a track walks to, seen from above; None if it does not walk."""
    vx, vy = track.state[2:].tolist()
    return math.atan2(vy, vx) if math.hypot(vx, vy) >= MOVING_MPS else None


def _object(name: str, epoch: int, track: Track, kinematics: Any) -> Any:
    types = _types()
    uuid = types["UUID"](np.frombuffer(object_id(epoch, track.id).bytes, np.uint8))
    pedestrian = types["ObjectClassification"](label=_PEDESTRIAN, probability=1.0)
    return types[name](uuid, track.existence, [pedestrian], kinematics, _person())


def _kinematics(track: Track, heading: float | None, ground_m: float) -> tuple[Any, Any, Any]:
    """Returns pose, velocity and acceleration of a track with their covariances; the acceleration is not estimated."""
    types = _types()
    x, y, vx, vy = track.state.tolist()
    cos, sin = (1.0, 0.0) if heading is None else (math.cos(heading), math.sin(heading))
    own_from_map = np.array([[cos, sin], [-sin, cos]])
    velocity_cov = own_from_map @ track.covariance[2:, 2:] @ own_from_map.T  # ahead and to the left
    forward, left = cos * vx + sin * vy, cos * vy - sin * vx
    # the heading is as uncertain as the speed to the side is, seen along the speed ahead
    heading_variance = UNKNOWN_HEADING_VARIANCE_RAD2
    if heading is not None:
        heading_variance = min(heading_variance, float(velocity_cov[1, 1]) / forward**2)
    return (
        types["PoseWithCovariance"](
            _pose(x, y, ground_m, heading), _covariance(track.covariance[:2, :2], heading_variance)
        ),
        types["TwistWithCovariance"](types["Twist"](_vector(forward, left, 0.0), _zero()), _covariance(velocity_cov)),
        types["AccelWithCovariance"](types["Accel"](_zero(), _zero()), np.zeros(36)),
    )


def _paths(track: Track, heading: float | None, prediction: Prediction, time_step: Any, ground_m: float) -> list[Any]:
    start = track.state[:2]
    return [
        _types()["PredictedPath"](_path_poses(start, path, heading, ground_m), time_step, path.probability)
        for path in prediction.paths[:MAX_PATHS]
    ]


def _path_poses(start_m: FloatArray, path: ModalPath, heading: float | None, ground_m: float) -> list[Any]:
    """Returns the present pose and those of the path; each looks at the next, the last one as the one before it."""
    places = [start_m.tolist(), *path.points_m[: MAX_POSES - 1].tolist()]
    poses = []
    for (x, y), (next_x, next_y) in pairwise(places):
        dx, dy = next_x - x, next_y - y
        if math.hypot(dx, dy) > _STEP_M:
            heading = math.atan2(dy, dx)
        poses.append(_pose(x, y, ground_m, heading))
    x, y = places[-1]
    return [*poses, _pose(x, y, ground_m, heading)]


_STEP_M = 1e-3  # a shorter step has no direction


def _covariance(block: FloatArray, about_z: float = 0.0) -> NDArray[np.float64]:
    """Returns a covariance of x, y, z and the rotations about them, row by row (36,); what is not estimated is 0."""
    full = np.zeros((6, 6))
    full[:2, :2] = block
    full[5, 5] = about_z
    return full.ravel()


def _pose(x: float, y: float, ground_m: float, heading: float | None) -> Any:
    types = _types()
    half = 0.0 if heading is None else heading / 2
    middle = types["Point"](x, y, ground_m + PERSON_HEIGHT_M / 2)
    return types["Pose"](middle, types["Quaternion"](0.0, 0.0, math.sin(half), math.cos(half)))


def _vector(x: float, y: float, z: float) -> Any:
    return _types()["Vector3"](x, y, z)


@cache
def _zero() -> Any:
    return _vector(0.0, 0.0, 0.0)


@cache
def _person() -> Any:
    """The person that `replay.drawing` draws; our tracks have no sizes."""
    dimensions = _vector(2 * PERSON_RADIUS_M, 2 * PERSON_RADIUS_M, PERSON_HEIGHT_M)
    return _types()["Shape"](type=_CYLINDER, footprint=_types()["Polygon"]([]), dimensions=dimensions)


def _header(tracks: TrackFrame) -> Any:
    stamp = _types()["Time"](*divmod(tracks.stamp_ns, 1_000_000_000))
    return _types()["Header"](stamp, tracks.frame_id)


# --- definitions ---------------------------------------------------------------------------------------------------

_PEDESTRIAN = 7  # constants of ObjectClassification, Shape and TrackedObjectKinematics
_CYLINDER = 1
_UNAVAILABLE, _AVAILABLE = 0, 2
_DEFINITIONS = Path(__file__).parent / "ros_definitions" / PACKAGE


@cache
def _typestore() -> Typestore:
    """ROS 2's own messages and Autoware's, the latter from the definitions in ros_definitions."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted(_DEFINITIONS.glob("*.msg")):
        store.register(get_types_from_msg(path.read_text(), f"{PACKAGE}/msg/{path.stem}"))
    return store


@cache
def _types() -> dict[str, Any]:
    """Classes of the messages by the last part of their names; those of the packages used here share none."""
    packages: Sequence[str] = (PACKAGE, "geometry_msgs", "std_msgs", "builtin_interfaces", "unique_identifier_msgs")
    return {name.split("/")[-1]: kind for name, kind in _typestore().types.items() if name.split("/")[0] in packages}
