"""Builders for the tests of pcgan/."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from pcgan import clips
from pcgan.batches import Observation
from pcgan.clips import Clip, Trajectory, VehicleTrajectory
from pcgan.dataset import HELD_OUT_CLIPS, VALIDATION_CLIPS, Windows, filled_in, weighted_velocity
from pcgan.model import Generator, ModelConfig
from pcgan.protocols import FIRST_VALIDATION_FRAME
from schemas.messages import Track, TrackFrame, TrackHistory, VehicleHistory

STAMP_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="session")
def public_data() -> Path:
    """The folder of the public data sets; the test skips, with the reason, where it is missing."""
    try:
        return clips.data_folder()
    except clips.DataNotFound as error:
        pytest.skip(str(error))


@pytest.fixture
def make_generator():
    """Builds a generator with seeded random weights."""

    def make(seed=0, **config):
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed)
            return Generator(ModelConfig(**config)).eval()

    return make


@pytest.fixture
def make_track():
    """Builds a track walking straight, with a history every 0.1 s up to the frame's stamp."""

    def make(*, id=1, position=(0.0, 0.0), velocity=(1.2, 0.0), age_s=3.0, coasting=False, ages_s=None, noise_m=0.0):
        ages = np.arange(round(age_s * 10), -1, -1) / 10 if ages_s is None else np.asarray(ages_s, float)
        stamps = STAMP_NS - np.round(ages * 1e9).astype(np.int64)
        points = np.asarray(position) - ages[:, None] * np.asarray(velocity)
        points = points + noise_m * np.random.default_rng(id).normal(size=points.shape)
        states = np.concatenate([points, np.tile(velocity, (len(ages), 1))], axis=1)
        history = TrackHistory(stamps, states, np.zeros(len(ages), bool))
        state = np.array([*position, *velocity], float)
        return Track(id, state, np.diag([0.01, 0.01, 0.04, 0.04]), 0.99, int(age_s * 1e9), coasting, history)

    return make


@pytest.fixture
def make_frame():
    """Builds a frame of tracks, with a vehicle driving along x if wanted."""

    def make(*tracks, vehicle_speed_mps=None, vehicle_y_m=-3.0, sequence=5):
        vehicle = VehicleHistory.empty()
        if vehicle_speed_mps is not None:
            ages = np.arange(36, -1, -1) / 10
            rows = [[-a * vehicle_speed_mps, vehicle_y_m, 0.0, vehicle_speed_mps, 0.0] for a in ages]
            vehicle = VehicleHistory(STAMP_NS - np.round(ages * 1e9).astype(np.int64), np.array(rows))
        return TrackFrame(sequence, STAMP_NS, "odom", vehicle, tuple(tracks))

    return make


@pytest.fixture
def make_observation():
    """Builds what is observed of a scene of A people walking about, with a vehicle that all of them see.

    With gaps, some steps are unseen, and filled in.
    """

    def make(A=5, *, T=8, seed=0, gaps=False, vehicle=True, spread_m=8.0, dt_s=0.1, dtype=torch.float32):
        rng = np.random.default_rng(seed)
        velocity = rng.normal(0, 1, (A, 2))
        ages = np.arange(T - 1, -1, -1)[:, None] * dt_s
        observed = rng.uniform(-spread_m, spread_m, (A, 1, 2)) - ages * velocity[:, None]
        observed += rng.normal(0, 0.02, (A, T, 2))
        seen = np.ones((A, T), bool)
        if gaps:
            seen = rng.random((A, T)) < 0.5
            seen[np.arange(A), rng.integers(0, T - 1, A)] = True
            seen[:, -1] = True
        speeds = rng.normal([5, 0], 0.1, (T, 2))
        driven = np.concatenate([[2, -3] - ages * [5, 0], speeds], axis=1)
        return Observation(
            observed=torch.from_numpy(filled_in(observed, seen)).to(dtype),
            seen=torch.from_numpy(seen),
            velocity=torch.from_numpy(velocity).to(dtype),
            neighbours=torch.ones(A, A, dtype=torch.bool),
            vehicle=torch.from_numpy(driven).to(dtype).expand(A, T, 4) if vehicle else None,
        )

    return make


@pytest.fixture
def make_clip():
    """Builds a clip of people walking along gentle curves, and vehicles along x."""

    def make(*, pedestrians=6, vehicles=1, frames=100, rate_hz=24.0, seed=0, turn_radps=0.2):
        rng = np.random.default_rng(seed)
        time_s = np.arange(frames) / rate_hz
        people = []
        for id in range(pedestrians):
            heading = rng.uniform(-np.pi, np.pi) + rng.normal(0, turn_radps) * time_s
            velocity = rng.uniform(0.8, 1.6) * np.stack([np.cos(heading), np.sin(heading)], -1)
            positions = rng.uniform(-10, 10, 2) + np.cumsum(velocity, axis=0) / rate_hz
            people.append(Trajectory(id, np.arange(1, frames + 1), positions, velocity))
        cars = []
        for id in range(vehicles):
            positions = np.stack([-10 + 4 * time_s, np.full(frames, 3.0 * id)], -1)
            cars.append(
                VehicleTrajectory(id, np.arange(1, frames + 1), positions, np.zeros(frames), np.full(frames, 4.0))
            )
        return Clip("dut/made_01", rate_hz, tuple(people), tuple(cars))

    return make


@pytest.fixture
def make_windows():
    """Builds windows of random walks, scene by scene of the sizes given; with gaps, some steps unseen or unknown."""

    def make(sizes=(1, 3, 2), *, observed_steps=8, predicted_steps=12, gaps=False, annotated=True, dt_s=0.4, seed=0):
        rng = np.random.default_rng(seed)
        N, T, P = sum(sizes), observed_steps, predicted_steps
        walks = rng.uniform(-5, 5, (N, 1, 2)) + np.cumsum(rng.normal(0.3, 0.2, (N, T + P, 2)), axis=1)
        seen, future = np.ones((N, T), bool), walks[:, T:].copy()
        if gaps:
            seen = rng.random((N, T)) < 0.4
            seen[np.arange(N), rng.integers(0, T - 1, N)] = True
            seen[:, -1] = True
            future[np.arange(P) >= rng.integers(1, P + 1, N)[:, None]] = np.nan
        observed = filled_in(walks[:, :T], seen)
        return Windows(
            observed=observed.astype(np.float32),
            seen=seen,
            velocity=weighted_velocity(observed, dt_s, seen).astype(np.float32),
            future=future.astype(np.float32),
            vehicle=rng.normal(0, 5, (N, T, 4)).astype(np.float32),
            scene=np.repeat(np.arange(len(sizes)), sizes),
            annotated=np.full(N, annotated),
            dt_s=dt_s,
        )

    return make


# --- made data sets --------------------------------------------------------------------------------------------------

SPEED_MPS = 0.025  # person k of the made data sets walks k times as fast, along x


class MadeData(NamedTuple):
    """A folder with dut/ and eth_ucy/ in which every person, of whichever clip, can be told by the speed.

    In ETH/UCY every step along y tells the time: 0.001 m at the first of the file, 0.002 m at the second and so on.
    """

    folder: Path
    people: dict[str, set[int]]  # file of ETH/UCY or clip of DUT -> k

    def of(self, windows: Windows) -> set[int]:
        """Whose futures these are, whichever way time runs."""
        steps = np.abs(np.diff(windows.future[..., 0], axis=1)) / (SPEED_MPS * windows.dt_s)
        return set(np.round(steps[np.isfinite(steps)]).astype(int).tolist())

    def each(self, windows: Windows) -> np.ndarray:
        """(N,) who each of some clean windows is."""
        return np.round(np.abs(windows.velocity[:, 0]) / SPEED_MPS).astype(int)

    def within(self, *names: str) -> set[int]:
        """Everybody in these files or clips."""
        return set().union(*(self.people[name] for name in names))

    def steps_of(self, windows: Windows) -> set[tuple[int, int]]:
        """Which steps of whom: (k, time), of ETH/UCY."""
        paths = np.concatenate([windows.observed, windows.future], axis=1)
        steps = np.diff(paths, axis=1)[windows.complete] / (SPEED_MPS * windows.dt_s, 0.001)
        return set(map(tuple, np.round(steps[np.isfinite(steps).all(axis=2)]).astype(int).tolist()))


@pytest.fixture(scope="session")
def made_data(tmp_path_factory) -> MadeData:
    """Nine files of ETH/UCY, three people each, who walk across the cut; nine clips of DUT, two to five people each.

    dut/intersection_01 has two vehicles, one after the other; dut/intersection_02 two at a time; the others one.
    """
    folder, people, k = tmp_path_factory.mktemp("made"), {}, 30
    (folder / "eth_ucy").mkdir()
    for file, first_validation in FIRST_VALIDATION_FRAME.items():
        every, rows = 6 if file == "biwi_eth_6frame" else 10, []
        people[file] = set(range(k, k + 3))
        for number, first in enumerate((0, 7, 12)):
            y, start = 0.0, first_validation // every - 30
            for step in range(first, 55 + first):
                y += 0.001 * step
                rows.append((every * (start + step), number, 0.4 * SPEED_MPS * (k + number) * step, y))
        k += 3
        rows.sort()
        text = "\n".join(f"{frame:.1f}\t{id:.1f}\t{x:.4f}\t{y:.4f}" for frame, id, x, y in rows)
        (folder / "eth_ucy" / f"{file}.txt").write_text(text)
    dut = folder / "dut" / "trajectories_filtered"
    dut.mkdir(parents=True)
    names = ("dut/intersection_01", "dut/intersection_02", *VALIDATION_CLIPS, *HELD_OUT_CLIPS)
    for count, name in enumerate(names):
        number = 2 + count % 4
        people[name] = set(range(k, k + number))
        lines = ["id,frame,label,x_est,y_est,vx_est,vy_est"]
        for person in people[name]:
            speed = SPEED_MPS * person
            lines += [f"{person},{f},ped,{speed * f * 1001 / 24000:.6f},{person},{speed},0" for f in range(1, 101)]
        k += number
        (dut / f"{name[4:]}_traj_ped_filtered.csv").write_text("\n".join(lines))
        spans = {"dut/intersection_01": ((1, 50), (51, 101)), "dut/intersection_02": ((1, 61), (41, 101))}
        lines = ["id,frame,label,x_est,y_est,psi_est,vel_est"]
        for id, (begin, end) in enumerate(spans.get(name, ((1, 101),))):
            lines += [f"{id},{f},veh,{4 * f * 1001 / 24000:.6f},{-5 - id},0,4" for f in range(begin, end)]
        (dut / f"{name[4:]}_traj_veh_filtered.csv").write_text("\n".join(lines))
    return MadeData(folder, people)
