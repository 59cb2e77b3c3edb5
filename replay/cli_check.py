"""The subcommand `pcgan check`: a suite of recordings replayed, compared with references and judged."""

import shlex
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from replay.check_result import Status
from replay.cli_common import (
    EXIT_ERROR,
    REGRESSION,
    console,
    ended_by_signals,
    errors,
    fail,
    progress,
    refuse_unwritable,
    write_json,
)
from replay.interrupts import Interrupted, Interrupts

if TYPE_CHECKING:
    from replay.check import Check, CheckOptions
    from replay.suite import Suite

app = typer.Typer()

EXIT_CHANGED = 1


@app.command(rich_help_panel=REGRESSION)
def check(
    suite: Annotated[
        Path, typer.Argument(metavar="SUITE", help="Logs and what is expected of them: YAML, TOML or JSON.")
    ],
    only: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Check these cases only; * and ? stand for any letters.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Processes side by side. [default: one per CPU]")
    ] = None,
    update: Annotated[
        bool, typer.Option("--update", metavar="", help="Write references that differ or are missing.")
    ] = False,
    reason: Annotated[
        str | None, typer.Option(metavar="TEXT", help="Why, with --update; kept in the references.")
    ] = None,
    sweep: Annotated[
        bool, typer.Option("--sweep", metavar="", help="Try the suite's variants, too, side by side.")
    ] = False,
    page: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Write a page here: what changed, and the worst moments.")
    ] = None,
    rerun: Annotated[
        str | None,
        typer.Option(metavar="changed|all|none", help="Cases of the page that get a rerun recording. [default: all]"),
    ] = None,
    keep: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Keep the outputs here.")] = None,
    junit: Annotated[Path | None, typer.Option(metavar="FILE", help="Write JUnit XML for a CI system.")] = None,
    as_json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write everything as JSON.")] = None,
) -> None:
    """Check recorded drives for regressions: replay a suite, compare it with references, judge it.

    **Examples**

    pcgan check suite.yaml

    pcgan check suite.yaml --page page --junit junit.xml

    pcgan check suite.yaml --only "crossing*" --update --reason "new birth model"

    pcgan check suite.yaml --sweep

    **Exit codes**: 0 all passed, 1 a case differs, misses an expectation or has no reference, 2 an error, 130
    Ctrl-C, 143 SIGTERM; after those no reference is half written.
    """
    from replay.check import CheckOptions, Rerun, is_page_or_free
    from replay.check_table import print_check
    from replay.junit import junit_xml
    from replay.part_file import same_file, write_whole
    from replay.record import refuse_overwriting
    from replay.suite import read_suite
    from replay.workers import usable_cpus

    if update and not (reason or "").strip():
        fail("--update wants --reason TEXT: why the new outputs are right; it is kept in the references")
    if reason is not None and not update:
        fail("--reason goes with --update")
    if rerun is not None and rerun not in list(Rerun):
        fail(f"--rerun wants {', '.join(Rerun)}; got {rerun!r}")
    if rerun is not None and page is None:
        fail("--rerun goes with --page")
    for option, folder in (("--page", page), ("--keep", keep)):
        if folder is not None and folder.exists() and not folder.is_dir():
            fail(f"{option}: {folder} must be a folder, and is a file")
    if page is not None and not is_page_or_free(page):
        fail(f"--page: {page} holds other files; choose a new folder")
    refuse_unwritable(junit, as_json)
    plan = read_suite(suite)
    files = [path for path in (junit, as_json) if path is not None]
    if any(same_file(path, suite) for path in files):
        fail(f"{suite} is the suite itself, which is never overwritten; choose another file")
    refuse_overwriting([log.path for case in plan.cases for log in case.logs if log.path is not None], *files)
    if sweep and not plan.sweep:
        fail(f"--sweep: {suite} has no sweep; list variants there, such as sweep: {{eager: {{settings: ...}}}}")
    options = CheckOptions(
        workers or usable_cpus(), tuple(only or ()), reason, keep, page, Rerun(rerun or "all"), sweep
    )
    with ended_by_signals():
        with _stopped_early():
            done = _run(plan, options)
        written = []
        if page is not None:
            from replay.check_page import write_page

            with Interrupts() as interrupts:
                interrupts.ignore()  # its pictures are those of this check already
                written.append(write_page(done.results, page, title=f"pcgan check {suite.name}"))
        if junit is not None:
            write_whole(junit, junit_xml(done.results, suite.stem))
            written.append(junit)
        if as_json is not None:
            write_json(as_json, _as_json(done, suite))
            written.append(as_json)
    out = console(minimum_width=80)
    print_check(done.results, out)
    _closing_lines(done, suite, [*done.references, *written], keep, page, out)
    raise typer.Exit(_exit_code(done))


@contextmanager
def _stopped_early() -> Iterator[None]:
    """Says what Ctrl-C has left."""
    try:
        yield
    except Interrupted:
        errors.print("stopped early: no reference was written")
        raise


def _run(plan: "Suite", options: "CheckOptions") -> "Check":
    from replay.check import check_suite

    with progress() as bar:
        task = bar.add_task("checking", total=None)
        return check_suite(plan, options, lambda done, every: bar.update(task, completed=done, total=every))


def _as_json(done: "Check", suite: Path) -> dict[str, object]:
    """Returns everything under the names that `--json` writes; only `wall_s` differs from run to run."""
    from replay.check_table import mean_figures

    return {
        "suite": suite.name,
        "passed": done.passed,
        "counts": dict(sorted(Counter(each.status for each in done.results).items())),
        "cases": [result.as_json() for result in done.results],
        "mean": mean_figures(done.results),
        "references_written": [str(path) for path in done.references],
        "notes": list(done.notes),
    }


def _closing_lines(
    done: "Check", suite: Path, written: list[Path], keep: Path | None, page: Path | None, out: Console
) -> None:
    """Says what to do next, and what has been written."""
    for note in done.notes:
        errors.print(f"note: {note}", markup=False)
    if kept := sum(result.output is not None for result in done.results):
        out.print(
            f"kept {kept} output{'' if kept == 1 else 's'} in {keep}", markup=False, highlight=False, soft_wrap=True
        )
    for result in done.results:
        if result.status is Status.CHANGED and result.output is not None and result.reference is not None:
            line = shlex.join(["pcgan", "diff", str(result.reference.path), str(result.output)])
            out.print(f"look closer: {line}", markup=False, highlight=False, soft_wrap=True)
    for path in written:
        out.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)
    if page is not None:
        out.print(f"rerun at those moments: pcgan report {page}", markup=False, highlight=False, soft_wrap=True)
    accepting = {Status.CHANGED: "if this is how it should be", Status.UNREFERENCED: "if these outputs are right"}
    for status, words in accepting.items():
        if any(result.status is status for result in done.results):
            line = f"{words}: pcgan check {suite} --update --reason TEXT"
            out.print(line, markup=False, highlight=False, soft_wrap=True)
            break


def _exit_code(done: "Check") -> int:
    if any(result.status is Status.ERROR for result in done.results):
        return EXIT_ERROR
    return 0 if done.passed else EXIT_CHANGED
