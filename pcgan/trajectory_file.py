"""Trajectories in a file of their own, CSV or Parquet: one row per person and moment, in metres in the odometry frame.

The columns are `id, stamp_ns, x, y, vx, vy`, then `cov_xx, cov_xy, cov_yy` (of the position) and `vehicle_x, vehicle_y,
vehicle_yaw, vehicle_speed` (at that stamp), which may be absent or empty; further columns are not read. The axes are
right-handed, so with x ahead y is to the left. A row without id, x, y, vx and vy tells where the vehicle was while
nobody was seen.
"""

import csv
import gzip
import importlib
import io
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pcgan.clips import TRAJECTORY_SUFFIXES, Clip, ClipError, DataNotFound, Trajectory, VehicleTrajectory
from schemas.messages import BoolArray, FloatArray, IntArray

LONGEST_GAP_S = 0.5  # over longer ones nobody knows where a person went: the track is cut
STATE_COLUMNS = ("x", "y", "vx", "vy")
COVARIANCE_COLUMNS = ("cov_xx", "cov_xy", "cov_yy")
VEHICLE_COLUMNS = ("vehicle_x", "vehicle_y", "vehicle_yaw", "vehicle_speed")
COLUMNS = ("id", "stamp_ns", *STATE_COLUMNS, *COVARIANCE_COLUMNS, *VEHICLE_COLUMNS)
# Whole and half Hz up to 100, and the rates of NTSC video. A median step within 1% of one of them is taken as that.
_USUAL_RATES_HZ = np.array([*(n / 2 for n in range(1, 201)), *(n * 1000 / 1001 for n in (24, 30, 60))])
_RATE_TOLERANCE = 0.01
_SNAP_FRAMES = 0.01  # a stamp this near outside a grid point still counts as on it
_NO_ID = -1


@dataclass(frozen=True, eq=False)
class TrajectoryRows:
    """The rows of a trajectory file, sorted by stamp, then id."""

    ids: IntArray  # (N,)    -1 in rows that tell of the vehicle alone
    stamps_ns: IntArray  # (N,)
    states: FloatArray  # (N, 4) x, y, vx, vy in m and m/s; NaN in rows of the vehicle alone
    position_covs: FloatArray  # (N, 3) xx, xy, yy in m^2; NaN where not known
    vehicles: FloatArray  # (N, 4) x, y in m, yaw in rad, speed in m/s; NaN where not known

    @property
    def people(self) -> BoolArray:
        """(N,) which rows tell of a person."""
        return np.asarray(np.isfinite(self.states[:, 0]))


def load_trajectories(path: Path) -> Clip:
    """Returns the trajectories of a file as a clip named like the file, frame 0 at its first stamp.

    Its rate is the usual one nearest to the median step of the stamps. Between stamps states are interpolated linearly,
    over at most LONGEST_GAP_S: tracks are cut there, and their pieces keep the id. The vehicle, of id 0, is one
    trajectory: it is interpolated over longer gaps, too, since it was somewhere. Raises DataNotFound if
    there is no file, ClipError naming it and the problem if it is not what it should be.
    """
    rows = read_rows(path)
    people = rows.people
    order = np.lexsort((rows.stamps_ns[people], rows.ids[people]))
    ids, stamps = rows.ids[people][order], rows.stamps_ns[people][order]
    states = rows.states[people][order]
    new_track = np.diff(ids) != 0
    steps_ns = np.diff(stamps)
    if (twice := np.flatnonzero(~new_track & (steps_ns == 0))).size:
        raise ClipError(f"{path}: id {ids[twice[0]]} has two rows of stamp_ns {stamps[twice[0]]}")
    rate_hz = _rate(path, steps_ns[~new_track], rows.stamps_ns)
    start_ns = int(rows.stamps_ns[0])
    cuts = np.flatnonzero(new_track | (steps_ns > LONGEST_GAP_S * 1e9)) + 1
    pedestrians = []
    for piece in np.split(np.arange(len(ids)), cuts) if len(ids) else ():
        frames, at = _grid(stamps[piece] - start_ns, rate_hz)
        if len(frames):
            on_grid = _interpolated(at, stamps[piece] - start_ns, states[piece])
            pedestrians.append(Trajectory(int(ids[piece[0]]), frames, on_grid[:, :2], on_grid[:, 2:]))
    vehicle = _vehicle(path, rows, rate_hz)
    return Clip(path.name, rate_hz, tuple(pedestrians), (vehicle,) if vehicle is not None else ())


def save_trajectories(clip: Clip, path: Path, start_ns: int = 0, vehicle_id: int | None = None) -> None:
    """Writes a clip as CSV (gzipped if it ends in .gz) or Parquet; frame 0 has stamp start_ns, covariances stay empty.

    Raises ValueError if the clip has several vehicles and none of them is chosen, or two people of one id at a time;
    ClipError if Parquet cannot be written here; OSError if the file cannot.
    """
    by_id = {vehicle.id: vehicle for vehicle in clip.vehicles}
    if vehicle_id is None and len(by_id) > 1:
        raise ValueError(f"{clip.name} has vehicles {sorted(by_id)} and a trajectory file holds one: choose vehicle_id")
    if vehicle_id is not None and vehicle_id not in by_id:
        raise ValueError(f"{clip.name} has no vehicle {vehicle_id}; its vehicles are {sorted(by_id)}")
    ids = np.concatenate([np.zeros(0, np.int64), *(np.full(len(p.frames), p.id) for p in clip.pedestrians)])
    frames = np.concatenate([np.zeros(0, np.int64), *(p.frames for p in clip.pedestrians)])
    parts = [np.concatenate([p.positions_m, p.velocities_mps], axis=1) for p in clip.pedestrians]
    states = np.concatenate([np.zeros((0, 4)), *parts])
    if len(np.unique(np.stack([ids, frames], axis=1), axis=0)) < len(ids):
        raise ValueError(f"{clip.name} has two people of one id at a time")
    vehicles = np.full((len(ids), 4), np.nan)
    if by_id:
        vehicle = by_id[vehicle_id] if vehicle_id is not None else clip.vehicles[0]
        columns = np.column_stack([vehicle.positions_m, vehicle.yaw_rad, vehicle.speed_mps])  # (F, 4)
        alone = ~np.isin(vehicle.frames, frames)
        there = np.isin(frames, vehicle.frames)
        vehicles[there] = columns[frames[there] - vehicle.frames[0]]
        ids = np.concatenate([ids, np.full(alone.sum(), _NO_ID)])
        frames = np.concatenate([frames, vehicle.frames[alone]])
        states = np.concatenate([states, np.full((alone.sum(), 4), np.nan)])
        vehicles = np.concatenate([vehicles, columns[alone]])
    stamps_ns = start_ns + np.round(frames * 1e9 / clip.rate_hz).astype(np.int64)
    order = np.lexsort((ids, stamps_ns))
    unknown = np.full((len(ids), 3), np.nan)
    write_rows(TrajectoryRows(ids[order], stamps_ns[order], states[order], unknown, vehicles[order]), path)


def read_rows(path: Path) -> TrajectoryRows:
    """Returns a file's rows, sorted; raises DataNotFound or ClipError as load_trajectories does."""
    if not path.name.endswith(TRAJECTORY_SUFFIXES):
        raise ClipError(f"{path} must end in {', '.join(TRAJECTORY_SUFFIXES)}")
    if not path.is_file():
        raise DataNotFound(f"there is no file {path}")
    columns = _read_parquet(path) if path.suffix == ".parquet" else _read_csv(path)
    if missing := [name for name in COLUMNS[:6] if name not in columns]:
        raise ClipError(f"{path} has no column {', '.join(missing)}; its columns are {', '.join(columns)}")
    length = len(columns["id"])
    if length == 0:
        raise ClipError(f"{path} holds no rows")
    groups = {}
    for names in (STATE_COLUMNS, COVARIANCE_COLUMNS, VEHICLE_COLUMNS):
        given = [name for name in names if name in columns]
        if given and len(given) < len(names):
            raise ClipError(f"{path} has {', '.join(given)} but not all of {', '.join(names)}")
        empty = [[None] * length] * len(names)
        groups[names] = _floats(path, names, [columns[name] for name in names] if given else empty)
    states, vehicles = groups[STATE_COLUMNS], groups[VEHICLE_COLUMNS]
    ids = _whole_numbers(path, "id", columns["id"], may_be_empty=True)
    stamps = _whole_numbers(path, "stamp_ns", columns["stamp_ns"], may_be_empty=False)
    nobody = np.array([_is_empty(cell) for cell in columns["id"]])
    for bad, problem in (
        (nobody & np.isfinite(states[:, 0]), "a position without id"),
        (~nobody & np.isnan(states[:, 0]), "an id without x, y, vx, vy"),
        (nobody & np.isnan(vehicles[:, 0]), "neither a person nor the vehicle"),
        (~nobody & (ids < 0), "an id below 0"),
    ):
        if bad.any():
            raise ClipError(f"{path}, row {np.flatnonzero(bad)[0] + 1}: {problem}")
    order = np.lexsort((ids, stamps))
    covs = groups[COVARIANCE_COLUMNS]
    return TrajectoryRows(ids[order], stamps[order], states[order], covs[order], vehicles[order])


def write_rows(rows: TrajectoryRows, path: Path) -> None:
    """Writes rows as CSV (gzipped if it ends in .gz) or Parquet; what is NaN stays empty, floats keep every digit.

    Raises ValueError for another ending, ClipError if Parquet cannot be written here, OSError if the file cannot.
    """
    if not path.name.endswith(TRAJECTORY_SUFFIXES):
        raise ValueError(f"{path} must end in {', '.join(TRAJECTORY_SUFFIXES)}")
    floats = np.concatenate([rows.states, rows.position_covs, rows.vehicles], axis=1)  # (N, 11)
    cells: list[list[Any]] = [
        [None if id == _NO_ID else id for id in rows.ids.tolist()],
        rows.stamps_ns.tolist(),
        *([None if math.isnan(value) else value for value in column] for column in floats.T.tolist()),
    ]
    if path.suffix == ".parquet":
        pa, parquet = _pyarrow(path)
        types = [pa.int64(), pa.int64(), *[pa.float64()] * floats.shape[1]]
        arrays = [pa.array(column, type=type) for column, type in zip(cells, types, strict=True)]
        parquet.write_table(pa.Table.from_arrays(arrays, names=list(COLUMNS)), str(path))
        return
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(zip(*cells, strict=True))
    content = text.getvalue().encode()
    # mtime 0: the same trajectories give the same bytes
    path.write_bytes(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)


def _rate(path: Path, track_steps_ns: IntArray, stamps_ns: IntArray) -> float:
    """Returns the usual rate nearest to the median step within tracks, or of the vehicle's stamps if nobody has two."""
    steps_ns = track_steps_ns if len(track_steps_ns) else np.diff(np.unique(stamps_ns))
    if len(steps_ns) == 0:
        raise ClipError(f"{path} holds a single stamp: nothing moves")
    step_s = float(np.median(steps_ns)) / 1e9
    if step_s > LONGEST_GAP_S:
        raise ClipError(
            f"{path}: the median step of its stamps is {step_s:.3g} s, and over more than {LONGEST_GAP_S} s nobody is"
            " followed; stamp_ns counts nanoseconds"
        )
    nearest = float(_USUAL_RATES_HZ[np.argmin(np.abs(_USUAL_RATES_HZ * step_s - 1))])
    return nearest if abs(nearest * step_s - 1) <= _RATE_TOLERANCE else 1 / step_s


def _grid(times_ns: IntArray, rate_hz: float) -> tuple[IntArray, FloatArray]:
    """Returns the frames within rising times (T,) since frame 0, and their times in s; both (F,), F may be 0."""
    first = math.ceil(times_ns[0] / 1e9 * rate_hz - _SNAP_FRAMES)
    last = math.floor(times_ns[-1] / 1e9 * rate_hz + _SNAP_FRAMES)
    frames = np.arange(first, last + 1, dtype=np.int64)
    return frames, frames / rate_hz


def _interpolated(at_s: FloatArray, times_ns: IntArray, columns: FloatArray) -> FloatArray:
    """(F,), (T,), (T, C) -> (F, C)."""
    return np.stack([np.interp(at_s, times_ns / 1e9, column) for column in columns.T], axis=-1)


def _vehicle(path: Path, rows: TrajectoryRows, rate_hz: float) -> VehicleTrajectory | None:
    known = np.isfinite(rows.vehicles[:, 0])
    if not known.any():
        return None
    stamps, first = np.unique(rows.stamps_ns[known], return_index=True)
    poses = rows.vehicles[known][first]  # (T, 4)
    differs = (rows.vehicles[known] != poses[np.searchsorted(stamps, rows.stamps_ns[known])]).any(axis=1)
    if differs.any():
        raise ClipError(f"{path}: the vehicle is in two places at stamp_ns {rows.stamps_ns[known][differs][0]}")
    times_ns = stamps - rows.stamps_ns[0]
    frames, at = _grid(times_ns, rate_hz)
    if len(frames) == 0:
        return None
    poses[:, 2] = np.unwrap(poses[:, 2])
    on_grid = _interpolated(at, times_ns, poses)
    yaws = np.arctan2(np.sin(on_grid[:, 2]), np.cos(on_grid[:, 2]))
    return VehicleTrajectory(0, frames, on_grid[:, :2], yaws, on_grid[:, 3])


def _read_csv(path: Path) -> dict[str, Sequence[Any]]:
    """Returns the cells of each column, as text."""
    try:
        content = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
        lines = list(csv.reader(io.StringIO(content.decode("utf-8-sig"), newline="")))
    except (gzip.BadGzipFile, zlib.error, EOFError, UnicodeDecodeError, csv.Error) as error:
        raise ClipError(f"{path} cannot be read: {error}") from error
    if not lines:
        raise ClipError(f"{path} is empty; it needs a header: {','.join(COLUMNS)}")
    header = [name.strip() for name in lines[0]]
    if twice := {name for name in header if header.count(name) > 1}:
        raise ClipError(f"{path} has a column twice: {', '.join(sorted(twice))}")
    rows = [line for line in lines[1:] if line]
    for number, row in enumerate(rows, start=1):
        if len(row) != len(header):
            raise ClipError(f"{path}, row {number}: {len(row)} cells under {len(header)} columns")
    return dict(zip(header, zip(*rows, strict=True) if rows else [()] * len(header), strict=True))


def _read_parquet(path: Path) -> dict[str, Sequence[Any]]:
    """Returns the cells of each column, None where empty."""
    pa, parquet = _pyarrow(path)
    try:
        table = parquet.read_table(str(path))
    except (pa.ArrowException, OSError) as error:
        raise ClipError(f"{path} cannot be read: {error}") from error
    return {name: table.column(name).to_pylist() for name in table.column_names if name in COLUMNS}


def _pyarrow(path: Path) -> tuple[Any, Any]:
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        raise ClipError(
            f"{path} needs the package pyarrow, which is not installed; .csv and .csv.gz need none"
        ) from error


def _is_empty(cell: Any) -> bool:
    return cell is None or (isinstance(cell, str) and not cell.strip())


def _whole_numbers(path: Path, name: str, cells: Sequence[Any], *, may_be_empty: bool) -> IntArray:
    """(N,) cells as int64, -1 where empty; never by way of a float, which cannot hold a stamp."""
    numbers = np.full(len(cells), _NO_ID, np.int64)
    for i, cell in enumerate(cells):
        if _is_empty(cell) and may_be_empty:
            continue
        if isinstance(cell, float) or _is_empty(cell):
            raise ClipError(f"{path}, row {i + 1}: {name} is {cell!r}, not a whole number")
        try:
            numbers[i] = int(cell)
        except (ValueError, TypeError, OverflowError) as error:
            raise ClipError(f"{path}, row {i + 1}: {name} is {cell!r}, not a whole number") from error
    return numbers


def _floats(path: Path, names: Sequence[str], columns: Sequence[Sequence[Any]]) -> FloatArray:
    """Returns cells (N, C) as finite floats; a row may leave out all of them (NaN), but not some."""
    table = np.full((len(columns[0]), len(names)), np.nan)
    for c, (name, cells) in enumerate(zip(names, columns, strict=True)):
        for i, cell in enumerate(cells):
            if _is_empty(cell):
                continue
            try:
                table[i, c] = float(cell)
            except (ValueError, TypeError) as error:
                raise ClipError(f"{path}, row {i + 1}: {name} is {cell!r}, not a number") from error
            if not math.isfinite(table[i, c]):
                raise ClipError(f"{path}, row {i + 1}: {name} is {cell!r}; NaN and infinity are not wanted")
    some = np.isnan(table).any(axis=1) & ~np.isnan(table).all(axis=1)
    if some.any():
        i = np.flatnonzero(some)[0]
        lacking = [name for name, value in zip(names, table[i], strict=True) if math.isnan(value)]
        raise ClipError(f"{path}, row {i + 1}: {', '.join(lacking)} is empty")
    return table
