"""The predictor: a track frame in, its predictions out. Knows no zenoh, no clock, and no state but its weights."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pcgan import checkpoint, inference
from pcgan.corridor import Corridor, Futures, corridor_of, entries
from pcgan.extrapolation import extrapolate
from pcgan.history import observations, vehicle_states
from pcgan.inference import NumpyGenerator
from pcgan.model import Generator
from pcgan.vehicle_path import drive_on, motion_at
from schemas.messages import (
    BoolArray,
    FloatArray,
    Mixture,
    ModalPath,
    Prediction,
    PredictionFrame,
    Track,
    TrackFrame,
    VehiclePath,
)

# How well a tracker usually knows where somebody is, standard deviation per axis: networks have learnt from such
# tracks, so their mixtures hold that much already. Nine of ten tracks on simulated drives are better.
USUAL_SIGMA_M = 0.08


@dataclass(frozen=True, eq=False)
class _Arrays:
    """Predictions of several pedestrians, in the frame of their tracks."""

    probabilities: FloatArray  # (A, L) 0 where there is no path
    paths_m: FloatArray  # (A, L, P, 2) float64
    weights: FloatArray  # (A, P, K) float32
    means_m: FloatArray  # (A, P, K, 2) float64: metres in the frame of the tracks may be millions
    sigmas_m: FloatArray  # (A, P, K, 2) float32
    rhos: FloatArray  # (A, P, K) float32


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
        self._ahead_s = self.dt_s * np.arange(self.config.predicted_steps + 1)  # (P + 1,) from now to the horizon
        self._ages_ns = np.round(ages * self.dt_s * 1e9).astype(np.int64)  # (T,) oldest first

    @staticmethod
    def from_checkpoint(path: Path | None = None) -> "Predictor":
        """Builds the predictor in a checkpoint, by default the one that ships; raises CheckpointError."""
        path = checkpoint.DEFAULT_CHECKPOINT if path is None else path
        generator, loaded = checkpoint.load_generator(path)
        return Predictor(generator, loaded.name, checkpoint.sha256(path))

    def step(self, frame: TrackFrame) -> PredictionFrame:
        """Predicts every track of a frame, in the frame's order; an empty frame gives an empty answer.

        The network answers for tracks that were seen at one earlier step of its observation at least (`history.py`) and
        are not coasting. The others are extrapolated from the tracker's state and covariance, marked `fallback`.
        Positions are absolute, in the frame's own coordinates.

        The network sees how the vehicle came here, not where it is going: the frame's `vehicle_path` changes the
        figures of the corridor (`corridor.py`) and nothing else. Without one the vehicle's present motion is carried
        on; without a vehicle nobody enters its corridor.

        Raises ValueError, naming the tracks, if what is needed of one is not finite, and if the vehicle's path is not;
        decoded frames always are.
        """
        times_ns = frame.stamp_ns - self._ages_ns
        with np.errstate(invalid="ignore"):  # what is not finite is refused below
            positions, seen, usable = observations(frame.tracks, times_ns)  # (A, T, 2), (A, T), (A,)
        states = np.array([track.state for track in frame.tracks], float).reshape(-1, 4)
        covariances = np.array([track.covariance for track in frame.tracks], float).reshape(-1, 4, 4)
        _require_finite(frame.tracks, positions, states, covariances)
        path = frame.vehicle_path
        if path is None:
            path = self._driven_on(frame)
        elif len(path.times_s) == 0 or not all(np.isfinite(values).all() for values in vars(path).values()):
            raise ValueError("the vehicle's path has no poses, or holds NaN or infinity")
        corridor = corridor_of(path, self.dt_s, self.config.predicted_steps) if path and frame.tracks else None
        predictions: list[Prediction | None] = [None] * len(frame.tracks)
        if usable.any():
            vehicle = vehicle_states(frame.vehicle_history, times_ns) if self.config.uses_vehicle else None
            rows = np.flatnonzero(usable).tolist()
            of_position = covariances[usable][:, :2, :2]
            predicted = self._forward(positions[usable], seen[usable], states[usable], of_position, vehicle)
            risks = _risks(corridor, states[usable], covariances[usable], predicted)
            self._fill(predictions, frame.tracks, rows, predicted, risks, False)
        if not usable.all():
            rows = np.flatnonzero(~usable).tolist()
            extrapolated = _fallback(states[~usable], covariances[~usable], self.dt_s, self.config.predicted_steps)
            risks = _risks(corridor, states[~usable], covariances[~usable], extrapolated)
            self._fill(predictions, frame.tracks, rows, extrapolated, risks, True)
        answered = tuple(prediction for prediction in predictions if prediction is not None)
        return PredictionFrame(
            frame.sequence, frame.stamp_ns, frame.frame_id, self.model_name, self.dt_s, answered, path
        )

    def _driven_on(self, frame: TrackFrame) -> VehiclePath | None:
        """Returns the vehicle's path if it goes on moving as it does, or None if it has not been seen lately."""
        motion = motion_at(frame.vehicle_history, frame.stamp_ns)
        return None if motion is None else drive_on(motion, self._ahead_s)

    def _forward(
        self,
        positions: FloatArray,
        seen: BoolArray,
        states: FloatArray,
        covariances: FloatArray,
        vehicle: FloatArray | None,
    ) -> _Arrays:
        """(A, T, 2), (A, T), (A, 4), (A, 2, 2), (T, 4) or None, float64 -> the network's predictions."""
        present = positions[:, -1]  # (A, 2)
        origin = present.mean(axis=0)  # what the network sees is small, so float32 is fine from here on
        observed = np.ascontiguousarray((positions - origin).transpose(2, 1, 0), np.float32)  # (2, T, A)
        velocity = np.ascontiguousarray(states[:, 2:].T, np.float32)  # (2, A)
        met = None
        if vehicle is not None and np.isfinite(vehicle).all():
            met = (vehicle - [origin[0], origin[1], 0, 0]).astype(np.float32)
        heading = self._generator.heading(velocity)
        local = self._generator.local_mixture(observed, np.ascontiguousarray(seen.T), velocity, met, heading)
        probabilities, points = inference.modal_paths(local.weights, local.means_m, self.config.eps_m)
        scene = inference.widened(inference.to_scene(local, heading), excess(covariances))
        where = present.T[:, None, None]  # (2, 1, 1, A)
        return _Arrays(
            probabilities=probabilities.T,
            paths_m=np.ascontiguousarray((inference.points_to_scene(points, heading) + where).T),
            weights=np.ascontiguousarray(scene.weights.T),
            means_m=np.ascontiguousarray((scene.means_m + where).T),
            sigmas_m=np.ascontiguousarray(scene.sigmas_m.T),
            rhos=np.ascontiguousarray(scene.rhos.T),
        )

    @staticmethod
    def _fill(
        predictions: list[Prediction | None],
        tracks: Sequence[Track],
        rows: list[int],
        arrays: _Arrays,
        risks: Sequence[tuple[float, float | None]],
        fallback: bool,
    ) -> None:
        """Puts the arrays' predictions in the places of their tracks."""
        counts = (arrays.probabilities > 0).sum(axis=1).tolist()  # they fall, so the zeros come last
        means = arrays.means_m.astype(np.float32)
        mixtures = zip(arrays.weights, means, arrays.sigmas_m, arrays.rhos, strict=True)
        everything = zip(rows, counts, arrays.probabilities.tolist(), arrays.paths_m, mixtures, risks, strict=True)
        for row, count, probabilities, points, mixture, risk in everything:
            paths = tuple(map(ModalPath, probabilities[:count], points))
            predictions[row] = Prediction(tracks[row].id, fallback, paths, Mixture(*mixture), *risk)


def excess(covariances: FloatArray) -> FloatArray:
    """(A, 2, 2) m^2 position covariances -> (A, 2, 2): by how much tracks are worse known than usual, per direction."""
    values, vectors = np.linalg.eigh(covariances)
    more = np.maximum(values - USUAL_SIGMA_M**2, 0)  # (A, 2)
    return np.asarray((vectors * more[:, None]) @ vectors.swapaxes(1, 2))


def _risks(
    corridor: Corridor | None, states: FloatArray, covariances: FloatArray, arrays: _Arrays
) -> list[tuple[float, float | None]]:
    """(A, 4), (A, 4, 4) -> the probability of entering the corridor and the time to it, of each pedestrian."""
    if corridor is None:
        return [(0.0, None)] * len(states)
    futures = Futures(states[:, :2], covariances[:, :2, :2], **vars(arrays))
    probabilities, times_s = entries(corridor, futures)
    return [(p, t if p > 0 else None) for p, t in zip(probabilities.tolist(), times_s.tolist(), strict=True)]


def _require_finite(tracks: Sequence[Track], *arrays: FloatArray) -> None:
    """Raises ValueError, naming the tracks, unless all arrays (A, ...) are finite."""
    if all(np.isfinite(array).all() for array in arrays):
        return
    finite = np.all([np.isfinite(array).reshape(len(tracks), -1).all(axis=1) for array in arrays], axis=0)
    ids = [track.id for track, sound in zip(tracks, finite.tolist(), strict=True) if not sound]
    raise ValueError(f"tracks {ids} hold NaN or infinity; what is needed of a track must be finite")


def _fallback(states: FloatArray, covariances: FloatArray, dt_s: float, steps: int) -> _Arrays:
    """(A, 4), (A, 4, 4) -> one path and a one-component mixture per track, from the tracker's own state."""
    path, sigmas, rhos = extrapolate(states, covariances, dt_s, steps)  # (A, P, 2), (A, P, 2), (A, P)
    return _Arrays(
        probabilities=np.ones((len(states), 1)),
        paths_m=path[:, None],
        weights=np.ones((len(states), steps, 1), np.float32),
        means_m=path[:, :, None],
        sigmas_m=sigmas[:, :, None].astype(np.float32),
        rhos=rhos[..., None].astype(np.float32),
    )
