"""What every command shares: options, one-line errors, exit codes, consoles, the progress bar, files on the side."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from replay.interrupts import Interrupted, Interrupts
from replay.session import Replay, ReplaySettings
from replay.time_sync import SyncSettings

errors = Console(stderr=True, highlight=False, soft_wrap=True)

EXIT_ERROR = 2  # a mistake that the user can mend: one line says which
EXIT_REFUSED = 3  # the run went through, but messages were refused or a damaged file lost some
DRIVES = "Drives"  # a panel of the help

# options that several commands have
Log = Annotated[list[Path], typer.Argument(metavar="LOG.mcap", help="The recording, in one file or several.")]
Remaps = Annotated[
    list[str] | None,
    typer.Option("--topic", metavar="NAME:=NAME", help="Read a topic under another name, e.g. /vn100/odometry:=/odom."),
]
Start = Annotated[float, typer.Option(min=0, metavar="S", help="Begin this many seconds into the log.")]
Duration = Annotated[
    float | None, typer.Option(min=0.001, metavar="S", help="Stop after this many seconds. [default: all]")
]
Strict = Annotated[bool, typer.Option("--strict", metavar="", help="Stop at the first message that is refused.")]
Salvage = Annotated[bool, typer.Option("--salvage", metavar="", help="Read every intact chunk of a damaged file.")]
TimeOffsets = Annotated[
    list[str] | None,
    typer.Option(
        "--time-offset", metavar="NAME:=MS", help="Add ms to a topic's stamps, e.g. /gmsl/A1/detections:=-80."
    ),
]
SettingsFile = Annotated[
    Path | None,
    typer.Option("--settings", metavar="FILE", help="Settings as JSON, such as an output's settings.json."),
]


def fail(problem: str) -> NoReturn:
    """Ends the command with one line about what went wrong."""
    errors.print(f"pcgan: {problem}", markup=False)
    raise SystemExit(EXIT_ERROR)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Ends the command at once on Ctrl-C and SIGTERM; exit code 130 or 143, where typer would always give 130."""
    try:
        with Interrupts():
            yield
    except Interrupted as interruption:
        raise typer.Exit(128 + interruption.signum) from None


def progress() -> Progress:
    """Returns a progress bar for a terminal; in a pipe it says nothing."""
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    return Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal)


def console(minimum_width: int) -> Console:
    """Returns standard output; in a pipe, and in a narrow terminal, tables keep their columns whole."""
    wide = Console()
    wide.width = max(wide.width, minimum_width)
    return wide


def refuse_unwritable(*paths: Path | None) -> None:
    """Ends the command if a file could not be written: now, not after an hour of work."""
    for path in paths:
        if path is not None and (not path.parent.is_dir() or path.is_dir()):
            fail(f"{path} cannot be written: {path.parent} is no folder, or {path.name} is one")


def write_json(path: Path, value: object, *, indent: int | None = 2) -> None:
    """Writes a value as JSON, or ends the command."""
    try:
        path.write_text(json.dumps(value, indent=indent) + "\n")
    except OSError as error:
        fail(f"{path} cannot be written: {error.strerror or error}")


def refused_figures(run: Replay) -> dict[str, object]:
    """Returns what was refused and lost under the names of every `--json`."""
    refused = run.refusals
    return {"refused": refused.total, "refusals": refused.as_json(), "salvage_losses": run.reader.losses.notes}


def closing_lines(run: Replay, written: Sequence[Path], out: Console) -> int:
    """Says what was refused, lost and written; returns the exit code."""
    refused, losses = run.refusals, run.reader.losses.notes
    for line in refused.first[:5] + losses[:5]:
        out.print(line, markup=False)
    if refused.total:
        were = "message was" if refused.total == 1 else "messages were"
        out.print(f"[yellow]{refused.total} {were} refused[/]; --json lists them by topic and reason")
    if losses:
        out.print("[yellow]the file is damaged[/]; every intact chunk was used")
    for path in written:
        out.print(f"wrote {path}", markup=False, highlight=False)
    return EXIT_REFUSED if refused.total or losses else 0


def remaps(options: list[str] | None) -> dict[str, str]:
    """Reads NAME:=NAME options."""
    names = {}
    for option in options or ():
        default, separator, name = option.partition(":=")
        if not separator or not default or not name:
            fail(f"--topic wants NAME:=NAME, for example /vn100/odometry:=/odom; got {option!r}")
        names[default] = name
    return names


def with_time_offsets(settings: ReplaySettings, options: list[str] | None) -> ReplaySettings:
    """Returns the settings with NAME:=MS options in them, which go before those of the same name there."""
    offsets_ms = dict(settings.sync.time_offset_ms)
    for option in options or ():
        name, _, offset_ms = option.partition(":=")
        try:
            offsets_ms[name] = float(offset_ms)
            sync = SyncSettings(**{**settings.sync.model_dump(), "time_offset_ms": offsets_ms})
        except ValueError:  # pydantic's, too
            fail(
                "--time-offset wants NAME:=MS, at most 10 s either way, for example /gmsl/A1/detections:=-80; "
                f"got {option!r}"
            )
        settings = settings.model_copy(update={"sync": sync})
    return settings


def read_settings(path: Path | None) -> ReplaySettings:
    """Reads settings from a JSON file; what it leaves out keeps its default."""
    if path is None:
        return ReplaySettings()
    try:
        return ReplaySettings.model_validate_json(path.read_bytes())
    except OSError as error:
        fail(f"{path} cannot be read: {error.strerror or error}")
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        fail(f"{path} does not hold replay settings: {where}: {first['msg']}")
