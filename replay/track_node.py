"""The live tracker as a process: a thin zenoh shell around `LiveTracker`, which knows no sockets and no clock.

Sensor messages come in on the keys of their topics; tracks and the vehicle's pose go out as live messages
(`CongestionControl.DROP`): a listener that stalls loses some, and holds up nobody.
"""

import logging
import secrets
import signal
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import NamedTuple, Protocol

import zenoh
import zenoh.ext
from threadpoolctl import threadpool_limits

from pcgan.bus import ENCODING
from pcgan.node_health import DEFAULT_DEADLINE_MS, HealthMeter, health_key
from replay.bus_channels import Channels, key_of
from replay.live_tracker import LiveTracker, Tracked
from replay.logged_message import RawMessage
from replay.roles import Roles
from replay.session import ReplaySettings
from schemas import codec, topics
from schemas.messages import NodeHealth, TrackFrame, VehiclePose
from schemas.topics import Topic

log = logging.getLogger(__name__)

MAX_WAITING = 1000  # messages of a topic that may wait to be taken: 10 s of poses at 100 Hz ...
MAX_WAITING_BYTES = 32 * 2**20  # ... and their bytes: 16 scans of a million bytes with points
PATIENCE_NS = 2_000_000_000  # so long after its start a node does not complain of what is missing
_TICK_S = 0.05  # a scan is released so long after its time at most where nothing comes any more
_STEPS = 8  # how many of the latest steps tell how long the next one will take
_STATIC = ("transforms", "calibration")  # said once, perhaps before we came


def steady_clock() -> Callable[[], int]:
    """Returns a clock that gives the time of day in ns, and goes on evenly when somebody sets that."""
    offset_ns = time.time_ns() - time.monotonic_ns()
    return lambda: offset_ns + time.monotonic_ns()


class Arrival(NamedTuple):
    """A message as it came, not yet looked into, and when that was."""

    arrived_ns: int
    message: zenoh.Sample | RawMessage


class SensorInbox:
    """Carries sensor messages from zenoh's callback threads to the main loop, in the order of their arrival.

    Nothing else happens in a callback. What waits is bounded per topic, so that a flood on one pushes out the oldest
    messages of its own, and nobody else's.
    """

    def __init__(self, clock_ns: Callable[[], int] | None = None):
        self.clock_ns = clock_ns or steady_clock()
        self.closed = False
        self._came = threading.Condition()
        self._waiting: dict[str, deque[Arrival]] = {}
        self._bytes: dict[str, int] = {}
        self._pushed_out = 0

    def put(self, message: zenoh.Sample | RawMessage) -> None:
        """Queues a message."""
        topic = message.topic if isinstance(message, RawMessage) else str(message.key_expr)
        with self._came:
            queue = self._waiting.setdefault(topic, deque())
            queue.append(Arrival(self.clock_ns(), message))
            self._bytes[topic] = self._bytes.get(topic, 0) + _size(message)
            while len(queue) > MAX_WAITING or (self._bytes[topic] > MAX_WAITING_BYTES and len(queue) > 1):
                self._bytes[topic] -= _size(queue.popleft().message)
                self._pushed_out += 1
            self._came.notify()

    def close(self) -> None:
        """Ends the loop; takes no lock, so that a signal's handler may call it."""
        self.closed = True

    def drain(self, timeout_s: float) -> tuple[list[Arrival], int]:
        """Waits for something to arrive; returns all that has, and up to when that is."""
        with self._came:
            if not self._waiting and timeout_s > 0:
                self._came.wait(timeout_s)
            arrivals = [arrival for queue in self._waiting.values() for arrival in queue]
            self._waiting.clear()
            self._bytes.clear()
            now_ns = self.clock_ns()
        return sorted(arrivals, key=lambda arrival: arrival.arrived_ns), now_ns

    def pushed_out(self) -> int:
        """Returns how many messages there was no room for, since the last call."""
        with self._came:
            count, self._pushed_out = self._pushed_out, 0
        return count


def subscribe(session: zenoh.Session, roles: Roles, inbox: SensorInbox, namespace: str = "") -> ExitStack:
    """Lets the messages of all topics in use go to the inbox, until the returned stack is closed.

    Of transforms and calibrations what was said before we came is asked for, too: their publishers may keep it.
    Raises ValueError for a topic that cannot be a zenoh key.
    """
    keys = {key_of(topic, namespace): reading for topic, reading in roles.readings.items()}
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
    # in the network's own thread: otherwise each topic has a thread, and a pose may overtake the scan before it
    put = zenoh.handlers.Callback(inbox.put, indirect=False)
    subscriptions = ExitStack()
    for key, reading in keys.items():
        if reading.role in _STATIC:
            subscriptions.enter_context(zenoh.ext.declare_advanced_subscriber(session, key, put, history=history))
        else:
            subscriptions.enter_context(session.declare_subscriber(key, put))
    return subscriptions


class Sensors(Protocol):
    """Where sensor messages come from, if not from the keys of their topics."""

    @property
    def refused(self) -> int:
        """How many messages were of no use before they reached the inbox."""
        ...

    def listen(self, inbox: SensorInbox) -> None:
        """Lets them go to the inbox."""
        ...


class TrackNode:
    """A live tracker on the bus: takes what the inbox holds, tracks, publishes, and says how it is doing."""

    def __init__(
        self,
        session: zenoh.Session,
        inbox: SensorInbox,
        settings: ReplaySettings | None = None,
        *,
        namespace: str = "",
        deadline_ms: float = DEFAULT_DEADLINE_MS,
        roles: Roles | None = None,
        sensors: Sensors | None = None,
    ):
        self.meter = HealthMeter("track", deadline_ms=deadline_ms, clock_ns=inbox.clock_ns)
        self.tracker = LiveTracker(settings, roles, on_refused=self._tell)
        self._sensors = sensors
        self._session = session
        self._inbox = inbox
        self._namespace = namespace
        self._channels = Channels(session, namespace)
        self._deadline_ns = round(deadline_ms * 1e6)
        self._started_ns = inbox.clock_ns()
        self._steps_ns: deque[int] = deque([0], maxlen=_STEPS)
        self._failed = 0
        self._complained: tuple[str, ...] = ()
        self._frames_before = 0  # at the last report

    def serve(
        self,
        *,
        on_ready: Callable[[], None] | None = None,
        on_tracked: Callable[[TrackFrame, VehiclePose], None] | None = None,
        on_health: Callable[[NodeHealth], None] | None = None,
    ) -> int:
        """Tracks until the inbox is closed; returns how many messages were refused."""
        session, namespace = self._session, self._namespace
        run = secrets.token_bytes(8)  # tells our frames from another tracker's, or from those before a restart

        def publisher(key: str, message_type: type) -> Callable[[object], None]:
            encoding = ENCODING.with_schema(codec.schema_name(message_type))
            declared = session.declare_publisher(key, encoding=encoding)
            ends.callback(declared.undeclare)
            return lambda message: declared.put(codec.encode(message), attachment=run)

        with ExitStack() as ends:
            put_tracks = publisher(topics.zenoh_key(topics.TRACKS, namespace), TrackFrame)
            put_pose = publisher(topics.zenoh_key(topics.VEHICLE_POSE, namespace), VehiclePose)
            put_health = publisher(health_key("track", namespace), NodeHealth)
            if self._sensors is None:
                ends.enter_context(subscribe(session, self.tracker.roles, self._inbox, namespace))
            else:
                self._sensors.listen(self._inbox)
            token = session.liveliness().declare_token(alive_key(str(session.zid()), namespace))
            ends.callback(token.undeclare)
            if on_ready is not None:
                on_ready()
            while not self._inbox.closed:
                tracked = self.step()
                if tracked is not None:
                    put_pose(tracked.pose)
                    put_tracks(tracked.tracks)
                    if on_tracked is not None:
                        on_tracked(tracked.tracks, tracked.pose)
                    self.meter.published(tracked.released_ns)
                health = self._report()
                if health is not None:
                    put_health(health)
                    if on_health is not None:
                        on_health(health)
        return self.meter.refused

    def step(self) -> Tracked | None:
        """Takes everything that has arrived and tracks one scan, after leaving out those there is no time for."""
        tracker, clock_ns = self.tracker, self._inbox.clock_ns
        arrivals, now_ns = self._inbox.drain(0 if tracker.waiting else min(_TICK_S, self.meter.wait_s))
        self.meter.took(len(arrivals))
        for arrival in arrivals:
            self._shielded(partial(self._take, arrival), "a message")
        self.meter.dropped += self._inbox.pushed_out()
        tracker.advance(now_ns)
        self.meter.dropped += tracker.shed(clock_ns(), self._deadline_ns, max(self._steps_ns))
        outside = self._sensors.refused if self._sensors is not None else 0
        self.meter.refused = self._failed + tracker.refused + outside
        if not tracker.waiting:
            return None
        start_ns = clock_ns()
        tracked = self._shielded(tracker.track, "a scan")
        self._steps_ns.append(clock_ns() - start_ns)
        return tracked

    def _take(self, arrival: Arrival) -> None:
        message = arrival.message
        if isinstance(message, RawMessage):
            self.tracker.take(message._replace(log_time_ns=arrival.arrived_ns))
        else:
            self.tracker.take(self._channels.raw_message(message, arrival.arrived_ns))

    def _shielded(self, call: Callable[[], Tracked | None], what: str) -> Tracked | None:
        """Calls; what nobody foresaw in a stranger's message must not end the node for everybody else."""
        try:
            return call()
        except Exception as error:
            self._failed += 1
            if self.meter.trouble(f"{what}: {error!r}", kind="failed"):
                log.exception("could not use %s", what)
            return None

    def _tell(self, problem: str) -> None:
        if self.meter.trouble(problem, kind=problem.partition(" ")[0]):
            log.warning("%s", problem)

    def _report(self) -> NodeHealth | None:
        if self.meter.wait_s == 0 and self._inbox.clock_ns() - self._started_ns >= PATIENCE_NS:
            self._complain()
        return self.meter.report()

    def _complain(self) -> None:
        """Says once what tracking still needs, and once that it goes on."""
        missing = self.tracker.missing()
        if missing:
            self.meter.trouble("; ".join(missing))
        elif self.meter.frames == self._frames_before:
            return  # nothing is known to be missing, but nothing has come of it yet
        if missing != self._complained:
            log.warning("%s", f"waiting: {'; '.join(missing)}" if missing else "what was missing is there")
            self._complained = missing
            if not missing:
                self.meter.well()
        self._frames_before = self.meter.frames


def alive_key(session_id: str, namespace: str = "") -> str:
    """Returns the key of the liveliness token by which a tracker says that it is there."""
    return topics.zenoh_key(Topic(f"/pcgan/tracker/{session_id}", "alive", ""), namespace)


def run(
    session: zenoh.Session,
    settings: ReplaySettings | None = None,
    *,
    namespace: str = "",
    deadline_ms: float = DEFAULT_DEADLINE_MS,
    roles: Roles | None = None,
    sensors: Sensors | None = None,
    on_tracked: Callable[[TrackFrame, VehiclePose], None] | None = None,
    on_health: Callable[[NodeHealth], None] | None = None,
) -> int:
    """Tracks until SIGINT or SIGTERM; returns how many messages were refused."""
    inbox = SensorInbox()
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, lambda *_: inbox.close())
    node = TrackNode(
        session, inbox, settings, namespace=namespace, deadline_ms=deadline_ms, roles=roles, sensors=sensors
    )
    with threadpool_limits(1):  # sums in BLAS depend on how many threads share them
        return node.serve(on_tracked=on_tracked, on_health=on_health)


def _size(message: zenoh.Sample | RawMessage) -> int:
    if isinstance(message, RawMessage):
        return len(message.data)
    return len(message.payload) + (0 if message.attachment is None else len(message.attachment))
