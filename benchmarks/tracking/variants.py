"""What drives are tracked with: our stage with every sensor, with some, with a step left out; and other trackers.

The other trackers get the fused measurements that are likely people, of every sensor, made without their tracks.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from benchmarks.tracking import peers
from benchmarks.tracking.peers import Sort, StoneSoupPhd
from benchmarks.tracking.scenarios import Sensor
from replay.simulator.rig import campus_rig
from replay.time_sync import SyncedFrame
from schemas.messages import FloatArray, IntArray, Track
from tracking.camera import CameraModel
from tracking.fusion import fuse
from tracking.geometry import inverse
from tracking.measurements import Measurements, no_predicted_tracks
from tracking.pipeline import TrackingSettings, TrackingStage
from tracking.sensor_frame import SensorFrame
from tracking.tracker import LateScanError


class Step(NamedTuple):
    """What a tracker made of one scan, and the CPU seconds that took."""

    frame: SyncedFrame
    ids: IntArray  # (B,)
    positions_m: FloatArray  # (B, 2)
    fusion_s: float
    tracker_s: float


def arrays(tracks: Sequence[Track]) -> tuple[IntArray, FloatArray]:
    """Returns ids (B,) and positions (B, 2)."""
    places = np.array([track.state[:2] for track in tracks]).reshape(-1, 2)
    return np.array([track.id for track in tracks], np.int64), places


@dataclass(frozen=True)
class Variant:
    """The tracking stage with something changed."""

    name: str
    settings: dict[str, object] = field(default_factory=dict)  # "fusion.p_box" -> value
    frame: Callable[[SensorFrame], SensorFrame] = lambda frame: frame
    patch: Callable[[], AbstractContextManager[object]] = nullcontext

    def make_settings(self) -> TrackingSettings:
        """Returns the settings, checked."""
        values = TrackingSettings().model_dump()
        for name, value in self.settings.items():
            *groups, last = name.split(".")
            group = values
            for each in groups:
                group = group[each]
            if last not in group:
                raise KeyError(name)
            group[last] = value
        return TrackingSettings.model_validate(values)

    def track(self, frames: Iterable[SyncedFrame]) -> Iterator[Step]:
        """Yields what the stage makes of each scan; late ones amend it."""
        stage, timed = TrackingStage(self.make_settings()), _TimedFuse()
        with self.patch(), mock.patch("tracking.pipeline.fuse", timed):
            for frame in frames:
                sensors = self.frame(frame.sensors)
                if frame.late:
                    with suppress(LateScanError):  # too late to change anything
                        stage.amend(sensors)
                    continue
                timed.spent_s, start = 0.0, time.process_time()
                tracks = stage.step(sensors).tracks
                spent_s = time.process_time() - start
                yield Step(frame, *arrays(tracks), timed.spent_s, spent_s - timed.spent_s)


class _TimedFuse:
    """`fuse`, which adds up the CPU seconds of its calls."""

    spent_s = 0.0

    def __call__(self, *arguments: Any) -> Measurements:
        start = time.process_time()
        measurements = fuse(*arguments)
        self.spent_s += time.process_time() - start
        return measurements


@dataclass(frozen=True)
class PeerVariant:
    """Another tracker in the place of ours, on the same measurements; it is told the LiDAR's place and cannot amend."""

    name: str
    make: Callable[[Sensor, Any], peers.Peer]
    params: peers.SortParams | peers.StoneSoupParams

    def track(self, frames: Iterable[SyncedFrame]) -> Iterator[Step]:
        """Yields what the peer makes of each scan but the late ones."""
        peer, timed, params = self.make(DRIVE_SENSOR, self.params), _TimedFuse(), TrackingSettings().fusion
        for frame in frames:
            if frame.late:
                continue
            sensors, timed.spent_s = frame.sensors, 0.0
            measurements = timed(sensors, no_predicted_tracks(), params)
            likely = measurements.pedestrian_probability >= LEAST_PROBABILITY
            start = time.process_time()
            ids, positions = peer.step(
                measurements.positions_m[likely], sensors.stamp_ns, sensors.map_from_lidar[:2, 3]
            )
            yield Step(frame, ids, positions, timed.spent_s, time.process_time() - start)


def _without_cameras(frame: SensorFrame) -> SensorFrame:
    return replace(frame, cameras=())


def _without_clusters(frame: SensorFrame) -> SensorFrame:
    c = frame.clusters
    nothing = replace(c, centroids_m=c.centroids_m[:0], sizes_m=c.sizes_m[:0], points=c.points[:0])
    return replace(frame, clusters=nothing)


def _with_one_pose(frame: SensorFrame) -> SensorFrame:
    """Returns the frame as if every camera had taken its picture at the scan's stamp."""
    vehicle_from_camera = {camera.name: camera.vehicle_from_camera for camera in campus_rig().cameras}
    cameras = [
        replace(
            camera,
            camera_from_map=inverse(frame.map_from_vehicle @ vehicle_from_camera[camera.name]),
            detections=replace(camera.detections, stamp_ns=frame.stamp_ns),
        )
        for camera in frame.cameras
    ]
    return replace(frame, cameras=tuple(cameras))


def _with_pinholes(frame: SensorFrame) -> SensorFrame:
    """Returns the frame with the lenses' distortion left out of the projection."""
    return replace(frame, cameras=tuple(replace(c, model=_pinhole(c.model)) for c in frame.cameras))


def _pinhole(model: CameraModel) -> CameraModel:
    return replace(model, model="plumb_bob", distortion=np.zeros(4))


def _no_occlusion(targets_m: np.ndarray, _: object, occluders_m: np.ndarray, *__: object, **___: object) -> np.ndarray:
    return np.zeros((len(occluders_m), len(targets_m)))


def _nearest_first(rows: np.ndarray, columns: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Assigns greedily: the best pair, then the best of what is left."""
    kept = np.zeros(len(gains), bool)
    used_rows, used_columns = set(), set()
    for pair in np.argsort(-gains, kind="stable"):
        if rows[pair] not in used_rows and columns[pair] not in used_columns:
            kept[pair] = True
            used_rows.add(rows[pair])
            used_columns.add(columns[pair])
    return kept


SENSORS = (
    Variant("LiDAR and cameras"),
    Variant("LiDAR only", frame=_without_cameras),
    Variant("cameras only, births allowed", {"fusion.camera_births": True}, _without_clusters),
)
# What the peers are told of the sensors was tuned on the tuning drives, as their own settings were; people who stand
# behind others are detected less often than those in plain view.
# Stone Soup's filter knows no occlusion, so a low detection probability serves it best; SORT does not use it.
DRIVE_SENSOR = Sensor(half_m=50.0, dt_s=0.1, p_detect=0.4, sigma_m=0.1, clutter=5.0, cutoff_m=2.0)
LEAST_PROBABILITY = 0.45  # of being a person: the measurements that the peers get
PEERS = (
    PeerVariant("SORT on the same measurements", Sort, peers.SORT_DRIVES),
    PeerVariant(
        "Stone Soup's GM-PHD on the same measurements (k-d trees)", StoneSoupPhd, peers.STONE_SOUP_DRIVES_TREES
    ),
)
FUSION_STEPS = (
    Variant("one pose for all cameras, no track velocity", {"fusion.follow_track_m": 0.0}, _with_one_pose),
    Variant("pinhole projection", frame=_with_pinholes),
    Variant(
        "nobody hides anybody from a camera", patch=lambda: mock.patch("tracking.fusion.hidden_share", _no_occlusion)
    ),
    Variant(
        "boxes given to the best cluster first",
        patch=lambda: mock.patch("tracking.box_matching.assign", _nearest_first),
    ),
    Variant("a missing box proves nothing", {"fusion.p_box": 1e-6, "fusion.p_box_other": 1e-6}),
    Variant(
        "size proves nothing", {"fusion.max_width_m": 99.0, "fusion.max_height_m": 99.0, "fusion.pole_width_m": 0.0}
    ),
    Variant("no splitting of clusters", {"fusion.wide_for_two_m": 99.0}),
    Variant("no boxes without a cluster", {"fusion.camera_only": False}),
    Variant("births from a single box", {"fusion.camera_births": True}),
)
FILTER_STEPS = (
    Variant("several measurements per label", patch=lambda: mock.patch("tracking.gm_phd.own", _all_pairs)),
    Variant(
        "no occlusion in the detection probability",
        patch=lambda: mock.patch("tracking.visibility.hidden_share", _no_occlusion),
    ),
    Variant("no hidden state", {"tracker.hide_per_s": 0.0, "tracker.show_per_s": 0.0}),
    Variant("people are always seen apart", {"tracker.filter.resolution_m": 0.0}),
    Variant("people do not make way for each other", {"tracker.filter.avoidance_mps2": 0.0}),
    Variant("clutter as set, not counted", {"tracker.clutter_memory_s": 1e9}),
    Variant("one component per label", {"tracker.filter.components_per_label": 1}),
)
VARIANTS: tuple[Variant | PeerVariant, ...] = (*SENSORS, *PEERS, *FUSION_STEPS, *FILTER_STEPS)


def _all_pairs(labels: np.ndarray, pairs: object, weights: np.ndarray) -> np.ndarray:
    del labels, pairs
    return np.ones(len(weights), bool)
