from itertools import pairwise

import numpy as np
import pytest

from replay.simulator.motion import SimulationError
from replay.simulator.social_force import CrowdSettings, crowd_motion

SETTINGS = CrowdSettings()


@pytest.fixture(scope="module")
def scenes():
    return list(crowd_motion(40, 60.0, seed=5).scenes())


def in_vehicle_axes(scene):
    place = scene.people.positions_m - scene.vehicle.position_m
    c, s = np.cos(scene.vehicle.yaw_rad), np.sin(scene.vehicle.yaw_rad)
    return place @ (c, s), place @ (-s, c)


def test_scenes_cover_the_duration_in_even_steps(scenes):
    times = [scene.time_s for scene in scenes]
    assert times[0] == 0
    assert times[-1] >= 60.0
    np.testing.assert_allclose(np.diff(times), 0.05)


def test_nobody_is_run_over(scenes):
    inside = 0
    for scene in scenes:
        along, left = in_vehicle_axes(scene)
        inside += int(((along > -0.9) & (along < 1.9) & (np.abs(left) < 0.7)).sum())
    assert inside <= 0.0005 * 40 * len(scenes)


def test_speeds_are_those_of_people(scenes):
    speeds = np.concatenate([np.linalg.norm(scene.people.velocities_mps, axis=1) for scene in scenes])
    walking = speeds[speeds > 0.3]
    assert 1.1 < np.median(walking) < 1.4
    assert speeds.max() <= SETTINGS.fastest_mps + 1e-9
    assert 0.05 < np.mean(speeds < 0.3) < 0.35  # some stand


def test_velocities_are_those_of_the_positions(scenes):
    for before, after in pairwise(scenes[:201]):
        same = before.people.ids == after.people.ids
        moved = (after.people.positions_m - before.people.positions_m)[same]
        np.testing.assert_allclose(moved, 0.05 * after.people.velocities_mps[same], atol=1e-9)


def test_people_keep_their_distance_and_pairs_stay_together(scenes):
    pairs = 2 * int(40 * SETTINGS.paired_share / 2)
    nearest, partners = [], []
    for scene in scenes[::5]:
        positions = scene.people.positions_m
        apart = np.linalg.norm(positions[:, None] - positions, axis=-1)
        np.fill_diagonal(apart, np.inf)
        first = np.arange(0, pairs, 2)
        partners.append(apart[first, first + 1])
        nearest.append(apart.min())
    partners = np.concatenate(partners)
    assert 0.5 < np.median(partners) < 0.9
    assert np.mean(partners < 1.2) > 0.98
    assert np.median(nearest) > 0.3


def test_about_as_many_as_asked_for_stay_in_view(scenes):
    near = [(np.linalg.norm(s.people.positions_m - s.vehicle.position_m, axis=1) < 30).sum() for s in scenes]
    assert np.mean(near) > 0.85 * 40
    assert min(near) > 0.6 * 40
    assert {len(scene.people.ids) for scene in scenes} == {40}


def test_who_comes_in_is_somebody_new_at_the_edge(scenes):
    known: set[int] = set(scenes[0].people.ids.tolist())
    gone: set[int] = set()
    for before, after in pairwise(scenes):
        ids = set(after.people.ids.tolist())
        assert len(ids) == 40
        gone |= set(before.people.ids.tolist()) - ids
        assert not ids & gone
        for new in ids - known:
            place = after.people.positions_m[after.people.ids == new][0]
            assert np.linalg.norm(place - after.vehicle.position_m) > 28
        known |= ids
    assert len(known) > 60


def test_the_vehicle_drives_and_slows_down_for_people(scenes):
    speeds = np.array([np.linalg.norm(scene.vehicle.velocity_mps) for scene in scenes])
    assert speeds.max() <= SETTINGS.cruise_mps + 1e-6
    assert np.linalg.norm(scenes[-1].vehicle.position_m - scenes[0].vehicle.position_m) > 60
    assert (speeds < 0.7 * SETTINGS.cruise_mps).any()
    assert np.abs(np.diff(speeds)).max() <= SETTINGS.braking_mps2 * 0.05 + 1e-9
    for before, after in pairwise(scenes):
        moved = (after.vehicle.position_m - before.vehicle.position_m) / 0.05
        np.testing.assert_allclose(moved, before.vehicle.velocity_mps, atol=0.05)
        assert abs(before.vehicle.yaw_rate_radps) < 0.5


def test_yaw_rate_is_the_change_of_yaw(scenes):
    yaws = np.array([scene.vehicle.yaw_rad for scene in scenes])
    rates = np.array([scene.vehicle.yaw_rate_radps for scene in scenes])
    np.testing.assert_allclose(np.diff(yaws) / 0.05, rates[:-1], atol=0.02)


def test_fixtures_stand_still_beside_the_lane(scenes):
    places: dict[int, tuple[float, float]] = {}
    for scene in scenes[::20]:
        for id, place in zip(scene.fixtures.ids.tolist(), scene.fixtures.positions_m.tolist(), strict=True):
            assert places.setdefault(id, tuple(place)) == tuple(place)
        gap = np.linalg.norm(scene.fixtures.positions_m - scene.vehicle.position_m, axis=1).min()
        assert gap > 2.0
    assert len(places) > 15


def test_the_seed_decides():
    def first(seed):
        return [
            scene.people.positions_m for _, scene in zip(range(30), crowd_motion(12, 2, seed).scenes(), strict=False)
        ]

    np.testing.assert_array_equal(first(1), first(1))
    assert not np.array_equal(first(1), first(2))


@pytest.mark.parametrize("pedestrians", [0, 1, 2])
def test_small_crowds(pedestrians):
    scenes = list(crowd_motion(pedestrians, 3.0, seed=0).scenes())
    assert {len(scene.people.ids) for scene in scenes} == {pedestrians}
    assert np.isfinite(scenes[-1].people.positions_m).all()


@pytest.mark.parametrize(
    ("pedestrians", "duration_s", "problem"), [(-1, 5.0, "0 or more"), (3, 0.0, "positive"), (3, np.nan, "positive")]
)
def test_bad_arguments(pedestrians, duration_s, problem):
    with pytest.raises(SimulationError, match=problem):
        crowd_motion(pedestrians, duration_s, 0)
