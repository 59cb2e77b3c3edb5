"""Recordings in: several MCAP files as one stream of raw messages in log-time order, CRCs checked.

Memory is bounded by the chunks that overlap in time, whatever the length of the log. Files are opened for reading only.
"""

import contextlib
import errno
import hashlib
import heapq
import io
import mmap
import struct
import threading
import zlib
from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from operator import attrgetter
from pathlib import Path
from typing import IO, cast

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import MAGIC_SIZE, breakup_chunk, get_chunk_data_stream

from replay.errors import LogError
from replay.logged_message import NO_SCHEMA, ChannelInfo, LoggedSchema, RawMessage

# Files without an index, and damaged ones, come in file order: writers interleave sensors by less than this.
REORDER_NS = 2_000_000_000


@dataclass
class Losses:
    """What `--salvage` could not read."""

    chunks: int = 0
    notes: list[str] = field(default_factory=list)


class LogReader:
    """Several MCAP files (a split recording, a drive and its sidecar) read as one log.

    Raises LogError naming file and problem if a file is no MCAP, is cut short, or has no summary, unless `salvage`.
    """

    def __init__(self, paths: Sequence[Path], *, salvage: bool = False):
        if not paths:
            raise LogError("no recording given")
        self.paths = tuple(paths)
        self.losses = Losses()
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
        streams = [file.messages(topics, start_ns, end_ns) for file in self._files]
        return heapq.merge(*streams, key=_log_time)


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
    """An intact MCAP file, read through its index."""

    def __init__(self, path: Path):
        self._path = path
        with path.open("rb") as stream:
            try:
                summary = SeekingReader(stream, validate_crcs=True).get_summary()
                _check_summary_crc(stream)
            except Exception as error:  # what mcap raises on damage has no common base
                if isinstance(error, OSError) and error.errno != errno.EINVAL:  # that is a seek before the beginning
                    raise
                raise LogError(f"{path} is not a readable MCAP file ({_described(path, error)}){_HINT}") from error
        if summary is None or summary.statistics is None:
            raise LogError(f"{path} has no summary section: the recording was not closed{_HINT}")
        counts = summary.statistics.channel_message_counts
        self._summary = summary
        self.start_ns = summary.statistics.message_start_time
        self.end_ns = summary.statistics.message_end_time
        self.channels = tuple(
            ChannelInfo(channel.topic, _schema_of(summary.schemas, channel), channel.message_encoding, count)
            for identifier, channel in summary.channels.items()
            if (count := counts.get(identifier, 0))
        )

    def messages(
        self, topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[RawMessage]:
        with self._path.open("rb") as stream:
            raw = self._chunks(stream, topics, start_ns, end_ns) if self._summary.chunk_indexes else self._plain(stream)
            for message in _damage_named(self._path, raw):
                if (
                    (topics is None or message.topic in topics)
                    and (start_ns is None or message.log_time_ns >= start_ns)
                    and (end_ns is None or message.log_time_ns < end_ns)
                ):
                    yield message

    def _plain(self, stream: IO[bytes]) -> Iterator[RawMessage]:
        """Yields the messages of a file without chunks."""
        records = NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        schemas = {number: _schema_of(self._summary.schemas, c) for number, c in self._summary.channels.items()}
        return _reordered(_raw(schemas[channel.id], channel, message) for _, channel, message in records)

    def _chunks(
        self, stream: IO[bytes], topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[RawMessage]:
        """Yields the messages of the chunks that hold something wanted, in log-time order.

        A message waits only for the chunks that begin before it. (mcap's own reader keeps every message in a heap with
        a comparison in Python, which costs more than everything else there is to do with it.)
        """
        channels = self._summary.channels
        schemas = {identifier: _schema_of(self._summary.schemas, channel) for identifier, channel in channels.items()}
        wanted = {identifier for identifier, channel in channels.items() if topics is None or channel.topic in topics}
        chunks = sorted(
            (
                chunk
                for chunk in self._summary.chunk_indexes
                if (not chunk.message_index_offsets or wanted & chunk.message_index_offsets.keys())
                and (start_ns is None or chunk.message_end_time >= start_ns)
                and (end_ns is None or chunk.message_start_time < end_ns)
            ),
            key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset),
        )
        waiting: list[RawMessage] = []
        for chunk, following in zip_longest(chunks, chunks[1:]):
            stream.seek(chunk.chunk_start_offset + _RECORD.size)
            for identifier, log_time_ns, data in _chunk_messages(Chunk.read(ReadDataStream(stream))):
                if identifier in wanted:
                    channel = channels[identifier]
                    encoding = channel.message_encoding
                    waiting.append(RawMessage(channel.topic, log_time_ns, schemas[identifier], encoding, data))
            waiting.sort(key=_log_time)
            ready = bisect_left(waiting, following.message_start_time, key=_log_time) if following else len(waiting)
            yield from waiting[:ready]
            del waiting[:ready]


class _SalvagedFile:
    """A damaged MCAP file, read chunk by chunk; bad chunks are left out and counted once.

    Two passes: a topic may be declared in a chunk that is lost, and again in the summary at the end.
    """

    def __init__(self, path: Path, losses: Losses):
        self._path = path
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        counts: Counter[int] = Counter()
        recorded = 0
        if path.stat().st_size == 0:
            losses.notes.append(f"{path.name}: the file is empty")
        else:
            with path.open("rb") as stream, contextlib.suppress(OSError):  # a seek before the beginning
                try:
                    _check_summary_crc(stream)
                except ValueError as error:
                    losses.notes.append(f"{path.name}: {error}")
        self.start_ns, self.end_ns = 2**63, 0
        for record in self._records(losses):
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._channels[record.id] = record
            elif isinstance(record, Message):
                counts[record.channel_id] += 1
                self.start_ns = min(self.start_ns, record.log_time)
                self.end_ns = max(self.end_ns, record.log_time)
            elif isinstance(record, Statistics):
                recorded = record.message_count
        if not losses.notes and counts.total() < recorded:
            # a damaged record header hides a whole chunk without a trace of it
            losses.notes.append(f"{path.name}: {recorded - counts.total()} of {recorded} recorded messages are missing")
        if undeclared := sum(count for channel, count in counts.items() if channel not in self._channels):
            losses.notes.append(f"{path.name}: {undeclared} messages of topics whose declaration is lost")
        self._schema_of = {number: _schema_of(self._schemas, channel) for number, channel in self._channels.items()}
        self.channels = tuple(
            ChannelInfo(channel.topic, self._schema_of[identifier], channel.message_encoding, counts[identifier])
            for identifier, channel in self._channels.items()
            if counts[identifier]
        )

    def messages(
        self, topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[RawMessage]:
        raw = (
            _raw(self._schema_of[record.channel_id], channel, record)
            for record in self._records(Losses())
            if isinstance(record, Message)
            and (channel := self._channels.get(record.channel_id)) is not None
            and (topics is None or channel.topic in topics)
            and (start_ns is None or record.log_time >= start_ns)
            and (end_ns is None or record.log_time < end_ns)
        )
        return _reordered(raw)

    def _records(self, losses: Losses) -> Iterator[McapRecord]:
        """Yields the records of every intact chunk, in file order; looks for the next one behind what is damaged."""
        if self._path.stat().st_size == 0:
            return
        with self._path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as view:
            last = MAGIC_SIZE
            at: int | None = last
            while at is not None and at + _RECORD.size <= len(view):
                opcode, length = _RECORD.unpack_from(view, at)
                if opcode == Opcode.FOOTER and at + _RECORD.size + _FOOTER_END.size <= len(view):
                    return
                try:
                    if opcode == Opcode.CHUNK:
                        inside, following = _read_chunk(view, at)
                        yield from inside
                    else:
                        record, following = _read_record(view, at)
                        if record is not None:
                            yield record
                except Exception as error:  # what mcap raises on damage has no common base
                    losses.chunks += opcode == Opcode.CHUNK
                    what = "chunk" if opcode == Opcode.CHUNK else "record"
                    losses.notes.append(
                        f"{self._path.name}: {what} at byte {at} is damaged ({_described(self._path, error)})"
                    )
                    end = at + _RECORD.size + length
                    following = end if _plausible(view, end) else _find_chunk(view, at + 1)
                last, at = following or at, following
            losses.notes.append(f"{self._path.name}: nothing readable after byte {last}")


def _read_chunk(view: mmap.mmap, at: int) -> tuple[list[McapRecord], int | None]:
    """Returns the records in the chunk at an offset and where to read on; raises if it is not what was written."""
    view.seek(at + _RECORD.size)
    chunk = Chunk.read(ReadDataStream(cast(IO[bytes], view)))  # by its own length: the record's may be damaged
    if chunk.uncompressed_size > max(1 << 26, 1000 * len(chunk.data)):
        raise ValueError(f"it claims to hold {chunk.uncompressed_size} bytes")
    inside, end = breakup_chunk(chunk, validate_crc=True), view.tell()
    _, length = _RECORD.unpack_from(view, at)
    if end != at + _RECORD.size + length:  # one of the two lengths is wrong, though the content is not
        return inside, _find_chunk(view, at + 1)
    return inside, end


def _read_record(view: mmap.mmap, at: int) -> tuple[McapRecord | None, int]:
    """Returns the record at an offset, None if it is of a kind not needed here, and where it ends."""
    if not _plausible(view, at):
        raise ValueError("its header makes no sense")
    opcode, length = _RECORD.unpack_from(view, at)
    view.seek(at + _RECORD.size)
    stream, end = ReadDataStream(cast(IO[bytes], view)), at + _RECORD.size + length
    match opcode:
        case Opcode.SCHEMA:
            return Schema.read(stream), end
        case Opcode.CHANNEL:
            return Channel.read(stream), end
        case Opcode.MESSAGE:
            return Message.read(stream, length), end
        case Opcode.STATISTICS:
            return Statistics.read(stream), end
    return None, end


def _plausible(view: mmap.mmap, at: int) -> bool:
    """Tells whether a record may begin at an offset."""
    if at + _RECORD.size > len(view):
        return False
    opcode, length = _RECORD.unpack_from(view, at)
    known = 1 <= opcode <= max(Opcode) or opcode >= 0x80  # the upper half is anybody's own
    return bool(known and length <= len(view) - at - _RECORD.size)


def _find_chunk(view: mmap.mmap, start: int) -> int | None:
    """Returns where the next chunk seems to begin: an opcode, a length that fits, a compression that exists."""
    at = start
    while (at := view.find(bytes([Opcode.CHUNK]), at)) != -1:
        name_at = at + _RECORD.size + _CHUNK_HEAD_BYTES
        named = view[name_at : name_at + 8]
        if _plausible(view, at) and named.startswith(_COMPRESSIONS):
            return at
        at += 1
    return None


_RECORD = struct.Struct("<BQ")  # opcode, length of what follows
_FOOTER_END = struct.Struct("<QQI8s")  # summary start, summary offset start, CRC; then the magic that ends a file
_CHUNK_HEAD_BYTES = 8 + 8 + 8 + 4  # start, end, uncompressed size, CRC, before the name of the compression
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time, before the data
_MAGIC = b"\x89MCAP0\r\n"
_COMPRESSIONS = tuple(struct.pack("<I", len(name)) + name for name in (b"zstd", b"lz4", b""))
_OTHER_FORMATS = {b"#ROSBAG": "a ROS 1 bag", b"SQLite format 3": "a database, perhaps a ROS 2 bag of the older kind"}
_log_time = attrgetter("log_time_ns")
_HINT = "; try --salvage"


def _open(path: Path, losses: Losses | None) -> _IndexedFile | _SalvagedFile:
    try:
        with path.open("rb") as stream:
            head = stream.read(16)
        for magic, kind in _OTHER_FORMATS.items():
            if head.startswith(magic):
                raise LogError(f"{path} is {kind}, not MCAP: rosbags-convert makes MCAP of it, with --dst-storage mcap")
        return _IndexedFile(path) if losses is None else _SalvagedFile(path, losses)
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror or error}") from error


def _described(path: Path, error: Exception) -> str:
    if path.stat().st_size == 0:
        return "the file is empty"
    name = type(error).__name__
    known = {"EndOfFile": "it ends early", "RecordLengthLimitExceeded": "it is cut short or damaged"}
    return known.get(name) or f"{str(error) or name}"


def _check_summary_crc(stream: IO[bytes]) -> None:
    """Raises ValueError if the summary section is not what was written; mcap reads it unchecked.

    The CRC is the footer's last field, and covers all from the beginning of the summary up to itself.
    """
    stream.seek(-_FOOTER_END.size, io.SEEK_END)
    summary_start, _, crc, magic = _FOOTER_END.unpack(stream.read(_FOOTER_END.size))
    if magic != _MAGIC:
        raise ValueError("it does not end as an MCAP file does")
    if summary_start and crc:
        end = stream.seek(0, io.SEEK_END) - _FOOTER_END.size + 16  # the two offsets before the CRC are covered, too
        stream.seek(summary_start)
        if zlib.crc32(stream.read(end - summary_start)) != crc:
            raise ValueError("the summary's CRC is wrong")


def _chunk_messages(chunk: Chunk) -> Iterator[tuple[int, int, bytes]]:
    """Yields channel id, log time and data of each message in a chunk, its CRC checked.

    As mcap's `breakup_chunk`, without an object per message and a read per field: a log has hundreds a second.
    """
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    data = stream.read(length)
    at = 0
    while at < length:
        opcode, size = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if at + size > length:
            raise EndOfFile
        if opcode == Opcode.MESSAGE:
            identifier, _, log_time_ns, _ = _MESSAGE.unpack_from(data, at)
            yield identifier, log_time_ns, data[at + _MESSAGE.size : at + size]
        at += size


def _damage_named(path: Path, messages: Iterator[RawMessage]) -> Iterator[RawMessage]:
    """Passes messages on; damage found on the way becomes a LogError that names the file."""
    while True:
        try:
            message = next(messages)
        except StopIteration:
            return
        except Exception as error:  # what mcap raises on damage has no common base
            raise LogError(f"{path} is damaged ({_described(path, error)}){_HINT}") from error
        yield message


def _schema_of(schemas: Mapping[int, Schema], channel: Channel) -> LoggedSchema:
    schema = schemas.get(channel.schema_id)
    return LoggedSchema(schema.name, schema.encoding, schema.data) if schema else NO_SCHEMA


def _raw(schema: LoggedSchema, channel: Channel, message: Message) -> RawMessage:
    return RawMessage(channel.topic, message.log_time, schema, channel.message_encoding, message.data)


def _reordered(messages: Iterable[RawMessage]) -> Iterator[RawMessage]:
    """Sorts messages that are out of log-time order by less than REORDER_NS; stable."""
    waiting: list[tuple[int, int, RawMessage]] = []
    for index, message in enumerate(messages):
        heapq.heappush(waiting, (message.log_time_ns, index, message))
        while waiting[0][0] <= message.log_time_ns - REORDER_NS:
            yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]
