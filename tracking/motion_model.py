"""Constant velocity with white acceleration noise, for the state [x, y, vx, vy] in m and m/s."""

import numpy as np

from schemas.messages import FloatArray


def transition(dt_s: float) -> FloatArray:
    """Returns F (4, 4): the state dt_s later is F @ state."""
    F = np.eye(4)
    F[0, 2] = F[1, 3] = dt_s
    return F


def process_noise(dt_s: float, acceleration_mps2: float) -> FloatArray:
    """Returns Q (4, 4): an acceleration of this standard deviation per axis, constant over dt_s, new at each step.

    Equal to filterpy's Q_discrete_white_noise(2, dt_s, acceleration_mps2 ** 2, block_size=2, order_by_dim=False).
    """
    variance = acceleration_mps2**2
    Q = np.zeros((4, 4))
    Q[0, 0] = Q[1, 1] = dt_s**4 / 4 * variance
    Q[0, 2] = Q[2, 0] = Q[1, 3] = Q[3, 1] = dt_s**3 / 2 * variance
    Q[2, 2] = Q[3, 3] = dt_s**2 * variance
    return Q
