"""Worst moments of hand-made drives, where every error is known."""

import gc
import sys
import weakref
from dataclasses import replace

import numpy as np
import pytest

from replay.check_result import MomentKind
from replay.errors import OutputError
from replay.moment_people import clear_pairs
from replay.moment_ranking import turns
from replay.moments import Moments
from replay.score import ReplayScore, match
from schemas.messages import CompressedImage
from tracking.metrics import ScoredFrame, clear

P = 3  # predicted steps, 0.1 s each, as far apart as the frames
HORIZON_FRAMES = 3


def walk(i, person=0):
    return np.array([6.0 + 0.12 * i, 3.0 + 4 * person])


@pytest.fixture
def walkers(make):
    """Makes frames of people who walk straight on at 1.2 m/s, each tracked and predicted perfectly but for `off`.

    `off` maps (frame, person) to how far the predicted path is beside the right one, in m; track ids are 10 + person.
    """

    def made(count=30, people=1, off=(), truth=True, track_of=lambda _, person: 10 + person, **changes):
        off = dict(off)
        for i in range(count):
            tracks, predictions = [], []
            for person in range(people):
                track = track_of(i, person)
                if track is None:
                    continue
                tracks.append(make.track(100 * i, track, (*walk(i, person), 1.2, 0.0)))
                beside = np.array([0.0, off.get((i, person), 0.0)])
                path = [walk(i + k, person) + beside for k in range(1, P + 1)]
                predictions.append(make.prediction(track, path, fallback=changes.get("fallback", False)))
            seen = [(person, *walk(i, person)) for person in range(people)]
            frame = make.truth(100 * i, seen, changes.get("points", 40)) if truth else None
            if frame is not None:
                frame = replace(frame, velocities_mps=np.tile([1.2, 0.0], (people, 1)))
            yield make.result(100 * i, tracks, predictions, frame, sequence=i, epoch=changes.get("epoch", 0))

    return made


def found(frames, most=10, few=0, **options):
    """The worst of each kind; with `few` also those of each slice."""
    moments = Moments(most=most, few=few, **options)
    for frame in frames:
        moments.add(frame)
    return moments.finish()


def of(kind, moments):
    return [moment for moment in moments if moment.kind is kind]


# --- prediction errors -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("truth", [True, False])
def test_the_worst_prediction_is_the_one_that_is_off(walkers, make, truth):
    moments, _ = found(walkers(off={(7, 0): 2.0}, truth=truth))
    worst = moments[0]
    assert worst.kind is MomentKind.ERROR
    assert worst.size == pytest.approx(2.0)
    assert worst.stamp_ns == make.stamp(700)
    assert worst.at_s == pytest.approx(0.7)  # after the first frame
    assert np.array(worst.horizon_errors_m) == pytest.approx(np.array([(0.1, 2.0), (0.2, 2.0), (0.3, 2.0)]))
    assert (worst.track_id, worst.person_id) == (10, 0 if truth else -1)
    assert worst.text == "track 10: ADE 2.00 m, FDE 2.00 m"
    assert (worst.ahead_m, worst.left_m) == pytest.approx(tuple(walk(7)))
    assert worst.range_m == pytest.approx(np.hypot(*walk(7)))
    assert worst.speed_mps == pytest.approx(1.2)
    assert not worst.turning
    assert not worst.near_vehicle
    assert worst.picture is None


def test_seconds_count_from_the_start_of_the_log(walkers, make):
    moments, _ = found(walkers(off={(7, 0): 2.0}), log_start_ns=make.stamp(-1000))
    assert moments[0].at_s == pytest.approx(1.7 + 0.05)  # a frame is released 50 ms after its stamp


def test_of_one_person_within_one_horizon_only_the_worst_stays(walkers, make):
    errors = {(5, 0): 1.0, (6, 0): 2.0, (7, 0): 1.9, (15, 0): 1.5, (6, 1): 1.2}
    moments, _ = found(walkers(people=2, off=errors), most=3)
    assert [round(m.size, 6) for m in moments] == [2.0, 1.5, 1.2]
    assert [(m.person_id, m.stamp_ns) for m in moments] == [
        (0, make.stamp(600)), (0, make.stamp(1500)), (1, make.stamp(600))
    ]  # fmt: skip


def test_kept_errors_of_a_person_are_at_least_a_horizon_apart(walkers):
    rng = np.random.default_rng(1)
    errors = {(i, person): float(rng.random()) for i in range(60) for person in range(3)}
    moments, _ = found(walkers(60, people=3, off=errors), most=100)
    for person in range(3):
        stamps = sorted(m.stamp_ns for m in moments if m.person_id == person)
        assert len(stamps) > 5
        assert min(np.diff(stamps)) > HORIZON_FRAMES * 100_000_000 - 1
    assert [m.size for m in moments] == sorted((m.size for m in moments), reverse=True)
    assert moments[0].size == pytest.approx(max(e for (i, _), e in errors.items() if i < 60 - P))


@pytest.mark.parametrize("most", [0, 1, 4])
def test_no_more_than_wanted_are_kept_and_they_are_the_worst(walkers, most):
    rng = np.random.default_rng(2)
    errors = {(i, person): float(rng.random()) for i in range(60) for person in range(3)}
    everything, _ = found(walkers(60, people=3, off=errors), most=100)
    assert found(walkers(60, people=3, off=errors), most=most)[0] == everything[:most]


def test_fallbacks_are_no_predictions(walkers):
    assert found(walkers(off={(7, 0): 2.0}, fallback=True)) == ([], [])


def test_an_epoch_ends_what_was_predicted_before(walkers):
    """Frames of both epochs have the same stamps: errors beside each other are two moments all the same."""
    frames = [*walkers(12, off={(5, 0): 1.0}), *walkers(12, off={(5, 0): 2.0}, epoch=1)]
    moments, _ = found(frames)
    assert [round(m.size, 6) for m in moments[:2]] == [2.0, 1.0]


def test_nothing_gives_nothing(make):
    assert found([]) == ([], [])
    assert found(make.result(100 * i) for i in range(20)) == ([], [])


def test_slices_add_up_to_the_score(results):
    """Of a simulated drive: what the score scored is all there, in every way of slicing."""
    score = ReplayScore()
    for frame in results:
        score.add(frame)
    truth = score.as_json()["ground_truth"]
    moments, slices = found(results)
    assert truth["scored"] > 20
    for by in ("range", "near the vehicle", "speed"):
        part = [each for each in slices if each.by == by]
        assert sum(each.count for each in part) == truth["scored"]
        assert sum(each.count * each.ade_m for each in part) / truth["scored"] == pytest.approx(truth["ade_m"])
        assert max(each.worst_m for each in part) == pytest.approx(moments[0].size)
    last = [each for each in slices if each.by == "horizon"][-1]
    assert last.count == truth["scored"]
    assert last.ade_m == pytest.approx(truth["fde_m"])


def test_who_is_near_who_stands_and_how_far_away(walkers):
    _, slices = found(walkers(20, people=2))  # at 6 to 9 m ahead, 3 and 7 m to the left
    counts = {(each.by, each.value): each.count for each in slices}
    assert counts["speed", "walking"] == 2 * (20 - P)
    assert ("speed", "standing") not in counts
    assert ("near the vehicle", "within 5 m") not in counts
    assert counts["range", "0 to 10 m"] + counts["range", "10 to 20 m"] == 2 * (20 - P)
    assert counts["turning", "straight on"] == 2 * (20 - P)
    assert counts["horizon", "0.1 s"] == counts["horizon", "0.3 s"] == 2 * (20 - P)


def slices_of(moment):
    return {(each.by, each.value): each.size for each in moment.worst_of}


def test_the_worst_of_a_slice_is_kept_though_others_are_worse(walkers):
    """People 1 and 2, 7 and 11 m to the left, are predicted far worse than person 0 when it is 5 m from the vehicle."""
    errors = {(i, person): 3.0 + (7 * i) % 5 for i in range(60) for person in (1, 2)} | {(40, 0): 0.5, (42, 0): 0.4}
    frames = [moved_vehicle(frame, walk(40)[0]) for frame in walkers(100, people=3, off=errors)]
    assert {m.person_id for m in found(frames, most=5)[0]} == {1, 2}
    moments, slices = found(frames, most=5, few=3)
    assert {m.person_id for m in moments[:5]} == {1, 2}
    (near,) = [m for m in moments if m.near_vehicle and m.size > 0.1]
    assert (near.person_id, round(near.size, 6)) == (0, 0.5)
    assert slices_of(near)["near the vehicle", "within 5 m"] == pytest.approx(0.5)
    (row,) = [each for each in slices if each.value == "within 5 m"]
    assert row.worst_m == pytest.approx(0.5)


def moved_vehicle(frame, x_m):
    pose = frame.sensors.map_from_vehicle.copy()
    pose[0, 3] = x_m
    return replace(frame, sensors=replace(frame.sensors, map_from_vehicle=pose))


def test_horizons_are_ranked_by_the_error_at_that_step(walkers, make):
    """Person 1's path is 1 m off at every step, person 0's 2 m at the first one alone."""

    def bent(frame):
        predictions = [*frame.predictions.predictions]
        if frame.tracks.stamp_ns != make.stamp(700):
            return frame
        path = predictions[0].paths[0]
        bent_m = path.points_m + np.array([[0, 2.0], [0, 0], [0, 0]])
        predictions[0] = replace(predictions[0], paths=(replace(path, points_m=bent_m),))
        return replace(frame, predictions=replace(frame.predictions, predictions=tuple(predictions)))

    frames = [bent(frame) for frame in walkers(30, people=2, off={(7, 1): 1.0})]
    moments, _ = found(frames, most=0, few=1)
    first, last = (
        max(((size, m.person_id) for m in moments for part, size in slices_of(m).items() if part == ("horizon", name)))
        for name in ("0.1 s", "0.3 s")
    )
    assert first == (pytest.approx(2.0), 0)
    assert last == (pytest.approx(1.0), 1)


def test_of_one_person_within_one_horizon_one_stays_for_all_slices(walkers):
    rng = np.random.default_rng(5)
    errors = {(i, person): float(rng.random()) for i in range(60) for person in range(3)}
    moments, slices = found(walkers(60, people=3, off=errors), most=4, few=3)
    for person in range(3):
        stamps = sorted(m.stamp_ns for m in moments if m.person_id == person)
        assert all(gap > HORIZON_FRAMES * 100_000_000 for gap in np.diff(stamps))
    assert 4 < len(moments) <= 4 + 3 * len(slices)
    assert [m.size for m in moments] == sorted((m.size for m in moments), reverse=True)


def test_every_slice_has_its_worst_and_no_more_than_a_few(results):
    """Of a simulated drive: the largest error that a slice tells is that of a moment."""
    moments, slices = found(results, few=3)
    errors = of(MomentKind.ERROR, moments)
    assert {each.by for each in slices} >= {"range", "horizon", "near the vehicle", "speed"}
    for each in slices:
        sizes = [slices_of(m)[each.by, each.value] for m in errors if (each.by, each.value) in slices_of(m)]
        assert max(sizes) == each.worst_m
        assert 1 <= len(sizes) <= 3
        assert sum((part.by, part.value) == (each.by, each.value) for m in errors for part in m.worst_of) <= 3


def test_missed_people_are_kept_by_range(walkers):
    """Two are missed longer farther away; the one 6.7 m away is kept for its range."""
    lost = {0: range(5, 12), 4: range(10, 40), 5: range(10, 40)}
    frames = list(walkers(60, people=6, track_of=lambda i, p: None if i in lost.get(p, ()) else 10 + p))
    assert {m.person_id for m in of(MomentKind.MISSED, found(frames, most=2)[0])} == {4, 5}
    missed = of(MomentKind.MISSED, found(frames, most=2, few=1)[0])
    assert [m.person_id for m in missed][-1] == 0
    assert set(slices_of(missed[-1])) == {("range", "0 to 10 m")}


def test_turns_in_closed_form():
    time = np.linspace(0, 4.8, 13)[:, None]
    straight, still = np.hstack([time, 0 * time]), np.zeros((13, 2))
    angle = np.pi / 2 * time / 4.8
    left = 3 * np.hstack([np.sin(angle), 1 - np.cos(angle)])
    turned, walks = turns(np.stack([straight, left, left * [1, -1], still, straight * [-1, 1]]), 4.8)
    assert walks.tolist() == [True, True, True, False, True]
    # the directions of the first and the last of four chords of a quarter circle
    assert turned == pytest.approx([0, 3 / 8 * np.pi, -3 / 8 * np.pi, 0, 0], abs=1e-9)


def test_a_turn_back_over_the_seam_of_angles_is_small():
    """From 170 to -170 degrees is a turn by 20, not by 340."""
    headings = np.radians([170, 170, -170, -170])
    walked = np.concatenate([[[0, 0]], np.cumsum(np.column_stack([np.cos(headings), np.sin(headings)]), axis=0)])
    assert turns(walked[None], 2.0)[0] == pytest.approx([np.radians(20)])


# --- missed people and id switches -----------------------------------------------------------------------------------


def test_a_missed_person_is_one_moment_per_stretch(walkers, make):
    """Nearest to the vehicle it is at the stretch's begin: it walks away."""
    moments, _ = found(walkers(40, track_of=lambda i, _: None if 5 <= i < 17 else 10))
    (missed,) = of(MomentKind.MISSED, moments)
    assert missed.size == pytest.approx(1.2)
    assert missed.stamp_ns == make.stamp(500)
    assert (missed.person_id, missed.track_id) == (0, 0)
    assert missed.text == "person 0: without a track for 1.2 s, 7 m away"


def test_missed_people_are_ranked_by_seconds(walkers):
    lost = {0: range(5, 12), 1: range(10, 30), 2: range(8, 18)}
    moments, _ = found(walkers(60, people=3, track_of=lambda i, person: None if i in lost[person] else 10 + person))
    missed = of(MomentKind.MISSED, moments)
    assert [(m.person_id, round(m.size, 3)) for m in missed] == [(1, 2.0), (2, 1.0), (0, 0.7)]


def test_two_stretches_are_two_moments(walkers):
    moments, _ = found(walkers(120, track_of=lambda i, _: None if 5 <= i < 15 or 80 <= i < 88 else 10))
    assert [round(m.size, 3) for m in of(MomentKind.MISSED, moments)] == [1.0, 0.8]


def test_a_person_lost_at_the_end_is_missed_too(walkers):
    moments, _ = found(walkers(30, track_of=lambda i, _: None if i >= 20 else 10))
    assert [round(m.size, 3) for m in of(MomentKind.MISSED, moments)] == [1.0]


@pytest.mark.parametrize(("count", "points"), [(4, 40), (20, 3)], ids=["too short", "hardly seen"])
def test_who_is_lost_for_some_scans_or_hardly_seen_is_not_missed(walkers, count, points):
    frames = walkers(40, points=points, track_of=lambda i, _: None if 5 <= i < 5 + count else 10)
    assert of(MomentKind.MISSED, found(frames)[0]) == []


def test_a_switch_is_a_person_whose_track_is_another(walkers, make):
    moments, _ = found(
        walkers(40, people=2, track_of=lambda i, person: 10 + person + (10 if person and i >= 20 else 0))
    )
    (switch,) = of(MomentKind.SWITCH, moments)
    assert switch.stamp_ns == make.stamp(2000)
    assert (switch.person_id, switch.track_id, switch.size) == (1, 21, 2)
    assert switch.text == "person 1: track 11 became track 21, its 2nd"


@pytest.mark.parametrize(("frames", "turning"), [(8, True), (2, False)], ids=["in view", "gone at once"])
def test_who_turns_and_leaves_has_turned(make, frames, turning):
    """Half a turn to the left within 0.8 s, then the ground truth knows nothing of the person any more."""

    def at(i):
        angle = np.pi * max(0, i - 10) / 8
        return (6 + 0.1 * min(i - 10, 0) + 0.4 * np.sin(angle), 3 + 0.4 * (1 - np.cos(angle)))

    results = [
        make.result(100 * i, [make.track(100 * i, 10 if i < 10 else 11, (*at(i), 1, 0))],
                    [make.prediction(10 if i < 10 else 11, [at(i)] * P, fallback=True)],
                    make.truth(100 * i, [(0, *at(i))] if i <= 10 + frames else []), sequence=i)
        for i in range(80)
    ]  # fmt: skip
    (switch,) = of(MomentKind.SWITCH, found(results)[0])
    assert switch.stamp_ns == make.stamp(1000)
    assert switch.turning is turning


def test_a_track_that_comes_back_after_a_gap_is_no_switch_and_another_is(walkers):
    back = walkers(40, track_of=lambda i, _: None if 10 <= i < 20 else 10)
    other = walkers(40, track_of=lambda i, _: None if 10 <= i < 20 else 10 if i < 10 else 11)
    assert of(MomentKind.SWITCH, found(back)[0]) == []
    assert len(of(MomentKind.SWITCH, found(other)[0])) == 1


def test_switches_of_one_person_at_once_are_one_moment_the_last(walkers):
    moments, _ = found(walkers(40, track_of=lambda i, _: 10 + max(0, min(i - 20, 3))))
    (switch,) = of(MomentKind.SWITCH, moments)
    assert (switch.size, switch.track_id) == (4, 13)


def test_pairs_are_those_of_the_clear_metrics():
    """Frame by frame they give the counts that the metric has for the whole drive."""
    rng = np.random.default_rng(3)
    frames = []
    for _ in range(200):
        people, tracks = (
            rng.choice(6, rng.integers(0, 6), replace=False),
            rng.choice(7, rng.integers(0, 6), replace=False),
        )
        truth_m, tracks_m = rng.uniform(0, 3, (len(people), 2)), rng.uniform(0, 3, (len(tracks), 2))
        frames.append(ScoredFrame(people, truth_m, tracks, tracks_m))
    pairs, last, switches, missed = {}, {}, 0, 0
    for frame in frames:
        pairs = clear_pairs(frame, pairs)
        switches += sum(last.get(person, track) != track for person, track in pairs.items())
        missed += len(frame.truth_ids) - len(pairs)
        last |= pairs
    whole = clear(frames)
    assert (switches, missed) == (whole.id_switches, whole.missed)
    assert switches > 50


def test_a_simulated_drive_has_the_switches_of_its_score(results):
    """From the middle on it is tracked under other numbers: each person seen before and after has switched."""
    shuffled = list(results)
    for i, frame in enumerate(results[30:], 30):
        renamed = tuple(replace(track, id=track.id + 100) for track in frame.tracks.tracks)
        theirs = tuple(replace(each, track_id=each.track_id + 100) for each in frame.predictions.predictions)
        shuffled[i] = replace(
            frame,
            tracks=replace(frame.tracks, tracks=renamed),
            predictions=replace(frame.predictions, predictions=theirs),
        )
    score = ReplayScore()
    for frame in shuffled:
        score.add(frame)
    switches = of(MomentKind.SWITCH, found(shuffled, most=1000)[0])
    assert len(switches) == score.as_json()["ground_truth"]["id_switches"] > 0


# --- memory and pictures ---------------------------------------------------------------------------------------------


def test_memory_does_not_grow_with_the_log(walkers):
    """Of a drive full of errors no more frames live on than the horizon's, and a few for what is kept."""
    rng = np.random.default_rng(4)
    errors = {(i, person): float(rng.random()) for i in range(600) for person in range(2)}
    alive, most, moments = weakref.WeakSet(), 0, Moments(most=5)
    lost = walkers(
        600, people=2, off=errors, track_of=lambda i, person: None if person and i % 40 < 8 else 10 + i // 50
    )
    for frame in lost:
        alive.add(frame)
        moments.add(frame)
        most = max(most, len(alive))
    del frame
    gc.collect()
    assert most < 60
    moments.finish()
    assert len(alive) < 30


def test_images_are_not_kept(walkers):
    images, moments = weakref.WeakSet(), Moments()
    for frame in walkers(off={(7, 0): 2.0}):
        image = CompressedImage(frame.tracks.stamp_ns, "camera", b"...", "jpeg")
        images.add(image)
        moments.add(replace(frame, images={"A0": image}))
    del image
    gc.collect()
    assert len(images) == 0


def test_pictures_are_drawn_of_every_moment_and_are_small(results, tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib comes with pcgan[view]")
    moments = Moments(most=2, few=0)
    for frame in results:
        moments.add(frame)
    drawn, _ = moments.finish(tmp_path / "new" / "pictures")
    assert [m.picture.name for m in drawn if m.kind is MomentKind.ERROR] == ["error-01.png", "error-02.png"]
    for moment in drawn:
        data = moment.picture.read_bytes()
        assert data.startswith(b"\x89PNG")
        assert 3_000 < len(data) < 60_000
    assert {path.name for path in (tmp_path / "new" / "pictures").iterdir()} == {m.picture.name for m in drawn}


def test_without_matplotlib_there_are_no_pictures(walkers, tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name == "matplotlib" or name.startswith("matplotlib.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    moments = Moments()
    for frame in walkers(off={(7, 0): 2.0}):
        moments.add(frame)
    drawn, slices = moments.finish(tmp_path / "pictures")
    assert drawn
    assert slices
    assert all(moment.picture is None for moment in drawn)


def test_a_folder_that_cannot_be_made_is_named(walkers, tmp_path):
    (tmp_path / "file").write_text("")
    moments = Moments()
    for frame in walkers():
        moments.add(frame)
    with pytest.raises(OutputError, match=r"pictures' folder .*file/pictures cannot be made"):
        moments.finish(tmp_path / "file" / "pictures")


def test_people_of_a_frame_are_found_whatever_their_order(walkers):
    """Rows of the ground truth are in no order; a person's place is its own."""
    frames = [
        replace(frame, ground_truth=replace(
            frame.ground_truth, ids=frame.ground_truth.ids[::-1], positions_m=frame.ground_truth.positions_m[::-1]))
        for frame in walkers(people=3, off={(7, 1): 2.0})
    ]  # fmt: skip
    moments, _ = found(frames)
    assert match(frames[0].tracks.tracks, frames[0].ground_truth).tolist() == [0, 1, 2]
    assert (moments[0].person_id, moments[0].left_m) == (1, pytest.approx(walk(7, 1)[1]))
