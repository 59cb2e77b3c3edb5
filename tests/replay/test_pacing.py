"""Pacing: log time at a multiple of real time, or as fast as possible."""

import time

import pytest

from replay.pacing import Pacer

S = 1_000_000_000


def seconds(pacer, *log_times_s):
    start = time.monotonic()
    for log_time_s in log_times_s:
        pacer.wait_for(round(log_time_s * S))
    return time.monotonic() - start


def test_without_a_rate_nothing_waits():
    assert seconds(Pacer(), 0, 1000, 5000) < 0.05


@pytest.mark.parametrize("rate", [1.0, 10.0])
def test_log_time_passes_at_the_rate(rate):
    took = seconds(Pacer(rate), 100, 100 + 0.1 * rate, 100 + 0.2 * rate)
    assert took >= 0.2
    assert took < 2.0  # a busy machine


def test_the_first_call_starts_the_clock():
    assert seconds(Pacer(1.0), 5000) < 0.05


def test_what_is_overdue_does_not_wait():
    """After a slow frame the pacer catches up instead of sleeping for every frame."""
    pacer = Pacer(1.0)
    pacer.wait_for(0)
    time.sleep(0.1)
    assert seconds(pacer, 0.02, 0.05, 0.09) < 0.05


def test_log_time_that_goes_back_does_not_wait():
    pacer = Pacer(1.0)
    pacer.wait_for(100 * S)
    assert seconds(pacer, 50) < 0.05
