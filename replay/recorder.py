"""The bus into a recording: behind `pcgan record`.

zenoh's callbacks only queue, one loop asks what unknown keys carry and writes. The file is written as NAME.part, in
chunks that are closed once a second: whatever ends the process, what came before the last second can be read.
"""

import contextlib
import errno
import json
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple, Self, cast

import zenoh
from mcap.writer import CompressionType, Writer

from pcgan.bus import under
from replay.bus_channels import BusChannel, Channels, key_of, topic_of
from replay.errors import OutputError
from replay.logged_message import LoggedSchema
from replay.topic_choice import TopicChoice

QUEUE_BYTES = 256 << 20  # samples that wait to be written: 2 s of six cameras' raw images
CHUNK_BYTES = 1 << 20
FLUSH_S = 1.0
_TICK_S = 0.1
MAX_CHANNELS = 10_000  # MCAP numbers them in 16 bits; what a stranger makes up beyond this is counted as lost
OTHERS = "others"  # in counts by key: all keys beyond that
_SAMPLE_BYTES = 512  # what a sample takes beside its payload and attachment
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Arrival(NamedTuple):
    """A sample and when it came, in ns of the wall clock."""

    sample: zenoh.Sample
    arrival_ns: int


class Inbox:
    """Carries samples from zenoh's callback threads to the loop that writes; bounded in bytes.

    What does not fit is counted by key, never waited for: a callback that blocks would stop zenoh itself.
    """

    def __init__(self, wants: Callable[[str], bool], max_bytes: int = QUEUE_BYTES):
        self._wants, self._max_bytes = wants, max_bytes
        self._wanted: dict[str, bool] = {}
        self._came = threading.Condition()
        self._waiting: deque[Arrival] = deque()
        self._bytes = 0
        self._dropped: Counter[str] = Counter()

    def put(self, sample: zenoh.Sample) -> None:
        """Queues a sample of a key that is wanted."""
        arrival_ns = time.time_ns()
        key = str(sample.key_expr)
        size = _size(sample)
        with self._came:
            if key not in self._wanted:
                if len(self._wanted) >= MAX_CHANNELS:
                    self._wanted.clear()
                self._wanted[key] = self._wants(key)
            if not self._wanted[key] or sample.kind != zenoh.SampleKind.PUT:  # a deletion has nothing to record
                return
            if self._bytes + size > self._max_bytes:
                self._dropped[key if key in self._dropped or len(self._dropped) < MAX_CHANNELS else OTHERS] += 1
                return
            self._bytes += size
            self._waiting.append(Arrival(sample, arrival_ns))
            self._came.notify()

    def take(self, timeout_s: float) -> Iterator[Arrival]:
        """Waits until something is there, timeout_s at most; yields all that is, in the order of arrival."""
        with self._came:
            if not self._waiting and timeout_s > 0:
                self._came.wait(timeout_s)
            count = len(self._waiting)
        for _ in range(count):
            with self._came:  # its place is free as soon as it is taken
                arrival = self._waiting.popleft()
                self._bytes -= _size(arrival.sample)
            yield arrival

    def drop_other(self) -> None:
        """Counts a sample that was taken, and could not be recorded, of one key too many."""
        with self._came:
            self._dropped[OTHERS] += 1

    @property
    def dropped(self) -> Counter[str]:
        """How many samples of each key there was no room for."""
        with self._came:
            return self._dropped.copy()


@dataclass
class Recorded:
    """What has been recorded."""

    messages: Counter[str] = field(default_factory=Counter)  # by topic
    schemas: dict[str, str] = field(default_factory=dict)  # topic -> name of its schema, "" if unknown
    payload_bytes: int = 0
    dropped: Counter[str] = field(default_factory=Counter)  # by key


class TooManyChannels(Exception):
    """More channels than a recording has room for."""


class BusWriter:
    """Writes messages of channels that become known on the way; a context manager.

    On a clean end the file takes its final name, after an error it stays as NAME.part, readable up to the last flush.
    Raises OutputError if the file is there already or cannot be written.
    """

    def __init__(self, path: Path):
        self._path, self._part = path, path.with_name(path.name + ".part")
        for taken in (path, self._part):
            if taken.exists():
                raise OutputError(f"{taken} is there already; choose another name, or move it away")
        try:
            self._stream: IO[bytes] = self._part.open("xb")
        except OSError as error:
            raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._schemas: dict[LoggedSchema, int] = {}
        self._channels: dict[tuple[str, LoggedSchema, str], int] = {}
        self._sequences: Counter[int] = Counter()
        self._metadata: dict[str, str] = {}
        with self._guarded():
            self._writer.start(profile="", library="pcgan")

    def write(self, channel: BusChannel, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        """Appends one message; raises TooManyChannels if it is the first of one channel too many."""
        number = self._channels.get((channel.topic, channel.schema, channel.encoding))
        if number is None and len(self._channels) >= MAX_CHANNELS:
            raise TooManyChannels
        with self._guarded():
            number = number or self._register(channel)
            self._writer.add_message(number, log_time_ns, data, publish_time_ns, self._sequences[number])
        self._sequences[number] += 1

    def flush(self) -> None:
        """Closes the open chunk, so that what has been written so far outlives this process."""
        with self._guarded():
            self._writer.flush()  # type: ignore[no-untyped-call]

    def describe(self, metadata: Mapping[str, str]) -> None:
        """Sets what goes into the metadata record "pcgan record" when the file is closed."""
        self._metadata = dict(sorted(metadata.items()))

    @property
    def size(self) -> int:
        """Bytes of the file so far, or of the closed file."""
        return self._stream.tell() if not self._stream.closed else self._path.stat().st_size

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if error is None:
                with self._guarded():
                    self._writer.add_metadata("pcgan record", self._metadata)
                    self._writer.finish()  # type: ignore[no-untyped-call]
                    self._stream.flush()
                    os.fsync(self._stream.fileno())
                    if self._path.exists():  # made by somebody else meanwhile
                        raise FileExistsError(errno.EEXIST, "it is there already")
                    self._part.replace(self._path)
        finally:
            with contextlib.suppress(OSError):  # on a full disk closing fails again, with nothing new to say
                self._stream.close()

    def _register(self, channel: BusChannel) -> int:
        schema = channel.schema
        number = 0  # no schema: one without its definition would read nothing, but of JSON the name is enough
        if schema.definition or (schema.name and channel.encoding == "json"):
            if schema not in self._schemas:
                self._schemas[schema] = self._writer.register_schema(*schema)
            number = self._schemas[schema]
        number = self._writer.register_channel(channel.topic, channel.encoding, number, dict(channel.metadata))
        self._channels[channel.topic, schema, channel.encoding] = number
        return number

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(
                f"{self._path} cannot be written: {error.strerror or error}; what was is in {self._part.name}"
            ) from error


def record_bus(
    session: zenoh.Session,
    output: Path,
    choice: TopicChoice,
    *,
    namespace: str = "",
    duration_s: float | None = None,
    stop: Callable[[], bool] = lambda: False,
    on_ready: Callable[[], None] = lambda: None,
    on_tick: Callable[[Recorded], None] = lambda _: None,
    queue_bytes: int = QUEUE_BYTES,
) -> Recorded:
    """Writes what comes on the chosen keys into a new MCAP file until `stop` says so or the duration is over.

    What static topics said before is recorded first, if their publishers keep it. Raises OutputError if the file cannot
    be written, or there is one of that name.
    """
    recorded = Recorded()
    inbox = Inbox(lambda key: choice.wants(topic_of(key, namespace)), queue_bytes)
    exact = choice.names if choice.regex is None else ()
    keys = [key_of(name, namespace) for name in sorted(exact)] or [under(namespace, "**")]
    channels = Channels(session, namespace)
    # in the network's own thread: otherwise each subscriber has one, and order across topics is lost
    put = zenoh.handlers.Callback(inbox.put, indirect=False)

    def write(arrival: Arrival) -> None:
        sample = arrival.sample
        channel, data = channels.of(sample), sample.payload.to_bytes()
        published_ns = arrival.arrival_ns if sample.timestamp is None else _ns(sample.timestamp.get_time())
        try:
            writer.write(channel, arrival.arrival_ns, published_ns, data)
        except TooManyChannels:
            inbox.drop_other()
            return
        recorded.messages[channel.topic] += 1
        recorded.schemas[channel.topic] = channel.schema.name
        recorded.payload_bytes += len(data)

    def write_all(arrivals: Iterator[Arrival]) -> None:
        for arrival in arrivals:
            if not said_before or _identity(arrival.sample) not in said_before:
                write(arrival)

    with BusWriter(output) as writer, contextlib.ExitStack() as subscriptions:
        started_ns, started_s = time.time_ns(), time.monotonic()
        for key in keys:
            subscriptions.enter_context(session.declare_subscriber(key, put))
        said_before = _said_before(session, keys)
        for sample in said_before.values():
            if choice.wants(topic_of(str(sample.key_expr), namespace)):
                write(Arrival(sample, started_ns))
        on_ready()
        flush_s = started_s + FLUSH_S
        while not stop() and (duration_s is None or time.monotonic() < started_s + duration_s):
            write_all(inbox.take(_TICK_S))
            if time.monotonic() >= flush_s:
                writer.flush()
                flush_s = time.monotonic() + FLUSH_S
            recorded.dropped = inbox.dropped
            on_tick(recorded)
        subscriptions.close()
        write_all(inbox.take(0))
        recorded.dropped = inbox.dropped
        writer.describe({
            "dropped": json.dumps(recorded.dropped, sort_keys=True),
            "namespace": namespace,
            "version": version("pcgan"),
        })  # fmt: skip
    return recorded


def _said_before(session: zenoh.Session, keys: Sequence[str]) -> dict[tuple[str, str], zenoh.Sample]:
    """Returns what zenoh's AdvancedPublishers keep for late subscribers, oldest first.

    Asked for once. An AdvancedSubscriber on "**" would ask, too, but leaves out whatever overtook another sample of the
    same session, such as one of a higher priority.
    """
    samples = []
    for key in keys:
        # the key under which a cache answers, with leave to answer with samples of other keys
        replies = session.get(f"{key}/@adv/pub/**?_anyke", consolidation=zenoh.ConsolidationMode.NONE, timeout=1.0)
        samples += [reply.ok for reply in replies if reply.ok is not None and reply.ok.timestamp is not None]
    samples.sort(key=lambda sample: cast(zenoh.Timestamp, sample.timestamp).get_time())
    return {_identity(sample): sample for sample in samples}


def _identity(sample: zenoh.Sample) -> tuple[str, str]:
    """Returns what tells a timestamped sample from any other."""
    return str(sample.key_expr), str(sample.timestamp)


def _size(sample: zenoh.Sample) -> int:
    attachment = sample.attachment
    return len(sample.payload) + (0 if attachment is None else len(attachment)) + _SAMPLE_BYTES


def _ns(time_of_day: datetime) -> int:
    return (time_of_day - _EPOCH) // timedelta(microseconds=1) * 1000
