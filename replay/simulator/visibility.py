"""Who hides whom, seen from one sensor: everything upright is a disc, and nearer discs are painted over farther ones.

The horizon is divided into columns; each belongs to the nearest disc it meets. A person is one disc, a vehicle a row
of them, so that somebody in front of a long car is not hidden by its nearer end. Hiding is complete from top to
bottom: sensors at 1.4 to 1.7 m look at people almost level.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from replay.simulator.motion import OtherVehicles, Scene
from replay.simulator.sensor_model import SensorModelV1
from schemas.messages import BoolArray, FloatArray, IntArray

PERSON, VEHICLE, FIXTURE = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Objects:
    """Everything solid in a scene: O objects (people, then vehicles, then fixtures) made of J discs."""

    kinds: IntArray  # (O,)    PERSON, VEHICLE or FIXTURE
    keys: IntArray  # (O,)    one number per object for the whole drive
    heights_m: FloatArray  # (O,)
    owners: IntArray  # (J,)    object of each disc, rising
    centres_m: FloatArray  # (J, 2)  map frame
    radii_m: FloatArray  # (J,)


def stacked(objects: Sequence[Objects]) -> Objects:
    """Returns the objects of several scenes one after another; owners count through all of them."""
    before = np.cumsum([0, *(len(each.kinds) for each in objects)])[:-1]
    return Objects(
        np.concatenate([each.kinds for each in objects]),
        np.concatenate([each.keys for each in objects]),
        np.concatenate([each.heights_m for each in objects]),
        np.concatenate([each.owners + first for each, first in zip(objects, before, strict=True)]),
        np.concatenate([each.centres_m for each in objects]),
        np.concatenate([each.radii_m for each in objects]),
    )


class ObjectTable:
    """Turns scenes into their solid objects; what does not change from one scene to the next is made once.

    People's heights differ, by id and seed, and stay the same for the drive.
    """

    def __init__(self, model: SensorModelV1, seed: int):
        self._model = model
        self._seed = seed
        self._same: tuple[object, ...] = ()
        self._last: Objects | None = None

    def objects(self, scene: Scene) -> Objects:
        """Returns the solid objects of a scene."""
        same = (scene.people.ids, scene.others.ids, scene.fixtures)
        last = self._last
        if (
            last is not None
            and not len(scene.others.ids)
            and all(a is b for a, b in zip(same, self._same, strict=True))
        ):
            A = len(scene.people.ids)
            centres = last.centres_m.copy()
            centres[:A] = scene.people.positions_m
            return replace(last, centres_m=centres)
        self._last = _objects_in(scene, self._model, self._seed)
        self._same = same
        return self._last


def _objects_in(scene: Scene, model: SensorModelV1, person_seed: int) -> Objects:
    people, others, fixtures = scene.people, scene.others, scene.fixtures
    A, V, F = len(people.ids), len(others.ids), len(fixtures.ids)
    vehicle_owners, vehicle_centres, vehicle_radii = _vehicle_discs(others)
    heights = model.person_height_m + model.person_height_sd_m * _hashed_normal(people.ids, person_seed)
    return Objects(
        np.repeat([PERSON, VEHICLE, FIXTURE], [A, V, F]),
        np.concatenate([people.ids * 3 + PERSON, others.ids * 3 + VEHICLE, fixtures.ids * 3 + FIXTURE]),
        np.concatenate([heights, others.sizes_m[:, 2], fixtures.heights_m]),
        np.concatenate([np.arange(A), A + vehicle_owners, A + V + np.arange(F)]),
        np.concatenate([people.positions_m, vehicle_centres, fixtures.positions_m]),
        np.concatenate([np.full(A, model.person_radius_m), vehicle_radii, fixtures.radii_m]),
    )


def _vehicle_discs(others: OtherVehicles) -> tuple[IntArray, FloatArray, FloatArray]:
    """Returns owner, centre and radius of a row of discs per vehicle, as wide as it is, overlapping by half."""
    owners: list[IntArray] = [np.zeros(0, np.int64)]
    centres: list[FloatArray] = [np.zeros((0, 2))]
    radii: list[FloatArray] = [np.zeros(0)]
    for i, (length, width, _) in enumerate(others.sizes_m):
        radius = width / 2
        count = max(1, math.ceil((length - width) / radius) + 1)
        along = np.linspace(-1, 1, count) * max(0.0, (length - width) / 2)
        heading = np.array([math.cos(others.yaws_rad[i]), math.sin(others.yaws_rad[i])])
        owners.append(np.full(count, i))
        centres.append(others.positions_m[i] + along[:, None] * heading)
        radii.append(np.full(count, radius))
    return np.concatenate(owners), np.concatenate(centres), np.concatenate(radii)


def _hashed_normal(ids: IntArray, seed: int) -> FloatArray:
    """Returns a number per id, roughly standard normal and within +-2.1: a sum of four uniform hashes."""
    total = np.zeros(len(ids))
    for k in range(4):
        # SplitMix64's finaliser (Steele et al. 2014)
        x = ids.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + np.uint64((seed * 4 + k + 1) & (2**64 - 1))
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        total += (x ^ (x >> np.uint64(31))).astype(float) / 2.0**64
    normal: FloatArray = np.clip((total - 2) * math.sqrt(3), -2.1, 2.1)
    return normal


@dataclass(frozen=True, eq=False)
class View:
    """What one sensor sees of each of J discs. Columns run anticlockwise, like bearings."""

    distances_m: FloatArray  # (J,)    to the disc's centre
    bearings_rad: FloatArray  # (J,)   of the disc's centre, from the direction of sight
    columns: IntArray  # (J,)    columns the disc would fill if nothing hid it
    visible: IntArray  # (J,)    columns that are left
    first: IntArray  # (J,)    first visible column, counted from the disc's own first; meaningless if none is
    last: IntArray  # (J,)    last visible column, counted likewise
    mean_offset_rad: FloatArray  # (J,)    mean bearing of the visible columns, from the centre's; 0 if none is


def look(
    offsets_m: FloatArray, radii_m: FloatArray, candidates: BoolArray, sweeps: IntArray, *, columns: int, phase: float
) -> View:
    """Returns what a sensor at the origin, looking along x, sees of discs, for any number of sweeps at once.

    Args:
        offsets_m: (J, 2) centres in the sensor's horizontal frame.
        radii_m: (J,)
        candidates: (J,) which discs can be seen at all; the others hide nothing either.
        sweeps: (J,) which sweep (image, scan) each disc belongs to, from 0; discs hide others of their sweep only.
        columns: how many equal columns make up the whole circle.
        phase: 0 to 1, where in its width a column looks.

    A disc that the sensor stands in is not seen and hides nothing.
    """
    J = len(radii_m)
    distances = np.maximum(np.hypot(offsets_m[:, 0], offsets_m[:, 1]), 1e-9)
    bearings = np.arctan2(offsets_m[:, 1], offsets_m[:, 0])
    width = 2 * math.pi / columns
    half = np.arcsin(np.minimum(radii_m / distances, 1.0))
    first = np.ceil((bearings - half) / width - phase).astype(np.int64)
    last = np.floor((bearings + half) / width - phase).astype(np.int64)
    total = np.where(candidates & (distances > radii_m + 0.05), last - first + 1, 0)

    # One row of columns per sweep, end to end; a disc that reaches over its row's end goes on at the row's start.
    painted = np.full(columns * (int(sweeps.max(initial=-1)) + 1), -1, np.int64)
    seen = np.flatnonzero(total > 0)
    seen = seen[np.argsort((radii_m - distances)[seen], kind="stable")]  # farthest surface first
    rows = sweeps[seen] * columns
    starts = rows + first[seen] % columns
    ends = zip(seen.tolist(), rows.tolist(), starts.tolist(), (starts + total[seen]).tolist(), strict=True)
    for j, row, start, stop in ends:
        painted[start : min(stop, row + columns)] = j
        if stop > row + columns:
            painted[row : stop - columns] = j

    filled = np.flatnonzero(painted >= 0)
    owner = painted[filled]
    within = (filled - first[owner]) % columns  # column counted from the disc's first
    visible = np.bincount(owner, minlength=J)
    mean = np.bincount(owner, weights=within, minlength=J) / np.maximum(visible, 1)
    mean_offset = np.where(visible > 0, (first + mean + phase) * width - bearings, 0.0)
    lowest, highest = np.full(J, columns, np.int64), np.full(J, -1, np.int64)
    np.minimum.at(lowest, owner, within)
    np.maximum.at(highest, owner, within)
    return View(distances, bearings, total, visible, lowest, highest, mean_offset)
