"""Recordings as other stacks write them: our simulated drives as ROS 2 and ROS 1 messages, by other people's writers.

A message is a nested dict first; `Stack.filled` puts in what its definition has besides. Then either rosbags or
mcap-ros2-support or genpy (of mcap-ros1-support) turns it into bytes, so that no reader is tested against itself.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros1.decoder import dynamic as genpy
from mcap_ros1.writer import Writer as Ros1Writer
from mcap_ros2.writer import Writer as Ros2Writer
from mcap_ros2.writer import serialize_dynamic
from rosbags import rosbag2
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from replay.decoders import decoders_for
from replay.log_reader import LogReader
from replay.logged_message import LoggedSchema
from replay.ros_objects import expected_points
from schemas import codec
from schemas.messages import (
    CameraCalibration,
    CameraDetections,
    GroundTruthFrame,
    LidarClusters,
    PointCloud,
    Transform,
    VehiclePose,
)

CLASS_IDS = {"car": 2, "person": 7}  # of vision_msgs 1.x, where classes are numbers
ROS1_PEDESTRIAN = str(CLASS_IDS["person"])  # the label under which people come out of `as_ros1`

_TF_MESSAGE = "geometry_msgs/TransformStamped[] transforms"
_ARRAY = "std_msgs/Header header\nDetection{n}D[] detections"
_BOX_3D = "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size"
_BOX_2D = "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y"
_DETECTION = "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox{n}D bbox"
_OLD_DETECTIONS = {
    "Detection2D": f"{_DETECTION.format(n=2)}\nsensor_msgs/Image source_img",
    "Detection3D": f"{_DETECTION.format(n=3)}\nsensor_msgs/PointCloud2 source_cloud",
    "BoundingBox2D": _BOX_2D,
}
_TRACKING = "\nbool is_tracking\nstring tracking_id"
_HYPOTHESIS = {
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "Detection2D": f"{_DETECTION.format(n=2)}\nstring id",
    "Detection3D": f"{_DETECTION.format(n=3)}\nstring id",
}
_RESULT = "{kind} id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose"
_COMMON = {
    "Detection2DArray": _ARRAY.format(n=2),
    "Detection3DArray": _ARRAY.format(n=3),
    "BoundingBox3D": _BOX_3D,
}
VISION_MSGS: dict[int, dict[str, str]] = {
    1: _COMMON | _OLD_DETECTIONS | {"ObjectHypothesisWithPose": _RESULT.format(kind="int64")},
    2: _COMMON
    | {name: text + _TRACKING * name.startswith("Detection") for name, text in _OLD_DETECTIONS.items()}
    | {"ObjectHypothesisWithPose": _RESULT.format(kind="string")},
    3: _COMMON | _HYPOTHESIS | {"BoundingBox2D": _BOX_2D},
    4: _COMMON
    | _HYPOTHESIS
    | {
        "Point2D": "float64 x\nfloat64 y",
        "Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
        "BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    },
}  # major version -> name -> definition


class Stack:
    """The message types of a robot: ROS 1 with vision_msgs 1.x, or ROS 2 with a later one, and what else it has."""

    def __init__(self, vision_msgs: int, others: Mapping[str, str] | None = None):
        """Registers the types; `others` are definitions by full name, such as a_msgs/msg/Thing."""
        self.vision_msgs = vision_msgs
        self.ros = 1 if vision_msgs == 1 else 2
        self.encoding = "ros1" if self.ros == 1 else "cdr"
        self.store: Typestore = get_typestore(Stores.ROS1_NOETIC if self.ros == 1 else Stores.ROS2_JAZZY)
        texts = {f"vision_msgs/msg/{name}": text for name, text in VISION_MSGS[vision_msgs].items()}
        if self.ros == 1:  # which rosbags leaves out
            texts |= dict.fromkeys(("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"), _TF_MESSAGE)
        texts |= dict(others or {})
        types = {}
        for name, text in texts.items():
            types |= get_types_from_msg(text, name)
        self.store.register(types)

    def name(self, full: str) -> str:
        """Returns a type's name as this ROS writes it: without "msg" in ROS 1."""
        return full.replace("/msg/", "/") if self.ros == 1 else full

    def definition(self, full: str) -> str:
        """Returns the definition of a type and of all types in it, as a recording embeds it."""
        return self.store.generate_msgdef(full, ros_version=self.ros)[0]

    def schema(self, full: str) -> LoggedSchema:
        """Returns what a recording says of a type."""
        return LoggedSchema(self.name(full), f"ros{self.ros}msg", self.definition(full).encode())

    def filled(self, full: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """Returns a message with all its fields: the given ones, and zeros."""
        fields = self.store.fielddefs[full][1]
        if unknown := set(values) - {name for name, _ in fields}:
            raise KeyError(f"{full} has no {sorted(unknown)}")
        return {name: self._value(kind, what, values.get(name)) for name, (kind, what) in fields}

    def _value(self, kind: int, what: Any, value: Any) -> Any:
        if kind == Nodetype.NAME:
            return self.filled(what, value or {})
        if kind == Nodetype.BASE:
            return ("" if what[0] == "string" else 0) if value is None else value
        element, length = what
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            zeros = [0] * (length if kind == Nodetype.ARRAY else 0)
            return np.array(zeros if value is None else value, element[1][0].replace("byte", "uint8"))
        return [self._value(*element, item) for item in value or ()]

    def rosbags_message(self, full: str, values: Mapping[str, Any]) -> object:
        """Returns a filled message as an object of rosbags."""
        made = {}
        for name, (kind, what) in self.store.fielddefs[full][1]:
            value = values[name]
            if kind == Nodetype.NAME:
                value = self.rosbags_message(what, value)
            elif kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and what[0][0] == Nodetype.NAME:
                value = [self.rosbags_message(what[0][1], item) for item in value]
            made[name] = value
        return self.store.types[full](**made)

    def rosbags_bytes(self, full: str, values: Mapping[str, Any], *, little_endian: bool = True) -> bytes:
        """Returns a message, serialised by rosbags."""
        message = self.rosbags_message(full, self.filled(full, values))
        if self.ros == 1:
            return bytes(self.store.serialize_ros1(message, full))
        return bytes(self.store.serialize_cdr(message, full, little_endian=little_endian))

    def other_bytes(self, full: str, values: Mapping[str, Any]) -> bytes:
        """Returns a message, serialised by mcap-ros2-support or, in ROS 1, by genpy."""
        filled = self.filled(full, values)
        if self.ros == 2:
            return bytes(serialize_dynamic(full, self.definition(full))[full](namespace(filled)))
        buffer = _Buffer()
        genpy_message(self, full, filled).serialize(buffer)
        return buffer.data


class _Buffer:
    """What genpy writes into."""

    data = b""

    def write(self, data: bytes) -> None:
        self.data += data


def namespace(value: Any) -> Any:
    """Returns nested dicts and arrays as the objects and lists that mcap-ros2-support takes."""
    if isinstance(value, dict):
        return SimpleNamespace(**{name: namespace(item) for name, item in value.items()})
    if isinstance(value, np.ndarray):
        return value.tobytes() if value.dtype == np.uint8 else value.tolist()
    return [namespace(item) for item in value] if isinstance(value, list) else value


@cache
def _genpy_types(name: str, definition: str) -> dict[str, Any]:
    types: dict[str, Any] = genpy.generate_dynamic(name, definition)
    return types


def genpy_message(stack: Stack, full: str, values: Mapping[str, Any]) -> Any:
    """Returns a filled ROS 1 message as an object of genpy."""
    types = _genpy_types(stack.name(full), stack.definition(full))

    def made(name: str, values: Mapping[str, Any]) -> Any:
        message = types[name]()
        for field, kind in zip(message.__slots__, message._slot_types, strict=True):
            value = values[field]
            if kind == "time":
                stamp = getattr(message, field)
                stamp.secs, stamp.nsecs = value["sec"], value["nanosec"]
                continue
            if isinstance(value, dict):
                value = made(kind, value)
            elif isinstance(value, list):
                value = [made(kind.removesuffix("[]"), item) if isinstance(item, dict) else item for item in value]
            elif isinstance(value, np.ndarray):
                value = value.tobytes() if value.dtype == np.uint8 else value.tolist()
            setattr(message, field, value)
        return message

    return made(stack.name(full), values)


# --- our messages as dicts -----------------------------------------------------------------------------------------


def time_of(stamp_ns: int) -> dict[str, int]:
    """Returns a builtin_interfaces/Time."""
    return {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}


def header(stamp_ns: int, frame_id: str) -> dict[str, Any]:
    """Returns a std_msgs/Header."""
    return {"stamp": time_of(stamp_ns), "frame_id": frame_id}


def vector(xyz: Any) -> dict[str, float]:
    """Returns a Point or Vector3."""
    return dict(zip("xyz", map(float, xyz), strict=True))


def rotation(xyzw: Any = (0.0, 0.0, 0.0, 1.0)) -> dict[str, float]:
    """Returns a Quaternion."""
    return dict(zip("xyzw", map(float, xyzw), strict=True))


def result(stack: Stack, label: str, score: float) -> dict[str, Any]:
    """Returns a vision_msgs/ObjectHypothesisWithPose."""
    match stack.vision_msgs:
        case 1:
            return {"id": CLASS_IDS[label], "score": score}
        case 2:
            return {"id": label, "score": score}
    return {"hypothesis": {"class_id": label, "score": score}}


def box_2d(stack: Stack, x: float, y: float, size_x: float, size_y: float, theta: float = 0.0) -> dict[str, Any]:
    """Returns a vision_msgs/BoundingBox2D around a centre."""
    place = {"x": x, "y": y} if stack.vision_msgs < 4 else {"position": {"x": x, "y": y}}
    return {"center": {**place, "theta": theta}, "size_x": size_x, "size_y": size_y}


def box_3d(centre: Any, size: Any, xyzw: Any = (0.0, 0.0, 0.0, 1.0)) -> dict[str, Any]:
    """Returns a vision_msgs/BoundingBox3D."""
    return {"center": {"position": vector(centre), "orientation": rotation(xyzw)}, "size": vector(size)}


def detection_array(stack: Stack, detections: CameraDetections) -> dict[str, Any]:
    """Returns a vision_msgs/Detection2DArray."""
    head = header(detections.stamp_ns, detections.frame_id)
    rows = zip(detections.boxes_px.tolist(), detections.scores.tolist(), detections.labels, strict=True)
    return {
        "header": head,
        "detections": [
            {
                "header": head,
                "results": [result(stack, label, score)],
                "bbox": box_2d(stack, (x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0),
            }
            for (x0, y0, x1, y1), score, label in rows
        ],
    }


def cluster_array(_: Stack, clusters: LidarClusters) -> dict[str, Any]:
    """Returns a vision_msgs/Detection3DArray; no version of it has a field for the numbers of points."""
    head = header(clusters.stamp_ns, clusters.frame_id)
    boxes = zip(clusters.centroids_m.tolist(), clusters.sizes_m.tolist(), strict=True)
    return {"header": head, "detections": [{"header": head, "bbox": box_3d(*box)} for box in boxes]}


def camera_info(stack: Stack, calibration: CameraCalibration) -> dict[str, Any]:
    """Returns a sensor_msgs/CameraInfo."""
    K = np.asarray(calibration.intrinsics_px, float)
    matrices = {
        "d": calibration.distortion,
        "k": K.ravel(),
        "r": np.eye(3).ravel(),
        "p": np.hstack([K, np.zeros((3, 1))]).ravel(),
    }
    return {
        "header": header(calibration.stamp_ns, calibration.frame_id),
        "width": calibration.width_px,
        "height": calibration.height_px,
        "distortion_model": calibration.model,
        **{name.upper() if stack.ros == 1 else name: matrix for name, matrix in matrices.items()},
    }


def odometry(_: Stack, pose: VehiclePose) -> dict[str, Any]:
    """Returns a nav_msgs/Odometry."""
    place = {"position": vector(pose.position_m), "orientation": rotation(pose.quaternion_xyzw)}
    twist = {"linear": vector(pose.velocity_mps), "angular": vector(pose.angular_velocity_radps)}
    return {
        "header": header(pose.stamp_ns, pose.frame_id),
        "child_frame_id": pose.child_frame_id,
        "pose": {"pose": place},
        "twist": {"twist": twist},
    }


def tf_message(_: Stack, transforms: tuple[Transform, ...]) -> dict[str, Any]:
    """Returns a tf2_msgs/TFMessage."""
    return {
        "transforms": [
            {
                "header": header(transform.stamp_ns, transform.parent_frame_id),
                "child_frame_id": transform.child_frame_id,
                "transform": {
                    "translation": vector(transform.translation_m),
                    "rotation": rotation(transform.quaternion_xyzw),
                },
            }
            for transform in transforms
        ]
    }


def point_cloud(_: Stack, cloud: PointCloud) -> dict[str, Any]:
    """Returns a sensor_msgs/PointCloud2 of x, y, z in float32."""
    xyz = np.ascontiguousarray(cloud.points_m, np.float32)
    return {
        "header": header(cloud.stamp_ns, cloud.frame_id),
        "height": 1,
        "width": len(xyz),
        "fields": [{"name": name, "offset": 4 * k, "datatype": 7, "count": 1} for k, name in enumerate("xyz")],
        "point_step": 12,
        "row_step": 12 * len(xyz),
        "data": np.frombuffer(xyz.tobytes(), np.uint8),
        "is_dense": True,
    }


_FOREIGN: dict[type, tuple[str, Callable[[Stack, Any], dict[str, Any]]]] = {
    CameraDetections: ("vision_msgs/msg/Detection2DArray", detection_array),
    LidarClusters: ("vision_msgs/msg/Detection3DArray", cluster_array),
    PointCloud: ("sensor_msgs/msg/PointCloud2", point_cloud),
    CameraCalibration: ("sensor_msgs/msg/CameraInfo", camera_info),
    VehiclePose: ("nav_msgs/msg/Odometry", odometry),
    tuple: ("tf2_msgs/msg/TFMessage", tf_message),
}


class ForeignMessage(NamedTuple):
    """A message of a drive as another stack would have it."""

    topic: str
    log_time_ns: int
    type: str  # full name
    values: dict[str, Any]  # all fields


def foreign_messages(source: Path, stack: Stack) -> Iterator[ForeignMessage]:
    """Yields the messages of one of our drives, without its ground truth, under their own topics and log times."""
    for raw in LogReader([source]).messages():
        message = decoders_for(raw.schema, raw.encoding)[0].decode(raw.data)
        if isinstance(message, GroundTruthFrame):
            continue
        full, convert = _FOREIGN[type(message)]
        yield ForeignMessage(raw.topic, raw.log_time_ns, full, stack.filled(full, convert(stack, message)))


# --- whole drives --------------------------------------------------------------------------------------------------


def as_ros2(source: Path, target: Path, vision_msgs: int = 4, writer: str = "mcap_ros2") -> Path:
    """Rewrites one of our drives as a ROS 2 recording (MCAP, CDR) and returns its path.

    Detections and clusters become vision_msgs of the given major version (2, 3 or 4), the rest ROS's own messages;
    topics keep their names and messages their log times. The ground truth is left out.

    Args:
        source: the drive.
        target: the file.
        vision_msgs: major version.
        writer: "mcap_ros2", of mcap-ros2-support, or "rosbags", whose rosbag2 folder's file is moved to `target`.
    """
    stack = Stack(vision_msgs)
    messages = foreign_messages(source, stack)
    {"mcap_ros2": write_mcap_ros2, "rosbags": _write_rosbags}[writer](messages, target, stack)
    return target


def write_mcap_ros2(messages: Iterator[ForeignMessage], target: Path, stack: Stack) -> None:
    """Writes messages as a ROS 2 recording, with mcap-ros2-support."""
    schemas: dict[str, Any] = {}
    with target.open("wb") as stream, Ros2Writer(stream) as writer:
        for topic, log_time_ns, full, values in messages:
            if full not in schemas:
                schemas[full] = writer.register_msgdef(full, stack.definition(full))
            writer.write_message(topic, schemas[full], namespace(values), log_time_ns)


def _write_rosbags(messages: Iterator[ForeignMessage], target: Path, stack: Stack) -> None:
    with TemporaryDirectory(dir=target.parent) as name:
        folder = Path(name) / "bag"
        connections: dict[str, Any] = {}
        with rosbag2.Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            for topic, log_time_ns, full, values in messages:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, full, typestore=stack.store)
                data = stack.store.serialize_cdr(stack.rosbags_message(full, values), full)
                writer.write(connections[topic], log_time_ns, data)
        (folder / "bag.mcap").replace(target)


def as_ros1(source: Path, target: Path) -> Path:
    """Rewrites one of our drives as a ROS 1 recording (MCAP) with vision_msgs 1.x, written by genpy; returns its path.

    As `as_ros2`, but classes are numbers (`CLASS_IDS`): people have the label `ROS1_PEDESTRIAN`.
    """
    stack = Stack(1)
    with target.open("wb") as stream:
        writer = Ros1Writer(stream)
        for topic, log_time_ns, full, values in foreign_messages(source, stack):
            writer.write_message(topic, genpy_message(stack, full, values), log_time_ns)
        writer.finish()
    return target


def reduced(source: Path, target: Path) -> Path:
    """Copies one of our drives with what vision_msgs cannot carry replaced by what stands for it; returns its path.

    That is the clusters' numbers of points; everything else comes through ROS exactly, labels of ROS 1 aside. The
    ground truth is left out.
    """
    with source.open("rb") as stream, target.open("wb") as copy:
        writer = Writer(copy)
        writer.start(profile="", library="pcgan tests")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if schema.name == codec.schema_name(GroundTruthFrame):
                continue
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            data = message.data
            if schema.name == codec.schema_name(LidarClusters):
                data = codec.encode(without_counts(codec.decode(LidarClusters, data)))
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time)
        writer.finish()
    return target


def without_counts(clusters: LidarClusters) -> LidarClusters:
    """Returns clusters with the numbers of points that the adapter assumes."""
    points = expected_points(clusters.centroids_m, clusters.sizes_m)
    return LidarClusters(clusters.stamp_ns, clusters.frame_id, clusters.centroids_m, clusters.sizes_m, points)
