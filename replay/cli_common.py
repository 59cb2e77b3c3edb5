"""What every command shares: one-line errors, exit codes, consoles, the progress bar, files written on the side."""

import json
from pathlib import Path
from typing import NoReturn

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

errors = Console(stderr=True, highlight=False, soft_wrap=True)

EXIT_ERROR = 2  # a mistake that the user can mend: one line says which


def fail(problem: str) -> NoReturn:
    """Ends the command with one line about what went wrong."""
    errors.print(f"pcgan: {problem}", markup=False)
    raise SystemExit(EXIT_ERROR)


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


def write_json(path: Path, value: object) -> None:
    """Writes a value as JSON, or ends the command."""
    try:
        path.write_text(json.dumps(value, indent=2) + "\n")
    except OSError as error:
        fail(f"{path} cannot be written: {error.strerror or error}")
