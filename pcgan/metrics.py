"""Errors of predicted paths and mixtures against what people then did. Bare functions: arrays in, array out."""

import numpy as np

from schemas.messages import BoolArray, FloatArray

MISS_M = 2.0  # a path that ends farther off has missed (Argoverse)
COLLISION_M = 0.2  # two people nearer than this have collided


def ade(predicted_m: FloatArray, true_m: FloatArray) -> FloatArray:
    """(..., P, 2), (..., P, 2) -> (...): average displacement error, the mean distance over the P steps, in m."""
    return np.asarray(_distances(predicted_m, true_m).mean(axis=-1))


def fde(predicted_m: FloatArray, true_m: FloatArray) -> FloatArray:
    """(..., P, 2), (..., P, 2) -> (...): final displacement error, the distance at the last step, in m."""
    return np.asarray(_distances(predicted_m, true_m)[..., -1])


def mhd(predicted_m: FloatArray, true_m: FloatArray) -> FloatArray:
    """(..., P, 2), (..., Q, 2) -> (...): modified Hausdorff distance in m (Dubuisson & Jain 1994).

    The larger of the two mean distances from a point of one path to the nearest point of the other; it forgives a
    prediction that is on the right line but early or late. The two paths may differ in length.
    """
    _require_paths(predicted_m, true_m)
    x = predicted_m[..., :, None, 0] - true_m[..., None, :, 0]  # (..., P, Q)
    y = predicted_m[..., :, None, 1] - true_m[..., None, :, 1]
    squared = x * x + y * y  # roots are taken of the nearest only
    nearest = (np.sqrt(squared.min(axis=-1)).mean(axis=-1), np.sqrt(squared.min(axis=-2)).mean(axis=-1))
    return np.asarray(np.maximum(*nearest))


def nll(
    weights: FloatArray, means_m: FloatArray, sigmas_m: FloatArray, rhos: FloatArray, true_m: FloatArray
) -> FloatArray:
    """(..., P, K), (..., P, K, 2), (..., P, K, 2), (..., P, K), (..., P, 2) -> (...): negative log-likelihood.

    In nats, of densities per m^2, averaged over the P steps. A component of weight 0 adds nothing; a density that
    underflows even in log space cannot occur for positive sigmas.
    """
    z_x, z_y = np.moveaxis((true_m[..., None, :] - means_m) / sigmas_m, -1, 0)  # (..., P, K)
    one_minus_rho2 = 1 - np.square(rhos)
    mahalanobis2 = (z_x**2 + z_y**2 - 2 * rhos * z_x * z_y) / one_minus_rho2
    with np.errstate(divide="ignore"):
        log_weights = np.log(weights)
    log_norm = np.log(2 * np.pi * sigmas_m[..., 0] * sigmas_m[..., 1] * np.sqrt(one_minus_rho2))
    log_density = log_weights - log_norm - 0.5 * mahalanobis2
    highest = log_density.max(axis=-1, keepdims=True)  # a weight of 0 gives exp(-inf), never all of them
    log_sum = np.log(np.exp(log_density - highest).sum(axis=-1)) + highest[..., 0]
    return np.asarray(-log_sum.mean(axis=-1))


def collided(paths_m: FloatArray, there: BoolArray, threshold_m: float = COLLISION_M) -> BoolArray:
    """(..., A, P, 2), (..., A, P) -> (..., A, P): who is nearer than 0.2 m to somebody else of the scene at a step.

    Only people who are there at the step count. Between the steps nothing is looked at.
    """
    _require_paths(paths_m)
    present = np.where(there[..., None], paths_m, np.nan).swapaxes(-2, -3)  # (..., P, A, 2)
    x, y = present[..., 0], present[..., 1]
    apart_x, apart_y = x[..., :, None] - x[..., None, :], y[..., :, None] - y[..., None, :]  # (..., P, A, A)
    near = apart_x * apart_x + apart_y * apart_y < threshold_m * threshold_m  # False for NaN
    near &= ~np.eye(near.shape[-1], dtype=bool)
    return np.asarray(near.any(axis=-1).swapaxes(-1, -2))


def _distances(predicted_m: FloatArray, true_m: FloatArray) -> FloatArray:
    _require_paths(predicted_m, true_m)
    if predicted_m.shape[-2] != true_m.shape[-2]:
        raise ValueError(f"paths have {predicted_m.shape[-2]} and {true_m.shape[-2]} steps; they must agree")
    difference = predicted_m - true_m
    return np.asarray(np.hypot(difference[..., 0], difference[..., 1]))


def _require_paths(*paths_m: FloatArray) -> None:
    for path_m in paths_m:
        if path_m.ndim < 2 or path_m.shape[-1] != 2 or path_m.shape[-2] == 0:
            raise ValueError(f"a path must have shape (..., P, 2) with P > 0, got {path_m.shape}")
