import math

import numpy as np
import pytest

from replay.simulator.lidar_model import SimulatedLidar
from replay.simulator.rig import campus_rig, planar_pose
from replay.simulator.sensor_model import SensorModelV1
from replay.simulator.visibility import ObjectTable
from tracking.geometry import apply

MODEL = SensorModelV1()
NO_CLUTTER = SensorModelV1(clutter_per_scan=0.0)


def scans(scene_at, count=200, model=NO_CLUTTER, seed=0):
    """Scans 0.5 s apart, so that misses and gait are nearly independent."""
    lidar = SimulatedLidar(campus_rig().vehicle_from_lidar, model, np.random.default_rng(seed))
    table = ObjectTable(model, 0)
    found = []
    for k in range(count):
        scene = scene_at(0.5 * k)
        found.append(lidar.scan(scene, table.objects(scene), 1 + k))
    return found


def in_map(scan, position=(0.0, 0.0), yaw=0.0):
    return apply(planar_pose(np.array(position), yaw) @ campus_rig().vehicle_from_lidar, scan.clusters.centroids_m)


def test_points_follow_geometry_and_fall_with_range(make_scene):
    """10 m ahead: 0.5 m is 14 columns of 0.2 degrees, 0.15 to 1.75 m about 4.6 rings of 2 degrees, 0.85 come back."""
    means = []
    for distance in (5, 10, 20, 30, 40):
        points = [s.person_points[0] for s in scans(lambda t, d=distance: make_scene([[1.2 + d, 0]], time_s=t), 60)]
        means.append(np.mean(points))
    assert means[1] == pytest.approx(14.3 * 4.6 * 0.85, rel=0.15)
    assert means[1] / means[2] == pytest.approx(4.0, rel=0.3)  # the inverse square of the range
    assert means[0] > means[1] > means[2] > means[3] > means[4] > 0


def test_hidden_people_get_no_points(make_scene):
    for scan in scans(lambda t: make_scene([[20, 0], [8, 0]], time_s=t), 40):
        assert scan.person_points[0] == 0
        assert scan.person_points[1] > 0


def test_another_vehicle_hides_people_behind_it_but_not_in_front(make_scene):
    crossing = [[10, 0, math.pi / 2]]
    for scan in scans(lambda t: make_scene([[14, 0], [7, 0], [14, 6]], crossing, time_s=t), 20):
        assert scan.person_points[0] == 0
        assert (scan.person_points[1:] > 0).all()


def test_out_of_range_is_zero(make_scene):
    assert scans(lambda t: make_scene([[80, 0]], time_s=t), 1)[0].person_points.tolist() == [0]


def test_centroids_are_pulled_towards_the_sensor_and_scatter_by_centimetres(make_scene):
    person = np.array([8.0, 6.0])
    found = scans(lambda t: make_scene([person], time_s=t), 200)
    errors = np.concatenate([in_map(s)[:, :2] - person for s in found])
    sight = (person - (1.2, 0)) / np.linalg.norm(person - (1.2, 0))
    along, across = errors @ sight, errors @ (-sight[1], sight[0])
    assert along.mean() == pytest.approx(-0.12, abs=0.015)
    assert abs(across.mean()) < 0.02
    assert 0.03 < along.std() < 0.07
    assert 0.03 < across.std() < 0.08
    assert len(errors) > 0.95 * 200


def test_clusters_are_as_high_as_people(make_scene):
    heights = np.concatenate([in_map(s)[:, 2] for s in scans(lambda t: make_scene([[9, 2]], time_s=t), 100)])
    assert 0.6 < heights.mean() < 1.2
    sizes = np.concatenate([s.clusters.sizes_m for s in scans(lambda t: make_scene([[9, 2]], time_s=t), 100)])
    assert (sizes <= (0.8, 0.8, 2.0)).all()
    assert sizes[:, 2].mean() > 0.8


def test_a_turned_vehicle_sees_the_same_world(make_scene):
    person, yaw = np.array([4.0, -7.0]), 2.3
    found = scans(lambda t: make_scene([person], time_s=t, position=(1.0, 1.0), yaw=yaw), 100)
    errors = np.concatenate([in_map(s, (1.0, 1.0), yaw)[:, :2] - person for s in found])
    assert np.linalg.norm(errors, axis=1).mean() < 0.2


@pytest.mark.parametrize(("apart_m", "low", "high"), [(0.35, 0.0, 0.1), (0.9, 0.9, 1.0)])
def test_people_closer_than_45_cm_give_one_cluster(make_scene, apart_m, low, high):
    found = scans(lambda t: make_scene([[6, -apart_m / 2], [6, apart_m / 2]], time_s=t), 100)
    assert low <= np.mean([len(s.clusters.points) == 2 for s in found]) <= high
    merged = [s for s in found if len(s.clusters.points) == 1 and min(s.person_points) > 20]
    if apart_m < 0.45:
        assert np.mean([abs(in_map(s)[0, 1]) for s in merged]) < 0.12
        assert all(s.clusters.points[0] == s.person_points.sum() for s in merged[:5])


def test_few_points_seldom_make_a_cluster(make_scene):
    found = scans(lambda t: make_scene([[42, 0]], time_s=t), 300)
    points = np.array([s.person_points[0] for s in found])
    clustered = np.array([len(s.clusters.points) for s in found])
    assert clustered[points < MODEL.cluster_min_points].sum() == 0
    assert clustered[points >= MODEL.cluster_min_points].mean() > 0.3


def test_vehicles_make_big_clusters(make_scene):
    for scan in scans(lambda t: make_scene(others=[[10, 0, 1.5]], time_s=t), 10):
        assert len(scan.clusters.points) <= 1
        if len(scan.clusters.points):
            assert scan.clusters.sizes_m[0, 1] > 3.5
            assert scan.clusters.points[0] > 100


def test_clutter_comes_at_its_rate_and_fixtures_stay(make_scene):
    found = scans(lambda t: make_scene(fixtures=[[10, 5, 0.15, 4.0]], time_s=t), 300, MODEL)
    pole = np.mean([np.linalg.norm(in_map(s)[:, :2] - (10, 5), axis=1).min(initial=9) < 0.5 for s in found])
    assert pole > 0.95
    assert np.mean([len(s.clusters.points) for s in found]) == pytest.approx(pole + MODEL.clutter_per_scan, abs=0.3)


def test_an_empty_world_gives_an_empty_scan(make_scene):
    scan = scans(lambda t: make_scene(time_s=t), 1)[0]
    assert scan.clusters.centroids_m.shape == (0, 3)
    assert scan.clusters.sizes_m.shape == (0, 3)
    assert len(scan.clusters.points) == len(scan.person_points) == 0
