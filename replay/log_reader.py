"""Recordings in: several MCAP files as one stream of raw messages in log-time order, CRCs checked.

Memory is bounded by the chunks that overlap in time, whatever the length of the log. Files are opened for reading only.
"""

import hashlib
import heapq
import os
import struct
import threading
import zlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, NamedTuple, Self

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, DataEnd, Schema, Statistics
from mcap.summary import Summary

from replay.errors import LogError
from replay.file_bytes import FileBytes
from replay.log_salvage import Losses, SalvagedFile
from replay.logged_message import ChannelInfo, LoggedSchema, RawMessage
from replay.mcap_records import (
    MAGIC,
    MESSAGE,
    RECORD,
    DamageError,
    chunk_content,
    chunk_head,
    crc_of,
    declared,
    parsed,
    record_at,
    records_in,
)
from replay.message_order import in_time_order, log_time, reordered


class LogReader:
    """Several MCAP files (a split recording, a drive and its sidecar) read as one log.

    Raises LogError naming file and problem if a file is no MCAP, is cut short, or has no summary, unless `salvage`. Its
    messages raise it if they have been read to the end, and the file has been changed meanwhile.
    """

    def __init__(self, paths: Sequence[Path], *, salvage: bool = False):
        if not paths:
            raise LogError("no recording given")
        self.paths = tuple(paths)
        self.losses = Losses()
        self._salvage = salvage
        self._opened = [_identity(path) for path in self.paths]
        self._files = [_open(path, self.losses if salvage else None) for path in self.paths]
        starts = [file.start_ns for file in self._files if file.channels]
        if not starts:
            losses = f" that can be read: {'; '.join(self.losses.notes)}" if self.losses.notes else ""
            raise LogError(f"{_names(self.paths)} holds no messages{losses}")
        self.start_ns = min(starts)
        self.end_ns = max(file.end_ns for file in self._files if file.channels)

    @property
    def channels(self) -> tuple[ChannelInfo, ...]:
        """The topics of all files, sorted by name; a topic in several files is counted together."""
        merged: dict[tuple[str, LoggedSchema, str], int] = {}
        for file in self._files:
            for channel in file.channels:
                key = channel[:3]
                merged[key] = merged.get(key, 0) + channel.messages
        return tuple(ChannelInfo(*key, count) for key, count in sorted(merged.items()))

    def messages(
        self, topics: Collection[str] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yields messages in log-time order, start_ns <= log time < end_ns; ties in file order."""
        streams = [
            _damage_named(path, file.messages(topics, start_ns, end_ns))
            for path, file in zip(self.paths, self._files, strict=True)
        ]
        yield from heapq.merge(*streams, key=log_time)
        self.require_unchanged()

    def require_unchanged(self) -> None:
        """Raises LogError if a recording is not the file any more that was opened: what was read of it may be mixed.

        With salvage a recording may grow, as one does that is still being made; what came later is a loss.
        """
        for path, before in zip(self.paths, self._opened, strict=True):
            now = _identity(path)
            if now == before:
                continue
            if self._salvage and now is not None and before is not None and now.grown_from(before):
                note = f"{path.name}: it grew while it was read; what came later is left out"
                if note not in self.losses.notes:
                    self.losses.notes.append(note)
                continue
            how = "is gone" if now is None else "has been replaced or changed"
            raise LogError(f"{path} {how} while it was read; nothing that came of it can be relied on, so do it again")


class _Identity(NamedTuple):
    """What tells a file from another one, and from itself at another time."""

    device: int
    inode: int
    size: int
    changed_ns: int

    def grown_from(self, before: Self) -> bool:
        """Tells whether this is the same file as before, only longer."""
        return self[:2] == before[:2] and self.size > before.size


def _identity(path: Path) -> _Identity | None:
    try:
        found = path.stat()
    except OSError:  # who opens it says why
        return None
    return _Identity(found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns)


def checksum(path: Path, abandoned: threading.Event | None = None) -> str | None:
    """Returns the SHA-256 of a file, in hexadecimal; None if it is abandoned on the way."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            if abandoned is not None and abandoned.is_set():
                return None
            digest.update(block)
    return digest.hexdigest()


def _names(paths: Iterable[Path]) -> str:
    return ", ".join(path.name for path in paths)


class _IndexedFile:
    """An intact MCAP file, read through its index. What contradicts the index, or itself, is damage."""

    def __init__(self, path: Path):
        self._path = path
        with path.open("rb") as stream:
            try:
                summary = _summary(stream)
            except ValueError as error:  # DamageError; an empty file cannot be mapped
                raise LogError(f"{path} is not a readable MCAP file ({_described(path, error)}){_HINT}") from error
        if summary is None or summary.statistics is None:
            raise LogError(f"{path} has no summary section: the recording was not closed{_HINT}")
        self._summary = summary
        self._counts = summary.statistics.channel_message_counts
        self.start_ns = summary.statistics.message_start_time
        self.end_ns = summary.statistics.message_end_time
        self._channels = {
            number: declared(c, summary.schemas.get(c.schema_id)) for number, c in summary.channels.items()
        }
        self.channels = tuple(
            ChannelInfo(*channel, count)
            for number, channel in self._channels.items()
            if (count := self._counts.get(number))
        )

    def messages(
        self, topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[RawMessage]:
        """Yields the messages of some topics, start_ns <= log time < end_ns, in log-time order."""
        wanted = {number for number, (topic, *_) in self._channels.items() if topics is None or topic in topics}
        found: Counter[int] = Counter()
        with self._path.open("rb") as stream:
            if self._summary.chunk_indexes:
                raw = in_time_order(self._chunks(stream, wanted, start_ns, end_ns, found))
            else:
                raw = reordered(self._plain(stream, wanted, found))
            for message in raw:
                if (start_ns is None or message.log_time_ns >= start_ns) and (
                    end_ns is None or message.log_time_ns < end_ns
                ):
                    yield message
        if (start_ns is None or start_ns <= self.start_ns) and (end_ns is None or end_ns > self.end_ns):
            self._check_counts(wanted, found)

    def _check_counts(self, wanted: Collection[int], found: Counter[int]) -> None:
        """Raises LogError if not all messages that were recorded have been there."""
        for number in wanted:
            if found[number] != (count := self._counts.get(number, 0)):
                topic = self._channels[number][0]
                there = f"{found[number]} of {count} recorded messages of {topic!r} are there"
                raise LogError(f"{self._path} is damaged ({there}){_HINT}")

    def _chunks(
        self, stream: IO[bytes], wanted: Collection[int], start_ns: int | None, end_ns: int | None, found: Counter[int]
    ) -> Iterator[tuple[int, Iterable[RawMessage]]]:
        """Yields the beginning in time, and the messages, of the chunks that hold something wanted."""
        chunks = sorted(
            (
                chunk
                for chunk in self._summary.chunk_indexes
                if (not chunk.message_index_offsets or not chunk.message_index_offsets.keys().isdisjoint(wanted))
                and (start_ns is None or chunk.message_end_time >= start_ns)
                and (end_ns is None or chunk.message_start_time < end_ns)
            ),
            key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset),
        )
        for chunk in chunks:
            yield chunk.message_start_time, self._inside(stream, chunk, wanted, found)

    def _inside(
        self, stream: IO[bytes], chunk: ChunkIndex, wanted: Collection[int], found: Counter[int]
    ) -> Iterator[RawMessage]:
        """Yields the wanted messages of one chunk; raises DamageError if it is not the one in the index."""
        times_ns = chunk.message_start_time, chunk.message_end_time
        yield from self._messages(_content(stream, chunk), wanted, found, times_ns)

    def _messages(
        self, content: bytes, wanted: Collection[int], found: Counter[int], times_ns: tuple[int, int]
    ) -> Iterator[RawMessage]:
        """Yields the wanted messages among the records of a chunk."""
        start_ns, end_ns = times_ns
        for opcode, begin, end in records_in(content):
            if opcode == Opcode.MESSAGE:
                number, _, log_time_ns, _ = MESSAGE.unpack_from(content, begin)
                if not start_ns <= log_time_ns <= end_ns:
                    raise DamageError(f"a chunk of {start_ns} to {end_ns} ns holds a message of {log_time_ns} ns")
                if number in wanted:
                    found[number] += 1
                    topic, schema, encoding = self._channels[number]
                    yield RawMessage(topic, log_time_ns, schema, encoding, content[begin + MESSAGE.size : end])
                elif number not in self._channels:
                    raise DamageError(f"a message is of channel {number}, which the summary does not declare")
            elif opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
                self._check(opcode, content[begin:end])

    def _check(self, opcode: int, body: bytes) -> None:
        """Raises DamageError if a declaration is not the one in the summary."""
        summary = self._summary
        match opcode:
            case Opcode.CHANNEL:
                channel = parsed(Channel, body)
                known = summary.channels.get(channel.id)
                if known is not None and (channel.topic, channel.message_encoding, channel.schema_id) != (
                    known.topic,
                    known.message_encoding,
                    known.schema_id,
                ):
                    raise DamageError(f"channel {channel.id} is {channel.topic!r}, and {known.topic!r} in the summary")
            case Opcode.SCHEMA:
                schema = parsed(Schema, body)
                if summary.schemas.get(schema.id, schema) != schema:
                    raise DamageError(f"schema {schema.id}, {schema.name!r}, is another one in the summary")

    def _plain(self, stream: IO[bytes], wanted: Collection[int], found: Counter[int]) -> Iterator[RawMessage]:
        """Yields the wanted messages of a file without an index of chunks, in its order."""
        crc, left = zlib.crc32(stream.read(len(MAGIC))), _size(stream) - len(MAGIC)
        while left > 0:
            record = stream.read(RECORD.size)
            opcode, length = RECORD.unpack(record)
            left -= RECORD.size + length
            if left < 0:
                raise DamageError(f"it is cut short or damaged: a record claims {length} bytes")
            record += stream.read(length)
            if opcode == Opcode.DATA_END:
                expected = parsed(DataEnd, record[RECORD.size :]).data_section_crc
                if expected and crc != expected:
                    raise DamageError(f"the crc of all its data is {crc:08x} instead of {expected:08x}")
                return
            crc = zlib.crc32(record, crc)
            if opcode == Opcode.CHUNK:
                yield from self._messages(chunk_content(record, chunk_head(record, 0)), wanted, found, _ANY_TIME)
            elif opcode in (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA):
                yield from self._messages(record, wanted, found, _ANY_TIME)
        raise DamageError("it ends early")


_FOOTER = struct.Struct("<BQQQI8s")  # opcode, length, summary start, summary offset start, CRC; the magic at the end
_FOOTER_BYTES = 8 + 8 + 4
_OF_SUMMARY: dict[int, type[Schema | Channel | ChunkIndex | Statistics]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.STATISTICS: Statistics,
}
_ANY_TIME = (0, 2**64 - 1)
_OTHER_FORMATS = {b"#ROSBAG": "a ROS 1 bag", b"SQLite format 3": "a database, perhaps a ROS 2 bag of the older kind"}
_HINT = "; try --salvage"


def _open(path: Path, losses: Losses | None) -> _IndexedFile | SalvagedFile:
    try:
        with path.open("rb") as stream:
            head = stream.read(16)
        for magic, kind in _OTHER_FORMATS.items():
            if head.startswith(magic):
                raise LogError(f"{path} is {kind}, not MCAP: rosbags-convert makes MCAP of it, with --dst-storage mcap")
        return _IndexedFile(path) if losses is None else SalvagedFile(path, losses)
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror or error}") from error


def _described(path: Path, error: Exception) -> str:
    return "the file is empty" if path.exists() and path.stat().st_size == 0 else str(error)


def _size(stream: IO[bytes]) -> int:
    return os.fstat(stream.fileno()).st_size


def _summary(stream: IO[bytes]) -> Summary | None:
    """Returns the summary section, None if there is none; raises DamageError if it is not what was written.

    Its CRC is the footer's last field, and covers all from its beginning up to itself. Without one, and against a
    forged one, what can be compared is compared.
    """
    view = FileBytes(stream)
    if view[: len(MAGIC)] != MAGIC:
        raise DamageError("it does not begin as an MCAP file does")
    footer_at = len(view) - _FOOTER.size
    if footer_at < len(MAGIC):
        raise DamageError("it ends early")
    opcode, length, start, _, crc, magic = _FOOTER.unpack(view[footer_at:])
    if (opcode, length, magic) != (Opcode.FOOTER, _FOOTER_BYTES, MAGIC):
        raise DamageError("it does not end as an MCAP file does")
    if start == 0:
        return None
    if start > footer_at:
        raise DamageError(f"its summary begins at byte {start}, behind its end")
    if crc and crc != crc_of(view, start, len(view) - len(MAGIC) - 4):
        raise DamageError("the summary's CRC is wrong")
    summary = _summary_in(view, start, footer_at)
    _check_index(summary, start)
    return summary


def _summary_in(view: FileBytes, at: int, end: int) -> Summary:
    summary = Summary()
    while at < end:
        opcode, following = record_at(view, at)
        if following > end:
            raise DamageError("a record of the summary reaches beyond its end")
        if (kind := _OF_SUMMARY.get(opcode)) is not None:
            match parsed(kind, view[at + RECORD.size : following]):
                case Schema() as schema:
                    summary.schemas[schema.id] = schema
                case Channel() as channel:
                    summary.channels[channel.id] = channel
                case ChunkIndex() as index:
                    summary.chunk_indexes.append(index)
                case Statistics() as statistics:
                    summary.statistics = statistics
        at = following
    return summary


def _check_index(summary: Summary, summary_start: int) -> None:
    """Raises DamageError if there is a chunk where none can be, or times contradict each other."""
    statistics = summary.statistics
    for chunk in summary.chunk_indexes:
        if chunk.chunk_start_offset + chunk.chunk_length > summary_start:
            raise DamageError(f"its index has a chunk at byte {chunk.chunk_start_offset}, where none can be")
        if statistics is not None and chunk.message_end_time:  # 0 in a chunk without messages
            times_ns = statistics.message_start_time, chunk.message_start_time, chunk.message_end_time
            if not times_ns[0] <= times_ns[1] <= times_ns[2] <= statistics.message_end_time:
                raise DamageError("the times of its chunks and those of all its messages contradict each other")


def _content(stream: IO[bytes], chunk: ChunkIndex) -> bytes:
    """Returns what the chunk of an index entry holds; raises DamageError if it is not the one in the index."""
    stream.seek(chunk.chunk_start_offset)
    data = stream.read(chunk.chunk_length)  # no longer than the file, as the index has been checked
    try:
        opcode, end = record_at(data, 0)
        head = chunk_head(data, 0)
    except DamageError as error:
        raise DamageError(f"the chunk at byte {chunk.chunk_start_offset} makes no sense: {error}") from error
    if opcode != Opcode.CHUNK or not head.is_whole or end != len(data):
        raise DamageError(f"the chunk at byte {chunk.chunk_start_offset} is none, or its lengths are wrong")
    if (head.start_ns, head.end_ns) != (chunk.message_start_time, chunk.message_end_time):
        raise DamageError(f"the chunk at byte {chunk.chunk_start_offset} and the index contradict each other")
    return chunk_content(data, head)


def _damage_named(path: Path, messages: Iterator[RawMessage]) -> Iterator[RawMessage]:
    """Passes messages on; damage found on the way becomes a LogError that names the file."""
    while True:
        try:
            message = next(messages)
        except StopIteration:
            return
        except OSError as error:
            raise LogError(f"{path} cannot be read: {error.strerror or error}") from error
        except (ValueError, struct.error) as error:  # DamageError; and what comes of a file that shrinks meanwhile
            raise LogError(f"{path} is damaged ({_described(path, error)}){_HINT}") from error
        yield message
