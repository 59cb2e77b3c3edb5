"""Logged bytes -> message dataclasses, by the schema embedded in the file. No stage cares how a log was written.

One module per family knows its formats: `schemas.codec` (pcgan.v1), `foxglove`, `foxglove_json`, `ros`.
"""

from functools import lru_cache, partial

from replay import foxglove, foxglove_json, ros
from replay.logged_message import Decoder, LoggedSchema
from schemas import codec

PROTOBUF: dict[str, Decoder] = {
    schema: Decoder(message_type.__name__, partial(codec.decode, message_type))
    for schema, message_type in codec.MESSAGE_TYPES.items()
} | {schema: Decoder(message, partial(foxglove.decode, schema)) for schema, message in foxglove.MESSAGES.items()}


@lru_cache(maxsize=1024)
def decoders_for(schema: LoggedSchema, encoding: str) -> tuple[Decoder, ...]:
    """Returns the ways to read messages of a schema and encoding, the usual one first; none if we know none.

    Several, because a message may serve several roles: boxes of a Detection3DArray are clusters, or, with ids, tracks.
    """
    match encoding:
        case "protobuf":
            return (PROTOBUF[schema.name],) if schema.name in PROTOBUF else ()
        case "json":
            return foxglove_json.decoders(schema)
        case "cdr" | "ros1":
            return ros.decoders(schema, encoding)
    return ()


def schemas_of(message: str) -> list[str]:
    """Returns the names of the schemas that can become a dataclass, for people to read."""
    return sorted({name for name, way in PROTOBUF.items() if way.message == message} | set(ros.schemas_of(message)))
