"""Profiles, suites and such: names and values in YAML, TOML or JSON, held against a model of what they may say."""

import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError

from replay.errors import ReplayError
from replay.expectations import near
from replay.session import ReplaySettings

M = TypeVar("M", bound=BaseModel)
Loc = tuple[int | str, ...]


class SettingsError(ReplayError):
    """A file, or what stands in for one, that cannot be used; the text names it and the place in it."""


def read_profile(path: Path | None) -> ReplaySettings:
    """Reads roles and settings from a file; what it leaves out keeps its default. Raises SettingsError."""
    return ReplaySettings() if path is None else validated(ReplaySettings, read_plain(path), path)


def read_plain(path: Path) -> dict[str, Any]:
    """Returns what a YAML, TOML or JSON file holds; raises SettingsError."""
    kinds = {".yaml": "YAML", ".yml": "YAML", ".toml": "TOML", ".json": "JSON"}
    kind = kinds.get(path.suffix.lower())
    if kind is None:
        raise SettingsError(f"{path} must end in .yaml, .yml, .toml or .json, so that it is known how to read it")
    try:
        text = path.read_text(encoding="utf-8")
        plain = _yaml(text) if kind == "YAML" else tomllib.loads(text) if kind == "TOML" else json.loads(text)
    except OSError as error:
        raise SettingsError(f"{path} cannot be read: {error.strerror or error}") from error
    except ValueError as error:  # of UTF-8 and of all three parsers
        raise SettingsError(f"{path} is not {kind}: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise SettingsError(f"{path} cannot be read: its brackets are nested too deeply") from error
    if not isinstance(plain, dict):
        found = "nothing" if plain is None else f"a {type(plain).__name__}"
        raise SettingsError(f"{path} must hold names and values at its top, and holds {found}")
    return plain


def _yaml(text: str) -> object:
    """Parses YAML 1.2; raises ValueError saying where it is wrong."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    try:
        return YAML(typ="safe", pure=True).load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark is not None else ""
        raise ValueError(f"{where}{(error.problem or str(error)).splitlines()[0]}") from error
    except YAMLError as error:
        raise ValueError(str(error)) from error


def validated(model: type[M], plain: Mapping[str, Any], source: Path | str, place: Loc = ()) -> M:
    """Returns what names and values come to; raises SettingsError with the source and the place of what is wrong."""
    try:
        return model.model_validate(plain)
    except ValidationError as error:
        # a typo rather than what it hides
        first = min(error.errors(), key=lambda each: each["type"] != "extra_forbidden")
        problem = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            *above, name = first["loc"]
            known = _names_at(model, above)
            problem = f"there is nothing of this name{'; ' + near(str(name), known) if known else ''}"
        where = place_in((*place, *first["loc"]))
        raise SettingsError(f"{source}: {f'{where}: ' if where else ''}{problem}") from error


def place_in(loc: Loc) -> str:
    """Returns a place as people write it: logs[1].settings.start_s."""
    parts = [part for part in loc if part != "[key]"]  # pydantic's: the name itself is wrong
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in parts).removeprefix(".")


def _names_at(model: type[BaseModel], loc: Sequence[int | str]) -> list[str]:
    """Returns the names that a model knows at a place inside it."""
    kind: Any = model
    for part in loc:
        if get_origin(kind) in (tuple, dict):  # the part is an index, or a key
            kind = _model_in(kind)
            continue
        field = kind.model_fields.get(str(part)) if (kind := _model_in(kind)) is not None else None
        kind = field.annotation if field is not None else None
    found = _model_in(kind)
    return [] if found is None else list(found.model_fields)


def _model_in(kind: object) -> type[BaseModel] | None:
    """Returns the model that a type is made of: of tuple[LogEntry, ...] LogEntry."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return kind
    return next((found for part in get_args(kind) if (found := _model_in(part)) is not None), None)
