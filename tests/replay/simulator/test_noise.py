import numpy as np
import pytest

from replay.simulator.noise import CorrelatedNoise


def test_values_are_unit_normal_and_correlated_as_asked():
    noise = CorrelatedNoise((0.5, 2.0), np.random.default_rng(0))
    ids = np.arange(4000)
    first = noise.at(ids, 0.0)
    second = noise.at(ids, 0.5)
    assert second.std(axis=0) == pytest.approx([1, 1], abs=0.04)
    correlation = [np.corrcoef(first[:, c], second[:, c])[0, 1] for c in (0, 1)]
    assert correlation == pytest.approx([np.exp(-1), np.exp(-0.25)], abs=0.04)


def test_values_follow_the_id_not_the_place():
    noise = CorrelatedNoise((1e9,), np.random.default_rng(0))
    before = dict(zip([5, 2, 9], noise.at(np.array([5, 2, 9]), 0.0)[:, 0], strict=True))
    after = dict(zip([9, 5, 4], noise.at(np.array([9, 5, 4]), 0.1)[:, 0], strict=True))
    assert after[5] == pytest.approx(before[5], abs=1e-3)
    assert after[9] == pytest.approx(before[9], abs=1e-3)


def test_who_was_away_starts_anew():
    noise = CorrelatedNoise((1e9,), np.random.default_rng(0))
    before = noise.at(np.array([1]), 0.0)
    assert noise.at(np.zeros(0, np.int64), 0.1).shape == (0, 1)
    assert abs(noise.at(np.array([1]), 0.2) - before) > 1e-3
