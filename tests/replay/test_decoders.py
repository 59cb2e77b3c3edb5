"""Decoders: every schema a role can have gives the dataclass that role wants."""

import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage as FoxgloveImage

from replay import foxglove
from replay.decoders import PROTOBUF as DECODERS
from replay.decoders import decoders_for, schemas_of
from replay.logged_message import LoggedSchema
from schemas import codec, messages, topics
from schemas.codec import CodecError


def test_every_decoder_names_a_dataclass_that_some_topic_carries():
    carried = {topic.message for topic in (*topics.INPUTS, *topics.OUTPUTS)} | {"NodeHealth"}
    for schema, (name, _) in DECODERS.items():
        assert hasattr(messages, name), schema
        assert name in carried, schema


def test_our_messages_are_decoded(make):
    for message in (make.pose(1), make.scan(1), make.boxes(1), make.truth(1, [(1, 2, 3)])):
        name, decoder = DECODERS[codec.schema_name(type(message))]
        found = decoder(codec.encode(message))
        assert type(found).__name__ == name == type(message).__name__
        assert found.stamp_ns == message.stamp_ns


def test_foxglove_messages_are_decoded(make):
    calibration = DECODERS["foxglove.CameraCalibration"][1](foxglove.encode(make.calibration()))
    assert calibration.model == "equidistant"
    pose = DECODERS["foxglove.Odometry"][1](foxglove.encode(make.pose(1)))
    assert pose.frame_id == "odom"
    transforms = DECODERS["foxglove.FrameTransforms"][1](foxglove.encode((make.transform("a", "b"),) * 2))
    assert isinstance(transforms, tuple)
    assert [t.child_frame_id for t in transforms] == ["b", "b"]


def test_an_image_is_passed_through(make):
    image = FoxgloveImage(frame_id="camera", data=b"bytes", format="jpeg")
    image.timestamp.FromNanoseconds(make.stamp(5))
    found = DECODERS["foxglove.CompressedImage"][1](image.SerializeToString())
    assert (found.stamp_ns, found.data, found.format) == (make.stamp(5), b"bytes", "jpeg")


@pytest.mark.parametrize("schema", sorted(DECODERS))
def test_bytes_that_are_something_else_raise_a_codec_error(schema):
    with pytest.raises(CodecError):
        DECODERS[schema][1](b"\xff\xff\xff\xff")


def test_schemas_nobody_knows_have_no_decoder():
    for name, kind, encoding in (("x.Y", "protobuf", "protobuf"), ("x/Y", "ros2msg", "cdr"), ("", "", "")):
        assert decoders_for(LoggedSchema(name, kind, b""), encoding) == ()
    ours = LoggedSchema("pcgan.v1.VehiclePose", "protobuf", b"")
    assert [way.message for way in decoders_for(ours, "protobuf")] == ["VehiclePose"]
    assert decoders_for(ours, "cdr") == ()


def test_the_families_of_a_message_are_listed_together():
    assert {"pcgan.v1.VehiclePose", "foxglove.Odometry", "foxglove.PoseInFrame"} <= set(schemas_of("VehiclePose"))
