"""Trains every network of the tables: all methods, folds and seeds. Resumable: what is complete is left alone.

pcgan windows -o windows
python -m benchmarks.train_all [--runs DIR] [--jobs 2] [--only TEXT]

The windows are for the two networks that predict in replays. Checkpoints, curves and states go to DIR, named
METHOD[_paper]_DATA[_SCENE]_sSEED. About two hours on two cores.
"""

import argparse
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from pcgan.protocols import ETH_UCY_SCENES

SEEDS = {"sgan": 1, "srlstm": 1, "psgan": 3, "pcgan": 3}


@dataclass(frozen=True)
class Job:
    """One training run: its name without the seed, and the options that are its own."""

    task: str
    options: tuple[str, ...]
    seed: int

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.task}_s{self.seed}"

    def command(self, runs: Path) -> list[str]:
        """The command line that runs it."""
        words = [sys.executable, "-m", "replay.cli", "train", *self.options]
        return [*words, "--seed", str(self.seed), "-o", str(runs), "--name", self.name]


def jobs() -> list[Job]:
    """Returns all runs: first seeds first, ours before what it is compared with."""
    found = []
    for seed in range(max(SEEDS.values())):
        for method, recipe in (("pcgan", "best"), ("psgan", "best"), ("pcgan", "paper"), ("psgan", "paper"),
                               ("srlstm", "best"), ("sgan", "best")):  # fmt: skip
            if seed >= SEEDS[method]:
                continue
            own = ("--method", method, "--recipe", recipe)
            name = f"{method}_paper" if recipe == "paper" else method
            for scene in ETH_UCY_SCENES:
                options = (*own, "--data", "eth_ucy", "--leave-out", scene)
                found.append(Job(f"{name}_eth_ucy_{scene}", options, seed))
            found.append(Job(f"{name}_vci", (*own, "--data", "vci"), seed))
        pcgan = ("--method", "pcgan", "--data")
        found.append(Job("pcgan_dut_long", (*pcgan, "drives", "--dt", "0.4"), seed))
        for task, options in (("vci", ("vci",)), ("dut_long", ("drives", "--dt", "0.4"))):
            found.append(Job(f"pcgan_no_vehicle_{task}", (*pcgan, *options, "--no-vehicle"), seed))
    for rate, step in (("10hz", "0.1"), ("2.5hz", "0.4")):
        windows = ("--windows", f"windows/tracked_{rate}.npz")
        found.append(Job(f"vehicle_{rate}", ("--method", "pcgan", "--data", "drives", "--dt", step, *windows), 0))
    return found


def main() -> int:
    """Runs what is not complete; returns how many runs failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where checkpoints go (runs)")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time, a core each (2)")
    parser.add_argument("--only", default="", help="only runs whose name has this in it, e.g. pcgan_eth_ucy")
    arguments = parser.parse_args()
    arguments.runs.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=True)
    chosen = [job for job in jobs() if arguments.only in job.name]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    failed = []
    with Progress(console=console) as progress, ThreadPoolExecutor(arguments.jobs) as pool:
        task = progress.add_task("training", total=len(chosen))

        def run(job: Job) -> None:
            done = subprocess.run(
                job.command(arguments.runs), capture_output=True, text=True, check=False, env=environment
            )
            if done.returncode:
                failed.append(job.name)
                progress.console.print(f"{job.name}: {done.stderr.strip()[-500:]}")
            progress.advance(task)

        list(pool.map(run, chosen))
    return len(failed)


if __name__ == "__main__":
    raise SystemExit(main())
