"""What a check costs per minute of log, beside the same log played in real time.

python -m benchmarks.check_cost [--logs 4] [--seconds 30] [--pedestrians 20] [--repeats 3] [--json F]

Drives are simulated, a suite of them gets references, and `pcgan check` is then run as a user runs it, start-up
included: on one worker and two, with a page (pictures and slices, rerun recordings of no case or of all) and without.
`pcgan replay` of the same drives, one after another, says how much of it is the replay. The ways take turns, and the
fastest of the repeats counts: what slows one down is other work on the machine. Of that the CPU time says less, which
is all processes' together. Real time is a minute per minute; some seconds of `pcgan replay --rate 1` show that it is.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from replay.simulator import simulate

REAL_TIME = "pcgan replay --rate 1"
REPLAY = "pcgan replay, one after another"
WAYS: Mapping[str, tuple[str, ...]] = {
    "check, 1 worker": ("--workers", "1"),
    "check, 2 workers": ("--workers", "2"),
    "check --page, 1 worker": ("--workers", "1", "--page", "page", "--rerun", "none"),
    "check --page, 2 workers": ("--workers", "2", "--page", "page", "--rerun", "none"),
    "check --page --rerun all, 2 workers": ("--workers", "2", "--page", "page", "--rerun", "all"),
}


class Cost(NamedTuple):
    """What a command took."""

    wall_s: float
    cpu_s: float  # of all its processes


def main() -> None:
    """Measures, prints a table, and writes JSON if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=4, help="of the suite (4)")
    parser.add_argument("--seconds", type=float, default=30, help="of each log (30)")
    parser.add_argument("--pedestrians", type=int, default=20, help="around the vehicle (20)")
    parser.add_argument("--repeats", type=int, default=3, help="of each way; the fastest counts (3)")
    parser.add_argument("--real-seconds", type=float, default=10, help="of a log played at --rate 1 (10)")
    parser.add_argument("--json", type=Path, help="write the figures to this file as well")
    arguments = parser.parse_args()
    console = Console(width=140)
    console.print(f"{os.cpu_count()} CPUs, load average {os.getloadavg()[0]:.1f} before anything began", style="dim")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        console.print(f"simulating {arguments.logs} drives of {arguments.seconds:g} s", style="dim")
        logs = [folder / f"drive{i}.mcap" for i in range(arguments.logs)]
        for i, log in enumerate(logs):
            simulate(
                log,
                clip=None,
                vehicle=None,
                pedestrians=arguments.pedestrians,
                duration_s=arguments.seconds,
                seed=1 + i,
            )
        (folder / "suite.yaml").write_text("logs: [drive*.mcap]\n")
        pcgan(folder, "check", "suite.yaml", "--update", "--reason", "first")
        rows = measure(folder, logs, arguments.seconds, arguments.repeats)
        rows.append(real_time(folder, logs[0], arguments.real_seconds))
    show(rows, console)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


def measure(folder: Path, logs: Sequence[Path], seconds: float, repeats: int) -> list[dict[str, Any]]:
    """Returns a row per way, the fastest of its repeats; in each round every way has its turn."""
    costs: dict[str, list[Cost]] = {way: [] for way in (REPLAY, *WAYS)}
    for _ in range(repeats):
        each = [pcgan(folder, "replay", log.name, "-o", "out.mcap") for log in logs]
        costs[REPLAY].append(Cost(sum(cost.wall_s for cost in each), sum(cost.cpu_s for cost in each)))
        for way, options in WAYS.items():
            costs[way].append(pcgan(folder, "check", "suite.yaml", *options))
    return [row(way, seconds * len(logs), found) for way, found in costs.items()]


def real_time(folder: Path, log: Path, seconds: float) -> dict[str, Any]:
    """Plays the beginning of a log at its own rate; returns its row, the time without what starting up takes."""
    settings = ("--rate", "1", "--duration", str(seconds), "--json", "summary.json")
    cost = pcgan(folder, "replay", log.name, "-o", "out.mcap", *settings)
    summary = json.loads((folder / "summary.json").read_text())
    return row(REAL_TIME, summary["log_s"], [Cost(summary["wall_s"], cost.cpu_s)])


def row(way: str, log_s: float, costs: Sequence[Cost]) -> dict[str, Any]:
    """Returns the figures of one way."""
    wall_s, cpu_s = min(cost.wall_s for cost in costs), min(cost.cpu_s for cost in costs)
    return {
        "way": way,
        "log_s": log_s,
        "wall_s": wall_s,
        "slowest_s": max(cost.wall_s for cost in costs),
        "s_per_minute": 60 * wall_s / log_s,
        "cpu_s_per_minute": 60 * cpu_s / log_s,
        "times_real_time": log_s / wall_s,
    }


def pcgan(folder: Path, *arguments: str) -> Cost:
    """Runs the command in a folder and returns what it took; raises CalledProcessError unless all is well."""
    command = [sys.executable, "-c", "from replay.cli import main; main()", *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    started, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    wall_s, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        sys.stderr.write(done.stdout + done.stderr)
        done.check_returncode()
    return Cost(wall_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def show(rows: Sequence[dict[str, Any]], console: Console) -> None:
    """Prints the rows as a table; the last columns compare with the plain check on one worker."""
    plain = next(each for each in rows if each["way"] in WAYS)
    table = Table(
        "way", "log s", "s (slowest)", "s per minute", "CPU s per minute", "times real time", "s : 1", "CPU : 1"
    )
    for each in rows:
        table.add_row(
            each["way"],
            f"{each['log_s']:.0f}",
            f"{each['wall_s']:.1f} ({each['slowest_s']:.1f})",
            f"{each['s_per_minute']:.1f}",
            f"{each['cpu_s_per_minute']:.1f}",
            f"{each['times_real_time']:.1f}",
            f"{each['s_per_minute'] / plain['s_per_minute']:.2f}",
            f"{each['cpu_s_per_minute'] / plain['cpu_s_per_minute']:.2f}",
        )
    console.print(table)


if __name__ == "__main__":
    main()
