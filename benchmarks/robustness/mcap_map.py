"""Where the chunks and messages of an intact MCAP file lie, read with `struct` alone.

Neither the mcap package nor our reader is used: this is what both are measured against.
"""

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
HEADER = struct.Struct("<BQ")  # opcode and length of each record
CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, uncompressed size, CRC, length of the compression's name
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 2, 3, 4, 5, 6, 15


class Content(NamedTuple):
    """A message as a reader should give it."""

    topic: str
    log_time_ns: int
    data: bytes


@dataclass(frozen=True)
class Piece:
    """A record of the file, with everything inside it if it is a chunk."""

    start: int
    end: int
    opcode: int
    messages: tuple[tuple[int, int, bytes], ...] = ()  # channel, log time, data
    channels: tuple[tuple[int, str], ...] = ()  # id, topic; declared here
    content: bytes = b""  # of a chunk, uncompressed


@dataclass(frozen=True)
class McapMap:
    """An intact file and its records in order."""

    data: bytes
    pieces: tuple[Piece, ...]

    @cached_property
    def chunks(self) -> tuple[Piece, ...]:
        """The records that are chunks."""
        return tuple(piece for piece in self.pieces if piece.opcode == CHUNK)

    @cached_property
    def topics(self) -> dict[int, str]:
        """Every declared channel's topic."""
        return {number: topic for piece in self.pieces for number, topic in piece.channels}

    @cached_property
    def messages(self) -> Counter[Content]:
        """All messages."""
        return self.expected([(0, len(self.data))])

    @cached_property
    def summary_start(self) -> int:
        """Where the summary begins, which is right behind the end of the data."""
        return next(piece.end for piece in self.pieces if piece.opcode == DATA_END)

    def expected(self, kept: list[tuple[int, int]], guarded: bool = True) -> Counter[Content]:
        """Returns the messages that must be found if only these stretches of the file are left, each in one piece.

        Those are the messages of the records that lie wholly in one of them, if their topic is declared there, too.
        Where declarations are not guarded by a CRC, or one may be forged, none of a topic's may be damaged: who knows
        which of them is the right one?
        """
        left = [p for p in self.pieces if any(start <= p.start and p.end <= end for start, end in kept)]
        declared = {number for piece in left for number, _ in piece.channels}
        if not guarded:
            declared -= {number for piece in set(self.pieces) - set(left) for number, _ in piece.channels}
        return Counter(
            Content(self.topics[number], log_time_ns, data)
            for piece in left
            for number, log_time_ns, data in piece.messages
            if number in declared
        )


def read_map(data: bytes) -> McapMap:
    """Returns the map of an intact file."""
    assert data.startswith(MAGIC)
    assert data.endswith(MAGIC)
    return McapMap(data, tuple(_pieces(data, len(MAGIC), len(data) - len(MAGIC))))


def decompressed(name: bytes, data: bytes) -> bytes:
    """Returns the content of a chunk."""
    match name:
        case b"zstd":
            return zstandard.ZstdDecompressor().decompress(data)
        case b"lz4":
            return bytes(lz4.frame.decompress(data))
    return data


def _pieces(data: bytes, at: int, end: int) -> Iterator[Piece]:
    while at < end:
        opcode, length = HEADER.unpack_from(data, at)
        body = data[at + HEADER.size : at + HEADER.size + length]
        piece = Piece(at, at + HEADER.size + length, opcode)
        at = piece.end
        match opcode:
            case 6:
                yield _chunk(piece, body)
            case 5:
                number, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(body)
                yield replace(piece, messages=((number, log_time_ns, body[MESSAGE_HEAD.size :]),))
            case 4:
                number, _, size = struct.unpack_from("<HHI", body)
                yield replace(piece, channels=((number, body[8 : 8 + size].decode()),))
            case _:
                yield piece


def _chunk(piece: Piece, body: bytes) -> Piece:
    *_, named = CHUNK_HEAD.unpack_from(body)
    name = body[CHUNK_HEAD.size : CHUNK_HEAD.size + named]
    content = decompressed(name, body[CHUNK_HEAD.size + named + 8 :])
    inside = list(_pieces(content, 0, len(content)))
    return replace(
        piece,
        messages=tuple(message for each in inside for message in each.messages),
        channels=tuple(channel for each in inside for channel in each.channels),
        content=content,
    )
