"""Keeps a labelled Gaussian mixture small: prune what has no weight, merge what one label says twice."""

from dataclasses import dataclass

import numpy as np

from schemas.messages import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """PHD intensity: weighted Gaussians over [x, y, vx, vy]. Weights sum to the expected number of people, not to 1."""

    weights: FloatArray  # (J,)  expected people per component
    means: FloatArray  # (J, 4)  m and m/s, odometry frame
    covs: FloatArray  # (J, 4, 4)
    labels: IntArray  # (J,)  row of the label each component belongs to

    def __len__(self) -> int:
        return len(self.weights)


def empty_mixture() -> GaussianMixture:
    """Returns the intensity of a place where nobody is."""
    return GaussianMixture(np.zeros(0), np.zeros((0, 4)), np.zeros((0, 4, 4)), np.zeros(0, np.int64))


def concatenate(*mixtures: GaussianMixture) -> GaussianMixture:
    """Returns all components, in the order given."""
    return GaussianMixture(
        np.concatenate([mixture.weights for mixture in mixtures]),
        np.concatenate([mixture.means for mixture in mixtures]),
        np.concatenate([mixture.covs for mixture in mixtures]),
        np.concatenate([mixture.labels for mixture in mixtures]),
    )


def select(mixture: GaussianMixture, rows: IntArray | BoolArray) -> GaussianMixture:
    """Returns the components at `rows`, an index or a mask."""
    return GaussianMixture(mixture.weights[rows], mixture.means[rows], mixture.covs[rows], mixture.labels[rows])


def label_mass(mixture: GaussianMixture, L: int) -> FloatArray:
    """Returns the summed weight (L,) of each label's components."""
    return np.bincount(mixture.labels, mixture.weights, L).astype(float)


def prune(mixture: GaussianMixture, weight: float, share: float = 0.0) -> GaussianMixture:
    """Drops components below `weight`, and those below `share` of their label's heaviest.

    What a label loses its other components take; a label that falls below `weight` altogether is gone.
    """
    if len(mixture) == 0:
        return mixture
    L = int(mixture.labels.max()) + 1
    mass = label_mass(mixture, L)
    heaviest = np.zeros(L)
    np.maximum.at(heaviest, mixture.labels, mixture.weights)
    keep = (mixture.weights >= weight) & (mixture.weights >= share * heaviest[mixture.labels])
    if keep.all():
        return mixture
    kept = select(mixture, keep)
    scale = mass / np.maximum(label_mass(kept, L), 1e-300)
    return GaussianMixture(kept.weights * scale[kept.labels], kept.means, kept.covs, kept.labels)


def merge(mixture: GaussianMixture, distance: float, components_per_label: int) -> GaussianMixture:
    """Merges components of one label that lie near its heaviest one, then near its next, and so on.

    Moment matching: a label's weight, and its mean, stay what they were. Components past `components_per_label` are the
    lightest of their label; they are merged into its last one whatever the distance, so that nothing is lost.

    Args:
        mixture: (J,) components.
        distance: squared Mahalanobis distance, measured with the heavier component's covariance.
        components_per_label: at most this many come out per label.

    Returns:
        Components in order of label, within one the heaviest group first.
    """
    if len(mixture) == 0:
        return mixture
    several = np.bincount(mixture.labels)[mixture.labels] > 1
    alone = select(mixture, np.flatnonzero(~several))
    rest = select(mixture, np.flatnonzero(several))
    rest = select(rest, np.lexsort((-rest.weights, rest.labels)))
    merged = [alone]
    for turn in range(components_per_label):
        if len(rest) == 0:
            break
        first = np.ones(len(rest), bool)
        first[1:] = rest.labels[1:] != rest.labels[:-1]
        group = np.cumsum(first) - 1  # (J,)  which pivot each component is held against
        pivot = np.flatnonzero(first)
        near = first | (turn == components_per_label - 1)
        others = np.flatnonzero(~near)
        if len(others):
            delta = rest.means[others] - rest.means[pivot[group[others]]]
            inverse = np.linalg.inv(rest.covs[pivot[group[others]]])
            near[others] = (delta * (inverse @ delta[:, :, None])[:, :, 0]).sum(axis=1) < distance
        merged.append(_moment_match(select(rest, near), group[near], len(pivot)))
        rest = select(rest, ~near)
    together = concatenate(*merged)
    return select(together, np.lexsort((-together.weights, together.labels)))


def _moment_match(mixture: GaussianMixture, group: IntArray, G: int) -> GaussianMixture:
    """Returns one component (G,) per group, with its total weight, mean and covariance."""
    if len(mixture) == G:
        return mixture
    starts = np.searchsorted(group, np.arange(G))
    weights = np.add.reduceat(mixture.weights, starts)
    share = mixture.weights / np.maximum(weights[group], 1e-300)
    means = np.add.reduceat(share[:, None] * mixture.means, starts)
    delta = mixture.means - means[group]
    spread = mixture.covs + delta[:, :, None] * delta[:, None, :]
    covs = np.add.reduceat(share[:, None, None] * spread, starts)
    return GaussianMixture(weights, means, covs, mixture.labels[starts])
