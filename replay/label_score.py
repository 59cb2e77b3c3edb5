"""How good labels are where the truth is known: smoothed trajectories beside the tracker's own states."""

from dataclasses import dataclass

import numpy as np

from pcgan.trajectory_file import TrajectoryRows
from replay.score import nearest_pairs, scored_frame
from schemas.messages import FloatArray, GroundTruthFrame, IntArray
from tracking.label_report import LabelReport, Verdict
from tracking.metrics import ScoredFrame, drop_ignored, score


@dataclass(frozen=True)
class Scores:
    """Labels, or the tracker's own states, against the truth.

    The errors are over the moments at which both stand for the same person, so that they compare like with like.
    """

    position_m: float | None  # mean error; None if they never stand for the same person
    velocity_mps: float | None
    position_nees: float | None  # mean of error^2 over covariance: 2 if the covariances are honest
    moments: int  # that these means are over
    recall: float | None  # share of a person's moments with somebody within 1 m
    precision: float | None  # share of states with a person within 1 m
    hota: float
    id_switches: int
    people: int  # that stand for somebody at some moment


@dataclass(frozen=True, eq=False)
class _States:
    """Who was thought to be where at one stamp."""

    ids: IntArray  # (B,)  rising
    states: FloatArray  # (B, 4)  x, y, vx, vy
    position_covs: FloatArray  # (B, 3)  xx, xy, yy


class LabelScore:
    """Takes what the tracker thought, and what was true, scan by scan; compares it with the labels at the end.

    People with fewer than 4 LiDAR points are neither missed nor, if labelled, wrong.
    """

    def __init__(self) -> None:
        self._truth: list[GroundTruthFrame] = []
        self._tracker: list[_States] = []

    def add(self, report: LabelReport, truth: GroundTruthFrame) -> None:
        """Takes one scan."""
        rows = np.flatnonzero(report.verdict == Verdict.PUBLISHED)
        rows = rows[np.argsort(report.ids[rows])]
        covs = report.covariances[rows, :2, :2].reshape(-1, 4)[:, [0, 1, 3]]
        self._truth.append(truth)
        self._tracker.append(_States(report.ids[rows], report.states[rows], covs))

    def against(self, rows: TrajectoryRows) -> dict[str, Scores] | None:
        """Returns the scores of "tracker" and "labels" (sorted by stamp, then id); None without ground truth."""
        if not self._truth:
            return None
        people = rows.people
        ids, states, covs = rows.ids[people], rows.states[people], rows.position_covs[people]
        stamps, truth_ns = rows.stamps_ns[people], np.array([truth.stamp_ns for truth in self._truth])
        slices = zip(np.searchsorted(stamps, truth_ns), np.searchsorted(stamps, truth_ns, side="right"), strict=True)
        labels = [_States(ids[a:b], states[a:b], covs[a:b]) for a, b in slices]
        of = {"tracker": self._tracker, "labels": labels}
        frames = {name: list(map(_scored, states, self._truth)) for name, states in of.items()}
        pairs = {name: [_matched(frame) for frame in each] for name, each in frames.items()}
        errors: dict[str, list[FloatArray]] = {name: [] for name in of}
        for k, truth in enumerate(self._truth):
            both = sorted(pairs["tracker"][k] & pairs["labels"][k])
            for name, thought in of.items():
                errors[name].append(_errors(thought[k], truth, both))
        return {name: _scores(frames[name], pairs[name], np.concatenate(errors[name])) for name in of}


def _scored(states: _States, truth: GroundTruthFrame) -> ScoredFrame:
    """Returns positions and truth without the people whom the LiDAR hardly saw."""
    return drop_ignored(scored_frame(states.ids, states.states[:, :2], truth))


def _matched(frame: ScoredFrame) -> set[tuple[int, int]]:
    """Returns which person (first) each id (second) stands for."""
    rows, columns = nearest_pairs(frame.distances())
    return set(zip(frame.truth_ids[rows].tolist(), frame.track_ids[columns].tolist(), strict=True))


def _errors(states: _States, truth: GroundTruthFrame, pairs: list[tuple[int, int]]) -> FloatArray:
    """Returns position error in m, velocity error in m/s and NEES of the position for each pair: (n, 3)."""
    if not pairs:
        return np.zeros((0, 3))
    row_of = {person: i for i, person in enumerate(truth.ids.tolist())}
    person = [row_of[person] for person, _ in pairs]
    row = np.searchsorted(states.ids, [id for _, id in pairs])
    x, y = (states.states[row, :2] - truth.positions_m[person]).T
    velocity = np.linalg.norm(states.states[row, 2:] - truth.velocities_mps[person], axis=1)
    xx, xy, yy = states.position_covs[row].T
    nees = (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
    return np.stack([np.hypot(x, y), velocity, nees], axis=1)


def _scores(frames: list[ScoredFrame], pairs: list[set[tuple[int, int]]], errors: FloatArray) -> Scores:
    tracking = score(frames)
    position_m, velocity_mps, nees = errors.mean(axis=0).tolist() if len(errors) else (None, None, None)
    people, found = sum(len(frame.truth_ids) for frame in frames), sum(len(frame.track_ids) for frame in frames)
    return Scores(
        position_m,
        velocity_mps,
        nees,
        len(errors),
        1 - tracking.missed / people if people else None,
        1 - tracking.false / found if found else None,
        tracking.hota,
        tracking.id_switches,
        len({person for frame in pairs for person, _ in frame}),
    )
