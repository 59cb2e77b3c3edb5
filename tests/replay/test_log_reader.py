"""Recordings in: order, several files, damage of every kind, and memory that does not grow with the log."""

import io
import threading
import tracemalloc
from collections import Counter

import pytest
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType

from replay.errors import LogError
from replay.log_reader import LogReader, checksum
from replay.logged_message import ChannelInfo, LoggedSchema

MAGIC = b"\x89MCAP0\r\n"
KINDS = {
    "indexed": {"chunk_size": 600},
    "one chunk": {},
    "zstd": {"chunk_size": 600, "compression": CompressionType.ZSTD},
    "lz4": {"chunk_size": 600, "compression": CompressionType.LZ4},
    "unchunked": {"use_chunking": False},
}

SCHEMA = LoggedSchema("some.Schema", "protobuf", b"")


@pytest.fixture
def records(logged):
    """60 messages of two topics, 10 ms apart, each with its number as payload."""
    return [
        logged(f"/{'ab'[i % 2]}", 1_000_000_000 + i * 10_000_000, b"payload %03d" % i, "some.Schema") for i in range(60)
    ]


def payloads(reader, *arguments):
    return [message.data for message in reader.messages(*arguments)]


def intact(data):
    """Counts the messages of the intact chunks before the first unreadable record, with mcap's own parts."""
    found, records = Counter(), StreamReader(io.BytesIO(data), emit_chunks=True, record_size_limit=len(data)).records
    while True:
        try:
            record = next(records, None)
        except Exception:
            break
        if record is None:
            break
        inside = [record]
        if isinstance(record, Chunk):
            try:
                inside = breakup_chunk(record, validate_crc=True)
            except Exception:
                continue
        found.update(bytes(r.data) for r in inside if isinstance(r, Message))
    return found


def opcodes(data):
    """Where each record begins: a wrong byte there turns it into an unknown one, which readers skip."""
    found, offset = [], len(MAGIC)
    while offset < len(data) - len(MAGIC):
        found.append(offset)
        offset += 9 + int.from_bytes(data[offset + 1 : offset + 9], "little")
    return found


def chunk_indexes(path):
    with path.open("rb") as stream:
        return make_reader(stream).get_summary().chunk_indexes


# --- intact files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("salvage", [False, True])
def test_every_message_is_read_in_log_time_order(make_log, records, kind, salvage):
    shuffled = records[::2] + records[1::2]  # 0.6 s out of order
    reader = LogReader([make_log(shuffled, **KINDS[kind])], salvage=salvage)
    assert payloads(reader) == [record.message for record in records]
    assert (reader.start_ns, reader.end_ns) == (records[0].log_time_ns, records[-1].log_time_ns)
    assert reader.losses.chunks == 0
    assert reader.losses.notes == []


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("salvage", [False, True])
def test_topics_and_times_select(make_log, records, kind, salvage):
    reader = LogReader([make_log(records, **KINDS[kind])], salvage=salvage)
    start_ns, end_ns = records[10].log_time_ns, records[20].log_time_ns
    expected = [record.message for record in records[10:20] if record.topic == "/b"]
    assert payloads(reader, {"/b"}, start_ns, end_ns) == expected


def test_a_message_carries_what_the_file_says(make_log, records):
    first = next(LogReader([make_log(records)]).messages())
    assert first == ("/a", 1_000_000_000, SCHEMA, "protobuf", b"payload 000")


def test_channels_are_counted_over_all_files(make_log, records):
    paths = [make_log(records[:20], "one.mcap"), make_log(records[20:], "two.mcap")]
    assert LogReader(paths).channels == (
        ChannelInfo("/a", SCHEMA, "protobuf", 30),
        ChannelInfo("/b", SCHEMA, "protobuf", 30),
    )


def test_several_files_are_merged_by_log_time(make_log, records):
    paths = [make_log(records[i::3], f"{i}.mcap", **KINDS["indexed"]) for i in range(3)]
    reader = LogReader(paths)
    assert payloads(reader) == [record.message for record in records]
    assert (reader.start_ns, reader.end_ns) == (records[0].log_time_ns, records[-1].log_time_ns)


def test_ties_are_read_in_the_order_of_the_files(make_log, logged):
    paths = [make_log([logged("/a", 5, name.encode(), "s")], f"{name}.mcap") for name in ("first", "second", "third")]
    assert payloads(LogReader(paths)) == [b"first", b"second", b"third"]
    assert payloads(LogReader(paths[::-1])) == [b"third", b"second", b"first"]


def test_ties_within_a_file_keep_its_order(make_log, logged):
    same = [logged("/a", 5, b"%d" % i, "s") for i in range(9)]
    for kind in ("indexed", "unchunked"):
        assert payloads(LogReader([make_log(same, **KINDS[kind])])) == [record.message for record in same]


def test_a_file_of_no_messages_beside_a_full_one_is_fine(make_log, records):
    paths = [make_log([], "empty.mcap"), make_log(records)]
    assert len(payloads(LogReader(paths))) == 60


def test_the_log_can_be_read_twice(make_log, records):
    reader = LogReader([make_log(records)])
    assert payloads(reader) == payloads(reader)


def test_checksum_is_sha256(tmp_path):
    (tmp_path / "abc").write_bytes(b"abc")
    assert checksum(tmp_path / "abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_a_checksum_can_be_abandoned(tmp_path):
    (tmp_path / "abc").write_bytes(b"abc")
    abandoned = threading.Event()
    assert checksum(tmp_path / "abc", abandoned) == checksum(tmp_path / "abc")
    abandoned.set()
    assert checksum(tmp_path / "abc", abandoned) is None


# --- files that are none ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("head", "kind"), [(b"#ROSBAG V2.0\n", "a ROS 1 bag"), (b"SQLite format 3\0", "a database")])
def test_bags_of_other_kinds_are_named_with_the_way_out(tmp_path, head, kind):
    (tmp_path / "week.bag").write_bytes(head + bytes(4000))
    for salvage in (False, True):
        with pytest.raises(LogError, match=f"week.bag is {kind}.*, not MCAP: rosbags-convert makes MCAP of it"):
            LogReader([tmp_path / "week.bag"], salvage=salvage)


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", r"is not a readable MCAP file \(the file is empty\); try --salvage"),
        (b"x", r"is not a readable MCAP file \(.+\); try --salvage"),
        (b"This is a text file and no recording.\n" * 20, r"is not a readable MCAP file \(.+\); try --salvage"),
        (b"\0" * 4096, r"is not a readable MCAP file \(.+\); try --salvage"),
        (MAGIC, r"is not a readable MCAP file \(.+\); try --salvage"),
        (MAGIC + b"\0" * 4096 + MAGIC, r"log\.mcap .+; try --salvage"),
        (MAGIC + b"junk" * 1000 + MAGIC, r"log\.mcap .+; try --salvage"),
    ],
    ids=["empty", "one byte", "text", "zeros", "magic alone", "zeros between magics", "junk between magics"],
)
def test_what_is_no_recording_is_refused_with_its_name(tmp_path, data, problem):
    path = tmp_path / "log.mcap"
    path.write_bytes(data)
    with pytest.raises(LogError, match=problem) as refusal:
        LogReader([path])
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)
    with pytest.raises(LogError, match=r"log\.mcap holds no messages") as refusal:
        LogReader([path], salvage=True)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("salvage", [False, True])
def test_a_missing_file_and_a_folder_are_named(tmp_path, salvage):
    with pytest.raises(LogError, match=r"gone\.mcap cannot be read: No such file or directory$"):
        LogReader([tmp_path / "gone.mcap"], salvage=salvage)
    with pytest.raises(LogError, match=r"cannot be read: Is a directory$"):
        LogReader([tmp_path], salvage=salvage)


def test_no_file_and_no_message_are_refused(make_log):
    with pytest.raises(LogError, match="no recording given"):
        LogReader([])
    with pytest.raises(LogError, match=r"log\.mcap holds no messages"):
        LogReader([make_log([])])


# --- damage ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_that_was_not_closed(make_log, records, kind):
    path = make_log(records, finish=False, **KINDS[kind])
    with pytest.raises(LogError, match=r"log\.mcap .*; try --salvage"):
        LogReader([path])
    expected = intact(path.read_bytes())
    if kind == "one chunk":  # nothing had been written yet
        assert not expected
        return
    reader = LogReader([path], salvage=True)
    assert Counter(payloads(reader)) == expected
    assert expected.total() > 40


def test_a_file_without_summary_is_read_by_salvage_alone(make_log, records):
    path = make_log(records, use_statistics=False, use_summary_offsets=False, repeat_channels=False,
                    repeat_schemas=False, index_types=IndexType.NONE, chunk_size=600)  # fmt: skip
    with pytest.raises(LogError, match="has no summary section: the recording was not closed; try --salvage"):
        LogReader([path])
    assert payloads(LogReader([path], salvage=True)) == [record.message for record in records]


@pytest.mark.parametrize("kind", ["indexed", "zstd", "unchunked"])
@pytest.mark.parametrize("share", [0.02, 0.2, 0.5, 0.8, 0.95, 0.999])
def test_a_file_cut_short(make_log, records, kind, share):
    path = make_log(records, **KINDS[kind])
    data = path.read_bytes()
    data = data[: int(len(data) * share)]
    path.write_bytes(data)
    with pytest.raises(LogError, match=r"log\.mcap .*; try --salvage") as refusal:
        LogReader([path])
    assert "\n" not in str(refusal.value)
    expected = intact(data)
    if not expected:
        with pytest.raises(LogError, match="holds no messages"):
            LogReader([path], salvage=True)
        return
    reader = LogReader([path], salvage=True)
    assert Counter(payloads(reader)) == expected
    assert sum(channel.messages for channel in reader.channels) == expected.total()
    assert any("log.mcap: nothing readable after byte" in note for note in reader.losses.notes)


def test_one_damaged_chunk(make_log, records):
    path = make_log(records, **KINDS["indexed"])
    chunks = chunk_indexes(path)
    assert len(chunks) > 4
    data = bytearray(path.read_bytes())
    middle = chunks[2]
    data[middle.chunk_start_offset + middle.chunk_length - 20] ^= 0xFF
    path.write_bytes(data)

    reader = LogReader([path])  # the summary is intact: the damage shows on the way
    with pytest.raises(LogError, match=r"log\.mcap is damaged \(.*crc.*\); try --salvage"):
        payloads(reader)

    reader = LogReader([path], salvage=True)
    found = payloads(reader)
    lost = [r.message for r in records if middle.message_start_time <= r.log_time_ns <= middle.message_end_time]
    assert lost
    assert found == [record.message for record in records if record.message not in lost]
    assert Counter(found) == intact(bytes(data))
    assert reader.losses.chunks == 1
    assert reader.losses.notes == [note for note in reader.losses.notes if "log.mcap: chunk at byte" in note]
    assert len(reader.losses.notes) == 1


def test_damage_outside_the_replayed_part_goes_unnoticed(make_log, records):
    """Only the chunks that are asked for are read; the others may be damaged."""
    path = make_log(records, **KINDS["indexed"])
    last = chunk_indexes(path)[-1]
    data = bytearray(path.read_bytes())
    data[last.chunk_start_offset + last.chunk_length - 20] ^= 0xFF
    path.write_bytes(data)
    early = payloads(LogReader([path]), None, None, records[10].log_time_ns)
    assert early == [record.message for record in records[:10]]


@pytest.mark.parametrize("kind", ["indexed", "zstd", "lz4"])
def test_a_topic_declared_in_a_lost_chunk_is_known_from_the_summary(make_log, records, kind):
    path = make_log(records, **KINDS[kind])
    first = chunk_indexes(path)[0]
    data = bytearray(path.read_bytes())
    data[first.chunk_start_offset + first.chunk_length - 5] ^= 0xFF
    path.write_bytes(data)
    reader = LogReader([path], salvage=True)
    found = [(message.topic, message.schema.name, message.data) for message in reader.messages()]
    expected = [(r.topic, r.schema, r.message) for r in records if r.log_time_ns > first.message_end_time]
    assert found == expected
    assert len(found) > 40


def test_messages_whose_declaration_is_lost_everywhere_are_counted(make_log, records):
    path = make_log(records, chunk_size=600)
    chunks = chunk_indexes(path)
    data = bytearray(path.read_bytes())
    data[chunks[0].chunk_start_offset + chunks[0].chunk_length - 5] ^= 0xFF
    path.write_bytes(data[: chunks[-1].chunk_start_offset])  # no summary either
    with pytest.raises(LogError, match="holds no messages"):
        LogReader([path], salvage=True)
    other = make_log(records, "other.mcap")
    reader = LogReader([path, other], salvage=True)
    undeclared = sum(chunk.message_start_time > chunks[0].message_end_time for chunk in chunks[:-1])
    assert undeclared > 2
    assert any(
        "log.mcap" in note and "messages of topics whose declaration is lost" in note for note in reader.losses.notes
    )


@pytest.mark.parametrize("kind", ["indexed", "zstd", "one chunk"])
@pytest.mark.parametrize("salvage", [False, True])
def test_a_flipped_byte_anywhere_never_invents_a_message(make_log, records, kind, salvage):
    """Whatever byte is wrong, what is read was logged, or the reader says that the file is damaged."""
    path = make_log(records, **KINDS[kind])
    original, expected = path.read_bytes(), Counter(record.message for record in records)
    named = 0
    places = sorted({*range(0, len(original), 17), *opcodes(original)})
    for place in places:
        data = bytearray(original)
        data[place] ^= 0x55
        path.write_bytes(data)
        try:
            reader = LogReader([path], salvage=salvage)
            found = Counter(payloads(reader))
        except LogError:
            named += 1
            continue
        assert found <= expected, f"byte {place} invents messages"
        if not salvage:
            assert found == expected, f"byte {place} loses messages in silence"
        elif found != expected:
            assert reader.losses.notes, f"byte {place} loses messages in silence"
    assert salvage or named > 0.5 * len(places)


@pytest.mark.parametrize("kind", ["indexed", "zstd", "lz4"])
def test_salvage_loses_no_more_than_the_chunk_that_is_damaged(make_log, records, kind):
    """One wrong byte anywhere, record headers and lengths included: every other chunk's messages are read."""
    path = make_log(records, **KINDS[kind])
    original = path.read_bytes()
    chunks = {}
    for index in chunk_indexes(path):
        end = index.chunk_start_offset + index.chunk_length
        chunks[index.chunk_start_offset, end] = intact(original[:end]) - intact(original[: index.chunk_start_offset])
    assert len(chunks) > 3
    assert sum(chunks.values(), Counter()) == Counter(record.message for record in records)
    for place in sorted({*range(8, len(original), 11), *opcodes(original)}):
        data = bytearray(original)
        data[place] ^= 0x55
        path.write_bytes(data)
        elsewhere = sum((inside for (start, end), inside in chunks.items() if not start <= place < end), Counter())
        assert not elsewhere - Counter(payloads(LogReader([path], salvage=True))), f"byte {place}"


def test_a_zeroed_tail(make_log, records):
    path = make_log(records, **KINDS["indexed"])
    data = path.read_bytes()
    data = data[: len(data) // 2] + bytes(len(data) // 2)
    path.write_bytes(data)
    with pytest.raises(LogError, match=r"log\.mcap .*; try --salvage"):
        LogReader([path])
    assert Counter(payloads(LogReader([path], salvage=True))) == intact(data)


def test_reading_changes_nothing(make_log, records):
    path = make_log(records)
    path.chmod(0o444)
    before, stat = checksum(path), path.stat()
    for salvage in (False, True):
        payloads(LogReader([path], salvage=salvage))
    assert checksum(path) == before
    assert path.stat().st_mtime_ns == stat.st_mtime_ns


# --- memory ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "salvage"),
    [({"chunk_size": 64_000}, False), ({"use_chunking": False}, False), ({"chunk_size": 64_000}, True)],
    ids=["indexed", "unchunked", "salvaged"],
)
def test_a_longer_log_needs_no_more_memory(make_log, logged, options, salvage):
    """Ten times as many messages; unindexed files keep the 2 s in which writers may be out of order."""

    def peak_bytes(seconds):
        stamps = range(0, seconds * 10**9, 10**8)
        path = make_log((logged("/a", 1 + at_ns, bytes(4000), "s") for at_ns in stamps), **options)
        tracemalloc.start()
        count = sum(1 for _ in LogReader([path], salvage=salvage).messages())
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert count == len(stamps)
        return peak

    peak_bytes(1)  # what is imported and cached on first use
    short, long = peak_bytes(12), peak_bytes(120)
    assert long < 1.3 * short + 60_000  # the index: 200 bytes a chunk
