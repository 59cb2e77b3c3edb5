"""Unsynchronised messages in, one frame per scan out: when it is released, and what comes with it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from replay import PredictorChoice, Replay, ReplaySettings
from replay.errors import LogError, Refusals
from replay.roles import Reading, Roles, time_offsets
from replay.time_sync import SyncSettings, TimeSync
from schemas.messages import PointCloud, TrackFrame

SCANS, POSES, BOXES = "/velodyne/front/clusters", "/vn100/odometry", "/gmsl/{}/detections"


class Rig:
    """A TimeSync with mounts, and pushes in the words of this test; times in ms, log time 20 ms after the stamp."""

    def __init__(self, make, cameras=("A0",), mounts=("lidar", "camera"), **settings):
        self.make, self.refusals, self.frames = make, Refusals(), []
        self.sync = TimeSync(cameras, SyncSettings(**settings), self.refusals)
        for name in cameras:
            self.sync.take_static(f"/gmsl/{name}/camera_info", name, make.calibration(), self.refusals)
        for name in mounts:
            self.sync.take_static("/tf_static", None, make.transform("base_link", name, (1.2, 0, 1.4)), self.refusals)

    def _push(self, topic, camera, message, log_ms, at_ms):
        log_ns = self.make.stamp(at_ms + 20 if log_ms is None else log_ms)
        frames = list(self.sync.push(topic, camera, log_ns, message))
        self.frames += frames
        return frames

    def scan(self, at_ms, log_ms=None, **changes):
        return self._push(SCANS, None, self.make.scan(at_ms, **changes), log_ms, at_ms)

    def pose(self, at_ms, log_ms=None, **changes):
        return self._push(POSES, None, self.make.pose(at_ms, **changes), log_ms, at_ms)

    def boxes(self, at_ms, camera="A0", log_ms=None, **changes):
        return self._push(BOXES.format(camera), camera, self.make.boxes(at_ms, **changes), log_ms, at_ms)

    def truth(self, at_ms, log_ms=None):
        return self._push("/simulation/ground_truth", None, self.make.truth(at_ms, [(7, 1, 2)]), log_ms, at_ms)

    def poses(self, *times_ms):
        return [frame for t in times_ms for frame in self.pose(t)]


@pytest.fixture
def rig(make):
    return lambda *arguments, **settings: Rig(make, *arguments, **settings)


# --- when ------------------------------------------------------------------------------------------------------------


def test_a_scan_waits_for_every_camera_and_the_pose_to_pass_it_by_50_ms(rig, make):
    r = rig(("A0", "A1"))
    assert r.poses(*range(900, 1060, 10)) == []
    assert r.scan(1000) == []
    assert r.boxes(1010) == []
    assert r.boxes(1049.9) == []
    assert r.boxes(1055) == []
    assert r.boxes(1049.9, "A1") == []
    (frame,) = r.boxes(1050, "A1", log_ms=1093)
    assert frame.sensors.stamp_ns == make.stamp(1000)
    assert frame.log_time_ns == make.stamp(1093)  # of the message that released it
    assert not frame.late


def test_a_scan_waits_for_the_pose(rig):
    r = rig()
    r.poses(*range(900, 1050, 10))
    r.scan(1000)
    assert r.boxes(1060) == []
    assert len(r.pose(1050)) == 1


def test_the_scan_itself_may_come_last(rig, make):
    r = rig()
    r.poses(*range(900, 1060, 10))
    r.boxes(1060)
    (frame,) = r.scan(1000, log_ms=1100)
    assert frame.log_time_ns == make.stamp(1100)


def test_without_cameras_the_pose_decides(rig):
    r = rig(())
    r.poses(*range(900, 1050, 10))
    assert r.scan(1000) == []
    assert len(r.pose(1050)) == 1


def test_a_silent_camera_is_waited_for_300_ms_of_log_time_and_no_longer(rig, make):
    r = rig(("A0", "A1"))
    r.poses(*range(900, 1400, 10))
    r.boxes(1060)
    assert r.scan(1000, log_ms=1400) == []
    assert r.boxes(1390, log_ms=1699.9) == []
    (frame,) = r.boxes(1395, log_ms=1700)
    assert frame.log_time_ns == make.stamp(1700)
    assert frame.sensors.cameras == ()  # A0's detections at 1060 are 60 ms away, A1 is silent


def test_the_wait_is_a_setting(rig):
    r = rig(("A0", "A1"), wait_ms=10)
    r.poses(*range(900, 1060, 10))
    r.scan(1000, log_ms=1080)
    assert r.boxes(1062, log_ms=1089.9) == []
    assert len(r.boxes(1063, log_ms=1090)) == 1


def test_scans_are_released_in_stamp_order_however_they_arrive(rig, make):
    r = rig()
    r.poses(*range(900, 1400, 10))
    assert r.scan(1200, log_ms=1400) == []
    assert r.scan(1000, log_ms=1410) == []
    assert r.scan(1100, log_ms=1420) == []
    frames = r.boxes(1390, log_ms=1430)
    assert [frame.sensors.stamp_ns for frame in frames] == [make.stamp(t) for t in (1000, 1100, 1200)]


def test_flush_releases_what_still_waits(rig, make):
    r = rig()
    r.poses(*range(900, 1160, 10))
    r.scan(1000)
    r.scan(1100)
    assert [f.sensors.stamp_ns for f in r.sync.flush()] == [make.stamp(1000), make.stamp(1100)]
    assert list(r.sync.flush()) == []


# --- what ------------------------------------------------------------------------------------------------------------


def released(r, scan_ms=1000):
    """Returns the frame of the only scan, releasing it if it still waits."""
    (frame,) = [*r.frames, *r.sync.flush()]
    assert frame.sensors.stamp_ns == r.make.stamp(scan_ms)
    return frame


def test_the_nearest_detections_are_taken_and_of_equally_near_ones_the_older(rig, make):
    for times, expected in (((960, 990, 1030), 990), ((980, 1020), 980), ((1049, 1050.5), 1049)):
        r = rig()
        r.poses(*range(900, 1100, 10))
        for t in times:
            r.boxes(t)
        r.scan(1000)
        (camera,) = released(r).sensors.cameras
        assert camera.detections.stamp_ns == make.stamp(expected)


@pytest.mark.parametrize(("at_ms", "evidence"), [(950, True), (949.9, False), (1050, True), (1050.1, False)])
def test_a_camera_without_detections_within_50_ms_gives_no_evidence(rig, at_ms, evidence):
    r = rig()
    r.poses(*range(900, 1100, 10))
    r.boxes(at_ms)
    r.scan(1000)
    assert len(released(r).sensors.cameras) == evidence


def test_a_camera_without_a_calibration_gives_no_evidence(rig, make):
    r = rig(())
    r.sync = TimeSync(("A0",), SyncSettings(), r.refusals)
    r.sync.take_static("/tf_static", None, make.transform("base_link", "lidar"), r.refusals)
    r.poses(*range(900, 1100, 10))
    r.boxes(1000)
    r.scan(1000)
    assert released(r).sensors.cameras == ()


def test_each_camera_has_the_pose_of_its_own_stamp(rig):
    """The vehicle drives at 2 m/s along x; the camera looked 30 ms after the scan, so 6 cm farther on."""
    r = rig()
    r.poses(*range(900, 1100, 10))
    r.boxes(1030)
    r.scan(1000)
    sensors = released(r).sensors
    np.testing.assert_allclose(sensors.map_from_vehicle[:3, 3], [2.0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(sensors.map_from_lidar[:3, 3], [3.2, 0, 1.4], atol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(sensors.cameras[0].camera_from_map)[:3, 3], [3.26, 0, 1.4], atol=1e-9)


def test_the_pose_lies_between_the_logged_ones(rig):
    r = rig()
    r.poses(990, 1010, 1060)
    r.scan(1003)
    frame = released(r, 1003)
    np.testing.assert_allclose(frame.vehicle_state, [2.006, 0, 0, 2, 0], atol=1e-9)
    assert not frame.sensors.pose_extrapolated
    assert (frame.sensors.frame_id, frame.sensors.vehicle_frame_id) == ("odom", "base_link")


def test_an_extrapolated_pose_is_marked(rig):
    r = rig()
    r.poses(*range(900, 980, 10))
    r.scan(1000)
    frame = released(r)
    assert frame.sensors.pose_extrapolated
    np.testing.assert_allclose(frame.vehicle_state[0], 2.0, atol=1e-9)


def test_a_scan_without_a_pose_is_refused_and_counted(rig):
    r = rig()
    r.poses(*range(900, 940, 10))
    r.scan(1000)
    assert list(r.sync.flush()) == []
    assert r.refusals.as_json() == [{"topic": "scans", "reason": "no vehicle pose within 50 ms", "count": 1}]


def test_a_scan_before_the_first_pose_is_refused_and_the_next_is_not(rig, make):
    r = rig()
    r.scan(700)
    r.scan(1000)
    r.poses(*range(960, 1400, 10))
    assert [f.sensors.stamp_ns for f in [*r.frames, *r.sync.flush()]] == [make.stamp(1000)]
    assert r.refusals.counts["scans", "no vehicle pose within 50 ms"] == 1


def test_a_pose_without_a_frame_is_of_base_link(rig):
    r = rig()
    for t in range(900, 1100, 10):
        r.pose(t, child="")
    r.scan(1000)
    assert released(r).sensors.vehicle_frame_id == "base_link"


def test_the_ground_truth_of_the_scan_is_joined(rig):
    r = rig()
    r.poses(*range(900, 1100, 10))
    r.truth(900)
    r.truth(1000)
    r.scan(1000)
    assert released(r).ground_truth.stamp_ns == r.make.stamp(1000)


def test_no_ground_truth_of_another_stamp_is_joined(rig):
    r = rig()
    r.poses(*range(900, 1100, 10))
    r.truth(999.9)
    r.scan(1000)
    assert released(r).ground_truth is None


def test_an_empty_scan_is_a_frame(rig):
    r = rig()
    r.poses(*range(900, 1100, 10))
    r.scan(1000, centroids=())
    assert len(released(r).sensors.clusters.centroids_m) == 0


def same(one, other):
    a, b = one.sensors, other.sensors
    np.testing.assert_array_equal(a.map_from_lidar, b.map_from_lidar)
    np.testing.assert_array_equal(one.vehicle_state, other.vehicle_state)
    assert [c.detections.stamp_ns for c in a.cameras] == [c.detections.stamp_ns for c in b.cameras]
    for x, y in zip(a.cameras, b.cameras, strict=True):
        np.testing.assert_array_equal(x.camera_from_map, y.camera_from_map)


PIECES = [("pose", t) for t in range(940, 1051, 10)] + [("boxes", t) for t in (970, 1005, 1040)] + [("scan", 1000)]


@given(st.permutations(PIECES))
@settings(max_examples=40, deadline=None)
def test_the_order_of_arrival_changes_nothing(make, pieces):
    def frame(order):
        r = Rig(make)
        for kind, t in order:
            assert getattr(r, kind)(t, log_ms=1100) == []
        return released(r)

    same(frame(pieces), frame(PIECES))


# --- what is late, repeated or absurd --------------------------------------------------------------------------------


def driven(r, until_ms):
    """Drives on to a time, with a scan every 100 ms from 1000 on; returns the frames."""
    frames = []
    for t in range(900, until_ms + 1, 10):
        frames += r.pose(t)
        if t % 30 == 0:
            frames += r.boxes(t)
        if t % 100 == 0 and t >= 1000:
            frames += r.scan(t)
    return frames


def test_a_scan_whose_successors_were_released_comes_late(rig, make):
    r = rig()
    frames = driven(r, 1600)
    assert [f.sensors.stamp_ns for f in frames] == [make.stamp(t) for t in range(1000, 1600, 100)]
    (late,) = r.scan(1350, log_ms=1630)
    assert late.late
    assert late.sensors.stamp_ns == make.stamp(1350)
    assert len(late.sensors.cameras) == 1
    assert r.refusals.total == 0


def test_a_repeated_scan_is_refused(rig):
    r = rig()
    driven(r, 1600)
    assert r.scan(1300, log_ms=1630) == []  # released before
    r.scan(1700, log_ms=1720)
    r.scan(1700, log_ms=1721)  # still waiting
    assert r.refusals.counts == {(SCANS, "repeated scan"): 2}


def test_one_absurd_stamp_is_refused_and_named(rig):
    r = rig()
    before = driven(r, 1500)
    assert r.scan(3_600_000, log_ms=1520) == []
    assert r.pose(-100_000, log_ms=1521) == []
    assert r.refusals.counts == {(SCANS, "absurd stamp"): 1, (POSES, "absurd stamp"): 1}
    assert "refused: absurd stamp (log time" in r.refusals.first[0]
    assert {frame.epoch for frame in before} == {0}


def test_a_clock_reset_begins_a_new_epoch(rig, make):
    r = rig()
    frames = driven(r, 2000)
    scans = [1000 + 100 * i for i in range(10)]
    assert [f.sensors.stamp_ns for f in frames] == [make.stamp(t) for t in scans]
    after, back = [], -500_000  # the sensors' clock; log time goes on
    for t in range(2000, 3000, 10):
        after += r.pose(back + t, log_ms=t + 20)
        if t % 30 == 0:
            after += r.boxes(back + t, log_ms=t + 20)
        if t % 100 == 0:
            after += r.scan(back + t, log_ms=t + 20)
    old = [frame for frame in after if frame.epoch == 0]
    new = [frame for frame in after if frame.epoch == 1]
    assert len(old) + len(new) == len(after)
    assert [f.sensors.stamp_ns for f in old] == [make.stamp(2000)]  # it was waiting when the clock jumped
    stamps = [f.sensors.stamp_ns for f in new]
    assert stamps == sorted(stamps)
    assert len(stamps) >= 6
    assert stamps[-1] >= make.stamp(back + 2800)
    assert all(reason == "absurd stamp" for _, reason in r.refusals.counts if reason != "no vehicle pose within 50 ms")
    assert r.refusals.counts[POSES, "absurd stamp"] == 2  # the third showed the reset


def test_a_reset_keeps_calibration_and_mounts(rig):
    r = rig()
    driven(r, 1500)
    frames = []
    for t in range(1510, 2500, 10):
        frames += r.pose(t - 60_000, log_ms=t + 20)
        frames += r.boxes(t - 60_000, log_ms=t + 20)
        if t % 100 == 0:
            frames += r.scan(t - 60_000, log_ms=t + 20)
    new = [frame for frame in frames if frame.epoch == 1]
    assert new
    assert all(frame.sensors.cameras for frame in new[1:])


# --- mounts and calibrations -----------------------------------------------------------------------------------------


def test_a_lidar_nobody_mounted_is_a_clear_error(rig):
    r = rig(mounts=("camera",))
    r.poses(*range(900, 1100, 10))
    r.scan(1000)
    text = r"no transform joins 'base_link' and 'lidar'; the frames of /tf_static are base_link, camera"
    with pytest.raises(LogError, match=text):
        list(r.sync.flush())


def test_a_camera_nobody_mounted_is_a_clear_error(rig):
    r = rig(mounts=("lidar",))
    r.poses(*range(900, 1100, 10))
    r.boxes(1000)
    r.scan(1000)
    with pytest.raises(LogError, match="no transform joins 'camera' and 'base_link'"):
        list(r.sync.flush())


def test_no_mounts_at_all_say_none(rig):
    r = rig(mounts=())
    r.poses(*range(900, 1100, 10))
    r.scan(1000)
    with pytest.raises(LogError, match="the frames of /tf_static are none"):
        list(r.sync.flush())


def test_a_single_scan_of_an_unknown_frame_later_on_is_refused(rig):
    r = rig()
    driven(r, 1500)
    r.scan(1510, frame="who")
    list(r.sync.flush())
    assert r.refusals.counts["transforms", "no transform joins 'base_link' and 'who'"] == 1


def test_an_unusable_calibration_is_refused_and_the_old_one_stays(rig, make):
    r = rig()
    bad = make.calibration(coefficients=3)
    assert list(r.sync.push("/gmsl/A0/camera_info", "A0", make.stamp(10), bad)) == []
    ((topic, reason),) = r.refusals.counts
    assert (topic, reason) == ("/gmsl/A0/camera_info", "unusable calibration")
    r.poses(*range(900, 1100, 10))
    r.boxes(1000)
    r.scan(1000)
    assert len(released(r).sensors.cameras) == 1


def test_a_transform_in_the_stream_is_taken(rig, make):
    r = rig(mounts=("camera",))
    assert list(r.sync.push("/tf_static", None, make.stamp(5), make.transform("base_link", "lidar"))) == []
    r.poses(*range(900, 1100, 10))
    r.scan(1000)
    assert released(r).sensors.stamp_ns == make.stamp(1000)


# --- time offsets ----------------------------------------------------------------------------------------------------


def test_an_offset_is_added_to_a_topic_s_stamps(make):
    """A camera whose clock is 80 ms ahead: with -80 ms its boxes are those of the scan again, at the vehicle's pose."""
    r = Rig(make)
    r.sync = TimeSync(("A0",), SyncSettings(), r.refusals, {BOXES.format("A0"): -80 * make.MS})
    r.sync.take_static("/gmsl/A0/camera_info", "A0", make.calibration(), r.refusals)
    for name in ("lidar", "camera"):
        r.sync.take_static("/tf_static", None, make.transform("base_link", name, (1.2, 0, 1.4)), r.refusals)
    r.poses(*range(900, 1100, 10))
    r.boxes(1000)
    r.boxes(1110)
    r.scan(1000)
    (camera,) = released(r).sensors.cameras
    assert camera.detections.stamp_ns == make.stamp(1030)
    np.testing.assert_allclose(np.linalg.inv(camera.camera_from_map)[:3, 3], [3.26, 0, 1.4], atol=1e-9)


def test_frames_bear_the_corrected_stamp_of_the_scan_and_keep_its_truth(make):
    r = Rig(make, ())
    offsets_ns = {SCANS: -50 * make.MS, "/simulation/ground_truth": -50 * make.MS}
    r.sync = TimeSync((), SyncSettings(), r.refusals, offsets_ns)
    r.sync.take_static("/tf_static", None, make.transform("base_link", "lidar"), r.refusals)
    r.poses(*range(900, 1100, 10))
    r.truth(1000)
    r.scan(1000)
    frame = released(r, 950)
    assert frame.ground_truth.stamp_ns == make.stamp(950)
    np.testing.assert_allclose(frame.vehicle_state[0], 1.9, atol=1e-9)


@pytest.mark.parametrize("offset_ms", [float("nan"), float("inf"), 10_000.1, -10_000.1])
def test_an_offset_that_makes_no_sense_is_refused(offset_ms):
    with pytest.raises(ValidationError):
        SyncSettings(time_offset_ms={SCANS: offset_ms})
    assert SyncSettings(time_offset_ms={SCANS: 10_000}).time_offset_ms == {SCANS: 10_000}


def test_offsets_go_by_topic():
    readings = {"/clusters": "clusters", POSES: "pose", "/truth": "truth", "/tf_static": "transforms"}
    roles = Roles({topic: Reading(topic, role, None, "") for topic, role in readings.items()}, ())
    assert time_offsets(roles, {"/clusters": -5}) == {"/clusters": -5_000_000, "/truth": -5_000_000}  # of its scan
    assert time_offsets(roles, {POSES: 0.25}) == {POSES: 250_000}
    assert time_offsets(roles, {}) == {}
    for name in ("/nothing", "/tf_static", "/truth"):
        with pytest.raises(LogError, match=f"{name} can have no time offset; topics with stamps that count are /clus"):
            time_offsets(roles, {name: 1})


# --- other sources ---------------------------------------------------------------------------------------------------


def test_transforms_move_the_vehicle(make):
    """The chain odom <- base_footprint <- base_link, of which one link moves; others' transforms are not poses."""
    sync = TimeSync((), SyncSettings(), Refusals(), moving="/tf")
    sync.take_static("/tf_static", None, make.transform("base_footprint", "base_link", (0, 0, 0.3)), Refusals())
    sync.take_static("/tf_static", None, make.transform("base_link", "lidar", (1.2, 0, 1.4)), Refusals())
    frames = []
    for at_ms in range(900, 1200, 10):
        moved = replace(make.transform("odom", "base_footprint", (2e-3 * at_ms, 1, 0)), stamp_ns=make.stamp(at_ms))
        other = replace(make.transform("map", "odom", (50, 0, 0)), stamp_ns=make.stamp(at_ms + 500))
        wheel = replace(make.transform("base_link", "wheel", (0, at_ms, 0)), stamp_ns=make.stamp(at_ms + 700))
        for transform in (moved, other, wheel):
            frames += sync.push("/tf", None, make.stamp(at_ms + 20), transform)
        if at_ms == 1000:
            frames += sync.push(SCANS, None, make.stamp(1025), make.scan(1000))
    (frame,) = frames
    assert (frame.sensors.frame_id, frame.sensors.vehicle_frame_id) == ("odom", "base_link")
    np.testing.assert_allclose(frame.sensors.map_from_vehicle[:3, 3], [2, 1, 0.3], atol=1e-9)
    np.testing.assert_allclose(frame.vehicle_state, [2, 1, 0, 2, 0], atol=1e-6)


@pytest.mark.parametrize("stamp_ms", [500, None], ids=["ahead", "none"])
def test_mounts_among_the_transforms_that_move_the_vehicle_are_no_poses(make, stamp_ms):
    """As ROS 1 logs mounts: again and again, half a second ahead; others give them no stamp."""
    refusals = Refusals()
    sync, frames = TimeSync((), SyncSettings(), refusals, moving="/tf"), []
    for at_ms in range(900, 1200, 10):
        mounts = (make.transform("base_footprint", "base_link", (0, 0, 0.3)), make.transform("base_link", "lidar"))
        stamp_ns = 0 if stamp_ms is None else make.stamp(at_ms + stamp_ms)
        moved = replace(make.transform("odom", "base_footprint", (2e-3 * at_ms, 1, 0)), stamp_ns=make.stamp(at_ms))
        for transform in (*(replace(mount, stamp_ns=stamp_ns) for mount in mounts), moved):
            if at_ms == 900:
                sync.take_static("/tf", None, transform, refusals)
            else:
                frames += sync.push("/tf", None, make.stamp(at_ms + 20), transform)
        if at_ms == 1000:
            frames += sync.push(SCANS, None, make.stamp(1025), make.scan(1000))
    (frame,) = frames
    np.testing.assert_allclose(frame.sensors.map_from_vehicle[:3, 3], [2, 1, 0.3], atol=1e-9)
    assert (frame.epoch, refusals.total) == (0, 0)


def test_the_moving_link_nearest_to_the_vehicle_says_when(make):
    """map <- odom is corrected now and then, and stamped ahead; odom <- base_link is what drives."""
    sync, frames = TimeSync((), SyncSettings(odometry_frame="map"), Refusals(), moving="/tf"), []
    sync.take_static("/tf_static", None, make.transform("base_link", "lidar"), Refusals())
    for at_ms in range(800, 1200, 10):
        moved = replace(make.transform("odom", "base_link", (2e-3 * at_ms, 1, 0)), stamp_ns=make.stamp(at_ms))
        drift_m = 50 + (at_ms > 850)
        fixed = replace(make.transform("map", "odom", (drift_m, 0, 0)), stamp_ns=make.stamp(at_ms + 105))
        for transform in (fixed, moved):
            frames += sync.push("/tf", None, make.stamp(at_ms + 20), transform)
        if at_ms == 1000:
            frames += sync.push(SCANS, None, make.stamp(1025), make.scan(1000))
    (frame,) = frames
    np.testing.assert_allclose(frame.sensors.map_from_vehicle[:3, 3], [53, 1, 0], atol=1e-9)


def test_a_root_frame_can_be_chosen(make):
    sync = TimeSync((), SyncSettings(odometry_frame="map"), Refusals(), moving="/tf")
    sync.take_static("/tf", None, make.transform("map", "odom", (50, 0, 0)), Refusals())
    sync.take_static("/tf", None, make.transform("base_link", "lidar"), Refusals())
    frames = []
    for at_ms in (900, 1000, 1100):
        moved = replace(make.transform("odom", "base_link", (1, 0, 0)), stamp_ns=make.stamp(at_ms))
        frames += sync.push("/tf", None, make.stamp(at_ms), moved)
        if at_ms == 1000:
            frames += sync.push(SCANS, None, make.stamp(1025), make.scan(1000))
    assert frames[0].sensors.frame_id == "map"
    assert frames[0].sensors.map_from_vehicle[0, 3] == 51


def test_points_become_clusters_on_the_way(make):
    """A post in front of the sensor, and the ground under it."""
    sync = TimeSync((), SyncSettings(), Refusals())
    sync.take_static("/tf_static", None, make.transform("base_link", "lidar", (0, 0, 1.4)), Refusals())
    grid = np.stack(np.meshgrid(np.arange(-15, 15, 0.3), np.arange(-15, 15, 0.3)), axis=-1).reshape(-1, 2)
    ground = np.column_stack([grid, np.full(len(grid), -1.4)])
    angle, height = np.meshgrid(np.linspace(0, 6, 40), np.linspace(-1.2, 0.3, 16))
    post = np.column_stack([6 + 0.2 * np.cos(angle.ravel()), 0.2 * np.sin(angle.ravel()), height.ravel()])
    frames = []
    for at_ms in (900, 1000, 1100):
        frames += sync.push(POSES, None, make.stamp(at_ms), make.pose(at_ms))
        if at_ms == 1000:
            cloud = PointCloud(make.stamp(1000), "lidar", np.concatenate([ground, post]))
            frames += sync.push("/points", None, make.stamp(1010), cloud)
    (frame,) = frames
    np.testing.assert_allclose(frame.sensors.clusters.centroids_m[:, :2], [[6, 0]], atol=0.1)


@pytest.mark.parametrize(
    ("frame", "x"),
    [("odom", 3.0), ("lidar", 3.0 + 2.0 + 1.2), ("map", 13.0)],
    ids=["pose's", "on the vehicle", "joined"],
)
def test_tracks_come_in_any_frame_that_is_joined_to_the_pose(make, frame, x):
    sync = TimeSync((), SyncSettings(), Refusals())
    sync.take_static("/tf_static", None, make.transform("base_link", "lidar", (1.2, 0, 1.4)), Refusals())
    sync.take_static("/tf", None, make.transform("odom", "map", (10, 0, 0)), Refusals())
    tracks, frames = TrackFrame(0, make.stamp(1000), frame), []
    for at_ms in (900, 1000, 1100):
        frames += sync.push(POSES, None, make.stamp(at_ms), make.pose(at_ms))
        if at_ms == 1000:
            frames += sync.push("/tracks", None, make.stamp(1010), tracks)
    (found,) = frames
    assert found.objects is tracks
    assert (found.sensors.map_from_lidar @ [3, 0, 0, 1])[0] == pytest.approx(x)
    assert len(found.sensors.clusters.points) == 0


def test_tracks_may_hang_from_the_vehicle_by_another_of_its_frames(make):
    """The pose is the IMU's, the tracks are in base_link, which has the IMU on it; transforms also say where it is."""
    sync, frames = TimeSync((), SyncSettings(), Refusals()), []
    sync.take_static("/tf_static", None, make.transform("base_link", "imu", (0.5, 0, 0.3)), Refusals())
    for at_ms in range(900, 1200, 10):
        moved = make.transform("odom", "base_link", (2e-3 * at_ms - 0.5, 0, -0.3))
        frames += sync.push("/tf", None, make.stamp(at_ms), moved)
        frames += sync.push(POSES, None, make.stamp(at_ms), make.pose(at_ms, child="imu"))
        if at_ms == 1000:
            frames += sync.push("/tracks", None, make.stamp(1010), TrackFrame(0, make.stamp(1000), "base_link"))
    (found,) = frames
    np.testing.assert_allclose(found.sensors.map_from_lidar[:3, 3], [1.5, 0, -0.3], atol=1e-9)


def test_waiting_scans_are_released_when_time_passes_without_a_message(rig, make):
    r = rig()
    r.poses(*range(900, 1020, 10))
    r.scan(1000)
    assert list(r.sync.advance(make.stamp(1319))) == []
    (frame,) = r.sync.advance(make.stamp(1320))
    assert frame.sensors.stamp_ns == make.stamp(1000)
    assert frame.log_time_ns == make.stamp(1320)


@pytest.mark.parametrize("late", [("/gmsl/A1/detections",), (SCANS, "/simulation/ground_truth")], ids=["A1", "LiDAR"])
def test_an_offset_undoes_wrong_stamps_to_the_last_bit(drive, model, edit_log, shift_stamps, digest, results, late):
    path = edit_log(drive, shift_stamps(80, *late))
    for offsets_ms, mended in (({late[0]: -80}, True), ({}, False)):
        run = Replay(
            [path], ReplaySettings(sync=SyncSettings(time_offset_ms=offsets_ms)), PredictorChoice("inline", model)
        )
        with run:
            found = list(run)
        assert (digest(found) == digest(results)) is mended
        assert all(result.ground_truth is not None for result in found)
