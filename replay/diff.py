"""Two logs compared: which topics, which messages, then every value; where and by how much the first one differs."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from replay.autoware import PREDICTED_OBJECTS, TRACKED_OBJECTS
from replay.diff_compare import Comparison
from replay.diff_pairs import Pair, pairs
from replay.diff_result import Difference, Kind, LogDiff, Tolerances
from replay.diff_tally import SPANS, TopicTally
from replay.diff_tracks import PREDICTIONS, TRACKS, TrackMap, match_tracks
from replay.diff_values import Level, flattener, has_field, level_of, use_keys
from replay.errors import LogError
from replay.log_reader import LogReader
from replay.logged_message import ChannelInfo, RawMessage
from schemas.codec import PACKAGE, CodecError

__all__ = ["Difference", "Kind", "LogDiff", "Tolerances", "diff_logs"]

SCENE = "foxglove.SceneUpdate"


@dataclass(frozen=True)
class _Keyed:
    """The part of a message whose rows are tracks, or have names that tell them apart."""

    level: str
    key: str  # the value that is the name
    track: Callable[[object], int | None]  # the track's id in it; None: it is no track of ours


def _number(name: object) -> int | None:
    return name if isinstance(name, int) else None


def _entity_track(name: object) -> int | None:
    """Returns the track's id in the name of an entity of `replay.scene_update`, "track/7"."""
    number = str(name).removeprefix("track/")
    return int(number) if number != name and number.isdecimal() else None


def _object_track(uuid: object) -> int | None:
    """Returns the track's id in a UUID of `replay.autoware.object_id`."""
    if not isinstance(uuid, bytes) or len(uuid) != 16 or uuid[6:9] != b"\x80\x00\x80":
        return None
    return int.from_bytes(uuid[8:]) & 0x3FFF_FFFF_FFFF_FFFF


_KEYED: Mapping[str, _Keyed] = {
    TRACKS: _Keyed("tracks", "tracks.id", _number),
    PREDICTIONS: _Keyed("predictions", "predictions.track_id", _number),
    SCENE: _Keyed("entities", "entities.id", _entity_track),
    TRACKED_OBJECTS.message: _Keyed("objects", "objects.object_id.uuid", _object_track),
    PREDICTED_OBJECTS.message: _Keyed("objects", "objects.object_id.uuid", _object_track),
}
# What `replay.scene_update` draws by a track's number, its colour and its label, says nothing once that has changed.
OF_NUMBERS = (
    "entities.cylinders.color", "entities.lines.color", "entities.texts.color", "entities.texts.text",
)  # fmt: skip


def diff_logs(
    a: Sequence[Path],
    b: Sequence[Path],
    tolerances: Tolerances | None = None,
    *,
    salvage: bool = False,
    on_progress: Callable[[float], None] = lambda _: None,
    on_pair: Callable[[Pair, TrackMap | None], None] | None = None,
) -> LogDiff:
    """Compares two logs, each in one file or several, and returns what differs.

    Tracks are compared with those that are where they are, whatever their numbers. Memory does not grow with the logs,
    apart from a number per pair of tracks that met.

    Args:
        a: the first log; its values are what `rtol` counts from.
        b: the second log.
        tolerances: what counts as the same; without them, the usual.
        salvage: read every intact chunk of damaged files.
        on_progress: told the share of the work that is done, 0 to 1.
        on_pair: shown the messages that are compared, with which of their tracks is which; None: each is itself.

    Raises:
        LogError: a file cannot be read, or no topic is the one that was asked for.
    """
    readers = LogReader(a, salvage=salvage), LogReader(b, salvage=salvage)
    return _Diff(*readers, tolerances or Tolerances()).run(on_progress, on_pair or (lambda *_: None))


class _Diff:
    """One comparison of two logs."""

    def __init__(self, a: LogReader, b: LogReader, tolerances: Tolerances):
        self.a, self.b, self.tolerances = a, b, tolerances
        self.start_ns, self.end_ns = min(a.start_ns, b.start_ns), max(a.end_ns, b.end_ns)
        self._channels = [_by_topic(reader) for reader in (a, b)]
        counts = [Counter({topic: sum(each.messages for each in found) for topic, found in log.items()})
                  for log in self._channels]  # fmt: skip
        self.topics = _chosen({*counts[0], *counts[1]}, tolerances.topics)
        self.tallies = {topic: TopicTally(topic, (counts[0][topic], counts[1][topic])) for topic in self.topics}
        self.compared = [topic for topic in self.topics if self._same_type(topic)]
        self.types = {topic: {each.schema.name for each in self._channels[0][topic]} for topic in self.compared}
        self._comparisons: dict[str, Comparison] = {}
        self._maps: dict[str, TrackMap] = {}
        self._renumbered: dict[str, str] = {}

    def run(self, on_progress: Callable[[float], None], on_pair: Callable[[Pair, TrackMap | None], None]) -> LogDiff:
        """Compares everything, in order of log time."""
        span_ns = max(1, self.end_ns - self.start_ns)
        self._maps = self._match_tracks(lambda at_ns: on_progress(0.3 * (at_ns - self.start_ns) / span_ns))
        for track_map in self._maps.values():
            self._renumbered |= track_map.renumbered
        share = 0.3 if self._maps else 0.0
        met = not self.compared
        for pair in pairs(self.a, self.b, self.compared):
            passed = (pair.log_time_ns - self.start_ns) / span_ns
            tally = self.tallies[pair.topic]
            tally.begin((pair.log_time_ns - self.a.start_ns) / 1e9, pair.log_time_ns)
            self._compare(pair, tally)
            tally.end(min(max(int(passed * SPANS), 0), SPANS - 1))  # a file's summary may be wrong about its times
            met = met or (pair.a is not None and pair.b is not None)
            on_pair(pair, self._map_of(pair.topic))
            on_progress(share + (1 - share) * passed)
        return LogDiff(
            tuple(tally.result(self.tolerances.share) for tally in self.tallies.values()),
            self._renumbered,
            OF_NUMBERS if self._renumbered and any(SCENE in types for types in self.types.values()) else (),
            span_s=(self.end_ns - self.start_ns) / 1e9,
            losses=(*self.a.losses.notes, *self.b.losses.notes),
            notes=(*self._unknown_fields(), *(() if met else (self._apart(),))),
        )

    def _unknown_fields(self) -> list[str]:
        """Tells of names that were to be ignored, and that no message has, whichever topics are compared."""
        channels = [channel for log in self._channels for found in log.values() for channel in found]
        return [
            f"no message has a field {name!r} that could be ignored"
            for name in self.tolerances.ignore
            if not any(has_field(channel.schema, channel.encoding, name) for channel in channels)
        ]

    def _apart(self) -> str:
        """Tells that no message of one log belongs to any of the other, as of drives recorded apart."""
        later_s = (self.b.start_ns - self.a.start_ns) / 1e9
        when = "later" if later_s > 0 else "earlier"
        begins = f"the second log begins {abs(later_s):.3f} s {when}" if later_s else "both begin at the same time"
        return f"no two messages have the same log time, by which they belong together: nothing was compared; {begins}"

    def _same_type(self, topic: str) -> bool:
        """Tells whether both logs have a topic, with messages of the same type; else that is its difference."""
        texts = [", ".join(sorted({_type_in_words(each) for each in log.get(topic, ())})) for log in self._channels]
        if texts[0] == texts[1]:
            return True
        difference = Difference(Kind.TOPIC, topic, 0.0, self.a.start_ns, "", "", texts[0], texts[1])
        self.tallies[topic].unlike_topic(difference)
        return False

    # --- messages ---------------------------------------------------------------------------------------------------

    def _compare(self, pair: Pair, tally: TopicTally) -> None:
        """Compares two messages, or tells of one that the other log does not have."""
        if pair.a is None or pair.b is None:
            tally.lone_message(lambda: _lone(tally, in_a=pair.a is not None))
            return
        if not pair.identical:
            tally.identical = False
        elif self.tolerances.share == 0 and not self._names_renumbered(pair.a):
            return  # with a share, these values count, too
        self._compare_values(pair.a, pair.b, tally)

    def _names_renumbered(self, message: RawMessage) -> bool:
        """Tells whether equal bytes may mean other tracks: before an id switch, or after it, they do."""
        track_map = self._map_of(message.topic) if message.schema.name in _KEYED else None
        return track_map is not None and bool(track_map.renumbered)

    def _compare_values(self, a: RawMessage, b: RawMessage, tally: TopicTally) -> None:
        comparison = self._comparison(tally, a)
        try:
            flat_a, flat_b = self._flat(a), self._flat(b)
        except CodecError:
            flat_a = flat_b = None
        if flat_a is None or flat_b is None or a.schema.name != b.schema.name:
            comparison.compare_bytes(a.data, b.data)
            return
        keyed = _KEYED.get(a.schema.name)
        if keyed is not None and use_keys((flat_a, flat_b), keyed.level, keyed.key):
            for log, (root, message) in enumerate(((flat_a, a), (flat_b, b))):
                self._name_tracks(root, keyed, message, log)
        try:
            comparison.compare(flat_a, flat_b)
        except RecursionError:  # JSON in JSON in JSON
            comparison.compare_bytes(a.data, b.data)

    def _comparison(self, tally: TopicTally, message: RawMessage) -> Comparison:
        found = self._comparisons.get(tally.topic)
        if found is None:
            found = self._comparisons[tally.topic] = Comparison(
                tally,
                self.tolerances.atol,
                self.tolerances.rtol,
                ours=message.schema.name.startswith(f"{PACKAGE}."),
                defaults=message.encoding == "protobuf",
            )
        return found

    def _flat(self, message: RawMessage) -> Level | None:
        """Returns a message's values; None if its type cannot be read."""
        name, ignore = message.schema.name, self.tolerances.ignore
        if name in _KEYED:  # names are not compared, they say what is
            ignore = tuple(ignored for ignored in ignore if ignored != _KEYED[name].key)
        if self._renumbered and name == SCENE:
            ignore = (*ignore, *OF_NUMBERS)
        flatten = flattener(message.schema, message.encoding, ignore)
        return None if flatten is None else flatten(message.data)

    def _name_tracks(self, root: Level, keyed: _Keyed, message: RawMessage, log: int) -> None:
        """Has the rows of tracks told apart by which track they are."""
        track_map, level = self._map_of(message.topic), level_of(root, keyed.level)
        if track_map is None or level is None:
            return
        sequences = root.parts.get("sequence")
        sequence = sequences[0] if isinstance(sequences, list) else None
        track_map.give_keys(level, log, track_map.epoch(log, message.log_time_ns, sequence), keyed.track)

    # --- tracks -----------------------------------------------------------------------------------------------------

    def _match_tracks(self, on_progress: Callable[[int], None]) -> dict[str, TrackMap]:
        """Returns which track is which, by the topic that says so: one of tracks; of predictions if there is none."""
        if not any(self.types[topic] & _KEYED.keys() for topic in self.compared):
            return {}
        for name in (TRACKS, PREDICTIONS):
            topics = [
                topic
                for topic in sorted(self._channels[0].keys() & self._channels[1].keys())
                if all(_carries(channels[topic], name) for channels in self._channels)
            ]
            if topics:
                return {topic: self._match_topic(topic, on_progress) for topic in topics if self._differs(topic)}
        return {}

    def _differs(self, topic: str) -> bool:
        """Tells whether any message of a topic differs; as long as none does, ids are the same."""
        return any(not pair.identical for pair in pairs(self.a, self.b, [topic]))

    def _match_topic(self, topic: str, on_progress: Callable[[int], None]) -> TrackMap:
        def told() -> Iterator[Pair]:
            for pair in pairs(self.a, self.b, [topic]):
                on_progress(pair.log_time_ns)
                yield pair

        return match_tracks(told())

    def _map_of(self, topic: str) -> TrackMap | None:
        """Returns the tracks of a topic: its own, or those of the topic whose name has most in common with its."""
        if topic in self._maps or not self._maps:
            return self._maps.get(topic)
        return self._maps[max(self._maps, key=lambda other: _common(topic, other))]


def _by_topic(reader: LogReader) -> dict[str, list[ChannelInfo]]:
    found: dict[str, list[ChannelInfo]] = {}
    for channel in reader.channels:
        found.setdefault(channel.topic, []).append(channel)
    return found


def _chosen(topics: set[str], patterns: Sequence[str] | None) -> list[str]:
    """Returns the topics that match any pattern, sorted; raises LogError if a pattern matches none."""
    if patterns is None:
        return sorted(topics)
    chosen: set[str] = set()
    for pattern in patterns:
        found = {topic for topic in topics if fnmatchcase(topic, pattern) or fnmatchcase(topic, f"/{pattern}")}
        if not found:
            raise LogError(f"neither log has a topic {pattern!r}; they have {', '.join(sorted(topics))}")
        chosen |= found
    return sorted(chosen)


def _type_in_words(channel: ChannelInfo) -> str:
    return f"{channel.schema.name or 'messages without a schema'} ({channel.encoding})"


def _carries(channels: Sequence[ChannelInfo], name: str) -> bool:
    return all(channel.schema.name == name and channel.encoding == "protobuf" for channel in channels)


def _lone(tally: TopicTally, *, in_a: bool) -> Difference:
    where = f"only the {'first' if in_a else 'second'} log has this message"
    a, b = tally.messages
    if a == b:
        texts = ("there", "") if in_a else ("", "there")
        return tally.difference(Kind.STAMP, where, "", *texts)
    return tally.difference(Kind.COUNT, where, "", str(a), str(b))


def _common(a: str, b: str) -> int:
    """Returns how many letters two names begin with together."""
    return next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
