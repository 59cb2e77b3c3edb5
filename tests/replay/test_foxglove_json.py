"""JSON messages become the dataclasses that their protobuf would; what makes no sense is refused by name."""

import contextlib
import json
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from google.protobuf import json_format
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from replay import foxglove
from replay.foxglove_json import decoders
from replay.logged_message import LoggedSchema
from schemas import codec
from schemas.codec import CodecError
from schemas.messages import (
    CameraCalibration,
    CameraDetections,
    CompressedImage,
    GroundTruthFrame,
    LidarClusters,
    PointCloud,
    Track,
    TrackFrame,
    TrackHistory,
    Transform,
    VehicleHistory,
    VehiclePose,
)
from tests.replay.foreign_foxglove import as_foxglove, as_foxglove_json, plain

STAMP_NS = 1_583_114_400_123_456_789
TURN = np.array([0.0, 0.0, 0.6, 0.8])
POSE = VehiclePose(
    STAMP_NS, "odom", "base_link", np.array([1.0, -2.0, 0.5]), TURN, np.array([3.0, 0.1, 0]), np.array([0, 0, 0.2])
)
MOUNT = Transform(STAMP_NS, "base_link", "velodyne_front_link", np.array([1.2, 0.0, 1.37]), TURN)
CALIBRATION = CameraCalibration(
    STAMP_NS,
    "gmsl_centre_link",
    1920,
    1208,
    "equidistant",
    np.array([-0.05, -0.08, 0.1, -0.05]),
    np.array([[1176.93, 0, 962.275], [0, 1177.72, 612.725], [0, 0, 1]]),
)
CLOUD = PointCloud(STAMP_NS, "velodyne_front_link", np.array([[4.0, -1.5, 0.25], [8.0, 2.5, -1.5]], np.float32))
IMAGE = CompressedImage(STAMP_NS, "gmsl_left_link", b"\xff\xd8\x00jpeg", "jpeg")
FOXGLOVE = {
    "foxglove.CameraCalibration": foxglove.to_protobuf(CALIBRATION),
    "foxglove.CompressedImage": foxglove.to_protobuf(IMAGE),
    "foxglove.FrameTransform": foxglove.to_protobuf(MOUNT),
    "foxglove.FrameTransforms": foxglove.to_protobuf((MOUNT, MOUNT)),
    "foxglove.Odometry": foxglove.to_protobuf(POSE),
    "foxglove.PointCloud": foxglove.to_protobuf(CLOUD),
    "foxglove.PoseInFrame": foxglove.pose_in_frame(POSE),
}

STATES = np.array([[1.0, 2.0, 0.5, 0.0], [1.05, 2.0, 0.5, 0.0]])
HISTORY = TrackHistory(np.array([STAMP_NS - 100_000_000, STAMP_NS]), STATES, np.array([True, False]))
OURS = {
    "pcgan.v1.CameraDetections": CameraDetections(
        STAMP_NS, "gmsl_centre_link", np.array([[900.25, 500, 960, 700.5]]), np.array([0.875]), ("person",)
    ),
    "pcgan.v1.LidarClusters": LidarClusters(
        STAMP_NS, "velodyne_front_link", np.array([[8.0, -0.5, 0.25]]), np.array([[0.5, 0.5, 1.75]]), np.array([40])
    ),
    "pcgan.v1.VehiclePose": POSE,
    "pcgan.v1.GroundTruthFrame": GroundTruthFrame(
        STAMP_NS, "odom", np.array([3]), np.array([[1.0, 2.0]]), np.array([[0.5, 0.0]]), np.array([40])
    ),
    "pcgan.v1.TrackFrame": TrackFrame(
        4,
        STAMP_NS,
        "odom",
        VehicleHistory(np.array([STAMP_NS]), np.array([[0.0, 0.0, 0.5, 2.0, 0.0]])),
        (Track(7, STATES[1], np.diag([0.04, 0.04, 0.09, 0.09]), 0.9, 10**9, False, HISTORY),),
    ),
}


def decode(schema_name: str, document: object):
    (decoder,) = decoders(LoggedSchema(schema_name, "jsonschema", b"{}"))
    return decoder.decode(document if isinstance(document, bytes) else json.dumps(document).encode())


def assert_same(found, expected):
    """Dataclasses, and tuples of them, of one type with equal fields."""
    assert type(found) is type(expected)
    if is_dataclass(expected):
        for field in fields(expected):
            assert_same(getattr(found, field.name), getattr(expected, field.name))
    elif isinstance(expected, tuple):
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other)
    else:
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("schema", sorted(FOXGLOVE))
def test_every_foxglove_message_is_read_as_from_its_protobuf(schema):
    message = FOXGLOVE[schema]
    expected = foxglove.from_protobuf(message)
    assert_same(decode(schema, plain(message)), expected)
    assert_same(decode(schema, json_format.MessageToJson(message).encode()), expected)  # camelCase, RFC 3339 stamps
    (decoder,) = decoders(LoggedSchema(schema, "jsonschema", b""))
    assert decoder.message == foxglove.MESSAGES[schema]


def test_all_of_foxgloves_messages_are_tried():
    assert set(FOXGLOVE) == set(foxglove.DECODERS)


@pytest.mark.parametrize("schema", sorted(OURS))
@pytest.mark.parametrize("snake_case", [False, True])
def test_our_messages_are_read_from_protobufs_canonical_json(schema, snake_case):
    message = codec.to_protobuf(OURS[schema])
    text = json_format.MessageToJson(message, preserving_proto_field_name=snake_case)
    assert f'"{STAMP_NS}"' in text  # 64 bits are text there
    assert_same(decode(schema, text.encode()), codec.decode(type(OURS[schema]), codec.encode(OURS[schema])))


def test_our_messages_may_have_their_stamp_as_a_number():
    schema = "pcgan.v1.LidarClusters"
    document = plain(codec.to_protobuf(OURS[schema]))
    assert document["stamp_ns"] == STAMP_NS
    assert_same(decode(schema, document), OURS[schema])


@pytest.mark.parametrize("schema", ["foxglove.SceneUpdate", "sensor_msgs/msg/CameraInfo", ""])
def test_other_schemas_play_no_role(schema):
    assert decoders(LoggedSchema(schema, "jsonschema", b"")) == ()


def test_whole_numbers_may_be_written_as_fractions_and_fractions_as_whole_numbers():
    document = plain(FOXGLOVE["foxglove.CameraCalibration"])
    document["width"] = 1920.0
    document["K"] = [1176.93, 0, 962.275, 0, 1177.72, 612.725, 0, 0, 1]
    assert_same(decode("foxglove.CameraCalibration", document), CALIBRATION)


def test_odometry_may_call_its_second_frame_as_foxgloves_first_version_did():
    document = plain(FOXGLOVE["foxglove.Odometry"])
    document["child_frame_id"] = document.pop("body_frame_id")
    assert_same(decode("foxglove.Odometry", document), POSE)


def test_a_twist_that_is_null_or_left_out_is_unknown():
    document = plain(FOXGLOVE["foxglove.Odometry"])
    del document["linear_velocity"]
    document["angular_velocity"] = None
    found = decode("foxglove.Odometry", document)
    assert np.isnan(found.velocity_mps).all()
    assert np.isnan(found.angular_velocity_radps).all()


def test_what_a_message_does_not_know_is_ignored():
    document = {**plain(FOXGLOVE["foxglove.Odometry"]), "metadata2": [{"key": "a"}], "uuid": None}
    assert_same(decode("foxglove.Odometry", document), POSE)


def test_a_static_transform_may_lack_a_stamp():
    document = plain(FOXGLOVE["foxglove.FrameTransforms"])
    del document["transforms"][0]["timestamp"]
    assert [transform.stamp_ns for transform in decode("foxglove.FrameTransforms", document)] == [0, STAMP_NS]
    assert decode("foxglove.FrameTransforms", {"transforms": []}) == ()
    assert decode("foxglove.FrameTransforms", {"transforms": None}) == ()


def changed(schema: str, path: str, value: object) -> dict:
    document = plain(FOXGLOVE[schema] if schema in FOXGLOVE else codec.to_protobuf(OURS[schema]))
    target = document
    *parents, name = path.split(".")
    for parent in parents:
        target = target[int(parent)] if isinstance(target, list) else target[parent]
    target[name] = value
    return document


@pytest.mark.parametrize(
    ("schema", "path", "value", "problem"),
    [
        ("foxglove.Odometry", "timestamp", {}, "Odometry has no stamp"),
        ("foxglove.Odometry", "timestamp", None, "Odometry has no stamp"),
        ("foxglove.Odometry", "timestamp", 1.5e9, "timestamp"),
        ("foxglove.Odometry", "timestamp", "yesterday", "timestamp"),
        ("foxglove.Odometry", "timestamp.sec", 1.5, r"Odometry\.timestamp .* is not whole numbers sec and nsec"),
        ("foxglove.Odometry", "timestamp.nanosec", 5, r"Odometry\.timestamp .* is not whole numbers sec and nsec"),
        ("foxglove.Odometry", "timestamp.sec", -5, "Odometry has no stamp"),
        ("foxglove.Odometry", "timestamp.sec", 10**12, "past the year 2262"),
        ("foxglove.Odometry", "timestamp.nsec", 2**40, r"Odometry\.timestamp .* out of range"),
        ("foxglove.Odometry", "pose", "here", r"Odometry\.pose is text instead of an object"),
        ("foxglove.Odometry", "linear_velocity", [1, 2, 3], r"linear_velocity is an array instead of an object"),
        ("foxglove.Odometry", "pose.position.x", None, r"Vector3\.x is null, as JavaScript writes NaN"),
        ("foxglove.Odometry", "pose.position.x", "near", r"position\.x"),
        ("foxglove.Odometry", "pose.position.x", float("nan"), r"Odometry\.position holds NaN"),
        ("foxglove.Odometry", "pose.position.x", "NaN", r"Odometry\.position holds NaN"),
        ("foxglove.Odometry", "pose.orientation.w", 5.0, "instead of 1"),
        ("foxglove.Odometry", "frame_id", 5, "frame_id"),
        ("foxglove.FrameTransforms", "transforms", {}, r"FrameTransforms\.transforms is an object instead of an array"),
        ("foxglove.FrameTransforms", "transforms", [None], r"transforms is null instead of an object"),
        ("foxglove.FrameTransforms", "transforms.1.rotation.z", float("inf"), r"FrameTransform\.rotation holds NaN"),
        ("foxglove.FrameTransforms", "transforms.1.timestamp.sec", "3", r"FrameTransform\.timestamp"),
        ("foxglove.CameraCalibration", "width", 0, "no image size"),
        ("foxglove.CameraCalibration", "K", [1.0, 2.0], "K has 2 entries"),
        ("foxglove.CameraCalibration", "D", [None], r"CameraCalibration\.D\[0\]"),
        ("foxglove.CompressedImage", "data", "", "no data"),
        ("foxglove.CompressedImage", "data", "a", r"CompressedImage\.data is not base64"),
        ("foxglove.CompressedImage", "data", "\u00e4bcd", r"CompressedImage\.data is not base64"),
        ("foxglove.CompressedImage", "data", "/9g!", r"CompressedImage\.data is not base64"),
        ("foxglove.CompressedImage", "data", {"type": "Buffer"}, r"data is an object instead of text in base64"),
        ("foxglove.PointCloud", "point_stride", -1, "point_stride"),
        ("foxglove.PointCloud", "fields.0.type", 99, "fields x has the unknown type 99"),
        ("foxglove.PointCloud", "fields.0.type", "FLOAT128", "type"),
        ("pcgan.v1.CameraDetections", "stamp_ns", None, r"CameraDetections\.stamp_ns is null"),
        ("pcgan.v1.CameraDetections", "stamp_ns", 0, "CameraDetections has no stamp"),
        ("pcgan.v1.CameraDetections", "score", [2.0], "score outside 0 to 1"),
        ("pcgan.v1.CameraDetections", "x_min", [1.0, 2.0], "arrays differ in length"),
        ("pcgan.v1.CameraDetections", "label", "p", r"CameraDetections\.label is text instead of an array"),
        ("pcgan.v1.LidarClusters", "points", [1.5], "points"),
        ("pcgan.v1.LidarClusters", "size_x", [-1.0], "negative size"),
        ("pcgan.v1.LidarClusters", "x", [1e300], r"LidarClusters\.x"),
        ("pcgan.v1.TrackFrame", "tracks.0.covariance", [1.0], "covariance has 1 entries instead of 16"),
        ("pcgan.v1.TrackFrame", "tracks.0.history", [], r"Track\.history is an array instead of an object"),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(schema, path, value, problem):
    with pytest.raises(CodecError, match=problem):
        decode(schema, changed(schema, path, value))


NESTED = b"[" * 100_000 + b"]" * 100_000
SCHEMAS = st.sampled_from(sorted(FOXGLOVE) + sorted(OURS))


@pytest.mark.parametrize("data", [b"", b"{", b"\xff", b"[]", b"3", b'"text"', NESTED, b'{"a": ' + b"9" * 5000 + b"}"])
def test_what_is_no_object_is_no_message(data):
    for schema in ("foxglove.Odometry", "pcgan.v1.LidarClusters"):
        with pytest.raises(CodecError, match=f"not a {schema}"):
            decode(schema, data)


@given(SCHEMAS, st.binary(max_size=100))
def test_any_bytes_give_a_message_or_a_codec_error(schema, data):
    with contextlib.suppress(CodecError):
        decode(schema, data)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
HUGE = st.sampled_from([10**400, -(10**400), 1e308, 2**63, -(2**63), "\ud800", "1e400", "Infinity", {"sec": 10**400}])


@given(st.data())
def test_a_message_with_something_else_in_one_place_is_still_one_or_a_codec_error(data):
    schema = data.draw(SCHEMAS)
    document = plain(FOXGLOVE[schema] if schema in FOXGLOVE else codec.to_protobuf(OURS[schema]))
    parent, key, value = None, None, document
    while isinstance(value, dict | list) and value and (parent is None or data.draw(st.booleans())):
        parent, key = value, data.draw(st.sampled_from(sorted(value) if isinstance(value, dict) else range(len(value))))
        value = parent[key]
    parent[key] = data.draw(JSON | HUGE)
    with contextlib.suppress(CodecError):
        decode(schema, document)


def test_a_drive_of_other_writers_holds_the_same_messages(short_drive, tmp_path):
    """Every message of a drive, in Foxglove's protobuf and in JSON, decodes to what the source decodes to."""
    protobuf = as_foxglove(short_drive, tmp_path / "foxglove.mcap")
    as_json = as_foxglove_json(short_drive, tmp_path / "json.mcap")
    counted = 0
    for ours, theirs, in_json in zip(records(short_drive), records(protobuf), records(as_json), strict=True):
        (topic, log_time_ns, encoding, schema, data) = ours
        assert theirs[:3] == (topic, log_time_ns, encoding)
        assert in_json[:4] == (topic, log_time_ns, "json", theirs[3])
        expected = decode_protobuf(schema, data)
        assert_same(decode_protobuf(theirs[3], theirs[4]), expected)
        assert_same(decode(in_json[3], in_json[4]), expected)
        counted += 1
    assert counted > 500


def records(path):
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            yield channel.topic, message.log_time, channel.message_encoding, schema.name, message.data


def decode_protobuf(schema, data):
    if schema in codec.MESSAGE_TYPES:
        return codec.decode(codec.MESSAGE_TYPES[schema], data)
    return foxglove.decode(schema, data)
