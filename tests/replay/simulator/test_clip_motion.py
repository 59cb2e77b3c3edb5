import numpy as np
import pytest

from pcgan.clips import Clip, Trajectory, VehicleTrajectory, clip_names, load_clip
from replay.simulator.clip_motion import clip_motion, motion_of, smooth_velocities, steady_yaws
from replay.simulator.motion import MotionSampler, SimulationError

RATE_HZ = 25.0


def walker(id, first, count, start=(0.0, 0.0), velocity=(1.0, 0.0)):
    frames = np.arange(first, first + count)
    positions = np.array(start) + (frames - first)[:, None] / RATE_HZ * np.array(velocity)
    return Trajectory(id, frames, positions, np.tile(velocity, (count, 1)))


def car(id, first, count, speed, *, yaw=0.5, start=(10.0, 0.0)):
    frames = np.arange(first, first + count)
    speeds = np.broadcast_to(speed, count).astype(float)
    along = np.concatenate([[0.0], np.cumsum(speeds[:-1])]) / RATE_HZ
    positions = np.array(start) + along[:, None] * (np.cos(yaw), np.sin(yaw))
    return VehicleTrajectory(id, frames, positions, np.full(count, yaw), speeds)


def made(vehicles, pedestrians=(), name="dut/made"):
    return Clip(name, RATE_HZ, tuple(pedestrians), tuple(vehicles))


def test_the_drive_spans_the_vehicles_presence():
    clip = made([car(4, 11, 101, 3.0)], [walker(1, 1, 300), walker(2, 61, 20), walker(3, 200, 20)])
    motion = motion_of(clip)
    assert motion.duration_s == pytest.approx(4.0)
    scenes = list(motion.scenes())
    assert len(scenes) == 101
    assert {len(scene.people.ids) for scene in scenes} == {1, 2}
    assert scenes[50].people.ids.tolist() == [1, 2]
    np.testing.assert_allclose(scenes[50].people.positions_m[0], [60 / RATE_HZ, 0])  # frame 61, 60 after the first
    sampled = MotionSampler(motion).at(2.01)
    np.testing.assert_allclose(sampled.people.positions_m[0, 0], 10 / RATE_HZ + 2.01)
    assert sampled.vehicle.position_m == pytest.approx(
        clip.vehicles[0].positions_m[0] + 2.01 * 3 * np.array([np.cos(0.5), np.sin(0.5)])
    )


def test_the_moving_vehicle_records_even_if_a_parked_one_stays_longer():
    motion = motion_of(
        made([car(0, 1, 400, 0.0), car(1, 50, 100, 2.0, start=(0, 5)), car(2, 50, 60, 4.0, start=(0, 9))])
    )
    scene = next(motion.scenes())
    np.testing.assert_allclose(scene.vehicle.position_m, [0, 5])
    assert scene.others.ids.tolist() == [0, 2]
    np.testing.assert_allclose(scene.others.sizes_m[0], [4.5, 1.8, 1.5])


def test_a_vehicle_can_be_chosen_and_a_wrong_one_lists_those_there_are():
    clip = made([car(0, 1, 400, 0.0), car(7, 50, 100, 2.0)])
    assert motion_of(clip, 0).duration_s == pytest.approx(399 / RATE_HZ)
    with pytest.raises(SimulationError, match=r"no vehicle 3; its vehicles are \[0, 7\]"):
        motion_of(clip, 3)
    with pytest.raises(SimulationError, match="no vehicle to drive"):
        motion_of(made([]))
    with pytest.raises(SimulationError, match="1 frame"):
        motion_of(made([car(0, 1, 1, 2.0)]))


def test_heading_is_held_while_the_vehicle_stands():
    speeds = np.concatenate([np.full(50, 2.0), np.zeros(60), np.full(50, 2.0)])
    vehicle = car(0, 1, 160, speeds, yaw=3.1)
    wild = vehicle.yaw_rad.copy()
    wild[65:95] = np.linspace(-2, 2, 30)  # nonsense while standing
    wild[110:] = -3.1  # across +-pi
    vehicle = VehicleTrajectory(0, vehicle.frames, vehicle.positions_m, wild, vehicle.speed_mps)
    yaws = steady_yaws(vehicle, RATE_HZ)
    assert np.abs(np.diff(yaws)).max() < 0.1  # from 3.1 to -3.1 the short way
    assert yaws[0] % (2 * np.pi) == pytest.approx(3.1)
    assert yaws[-1] % (2 * np.pi) == pytest.approx(2 * np.pi - 3.1)
    parked = car(0, 1, 50, 0.0, yaw=1.0)
    np.testing.assert_allclose(steady_yaws(parked, RATE_HZ), 1.0)


def test_velocities_of_a_steady_drive_are_exact():
    vehicle = car(0, 1, 80, 3.0, yaw=1.2)
    np.testing.assert_allclose(
        smooth_velocities(vehicle.positions_m, RATE_HZ), np.tile([3 * np.cos(1.2), 3 * np.sin(1.2)], (80, 1))
    )
    assert smooth_velocities(np.zeros((1, 2)), RATE_HZ).tolist() == [[0, 0]]


def test_fixtures_keep_clear_of_everybodys_path():
    clip = made([car(0, 1, 200, 3.0)], [walker(k, 1, 300, start=(0, k), velocity=(1.0, 0.1 * k)) for k in range(20)])
    fixtures = next(motion_of(clip, seed=4).scenes()).fixtures
    assert len(fixtures.ids) > 10
    people = np.concatenate([person.positions_m for person in clip.pedestrians])
    gaps = np.linalg.norm(people[:, None] - fixtures.positions_m, axis=-1) - fixtures.radii_m
    assert gaps.min() > 0.8
    again = next(motion_of(clip, seed=4).scenes()).fixtures
    np.testing.assert_array_equal(fixtures.positions_m, again.positions_m)


def test_citr_carts_are_smaller_and_centred_behind_the_reference_point():
    motion = motion_of(made([car(0, 1, 50, 2.0), car(1, 1, 30, 2.0, yaw=0.0)], name="citr/made"))
    others = next(motion.scenes()).others
    np.testing.assert_allclose(others.sizes_m[0, :2], [2.2, 1.2])
    np.testing.assert_allclose(others.positions_m[0], [9.9, 0.0])


@pytest.mark.usefixtures("public_clips")
def test_unknown_clips_list_those_there_are():
    with pytest.raises(SimulationError, match=r"no clip 'dut/nowhere_01'; there are .*dut/roundabout_04"):
        clip_motion("dut/nowhere_01")
    with pytest.raises(SimulationError, match=r"no data set 'kitti'.*named like dut/roundabout_04"):
        clip_motion("kitti/7")


@pytest.mark.usefixtures("public_clips")
@pytest.mark.parametrize("name", ["dut/roundabout_04", "dut/intersection_04", "citr/vci_front/front_interaction_01"])
def test_real_vehicles_point_where_they_go(name):
    """y was flipped for positions and headings alike, or the two would disagree in sign."""
    motion = clip_motion(name)
    clip = load_clip(name)
    assert any(motion.duration_s == pytest.approx((len(v.frames) - 1) / clip.rate_hz) for v in clip.vehicles)
    scenes = list(motion.scenes())
    velocities = np.array([scene.vehicle.velocity_mps for scene in scenes])
    yaws = np.array([scene.vehicle.yaw_rad for scene in scenes])
    fast = np.linalg.norm(velocities, axis=1) > 1.0
    assert fast.any()
    apart = np.arctan2(velocities[:, 1], velocities[:, 0]) - yaws
    apart = np.abs((apart + np.pi) % (2 * np.pi) - np.pi)
    assert apart[fast].mean() < 0.15


@pytest.mark.usefixtures("public_clips")
def test_every_clip_with_a_vehicle_makes_a_motion():
    for name in clip_names("dut"):
        motion = clip_motion(name)
        first = next(motion.scenes())
        assert motion.duration_s > 1
        assert np.isfinite(first.vehicle.position_m).all()
