"""Mixtures against scipy and torch.distributions."""

import numpy as np
import pytest
import torch
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from pcgan.mixture_density import GaussianMixture, log_likelihood, mixture_from_raw, rotate


def random_mixture(seed=0, shape=(3, 4), K=6, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return mixture_from_raw(torch.randn(*shape, 6 * K, generator=generator, dtype=dtype))


def covariances(mixture):
    sigma_x, sigma_y = mixture.log_sigmas.exp().unbind(-1)
    cov = mixture.rhos * sigma_x * sigma_y
    return torch.stack([sigma_x**2, cov, cov, sigma_y**2], -1).unflatten(-1, (2, 2))


def test_log_likelihood_is_that_of_scipy():
    mixture = random_mixture()
    points = torch.randn(3, 4, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    found = log_likelihood(mixture, points).numpy()
    for index in np.ndindex(3, 4):
        parts = [
            multivariate_normal(mixture.means[index][k], covariances(mixture)[index][k]).logpdf(points[index])
            for k in range(6)
        ]
        assert found[index] == pytest.approx(logsumexp(parts, b=mixture.weights[index].numpy()), abs=1e-9)


def test_log_likelihood_is_that_of_torch_distributions():
    mixture = random_mixture(2, (50,))
    points = 3 * torch.randn(50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    normal = torch.distributions.MultivariateNormal(mixture.means, covariances(mixture))
    expected = torch.distributions.MixtureSameFamily(
        torch.distributions.Categorical(logits=mixture.log_weights), normal
    ).log_prob(points)
    torch.testing.assert_close(log_likelihood(mixture, points), expected)


def test_extreme_raw_output_stays_finite_with_its_gradient():
    raw = torch.cat([torch.full((36,), 80.0), torch.full((36,), -80.0)]).reshape(2, 36).requires_grad_()
    mixture = mixture_from_raw(raw)
    assert mixture.log_sigmas.min() == -5
    assert mixture.log_sigmas.max() == 3
    assert mixture.rhos.abs().max() <= 0.95
    log_likelihood(mixture, torch.zeros(2, 2)).sum().backward()
    assert torch.isfinite(raw.grad).all()


def test_far_point_has_a_finite_likelihood():
    mixture = random_mixture(4, (1,), dtype=torch.float32)
    far = log_likelihood(mixture, torch.tensor([[1e4, -1e4]]))
    assert torch.isfinite(far).all()
    assert far < -1e3


def test_rotated_mixture_gives_rotated_points_the_same_likelihood():
    mixture = random_mixture(5, (20,))
    angle = torch.linspace(-3, 3, 20, dtype=torch.float64)
    turn = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).unflatten(-1, (2, 2))
    points = torch.randn(20, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(6))
    turned_points = (turn @ points.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(
        log_likelihood(rotate(mixture, turn), turned_points), log_likelihood(mixture, points), atol=1e-6, rtol=1e-6
    )


def test_needle_thin_component_survives_rotation_in_float32():
    needle = GaussianMixture(
        torch.zeros(1, 1), torch.zeros(1, 1, 2), torch.tensor([[[-5.0, 3.0]]]), torch.full((1, 1), 0.95)
    )
    c = 0.5**0.5
    turned = rotate(needle, torch.tensor([[[c, -c], [c, c]]]))
    assert turned.rhos.abs().max() <= 0.9999
    assert torch.isfinite(log_likelihood(turned, torch.ones(1, 2))).all()


def test_raw_of_the_wrong_width_is_refused():
    with pytest.raises(ValueError, match="6 values per component, got 35"):
        mixture_from_raw(torch.zeros(2, 35))
