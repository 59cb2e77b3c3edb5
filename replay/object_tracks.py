"""Another tracker's tracks -> track frames with histories: a predictor can be asked without our fusion and tracking.

Who lives and who is who, the other tracker says; what its format leaves out is filled in here: ids as small numbers,
histories, velocities, covariances.
"""

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from schemas.codec import LARGEST
from schemas.messages import FloatArray, ObjectTracks, Track, TrackFrame, TrackHistory, VehicleHistory
from tracking import geometry
from tracking.fusion_params import FusionParams
from tracking.motion_model import process_noise, transition
from tracking.tracker import LateScanError

_H = np.eye(2, 4)
MIN_VARIANCE = 1e-6  # (1 mm)^2, and the same for velocities: a covariance that says less was not meant
ABSURD = LARGEST / 10  # what is turned and added up stays below what a message may hold
JUMP_M = 1.0  # by which a filter may correct itself from one message to the next, however fast they come


class ObjectTracksParams(BaseModel):
    """Settings of what is made of another tracker's tracks."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    unlabelled_are_pedestrians: bool = Field(
        default=True, description="tracks without a label are taken for pedestrians, else left out"
    )
    history_s: float = Field(default=3.6, gt=0)
    forget_after_s: float = Field(
        default=3.0, ge=0, description="an id that was not there for longer is somebody new when it comes back"
    )
    fastest_mps: float = Field(
        default=12.0, gt=0, description="an id that comes back farther off than this allows is somebody new, too"
    )
    coasting_below_existence: float = Field(
        default=0.0, ge=0, le=1, description="tracks less likely than this are marked as coasting; 0: none"
    )
    position_sigma_m: float = Field(
        default=0.1, gt=0, description="of positions, per axis, if no covariance comes with them"
    )
    velocity_sigma_mps: float = Field(
        default=0.3, gt=0, description="of velocities, per axis, if no covariance comes with them"
    )
    acceleration_mps2: float = Field(
        default=1.0, gt=0, description="of people, per axis, one sigma: for velocities that have to be estimated"
    )
    first_speed_mps: float = Field(
        default=1.0, gt=0, description="one sigma per axis of such a velocity at the first position"
    )


@dataclass
class _Person:
    """What is remembered of one id of the other tracker. States are [x, y, vx, vy], odometry frame."""

    number: int
    born_ns: int
    stamp_ns: int
    state: FloatArray  # (4,)
    covariance: FloatArray  # (4, 4)
    past: deque[tuple[int, FloatArray, bool]] = field(default_factory=deque)  # stamp, state, coasting


class TrackAssembler:
    """Turns another tracker's objects, message by message, into track frames of its pedestrians.

    Remembers a person's id and history for as long as the settings say; nobody is kept alive or predicted here.
    """

    def __init__(
        self,
        params: ObjectTracksParams | None = None,
        pedestrian_labels: Collection[str] = FusionParams().pedestrian_labels,
    ):
        self.params = params or ObjectTracksParams()
        self._labels = {*pedestrian_labels, *([""] if self.params.unlabelled_are_pedestrians else [])}
        self._people: dict[str, _Person] = {}
        self._next_number = 1
        self._stamp_ns = 0
        self._epoch = 0

    def step(
        self,
        objects: ObjectTracks,
        map_from_frame: FloatArray,
        vehicle_history: VehicleHistory,
        frame_id: str,
        *,
        pose_extrapolated: bool = False,
        epoch: int = 0,
        sequence: int = 0,
    ) -> TrackFrame:
        """Returns the pedestrians among some objects as a track frame, sorted by id, with up to `history_s` of history.

        Ids count up in the order in which people are first seen, and go on counting through clock resets (epochs), at
        which everybody is forgotten. Velocities that are not given come from a Kalman filter of each person's
        positions. A covariance that is not given, or not positive definite, is replaced by the settings' sigmas; of one
        whose position block alone is sound, that block is kept.

        Args:
            objects: of one stamp.
            map_from_frame: (4, 4) from the objects' frame into the odometry frame, at their stamp.
            vehicle_history: up to their stamp.
            frame_id: the odometry frame's name.
            pose_extrapolated, epoch, sequence: of the track frame.

        Raises LateScanError (a ValueError) if stamps do not rise, ValueError if two pedestrians have one id or
        something of theirs is not finite; the message is then as if it had never come.
        """
        people = self._pedestrians(objects)
        self._check(objects, people, epoch)
        if epoch != self._epoch:
            self._people.clear()
        self._epoch, self._stamp_ns = epoch, objects.stamp_ns
        self._forget()
        states, covariances = _moved(objects, people, map_from_frame)
        existence = np.clip(objects.existence[people], 0.0, 1.0).tolist()
        tracks = [
            self._track(objects.ids[row], state, covariance, probability)
            for row, state, covariance, probability in zip(people, states, covariances, existence, strict=True)
        ]
        tracks.sort(key=lambda track: track.id)
        return TrackFrame(
            sequence, objects.stamp_ns, frame_id, vehicle_history, tuple(tracks), pose_extrapolated, epoch
        )

    def _pedestrians(self, objects: ObjectTracks) -> list[int]:
        """Returns the rows of the objects that are people."""
        return [row for row, label in enumerate(objects.labels) if label in self._labels]

    def _check(self, objects: ObjectTracks, people: list[int], epoch: int) -> None:
        if epoch == self._epoch and objects.stamp_ns <= self._stamp_ns:
            raise LateScanError(f"tracks of {objects.stamp_ns} ns come after those of {self._stamp_ns} ns")
        ids = [objects.ids[row] for row in people]
        if len(set(ids)) < len(ids):
            twice = next(name for name in ids if ids.count(name) > 1)
            raise ValueError(f"{ids.count(twice)} pedestrians have the id {twice!r}; a track's id must be its own")
        for row, name in zip(people, ids, strict=True):
            if not (np.abs(objects.positions_m[row]).max() <= ABSURD and np.isfinite(objects.existence[row])):
                raise ValueError(f"the position or existence of track {name!r} is not finite, or absurdly large")

    def _forget(self) -> None:
        """Drops whoever was not there for too long."""
        oldest_ns = self._stamp_ns - round(self.params.forget_after_s * 1e9)
        for name in [name for name, person in self._people.items() if person.stamp_ns < oldest_ns]:
            del self._people[name]

    def _track(self, name: str, state: FloatArray, covariance: FloatArray, existence: float) -> Track:
        """Returns one person's track: the state as given, its velocity NaN if that is to be estimated."""
        params, stamp_ns = self.params, self._stamp_ns
        person = self._people.get(name)
        if person is not None and not self._in_reach(person, state[:2]):
            person = None
        estimate, covariance = _estimated(person, stamp_ns, state, covariance, params)
        if person is None:
            person = self._people[name] = _Person(self._next_number, stamp_ns, stamp_ns, estimate, covariance)
            self._next_number += 1
        person.stamp_ns, person.state, person.covariance = stamp_ns, estimate, covariance
        coasting = existence < params.coasting_below_existence
        person.past.append((stamp_ns, estimate, coasting))
        while person.past[0][0] < stamp_ns - round(params.history_s * 1e9):
            person.past.popleft()
        stamps_ns, states, coasted = zip(*person.past, strict=True)
        history = TrackHistory(np.array(stamps_ns, np.int64), np.array(states), np.array(coasted))
        age_ns = stamp_ns - person.born_ns
        return Track(person.number, estimate, covariance, existence, age_ns, coasting, history)

    def _in_reach(self, person: _Person, position_m: FloatArray) -> bool:
        """Tells whether somebody can have got to a place since they were last seen."""
        elapsed_s = (self._stamp_ns - person.stamp_ns) * 1e-9
        distance_m = np.hypot(*(position_m - person.state[:2]))
        return bool(distance_m <= JUMP_M + self.params.fastest_mps * elapsed_s)


def _moved(objects: ObjectTracks, people: list[int], map_from_frame: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns states (A, 4) and covariances (A, 4, 4) of some objects in the odometry frame; NaN where not given.

    A vertical velocity counts if the frame is tilted, and is 0 if not given. Covariances are of the plane alone, so
    they are turned by the part of the rotation that lies in it.
    """
    R = map_from_frame[:3, :3]
    positions = geometry.apply(map_from_frame, objects.positions_m[people])[:, :2]
    velocities = _bounded(objects.velocities_mps[people])
    velocities[:, 2] = np.nan_to_num(velocities[:, 2])
    states = np.hstack([positions, (velocities @ R.T)[:, :2]])
    blocks = _bounded(objects.covariances[people]).reshape(-1, 2, 2, 2, 2)  # (A, position or velocity, axis, ..., ...)
    # One block at a time: in a product of whole matrices one NaN would spoil them all.
    turned = np.einsum("ik,nakbl,jl->naibj", R[:2, :2], blocks, R[:2, :2]).reshape(-1, 4, 4)
    return states, (turned + turned.swapaxes(1, 2)) / 2


def _bounded(values: FloatArray) -> FloatArray:
    """Returns a copy with NaN for what is infinite or absurdly large."""
    return np.where(np.abs(values) <= ABSURD, values, np.nan)


def _estimated(
    person: _Person | None, stamp_ns: int, state: FloatArray, covariance: FloatArray, params: ObjectTracksParams
) -> tuple[FloatArray, FloatArray]:
    """Returns a state (4,) and its covariance (4, 4) with everything that was not given filled in.

    Without a velocity, the position is a measurement of a Kalman filter, which begins with the person as last known.
    """
    covariance = _completed(covariance, params)
    if np.isfinite(state[2:]).all():
        return state, covariance
    position, noise = state[:2], covariance[:2, :2]
    if person is None:
        first = np.diag([0.0, 0.0, params.first_speed_mps**2, params.first_speed_mps**2])
        first[:2, :2] = noise
        return np.array([*position, 0.0, 0.0]), first
    from filterpy.kalman import KalmanFilter  # a third of a second, which only formats without velocities cost

    dt_s = (stamp_ns - person.stamp_ns) * 1e-9
    kalman = KalmanFilter(dim_x=4, dim_z=2)
    kalman.x, kalman.P, kalman.H = person.state, person.covariance, _H
    kalman.predict(F=transition(dt_s), Q=process_noise(dt_s, params.acceleration_mps2))
    kalman.update(position, R=noise)
    return kalman.x, (kalman.P + kalman.P.T) / 2


def _completed(covariance: FloatArray, params: ObjectTracksParams) -> FloatArray:
    """Returns a covariance (4, 4), or as much of it as is sound, beside the settings' sigmas."""
    if _positive_definite(covariance):
        return covariance
    completed = np.diag(np.square([params.position_sigma_m] * 2 + [params.velocity_sigma_mps] * 2))
    if _positive_definite(covariance[:2, :2]):
        completed[:2, :2] = covariance[:2, :2]
    return completed


def _positive_definite(matrix: FloatArray) -> bool:
    return bool(np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix)[0] > MIN_VARIANCE)
