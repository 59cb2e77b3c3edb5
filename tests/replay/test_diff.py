"""Two logs compared: messages paired, tracks matched, tolerances, first differences, and logs of every kind."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from replay.diff import Difference, Kind, LogDiff, Tolerances, diff_logs
from replay.diff_result import TopicDiff
from replay.errors import LogError
from schemas import codec
from schemas.messages import GroundTruthFrame, TrackFrame, VehiclePose
from tests.replay.foreign_foxglove import as_foxglove, as_foxglove_json
from tests.replay.foreign_ros import as_ros1, as_ros2

TRACKS, PREDICTIONS, SCENE = "/pcgan/tracks", "/pcgan/predictions", "/pcgan/scene"
STEP_NS = 100_000_000


def diff(a: Path, b: Path, **tolerances):
    return diff_logs([a], [b], Tolerances(**tolerances))


def of(found, topic):
    return next(each for each in found.topics if each.topic == topic)


@pytest.fixture
def scenes(make, logged, make_log):
    """Writes a log of people who walk along x, predicted; `people(k)` gives id -> place of frame k."""

    def write(people, name, frames=20, change=None, topics=None):
        messages = []
        for k in range(frames):
            at_ms = 100.0 * k
            tracks, predictions = [], []
            for number, (x, y) in people(k).items():
                tracks.append(make.track(at_ms, number, (x, y, 1.0, 0.0)))
                predictions.append(make.prediction(number, [(x + 0.4 * step, y) for step in range(1, 6)]))
            result = make.result(at_ms, tracks, predictions, sequence=k)
            frame, answer = result.tracks, result.predictions
            if change is not None:
                frame, answer = change(k, frame, answer)
            at_ns = result.log_time_ns
            messages += [logged(TRACKS, at_ns, frame), logged(PREDICTIONS, at_ns, answer)]
        return make_log([each for each in messages if topics is None or each.topic in topics], name)

    return write


def walkers(numbers=(1, 2, 3)):
    """People 3 m beside each other."""
    return lambda k: {number: (0.1 * k, 3.0 * row) for row, number in enumerate(numbers)}


# --- the same ---------------------------------------------------------------------------------------------------------


def test_a_log_and_itself_are_identical(recorded):
    found = diff(recorded.path, recorded.path)
    assert (found.same, found.identical, found.first, found.renumbered) == (True, True, None, {})
    assert {each.topic for each in found.topics} == {TRACKS, PREDICTIONS, SCENE, "/pcgan/vehicle_pose"}
    frames = len(recorded.frames)
    assert all(each.messages == (frames, frames) and each.values == 0 for each in found.topics)
    assert json.loads(json.dumps(found.as_json()))["identical"] is True


@pytest.fixture
def tiny_drive(short_drive, edit_log):
    """The first second of a drive: every kind of message is in it."""
    return edit_log(short_drive, lambda log: log[:250], "tiny.mcap")


every_kind = pytest.mark.parametrize(
    "rewrite", [as_foxglove, as_foxglove_json, as_ros1, as_ros2], ids=lambda kind: kind.__name__
)


def test_a_drive_and_itself_are_the_same_value_by_value(tiny_drive):
    exact = diff(tiny_drive, tiny_drive, share=1e-9)  # which decodes everything, to count it
    assert all(each.values > each.messages[0] for each in exact.topics)
    assert exact.identical


@every_kind
def test_logs_of_every_kind_are_read_and_a_number_in_them_is_found(rewrite, tiny_drive, edit_log, tmp_path):
    def moved(log):
        rows = [i for i, message in enumerate(log) if message[0] == "/vn100/odometry"]
        topic, at, data = log[rows[20]]
        pose = codec.decode(VehiclePose, data)
        log[rows[20]] = (topic, at, codec.encode(replace(pose, position_m=pose.position_m + np.array([0.5, 0, 0]))))
        return log

    a = rewrite(tiny_drive, tmp_path / "a.mcap")
    exact = diff(a, a, share=1e-9)
    assert exact.identical
    assert all(each.values > each.messages[0] for each in exact.topics)
    found = diff(a, rewrite(edit_log(tiny_drive, moved), tmp_path / "b.mcap"))
    (topic,) = [each for each in found.topics if not each.identical]
    assert (topic.topic, topic.different, topic.same) == ("/vn100/odometry", 1, False)
    (field,) = topic.fields
    assert field.field in {"pose.position.x", "pose.pose.position.x"}
    assert field.largest == pytest.approx(0.5)
    assert f", {field.field}: " in str(topic.first)
    assert str(topic.first).endswith("(atol 0.0001)")


def test_several_files_are_one_log(short_drive, edit_log):
    whole = edit_log(short_drive, lambda log: log, "whole.mcap")
    half = len(list(_messages(short_drive))) // 2
    parts = [
        edit_log(short_drive, lambda log: log[:half], "one.mcap"),
        edit_log(short_drive, lambda log: log[half:], "two.mcap"),
    ]
    assert diff_logs([whole], parts).identical


def _messages(path):
    from replay.log_reader import LogReader

    return LogReader([path]).messages()


# --- messages ---------------------------------------------------------------------------------------------------------


def test_a_dropped_message_is_one_difference(recorded, edit_log):
    def drop(log):
        rows = [i for i, message in enumerate(log) if message[0] == TRACKS]
        return [message for i, message in enumerate(log) if i != rows[7]]

    found = diff(recorded.path, edit_log(recorded.path, drop))
    tracks = of(found, TRACKS)
    count = len(recorded.frames)
    assert (tracks.stamps, tracks.different, tracks.messages) == (1, 0, (count, count - 1))
    assert tracks.first.kind is Kind.COUNT
    at_s = (recorded.frames[7].log_time_ns - recorded.frames[0].log_time_ns) / 1e9
    assert str(tracks.first) == (
        f"{TRACKS} at {at_s:.3f} s: only the first log has this message ({count} vs {count - 1} messages)"
    )
    assert sum(tracks.when) == 1
    assert [each.topic for each in found.topics if not each.same] == [TRACKS]


def test_a_message_at_another_time_is_a_stamp_of_both(recorded, edit_log):
    def late(log):
        row = next(i for i, message in enumerate(log) if message[0] == PREDICTIONS and i > 40)
        topic, at, data = log[row]
        return [*log[:row], (topic, at + 1000, data), *log[row + 1 :]]

    predictions = of(diff(recorded.path, edit_log(recorded.path, late)), PREDICTIONS)
    assert (predictions.stamps, predictions.different, predictions.first.kind) == (2, 0, Kind.STAMP)
    assert str(predictions.first).endswith(": only the first log has this message")


def test_messages_of_one_time_are_paired_in_order(make, logged, make_log):
    def log(name, *xs):
        return make_log([logged("/pose", make.START_NS, make.pose(0, x=x)) for x in xs], name)

    assert diff(log("a.mcap", 1, 2, 3), log("b.mcap", 1, 2, 3)).identical
    (topic,) = diff(log("a.mcap", 1, 2, 3), log("b.mcap", 1, 2)).topics
    assert (topic.stamps, topic.different) == (1, 0)
    (topic,) = diff(log("a.mcap", 1, 2, 3), log("b.mcap", 1, 5, 3)).topics
    assert (topic.stamps, topic.different, topic.largest) == (0, 1, 3.0)


def test_a_topic_of_one_log(recorded, edit_log):
    without = edit_log(recorded.path, lambda log: [message for message in log if message[0] != SCENE])
    for found, text in (
        (diff(recorded.path, without), f"{SCENE}: foxglove.SceneUpdate (protobuf) vs no messages"),
        (diff(without, recorded.path), f"{SCENE}: no messages vs foxglove.SceneUpdate (protobuf)"),
    ):
        assert str(of(found, SCENE).first) == text
        assert not found.same
        assert not diff(recorded.path, without, share=1.0).same  # which no share excuses
    assert diff(recorded.path, without, topics=("/pcgan/[tp]*",)).identical


def test_a_changed_type(make, logged, make_log):
    a = make_log([logged("/x", make.START_NS, make.pose(0))], "a.mcap")
    b = make_log([logged("/x", make.START_NS, make.scan(0))], "b.mcap")
    found = diff(a, b)
    assert str(found.first) == "/x: pcgan.v1.VehiclePose (protobuf) vs pcgan.v1.LidarClusters (protobuf)"


def test_topics_are_chosen_by_pattern_and_a_wrong_one_is_an_error(recorded):
    assert [each.topic for each in diff(recorded.path, recorded.path, topics=("pcgan/tr*",)).topics] == [TRACKS]
    with pytest.raises(LogError, match=r"neither log has a topic '/nope'; they have /pcgan/predictions, "):
        diff(recorded.path, recorded.path, topics=("/nope",))


def test_unreadable_bytes_are_compared_as_bytes(make_log, logged, make):
    def log(name, data, schema="nobody.Knows", encoding="protobuf"):
        return make_log([logged("/x", make.START_NS, data, schema, encoding)], name)

    assert diff(log("a.mcap", b"\1\2\3"), log("b.mcap", b"\1\2\3")).identical
    found = diff(log("a.mcap", b"\1\2\3"), log("b.mcap", b"\1\2\4\5"))
    assert str(found.first) == "/x at 0.000 s: 3 bytes vs 4 bytes, unlike from byte 2 on"
    damaged = diff(log("a.mcap", b"\xff", "pcgan.v1.TrackFrame"), log("b.mcap", b"\xfe", "pcgan.v1.TrackFrame"))
    assert str(damaged.first) == "/x at 0.000 s: 1 byte vs 1 byte, unlike from byte 0 on"


@pytest.mark.parametrize("depth", [100, 300, 450, 900, 5000])
def test_documents_of_any_depth_are_compared(make_log, logged, depth):
    def log(name, inside):
        return make_log([logged("/x", 10, b"[" * depth + inside + b"]" * depth, "any", "json")], name)

    found = diff(log("a.mcap", b"1"), log("b.mcap", b"2"))
    assert not found.same
    assert found.topics[0].different == 1


# --- tracks -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("topics", [None, {TRACKS}, {PREDICTIONS}])
def test_renumbered_tracks_are_the_same_and_told(scenes, topics):
    a = scenes(walkers((1, 2, 3)), "a.mcap", topics=topics)
    b = scenes(walkers((3, 9, 1)), "b.mcap", topics=topics)
    found = diff(a, b)
    assert found.same
    assert not found.identical
    assert found.renumbered == {"1": "3", "2": "9", "3": "1"}
    assert all(each.first is None for each in found.topics)


def test_what_is_made_of_renumbered_tracks_is_the_same_too(results, tmp_path):
    """Scene and Autoware's messages name tracks; the former colours them by number."""
    from replay.log_writer import LogWriter

    numbers = sorted({track.id for result in results for track in result.tracks.tracks})
    new = dict(zip(numbers, numbers[::-1], strict=True))

    def write(name, number):
        with LogWriter(tmp_path / name, emit=("pcgan", "foxglove", "autoware")) as writer:
            for result in results[-6:]:
                tracks = sorted((replace(t, id=number(t.id)) for t in result.tracks.tracks), key=lambda t: t.id)
                answers = [replace(p, track_id=number(p.track_id)) for p in result.predictions.predictions]
                writer.write(
                    replace(
                        result,
                        tracks=replace(result.tracks, tracks=tuple(tracks)),
                        predictions=replace(result.predictions, predictions=tuple(answers)),
                    )
                )
        return tmp_path / name

    found = diff(write("a.mcap", lambda number: number), write("b.mcap", new.__getitem__))
    assert [str(each.first) for each in found.topics if each.first is not None] == []
    assert found.same
    assert len(found.topics) == 6
    assert found.renumbered.items() <= {(str(a), str(b)) for a, b in new.items()}
    assert len(found.renumbered) > 3
    assert "entities.texts.text" in found.left_out


def test_an_id_switch_is_a_difference(scenes):
    a = scenes(walkers((1, 2, 3)), "a.mcap")
    b = scenes(lambda k: walkers((1, 2, 3) if k < 12 else (1, 7, 3))(k), "b.mcap")
    found = diff(a, b)
    assert not found.same
    assert found.renumbered == {}
    for topic in found.topics:
        assert topic.items == 2 * 8  # one lost and one new in each of the last 8 frames
        assert topic.different == 0
        assert str(topic.first) == f"{topic.topic} at 1.200 s, track 2: only in the first log"


@pytest.mark.parametrize("switched", [1, 3, 10, 17])
def test_an_id_switch_is_found_whenever_it_was(scenes, switched):
    """Up to the switch all bytes are equal, and if it was early most frames are of the new number."""
    a = scenes(walkers((1, 2)), "a.mcap")
    b = scenes(lambda k: walkers((1, 2) if k < switched else (1, 7))(k), "b.mcap")
    for found in (diff(a, b), diff(b, a)):
        assert not found.same
        assert all(each.items == 2 * min(switched, 20 - switched) for each in found.topics)


def test_a_swap_of_two_ids_is_a_difference(scenes):
    found = diff(
        scenes(walkers((1, 2)), "a.mcap"), scenes(lambda k: walkers((1, 2) if k < 12 else (2, 1))(k), "b.mcap")
    )
    assert not found.same
    tracks = of(found, TRACKS)
    assert tracks.first.at_s == 1.2
    assert tracks.largest == 3.0


def test_a_track_that_one_log_lacks(scenes):
    found = diff(scenes(walkers((1, 2, 3)), "a.mcap"), scenes(walkers((1, 2)), "b.mcap"))
    assert str(of(found, TRACKS).first) == f"{TRACKS} at 0.000 s, track 3: only in the first log"
    found = diff(scenes(walkers((1, 2)), "a.mcap"), scenes(walkers((1, 2, 3)), "b.mcap"))
    assert str(of(found, TRACKS).first) == f"{TRACKS} at 0.000 s, track 3: only in the second log"
    assert of(found, TRACKS).items == 20


def test_tracks_that_moved_far_are_compared_by_their_unchanged_numbers(scenes):
    a, b = walkers((1, 2)), walkers((1, 2))
    far = scenes(lambda k: {number: (x + 5, y) for number, (x, y) in b(k).items()}, "b.mcap")
    tracks = of(diff(scenes(a, "a.mcap"), far), TRACKS)
    assert str(tracks.first) == f"{TRACKS} at 0.000 s, track 1, state x: 0.000 vs 5.000 (atol 0.0001)"
    assert tracks.items == 0


def test_ids_begin_anew_with_an_epoch(scenes):
    def epochs(k, tracks, predictions):
        return replace(tracks, epoch=int(k >= 10)), predictions

    a = scenes(walkers((1, 2)), "a.mcap", change=epochs)
    b = scenes(lambda k: walkers((1, 2) if k < 10 else (2, 1))(k), "b.mcap", change=epochs)
    found = diff(a, b)
    assert found.same
    assert found.renumbered == {"1:1": "1:2", "1:2": "1:1"}


# --- values -----------------------------------------------------------------------------------------------------------


def test_the_first_difference_of_a_path(scenes):
    def bent(k, tracks, predictions):
        if k < 12:
            return tracks, predictions
        first, *others = predictions.predictions
        points = first.paths[0].points_m.copy()
        points[2, 0] += 0.058
        return tracks, replace(
            predictions,
            predictions=(replace(first, paths=(replace(first.paths[0], points_m=points),)), *others),
        )

    found = diff(scenes(walkers(), "a.mcap"), scenes(walkers(), "b.mcap", change=bent))
    assert str(found.first) == f"{PREDICTIONS} at 1.200 s, track 1, path 0 step 3: 2.400 vs 2.458 (atol 0.0001)"
    (field,) = of(found, PREDICTIONS).fields
    assert (field.field, field.values, field.different) == ("predictions.paths.x", 8 * 3 * 5, 8)
    assert field.largest == pytest.approx(0.058)
    assert field.p50 == pytest.approx(0.058)
    assert field.first_at_s == 1.2
    when = of(found, PREDICTIONS).when
    assert sum(when) == 8
    assert not any(when[: len(when) // 2])
    assert of(found, TRACKS).identical


def nudged(by):
    def change(_, tracks, predictions):
        moved = tuple(replace(track, state=track.state + np.array([by, 0, 0, 0])) for track in tracks.tracks)
        return replace(tracks, tracks=moved), predictions

    return change


@pytest.mark.parametrize(
    ("by", "tolerances", "same"),
    [
        (5e-5, {}, True),
        (2e-4, {}, False),
        (2e-4, {"atol": 1e-3}, True),
        (2e-4, {"ignore": ("tracks.x",)}, True),
        (2e-4, {"ignore": ("tracks",)}, True),
        (2e-4, {"ignore": ("tracks.xy", "track")}, False),
        (2e-4, {"ignore": ("tracks.state",)}, False),
        (2e-4, {"topics": (PREDICTIONS,)}, True),
        (2e-4, {"share": 0.5}, True),
        (2e-4, {"share": 1e-4}, False),
    ],
)
def test_tolerances(scenes, by, tolerances, same):
    found = diff(scenes(walkers(), "a.mcap"), scenes(walkers(), "b.mcap", change=nudged(by)), **tolerances)
    assert found.same is same
    if same and by < 1e-4:
        assert of(found, TRACKS).within == pytest.approx(by)


def test_a_share_counts_the_values_of_identical_messages_too(scenes):
    def once(k, tracks, predictions):
        return nudged(0.01)(k, tracks, predictions) if k == 4 else (tracks, predictions)

    a, b = scenes(walkers(), "a.mcap"), scenes(walkers(), "b.mcap", change=once)
    tracks = of(diff(a, b, share=1e-9), TRACKS)
    assert tracks.different == 3
    assert tracks.values == 20 * of(diff(a, b), TRACKS).values
    exactly = tracks.different / tracks.values
    assert diff(a, b, share=exactly).same
    assert not diff(a, b, share=exactly * 0.999).same


def test_a_share_of_tracks_is_one_of_tracks(scenes):
    """What tracks hold besides, 16 entries of a covariance, say, does not thin out those that are missing."""
    a = scenes(walkers((1, 2, 3)), "a.mcap")
    b = scenes(lambda k: walkers((1, 2) if k < 6 else (1, 2, 3))(k), "b.mcap")  # 6 of 60 are missing
    assert not diff(a, b, share=0.09).same
    assert diff(a, b, share=0.1).same


def test_nan_is_nan(make, logged, make_log):
    """Our codec refuses it; two logs may hold it all the same."""
    from schemas import pcgan_v1_pb2 as pb

    def log(name, vx):
        message = pb.VehiclePose(stamp_ns=5, frame_id="odom", vx=vx)
        return make_log(
            [
                logged("/pose", make.START_NS, make.pose(0)),
                logged("/pose", make.START_NS + 1, message.SerializeToString(), "pcgan.v1.VehiclePose"),
            ],
            name,
        )

    assert diff(log("a.mcap", np.nan), log("b.mcap", np.nan), share=1e-9).same
    found = diff(log("a.mcap", np.nan), log("b.mcap", 1.0))
    assert not found.same
    assert str(found.first).endswith("vx: nan vs 1 (atol 0.0001)")
    assert json.loads(json.dumps(found.as_json(), allow_nan=False))["same"] is False


def test_a_thinned_reference(results, make_log, logged):
    """A reference lacks what can be ignored: mixtures, pasts, the vehicle's way."""
    from schemas import pcgan_v1_pb2 as pb

    whole, thin = [], []
    for result in results[-10:]:
        at_ns = result.log_time_ns
        tracks, answer = codec.to_protobuf(result.tracks), codec.to_protobuf(result.predictions)
        whole += [logged(TRACKS, at_ns, result.tracks), logged(PREDICTIONS, at_ns, result.predictions)]
        for track in tracks.tracks:
            track.ClearField("history")
            track.x = round(track.x * 2**14) / 2**14
        for prediction in answer.predictions:
            prediction.ClearField("mixture")
        for message in (tracks, answer):
            message.ClearField("vehicle_path")
        tracks.ClearField("vehicle_history")
        thin += [
            logged(TRACKS, at_ns, tracks.SerializeToString(), pb.TrackFrame.DESCRIPTOR.full_name),
            logged(PREDICTIONS, at_ns, answer.SerializeToString(), pb.PredictionFrame.DESCRIPTOR.full_name),
        ]
    reference, output = make_log(thin, "reference.mcap"), make_log(whole, "output.mcap")
    lacking = ("tracks.history", "predictions.mixture", "vehicle_path", "vehicle_history")
    found = diff(reference, output, ignore=lacking)
    assert found.same, str(found.first)
    assert 0 < of(found, TRACKS).within <= 2**-15
    assert not diff(reference, output, ignore=lacking[1:]).same


def test_a_new_field_is_a_difference_only_once_it_is_set(tmp_path):
    """In protobuf, a field that a definition does not have is one that is not set."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
    from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet

    def write(name, fields, data):
        file = FileDescriptorProto(name="thing.proto", package="others", syntax="proto3")
        message = file.message_type.add(name="Thing")
        for number, field in enumerate(fields, 1):
            message.field.add(name=field, number=number, type=Field.TYPE_INT32, label=Field.LABEL_OPTIONAL)
        with (tmp_path / name).open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            schema = writer.register_schema(
                "others.Thing", "protobuf", FileDescriptorSet(file=[file]).SerializeToString()
            )
            writer.add_message(writer.register_channel("/thing", "protobuf", schema), 10, data, 10)
            writer.finish()
        return tmp_path / name

    old = write("old.mcap", ["speed"], b"\x08\x05")
    assert diff(old, write("new.mcap", ["speed", "limit"], b"\x08\x05")).same
    found = diff(old, write("new.mcap", ["speed", "limit"], b"\x08\x05\x10\x07"))
    assert str(found.first) == "/thing at 0.000 s, limit: 0 vs 7"
    renamed = diff(old, write("other.mcap", ["pace"], b"\x08\x05"))  # the same bytes, of another meaning
    assert not renamed.same
    assert str(renamed.first) == "/thing at 0.000 s, speed: 5 vs 0"


# --- what may not have been meant -------------------------------------------------------------------------------------


def test_an_ignored_name_that_no_message_has_is_told(scenes):
    a, b = scenes(walkers(), "a.mcap"), scenes(walkers(), "b.mcap", change=nudged(1.0))
    names = ("predictions.mixture", "tracks.z", "track")
    text = "no message has a field {!r} that could be ignored"
    for found in (diff(a, a, ignore=names), diff(a, b, ignore=names), diff(a, b, ignore=names, topics=(TRACKS,))):
        assert found.notes == (text.format("tracks.z"), text.format("track"))


def test_logs_of_other_times_are_told(recorded, edit_log):
    later = edit_log(recorded.path, lambda log: [(topic, at + 90 * 10**9, data) for topic, at, data in log])
    found, back = diff(recorded.path, later), diff(later, recorded.path)
    assert not found.same
    assert found.notes[0].endswith(": nothing was compared; the second log begins 90.000 s later")
    assert back.notes[0].endswith(": nothing was compared; the second log begins 90.000 s earlier")
    assert of(found, TRACKS).stamps == 2 * len(recorded.frames)


def test_the_first_differences_come_in_order_of_time(scenes):
    def change(k, tracks, predictions):
        late = replace(tracks, sequence=99) if k == 15 else tracks
        return late, replace(predictions, sequence=99) if k == 3 else predictions

    a, b = scenes(walkers(), "a.mcap"), scenes(walkers(), "b.mcap", change=change)
    assert [first.topic for first in diff(a, b).firsts] == [PREDICTIONS, TRACKS]
    assert [first.at_s for first in diff(b, a).firsts] == [0.3, 1.5]


def test_at_one_time_the_cause_is_told_before_its_effects(scenes):
    found = diff(scenes(walkers((1, 2, 3)), "a.mcap"), scenes(walkers((1, 2)), "b.mcap"))
    assert [each.topic for each in found.topics] == [PREDICTIONS, TRACKS]
    assert [first.topic for first in found.firsts] == [TRACKS, PREDICTIONS]
    assert str(found.first) == f"{TRACKS} at 0.000 s, track 3: only in the first log"


def test_differences_of_one_time_are_in_order_of_topics():
    def differing(topic, log_time_ns):
        first = Difference(Kind.ITEM, topic, 0.0, log_time_ns, "track 1", "", "there", "")
        return TopicDiff(topic, (1, 1), identical=False, same=False, first=first)

    topics = ["/a", "/pcgan/predictions", "/pcgan/scene", "/pcgan/tracks", "/pcgan/vehicle_pose"]
    found = LogDiff((*(differing(topic, 7) for topic in topics), differing("/z", 5)))
    assert [first.topic for first in found.firsts] == [
        "/z", "/pcgan/tracks", "/pcgan/vehicle_pose", "/pcgan/predictions", "/a", "/pcgan/scene"
    ]  # fmt: skip


def test_ids_may_be_ignored_without_mixing_people_up(scenes):
    a, b = scenes(walkers((1, 2, 3)), "a.mcap"), scenes(walkers((1, 3)), "b.mcap")
    found = diff(a, b, ignore=("tracks.id",))
    assert str(of(found, TRACKS).first).startswith(f"{TRACKS} at 0.000 s, track ")
    assert of(found, TRACKS).items == 20


def test_documents_that_only_claim_to_be_a_scene(make_log, logged):
    def log(name, *ids):
        data = json.dumps({"entities": [{"id": each} for each in ids]}).encode()
        return make_log([logged("/x", 10, data, "foxglove.SceneUpdate", "json")], name)

    found = diff(log("a.mcap", "track/1", {"no": 1}, [1]), log("b.mcap", "track/1", {"no": 2}, [1]))
    assert not found.same
    assert str(found.first).startswith("/x at 0.000 s, entities[1].id")


# --- damage, and much -------------------------------------------------------------------------------------------------


def test_a_damaged_log_needs_salvage(recorded, edit_log):
    path = edit_log(recorded.path, lambda log: log, "cut.mcap", chunk_size=20_000)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(LogError, match="try --salvage"):
        diff(recorded.path, path)
    found = diff_logs([recorded.path], [path], salvage=True)
    assert not found.same
    assert found.losses
    assert all(each.different == 0 for each in found.topics)


def test_ground_truth_and_sensors_are_compared_too(short_drive, edit_log):
    def one_person_moved(log):
        changed = []
        for topic, at, data in log:
            if topic == "/simulation/ground_truth":
                truth = codec.decode(GroundTruthFrame, data)
                moved = truth.positions_m.copy()
                moved[0, 0] += 1.0
                data = codec.encode(replace(truth, positions_m=moved))  # noqa: PLW2901
            changed.append((topic, at, data))
        return changed

    found = diff(short_drive, edit_log(short_drive, one_person_moved))
    (topic,) = [each for each in found.topics if not each.identical]
    assert topic.topic == "/simulation/ground_truth"
    assert topic.fields[0].field == "x"
    assert topic.different == topic.messages[0]
    assert str(topic.first).startswith("/simulation/ground_truth at 0.")
    assert ", x[0]: " in str(topic.first)


def test_progress_rises_to_its_end(recorded, edit_log):
    def change(log):
        return [(t, at, codec.encode(replace(codec.decode(TrackFrame, d), sequence=9)) if t == TRACKS else d)
                for t, at, d in log]  # fmt: skip

    told = []
    diff_logs([recorded.path], [edit_log(recorded.path, change)], on_progress=told.append)
    assert told == sorted(told)
    assert told[0] >= 0
    assert told[-1] == pytest.approx(1.0)
