"""The tracker's own state carried on at constant velocity: the fallback, and the baseline to beat."""

import numpy as np

from schemas.messages import FloatArray

# White acceleration noise as the tracker's: 1 m/s^2, a new one every scan (0.1 s).
NOISE_M2_PER_S3 = 1.0**2 * 0.1
_MIN_VARIANCE_M2 = 1e-4


def extrapolate(
    states: FloatArray, covariances: FloatArray, dt_s: float, steps: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns constant-velocity predictions of tracks, one Gaussian per step.

    Position covariance after t: P_xx + t (P_xv + P_vx) + t^2 P_vv + q t^3 / 3 I, with white acceleration noise of
    density q = NOISE_M2_PER_S3 on each axis.

    Args:
        states: (A, 4) x, y, vx, vy.
        covariances: (A, 4, 4) of the states.
        dt_s: between predicted steps; the first is dt_s after the states.
        steps: P.

    Returns:
        paths (A, P, 2) in m, sigmas (A, P, 2) in m, correlations (A, P).
    """
    t = dt_s * np.arange(1, steps + 1)  # (P,)
    paths = states[:, None, :2] + t[:, None] * states[:, None, 2:]  # (A, P, 2)
    P_xx, P_xv, P_vv = covariances[:, :2, :2], covariances[:, :2, 2:], covariances[:, 2:, 2:]
    growth = t[:, None, None]  # (P, 1, 1)
    covariance = P_xx[:, None] + growth * (P_xv + P_xv.swapaxes(1, 2))[:, None] + growth**2 * P_vv[:, None]
    covariance = covariance + NOISE_M2_PER_S3 / 3 * growth**3 * np.eye(2)  # (A, P, 2, 2)
    sigmas = np.sqrt(np.maximum(np.diagonal(covariance, axis1=2, axis2=3), _MIN_VARIANCE_M2))  # (A, P, 2)
    rhos = np.clip(covariance[..., 0, 1] / (sigmas[..., 0] * sigmas[..., 1]), -0.9999, 0.9999)
    return paths, sigmas, rhos
