"""Late fusion: LiDAR clusters and camera boxes -> position measurements with a covariance and a class probability.

One measurement per person: one whom two cameras see is still one, and a cluster that boxes show to be two is two.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from schemas.messages import FloatArray, IntArray
from tracking.box_matching import Boxes, CameraView, look, pedestrian_boxes
from tracking.camera_only import GroundPoints, ground_points, lonely_boxes
from tracking.cluster_splitting import split_clusters
from tracking.clusters import Clusters, place, positions, size_log_odds, sound_clusters
from tracking.fusion_params import FusionParams
from tracking.geometry import ground_heights
from tracking.measurements import CameraEvidence, Measurements, PredictedTracks, make_measurements
from tracking.sensor_frame import CameraFrame, SensorFrame
from tracking.visibility import hidden_share

__all__ = ["CameraEvidence", "Candidate", "FusionParams", "Measurements", "PredictedTracks", "explain", "fuse"]


def fuse(frame: SensorFrame, predicted: PredictedTracks, params: FusionParams) -> Measurements:
    """Returns one measurement per person-like part of a LiDAR cluster, with what the cameras say of it.

    Args:
        frame: one scan with the cameras' detections around it, poses resolved.
        predicted: where the tracker expects people at the scan's stamp; clusters near them move with their velocity
            to each camera's own stamp.
        params: settings.

    Returns:
        Measurements in the odometry frame; the order of clusters, cameras and boxes does not matter. Clusters that are
        not finite are left out and counted as `refused`.
    """
    sound = sound_clusters(frame)
    scene = _scene(frame, place(frame, np.flatnonzero(sound)), predicted, params)
    log_odds, evidence = _evidence(scene, params)
    total = np.minimum(np.maximum(log_odds, -params.max_log_odds), params.max_log_odds) + scene.person_like
    seen = _CameraOnly.of(frame, scene, params)
    M, K = len(scene.clusters), len(seen.places.boxes)
    measurements = make_measurements(
        np.concatenate([scene.positions_m, seen.places.positions_m]),
        np.concatenate([scene.covariances_m2, seen.places.covariances_m2]),
        1 / (1 + np.exp(-np.concatenate([total, seen.log_odds]))),
        np.concatenate([scene.clusters.index, np.full(K, -1)]),
        [*evidence, *seen.evidence],
        np.concatenate([np.ones(M, bool), seen.places.crossed | params.camera_births]),
    )
    return _refuse(measurements, np.flatnonzero(~sound))


class Candidate(NamedTuple):
    """A box and a cluster that touch in a camera's image, and what came of it."""

    camera: str
    box: int  # row in the camera's message
    cluster: int  # row in the scan
    overlap: float  # horizontal, intersection over union
    height_log_ratio: float  # of the box to the person that the cluster would be
    likeness: float  # how well they fit; 0 past the gates
    matched: bool


def explain(frame: SensorFrame, predicted: PredictedTracks, params: FusionParams) -> tuple[Candidate, ...]:
    """Returns which boxes and clusters `fuse` compared in this frame, and which it put together: to look into."""
    scene = _scene(frame, place(frame, np.flatnonzero(sound_clusters(frame))), predicted, params)
    boxes, pairs = scene.view.boxes, scene.view.pairs
    return tuple(
        Candidate(
            scene.cameras[boxes.camera[box]].name,
            int(boxes.rows[box]),
            int(scene.clusters.index[pairs.cluster[p]]),
            float(pairs.overlap[p]),
            float(pairs.height_log_ratio[p]),
            float(pairs.likeness[p]),
            bool(scene.view.matched[p]),
        )
        for p, box in enumerate(pairs.box)
    )


@dataclass(frozen=True, eq=False)
class _Scene:
    """Clusters as people, and what the cameras see of them."""

    cameras: tuple[CameraFrame, ...]  # sorted by name
    clusters: Clusters
    positions_m: FloatArray  # (M, 2)
    covariances_m2: FloatArray  # (M, 2, 2)
    person_like: FloatArray  # (M,)  log-odds by size alone
    visible: FloatArray  # (M,)  share that nothing nearer hides
    moved_m: FloatArray  # (C, M, 2)  at the cameras' stamps
    view: CameraView


def _scene(frame: SensorFrame, clusters: Clusters, predicted: PredictedTracks, params: FusionParams) -> _Scene:
    """Looks at the clusters through the cameras, and once more where that showed some of them to be several people."""
    cameras = tuple(sorted(frame.cameras, key=lambda camera: camera.name))
    boxes = pedestrian_boxes(cameras, params.pedestrian_labels)
    scene = _look(frame, cameras, boxes, clusters, predicted, params)
    split = split_clusters(clusters, cameras, scene.moved_m, scene.view, params)
    return scene if split is None else _look(frame, cameras, boxes, split, predicted, params)


def _look(
    frame: SensorFrame,
    cameras: tuple[CameraFrame, ...],
    boxes: Boxes,
    clusters: Clusters,
    predicted: PredictedTracks,
    params: FusionParams,
) -> _Scene:
    where, covs = positions(clusters, params, pose_extrapolated=frame.pose_extrapolated)
    person_like = size_log_odds(clusters, params)
    # The cameras stand close to the LiDAR, so what hides a cluster from it by half hides it from them by half.
    radii = 0.5 * np.maximum(clusters.sizes_m[:, 0], clusters.sizes_m[:, 1])
    covered = hidden_share(
        clusters.offsets_m, params.radius_m, clusters.offsets_m, radii, nearer_by_m=params.nearer_by_m
    )
    low = np.minimum(clusters.sizes_m[:, 2] / params.hiding_height_m, 1.0)  # what is low hides legs only
    visible = 1 - (covered * low[:, None]).max(axis=0, initial=0.0)
    rank = (0.2 + 0.8 * visible) / (1 + np.exp(-person_like - 1))
    delays_s = np.array([camera.detections.stamp_ns - frame.stamp_ns for camera in cameras]) * 1e-9
    moved = where + _velocities(where, predicted, params) * delays_s[:, None, None]  # (C, M, 2)
    view = look(cameras, boxes, moved, _ground(frame, clusters, params), rank, params)
    return _Scene(cameras, clusters, where, covs, person_like, visible, moved, view)


@dataclass(frozen=True, eq=False)
class _CameraOnly:
    """People whom only cameras see."""

    places: GroundPoints
    log_odds: FloatArray  # (K,)
    evidence: list[tuple[CameraEvidence, ...]]  # (K,)

    @classmethod
    def of(cls, frame: SensorFrame, scene: _Scene, params: FusionParams) -> "_CameraOnly":
        """Returns what the boxes that no cluster fits tell."""
        boxes = scene.view.boxes
        rows = lonely_boxes(scene.view) if params.camera_only else np.zeros(0, np.int64)
        places = ground_points(frame, scene.cameras, boxes, rows, scene.positions_m, params)
        for_it = _for_it(boxes.scores, params)
        evidence = [
            tuple(
                CameraEvidence(scene.cameras[boxes.camera[b]].name, int(boxes.rows[b]), float(boxes.scores[b]))
                for b in several
            )
            for several in places.boxes
        ]
        return cls(places, np.array([for_it[list(several)].sum() for several in places.boxes]), evidence)


def _for_it(scores: FloatArray, params: FusionParams) -> FloatArray:
    """Returns what a box of a score (B,) says for a person: log-odds."""
    p = np.minimum(np.maximum(scores, 0.01), 0.99)
    log_odds: FloatArray = np.log(p / (1 - p))
    return np.minimum(np.maximum(log_odds, params.min_box_log_odds), params.max_box_log_odds)


def _velocities(where: FloatArray, predicted: PredictedTracks, params: FusionParams) -> FloatArray:
    """Returns each cluster's velocity (M, 2): its nearest predicted track's, or none."""
    if len(predicted.positions_m) == 0:
        return np.zeros_like(where)
    x = where[:, 0, None] - predicted.positions_m[:, 0]
    y = where[:, 1, None] - predicted.positions_m[:, 1]
    squared = x * x + y * y  # (M, A)
    nearest = squared.argmin(axis=1)
    follows = squared[np.arange(len(where)), nearest] < params.follow_track_m**2
    return np.where(follows[:, None], predicted.velocities_mps[nearest], 0.0)


def _evidence(scene: _Scene, params: FusionParams) -> tuple[FloatArray, list[tuple[CameraEvidence, ...]]]:
    """Returns class log-odds summed over cameras (M,) and the boxes behind them."""
    M = len(scene.clusters)
    people, boxes, pairs = scene.view.people, scene.view.boxes, scene.view.pairs
    box, cluster = pairs.box[scene.view.matched], pairs.cluster[scene.view.matched]
    scores, camera = boxes.scores[box], boxes.camera[box]
    log_odds = np.bincount(cluster, _for_it(scores, params), M)
    matched = np.zeros((len(scene.cameras), M), bool)
    matched[camera, cluster] = True
    names = [camera.name for camera in scene.cameras]
    evidence: list[tuple[CameraEvidence, ...]] = [()] * M
    found = zip(cluster.tolist(), camera.tolist(), boxes.rows[box].tolist(), scores.tolist(), strict=True)
    for m, c, row, score in found:
        evidence[m] = (*evidence[m], CameraEvidence(names[c], row, score))
    # No box where a person should have one speaks against a person, as far as a detector could have found it: less if
    # the person is small in the image or partly hidden.
    height = people.corners_px[3] - people.corners_px[1]
    size = (height - params.min_height_px) / (params.full_height_px - params.min_height_px)
    expected = params.p_box * np.minimum(np.maximum(size, 0.0), 1.0) * _shown(scene.visible, params)[people.person]
    no_box = np.log((1 - expected) / (1 - np.minimum(params.p_box_other, expected)))
    proves = (people.share_inside >= params.min_in_image) & ~matched[people.camera, people.person]
    against = np.bincount(people.person[proves], no_box[proves], M).astype(float, copy=False)
    return log_odds + against, evidence


def _shown(visible: FloatArray, params: FusionParams) -> FloatArray:
    """Returns how well a detector finds people (M,) of whom a share is visible; half hidden ones it seldom does."""
    shown: FloatArray = np.minimum(np.maximum((visible - params.min_visible) / (1 - params.min_visible), 0.0), 1.0)
    return shown


def _ground(frame: SensorFrame, clusters: Clusters, params: FusionParams) -> FloatArray:
    """Returns the ground's height (M,) under each cluster: the vehicle's plane, unless the cluster contradicts it."""
    z = clusters.centroids_m[:, 2]
    if frame.map_from_vehicle[2, 2] < 0.5:  # lying on its side: there is no plane to speak of
        return z - params.height_m / 2
    plane = ground_heights(frame.map_from_vehicle, clusters.centroids_m[:, :2], params.ground_below_vehicle_m)
    ground: FloatArray = np.minimum(np.maximum(plane, z - 0.9 * params.height_m), z - 0.1 * params.height_m)
    return ground


def _refuse(measurements: Measurements, index: IntArray) -> Measurements:
    if len(index) == 0:
        return measurements
    m = measurements
    refused = np.sort(np.concatenate([m.refused_cluster_index, index]))
    return Measurements(
        m.positions_m,
        m.covariances_m2,
        m.pedestrian_probability,
        m.cluster_index,
        m.gives_birth,
        m.evidence,
        len(refused),
        refused,
    )
