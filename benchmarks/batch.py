"""How long `pcgan batch` takes over many short logs, and whether its rows are the same however they came about.

python -m benchmarks.batch [--logs 50] [--seconds 6] [--without-ray] [--json F]

Simulates the logs, then runs the command itself, each time into a new folder: with one worker, with two, with two of
which one is killed in the middle, killed as a whole three times and started again, and on a Ray cluster of two nodes
on this machine (a processor each) of which one is killed in the middle. Rows are compared with those of the first run
in every column but the timings. Logs are a little longer than the predictor's horizon, so that errors are scored, too.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import pyarrow.parquet as pq
from rich.console import Console
from rich.table import Table

from replay.batch import RESULTS, ROWS
from replay.batch_table import TIMINGS, Row
from replay.simulator import simulate

PEOPLE = (3, 4, 5, 6)
NODE = {"num_cpus": 1, "object_store_memory": 100 << 20, "include_dashboard": False}


@dataclass(frozen=True)
class Run:
    """One way to do the batch, and what came of it."""

    way: str
    wall_s: float
    commands: int  # how often it was started
    killed: str
    same_rows: bool


def main() -> None:
    """Runs all ways, prints a table, and writes JSON if asked; exit code 1 if rows differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=50, help="how many (50)")
    parser.add_argument("--seconds", type=float, default=6, help="of each (6)")
    parser.add_argument("--without-ray", action="store_true", help="worker processes only")
    parser.add_argument("--json", type=Path, help="write the figures to this file as well")
    arguments = parser.parse_args()
    console = Console(width=120)
    with tempfile.TemporaryDirectory() as name:
        logs = Path(name) / "logs"
        logs.mkdir()
        console.print(f"simulating {arguments.logs} logs of {arguments.seconds:g} s", style="dim")
        for i in range(arguments.logs):
            people = PEOPLE[i % len(PEOPLE)]
            path = logs / f"drive_{i:03d}.mcap"
            simulate(path, clip=None, vehicle=None, pedestrians=people, duration_s=arguments.seconds, seed=i)
        runs, expected = [], None
        for run, rows in all_ways(logs, Path(name), arguments.logs, with_ray=not arguments.without_ray):
            expected = expected or rows
            runs.append(Run(*run, same_rows=rows == expected and len(rows) == arguments.logs))
            console.print(f"{runs[-1].way}: {runs[-1].wall_s:.1f} s", style="dim")
    print_runs(runs, arguments.logs, arguments.seconds, console)
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(run) for run in runs], indent=2) + "\n")
    sys.exit(0 if all(run.same_rows for run in runs) else 1)


def all_ways(
    logs: Path, folder: Path, count: int, *, with_ray: bool
) -> Iterator[tuple[tuple[str, float, int, str], list[Row]]]:
    """Yields what there is to say of each way, and its rows."""
    for workers in (1, 2):
        out = folder / f"workers_{workers}"
        wall_s = whole(logs, out, "--workers", str(workers))
        yield (f"{workers} worker{'s' * (workers > 1)}", wall_s, 1, ""), rows_of(out)

    out, started = folder / "worker_killed", time.perf_counter()
    with command(logs, out, "--workers", "2") as process:
        wait_for_rows(out, count // 2, process)
        victim = next(pid for pid in descendants(process.pid) if "spawn_main" in command_of(pid))
        os.kill(victim, signal.SIGKILL)
    yield ("2 workers, one killed", time.perf_counter() - started, 1, "kill -9 of a worker"), rows_of(out)

    out, started = folder / "killed", time.perf_counter()
    at = [max(1, round(count * share)) for share in (0.02, 0.4, 0.9)]
    for rows in at:
        with command(logs, out, "--workers", "2") as process:
            wait_for_rows(out, rows, process)
            process.kill()
    before = {path.name: path.stat().st_mtime_ns for path in (out / ROWS).glob("*.json")}
    whole(logs, out, "--workers", "2")
    after = {path.name: path.stat().st_mtime_ns for path in (out / ROWS).glob("*.json")}
    assert before.items() <= after.items(), "what was done has been done again"
    said = f"kill -9 of all after {', '.join(map(str, at))} logs"
    yield ("2 workers, killed three times", time.perf_counter() - started, 4, said), rows_of(out)

    if with_ray:
        with cluster() as (address, kill_node):
            out, started = folder / "ray", time.perf_counter()
            with command(logs, out, "--ray", address) as process:
                wait_for_rows(out, count // 2, process)
                kill_node()
            yield ("Ray, 2 nodes", time.perf_counter() - started, 1, "kill -9 of a node"), rows_of(out)


@contextmanager
def command(logs: Path, out: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Starts `pcgan batch`, and waits for its end."""
    words = [sys.executable, "-m", "replay.cli", "batch", str(logs), "-o", str(out), *options]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, text=True) as process:
        try:
            yield process
        except BaseException:
            process.kill()
            raise


def whole(logs: Path, out: Path, *options: str) -> float:
    """Runs `pcgan batch` to its end and returns how many seconds it took."""
    started = time.perf_counter()
    with command(logs, out, *options) as process:
        code = process.wait()
    assert code == 0, f"pcgan batch ended with exit code {code}"
    return time.perf_counter() - started


def rows_of(out: Path) -> list[Row]:
    """Returns the rows of a batch, without timings."""
    rows = pq.read_table(out / RESULTS).to_pylist()
    return [{name: value for name, value in row.items() if name not in TIMINGS} for row in rows]


def wait_for_rows(out: Path, count: int, process: subprocess.Popen[str]) -> None:
    """Returns when so many logs are done."""
    while len(list((out / ROWS).glob("*.json"))) < count:
        assert process.poll() is None, "the batch ended too early"
        time.sleep(0.01)


@contextmanager
def cluster() -> Iterator[tuple[str, Callable[[], None]]]:
    """Gives the address of a Ray cluster of two nodes on this machine, and what kills the second one."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    from ray.cluster_utils import Cluster

    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")  # a short path: sockets lie in it
    nodes = Cluster(initialize_head=True, head_node_args={**NODE, "temp_dir": folder})
    try:
        second = nodes.add_node(**NODE)
        yield nodes.address, lambda: nodes.remove_node(second, allow_graceful=False)
    finally:
        nodes.shutdown()
        shutil.rmtree(folder, ignore_errors=True)


def descendants(pid: int) -> list[int]:
    """Returns the ids of a process's children, and theirs."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    children = [int(child) for task in tasks for child in (task / "children").read_text().split()]
    return [each for child in children for each in (child, *descendants(child))]


def command_of(pid: int) -> str:
    """Returns the command line of a process."""
    return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")


def print_runs(runs: Sequence[Run], logs: int, seconds: float, console: Console) -> None:
    """Prints one line for each way."""
    table = Table(title=f"{logs} logs of {seconds:g} s", title_justify="left")
    for heading in ("way", "wall s", "times real time", "commands", "killed", "same rows"):
        table.add_column(heading, justify="left" if heading in {"way", "killed"} else "right")
    for run in runs:
        speed = f"{logs * seconds / run.wall_s:.1f}"
        same = "yes" if run.same_rows else "NO"
        table.add_row(run.way, f"{run.wall_s:.1f}", speed, str(run.commands), run.killed, same)
    console.print(table)


if __name__ == "__main__":
    main()
