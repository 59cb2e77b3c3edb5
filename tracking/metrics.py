"""How good tracks are: OSPA and GOSPA per frame; OSPA(2), HOTA, IDF1 and MOTA per drive. Arrays in, numbers out."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from schemas.messages import BoolArray, FloatArray, IntArray
from tracking.assignment import assign

HOTA_THRESHOLDS = np.arange(1, 20) / 20  # 0.05 to 0.95
_EPS = np.finfo(float).eps


@dataclass(frozen=True, eq=False)
class ScoredFrame:
    """Where people were and where the tracker said they were, at one stamp. Ids are unique within a frame."""

    truth_ids: IntArray  # (A,)
    truth_m: FloatArray  # (A, 2)
    track_ids: IntArray  # (B,)
    tracks_m: FloatArray  # (B, 2)
    ignored: BoolArray = field(default_factory=lambda: np.zeros(0, bool))  # (A,), or empty: nobody is

    def distances(self) -> FloatArray:
        """Returns the distance (A, B) in m of each person to each track."""
        return _distances(self.truth_m, self.tracks_m)


@dataclass(frozen=True)
class Gospa:
    """GOSPA and its parts, in m: `total ** p` is the sum of the parts each `** p`."""

    total: float
    localisation: float
    missed: float
    false: float


@dataclass(frozen=True)
class TrackingScore:
    """Scores of a whole drive. All but the counts and distances lie between 0 and 1, MOTA may be negative."""

    hota: float
    det_a: float  # detection accuracy, of HOTA
    ass_a: float  # association accuracy, of HOTA
    idf1: float
    mota: float
    id_switches: int
    missed: int
    false: int
    ospa_m: float  # mean over frames
    gospa_m: float
    localisation_m: float  # mean distance of the pairs CLEAR matches
    frames: int


def _distances(a: FloatArray, b: FloatArray) -> FloatArray:
    difference = np.asarray(a, float).reshape(-1, 1, 2) - np.asarray(b, float).reshape(1, -1, 2)
    distance: FloatArray = np.hypot(difference[..., 0], difference[..., 1])
    return distance


def ospa(truth_m: FloatArray, tracks_m: FloatArray, cutoff_m: float = 2.0, order: float = 1.0) -> float:
    """Returns the optimal subpattern assignment distance in m of two sets of points (A, 2) and (B, 2).

    Schuhmacher, Vo and Vo, "A Consistent Metric for Performance Evaluation of Multi-Object Filters" (2008). Two empty
    sets are 0 apart, an empty and another one `cutoff_m`.
    """
    A, B = len(truth_m), len(tracks_m)
    if A == 0 or B == 0:
        return 0.0 if A == B else cutoff_m
    cost = np.minimum(_distances(truth_m, tracks_m), cutoff_m) ** order
    rows, columns = linear_sum_assignment(cost)
    total = float(cost[rows, columns].sum()) + abs(A - B) * cutoff_m**order
    return float((total / max(A, B)) ** (1 / order))


def gospa(truth_m: FloatArray, tracks_m: FloatArray, cutoff_m: float = 2.0, order: float = 1.0) -> Gospa:
    """Returns the generalised OSPA (alpha 2) of two sets of points (A, 2) and (B, 2), with its parts.

    Rahmathullah, Garcia-Fernandez and Svensson, "Generalized Optimal Sub-Pattern Assignment Metric" (2017): a person
    without a track and a track without a person each cost cutoff_m ** order / 2.
    """
    cost = np.minimum(_distances(truth_m, tracks_m), cutoff_m)
    rows, columns = linear_sum_assignment(cost**order)
    matched = cost[rows, columns] < cutoff_m
    near = float((cost[rows, columns][matched] ** order).sum())
    pairs, unit = int(matched.sum()), cutoff_m**order / 2
    parts = (near, (len(truth_m) - pairs) * unit, (len(tracks_m) - pairs) * unit)
    localisation, missed, false = (part ** (1 / order) for part in parts)
    return Gospa(sum(parts) ** (1 / order), localisation, missed, false)


def drop_ignored(frame: ScoredFrame, gate_m: float = 2.0) -> ScoredFrame:
    """Returns the frame without its ignored people, and without the tracks on them.

    An ignored person is neither a miss nor, if tracked, a false track. A track is on an ignored person if the best
    assignment of tracks to all people within `gate_m` puts it there.
    """
    if not frame.ignored.any():
        return frame
    keep = np.ones(len(frame.track_ids), bool)
    gain = np.maximum(gate_m - frame.distances(), 0.0)
    rows, columns = linear_sum_assignment(gain, maximize=True)
    keep[columns[frame.ignored[rows] & (gain[rows, columns] > 0)]] = False
    seen = ~frame.ignored
    return ScoredFrame(frame.truth_ids[seen], frame.truth_m[seen], frame.track_ids[keep], frame.tracks_m[keep])


def ospa2(frames: Sequence[ScoredFrame], cutoff_m: float = 2.0, order: float = 1.0, window_scans: int = 10) -> float:
    """Returns OSPA(2) in m, the mean over windows that end at each frame and hold it and the window_scans - 1 before.

    Beard, Vo and Vo, "A Solution for Large-Scale Multi-Object Tracking" (2020): the OSPA distance of the two sets of
    paths seen in a window. Two paths are as far apart as their positions on average, each at most `cutoff_m`, over the
    frames in which either exists; where only one of them does they are `cutoff_m` apart. So a track that changes people
    costs, unlike in OSPA. Ignored people, and the tracks on them, are left out. No frame gives 0.
    """
    if window_scans < 1:
        raise ValueError(f"window_scans must be at least 1, got {window_scans}")
    seen = [drop_ignored(frame) for frame in frames]
    people, here = _presence([frame.truth_ids for frame in seen])  # (A,), (F, A)
    tracks, there = _presence([frame.track_ids for frame in seen])  # (B,), (F, B)
    # Only pairs that are ever within the cutoff can gain by being matched; all others are `cutoff_m` apart.
    keys, gains = [], []
    for frame in seen:
        gain = np.maximum(cutoff_m - frame.distances(), 0.0)
        rows, columns = np.nonzero(gain)
        person, track = (
            np.searchsorted(people, frame.truth_ids[rows]),
            np.searchsorted(tracks, frame.track_ids[columns]),
        )
        keys.append(person * len(tracks) + track)
        gains.append(gain[rows, columns])
    total = 0.0
    for end in range(1, len(seen) + 1):
        window = slice(max(0, end - window_scans), end)
        pairs, inverse = np.unique(np.concatenate(keys[window]), return_inverse=True)
        gain = np.bincount(inverse, np.concatenate(gains[window]), len(pairs))
        person, track = pairs // max(1, len(tracks)), pairs % max(1, len(tracks))
        either = (here[window][:, person] | there[window][:, track]).sum(axis=0)
        saved = cutoff_m**order - np.maximum(cutoff_m - gain / either, 0.0) ** order  # rounding may go below 0
        matched = float(saved[assign(person, track, saved)].sum())
        paths = max(int(here[window].any(axis=0).sum()), int(there[window].any(axis=0).sum()))
        total += (cutoff_m**order - matched / paths) ** (1 / order) if paths else 0.0
    return total / max(1, len(seen))


def _presence(ids: Sequence[IntArray]) -> tuple[IntArray, BoolArray]:
    """Returns the different ids (A,) of all frames, rising, and in which frames they occur (F, A)."""
    different = np.unique(np.concatenate([*ids, np.zeros(0, np.int64)]))
    present = np.zeros((len(ids), len(different)), bool)
    for row, those in zip(present, ids, strict=True):
        row[np.searchsorted(different, those)] = True
    return different, present


def similarity(distances_m: FloatArray, reach_m: float = 2.0) -> FloatArray:
    """Returns max(0, 1 - d / reach) for distances of any shape."""
    near: FloatArray = np.maximum(0.0, 1 - distances_m / reach_m)
    return near


@dataclass(frozen=True, eq=False)
class _Pairs:
    """The person-track pairs of one frame that are alike at all (within 2 m), E of them."""

    truth: IntArray  # (A_f,)  people of the frame, as rows 0 to A - 1 of the drive
    tracks: IntArray  # (B_f,)
    rows: IntArray  # (E,)    into `truth`
    columns: IntArray  # (E,)    into `tracks`
    similarity: FloatArray  # (E,)

    def dense(self, values: FloatArray) -> FloatArray:
        """Returns values of the pairs as a table (A_f, B_f), 0 elsewhere."""
        table = np.zeros((len(self.truth), len(self.tracks)))
        table[self.rows, self.columns] = values
        return table


@dataclass(frozen=True, eq=False)
class _Drive:
    """Frames with ids as rows 0 to n - 1. Only pairs that are alike are kept: a long drive has millions of others."""

    frames: list[_Pairs]
    A: int  # people in the drive
    B: int  # tracks in the drive
    keys: IntArray  # (U,)  person * B + track of each pair that is ever alike, rising

    def pair_index(self, frame: _Pairs) -> IntArray:
        """Returns which of the drive's pairs the frame's are (E,)."""
        return np.searchsorted(self.keys, frame.truth[frame.rows] * self.B + frame.tracks[frame.columns])


def _prepare(frames: Iterable[ScoredFrame]) -> _Drive:
    frames = list(frames)
    people = np.unique(np.concatenate([frame.truth_ids for frame in frames] or [np.zeros(0, np.int64)]))
    tracks = np.unique(np.concatenate([frame.track_ids for frame in frames] or [np.zeros(0, np.int64)]))
    pairs = []
    for frame in frames:
        sim = similarity(frame.distances())
        rows, columns = np.nonzero(sim)
        truth, names = np.searchsorted(people, frame.truth_ids), np.searchsorted(tracks, frame.track_ids)
        pairs.append(_Pairs(truth, names, rows, columns, sim[rows, columns]))
    keys = [frame.truth[frame.rows] * len(tracks) + frame.tracks[frame.columns] for frame in pairs]
    return _Drive(pairs, len(people), len(tracks), np.unique(np.concatenate(keys or [np.zeros(0, np.int64)])))


def hota(frames: Sequence[ScoredFrame]) -> tuple[float, float, float]:
    """Returns HOTA, DetA and AssA of a drive, means over 19 similarity thresholds.

    Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking" (2021). No person and no track
    at all gives 1; a drive with people but no track 0.
    """
    return _hota(_prepare(frames))


def _hota(drive: _Drive) -> tuple[float, float, float]:
    A, B = drive.A, drive.B
    if A == 0 or B == 0:
        value = 1.0 if A == B else 0.0
        return value, value, value
    U = len(drive.keys)
    person, track = drive.keys // B, drive.keys % B  # (U,)
    index = [drive.pair_index(frame) for frame in drive.frames]
    potential, truth_count, track_count = np.zeros(U), np.zeros(A), np.zeros(B)
    for frame, at in zip(drive.frames, index, strict=True):
        sim = frame.similarity
        per_person = np.bincount(frame.rows, sim, len(frame.truth))
        per_track = np.bincount(frame.columns, sim, len(frame.tracks))
        potential[at] += sim / (per_person[frame.rows] + per_track[frame.columns] - sim)
        truth_count[frame.truth] += 1
        track_count[frame.tracks] += 1
    alignment = potential / (truth_count[person] + track_count[track] - potential)

    matches = np.zeros((len(HOTA_THRESHOLDS), U))
    true_positives = np.zeros(len(HOTA_THRESHOLDS))
    for frame, at in zip(drive.frames, index, strict=True):
        table = frame.dense(frame.similarity)
        rows, columns = linear_sum_assignment(frame.dense(alignment[at] * frame.similarity), maximize=True)
        alike = table[rows, columns] > 0
        rows, columns = rows[alike], columns[alike]
        over = table[rows, columns] >= HOTA_THRESHOLDS[:, None] - _EPS  # (19, pairs)
        matches[:, np.searchsorted(drive.keys, frame.truth[rows] * B + frame.tracks[columns])] += over
        true_positives += over.sum(axis=1)
    detections = truth_count.sum() + track_count.sum()
    det_a = true_positives / np.maximum(1, detections - true_positives)
    jaccard = matches / np.maximum(1, truth_count[person] + track_count[track] - matches)
    ass_a = (matches * jaccard).sum(axis=1) / np.maximum(1, true_positives)
    return float(np.sqrt(det_a * ass_a).mean()), float(det_a.mean()), float(ass_a.mean())


def idf1(frames: Sequence[ScoredFrame], gate_m: float = 1.0) -> float:
    """Returns the share of positions that one-to-one identities over the whole drive account for.

    Ristani et al., "Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking" (2016).
    """
    return _idf1(_prepare(frames), gate_m)


def _idf1(drive: _Drive, gate_m: float) -> float:
    if drive.A == 0 and drive.B == 0:
        return 1.0
    least = float(similarity(np.array(gate_m)))
    together = np.zeros(len(drive.keys))
    positions = 0
    for frame in drive.frames:
        near = frame.similarity >= least - _EPS
        together[drive.pair_index(frame)[near]] += 1
        positions += len(frame.truth) + len(frame.tracks)
    return 2 * _most_together(drive, together) / positions


def _most_together(drive: _Drive, together: FloatArray) -> float:
    """Returns the largest sum over pairs (U,) of which each person and each track is in one at most.

    People and tracks that never met fall into groups of their own, so no table of everybody is needed.
    """
    met = together > 0
    person, track = drive.keys[met] // drive.B, drive.keys[met] % drive.B
    nodes = drive.A + drive.B
    graph = coo_array((np.ones(len(person), bool), (person, drive.A + track)), shape=(nodes, nodes))
    _, group = connected_components(graph, directed=False)
    order = np.argsort(group[person], kind="stable")
    starts = np.flatnonzero(np.diff(group[person][order], prepend=-1))
    total = 0.0
    for members in np.split(order, starts[1:]):
        people, rows = np.unique(person[members], return_inverse=True)
        tracks, columns = np.unique(track[members], return_inverse=True)
        table = np.zeros((len(people), len(tracks)))
        table[rows, columns] = together[met][members]
        total += float(table[linear_sum_assignment(table, maximize=True)].sum())
    return total


@dataclass(frozen=True)
class Clear:
    """Counts of the CLEAR metrics over a drive."""

    mota: float
    id_switches: int
    missed: int
    false: int
    localisation_m: float  # mean distance of matched pairs; 0 without any


def clear(frames: Sequence[ScoredFrame], gate_m: float = 1.0) -> Clear:
    """Returns MOTA and its counts: a pair of the frame before stays while within the gate, the rest is assigned anew.

    Bernardin and Stiefelhagen, "Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics" (2008). An
    identity switch is a person whose track differs from the last one it had. Without people MOTA is 1 - false tracks.
    """
    return _clear(_prepare(frames), gate_m)


def _clear(drive: _Drive, gate_m: float) -> Clear:
    least = float(similarity(np.array(gate_m)))
    last_ever, last_frame = np.full(drive.A, -1), np.full(drive.A, -1)
    switches = missed = false = positions = pairs = 0
    distance = 0.0
    for frame in drive.frames:
        truth, tracks, sim = frame.truth, frame.tracks, frame.dense(frame.similarity)
        kept = last_frame[truth][:, None] == tracks[None, :]
        score = np.where(sim >= least - _EPS, 1000.0 * kept + sim, 0.0)
        rows, columns = linear_sum_assignment(score, maximize=True)
        real = score[rows, columns] > 0
        rows, columns = rows[real], columns[real]
        people, ids = truth[rows], tracks[columns]
        switches += int(((last_ever[people] >= 0) & (last_ever[people] != ids)).sum())
        last_ever[people] = ids
        last_frame[:] = -1
        last_frame[people] = ids
        positions += len(truth)
        pairs += len(rows)
        missed += len(truth) - len(rows)
        false += len(tracks) - len(rows)
        distance += float(((1 - sim[rows, columns]) * 2.0).sum())
    mota = 1 - (missed + false + switches) / max(1, positions)
    return Clear(mota, switches, missed, false, distance / max(1, pairs))


def score(frames: Sequence[ScoredFrame], cutoff_m: float = 2.0, gate_m: float = 1.0) -> TrackingScore:
    """Returns every score of a drive; ignored people, and the tracks on them, are left out first."""
    seen = [drop_ignored(frame) for frame in frames]
    drive = _prepare(seen)
    hota_value, det_a, ass_a = _hota(drive)
    counts = _clear(drive, gate_m)
    return TrackingScore(
        hota_value,
        det_a,
        ass_a,
        _idf1(drive, gate_m),
        counts.mota,
        counts.id_switches,
        counts.missed,
        counts.false,
        float(np.mean([ospa(frame.truth_m, frame.tracks_m, cutoff_m) for frame in seen] or [0.0])),
        float(np.mean([gospa(frame.truth_m, frame.tracks_m, cutoff_m).total for frame in seen] or [0.0])),
        counts.localisation_m,
        len(seen),
    )
