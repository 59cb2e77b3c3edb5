"""Which track of one log is which of the other: ids may have been renumbered, people are where they are.

Both logs' tracks are paired frame by frame by place. Over the whole log, ids are then matched one to one so that the
matched ones are together in the largest number of frames. What is kept is one count per pair of ids that ever met.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from replay.diff_pairs import Pair
from replay.diff_values import Level, unique
from replay.logged_message import RawMessage
from schemas import pcgan_v1_pb2 as pb
from schemas.messages import FloatArray, IntArray

TRACKS, PREDICTIONS = "pcgan.v1.TrackFrame", "pcgan.v1.PredictionFrame"
SAME_FOR_FRAMES = 1e-3  # what an unchanged id is worth: it decides where the frames do not

TrackId = tuple[int, int]  # epoch, id: ids begin anew after a clock reset


class _Place(NamedTuple):
    ids: list[int]  # (A,)
    positions_m: FloatArray  # (A, 2)


class _Epoch(NamedTuple):
    """Since when ids are those of an epoch."""

    number: int
    log_time_ns: int
    sequence: int


class TrackMap:
    """Which id of log A is which of log B, of one topic of tracks and what is made of it."""

    def __init__(self, b_of: dict[TrackId, TrackId], epochs: "Sequence[list[_Epoch]]"):
        """Takes the pairs and the epochs of each log, in order."""
        self._b_of = b_of
        self._epochs = epochs
        # ids of A and of B where they differ; "2:7" is track 7 of epoch 2
        self.renumbered = {_text(a): _text(b) for a, b in sorted(b_of.items()) if a != b}

    def epoch(self, log: int, log_time_ns: int, sequence: int | None) -> int:
        """Returns the epoch of a message of log 0 (A) or 1 (B); its sequence number, if it has one, says more."""
        begun = [
            each.number
            for each in self._epochs[log]
            if (each.log_time_ns <= log_time_ns if sequence is None else each.sequence <= sequence)
        ]
        return begun[-1] if begun else 0

    def key(self, log: int, track: TrackId) -> tuple[int, TrackId]:
        """Returns what is equal of two tracks that belong together and of no others."""
        if log == 0 and track in self._b_of:
            return 1, self._b_of[track]
        return log, track

    def give_keys(self, level: Level, log: int, epoch: int, number: Callable[[Any], int | None]) -> None:
        """Has the rows of a level told apart by which track they are; `number` finds the id in what they are called."""
        if level.labels is None:
            return
        names = [label if (found := number(label)) is None else self.key(log, (epoch, found)) for label in level.labels]
        level.keys = unique(names, level.counts)


def match_tracks(pairs: Iterable[Pair]) -> TrackMap:
    """Returns which track is which, from the messages of one topic of tracks or, failing that, of predictions."""
    matching = _Matching()
    for pair in pairs:
        matching.add(pair)
    return matching.result()


class _Matching:
    """Counts the frames that tracks of two logs are together."""

    def __init__(self) -> None:
        self._together: Counter[tuple[TrackId, TrackId]] = Counter()
        self._met: set[TrackId] = set()  # ids that both logs have in one frame
        self._epochs: tuple[list[_Epoch], list[_Epoch]] = ([], [])

    def add(self, pair: Pair) -> None:
        """Takes the next frame of both logs, or of one."""
        a, b = self._read(0, pair.a), self._read(1, pair.b)
        if a is None or b is None:
            return
        (epoch_a, place_a), (epoch_b, place_b) = a, b
        ids = zip(place_a.ids, place_a.ids, strict=True) if pair.identical else _nearest(place_a, place_b)
        self._together.update(((epoch_a, i), (epoch_b, j)) for i, j in ids)
        if epoch_a == epoch_b:
            self._met |= {(epoch_a, number) for number in {*place_a.ids} & {*place_b.ids}}

    def _read(self, log: int, message: RawMessage | None) -> tuple[int, _Place] | None:
        if message is None:
            return None
        try:
            if message.schema.name == TRACKS:
                tracks = pb.TrackFrame.FromString(message.data)
                changes = self._epochs[log]
                if not changes or changes[-1].number != tracks.epoch:
                    changes.append(_Epoch(tracks.epoch, message.log_time_ns, tracks.sequence))
                rows = [(track.id, track.x, track.y) for track in tracks.tracks]
                return tracks.epoch, _place(rows)
            predictions = pb.PredictionFrame.FromString(message.data)
        except DecodeError:
            return None
        first = [(each.track_id, each.paths[0]) for each in predictions.predictions if each.paths]
        return 0, _place([(number, path.x[0], path.y[0]) for number, path in first if path.x and path.y])

    def result(self) -> TrackMap:
        """Returns the matching that has most frames together."""
        b_of = _most_together(self._together)
        if all(a == b for a, b in b_of.items()):
            # nothing was renumbered: who has its number, but was never near it, has moved
            b_of |= {track: track for track in self._met if track not in b_of}
        return TrackMap(b_of, self._epochs)


def _place(rows: Sequence[tuple[int, float, float]]) -> _Place:
    table = np.array([row[1:] for row in rows], float).reshape(-1, 2)
    finite = np.isfinite(table).all(axis=1)
    return _Place([row[0] for row, kept in zip(rows, finite.tolist(), strict=True) if kept], table[finite])


def _nearest(a: _Place, b: _Place) -> list[tuple[int, int]]:
    """Returns the ids that go together in a frame: one to one, least total distance, within 1 m."""
    if not a.ids or not b.ids:
        return []
    from replay.score import nearest_pairs  # brings scipy, which is not needed where nothing differs

    with np.errstate(over="ignore"):  # absurd places are far from all others
        rows, columns = nearest_pairs(np.linalg.norm(a.positions_m[:, None] - b.positions_m, axis=-1))
    return [(a.ids[i], b.ids[j]) for i, j in zip(rows.tolist(), columns.tolist(), strict=True)]


def _most_together(together: Counter[tuple[TrackId, TrackId]]) -> dict[TrackId, TrackId]:
    """Returns the pairs, each track in one at most, that are together in most frames.

    Tracks that never met fall into groups of their own, so no table of everybody is needed.
    """
    if not together:
        return {}
    if all(a == b for a, b in together):
        return {a: a for a, _ in together}
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    from tracking.assignment import assign

    number_a = {track: k for k, track in enumerate(sorted({a for a, _ in together}))}
    number_b = {track: k for k, track in enumerate(sorted({b for _, b in together}))}
    pairs = sorted(together)
    rows: IntArray = np.array([number_a[a] for a, _ in pairs], np.int64)
    columns: IntArray = np.array([number_b[b] for _, b in pairs], np.int64)
    gains = np.array([together[a, b] + SAME_FOR_FRAMES * (a == b) for a, b in pairs])
    A, size = len(number_a), len(number_a) + len(number_b)
    graph = coo_array((np.ones(len(pairs), bool), (rows, A + columns)), shape=(size, size))
    _, group = connected_components(graph, directed=False)
    members: defaultdict[int, list[int]] = defaultdict(list)
    for place, number in enumerate(group[rows].tolist()):
        members[number].append(place)
    kept = []
    for places in members.values():
        _, row = np.unique(rows[places], return_inverse=True)
        _, column = np.unique(columns[places], return_inverse=True)
        kept += np.array(places)[assign(row, column, gains[places])].tolist()
    return {pairs[place][0]: pairs[place][1] for place in kept}


def _text(track: TrackId) -> str:
    epoch, number = track
    return f"{epoch}:{number}" if epoch else str(number)
