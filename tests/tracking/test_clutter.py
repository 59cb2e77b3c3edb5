"""The count of false measurements."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking.clutter import ClutterEstimate, area_of, updated
from tracking.measurements import make_measurements
from tracking.tracker import Tracker, TrackerParams

PRIOR = 1.5e-3


@pytest.mark.parametrize("per_scan", [1.0, 5.0, 20.0])
def test_the_tracker_finds_the_rate_of_clutter(per_scan):
    """60 x 60 m, 15 people, 10 Hz: after 20 s the estimate is within a third of the true rate."""
    generator = np.random.default_rng(3)
    start, velocity = generator.uniform(-25, 25, (15, 2)), generator.uniform(-0.3, 0.3, (15, 2))
    tracker = Tracker(TrackerParams())
    rates = []
    for k in range(300):
        people = start + 0.1 * k * velocity + generator.normal(0, 0.1, (15, 2))
        clutter = generator.uniform(-30, 30, (generator.poisson(per_scan), 2))
        tracker.step(make_measurements(np.concatenate([people, clutter]), np.eye(2) * 0.01), k * 100_000_000)
        rates.append(tracker.state.clutter.per_m2)
    assert np.mean(rates[200:]) == pytest.approx(per_scan / 3600, rel=0.35)


def test_the_estimate_stays_within_ten_times_of_what_it_began_with():
    low = high = ClutterEstimate(PRIOR, 0.0)
    scan = np.random.default_rng(0).uniform(-5, 5, (50, 2))
    for _ in range(100):
        low = updated(low, scan, 0.0, 1.0, prior=PRIOR, memory_s=1.0)
        high = updated(high, scan, 50.0, 1.0, prior=PRIOR, memory_s=1.0)
    assert low.per_m2 == pytest.approx(PRIOR / 10)
    assert high.per_m2 == pytest.approx(PRIOR * 10)


def test_scans_of_the_same_moment_and_empty_ones_before_any_other_change_nothing():
    estimate = ClutterEstimate(PRIOR, 900.0)
    assert updated(estimate, np.zeros((0, 2)), 0.0, 0.0, prior=PRIOR, memory_s=2.0) == estimate
    unknown = ClutterEstimate(PRIOR, 0.0)
    assert updated(unknown, np.zeros((0, 2)), 0.0, 0.1, prior=PRIOR, memory_s=2.0) == unknown


def test_the_area_of_a_filled_square_and_disc():
    generator = np.random.default_rng(1)
    square = generator.uniform(-20, 20, (20000, 2))
    assert area_of(square) == pytest.approx(1600, rel=0.06)
    assert area_of(square[np.hypot(*square.T) < 20]) == pytest.approx(np.pi * 400, rel=0.03)


@given(angle=st.floats(-4, 4), x=st.floats(-1e3, 1e3), seed=st.integers(0, 9))
def test_the_area_does_not_depend_on_the_frame(angle, x, seed):
    points = np.random.default_rng(seed).normal(0, 8, (12, 2))
    c, s = np.cos(angle), np.sin(angle)
    assert area_of(points @ np.array([[c, -s], [s, c]]) + x) == pytest.approx(area_of(points), rel=1e-6)
