"""What a run learns from and is watched on, by the name of the data: a fold of ETH/UCY, the VCI split, drives."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pcgan.clips import load_clip
from pcgan.dataset import (
    VALIDATION_CLIPS,
    Windows,
    WindowSpec,
    clip_windows,
    concatenate,
    reversed_in_time,
    training_clip_names,
)
from pcgan.protocols import ETH_UCY_SPEC, VCI_SPEC, eth_ucy_fold, vci_split
from pcgan.recipes import Recipe, Task
from pcgan.scores import scorable
from pcgan.windows_file import load_windows
from schemas.messages import FloatArray

DATA = ("eth_ucy", "vci", "drives")
CROWDED = "students"
LONG_STEP_S = 0.4  # where few windows of a clip are worth anything new, and learning them by heart begins early
FILTERED_COPIES = 2  # of each clip, as a tracker with this much noise would see it
FILTER_NOISE_M = (0.03, 0.10)
VALIDATION_NOISE_M = 0.06


@dataclass(frozen=True, eq=False)
class TrainData:
    """What a run learns from, and the sets it is watched on, by name; none of them holds a test scene."""

    training: Windows
    share: FloatArray  # (scenes,) probability with which an epoch draws each training scene
    validation: dict[str, Windows]


def default_task(data: str, dt_s: float | None = None) -> Task:
    """Returns the task that goes with the data: the protocols', and for drives the paper's 10 Hz, 1.2 s, or `dt_s`.

    Raises ValueError for data that do not exist, and for another dt_s than the data's.
    """
    if data == "drives":
        return Task(dt_s=dt_s or 0.1, uses_vehicle=True, epochs=8 if (dt_s or 0.1) < LONG_STEP_S else 3)
    if dt_s is not None:
        raise ValueError(f"only drives can have another step, not {data!r}")
    if data == "eth_ucy":
        return Task(dt_s=ETH_UCY_SPEC.dt_s)
    if data == "vci":
        return Task(dt_s=VCI_SPEC.dt_s, uses_vehicle=True)
    raise ValueError(f"no data {data!r} to train on; there are {DATA}")


def training_data(
    data: str,
    recipe: Recipe,
    *,
    leave_out: str | None = None,
    window_files: tuple[Path, ...] = (),
    trajectory_files: tuple[Path, ...] = (),
    data_dir: Path | None = None,
    seed: int = 0,
) -> TrainData:
    """Returns the windows of a run.

    Args:
        data: `eth_ucy` (all but the scene or comma-separated scenes to leave out), `vci`, or `drives`: the DUT clips
            that may be trained on, clean and as a tracker would see them, at the recipe's rate, and at 2.5 Hz ETH/UCY
            as well.
        recipe: decides steps, dt, and how scenes are drawn.
        leave_out: scenes of ETH/UCY.
        window_files: a tracker's windows, for `drives`.
        trajectory_files: trajectories of one's own (`trajectory_file.py`), to learn from as well, for `drives`.
        data_dir: where the data sets are; None: where they are usually looked for.
        seed: of the noise in filtered copies.

    Raises DataNotFound, WindowsError, or ValueError for names that do not exist.
    """
    network = recipe.network
    steps = {"observed_steps": network.observed_steps, "predicted_steps": network.predicted_steps}
    if leave_out and data != "eth_ucy":
        raise ValueError(f"only scenes of eth_ucy can be left out, not of {data}")
    if (window_files or trajectory_files) and data != "drives":
        raise ValueError(f"windows and trajectories of one's own go with the data 'drives', not with {data!r}")
    found = _Collection(recipe)
    eth_ucy_spec = replace(ETH_UCY_SPEC, **steps, dt_s=network.dt_s)
    if data == "eth_ucy":
        out = tuple(leave_out.split(",")) if leave_out else ()
        return found.data(_add_eth_ucy(found, recipe, out, eth_ucy_spec, data_dir))
    if data == "vci":
        split = vci_split(replace(VCI_SPEC, **steps, dt_s=network.dt_s), data_dir)
        for windows in split.training.values():
            found.add(windows)
        return found.data({"vci": concatenate(list(split.validation.values()))})
    if data == "drives":
        spec = WindowSpec(**steps, dt_s=network.dt_s)
        validation = _add_drives(found, spec, window_files, data_dir, seed)
        for file in trajectory_files:
            windows = clip_windows(load_clip(str(file)), spec)
            found.add(replace(windows, annotated=np.zeros(len(windows), bool)))  # what a tracker saw has its own noise
        if abs(network.dt_s - ETH_UCY_SPEC.dt_s) < 1e-9:
            validation |= _add_eth_ucy(found, recipe, (), eth_ucy_spec, data_dir)
        return found.data(validation)
    raise ValueError(f"no data {data!r} to train on; there are {DATA}")


class _Collection:
    """Windows put together, with the probability that an epoch draws each of their scenes."""

    def __init__(self, recipe: Recipe):
        self._recipe = recipe
        self._parts: list[Windows] = []
        self._shares: list[FloatArray] = []

    def add(self, windows: Windows, share: float = 1.0) -> None:
        if self._recipe.complete_only:
            windows = windows.select(windows.complete & windows.known.all(axis=1))
        if len(windows):
            self._parts.append(windows)
            self._shares.append(np.full(int(windows.scene[-1]) + 1, share * self._recipe.share))

    def data(self, validation: dict[str, Windows]) -> TrainData:
        if not self._parts:
            raise ValueError("no training window has a known future; are the clips or drives long enough?")
        return TrainData(concatenate(self._parts), np.concatenate(self._shares), validation)


def _add_eth_ucy(
    found: _Collection, recipe: Recipe, out: tuple[str, ...], spec: WindowSpec, data_dir: Path | None
) -> dict[str, Windows]:
    """Adds the training parts of all scenes but those left out; returns their validation parts, as one set."""
    split = eth_ucy_fold(out, spec, data_dir)
    for file, windows in split.training.items():
        drawn = recipe.crowd_share if file.startswith(CROWDED) else 1.0
        found.add(windows, drawn * (1 - recipe.reversed_share))
        if recipe.reversed_share > 0:
            found.add(reversed_in_time(windows), drawn * recipe.reversed_share)
    return {"scenes": concatenate(list(split.validation.values()))}


def _add_drives(
    found: _Collection, spec: WindowSpec, window_files: tuple[Path, ...], data_dir: Path | None, seed: int
) -> dict[str, Windows]:
    rng = np.random.default_rng(seed)
    for name in training_clip_names(data_dir):
        clip = load_clip(name, data_dir)
        found.add(clip_windows(clip, spec))
        for _ in range(FILTERED_COPIES):
            found.add(clip_windows(clip, spec, float(rng.uniform(*FILTER_NOISE_M)), rng))
    clips = [load_clip(name, data_dir) for name in VALIDATION_CLIPS]
    rng = np.random.default_rng(12345)  # the same validation noise whatever the seed of the run
    validation = {
        "clean": concatenate([clip_windows(clip, spec) for clip in clips]),
        "filtered": concatenate([clip_windows(clip, spec, VALIDATION_NOISE_M, rng) for clip in clips]),
    }
    for file in window_files:
        train_part, validation_part = load_windows(file, spec)
        found.add(train_part)
        if scorable(validation_part, spec.predicted_steps).any():
            validation[file.stem] = validation_part
    return validation
