"""What detectors and trackers find, in all layouts of vision_msgs and in Autoware's messages."""

import math

import numpy as np
import pytest

from replay.ros_objects import expected_points
from schemas.codec import CodecError
from schemas.messages import CameraDetections, LidarClusters, ObjectTracks
from tests.replay.foreign_ros import box_2d, box_3d, header, result
from tests.replay.ros_samples import (
    ARRAY_2D,
    ARRAY_3D,
    HALF_TURN,
    QUARTER_TURN,
    ROS2,
    STACKS,
    STAMP_NS,
    TRACKED,
    assert_equal,
    cloud,
    decode,
    each_stack,
    edited,
    label,
    tracked,
    two_boxes,
    two_boxes_3d,
)

# --- vision_msgs ---------------------------------------------------------------------------------------------------


@each_stack
def test_boxes_of_all_layouts(stack):
    found = decode(stack, ARRAY_2D, two_boxes(stack))
    boxes = np.array([[90.0, 30.0, 110.0, 70.0], [10.0, 19.0, 11.0, 21.0]])
    labels = (label(stack, "person"), label(stack, "car"))
    assert_equal(found, CameraDetections(STAMP_NS, "front", boxes, np.array([0.75, 0.5]), labels))


@each_stack
def test_no_boxes(stack):
    for detections in ([], [{"bbox": box_2d(stack, 100.0, 50.0, 20.0, 40.0)}]):  # the second is of no class
        found = decode(stack, ARRAY_2D, {"header": header(STAMP_NS, "front"), "detections": detections})
        assert_equal(found, CameraDetections(STAMP_NS, "front", np.zeros((0, 4)), np.zeros(0), ()))


@pytest.mark.parametrize(
    ("theta", "half"), [(math.pi / 2, (20, 10)), (-math.pi / 2, (20, 10)), (math.pi, (10, 20)), (math.pi / 4, (15, 15))]
)
def test_a_rotated_box_becomes_the_box_around_it(theta, half):
    half_x, half_y = half if theta != math.pi / 4 else (30 / math.sqrt(2),) * 2
    values = two_boxes(ROS2, bbox=box_2d(ROS2, 100.0, 50.0, 20.0, 40.0, theta))
    found = decode(ROS2, ARRAY_2D, values)
    expected = [100 - half_x, 50 - half_y, 100 + half_x, 50 + half_y]
    np.testing.assert_allclose(found.boxes_px[1], expected)
    np.testing.assert_array_equal(found.boxes_px[0], [90, 30, 110, 70])


@pytest.mark.parametrize(
    ("path", "value", "error"),
    [
        ("header", header(0, "front"), r"Detection2DArray has no stamp \(header.stamp 0 s 0 ns\)"),
        ("header", header(-5 * 10**9, "front"), "has no stamp"),
        ("detections.1.bbox.size_x", -1.0, "Detection2DArray.bbox has a negative size"),
        ("detections.1.bbox.size_y", math.nan, "Detection2DArray.bbox holds NaN or infinity"),
        ("detections.1.bbox.center.theta", math.inf, "Detection2DArray.bbox holds NaN or infinity"),
        ("detections.1.bbox.center.position.x", 1e12, r"Detection2DArray.bbox holds 1e\+12, more than 1e\+09"),
        ("detections.0.results.0.hypothesis.score", 1.5, "Detection2DArray.results.score is 1.5, outside 0 to 1"),
        ("detections.0.results.0.hypothesis.score", -0.5, "score is -0.5"),
        ("detections.0.results.0.hypothesis.score", math.nan, "score is nan"),
    ],
)
def test_boxes_that_make_no_sense(path, value, error):
    with pytest.raises(CodecError, match=error):
        decode(ROS2, ARRAY_2D, edited(two_boxes(ROS2), path, value))


@each_stack
def test_clusters_of_all_layouts(stack):
    found = decode(stack, ARRAY_3D, two_boxes_3d(stack))
    centroids, sizes = np.array([[8.0, 1.0, -0.5], [20.0, -4.0, 0.0]]), np.array([[0.5, 0.6, 1.7], [2.0, 4.0, 1.5]])
    assert_equal(found, LidarClusters(STAMP_NS, "lidar", centroids, sizes, expected_points(centroids, sizes)))
    assert found.points.dtype == np.int64
    empty = decode(stack, ARRAY_3D, {"header": header(STAMP_NS, "lidar")})
    assert [empty.centroids_m.shape, empty.sizes_m.shape, empty.points.shape] == [(0, 3), (0, 3), (0,)]


def test_expected_points_worked_by_hand():
    """A face of 0.5 m by 2 m at 10 m is 0.05 by 0.2 rad: 14.3 columns of 0.2 degrees, 5.73 rows of 2 degrees."""
    centroids = np.array([[6.0, 8.0, 0.0], [100.0, 0, 0], [0.0, 0, 0]])
    sizes = np.array([[0.3, 0.4, 2.0], [0.1, 0.1, 0.1], [0, 0, 0]])
    assert expected_points(centroids, sizes).tolist() == [82, 1, 1]
    assert expected_points(np.zeros((0, 3)), np.zeros((0, 3))).tolist() == []


@pytest.mark.parametrize("version", [1, 2])
def test_the_cloud_that_old_layouts_carry_is_counted(version):
    stack = STACKS[version]
    found = decode(stack, ARRAY_3D, two_boxes_3d(stack, source_cloud={"height": 2, "width": 21}))
    assert found.points.tolist() == [decode(stack, ARRAY_3D, two_boxes_3d(stack)).points[0], 42]


@pytest.mark.parametrize(
    ("turn", "sizes"),
    [
        (QUARTER_TURN, (4.0, 2.0, 1.5)),
        (HALF_TURN, (2.0, 4.0, 1.5)),
        ((math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)), (2.0, 1.5, 4.0)),  # onto its side
        ((0.0, 0.0, math.sin(math.pi / 8), math.cos(math.pi / 8)), (3 * math.sqrt(2), 3 * math.sqrt(2), 1.5)),
        ((0.0, 0.0, 0.0, 0.0), (2.0, 4.0, 1.5)),  # left out
    ],
)
def test_a_rotated_cluster_becomes_the_box_around_it(turn, sizes):
    values = two_boxes_3d(ROS2, bbox=box_3d((20.0, -4.0, 0.0), (2.0, 4.0, 1.5), turn))
    found = decode(ROS2, ARRAY_3D, values)
    np.testing.assert_allclose(found.sizes_m[1], sizes, atol=1e-12)
    np.testing.assert_array_equal(found.sizes_m[0], [0.5, 0.6, 1.7])
    np.testing.assert_array_equal(found.centroids_m[1], [20, -4, 0])


@pytest.mark.parametrize(
    ("path", "value", "error"),
    [
        ("header", header(0, "lidar"), "Detection3DArray has no stamp"),
        ("detections.1.bbox.size.z", -0.1, "Detection3DArray.bbox has a negative size"),
        ("detections.0.bbox.center.position.x", math.nan, "Detection3DArray.bbox holds NaN or infinity"),
        (
            "detections.1.bbox.center.orientation.w",
            0.5,
            r"orientation \[0.0, 0.0, 0.0, 0.5\] has length 0.5 instead of 1",
        ),
    ],
)
def test_clusters_that_make_no_sense(path, value, error):
    with pytest.raises(CodecError, match=error):
        decode(ROS2, ARRAY_3D, edited(two_boxes_3d(ROS2), path, value))


@pytest.mark.parametrize("version", [2, 3, 4])
def test_tracks_of_a_detection_array(version):
    stack, key = STACKS[version], "tracking_id" if version == 2 else "id"
    values = edited(two_boxes_3d(stack, results=[result(stack, "car", 0.9)], **{key: "b"}), f"detections.0.{key}", "a7")
    found = decode(stack, ARRAY_3D, values, which=1)
    nan = np.full((2, 4, 4), np.nan)
    expected = ObjectTracks(
        STAMP_NS, "lidar", ("a7", "b"), ("person", "car"), np.array([[8, 1, -0.5], [20, -4, 0]]), nan[:, 0, :3], nan,
        np.array([0.5, 0.9]),
    )  # fmt: skip
    assert_equal(found, expected)


def test_what_has_no_id_is_no_track_and_what_has_no_class_has_no_label():
    values = edited(two_boxes_3d(ROS2, id="b"), "detections.0.id", "")
    found = decode(ROS2, ARRAY_3D, values, which=1)
    assert (found.ids, found.labels, found.existence.tolist()) == (("b",), ("",), [1.0])
    values = edited(two_boxes_3d(ROS2), "detections.0.id", "a")
    assert decode(ROS2, ARRAY_3D, values, which=1).ids == ("a",)


@each_stack
def test_detections_without_ids_are_no_tracks(stack):
    with pytest.raises(CodecError, match="Detection3DArray has no ids: tracks need"):
        decode(stack, ARRAY_3D, two_boxes_3d(stack), which=1)
    assert decode(stack, ARRAY_3D, {"header": header(STAMP_NS, "lidar")}, which=1).ids == ()


def test_two_tracks_of_one_id():
    values = edited(two_boxes_3d(ROS2, results=[result(ROS2, "car", 0.9)], id="a"), "detections.0.id", "a")
    with pytest.raises(CodecError, match="two objects of the id 'a'"):
        decode(ROS2, ARRAY_3D, values, which=1)


# --- Autoware ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("package", ["autoware_perception_msgs", "autoware_auto_perception_msgs"])
def test_tracked_objects_turn_their_twist_into_the_frame(package):
    """Facing along y: 2 m/s ahead and 1 m/s to the left are 2 along y and 1 against x; so are their variances."""
    found = decode(ROS2, f"{package}/msg/TrackedObjects", tracked())
    assert (found.stamp_ns, found.frame_id, found.ids) == (STAMP_NS, "map", ("000102030405060708090a0b0c0d0e0f",))
    assert found.labels == ("pedestrian",)
    np.testing.assert_array_equal(found.positions_m, [[5, 6, 0.5]])
    np.testing.assert_allclose(found.velocities_mps, [[-1, 2, 0]], atol=1e-12)
    np.testing.assert_allclose(found.covariances, [np.diag([0.1, 0.2, 0.4, 0.3])], atol=1e-12)
    np.testing.assert_array_equal(found.existence, [0.75])


def test_covariances_turn_with_their_correlation():
    twist_cov = np.zeros((6, 6))
    twist_cov[:2, :2] = [[1.0, 0.5], [0.5, 2.0]]
    angle = 0.3
    turn = (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))
    found = decode(ROS2, TRACKED, tracked(turn, twist_cov=twist_cov))
    R = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    np.testing.assert_allclose(found.covariances[0, 2:, 2:], R @ twist_cov[:2, :2] @ R.T, atol=1e-12)
    np.testing.assert_allclose(found.velocities_mps[0, :2], R @ [2, 1])
    np.testing.assert_array_equal(found.covariances[0, :2, 2:], 0)


@pytest.mark.parametrize("left_out", ["pose_cov", "twist_cov"])
def test_a_covariance_of_zeros_was_left_out(left_out):
    assert np.isnan(decode(ROS2, TRACKED, tracked(**{left_out: np.zeros((6, 6))})).covariances).all()


def test_objects_without_orientation_or_class():
    values = edited(tracked(turn=(0, 0, 0, 0)), "objects.0.classification", [])
    found = decode(ROS2, TRACKED, values)
    np.testing.assert_array_equal(found.velocities_mps, [[2, 1, 0]])
    assert found.labels == ("unknown",)
    none = decode(ROS2, TRACKED, {"header": header(STAMP_NS, "map")})
    assert [none.positions_m.shape, none.velocities_mps.shape, none.covariances.shape] == [(0, 3), (0, 3), (0, 4, 4)]


@pytest.mark.parametrize(
    ("number", "name"),
    [(0, "unknown"), (1, "car"), (2, "truck"), (3, "bus"), (4, "trailer"), (5, "motorcycle"), (6, "bicycle"),
     (7, "pedestrian"), (8, "animal"), (9, "hazard"), (11, "under_drivable"), (200, "200")],
)  # fmt: skip
def test_autoware_classes_have_names(number, name):
    values = edited(tracked(), "objects.0.classification", [{"label": number, "probability": 1.0}])
    assert decode(ROS2, TRACKED, values).labels == (name,)


@pytest.mark.parametrize(
    ("path", "value", "error"),
    [
        ("header", header(0, "map"), "TrackedObjects has no stamp"),
        ("objects.0.existence_probability", 1.5, "existence_probability is 1.5, outside 0 to 1"),
        ("objects.0.kinematics.pose_with_covariance.covariance", -np.eye(6).ravel(), "negative variance"),
        ("objects.0.kinematics.twist_with_covariance.covariance", np.full(36, np.nan), "covariance holds NaN"),
        ("objects.0.kinematics.twist_with_covariance.twist.linear.x", math.inf, "twist.linear holds NaN or infinity"),
        ("objects.0.kinematics.pose_with_covariance.pose.position.y", math.nan, "pose.position holds NaN"),
        ("objects.0.kinematics.pose_with_covariance.pose.orientation.w", 3.0, "orientation .* has length"),
    ],
)
def test_tracked_objects_that_make_no_sense(path, value, error):
    with pytest.raises(CodecError, match=error):
        decode(ROS2, TRACKED, edited(tracked(), path, value))


def test_two_tracked_objects_of_one_id():
    values = tracked()
    with pytest.raises(CodecError, match="two objects of the id '000102"):
        decode(ROS2, TRACKED, {**values, "objects": values["objects"] * 2})


def test_clusters_with_their_points():
    points = np.array([[1, 2, 3], [3, 2, 0], [2, 5, 0]])
    objects = [{"feature": {"cluster": cloud(points)}}, {"feature": {"cluster": cloud(points[:0])}}]
    full = "tier4_perception_msgs/msg/DetectedObjectsWithFeature"
    found = decode(ROS2, full, {"header": header(STAMP_NS, "lidar"), "feature_objects": objects})
    expected = LidarClusters(STAMP_NS, "lidar", np.array([[2.0, 3.0, 1.0]]), np.array([[2.0, 3.0, 3.0]]), np.array([3]))
    assert_equal(found, expected)
    assert decode(ROS2, full, {"header": header(STAMP_NS, "lidar")}).centroids_m.shape == (0, 3)
