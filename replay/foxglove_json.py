"""JSON messages -> message dataclasses: Foxglove's, and our own, which users log as JSON beside them.

A message is put into its protobuf and checked as if it had been logged so. Names may be in snake_case, as in Foxglove's
JSON schemas, or in camelCase, as in protobuf's canonical JSON; what a message does not know is ignored.
"""

import base64
import json
from functools import cache, partial
from typing import Any

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.json_format import ParseDict, ParseError
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp

from replay import foxglove
from replay.logged_message import Decoder, LoggedSchema
from schemas import codec
from schemas.codec import CodecError

Descriptor = Any  # protobuf has one class of descriptors per backend
# Foxglove has had two names for an Odometry's second frame.
_RENAMED = {"child_frame_id": "body_frame_id", "childFrameId": "body_frame_id"}


def decoders(schema: LoggedSchema) -> tuple[Decoder, ...]:
    """Returns the way to read JSON messages of a schema, told by its name; none for types that play no role here."""
    if schema.name in foxglove.MESSAGES:
        return (Decoder(foxglove.MESSAGES[schema.name], partial(_decode_foxglove, schema.name)),)
    if schema.name in codec.MESSAGE_TYPES:
        message_type = codec.MESSAGE_TYPES[schema.name]
        return (Decoder(message_type.__name__, partial(_decode_ours, message_type)),)
    return ()


def _decode_foxglove(schema_name: str, data: bytes) -> Any:
    message_class, _ = foxglove.DECODERS[schema_name]
    return foxglove.from_protobuf(_foxglove_message(_document(data, schema_name), message_class))


def _decode_ours(message_type: type, data: bytes) -> Any:
    message = _parsed(_document(data, codec.schema_name(message_type)), codec.protobuf_type(message_type))
    return codec.decode(message_type, message.SerializeToString())


def _document(data: bytes, schema_name: str) -> dict[str, Any]:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:  # ValueError: no JSON, no UTF-8, or an integer of thousands of digits
        raise CodecError(f"not a {schema_name}: {error}") from error
    if not isinstance(document, dict):
        raise CodecError(f"not a {schema_name}: {_kind(document)} instead of an object")
    return document


def _foxglove_message(document: dict[str, Any], message_class: type[Message]) -> Any:
    """Parses a message of Foxglove's, whose stamps are objects of sec and nsec, or RFC 3339 strings."""
    if message_class is FrameTransforms:
        transforms = FrameTransforms()
        for each in _objects(document.get("transforms"), "FrameTransforms.transforms"):
            transforms.transforms.append(_foxglove_message(each, FrameTransform))
        return transforms
    if message_class is Odometry:
        document = {_RENAMED.get(key, key): value for key, value in document.items()}
    stamp = document.pop("timestamp") if isinstance(document.get("timestamp"), dict) else None
    message = _parsed(document, message_class)
    if stamp is not None:
        _set_stamp(message, stamp)
    return message


def _set_stamp(message: Any, stamp: dict[str, Any]) -> None:
    name = f"{message.DESCRIPTOR.name}.timestamp"
    sec, nsec = stamp.get("sec", 0), stamp.get("nsec", 0)
    if not stamp.keys() <= {"sec", "nsec"} or type(sec) is not int or type(nsec) is not int:
        raise CodecError(f"{name} {stamp} is not whole numbers sec and nsec")  # ROS's nanosec must not be lost
    try:
        message.timestamp.seconds, message.timestamp.nanos = sec, nsec
    except ValueError as error:
        raise CodecError(f"{name} {stamp} is out of range") from error


def _parsed(document: dict[str, Any], message_class: type[Message]) -> Message:
    """Returns a protobuf from its JSON; raises CodecError naming the field that is wrong."""
    known = _known(document, message_class.DESCRIPTOR)
    try:
        return message_class(**known)  # takes plain numbers, which are nearly all there are, several times faster
    except (TypeError, ValueError, OverflowError):
        pass
    try:
        # takes whole numbers of 64 bits as text, stamps as RFC 3339, and says which field is wrong
        return ParseDict(document, message_class(), ignore_unknown_fields=True)
    except (ParseError, ValueError, OverflowError) as error:
        raise CodecError(f"not a {message_class.DESCRIPTOR.full_name}: {error}") from error


def _known(document: dict[str, Any], descriptor: Descriptor) -> dict[str, Any]:
    """Returns what a message knows of a document, by its fields' names in protobuf; null is left out.

    Refuses what would otherwise be taken for zeros or for lists: null for a number (as JavaScript writes NaN), and text
    where an object or an array should be.
    """
    fields = _fields(descriptor)
    known: dict[str, Any] = {}
    for key, value in document.items():
        field = fields.get(key)
        if field is None:
            continue
        name = f"{descriptor.name}.{key}"
        if value is None:
            if not field.is_repeated and field.cpp_type not in _MAY_BE_NULL:
                raise CodecError(f"{name} is null, as JavaScript writes NaN")
        elif field.type == FieldDescriptor.TYPE_BYTES:
            known[field.name] = _bytes(value, name)
        elif field.message_type is None or field.message_type.full_name == _TIMESTAMP:
            known[field.name] = _array(value, name) if field.is_repeated else value
        elif field.is_repeated:
            known[field.name] = [_known(item, field.message_type) for item in _objects(value, name)]
        else:
            known[field.name] = _known(_object(value, name), field.message_type)
    return known


_TIMESTAMP = Timestamp.DESCRIPTOR.full_name
_MAY_BE_NULL = (FieldDescriptor.CPPTYPE_MESSAGE, FieldDescriptor.CPPTYPE_STRING)


@cache
def _fields(descriptor: Descriptor) -> dict[str, Any]:
    """Returns a message's fields by their names in JSON, of which each has two."""
    return {name: field for field in descriptor.fields for name in (field.name, field.json_name)}


def _bytes(value: Any, name: str) -> bytes:
    if not isinstance(value, str):
        raise CodecError(f"{name} is {_kind(value)} instead of text in base64")
    try:
        return base64.b64decode(value, validate=True)
    except ValueError as error:
        raise CodecError(f"{name} is not base64: {error}") from error


def _objects(items: Any, name: str) -> list[dict[str, Any]]:
    """Returns an array of objects; null is an array of none."""
    return [_object(item, name) for item in _array([] if items is None else items, name)]


def _array(value: Any, name: str) -> list[Any]:
    if not isinstance(value, list):
        raise CodecError(f"{name} is {_kind(value)} instead of an array")
    return value


def _object(value: Any, name: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise CodecError(f"{name} is {_kind(value)} instead of an object")
    return value


def _kind(value: Any) -> str:
    """Returns what JSON calls a value's type."""
    kinds = {bool: "true or false", str: "text", list: "an array", dict: "an object", type(None): "null"}
    return kinds.get(type(value), "a number")
