"""Distributions whose likelihood, regions and areas are known."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import gaussian_kde

from pcgan import distribution_metrics
from pcgan.distribution_metrics import coverage, densities, density_ranks, kde_log_density, region_areas, sample_paths
from pcgan.mixture_density import GaussianMixture, log_likelihood


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(3)


def round_gaussians(*lead, sigma=0.5, mean=0.0):
    one = torch.zeros(*lead, 1)
    return GaussianMixture(one, torch.full((*lead, 1, 2), mean), torch.full((*lead, 1, 2), math.log(sigma)), one)


def random_mixtures(*lead, K=4, seed=0):
    g = torch.Generator().manual_seed(seed)
    return GaussianMixture(
        torch.randn(*lead, K, generator=g).log_softmax(-1),
        torch.randn(*lead, K, 2, generator=g),
        torch.randn(*lead, K, 2, generator=g) * 0.5 - 1,
        torch.rand(*lead, K, generator=g) * 1.6 - 0.8,
    )


def test_drawn_paths_have_the_mixtures_moments_at_each_step(generator):
    mixture = random_mixtures(3)  # three steps of one pedestrian
    paths = sample_paths(mixture, 40_000, generator)
    assert paths.shape == (40_000, 3, 2)
    w, mean = mixture.weights.unsqueeze(-1), (mixture.weights.unsqueeze(-1) * mixture.means).sum(dim=-2)
    second = (w * (mixture.means.square() + (2 * mixture.log_sigmas).exp())).sum(dim=-2)
    torch.testing.assert_close(paths.mean(dim=0), mean, atol=0.02, rtol=0)
    torch.testing.assert_close(paths.square().mean(dim=0), second, atol=0.06, rtol=0)
    sigma = mixture.log_sigmas.exp()
    xy = (mixture.weights * (mixture.means.prod(dim=-1) + mixture.rhos * sigma.prod(dim=-1))).sum(dim=-1)
    torch.testing.assert_close(paths.prod(dim=-1).mean(dim=0), xy, atol=0.03, rtol=0)


def test_a_drawn_path_keeps_to_its_component_and_its_place(generator):
    """Two far components, the same at each step: a path stays with one, and as far from its mean as it began."""
    means = torch.tensor([[-50.0, 0.0], [50.0, 0.0]]).expand(5, 2, 2)
    mixture = GaussianMixture(torch.full((5, 2), 0.5).log(), means, torch.zeros(5, 2, 2), torch.zeros(5, 2))
    paths = sample_paths(mixture, 200, generator)
    torch.testing.assert_close(paths, paths[:, :1].expand_as(paths))
    assert 60 < (paths[:, 0, 0] > 0).sum() < 140


def test_densities_are_those_of_the_likelihood():
    mixture = random_mixtures(2, 3)
    points = torch.randn(2, 3, 7, 2, generator=torch.Generator().manual_seed(1))
    expected = torch.stack([log_likelihood(mixture, points[:, :, i]) for i in range(7)], dim=-1).exp()
    torch.testing.assert_close(densities(mixture, points), expected)


def test_ranks_of_truths_from_the_very_mixtures_are_uniform(generator):
    mixture = random_mixtures(20_000)
    drawn = sample_paths(distribution_metrics.take(mixture, (slice(None), None)), 33, generator)[:, :, 0]  # (N, 33, 2)
    truth, samples = drawn[:, 0], drawn[:, 1:]
    ranks = density_ranks(densities(mixture, samples), log_likelihood(mixture, truth).exp(), generator)
    shares = torch.tensor([0.05, 0.5, 0.9, 0.95])
    torch.testing.assert_close(coverage(ranks, shares), shares, atol=0.012, rtol=0)


def test_a_truth_at_a_known_distance_has_the_gaussians_rank(generator):
    """The region of a round Gaussian that reaches out to r holds 1 - exp(-r^2 / 2 sigma^2)."""
    mixture = round_gaussians(5000)
    samples = sample_paths(distribution_metrics.take(mixture, (slice(None), None)), 64, generator)[:, :, 0]
    truth = torch.tensor([0.6, 0.0]).expand(5000, 2)
    ranks = density_ranks(densities(mixture, samples), log_likelihood(mixture, truth).exp(), generator)
    assert ranks.mean().item() == pytest.approx(1 - math.exp(-0.5 * (0.6 / 0.5) ** 2), abs=0.01)


def test_area_of_a_gaussians_region(generator):
    mixture = round_gaussians(5000)
    samples = sample_paths(distribution_metrics.take(mixture, (slice(None), None)), 64, generator)[:, :, 0]
    areas = region_areas(densities(mixture, samples))
    assert areas.mean().item() == pytest.approx(2 * math.pi * 0.5**2 * math.log(10), rel=0.02)


def test_coverage_counts_what_is_inside():
    ranks = torch.tensor([0.1, 0.2, 0.3, 0.9])
    assert coverage(ranks, torch.tensor([0.05, 0.2, 0.5, 1.0])).tolist() == [0.0, 0.5, 0.75, 1.0]


def test_kernel_estimate_is_scipys():
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(3, 50, 2)) @ np.array([[1.0, 0.3], [0.0, 0.5]])
    points = 0.8 * samples[:, 0]
    expected = [gaussian_kde(s.T).logpdf(p)[0] for s, p in zip(samples, points, strict=True)]
    found = kde_log_density(torch.from_numpy(samples), torch.from_numpy(points))
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_kernel_estimate_of_a_gaussian_gives_its_entropy(generator):
    mixture = distribution_metrics.take(round_gaussians(3000), (slice(None), None))
    drawn = sample_paths(mixture, 501, generator)[:, :, 0]
    nll = -kde_log_density(drawn[:, 1:], drawn[:, 0]).mean().item()
    entropy = math.log(2 * math.pi * math.e * 0.5**2)
    assert entropy < nll < entropy + 0.12  # a kernel estimate is too wide, and wobbles


def test_kernel_estimate_is_floored_and_takes_equal_samples():
    same = torch.zeros(20, 2)
    assert kde_log_density(same, torch.tensor([100.0, 0.0])).item() == -20
    assert kde_log_density(same, torch.zeros(2)).item() == pytest.approx(-math.log(2 * math.pi * 1e-6), abs=1e-3)
