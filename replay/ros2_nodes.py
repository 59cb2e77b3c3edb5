"""What makes our live nodes ROS 2 nodes: roles from the ROS graph, tracks and predictions as Autoware's messages."""

import contextlib
import time
from dataclasses import replace
from functools import cache, partial
from queue import Empty, SimpleQueue

import zenoh

from pcgan.bus import MAX_PAYLOAD_BYTES
from replay import autoware, ros2_bus
from replay.decoders import decoders_for
from replay.errors import LogError
from replay.logged_message import ChannelInfo, LoggedSchema, RawMessage
from replay.rmw_zenoh import LATCHED, EntityKind
from replay.roles import Reading, RoleChoices, Roles, assign_roles
from replay.ros2_bus import Ros2Node, Ros2Subscription
from replay.ros_type_hash import TypeHashError, definition_of
from replay.track_node import SensorInbox
from schemas import codec, topics
from schemas.codec import CodecError
from schemas.messages import PredictionFrame, TrackFrame, VehiclePose

SETTLED_S = 2.0  # so long nothing came or went before the roles are given: nodes of one launch come up one by one
LISTEN_S = 2.0  # so long a topic may take to say what frame it is of
USUAL_TRANSFORMS = ("/tf_static", "/tf")
_POLL_S = 0.2


def graph_roles(
    session: zenoh.Session, domain: int, choices: RoleChoices, wait_s: float = 10.0, settled_s: float = SETTLED_S
) -> Roles:
    """Returns the roles of the topics that a domain's nodes publish, by their types, as of a recording.

    Nodes may come up after us: waits until what is published suffices and has stayed the same for `settled_s`. After
    `wait_s` what is there must do. Transforms of the usual names are listened to even if nobody publishes them yet.
    Raises LogError saying what is missing or in doubt.
    """
    changed_s = time.monotonic()
    deadline_s = changed_s + wait_s
    channels: list[ChannelInfo] = []
    while True:
        before, channels = channels, published_channels(session, domain)
        now_s = time.monotonic()
        if channels != before:
            changed_s = now_s
        if now_s - changed_s >= settled_s or now_s > deadline_s:
            try:
                roles = assign_roles(channels, choices, cache(partial(frame_heard, session, domain)))
                return roles if choices.transforms is not None else _with_usual_transforms(roles)
            except LogError as error:
                if now_s > deadline_s:
                    raise LogError(f"in ROS domain {domain}: {error}".replace("the log has", "there is")) from error
        time.sleep(_POLL_S)


def _with_usual_transforms(roles: Roles) -> Roles:
    usual = {topic: Reading(topic, "transforms", None, "the usual name") for topic in USUAL_TRANSFORMS}
    return replace(roles, readings={**usual, **roles.readings})


def frame_heard(session: zenoh.Session, domain: int, topic: str) -> str | None:
    """Returns the frame that a topic's first readable message names; None if none comes in LISTEN_S.

    We listen as a node of the graph: some publish only to those whom they see there.
    """
    came: SimpleQueue[RawMessage] = SimpleQueue()
    deadline_s = time.monotonic() + LISTEN_S
    with Ros2Node(session, domain, "pcgan_frames") as node, contextlib.suppress(Empty):
        node.subscribe(topic, came.put, LATCHED)
        while (left_s := deadline_s - time.monotonic()) > 0:
            message = came.get(timeout=left_s)
            for way in decoders_for(message.schema, message.encoding):
                with contextlib.suppress(CodecError):
                    if frame := getattr(way.decode(message.data), "frame_id", ""):
                        return str(frame)
    return None


def published_channels(session: zenoh.Session, domain: int) -> list[ChannelInfo]:
    """Returns what a domain's nodes publish at this moment, sorted by topic; a topic of two types comes twice."""
    found: set[ChannelInfo] = set()
    for entity in ros2_bus.graph(session, domain):
        endpoint = entity.endpoint
        if endpoint is None or endpoint.kind is not EntityKind.PUBLISHER:
            continue
        try:
            schema = definition_of(endpoint.type_name, endpoint.type_hash)
        except TypeHashError:
            schema = LoggedSchema(endpoint.type_name, "", b"")  # listed, but of no use
        found.add(ChannelInfo(endpoint.topic, schema, "cdr" if schema.definition else "unknown", 0))
    return sorted(found)


class Ros2Sensors:
    """The sensor topics of a domain, for a live tracker to listen to."""

    def __init__(self, node: Ros2Node, roles: Roles):
        self._node, self._roles = node, roles
        self._subscriptions: list[Ros2Subscription] = []

    def listen(self, inbox: SensorInbox) -> None:
        """Lets the messages of all topics in use go to the inbox, for as long as the node is open."""
        self._subscriptions = [
            self._node.subscribe(topic, inbox.put, LATCHED if _said_once(topic, reading) else None)
            for topic, reading in self._roles.readings.items()
        ]

    @property
    def refused(self) -> int:
        """How many messages were of an unknown definition, or not rmw_zenoh's."""
        return sum(subscription.refused for subscription in self._subscriptions)


def _said_once(topic: str, reading: Reading) -> bool:
    """Tells whether a topic's publisher may have said all it has to say before we came."""
    return reading.role == "calibration" or topic.endswith("tf_static")


class Ros2Tracks:
    """Tracks as a topic of TrackedObjects."""

    def __init__(self, node: Ros2Node):
        self._publisher = node.publisher(autoware.TRACKED_OBJECTS.name, _schema(autoware.TRACKED_OBJECTS.message))

    def put(self, frame: TrackFrame, pose: VehiclePose) -> None:
        """Publishes a frame; people stand on the ground that the vehicle stands on."""
        self._publisher.put(autoware.tracked_objects(frame, float(pose.position_m[2])))


class Ros2Predictions:
    """Predictions as a topic of PredictedObjects."""

    def __init__(self, node: Ros2Node, session: zenoh.Session, namespace: str = ""):
        self._publisher = node.publisher(autoware.PREDICTED_OBJECTS.name, _schema(autoware.PREDICTED_OBJECTS.message))
        self._ground_m = 0.0  # a track frame is flat: the height comes with the vehicle's pose
        self._poses = session.declare_subscriber(topics.zenoh_key(topics.VEHICLE_POSE, namespace), self._on_pose)

    def put(self, frame: TrackFrame, answer: PredictionFrame) -> None:
        """Publishes the answer to a frame; people stand on the ground that the vehicle stood on last."""
        self._publisher.put(autoware.predicted_objects(frame, answer, self._ground_m))

    def _on_pose(self, sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        if len(payload) <= MAX_PAYLOAD_BYTES:
            with contextlib.suppress(CodecError):  # a stranger's; the last one holds
                self._ground_m = float(codec.decode(VehiclePose, payload).position_m[2])


def _schema(type_name: str) -> LoggedSchema:
    return LoggedSchema(type_name, "ros2msg", autoware.definition(type_name).encode())
