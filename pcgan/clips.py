"""Annotated clips as trajectories in metres: DUT, CITR (Yang et al. 2019), ETH, UCY (Pellegrini 2009, Lerner 2007).

The published files of DUT and CITR use image axes (x right, y down); here y, vy and heading are negated, so that angles
turn anticlockwise as everywhere else. ETH/UCY are world coordinates as published. Frames count what was annotated:
video frames in DUT and CITR, annotation steps of 0.4 s in ETH/UCY; trajectories are contiguous in them.
"""

import gzip
import os
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.messages import FloatArray, IntArray

RATES_HZ = {"dut": 24000 / 1001, "citr": 30000 / 1001, "eth_ucy": 2.5}
_FOLDERS = {"dut": "trajectories_filtered", "citr": "", "eth_ucy": ""}
# Video frames from one annotation step to the next. The video of ETH-Univ is accelerated: 6 of its frames are 0.4 s.
# Its 10-frame file, which most papers use, was interpolated to 0.67 s and is read as if that were 0.4 s.
_FRAMES_PER_STEP = {"biwi_eth_6frame": 6}
_USUAL_FRAMES_PER_STEP = 10
TRAJECTORY_SUFFIXES = (".csv", ".csv.gz", ".parquet")  # clips that are files of their own: pcgan/trajectory_file.py
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


def cache_folder() -> Path:
    """Returns where `pcgan data get` puts data sets: pcgan/data in XDG_CACHE_HOME or ~/.cache; it need not exist."""
    chosen = Path(os.environ.get("XDG_CACHE_HOME", ""))
    home = Path(os.path.expanduser("~"))  # noqa: PTH111  Path.home() raises where there is no home
    return (chosen if chosen.is_absolute() else home / ".cache") / "pcgan" / "data"


def data_folders() -> tuple[Path, ...]:
    """Returns the folders that data sets are read from, first wins: PCGAN_DATA alone if set, else those that exist of
    ../shared/data beside the project or the cwd, and the cache.

    Raises DataNotFound naming every place that was tried. A PCGAN_DATA that does not exist is an error of its own:
    falling back to another copy would be a surprise.
    """
    if chosen := os.environ.get("PCGAN_DATA"):
        if Path(chosen).is_dir():
            return (Path(chosen),)
        raise DataNotFound(f"PCGAN_DATA is {chosen}, which is not a folder")
    project = Path(__file__).resolve().parents[1]
    shared = [project.parent / "shared" / "data", Path.cwd().parent / "shared" / "data"]
    candidates = list(dict.fromkeys([*shared, cache_folder()]))
    if found := tuple(candidate for candidate in candidates if candidate.is_dir()):
        return found
    looked = ", ".join(map(str, candidates))
    raise DataNotFound(
        f"no data sets in {looked}; download them (`pcgan data get NAME`), or set PCGAN_DATA to the folder that holds"
        " dut/, citr/ and eth_ucy/"
    )


def data_folder() -> Path:
    """Returns the first of data_folders()."""
    return data_folders()[0]


def clip_names(dataset: str, data_dir: Path | None = None) -> tuple[str, ...]:
    """Returns the names of a data set's clips that have pedestrians, sorted, e.g. "dut/intersection_01".

    Raises ValueError for a data set other than "dut", "citr" and "eth_ucy", DataNotFound if it is not on this machine.
    """
    folder = _dataset_folder(dataset, data_dir)
    if dataset == "eth_ucy":
        return tuple(sorted(f"{dataset}/{path.stem}" for path in folder.glob("*.txt")))
    found = {
        f"{dataset}/{path.relative_to(folder).as_posix().split(_PEDESTRIAN_SUFFIX)[0]}"
        for path in folder.rglob(f"*{_PEDESTRIAN_SUFFIX}*")
        if path.name.endswith((_PEDESTRIAN_SUFFIX, f"{_PEDESTRIAN_SUFFIX}.gz"))  # no half of a download
    }
    if not found:
        raise DataNotFound(f"{folder} holds no *{_PEDESTRIAN_SUFFIX}[.gz]")
    return tuple(sorted(found))


def load_clip(name: str, data_dir: Path | None = None) -> Clip:
    """Returns a clip by name ("dut/roundabout_04", "citr/vci_front/front_interaction_01", "eth_ucy/biwi_hotel").

    DUT and CITR y up; ids as published. A name that ends in .csv, .csv.gz or .parquet is the path of a trajectory file.

    A clip without a vehicle file has no vehicles. Raises DataNotFound if the clip is not there (the pedestrians of
    dut/roundabout_03 never are), ClipError if a file is not what it should be.
    """
    if name.endswith(TRAJECTORY_SUFFIXES):
        from pcgan.trajectory_file import load_trajectories

        return load_trajectories(Path(name))
    dataset, _, clip = name.partition("/")
    folder = _dataset_folder(dataset, data_dir)
    if dataset == "eth_ucy":
        return _load_eth_ucy(name, folder / f"{clip}.txt")
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


def frames_per_step(file: str) -> int:
    """Returns how many video frames of an ETH/UCY file are one annotation step of 0.4 s."""
    return _FRAMES_PER_STEP.get(file, _USUAL_FRAMES_PER_STEP)


def _load_eth_ucy(name: str, path: Path) -> Clip:
    """Returns a clip of rows `frame ped_id x y`, its frames counted in annotation steps of 0.4 s."""
    if not path.is_file():
        raise DataNotFound(f"clip {name!r} is not in {path.parent}: no {path.name}")
    try:
        table = np.loadtxt(path, ndmin=2)
    except ValueError as error:
        raise ClipError(f"{path} has a line that is not numbers: {error}") from error
    if table.shape[1] != 4 or not np.isfinite(table).all():
        raise ClipError(f"{path} needs rows of four finite numbers, frame, id, x and y")
    every = frames_per_step(path.stem)
    people = []
    for id in np.unique(table[:, 1]):
        rows = table[table[:, 1] == id]
        rows = rows[np.argsort(rows[:, 0])]
        if (np.diff(rows[:, 0]) != every).any():
            raise ClipError(f"{path}: the frames of track {int(id)} are not contiguous")
        frames = (rows[:, 0] // every).astype(np.int64)  # the phase changes where nobody is seen
        steps = np.diff(rows[:, 2:], axis=0, prepend=rows[:1, 2:])  # causal: centred differences would leak the future
        steps[0] = steps[min(1, len(steps) - 1)]  # the first has none behind it
        velocities = steps * RATES_HZ["eth_ucy"]
        people.append(Trajectory(int(id), frames, rows[:, 2:], velocities))
    return Clip(name, RATES_HZ["eth_ucy"], tuple(people), ())


def _dataset_folder(dataset: str, data_dir: Path | None) -> Path:
    if dataset not in _FOLDERS:
        raise ValueError(f"no data set {dataset!r}; there are {sorted(_FOLDERS)}")
    folders = [place / dataset / _FOLDERS[dataset] for place in ((data_dir,) if data_dir else data_folders())]
    for folder in folders:
        if folder.is_dir():
            return folder
    looked = " or ".join(map(str, folders))
    raise DataNotFound(
        f"data set {dataset!r} is not on this machine: no folder {looked}; `pcgan data get {dataset}` downloads it"
    )


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
