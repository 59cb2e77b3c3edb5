"""Histories are interpolated between stamped samples and never extrapolated."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcgan.history import MAX_GAP_NS, track_positions, vehicle_states
from schemas.messages import Track, TrackHistory, VehicleHistory

STAMP_NS = 1_700_000_000_000_000_000
TIMES_NS = STAMP_NS - np.arange(7, -1, -1) * 100_000_000


def history_of(stamps_ns, coasting=None):
    """A walk along x = 2 t + 5, y = -t, t in s since STAMP_NS."""
    stamps_ns = np.asarray(stamps_ns, np.int64)
    t = (stamps_ns - STAMP_NS) / 1e9
    states = np.stack([2 * t + 5, -t, np.full_like(t, 2), np.full_like(t, -1)], -1)
    return TrackHistory(stamps_ns, states, np.zeros(len(t), bool) if coasting is None else np.asarray(coasting))


def track_of(history, id=1):
    return Track(id, np.zeros(4), np.eye(4), 1.0, 0, False, history)


EXPECTED = np.stack([2 * (TIMES_NS - STAMP_NS) / 1e9 + 5, -(TIMES_NS - STAMP_NS) / 1e9], -1)


@given(st.lists(st.integers(1, 900_000_000), min_size=3, max_size=30), st.integers(0, 300_000_000))
def test_straight_walk_is_found_between_any_stamps(gaps_ns, lead_ns):
    stamps = STAMP_NS + lead_ns - np.cumsum([0, *gaps_ns])[::-1]
    positions, covered = track_positions([track_of(history_of(stamps))], TIMES_NS)
    assert covered[0] == (stamps[0] <= TIMES_NS[0])
    if covered[0]:
        np.testing.assert_allclose(positions[0], EXPECTED, atol=1e-6)


def test_tracks_do_not_run_into_one_another():
    good = history_of(STAMP_NS - np.arange(9, -1, -1) * 100_000_000)
    short = history_of(STAMP_NS - np.arange(5, -1, -1) * 100_000_000)
    ended = history_of(STAMP_NS - np.arange(20, 0, -1) * 100_000_000)
    none = history_of([])
    tracks = [track_of(h) for h in (short, good, ended, good, none)]
    positions, covered = track_positions(tracks, TIMES_NS)
    assert covered.tolist() == [False, True, False, True, False]
    np.testing.assert_allclose(positions[1], EXPECTED, atol=1e-6)
    np.testing.assert_allclose(positions[3], EXPECTED, atol=1e-6)


def test_exact_stamps_give_the_samples_themselves():
    history = history_of(TIMES_NS)
    positions, covered = track_positions([track_of(history)], TIMES_NS)
    assert covered.all()
    np.testing.assert_array_equal(positions[0], history.states[:, :2])


def test_coasting_samples_do_not_count():
    stamps = STAMP_NS - np.arange(9, -1, -1) * 100_000_000
    coasting = np.isin(np.arange(10), [4, 5])
    history = history_of(stamps, coasting)
    history.states[coasting] = 99  # where the filter coasted to
    positions, covered = track_positions([track_of(history)], TIMES_NS)
    assert covered.all()
    np.testing.assert_allclose(positions[0], EXPECTED, atol=1e-6)
    _, covered = track_positions([track_of(history_of(stamps, np.arange(10) == 9))], TIMES_NS)
    assert not covered.any()  # its last sample: beyond the one before lies extrapolation


def test_long_gap_is_not_bridged():
    stamps = np.array([-2_000_000_000, -MAX_GAP_NS - 1, 0]) + STAMP_NS
    assert not track_positions([track_of(history_of(stamps))], TIMES_NS)[1].any()
    stamps[1] += 1
    assert track_positions([track_of(history_of(stamps))], TIMES_NS)[1].all()


def test_ancient_sample_is_ignored():
    stamps = np.array([1, *(STAMP_NS - np.arange(9, -1, -1) * 100_000_000)])
    positions, covered = track_positions([track_of(history_of(stamps))] * 2, TIMES_NS)
    assert covered.all()
    np.testing.assert_allclose(positions[1], EXPECTED, atol=1e-6)


def test_no_tracks():
    positions, covered = track_positions([], TIMES_NS)
    assert positions.shape == (0, 8, 2)
    assert covered.shape == (0,)


def test_vehicle_is_interpolated_or_missing():
    stamps = STAMP_NS - np.arange(40, -1, -1) * 50_000_000 + 7_000_000
    t = (stamps - STAMP_NS) / 1e9
    states = np.stack([5 * t, t * 0 + 1, t * 0, t * 0 + 5, t * 0], -1)
    found = vehicle_states(VehicleHistory(stamps, states), TIMES_NS)
    assert found is not None
    np.testing.assert_allclose(found[:, 0], 5 * (TIMES_NS - STAMP_NS) / 1e9, atol=1e-6)
    np.testing.assert_allclose(found[:, 1:], [[1, 5, 0]] * 8)
    assert vehicle_states(VehicleHistory(stamps[:-2], states[:-2]), TIMES_NS) is None
    assert vehicle_states(VehicleHistory.empty(), TIMES_NS) is None


@pytest.mark.parametrize("count", [1, 3])
def test_only_ancient_samples_cover_nothing(count):
    assert not track_positions([track_of(history_of([1, 2]))] * count, TIMES_NS)[1].any()
