"""What a suite asks of a replay's figures: `hota >= 0.8`, `ground_truth.ade_m <= 0.3`, `no refused messages`."""

import difflib
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields

from replay.check_result import Judged
from replay.record import Summary
from replay.score import Errors, ReplayScore
from tracking.metrics import TrackingScore

STAGES = ("read", "track", "predict", "write", "score")  # of latency_ms
PEOPLE = ("people_seen", "people_tracked", "people_predicted")
_OPERATORS: Mapping[str, Callable[[float, float], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "==": operator.eq,
    "!=": operator.ne,
    ">": operator.gt,
    "<": operator.lt,
}
_COMPARISON = re.compile(r"([a-z][\w.]*)\s*(>=|<=|==|!=|>|<)\s*(\S+)")
_ABSENCE = re.compile(r"no ([a-z][\w. ]*)")


@dataclass(frozen=True)
class Expectation:
    """A figure of a replay's summary and what it has to be."""

    text: str  # as in the suite
    figure: str  # dotted path into the summary: "ground_truth.hota"
    symbol: str
    number: float

    def judge(self, summary: Mapping[str, object]) -> Judged:
        """Returns what came of it; a figure that the replay does not have meets nothing."""
        value = figures(summary).get(self.figure)
        return Judged(self.text, value, value is not None and _OPERATORS[self.symbol](value, self.number))


def parse_expectation(text: object) -> Expectation:
    """Reads `NAME OP NUMBER` or `no NAME`.

    NAME is a dotted path into the summary of `pcgan replay --json`. One without dots that does not stand at its top
    is looked for in its `ground_truth`. A list, such as `salvage_losses`, stands for its length.

    Raises:
        ValueError: the text is neither, or no summary has such a figure.
    """
    words = " ".join(text.split()) if isinstance(text, str) else ""
    if absence := _ABSENCE.fullmatch(words):
        name = absence[1].removesuffix(" messages").replace(" ", "_")
        return Expectation(words, _figure_named(name), "==", 0.0)
    comparison = _COMPARISON.fullmatch(words)
    if comparison is None:
        plain = isinstance(text, str | int | float)  # YAML's aliases make lists that no memory can hold, once written
        got = repr(text) if plain else f"a {type(text).__name__}"
        raise ValueError(f"an expectation reads like 'hota >= 0.8' or 'no refused messages', got {got}")
    name, symbol, number = comparison.groups()
    try:
        value = float(number)
    except ValueError:
        raise ValueError(f"{number!r} in {words!r} is no number") from None
    if not math.isfinite(value):
        raise ValueError(f"{number!r} in {words!r} is no finite number")
    return Expectation(words, _figure_named(name), symbol, value)


def figures(summary: Mapping[str, object]) -> dict[str, float]:
    """Returns all numbers of a summary by their dotted names, a list as its length; what is None has no number."""
    found: dict[str, float] = {}
    for name, value in summary.items():
        if isinstance(value, Mapping):
            found |= {f"{name}.{inner}": number for inner, number in figures(value).items()}
        elif isinstance(value, list | tuple):
            found[name] = len(value)
        elif isinstance(value, int | float):  # bool, too
            found[name] = value
    return found


def known_figures() -> frozenset[str]:
    """Returns the dotted names of all numbers that a summary can have."""
    errors = (*Errors().as_json(), *(f"tracker.{name}" for name in Errors().as_json()), "scored", "scored_share")
    score = [*errors, *PEOPLE, *(field.name for field in fields(TrackingScore))]
    top = {name for name, value in {**Summary().as_json(), **ReplayScore().as_json()}.items() if value != {}}
    return frozenset(
        {
            *(top - {"model", "tracker"}),
            *errors,
            *(f"ground_truth.{name}" for name in score),
            *(f"latency_ms.{stage}.{part}" for stage in STAGES for part in ("p50", "p99")),
        }
    )


def near(name: str, names: Iterable[str]) -> str:
    """Returns the end of an error about a name that does not exist: those it could have been, or all."""
    every = sorted(names)
    likely = difflib.get_close_matches(name, every, n=4, cutoff=0.5)
    return f"did you mean {' or '.join(likely)}?" if likely else f"there are {', '.join(every)}"


def _figure_named(name: str) -> str:
    known = known_figures()
    for figure in (name, f"ground_truth.{name}"):
        if figure in known:
            return figure
    bare = {figure.removeprefix("ground_truth.") for figure in known} | (known if "." in name else set())
    raise ValueError(f"no replay has a figure called {name}; {near(name, bare)}")
