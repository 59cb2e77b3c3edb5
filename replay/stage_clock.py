"""How long each stage takes; for the summary only, never for a result."""

import time
from array import array
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np


class StageClock:
    """Collects durations by stage."""

    def __init__(self) -> None:
        self._seconds: dict[str, array[float]] = {}

    def add(self, stage: str, seconds: float) -> None:
        """Takes one duration."""
        self._seconds.setdefault(stage, array("f")).append(seconds)

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Times a block."""
        start = time.perf_counter()
        yield
        self.add(stage, time.perf_counter() - start)

    def as_json(self) -> dict[str, dict[str, float]]:
        """Returns median and 99th percentile per stage, in ms."""
        return {
            stage: {
                "p50": round(float(np.percentile(seconds, 50)) * 1e3, 3),
                "p99": round(float(np.percentile(seconds, 99)) * 1e3, 3),
            }
            for stage, seconds in self._seconds.items()
        }
