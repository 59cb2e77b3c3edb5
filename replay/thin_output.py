"""The messages of an output without what a comparison can do without: a twentieth of the bytes, the same messages.

Kept are tracks, the vehicle's poses and predicted paths. Left out are mixtures, the vehicle's path, and of histories
all but the present state; numbers are rounded to GRID, far below what sensors can tell and comparisons tolerate.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from replay.logged_message import RawMessage
from schemas import codec
from schemas.messages import (
    FloatArray,
    Mixture,
    PredictionFrame,
    Track,
    TrackFrame,
    TrackHistory,
    VehicleHistory,
    VehiclePose,
)
from schemas.topics import PREDICTIONS, TRACKS, VEHICLE_POSE

GRID = 2.0**-14  # m, m/s, probabilities; 0.06 of a millimetre


def thinned(message: RawMessage) -> bytes:
    """Returns what is kept of a message on one of TOPICS."""
    kind, thin = _THIN[message.topic]
    return codec.encode(thin(codec.decode(kind, message.data)))


def _rounded(values: ArrayLike) -> FloatArray:
    rounded: FloatArray = np.round(np.asarray(values, float) / GRID) * GRID + 0.0  # no negative zero
    return rounded


def _number(value: float) -> float:
    return float(_rounded(value))


def _thin_tracks(frame: TrackFrame) -> TrackFrame:
    tracks = tuple(map(_thin_track, frame.tracks))
    return replace(frame, tracks=tracks, vehicle_history=VehicleHistory.empty(), vehicle_path=None)


def _thin_track(track: Track) -> Track:
    past = track.history
    history = TrackHistory(past.stamps_ns[-1:], _rounded(past.states[-1:]), past.coasting[-1:])
    return replace(
        track,
        state=_rounded(track.state),
        covariance=_rounded(track.covariance),
        existence=_number(track.existence),
        history=history,
    )


def _thin_predictions(frame: PredictionFrame) -> PredictionFrame:
    predictions = tuple(
        replace(
            each,
            paths=tuple(
                replace(path, probability=_number(path.probability), points_m=_rounded(path.points_m))
                for path in each.paths
            ),
            mixture=_NO_MIXTURE,
            corridor_probability=_number(each.corridor_probability),
            corridor_time_s=None if each.corridor_time_s is None else _number(each.corridor_time_s),
        )
        for each in frame.predictions
    )
    return replace(frame, predictions=predictions, vehicle_path=None)


def _thin_pose(pose: VehiclePose) -> VehiclePose:
    return replace(
        pose,
        position_m=_rounded(pose.position_m),
        quaternion_xyzw=_rounded(pose.quaternion_xyzw),
        velocity_mps=_rounded(pose.velocity_mps),
        angular_velocity_radps=_rounded(pose.angular_velocity_radps),
    )


_NO_MIXTURE = Mixture(np.zeros((0, 0)), np.zeros((0, 0, 2)), np.zeros((0, 0, 2)), np.zeros((0, 0)))
_THIN: Mapping[str, tuple[type, Any]] = {
    TRACKS.name: (TrackFrame, _thin_tracks),
    PREDICTIONS.name: (PredictionFrame, _thin_predictions),
    VEHICLE_POSE.name: (VehiclePose, _thin_pose),
}
TOPICS = tuple(_THIN)
