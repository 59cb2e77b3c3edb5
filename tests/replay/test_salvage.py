"""Damage that hid whole chunks, made messages up or went unnoticed; what is intact is counted by `mcap_map` alone."""

import struct
import zlib
from collections import Counter

import pytest
from mcap.writer import CompressionType, IndexType

from benchmarks.robustness.mcap_map import HEADER, MAGIC, Content, read_map
from replay.errors import LogError
from replay.log_reader import LogReader

KINDS = {
    "uncompressed": {"chunk_size": 600},
    "zstd": {"chunk_size": 600, "compression": CompressionType.ZSTD},
    "lz4": {"chunk_size": 600, "compression": CompressionType.LZ4},
    "no CRCs": {"chunk_size": 600, "enable_crcs": False},
    "no chunks": {"use_chunking": False},
}
START_NS = 1_000_000_000


@pytest.fixture
def records(logged):
    """60 messages of two topics, 10 ms apart, each with its number as payload."""
    return [logged(f"/{'ab'[i % 2]}", START_NS + i * 10_000_000, b"payload %03d" % i, "some.Schema") for i in range(60)]


@pytest.fixture
def source(make_log, records):
    """Writes the 60 messages and returns the file's map."""

    def make(kind="uncompressed", **options):
        return read_map(make_log(records, **{**KINDS[kind], **options}).read_bytes())

    return make


@pytest.fixture
def read(tmp_path):
    """Reads bytes as a file; returns what it holds, and what is noted of losses."""

    def of(data, *, salvage=True):
        path = tmp_path / "damaged.mcap"
        path.write_bytes(data)
        reader = LogReader([path], salvage=salvage)
        found = [Content(m.topic, m.log_time_ns, m.data) for m in reader.messages()]
        assert [m.log_time_ns for m in found] == sorted(m.log_time_ns for m in found)
        return Counter(found), reader.losses

    return of


def without(source, *damaged):
    """Returns the messages of all pieces but some."""
    left = [(piece.start, piece.end) for piece in source.pieces if piece not in damaged]
    return source.expected(left)


def with_bytes(data, at, new):
    return data[:at] + new + data[at + len(new) :]


# --- salvage loses nothing that is intact ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind",
    ["zstd", "no chunks", *(pytest.param(k, marks=pytest.mark.slow) for k in ("uncompressed", "lz4", "no CRCs"))],
)
def test_an_opcode_with_any_bit_flipped_hides_no_other_record(source, read, kind):
    """A chunk's opcode with one bit flipped is the footer's, behind which nothing is looked for any more."""
    intact = source(kind)
    for piece in intact.pieces:
        for bit in range(8):
            flipped = bytes([intact.data[piece.start] ^ 1 << bit])
            found, _ = read(with_bytes(intact.data, piece.start, flipped))
            assert not without(intact, piece) - found, (piece.opcode, bit)
            if kind != "no chunks":  # there nothing says what was a message
                assert not found - intact.messages, (piece.opcode, bit)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_length_with_a_bit_flipped_hides_no_other_record(source, read, kind):
    """A record that only seems to be long must not swallow the chunks behind it."""
    intact = source(kind)
    for piece in intact.pieces:
        for bit in (*range(20), 24, 31, 32, 63):
            length = int.from_bytes(intact.data[piece.start + 1 : piece.start + 9], "little") ^ 1 << bit
            found, _ = read(with_bytes(intact.data, piece.start + 1, struct.pack("<Q", length)))
            assert not without(intact, piece) - found, (piece.opcode, bit)
            if kind != "no chunks":  # there nothing says how long a message was
                assert not found - intact.messages, (piece.opcode, bit)


@pytest.mark.parametrize("kind", ["uncompressed", "zstd", "no CRCs"])
def test_an_index_that_claims_to_be_longer_swallows_no_chunk(source, read, kind):
    intact = source(kind)
    index = next(piece for piece in intact.pieces if piece.opcode == 7)
    for longer in (16, 500, 1200, 2000):
        length = index.end - index.start - HEADER.size + longer
        found, losses = read(with_bytes(intact.data, index.start + 1, struct.pack("<Q", length)))
        assert found == intact.messages
        assert losses.notes


def test_a_chunk_whose_data_claim_to_be_longer_swallows_no_chunk(source, read):
    """zstd does not mind what follows, so that the content's CRC is right."""
    intact = source("zstd")
    chunk = intact.chunks[1]
    length_at = chunk.start + HEADER.size + 32 + 4
    for longer in (100, 400, 900):
        length = int.from_bytes(intact.data[length_at : length_at + 8], "little") + longer
        found, _ = read(with_bytes(intact.data, length_at, struct.pack("<Q", length)))
        assert not without(intact, chunk) - found


def test_chunks_that_have_changed_places_are_read_in_log_time_order(source, read):
    intact = source()
    first, *_, last = intact.chunks
    data = intact.data
    swapped = (
        data[: first.start] + data[last.start : last.end] + data[first.end : last.start]
        + data[first.start : first.end] + data[last.end :]
    )  # fmt: skip
    found, _ = read(swapped)
    assert found == intact.messages


@pytest.mark.parametrize("kind", ["uncompressed", "zstd", "no CRCs"])
def test_a_chunk_that_is_there_twice_is_read_once(source, read, kind):
    intact = source(kind)
    chunk = intact.chunks[1]
    found, losses = read(intact.data[: chunk.end] + intact.data[chunk.start :])
    assert found == intact.messages
    assert f"damaged.mcap: chunk at byte {chunk.end} is a copy of one before it" in losses.notes


def test_a_chunk_pasted_into_another_is_found_there(source, read):
    intact = source()
    host, guest = intact.chunks[1], intact.chunks[3]
    middle = (host.start + host.end) // 2
    data = intact.data[:middle] + intact.data[guest.start : guest.end] + intact.data[middle : guest.start]
    found, losses = read(data + intact.data[guest.end :])
    assert found == without(intact, host)
    assert losses.chunks == 1


def test_without_crcs_a_chunk_that_reaches_a_few_bytes_into_the_next_gives_way(make_log, logged, read):
    """What was cut out lay in a payload, so that the chunk still seems whole, with another's first bytes at its end."""
    records = [logged("/a", START_NS + i, b"%03d" % i * 300, "some.Schema") for i in range(12)]
    intact = read_map(make_log(records, chunk_size=2000, enable_crcs=False, index_types=IndexType.NONE).read_bytes())
    host, guest = intact.chunks[1:3]
    for missing in (3, 9, 40, 400):
        at = host.end - 500
        found, _ = read(intact.data[:at] + intact.data[at + missing :])
        assert not without(intact, host) - found, missing
        assert guest.messages[0][1] in {message.log_time_ns for message in found}


def test_topics_are_known_from_the_summary_though_the_last_chunk_runs_over_it(source, read):
    """The first chunk, which declares them, is lost, and the last one seems to reach to the end of the file."""
    intact = source()
    first, *_, last = intact.chunks
    data = with_bytes(intact.data, first.end - 5, b"\xff\xff")
    data = with_bytes(data, last.start + 1, struct.pack("<Q", len(data) - last.start - HEADER.size - 8))
    found, _ = read(data)
    assert not without(intact, first, last) - found
    assert found


def test_of_two_declarations_the_one_under_a_crc_counts(source, read):
    """A file without chunks: the first declaration has a wrong letter, the summary's is proved by its CRC."""
    intact = source("no chunks")
    channel = next(piece for piece in intact.pieces if piece.opcode == 4)
    at = intact.data.index(b"/a", channel.start)
    found, _ = read(with_bytes(intact.data, at + 1, b"x"))
    assert found == intact.messages


def test_two_declarations_that_contradict_each_other_are_told(source, read):
    """Both under a CRC that is right: the first is used."""
    intact = source()
    data = forged(intact, intact.data.rindex(b"/a"), b"/x")
    found, losses = read(data)
    assert found == intact.messages
    assert "damaged.mcap: channel 1 is declared twice, as '/a', which is used, and as '/x'" in losses.notes


# --- two recordings in one file --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["uncompressed", "zstd", "no chunks"])
def test_two_recordings_in_a_row_are_both_read_each_with_its_own_topics(make_log, logged, source, read, kind):
    """The numbers of channels and schemas mean something else in each."""
    others = [logged(f"/{'xya'[i % 3]}", START_NS + i, b"other %03d" % i, "another.Schema") for i in range(30)]
    one, other = source(kind), read_map(make_log(others, "other.mcap", chunk_size=300).read_bytes())
    found, losses = read(one.data + other.data)
    assert found == one.messages + other.messages
    assert f"damaged.mcap: another recording begins at byte {len(one.data)}" in losses.notes
    with pytest.raises(LogError, match=r"damaged\.mcap is not a readable MCAP file"):
        read(one.data + other.data, salvage=False)


# --- files without chunks --------------------------------------------------------------------------------------------


def test_without_chunks_every_message_but_the_damaged_one_is_read(source, read):
    intact = source("no chunks")
    messages = [piece for piece in intact.pieces if piece.opcode == 5]
    for piece in (messages[0], messages[30], messages[-1]):
        for new in (b"\x00", bytes(9), b"\xff" * 20):
            found, losses = read(with_bytes(intact.data, piece.start, new))
            assert not without(intact, piece) - found
            assert losses.notes


def test_without_chunks_a_message_between_two_damaged_ones_is_read(source, read):
    intact = source("no chunks")
    first, second, third = [piece for piece in intact.pieces if piece.opcode == 5][20:23]
    found, _ = read(with_bytes(with_bytes(intact.data, first.start, bytes(9)), third.start, bytes(9)))
    assert found == without(intact, first, third)
    assert not Counter([Content("/b", second.messages[0][1], b"payload 021")]) - found


def test_without_chunks_the_crc_of_all_data_is_checked_if_there_is_one(source, read):
    intact = source("no chunks", enable_data_crcs=True)
    assert read(intact.data)[0] == read(intact.data, salvage=False)[0] == intact.messages
    assert read(intact.data)[1].notes == []
    at = intact.data.index(b"payload 030")
    damaged = with_bytes(intact.data, at, b"P")
    with pytest.raises(LogError, match=r"damaged\.mcap is damaged \(the crc of all its data is .*\); try --salvage"):
        read(damaged, salvage=False)
    assert any("the CRC of all its data is wrong" in note for note in read(damaged)[1].notes)


def test_without_chunks_a_message_that_swallows_others_is_missed_by_their_number(source, read):
    intact = source("no chunks")
    message = [piece for piece in intact.pieces if piece.opcode == 5][30]
    length = message.end - message.start - HEADER.size
    swallowing = with_bytes(intact.data, message.start + 1, struct.pack("<Q", 2 * length + HEADER.size))
    with pytest.raises(LogError, match=r"is damaged \(29 of 30 recorded messages of '/b' are there\); try --salvage"):
        read(swallowing, salvage=False)


# --- what is read was logged -----------------------------------------------------------------------------------------


def test_an_index_does_not_become_a_message(source, read):
    """The opcodes differ in one bit, and an index begins with a channel's number."""
    intact = source()
    for index in [piece for piece in intact.pieces if piece.opcode == 7]:
        found, losses = read(with_bytes(intact.data, index.start, b"\x05"))
        assert found == intact.messages
        assert any("messages outside of chunks, which nothing guards, are left out" in n for n in losses.notes)


def test_what_lies_in_a_damaged_chunk_is_not_believed_though_no_chunk_is_intact(make_log, logged, read):
    """Its messages look like those of a file without chunks; the tail of the last one has been zeroed."""
    records = [logged("/a", START_NS + i, b"payload " * 20, "some.Schema") for i in range(20)]
    data = make_log(records).read_bytes()
    with pytest.raises(LogError, match=r"holds no messages that can be read: .* messages outside of chunks"):
        read(data[:900] + bytes(len(data) - 900))


# --- the index is not believed against the file ----------------------------------------------------------------------


def forged(source, at, new):
    """Returns a file with other bytes in its summary, whose CRC is made right."""
    data = with_bytes(source.data, at, new)
    end = len(data) - len(MAGIC) - 4
    return data[:end] + struct.pack("<I", zlib.crc32(data[source.summary_start : end])) + MAGIC


def chunk_index(source, number):
    return [piece for piece in source.pieces if piece.opcode == 8][number].start + HEADER.size


def test_what_contradicts_the_index_is_an_error_and_no_silent_loss(source, read):
    intact = source()
    statistics = next(piece for piece in intact.pieces if piece.opcode == 11).start + HEADER.size
    topic = intact.data.rindex(b"/a")
    entry, other = chunk_index(intact, 2), chunk_index(intact, 3)
    forgeries = {
        "contradict each other": forged(intact, entry, struct.pack("<Q", START_NS + 1)),
        "the times of its chunks": forged(intact, entry + 8, struct.pack("<Q", 0xFFFF_FFFF_FFFF_FFFF)),
        "makes no sense": forged(intact, entry + 16, struct.pack("<Q", intact.chunks[2].start + 9)),
        "where none can be": forged(intact, entry + 16, struct.pack("<Q", 2**63)),
        "and the index contradict each other": forged(intact, entry + 16, intact.data[other + 16 : other + 32]),
        "recorded messages of '/.' are there": forged(intact, statistics + 46 + 2, struct.pack("<Q", 31)),
        "channel 1 is '/a', and '/x' in the summary": forged(intact, topic, b"/x"),
    }
    for problem, data in forgeries.items():
        with pytest.raises(LogError, match=problem) as refusal:
            read(data, salvage=False)
        assert "damaged.mcap is" in str(refusal.value)
        assert "; try --salvage" in str(refusal.value)
        assert read(data)[0] == intact.messages, problem


def test_a_message_of_an_undeclared_channel_is_an_error(source, read):
    intact = source(enable_crcs=False)
    chunk = intact.chunks[2]
    at = intact.data.index(b"\x05", chunk.start + HEADER.size + 40) + HEADER.size
    with pytest.raises(LogError, match="a message is of channel 999, which the summary does not declare"):
        read(with_bytes(intact.data, at, struct.pack("<H", 999)), salvage=False)


def test_a_message_outside_of_its_chunks_times_is_an_error(source, read):
    """Without a CRC a wrong log time would put a message elsewhere, or leave it out of a selection."""
    intact = source(enable_crcs=False)
    chunk = intact.chunks[2]
    at = intact.data.index(b"\x05", chunk.start + HEADER.size + 40) + HEADER.size + 6
    with pytest.raises(LogError, match=r"a chunk of \d+ to \d+ ns holds a message of 7 ns"):
        read(with_bytes(intact.data, at, struct.pack("<Q", 7)), salvage=False)


@pytest.mark.parametrize("crcs", [True, False])
def test_what_stands_behind_the_end_is_an_error(source, read, crcs):
    intact = source(enable_crcs=crcs)
    for more in (b"\n", bytes(100), MAGIC, intact.data):
        with pytest.raises(LogError, match=r"damaged\.mcap is not a readable MCAP file"):
            read(intact.data + more, salvage=False)
        found, losses = read(intact.data + more)
        assert found == intact.messages
        assert losses.notes


def test_a_file_without_an_index_of_chunks_is_read_in_its_order(make_log, records, read):
    path = make_log(records, chunk_size=600, index_types=IndexType.ALL & ~IndexType.CHUNK)
    data = path.read_bytes()
    assert read(data, salvage=False)[0] == read_map(data).messages


# --- traps -----------------------------------------------------------------------------------------------------------


def test_a_trap_of_a_million_chunks_ends_soon_in_few_words(source, read):
    """Each seems to hold all that follows; together they would have to be read 20,000 times over."""
    size = 60 * 20_000
    trap = b"".join(
        HEADER.pack(6, 40 + left) + struct.pack("<QQQII", 1, 2, left, 77, 0) + struct.pack("<Q", left)
        for left in range(size - 60, 0, -57)
    )
    intact = source()
    found, losses = read(intact.data[: intact.summary_start] + trap + bytes(size))
    assert found == intact.messages
    assert any("so much is damaged that the search was given up" in note for note in losses.notes)
    assert len(losses.notes) < 250


def test_of_very_many_losses_the_first_are_told(make_log, logged, read):
    records = [logged("/a", START_NS + i, b"x" * 50, "s") for i in range(3000)]
    data = bytearray(make_log(records, chunk_size=100).read_bytes())
    pieces = read_map(bytes(data)).chunks
    for chunk in pieces[1:-1]:
        data[chunk.end - 5] ^= 0xFF
    _, losses = read(bytes(data))
    assert losses.chunks == len(pieces) - 2 > 500
    assert len(losses.notes) < 250
    assert losses.notes[-1].endswith("more places are damaged")
