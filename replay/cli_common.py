"""What every command shares: options, one-line errors, exit codes, consoles, the progress bar, files on the side."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from replay.class_labels import unmatched_line
from replay.errors import refused_line
from replay.interrupts import Interrupted, Interrupts
from replay.part_file import write_whole
from replay.roles import SCANS
from replay.session import Replay, ReplaySettings
from replay.settings_file import read_profile
from replay.time_sync import SyncSettings

errors = Console(stderr=True, highlight=False, soft_wrap=True)

EXIT_ERROR = 2  # a mistake that the user can mend: one line says which
EXIT_REFUSED = 3  # the run went through, but messages were refused or a damaged file lost some
DRIVES, REGRESSION, LIVE = "Drives", "Regression", "Live"  # panels of the help

# options that several commands have
Log = Annotated[list[Path], typer.Argument(metavar="LOG.mcap", help="The recording, in one file or several.")]
RoleOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--role", metavar="ROLE:=TOPIC", help="Give a topic a role, e.g. pose:=/odom; pcgan info tells which."
    ),
]
Tracks = Annotated[
    str | None,
    typer.Option(metavar="TOPIC", help="Take another tracker's tracks instead of ours; same as --role tracks:=TOPIC."),
]
Start = Annotated[
    float | None, typer.Option(min=0, max=1e9, metavar="S", help="Begin this many seconds into the log. [default: 0]")
]
Duration = Annotated[
    float | None, typer.Option(min=0.001, max=1e9, metavar="S", help="Stop after this many seconds. [default: all]")
]
PedestrianLabels = Annotated[
    list[str] | None,
    typer.Option(
        "--pedestrian-label", metavar="NAME", help="Class name or id that means a pedestrian; replaces the usual names."
    ),
]
Strict = Annotated[bool, typer.Option("--strict", metavar="", help="Stop at the first message that is refused.")]
Salvage = Annotated[bool, typer.Option("--salvage", metavar="", help="Read every intact chunk of a damaged file.")]
TimeOffsets = Annotated[
    list[str] | None,
    typer.Option(
        "--time-offset", metavar="NAME:=MS", help="Add ms to a topic's stamps, e.g. /gmsl/A1/detections:=-80."
    ),
]
ProfileFile = Annotated[
    Path | None,
    typer.Option(
        "--profile", metavar="FILE", help="Roles and settings in YAML, TOML or JSON, e.g. an output's settings.json."
    ),
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
    """Writes a value as JSON: a whole file or, with an OutputError, none."""
    write_whole(path, (json.dumps(value, indent=indent) + "\n").encode())


def refused_figures(run: Replay) -> dict[str, object]:
    """Returns what was refused and lost under the names of every `--json`."""
    refused = run.refusals
    return {"refused": refused.total, "refusals": refused.as_json(), "salvage_losses": run.reader.losses.notes}


def note_missing(run: Replay) -> None:
    """Says what would make the result better and is not in the log."""
    for name in run.roles.missing:
        errors.print(f"note: the log has no {name}", markup=False)


def closing_lines(run: Replay, written: Sequence[Path], out: Console) -> int:
    """Says what was refused, lost and written; returns the exit code."""
    refused, losses = run.refusals, run.reader.losses.notes
    for line in refused.first[:5] + losses[:5]:
        out.print(line, markup=False)
    if refused.total:
        out.print(refused_line(refused.total))
    if run.labels.unmatched:
        out.print(f"[yellow]{escape(unmatched_line(run.labels.unmatched))}[/]")
    if losses:
        out.print("[yellow]the file is damaged[/]; every intact chunk was used")
    for path in written:
        out.print(f"wrote {path}", markup=False, highlight=False)
    return EXIT_REFUSED if refused.total or losses else 0


def settings_of(
    profile: Path | None,
    *,
    start: float | None = None,
    duration: float | None = None,
    roles: list[str] | None = None,
    tracks: str | None = None,
    time_offsets: list[str] | None = None,
    pedestrian_labels: list[str] | None = None,
) -> ReplaySettings:
    """Returns the settings of a run: the profile's, with options in their place."""
    settings = read_profile(profile)
    given = {"start_s": start, "duration_s": duration}
    settings = settings.model_copy(update={name: value for name, value in given.items() if value is not None})
    settings = _with_time_offsets(_with_roles(settings, roles, tracks), time_offsets)
    if not pedestrian_labels:
        return settings
    fusion = settings.tracking.fusion.model_copy(update={"pedestrian_labels": tuple(pedestrian_labels)})
    tracking = settings.tracking.model_copy(update={"fusion": fusion})
    return settings.model_copy(update={"tracking": tracking})


def _with_roles(settings: ReplaySettings, options: list[str] | None, tracks: str | None) -> ReplaySettings:
    """Puts ROLE:=TOPIC options into the settings."""
    roles = settings.roles
    if any(option.partition(":=")[0].partition(".")[0] == "camera" for option in options or ()):
        roles = roles.model_copy(update={"cameras": None})  # cameras named here are all there are
    for option in [*(options or ()), *([f"tracks:={tracks}"] if tracks is not None else [])]:
        role, separator, topic = option.partition(":=")
        if not separator or not role or not topic:
            fail(f"--role wants ROLE:=TOPIC, for example pose:=/odom; got {option!r}")
        if role in SCANS:
            roles = roles.model_copy(update=dict.fromkeys(SCANS))
        roles = roles.with_role(role, topic)
    return settings.model_copy(update={"roles": roles})


def _with_time_offsets(settings: ReplaySettings, options: list[str] | None) -> ReplaySettings:
    """Puts NAME:=MS options into the settings, where they go before those of the same name there."""
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
