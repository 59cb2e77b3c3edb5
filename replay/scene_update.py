"""A frame as a foxglove.SceneUpdate, so that tracks and predictions can be seen in Foxglove or Lichtblick as they are.

Every update first deletes what was there and then draws the whole frame. It depends on no update before it, so seeking
works in both directions; the lifetime takes the last drawing away where the recording ends or has a gap.
"""

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.duration_pb2 import Duration
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from replay import colours
from replay.drawing import (
    PERSON_HEIGHT_M,
    PERSON_RADIUS_M,
    VEHICLE_CENTRE_M,
    VEHICLE_HEIGHT_M,
    VEHICLE_LENGTH_M,
    VEHICLE_WIDTH_M,
    vehicle_outline,
)
from replay.frame_result import FrameResult
from schemas.messages import FloatArray
from tracking.geometry import quaternion_of

__all__ = ["SceneUpdate", "scene_update", "scene_update_bytes"]

LIFETIME_S = 1
COASTING_OPACITY = 0.3
GROUND_M = 0.05  # paths float a little above the ground, or a grid would hide them
LABEL_M = PERSON_HEIGHT_M + 0.4


def scene_update(result: FrameResult) -> SceneUpdate:
    """Returns the scene of one frame: the vehicle, and per track one entity with cylinder, id and modal paths.

    Entities are called "vehicle" and "track/ID" and are in the odometry frame. Paths have their pedestrian's colour and
    are as opaque as they are likely; a fallback is grey and dashed, a coasting track pale.
    """
    return SceneUpdate.FromString(scene_update_bytes(result))


def scene_update_bytes(result: FrameResult) -> bytes:
    """Returns `scene_update(result)` on the wire; the same result gives the same bytes.

    Messages of one shape are filled in as rows of an array: setting their fields one by one takes four times as long.
    """
    stamp_ns, tracks = result.tracks.stamp_ns, result.tracks.tracks
    stamp = Timestamp(seconds=stamp_ns // 1_000_000_000, nanos=stamp_ns % 1_000_000_000)
    deletion = SceneEntityDeletion(timestamp=stamp, type=SceneEntityDeletion.ALL)
    head = SceneEntity(timestamp=stamp, frame_id=result.tracks.frame_id).SerializeToString()
    lifetime = _field(_LIFETIME, Duration(seconds=LIFETIME_S).SerializeToString())
    ground_m = float(result.sensors.map_from_vehicle[2, 3])

    rgb = colours.track_colours([track.id for track in tracks]) / 255  # (A, 3)
    places = np.array([track.state[:2] for track in tracks], float).reshape(-1, 2)  # (A, 2)
    opacity = np.array([COASTING_OPACITY if track.coasting else 1.0 for track in tracks])
    cylinders = _CYLINDER.fill(_raised(places, ground_m + PERSON_HEIGHT_M / 2), rgb, opacity)
    labels = _LABEL.fill(_raised(places, ground_m + LABEL_M), rgb, np.ones(len(tracks)))
    lines = _path_lines(result, places, rgb, ground_m + GROUND_M)

    out = [_field(_DELETIONS, deletion.SerializeToString()), _vehicle(result, stamp)]
    for track, cylinder, label in zip(tracks, cylinders, labels, strict=True):
        number = str(track.id).encode()
        text = _field(_TEXTS, label + _field(_TEXT, number))
        body = (head, _field(_ID, b"track/" + number), lifetime, cylinder, lines.get(track.id, b""), text)
        out.append(_field(_ENTITIES, b"".join(body)))
    return b"".join(out)


def _vehicle(result: FrameResult, stamp: Timestamp) -> bytes:
    pose = result.sensors.map_from_vehicle
    middle = pose[:3, :3] @ np.array([VEHICLE_CENTRE_M, 0, VEHICLE_HEIGHT_M / 2]) + pose[:3, 3]
    x, y, z, w = quaternion_of(pose).tolist()
    r, g, b = (channel / 255 for channel in colours.VEHICLE)
    entity = SceneEntity(
        timestamp=stamp,
        frame_id=result.tracks.frame_id,
        id="vehicle",
        lifetime=Duration(seconds=LIFETIME_S),
        cubes=[
            CubePrimitive(
                pose=Pose(position=_vector(*middle.tolist()), orientation=Quaternion(x=x, y=y, z=z, w=w)),
                size=_vector(VEHICLE_LENGTH_M, VEHICLE_WIDTH_M, VEHICLE_HEIGHT_M),
                color=Color(r=r, g=g, b=b, a=0.5),
            )
        ],
        lines=[
            LinePrimitive(
                type=LinePrimitive.LINE_STRIP,
                pose=_UPRIGHT,
                thickness=0.05,
                points=[Point3(x=px, y=py, z=pose[2, 3] + GROUND_M) for px, py in vehicle_outline(pose).tolist()],
                color=Color(r=r, g=g, b=b, a=1),
            )
        ],
    )
    return _field(_ENTITIES, entity.SerializeToString(deterministic=True))


def _path_lines(result: FrameResult, places: FloatArray, rgb: FloatArray, height_m: float) -> dict[int, bytes]:
    """Returns each track's paths as encoded `lines` fields of its entity, likeliest first."""
    row_of = {track.id: row for row, track in enumerate(result.tracks.tracks)}
    predictions = [p for p in result.predictions.predictions if p.track_id in row_of]
    paths = [(row_of[p.track_id], p, path) for p in predictions for path in p.paths]
    if not paths:
        return {}
    rows = np.array([row for row, _, _ in paths])
    fallback = np.array([p.fallback for _, p, _ in paths])
    colour = np.where(fallback[:, None], np.array(colours.FALLBACK) / 255, rgb[rows])
    opacity = colours.path_opacity([path.probability for _, _, path in paths])
    ends = _LINE_COLOUR.fill(colour, opacity)

    pieces = [piece for row, _, path in paths for piece in (places[row, None], path.points_m)]
    points = _POINT.fill_joined(_raised(np.concatenate(pieces), height_m))
    size = len(_POINT.wire)
    lines: dict[int, list[bytes]] = {}
    start = 0
    for (_, p, path), end in zip(paths, ends, strict=True):
        stop = start + size * (1 + len(path.points_m))
        line = (_DASHED if p.fallback else _SOLID) + points[start:stop] + end
        lines.setdefault(p.track_id, []).append(_field(_LINES, line))
        start = stop
    return {number: b"".join(encoded) for number, encoded in lines.items()}


def _raised(places_m: FloatArray, height_m: float) -> FloatArray:
    return np.column_stack([places_m, np.full(len(places_m), height_m)])


def _vector(x: float, y: float, z: float) -> Vector3:
    return Vector3(x=x, y=y, z=z)


# --- messages of one shape as rows of bytes ------------------------------------------------------------------------

_MARKS = tuple(1e6 + k + 0.25 for k in range(7))  # stand where a number goes; found again in the encoded template


@dataclass(frozen=True, eq=False)
class _Shape:
    """An encoded message with holes for float64 numbers, in the order of the marks."""

    wire: NDArray[np.uint8]
    holes: tuple[int, ...]

    def fill(self, *values: FloatArray) -> list[bytes]:
        """Returns N encoded messages from arrays (N,) or (N, k) that together have one column per hole."""
        size, joined = len(self.wire), self.fill_joined(*values)
        return [joined[start : start + size] for start in range(0, len(joined), size)]

    def fill_joined(self, *values: FloatArray) -> bytes:
        """Returns the same N messages one behind another."""
        columns = np.ascontiguousarray(np.column_stack(values), "<f8").view(np.uint8)  # (N, holes * 8)
        rows = np.empty((len(columns), len(self.wire)), np.uint8)
        rows[:] = self.wire
        for k, hole in enumerate(self.holes):
            rows[:, hole : hole + 8] = columns[:, 8 * k : 8 * k + 8]
        return rows.tobytes()


def _shape(message: Message, field: int | None = None) -> _Shape:
    """Returns the shape of a message, as the value of a field of its parent if `field` is given."""
    wire = message.SerializeToString(deterministic=True)
    if field is not None:
        wire = _field(field, wire)
    marks = [struct.pack("<d", mark) for mark in _MARKS]
    return _Shape(np.frombuffer(wire, np.uint8), tuple(wire.index(mark) for mark in marks if mark in wire))


def _field(number: int, payload: bytes) -> bytes:
    """Returns a length-delimited field; numbers up to 15, which have a tag of one byte."""
    tag, length = number << 3 | 2, len(payload)
    if length < 0x80:
        return bytes((tag, length)) + payload
    size = [tag]
    while length > 0x7F:
        size.append(length & 0x7F | 0x80)
        length >>= 7
    return bytes((*size, length)) + payload


def _number(message: Any, field: str) -> int:
    return int(message.DESCRIPTOR.fields_by_name[field].number)


_DELETIONS, _ENTITIES = _number(SceneUpdate, "deletions"), _number(SceneUpdate, "entities")
_ID, _LIFETIME = _number(SceneEntity, "id"), _number(SceneEntity, "lifetime")
_LINES, _TEXTS = _number(SceneEntity, "lines"), _number(SceneEntity, "texts")
_TEXT = _number(TextPrimitive, "text")

_UPRIGHT = Pose(orientation=Quaternion(w=1))
_AT_MARKS = Pose(position=_vector(*_MARKS[:3]), orientation=Quaternion(w=1))
_COLOUR_MARKS = Color(r=_MARKS[3], g=_MARKS[4], b=_MARKS[5], a=_MARKS[6])
_CYLINDER = _shape(
    CylinderPrimitive(
        pose=_AT_MARKS,
        size=_vector(2 * PERSON_RADIUS_M, 2 * PERSON_RADIUS_M, PERSON_HEIGHT_M),
        bottom_scale=1,
        top_scale=1,
        color=_COLOUR_MARKS,
    ),
    _number(SceneEntity, "cylinders"),
)
_LABEL = _shape(TextPrimitive(pose=_AT_MARKS, billboard=True, font_size=0.5, color=_COLOUR_MARKS))
_POINT = _shape(Point3(x=_MARKS[0], y=_MARKS[1], z=_MARKS[2]), _number(LinePrimitive, "points"))
_LINE_COLOUR = _shape(_COLOUR_MARKS, _number(LinePrimitive, "color"))
_SOLID = LinePrimitive(type=LinePrimitive.LINE_STRIP, pose=_UPRIGHT, thickness=0.07).SerializeToString()
# a list of lines joins the points 0-1, 2-3, ...: a path drawn so is dashed
_DASHED = LinePrimitive(type=LinePrimitive.LINE_LIST, pose=_UPRIGHT, thickness=0.04).SerializeToString()
