import os
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from replay.errors import LogError
from replay.workers import RETRIES, Failure, failure_of, run_jobs
from tests.replay.processes import is_running, wait_for

# --- work; in the workers ------------------------------------------------------------------------------------------


def act(job: tuple[str, object]) -> object:
    """Does what the job says; returns the worker's process id, or what was asked for."""
    what, value = job
    if what == "raise":
        raise value
    if what == "exit":
        sys.exit(value)
    if what == "os exit":
        os._exit(value)
    if what == "signal":
        os.kill(os.getpid(), value)
        time.sleep(30)
    if what == "die":  # so many times
        folder, times = value
        tries = len(list(folder.iterdir()))
        (folder / str(tries)).touch()
        if tries < times:
            os.kill(os.getpid(), signal.SIGKILL)
    if what == "sleep":
        time.sleep(value)
    if what == "lambda":
        return lambda: None
    if what == "tidy":
        Path(value).touch()
        try:
            time.sleep(60)
        finally:
            Path(value).unlink()
    if what == "pid file":
        Path(value).with_suffix(".part").write_text(str(os.getpid()))
        Path(value).with_suffix(".part").rename(value)
        time.sleep(60)
    return os.getpid()


def outcomes(jobs, workers=2) -> dict[int, object]:
    found = list(run_jobs(act, jobs, workers))
    assert len({index for index, _ in found}) == len(found) == len(jobs)
    return dict(found)


# --- what comes back -----------------------------------------------------------------------------------------------


def test_every_way_to_fail_fails_that_job_alone(monkeypatch):
    """Exceptions, exits, what cannot be pickled and dead workers, between jobs that all succeed."""
    monkeypatch.setattr("replay.workers.RETRIES", 1)
    bad = {
        "LogError": ("raise", LogError("a.mcap is no MCAP")),
        "ValueError": ("raise", ValueError("two\nlines")),
        "bare": ("raise", KeyError()),
        "exit": ("exit", 3),
        "os exit": ("os exit", 7),
        "kill": ("signal", signal.SIGKILL),
        "segfault": ("signal", signal.SIGSEGV),
        "terminated": ("signal", signal.SIGTERM),
        "unpicklable": ("lambda", None),
    }
    names = list(bad)
    jobs = [each for name in names for each in (("pid", 0), bad[name])] + [("pid", 0)] * 3
    found = outcomes(jobs)
    failures = {names[i // 2]: each for i, each in sorted(found.items()) if isinstance(each, Failure)}
    assert list(failures) == names
    problems = {name: failure.problem for name, failure in failures.items()}
    assert problems["LogError"] == "a.mcap is no MCAP"
    assert failures["LogError"].traceback == ""
    assert problems["ValueError"] == "ValueError: two lines"
    assert failures["ValueError"].traceback.rstrip().endswith("ValueError: two\nlines")
    assert problems["bare"] == "KeyError"
    assert problems["exit"] == "SystemExit: 3"
    assert problems["os exit"] == "2 workers died of it; the last one ended by itself with exit code 7"
    assert problems["kill"].startswith("2 workers died of it; the last one was ended by signal 9 (SIGKILL)")
    assert "memory" in problems["kill"]
    assert problems["segfault"] == "2 workers died of it; the last one was ended by signal 11 (SIGSEGV)"
    assert problems["terminated"] == "2 workers died of it; the last one was ended by signal 15 (SIGTERM)"
    assert "pickle" in problems["unpicklable"]
    assert all("\n" not in problem for problem in problems.values())
    assert {name for name, failure in failures.items() if failure.transient} == {
        *("os exit", "kill", "segfault", "terminated")
    }
    assert all(isinstance(found[i], int) for i in range(0, len(jobs), 2))


def test_a_job_whose_worker_dies_is_begun_again(tmp_path):
    found = outcomes([("die", (tmp_path, RETRIES)), ("pid", 0)], workers=1)
    assert isinstance(found[0], int)
    assert len(list(tmp_path.iterdir())) == RETRIES + 1
    assert found[1] != found[0]


def test_workers_are_spawned_reused_and_no_more_than_there_are_jobs():
    pids = set(outcomes([("sleep", 0.02)] * 12).values())
    assert len(pids) <= 2
    assert os.getpid() not in pids
    assert len(set(outcomes([("pid", 0)], workers=8).values())) == 1


def test_results_come_as_they_finish():
    with closing(run_jobs(act, [("sleep", 60), ("pid", 0), ("pid", 0)], 2)) as running:
        assert [next(running)[0], next(running)[0]] == [1, 2]


def test_no_jobs_give_nothing_and_no_workers_are_a_mistake():
    assert list(run_jobs(act, [], 2)) == []
    with pytest.raises(ValueError, match="at least one worker, got 0"):
        next(run_jobs(act, [("pid", 0)], 0))


def test_work_that_cannot_be_sent_is_the_callers_mistake():
    with pytest.raises(Exception, match="pickle"):
        next(run_jobs(lambda _: None, [1], 1))
    with pytest.raises(Exception, match="pickle"):
        next(run_jobs(act, [("pid", lambda: None)], 1))


def test_a_failure_says_its_error_once():
    assert failure_of(LogError("x")) == Failure("x")
    assert failure_of(MemoryError()).problem == "MemoryError"
    assert failure_of(MemoryError()).transient
    assert failure_of(OSError(24, "Too many open files")).transient
    assert not failure_of(ZeroDivisionError()).transient


# --- the end of it -------------------------------------------------------------------------------------------------


def test_who_stops_listening_ends_the_workers_which_tidy_up(tmp_path):
    part = tmp_path / "out.part"
    with closing(run_jobs(act, [("tidy", str(part)), ("pid", 0)], 2)) as running:
        _, pid = next(running)
        wait_for(part.exists)
    assert not part.exists()
    assert not is_running(pid)


SCRIPT = """
import sys
from contextlib import closing
from pathlib import Path
from tests.replay.test_workers import act
from replay.interrupts import Interrupts
from replay.workers import run_jobs
if __name__ == "__main__":
    with Interrupts(), closing(run_jobs(act, [("pid file", path) for path in sys.argv[1:]], 2)) as running:
        print(list(running))
"""


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_worker_outlives_the_caller(tmp_path, signum):
    """Whatever ends the caller: Ctrl-C, which a terminal sends to all its processes, SIGTERM, or SIGKILL."""
    script, files = tmp_path / "script.py", [tmp_path / "a", tmp_path / "b"]
    script.write_text(SCRIPT)
    with subprocess.Popen(
        [sys.executable, script, *files],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as caller:
        wait_for(lambda: all(file.exists() for file in files))
        workers = [int(file.read_text()) for file in files]
        if signum == signal.SIGINT:
            os.killpg(caller.pid, signum)
        else:
            caller.send_signal(signum)
        _, err = caller.communicate(timeout=20)
    wait_for(lambda: not any(map(is_running, workers)))
    assert err.count("Traceback") == (signum != signal.SIGKILL)  # the caller's own


def test_a_script_without_the_guard_is_told_so_at_once(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from os import getpid\nfrom replay.workers import run_jobs\nprint(list(run_jobs(abs, [1, 2], 1)))"
    )
    done = subprocess.run([sys.executable, script], check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "WorkersError: worker processes cannot be started: one ended by itself with exit code 1" in done.stderr
