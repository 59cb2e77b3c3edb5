"""Builders for the tests of pcgan/."""

from pathlib import Path

import numpy as np
import pytest
import torch

from pcgan import clips
from pcgan.clips import Clip, Trajectory, VehicleTrajectory
from pcgan.model import Generator, ModelConfig
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
