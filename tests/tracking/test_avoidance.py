"""Making way: who swerves, which way, and that it stays a second hypothesis."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking.avoidance import SHARE, make_way
from tracking.mixture_reduction import GaussianMixture, label_mass


def people(*states, weight=0.9):
    L = len(states)
    return GaussianMixture(
        np.full(L, weight), np.array(states, float), np.tile(np.eye(4) * 0.01, (L, 1, 1)), np.arange(L)
    )


def swerves(mixture, dt_s=0.1, acceleration_mps2=2.0):
    """By how much each label's second component is faster than its first, (L, 2); 0 without one."""
    moved = make_way(mixture, dt_s, acceleration_mps2, 0.3)
    out = np.zeros((len(mixture), 2))
    for label, state in zip(moved.labels, moved.means, strict=True):
        difference = state[2:] - mixture.means[label, 2:]
        out[label] = difference if np.abs(difference).max() > np.abs(out[label]).max() else out[label]
    return out


def test_two_who_meet_swerve_to_opposite_sides():
    """Head-on, one 0.2 m to the left of the other's line: each to the side where there is room, and both brake."""
    first, second = swerves(people([0, 0, 1.3, 0], [0.7, 0.2, -1.3, 0]))
    assert first[1] < 0 < second[1]
    assert first[0] < 0 < second[0]
    np.testing.assert_allclose(first, -second)


def test_nobody_swerves_from_who_walks_along_goes_away_or_is_far():
    along = people([0, 0, 1.3, 0], [0, 0.5, 1.3, 0])
    apart = people([0, 0, -1.3, 0], [0.6, 0, 1.3, 0])
    far = people([0, 0, 1.3, 0], [2.5, 0, -1.3, 0])
    for mixture in (along, apart, far):
        assert make_way(mixture, 0.1, 2.0, 0.3) is mixture


def test_ghosts_push_nobody():
    mixture = people([0, 0, 1.3, 0], [0.6, 0.1, -1.3, 0], weight=0.4)
    assert make_way(mixture, 0.1, 2.0, 0.3) is mixture


def test_it_can_be_turned_off():
    mixture = people([0, 0, 1.3, 0], [0.6, 0.1, -1.3, 0])
    assert make_way(mixture, 0.1, 0.0, 0.3) is mixture


def test_walking_on_stays_a_hypothesis_and_no_mass_is_lost():
    mixture = people([0, 0, 1.3, 0], [0.6, 0.1, -1.3, 0], [9, 9, 0, 0])
    moved = make_way(mixture, 0.1, 2.0, 0.3)
    assert moved.labels.tolist() == [0, 0, 1, 1, 2]
    np.testing.assert_allclose(label_mass(moved, 3), 0.9)
    np.testing.assert_allclose(moved.weights, [0.9 * SHARE, 0.9 * (1 - SHARE)] * 2 + [0.9])
    np.testing.assert_array_equal(moved.means[[1, 3, 4]], mixture.means)


def test_a_long_step_swerves_no_further_than_a_short_one():
    mixture = people([0, 0, 1.3, 0], [0.6, 0.1, -1.3, 0])
    np.testing.assert_allclose(swerves(mixture, 30.0), swerves(mixture, 0.2))
    assert make_way(mixture, 0.0, 2.0, 0.3).means == pytest.approx(np.repeat(mixture.means, 2, axis=0))


@given(seed=st.integers(0, 1000), angle=st.floats(-3, 3))
def test_it_turns_with_the_world(seed, angle):
    generator = np.random.default_rng(seed)
    states = np.concatenate([generator.uniform(-2, 2, (8, 2)), generator.normal(0, 1, (8, 2))], axis=1)
    c, s = np.cos(angle), np.sin(angle)
    R = np.kron(np.eye(2), [[c, -s], [s, c]])
    a, b = swerves(people(*states)), swerves(people(*(states @ R.T)))
    np.testing.assert_allclose(b, a @ R[:2, :2].T, atol=1e-9)
