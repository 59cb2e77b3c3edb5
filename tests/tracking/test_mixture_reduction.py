"""Pruning and merging: what they keep, and agreement with plain loops."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking.mixture_reduction import GaussianMixture, concatenate, empty_mixture, label_mass, merge, prune, select

seeds = st.integers(0, 10_000)


def plain_merge(mixture, distance, components_per_label):
    """The same rule, one component at a time."""
    out = []
    for label in sorted(set(mixture.labels.tolist())):
        rest = [j for j in np.argsort(-mixture.weights, kind="stable") if mixture.labels[j] == label]
        groups = []
        while rest:
            pivot = rest[0]
            inverse = np.linalg.inv(mixture.covs[pivot])
            last = len(groups) == components_per_label - 1
            delta = {j: mixture.means[j] - mixture.means[pivot] for j in rest}
            group = [j for j in rest if last or j == pivot or delta[j] @ inverse @ delta[j] < distance]
            rest = [j for j in rest if j not in group]
            w = sum(mixture.weights[j] for j in group)
            m = sum(mixture.weights[j] * mixture.means[j] for j in group) / w
            P = sum(
                mixture.weights[j] * (mixture.covs[j] + np.outer(mixture.means[j] - m, mixture.means[j] - m))
                for j in group
            )
            groups.append((w, m, P / w, label))
        out += sorted(groups, key=lambda g: -g[0])
    return out


@given(seeds, st.sampled_from([0.5, 4.0, 50.0]), st.integers(1, 4))
def test_merge_agrees_with_a_plain_loop(make_mixture, seed, distance, components):
    mixture = make_mixture(seed)
    merged = merge(mixture, distance, components)
    expected = plain_merge(mixture, distance, components)
    np.testing.assert_allclose(merged.weights, [g[0] for g in expected])
    np.testing.assert_allclose(merged.means, [g[1] for g in expected], atol=1e-12)
    np.testing.assert_allclose(merged.covs, [g[2] for g in expected], atol=1e-12)
    assert merged.labels.tolist() == [g[3] for g in expected]


@given(seeds, st.integers(1, 3))
def test_merge_keeps_weight_and_mean_of_every_label(make_mixture, seed, components):
    mixture = make_mixture(seed)
    merged = merge(mixture, 4.0, components)
    L = 4
    np.testing.assert_allclose(label_mass(merged, L), label_mass(mixture, L))
    for label in range(L):
        old, new = mixture.labels == label, merged.labels == label
        np.testing.assert_allclose(
            merged.weights[new] @ merged.means[new], mixture.weights[old] @ mixture.means[old], atol=1e-10
        )
    assert (np.linalg.eigvalsh(merged.covs) > 0).all()
    assert np.bincount(merged.labels).max() <= components


@given(seeds)
def test_labels_never_merge(make_mixture, seed):
    mixture = make_mixture(seed, J=6, L=6)
    same_place = GaussianMixture(mixture.weights, np.zeros((6, 4)), mixture.covs, np.arange(6))
    assert len(merge(same_place, 1e9, 3)) == 6


@given(seeds, st.floats(0, 0.5))
def test_pruning_by_share_keeps_each_labels_mass(make_mixture, seed, share):
    mixture = make_mixture(seed)
    np.testing.assert_allclose(label_mass(prune(mixture, 0.0, share), 4), label_mass(mixture, 4))


def test_pruning_by_weight_drops_whole_labels(make_mixture):
    mixture = make_mixture(3, J=3, L=1)
    mixture = GaussianMixture(np.array([0.5, 1e-6, 0.2]), mixture.means, mixture.covs, np.array([0, 1, 2]))
    assert prune(mixture, 1e-5).labels.tolist() == [0, 2]


def test_nothing_stays_nothing(make_mixture):
    assert len(merge(prune(empty_mixture(), 1e-5, 1e-3), 4.0, 3)) == 0
    assert len(concatenate(empty_mixture(), empty_mixture())) == 0
    assert len(select(make_mixture(), np.zeros(12, bool))) == 0


def test_all_pruned_is_empty(make_mixture):
    assert len(prune(make_mixture(), 10.0)) == 0


def test_merging_one_component_returns_it(make_mixture):
    mixture = make_mixture(J=1, L=1)
    merged = merge(mixture, 4.0, 3)
    assert merged.weights == pytest.approx(mixture.weights)
    np.testing.assert_array_equal(merged.means, mixture.means)
