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


# --- gradients -------------------------------------------------------------------------------------------------------


def clear_mixtures(seed, A=2, P=3, K=4):
    """Weights (A, P, K) and means (A, P, K, 2) whose clusters do not change within 0.2 m: pairs 0.4 m or 6 m apart."""
    rng = np.random.default_rng(seed)
    places = np.array([[0.0, 0], [0.4, 0], [6, 0], [6, 0.4]])[:K]
    means = places + rng.uniform(-0.05, 0.05, (A, P, K, 2)) + 0.5 * np.arange(P)[:, None, None]
    logits = rng.uniform(-0.4, 0.4, (A, P, K))
    return torch.from_numpy(logits).requires_grad_(), torch.from_numpy(means).requires_grad_()


@pytest.mark.parametrize("seed", range(3))
def test_gradients_are_those_of_finite_differences(seed):
    """Of every point and probability, by every weight and mean, while no mean changes its cluster."""
    logits, means = clear_mixtures(seed)

    def paths(logits, means):
        found = modal_paths(logits.softmax(dim=-1), means, eps_m=1.0)
        return found.points[:, :2], found.probabilities[:, :2]

    assert (paths(logits, means)[1] > 0.1).all()  # two clusters each
    assert torch.autograd.gradcheck(paths, (logits, means), eps=1e-6, atol=1e-7)


def test_gradient_moves_only_what_is_on_the_path():
    """A path of the first cluster pulls at its two members, by their weights; the other cluster's gets nothing."""
    logits, means = clear_mixtures(0, A=1)
    with torch.no_grad():
        logits[..., :2] += 1  # the first cluster is the most probable
    weights = logits.softmax(dim=-1)
    modal_paths(weights, means, eps_m=1.0).points[0, 0, :, 0].sum().backward()
    share = weights.detach()[0, :, :2] / weights.detach()[0, :, :2].sum(dim=-1, keepdim=True)
    torch.testing.assert_close(means.grad[0, :, :2, 0], share)
    assert not means.grad[..., 2:, :].any()
    assert not means.grad[..., 1].any()


def test_faint_component_gets_no_gradient():
    means = torch.tensor([[[[0.0, 0], [0.3, 0], [0.1, 0]]]], requires_grad=True)
    logits = torch.tensor([[[1.0, 1.0, -2.0]]], requires_grad=True)
    weights = logits.softmax(dim=-1)
    assert weights[0, 0, 2] < MIN_WEIGHT_SHARE / 3
    modal_paths(weights, means, eps_m=1.0).points.sum().backward()
    assert means.grad[0, 0, :, 0].tolist()[:2] == pytest.approx([1.5, 1.5])  # three paths, all the same one
    assert not means.grad[0, 0, 2].any()


def test_unused_slots_repeat_a_real_path_and_have_no_probability():
    logits, means = clear_mixtures(1, A=3, K=3)
    found = modal_paths(logits.softmax(dim=-1), means, eps_m=1.0)
    assert ((found.probabilities > 0).sum(dim=1) == 2).all()
    torch.testing.assert_close(found.probabilities.sum(dim=1), torch.ones(3).double())
    real = [any(torch.equal(found.points[a, 2], found.points[a, k]) for k in (0, 1)) for a in range(3)]
    assert real == [True] * 3


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), angle=st.floats(-3, 3))
def test_turning_the_means_turns_the_paths(seed, angle):
    rng = np.random.default_rng(seed)
    weights = torch.from_numpy(rng.dirichlet(np.full(5, 0.7), (3, 4)))
    means = torch.from_numpy(np.cumsum(rng.normal(0, 1, (3, 4, 5, 2)), axis=1))
    c, s = np.cos(angle), np.sin(angle)
    turn = torch.tensor([[c, s], [-s, c]], dtype=torch.float64)
    still, turned = modal_paths(weights, means, 1.0), modal_paths(weights, means @ turn + 3, 1.0)
    torch.testing.assert_close(turned.probabilities, still.probabilities)
    torch.testing.assert_close(turned.points, still.points @ turn + 3)
