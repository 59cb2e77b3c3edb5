"""ROS messages of cameras, poses and points -> message dataclasses: sensor_msgs, nav_msgs, geometry_msgs, tf."""

from typing import Any

import numpy as np

from replay.lens_models import lens
from replay.point_fields import points_from_fields
from replay.ros_fields import HEADER, Form, checked, frame, pose, quaternion, stamp, vector
from replay.ros_reader import Values, Wanted
from schemas.codec import CodecError, unit_quaternion
from schemas.messages import CameraCalibration, CompressedImage, FloatArray, PointCloud, Transform, VehiclePose

# --- cameras -------------------------------------------------------------------------------------------------------

_CAMERA_INFO = (
    *HEADER, "width", "height", "distortion_model", "d|D", "k|K", "binning_x", "binning_y", "roi.x_offset",
    "roi.y_offset",
)  # fmt: skip


def _calibration(
    name: str,
    sec: int,
    nanosec: int,
    frame_id: str,
    width: int,
    height: int,
    model: str,
    distortion: FloatArray,
    K: FloatArray,
    binning_x: int,
    binning_y: int,
    x_offset: int,
    y_offset: int,
) -> CameraCalibration:
    stamp_ns = stamp(sec, nanosec, name)
    if width == 0 or height == 0:
        raise CodecError(f"{name} has no image size ({width} x {height})")
    intrinsics = checked(K, f"{name}.k").reshape(3, 3)
    if not intrinsics.any():
        raise CodecError(f"{name}.k is all zeros: the camera is not calibrated")
    if max(binning_x, binning_y) > 1 or x_offset or y_offset:
        raise CodecError(
            f"{name} is of binned or cropped images, not whole ones "
            f"(binning {binning_x} x {binning_y}, roi at {x_offset}, {y_offset})"
        )
    lens_model = lens(model, checked(distortion, f"{name}.d"))
    return CameraCalibration(stamp_ns, frame(frame_id), width, height, *lens_model, intrinsics)


def _image(name: str, sec: int, nanosec: int, frame_id: str, format: str, data: bytes) -> CompressedImage:
    """Makes a picture; `format` is what image_transport's plug-ins write: "bgr8; jpeg compressed bgr8"."""
    stamp_ns = stamp(sec, nanosec, name)
    if not data:
        raise CodecError(f"{name} has no data")
    words = format.lower().replace(";", " ").split()
    if "compresseddepth" in words:
        raise CodecError(f"{name}.format is {format!r}: depths, not a picture")
    known = ["jpeg" if word == "jpg" else word for word in words if word in ("jpeg", "jpg", "png", "webp")]
    return CompressedImage(stamp_ns, frame(frame_id), data, known[0] if known else format)


# --- poses ---------------------------------------------------------------------------------------------------------


def _odometry(name: str, sec: int, nanosec: int, frame_id: str, child: str, *numbers: float) -> VehiclePose:
    stamp_ns, values = stamp(sec, nanosec, name), checked(numbers, name)
    rotation = unit_quaternion(values[3:7])
    return VehiclePose(stamp_ns, frame(frame_id), frame(child), values[:3], rotation, values[7:10], values[10:])


def _pose(name: str, sec: int, nanosec: int, frame_id: str, *numbers: float) -> VehiclePose:
    """Makes a pose that names no child frame (left empty) and has no twist (NaN: unknown, which zero would not say)."""
    stamp_ns, values = stamp(sec, nanosec, name), checked(numbers, f"{name}.pose")
    unknown = np.full(3, np.nan)
    return VehiclePose(stamp_ns, frame(frame_id), "", values[:3], unit_quaternion(values[3:]), unknown, unknown)


_TRANSFORM = (*HEADER, "child_frame_id", *vector("transform.translation"), *quaternion("transform.rotation"))


def _transforms(name: str, found: list[Values]) -> tuple[Transform, ...]:
    return tuple(_transform(name, *row) for row in found)


def _transform(name: str, sec: int, nanosec: int, parent: str, child: str, *numbers: float) -> Transform:
    parent, child = frame(parent), frame(child)
    if not parent or not child:
        raise CodecError(f"{name} from {parent!r} to {child!r} lacks a frame name")
    values = checked(numbers, f"{name}.transforms")
    stamp_ns = stamp(sec, nanosec, name, required=False)
    return Transform(stamp_ns, parent, child, values[:3], unit_quaternion(values[3:]))


# --- points --------------------------------------------------------------------------------------------------------

_POINT_FIELD_TYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")  # by their numbers in PointField
CLOUD: Wanted = (
    "height", "width", ("fields", ("name", "offset", "datatype")), "is_bigendian", "point_step", "row_step", "data",
)  # fmt: skip


def _point_cloud(name: str, sec: int, nanosec: int, frame_id: str, *cloud: Any) -> PointCloud:
    return PointCloud(stamp(sec, nanosec, name), frame(frame_id), cloud_points(name, *cloud))


def cloud_points(
    name: str,
    height: int,
    width: int,
    fields: list[Values],
    is_bigendian: bool,
    point_step: int,
    row_step: int,
    data: bytes,
) -> FloatArray:
    """Returns a PointCloud2's points (N, 3) from its fields in the order of `CLOUD`.

    `row_step` counts if the data are as long as it says: some drivers leave it 0.
    """
    order = ">" if is_bigendian else "<"
    types = dict(enumerate(_POINT_FIELD_TYPES))
    layout = {field: (offset, order + types.get(number, f"number {number}")) for field, offset, number in fields}
    step = row_step if len(data) == height * row_step else None
    return points_from_fields(data, height * width, point_step, layout, rows=max(height, 1), row_step=step, name=name)


# -------------------------------------------------------------------------------------------------------------------

_TF_MESSAGE = Form("Transform", (("transforms", _TRANSFORM),), _transforms)
_TWIST = (*vector("twist.twist.linear"), *vector("twist.twist.angular"))

FORMS: dict[str, tuple[Form, ...]] = {
    "sensor_msgs/msg/CameraInfo": (Form("CameraCalibration", _CAMERA_INFO, _calibration),),
    "sensor_msgs/msg/CompressedImage": (Form("CompressedImage", (*HEADER, "format", "data"), _image),),
    "sensor_msgs/msg/PointCloud2": (Form("PointCloud", (*HEADER, *CLOUD), _point_cloud),),
    "nav_msgs/msg/Odometry": (
        Form("VehiclePose", (*HEADER, "child_frame_id", *pose("pose.pose"), *_TWIST), _odometry),
    ),
    "geometry_msgs/msg/PoseStamped": (Form("VehiclePose", (*HEADER, *pose("pose")), _pose),),
    "geometry_msgs/msg/PoseWithCovarianceStamped": (Form("VehiclePose", (*HEADER, *pose("pose.pose")), _pose),),
    "tf2_msgs/msg/TFMessage": (_TF_MESSAGE,),
    "tf/msg/tfMessage": (_TF_MESSAGE,),
}
