"""Where everything is at any time of a drive: the vehicle, pedestrians, other vehicles and what stands still.

A `Motion` is a stream of `Scene`s at rising times, so that a long drive needs no more memory than a short one; a
`MotionSampler` interpolates between two successive ones. Everything is in the odometry frame: x forward/east, y left,
z up, metres; the ground is z = 0. One letter per axis: A pedestrians, V other vehicles, F fixtures.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from schemas.messages import FloatArray, IntArray


class SimulationError(ValueError):
    """A drive that cannot be simulated as asked; the message says what to ask for instead."""


@dataclass(frozen=True, eq=False)
class VehicleState:
    """The recording vehicle: where its base_link is, on the ground, and how that moves."""

    position_m: FloatArray  # (2,)
    yaw_rad: float  # unwrapped between the scenes of one motion
    velocity_mps: FloatArray  # (2,)   odometry frame
    yaw_rate_radps: float


@dataclass(frozen=True, eq=False)
class People:
    """Pedestrians present at one time; an id means one person for the whole drive."""

    ids: IntArray  # (A,)
    positions_m: FloatArray  # (A, 2)
    velocities_mps: FloatArray  # (A, 2)

    @staticmethod
    def none() -> "People":
        """Returns nobody."""
        return People(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)))


@dataclass(frozen=True, eq=False)
class OtherVehicles:
    """Vehicles other than the recording one, as upright boxes on the ground."""

    ids: IntArray  # (V,)
    positions_m: FloatArray  # (V, 2)  centre of the box
    yaws_rad: FloatArray  # (V,)    unwrapped between the scenes of one motion
    sizes_m: FloatArray  # (V, 3)  length, width, height

    @staticmethod
    def none() -> "OtherVehicles":
        """Returns no vehicles."""
        return OtherVehicles(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Fixtures:
    """Poles, trees and bushes: round, upright, never moving."""

    ids: IntArray  # (F,)
    positions_m: FloatArray  # (F, 2)
    radii_m: FloatArray  # (F,)
    heights_m: FloatArray  # (F,)

    @staticmethod
    def none() -> "Fixtures":
        """Returns no fixtures."""
        return Fixtures(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything there is at one time."""

    time_s: float
    vehicle: VehicleState
    people: People = field(default_factory=People.none)
    others: OtherVehicles = field(default_factory=OtherVehicles.none)
    fixtures: Fixtures = field(default_factory=Fixtures.none)


@dataclass(frozen=True, eq=False)
class Motion:
    """A drive's motion: scenes at rising times from 0 to at least duration_s; `scenes` starts afresh at each call."""

    name: str
    duration_s: float
    scenes: Callable[[], Iterator[Scene]]


class MotionSampler:
    """Interpolates a motion linearly at any times that do not go back by more than one scene.

    Scenes are 1/20 s or less apart, over which a pedestrian's path bends by 2 mm. Who is missing from one of the two
    scenes around a time is not there.
    """

    def __init__(self, motion: Motion):
        self._scenes = motion.scenes()
        self._before = next(self._scenes)
        self._after = self._before
        self._pair = _Pair(self._before, self._after)

    def at(self, time_s: float) -> Scene:
        """Returns the scene at a time, which must lie between the earlier scene in hand and the end of the motion."""
        self._move_to(time_s)
        return self._pair.at(time_s)

    def vehicle_at(self, time_s: float) -> VehicleState:
        """Returns the recording vehicle alone at a time, as `at` does."""
        self._move_to(time_s)
        return self._pair.vehicle_at(time_s)

    def _move_to(self, time_s: float) -> None:
        while time_s > self._after.time_s:
            following = next(self._scenes, None)
            if following is None:
                raise ValueError(f"the motion ends at {self._after.time_s:.3f} s, asked for {time_s:.3f} s")
            self._before, self._after = self._after, following
            self._pair = _Pair(self._before, self._after)
        if time_s < self._before.time_s:
            raise ValueError(f"the motion has moved on to {self._before.time_s:.3f} s, asked for {time_s:.3f} s")


class _Pair:
    """Two successive scenes with those present in both lined up."""

    def __init__(self, before: Scene, after: Scene):
        self.before, self.after = before, after
        self.people, self.people_0, self.people_1 = _present_in_both(before.people.ids, after.people.ids)
        self.others, self.others_0, self.others_1 = _present_in_both(before.others.ids, after.others.ids)

        i, j = self.people_0, self.people_1
        self.positions = before.people.positions_m[i], after.people.positions_m[j]
        self.velocities = before.people.velocities_mps[i], after.people.velocities_mps[j]

    def fraction(self, time_s: float) -> float:
        span = self.after.time_s - self.before.time_s
        return (time_s - self.before.time_s) / span if span > 0 else 0.0

    def vehicle_at(self, time_s: float) -> VehicleState:
        f, a, b = self.fraction(time_s), self.before.vehicle, self.after.vehicle
        return VehicleState(
            _blend(a.position_m, b.position_m, f),
            a.yaw_rad + f * (b.yaw_rad - a.yaw_rad),
            _blend(a.velocity_mps, b.velocity_mps, f),
            a.yaw_rate_radps + f * (b.yaw_rate_radps - a.yaw_rate_radps),
        )

    def at(self, time_s: float) -> Scene:
        f, before, after = self.fraction(time_s), self.before, self.after
        people = People(self.people, _blend(*self.positions, f), _blend(*self.velocities, f))
        i, j = self.others_0, self.others_1
        others = OtherVehicles(
            self.others,
            _blend(before.others.positions_m[i], after.others.positions_m[j], f),
            _blend(before.others.yaws_rad[i], after.others.yaws_rad[j], f),
            before.others.sizes_m[i],
        )
        return Scene(time_s, self.vehicle_at(time_s), people, others, before.fixtures)


def _present_in_both(before: IntArray, after: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Returns the ids in both (ascending), with their places in each."""
    return np.intersect1d(before, after, assume_unique=True, return_indices=True)


def _blend(a: FloatArray, b: FloatArray, fraction: float) -> FloatArray:
    return a + fraction * (b - a)
