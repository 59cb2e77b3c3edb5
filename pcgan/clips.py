"""Annotated vehicle-crowd clips (DUT and CITR, Yang et al. 2019) as trajectories in metres, y up.

The published files use image axes (x right, y down); here y, vy and heading are negated, so that angles turn
anticlockwise as everywhere else. Frames count video frames; the trajectories are contiguous in them.
"""

import gzip
import os
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.messages import FloatArray, IntArray

RATES_HZ = {"dut": 24000 / 1001, "citr": 30000 / 1001}
_FOLDERS = {"dut": "trajectories_filtered", "citr": ""}
_PEDESTRIAN_SUFFIX = "_traj_ped_filtered.csv"
_VEHICLE_SUFFIX = "_traj_veh_filtered.csv"
_PEDESTRIAN_COLUMNS = ("id", "frame", "label", "x_est", "y_est", "vx_est", "vy_est")
_VEHICLE_COLUMNS = ("id", "frame", "label", "x_est", "y_est", "psi_est", "vel_est")


class DataNotFound(FileNotFoundError):
    """A data set is not on this machine; the message says where it was looked for."""


class ClipError(ValueError):
    """A clip's file does not hold what it should; the message names the file and the problem."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One pedestrian's annotated track."""

    id: int
    frames: IntArray  # (T,)    video frames, contiguous
    positions_m: FloatArray  # (T, 2)
    velocities_mps: FloatArray  # (T, 2)


@dataclass(frozen=True, eq=False)
class VehicleTrajectory:
    """One vehicle's annotated track; the position is that of the published reference point."""

    id: int
    frames: IntArray  # (T,)    video frames, contiguous
    positions_m: FloatArray  # (T, 2)
    yaw_rad: FloatArray  # (T,)    -pi to pi as published; unwrap before interpolating
    speed_mps: FloatArray  # (T,)


@dataclass(frozen=True)
class Clip:
    """One annotated video: who was where at which frame."""

    name: str
    rate_hz: float
    pedestrians: tuple[Trajectory, ...]
    vehicles: tuple[VehicleTrajectory, ...]


def data_folder() -> Path:
    """Returns the folder with the data sets: PCGAN_DATA if set, else ../shared/data beside the project or the cwd.

    Raises DataNotFound naming every place that was tried. A PCGAN_DATA that does not exist is an error of its own:
    falling back to another copy would be a surprise.
    """
    if chosen := os.environ.get("PCGAN_DATA"):
        if Path(chosen).is_dir():
            return Path(chosen)
        raise DataNotFound(f"PCGAN_DATA is {chosen}, which is not a folder")
    project = Path(__file__).resolve().parents[1]
    candidates = [project.parent / "shared" / "data", Path.cwd().parent / "shared" / "data"]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    looked = ", ".join(str(candidate) for candidate in dict.fromkeys(candidates))
    raise DataNotFound(f"no data sets in {looked}; set PCGAN_DATA to the folder that holds dut/ and citr/")


def clip_names(dataset: str, data_dir: Path | None = None) -> tuple[str, ...]:
    """Returns the names of a data set's clips that have pedestrians, sorted, e.g. "dut/intersection_01".

    Raises ValueError for a data set other than "dut" and "citr", DataNotFound if it is not on this machine.
    """
    folder = _dataset_folder(dataset, data_dir)
    found = {
        f"{dataset}/{path.relative_to(folder).as_posix().split(_PEDESTRIAN_SUFFIX)[0]}"
        for path in folder.rglob(f"*{_PEDESTRIAN_SUFFIX}*")
    }
    if not found:
        raise DataNotFound(f"{folder} holds no *{_PEDESTRIAN_SUFFIX}[.gz]")
    return tuple(sorted(found))


def load_clip(name: str, data_dir: Path | None = None) -> Clip:
    """Returns a clip by name ("dut/roundabout_04", "citr/vci_front/front_interaction_01"), y up, ids as published.

    A clip without a vehicle file has no vehicles. Raises DataNotFound if the clip is not there (the pedestrians of
    dut/roundabout_03 never are), ClipError if a file is not what it should be.
    """
    dataset, _, clip = name.partition("/")
    folder = _dataset_folder(dataset, data_dir)
    pedestrian_file = _existing(folder / f"{clip}{_PEDESTRIAN_SUFFIX}")
    if pedestrian_file is None:
        raise DataNotFound(f"clip {name!r} is not in {folder}: no {clip}{_PEDESTRIAN_SUFFIX}[.gz]")
    vehicle_file = _existing(folder / f"{clip}{_VEHICLE_SUFFIX}")
    pedestrians = [
        Trajectory(id, frames, columns[:, 0:2] * (1, -1), columns[:, 2:4] * (1, -1))
        for id, frames, columns in _read_tracks(pedestrian_file, _PEDESTRIAN_COLUMNS)
    ]
    vehicles = [
        VehicleTrajectory(id, frames, columns[:, 0:2] * (1, -1), -columns[:, 2], columns[:, 3].copy())
        for id, frames, columns in (_read_tracks(vehicle_file, _VEHICLE_COLUMNS) if vehicle_file else ())
    ]
    return Clip(name, RATES_HZ[dataset], tuple(pedestrians), tuple(vehicles))


def _dataset_folder(dataset: str, data_dir: Path | None) -> Path:
    if dataset not in _FOLDERS:
        raise ValueError(f"no data set {dataset!r}; there are {sorted(_FOLDERS)}")
    folder = (data_dir or data_folder()) / dataset / _FOLDERS[dataset]
    if not folder.is_dir():
        raise DataNotFound(f"data set {dataset!r} is not on this machine: no folder {folder}")
    return folder


def _existing(path: Path) -> Path | None:
    """Returns the file as given or gzipped, whichever exists."""
    return next((p for p in (path, path.with_name(f"{path.name}.gz")) if p.is_file()), None)


def _read_tracks(path: Path, columns: tuple[str, ...]) -> list[tuple[int, IntArray, FloatArray]]:
    """Returns per track its id, frames (T,) and the four float columns (T, 4), in order of id."""
    try:
        content = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
        first, *rest = content.decode().splitlines() or [""]
    except (gzip.BadGzipFile, zlib.error, EOFError, UnicodeDecodeError) as error:
        raise ClipError(f"{path} cannot be read: {error}") from error
    header = tuple(first.strip().split(","))
    if header != columns:
        raise ClipError(f"{path} has columns {header} instead of {columns}")
    if not (lines := [line for line in rest if line.strip()]):
        return []
    try:
        table = np.loadtxt(lines, delimiter=",", usecols=(0, 1, 3, 4, 5, 6), ndmin=2)
    except ValueError as error:
        raise ClipError(f"{path} has a line that is not numbers: {error}") from error
    if not np.isfinite(table).all():
        raise ClipError(f"{path} holds NaN or infinity")
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    starts = np.flatnonzero(np.diff(table[:, 0], prepend=np.nan) != 0)
    tracks: list[tuple[int, IntArray, FloatArray]] = []
    for rows in np.split(table, starts[1:]):
        id, frames = int(rows[0, 0]), rows[:, 1].astype(np.int64)
        if (np.diff(frames) != 1).any():
            raise ClipError(f"{path}: the frames of track {id} are not contiguous")
        tracks.append((id, frames, rows[:, 2:]))
    return tracks
