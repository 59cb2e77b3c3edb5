"""One frame taken apart: what each cluster, box, track and person came to, and why. Plain numbers and words.

Places are as the vehicle sees them: metres ahead of its origin and to its left.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from threadpoolctl import threadpool_limits

from replay.pipeline import amend
from replay.score import MIN_LIDAR_POINTS, match
from replay.session import Replay
from replay.time_sync import SyncedFrame
from schemas.messages import FloatArray, GroundTruthFrame, TrackFrame
from tracking.clusters import place, size_log_odds, sound_clusters
from tracking.fusion import Candidate
from tracking.fusion_params import FusionParams
from tracking.geometry import apply, ground_heights, inverse
from tracking.label_report import LabelReport, Verdict
from tracking.measurements import Measurements
from tracking.pipeline import TrackingSettings
from tracking.tracker import TrackerParams

NEAR_M = 0.7  # a cluster this near a person is that person's


class Outcome(StrEnum):
    """What became of a measurement."""

    TRACKED = "tracked"
    UNCONFIRMED = "unconfirmed"
    FADED = "faded"
    NO_PEDESTRIAN = "no pedestrian"
    NO_BIRTH = "gives no birth"
    ONE_CAMERA = "one camera alone"
    CLUTTER = "clutter"
    REFUSED = "refused"


class Miss(StrEnum):
    """Why a person is not tracked, beside the outcomes of that person's measurement."""

    FEW_POINTS = "fewer than 4 LiDAR points"
    NO_CLUSTER = "no cluster near"
    SHARED = "shares a cluster"
    OTHER_PLACE = "its track is elsewhere"


class Unmatched(StrEnum):
    """Why a box has no cluster."""

    NO_CLUSTER = "no cluster near"
    OVERLAP = "overlap"
    HEIGHT = "height ratio"
    APART = "one above the other"
    LOST = "lost to another box"


@dataclass(frozen=True)
class BoxScore:
    """A box that was matched to a cluster, or stands for a person without one; then there is nothing to fit."""

    camera: str
    box: int  # row in the camera's message
    score: float  # the detector's
    fit: float | None = None  # how well box and cluster go together, at most 1.1; the matching weighs it
    overlap: float | None = None  # horizontal, intersection over union
    height_log_ratio: float | None = None  # of the box to the person that the cluster would be


@dataclass(frozen=True)
class NearMiss:
    """A box that touches a cluster and was not matched to it."""

    camera: str
    box: int
    score: float  # the detector's
    fit: float  # 0: past fusion's gates; otherwise it lost to another
    overlap: float  # horizontal, intersection over union
    height_log_ratio: float  # of the box to the person that the cluster would be
    why: str


@dataclass(frozen=True)
class ClusterReport:
    """One measurement and the cluster behind it; a cluster that was split has several."""

    cluster: int  # row in the scan; -1: a camera's alone
    part: int  # which of `parts`, from 0
    parts: int
    ahead_m: float
    left_m: float
    range_m: float  # from the vehicle's origin
    points: int
    width_m: float  # diagonal, seen from above, of the whole cluster
    height_m: float
    size_log_odds: float | None  # of being a person by size alone
    boxes: tuple[BoxScore, ...]
    near_misses: tuple[NearMiss, ...]
    pedestrian_probability: float | None  # from this scan alone; None: refused
    outcome: Outcome
    label: tuple[int, int] | None  # name of the tracker's label that owns it, the same from scan to scan
    track_id: int  # of the label, once it has been published; 0 before
    reason: str  # of the outcome, in words


@dataclass(frozen=True)
class BoxReport:
    """A pedestrian box."""

    camera: str
    box: int  # row in the camera's message
    score: float
    corners_px: tuple[float, float, float, float]
    cluster: int | None  # that it was matched to; -1: it is a measurement of its own; None: neither
    outcome: str  # an Outcome, of the measurement, or an Unmatched
    why: str  # in words


@dataclass(frozen=True)
class TrackReport:
    """A published track that nothing was measured of in this frame."""

    id: int
    ahead_m: float
    left_m: float
    existence: float
    hidden: float  # probability that the sensors cannot see it now


@dataclass(frozen=True)
class PersonReport:
    """Somebody of the ground truth."""

    id: int
    ahead_m: float
    left_m: float
    range_m: float
    lidar_points: int
    track_id: int  # that stands for this person; 0: none
    miss: str | None  # an Outcome or a Miss; None: tracked
    reason: str


@dataclass(frozen=True)
class FrameReport:
    """One frame."""

    at_s: float  # seconds into the log, by log time: what --start and --at count
    stamp_ns: int
    epoch: int
    cameras: tuple[str, ...]  # with detections near enough in time
    tracks: int  # published
    clusters: tuple[ClusterReport, ...]  # nearest first
    boxes: tuple[BoxReport, ...]
    unmeasured: tuple[TrackReport, ...]
    people: tuple[PersonReport, ...] | None  # nearest first; None: the log has no ground truth for this scan


@dataclass(frozen=True, eq=False)
class Inspected:
    """A frame as it went through the tracker, and the report of it."""

    frame: SyncedFrame
    candidates: tuple[Candidate, ...]
    measurements: Measurements
    tracks: TrackFrame
    labels: LabelReport
    clusters: tuple[ClusterReport, ...]  # a report for each measurement, in their order, then for refused clusters
    report: FrameReport


def inspect_frames(run: Replay) -> Iterator[Inspected]:
    """Yields the run's frames with their reports, tracked as a replay tracks them; nothing is predicted.

    The first ones warm the tracker up: they lie before `run.start_ns`. Late scans amend the tracks and are not yielded.
    """
    tracker = run.tracker()
    with threadpool_limits(1):  # sums in BLAS depend on how many threads share them
        for frame in run.frames():
            if frame.late:
                amend(tracker, frame, run.refusals)
                continue
            candidates = tracker.explain(frame)
            measurements, tracks = tracker.step(frame)
            labels = tracker.labels()
            at_s = (frame.log_time_ns - run.reader.start_ns) / 1e9
            yield inspect(frame, candidates, measurements, tracks, labels, run.settings.tracking, at_s=at_s)


def inspect(
    frame: SyncedFrame,
    candidates: tuple[Candidate, ...],
    measurements: Measurements,
    tracks: TrackFrame,
    labels: LabelReport,
    settings: TrackingSettings,
    *,
    at_s: float,
) -> Inspected:
    """Returns a tracked frame with the report of it.

    Args:
        frame: the frame.
        candidates: boxes and clusters that were compared.
        measurements: what fusion made of it.
        tracks: published after it.
        labels: all the tracker's labels after it.
        settings: that all this was done with.
        at_s: seconds into the log.
    """
    view = _View(frame)
    clusters = tuple(_clusters(frame, view, candidates, measurements, labels, settings))
    truth = frame.ground_truth
    report = FrameReport(
        at_s,
        frame.sensors.stamp_ns,
        frame.epoch,
        tuple(sorted(camera.name for camera in frame.sensors.cameras)),
        len(tracks.tracks),
        tuple(sorted(clusters, key=lambda c: c.range_m)),
        tuple(_boxes(frame, candidates, clusters, settings.fusion)),
        _unmeasured(view, labels),
        None if truth is None else _people(view, truth, tracks, measurements, clusters),
    )
    return Inspected(frame, candidates, measurements, tracks, labels, clusters, report)


class _View:
    """Places of the odometry frame as the vehicle sees them."""

    def __init__(self, frame: SyncedFrame):
        self._map_from_vehicle = frame.sensors.map_from_vehicle
        self._map_from_lidar = frame.sensors.map_from_lidar

    def of(self, positions_m: FloatArray) -> FloatArray:
        """Returns ahead and left (N, 2) of positions (N, 2), on the plane that the vehicle stands on."""
        heights = ground_heights(self._map_from_vehicle, positions_m, 0.0)
        places: FloatArray = apply(inverse(self._map_from_vehicle), np.column_stack([positions_m, heights]))[:, :2]
        return places

    def of_lidar(self, points_m: FloatArray) -> FloatArray:
        """Returns ahead and left (N, 2) of the LiDAR's points (N, 3); what is not finite counts as 0."""
        points_m = np.where(np.isfinite(points_m), points_m, 0.0)
        places: FloatArray = apply(inverse(self._map_from_vehicle) @ self._map_from_lidar, points_m)[:, :2]
        return places


def _clusters(
    frame: SyncedFrame,
    view: _View,
    candidates: Sequence[Candidate],
    measurements: Measurements,
    labels: LabelReport,
    settings: TrackingSettings,
) -> list[ClusterReport]:
    sensors, scan = frame.sensors, frame.sensors.clusters
    sound = place(sensors, np.flatnonzero(sound_clusters(sensors)))
    by_size = dict(zip(sound.index.tolist(), size_log_odds(sound, settings.fusion).tolist(), strict=True))
    near = _near_misses(frame, candidates, settings.fusion)
    fits = {(c.camera, c.box): (c.likeness, c.overlap, c.height_log_ratio) for c in candidates if c.matched}
    owner: dict[int, int] = {}  # the oldest counts: a label may be born at a measurement that is a track's
    for label, row in enumerate(labels.measurement.tolist()):
        owner.setdefault(row, label)
    places = view.of(measurements.positions_m)
    index = measurements.cluster_index.tolist()
    reports, seen = [], dict.fromkeys(index, 0)
    for row, cluster in enumerate(index):
        evidence = measurements.evidence[row] if measurements.evidence else ()
        outcome, reason = _outcome(row, owner.get(row), measurements, labels, settings.tracker)
        ahead, left = places[row].tolist()
        width, height, points = _size(scan.sizes_m[cluster], scan.points[cluster]) if cluster >= 0 else (0.0, 0.0, 0)
        reports.append(
            ClusterReport(
                cluster,
                seen[cluster],
                index.count(cluster) if cluster >= 0 else 1,
                ahead,
                left,
                float(np.hypot(ahead, left)),
                points,
                width,
                height,
                by_size.get(cluster),
                tuple(BoxScore(*found, *fits.get((found.camera, found.box), ())) for found in evidence),
                tuple(near.get(cluster, ())),
                float(measurements.pedestrian_probability[row]),
                outcome,
                labels.names[owner[row]] if row in owner else None,
                int(labels.ids[owner[row]]) if row in owner else 0,
                reason,
            )
        )
        seen[cluster] += 1
    refused = measurements.refused_cluster_index
    refused = refused[refused >= 0]  # a camera's own has no cluster to tell of
    places = view.of_lidar(scan.centroids_m[refused])
    return reports + [
        _refused(*row) for row in zip(refused.tolist(), places.tolist(), scan.points[refused], strict=True)
    ]


def _size(size_m: FloatArray, points: int) -> tuple[float, float, int]:
    return float(np.hypot(size_m[0], size_m[1])), float(size_m[2]), int(points)


def _refused(cluster: int, place_m: Sequence[float], points: int) -> ClusterReport:
    """Returns the report of a cluster that is not finite, or impossible; its numbers are not to be trusted."""
    x, y = place_m
    return ClusterReport(
        cluster, 0, 1, x, y, float(np.hypot(x, y)), int(points), 0.0, 0.0, None, (), (), None,
        Outcome.REFUSED, None, 0, "refused: out of reach, or of an impossible shape",
    )  # fmt: skip


def _outcome(
    row: int, label: int | None, measurements: Measurements, labels: LabelReport, params: TrackerParams
) -> tuple[Outcome, str]:
    """Returns what became of the measurement at `row`, owned by `label`, and why."""
    probability = float(measurements.pedestrian_probability[row])
    if label is None:
        if not measurements.gives_birth[row]:
            return Outcome.ONE_CAMERA, "no cluster near; one camera alone gives no birth"
        if probability < params.filter.least_pedestrian_probability:
            return (
                Outcome.NO_BIRTH,
                f"gives no birth: {_two(probability)} < {_two(params.filter.least_pedestrian_probability)}",
            )
        return Outcome.CLUTTER, f"clutter: {_explained_by(row, measurements, labels)}"
    number, hits = int(labels.ids[label]), int(labels.hits[label])
    was = f" (was track {number})" if number else ""
    existence, pedestrian = float(labels.existence[label]), float(labels.pedestrian[label])
    too_few = f"{hits} hit{'s' * (hits != 1)} of {params.confirm_hits}"
    unlikely = f"existence {_two(existence)} < {_two(params.confirm_existence)}{was}"
    return {
        Verdict.PUBLISHED: (Outcome.TRACKED, f"track {number}"),
        Verdict.UNCONFIRMED: (
            Outcome.UNCONFIRMED,
            f"unconfirmed: {too_few if hits < params.confirm_hits else unlikely}",
        ),
        Verdict.FADED: (
            Outcome.FADED,
            f"faded: existence {_two(existence)} < {_two(params.publish_existence)}{was}",
        ),
        Verdict.NO_PEDESTRIAN: (
            Outcome.NO_PEDESTRIAN,
            f"no pedestrian: {_two(pedestrian)} < {_two(params.pedestrian_probability)}{was}",
        ),
    }[Verdict(labels.verdict[label])]


def _explained_by(row: int, measurements: Measurements, labels: LabelReport) -> str:
    """Returns why a measurement that might be a person's gave no label: a track beside it explains it."""
    distances = np.linalg.norm(labels.states[:, :2] - measurements.positions_m[row], axis=1)
    if len(distances) == 0 or distances.min() > 1.5:
        return "too unlikely for a birth"
    nearest = int(distances.argmin())
    what = f"track {labels.ids[nearest]}" if labels.ids[nearest] else "a label without a track"
    other = int(labels.measurement[nearest])
    took = f", which took cluster {measurements.cluster_index[other]}" if other >= 0 else ""
    return f"{distances[nearest]:.1f} m from {what}{took}"


def _near_misses(
    frame: SyncedFrame, candidates: Sequence[Candidate], params: FusionParams
) -> Mapping[int, list[NearMiss]]:
    """Returns cluster -> boxes that touch it and are not its own."""
    scores = {camera.name: camera.detections.scores for camera in frame.sensors.cameras}
    cluster_of = {(c.camera, c.box): c.cluster for c in candidates if c.matched}
    found: dict[int, dict[tuple[str, int], NearMiss]] = {}
    for c in candidates:
        went_to = cluster_of.get((c.camera, c.box))
        if went_to != c.cluster:
            _, refused = _gate(c, params)
            why = refused or ("another box fits better" if went_to is None else f"went to cluster {went_to}")
            score = float(scores[c.camera][c.box])
            miss = NearMiss(c.camera, c.box, score, c.likeness, c.overlap, c.height_log_ratio, why)
            found.setdefault(c.cluster, {})[c.camera, c.box] = miss
    return {cluster: list(misses.values()) for cluster, misses in found.items()}


def _gate(candidate: Candidate, params: FusionParams) -> tuple[Unmatched, str]:
    """Returns which gate of fusion refused a pair, and in words; no words if none did."""
    if candidate.likeness > 0:
        return Unmatched.LOST, ""
    if abs(candidate.height_log_ratio) >= params.max_height_log_ratio:
        most = _two(params.max_height_log_ratio)
        beyond = f"> {most}" if candidate.height_log_ratio > 0 else f"< -{most}"
        return Unmatched.HEIGHT, f"height log ratio {_two(candidate.height_log_ratio)} {beyond}"
    if candidate.overlap < params.min_overlap:
        return Unmatched.OVERLAP, f"overlap {_two(candidate.overlap)} < {_two(params.min_overlap)}"
    return Unmatched.APART, "one above the other"


def _boxes(
    frame: SyncedFrame, candidates: Sequence[Candidate], clusters: Sequence[ClusterReport], params: FusionParams
) -> Iterator[BoxReport]:
    """Yields a report of each pedestrian box."""
    measured = {(found.camera, found.box): cluster for cluster in clusters for found in cluster.boxes}
    box_of = {(c.camera, c.cluster): c.box for c in candidates if c.matched}
    best: dict[tuple[str, int], Candidate] = {}  # the cluster that fits each box best, or nearly did
    for c in candidates:
        known = best.get((c.camera, c.box))
        if known is None or (c.likeness, c.overlap) > (known.likeness, known.overlap):
            best[c.camera, c.box] = c
    for camera in sorted(frame.sensors.cameras, key=lambda camera: camera.name):
        found = camera.detections
        for box in [i for i, label in enumerate(found.labels) if label in params.pedestrian_labels]:
            cluster, near = measured.get((camera.name, box)), best.get((camera.name, box))
            outcome, why = Unmatched.NO_CLUSTER.value, "no cluster near"
            if cluster is not None:
                outcome, why = cluster.outcome.value, cluster.reason
            elif near is not None:
                gate, refused = _gate(near, params)
                other = box_of.get((camera.name, near.cluster))
                lost = f"lost to box {other}" if other is not None else "not chosen"
                outcome, why = gate.value, f"cluster {near.cluster}: {refused or lost}"
            x0, y0, x1, y1 = found.boxes_px[box].tolist()
            where = None if cluster is None else cluster.cluster
            yield BoxReport(camera.name, box, float(found.scores[box]), (x0, y0, x1, y1), where, outcome, why)


def _unmeasured(view: _View, labels: LabelReport) -> tuple[TrackReport, ...]:
    rows = np.flatnonzero((labels.verdict == Verdict.PUBLISHED) & (labels.measurement < 0))
    return tuple(
        TrackReport(int(labels.ids[row]), ahead, left, float(labels.existence[row]), float(labels.hidden[row]))
        for row, (ahead, left) in zip(rows, view.of(labels.states[rows, :2]).tolist(), strict=True)
    )


def _people(
    view: _View,
    truth: GroundTruthFrame,
    tracks: TrackFrame,
    measurements: Measurements,
    clusters: Sequence[ClusterReport],
) -> tuple[PersonReport, ...]:
    person_of = match(tracks.tracks, truth).tolist()
    track_of = {person: track.id for track, person in zip(tracks.tracks, person_of, strict=True) if person >= 0}
    distances = np.linalg.norm(truth.positions_m[:, None] - measurements.positions_m, axis=-1)  # (A, M)
    people = []
    for a, (ahead, left) in enumerate(view.of(truth.positions_m).tolist()):
        person = int(truth.ids[a])
        points, track = int(truth.lidar_points[a]), track_of.get(person, 0)
        miss, reason = None, f"track {track}"
        if not track:
            miss, reason = _why_missed(a, truth, distances, clusters, person_of, tracks)
        people.append(PersonReport(person, ahead, left, float(np.hypot(ahead, left)), points, track, miss, reason))
    return tuple(sorted(people, key=lambda p: p.range_m))


def _why_missed(
    a: int,
    truth: GroundTruthFrame,
    distances: FloatArray,
    clusters: Sequence[ClusterReport],
    person_of: Sequence[int],
    tracks: TrackFrame,
) -> tuple[str, str]:
    """Returns why person `a` has no track.

    Args:
        a: row of the ground truth.
        truth: the ground truth.
        distances: (A, M) between people and measurements.
        clusters: a report for each measurement, in their order, and then for the refused ones.
        person_of: whom each track stands for.
        tracks: the published tracks.
    """
    points = int(truth.lidar_points[a])
    if points < MIN_LIDAR_POINTS:
        return Miss.FEW_POINTS, f"{points} LiDAR points"
    M = distances.shape[1]
    reach = distances[a] - np.array([max(c.width_m - 0.5, 0.0) / 2 for c in clusters[:M]])  # a wide one reaches further
    nearest = int(reach.argmin()) if M else -1
    if nearest < 0 or reach[nearest] > NEAR_M:
        gap = f", the nearest is {distances[a].min():.1f} m away" if M else " at all"
        return Miss.NO_CLUSTER, f"no cluster within {NEAR_M} m{gap}"
    cluster = clusters[nearest]
    closest = int(distances[:, nearest].argmin())
    name = f"cluster {cluster.cluster}" if cluster.cluster >= 0 else "a camera's measurement"
    if cluster.outcome is not Outcome.TRACKED:
        shared = f", shared with person {truth.ids[closest]}" if closest != a else ""
        return cluster.outcome, f"{name}: {cluster.reason}{shared}"
    stands_for = next((p for t, p in zip(tracks.tracks, person_of, strict=True) if t.id == cluster.track_id), -1)
    if stands_for >= 0:
        return Miss.SHARED, f"{name} is person {stands_for}'s, too: track {cluster.track_id}"
    return Miss.OTHER_PLACE, f"{name} is track {cluster.track_id}'s, which is over 1 m away"


def _two(value: float) -> str:
    """Shows a probability or ratio: .12, -.51, 1.00."""
    return f"{value:.2f}".replace("0.", ".", 1) if abs(value) < 0.995 else f"{value:.2f}"
