"""Randomness with a memory: a miss or an offset that lasts, as real detectors' do."""

import math

import numpy as np

from schemas.messages import FloatArray, IntArray


class CorrelatedNoise:
    """Unit Gaussian channels per object, each an Ornstein-Uhlenbeck process in time (exactly discretised).

    An object is known by its id. One not asked for is forgotten, so memory follows what is in view; if it comes back
    it starts anew from the stationary distribution.
    """

    def __init__(self, correlations_s: tuple[float, ...], rng: np.random.Generator):
        self._correlations_s = np.array(correlations_s)
        self._rng = rng
        self._ids: IntArray = np.zeros(0, np.int64)
        self._values: FloatArray = np.zeros((0, len(correlations_s)))
        self._time_s = -math.inf

    def at(self, ids: IntArray, time_s: float) -> FloatArray:
        """Returns unit normal values (N, C) of the objects `ids` (N,), all different, at a later or equal time."""
        fresh = self._rng.standard_normal((len(ids), len(self._correlations_s)))
        if len(self._ids) and len(ids):
            memory = np.exp(-(time_s - self._time_s) / self._correlations_s)  # (C,)
            place = np.minimum(np.searchsorted(self._ids, ids), len(self._ids) - 1)
            known = self._ids[place] == ids
            moved = memory * self._values[place[known]] + np.sqrt(1 - memory**2) * fresh[known]
            fresh[known] = moved
        order = np.argsort(ids)
        self._ids, self._values, self._time_s = ids[order], fresh[order], time_s
        return fresh
