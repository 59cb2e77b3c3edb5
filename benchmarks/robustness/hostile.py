"""Files that are sound on the outside, with messages inside that make no sense."""

import json
import math
import struct
from collections.abc import Callable
from random import Random

from benchmarks.robustness.sources import Record
from schemas import codec

Records = tuple[Record, ...]
_STAMPS_NS = (0, 1, 2**31, 2**53, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
_NUMBERS = (math.nan, math.inf, -math.inf, -1.0, -1e-9, 1e9, -1e9, 1e10, 1e30, 1e300, -1e300, 5e-324, 0.0)


def _some(records: Records, random: Random, change: Callable[[Record], Record]) -> Records:
    """Changes one message, a few, or all of a topic."""
    if random.random() < 0.4:
        topic = random.choice(records).topic
        return tuple(change(record) if record.topic == topic else record for record in records)
    chosen = set(random.sample(range(len(records)), random.choice((1, 3, 20))))
    return tuple(change(record) if i in chosen else record for i, record in enumerate(records))


def _flipped(records: Records, random: Random) -> Records:
    def change(record: Record) -> Record:
        data = bytearray(record.data)
        for _ in range(random.choice((1, 3))):
            data[random.randrange(len(data))] ^= 1 << random.randrange(8)
        return record._replace(data=bytes(data))

    return _some(records, random, change)


def _other_bytes(records: Records, random: Random) -> Records:
    def change(record: Record) -> Record:
        data, cut = record.data, random.randrange(len(record.data))
        new = random.choice(
            (
                b"",
                data[:cut],
                data + data,
                data + random.randbytes(9),
                random.randbytes(len(data)),
                bytes(len(data)),
                b"\xff" * len(data),
                random.choice(records).data,
            )
        )
        return record._replace(data=new)

    return _some(records, random, change)


def _numbers(records: Records, random: Random) -> Records:
    """Puts numbers into messages that are no measurement: NaN, infinite, negative, absurd."""

    def change(record: Record) -> Record:
        number = random.choice(_NUMBERS)
        if record.encoding == "json":
            return record._replace(data=json.dumps(_with_number(json.loads(record.data), random, number)).encode())
        if record.schema[0] in codec.MESSAGE_TYPES:
            return record._replace(data=_number_in_protobuf(record, random, number))
        # CDR, ROS 1 and Foxglove's protobuf: eight bytes anywhere become a double
        at = random.randrange(max(1, len(record.data) - 8))
        if record.encoding == "cdr":
            at = max(4, at - (at - 4) % 8)
        return record._replace(data=record.data[:at] + struct.pack("<d", number) + record.data[at + 8 :])

    return _some(records, random, change)


def _with_number(document: object, random: Random, number: float) -> object:
    """Returns a document with one of its values replaced."""
    if isinstance(document, dict) and document:
        key = random.choice(sorted(document))
        return {**document, key: _with_number(document[key], random, number)}
    if isinstance(document, list) and document:
        place = random.randrange(len(document))
        return [_with_number(item, random, number) if i == place else item for i, item in enumerate(document)]
    return random.choice((number, number, None, "", "1", {}, [], [[]], True, 10**400, int(1e18)))


def _number_in_protobuf(record: Record, random: Random, number: float) -> bytes:
    """Returns a message of ours with a number of it replaced, and every CRC and length right."""
    message = codec.protobuf_type(codec.MESSAGE_TYPES[record.schema[0]]).FromString(record.data)
    for field in random.sample(list(message.DESCRIPTOR.fields), len(message.DESCRIPTOR.fields)):
        if field.cpp_type not in (field.CPPTYPE_DOUBLE, field.CPPTYPE_FLOAT):
            continue
        if not field.is_repeated:
            setattr(message, field.name, number)
            break
        values = getattr(message, field.name)
        if len(values):
            values[random.randrange(len(values))] = number
            break
    return bytes(message.SerializeToString())


def _stamps(records: Records, random: Random) -> Records:
    """Stamps that no clock shows, or of another order than the messages."""

    def change(record: Record) -> Record:
        stamp_ns = random.choice(
            (*_STAMPS_NS, record.log_time_ns + random.choice((-1, 1)) * 10 ** random.randrange(19))
        )
        if record.encoding == "json":
            document = json.loads(record.data)
            if "timestamp" in document:
                document["timestamp"] = random.choice(
                    ({"sec": stamp_ns // 10**9, "nsec": stamp_ns % 10**9}, {"sec": -1, "nsec": 2**40}, stamp_ns, "now")
                )
            else:
                document["stamp_ns"] = random.choice((stamp_ns, str(stamp_ns), -stamp_ns))
            return record._replace(data=json.dumps(document).encode())
        if record.encoding in ("cdr", "ros1"):
            at = 4
            head = struct.pack("<II", stamp_ns // 10**9 % 2**32, random.choice((stamp_ns % 10**9, 2**32 - 1)))
            return record._replace(data=record.data[:at] + head + record.data[at + 8 :])
        # stamp_ns is field 1 of all our messages: the last one counts
        return record._replace(data=record.data + b"\x09" + struct.pack("<Q", stamp_ns % 2**64))

    return _some(records, random, change)


def _log_times(records: Records, random: Random) -> Records:
    """The recorder's own clock: absurd, going back, standing still."""
    if random.random() < 0.3:
        shift_ns = random.choice((2**62, -records[0].log_time_ns, 2**64 - 1 - records[-1].log_time_ns))
        return tuple(r._replace(log_time_ns=min(max(r.log_time_ns + shift_ns, 0), 2**64 - 1)) for r in records)
    return _some(records, random, lambda record: record._replace(log_time_ns=random.choice(_STAMPS_NS)))


def _order(records: Records, random: Random) -> Records:
    """Messages in another order, doubled or missing, each with the log time of its new place."""
    times = [record.log_time_ns for record in records]
    mixed = [record for record in records for _ in range(random.choice((0, 1, 1, 1, 2)))]
    if random.random() < 0.5:
        random.shuffle(mixed)
    return tuple(record._replace(log_time_ns=times[i % len(times)]) for i, record in enumerate(mixed))


def _schemas(records: Records, random: Random) -> Records:
    """A topic's schema is another's, a nonsense, or gone; its encoding is not what it says."""
    topic, other = random.choice(records).topic, random.choice(records)
    definition = random.choice((b"", b"\xff\xfe", b"float64 x\n" * 3, b"A a\n===\nMSG: A\nA a", random.randbytes(200)))
    ways: tuple[Callable[[Record], Record], ...] = (
        lambda record: record._replace(schema=other.schema),
        lambda record: record._replace(schema=(record.schema[0], record.schema[1], definition)),
        lambda record: record._replace(schema=(record.schema[0], "ros2msg", record.schema[2])),
        lambda record: record._replace(schema=("", "", b"")),
        lambda record: record._replace(schema=("a/b/c\nd" * 99, "ros2idl", definition)),
        lambda record: record._replace(encoding=random.choice(("json", "cdr", "ros1", "protobuf", "", "x\ny"))),
        lambda record: record._replace(
            topic=random.choice(("", "/", other.topic, "no slash", "/a\nb\x1b[31m", "/" * 5000))
        ),
    )
    change = random.choice(ways)
    return tuple(change(record) if record.topic == topic else record for record in records)


def _floods(records: Records, random: Random) -> Records:
    """Lengths and depths that would take all memory or all stack, if they were believed."""

    def change(record: Record) -> Record:
        tag = bytes([random.randrange(1, 16) << 3 | 2])
        length = random.choice((2**20, 2**31 - 1, 2**32 - 1, 2**63 - 1))
        varint = bytes(length >> shift & 0x7F | 0x80 for shift in range(0, 56, 7)) + bytes([length >> 56 & 0x7F])
        nested = b""
        while len(nested) < 10_000:
            nested = tag + bytes([len(nested) & 0x7F | 0x80, len(nested) >> 7]) + nested
        new = random.choice(
            (
                record.data + tag + varint,
                tag + varint + record.data,
                nested,
                b"[" * 50_000 + b"]" * 50_000,
                b'{"a":' * 20_000 + b"1" + b"}" * 20_000,
                b'{"stamp_ns": 1' + b"0" * 5000 + b"}",
                record.data[:4] + b"\xff\xff\xff\x7f" * 40,
                bytes(300_000),
            )
        )
        return record._replace(data=new)

    return _some(records, random, change)


HOSTILE: dict[str, Callable[[Records, Random], Records]] = {
    "flipped bits in messages": _flipped,
    "other bytes as messages": _other_bytes,
    "absurd numbers": _numbers,
    "absurd stamps": _stamps,
    "absurd log times": _log_times,
    "another order": _order,
    "schemas and names": _schemas,
    "absurd lengths": _floods,
}
