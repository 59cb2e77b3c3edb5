"""Training windows of a made clip: what the tracker saw, as a predictor would take it, and where people really went."""

from types import SimpleNamespace

import numpy as np
import pytest

from pcgan.clips import Clip, Trajectory, VehicleTrajectory
from pcgan.dataset import WindowSpec, refuse_held_out
from pcgan.history import observations, vehicle_states
from pcgan.recipes import Task
from pcgan.trajectory_file import save_trajectories
from pcgan.windows_file import load_windows
from replay import training_windows
from replay.pipeline import FrameTracker
from replay.score import match
from replay.session import Replay
from replay.simulator import simulate
from replay.training_windows import SHORTEST_S

TASKS = {"fast": Task(4, 6, 0.1), "slow": Task(3, 2, 0.4, uses_vehicle=True)}


def made_clip(seconds=4.0, rate_hz=10.0):
    """Four people before a vehicle that drives along x at 2 m/s; the second leaves half-way."""
    count = int(seconds * rate_hz)
    time = np.arange(count)[:, None] / rate_hz
    people = []
    for id, (start, velocity, last) in enumerate([
        ((9.0, 3.0), (-0.5, -0.6), count),
        ((12.0, -3.0), (0.2, 1.0), count // 2),
        ((14.0, 2.0), (1.0, 0.0), count),
        ((16.0, -2.0), (0.3, -0.2), count),
    ]):  # fmt: skip
        positions = (np.array(start) + time * np.array(velocity))[:last]
        people.append(Trajectory(id + 1, np.arange(last), positions, np.tile(velocity, (last, 1))))
    car = VehicleTrajectory(0, np.arange(count), time * np.array([2.0, 0]), np.zeros(count), np.full(count, 2.0))
    return Clip("made.csv", rate_hz, tuple(people), (car,))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The files of one drive, and the same drive tracked again: its track frames and ground truths."""
    folder = tmp_path_factory.mktemp("windows")
    clip, short = str(folder / "made.csv"), str(folder / "short.csv")
    save_trajectories(made_clip(), folder / "made.csv")
    save_trajectories(made_clip(seconds=SHORTEST_S - 0.2), folder / "short.csv")
    progress = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training_windows, "training_clip_names", lambda: (short, clip))
        patch.setattr(training_windows, "VALIDATION_CLIPS", ())
        counts = training_windows.make_windows(
            folder, 1, tasks=TASKS, progress=lambda done, total: progress.append((done, total))
        )
    log = folder / "again.mcap"
    simulate(log, clip=clip, vehicle=0, pedestrians=0, duration_s=None, seed=0)
    run = Replay([log])
    tracker = FrameTracker(run.settings.tracking)
    frames = [(tracker.step(frame)[1], frame.ground_truth) for frame in run.frames()]
    return SimpleNamespace(folder=folder, clip=clip, counts=counts, progress=progress, frames=frames)


def arrays_of(made, name):
    with np.load(made.folder / f"{name}.npz") as file:
        return dict(file)


def times_of(tracks, task):
    return tracks.stamp_ns - np.round(np.arange(task.observed_steps - 1, -1, -1) * task.dt_s * 1e9).astype(np.int64)


def frames_of(made, task):
    """Every half step, the frames with somebody to predict: tracks, ground truth, usable."""
    every = max(1, round(task.dt_s / 0.1 / 2))
    for tracks, truth in made.frames[::every]:
        usable = observations(tracks.tracks, times_of(tracks, task))[2]
        if usable.any():
            yield tracks, truth, usable


def test_both_tasks_are_written(made):
    assert set(made.counts) == {made.folder / "fast.npz", made.folder / "slow.npz"}
    for name, task in TASKS.items():
        arrays = arrays_of(made, name)
        count = made.counts[made.folder / f"{name}.npz"]
        assert count > 20
        assert arrays["observed"].shape == (count, task.observed_steps, 2)
        assert arrays["future"].shape == (count, task.predicted_steps, 2)
        assert arrays["dt_s"] == task.dt_s
        assert set(arrays["clip"].tolist()) == {made.clip}


@pytest.mark.parametrize("name", TASKS)
def test_observed_is_what_a_predictor_would_observe(made, name):
    """Scene by scene the same as of the same drive's track frames."""
    task, arrays = TASKS[name], arrays_of(made, name)
    scene = -1
    for scene, (tracks, _, usable) in enumerate(frames_of(made, task)):
        rows = arrays["scene"] == scene
        observed, seen, _ = observations(tracks.tracks, times_of(tracks, task))
        np.testing.assert_array_equal(arrays["observed"][rows], observed[usable])
        np.testing.assert_array_equal(arrays["seen"][rows], seen[usable])
        states = np.array([track.state for track in tracks.tracks])[usable]
        np.testing.assert_array_equal(arrays["velocity"][rows], states[:, 2:])
        np.testing.assert_array_equal(arrays["observed"][rows][:, -1], states[:, :2])
        vehicle = vehicle_states(tracks.vehicle_history, times_of(tracks, task))
        expected = np.full((task.observed_steps, 4), np.nan) if vehicle is None else vehicle
        np.testing.assert_array_equal(arrays["vehicle"][scene], expected)
    assert scene == arrays["scene"][-1]
    assert not arrays["seen"].all()  # early in a track
    assert np.isfinite(arrays["vehicle"]).any()


@pytest.mark.parametrize("name", TASKS)
def test_futures_are_where_people_really_went(made, name):
    """In a plain loop over the ground truth; whoever is nobody, or has left by then, has no future there."""
    task, arrays = TASKS[name], arrays_of(made, name)
    truths = [truth for _, truth in made.frames]
    stamps = np.array([truth.stamp_ns for truth in truths])
    known = np.isfinite(arrays["future"]).all(axis=2)
    for scene, (tracks, truth, usable) in enumerate(frames_of(made, task)):
        persons = match(tracks.tracks, truth)[usable]
        for row, person in zip(np.flatnonzero(arrays["scene"] == scene), persons, strict=True):
            there = [person in truth.ids for truth in truths]
            last_ns = stamps[there].max() if any(there) else 0
            for step in range(task.predicted_steps):
                at_ns = tracks.stamp_ns + round((step + 1) * task.dt_s * 1e9)
                assert known[row, step] == (at_ns <= last_ns)
                if known[row, step]:
                    walk = np.array([t.positions_m[t.ids == person][0] for t in truths if person in t.ids])
                    expected = [np.interp(at_ns - stamps[0], stamps[there] - stamps[0], walk[:, i]) for i in (0, 1)]
                    np.testing.assert_allclose(arrays["future"][row, step], expected, atol=1e-6)
    assert known.any()
    assert not known.all()
    partly = known.any(axis=1) & ~known.all(axis=1)
    assert partly.any()  # a future that ends is kept as far as it goes


def test_files_are_read_for_training(made):
    for name, task in TASKS.items():
        training, validation = load_windows(
            made.folder / f"{name}.npz", WindowSpec(task.observed_steps, task.predicted_steps, task.dt_s)
        )
        assert 0 < len(training) <= made.counts[made.folder / f"{name}.npz"]
        assert len(validation) == 0
        ahead = np.linalg.norm(training.future[:, 0] - training.observed[:, -1], axis=1)
        assert np.nanmedian(ahead) < 0.3 + 1.2 * task.dt_s


def test_vehicles_that_are_there_briefly_make_no_drive(made):
    """Of the two clips, one is too short."""
    assert made.progress == [(0, 1)]


def test_clips_driven_through_are_not_held_out():
    refuse_held_out(training_windows.VALIDATION_CLIPS)
