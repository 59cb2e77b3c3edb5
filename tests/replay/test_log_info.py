"""What a recording holds, as data and as a table."""

import io
import json

import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from rich.console import Console

from replay.errors import LogError
from replay.log_info import delays_text, describe_log, print_info, timings
from replay.log_reader import LogReader
from replay.roles import RoleChoices
from replay.session import ReplaySettings
from replay.simulator.sensor_suite import CLUSTERS_TOPIC, ODOMETRY_TOPIC


def rows(description):
    return {row["topic"]: row for row in description["topics"]}


def printed(description):
    stream = io.StringIO()
    print_info(description, Console(file=stream, width=240))
    return stream.getvalue()


def test_a_drive_is_described(short_drive):
    description = describe_log([short_drive])
    json.dumps(description)
    assert description["files"] == ["short.mcap"]
    assert description["usable"] is True
    assert description["problem"] is None
    assert description["missing"] == []
    assert description["duration_s"] == pytest.approx(3.0, abs=0.2)
    scans = rows(description)[CLUSTERS_TOPIC]
    assert (scans["schema"], scans["encoding"], scans["role"]) == (
        "pcgan.v1.LidarClusters",
        "protobuf",
        "clusters",
    )
    assert scans["count"] == 30
    assert scans["rate_hz"] == pytest.approx(10, rel=0.1)
    poses = rows(description)[ODOMETRY_TOPIC]
    assert poses["rate_hz"] == pytest.approx(100, rel=0.1)
    assert poses["skew_ms"]["p50"] <= 5.5  # 100 Hz: at most half a period


def test_delays_and_skews_in_closed_form(make, make_log, logged):
    """Poses every 100 ms with stamps 30 ms old; scans 20 ms after each pose's stamp."""
    messages = []
    for t in range(1000, 3000, 100):
        messages.append(logged(ODOMETRY_TOPIC, make.stamp(t + 30), make.pose(t)))
        messages.append(logged(CLUSTERS_TOPIC, make.stamp(t + 70), make.scan(t + 20)))
    found = rows(describe_log([make_log(messages)]))
    assert found[ODOMETRY_TOPIC]["delay_ms"] == {"p50": 30.0, "p99": 30.0}
    assert found[CLUSTERS_TOPIC]["delay_ms"] == {"p50": 50.0, "p99": 50.0}
    assert found[ODOMETRY_TOPIC]["skew_ms"] == {"p50": 20.0, "p99": 20.0}
    assert found[CLUSTERS_TOPIC]["skew_ms"] is None


def test_delays_are_taken_from_the_first_seconds(make, make_log, logged):
    messages = [
        logged(ODOMETRY_TOPIC, make.stamp(t + (10 if t < 2000 else 500)), make.pose(t)) for t in range(1000, 9000, 50)
    ]
    messages.append(logged(CLUSTERS_TOPIC, make.stamp(9900), make.scan(9800)))
    path = make_log(messages)
    assert rows(describe_log([path], seconds=0.9))[ODOMETRY_TOPIC]["delay_ms"]["p99"] == 10
    assert rows(describe_log([path]))[ODOMETRY_TOPIC]["delay_ms"]["p99"] == 500


def test_a_log_that_cannot_be_replayed_says_why(make, make_log, logged):
    path = make_log([logged(ODOMETRY_TOPIC, make.stamp(t), make.pose(t)) for t in range(0, 100, 10)])
    description = describe_log([path])
    assert description["usable"] is False
    assert (
        "the log has no LiDAR clusters and no LiDAR points: looked for /velodyne/front/clusters"
        in description["problem"]
    )
    assert rows(description)[ODOMETRY_TOPIC]["count"] == 10
    assert "cannot be replayed: the log has no LiDAR clusters" in printed(description)


def test_topics_nobody_can_decode_are_listed(make, make_log, logged):
    messages = [
        logged(ODOMETRY_TOPIC, make.stamp(0), make.pose(0)),
        logged("/diagnostics", make.stamp(5), b"\x01\x02", "diagnostic_msgs/DiagnosticArray", "cdr"),
        logged(CLUSTERS_TOPIC, make.stamp(9), make.scan(0)),
    ]
    row = rows(describe_log([make_log(messages)]))["/diagnostics"]
    assert (row["role"], row["delay_ms"], row["rate_hz"], row["count"]) == (None, None, None, 1)


def test_messages_that_do_not_decode_are_left_out_of_the_delays(make, make_log, logged):
    messages = [
        logged(ODOMETRY_TOPIC, make.stamp(10), make.pose(0)),
        logged(ODOMETRY_TOPIC, make.stamp(20), b"\xff\xff", "pcgan.v1.VehiclePose"),
        logged(CLUSTERS_TOPIC, make.stamp(30), make.scan(0)),
    ]
    row = rows(describe_log([make_log(messages)]))[ODOMETRY_TOPIC]
    assert row["count"] == 2
    assert row["delay_ms"] == {"p50": 10.0, "p99": 10.0}


def test_a_transforms_message_without_a_transform_is_no_reason_to_stop(make, make_log, logged):
    messages = [
        logged(ODOMETRY_TOPIC, make.stamp(10), make.pose(0)),
        logged("/tf_static", make.stamp(20), b"", "foxglove.FrameTransforms"),
        logged(CLUSTERS_TOPIC, make.stamp(30), make.scan(0)),
    ]
    row = rows(describe_log([make_log(messages)]))["/tf_static"]
    assert (row["count"], row["delay_ms"]) == (1, None)


def test_what_is_used_is_said_with_the_reason_and_what_could_be(short_drive, edit_log):
    twice = edit_log(
        short_drive,
        lambda log: [m for t, at, d in log for m in ((t, at, d), ("/odom", at, d))[: 1 + (t == ODOMETRY_TOPIC)]],
        topics={ODOMETRY_TOPIC: "/a"},
        schemas={"/odom": ODOMETRY_TOPIC},
    )
    description = describe_log([twice])
    assert description["usable"] is False
    assert "2 topics could be the vehicle pose: /a, /odom" in description["problem"]
    assert rows(description)["/odom"]["could_be"] == ["pose"]
    assert "could be pose" in printed(description)
    description = describe_log([twice], ReplaySettings(roles=RoleChoices(pose="/odom")))
    assert description["usable"] is True
    assert (rows(description)["/odom"]["role"], rows(description)["/odom"]["why"]) == ("pose", "chosen")
    assert rows(description)["/a"]["role"] is None
    assert rows(description)["/gmsl/A0/detections"]["camera"] == "A0"


def test_the_table_has_a_line_per_topic(short_drive):
    description = describe_log([short_drive])
    text = printed(description)
    for row in description["topics"]:
        assert row["topic"] in text
    assert "short.mcap: 3." in text
    assert "clusters" in text
    assert "cannot be replayed" not in text


def test_damage_is_shown_when_salvaged(short_drive, edit_log):
    damaged = edit_log(short_drive, lambda log: log, "damaged.mcap", chunk_size=20_000)
    data = damaged.read_bytes()
    damaged.write_bytes(data[: len(data) // 2])
    with pytest.raises(LogError, match=r"damaged\.mcap is not a readable MCAP file"):
        describe_log([damaged])
    description = describe_log([damaged], salvage=True)
    assert description["salvage_losses"]
    assert "damaged: damaged.mcap: nothing readable after byte" in printed(description)


def test_a_topic_of_several_schemas_is_used_as_far_as_it_can_be_read(make, make_log, logged):
    messages = [logged(ODOMETRY_TOPIC, make.stamp(t), make.pose(t)) for t in range(0, 100, 10)]
    others = [logged(ODOMETRY_TOPIC, make.stamp(100), b"?", name) for name in ("a.Other", "z.Other")]
    path = make_log([*messages, logged(CLUSTERS_TOPIC, make.stamp(50), make.scan(40)), *others])
    found = [row for row in describe_log([path])["topics"] if row["topic"] == ODOMETRY_TOPIC]
    assert [row["schema"] for row in found] == ["a.Other", "pcgan.v1.VehiclePose", "z.Other"]
    assert {(row["role"], row["delay_ms"]["p99"]) for row in found} == {("pose", 0.0)}


def test_what_has_no_stamp_or_an_impossible_log_time_has_no_delay(make, make_log, logged):
    static = FrameTransform(parent_frame_id="base_link", child_frame_id="lidar", rotation={"w": 1.0})
    messages = [
        logged("/tf_static", make.stamp(0), static.SerializeToString(), "foxglove.FrameTransform"),
        logged(ODOMETRY_TOPIC, make.stamp(30), make.pose(20)),
        logged(ODOMETRY_TOPIC, 2**64 - 1, make.pose(30)),
    ]
    reader = LogReader([make_log(messages)])
    found = timings(reader, 1e12)
    assert len(found["/tf_static"][0]) == 0
    assert found[ODOMETRY_TOPIC][1].tolist() == [10 * make.MS]


def test_names_that_look_like_markup_are_printed_as_they_are(make, make_log, logged):
    odd = logged("/a[/b]", make.stamp(0), b"?", "x[/red]")
    text = printed(describe_log([make_log([odd, logged(ODOMETRY_TOPIC, make.stamp(0), make.pose(0))])]))
    assert "/a[/b]" in text
    assert "x[/red]" in text


def test_delays_of_a_log_that_was_recorded_from_a_replay_are_told_in_days():
    assert delays_text(56.4, 74.0) == "56 / 74"
    assert delays_text(-250_000, -240_000) == "-250 / -240 s"
    assert delays_text(212_533_842_295, 212_533_842_303) == "2460 / 2460 d"
