"""ROS 2 (CDR) and ROS 1 messages -> message dataclasses, with the definitions that the recording embeds.

`ros_sensors` and `ros_objects` have a row per type of message: which fields are wanted, under all the names that
versions of its definition have for them, and the function that makes a dataclass of their values. As in
`schemas.codec`, what makes no sense raises `CodecError` naming the field.
"""

from functools import cached_property, lru_cache
from typing import Any

from replay import ros_objects, ros_sensors
from replay.logged_message import Decoder, LoggedSchema
from replay.ros_fields import Form
from replay.ros_reader import Definitions, Reader, full_name, parse, standard_definitions
from schemas.codec import CodecError

_FORMS: dict[str, tuple[Form, ...]] = ros_sensors.FORMS | ros_objects.FORMS


def decoders(schema: LoggedSchema, encoding: str) -> tuple[Decoder, ...]:
    """Returns the ways to read messages of a schema, the usual one first; none for types that play no role here.

    The definition is compiled when the first message is decoded. Without one, as on a live bus, ROS 2's own definitions
    are used. One that cannot be read, or lacks a field, raises CodecError with every message, so that whoever chose the
    topic learns why.

    Args:
        schema: of the channel; named in either way, sensor_msgs/msg/CameraInfo or sensor_msgs/CameraInfo.
        encoding: of the data: cdr or ros1.
    """
    return tuple(
        Decoder(form.message, _Decoding(schema, encoding, form)) for form in _FORMS.get(full_name(schema.name), ())
    )


class _Decoding:
    """Decodes messages of one schema to one dataclass."""

    def __init__(self, schema: LoggedSchema, encoding: str, form: Form):
        self._schema, self._encoding, self._form = schema, encoding, form
        self._name = schema.name.rpartition("/")[2]

    def __call__(self, data: bytes) -> Any:
        values = self._reader(data)
        try:
            return self._form.make(self._name, *values)
        except CodecError:
            raise
        except (ArithmeticError, TypeError, ValueError) as error:
            # a definition may give a field of the right name another type
            raise CodecError(f"{self._name} is not the usual message of that name: {error}") from error

    @cached_property
    def _reader(self) -> Reader:
        definitions = _definitions(self._schema, self._encoding)
        return Reader(definitions, full_name(self._schema.name), self._form.wanted, self._encoding)


@lru_cache(maxsize=256)
def _definitions(schema: LoggedSchema, encoding: str) -> Definitions:
    if schema.definition.strip():
        return parse(schema)
    if encoding != "cdr":
        raise CodecError(f"the recording has no definition of {schema.name}, without which ROS 1 cannot be read")
    known = standard_definitions()
    if full_name(schema.name) not in known:
        raise CodecError(f"{schema.name} comes without a definition, and is none of those that are known without")
    return known


def schemas_of(message: str) -> list[str]:
    """Returns the names of the ROS types that can become a dataclass, for people to read."""
    return sorted(name for name, forms in _FORMS.items() if any(form.message == message for form in forms))
