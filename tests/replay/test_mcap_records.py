"""Records within bounds: what is too long, too short, too tightly packed or not what its CRC says is refused."""

import struct
import tracemalloc
import zlib

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Statistics

from replay.mcap_records import DamageError, begins_as_chunk, chunk_content, chunk_head, parsed, record_at, records_in

PACKED = {"": bytes, "lz4": lz4.frame.compress, "zstd": zstandard.compress}
each_compression = pytest.mark.parametrize("compression", PACKED)


def chunk(content, compression="", *, packed=None, **claims):
    """A chunk's record; `claims` are sizes, CRC or lengths that are not the true ones."""
    packed = PACKED[compression](content) if packed is None else packed
    name = claims.get("name", compression).encode()
    head = struct.pack(
        "<QQQII", 5, 9, claims.get("size", len(content)), claims.get("crc", zlib.crc32(content)), len(name)
    )
    body = head + name + struct.pack("<Q", claims.get("length", len(packed))) + packed
    return struct.pack("<BQ", 6, claims.get("record", len(body))) + body


def content_of(record):
    return chunk_content(record, chunk_head(record, 0))


@each_compression
def test_a_chunk_holds_what_was_put_into_it(compression):
    head = chunk_head(chunk(b"content", compression), 0)
    assert (head.start_ns, head.end_ns, head.size, head.compression, head.is_whole) == (5, 9, 7, compression, True)
    assert content_of(chunk(b"content", compression)) == b"content"
    assert content_of(chunk(b"", compression)) == b""


@each_compression
@pytest.mark.parametrize(
    ("claims", "problem"),
    [
        ({"crc": 1}, "its crc is .* instead of 00000001"),
        ({"size": 6}, "it (holds|cannot be unpacked).*"),
        ({"size": 8}, "it holds 7 bytes instead of 8"),
        ({"size": 2**62}, r"its \d+ bytes claim to hold 4611686018427387904"),
        ({"length": 2**40}, "it is cut short or damaged"),
        ({"name": "zip"}, "it names an unknown compression, b'zip"),
        ({"name": "x" * 99}, "it names an unknown compression"),
    ],
)
def test_a_chunk_that_is_not_what_it_says_is_refused(compression, claims, problem):
    with pytest.raises(DamageError, match=problem):
        content_of(chunk(b"content", compression, **claims))


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_what_does_not_unpack_is_refused(compression):
    packed = bytearray(PACKED[compression](b"some content" * 50))
    with pytest.raises(DamageError):
        content_of(chunk(b"some content" * 50, compression, packed=bytes(packed[:-9])))
    packed[4] ^= 0xFF
    with pytest.raises(DamageError):
        content_of(chunk(b"some content" * 50, compression, packed=bytes(packed)))


@pytest.mark.parametrize("told", [True, False], ids=["says its length", "does not say it"])
@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_a_bomb_takes_no_memory(compression, told):
    """100 MB of zeros in a chunk that claims to hold 1 kB, or all of them."""
    zeros = bytes(100 << 20)
    if compression == "zstd":
        packed = zstandard.ZstdCompressor(write_content_size=told).compress(zeros)
    else:
        packed = lz4.frame.compress(zeros, store_size=told, block_size=lz4.frame.BLOCKSIZE_MAX4MB)
    for size in (1000, len(zeros)):
        record = chunk(b"", compression, packed=packed, size=size, crc=0)
        tracemalloc.start()
        with pytest.raises(DamageError, match=r"it holds|it cannot be unpacked|claim to hold"):
            content_of(record)
        assert tracemalloc.get_traced_memory()[1] < 12 << 20
        tracemalloc.stop()


def test_two_lengths_that_differ_are_seen():
    assert not chunk_head(chunk(b"content", record=999), 0).is_whole
    assert chunk_head(chunk(b"content", record=999) + bytes(9), 0).record_end == 9 + 999


@each_compression
def test_a_chunk_is_known_by_its_head_whatever_became_of_its_content(compression):
    whole = chunk(b"content" * 9, compression)
    assert begins_as_chunk(whole, 0)
    assert begins_as_chunk(whole[:60] + bytes(len(whole)), 0)
    for other in (b"\x05" + whole[1:], whole[:9], b"\x06" + bytes(20) + whole, chunk(b"content", name="xz")):
        assert not begins_as_chunk(other, 0)


@pytest.mark.parametrize("cut", range(0, 60, 7))
def test_a_chunk_that_is_cut_is_refused(cut):
    record = chunk(b"content" * 3)
    with pytest.raises(DamageError):
        content_of(record[:cut])


def test_a_record_reaches_no_farther_than_the_data():
    assert record_at(struct.pack("<BQ", 5, 3) + b"abc", 0) == (5, 12)
    for data in (b"\x05", struct.pack("<BQ", 5, 4) + b"abc", struct.pack("<BQ", 5, 2**64 - 1)):
        with pytest.raises(DamageError, match="cut short"):
            record_at(data, 0)


def record(opcode, body):
    return struct.pack("<BQ", opcode, len(body)) + body


def test_records_in_a_chunk_are_found_and_private_ones_with_them():
    content = record(Opcode.MESSAGE, bytes(25)) + record(0x90, b"private") + record(Opcode.SCHEMA, b"")
    assert [(opcode, end - begin) for opcode, begin, end in records_in(content)] == [(5, 25), (0x90, 7), (3, 0)]


@pytest.mark.parametrize(
    "content",
    [
        record(Opcode.MESSAGE, bytes(21)),
        record(Opcode.MESSAGE, bytes(25))[:-1],
        record(Opcode.MESSAGE, bytes(25)) + b"\x05\x00",
        record(Opcode.CHUNK, bytes(25)),
        record(0, bytes(25)),
        struct.pack("<BQ", 5, 2**63),
    ],
    ids=["too short for a message", "cut", "cut in a header", "a chunk in it", "no opcode", "endless"],
)
def test_what_cannot_be_in_a_chunk_is_refused(content):
    with pytest.raises(DamageError, match="a record in it"):
        list(records_in(content))


def body(of):
    builder = RecordBuilder()
    of.write(builder)
    return builder.end()[9:]


def test_a_record_takes_no_less_than_it_says():
    channel = Channel(3, "/topic", "cdr", {"key": "value"}, 2)
    whole = body(channel)
    assert parsed(Channel, whole, exact=True) == channel
    for cut in range(len(whole)):
        with pytest.raises(DamageError, match="a Channel makes no sense"):
            parsed(Channel, whole[:cut])
    assert parsed(Channel, whole + b"later") == channel
    with pytest.raises(DamageError, match=f"a Channel of {len(whole) + 5} bytes takes {len(whole)}"):
        parsed(Channel, whole + b"later", exact=True)


def test_counts_that_claim_gigabytes_end_with_the_record():
    data = bytearray(body(Statistics(0, 1, {1: 5}, 1, 5, 2, 1, 0, 1)))
    data[42:46] = struct.pack("<I", 2**32 - 1)
    with pytest.raises(DamageError, match="a Statistics makes no sense"):
        parsed(Statistics, bytes(data))


def test_a_name_that_is_no_utf_8_is_refused():
    data = body(Channel(3, "/topic", "cdr", {}, 2)).replace(b"topic", b"\xff\xfe\xfd\xfc\xfb")
    with pytest.raises(DamageError, match="a Channel makes no sense"):
        parsed(Channel, data)
