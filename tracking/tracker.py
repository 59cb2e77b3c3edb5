"""The tracker: labels, existence, class and identity on top of the GM-PHD recursion. Measurements in, tracks out."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from schemas.messages import FloatArray, Track, TrackHistory
from tracking import gm_phd
from tracking.gm_phd import FilterParams
from tracking.measurements import Measurements, PredictedTracks, no_predicted_tracks
from tracking.mixture_reduction import GaussianMixture, concatenate, empty_mixture, label_mass, select
from tracking.motion_model import process_noise
from tracking.track_table import History, Labels, append, extend, new_labels, no_history, no_labels, take

DetectionProbability = Callable[[FloatArray], FloatArray] | float
MAX_CLASS_LOG_ODDS = 5.0
MAX_REMEMBERED_IDS = 10_000
SCANS_OF_ONE_STAMP = 1 << 20  # spacing of born_index between scans that share a stamp


class LateScanError(ValueError):
    """A scan older than the tracker can still take in."""


class TrackerParams(BaseModel):
    """Settings of the tracker. The defaults were tuned on the tuning seeds of benchmarks/tracking."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    filter: FilterParams = FilterParams()
    survival_s: float = Field(default=20.0, gt=0, description="mean time a person stays, where the sensors look")
    survival_unseen_s: float = Field(
        default=2.0, gt=0, description="and where they do not: without it ghosts never die"
    )
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
    hide_per_s: float = Field(default=0.05, ge=0, description="rate at which visible people become hidden")
    show_per_s: float = Field(default=1.0, ge=0, description="rate at which hidden people become visible again")
    class_memory_s: float = Field(default=2.0, gt=0, description="time constant of a track's class log-odds")
    pedestrian_probability: float = Field(
        default=0.4, gt=0, lt=1, description="tracks at least this likely are pedestrians"
    )
    birth_pedestrian_probability: float = Field(
        default=0.03, ge=0, lt=1, description="measurements below give no birth"
    )
    ring: int = Field(default=8, ge=1, description="how many scans back a late one can still be taken in")


@dataclass(frozen=True, eq=False)
class TrackerState:
    """Everything the tracker remembers after a scan. Never changed in place."""

    stamp_ns: int
    repeats: int  # how many scans just before had the same stamp
    mixture: GaussianMixture  # sorted by label row, the heaviest component first
    labels: Labels
    history: History


def initial_state(stamp_ns: int) -> TrackerState:
    """Returns what is known before the first scan, which has this stamp."""
    return TrackerState(stamp_ns, -1, empty_mixture(), no_labels(), no_history())


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
    predicted = gm_phd.predict(state.mixture, dt_s, params.filter)
    in_view = _probabilities(detection_probability, predicted.means[:, :2])
    lifetime_s = np.where(in_view > 0, params.survival_s, params.survival_unseen_s)
    predicted = replace(predicted, weights=predicted.weights * np.exp(-dt_s / lifetime_s))
    hidden = _predict_hidden(state.labels, dt_s, params)

    label_probability = 1 / (1 + np.exp(-state.labels.class_log_odds))
    p_detect = in_view * (1 - hidden[predicted.labels])
    correction = gm_phd.correct(
        predicted, measurements, p_detect=p_detect, label_probability=label_probability, params=params.filter
    )
    labels = _update_labels(
        state.labels, predicted, correction, measurements,
        hidden=hidden, in_view=in_view, stamp_ns=stamp_ns, dt_s=dt_s, params=params,
    )  # fmt: skip

    newborn = np.flatnonzero(
        (correction.births >= params.filter.prune_weight)
        & (measurements.pedestrian_probability >= params.birth_pedestrian_probability)
    )
    births = gm_phd.birth(measurements, newborn, correction.births[newborn], L + np.arange(len(newborn)), params.filter)
    labels = append(
        labels,
        new_labels(
            stamp_ns,
            newborn + repeats * SCANS_OF_ONE_STAMP,
            births.weights,
            _log_odds(measurements.pedestrian_probability[newborn]),
        ),
    )
    mixture = gm_phd.reduce(concatenate(correction.mixture, births), params.filter)
    return _settle(mixture, labels, state.history, old=L, stamp_ns=stamp_ns, repeats=repeats, params=params)


def _probabilities(detection_probability: DetectionProbability, positions_m: FloatArray) -> FloatArray:
    if callable(detection_probability):
        return np.minimum(np.maximum(detection_probability(positions_m), 0.0), 1.0)
    return np.full(len(positions_m), float(detection_probability))


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
    predicted: GaussianMixture,
    correction: gm_phd.Correction,
    measurements: Measurements,
    *,
    hidden: FloatArray,
    in_view: FloatArray,
    stamp_ns: int,
    dt_s: float,
    params: TrackerParams,
) -> Labels:
    """Bayes' rule per label for existence (a Bernoulli's), for being hidden, and for being a pedestrian."""
    L = len(labels)
    explained = correction.explained
    prior = np.minimum(label_mass(predicted, L), 1.0)
    absent = np.maximum(1 - prior, 1e-12)
    existence = 1 - absent / (absent + correction.missed_mass + explained / (1 - explained))

    visible = np.bincount(predicted.labels, predicted.weights * in_view, L) / np.maximum(prior, 1e-300)
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
    )


def _settle(
    mixture: GaussianMixture,
    labels: Labels,
    history: History,
    *,
    old: int,
    stamp_ns: int,
    repeats: int,
    params: TrackerParams,
) -> TrackerState:
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
    return TrackerState(stamp_ns, repeats, mixture, labels, history)


@dataclass(frozen=True, eq=False)
class _Scan:
    """One scan's inputs with the state after it, kept so that a late one can be put in before it."""

    measurements: Measurements
    stamp_ns: int
    detection_probability: DetectionProbability
    state: TrackerState


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
        state = self.state or initial_state(stamp_ns)
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
        self._ring.extend(kept[-self.params.ring :])

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

    def _publish(self, state: TrackerState) -> tuple[Track, ...]:
        labels, history, params = state.labels, state.history, self.params
        threshold = math.log(params.pedestrian_probability / (1 - params.pedestrian_probability))
        shown = labels.confirmed & (labels.existence >= params.publish_existence)
        rows = np.flatnonzero(shown & (labels.class_log_odds >= threshold))
        heaviest = np.searchsorted(state.mixture.labels, rows)
        means, covs = state.mixture.means[heaviest], state.mixture.covs[heaviest]
        first = np.searchsorted(history.stamps_ns, labels.born_ns[rows]).tolist()
        born_ns, born_index = labels.born_ns[rows].tolist(), labels.born_index[rows].tolist()
        existence = np.minimum(np.maximum(labels.existence[rows], 0.0), 1.0).tolist()
        unseen_ns = (state.stamp_ns - labels.last_hit_ns[rows]).tolist()
        coasting_after_ns = round(params.coasting_after_s * 1e9)
        tracks = []
        for i, row in enumerate(rows.tolist()):
            start = first[i]
            past = TrackHistory(history.stamps_ns[start:], history.states[row, start:], history.coasting[row, start:])
            tracks.append(
                Track(
                    self._id((born_ns[i], born_index[i])),
                    means[i],
                    covs[i],
                    existence[i],
                    state.stamp_ns - born_ns[i],
                    unseen_ns[i] > coasting_after_ns,
                    past,
                )
            )
        return tuple(tracks)

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
        states = [scan.state.labels for scan in self._ring]
        alive = {
            name for labels in states for name in zip(labels.born_ns.tolist(), labels.born_index.tolist(), strict=True)
        }
        self._ids = {name: number for name, number in self._ids.items() if name in alive}
