"""Durations by stage."""

import time

import numpy as np
import pytest

from replay.stage_clock import StageClock


def test_percentiles_in_ms():
    clock = StageClock()
    for milliseconds in range(1, 102):
        clock.add("track", milliseconds / 1000)
    assert clock.as_json() == {"track": {"p50": pytest.approx(51.0, abs=0.01), "p99": pytest.approx(100.0, abs=0.01)}}


def test_stages_are_kept_apart_in_the_order_they_came():
    clock = StageClock()
    clock.add("read", 0.001)
    clock.add("write", 0.004)
    assert {name: times["p50"] for name, times in clock.as_json().items()} == {"read": 1.0, "write": 4.0}
    assert list(clock.as_json()) == ["read", "write"]


def test_a_block_is_timed():
    clock = StageClock()
    with clock.measure("sleep"):
        time.sleep(0.02)
    assert 20 <= clock.as_json()["sleep"]["p50"] < 1000


def test_nothing_measured_is_nothing():
    assert StageClock().as_json() == {}


def test_a_long_run_keeps_few_bytes_a_frame():
    clock = StageClock()
    for seconds in np.linspace(0, 1, 10_000):
        clock.add("track", seconds)
    assert clock.as_json()["track"]["p50"] == pytest.approx(500, rel=1e-3)
