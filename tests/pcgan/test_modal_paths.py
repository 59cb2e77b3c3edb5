"""MultiPAC against a plain loop over scikit-learn's DBSCAN, and cases worked out by hand."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import DBSCAN

from pcgan.modal_paths import MIN_WEIGHT_SHARE, cluster_eps_m, modal_paths


def plain_modal_paths(weights, means, eps_m):
    """One pedestrian, (P, K) and (P, K, 2): list of (probability, (P, 2) path), most probable first."""
    P, K = weights.shape
    levels = []
    for step in range(P):
        live = np.flatnonzero(weights[step] >= MIN_WEIGHT_SHARE / K)
        labels = DBSCAN(eps=eps_m, min_samples=1).fit(means[step, live]).labels_
        level = []
        for label in range(labels.max() + 1):
            members = live[labels == label]
            mass = weights[step, members].sum()
            centroid = (weights[step, members, None] * means[step, members]).sum(axis=0) / mass
            level.append((mass, centroid))
        levels.append(level)
    paths = []
    for mass, centroid in levels[-1]:
        path = [centroid]
        for level in levels[-2::-1]:
            path.append(min((c for _, c in level), key=lambda c: np.linalg.norm(c - path[-1])))
        paths.append((mass, np.array(path[::-1])))
    total = sum(mass for mass, _ in paths)
    return sorted(((mass / total, path) for mass, path in paths), key=lambda pair: -pair[0])


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), K=st.integers(1, 8), P=st.integers(1, 6), spread=st.floats(0.2, 4))
def test_batched_agrees_with_the_plain_loop(seed, K, P, spread):
    rng = np.random.default_rng(seed)
    A = 4
    weights = rng.dirichlet(np.full(K, 0.7), (A, P))
    means = np.cumsum(rng.normal(0, spread, (A, P, K, 2)), axis=1)
    found = modal_paths(torch.from_numpy(weights), torch.from_numpy(means), eps_m=1.0)
    for a in range(A):
        expected = plain_modal_paths(weights[a], means[a], 1.0)
        probabilities = found.probabilities[a].numpy()
        np.testing.assert_allclose(probabilities[: len(expected)], [p for p, _ in expected], atol=1e-12)
        assert not probabilities[len(expected) :].any()
        for k, (_, path) in enumerate(expected):
            np.testing.assert_allclose(found.points[a, k].numpy(), path, atol=1e-9)


def test_chain_of_close_means_is_one_cluster():
    means = torch.tensor([[0.0, 0], [5, 0], [1, 0], [4, 0], [2, 0], [3, 0]]).reshape(1, 1, 6, 2)
    found = modal_paths(torch.full((1, 1, 6), 1 / 6), means, eps_m=1.01)
    assert found.probabilities[0].tolist() == pytest.approx([1, 0, 0, 0, 0, 0])
    assert found.points[0, 0].tolist() == [pytest.approx([2.5, 0])]


def test_two_branches_share_their_trunk():
    means = torch.tensor([[[0.0, 0], [0, 0.2]], [[1, 2], [1, -2]], [[2, 4], [2, -4]]]).unsqueeze(0)
    weights = torch.tensor([[[0.5, 0.5], [0.4, 0.6], [0.3, 0.7]]])
    found = modal_paths(weights, means, eps_m=1.0)
    assert found.probabilities[0].tolist() == pytest.approx([0.7, 0.3])
    np.testing.assert_allclose(found.points[0, 0], [[0, 0.1], [1, -2], [2, -4]], atol=1e-6)
    np.testing.assert_allclose(found.points[0, 1], [[0, 0.1], [1, 2], [2, 4]], atol=1e-6)


def test_faint_component_is_left_out():
    means = torch.tensor([[[[0.0, 0], [9, 9]]]])
    found = modal_paths(torch.tensor([[[0.8, 0.2]]]), means, eps_m=1.0)  # 0.2 < 0.5 / 2
    assert found.probabilities[0].tolist() == [1, 0]
    assert found.points[0, 0, 0].tolist() == [0, 0]


def test_gradient_flows_through_centroids_and_weights():
    means = torch.tensor([[[[0.0, 0], [0.4, 0]], [[1, 0], [1.4, 0]]]], requires_grad=True)
    logits = torch.zeros(1, 2, 2, requires_grad=True)
    found = modal_paths(logits.softmax(-1), means, eps_m=1.0)
    found.points[0, 0, :, 0].sum().backward()
    np.testing.assert_allclose(means.grad[..., 0], [[[0.5, 0.5], [0.5, 0.5]]], atol=1e-6)
    np.testing.assert_allclose(logits.grad, [[[-0.1, 0.1], [-0.1, 0.1]]], atol=1e-6)  # a quarter of the gap of 0.4


def test_eps_grows_with_the_horizon():
    assert cluster_eps_m(4.8) == pytest.approx(1.0)
    assert cluster_eps_m(1.2) == pytest.approx(0.125)


def test_no_pedestrians_give_no_paths():
    found = modal_paths(torch.zeros(0, 3, 6), torch.zeros(0, 3, 6, 2), 1.0)
    assert found.points.shape == (0, 6, 3, 2)
