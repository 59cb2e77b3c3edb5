"""The command `pcgan`: parse, call, print; nothing else. Commands about models and data are in files of their own."""

import json
import os
import signal
import sys
from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from pcgan.node_health import DEFAULT_DEADLINE_MS
from replay import (
    cli_batch,
    cli_check,
    cli_data,
    cli_diff,
    cli_export,
    cli_inspect,
    cli_label,
    cli_models,
    cli_play,
    cli_report,
    cli_track,
    cli_whatif,
)
from replay.cli_common import (
    DRIVES,
    EXIT_ERROR,
    EXIT_REFUSED,
    LIVE,
    Duration,
    Log,
    PedestrianLabels,
    ProfileFile,
    RoleOptions,
    Salvage,
    Start,
    Strict,
    TimeOffsets,
    Tracks,
    console,
    errors,
    fail,
    note_missing,
    progress,
    refuse_unwritable,
    settings_of,
    write_json,
)
from replay.cli_live import (
    Connect,
    Deadline,
    Listen,
    Namespace,
    Ros2Domain,
    ZenohConfig,
    health_line,
    live_session,
    place,
    status_line,
    warn_of_others,
)
from replay.errors import ReplayError
from replay.frame_result import FrameResult
from replay.interrupts import Interrupted
from replay.record import Summary, record, refuse_overwriting

app = typer.Typer(
    name="pcgan",
    help="Replays recorded drives and predicts what the pedestrians around the vehicle will do next.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(version("pcgan"))
        raise typer.Exit


@app.callback()
def _about(
    version: Annotated[
        bool, typer.Option("--version", metavar="", callback=_print_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    pass


class PredictorMode(StrEnum):
    """Where predictions come from."""

    spawned = "spawned"
    external = "external"
    inline = "inline"


Model = Annotated[
    str | None,
    typer.Option(metavar="NAME|FILE", help="Weights: one of pcgan models, or a file. [default: marked there]"),
]
Horizon = Annotated[
    float | None,
    typer.Option(min=0.1, metavar="S", help="The shipped weights that look at least so far ahead."),
]


@app.command(rich_help_panel=DRIVES)
def replay(
    logs: Log,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="OUT.mcap", help="Predictions go here. [default: LOG.pcgan.mcap]"),
    ] = None,
    merge: Annotated[bool, typer.Option("--merge", metavar="", help="Copy the recording into OUT.mcap, too.")] = False,
    emit: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Write these forms only: pcgan, foxglove, autoware. [default: the first two]"
        ),
    ] = None,
    rrd: Annotated[Path | None, typer.Option("--rrd", metavar="FILE", help="Write a rerun recording, too.")] = None,
    view: Annotated[bool, typer.Option("--view", metavar="", help="Open the rerun viewer and watch.")] = False,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="PNG", help="Draw the busiest moment, seen from above.")
    ] = None,
    summary: Annotated[
        Path | None, typer.Option("--json", metavar="SUMMARY.json", help="Write the summary as JSON.")
    ] = None,
    start: Start = None,
    duration: Duration = None,
    predictor: Annotated[
        PredictorMode, typer.Option(help="A process of its own, one already running, or this process.")
    ] = PredictorMode.spawned,
    connect: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Where an external predictor listens, e.g. tcp/host:7447.")
    ] = None,
    zenoh_config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="zenoh configuration for an external predictor (TLS, ACL).")
    ] = None,
    namespace: Annotated[
        str, typer.Option(metavar="TEXT", help="Prefix of the zenoh keys of an external predictor.")
    ] = "",
    model: Model = None,
    horizon: Horizon = None,
    window: Annotated[int, typer.Option(min=1, metavar="W", help="Frames that may be unanswered at a time.")] = 8,
    rate: Annotated[
        float | None, typer.Option(min=0.01, metavar="R", help="Times real time. [default: as fast as possible]")
    ] = None,
    strict: Strict = False,
    salvage: Salvage = False,
    tracks: Tracks = None,
    role: RoleOptions = None,
    pedestrian_label: PedestrianLabels = None,
    time_offset: TimeOffsets = None,
    profile: ProfileFile = None,
) -> None:
    """Replay a drive: track its pedestrians, predict them, write the predictions.

    **Examples**

    pcgan replay drive.mcap

    pcgan replay drive.mcap -o out.mcap --rrd out.rrd --json summary.json

    pcgan replay drive_0.mcap drive_1.mcap --start 60 --duration 30

    pcgan replay drive.mcap --horizon 3

    pcgan replay drive.mcap --tracks /perception/tracked_objects --emit autoware

    pcgan replay drive.mcap --predictor external --connect tcp/127.0.0.1:7447

    **Exit codes**: 0 all well, 2 an error, 3 messages were refused or lost, 130 Ctrl-C, 143 SIGTERM,
    129 a closed terminal.
    """
    from pcgan.bus import DEFAULT_ENDPOINT
    from replay.log_writer import DEFAULT_FORMATS
    from replay.picture import BusiestMoment, draw_top_down
    from replay.rerun_view import NullView, RerunView
    from replay.session import PredictorChoice, Replay
    from replay.summary_table import print_summary

    for option, value in (("--connect", connect), ("--zenoh-config", zenoh_config), ("--namespace", namespace)):
        if value and predictor is not PredictorMode.external:
            fail(f"{option} goes with --predictor external")
    if predictor is PredictorMode.external and (model is not None or horizon is not None):
        fail(f"{'--model' if model is not None else '--horizon'}: an external predictor has its own weights")
    if predictor is PredictorMode.external and not (connect or zenoh_config):
        connect = DEFAULT_ENDPOINT
    if merge and salvage:
        fail("--merge copies intact recordings only: it cannot go with --salvage")
    if rrd and view:
        fail("--rrd and --view exclude each other: write the recording and open it with rerun, or watch now")
    output = output or logs[0].with_name(f"{logs[0].stem}.pcgan.mcap")
    refuse_overwriting(logs, *(path for path in (output, rrd, picture, summary) if path is not None))
    refuse_unwritable(rrd, picture, summary)
    settings = settings_of(
        profile,
        start=start,
        duration=duration,
        roles=role,
        tracks=tracks,
        time_offsets=time_offset,
        pedestrian_labels=pedestrian_label,
    )
    choice = PredictorChoice(predictor.value, _chosen(model, horizon), connect, zenoh_config, namespace)
    run = Replay(
        logs,
        settings,
        choice,
        window=window,
        rate=rate,
        strict=strict,
        salvage=salvage,
        images=rrd is not None or view,
    )
    note_missing(run)
    if predictor is PredictorMode.external:
        errors.print(f"looking for a predictor on {connect or zenoh_config}", markup=False)
    recording_id = "+".join(path.stem for path in logs)
    shown = RerunView.to_file(rrd, recording_id) if rrd else RerunView.spawn(recording_id) if view else NullView()
    busiest = BusiestMoment()
    with progress() as bar:
        task = bar.add_task("replaying", total=(run.end_ns - run.start_ns) / 1e9)

        def on_frame(result: FrameResult) -> None:
            bar.update(task, completed=(result.log_time_ns - run.start_ns) / 1e9)
            if picture is not None:
                busiest.offer(result)

        try:
            done = record(
                run, output, shown, merge=merge, emit=tuple(emit) if emit else DEFAULT_FORMATS, on_frame=on_frame
            )
        except Interrupted as interruption:  # before the first frame: there is nothing to close
            raise typer.Exit(128 + interruption.signum) from None
    written = [output]
    if picture is not None and busiest.result is not None:
        draw_top_down(busiest.result, picture)
        written.append(picture)
    if rrd is not None:
        written.append(rrd)
    if summary is not None:
        write_json(summary, done.as_json())
        written.append(summary)
    print_summary(done, written, console(minimum_width=90))
    raise typer.Exit(_exit_code(done))


@app.command(rich_help_panel=DRIVES)
def simulate(
    output: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="The drive goes here.")],
    clip: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", help="A clip of a data set, or a trajectory file. [default: a crowd]"),
    ] = None,
    vehicle: Annotated[
        int | None, typer.Option(metavar="ID", help="The clip's vehicle that records. [default: the one that drives]")
    ] = None,
    pedestrians: Annotated[int, typer.Option(min=0, metavar="N", help="People around the vehicle, of a crowd.")] = 30,
    duration: Annotated[
        float | None, typer.Option(min=0.5, metavar="S", help="[default: 60 of a crowd, all of a clip]")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Of the crowd and of all sensor noise.")] = 0,
    points: Annotated[
        bool, typer.Option("--points", metavar="", help="Write the LiDAR's points, too: 4 MB a second.")
    ] = False,
) -> None:
    """Simulate a USyd-style drive: six fisheye cameras, a VLP-16, odometry, and the truth.

    **Examples**

    pcgan simulate drive.mcap --pedestrians 30 --duration 60 --seed 1

    pcgan simulate drive.mcap --clip dut/intersection_08 --vehicle 2

    pcgan simulate drive.mcap --clip my.csv

    pcgan simulate drive.mcap --duration 20 --points
    """
    from pcgan.clips import ClipError, DataNotFound
    from replay.simulator import SimulationError
    from replay.simulator import simulate as simulate_drive

    with progress() as bar:
        task = bar.add_task("simulating", total=1.0)
        try:
            drive = simulate_drive(
                output,
                clip=clip,
                vehicle=vehicle,
                pedestrians=pedestrians,
                duration_s=duration,
                seed=seed,
                points=points,
                progress=lambda fraction: bar.update(task, completed=fraction),
            )
        except (SimulationError, ClipError, DataNotFound) as error:
            fail(str(error))
        except OSError as error:
            fail(f"{output} cannot be written: {error.strerror or error}")
    typer.echo(f"{output}: {drive.duration_s:.1f} s of {drive.motion}, {drive.pedestrians} people, {drive.scans} scans")


@app.command(rich_help_panel=LIVE)
def predict(
    model: Model = None,
    horizon: Horizon = None,
    listen: Listen = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    namespace: Namespace = "",
    ros2_domain: Ros2Domain = None,
    deadline_ms: Deadline = DEFAULT_DEADLINE_MS,
    spawned: Annotated[Path | None, typer.Option("--spawned", hidden=True)] = None,  # in whose folder
) -> None:
    """Serve predictions over zenoh until Ctrl-C: pcgan/tracks in, pcgan/predictions out, queries on pcgan/predict.

    **Examples**

    pcgan predict

    pcgan predict --horizon 3

    pcgan predict --listen tcp/127.0.0.1:7450 --model my.safetensors

    pcgan predict --ros2-domain 0
    """
    from pcgan import bus

    with ExitStack() as ends:
        if spawned is not None:
            from replay.private_folder import remove_if_abandoned

            ends.callback(remove_if_abandoned, spawned)
            session = ends.enter_context(bus.open_session(connect=[connect] if connect else []))
        else:  # before the weights are loaded, which takes a while: who is started first listens
            session = ends.enter_context(live_session(listen, connect, zenoh_config, ros2_domain))
        from pcgan.checkpoint import CheckpointError, find_model
        from pcgan.predictor import Predictor
        from pcgan.predictor_process import run

        try:
            predictor = Predictor.from_checkpoint(find_model(_chosen(model, horizon)))
        except CheckpointError as error:
            fail(str(error))
        identity = bus.ModelIdentity(predictor.model_name, predictor.checksum)
        if spawned is None:
            warn_of_others(session, bus.any_alive_key(namespace), "a predictor", "every frame is answered twice")
            where = place(listen, connect, zenoh_config, ros2_domain)
            errors.print(f"serving {identity.name} on {where}; Ctrl-C ends it", markup=False)
        on_answer = None
        if ros2_domain is not None:
            from replay.ros2_bus import Ros2Node
            from replay.ros2_nodes import Ros2Predictions

            node = ends.enter_context(Ros2Node(session, ros2_domain, "pcgan_predict"))
            on_answer = Ros2Predictions(node, session, namespace).put
        say = ends.enter_context(status_line())
        refused = run(
            session,
            predictor,
            identity,
            namespace=namespace,
            deadline_ms=deadline_ms,
            end_with_stdin=spawned is not None,
            on_answer=on_answer,
            on_health=lambda health: say(health_line(health)),
        )
    if refused and spawned is None:
        errors.print(f"{refused} malformed messages were refused", markup=False)
        raise typer.Exit(EXIT_REFUSED)


@app.command(rich_help_panel=DRIVES)
def info(
    logs: Log,
    salvage: Salvage = False,
    role: RoleOptions = None,
    pedestrian_label: PedestrianLabels = None,
    profile: ProfileFile = None,
    seconds: Annotated[float, typer.Option(min=0.1, metavar="S", help="How much of the log to time.")] = 60,
    as_json: Annotated[bool, typer.Option("--json", metavar="", help="Print JSON instead of a table.")] = False,
) -> None:
    """Show what a recording holds: topics, rates, delays, roles, and what is missing.

    **Examples**

    pcgan info drive.mcap

    pcgan info drive.mcap --role pose:=/odom --role camera:=/front/detections

    pcgan info drive.mcap --json | jq .topics
    """
    from replay.log_info import describe_log, print_info

    settings = settings_of(profile, roles=role, pedestrian_labels=pedestrian_label)
    description = describe_log(logs, settings, salvage=salvage, seconds=seconds)
    if as_json:
        typer.echo(json.dumps(description, indent=2))
    else:
        print_info(description, console(minimum_width=170))
    raise typer.Exit(0 if description["usable"] else EXIT_ERROR)


app.add_typer(cli_inspect.app)
app.add_typer(cli_track.app)
app.add_typer(cli_label.app)
app.add_typer(cli_export.app)
app.add_typer(cli_whatif.app)
app.add_typer(cli_diff.app)
app.add_typer(cli_check.app)
app.add_typer(cli_report.app)
app.add_typer(cli_batch.app)
app.add_typer(cli_play.app)
app.add_typer(cli_models.app)
app.add_typer(cli_data.app, rich_help_panel="Data")


def main() -> None:
    """Runs the command; every error that a user can mend is one line and exit code 2."""
    try:
        app()
    except ReplayError as error:
        fail(str(error))
    except KeyboardInterrupt as interruption:
        signum: int = interruption.signum if isinstance(interruption, Interrupted) else signal.SIGINT
        raise SystemExit(128 + signum) from None
    except BrokenPipeError:  # the reader of our output has gone: nothing more to say, and nobody to say it to
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(EXIT_ERROR) from None


def _chosen(model: str | None, horizon_s: float | None) -> str | Path | None:
    """Returns the name or file of the weights that were asked for; None: no wish."""
    if horizon_s is None:
        return model
    if model is not None:
        fail("--model and --horizon exclude each other: name the weights, or say how far they have to look ahead")
    from pcgan.checkpoint import CheckpointError, model_for_horizon

    try:
        return model_for_horizon(horizon_s)
    except CheckpointError as error:
        fail(str(error))


def _exit_code(done: Summary) -> int:
    if done.stopped is not None:
        return 128 + done.stopped.signum if isinstance(done.stopped, Interrupted) else EXIT_ERROR
    return 0 if done.clean else EXIT_REFUSED


if __name__ == "__main__":
    main()
