"""Batches: each log once, its row in the table, whatever ends a run; and what makes a log be replayed again."""

import json
import os
import shutil
import signal
import subprocess
import sys
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import fsspec
import pyarrow.parquet as pq
import pytest

from replay.batch import COPIES, LOCK, RESULTS, Batch, JobDone, replay_one, run_batch
from replay.batch_table import COLUMNS, TIMINGS, figures
from replay.errors import LogError, OutputError, PredictorError
from replay.interrupts import Interrupted
from replay.log_reader import checksum
from replay.log_source import find_logs
from replay.part_file import write_whole
from replay.replay_job import ReplayJob, run_job
from replay.session import ReplaySettings
from replay.workers import Failure, WorkersError, failure_of, run_jobs
from tests.replay.batch_rows import in_this_process, untimed


class Pretend:
    """A runner that replays nothing: it writes outputs of a few bytes, and remembers for which logs."""

    def __init__(self, **outcomes):
        self.asked: list[str] = []
        self.outcomes = outcomes  # by name, instead of success

    def __call__(self, work, jobs):  # noqa: ARG002  as of run_jobs
        for i, job in enumerate(jobs):
            name = job.source.name
            self.asked.append(name)
            outcome = self.outcomes.get(name)
            if isinstance(outcome, BaseException):
                raise outcome
            if outcome is None:
                job.output.write_text(name)
                outcome = JobDone({"frames": 1, "log_s": 2.0}, "in", "out", len(name), 0.5)
            yield i, outcome


@pytest.fixture
def logs(tmp_path) -> Path:
    """Three files that are no logs, for pretended batches."""
    folder = tmp_path / "logs"
    folder.mkdir()
    for name in "abc":
        (folder / f"{name}.mcap").write_text(name)
    return folder


@pytest.fixture
def batch(tmp_path, model) -> Batch:
    return Batch(tmp_path / "out", model=model)


@pytest.fixture
def memory_logs():
    """Two files in fsspec's memory, which is empty again afterwards."""
    filesystem = fsspec.filesystem("memory")
    filesystem.pipe({"/drives/a.mcap": b"a", "/drives/b.mcap": b"b"})
    yield filesystem
    filesystem.store.clear()
    filesystem.pseudo_dirs[:] = [""]


def broken_link(*_):
    raise ConnectionError("no route to host")


def asked(batch, logs, **outcomes) -> list[str]:
    """Runs a pretended batch over a folder and returns for which logs it asked."""
    run = Pretend(**outcomes)
    run_batch(batch, find_logs([str(logs)]), run)
    return run.asked


def table(batch) -> list[dict]:
    return pq.read_table(batch.folder / RESULTS).to_pylist()


# --- rows and outputs ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def corpus(short_drive, tmp_path_factory) -> Path:
    """A drive, the same in an archive under another name, and a file that is no MCAP, there as here."""
    folder = tmp_path_factory.mktemp("corpus")
    shutil.copyfile(short_drive, folder / "drive.mcap")
    (folder / "broken.mcap").write_text("no MCAP")
    with zipfile.ZipFile(folder / "more.zip", "w") as archive:
        archive.write(short_drive, "packed.mcap")
        archive.writestr("torn.mcap", "no MCAP either")
    return folder


@pytest.fixture(scope="module")
def whole(corpus, model, tmp_path_factory):
    """A batch over the corpus, done in this process: the batch, and what it returned."""
    batch = Batch(tmp_path_factory.mktemp("batch") / "new" / "out", model=model)
    return batch, run_batch(batch, sources(corpus), in_this_process)


def sources(corpus):
    return find_logs([str(corpus), f"zip://*.mcap::{corpus / 'more.zip'}"])


def test_every_log_has_a_row_and_those_that_went_through_an_output(whole, corpus, model, tmp_path):
    batch, result = whole
    rows = {row["name"]: row for row in table(batch)}
    assert list(rows) == [source.name for source in sources(corpus)] == ["broken", "drive", "packed", "torn"]
    assert result.rows == list(rows.values())
    assert result.fresh == set(rows)
    assert result.stopped is None
    assert [row["name"] for row in result.failed] == ["broken", "torn"]
    assert {path.name for path in batch.folder.iterdir()} == {
        "drive.pcgan.mcap", "packed.pcgan.mcap", "results.parquet", "rows", LOCK
    }  # fmt: skip
    alone = run_job(ReplayJob((corpus / "drive.mcap",), tmp_path / "alone.mcap", model=model))
    drive = rows["drive"]
    assert drive["url"] == str(corpus / "drive.mcap")
    assert drive["status"] == "done"
    assert drive["problem"] is None
    assert drive["input_sha256"] == checksum(corpus / "drive.mcap") == rows["packed"]["input_sha256"]
    assert drive["output_sha256"] == checksum(tmp_path / "alone.mcap") == checksum(batch.folder / "drive.pcgan.mcap")
    wanted = alone.as_json()
    assert drive["frames"] == wanted["frames"] > 20
    assert drive["tracks"] == wanted["tracks"] > 0
    assert drive["hota"] == wanted["ground_truth"]["hota"] > 0.5
    assert drive["model_sha256"] == checksum(model)
    assert drive["wall_s"] > drive["replay_s"] > 0
    for name, url in (("broken", f"{corpus}/broken.mcap"), ("torn", f"zip://torn.mcap::{corpus}/more.zip")):
        assert rows[name]["status"] == "failed"
        assert rows[name]["problem"].startswith(f"{url} ")  # not where its copy lay
        assert "\n" not in rows[name]["problem"]
        assert rows[name]["frames"] is rows[name]["hota"] is rows[name]["output_sha256"] is None


def test_worker_processes_give_the_same_rows(whole, corpus, tmp_path):
    batch = replace(whole[0], folder=tmp_path / "out")
    result = run_batch(batch, sources(corpus), partial(run_jobs, workers=1))
    assert untimed(result.rows) == untimed(whole[1].rows)


def test_a_second_run_does_nothing_and_says_the_same(whole, corpus):
    batch, result = whole
    seen = []
    run = Pretend()
    again = run_batch(batch, sources(corpus), run, seen.append)
    assert run.asked == []
    assert again.rows == result.rows == table(batch)
    assert again.fresh == set()
    assert seen == [result.rows]


def test_rows_alone(whole, corpus, tmp_path):
    batch = replace(whole[0], folder=tmp_path / "out", outputs=False)
    result = run_batch(batch, find_logs([str(corpus)]), in_this_process)
    without = [row | {"output_sha256": None} for row in untimed(whole[1].rows)]
    assert untimed(result.rows) == without[:2]
    assert list(batch.folder.glob("*.mcap")) == []
    assert run_batch(batch, find_logs([str(corpus)]), in_this_process).fresh == set()


def test_every_figure_of_a_summary_is_a_column_with_a_type_and_a_meaning(whole, recorded):
    def leaves(value, path=()):
        for name, each in value.items():
            yield from leaves(each, (*path, name)) if isinstance(each, dict) else [(*path, name)]

    told_otherwise = {"complete", "refusals", "salvage_losses", "unmatched_labels", "predictor_restarts", "latency_ms"}
    told_otherwise |= {"wall_s", "startup_s", "realtime_factor"}
    summary = recorded.summary.as_json()
    wanted = {path for path in leaves(summary) if path[0] not in told_otherwise}
    assert wanted == {column.path for column in COLUMNS if column.path}
    schema = pq.read_schema(whole[0].folder / RESULTS)
    assert schema.names == [column.name for column in COLUMNS]
    assert schema.names[-2:] == list(TIMINGS)
    for column in COLUMNS:
        assert str(schema.field(column.name).type) == column.type.replace("float64", "double")
        assert schema.field(column.name).metadata[b"meaning"] == column.meaning.encode() != b""
    assert schema.field("ade_m").metadata[b"unit"] == b"m"


def test_without_ground_truth_its_figures_are_null(recorded):
    summary = {name: value for name, value in recorded.summary.as_json().items() if name != "ground_truth"}
    row = figures(summary | {"unmatched_labels": ["car", "bus"], "salvage_losses": ["chunk 3"]})
    assert row["hota"] is row["truth_ade_m"] is row["truth_tracker_nll"] is row["people_seen"] is None
    assert row["frames"] == recorded.summary.frames
    assert row["unmatched_labels"] == "car, bus"
    assert row["lost"] == 1


# --- what is done again, and what is not ---------------------------------------------------------------------------


def test_what_is_done_is_done(batch, logs):
    assert asked(batch, logs) == ["a", "b", "c"]
    assert asked(batch, logs) == []
    (logs / "d.mcap").touch()
    assert asked(batch, logs) == ["d"]
    assert [row["name"] for row in table(batch)] == ["a", "b", "c", "d"]
    (logs / "a.mcap").unlink()
    assert asked(batch, logs) == []
    assert [row["name"] for row in table(batch)] == ["b", "c", "d"]  # of the logs that were asked for


def test_another_log_is_replayed_again(batch, logs):
    asked(batch, logs)
    (logs / "b.mcap").write_text("another")
    assert asked(batch, logs) == ["b"]
    os.utime(logs / "c.mcap", ns=(0, 0))
    assert asked(batch, logs) == ["c"]


@pytest.mark.parametrize(
    "change",
    [
        {"settings": ReplaySettings(start_s=1)},
        {"model": None},
        {"salvage": True},
        {"emit": ("pcgan", "foxglove")},
        {"outputs": False},
    ],
    ids=lambda change: next(iter(change)),
)
def test_other_settings_replay_all_again(batch, logs, change):
    asked(batch, logs)
    assert asked(replace(batch, **change), logs) == ["a", "b", "c"]
    assert asked(replace(batch, **change), logs) == []
    assert asked(batch, logs) == ["a", "b", "c"]


def test_another_version_replays_all_again(batch, logs, monkeypatch):
    asked(batch, logs)
    monkeypatch.setattr("replay.batch.version", lambda _: "99")
    assert asked(batch, logs) == ["a", "b", "c"]


def test_an_output_that_is_gone_or_cut_and_a_spoilt_journal_are_replayed_again(batch, logs):
    asked(batch, logs)
    (batch.folder / "a.pcgan.mcap").unlink()
    (batch.folder / "b.pcgan.mcap").write_text("")
    (batch.folder / "rows" / "c.json").write_text("{")
    assert asked(batch, logs) == ["a", "b", "c"]
    (batch.folder / "rows" / "c.json").write_text("[]")
    assert asked(batch, logs) == ["c"]


def test_a_log_that_failed_is_not_tried_again_unless_asked_or_likely_to_go_well(batch, logs):
    outcomes = {"a": failure_of(LogError("no good")), "b": Failure("its worker died", transient=True)}
    assert asked(batch, logs, **outcomes) == ["a", "b", "c"]
    assert [row["status"] for row in table(batch)] == ["failed", "failed", "done"]
    assert [row["problem"] for row in table(batch)] == ["no good", "its worker died", None]
    assert asked(batch, logs, **outcomes) == ["b"]
    assert asked(batch, logs) == ["b"]
    assert asked(replace(batch, retry_failed=True), logs) == ["a"]
    assert [row["status"] for row in table(batch)] == ["done"] * 3


def test_the_traceback_of_a_bug_is_kept_with_the_row(batch, logs):
    asked(batch, logs, a=failure_of(ZeroDivisionError("oh")))
    assert table(batch)[0]["problem"] == "ZeroDivisionError: oh"
    assert "ZeroDivisionError: oh" in json.loads((batch.folder / "rows" / "a.json").read_text())["traceback"]


def test_a_log_that_fails_with_other_settings_leaves_no_output_of_the_old_ones(batch, logs):
    asked(batch, logs)
    (batch.folder / "theirs.pcgan.mcap").touch()
    asked(replace(batch, salvage=True), logs, a=Failure("no"))
    assert {path.name for path in batch.folder.glob("*.mcap")} == {
        "b.pcgan.mcap", "c.pcgan.mcap", "theirs.pcgan.mcap"
    }  # fmt: skip


# --- the end of a run ----------------------------------------------------------------------------------------------


def test_an_interruption_keeps_what_was_done_and_the_next_run_goes_on(batch, logs):
    stopped = run_batch(batch, find_logs([str(logs)]), Pretend(b=Interrupted(signal.SIGTERM)))
    assert stopped.stopped is not None
    assert stopped.stopped.signum == signal.SIGTERM
    assert [row["name"] for row in table(batch)] == ["a"]
    assert asked(batch, logs) == ["b", "c"]
    assert [row["name"] for row in table(batch)] == ["a", "b", "c"]


def test_an_error_keeps_what_was_done_too(batch, logs):
    with pytest.raises(OutputError, match="disk full"):
        asked(batch, logs, c=OutputError("disk full"))
    assert [row["name"] for row in table(batch)] == ["a", "b"]
    assert asked(batch, logs) == ["c"]


def test_a_run_that_cannot_begin_leaves_the_table_of_an_earlier_one(batch, logs):
    asked(batch, logs)
    before = table(batch)
    with pytest.raises(WorkersError, match="no Ray here"):
        asked(replace(batch, settings=ReplaySettings(start_s=1.0)), logs, a=WorkersError("no Ray here"))
    assert table(batch) == before


def test_what_killed_workers_left_is_swept_and_nothing_else(batch, logs):
    (batch.folder / "rows").mkdir(parents=True)
    (batch.folder / COPIES / "pcgan-x").mkdir(parents=True)
    (batch.folder / "copies").mkdir()
    left = ["a.pcgan.mcap.unfinished", "a.pcgan.mcap.unfinished.part", "rows/a.json.part", f"{COPIES}/pcgan-x/a.mcap"]
    others = ["mine.part", "mine.mcap.unfinished", "rows/mine.part", "copies/mine.mcap"]
    for name in left + others:
        (batch.folder / name).touch()
    asked(batch, logs)
    assert [name for name in left if (batch.folder / name).exists()] == []
    assert [name for name in others if not (batch.folder / name).exists()] == []


@pytest.mark.parametrize("victim", ["b.json", RESULTS])
def test_a_full_disk_ends_the_batch_and_costs_what_could_not_be_written(batch, logs, monkeypatch, victim):
    def write(path, data):
        if path.name == victim:
            raise OutputError(f"{path} cannot be written: No space left on device")
        write_whole(path, data)

    with monkeypatch.context() as full:
        full.setattr("replay.batch.write_whole", write)
        full.setattr("replay.batch_table.write_whole", write)
        with pytest.raises(OutputError, match=f"{victim} cannot be written: No space left on device$"):
            asked(batch, logs)
    assert not (batch.folder / COPIES).exists()
    again = asked(batch, logs)
    assert again == (["b", "c"] if victim == "b.json" else [])
    assert [row["status"] for row in table(batch)] == ["done"] * 3


def test_a_folder_that_cannot_be_marked_or_holds_something_else_is_an_error_of_one_line(batch, logs):
    batch.folder.mkdir()
    (batch.folder / LOCK).symlink_to("/dev/full")
    with pytest.raises(OutputError, match="lock cannot be written: "):
        asked(batch, logs)
    (batch.folder / LOCK).unlink()
    (batch.folder / COPIES).touch()
    with pytest.raises(OutputError, match="copies cannot be written: File exists"):
        asked(batch, logs)


HOLDER = """
import sys, time
from pathlib import Path
from replay.batch import _only_batch_in
with _only_batch_in(Path(sys.argv[1])):
    print("in", flush=True)
    time.sleep(60)
"""


def test_one_batch_at_a_time_has_the_folder_until_it_ends_or_is_killed(batch, logs):
    with subprocess.Popen([sys.executable, "-c", HOLDER, batch.folder], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "in\n"
        with pytest.raises(OutputError, match=f"another batch is at work in .*out: process {holder.pid} on "):
            asked(batch, logs)
        holder.kill()
        holder.wait()
    assert asked(batch, logs) == ["a", "b", "c"]


# --- what cannot be done -------------------------------------------------------------------------------------------


def test_mistakes_are_told_before_anything_is_done(batch, logs, monkeypatch):
    with pytest.raises(PredictorError, match="no checkpoint none"):
        asked(replace(batch, model="none"), logs)
    with pytest.raises(OutputError, match="no output format 'x'"):
        asked(replace(batch, emit=("x",)), logs)
    with pytest.raises(OutputError, match=r"a\.mcap cannot be written"):
        asked(replace(batch, folder=logs / "a.mcap"), logs)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(OutputError, match=r"pcgan batch needs the package pyarrow.*pip install 'pcgan\[data\]'"):
        asked(batch, logs)
    assert not batch.folder.exists()


def test_a_log_that_vanishes_fails_alone_and_is_looked_for_again(batch, logs):
    found = find_logs([str(logs)])
    (logs / "b.mcap").unlink()

    def some(work, jobs):
        for i, job in enumerate(jobs):
            yield i, work(job) if job.source.name == "b" else JobDone({}, "", "", 0, 0.0)

    assert [row["problem"] for row in run_batch(batch, found, some).failed] == [f"{logs / 'b.mcap'} is not there"]
    (logs / "b.mcap").touch()
    run = Pretend()
    run_batch(batch, found, run)
    assert "b" in run.asked


def test_a_log_that_cannot_be_reached_now_stays_done(batch, memory_logs, monkeypatch):
    found = find_logs(["memory://drives/*.mcap"])
    run_batch(batch, found, Pretend())
    monkeypatch.setattr(memory_logs, "info", broken_link)
    run = Pretend()
    assert [row["status"] for row in run_batch(batch, found, run).rows] == ["done", "done"]
    run_batch(replace(batch, salvage=True), found, run)
    assert run.asked == ["a", "b"]  # with other settings it is another matter


def test_a_log_that_is_begun_again_counts_as_done_no_more(batch, corpus):
    """Killed when the output has just been replaced, it must not pass for what the older row says."""
    found = find_logs([str(corpus / "drive.mcap")])
    run_batch(batch, found, Pretend())

    def killed_before_the_row(work, jobs):
        work(jobs[0])
        raise Interrupted(signal.SIGTERM)
        yield

    longer = replace(batch, settings=ReplaySettings(duration_s=1.0))
    assert run_batch(longer, found, killed_before_the_row).stopped is not None
    (batch.folder / "drive.pcgan.mcap").write_text("drive")  # of the same size as what was there at first
    run = Pretend(drive=Failure("no"))
    run_batch(batch, found, run)
    assert run.asked == ["drive"]
    assert not (batch.folder / "drive.pcgan.mcap").exists()  # still known as ours


def test_no_output_takes_the_place_of_a_log(batch, logs):
    (logs / "a.pcgan.mcap").touch()
    found = find_logs([str(logs / "a.mcap"), str(logs / "a.pcgan.mcap")])
    with pytest.raises(OutputError, match=r"a\.pcgan\.mcap is to be replayed, and overwritten by an output"):
        run_batch(replace(batch, folder=logs), found, Pretend())
    run_batch(replace(batch, folder=logs, outputs=False), found, Pretend())


def test_a_worker_elsewhere_must_see_the_folder_and_have_the_same_pcgan(batch, corpus):
    jobs = []

    def collect(work, given):  # noqa: ARG001  as of run_jobs
        jobs.extend(given)
        yield from ()

    run_batch(batch, find_logs([str(corpus / "drive.mcap")]), collect)
    job = jobs[0]
    other = replay_one(replace(job, mark="another"))
    assert isinstance(other, Failure)
    assert "is not the folder of this batch: all machines must share it" in other.problem
    assert other.transient
    older = replay_one(replace(job, version="0.0.1"))
    assert isinstance(older, Failure)
    assert "this batch is of 0.0.1" in older.problem
    weights = replay_one(replace(job, model_sha256="0" * 64))
    assert isinstance(weights, Failure)
    assert "those here 000000000000: install the same pcgan" in weights.problem
    assert not job.output.exists()
