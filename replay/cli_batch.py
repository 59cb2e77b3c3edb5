"""The subcommand `pcgan batch`: many logs, one row each."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from replay.cli_common import (
    EXIT_ERROR,
    EXIT_REFUSED,
    REGRESSION,
    ProfileFile,
    Salvage,
    console,
    fail,
    progress,
)
from replay.settings_file import read_profile

if TYPE_CHECKING:
    from replay.batch import BatchResult
    from replay.batch_table import Row

app = typer.Typer()

SHOWN_FAILURES = 50
FIGURES = (  # column, heading, whether more is better, decimals
    ("hota", "HOTA", True, 3),
    ("mota", "MOTA", True, 3),
    ("idf1", "IDF1", True, 3),
    ("id_switches", "id switches", False, 1),
    ("ade_m", "ADE m, against later tracks", False, 3),
    ("fde_m", "FDE m, against later tracks", False, 3),
    ("truth_ade_m", "ADE m, against ground truth", False, 3),
    ("truth_fde_m", "FDE m, against ground truth", False, 3),
)


@app.command(rich_help_panel=REGRESSION)
def batch(
    logs: Annotated[
        list[str], typer.Argument(metavar="LOGS...", help="Files, folders, globs in quotes, or URLs of these.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FOLDER", help="Everything goes here.")],
    workers: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Logs at a time. [default: one per processor]")
    ] = None,
    profile: ProfileFile = None,
    model: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", help="Weights: one of pcgan models, or a file. [default: marked there]"),
    ] = None,
    emit: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Write these forms: pcgan, foxglove, autoware. [default: pcgan]"),
    ] = None,
    no_outputs: Annotated[
        bool, typer.Option("--no-outputs", metavar="", help="Write rows only, no predictions.")
    ] = False,
    salvage: Salvage = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", metavar="", help="Try again what failed before, too.")
    ] = False,
    ray: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Use Ray: local starts one, auto or HOST:PORT joins a cluster."),
    ] = None,
) -> None:
    """Replay many drives: an output and a row of figures for each. What is done stays done.

    **Examples**

    pcgan batch drives/*.mcap -o results

    pcgan batch 'drives/**/*.mcap' -o results --workers 4 --no-outputs

    pcgan batch 's3://bucket/2026/*.mcap' -o results

    pcgan batch /shared/drives -o /shared/results --ray auto

    **Exit codes**: 0 all well, 2 an error, or some logs failed, 3 messages were refused or lost, 130 Ctrl-C,
    143 SIGTERM; the same command then goes on where it was.
    """
    from replay.batch import RESULTS, Batch, run_batch
    from replay.batch_ray import import_ray, run_jobs_on_ray
    from replay.batch_table import FAILED
    from replay.log_source import find_logs
    from replay.workers import run_jobs, usable_cpus

    if no_outputs and emit:
        fail("--no-outputs and --emit exclude each other: nothing is written, or these forms are")
    if ray is not None:
        import_ray()  # now, before anything in the folder is touched
    wanted = Batch(
        output,
        read_profile(profile),
        model,
        salvage,
        tuple(emit) if emit else ("pcgan",),
        outputs=not no_outputs,
        retry_failed=retry_failed,
    )
    sources = find_logs(logs)
    run: Any = (
        partial(run_jobs, workers=workers or usable_cpus())
        if ray is None
        else partial(run_jobs_on_ray, address=ray, workers=workers)
    )
    with progress() as bar:
        task = bar.add_task("replaying", total=len(sources))
        failed = 0

        def on_rows(rows: Sequence["Row"]) -> None:
            nonlocal failed
            failed += sum(row["status"] == FAILED for row in rows)
            said = f"replaying {_logs(len(sources))}" + (f", [red]{failed} failed[/]" if failed else "")
            bar.update(task, advance=len(rows), description=said)

        done = run_batch(wanted, sources, run, on_rows)
    print_batch(done, len(sources), output / RESULTS, console(minimum_width=110))
    raise typer.Exit(_exit_code(done))


def print_batch(done: "BatchResult", logs: int, results: Path, out: Console) -> None:
    """Prints how many logs went through, how fast and how well, and which failed and why."""
    fresh = [row for row in done.done if row["name"] in done.fresh]
    log_s = sum(row["log_s"] for row in fresh)
    before = len(done.rows) - len(done.fresh)
    out.print(
        f"[bold]{_logs(logs)}[/]: [bold]{len(done.done)}[/] done, [bold]{len(done.failed)}[/] failed"
        + (f", {logs - len(done.rows)} not yet" if len(done.rows) < logs else "")
        + (f"; {before} of them before this run" if before else ""),
        highlight=False,
    )
    if fresh:
        out.print(
            f"{log_s / 60:.1f} min of log in {done.wall_s / 60:.1f} min, {log_s / done.wall_s:.1f} times real time",
            highlight=False,
        )
    if done.done:
        out.print(_figures_table(done.done))
    for count, what in (("refused", "messages were refused"), ("lost", "damages were left out by --salvage")):
        rows = [row for row in done.done if row[count]]
        if rows:
            total = sum(row[count] for row in rows)
            out.print(f"[yellow]{total} {what}[/], in {len(rows)} of the logs", highlight=False)
    for row in done.failed[:SHOWN_FAILURES]:
        out.print(f"{row['name']} failed: {row['problem']}", markup=False, highlight=False, soft_wrap=True)
    if len(done.failed) > SHOWN_FAILURES:
        out.print(f"and {len(done.failed) - SHOWN_FAILURES} more; the table has them all", highlight=False)
    if done.stopped is not None:
        out.print(f"[yellow]stopped early[/]: {done.stopped} arrived; the same command goes on from here")
    out.print(f"wrote {results}, {len(done.rows)} rows", markup=False, highlight=False)


def _logs(count: int) -> str:
    return "1 log" if count == 1 else f"{count} logs"


def _figures_table(rows: Sequence["Row"]) -> Table:
    table = Table(title="over logs", title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("", no_wrap=True)
    for heading in ("mean", "worst"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("in", no_wrap=True)
    table.add_column("logs", justify="right", no_wrap=True)
    for column, heading, more_is_better, decimals in FIGURES:
        having = [row for row in rows if row[column] is not None]
        if not having:
            continue
        worst = (min if more_is_better else max)(having, key=lambda row: row[column])
        mean = sum(row[column] for row in having) / len(having)
        shown = f"{worst[column]:.{decimals}f}" if isinstance(worst[column], float) else str(worst[column])
        table.add_row(heading, f"{mean:.{decimals}f}", shown, worst["name"], str(len(having)))
    return table


def _exit_code(done: "BatchResult") -> int:
    if done.stopped is not None:
        return 128 + done.stopped.signum
    if done.failed:
        return EXIT_ERROR
    return EXIT_REFUSED if any(row["refused"] or row["lost"] for row in done.done) else 0
