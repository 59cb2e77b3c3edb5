"""The subcommand `pcgan label`: the smoothed trajectories of a recorded drive, as training data."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.table import Table

from replay.cli_common import (
    DRIVES,
    Duration,
    Log,
    PedestrianLabels,
    ProfileFile,
    RoleOptions,
    Salvage,
    Start,
    Strict,
    TimeOffsets,
    closing_lines,
    console,
    ended_by_signals,
    fail,
    note_missing,
    progress,
    refuse_unwritable,
    refused_figures,
    settings_of,
    write_json,
)
from replay.label_score import Scores

app = typer.Typer()


@app.command(rich_help_panel=DRIVES)
def label(
    logs: Log,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="A .csv, .csv.gz or .parquet. [default: LOG.trajectories.csv]"
        ),
    ] = None,
    summary: Annotated[
        Path | None, typer.Option("--json", metavar="SUMMARY.json", help="Write the summary as JSON.")
    ] = None,
    start: Start = None,
    duration: Duration = None,
    min_duration: Annotated[float, typer.Option(min=0, metavar="S", help="Leave shorter trajectories out.")] = 1.0,
    min_hits: Annotated[int, typer.Option(min=1, metavar="N", help="Leave out those of fewer measurements.")] = 5,
    max_gap: Annotated[
        float, typer.Option(min=0.001, metavar="S", help="Cut trajectories where nothing is measured for longer.")
    ] = 0.5,
    strict: Strict = False,
    salvage: Salvage = False,
    role: RoleOptions = None,
    pedestrian_label: PedestrianLabels = None,
    time_offset: TimeOffsets = None,
    profile: ProfileFile = None,
) -> None:
    """Label a drive: write its pedestrians' smoothed trajectories, to train on or to simulate again.

    **Examples**

    pcgan label drive.mcap

    pcgan label drive.mcap -o drive.parquet --json labels.json

    pcgan label drive_0.mcap drive_1.mcap --start 60 --duration 30

    pcgan train --method pcgan --data drives --trajectories drive.trajectories.csv

    **Exit codes**: 0 all well, 2 an error, 3 messages were refused or lost, 130 Ctrl-C, 143 SIGTERM; after
    those nothing is written.
    """
    from pcgan.clips import TRAJECTORY_SUFFIXES
    from replay.label import LabelSettings, part_of, save
    from replay.label import label as label_drive
    from replay.record import refuse_overwriting
    from replay.session import Replay
    from replay.time_sync import SyncedFrame

    output = output or logs[0].with_name(f"{logs[0].stem}.trajectories.csv")
    if not output.name.endswith(TRAJECTORY_SUFFIXES):
        fail(f"{output} must end in {', '.join(TRAJECTORY_SUFFIXES)}")
    if output.suffix == ".parquet" and find_spec("pyarrow") is None:
        fail(f"{output} needs the package pyarrow, which is not installed; .csv and .csv.gz need none")
    refuse_overwriting(logs, output, part_of(output), *([] if summary is None else [summary]))
    refuse_unwritable(output, summary)
    settings = settings_of(
        profile,
        start=start,
        duration=duration,
        roles=role,
        time_offsets=time_offset,
        pedestrian_labels=pedestrian_label,
    )
    wanted = LabelSettings(min_duration_s=min_duration, min_hits=min_hits, max_gap_s=max_gap)
    run = Replay(logs, settings, strict=strict, salvage=salvage)
    note_missing(run)
    with ended_by_signals(), progress() as bar:
        task = bar.add_task("labelling", total=(run.end_ns - run.start_ns) / 1e9)

        def on_frame(frame: SyncedFrame) -> None:
            bar.update(task, completed=(frame.log_time_ns - run.start_ns) / 1e9)

        labelled = label_drive(run, wanted, on_frame)
        save(labelled.rows, output)
    figures = {**labelled.as_json(), "settings": wanted.model_dump(mode="json"), **refused_figures(run)}
    written = [output]
    if summary is not None:
        write_json(summary, figures)
        written.append(summary)
    out = console(minimum_width=90)
    out.print(
        f"[bold]{labelled.trajectories}[/] trajectories of {labelled.tracks_kept} tracks "
        f"({labelled.tracks} were published), [bold]{figures['rows']}[/] rows, "
        f"{figures['vehicle_rows']} of the vehicle alone, of {labelled.scans} scans",
        soft_wrap=True,
    )
    if labelled.score is not None:
        out.print(_table(labelled.score))
    raise typer.Exit(closing_lines(run, written, out))


_FIGURES = (  # what the table shows, and how
    ("position_m", "position error, mean, m", ".3f"),
    ("velocity_mps", "velocity error, mean, m/s", ".3f"),
    ("position_nees", "error² over covariance (2: honest)", ".2f"),
    ("recall", "share of people's moments that are covered", ".3f"),
    ("precision", "share of states that are somebody's", ".3f"),
    ("hota", "HOTA", ".3f"),
    ("id_switches", "id switches", "d"),
    ("people", "people", "d"),
)


def _table(scores: dict[str, Scores]) -> Table:
    table = Table(title="against ground truth", title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("", no_wrap=True)
    for name in scores:
        table.add_column(name, justify="right")
    for figure, what, form in _FIGURES:
        values = [getattr(each, figure) for each in scores.values()]
        table.add_row(what, *("-" if value is None else format(value, form) for value in values))
    return table
