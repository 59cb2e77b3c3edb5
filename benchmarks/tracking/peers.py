"""The trackers that are compared, behind one interface: ours, Stone Soup's GM-PHD filter, and SORT built on filterpy.

All of them are told the sensor: detection probability, noise and time step. Stone Soup is told the clutter, too, which
SORT has no use for, and which ours counts for itself. What else they need was tuned on the tuning seeds, and for
the drives on the tuning drives, for OSPA and HOTA together; ours keeps its defaults on crowds and drives.
"""

import datetime
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.optimize import linear_sum_assignment
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser, GaussianMixtureKDTreeHypothesiser
from stonesoup.measures import Mahalanobis
from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.state import TaggedWeightedGaussianState
from stonesoup.updater.kalman import KalmanUpdater
from stonesoup.updater.pointprocess import PHDUpdater

from benchmarks.tracking.scenarios import Sensor
from schemas.messages import FloatArray, IntArray
from tracking.gm_phd import FilterParams
from tracking.measurements import make_measurements
from tracking.motion_model import process_noise, transition
from tracking.tracker import Tracker, TrackerParams

ORIGIN_M = np.zeros(2)


class Peer(Protocol):
    """A tracker: measured positions in, tracks out."""

    def step(
        self, measured_m: FloatArray, stamp_ns: int, origin_m: FloatArray = ORIGIN_M
    ) -> tuple[IntArray, FloatArray]:
        """Takes in one scan's positions (M, 2), measured around `origin_m`.

        Returns ids (B,) and positions (B, 2) of the tracks after it.
        """


# --- ours -------------------------------------------------------------------------------------------------------------

OURS_CROWD = TrackerParams()
OURS_VO_MA = TrackerParams(
    filter=FilterParams(
        acceleration_mps2=5.0,
        clutter_per_m2=12.5e-6,
        birth_per_m2=2e-8,
        birth_speed_mps=12.0,
        survival_s=100.0,  # p_S = 0.99 a step
    ),
    hide_per_s=0.0,  # nothing here stands behind something
)
# The paths are straight, so less process noise than the paper's 5 m/s^2 serves every tracker.
OURS_VO_MA_TUNED = OURS_VO_MA.model_copy(
    update={"filter": OURS_VO_MA.filter.model_copy(update={"acceleration_mps2": 0.5})}
)


class Ours:
    """`tracking.tracker.Tracker`, which makes its own measurements of the positions."""

    def __init__(self, sensor: Sensor, params: TrackerParams) -> None:
        self._sensor, self._tracker = sensor, Tracker(params)

    def step(
        self,
        measured_m: FloatArray,
        stamp_ns: int,
        origin_m: FloatArray = ORIGIN_M,  # noqa: ARG002  births happen at the measurements
    ) -> tuple[IntArray, FloatArray]:
        """See `Peer`."""
        measurements = make_measurements(measured_m, np.eye(2) * self._sensor.sigma_m**2)
        tracks = self._tracker.step(measurements, stamp_ns, self._sensor.p_detect)
        ids = np.array([track.id for track in tracks], np.int64)
        return ids, np.array([track.state[:2] for track in tracks]).reshape(-1, 2)


# --- Stone Soup -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StoneSoupParams:
    """Settings of Stone Soup's GM-PHD filter. Births are broad Gaussians around the sensor that cover the region."""

    acceleration_mps2: float
    birth_weight: float  # people per scan and birth component
    birth_sigma_m: float
    birth_speed_mps: float
    p_survive: float
    birth_places_m: tuple[tuple[float, float], ...] = ((0.0, 0.0),)  # as seen from the sensor
    gate: float = 4.0  # Mahalanobis distance
    prune_weight: float = 1e-4
    merge_distance: float = 8.0  # squared Mahalanobis distance
    components: int = 1000
    shown_weight: float = 0.5
    # Its k-d trees, a coarse gate: measurements within this many variances (m), components within a distance (m).
    tree_variances: float | None = None
    tree_distance_m: float | None = None


STONE_SOUP_CROWD = StoneSoupParams(1.0, 0.1, 25.0, 0.7, 0.995, prune_weight=1e-3)
STONE_SOUP_CROWD_TREES = replace(STONE_SOUP_CROWD, tree_variances=40.0, tree_distance_m=2.0)
STONE_SOUP_DRIVES_TREES = replace(STONE_SOUP_CROWD_TREES, birth_speed_mps=1.0, gate=3.0, prune_weight=1e-4)
# The paper's own births, at two places; what is spawned elsewhere has to split off a component of its parent.
STONE_SOUP_VO_MA = StoneSoupParams(
    5.0, 0.1, 10.0, 5.0, 0.99, birth_places_m=((250.0, 250.0), (-250.0, -250.0)), merge_distance=16.0
)
STONE_SOUP_VO_MA_TUNED = replace(STONE_SOUP_VO_MA, acceleration_mps2=2.0)


class StoneSoupPhd:
    """Stone Soup's components put together as in its own GM-PHD example; a track's id stands for its tag."""

    def __init__(self, sensor: Sensor, params: StoneSoupParams) -> None:
        self._params = params
        motion = LinearGaussianTimeInvariantTransitionModel(
            transition_matrix=transition(sensor.dt_s),
            covariance_matrix=process_noise(sensor.dt_s, params.acceleration_mps2),
        )
        predictor = KalmanPredictor(motion)
        self._model = LinearGaussian(4, (0, 1), np.eye(2) * sensor.sigma_m**2)  # state x, y, vx, vy
        updater = KalmanUpdater(self._model)
        pairs = DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=params.gate)
        if params.tree_variances is None:
            self._hypothesiser = GaussianMixtureHypothesiser(pairs, order_by_detection=True)
        else:
            self._hypothesiser = GaussianMixtureKDTreeHypothesiser(
                pairs,
                predictor=predictor,
                updater=updater,
                max_distance_covariance_multiplier=params.tree_variances,
                order_by_detection=True,
            )
        self._updater = PHDUpdater(
            updater, sensor.clutter_per_m2, prob_detection=sensor.p_detect, prob_survival=params.p_survive
        )
        self._reducer = GaussianMixtureReducer(
            prune_threshold=params.prune_weight,
            merge_threshold=params.merge_distance,
            max_number_components=params.components,
            kdtree_max_distance=params.tree_distance_m,
        )
        self._components: list[TaggedWeightedGaussianState] = []
        self._ids: dict[str, int] = {}

    def step(
        self, measured_m: FloatArray, stamp_ns: int, origin_m: FloatArray = ORIGIN_M
    ) -> tuple[IntArray, FloatArray]:
        """See `Peer`."""
        params = self._params
        now = datetime.datetime(2020, 1, 1) + datetime.timedelta(microseconds=stamp_ns / 1e3)
        detections = {Detection(z[:, None], timestamp=now, measurement_model=self._model) for z in measured_m}
        births = [
            TaggedWeightedGaussianState(
                np.array([[origin_m[0] + x], [origin_m[1] + y], [0.0], [0.0]]),
                np.diag([params.birth_sigma_m**2] * 2 + [params.birth_speed_mps**2] * 2),
                weight=params.birth_weight,
                tag=TaggedWeightedGaussianState.BIRTH,
                timestamp=now,
            )
            for x, y in params.birth_places_m
        ]
        hypotheses = self._hypothesiser.hypothesise(self._components + births, detections, now)
        self._components = self._reducer.reduce(list(self._updater.update(hypotheses)))
        shown = [component for component in self._components if component.weight > params.shown_weight]
        ids = np.array([self._ids.setdefault(component.tag, len(self._ids)) for component in shown], np.int64)
        return ids, np.array([component.mean[:2, 0] for component in shown], float).reshape(-1, 2)


# --- SORT -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SortParams:
    """Settings of SORT."""

    acceleration_mps2: float
    birth_speed_mps: float
    gate: float  # Mahalanobis distance
    min_hits: int  # a track is shown from this measurement on
    max_age: int  # and forgotten after more scans than this without one


SORT_CROWD = SortParams(1.0, 0.8, gate=5.0, min_hits=4, max_age=5)
SORT_DRIVES = SortParams(1.0, 0.7, gate=5.0, min_hits=2, max_age=6)
SORT_VO_MA = SortParams(5.0, 5.0, gate=3.0, min_hits=4, max_age=1)
SORT_VO_MA_TUNED = replace(SORT_VO_MA, acceleration_mps2=2.0)


@dataclass(eq=False)
class _Sorted:
    """One of SORT's tracks."""

    id: int
    filter: KalmanFilter = field(repr=False)
    hits: int = 1
    unseen: int = 0


class Sort:
    """Bewley et al., "Simple online and realtime tracking" (2016) for points: filterpy's Kalman filters and Hungarian.

    Kinder than the original: the gate is a Mahalanobis distance, and a track is still shown while it is not forgotten.
    """

    def __init__(self, sensor: Sensor, params: SortParams) -> None:
        self._sensor, self._params = sensor, params
        self._tracks: list[_Sorted] = []
        self._next_id = 1

    def step(
        self,
        measured_m: FloatArray,
        stamp_ns: int,  # noqa: ARG002  steps are equal
        origin_m: FloatArray = ORIGIN_M,  # noqa: ARG002  every measurement without a track starts one
    ) -> tuple[IntArray, FloatArray]:
        """See `Peer`."""
        for track in self._tracks:
            track.filter.predict()
            track.unseen += 1
        rows, columns = self._associate(measured_m)
        for row, column in zip(rows, columns, strict=True):
            track = self._tracks[row]
            track.filter.update(measured_m[column])
            track.hits, track.unseen = track.hits + 1, 0
        new = np.ones(len(measured_m), bool)
        new[columns] = False
        self._tracks += [self._start(position) for position in measured_m[new]]
        self._tracks = [track for track in self._tracks if track.unseen <= self._patience(track)]
        shown = [track for track in self._tracks if track.hits >= self._params.min_hits]
        ids = np.array([track.id for track in shown], np.int64)
        return ids, np.array([track.filter.x[:2, 0] for track in shown]).reshape(-1, 2)

    def _patience(self, track: _Sorted) -> int:
        return self._params.max_age if track.hits >= self._params.min_hits else 0

    def _associate(self, measured_m: FloatArray) -> tuple[IntArray, IntArray]:
        """Returns rows of tracks and of measurements that belong together, with the least sum of squared distances."""
        if not self._tracks or len(measured_m) == 0:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        means = np.array([track.filter.x[:2, 0] for track in self._tracks])
        covs = np.array([track.filter.P[:2, :2] for track in self._tracks]) + np.eye(2) * self._sensor.sigma_m**2
        apart = measured_m[None] - means[:, None]  # (B, M, 2)
        squared = (apart @ np.linalg.inv(covs) * apart).sum(axis=2)
        limit = self._params.gate**2
        rows, columns = linear_sum_assignment(np.minimum(squared, limit))
        near = squared[rows, columns] < limit
        return rows[near], columns[near]

    def _start(self, position_m: FloatArray) -> _Sorted:
        sensor, params = self._sensor, self._params
        filter = KalmanFilter(dim_x=4, dim_z=2)
        filter.x[:2, 0] = position_m
        filter.F = transition(sensor.dt_s)
        filter.H = np.eye(2, 4)
        filter.Q = process_noise(sensor.dt_s, params.acceleration_mps2)
        filter.R = np.eye(2) * sensor.sigma_m**2
        filter.P = np.diag([sensor.sigma_m**2] * 2 + [params.birth_speed_mps**2] * 2)
        self._next_id += 1
        return _Sorted(self._next_id - 1, filter)
