"""Bivariate Gaussian mixtures as a network's output (Bishop 1994; bivariate form as in Graves 2013).

Letters: K components; leading axes are free (pedestrians, predicted steps). Everything is differentiable torch.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

LOG_SIGMA_RANGE = (-5.0, 3.0)  # 7 mm to 20 m
MAX_RHO = 0.95
RAW_PER_COMPONENT = 6  # weight logit, mean (2), log sigma (2), correlation


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """Mixtures of K bivariate Gaussians; all tensors share their leading axes."""

    log_weights: Tensor  # (..., K)    their exponentials sum to 1 over K
    means: Tensor  # (..., K, 2) m
    log_sigmas: Tensor  # (..., K, 2) log of m
    rhos: Tensor  # (..., K)    -1 to 1, exclusive

    @property
    def weights(self) -> Tensor:
        """(..., K) probabilities of the components."""
        return self.log_weights.exp()


def mixture_from_raw(raw: Tensor) -> GaussianMixture:
    """Returns the mixture that a linear layer's output (..., K * 6) stands for; means are taken as they are.

    Per component: weight logit, mean x and y, log sigma x and y (clamped to -5..3), and the argument of
    rho = 0.95 tanh. Raises ValueError if the last axis is not a multiple of 6.
    """
    if raw.shape[-1] % RAW_PER_COMPONENT:
        raise ValueError(f"raw must have 6 values per component, got {raw.shape[-1]}")
    raw = raw.reshape(*raw.shape[:-1], RAW_PER_COMPONENT, -1)  # (..., 6, K)
    return GaussianMixture(
        log_weights=raw[..., 0, :].log_softmax(dim=-1),
        means=raw[..., 1:3, :].transpose(-1, -2),
        log_sigmas=raw[..., 3:5, :].transpose(-1, -2).clamp(*LOG_SIGMA_RANGE),
        rhos=MAX_RHO * raw[..., 5, :].tanh(),
    )


def log_likelihood(mixture: GaussianMixture, points: Tensor) -> Tensor:
    """Returns the log density (...) in 1/m^2 of points (..., 2) in m under the mixtures, by log-sum-exp over K."""
    z = (points.unsqueeze(-2) - mixture.means) * (-mixture.log_sigmas).exp()  # (..., K, 2)
    z_x, z_y = z.unbind(-1)
    one_minus_rho2 = 1 - mixture.rhos.square()
    mahalanobis2 = (z_x.square() + z_y.square() - 2 * mixture.rhos * z_x * z_y) / one_minus_rho2
    log_norm = mixture.log_sigmas.sum(dim=-1) + 0.5 * one_minus_rho2.log() + math.log(2 * math.pi)
    return (mixture.log_weights - log_norm - 0.5 * mahalanobis2).logsumexp(dim=-1)


def rotate(mixture: GaussianMixture, rotation: Tensor) -> GaussianMixture:
    """Returns the mixture turned by rotation matrices (..., 2, 2), one for all K components of a mixture.

    Means become R mu and covariances R C R^T. A needle-thin component turned off its axes has a correlation near 1,
    where float32 runs out of digits; it is held at 0.9999 there.
    """
    sigma_x, sigma_y = mixture.log_sigmas.exp().unbind(-1)  # (..., K)
    var_x, var_y, cov = sigma_x.square(), sigma_y.square(), mixture.rhos * sigma_x * sigma_y
    c, s = rotation[..., 0, 0].unsqueeze(-1), rotation[..., 1, 0].unsqueeze(-1)  # (..., 1)
    new_var_x = c * c * var_x + s * s * var_y - 2 * c * s * cov
    new_var_y = s * s * var_x + c * c * var_y + 2 * c * s * cov
    new_cov = c * s * (var_x - var_y) + (c * c - s * s) * cov
    return GaussianMixture(
        log_weights=mixture.log_weights,
        means=mixture.means @ rotation.transpose(-1, -2),
        log_sigmas=0.5 * torch.stack([new_var_x, new_var_y], dim=-1).log(),
        rhos=(new_cov / (new_var_x * new_var_y).sqrt()).clamp(-0.9999, 0.9999),
    )
