"""What stands around a drive: the lane that a simulated vehicle follows, and poles and bushes."""

import math
from dataclasses import dataclass

import numpy as np

from replay.simulator.motion import Fixtures
from schemas.messages import FloatArray

CELL_M = 11.0  # there is at most one fixture per cell of the map
SHARE = 0.35  # of cells that have one
_RANGE_M = 42.0
_LANE_CLEARANCE_M = 3.0
_OFFSET = 2**15  # makes cells' numbers positive


@dataclass(frozen=True)
class Lane:
    """The vehicle's path, y(x): a sum of sines, so that it turns gently, is known ahead and never crosses itself."""

    amplitudes_m: tuple[float, ...]
    wavelengths_m: tuple[float, ...]
    phases_rad: tuple[float, ...]

    def at(self, x_m: FloatArray | float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Returns y, slope dy/dx and second derivative at x, each of x's shape."""
        x = np.asarray(x_m, float)[..., None]
        k = 2 * math.pi / np.array(self.wavelengths_m)
        angle, a = k * x + np.array(self.phases_rad), np.array(self.amplitudes_m)
        sine, cosine = np.sin(angle), np.cos(angle)
        return (a * sine).sum(-1), (a * k * cosine).sum(-1), -(a * k * k * sine).sum(-1)


class Surroundings:
    """Poles and bushes beside a lane without end: each cell of the map always holds the same, seen again or not."""

    def __init__(self, lane: Lane, seed: int):
        self._lane, self._seed = lane, seed
        self._cell: tuple[int, int] | None = None
        self._fixtures = Fixtures.none()

    def around(self, position_m: FloatArray) -> Fixtures:
        """Returns the fixtures within about 42 m of a position (2,); the same object while its cell does not change."""
        cell = (math.floor(position_m[0] / CELL_M), math.floor(position_m[1] / CELL_M))
        if cell != self._cell:
            reach = math.ceil(_RANGE_M / CELL_M)
            steps = range(-reach, reach + 1)
            cells = [(cell[0] + i, cell[1] + j) for i in steps for j in steps if i * i + j * j <= reach * reach]
            self._cell, self._fixtures = cell, self._in_cells(cells)
        return self._fixtures

    def _in_cells(self, cells: list[tuple[int, int]]) -> Fixtures:
        rows = []
        for i, j in cells:
            rng = np.random.default_rng([self._seed, 2, i + _OFFSET, j + _OFFSET])
            if rng.random() > SHARE:
                continue
            x, y = (np.array([i, j]) + rng.random(2)) * CELL_M
            lane_y, slope, _ = (float(value) for value in self._lane.at(x))
            if abs(y - lane_y) / math.hypot(1.0, slope) > _LANE_CLEARANCE_M:
                rows.append(((i + _OFFSET) * 2 * _OFFSET + j + _OFFSET, float(x), float(y), *pole_or_bush(rng)))
        return fixtures_from_rows(rows)


def pole_or_bush(rng: np.random.Generator) -> tuple[float, float]:
    """Returns radius and height of a pole or trunk (three in five) or of a bush, in m."""
    if rng.random() < 0.6:
        return float(rng.uniform(0.08, 0.22)), float(rng.uniform(2.5, 5.0))
    return float(rng.uniform(0.3, 0.7)), float(rng.uniform(0.7, 1.8))


def fixtures_from_rows(rows: list[tuple[int, float, float, float, float]]) -> Fixtures:
    """Returns fixtures from rows of id, x, y, radius and height."""
    if not rows:
        return Fixtures.none()
    columns = np.array([row[1:] for row in rows])
    ids = np.array([row[0] for row in rows], np.int64)
    return Fixtures(ids, columns[:, :2], columns[:, 2], columns[:, 3])
