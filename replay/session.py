"""A replay from files to frame results: `for frame in replay("drive.mcap"): ...`."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field
from threadpoolctl import threadpool_limits

from replay.decoders import DECODERS
from replay.errors import LogError, Refusals
from replay.frame_result import FrameResult
from replay.log_reader import LogReader, RawMessage
from replay.pacing import Pacer
from replay.pipeline import FrameTracker, run_pipeline
from replay.remote_predictor import AskedPredictor, InlinePredictor, RemotePredictor
from replay.roles import assign_roles, time_offsets
from replay.stage_clock import StageClock
from replay.time_sync import DEFAULT_VEHICLE_FRAME, SyncedFrame, SyncSettings, TimeSync
from replay.transform_tree import TransformTree
from schemas.codec import CodecError
from schemas.messages import LidarClusters, Transform, VehiclePose
from tracking.pipeline import TrackingSettings

WARM_UP_NS = 4_000_000_000  # what the tracker sees, unpublished, before --start
LEAD_IN_NS = 1_000_000_000  # poses and boxes from before the first scan
STATIC_SEARCH_NS = 10_000_000_000  # how far into a log its transforms and calibrations are looked for
PredictorMode = Literal["spawned", "external", "inline"]


class ReplaySettings(BaseModel):
    """Everything that changes results; attached to every output."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    start_s: float = Field(default=0, ge=0, description="seconds after the log's first message")
    duration_s: float | None = Field(default=None, gt=0, description="None: to the end of the log")
    topics: dict[str, str] = Field(default={}, description="default topic name -> name in the log")
    sync: SyncSettings = SyncSettings()
    tracking: TrackingSettings = TrackingSettings()


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
        self.reader = LogReader(paths, salvage=salvage)
        self.roles = assign_roles(self.reader.channels, self.settings.topics)
        self.offsets_ns = time_offsets(self.roles, self.settings.sync.time_offset_ms)
        self.start_ns = self.reader.start_ns + round(self.settings.start_s * 1e9)
        self.end_ns = self.reader.end_ns + 1
        if self.settings.duration_s is not None:
            self.end_ns = min(self.end_ns, self.start_ns + round(self.settings.duration_s * 1e9))
        if self.start_ns >= self.end_ns:
            length_s = (self.reader.end_ns - self.reader.start_ns) / 1e9
            raise LogError(f"nothing to replay from {self.settings.start_s:g} s: the log lasts {length_s:.1f} s")
        self._static = self._read_static()
        self._check_mounts()
        self._choice = predictor or PredictorChoice()
        self._images = images
        self._window = window
        self._pacer = Pacer(rate)
        self._predictor: AskedPredictor | None = None

    def _check_mounts(self) -> None:
        """Raises LogError unless the transforms at the log's beginning say where the LiDAR is on the vehicle."""
        tree = TransformTree()
        frames: dict[str, str] = {}
        for message in self._static:
            for decoded in _decoded(message, Refusals()):
                if isinstance(decoded, Transform):
                    tree.add(decoded)
        wanted = {self.roles.topic_of[name] for name in ("/velodyne/front/clusters", "/vn100/odometry")}
        for message in self.reader.messages(wanted):
            for decoded in _decoded(message, Refusals()):
                if isinstance(decoded, LidarClusters):
                    frames.setdefault("lidar", decoded.frame_id)
                elif isinstance(decoded, VehiclePose):
                    frames.setdefault("vehicle", decoded.child_frame_id or DEFAULT_VEHICLE_FRAME)
            if len(frames) == 2:
                if tree.transform(frames["vehicle"], frames["lidar"]) is None:
                    known = ", ".join(tree.frames) or "none"
                    raise LogError(
                        f"no transform joins {frames['vehicle']!r} and {frames['lidar']!r}; "
                        f"the frames of /tf_static and /tf are {known}"
                    )
                return

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
            FrameTracker(self.settings.tracking),
            self.predictor,
            window=self._window,
            published=lambda frame: frame.log_time_ns >= self.start_ns,
            refusals=self.refusals,
            clock=self.clock,
        )

    def frames(self) -> Iterator[SyncedFrame]:
        """Yields synchronised frames from 4 s before the start on."""
        sync = TimeSync(self.roles.cameras, self.settings.sync, self.refusals, self.offsets_ns)
        names = self._names(images=self._images)
        cameras = {name: _camera_of(default) for name, default in names.items()}
        from_ns = max(self.reader.start_ns, self.start_ns - WARM_UP_NS)
        for message in self._static:
            # what the stream below comes to again is counted there
            refusals = self.refusals if message.log_time_ns < from_ns - LEAD_IN_NS else Refusals()
            for decoded in _decoded(message, refusals):
                sync.take_static(message.topic, cameras[message.topic], decoded, refusals)
        elapsed, since = 0.0, time.perf_counter()
        scans = self.roles.topic_of["/velodyne/front/clusters"]
        for message in self.reader.messages(set(names), from_ns - LEAD_IN_NS, self.end_ns):
            if message.topic == scans and message.log_time_ns < from_ns:
                continue  # what is read this early only surrounds the first scan
            for decoded in _decoded(message, self.refusals):
                for frame in sync.push(message.topic, cameras[message.topic], message.log_time_ns, decoded):
                    self.clock.add("read", elapsed + time.perf_counter() - since)
                    yield frame
                    elapsed, since = 0.0, time.perf_counter()
        yield from sync.flush()

    def _paced(self, frames: Iterator[SyncedFrame]) -> Iterator[SyncedFrame]:
        for frame in frames:
            self._pacer.wait_for(frame.log_time_ns)
            yield frame

    def _names(self, *, images: bool = False) -> dict[str, str]:
        """Returns the topics to read: name in this log -> default name."""
        names = self.roles.default_of
        if "/tf_static" in self.roles.topic_of:
            names.pop(self.roles.topic_of.get("/tf", ""), None)  # mounts are static; the pose has a topic of its own
        return {name: default for name, default in names.items() if images or not default.endswith("/image")}

    def _read_static(self) -> list[RawMessage]:
        """Returns calibrations and transforms from the log's beginning: they may occur there only, once."""
        wanted = {
            name
            for name, default in self._names().items()
            if default.endswith("/camera_info") or default in ("/tf_static", "/tf")
        }
        if not wanted:
            return []
        return list(self.reader.messages(wanted, None, self.reader.start_ns + STATIC_SEARCH_NS))


def _decoded(message: RawMessage, refusals: Refusals) -> tuple[object, ...]:
    """Returns a message's dataclasses; one that does not decode, or makes no sense, is refused and counted."""
    try:
        decoded = DECODERS[message.schema_name][1](message.data)
    except KeyError:
        reason = f"schema {message.schema_name}"
    except CodecError as error:
        reason = str(error)
    else:
        return decoded if isinstance(decoded, tuple) else (decoded,)
    refusals.add(message.topic, message.log_time_ns, reason)
    return ()


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


def _camera_of(default_topic: str) -> str | None:
    """Returns the camera a default topic belongs to: "A0" for /gmsl/A0/detections, None for what is no camera's."""
    parts = default_topic.split("/")
    return parts[2] if parts[1] == "gmsl" else None
