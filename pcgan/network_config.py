"""What the configurations of all networks have in common: their checks, and how they come back from a checkpoint."""

import math
from dataclasses import asdict
from typing import Any, TypeVar

Config = TypeVar("Config")


def check_sizes(config: Any) -> None:
    """Raises ValueError unless all whole numbers are positive, there is a displacement to see, and dt_s is a time."""
    values = asdict(config)
    if small := {name: value for name, value in values.items() if type(value) is int and value < 1}:
        raise ValueError(f"sizes must be positive, got {small}")
    if values["observed_steps"] < 2:
        raise ValueError(f"observed_steps must be at least 2 for a displacement, got {values['observed_steps']}")
    if not (math.isfinite(values["dt_s"]) and values["dt_s"] > 0):
        raise ValueError(f"dt_s must be positive, got {values['dt_s']}")


def config_from_dict(kind: type[Config], values: dict[str, Any], name: str) -> Config:
    """Builds a config from `asdict`'s result; raises ValueError naming unknown, missing or mistyped fields."""
    wanted = asdict(kind())  # type: ignore[call-overload]
    if unknown := sorted(values.keys() ^ wanted.keys()):
        raise ValueError(f"{name} configuration differs in the fields {unknown}")
    for field, default in wanted.items():
        if type(values[field]) is not type(default):
            raise ValueError(f"{name} configuration {field} is {values[field]!r}, not a {type(default).__name__}")
    return kind(**values)
