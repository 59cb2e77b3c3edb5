"""What a message on the bus is: its topic, its schema and its encoding, told without looking into the bytes.

Three things say so. The key is the topic's name. zenoh's encoding carries the message encoding and the schema's name.
The schema's definition does not fit there: whoever publishes answers with it on `pcgan/channels/ID`.
"""

import base64
import binascii
import json
import logging
import math
import time
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib import import_module
from types import MappingProxyType
from typing import Any, NamedTuple

import zenoh
from google.protobuf.message import Message
from mcap_protobuf.schema import build_file_descriptor_set

from pcgan.bus import MAX_PAYLOAD_BYTES, under
from replay.logged_message import LoggedSchema, RawMessage
from schemas import codec

log = logging.getLogger(__name__)

MAX_FOUND = 10_000  # kinds of samples that are remembered
TOLD_FOR_S = 10.0
UNTOLD_FOR_S, UNTOLD_FOR_MOST_S = 1.0, 60.0
ASKING_SHARE = 0.1  # of the time
MAX_UNUSED_S = 10.0  # of which the share may be used up at once

CHANNELS = "pcgan/channels"
ENCODING_KEY = "zenoh_encoding"  # in the metadata of a recorded channel whose schema nobody told

# message encodings that zenoh has a name for; any other is application/x-NAME
_KNOWN_TO_ZENOH = ("protobuf", "cdr", "json", "cbor")
# the language that schemas of a message encoding are written in, where nobody tells
_SCHEMA_ENCODINGS = {"protobuf": "protobuf", "cdr": "ros2msg", "ros1": "ros1msg", "json": "jsonschema"}
_NOT_IN_KEYS = frozenset("*$?#")


class BusChannel(NamedTuple):
    """What a publisher says about one of its keys."""

    topic: str  # as in the recording it comes from: /tf_static
    schema: LoggedSchema
    encoding: str  # of the messages: protobuf, cdr, ros1, json
    metadata: Mapping[str, str] = MappingProxyType({})  # of the recording's channel: offered_qos_profiles and the like


# --- keys ------------------------------------------------------------------------------------------------------------


def key_of(topic: str, namespace: str = "") -> str:
    """Returns the zenoh key of a topic: "/gmsl/A0/image" under "car7" is "car7/gmsl/A0/image".

    Raises ValueError if zenoh has no such key: parts of the name must not be empty nor hold * $ ? #.
    """
    name = topic.removeprefix("/")
    if not all(name.split("/")) or _NOT_IN_KEYS & set(name):
        raise ValueError(f"topic {topic!r} cannot be a zenoh key: no part of it may be empty or hold one of * $ ? #")
    return under(namespace, name)


def topic_of(key: str, namespace: str = "") -> str:
    """Returns the topic of a key, with a leading slash: "car7/gmsl/A0/image" under "car7" is "/gmsl/A0/image".

    A key outside the namespace keeps its whole name.
    """
    prefix = under(namespace, "")
    return "/" + key.removeprefix(prefix)


# --- encodings -------------------------------------------------------------------------------------------------------


def zenoh_encoding(
    schema: LoggedSchema, encoding: str, metadata: Mapping[str, str] = MappingProxyType({})
) -> zenoh.Encoding:
    """Returns the encoding to publish messages with, such as "application/cdr;sensor_msgs/msg/CameraInfo".

    A channel that was recorded without a schema has the encoding it was recorded with, from its metadata.
    """
    if not schema.name and ENCODING_KEY in metadata:
        return zenoh.Encoding(metadata[ENCODING_KEY])
    if not encoding:
        base = zenoh.Encoding.APPLICATION_OCTET_STREAM
    else:
        base = zenoh.Encoding(f"application/{'' if encoding in _KNOWN_TO_ZENOH else 'x-'}{encoding}")
    return base.with_schema(schema.name) if schema.name else base


def logged_schema(encoding: zenoh.Encoding | str) -> tuple[LoggedSchema, str]:
    """Returns schema and message encoding that a zenoh encoding names, the inverse of `zenoh_encoding`.

    The definition is there for `pcgan.v1` and Foxglove protobufs, which everybody knows, and empty for the rest.
    What is no application/... has no message encoding ("").
    """
    media_type, _, name = str(encoding).partition(";")
    family, _, message_encoding = media_type.partition("/")
    message_encoding = message_encoding.removeprefix("x-")
    if family != "application" or message_encoding == "octet-stream":
        message_encoding = ""
    if not name:
        return LoggedSchema("", "", b""), message_encoding
    definition = well_known_definition(name) if message_encoding == "protobuf" else b""
    return LoggedSchema(name, _SCHEMA_ENCODINGS.get(message_encoding, ""), definition), message_encoding


@lru_cache(maxsize=256)
def well_known_definition(schema_name: str) -> bytes:
    """Returns the descriptor set of a `pcgan.v1` or Foxglove protobuf; empty for any other name."""
    generated: type[Message] | None = None
    package, _, name = schema_name.rpartition(".")
    if schema_name in codec.MESSAGE_TYPES:
        generated = codec.protobuf_type(codec.MESSAGE_TYPES[schema_name])
    elif package == "foxglove" and name.isidentifier():
        try:
            generated = getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
        except (ImportError, AttributeError):
            return b""
    if generated is None:
        return b""
    return build_file_descriptor_set(generated).SerializeToString(deterministic=True)


# --- definitions -----------------------------------------------------------------------------------------------------


def announce(
    session: zenoh.Session, channels: Mapping[str, BusChannel], namespace: str = ""
) -> "zenoh.Queryable[None]":
    """Answers whoever asks what the given keys carry, until the returned queryable is undeclared or its session ends.

    Announce before you publish: who hears the first message asks at once.
    """
    key = under(namespace, f"{CHANNELS}/{session.zid()}-{time.monotonic_ns():x}")
    answer = _to_json(channels)

    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(key, answer, encoding=zenoh.Encoding.APPLICATION_JSON)

    return session.declare_queryable(key, reply)


def known_channels(session: zenoh.Session, namespace: str = "", timeout_s: float = 1.0) -> dict[str, BusChannel]:
    """Asks everybody on the bus what they publish; returns channels by key, {} if nobody answers.

    Answers that make no sense are logged and left out. Not for zenoh's callbacks: it waits for the answers.
    """
    channels: dict[str, BusChannel] = {}
    for reply in session.get(under(namespace, f"{CHANNELS}/*"), timeout=timeout_s):
        if reply.ok is None:  # a timeout, or somebody's error: the others' answers still hold
            continue
        try:
            channels |= _from_json(reply.ok.payload.to_bytes())
        except ValueError as error:
            log.warning("refused the channels on %s: %s", reply.ok.key_expr, error)
    return channels


class _Found(NamedTuple):
    """What samples of a key and an encoding are, as far as is known."""

    channel: BusChannel
    told: bool  # by its publisher
    for_s: float
    until_s: float  # when it is to be asked for again


class Channels:
    """The channels of a bus, asked for when a key or encoding turns up that is not known yet.

    A publisher may be started again with another definition, and whoever could tell may come later than the messages.
    So what was told is asked for again after 10 s, and what nobody told after 1 s, then ever more seldom. Asking takes
    a tenth of the time at most, however many keys and encodings strangers make up and however slowly they answer.
    """

    def __init__(
        self,
        session: zenoh.Session,
        namespace: str = "",
        timeout_s: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._session, self._namespace, self._timeout_s, self._clock = session, namespace, timeout_s, clock
        self._told: dict[str, BusChannel] = {}  # when it was asked last
        self._asked_s = self._free_from_s = -math.inf
        self._found: dict[tuple[str, str], _Found] = {}

    def of(self, sample: zenoh.Sample) -> BusChannel:
        """Returns what a sample is. The first of its key and encoding may wait for answers: not for callbacks."""
        kind = str(sample.key_expr), str(sample.encoding)
        found, now_s = self._found.get(kind), self._clock()
        if found is None or now_s >= found.until_s:
            if found is None and len(self._found) >= MAX_FOUND:
                self._found.clear()
            found = self._found[kind] = self._look_up(sample, found, now_s)
        return found.channel

    def _look_up(self, sample: zenoh.Sample, before: _Found | None, now_s: float) -> _Found:
        channel, told = self._as_told(sample)
        unclear = not (told or channel.schema.definition)
        outdated = unclear if before is None else self._asked_s < before.until_s
        if outdated and now_s >= self._free_from_s:
            self._ask()
            channel, told = self._as_told(sample)
        if told:
            for_s = TOLD_FOR_S
        elif channel.schema.definition:
            for_s = math.inf  # everybody knows that one
        elif before is None:
            for_s = UNTOLD_FOR_S
        elif before.told:  # whoever told it has gone; this came before
            channel, told, for_s = before.channel, True, TOLD_FOR_S
        else:
            for_s = min(2 * before.for_s, UNTOLD_FOR_MOST_S)
        return _Found(channel, told, for_s, self._clock() + for_s)

    def _as_told(self, sample: zenoh.Sample) -> tuple[BusChannel, bool]:
        channel = channel_of(sample, self._told, self._namespace)
        return channel, channel is self._told.get(str(sample.key_expr))

    def _ask(self) -> None:
        began_s = self._clock()
        self._told = known_channels(self._session, self._namespace, self._timeout_s)
        self._asked_s = self._clock()
        unused_from_s = max(self._free_from_s, began_s - MAX_UNUSED_S)
        self._free_from_s = unused_from_s + (self._asked_s - began_s) / ASKING_SHARE

    def raw_message(self, sample: zenoh.Sample, arrival_ns: int) -> RawMessage:
        """Returns a sample as a recording would hold it; as with `of`, the first of its kind may wait."""
        return _raw(sample, self.of(sample), arrival_ns)


def channel_of(sample: zenoh.Sample, channels: Mapping[str, BusChannel], namespace: str = "") -> BusChannel:
    """Returns what a sample is: as announced, unless its own encoding says something else."""
    key = str(sample.key_expr)
    schema, encoding = logged_schema(sample.encoding)
    announced = channels.get(key)
    if announced is not None and sample.encoding == zenoh_encoding(
        announced.schema, announced.encoding, announced.metadata
    ):
        return announced
    vague = not schema.definition and (schema.name or not encoding)
    topic = announced.topic if announced is not None else topic_of(key, namespace)
    return BusChannel(topic, schema, encoding, {ENCODING_KEY: str(sample.encoding)} if vague else {})


def raw_message(
    sample: zenoh.Sample, channels: Mapping[str, BusChannel], arrival_ns: int, namespace: str = ""
) -> RawMessage:
    """Returns a sample as a recording would hold it, with its arrival as log time."""
    return _raw(sample, channel_of(sample, channels, namespace), arrival_ns)


def _raw(sample: zenoh.Sample, channel: BusChannel, arrival_ns: int) -> RawMessage:
    return RawMessage(channel.topic, arrival_ns, channel.schema, channel.encoding, sample.payload.to_bytes())


def _to_json(channels: Mapping[str, BusChannel]) -> bytes:
    rows = [
        {
            "key": key,
            "topic": channel.topic,
            "message_encoding": channel.encoding,
            "schema_name": channel.schema.name,
            "schema_encoding": channel.schema.encoding,
            "schema_base64": base64.b64encode(channel.schema.definition).decode(),
            "metadata": dict(channel.metadata),
        }
        for key, channel in channels.items()
    ]
    return json.dumps({"channels": rows}).encode()


def _from_json(data: bytes) -> dict[str, BusChannel]:
    """Reads the answer of `announce`; raises ValueError naming what is wrong with a stranger's."""
    if len(data) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"{len(data)} bytes are more than a list of channels can have ({MAX_PAYLOAD_BYTES})")
    try:
        return dict(map(_channel, json.loads(data)["channels"]))
    except (KeyError, TypeError, AttributeError, RecursionError, binascii.Error) as error:
        raise ValueError(f"not a list of channels: {error!r}") from error


def _channel(row: Mapping[str, Any]) -> tuple[str, BusChannel]:
    names = ("key", "topic", "schema_name", "schema_encoding", "message_encoding")
    key, topic, schema_name, schema_encoding, encoding = (row[name] for name in names)
    metadata = row["metadata"]
    if not all(
        isinstance(text, str) for text in (key, topic, schema_name, schema_encoding, encoding, *metadata.values())
    ):
        raise TypeError("a name that is no text")
    definition = base64.b64decode(row["schema_base64"], validate=True)
    return key, BusChannel(topic, LoggedSchema(schema_name, schema_encoding, definition), encoding, metadata)
