"""Messages as they lie in a recording or arrive on a bus: bytes, with the schema that says what they are."""

from collections.abc import Callable
from typing import Any, NamedTuple


class LoggedSchema(NamedTuple):
    """What a file says about a type of message; enough to decode it, whoever wrote it."""

    name: str  # pcgan.v1.LidarClusters, sensor_msgs/msg/CameraInfo, sensor_msgs/CameraInfo (ROS 1), foxglove.PointCloud
    encoding: str  # of the definition: protobuf, ros2msg, ros2idl, ros1msg, jsonschema
    definition: bytes


NO_SCHEMA = LoggedSchema("", "", b"")


class RawMessage(NamedTuple):
    """One message as it lies in the file."""

    topic: str
    log_time_ns: int
    schema: LoggedSchema
    encoding: str  # of the data: protobuf, cdr, ros1, json
    data: bytes


class ChannelInfo(NamedTuple):
    """What a file says about one topic."""

    topic: str
    schema: LoggedSchema
    encoding: str
    messages: int


class Decoder(NamedTuple):
    """Bytes of one schema -> dataclasses of `schemas.messages`."""

    message: str  # name of the dataclass
    decode: Callable[[bytes], Any]  # for transforms a tuple of them; raises CodecError naming what is wrong
