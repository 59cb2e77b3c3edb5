"""The paper's kinds of scene are found among walks made to be one, and only there."""

import numpy as np
import pytest

from pcgan.dataset import Windows, concatenate
from pcgan.scene_choice import busiest, oncoming_pair, turning_group, vehicle_from_behind

DT_S = 0.4
STEPS = np.arange(-7, 13)


def scene(*tracks, vehicle=None):
    """One scene of tracks (20, 2); the vehicle's state at the last observed step, driving straight."""
    walk = np.stack(tracks).astype(np.float32)
    state = np.full((len(walk), 8, 4), np.nan, np.float32)
    if vehicle is not None:
        place, velocity = np.array(vehicle[:2]), np.array(vehicle[2:])
        state[..., :2] = place + np.arange(-7, 1)[:, None] * DT_S * velocity
        state[..., 2:] = velocity
    return Windows(
        observed=walk[:, :8],
        seen=np.ones((len(walk), 8), bool),
        velocity=(walk[:, 7] - walk[:, 6]) / DT_S,
        future=walk[:, 8:],
        vehicle=state,
        scene=np.zeros(len(walk), np.int64),
        annotated=np.ones(len(walk), bool),
        dt_s=DT_S,
    )


def straight(x=0.0, y=0.0, vx=1.0, vy=0.0, swerve_m=0.0):
    aside = np.where(STEPS > 0, swerve_m * STEPS / 12, 0.0)
    return np.stack([x + DT_S * STEPS * vx, y + DT_S * STEPS * vy + aside], -1)


def turning(y=0.0, turn_rad=1.2):
    heading = np.clip((STEPS + 3) / 12, 0, 1) * turn_rad
    velocity = np.stack([np.cos(heading), np.sin(heading)], -1)
    track = np.cumsum(velocity, axis=0) * DT_S
    return track - track[7] + [0, y]


def test_oncoming_pair():
    side_by_side = scene(straight(), straight(y=1.0))
    far = scene(straight(), straight(x=12.0, vx=-1.0))
    passing_wide = scene(straight(), straight(x=5.0, y=3.0, vx=-1.0))
    head_on = scene(straight(y=9.0), straight(), straight(x=5.0, y=0.3, vx=-1.0))
    swerving = scene(straight(), straight(x=5.0, y=0.3, vx=-1.0, swerve_m=0.8))
    assert oncoming_pair(concatenate([side_by_side, far, passing_wide])) is None
    found = oncoming_pair(concatenate([side_by_side, head_on]))
    assert found.focus.tolist() == [1, 2]
    assert len(found.observed) == 3
    better = oncoming_pair(concatenate([head_on, swerving, side_by_side]))
    assert len(better.observed) == 2


def test_turning_group():
    alone = scene(turning(), straight(y=8.0))
    apart = scene(turning(), turning(y=5.0))
    other_side = scene(turning(), turning(y=1.0, turn_rad=-1.2))
    slight = scene(turning(turn_rad=0.3), turning(y=1.0, turn_rad=0.3))
    together = scene(straight(y=-8.0), turning(), turning(y=1.0))
    assert turning_group(concatenate([alone, apart, other_side, slight])) is None
    assert turning_group(concatenate([alone, together, slight])).focus.tolist() == [1, 2]


def test_vehicle_from_behind():
    none = scene(straight())
    ahead = scene(straight(), vehicle=(8.0, 0.0, 4.0, 0.0))
    oncoming = scene(straight(), vehicle=(8.0, 0.0, -4.0, 0.0))
    crossing = scene(straight(), vehicle=(-8.0, 0.0, 0.0, 4.0))
    slow = scene(straight(), vehicle=(-8.0, 0.0, 0.5, 0.0))
    behind = scene(straight(vx=-1.0), straight(y=0.5, swerve_m=0.5), vehicle=(-8.0, 0.0, 4.0, 0.0))
    assert vehicle_from_behind(concatenate([none, ahead, oncoming, crossing, slow])) is None
    found = vehicle_from_behind(concatenate([none, ahead, behind, crossing]))
    assert found.focus.tolist() == [1]
    assert np.isfinite(found.vehicle).all()


def test_busiest():
    few = scene(straight(), straight(y=1.0))
    many = scene(straight(), straight(y=1.0), straight(y=2.0), straight(y=30.0))
    assert busiest(concatenate([few, many])).focus.tolist() == [0, 1, 2]
    assert busiest(scene(straight(vx=0.0))) is None


@pytest.mark.parametrize("choose", [oncoming_pair, turning_group, vehicle_from_behind, busiest])
def test_only_whole_walks_take_part(choose):
    windows = concatenate(
        [
            scene(straight(), straight(x=5.0, y=0.3, vx=-1.0)),
            scene(turning(), turning(y=1.0)),
            scene(straight(), vehicle=(-8.0, 0.0, 4.0, 0.0)),
        ]
    )
    assert choose(windows) is not None
    windows.future[:, -1] = np.nan
    assert choose(windows) is None
    assert choose(windows.select(np.zeros(len(windows), bool))) is None


def test_a_scene_is_what_a_method_may_see():
    found = oncoming_pair(scene(straight(), straight(x=5.0, y=0.3, vx=-1.0)))
    observation = found.observation()
    assert observation.observed.shape == (2, 8, 2)
    assert observation.neighbours.all()
    assert observation.vehicle.isnan().all()
