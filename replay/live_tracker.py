"""Tracking as messages arrive: the very objects of a replay, fed one message at a time. Knows no sockets and no clock.

A message's log time is when it arrived. So a log that is played to a live tracker gives the tracks of its replay, but
for what arrives so late that a scan no longer waited for it.
"""

from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

from replay.class_labels import ClassLabels, unmatched_line
from replay.errors import LogError, Refusals
from replay.frame_result import vehicle_pose
from replay.logged_message import RawMessage
from replay.pipeline import amend
from replay.roles import WHAT, Roles, decoded, live_roles
from replay.session import ReplaySettings, frame_stage
from replay.time_sync import SyncedFrame, TimeSync
from schemas.codec import CodecError
from schemas.messages import TrackFrame, VehiclePose

SILENT_NS = 2_000_000_000  # a camera from which nothing has come for so long is no longer waited for


class Tracked(NamedTuple):
    """The tracks of one scan, and the pose they were tracked in."""

    released_ns: int  # arrival of the message that released the scan
    tracks: TrackFrame
    pose: VehiclePose


class LiveTracker:
    """Turns arriving messages into tracks, as `replay.session.Replay` turns logged ones.

    `take` and `advance` do what costs little and must not be left out: they decode, synchronise, and let the scans they
    complete wait. `track` does what costs much, for one scan. Who cannot keep up calls `shed` in between. The place for
    leaving something out is there: every pose, transform and calibration has been taken in, so the newer scan is whole,
    and for the tracker a scan that was left out is one that never was, a longer time step.

    Messages that are of no use are refused: counted, and told to `on_refused` in words. They never end anything.
    """

    def __init__(
        self,
        settings: ReplaySettings | None = None,
        roles: Roles | None = None,
        on_refused: Callable[[str], None] = lambda _: None,
    ):
        settings = settings or ReplaySettings()
        self.roles = roles or live_roles(settings.roles)
        self._refusals = _LiveRefusals(on_refused)
        self._sync = TimeSync.of(self.roles, settings.sync, settings.segmentation, self._refusals)
        self._stage = frame_stage(self.roles, settings)
        self._waiting: deque[SyncedFrame] = deque()
        self._started_ns = 0  # arrival of the first message
        self._heard_ns: dict[str, int] = {}  # topic -> arrival of its last message that was of use
        self._labels = ClassLabels(settings.tracking.fusion.pedestrian_labels)
        self._unmounted = ""  # why the last scan could not be placed on the vehicle

    @property
    def refused(self) -> int:
        """How many messages were refused, and scans that could not be used."""
        return self._refusals.count

    @property
    def waiting(self) -> int:
        """How many complete scans wait to be tracked."""
        return len(self._waiting)

    def push(self, message: RawMessage) -> list[Tracked]:
        """Takes a message and tracks every scan it completes, for whoever has the time."""
        self.take(message)
        results = [self.track() for _ in range(self.waiting)]
        return [result for result in results if result is not None]

    def take(self, message: RawMessage) -> None:
        """Takes the next message, in the order of arrival."""
        reading = self.roles.readings.get(message.topic)
        if reading is None:
            return
        if not self._heard_ns:
            self._started_ns = message.log_time_ns
        try:
            messages = decoded(message, reading)
        except CodecError as error:
            self._refusals.add(message.topic, message.log_time_ns, str(error))
            return
        self._heard_ns[message.topic] = message.log_time_ns
        if message.topic == self.roles.scans:
            self._sync.wait_for(self._present_cameras(message.log_time_ns))
        for each in messages:
            self._labels.see(each)
            self._collect(self._sync.push(message.topic, reading.camera, message.log_time_ns, each))

    def advance(self, now_ns: int) -> None:
        """Releases the scans that have waited long enough; all that has arrived up to now must have been taken."""
        self._collect(self._sync.advance(now_ns))

    def shed(self, now_ns: int, deadline_ns: int, step_ns: int) -> int:
        """Leaves out as few waiting scans as lets the newest be out by its deadline; returns how many.

        A short burst is so caught up with, and nothing lost. Where tracking is slower than the scans come, only the
        newest is left. The oldest go first, before them those that would only amend what is out already.

        Args:
            now_ns: what time it is, by the clock of arrivals.
            deadline_ns: how long after its release a scan should be out.
            step_ns: how long tracking one takes.
        """
        if len(self._waiting) < 2:
            return 0
        frames = list(self._waiting)
        newest = max((i for i, frame in enumerate(frames) if not frame.late), default=len(frames) - 1)
        left_ns = frames[newest].log_time_ns + deadline_ns - now_ns
        excess = len(frames) - max(1, left_ns // max(1, step_ns))
        if excess <= 0:
            return 0
        others = sorted((i for i in range(len(frames)) if i != newest), key=lambda i: (not frames[i].late, i))
        left_out = others[:excess]
        self._waiting = deque(frame for i, frame in enumerate(frames) if i not in left_out)
        return len(left_out)

    def track(self) -> Tracked | None:
        """Tracks the oldest scan that waits; None if there is none, or if it only amended the tracks."""
        if not self._waiting:
            return None
        frame = self._waiting.popleft()
        if frame.late:
            amend(self._stage, frame, self._refusals)
            return None
        measurements, tracks = self._stage.step(frame)
        for _ in range(measurements.refused):
            self._refusals.add("scans", frame.sensors.stamp_ns, "cluster out of reach, or of an impossible shape")
        return Tracked(frame.log_time_ns, tracks, vehicle_pose(frame.sensors, tracks))

    def missing(self) -> tuple[str, ...]:
        """Returns what tracking still needs, in words; nothing once all is well."""
        roles = self.roles
        needed = (roles.scans, roles.pose)
        words = [f"no {WHAT[roles.readings[t].role]} on {t}" for t in needed if t not in self._heard_ns]
        if self._unmounted:
            words.append(self._unmounted)
        if unmatched := self._labels.unmatched:
            words.append(unmatched_line(unmatched))
        for camera in roles.cameras:
            [boxes], calibration = roles.topics("camera", camera=camera), roles.topics("calibration", camera=camera)
            if boxes in self._heard_ns and not any(topic in self._heard_ns for topic in calibration):
                words.append(f"no calibration of camera {camera} on {' or '.join(calibration)}: its boxes are left out")
        return tuple(words)

    def _present_cameras(self, now_ns: int) -> tuple[str, ...]:
        """Returns the cameras that have sent something lately, and at the beginning all."""
        present = []
        for camera in self.roles.cameras:
            [topic] = self.roles.topics("camera", camera=camera)
            if now_ns - self._heard_ns.get(topic, self._started_ns) < SILENT_NS:
                present.append(camera)
        return tuple(present)

    def _collect(self, frames: Iterator[SyncedFrame]) -> None:
        before = len(self._waiting)
        try:
            self._waiting.extend(frames)
        except LogError as error:  # no mount of the LiDAR: a replay ends there; live it may still come
            self._unmounted = str(error)
            self._refusals.count += 1  # told by `missing`, and not with every scan
        if len(self._waiting) > before:
            self._unmounted = ""


class _LiveRefusals(Refusals):
    """Counts and tells what is refused, and keeps none of it: a node runs for weeks."""

    def __init__(self, tell: Callable[[str], None]):
        super().__init__()
        self.count = 0
        self._tell = tell

    def add(self, topic: str, stamp_ns: int, kind: str, detail: str = "") -> None:  # noqa: ARG002  it is now
        """Counts one refused message and tells it."""
        self.count += 1
        self._tell(f"{topic} refused: {kind}{f' ({detail})' if detail else ''}")
