"""Two messages compared value by value: rows are paired by key or order, numbers by tolerance, all with numpy."""

from collections.abc import Hashable, Sequence
from functools import partial
from itertools import accumulate
from typing import Any

import numpy as np

from replay.diff_result import Difference, Kind
from replay.diff_tally import TopicTally
from replay.diff_values import Level
from replay.diff_words import numbers_in_words, others_in_words, place_in_words, value_in_words
from schemas.messages import BoolArray, FloatArray, IntArray

# Of two levels, the rows that belong together; None: each to the same of the other.
Rows = tuple[IntArray, IntArray] | None
# A hair to either side of half a turn is nothing, and far apart as numbers.
_ANGLES = {"vehicle_history.yaw", "vehicle_path.yaw"}
_LARGEST_INT = 2**1000  # JSON has whole numbers of any size, more than a float can hold
_MISSING = object()  # stands for a value that only the other message has


class Comparison:
    """Compares pairs of messages of one topic and tells its tally."""

    def __init__(self, tally: TopicTally, atol: float, rtol: float, *, ours: bool, defaults: bool):
        """Begins without messages.

        Args:
            tally: what is told; it has begun the message that is compared.
            atol: numbers are the same if |a - b| <= atol + rtol |a|.
            rtol: see atol.
            ours: the messages are of `pcgan.v1`.
            defaults: a field that the other definition lacks is the same as one that is not set, as in protobuf.
        """
        self._tally, self._atol, self._rtol, self._ours, self._defaults = tally, atol, rtol, ours, defaults

    def compare(self, a: Level, b: Level) -> None:
        """Compares two messages."""
        self._level(a, b, None)

    def compare_bytes(self, a: bytes, b: bytes) -> None:
        """Compares two messages that cannot be decoded, both of them or one: they are one value each."""
        if a == b:
            self._tally.same_values("", 1)
        else:
            self._tally.other_values(
                "", 1, None, lambda: self._tally.difference(Kind.VALUE, "", "", *others_in_words(a, b))
            )

    # --- levels -----------------------------------------------------------------------------------------------------

    def _level(self, a: Level, b: Level, rows: Rows) -> None:
        """Compares what the rows of a level have that belong together."""
        count = a.rows if rows is None else len(rows[0])
        if count == 0:
            return
        for name in dict.fromkeys([*a.parts, *b.parts]):
            left, right = a.parts.get(name), b.parts.get(name)
            if not isinstance(left, Level) and not isinstance(right, Level):
                self._column(name, a, left, right, rows)
                continue
            like = left if isinstance(left, Level) else right
            assert isinstance(like, Level)
            if not self._defaults and not like.optional and not (isinstance(left, Level) and isinstance(right, Level)):
                self._not_a_list(name, a, like, rows, in_a=like is left)
            if not isinstance(left, Level):
                left = a.empty(name, optional=like.optional, plain=like.plain)
            if not isinstance(right, Level):
                right = b.empty(name, optional=like.optional, plain=like.plain)
            self._below(left, right, rows)

    def _not_a_list(self, name: str, a: Level, listed: Level, rows: Rows, *, in_a: bool) -> None:
        """Tells of a list, perhaps an empty one, that is none in the other message."""
        row = 0 if rows is None else int(rows[0][0])
        text = f"{listed.rows} values"
        where = place_in_words(a, row, name, self._ours)
        texts = (text, "") if in_a else ("", text)
        self._tally.other_values(name, 1, None, lambda: self._tally.difference(Kind.VALUE, where, name, *texts))

    def _below(self, a: Level, b: Level, rows: Rows) -> None:
        """Pairs the rows of two levels under parents that belong together, and compares those."""
        if rows is None and a.counts == b.counts and a.keys == b.keys:
            self._tally.items_seen[a.name] += a.rows
            self._level(a, b, None)
            return
        parents = (np.arange(len(a.counts)), np.arange(len(b.counts))) if rows is None else rows
        pair = _by_order if a.keys is None or b.keys is None else _by_key
        pairs, lone_a, lone_b = pair(a, b, parents)
        self._tally.items_seen[a.name] += len(pairs[0]) + len(lone_a) + len(lone_b)
        for lone, level, in_a in ((lone_a, a, True), (lone_b, b, False)):
            if len(lone):
                self._lone(level, lone, in_a, a, b, parents)
        self._level(a, b, pairs)

    def _lone(
        self, level: Level, lone: IntArray, in_a: bool, a: Level, b: Level, parents: tuple[IntArray, ...]
    ) -> None:
        """Tells of rows that only one of two messages has."""
        row, name, above = int(lone[0]), level.name, level.above
        assert above is not None
        if level.optional and level.plain:  # a value that may be missing
            [values] = level.parts.values()
            assert isinstance(values, list)

            def value() -> Difference:
                text = value_in_words(values[row])
                where = place_in_words(level, row, name, self._ours)
                return self._tally.difference(Kind.VALUE, where, name, *((text, "") if in_a else ("", text)))

            self._tally.other_values(name, len(lone), None, value)
        elif level.plain:

            def length() -> Difference:
                parent, _ = level.place(row)
                place = int(np.flatnonzero(parents[0 if in_a else 1] == parent)[0])
                lengths = a.counts[int(parents[0][place])], b.counts[int(parents[1][place])]
                where = place_in_words(above, parent, name, self._ours)
                return self._tally.difference(Kind.ITEM, where, name, f"{lengths[0]} values", f"{lengths[1]} values")

            self._tally.lone_items(name, len(lone), length)
        else:

            def item() -> Difference:
                where = place_in_words(level, row, name, self._ours)
                return self._tally.difference(Kind.ITEM, where, name, *(("there", "") if in_a else ("", "there")))

            self._tally.lone_items(name, len(lone), item)

    # --- values -----------------------------------------------------------------------------------------------------

    def _column(self, name: str, a: Level, left: list[Any] | None, right: list[Any] | None, rows: Rows) -> None:
        """Compares the values of one name."""
        x = None if left is None else left if rows is None else [left[row] for row in rows[0].tolist()]
        y = None if right is None else right if rows is None else [right[row] for row in rows[1].tolist()]
        x = self._stand_ins(y or []) if x is None else x
        y = self._stand_ins(x) if y is None else y
        if x == y:
            self._tally.same_values(name, len(x))
            return
        types = {*map(type, x), *map(type, y)}
        floats = types <= {float, int} and float in types
        sizes: FloatArray | None = None
        arrays = _as_floats(x, y) if floats else None
        if arrays is not None:
            unlike, apart = self._unlike(name, *arrays)
            sizes = apart[unlike]
            within = apart[~unlike]
            self._tally.same_values(name, len(within), float(np.nanmax(within, initial=0.0)))
        else:
            unlike = np.array([p != q for p, q in zip(x, y, strict=True)], bool)
            if types == {int}:
                apart_by = [min(abs(x[row] - y[row]), _LARGEST_INT) for row in np.flatnonzero(unlike).tolist()]
                sizes = np.array(apart_by, float)
            self._tally.same_values(name, len(x) - int(unlike.sum()))
        places = np.flatnonzero(unlike)
        if len(places) == 0:
            return
        row = int(places[0])
        row_a = row if rows is None else int(rows[0][row])
        size = float(sizes[0]) if sizes is not None and np.isfinite(sizes[0]) else None
        first = partial(self._first_value, name, a, row_a, x[row], y[row], size, arrays is not None)
        self._tally.other_values(name, len(places), sizes, first)

    def _first_value(
        self, name: str, level: Level, row: int, a: Any, b: Any, size: float | None, tolerated: bool
    ) -> Difference:
        where, atol = place_in_words(level, row, name, self._ours), 0.0
        if a is _MISSING or b is _MISSING:
            texts = "" if a is _MISSING else value_in_words(a), "" if b is _MISSING else value_in_words(b)
        elif tolerated:
            texts, atol = numbers_in_words(float(a), float(b)), self._atol
        else:
            texts = others_in_words(a, b)
        return self._tally.difference(Kind.VALUE, where, name, *texts, size, atol)

    def _stand_ins(self, others: Sequence[Any]) -> list[Any]:
        """Returns what stands for the values of a field that one of the definitions does not have."""
        return [type(other)() for other in others] if self._defaults else [_MISSING] * len(others)

    def _unlike(self, name: str, a: FloatArray, b: FloatArray) -> tuple[BoolArray, FloatArray]:
        """Returns which numbers differ beyond the tolerance, and how far apart all are."""
        with np.errstate(invalid="ignore", over="ignore"):  # infinities, and numbers that are nearly so
            apart = np.abs(a - b)
            if self._ours and name in _ANGLES:
                apart = np.minimum(apart, np.abs(2 * np.pi - apart))
            near = np.isfinite(apart) & (apart <= self._atol + self._rtol * np.abs(a))
        same = near | (a == b) | (np.isnan(a) & np.isnan(b))
        return ~same, apart


def _as_floats(x: Sequence[Any], y: Sequence[Any]) -> tuple[FloatArray, FloatArray] | None:
    try:
        return np.array(x, float), np.array(y, float)
    except OverflowError:
        return None


Pairs = tuple[tuple[IntArray, IntArray], IntArray, IntArray]  # rows that belong together, those of A alone, of B alone


def _by_order(a: Level, b: Level, parents: tuple[IntArray, IntArray]) -> Pairs:
    """Pairs the first row under a parent with the first, and so on."""
    starts, counts = [], []
    for level, rows in zip((a, b), parents, strict=True):
        all_counts = np.array(level.counts, np.int64)
        starts.append((np.cumsum(all_counts) - all_counts)[rows])
        counts.append(all_counts[rows])
    both = np.minimum(*counts)
    none = np.zeros(len(both), np.int64)
    pairs = _ranges(starts[0], none, both), _ranges(starts[1], none, both)
    return pairs, _ranges(starts[0], both, counts[0]), _ranges(starts[1], both, counts[1])


def _ranges(starts: IntArray, low: IntArray, high: IntArray) -> IntArray:
    """Returns starts + low ... starts + high - 1 of every row, one behind the other."""
    lengths = high - low
    begins = np.cumsum(lengths) - lengths
    return np.repeat(starts + low - begins, lengths) + np.arange(int(lengths.sum()))


def _by_key(a: Level, b: Level, parents: tuple[IntArray, IntArray]) -> Pairs:
    """Pairs rows of one key under parents that belong together."""
    assert a.keys is not None
    assert b.keys is not None
    ends_a, ends_b = list(accumulate(a.counts)), list(accumulate(b.counts))
    pairs: list[tuple[int, int]] = []
    lone_a: list[int] = []
    lone_b: list[int] = []
    for i, j in zip(parents[0].tolist(), parents[1].tolist(), strict=True):
        rows_b: dict[Hashable, int] = {b.keys[row]: row for row in range(ends_b[j] - b.counts[j], ends_b[j])}
        for row in range(ends_a[i] - a.counts[i], ends_a[i]):
            found = rows_b.pop(a.keys[row], None)
            if found is None:
                lone_a.append(row)
            else:
                pairs.append((row, found))
        lone_b += rows_b.values()
    table = np.array(pairs, np.int64).reshape(-1, 2)
    return (table[:, 0], table[:, 1]), np.array(lone_a, np.int64), np.array(lone_b, np.int64)
