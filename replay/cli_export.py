"""The subcommand `pcgan export`: tracks and predictions as Parquet."""

from pathlib import Path
from typing import Annotated

import typer

from replay.cli_common import (
    DRIVES,
    EXIT_REFUSED,
    Duration,
    Salvage,
    Start,
    console,
    ended_by_signals,
    errors,
    fail,
    progress,
)

app = typer.Typer()


@app.command(rich_help_panel=DRIVES)
def export(
    logs: Annotated[
        list[Path], typer.Argument(metavar="OUT.pcgan.mcap", help="An output of pcgan replay, in one file or several.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FOLDER", help="The tables go here. [default: OUT.pcgan]"),
    ] = None,
    mixtures: Annotated[
        bool, typer.Option("--mixtures", metavar="", help="Write the Gaussian mixtures, too: many rows.")
    ] = False,
    start: Start = None,
    duration: Duration = None,
    salvage: Salvage = False,
) -> None:
    """Export tracks and predictions as Parquet tables, for pandas, polars, DuckDB or Spark.

    **Examples**

    pcgan export drive.pcgan.mcap

    pcgan export drive.pcgan.mcap -o tables --mixtures

    pcgan export drive.pcgan.mcap --start 60 --duration 30

    **Exit codes**: 0 all well, 2 an error, 3 messages were refused or lost, 130 Ctrl-C, 143 SIGTERM; after
    those nothing is written.
    """
    from replay.errors import Refusals
    from replay.export import TABLES, table_paths
    from replay.export import export as export_tables
    from replay.log_reader import LogReader
    from replay.record import refuse_overwriting

    folder = output or logs[0].with_suffix("")
    if output is None and folder == logs[0]:
        fail(f"{logs[0]} has no ending to leave away: say with -o where the tables go")
    if folder.suffix == ".parquet" or folder.is_file():
        fail(f"{folder} must be a folder: it gets {', '.join(path.name for path in table_paths(Path(), TABLES))}")
    refuse_overwriting(logs, *table_paths(folder, TABLES))
    reader = LogReader(logs, salvage=salvage)
    start_ns = reader.start_ns + round((start or 0) * 1e9)
    if start_ns > reader.end_ns:
        fail(f"--start {start:g}: the log ends after {(reader.end_ns - reader.start_ns) / 1e9:.1f} s")
    end_ns = reader.end_ns + 1 if duration is None else start_ns + round(duration * 1e9)
    refusals = Refusals()
    with ended_by_signals(), progress() as bar:
        task = bar.add_task("exporting", total=(min(end_ns, reader.end_ns) - start_ns) / 1e9)

        def on_message(log_time_ns: int) -> None:
            bar.update(task, completed=(log_time_ns - start_ns) / 1e9)

        done = export_tables(
            reader,
            folder,
            mixtures=mixtures,
            start_ns=start_ns,
            end_ns=end_ns,
            refusals=refusals,
            on_message=on_message,
        )
    for name in done.missing:
        errors.print(f"note: the log has nothing for the table {name}", markup=False)
    out, losses = console(minimum_width=90), reader.losses.notes
    for line in refusals.first[:5] + losses[:5]:
        out.print(line, markup=False)
    if refusals.total:
        out.print(f"[yellow]{refusals.total} message{'s were' if refusals.total > 1 else ' was'} refused[/]")
    if losses:
        out.print("[yellow]the file is damaged[/]; every intact chunk was used")
    for path in done.paths:
        out.print(f"wrote {path}, {done.rows[path.stem]} rows", markup=False, highlight=False)
    raise typer.Exit(EXIT_REFUSED if refusals.total or losses else 0)
