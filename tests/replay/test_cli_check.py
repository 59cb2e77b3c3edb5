"""The command `pcgan check`: what it prints and writes, how it ends, and that it can be stopped."""

import json
import os
import pickle
import re
import signal
import time
import xml.etree.ElementTree as ET
import zipfile

import pytest

from replay import check as check_module
from replay.check_page import case_folder
from replay.interrupts import Interrupted
from replay.log_reader import checksum
from replay.workers import failure_of


def one_line(err):
    """Asserts that an error is one line of our own, and returns it."""
    (line,) = err.splitlines()
    assert line.startswith("pcgan: ")
    return line


@pytest.fixture
def in_process(monkeypatch):
    """Does the tasks in this process: starting workers takes seconds; tests/replay/test_check.py starts them."""

    def run_jobs(work, jobs, workers):
        assert workers >= 1
        for i, job in enumerate(jobs):
            try:
                yield i, pickle.loads(pickle.dumps(work(job)))
            except Exception as error:
                yield i, failure_of(error)

    monkeypatch.setattr(check_module, "run_jobs", run_jobs)


@pytest.fixture
def suite(tmp_path, short_drive, model):
    """Writes a suite of one short case."""

    def make(more="expect: [hota >= 0.5, no refused messages]", settings="{duration_s: 1.5}"):
        path = tmp_path / "suite.yaml"
        entry = f"{{log: {short_drive}, name: crossing, settings: {settings}}}"
        path.write_text(f"logs: [{entry}]\nmodel: {model}\n{more}\n")
        return path

    return make


@pytest.fixture
def referenced(pcgan, suite, in_process):  # noqa: ARG001  how it is run
    """The suite with its reference written."""
    path = suite()
    outcome = pcgan("check", path, "--update", "--reason", "baseline")
    assert (outcome.code, outcome.err) == (0, "")
    assert "crossing   new" in outcome.out
    assert f"wrote {path.parent / 'references' / 'crossing.reference.mcap'}" in outcome.out
    return path


def test_without_a_reference_it_says_how_to_write_one(pcgan, suite, in_process):  # noqa: ARG001
    path = suite()
    outcome = pcgan("check", path)
    assert (outcome.code, outcome.err) == (1, "")
    assert "1 case: 1 no reference" in outcome.out
    assert f"if these outputs are right: pcgan check {path} --update --reason TEXT" in outcome.out
    assert not (path.parent / "references").exists()


def test_what_passes_is_exit_0(pcgan, referenced, tmp_path):
    outcome = pcgan("check", referenced, "--json", tmp_path / "o.json", "--junit", tmp_path / "o.xml", "--workers", 2)
    assert (outcome.code, outcome.err) == (0, "")
    assert "\x1b" not in outcome.out
    table = outcome.out.splitlines()
    assert table[0].split() == ["case", "status", "took", "s", "hota", "refused"]
    assert table[2].split()[:2] == ["crossing", "identical"]
    assert "1 case: 1 identical" in table
    assert "--update" not in outcome.out
    found = json.loads((tmp_path / "o.json").read_text())
    assert (found["suite"], found["passed"], found["counts"]) == ("suite.yaml", True, {"identical": 1})
    (case,) = found["cases"]
    assert case["status"] == "identical"
    assert case["expectations"][1] == {"text": "no refused messages", "value": 0, "met": True}
    assert case["reference"]["reason"] == "baseline"
    assert ET.parse(tmp_path / "o.xml").getroot().get("failures") == "0"
    for name in ("o.xml", "o.json"):
        assert f"wrote {tmp_path / name}" in table


def test_a_log_inside_an_archive_is_checked_like_a_file(pcgan, in_process, short_drive, model, tmp_path):  # noqa: ARG001
    with zipfile.ZipFile(tmp_path / "drives.zip", "w") as archive:
        archive.write(short_drive, "crossing.mcap")
    suite, kept = tmp_path / "suite.yaml", tmp_path / "kept"
    url = f"zip://*.mcap::{tmp_path / 'drives.zip'}"
    suite.write_text(f"logs: [{{log: '{url}', settings: {{duration_s: 1.5}}}}]\nmodel: {model}\n")
    outcome = pcgan("check", suite, "--update", "--reason", "baseline")
    assert (outcome.code, outcome.err) == (0, "")
    assert "1 case: 1 new" in outcome.out
    outcome = pcgan("check", suite, "--json", tmp_path / "o.json", "--keep", kept)
    assert (outcome.code, outcome.err) == (0, "")
    assert "1 case: 1 identical" in outcome.out
    (case,) = json.loads((tmp_path / "o.json").read_text())["cases"]
    assert (case["case"], case["status"]) == ("crossing", "identical")
    assert case["summary"]["frames"] > 10
    assert case["reference"]["inputs"] == [["crossing.mcap", checksum(short_drive)]]
    assert [path.name for path in kept.iterdir()] == ["crossing.pcgan.mcap"]  # the copy from the archive is gone


def test_what_changed_is_exit_1_with_the_difference_and_its_cause(pcgan, referenced, suite, tmp_path):
    reference = referenced.parent / "references" / "crossing.reference.mcap"
    before = checksum(reference)
    suite("expect: [hota >= 1.5]", "{duration_s: 1.5, tracking: {tracker: {confirm_hits: 5}}}")
    kept = tmp_path / "kept folder"
    outcome = pcgan("check", referenced, "--junit", tmp_path / "o.xml", "--keep", kept)
    assert (outcome.code, outcome.err) == (1, "")
    lines = outcome.out.splitlines()
    assert lines[2].split()[:2] == ["crossing", "changed"]
    assert re.search(r"✗ 0\.\d+ \(>= 1\.5\)$", lines[2].rstrip())
    assert lines[3].split()[0] == "was"
    (first,) = (line for line in lines if line.startswith("crossing: changed: /pcgan/"))
    assert first.endswith(": only in the reference")
    assert f"look closer: pcgan diff {reference} '{kept / 'crossing.pcgan.mcap'}'" in lines
    assert "  since the reference: tracking.tracker.confirm_hits 2 -> 5" in lines
    assert any(line.startswith("  not met: hota >= 1.5 (0.") for line in lines)
    assert f"if this is how it should be: pcgan check {referenced} --update --reason TEXT" in lines
    failure = ET.parse(tmp_path / "o.xml").find("testsuite/testcase/failure")
    assert failure.get("message") in first
    assert failure.text.splitlines()[-1].startswith("not met: hota >= 1.5 (0.")
    assert checksum(reference) == before


def test_an_error_is_exit_2(pcgan, referenced, suite):
    suite("", "{start_s: 1000}")
    outcome = pcgan("check", referenced)
    assert (outcome.code, outcome.err) == (2, "")
    assert "crossing: error: nothing to replay from 1000 s" in outcome.out


def test_a_sweep_is_printed_side_by_side(pcgan, referenced, suite):
    suite("expect: [tracks >= 1]\nsweep: {strict: {settings: {tracking: {tracker: {confirm_hits: 50}}}}}")
    outcome = pcgan("check", referenced, "--sweep")
    assert outcome.code == 1
    lines = outcome.out.splitlines()
    assert ["figure", "suite", "strict"] in [line.split() for line in lines]
    (tracks,) = (line.split() for line in lines if line.startswith("tracks "))
    assert tracks[2:] == ["0", f"(-{tracks[1]})"]
    assert "crossing, strict: unmet: tracks >= 1: it is 0" in lines
    assert "2 replays of 1 case: 1 identical, 1 unmet" in lines


def test_a_page_and_outputs(pcgan, referenced, tmp_path):
    kept = tmp_path / "kept"
    outcome = pcgan("check", referenced, "--page", tmp_path / "page", "--rerun", "none", "--keep", kept)
    assert outcome.code == 0
    assert f"kept 1 output in {kept}" in outcome.out
    assert [path.name for path in kept.iterdir()] == ["crossing.pcgan.mcap"]
    assert f"wrote {tmp_path / 'page' / 'index.html'}" in outcome.out
    assert "crossing" in (tmp_path / "page" / "index.html").read_text()
    assert sorted(path.name for path in (tmp_path / "page").iterdir()) == ["cases", "index.html", "rerun"]
    assert pcgan("check", referenced, "--page", tmp_path / "page", "--rerun", "none").code == 0  # it is a page of ours


def test_stopped_early_it_says_so_and_leaves_the_page_as_it_was(pcgan, referenced, tmp_path, monkeypatch):
    page = tmp_path / "page"
    assert pcgan("check", referenced, "--page", page, "--rerun", "none").code == 0

    def files():
        return {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    old = case_folder(page, "crossing", "")
    (old / "pictures").mkdir(exist_ok=True)
    for name in ("pictures/old.png", "replay.rrd"):
        (old / name).write_bytes(b"old")
    before, run_jobs = files(), check_module.run_jobs

    def stopped(work, jobs, workers):
        yield next(iter(run_jobs(work, jobs, workers)))
        raise Interrupted(signal.SIGINT)

    monkeypatch.setattr(check_module, "run_jobs", stopped)
    for folder in (page, tmp_path / "new" / "page"):
        outcome = pcgan("check", referenced, "--page", folder, "--keep", tmp_path / "new" / "kept")
        assert (outcome.code, outcome.out) == (130, "")
        assert outcome.err == "stopped early: no reference was written\n"
        assert files() == before
        assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--update"], "--update wants --reason TEXT"),
        (["--update", "--reason", " "], "--update wants --reason TEXT"),
        (["--reason", "x"], "--reason goes with --update"),
        (["--rerun", "some"], "--rerun wants changed, all, none; got 'some'"),
        (["--rerun", "changed"], "--rerun goes with --page"),
        (["--page", "."], "--page: . holds other files; choose a new folder"),
        (["--sweep"], "has no sweep; list variants there"),
        (["--only", "nobody"], "is called nobody; its cases are crossing"),
        (["--json", "nowhere/o.json"], "nowhere/o.json cannot be written"),
        (["--junit", "/"], "/ cannot be written"),
        (["--page", "FILE"], "FILE must be a folder, and is a file"),
        (["--keep", "FILE"], "FILE must be a folder, and is a file"),
        (["--json", "suite.yaml"], "is the suite itself, which is never overwritten"),
        (["--junit", "DRIVE"], "is the recording itself, which is never overwritten"),
        (["--junit", "out", "--json", "out"], "out would be written twice"),
    ],
)
def test_mistakes_are_one_line_before_anything_is_replayed(
    pcgan, suite, short_drive, tmp_path, monkeypatch, options, words
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "FILE").touch()
    outcome = pcgan("check", suite(), *(short_drive if option == "DRIVE" else option for option in options))
    assert outcome.code == 2
    assert words in one_line(outcome.err)
    assert outcome.out == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["FILE", "suite.yaml"]


def test_a_suite_with_a_mistake_is_one_line(pcgan, suite):
    outcome = pcgan("check", suite("expect: [hoat >= 0.8]"))
    assert outcome.code == 2
    assert "suite.yaml: expect[0]: no replay has a figure called hoat; did you mean hota" in one_line(outcome.err)


@pytest.mark.slow
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_stopping_it_leaves_no_process_and_no_file(start_pcgan, pcgan, suite, drive, in_process, tmp_path, signum):  # noqa: ARG001
    path = suite()
    assert pcgan("check", path, "--update", "--reason", "x").code == 0
    reference = tmp_path / "references" / "crossing.reference.mcap"
    before = checksum(reference)
    entries = ", ".join(f"{{log: {drive}, name: case {i}}}" for i in range(20))
    path.write_text(path.read_text().replace("logs: [", f"logs: [{entries}, "))
    scratch, kept = tmp_path / "scratch", tmp_path / "kept"
    scratch.mkdir()
    process = start_pcgan("check", path, "--update", "--reason", "y", "--workers", 2, "--keep", kept, cwd=scratch)
    deadline = time.monotonic() + 120
    while not list(kept.glob(".pcgan-check-*/*.unfinished*")):  # a worker is in the middle of a replay
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signum)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (128 + signum, "", "stopped early: no reference was written\n")
    assert not kept.exists()
    assert list(scratch.iterdir()) == []
    assert [each.name for each in reference.parent.iterdir()] == [reference.name]
    assert checksum(reference) == before
    while group_lives(process.pid):  # multiprocessing's resource tracker ends a moment after the rest
        assert time.monotonic() < deadline
        time.sleep(0.01)


def group_lives(number):
    """Tells whether a process of a group is left."""
    try:
        os.killpg(number, 0)
    except ProcessLookupError:
        return False
    return True
