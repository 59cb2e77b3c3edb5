"""How good predicted distributions are: likelihood by kernels, calibration, sharpness. Bare functions on torch tensors.

Whatever is estimated from random draws takes a `torch.Generator`. Letters: P steps, K components, M samples; `...` is
any leading axes, pedestrians as a rule.
"""

import math
from typing import Any

import torch
from torch import Tensor

from pcgan.mixture_density import GaussianMixture

KDE_FLOOR_NATS = -20.0  # as in the code of Ivanovic & Pavone 2019, or one outlier is worth a whole test set
_MIN_KDE_SIGMA_M = 1e-3


def take(mixture: GaussianMixture, index: Any) -> GaussianMixture:
    """Returns the part of a mixture that an index into its leading axes picks."""
    parts = (mixture.log_weights, mixture.means, mixture.log_sigmas, mixture.rhos)
    return GaussianMixture(*(part[index] for part in parts))


def sample_paths(mixture: GaussianMixture, count: int, generator: torch.Generator) -> Tensor:
    """Draws whole paths (..., M, P, 2) in m from mixtures (..., P, K), which do not say how their steps hang together.

    One uniform draw picks the component at every step (the inverse of the cumulative weights), so a path keeps to its
    component while the weights do not change; one standard normal draw, common to all steps, places it within the
    component. The points of each step are then distributed exactly as the mixture of the step; steps are as dependent
    as they can be: who is ahead of the mean at one step is ahead at all of them.
    """
    *lead, P, _ = mixture.log_weights.shape
    u = torch.rand(*lead, 1, count, generator=generator).expand(*lead, P, count)
    z_x, z_y = torch.randn(2, *lead, 1, count, generator=generator)
    edges = mixture.weights.cumsum(dim=-1)
    k = torch.zeros(u.shape, dtype=torch.uint8)
    for component in range(edges.shape[-1] - 1):
        k += u > edges[..., component, None]
    index = k.long()
    sigma_x, sigma_y = mixture.log_sigmas.exp().unbind(-1)
    along, across = mixture.rhos * sigma_y, (1 - mixture.rhos.square()).sqrt() * sigma_y
    x = mixture.means[..., 0].gather(-1, index) + sigma_x.gather(-1, index) * z_x
    y = mixture.means[..., 1].gather(-1, index) + along.gather(-1, index) * z_x + across.gather(-1, index) * z_y
    return torch.stack([x, y], dim=-1).transpose(-2, -3)


def density_ranks(sample_densities: Tensor, true_density: Tensor, generator: torch.Generator) -> Tensor:
    """(..., M), (...) -> (...): which highest-density region the truth just falls into, 0 to 1.

    The truth is inside the region that holds a share q of the probability (Hyndman 1996) where its rank is at most q.
    The rank is the share of the samples that lie where the density is higher, smoothed at random by less than 1 / M:
    over truths that were drawn from the very mixtures, ranks are uniform, exactly.
    """
    M = sample_densities.shape[-1]
    higher = (sample_densities > true_density.unsqueeze(-1)).sum(dim=-1)
    return (higher + torch.rand(higher.shape, generator=generator)) / (M + 1)


def region_areas(sample_densities: Tensor, share: float = 0.9) -> Tensor:
    """(..., M) -> (...): area in m^2 of the highest-density region that holds this share of the probability.

    The area is the mean over the samples of 1 / density within the region: importance sampling by the mixture itself.
    The region ends at the density of one of the samples, the one that makes the area of a Gaussian's right on average.
    """
    M = sample_densities.shape[-1]
    outside = max(1, round((1 - share) * (M + 0.5) + 0.5))
    edge = sample_densities.topk(outside, dim=-1, largest=False, sorted=False).values.amax(dim=-1, keepdim=True)
    return ((sample_densities > edge) / sample_densities).mean(dim=-1)


def coverage(ranks: Tensor, shares: Tensor) -> Tensor:
    """(N,), (Q,) -> (Q,): how many truths fell into the regions that should hold these shares; NaN of no ranks."""
    inside = torch.searchsorted(ranks.sort().values, shares.to(ranks.dtype), right=True)
    return inside / len(ranks)


def kde_log_density(samples: Tensor, points: Tensor) -> Tensor:
    """(..., M, 2), (..., 2) -> (...): log density in 1/m^2 of points under a Gaussian kernel estimate of the samples.

    Bandwidth by Scott's rule, M^(-1/6) times the samples' own covariance, as `scipy.stats.gaussian_kde` has it. The
    covariance is widened by (1 mm)^2, so that equal samples have a density, and the result is at least -20 nats.
    """
    M = samples.shape[-2]
    centred = samples - samples.mean(dim=-2, keepdim=True)
    x, y = centred.unbind(-1)
    scale = math.pow(M, -1 / 3) / (M - 1)
    var_x = x.square().sum(dim=-1) * scale + _MIN_KDE_SIGMA_M**2
    var_y = y.square().sum(dim=-1) * scale + _MIN_KDE_SIGMA_M**2
    cov = (x * y).sum(dim=-1) * scale
    determinant = (var_x * var_y - cov.square()).clamp_min(_MIN_KDE_SIGMA_M**4)
    dx, dy = (samples - points.unsqueeze(-2)).unbind(-1)
    a, b, c = (part.unsqueeze(-1) for part in (var_y / determinant, cov / determinant, var_x / determinant))
    exponent = -0.5 * (a * dx * dx - 2 * b * dx * dy + c * dy * dy)  # (..., M)
    log_norm = math.log(2 * math.pi * M) + 0.5 * determinant.log()
    return (exponent.logsumexp(dim=-1) - log_norm).clamp_min(KDE_FLOOR_NATS)


def densities(mixture: GaussianMixture, samples: Tensor) -> Tensor:
    """(..., K), (..., M, 2) -> (..., M): densities in 1/m^2 of many points under each mixture; 0 where it underflows.

    As `mixture_density.log_likelihood`, but with the many samples on the last axis instead of the few components.
    """
    x, y = samples.unbind(-1)
    half = 0.5 / (1 - mixture.rhos.square())  # (..., K)
    height = (mixture.log_weights - mixture.log_sigmas.sum(dim=-1)).exp() * (2 * half).sqrt() / (2 * math.pi)
    inverse = (-mixture.log_sigmas).exp()
    total = torch.zeros_like(x)
    for k in range(height.shape[-1]):
        zx = (x - mixture.means[..., k, 0, None]) * inverse[..., k, 0, None]
        zy = (y - mixture.means[..., k, 1, None]) * inverse[..., k, 1, None]
        zy_given_x = zy - mixture.rhos[..., k, None] * zx
        square = 0.5 * zx * zx + half[..., k, None] * zy_given_x * zy_given_x
        total += height[..., k, None] * (-square).exp()
    return total
