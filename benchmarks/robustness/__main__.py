"""Tries mutated files and prints what became of them; exit code 1 if anything forbidden happened."""

import argparse
import itertools
import sys
import time
from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.robustness import trial
from benchmarks.robustness.sources import make_sources
from benchmarks.robustness.trial import FORBIDDEN, Report


def print_report(report: Report, console: Console) -> None:
    """Prints how many files of each kind there were, what became of them, and every failure."""
    files = Table(title="mutated files, by source and kind")
    sources = sorted({source for _, source in report.files})
    for column in ("kind of mutation", *sources, "all"):
        files.add_column(column, justify="left" if column == "kind of mutation" else "right")
    for kind in dict.fromkeys(kind for kind, _ in sorted(report.files)):
        numbers = [report.files[kind, source] for source in sources]
        files.add_row(kind, *map(str, numbers), str(sum(numbers)))
    files.add_row("all", *(str(sum(report.files[k, s] for k, s in report.files if s == source)) for source in sources),
                  str(report.files.total()))  # fmt: skip
    console.print(files)
    by_step: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for (_, step, outcome), number in report.outcomes.items():
        by_step[step][outcome] += number
    outcomes = Table(title="what became of them")
    names = [trial.CLEAN, trial.NOTED, trial.REFUSED, trial.ONE_LINE, trial.UNSEEN, trial.MISNAMED, *FORBIDDEN]
    steps = sorted(by_step)
    for column in ("outcome", *steps):
        outcomes.add_column(column, justify="left" if column == "outcome" else "right")
    for name in names:
        outcomes.add_row(name, *(str(by_step[step].get(name, 0)) for step in steps), style="bold" * (name in FORBIDDEN))
    console.print(outcomes)
    console.print(f"messages of undamaged chunks: {report.expected}, all of them read by --salvage: "
                  f"{'no' if report.count(trial.LOST) else 'yes'}")  # fmt: skip
    console.print(f"one step took {report.peak_bytes / 2**20:.0f} MiB at most")
    kinds = itertools.groupby(sorted(report.failures, key=lambda f: (f.what, f.step, f.kind)), key=lambda f: f.what)
    for what, failures in kinds:
        found = list(failures)
        console.print(f"[red]{what}: {len(found)}[/]")
        for failure in found[:SHOWN]:
            console.print(f"  {failure}", markup=False, soft_wrap=True)


SHOWN = 12


def main() -> int:
    """Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=5000, help="how many mutated files")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    console = Console(width=max(240, Console().width))
    started = time.perf_counter()
    with TemporaryDirectory() as name, Progress(console=console, transient=True) as progress:
        task = progress.add_task("files", total=arguments.files)
        sources = make_sources(Path(name))
        report = trial.run(sources, Path(name), arguments.files, arguments.seed, lambda: progress.advance(task))
    print_report(report, console)
    console.print(f"{report.files.total()} files in {time.perf_counter() - started:.0f} s")
    return 1 if report.failures else 0


if __name__ == "__main__":
    sys.exit(main())
