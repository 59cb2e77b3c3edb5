"""Type hashes against those that ROS 2 itself printed or generated, and against a second implementation."""

import pytest
from rosbags.typesys import Stores, get_typestore

from replay import rmw_zenoh
from replay.logged_message import LoggedSchema
from replay.ros_type_hash import TypeHashError, definition_of, type_hash
from tests.replay import rmw_reference

# Hashes that real ROS 2 installations printed (ros2 topic info --verbose, design.md of rmw_zenoh) or that rosidl
# generated (vision_msgs 4.1: borednuna/ipm-ws at 1d76827, build/vision_msgs/.../detection2_d_array__description.c).
PUBLISHED = {
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "geometry_msgs/msg/Twist": "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "vision_msgs/msg/Point2D": "eab0e83f44ab4de92ceaf76dd7d0e7638f2bdd1d16ffbe16c7a136c48e407247",
    "vision_msgs/msg/Detection2DArray": "214274120007f4a683866481336b70310268cfa107aebe9d594a6acf75bda968",
}


@pytest.mark.parametrize(("name", "digest"), PUBLISHED.items())
def test_a_published_hash_leads_to_a_definition_that_has_it(name, digest):
    schema = definition_of(name, f"RIHS01_{digest}")
    assert schema[:2] == (name, "ros2msg")
    assert type_hash(schema) == f"RIHS01_{digest}"


@pytest.mark.parametrize("name", [rmw_reference.STRING, rmw_reference.DETECTIONS, rmw_reference.PREDICTED])
def test_a_second_implementation_agrees(name):
    assert type_hash(definition_of(name, rmw_reference.rihs01(name))) == rmw_reference.rihs01(name)


@pytest.mark.parametrize("release", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_LYRICAL])
def test_every_type_of_a_release_is_found_by_its_hash(release):
    store = get_typestore(release)
    for name in store.fielddefs:
        assert type_hash(definition_of(name, store.hash_rihs01(name))) == store.hash_rihs01(name)


def test_vision_msgs_3_is_told_from_4():
    three = LoggedSchema(
        "vision_msgs/msg/BoundingBox2D",
        "ros2msg",
        b"geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n"
        + b"=" * 80
        + b"\nMSG: geometry_msgs/Pose2D\nfloat64 x\nfloat64 y\nfloat64 theta\n",
    )
    found = definition_of(three.name, type_hash(three))
    assert b"geometry_msgs/Pose2D center" in found.definition
    four = definition_of(three.name, rmw_reference.rihs01(three.name))
    assert b"vision_msgs/Pose2D center" in four.definition
    array = definition_of(rmw_reference.DETECTIONS, rmw_zenoh.TYPE_HASH_NOT_SUPPORTED)  # Humble has vision_msgs 4
    assert type_hash(array) == rmw_reference.rihs01(rmw_reference.DETECTIONS)


def test_comments_and_constants_do_not_matter_but_names_do():
    def of(text):
        return type_hash(LoggedSchema("a/msg/B", "ros2msg", text))

    assert of(b"# what\nuint8 X=1\nuint8 kind # how\n") == of(b"uint8 kind")
    assert of(b"uint8 kind") != of(b"uint8 sort")
    assert of(b"uint8[<=3] kind") != of(b"uint8[3] kind") != of(b"uint8[] kind")


def test_an_idl_has_the_hash_of_its_message():
    idl = b"module a { module msg { struct B { uint8 kind; }; }; };"
    assert type_hash(LoggedSchema("a/msg/B", "ros2idl", idl)) == type_hash(
        LoggedSchema("a/msg/B", "ros2msg", b"uint8 kind")
    )


def test_an_unknown_hash_is_told_with_those_known():
    with pytest.raises(TypeHashError, match="String with the hash RIHS01_00 is known, only RIHS01_df668c74"):
        definition_of("std_msgs/msg/String", "RIHS01_00")
    with pytest.raises(TypeHashError, match="nor any other of this type"):
        definition_of("acme_msgs/msg/Radar", "RIHS01_00")


@pytest.mark.parametrize(
    ("schema", "why"),
    [
        (LoggedSchema("a/msg/B", "protobuf", b""), "'protobuf'; only ros2msg and ros2idl"),
        (LoggedSchema("a/msg/B", "ros1msg", b"uint8 kind"), "'ros1msg'; only ros2msg and ros2idl"),
        (LoggedSchema("a/msg/B", "ros2msg", b"std_msgs/Header header"), "lacks 'std_msgs/msg/Header'"),
        (LoggedSchema("a/msg/B", "ros2msg", b"uint8 (1)"), "a/msg/B cannot be read"),
        (LoggedSchema("a/msg/B", "ros2msg", b"\xff\xfe"), "a/msg/B cannot be read"),
    ],
)
def test_a_definition_without_a_hash_says_why(schema, why):
    with pytest.raises(TypeHashError, match=why):
        type_hash(schema)
