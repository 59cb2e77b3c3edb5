"""A replay's score of itself: predictions against where the tracks, and the people, were found later.

Works while frames stream by. What it keeps is a few seconds of positions and, where the log holds ground truth, a few
numbers per person and frame for the tracking scores, which need the whole drive.
"""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from pcgan import metrics
from pcgan.extrapolation import extrapolate
from replay.frame_result import FrameResult
from schemas.messages import BoolArray, FloatArray, GroundTruthFrame, IntArray, Prediction, Track
from tracking.metrics import ScoredFrame, drop_ignored, score

MAX_GAP_NS = 350_000_000  # a position is interpolated between measurements at most this far apart
MATCH_M = 1.0  # a track further than this from everybody stands for nobody
LONG_ENOUGH_SCANS = 20  # 2 s at 10 Hz: to be confirmed, and to have the 0.8 s of history a prediction takes
FRAMES_AT_A_TIME = 10
MIN_LIDAR_POINTS = 4  # whoever has fewer is neither missed nor, if tracked, a false track


@dataclass
class Errors:
    """Running means over scored predictions; NaN before the first."""

    scored: int = 0
    sums: FloatArray = field(default_factory=lambda: np.zeros(4))  # ade, fde, mhd, nll

    def add(self, rows: FloatArray) -> None:
        """Takes (n, 4) rows of ADE, FDE, MHD in m and NLL in nats."""
        self.scored += len(rows)
        self.sums = self.sums + rows.sum(axis=0)

    def as_json(self) -> dict[str, float | None]:
        """Returns the means by name; None before the first prediction was scored."""
        means = (self.sums / self.scored).tolist() if self.scored else [None] * 4
        return dict(zip(("ade_m", "fde_m", "mhd_m", "nll"), means, strict=True))


@dataclass(frozen=True, eq=False)
class Positions:
    """Who was where at one stamp; `ids` rise."""

    stamp_ns: int
    ids: IntArray  # (A,)
    positions_m: FloatArray  # (A, 2)
    measured: BoolArray  # (A,)


@dataclass(frozen=True, eq=False)
class _Asked:
    """The network's predictions of one frame, and what they were made from; A of each."""

    stamp_ns: int
    dt_s: float
    tracks: list[Track]
    predictions: list[Prediction]
    person_ids: IntArray  # (A,)  whom the track stands for in the ground truth; -1 for nobody

    @property
    def last_step_ns(self) -> int:
        """Stamp of the last predicted step."""
        return self.stamp_ns + round(self.dt_s * 1e9 * len(self.predictions[0].mixture.weights))


class ReplayScore:
    """Takes frame results in order; `as_json` at the end.

    A prediction is scored if all its steps fall where the track was measured later: between two measurements at most
    0.35 s apart. Fallbacks are the tracker's extrapolation itself and are left out.
    """

    def __init__(self) -> None:
        self._asked: deque[_Asked] = deque()
        self._tracked: deque[Positions] = deque()
        self._true: deque[Positions] = deque()
        self._frames: list[ScoredFrame] = []
        self._epoch = 0
        self._scans_on: Counter[int] = Counter()  # person -> scans with enough LiDAR points
        self._found: set[int] = set()  # people that a track stood for
        self._foretold: set[int] = set()  # people that the network predicted
        self.predictions = 0
        self.fallbacks = 0
        self.against_tracks = {"predictor": Errors(), "tracker": Errors()}
        self.against_truth = {"predictor": Errors(), "tracker": Errors()}

    def add(self, result: FrameResult) -> None:
        """Takes the next frame and scores the predictions that are due."""
        if result.tracks.epoch != self._epoch:
            self._settle(None)
            self._epoch = result.tracks.epoch
            self._tracked.clear()
            self._true.clear()
        tracks, truth = result.tracks.tracks, result.ground_truth
        stamp_ns = result.tracks.stamp_ns
        self._tracked.append(track_positions(stamp_ns, tracks))
        person_of: IntArray = np.full(len(tracks), -1, np.int64)
        if truth is not None:
            self._true.append(true_positions(truth))
            person_of = match(tracks, truth)
            ids = np.array([track.id for track in tracks], np.int64)
            places = np.array([track.state[:2] for track in tracks]).reshape(-1, 2)
            self._frames.append(drop_ignored(_small(scored_frame(ids, places, truth))))
            self._scans_on.update(truth.ids[truth.lidar_points >= MIN_LIDAR_POINTS].tolist())
            self._found.update(person_of.tolist())
            usual = [not prediction.fallback for prediction in result.predictions.predictions]
            self._foretold.update(person_of[np.array(usual, bool)].tolist())
        self._ask(result, person_of)
        self._settle(stamp_ns)

    def as_json(self) -> dict[str, object]:
        """Scores what can still be scored and returns all figures."""
        self._settle(None)
        measured, true = self.against_tracks, self.against_truth
        figures: dict[str, object] = {
            **measured["predictor"].as_json(),
            "scored": measured["predictor"].scored,
            "scored_share": _share(measured["predictor"].scored, self.predictions),
            "tracker": measured["tracker"].as_json(),
            "fallbacks": self.fallbacks,
        }
        if self._frames:
            figures["ground_truth"] = {
                **true["predictor"].as_json(),
                "scored": true["predictor"].scored,
                "scored_share": _share(true["predictor"].scored, self.predictions),
                "tracker": true["tracker"].as_json(),
                **self._people(),
                **asdict(score(self._frames)),
            }
        return figures

    def _people(self) -> dict[str, int]:
        """Returns how many people were seen for long enough, and how many of those were tracked and predicted."""
        seen = {person for person, scans in self._scans_on.items() if scans >= LONG_ENOUGH_SCANS}
        return {
            "people_seen": len(seen),
            "people_tracked": len(seen & self._found),
            "people_predicted": len(seen & self._foretold),
        }

    def _ask(self, result: FrameResult, person_of: IntArray) -> None:
        predictions = result.predictions.predictions
        rows = [i for i, prediction in enumerate(predictions) if not prediction.fallback]
        self.predictions += len(predictions)
        self.fallbacks += len(predictions) - len(rows)
        if not rows:
            return
        tracks = [result.tracks.tracks[i] for i in rows]
        asked = [predictions[i] for i in rows]
        self._asked.append(_Asked(result.tracks.stamp_ns, result.predictions.dt_s, tracks, asked, person_of[rows]))

    def _settle(self, now_ns: int | None) -> None:
        """Scores the predictions whose last step lies far enough back; all of them without a present time.

        Several frames at once: they are small, and numpy's cost is per call.
        """
        due = [asked for asked in self._asked if now_ns is None or asked.last_step_ns + MAX_GAP_NS <= now_ns]
        if due and (len(due) >= FRAMES_AT_A_TIME or now_ns is None):
            for _ in due:
                self._asked.popleft()
            batch = _Batch(due)
            batch.compare(batch.track_ids, self._tracked, self.against_tracks)
            if self._true:
                batch.compare(batch.person_ids, self._true, self.against_truth)
        oldest_ns = self._asked[0].stamp_ns if self._asked else now_ns
        for seen in (self._tracked, self._true):
            while seen and oldest_ns is not None and seen[0].stamp_ns < oldest_ns - MAX_GAP_NS:
                seen.popleft()


class _Batch:
    """The predictions of several frames as arrays of N rows, the extrapolated tracks beside them."""

    def __init__(self, asked: Sequence[_Asked]):
        tracks = [track for frame in asked for track in frame.tracks]
        predictions = [prediction for frame in asked for prediction in frame.predictions]
        mixtures = [prediction.mixture for prediction in predictions]
        N, (P, K) = len(predictions), mixtures[0].weights.shape
        dt_s = asked[0].dt_s
        stamps_ns = np.repeat([frame.stamp_ns for frame in asked], [len(frame.tracks) for frame in asked])
        self.steps_ns = stamps_ns[:, None] + np.round(dt_s * 1e9 * np.arange(1, P + 1)).astype(np.int64)  # (N, P)
        self.track_ids = np.array([track.id for track in tracks], np.int64)
        self.person_ids = np.concatenate([frame.person_ids for frame in asked])
        self.paths_m = np.concatenate([prediction.paths[0].points_m for prediction in predictions]).reshape(N, P, 2)
        self.weights = np.concatenate([mixture.weights for mixture in mixtures], dtype=float).reshape(N, P, K)
        self.means_m = np.concatenate([mixture.means_m for mixture in mixtures], dtype=float).reshape(N, P, K, 2)
        self.sigmas_m = np.concatenate([mixture.sigmas_m for mixture in mixtures], dtype=float).reshape(N, P, K, 2)
        self.rhos = np.concatenate([mixture.rhos for mixture in mixtures], dtype=float).reshape(N, P, K)
        states = np.concatenate([track.state for track in tracks]).reshape(N, 4)
        covariances = np.concatenate([track.covariance for track in tracks]).reshape(N, 4, 4)
        self.extrapolated = extrapolate(states, covariances, dt_s, P)

    def compare(self, ids: IntArray, seen: Sequence[Positions], errors: dict[str, Errors]) -> None:
        """Adds the errors against where `ids` (N,) were seen later; -1 is nobody."""
        positions, known = lookup(seen, ids, self.steps_ns)
        rows = np.flatnonzero(known.all(axis=1) & (ids >= 0))
        if len(rows) == 0:
            return
        true = positions[rows]
        paths = self.paths_m[rows]
        nll = metrics.nll(self.weights[rows], self.means_m[rows], self.sigmas_m[rows], self.rhos[rows], true)
        errors["predictor"].add(_errors(paths, nll, true))
        paths, sigmas, rhos = (part[rows] for part in self.extrapolated)
        certain = np.ones_like(rhos)[..., None]
        nll = metrics.nll(certain, paths[:, :, None], sigmas[:, :, None], rhos[..., None], true)
        errors["tracker"].add(_errors(paths, nll, true))


def _errors(paths_m: FloatArray, nll: FloatArray, true_m: FloatArray) -> FloatArray:
    """(n, P, 2), (n,), (n, P, 2) -> (n, 4) rows of ADE, FDE, MHD and NLL."""
    columns = (metrics.ade(paths_m, true_m), metrics.fde(paths_m, true_m), metrics.mhd(paths_m, true_m), nll)
    return np.column_stack(columns)


def lookup(seen: Sequence[Positions], ids: IntArray, steps_ns: IntArray) -> tuple[FloatArray, BoolArray]:
    """Returns where people or tracks were at given times, between their measurements.

    Args:
        seen: positions at rising stamps.
        ids: (A,) who is looked for; the same one may be asked for more than once.
        steps_ns: (A, P) when, or (P,) for all.

    Returns:
        positions (A, P, 2) in m, and (A, P) whether they were measured around that step, at most MAX_GAP_NS apart;
        other positions mean nothing.
    """
    steps_ns = np.broadcast_to(steps_ns, (len(ids), steps_ns.shape[-1]))
    window = [frame for frame in seen if len(ids) and frame.stamp_ns <= steps_ns.max() + MAX_GAP_NS]
    F = len(window)
    if F == 0:
        return np.zeros((*steps_ns.shape, 2)), np.zeros(steps_ns.shape, bool)
    # who was where, as a table of F frames and U different ids
    unique, column = np.unique(ids, return_inverse=True)
    everybody = np.concatenate([frame.ids for frame in window])
    place = np.minimum(np.searchsorted(unique, everybody), len(unique) - 1)
    wanted = unique[place] == everybody
    row, place = np.repeat(np.arange(F), [len(frame.ids) for frame in window])[wanted], place[wanted]
    positions = np.zeros((F, len(unique), 2))
    measured = np.zeros((F, len(unique)), bool)
    positions[row, place] = np.concatenate([frame.positions_m for frame in window])[wanted]
    measured[row, place] = np.concatenate([frame.measured for frame in window])[wanted]
    # index of the last measured frame up to each frame, and of the first from it on
    stamps = np.array([frame.stamp_ns for frame in window], np.int64)
    index = np.arange(F)[:, None]
    last = np.maximum.accumulate(np.where(measured, index, -1), axis=0)  # (F, U)
    first = np.minimum.accumulate(np.where(measured, index, F)[::-1], axis=0)[::-1]
    column = column[:, None]  # (A, 1)
    after = np.searchsorted(stamps, steps_ns)  # (A, P)  first frame at or past the step
    before = np.searchsorted(stamps, steps_ns, side="right") - 1
    first_after = np.where(after < F, first[np.minimum(after, F - 1), column], F)
    last_before = np.where(before >= 0, last[np.maximum(before, 0), column], -1)
    inside = (first_after < F) & (last_before >= 0)
    low, high = np.where(inside, last_before, 0), np.where(inside, first_after, 0)
    gap_ns = stamps[high] - stamps[low]
    fraction = (steps_ns - stamps[low]) / np.maximum(gap_ns, 1)
    start, end = positions[low, column], positions[high, column]  # (A, P, 2)
    return start + fraction[..., None] * (end - start), np.asarray(inside & (gap_ns <= MAX_GAP_NS))


def track_positions(stamp_ns: int, tracks: Sequence[Track]) -> Positions:
    """Returns where the tracks of a frame are; coasting ones do not count as measured."""
    ids = np.array([track.id for track in tracks], np.int64)
    order = np.argsort(ids)
    positions = np.array([track.state[:2] for track in tracks], float).reshape(-1, 2)
    measured = np.array([not track.history.coasting[-1] for track in tracks], bool)
    return Positions(stamp_ns, ids[order], positions[order], measured[order])


def true_positions(truth: GroundTruthFrame) -> Positions:
    """Returns everybody of a ground truth frame; all of them count as measured."""
    ids = truth.ids.astype(np.int64)
    order = np.argsort(ids)
    return Positions(truth.stamp_ns, ids[order], truth.positions_m[order], np.ones(len(ids), bool))


def match(tracks: Sequence[Track], truth: GroundTruthFrame) -> IntArray:
    """Returns whom each track stands for (A,), -1 for nobody: one to one, least total distance, within 1 m."""
    person_of = np.full(len(tracks), -1, np.int64)
    if len(tracks) and len(truth.ids):
        positions = np.array([track.state[:2] for track in tracks])
        rows, columns = nearest_pairs(np.linalg.norm(positions[:, None] - truth.positions_m, axis=-1))
        person_of[rows] = truth.ids[columns]
    return person_of


def nearest_pairs(distances_m: FloatArray) -> tuple[IntArray, IntArray]:
    """Returns rows (n,) and columns (n,) of distances (A, B) that go together: one to one, least total, within 1 m."""
    rows, columns = linear_sum_assignment(np.minimum(distances_m, MATCH_M))
    near = distances_m[rows, columns] < MATCH_M
    return rows[near], columns[near]


def scored_frame(ids: IntArray, positions_m: FloatArray, truth: GroundTruthFrame) -> ScoredFrame:
    """Returns tracks (B,) at positions (B, 2) beside the truth; whom the LiDAR hardly saw is ignored."""
    ignored = truth.lidar_points < MIN_LIDAR_POINTS
    return ScoredFrame(truth.ids.astype(np.int64), truth.positions_m, ids, positions_m, ignored)


def _small(frame: ScoredFrame) -> ScoredFrame:
    """Returns the frame in half of the memory: a whole drive of them is kept."""
    return ScoredFrame(
        frame.truth_ids.astype(np.int32),
        frame.truth_m.astype(np.float32),
        frame.track_ids.astype(np.int32),
        frame.tracks_m.astype(np.float32),
        frame.ignored,
    )


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None
