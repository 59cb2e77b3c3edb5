"""Frames taken apart: hand-made scenes whose every reason is known, a drive that has to add up, spells by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from replay.frame_result import FrameResult
from replay.inspection import (
    BoxReport,
    ClusterReport,
    FrameReport,
    Miss,
    Outcome,
    PersonReport,
    inspect,
    inspect_frames,
)
from replay.inspection_summary import InspectionLog
from replay.inspection_view import velocities
from replay.pipeline import FrameTracker
from replay.reprojection import reproject
from replay.score import match
from replay.session import Replay, ReplaySettings
from replay.time_sync import SyncedFrame
from schemas.messages import LidarClusters
from tracking.camera import CameraModel
from tracking.fusion import FusionParams
from tracking.geometry import apply, inverse
from tracking.pipeline import TrackingSettings
from tracking.sensor_frame import CameraFrame, SensorFrame

SETTINGS = TrackingSettings()
PERSON, WALL = (0.5, 0.3, 1.7), (4.0, 0.5, 2.5)
# A camera 1.7 m above the vehicle's origin that looks ahead: x is to the right, y down, z ahead.
CAMERA_FROM_MAP = np.array([[0.0, -1, 0, 0], [0, 0, -1, 1.7], [1, 0, 0, 0], [0, 0, 0, 1]])


class Scene:
    """A standing vehicle at the origin; clusters, boxes and people as they are told, ten times a second."""

    def __init__(self, make, settings=SETTINGS):
        self.make, self.settings, self.tracker, self.at_ms = make, settings, FrameTracker(settings), 0

    def frame(self, clusters=(), boxes=(), people=(), lidar_points=40):
        """A frame of clusters (x, y, size), boxes (x_min, y_min, x_max, y_max) and people (id, x, y)."""
        self.at_ms += 100
        stamp_ns = self.make.stamp(self.at_ms)
        centroids = np.array([(x, y, size[2] / 2) for x, y, size in clusters], float).reshape(-1, 3)
        sizes = np.array([size for *_, size in clusters], float).reshape(-1, 3)
        scan = LidarClusters(stamp_ns, "lidar", centroids, sizes, np.full(len(clusters), 40))
        model = CameraModel.from_calibration(self.make.calibration())
        camera = CameraFrame("A0", self.make.boxes(self.at_ms, boxes), model, CAMERA_FROM_MAP)
        sensors = SensorFrame(stamp_ns, scan, np.eye(4), np.eye(4), (camera,), "odom")
        truth = self.make.truth(self.at_ms, people, lidar_points)
        return SyncedFrame(stamp_ns, 0, sensors, np.zeros(5), {}, truth)

    def box(self, x, y, *, right_px=0.0, taller=1.0):
        """The box of a person at a place; moved to the right, or so many times as high."""
        people = reproject(self.frame().sensors, np.array([[x, y]]), np.zeros((1, 2)), SETTINGS.fusion)
        self.at_ms -= 100
        x0, y0, x1, y1 = people.corners_px[:, 0]
        return x0 + right_px, y1 - taller * (y1 - y0), x1 + right_px, y1

    def step(self, *arguments, **options) -> FrameReport:
        frame = self.frame(*arguments, **options)
        candidates = self.tracker.explain(frame)
        measurements, tracks = self.tracker.step(frame)
        labels, at_s = self.tracker.labels(), self.at_ms / 1e3
        return inspect(frame, candidates, measurements, tracks, labels, self.settings, at_s=at_s).report

    def after(self, steps, *arguments, **options) -> FrameReport:
        return [self.step(*arguments, **options) for _ in range(steps)][-1]


@pytest.fixture
def scene(make):
    return Scene(make)


# --- clusters and boxes -----------------------------------------------------------------------------------------------


def test_a_person_with_a_box_is_unconfirmed_and_then_tracked(scene):
    ahead = ([(8, 1, PERSON)], [scene.box(8.1, 1)])
    first = scene.step(*ahead, [(7, 8.1, 1)])
    (cluster,) = first.clusters
    assert (cluster.outcome, cluster.reason) == (Outcome.UNCONFIRMED, "unconfirmed: 1 hit of 2")
    (person,) = first.people
    assert (person.miss, person.reason) == (Outcome.UNCONFIRMED, "cluster 0: unconfirmed: 1 hit of 2")

    later = scene.after(5, *ahead, [(7, 8.1, 1)])
    (cluster,) = later.clusters
    assert (cluster.outcome, cluster.track_id, cluster.reason) == (Outcome.TRACKED, 1, "track 1")
    (matched,) = cluster.boxes
    assert (matched.camera, matched.box, matched.score) == ("A0", 0, 0.9)
    assert (matched.fit, matched.overlap) == (pytest.approx(1.1, abs=0.1), pytest.approx(1.0, abs=0.1))
    assert matched.height_log_ratio == pytest.approx(0.0, abs=0.05)
    assert (cluster.ahead_m, cluster.left_m) == pytest.approx((8.1, 1.0), abs=0.05)
    assert (cluster.width_m, cluster.height_m, cluster.points) == pytest.approx((np.hypot(0.5, 0.3), 1.7, 40))
    assert cluster.label is not None
    (box,) = later.boxes
    assert (box.cluster, box.outcome, box.why) == (0, "tracked", "track 1")
    (person,) = later.people
    assert (person.track_id, person.miss, person.reason) == (1, None, "track 1")
    assert later.tracks == 1


def test_a_wall_gives_no_birth_and_a_pole_without_a_box_is_no_pedestrian(scene):
    report = scene.after(6, [(10, 4, WALL), (8, -2, PERSON)])
    by_row = {cluster.cluster: cluster for cluster in report.clusters}
    assert by_row[0].outcome is Outcome.NO_BIRTH
    assert by_row[0].reason.startswith("gives no birth: .0")
    assert by_row[0].reason.endswith(" < .03")
    assert by_row[0].size_log_odds < -3
    assert by_row[1].outcome is Outcome.NO_PEDESTRIAN
    assert by_row[1].reason.endswith(" < .40")
    assert by_row[1].size_log_odds == pytest.approx(SETTINGS.fusion.base_log_odds)


@pytest.mark.parametrize(
    ("box", "outcome", "words"),
    [
        ({"right_px": 85}, "overlap", "cluster 0: overlap .0"),
        ({"taller": 1.6}, "height ratio", "cluster 0: height log ratio .47 > .35"),
        ({"taller": 0.6}, "height ratio", "cluster 0: height log ratio -.51 < -.35"),
    ],
    ids=["aside", "too tall", "too small"],
)
def test_a_box_that_fits_no_cluster_says_what_kept_them_apart(scene, box, outcome, words):
    report = scene.step([(8, 1, PERSON)], [scene.box(8.12, 1.015, **box)])
    (found,), (cluster,) = report.boxes, report.clusters
    assert (found.cluster, found.outcome) == (None, outcome)
    assert found.why.startswith(words)
    assert cluster.boxes == ()
    assert [(f"cluster 0: {miss.why}", miss.fit) for miss in cluster.near_misses] == [(found.why, 0.0)]


def test_a_box_far_from_every_cluster_is_a_camera_s_alone(scene):
    report = scene.step([(8, 1, PERSON)], [scene.box(8.12, 1.015, right_px=600)])
    (box,), (alone,) = report.boxes, [each for each in report.clusters if each.cluster < 0]
    assert (box.cluster, box.outcome) == (-1, Outcome.ONE_CAMERA)
    assert alone.reason == box.why == "no cluster near; one camera alone gives no birth"
    assert [(each.camera, each.box, each.fit) for each in alone.boxes] == [("A0", 0, None)]


def test_a_box_without_a_cluster_where_boxes_alone_do_not_count(make):
    scene = Scene(make, TrackingSettings(fusion=FusionParams(camera_only=False)))
    report = scene.step([(8, 1, PERSON)], [scene.box(8.12, 1.015, right_px=600)])
    (box,) = report.boxes
    assert (box.cluster, box.outcome, box.why) == (None, "no cluster near", "no cluster near")
    assert report.clusters[0].near_misses == ()


def test_two_boxes_on_one_person_one_is_lost_to_the_other(scene):
    report = scene.step([(8, 1, PERSON)], [scene.box(8.12, 1.015), scene.box(8.12, 1.015, right_px=12)])
    matched, lost = sorted(report.boxes, key=lambda box: box.cluster is None)
    assert (matched.box, matched.cluster) == (0, 0)
    assert (lost.outcome, lost.why) == ("lost to another box", "cluster 0: lost to box 0")
    (miss,) = report.clusters[0].near_misses
    assert (miss.box, miss.why) == (1, "another box fits better")
    assert 0 < miss.fit < report.clusters[0].boxes[0].fit


def test_boxes_of_other_things_are_no_ones(scene):
    frame = scene.frame([(8, 1, PERSON)], [scene.box(8.12, 1)])
    (camera,) = frame.sensors.cameras
    cars = replace(camera, detections=replace(camera.detections, labels=("car",)))
    frame = replace(frame, sensors=replace(frame.sensors, cameras=(cars,)))
    candidates = scene.tracker.explain(frame)
    measurements, tracks = scene.tracker.step(frame)
    found = inspect(frame, candidates, measurements, tracks, scene.tracker.labels(), SETTINGS, at_s=0.0)
    assert found.report.boxes == ()


def test_a_cluster_that_is_no_number_is_refused(scene):
    report = scene.step([(8, 1, PERSON), (np.nan, 1, PERSON)])
    assert [(c.cluster, c.outcome) for c in report.clusters if c.outcome is Outcome.REFUSED] == [(1, Outcome.REFUSED)]


def test_a_refused_cluster_is_told_from_the_vehicle_and_a_refused_box_not_at_all(scene):
    """The LiDAR sits 1 m ahead of the vehicle's origin and looks to the left; a size below 0 is impossible."""
    frame = scene.frame([(8, 1, PERSON), (5, 2, (-1.0, 0.3, 1.7))])
    lidar = np.eye(4)
    lidar[:2, :2], lidar[0, 3] = [[0, -1], [1, 0]], 1.0
    frame = replace(frame, sensors=replace(frame.sensors, map_from_lidar=lidar))
    measurements, tracks = scene.tracker.step(frame)
    measurements = replace(measurements, refused_cluster_index=np.array([-1, 1]), refused=2)
    found = inspect(frame, (), measurements, tracks, scene.tracker.labels(), SETTINGS, at_s=0.0)
    (refused,) = [each for each in found.report.clusters if each.outcome is Outcome.REFUSED]
    assert (refused.cluster, refused.points) == (1, 40)
    assert (refused.ahead_m, refused.left_m) == pytest.approx((1 - 2, 5))


# --- people and tracks ------------------------------------------------------------------------------------------------


def test_a_track_without_a_measurement_is_listed_and_still_stands_for_its_person(scene):
    scene.after(8, [(8, 1, PERSON)], [scene.box(8.12, 1.015)], [(7, 8.12, 1)])
    report = scene.step([], [], [(7, 8.12, 1)])
    (track,) = report.unmeasured
    assert (track.id, track.ahead_m) == (1, pytest.approx(8.12, abs=0.1))
    assert 0 < track.existence <= 1
    assert 0 <= track.hidden <= 1
    assert report.people[0].miss is None


def test_why_people_are_missed(scene):
    boxes = [scene.box(8.12, 1.015)]
    report = scene.after(8, [(8, 1, PERSON)], boxes, [(7, 8.12, 1.0), (8, 8.12, 1.4), (9, 20, 5)])
    by_id = {person.id: person for person in report.people}
    assert by_id[7].miss is None
    assert (by_id[8].miss, by_id[8].reason) == (Miss.SHARED, "cluster 0 is person 7's, too: track 1")
    assert by_id[9].miss == Miss.NO_CLUSTER
    assert by_id[9].reason.startswith("no cluster within 0.7 m, the nearest is 12.5 m away")
    report = scene.step([(8, 1, PERSON)], boxes, [(9, 20, 5)], lidar_points=3)
    assert (report.people[0].miss, report.people[0].reason) == (Miss.FEW_POINTS, "3 LiDAR points")


def test_people_are_told_from_the_vehicle(scene):
    frame = scene.frame([], [], [(7, 3.0, 4.0)])
    turned = np.eye(4)
    turned[:2, :2] = [[0, -1], [1, 0]]  # the vehicle looks along y
    turned[:3, 3] = [3, 0, 2]
    frame = replace(frame, sensors=replace(frame.sensors, map_from_vehicle=turned))
    measurements, tracks = scene.tracker.step(frame)
    (person,) = inspect(frame, (), measurements, tracks, scene.tracker.labels(), SETTINGS, at_s=0.0).report.people
    assert (person.ahead_m, person.left_m, person.range_m) == pytest.approx((4.0, 0.0, 4.0))


def lifted(pose):
    """A pose in an odometry frame that began on a slope: 200 m up, and nose down by 4 degrees."""
    lean = np.eye(4)
    lean[:3, :3] = Rotation.from_rotvec([0, np.radians(4.0), 0]).as_matrix()
    lean[2, 3] = 200.0
    return lean @ pose


def test_where_the_map_lies_and_how_it_leans_moves_nobody_in_the_image(scene):
    level = scene.frame().sensors
    (camera,) = level.cameras
    tilted = replace(
        level,
        map_from_vehicle=lifted(np.eye(4)),
        cameras=(replace(camera, camera_from_map=CAMERA_FROM_MAP @ inverse(lifted(np.eye(4)))),),
    )
    places = np.array([[6.0, 0], [10, 3], [20, -4]])
    up_there = apply(lifted(np.eye(4)), np.column_stack([places, np.zeros(3)]))[:, :2]
    standing = np.zeros((3, 2))
    there = reproject(level, places, standing, SETTINGS.fusion).corners_px
    leaning = reproject(tilted, up_there, standing, SETTINGS.fusion).corners_px
    assert leaning == pytest.approx(there, abs=20)  # they stand upright and the camera does not: half a shoulder
    assert leaning[3] == pytest.approx(there[3], abs=3)  # feet


def test_people_on_a_slope_are_as_far_ahead_as_on_the_level(scene):
    frame = scene.frame()
    frame = replace(frame, sensors=replace(frame.sensors, map_from_vehicle=lifted(np.eye(4))))
    (place,) = apply(lifted(np.eye(4)), np.array([[30.0, 4.0, 0.0]]))[:, :2].tolist()
    frame = replace(frame, ground_truth=scene.make.truth(scene.at_ms, [(7, *place)]))
    measurements, tracks = scene.tracker.step(frame)
    (person,) = inspect(frame, (), measurements, tracks, scene.tracker.labels(), SETTINGS, at_s=0.0).report.people
    assert (person.ahead_m, person.left_m) == pytest.approx((30.0, 4.0))


def test_of_two_labels_of_one_measurement_the_older_gives_the_velocity():
    labels = SimpleNamespace(measurement=np.array([1, -1, 1]), states=np.arange(12.0).reshape(3, 4))
    assert velocities(labels, 2).tolist() == [[0, 0], [2, 3]]


# --- a whole drive ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def inspected(drive):
    run = Replay([drive])
    return list(inspect_frames(run))


def test_a_drive_adds_up(inspected, results):
    assert [each.report.stamp_ns for each in inspected] == [result.tracks.stamp_ns for result in results]
    for each, result in zip(inspected, results, strict=True):
        assert [track.id for track in each.tracks.tracks] == [track.id for track in result.tracks.tracks]
        _adds_up(each.report, result)


def _adds_up(report: FrameReport, result: FrameResult) -> None:
    clusters = [cluster for cluster in report.clusters if cluster.outcome is not Outcome.REFUSED]
    assert sorted(c.cluster for c in clusters) == sorted(result.measurements.cluster_index.tolist())
    assert [c.range_m for c in report.clusters] == sorted(c.range_m for c in report.clusters)
    behind = {(b.camera, b.box): c.cluster for c in clusters for b in c.boxes}
    assert {(b.camera, b.box): b.cluster for b in report.boxes if b.cluster is not None} == behind
    assert len({(b.camera, b.box) for b in report.boxes}) == len(report.boxes)
    ids = [c.track_id for c in clusters if c.outcome is Outcome.TRACKED] + [t.id for t in report.unmeasured]
    assert sorted(ids) == sorted(track.id for track in result.tracks.tracks)
    matched = set(match(result.tracks.tracks, result.ground_truth).tolist()) - {-1}
    assert {person.id for person in report.people if person.miss is None} == matched
    assert len(report.people) == len(result.ground_truth.ids)


def test_inspecting_changes_no_track(digest, results, inspected):
    """`explain` before `step` is free of side effects: tracks are those of the replay, to the last bit."""
    seen = [replace(result, tracks=each.tracks) for each, result in zip(inspected, results, strict=True)]
    assert digest(seen) == digest(results)


# --- spells -----------------------------------------------------------------------------------------------------------


def person(id_, miss=None, track=1, points=40):
    return PersonReport(id_, 5.0, 0.0, 5.0, points, 0 if miss else track, miss, "")


def frame(at_s, people=None, clusters=(), boxes=(), *, stamp_s=None, epoch=0):
    stamp_ns = round((at_s if stamp_s is None else stamp_s) * 1e9)
    return FrameReport(at_s, stamp_ns, epoch, ("A0",), 0, tuple(clusters), tuple(boxes), (), people)


def summary_of(*frames):
    log = InspectionLog()
    for each in frames:
        log.add(each)
    return log.summary()


def test_a_person_missed_for_a_while_by_hand():
    """Tracked to 1.0 s, missed at 1.1 to 1.3 s, then tracked under another id."""
    times = [(0.1 * i, None, 1) for i in range(11)]
    times += [(1.1, Miss.NO_CLUSTER, 0), (1.2, Outcome.UNCONFIRMED, 0), (1.3, Miss.NO_CLUSTER, 0), (1.4, None, 4)]
    found = summary_of(*(frame(at, (person(7, miss, track),)) for at, miss, track in times))
    (one,) = found.people
    assert (one.id, one.track_ids) == (7, (1, 4))
    assert (one.seen_s, one.missed_s) == pytest.approx((1.4, 0.3))
    assert (one.longest.from_s, one.longest.to_s) == pytest.approx((1.0, 1.3))
    assert (one.longest.look_at_s, one.longest.reason) == (pytest.approx(1.2), Miss.NO_CLUSTER)
    assert one.reasons == pytest.approx({Miss.NO_CLUSTER: 0.2, Outcome.UNCONFIRMED: 0.1})
    assert list(found.reasons) == [Miss.NO_CLUSTER, Outcome.UNCONFIRMED]
    (switch,) = found.switches
    assert (switch.at_s, switch.person, switch.before, switch.after) == (pytest.approx(1.4), 7, 1, 4)
    assert (found.frames, found.from_s, found.to_s) == (15, 0.0, pytest.approx(1.4))


def test_who_has_too_few_points_is_not_missed_and_ends_a_spell():
    missing = [frame(0.1 * i, (person(7, Miss.NO_CLUSTER),)) for i in range(4)]
    hidden = [frame(0.1 * i, (person(7, Miss.FEW_POINTS, points=2),)) for i in range(4, 10)]
    again = [frame(0.1 * i, (person(7, Miss.NO_CLUSTER),)) for i in range(10, 12)]
    (one,) = summary_of(*missing, *hidden, *again).people
    assert one.missed_s == pytest.approx(0.5)
    assert one.longest.to_s == pytest.approx(0.3)


def test_frames_that_were_released_together_last_as_long_as_their_scans():
    """Nothing was logged for a second, and then ten scans at once; seconds are those between the scans."""
    missing = [frame(2.0, (person(7, Miss.NO_CLUSTER),), [cluster()], [box()], stamp_s=50 + 0.1 * i) for i in range(11)]
    found = summary_of(*missing)
    (one,) = found.people
    assert (one.seen_s, one.missed_s, one.longest.length_s) == pytest.approx((1.0, 1.0, 1.0))
    assert one.longest.look_at_s == 2.0
    assert [each.spell.length_s for each in (*found.boxes, *found.clusters)] == pytest.approx([1.0, 1.0])


def test_a_clock_reset_takes_no_time():
    before = [frame(0.1 * i, (person(7, Miss.NO_CLUSTER),), stamp_s=50 + 0.1 * i) for i in range(3)]
    after = [frame(0.3 + 0.1 * i, (person(7, Miss.NO_CLUSTER),), stamp_s=20 + 0.1 * i, epoch=1) for i in range(3)]
    (one,) = summary_of(*before, *after).people
    assert one.missed_s == pytest.approx(0.4)
    assert one.longest.length_s == pytest.approx(0.5)


def test_whom_nobody_missed_has_no_spell_and_the_worst_come_first():
    found = summary_of(*(frame(0.1 * i, (person(1), person(2, Miss.NO_CLUSTER), person(3))) for i in range(5)))
    assert [one.id for one in found.people] == [2, 1, 3]
    assert found.people[1].longest is None
    assert found.missed_s == pytest.approx(0.4)


def box(right_px=0.0, score=0.9, outcome="no cluster near"):
    return BoxReport("A0", 0, score, (100 + right_px, 100, 140 + right_px, 200), None, outcome, "")


def cluster(probability=0.9, outcome=Outcome.UNCONFIRMED, label=(1, 0)):
    return ClusterReport(3, 0, 1, 8.0, 1.0, 8.1, 40, 0.6, 1.7, 0.3, (), (), probability, outcome, label, 0, "")


def test_boxes_and_clusters_without_tracks_are_followed():
    """A box that drifts to the right is one; one that jumps is another, and too short to tell of."""
    boxes = [frame(0.1 * i, None, [cluster()], [box(5.0 * i)]) for i in range(11)]
    found = summary_of(*boxes, frame(1.1, None, [], [box(500)]))
    assert not found.has_truth
    (one,) = found.boxes
    assert (one.camera, one.score, one.spell.reason) == ("A0", pytest.approx(0.9), "no cluster near")
    assert (one.spell.from_s, one.spell.to_s) == pytest.approx((0.0, 1.0))
    assert one.middle_px == pytest.approx((145.0, 150.0))
    (one,) = found.clusters
    assert (one.pedestrian_probability, one.spell.reason) == (pytest.approx(0.9), Outcome.UNCONFIRMED)
    assert one.spell.length_s == pytest.approx(1.0)


@pytest.mark.parametrize(
    "frames",
    [
        [frame(0.1 * i, None, [cluster()], [box()]) for i in range(4)],
        [frame(0.1 * i, None, [cluster(0.5)], [box(score=0.4)]) for i in range(20)],
        [frame(0.1 * i, None, [cluster(outcome=Outcome.TRACKED)], [box(outcome="tracked")]) for i in range(20)],
        [frame(1.0 * i, None, [cluster()], [box()]) for i in range(20)],
        [],
    ],
    ids=["short", "unlikely", "tracked", "now and then", "nothing"],
)
def test_what_is_not_worth_a_line(frames):
    found = summary_of(*frames)
    assert (found.boxes, found.clusters) == ((), ())


def test_the_warm_up_is_tracked(drive):
    """With --start the tracker has seen the 4 s before: the first frame to be shown has tracks."""
    run = Replay([drive], ReplaySettings(start_s=4.5, duration_s=0.3))
    shown = [each for each in inspect_frames(run) if each.frame.log_time_ns >= run.start_ns]
    assert shown[0].report.at_s == pytest.approx(4.5, abs=0.15)
    assert shown[0].report.tracks > 0
