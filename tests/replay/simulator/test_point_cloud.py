import json
import math

import numpy as np
import pytest
from mcap.reader import make_reader

from replay import foxglove
from replay.simulator import simulate
from replay.simulator.lidar_model import SimulatedLidar
from replay.simulator.point_cloud import SimulatedPoints
from replay.simulator.rig import LIDAR_FRAME, campus_rig, planar_pose
from replay.simulator.sensor_model import SensorModelV1
from replay.simulator.visibility import ObjectTable
from schemas import codec
from schemas.messages import GroundTruthFrame, LidarClusters, PointCloud, VehiclePose
from tracking.geometry import apply
from tracking.segmentation import SegmentationParams, segment

EXACT = SensorModelV1(
    clutter_per_scan=0.0,
    point_noise_sd_m=0.0,
    point_noise_sd_per_m=0.0,
    foliage_noise_sd_m=0.0,
    sway_sd_m=0.0,
    lidar_pitch_jitter_rad=0.0,
    person_height_sd_m=0.0,
    p_return=1.0,
)
MOUNT = campus_rig().vehicle_from_lidar
POINTS, CLUSTERS = "/velodyne/front/points", "/velodyne/front/clusters"


def clouds(scene_at, count=1, model=EXACT, seed=0):
    """Point clouds 0.5 s apart."""
    lidar, table = SimulatedPoints(MOUNT, model, np.random.default_rng(seed)), ObjectTable(model, 0)
    scenes = [scene_at(0.5 * k) for k in range(count)]
    return [lidar.scan(scene, table.objects(scene), 7 + k) for k, scene in enumerate(scenes)]


def above_ground(cloud, position=(0.0, 0.0), yaw=0.0):
    """The points (N, 3) of a cloud in the map that are not the road's."""
    points = apply(planar_pose(np.array(position), yaw) @ MOUNT, cloud.points_m)
    return points[points[:, 2] > 0.01]


def read(path):
    with path.open("rb") as stream:
        messages = make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in messages]


def metadata(path):
    with path.open("rb") as stream:
        (record,) = make_reader(stream).iter_metadata()
    return json.loads(record.metadata["settings"])


@pytest.fixture(scope="module")
def with_points(tmp_path_factory):
    """A 3 s drive through a crowd of 20, with points."""
    path = tmp_path_factory.mktemp("points") / "drive.mcap"
    simulate(path, clip=None, vehicle=None, pedestrians=20, duration_s=3.0, seed=5, points=True)
    return path


def test_beams_are_those_of_a_tilted_vlp_16(make_scene):
    (cloud,) = clouds(lambda t: make_scene(time_s=t))
    assert (cloud.stamp_ns, cloud.frame_id, cloud.points_m.dtype) == (7, LIDAR_FRAME, np.float32)
    x, y, z = cloud.points_m.T.astype(float)
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    rings = np.round((elevation + 15) / 2)
    np.testing.assert_allclose(elevation, -15 + 2 * rings, atol=1e-4)
    columns = np.degrees(np.arctan2(y, x)) / 0.2
    phase = columns[0] - math.floor(columns[0])
    np.testing.assert_allclose((columns - phase + 0.5) % 1, 0.5, atol=1e-3)
    assert set(rings[x > 0].astype(int)) == set(range(11))  # -22 to -2 degrees ahead, and to the sides
    assert set(rings[(x < 0) & (abs(y) < 0.1 * -x)].astype(int)) == set(range(4))  # -8 to -2 behind


def test_the_road_is_flat_and_reaches_as_far_as_beams_do(make_scene):
    (cloud,) = clouds(lambda t: make_scene(time_s=t))
    points = apply(MOUNT, cloud.points_m)
    np.testing.assert_allclose(points[:, 2], 0.0, atol=1e-4)
    assert np.linalg.norm(cloud.points_m, axis=1).max() < EXACT.lidar_range_m
    nearest = np.linalg.norm(points[:, :2] - MOUNT[:2, 3], axis=1).min()
    assert nearest == pytest.approx(1.37 / math.tan(math.radians(22)), rel=0.01)


def test_a_person_is_hit_on_the_near_side_as_deep_as_the_clusters_are_pulled(make_scene):
    person = np.array([8.0, 6.0])
    points = above_ground(clouds(lambda t: make_scene([person], time_s=t))[0])
    sight = (person - (1.2, 0)) / np.linalg.norm(person - (1.2, 0))
    along, across = (points[:, :2] - person) @ sight, (points[:, :2] - person) @ (-sight[1], sight[0])
    assert along.mean() == pytest.approx(-0.12, abs=0.01)
    assert along.max() < 0.01
    assert across.min() == pytest.approx(-0.25, abs=0.04)
    assert across.max() == pytest.approx(0.25, abs=0.04)
    assert points[:, 2].max() <= 1.75


def test_as_many_points_as_the_clusters_count(make_scene):
    """On average, over ranges and bearings: what the clusters say fell on people, but for what is taken for ground."""
    model = SensorModelV1(clutter_per_scan=0.0)
    for place in ([9, 0], [-12, 5], [3, 20]):
        table = ObjectTable(model, 0)
        drawn = SimulatedLidar(MOUNT, model, np.random.default_rng(1))
        scene = make_scene([place])
        expected = np.mean([drawn.scan(scene, table.objects(scene), 1).person_points[0] for _ in range(40)])
        found = clouds(lambda t, place=place: make_scene([place], time_s=t), 40, model)
        near = [np.linalg.norm(apply(MOUNT, c.points_m)[:, :2] - place, axis=1) < 0.6 for c in found]
        high = [apply(MOUNT, c.points_m)[:, 2] > model.ground_cut_m for c in found]
        assert np.mean([(a & b).sum() for a, b in zip(near, high, strict=True)]) == pytest.approx(expected, rel=0.1)


def test_who_stands_behind_somebody_is_hidden_and_so_is_the_road(make_scene):
    road, shadow = (
        apply(MOUNT, clouds(lambda t, people=people: make_scene(people, time_s=t))[0].points_m)
        for people in ([], [[8, 0], [20, 0]])
    )
    behind = [p[(p[:, 0] > 9) & (p[:, 0] < 25) & (abs(p[:, 1]) < 0.2)] for p in (road, shadow)]
    assert len(behind[0]) > 5
    assert len(behind[1]) == 0


def test_low_things_are_seen_from_above_and_over(make_scene):
    """A bush of 0.95 m, 6 m ahead: its top is hit, too, and so is a person behind it, above."""
    bush = [[7.2, 0, 0.7, 0.95]]
    points = above_ground(clouds(lambda t: make_scene([[10.2, 0]], fixtures=bush, time_s=t))[0])
    on_bush = points[points[:, 0] < 9]
    np.testing.assert_allclose(on_bush[:, 2].max(), 0.95, atol=1e-3)
    person = points[points[:, 0] > 9.5]
    assert len(person) > 20
    assert person[:, 2].min() > 0.5


def test_a_turned_vehicle_sees_the_same_world(make_scene):
    place, yaw, position = np.array([4.0, -7.0]), 2.3, (1.0, 1.0)
    (cloud,) = clouds(lambda t: make_scene([place], time_s=t, position=position, yaw=yaw))
    points = above_ground(cloud, position, yaw)
    assert len(points) > 60
    assert np.linalg.norm(points[:, :2] - place, axis=1).max() < 0.26


def test_what_lies_straight_behind_the_sensor_is_whole(make_scene):
    """Where bearings jump from pi to -pi."""
    (cloud,) = clouds(lambda t: make_scene([[-6, 0]], time_s=t))
    points = above_ground(cloud)
    columns = np.unique(np.round(np.arctan2(points[:, 1], points[:, 0] - 1.2) % (2 * math.pi), 4))
    assert points[:, 1].min() == pytest.approx(-0.25, abs=0.03)
    assert points[:, 1].max() == pytest.approx(0.25, abs=0.03)
    assert np.diff(columns).max() < 0.005


def test_noise_and_drop_outs_are_the_models(make_scene):
    model = SensorModelV1(clutter_per_scan=0.0, lidar_pitch_jitter_rad=0.0)
    (exact,) = clouds(lambda t: make_scene(time_s=t))
    (noisy,) = clouds(lambda t: make_scene(time_s=t), model=model)
    near = [np.linalg.norm(c.points_m, axis=1) < 20 for c in (exact, noisy)]
    assert near[1].sum() / near[0].sum() == pytest.approx(0.85, abs=0.02)
    points = noisy.points_m[near[1]].astype(float)
    ranges = np.linalg.norm(points, axis=1)
    down = (points / ranges[:, None]) @ MOUNT[2, :3]
    errors = ranges - 1.37 / -down
    assert errors.std() == pytest.approx(0.06 + 0.002 * ranges.mean(), rel=0.1)
    assert abs(errors.mean()) < 0.005


def test_clutter_is_of_one_scan_and_as_frequent_as_the_clusters(make_scene):
    model = SensorModelV1(point_noise_sd_m=0.0, point_noise_sd_per_m=0.0, lidar_pitch_jitter_rad=0.0)
    found = clouds(lambda t: make_scene(time_s=t), 30, model)
    counts = [len(segment(cloud, SegmentationParams()).points) for cloud in found]
    assert 0.5 < np.mean(counts) <= model.clutter_per_scan + 0.5
    assert len(set(counts)) > 2


def test_the_same_seed_gives_the_same_points(make_scene):
    people = [[8, 2], [5, -1]]
    one, two, other = (
        clouds(lambda t: make_scene(people, time_s=t), 2, SensorModelV1(), seed)[1].points_m for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, two)
    assert one.shape != other.shape or (one != other).any()


def test_points_change_no_other_message_of_a_drive(tmp_path, with_points):
    without = tmp_path / "without.mcap"
    summary = simulate(without, clip=None, vehicle=None, pedestrians=20, duration_s=3.0, seed=5)
    assert POINTS not in summary.messages
    assert [message for message in read(with_points) if message[0] != POINTS] == read(without)
    assert metadata(without) == {"duration_s": 3.0, "pedestrians": 20, "seed": 5}
    assert metadata(with_points) == {**metadata(without), "points": True}


def test_every_scan_has_its_points_in_the_log_when_its_clusters_are(with_points):
    messages = read(with_points)
    points = [(time, foxglove.decode("foxglove.PointCloud", data)) for topic, time, data in messages if topic == POINTS]
    scans = [(time, codec.decode(LidarClusters, data)) for topic, time, data in messages if topic == CLUSTERS]
    assert len(points) == 30
    for (points_time, cloud), (scan_time, scan) in zip(points, scans, strict=True):
        assert isinstance(cloud, PointCloud)
        assert (points_time, cloud.stamp_ns, cloud.frame_id) == (scan_time, scan.stamp_ns, scan.frame_id)
        assert 5_000 < len(cloud.points_m) < 28_800


def test_segmented_points_find_the_people_of_the_ground_truth(with_points):
    messages = read(with_points)
    truths = {
        truth.stamp_ns: truth
        for topic, _, data in messages
        if topic == "/simulation/ground_truth"
        for truth in [codec.decode(GroundTruthFrame, data)]
    }
    poses = [codec.decode(VehiclePose, data) for topic, _, data in messages if "odometry" in topic]
    found = []
    for cloud in (foxglove.decode("foxglove.PointCloud", data) for topic, _, data in messages if topic == POINTS):
        pose = min(poses, key=lambda pose, stamp=cloud.stamp_ns: abs(pose.stamp_ns - stamp))
        yaw = 2 * math.atan2(pose.quaternion_xyzw[2], pose.quaternion_xyzw[3])
        clusters = segment(cloud, SegmentationParams()).centroids_m
        places = apply(planar_pose(pose.position_m[:2], yaw) @ MOUNT, clusters)[:, :2]
        truth = truths[cloud.stamp_ns]
        for person in truth.positions_m[truth.lidar_points >= 15]:
            found.append(np.linalg.norm(places - person, axis=1).min() < 0.4)
    assert len(found) > 150
    assert np.mean(found) > 0.93
