"""Recordings of other stacks, written by other people's libraries, replayed with no options: our tracks come out."""

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from replay import PredictorChoice, Replay, ReplaySettings, record
from replay.log_info import describe_log
from replay.simulator import simulate
from replay.simulator.sensor_suite import CLUSTERS_TOPIC, ODOMETRY_TOPIC
from tests.replay import foreign_foxglove as foxglove
from tests.replay import foreign_ros as ros

WRITERS = {
    "ROS 2, vision_msgs 4, rosbags": lambda source, target: ros.as_ros2(source, target, 4, "rosbags"),
    "ROS 2, vision_msgs 3, mcap-ros2-support": lambda source, target: ros.as_ros2(source, target, 3, "mcap_ros2"),
    "ROS 1, genpy": ros.as_ros1,
    "Foxglove protobuf": foxglove.as_foxglove,
    "Foxglove JSON": foxglove.as_foxglove_json,
}


@pytest.fixture(scope="module")
def replayed(model):
    """Replays a log in this process; with labels of pedestrians, if they are not the usual ones."""

    def run(path, *labels, **roles):
        settings = {"roles": roles}
        if labels:
            settings["tracking"] = {"fusion": {"pedestrian_labels": labels}}
        settings = ReplaySettings.model_validate(settings)
        with Replay([path], settings, PredictorChoice("inline", model)) as replay:
            frames = list(replay)
        assert replay.refusals.total == 0
        return frames

    return run


@pytest.fixture(scope="module")
def expected(short_drive, replayed, tmp_path_factory):
    """The drive's own frames, and those of the drive reduced to what vision_msgs carries."""
    reduced = ros.reduced(short_drive, tmp_path_factory.mktemp("reduced") / "reduced.mcap")
    return {"whole": replayed(short_drive), "reduced": replayed(reduced)}


def assert_same(found, wanted, tolerance_m=1e-6):
    assert [frame.tracks.stamp_ns for frame in found] == [frame.tracks.stamp_ns for frame in wanted]
    assert sum(len(frame.tracks.tracks) for frame in wanted) > 50
    for one, other in zip(found, wanted, strict=True):
        assert [t.id for t in one.tracks.tracks] == [t.id for t in other.tracks.tracks]
        assert len(one.sensors.cameras) == len(other.sensors.cameras)
        for a, b in zip(one.tracks.tracks, other.tracks.tracks, strict=True):
            np.testing.assert_allclose(a.state, b.state, atol=tolerance_m)
        for a, b in zip(one.predictions.predictions, other.predictions.predictions, strict=True):
            np.testing.assert_allclose(a.paths[0].points_m, b.paths[0].points_m, atol=1e3 * tolerance_m)


@pytest.mark.parametrize("stack", WRITERS)
def test_a_foreign_log_gives_the_tracks_of_ours(stack, short_drive, replayed, expected, tmp_path):
    path = WRITERS[stack](short_drive, tmp_path / "foreign.mcap")
    labels = (ros.ROS1_PEDESTRIAN,) if stack.startswith("ROS 1") else ()  # numbers there, and no name for them
    found = replayed(path, *labels)
    assert_same(found, expected["reduced" if stack.startswith("ROS") else "whole"])
    description = describe_log([path])
    assert description["usable"] is True
    assert {row["role"] for row in description["topics"]} >= {"camera", "calibration", "clusters", "pose", "transforms"}


def test_topics_of_any_names_are_found_by_what_they_carry(short_drive, replayed, expected, tmp_path):
    """Every topic under a name that says nothing; detections and their calibration are joined by their frame."""
    source = ros.as_ros2(short_drive, tmp_path / "usual.mcap", 4, "mcap_ros2")
    path = tmp_path / "strange.mcap"
    with source.open("rb") as stream, path.open("wb") as copy:
        writer = Writer(copy)
        writer.start(profile="ros2", library="pcgan tests")
        names, numbers = {}, {}
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.topic not in numbers:
                names[channel.topic] = f"/topic_{len(names)}"
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.topic] = writer.register_channel(names[channel.topic], "cdr", number)
            writer.add_message(numbers[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    assert_same(replayed(path), expected["reduced"])


def test_points_alone_give_tracks(replayed, tmp_path):
    """A log with points in the place of clusters: most people near enough are tracked where they really are."""
    path = tmp_path / "points.mcap"
    simulate(path, clip=None, vehicle=None, pedestrians=15, duration_s=4.0, seed=3, points=True)
    with_clusters, from_points = replayed(path), replayed(path, points="/velodyne/front/points")
    assert len(from_points) == len(with_clusters)
    near = []
    for frame in from_points[20:]:
        truth = frame.ground_truth
        seen = truth.positions_m[truth.lidar_points >= 20]
        found = np.array([track.state[:2] for track in frame.tracks.tracks]).reshape(-1, 2)
        if len(seen):
            near += (np.linalg.norm(seen[:, None] - found, axis=-1).min(axis=1, initial=9) < 0.5).tolist()
    assert len(near) > 40
    assert np.mean(near) > 0.85


@pytest.fixture(scope="module")
def with_outputs(short_drive, model, tmp_path_factory):
    """The drive with our tracks beside it, as our own messages and as Autoware's."""
    path = tmp_path_factory.mktemp("tracks") / "with_tracks.mcap"
    run = Replay([short_drive], None, PredictorChoice("inline", model))
    record(run, path, merge=True, emit=("pcgan", "autoware"))
    return path


def test_our_own_logged_tracks_are_predicted_again(with_outputs, replayed, expected, digest):
    assert digest(replayed(with_outputs, tracks="/pcgan/tracks")) == [
        (frame.log_time_ns, *rest)
        for frame, (_, *rest) in zip(
            replayed(with_outputs, tracks="/pcgan/tracks"), digest(expected["whole"]), strict=True
        )
    ]


def test_autoware_tracks_are_predicted_without_fusion_and_tracking(with_outputs, replayed, expected):
    found = replayed(with_outputs, tracks="/pcgan/tracked_objects")
    assert len(found) == len(expected["whole"])
    for one, other in zip(found, expected["whole"], strict=True):
        assert len(one.sensors.clusters.points) == 0
        ours = np.array([t.state for t in other.tracks.tracks]).reshape(-1, 4)
        np.testing.assert_allclose(np.array([t.state for t in one.tracks.tracks]).reshape(-1, 4), ours, atol=1e-9)
    last = found[-1].predictions.predictions
    assert sum(not prediction.fallback for prediction in last) >= len(last) - 1


def test_detections_with_ids_are_predicted_too(short_drive, replayed, expected, tmp_path):
    """vision_msgs carry neither velocity nor covariance of tracks: both are estimated from the positions."""
    stack, name = ros.Stack(4), "vision_msgs/msg/Detection3DArray"
    wanted = expected["whole"]
    arrays = [(frame.log_time_ns, detection_array(frame.tracks)) for frame in wanted]
    poses = [m for m in ros.foreign_messages(short_drive, stack) if m[0] in (ODOMETRY_TOPIC, "/tf_static")]
    messages = [*poses, *(("/tracker", at_ns, name, stack.filled(name, values)) for at_ns, values in arrays)]
    path = tmp_path / "tracks.mcap"
    ros.write_mcap_ros2(iter(sorted(messages, key=lambda message: message[1])), path, stack)
    found = replayed(path, tracks="/tracker")
    assert len(found) == len(wanted)
    errors = []
    for one, other in zip(found[15:], wanted[15:], strict=True):
        ids = {track.id: track for track in one.tracks.tracks}
        assert len(ids) == len(other.tracks.tracks)
        for track in other.tracks.tracks:
            same = min(ids.values(), key=lambda each: np.linalg.norm(each.state[:2] - track.state[:2]))
            np.testing.assert_allclose(same.state[:2], track.state[:2], atol=0.2)
            errors.append(np.linalg.norm(same.state[2:] - track.state[2:]))
    assert np.median(errors) < 0.2


def detection_array(tracks):
    """Our tracks as boxes with ids, in the odometry frame."""
    people = [
        {
            "header": ros.header(tracks.stamp_ns, tracks.frame_id),
            "results": [{"hypothesis": {"class_id": "person", "score": track.existence}}],
            "bbox": ros.box_3d((*track.state[:2], 0.9), (0.6, 0.6, 1.7)),
            "id": f"track {track.id}",
        }
        for track in tracks.tracks
    ]
    return {"header": ros.header(tracks.stamp_ns, tracks.frame_id), "detections": people}


def test_clusters_without_ids_are_no_tracks(short_drive, model, tmp_path):
    path = ros.as_ros2(short_drive, tmp_path / "log.mcap", 4, "mcap_ros2")
    settings = ReplaySettings.model_validate({"roles": {"tracks": CLUSTERS_TOPIC}})
    with Replay([path], settings, PredictorChoice("inline", model)) as replay:
        assert list(replay) == []
    ((topic, reason),) = replay.refusals.counts
    assert (topic, replay.refusals.total) == (CLUSTERS_TOPIC, 30)
    assert "id" in reason
