"""The subcommand `pcgan whatif`: who would be in the vehicle's way if it drove otherwise from a moment on."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from replay.cli_common import (
    DRIVES,
    Log,
    PedestrianLabels,
    ProfileFile,
    RoleOptions,
    Salvage,
    Start,
    TimeOffsets,
    Tracks,
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

if TYPE_CHECKING:
    from replay.frame_result import FrameResult
    from replay.session import Replay
    from replay.what_if import Entry, Hypothesis, Pedestrian, Predict, WhatIf
    from schemas.messages import PredictionFrame, TrackFrame

app = typer.Typer()

LIMITATION = "the model sees the vehicle up to this moment only: people are predicted to walk the same in both futures"


class Side(StrEnum):
    """To which side the vehicle swerves."""

    left = "left"
    right = "right"


@app.command(rich_help_panel=DRIVES)
def whatif(
    logs: Log,
    at: Annotated[float, typer.Option(min=0, max=1e9, metavar="S", help="The moment, in seconds into the log.")],
    brake: Annotated[bool, typer.Option("--brake", metavar="", help="Suppose that the vehicle brakes.")] = False,
    deceleration: Annotated[float, typer.Option(min=0.1, max=15, metavar="A", help="m/s², of --brake.")] = 3.0,
    swerve: Annotated[
        Side | None, typer.Option(metavar="left|right", help="Suppose that it shifts to one side.")
    ] = None,
    offset: Annotated[float, typer.Option(min=0.1, max=20, metavar="M", help="How far, of --swerve.")] = 1.5,
    over: Annotated[float, typer.Option(min=0.1, max=20, metavar="S", help="How long it takes, of --swerve.")] = 2.0,
    path: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Suppose that it drives along a CSV of t,x,y or t,x,y,yaw, seen from it now."
        ),
    ] = None,
    as_json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write all figures as JSON.")] = None,
    rrd: Annotated[
        Path | None, typer.Option("--rrd", metavar="FILE", help="Draw both futures into a rerun recording.")
    ] = None,
    view: Annotated[bool, typer.Option("--view", metavar="", help="Look at both futures in the rerun viewer.")] = False,
    start: Start = None,
    model: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", help="Weights: one of pcgan models, or a file. [default: marked there]"),
    ] = None,
    connect: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Ask a running pcgan predict, e.g. tcp/127.0.0.1:7447.")
    ] = None,
    zenoh_config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A zenoh configuration to ask it with, e.g. for TLS.")
    ] = None,
    namespace: Annotated[str, typer.Option(help="Prefix of its zenoh keys.")] = "",
    salvage: Salvage = False,
    role: RoleOptions = None,
    pedestrian_label: PedestrianLabels = None,
    tracks: Tracks = None,
    time_offset: TimeOffsets = None,
    profile: ProfileFile = None,
) -> None:
    """Suppose that the vehicle brakes, swerves or follows a path, and compare who enters its corridor.

    The corridor is what the vehicle sweeps within the model's horizon, 0.3 m of margin included. For now the model
    does not react to the supposed path: it sees the vehicle up to the moment only. The corridor does use it.

    **Examples**

    pcgan whatif drive.mcap --at 7.6 --brake

    pcgan whatif drive.mcap --at 7.6 --swerve left --rrd futures.rrd

    pcgan whatif drive.mcap --at 7.6 --path plan.csv --json futures.json

    **Exit codes**: 0 all well, 2 an error, 3 messages were refused or lost, 130 Ctrl-C, 143 SIGTERM.
    """
    from replay.record import refuse_overwriting
    from replay.session import PredictorChoice, Replay
    from replay.what_if import NEAREST_S, compare, frame_at, what_if
    from replay.what_if import as_json as figures_of
    from replay.what_if_view import what_if_view

    if namespace and connect is None and zenoh_config is None:
        fail("--namespace is of a running predictor: say with --connect or --zenoh-config where that is")
    if rrd is not None and view:
        fail("--rrd writes a file and --view opens a viewer: leave one of them out")
    written = [file for file in (as_json, rrd) if file is not None]
    refuse_overwriting(logs, *written)
    refuse_unwritable(*written)
    hypothesis = _hypothesis(path, brake, deceleration, swerve, offset, over)
    settings = settings_of(
        profile, start=start, roles=role, tracks=tracks, time_offsets=time_offset, pedestrian_labels=pedestrian_label
    )
    if at < settings.start_s:
        fail(f"--at {at:g} lies before the start, {settings.start_s:g} s into the log")
    settings = settings.model_copy(update={"duration_s": at - settings.start_s + NEAREST_S})
    run = Replay(logs, settings, PredictorChoice("inline", model), salvage=salvage)
    note_missing(run)
    with ended_by_signals(), what_if_view(rrd, view, "+".join(log.stem for log in logs)) as shown, run:
        with progress() as bar:
            bar.add_task("replaying", total=None)
            frame = frame_at(run, at)
        with _asked(run, frame, connect, zenoh_config, namespace) as predict:
            found = what_if(predict, frame.tracks, hypothesis)
        people = compare(found)
        if shown is not None:
            shown.show_futures(found, people)
    at_s = (frame.log_time_ns - run.reader.start_ns) / 1e9
    if as_json is not None:
        about = {"files": [log.name for log in logs], "at_s": round(at_s, 3), "hypothesis": hypothesis.figures}
        write_json(as_json, {**about, **figures_of(found, people), **refused_figures(run)})
    out = console(minimum_width=100)
    _print(found, people, at_s, out)
    raise typer.Exit(closing_lines(run, written, out))


def _hypothesis(
    path: Path | None, brake: bool, deceleration: float, swerve: Side | None, offset: float, over: float
) -> "Hypothesis":
    """Returns what the options suppose, or ends the command unless they suppose one thing."""
    from replay.what_if import braking, following, swerving

    if (path is not None) + brake + (swerve is not None) != 1:
        fail("suppose one thing: --brake, --swerve left or right, or --path FILE")
    if path is not None:
        return following(path)
    return braking(deceleration) if swerve is None else swerving(swerve is Side.left, offset, over)


@contextmanager
def _asked(
    run: "Replay", frame: "FrameResult", connect: str | None, zenoh_config: Path | None, namespace: str
) -> Iterator["Predict"]:
    """Yields whom to ask: the predictor of the run, or one on the bus if an endpoint or a configuration is given."""
    if connect is None and zenoh_config is None:

        def ask(tracks: "TrackFrame") -> "PredictionFrame":
            run.predictor.ask(tracks, frame.vehicle_pose)
            return run.predictor.answer()

        yield ask
        return
    from pcgan.bus import BusError, open_session
    from replay.what_if import ask_what_if

    try:
        session = open_session(connect=[] if connect is None else [connect], config_file=zenoh_config)
    except BusError as error:
        fail(str(error))
    with session:
        yield lambda frame: ask_what_if(session, frame, namespace)


def _print(found: "WhatIf", people: Sequence["Pedestrian"], at_s: float, out: Console) -> None:
    """Prints whom either future concerns, and how."""
    concerned = [person for person in people if person.concerned]
    others = len(people) - len(concerned)
    out.print(
        f"[bold]{at_s:.2f} s[/] into the log, vehicle at {found.motion.speed_mps:.1f} m/s: it drives on, or it "
        f"[bold]{escape(found.supposed.name)}[/]; within {found.horizon_s:.1f} s, by {found.driven_on.answer.model}",
        soft_wrap=True,
    )
    if concerned:
        table = Table(title="who enters its corridor", title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
        columns = ("track", "distance m", "ahead m", "left m", "drives on", "after s", found.supposed.name)
        for column in (*columns, "after s", "change"):
            table.add_column(column, justify="right")
        for person in concerned:
            before, after = person.driven_on, person.supposed
            places = (f"{value:.1f}" for value in (person.distance_m, person.ahead_m, person.left_m))
            table.add_row(
                f"{person.id}{'*' if person.fallback else ''}",
                *places,
                *_cells(before),
                *_cells(after),
                f"{after.probability - before.probability:+.0%}",
            )
        out.print(table)
    if not concerned:
        out.print("nobody enters either corridor with a probability of 1% or more", soft_wrap=True)
    elif others:
        out.print(f"{others} more: less than 1% in both", style="dim")
    if any(person.fallback for person in concerned):
        out.print("*: too young a track, or coasting; it is carried on at constant velocity", style="dim")
    out.print(f"note: {LIMITATION}", style="dim", soft_wrap=True)


def _cells(entry: "Entry") -> tuple[str, str]:
    return f"{entry.probability:.0%}", "" if entry.time_s is None else f"{entry.time_s:.1f}"
