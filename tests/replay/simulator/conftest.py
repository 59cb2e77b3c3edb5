"""Builders for the simulator's tests: scenes of a few people around a vehicle at the origin, and one short drive."""

from pathlib import Path

import numpy as np
import pytest

from pcgan import clips
from replay.simulator import simulate
from replay.simulator.motion import Fixtures, Motion, OtherVehicles, People, Scene, VehicleState


@pytest.fixture
def make_scene():
    """Builds a scene: the vehicle at a pose, people standing at places (A, 2), boxes (x, y, yaw), fixtures."""

    def make(people=(), others=(), fixtures=(), *, time_s=0.0, position=(0.0, 0.0), yaw=0.0):
        places = np.array(people, float).reshape(-1, 2)
        boxes, posts = np.array(others, float).reshape(-1, 3), np.array(fixtures, float).reshape(-1, 4)
        return Scene(
            time_s,
            VehicleState(np.array(position, float), yaw, np.zeros(2), 0.0),
            People(np.arange(1, len(places) + 1), places, np.zeros_like(places)),
            OtherVehicles(np.arange(len(boxes)), boxes[:, :2], boxes[:, 2], np.tile((4.5, 1.8, 1.5), (len(boxes), 1))),
            Fixtures(np.arange(len(posts)), posts[:, :2], posts[:, 2], posts[:, 3]),
        )

    return make


@pytest.fixture
def make_motion():
    """Builds a motion from scenes."""

    def make(scenes, name="made"):
        return Motion(name, scenes[-1].time_s, lambda: iter(scenes))

    return make


@pytest.fixture(scope="session")
def drive(tmp_path_factory) -> Path:
    """A 6 s drive through a crowd of 25."""
    path = tmp_path_factory.mktemp("drives") / "crowd.mcap"
    simulate(path, clip=None, vehicle=None, pedestrians=25, duration_s=6.0, seed=3)
    return path


@pytest.fixture(scope="session")
def public_clips() -> Path:
    """The folder of the public data sets; the test skips, with the reason, where DUT is missing."""
    try:
        clips.clip_names("dut")
        return clips.data_folder()
    except clips.DataNotFound as error:
        pytest.skip(str(error))
