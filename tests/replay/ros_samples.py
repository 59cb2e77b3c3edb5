"""Sample messages for the tests of the ROS adapters, in every stack, and how they are written and compared."""

import math

import numpy as np
import pytest

from replay import ros
from schemas.messages import CameraCalibration, Transform, VehiclePose
from tests.replay import foreign_ros as foreign
from tests.replay.foreign_ros import Stack, box_2d, box_3d, header, result

STAMP_NS = 1_583_114_400_123_456_789
HALF_TURN = (0.0, 0.0, 1.0, 0.0)
QUARTER_TURN = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
_PERCEPTION = {
    "TrackedObjects": "std_msgs/Header header\nTrackedObject[] objects",
    "TrackedObject": (
        "unique_identifier_msgs/UUID object_id\nfloat32 existence_probability\nObjectClassification[] classification\n"
        "TrackedObjectKinematics kinematics\nShape shape"
    ),
    "ObjectClassification": "uint8 PEDESTRIAN=7\nuint8 label\nfloat32 probability",
    "TrackedObjectKinematics": (
        "geometry_msgs/PoseWithCovariance pose_with_covariance\n"
        "geometry_msgs/TwistWithCovariance twist_with_covariance\n"
        "geometry_msgs/AccelWithCovariance acceleration_with_covariance\n"
        "uint8 orientation_availability\nbool is_stationary"
    ),
    "Shape": "uint8 type\ngeometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions",
}
_AUTO = _PERCEPTION | {  # other constants, and another order
    "ObjectClassification": "uint8 label\nfloat32 probability",
    "TrackedObjectKinematics": (
        "geometry_msgs/PoseWithCovariance pose_with_covariance\nuint8 orientation_availability\n"
        "geometry_msgs/TwistWithCovariance twist_with_covariance\n"
        "geometry_msgs/AccelWithCovariance acceleration_with_covariance\nbool is_stationary"
    ),
}
AUTOWARE = {f"autoware_perception_msgs/msg/{name}": text for name, text in _PERCEPTION.items()} | {
    f"autoware_auto_perception_msgs/msg/{name}": text for name, text in _AUTO.items()
}
TIER4 = {
    "tier4_perception_msgs/msg/DetectedObjectsWithFeature": (
        "std_msgs/Header header\nDetectedObjectWithFeature[] feature_objects"
    ),
    "tier4_perception_msgs/msg/DetectedObjectWithFeature": (
        "autoware_perception_msgs/DetectedObject object\nFeature feature"
    ),
    "tier4_perception_msgs/msg/Feature": "sensor_msgs/PointCloud2 cluster\nsensor_msgs/RegionOfInterest roi",
    "autoware_perception_msgs/msg/DetectedObject": "float32 existence_probability",  # the rest is of no interest
}
STACKS = {version: Stack(version, AUTOWARE | TIER4 if version == 4 else None) for version in (1, 2, 3, 4)}
ROS1, ROS2 = STACKS[1], STACKS[4]
each_stack = pytest.mark.parametrize("stack", STACKS.values(), ids=lambda stack: f"vision_msgs {stack.vision_msgs}")
both_ros = pytest.mark.parametrize("stack", [ROS1, ROS2], ids=["ROS 1", "ROS 2"])


def decode(stack, full, values, which=0):
    """Decodes a message that rosbags wrote, after checking that the other writers' bytes say the same."""
    decoder = ros.decoders(stack.schema(full), stack.encoding)[which]
    serialised = [stack.rosbags_bytes(full, values), stack.other_bytes(full, values)]
    if stack.ros == 2:
        serialised.append(stack.rosbags_bytes(full, values, little_endian=False))
    found, *others = [decoder.decode(each) for each in serialised]
    for each in found if isinstance(found, tuple) else (found,):
        assert type(each).__name__ == decoder.message
    for other in others:
        assert_equal(other, found)
    return found


def assert_equal(found, expected):
    assert type(found) is type(expected)
    if isinstance(expected, tuple):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert_equal(one, other)
        return
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)


def edited(values, path, value):
    """Nested dicts and lists with the value at a path such as "detections.0.bbox.size_x" replaced."""
    name, _, rest = path.partition(".")
    key = int(name) if isinstance(values, list) else name
    new = edited(values[key], rest, value) if rest else value
    if isinstance(values, list):
        return [new if i == key else item for i, item in enumerate(values)]
    return {**values, key: new}


# --- messages -----------------------------------------------------------------------------------------------------

ARRAY_2D, ARRAY_3D = "vision_msgs/msg/Detection2DArray", "vision_msgs/msg/Detection3DArray"


def label(stack, name):
    return str(foreign.CLASS_IDS[name]) if stack.vision_msgs == 1 else name


def two_boxes(stack, **second):
    return {
        "header": header(STAMP_NS, "front"),
        "detections": [
            {
                "results": [result(stack, "car", 0.25), result(stack, "person", 0.75)],
                "bbox": box_2d(stack, 100.0, 50.0, 20.0, 40.0),
            },
            {"results": [result(stack, "car", 0.5)], "bbox": box_2d(stack, 10.5, 20.0, 1.0, 2.0), **second},
        ],
    }


def two_boxes_3d(stack, **second):
    return {
        "header": header(STAMP_NS, "lidar"),
        "detections": [
            {"bbox": box_3d((8.0, 1.0, -0.5), (0.5, 0.6, 1.7)), "results": [result(stack, "person", 0.5)]},
            {"bbox": box_3d((20.0, -4.0, 0.0), (2.0, 4.0, 1.5)), **second},
        ],
    }


TRACKED = "autoware_perception_msgs/msg/TrackedObjects"
UUID = bytes(range(16))


def tracked(turn=QUARTER_TURN, velocity=(2.0, 1.0, 0.0), pose_cov=None, twist_cov=None):
    pose_cov = np.diag([0.1, 0.2, 9, 9, 9, 9]) if pose_cov is None else pose_cov
    twist_cov = np.diag([0.3, 0.4, 9, 9, 9, 9]) if twist_cov is None else twist_cov
    place = {"position": foreign.vector((5, 6, 0.5)), "orientation": foreign.rotation(turn)}
    return {
        "header": header(STAMP_NS, "map"),
        "objects": [
            {
                "object_id": {"uuid": np.frombuffer(UUID, np.uint8)},
                "existence_probability": 0.75,
                "classification": [{"label": 6, "probability": 0.25}, {"label": 7, "probability": 0.5}],
                "kinematics": {
                    "pose_with_covariance": {"pose": place, "covariance": np.ravel(pose_cov)},
                    "twist_with_covariance": {
                        "twist": {"linear": foreign.vector(velocity)},
                        "covariance": np.ravel(twist_cov),
                    },
                },
            }
        ],
    }


CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
K = np.array([[1176.93, 0, 962.275], [0, 1177.72, 612.725], [0, 0, 1]])


def camera_info(stack, model="equidistant", distortion=(-0.05, -0.08, 0.1, -0.05), **changes):
    calibration = CameraCalibration(STAMP_NS, "front", 1920, 1208, model, np.array(distortion, float), K)
    return foreign.camera_info(stack, calibration) | changes


def pose(frame="odom", child="base_link"):
    return VehiclePose(
        STAMP_NS, frame, child, np.array([1.0, -2.0, 0.5]), np.array([0.0, 0.0, 0.6, 0.8]), np.array([3.0, 0.1, 0]),
        np.array([0, 0, 0.2]),
    )  # fmt: skip


def transforms():
    one = Transform(STAMP_NS, "base_link", "lidar", np.array([1.2, 0.0, 1.37]), np.array([0.0, 0.6, 0.0, 0.8]))
    other = Transform(0, "odom", "base_link", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))  # static: no stamp
    return one, other


CLOUD = "sensor_msgs/msg/PointCloud2"


def cloud(points, order="<", height=1, padding=0, **changes):
    """A cloud of x, y, z in float32 and a ring number, `padding` bytes behind each row."""
    record = np.dtype([("x", order + "f4"), ("ring", order + "u2"), ("y", order + "f4"), ("z", order + "f4")])
    packed = np.zeros(len(points), record)
    for axis, column in zip("xyz", np.reshape(points, (-1, 3)).T, strict=True):
        packed[axis] = column
    rows = [row.tobytes() + b"\xee" * padding for row in packed.reshape(height, -1)]
    types = {"x": 7, "y": 7, "z": 7, "ring": 4}
    return {
        "header": header(STAMP_NS, "/lidar"),
        "height": height,
        "width": len(points) // height,
        "fields": [
            {"name": name, "offset": record.fields[name][1], "datatype": types[name], "count": 1}
            for name in record.names
        ],
        "is_bigendian": order == ">",
        "point_step": record.itemsize,
        "row_step": len(rows[0]),
        "data": np.frombuffer(b"".join(rows), np.uint8),
        "is_dense": True,
    } | changes


POINTS = np.array([[4.0, -1.5, 0.25], [8.0, 2.5, -1.5], [1.0, 2.0, 3.0], [-1.0, -2.0, -3.0]])
