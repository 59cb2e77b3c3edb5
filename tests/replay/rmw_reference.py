"""A ROS 2 node under rmw_zenoh, written a second time from its specification, to play the other side in our tests.

From ros2/rmw_zenoh's docs/design.md (commit 99a6a2b) and `qos_to_keyexpr` (liveliness_utils.cpp, 3411fde), REP 2016 for
type hashes and the CDR of OMG DDSI-RTPS for payloads: with struct, hashlib and zenoh only, and nothing of ours.
"""

import hashlib
import json
import struct
import time
from collections.abc import Sequence

import zenoh
import zenoh.ext

# Fields in order, with the numbers that type_description_interfaces/msg/FieldType gives to their kinds.
KINDS = {"uint8": 3, "int32": 6, "uint32": 7, "float32": 10, "float64": 11, "string": 17}
NESTED, ARRAY, SEQUENCE = 1, 48, 144
STRING = "std_msgs/msg/String"
DETECTIONS = "vision_msgs/msg/Detection2DArray"
PREDICTED = "autoware_perception_msgs/msg/PredictedObjects"
TYPES = {
    "builtin_interfaces/msg/Time": "int32 sec, uint32 nanosec",
    "builtin_interfaces/msg/Duration": "int32 sec, uint32 nanosec",
    "unique_identifier_msgs/msg/UUID": "uint8[16] uuid",
    STRING: "string data",
    "std_msgs/msg/Header": "builtin_interfaces/msg/Time stamp, string frame_id",
    "geometry_msgs/msg/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Point32": "float32 x, float32 y, float32 z",
    "geometry_msgs/msg/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/msg/Polygon": "geometry_msgs/msg/Point32[] points",
    "geometry_msgs/msg/Pose": "geometry_msgs/msg/Point position, geometry_msgs/msg/Quaternion orientation",
    "geometry_msgs/msg/Twist": "geometry_msgs/msg/Vector3 linear, geometry_msgs/msg/Vector3 angular",
    "geometry_msgs/msg/Accel": "geometry_msgs/msg/Vector3 linear, geometry_msgs/msg/Vector3 angular",
    "geometry_msgs/msg/PoseWithCovariance": "geometry_msgs/msg/Pose pose, float64[36] covariance",
    "geometry_msgs/msg/TwistWithCovariance": "geometry_msgs/msg/Twist twist, float64[36] covariance",
    "geometry_msgs/msg/AccelWithCovariance": "geometry_msgs/msg/Accel accel, float64[36] covariance",
    "vision_msgs/msg/Point2D": "float64 x, float64 y",
    "vision_msgs/msg/Pose2D": "vision_msgs/msg/Point2D position, float64 theta",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/msg/Pose2D center, float64 size_x, float64 size_y",
    "vision_msgs/msg/ObjectHypothesis": "string class_id, float64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/msg/ObjectHypothesis hypothesis, geometry_msgs/msg/PoseWithCovariance pose"
    ),
    "vision_msgs/msg/Detection2D": (
        "std_msgs/msg/Header header, vision_msgs/msg/ObjectHypothesisWithPose[] results,"
        "vision_msgs/msg/BoundingBox2D bbox, string id"
    ),
    DETECTIONS: "std_msgs/msg/Header header, vision_msgs/msg/Detection2D[] detections",
    "autoware_perception_msgs/msg/ObjectClassification": "uint8 label, float32 probability",
    "autoware_perception_msgs/msg/Shape": (
        "uint8 type, geometry_msgs/msg/Polygon footprint, geometry_msgs/msg/Vector3 dimensions"
    ),
    "autoware_perception_msgs/msg/PredictedPath": (
        "geometry_msgs/msg/Pose[] path, builtin_interfaces/msg/Duration time_step, float32 confidence"
    ),
    "autoware_perception_msgs/msg/PredictedObjectKinematics": (
        "geometry_msgs/msg/PoseWithCovariance initial_pose_with_covariance,"
        "geometry_msgs/msg/TwistWithCovariance initial_twist_with_covariance,"
        "geometry_msgs/msg/AccelWithCovariance initial_acceleration_with_covariance,"
        "autoware_perception_msgs/msg/PredictedPath[] predicted_paths"
    ),
    "autoware_perception_msgs/msg/PredictedObject": (
        "unique_identifier_msgs/msg/UUID object_id, float32 existence_probability,"
        "autoware_perception_msgs/msg/ObjectClassification[] classification,"
        "autoware_perception_msgs/msg/PredictedObjectKinematics kinematics, autoware_perception_msgs/msg/Shape shape"
    ),
    PREDICTED: "std_msgs/msg/Header header, autoware_perception_msgs/msg/PredictedObject[] objects",
}


def rihs01(name: str) -> str:
    """Returns the hash of one of TYPES: SHA-256 of its description as JSON, referenced types sorted by name."""
    descriptions = {}

    def describe(name):
        if name not in descriptions:
            descriptions[name] = {"type_name": name, "fields": [field(text) for text in TYPES[name].split(",")]}
        return descriptions[name]

    def field(text):
        kind, name = text.split()
        base, bracket, size = kind.partition("[")
        many = 0 if not bracket else SEQUENCE if size == "]" else ARRAY
        if nested := base not in KINDS:
            describe(base)
        return {
            "name": name,
            "type": {
                "type_id": many + (NESTED if nested else KINDS[base]),
                "capacity": int(size[:-1]) if many == ARRAY else 0,
                "string_capacity": 0,
                "nested_type_name": base if nested else "",
            },
        }

    whole = {"type_description": describe(name)}
    whole["referenced_type_descriptions"] = [descriptions[other] for other in sorted(descriptions) if other != name]
    return "RIHS01_" + hashlib.sha256(json.dumps(whole).encode()).hexdigest()


# --- keys, tokens, attachments --------------------------------------------------------------------------------------


def dds(name: str) -> str:
    package, kind, message = name.split("/")
    return f"{package}::{kind}::dds_::{message}_"


def key(domain: int, topic: str, name: str, hash_: str) -> str:
    return "/".join((str(domain), topic.strip("/"), dds(name), hash_))


def read_token(text: str) -> dict[str, str]:
    """Returns the chunks of a token by their names in the specification; raises if they are too few or too many."""
    names = ["admin", "domain", "session", "node_id", "entity_id", "kind", "enclave", "namespace", "node"]
    if text.split("/")[5] != "NN":
        names += ["topic", "type", "hash", "qos"]
    return dict(zip(names, text.split("/"), strict=True))


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    return sequence.to_bytes(8, "little", signed=True) + stamp_ns.to_bytes(8, "little", signed=True) + b"\x10" + gid


# --- CDR, little-endian ---------------------------------------------------------------------------------------------


class Cdr:
    """Appends values, each aligned to its own size from behind the four bytes of the header."""

    def __init__(self):
        self.data = b""

    def put(self, kind: str, *values) -> None:
        size = struct.calcsize(kind)
        for value in values:
            self.data += b"\0" * (-len(self.data) % size) + struct.pack("<" + kind, value)

    def text(self, value: str) -> None:
        self.put("I", len(value.encode()) + 1)
        self.data += value.encode() + b"\0"

    def header(self, stamp_ns: int, frame_id: str) -> None:
        self.put("i", stamp_ns // 10**9)
        self.put("I", stamp_ns % 10**9)
        self.text(frame_id)

    def bytes(self) -> bytes:
        return b"\x00\x01\x00\x00" + self.data


def detections(stamp_ns: int, frame_id: str, boxes: Sequence[tuple[str, float, float, float, float, float]]) -> bytes:
    """Returns a vision_msgs 4 Detection2DArray of (class, score, x, y, width, height)."""
    cdr = Cdr()
    cdr.header(stamp_ns, frame_id)
    cdr.put("I", len(boxes))
    for label, score, x, y, width, height in boxes:
        cdr.header(stamp_ns, frame_id)
        cdr.put("I", 1)
        cdr.text(label)
        cdr.put("d", score, *(0.0,) * 6, 1.0, *(0.0,) * 36)  # a pose nobody measured, and its covariance
        cdr.put("d", x, y, 0.0, width, height)
        cdr.text("")
    return cdr.bytes()


# --- the node -------------------------------------------------------------------------------------------------------


def wait_until(condition, timeout_s: float = 5.0) -> None:
    """Waits for something that zenoh's threads bring about."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"waited {timeout_s} s in vain"
        time.sleep(0.01)


class ReferenceNode:
    """A node that publishes, subscribes and watches the graph as the specification says; use as a context manager."""

    def __init__(self, session: zenoh.Session, domain: int, name: str):
        self._session, self._domain, self._name = session, domain, name
        self._base = f"@ros2_lv/{domain}/{session.zid()}"
        self._declared = [session.liveliness().declare_token(f"{self._base}/0/0/NN/%/%/{name}")]
        self._entities = 0
        self.tokens: set[str] = set()
        self._declared.append(
            session.liveliness().declare_subscriber(f"@ros2_lv/{domain}/**", self._on_token, history=True)
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for declared in reversed(self._declared):
            declared.undeclare()

    def _on_token(self, sample: zenoh.Sample) -> None:
        change = self.tokens.add if sample.kind == zenoh.SampleKind.PUT else self.tokens.discard
        change(str(sample.key_expr))

    def others(self, kind: str, topic: str = "") -> list[dict[str, str]]:
        """Returns the tokens of a kind that other sessions hold, optionally of one topic."""
        found = [read_token(token) for token in tuple(self.tokens) if not token.startswith(self._base)]
        chunk = topic.replace("/", "%")
        return [token for token in found if token["kind"] == kind and (not topic or token["topic"] == chunk)]

    def _announce(self, kind: str, topic: str, name: str, hash_: str, qos: str) -> None:
        self._entities += 1
        chunk = topic.replace("/", "%")
        token = f"{self._base}/0/{self._entities}/{kind}/%/%/{self._name}/{chunk}/{dds(name)}/{hash_}/{qos}"
        self._declared.append(self._session.liveliness().declare_token(token))

    def publisher(self, topic: str, name: str, hash_: str, *, latched: bool = False):
        """Returns a function that publishes CDR."""
        latched_options = {
            "cache": zenoh.ext.CacheConfig(max_samples=1),
            "publisher_detection": True,
            "sample_miss_detection": zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
        }
        publisher = zenoh.ext.declare_advanced_publisher(
            self._session, key(self._domain, topic, name, hash_), **(latched_options if latched else {})
        )
        self._declared.append(publisher)
        self._announce("MP", topic, name, hash_, ":1:,1:,:,:,," if latched else "::,10:,:,:,,")
        gid = hashlib.md5(topic.encode()).digest()
        sequence = 0

        def put(data: bytes) -> None:
            nonlocal sequence
            sequence += 1
            publisher.put(data, attachment=attachment(sequence, time.time_ns(), gid))

        return put

    def subscribe(self, topic: str, name: str, hash_: str, *, latched: bool = False) -> list[zenoh.Sample]:
        """Returns the list to which what arrives is appended."""
        samples: list[zenoh.Sample] = []
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1) if latched else None
        self._declared.append(
            zenoh.ext.declare_advanced_subscriber(
                self._session, key(self._domain, topic, name, hash_), samples.append, history=history
            )
        )
        self._announce("MS", topic, name, hash_, ":1:,1:,:,:,," if latched else "::,10:,:,:,,")
        return samples
