"""Labels of a drive: late scans in order, whose measurements count, where trajectories end, and what comes of them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pcgan.clips import load_clip
from pcgan.dataset import WindowSpec, clip_windows
from pcgan.trajectory_file import load_trajectories, read_rows
from replay.errors import LogError, OutputError, Refusals
from replay.label import LabelSettings, in_order, label, part_of, save
from replay.pipeline import FrameTracker
from replay.session import Replay, ReplaySettings
from replay.simulator import simulate
from replay.simulator.sensor_suite import CLUSTERS_TOPIC
from replay.time_sync import SyncedFrame
from tracking.pipeline import TrackingSettings
from tracking.sensor_frame import SensorFrame


@pytest.fixture
def frames(make):
    """Scans every 100 ms of one person who walks at 1.2 m/s, seen by the LiDAR alone, from a vehicle at 2 m/s."""

    def scan(i, epoch=0, late=False, nobody=False, truth=None):
        at_ms = 100 * i
        map_from_vehicle = np.eye(4)
        map_from_vehicle[0, 3] = 2e-3 * at_ms
        person = (8 + 1.2e-3 * at_ms - 2e-3 * at_ms, 1.0, 0.9)
        clusters = make.scan(at_ms, () if nobody else (person,))
        sensors = SensorFrame(make.stamp(at_ms), clusters, map_from_vehicle, map_from_vehicle, (), "odom")
        state = np.array([2e-3 * at_ms, 0, np.pi, 2.0, 0])
        return SyncedFrame(make.stamp(at_ms + 60), epoch, sensors, state, {}, truth, late)

    return scan


def run_of(frames, start=0):
    """What `label` needs of a Replay, with frames of our own."""
    begin = frames[0].sensors.stamp_ns
    return SimpleNamespace(
        frames=lambda: iter(frames),
        settings=ReplaySettings(),
        tracker=lambda: FrameTracker(TrackingSettings()),
        refusals=Refusals(),
        start_ns=begin + start * 100_000_000,
        reader=SimpleNamespace(start_ns=begin),
    )


@pytest.fixture(scope="module")
def labelled(drive):
    """The 6 s drive, labelled, and what its tracker said scan by scan: stamp and report."""
    run, reports = Replay([drive]), []
    tracker = FrameTracker(run.settings.tracking)
    for frame in run.frames():
        tracker.step(frame)
        reports.append((frame, tracker.labels()))
    return SimpleNamespace(result=label(Replay([drive])), reports=reports)


# --- the order of scans ----------------------------------------------------------------------------------------------


def test_late_scans_are_put_where_they_belong(frames):
    given = [frames(i) for i in range(12)]
    shuffled = [*given[:3], *given[4:8], replace(given[3], late=True), *given[8:]]
    refusals = Refusals()
    assert [f.sensors for f in in_order(shuffled, 8, refusals)] == [f.sensors for f in given]
    assert refusals.total == 0


@pytest.mark.parametrize("depth", [1, 3, 8])
def test_no_more_frames_are_held_back_than_asked_for(frames, depth):
    seen = []

    def stream():
        for i in range(12):
            seen.append(i)
            yield frames(i)

    next(in_order(stream(), depth, Refusals()))
    assert len(seen) == depth + 1


def test_what_is_later_than_that_is_refused(frames):
    given = [frames(i) for i in range(12)]
    refusals = Refusals()
    done = list(in_order([given[0], *given[2:], replace(given[1], late=True)], 3, refusals))
    assert done == [given[0], *given[2:]]
    assert refusals.as_json() == [{"topic": "scans", "reason": "scan too late to use", "count": 1}]


def test_an_epoch_ends_before_the_next_begins(frames):
    given = [*(frames(i) for i in range(5, 10)), *(frames(i, epoch=1) for i in range(5))]
    assert list(in_order(given, 8, Refusals())) == given


def test_a_scan_that_came_late_changes_nothing(drive, edit_log, labelled):
    def delay(log, by):
        scans = [i for i, (topic, *_) in enumerate(log) if topic == CLUSTERS_TOPIC]
        topic, at, data = log.pop(scans[20])
        return sorted([*log, (topic, at + by, data)], key=lambda message: message[1])

    run = Replay([edit_log(drive, lambda log: delay(log, 600_000_000), "late.mcap")])
    rows, expected = label(run).rows, labelled.result.rows
    assert run.refusals.total == 0
    np.testing.assert_array_equal(rows.stamps_ns, expected.stamps_ns)
    np.testing.assert_array_equal(rows.states, expected.states)
    run = Replay([edit_log(drive, lambda log: delay(log, 2_000_000_000), "too_late.mcap")])
    fewer = label(run)
    assert run.refusals.total == 1
    assert fewer.scans == labelled.result.scans - 1


# --- what a label is made of -----------------------------------------------------------------------------------------


def test_rows_have_everybody_and_the_vehicle(labelled):
    rows, reports = labelled.result.rows, labelled.reports
    assert (np.lexsort((rows.ids, rows.stamps_ns)) == np.arange(len(rows.ids))).all()
    assert len(np.unique(np.stack([rows.ids, rows.stamps_ns]), axis=1).T) == len(rows.ids)
    np.testing.assert_array_equal(np.unique(rows.stamps_ns), [frame.sensors.stamp_ns for frame, _ in reports])
    assert np.isfinite(rows.vehicles).all()
    vehicle = {frame.sensors.stamp_ns: frame.vehicle_state for frame, _ in reports}
    states = np.array([vehicle[stamp] for stamp in rows.stamps_ns.tolist()])
    np.testing.assert_array_equal(rows.vehicles[:, :3], states[:, :3])
    np.testing.assert_allclose(rows.vehicles[:, 3], np.hypot(states[:, 3], states[:, 4]), atol=0.05)
    xx, xy, yy = rows.position_covs[rows.people].T
    assert (xx * yy - xy**2 > 0).all()
    published = {id for _, report in reports for id in report.ids.tolist()}
    assert set(rows.ids[rows.people].tolist()) <= published


def test_measurements_from_before_a_track_was_published_count(labelled):
    rows, reports = labelled.result.rows, labelled.reports
    born_ns, published_ns = {}, {}
    for frame, report in reports:
        for name, id in zip(report.names, report.ids.tolist(), strict=True):
            born_ns[id] = name[0]
            published_ns.setdefault(id, frame.sensors.stamp_ns)
    ids = np.unique(rows.ids[rows.people]).tolist()
    earlier = [born_ns[id] == rows.stamps_ns[rows.ids == id][0] < published_ns[id] for id in ids]
    assert sum(earlier) > 3  # all but those of whom an early stretch was too short


def test_labels_are_nearer_the_truth_than_the_tracker(labelled):
    tracker, labels = labelled.result.score["tracker"], labelled.result.score["labels"]
    assert labels.moments == tracker.moments > 200
    assert labels.position_m < 0.9 * tracker.position_m
    assert labels.velocity_mps < 0.7 * tracker.velocity_mps
    assert labels.precision > 0.97
    assert labels.recall > 0.9


def test_a_walk_is_found_again(frames):
    run = run_of([frames(i) for i in range(40)])
    result = label(run)
    rows = result.rows
    assert (result.scans, result.tracks, result.tracks_kept, result.trajectories) == (40, 1, 1, 1)
    assert len(rows.ids) == 40
    times = (rows.stamps_ns - rows.stamps_ns[0]) * 1e-9
    offset = rows.states[:, :2] - np.stack([8 + 1.2 * times, np.ones(40)], axis=1)
    np.testing.assert_allclose(offset, np.tile(offset.mean(axis=0), (40, 1)), atol=0.05)  # the centroid's bias is off
    np.testing.assert_allclose(rows.states[:, 2:], np.tile([1.2, 0], (40, 1)), atol=0.1)
    np.testing.assert_allclose(rows.vehicles[:, 3], -2.0)  # its yaw is pi: it drives backwards
    assert result.score is None


# --- where trajectories end, and which are left out ------------------------------------------------------------------


@pytest.mark.parametrize(("missing", "max_gap_s", "trajectories"), [(8, 0.5, 2), (8, 1.0, 1), (3, 0.5, 1), (3, 0.3, 2)])
def test_a_long_gap_cuts_and_gets_no_rows(frames, missing, max_gap_s, trajectories):
    result = label(
        run_of([frames(i, nobody=20 <= i < 20 + missing) for i in range(50)]), LabelSettings(max_gap_s=max_gap_s)
    )
    rows = result.rows
    assert (result.tracks, result.trajectories) == (1, trajectories)  # the tracker keeps its id through the gap
    assert len(np.unique(rows.ids[rows.people])) == 1
    scans = set(((rows.stamps_ns[rows.people] - rows.stamps_ns[0]) // 100_000_000).tolist())
    assert set(range(50)) - scans == (set(range(20, 20 + missing)) if trajectories == 2 else set())
    assert len(rows.ids) == 50  # where there is nobody, the vehicle has a row of its own


@pytest.mark.parametrize(
    ("settings", "kept"),
    [
        ({"min_duration_s": 1.9}, True),
        ({"min_duration_s": 2.0}, False),
        ({"min_hits": 20}, True),
        ({"min_hits": 21}, False),
        ({"min_published": 1.0}, False),  # nobody is published at the first sight
    ],
)
def test_short_and_doubtful_tracks_are_left_out(frames, settings, kept):
    result = label(run_of([frames(i, nobody=i >= 20) for i in range(30)]), LabelSettings(**settings))
    assert (result.tracks, result.tracks_kept) == (1, int(kept))
    assert result.rows.people.sum() == (20 if kept else 0)


def test_without_people_there_are_rows_of_the_vehicle(frames, tmp_path):
    result = label(run_of([frames(i, nobody=True) for i in range(15)]))
    assert len(result.rows.ids) == 15
    assert not result.rows.people.any()
    save(result.rows, tmp_path / "empty.csv")
    clip = load_trajectories(tmp_path / "empty.csv")
    assert clip.pedestrians == ()
    np.testing.assert_allclose(clip.vehicles[0].positions_m[-1], [2.8, 0])


def test_what_comes_before_the_start_is_known_but_not_written(frames):
    given = [frames(i) for i in range(40)]
    all_rows, rows = label(run_of(given)).rows, label(run_of(given, start=20)).rows
    assert rows.stamps_ns[0] == given[20].sensors.stamp_ns
    np.testing.assert_allclose(rows.states, all_rows.states[20:])


def test_a_log_that_begins_anew_may_be_labelled_from_there_on(frames):
    given = [*(frames(i) for i in range(10)), *(frames(i, epoch=1) for i in range(20))]
    run = run_of(given)
    wanted = [replace(frame, log_time_ns=frame.log_time_ns + (frame.epoch << 40)) for frame in given]
    run.frames, run.start_ns = lambda: wanted, run.start_ns + (1 << 39)
    result = label(run)
    assert (result.scans, result.tracks, result.trajectories) == (20, 1, 1)


def test_a_clock_that_is_set_back_is_an_error_that_says_where(frames):
    given = [*(frames(i) for i in range(10, 30)), *(frames(i, epoch=1) for i in range(20))]
    with pytest.raises(LogError, match=r"set back -?\d+\.\d s into the log: .* --duration and --start"):
        label(run_of(given))
    assert label(SimpleNamespace(**{**vars(run_of(given)), "start_ns": 0, "frames": lambda: given[:20]})).scans == 20


def test_clusters_that_fusion_drops_are_counted(frames):
    given = [frames(i) for i in range(10)]
    sensors = given[4].sensors
    far = replace(sensors.clusters, centroids_m=np.full((1, 3), 2e4))
    given[4] = replace(given[4], sensors=replace(sensors, clusters=far))
    run = run_of(given)
    label(run)
    (row,) = run.refusals.as_json()
    assert row["reason"] == "cluster out of reach, or of an impossible shape"


def test_no_scan_at_all_is_an_error():
    run = SimpleNamespace(
        frames=lambda: [],
        settings=ReplaySettings(),
        tracker=lambda: FrameTracker(TrackingSettings()),
        refusals=Refusals(),
        start_ns=0,
    )
    with pytest.raises(LogError, match="nothing to label"):
        label(run)


# --- the file, and the way round --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz", "a.parquet"])
def test_a_file_holds_the_rows_and_nothing_is_left_beside_it(labelled, tmp_path, name):
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    rows = labelled.result.rows
    save(rows, tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    back = read_rows(tmp_path / name)
    np.testing.assert_array_equal(back.ids, rows.ids)
    np.testing.assert_array_equal(back.states, rows.states)
    np.testing.assert_array_equal(back.position_covs, rows.position_covs)
    assert part_of(tmp_path / name).name == name.replace("a.", "a.part.")


def test_a_file_that_cannot_be_written_leaves_the_old_one(labelled, tmp_path, monkeypatch):
    (tmp_path / "a.csv").write_text("old")

    def fail_half_way(_, path):
        path.write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("replay.label.write_rows", fail_half_way)
    with pytest.raises(OutputError, match=r"a\.csv cannot be written: No space left"):
        save(labelled.result.rows, tmp_path / "a.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]
    assert (tmp_path / "a.csv").read_text() == "old"


def test_labels_are_trained_on_and_simulated_again(labelled, tmp_path):
    path = tmp_path / "labels.csv"
    save(labelled.result.rows, path)
    clip = load_clip(str(path))
    assert clip.rate_hz == 10
    assert len(clip.vehicles) == 1
    assert {p.id for p in clip.pedestrians} == set(labelled.result.rows.ids[labelled.result.rows.people].tolist())
    windows = clip_windows(clip, WindowSpec(observed_steps=8, predicted_steps=12, dt_s=0.1))
    assert len(windows) > 50
    assert windows.known.any()

    simulate(tmp_path / "again.mcap", clip=str(path), vehicle=None, pedestrians=0, duration_s=3.0, seed=1)
    again = label(Replay([tmp_path / "again.mcap"]))
    assert again.score["labels"].position_m < 0.1
    assert again.tracks_kept > 0
