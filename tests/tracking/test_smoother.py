"""The smoother against the batch solution of the same problem, against the truth, and against input that is wrong."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking.motion_model import transition
from tracking.smoother import SmootherParams, kalman_filter, smooth

PARAMS = SmootherParams(acceleration_mps2=0.8, noise_factor=1.0, first_speed_mps=1.2)
NS = 1_000_000_000


def walk(seed, T=40, p_measured=0.7, sigma_m=0.15):
    """A walk that keeps to the model, at uneven stamps, measured now and then: truth (T, 4) and what is measured."""
    generator = np.random.default_rng(seed)
    stamps = 1_700_000_000 * NS + np.cumsum(generator.integers(30_000_000, 300_000_000, T))
    truth = np.empty((T, 4))
    truth[0] = [*generator.normal(0, 5, 2), *generator.normal(0, PARAMS.first_speed_mps, 2)]
    for k, dt_s in enumerate(np.diff(stamps) * 1e-9):
        acceleration = generator.normal(0, PARAMS.acceleration_mps2, 2)
        truth[k + 1] = transition(dt_s) @ truth[k] + np.concatenate([dt_s**2 / 2 * acceleration, dt_s * acceleration])
    measured = generator.random(T) < p_measured
    measured[[0, -1]] = True
    roots = generator.normal(0, sigma_m, (measured.sum(), 2, 2))
    covs = roots @ roots.swapaxes(1, 2) + 0.05**2 * np.eye(2)
    noise = np.linalg.cholesky(covs) @ generator.normal(size=(len(covs), 2, 1))
    return truth, (stamps, measured, truth[measured, :2] + noise[:, :, 0], covs)


def batch(stamps_ns, measured, positions_m, covs_m2, params):
    """The least squares solution for the first state and all accelerations at once: states (T, 4) and (T, 4, 4)."""
    T = len(stamps_ns)
    U = 4 + 2 * (T - 1)  # unknowns: x, y, vx, vy of the first stamp, and an acceleration for each step
    state_of = np.zeros((T, 4, U))
    state_of[0, :, :4] = np.eye(4)
    for k, dt_s in enumerate(np.diff(stamps_ns) * 1e-9):
        state_of[k + 1] = transition(dt_s) @ state_of[k]
        state_of[k + 1, :, 4 + 2 * k : 6 + 2 * k] = np.vstack([dt_s**2 / 2 * np.eye(2), dt_s * np.eye(2)])
    prior = np.full(U, params.acceleration_mps2**-2.0)
    prior[:4] = [0, 0, params.first_speed_mps**-2.0, params.first_speed_mps**-2.0]
    information, vector = np.diag(prior), np.zeros(U)
    for k, z, R in zip(np.flatnonzero(measured), positions_m, covs_m2, strict=True):
        H = state_of[k, :2]
        information += H.T @ np.linalg.inv(R) @ H
        vector += H.T @ np.linalg.inv(R) @ z
    covariance = np.linalg.inv(information)
    return state_of @ covariance @ vector, state_of @ covariance @ state_of.swapaxes(1, 2)


@pytest.mark.parametrize("seed", range(6))
def test_it_is_the_batch_solution(seed):
    _, given_ = walk(seed)
    states, covs = batch(*given_, PARAMS)
    estimate = smooth(*given_, PARAMS)
    np.testing.assert_array_equal(estimate.stamps_ns, given_[0])
    np.testing.assert_allclose(estimate.states, states, atol=1e-8)
    np.testing.assert_allclose(estimate.covariances, covs, atol=1e-8)


def test_the_filter_is_the_batch_solution_of_what_came_before():
    _, (stamps, measured, positions, covs) = walk(1)
    forward = kalman_filter(stamps, measured, positions, covs, PARAMS)
    for k in (0, 1, 7, 20, 39):
        K = measured[: k + 1].sum()
        states, covariances = batch(stamps[: k + 1], measured[: k + 1], positions[:K], covs[:K], PARAMS)
        np.testing.assert_allclose(forward.states[k], states[-1], atol=1e-8)
        np.testing.assert_allclose(forward.covariances[k], covariances[-1], atol=1e-8)


def test_at_the_last_stamp_hindsight_knows_no_more():
    _, given_ = walk(2)
    forward, estimate = kalman_filter(*given_, PARAMS), smooth(*given_, PARAMS)
    np.testing.assert_array_equal(estimate.states[-1], forward.states[-1])
    less = np.linalg.eigvalsh(forward.covariances - estimate.covariances)
    assert less.min() > -1e-12  # nowhere is anything known less well
    assert less[:-1].max(axis=1).min() > 0


def test_errors_shrink_and_agree_with_the_covariances():
    """150 walks: hindsight more than halves the filter's errors (0.43 and 0.38 of them); NEES is that of 4 numbers."""
    squares = {"filter": [], "smoother": []}
    nees = {"filter": [], "smoother": []}
    for seed in range(150):
        truth, given_ = walk(seed)
        for name, function in (("filter", kalman_filter), ("smoother", smooth)):
            estimate = function(*given_, PARAMS)
            error = estimate.states - truth
            squares[name].append(error**2)
            nees[name].append(np.einsum("ti,tij,tj->t", error, np.linalg.inv(estimate.covariances), error))
    rmse = {name: np.sqrt(np.mean(each, axis=(0, 1)).reshape(2, 2).sum(axis=1)) for name, each in squares.items()}
    assert rmse["smoother"][0] < 0.5 * rmse["filter"][0]
    assert rmse["smoother"][1] < 0.45 * rmse["filter"][1]
    assert np.mean(nees["filter"]) == pytest.approx(4, abs=0.25)
    assert np.mean(nees["smoother"]) == pytest.approx(4, abs=0.25)


@given(st.integers(0, 1000), st.floats(-3, 3))
def test_turning_the_measurements_turns_the_answer(seed, angle):
    _, (stamps, measured, positions, covs) = walk(seed, T=12)
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = smooth(stamps, measured, positions @ R.T + [3, -5], R @ covs @ R.T, PARAMS)
    states = smooth(stamps, measured, positions, covs, PARAMS).states
    np.testing.assert_allclose(turned.states[:, :2], states[:, :2] @ R.T + [3, -5], atol=1e-8)
    np.testing.assert_allclose(turned.states[:, 2:], states[:, 2:] @ R.T, atol=1e-8)


def test_the_noise_factor_is_on_the_measurements():
    _, (stamps, measured, positions, covs) = walk(4)
    doubled = smooth(stamps, measured, positions, covs, PARAMS.model_copy(update={"noise_factor": 2.0}))
    np.testing.assert_array_equal(doubled.states, smooth(stamps, measured, positions, 2 * covs, PARAMS).states)


def test_a_straight_walk_without_noise_is_found():
    stamps = np.arange(30) * 100_000_000
    positions = np.stack([1.2 * stamps * 1e-9, np.full(30, 2.0)], axis=1)
    estimate = smooth(stamps, np.ones(30, bool), positions, np.tile(1e-6 * np.eye(2), (30, 1, 1)))
    np.testing.assert_allclose(estimate.states[:, :2], positions, atol=1e-4)
    np.testing.assert_allclose(estimate.states[5:, 2:], np.tile([1.2, 0.0], (25, 1)), atol=1e-3)


def test_nothing_before_the_first_measurement_and_nothing_after_the_last():
    stamps = np.arange(10) * 100_000_000
    measured = np.isin(np.arange(10), [3, 4, 7])
    positions, covs = np.array([[0.0, 0], [0.1, 0], [0.4, 0]]), np.tile(0.01 * np.eye(2), (3, 1, 1))
    estimate = smooth(stamps, measured, positions, covs)
    np.testing.assert_array_equal(estimate.stamps_ns, stamps[3:8])
    assert estimate.states.shape == (5, 4)
    alone = smooth(stamps, np.arange(10) == 6, positions[:1], covs[:1], PARAMS)
    np.testing.assert_array_equal(alone.stamps_ns, stamps[6:7])
    np.testing.assert_array_equal(alone.states, [[0, 0, 0, 0]])
    np.testing.assert_allclose(alone.covariances[0], np.diag([0.01, 0.01, 1.44, 1.44]))


ONES = np.ones(3, bool)
STAMPS = np.arange(3) * 100_000_000
POSITIONS, COVS = np.zeros((3, 2)), np.tile(np.eye(2), (3, 1, 1))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((STAMPS, ONES[:2], POSITIONS, COVS), r"must both be \(T,\), got \(3,\), \(2,\)"),
        ((STAMPS, ONES, POSITIONS[:2], COVS), r"3 scans .* got \(2, 2\) and \(3, 2, 2\)"),
        ((STAMPS, ONES, POSITIONS[:, :, None], COVS), r"got \(3, 2, 1\)"),
        ((STAMPS, ONES, POSITIONS, COVS[0]), r"and \(2, 2\)"),
        ((STAMPS, ~ONES, POSITIONS[:0], COVS[:0]), "nothing was measured"),
        ((STAMPS, ONES, np.full((3, 2), np.nan), COVS), "finite"),
        ((STAMPS, ONES, POSITIONS, np.full((3, 2, 2), np.inf)), "finite"),
        ((STAMPS[::-1], ONES, POSITIONS, COVS), "must rise"),
        ((STAMPS * 0, ONES, POSITIONS, COVS), "must rise"),
    ],
)
def test_what_filterpy_would_take_in_silence_is_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        smooth(*arguments)


def test_what_is_given_is_left_as_it_was():
    _, given_ = walk(3, T=8)
    before = [each.copy() for each in given_]
    smooth(*given_, PARAMS)
    for each, was in zip(given_, before, strict=True):
        np.testing.assert_array_equal(each, was)
