"""Training windows as a predictor meets them: drives simulated from annotated clips, run through the real tracker.

A clean annotated track is not what a tracker gives: its positions lag, wander and are cut by occlusion. Here the
history is the tracker's, taken exactly as the predictor takes it, and the future is the annotation's.
"""

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from pcgan.clips import load_clip
from pcgan.dataset import (
    SCAN_PERIOD_S,
    VALIDATION_CLIPS,
    Windows,
    centred,
    concatenate,
    training_clip_names,
)
from pcgan.history import observations, vehicle_states
from pcgan.recipes import Task
from pcgan.windows_file import WindowsError, save_windows
from replay.score import Positions, lookup, match, true_positions
from replay.session import Replay
from replay.simulator import simulate
from schemas.messages import IntArray, TrackFrame
from tracking.tracker import LateScanError

SHORTEST_S = 3.0  # a vehicle that is there for less makes no drive
# The two models that ship: as the paper's vehicle data, and as far ahead as a planner needs.
TASKS = {
    "tracked_10hz": Task(dt_s=0.1, uses_vehicle=True),
    "tracked_2.5hz": Task(dt_s=0.4, uses_vehicle=True),
}


def make_windows(
    folder: Path,
    seeds: int,
    *,
    tasks: Mapping[str, Task] = TASKS,
    progress: Callable[[int, int], None] | None = None,
) -> dict[Path, int]:
    """Writes the windows of every vehicle's drive through every clip not held out, one file per task.

    Args:
        folder: where the .npz files go, as `pcgan train --windows` reads them.
        seeds: drives per vehicle, with sensor noise of their own.
        tasks: name of the file -> steps and dt_s of the network to train.
        progress: called with drives done and drives in all.

    Returns the files, and how many windows each has. Raises DataNotFound if the clips are not on this machine.
    """
    drives = [
        (name, vehicle.id, seed)
        for name in (*training_clip_names(), *VALIDATION_CLIPS)
        for clip in (load_clip(name),)
        for vehicle in clip.vehicles
        if len(vehicle.frames) >= SHORTEST_S * clip.rate_hz
        for seed in range(seeds)
    ]
    scenes: dict[str, list[_Scene]] = {name: [] for name in tasks}
    clips: dict[str, list[str]] = {name: [] for name in tasks}
    for clip_name, tracked in _tracked(drives, tasks, progress):
        for name, found in tracked.items():
            scenes[name] += found
            clips[name] += [clip_name] * len(found)
    counts = {}
    for name, task in tasks.items():
        found = scenes[name]
        if not found:
            raise WindowsError(f"no window in {len(drives)} drives: are the clips long enough for {name}?")
        path = folder / f"{name}.npz"
        save_windows(
            path,
            observed=np.concatenate([scene.observed for scene in found]),
            seen=np.concatenate([scene.seen for scene in found]),
            velocity=np.concatenate([scene.velocity for scene in found]),
            future=np.concatenate([scene.future for scene in found]),
            scene=np.repeat(np.arange(len(found)), [len(scene.observed) for scene in found]),
            vehicle=np.stack([scene.vehicle for scene in found]),
            clips=clips[name],
            dt_s=task.dt_s,
        )
        counts[path] = sum(len(scene.observed) for scene in found)
    return counts


# Drives that predictors are scored on: nobody's training, validation or tuning data (DESIGN section 7).
HELD_OUT_DRIVES: tuple[tuple[str, int | None], ...] = (
    ("dut/roundabout_04", None),
    ("dut/intersection_08", 2),
    ("citr/vci_lat_bi/bidirection_normal_driving_01", None),
    ("citr/vci_front/front_interaction_01", None),
)


def held_out_windows(
    tasks: Mapping[str, Task] = TASKS, progress: Callable[[int, int], None] | None = None, seed: int = 0
) -> dict[str, Windows]:
    """Returns the windows of the held-out drives, simulated and tracked now, one set per task: to score on, only.

    Raises DataNotFound if the clips are not on this machine.
    """
    parts: dict[str, list[Windows]] = {name: [] for name in tasks}
    drives = [(clip, vehicle, seed) for clip, vehicle in HELD_OUT_DRIVES]
    for _, tracked in _tracked(drives, tasks, progress):
        for name, scenes in tracked.items():
            counts = [len(scene.observed) for scene in scenes]
            parts[name].append(
                centred(
                    observed=np.concatenate([scene.observed for scene in scenes]),
                    seen=np.concatenate([scene.seen for scene in scenes]),
                    velocity=np.concatenate([scene.velocity for scene in scenes]),
                    future=np.concatenate([scene.future for scene in scenes]),
                    vehicle=np.repeat(np.stack([scene.vehicle for scene in scenes]), counts, axis=0),
                    scene=np.repeat(np.arange(len(scenes)), counts),
                    annotated=np.zeros(sum(counts), bool),
                    dt_s=tasks[name].dt_s,
                )
            )
    return {name: concatenate(windows) for name, windows in parts.items()}


def _tracked(
    drives: Sequence[tuple[str, int | None, int]],
    tasks: Mapping[str, Task],
    progress: Callable[[int, int], None] | None,
) -> Iterator[tuple[str, dict[str, list["_Scene"]]]]:
    """Simulates and tracks drives (clip, vehicle, seed) in turn; yields each one's clip, and scenes by task."""
    with tempfile.TemporaryDirectory(prefix="pcgan-windows-") as scratch:
        for done, (clip, vehicle, seed) in enumerate(drives):
            if progress is not None:
                progress(done, len(drives))
            log = Path(scratch) / "drive.mcap"
            simulate(log, clip=clip, vehicle=vehicle, pedestrians=0, duration_s=None, seed=seed)
            yield clip, _drive_scenes(log, tasks)


class _Scene:
    """One frame's windows."""

    def __init__(self, frame: TrackFrame, person_of: IntArray, task: Task):
        ages = np.arange(task.observed_steps - 1, -1, -1)
        times_ns = frame.stamp_ns - np.round(ages * task.dt_s * 1e9).astype(np.int64)
        observed, seen, usable = observations(frame.tracks, times_ns)
        self.stamp_ns = frame.stamp_ns
        self.observed = observed[usable]  # (N, T, 2)
        self.seen = seen[usable]  # (N, T)
        self.velocity = np.array([track.state[2:] for track in frame.tracks]).reshape(-1, 2)[usable]
        self.person_of = person_of[usable]  # (N,)  -1: nobody's
        vehicle = vehicle_states(frame.vehicle_history, times_ns)
        self.vehicle = np.full((task.observed_steps, 4), np.nan) if vehicle is None else vehicle
        steps = np.round(np.arange(1, task.predicted_steps + 1) * task.dt_s * 1e9).astype(np.int64)
        self.steps_ns = frame.stamp_ns + steps
        self.future = np.full((len(self.observed), task.predicted_steps, 2), np.nan)

    def fill(self, truth: list[Positions]) -> None:
        """Looks up where the people really went."""
        near = [frame for frame in truth if self.stamp_ns <= frame.stamp_ns <= self.steps_ns[-1] + 500_000_000]
        positions, known = lookup(near, self.person_of, self.steps_ns)
        known &= (self.person_of >= 0)[:, None]
        self.future[known] = positions[known]


def _drive_scenes(log: Path, tasks: Mapping[str, Task]) -> dict[str, list[_Scene]]:
    run = Replay([log])
    tracker = run.tracker()
    truth: list[Positions] = []
    scenes: dict[str, list[_Scene]] = {name: [] for name in tasks}
    for count, frame in enumerate(run.frames()):
        if frame.late:
            with suppress(LateScanError):  # too late to change anything
                tracker.amend(frame)
            continue
        _, tracks = tracker.step(frame)
        if frame.ground_truth is None:
            continue
        truth.append(true_positions(frame.ground_truth))
        person_of = match(tracks.tracks, frame.ground_truth)
        for name, task in tasks.items():
            if count % max(1, round(task.dt_s / SCAN_PERIOD_S / 2)) == 0:  # windows that share most steps teach little
                scene = _Scene(tracks, person_of, task)
                if len(scene.observed):
                    scenes[name].append(scene)
    for found in scenes.values():
        for scene in found:
            scene.fill(truth)
    return scenes
