"""What goes between fusion and the tracker: fused measurements one way, the tracker's prediction the other."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from schemas.messages import BoolArray, FloatArray, IntArray

FARTHEST_M = 1e8  # more than any map's coordinates
MIN_SIGMA_M = 0.05  # no LiDAR centroid is known better than this


class CameraEvidence(NamedTuple):
    """A box that was matched to a measurement: whose camera, which of its boxes, and the detector's score."""

    camera: str
    box: int
    score: float


@dataclass(frozen=True, eq=False)
class Measurements:
    """One scan's fused position measurements in the odometry frame, sorted by x, then y."""

    positions_m: FloatArray  # (M, 2)
    covariances_m2: FloatArray  # (M, 2, 2)
    pedestrian_probability: FloatArray  # (M,)  from this scan alone, strictly between 0 and 1
    cluster_index: IntArray  # (M,)  row in the scan's LidarClusters; -1 without a cluster
    gives_birth: BoolArray  # (M,)  whether it may be a new person: not if its place is too uncertain
    evidence: tuple[tuple[CameraEvidence, ...], ...] = ()  # (M,)  boxes behind each measurement
    refused: int = 0  # how many more there were, not finite or with an impossible covariance
    refused_cluster_index: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # those with a cluster

    def __len__(self) -> int:
        return len(self.positions_m)


def empty_measurements() -> Measurements:
    """Returns a scan in which nothing was measured."""
    return Measurements(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, np.int64), np.zeros(0, bool))


def make_measurements(
    positions_m: FloatArray,
    covariances_m2: FloatArray,
    pedestrian_probability: FloatArray | None = None,
    cluster_index: IntArray | None = None,
    evidence: Sequence[tuple[CameraEvidence, ...]] | None = None,
    gives_birth: BoolArray | None = None,
) -> Measurements:
    """Returns checked and sorted measurements, so that results do not depend on the order clusters came in.

    Args:
        positions_m: (M, 2) odometry frame.
        covariances_m2: (M, 2, 2), or (2, 2) for all. Eigenvalues are floored at (0.05 m)^2.
        pedestrian_probability: (M,); without it 0.5, which says nothing. Clipped to [0.001, 0.999].
        cluster_index: (M,); without it 0 to M - 1.
        evidence: M tuples; without it none.
        gives_birth: (M,); without it all may be new people.

    Returns:
        The measurements that are on earth and whose covariance is positive definite; `refused` counts the others.

    Raises:
        ValueError: shapes do not agree.
    """
    positions = np.asarray(positions_m, float).reshape(-1, 2) if np.size(positions_m) == 0 else np.asarray(positions_m)
    M = len(positions)
    if positions.shape != (M, 2):
        raise ValueError(f"positions_m must have shape (M, 2), got {positions.shape}")
    covs = np.asarray(covariances_m2, float)
    covs = np.broadcast_to(covs, (M, 2, 2)) if covs.ndim == 2 and covs.shape == (2, 2) else covs.reshape(-1, 2, 2)
    probability = np.full(M, 0.5) if pedestrian_probability is None else np.asarray(pedestrian_probability, float)
    index = np.arange(M) if cluster_index is None else np.asarray(cluster_index, np.int64)
    births = np.ones(M, bool) if gives_birth is None else np.asarray(gives_birth, bool)
    boxes = ((),) * M if evidence is None else tuple(evidence)
    if not len(covs) == len(probability) == len(index) == len(boxes) == len(births) == M:
        raise ValueError(
            f"{M} positions, {len(covs)} covariances, {len(probability)} probabilities, "
            f"{len(index)} cluster indices, {len(boxes)} tuples of evidence and {len(births)} permissions of birth "
            "do not go together"
        )
    determinant = covs[:, 0, 0] * covs[:, 1, 1] - covs[:, 0, 1] * covs[:, 1, 0]
    sound = (np.abs(positions) < FARTHEST_M).all(axis=1) & np.isfinite(probability) & np.isfinite(determinant)
    sound &= (covs[:, 0, 0] > 0) & (determinant > 0)
    ties = (index, births, covs[:, 0, 1], covs[:, 1, 1], covs[:, 0, 0], probability)
    order = np.lexsort((*ties, positions[:, 1], positions[:, 0]))
    order = order[sound[order]]
    return Measurements(
        positions[order],
        floor_eigenvalues(covs[order], MIN_SIGMA_M**2),
        np.clip(probability[order], 0.001, 0.999),
        index[order],
        births[order],
        tuple(boxes[row] for row in order),
        M - len(order),
        np.sort(index[~sound & (index >= 0)]),
    )


def floor_eigenvalues(covs: FloatArray, floor: float) -> FloatArray:
    """Returns symmetric 2 x 2 matrices (M, 2, 2) with every eigenvalue raised to at least `floor`."""
    a, b, d = covs[:, 0, 0], (covs[:, 0, 1] + covs[:, 1, 0]) / 2, covs[:, 1, 1]
    mean, radius = (a + d) / 2, np.hypot((a - d) / 2, b)
    out = np.empty_like(covs)
    low, high = np.maximum(mean - radius, floor), np.maximum(mean + radius, floor)
    # The deviator's direction stays; only its size and the mean change.
    scale = np.divide((high - low) / 2, radius, out=np.zeros_like(radius), where=radius > 0)
    out[:, 0, 0] = (low + high) / 2 + scale * (a - d) / 2
    out[:, 1, 1] = (low + high) / 2 - scale * (a - d) / 2
    out[:, 0, 1] = out[:, 1, 0] = scale * b
    return out


@dataclass(frozen=True, eq=False)
class PredictedTracks:
    """Where the tracker expects its tracks at a stamp; a new tracker expects none."""

    positions_m: FloatArray  # (A, 2)  odometry frame
    velocities_mps: FloatArray  # (A, 2)
    covariances_m2: FloatArray  # (A, 2, 2)  of the positions


def no_predicted_tracks() -> PredictedTracks:
    """Returns the expectation of a tracker that has seen nothing."""
    return PredictedTracks(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2)))
