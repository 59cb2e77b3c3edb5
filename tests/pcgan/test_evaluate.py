"""Scores of walks whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest

from pcgan.dataset import Windows, WindowSpec, clip_windows
from pcgan.evaluate import extrapolation_scores, near_vehicle, score


def straight_windows(N=4, sideways_m=0.0):
    steps = np.arange(-7, 13)
    walk = np.stack([0.1 * steps, np.where(steps > 0, sideways_m, 0.0)], -1)
    walk = np.tile(walk, (N, 1, 1)).astype(np.float32)
    return Windows(
        observed=walk[:, :8],
        velocity=np.tile(np.float32([1, 0]), (N, 1)),
        future=walk[:, 8:],
        vehicle=np.full((N, 8, 4), np.nan, np.float32),
        scene=np.arange(N),
        annotated=np.ones(N, bool),
    )


def test_extrapolation_of_a_step_to_the_side():
    scores = extrapolation_scores(straight_windows(sideways_m=0.5), 0.1)
    assert scores.pedestrians == 4
    assert scores.ade == pytest.approx(0.5, abs=1e-6)
    assert scores.fde == pytest.approx(0.5, abs=1e-6)
    variance = 0.5**2 / 2  # one axis is off by 0.5, the other not at all
    assert scores.nll == pytest.approx(np.log(2 * np.pi * variance) + 1, abs=1e-5)


def test_last_displacement_is_the_other_baseline():
    windows = straight_windows()
    wrong = replace(windows, velocity=windows.velocity * 2)
    assert extrapolation_scores(wrong, 0.1).fde == pytest.approx(1.2, abs=1e-5)
    assert extrapolation_scores(wrong, 0.1, last_displacement=True).fde == pytest.approx(0, abs=1e-5)


def test_score_counts_known_futures_only(make_generator, make_clip):
    windows = clip_windows(make_clip(), WindowSpec(8, 12, 0.1))
    future = windows.future.copy()
    future[::2] = np.nan
    half = replace(windows, future=future)
    scores = score(make_generator(), half, pedestrians=50)
    assert scores.pedestrians == half.known.sum()
    assert scores.ade < 0.5
    assert 1 <= scores.mean_paths <= 6
    again = score(make_generator(), half, pedestrians=500)
    assert (scores.ade, scores.nll) == (pytest.approx(again.ade, rel=1e-4), pytest.approx(again.nll, rel=1e-4))


def test_only_those_near_a_vehicle_are_scored():
    windows = straight_windows()
    vehicle = windows.vehicle.copy()
    vehicle[0] = [2.0, 4.0, 0, 0]  # 4.5 m from the walker's last observed position, and farther before
    vehicle[1] = [0.0, 6.0, 0, 0]
    near = near_vehicle(replace(windows, vehicle=vehicle))
    assert near.known.tolist() == [True, False, False, False]
    assert len(near) == 4


def test_nothing_known_is_an_error(make_generator):
    windows = straight_windows()
    unknown = replace(windows, future=windows.future * np.nan)
    with pytest.raises(ValueError, match="no window has a known future"):
        score(make_generator(), unknown)
    with pytest.raises(ValueError, match="no window has a known future"):
        extrapolation_scores(unknown, 0.1)
