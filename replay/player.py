"""A recording onto the bus, message by message, when each is due: behind `pcgan play`.

`Schedule` says when that is and knows no sleep, `Player` waits and obeys the keyboard, `LogPublisher` is the zenoh end.
Payloads are not looked into.
"""

import math
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Protocol, Self

import zenoh
import zenoh.ext
from mcap.reader import SeekingReader

from pcgan.bus import settle
from replay.bus_channels import BusChannel, announce, key_of, zenoh_encoding
from replay.decoders import decoders_for
from replay.errors import LogError
from replay.keyboard import Key
from replay.log_reader import LogReader
from replay.logged_message import ChannelInfo, RawMessage
from replay.topic_choice import TopicChoice

RATE_STEP = 1.1
STATIC_SEARCH_NS = 10_000_000_000  # how far into a log static topics are looked for, as with `pcgan replay --start`
_TICK_S = 0.1  # how often keys are looked at and the position is shown
_FEW_MESSAGES = 10  # a topic with no more than these says things once
_MOST_CACHED = 100  # messages of a static topic that a late subscriber gets
_SETTLE_S = 60.0  # so long zenoh waits for a subscriber that stalls
_LINGER_S = 1.0  # where this process is the router, others may still be talking about the last messages through it
_TRANSIENT_LOCAL = re.compile(r"durability: *(1|transient_local)\b")  # in rosbag2's offered_qos_profiles


class Schedule:
    """When messages are due: log time runs at `rate` times the clock, unless it is paused.

    Args:
        rate: seconds of the log per second of the clock.
        paused: begin paused.
        clock: gives seconds that never jump.
    """

    def __init__(self, rate: float = 1.0, *, paused: bool = False, clock: Callable[[], float] = time.monotonic):
        self.rate = rate
        self.paused = paused
        self._clock = clock
        self._log_ns, self._at_s = 0, clock()  # the log time at a reading of the clock

    @property
    def now_s(self) -> float:
        """What the clock says."""
        return self._clock()

    @property
    def position_ns(self) -> int:
        """The log time now; before the beginning while a delay lasts."""
        return self._log_ns if self.paused else self._log_ns + round((self._clock() - self._at_s) * self.rate * 1e9)

    def restart(self, log_time_ns: int, delay_s: float = 0.0) -> None:
        """Lets log_time_ns be due when `delay_s` of the clock have passed, pauses not counted."""
        self._anchor(log_time_ns - round(delay_s * self.rate * 1e9))

    def wait_s(self, log_time_ns: int) -> float:
        """Returns how long it is until a log time is due: negative if it was due before, infinite while paused."""
        if self.paused:
            return math.inf
        return self._at_s + (log_time_ns - self._log_ns) * 1e-9 / self.rate - self._clock()

    def pause_or_resume(self) -> None:
        """Stops log time, or lets it go on from where it stopped."""
        self._anchor(self.position_ns)
        self.paused = not self.paused

    def set_rate(self, rate: float) -> None:
        """Lets log time go on from where it is at another rate."""
        self._anchor(self.position_ns)
        self.rate = rate

    def jump_to(self, log_time_ns: int) -> None:
        """Makes a log time the present one."""
        self._anchor(log_time_ns)

    def _anchor(self, log_ns: int) -> None:
        self._log_ns, self._at_s = log_ns, self._clock()


@dataclass
class Tally:
    """What has been played."""

    messages: int = 0
    payload_bytes: int = 0
    most_late_s: float = 0.0
    topics: set[str] = field(default_factory=set)


class Controls(Protocol):
    """Where keys come from."""

    def press(self, timeout_s: float) -> Key | None:
        """Waits for a key, timeout_s at most."""
        ...


class Player:
    """Publishes messages when they are due, and at once if that is past: none is left out.

    Args:
        schedule: when they are due.
        controls: space pauses, the right arrow publishes the next message while paused, up and down change the rate.
        publish: takes each message; may block.
        on_tick: called about ten times a second, also while paused.
    """

    def __init__(
        self,
        schedule: Schedule,
        controls: Controls,
        publish: Callable[[RawMessage], None],
        on_tick: Callable[[Tally], None] = lambda _: None,
    ):
        self.tally = Tally()
        self._schedule, self._controls, self._publish, self._on_tick = schedule, controls, publish, on_tick
        self._next_tick_s = -math.inf

    def play(self, messages: Iterable[RawMessage]) -> None:
        """Publishes messages, in their order, each when it is due."""
        for message in messages:
            self._wait_for(message.log_time_ns)
            self.publish(message)

    def publish(self, message: RawMessage) -> None:
        """Publishes a message now."""
        self._publish(message)
        self.tally.messages += 1
        self.tally.payload_bytes += len(message.data)
        self.tally.topics.add(message.topic)

    def _wait_for(self, log_time_ns: int) -> None:
        while (wait_s := self._schedule.wait_s(log_time_ns)) > 0 or self._schedule.now_s >= self._next_tick_s:
            key = self._controls.press(max(0.0, min(wait_s, _TICK_S)))  # keys are heard however late we are
            if self._obey(key, log_time_ns):
                return
            if (now_s := self._schedule.now_s) >= self._next_tick_s:
                self._next_tick_s = now_s + _TICK_S
                self._on_tick(self.tally)
        self.tally.most_late_s = max(self.tally.most_late_s, -wait_s)

    def _obey(self, key: Key | None, log_time_ns: int) -> bool:
        """Does what a key says; returns whether the message that waits is to be published at once."""
        schedule = self._schedule
        match key:
            case Key.PAUSE:
                schedule.pause_or_resume()
            case Key.FASTER:
                schedule.set_rate(schedule.rate * RATE_STEP)
            case Key.SLOWER:
                schedule.set_rate(schedule.rate / RATE_STEP)
            case Key.STEP if schedule.paused:
                schedule.jump_to(log_time_ns)
                return True
        return False


# --- what is played --------------------------------------------------------------------------------------------------


class PlayedTopic(NamedTuple):
    """A topic of the recording, and what becomes of it on the bus."""

    source: ChannelInfo
    key: str
    channel: BusChannel
    cached: int  # how many of its messages a late subscriber gets; 0: it is not static


def played_topics(
    reader: LogReader, choice: TopicChoice, remaps: Mapping[str, str], namespace: str = ""
) -> tuple[PlayedTopic, ...]:
    """Returns the chosen topics of a recording under their names on the bus.

    Raises LogError if a name is not in the recording, if nothing is chosen, or if zenoh cannot have such a key.
    """
    channels = reader.channels
    names = {channel.topic for channel in channels}
    wanted = {name for name in names if choice.wants(name)}
    rooted = {"/" + name.removeprefix("/") for name in names}
    if unknown := sorted((choice.names | {"/" + old.removeprefix("/") for old in remaps}) - rooted):
        raise LogError(f"the recording has no {', '.join(unknown)}; its topics are {', '.join(sorted(names))}")
    if not wanted:
        raise LogError(f"none of the recording's topics is chosen; they are {', '.join(sorted(names))}")
    new_names = {"/" + old.removeprefix("/"): new for old, new in remaps.items()}
    metadata = _channel_metadata(reader.paths)
    played = []
    source_of: dict[str, str] = {}
    for source in channels:
        if source.topic not in wanted:
            continue
        topic = new_names.get("/" + source.topic.removeprefix("/"), source.topic)
        try:
            key = key_of(topic, namespace)
        except ValueError as error:
            raise LogError(f"{error}; leave it out (--exclude-regex) or rename it (--remap)") from error
        if source_of.setdefault(key, source.topic) != source.topic:
            raise LogError(f"{source.topic} and {source_of[key]} would both be {key}; rename one of them (--remap)")
        channel = BusChannel(topic, source.schema, source.encoding, metadata.get(source.topic, {}))
        played.append(PlayedTopic(source, key, channel, _cached(source, channel.metadata)))
    return tuple(played)


def _cached(source: ChannelInfo, metadata: Mapping[str, str]) -> int:
    """Returns how many messages of a topic to keep for late subscribers: 0 for those that go on saying things."""
    if any(decoder.message == "CameraCalibration" for decoder in decoders_for(source.schema, source.encoding)):
        return 1  # each replaces the one before
    static = (
        source.topic.rpartition("/")[2] == "tf_static"
        or source.messages <= _FEW_MESSAGES
        or _TRANSIENT_LOCAL.search(metadata.get("offered_qos_profiles", "")) is not None
    )
    return min(source.messages, _MOST_CACHED) if static else 0


def _channel_metadata(paths: Sequence[Path]) -> dict[str, Mapping[str, str]]:
    """Returns the metadata of each topic's channel, such as rosbag2's QoS profiles; of damaged files none."""
    found: dict[str, Mapping[str, str]] = {}
    for path in paths:
        with path.open("rb") as stream:
            try:
                summary = SeekingReader(stream).get_summary()
            except Exception:  # what mcap raises on damage has no common base
                continue
        for channel in summary.channels.values() if summary is not None else ():
            if channel.metadata:
                found.setdefault(channel.topic, channel.metadata)
    return found


def static_before(reader: LogReader, played: Sequence[PlayedTopic], start_ns: int) -> Iterator[RawMessage]:
    """Yields what static topics said before start_ns, in the log's first 10 s: of each topic what is cached, too.

    Without transforms and calibrations nobody could use what comes from the middle of a drive.
    """
    kept = {topic.source.topic: deque[RawMessage](maxlen=topic.cached) for topic in played if topic.cached}
    end_ns = min(start_ns, reader.start_ns + STATIC_SEARCH_NS)
    if not kept or end_ns <= reader.start_ns:
        return
    for message in reader.messages(kept.keys(), end_ns=end_ns):
        kept[message.topic].append(message)
    for messages in kept.values():
        yield from messages


def play_log(
    reader: LogReader,
    played: Sequence[PlayedTopic],
    player: Player,
    schedule: Schedule,
    *,
    start_offset_s: float = 0.0,
    duration_s: float | None = None,
    delay_s: float = 0.0,
    loop: bool = False,
) -> None:
    """Plays the part of a recording that is asked for; with `loop` again and again, until something is raised.

    Raises LogError if the part begins behind the end, if with `loop` it holds nothing, or if the recording turns out to
    be damaged.
    """
    start_ns = reader.start_ns + round(start_offset_s * 1e9)
    if start_ns > reader.end_ns:
        length_s = (reader.end_ns - reader.start_ns) / 1e9
        raise LogError(
            f"nothing is left to play {start_offset_s:g} s into the recording, which is {length_s:.3f} s long"
        )
    end_ns = None if duration_s is None else start_ns + round(duration_s * 1e9)
    topics = {topic.source.topic for topic in played}
    while True:
        before = player.tally.messages
        for message in static_before(reader, played, start_ns):
            player.publish(message)
        schedule.restart(start_ns, delay_s)
        player.play(reader.messages(topics, start_ns=start_ns, end_ns=end_ns))
        if not loop:
            return
        if player.tally.messages == before:
            raise LogError("the chosen topics have no message in the part that is to be played again and again")


# --- the zenoh end ---------------------------------------------------------------------------------------------------


class LogPublisher:
    """Publishes a recording's messages under their keys, with the encodings that say what they are; a context manager.

    Nothing is dropped: a subscriber that stalls holds up the others (`CongestionControl.BLOCK`), and so it does at the
    end, unless that is an error. What static topics said reaches zenoh's AdvancedSubscribers that come later.
    """

    def __init__(self, session: zenoh.Session, played: Sequence[PlayedTopic], namespace: str = ""):
        self._session, self._played, self._namespace = session, played, namespace
        self._publishers: dict[tuple[object, ...], zenoh.Publisher | zenoh.ext.AdvancedPublisher] = {}
        self._declared = ExitStack()

    def __enter__(self) -> Self:
        announced = announce(self._session, {topic.key: topic.channel for topic in self._played}, self._namespace)
        self._declared.enter_context(announced)
        for topic in self._played:
            self._publishers[topic.source[:3]] = self._declare(topic)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is None:
            settle(self._session, _SETTLE_S)
            if any(link.whatami != zenoh.WhatAmI.ROUTER for link in self._session.info.transports()):
                time.sleep(_LINGER_S)
        self._declared.close()

    def publish(self, message: RawMessage) -> None:
        """Publishes one message of the recording, its bytes as they are."""
        self._publishers[message.topic, message.schema, message.encoding].put(message.data)

    def wait_for_subscriber(self, timeout_s: float) -> bool:
        """Waits until somebody subscribes to one of the topics; returns whether that came to be."""
        deadline_s = time.monotonic() + timeout_s
        with ExitStack() as stack:
            probes = [stack.enter_context(self._session.declare_publisher(topic.key)) for topic in self._played]
            # zenoh's stubs take the status for a bool; as an object it is always true
            while not any(probe.matching_status.matching for probe in probes):  # type: ignore[attr-defined]
                if time.monotonic() >= deadline_s:
                    return False
                time.sleep(0.01)
        return True

    def _declare(self, topic: PlayedTopic) -> zenoh.Publisher | zenoh.ext.AdvancedPublisher:
        encoding = zenoh_encoding(topic.source.schema, topic.source.encoding, topic.channel.metadata)
        block = zenoh.CongestionControl.BLOCK
        if not topic.cached:
            return self._declared.enter_context(
                self._session.declare_publisher(topic.key, encoding=encoding, congestion_control=block)
            )
        return self._declared.enter_context(
            zenoh.ext.declare_advanced_publisher(
                self._session,
                topic.key,
                encoding=encoding,
                congestion_control=block,
                cache=zenoh.ext.CacheConfig(max_samples=topic.cached),
                publisher_detection=True,  # so that subscribers that were there before ask, too
            )
        )
