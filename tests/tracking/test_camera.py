"""Camera models: agreement with OpenCV, inversion, and refusal of what cannot be projected or calibrated."""

import numpy as np
import pytest

from schemas.messages import CameraCalibration
from tracking.camera import CalibrationError, CameraModel

A0 = [-0.0540096, -0.0784275, 0.0959641, -0.0515253]
MODELS = {
    "fisheye_a0": ("equidistant", A0),
    "fisheye_a2": ("equidistant", [-0.094054, 0.086107, -0.170816, 0.098190]),
    "barrel": ("plumb_bob", [-0.30, 0.08, 0.001, -0.0005]),
    "five": ("plumb_bob", [-0.28, 0.07, 0.0002, 0.0003, -0.01]),
    "rational": ("rational_polynomial", [0.5, -0.1, 0.0002, -0.0004, 0.002, 0.9, 0.05, 0.01]),
    "none": ("plumb_bob", [0.0, 0.0, 0.0, 0.0]),
}


def make_calibration(model="equidistant", distortion=A0, K=None, width=1920, height=1208):
    K = np.array([[1176.93, 0, 962.275], [0, 1177.72, 612.725], [0, 0, 1]]) if K is None else np.asarray(K, float)
    return CameraCalibration(1, "gmsl_centre_link", width, height, model, np.asarray(distortion, float), K)


def make_camera(name="fisheye_a0"):
    return CameraModel.from_calibration(make_calibration(*MODELS[name]))


def points_in_view(camera, count=500, seed=1):
    """Points at 0.5 to 40 m whose angle stays below where the distortion stops growing, and below 60 degrees."""
    generator = np.random.default_rng(seed)
    theta = generator.uniform(0, min(0.97 * camera.max_theta_rad, np.pi / 3), count)
    phi, depth = generator.uniform(-np.pi, np.pi, count), generator.uniform(0.5, 40, count)
    r = np.tan(theta)
    return np.stack([r * np.cos(phi), r * np.sin(phi), np.ones(count)], axis=1) * depth[:, None]


@pytest.mark.parametrize("name", MODELS)
def test_projection_agrees_with_opencv(name):
    cv2 = pytest.importorskip("cv2")
    camera = make_camera(name)
    points = points_in_view(camera)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    if camera.model == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, camera.distortion)
    else:
        expected, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, camera.distortion)
    pixels, valid = camera.project(points)
    assert valid.all()
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_ray_undoes_projection(name):
    camera = make_camera(name)
    points = points_in_view(camera)
    pixels, _ = camera.project(points)
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(camera.ray(pixels), directions, atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_projection_grows_up_to_the_limit(name):
    """Along any direction the pixel moves outward all the way to max_theta_rad, and is refused past it."""
    camera = make_camera(name)
    theta = np.linspace(0, min(camera.max_theta_rad, 1.5) * 0.999, 200)
    points = np.stack([np.tan(theta), np.zeros_like(theta), np.ones_like(theta)], axis=1)
    pixels, valid = camera.project(points)
    assert valid.all()
    assert (np.diff(pixels[:, 0]) > 0).all()
    if camera.max_theta_rad < 1.5:
        beyond = np.array([[np.tan(camera.max_theta_rad * 1.01), 0, 1]])
        pixels, valid = camera.project(beyond)
        assert not valid.any()
        assert np.isnan(pixels).all()


def test_limit_of_a_barrel_is_where_the_derivative_vanishes():
    """r (1 + k r^2) stops growing at r = 1 / sqrt(-3 k)."""
    camera = CameraModel.from_calibration(make_calibration("plumb_bob", [-0.3, 0, 0, 0]))
    assert camera.max_radius == pytest.approx(1 / np.sqrt(0.9))
    assert camera.max_theta_rad == pytest.approx(np.arctan(camera.max_radius))


def test_limit_of_an_undistorted_camera():
    assert make_camera("none").max_radius == np.inf
    assert CameraModel.from_calibration(make_calibration("equidistant", [0, 0, 0, 0])).max_theta_rad == np.pi


def test_limit_at_a_pole_of_the_rational_model():
    camera = CameraModel.from_calibration(make_calibration("rational_polynomial", [0, 0, 0, 0, 0, -0.25, 0, 0]))
    assert camera.max_radius == pytest.approx(2.0)


@pytest.mark.parametrize(
    "point", [[0, 0, 0.09], [0, 0, -5], [1, 1, 0], [np.nan, 0, 1], [0, 0, np.nan], [np.inf, 0, 1], [1e300, 0, 1]]
)
@pytest.mark.parametrize("name", MODELS)
def test_points_that_cannot_be_seen_are_refused(name, point):
    pixels, valid = make_camera(name).project(np.array([point, [0, 0, 1]], float))
    assert valid.tolist() == [False, True]
    assert np.isnan(pixels[0]).all()
    np.testing.assert_allclose(pixels[1], [962.275, 612.725])


def test_shapes():
    camera = make_camera()
    for shape in [(0, 3), (4, 3), (2, 5, 3)]:
        pixels, valid = camera.project(np.ones(shape))
        assert pixels.shape == (*shape[:-1], 2)
        assert valid.shape == shape[:-1]
        assert camera.ray(pixels).shape == shape


def test_pixel_that_no_direction_reaches_has_no_ray():
    camera = CameraModel.from_calibration(make_calibration("plumb_bob", [-0.3, 0, 0, 0]))
    assert np.isnan(camera.ray(np.array([[5000.0, 600.0]]))).all()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"model": "fov"}, "unknown distortion model 'fov'; known are"),
        ({"distortion": [0.1]}, "equidistant takes 4 distortion coefficients, got 1"),
        ({"model": "plumb_bob", "distortion": [0] * 8}, "plumb_bob takes 4 or 5"),
        ({"distortion": [np.nan, 0, 0, 0]}, "not finite"),
        ({"K": np.zeros((3, 3))}, "K must be"),
        ({"K": [[0, 0, 900], [0, 1000, 600], [0, 0, 1]]}, "focal lengths positive"),
        (
            {"K": [[6e-306, 0, 900], [0, 1000, 600], [0, 0, 1]]},
            r"focal lengths \(6e-306, 1000\) px are those of no lens",
        ),
        ({"K": [[1000, 0, 900], [0, 1e8, 600], [0, 0, 1]]}, r"focal lengths \(1000, 1e\+08\) px are those of no lens"),
        ({"K": [[1000, 0, 9000], [0, 1000, 600], [0, 0, 1]]}, "far outside the 1920 x 1208 image"),
        ({"K": [[1000, 0, np.nan], [0, 1000, 600], [0, 0, 1]]}, "finite"),
        ({"K": np.eye(2)}, "K must be 3 x 3"),
        ({"width": 0}, "image size 0 x 1208"),
    ],
)
def test_nonsense_calibration_is_refused(change, text):
    with pytest.raises(CalibrationError, match=text) as caught:
        CameraModel.from_calibration(make_calibration(**change))
    assert "gmsl_centre_link" in str(caught.value)


def test_calibration_cannot_be_changed_behind_the_model():
    distortion = np.array(A0)
    camera = CameraModel.from_calibration(make_calibration(distortion=distortion))
    distortion[0] = 9.0
    assert camera.distortion[0] == A0[0]


@pytest.mark.parametrize(("model", "D"), [("plumb_bob", [0, 0, 0, 0]), ("equidistant", [0, 0, 0, 0])])
def test_the_view_ends_at_the_corner_farthest_from_the_centre(model, D):
    camera = CameraModel(1000, 800, 500, 500, 400, 300, model, np.array(D, float))
    radius = np.hypot(600, 500) / 500
    assert camera.view_rad == pytest.approx(np.arctan(radius) if model == "plumb_bob" else radius)


def test_a_view_wider_than_the_distortion_allows_ends_with_it():
    camera = CameraModel(2000, 2000, 300, 300, 1000, 1000, "plumb_bob", np.array([-0.3, 0.0, 0.0, 0.0]))
    assert camera.view_rad == camera.max_theta_rad


def test_random_rational_lenses_can_be_inverted():
    """Also those whose distortion ends at a pole."""
    generator = np.random.default_rng(0)
    for _ in range(200):
        distortion = generator.uniform(-0.6, 0.6, 8) * [1, 1, 0, 0, 1, 1, 1, 1]
        camera = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0, "rational_polynomial", distortion)
        far = min(camera.max_radius, 1.0)
        points = np.array([[0.3 * far, 0.2 * far, 1.0], [-0.5 * far, 0.1 * far, 1.0], [0.01, 0.0, 1.0]])
        pixels, valid = camera.project(points)
        rays = camera.ray(pixels[valid])
        np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], points[valid, :2], atol=1e-6)
        assert valid.any()
