"""People make way for each other: of two who approach, each may swerve and brake. A term of the motion prediction.

Without it tracks cut through one another exactly where they are easiest to mistake. A social force after Helbing and
Molnar (1995), used in tracking as by Pellegrini et al., "You'll Never Walk Alone" (2009); here only between those who
approach, so that people who walk together are left together, and as a second hypothesis beside that of walking on.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from schemas.messages import FloatArray, IntArray
from tracking.mixture_reduction import GaussianMixture, concatenate, select

FARTHEST_M = 1.5  # the force is next to nothing from here on
CONTACT_M = 0.5  # between the middles of two people who touch
NEAREST_M = 0.1
FULL_CLOSING_MPS = 0.5  # who approaches more slowly makes less way
LONGEST_S = 0.2  # over a longer step nobody knows who met whom; people make way for so long
LEAST_MPS2 = 0.3  # a smaller acceleration is not worth a hypothesis
SHARE = 0.7  # of those who should make way, so many do


def make_way(mixture: GaussianMixture, dt_s: float, acceleration_mps2: float, reach_m: float) -> GaussianMixture:
    """Returns the mixture with a second component for everybody who may make way in the dt_s to come.

    Args:
        mixture: sorted by label, the heaviest component of each first, which says where its person is.
        dt_s: length of the step that is about to be predicted.
        acceleration_mps2: of two people who touch; 0 turns it off.
        reach_m: over this distance the acceleration falls to 1 / e.
    """
    if acceleration_mps2 == 0 or len(mixture) == 0:
        return mixture
    first = np.searchsorted(mixture.labels, np.arange(int(mixture.labels[-1]) + 1))
    real = first[mixture.weights[first] > 0.5]
    total = _accelerations(mixture.means[real], acceleration_mps2, reach_m)
    strong = np.flatnonzero(np.hypot(total[:, 0], total[:, 1]) > LEAST_MPS2)
    if len(strong) == 0:
        return mixture
    rows, total, t = real[strong], total[strong], min(dt_s, LONGEST_S)
    swerving = select(mixture, rows)
    means = swerving.means + np.concatenate([0.5 * t * t * total, t * total], axis=1)
    weights = mixture.weights.copy()
    weights[rows] *= 1 - SHARE
    both = concatenate(
        replace(mixture, weights=weights), replace(swerving, means=means, weights=swerving.weights * SHARE)
    )
    return select(both, np.lexsort((-both.weights, both.labels)))


def _accelerations(states: FloatArray, acceleration_mps2: float, reach_m: float) -> FloatArray:
    """Returns by how much each of A people with states (A, 4) accelerates away from those who come nearer, (A, 2)."""
    total = np.zeros((len(states), 2))
    if len(states) < 2:
        return total
    i, j = _pairs(states[:, :2])
    apart, relative = states[i, :2] - states[j, :2], states[i, 2:] - states[j, 2:]
    gap = np.maximum(np.hypot(apart[:, 0], apart[:, 1]), NEAREST_M)
    away = apart / gap[:, None]
    closing = -(relative * away).sum(axis=1)
    eager = np.minimum(np.maximum(closing / FULL_CLOSING_MPS, 0.0), 1.0)
    force = (acceleration_mps2 * eager * np.exp((CONTACT_M - gap) / reach_m))[:, None] * away
    np.add.at(total, i, force)
    np.add.at(total, j, -force)
    return total


def _pairs(places_m: FloatArray) -> tuple[IntArray, IntArray]:
    """Returns who is near whom, each pair once, in an order of its own: sums depend on it."""
    pairs = KDTree(places_m).query_pairs(FARTHEST_M, output_type="ndarray")
    i, j = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
    return i, j
