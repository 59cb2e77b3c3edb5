"""The keys and bytes by which rmw_zenoh_cpp carries ROS 2 over zenoh, written and read; pure functions.

After ros2/rmw_zenoh: docs/design.md (commit 99a6a2b) and, in rmw_zenoh_cpp/src/detail, liveliness_utils.cpp (3411fde),
attachment_helpers.cpp (534747d), qos.cpp (7efeee2) and type_support_common.cpp (81d0361). The attachment has this
layout since rmw_zenoh_cpp 0.1.2 (Humble), 0.2.4 (Jazzy) and 0.6.0 (Kilted); older ones are refused.
"""

import re
import struct
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import xxhash

from replay.errors import ReplayError

TYPE_HASH_NOT_SUPPORTED = "TypeHashNotSupported"  # what Humble says: its message types have no hashes yet
DEFAULT_DEPTH = 42  # rmw_zenoh's own; a token leaves out what is default
GID_BYTES = 16

_TOPIC_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_TYPE_NAME = re.compile(r"([A-Za-z]\w*)/(msg|srv|action)/([A-Za-z]\w*)", re.ASCII)
_DDS_NAME = re.compile(r"([A-Za-z]\w*)::(msg|srv|action)::dds_::([A-Za-z]\w*)_", re.ASCII)
_TYPE_HASH = re.compile(r"RIHS01_[0-9a-f]{64}|" + TYPE_HASH_NOT_SUPPORTED)
_NUMBER = re.compile(r"[0-9]{1,20}")
_ADMIN_SPACE = "@ros2_lv"
_SLASH = "%"
_ATTACHMENT = struct.Struct(f"<qqB{GID_BYTES}s")  # zenoh's serializer: little-endian, a length before the array


class RmwZenohError(ReplayError):
    """A key, token or attachment that is not rmw_zenoh's."""


# --- names ----------------------------------------------------------------------------------------------------------


def dds_name(type_name: str) -> str:
    """Returns a type's name as keys spell it: "std_msgs/msg/String" is "std_msgs::msg::dds_::String_"."""
    if not (match := _TYPE_NAME.fullmatch(type_name)):
        raise ValueError(f"{type_name!r} is no ROS 2 type name such as std_msgs/msg/String")
    return "{}::{}::dds_::{}_".format(*match.groups())


def type_name(dds: str) -> str:
    """Returns a type's name as ROS 2 spells it: "std_msgs::msg::dds_::String_" is "std_msgs/msg/String"."""
    if not (match := _DDS_NAME.fullmatch(dds)):
        raise RmwZenohError(f"{dds!r} is no type name of rmw_zenoh such as std_msgs::msg::dds_::String_")
    return "/".join(match.groups())


def check_topic(topic: str) -> str:
    """Returns the topic if it is a fully qualified ROS 2 name: a wildcard in it would match what nobody asked for."""
    if not _TOPIC_NAME.fullmatch(topic):
        raise ValueError(f"{topic!r} is no fully qualified ROS 2 topic such as /sensing/camera/detections")
    return topic


def mangle(name: str) -> str:
    """Returns a name as one chunk of a key: "/sensing/lidar" is "%sensing%lidar"."""
    return name.replace("/", _SLASH)


def demangle(chunk: str) -> str:
    """Returns the name that `mangle` made a chunk of."""
    return chunk.replace(_SLASH, "/")


# --- data keys ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TopicKey:
    """What the key of a topic's data says."""

    domain: int
    topic: str  # fully qualified: /sensing/lidar/points
    type_name: str  # sensor_msgs/msg/PointCloud2
    type_hash: str  # RIHS01_..., or TypeHashNotSupported

    def __str__(self) -> str:
        return f"{self.domain}/{check_topic(self.topic)[1:]}/{dds_name(self.type_name)}/{self.type_hash}"


def any_type_key(domain: int, topic: str) -> str:
    """Returns the key expression of a topic whatever its type: the type is one chunk, its hash another."""
    return f"{domain}/{check_topic(topic)[1:]}/*/*"


def parse_topic_key(key: str) -> TopicKey:
    """Reads the key of a topic's data; raises RmwZenohError for any other key."""
    parts = key.split("/")
    if len(parts) < 4 or not _NUMBER.fullmatch(parts[0]) or not _TYPE_HASH.fullmatch(parts[-1]):
        raise RmwZenohError(f"{key!r} is not DOMAIN/TOPIC/TYPE/HASH, the key of a ROS 2 topic under rmw_zenoh")
    return TopicKey(int(parts[0]), "/" + "/".join(parts[1:-2]), type_name(parts[-2]), parts[-1])


# --- attachments ----------------------------------------------------------------------------------------------------


class Attachment(NamedTuple):
    """What travels beside each message."""

    sequence: int  # counts from 1, per publisher
    stamp_ns: int  # when it was published
    gid: bytes  # (16,)  the publisher's: `gid_of` its token

    def encode(self) -> bytes:
        """Returns the 33 bytes that zenoh's serializer writes."""
        if len(self.gid) != GID_BYTES:
            raise ValueError(f"a GID has {GID_BYTES} bytes, got {len(self.gid)}")
        return _ATTACHMENT.pack(self.sequence, self.stamp_ns, GID_BYTES, self.gid)


def decode_attachment(data: bytes) -> Attachment:
    """Reads an attachment; raises RmwZenohError for anything but its 33 bytes."""
    if len(data) != _ATTACHMENT.size:
        raise RmwZenohError(
            f"an attachment has {_ATTACHMENT.size} bytes, got {len(data)}; an rmw_zenoh_cpp from before April 2025 "
            "writes another layout: update it"
        )
    sequence, stamp_ns, gid_bytes, gid = _ATTACHMENT.unpack(data)
    if gid_bytes != GID_BYTES:
        raise RmwZenohError(f"an attachment's GID has {GID_BYTES} bytes, this one says {gid_bytes}")
    return Attachment(sequence, stamp_ns, gid)


# --- quality of service ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class QoS:
    """How a topic is delivered; what rmw_zenoh does not act on (deadline, lifespan, liveliness) is left out."""

    depth: int = 10
    reliable: bool = True
    transient_local: bool = False  # late subscribers get the last `depth` messages
    keep_all: bool = False  # a full queue stops the publisher instead of dropping

    def __str__(self) -> str:
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        history = "2" if self.keep_all else ""
        depth = "" if self.depth == DEFAULT_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:{history},{depth}:,:,:,,"


SENSOR_DATA = QoS(depth=5, reliable=False)
LATCHED = QoS(depth=100, transient_local=True)  # as tf2 subscribes to /tf_static

# values of rmw/types.h; an empty component is rmw_zenoh's default
_RELIABLE = {"": True, "1": True, "2": False}
_TRANSIENT_LOCAL = {"": False, "1": True, "2": False}
_KEEP_ALL = {"": False, "1": False, "2": True}


def parse_qos(text: str) -> QoS:
    """Reads the last chunk of a publisher's or subscription's token, such as "::,10:,:,:,,"."""
    parts = [part.split(",") for part in text.split(":")]
    numbers = [number for part in parts for number in part if number]
    if [len(part) for part in parts] != [1, 1, 2, 2, 2, 3] or not all(map(_NUMBER.fullmatch, numbers)):
        raise RmwZenohError(f"{text!r} is no QoS of rmw_zenoh such as '::,10:,:,:,,'")
    (reliability,), (durability,), (history, depth) = parts[:3]
    try:
        return QoS(
            depth=int(depth) if depth else DEFAULT_DEPTH,
            reliable=_RELIABLE[reliability],
            transient_local=_TRANSIENT_LOCAL[durability],
            keep_all=_KEEP_ALL[history],
        )
    except KeyError as error:
        raise RmwZenohError(f"{text!r} has a policy {error} that rmw_zenoh does not resolve to") from None


# --- liveliness tokens ----------------------------------------------------------------------------------------------


class EntityKind(StrEnum):
    """What a token stands for."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


@dataclass(frozen=True)
class Node:
    """A node as its tokens name it."""

    domain: int
    session_id: str  # hexadecimal, zenoh's
    node_id: int  # unique in the session
    name: str
    namespace: str = "/"
    enclave: str = "/"  # of SROS


@dataclass(frozen=True)
class Endpoint:
    """One side of a topic or service."""

    entity_id: int  # unique in the session
    kind: EntityKind
    topic: str
    type_name: str
    type_hash: str
    qos: QoS = field(default_factory=QoS)


@dataclass(frozen=True)
class Entity:
    """A node, or one of its endpoints: what a liveliness token announces to the ROS graph."""

    node: Node
    endpoint: Endpoint | None = None

    def __str__(self) -> str:
        node, end = self.node, self.endpoint
        entity_id, kind = (end.entity_id, end.kind) if end else (node.node_id, EntityKind.NODE)
        parts = [_ADMIN_SPACE, node.domain, node.session_id, node.node_id, entity_id, kind]
        parts += [mangle(node.enclave), mangle(node.namespace), node.name]
        if end:
            parts += [mangle(end.topic), dds_name(end.type_name), end.type_hash, end.qos]
        return "/".join(map(str, parts))


def any_token(domain: int) -> str:
    """Returns the key expression of every token of a domain."""
    return f"{_ADMIN_SPACE}/{domain}/**"


def any_publisher_token(domain: int, topic: str) -> str:
    """Returns the key expression of the tokens of a topic's publishers."""
    return f"{_ADMIN_SPACE}/{domain}/*/*/*/{EntityKind.PUBLISHER}/*/*/*/{mangle(check_topic(topic))}/**"


def parse_token(key: str) -> Entity:
    """Reads a liveliness token; raises RmwZenohError for any other key.

    Chunks after the last one known are ignored, as rmw_zenoh does: newer releases add what only they understand.
    """
    chunks = key.split("/")
    if len(chunks) < 9 or "" in chunks or chunks[0] != _ADMIN_SPACE:
        raise RmwZenohError(f"{key!r} is no liveliness token of rmw_zenoh")
    _, domain, session_id, node_id, entity_id, kind, enclave, namespace, name, *rest = chunks
    if not all(map(_NUMBER.fullmatch, (domain, node_id, entity_id))):
        raise RmwZenohError(f"{key!r} has a domain, node or entity that is no number")
    if kind not in tuple(EntityKind):
        raise RmwZenohError(f"{key!r} is of kind {kind!r}, not one of {', '.join(EntityKind)}")
    node = Node(int(domain), session_id, int(node_id), demangle(name), demangle(namespace), demangle(enclave))
    if kind == EntityKind.NODE:
        return Entity(node)
    if len(rest) < 4:
        raise RmwZenohError(f"{key!r} ends before its topic, type, hash and QoS")
    topic, dds, type_hash, qos = rest[:4]
    return Entity(
        node,
        Endpoint(
            int(entity_id),
            EntityKind(kind),
            demangle(topic),
            type_name(demangle(dds)),
            demangle(type_hash),
            parse_qos(qos),
        ),
    )


def gid_of(entity: Entity) -> bytes:
    """Returns the 16 bytes by which ROS 2 tells endpoints apart: XXH3-128 of the token, its low half first."""
    return xxhash.xxh3_128_intdigest(str(entity).encode()).to_bytes(GID_BYTES, "little")
