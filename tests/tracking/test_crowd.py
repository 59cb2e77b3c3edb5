"""The tracker on the benchmark's crowd: better than the yardstick of DESIGN section 6, and repeatable."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from tracking.tracker import TrackerParams

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "tracking" / "crowd.py"


@pytest.fixture(scope="module")
def crowd():
    spec = importlib.util.spec_from_file_location("crowd_benchmark", BENCHMARK)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(("N", "ospa_m", "hota"), [(10, 0.15, 0.91), (30, 0.17, 0.90), (100, 0.17, 0.89)])
def test_beats_the_yardstick(crowd, N, ospa_m, hota):
    scores = [crowd.run(crowd.crowd(N, 120, seed), TrackerParams())[0] for seed in (200, 201)]
    assert np.mean([score.ospa_m for score in scores]) < ospa_m
    assert np.mean([score.hota for score in scores]) > hota


def test_is_repeatable(crowd):
    first, again = (crowd.run(crowd.crowd(20, 60, 7), TrackerParams())[0] for _ in range(2))
    assert first == again
