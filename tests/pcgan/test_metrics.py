"""Expected values worked out by hand, one named case each."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from pcgan import metrics

STRAIGHT = np.array([[1.0, 0], [2, 0], [3, 0], [4, 0]])
BESIDE = np.array([[1.0, 1], [2, 1], [3, 1], [4, 1]])


def test_path_one_metre_off_everywhere():
    assert metrics.ade(BESIDE, STRAIGHT) == 1
    assert metrics.fde(BESIDE, STRAIGHT) == 1
    assert metrics.mhd(BESIDE, STRAIGHT) == 1


def test_path_that_drifts_off():
    drifting = STRAIGHT + np.array([[0, 0.0], [0, 1], [0, 2], [0, 3]])
    assert metrics.ade(drifting, STRAIGHT) == 1.5
    assert metrics.fde(drifting, STRAIGHT) == 3


def test_late_path_has_a_small_mhd():
    late = STRAIGHT - np.array([1, 0])  # only its first point is off the other path, by 1 m; so is the other's last one
    assert metrics.ade(late, STRAIGHT) == 1
    assert metrics.mhd(late, STRAIGHT) == 0.25


def test_mhd_takes_the_larger_direction():
    short = STRAIGHT[:1]  # its one point lies on the path; the path's points are 0, 1, 2, 3 m from it
    assert metrics.mhd(short, STRAIGHT) == 1.5
    assert metrics.mhd(STRAIGHT, short) == 1.5


@given(st.integers(0, 2**31))
def test_errors_do_not_see_a_rigid_motion(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 3, 5, 2))
    angle = rng.uniform(0, 7)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for metric in (metrics.ade, metrics.fde, metrics.mhd):
        assert metric(a, b).shape == (3,)
        np.testing.assert_allclose(metric(a @ turn.T + 7, b @ turn.T + 7), metric(a, b), atol=1e-9)
        np.testing.assert_allclose(metric(a, b), metric(b, a))


def test_nll_of_one_gaussian_is_scipys():
    sigma, rho = np.array([0.5, 2.0]), 0.6
    covariance = np.array([[0.25, 0.6], [0.6, 4.0]])
    points = np.array([[0.3, -1.0], [5.0, 0.0]])
    mean = np.array([0.1, 0.2])
    expected = -multivariate_normal(mean, covariance).logpdf(points).mean()
    found = metrics.nll(
        np.ones((2, 1)), np.tile(mean, (2, 1, 1)), np.tile(sigma, (2, 1, 1)), np.full((2, 1), rho), points
    )
    assert found == pytest.approx(expected)


def test_nll_ignores_components_of_no_weight():
    weights = np.array([[1.0, 0.0]])
    means = np.zeros((1, 2, 2))
    one = metrics.nll(weights[:, :1], means[:, :1], np.ones((1, 1, 2)), np.zeros((1, 1)), np.zeros((1, 2)))
    two = metrics.nll(weights, means, np.ones((1, 2, 2)), np.zeros((1, 2)), np.zeros((1, 2)))
    assert one == two == pytest.approx(np.log(2 * np.pi))


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match=r"got \(4, 3\)"):
        metrics.ade(np.zeros((4, 3)), np.zeros((4, 3)))
    with pytest.raises(ValueError, match="4 and 3 steps"):
        metrics.fde(STRAIGHT, STRAIGHT[:3])


def test_who_has_collided():
    """Three walk abreast, 0.1 and 0.5 m apart, and the outer two swap at the last step; one comes late."""
    paths = np.zeros((3, 2, 2))
    paths[:, 0, 1] = [0.0, 0.1, 0.6]
    paths[:, 1, 1] = [0.6, 0.1, 0.0]
    there = np.ones((3, 2), bool)
    assert metrics.collided(paths, there).tolist() == [[True, False], [True, True], [False, True]]
    there[0, 0] = False
    assert metrics.collided(paths, there).tolist() == [[False, False], [False, True], [False, True]]
    assert not metrics.collided(paths[:1], there[:1]).any()
