"""Message dataclasses <-> protobuf bytes (`pcgan.v1`, schemas/pcgan_v1.proto).

Decoding checks what protobuf does not: that parallel arrays have one length, that numbers are finite, that sizes and
probabilities make sense. Whatever is wrong raises `CodecError` with the field's name; nothing is repaired in silence.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import cache, lru_cache
from itertools import accumulate, islice
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

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
    NodeHealth,
    Prediction,
    PredictionFrame,
    Track,
    TrackFrame,
    TrackHistory,
    VehicleHistory,
    VehiclePath,
    VehiclePose,
)

T = TypeVar("T")
Descriptor = Any  # protobuf has one class of descriptors per backend
PACKAGE = "pcgan.v1"


class CodecError(ValueError):
    """Bytes that are not the message they claim to be, or a message that makes no sense."""


def encode(message: object) -> bytes:
    """Returns the protobuf bytes of a message dataclass; the same message always gives the same bytes."""
    data = _encoded.get(message) if type(message) in _SENT_TWICE else None
    if data is None:
        data = bytes(to_protobuf(message).SerializeToString(deterministic=True))
        _remember(message, data)
    return data


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
    message.DiscardUnknownFields()  # a newer sender's; they would stand between the fields read below
    decoded: T = decoder(message)
    _remember(decoded, data)
    return decoded


def schema_name(message_type: type) -> str:
    """Returns the full protobuf name of a message dataclass, e.g. pcgan.v1.TrackFrame."""
    name: str = _DECODERS[message_type][0].DESCRIPTOR.full_name
    return name


def protobuf_type(message_type: type) -> type[Message]:
    """Returns the generated class behind a message dataclass."""
    generated: type[Message] = _DECODERS[message_type][0]
    return generated


# A track frame goes to the predictor and to the log, its answer from the predictor to the log: both are encoded once.
_SENT_TWICE = (TrackFrame, PredictionFrame)
_encoded: WeakKeyDictionary[object, bytes] = WeakKeyDictionary()


def _remember(message: object, data: bytes) -> None:
    if type(message) in _SENT_TWICE:
        _encoded[message] = data


# --- packed arrays -------------------------------------------------------------------------------------------------

_FIELD = FieldDescriptor
_PACKED_DTYPES: dict[int, np.dtype[Any]] = {
    _FIELD.TYPE_DOUBLE: np.dtype("<f8"),
    _FIELD.TYPE_FLOAT: np.dtype("<f4"),
    _FIELD.TYPE_FIXED64: np.dtype("<u8"),
    _FIELD.TYPE_FIXED32: np.dtype("<u4"),
    _FIELD.TYPE_SFIXED64: np.dtype("<i8"),
    _FIELD.TYPE_BOOL: np.dtype("<u1"),
}
_FIXED64, _LENGTH_DELIMITED = 1, 2  # protobuf wire types


def _set_arrays(message: Message, **arrays: ArrayLike) -> None:
    """Fills packed repeated fields from arrays, flattened row-major.

    A packed field on the wire is a tag, a length and the little-endian numbers, so an array's own bytes are merged in.
    `extend(array.tolist())` gives the same bytes and is 100 times slower.
    """
    wire: list[bytes] = []
    for name, values in arrays.items():
        number, dtype = _number_and_dtype(message.DESCRIPTOR, name)
        data = np.asarray(values, dtype).tobytes()
        if data:
            wire += (_varint(number << 3 | _LENGTH_DELIMITED), _varint(len(data)), data)
    message.MergeFromString(b"".join(wire))


@cache
def _number_and_dtype(descriptor: Descriptor, name: str) -> tuple[int, np.dtype[Any]]:
    field = descriptor.fields_by_name[name]
    return field.number, _PACKED_DTYPES[field.type]


@lru_cache(maxsize=1024)
def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _columns(message: Message, *names: str) -> NDArray[np.float64]:
    """Returns a message's parallel repeated fields as columns (N, len(names)), for messages of a few objects.

    Raises CodecError unless they are equally long and finite.
    """
    fields = [getattr(message, name)[:] for name in names]
    if len(set(map(len, fields))) > 1:
        found = ", ".join(f"{name} {len(field)}" for name, field in zip(names, fields, strict=True))
        raise CodecError(f"{message.DESCRIPTOR.name} arrays differ in length: {found}")
    rows = np.array(fields, float)
    _check_finite(rows, message.DESCRIPTOR, names)
    return rows.T


# Nothing measured in metres, seconds or pixels is larger; what is would overflow somewhere downstream.
LARGEST = 1e9


def _check_finite(rows: NDArray[Any], descriptor: Descriptor, names: Sequence[str]) -> None:
    """Raises CodecError naming the first of the rows that holds NaN, infinity or an absurdly large number."""
    if rows.size == 0 or rows.dtype.kind != "f":
        return
    if not (rows.min() >= -LARGEST and rows.max() <= LARGEST):  # NaN fails every comparison
        for name, row in zip(names, rows, strict=True):
            if not np.isfinite(row).all():
                raise CodecError(f"{descriptor.name}.{name} holds NaN or infinity")
            if len(row) and np.abs(row).max() > LARGEST:
                raise CodecError(f"{descriptor.name}.{name} holds {np.abs(row).max():.3g}, more than {LARGEST:g}")


def _table(
    descriptor: Descriptor, wires: Sequence[dict[int, bytes]], names: Sequence[str]
) -> tuple[NDArray[Any], list[int]]:
    """Returns the parallel packed fields of several messages of one type, one behind the other, and their lengths.

    All at once, since a frame has hundreds of short arrays: (len(names), sum of lengths). Raises CodecError unless the
    arrays of each message are equally long and everything is finite.
    """
    rows, lengths = [], []
    for name in names:
        number, dtype = _number_and_dtype(descriptor, name)
        parts = [wire.get(number, b"") for wire in wires]
        rows.append(np.frombuffer(b"".join(parts), dtype))
        lengths.append([len(part) // dtype.itemsize for part in parts])
    for field_lengths in lengths[1:]:
        if field_lengths != lengths[0]:
            row = next(i for i, length in enumerate(field_lengths) if length != lengths[0][i])
            found = ", ".join(f"{name} {field[row]}" for name, field in zip(names, lengths, strict=True))
            raise CodecError(f"{descriptor.name} arrays differ in length: {found}")
    table = np.array(rows)
    _check_finite(table, descriptor, names)
    return table, lengths[0]


def _packed_fields(data: bytes) -> dict[int, bytes]:
    """Returns the bytes of a message's packed fields and singular sub-messages by field number.

    `data` is protobuf's own serialisation, in which each packed field stands once, whatever the sender wrote: reading
    it off is several times faster than converting repeated fields one by one. Tags have one byte, as all our field
    numbers are below 16.
    """
    fields = {}
    at, end = 0, len(data)
    while at < end:
        number, wire_type = data[at] >> 3, data[at] & 7
        at += 1
        if wire_type == _FIXED64:
            at += 8
            continue
        value = shift = 0
        while True:  # a varint: the value itself, or the length of what follows
            byte = data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                break
            shift += 7
        if wire_type == _LENGTH_DELIMITED:
            fields[number] = data[at : at + value]
            at += value
    return fields


def _split(array: NDArray[Any], lengths: Sequence[int]) -> list[NDArray[Any]]:
    """Cuts an array along its first axis into pieces of the given lengths."""
    ends = list(accumulate(lengths))
    return [array[end - length : end] for end, length in zip(ends, lengths, strict=True)]


def _require(condition: bool, message: Message, problem: str) -> None:
    if not condition:
        raise CodecError(f"{message.DESCRIPTOR.name} {problem}")


def _check_scalars(message: Message, *names: str) -> None:
    for name in names:
        value = getattr(message, name)
        if not -LARGEST <= value <= LARGEST:
            problem = f"is {value:.3g}, more than {LARGEST:g}" if math.isfinite(value) else "is not finite"
            raise CodecError(f"{message.DESCRIPTOR.name}.{name} {problem}")


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
    boxes, scores = columns[:, :4], columns[:, 4]
    _require(len(message.label) == len(boxes), message, f"has {len(boxes)} boxes but {len(message.label)} labels")
    if len(boxes):
        _require(bool((boxes[:, 2:] >= boxes[:, :2]).all()), message, "has a box of negative size")
        _require(scores.min() >= 0 and scores.max() <= 1, message, "has a score outside 0 to 1")
    return CameraDetections(message.stamp_ns, message.frame_id, boxes, scores, tuple(message.label))


def _encode_clusters(clusters: LidarClusters) -> Message:
    message = pb.LidarClusters(stamp_ns=clusters.stamp_ns, frame_id=clusters.frame_id)
    x, y, z = clusters.centroids_m.T
    size_x, size_y, size_z = clusters.sizes_m.T
    _set_arrays(message, x=x, y=y, z=z, size_x=size_x, size_y=size_y, size_z=size_z, points=clusters.points)
    return message


def _decode_clusters(message: pb.LidarClusters) -> LidarClusters:
    _check_stamp(message)
    columns = _columns(message, "x", "y", "z", "size_x", "size_y", "size_z")
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
    norm = math.sqrt(float(quaternion @ quaternion))
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
    if frame.vehicle_path is not None:
        message.vehicle_path.CopyFrom(_encode_path(frame.vehicle_path))
    return message


def _encode_path(path: VehiclePath) -> pb.VehiclePath:
    message = pb.VehiclePath(front=path.front_m, rear=path.rear_m, width=path.width_m)
    x, y, yaw = path.poses.T
    _set_arrays(message, t_s=path.times_s, x=x, y=y, yaw=yaw)
    return message


def _decode_path(message: pb.VehiclePath) -> VehiclePath:
    columns = _columns(message, "t_s", "x", "y", "yaw")
    times_s, poses = columns[:, 0], columns[:, 1:]
    _require(len(times_s) > 0, message, "has no poses")
    _require(times_s[0] >= 0 and bool((np.diff(times_s) > 0).all()), message, "has times that do not rise from 0")
    _check_scalars(message, "front", "rear", "width")
    _require(min(message.front, message.rear) >= 0 and message.width > 0, message, "is of a vehicle without size")
    return VehiclePath(times_s, poses, message.front, message.rear, message.width)


def _decode_track_frame(message: pb.TrackFrame) -> TrackFrame:
    _check_stamp(message)
    vehicle = message.vehicle_history
    wires = [_packed_fields(vehicle.SerializeToString())]
    states, lengths = _table(vehicle.DESCRIPTOR, wires, ("x", "y", "yaw", "vx", "vy"))
    vehicle_history = VehicleHistory(_rising_stamps(vehicle.DESCRIPTOR, wires, lengths), states.T)
    tracks = message.tracks
    ids = {track.id for track in tracks}
    _require(len(ids) == len(tracks), message, "has two tracks of one id")
    _require(max(ids, default=0) < 2**63, message, f"has a track of the id {max(ids, default=0)}, more than 2^63")
    return TrackFrame(
        message.sequence,
        message.stamp_ns,
        message.frame_id,
        vehicle_history,
        _decode_tracks(tracks) if tracks else (),
        message.pose_extrapolated,
        message.epoch,
        _decode_path(message.vehicle_path) if message.HasField("vehicle_path") else None,
    )


def _decode_tracks(tracks: Sequence[pb.Track]) -> tuple[Track, ...]:
    present = np.array([(track.x, track.y, track.vx, track.vy, track.existence) for track in tracks])
    _check_finite(present.T, pb.Track.DESCRIPTOR, ("x", "y", "vx", "vy", "existence"))
    outside = np.flatnonzero((present[:, 4] < 0) | (present[:, 4] > 1))
    _require(len(outside) == 0, tracks[0], f"existence {present[outside[:1], 4]} is outside 0 to 1")
    youngest = min(track.age_ns for track in tracks)
    _require(youngest >= 0, tracks[0], f"has the age {youngest} ns")
    wires = [_packed_fields(track.SerializeToString()) for track in tracks]
    covariances, sizes = _table(pb.Track.DESCRIPTOR, wires, ("covariance",))
    _require(set(sizes) == {16}, tracks[0], f"covariance has {max(sizes, key=lambda n: n != 16)} entries instead of 16")
    past_wires = [_packed_fields(wire.get(_HISTORY, b"")) for wire in wires]
    states, lengths = _table(pb.TrackHistory.DESCRIPTOR, past_wires, ("x", "y", "vx", "vy"))
    stamps_ns = _rising_stamps(pb.TrackHistory.DESCRIPTOR, past_wires, lengths)
    coasting, flags = _table(pb.TrackHistory.DESCRIPTOR, past_wires, ("coasting",))
    _require(flags == lengths, tracks[0].history, "arrays differ in length")
    past = map(
        TrackHistory,
        _split(stamps_ns, lengths),
        _split(np.ascontiguousarray(states.T), lengths),
        _split(coasting[0].astype(bool), lengths),
    )
    return tuple(
        Track(track.id, state, covariance, existence, track.age_ns, track.coasting, history)
        for track, state, covariance, existence, history in zip(
            tracks, present[:, :4], covariances.reshape(-1, 4, 4), present[:, 4].tolist(), past, strict=True
        )
    )


_HISTORY = pb.Track.DESCRIPTOR.fields_by_name["history"].number


def _rising_stamps(descriptor: Descriptor, wires: Sequence[dict[int, bytes]], lengths: list[int]) -> NDArray[np.int64]:
    """Returns all histories' stamps one behind the other; raises CodecError unless each one's rise."""
    (stamps_ns,), found = _table(descriptor, wires, ("stamp_ns",))
    for stamps_found, length in zip(found, lengths, strict=True):
        if stamps_found != length:
            raise CodecError(f"{descriptor.name} has {length} states but {stamps_found} stamps")
    if (earliest := stamps_ns.min(initial=1)) <= 0:
        raise CodecError(f"{descriptor.name} has no stamp for every state (stamp_ns {earliest})")
    rises = np.diff(stamps_ns) > 0
    ends = np.cumsum(lengths)[:-1]
    rises[ends[(ends > 0) & (ends < len(stamps_ns))] - 1] = True  # from one history to the next
    if not rises.all():
        raise CodecError(f"{descriptor.name} stamps do not rise")
    return np.asarray(stamps_ns, np.int64)


# --- predictions ---------------------------------------------------------------------------------------------------


def _encode_prediction_frame(frame: PredictionFrame) -> Message:
    message = pb.PredictionFrame(
        sequence=frame.sequence, stamp_ns=frame.stamp_ns, frame_id=frame.frame_id, model=frame.model, dt_s=frame.dt_s
    )
    for prediction in frame.predictions:
        encoded = message.predictions.add(
            track_id=prediction.track_id,
            fallback=prediction.fallback,
            corridor_probability=prediction.corridor_probability,
            corridor_time_s=prediction.corridor_time_s,
        )
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
    if frame.vehicle_path is not None:
        message.vehicle_path.CopyFrom(_encode_path(frame.vehicle_path))
    return message


def _decode_prediction_frame(message: pb.PredictionFrame) -> PredictionFrame:
    _check_stamp(message)
    _require(message.dt_s > 0 and math.isfinite(message.dt_s), message, f"dt_s {message.dt_s} is not positive")
    _check_scalars(message, "dt_s")
    ids = {prediction.track_id for prediction in message.predictions}
    _require(len(ids) == len(message.predictions), message, "has two predictions of one track")
    _require(max(ids, default=0) < 2**63, message, f"predicts a track of the id {max(ids, default=0)}, more than 2^63")
    predictions = _decode_predictions(message.predictions) if message.predictions else ()
    path = _decode_path(message.vehicle_path) if message.HasField("vehicle_path") else None
    return PredictionFrame(
        message.sequence, message.stamp_ns, message.frame_id, message.model, message.dt_s, predictions, path
    )


def _decode_predictions(predictions: Sequence[pb.Prediction]) -> tuple[Prediction, ...]:
    paths = [path for prediction in predictions for path in prediction.paths]
    counts = [len(prediction.paths) for prediction in predictions]
    _require(0 not in counts, predictions[0], "has no path")
    for path in paths:
        _require(0 <= path.probability <= 1, path, f"probability {path.probability} is outside 0 to 1")
    wires = [_packed_fields(path.SerializeToString()) for path in paths]
    points, lengths = _table(pb.ModalPath.DESCRIPTOR, wires, ("x", "y"))
    modal_paths = iter(
        [
            ModalPath(path.probability, path_points)
            for path, path_points in zip(paths, _split(np.ascontiguousarray(points.T), lengths), strict=True)
        ]
    )
    mixtures = _decode_mixtures([prediction.mixture for prediction in predictions])
    decoded = []
    for prediction, count, mixture in zip(predictions, counts, mixtures, strict=True):
        tree = tuple(islice(modal_paths, count))
        steps = len(mixture.weights)
        _require(
            all(len(path.points_m) == steps for path in tree), prediction, f"has a path that is not {steps} steps long"
        )
        risk = prediction.corridor_probability
        _require(0 <= risk <= 1, prediction, f"corridor_probability {risk} is outside 0 to 1")
        time_s = prediction.corridor_time_s if prediction.HasField("corridor_time_s") else None
        _require(time_s is None or 0 <= time_s <= LARGEST, prediction, f"corridor_time_s {time_s} makes no sense")
        decoded.append(Prediction(prediction.track_id, prediction.fallback, tree, mixture, risk, time_s))
    return tuple(decoded)


def _decode_mixtures(messages: Sequence[pb.Mixture]) -> list[Mixture]:
    wires = [_packed_fields(message.SerializeToString()) for message in messages]
    columns, lengths = _table(pb.Mixture.DESCRIPTOR, wires, ("weight", "x", "y", "sigma_x", "sigma_y", "rho"))
    weights, rhos = columns[0], columns[5]
    _require(float(columns[3:5].min(initial=1)) > 0, messages[0], "has a sigma that is not positive")
    _require(float(weights.min(initial=0)) >= 0, messages[0], "has a negative weight")
    _require(float(np.abs(rhos).max(initial=0)) < 1, messages[0], "has a correlation outside -1 to 1")
    mixtures = []
    means, sigmas = np.ascontiguousarray(columns[1:3].T), np.ascontiguousarray(columns[3:5].T)  # (S, 2) each
    for message, weight, mean, sigma, rho in zip(
        messages, *(_split(part, lengths) for part in (weights, means, sigmas, rhos)), strict=True
    ):
        K = message.components
        _require(K > 0 and len(weight) % K == 0, message, f"has {len(weight)} entries for {K} components")
        steps = (-1, K)
        mixtures.append(
            Mixture(weight.reshape(steps), mean.reshape(*steps, 2), sigma.reshape(*steps, 2), rho.reshape(steps))
        )
    return mixtures


# --- nodes ---------------------------------------------------------------------------------------------------------


def _encode_health(health: NodeHealth) -> Message:
    return pb.NodeHealth(**asdict(health))


def _decode_health(message: pb.NodeHealth) -> NodeHealth:
    _check_stamp(message)
    _check_scalars(message, "uptime_s", "rate_hz", "input_hz", "latency_p50_ms", "latency_p99_ms")
    return NodeHealth(*(getattr(message, name) for name in NodeHealth.__dataclass_fields__))


_ENCODERS: dict[type, Callable[[Any], Message]] = {
    CameraDetections: _encode_detections,
    LidarClusters: _encode_clusters,
    VehiclePose: _encode_pose,
    TrackFrame: _encode_track_frame,
    PredictionFrame: _encode_prediction_frame,
    GroundTruthFrame: _encode_ground_truth,
    NodeHealth: _encode_health,
}
_DECODERS: dict[type, tuple[Any, Callable[[Any], Any]]] = {
    CameraDetections: (pb.CameraDetections, _decode_detections),
    LidarClusters: (pb.LidarClusters, _decode_clusters),
    VehiclePose: (pb.VehiclePose, _decode_pose),
    TrackFrame: (pb.TrackFrame, _decode_track_frame),
    PredictionFrame: (pb.PredictionFrame, _decode_prediction_frame),
    GroundTruthFrame: (pb.GroundTruthFrame, _decode_ground_truth),
    NodeHealth: (pb.NodeHealth, _decode_health),
}
MESSAGE_TYPES: dict[str, type] = {schema_name(message_type): message_type for message_type in _DECODERS}
