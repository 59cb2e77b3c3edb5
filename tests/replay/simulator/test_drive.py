import json

import numpy as np
import pytest
from mcap.reader import make_reader

from replay import foxglove
from replay.simulator import SimulationError, drive, simulate
from replay.simulator.clip_motion import clip_motion
from replay.simulator.sensor_model import SensorModelV1
from schemas import codec
from schemas.messages import CameraDetections, GroundTruthFrame, LidarClusters, VehiclePose
from schemas.topics import CAMERAS, INPUTS
from tracking.camera import CameraModel
from tracking.geometry import apply, inverse, transform_matrix

START_NS = 1_583_114_400_000_000_000


def read(path):
    """All messages of a drive in file order, as (topic, log time, decoded), every CRC checked."""
    messages = []
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False):
            if schema.name in codec.MESSAGE_TYPES:
                decoded = codec.decode(codec.MESSAGE_TYPES[schema.name], message.data)
            else:
                decoded = foxglove.decode(schema.name, message.data)
            messages.append((channel.topic, message.log_time, decoded))
    return messages


def of(messages, topic):
    return [(log_time, decoded) for found, log_time, decoded in messages if found == topic]


def crowd(path, **changes):
    arguments = {"clip": None, "vehicle": None, "pedestrians": 8, "duration_s": 1.5, "seed": 1}
    return simulate(path, **{**arguments, **changes})


def test_file_order_is_log_time_order_and_topics_are_the_contracts(drive):
    messages = read(drive)
    log_times = [log_time for _, log_time, _ in messages]
    assert log_times == sorted(log_times)
    expected = {topic.name for topic in INPUTS if not topic.name.endswith(("/image", "/points"))}
    assert {topic for topic, _, _ in messages} == expected


def test_rates(drive):
    messages = read(drive)
    assert len(of(messages, "/velodyne/front/clusters")) == 60
    assert len(of(messages, "/simulation/ground_truth")) == 60
    assert len(of(messages, "/vn100/odometry")) == 600
    assert len(of(messages, "/tf")) == 200
    assert len(of(messages, "/tf_static")) == 1
    for camera in CAMERAS:
        assert 170 < len(of(messages, f"/gmsl/{camera}/detections")) <= 180
        assert len(of(messages, f"/gmsl/{camera}/camera_info")) == 7
    assert messages[0][1] == START_NS
    assert messages[0][0] == "/tf_static"


@pytest.mark.parametrize(
    ("topic", "low_ms", "high_ms"),
    [("/gmsl/A2/detections", 40, 80), ("/velodyne/front/clusters", 60, 110), ("/vn100/odometry", 4, 7)],
)
def test_stamps_rise_and_precede_log_times_by_the_sensors_delay(drive, topic, low_ms, high_ms):
    messages = of(read(drive), topic)
    delays_ms = np.array([log_time - message.stamp_ns for log_time, message in messages]) / 1e6
    assert low_ms <= delays_ms.min() <= delays_ms.max() <= high_ms
    assert delays_ms.std() > 0.3
    stamps = np.sort([message.stamp_ns for _, message in messages])
    assert len(set(stamps.tolist())) == len(stamps)
    gaps_ms = np.diff(stamps) / 1e6
    assert np.median(np.abs(gaps_ms - np.median(gaps_ms))) > 0.05  # jitter
    assert stamps[0] > START_NS


def test_sensors_are_not_in_step(drive):
    messages = read(drive)
    firsts = [min(m.stamp_ns for _, m in of(messages, f"/gmsl/{camera}/detections")) for camera in CAMERAS]
    assert np.diff(np.sort(firsts)).min() > 1e6


def test_ground_truth_goes_with_every_scan_and_is_logged_before_it(drive):
    messages = read(drive)
    truths = {truth.stamp_ns: (log_time, truth) for log_time, truth in of(messages, "/simulation/ground_truth")}
    scans = of(messages, "/velodyne/front/clusters")
    assert set(truths) == {scan.stamp_ns for _, scan in scans}
    for log_time, scan in scans:
        assert scan.stamp_ns < truths[scan.stamp_ns][0] < log_time
    points = np.concatenate([truth.lidar_points for _, truth in truths.values()])
    assert (points == 0).any()
    assert (points > 0).mean() > 0.5
    assert {len(truth.ids) for _, truth in truths.values()} <= set(range(22, 26))


def test_clusters_and_boxes_lie_on_the_people(drive):
    """Read back as a consumer would: tf_static, odometry, calibration; most people seen have a cluster and a box."""
    messages = read(drive)
    (static,) = of(messages, "/tf_static")
    mounts = {t.child_frame_id: transform_matrix(t.translation_m, t.quaternion_xyzw) for t in static[1]}
    poses = [pose for _, pose in of(messages, "/vn100/odometry")]
    stamps = np.array([pose.stamp_ns for pose in poses])
    cameras = []
    for name in CAMERAS:
        calibration = of(messages, f"/gmsl/{name}/camera_info")[0][1]
        images = [image for _, image in of(messages, f"/gmsl/{name}/detections")]
        cameras.append((CameraModel.from_calibration(calibration), images))
    scans = {scan.stamp_ns: scan for _, scan in of(messages, "/velodyne/front/clusters")}

    def map_from_vehicle(stamp_ns):
        pose = poses[int(np.argmin(np.abs(stamps - stamp_ns)))]
        return transform_matrix(pose.position_m, pose.quaternion_xyzw)

    clustered, boxed = [], []
    for _, truth in of(messages, "/simulation/ground_truth"):
        scan = scans[truth.stamp_ns]
        clusters = apply(map_from_vehicle(truth.stamp_ns) @ mounts[scan.frame_id], scan.centroids_m)[:, :2]
        seen = truth.lidar_points >= 20
        places, velocities = truth.positions_m[seen], truth.velocities_mps[seen]
        clustered += [np.linalg.norm(clusters - place, axis=1).min() < 0.4 for place in places]
        for camera, images in cameras:
            image = min(images, key=lambda image, stamp=truth.stamp_ns: abs(image.stamp_ns - stamp))
            then = places + velocities * (image.stamp_ns - truth.stamp_ns) / 1e9
            camera_from_map = inverse(map_from_vehicle(image.stamp_ns) @ mounts[image.frame_id])
            chests = np.column_stack([then, np.full(len(then), 0.9)])
            pixels, valid = camera.project(apply(camera_from_map, chests))
            x_min, y_min, x_max, y_max = image.boxes_px.T
            for u, v in pixels[valid]:
                if 100 < u < 1820 and 0 < v < 1208:
                    boxed.append(((x_min < u) & (u < x_max) & (y_min < v) & (v < y_max)).any())
    assert len(clustered) > 200
    assert np.mean(clustered) > 0.93
    assert len(boxed) > 50
    assert np.mean(boxed) > 0.8


def test_tf_agrees_with_odometry(drive):
    messages = read(drive)
    poses = {pose.stamp_ns: pose for _, pose in of(messages, "/vn100/odometry")}
    for _, (transform,) in of(messages, "/tf"):
        pose = poses[transform.stamp_ns]
        np.testing.assert_array_equal(transform.translation_m, pose.position_m)
        np.testing.assert_array_equal(transform.quaternion_xyzw, pose.quaternion_xyzw)
        assert (transform.parent_frame_id, transform.child_frame_id) == ("odom", "base_link")


def test_metadata_says_what_the_drive_was_made_from(drive):
    with drive.open("rb") as stream:
        reader = make_reader(stream)
        (record,) = list(reader.iter_metadata())
        header = reader.get_header()
    assert record.name == "pcgan.simulation"
    assert record.metadata["motion"] == "crowd"
    assert record.metadata["seed"] == "3"
    assert record.metadata["sensor_model_checksum"] == SensorModelV1().checksum()
    assert json.loads(record.metadata["settings"]) == {"duration_s": 6.0, "pedestrians": 25, "seed": 3}
    assert (header.profile, header.library) == ("", "pcgan simulate")


def test_the_same_arguments_give_the_same_bytes(tmp_path):
    one, two, other = tmp_path / "one.mcap", tmp_path / "two.mcap", tmp_path / "other.mcap"
    crowd(one)
    crowd(two)
    crowd(other, seed=2)
    assert one.read_bytes() == two.read_bytes()
    assert one.read_bytes() != other.read_bytes()


def test_a_shorter_drive_begins_like_a_longer_one(tmp_path):
    crowd(tmp_path / "short.mcap", duration_s=1.0)
    crowd(tmp_path / "long.mcap", duration_s=2.0)
    short, long = read(tmp_path / "short.mcap"), read(tmp_path / "long.mcap")
    for topic in ("/velodyne/front/clusters", "/vn100/odometry", "/simulation/ground_truth"):
        for (_, a), (_, b) in zip(of(short, topic)[:8], of(long, topic)[:8], strict=True):
            assert codec.encode(a) == codec.encode(b)


def test_summary_counts_what_was_written(tmp_path):
    done = []
    summary = crowd(tmp_path / "drive.mcap", duration_s=3.0, progress=done.append)
    messages = read(tmp_path / "drive.mcap")
    assert sum(summary.messages.values()) == len(messages)
    assert summary.scans == len(of(messages, "/velodyne/front/clusters"))
    truths = [truth for _, truth in of(messages, "/simulation/ground_truth")]
    assert summary.pedestrians == len({id for truth in truths for id in truth.ids.tolist()})
    assert summary.duration_s == 3.0
    assert done == sorted(done)
    assert done[-1] == 1.0
    assert all(0 <= fraction <= 1 for fraction in done)


@pytest.mark.parametrize("pedestrians", [0, 1])
def test_empty_roads_make_valid_drives(tmp_path, pedestrians):
    crowd(tmp_path / "drive.mcap", pedestrians=pedestrians)
    types = {type(decoded) for _, _, decoded in read(tmp_path / "drive.mcap")}
    assert {CameraDetections, LidarClusters, VehiclePose, GroundTruthFrame} <= types


def test_nothing_is_left_behind_when_writing_fails(tmp_path):
    class Stopped(Exception):
        pass

    def stop(fraction):
        raise Stopped(fraction)

    with pytest.raises(Stopped):
        crowd(tmp_path / "drive.mcap", duration_s=3.0, progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"pedestrians": -1}, "0 or more pedestrians, got -1"),
        ({"duration_s": 0.0}, "positive duration, got 0.0 s"),
        ({"duration_s": float("inf")}, "positive duration, got inf s"),
        ({"seed": -3}, "seed must be 0 or more, got -3"),
        ({"vehicle": 2}, "name the clip, too"),
        ({"clip": "kitti/1"}, "no data set 'kitti'"),
    ],
)
def test_bad_arguments_say_what_is_wrong(tmp_path, changes, problem):
    with pytest.raises(SimulationError, match=problem):
        crowd(tmp_path / "drive.mcap", **changes)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(SimulationError, match=r"there is no folder .*nowhere"):
        crowd(tmp_path / "nowhere" / "drive.mcap")


@pytest.mark.usefixtures("public_clips")
def test_a_clip_makes_a_drive_with_its_own_people(tmp_path):
    summary = simulate(
        tmp_path / "clip.mcap", clip="dut/roundabout_09", vehicle=None, pedestrians=99, duration_s=60.0, seed=0
    )
    motion = clip_motion("dut/roundabout_09")
    assert summary.duration_s == motion.duration_s
    assert summary.motion == "dut/roundabout_09"
    truths = [truth for _, truth in of(read(tmp_path / "clip.mcap"), "/simulation/ground_truth")]
    assert len(truths) == pytest.approx(motion.duration_s * 10, abs=1)
    assert 0 < max(len(truth.ids) for truth in truths) <= 15


def test_sensors_that_see_perfectly_can_be_had_by_name(tmp_path, make_scene, make_motion):
    """The model is an argument of drive.simulate, for tests of trackers; the command always uses version 1."""
    motion = make_motion([make_scene([[8, 0]], time_s=0.5 * k) for k in range(4)])
    perfect = SensorModelV1(clutter_per_scan=0, p_cluster=1.0, sway_sd_m=0, point_noise_sd_m=0, point_noise_sd_per_m=0)
    drive.simulate(motion, tmp_path / "drive.mcap", 0, model=perfect)
    for _, scan in of(read(tmp_path / "drive.mcap"), "/velodyne/front/clusters"):
        assert len(scan.points) == 1
