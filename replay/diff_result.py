"""What a comparison of two logs found: plain numbers and words, which can be sent to another process."""

from dataclasses import asdict, dataclass, field
from enum import StrEnum

from pydantic import BaseModel, ConfigDict, Field

from replay.errors import one_line
from schemas.topics import PREDICTIONS, TRACKS, VEHICLE_POSE

# Of differences at one time, what causes the others is told first: a track that moved has other predictions.
FIRST_TOLD = {topic.name: rank for rank, topic in enumerate((TRACKS, VEHICLE_POSE, PREDICTIONS))}


class Tolerances(BaseModel):
    """What counts as the same.

    Words, whole numbers and flags are the same if they are equal, NaN is the same as NaN. With a `share`, a topic is
    still the same if at most that share of its values lies outside, and at most that share of its messages is in one
    log alone, and likewise of the tracks in them, of their paths, and of each other kind of item.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    topics: tuple[str, ...] | None = Field(
        default=None, description="shell-style patterns; None: every topic of either log"
    )
    atol: float = Field(default=1e-4, ge=0, description="numbers a, b are the same if |a - b| <= atol + rtol |a|")
    rtol: float = Field(default=1e-6, ge=0, description="see atol; a is the first log's, or the reference's")
    ignore: tuple[str, ...] = Field(default=(), description="fields, and all in them, by their dotted names")
    share: float = Field(default=0, ge=0, le=1, description="of a topic's values that may lie outside")


class Kind(StrEnum):
    """How two logs differ at a place."""

    TOPIC = "topic"  # only one log has it, or with another schema
    COUNT = "count"  # another number of messages
    STAMP = "stamp"  # a message at another time, or in one log alone
    ITEM = "item"  # a track, a prediction, a path, that one message has alone
    VALUE = "value"


@dataclass(frozen=True)
class Difference:
    """One difference; `str` says it in a line."""

    kind: Kind
    topic: str
    at_s: float  # log time after the first message of log A
    log_time_ns: int
    where: str  # in words, what the value is included: "track 7, path 1 step 3"; empty: the message
    field: str  # dotted name, "predictions.paths.x"; empty: the message
    a: str  # as text, "4.812"; empty: not there
    b: str
    size: float | None = None  # |a - b| of numbers
    atol: float = 0.0  # of values that have a tolerance

    def __str__(self) -> str:
        """Returns "/pcgan/predictions at 12.400 s, track 7, path 1 step 3: 4.812 vs 4.870 (atol 0.0001)"."""
        return one_line(self._in_words())

    def _in_words(self) -> str:
        place = f"{self.topic} at {self.at_s:.3f} s"
        match self.kind:
            case Kind.TOPIC:
                return f"{self.topic}: {self.a or 'no messages'} vs {self.b or 'no messages'}"
            case Kind.COUNT:
                return f"{place}: {self.where} ({self.a} vs {self.b} messages)"
            case Kind.STAMP:
                return f"{place}: {self.where}"
        place += f", {self.where}" if self.where else ""
        if self.kind is Kind.ITEM and not (self.a and self.b):
            return f"{place}: only in the {'first' if self.a else 'second'} log"
        tolerance = f" (atol {self.atol:g})" if self.atol else ""
        return f"{place}: {self.a or 'nothing'} vs {self.b or 'nothing'}{tolerance}"


@dataclass(frozen=True)
class FieldDifferences:
    """How the values of a field differ."""

    field: str
    values: int  # compared
    different: int  # beyond the tolerance
    largest: float | None = None  # of |a - b|; None of words
    p50: float | None = None  # of those that are different
    p99: float | None = None
    first_at_s: float = 0.0  # as of `Difference`


@dataclass(frozen=True)
class TopicDiff:
    """One topic of two logs compared."""

    topic: str
    messages: tuple[int, int]  # in A, in B
    identical: bool  # the same bytes at the same times
    same: bool  # within the tolerances
    first: Difference | None = None
    fields: tuple[FieldDifferences, ...] = ()  # those with differences, most first
    stamps: int = 0  # messages that only one of the two has
    items: int = 0  # tracks, predictions and paths that only one of two messages has
    within: float = 0.0  # largest difference that the tolerances cover
    values: int = 0  # compared: those of messages whose bytes differ; with a share, of all
    different: int = 0  # of these, beyond the tolerance
    largest: float | None = None  # of |a - b| over all fields, whatever their units
    p50: float | None = None  # of those that are different
    p99: float | None = None
    when: tuple[int, ...] = ()  # messages that differ in each of so many equal parts of the time both logs take


@dataclass(frozen=True)
class LogDiff:
    """Two logs compared."""

    topics: tuple[TopicDiff, ...]
    renumbered: dict[str, str] = field(default_factory=dict)  # track of A -> track of B, where they differ
    left_out: tuple[str, ...] = ()  # fields that follow from a track's number, where those differ
    span_s: float = 0.0  # from the first message of either log to the last
    losses: tuple[str, ...] = ()  # what could not be read of damaged files
    notes: tuple[str, ...] = ()  # why the comparison may not be the one that was meant

    @property
    def same(self) -> bool:
        """True if every topic is the same within the tolerances."""
        return all(topic.same for topic in self.topics)

    @property
    def identical(self) -> bool:
        """True if every topic has the same bytes at the same times."""
        return all(topic.identical for topic in self.topics)

    @property
    def first(self) -> Difference | None:
        """The earliest difference of all topics; of those that are not the same, if there are any."""
        return next(iter(self.firsts), None)

    @property
    def firsts(self) -> tuple[Difference, ...]:
        """The first difference of each topic, in order of time; those of topics that are still the same come last.

        At one time tracks come before predictions, which are made of them, and others by name.
        """
        found = [(topic.same, topic.first) for topic in self.topics if topic.first is not None]
        return tuple(first for _, first in sorted(found, key=lambda each: (each[0], *_order(each[1]))))

    def as_json(self) -> dict[str, object]:
        """Returns everything under the names that users rely on."""
        return {"same": self.same, "identical": self.identical, **asdict(self)}


def _order(difference: Difference) -> tuple[int, int, str]:
    return difference.log_time_ns, FIRST_TOLD.get(difference.topic, len(FIRST_TOLD)), difference.topic
