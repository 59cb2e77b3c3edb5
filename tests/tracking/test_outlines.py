"""People's outlines against a plain loop over every camera and person, near and far, in and out of view."""

import numpy as np
import pytest

from schemas.messages import CameraDetections
from tracking.camera import CameraModel
from tracking.geometry import apply, inverse
from tracking.outlines import outlines
from tracking.sensor_frame import CameraFrame

RADIUS_M, HEIGHT_M = 0.3, 1.75
PINHOLE = CameraModel(1280, 720, 700, 710, 600, 380, "plumb_bob", np.array([-0.2, 0.05, 0.001, -0.002, 0.0]))
RATIONAL = CameraModel(
    1280, 720, 900, 900, 640, 360, "rational_polynomial", np.array([0.3, 0.02, 0, 0, 0.01, 0.6, 0.1, 0.01])
)


def plain_outlines(cameras, positions, ground):
    """Every pair of camera and person, one at a time, without asking first whether the two may see each other."""
    found = {}
    for c, camera in enumerate(cameras):
        eye = inverse(camera.camera_from_map)[:2, 3]
        for m, place in enumerate(positions[c]):
            toward = place - eye
            side = RADIUS_M * np.array([-toward[1], toward[0]]) / np.linalg.norm(toward)
            corners = [
                [*(place + sign * side), ground[m] + share * HEIGHT_M] for sign in (-1, 1) for share in (0, 0.5, 1)
            ]
            pixels, valid = camera.model.project(apply(camera.camera_from_map, np.array(corners)))
            if valid.sum() < 4:
                continue
            low, high = pixels[valid].min(axis=0), pixels[valid].max(axis=0)
            size = np.array([camera.model.width_px, camera.model.height_px])
            cut_low, cut_high = np.clip(low, 0, size), np.clip(high, 0, size)
            share = np.prod(cut_high - cut_low) / max(np.prod(high - low), 1e-9)
            if share > 0:
                found[c, m] = [*cut_low, *cut_high, share]
    return found


def rig(world, models):
    """The world's cameras, each with one of the models in turn."""
    frames = []
    for i, (name, _, vehicle_from_camera) in enumerate(world.cameras):
        detections = CameraDetections(1, name, np.zeros((0, 4)), np.zeros(0), ())
        frames.append(CameraFrame(name, detections, models[i % len(models)], inverse(vehicle_from_camera)))
    return frames


@pytest.mark.parametrize("kind", ["fisheye", "pinhole", "rational", "mixed"])
@pytest.mark.parametrize("far_m", [1.5, 4.0, 30.0])
def test_outlines_agree_with_a_plain_loop(world, kind, far_m):
    fisheye = world.cameras[0][1]
    models = {"fisheye": [fisheye], "pinhole": [PINHOLE], "rational": [RATIONAL], "mixed": [RATIONAL, fisheye, PINHOLE]}
    cameras = rig(world, models[kind])
    generator = np.random.default_rng(7)
    M = 120
    positions = generator.uniform(-far_m, far_m, (M, 2)) + generator.normal(0, 0.05, (len(cameras), M, 2))
    ground = generator.uniform(-1.5, 1.5, M)
    people = outlines(cameras, positions, ground, radius_m=RADIUS_M, height_m=HEIGHT_M)
    expected = plain_outlines(cameras, positions, ground)
    pairs = list(zip(people.camera.tolist(), people.person.tolist(), strict=True))
    assert pairs == sorted(expected)
    np.testing.assert_allclose(people.corners_px.T, [expected[pair][:4] for pair in pairs], atol=1e-6)
    np.testing.assert_allclose(people.share_inside, [expected[pair][4] for pair in pairs], atol=1e-6)


def test_nobody_is_in_no_view(world):
    cameras = rig(world, [PINHOLE])
    people = outlines(cameras, np.zeros((len(cameras), 0, 2)), np.zeros(0), radius_m=RADIUS_M, height_m=HEIGHT_M)
    assert people.corners_px.shape == (4, 0)
