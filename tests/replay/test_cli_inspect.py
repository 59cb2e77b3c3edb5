"""`pcgan inspect`: what it prints with and without ground truth, the files it writes, one line for a mistake."""

import json
import os
import re
import signal
import time

import pytest

from replay.log_reader import checksum
from replay.simulator.sensor_suite import CLUSTERS_TOPIC, GROUND_TRUTH_TOPIC


def one_line(outcome):
    assert outcome.code == 2
    (line,) = [line for line in outcome.err.splitlines() if not line.startswith("note: ")]
    return line


def test_a_log_is_checked_and_its_people_are_counted(pcgan, short_drive, tmp_path):
    before = checksum(short_drive)
    outcome = pcgan("inspect", short_drive, "--json", tmp_path / "all.json")
    assert outcome.code == 0
    assert outcome.err == ""
    for words in (
        "stamps",
        "cameras against the LiDAR",
        "nothing wrong was found; checked: the stamps, ",
        "missed longest",
    ):
        assert words in outcome.out
    assert "people had 4 LiDAR points or more" in outcome.out
    assert f"wrote {tmp_path / 'all.json'}" in outcome.out
    figures = json.loads((tmp_path / "all.json").read_text())
    assert set(figures) == {
        "files", "frames", "recording", "summary", "refused", "refusals", "salvage_losses"
    }  # fmt: skip
    assert len(figures["frames"]) == figures["summary"]["frames"] == 30
    assert len(figures["recording"]["cameras"]) == 6
    assert figures["recording"]["verdicts"] == []
    assert figures["summary"]["missed_s"] == pytest.approx(sum(figures["summary"]["reasons"].values()), abs=1e-3)
    first = figures["frames"][0]
    assert {"at_s", "stamp_ns", "clusters", "boxes", "unmeasured", "people"} <= set(first)
    assert checksum(short_drive) == before


def test_without_ground_truth_it_lists_what_looked_like_people(pcgan, short_drive, edit_log):
    log = edit_log(short_drive, lambda log: [m for m in log if m[0] != GROUND_TRUTH_TOPIC])
    outcome = pcgan("inspect", log)
    assert outcome.code == 0
    assert "no ground truth; what looked like a person for half a second or longer and was not tracked" in outcome.out
    assert "missed longest" not in outcome.out


def test_one_frame_and_every_frame(pcgan, short_drive, tmp_path):
    outcome = pcgan("inspect", short_drive, "--at", "1.5", "--json", tmp_path / "one.json")
    assert outcome.code == 0
    for words in ("people (ground truth)", "clusters, nearest first", "what came of it", "track "):
        assert words in outcome.out
    assert "stamps" not in outcome.out
    assert re.search(r"A\d:\d+ \.\d\d fit \d?\.\d\d", outcome.out)
    (one,) = json.loads((tmp_path / "one.json").read_text())["frames"]
    assert abs(one["at_s"] - 1.5) <= 0.06

    outcome = pcgan("inspect", short_drive, "--frames", "--start", "1.2", "--duration", "0.6", "--json", tmp_path / "j")
    assert outcome.code == 0
    some = json.loads((tmp_path / "j").read_text())["frames"]
    assert outcome.out.count("clusters, nearest first") == len(some) == pytest.approx(6, abs=1)
    # ids and outcomes of a frame do not depend on how it was asked for, since the tracker is warmed up
    assert next(frame for frame in some if frame["stamp_ns"] == one["stamp_ns"]) == one


@pytest.mark.parametrize("width", [60, 100, 140])
def test_tables_fit_100_columns(pcgan, short_drive, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    for arguments in ((), ("--at", "1.5")):
        tables = [line for line in pcgan("inspect", short_drive, *arguments).out.splitlines() if "─" in line]
        assert tables
        assert max(map(len, tables)) <= max(width, 100)


def test_a_recording_of_the_view(pcgan, short_drive, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    outcome = pcgan("inspect", short_drive, "--start", "1", "--duration", "0.5", "--rrd", tmp_path / "why.rrd")
    assert outcome.code == 0
    content = (tmp_path / "why.rrd").read_bytes()
    for entity in (b"map/verdicts", b"cameras/A0/clusters", b"cameras/A0/left_over"):
        assert entity in content


def test_a_time_offset_is_used(pcgan, short_drive, tmp_path):
    arguments = ("--time-offset", "/gmsl/A1/detections:=-200", "--json", tmp_path / "all.json")
    outcome = pcgan("inspect", short_drive, *arguments)
    assert outcome.code == 0
    assert "! /gmsl/A1/detections: logged 25" in outcome.out
    assert re.search(r"its stamps may be (19|20)\d ms too early", outcome.out)


@pytest.mark.parametrize("option", ["/gmsl/A1/detections", "/gmsl/A1/detections:=x", "a:=1e9", "a:=nan"])
@pytest.mark.parametrize("command", ["inspect", "replay"])
def test_a_time_offset_that_is_none_shows_an_example(pcgan, short_drive, command, option):
    line = one_line(pcgan(command, short_drive, "--time-offset", option))
    assert line.startswith("pcgan: --time-offset wants NAME:=MS, at most 10 s either way, for example /gmsl/A1/")
    assert repr(option) in line


def test_mistakes_are_one_line(pcgan, short_drive, tmp_path):
    assert "--at shows one frame" in one_line(pcgan("inspect", short_drive, "--at", "1", "--frames"))
    assert "--at 1 lies before the start, 2 s into the log" in one_line(
        pcgan("inspect", short_drive, "--at", "1", "--start", "2")
    )
    settings = tmp_path / "settings.json"
    settings.write_text('{"start_s": 2}')
    line = one_line(pcgan("inspect", short_drive, "--at", "1.2", "--profile", settings))
    assert "--at 1.2 lies before the start, 2 s into the log" in line
    assert "no frame within 1 s of --at 50" in one_line(pcgan("inspect", short_drive, "--at", "50"))
    assert "/odom can have no time offset; topics with stamps that count are /gmsl/A0/detections" in one_line(
        pcgan("inspect", short_drive, "--time-offset", "/odom:=5")
    )
    twice = one_line(pcgan("inspect", short_drive, "--json", tmp_path / "x", "--rrd", tmp_path / "." / "x"))
    assert "would be written twice" in twice
    assert not (tmp_path / "x").exists()
    assert "is the recording itself" in one_line(pcgan("inspect", short_drive, "--json", short_drive))
    assert "cannot be written" in one_line(pcgan("inspect", short_drive, "--json", tmp_path / "no" / "file"))
    assert "cannot be read" in one_line(pcgan("inspect", tmp_path / "no.mcap"))


def test_refused_messages_are_exit_3(pcgan, short_drive, edit_log):
    log = edit_log(short_drive, lambda log: [*log[:500], (CLUSTERS_TOPIC, log[499][1], b"\xff\xff"), *log[500:]])
    outcome = pcgan("inspect", log)
    assert outcome.code == 3
    assert "1 message was refused" in outcome.out


def test_without_cameras_it_does_not_blame_the_boxes(pcgan, short_drive, edit_log):
    log = edit_log(short_drive, lambda log: [m for m in log if not m[0].startswith("/gmsl")])
    outcome = pcgan("inspect", log)
    assert "nothing wrong was found; checked: the stamps, no mount: there are no cameras" in outcome.out


@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interruption_writes_nothing(pcgan, short_drive, tmp_path, monkeypatch, signum, code):
    def interrupt(*_):
        os.kill(os.getpid(), signum)
        time.sleep(5)

    monkeypatch.setattr("replay.camera_check.CameraWatch.add", interrupt)
    assert pcgan("inspect", short_drive, "--json", tmp_path / "all.json").code == code
    assert list(tmp_path.iterdir()) == []
