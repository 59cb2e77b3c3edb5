"""The subcommand `pcgan diff`: where, and by how much, two logs differ."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from replay.cli_common import (
    REGRESSION,
    Salvage,
    ended_by_signals,
    errors,
    progress,
    refuse_unwritable,
)

if TYPE_CHECKING:
    from replay.diff_result import Tolerances
    from replay.diff_view import DiffView

app = typer.Typer()

EXIT_DIFFERENT = 1


@app.command(rich_help_panel=REGRESSION)
def diff(
    a: Annotated[Path, typer.Argument(metavar="A.mcap", help="The first log: what the other is held against.")],
    b: Annotated[Path, typer.Argument(metavar="B.mcap", help="The second log.")],
    topics: Annotated[
        list[str] | None,
        typer.Option("--topics", metavar="TOPIC,...", help="Only these; * and ? stand for any. [default: all]"),
    ] = None,
    atol: Annotated[
        float, typer.Option(min=0, max=1e9, metavar="X", help="Numbers are the same if |a - b| <= atol + rtol |a|.")
    ] = 1e-4,
    rtol: Annotated[float, typer.Option(min=0, max=1e9, metavar="X", help="See --atol.")] = 1e-6,
    ignore: Annotated[
        list[str] | None,
        typer.Option(metavar="FIELD,...", help="Leave fields out, and all in them: predictions.mixture, say."),
    ] = None,
    share: Annotated[
        float,
        typer.Option(min=0, max=1, metavar="X", help="How much of a topic may differ: values, messages, items."),
    ] = 0,
    rrd: Annotated[
        Path | None, typer.Option("--rrd", metavar="FILE", help="Draw both over each other into a rerun recording.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", metavar="", help="Print JSON instead of a table.")] = False,
    salvage: Salvage = False,
) -> None:
    """Compare two logs: the first difference of each topic, how large the others are, and when.

    Tracks that were only renumbered are the same, and so is what a reference of pcgan check leaves out. Any MCAP file
    will do: protobuf, ROS 1, ROS 2 and JSON are compared value by value, others by their bytes.

    **Examples**

    pcgan diff before.mcap after.mcap

    pcgan diff before.mcap after.mcap --topics /pcgan/tracks --atol 0.01

    pcgan diff before.mcap after.mcap --ignore predictions.mixture --rrd both.rrd

    pcgan diff before.mcap after.mcap --json | jq .topics[].first

    **Exit codes**: 0 the same, 1 different, 2 an error, 130 Ctrl-C, 143 SIGTERM.
    """
    from replay.diff import Tolerances, diff_logs
    from replay.diff_table import print_diff

    if rrd is not None:
        from replay.record import refuse_overwriting

        refuse_overwriting([a, b], rrd)
        refuse_unwritable(rrd)
    tolerances = Tolerances(
        topics=tuple(_split(topics)) or None, atol=atol, rtol=rtol, ignore=tuple(_split(ignore)), share=share
    )
    tolerances, about_reference = _for_reference(tolerances, a, b)
    with ended_by_signals(), _view(rrd, a, b, tolerances) as view, progress() as bar:
        task = bar.add_task("comparing", total=1.0)
        found = diff_logs(
            [a],
            [b],
            tolerances,
            salvage=salvage,
            on_progress=lambda done: bar.update(task, completed=done),
            on_pair=view.show_pair if view is not None else None,
        )
    found = replace(found, notes=(*about_reference, *found.notes))
    if as_json:
        typer.echo(json.dumps(found.as_json(), indent=2))
    else:
        out = Console()
        print_diff(found, tolerances, out)
        if rrd is not None:
            out.print(f"wrote {rrd}", markup=False, highlight=False)
    for note in found.notes:
        errors.print(f"note: {note}", markup=False)
    raise typer.Exit(0 if found.same else EXIT_DIFFERENT)


def _for_reference(tolerances: "Tolerances", a: Path, b: Path) -> "tuple[Tolerances, tuple[str, ...]]":
    """Returns tolerances that ask for no more than a reference holds, and a note on that; unchanged without one.

    With it tracks, poses and predictions are compared as `pcgan check` does. Two references lack the same, and are
    compared as they are.
    """
    from replay.reference import NAMED, THINNED
    from replay.thin_output import GRID, TOPICS

    references = [path for path in (a, b) if _is_reference(path)]
    if len(references) != 1:
        return tolerances, ()
    fields = (*THINNED, *NAMED)
    changed: dict[str, object] = {
        "atol": max(tolerances.atol, GRID / 2),
        "ignore": (*tolerances.ignore, *fields),
    }
    other_topics = ""
    if tolerances.topics is None:
        changed["topics"] = TOPICS
        other_topics = f", and topics other than {', '.join(TOPICS)},"
    note = f"{references[0].name} is a thinned reference: {', '.join(fields)}{other_topics} are not compared"
    return tolerances.model_copy(update=changed), (note,)


def _is_reference(path: Path) -> bool:
    """Tells whether a file says that it is a reference; what cannot be read is none, and the comparison tells why."""
    from mcap.reader import SeekingReader

    from replay.reference import RECORD

    try:
        with path.open("rb") as stream:
            summary = SeekingReader(stream).get_summary()
    except Exception:  # what mcap raises on damage has no common base
        return False
    return summary is not None and any(index.name == RECORD for index in summary.metadata_indexes)


@contextmanager
def _view(rrd: Path | None, a: Path, b: Path, tolerances: "Tolerances") -> "Iterator[DiffView | None]":
    """Yields a view into a file, or None if none is wanted; raises ViewError."""
    if rrd is None:
        yield None
        return
    from replay.diff_view import DiffView

    with DiffView.of_logs(rrd, a, b, tolerances) as view:
        yield view


def _split(options: list[str] | None) -> list[str]:
    """Returns the parts of an option that may be repeated, and may name several with commas between."""
    return [part.strip() for option in options or () for part in option.split(",") if part.strip()]
