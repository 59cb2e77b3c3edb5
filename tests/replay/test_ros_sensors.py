"""Cameras, poses, transforms and points as ROS 1 and ROS 2 have them."""

import math

import numpy as np
import pytest

from schemas.codec import CodecError
from schemas.messages import CameraCalibration, CompressedImage, PointCloud, VehiclePose
from tests.replay import foreign_ros as foreign
from tests.replay.foreign_ros import header
from tests.replay.ros_samples import (
    CAMERA_INFO,
    CLOUD,
    POINTS,
    ROS1,
    ROS2,
    STAMP_NS,
    K,
    assert_equal,
    both_ros,
    camera_info,
    cloud,
    decode,
    edited,
    pose,
    transforms,
)

# --- cameras -------------------------------------------------------------------------------------------------------


@both_ros
@pytest.mark.parametrize(
    ("theirs", "ours", "coefficients"),
    [
        ("plumb_bob", "plumb_bob", 5),
        ("rational_polynomial", "rational_polynomial", 8),
        ("equidistant", "equidistant", 4),
        ("fisheye", "equidistant", 4),
        ("kannala_brandt", "equidistant", 4),
        ("brown_conrady", "brown_conrady", 3),  # whoever uses it says that it is not known
    ],
)
def test_calibrations(stack, theirs, ours, coefficients):
    D = np.arange(coefficients) / 100
    found = decode(stack, CAMERA_INFO, camera_info(stack, theirs, D))
    assert_equal(found, CameraCalibration(STAMP_NS, "front", 1920, 1208, ours, D, K))


@pytest.mark.parametrize("model", ["", "plumb_bob"])
def test_a_rectified_camera_has_no_distortion(model):
    found = decode(ROS2, CAMERA_INFO, camera_info(ROS2, model, ()))
    assert (found.model, found.distortion.tolist()) == ("plumb_bob", [0] * 5)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"width": 0}, r"CameraInfo has no image size \(0 x 1208\)"),
        ({"height": 0}, "has no image size"),
        ({"k": np.zeros(9)}, "CameraInfo.k is all zeros: the camera is not calibrated"),
        ({"k": np.full(9, np.nan)}, "CameraInfo.k holds NaN"),
        ({"d": np.array([1, np.inf])}, "CameraInfo.d holds NaN or infinity"),
        ({"header": header(0, "front")}, "CameraInfo has no stamp"),
        ({"binning_x": 2}, "binned or cropped images, not whole ones .binning 2 x 0, roi at 0, 0"),
        ({"roi": {"x_offset": 8}}, "roi at 8, 0"),
    ],
)
def test_calibrations_that_make_no_sense(changes, error):
    with pytest.raises(CodecError, match=error):
        decode(ROS2, CAMERA_INFO, camera_info(ROS2, **changes))


@both_ros
@pytest.mark.parametrize(
    ("theirs", "ours"),
    [
        ("jpeg", "jpeg"),
        ("jpg", "jpeg"),
        ("JPEG", "jpeg"),
        ("bgr8; jpeg compressed bgr8", "jpeg"),
        ("rgb8; png compressed rgb8", "png"),
        ("webp", "webp"),
        ("h264", "h264"),
        ("", ""),
    ],
)
def test_pictures(stack, theirs, ours):
    data = b"\xff\xd8 picture"
    values = {"header": header(STAMP_NS, "/front"), "format": theirs, "data": np.frombuffer(data, np.uint8)}
    found = decode(stack, "sensor_msgs/msg/CompressedImage", values)
    assert_equal(found, CompressedImage(STAMP_NS, "front", data, ours))


@pytest.mark.parametrize(
    ("format", "data", "error"),
    [("jpeg", b"", "CompressedImage has no data"), ("16UC1; compressedDepth png", b"x", "depths, not a picture")],
)
def test_pictures_that_are_none(format, data, error):
    values = {"header": header(STAMP_NS, "front"), "format": format, "data": np.frombuffer(data, np.uint8)}
    with pytest.raises(CodecError, match=error):
        decode(ROS2, "sensor_msgs/msg/CompressedImage", values)


# --- poses ---------------------------------------------------------------------------------------------------------


@both_ros
def test_odometry(stack):
    assert_equal(decode(stack, "nav_msgs/msg/Odometry", foreign.odometry(stack, pose())), pose())
    slashed = foreign.odometry(stack, pose("/odom", "/base_link"))
    assert_equal(decode(stack, "nav_msgs/msg/Odometry", slashed), pose())


@both_ros
@pytest.mark.parametrize("message", ["PoseStamped", "PoseWithCovarianceStamped"])
def test_poses_alone(stack, message):
    inside = foreign.odometry(stack, pose())["pose"]
    values = {"header": header(STAMP_NS, "map"), "pose": inside if "With" in message else inside["pose"]}
    found = decode(stack, f"geometry_msgs/msg/{message}", values)
    unknown = np.full(3, np.nan)
    expected = VehiclePose(STAMP_NS, "map", "", pose().position_m, pose().quaternion_xyzw, unknown, unknown)
    assert_equal(found, expected)


@pytest.mark.parametrize(
    ("path", "value", "error"),
    [
        ("header", header(0, "odom"), "Odometry has no stamp"),
        ("pose.pose.position.x", math.nan, "Odometry holds NaN or infinity"),
        ("twist.twist.linear.x", math.inf, "Odometry holds NaN or infinity"),
        ("pose.pose.orientation", foreign.rotation((0, 0, 0, 0)), "has length 0 instead of 1"),
    ],
)
def test_odometry_that_makes_no_sense(path, value, error):
    with pytest.raises(CodecError, match=error):
        decode(ROS2, "nav_msgs/msg/Odometry", edited(foreign.odometry(ROS2, pose()), path, value))


@pytest.mark.parametrize(
    ("stack", "full"),
    [(ROS2, "tf2_msgs/msg/TFMessage"), (ROS1, "tf2_msgs/msg/TFMessage"), (ROS1, "tf/msg/tfMessage")],
)
def test_transforms(stack, full):
    assert_equal(decode(stack, full, foreign.tf_message(stack, transforms())), transforms())
    assert decode(stack, full, {"transforms": []}) == ()


def test_transforms_of_ros_1_lose_their_slashes():
    values = foreign.tf_message(ROS1, transforms())
    values = edited(edited(values, "transforms.0.child_frame_id", "/lidar"), "transforms.1.header.frame_id", "/odom")
    assert_equal(decode(ROS1, "tf/msg/tfMessage", values), transforms())


@pytest.mark.parametrize(
    ("path", "value", "error"),
    [
        ("transforms.0.child_frame_id", "", "TFMessage from 'base_link' to '' lacks a frame name"),
        ("transforms.0.header.frame_id", "/", "TFMessage from '' to 'lidar' lacks"),
        ("transforms.0.transform.translation.x", math.nan, "TFMessage.transforms holds NaN"),
        ("transforms.0.transform.rotation.w", 0.1, "has length"),
    ],
)
def test_transforms_that_make_no_sense(path, value, error):
    with pytest.raises(CodecError, match=error):
        decode(ROS2, "tf2_msgs/msg/TFMessage", edited(foreign.tf_message(ROS2, transforms()), path, value))


# --- points --------------------------------------------------------------------------------------------------------


@both_ros
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (1, 5), (2, 0), (2, 3)])
def test_clouds(stack, order, height, padding):
    found = decode(stack, CLOUD, cloud(POINTS, order, height, padding))
    assert_equal(found, PointCloud(STAMP_NS, "lidar", POINTS))


@pytest.mark.parametrize("height", [1, 2])
def test_a_cloud_without_padding_may_leave_its_row_step_out(height):
    assert_equal(decode(ROS2, CLOUD, cloud(POINTS, height=height, row_step=0)), PointCloud(STAMP_NS, "lidar", POINTS))


def test_a_cloud_without_points_or_with_none_that_was_measured():
    for points in (POINTS[:0], np.zeros((2, 3)), np.full((2, 3), np.nan)):
        assert decode(ROS2, CLOUD, cloud(points)).points_m.shape == (0, 3)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"header": header(0, "lidar")}, "PointCloud2 has no stamp"),
        ({"width": 5}, "PointCloud2 has rows of 56 bytes, too few for 5 points of 14 bytes"),
        ({"width": 5, "row_step": 70}, "PointCloud2 holds 56 bytes instead of 70"),
        ({"point_step": 12}, "PointCloud2.z of 4 bytes at byte 10 does not fit into a point of 12 bytes"),
        ({"fields": []}, "PointCloud2 has no field x; its fields are none"),
        ({"fields": [{"name": "x", "datatype": 99}]}, "PointCloud2.x has an unknown type"),
        ({"height": 2, "width": 3, "row_step": 28}, "rows of 28 bytes, too few for 3 points"),
        ({"height": 2**31, "width": 2**31}, "PointCloud2 holds 56 bytes instead of 6"),
    ],
)
def test_clouds_that_make_no_sense(changes, error):
    with pytest.raises(CodecError, match=error):
        decode(ROS2, CLOUD, cloud(POINTS) | changes)
