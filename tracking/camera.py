"""Camera models as ROS and OpenCV define them: plumb_bob, rational_polynomial and equidistant (fisheye).

Optical frame: x right, y down, z forward. `r` is the distance from the optical axis at depth 1, theta = atan(r).
"""

import math
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from schemas.messages import BoolArray, CameraCalibration, FloatArray, IntArray

MIN_DEPTH_M = 0.1
COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}


class CalibrationError(ValueError):
    """A camera calibration that no image can have come from."""


@dataclass(frozen=True, eq=False)
class CameraModel:
    """One camera's projection.

    `max_radius` and `max_theta_rad` say the same thing twice: where the distortion stops growing. Past it the
    polynomial folds back and would put points from far outside the view into the middle of the image.
    """

    width_px: int
    height_px: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str
    distortion: FloatArray  # (D,)  plumb_bob k1 k2 p1 p2 [k3]; rational k1 k2 p1 p2 k3 k4 k5 k6; equidistant k1..k4
    max_theta_rad: float = field(init=False)  # at most pi
    max_radius: float = field(init=False)  # may be infinite

    def __post_init__(self) -> None:
        _check(self)
        distortion = np.array(self.distortion, float)
        distortion.flags.writeable = False
        object.__setattr__(self, "distortion", distortion)
        limit = _first_standstill(self.model, distortion)
        if self.model == "equidistant":
            theta = min(limit, math.pi)
            radius = math.tan(theta) if theta < math.pi / 2 else math.inf
        else:
            theta, radius = math.atan(limit), limit
        object.__setattr__(self, "max_theta_rad", theta)
        object.__setattr__(self, "max_radius", radius)

    @classmethod
    def from_calibration(cls, calibration: CameraCalibration) -> "CameraModel":
        """Returns the model of a logged calibration; raises CalibrationError saying what is wrong with it."""
        K = np.asarray(calibration.intrinsics_px, float)
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise CalibrationError(f"{calibration.frame_id}: K must be 3 x 3 finite numbers, got {K.tolist()}")
        if not np.allclose([K[0, 1], K[1, 0], K[2, 0], K[2, 1], K[2, 2]], [0, 0, 0, 0, 1], atol=1e-9):
            raise CalibrationError(f"{calibration.frame_id}: K must be [fx 0 cx; 0 fy cy; 0 0 1], got {K.tolist()}")
        fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
        try:
            return cls(
                calibration.width_px, calibration.height_px, fx, fy, cx, cy, calibration.model, calibration.distortion
            )
        except CalibrationError as error:
            raise CalibrationError(f"{calibration.frame_id}: {error}") from error

    @cached_property
    def view_rad(self) -> float:
        """Half angle of the cone round the optical axis that holds everything in the image."""
        corners = np.array([(x, y) for x in (0, self.width_px) for y in (0, self.height_px)], float)
        x, y, z = self.ray(corners).T
        angles = np.arctan2(np.hypot(x, y), z)
        return float(np.where(np.isnan(angles), self.max_theta_rad, angles).max())

    def project(self, points_camera: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Projects points (..., 3) in m of the optical frame to raw pixels (..., 2), which may lie outside the image.

        Returns the pixels and a mask (...,): True at a depth of at least 0.1 m and where the distortion still grows.
        Pixels of the others are NaN, as are those of points that are not finite.
        """
        points = np.asarray(points_camera, float)
        pixels, valid = project_all(
            make_rig((self,)), np.zeros(1, np.int64), points.reshape(-1, 1, 3).transpose(2, 0, 1)
        )
        return pixels.reshape(2, -1).T.reshape(*points.shape[:-1], 2), valid.reshape(points.shape[:-1])

    def ray(self, pixels: FloatArray) -> FloatArray:
        """Returns unit directions (..., 3) in the optical frame of raw pixels (..., 2): the inverse of `project`.

        A pixel that no direction within `max_theta_rad` reaches gives NaN.
        """
        pixels = np.asarray(pixels, float)
        x = ((pixels[..., 0] - self.cx) / self.fx).ravel()
        y = ((pixels[..., 1] - self.cy) / self.fy).ravel()
        radius = np.hypot(x, y)
        if self.model == "equidistant":
            theta = self._invert_radial(radius)
            scale = np.divide(np.sin(theta), radius, out=np.zeros_like(radius), where=radius > 0)
            directions = np.stack([scale * x, scale * y, np.cos(theta)], axis=-1)
        else:
            undistorted = self._invert_radial(radius)
            if self.distortion[2:4].any():  # tangential terms reach a little further: start just inside the limit
                undistorted = np.where(np.isnan(undistorted), 0.95 * self.max_radius, undistorted)
            scale = np.divide(undistorted, radius, out=np.ones_like(radius), where=radius > 0)
            u, v = self._remove_tangential(x, y, scale * x, scale * y)
            directions = np.stack([u, v, np.ones_like(u)], axis=-1)
            directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return directions.reshape(*pixels.shape[:-1], 3)

    def _radial(self, r: FloatArray) -> FloatArray:
        """Distorted radius of an undistorted one; of an angle theta for the equidistant model."""
        numerator, denominator = _radial_polynomials(self.model, self.distortion)
        r2 = r * r
        return r * _horner(numerator, r2) / _horner(denominator, r2)

    def _invert_radial(self, radius: FloatArray) -> FloatArray:
        """Inverts the growing part of the distortion; NaN where it never reaches the radius.

        A table gives a bracket so narrow that the distortion is nearly straight in it and a few steps along its secant
        are exact. Only right at the limit, where the distortion stands still, it is not: there the bracket is bisected.
        """
        samples, distorted = self._radial_table
        reachable = radius <= distorted[-1]
        right = np.minimum(np.maximum(np.searchsorted(distorted, radius), 1), len(samples) - 1)
        low, high = samples[right - 1], samples[right]
        slope = (high - low) / np.maximum(distorted[right] - distorted[right - 1], 1e-300)
        found = low.copy()
        for _ in range(5):
            found = np.minimum(np.maximum(found - slope * (self._radial(found) - radius), low), high)
        rest = np.flatnonzero(reachable & (np.abs(self._radial(found) - radius) > 1e-13 * (1 + radius)))
        if len(rest):
            low, high, wanted = low[rest], high[rest], radius[rest]
            for _ in range(48):
                middle = (low + high) / 2
                above = self._radial(middle) > wanted
                low, high = np.where(above, low, middle), np.where(above, middle, high)
            found[rest] = (low + high) / 2
        return np.where(reachable, found, np.nan)

    @cached_property
    def _radial_table(self) -> tuple[FloatArray, FloatArray]:
        """Undistorted radii (angles, if equidistant) from 0 to the limit, and the distorted ones; both rise."""
        angles = np.linspace(0.0, min(self.max_theta_rad, math.pi if self.model == "equidistant" else 1.57), 2048)
        samples = angles if self.model == "equidistant" else np.minimum(np.tan(angles), self.max_radius * (1 - 1e-9))
        return samples, self._radial(samples)

    def _remove_tangential(
        self, x: FloatArray, y: FloatArray, u: FloatArray, v: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Refines undistorted u, v until they distort to x, y: Newton's method with differences for the Jacobian."""
        if not self.distortion[2:4].any():
            return u, v
        step = 1e-6
        for _ in range(12):
            error_x, error_y = self._residual(u, v, x, y)
            forward_x, forward_y = self._residual(u + step, v, x, y)
            right_x, right_y = self._residual(u, v + step, x, y)
            a, b = (forward_x - error_x) / step, (right_x - error_x) / step
            c, d = (forward_y - error_y) / step, (right_y - error_y) / step
            determinant = a * d - b * c
            u, v = u - (d * error_x - b * error_y) / determinant, v - (a * error_y - c * error_x) / determinant
        error_x, error_y = self._residual(u, v, x, y)
        solved = (np.hypot(error_x, error_y) < 1e-6) & (np.hypot(u, v) <= self.max_radius)
        return np.where(solved, u, np.nan), np.where(solved, v, np.nan)

    def _residual(self, u: FloatArray, v: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        distorted_x, distorted_y = _distort(self.model, self.distortion, u, v, u * u + v * v)
        return distorted_x - x, distorted_y - y


@dataclass(frozen=True, eq=False)
class Rig:
    """The numbers of several cameras, one column each, so that all of them project in one batch."""

    models: tuple[str, ...]  # the different ones
    model: IntArray  # (C,)  which of them
    intrinsics: FloatArray  # (5, C)  fx, fy, cx, cy, max_radius
    distortion: FloatArray  # (8, C)  zeros past a model's own
    size_px: FloatArray  # (2, C)


@lru_cache(maxsize=16)
def make_rig(cameras: tuple[CameraModel, ...]) -> Rig:
    """Returns the cameras' numbers; a vehicle's cameras seldom change, so these are kept."""
    models = tuple(sorted({camera.model for camera in cameras}))
    distortion = np.zeros((8, len(cameras)))
    for column, camera in enumerate(cameras):
        distortion[: len(camera.distortion), column] = camera.distortion
    return Rig(
        models,
        np.array([models.index(c.model) for c in cameras], np.int64),
        np.array([(c.fx, c.fy, c.cx, c.cy, c.max_radius) for c in cameras]).reshape(-1, 5).T.copy(),
        distortion,
        np.array([(c.width_px, c.height_px) for c in cameras], float).reshape(-1, 2).T.copy(),
    )


def project_all(rig: Rig, camera: IntArray, points_camera: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Projects points (3, N, R), column r in the optical frame of the rig's camera[r]; see `CameraModel.project`.

    Returns pixels (2, N, R) and the mask (N, R). Coordinates come first, so that numpy runs along whole rows.
    """
    fx, fy, cx, cy, max_radius = rig.intrinsics[:, camera]  # (R,) each
    x, y, z = points_camera
    valid = z >= MIN_DEPTH_M
    depth = np.where(valid, z, 1.0)
    x, y = x / depth, y / depth
    with np.errstate(over="ignore"):
        r2: FloatArray = x * x + y * y
        valid &= r2 <= max_radius * max_radius  # False for NaN, too
    valid &= np.isfinite(r2)
    everywhere = bool(valid.all())
    if not everywhere:
        x, y, r2 = np.where(valid, x, 0.0), np.where(valid, y, 0.0), np.where(valid, r2, 0.0)
    D = rig.distortion[:, camera]  # (8, R)
    if len(rig.models) == 1:
        x, y = _distort(rig.models[0], D, x, y, r2)
    else:
        for number, model in enumerate(rig.models):
            columns = np.flatnonzero(rig.model[camera] == number)
            x[:, columns], y[:, columns] = _distort(model, D[:, columns], x[:, columns], y[:, columns], r2[:, columns])
    pixels = np.empty((2, *valid.shape))
    pixels[0] = fx * x + cx
    pixels[1] = fy * y + cy
    if not everywhere:
        pixels[:, ~valid] = np.nan
    return pixels, valid


def _distort(model: str, D: FloatArray, x: FloatArray, y: FloatArray, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns distorted coordinates at depth 1; D (D, ...) holds coefficients that broadcast against x, y and r2."""
    if model == "equidistant":
        r = np.sqrt(r2)
        theta = np.arctan(r)
        t2 = theta * theta
        theta_distorted = theta * (1 + t2 * (D[0] + t2 * (D[1] + t2 * (D[2] + t2 * D[3]))))
        scale: FloatArray = np.divide(theta_distorted, r, out=np.ones_like(r), where=r > 1e-12)
        return x * scale, y * scale
    k3 = D[4] if len(D) > 4 else 0.0
    scale = 1 + r2 * (D[0] + r2 * (D[1] + r2 * k3))
    if model == "rational_polynomial":
        scale = scale / (1 + r2 * (D[5] + r2 * (D[6] + r2 * D[7])))
    p1, p2 = D[2], D[3]
    return (
        x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * scale + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def _check(camera: CameraModel) -> None:
    if camera.model not in COEFFICIENTS:
        raise CalibrationError(f"unknown distortion model {camera.model!r}; known are {sorted(COEFFICIENTS)}")
    D = np.asarray(camera.distortion, float)
    wanted = COEFFICIENTS[camera.model]
    if D.ndim != 1 or len(D) not in wanted:
        counts = " or ".join(map(str, wanted))
        raise CalibrationError(f"{camera.model} takes {counts} distortion coefficients, got {D.size}")
    if not np.isfinite(D).all():
        raise CalibrationError(f"distortion {D.tolist()} is not finite")
    if camera.width_px <= 0 or camera.height_px <= 0:
        raise CalibrationError(f"image size {camera.width_px} x {camera.height_px} is not positive")
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
    if not all(map(math.isfinite, numbers)) or camera.fx <= 0 or camera.fy <= 0:
        raise CalibrationError(f"focal lengths and centre {numbers} must be finite, focal lengths positive")
    if not all(1e-3 < f / size < 1e3 for f, size in ((camera.fx, camera.width_px), (camera.fy, camera.height_px))):
        raise CalibrationError(
            f"focal lengths ({camera.fx:.6g}, {camera.fy:.6g}) px are those of no lens over a "
            f"{camera.width_px} x {camera.height_px} image"
        )
    # A cropped image may have its centre outside, but not by more than its own size.
    if abs(camera.cx / camera.width_px - 0.5) > 1.5 or abs(camera.cy / camera.height_px - 0.5) > 1.5:
        raise CalibrationError(
            f"optical centre ({camera.cx:.6g}, {camera.cy:.6g}) is far outside the "
            f"{camera.width_px} x {camera.height_px} image"
        )


def _horner(coefficients: list[float], x: FloatArray) -> FloatArray:
    """Returns np.polyval(coefficients, x) to the bit, without its checks, which cost more than the sums."""
    value = np.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        value = value * x + coefficient
    return value


def _radial_polynomials(model: str, D: FloatArray) -> tuple[list[float], list[float]]:
    """Numerator and denominator of the radial factor in r^2 (theta^2 for equidistant), highest power first."""
    if model == "equidistant":
        return [D[3], D[2], D[1], D[0], 1.0], [1.0]
    k3 = D[4] if len(D) > 4 else 0.0
    denominator = [D[7], D[6], D[5], 1.0] if model == "rational_polynomial" else [1.0]
    return [k3, D[1], D[0], 1.0], denominator


def _first_standstill(model: str, D: FloatArray) -> float:
    """Returns the first radius (angle for equidistant) at which r N(r^2) / D(r^2) stops growing, or infinity."""
    numerator, denominator = (np.poly1d(p) for p in _radial_polynomials(model, D))
    s = np.poly1d([1.0, 0.0])  # s = r^2;  d/dr [r N / D] has the sign of (N + 2 s N') D - 2 s N D'
    slope = (numerator + 2 * s * numerator.deriv()) * denominator - 2 * s * numerator * denominator.deriv()
    candidates = [root for polynomial in (slope, denominator) for root in np.atleast_1d(polynomial.roots)]
    # A double root may come out as a pair of conjugates with a tiny imaginary part.
    positive = [root.real for root in candidates if root.real > 0 and abs(root.imag) < 1e-7 * abs(root)]
    return math.sqrt(min(positive)) if positive else math.inf
