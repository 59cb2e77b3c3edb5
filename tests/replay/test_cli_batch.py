"""The command `pcgan batch`: what it prints, how it ends, and that nothing is lost or done twice when it is killed."""

import io
import shutil
import signal
import sys
from pathlib import Path

import pytest
from rich.console import Console

from replay.batch import Batch, BatchResult, run_batch
from replay.batch_table import empty_row
from replay.cli_batch import print_batch
from replay.interrupts import Interrupted
from replay.log_source import find_logs
from replay.session import ReplaySettings
from tests.replay.batch_rows import in_this_process, rows_of
from tests.replay.processes import command_of, descendants, is_running, kill, wait_for


@pytest.fixture
def _in_this_process(monkeypatch):
    """Worker processes cost seconds each; test_batch has some."""

    monkeypatch.setattr("replay.workers.run_jobs", in_this_process)


@pytest.fixture
def folder(short_drive, tmp_path) -> Path:
    shutil.copyfile(short_drive, tmp_path / "one.mcap")
    return tmp_path


@pytest.mark.usefixtures("_in_this_process")
def test_it_says_what_it_did_and_does_nothing_twice(pcgan, folder, model):
    outcome = pcgan("batch", folder, "-o", folder / "out", "--model", model)
    assert (outcome.code, outcome.err) == (0, "")
    assert "\x1b" not in outcome.out
    assert "1 log: 1 done, 0 failed\n" in outcome.out
    assert "times real time" in outcome.out
    assert f"wrote {folder}/out/results.parquet, 1 rows" in outcome.out
    assert (folder / "out" / "one.pcgan.mcap").is_file()
    again = pcgan("batch", folder, "-o", folder / "out", "--model", model)
    assert again.code == 0
    assert "1 log: 1 done, 0 failed; 1 of them before this run\n" in again.out
    assert "times real time" not in again.out


@pytest.mark.usefixtures("_in_this_process")
def test_a_failed_log_is_exit_2_and_one_line_and_the_others_are_done(pcgan, folder, model):
    (folder / "bad.mcap").write_text("no MCAP")
    outcome = pcgan("batch", folder / "*.mcap", "-o", folder / "out", "--model", model, "--no-outputs")
    assert outcome.code == 2
    assert "2 logs: 1 done, 1 failed\n" in outcome.out
    assert next(line for line in outcome.out.splitlines() if "bad failed" in line).startswith(
        f"bad failed: {folder}/bad.mcap "
    )
    assert not list((folder / "out").glob("*.mcap"))
    assert [row["status"] for row in rows_of(folder / "out")] == ["failed", "done"]


@pytest.mark.usefixtures("_in_this_process")
def test_refused_messages_are_exit_3_and_a_profile_is_obeyed(pcgan, folder, model, edit_log):
    def damage(log):
        first = next(i for i, message in enumerate(log) if "detections" in message[0])
        return [*log[:first], (*log[first][:2], b"\xff"), *log[first + 1 :]]

    spoilt = edit_log(folder / "one.mcap", damage, "spoilt.mcap")
    (folder / "profile.toml").write_text("duration_s = 1.0\n")
    outcome = pcgan("batch", spoilt, "-o", folder / "out", "--model", model, "--profile", folder / "profile.toml")
    assert outcome.code == 3, outcome
    assert "1 messages were refused, in 1 of the logs" in outcome.out
    (row,) = rows_of(folder / "out")
    assert row["refused"] == 1
    assert row["log_s"] == 1.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["none.mcap"], "none.mcap is not there"),
        (["'x/*.mcap'"], "finds no file"),
        (["{one}", "--no-outputs", "--emit", "pcgan"], "--no-outputs and --emit exclude each other"),
        (["{one}", "--model", "none"], "no checkpoint none; shipped models are"),
        (["{one}", "--emit", "none"], "there is no output format 'none'"),
        (["{one}", "--profile", "none.toml"], "none.toml cannot be read"),
        (["{one}", "--ray", "127.0.0.1:1"], "no Ray at 127.0.0.1:1: Connection refused"),
        (["{one}", "--ray", "here"], "a Ray is local, auto or HOST:PORT of its head node, got 'here'"),
    ],
)
def test_mistakes_are_one_line_and_exit_2(pcgan, folder, arguments, said):
    one = str(folder / "one.mcap")
    outcome = pcgan("batch", *(word.replace("{one}", one) for word in arguments), "-o", folder / "out")
    assert outcome.code == 2
    (line,) = outcome.err.splitlines()
    assert line.startswith("pcgan: ")
    assert said in line


def test_without_ray_the_folder_is_not_touched(pcgan, folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    outcome = pcgan("batch", folder / "one.mcap", "-o", folder / "out", "--ray", "local")
    assert outcome.code == 2
    assert outcome.err == "pcgan: --ray needs the package ray, which is not installed: pip install 'pcgan[ray]'\n"
    assert not (folder / "out").exists()


def test_the_closing_table_names_the_worst_logs():
    shared = {"status": "done", "log_s": 60.0, "refused": 0, "lost": 0}
    done = BatchResult(
        [
            empty_row(name="a", hota=0.9, id_switches=0, ade_m=0.5, **shared),
            empty_row(name="b", hota=0.7, id_switches=3, **shared),
            empty_row(name="c", ade_m=0.3, **shared | {"refused": 2, "lost": 1}),
            empty_row(name="d", status="failed", problem="a [red] herring"),
        ],
        {"a", "b", "d"},
        wall_s=30.0,
        stopped=Interrupted(signal.SIGINT),
    )
    out = Console(width=110, record=True, file=io.StringIO())
    print_batch(done, 5, Path("results.parquet"), out)
    text = out.export_text()
    assert "5 logs: 3 done, 1 failed, 1 not yet; 1 of them before this run" in text
    assert "2.0 min of log in 0.5 min, 4.0 times real time" in text
    cells = [line.split() for line in text.splitlines()]
    assert ["HOTA", "0.800", "0.700", "b", "2"] in cells
    assert ["id", "switches", "1.5", "3", "b", "2"] in cells
    assert any(line[:2] == ["ADE", "m,"] and line[-4:] == ["0.400", "0.500", "a", "2"] for line in cells)
    assert "MOTA" not in text
    assert "2 messages were refused, in 1 of the logs" in text
    assert "1 damages were left out by --salvage, in 1 of the logs" in text
    assert "d failed: a [red] herring" in text
    assert "stopped early: SIGINT arrived" in text
    assert "wrote results.parquet, 4 rows" in text


# --- killed --------------------------------------------------------------------------------------------------------

LOGS = 14


@pytest.mark.slow
def test_a_batch_that_is_ended_again_and_again_gives_the_same_rows_and_does_nothing_twice(
    start_pcgan, short_drive, model, tmp_path
):
    """Killed whole, stopped, and at last with one worker killed, which costs nothing."""
    drives, out = tmp_path / "drives", tmp_path / "out"
    drives.mkdir()
    for i in range(LOGS):
        shutil.copyfile(short_drive, drives / f"drive_{i:02d}.mcap")
    (tmp_path / "profile.toml").write_text("duration_s = 1.0\n")
    arguments = ("batch", drives, "-o", out, "--model", model, "--workers", 2, "--profile", tmp_path / "profile.toml")

    def one_more() -> bool:
        return len(journals(out)) > len(kept)

    def one_begun() -> bool:
        return any(out.glob("*.part"))

    kept: dict[str, int] = {}
    for signum, moment in (
        (signal.SIGKILL, one_begun),
        (signal.SIGKILL, one_more),
        (signal.SIGTERM, one_more),
        (signal.SIGINT, one_more),
    ):
        process = start_pcgan(*arguments)
        wait_for(moment)
        started = descendants(process.pid)
        process.send_signal(signum)
        _, err = process.communicate(timeout=60)
        assert process.returncode == (-signum if signum == signal.SIGKILL else 128 + signum)
        assert "Traceback" not in err
        wait_for(lambda started=started: not any(map(is_running, started)))
        now = journals(out)
        assert kept.items() <= now.items()
        kept = now
        if signum != signal.SIGKILL:
            assert {row["name"] for row in rows_of(out)} == {name.removesuffix(".json") for name in kept}
            assert not list(out.glob("*unfinished*"))

    process = start_pcgan(*arguments)
    wait_for(one_more)
    assert len(journals(out)) < LOGS - 2, "all logs were done before a worker could be killed"
    kill(next(pid for pid in descendants(process.pid) if "spawn_main" in command_of(pid)))
    text, err = process.communicate(timeout=120)
    assert (process.returncode, err) == (0, "")
    assert f"{LOGS} logs: {LOGS} done, 0 failed; {len(kept)} of them before this run" in text
    assert kept.items() <= journals(out).items()
    undisturbed = Batch(tmp_path / "undisturbed", ReplaySettings(duration_s=1.0), model)
    run_batch(undisturbed, find_logs([str(drives)]), in_this_process)
    assert rows_of(out) == rows_of(undisturbed.folder)
    assert sorted(path.name for path in out.iterdir() if not path.name.endswith(".pcgan.mcap")) == [
        ".batch.lock", "results.parquet", "rows"
    ]  # fmt: skip


def journals(out: Path) -> dict[str, int]:
    """Returns when the row of each log was written, in ns."""
    return {path.name: path.stat().st_mtime_ns for path in out.glob("rows/*.json")}
