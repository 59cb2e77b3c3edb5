"""A recording with one thing wrong: the check names it and the amount, and nothing else; one in order, nothing."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from replay import foxglove, recording_check
from replay.camera_check import CameraCheck, CameraWatch, Estimate
from replay.decoders import PROTOBUF as DECODERS
from replay.inspection import inspect_frames
from replay.recording_check import ClockReset, RecordingReport, StampCheck, TopicTiming, check_stamps, report
from replay.session import Replay, ReplaySettings
from replay.simulator import simulate
from replay.simulator.sensor_suite import CLUSTERS_TOPIC, GROUND_TRUTH_TOPIC, ODOMETRY_TOPIC, TF_STATIC_TOPIC
from schemas import codec
from schemas import pcgan_v1_pb2 as pb
from schemas.messages import VehiclePose
from tracking.fusion import FusionParams

CAMERAS = ("A0", "A1", "A2", "A3", "B0", "B1")
SIDE_CAMERA = "gmsl_right_side_link"  # of B1


@pytest.fixture(scope="module")
def crowd(tmp_path_factory):
    """A 10 s drive through a crowd of 25: every camera sees people for most of it."""
    path = tmp_path_factory.mktemp("drives") / "crowd.mcap"
    simulate(path, clip=None, vehicle=None, pedestrians=25, duration_s=10.0, seed=6)
    return path


def check(path, **sync) -> RecordingReport:
    run = Replay([path], ReplaySettings(sync=sync))
    watch = CameraWatch(run.settings.tracking.fusion)
    for each in inspect_frames(run):
        watch.add(each.frame, each.measurements, each.labels, each.report.at_s)
    return report(stamps(run), watch.checks(run.roles))


def stamps(run: Replay) -> StampCheck:
    return check_stamps(run.reader, run.roles, run.settings.sync, run.offsets_ns)


def stamp_verdicts(path) -> tuple[str, ...]:
    """What the stamps alone give: nothing has to be tracked for that."""
    return report(stamps(Replay([path])), ()).verdicts


def turned(frame_id: str, axis: tuple[float, float, float], angle_deg: float) -> Callable:
    """A change to a log: a sensor's mount is said to be turned about an axis of the vehicle."""
    turn = Rotation.from_rotvec(np.radians(angle_deg) * np.array(axis))

    def change(log: list) -> Iterable:
        for topic, log_time_ns, data in log:
            if topic == TF_STATIC_TOPIC:
                transforms = DECODERS["foxglove.FrameTransforms"][1](data)
                said = [
                    replace(t, quaternion_xyzw=(turn * Rotation.from_quat(t.quaternion_xyzw)).as_quat())
                    if t.child_frame_id == frame_id
                    else t
                    for t in transforms
                ]
                yield topic, log_time_ns, foxglove.encode(tuple(said))
            else:
                yield topic, log_time_ns, data

    return change


# --- whole drives -----------------------------------------------------------------------------------------------------


def test_a_recording_in_order_gives_no_verdict(crowd):
    found = check(crowd)
    assert found.verdicts == ()
    assert [each.camera for each in found.cameras] == list(CAMERAS)
    for camera in found.cameras:
        assert camera.boxes > 0.6 * camera.boxes_seen
        assert abs(camera.yaw_deg.value) < 0.3
        assert abs(camera.pitch_deg.value) < 0.3
        assert abs(camera.time_offset_ms.value) < max(5, 4 * camera.time_offset_ms.error)
        assert camera.residual_px[1] < 6
        assert abs(camera.height_log_ratio.value) < 0.05
    rates = {topic.topic: topic.rate_hz for topic in found.topics}
    assert rates[CLUSTERS_TOPIC] == pytest.approx(10, abs=0.1)
    assert rates[ODOMETRY_TOPIC] == pytest.approx(100, abs=1)
    assert rates["/gmsl/A0/detections"] == pytest.approx(30, abs=0.3)
    assert all(0.2 < topic.jitter_ms < 1.2 for topic in found.topics)  # 0.4 ms each stamp, so 0.57 ms each step
    assert all(topic.delay_ms[0] > 3 and topic.gaps == 0 for topic in found.topics)


def test_stamps_80_ms_late_are_found_and_nobody_else_is_named(crowd, edit_log, shift_stamps):
    late = edit_log(crowd, shift_stamps(80, "/gmsl/A1/detections"))
    found = check(late)
    (by_motion, by_delay) = found.verdicts
    assert "A1: its stamps are about" in by_motion
    assert "too late" in by_motion
    assert "--time-offset /gmsl/A1/detections:=-" in by_motion
    assert by_delay.startswith("/gmsl/A1/detections: logged -")
    assert "may be 8" in by_delay or "may be 7" in by_delay
    (a1,) = [each for each in found.cameras if each.camera == "A1"]
    assert a1.time_offset_ms.value == pytest.approx(-80, abs=10)
    assert abs(a1.yaw_deg.value) < 0.3
    assert check(late, time_offset_ms={"/gmsl/A1/detections": -80}).verdicts == ()


@pytest.mark.parametrize(
    ("axis", "words", "figure"),
    [
        ((0, 0, 1), "left of the clusters", "yaw_deg"),
        # about its own right-hand side, seen from the vehicle: it looks 110 degrees to the right
        ((-math.cos(math.radians(20)), math.sin(math.radians(20)), 0), "above the clusters", "pitch_deg"),
    ],
    ids=["yaw", "pitch"],
)
def test_a_mount_3_degrees_off_is_found_and_nobody_else_is_named(crowd, edit_log, axis, words, figure):
    found = check(edit_log(crowd, turned(SIDE_CAMERA, axis, 3.0)))
    (verdict,) = found.verdicts
    assert verdict.startswith("B1: ")
    estimate = next(getattr(each, figure) for each in found.cameras if each.camera == "B1")
    assert estimate.value == pytest.approx(3.0, abs=0.3)
    assert words in verdict
    assert verdict.endswith("to the right" if figure == "yaw_deg" else "down")


def test_where_every_camera_is_off_alike_it_is_the_lidar(crowd, edit_log, shift_stamps):
    found = check(edit_log(crowd, shift_stamps(50, CLUSTERS_TOPIC, GROUND_TRUTH_TOPIC)))
    (verdict,) = found.verdicts
    assert verdict.startswith(f"{CLUSTERS_TOPIC}: its stamps are about ")
    offset_ms = float(verdict.rsplit(":=", 1)[1])
    assert offset_ms == pytest.approx(-50, abs=8)


def test_where_the_map_lies_and_how_it_leans_changes_no_check(crowd, edit_log):
    """An odometry frame that began on a slope: everything is 200 m up and leans by 4 degrees, people as well."""
    lean = Rotation.from_rotvec([0, math.radians(4.0), 0])

    def lifted(log):
        for topic, log_time_ns, data in log:
            if topic == ODOMETRY_TOPIC:
                pose = codec.decode(VehiclePose, data)
                moved = lean.apply(pose.position_m) + np.array([0, 0, 200])
                quaternion = (lean * Rotation.from_quat(pose.quaternion_xyzw)).as_quat()
                yield topic, log_time_ns, codec.encode(replace(pose, position_m=moved, quaternion_xyzw=quaternion))
            elif topic != GROUND_TRUTH_TOPIC:
                yield topic, log_time_ns, data

    level, leaning = check(crowd), check(edit_log(crowd, lifted))
    assert leaning.verdicts == ()
    for before, after in zip(level.cameras, leaning.cameras, strict=True):
        assert after.boxes == pytest.approx(before.boxes, rel=0.05)
        assert after.yaw_deg.value == pytest.approx(before.yaw_deg.value, abs=0.1)
        assert after.pitch_deg.value == pytest.approx(before.pitch_deg.value, abs=0.1)


def test_another_calibration_on_the_way_starts_its_camera_afresh(crowd, edit_log):
    """Until 3 s in, A0 is said to have a focal length 1.4 times as long as it has."""

    def change(log):
        start_ns = log[0][1]
        for topic, log_time_ns, data in log:
            if topic == "/gmsl/A0/camera_info" and log_time_ns < start_ns + 2_500_000_000:
                said = DECODERS["foxglove.CameraCalibration"][1](data)
                longer = said.intrinsics_px * np.array([[1.4, 1, 1], [1, 1.4, 1], [1, 1, 1]])
                yield topic, log_time_ns, foxglove.encode(replace(said, intrinsics_px=longer))
            else:
                yield topic, log_time_ns, data

    found = check(edit_log(crowd, change))
    (verdict,) = found.verdicts
    assert verdict.startswith("A0: its calibration changes on the way; its boxes are checked from 3.")
    (a0,) = [each for each in found.cameras if each.camera == "A0"]
    assert a0.since_s == pytest.approx(3.0, abs=0.5)
    assert abs(a0.height_log_ratio.value) < 0.05
    assert all(each.since_s is None for each in found.cameras if each.camera != "A0")


def test_a_short_log_has_too_little_to_say_and_says_so(short_drive):
    found = check(short_drive)
    assert found.verdicts == ()
    few = [each for each in found.cameras if each.yaw_deg is None]
    assert any(0 < each.boxes < 30 for each in few)


def test_a_gap_and_scans_without_detections_are_verdicts(short_drive, edit_log):
    def drop(log):
        start_ns = log[0][1]
        return [m for m in log if m[0] != "/gmsl/B0/detections" or not 1e9 < m[1] - start_ns < 1.8e9]

    found = check(edit_log(short_drive, drop))
    gap, share = found.verdicts
    assert gap.startswith("/gmsl/B0/detections: no message for 0.8 s, from ")
    assert share.startswith("/gmsl/B0/detections: only 7")
    (b0,) = [each for each in found.topics if each.topic == "/gmsl/B0/detections"]
    assert b0.gaps == 1


@pytest.mark.parametrize(
    ("kept", "gap_s", "at_s"),
    [(lambda at_s: at_s < 0.2, 2.8, 0.2), (lambda at_s: at_s > 1, 1.0, 0.0), (lambda at_s: at_s < 0, 3.1, 0.0)],
    ids=["stops", "starts late", "says nothing"],
)
@pytest.mark.parametrize("topic", [CLUSTERS_TOPIC, ODOMETRY_TOPIC])
def test_a_sensor_that_stops_or_starts_late_has_a_gap(short_drive, topic, kept, gap_s, at_s, monkeypatch):
    """The log lasts 3.1 s: the delay of its last messages is in it."""
    usual = recording_check.timings

    def cut(reader, seconds):
        found = usual(reader, seconds)
        stamps_ns, delays_ns = found[topic]
        rows = kept((stamps_ns + delays_ns - reader.start_ns) / 1e9)
        return found | {topic: (stamps_ns[rows], delays_ns[rows])}

    monkeypatch.setattr(recording_check, "timings", cut)
    found = stamps(Replay([short_drive]))
    (gap,) = [each for each in found.topics if each.topic == topic]
    assert gap.gaps == 1
    assert (gap.longest_gap_s, gap.longest_gap_at_s) == pytest.approx((gap_s, at_s), abs=0.12)
    verdicts = [verdict for verdict in report(found, ()).verdicts if "no message" in verdict]
    assert verdicts == [f"{topic}: no message for {gap.longest_gap_s:.1f} s, from {gap.longest_gap_at_s:.1f} s on"]


def test_messages_that_were_logged_late_are_no_gap(short_drive, edit_log):
    """From 1 to 2 s into the log nothing could be written; it was written then."""

    def stall(log):
        start_ns = log[0][1]
        held = [(t, max(at, start_ns + 2 * 10**9) if at > start_ns + 10**9 else at, data) for t, at, data in log]
        return sorted(held, key=lambda message: message[1])

    assert stamp_verdicts(edit_log(short_drive, stall)) == ()


def restamped(offset_s: Callable[[str, float], float]) -> Callable:
    """A change to a log: adds to a message's stamp what `offset_s` says of its topic and time in the log."""
    kinds = {CLUSTERS_TOPIC: pb.LidarClusters, GROUND_TRUTH_TOPIC: pb.GroundTruthFrame, ODOMETRY_TOPIC: pb.VehiclePose}

    def change(log: list) -> Iterable:
        start_ns = log[0][1]
        for topic, log_time_ns, data in log:
            kind = kinds.get(topic, pb.CameraDetections if topic.endswith("/detections") else None)
            if kind is not None:
                message = kind.FromString(data)
                message.stamp_ns += round(1e9 * offset_s(topic, (log_time_ns - start_ns) / 1e9))
                yield topic, log_time_ns, message.SerializeToString(deterministic=True)
            else:
                yield topic, log_time_ns, data

    return change


@pytest.mark.parametrize("off_s", [1e8, -1e8])
def test_one_absurd_stamp_is_refused_and_changes_no_figure(short_drive, edit_log, off_s):
    """As the replay does: it is one message less."""
    seen = set()

    def one(topic, at_s):
        if topic != "/gmsl/A1/detections" or at_s < 1.5 or seen:
            return 0.0
        seen.add(topic)
        return off_s

    path = edit_log(short_drive, restamped(one))
    found = stamps(Replay([path]))
    assert report(found, ()).verdicts == ()
    (a1,) = [each for each in found.topics if each.topic == "/gmsl/A1/detections"]
    assert a1.refused == 1
    assert a1.longest_gap_s < 0.1
    assert max(a1.skew_ms) < 50
    assert max(each.delay_ms[1] for each in found.topics) < 1000


@pytest.mark.parametrize(("by_s", "words"), [(-20.0, "back by 20.0 s"), (100.0, "forward by 100.0 s")])
def test_a_clock_that_was_set_is_a_verdict_and_the_only_one(short_drive, edit_log, by_s, words):
    path = edit_log(short_drive, restamped(lambda _, at_s: by_s if at_s > 1.5 else 0.0))
    found = stamps(Replay([path]))
    (verdict,) = report(found, ()).verdicts
    assert verdict == f"the clock was set {words}, at 1.5 s into the log: tracks begin anew there"
    assert all(each.longest_gap_s < 0.4 for each in found.topics)
    assert all(max(each.skew_ms) < 100 for each in found.topics if each.skew_ms)
    assert all(0 < each.delay_ms[0] < 100 for each in found.topics)  # of the clock that agrees with the log's
    assert {round(each.rate_hz) for each in found.topics} == {10, 30, 100}


# --- figures into words -----------------------------------------------------------------------------------------------


def timing(topic: str, role: str = "camera", delay_ms: float = 50.0, **changes) -> TopicTiming:
    usual = TopicTiming(topic, role, 300, 0, 30.0, 0.5, (delay_ms, delay_ms + 20), (5.0, 9.0), 1.0, 0, 0.03, 1.0)
    return replace(usual, **changes)


def verdicts(timings: list[TopicTiming], cameras: list[CameraCheck]) -> tuple[str, ...]:
    return report(StampCheck(tuple(timings), ()), cameras).verdicts


SCANS = timing(CLUSTERS_TOPIC, "clusters", 80.0, scans_with=None)


def camera(name: str, **changes) -> CameraCheck:
    good = CameraCheck(
        name, f"/gmsl/{name}/detections", 400, 500, (0.0, 3.0), (0.0, 0.1), Estimate(0.0, 0.02),
        Estimate(0.0, 0.05), Estimate(0.0, 0.05), Estimate(0.0, 3.0), time_offset_observable=True,
    )  # fmt: skip
    return replace(good, **changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"yaw_deg": Estimate(-2.1, 0.2)}, "boxes lie 2.1 deg (± 0.4) right of the clusters"),
        ({"yaw_deg": Estimate(-2.1, 0.6)}, None),  # not significant
        ({"yaw_deg": Estimate(0.9, 0.01)}, None),  # not worth a word
        ({"pitch_deg": Estimate(1.5, 0.1)}, "boxes lie 1.5 deg (± 0.2) above the clusters"),
        ({"time_offset_ms": Estimate(35.0, 5.0)}, "about 35 ms (± 10) too early"),
        ({"time_offset_ms": Estimate(35.0, 9.0)}, None),
        ({"time_offset_ms": Estimate(90.0, 4.0), "time_offset_observable": False}, None),
        ({"height_log_ratio": Estimate(0.3, 0.05)}, "boxes are 1.35 times as high"),
        ({"height_log_ratio": Estimate(-0.3, 0.05)}, "boxes are 0.74 times as high"),
        ({"height_log_ratio": Estimate(0.3, 0.1)}, None),
        ({"height_log_ratio": Estimate(0.1, 0.01)}, None),
        ({"since_s": 4.0}, "its calibration changes on the way; its boxes are checked from 4.0 s on"),
        ({"boxes": 60}, "only 60 of 500 boxes"),
        ({"boxes": 5, "boxes_seen": 60}, None),
    ],
)
def test_what_becomes_a_verdict(changes, words):
    found = verdicts([SCANS], [camera("A0", **changes)])
    assert len(found) == (words is not None)
    assert words is None or words in found[0]


def test_cameras_that_disagree_do_not_make_it_the_lidar():
    off = Estimate(-80.0, 3.0)
    found = verdicts([SCANS], [camera("A0"), camera("A1", time_offset_ms=off), camera("A2")])
    assert len(found) == 1
    assert found[0].startswith("A1: ")
    found = verdicts([SCANS], [camera(name, time_offset_ms=off) for name in ("A0", "A1", "A2")])
    assert len(found) == 1
    assert found[0].startswith(f"{CLUSTERS_TOPIC}: ")


def test_a_delay_unlike_the_other_cameras_is_a_verdict_and_stamps_from_the_future_are():
    three = [
        timing(f"/gmsl/{name}/detections", delay_ms=delay) for name, delay in zip("abc", (50, 52, 130), strict=True)
    ]
    (verdict,) = verdicts([SCANS, *three], [])
    assert verdict.startswith("/gmsl/c/detections: logged 130 ms after its stamps, cameras usually 52 ms")
    assert "78 ms too early" in verdict
    (verdict,) = verdicts([replace(SCANS, delay_ms=(-30.0, -10.0))], [])
    assert verdict == f"{CLUSTERS_TOPIC}: logged 30 ms before its stamps: another clock?"


def test_a_clock_reset_comes_first():
    found = report(StampCheck((replace(SCANS, longest_gap_s=2.0),), (ClockReset(12.34, -0.04),)), [])
    assert found.clock_resets == (ClockReset(12.34, -0.04),)
    assert found.verdicts[0].startswith("the clock was set back by 0.0 s, at 12.3 s into the log")
    assert found.verdicts[1].endswith("no message for 2.0 s, from 1.0 s on")


def test_nothing_seen_gives_no_checks():
    assert CameraWatch(FusionParams()).checks({}) == ()
