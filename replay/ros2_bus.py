"""A ROS 2 node on a zenoh session: topics published and subscribed as rmw_zenoh_cpp does it.

A thin shell: names and bytes are `replay.rmw_zenoh`'s, definitions `replay.ros_type_hash`'s. What a message means is
left to `replay.decoders`.
"""

import itertools
import json
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Protocol, Self

import zenoh
import zenoh.ext

from pcgan.bus import BusError, plain_reason
from replay import rmw_zenoh
from replay.logged_message import LoggedSchema, RawMessage
from replay.rmw_zenoh import Attachment, Endpoint, Entity, EntityKind, Node, QoS, RmwZenohError
from replay.ros_type_hash import TypeHashError, definition_of, type_hash

log = logging.getLogger(__name__)

ROUTER = "tcp/localhost:7447"  # where `ros2 run rmw_zenoh_cpp rmw_zenohd` listens
_HEARTBEAT_S = 0.5  # rmw_zenoh's: how soon a subscriber notices that it missed the last message
MAX_TYPES = 32  # of one topic, known or not: a stranger may make up names and hashes without end
MAX_PUBLISHERS = 1000  # of one topic, whose last number is remembered
_entity_ids = itertools.count()  # rmw_zenoh wants them unique in a session; these are unique in the process


def open_session(router: str = ROUTER) -> zenoh.Session:
    """Opens a client of ROS 2's zenoh router, which listens nowhere and scouts nothing.

    Not a peer: to a peer that takes no part in gossip the router forwards nothing. Raises BusError without a router.
    """
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [router],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise BusError(
            f"no zenoh router at {router} ({plain_reason(error)}); start one: ros2 run rmw_zenoh_cpp rmw_zenohd"
        ) from error


def graph(session: zenoh.Session, domain: int) -> tuple[Entity, ...]:
    """Returns the nodes and endpoints that a domain has at this moment; what cannot be read is logged and left out."""
    entities = []
    for reply in session.liveliness().get(rmw_zenoh.any_token(domain)):
        if reply.ok is not None and (entity := _entity(reply.ok)) is not None:
            entities.append(entity)
    return tuple(entities)


class Ros2Node:
    """A node in the ROS graph for as long as it is open; what it published and subscribed ends with it."""

    def __init__(self, session: zenoh.Session, domain: int, name: str, namespace: str = "/"):
        """Announces the node.

        Args:
            session: reaches the ROS nodes, usually through their router (`open_session`).
            domain: ROS_DOMAIN_ID of those nodes.
            name: as `ros2 node list` shows it, without a slash.
            namespace: before the name, with a leading slash; topics are given in full and not moved into it.
        """
        rmw_zenoh.check_topic(f"/{name}")
        self._session = session
        self._node = Node(domain, str(session.zid()), next(_entity_ids), name, namespace)
        self._declared = ExitStack()
        self._keep(session.liveliness().declare_token(str(Entity(self._node))))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Ends everything the node declared, last first; the session stays open."""
        self._declared.close()

    def publisher(self, topic: str, schema: LoggedSchema, qos: QoS | None = None) -> "Ros2Publisher":
        """Announces a topic and returns what publishes on it; the definition gives the type's hash.

        What is published goes out under the hash's key, and once more under Humble's, where no types have hashes.
        """
        qos = qos or QoS()
        if qos.transient_local and not qos.reliable:
            raise ValueError(f"{topic}: messages are kept for late subscribers only where delivery is reliable")
        hash_ = type_hash(schema)
        publishers = [
            self._declare_publisher(rmw_zenoh.TopicKey(self._node.domain, topic, schema.name, each), qos)
            for each in (hash_, rmw_zenoh.TYPE_HASH_NOT_SUPPORTED)
        ]
        entity = self._announce(EntityKind.PUBLISHER, topic, schema.name, hash_, qos)
        return Ros2Publisher(publishers, rmw_zenoh.gid_of(entity))

    def subscribe(
        self, topic: str, on_message: Callable[[RawMessage], None], qos: QoS | None = None
    ) -> "Ros2Subscription":
        """Hands on every message of a topic, of any type, with the definition that has the hash in its key.

        `on_message` is called in zenoh's thread and must return soon. A message's log time is that of its arrival.
        """
        qos = qos or QoS()
        late = qos.transient_local
        subscription = Ros2Subscription(
            topic, on_message, lambda name, hash_: self._announce(EntityKind.SUBSCRIPTION, topic, name, hash_, qos)
        )
        self._keep(
            zenoh.ext.declare_advanced_subscriber(
                self._session,
                rmw_zenoh.any_type_key(self._node.domain, topic),
                # in the network's own thread: otherwise each topic has one, and order across topics is lost
                zenoh.handlers.Callback(subscription.on_sample, indirect=False),
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth) if late else None,
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
                if late and qos.reliable
                else None,
                subscriber_detection=late,
            )
        )
        publishers = rmw_zenoh.any_publisher_token(self._node.domain, topic)
        self._keep(self._session.liveliness().declare_subscriber(publishers, subscription.on_publisher, history=True))
        return subscription

    def _declare_publisher(self, key: rmw_zenoh.TopicKey, qos: QoS) -> zenoh.ext.AdvancedPublisher:
        """Returns what publishes under a key; it sends nothing to where nobody subscribes."""
        blocks = qos.reliable and qos.keep_all
        publisher = zenoh.ext.declare_advanced_publisher(
            self._session,
            str(key),
            congestion_control=zenoh.CongestionControl.BLOCK if blocks else zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT,
            cache=zenoh.ext.CacheConfig(max_samples=qos.depth) if qos.transient_local else None,
            publisher_detection=qos.transient_local,
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S)
            if qos.transient_local
            else None,
        )
        self._keep(publisher)
        return publisher

    def _announce(self, kind: EntityKind, topic: str, type_name: str, hash_: str, qos: QoS) -> Entity:
        """Puts an endpoint into the ROS graph."""
        entity = Entity(self._node, Endpoint(next(_entity_ids), kind, topic, type_name, hash_, qos))
        self._keep(self._session.liveliness().declare_token(str(entity)))
        return entity

    def _keep(self, declared: "_Declared") -> None:
        self._declared.callback(declared.undeclare)


class _Declared(Protocol):
    """What zenoh declares until further notice."""

    def undeclare(self) -> None:
        """Ends it."""
        ...


class Ros2Publisher:
    """Publishes CDR on one topic, under each of its keys."""

    def __init__(self, publishers: Sequence[zenoh.ext.AdvancedPublisher], gid: bytes):
        self._publishers = publishers
        self._gid = gid
        self._sequence = itertools.count(1)

    def put(self, data: bytes, stamp_ns: int | None = None) -> None:
        """Publishes one message; `stamp_ns` is when, on the system's clock, by default now."""
        stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns
        attachment = Attachment(next(self._sequence), stamp_ns, self._gid).encode()
        for publisher in self._publishers:
            publisher.put(data, attachment=attachment)


class Ros2Subscription:
    """What came in on one topic, and what of it could not be used."""

    def __init__(self, topic: str, on_message: Callable[[RawMessage], None], announce: Callable[[str, str], object]):
        """Begins with nothing.

        Args:
            topic: fully qualified.
            on_message: takes what can be decoded.
            announce: is told the name and hash of each type that is published and that we can decode, once.
        """
        self._topic = topic
        self._on_message = on_message
        self._announce = announce
        self._lock = threading.Lock()  # zenoh's threads: one for each transport
        self._schemas: dict[tuple[str, str], LoggedSchema | None] = {}  # of what was published, by type and hash
        self._sequences: dict[bytes, tuple[int, str]] = {}  # the last one of each publisher, and its key's hash
        self._foreign: Counter[str] = Counter()  # of those refused: without a key of rmw_zenoh, or an attachment
        self.received = 0
        self.refused = 0  # of an unknown definition, or not rmw_zenoh's
        self.lost = 0  # numbers that publishers skipped

    def on_sample(self, sample: zenoh.Sample) -> None:
        """Takes a sample of the topic's data."""
        arrived_ns = time.time_ns()
        part = "key"
        try:
            key = rmw_zenoh.parse_topic_key(str(sample.key_expr))
            part = "attachment"
            attachment = rmw_zenoh.decode_attachment(sample.attachment.to_bytes() if sample.attachment else b"")
        except RmwZenohError as error:
            with self._lock:
                self.refused += 1
                self._foreign[part] += 1
                number = str(self._foreign[part])
            if number.strip("0") == "1":  # the 1st, 10th, 100th: they may come at 100 Hz
                times = f" ({number} times)" if number != "1" else ""
                log.warning("refused a message on %s%s: %s", self._topic, times, error)
            return
        with self._lock:
            last, hash_ = self._sequences.get(attachment.gid, (attachment.sequence, key.type_hash))
            if key.type_hash == rmw_zenoh.TYPE_HASH_NOT_SUPPORTED != hash_:
                return  # a copy for Humble, from one of us
            schema = self._schema_of(key.type_name, key.type_hash)
            self._sequences.pop(attachment.gid, None)  # to the end: who is silent is forgotten first
            self._sequences[attachment.gid] = attachment.sequence, key.type_hash
            if len(self._sequences) > MAX_PUBLISHERS:
                del self._sequences[next(iter(self._sequences))]
            self.lost += max(attachment.sequence - last - 1, 0)
            self.received += schema is not None
            self.refused += schema is None
        if schema is not None:
            self._on_message(RawMessage(self._topic, arrived_ns, schema, "cdr", sample.payload.to_bytes()))

    def on_publisher(self, sample: zenoh.Sample) -> None:
        """Takes the token of a publisher that came or went; who comes finds a subscription to his type."""
        entity = _entity(sample)
        if entity is None or entity.endpoint is None or sample.kind != zenoh.SampleKind.PUT:
            return
        with self._lock:
            self._schema_of(entity.endpoint.type_name, entity.endpoint.type_hash)

    def _schema_of(self, type_name: str, hash_: str) -> LoggedSchema | None:
        """Returns the definition, or None if we know none; what is new is announced, or complained of."""
        if (type_name, hash_) not in self._schemas:
            if len(self._schemas) >= MAX_TYPES:
                return None
            try:
                self._schemas[type_name, hash_] = definition_of(type_name, hash_)
                self._announce(type_name, hash_)
            except TypeHashError as error:
                self._schemas[type_name, hash_] = None
                log.warning("%s cannot be read: %s", self._topic, error)
        return self._schemas[type_name, hash_]


def _entity(sample: zenoh.Sample) -> Entity | None:
    try:
        return rmw_zenoh.parse_token(str(sample.key_expr))
    except RmwZenohError as error:
        log.warning("ignored a token of the ROS graph: %s", error)
        return None
