"""The command `pcgan`: parse, call, print; nothing else."""

import json
import os
import signal
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from replay.errors import ReplayError
from replay.frame_result import FrameResult
from replay.interrupts import Interrupted
from replay.record import Summary, record, refuse_overwriting
from replay.session import ReplaySettings

app = typer.Typer(
    name="pcgan",
    help="Replays recorded drives and predicts what the pedestrians around the vehicle will do next.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
errors = Console(stderr=True, highlight=False, soft_wrap=True)

EXIT_ERROR = 2  # a mistake that the user can mend: one line says which
EXIT_REFUSED = 3  # the run went through, but messages were refused or a damaged file lost some


class PredictorMode(StrEnum):
    """Where predictions come from."""

    spawned = "spawned"
    external = "external"
    inline = "inline"


Log = Annotated[list[Path], typer.Argument(metavar="LOG.mcap...", help="The recording, in one file or several.")]
Remaps = Annotated[
    list[str] | None,
    typer.Option("--topic", metavar="NAME:=NAME", help="Read a topic under another name, e.g. /vn100/odometry:=/odom."),
]
Salvage = Annotated[bool, typer.Option("--salvage", help="Read every intact chunk of a damaged file.")]


@app.command()
def replay(
    logs: Log,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="OUT.mcap", help="Predictions go here. [default: LOG.pcgan.mcap]"),
    ] = None,
    merge: Annotated[bool, typer.Option("--merge", help="Copy the recording into OUT.mcap, too.")] = False,
    rrd: Annotated[Path | None, typer.Option("--rrd", metavar="FILE", help="Write a rerun recording, too.")] = None,
    view: Annotated[bool, typer.Option("--view", help="Open the rerun viewer and watch.")] = False,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="PNG", help="Draw the busiest moment, seen from above.")
    ] = None,
    summary: Annotated[
        Path | None, typer.Option("--json", metavar="SUMMARY.json", help="Write the summary as JSON.")
    ] = None,
    start: Annotated[float, typer.Option(min=0, metavar="S", help="Begin this many seconds into the log.")] = 0.0,
    duration: Annotated[
        float | None, typer.Option(min=0.001, metavar="S", help="Stop after this many seconds. [default: all]")
    ] = None,
    predictor: Annotated[
        PredictorMode, typer.Option(help="A process of its own, one already running, or this process.")
    ] = PredictorMode.spawned,
    connect: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Where an external predictor listens, e.g. tcp/host:7447.")
    ] = None,
    zenoh_config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="zenoh configuration for an external predictor (TLS, ACL).")
    ] = None,
    namespace: Annotated[str, typer.Option(help="Prefix of the zenoh keys of an external predictor.")] = "",
    model: Annotated[Path | None, typer.Option(metavar="FILE", help="Weights. [default: those that ship]")] = None,
    window: Annotated[int, typer.Option(min=1, metavar="W", help="Frames that may be unanswered at a time.")] = 8,
    rate: Annotated[
        float | None, typer.Option(min=0.01, metavar="R", help="Times real time. [default: as fast as possible]")
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Stop at the first message that is refused.")] = False,
    salvage: Salvage = False,
    topic: Remaps = None,
    settings_file: Annotated[
        Path | None,
        typer.Option("--settings", metavar="FILE", help="Settings as JSON, such as an output's settings.json."),
    ] = None,
) -> None:
    """Replay a drive: track its pedestrians, predict them, write the predictions.

    **Examples**

    pcgan replay drive.mcap

    pcgan replay drive.mcap -o out.mcap --rrd out.rrd --json summary.json

    pcgan replay drive_0.mcap drive_1.mcap detections.mcap --start 60 --duration 30

    pcgan replay drive.mcap --predictor external --connect tcp/127.0.0.1:7447

    **Exit codes**: 0 all well, 2 an error, 3 messages were refused or lost, 130 Ctrl-C.
    """
    from replay.picture import BusiestMoment, draw_top_down
    from replay.rerun_view import NullView, RerunView
    from replay.session import PredictorChoice, Replay
    from replay.summary_table import print_summary

    if connect and predictor is not PredictorMode.external:
        _fail("--connect goes with --predictor external")
    if predictor is PredictorMode.external and not (connect or zenoh_config):
        connect = "tcp/127.0.0.1:7447"
    if merge and salvage:
        _fail("--merge copies intact recordings only: it cannot go with --salvage")
    if rrd and view:
        _fail("--rrd and --view exclude each other: write the recording and open it with rerun, or watch now")
    output = output or logs[0].with_name(f"{logs[0].stem}.pcgan.mcap")
    extras = [path for path in (rrd, picture, summary) if path is not None]
    refuse_overwriting(logs, *extras)
    for path in extras:  # now, not after an hour of replay
        if not path.parent.is_dir() or path.is_dir():
            _fail(f"{path} cannot be written: {path.parent} is no folder, or {path.name} is one")
    given = {"start_s": start or None, "duration_s": duration, "topics": _remaps(topic) or None}
    settings = _settings(settings_file).model_copy(update={k: v for k, v in given.items() if v is not None})
    choice = PredictorChoice(predictor.value, model, connect, zenoh_config, namespace)
    images = rrd is not None or view
    run = Replay(logs, settings, choice, window=window, rate=rate, strict=strict, salvage=salvage, images=images)
    for name in run.roles.missing:
        errors.print(f"note: the log has no {name}", markup=False)
    recording_id = "+".join(path.stem for path in logs)
    shown = RerunView.to_file(rrd, recording_id) if rrd else RerunView.spawn(recording_id) if view else NullView()
    busiest = BusiestMoment()
    with _progress() as progress:
        task = progress.add_task("replaying", total=(run.end_ns - run.start_ns) / 1e9)

        def on_frame(result: FrameResult) -> None:
            progress.update(task, completed=(result.log_time_ns - run.start_ns) / 1e9)
            if picture is not None:
                busiest.offer(result)

        try:
            done = record(run, output, shown, merge=merge, on_frame=on_frame)
        except Interrupted as interruption:  # before the first frame: there is nothing to close
            raise typer.Exit(128 + interruption.signum) from None
    written = [output]
    if picture is not None and busiest.result is not None:
        draw_top_down(busiest.result, picture)
        written.append(picture)
    if rrd is not None:
        written.append(rrd)
    if summary is not None:
        _write_json(summary, done.as_json())
        written.append(summary)
    print_summary(done, written, _console(minimum_width=90))
    raise typer.Exit(_exit_code(done))


@app.command()
def simulate(
    output: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="The drive goes here.")],
    clip: Annotated[
        str | None, typer.Option(metavar="NAME", help="Real trajectories, e.g. dut/roundabout_04. [default: a crowd]")
    ] = None,
    vehicle: Annotated[
        int | None, typer.Option(metavar="ID", help="The clip's vehicle that records. [default: the one that drives]")
    ] = None,
    pedestrians: Annotated[int, typer.Option(min=0, metavar="N", help="People around the vehicle, of a crowd.")] = 30,
    duration: Annotated[
        float | None, typer.Option(min=0.5, metavar="S", help="[default: 60 of a crowd, all of a clip]")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Of the crowd and of all sensor noise.")] = 0,
) -> None:
    """Simulate a USyd-style drive: six fisheye cameras, a VLP-16, odometry, and the truth.

    **Examples**

    pcgan simulate drive.mcap --pedestrians 30 --duration 60 --seed 1

    pcgan simulate drive.mcap --clip dut/intersection_08 --vehicle 2
    """
    from pcgan.clips import ClipError, DataNotFound
    from replay.simulator import SimulationError
    from replay.simulator import simulate as simulate_drive

    with _progress() as progress:
        task = progress.add_task("simulating", total=1.0)
        try:
            drive = simulate_drive(
                output,
                clip=clip,
                vehicle=vehicle,
                pedestrians=pedestrians,
                duration_s=duration,
                seed=seed,
                progress=lambda fraction: progress.update(task, completed=fraction),
            )
        except (SimulationError, ClipError, DataNotFound) as error:
            _fail(str(error))
        except OSError as error:
            _fail(f"{output} cannot be written: {error.strerror or error}")
    typer.echo(f"{output}: {drive.duration_s:.1f} s of {drive.motion}, {drive.pedestrians} people, {drive.scans} scans")


@app.command()
def predict(
    model: Annotated[Path | None, typer.Option(metavar="FILE", help="Weights. [default: those that ship]")] = None,
    listen: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Listen here. [default: tcp/127.0.0.1:7447]")
    ] = None,
    connect: Annotated[str | None, typer.Option(metavar="ENDPOINT", help="Connect here instead.")] = None,
    zenoh_config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="zenoh configuration: TLS, access control, other networks.")
    ] = None,
    namespace: Annotated[str, typer.Option(help="Prefix of the zenoh keys.")] = "",
    spawned: Annotated[bool, typer.Option("--spawned", hidden=True)] = False,
) -> None:
    """Serve predictions over zenoh until Ctrl-C: pcgan/tracks in, pcgan/predictions out.

    **Examples**

    pcgan predict

    pcgan predict --listen tcp/127.0.0.1:7450 --model my.safetensors
    """
    from pcgan import bus
    from pcgan.checkpoint import CheckpointError
    from pcgan.predictor import Predictor
    from pcgan.predictor_process import run

    listening = [listen] if listen else [] if connect or zenoh_config else [bus.DEFAULT_ENDPOINT]
    try:
        predictor = Predictor.from_checkpoint(model)
        session = bus.open_session(listen=listening, connect=[connect] if connect else [], config_file=zenoh_config)
    except (CheckpointError, bus.BusError) as error:
        _fail(str(error))
    identity = bus.ModelIdentity(predictor.model_name, predictor.checksum)
    if not spawned:
        where = ", ".join(listening) or connect or str(zenoh_config)
        errors.print(f"serving {identity.name} on {where}; Ctrl-C ends it", markup=False)
    refused = run(session, predictor, identity, namespace=namespace, end_with_stdin=spawned)
    session.close()  # type: ignore[no-untyped-call]
    if refused and not spawned:
        errors.print(f"{refused} malformed messages were refused", markup=False)
        raise typer.Exit(EXIT_REFUSED)


@app.command()
def info(
    logs: Log,
    salvage: Salvage = False,
    topic: Remaps = None,
    seconds: Annotated[float, typer.Option(min=0.1, metavar="S", help="How much of the log to time.")] = 60.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Show what a recording holds: topics, rates, delays, roles, and what is missing.

    **Examples**

    pcgan info drive.mcap

    pcgan info drive.mcap --json | jq .topics
    """
    from replay.log_info import describe_log, print_info

    description = describe_log(logs, _remaps(topic), salvage=salvage, seconds=seconds)
    if as_json:
        typer.echo(json.dumps(description, indent=2))
    else:
        print_info(description, _console(minimum_width=120))
    raise typer.Exit(0 if description["usable"] else EXIT_ERROR)


@app.command()
def train(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Checkpoint and curve go here.")] = Path(
        "runs"
    ),
    name: Annotated[str, typer.Option(help="Of the checkpoint.")] = "model",
    clips: Annotated[bool, typer.Option(help="Train on the annotated DUT clips.")] = True,
    windows: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE.npz", help="Train on a tracker's windows, too (pcgan windows makes them)."),
    ] = None,
    recipe: Annotated[str, typer.Option(help="paper: as published; best: what ships.")] = "best",
    start_from: Annotated[Path | None, typer.Option(metavar="FILE", help="Fine-tune this checkpoint.")] = None,
    epochs: Annotated[int, typer.Option(min=1, metavar="N", help="Passes over the training windows.")] = 40,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Of the weights and of the order of the windows.")] = 0,
) -> None:
    """Train a predictor (10 Hz, 8 steps observed, 12 predicted, with the vehicle); resumes where it stopped.

    **Examples**

    pcgan train -o runs --name first

    pcgan windows -o windows.npz && pcgan train -o runs --name tracked --windows windows.npz
    """
    from pcgan.checkpoint import CheckpointError
    from pcgan.clips import DataNotFound
    from pcgan.model import ModelConfig
    from pcgan.train import TrainConfig
    from pcgan.train import train as train_model
    from pcgan.windows_file import WindowsError

    try:
        config = TrainConfig(
            output,
            ModelConfig(recipe=recipe),
            name,
            clips=clips,
            windows=tuple(windows or ()),
            start_from=start_from,
            epochs=epochs,
            seed=seed,
        )
        typer.echo(train_model(config, console=errors))
    except (DataNotFound, WindowsError, CheckpointError, ValueError) as error:
        _fail(str(error))
    except OSError as error:
        _fail(f"{output} cannot be written: {error.strerror or error}")


@app.command()
def windows(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.npz", help="The windows go here.")] = Path(
        "windows.npz"
    ),
    seeds: Annotated[int, typer.Option(min=1, metavar="N", help="Drives per clip and vehicle.")] = 2,
) -> None:
    """Make training windows: drives simulated from the training clips, tracked by the real tracker.

    **Example**

    pcgan windows -o windows.npz --seeds 3
    """
    from pcgan.clips import ClipError, DataNotFound
    from replay.training_windows import make_windows

    if not output.parent.is_dir():
        _fail(f"{output} cannot be written: there is no folder {output.parent}")
    with _progress() as progress:
        task = progress.add_task("tracking drives", total=None)
        try:
            count = make_windows(
                output, seeds, progress=lambda done, total: progress.update(task, completed=done, total=total)
            )
        except (ClipError, DataNotFound) as error:
            _fail(str(error))
        except OSError as error:
            _fail(f"{output} cannot be written: {error.strerror or error}")
    typer.echo(f"{output}: {count} windows")


def main() -> None:
    """Runs the command; every error that a user can mend is one line and exit code 2."""
    try:
        app()
    except ReplayError as error:
        _fail(str(error))
    except KeyboardInterrupt as interruption:
        signum: int = interruption.signum if isinstance(interruption, Interrupted) else signal.SIGINT
        raise SystemExit(128 + signum) from None
    except BrokenPipeError:  # the reader of our output has gone: nothing more to say, and nobody to say it to
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(EXIT_ERROR) from None


def _remaps(options: list[str] | None) -> dict[str, str]:
    """Reads NAME:=NAME options."""
    remaps = {}
    for option in options or ():
        default, separator, name = option.partition(":=")
        if not separator or not default or not name:
            _fail(f"--topic wants NAME:=NAME, for example /vn100/odometry:=/odom; got {option!r}")
        remaps[default] = name
    return remaps


def _settings(path: Path | None) -> ReplaySettings:
    """Reads settings from a JSON file; what it leaves out keeps its default."""
    if path is None:
        return ReplaySettings()
    try:
        return ReplaySettings.model_validate_json(path.read_bytes())
    except OSError as error:
        _fail(f"{path} cannot be read: {error.strerror or error}")
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        _fail(f"{path} does not hold replay settings: {where}: {first['msg']}")


def _progress() -> Progress:
    """Returns a progress bar for a terminal; in a pipe it says nothing."""
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    return Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal)


def _console(minimum_width: int) -> Console:
    """Returns standard output; in a pipe, and in a narrow terminal, tables keep their columns whole."""
    console = Console()
    console.width = max(console.width, minimum_width)
    return console


def _write_json(path: Path, value: object) -> None:
    try:
        path.write_text(json.dumps(value, indent=2) + "\n")
    except OSError as error:
        _fail(f"{path} cannot be written: {error.strerror or error}")


def _exit_code(done: Summary) -> int:
    if done.stopped is not None:
        return 128 + done.stopped.signum if isinstance(done.stopped, Interrupted) else EXIT_ERROR
    return 0 if done.clean else EXIT_REFUSED


def _fail(problem: str) -> NoReturn:
    errors.print(f"pcgan: {problem}", markup=False)
    raise SystemExit(EXIT_ERROR)


if __name__ == "__main__":
    main()
