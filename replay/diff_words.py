"""Places and values of two logs in words: "track 7, path 1 step 3" and "4.812 vs 4.870"."""

import math
from collections.abc import Callable, Hashable
from typing import Any
from uuid import UUID

from replay.diff_values import Level

# What rows of our own messages are called, by the level's name; paths count from 0, steps from 1, as in `pcgan export`.
_ROWS: dict[str, Callable[[Hashable, int], str]] = {
    "tracks": lambda label, _: f"track {label}",
    "predictions": lambda label, _: f"track {label}",
    "predictions.paths": lambda _, index: f"path {index}",
    "predictions.paths.x": lambda _, index: f"step {index + 1}",
    "predictions.paths.y": lambda _, index: f"step {index + 1}",
    "tracks.covariance": lambda _, index: f"covariance row {index // 4} column {index % 4}",
}
_NAMED = {"tracks", "predictions"}  # those that are called by their label
# What values are called where their own names would not say it.
_VALUES = {
    "predictions.paths.x": "",
    "predictions.paths.y": "",
    "tracks.covariance": "",
    **{f"tracks.{name}": f"state {name}" for name in ("x", "y", "vx", "vy")},
}


def place_in_words(level: Level, row: int, name: str, ours: bool) -> str:
    """Returns where a value is: "track 7, state vx", or "objects[3].shape.dimensions.x" of others' messages.

    Args:
        level: what has the value.
        row: of the level.
        name: of the value, dotted; the level's own name: the row itself.
        ours: whether the message is one of `pcgan.v1`.
    """
    words: list[str] = []
    dotted, said = "", 0  # so many letters of the name are said
    for each, index, label in _way(level, row):
        if each.optional:
            continue
        if ours and each.name in _ROWS and (label is not None or each.name not in _NAMED):
            words.append(_ROWS[each.name](label, index))
        elif ours and each.name.startswith("predictions.mixture."):
            words.append(_in_mixture(each, row, index))
        else:
            dotted += f"{each.name[said:]}[{index if label is None else _in_brackets(label)}]"
        said = len(each.name)
    rest = _VALUES[name] if ours and name in _VALUES else (dotted + name[said:]).strip(".")
    words += [rest] if rest else []
    return ", ".join([*words[:1], *([" ".join(words[1:])] if len(words) > 1 else [])])


def _in_brackets(label: Hashable) -> str:
    if isinstance(label, bytes):
        return str(UUID(bytes=label)) if len(label) == 16 else label.hex()
    return str(label)


def _way(level: Level, row: int) -> list[tuple[Level, int, Hashable | None]]:
    """Returns the levels from the top down to a row: each with the row's number under its parent and its label."""
    way: list[tuple[Level, int, Hashable | None]] = []
    at: Level | None = level
    while at is not None and at.above is not None:
        parent, index = at.place(row)
        labels = at.labels or at.keys
        way.append((at, index, labels[row] if labels is not None else None))
        at, row = at.above, parent
    return way[::-1]


def _in_mixture(level: Level, row: int, index: int) -> str:
    name = level.name.rpartition(".")[2]
    assert level.above is not None
    components = level.above.parts.get("predictions.mixture.components")
    parent, _ = level.place(row)
    count = components[parent] if isinstance(components, list) else 0
    place = f"step {index // count + 1} component {index % count}" if count else f"entry {index}"
    return f"mixture {name} {place}"


def numbers_in_words(a: float, b: float) -> tuple[str, str]:
    """Returns two numbers that differ with so many digits that it shows, at least three after the point."""
    size = abs(a - b)
    if math.isfinite(size) and size > 0 and max(abs(a), abs(b)) < 1e9 and size > 1e-9:
        decimals = max(3, math.floor(-math.log10(size)) + 1)
        texts = f"{a:.{decimals}f}", f"{b:.{decimals}f}"
        if texts[0] != texts[1]:
            return texts
    for digits in (6, 9, 12, 17):
        texts = f"{a:.{digits}g}", f"{b:.{digits}g}"
        if texts[0] != texts[1]:
            break
    return texts


def value_in_words(value: Any) -> str:
    """Returns a value as it is shown alone, long ones cut."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, bytes):
        return "1 byte" if len(value) == 1 else f"{len(value)} bytes"
    text = "true" if value is True else "false" if value is False else str(value) or '""'
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def others_in_words(a: Any, b: Any) -> tuple[str, str]:
    """Returns two values that are no numbers and differ; of long ones, the part from where they do."""
    if isinstance(a, bytes) and isinstance(b, bytes):
        place = _first_unlike(a, b)
        return value_in_words(a), f"{value_in_words(b)}, unlike from byte {place} on"
    texts = [value_in_words(value) for value in (a, b)]
    if texts[0] == texts[1]:
        whole = [str(value) for value in (a, b)]
        start = max(0, _first_unlike(*whole) - 10)
        texts = [f"{'…' if start else ''}{text[start : start + _LONGEST - 2]}" for text in whole]
    if texts[0] == texts[1]:
        texts = [f"{text} ({type(value).__name__})" for text, value in zip(texts, (a, b), strict=True)]
    return texts[0], texts[1]


_LONGEST = 60


def _first_unlike(a: Any, b: Any) -> int:
    shorter = min(len(a), len(b))
    return next((place for place in range(shorter) if a[place] != b[place]), shorter)
