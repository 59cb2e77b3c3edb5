"""Histories are interpolated between stamped samples and never extrapolated."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcgan.history import MAX_GAP_NS, observations, track_positions, vehicle_states
from schemas.messages import Track, TrackHistory, VehicleHistory

STAMP_NS = 1_700_000_000_000_000_000
TIMES_NS = STAMP_NS - np.arange(7, -1, -1) * 100_000_000


def history_of(stamps_ns, coasting=None):
    """A walk along x = 2 t + 5, y = -t, t in s since STAMP_NS."""
    stamps_ns = np.asarray(stamps_ns, np.int64)
    t = (stamps_ns - STAMP_NS) / 1e9
    states = np.stack([2 * t + 5, -t, np.full_like(t, 2), np.full_like(t, -1)], -1)
    return TrackHistory(stamps_ns, states, np.zeros(len(t), bool) if coasting is None else np.asarray(coasting))


def track_of(history, id=1, *, state=(0.0, 0.0, 0.0, 0.0), coasting=False):
    return Track(id, np.array(state), np.eye(4), 1.0, 0, coasting, history)


EXPECTED = np.stack([2 * (TIMES_NS - STAMP_NS) / 1e9 + 5, -(TIMES_NS - STAMP_NS) / 1e9], -1)


@given(st.lists(st.integers(1, 900_000_000), min_size=3, max_size=30), st.integers(0, 300_000_000))
def test_straight_walk_is_found_between_any_stamps(gaps_ns, lead_ns):
    stamps = STAMP_NS + lead_ns - np.cumsum([0, *gaps_ns])[::-1]
    positions, covered = track_positions([track_of(history_of(stamps))], TIMES_NS)
    np.testing.assert_array_equal(covered[0], stamps[0] <= TIMES_NS)
    np.testing.assert_allclose(positions[covered], EXPECTED[covered[0]], atol=1e-6)


def test_tracks_do_not_run_into_one_another():
    good = history_of(STAMP_NS - np.arange(9, -1, -1) * 100_000_000)
    short = history_of(STAMP_NS - np.arange(5, -1, -1) * 100_000_000)
    ended = history_of(STAMP_NS - np.arange(20, 0, -1) * 100_000_000)
    none = history_of([])
    tracks = [track_of(h) for h in (short, good, ended, good, none)]
    positions, covered = track_positions(tracks, TIMES_NS)
    assert covered.sum(axis=1).tolist() == [6, 8, 7, 8, 0]
    assert covered[0].tolist() == [False] * 2 + [True] * 6
    assert covered[2].tolist() == [True] * 7 + [False]
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
    assert covered[0].tolist() == [True] * 7 + [False]  # beyond the last sample that counts lies extrapolation


def test_long_gap_is_not_bridged():
    stamps = np.array([-2_000_000_000, -MAX_GAP_NS - 1, 0]) + STAMP_NS
    assert track_positions([track_of(history_of(stamps))], TIMES_NS)[1][0].tolist() == [False] * 7 + [True]
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
    assert covered.shape == (0, 8)
    observed, seen, usable = observations([], TIMES_NS)
    assert (observed.shape, seen.shape, usable.shape) == ((0, 8, 2), (0, 8), (0,))


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


# --- what a network observes -----------------------------------------------------------------------------------------

SCANS_NS = STAMP_NS - np.arange(9, -1, -1) * 100_000_000  # the last eight are TIMES_NS


def test_observed_last_is_the_present_state_and_before_it_the_history():
    observed, seen, usable = observations([track_of(history_of(SCANS_NS), state=(5.5, 0.5, 0, 0))], TIMES_NS)
    np.testing.assert_allclose(observed[0, :-1], EXPECTED[:-1], atol=1e-6)
    np.testing.assert_array_equal(observed[0, -1], [5.5, 0.5])
    assert seen.all()
    assert usable.tolist() == [True]


def test_present_counts_though_the_last_scan_missed():
    """The last two scans missed: one step is unseen, and filled in between the history and the present state."""
    missed = np.isin(np.arange(10), [8, 9])
    history = history_of(SCANS_NS, missed)
    history.states[missed] = 99
    observed, seen, usable = observations([track_of(history, state=(6.0, 1.0, 0, 0))], TIMES_NS)
    assert seen[0].tolist() == [True] * 6 + [False, True]
    np.testing.assert_allclose(observed[0, :6], EXPECTED[:6], atol=1e-6)
    np.testing.assert_allclose(observed[0, 6], (EXPECTED[5] + [6.0, 1.0]) / 2, atol=1e-6)
    assert usable[0]


def test_steps_before_the_first_sample_repeat_it():
    observed, seen, usable = observations([track_of(history_of(SCANS_NS[-3:]), state=(5.0, 0, 0, 0))], TIMES_NS)
    assert seen[0].tolist() == [False] * 5 + [True] * 3
    np.testing.assert_allclose(observed[0], np.where(seen[0][:, None], EXPECTED, EXPECTED[5]), atol=1e-6)
    assert usable[0]


def test_who_can_be_predicted():
    """Not who coasts, nor who was not seen at an earlier step; the others' rows stay finite all the same."""
    whole, new, brief = history_of(SCANS_NS), history_of(SCANS_NS[-1:]), history_of(SCANS_NS[-1:] - 40_000_000)
    coasting = track_of(history_of(SCANS_NS, np.arange(10) > 8), coasting=True)
    tracks = [track_of(whole), coasting, track_of(new), track_of(history_of([])), track_of(brief)]
    observed, seen, usable = observations(tracks, TIMES_NS)
    assert usable.tolist() == [True, False, False, False, False]
    assert seen.sum(axis=1).tolist() == [8, 8, 1, 1, 1]
    assert np.isfinite(observed).all()


@given(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 2**12 - 1)), min_size=1, max_size=5))
def test_everybodys_observations_are_their_own(people):
    """Several tracks, each of some scans, some of them missed: the same as asked one by one."""
    stamps = STAMP_NS - np.arange(11, -1, -1) * 100_000_000
    tracks = []
    for scans, missed in people:
        coasting = np.array([bool(missed >> i & 1) for i in range(12)])[-scans:]
        tracks.append(track_of(history_of(stamps[-scans:], coasting), state=(5.0, 0.0, 2.0, -1.0)))
    observed, seen, usable = observations(tracks, TIMES_NS)
    for row, track in enumerate(tracks):
        alone = observations([track], TIMES_NS)
        np.testing.assert_array_equal(observed[row], alone[0][0])
        np.testing.assert_array_equal(seen[row], alone[1][0])
        assert usable[row] == alone[2][0]
    np.testing.assert_allclose(observed[seen], np.broadcast_to(EXPECTED, observed.shape)[seen], atol=1e-6)
