import numpy as np
import pytest

from replay.simulator.motion import MotionSampler, People, Scene, VehicleState


def scene(time_s, x, ids, yaw=0.0):
    ids = np.array(ids, np.int64)
    places = np.stack([ids + time_s, 2.0 * ids], axis=-1)
    return Scene(
        time_s,
        VehicleState(np.array([x, 0.0]), yaw, np.array([1.0, 0.0]), 0.0),
        People(ids, places, np.ones((len(ids), 2))),
    )


def test_between_two_scenes_everything_is_interpolated(make_motion):
    found = MotionSampler(make_motion([scene(0.0, 0.0, [1, 2]), scene(0.1, 1.0, [1, 2], yaw=0.2)])).at(0.025)
    assert found.vehicle.position_m[0] == pytest.approx(0.25)
    assert found.vehicle.yaw_rad == pytest.approx(0.05)
    np.testing.assert_allclose(found.people.positions_m, [[1.025, 2.0], [2.025, 4.0]])


def test_only_who_is_in_both_scenes_is_there_and_order_does_not_matter(make_motion):
    found = MotionSampler(make_motion([scene(0.0, 0.0, [3, 1, 7]), scene(0.1, 1.0, [7, 9, 3])])).at(0.05)
    np.testing.assert_array_equal(found.people.ids, [3, 7])
    np.testing.assert_allclose(found.people.positions_m, [[3.05, 6.0], [7.05, 14.0]])


def test_vehicle_alone_is_the_vehicle_of_the_scene(make_motion):
    motion = make_motion([scene(0.0, 0.0, []), scene(0.1, 1.0, []), scene(0.2, 4.0, [])])
    for time_s in (0.0, 0.07, 0.1, 0.15, 0.2):
        alone, whole = MotionSampler(motion).vehicle_at(time_s), MotionSampler(motion).at(time_s).vehicle
        np.testing.assert_array_equal(alone.position_m, whole.position_m)


def test_times_outside_what_is_at_hand_are_refused(make_motion):
    sampler = MotionSampler(make_motion([scene(0.1 * k, 0.0, []) for k in range(4)]))
    sampler.at(0.25)
    with pytest.raises(ValueError, match=r"has moved on to 0.200 s, asked for 0.150 s"):
        sampler.at(0.15)
    with pytest.raises(ValueError, match=r"ends at 0.300 s, asked for 0.400 s"):
        sampler.at(0.4)
