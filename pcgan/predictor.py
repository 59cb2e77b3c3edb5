"""The predictor: a track frame in, its predictions out. Knows no zenoh, no clock, and no state but its weights."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pcgan import checkpoint, inference
from pcgan.extrapolation import extrapolate
from pcgan.history import track_positions, vehicle_states
from pcgan.inference import NumpyGenerator
from pcgan.model import Generator
from schemas.messages import (
    FloatArray,
    Mixture,
    ModalPath,
    Prediction,
    PredictionFrame,
    Track,
    TrackFrame,
)


@dataclass(frozen=True, eq=False)
class _Arrays:
    """Predictions of several pedestrians, in the frame of their tracks."""

    probabilities: FloatArray  # (A, L) 0 where there is no path
    paths_m: FloatArray  # (A, L, P, 2) float64
    weights: FloatArray  # (A, P, K) float32, as the rest
    means_m: FloatArray  # (A, P, K, 2)
    sigmas_m: FloatArray  # (A, P, K, 2)
    rhos: FloatArray  # (A, P, K)


class Predictor:
    """Answers every TrackFrame with a PredictionFrame of the same sequence and stamp.

    The answer depends on the frame and the weights alone, bit for bit on one machine: one frame is one forward pass on
    the calling thread, in numpy (`inference.py`). The weights are copied: training a generator on changes no predictor.
    """

    def __init__(self, generator: Generator, model_name: str, checksum: str):
        self.model_name = model_name
        self.checksum = checksum  # SHA-256 of the weights' file
        self.config = generator.config
        self.dt_s = generator.config.dt_s
        self._generator = NumpyGenerator(generator)
        ages = np.arange(self.config.observed_steps - 1, -1, -1)
        self._ages_ns = np.round(ages * self.dt_s * 1e9).astype(np.int64)  # (T,) oldest first

    @staticmethod
    def from_checkpoint(path: Path | None = None) -> "Predictor":
        """Builds the predictor in a checkpoint, by default the one that ships; raises CheckpointError."""
        path = checkpoint.DEFAULT_CHECKPOINT if path is None else path
        generator, loaded = checkpoint.load_generator(path)
        return Predictor(generator, loaded.name, checkpoint.sha256(path))

    def step(self, frame: TrackFrame) -> PredictionFrame:
        """Predicts every track of a frame, in the frame's order; an empty frame gives an empty answer.

        The network answers for tracks that were seen over its whole observation (history interpolated at stamp - k dt,
        coasting samples left out) and are not coasting now. The others are extrapolated from the tracker's state and
        covariance, marked `fallback`. Positions are absolute, in the frame's own coordinates.
        """
        times_ns = frame.stamp_ns - self._ages_ns
        positions, covered = track_positions(frame.tracks, times_ns)  # (A, T, 2), (A,)
        coasting = np.array([track.coasting for track in frame.tracks], bool)
        usable = covered & ~coasting
        states = np.array([track.state for track in frame.tracks], float).reshape(-1, 4)
        predictions: list[Prediction | None] = [None] * len(frame.tracks)
        if usable.any():
            vehicle = vehicle_states(frame.vehicle_history, times_ns) if self.config.uses_vehicle else None
            rows = np.flatnonzero(usable).tolist()
            predicted = self._forward(positions[usable], states[usable], vehicle)
            self._fill(predictions, frame.tracks, rows, predicted, False)
        if not usable.all():
            rows = np.flatnonzero(~usable).tolist()
            covariances = np.array([frame.tracks[row].covariance for row in rows], float)
            extrapolated = _fallback(states[~usable], covariances, self.dt_s, self.config.predicted_steps)
            self._fill(predictions, frame.tracks, rows, extrapolated, True)
        answered = tuple(prediction for prediction in predictions if prediction is not None)
        return PredictionFrame(frame.sequence, frame.stamp_ns, frame.frame_id, self.model_name, self.dt_s, answered)

    def _forward(self, positions: FloatArray, states: FloatArray, vehicle: FloatArray | None) -> _Arrays:
        """(A, T, 2), (A, 4), (T, 4) or None, float64 -> the network's predictions."""
        present = positions[:, -1]  # (A, 2)
        origin = present.mean(axis=0)  # what the network sees is small, so float32 is fine from here on
        observed = np.ascontiguousarray((positions - origin).transpose(2, 1, 0), np.float32)  # (2, T, A)
        velocity = np.ascontiguousarray(states[:, 2:].T, np.float32)  # (2, A)
        seen = None
        if vehicle is not None and np.isfinite(vehicle).all():
            seen = (vehicle - [origin[0], origin[1], 0, 0]).astype(np.float32)
        heading = self._generator.heading(velocity)
        local = self._generator.local_mixture(observed, velocity, seen, heading)
        probabilities, points = inference.modal_paths(local.weights, local.means_m, self.config.eps_m)
        scene = inference.to_scene(local, heading)
        where = present.T[:, None, None]  # (2, 1, 1, A)
        return _Arrays(
            probabilities=probabilities.T,
            paths_m=np.ascontiguousarray((inference.points_to_scene(points, heading) + where).T),
            weights=np.ascontiguousarray(scene.weights.T),
            means_m=np.ascontiguousarray((scene.means_m + where).T, np.float32),
            sigmas_m=np.ascontiguousarray(scene.sigmas_m.T),
            rhos=np.ascontiguousarray(scene.rhos.T),
        )

    @staticmethod
    def _fill(
        predictions: list[Prediction | None], tracks: Sequence[Track], rows: list[int], arrays: _Arrays, fallback: bool
    ) -> None:
        """Puts the arrays' predictions in the places of their tracks."""
        counts = (arrays.probabilities > 0).sum(axis=1).tolist()  # they fall, so the zeros come last
        mixtures = zip(arrays.weights, arrays.means_m, arrays.sigmas_m, arrays.rhos, strict=True)
        everything = zip(rows, counts, arrays.probabilities.tolist(), arrays.paths_m, mixtures, strict=True)
        for row, count, probabilities, points, mixture in everything:
            paths = tuple(map(ModalPath, probabilities[:count], points))
            predictions[row] = Prediction(tracks[row].id, fallback, paths, Mixture(*mixture))


def _fallback(states: FloatArray, covariances: FloatArray, dt_s: float, steps: int) -> _Arrays:
    """(A, 4), (A, 4, 4) -> one path and a one-component mixture per track, from the tracker's own state."""
    path, sigmas, rhos = extrapolate(states, covariances, dt_s, steps)  # (A, P, 2), (A, P, 2), (A, P)
    return _Arrays(
        probabilities=np.ones((len(states), 1)),
        paths_m=path[:, None],
        weights=np.ones((len(states), steps, 1), np.float32),
        means_m=path[:, :, None].astype(np.float32),
        sigmas_m=sigmas[:, :, None].astype(np.float32),
        rhos=rhos[..., None].astype(np.float32),
    )
