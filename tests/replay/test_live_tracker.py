"""Tracking as messages arrive: the tracks of a replay, what waits for whom, what overload leaves out, refusals."""

import pytest

from replay import foxglove
from replay.live_tracker import LiveTracker
from replay.log_reader import LogReader
from replay.logged_message import LoggedSchema, RawMessage
from replay.roles import RoleChoices
from replay.session import ReplaySettings
from replay.simulator.sensor_suite import CLUSTERS_TOPIC, ODOMETRY_TOPIC, TF_STATIC_TOPIC
from schemas import codec
from schemas.messages import CameraCalibration, Transform
from tracking.tracker import Tracker

MS = 1_000_000
BOXES, CALIBRATION = "/gmsl/A0/detections", "/gmsl/A0/camera_info"
TOPICS = {
    "LidarClusters": CLUSTERS_TOPIC,
    "VehiclePose": ODOMETRY_TOPIC,
    "CameraDetections": BOXES,
    "CameraCalibration": CALIBRATION,
    "Transform": TF_STATIC_TOPIC,
}


@pytest.fixture
def raw(make):
    """Turns a message into what arrives at `at_ms`."""

    def arriving(at_ms, message, topic=None):
        if isinstance(message, Transform):
            name, data = "foxglove.FrameTransforms", foxglove.encode((message,))
        elif isinstance(message, CameraCalibration):
            name, data = "foxglove.CameraCalibration", foxglove.encode(message)
        else:
            name, data = codec.schema_name(type(message)), codec.encode(message)
        topic = topic or TOPICS[type(message).__name__]
        return RawMessage(topic, make.stamp(at_ms), LoggedSchema(name, "protobuf", b""), "protobuf", data)

    return arriving


@pytest.fixture
def live(make, raw):
    """Makes a tracker that knows the mounts and has poses up to a time; also the list of what it refuses."""

    def start(poses_until_ms=101, *, mounts=True, settings=None, silent_cameras=True):
        refused = []
        tracker = LiveTracker(settings, on_refused=refused.append)
        if mounts:
            tracker.take(raw(0, make.transform("base_link", "lidar", (1.2, 0, 1.4))))
            tracker.take(raw(0, make.transform("base_link", "camera", (1.2, 0, 1.4))))
        for at_ms in range(0, poses_until_ms, 10):
            tracker.take(raw(at_ms, make.pose(at_ms)))
        if silent_cameras:
            tracker._started_ns = make.stamp(-10_000)  # so long ago that no scan waits for any
        return tracker, refused

    return start


def scans_until(tracker, raw, make, at_ms, *, every_ms=100, first_ms=100):
    """Lets scans and poses arrive; they all wait."""
    for stamp_ms in range(first_ms, at_ms, every_ms):
        tracker.take(raw(stamp_ms, make.scan(stamp_ms)))
        for pose_ms in range(stamp_ms + 10, stamp_ms + every_ms + 1, 10):
            tracker.take(raw(pose_ms, make.pose(pose_ms)))


def tracked(tracker):
    """Tracks all that waits."""
    results = [tracker.track() for _ in range(tracker.waiting)]
    return [result for result in results if result is not None]


# --- live is replay ---------------------------------------------------------------------------------------------------


def test_a_log_pushed_message_by_message_gives_the_tracks_of_its_replay(recorded, short_drive):
    tracker = LiveTracker(on_refused=pytest.fail)
    results = []
    for message in LogReader([short_drive]).messages(set(tracker.roles.readings)):
        results += tracker.push(message)
    tracker.advance(message.log_time_ns + 300 * MS)  # where a replay knows that the log has ended
    results += tracked(tracker)
    assert [codec.encode(r.tracks) for r in results] == [codec.encode(f.tracks) for f in recorded.frames]
    assert [codec.encode(r.pose) for r in results] == [codec.encode(f.vehicle_pose) for f in recorded.frames]
    released = [r.released_ns for r in results]
    assert released[:-1] == [f.log_time_ns for f in recorded.frames][:-1]
    assert sum(len(r.tracks.tracks) for r in results) > 50
    assert tracker.missing() == ()
    assert tracker.refused == 0


def test_time_that_passes_between_messages_changes_nothing(recorded, short_drive):
    """What a node does between arrivals, at every moment at which nothing has come for 10 ms."""
    tracker = LiveTracker(on_refused=pytest.fail)
    results, last_ns = [], None
    for message in LogReader([short_drive]).messages(set(tracker.roles.readings)):
        if last_ns is not None and message.log_time_ns - last_ns > 10 * MS:
            tracker.advance(last_ns + 10 * MS)
        last_ns = message.log_time_ns
        tracker.take(message)
        results += tracked(tracker)
    tracker.advance(last_ns + 300 * MS)
    results += tracked(tracker)
    assert [codec.encode(r.tracks) for r in results] == [codec.encode(f.tracks) for f in recorded.frames]


def test_another_trackers_tracks_are_followed_as_in_a_replay(make, raw, live):
    """A topic of somebody's tracks gives the frames; nothing is tracked by us."""
    tracker, _ = live(settings=ReplaySettings(roles=RoleChoices(tracks="/theirs")))
    assert tracker.roles.cameras == ()
    tracker.take(raw(110, make.result(100, tracks=[make.track(100, id=77)]).tracks, "/theirs"))
    (result,) = tracker.push(raw(150, make.pose(150)))
    assert [track.id for track in result.tracks.tracks] == [77]


# --- who waits for whom -----------------------------------------------------------------------------------------------


def test_a_scan_is_released_when_nothing_comes_any_more(make, raw, live):
    tracker, _ = live()
    tracker.take(raw(105, make.scan(100)))
    for now_ms, waiting in ((105, 0), (404, 0), (405, 1), (500, 1)):
        tracker.advance(make.stamp(now_ms))
        assert tracker.waiting == waiting
    (result,) = tracked(tracker)
    assert result.released_ns == make.stamp(405)
    assert result.tracks.stamp_ns == make.stamp(100)


def test_cameras_that_never_send_are_waited_for_in_the_beginning_only(make, raw, live):
    tracker, _ = live(1000, silent_cameras=False)
    waited = []
    for stamp_ms in range(1000, 4000, 100):
        for pose_ms in range(stamp_ms, stamp_ms + 100, 10):
            tracker.take(raw(pose_ms, make.pose(pose_ms)))
            if pose_ms == stamp_ms:
                tracker.take(raw(stamp_ms, make.scan(stamp_ms)))
            waited += [(r.released_ns - r.tracks.stamp_ns) / MS for r in tracked(tracker)]
    assert waited[0] == 300
    assert waited[-1] == 50  # until the pose has passed the scan
    assert 0.5 < sum(each == 50 for each in waited) / len(waited) < 0.8


def test_a_camera_that_sends_is_waited_for_until_it_falls_silent(make, raw, live):
    tracker, _ = live(1000)
    tracker.take(raw(990, make.calibration()))
    waited = {}
    for stamp_ms in range(1000, 5000, 100):
        for pose_ms in range(stamp_ms, stamp_ms + 100, 10):
            tracker.take(raw(pose_ms, make.pose(pose_ms)))
            if pose_ms == stamp_ms:
                tracker.take(raw(stamp_ms, make.scan(stamp_ms)))
            if pose_ms == stamp_ms + 90 and stamp_ms < 2000:
                tracker.take(raw(pose_ms, make.boxes(stamp_ms + 70)))  # 20 ms under way
            waited |= {r.tracks.stamp_ns: (r.released_ns - r.tracks.stamp_ns) / MS for r in tracked(tracker)}
    assert waited[make.stamp(1500)] == 90
    assert waited[make.stamp(2500)] == 300
    assert waited[make.stamp(4500)] == 50


# --- overload ---------------------------------------------------------------------------------------------------------


def test_a_short_burst_is_caught_up_with(make, raw, live):
    """Five scans at once, 10 ms each: the newest is still out within 100 ms."""
    tracker, _ = live()
    scans_until(tracker, raw, make, 600)
    assert tracker.waiting == 5
    newest_ns = make.stamp(550)  # when the pose has passed it
    assert tracker.shed(newest_ns, deadline_ns=100 * MS, step_ns=10 * MS) == 0
    assert [r.tracks.stamp_ns for r in tracked(tracker)] == [make.stamp(100 * k) for k in range(1, 6)]


def test_no_more_is_left_out_than_is_needed(make, raw, live):
    tracker, _ = live()
    scans_until(tracker, raw, make, 600)
    assert tracker.shed(make.stamp(560), deadline_ns=100 * MS, step_ns=30 * MS) == 2  # 90 ms left: three of 30
    assert [r.tracks.stamp_ns for r in tracked(tracker)] == [make.stamp(100 * k) for k in (3, 4, 5)]


@pytest.mark.parametrize("now_ms", [550, 600, 5000])
def test_where_tracking_is_too_slow_the_newest_wins(make, raw, live, now_ms):
    tracker, _ = live()
    scans_until(tracker, raw, make, 600)
    assert tracker.shed(make.stamp(now_ms), deadline_ns=100 * MS, step_ns=150 * MS) == 4
    assert [r.tracks.stamp_ns for r in tracked(tracker)] == [make.stamp(500)]


def test_one_that_waits_alone_is_never_left_out(make, raw, live):
    tracker, _ = live()
    scans_until(tracker, raw, make, 200)
    assert tracker.waiting == 1
    assert tracker.shed(make.stamp(10_000), deadline_ns=1, step_ns=10**9) == 0
    assert tracker.waiting == 1


def test_late_scans_go_before_others(make, raw, live):
    """They would only amend tracks that are out already."""
    tracker, _ = live()
    scans_until(tracker, raw, make, 400)
    tracker.take(raw(410, make.scan(150)))  # its successors are complete
    scans_until(tracker, raw, make, 500, first_ms=420)
    assert tracker.waiting == 5
    assert tracker.shed(make.stamp(480), deadline_ns=50 * MS, step_ns=10 * MS) == 1  # time for four of five
    results = [tracker.track() for _ in range(tracker.waiting)]
    assert None not in results
    assert [r.tracks.stamp_ns for r in results] == [make.stamp(ms) for ms in (100, 200, 300, 420)]


def test_a_late_scan_amends_as_in_a_replay(make, raw, live, monkeypatch):
    amended = []
    real = Tracker.amend
    monkeypatch.setattr(Tracker, "amend", lambda *args: (amended.append(args[2]), real(*args))[1])
    tracker, refused = live()
    scans_until(tracker, raw, make, 400)
    assert tracker.push(raw(410, make.scan(250)))
    assert amended == [make.stamp(250)]
    assert refused == []


def test_people_are_followed_across_what_was_left_out(make, raw, live):
    """Every second scan is left out: the time step is longer, the person the same."""
    ids = []
    tracker, _ = live()
    for stamp_ms in range(100, 3100, 100):
        scan = make.scan(stamp_ms, ((8.0, -1.2 + 1.2e-3 * stamp_ms, -0.5),))
        tracker.take(raw(stamp_ms, scan))
        for pose_ms in range(stamp_ms + 10, stamp_ms + 101, 10):
            tracker.take(raw(pose_ms, make.pose(pose_ms, x=0.0, velocity=(0, 0, 0))))
        if tracker.waiting == 2:
            assert tracker.shed(make.stamp(stamp_ms + 100), deadline_ns=100 * MS, step_ns=150 * MS) == 1
            ids += [[track.id for track in r.tracks.tracks] for r in tracked(tracker)]
    assert len(ids) == 15
    assert ids[-8:] == [ids[-1]] * 8
    assert len(ids[-1]) == 1


# --- what is missing, what is refused ---------------------------------------------------------------------------------


def test_it_says_what_it_has_not_heard_of_yet(make, raw):
    tracker = LiveTracker()
    assert tracker.missing() == (
        f"no LiDAR clusters on {CLUSTERS_TOPIC}",
        f"no vehicle pose on {ODOMETRY_TOPIC}",
    )
    tracker.take(raw(0, make.pose(0)))
    assert tracker.missing() == (f"no LiDAR clusters on {CLUSTERS_TOPIC}",)


def test_without_a_mount_it_goes_on_waiting_and_says_so(make, raw, live):
    """A replay ends there; live the transforms may be late."""
    tracker, refused = live(mounts=False)
    scans_until(tracker, raw, make, 400)
    (problem,) = tracker.missing()
    assert problem.startswith("no transform joins 'base_link' and 'lidar'; the frames of /tf_static are none")
    assert (tracker.waiting, tracker.refused, refused) == (0, 3, [])
    tracker.take(raw(410, make.transform("base_link", "lidar")))
    scans_until(tracker, raw, make, 700, first_ms=420)
    assert tracker.waiting == 3
    assert tracker.missing() == ()


def test_a_camera_without_a_calibration_is_told_and_left_out(make, raw, live):
    tracker, _ = live()
    tracker.take(raw(110, make.boxes(110)))
    scans_until(tracker, raw, make, 300)
    assert tracker.missing() == (f"no calibration of camera A0 on {CALIBRATION}: its boxes are left out",)
    tracker.take(raw(310, make.calibration()))
    assert tracker.missing() == ()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"data": b"\xff\xff\xff"}, f"{CLUSTERS_TOPIC} refused: not a pcgan.v1.LidarClusters"),
        ({"schema": LoggedSchema("foo.Bar", "protobuf", b"")}, "schema foo.Bar in protobuf"),
        ({"encoding": "cdr"}, "in cdr"),
    ],
    ids=["no protobuf", "another schema", "another encoding"],
)
def test_what_makes_no_sense_is_refused_and_the_rest_tracked(make, raw, live, change, words):
    tracker, refused = live()
    tracker.take(raw(90, make.scan(90))._replace(**change))
    scans_until(tracker, raw, make, 400)
    assert tracker.waiting == 3
    (line,) = refused
    assert words in line
    assert tracker.refused == 1


def test_messages_on_other_topics_are_none_of_its_business(make, raw, live):
    tracker, refused = live()
    tracker.take(raw(90, make.scan(90), "/rear/clusters"))
    assert (tracker.waiting, tracker.refused, refused) == (0, 0, [])


def test_what_is_refused_is_counted_and_not_kept(make, raw, live):
    tracker, refused = live()
    for k in range(500):
        tracker.take(raw(90, make.scan(90))._replace(schema=LoggedSchema(f"foo.Bar{k}", "protobuf", b"")))
    assert tracker.refused == len(refused) == 500
    assert not tracker._refusals.counts
    assert not tracker._refusals.first


def test_a_clock_that_was_reset_starts_tracks_anew(make, raw, live):
    """As when a log is played in a loop."""
    tracker, _ = live()
    scans_until(tracker, raw, make, 1000)
    results = tracked(tracker)
    for stamp_ms in range(-60_000, -59_000, 10):
        tracker.take(raw(stamp_ms + 62_000, make.pose(stamp_ms)))
        if stamp_ms % 100 == 0:
            tracker.take(raw(stamp_ms + 62_000, make.scan(stamp_ms)))
    results += tracked(tracker)
    assert {r.tracks.epoch for r in results} == {0, 1}
    assert results[-1].tracks.stamp_ns > make.stamp(-60_000)
