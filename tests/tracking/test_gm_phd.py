"""The recursion: closed forms, laws over random mixtures, and plain-loop references."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking.gm_phd import FilterParams, correct, gate, own, predict, reduce, update, weigh
from tracking.measurements import empty_measurements, make_measurements
from tracking.mixture_reduction import GaussianMixture, concatenate
from tracking.motion_model import process_noise, transition

PARAMS = FilterParams()
H = np.eye(2, 4)
seeds = st.integers(0, 10_000)


def make_scan(seed=0, M=8):
    generator = np.random.default_rng(seed)
    roots = generator.normal(0, 0.3, (M, 2, 2))
    return make_measurements(
        generator.normal(0, 3, (M, 2)), roots @ roots.swapaxes(1, 2) + 0.01 * np.eye(2), generator.uniform(0.1, 0.9, M)
    )


def corrected(mixture, scan, p_detect, *, labels, params=PARAMS, in_view_at=0.0, pedestrian=0.5):
    """The correction where everybody is as easy to see."""
    return correct(
        mixture,
        scan,
        in_view=np.full(len(mixture), p_detect),
        in_view_at=np.full(len(scan), in_view_at),
        hidden=np.zeros(labels),
        pedestrian=np.full(labels, pedestrian),
        clutter_per_m2=params.clutter_per_m2,
        params=params,
    )


def plain_update(mixture, scan, p_detect, background, gate_limit):
    """Vo & Ma's Table I, one pair at a time."""
    detected = []
    for m, (z, R) in enumerate(zip(scan.positions_m, scan.covariances_m2, strict=True)):
        terms = []
        for j in range(len(mixture)):
            S = H @ mixture.covs[j] @ H.T + R
            v = z - H @ mixture.means[j]
            d2 = v @ np.linalg.inv(S) @ v
            if d2 < gate_limit:
                q = np.exp(-d2 / 2) / (2 * np.pi * np.sqrt(np.linalg.det(S)))
                K = mixture.covs[j] @ H.T @ np.linalg.inv(S)
                P = (np.eye(4) - K @ H) @ mixture.covs[j]
                terms.append((j, m, p_detect[j] * mixture.weights[j] * q, mixture.means[j] + K @ v, P))
        total = background[m] + sum(term[2] for term in terms)
        detected += [(j, m, w / total, mean, P) for j, m, w, mean, P in terms]
    return sorted(detected, key=lambda term: term[:2])


@given(seeds)
def test_update_agrees_with_a_plain_loop(make_mixture, seed):
    mixture, scan = make_mixture(seed), make_scan(seed)
    p_detect = np.random.default_rng(seed).uniform(0.5, 1, len(mixture))
    background = np.full(len(scan), 0.01)
    pairs = gate(mixture, scan, PARAMS.gate)
    ones = np.ones(len(pairs.component))
    weights, leftover = weigh(mixture.weights, pairs, p_detect[pairs.component], ones, background)
    missed, detected = update(mixture, pairs, weights, scan.covariances_m2, p_detect)
    expected = plain_update(mixture, scan, p_detect, background, PARAMS.gate)
    assert list(zip(pairs.component.tolist(), pairs.measurement.tolist(), strict=True)) == [e[:2] for e in expected]
    np.testing.assert_allclose(detected.weights, [e[2] for e in expected], rtol=1e-9)
    np.testing.assert_allclose(detected.means, np.array([e[3] for e in expected]).reshape(-1, 4), atol=1e-9)
    np.testing.assert_allclose(detected.covs, np.array([e[4] for e in expected]).reshape(-1, 4, 4), atol=1e-9)
    np.testing.assert_allclose(missed.weights, (1 - p_detect) * mixture.weights)
    # What the pairs do not explain of a measurement is background: the shares add up to one.
    explained = np.bincount(pairs.measurement, weights, len(scan))
    np.testing.assert_allclose(explained + background * leftover, 1)


def test_one_component_and_one_detection_is_a_kalman_filter():
    kalman = pytest.importorskip("filterpy.kalman")
    generator = np.random.default_rng(4)
    dt_s, R = 0.1, np.diag([0.02, 0.03])
    reference = kalman.KalmanFilter(dim_x=4, dim_z=2)
    reference.F, reference.H, reference.R, reference.Q = transition(dt_s), H, R, process_noise(dt_s, 1.0)
    reference.x, reference.P = np.array([[1.0], [2.0], [0.5], [-0.5]]), np.diag([0.1, 0.1, 1.0, 1.0])
    mixture = GaussianMixture(np.ones(1), reference.x.T.copy(), reference.P[None].copy(), np.zeros(1, np.int64))
    for _ in range(50):
        z = reference.x[:2, 0] + generator.normal(0, 0.1, 2)
        reference.predict()
        reference.update(z[:, None])
        predicted = predict(mixture, dt_s, FilterParams(acceleration_mps2=1.0))
        scan = make_measurements(z[None], R)
        pairs = gate(predicted, scan, 1e9)
        weights, _ = weigh(predicted.weights, pairs, np.ones(1), np.ones(1), np.zeros(1))
        missed, mixture = update(predicted, pairs, weights, scan.covariances_m2, np.ones(1))
        assert missed.weights.tolist() == [0.0]
        assert mixture.weights.tolist() == [1.0]
        np.testing.assert_allclose(mixture.means[0], reference.x[:, 0], atol=1e-9)
        np.testing.assert_allclose(mixture.covs[0], reference.P, atol=1e-9)


@given(seeds, st.floats(0, 1))
def test_no_detections_scale_the_mass(make_mixture, seed, p_detect):
    mixture = make_mixture(seed)
    correction = corrected(mixture, empty_measurements(), p_detect, labels=4)
    np.testing.assert_allclose(correction.mixture.weights.sum(), (1 - p_detect) * mixture.weights.sum())
    assert (correction.explained == 0).all()


@given(seeds)
def test_weights_and_covariances_stay_sound(make_mixture, seed):
    mixture = reduce(make_mixture(seed, J=24), PARAMS)  # sorted by label, as the tracker's is
    predicted = predict(mixture, 0.1, PARAMS)
    np.testing.assert_array_equal(predicted.weights, mixture.weights)
    correction = corrected(predicted, make_scan(seed), 0.9, labels=4)
    posterior = reduce(correction.mixture, PARAMS)
    assert (correction.mixture.weights >= 0).all()
    assert (posterior.weights > 0).all()
    np.testing.assert_allclose(posterior.covs, posterior.covs.swapaxes(1, 2), atol=1e-9)
    assert (np.linalg.eigvalsh(posterior.covs) > 0).all()
    assert (correction.explained < 1).all()
    assert (correction.births > 0).all()


@given(seeds)
def test_each_label_owns_one_measurement_and_the_best_way(make_mixture, seed):
    mixture, scan = make_mixture(seed, J=5, L=3), make_scan(seed, 4)
    pairs = gate(mixture, scan, PARAMS.gate)
    weights, _ = weigh(mixture.weights, pairs, *np.full((2, len(pairs.component)), 0.9), np.full(len(scan), 0.01))
    owned = own(mixture.labels, pairs, weights)
    chosen = {(int(mixture.labels[j]), int(m)) for j, m in zip(pairs.component[owned], pairs.measurement[owned])}  # noqa: B905
    assert len({label for label, _ in chosen}) == len({m for _, m in chosen}) == len(chosen)
    mass = np.zeros((3, len(scan)))
    np.add.at(mass, (mixture.labels[pairs.component], pairs.measurement), weights)
    best = max(sum(mass[i, m] for i, m in enumerate(p)) for p in itertools.permutations(range(len(scan)), 3))
    assert sum(mass[label, m] for label, m in chosen) == pytest.approx(best)


def test_a_measurement_a_track_accounts_for_gives_next_to_no_birth():
    cov = np.diag([0.02, 0.02, 0.5, 0.5])
    mixture = GaussianMixture(np.ones(1), np.zeros((1, 4)), cov[None], np.zeros(1, np.int64))
    scan = make_measurements(np.array([[0.0, 0.0], [10.0, 0.0]]), np.eye(2) * 0.02)
    births = corrected(mixture, scan, 0.9, labels=1).births
    assert births[0] < births[1] / 100


def test_the_cameras_word_moves_births(make_mixture):
    scan = make_measurements(np.array([[0.0, 0.0], [10.0, 0.0]]), np.eye(2) * 0.02, np.array([0.05, 0.95]))
    empty = make_mixture(J=0)
    births = corrected(empty, scan, 0.9, labels=0).births
    assert births[1] > 10 * births[0]


def standing(*places, sigma_m=0.1):
    """One sure person per place, not moving."""
    means = np.zeros((len(places), 4))
    means[:, :2] = places
    cov = np.diag([sigma_m**2, sigma_m**2, 0.1, 0.1])
    return GaussianMixture(np.full(len(places), 0.9), means, np.tile(cov, (len(places), 1, 1)), np.arange(len(places)))


def test_a_miss_beside_a_measured_neighbour_may_be_a_merged_cluster():
    """Three people, one measurement: the one next to it may be in it, the one far away may not."""
    scan = make_measurements(np.array([[0.0, 0.0]]), np.eye(2) * 0.01)
    mixture = standing([0, 0], [0.3, 0], [5, 0])
    correction = corrected(mixture, scan, 0.9, labels=3)
    assert correction.measurement.tolist() == [0, -1, -1]
    owner, near, far = correction.unresolved
    assert owner == 0 == pytest.approx(far, abs=1e-9)
    assert 0.3 < near < 0.8
    assert correction.missed_mass[1] > 2 * correction.missed_mass[2]
    apart = corrected(mixture, scan, 0.9, labels=3, params=FilterParams(resolution_m=0.0))
    assert apart.unresolved.tolist() == [0.0, 0.0, 0.0]


def test_half_of_the_people_at_the_resolution_are_not_seen_apart():
    scan = make_measurements(np.array([[0.0, 0.0]]), np.eye(2) * 0.0025)
    exact = standing([0, 0], [PARAMS.resolution_m, 0], sigma_m=1e-3)
    assert corrected(exact, scan, 0.9, labels=2).unresolved[1] == pytest.approx(0.5, abs=0.02)


def test_what_is_surely_nobody_keeps_no_pedestrian_alive():
    """A car's cluster next to where somebody is hidden."""
    scan = make_measurements(np.array([[0.3, 0.0]]), np.eye(2) * 0.01, np.array([0.01]))
    assert corrected(standing([0, 0]), scan, 0.9, labels=1, pedestrian=0.95).measurement.tolist() == [-1]
    assert corrected(standing([0, 0]), scan, 0.9, labels=1, pedestrian=0.05).measurement.tolist() == [0]


def test_what_was_measured_was_in_view():
    """The prediction lies just outside the view, the measurement inside: it is still the label's."""
    scan = make_measurements(np.array([[0.1, 0.0]]), np.eye(2) * 0.01)
    assert corrected(standing([0, 0]), scan, 0.0, labels=1).measurement.tolist() == [-1]
    seen = corrected(standing([0, 0]), scan, 0.0, labels=1, in_view_at=0.9)
    assert seen.measurement.tolist() == [0]
    assert seen.explained[0] > 0.9


def test_gate_of_nothing(make_mixture):
    mixture = make_mixture(J=0)
    assert len(gate(concatenate(mixture), make_scan(), 16.0).component) == 0
    assert len(gate(make_mixture(), empty_measurements(), 16.0).component) == 0
