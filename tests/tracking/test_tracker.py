"""Labels, existence and identity: what is published, when, and that it repeats. Harder scenes: test_hard_cases.py."""

import numpy as np
import pytest

from tracking.measurements import empty_measurements, make_measurements
from tracking.tracker import LateScanError, Tracker, TrackerParams

START_NS, STEP_NS = 1_600_000_000_000_000_000, 100_000_000
SIGMA_M = 0.1


def stamp(k):
    return START_NS + k * STEP_NS


def scan_of(positions, probability=None, seed=None):
    positions = np.asarray(positions, float).reshape(-1, 2)
    if seed is not None:
        positions = positions + np.random.default_rng(seed).normal(0, SIGMA_M, positions.shape)
    chances = None if probability is None else np.full(len(positions), probability)
    return make_measurements(positions, np.eye(2) * SIGMA_M**2, chances)


def walk(tracker, paths, first=0, seen=None, p_detect=0.9):
    """Steps through paths (T, A, 2); `seen` (T, A) says who is measured. Returns the tracks of every scan."""
    out = []
    for k, places in enumerate(np.asarray(paths, float), first):
        shown = places if seen is None else places[seen[k - first]]
        out.append(tracker.step(scan_of(shown, seed=k), stamp(k), p_detect))
    return out


def straight(T, start, velocity):
    return np.asarray(start, float) + np.arange(T)[:, None] * 0.1 * np.asarray(velocity, float)


def nearest_ids(tracks, places, reach_m=1.0):
    """The id of the track nearest each place; None without one in reach."""
    ids = []
    for place in places:
        near = [(np.hypot(*(track.state[:2] - place)), track.id) for track in tracks]
        near = [entry for entry in near if entry[0] < reach_m]
        ids.append(min(near)[1] if near else None)
    return ids


def same_tracks(a, b):
    return len(a) == len(b) and all(
        (x.id, x.existence, x.age_ns, x.coasting) == (y.id, y.existence, y.age_ns, y.coasting)
        and np.array_equal(x.state, y.state)
        and np.array_equal(x.covariance, y.covariance)
        and np.array_equal(x.history.states, y.history.states)
        and np.array_equal(x.history.stamps_ns, y.history.stamps_ns)
        and np.array_equal(x.history.coasting, y.history.coasting)
        for x, y in zip(a, b, strict=True)
    )


def test_one_walker_is_one_track_with_the_right_state_and_history():
    tracker = Tracker()
    path = straight(60, [0, 0], [1.2, 0.5])
    results = walk(tracker, path[:, None])
    (track,) = results[-1]
    assert {t.id for tracks in results for t in tracks} == {1}
    assert len(results[0]) == 0  # one hit is not enough
    assert len(results[2]) == 1
    np.testing.assert_allclose(track.state, [*path[-1], 1.2, 0.5], atol=0.3)
    assert track.existence > 0.9
    assert track.age_ns == 59 * STEP_NS
    history = track.history
    assert history.stamps_ns[-1] == stamp(59)
    assert history.stamps_ns[-1] - history.stamps_ns[0] == 3_600_000_000
    assert (np.diff(history.stamps_ns) > 0).all()
    np.testing.assert_array_equal(history.states[-1], track.state)
    assert np.isfinite(history.states).all()
    assert not history.coasting.any()
    # The covariance is honest: the error of a track is what it says.
    assert 0.02 < np.sqrt(track.covariance[0, 0]) < 0.1


def test_published_covariance_agrees_with_the_errors():
    """Mean squared Mahalanobis distance of the position errors is near 2, its expectation."""
    squared = []
    for seed in range(20):
        tracker, path = Tracker(), straight(30, [0, 0], [1.3, 0])
        for k, place in enumerate(path):
            tracks = tracker.step(scan_of(place, seed=1000 * seed + k), stamp(k), 0.95)
        error = tracks[0].state[:2] - path[-1]
        squared.append(error @ np.linalg.inv(tracks[0].covariance[:2, :2]) @ error)
    assert 0.8 < np.mean(squared) < 3.2


@pytest.mark.parametrize("explained", [True, False])
def test_id_survives_an_occlusion(explained):
    """Two seconds without a measurement; if the visibility model knows why, or if it does not."""
    tracker = Tracker()
    path = straight(70, [0, 0], [1.0, 0.2])
    for k, place in enumerate(path):
        hidden = 30 <= k < 50
        scan = empty_measurements() if hidden else scan_of(place, seed=k)
        tracks = tracker.step(scan, stamp(k), 0.1 if hidden and explained else 0.9)
        if k == 29:
            (before,) = tracks
        if hidden and k >= 35 and tracks:
            assert tracks[0].coasting
            assert tracks[0].history.coasting[-1]
    (after,) = tracks
    assert after.id == before.id
    assert not after.coasting
    hidden_stamps = [stamp(k) for k in range(34, 50)]  # within the 3.6 s
    assert after.history.coasting[np.isin(after.history.stamps_ns, hidden_stamps)].all()


def test_single_missed_scans_do_not_matter():
    tracker = Tracker()
    path = straight(100, [0, 0], [1.3, 0])
    seen = np.ones((100, 1), bool)
    seen[20::7] = False
    results = walk(tracker, path[:, None], seen=seen)
    assert all(len(tracks) == 1 and tracks[0].id == 1 for tracks in results[5:])
    assert not any(tracks[0].coasting for tracks in results[5:])


def test_someone_who_leaves_is_forgotten():
    tracker = Tracker()
    walk(tracker, np.zeros((30, 1, 2)))
    results = walk(tracker, np.zeros((100, 0, 2)), first=30)
    assert len(results[0]) == 1
    assert not any(results[30:])


def test_ghosts_out_of_view_die():
    """Detection probability 0 explains every miss; without a shorter survival there a ghost would be immortal."""
    tracker = Tracker()
    walk(tracker, np.zeros((30, 1, 2)))
    for k in range(30, 60):
        tracks = tracker.step(empty_measurements(), stamp(k), lambda positions: np.zeros(len(positions)))
    assert not tracks


def test_a_pole_that_cameras_cover_is_not_a_pedestrian():
    tracker = Tracker()
    for k in range(100):
        assert tracker.step(scan_of([[5, 5]], probability=0.25, seed=k), stamp(k)) == ()


def test_without_cameras_people_are_still_tracked():
    tracker = Tracker()
    for k in range(20):
        tracks = tracker.step(scan_of([[5, 5]], probability=0.5, seed=k), stamp(k))
    assert len(tracks) == 1


def test_a_pole_called_person_once_in_a_while_is_not_a_pedestrian():
    tracker, shown = Tracker(), 0
    for k in range(200):
        probability = 0.9 if k % 15 == 14 else 0.25
        shown += len(tracker.step(scan_of([[5, 5]], probability=probability, seed=k), stamp(k)))
    assert shown == 0


def test_clutter_hardly_ever_becomes_a_track():
    tracker, generator, shown = Tracker(), np.random.default_rng(7), 0
    for k in range(300):
        shown += len(tracker.step(scan_of(generator.uniform(-30, 30, (5, 2))), stamp(k)))
    assert shown < 30  # false tracks times scans, of 1500 clutter points


def test_same_input_gives_the_same_bits_in_any_order():
    generator = np.random.default_rng(3)
    scans = [generator.uniform(-5, 5, (12, 2)) for _ in range(20)]
    one, other = Tracker(), Tracker()
    for k, positions in enumerate(scans):
        shuffled = positions[generator.permutation(12)]
        a = one.step(scan_of(positions), stamp(k))
        b = other.step(scan_of(shuffled), stamp(k))
        assert same_tracks(a, b)


def test_a_tracker_that_has_seen_nobody_expects_nobody():
    tracker = Tracker()
    assert len(tracker.predicted(stamp(0)).positions_m) == 0
    tracker.step(empty_measurements(), stamp(0))
    assert len(tracker.predicted(stamp(1)).positions_m) == 0


def test_measurements_that_are_not_numbers_change_nothing():
    one, other = Tracker(), Tracker()
    for k in range(10):
        good = np.array([[1.0, 2.0], [4.0, 4.0]])
        bad = np.concatenate([good, [[np.nan, 1.0], [np.inf, 2.0]]])
        assert same_tracks(one.step(scan_of(good), stamp(k)), other.step(scan_of(bad), stamp(k)))


def test_predicted_moves_with_the_velocity():
    tracker = Tracker()
    path = straight(40, [0, 0], [1.5, 0])
    walk(tracker, path[:, None])
    predicted = tracker.predicted(stamp(39) + 200_000_000)
    np.testing.assert_allclose(predicted.positions_m[0], path[-1] + [0.3, 0], atol=0.2)
    np.testing.assert_allclose(predicted.velocities_mps[0], [1.5, 0], atol=0.3)
    now = tracker.predicted(stamp(39))
    assert np.trace(predicted.covariances_m2[0]) > np.trace(now.covariances_m2[0])


def test_a_late_scan_is_refused_by_step_and_taken_in_by_amend():
    """With amend the result is that of the scans in order, ids included."""
    path = straight(30, [0, 0], [1.2, 0])
    ordered, late = Tracker(), Tracker()
    for k in range(30):
        ordered.step(scan_of(path[k], seed=k), stamp(k))
    for k in [*range(20), *range(21, 25)]:
        late.step(scan_of(path[k], seed=k), stamp(k))
    with pytest.raises(LateScanError, match="comes after the one"):
        late.step(scan_of(path[20], seed=20), stamp(20))
    late.amend(scan_of(path[20], seed=20), stamp(20))
    for k in range(25, 30):
        tracks = late.step(scan_of(path[k], seed=k), stamp(k))
    assert same_tracks(tracks, ordered._publish(ordered.state))


def test_amend_keeps_published_ids():
    """A late scan with somebody new in it must not shift the ids of those already published."""
    tracker = Tracker()
    people = np.array([[0.0, 0.0], [10.0, 0.0]])
    for k in range(8):
        shown = people[:1] if k < 4 else people
        tracks = tracker.step(scan_of(shown, seed=k), stamp(2 * k))
    before = nearest_ids(tracks, people)
    tracker.amend(scan_of([[0.0, 0.0], [-10.0, 0.0]], seed=50), stamp(5))
    tracks = tracker.step(scan_of([*people, [-10.0, 0.0]], seed=51), stamp(16))
    tracks = tracker.step(scan_of([*people, [-10.0, 0.0]], seed=52), stamp(18))
    assert nearest_ids(tracks, people) == before


def test_a_scan_older_than_the_ring_is_refused():
    tracker = Tracker(TrackerParams(ring=4))
    with pytest.raises(LateScanError, match="too late"):
        tracker.amend(empty_measurements(), stamp(0))
    for k in range(10):
        tracker.step(scan_of([[0, 0]]), stamp(k))
    with pytest.raises(LateScanError, match="oldest state remembered is of"):
        tracker.amend(scan_of([[0, 0]]), stamp(3))


def test_published_ids_do_not_pile_up(monkeypatch):
    monkeypatch.setattr("tracking.tracker.MAX_REMEMBERED_IDS", 5)
    tracker, seen = Tracker(), []
    for k in range(200):
        place = [[20.0 * (k // 10), 0.0]]
        seen += [track.id for track in tracker.step(scan_of(place, seed=k), stamp(k))]
    assert len(set(seen)) == 20
    assert len(tracker._ids) < 15  # those the ring still holds


def test_an_id_stays_when_a_late_scan_shows_that_its_track_is_older():
    """Scans 2, 3 and 4 publish a track; scan 1, with the same person, comes after them."""
    tracker, path = Tracker(), straight(12, [0.0, 0.0], [1.2, 0.0])
    tracker.step(empty_measurements(), stamp(0))
    for k in (2, 3, 4):
        (track,) = tracker.step(scan_of([path[k]]), stamp(k)) or (None,)
    tracker.amend(scan_of([path[1]]), stamp(1))
    for k in range(5, 10):
        (after,) = tracker.step(scan_of([path[k]]), stamp(k))
        assert after.id == track.id
    assert after.age_ns == stamp(9) - stamp(1)


def test_nothing_is_born_at_a_measurement_that_is_somebodys():
    tracker, path = Tracker(), straight(30, [0.0, 0.0], [1.2, 0.0])
    for k in range(30):
        tracker.step(scan_of([path[k]], seed=k), stamp(k))
        labels = tracker.labels()
        owned = labels.measurement[labels.measurement >= 0]
        assert len(owned) == len(set(owned.tolist()))
    assert len(tracker.labels().names) == 1
