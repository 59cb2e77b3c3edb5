"""Scores: values worked out by hand, laws, and agreement with trackeval and Stone Soup."""

import datetime

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import linear_sum_assignment

from tracking.metrics import (
    ScoredFrame,
    clear,
    drop_ignored,
    gospa,
    hota,
    idf1,
    ospa,
    ospa2,
    score,
    similarity,
)

points = st.integers(0, 5).flatmap(lambda n: arrays(float, (n, 2), elements=st.floats(-5, 5)))
NONE = np.zeros((0, 2))


def frame(truth, tracks, ignored=()):
    """From {id: (x, y)}."""
    return ScoredFrame(
        np.array(list(truth), np.int64),
        np.array(list(truth.values()), float).reshape(-1, 2),
        np.array(list(tracks), np.int64),
        np.array(list(tracks.values()), float).reshape(-1, 2),
        np.isin(list(truth), list(ignored)) if truth else np.zeros(0, bool),
    )


def random_drive(seed, frames=30):
    """People and noisy tracks with misses, false tracks and swapped ids."""
    generator = np.random.default_rng(seed)
    out = []
    for k in range(frames):
        people = {i: (3 * i + 0.1 * k, np.sin(i + 0.2 * k)) for i in range(5) if generator.random() < 0.9}
        tracks = {}
        for i, place in people.items():
            if generator.random() < 0.85:
                number = i if k < frames // 2 or i > 1 else 1 - i
                tracks[10 + number] = np.array(place) + generator.normal(0, 0.4, 2)
        if generator.random() < 0.3:
            tracks[99] = generator.uniform(-5, 15, 2)
        out.append(frame(people, tracks))
    return out


def test_ospa_by_hand():
    """Two people at 0 and 10; tracks at 0.5 and one too many far off: (0.5 + 2 + 2) / 3."""
    people, tracks = np.array([[0.0, 0], [10, 0]]), np.array([[0.5, 0], [50, 0], [90, 0]])
    assert ospa(people, tracks) == pytest.approx((0.5 + 2 + 2) / 3)
    assert ospa(people, NONE) == 2
    assert ospa(NONE, NONE) == 0


def test_gospa_by_hand():
    """0.5 m of localisation, a missed person and two false tracks at 1 m each."""
    parts = gospa(np.array([[0.0, 0], [10, 0]]), np.array([[0.5, 0], [50, 0], [90, 0]]))
    assert (parts.localisation, parts.missed, parts.false) == pytest.approx((0.5, 1, 2))
    assert parts.total == pytest.approx(3.5)
    assert gospa(NONE, NONE).total == 0


@given(points, points, st.sampled_from([1.0, 2.0]))
def test_ospa_and_gospa_are_symmetric_and_zero_on_equals(a, b, order):
    assert ospa(a, b, 2.0, order) == pytest.approx(ospa(b, a, 2.0, order))
    forth, back = gospa(a, b, 2.0, order), gospa(b, a, 2.0, order)
    assert forth.total == pytest.approx(back.total)
    assert forth.missed == pytest.approx(back.false)
    assert ospa(a, a) == pytest.approx(0)
    assert 0 <= ospa(a, b) <= 2


@given(points, points)
def test_ospa_agrees_with_stone_soup(a, b):
    assume(len(a) + len(b) > 0)  # theirs needs a timestamp from somewhere
    metrics = pytest.importorskip("stonesoup.metricgenerator.ospametric")
    states = pytest.importorskip("stonesoup.types.state")
    now = datetime.datetime(2020, 1, 1)
    a_states, b_states = ([states.State(row[:, None], timestamp=now) for row in rows] for rows in (a, b))
    expected = metrics.OSPAMetric(c=2.0, p=1.0).compute_OSPA_distance(a_states, b_states).value
    assert ospa(a, b) == pytest.approx(float(expected), abs=1e-9)


def test_gospa_agrees_with_stone_soup():
    """Over a sequence, part by part: theirs are sums of distances to the power of p, which is 1."""
    metrics = pytest.importorskip("stonesoup.metricgenerator.ospametric")
    states = pytest.importorskip("stonesoup.types.state")
    now = datetime.datetime(2020, 1, 1)
    theirs = metrics.GOSPAMetric(c=2.0, p=1.0)
    for each in random_drive(3):
        people, tracks = (
            [states.State(row[:, None], timestamp=now) for row in rows] for rows in (each.truth_m, each.tracks_m)
        )
        expected = theirs.compute_gospa_metric(tracks, people)[0].value
        parts = gospa(each.truth_m, each.tracks_m)
        wanted = [float(expected[name]) for name in ("distance", "localisation", "missed", "false")]
        assert (parts.total, parts.localisation, parts.missed, parts.false) == pytest.approx(wanted, abs=1e-9)


# --- OSPA(2) ----------------------------------------------------------------------------------------------------------


def plain_ospa2(frames, cutoff_m, order, window_scans):
    """By the definition, pair by pair and scan by scan."""
    values = []
    for end in range(1, len(frames) + 1):
        window = [
            (
                dict(zip(f.truth_ids.tolist(), f.truth_m, strict=True)),
                dict(zip(f.track_ids.tolist(), f.tracks_m, strict=True)),
            )
            for f in frames[max(0, end - window_scans) : end]
        ]
        people = sorted({i for truth, _ in window for i in truth})
        tracks = sorted({i for _, found in window for i in found})
        base = np.full((len(people), len(tracks)), cutoff_m)
        for a, person in enumerate(people):
            for b, track in enumerate(tracks):
                apart = [
                    ospa(
                        np.array([t[person]] if person in t else NONE),
                        np.array([f[track]] if track in f else NONE),
                        cutoff_m,
                    )
                    for t, f in window
                    if person in t or track in f
                ]
                base[a, b] = np.mean(apart)
        n = max(base.shape)
        cost = base[linear_sum_assignment(base**order)] ** order
        values.append(((cost.sum() + (n - len(cost)) * cutoff_m**order) / n) ** (1 / order) if n else 0.0)
    return np.mean(values)


def test_ospa2_by_hand():
    """One path 0.5 m off for two scans of four, not there for one, 9 m off for one: (0.5 + 0.5 + 2 + 2) / 4."""
    tracks = [{7: (0, 0.5)}, {7: (1, -0.5)}, {}, {7: (3, 9)}]
    frames = [frame({1: (k, 0)}, found) for k, found in enumerate(tracks)]
    assert ospa2(frames, window_scans=4) == pytest.approx((0.5 + 0.5 + 3 / 3 + 5 / 4) / 4)
    assert ospa2(frames, window_scans=1) == pytest.approx(np.mean([0.5, 0.5, 2, 2]))


def test_ospa2_of_two_paths_and_one_too_many():
    """Person 2 is never found and track 8 is on nobody: (0 + 2 + 2) / 3 with a second false track that comes later."""
    frames = [
        frame({1: (0, 0), 2: (9, 0)}, {7: (0, 0), 8: (-9, 0)}),
        frame({1: (1, 0), 2: (9, 0)}, {7: (1, 0), 8: (-9, 0), 9: (0, 20)}),
    ]
    assert ospa2(frames) == pytest.approx(((0 + 2) / 2 + (0 + 2 + 2) / 3) / 2)


def test_ospa2_charges_for_a_change_of_identity_which_ospa_does_not_see():
    kept = [frame({1: (k, 0)}, {7: (k, 0)}) for k in range(10)]
    changed = [frame({1: (k, 0)}, {7 + (k >= 5): (k, 0)}) for k in range(10)]
    assert score(kept).ospa_m == score(changed).ospa_m == 0
    assert ospa2(kept) == 0
    # From scan 5 on track 7 explains five scans of k + 1, and track 8 is one too many.
    assert ospa2(changed) == pytest.approx(sum((2 * (k - 4) / (k + 1) + 2) / 2 for k in range(5, 10)) / 10)


@pytest.mark.parametrize("order", [1.0, 2.0])
@pytest.mark.parametrize("window_scans", [1, 4, 50])
def test_ospa2_agrees_with_a_plain_loop(window_scans, order):
    for seed in range(3):
        frames = random_drive(seed, 15)
        expected = plain_ospa2(frames, 2.0, order, window_scans)
        assert ospa2(frames, 2.0, order, window_scans) == pytest.approx(expected, abs=1e-9)


def test_ospa2_of_one_scan_is_ospa():
    frames = random_drive(1)
    assert ospa2(frames, window_scans=1) == pytest.approx(score(frames).ospa_m)


def test_ospa2_of_nothing_and_of_what_is_ignored():
    assert ospa2([]) == 0
    assert ospa2([frame({}, {}), frame({}, {})]) == 0
    assert ospa2([frame({1: (0, 0)}, {}), frame({1: (0, 0)}, {})]) == 2
    alone = [frame({1: (k, 0)}, {7: (k, 0.1)}) for k in range(5)]
    beside = [frame({1: (k, 0), 2: (k, 5)}, {7: (k, 0.1), 8: (k, 5.5)}, [2]) for k in range(5)]
    assert ospa2(beside) == pytest.approx(ospa2(alone))
    with pytest.raises(ValueError, match="window_scans must be at least 1, got 0"):
        ospa2(alone, window_scans=0)


def trackeval_scores(frames):
    """HOTA, DetA, AssA, IDF1, MOTA and id switches by the reference implementation."""
    metrics = pytest.importorskip("trackeval.metrics")
    people = sorted({int(i) for f in frames for i in f.truth_ids})
    tracks = sorted({int(i) for f in frames for i in f.track_ids})
    data = {
        "num_timesteps": len(frames),
        "num_gt_ids": len(people),
        "num_tracker_ids": len(tracks),
        "num_gt_dets": sum(len(f.truth_ids) for f in frames),
        "num_tracker_dets": sum(len(f.track_ids) for f in frames),
        "gt_ids": [np.array([people.index(int(i)) for i in f.truth_ids], int) for f in frames],
        "tracker_ids": [np.array([tracks.index(int(i)) for i in f.track_ids], int) for f in frames],
        "similarity_scores": [similarity(f.distances()) for f in frames],
    }
    a = metrics.HOTA().eval_sequence(data)
    b = metrics.Identity({"PRINT_CONFIG": False}).eval_sequence(data)
    c = metrics.CLEAR({"PRINT_CONFIG": False}).eval_sequence(data)
    return (
        *(float(np.mean(a[name])) for name in ("HOTA", "DetA", "AssA")), float(b["IDF1"]), float(c["MOTA"]), c["IDSW"],
    )  # fmt: skip


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seed", range(6))
def test_agrees_with_trackeval(seed):
    pytest.importorskip("trackeval")
    frames = random_drive(seed)
    counts = clear(frames)
    ours = (*hota(frames), idf1(frames), counts.mota, counts.id_switches)
    assert ours == pytest.approx(trackeval_scores(frames), abs=1e-9)


def test_perfect_tracks():
    frames = [frame({1: (k, 0), 2: (k, 5)}, {7: (k, 0), 8: (k, 5)}) for k in range(10)]
    result = score(frames)
    assert (result.hota, result.idf1, result.mota, result.id_switches, result.ospa_m) == pytest.approx((1, 1, 1, 0, 0))


def test_a_swap_is_two_switches():
    """Two tracks change people half way: HOTA's association and IDF1 halve, MOTA loses two of twenty."""
    frames = [frame({1: (k, 0), 2: (k, 5)}, {7 + (k >= 5): (k, 0), 8 - (k >= 5): (k, 5)}) for k in range(10)]
    counts = clear(frames)
    assert (counts.id_switches, counts.missed, counts.false) == (2, 0, 0)
    assert counts.mota == pytest.approx(0.9)
    assert idf1(frames) == pytest.approx(0.5)
    assert hota(frames)[1:] == pytest.approx((1, 1 / 3))


def test_no_tracks_and_no_people():
    assert hota([frame({1: (0, 0)}, {})])[0] == 0
    assert hota([frame({}, {1: (0, 0)})])[0] == 0
    assert hota([frame({}, {})]) == (1, 1, 1)
    assert idf1([]) == 1
    assert score([]).frames == 0
    assert clear([frame({}, {1: (0, 0)})]).mota == 0


def test_ignored_people_are_neither_misses_nor_false_tracks():
    """Person 2 has too few points: missed or tracked, the score is that of person 1 alone."""
    alone = [frame({1: (k, 0)}, {7: (k, 0.1)}) for k in range(5)]
    missed = [frame({1: (k, 0), 2: (k, 5)}, {7: (k, 0.1)}, [2]) for k in range(5)]
    tracked = [frame({1: (k, 0), 2: (k, 5)}, {7: (k, 0.1), 8: (k, 5.5)}, [2]) for k in range(5)]
    far = [frame({1: (k, 0), 2: (k, 5)}, {7: (k, 0.1), 8: (k, 9)}, [2]) for k in range(5)]
    assert score(missed) == score(tracked) == score(alone)
    assert score(far).false == 5


def test_an_ignored_neighbour_does_not_take_the_track():
    kept = drop_ignored(frame({1: (0, 0), 2: (0.5, 0)}, {7: (0.1, 0)}, [2]))
    assert kept.track_ids.tolist() == [7]
