"""Camera boxes and clusters: which came near each other, how well they fit, and who got whom. Arrays in, arrays out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.messages import BoolArray, FloatArray, IntArray
from tracking.assignment import assign
from tracking.fusion_params import FusionParams
from tracking.outlines import Outlines, outlines
from tracking.sensor_frame import CameraFrame


@dataclass(frozen=True, eq=False)
class Boxes:
    """Every camera's pedestrian boxes, sorted by camera, then by place."""

    camera: IntArray  # (B,)  row of the camera
    rows: IntArray  # (B,)  in the camera's message
    corners_px: FloatArray  # (B, 4)
    scores: FloatArray  # (B,)

    def __len__(self) -> int:
        return len(self.rows)


def pedestrian_boxes(cameras: Sequence[CameraFrame], labels: Sequence[str]) -> Boxes:
    """Returns the boxes with one of the labels that are finite and have a size."""
    messages = [camera.detections for camera in cameras]
    named = np.array([label in labels for message in messages for label in message.labels], bool)
    counts = [len(message.labels) for message in messages]
    camera = np.repeat(np.arange(len(messages)), counts)
    rows = np.concatenate([np.zeros(0, np.int64), *(np.arange(count) for count in counts)])
    corners = np.concatenate([np.zeros((0, 4)), *(message.boxes_px.reshape(-1, 4) for message in messages)])
    scores = np.concatenate([np.zeros(0), *(message.scores for message in messages)])
    keep = named & np.isfinite(corners).all(axis=1) & np.isfinite(scores)
    keep &= (corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1])
    kept = np.flatnonzero(keep)
    kept = kept[np.lexsort((scores[kept], *corners[kept].T[::-1], camera[kept]))]
    return Boxes(camera[kept], rows[kept], corners[kept], scores[kept])


@dataclass(frozen=True, eq=False)
class BoxPairs:
    """Boxes and clusters of one camera that touch, in order of box, then cluster."""

    box: IntArray  # (P,)
    cluster: IntArray  # (P,)
    outline_px: FloatArray  # (4, P)  of the person that the cluster would be
    overlap: FloatArray  # (P,)  horizontal, intersection over union
    height_log_ratio: FloatArray  # (P,)  of the box to the outline
    likeness: FloatArray  # (P,)  how well they fit; 0 past the gates


@dataclass(frozen=True, eq=False)
class CameraView:
    """What C cameras see of M clusters, were each a person."""

    people: Outlines
    boxes: Boxes
    pairs: BoxPairs
    matched: BoolArray  # (P,)  pairs of the one to one assignment per camera


def look(
    cameras: Sequence[CameraFrame],
    boxes: Boxes,
    positions_m: FloatArray,
    ground_m: FloatArray,
    rank: FloatArray,
    params: FusionParams,
) -> CameraView:
    """Projects people into the cameras and matches them with the boxes, one to one per camera.

    Args:
        cameras: C of them, in the order of `boxes`.
        boxes: B of them.
        positions_m: (C, M, 2) odometry frame, at each camera's stamp.
        ground_m: (M,) height of the people's feet.
        rank: (M,) who comes first to a box that fits several: factors on how well they fit.
        params: settings.
    """
    M = len(ground_m)
    if M == 0 or not cameras:
        return nothing_seen(boxes)
    people = outlines(cameras, positions_m, ground_m, radius_m=params.radius_m, height_m=params.height_m)
    pairs = _near_pairs(people, boxes, len(cameras), M, params)
    fits = np.flatnonzero(pairs.likeness)
    box, cluster = pairs.box[fits], pairs.cluster[fits]
    matched = np.zeros(len(pairs.box), bool)
    matched[fits] = assign(box, boxes.camera[box] * M + cluster, pairs.likeness[fits] * rank[cluster])
    return CameraView(people, boxes, pairs, matched)


def nothing_seen(boxes: Boxes) -> CameraView:
    """Returns the view of nobody."""
    i, f = np.zeros(0, np.int64), np.zeros(0)
    return CameraView(
        Outlines(i, i, np.zeros((4, 0)), f), boxes, BoxPairs(i, i, np.zeros((4, 0)), f, f, f), np.zeros(0, bool)
    )


def _near_pairs(people: Outlines, boxes: Boxes, C: int, M: int, params: FusionParams) -> BoxPairs:
    """Returns the pairs that touch when boxes are widened by `grown_box`, those that the gates refuse among them."""
    table = np.full((4, C, M), np.nan)  # compares as False where nobody is in view
    table[:, people.camera, people.person] = people.corners_px
    x0, y0, x1, y1 = table[:, boxes.camera]  # (B, M) each
    u0, v0, u1, v1 = boxes.corners_px.T  # (B,) each
    wider = 0.5 * (params.grown_box - 1) * (u1 - u0) + 1.0  # a pixel more, for rounding
    near = (x0 < (u1 + wider)[:, None]) & (x1 > (u0 - wider)[:, None]) & (y0 < v1[:, None]) & (y1 > v0[:, None])
    box, cluster = np.divmod(np.flatnonzero(near), max(M, 1))
    outline = table[:, boxes.camera[box], cluster]
    return BoxPairs(box, cluster, outline, *_likeness(outline, boxes.corners_px[box].T, params))


def _likeness(
    outlines_px: FloatArray, boxes_px: FloatArray, params: FusionParams
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns overlap, log ratio of heights and likeness (P,) of outlines (4, P) and boxes (4, P), pair by pair."""
    x0, y0, x1, y1 = outlines_px
    u0, v0, u1, v1 = boxes_px
    width, height = x1 - x0, np.maximum(y1 - y0, 1e-9)
    box_width, box_height = u1 - u0, v1 - v0
    shared_x = np.minimum(x1, u1) - np.maximum(x0, u0)
    shared_y = np.minimum(y1, v1) - np.maximum(y0, v0)
    overlap = np.maximum(shared_x, 0.0) / np.maximum(width + box_width - shared_x, 1e-9)
    inside = np.abs(x0 + x1 - u0 - u1) <= params.grown_box * box_width
    inside &= np.abs(y0 + y1 - v0 - v1) <= params.grown_box * box_height
    log_ratio = np.log(box_height / height)
    ratio = log_ratio / params.max_height_log_ratio
    gate = ((overlap >= params.min_overlap) | inside) & (shared_y > 0) & (np.abs(ratio) < 1)
    return overlap, log_ratio, np.where(gate, (0.1 + overlap) * np.exp(-2 * ratio * ratio), 0.0)
