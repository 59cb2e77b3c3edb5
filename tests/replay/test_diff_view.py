"""The overlay of two logs in rerun: what is drawn of whom, and where they differ."""

import math

import numpy as np
import pytest

from replay.diff import Tolerances, diff_logs
from replay.diff_view import DiffView
from schemas import pcgan_v1_pb2 as pb


def log(make, logged, make_log, name, *, numbers, moved=0.0, lost=()):
    messages = []
    for k in range(4):
        at_ms = 100.0 * k
        people = [(number, row) for row, number in enumerate(numbers) if (k, number) not in lost]
        tracks = [make.track(at_ms, number, (0.1 * k, 3.0 * row + moved, 1.0, 0.0)) for number, row in people]
        answers = [make.prediction(number, [(1.0, 3.0 * row + moved), (2.0, 3.0 * row)]) for number, row in people]
        result = make.result(at_ms, tracks, answers, sequence=k)
        messages += [
            logged("/pcgan/tracks", result.log_time_ns, result.tracks),
            logged("/pcgan/predictions", result.log_time_ns, result.predictions),
        ]
    return make_log(messages, name)


class Spy(DiffView):
    """Keeps what would be sent."""

    def __init__(self):
        self.frames, self._row = [], {}
        self._columns = self
        self._origin_m = None
        self._mark_m = 0.01
        self._tracks = {"a": {}, "b": {}}

    def add(self, entity, archetype, **components):
        assert len({len(each) for each in components.values()}) == 1, (entity, archetype)
        self._row[entity] = components

    def end_frame(self, stamp_ns, sequence):
        self.frames.append((stamp_ns, sequence, self._row))
        self._row = {}


def drawn(a, b):
    spy = Spy()
    diff_logs([a], [b], on_pair=spy.show_pair)
    return spy.frames


def test_renumbered_people_lie_over_each_other(make, logged, make_log):
    a = log(make, logged, make_log, "a.mcap", numbers=(1, 2))
    b = log(make, logged, make_log, "b.mcap", numbers=(5, 1))
    frames = drawn(a, b)
    assert [sequence for _, sequence, _ in frames] == [0, 0, 1, 1, 2, 2, 3, 3]
    for stamp_ns, sequence, row in frames:
        assert stamp_ns == make.stamp(100 * sequence)
        if "a/tracks" in row:
            assert row["a/tracks"]["labels"] == ["1 = 5", "2 = 1"]
            np.testing.assert_array_equal(row["a/tracks"]["centers"][:, :2], row["b/tracks"]["centers"][:, :2])
            assert len(row["apart/alone"]["centers"]) == 0
            assert row["figures/tracks"]["scalars"] == 0
            assert len(row["map/vehicle"]["strips"]) == 1
        else:
            assert len(row["a/paths"]["strips"]) == len(row["b/paths"]["strips"]) == 2
            assert len(row["apart/paths"]["strips"]) == 0


def test_what_lies_apart_is_joined_by_lines(make, logged, make_log):
    a = log(make, logged, make_log, "a.mcap", numbers=(1, 2))
    b = log(make, logged, make_log, "b.mcap", numbers=(1, 2), moved=0.25)
    for _, _, row in drawn(a, b):
        if "a/tracks" in row:
            assert len(row["apart/places"]["strips"]) == 2
            assert row["figures/tracks"]["scalars"] == pytest.approx(0.25)
        else:
            assert len(row["apart/paths"]["strips"]) == 2  # the first of two steps of each
            assert row["figures/paths"]["scalars"] == pytest.approx(0.25)


def test_who_is_in_one_log_alone_is_marked_and_gone_again(make, logged, make_log):
    a = log(make, logged, make_log, "a.mcap", numbers=(1, 2))
    b = log(make, logged, make_log, "b.mcap", numbers=(1, 2), lost={(2, 2)})
    alone = [len(row["apart/alone"]["centers"]) for _, _, row in drawn(a, b) if "a/tracks" in row]
    assert alone == [0, 0, 1, 0]


def test_a_frame_of_one_log_is_drawn_and_others_messages_are_not(recorded, edit_log):
    def drop(messages):
        first = next(i for i, message in enumerate(messages) if message[0] == "/pcgan/tracks")
        return [*messages[:first], *messages[first + 1 :]]

    frames = drawn(recorded.path, edit_log(recorded.path, drop))
    assert len(frames) == 2 * len(recorded.frames)


def test_predictions_without_tracks_are_drawn_too(recorded, edit_log):
    only = edit_log(recorded.path, lambda log: [message for message in log if message[0] == "/pcgan/predictions"])
    frames = drawn(only, only)
    assert len(frames) == len(recorded.frames)
    assert any(len(row["a/paths"]["strips"]) for _, _, row in frames)


def test_the_recording_is_written_whole(recorded, tmp_path):
    rrd = tmp_path / "both.rrd"
    with DiffView.of_logs(rrd, recorded.path, recorded.path, Tolerances()) as view:
        diff_logs([recorded.path], [recorded.path], on_pair=view.show_pair)
    assert rrd.stat().st_size > 10_000
    assert not rrd.with_name("both.rrd.part").exists()


def test_nonsense_is_not_drawn_and_ends_nothing(recorded, edit_log, tmp_path):
    """What the comparison tells of in numbers cannot all be drawn."""

    def absurd(log):
        for k, (topic, at, data) in enumerate(log):
            if topic == "/pcgan/tracks":
                frame = pb.TrackFrame.FromString(data)
                frame.sequence, frame.stamp_ns = 2**64 - 1, -(2**63) + k
                del frame.vehicle_history.y[:]
                for track, value in zip(frame.tracks, (math.nan, 1e300, -math.inf), strict=False):
                    track.x = value
                yield topic, at, frame.SerializeToString()
            elif topic == "/pcgan/predictions":
                answer = pb.PredictionFrame.FromString(data)
                for number, prediction in enumerate(answer.predictions):
                    path = prediction.paths[0]
                    if number == 0:
                        path.probability = math.nan
                    elif number == 1:
                        del path.x[1:]
                    elif number == 2:
                        path.y[0] = 1e300
                    else:
                        del path.x[:], path.y[:]
                yield topic, at, answer.SerializeToString()

    path = edit_log(recorded.path, absurd, "absurd.mcap")
    for a, b in ((path, path), (recorded.path, path), (path, recorded.path)):
        with DiffView.of_logs(tmp_path / "both.rrd", a, b, Tolerances()) as view:
            diff_logs([a], [b], on_pair=view.show_pair)
        assert (tmp_path / "both.rrd").stat().st_size > 10_000
