"""Message dataclasses <-> Foxglove's protobuf messages, for what `pcgan.v1` leaves to existing schemas.

Decoding checks what protobuf does not, as `schemas.codec` does for our own messages: whatever is wrong raises
`CodecError` naming the field. Foxglove stamps are `google.protobuf.Timestamp`; ours are integer nanoseconds.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf import (
    CameraCalibration_pb2,
    CompressedImage_pb2,
    FrameTransform_pb2,
    FrameTransforms_pb2,
    Odometry_pb2,
    PackedElementField_pb2,
    PointCloud_pb2,
    PoseInFrame_pb2,
)
from google.protobuf.message import DecodeError, Message

from replay.lens_models import lens
from replay.point_fields import points_from_fields
from schemas.codec import LARGEST, CodecError, unit_quaternion
from schemas.messages import CameraCalibration, CompressedImage, FloatArray, PointCloud, Transform, VehiclePose
from tracking import geometry

NS_PER_S = 1_000_000_000
_LAST_NS = 2**63 - 1  # what 64 bits hold; a sender's garbage may be more
# Foxglove's name for OpenCV's fisheye model; ROS, and our dataclasses, say equidistant.
_FOXGLOVE_MODELS = {"equidistant": "kannala_brandt"}
_Field = PackedElementField_pb2.PackedElementField
_DTYPES = {
    _Field.UINT8: "<u1",
    _Field.INT8: "<i1",
    _Field.UINT16: "<u2",
    _Field.INT16: "<i2",
    _Field.UINT32: "<u4",
    _Field.INT32: "<i4",
    _Field.FLOAT32: "<f4",
    _Field.FLOAT64: "<f8",
}  # little-endian always, as Foxglove says


def encode(message: object) -> bytes:
    """Returns the bytes of a message dataclass as Foxglove's protobuf; the same message always gives the same bytes.

    A Transform becomes a FrameTransform, a tuple or list of them FrameTransforms, a VehiclePose an Odometry (which
    keeps the twist). Raises TypeError for anything else.
    """
    return to_protobuf(message).SerializeToString(deterministic=True)


def to_protobuf(message: object) -> Message:
    """Returns Foxglove's protobuf of a message dataclass, chosen as in `encode`."""
    if isinstance(message, CameraCalibration):
        return _calibration(message)
    if isinstance(message, Transform):
        return _frame_transform(message)
    if isinstance(message, CompressedImage):
        return _image(message)
    if isinstance(message, VehiclePose):
        return _odometry(message)
    if isinstance(message, PointCloud):
        return _point_cloud(message)
    if isinstance(message, Sequence) and all(isinstance(item, Transform) for item in message):
        return FrameTransforms_pb2.FrameTransforms(transforms=map(_frame_transform, message))
    raise TypeError(f"{type(message).__name__} has no Foxglove protobuf here")


def pose_in_frame(pose: VehiclePose) -> Message:
    """Returns a pose as foxglove.PoseInFrame, which has neither a child frame nor a twist."""
    message = PoseInFrame_pb2.PoseInFrame(frame_id=pose.frame_id)
    message.timestamp.FromNanoseconds(pose.stamp_ns)
    _set_pose(message.pose, pose)
    return message


def decode(schema_name: str, data: bytes) -> Any:
    """Returns what a Foxglove message holds, checked, by the schema's full name (a key of `DECODERS`).

    CameraCalibration, CompressedImage, PointCloud and VehiclePose come as themselves; FrameTransform and
    FrameTransforms both as a tuple of Transform. Raises CodecError naming the field that is wrong, KeyError for
    another schema.
    """
    try:
        message = DECODERS[schema_name][0].FromString(data)
    except DecodeError as error:
        raise CodecError(f"not a {schema_name}: {error}") from error
    return from_protobuf(message)


def from_protobuf(message: Message) -> Any:
    """Returns what a Foxglove message holds, checked, as `decode` does."""
    return DECODERS[message.DESCRIPTOR.full_name][1](message)


# --- encoding ------------------------------------------------------------------------------------------------------


def _calibration(calibration: CameraCalibration) -> Message:
    K = np.asarray(calibration.intrinsics_px, float)
    message = CameraCalibration_pb2.CameraCalibration(
        frame_id=calibration.frame_id,
        width=calibration.width_px,
        height=calibration.height_px,
        distortion_model=_FOXGLOVE_MODELS.get(calibration.model, calibration.model),
        D=np.asarray(calibration.distortion, float).tolist(),
        K=K.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.hstack([K, np.zeros((3, 1))]).ravel().tolist(),
    )
    message.timestamp.FromNanoseconds(calibration.stamp_ns)
    return message


def _frame_transform(transform: Transform) -> FrameTransform_pb2.FrameTransform:
    message = FrameTransform_pb2.FrameTransform(
        parent_frame_id=transform.parent_frame_id, child_frame_id=transform.child_frame_id
    )
    message.timestamp.FromNanoseconds(transform.stamp_ns)
    _set_vector(message.translation, transform.translation_m)
    _set_quaternion(message.rotation, transform.quaternion_xyzw)
    return message


def _image(image: CompressedImage) -> Message:
    message = CompressedImage_pb2.CompressedImage(frame_id=image.frame_id, data=image.data, format=image.format)
    message.timestamp.FromNanoseconds(image.stamp_ns)
    return message


def _odometry(pose: VehiclePose) -> Message:
    message = Odometry_pb2.Odometry(frame_id=pose.frame_id, body_frame_id=pose.child_frame_id)
    message.timestamp.FromNanoseconds(pose.stamp_ns)
    _set_pose(message.pose, pose)
    _set_vector(message.linear_velocity, pose.velocity_mps)
    _set_vector(message.angular_velocity, pose.angular_velocity_radps)
    return message


def _point_cloud(cloud: PointCloud) -> Message:
    points = np.asarray(cloud.points_m, "<f4")
    message = PointCloud_pb2.PointCloud(
        frame_id=cloud.frame_id,
        point_stride=3 * points.itemsize,
        fields=[_Field(name=name, offset=4 * i, type=_Field.FLOAT32) for i, name in enumerate("xyz")],
        data=points.tobytes(),
    )
    message.timestamp.FromNanoseconds(cloud.stamp_ns)
    message.pose.orientation.w = 1.0
    return message


def _set_pose(message: Any, pose: VehiclePose) -> None:
    _set_vector(message.position, pose.position_m)
    _set_quaternion(message.orientation, pose.quaternion_xyzw)


def _set_vector(message: Any, xyz: FloatArray) -> None:
    message.x, message.y, message.z = map(float, xyz)


def _set_quaternion(message: Any, xyzw: FloatArray) -> None:
    message.x, message.y, message.z, message.w = map(float, xyzw)


# --- decoding ------------------------------------------------------------------------------------------------------


def _decode_calibration(message: Any) -> CameraCalibration:
    name = "CameraCalibration"
    if message.width == 0 or message.height == 0:
        raise CodecError(f"{name} has no image size ({message.width} x {message.height})")
    if len(message.K) != 9:
        raise CodecError(f"{name}.K has {len(message.K)} entries instead of 9")
    return CameraCalibration(
        _stamp(message, name),
        message.frame_id,
        message.width,
        message.height,
        *lens(message.distortion_model, _finite(message.D, f"{name}.D")),
        _finite(message.K, f"{name}.K").reshape(3, 3),
    )


def _decode_transform(message: Any) -> Transform:
    name = "FrameTransform"
    if not message.parent_frame_id or not message.child_frame_id:
        raise CodecError(f"{name} from {message.parent_frame_id!r} to {message.child_frame_id!r} lacks a frame name")
    return Transform(
        _stamp(message, name, required=False),
        message.parent_frame_id,
        message.child_frame_id,
        _vector(message.translation, f"{name}.translation"),
        _quaternion(message.rotation, f"{name}.rotation"),
    )


def _decode_one_transform(message: Any) -> tuple[Transform, ...]:
    return (_decode_transform(message),)


def _decode_transforms(message: Any) -> tuple[Transform, ...]:
    return tuple(map(_decode_transform, message.transforms))


def _decode_image(message: Any) -> CompressedImage:
    if not message.data:
        raise CodecError("CompressedImage has no data")
    return CompressedImage(_stamp(message, "CompressedImage"), message.frame_id, message.data, message.format)


def _decode_odometry(message: Any) -> VehiclePose:
    name = "Odometry"
    return VehiclePose(
        _stamp(message, name),
        message.frame_id,
        message.body_frame_id,
        _vector(message.pose.position, f"{name}.position"),
        _quaternion(message.pose.orientation, f"{name}.orientation"),
        _twist(message, "linear_velocity"),
        _twist(message, "angular_velocity"),
    )


def _decode_pose_in_frame(message: Any) -> VehiclePose:
    """A PoseInFrame names no child frame (left empty) and has no twist (NaN: unknown, which zero would not say)."""
    name = "PoseInFrame"
    return VehiclePose(
        _stamp(message, name),
        message.frame_id,
        "",
        _vector(message.pose.position, f"{name}.position"),
        _quaternion(message.pose.orientation, f"{name}.orientation"),
        np.full(3, np.nan),
        np.full(3, np.nan),
    )


def _decode_point_cloud(message: Any) -> PointCloud:
    name = "PointCloud"
    stamp_ns, stride = _stamp(message, name), message.point_stride
    if stride == 0 or len(message.data) % stride:
        raise CodecError(f"{name}.data has {len(message.data)} bytes, no multiple of the point_stride {stride}")
    fields = {}
    for field in message.fields:
        if field.type in _DTYPES:
            fields[field.name] = (field.offset, _DTYPES[field.type])
        elif field.name in {"x", "y", "z"}:
            raise CodecError(f"{name}.fields {field.name} has the unknown type {field.type}")
    points = points_from_fields(message.data, len(message.data) // stride, stride, fields)
    return PointCloud(stamp_ns, message.frame_id, _moved_by_pose(points, message))


def _moved_by_pose(points: FloatArray, message: Any) -> FloatArray:
    """Returns a cloud's points in its frame_id: they are logged relative to its pose, which may be left out."""
    if not message.HasField("pose"):
        return points
    position = _vector(message.pose.position, "PointCloud.position")
    quaternion = _quaternion(message.pose.orientation, "PointCloud.orientation")
    if not position.any() and not quaternion[:3].any():
        return points
    return geometry.apply(geometry.transform_matrix(position, quaternion), points)


def _stamp(message: Any, name: str, required: bool = True) -> int:
    """Returns the stamp in ns; static transforms may have none, everything else must."""
    stamp: int = message.timestamp.seconds * NS_PER_S + message.timestamp.nanos
    if stamp < 0 or (required and stamp == 0):
        raise CodecError(f"{name} has no stamp (timestamp {stamp} ns)")
    if stamp > _LAST_NS:
        raise CodecError(f"{name} has a stamp past the year 2262 (timestamp {stamp} ns)")
    return stamp


def _finite(values: Iterable[float], name: str) -> FloatArray:
    numbers = list(values)
    if not all(map(math.isfinite, numbers)):
        raise CodecError(f"{name} holds NaN or infinity")
    if (largest := max(map(abs, numbers), default=0)) > LARGEST:
        raise CodecError(f"{name} holds {largest:.3g}, more than {LARGEST:g}")
    return np.array(numbers, float)


def _vector(message: Any, name: str) -> FloatArray:
    return _finite((message.x, message.y, message.z), name)


def _quaternion(message: Any, name: str) -> FloatArray:
    return unit_quaternion(_finite((message.x, message.y, message.z, message.w), name))


def _twist(message: Any, field: str) -> FloatArray:
    """Returns a velocity of an Odometry, NaN where the message leaves it out."""
    return _vector(getattr(message, field), f"Odometry.{field}") if message.HasField(field) else np.full(3, np.nan)


DECODERS: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "foxglove.CameraCalibration": (CameraCalibration_pb2.CameraCalibration, _decode_calibration),
    "foxglove.FrameTransform": (FrameTransform_pb2.FrameTransform, _decode_one_transform),
    "foxglove.FrameTransforms": (FrameTransforms_pb2.FrameTransforms, _decode_transforms),
    "foxglove.CompressedImage": (CompressedImage_pb2.CompressedImage, _decode_image),
    "foxglove.PointCloud": (PointCloud_pb2.PointCloud, _decode_point_cloud),
    "foxglove.PoseInFrame": (PoseInFrame_pb2.PoseInFrame, _decode_pose_in_frame),
    "foxglove.Odometry": (Odometry_pb2.Odometry, _decode_odometry),
}
MESSAGES = {
    "foxglove.CameraCalibration": "CameraCalibration",
    "foxglove.FrameTransform": "Transform",
    "foxglove.FrameTransforms": "Transform",
    "foxglove.CompressedImage": "CompressedImage",
    "foxglove.PointCloud": "PointCloud",
    "foxglove.PoseInFrame": "VehiclePose",
    "foxglove.Odometry": "VehiclePose",
}  # the dataclass that a message becomes
