"""What the tracker knows of each label beside its Gaussians: existence, class, whether it is hidden, and its past.

Everything is immutable, so that an earlier state of the tracker can be kept by keeping a reference to it.
"""

from dataclasses import dataclass, fields

import numpy as np

from schemas.messages import BoolArray, FloatArray, IntArray

SCANS_OF_ONE_STAMP = 1 << 20  # spacing of born_index between scans that share a stamp


@dataclass(frozen=True, eq=False)
class Labels:
    """One row per label, oldest first. A label is named by the scan and the measurement it was born at."""

    born_ns: IntArray  # (L,)
    born_index: IntArray  # (L,)  measurement of that scan
    hits: IntArray  # (L,)
    last_hit_ns: IntArray  # (L,)
    confirmed: BoolArray  # (L,)
    existence: FloatArray  # (L,)  probability that there is such a person or thing
    hidden: FloatArray  # (L,)  probability that it is hidden from the sensors, if it exists
    class_log_odds: FloatArray  # (L,)  of being a pedestrian
    measurement: IntArray  # (L,)  row of the latest scan's measurement that the label owns, or -1

    def __len__(self) -> int:
        return len(self.born_ns)


_COLUMNS = tuple(field.name for field in fields(Labels))


def no_labels() -> Labels:
    """Returns an empty table."""
    i, f = np.zeros(0, np.int64), np.zeros(0)
    return Labels(i, i, i, i, np.zeros(0, bool), f, f, f, i)


def new_labels(
    stamp_ns: int, repeats: int, measurement: IntArray, existence: FloatArray, class_log_odds: FloatArray
) -> Labels:
    """Returns rows for labels born at a scan, with one hit each; `repeats` earlier scans had the same stamp."""
    L = len(measurement)
    index = measurement + repeats * SCANS_OF_ONE_STAMP
    stamps = np.full(L, stamp_ns, np.int64)
    hits, unconfirmed, hidden = np.ones(L, np.int64), np.zeros(L, bool), np.zeros(L)
    return Labels(stamps, index, hits, stamps, unconfirmed, existence, hidden, class_log_odds, measurement)


def append(labels: Labels, more: Labels) -> Labels:
    """Returns the rows of both."""
    if len(more) == 0:
        return labels
    return Labels(*(np.concatenate([getattr(labels, column), getattr(more, column)]) for column in _COLUMNS))


def take(labels: Labels, rows: IntArray) -> Labels:
    """Returns the given rows."""
    return Labels(*(getattr(labels, column).take(rows) for column in _COLUMNS))


@dataclass(frozen=True, eq=False)
class History:
    """Posterior states of every label at the recent scans; columns before a label's birth are NaN."""

    stamps_ns: IntArray  # (H,)  rising
    states: FloatArray  # (L, H, 4)
    coasting: BoolArray  # (L, H)


def no_history() -> History:
    """Returns the past of a tracker that has seen nothing."""
    return History(np.zeros(0, np.int64), np.zeros((0, 0, 4)), np.zeros((0, 0), bool))


def extend(
    history: History, rows: IntArray, stamp_ns: int, states: FloatArray, coasting: BoolArray, *, span_ns: int
) -> History:
    """Returns the history of the labels at `rows`, then of new ones, with one more scan at its end.

    A scan with the stamp of the last one takes its place, so that stamps rise strictly.

    Args:
        history: (L, H) so far.
        rows: labels that live on; the new ones' rows of `states` come after theirs.
        stamp_ns: of the new scan.
        states: (L', 4) posteriors.
        coasting: (L',) True where no measurement was behind the state.
        span_ns: what is older than this before stamp_ns is forgotten.
    """
    first = int(np.searchsorted(history.stamps_ns, stamp_ns - span_ns))
    end = int(np.searchsorted(history.stamps_ns, stamp_ns))
    old, L, H = len(rows), len(states), end - first + 1
    new_states = np.empty((L, H, 4))
    new_coasting = np.empty((L, H), bool)
    new_states[:old, :-1] = history.states[rows, first:end]
    new_coasting[:old, :-1] = history.coasting[rows, first:end]
    new_states[old:, :-1] = np.nan
    new_coasting[old:, :-1] = True
    new_states[:, -1], new_coasting[:, -1] = states, coasting
    return History(np.append(history.stamps_ns[first:end], stamp_ns), new_states, new_coasting)
