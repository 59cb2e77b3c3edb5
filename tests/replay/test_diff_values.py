"""Bytes as named values: protobuf of every shape, and what is left out or cannot be read."""

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.struct_pb2 import Struct
from mcap_protobuf.schema import build_file_descriptor_set

from replay.diff_values import Level, flattener, has_field
from replay.logged_message import LoggedSchema
from schemas import codec
from schemas.messages import PredictionFrame, TrackFrame


def names(level: Level) -> dict[str, list]:
    found = {}
    for name, part in level.parts.items():
        found |= names(part) if isinstance(part, Level) else {name: part}
    return found


def schema_of(kind) -> LoggedSchema:
    definition = build_file_descriptor_set(kind).SerializeToString()
    return LoggedSchema(kind.DESCRIPTOR.full_name, "protobuf", definition)


def test_a_track_frame_has_the_fields_that_the_documents_name(results):
    frame = results[-1].tracks
    found = names(flattener(schema_of(codec.protobuf_type(TrackFrame)), "protobuf")(codec.encode(frame)))
    assert found["tracks.id"] == [track.id for track in frame.tracks]
    assert found["tracks.vx"] == [float(track.state[2]) for track in frame.tracks]
    assert found["tracks.covariance"] == [
        value for track in frame.tracks for value in track.covariance.ravel().tolist()
    ]
    assert found["tracks.history.x"] == [x for track in frame.tracks for x in track.history.states[:, 0].tolist()]
    assert found["vehicle_history.yaw"] == frame.vehicle_history.states[:, 2].tolist()


def test_what_is_ignored_is_not_even_read(results):
    frame = results[-1].predictions
    schema = schema_of(codec.protobuf_type(PredictionFrame))
    whole = names(flattener(schema, "protobuf")(codec.encode(frame)))
    ignore = ("predictions.mixture", "vehicle_path", "predictions.path", "sequence")
    found = names(flattener(schema, "protobuf", ignore)(codec.encode(frame)))
    gone = {name for name in whole if name.split(".")[0] in {"vehicle_path", "sequence"} or ".mixture." in name}
    assert gone
    assert found == {name: values for name, values in whole.items() if name not in gone}


def test_maps_oneofs_and_messages_in_themselves():
    message = Struct()
    message.update({"speed": 1.5, "names": ["a", "b"], "inner": {"deep": True}})
    root = flattener(schema_of(Struct), "protobuf")(message.SerializeToString())
    fields = root.parts["fields"]
    assert fields.keys == ["inner", "names", "speed"]
    found = names(root)
    assert found["fields.value.number_value"] == [1.5]
    assert found["fields.value.list_value.values.string_value"] == ["a", "b"]
    assert found["fields.value.struct_value.fields.value.bool_value"] == [True]


def test_what_cannot_be_read_has_no_flattener():
    for schema, encoding in (
        (LoggedSchema("nobody.Knows", "protobuf", b""), "protobuf"),
        (LoggedSchema("nobody.Knows", "protobuf", b"\xff\xff"), "protobuf"),
        (LoggedSchema("nobody.Knows", "protobuf", FileDescriptorSet().SerializeToString()), "protobuf"),
        (LoggedSchema("a_msgs/msg/Thing", "ros2msg", b"]["), "cdr"),
        (LoggedSchema("a_msgs/msg/Thing", "ros2msg", b"wstring text"), "cdr"),
        (LoggedSchema("a_msgs/msg/Thing", "ros2msg", b"Thing again"), "cdr"),
        (LoggedSchema("a_msgs/Thing", "ros1msg", b""), "ros1"),
        (LoggedSchema("x", "", b""), "cbor"),
    ):
        assert flattener(schema, encoding) is None, schema


POINTS = b"""Header header
geometry_msgs/Point32[] points
float32[3] size
================================================================================
MSG: std_msgs/Header
string frame_id
================================================================================
MSG: geometry_msgs/Point32
float32 x
"""


@pytest.mark.parametrize(
    ("schema", "encoding", "there", "missing"),
    [
        (
            schema_of(codec.protobuf_type(PredictionFrame)),
            "protobuf",
            ("sequence", "predictions", "predictions.mixture", "predictions.paths.x"),
            ("", "prediction", "predictions.mixtures", "predictions.paths.x.y"),
        ),
        (schema_of(Struct), "protobuf", ("fields.value.list_value.values.bool_value",), ("fields.bool_value",)),
        (
            LoggedSchema("a_msgs/Thing", "ros1msg", POINTS),
            "ros1",
            ("header", "header.frame_id", "points", "points.x", "size"),
            ("frame_id", "points.y", "points.x.z", "size.x"),
        ),
        (LoggedSchema("any", "jsonschema", b""), "json", ("anything",), ()),
        (LoggedSchema("nobody.Knows", "protobuf", b""), "protobuf", (), ("anything",)),
        (LoggedSchema("x", "", b""), "cbor", (), ("anything",)),
    ],
)
def test_whether_a_schema_has_a_field(schema, encoding, there, missing):
    assert [name for name in there if not has_field(schema, encoding, name)] == []
    assert [name for name in missing if has_field(schema, encoding, name)] == []
