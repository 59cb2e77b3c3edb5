"""Geometry of what is drawn."""

from dataclasses import replace

import numpy as np
import pytest

from replay.drawing import (
    PERSON_HEIGHT_M,
    PERSON_RADIUS_M,
    dashes,
    drawn_steps,
    mixture_ellipses,
    modal_paths,
    people_in_image,
    split_by_fallback,
    vehicle_outline,
)
from schemas.messages import CameraCalibration, CameraDetections, Mixture, ModalPath, Prediction
from tests.replay.view_scenes import START_NS, crowd, yaw_transform
from tracking.camera import CameraModel
from tracking.sensor_frame import CameraFrame

# looks along map x from 1 m above the ground: image x is map -y, image y is map -z
CAMERA_FROM_MAP = np.array([[0, -1, 0, 0], [0, 0, -1, 1.0], [1, 0, 0, 0], [0, 0, 0, 1]], float)


def make_camera(stamp_ns: int = START_NS) -> CameraFrame:
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    model = CameraModel.from_calibration(CameraCalibration(START_NS, "c", 640, 480, "plumb_bob", np.zeros(5), K))
    detections = CameraDetections(stamp_ns, "c", np.zeros((0, 4)), np.zeros(0), ())
    return CameraFrame("A0", detections, model, CAMERA_FROM_MAP)


def make_prediction(track_id: int, *mixture: np.ndarray, paths: tuple[ModalPath, ...] = ()) -> Prediction:
    return Prediction(track_id, False, paths or (ModalPath(1.0, np.zeros((2, 2))),), Mixture(*mixture))


def test_person_straight_ahead_fills_the_box_pinhole_geometry_says():
    boxes, index = people_in_image(make_camera(), np.array([[10.0, 0, 0, 0]]), START_NS, ground_m=0.0)
    near = 10 - PERSON_RADIUS_M
    assert index.tolist() == [0]
    assert boxes[0, 3] == pytest.approx(240 + 500 * 1.0 / near)  # feet, at the nearest edge
    assert boxes[0, 1] == pytest.approx(240 - 500 * (PERSON_HEIGHT_M - 1) / near)
    assert boxes[0, [0, 2]] == pytest.approx([320 - 15, 320 + 15], abs=0.6)


def test_person_is_moved_to_the_cameras_own_stamp():
    walking = np.array([[10.0, 0.0, 0.0, 2.0]])
    late, _ = people_in_image(make_camera(START_NS + 50_000_000), walking, START_NS, 0.0)
    there, _ = people_in_image(make_camera(), np.array([[10.0, 0.1, 0, 0]]), START_NS, 0.0)
    np.testing.assert_allclose(late, there)


def test_people_behind_beside_and_too_near_have_no_box():
    states = np.array([[-5.0, 0, 0, 0], [10, 20, 0, 0], [0.2, 0, 0, 0], [10, 0, 0, 0]])
    _, index = people_in_image(make_camera(), states, START_NS, 0.0)
    assert index.tolist() == [3]
    boxes, index = people_in_image(make_camera(), np.zeros((0, 4)), START_NS, 0.0)
    assert boxes.shape == (0, 4)
    assert len(index) == 0


def test_box_ends_at_the_images_border():
    boxes, _ = people_in_image(make_camera(), np.array([[1.5, 0.9, 0, 0]]), START_NS, 0.0)
    assert boxes[0, 0] == 0
    assert boxes[0, 3] == 480


def test_ellipse_of_a_component_has_its_covariances_axes():
    rng = np.random.default_rng(1)
    sigmas, rhos = rng.uniform(0.1, 2, (3, 4, 2)), rng.uniform(-0.95, 0.95, (3, 4))
    means = rng.normal(size=(3, 4, 2))
    ellipses = mixture_ellipses([make_prediction(7, np.full((3, 4), 0.25), means, sigmas, rhos)], (0, 1, 2), 0.0)
    for k, (s, rho) in enumerate(zip(sigmas.reshape(-1, 2), rhos.ravel(), strict=True)):
        covariance = np.array([[s[0] ** 2, rho * s[0] * s[1]], [rho * s[0] * s[1], s[1] ** 2]])
        c, d = np.cos(ellipses.yaws_rad[k]), np.sin(ellipses.yaws_rad[k])
        R = np.array([[c, -d], [d, c]])
        np.testing.assert_allclose(R @ np.diag(ellipses.half_axes_m[k] ** 2) @ R.T, covariance, atol=1e-12)
    np.testing.assert_array_equal(ellipses.centres_m, means.reshape(-1, 2))
    assert (ellipses.half_axes_m[:, 0] >= ellipses.half_axes_m[:, 1]).all()


def test_light_components_and_missing_steps_are_left_out():
    weights = np.array([[0.9, 0.1], [0.95, 0.05]])
    short = make_prediction(1, weights, np.zeros((2, 2, 2)), np.ones((2, 2, 2)), np.zeros((2, 2)))
    ellipses = mixture_ellipses([short], (1, 5), 0.08)
    assert ellipses.weights.tolist() == [0.95]
    assert mixture_ellipses([], (1,), 0.1).centres_m.shape == (0, 2)


def test_mixtures_of_different_size_are_drawn_together():
    one = make_prediction(1, np.ones((2, 1)), np.zeros((2, 1, 2)), np.ones((2, 1, 2)), np.zeros((2, 1)))
    many = make_prediction(2, np.full((2, 4), 0.25), np.zeros((2, 4, 2)), np.ones((2, 4, 2)), np.zeros((2, 4)))
    assert mixture_ellipses([one, many], (-1,), 0.0).track_ids.tolist() == [1, 2, 2, 2, 2]


def test_paths_begin_at_their_track_and_the_likeliest_comes_last():
    result = next(crowd(people=8))
    paths = modal_paths(result.tracks, result.predictions.predictions)
    places = {track.id: track.state[:2] for track in result.tracks.tracks}
    for strip, number in zip(paths.strips_m(), paths.track_ids, strict=True):
        np.testing.assert_array_equal(strip[0], places[number])
    assert (np.diff(paths.probabilities) >= 0).all()
    assert paths.lengths.sum() == len(paths.points_m)


def test_a_path_without_its_track_begins_at_its_first_point():
    result = next(crowd(people=3))
    paths = modal_paths(replace(result.tracks, tracks=()), result.predictions.predictions)
    assert set(paths.lengths.tolist()) == {12}
    assert modal_paths(result.tracks, ()).strips_m() == []


def test_dashes_cover_their_share_of_a_line():
    strip = np.array([[0.0, 0], [3, 0], [3, 10]])
    cut = dashes(strip, dash_m=0.5, gap_m=0.5)
    assert cut.shape == (13, 2, 2)
    assert np.hypot(*(cut[:, 1] - cut[:, 0]).T).sum() == pytest.approx(6.5)
    np.testing.assert_allclose(cut[3], [[3, 0], [3, 0.5]])
    assert len(dashes(np.zeros((4, 2)))) == 0


def test_vehicle_outline_points_where_the_vehicle_does():
    outline = vehicle_outline(yaw_transform(10, 20, 0, np.pi / 2))
    np.testing.assert_array_equal(outline[0], outline[-1])
    ahead = outline[2] - [10, 20]
    assert ahead[1] > 2
    assert abs(ahead[0]) < 1e-9


@pytest.mark.parametrize(("steps", "drawn"), [(12, (5, 11)), (4, (1, 3)), (3, (2,)), (1, (0,))])
def test_steps_drawn(steps, drawn):
    mixture = (np.ones((steps, 1)), np.zeros((steps, 1, 2)), np.ones((steps, 1, 2)), np.zeros((steps, 1)))
    frame = replace(next(crowd(people=1)).predictions, predictions=(make_prediction(1, *mixture),))
    assert drawn_steps(frame) == drawn
    assert drawn_steps(replace(frame, predictions=())) == ()


def test_fallbacks_are_told_apart():
    predicted, fallback = split_by_fallback(next(crowd(people=18)).predictions.predictions)
    assert [p.track_id for p in fallback] == [9, 18]
    assert len(predicted) == 16
