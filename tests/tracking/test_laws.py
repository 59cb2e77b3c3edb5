"""Laws of the whole recursion over random scenes: mass, covariances, invariance, and equality with a plain loop."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.tracking import reference_filter
from tests.tracking.test_tracker import stamp
from tracking.gm_phd import FilterParams, correct, predict, survive
from tracking.measurements import make_measurements
from tracking.mixture_reduction import GaussianMixture, label_mass
from tracking.tracker import Tracker, TrackerParams, advance, initial_state

seeds = st.integers(0, 10_000)
PARAMS = TrackerParams()
COLUMNS = "born_ns", "born_index", "hits", "last_hit_ns", "confirmed", "measurement"
BELIEFS = "existence", "hidden", "class_log_odds"


def random_scans(seed, scans, half_m=5.0, dt_choices_s=(0.0, 0.05, 0.1, 0.1, 0.3)):
    """Yields stamps and scans: people who wander, with misses, clutter, long thin covariances, and any class.

    One measurement in ten may not be a new person.
    """
    generator = np.random.default_rng(seed)
    A, stamp_ns = generator.integers(1, 7), stamp(0)
    places, velocities = generator.uniform(-half_m, half_m, (A, 2)), generator.normal(0, 1, (A, 2))
    for _ in range(scans):
        dt_s = generator.choice(dt_choices_s)
        places, stamp_ns = places + dt_s * velocities, stamp_ns + round(dt_s * 1e9)
        seen = places[generator.random(A) < 0.85]
        noisy = seen + generator.normal(0, 0.12, seen.shape)
        points = np.concatenate([noisy, generator.uniform(-half_m, half_m, (generator.poisson(2), 2))])
        roots = generator.normal(0, 0.1, (len(points), 2, 2))
        covs = roots @ roots.swapaxes(1, 2) + 0.01 * np.eye(2)
        pedestrian, gives_birth = generator.uniform(0.02, 0.98, len(points)), generator.random(len(points)) < 0.9
        yield stamp_ns, make_measurements(points, covs, pedestrian, gives_birth=gives_birth)


def view(positions):
    """A detection probability that falls off softly to one side and ends sharply at another."""
    return np.where(positions[:, 0] > 3.5, 0.0, 0.45 - 0.45 * np.tanh((positions[:, 1] - 4) / 2))


def four_labels(mixture):
    """The mixture of 12 as the tracker's: three components a label, the heaviest first, and at most one person each."""
    weights = -np.sort(-mixture.weights.reshape(4, 3), axis=1)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1.0)
    return GaussianMixture(weights.ravel(), mixture.means, mixture.covs, np.repeat(np.arange(4), 3))


# --- mass ------------------------------------------------------------------------------------------------------------


@given(seeds, st.floats(0, 2))
def test_prediction_scales_the_mass_by_survival_and_no_label_gains(make_mixture, seed, dt_s):
    mixture = make_mixture(seed)
    in_view = np.random.default_rng(seed).choice([0.0, 0.9], len(mixture))
    predicted = survive(predict(mixture, dt_s, PARAMS.filter), in_view, dt_s, PARAMS.filter)
    stays = np.where(in_view > 0, np.exp(-dt_s / 20), np.exp(-dt_s / 2))
    for label in range(4):
        own = mixture.labels == label
        assert predicted.weights[own].sum() == pytest.approx(stays[own] @ mixture.weights[own])


@given(seeds, st.floats(0, 1))
def test_a_scan_gives_no_measurement_and_no_label_more_than_one_person(make_mixture, seed, p_detect):
    mixture = four_labels(make_mixture(seed))
    _, scan = next(random_scans(seed, 1, half_m=4))
    result = correct(
        mixture,
        scan,
        in_view=np.full(12, p_detect),
        in_view_at=np.zeros(len(scan)),
        hidden=np.zeros(4),
        pedestrian=np.full(4, 0.5),
        clutter_per_m2=PARAMS.filter.clutter_per_m2,
        params=PARAMS.filter,
    )
    owners = np.flatnonzero(result.measurement >= 0)
    assert len(set(result.measurement[owners])) == len(owners)
    detected = GaussianMixture(*(getattr(result.mixture, name)[12:] for name in ("weights", "means", "covs", "labels")))
    np.testing.assert_allclose(label_mass(detected, 4), result.explained)
    assert (result.explained[owners] + result.births[result.measurement[owners]] <= 1 + 1e-12).all()
    assert (label_mass(result.mixture, 4) <= 1 + 1e-12).all()


@settings(max_examples=15)
@given(seeds)
def test_after_each_scan_a_labels_mass_is_its_existence(seed):
    state = initial_state(stamp(0), PARAMS)
    for stamp_ns, scan in random_scans(seed, 25):
        state = advance(state, scan, stamp_ns, view, PARAMS)
        L = len(state.labels)
        np.testing.assert_allclose(label_mass(state.mixture, L), state.labels.existence)
        assert ((state.labels.existence > 0) & (state.labels.existence <= 1)).all()
        assert ((state.labels.hidden >= 0) & (state.labels.hidden <= 1)).all()
        assert np.isfinite(state.labels.class_log_odds).all()


# --- covariances -----------------------------------------------------------------------------------------------------


@settings(max_examples=15)
@given(seeds, st.sampled_from([0.01, 1.0, 10.0]))
def test_covariances_stay_symmetric_and_positive_definite_over_many_scans(seed, acceleration_mps2):
    """However briskly people move, and with gaps of half a minute between the scans."""
    params = TrackerParams(filter=FilterParams(acceleration_mps2=acceleration_mps2))
    state, least = initial_state(stamp(0), params), np.inf
    for stamp_ns, scan in random_scans(seed, 60, dt_choices_s=(0.0, 1e-6, 0.1, 0.1, 0.1, 0.1, 2.0, 30.0)):
        state = advance(state, scan, stamp_ns, view, params)
        covs = state.mixture.covs
        np.testing.assert_allclose(covs, covs.swapaxes(1, 2), rtol=1e-9, atol=1e-12)
        least = min(least, np.linalg.eigvalsh(covs).min(initial=np.inf))
    assert least > 0
    assert np.isfinite(least)


# --- invariance ------------------------------------------------------------------------------------------------------


@settings(max_examples=25)
@given(seeds, st.floats(-np.pi, np.pi), st.floats(-1000, 1000), st.floats(-1000, 1000))
def test_turning_and_moving_the_world_turns_and_moves_the_tracks(seed, angle, x, y):
    """Within a micrometre, at up to a kilometre. Measurements are sorted by place, so the ids' numbers may differ."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turn_state = np.kron(np.eye(2), turn)
    one, other, other_id = Tracker(), Tracker(), {}
    for stamp_ns, scan in random_scans(seed, 25):
        moved = make_measurements(
            scan.positions_m @ turn.T + [x, y],
            turn @ scan.covariances_m2 @ turn.T,
            scan.pedestrian_probability,
            gives_birth=scan.gives_birth,
        )
        tracks, others = one.step(scan, stamp_ns, 0.9), list(other.step(moved, stamp_ns, 0.9))
        assert len(tracks) == len(others)
        for track in tracks:
            expected = turn_state @ track.state + [x, y, 0, 0]
            twin = min(others, key=lambda candidate: np.hypot(*(candidate.state[:2] - expected[:2])))
            others.remove(twin)
            np.testing.assert_allclose(twin.state, expected, atol=1e-6)
            np.testing.assert_allclose(twin.covariance, turn_state @ track.covariance @ turn_state.T, atol=1e-6)
            assert twin.existence == pytest.approx(track.existence, abs=1e-6)
            assert (twin.age_ns, twin.coasting) == (track.age_ns, track.coasting)
            assert other_id.setdefault(track.id, twin.id) == twin.id
    assert len(set(other_id.values())) == len(other_id)


# --- equality with the reference -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_the_tracker_agrees_with_a_plain_loop_on_filterpy(seed):
    """Weights, means, covariances and everything a label remembers, through eight scans of a random scene."""
    state, labels, before_ns, repeats = initial_state(stamp(0), PARAMS), [], stamp(0), -1
    for stamp_ns, scan in random_scans(seed, 8):
        repeats = repeats + 1 if stamp_ns == before_ns else 0
        labels = reference_filter.step(
            labels, scan, stamp_ns, (stamp_ns - before_ns) * 1e-9, lambda place: float(view(place[None])[0]), PARAMS,
            clutter_per_m2=state.clutter.per_m2, repeats=repeats,
        )  # fmt: skip
        state = advance(state, scan, stamp_ns, view, PARAMS)
        before_ns = stamp_ns
        assert_agree(state, labels)
    assert len(labels) > 0


def assert_agree(state, labels):
    components = [component for label in labels for component in label.components]
    rows = [row for row, label in enumerate(labels) for _ in label.components]
    assert state.mixture.labels.tolist() == rows
    means = np.array([component.kalman.x[:, 0] for component in components]).reshape(-1, 4)
    covs = np.array([component.kalman.P for component in components]).reshape(-1, 4, 4)
    np.testing.assert_allclose(state.mixture.weights, [component.weight for component in components], rtol=1e-9)
    np.testing.assert_allclose(state.mixture.means, means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(state.mixture.covs, covs, rtol=1e-9, atol=1e-11)
    for column in COLUMNS:
        assert getattr(state.labels, column).tolist() == [getattr(label, column) for label in labels], column
    for column in BELIEFS:
        expected = [getattr(label, column) for label in labels]
        np.testing.assert_allclose(getattr(state.labels, column), expected, rtol=1e-9, atol=1e-12, err_msg=column)
