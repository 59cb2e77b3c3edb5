"""Ways to damage a file, each of which knows what is left of the original.

A mutated file is a row of parts: stretches of the original, and bytes that are not. A record is undamaged if it lies
wholly in one stretch, wherever that now is.
"""

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from random import Random
from typing import NamedTuple, TypeAlias

import lz4.frame
import zstandard

from benchmarks.robustness.mcap_map import CHUNK_HEAD, HEADER, MAGIC, McapMap, Piece


class Stretch(NamedTuple):
    """Bytes of the original, from start to end."""

    start: int
    end: int


Part: TypeAlias = "Stretch | bytes"
Parts: TypeAlias = "list[Part]"


@dataclass(frozen=True)
class Mutation:
    """A file that was an intact one."""

    kind: str
    parts: tuple[Part, ...]
    forged: bool = False  # its CRCs were made right: nobody can tell the damage from the truth

    def applied(self, data: bytes) -> bytes:
        """Returns the mutated file."""
        return b"".join(data[part.start : part.end] if isinstance(part, Stretch) else part for part in self.parts)

    def kept(self) -> list[tuple[int, int]]:
        """Returns the stretches of the original that are still in one piece."""
        kept: list[tuple[int, int]] = []
        broken = True
        for part in self.parts:
            if not isinstance(part, Stretch):
                broken = broken or bool(part)
            elif kept and not broken and kept[-1][1] == part.start:
                kept[-1] = (kept[-1][0], part.end)
            else:
                kept.append(part)
                broken = False
        return kept


# --- bytes ---------------------------------------------------------------------------------------------------------


def overwritten(source: McapMap, *changes: tuple[int, bytes]) -> Parts:
    """Returns the file with some bytes in the place of others."""
    parts: Parts = []
    at = 0
    for place, data in sorted(changes):
        if place < at:
            continue
        parts += [Stretch(at, place), data]
        at = place + len(data)
    return [*parts, Stretch(min(at, len(source.data)), len(source.data))]


def _block(source: McapMap, random: Random) -> Stretch:
    """Picks a stretch of the file: short or long, often along the borders of records."""
    if random.random() < 0.3:
        first = random.randrange(len(source.pieces))
        last = min(first + random.choice((0, 0, 1, 3)), len(source.pieces) - 1)
        return Stretch(source.pieces[first].start, source.pieces[last].end)
    length = min(int(2 ** random.uniform(0, 14)), len(source.data) // 2)
    start = random.randrange(len(source.data) - length)
    return Stretch(start, start + length)


def _flipped_bits(source: McapMap, random: Random) -> Parts:
    places = random.sample(range(len(source.data)), random.choice((1, 1, 1, 2, 5, 30)))
    return overwritten(source, *((at, bytes([source.data[at] ^ 1 << random.randrange(8)])) for at in places))


def _zeroed_block(source: McapMap, random: Random) -> Parts:
    start, end = _block(source, random)
    return overwritten(source, (start, bytes(end - start)))


def _random_block(source: McapMap, random: Random) -> Parts:
    start, end = _block(source, random)
    return overwritten(source, (start, random.randbytes(end - start)))


def _cut_short(source: McapMap, random: Random) -> Parts:
    return [Stretch(0, random.randrange(len(source.data)))]


def _zeroed_tail(source: McapMap, random: Random) -> Parts:
    cut = random.randrange(len(source.data))
    return [Stretch(0, cut), bytes(len(source.data) - cut)]


def _removed_block(source: McapMap, random: Random) -> Parts:
    start, end = _block(source, random)
    return [Stretch(0, start), Stretch(end, len(source.data))]


def _inserted_block(source: McapMap, random: Random) -> Parts:
    place = _block(source, random).start
    length = int(2 ** random.uniform(0, 13))
    new = random.choice((random.randbytes(length), bytes(length), b"\x06" * length, b"\xff" * length))
    return [Stretch(0, place), new, Stretch(place, len(source.data))]


def _doubled_block(source: McapMap, random: Random) -> Parts:
    start, end = _block(source, random)
    return [Stretch(0, end), Stretch(start, end), Stretch(end, len(source.data))]


def _copied_block(source: McapMap, random: Random) -> Parts:
    block, place = _block(source, random), _block(source, random).start
    return [Stretch(0, place), source.data[block.start : block.end], Stretch(place, len(source.data))]


def _swapped_blocks(source: McapMap, random: Random) -> Parts:
    (a, b), (c, d) = sorted((_block(source, random), _block(source, random)))
    c, d = max(b, c), max(b, d)
    return [Stretch(0, a), Stretch(c, d), Stretch(b, c), Stretch(a, b), Stretch(d, len(source.data))]


def _shuffled_records(source: McapMap, random: Random) -> Parts:
    pieces = [Stretch(piece.start, piece.end) for piece in source.pieces]
    random.shuffle(pieces)
    return [MAGIC, *pieces, MAGIC]


def _random_file(source: McapMap, random: Random) -> Parts:
    length = random.choice((0, 1, 7, 8, 9, 40, 300, len(source.data)))
    noise = random.choice((random.randbytes(length), bytes(length), b"\x06" * length, b"MCAP" * (length // 4)))
    head, tail = random.random() < 0.5, random.random() < 0.5
    return [MAGIC * head + noise + MAGIC * tail]


def _appended(source: McapMap, random: Random) -> Parts:
    whole = Stretch(0, len(source.data))
    return [whole, random.choice((b"\n", bytes(4096), random.randbytes(500), MAGIC, source.data[:200]))]


# --- records -------------------------------------------------------------------------------------------------------

_NUMBERS = (0, 1, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)  # what breaks what counts


def _number(random: Random, was: int) -> bytes:
    """Returns 64 bits that are not the ones that were: absurd, a little off, or with one bit flipped."""
    near = (was + random.choice((-9, -1, 1, 9, 100)), was ^ 1 << random.randrange(24))
    return struct.pack("<Q", random.choice((*_NUMBERS, *near)) % 2**64)


def _wrong_lengths(source: McapMap, random: Random) -> Parts:
    places = [piece.start + 1 for piece in random.choices(source.pieces, k=random.choice((1, 1, 2)))]
    return overwritten(
        source, *((at, _number(random, int.from_bytes(source.data[at : at + 8], "little"))) for at in places)
    )


def _wrong_opcodes(source: McapMap, random: Random) -> Parts:
    places = [piece.start for piece in random.choices(source.pieces, k=random.choice((1, 1, 3)))]
    return overwritten(source, *((at, bytes([random.choice((*range(17), 0x7F, 0x80, 0xFF))])) for at in places))


def _any_piece(source: McapMap, random: Random) -> Piece:
    return random.choice(source.chunks or source.pieces)


def _chunk_head(source: McapMap, random: Random) -> Parts:
    """Times, sizes, CRC, compression or length of one chunk; of a record without chunks its first bytes."""
    at = _any_piece(source, random).start + HEADER.size
    name_at = at + CHUNK_HEAD.size
    named = int.from_bytes(source.data[name_at - 4 : name_at], "little") % 16
    change = random.choice(
        (
            *((at + offset, _number(random, 5000)) for offset in (0, 8, 16)),
            (at + 24, random.randbytes(4)),
            (at + 24, bytes(4)),
            (name_at - 4, _number(random, 4)[:4]),
            (name_at, random.choice((b"zstd", b"lz4\0", b"none", b"\xff\xfe\xfd\xfc", bytes(4)))),
            (name_at + named, _number(random, 1000)),
        )
    )
    return overwritten(source, change)


def _wrong_magic(source: McapMap, random: Random) -> Parts:
    place = random.choice((0, len(source.data) - len(MAGIC))) + random.randrange(len(MAGIC))
    return overwritten(source, (place, random.randbytes(1)))


def _footer_astray(source: McapMap, random: Random) -> Parts:
    """The footer points anywhere, or is gone with part of the summary."""
    end = len(source.data) - len(MAGIC)
    if random.random() < 0.3:
        return [Stretch(0, random.randrange(source.summary_start, end)), MAGIC]
    start = random.choice((*_NUMBERS, source.pieces[0].start, random.choice(source.pieces).start, end - 20))
    return overwritten(
        source, (end - 20, struct.pack("<Q", start)), (end - 4, random.choice((bytes(4), b"\x01\x02\x03\x04")))
    )


def _summary_damaged(source: McapMap, random: Random) -> Parts:
    place = random.randrange(source.summary_start, len(source.data) - len(MAGIC))
    return overwritten(source, (place, random.randbytes(random.choice((1, 1, 8)))))


# --- forgeries: every CRC is right -----------------------------------------------------------------------------------


def _forged_summary(source: McapMap, random: Random) -> Parts:
    """The summary says something else, under a CRC that is right: offsets, times, counts, names, lengths."""
    start, crc_at = source.summary_start, len(source.data) - len(MAGIC) - 4
    summary = bytearray(source.data[start:crc_at])
    for _ in range(random.choice((1, 1, 3))):
        at = random.randrange(len(summary) - 8)
        new = random.choice((_number(random, int.from_bytes(summary[at : at + 8], "little")), random.randbytes(1)))
        summary[at : at + len(new)] = new
    return [Stretch(0, start), bytes(summary), struct.pack("<I", zlib.crc32(summary)), MAGIC]


def _in_place_of(
    source: McapMap, chunk: Piece, content: bytes, compression: bytes = b"", size: int | None = None
) -> Parts:
    """Returns the file with another chunk in the place of one; all behind it keeps its place if it is as long."""
    start_ns, end_ns, *_ = CHUNK_HEAD.unpack_from(source.data, chunk.start + HEADER.size)
    packed = {b"zstd": zstandard.compress, b"lz4": lz4.frame.compress}.get(compression, bytes)(content)
    claimed = len(content) if size is None else size
    head = CHUNK_HEAD.pack(start_ns, end_ns, claimed, zlib.crc32(content), len(compression))
    body = head + compression + struct.pack("<Q", len(packed)) + packed
    return [
        Stretch(0, chunk.start),
        HEADER.pack(6, len(body)) + body,
        Stretch(chunk.end, len(source.data)),
    ]


def _forged_chunk(source: McapMap, random: Random) -> Parts:
    """A chunk holds nonsense under a CRC that is right: record lengths, channels, times, payloads."""
    if not source.chunks:
        return _flipped_bits(source, random)
    chunk = random.choice(source.chunks)
    content = bytearray(chunk.content)
    heads = list(_heads(chunk.content))
    for _ in range(random.choice((1, 2, 10))):
        at = random.choice((random.randrange(len(content)), random.choice(heads) + random.randrange(31)))
        new = random.choice((random.randbytes(1), _number(random, int.from_bytes(content[at : at + 8], "little"))))
        content[at : at + len(new)] = new[: max(0, len(content) - at)]
    return _in_place_of(source, chunk, bytes(content))


def _heads(content: bytes) -> Iterator[int]:
    at = 0
    while at < len(content):
        yield at
        at += HEADER.size + HEADER.unpack_from(content, at)[1]


BOMB_BYTES = 1 << 28  # what a bomb unpacks to


def _bomb(source: McapMap, random: Random) -> Parts:
    """A chunk of some kilobytes unpacks to a quarter of a gigabyte of zeros, and says so, or says less, or more."""
    if not source.chunks:
        return _wrong_lengths(source, random)
    chunk = random.choice(source.chunks)
    name, packed = random.choice(_bombs())
    start_ns, end_ns, *_ = CHUNK_HEAD.unpack_from(source.data, chunk.start + HEADER.size)
    claimed = random.choice((len(chunk.content), BOMB_BYTES, 2**62))
    head = CHUNK_HEAD.pack(start_ns, end_ns, claimed, random.choice((0, 12345)), len(name))
    body = head + name + struct.pack("<Q", len(packed)) + packed
    return [Stretch(0, chunk.start), HEADER.pack(6, len(body)) + body, Stretch(chunk.end, len(source.data))]


_made_bombs: list[tuple[bytes, bytes]] = []


def _bombs() -> list[tuple[bytes, bytes]]:
    """Returns compressed zeros, made in small pieces, with and without their length in front."""
    if not _made_bombs:
        piece = bytes(1 << 20)
        for told in (BOMB_BYTES, -1):
            zstd = zstandard.ZstdCompressor().compressobj(size=told)
            packed = b"".join([zstd.compress(piece) for _ in range(BOMB_BYTES >> 20)])
            _made_bombs.append((b"zstd", packed + zstd.flush()))
        for told in (BOMB_BYTES, 0):
            with lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB) as compressor:
                packed = compressor.begin(told)
                packed += b"".join([compressor.compress(piece) for _ in range(BOMB_BYTES >> 20)])
                _made_bombs.append((b"lz4", packed + compressor.flush()))
    return _made_bombs


DAMAGE: dict[str, Callable[[McapMap, Random], Parts]] = {
    "flipped bits": _flipped_bits,
    "zeroed block": _zeroed_block,
    "block of noise": _random_block,
    "cut short": _cut_short,
    "zeroed tail": _zeroed_tail,
    "removed block": _removed_block,
    "inserted block": _inserted_block,
    "doubled block": _doubled_block,
    "block copied elsewhere": _copied_block,
    "swapped blocks": _swapped_blocks,
    "shuffled records": _shuffled_records,
    "wrong lengths": _wrong_lengths,
    "wrong opcodes": _wrong_opcodes,
    "chunk header": _chunk_head,
    "wrong magic": _wrong_magic,
    "footer astray": _footer_astray,
    "summary damaged": _summary_damaged,
    "something appended": _appended,
    "no recording at all": _random_file,
}
FORGERIES: dict[str, Callable[[McapMap, Random], Parts]] = {
    "summary, CRC right": _forged_summary,
    "chunk, CRC right": _forged_chunk,
    "decompression bomb": _bomb,
}


def mutate(source: McapMap, kind: str, random: Random) -> Mutation:
    """Returns the file mutated in one way; the same random state gives the same file."""
    if kind in FORGERIES:
        return Mutation(kind, tuple(FORGERIES[kind](source, random)), forged=True)
    return Mutation(kind, tuple(DAMAGE[kind](source, random)))
