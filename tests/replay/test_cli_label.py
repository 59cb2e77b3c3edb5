"""The command `pcgan label`: what it writes and prints, and every way it can end."""

import json
import os
import signal
import time

import pytest

from pcgan.trajectory_file import read_rows
from replay.log_reader import checksum
from replay.simulator.sensor_suite import CLUSTERS_TOPIC


def one_line(err):
    """Asserts that an error is one line of our own, and returns it."""
    (line,) = err.splitlines()
    assert line.startswith("pcgan: ")
    return line


def test_it_writes_what_it_says_and_the_same_again(pcgan, short_drive, tmp_path):
    outcome = pcgan("label", short_drive, "-o", tmp_path / "a.csv", "--json", tmp_path / "a.json")
    assert (outcome.code, outcome.err) == (0, "")
    assert "\x1b" not in outcome.out
    rows = read_rows(tmp_path / "a.csv")
    figures = json.loads((tmp_path / "a.json").read_text())
    assert figures["rows"] == rows.people.sum() > 30
    assert figures["scans"] == 30
    assert (figures["refused"], figures["refusals"], figures["salvage_losses"]) == (0, [], [])
    assert figures["settings"]["min_published"] == 0.5
    assert figures["settings"]["smoother"]
    truth = figures["ground_truth"]
    assert truth["labels"]["position_m"] < truth["tracker"]["position_m"]
    assert f"{figures['trajectories']} trajectories of {figures['tracks_kept']} tracks" in outcome.out
    assert f"{truth['labels']['velocity_mps']:.3f}" in outcome.out
    assert f"wrote {tmp_path / 'a.csv'}" in outcome.out
    assert pcgan("label", short_drive, "-o", tmp_path / "b.csv").code == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"a.csv", "a.json", "b.csv"}


def test_the_output_lies_beside_the_log_by_default(pcgan, edit_log, short_drive):
    path = edit_log(short_drive, lambda log: log, "mine.mcap")
    assert pcgan("label", path, "--duration", "1").code == 0
    assert (path.parent / "mine.trajectories.csv").is_file()


def test_settings_say_which_were_kept(pcgan, short_drive, tmp_path):
    arguments = ("--min-duration", "0.7", "--min-hits", "4", "--max-gap", "0.3")
    assert pcgan("label", short_drive, "-o", tmp_path / "o.csv", "--json", tmp_path / "j", *arguments).code == 0
    settings = json.loads((tmp_path / "j").read_text())["settings"]
    assert (settings["min_duration_s"], settings["min_hits"], settings["max_gap_s"]) == (0.7, 4, 0.3)


def test_start_duration_and_limits(pcgan, short_drive, tmp_path):
    arguments = ("label", short_drive, "-o", tmp_path / "o.csv", "--start", 1, "--duration", 1.5)
    assert pcgan(*arguments, "--json", tmp_path / "j").code == 0
    figures = json.loads((tmp_path / "j").read_text())
    assert figures["scans"] == pytest.approx(15, abs=1)
    assert figures["rows"] > 0
    assert pcgan(*arguments, "--json", tmp_path / "j", "--min-duration", "2").code == 0
    assert json.loads((tmp_path / "j").read_text())["rows"] == 0
    assert pcgan(*arguments, "--json", tmp_path / "j", "--min-hits", "20").code == 0
    assert json.loads((tmp_path / "j").read_text())["rows"] == 0


def test_without_ground_truth_there_is_no_table(pcgan, short_drive, edit_log, tmp_path):
    path = edit_log(short_drive, lambda log: [m for m in log if "truth" not in m[0]])
    outcome = pcgan("label", path, "-o", tmp_path / "o.csv", "--json", tmp_path / "j")
    assert outcome.code == 0
    assert "against ground truth" not in outcome.out
    assert "ground_truth" not in json.loads((tmp_path / "j").read_text())


def test_refused_messages_are_exit_3_and_strict_stops(pcgan, short_drive, edit_log, tmp_path):
    path = edit_log(short_drive, lambda log: [*log[:500], (CLUSTERS_TOPIC, log[499][1], b"\xff\xff\xff"), *log[500:]])
    outcome = pcgan("label", path, "-o", tmp_path / "o.csv")
    assert outcome.code == 3
    assert f"{CLUSTERS_TOPIC} at " in outcome.out
    assert "1 message was refused" in outcome.out
    outcome = pcgan("label", path, "-o", tmp_path / "strict.csv", "--strict")
    assert outcome.code == 2
    assert "without --strict the run would go on" in one_line(outcome.err)
    assert not (tmp_path / "strict.csv").exists()


def test_a_damaged_file_wants_salvage(pcgan, short_drive, edit_log, tmp_path):
    path = edit_log(short_drive, lambda log: log, "damaged.mcap", chunk_size=20_000)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 4])
    outcome = pcgan("label", path, "-o", tmp_path / "o.csv")
    assert outcome.code == 2
    assert "try --salvage" in one_line(outcome.err)
    outcome = pcgan("label", path, "-o", tmp_path / "o.csv", "--salvage")
    assert outcome.code == 3
    assert "the file is damaged; every intact chunk was used" in outcome.out
    assert (tmp_path / "o.csv").is_file()


@pytest.mark.parametrize(
    ("output", "words"),
    [
        ("o.txt", "must end in .csv, .csv.gz, .parquet"),
        ("no/o.csv", "cannot be written"),
    ],
)
def test_an_output_that_cannot_be_is_said_at_once(pcgan, short_drive, tmp_path, output, words):
    outcome = pcgan("label", short_drive, "-o", tmp_path / output)
    assert outcome.code == 2
    assert words in one_line(outcome.err)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["-o", "--json"])
def test_the_recording_is_never_overwritten(pcgan, short_drive, edit_log, tmp_path, option):
    path = edit_log(short_drive, lambda log: log, "mine.mcap")
    path = path.rename(path.with_name("mine.csv"))
    before = checksum(path)
    outcome = pcgan("label", path, *(() if option == "-o" else ("-o", tmp_path / "o.csv")), option, path)
    assert checksum(path) == before
    assert outcome.code == 2
    assert "is the recording itself" in one_line(outcome.err)


@pytest.mark.parametrize("name", ["x.csv", "x.part.csv"])
def test_two_outputs_in_one_file_are_refused(pcgan, short_drive, tmp_path, name):
    outcome = pcgan("label", short_drive, "-o", tmp_path / "x.csv", "--json", tmp_path / name)
    assert outcome.code == 2
    assert f"{name} would be written twice" in one_line(outcome.err)
    assert list(tmp_path.iterdir()) == []


def test_parquet_without_pyarrow_is_said_at_once(pcgan, short_drive, tmp_path, monkeypatch):
    monkeypatch.setattr("replay.cli_label.find_spec", lambda _: None)
    outcome = pcgan("label", short_drive, "-o", tmp_path / "o.parquet")
    assert outcome.code == 2
    assert "needs the package pyarrow" in one_line(outcome.err)


@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interruption_writes_nothing(pcgan, short_drive, tmp_path, monkeypatch, signum, code):
    """Ctrl-C comes while the file is being written: the worst moment."""

    def write_slowly(_, path):
        path.write_text("half")
        os.kill(os.getpid(), signum)
        time.sleep(5)

    monkeypatch.setattr("replay.label.write_rows", write_slowly)
    assert pcgan("label", short_drive, "-o", tmp_path / "o.csv").code == code
    assert list(tmp_path.iterdir()) == []
