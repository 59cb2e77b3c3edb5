"""A replay as a library: frames in order, warm-up, what is refused on the way, and that nothing but the log decides."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from replay import LogError, PredictorChoice, PredictorError, Replay, ReplaySettings, foxglove, replay
from replay.roles import RoleChoices
from replay.simulator.sensor_suite import CLUSTERS_TOPIC, ODOMETRY_TOPIC, TF_STATIC_TOPIC
from schemas import codec
from schemas import pcgan_v1_pb2 as pb
from schemas.messages import LidarClusters

BOXES = "/gmsl/A0/detections"


def run(paths, model, settings=None, **options):
    """Replays in this process; returns frames and refusals."""
    paths = paths if isinstance(paths, list) else [paths]
    with Replay(paths, settings, PredictorChoice("inline", model), **options) as replaying:
        return list(replaying), replaying.refusals


def stamp_of(data):
    return codec.decode(LidarClusters, data).stamp_ns


# --- frames ----------------------------------------------------------------------------------------------------------


def test_every_scan_gives_a_frame_in_stamp_order(results, drive, mcap_content):
    scans = sorted(stamp_of(data) for topic, _, data in mcap_content(drive).messages if topic == CLUSTERS_TOPIC)
    stamps = [frame.tracks.stamp_ns for frame in results]
    assert stamps == sorted(stamps)
    assert len(set(stamps)) == len(stamps)
    assert stamps == scans
    assert [frame.tracks.sequence for frame in results] == list(range(len(results)))


def test_every_frame_is_answered_track_by_track(results):
    assert sum(len(frame.tracks.tracks) for frame in results) > 100
    for frame in results:
        assert frame.predictions.sequence == frame.tracks.sequence
        assert frame.predictions.stamp_ns == frame.tracks.stamp_ns
        assert [p.track_id for p in frame.predictions.predictions] == [t.id for t in frame.tracks.tracks]


def test_people_are_found_where_they_are(results):
    """After two seconds most of the people with a few LiDAR points have a track within half a metre."""
    near = total = 0
    for frame in results[20:]:
        tracks = np.array([track.state[:2] for track in frame.tracks.tracks]).reshape(-1, 2)
        for position, points in zip(frame.ground_truth.positions_m, frame.ground_truth.lidar_points, strict=True):
            if points >= 10:
                total += 1
                near += bool(len(tracks)) and np.linalg.norm(tracks - position, axis=1).min() < 0.5
    assert total > 50
    assert near / total > 0.8


def test_cameras_are_in_use(results):
    assert sum(len(frame.sensors.cameras) == 6 for frame in results) > 0.8 * len(results)


def test_replay_is_an_iterator_of_frames(short_drive, model, digest, monkeypatch):
    monkeypatch.setattr("pcgan.checkpoint.DEFAULT_CHECKPOINT", model)
    expected, _ = run(short_drive, model)
    assert digest(replay(short_drive)) == digest(expected)
    assert digest(replay(str(short_drive), window=2)) == digest(expected)
    assert digest(replay([short_drive], ReplaySettings(duration_s=1.0))) == digest(
        run(short_drive, model, ReplaySettings(duration_s=1.0))[0]
    )


def test_an_iterator_that_is_left_early_ends_cleanly(short_drive, model, monkeypatch):
    monkeypatch.setattr("pcgan.checkpoint.DEFAULT_CHECKPOINT", model)
    frames = replay(short_drive)
    next(frames)
    frames.close()


# --- nothing but the log decides -------------------------------------------------------------------------------------


def test_two_runs_agree(drive, model, results, digest):
    assert digest(run(drive, model)[0]) == digest(results)


@pytest.mark.parametrize("window", [1, 3])
def test_the_window_changes_nothing(drive, model, results, digest, window):
    assert digest(run(drive, model, window=window)[0]) == digest(results)


def test_the_rate_changes_nothing(short_drive, model, recorded, digest):
    assert digest(run(short_drive, model, rate=20.0)[0]) == digest(recorded.frames)


def test_the_rate_is_kept(short_drive, model, recorded):
    start = time.monotonic()
    run(short_drive, model, rate=10.0)
    first, last = recorded.frames[0].log_time_ns, recorded.frames[-1].log_time_ns
    assert time.monotonic() - start >= (last - first) * 1e-9 / 10


def test_two_replays_in_two_threads_do_not_mix(drive, short_drive, model, results, recorded, digest):
    found = {}

    def work(name, path):
        found[name] = digest(run(path, model)[0])

    threads = [threading.Thread(target=work, args=each) for each in (("long", drive), ("short", short_drive))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert found["long"] == digest(results)
    assert found["short"] == digest(recorded.frames)


def test_a_split_recording_is_one_log(drive, model, edit_log, results, digest):
    """Sensors in one file, poses in another; and the first and second half."""
    poses = edit_log(drive, lambda log: [m for m in log if m[0] == ODOMETRY_TOPIC], "poses.mcap")
    others = edit_log(drive, lambda log: [m for m in log if m[0] != ODOMETRY_TOPIC], "others.mcap")
    assert digest(run([poses, others], model)[0]) == digest(results)
    first = edit_log(drive, lambda log: log[: len(log) // 2], "first.mcap")
    second = edit_log(drive, lambda log: log[len(log) // 2 :], "second.mcap")
    assert digest(run([second, first], model)[0]) == digest(results)


def test_topics_under_other_names(short_drive, model, recorded, digest, edit_log):
    renamed = edit_log(short_drive, lambda log: log, topics={ODOMETRY_TOPIC: "/odom"})
    assert digest(run(renamed, model)[0]) == digest(recorded.frames)
    assert digest(run(renamed, model, ReplaySettings(roles=RoleChoices(pose="/odom")))[0]) == digest(recorded.frames)
    with pytest.raises(LogError, match="the log has no topic /odometry"):
        Replay([renamed], ReplaySettings(roles=RoleChoices(pose="/odometry")))


def test_without_odometry_the_transforms_say_where_the_vehicle_is(drive, model, edit_log, results):
    no_odometry = edit_log(drive, lambda log: [m for m in log if m[0] != ODOMETRY_TOPIC])
    frames, refusals = run(no_odometry, model)
    assert refusals.total <= 2  # scans before the second transform
    of_stamp = {frame.tracks.stamp_ns: frame for frame in results}
    assert len(frames) >= len(results) - 2
    for frame in frames:
        before = of_stamp[frame.tracks.stamp_ns]
        np.testing.assert_allclose(frame.sensors.map_from_vehicle, before.sensors.map_from_vehicle, atol=0.01)
    same = [len(f.tracks.tracks) == len(of_stamp[f.tracks.stamp_ns].tracks.tracks) for f in frames]
    assert np.mean(same) > 0.9


# --- a part of a log -------------------------------------------------------------------------------------------------


def test_start_warms_the_tracker_up(drive, model, results, mcap_content):
    """From second 3 on the tracks are those of the whole replay: what came before was tracked, unpublished."""
    frames, _ = run(drive, model, ReplaySettings(start_s=3.0, duration_s=1.5))
    start_ns = min(at for _, at, _ in mcap_content(drive).messages) + 3_000_000_000
    assert frames[0].tracks.sequence == 0
    assert frames[0].tracks.tracks
    assert start_ns <= frames[0].log_time_ns <= start_ns + 200_000_000
    assert len(frames) == pytest.approx(15, abs=1)
    whole = {frame.tracks.stamp_ns: frame for frame in results}
    for frame in frames[:-3]:  # the last ones are released by the end
        same = whole[frame.tracks.stamp_ns]
        assert [t.id for t in frame.tracks.tracks] == [t.id for t in same.tracks.tracks]
        for one, other in zip(frame.tracks.tracks, same.tracks.tracks, strict=True):
            np.testing.assert_array_equal(one.state, other.state)
            np.testing.assert_array_equal(one.history.states, other.history.states)
        np.testing.assert_array_equal(frame.tracks.vehicle_history.states, same.tracks.vehicle_history.states)


def test_duration_ends_it(drive, model, results):
    frames, _ = run(drive, model, ReplaySettings(duration_s=2.0))
    assert [f.tracks.stamp_ns for f in frames] == [f.tracks.stamp_ns for f in results[: len(frames)]]
    assert len(frames) == pytest.approx(20, abs=1)


def test_calibrations_and_mounts_that_occur_once_at_the_beginning_are_found(drive, model, edit_log):
    def once(log):
        seen = set()
        for topic, at_ns, data in log:
            if not topic.endswith("camera_info") or topic not in seen:
                seen.add(topic)
                yield topic, at_ns, data

    frames, refusals = run(edit_log(drive, once), model, ReplaySettings(start_s=5.0))
    assert refusals.total == 0
    assert len(frames[0].sensors.cameras) >= 5


def test_a_start_past_the_end_says_how_long_the_log_is(short_drive):
    with pytest.raises(LogError, match=r"nothing to replay from 60 s: the log lasts 3\.\d s"):
        Replay([short_drive], ReplaySettings(start_s=60.0))


# --- what is refused on the way --------------------------------------------------------------------------------------


def box_bytes(**changes):
    values = {"x_min": [1], "y_min": [2], "x_max": [3], "y_max": [4], "score": [0.5], "label": ["person"]}
    return pb.CameraDetections(**{"stamp_ns": 1, **values, **changes}).SerializeToString()


def cluster_bytes(stamp_ns=1, **changes):
    values = {name: [1.0] for name in ("x", "y", "z", "size_x", "size_y", "size_z")}
    return pb.LidarClusters(**{"stamp_ns": stamp_ns, **values, "points": [5], **changes}).SerializeToString()


NAN = float("nan")
EXTRA = {
    "undecodable": (BOXES, b"\xff\xff\xff", "not a pcgan.v1.CameraDetections"),
    "NaN": (CLUSTERS_TOPIC, cluster_bytes(x=[NAN]), "holds NaN or infinity"),
    "negative box": (BOXES, box_bytes(x_max=[0]), "box of negative size"),
    "negative cluster": (CLUSTERS_TOPIC, cluster_bytes(size_x=[-1]), "cluster of negative size"),
    "unequal lengths": (CLUSTERS_TOPIC, cluster_bytes(x=[1, 2]), "differ in length"),
    "no stamp": (CLUSTERS_TOPIC, cluster_bytes(stamp_ns=0), "has no stamp"),
    "absurd stamp": (CLUSTERS_TOPIC, cluster_bytes(stamp_ns=4 * 10**18), "absurd stamp"),
    "bad rotation": (ODOMETRY_TOPIC, pb.VehiclePose(stamp_ns=1, qw=3).SerializeToString(), "has length 3 instead of 1"),
    "absurd pose": (ODOMETRY_TOPIC, pb.VehiclePose(stamp_ns=1, qw=1).SerializeToString(), "absurd stamp"),
    "bad calibration": ("/gmsl/A0/camera_info", b"\xff\xff", "CameraCalibration"),
    "bad transform": (TF_STATIC_TOPIC, b"\xff\xff", "FrameTransforms"),
}


@pytest.mark.parametrize("case", EXTRA)
def test_a_damaged_extra_message_is_counted_and_changes_nothing(short_drive, model, recorded, digest, edit_log, case):
    topic, data, reason = EXTRA[case]

    def insert(log):
        middle = len(log) // 2
        return [*log[:middle], (topic, log[middle - 1][1], data), *log[middle:]]

    frames, refusals = run(edit_log(short_drive, insert), model)
    assert digest(frames) == digest(recorded.frames)
    (((found_topic, found_reason), count),) = refusals.counts.items()
    assert (found_topic, count) == (topic, 1)
    assert reason in found_reason
    assert topic in refusals.first[0]


def test_a_calibration_no_image_can_have_come_from_is_refused(short_drive, model, recorded, digest, edit_log, make):
    """Of the one at the very beginning, which is read ahead of the stream, as of any other."""
    bad = foxglove.encode(make.calibration(coefficients=3))

    def insert(log):
        first = next(i for i, (topic, _, _) in enumerate(log) if topic == "/gmsl/A0/camera_info")
        return [*log[:first], ("/gmsl/A0/camera_info", log[first][1], bad), *log[first:]]

    frames, refusals = run(edit_log(short_drive, insert), model)
    assert digest(frames) == digest(recorded.frames)
    assert refusals.counts == {("/gmsl/A0/camera_info", "unusable calibration"): 1}


def test_a_start_in_the_middle_refuses_nothing_of_a_healthy_log(drive, model):
    """The warm-up begins in mid-stream, with scans older than the first pose that is read."""
    for start_s in (4.2, 4.55, 5.0):
        _, refusals = run(drive, model, ReplaySettings(start_s=start_s, duration_s=0.3))
        assert refusals.total == 0, start_s


def test_strict_stops_at_the_first(short_drive, model, edit_log):
    def insert(log):
        return [*log[:500], (BOXES, log[499][1], b"\xff\xff\xff"), *log[500:]]

    with pytest.raises(
        LogError, match=r"/gmsl/A0/detections at .* s refused: .*; without --strict the run would go on"
    ):
        run(edit_log(short_drive, insert), model, strict=True)


def test_every_damaged_message_is_counted_with_its_reason(short_drive, model, edit_log):
    def damage(log):
        for i, (topic, at_ns, data) in enumerate(log):
            yield topic, at_ns, (b"\xff\xff\xff" if topic == BOXES and i % 3 == 0 else data)

    with_damage = edit_log(short_drive, damage)
    frames, refusals = run(with_damage, model)
    with Replay([short_drive], None, PredictorChoice("inline", model)) as whole:
        expected = len(list(whole))
    assert len(frames) == expected
    assert {topic for topic, _ in refusals.counts} == {BOXES}
    assert refusals.total > 20
    assert len(refusals.counts) == 1  # one reason


def test_a_scan_that_comes_two_seconds_late_is_counted(drive, model, edit_log, results):
    def delay(log):
        scans = [i for i, (topic, _, _) in enumerate(log) if topic == CLUSTERS_TOPIC]
        topic, at_ns, data = log[scans[20]]
        delayed = (topic, at_ns + 2_000_000_000, data)
        return sorted([*(m for i, m in enumerate(log) if i != scans[20]), delayed], key=lambda m: m[1])

    frames, refusals = run(edit_log(drive, delay), model)
    assert len(frames) == len(results) - 1
    assert list(refusals.counts.values()) == [1]
    ((_, reason),) = refusals.counts
    assert reason in ("scan too late to use", "absurd stamp")


def test_a_scan_that_comes_a_little_late_amends_the_tracks(drive, model, edit_log, results):
    def delay(log):
        scans = [i for i, (topic, _, _) in enumerate(log) if topic == CLUSTERS_TOPIC]
        topic, at_ns, data = log[scans[30]]
        delayed = (topic, at_ns + 350_000_000, data)
        return sorted([*(m for i, m in enumerate(log) if i != scans[30]), delayed], key=lambda m: m[1])

    frames, refusals = run(edit_log(drive, delay), model)
    assert refusals.total == 0
    assert len(frames) == len(results) - 1
    last, expected = frames[-1].tracks.tracks, results[-1].tracks.tracks
    assert [t.id for t in last] == [t.id for t in expected]
    for one, other in zip(last, expected, strict=True):
        np.testing.assert_allclose(one.state[:2], other.state[:2], atol=0.05)


# --- logs that cannot be used ----------------------------------------------------------------------------------------


def test_a_log_without_mounts_is_a_clear_error(short_drive, model, edit_log):
    no_mounts = edit_log(short_drive, lambda log: [m for m in log if m[0] != TF_STATIC_TOPIC])
    text = f"no transform joins 'base_link' and 'velodyne_front_link', the frame of {CLUSTERS_TOPIC}; the frames of"
    with pytest.raises(LogError, match=text):
        run(no_mounts, model)


def moved_to(topic, of, log):
    """Logs the mounts of some frames on another topic, five times a second."""
    for name, at_ns, data in log:
        if name != TF_STATIC_TOPIC:
            yield name, at_ns, data
            continue
        mounts = foxglove.decode("foxglove.FrameTransforms", data)
        yield name, at_ns, foxglove.encode([mount for mount in mounts if of not in mount.child_frame_id])
        moved = foxglove.encode([mount for mount in mounts if of in mount.child_frame_id])
        for k in range(15):
            yield topic, at_ns + k * 200_000_000, moved


def test_mounts_are_looked_for_among_moving_transforms_if_a_camera_needs_them(short_drive, model, edit_log):
    def move(log):
        return sorted(moved_to("/tf", "gmsl", log), key=lambda message: message[1])

    frames, refusals = run(edit_log(short_drive, move), model)
    assert refusals.total == 0
    assert [len(frame.sensors.cameras) for frame in frames] == [
        len(frame.sensors.cameras) for frame in run(short_drive, model)[0]
    ]


def test_a_camera_that_no_transform_reaches_is_named_before_anything_starts(short_drive, edit_log):
    path = edit_log(
        short_drive, lambda log: moved_to("/elsewhere", "gmsl_left_link", log), schemas={"/elsewhere": "/tf"}
    )
    settings = ReplaySettings(roles=RoleChoices(transforms=("/tf", "/tf_static")))
    text = "no transform joins 'base_link' and 'gmsl_left_link', the frame of /gmsl/A1/detections; the frames of"
    with pytest.raises(LogError, match=text):
        Replay([path], settings)


def test_scans_in_a_frame_in_which_the_vehicle_moves_are_refused(short_drive, edit_log):
    def in_odom(log):
        for topic, at_ns, data in log:
            scan = codec.decode(LidarClusters, data) if topic == CLUSTERS_TOPIC else None
            yield topic, at_ns, data if scan is None else codec.encode(replace(scan, frame_id="odom"))

    with pytest.raises(
        LogError, match=f"{CLUSTERS_TOPIC} is in 'odom', in which the vehicle moves: LiDAR clusters must"
    ):
        Replay([edit_log(short_drive, in_odom)])


def test_poses_of_which_none_can_be_read_are_a_clear_error(short_drive, edit_log):
    no_poses = edit_log(short_drive, lambda log: [(t, at, b"?" if t == ODOMETRY_TOPIC else d) for t, at, d in log])
    text = f"no message on {ODOMETRY_TOPIC} says where the vehicle is: .* refused: not a pcgan.v1.VehiclePose"
    with pytest.raises(LogError, match=text):
        Replay([no_poses])


def test_what_a_log_lacks_is_said_before_anything_starts(short_drive, edit_log):
    no_lidar = edit_log(short_drive, lambda log: [m for m in log if m[0] != CLUSTERS_TOPIC])
    with pytest.raises(LogError, match="no LiDAR clusters and no LiDAR points: looked for /velodyne/front/clusters"):
        Replay([no_lidar])


def test_the_lidar_alone_is_enough(short_drive, model, edit_log):
    lidar = edit_log(short_drive, lambda log: [m for m in log if not m[0].startswith("/gmsl")])
    frames, refusals = run(lidar, model)
    assert refusals.total == 0
    assert frames[-1].tracks.tracks
    assert frames[-1].sensors.cameras == ()


def test_a_corrupt_checkpoint_is_named(short_drive, tmp_path):
    (tmp_path / "bad.safetensors").write_bytes(b"no weights")
    with pytest.raises(PredictorError, match=r"bad\.safetensors is not a readable safetensors file"):
        run(short_drive, tmp_path / "bad.safetensors")


def test_a_missing_checkpoint_is_named(short_drive, tmp_path):
    with pytest.raises(PredictorError, match=r"no checkpoint .*gone\.safetensors"):
        run(short_drive, tmp_path / "gone.safetensors")


def test_a_window_of_nothing_is_a_callers_mistake(short_drive):
    with pytest.raises(ValueError, match="a window holds at least one frame, got 0"):
        Replay([short_drive], window=0)


def test_a_replay_must_be_entered(short_drive):
    with pytest.raises(RuntimeError, match="enter the replay first"):
        iter(Replay([short_drive]))


# --- settings --------------------------------------------------------------------------------------------------------


def test_settings_survive_json():
    settings = ReplaySettings(start_s=2, duration_s=5, roles=RoleChoices(pose="/odom"))
    assert ReplaySettings.model_validate_json(settings.model_dump_json()) == settings


@pytest.mark.parametrize("wrong", [{"start_s": -1}, {"duration_s": 0}, {"speed": 1}, {"sync": {"wait_ms": -1}}])
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="validation error"):
        ReplaySettings.model_validate(wrong)
