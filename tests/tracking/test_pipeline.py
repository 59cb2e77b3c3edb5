"""The stage from sensor frames to tracks."""

import numpy as np
import pytest

from tracking.pipeline import TrackingSettings, TrackingStage
from tracking.tracker import LateScanError

START_NS, STEP_NS = 1_600_000_000_000_000_000, 100_000_000


def drive(world, scans=40, first=0):
    """Two walkers and a pole, the vehicle standing."""
    for k in range(first, first + scans):
        people = [[6 + 0.12 * k, -3], [10, -6 + 0.13 * k]]
        yield world.frame(people, START_NS + k * STEP_NS, poles_m=[[7.0, 2.0]], seed=k)


def test_walkers_are_tracked_and_the_pole_is_not(world):
    stage = TrackingStage()
    for k, frame in enumerate(drive(world)):
        result = stage.step(frame)
        assert len(result.measurements) == 3
        if k >= 4:
            assert len(result.tracks) == 2
    assert [track.id for track in result.tracks] == [1, 2]
    states = np.array([track.state for track in result.tracks])
    states = states[np.argsort(states[:, 1])]
    np.testing.assert_allclose(states[0], [6 + 0.12 * 39, -3, 1.2, 0], atol=0.25)
    np.testing.assert_allclose(states[1], [10, -6 + 0.13 * 39, 0, 1.3], atol=0.25)


def test_two_stages_give_the_same_bits(world):
    one, other = TrackingStage(), TrackingStage()
    for frame in drive(world, 15):
        a, b = one.step(frame), other.step(frame)
        for x, y in zip(a.tracks, b.tracks, strict=True):
            assert x.id == y.id
            assert x.state.tobytes() == y.state.tobytes()
            assert x.history.states.tobytes() == y.history.states.tobytes()


def test_a_late_frame_is_refused_or_amended(world):
    stage, frames = TrackingStage(), list(drive(world, 30))
    for frame in [*frames[:20], *frames[21:24]]:
        stage.step(frame)
    with pytest.raises(LateScanError):
        stage.step(frames[20])
    assert len(stage.amend(frames[20])) == 3
    with pytest.raises(LateScanError):
        stage.amend(frames[2])
    assert [track.id for track in stage.step(frames[24]).tracks] == [1, 2]


def test_settings_survive_json():
    settings = TrackingSettings.model_validate({"tracker": {"coasting_after_s": 0.5}, "fusion": {"height_m": 1.8}})
    assert TrackingSettings.model_validate_json(settings.model_dump_json()) == settings
    with pytest.raises(ValueError, match="heigth_m"):
        TrackingSettings.model_validate({"fusion": {"heigth_m": 1.8}})
