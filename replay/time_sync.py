"""Unsynchronised messages in, one `SensorFrame` per LiDAR scan out, in stamp order.

A scan is released when every camera in use, and the vehicle's pose, have passed it, or when log time has moved on by a
fixed wait. Only stamps and log times decide, so that the machine's speed changes nothing.
"""

import heapq
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Annotated, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from replay.errors import LogError, Refusals
from replay.pose_buffer import PoseBuffer
from replay.roles import Roles, time_offsets
from replay.stamp_guard import StampGuard, Verdict
from replay.transform_tree import TransformTree
from schemas.messages import (
    CameraCalibration,
    CameraDetections,
    CompressedImage,
    GroundTruthFrame,
    LidarClusters,
    ObjectTracks,
    PointCloud,
    TrackFrame,
    Transform,
    VehiclePose,
)
from tracking.camera import CalibrationError, CameraModel
from tracking.geometry import quaternion_of
from tracking.segmentation import SegmentationParams, segment
from tracking.sensor_frame import CameraFrame, SensorFrame

MAX_OFFSET_MS = 10_000.0

Stamped = TypeVar("Stamped", CameraDetections, CompressedImage)
Scan = LidarClusters | ObjectTracks | TrackFrame  # whatever gives a frame
OffsetMs = Annotated[float, Field(ge=-MAX_OFFSET_MS, le=MAX_OFFSET_MS, allow_inf_nan=False)]


class SyncSettings(BaseModel):
    """When a scan is released, and what may accompany it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    camera_tolerance_ms: float = Field(
        default=50, gt=0, description="largest gap between a scan and a camera's detections"
    )
    wait_ms: float = Field(
        default=300, ge=0, description="log time after which a scan is released whatever is still missing"
    )
    time_offset_ms: dict[str, OffsetMs] = Field(default={}, description="topic -> added to its messages' stamps")
    vehicle_frame: str = Field(default="base_link", description="of poses that do not name the frame they are of")
    odometry_frame: str | None = Field(
        default=None,
        description="where poses made of transforms are. None: odom if it is there, else the vehicle's root frame",
    )


@dataclass(frozen=True, eq=False)
class SyncedFrame:
    """One scan with everything around it, and when it was known."""

    log_time_ns: int  # of the message that released it
    epoch: int  # counts clock resets
    sensors: SensorFrame
    vehicle_state: NDArray[np.float64]  # (5,)  x, y, yaw, vx, vy in the odometry frame
    images: Mapping[str, CompressedImage]
    ground_truth: GroundTruthFrame | None
    late: bool = False  # its successors were released before it: it amends the tracks and gives no frame of its own
    objects: ObjectTracks | TrackFrame | None = None  # another tracker's tracks, in the place of clusters


@dataclass
class _Camera:
    """What one camera has sent lately."""

    detections: deque[CameraDetections] = field(default_factory=lambda: deque(maxlen=32))
    images: deque[CompressedImage] = field(default_factory=lambda: deque(maxlen=8))
    latest_ns: int = 0


class TimeSync:
    """Collects messages and releases frames: one per scan, be it clusters, points or another tracker's tracks.

    `push` and `flush` return the frames that became complete; refused messages go to `refusals`. `offsets_ns` (topic ->
    ns) is added to the stamps of what is pushed: the frames carry the corrected stamps. Transforms pushed on a
    `moving` topic say where the vehicle is.
    """

    def __init__(
        self,
        cameras: tuple[str, ...],
        settings: SyncSettings,
        refusals: Refusals,
        offsets_ns: Mapping[str, int] = MappingProxyType({}),
        moving: str | None = None,
        segmentation: SegmentationParams | None = None,
    ):
        self._settings = settings
        self._moving = moving
        self._segmentation = segmentation or SegmentationParams()
        self._tolerance_ns = int(settings.camera_tolerance_ms * 1e6)
        self._wait_ns = int(settings.wait_ms * 1e6)
        self._refusals = refusals
        self._offsets_ns = offsets_ns
        self._tree = TransformTree()
        self._models: dict[str, tuple[CameraModel, str]] = {}  # camera -> model, optical frame
        self._calibrations: dict[str, CameraCalibration] = {}
        self._camera_names = cameras
        self._awaited = cameras
        self._epoch = 0
        self._released_any = False
        self._last_log_time_ns = 0
        self._start_epoch(None)

    @classmethod
    def of(
        cls, roles: Roles, settings: SyncSettings, segmentation: SegmentationParams, refusals: Refusals
    ) -> "TimeSync":
        """Returns one for the topics in use."""
        offsets_ns = time_offsets(roles, settings.time_offset_ms)
        return cls(roles.cameras, settings, refusals, offsets_ns, roles.pose, segmentation)

    def _start_epoch(self, reference: tuple[int, int] | None) -> None:
        """Forgets everything that has a stamp; calibration and mounts stay."""
        self._reference = reference
        self._guards: dict[str, StampGuard] = {}
        self._cameras = {name: _Camera() for name in self._camera_names}
        self._poses = PoseBuffer()
        self._scans: list[tuple[int, int, Scan]] = []  # heap: stamp (each once), log time, scan
        self._seen_scans: deque[int] = deque(maxlen=64)
        self._ground_truth: deque[GroundTruthFrame] = deque(maxlen=64)
        self._last_released_ns = 0

    def take_static(self, topic: str, camera: str | None, message: object, refusals: Refusals) -> None:
        """Takes a calibration or transform; at the beginning of a log ahead of the stream, and then as they come."""
        if isinstance(message, Transform):
            self._tree.add(message)
        elif isinstance(message, CameraCalibration) and camera is not None:
            known = self._calibrations.get(camera)
            if known is not None and _same_camera(known, message):
                return  # logged again and again, and costly to set up
            try:
                self._models[camera] = (CameraModel.from_calibration(message), message.frame_id)
                self._calibrations[camera] = message
            except CalibrationError as error:
                refusals.add(topic, message.stamp_ns, "unusable calibration", str(error))

    def push(self, topic: str, camera: str | None, log_time_ns: int, message: object) -> Iterator[SyncedFrame]:
        """Takes the next message in log-time order; yields the frames it completes."""
        self._last_log_time_ns = max(self._last_log_time_ns, log_time_ns)
        if isinstance(message, Transform | CameraCalibration):
            self.take_static(topic, camera, message, self._refusals)
            message = self._moved(message) if isinstance(message, Transform) and topic == self._moving else None
        if message is not None:
            message = self._corrected(topic, message)
            stamp_ns: int = message.stamp_ns  # type: ignore[attr-defined]
            verdict = self._guard(topic).check(stamp_ns, log_time_ns)
            if verdict is Verdict.REFUSE:
                self._refusals.add(topic, stamp_ns, "absurd stamp", f"log time {log_time_ns / 1e9:.3f} s")
                return
            if isinstance(message, PointCloud):
                message = segment(message, self._segmentation)
            if verdict is Verdict.NEW_EPOCH:
                yield from self.flush()
                self._epoch += 1
                self._start_epoch((stamp_ns, log_time_ns))
                self._guard(topic).check(stamp_ns, log_time_ns)
            yield from self._take_stamped(topic, camera, log_time_ns, message)
        if self._scans:
            yield from self._release(lambda scan_ns, arrived_ns: self._complete(scan_ns) or self._waited(arrived_ns))

    def advance(self, log_time_ns: int) -> Iterator[SyncedFrame]:
        """Yields the frames that have waited long enough by a log time at which no message came."""
        self._last_log_time_ns = max(self._last_log_time_ns, log_time_ns)
        yield from self._release(lambda _, arrived_ns: self._waited(arrived_ns))

    def wait_for(self, cameras: tuple[str, ...]) -> None:
        """Lets scans wait for these cameras alone from now on; boxes of the others are used if they are there."""
        self._awaited = cameras

    def flush(self) -> Iterator[SyncedFrame]:
        """Yields what is still waiting, at the end of the log or of an epoch."""
        yield from self._release(lambda *_: True)

    def _moved(self, transform: Transform) -> VehiclePose | None:
        """Returns the vehicle's pose by the transforms known, if this one is the link of its chain that moves.

        Of several that move, it is the one nearest to the vehicle. Mounts in between say nothing new, and some stacks
        stamp them half a second ahead. The velocity is unknown.
        """
        vehicle = self._settings.vehicle_frame
        chain = self._tree.ancestors(vehicle)
        top = self._settings.odometry_frame or ("odom" if "odom" in chain else chain[-1])
        if top not in chain or transform.stamp_ns == 0:  # only static ones may have no stamp
            return None
        links = chain[: chain.index(top)]
        moving = [link for link in links if self._tree.moves(link)]
        if transform.child_frame_id not in (moving[:1] or links):
            return None
        pose = self._tree.transform(top, vehicle)
        assert pose is not None, "what is in one chain is joined"
        unknown = np.full(3, np.nan)
        return VehiclePose(transform.stamp_ns, top, vehicle, pose[:3, 3], quaternion_of(pose), unknown, unknown)

    def _corrected(self, topic: str, message: object) -> object:
        """Returns the message with its topic's time offset added to its stamp."""
        offset_ns = self._offsets_ns.get(topic, 0)
        if offset_ns == 0:
            return message
        return replace(message, stamp_ns=message.stamp_ns + offset_ns)  # type: ignore[type-var,attr-defined]

    def _guard(self, topic: str) -> StampGuard:
        return self._guards.setdefault(topic, StampGuard(self._reference))

    def _take_stamped(self, topic: str, camera: str | None, log_time_ns: int, message: object) -> Iterator[SyncedFrame]:
        if isinstance(message, CameraDetections) and camera in self._cameras:
            state = self._cameras[camera]
            state.detections.append(message)
            state.latest_ns = max(state.latest_ns, message.stamp_ns)
        elif isinstance(message, CompressedImage) and camera in self._cameras:
            self._cameras[camera].images.append(message)
        elif isinstance(message, VehiclePose):
            self._poses.add(message)
        elif isinstance(message, GroundTruthFrame):
            self._ground_truth.append(message)
        elif isinstance(message, LidarClusters | ObjectTracks | TrackFrame):
            if message.stamp_ns in self._seen_scans:
                self._refusals.add(topic, message.stamp_ns, "repeated scan")
                return
            self._seen_scans.append(message.stamp_ns)
            if message.stamp_ns < self._last_released_ns:
                late = self._synced(message)
                if late is not None:
                    yield replace(late, late=True)
                return
            heapq.heappush(self._scans, (message.stamp_ns, log_time_ns, message))

    def _complete(self, scan_ns: int) -> bool:
        cameras_due_ns = scan_ns + self._tolerance_ns
        return self._poses.latest_ns >= cameras_due_ns and all(
            self._cameras[name].latest_ns >= cameras_due_ns for name in self._awaited
        )

    def _waited(self, arrived_ns: int) -> bool:
        return self._last_log_time_ns >= arrived_ns + self._wait_ns

    def _release(self, due: Callable[[int, int], bool]) -> Iterator[SyncedFrame]:
        while self._scans and due(*self._scans[0][:2]):
            stamp_ns, _, scan = heapq.heappop(self._scans)
            frame = self._synced(scan)
            if frame is not None:
                self._last_released_ns = stamp_ns
                self._released_any = True
                yield frame

    def _synced(self, scan: Scan) -> SyncedFrame | None:
        """Joins a scan with poses, cameras, images and truth; refuses it if the vehicle's pose or mount is unknown."""
        chosen = {name: self._nearest(camera.detections, scan.stamp_ns) for name, camera in self._cameras.items()}
        detections = {name: found for name, found in chosen.items() if found is not None and name in self._models}
        stamps_ns = [scan.stamp_ns, *(found.stamp_ns for found in detections.values())]
        poses = self._poses.at(stamps_ns)
        if not poses.known[0]:
            self._refusals.add("scans", scan.stamp_ns, "no vehicle pose within 50 ms")
            return None
        pose = self._poses.nearest(scan.stamp_ns)
        vehicle_frame = pose.child_frame_id or self._settings.vehicle_frame
        map_from_vehicle = poses.map_from_vehicle[0]
        map_from_scan = self._map_from_scan(scan, pose.frame_id, vehicle_frame, map_from_vehicle)
        if map_from_scan is None:
            return None

        cameras = []
        vehicle_from_map = np.linalg.inv(poses.map_from_vehicle)  # (S, 4, 4)
        for (name, found), vehicle_from_map_then, known in zip(
            detections.items(), vehicle_from_map[1:], poses.known[1:], strict=True
        ):
            model, optical_frame = self._models[name]
            camera_from_vehicle = self._mount(found.frame_id or optical_frame, vehicle_frame, found.stamp_ns)
            if known and camera_from_vehicle is not None:
                cameras.append(CameraFrame(name, found, model, camera_from_vehicle @ vehicle_from_map_then))
        sensors = SensorFrame(
            scan.stamp_ns,
            scan if isinstance(scan, LidarClusters) else _no_clusters(scan),
            map_from_scan,
            map_from_vehicle,
            tuple(cameras),
            pose.frame_id,
            vehicle_frame,
            bool(poses.extrapolated[0]),
        )
        images = {name: self._nearest(camera.images, scan.stamp_ns) for name, camera in self._cameras.items()}
        truth = next((frame for frame in self._ground_truth if frame.stamp_ns == scan.stamp_ns), None)
        return SyncedFrame(
            self._last_log_time_ns,
            self._epoch,
            sensors,
            _vehicle_state(map_from_vehicle, self._poses.velocity(scan.stamp_ns)),
            {name: image for name, image in images.items() if image is not None},
            truth,
            objects=None if isinstance(scan, LidarClusters) else scan,
        )

    def _map_from_scan(
        self, scan: Scan, map_frame: str, vehicle_frame: str, map_from_vehicle: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """Returns (4, 4) from the scan's frame; None, the reason counted, if no transform joins it to the vehicle."""
        frame = scan.frame_id
        if not isinstance(scan, LidarClusters):  # others' tracks need not hang from the vehicle
            if frame == map_frame:
                return np.eye(4)
            if not self._tree.is_fixed(frame, vehicle_frame):
                return self._mount(map_frame, frame, scan.stamp_ns)
        mount = self._mount(vehicle_frame, frame, scan.stamp_ns)
        return None if mount is None else map_from_vehicle @ mount

    def _nearest(self, messages: deque[Stamped], stamp_ns: int) -> Stamped | None:
        """Returns the message nearest in time, within the tolerance; of equally near ones the older."""
        near = [m for m in messages if abs(m.stamp_ns - stamp_ns) <= self._tolerance_ns]
        return min(near, key=lambda m: (abs(m.stamp_ns - stamp_ns), m.stamp_ns), default=None)

    def _mount(self, target: str, source: str, stamp_ns: int) -> NDArray[np.float64] | None:
        transform = self._tree.transform(target, source)
        if transform is None:
            problem = f"no transform joins {target!r} and {source!r}"
            if not self._released_any:
                raise LogError(f"{problem}; the frames of /tf_static are {', '.join(self._tree.frames) or 'none'}")
            self._refusals.add("transforms", stamp_ns, problem)
        return transform


def _no_clusters(scan: ObjectTracks | TrackFrame) -> LidarClusters:
    none = np.zeros((0, 3))
    return LidarClusters(scan.stamp_ns, scan.frame_id, none, none, np.zeros(0, np.int64))


def _same_camera(a: CameraCalibration, b: CameraCalibration) -> bool:
    return (a.frame_id, a.width_px, a.height_px, a.model) == (b.frame_id, b.width_px, b.height_px, b.model) and (
        np.array_equal(a.distortion, b.distortion) and np.array_equal(a.intrinsics_px, b.intrinsics_px)
    )


def _vehicle_state(map_from_vehicle: NDArray[np.float64], velocity_mps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns [x, y, yaw, vx, vy] (5,) in the odometry frame."""
    yaw = np.arctan2(map_from_vehicle[1, 0], map_from_vehicle[0, 0])
    return np.array([*map_from_vehicle[:2, 3], yaw, *velocity_mps])
