"""What a replay that has been done says about itself."""

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from replay import replayed as module
from replay.frame_result import FrameResult
from replay.log_source import LogSource
from replay.log_writer import LogWriter
from replay.replay_cache import Asked, ReplayCache, write_truth
from replay.replayed import Errors, Gap, References, Replayed, Scores
from replay.session import ReplaySettings
from schemas import codec


@pytest.fixture(scope="module")
def replayed(short_drive, model, tmp_path_factory) -> Replayed:
    """The short drive replayed as by the fixture `recorded`."""
    asked = Asked((LogSource(str(short_drive), "short"),), ReplaySettings(), model)
    return ReplayCache(tmp_path_factory.mktemp("replays")).get(asked, "short")


@pytest.fixture
def written(tmp_path):
    """Makes a `Replayed` of frame results, as if they had been replayed."""

    def write(results: Sequence[FrameResult]) -> Replayed:
        output, truth = tmp_path / "out.mcap", tmp_path / "truth.mcap"
        with LogWriter(output, emit=("pcgan",)) as writer:
            for result in results:
                writer.write(result)
        known = [(result.log_time_ns, result.ground_truth) for result in results if result.ground_truth is not None]
        if known:
            write_truth(truth, known)
        start_ns = results[0].log_time_ns
        return Replayed("made", ("made.mcap",), output, {"refused": 0}, start_ns, truth if known else None)

    return write


# --- what is in it -------------------------------------------------------------------------------------------------


def test_frames_are_those_of_the_replay(replayed, recorded):
    assert len(replayed.frames) == len(recorded.frames)
    for frame, result in zip(replayed.frames, recorded.frames, strict=True):
        assert codec.encode(frame.tracks) == codec.encode(result.tracks)
        assert codec.encode(frame.predictions) == codec.encode(result.predictions)
        np.testing.assert_array_equal(frame.pose.position_m, result.vehicle_pose.position_m)
        assert frame.pose.stamp_ns == frame.stamp_ns == result.tracks.stamp_ns
        assert codec.encode(frame.truth) == codec.encode(result.ground_truth)
        assert frame.log_time_ns == result.log_time_ns
    assert [len(each) for each in (replayed.tracks, replayed.predictions, replayed.poses)] == [len(replayed.frames)] * 3


def test_the_output_is_byte_for_byte_what_pcgan_replay_writes_of_these_topics(replayed, recorded, mcap_content):
    ours, others = mcap_content(replayed.output), mcap_content(recorded.path)
    assert ours.messages == [message for message in others.messages if message[0] != "/pcgan/scene"]
    assert (ours.metadata, ours.attachments) == (others.metadata, others.attachments)


def test_scores_are_the_summarys(replayed, recorded):
    truth = recorded.summary.as_json()["ground_truth"]
    scores = replayed.scores
    assert (scores.hota, scores.id_switches, scores.false) == (truth["hota"], truth["id_switches"], truth["false"])
    assert (scores.people_seen, scores.ospa_m) == (truth["people_seen"], truth["ospa_m"])
    assert (scores.scored, scores.ade_m) == (recorded.summary.score["scored"], recorded.summary.score["ade_m"])
    assert replayed.refused == recorded.summary.refused == 0


def test_scores_without_ground_truth_have_no_tracking_figures():
    errors = {"ade_m": 0.3, "fde_m": 0.7, "mhd_m": 0.2, "nll": -1.0}
    summary = {**errors, "scored": 12, "scored_share": 0.5, "tracker": {**errors, "ade_m": 0.4}, "fallbacks": 3}
    scores = Scores.of(summary)
    assert (scores.ade_m, scores.nll, scores.scored, scores.tracker.ade_m) == (0.3, -1.0, 12, 0.4)
    assert (scores.hota, scores.id_switches, scores.people_seen, scores.ground_truth) == (None, None, None, Errors())


def test_its_text_is_short(replayed):
    tracks = replayed.summary["tracks"]
    assert repr(replayed) == f"<replay of short: {len(replayed.frames)} frames, {tracks} tracks>"


# --- at a time, along a track --------------------------------------------------------------------------------------


def test_at_is_the_newest_frame_at_that_time_into_the_log(replayed):
    second, third = replayed.frames[1:3]
    assert replayed.at(second.at_s) is second
    assert replayed.at((second.at_s + third.at_s) / 2) is second
    assert replayed.at(1e6) is replayed.frames[-1]
    with pytest.raises(LookupError, match=r"no frame at 0 s: the first comes at 0\.\d{3} s"):
        replayed.at(0)


def test_time_counts_from_the_recordings_first_message(written, make):
    replayed = written([make.result(100 * k) for k in range(3)])
    assert [frame.at_s for frame in replayed.frames] == [0.0, 0.1, 0.2]
    assert [frame.at_s for frame in replace(replayed, start_ns=replayed.start_ns - 10**9).frames] == [1.0, 1.1, 1.2]


def test_a_track_is_followed_through_the_frames_that_hold_it(written, make):
    rows = [(0, (3.0, 4.0, 1.0, 0.0), False), (100, (3.1, 4.0, 1.0, 0.0), True), (300, (3.3, 4.0, 1.0, 0.0), False)]
    results = [
        make.result(
            at_ms,
            [make.track(at_ms, 7, state, coasting), make.track(at_ms, 8, (50.0, 0.0, 0.0, 0.0))],
            [make.prediction(7, [[0, 0]], fallback=coasting), make.prediction(8, [[0, 0]])],
        )
        for at_ms, state, coasting in rows
    ]
    results.insert(2, make.result(200, [make.track(200, 8)], [make.prediction(8, [[0, 0]])]))
    track = written(results).track(7)
    assert track.at_s.tolist() == [0.0, 0.1, 0.3]
    assert track.stamps_ns.tolist() == [make.stamp(at_ms) for at_ms, *_ in rows]
    np.testing.assert_array_equal(track.positions_m, [[3.0, 4.0], [3.1, 4.0], [3.3, 4.0]])
    np.testing.assert_array_equal(track.velocities_mps, [[1.0, 0.0]] * 3)
    assert track.range_m[0] == 5.0  # the vehicle stands in the origin
    assert track.coasting.tolist() == track.fallback.tolist() == [False, True, False]
    assert [prediction.track_id for prediction in track.predictions] == [7, 7, 7]
    assert np.isnan(track.corridor_time_s).all()
    assert repr(track) == "<track 7: 3 frames from 0.000 to 0.300 s>"


def test_a_clock_reset_starts_the_ids_anew(written, make):
    epochs = [make.result(100 * k, [make.track(100 * k)], [make.prediction(1, [[0, 0]])], epoch=k) for k in range(2)]
    replayed = written(epochs)
    assert (replayed.track(1).at_s.tolist(), replayed.track(1, epoch=1).at_s.tolist()) == ([0.0], [0.1])


def test_the_truth_is_that_of_its_own_epoch(written, make):
    """After a clock reset stamps come again; log times do not."""
    first, second = (make.result(0, truth=make.truth(0, [(person, 1.0, 2.0)]), epoch=person) for person in range(2))
    second = replace(second, log_time_ns=first.log_time_ns + 10**8)
    assert [truth.ids.tolist() for truth in written([first, second]).truth] == [[0], [1]]


def test_a_track_that_is_not_there_is_named_with_those_that_are(written, make):
    replayed = written(
        [make.result(0, [make.track(0, 3), make.track(0, 5)], [make.prediction(i, [[0, 0]]) for i in (3, 5)])]
    )
    assert replayed.track_ids == (3, 5)
    with pytest.raises(LookupError, match="no track 4 in epoch 0; there are 3, 5"):
        replayed.track(4)


def test_a_track_is_found_by_where_it_was(written, make):
    tracks = [make.track(0, 3, (1.0, 1.0, 0, 0)), make.track(0, 5, (9.0, 9.0, 0, 0))]
    replayed = written([make.result(0, tracks, [make.prediction(i, [[0, 0]]) for i in (3, 5)]), make.result(100)])
    assert replayed.track_near(8.0, 9.5, at_s=0.05).id == 5
    with pytest.raises(LookupError, match=r"nobody is tracked at 0.1 s"):
        replayed.track_near(8.0, 9.5, at_s=0.1)


def test_a_track_that_is_far_from_the_place_is_another_one(written, make):
    tracks = [make.track(0, 3, (1.0, 1.0, 0, 0)), make.track(0, 7, (4.0, 0.0, 0, 0))]
    replayed = written([make.result(0, tracks, [make.prediction(i, [[0, 0]]) for i in (3, 7)])])
    for place in ((6.0, 0.0), (2.0, 0.0)):  # both 2 m away
        assert replayed.track_near(*place, at_s=0.0, within_m=2.0).id in {3, 7}
    with pytest.raises(LookupError) as failure:
        replayed.track_near(1000, 0, 0.0)
    assert str(failure.value) == (
        "nobody is tracked within 2 m of (1000, 0) at 0 s; the nearest, track 7, is 996 m away"
    )
    assert replayed.track_near(1000, 0, 0.0, within_m=1000).id == 7
    with pytest.raises(LookupError, match=r"within 0\.5 m of \(4\.6, 0\) at 0 s; the nearest, track 7, is 0\.6 m away"):
        replayed.track_near(4.6, 0, 0.0, within_m=0.5)


def test_a_track_is_not_looked_for_outside_of_the_log(written, make):
    def frame(at_ms):
        return make.result(at_ms, [make.track(at_ms, 3, (1.0, 1.0, 0, 0))], [make.prediction(3, [[0, 0]])])

    replayed = written([frame(at_ms) for at_ms in (0, 100, 200, 700)])  # three frames are missing
    assert replayed.track_near(1, 1, 0.79).id == 3  # the last frame's time
    with pytest.raises(LookupError, match=r"no frame at 0\.81 s: the last comes at 0\.700 s"):
        replayed.track_near(1, 1, 0.81)
    with pytest.raises(LookupError, match=r"no frame at -1 s: the first comes at 0\.000 s"):
        replayed.track_near(1, 1, -1)


# --- who was lost --------------------------------------------------------------------------------------------------


@pytest.fixture
def lost(written, make):
    """Person 1, 4 m ahead, has no track at 0.1, 0.2 and 0.4 s; person 2, 20 m away, never has one."""
    results = []
    for k in range(6):
        tracked = k not in {1, 2, 4}
        tracks = [make.track(100 * k, 1, (4.0, 0.3, 0, 0))] if tracked else []
        predictions = [make.prediction(1, [[0, 0]])] if tracked else []
        results.append(make.result(100 * k, tracks, predictions, make.truth(100 * k, [(1, 4, 0), (2, 20, 0)])))
    return written(results)


def test_gaps_last_to_the_next_frame_that_is_otherwise(lost):
    assert lost.untracked(within_m=5) == [Gap(1, 0.1, 0.2, 4.0), Gap(1, 0.4, 0.1, 4.0)]


def test_a_gap_at_the_end_lasts_to_the_last_frame(lost):
    assert Gap(2, 0.0, 0.5, 20.0) in lost.untracked()


def test_who_is_hardly_hit_by_the_lidar_need_not_be_tracked(lost):
    assert lost.untracked(within_m=5, min_lidar_points=41) == []  # the truth has 40 each


def test_without_ground_truth_nobody_can_say_who_was_lost(written, make):
    replayed = written([make.result(0)])
    assert replayed.truth == ()
    with pytest.raises(ValueError, match="made has no ground truth"):
        replayed.untracked()


# --- references ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def changed(short_drive, model, replayed) -> Replayed:
    """The same with one more hit to confirm a track."""
    settings = ReplaySettings.model_validate({"tracking": {"tracker": {"confirm_hits": 3}}})
    asked = Asked((LogSource(str(short_drive), "short"),), settings, model)
    return ReplayCache(replayed.output.parent.parent).get(asked, "short")


@pytest.fixture
def variants(replayed, changed, tmp_path):
    """Both variants, with references in one folder."""
    references = References(tmp_path / "references", remedy="do this")
    usual, other = (replace(each, references=references) for each in (replayed, changed))
    return SimpleNamespace(usual=usual, changed=other, references=references)


def message_of(replayed: Replayed, **tolerances: float) -> str:
    with pytest.raises(AssertionError) as failure:
        replayed.assert_matches_reference(**tolerances)
    return str(failure.value)


def test_a_reference_is_missing_then_written_then_matched_then_missed(variants):
    usual, changed, references = variants.usual, variants.changed, variants.references
    assert message_of(usual).splitlines() == [
        f"short has no reference {usual.reference}",
        f"its output: {usual.output}",
        "if this output is right: do this",
    ]
    references.reason = "first version"
    usual.assert_matches_reference()
    assert references.written == [usual.reference]
    references.reason = None
    usual.assert_matches_reference(atol=0, rtol=0)

    text = message_of(changed)
    assert text.startswith("short: its reference (first) and this output (second) differ\n")
    for topic in ("/pcgan/tracks", "/pcgan/predictions"):
        assert sum(line.startswith(f"  {topic} at 0.") for line in text.splitlines()) == 1
    assert "changed since the reference was written:\n  tracking.tracker.confirm_hits 2 -> 3\n" in text
    assert "why it was written: first version" in text
    assert f"pcgan diff {usual.reference} {changed.output}" in text
    assert text.endswith("if this output is right: do this")


def test_an_update_rewrites_only_what_differs_and_keeps_the_reason(variants):
    usual, changed, references = variants.usual, variants.changed, variants.references
    usual.write_reference("first version")
    references.reason = "nothing to do"
    usual.assert_matches_reference()
    assert references.written == []
    references.reason = "three hits confirm a track"
    changed.assert_matches_reference()
    assert references.written == [changed.reference]
    references.reason = None
    changed.assert_matches_reference()
    assert changed.compare().reference.reason == "three hits confirm a track"


def test_one_of_two_processes_writes_and_the_other_finds_it_written(variants, tmp_path, monkeypatch):
    """Such as two workers of pytest-xdist with a test each of one drive; here they are threads."""
    usual = module.write_reference

    def slow(*arguments):
        time.sleep(0.3)
        usual(*arguments)

    monkeypatch.setattr(module, "write_reference", slow)
    both = [References(tmp_path / "references", "first", lock=tmp_path / "lock") for _ in range(2)]
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda each: replace(variants.usual, references=each).assert_matches_reference(), both))
    assert sorted(len(each.written) for each in both) == [0, 1]


def test_two_variants_cannot_write_one_reference(variants):
    variants.references.reason = "first version"
    variants.usual.assert_matches_reference()
    assert "two variants of a recording need a name each" in message_of(variants.changed)
    variants.references.reason = None
    variants.usual.assert_matches_reference()  # it is still the first one's


def test_a_damaged_reference_fails_and_can_be_written_anew(variants):
    usual, references = variants.usual, variants.references
    usual.reference.parent.mkdir()
    usual.reference.write_bytes(b"no reference")
    problem, remedy = message_of(usual).splitlines()
    assert problem.startswith(f"{usual.reference} is not a readable MCAP file")
    assert "--update" not in problem
    assert remedy == "if this output is right: do this"
    references.reason = "the old one was damaged"
    usual.assert_matches_reference()
    references.reason = None
    usual.assert_matches_reference()


def test_a_replay_without_a_folder_is_compared_with_a_file(replayed, tmp_path):
    with pytest.raises(ValueError, match="no folder of references is known for short"):
        replayed.compare()
    path = replayed.write_reference("by hand", tmp_path / "new" / "mine.mcap")
    assert replayed.compare(path).status == "identical"
    assert replayed.compare(Path("nowhere.mcap")).status == "no reference"
