"""Sensor frames -> tracks -> predictions, with a plain object as predictor: order, window, epochs, late scans."""

from collections import deque
from dataclasses import replace

import numpy as np
import pytest

from replay.errors import LogError, Refusals
from replay.pipeline import HISTORY_NS, FrameTracker, run_pipeline
from replay.time_sync import SyncedFrame
from schemas.messages import PredictionFrame
from tracking.pipeline import TrackingSettings
from tracking.sensor_frame import SensorFrame


class Echo:
    """Answers frames in order and remembers how many were unanswered."""

    restarts = 0

    def __init__(self):
        self.asked, self.most, self.poses = deque(), 0, []

    def ask(self, frame, pose):
        self.asked.append(frame)
        self.poses.append(pose)
        self.most = max(self.most, len(self.asked))

    def answer(self):
        frame = self.asked.popleft()
        return PredictionFrame(frame.sequence, frame.stamp_ns, frame.frame_id, "echo", 0.1)

    def close(self):
        pass


@pytest.fixture
def frames(make):
    """Scans of one walking person every 100 ms, seen by the LiDAR alone, from a vehicle that drives at 2 m/s."""

    def scan(i, epoch=0, late=False, at_ms=None):
        at_ms = 100 * i if at_ms is None else at_ms
        map_from_vehicle = np.eye(4)
        map_from_vehicle[0, 3] = 2e-3 * at_ms
        person = (8 + 1.2e-3 * at_ms - 2e-3 * at_ms, 1.0, 0.9)
        clusters = make.scan(at_ms, (person,))
        sensors = SensorFrame(make.stamp(at_ms), clusters, map_from_vehicle, map_from_vehicle, (), "odom")
        state = np.array([2e-3 * at_ms, 0, 0, 2.0, 0])
        return SyncedFrame(make.stamp(at_ms + 60), epoch, sensors, state, {}, None, late)

    return scan


def tracker():
    return FrameTracker(TrackingSettings())


def test_every_frame_gives_one_result_in_order(frames):
    given = [frames(i) for i in range(20)]
    results = list(run_pipeline(given, tracker(), Echo()))
    assert [r.tracks.sequence for r in results] == list(range(20))
    assert [r.tracks.stamp_ns for r in results] == [f.sensors.stamp_ns for f in given]
    assert [r.log_time_ns for r in results] == [f.log_time_ns for f in given]
    assert [r.predictions.sequence for r in results] == list(range(20))
    assert len(results[-1].tracks.tracks) == 1
    np.testing.assert_allclose(results[-1].tracks.tracks[0].state[:2], [8 + 1.2 * 1.9, 1.0], atol=0.2)
    assert len(results[-1].measurements) == 1


@pytest.mark.parametrize("window", [1, 3, 8, 100])
def test_at_most_a_window_of_frames_is_unanswered(frames, window, digest):
    predictor = Echo()
    results = list(run_pipeline((frames(i) for i in range(20)), tracker(), predictor, window=window))
    assert predictor.most == min(window, 20)
    assert digest(results) == digest(run_pipeline((frames(i) for i in range(20)), tracker(), Echo(), window=5))


def test_results_come_while_frames_still_do(frames):
    seen = []

    def stream():
        for i in range(20):
            seen.append(i)
            yield frames(i)

    results = run_pipeline(stream(), tracker(), Echo(), window=4)
    next(results)
    assert seen == [0, 1, 2, 3]


def test_unpublished_frames_warm_the_tracker_up_and_have_no_sequence(frames):
    given = [frames(i) for i in range(20)]
    results = list(
        run_pipeline(given, tracker(), Echo(), published=lambda f: f.sensors.stamp_ns >= given[10].sensors.stamp_ns)
    )
    full = list(run_pipeline(given, tracker(), Echo()))
    assert [r.tracks.sequence for r in results] == list(range(10))
    for warm, cold in zip(results, full[10:], strict=True):
        assert warm.tracks.stamp_ns == cold.tracks.stamp_ns
        np.testing.assert_array_equal(warm.tracks.tracks[0].state, cold.tracks.tracks[0].state)


def test_the_vehicle_history_is_the_last_3_6_seconds(frames):
    results = list(run_pipeline((frames(i) for i in range(60)), tracker(), Echo()))
    history = results[-1].tracks.vehicle_history
    assert history.stamps_ns[-1] == results[-1].tracks.stamp_ns
    assert history.stamps_ns[0] == results[-1].tracks.stamp_ns - HISTORY_NS
    assert len(history.stamps_ns) == 37
    np.testing.assert_allclose(history.states[-1], [2 * 5.9, 0, 0, 2, 0], atol=1e-9)


def test_the_pose_that_is_published_is_the_frames(frames):
    predictor = Echo()
    results = list(run_pipeline([frames(5)], tracker(), predictor))
    (pose,) = predictor.poses
    assert pose.stamp_ns == results[0].tracks.stamp_ns
    np.testing.assert_allclose(pose.position_m, [1.0, 0, 0])
    np.testing.assert_allclose(pose.velocity_mps, [2, 0, 0], atol=1e-12)
    np.testing.assert_allclose(results[0].vehicle_pose.position_m, pose.position_m)


def test_a_new_epoch_begins_with_a_new_tracker(frames):
    given = [frames(i) for i in range(15)] + [frames(i, epoch=1) for i in range(15)]
    results = list(run_pipeline(given, tracker(), Echo()))
    first = results[15]
    assert first.tracks.epoch == 1
    assert first.tracks.tracks == ()
    assert len(first.tracks.vehicle_history.stamps_ns) == 1
    assert [r.tracks.sequence for r in results] == list(range(30))  # goes on: answers are told apart by it
    assert results[14].tracks.tracks
    assert results[-1].tracks.tracks
    before, after = ({t.id for r in part for t in r.tracks.tracks} for part in (results[:15], results[15:]))
    assert max(before) < min(after)  # no id ever means two people


def test_clusters_that_fusion_drops_are_counted(frames):
    given = [frames(i) for i in range(6)]
    clusters = given[3].sensors.clusters
    far = replace(clusters, centroids_m=np.where(np.arange(3) == 0, 2e4, clusters.centroids_m))
    given[3] = replace(given[3], sensors=replace(given[3].sensors, clusters=far))
    refusals = Refusals()
    assert len(list(run_pipeline(given, tracker(), Echo(), refusals=refusals))) == 6
    assert refusals.total == len(clusters.points) > 0
    assert "cluster out of reach" in refusals.first[0]


def test_a_late_scan_gives_no_frame_but_is_taken_in(frames):
    """Scan 11 arrives after 12: no result of its own, and the track afterwards knows it."""
    in_order = [frames(i) for i in range(20)]
    late = [*in_order[:11], in_order[12], replace(in_order[11], late=True), *in_order[13:]]
    missing = [f for i, f in enumerate(in_order) if i != 11]
    refusals = Refusals()
    found = list(run_pipeline(late, tracker(), Echo(), refusals=refusals))
    assert [r.tracks.stamp_ns for r in found] == [f.sensors.stamp_ns for f in missing]
    assert refusals.total == 0
    with_it = list(run_pipeline(in_order, tracker(), Echo()))[13].tracks.tracks[0]
    without_it = list(run_pipeline(missing, tracker(), Echo()))[12].tracks.tracks[0]
    amended = found[12].tracks.tracks[0]
    assert np.abs(amended.state - with_it.state).max() < 0.3 * np.abs(without_it.state - with_it.state).max()
    assert np.trace(amended.covariance) < np.trace(without_it.covariance)


def test_a_scan_older_than_the_ring_is_refused_and_counted(frames):
    ring = TrackingSettings().tracker.ring
    given = [frames(i) for i in range(30)]
    late = frames(0, late=True, at_ms=100 * (29 - ring - 3) + 50)
    refusals = Refusals()
    found = list(run_pipeline([*given, late], tracker(), Echo(), refusals=refusals))
    assert len(found) == 30
    assert refusals.counts == {("scans", "scan too late to use"): 1}
    assert "scans at" in refusals.first[0]


def test_strict_stops_at_a_scan_too_late(frames):
    late = frames(0, late=True, at_ms=150)
    with pytest.raises(LogError, match="refused: scan too late to use; without --strict the run would go on"):
        list(run_pipeline([*(frames(i) for i in range(30)), late], tracker(), Echo(), refusals=Refusals(strict=True)))


def test_a_late_scan_of_an_epoch_that_is_over_is_left_out(frames, digest):
    given = [frames(i) for i in range(10)] + [frames(i, epoch=1) for i in range(10)]
    late = frames(8, epoch=0, late=True)
    assert digest(run_pipeline([*given[:15], late, *given[15:]], tracker(), Echo())) == digest(
        run_pipeline(given, tracker(), Echo())
    )


def test_no_frames_give_no_results():
    assert list(run_pipeline([], tracker(), Echo())) == []
