"""The one table of topics: what is read, what is written, and under which zenoh key.

A topic's zenoh key is its name without the leading slash (zenoh refuses one), under an optional namespace.
"""

from dataclasses import dataclass

CAMERAS = ("A0", "A1", "A2", "A3", "B0", "B1")


@dataclass(frozen=True)
class Topic:
    """A default topic name, the role it plays and the dataclass it carries."""

    name: str
    role: str
    message: str


INPUTS = (
    *(Topic(f"/gmsl/{camera}/detections", "camera", "CameraDetections") for camera in CAMERAS),
    *(Topic(f"/gmsl/{camera}/camera_info", "calibration", "CameraCalibration") for camera in CAMERAS),
    *(Topic(f"/gmsl/{camera}/image", "image", "CompressedImage") for camera in CAMERAS),
    Topic("/velodyne/front/clusters", "clusters", "LidarClusters"),
    Topic("/velodyne/front/points", "points", "PointCloud"),
    Topic("/vn100/odometry", "pose", "VehiclePose"),
    Topic("/tf", "transforms", "Transform"),
    Topic("/tf_static", "transforms", "Transform"),
    Topic("/simulation/ground_truth", "truth", "GroundTruthFrame"),
)

TRACKS = Topic("/pcgan/tracks", "tracks", "TrackFrame")
PREDICTIONS = Topic("/pcgan/predictions", "predictions", "PredictionFrame")
VEHICLE_POSE = Topic("/pcgan/vehicle_pose", "pose", "VehiclePose")
SCENE = Topic("/pcgan/scene", "drawing", "foxglove.SceneUpdate")
OUTPUTS = (TRACKS, VEHICLE_POSE, PREDICTIONS, SCENE)


def zenoh_key(topic: Topic, namespace: str = "") -> str:
    """Returns the zenoh key of a topic: "/pcgan/tracks" under "car7" is "car7/pcgan/tracks"."""
    return "/".join(part for part in (namespace.strip("/"), topic.name.lstrip("/")) if part)
