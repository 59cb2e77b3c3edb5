"""ROS messages as other libraries write them -> our dataclasses, in every layout; what makes no sense is named."""

import contextlib
import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks import decoding
from replay import ros
from replay.decoders import decoders_for
from replay.log_reader import LogReader
from replay.logged_message import LoggedSchema
from schemas.codec import CodecError
from schemas.messages import CameraDetections
from tests.replay import foreign_ros as foreign
from tests.replay.foreign_ros import Stack, header
from tests.replay.ros_samples import (
    ARRAY_2D,
    ARRAY_3D,
    AUTOWARE,
    CAMERA_INFO,
    CLOUD,
    POINTS,
    ROS2,
    STACKS,
    STAMP_NS,
    TRACKED,
    assert_equal,
    camera_info,
    cloud,
    decode,
    edited,
    pose,
    tracked,
    transforms,
    two_boxes,
    two_boxes_3d,
)

# --- which types, by which definition ------------------------------------------------------------------------------


def test_each_type_under_both_names():
    names = {
        "vision_msgs/Detection2DArray": ["CameraDetections"],
        "vision_msgs/Detection3DArray": ["LidarClusters", "ObjectTracks"],
        "autoware_perception_msgs/TrackedObjects": ["ObjectTracks"],
        "autoware_auto_perception_msgs/TrackedObjects": ["ObjectTracks"],
        "tier4_perception_msgs/DetectedObjectsWithFeature": ["LidarClusters"],
        "sensor_msgs/CameraInfo": ["CameraCalibration"],
        "sensor_msgs/CompressedImage": ["CompressedImage"],
        "sensor_msgs/PointCloud2": ["PointCloud"],
        "nav_msgs/Odometry": ["VehiclePose"],
        "geometry_msgs/PoseStamped": ["VehiclePose"],
        "geometry_msgs/PoseWithCovarianceStamped": ["VehiclePose"],
        "tf2_msgs/TFMessage": ["Transform"],
        "tf/tfMessage": ["Transform"],
        "sensor_msgs/Imu": [],
        "sensor_msgs/Image": [],
        "pcgan.v1.LidarClusters": [],
        "": [],
    }
    for name, messages in names.items():
        package, _, message = name.rpartition("/")
        for spelled in {name, f"{package}/msg/{message}" if package else name}:
            found = ros.decoders(LoggedSchema(spelled, "ros2msg", b""), "cdr")
            assert [decoder.message for decoder in found] == messages, spelled


@pytest.mark.parametrize(
    ("full", "build"),
    [
        ("vision_msgs/msg/Detection2DArray", lambda: two_boxes(ROS2)),
        ("vision_msgs/msg/Detection3DArray", lambda: two_boxes_3d(ROS2)),
        ("sensor_msgs/msg/CameraInfo", lambda: camera_info(ROS2)),
        ("nav_msgs/msg/Odometry", lambda: foreign.odometry(ROS2, pose())),
        ("autoware_perception_msgs/msg/TrackedObjects", tracked),
    ],
)
def test_a_message_on_a_bus_has_no_definition_and_is_read_by_the_standard_one(full, build):
    [decoder, *_] = ros.decoders(LoggedSchema(full, "", b""), "cdr")
    assert_equal(decoder.decode(ROS2.rosbags_bytes(full, build())), decode(ROS2, full, build()))


def test_not_every_type_is_known_without_a_definition():
    full = "autoware_auto_perception_msgs/msg/TrackedObjects"
    [decoder] = ros.decoders(LoggedSchema(full, "", b""), "cdr")
    with pytest.raises(CodecError, match=f"{full} comes without a definition"):
        decoder.decode(ROS2.rosbags_bytes(full, tracked()))


def test_ros_1_needs_a_definition():
    [decoder] = ros.decoders(LoggedSchema("nav_msgs/Odometry", "", b""), "ros1")
    with pytest.raises(CodecError, match="the recording has no definition of nav_msgs/Odometry"):
        decoder.decode(b"")


def test_a_definition_that_cannot_be_used_is_named_with_every_message():
    for text, error in [
        (b"<nonsense>", "definition of nav_msgs/msg/Odometry cannot be read"),
        (b"std_msgs/Header header", "lacks std_msgs/msg/Header"),
        (b"float64 pose", "nav_msgs/msg/Odometry has no field header.stamp.sec"),
    ]:
        [decoder] = ros.decoders(LoggedSchema("nav_msgs/msg/Odometry", "ros2msg", text), "cdr")
        for _ in range(2):
            with pytest.raises(CodecError, match=error):
                decoder.decode(b"\0\1\0\0")


def test_a_field_of_another_type_is_named():
    name = "autoware_auto_perception_msgs/msg/TrackedObject"
    odd = {**AUTOWARE, name: AUTOWARE[name].replace("float32 existence", "string existence")}
    stack = Stack(4, odd)
    full, values = f"{name}s", edited(tracked(), "objects.0.existence_probability", "certain")
    with pytest.raises(CodecError, match="TrackedObjects is not the usual message of that name: could not convert"):
        decode(stack, full, values)


# --- any bytes -----------------------------------------------------------------------------------------------------


def samples():
    """One message of every type in every stack: schema, encoding, bytes."""
    found = []
    for stack in STACKS.values():
        messages = {
            ARRAY_2D: two_boxes(stack), ARRAY_3D: two_boxes_3d(stack), CAMERA_INFO: camera_info(stack),
            "nav_msgs/msg/Odometry": foreign.odometry(stack, pose()), CLOUD: cloud(POINTS, height=2),
            "tf2_msgs/msg/TFMessage": foreign.tf_message(stack, transforms()),
            "sensor_msgs/msg/CompressedImage": {"header": header(STAMP_NS, "a"), "data": [1, 2], "format": "png"},
        } | ({TRACKED: tracked()} if stack is ROS2 else {})  # fmt: skip
        found += [
            (decoder, stack.rosbags_bytes(full, values))
            for full, values in messages.items()
            for decoder in ros.decoders(stack.schema(full), stack.encoding)
        ]
    return found


SAMPLES = samples()


@given(st.data())
@settings(max_examples=400)
def test_damaged_bytes_raise_nothing_but_codec_errors(data):
    decoder, message = data.draw(st.sampled_from(SAMPLES))
    damaged = bytearray(message)
    for at, value in data.draw(
        st.dictionaries(st.integers(4, len(message) - 1), st.integers(0, 255), max_size=8)
    ).items():
        damaged[at] = value
    with contextlib.suppress(CodecError):
        decoder.decode(bytes(damaged[: data.draw(st.integers(0, len(message)))]))
    with contextlib.suppress(CodecError):
        decoder.decode(bytes(damaged))


def test_absurd_lengths_take_no_memory():
    """Every aligned word of every sample, made a huge count in turn."""
    tracemalloc.start()
    try:
        for decoder, message in SAMPLES:
            for at in range(0, len(message) - 4, 4):
                with contextlib.suppress(CodecError):
                    decoder.decode(message[:at] + b"\xff\xff\xff\x0f" + message[at + 4 :])
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()


# --- whole drives --------------------------------------------------------------------------------------------------

DRIVES = {
    "mcap-ros2-support, vision_msgs 4": foreign.as_ros2,
    "rosbags, vision_msgs 3": lambda source, target: foreign.as_ros2(source, target, 3, "rosbags"),
    "rosbags, vision_msgs 2": lambda source, target: foreign.as_ros2(source, target, 2, "rosbags"),
    "genpy, vision_msgs 1": foreign.as_ros1,
}


@pytest.mark.parametrize("write", DRIVES.values(), ids=DRIVES)
def test_a_drive_as_others_write_it_holds_the_same_messages_as_ours(write, short_drive, tmp_path):
    """Exactly, but for the clusters' numbers of points (see `reduced`) and names of classes in ROS 1."""
    ours = LogReader([foreign.reduced(short_drive, tmp_path / "ours.mcap")]).messages()
    theirs = LogReader([write(short_drive, tmp_path / "theirs.mcap")]).messages()
    count = 0
    for own, other in zip(ours, theirs, strict=True):
        assert (own.topic, own.log_time_ns) == (other.topic, other.log_time_ns)
        assert other.encoding in ("cdr", "ros1")
        expected = decoders_for(own.schema, own.encoding)[0].decode(own.data)
        if isinstance(expected, CameraDetections) and other.encoding == "ros1":
            numbers = tuple(str(foreign.CLASS_IDS[name]) for name in expected.labels)
            expected = CameraDetections(*list(vars(expected).values())[:-1], numbers)
        assert_equal(decoders_for(other.schema, other.encoding)[0].decode(other.data), expected)
        count += 1
    assert count > 900


def test_the_benchmark_decodes_with_everything_it_names():
    for name, call in decoding.calls(3).items():
        found = call()
        assert len(found.labels if isinstance(found, CameraDetections) else found.detections) == 3, name
