"""Our drives as a user of Foxglove's schemas writes them: in protobuf or JSON, with other libraries' writers.

What Foxglove has a schema for is in it: poses, transforms, calibrations. Detections, clusters and ground truth stay
pcgan.v1, as Foxglove has nothing for them. Nothing here uses the package's own decoders or encoders.
"""

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from foxglove_schemas_protobuf import CameraCalibration_pb2, FrameTransforms_pb2  # noqa: F401  (declare their messages)
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.reader import make_reader
from mcap.writer import Writer as PlainWriter
from mcap_protobuf.writer import Writer as ProtobufWriter

from schemas import pcgan_v1_pb2 as pb


class Foreign(NamedTuple):
    """A message of a drive in the protobuf that a user of Foxglove would log."""

    topic: str
    log_time_ns: int
    message: Message


def as_foxglove(source: Path, target: Path) -> Path:
    """Rewrites a drive in protobuf, with mcap-protobuf-support; returns the target."""
    with target.open("wb") as stream, ProtobufWriter(stream) as writer:
        for topic, log_time_ns, message in _foreign(source):
            writer.write_message(topic, message, log_time_ns, log_time_ns)
    return target


def as_foxglove_json(source: Path, target: Path) -> Path:
    """Rewrites a drive in JSON with JSON schemas, with mcap's plain writer; returns the target."""
    channels: dict[str, int] = {}
    with target.open("wb") as stream:
        writer = PlainWriter(stream)
        writer.start()
        for topic, log_time_ns, message in _foreign(source):
            if topic not in channels:
                name = message.DESCRIPTOR.full_name
                definition = json.dumps(json_schema(message.DESCRIPTOR)).encode()
                channels[topic] = writer.register_channel(
                    topic, "json", writer.register_schema(name, "jsonschema", definition)
                )
            data = json.dumps(plain(message)).encode()
            writer.add_message(channels[topic], log_time_ns, data, log_time_ns)
        writer.finish()
    return target


def plain(message: Message) -> Any:
    """Returns a protobuf message as what `json.dumps` takes, in the form of Foxglove's JSON schemas.

    Names in snake case, bytes in base64, enums as numbers, stamps as sec and nsec. A sub-message that is not set is
    left out.
    """
    if isinstance(message, Timestamp):
        return {"sec": message.seconds, "nsec": message.nanos}
    fields = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.is_repeated:
            fields[field.name] = [_plain_value(item) for item in value]
        elif field.message_type is None or message.HasField(field.name):
            fields[field.name] = _plain_value(value)
    return fields


def _plain_value(value: Any) -> Any:
    match value:
        case Message():
            return plain(value)
        case bytes():
            return base64.b64encode(value).decode()
    return value


def json_schema(descriptor: Any) -> dict[str, Any]:
    """Returns a JSON schema of what `plain` makes of a message."""
    if descriptor.full_name == Timestamp.DESCRIPTOR.full_name:
        integer = {"type": "integer"}
        return {"type": "object", "title": "time", "properties": {"sec": integer, "nsec": integer}}
    properties = {}
    for field in descriptor.fields:
        if field.message_type is not None:
            one = json_schema(field.message_type)
        elif field.cpp_type == field.CPPTYPE_STRING:
            one = {"type": "string", **({"contentEncoding": "base64"} if field.type == field.TYPE_BYTES else {})}
        else:
            one = {"type": "number"}
        properties[field.name] = {"type": "array", "items": one} if field.is_repeated else one
    return {"title": descriptor.full_name, "type": "object", "properties": properties}


def _foreign(source: Path) -> Iterator[Foreign]:
    """Yields a drive's messages in order of log time, poses as Foxglove's Odometry."""
    pool = descriptor_pool.Default()
    with source.open("rb") as stream:
        for schema, channel, record in make_reader(stream).iter_messages():
            message = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(record.data)
            yield Foreign(
                channel.topic, record.log_time, odometry(message) if isinstance(message, pb.VehiclePose) else message
            )


def odometry(pose: pb.VehiclePose) -> Odometry:
    """Returns a pose of ours as Foxglove's Odometry."""
    message = Odometry(frame_id=pose.frame_id, body_frame_id=pose.child_frame_id)
    message.timestamp.seconds, message.timestamp.nanos = divmod(pose.stamp_ns, 1_000_000_000)
    position, orientation = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = pose.x, pose.y, pose.z
    orientation.x, orientation.y, orientation.z, orientation.w = pose.qx, pose.qy, pose.qz, pose.qw
    linear, angular = message.linear_velocity, message.angular_velocity
    linear.x, linear.y, linear.z = pose.vx, pose.vy, pose.vz
    angular.x, angular.y, angular.z = pose.wx, pose.wy, pose.wz
    return message
