"""What the comparison of one topic adds up to, in memory that does not grow with the log."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from replay.diff_result import Difference, FieldDifferences, Kind, TopicDiff
from schemas.messages import FloatArray, IntArray

PER_DECADE = 200  # bins: a percentile is off by at most 0.6 %
_LOWEST, _DECADES = -18, 36  # powers of ten; what is outside counts as the nearest
SPANS = 60  # equal parts of the log in which differing messages are counted


class Sizes:
    """A histogram of positive numbers with logarithmic bins."""

    def __init__(self) -> None:
        self.bins: IntArray = np.zeros(PER_DECADE * _DECADES, np.int64)
        self.smallest, self.largest = np.inf, 0.0

    def add(self, sizes: FloatArray) -> None:
        """Takes sizes (N,); those that are not finite have no place here."""
        sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
        if len(sizes):
            places = np.floor((np.log10(sizes) - _LOWEST) * PER_DECADE).clip(0, len(self.bins) - 1).astype(np.int64)
            self.bins += np.bincount(places, minlength=len(self.bins))
            self.smallest = min(self.smallest, float(sizes.min()))
            self.largest = max(self.largest, float(sizes.max()))

    def merge(self, other: "Sizes") -> None:
        """Takes all of another histogram's."""
        self.bins += other.bins
        self.smallest, self.largest = min(self.smallest, other.smallest), max(self.largest, other.largest)

    def percentile(self, percent: float) -> float | None:
        """Returns the size that so many percent are not larger than; None if there are none."""
        total = int(self.bins.sum())
        if total == 0:
            return None
        rank = max(1, int(np.ceil(total * percent / 100)))
        place = int(np.searchsorted(np.cumsum(self.bins), rank))
        middle = 10 ** ((place + 0.5) / PER_DECADE + _LOWEST)
        return float(np.clip(middle, self.smallest, self.largest))


@dataclass
class FieldTally:
    """The values of one field so far."""

    values: int = 0
    different: int = 0
    sizes: Sizes | None = None  # of numbers
    first_at_s: float = 0.0  # of those that are different

    def result(self, name: str) -> FieldDifferences:
        """Returns the figures under the field's name."""
        sizes = self.sizes if self.sizes is not None and self.sizes.largest > 0 else None
        return FieldDifferences(
            name,
            self.values,
            self.different,
            sizes.largest if sizes else None,
            sizes.percentile(50) if sizes else None,
            sizes.percentile(99) if sizes else None,
            self.first_at_s,
        )


@dataclass
class TopicTally:
    """The messages of one topic so far; everything is told in order of time."""

    topic: str
    messages: tuple[int, int] = (0, 0)
    first: Difference | None = None
    identical: bool = True
    unlike: bool = False  # there is a difference that no share excuses
    stamps: int = 0
    items: Counter[str] = field(default_factory=Counter)  # of one message alone, by the level's name
    items_seen: Counter[str] = field(default_factory=Counter)
    within: float = 0.0
    fields: dict[str, FieldTally] = field(default_factory=dict)
    when: list[int] = field(default_factory=lambda: [0] * SPANS)
    _at_s: float = 0.0  # of the present message, as of `Difference`
    _log_time_ns: int = 0
    _differs: bool = False

    def begin(self, at_s: float, log_time_ns: int) -> None:
        """Begins the next message, logged at a time as of `Difference`."""
        self._at_s, self._log_time_ns, self._differs = at_s, log_time_ns, False

    def difference(
        self, kind: Kind, where: str, name: str, a: str, b: str, size: float | None = None, atol: float = 0.0
    ) -> Difference:
        """Returns a difference at a place of the present message, all else as of `Difference`."""
        return Difference(kind, self.topic, self._at_s, self._log_time_ns, where, name, a, b, size, atol)

    def end(self, span: int) -> None:
        """Ends a message in the given part of the log."""
        if self._differs:
            self.when[span] += 1

    def lone_message(self, difference: Callable[[], Difference]) -> None:
        """Counts a message that only one log has."""
        self.stamps += 1
        self.identical = False
        self._note(difference)

    def lone_items(self, name: str, count: int, difference: Callable[[], Difference]) -> None:
        """Counts items of a level that only one of two messages has."""
        self.items[name] += count
        self._note(difference)

    def same_values(self, name: str, count: int, within: float = 0.0) -> None:
        """Counts values that are the same within the tolerances, and how far apart they are at most."""
        self.fields.setdefault(name, FieldTally()).values += count
        self.within = max(self.within, within)

    def other_values(
        self, name: str, count: int, sizes: FloatArray | None, difference: Callable[[], Difference]
    ) -> None:
        """Counts values that differ; `sizes` (N,) of numbers say by how much."""
        tally = self.fields.setdefault(name, FieldTally())
        if tally.different == 0:
            tally.first_at_s = self._at_s
        tally.values += count
        tally.different += count
        if sizes is not None:
            tally.sizes = tally.sizes or Sizes()
            tally.sizes.add(sizes)
        self._note(difference)

    def unlike_topic(self, difference: Difference) -> None:
        """Notes that only one log has the topic, or that its messages are of another type in each."""
        self.unlike, self.identical = True, False
        self.first = difference

    def _note(self, difference: Callable[[], Difference]) -> None:
        self._differs = True
        if self.first is None:
            self.first = difference()

    def result(self, share: float) -> TopicDiff:
        """Returns the topic's figures; at most `share` of values, of messages and of each kind of item may differ.

        Each kind for itself: a track has so many steps and states that a few lost ones would vanish among them.
        """
        found = [tally.result(name) for name, tally in self.fields.items() if tally.different]
        values = sum(tally.values for tally in self.fields.values())
        different = sum(each.different for each in found)
        sizes = Sizes()
        for tally in self.fields.values():
            if tally.sizes is not None:
                sizes.merge(tally.sizes)
        same = (
            not self.unlike
            and different <= share * values
            and self.stamps <= share * max(self.messages)
            and all(count <= share * self.items_seen[name] for name, count in self.items.items())
        )
        return TopicDiff(
            self.topic,
            self.messages,
            identical=self.identical,
            same=same,
            first=self.first,
            fields=tuple(sorted(found, key=lambda each: -each.different)),
            stamps=self.stamps,
            items=self.items.total(),
            within=self.within,
            values=values,
            different=different,
            largest=sizes.largest if sizes.largest > 0 else None,
            p50=sizes.percentile(50),
            p99=sizes.percentile(99),
            when=tuple(self.when),
        )
