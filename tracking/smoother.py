"""What one person's measurements say in hindsight: a Kalman filter forward, a Rauch-Tung-Striebel smoother back.

The tracker knows only what came before; a label for training may use what came after, too. Both passes are filterpy's,
with the tracker's model: constant velocity, white acceleration noise.
"""

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter, rts_smoother
from pydantic import BaseModel, ConfigDict, Field

from schemas.messages import BoolArray, FloatArray, IntArray
from tracking.motion_model import process_noise, transition

_H = np.eye(2, 4)


class SmootherParams(BaseModel):
    """Settings of the smoother. The defaults were tuned on simulated drives, of seeds that docs/labels.md names."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    acceleration_mps2: float = Field(
        default=0.85, gt=0, description="how briskly people change velocity, one sigma per axis, anew at each scan"
    )
    noise_factor: float = Field(
        default=2.0, gt=0, description="on the covariances of measurements: errors of a centroid last for several scans"
    )
    first_speed_mps: float = Field(
        default=1.0, gt=0, description="one sigma per axis of the velocity before the first measurement"
    )


@dataclass(frozen=True, eq=False)
class Estimate:
    """One person's states [x, y, vx, vy] at T stamps, in the frame of the measurements."""

    stamps_ns: IntArray  # (T,)  rising
    states: FloatArray  # (T, 4)  m and m/s
    covariances: FloatArray  # (T, 4, 4)


def smooth(
    stamps_ns: IntArray,
    measured: BoolArray,
    positions_m: FloatArray,
    covariances_m2: FloatArray,
    params: SmootherParams | None = None,
) -> Estimate:
    """Returns a person's states given all measurements, at every stamp from the first measurement to the last.

    Rauch, Tung and Striebel, "Maximum Likelihood Estimates of Linear Dynamic Systems" (1965). Nothing is extrapolated:
    stamps before the first measurement and after the last are left out.

    Args:
        stamps_ns: (T,) of the scans, rising.
        measured: (T,) in which of them the person was measured: K.
        positions_m: (K, 2)
        covariances_m2: (K, 2, 2)
        params: settings.

    Raises:
        ValueError: shapes do not agree, stamps do not rise, nothing was measured, or something is not finite.
    """
    forward = kalman_filter(stamps_ns, measured, positions_m, covariances_m2, params)
    if len(forward.stamps_ns) == 1:
        return forward
    # The function wants at k what leads from k to k + 1; the method of the same name wants at k what led there.
    Fs, Qs = _steps(forward.stamps_ns, params or SmootherParams())
    states, covs, _, _ = rts_smoother(forward.states, forward.covariances, Fs, Qs)
    return Estimate(forward.stamps_ns, states, _symmetric(covs))


def kalman_filter(
    stamps_ns: IntArray,
    measured: BoolArray,
    positions_m: FloatArray,
    covariances_m2: FloatArray,
    params: SmootherParams | None = None,
) -> Estimate:
    """Returns a person's states given the measurements up to each stamp; arguments and errors as of `smooth`.

    It begins as the tracker does: at the first measurement, with a velocity that nobody knows.
    """
    params = params or SmootherParams()
    stamps, rows = _checked(stamps_ns, measured, positions_m, covariances_m2)
    Fs, Qs = _steps(stamps, params)
    Rs = params.noise_factor * covariances_m2
    T = len(stamps)
    states, covs = np.empty((T, 4)), np.empty((T, 4, 4))
    kalman = KalmanFilter(dim_x=4, dim_z=2)
    kalman.H = _H  # as an argument of `update` it would switch off the check of z's shape
    kalman.x = np.array([*positions_m[0], 0.0, 0.0])
    kalman.P = np.diag([0.0, 0.0, params.first_speed_mps**2, params.first_speed_mps**2])
    kalman.P[:2, :2] = Rs[0]
    states[0], covs[0] = kalman.x, kalman.P
    for k in range(1, T):
        kalman.predict(F=Fs[k - 1], Q=Qs[k - 1])
        if rows[k] >= 0:
            kalman.update(positions_m[rows[k]], R=Rs[rows[k]])
        states[k], covs[k] = kalman.x, kalman.P
    return Estimate(stamps, states, _symmetric(covs))


def _checked(
    stamps_ns: IntArray, measured: BoolArray, positions_m: FloatArray, covariances_m2: FloatArray
) -> tuple[IntArray, IntArray]:
    """Returns the stamps from the first measurement to the last, and which measurement each has: (T,), -1 for none.

    filterpy takes wrong shapes in silence, and one NaN spoils all that follows.
    """
    K = int(np.count_nonzero(measured))
    if np.shape(stamps_ns) != np.shape(measured) or np.ndim(stamps_ns) != 1:
        raise ValueError(f"stamps_ns and measured must both be (T,), got {np.shape(stamps_ns)}, {np.shape(measured)}")
    if np.shape(positions_m) != (K, 2) or np.shape(covariances_m2) != (K, 2, 2):
        raise ValueError(
            f"{K} scans with a measurement want positions_m (K, 2) and covariances_m2 (K, 2, 2), "
            f"got {np.shape(positions_m)} and {np.shape(covariances_m2)}"
        )
    if K == 0:
        raise ValueError("nothing was measured: there is nothing to smooth")
    if not (np.isfinite(positions_m).all() and np.isfinite(covariances_m2).all()):
        raise ValueError("measurements must be finite")
    if (np.diff(stamps_ns) <= 0).any():
        raise ValueError("stamps_ns must rise")
    inside = np.flatnonzero(measured)
    span = slice(inside[0], inside[-1] + 1)
    return stamps_ns[span], np.where(measured, np.cumsum(measured) - 1, -1)[span]


def _steps(stamps_ns: IntArray, params: SmootherParams) -> tuple[list[FloatArray], list[FloatArray]]:
    """Returns F and Q from each stamp to the next, T - 1 each."""
    steps_s = (np.diff(stamps_ns) * 1e-9).tolist()
    return [transition(dt) for dt in steps_s], [process_noise(dt, params.acceleration_mps2) for dt in steps_s]


def _symmetric(covs: FloatArray) -> FloatArray:
    symmetric: FloatArray = (covs + covs.swapaxes(1, 2)) / 2
    return symmetric
