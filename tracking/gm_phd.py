"""The labelled Gaussian mixture PHD recursion; `step` is the whole of it: predict, correct, birth, reduce.

After Vo and Ma, "The Gaussian Mixture Probability Hypothesis Density Filter" (2006), with three changes: components
carry labels and a label owns at most one measurement of a scan; births happen at the measurements; and every weight
has a class likelihood in it. Pure functions: arrays in, arrays out.
Letters: J components, M measurements, P gated pairs, L labels.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from schemas.messages import BoolArray, FloatArray, IntArray
from tracking.assignment import assign
from tracking.avoidance import make_way
from tracking.measurements import Measurements
from tracking.mixture_reduction import GaussianMixture, concatenate, label_mass, merge, prune
from tracking.motion_model import process_noise, transition

_I4 = np.eye(4)
# Of a person at positions (N, 2), as (N,), or one number for everywhere. Exactly 0 means out of the sensors' view.
DetectionProbability = Callable[[FloatArray], FloatArray] | float


class FilterParams(BaseModel):
    """Settings of the recursion. The defaults were tuned on the tuning seeds and drives of benchmarks/tracking."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    acceleration_mps2: float = Field(
        default=0.85, gt=0, description="how briskly people change velocity, one sigma per axis"
    )
    avoidance_mps2: float = Field(
        default=2.0, ge=0, description="how briskly two people who are about to touch make way for each other"
    )
    avoidance_reach_m: float = Field(
        default=0.3, gt=0, description="and over what distance that falls to a third of it"
    )
    clutter_per_m2: float = Field(
        default=1.5e-3, gt=0, description="false measurements per scan and square metre, before any were counted"
    )
    birth_per_m2: float = Field(default=1e-5, gt=0, description="expected new people per scan and square metre")
    survival_s: float = Field(default=20.0, gt=0, description="mean time a person stays, where the sensors look")
    survival_unseen_s: float = Field(
        default=2.0, gt=0, description="and where they do not: without it ghosts never die"
    )
    birth_speed_mps: float = Field(default=1.0, gt=0, description="one sigma per axis of a new person's velocity")
    least_pedestrian_probability: float = Field(
        default=0.03, ge=0, lt=1, description="measurements below give no birth and keep no pedestrian alive"
    )
    gate: float = Field(default=25.0, gt=0, description="largest squared Mahalanobis distance of a pair")
    prune_weight: float = Field(default=1e-5, ge=0, description="components below this are dropped")
    prune_share: float = Field(
        default=0.03, ge=0, lt=1, description="so are those below this share of their label's heaviest"
    )
    merge_distance: float = Field(
        default=0.5, ge=0, description="squared Mahalanobis distance under which one label's merge"
    )
    components_per_label: int = Field(default=3, ge=1)
    resolution_m: float = Field(
        default=0.4, ge=0, description="this far from a measurement of somebody else, half of the people are in it"
    )


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


@dataclass(frozen=True, eq=False)
class Step:
    """What one scan made of the intensity. J, L and M as before the scan."""

    mixture: GaussianMixture  # posterior, reduced; labels born at this scan are L, L + 1, ...
    predicted: GaussianMixture  # (J,)
    in_view: FloatArray  # (J,)  detection probability where each predicted component is
    correction: "Correction"
    newborn: IntArray  # (B,)  measurements that gave birth, in the order of the new labels


def step(
    mixture: GaussianMixture,
    measurements: Measurements,
    dt_s: float,
    *,
    detection_probability: DetectionProbability,
    hidden: FloatArray,
    pedestrian: FloatArray,
    clutter_per_m2: float,
    params: FilterParams,
) -> Step:
    """Takes the intensity through one scan: Vo & Ma's Table I, with labels.

    Args:
        mixture: intensity after the scan before, sorted by label, the heaviest component of each first.
        measurements: (M,) of the scan, odometry frame.
        dt_s: since the scan before, not negative.
        detection_probability: of a person, by position.
        hidden: (L,) probability that a label cannot be measured wherever it is.
        pedestrian: (L,) probability that it is a pedestrian.
        clutter_per_m2: expected false measurements per square metre.
        params: settings.
    """
    predicted = predict(make_way(mixture, dt_s, params.avoidance_mps2, params.avoidance_reach_m), dt_s, params)
    in_view = probabilities(detection_probability, predicted.means[:, :2])
    predicted = survive(predicted, in_view, dt_s, params)
    correction = correct(
        predicted,
        measurements,
        in_view=in_view,
        in_view_at=probabilities(detection_probability, measurements.positions_m),
        hidden=hidden,
        pedestrian=pedestrian,
        clutter_per_m2=clutter_per_m2,
        params=params,
    )
    newborn = birthplaces(correction, measurements, params)
    labels = len(hidden) + np.arange(len(newborn))
    births = birth(measurements, newborn, correction.births[newborn], labels, params)
    return Step(reduce(concatenate(correction.mixture, births), params), predicted, in_view, correction, newborn)


def predict(mixture: GaussianMixture, dt_s: float, params: FilterParams) -> GaussianMixture:
    """Moves the mixture dt_s forward with constant velocity."""
    F = transition(dt_s)
    covs = F @ mixture.covs @ F.T + process_noise(dt_s, params.acceleration_mps2)
    return GaussianMixture(mixture.weights, mixture.means @ F.T, covs, mixture.labels)


def survive(predicted: GaussianMixture, in_view: FloatArray, dt_s: float, params: FilterParams) -> GaussianMixture:
    """Shrinks the weights by the probability of staying for dt_s; what is out of view (J,) is forgotten sooner."""
    lifetime_s = np.where(in_view > 0, params.survival_s, params.survival_unseen_s)
    return replace(predicted, weights=predicted.weights * np.exp(-dt_s / lifetime_s))


def probabilities(detection_probability: DetectionProbability, positions_m: FloatArray) -> FloatArray:
    """Returns the detection probability (N,) at positions (N, 2), kept between 0 and 1."""
    if callable(detection_probability):
        return np.minimum(np.maximum(detection_probability(positions_m), 0.0), 1.0)
    return np.full(len(positions_m), float(detection_probability))


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
        p_detect: (P,)
        class_likelihood: (P,) of what the cameras said of the measurement, if it is of the component's label.
        background: (M,) density of clutter plus births at each measurement, class likelihood included.
    """
    mass = p_detect * weights[pairs.component] * pairs.likelihood * class_likelihood
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
    owned_pairs: BoolArray = owned[edge] & (mass[edge] > 0)
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
    in_view: FloatArray,
    in_view_at: FloatArray,
    hidden: FloatArray,
    pedestrian: FloatArray,
    clutter_per_m2: float,
    params: FilterParams,
) -> "Correction":
    """Weighs, lets labels own, and updates: the labelled recursion from prediction to posterior, births still apart.

    Args:
        predicted: (J,) intensity at the time of the scan.
        measurements: (M,) of the scan.
        in_view: (J,) probability of measuring a person who stands where the component is.
        in_view_at: (M,) and where the measurement is: what was measured at the edge of the view was in view.
        hidden: (L,) probability that each label cannot be measured wherever it is.
        pedestrian: (L,) probability that each label is one.
        clutter_per_m2: expected false measurements per square metre.
        params: settings.
    """
    L = len(pedestrian)
    pairs = gate(predicted, measurements, params.gate)
    agreement = _agreement(
        pedestrian[predicted.labels[pairs.component]],
        measurements.pedestrian_probability[pairs.measurement],
        params.least_pedestrian_probability,
    )
    visible = 1 - hidden
    p_pair = np.maximum(in_view[pairs.component], in_view_at[pairs.measurement])
    p_pair = p_pair * visible[predicted.labels[pairs.component]]
    # Clutter is no pedestrian; what is born may be one or not, which cancels what the cameras say.
    background = clutter_per_m2 * (1 - measurements.pedestrian_probability) + 0.5 * params.birth_per_m2
    pair_weights, rest = weigh(predicted.weights, pairs, p_pair, agreement, background)
    births = 0.5 * params.birth_per_m2 * rest

    owned = own(predicted.labels, pairs, pair_weights)
    pairs, agreement, p_pair = pairs.where(owned), agreement[owned], p_pair[owned]
    pair_weights, _ = weigh(predicted.weights, pairs, p_pair, agreement, background)
    pair_label = predicted.labels[pairs.component]
    explained = np.minimum(np.bincount(pair_label, pair_weights, L), 1 - 1e-12)

    measurement = np.full(L, -1)
    measurement[pair_label] = pairs.measurement
    merged = unresolved(predicted, measurement, explained, measurements, params.resolution_m)
    p_detect = in_view * (visible * (1 - merged))[predicted.labels]
    missed, detected = update(predicted, pairs, pair_weights, measurements.covariances_m2, p_detect)
    missed_mass = label_mass(missed, L)
    # A label that owns a measurement was missed only in so far as the measurement is something else.
    missed = replace(missed, weights=missed.weights * (1 - explained[missed.labels]))
    return Correction(concatenate(missed, detected), births, measurement, explained, missed_mass, merged)


def unresolved(
    predicted: GaussianMixture,
    measurement: IntArray,
    explained: FloatArray,
    measurements: Measurements,
    resolution_m: float,
) -> FloatArray:
    """Returns the probability (L,) that a label without a measurement is in another label's: two people, one cluster.

    Koch and van Keuk, "Multiple hypothesis track maintenance with possibly unresolved measurements" (1997): it falls
    like a Gaussian with the distance, here averaged over where the label and the measurement may be.

    Args:
        predicted: mixture sorted by label, the heaviest component of a label first; every label has one.
        measurement: (L,) which one each label owns, or -1.
        explained: (L,) probability that it is the label's.
        measurements: of the scan.
        resolution_m: distance at which half of the people are not seen apart.
    """
    out = np.zeros(len(measurement))
    alone, owner = np.flatnonzero(measurement < 0), np.flatnonzero(measurement >= 0)
    taken = measurement[owner]
    if len(alone) == 0 or len(taken) == 0 or resolution_m == 0:
        return out
    width = resolution_m**2 / (2 * math.log(2))
    heaviest = np.searchsorted(predicted.labels, alone)
    means, P, z = predicted.means[heaviest], predicted.covs[heaviest], measurements.positions_m[taken]
    R = measurements.covariances_m2[taken]
    # A box first, as in `gate`: 8 sigma away there is nothing left.
    reach_x = 8 * np.sqrt(P[:, 0, 0] + R[:, 0, 0].max() + width)
    reach_y = 8 * np.sqrt(P[:, 1, 1] + R[:, 1, 1].max() + width)
    near = np.abs(z[:, 0] - means[:, 0, None]) < reach_x[:, None]
    near &= np.abs(z[:, 1] - means[:, 1, None]) < reach_y[:, None]
    i, j = np.divmod(np.flatnonzero(near), len(z))
    x, y = means[i, 0] - z[j, 0], means[i, 1] - z[j, 1]
    sxx, sxy, syy = (P[i, r, c] + R[j, r, c] for r, c in ((0, 0), (0, 1), (1, 1)))
    sxx, syy = sxx + width, syy + width
    determinant = sxx * syy - sxy * sxy
    squared = (syy * x * x - 2 * sxy * x * y + sxx * y * y) / determinant
    np.maximum.at(out, alone[i], explained[owner[j]] * width / np.sqrt(determinant) * np.exp(-0.5 * squared))
    return out


@dataclass(frozen=True, eq=False)
class Correction:
    """What one scan did to the mixture and to each label."""

    mixture: GaussianMixture  # missed components, then detected ones; not reduced
    births: FloatArray  # (M,)  weight of a new label at each measurement
    measurement: IntArray  # (L,)  which one the label owns, or -1
    explained: FloatArray  # (L,)  probability that the owned measurement is the label's, below 1
    missed_mass: FloatArray  # (L,)  mass had the label owned nothing
    unresolved: FloatArray  # (L,)  probability of being part of another label's measurement


def _agreement(p: FloatArray, q: FloatArray, least: float) -> FloatArray:
    """Returns the probability that two independent opinions on "is a pedestrian" agree; 1/2 where one knows nothing.

    What is surely nobody, q below `least`, keeps no pedestrian alive: cars have no labels that could claim their
    clusters, and whoever is hidden behind one would take it over.
    """
    return np.where((q < least) & (p > 0.5), 0.0, p * q + (1 - p) * (1 - q))


def birthplaces(correction: Correction, measurements: Measurements, params: FilterParams) -> IntArray:
    """Returns the measurements (B,) at which a new label is worth having: nobody's, likely enough, and by its class."""
    likely = correction.births >= params.prune_weight
    likely[correction.measurement[correction.explained > 0.5]] = False
    likely &= measurements.pedestrian_probability >= params.least_pedestrian_probability
    return np.flatnonzero(likely & measurements.gives_birth)


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
