"""Message dataclasses <-> protobuf bytes (`pcgan.v1`, schemas/pcgan_v1.proto).

Decoding checks what protobuf does not: that parallel arrays have one length, that numbers are finite, that sizes and
probabilities make sense. Whatever is wrong raises `CodecError` with the field's name; nothing is repaired in silence.
"""

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError, Message
from numpy.typing import ArrayLike, NDArray

from schemas import pcgan_v1_pb2 as pb
from schemas.messages import (
    CameraDetections,
    GroundTruthFrame,
    LidarClusters,
    Mixture,
    ModalPath,
    Prediction,
    PredictionFrame,
    Track,
    TrackFrame,
    TrackHistory,
    VehicleHistory,
    VehiclePose,
)

T = TypeVar("T")
PACKAGE = "pcgan.v1"


class CodecError(ValueError):
    """Bytes that are not the message they claim to be, or a message that makes no sense."""


def encode(message: object) -> bytes:
    """Returns the protobuf bytes of a message dataclass; the same message always gives the same bytes."""
    return to_protobuf(message).SerializeToString(deterministic=True)


def to_protobuf(message: object) -> Message:
    """Returns the `pcgan.v1` protobuf of a message dataclass; raises TypeError for any other object."""
    try:
        encoder = _ENCODERS[type(message)]
    except KeyError:
        raise TypeError(f"{type(message).__name__} has no pcgan.v1 protobuf") from None
    return encoder(message)


def decode(message_type: type[T], data: bytes) -> T:
    """Returns the message of the given type in `data`, checked; raises CodecError naming the field that is wrong."""
    protobuf_type, decoder = _DECODERS[message_type]
    try:
        message = protobuf_type.FromString(data)
    except DecodeError as error:
        raise CodecError(f"not a {PACKAGE}.{message_type.__name__}: {error}") from error
    decoded: T = decoder(message)
    return decoded


def schema_name(message_type: type) -> str:
    """Returns the full protobuf name of a message dataclass, e.g. pcgan.v1.TrackFrame."""
    name: str = _DECODERS[message_type][0].DESCRIPTOR.full_name
    return name


def protobuf_type(message_type: type) -> type[Message]:
    """Returns the generated class behind a message dataclass."""
    generated: type[Message] = _DECODERS[message_type][0]
    return generated


# --- packed arrays -------------------------------------------------------------------------------------------------

_FIELD = FieldDescriptor
_PACKED_DTYPES = {
    _FIELD.TYPE_DOUBLE: np.dtype("<f8"),
    _FIELD.TYPE_FLOAT: np.dtype("<f4"),
    _FIELD.TYPE_FIXED64: np.dtype("<u8"),
    _FIELD.TYPE_FIXED32: np.dtype("<u4"),
    _FIELD.TYPE_SFIXED64: np.dtype("<i8"),
    _FIELD.TYPE_BOOL: np.dtype("<u1"),
}
_LENGTH_DELIMITED = 2  # protobuf wire type


def _set_arrays(message: Message, **arrays: ArrayLike) -> None:
    """Fills packed repeated fields from arrays, flattened row-major.

    A packed field on the wire is a tag, a length and the little-endian numbers, so an array's own bytes are merged in.
    `extend(array.tolist())` gives the same bytes and is 100 times slower.
    """
    wire = bytearray()
    for name, values in arrays.items():
        field = message.DESCRIPTOR.fields_by_name[name]
        data = np.ascontiguousarray(np.asarray(values), _PACKED_DTYPES[field.type]).tobytes()
        if data:
            wire += _varint(field.number << 3 | _LENGTH_DELIMITED) + _varint(len(data)) + data
    message.MergeFromString(bytes(wire))


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _columns(message: Message, *names: str) -> NDArray[Any]:
    """Returns parallel packed fields as columns (N, len(names)); raises CodecError unless equally long and finite."""
    arrays = [np.array(getattr(message, name)) for name in names]
    lengths = {len(array) for array in arrays}
    if len(lengths) > 1:
        found = ", ".join(f"{name} {len(array)}" for name, array in zip(names, arrays, strict=True))
        raise CodecError(f"{message.DESCRIPTOR.name} arrays differ in length: {found}")
    columns = np.column_stack(arrays)
    if not np.isfinite(columns).all():
        bad = next(name for name, array in zip(names, arrays, strict=True) if not np.isfinite(array).all())
        raise CodecError(f"{message.DESCRIPTOR.name}.{bad} holds NaN or infinity")
    return columns


def _require(condition: bool, message: Message, problem: str) -> None:
    if not condition:
        raise CodecError(f"{message.DESCRIPTOR.name} {problem}")


def _check_scalars(message: Message, *names: str) -> None:
    for name in names:
        if not math.isfinite(getattr(message, name)):
            raise CodecError(f"{message.DESCRIPTOR.name}.{name} is not finite")


def _check_stamp(message: Message) -> None:
    _require(message.stamp_ns > 0, message, f"has no stamp (stamp_ns {message.stamp_ns})")  # type: ignore[attr-defined]


# --- sensors -------------------------------------------------------------------------------------------------------


def _encode_detections(detections: CameraDetections) -> Message:
    message = pb.CameraDetections(stamp_ns=detections.stamp_ns, frame_id=detections.frame_id, label=detections.labels)
    x_min, y_min, x_max, y_max = detections.boxes_px.T
    _set_arrays(message, x_min=x_min, y_min=y_min, x_max=x_max, y_max=y_max, score=detections.scores)
    return message


def _decode_detections(message: pb.CameraDetections) -> CameraDetections:
    _check_stamp(message)
    columns = _columns(message, "x_min", "y_min", "x_max", "y_max", "score")
    boxes, scores = columns[:, :4].astype(float), columns[:, 4].astype(float)
    _require(len(message.label) == len(boxes), message, f"has {len(boxes)} boxes but {len(message.label)} labels")
    _require(bool((boxes[:, 2:] >= boxes[:, :2]).all()), message, "has a box of negative size")
    _require(bool(((scores >= 0) & (scores <= 1)).all()), message, "has a score outside 0 to 1")
    return CameraDetections(message.stamp_ns, message.frame_id, boxes, scores, tuple(message.label))


def _encode_clusters(clusters: LidarClusters) -> Message:
    message = pb.LidarClusters(stamp_ns=clusters.stamp_ns, frame_id=clusters.frame_id)
    x, y, z = clusters.centroids_m.T
    size_x, size_y, size_z = clusters.sizes_m.T
    _set_arrays(message, x=x, y=y, z=z, size_x=size_x, size_y=size_y, size_z=size_z, points=clusters.points)
    return message


def _decode_clusters(message: pb.LidarClusters) -> LidarClusters:
    _check_stamp(message)
    columns = _columns(message, "x", "y", "z", "size_x", "size_y", "size_z").astype(float)
    points = np.array(message.points, np.int64)
    _require(len(points) == len(columns), message, f"has {len(columns)} clusters but {len(points)} point counts")
    _require(bool((columns[:, 3:] >= 0).all()), message, "has a cluster of negative size")
    return LidarClusters(message.stamp_ns, message.frame_id, columns[:, :3], columns[:, 3:], points)


def _encode_pose(pose: VehiclePose) -> Message:
    x, y, z = map(float, pose.position_m)
    qx, qy, qz, qw = map(float, pose.quaternion_xyzw)
    vx, vy, vz = map(float, pose.velocity_mps)
    wx, wy, wz = map(float, pose.angular_velocity_radps)
    return pb.VehiclePose(
        stamp_ns=pose.stamp_ns, frame_id=pose.frame_id, child_frame_id=pose.child_frame_id,
        x=x, y=y, z=z, qx=qx, qy=qy, qz=qz, qw=qw, vx=vx, vy=vy, vz=vz, wx=wx, wy=wy, wz=wz,
    )  # fmt: skip


def _decode_pose(message: pb.VehiclePose) -> VehiclePose:
    _check_stamp(message)
    m = message
    _check_scalars(m, "x", "y", "z", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "wx", "wy", "wz")
    quaternion = unit_quaternion((m.qx, m.qy, m.qz, m.qw))
    position, velocity, rate = np.array([m.x, m.y, m.z]), np.array([m.vx, m.vy, m.vz]), np.array([m.wx, m.wy, m.wz])
    return VehiclePose(m.stamp_ns, m.frame_id, m.child_frame_id, position, quaternion, velocity, rate)


def unit_quaternion(xyzw: ArrayLike) -> NDArray[np.float64]:
    """Returns a logged quaternion (4,) at length 1; raises CodecError if it is not near that already."""
    quaternion = np.asarray(xyzw, float)
    norm = float(np.linalg.norm(quaternion))
    if not abs(norm - 1) < 0.05:
        raise CodecError(f"a rotation's quaternion {quaternion.tolist()} has length {norm:.3g} instead of 1")
    return quaternion / norm


def _encode_ground_truth(truth: GroundTruthFrame) -> Message:
    message = pb.GroundTruthFrame(stamp_ns=truth.stamp_ns, frame_id=truth.frame_id)
    (x, y), (vx, vy) = truth.positions_m.T, truth.velocities_mps.T
    _set_arrays(message, id=truth.ids, x=x, y=y, vx=vx, vy=vy, lidar_points=truth.lidar_points)
    return message


def _decode_ground_truth(message: pb.GroundTruthFrame) -> GroundTruthFrame:
    _check_stamp(message)
    columns = _columns(message, "x", "y", "vx", "vy")
    ids, points = np.array(message.id, np.int64), np.array(message.lidar_points, np.int64)
    _require(len(ids) == len(points) == len(columns), message, "arrays differ in length")
    return GroundTruthFrame(message.stamp_ns, message.frame_id, ids, columns[:, :2], columns[:, 2:], points)


# --- tracks --------------------------------------------------------------------------------------------------------


def _encode_track_frame(frame: TrackFrame) -> Message:
    message = pb.TrackFrame(
        sequence=frame.sequence,
        stamp_ns=frame.stamp_ns,
        frame_id=frame.frame_id,
        pose_extrapolated=frame.pose_extrapolated,
        epoch=frame.epoch,
    )
    vehicle = frame.vehicle_history
    x, y, yaw, vx, vy = vehicle.states.T
    _set_arrays(message.vehicle_history, stamp_ns=vehicle.stamps_ns, x=x, y=y, yaw=yaw, vx=vx, vy=vy)
    for track in frame.tracks:
        x, y, vx, vy = map(float, track.state)
        encoded = message.tracks.add(
            id=track.id, x=x, y=y, vx=vx, vy=vy, existence=track.existence, age_ns=track.age_ns, coasting=track.coasting
        )
        _set_arrays(encoded, covariance=track.covariance)
        history = track.history
        hx, hy, hvx, hvy = history.states.T
        _set_arrays(encoded.history, stamp_ns=history.stamps_ns, x=hx, y=hy, vx=hvx, vy=hvy, coasting=history.coasting)
    return message


def _decode_track_frame(message: pb.TrackFrame) -> TrackFrame:
    _check_stamp(message)
    vehicle = message.vehicle_history
    states = _columns(vehicle, "x", "y", "yaw", "vx", "vy")
    history = VehicleHistory(_stamps(vehicle, len(states)), states)
    tracks = tuple(_decode_track(track) for track in message.tracks)
    _require(len({track.id for track in tracks}) == len(tracks), message, "has two tracks of one id")
    return TrackFrame(
        message.sequence, message.stamp_ns, message.frame_id, history, tracks, message.pose_extrapolated, message.epoch
    )


def _decode_track(message: pb.Track) -> Track:
    _check_scalars(message, "x", "y", "vx", "vy", "existence")
    _require(0 <= message.existence <= 1, message, f"existence {message.existence} is outside 0 to 1")
    covariance = _columns(message, "covariance")
    _require(len(covariance) == 16, message, f"covariance has {len(covariance)} entries instead of 16")
    states = _columns(message.history, "x", "y", "vx", "vy")
    coasting = np.array(message.history.coasting, bool)
    _require(len(coasting) == len(states), message.history, "arrays differ in length")
    return Track(
        message.id,
        np.array([message.x, message.y, message.vx, message.vy]),
        covariance.reshape(4, 4),
        message.existence,
        message.age_ns,
        message.coasting,
        TrackHistory(_stamps(message.history, len(states)), states, coasting),
    )


def _stamps(history: Message, count: int) -> NDArray[np.int64]:
    stamps = np.array(history.stamp_ns, np.int64)  # type: ignore[attr-defined]
    _require(len(stamps) == count, history, f"has {count} states but {len(stamps)} stamps")
    _require(bool((np.diff(stamps) > 0).all()), history, "stamps do not rise")
    return stamps


# --- predictions ---------------------------------------------------------------------------------------------------


def _encode_prediction_frame(frame: PredictionFrame) -> Message:
    message = pb.PredictionFrame(
        sequence=frame.sequence, stamp_ns=frame.stamp_ns, frame_id=frame.frame_id, model=frame.model, dt_s=frame.dt_s
    )
    for prediction in frame.predictions:
        encoded = message.predictions.add(track_id=prediction.track_id, fallback=prediction.fallback)
        for path in prediction.paths:
            x, y = path.points_m.T
            _set_arrays(encoded.paths.add(probability=path.probability), x=x, y=y)
        mixture = prediction.mixture
        encoded.mixture.components = mixture.weights.shape[1]
        _set_arrays(
            encoded.mixture,
            weight=mixture.weights,
            x=mixture.means_m[..., 0],
            y=mixture.means_m[..., 1],
            sigma_x=mixture.sigmas_m[..., 0],
            sigma_y=mixture.sigmas_m[..., 1],
            rho=mixture.rhos,
        )
    return message


def _decode_prediction_frame(message: pb.PredictionFrame) -> PredictionFrame:
    _check_stamp(message)
    _require(message.dt_s > 0 and math.isfinite(message.dt_s), message, f"dt_s {message.dt_s} is not positive")
    predictions = tuple(_decode_prediction(prediction) for prediction in message.predictions)
    return PredictionFrame(
        message.sequence, message.stamp_ns, message.frame_id, message.model, message.dt_s, predictions
    )


def _decode_prediction(message: pb.Prediction) -> Prediction:
    _require(len(message.paths) > 0, message, "has no path")
    paths = []
    for path in message.paths:
        _require(0 <= path.probability <= 1, path, f"probability {path.probability} is outside 0 to 1")
        paths.append(ModalPath(path.probability, _columns(path, "x", "y")))
    steps = len(paths[0].points_m)
    mixture, K = message.mixture, message.mixture.components
    columns = _columns(mixture, "weight", "x", "y", "sigma_x", "sigma_y", "rho")
    _require(K > 0 and len(columns) == steps * K, mixture, f"has {len(columns)} components for {steps} steps of {K}")
    weights, x, y, sigma_x, sigma_y, rhos = columns.T.reshape(6, steps, K)
    _require(bool((sigma_x > 0).all() and (sigma_y > 0).all()), mixture, "has a sigma that is not positive")
    return Prediction(
        message.track_id,
        message.fallback,
        tuple(paths),
        Mixture(weights, np.stack([x, y], -1), np.stack([sigma_x, sigma_y], -1), rhos),
    )


_ENCODERS: dict[type, Callable[[Any], Message]] = {
    CameraDetections: _encode_detections,
    LidarClusters: _encode_clusters,
    VehiclePose: _encode_pose,
    TrackFrame: _encode_track_frame,
    PredictionFrame: _encode_prediction_frame,
    GroundTruthFrame: _encode_ground_truth,
}
_DECODERS: dict[type, tuple[Any, Callable[[Any], Any]]] = {
    CameraDetections: (pb.CameraDetections, _decode_detections),
    LidarClusters: (pb.LidarClusters, _decode_clusters),
    VehiclePose: (pb.VehiclePose, _decode_pose),
    TrackFrame: (pb.TrackFrame, _decode_track_frame),
    PredictionFrame: (pb.PredictionFrame, _decode_prediction_frame),
    GroundTruthFrame: (pb.GroundTruthFrame, _decode_ground_truth),
}
MESSAGE_TYPES: dict[str, type] = {schema_name(message_type): message_type for message_type in _DECODERS}
