"""A suite: the file that says which logs `pcgan check` replays, how, and what has to come out."""

import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from replay.diff_result import Tolerances
from replay.errors import LogError
from replay.expectations import Expectation, parse_expectation
from replay.log_source import LogSource, find_logs, unique_names
from replay.session import ReplaySettings
from replay.settings_file import Loc, SettingsError, place_in, read_plain, read_profile, validated

LONGEST_NAME = 100  # bytes of UTF-8; file systems take 255, of which endings and a variant's name need some

# --- as the file has it ----------------------------------------------------------------------------------------------


def _listed(value: object) -> object:
    return [value] if isinstance(value, str) else value


def _log_entry(value: object) -> object:
    return {"log": value} if isinstance(value, str) else value


def _expectation(value: object) -> object:
    return value if isinstance(value, Expectation) else parse_expectation(value)


def _fit_for_files(name: str) -> str:
    if not re.fullmatch(r"\w[\w .+-]*", name):
        raise ValueError(f"{name!r} cannot be part of a file's name; use letters, digits, spaces and . + - _")
    if len(name.encode()) > LONGEST_NAME:
        raise ValueError(f"{name!r} is too long for the names of files; {LONGEST_NAME} bytes are the most")
    return name


Expected = Annotated[Expectation, BeforeValidator(_expectation)]
Expectations = Annotated[tuple[Expected, ...], BeforeValidator(_listed)]
Name = Annotated[str, AfterValidator(_fit_for_files)]


class LogEntry(BaseModel):
    """One line of `logs`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    log: Annotated[tuple[str, ...], BeforeValidator(_listed)] = Field(
        min_length=1, description="a path, glob, folder or URL: a case for each log it finds; a list: all in one case"
    )
    name: Name | None = Field(default=None, description="None: the file's stem")
    settings: dict[str, Any] = Field(default={}, description="merged over the suite's")
    expect: Expectations = Field(default=(), description="in addition to the suite's")
    together: bool = Field(default=False, description="what `log` finds is one recording, in several files")


class Variant(BaseModel):
    """Something else to try, side by side with the suite's own way."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    settings: dict[str, Any] = Field(default={}, description="merged over each case's")
    model: str | None = Field(default=None, description="None: the suite's")


class SuiteFile(BaseModel):
    """What a suite file says."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    logs: Annotated[tuple[Annotated[LogEntry, BeforeValidator(_log_entry)], ...], BeforeValidator(_listed)] = Field(
        min_length=1, description="a text is a list of one"
    )
    references: str = Field(default="references", pattern=r"^[^\x00]+$", description="the folder of the references")
    profile: str | None = Field(default=None, description="a file as of --profile")
    settings: dict[str, Any] = Field(default={}, description="merged over the profile")
    model: str | None = Field(default=None, description="name or file of the weights. None: the default")
    salvage: bool = Field(default=False, description="read every intact chunk of damaged files")
    tolerances: Tolerances = Tolerances()
    expect: Expectations = Field(default=(), description="of every case")
    sweep: dict[Name, Variant] = Field(default={}, description="by name; run with --sweep")


# --- as it is run ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A recording, in one file or several, and what has to come out of it."""

    name: str  # unique in the suite
    logs: tuple[LogSource, ...]
    shown: tuple[str, ...]  # the logs as a reader of the suite knows them
    settings: ReplaySettings
    expect: tuple[Expectation, ...]
    problem: str = ""  # why there is nothing to replay


@dataclass(frozen=True)
class Suite:
    """A suite with its globs expanded, its settings merged and its paths found."""

    path: Path
    references: Path
    cases: tuple[Case, ...]  # in the file's order
    model: str | None
    salvage: bool
    tolerances: Tolerances
    sweep: Mapping[str, Variant]

    def settings_of(self, case: Case, variant: Variant) -> ReplaySettings:
        """Returns a case's settings with a variant's in their place."""
        return _merged(case.settings, variant.settings, self.path, ("sweep",))


def read_suite(path: Path) -> Suite:
    """Reads a suite from YAML, TOML or JSON (by its ending); relative paths in it begin at its folder.

    A log that is not there is that case's problem, not the suite's. Raises SettingsError for anything else.
    """
    file = validated(SuiteFile, read_plain(path), path)
    settings = _base_settings(file, path)
    for name, variant in file.sweep.items():
        _merged(settings, variant.settings, path, ("sweep", name, "settings"))
    cases = _cases(file, settings, path)
    _tell_apart(cases, file.sweep, path)
    return Suite(
        path,
        path.parent / file.references,
        cases,
        _model(file.model, path),
        file.salvage,
        file.tolerances,
        {
            name: variant.model_copy(update={"model": _model(variant.model, path)})
            for name, variant in file.sweep.items()
        },
    )


def _base_settings(file: SuiteFile, path: Path) -> ReplaySettings:
    settings = ReplaySettings()
    if file.profile is not None:
        settings = read_profile(path.parent / file.profile)
    return _merged(settings, file.settings, path, ("settings",))


def _model(model: str | None, path: Path) -> str | None:
    """Returns the model's file if there is one beside the suite, else the name as it is."""
    if model is None:
        return None
    beside = path.parent / model
    return str(beside) if os.path.isfile(beside) else model  # noqa: PTH113  no error of what no file can be called


def _tell_apart(cases: Sequence[Case], variants: Iterable[str], path: Path) -> None:
    """Raises SettingsError if two files that belong to cases and variants of a sweep would have one name."""
    files: dict[str, str] = {}
    for case in cases:
        for variant in ("", *variants):
            file = f"{case.name}.{variant}" if variant else case.name
            what = f"{case.name}, {variant}" if variant else case.name
            other = files.setdefault(file.casefold(), what)  # some disks ignore case
            if other != what:
                raise SettingsError(f"{path}: the files of {other} and of {what} would have one name; rename one")


def _cases(file: SuiteFile, settings: ReplaySettings, path: Path) -> tuple[Case, ...]:
    """Returns the cases in the file's order; those of one glob sorted."""
    found: list[tuple[LogEntry, tuple[LogSource, ...], ReplaySettings, str]] = []
    for i, entry in enumerate(file.logs):
        own = _merged(settings, entry.settings, path, ("logs", i, "settings"))
        try:
            sources = find_logs(entry.log, path.parent)
        except LogError as error:
            found.append((entry, (), own, str(error)))
            continue
        if entry.together or len(entry.log) > 1:
            found.append((entry, tuple(sources), own, ""))
        elif entry.name is not None and len(sources) > 1:
            raise SettingsError(
                f"{path}: {place_in(('logs', i))}: {entry.log[0]} finds {len(sources)} logs, which cannot all be "
                f"called {entry.name}; leave the name out, or say together: true if they are one recording"
            )
        else:
            found += [(entry, (source,), own, "") for source in sources]
    firsts = [logs[0].url if logs else entry.log[0] for entry, logs, _, _ in found]
    nameless = [first for (entry, *_), first in zip(found, firsts, strict=True) if entry.name is None]
    if twice := [first for first, count in Counter(nameless).items() if count > 1]:
        raise SettingsError(f"{path}: {twice[0]} is among the logs twice; give one of them a name of its own")
    default = dict(zip(nameless, unique_names(nameless), strict=True))
    names = [entry.name or default[first] for (entry, *_), first in zip(found, firsts, strict=True)]
    for name, count in Counter(map(str.casefold, names)).items():  # some disks take them for one
        if count > 1:
            alike = [(first, other) for first, other in zip(firsts, names, strict=True) if other.casefold() == name]
            called = " or ".join(dict.fromkeys(other for _, other in alike))
            which = " and ".join(first for first, _ in alike)
            raise SettingsError(f"{path}: {count} cases are called {called} ({which}); give each a name of its own")
    return tuple(
        Case(
            name,
            logs,
            tuple(_shown(source, path) for source in logs) or entry.log,
            own,
            tuple(dict.fromkeys((*file.expect, *entry.expect))),
            problem,
        )
        for name, (entry, logs, own, problem) in zip(names, found, strict=True)
    )


def _shown(source: LogSource, path: Path) -> str:
    """Returns a log as seen from the suite, wherever the suite lies."""
    if source.path is not None:
        for folder in (path.parent, path.parent.resolve()):
            if source.path.is_relative_to(folder):
                return source.path.relative_to(folder).as_posix()
    return source.url.partition("?")[0]  # behind which is no part of the name but, often, a secret


def _merged(settings: ReplaySettings, changes: Mapping[str, Any], path: Path, place: Loc) -> ReplaySettings:
    """Returns settings with some of them changed; raises SettingsError naming the place of one that cannot be."""
    if not changes:
        return settings
    return validated(ReplaySettings, _over(settings.model_dump(), changes), path, place)


def _over(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Returns nested names and values with `changes` put over `base`, name by name."""
    return {
        **base,
        **{
            name: _over(base[name], value)
            if isinstance(value, Mapping) and isinstance(base.get(name), Mapping)
            else value
            for name, value in changes.items()
        },
    }
