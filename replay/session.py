"""A replay from files to frame results: `for frame in replay("drive.mcap"): ...`."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field
from threadpoolctl import threadpool_limits

from replay.class_labels import ClassLabels
from replay.decoders import decoders_for
from replay.errors import LogError, Refusals
from replay.frame_result import FrameResult
from replay.log_reader import LogReader
from replay.logged_message import RawMessage
from replay.object_tracks import ObjectTracksParams
from replay.pacing import Pacer
from replay.pipeline import FrameStage, FrameTracker, TrackFollower, run_pipeline
from replay.remote_predictor import AskedPredictor, InlinePredictor, RemotePredictor
from replay.roles import (
    WHAT,
    Reading,
    RoleChoices,
    Roles,
    assign_roles,
    decoded,
    listed,
    static_only,
    time_offsets,
)
from replay.stage_clock import StageClock
from replay.time_sync import SyncedFrame, SyncSettings, TimeSync
from replay.transform_tree import TransformTree
from schemas.codec import CodecError
from schemas.messages import LidarClusters, PointCloud, Transform, VehiclePose
from tracking.pipeline import TrackingSettings
from tracking.segmentation import SegmentationParams

WARM_UP_NS = 4_000_000_000  # what the tracker sees, unpublished, before --start
LEAD_IN_NS = 1_000_000_000  # poses and boxes from before the first scan
STATIC_SEARCH_NS = 10_000_000_000  # how far into a log its transforms and calibrations are looked for
PredictorMode = Literal["spawned", "external", "inline"]


class ReplaySettings(BaseModel):
    """Everything that changes results; attached to every output."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    start_s: float = Field(default=0, ge=0, le=1e9, description="seconds after the log's first message")
    duration_s: float | None = Field(default=None, gt=0, le=1e9, description="None: to the end of the log")
    roles: RoleChoices = RoleChoices()
    sync: SyncSettings = SyncSettings()
    segmentation: SegmentationParams = SegmentationParams()  # of logs that hold points instead of clusters
    tracking: TrackingSettings = TrackingSettings()
    object_tracks: ObjectTracksParams = ObjectTracksParams()  # of logs that hold another tracker's tracks


@dataclass(frozen=True)
class PredictorChoice:
    """Which predictor answers, and where; changes no result but through its weights."""

    mode: PredictorMode = "spawned"
    model: str | Path | None = None  # name of a shipped model, or a file; None: the default
    connect: str | None = None  # endpoint of an external predictor
    zenoh_config: Path | None = None
    namespace: str = ""

    def start(self) -> AskedPredictor:
        """Returns a predictor that is ready to answer; raises PredictorError."""
        if self.mode == "inline":
            return InlinePredictor(self.model)
        if self.mode == "external":
            return RemotePredictor.external(self.connect, self.zenoh_config, self.namespace)
        return RemotePredictor.spawned(self.model)


class Replay:
    """One run over one log. Entering starts the predictor; iterating yields results; leaving ends the predictor.

    With `images`, results carry the logged camera images nearest each scan; they are not read otherwise.

    Raises LogError before anything is started if the log cannot be used.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        settings: ReplaySettings | None = None,
        predictor: PredictorChoice | None = None,
        *,
        window: int = 8,
        rate: float | None = None,
        strict: bool = False,
        salvage: bool = False,
        images: bool = False,
    ):
        if window < 1:
            raise ValueError(f"a window holds at least one frame, got {window}")
        self.settings = settings or ReplaySettings()
        self.refusals = Refusals(strict=strict)
        self.clock = StageClock()
        self.labels = ClassLabels(self.settings.tracking.fusion.pedestrian_labels)
        self.reader = LogReader(paths, salvage=salvage)
        self.roles = assign_roles(self.reader.channels, self.settings.roles, partial(frame_named, self.reader))
        self.offsets_ns = time_offsets(self.roles, self.settings.sync.time_offset_ms)
        self.start_ns = self.reader.start_ns + round(self.settings.start_s * 1e9)
        self.end_ns = self.reader.end_ns + 1
        if self.settings.duration_s is not None:
            self.end_ns = min(self.end_ns, self.start_ns + round(self.settings.duration_s * 1e9))
        if self.start_ns >= self.end_ns:
            length_s = (self.reader.end_ns - self.reader.start_ns) / 1e9
            raise LogError(f"nothing to replay from {self.settings.start_s:g} s: the log lasts {length_s:.1f} s")
        self._static = self._read_static()
        self._mounts = self._find_mounts()
        self._choice = predictor or PredictorChoice()
        self._images = images
        self._window = window
        self._pacer = Pacer(rate)
        self._predictor: AskedPredictor | None = None

    def _find_mounts(self) -> tuple[str, ...]:
        """Returns the topics whose transforms say where the sensors are: those of static ones, or all if these do not.

        Raises LogError unless they join the frames of the LiDAR and of the cameras to the vehicle's, within the log's
        first seconds.
        """
        roles, sync = self.roles, self.settings.sync
        every = roles.topics("transforms")
        tree, vehicle = TransformTree(), sync.vehicle_frame
        static = static_only(every)
        for transform in self._transforms(set(static)):
            tree.add(transform)
        named = False
        if self._pose_is_transforms:
            for transform in self._transforms({roles.pose, *every}):
                tree.add(transform)
            if len(tree.ancestors(vehicle)) < 2:
                raise LogError(
                    f"no transform on {roles.pose} moves {vehicle!r}; its frames are {listed(tree.frames)}; "
                    "set sync.vehicle_frame, or choose another topic with --role pose:=TOPIC"
                )
        else:
            refusals = Refusals()
            poses = (each for each in self._first_of(roles.pose, refusals) if isinstance(each, VehiclePose))
            if (pose := next(poses, None)) is None:
                raise LogError(f"no message on {roles.pose} says where the vehicle is: {refusals.first[0]}")
            named = bool(pose.child_frame_id)
            vehicle = pose.child_frame_id or vehicle
        scan = next(self._first_of(roles.scans), None)
        if not isinstance(scan, LidarClusters | PointCloud):
            return every
        mounts, topic_of = tuple(static), {scan.frame_id: roles.scans} | self._camera_frames()
        if any(tree.transform(vehicle, frame) is None for frame in topic_of):
            mounts = every
            for transform in self._transforms(set(every)):
                tree.add(transform)
        for frame, topic in topic_of.items():
            if tree.transform(vehicle, frame) is None:
                raise LogError(
                    f"no transform joins {vehicle!r} and {frame!r}, the frame of {topic}; the frames of "
                    f"{' and '.join(every) or 'the transforms'} are {listed(tree.frames)}"
                    + ("" if named else "; set sync.vehicle_frame if the vehicle's frame is another one")
                )
        if scan.frame_id in tree.ancestors(vehicle) and not tree.is_fixed(scan.frame_id, vehicle):
            raise LogError(
                f"{roles.scans} is in {scan.frame_id!r}, in which the vehicle moves: {WHAT[roles.scan_role]} must be "
                "in a frame that is fixed to the vehicle; another tracker's tracks go with --tracks TOPIC"
            )
        return mounts

    def _camera_frames(self) -> dict[str, str]:
        """Returns the frame of each camera, and its topic: what its boxes name, else its calibration."""
        topic_of = {}
        for camera in self.roles.cameras:
            for topic in self.roles.topics("camera", "calibration", camera=camera):
                message = next(self._first_of(topic), None)
                if frame := getattr(message, "frame_id", ""):
                    topic_of[frame] = topic
                    break
        return topic_of

    @property
    def _pose_is_transforms(self) -> bool:
        channels = (channel for channel in self.reader.channels if channel.topic == self.roles.pose)
        ways = (way for channel in channels for way in decoders_for(channel.schema, channel.encoding))
        return all(way.message != "VehiclePose" for way in ways)

    def _transforms(self, topics: set[str]) -> Iterator[Transform]:
        """Yields the transforms of some topics in the log's first seconds."""
        for message in self._static:
            if message.topic in topics:
                for each in self._decoded(message, Refusals()):
                    if isinstance(each, Transform):
                        yield each

    def _first_of(self, topic: str, refusals: Refusals | None = None) -> Iterator[object]:
        """Yields what a topic holds, from its first readable message on."""
        for message in self.reader.messages({topic}):
            yield from self._decoded(message, refusals or Refusals())

    @property
    def predictor(self) -> AskedPredictor:
        """The predictor that answers, once the replay has been entered."""
        if self._predictor is None:
            raise RuntimeError("enter the replay first: with Replay(...) as run:")
        return self._predictor

    def __enter__(self) -> Self:
        self._one_thread = threadpool_limits(1)  # sums in BLAS depend on how many threads share them
        try:
            self._predictor = self._choice.start()
        except BaseException:
            self._one_thread.restore_original_limits()
            raise
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.predictor.close()
        self._one_thread.restore_original_limits()

    def __iter__(self) -> Iterator[FrameResult]:
        """Yields frame results in stamp order."""
        return run_pipeline(
            self._paced(self.frames()),
            frame_stage(self.roles, self.settings),
            self.predictor,
            window=self._window,
            published=lambda frame: frame.log_time_ns >= self.start_ns,
            refusals=self.refusals,
            clock=self.clock,
        )

    def tracker(self) -> FrameTracker:
        """Returns our tracker, as it is before the first frame; raises LogError if another's tracks are to be used."""
        if self.roles.scan_role == "tracks":
            raise LogError(f"{self.roles.scans} holds another tracker's tracks: there is nothing to track in it")
        return FrameTracker(self.settings.tracking)

    def frames(self) -> Iterator[SyncedFrame]:
        """Yields synchronised frames from 4 s before the start on."""
        readings = self.roles.readings
        sync = TimeSync.of(self.roles, self.settings.sync, self.settings.segmentation, self.refusals)
        wanted = {name for name, reading in readings.items() if self._is_read(reading)}
        from_ns = max(self.reader.start_ns, self.start_ns - WARM_UP_NS)
        for message in self._static:
            if message.topic not in wanted:
                continue
            # what the stream below comes to again is counted there
            refusals = self.refusals if message.log_time_ns < from_ns - LEAD_IN_NS else Refusals()
            for each in self._decoded(message, refusals):
                sync.take_static(message.topic, readings[message.topic].camera, each, refusals)
        elapsed, since = 0.0, time.perf_counter()
        scans = self.roles.scans
        for message in self.reader.messages(wanted, from_ns - LEAD_IN_NS, self.end_ns):
            if message.topic == scans and message.log_time_ns < from_ns:
                continue  # what is read this early only surrounds the first scan
            for each in self._decoded(message, self.refusals):
                for frame in sync.push(message.topic, readings[message.topic].camera, message.log_time_ns, each):
                    self.clock.add("read", elapsed + time.perf_counter() - since)
                    yield frame
                    elapsed, since = 0.0, time.perf_counter()
        yield from sync.flush()

    def _paced(self, frames: Iterator[SyncedFrame]) -> Iterator[SyncedFrame]:
        for frame in frames:
            self._pacer.wait_for(frame.log_time_ns)
            yield frame

    def _is_read(self, reading: Reading) -> bool:
        if reading.role == "transforms":
            return reading.topic in self._mounts
        return self._images or reading.role != "image"

    def _read_static(self) -> list[RawMessage]:
        """Returns calibrations and transforms from the log's beginning: they may occur there only, once."""
        wanted = set(self.roles.topics("calibration", "transforms"))
        if self._pose_is_transforms:
            wanted.add(self.roles.pose)
        if not wanted:
            return []
        return list(self.reader.messages(wanted, None, self.reader.start_ns + STATIC_SEARCH_NS))

    def _decoded(self, message: RawMessage, refusals: Refusals) -> tuple[object, ...]:
        """Returns a message's dataclasses; one that does not decode, or makes no sense, is refused and counted."""
        try:
            messages = decoded(message, self.roles.readings[message.topic])
        except CodecError as error:
            refusals.add(message.topic, message.log_time_ns, str(error))
            return ()
        for each in messages:
            self.labels.see(each)
        return messages


def frame_stage(roles: Roles, settings: ReplaySettings) -> FrameStage:
    """Returns what makes tracks of frames, in a replay as live: our tracker, or what follows another one's tracks."""
    if roles.scan_role == "tracks":
        return TrackFollower(settings.object_tracks, settings.tracking.fusion.pedestrian_labels)
    return FrameTracker(settings.tracking)


def frame_named(reader: LogReader, topic: str) -> str | None:
    """Returns the frame that a topic's first readable message names."""
    for message in reader.messages({topic}):
        for way in decoders_for(message.schema, message.encoding):
            with contextlib.suppress(CodecError):
                return getattr(way.decode(message.data), "frame_id", None)
    return None


def replay(
    paths: str | Path | Sequence[str | Path],
    settings: ReplaySettings | None = None,
    predictor: PredictorMode = "inline",
    **options: int | float | bool,
) -> Iterator[FrameResult]:
    """Yields one FrameResult per LiDAR scan of a recorded drive, in stamp order.

    Args:
        paths: an MCAP file, or several that belong together (a split recording, a sidecar with detections).
        settings: what changes results; the defaults fit the USyd vehicle.
        predictor: "inline" predicts in this process, "spawned" in a process of its own.
        options: `window`, `rate`, `strict`, `salvage`, `images`, as of `Replay`.

    Raises LogError if the log cannot be used, PredictorError if there is no predictor.
    """
    several = [paths] if isinstance(paths, str | Path) else paths
    with Replay([Path(p) for p in several], settings, PredictorChoice(predictor), **options) as run:  # type: ignore[arg-type]
        yield from run
