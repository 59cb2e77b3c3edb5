"""The command `pcgan diff`: what it prints and writes, and every way it can end."""

import json
import os
import signal
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from replay.log_reader import checksum
from replay.reference import write_reference
from replay.replay_job import ReplayJob, run_job
from replay.session import ReplaySettings
from schemas import codec
from schemas.messages import TrackFrame

TRACKS = "/pcgan/tracks"


def one_line(err):
    """Asserts that an error is one line of our own, and returns it."""
    (line,) = err.splitlines()
    assert line.startswith("pcgan: ")
    return line


@pytest.fixture
def nudged(recorded, edit_log):
    """An output whose tracks are 3 cm to the left from the 15th frame on, and its first time that is so."""
    since = recorded.frames[15]
    assert since.tracks.tracks

    def change(log):
        for topic, at, data in log:
            if topic != TRACKS or at < since.log_time_ns:
                yield topic, at, data
                continue
            frame = codec.decode(TrackFrame, data)
            moved = [replace(track, state=track.state + np.array([0, 0.03, 0, 0])) for track in frame.tracks]
            yield topic, at, codec.encode(replace(frame, tracks=tuple(moved)))

    return edit_log(recorded.path, change, "nudged.mcap"), since


def test_the_same(pcgan, recorded):
    outcome = pcgan("diff", recorded.path, recorded.path)
    assert (outcome.code, outcome.err) == (0, "")
    assert "\x1b" not in outcome.out
    assert outcome.out.rstrip().endswith("identical: the same bytes at the same times")


def test_the_first_difference_and_where_the_others_are(pcgan, recorded, nudged):
    path, since = nudged
    before = checksum(recorded.path), checksum(path)
    outcome = pcgan("diff", recorded.path, path)
    assert (outcome.code, outcome.err) == (1, "")
    at_s = (since.log_time_ns - recorded.frames[0].log_time_ns) / 1e9
    track = since.tracks.tracks[0]
    y = float(track.state[1])
    first, *rest = outcome.out.splitlines()
    assert first == f"{TRACKS} at {at_s:.3f} s, track {track.id}, state y: {y:.3f} vs {y + 0.03:.3f} (atol 0.0001)"
    (row,) = [line for line in rest if line.strip().startswith(TRACKS)]
    count = str(len(recorded.frames))
    assert row.split()[:4] == [TRACKS, "different", count, count]
    assert "…" not in row
    assert f"{at_s:.3f} s" in row
    assert "0.03" in row
    bars = row.split()[-1]
    assert bars[0] == bars[5] == "·"
    assert bars[-1] in "▁▂▃▄▅▆▇█"
    (field,) = [line for line in rest if line.strip().startswith("tracks.y")]
    tracks = sum(len(frame.tracks.tracks) for frame in recorded.frames[15:])
    assert field.split()[1:3] == [str(tracks), str(tracks)]
    assert rest[-1] == "different: 1 of 4 topics (atol 0.0001, rtol 1e-06)"
    assert (checksum(recorded.path), checksum(path)) == before


@pytest.mark.parametrize(
    "options",
    [
        ("--atol", 0.1),
        ("--ignore", "tracks.y"),
        ("--ignore", "vehicle_history,tracks"),
        ("--topics", "/pcgan/pred*"),
        ("--topics", "pcgan/scene,/pcgan/predictions", "--topics", "/pcgan/vehicle_pose"),
        ("--share", 0.5),
    ],
)
def test_options_that_make_it_the_same(pcgan, recorded, nudged, options):
    assert pcgan("diff", recorded.path, nudged[0]).code == 1
    outcome = pcgan("diff", recorded.path, nudged[0], *options)
    assert outcome.code == 0
    last = outcome.out.splitlines()[-1]
    assert last.startswith("identical" if "--topics" in options else "the same within atol ")
    if options == ("--atol", 0.1):
        assert last == "the same within atol 0.1, rtol 1e-06; the largest difference is 0.03"


def test_json(pcgan, recorded, nudged):
    outcome = pcgan("diff", recorded.path, nudged[0], "--json")
    assert (outcome.code, outcome.err) == (1, "")
    found = json.loads(outcome.out)
    assert (found["same"], found["identical"], found["renumbered"]) == (False, False, {})
    (tracks,) = [topic for topic in found["topics"] if not topic["same"]]
    assert tracks["topic"] == TRACKS
    assert (tracks["first"]["kind"], tracks["first"]["field"]) == ("value", "tracks.y")
    assert tracks["first"]["size"] == pytest.approx(0.03)
    assert sum(tracks["when"]) == len(recorded.frames) - 15
    assert {field["field"] for field in tracks["fields"]} == {"tracks.y"}


def test_a_recording_with_both(pcgan, recorded, nudged, tmp_path):
    outcome = pcgan("diff", recorded.path, nudged[0], "--rrd", tmp_path / "both.rrd")
    assert outcome.code == 1
    assert outcome.out.splitlines()[-1] == f"wrote {tmp_path / 'both.rrd'}"
    assert (tmp_path / "both.rrd").stat().st_size > 10_000


def test_what_may_not_be_meant_is_a_note(pcgan, recorded):
    outcome = pcgan("diff", recorded.path, recorded.path, "--ignore", "tracks.vz,tracks.vx", "--json")
    assert outcome.code == 0
    assert outcome.err == "note: no message has a field 'tracks.vz' that could be ignored\n"
    assert json.loads(outcome.out)["notes"] == ["no message has a field 'tracks.vz' that could be ignored"]


def test_what_a_reference_leaves_out_is_no_difference(pcgan, short_drive, model, tmp_path):
    output, reference = tmp_path / "out.mcap", tmp_path / "case.reference.mcap"
    summary = run_job(
        ReplayJob((short_drive,), output, ReplaySettings(duration_s=2.0), model, emit=("pcgan", "foxglove"))
    )
    write_reference(reference, output, summary.as_json(), "the first")
    note = (
        "note: case.reference.mcap is a thinned reference: tracks.history, vehicle_history, vehicle_path, "
        "predictions.mixture, model, and topics other than /pcgan/tracks, /pcgan/predictions, /pcgan/vehicle_pose, "
        "are not compared\n"
    )
    for pair in ((reference, output), (output, reference)):
        outcome = pcgan("diff", *pair, "--atol", 0, "--rtol", 0)
        assert (outcome.code, outcome.err) == (0, note)
    assert pcgan("diff", reference, output, "--topics", "/pcgan/scene").code == 1  # which was asked for
    assert pcgan("diff", reference, reference).err == ""
    assert pcgan("diff", output, output).err == ""


def test_a_reference_and_another_output_differ_first_where_check_says(pcgan, nudged, recorded, tmp_path):
    path, since = nudged
    reference = tmp_path / "case.reference.mcap"
    write_reference(reference, recorded.path, recorded.summary.as_json(), "the first")
    outcome = pcgan("diff", reference, path, "--json")
    assert outcome.code == 1
    found = json.loads(outcome.out)
    assert "case.reference.mcap is a thinned reference" in found["notes"][0]
    (tracks,) = [topic for topic in found["topics"] if not topic["same"]]
    assert (tracks["first"]["field"], tracks["first"]["log_time_ns"]) == ("tracks.y", since.log_time_ns)


def test_renumbered_tracks_are_told(pcgan, recorded, edit_log):
    def shift(log):
        for topic, at, data in log:
            if topic != TRACKS:
                continue
            frame = codec.decode(TrackFrame, data)
            tracks = tuple(replace(track, id=track.id + 100) for track in frame.tracks)
            yield topic, at, codec.encode(replace(frame, tracks=tracks))

    outcome = pcgan("diff", recorded.path, edit_log(recorded.path, shift), "--topics", TRACKS)
    assert outcome.code == 0
    numbers = sorted({track.id for frame in recorded.frames for track in frame.tracks.tracks})
    line = next(line for line in outcome.out.splitlines() if "other number" in line or "another number" in line)
    assert line.startswith(f"{len(numbers)} tracks have other numbers in the second log")
    assert f"{numbers[0]} is {numbers[0] + 100}" in line
    assert "left out" not in line


def test_errors_are_one_line_and_exit_2(pcgan, recorded, tmp_path):
    (tmp_path / "text.mcap").write_text("no log")
    for arguments, text in (
        ((tmp_path / "none.mcap", recorded.path), "none.mcap cannot be read: No such file"),
        ((recorded.path, tmp_path / "text.mcap"), "text.mcap is not a readable MCAP file"),
        ((recorded.path, recorded.path, "--topics", "/nope"), "neither log has a topic '/nope'"),
        ((recorded.path, recorded.path, "--rrd", tmp_path / "no" / "x.rrd"), "cannot be written"),
        ((recorded.path, recorded.path, "--rrd", recorded.path), "never overwritten"),
    ):
        outcome = pcgan("diff", *arguments)
        assert outcome.code == 2, arguments
        assert text in one_line(outcome.err)
        assert outcome.out == ""
    assert not list(tmp_path.glob("*.rrd*"))


def test_salvage(pcgan, recorded, edit_log):
    path = edit_log(recorded.path, lambda log: log, "cut.mcap", chunk_size=20_000)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert "try --salvage" in one_line(pcgan("diff", recorded.path, path).err)
    outcome = pcgan("diff", recorded.path, path, "--salvage")
    assert outcome.code == 1
    assert "damaged: cut.mcap: " in outcome.out


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ends a process by signal")
@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_leave_nothing_behind(start_pcgan, nudged, recorded, edit_log, tmp_path, signum, code):
    start_ns = recorded.frames[0].log_time_ns
    last_ns = recorded.frames[-1].log_time_ns + 10**8

    def repeated(log):
        log = list(log)
        for k in range(60):
            for topic, at, data in log:
                yield topic, at + k * (last_ns - start_ns), data

    a, b = (edit_log(path, repeated, name) for path, name in ((recorded.path, "a.mcap"), (nudged[0], "b.mcap")))
    process = start_pcgan("diff", a, b, "--rrd", tmp_path / "both.rrd")
    deadline = time.monotonic() + 30
    while not list(tmp_path.glob("both.rrd.part")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.3)
    os.kill(process.pid, signum)
    out, err = process.communicate(timeout=30)
    assert process.returncode == code, (out, err)
    assert not (tmp_path / "both.rrd").exists()
