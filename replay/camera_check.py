"""A camera's boxes against the scan's clusters: is its mount right, and do its stamps say when it looked?

Boxes and clusters are two views of the same people. Bearing of the box minus that of the reprojected cluster is 0 but
for noise; where it is not,

    residual = yaw + time_offset * bearing_rate:

a constant tells of a wrong mount, and what goes with how fast people pass by, or the vehicle turns, of wrong stamps.
Boxes are paired with clusters afresh, within gates far wider than fusion's: what is looked for here is what makes
fusion's own matches fail.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from replay.reprojection import reproject
from replay.roles import Roles
from replay.time_sync import SyncedFrame
from schemas.messages import BoolArray, FloatArray, IntArray
from tracking.camera import CameraModel
from tracking.fusion import FusionParams
from tracking.geometry import inverse
from tracking.label_report import LabelReport
from tracking.measurements import Measurements

# which pairs of a box and a cluster are looked at
MIN_SCORE, MIN_HEIGHT_PX = 0.5, 60
MIN_HITS = 5  # a label with fewer measurements may be clutter, and its velocity is not known yet
PERSON_WIDTH_M, PERSON_HEIGHT_M = 1.1, (0.3, 2.3)  # clusters of another size are left out
BORDER_PX = 4  # a box cut by the image's border has its middle in the wrong place
WINDOW = (0.2, 0.15)  # across and up, at depth 1: 11 and 9 degrees
HEIGHT_LOG_RATIO = 0.35
MAX_PAIRS = 20_000  # per camera; of longer logs every second, fourth, ... scan is taken

# the fit
KERNEL_RAD = math.radians(0.6)
YAWS_RAD = np.radians(np.arange(-8.0, 8.01, 0.5))
OFFSETS_S = np.arange(-0.24, 0.2401, 0.02)
GATE_RAD = math.radians(1.5)
OFFSET_PRIOR_S = 0.1  # one sigma: keeps a time offset at 0 that nothing tells about
MIN_BOXES, MIN_LABELS = 30, 3

SIGNIFICANT = 4.0  # standard errors
OBSERVABLE_S = 0.025  # a standard error above this: the time offset cannot be told


@dataclass(frozen=True)
class Estimate:
    """A value with its standard error."""

    value: float
    error: float

    def exceeds(self, least: float) -> bool:
        """Whether the value is significant, and at least so large."""
        return abs(self.value) >= max(least, SIGNIFICANT * self.error)


@dataclass(frozen=True)
class CameraCheck:
    """One camera against the LiDAR. None: too few boxes, or people, that the LiDAR sees, too."""

    camera: str
    topic: str  # of its detections, name in the log
    boxes: int  # that a cluster was found for
    boxes_seen: int  # whole, of a score of 0.5 or more, and tall enough for the LiDAR to reach their person
    residual_px: tuple[float, float] | None = None  # across, to the right: median and MAD
    residual_deg: tuple[float, float] | None = None  # in bearing, to the left: median and MAD
    height_log_ratio: Estimate | None = None  # box to a person of the assumed height
    yaw_deg: Estimate | None = None  # boxes lie so far to the left of the clusters
    pitch_deg: Estimate | None = None  # and so far above them
    time_offset_ms: Estimate | None = None  # to be added to the stamps
    time_offset_observable: bool = False  # False: people hardly pass by, nor does the vehicle turn
    since_s: float | None = None  # when its last calibration came, in s into the log; earlier boxes do not count


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of a box and a person's cluster of one camera that may belong together, sorted by box."""

    box: IntArray  # (N,)  scan and row as one number
    block: IntArray  # (N,)  label and second as one number: within one, errors go together
    label: IntArray  # (N,)
    box_px: FloatArray  # (N, 2)  middle of the box
    person_px: FloatArray  # (N, 2)  middle of the reprojected cluster
    up: FloatArray  # (N, 3)  the vertical in the optical frame
    height_log_ratio: FloatArray  # (N,)
    bearing_rate: FloatArray  # (N,)  rad/s, seen from the camera, to the left


@dataclass
class _Camera:
    model: CameraModel
    since_s: float | None = None
    frames: list[_Pairs] = field(default_factory=list)
    every: int = 1  # of how many scans one is kept
    pairs: int = 0
    boxes: int = 0  # that a cluster was looked for


class CameraWatch:
    """Collects pairs of boxes and clusters, frame by frame; `checks` fits them."""

    def __init__(self, params: FusionParams):
        self._params = params
        self._cameras: dict[str, _Camera] = {}
        self._labels: dict[tuple[int, tuple[int, int]], int] = {}
        self._last: tuple[int, int, float] | None = None  # epoch, stamp, yaw
        self._scans = 0

    def add(self, frame: SyncedFrame, measurements: Measurements, labels: LabelReport, at_s: float) -> None:
        """Takes a tracked frame, what the tracker made of it, and when that was, in seconds into the log."""
        yaw_rate = self._yaw_rate(frame)
        self._scans += 1
        sensors, clusters = frame.sensors, frame.sensors.clusters
        rows = np.flatnonzero((labels.measurement >= 0) & (labels.hits >= MIN_HITS))
        cluster = measurements.cluster_index[labels.measurement[rows]]
        size = clusters.sizes_m[np.maximum(cluster, 0)]
        low, high = PERSON_HEIGHT_M
        person = (cluster >= 0) & (np.hypot(size[:, 0], size[:, 1]) < PERSON_WIDTH_M)
        rows = rows[person & (size[:, 2] > low) & (size[:, 2] < high)]
        if len(rows) == 0 or yaw_rate is None:
            return
        positions, velocities = measurements.positions_m[labels.measurement[rows]], labels.states[rows, 2:]
        names = [(frame.epoch, labels.names[row]) for row in rows]
        label = np.array([self._labels.setdefault(name, len(self._labels)) for name in names], np.int64)
        people = reproject(sensors, positions, velocities, self._params)
        vehicle = frame.vehicle_state
        for c, camera in enumerate(sensors.cameras):
            known = self._cameras.setdefault(camera.name, _Camera(camera.model))
            if known.model is not camera.model:  # another calibration: its errors are others, too
                known = self._cameras[camera.name] = _Camera(camera.model, at_s)
            if self._scans % known.every:
                continue
            mine = np.flatnonzero((people.camera == c) & (people.share_inside > 0.95))
            detections = camera.detections
            boxes = np.flatnonzero(
                _whole(detections.boxes_px, camera.model)
                & (detections.scores >= MIN_SCORE)
                & (_height(detections.boxes_px.T) >= MIN_HEIGHT_PX)
                & np.array([name in self._params.pedestrian_labels for name in detections.labels], bool)
            )
            known.boxes += len(boxes)
            outline, box_px = people.corners_px[:, mine], detections.boxes_px[boxes].T
            b, p = _near(box_px, outline, camera.model)
            if len(b) == 0:
                continue
            who = people.person[mine[p]]
            eye = inverse(camera.camera_from_map)[:2, 3]
            offset = positions[who] - eye
            eye_velocity = vehicle[3:] + yaw_rate * np.array([-1.0, 1.0]) * (eye - vehicle[:2])[::-1]
            relative = velocities[who] - eye_velocity
            cross = offset[:, 0] * relative[:, 1] - offset[:, 1] * relative[:, 0]
            rate = cross / np.maximum((offset**2).sum(axis=1), 0.25) - yaw_rate
            second = sensors.stamp_ns // 1_000_000_000 % 1_000_000
            known.frames.append(
                _Pairs(
                    self._scans * 10_000 + boxes[b],
                    label[who] * 1_000_000 + second,
                    label[who],
                    _middle(box_px)[b],
                    _middle(outline)[p],
                    np.broadcast_to(camera.camera_from_map[:3, 2], (len(b), 3)),
                    np.log(_height(box_px)[b] / _height(outline)[p]),
                    rate,
                )
            )
            known.pairs += len(b)
            if known.pairs > MAX_PAIRS:
                known.every *= 2
                known.frames = known.frames[::2]
                known.pairs = sum(len(frame.box) for frame in known.frames)
                known.boxes //= 2

    def _yaw_rate(self, frame: SyncedFrame) -> float | None:
        """Returns how fast the vehicle turned since the frame before, rad/s, or None after a gap."""
        stamp_ns, yaw = frame.sensors.stamp_ns, float(frame.vehicle_state[2])
        last, self._last = self._last, (frame.epoch, stamp_ns, yaw)
        if last is None or last[0] != frame.epoch or not 0 < stamp_ns - last[1] < 500_000_000:
            return None
        return math.remainder(yaw - last[2], 2 * math.pi) / ((stamp_ns - last[1]) * 1e-9)

    def checks(self, roles: Roles) -> tuple[CameraCheck, ...]:
        """Returns a check of each camera that had detections."""
        return tuple(
            _check(name, roles.topics("camera", camera=name)[0], camera)
            for name, camera in sorted(self._cameras.items())
        )


def _whole(boxes_px: FloatArray, model: CameraModel) -> BoolArray:
    low = (boxes_px[:, :2] > BORDER_PX).all(axis=1)
    high = (boxes_px[:, 2:] < np.array([model.width_px, model.height_px]) - BORDER_PX).all(axis=1)
    return np.asarray(low & high & (boxes_px[:, 2:] > boxes_px[:, :2]).all(axis=1))


def _near(boxes_px: FloatArray, outlines_px: FloatArray, model: CameraModel) -> tuple[IntArray, IntArray]:
    """Returns boxes (N,) and outlines (N,) of corners (4, B) and (4, P) that may show the same person."""
    across = boxes_px[[0, 2], :, None].sum(axis=0) / 2 - outlines_px[[0, 2], None].sum(axis=0) / 2  # (B, P)
    up = boxes_px[[1, 3], :, None].sum(axis=0) / 2 - outlines_px[[1, 3], None].sum(axis=0) / 2
    ratio = np.log(_height(boxes_px)[:, None] / _height(outlines_px))
    near = (np.abs(across) < WINDOW[0] * model.fx) & (np.abs(up) < WINDOW[1] * model.fy)
    b, p = np.nonzero(near & (np.abs(ratio) < HEIGHT_LOG_RATIO))
    return b, p


def _middle(corners_px: FloatArray) -> FloatArray:
    middle: FloatArray = ((corners_px[:2] + corners_px[2:]) / 2).T
    return middle


def _height(corners_px: FloatArray) -> FloatArray:
    height: FloatArray = np.maximum(corners_px[3] - corners_px[1], 1e-9)
    return height


def _check(name: str, topic: str, camera: _Camera) -> CameraCheck:
    nothing = CameraCheck(name, topic, 0, camera.boxes, since_s=camera.since_s)
    if not camera.frames:
        return nothing
    pairs = _Pairs(*(np.concatenate(column) for column in zip(*map(_columns, camera.frames), strict=True)))
    box_ray, person_ray = camera.model.ray(pairs.box_px), camera.model.ray(pairs.person_px)
    bearing, elevation = _angles(person_ray, box_ray, pairs.up)
    known = np.flatnonzero(np.isfinite(bearing) & np.isfinite(elevation))
    pairs = _Pairs(*(column[known] for column in _columns(pairs)))
    bearing, elevation = bearing[known], elevation[known]
    starts = np.flatnonzero(np.diff(pairs.box, prepend=-1))
    if len(starts) < MIN_BOXES:
        return replace(nothing, boxes=len(starts))
    fit = _fit(bearing, pairs.bearing_rate, starts)
    chosen = fit.chosen
    boxes, labels = len(chosen), len(np.unique(pairs.label[chosen]))
    if boxes < MIN_BOXES or labels < MIN_LABELS:
        return replace(nothing, boxes=boxes)
    errors = _standard_errors(fit, bearing, pairs)
    across = (pairs.box_px - pairs.person_px)[chosen, 0]
    # A camera that looks up too far sees people at its sides raised by less.
    axis = np.broadcast_to(np.array([0.0, 0.0, 1.0]), person_ray.shape)
    aside, _ = _angles(axis[known], person_ray[known], pairs.up)
    pitch = _median((elevation / np.maximum(np.cos(aside), 0.3))[chosen], len(np.unique(pairs.block[chosen])))
    height = _median(pairs.height_log_ratio[chosen], labels)  # somebody tall is tall from second to second
    return CameraCheck(
        name,
        topic,
        boxes,
        camera.boxes,
        median_and_mad(across),
        median_and_mad(np.degrees(bearing[chosen])),
        height,
        Estimate(math.degrees(fit.yaw_rad), math.degrees(errors[0])),
        Estimate(math.degrees(pitch.value), math.degrees(pitch.error)),
        Estimate(1e3 * fit.offset_s, 1e3 * float(errors[1])),
        time_offset_observable=bool(errors[1] <= OBSERVABLE_S),
        since_s=camera.since_s,
    )


def _median(values: FloatArray, independent: int) -> Estimate:
    """Returns the median and its standard error, if so many of the values are independent of each other."""
    middle, mad = median_and_mad(values)
    return Estimate(middle, 1.25 * 1.4826 * mad / math.sqrt(independent))


def _columns(pairs: _Pairs) -> tuple[np.ndarray, ...]:
    return (
        pairs.box,
        pairs.block,
        pairs.label,
        pairs.box_px,
        pairs.person_px,
        pairs.up,
        pairs.height_log_ratio,
        pairs.bearing_rate,
    )


def _angles(from_ray: FloatArray, to_ray: FloatArray, up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns by how much (N,) one has to turn to the left, and look up, from one unit direction (N, 3) to another."""
    height_from, height_to = (from_ray * up).sum(axis=1), (to_ray * up).sum(axis=1)
    sine = (np.cross(from_ray, to_ray) * up).sum(axis=1)
    cosine = (from_ray * to_ray).sum(axis=1) - height_from * height_to
    return np.arctan2(sine, cosine), np.arcsin(height_to) - np.arcsin(height_from)


@dataclass(frozen=True, eq=False)
class _Fit:
    yaw_rad: float
    offset_s: float
    chosen: IntArray  # (K,)  the pair of each box that fits, where one does
    weights: FloatArray  # (K,)  Huber's


def _fit(bearing: FloatArray, rate: FloatArray, starts: IntArray) -> _Fit:
    """Fits bearing = yaw + offset * rate to one pair per box, whichever fits best.

    Args:
        bearing: (N,) residuals in rad.
        rate: (N,) rad/s.
        starts: (B,) where in N each box begins.
    """
    yaw, offset = _start(bearing, rate, starts)
    gate, chosen, weights = 2 * GATE_RAD, starts, np.ones(len(starts))
    for _ in range(20):
        off = np.abs(bearing - yaw - offset * rate)
        chosen = _least_per_box(off, starts)
        chosen = chosen[off[chosen] < gate]
        if len(chosen) < MIN_BOXES:
            break
        scale = max(1.4826 * float(np.median(off[chosen])), math.radians(0.05))
        weights = np.minimum(1.0, 1.5 * scale / np.maximum(off[chosen], 1e-12))  # Huber
        A = np.column_stack([np.ones(len(chosen)), rate[chosen]])
        normal = (A * weights[:, None]).T @ A + np.diag([0.0, (scale / OFFSET_PRIOR_S) ** 2])
        yaw, offset = np.linalg.solve(normal, (A * weights[:, None]).T @ bearing[chosen]).tolist()
        gate = GATE_RAD
    return _Fit(yaw, offset, chosen, weights)


def _start(bearing: FloatArray, rate: FloatArray, starts: IntArray) -> tuple[float, float]:
    """Returns the yaw and offset of a grid under which most boxes lie on a cluster; 0 unless another is far better."""
    bounds = np.append(starts, len(bearing))
    some = np.arange(0, len(starts), max(1, len(bearing) // 4000))  # boxes enough to find the peak
    rows = np.concatenate([np.arange(bounds[i], bounds[i + 1]) for i in some])
    begins = np.concatenate([[0], np.cumsum(bounds[some + 1] - bounds[some])])[:-1]
    best, best_score, score_of_none = (0.0, 0.0), 0.0, 0.0
    for offset in OFFSETS_S.tolist():
        off = (bearing[rows] - offset * rate[rows] - YAWS_RAD[:, None]) / KERNEL_RAD  # (Y, R)
        scores = np.maximum.reduceat(np.exp(-0.5 * off * off), begins, axis=1).sum(axis=1)
        top = int(scores.argmax())
        if scores[top] > best_score:
            best, best_score = (float(YAWS_RAD[top]), offset), float(scores[top])
        if abs(offset) < 1e-9:
            score_of_none = float(scores[len(YAWS_RAD) // 2])
    return best if best_score > 1.1 * score_of_none + 5 else (0.0, 0.0)


def _least_per_box(values: FloatArray, starts: IntArray) -> IntArray:
    """Returns the index (B,) of the least value of each box; boxes begin at `starts`."""
    box = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(values))))
    order = np.lexsort((values, box))
    return order[starts]


def _standard_errors(fit: _Fit, bearing: FloatArray, pairs: _Pairs) -> FloatArray:
    """Returns standard errors (2,) of yaw in rad and offset in s; the errors of one person's second go together.

    The sandwich estimator with blocks (Liang and Zeger 1986), with the usual correction for few blocks.
    """
    rows, weights = fit.chosen, fit.weights
    A = np.column_stack([np.ones(len(rows)), pairs.bearing_rate[rows]])
    off = bearing[rows] - A @ np.array([fit.yaw_rad, fit.offset_s])
    _, block = np.unique(pairs.block[rows], return_inverse=True)
    G = int(block.max()) + 1
    scores = np.zeros((G, 2))
    np.add.at(scores, block, A * (weights * off)[:, None])
    bread = np.linalg.pinv((A * weights[:, None]).T @ A)
    covariance = bread @ (scores.T @ scores) @ bread * (G / max(G - 2, 1))
    # never better than if the blocks' errors were independent of each other and of the size of the noise seen
    least = np.linalg.pinv(A.T @ A) * float(np.mean(off**2)) * len(rows) / G
    errors: FloatArray = np.sqrt(np.maximum(np.diag(covariance), np.diag(least)))
    return errors


def median_and_mad(values: FloatArray | IntArray) -> tuple[float, float]:
    """Returns the median, and the median distance from it."""
    middle = float(np.median(values))
    return middle, float(np.median(np.abs(values - middle)))
