"""Foxglove messages: everything comes back as it went in, and what makes no sense is refused by name."""

import contextlib

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration as FoxgloveCalibration
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud as FoxgloveCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from hypothesis import given
from hypothesis import strategies as st

from replay import foxglove
from schemas.codec import CodecError
from schemas.messages import CameraCalibration, CompressedImage, PointCloud, Transform, VehiclePose

STAMP_NS = 1_583_114_400_123_456_789
TURN = np.array([0.0, 0.0, 0.6, 0.8])


def calibration(**changes):
    values = {
        "stamp_ns": STAMP_NS,
        "frame_id": "gmsl_centre_link",
        "width_px": 1920,
        "height_px": 1208,
        "model": "equidistant",
        "distortion": np.array([-0.05, -0.08, 0.1, -0.05]),
        "intrinsics_px": np.array([[1176.93, 0, 962.275], [0, 1177.72, 612.725], [0, 0, 1]]),
    }
    return CameraCalibration(**{**values, **changes})


def pose():
    return VehiclePose(
        STAMP_NS, "odom", "base_link", np.array([1.0, -2.0, 0.5]), TURN, np.array([3.0, 0.1, 0]), np.array([0, 0, 0.2])
    )


def transform(child="velodyne_front_link"):
    return Transform(STAMP_NS, "base_link", child, np.array([1.2, 0.0, 1.37]), TURN)


def cloud():
    points = np.array([[4.0, -1.5, 0.25], [8.0, 2.5, -1.5]], np.float32)
    return PointCloud(STAMP_NS, "velodyne_front_link", points)


def assert_equal(found, expected):
    assert type(found) is type(expected)
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)


@pytest.mark.parametrize("model", ["equidistant", "plumb_bob", "rational_polynomial"])
def test_calibration_round_trip(model):
    sent = calibration(model=model, distortion=np.arange(8) / 100)
    assert_equal(foxglove.decode("foxglove.CameraCalibration", foxglove.encode(sent)), sent)


def test_the_fisheye_model_goes_by_foxgloves_name():
    assert FoxgloveCalibration.FromString(foxglove.encode(calibration())).distortion_model == "kannala_brandt"


@pytest.mark.parametrize("model", ["", "plumb_bob"])
def test_a_lens_without_distortion_has_zeros(model):
    found = foxglove.decode(
        "foxglove.CameraCalibration", foxglove.encode(calibration(model=model, distortion=np.zeros(0)))
    )
    assert_equal(found, calibration(model="plumb_bob", distortion=np.zeros(5)))


def test_pose_round_trips_as_odometry_with_its_twist():
    assert_equal(foxglove.decode("foxglove.Odometry", foxglove.encode(pose())), pose())


def test_pose_in_frame_has_no_twist_and_says_so():
    found = foxglove.decode("foxglove.PoseInFrame", foxglove.pose_in_frame(pose()).SerializeToString())
    np.testing.assert_array_equal(found.position_m, pose().position_m)
    np.testing.assert_array_equal(found.quaternion_xyzw, TURN)
    assert found.stamp_ns == STAMP_NS
    assert found.child_frame_id == ""
    assert np.isnan(found.velocity_mps).all()
    assert np.isnan(found.angular_velocity_radps).all()


def test_odometry_without_twist_has_nan_velocity():
    message = Odometry.FromString(foxglove.encode(pose()))
    message.ClearField("linear_velocity")
    assert np.isnan(foxglove.decode("foxglove.Odometry", message.SerializeToString()).velocity_mps).all()


def test_transforms_round_trip_alone_and_together():
    (alone,) = foxglove.decode("foxglove.FrameTransform", foxglove.encode(transform()))
    assert_equal(alone, transform())
    sent = (transform(), transform("gmsl_back_link"))
    for found, expected in zip(foxglove.decode("foxglove.FrameTransforms", foxglove.encode(sent)), sent, strict=True):
        assert_equal(found, expected)
    assert foxglove.decode("foxglove.FrameTransforms", foxglove.encode(())) == ()


def test_image_round_trip():
    sent = CompressedImage(STAMP_NS, "gmsl_left_link", b"\xff\xd8jpeg", "jpeg")
    assert foxglove.decode("foxglove.CompressedImage", foxglove.encode(sent)) == sent


def test_cloud_round_trip():
    assert_equal(foxglove.decode("foxglove.PointCloud", foxglove.encode(cloud())), cloud())


def test_what_a_beam_did_not_meet_is_left_out_of_a_cloud():
    points = np.array([[1, 2, 3], [0, 0, 0], [np.nan, 1, 1], [4, 5, 6]], np.float32)
    sent = foxglove.encode(PointCloud(STAMP_NS, "lidar", points))
    np.testing.assert_array_equal(foxglove.decode("foxglove.PointCloud", sent).points_m, [[1, 2, 3], [4, 5, 6]])
    assert foxglove.decode(
        "foxglove.PointCloud", foxglove.encode(PointCloud(STAMP_NS, "lidar", points[:0]))
    ).points_m.shape == (0, 3)


@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"])
def test_a_cloud_may_have_fields_of_any_type_in_any_order(dtype):
    names = {"u1": "UINT8", "i1": "INT8", "u2": "UINT16", "i2": "INT16", "u4": "UINT32", "i4": "INT32", "f4": "FLOAT32"}
    kind = PackedElementField.NumericType.Value(names.get(dtype, "FLOAT64"))
    record = np.dtype([("intensity", "<f4"), ("z", f"<{dtype}"), ("gap", "V3"), ("y", f"<{dtype}"), ("x", f"<{dtype}")])
    records = np.zeros(2, record)
    records["x"], records["y"], records["z"] = (1, 2), (3, 4), (5, 6)
    message = FoxgloveCloud(frame_id="lidar", point_stride=record.itemsize, data=records.tobytes())
    message.timestamp.FromNanoseconds(STAMP_NS)
    for name in ("intensity", "x", "y", "z"):
        offset = record.fields[name][1]
        message.fields.add(name=name, offset=offset, type=PackedElementField.FLOAT32 if name == "intensity" else kind)
    found = foxglove.decode("foxglove.PointCloud", message.SerializeToString())
    np.testing.assert_array_equal(found.points_m, [[1, 3, 5], [2, 4, 6]])


def test_a_cloud_is_moved_by_its_pose():
    message = FoxgloveCloud.FromString(foxglove.encode(cloud()))
    message.pose.position.x, message.pose.position.z = 1.0, 2.0
    message.pose.orientation.z = message.pose.orientation.w = np.sqrt(0.5)  # a quarter turn to the left
    found = foxglove.decode("foxglove.PointCloud", message.SerializeToString())
    np.testing.assert_allclose(found.points_m, [[2.5, 4.0, 2.25], [-1.5, 8.0, 0.5]], atol=1e-12)


def test_a_cloud_without_a_pose_stays_where_it_is():
    message = FoxgloveCloud.FromString(foxglove.encode(cloud()))
    message.ClearField("pose")
    assert_equal(foxglove.decode("foxglove.PointCloud", message.SerializeToString()), cloud())


def test_the_same_message_gives_the_same_bytes():
    assert foxglove.encode(calibration()) == foxglove.encode(calibration())


def test_other_objects_are_refused():
    with pytest.raises(TypeError, match="int has no Foxglove protobuf"):
        foxglove.encode(3)


def test_a_static_transform_may_lack_a_stamp_but_a_pose_may_not():
    message = FrameTransform.FromString(foxglove.encode(transform()))
    message.ClearField("timestamp")
    assert foxglove.decode("foxglove.FrameTransform", message.SerializeToString())[0].stamp_ns == 0
    odometry = Odometry.FromString(foxglove.encode(pose()))
    odometry.ClearField("timestamp")
    with pytest.raises(CodecError, match="Odometry has no stamp"):
        foxglove.decode("foxglove.Odometry", odometry.SerializeToString())


@pytest.mark.parametrize("schema", sorted(foxglove.DECODERS))
def test_garbage_is_not_a_message(schema):
    with pytest.raises(CodecError, match=f"not a {schema}"):
        foxglove.decode(schema, b"\xff\xff\xff\xff")


def edited(message_type, message, **changes):
    decoded = message_type.FromString(foxglove.encode(message))
    for path, value in changes.items():
        *parents, name = path.split("__")
        target = decoded
        for parent in parents:
            target = getattr(target, parent)
        if isinstance(value, list):
            del getattr(target, name)[:]
            getattr(target, name).extend(value)
        else:
            setattr(target, name, value)
    return decoded.SerializeToString()


@pytest.mark.parametrize(
    ("message_type", "message", "changes", "problem"),
    [
        (FoxgloveCalibration, calibration(), {"width": 0}, "no image size"),
        (FoxgloveCalibration, calibration(), {"K": [1.0, 2.0]}, "K has 2 entries"),
        (FoxgloveCalibration, calibration(), {"D": [float("nan")]}, "CameraCalibration.D holds NaN"),
        (FrameTransform, transform(), {"translation__x": float("inf")}, "FrameTransform.translation holds NaN"),
        (FrameTransform, transform(), {"rotation__w": 5.0}, "instead of 1"),
        (FrameTransform, transform(), {"rotation__w": float("nan")}, "FrameTransform.rotation holds NaN"),
        (FrameTransform, transform(), {"child_frame_id": ""}, "lacks a frame name"),
        (Odometry, pose(), {"linear_velocity__y": float("nan")}, "Odometry.linear_velocity holds NaN"),
        (Odometry, pose(), {"pose__position__x": float("nan")}, "Odometry.position holds NaN"),
        (FoxgloveCloud, cloud(), {"point_stride": 0}, "24 bytes, no multiple of the point_stride 0"),
        (FoxgloveCloud, cloud(), {"data": bytes(25)}, "25 bytes, no multiple of the point_stride 12"),
        (FoxgloveCloud, cloud(), {"fields": []}, "PointCloud has no field x"),
        (
            FoxgloveCloud,
            cloud(),
            {"fields": [PackedElementField(name="x", type=99)]},
            "fields x has the unknown type 99",
        ),
        (FoxgloveCloud, cloud(), {"pose__position__x": float("nan")}, "PointCloud.position holds NaN"),
        (FoxgloveCloud, cloud(), {"pose__orientation__w": 0.0}, "length 0 instead of 1"),
        (FoxgloveCloud, cloud(), {"timestamp__seconds": 0, "timestamp__nanos": 0}, "PointCloud has no stamp"),
        (Odometry, pose(), {"timestamp__seconds": 10**10}, "past the year 2262"),
        (Odometry, pose(), {"pose__position__x": 2e9}, "Odometry.position holds 2e.09, more than 1e.09"),
        (PoseInFrame, None, {"pose__position__x": float("nan")}, "PoseInFrame.position holds NaN"),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(message_type, message, changes, problem):
    if message is None:
        bad = foxglove.pose_in_frame(pose())
        bad.pose.position.x = float("nan")
        data = bad.SerializeToString()
    else:
        data = edited(message_type, message, **changes)
    with pytest.raises(CodecError, match=problem):
        foxglove.decode(message_type.DESCRIPTOR.full_name, data)


@given(st.sampled_from(sorted(foxglove.DECODERS)), st.binary(max_size=200))
def test_any_bytes_give_a_message_or_a_codec_error(schema, data):
    with contextlib.suppress(CodecError):
        foxglove.decode(schema, data)


EXAMPLES = {
    "foxglove.CameraCalibration": foxglove.encode(calibration()),
    "foxglove.Odometry": foxglove.encode(pose()),
    "foxglove.FrameTransforms": foxglove.encode((transform(),)),
    "foxglove.PointCloud": foxglove.encode(cloud()),
}


@given(st.sampled_from(sorted(EXAMPLES)), st.data())
def test_a_message_with_a_few_wrong_bytes_is_still_one_or_a_codec_error(schema, data):
    message = bytearray(EXAMPLES[schema])
    for at, value in data.draw(st.lists(st.tuples(st.integers(0, len(message) - 1), st.integers(0, 255)), max_size=4)):
        message[at] = value
    with contextlib.suppress(CodecError):
        foxglove.decode(schema, bytes(message))
