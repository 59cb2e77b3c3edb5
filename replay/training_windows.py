"""Training windows as a predictor meets them: drives simulated from annotated clips, run through the real tracker.

A clean annotated track is not what a tracker gives: its positions lag, wander and are cut by occlusion. Here the
history is the tracker's, taken exactly as the predictor takes it, and the future is the annotation's.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pcgan.clips import load_clip
from pcgan.dataset import VALIDATION_CLIPS, training_clip_names
from pcgan.history import track_positions, vehicle_states
from pcgan.model import ModelConfig
from pcgan.windows_file import save_windows
from replay.pipeline import FrameTracker
from replay.score import Positions, lookup, match, true_positions
from replay.session import Replay
from replay.simulator import simulate
from schemas.messages import IntArray, TrackFrame

SHORTEST_S = 3.0  # a vehicle that is there for less makes no drive


def make_windows(
    output: Path,
    seeds: int,
    *,
    config: ModelConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Writes the windows of every vehicle's drive through every clip not held out; returns how many there are.

    Args:
        output: the .npz file, as `pcgan train --windows` reads it.
        seeds: drives per vehicle, with sensor noise of their own.
        config: steps and dt_s of the model to train.
        progress: called with drives done and drives in all.

    Raises DataNotFound if the clips are not on this machine.
    """
    config = config or ModelConfig()
    drives = [
        (name, vehicle.id, seed)
        for name in (*training_clip_names(), *VALIDATION_CLIPS)
        for clip in (load_clip(name),)
        for vehicle in clip.vehicles
        if len(vehicle.frames) >= SHORTEST_S * clip.rate_hz
        for seed in range(seeds)
    ]
    scenes: list[_Scene] = []
    clips: list[str] = []
    with tempfile.TemporaryDirectory(prefix="pcgan-windows-") as folder:
        for done, (name, vehicle, seed) in enumerate(drives):
            if progress is not None:
                progress(done, len(drives))
            log = Path(folder) / "drive.mcap"
            simulate(log, clip=name, vehicle=vehicle, pedestrians=0, duration_s=None, seed=seed)
            found = _drive_scenes(log, config)
            scenes += found
            clips += [name] * len(found)
    save_windows(
        output,
        observed=np.concatenate([scene.observed for scene in scenes]),
        velocity=np.concatenate([scene.velocity for scene in scenes]),
        future=np.concatenate([scene.future for scene in scenes]),
        scene=np.repeat(np.arange(len(scenes)), [len(scene.observed) for scene in scenes]),
        vehicle=np.stack([scene.vehicle for scene in scenes]),
        clips=clips,
        dt_s=config.dt_s,
    )
    return sum(len(scene.observed) for scene in scenes)


class _Scene:
    """One frame's windows."""

    def __init__(self, frame: TrackFrame, person_of: IntArray, config: ModelConfig):
        times_ns = frame.stamp_ns - np.round(np.arange(config.observed_steps - 1, -1, -1) * config.dt_s * 1e9).astype(
            np.int64
        )
        positions, covered = track_positions(frame.tracks, times_ns)
        usable = covered & ~np.array([track.coasting for track in frame.tracks], bool)
        self.stamp_ns = frame.stamp_ns
        self.observed = positions[usable]  # (N, T, 2)
        self.velocity = np.array([track.state[2:] for track in frame.tracks]).reshape(-1, 2)[usable]
        self.person_of = person_of[usable]  # (N,)  -1: nobody's
        vehicle = vehicle_states(frame.vehicle_history, times_ns)
        self.vehicle = np.full((config.observed_steps, 4), np.nan) if vehicle is None else vehicle
        steps = np.round(np.arange(1, config.predicted_steps + 1) * config.dt_s * 1e9).astype(np.int64)
        self.steps_ns = frame.stamp_ns + steps
        self.future = np.full((len(self.observed), config.predicted_steps, 2), np.nan)

    def fill(self, truth: list[Positions]) -> None:
        """Looks up where the people really went."""
        near = [frame for frame in truth if self.stamp_ns <= frame.stamp_ns <= self.steps_ns[-1] + 500_000_000]
        positions, known = lookup(near, self.person_of, self.steps_ns)
        known &= self.person_of >= 0
        self.future[known] = positions[known]


def _drive_scenes(log: Path, config: ModelConfig) -> list[_Scene]:
    run = Replay([log])
    tracker = FrameTracker(run.settings.tracking)
    truth: list[Positions] = []
    scenes = []
    for frame in run.frames():
        if frame.late:
            tracker.amend(frame)
            continue
        _, tracks = tracker.step(frame)
        if frame.ground_truth is None:
            continue
        truth.append(true_positions(frame.ground_truth))
        scene = _Scene(tracks, match(tracks.tracks, frame.ground_truth), config)
        if len(scene.observed):
            scenes.append(scene)
    for scene in scenes:
        scene.fill(truth)
    return scenes
