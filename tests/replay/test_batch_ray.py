"""Batches on Ray: the same rows as anywhere, also when a worker or a node dies; nothing of a local Ray is left."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from replay.batch import Batch, run_batch
from replay.batch_ray import run_jobs_on_ray
from replay.log_source import find_logs
from replay.workers import WorkersError
from tests.replay.batch_rows import in_this_process, rows_of
from tests.replay.processes import command_of, descendants, is_running, kill, processes_with, wait_for

LOGS = 16


def test_without_ray_the_command_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(WorkersError, match=r"--ray needs the package ray, .*pip install 'pcgan\[ray\]'"):
        next(run_jobs_on_ray(abs, [1], "local"))


@pytest.mark.parametrize("address", ["here", ":6379", "host:", "ray://host:x"])
def test_an_address_is_local_auto_or_a_place(address):
    with pytest.raises(WorkersError, match="a Ray is local, auto or HOST:PORT of its head node, got"):
        next(run_jobs_on_ray(abs, [1], address))


# --- on Ray --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def logs(short_drive, tmp_path_factory) -> Path:
    """Logs, and a file that is none."""
    folder = tmp_path_factory.mktemp("logs")
    for i in range(LOGS - 1):
        shutil.copyfile(short_drive, folder / f"drive_{i:02d}.mcap")
    (folder / "bad.mcap").write_text("no MCAP")
    return folder


@pytest.fixture(scope="module")
def expected(logs, model, tmp_path_factory) -> list[dict]:
    """Their rows, without Ray."""
    out = tmp_path_factory.mktemp("expected")
    run_batch(Batch(out, model=model), find_logs([str(logs)]), in_this_process)
    return rows_of(out)


CLUSTER = """
import sys
from ray.cluster_utils import Cluster
small = {"num_cpus": 1, "object_store_memory": 100 << 20, "include_dashboard": False}
cluster = Cluster(initialize_head=True, head_node_args={**small, "temp_dir": sys.argv[1]})
try:
    second = cluster.add_node(**small)
    cluster.wait_for_nodes()
    print(cluster.address, flush=True)
    if sys.stdin.readline() == "kill node\\n":
        cluster.remove_node(second, allow_graceful=False)
        print("killed", flush=True)
    sys.stdin.read()
finally:
    cluster.shutdown()
"""


@pytest.fixture
def cluster():
    """Two nodes of a processor each, the second of which dies of "kill node" on stdin. Nothing of them stays."""
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")  # a short path: sockets lie in it
    process = subprocess.Popen(
        [sys.executable, "-c", CLUSTER, folder],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
        env=os.environ | {"RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1"},
    )
    started: list[int] = []
    try:
        process.address = process.stdout.readline().strip()
        started += descendants(process.pid)  # some change their names, and their parents
        assert process.address, "the cluster did not start"
        yield process
        process.stdin.close()
        process.wait(timeout=60)
    finally:
        for pid in {process.pid, *started, *processes_with(folder)}:
            kill(pid)
        process.wait()
        process.stdin.close()
        process.stdout.close()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.slow
def test_a_cluster_gives_the_same_rows_though_it_is_interrupted_and_loses_a_node_and_a_worker(
    start_pcgan, cluster, logs, expected, model, tmp_path
):
    out = tmp_path / "out"
    arguments = ("batch", logs, "-o", out, "--model", model, "--ray", cluster.address)
    process = start_pcgan(*arguments)
    wait_for(lambda: count(out) >= 2)
    process.send_signal(signal.SIGINT)
    text, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "")
    assert "stopped early: SIGINT arrived" in text
    assert 2 <= len(rows_of(out)) == count(out) < LOGS

    before = count(out)
    process = start_pcgan(*arguments)
    wait_for(lambda: count(out) > before)
    print("kill node", file=cluster.stdin, flush=True)
    assert cluster.stdout.readline() == "killed\n"
    assert count(out) < LOGS
    at_work: list[int] = []
    wait_for(lambda: at_work.extend(workers_of(cluster)) or at_work)
    kill(at_work[0])
    text, err = process.communicate(timeout=240)
    assert (process.returncode, err) == (2, "")
    assert f"{LOGS} logs: {LOGS - 1} done, 1 failed" in text
    assert "bad failed: " in text
    assert rows_of(out) == expected
    assert not list(out.glob("*unfinished*"))


@pytest.mark.slow
def test_a_local_ray_gives_the_same_rows_and_sigterm_leaves_nothing_of_it(start_pcgan, logs, expected, model, tmp_path):
    out = tmp_path / "out"
    process = start_pcgan("batch", logs, "-o", out, "--model", model, "--ray", "local", "--workers", 2)
    wait_for(lambda: count(out) >= 3)
    started = descendants(process.pid)
    assert any("raylet" in command_of(pid) for pid in started)
    process.send_signal(signal.SIGTERM)
    text, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (143, "")
    assert "stopped early: SIGTERM arrived" in text
    wait_for(lambda: not any(map(is_running, started)))
    assert 3 <= len(rows_of(out)) < LOGS
    assert not list(out.glob("*unfinished*"))
    done = run_batch(Batch(out, model=model), find_logs([str(logs)]), in_this_process)
    assert len(done.fresh) < LOGS - 2  # the same batch goes on elsewhere
    assert rows_of(out) == expected


def count(out: Path) -> int:
    return len(list(out.glob("rows/*.json")))


def workers_of(cluster: subprocess.Popen) -> list[int]:
    """Returns processes that are at a log."""
    return [pid for pid in descendants(cluster.pid) if command_of(pid).startswith("ray::_outcome")]
