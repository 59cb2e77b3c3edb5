"""The tracker on the benchmark's crowd: better than the yardstick of DESIGN section 6, and repeatable."""

import numpy as np
import pytest

pytest.importorskip("stonesoup")
from benchmarks.tracking.compare import run
from benchmarks.tracking.peers import OURS_CROWD, Ours
from benchmarks.tracking.scenarios import CROWD, DENSE_CLUTTER, crowd
from tracking.metrics import score


def frames(N, scans, seed, sensor=CROWD):
    return run(Ours(sensor, OURS_CROWD), crowd(N, scans, seed, sensor), settling=10)[0]


@pytest.mark.parametrize(("N", "ospa_m", "hota"), [(10, 0.15, 0.91), (30, 0.17, 0.90), (100, 0.16, 0.90)])
def test_beats_the_yardstick(N, ospa_m, hota):
    scores = [score(frames(N, 120, seed)) for seed in (300, 301)]
    assert np.mean([each.ospa_m for each in scores]) < ospa_m
    assert np.mean([each.hota for each in scores]) > hota


def test_four_times_the_clutter_costs_little():
    scores = [score(frames(30, 120, seed, DENSE_CLUTTER)) for seed in (300, 301)]
    assert np.mean([each.ospa_m for each in scores]) < 0.17
    assert np.mean([each.hota for each in scores]) > 0.90


def test_is_repeatable():
    first, again = (score(frames(20, 60, 7)) for _ in range(2))
    assert first == again
