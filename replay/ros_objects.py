"""ROS messages of what a detector or tracker found -> message dataclasses: vision_msgs of all versions, Autoware."""

import math
from collections.abc import Sequence
from operator import itemgetter

import numpy as np

from replay.ros_fields import (
    HEADER,
    Form,
    checked,
    checked_rows,
    frame,
    pose,
    probabilities,
    quaternion,
    rotations,
    stamp,
    vector,
)
from replay.ros_reader import Values, Wanted
from replay.ros_sensors import CLOUD, cloud_points
from schemas.codec import CodecError
from schemas.messages import CameraDetections, FloatArray, IntArray, LidarClusters, ObjectTracks

# --- vision_msgs ---------------------------------------------------------------------------------------------------

# Up to 2.x class and score are in the result itself, the class a number in 1.x; later they are its `hypothesis`.
_RESULTS = ("results", ("hypothesis.class_id|hypothesis.id|id", "hypothesis.score|score"))
# 4.x has a `Pose2D` of its own, with a position in it.
_DETECTION_2D: Wanted = (
    _RESULTS, "bbox.center.x|bbox.center.position.x", "bbox.center.y|bbox.center.position.y", "bbox.center.theta",
    "bbox.size_x", "bbox.size_y",
)  # fmt: skip
_DETECTION_3D = (
    "source_cloud.height|", "source_cloud.width|",  # up to 2.x
    *vector("bbox.center.position"), *vector("bbox.size"), *quaternion("bbox.center.orientation"),
)  # fmt: skip
_TRACK_3D: Wanted = ("id|tracking_id|", _RESULTS, *vector("bbox.center.position"))


_NO_CLASS: list[Values] = [("", 1.0)]  # a LiDAR's tracker may not tell people from others, but says they are there


def _detections(name: str, sec: int, nanosec: int, frame_id: str, found: list[Values]) -> CameraDetections:
    """Makes boxes of a Detection2DArray. A box without any class is left out; a rotated one gets the box around it."""
    stamp_ns = stamp(sec, nanosec, name)
    found = [row for row in found if row[0]]
    labels, scores = _best([row[0] for row in found], name)
    box = checked_rows(found, slice(1, 6), f"{name}.bbox")
    half = box[:, 3:] / 2
    if (half < 0).any():
        raise CodecError(f"{name}.bbox has a negative size")
    if any(row[3] for row in found):
        c, s = np.abs(np.cos(box[:, 2:3])), np.abs(np.sin(box[:, 2:3]))
        half = c * half + s * half[:, ::-1]
    boxes = np.concatenate([box[:, :2] - half, box[:, :2] + half], axis=1)
    return CameraDetections(stamp_ns, frame(frame_id), boxes, scores, labels)


def _clusters(name: str, sec: int, nanosec: int, frame_id: str, found: list[Values]) -> LidarClusters:
    """Makes clusters of a Detection3DArray, whatever their class; a rotated box becomes the box around it."""
    stamp_ns = stamp(sec, nanosec, name)
    boxes = checked_rows(found, slice(2, 12), f"{name}.bbox")
    if boxes[:, 3:6].min(initial=0) < 0:
        raise CodecError(f"{name}.bbox has a negative size")
    R = rotations(boxes[:, 6:], f"{name}.bbox.center.orientation")
    centroids, sizes = boxes[:, :3], _hull(R, boxes[:, 3:6])
    logged = np.array([(row[0] or 0) * (row[1] or 0) for row in found], np.int64)
    points = np.where(logged > 0, logged, expected_points(centroids, sizes))
    return LidarClusters(stamp_ns, frame(frame_id), centroids, sizes, points)


def _tracks_3d(name: str, sec: int, nanosec: int, frame_id: str, found: list[Values]) -> ObjectTracks:
    """Makes tracks of a Detection3DArray with ids. Boxes without an id are left out; without a class, it is ""."""
    stamp_ns = stamp(sec, nanosec, name)
    tracked = [row for row in found if row[0]]
    if found and not tracked:
        raise CodecError(f"{name} has no ids: tracks need the detections' `id`, in vision_msgs 2.x `tracking_id`")
    ids = _unique([row[0] for row in tracked], name)
    labels, scores = _best([row[1] or _NO_CLASS for row in tracked], name)
    positions = checked_rows(tracked, slice(2, 5), f"{name}.bbox.center.position")
    velocities, covs = np.full((len(ids), 3), np.nan), np.full((len(ids), 4, 4), np.nan)
    return ObjectTracks(stamp_ns, frame(frame_id), ids, labels, positions, velocities, covs, scores)


# A stand-in for what vision_msgs does not say: beams per square radian of a LiDAR of 16 rings, 2 degrees apart, that
# fires every 0.2 degrees, as on the campus vehicle.
_BEAMS_PER_RAD2 = 1 / (math.radians(2.0) * math.radians(0.2))


def expected_points(centroids_m: FloatArray, sizes_m: FloatArray) -> IntArray:
    """Returns how many points (M,) a LiDAR of 16 rings would have on objects of a place and size, at least one.

    Fusion needs the number for its noise, which falls with the number's root, and to tell poles (thin, though well
    seen) from people. A denser LiDAR has more points, so that its noise is overestimated.
    """
    squared = np.maximum((centroids_m * centroids_m).sum(axis=1), 1.0)
    face_m2 = np.hypot(sizes_m[:, 0], sizes_m[:, 1]) * sizes_m[:, 2]
    points: IntArray = np.maximum(face_m2 / squared * _BEAMS_PER_RAD2, 1).astype(np.int64)
    return points


def _best(results: Sequence[list[Values]], name: str) -> tuple[tuple[str, ...], FloatArray]:
    """Returns the most probable class of each object, every one of which has some, and its score."""
    scores = probabilities([score for classes in results for _, score in classes], f"{name}.results.score")
    best = [max(classes, key=itemgetter(1)) if len(classes) > 1 else classes[0] for classes in results]
    if len(scores) > len(best):
        scores = np.array([score for _, score in best])
    return tuple([str(label) for label, _ in best]), scores


def _hull(R: FloatArray, sizes_m: FloatArray) -> FloatArray:
    """Returns the sizes (M, 3) of axis-aligned boxes around boxes that are rotated by R (M, 3, 3)."""
    hull: FloatArray = (np.abs(R) * sizes_m[:, None, :]).sum(axis=2)
    return hull


def _unique(ids: Sequence[str], name: str) -> tuple[str, ...]:
    if len(set(ids)) < len(ids):
        twice = next(id for id in ids if ids.count(id) > 1)
        raise CodecError(f"{name} has two objects of the id {twice!r}")
    return tuple(ids)


# --- Autoware ------------------------------------------------------------------------------------------------------

# ObjectClassification's constants: the first eight in autoware_auto_perception_msgs, all in autoware_perception_msgs.
_AUTOWARE_LABELS = (
    "unknown", "car", "truck", "bus", "trailer", "motorcycle", "bicycle", "pedestrian", "animal", "hazard",
    "over_drivable", "under_drivable",
)  # fmt: skip
_POSE, _TWIST = "kinematics.pose_with_covariance", "kinematics.twist_with_covariance"
_TRACKED_OBJECT: Wanted = (
    "object_id.uuid", "existence_probability", ("classification", ("label", "probability")), f"{_POSE}.covariance",
    f"{_TWIST}.covariance", *pose(f"{_POSE}.pose"), *vector(f"{_TWIST}.twist.linear"),
)  # fmt: skip
_FEATURE: Wanted = tuple(
    f"feature.cluster.{item}" if isinstance(item, str) else (f"feature.cluster.{item[0]}", item[1]) for item in CLOUD
)


def _tracked_objects(name: str, sec: int, nanosec: int, frame_id: str, found: list[Values]) -> ObjectTracks:
    """Makes tracks of Autoware's TrackedObjects, whose twist is along each object's own axes."""
    stamp_ns = stamp(sec, nanosec, name)
    positions = checked_rows(found, slice(5, 8), f"{name}.{_POSE}.pose.position")
    orientation = f"{name}.{_POSE}.pose.orientation"
    R = rotations(checked_rows(found, slice(8, 12), orientation), orientation)  # (A, 3, 3)
    twists = checked_rows(found, slice(12, 15), f"{name}.{_TWIST}.twist.linear")
    covs = np.zeros((len(found), 4, 4))
    covs[:, :2, :2] = _covariances(found, 3, f"{name}.{_POSE}")[:, :2, :2]
    covs[:, 2:, 2:] = (R @ _covariances(found, 4, f"{name}.{_TWIST}") @ R.transpose(0, 2, 1))[:, :2, :2]
    variances = covs.diagonal(axis1=1, axis2=2)
    if (variances < 0).any():
        raise CodecError(f"{name} has a negative variance")
    covs[(variances == 0).any(axis=1)] = np.nan  # nothing is known that exactly: it was left out
    return ObjectTracks(
        stamp_ns,
        frame(frame_id),
        _unique([row[0].hex() for row in found], name),
        tuple(_autoware_label(row[2]) for row in found),
        positions,
        (R @ twists[:, :, None])[:, :, 0],
        covs,
        probabilities([row[1] for row in found], f"{name}.existence_probability"),
    )


def _covariances(found: list[Values], column: int, name: str) -> FloatArray:
    """Returns the covariances (A, 3, 3) of x, y, z out of ROS's 6 x 6 ones."""
    return checked([row[column] for row in found], f"{name}.covariance").reshape(-1, 6, 6)[:, :3, :3]


def _autoware_label(classes: list[Values]) -> str:
    label = max(classes, key=itemgetter(1))[0] if classes else 0
    return _AUTOWARE_LABELS[label] if label < len(_AUTOWARE_LABELS) else str(label)


def _feature_clusters(name: str, sec: int, nanosec: int, frame_id: str, found: list[Values]) -> LidarClusters:
    """Makes clusters of tier4's DetectedObjectsWithFeature, which carry points; those that have none are left out."""
    stamp_ns = stamp(sec, nanosec, name)
    clouds = [points for row in found if len(points := cloud_points(f"{name}.feature.cluster", *row))]
    centroids = np.array([points.mean(axis=0) for points in clouds]).reshape(-1, 3)
    sizes = np.array([np.ptp(points, axis=0) for points in clouds]).reshape(-1, 3)
    return LidarClusters(stamp_ns, frame(frame_id), centroids, sizes, np.array(list(map(len, clouds)), np.int64))


# -------------------------------------------------------------------------------------------------------------------

_TRACKED_OBJECTS = Form("ObjectTracks", (*HEADER, ("objects", _TRACKED_OBJECT)), _tracked_objects)

FORMS: dict[str, tuple[Form, ...]] = {
    "vision_msgs/msg/Detection2DArray": (
        Form("CameraDetections", (*HEADER, ("detections", _DETECTION_2D)), _detections),
    ),
    "vision_msgs/msg/Detection3DArray": (
        Form("LidarClusters", (*HEADER, ("detections", _DETECTION_3D)), _clusters),
        Form("ObjectTracks", (*HEADER, ("detections", _TRACK_3D)), _tracks_3d),
    ),
    "autoware_perception_msgs/msg/TrackedObjects": (_TRACKED_OBJECTS,),
    "autoware_auto_perception_msgs/msg/TrackedObjects": (_TRACKED_OBJECTS,),
    "tier4_perception_msgs/msg/DetectedObjectsWithFeature": (
        Form("LidarClusters", (*HEADER, ("feature_objects", _FEATURE)), _feature_clusters),
    ),
}
