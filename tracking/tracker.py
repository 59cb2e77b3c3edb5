"""The tracker: labels, existence, class and identity on top of the GM-PHD recursion. Measurements in, tracks out."""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from schemas.messages import FloatArray, IntArray, Track, TrackHistory
from tracking import gm_phd
from tracking.clutter import ClutterEstimate, updated
from tracking.gm_phd import DetectionProbability, FilterParams
from tracking.label_report import LabelReport, Verdict, report, verdicts
from tracking.measurements import Measurements, PredictedTracks, no_predicted_tracks
from tracking.mixture_reduction import GaussianMixture, empty_mixture, label_mass, select
from tracking.motion_model import process_noise
from tracking.track_table import History, Labels, append, extend, new_labels, no_history, no_labels, take

MAX_CLASS_LOG_ODDS = 5.0
MAX_REMEMBERED_IDS = 10_000


class LateScanError(ValueError):
    """A scan older than the tracker can still take in."""


class TrackerParams(BaseModel):
    """Settings of the tracker. The defaults were tuned on the tuning seeds and drives of benchmarks/tracking."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    filter: FilterParams = FilterParams()
    confirm_existence: float = Field(default=0.5, gt=0, lt=1)
    confirm_hits: int = Field(default=2, ge=1)
    publish_existence: float = Field(
        default=0.5, gt=0, lt=1, description="confirmed tracks below this are kept, not published"
    )
    drop_existence: float = Field(default=1e-3, gt=0, lt=1, description="a confirmed label below this is forgotten")
    coasting_after_s: float = Field(
        default=0.3, ge=0, description="without a hit for longer, a track is marked as coasting"
    )
    history_s: float = Field(default=3.6, ge=0)
    hide_per_s: float = Field(default=0.01, ge=0, description="rate at which visible people become hidden")
    show_per_s: float = Field(default=1.0, ge=0, description="rate at which hidden people become visible again")
    class_memory_s: float = Field(default=3.0, gt=0, description="time constant of a track's class log-odds")
    pedestrian_probability: float = Field(
        default=0.4, gt=0, lt=1, description="tracks at least this likely are pedestrians"
    )
    clutter_memory_s: float = Field(default=2.0, gt=0, description="time constant of the count of false measurements")
    ring: int = Field(default=8, ge=1, description="how many scans back a late one can still be taken in")


@dataclass(frozen=True, eq=False)
class TrackerState:
    """Everything the tracker remembers after a scan. Never changed in place."""

    stamp_ns: int
    repeats: int  # how many scans just before had the same stamp
    clutter: ClutterEstimate
    mixture: GaussianMixture  # sorted by label row, the heaviest component first
    labels: Labels
    history: History


def initial_state(stamp_ns: int, params: TrackerParams) -> TrackerState:
    """Returns what is known before the first scan, which has this stamp."""
    clutter = ClutterEstimate(params.filter.clutter_per_m2, 0.0)
    return TrackerState(stamp_ns, -1, clutter, empty_mixture(), no_labels(), no_history())


def advance(
    state: TrackerState,
    measurements: Measurements,
    stamp_ns: int,
    detection_probability: DetectionProbability,
    params: TrackerParams,
) -> TrackerState:
    """Returns the state after one more scan.

    Args:
        state: after the scan before.
        measurements: of this scan, odometry frame; may be empty.
        stamp_ns: not before the state's own; the same again is fine.
        detection_probability: of people at positions (J, 2), as (J,), or one number for all. Exactly 0 means out of
            the sensors' view: people there are forgotten sooner.
        params: settings.
    """
    dt_s, L = (stamp_ns - state.stamp_ns) * 1e-9, len(state.labels)
    repeats = state.repeats + 1 if stamp_ns == state.stamp_ns else 0
    hidden = _predict_hidden(state.labels, dt_s, params)
    step = gm_phd.step(
        state.mixture,
        measurements,
        dt_s,
        detection_probability=detection_probability,
        hidden=hidden,
        pedestrian=1 / (1 + np.exp(-state.labels.class_log_odds)),
        clutter_per_m2=state.clutter.per_m2,
        params=params.filter,
    )
    labels = _update_labels(
        state.labels, step, measurements, hidden=hidden, stamp_ns=stamp_ns, dt_s=dt_s, params=params
    )
    births = step.correction.births[step.newborn]
    log_odds = _log_odds(measurements.pedestrian_probability[step.newborn])
    labels = append(labels, new_labels(stamp_ns, repeats, step.newborn, births, log_odds))
    clutter = updated(
        state.clutter,
        measurements.positions_m,
        _unexplained(step.correction, measurements),
        dt_s,
        prior=params.filter.clutter_per_m2,
        memory_s=params.clutter_memory_s,
    )
    mixture, labels, history = _settle(step.mixture, labels, state.history, old=L, stamp_ns=stamp_ns, params=params)
    return TrackerState(stamp_ns, repeats, clutter, mixture, labels, history)


def _unexplained(correction: gm_phd.Correction, measurements: Measurements) -> float:
    """Returns how many measurements are nobody's, expected; those that could not be new people do not count."""
    nobody = np.ones(len(measurements))
    owner = np.flatnonzero(correction.measurement >= 0)
    nobody[correction.measurement[owner]] -= correction.explained[owner]
    return float(nobody[measurements.gives_birth].sum())


def _log_odds(p: FloatArray) -> FloatArray:
    odds: FloatArray = np.log(p / (1 - p))
    return odds


def _predict_hidden(labels: Labels, dt_s: float, params: TrackerParams) -> FloatArray:
    """Moves the hidden chain dt_s on. What nothing has confirmed is never hidden: clutter would live for seconds."""
    rate = params.hide_per_s + params.show_per_s
    if rate == 0:
        return labels.hidden
    at_rest = params.hide_per_s / rate
    return np.where(labels.confirmed, at_rest + (labels.hidden - at_rest) * math.exp(-rate * dt_s), 0.0)


def _update_labels(
    labels: Labels,
    step: gm_phd.Step,
    measurements: Measurements,
    *,
    hidden: FloatArray,
    stamp_ns: int,
    dt_s: float,
    params: TrackerParams,
) -> Labels:
    """Bayes' rule per label for existence (a Bernoulli's), for being hidden, and for being a pedestrian."""
    L = len(labels)
    predicted, correction, explained = step.predicted, step.correction, step.correction.explained
    prior = np.minimum(label_mass(predicted, L), 1.0)
    absent = np.maximum(1 - prior, 1e-12)
    existence = 1 - absent / (absent + correction.missed_mass + explained / (1 - explained))

    visible = np.bincount(predicted.labels, predicted.weights * step.in_view, L) / np.maximum(prior, 1e-300)
    visible = visible * (1 - correction.unresolved)
    unseen = hidden + (1 - hidden) * np.maximum(1 - visible, 0.0)
    hidden = (1 - explained) * np.divide(hidden, unseen, out=np.zeros(L), where=unseen > 0)

    hit = explained > 0.5
    hits = labels.hits + hit
    memory = math.exp(-dt_s / params.class_memory_s)
    log_odds = labels.class_log_odds.copy()
    news = _log_odds(measurements.pedestrian_probability[correction.measurement[hit]])
    log_odds[hit] = np.minimum(np.maximum(log_odds[hit] * memory + news, -MAX_CLASS_LOG_ODDS), MAX_CLASS_LOG_ODDS)
    return replace(
        labels,
        hits=hits,
        last_hit_ns=np.where(hit, stamp_ns, labels.last_hit_ns),
        confirmed=labels.confirmed | ((hits >= params.confirm_hits) & (existence > params.confirm_existence)),
        existence=existence,
        hidden=hidden,
        class_log_odds=log_odds,
        measurement=np.where(hit, correction.measurement, -1),
    )


def _settle(
    mixture: GaussianMixture,
    labels: Labels,
    history: History,
    *,
    old: int,
    stamp_ns: int,
    params: TrackerParams,
) -> tuple[GaussianMixture, Labels, History]:
    """Forgets dead labels, sets each living one's mass to its existence (it is one person at most), writes history."""
    mass = label_mass(mixture, len(labels))
    least = np.where(labels.confirmed, params.drop_existence, params.filter.prune_weight)
    alive = (mass > 0) & (labels.existence >= least)
    mixture = select(mixture, alive[mixture.labels])
    weights = mixture.weights * (labels.existence[mixture.labels] / mass[mixture.labels])
    mixture = GaussianMixture(weights, mixture.means, mixture.covs, (np.cumsum(alive) - 1)[mixture.labels])
    rows = np.flatnonzero(alive)
    labels = take(labels, rows)
    heaviest = np.searchsorted(mixture.labels, np.arange(len(rows)))
    survivors = rows[rows < old]
    history = extend(
        history,
        survivors,
        stamp_ns,
        mixture.means[heaviest],
        labels.last_hit_ns != stamp_ns,
        span_ns=round(params.history_s * 1e9),
    )
    return mixture, labels, history


@dataclass(frozen=True, eq=False)
class _Scan:
    """One scan's inputs with the state after it, kept so that a late one can be put in before it."""

    measurements: Measurements
    stamp_ns: int
    detection_probability: DetectionProbability
    state: TrackerState


def _names(labels: Labels) -> list[tuple[int, int]]:
    return list(zip(labels.born_ns.tolist(), labels.born_index.tolist(), strict=True))


def _owned(labels: Labels) -> dict[tuple[int, int], int]:
    """Returns which measurement each label owns, or -1, by its name."""
    return dict(zip(_names(labels), labels.measurement.tolist(), strict=True))


class Tracker:
    """Holds the last few states and the numbers given to published tracks, and nothing else."""

    def __init__(self, params: TrackerParams | None = None, first_id: int = 1) -> None:
        self.params = TrackerParams() if params is None else params
        self._ring: deque[_Scan] = deque(maxlen=self.params.ring)
        self._ids: dict[tuple[int, int], int] = {}  # (born_ns, born_index) -> published id
        self._next_id = first_id

    @property
    def next_id(self) -> int:
        """The number that the next published track will get."""
        return self._next_id

    @property
    def state(self) -> TrackerState | None:
        """What is remembered after the latest scan; None before the first."""
        return self._ring[-1].state if self._ring else None

    def check_in_order(self, stamp_ns: int) -> None:
        """Raises LateScanError if `step` would refuse a scan of this stamp."""
        state = self.state
        if state is not None and stamp_ns < state.stamp_ns:
            raise LateScanError(f"scan at {stamp_ns} ns comes after the one at {state.stamp_ns} ns; amend takes it in")

    def step(
        self, measurements: Measurements, stamp_ns: int, detection_probability: DetectionProbability = 0.9
    ) -> tuple[Track, ...]:
        """Takes in one scan and returns the confirmed pedestrians at its stamp, oldest first.

        Args:
            measurements: odometry frame, from `fuse` or `make_measurements`.
            stamp_ns: of the scan; the last one's again is fine.
            detection_probability: of people at positions (J, 2), as (J,), or one number. Exactly 0 means out of view.

        Raises:
            LateScanError: the stamp is before the last scan's; see `amend`.
        """
        self.check_in_order(stamp_ns)
        state = self.state or initial_state(stamp_ns, self.params)
        state = advance(state, measurements, stamp_ns, detection_probability, self.params)
        self._ring.append(_Scan(measurements, stamp_ns, detection_probability, state))
        return self._publish(state)

    def amend(
        self, measurements: Measurements, stamp_ns: int, detection_probability: DetectionProbability = 0.9
    ) -> None:
        """Takes in a scan that came late: goes back to the state before it and replays what followed.

        Tracks that have been published keep their ids. The present tracks are those of the next `step`.

        Raises:
            LateScanError: the scan is older than the ring of remembered states.
        """
        scans = list(self._ring)
        before = sum(scan.stamp_ns <= stamp_ns for scan in scans)
        if before == 0:
            oldest = f"; the oldest state remembered is of {scans[0].stamp_ns} ns" if scans else ""
            raise LateScanError(f"scan at {stamp_ns} ns is too late{oldest}")
        kept, state = scans[:before], scans[before - 1].state
        late = _Scan(measurements, stamp_ns, detection_probability, state)
        for scan in (late, *scans[before:]):
            state = advance(state, scan.measurements, scan.stamp_ns, scan.detection_probability, self.params)
            kept.append(replace(scan, state=state))
        self._hand_on_ids(scans[before:], kept[before + 1 :])
        self._ring.extend(kept[-self.params.ring :])

    def _hand_on_ids(self, old: list[_Scan], new: list[_Scan]) -> None:
        """Gives a label whose birth the late scan has moved the id of what it was before.

        It is the same one if it owns, in the latest scan in which the old one owned any, the same measurement.
        """
        if not old:
            return
        alive = set(_names(new[-1].state.labels))
        gone = [name for name in _names(old[-1].state.labels) if name in self._ids and name not in alive]
        for name in gone:
            for before, after in zip(reversed(old), reversed(new), strict=True):
                measurement = _owned(before.state.labels).get(name, -1)
                if measurement >= 0:
                    owners = [other for other, owned in _owned(after.state.labels).items() if owned == measurement]
                    heir = next((other for other in owners if other in alive and other not in self._ids), None)
                    if heir is not None:
                        self._ids[heir] = self._ids.pop(name)
                    break

    def predicted(self, stamp_ns: int) -> PredictedTracks:
        """Returns where every label with two hits is expected at a stamp, which may lie a little in the past."""
        state = self.state
        if state is None or len(state.labels) == 0:
            return no_predicted_tracks()
        rows = np.flatnonzero(state.labels.hits >= 2)
        heaviest = np.searchsorted(state.mixture.labels, rows)
        means, covs = state.mixture.means[heaviest], state.mixture.covs[heaviest]
        dt_s = (stamp_ns - state.stamp_ns) * 1e-9
        Q = process_noise(dt_s, self.params.filter.acceleration_mps2)
        cross = covs[:, :2, 2:]
        covs = covs[:, :2, :2] + dt_s * (cross + cross.swapaxes(1, 2)) + dt_s**2 * covs[:, 2:, 2:] + Q[:2, :2]
        return PredictedTracks(means[:, :2] + dt_s * means[:, 2:], means[:, 2:], covs)

    def labels(self) -> LabelReport:
        """Returns what is thought of every label after the latest scan, and why it is published or not."""
        state = self.state or initial_state(0, self.params)
        return report(state.labels, state.mixture, self._verdicts(state.labels), lambda name: self._ids.get(name, 0))

    def _verdicts(self, labels: Labels) -> IntArray:
        return verdicts(
            labels,
            publish_existence=self.params.publish_existence,
            pedestrian_probability=self.params.pedestrian_probability,
        )

    def _publish(self, state: TrackerState) -> tuple[Track, ...]:
        labels, history, params = state.labels, state.history, self.params
        rows = np.flatnonzero(self._verdicts(labels) == Verdict.PUBLISHED)
        heaviest = np.searchsorted(state.mixture.labels, rows)
        means, covs = state.mixture.means[heaviest], state.mixture.covs[heaviest]
        shown = take(labels, rows)
        first = np.searchsorted(history.stamps_ns, shown.born_ns).tolist()
        pasts = [
            TrackHistory(history.stamps_ns[start:], states[start:], coasting[start:])
            for start, states, coasting in zip(first, history.states[rows], history.coasting[rows], strict=True)
        ]
        existence = np.minimum(np.maximum(shown.existence, 0.0), 1.0).tolist()
        ages_ns = (state.stamp_ns - shown.born_ns).tolist()
        coasting = (state.stamp_ns - shown.last_hit_ns > round(params.coasting_after_s * 1e9)).tolist()
        columns = zip(_names(shown), means, covs, existence, ages_ns, coasting, pasts, strict=True)
        return tuple(Track(self._id(name), *column) for name, *column in columns)

    def _id(self, name: tuple[int, int]) -> int:
        number = self._ids.get(name)
        if number is None:
            number = self._ids[name] = self._next_id
            self._next_id += 1
            if len(self._ids) > MAX_REMEMBERED_IDS:
                self._forget_ids()
        return number

    def _forget_ids(self) -> None:
        """Drops the numbers of labels that no remembered state holds."""
        alive = {name for scan in self._ring for name in _names(scan.state.labels)}
        self._ids = {name: number for name, number in self._ids.items() if name in alive}
