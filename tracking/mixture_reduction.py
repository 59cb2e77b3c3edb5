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
    index = np.flatnonzero(rows) if rows.dtype == bool else rows
    return GaussianMixture(
        mixture.weights.take(index),
        mixture.means.take(index, axis=0),
        mixture.covs.take(index, axis=0),
        mixture.labels.take(index),
    )


def label_mass(mixture: GaussianMixture, L: int) -> FloatArray:
    """Returns the summed weight (L,) of each label's components."""
    return np.bincount(mixture.labels, mixture.weights, L).astype(float, copy=False)


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
    mixture = select(mixture, np.lexsort((-mixture.weights, mixture.labels)))
    repeated = mixture.labels[1:] == mixture.labels[:-1]
    if not repeated.any():
        return mixture
    several = np.zeros(len(mixture), bool)
    several[1:] = repeated
    several[:-1] |= repeated
    rest = select(mixture, several)
    together = concatenate(
        select(mixture, ~several), _moment_match(rest, _pivots(rest, distance, components_per_label))
    )
    return select(together, np.lexsort((-together.weights, together.labels)))


def _pivots(mixture: GaussianMixture, distance: float, components_per_label: int) -> IntArray:
    """Returns the component (J,) that each one merges into; `mixture` is sorted by label, then by falling weight."""
    pivots = np.empty(len(mixture), np.int64)
    rest = np.arange(len(mixture))
    for turn in range(components_per_label):
        labels = mixture.labels[rest]
        first = np.ones(len(rest), bool)
        first[1:] = labels[1:] != labels[:-1]
        pivot = rest[first][np.cumsum(first) - 1]  # the heaviest of each label, beside each of its components
        others = np.flatnonzero(~first)
        if len(others) == 0 or turn == components_per_label - 1:
            pivots[rest] = pivot
            break
        near = first.copy()
        delta = mixture.means[rest[others]] - mixture.means[pivot[others]]
        inverse = np.linalg.inv(mixture.covs[pivot[others]])
        near[others] = (delta * (inverse @ delta[:, :, None])[:, :, 0]).sum(axis=1) < distance
        pivots[rest[near]] = pivot[near]
        rest = rest[~near]
    return pivots


def _moment_match(mixture: GaussianMixture, pivots: IntArray) -> GaussianMixture:
    """Returns one component per pivot, with the total weight, mean and covariance of those that merge into it."""
    order = np.argsort(pivots, kind="stable")
    mixture, pivots = select(mixture, order), pivots[order]
    first = np.ones(len(pivots), bool)
    first[1:] = pivots[1:] != pivots[:-1]
    starts, group = np.flatnonzero(first), np.cumsum(first) - 1
    weights = np.add.reduceat(mixture.weights, starts)
    share = mixture.weights / np.maximum(weights[group], 1e-300)
    means = np.add.reduceat(share[:, None] * mixture.means, starts)
    delta = mixture.means - means[group]
    spread = mixture.covs + delta[:, :, None] * delta[:, None, :]
    covs = np.add.reduceat(share[:, None, None] * spread, starts)
    return GaussianMixture(weights, means, covs, mixture.labels[starts])
