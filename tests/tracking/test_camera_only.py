"""People without a cluster: where their boxes meet the ground."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.messages import LidarClusters
from tests.tracking.conftest import render_box, world_all_round
from tracking.fusion import FusionParams, fuse
from tracking.geometry import transform_matrix
from tracking.measurements import no_predicted_tracks
from tracking.pipeline import TrackingSettings, TrackingStage

PARAMS = FusionParams()
NOBODY = no_predicted_tracks()


def without_clusters(frame, keep=()):
    c, rows = frame.clusters, np.array(keep, np.int64)
    return replace(
        frame, clusters=LidarClusters(c.stamp_ns, c.frame_id, c.centroids_m[rows], c.sizes_m[rows], c.points[rows])
    )


@pytest.mark.parametrize("place", [[11.0, 1.0], [16.0, -3.0], [-14.0, 0.5]])
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_a_box_without_a_cluster_is_a_measurement_where_its_feet_are(world, place, yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    there = np.array([[c, -s], [s, c]]) @ place + [40.0, -10.0]
    pose = transform_matrix([40.0, -10.0, 1.5], [0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])
    frame = world.frame([there], map_from_vehicle=pose)
    grounded = PARAMS.model_copy(update={"ground_below_vehicle_m": 1.5})
    scan = fuse(without_clusters(frame), NOBODY, grounded)
    assert scan.cluster_index.tolist() == [-1]
    error = scan.positions_m[0] - there
    assert error @ np.linalg.solve(scan.covariances_m2[0], error) < 2
    assert np.hypot(*error) < 0.25
    assert scan.pedestrian_probability[0] > 0.8
    # long along the ray, short across it
    axes = np.linalg.eigh(scan.covariances_m2[0])
    sight = (there - [40.0, -10.0]) / np.linalg.norm(there - [40.0, -10.0])
    assert axes.eigenvalues[1] > 2 * axes.eigenvalues[0]
    assert abs(axes.eigenvectors[:, 1] @ sight) > 0.95


def test_two_cameras_boxes_of_one_person_are_one_measurement_that_may_be_born(world):
    """Half way between two cameras both see the person."""
    bearing = np.pi / 6
    frame = without_clusters(world.frame([[8 * np.cos(bearing), 8 * np.sin(bearing)]]))
    scan = fuse(frame, NOBODY, PARAMS)
    assert [len(evidence) for evidence in scan.evidence] == [2]
    assert scan.gives_birth.tolist() == [True]


def test_one_cameras_box_gives_no_birth_unless_it_is_allowed_to(world):
    frame = without_clusters(world.frame([[8.0, 0.0]]))
    assert fuse(frame, NOBODY, PARAMS).gives_birth.tolist() == [False]
    allowed = PARAMS.model_copy(update={"camera_births": True})
    assert fuse(frame, NOBODY, allowed).gives_birth.tolist() == [True]


def test_a_box_that_may_be_a_clusters_is_no_second_person(world):
    """The box is too tall for the cluster, so it does not match; but it is at the same place."""
    frame = world.frame([[8.0, 0.0]])
    cameras = []
    for camera in frame.cameras:
        boxes = camera.detections.boxes_px.copy()
        boxes[:, 1] -= 0.6 * (boxes[:, 3] - boxes[:, 1])
        cameras.append(replace(camera, detections=replace(camera.detections, boxes_px=boxes)))
    scan = fuse(replace(frame, cameras=tuple(cameras)), NOBODY, PARAMS)
    assert scan.cluster_index.tolist() == [0]
    assert scan.evidence == ((),)


def test_a_box_cut_by_the_images_border_has_no_feet(world):
    frame = without_clusters(world.frame([[2.0, 0.0]]))
    height = frame.cameras[0].model.height_px
    assert any((camera.detections.boxes_px[:, 3] == height).any() for camera in frame.cameras)
    assert len(fuse(frame, NOBODY, PARAMS)) == 0


def test_it_can_be_turned_off(world):
    frame = without_clusters(world.frame([[8.0, 0.0]]))
    assert len(fuse(frame, NOBODY, PARAMS.model_copy(update={"camera_only": False}))) == 0


def walk(world, settings, lost):
    """Someone crosses 14 m ahead, in one camera's view; the LiDAR loses them after `lost` scans. Ids and errors."""
    stage = TrackingStage(settings)
    ids, errors = [], []
    for k in range(40):
        place = np.array([[14.0, -1.2 + 0.06 * k]])
        frame = world.frame(place, stamp_ns=(k + 1) * 100_000_000, seed=k)
        tracks = stage.step(frame if k < lost else without_clusters(frame)).tracks
        ids.append([track.id for track in tracks])
        errors.append(min((np.hypot(*(track.state[:2] - place[0])) for track in tracks), default=np.inf))
    return ids, errors


def test_boxes_keep_a_track_alive_that_the_lidar_has_lost(world):
    ids, errors = walk(world, TrackingSettings(), lost=15)
    assert ids[14] == ids[39] != []
    assert max(errors[5:]) < 0.7
    blind = TrackingSettings(fusion=FusionParams(camera_only=False))
    assert walk(world, blind, lost=15)[0][39] == []


def test_boxes_alone_give_tracks_only_if_births_are_allowed(world):
    allowed = TrackingSettings(fusion=FusionParams(camera_births=True))
    assert walk(world, TrackingSettings(), lost=0)[0][39] == []
    ids, errors = walk(world, allowed, lost=0)
    assert len(ids[39]) == 1
    assert ids[39] == ids[10]
    assert errors[39] < 0.7


@pytest.mark.parametrize("count", [12, 20])
def test_a_person_whom_several_cameras_see_is_one_however_many(count):
    world = world_all_round(count)
    frame = without_clusters(world.frame([[9.0, 2.0]]))
    seen = sum(len(camera.detections.boxes_px) for camera in frame.cameras)
    border = [c.detections.boxes_px for c in frame.cameras if len(c.detections.boxes_px)]
    cut = sum(boxes[0, 0] < 3 or boxes[0, 2] > 1917 for boxes in border)
    assert seen - cut >= 3
    scan = fuse(frame, NOBODY, PARAMS)
    assert [len(evidence) for evidence in scan.evidence] == [seen - cut]


def test_rays_that_are_nearly_one_give_no_birth(world):
    """A second camera 10 cm beside the first sees the same box; it adds nothing about how far away."""
    frame = without_clusters(world.frame([[14.0, 0.0]]))
    (camera,) = (c for c in frame.cameras if len(c.detections.boxes_px))
    shift = np.eye(4)
    shift[0, 3] = 0.1
    people = render_box(camera.model, shift @ camera.camera_from_map, [14.0, 0.0])
    twin = replace(
        camera,
        name="twin",
        camera_from_map=shift @ camera.camera_from_map,
        detections=replace(camera.detections, boxes_px=np.array([people])),
    )
    alone, both = fuse(frame, NOBODY, PARAMS), fuse(replace(frame, cameras=(*frame.cameras, twin)), NOBODY, PARAMS)
    assert [len(evidence) for evidence in both.evidence] == [2]
    assert both.gives_birth.tolist() == [False]
    assert np.linalg.eigvalsh(both.covariances_m2[0])[1] > 0.8 * np.linalg.eigvalsh(alone.covariances_m2[0])[1]
