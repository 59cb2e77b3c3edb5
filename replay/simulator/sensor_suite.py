"""All simulated sensors on one vehicle: when each looks, what it sees, and when its messages reach the log."""

import heapq
from collections.abc import Iterator
from itertools import count, groupby
from typing import NamedTuple

import numpy as np

from replay import foxglove
from replay.simulator.detector_model import SimulatedDetector
from replay.simulator.lidar_model import SimulatedLidar
from replay.simulator.motion import Motion, MotionSampler, Scene
from replay.simulator.odometry_model import SimulatedOdometry
from replay.simulator.point_cloud import SimulatedPoints
from replay.simulator.rig import ODOMETRY_FRAME, Rig
from replay.simulator.sensor_model import SensorModelV1
from replay.simulator.visibility import Objects, ObjectTable
from schemas import codec
from schemas.messages import CameraCalibration, GroundTruthFrame, Transform

NS_PER_S = 1_000_000_000
START_NS = 1_583_114_400 * NS_PER_S  # 2020-03-02T02:00:00Z
CLUSTERS_TOPIC = "/velodyne/front/clusters"
POINTS_TOPIC = "/velodyne/front/points"
ODOMETRY_TOPIC = "/vn100/odometry"
TF_TOPIC, TF_STATIC_TOPIC = "/tf", "/tf_static"
GROUND_TRUTH_TOPIC = "/simulation/ground_truth"
_BLOCK_NS = 1_000_000_000  # images of one camera are simulated by the block
_CALIBRATION_PERIOD_S = 1.0
_TRUTH_DELAY_NS = 1_000_000
_TF_EVERY = 3  # odometry messages


class Logged(NamedTuple):
    """A message on its way to the log, ordered by when it gets there and then by when it was made."""

    log_time_ns: int
    order: int
    topic: str
    data: bytes


class _Tick(NamedTuple):
    """One time at which a sensor looks."""

    stamp_ns: int
    sensor: str  # a camera's name, "lidar", "odometry" or "calibration"
    number: int


class SensorSuite:
    """Turns a motion into messages. Each sensor has randomness of its own: none depends on what another does."""

    def __init__(
        self, motion: Motion, duration_s: float, seed: int, model: SensorModelV1, rig: Rig, *, points: bool = False
    ):
        self.scans = 0
        self.people: set[int] = set()  # everybody within the ground truth's range so far
        self.rig = rig
        self.has_points = points
        self._model = model
        self._duration_s = duration_s
        self._sampler = MotionSampler(motion)
        self._objects = ObjectTable(model, seed)
        self._order = count()
        sensors = ["lidar", "odometry", *(camera.name for camera in rig.cameras)]
        self._stamp_rngs = {sensor: np.random.default_rng([seed, 10, i]) for i, sensor in enumerate(sensors)}
        self._delay_rngs = {sensor: np.random.default_rng([seed, 11, i]) for i, sensor in enumerate(sensors)}
        rngs = {sensor: np.random.default_rng([seed, 12, i]) for i, sensor in enumerate(sensors)}
        self._lidar = SimulatedLidar(rig.vehicle_from_lidar, model, rngs["lidar"])
        self._points = SimulatedPoints(rig.vehicle_from_lidar, model, np.random.default_rng([seed, 13]))
        self._odometry = SimulatedOdometry(model, rngs["odometry"])
        self._detectors = {c.name: SimulatedDetector(c, model, rngs[c.name]) for c in rig.cameras}

    def logged(self) -> Iterator[Logged]:
        """Yields all messages in order of log time; messages of one log time as they were made."""
        static = foxglove.encode(self.rig.static_transforms(START_NS))
        pending = [self._message(START_NS, TF_STATIC_TOPIC, static)]
        for number, block in groupby(heapq.merge(*self._ticks()), key=_block_of):
            while pending and pending[0].log_time_ns <= START_NS + number * _BLOCK_NS:
                yield heapq.heappop(pending)  # nothing that is still to come can be logged before the block begins
            for message in self._messages(list(block)):
                heapq.heappush(pending, message)
        while pending:
            yield heapq.heappop(pending)

    # --- when --------------------------------------------------------------------------------------------------------

    def _ticks(self) -> list[Iterator[_Tick]]:
        """Returns each sensor's ticks; no two sensors are in step."""
        model = self._model
        cameras = [
            self._regular(name, model.camera_rate_hz, 0.02 + 0.0047 * i) for i, name in enumerate(self._detectors)
        ]
        return [
            self._calibrations(),
            self._regular("odometry", model.odometry_rate_hz, 0.002),
            self._regular("lidar", model.lidar_rate_hz, 0.05),
            *cameras,
        ]

    def _regular(self, sensor: str, rate_hz: float, phase_s: float) -> Iterator[_Tick]:
        """Yields the ticks of a sensor at a rate, with jitter, until the drive ends."""
        rng, jitter = self._stamp_rngs[sensor], self._model.stamp_jitter_sd_s
        for number in count():
            time_s = phase_s + number / rate_hz + jitter * max(-4.0, min(4.0, rng.standard_normal()))
            if time_s > self._duration_s:
                return
            yield _Tick(START_NS + round(time_s * NS_PER_S), sensor, number)

    def _calibrations(self) -> Iterator[_Tick]:
        for number in range(int(self._duration_s / _CALIBRATION_PERIOD_S) + 1):
            yield _Tick(START_NS + round(number * _CALIBRATION_PERIOD_S * NS_PER_S), "calibration", number)

    def _arrival_ns(self, tick: _Tick, delay_s: float, jitter_s: float) -> int:
        """Returns when a tick's message reaches the log."""
        late_s = delay_s + jitter_s * float(self._delay_rngs[tick.sensor].beta(2, 3))
        return tick.stamp_ns + round(late_s * NS_PER_S)

    # --- what --------------------------------------------------------------------------------------------------------

    def _messages(self, ticks: list[_Tick]) -> Iterator[Logged]:
        """Yields the messages of a block of ticks, in no order."""
        images: dict[str, list[tuple[_Tick, Scene, Objects]]] = {name: [] for name in self._detectors}
        for tick in ticks:
            time_s = (tick.stamp_ns - START_NS) / NS_PER_S
            if tick.sensor == "calibration":
                yield from self._calibration_messages(tick)
            elif tick.sensor == "odometry":
                yield from self._odometry_messages(tick, time_s)
            else:
                scene = self._sampler.at(time_s)
                objects = self._objects.objects(scene)
                if tick.sensor == "lidar":
                    yield from self._lidar_messages(tick, scene, objects)
                else:
                    images[tick.sensor].append((tick, scene, objects))
        for name, taken in images.items():
            if taken:
                yield from self._camera_messages(name, *zip(*taken, strict=True))

    def _calibration_messages(self, tick: _Tick) -> Iterator[Logged]:
        for camera in self.rig.cameras:
            c = camera.calibration
            stamped = CameraCalibration(
                tick.stamp_ns, c.frame_id, c.width_px, c.height_px, c.model, c.distortion, c.intrinsics_px
            )
            yield self._message(tick.stamp_ns, f"/gmsl/{camera.name}/camera_info", foxglove.encode(stamped))

    def _odometry_messages(self, tick: _Tick, time_s: float) -> Iterator[Logged]:
        model = self._model
        pose = self._odometry.pose(self._sampler.vehicle_at(time_s), time_s, tick.stamp_ns)
        arrival_ns = self._arrival_ns(tick, model.odometry_delay_s, model.odometry_delay_jitter_s)
        yield self._message(arrival_ns, ODOMETRY_TOPIC, codec.encode(pose))
        if tick.number % _TF_EVERY == 0:
            transform = Transform(
                tick.stamp_ns, pose.frame_id, pose.child_frame_id, pose.position_m, pose.quaternion_xyzw
            )
            yield self._message(arrival_ns, TF_TOPIC, foxglove.encode((transform,)))

    def _lidar_messages(self, tick: _Tick, scene: Scene, objects: Objects) -> Iterator[Logged]:
        model, people = self._model, scene.people
        scan = self._lidar.scan(scene, objects, tick.stamp_ns)
        near = np.linalg.norm(people.positions_m - scene.vehicle.position_m, axis=1) < model.truth_range_m
        truth = GroundTruthFrame(
            tick.stamp_ns,
            ODOMETRY_FRAME,
            people.ids[near],
            people.positions_m[near],
            people.velocities_mps[near],
            scan.person_points[near],
        )
        self.scans += 1
        self.people.update(people.ids[near].tolist())
        arrival_ns = self._arrival_ns(tick, model.lidar_delay_s, model.lidar_delay_jitter_s)
        yield self._message(tick.stamp_ns + _TRUTH_DELAY_NS, GROUND_TRUTH_TOPIC, codec.encode(truth))
        if self.has_points:  # they arrive with the clusters, so that a log of either alone is released alike
            cloud = self._points.scan(scene, objects, tick.stamp_ns)
            yield self._message(arrival_ns, POINTS_TOPIC, foxglove.encode(cloud))
        yield self._message(arrival_ns, CLUSTERS_TOPIC, codec.encode(scan.clusters))

    def _camera_messages(
        self, name: str, ticks: tuple[_Tick, ...], scenes: tuple[Scene, ...], objects: tuple[Objects, ...]
    ) -> Iterator[Logged]:
        model = self._model
        detections = self._detectors[name].detect(scenes, objects, [tick.stamp_ns for tick in ticks])
        for tick, found in zip(ticks, detections, strict=True):
            arrival_ns = self._arrival_ns(tick, model.camera_delay_s, model.camera_delay_jitter_s)
            if self._delay_rngs[name].random() >= model.p_camera_drops_frame:
                yield self._message(arrival_ns, f"/gmsl/{name}/detections", codec.encode(found))

    def _message(self, log_time_ns: int, topic: str, data: bytes) -> Logged:
        return Logged(log_time_ns, next(self._order), topic, data)


def _block_of(tick: _Tick) -> int:
    return (tick.stamp_ns - START_NS) // _BLOCK_NS
