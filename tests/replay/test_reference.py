"""References: what they keep, how an output compares with one, and what they say about themselves."""

import dataclasses
import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from replay.check_result import Status
from replay.diff import diff_logs
from replay.diff_result import Tolerances
from replay.errors import OutputError
from replay.expectations import figures
from replay.log_reader import checksum
from replay.reference import (
    THINNED,
    BadReference,
    changes,
    compare,
    read_content,
    read_origin,
    read_reference,
    write_reference,
)
from replay.replay_job import ReplayJob, run_job
from replay.session import ReplaySettings
from replay.thin_output import GRID
from schemas import codec
from schemas.messages import PredictionFrame, TrackFrame

EXACT = Tolerances(atol=0, rtol=0)
SHORT = ReplaySettings(duration_s=2.0)


@pytest.fixture(scope="module")
def output(short_drive, model, tmp_path_factory):
    """Two seconds of the short drive: path and summary."""
    path = tmp_path_factory.mktemp("output") / "out.mcap"
    return path, run_job(ReplayJob((short_drive,), path, SHORT, model)).as_json()


@pytest.fixture
def reference(output, tmp_path):
    path = tmp_path / "case.reference.mcap"
    write_reference(path, *output, "the first")
    return path


def changed(path, folder, change):
    """A copy of an output with the dataclasses of its messages changed; metadata and attachments stay."""
    copy = folder / "changed.mcap"
    kinds = {"/pcgan/tracks": TrackFrame, "/pcgan/predictions": PredictionFrame}
    with path.open("rb") as source, copy.open("wb") as target:
        reader, writer = make_reader(source), Writer(target)
        writer.start()
        channels = {}
        for schema, channel, message in reader.iter_messages():
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, number)
            data = message.data
            if kind := kinds.get(channel.topic):
                data = codec.encode(change(codec.decode(kind, data)))
            writer.add_message(channels[channel.topic], message.log_time, data, message.log_time)
        for each in reader.iter_attachments():
            writer.add_attachment(each.create_time, each.log_time, each.name, each.media_type, each.data)
        for each in reader.iter_metadata():
            writer.add_metadata(each.name, each.metadata)
        writer.finish()
    return copy


def renumbered(frame):
    if isinstance(frame, TrackFrame):
        tracks = tuple(dataclasses.replace(track, id=track.id + 100) for track in frame.tracks)
        return dataclasses.replace(frame, tracks=tracks)
    predictions = tuple(dataclasses.replace(each, track_id=each.track_id + 100) for each in frame.predictions)
    return dataclasses.replace(frame, predictions=predictions)


def moved(metres):
    """A change that shifts every tracked position by so much."""

    def move(frame):
        if isinstance(frame, PredictionFrame):
            return frame
        tracks = tuple(dataclasses.replace(t, state=t.state + np.array([metres, 0, 0, 0])) for t in frame.tracks)
        return dataclasses.replace(frame, tracks=tracks)

    return move


def mixtures(fields):
    """A change of the mixtures alone: of what `fields` returns of each."""

    def change(frame):
        if isinstance(frame, TrackFrame):
            return frame
        predictions = tuple(
            dataclasses.replace(p, mixture=dataclasses.replace(p.mixture, **fields(p.mixture)))
            for p in frame.predictions
        )
        return dataclasses.replace(frame, predictions=predictions)

    return change


def wider(factor):
    return mixtures(lambda m: {"sigmas_m": m.sigmas_m * factor})


def test_what_changes_nothing_is_identical(reference, output, short_drive, model, tmp_path):
    again = tmp_path / "again.mcap"
    summary = run_job(ReplayJob((short_drive,), again, SHORT, model)).as_json()
    found = compare(reference, again, summary, EXACT)
    assert (found.status, found.problem, found.diff) == (Status.IDENTICAL, "", None)
    assert found.reference.changed == ()
    assert found.reference.reason == "the first"
    assert figures(found.reference_summary).items() <= figures(output[1]).items()


def test_the_same_output_gives_the_same_file(reference, output, tmp_path):
    other = tmp_path / "elsewhere" / "other.mcap"
    write_reference(other, *output, "the  first ")
    assert checksum(other) == checksum(reference)
    assert not list(tmp_path.rglob("*.part"))


def test_a_reference_is_a_thin_output_with_what_made_it(reference, output, mcap_content):
    assert reference.stat().st_size < output[0].stat().st_size / 5
    whole, thin = mcap_content(output[0]), mcap_content(reference)
    assert [message[:2] for message in thin.messages] == [message[:2] for message in whole.messages]
    assert diff_logs([reference], [output[0]], Tolerances(atol=GRID / 2, rtol=0, ignore=THINNED)).same
    assert thin.attachments["settings.json"] == whole.attachments["settings.json"]
    assert "wall_s" not in json.loads(thin.attachments["summary.json"])


def test_tracks_numbered_otherwise_are_close(reference, output, tmp_path):
    found = compare(reference, changed(output[0], tmp_path, renumbered), output[1], EXACT)
    assert found.status is Status.CLOSE
    assert found.diff.renumbered


@pytest.mark.parametrize(("metres", "status"), [(5e-5, Status.CLOSE), (2e-4, Status.CHANGED)])
def test_tolerances_count(reference, output, tmp_path, metres, status):
    copy = changed(output[0], tmp_path, moved(metres))
    found = compare(reference, copy, output[1], Tolerances(rtol=0))
    assert found.status is status
    assert compare(reference, copy, output[1], Tolerances(atol=0.001)).status is Status.CLOSE
    ignoring = Tolerances(atol=0, rtol=0, ignore=("tracks.x", "tracks.vx"))
    assert compare(reference, copy, output[1], ignoring).status is Status.CLOSE
    if status is Status.CHANGED:
        assert found.problem == str(found.diff.first)
        assert found.problem.startswith("/pcgan/tracks at ")
        assert "(atol 0.0001)" in found.problem


def test_a_track_that_is_gone_is_only_in_the_reference(reference, output, tmp_path):
    def without_the_first(frame):
        if isinstance(frame, TrackFrame):
            return dataclasses.replace(frame, tracks=frame.tracks[1:])
        return dataclasses.replace(frame, predictions=frame.predictions[1:])

    found = compare(reference, changed(output[0], tmp_path, without_the_first), output[1], Tolerances())
    assert found.status is Status.CHANGED
    assert found.problem.endswith(": only in the reference")


@pytest.mark.parametrize(("factor", "status"), [(1.00001, Status.CLOSE), (1.05, Status.CHANGED)])
def test_mixtures_are_not_kept_and_yet_watched(reference, output, tmp_path, factor, status):
    copy = changed(output[0], tmp_path, wider(factor))
    found = compare(reference, copy, output[1], Tolerances())
    assert found.status is status
    assert found.diff.same
    if status is Status.CHANGED:
        assert "the paths are the same, their mixtures are not: spread_m " in found.problem
    ignoring = Tolerances(ignore=("predictions.mixture",))
    assert compare(reference, copy, output[1], ignoring).status is Status.CLOSE
    only_tracks = Tolerances(topics=("/pcgan/tracks",))
    assert compare(reference, copy, output[1], only_tracks).status is Status.CLOSE


def test_mixtures_that_are_not_where_their_paths_are_are_noticed(reference, output, tmp_path):
    found = compare(
        reference,
        changed(output[0], tmp_path, mixtures(lambda m: {"means_m": m.means_m + 0.5})),
        output[1],
        Tolerances(),
    )
    assert found.status is Status.CHANGED
    assert "the paths are the same, their mixtures are not: spread_m " in found.problem


def test_the_likelihood_speaks_for_the_mixtures_too(reference, output, tmp_path):
    copy = changed(output[0], tmp_path, wider(1.00001))
    worse = {**output[1], "nll": 0.9, "ground_truth": {**output[1]["ground_truth"], "nll": None}}
    found = compare(reference, copy, worse, Tolerances())
    before = output[1]["nll"]
    assert found.status is Status.CHANGED
    assert f"nll {'nothing' if before is None else f'{before:.4g}'} -> 0.9" in found.problem


def test_the_spread_is_counted_from_the_likeliest_path(output, tmp_path):
    """Where the mixtures are 5 km away from the paths, their width and the other paths count for nothing."""
    away = mixtures(lambda m: {"means_m": m.means_m + np.array([3000, 4000])})
    assert 0.1 < read_content(output[0]).spread_m < 10
    assert read_content(changed(output[0], tmp_path, away)).spread_m == pytest.approx(5000, rel=1e-2)


def test_no_reference_is_no_error(output, tmp_path):
    found = compare(tmp_path / "gone.mcap", *output, Tolerances())
    assert (found.status, found.reference) == (Status.UNREFERENCED, None)


def test_causes_are_named_beside_the_effect(reference, short_drive, model, tmp_path):
    settings = ReplaySettings.model_validate({"duration_s": 2, "tracking": {"tracker": {"confirm_hits": 4}}})
    other = tmp_path / "other.mcap"
    summary = run_job(ReplayJob((short_drive,), other, settings, model)).as_json()
    found = compare(reference, other, summary, Tolerances())
    assert found.status is Status.CHANGED
    assert found.reference.changed == ("tracking.tracker.confirm_hits 2 -> 4",)


def test_changes_in_words(output):
    origin = read_origin(output[0])
    other = dataclasses.replace(
        origin,
        version="9.9",
        model="other",
        model_sha256="0123456789abcdef",
        inputs=(("short.mcap", "fedcba9876543210"),),
        settings={**origin.settings, "duration_s": None, "new": 1},
    )
    mine, name = origin.model_sha256[:8], origin.inputs[0][1][:8]
    assert changes(origin, other) == (
        f"version {origin.version} -> 9.9",
        f"model random ({mine}) -> other (01234567)",
        f"input short.mcap {name} -> short.mcap fedcba98",
        "duration_s 2.0 -> null",
        "new nothing -> 1",
    )
    retrained = dataclasses.replace(origin, model_sha256="0123456789abcdef")
    assert changes(origin, retrained) == (f"model {mine} -> 01234567",)


def test_reasons_are_remembered(reference, output):
    write_reference(reference, *output, "the second")
    write_reference(reference, *output, "the third")
    stored = read_reference(reference)
    assert stored.reason == "the third"
    assert [each["reason"] for each in stored.former] == ["the second", "the first"]
    assert stored.origin == read_origin(output[0])
    assert stored.content == read_content(output[0])


def damaged(data):
    return data[: len(data) // 2] + bytes(64) + data[len(data) // 2 + 64 :]


def with_an_endless_attachment(data):
    """The length of the record of settings.json, nine bytes of header before its two times, is set to 2^56 and more."""
    record = data.index(b"settings.json") - 4 - 16 - 9
    assert data[record] == 9
    return data[: record + 8] + b"\x01" + data[record + 9 :]


@pytest.mark.parametrize(
    "damage",
    [damaged, with_an_endless_attachment, lambda data: data[:-100], lambda _: b"", lambda _: b"nonsense"],
)
def test_a_damaged_reference_is_one_line(reference, output, damage):
    reference.write_bytes(damage(reference.read_bytes()))
    with pytest.raises(BadReference) as refusal:
        compare(reference, *output, Tolerances())
    line = str(refusal.value)
    assert reference.name in line
    assert line.endswith("; write it anew with --update --reason TEXT")
    assert "\n" not in line
    assert "--salvage" not in line
    write_reference(reference, *output, "anew")
    assert read_reference(reference).former == ()


def test_what_is_no_reference_or_of_another_format(output, short_drive, tmp_path):
    with pytest.raises(BadReference, match="is no reference: it has no record"):
        compare(short_drive, *output, Tolerances())
    old = tmp_path / "old.mcap"
    with old.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        number = writer.register_channel("/x", "json", 0)
        writer.add_message(number, 1, b"{}", 1)
        writer.add_metadata("pcgan.reference", {"format": "0"})
        writer.finish()
    with pytest.raises(BadReference, match="is a reference of format '0', and this version reads '1'"):
        read_reference(old)


def test_a_reference_that_cannot_be_written_leaves_the_old_one(reference, output, tmp_path):
    before = reference.read_bytes()
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"case\.mcap cannot be written"):
        write_reference(tmp_path / "file" / "case.mcap", *output, "why not")
    (tmp_path / "case.reference.mcap.part").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        write_reference(reference, *output, "why not")
    assert reference.read_bytes() == before
