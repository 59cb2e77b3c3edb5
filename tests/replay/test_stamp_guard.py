"""Late, absurd, or a clock that was reset: which stamp is what."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from replay.stamp_guard import StampGuard, Verdict

S = 1_000_000_000
T0 = 1_700_000_000 * S


def verdicts(guard, *stamps_and_logs):
    return [guard.check(T0 + round(stamp_s * S), T0 + round(log_s * S)) for stamp_s, log_s in stamps_and_logs]


ACCEPT, REFUSE, NEW = Verdict.ACCEPT, Verdict.REFUSE, Verdict.NEW_EPOCH


@given(st.lists(st.floats(-0.99, 9), max_size=30))
def test_stamps_within_reach_of_the_newest_are_accepted(steps):
    """Up to 1 s back, up to 10 s ahead of log time, always from the newest accepted."""
    guard, newest = StampGuard(), 0.0
    assert verdicts(guard, (0, 0)) == [ACCEPT]
    for step in steps:
        assert verdicts(guard, (newest + step, newest)) == [ACCEPT]
        newest = max(newest, newest + step)


@pytest.mark.parametrize(
    ("stamp_s", "verdict"),
    [(-1.0, ACCEPT), (-1.001, REFUSE), (10.1, ACCEPT), (10.2, REFUSE), (-3600, REFUSE), (3600, REFUSE)],
)
def test_the_bounds(stamp_s, verdict):
    """Against the message before, 0.1 s of log time ago: 1 s back, 10 s ahead of the log's own time."""
    assert verdicts(StampGuard(), (0, 0), (stamp_s, 0.1)) == [ACCEPT, verdict]


def test_a_pause_in_the_log_is_no_jump():
    assert verdicts(StampGuard(), (0, 0), (600, 600), (600.1, 600.1)) == [ACCEPT] * 3


def test_one_absurd_stamp_changes_nothing_for_the_others():
    found = verdicts(StampGuard(), (0, 0), (0.1, 0.1), (3600, 0.2), (0.3, 0.3), (-3600, 0.4), (0.5, 0.5))
    assert found == [ACCEPT, ACCEPT, REFUSE, ACCEPT, REFUSE, ACCEPT]


def test_three_jumps_in_a_row_are_a_reset():
    found = verdicts(StampGuard(), (100, 0), (5.0, 0.1), (5.1, 0.2), (5.2, 0.3))
    assert found == [ACCEPT, REFUSE, REFUSE, NEW]


def test_an_accepted_stamp_between_jumps_starts_the_count_anew():
    found = verdicts(StampGuard(), (100, 0), (5, 0.1), (5.1, 0.2), (100.3, 0.3), (5.3, 0.4), (5.4, 0.5), (5.5, 0.6))
    assert found == [ACCEPT, REFUSE, REFUSE, ACCEPT, REFUSE, REFUSE, NEW]


def test_after_a_reset_other_topics_start_from_its_message():
    """What another sensor sent before the reset may still arrive: refused, and no second reset."""
    guard = StampGuard((T0 + 5 * S, T0 + 20 * S))
    assert verdicts(guard, (100, 20.1), (5.1, 20.2), (100.1, 20.3), (5.3, 20.4)) == [REFUSE, ACCEPT, REFUSE, ACCEPT]


def test_the_reference_allows_no_ten_seconds_ahead():
    assert verdicts(StampGuard((T0, T0)), (5, 0.1)) == [REFUSE]
    assert verdicts(StampGuard((T0, T0)), (0.9, 0.1)) == [ACCEPT]
