"""The command `pcgan export`: what it writes and prints, and every way it can end."""

import os
import signal
import sys
import time

import pyarrow.parquet as pq
import pytest

from replay.log_reader import checksum


def one_line(err):
    """Asserts that an error is one line of our own, and returns it."""
    (line,) = err.splitlines()
    assert line.startswith("pcgan: ")
    return line


@pytest.fixture
def output(recorded, edit_log):
    """An output of a replay, in a folder of the test's own."""
    return edit_log(recorded.path, lambda log: log, "drive.pcgan.mcap")


def test_it_writes_what_it_says(pcgan, output, recorded, tmp_path):
    before = checksum(output)
    outcome = pcgan("export", output, "-o", tmp_path / "tables", "--mixtures")
    assert (outcome.code, outcome.err) == (0, "")
    assert "\x1b" not in outcome.out
    for name in ("tracks", "predictions", "mixtures"):
        path = tmp_path / "tables" / f"{name}.parquet"
        assert f"wrote {path}, {pq.read_metadata(path).num_rows} rows" in outcome.out
    tracks = sum(len(frame.tracks.tracks) for frame in recorded.frames)
    assert pq.read_metadata(tmp_path / "tables" / "tracks.parquet").num_rows == tracks > 0
    assert checksum(output) == before


def test_the_tables_lie_beside_the_log_by_default(pcgan, output):
    assert pcgan("export", output).code == 0
    assert {path.name for path in (output.parent / "drive.pcgan").iterdir()} == {
        "tracks.parquet", "predictions.parquet"
    }  # fmt: skip


def test_start_and_duration(pcgan, output, recorded, tmp_path):
    assert pcgan("export", output, "-o", tmp_path / "t", "--start", 1, "--duration", 1).code == 0
    begin = recorded.frames[0].log_time_ns + 10**9
    wanted = {f.tracks.sequence for f in recorded.frames if begin <= f.log_time_ns < begin + 10**9 and f.tracks.tracks}
    found = pq.read_table(tmp_path / "t" / "tracks.parquet").column("sequence").to_pylist()
    assert set(found) == wanted
    assert 5 <= len(wanted) <= 11


def test_a_start_behind_the_end(pcgan, output, tmp_path):
    outcome = pcgan("export", output, "-o", tmp_path / "t", "--start", 100)
    assert outcome.code == 2
    assert "--start 100: the log ends after 2." in one_line(outcome.err)
    assert not (tmp_path / "t").exists()


def test_a_recording_without_predictions_is_told_so(pcgan, short_drive, tmp_path):
    outcome = pcgan("export", short_drive, "-o", tmp_path / "t")
    assert outcome.code == 2
    assert "short.mcap holds no tracks or predictions of pcgan replay" in one_line(outcome.err)
    assert not (tmp_path / "t").exists()


def test_half_a_log_is_half_the_tables_and_a_note(pcgan, output, edit_log, tmp_path):
    half = edit_log(output, lambda log: [m for m in log if m[0] == "/pcgan/tracks"], "half.mcap")
    outcome = pcgan("export", half, "-o", tmp_path / "t")
    assert outcome.code == 0
    assert outcome.err == "note: the log has nothing for the table predictions\n"
    assert [path.name for path in (tmp_path / "t").iterdir()] == ["tracks.parquet"]


def test_refused_messages_are_exit_3(pcgan, output, edit_log, tmp_path):
    def damage(log):
        first = next(i for i, message in enumerate(log) if message[0] == "/pcgan/tracks")
        return [(topic, at, b"\xff" if i == first else data) for i, (topic, at, data) in enumerate(log)]

    outcome = pcgan("export", edit_log(output, damage, "bad.mcap"), "-o", tmp_path / "t")
    assert outcome.code == 3
    assert "/pcgan/tracks at " in outcome.out
    assert "1 message was refused" in outcome.out
    assert (tmp_path / "t" / "tracks.parquet").is_file()


def test_salvage_is_exit_3_and_without_it_exit_2(pcgan, output, edit_log, tmp_path):
    path = edit_log(output, lambda log: log, "cut.mcap", chunk_size=20_000)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    outcome = pcgan("export", path, "-o", tmp_path / "t")
    assert outcome.code == 2
    assert "try --salvage" in one_line(outcome.err)
    outcome = pcgan("export", path, "-o", tmp_path / "t", "--salvage")
    assert outcome.code == 3
    assert "the file is damaged" in outcome.out
    assert pq.read_metadata(tmp_path / "t" / "tracks.parquet").num_rows > 0


@pytest.mark.parametrize("name", ["out.parquet", "file"])
def test_the_output_is_a_folder(pcgan, output, tmp_path, name):
    (tmp_path / "file").write_text("")
    outcome = pcgan("export", output, "-o", tmp_path / name)
    assert outcome.code == 2
    assert f"{name} must be a folder: it gets tracks.parquet, predictions.parquet" in one_line(outcome.err)


def test_a_log_without_an_ending_needs_a_folder(pcgan, output, tmp_path):
    bare = output.rename(tmp_path / "bare")
    outcome = pcgan("export", bare)
    assert outcome.code == 2
    assert "say with -o where the tables go" in one_line(outcome.err)


def test_the_input_is_never_overwritten(pcgan, output, tmp_path):
    trap = output.rename(tmp_path / "tracks.parquet")
    before = checksum(trap)
    outcome = pcgan("export", trap, "-o", tmp_path)
    assert outcome.code == 2
    assert "never overwritten" in one_line(outcome.err)
    assert checksum(trap) == before


def test_without_pyarrow_it_says_what_to_install(pcgan, output, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    outcome = pcgan("export", output, "-o", tmp_path / "t")
    assert outcome.code == 2
    assert "pip install 'pcgan[data]'" in one_line(outcome.err)
    assert not (tmp_path / "t").exists()


@pytest.mark.slow
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_nothing_half_written(start_pcgan, output, edit_log, tmp_path, signum):
    def long(log):
        return [(topic, at + round * 10**10, data) for round in range(300) for topic, at, data in log]

    path = edit_log(output, long, "long.mcap")
    process = start_pcgan("export", path, "-o", tmp_path / "t", "--mixtures")
    deadline = time.monotonic() + 60
    while not (tmp_path / "t" / "tracks.parquet.part").exists():
        assert time.monotonic() < deadline
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    os.kill(process.pid, signum)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 128 + signum
    assert "Traceback" not in err
    assert list((tmp_path / "t").iterdir()) == []
