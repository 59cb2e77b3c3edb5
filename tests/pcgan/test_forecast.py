"""Extrapolations in closed form, how wide their Gaussians are, and that they turn and move with the scene."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pcgan import dataset
from pcgan.batches import Observation, batches
from pcgan.forecast import EXTRAPOLATIONS, MIN_SIGMA_M, Extrapolation, certain_path, mixture_of_samples
from pcgan.mixture_density import GaussianMixture, log_likelihood

DT_S = 0.4
P = 12
TOLERANCE_M = 1e-5  # times are float32


def observation_of(walks, seen=None, velocity=None):
    """(A, T, 2) -> one scene of those walks, in double precision."""
    observed = torch.as_tensor(np.asarray(walks), dtype=torch.float64)
    seen = torch.ones(observed.shape[:-1], dtype=torch.bool) if seen is None else torch.as_tensor(np.asarray(seen))
    velocity = torch.zeros(len(observed), 2, dtype=torch.float64) if velocity is None else torch.as_tensor(velocity)
    return Observation(observed, seen, velocity, torch.ones(len(observed), len(observed), dtype=torch.bool), None)


def path_of(name, observation):
    return Extrapolation(name, P, DT_S).path(observation).numpy()


def forecast_of(name, observation):
    return Extrapolation(name, P, DT_S).forecast(observation, torch.Generator())


@pytest.mark.parametrize("name", EXTRAPOLATIONS)
@given(st.tuples(*[st.floats(-20, 20)] * 2), st.tuples(*[st.floats(-3, 3)] * 2), st.integers(2, 8))
def test_straight_walk_is_continued_exactly(name, start, velocity, seen_steps):
    times = np.arange(-7, P + 1)[:, None] * DT_S
    walk = np.array(start) + times * np.array(velocity)
    seen = np.arange(8) >= 8 - seen_steps
    observed = np.where(seen[:, None], walk[:8], walk[8 - seen_steps])  # filled in
    found = path_of(name, observation_of(observed[None], seen[None], np.array([velocity])))
    np.testing.assert_allclose(found[0], walk[8:], atol=TOLERANCE_M)


@given(st.integers(0, 999), st.lists(st.booleans(), min_size=7, max_size=7).filter(any))
def test_lin_is_the_least_squares_line_through_what_was_seen(seed, earlier):
    walk = np.random.default_rng(seed).normal(size=(8, 2)).cumsum(axis=0)
    seen = np.array([*earlier, True])
    time = np.arange(-7, P + 1) * DT_S
    observation = observation_of(walk[None], seen[None])
    slopes = []
    for axis in (0, 1):
        slope, level = np.polyfit(time[:8][seen], walk[seen, axis], 1)
        expected = level + slope * time[8:]
        np.testing.assert_allclose(path_of("lin", observation)[0, :, axis], expected, atol=TOLERANCE_M)
        slopes.append(slope)
    anchored = walk[-1] + time[8:, None] * slopes
    np.testing.assert_allclose(path_of("anchored", observation)[0], anchored, atol=TOLERANCE_M)


def test_cvm_repeats_the_last_displacement():
    walk = np.array([[9.0, 9], [5, 5], [0, 0], [1, 2]])
    expected = np.array([1.0, 2]) * (1 + np.arange(1, P + 1))[:, None]
    np.testing.assert_allclose(path_of("cvm", observation_of(walk[None]))[0], expected)


def test_weighted_halves_with_age():
    """Displacements 7, 0 and 14 m: (7 + 2 * 0 + 4 * 14) / 7 = 9 m a step."""
    walk = np.array([[0.0, 1], [7, 1], [7, 1], [21, 1]])
    found = path_of("weighted", observation_of(walk[None]))[0]
    np.testing.assert_allclose(found, np.stack([21 + 9 * np.arange(1, P + 1), np.ones(P)], axis=-1))


def test_weighted_counts_from_the_first_seen_step():
    """Displacements 0 and 14 m alone: (0 + 2 * 14) / 3 m a step."""
    walk = np.array([[0.0, 1], [7, 1], [7, 1], [21, 1]])
    found = path_of("weighted", observation_of(walk[None], [[False, True, True, True]]))[0]
    np.testing.assert_allclose(found[:, 0], 21 + 28 / 3 * np.arange(1, P + 1))


def test_state_carries_the_windows_velocity_on():
    walk = np.zeros((1, 8, 2))
    found = path_of("state", observation_of(walk, velocity=np.array([[1.0, -2.0]])))
    np.testing.assert_allclose(found[0], np.arange(1, P + 1)[:, None] * DT_S * np.array([1, -2]))


@pytest.mark.parametrize("name", EXTRAPOLATIONS)
def test_unseen_steps_before_the_first_do_not_count(name):
    rng = np.random.default_rng(0)
    walks, seen = rng.normal(size=(3, 8, 2)), np.arange(8) >= np.array([[1], [4], [6]])
    elsewhere = np.where(seen[..., None], walks, 99.0)
    velocity = rng.normal(size=(3, 2))
    expected = path_of(name, observation_of(walks, seen, velocity))
    np.testing.assert_allclose(path_of(name, observation_of(elsewhere, seen, velocity)), expected, atol=1e-12)


@pytest.mark.parametrize("name", EXTRAPOLATIONS)
@given(st.integers(0, 99), st.floats(-math.pi, math.pi), st.tuples(*[st.floats(-50, 50)] * 2))
def test_paths_turn_and_move_with_the_scene(name, seed, angle, shift):
    rng = np.random.default_rng(seed)
    walks, velocity = rng.normal(size=(3, 8, 2)), rng.normal(size=(3, 2))
    seen = rng.random((3, 8)) < 0.5
    seen[:, [rng.integers(0, 7), 7]] = True
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])  # of row vectors
    plain = path_of(name, observation_of(walks, seen, velocity))
    moved = path_of(name, observation_of(walks @ turn + shift, seen, velocity @ turn))
    np.testing.assert_allclose(moved, plain @ turn + shift, atol=1e-8)


def test_a_batch_is_as_its_scenes(make_windows):
    windows = make_windows((1, 3, 2), gaps=True)
    for name in EXTRAPOLATIONS:
        (batch,) = batches(windows, 100)
        together = Extrapolation(name, P, DT_S).path(batch.observation)
        for scene, single in enumerate(batches(windows, 1)):
            alone = Extrapolation(name, P, DT_S).path(single.observation)[0]
            torch.testing.assert_close(together[scene, : len(alone)], alone)


def test_unknown_extrapolation_is_refused():
    with pytest.raises(ValueError, match=r"no extrapolation 'constant'; there are \('lin', 'cvm'"):
        Extrapolation("constant", P, DT_S)


# --- the mixture around them -----------------------------------------------------------------------------------------


def standing(errors, known=None):
    """Windows of people who stand, whose futures are `errors` (N, P, 2) away, in one scene."""
    errors = np.asarray(errors, float)
    N = len(errors)
    known = np.ones(errors.shape[:2], bool) if known is None else known
    return dataset.Windows(
        observed=np.zeros((N, 8, 2), np.float32),
        seen=np.ones((N, 8), bool),
        velocity=np.zeros((N, 2), np.float32),
        future=np.where(known[..., None], errors, np.nan).astype(np.float32),
        vehicle=np.full((N, 8, 4), np.nan, np.float32),
        scene=np.zeros(N, np.int64),
        annotated=np.ones(N, bool),
        dt_s=DT_S,
    )


@pytest.mark.parametrize("name", EXTRAPOLATIONS)
def test_fitted_sigmas_are_the_root_mean_square_error_per_axis(name):
    """Errors of (3, 4) and of (0, 1) m: sqrt((25 + 1) / 2 / 2); nobody's second step known twice; none at the third."""
    errors = [[[3.0, 4], [0, 2], [0, 0]], [[0, 1], [99, 99], [0, 0]]]
    known = np.array([[True, True, True], [True, False, True]])
    fitted = Extrapolation(name, 3, DT_S).fitted(standing(errors, known))
    np.testing.assert_allclose(fitted.sigmas_m, [6.5**0.5, 2**0.5, MIN_SIGMA_M], rtol=1e-6)
    assert fitted.name == name


def test_fitted_sigmas_count_every_scene_once_and_no_padding(make_windows):
    windows = make_windows((3, 9, 5, 8), gaps=True)
    fitted = Extrapolation("cvm", P, DT_S).fitted(windows)
    steps = np.arange(1, P + 1)[:, None]
    path = windows.observed[:, -1:] + (windows.observed[:, -1:] - windows.observed[:, -2:-1]) * steps
    expected = np.sqrt(np.nanmean(((path - windows.future) ** 2).sum(axis=2), axis=0) / 2)
    np.testing.assert_allclose(fitted.sigmas_m, expected, rtol=1e-4)


@given(st.integers(0, 99))
def test_fitted_sigmas_have_the_best_likelihood(seed):
    errors = np.random.default_rng(seed).normal(0, [[0.2], [0.7]], (40, 2, 2))
    windows = standing(errors)
    (batch,) = batches(windows, 1000)

    def likelihood(factor):
        sigmas = factor * Extrapolation("state", 2, DT_S).fitted(windows).sigmas_m
        mixture = Extrapolation("state", 2, DT_S, sigmas).forecast(batch.observation, torch.Generator()).mixture
        return float(log_likelihood(mixture, batch.future).mean())

    assert likelihood(1.0) > max(likelihood(0.95), likelihood(1.05))


def test_certain_path_is_one_path_and_one_round_gaussian():
    path = torch.arange(24.0).reshape(2, 6, 2)
    sigmas = torch.linspace(0.1, 0.6, 6)
    found = certain_path(path, sigmas)
    torch.testing.assert_close(found.likeliest, path)
    assert found.paths.probabilities.tolist() == [[1], [1]]
    assert found.mixture.weights.tolist() == [[[1]] * 6] * 2
    density = log_likelihood(found.mixture, path + torch.tensor([0.3, 0.4]))
    expected = -(2 * math.pi * sigmas**2).log() - 0.25 / 2 / sigmas**2
    torch.testing.assert_close(density, expected.expand(2, 6))


def test_nobody_is_forecast_too():
    found = forecast_of("cvm", observation_of(np.zeros((0, 8, 2))))
    assert found.likeliest.shape == (0, P, 2)
    assert found.mixture.means.shape == (0, P, 1, 2)


@given(st.integers(1, 9), st.integers(0, 99), st.booleans())
def test_samples_become_a_mixture_of_equals(N, seed, batched):
    lead = (2, 3) if batched else (3,)
    samples = torch.randn(*lead, N, 5, 2, generator=torch.Generator().manual_seed(seed))
    bandwidths = torch.linspace(0.1, 0.5, 5)
    mixture = mixture_of_samples(samples, bandwidths)
    assert isinstance(mixture, GaussianMixture)
    assert mixture.means.shape == (*lead, 5, N, 2)
    torch.testing.assert_close(mixture.weights.sum(dim=-1), torch.ones(*lead, 5))
    point = torch.tensor([0.3, -0.2])
    square = (samples - point).square().sum(dim=-1)  # (..., N, 5)
    density = ((-square / 2 / bandwidths**2).exp() / (2 * math.pi * bandwidths**2)).mean(dim=-2)
    torch.testing.assert_close(log_likelihood(mixture, point.expand(*lead, 5, 2)).exp(), density, atol=1e-5, rtol=1e-3)
