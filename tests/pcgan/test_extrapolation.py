"""The tracker's state carried on: closed forms, and the tracker's own prediction added up."""

import numpy as np
import pytest

from pcgan.extrapolation import NOISE_M2_PER_S3, extrapolate


def test_extrapolation_is_the_closed_form():
    covariance = np.diag([0.04, 0.09, 0.25, 0.36])
    covariance[0, 2] = covariance[2, 0] = 0.05
    covariance[0, 1] = covariance[1, 0] = 0.03
    paths, sigmas, rhos = extrapolate(np.array([[1.0, 2, 3, 4]]), covariance[None], 0.4, 12)
    t = 4.8
    np.testing.assert_allclose(paths[0, -1], [1 + 3 * t, 2 + 4 * t])
    noise = NOISE_M2_PER_S3 * t**3 / 3
    variance = [0.04 + 2 * t * 0.05 + t**2 * 0.25 + noise, 0.09 + t**2 * 0.36 + noise]
    np.testing.assert_allclose(sigmas[0, -1], np.sqrt(variance))
    np.testing.assert_allclose(rhos[0, -1], 0.03 / np.sqrt(variance[0] * variance[1]))


def test_process_noise_is_the_trackers_added_up_over_scans():
    """A Kalman prediction every 0.1 s with Q of 1 m/s^2 grows the position variance by the same cubic, within 1 %."""
    dt, F = 0.1, np.array([[1, 0.1], [0, 1]])
    Q = np.outer([dt**2 / 2, dt], [dt**2 / 2, dt])
    P = np.zeros((2, 2))
    for _ in range(48):
        P = F @ P @ F.T + Q
    _, sigmas, _ = extrapolate(np.zeros((1, 4)), np.zeros((1, 4, 4)), 0.4, 12)
    assert sigmas[0, -1, 0] ** 2 == pytest.approx(P[0, 0], rel=0.01)


def test_degenerate_covariance_gives_a_sound_gaussian():
    _, sigmas, rhos = extrapolate(np.zeros((2, 4)), np.stack([np.zeros((4, 4)), -np.eye(4)]), 0.1, 12)
    assert (sigmas > 0).all()
    assert (np.abs(rhos) < 1).all()


def test_no_tracks():
    paths, sigmas, rhos = extrapolate(np.zeros((0, 4)), np.zeros((0, 4, 4)), 0.1, 12)
    assert (paths.shape, sigmas.shape, rhos.shape) == ((0, 12, 2), (0, 12, 2), (0, 12))
