"""MultiPAC: the likely modal paths in a sequence of Gaussian mixtures (Eiffert et al. 2020, after Zyner et al. 2019).

At each predicted step the components whose means lie within `eps_m` of one another, directly or through others, form
one cluster (DBSCAN with min_samples 1, which is connected components). Clusters are linked back to the nearest one a
step earlier; each cluster of the last step is the end of one modal path.

The paper names no eps. Its author's code has 1 m, for horizons of 4.8 s. How far people stray from a straight line
grows with time to the power 1.5 (a random walk in velocity), and at 1.2 s a whole metre never splits anything: so eps
scales with the horizon, `cluster_eps_m`.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

PAPER_EPS_M, PAPER_HORIZON_S = 1.0, 4.8
MIN_WEIGHT_SHARE = 0.5  # a component below 0.5 / K is left out


@dataclass(frozen=True, eq=False)
class ModalPaths:
    """Up to K paths per pedestrian, most probable first; the rest have probability 0 and repeat a real path."""

    probabilities: Tensor  # (A, K)    sum to 1
    points: Tensor  # (A, K, P, 2) m


def cluster_eps_m(horizon_s: float) -> float:
    """Returns the clustering distance for a horizon: 1 m at 4.8 s, 0.125 m at 1.2 s."""
    return float(PAPER_EPS_M * (horizon_s / PAPER_HORIZON_S) ** 1.5)


def modal_paths(weights: Tensor, means: Tensor, eps_m: float) -> ModalPaths:
    """Returns the modal paths of A pedestrians, all at once.

    Args:
        weights: (A, P, K) probabilities of the components at each step.
        means: (A, P, K, 2) their means in m.
        eps_m: means at most this far apart belong together.

    Gradients flow through the centroids and the weights; which component belongs where is constant to them.
    """
    # K is small and A is not: with the pedestrians on the last axis every operation runs over long rows.
    w = weights.permute(2, 1, 0).contiguous()  # (K, P, A)
    x, y = means.permute(3, 2, 1, 0).contiguous()  # (K, P, A) each
    live = w >= MIN_WEIGHT_SHARE / len(w)  # never empty: the largest weight is at least 1 / K
    member, is_root = _clusters(x.detach(), y.detach(), live, eps_m)

    share = member.to(w.dtype) * w  # (K clusters, K members, P, A)
    mass = share.sum(dim=1)  # (K, P, A) 0 where there is no cluster
    divisor = mass.masked_fill(~is_root, 1)
    x, y = (share * x).sum(dim=1) / divisor, (share * y).sum(dim=1) / divisor  # centroids

    branch = _branches(x.detach(), y.detach(), is_root)  # (K, P, A)
    points = torch.stack([x.gather(0, branch), y.gather(0, branch)], dim=-1)  # (K, P, A, 2)
    probabilities = mass[:, -1] / mass[:, -1].sum(dim=0)  # (K, A)
    order = probabilities.argsort(dim=0, descending=True, stable=True)
    points = points.gather(0, order[:, None, :, None].expand_as(points))
    return ModalPaths(probabilities.gather(0, order).transpose(0, 1), points.permute(2, 0, 1, 3))


def _clusters(x: Tensor, y: Tensor, live: Tensor, eps_m: float) -> tuple[Tensor, Tensor]:
    """Returns which component is in which cluster (K, K, ...) bool, and which index stands for a cluster (K, ...) bool.

    A cluster goes by its lowest component. The closure is Warshall's: K passes that let links run over component k
    as well. It gives what three squarings of the adjacency give, with a third of the work.
    """
    K = len(x)
    distance2 = (x.unsqueeze(1) - x).square() + (y.unsqueeze(1) - y).square()  # (K, K, ...)
    reach = (distance2 <= eps_m * eps_m) & live.unsqueeze(1) & live
    for k in range(K):
        reach = reach | (reach[:, k].unsqueeze(1) & reach[k])
    lower = torch.ones(K, K, dtype=torch.bool, device=x.device).tril(-1)[..., None, None]  # (K, K, 1, 1)
    is_root = live & ~(reach & lower).any(dim=1)
    return reach & is_root.unsqueeze(1), is_root


def _branches(x: Tensor, y: Tensor, is_root: Tensor) -> Tensor:
    """Returns which cluster of each step the K paths run through, (K, P, A); the last step's are 0..K-1.

    An index of the last step that is no cluster borrows the path of the pedestrian's first cluster.
    """
    K, P = is_root.shape[:2]
    now_x, now_y, then_x, then_y = x[:, None, 1:], y[:, None, 1:], x[None, :, :-1], y[None, :, :-1]
    distance2 = (now_x - then_x).square() + (now_y - then_y).square()  # (K now, K one step earlier, P-1, A)
    not_there = (~is_root[:, :-1]).to(x.dtype) * 1e30
    parent = (distance2 + not_there).min(dim=1).indices  # (K, P-1, A); argmin is ten times slower here
    own = torch.arange(K, device=x.device).unsqueeze(-1)  # (K, 1)
    index = torch.where(is_root[:, -1], own, is_root[:, -1].to(torch.uint8).argmax(dim=0))  # (K, A)
    branches = [index]
    for step in range(P - 2, -1, -1):
        index = parent[:, step].gather(0, index)
        branches.append(index)
    return torch.stack(branches[::-1], dim=1)
