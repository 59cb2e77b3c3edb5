"""Records of MCAP files, read within bounds: nothing is believed that the size of the file contradicts.

The mcap package takes what it gets where less is there than a length says, and unpacks whatever a chunk holds.
"""

import io
import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple, TypeVar

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Schema

from replay.file_bytes import FileBytes
from replay.logged_message import NO_SCHEMA, LoggedSchema

R = TypeVar("R", bound=McapRecord)
Buffer = bytes | FileBytes

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time, before the data
_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size, CRC, length of the compression's name
_COMPRESSIONS = {b"": "", b"lz4": "lz4", b"zstd": "zstd"}
_IN_CHUNKS = (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA)
PRIVATE = 0x80  # opcodes from here on are anybody's own
PLAIN_BYTES = 1 << 26  # up to here a chunk may be packed as tightly as it likes
TIGHTEST = 100  # a larger one is a bomb if it is packed more tightly than this


class DamageError(ValueError):
    """Bytes that are not what was written; the message says what is wrong with them."""


class ChunkHead(NamedTuple):
    """What stands before a chunk's data, and where these are."""

    start_ns: int
    end_ns: int
    size: int  # uncompressed
    crc: int  # of the uncompressed content; 0: none
    compression: str
    data_at: int
    end: int  # of the data, by their own length
    record_end: int  # by the record's

    @property
    def is_whole(self) -> bool:
        """Whether both lengths say the same."""
        return self.end == self.record_end


def record_at(data: Buffer, at: int) -> tuple[int, int]:
    """Returns a record's opcode and where it ends; raises DamageError if that is beyond the data."""
    if at + RECORD.size > len(data):
        raise DamageError("it is cut short")
    opcode, length = RECORD.unpack(data[at : at + RECORD.size])
    if length > len(data) - at - RECORD.size:
        raise DamageError(f"it is cut short or damaged: it claims {length} bytes")
    return opcode, at + RECORD.size + length


def chunk_head(data: Buffer, at: int) -> ChunkHead:
    """Returns the head of the chunk whose record begins at an offset; raises DamageError if it makes no sense."""
    body_at = at + RECORD.size
    if body_at + _CHUNK.size + 8 > len(data):
        raise DamageError("it is cut short")
    _, length = RECORD.unpack(data[at:body_at])
    start_ns, end_ns, size, crc, named = _CHUNK.unpack(data[body_at : body_at + _CHUNK.size])
    name_at = body_at + _CHUNK.size
    name = data[name_at : name_at + min(named, 8)]
    if name not in _COMPRESSIONS or named != len(name):
        raise DamageError(f"it names an unknown compression, {name!r}")
    data_at = name_at + named + 8
    if data_at > len(data):
        raise DamageError("it is cut short")
    end = data_at + int.from_bytes(data[data_at - 8 : data_at], "little")
    if end > len(data):
        raise DamageError("it is cut short or damaged")
    return ChunkHead(start_ns, end_ns, size, crc, _COMPRESSIONS[name], data_at, end, body_at + length)


def begins_as_chunk(data: Buffer, at: int) -> bool:
    """Tells whether what is at an offset was a chunk, by lengths that agree, whatever became of its content."""
    head = data[at : at + RECORD.size + _CHUNK.size + 4 + 8]  # with the name of the compression and the data's length
    if len(head) < RECORD.size + _CHUNK.size + 8 or head[0] != Opcode.CHUNK:
        return False
    _, length = RECORD.unpack_from(head)
    named = _CHUNK.unpack_from(head, RECORD.size)[-1]
    name_at = RECORD.size + _CHUNK.size
    if named > 4 or head[name_at : name_at + named] not in _COMPRESSIONS:
        return False
    data_at = name_at + named + 8
    return bool(length == data_at - RECORD.size + int.from_bytes(head[data_at - 8 : data_at], "little"))


def chunk_content(data: Buffer, head: ChunkHead) -> bytes:
    """Returns a chunk's content, checked against its size and CRC; raises DamageError.

    Unpacks no more than the size that the chunk claims, and no claim is believed that only a bomb would make.
    """
    # a copy less, where there is one already
    packed = memoryview(data)[head.data_at : head.end] if isinstance(data, bytes) else data[head.data_at : head.end]
    if head.size > max(PLAIN_BYTES, TIGHTEST * len(packed)):
        raise DamageError(f"its {len(packed)} bytes claim to hold {head.size}")
    content = _unpacked(packed, head)
    if len(content) != head.size:
        raise DamageError(f"it holds {len(content)} bytes instead of {head.size}")
    if head.crc and (found := zlib.crc32(content)) != head.crc:
        raise DamageError(f"its crc is {found:08x} instead of {head.crc:08x}")
    return content


def _unpacked(packed: bytes | memoryview, head: ChunkHead) -> bytes:
    """Returns at most a byte more than the chunk claims to hold."""
    try:
        match head.compression:
            case "zstd":
                told = zstandard.get_frame_parameters(packed).content_size
                if told not in (head.size, zstandard.CONTENTSIZE_UNKNOWN):
                    raise DamageError(f"it holds {told} bytes instead of {head.size}")
                return bytes(zstandard.ZstdDecompressor().decompress(packed, max_output_size=max(1, head.size)))
            case "lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=head.size + 1))
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise DamageError(f"it cannot be unpacked: {error}") from error
    return bytes(packed)


def records_in(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yields opcode, begin and end of the body of each record in a chunk; raises DamageError if one cannot be there."""
    at, whole = 0, len(content)
    while at < whole:
        if at + RECORD.size > whole:
            raise DamageError("a record in it is cut short")
        opcode, length = RECORD.unpack_from(content, at)
        at += RECORD.size
        if length > whole - at or (opcode == Opcode.MESSAGE and length < MESSAGE.size):
            raise DamageError(f"a record in it has an impossible length, {length}")
        if opcode not in _IN_CHUNKS and opcode < PRIVATE:
            raise DamageError(f"a record in it is of a kind that cannot be there, {opcode}")
        yield opcode, at, at + length
        at += length


def parsed(kind: type[R], body: bytes, *, exact: bool = False) -> R:
    """Returns a record from its body; raises DamageError if it takes more, or if it must be `exact`, less than that.

    Less may be there for a reason: later versions of MCAP may append fields.
    """
    stream = _ExactStream(io.BytesIO(body))
    try:
        record: R = kind.read(stream)  # type: ignore[attr-defined]
    except (EndOfFile, ValueError, OverflowError) as error:
        raise DamageError(f"a {kind.__name__} makes no sense") from error
    if exact and stream.count != len(body):
        raise DamageError(f"a {kind.__name__} of {len(body)} bytes takes {stream.count}")
    return record


class _ExactStream(ReadDataStream):
    """Does not take less than it asked for."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data


def crc_of(data: FileBytes, begin: int, end: int) -> int:
    """Returns the CRC of part of a file, of which no more than a piece is in memory."""
    crc = 0
    for at in range(begin, end, 1 << 20):
        crc = zlib.crc32(data[at : min(at + (1 << 20), end)], crc)
    return crc


def schema_of(schema: Schema | None) -> LoggedSchema:
    """Returns a schema as messages carry it."""
    return LoggedSchema(schema.name, schema.encoding, schema.data) if schema else NO_SCHEMA


def declared(channel: Channel, schema: Schema | None) -> tuple[str, LoggedSchema, str]:
    """Returns what a channel says of its messages: topic, schema, encoding."""
    return channel.topic, schema_of(schema), channel.message_encoding
