"""Two people in one cluster: split where boxes say so, and only there."""

from dataclasses import replace

import numpy as np
import pytest

from tracking.fusion import FusionParams, fuse
from tracking.measurements import no_predicted_tracks

PARAMS = FusionParams()
NOBODY = no_predicted_tracks()


def merged(frame, width_m=None):
    """The frame with all its clusters in one, as a clustering that cannot tell people apart gives it."""
    c = frame.clusters
    low, high = (c.centroids_m - c.sizes_m / 2).min(axis=0), (c.centroids_m + c.sizes_m / 2).max(axis=0)
    size = high - low if width_m is None else np.array([width_m, width_m, 1.6])
    one = replace(
        c, centroids_m=c.centroids_m.mean(axis=0, keepdims=True), sizes_m=size[None], points=c.points.sum(keepdims=True)
    )
    return replace(frame, clusters=one)


def with_boxes(frame, change):
    """The frame with every camera's boxes (N, 4) changed."""
    cameras = []
    for camera in frame.cameras:
        boxes = change(camera.detections.boxes_px)
        d = replace(camera.detections, boxes_px=boxes, scores=np.full(len(boxes), 0.9), labels=("person",) * len(boxes))
        cameras.append(replace(camera, detections=d))
    return replace(frame, cameras=tuple(cameras))


@pytest.mark.parametrize("bearing_rad", [0.0, 0.4, 1.5, -2.5])
@pytest.mark.parametrize("range_m", [6.0, 14.0])
def test_two_people_side_by_side_are_two_measurements_where_they_stand(world, bearing_rad, range_m):
    ahead, left = (
        np.array([np.cos(bearing_rad), np.sin(bearing_rad)]),
        np.array([-np.sin(bearing_rad), np.cos(bearing_rad)]),
    )
    people = np.array([range_m * ahead + 0.22 * left, range_m * ahead - 0.22 * left])
    scan = fuse(merged(world.frame(people)), NOBODY, PARAMS)
    assert scan.cluster_index.tolist() == [0, 0]
    distances = np.linalg.norm(people[:, None] - scan.positions_m, axis=-1)
    assert (distances.min(axis=1) < 0.12).all()
    assert sorted(distances.argmin(axis=1)) == [0, 1]
    boxes = [{(e.camera, e.box) for e in evidence} for evidence in scan.evidence]
    assert all(boxes)
    assert not boxes[0] & boxes[1]
    assert (scan.pedestrian_probability > 0.7).all()


def test_three_in_a_row_are_three(world):
    people = np.array([[8.0, -0.42], [8.0, 0.0], [8.0, 0.42]])
    scan = fuse(merged(world.frame(people)), NOBODY, PARAMS)
    assert len(scan) == 3
    assert np.abs(np.sort(scan.positions_m[:, 1]) - people[:, 1]).max() < 0.15


def test_parts_are_less_certain_than_a_cluster_of_its_own(world):
    people = np.array([[8.0, 0.22], [8.0, -0.22]])
    apart, together = fuse(world.frame(people), NOBODY, PARAMS), fuse(merged(world.frame(people)), NOBODY, PARAMS)
    assert (together.covariances_m2[:, 0, 0] > apart.covariances_m2[:, 0, 0]).all()


def test_one_box_does_not_split(world):
    frame = merged(world.frame([[8.0, 0.22], [8.0, -0.22]], boxes_for=[0]))
    assert len(fuse(frame, NOBODY, PARAMS)) == 1


def test_two_boxes_of_one_person_do_not_split(world):
    frame = with_boxes(
        merged(world.frame([[8.0, 0.0]]), width_m=0.6), lambda boxes: np.concatenate([boxes, boxes + 4.0])
    )
    assert len(fuse(frame, NOBODY, PARAMS)) == 1


def test_what_is_as_wide_as_a_car_is_not_split(world):
    frame = merged(world.frame([[8.0, 0.4], [8.0, -0.4]]), width_m=3.0)
    assert len(fuse(frame, NOBODY, replace_params(camera_only=False))) == 1


def test_people_with_clusters_of_their_own_are_left_alone(world):
    people = [[8.0, 0.5], [8.0, -0.5]]
    a, b = (
        fuse(world.frame(people), NOBODY, PARAMS),
        fuse(world.frame(people), NOBODY, replace_params(wide_for_two_m=99.0)),
    )
    assert np.array_equal(a.positions_m, b.positions_m)
    assert a.evidence == b.evidence


def test_the_order_of_boxes_does_not_matter(world):
    frame = merged(world.frame([[8.0, 0.22], [8.0, -0.22]]))
    a, b = fuse(frame, NOBODY, PARAMS), fuse(with_boxes(frame, lambda boxes: boxes[::-1]), NOBODY, PARAMS)
    assert np.array_equal(a.positions_m, b.positions_m)
    assert np.array_equal(a.pedestrian_probability, b.pedestrian_probability)


def replace_params(**changes):
    return PARAMS.model_copy(update=changes)
