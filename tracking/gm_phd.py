"""The labelled Gaussian mixture PHD recursion: predict, correct (gate, weigh, own, update), birth, reduce.

After Vo and Ma, "The Gaussian Mixture Probability Hypothesis Density Filter" (2006), with three changes: components
carry labels and a label owns at most one measurement of a scan; births happen at the measurements; and every weight
has a class likelihood in it. Pure functions: arrays in, arrays out.
Letters: J components, M measurements, P gated pairs, L labels.
"""

from dataclasses import dataclass, replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from schemas.messages import BoolArray, FloatArray, IntArray
from tracking.assignment import assign
from tracking.measurements import Measurements
from tracking.mixture_reduction import GaussianMixture, concatenate, label_mass, merge, prune
from tracking.motion_model import process_noise, transition

_I4 = np.eye(4)


class FilterParams(BaseModel):
    """Settings of the recursion. The defaults were tuned on benchmarks/tracking/crowd.py's tuning seeds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    acceleration_mps2: float = Field(
        default=1.0, gt=0, description="how briskly people change velocity, one sigma per axis"
    )
    clutter_per_m2: float = Field(
        default=1.5e-3, gt=0, description="expected false measurements per scan and square metre"
    )
    birth_per_m2: float = Field(default=1e-5, gt=0, description="expected new people per scan and square metre")
    birth_speed_mps: float = Field(default=1.0, gt=0, description="one sigma per axis of a new person's velocity")
    gate: float = Field(default=25.0, gt=0, description="largest squared Mahalanobis distance of a pair")
    prune_weight: float = Field(default=1e-5, ge=0, description="components below this are dropped")
    prune_share: float = Field(
        default=1e-3, ge=0, lt=1, description="so are those below this share of their label's heaviest"
    )
    merge_distance: float = Field(
        default=4.0, ge=0, description="squared Mahalanobis distance under which one label's merge"
    )
    components_per_label: int = Field(default=3, ge=1)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Component and measurement pairs inside the gate, in order of component, then measurement."""

    component: IntArray  # (P,)
    measurement: IntArray  # (P,)
    innovation_m: FloatArray  # (P, 2)
    S_inverse: FloatArray  # (P, 2, 2)
    likelihood: FloatArray  # (P,)  density of the measurement's position under the component, 1/m^2

    def where(self, keep: BoolArray) -> "Pairs":
        """Returns the pairs marked True."""
        kept = np.flatnonzero(keep)
        return Pairs(
            self.component.take(kept),
            self.measurement.take(kept),
            self.innovation_m.take(kept, axis=0),
            self.S_inverse.take(kept, axis=0),
            self.likelihood.take(kept),
        )


def predict(
    mixture: GaussianMixture, dt_s: float, params: FilterParams, survival: FloatArray | float = 1.0
) -> GaussianMixture:
    """Moves the mixture dt_s forward with constant velocity; weights shrink by `survival`, (J,) or one number."""
    F = transition(dt_s)
    covs = F @ mixture.covs @ F.T + process_noise(dt_s, params.acceleration_mps2)
    return GaussianMixture(mixture.weights * survival, mixture.means @ F.T, covs, mixture.labels)


def gate(predicted: GaussianMixture, measurements: Measurements, limit: float) -> Pairs:
    """Returns every pair whose squared Mahalanobis distance is below `limit`, with the measurement's likelihood.

    A box around each component is tried first, since most of the J x M pairs are far apart.
    """
    z, R = measurements.positions_m, measurements.covariances_m2
    if len(z) == 0 or len(predicted.weights) == 0:
        return Pairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0))
    x, y = predicted.means[:, 0], predicted.means[:, 1]
    (pxx, pxy), (pyx, pyy) = predicted.covs[:, :2, :2].transpose(1, 2, 0)  # (J,) each
    (rxx, rxy), (ryx, ryy) = R.transpose(1, 2, 0)  # (M,) each
    reach_x, reach_y = np.sqrt(limit * (pxx + rxx.max())), np.sqrt(limit * (pyy + ryy.max()))
    near = np.abs(z[:, 0] - x[:, None]) < reach_x[:, None]  # (J, M)
    near &= np.abs(z[:, 1] - y[:, None]) < reach_y[:, None]
    j, m = np.divmod(np.flatnonzero(near), len(z))
    sxx, sxy, syx, syy = pxx[j] + rxx[m], pxy[j] + rxy[m], pyx[j] + ryx[m], pyy[j] + ryy[m]
    determinant = sxx * syy - sxy * syx
    dx, dy = z[:, 0][m] - x[j], z[:, 1][m] - y[j]
    distance = (syy * dx * dx - 2 * sxy * dx * dy + sxx * dy * dy) / determinant
    innovation, S_inverse = np.empty((len(j), 2)), np.empty((len(j), 2, 2))
    innovation[:, 0], innovation[:, 1] = dx, dy
    S_inverse[:, 0, 0], S_inverse[:, 1, 1] = syy / determinant, sxx / determinant
    S_inverse[:, 0, 1] = S_inverse[:, 1, 0] = -sxy / determinant
    likelihood = np.exp(-0.5 * distance) / (2 * np.pi * np.sqrt(determinant))
    return Pairs(j, m, innovation, S_inverse, likelihood).where(distance < limit)


def weigh(
    weights: FloatArray, pairs: Pairs, p_detect: FloatArray, class_likelihood: FloatArray, background: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns each pair's weight (P,) and what is left of each measurement (M,) for clutter and births.

    Vo & Ma's eq. 20: a measurement stands for at most one person, so its pairs share it with the background.

    Args:
        weights: (J,) predicted.
        pairs: the gated ones.
        p_detect: (J,)
        class_likelihood: (P,) of what the cameras said of the measurement, if it is of the component's label.
        background: (M,) density of clutter plus births at each measurement, class likelihood included.
    """
    mass = p_detect[pairs.component] * weights[pairs.component] * pairs.likelihood * class_likelihood
    total = background + np.bincount(pairs.measurement, mass, len(background))
    return mass / total[pairs.measurement], 1 / total


def own(component_labels: IntArray, pairs: Pairs, pair_weights: FloatArray) -> BoolArray:
    """Marks the pairs (P,) that remain when each label may own one measurement and each measurement one label.

    The assignment with the largest total mass (Hungarian).
    """
    label = component_labels[pairs.component]
    if len(label) == 0:
        return np.zeros(0, bool)
    M = int(pairs.measurement.max()) + 1
    edge = label * M + pairs.measurement  # (P,)  several components of a label give one edge
    edges = np.flatnonzero(np.bincount(edge))
    mass = np.bincount(edge, pair_weights).astype(float, copy=False)
    owned = np.zeros(len(mass), bool)
    owned[edges] = assign(edges // M, edges % M, mass[edges])
    owned_pairs: BoolArray = owned[edge]
    return owned_pairs


def update(
    predicted: GaussianMixture,
    pairs: Pairs,
    pair_weights: FloatArray,
    covariances_m2: FloatArray,
    p_detect: FloatArray,
) -> tuple[GaussianMixture, GaussianMixture]:
    """Returns Vo & Ma's posterior in its two parts: J missed components, and one detected one per pair.

    Args:
        predicted: intensity at the time of the measurements.
        pairs: gated ones, and owned ones if labels own measurements.
        pair_weights: (P,) from `weigh`.
        covariances_m2: (M, 2, 2) of the measurements.
        p_detect: (J,)
    """
    missed = GaussianMixture(predicted.weights * (1 - p_detect), predicted.means, predicted.covs, predicted.labels)
    j = pairs.component
    P = predicted.covs[j]
    K = P[:, :, :2] @ pairs.S_inverse  # (P, 4, 2)
    means = predicted.means[j] + (K @ pairs.innovation_m[:, :, None])[:, :, 0]
    I_KH = np.empty_like(P)
    I_KH[:] = _I4
    I_KH[:, :, :2] -= K
    # Joseph's form stays symmetric and positive whatever the rounding.
    covs = I_KH @ P @ I_KH.swapaxes(1, 2) + K @ covariances_m2[pairs.measurement] @ K.swapaxes(1, 2)
    return missed, GaussianMixture(pair_weights, means, covs, predicted.labels[j])


def correct(
    predicted: GaussianMixture,
    measurements: Measurements,
    *,
    p_detect: FloatArray,
    label_probability: FloatArray,
    params: FilterParams,
) -> "Correction":
    """Weighs, lets labels own, and updates: the labelled recursion from prediction to posterior, births still apart.

    Args:
        predicted: (J,) intensity at the time of the scan.
        measurements: (M,) of the scan.
        p_detect: (J,)
        label_probability: (L,) that each label is a pedestrian.
        params: settings.
    """
    L = len(label_probability)
    pairs = gate(predicted, measurements, params.gate)
    agreement = _agreement(
        label_probability[predicted.labels[pairs.component]], measurements.pedestrian_probability[pairs.measurement]
    )
    # Clutter is no pedestrian; what is born may be one or not, which cancels what the cameras say.
    background = params.clutter_per_m2 * (1 - measurements.pedestrian_probability) + 0.5 * params.birth_per_m2
    pair_weights, rest = weigh(predicted.weights, pairs, p_detect, agreement, background)
    births = 0.5 * params.birth_per_m2 * rest

    owned = own(predicted.labels, pairs, pair_weights)
    pairs, agreement = pairs.where(owned), agreement[owned]
    pair_weights, _ = weigh(predicted.weights, pairs, p_detect, agreement, background)
    pair_label = predicted.labels[pairs.component]
    explained = np.minimum(np.bincount(pair_label, pair_weights, L), 1 - 1e-12)

    missed, detected = update(predicted, pairs, pair_weights, measurements.covariances_m2, p_detect)
    missed_mass = label_mass(missed, L)
    # A label that owns a measurement was missed only in so far as the measurement is something else.
    missed = replace(missed, weights=missed.weights * (1 - explained[missed.labels]))
    measurement = np.full(L, -1)
    measurement[pair_label] = pairs.measurement
    return Correction(concatenate(missed, detected), births, measurement, explained, missed_mass)


@dataclass(frozen=True, eq=False)
class Correction:
    """What one scan did to the mixture and to each label."""

    mixture: GaussianMixture  # missed components, then detected ones; not reduced
    births: FloatArray  # (M,)  weight of a new label at each measurement
    measurement: IntArray  # (L,)  which one the label owns, or -1
    explained: FloatArray  # (L,)  probability that the owned measurement is the label's, below 1
    missed_mass: FloatArray  # (L,)  mass had the label owned nothing


def _agreement(p: FloatArray, q: FloatArray) -> FloatArray:
    """Returns the probability that two independent opinions on "is a pedestrian" agree; 1/2 where one knows nothing."""
    both: FloatArray = p * q + (1 - p) * (1 - q)
    return both


def birth(
    measurements: Measurements, rows: IntArray, weights: FloatArray, labels: IntArray, params: FilterParams
) -> GaussianMixture:
    """Returns one component for each of the measurements at `rows`, standing there with unknown velocity."""
    means, covs = np.zeros((len(rows), 4)), np.zeros((len(rows), 4, 4))
    means[:, :2] = measurements.positions_m[rows]
    covs[:, :2, :2] = measurements.covariances_m2[rows]
    covs[:, 2, 2] = covs[:, 3, 3] = params.birth_speed_mps**2
    return GaussianMixture(weights, means, covs, labels)


def reduce(mixture: GaussianMixture, params: FilterParams) -> GaussianMixture:
    """Prunes, then merges within each label; components come out in order of label, the heaviest first."""
    pruned = prune(mixture, params.prune_weight, params.prune_share)
    return merge(pruned, params.merge_distance, params.components_per_label)
