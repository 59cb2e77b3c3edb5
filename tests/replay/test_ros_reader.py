"""Compiled readers of ROS messages: what rosbags and mcap-ros2-support write comes out, whatever the definition."""

import contextlib
import math
import tracemalloc
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2.writer import serialize_dynamic
from rosbags.interfaces import Nodetype

from replay.logged_message import LoggedSchema
from replay.ros_reader import Reader, full_name, parse, standard_definitions
from schemas.codec import CodecError
from tests.replay.foreign_ros import Stack, genpy_message, namespace

INNER, OUTER = "a_msgs/msg/Inner", "a_msgs/msg/Outer"


def reader(text, wanted, encoding="cdr", name="a_msgs/msg/Thing"):
    definitions = parse(LoggedSchema(name, "ros2msg" if encoding == "cdr" else "ros1msg", text.encode()))
    return Reader(definitions, full_name(name), wanted, encoding)


@pytest.mark.parametrize(
    ("name", "full"),
    [
        ("sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/CameraInfo"),
        ("sensor_msgs/CameraInfo", "sensor_msgs/msg/CameraInfo"),
        ("CameraInfo", "CameraInfo"),
        ("", ""),
    ],
)
def test_a_type_has_one_full_name(name, full):
    assert full_name(name) == full


# --- against other people's writers --------------------------------------------------------------------------------

KINDS = {
    "bool": st.booleans(),
    "uint8": st.integers(0, 2**8 - 1),
    "int8": st.integers(-(2**7), 2**7 - 1),
    "uint16": st.integers(0, 2**16 - 1),
    "int16": st.integers(-(2**15), 2**15 - 1),
    "uint32": st.integers(0, 2**32 - 1),
    "int32": st.integers(-(2**31), 2**31 - 1),
    "uint64": st.integers(0, 2**64 - 1),
    "int64": st.integers(-(2**63), 2**63 - 1),
    "float32": st.floats(width=32, allow_nan=False),
    "float64": st.floats(allow_nan=False),
    "string": st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=5),
}
SHAPES = ("", "[]", "[2]", "[3]")


@st.composite
def messages(draw, ros):
    """Definitions of two types, one in the other, a message of the outer one, and the paths of all its fields."""
    kinds = st.lists(st.tuples(st.sampled_from([*KINDS]), st.sampled_from(SHAPES)), min_size=1, max_size=6)
    inner = draw(kinds)
    outer = draw(kinds)
    for shape in draw(st.lists(st.sampled_from(SHAPES), max_size=3)):
        outer.insert(draw(st.integers(0, len(outer))), ("a_msgs/Inner", shape))
    texts = {
        name: "".join(f"{kind}{shape} f{i}\n" for i, (kind, shape) in enumerate(fields))
        for name, fields in ((INNER, inner), (OUTER, outer))
    }

    def value(kind, shape):
        one = (
            st.builds(dict, **{f"f{i}": value(*field) for i, field in enumerate(inner)}) if "/" in kind else KINDS[kind]
        )
        if not shape:
            return one
        bounds = (0, 3) if shape == "[]" else (int(shape[1]), int(shape[1]))
        return st.lists(one, min_size=bounds[0], max_size=bounds[1])

    values = {f"f{i}": draw(value(*field)) for i, field in enumerate(outer)}
    inner_paths = tuple(f"f{i}" for i in range(len(inner)))
    wanted = []
    for i, (kind, shape) in enumerate(outer):
        if "/" not in kind:
            wanted.append(f"f{i}")
        elif shape:
            wanted.append((f"f{i}", inner_paths))
        else:
            wanted += [f"f{i}.{path}" for path in inner_paths]
    stack = Stack(1 if ros == 1 else 4, texts)
    return stack, stack.filled(OUTER, values), draw(st.permutations(wanted)), draw(st.integers(0, len(wanted)))


def expected(values, wanted):
    found = []
    for item in wanted:
        path, inner = (item, None) if isinstance(item, str) else item
        value = values
        for name in path.split("."):
            value = value[name]
        found.append([expected(row, inner) for row in value] if inner is not None else value)
    return found


def assert_same(found, wanted):
    if isinstance(found, bytes):
        assert found == wanted.tobytes()
    elif isinstance(wanted, list):
        assert isinstance(found, list | tuple)
        assert len(found) == len(wanted)
        for one, other in zip(found, wanted, strict=True):
            assert_same(one, other)
    else:
        np.testing.assert_array_equal(found, wanted)


def check(stack, values, wanted, some, *serialised):
    definitions = parse(stack.schema(OUTER))
    for paths in (tuple(wanted), tuple(wanted[:some])):
        read = Reader(definitions, OUTER, paths, stack.encoding)
        for data in serialised:
            assert_same(read(data), expected(values, paths))


@given(messages(ros=2))
@settings(max_examples=60)
def test_cdr_of_any_definition_is_read_as_written(case):
    stack, values, wanted, some = case
    message = stack.rosbags_message(OUTER, values)
    little = bytes(stack.store.serialize_cdr(message, OUTER))
    big = bytes(stack.store.serialize_cdr(message, OUTER, little_endian=False))
    other = bytes(serialize_dynamic(OUTER, stack.definition(OUTER))[OUTER](namespace(values)))
    check(stack, values, wanted, some, little, big, other)


@given(messages(ros=1))
@settings(max_examples=40)
def test_ros_1_of_any_definition_is_read_as_written(case):
    stack, values, wanted, some = case
    check(stack, values, wanted, some, bytes(stack.store.serialize_ros1(stack.rosbags_message(OUTER, values), OUTER)))


def test_ros_1_is_read_as_genpy_writes_it():
    text = "string[] names\ntime when\nfloat32[3] size\nuint8[] data\na_msgs/Inner[] rows\nbool last"
    stack = Stack(1, {OUTER: text, INNER: "int8 a\nfloat64 b"})
    values = stack.filled(
        OUTER,
        {
            "names": ["a", "ü"], "when": {"sec": 5, "nanosec": 7}, "size": [1, 2, 3], "data": [4, 5],
            "rows": [{"a": -1, "b": 0.5}, {"a": 2, "b": math.pi}], "last": True,
        },
    )  # fmt: skip
    buffer = BytesIO()
    genpy_message(stack, OUTER, values).serialize(buffer)
    wanted = ("last", ("rows", ("b", "a")), "data", "size", "when.nanosec", "when.sec", "names")
    last, rows, data, size, nanosec, sec, names = Reader(parse(stack.schema(OUTER)), OUTER, wanted, "ros1")(
        buffer.getvalue()
    )
    assert (last, rows, data, sec, nanosec, names) == (True, [(0.5, -1), (math.pi, 2)], b"\4\5", 5, 7, ["a", "ü"])
    np.testing.assert_array_equal(size, [1, 2, 3])


def test_every_standard_message_can_be_compiled():
    """Every type that rosbags knows, with everything wanted that stands in it directly."""
    definitions = standard_definitions()
    assert len(definitions) > 150
    for name, fields in definitions.items():
        plain = tuple(field for field, (kind, what) in fields if Nodetype.NAME not in (kind, what[0][0]))
        Reader(definitions, name, plain, "cdr")


def test_a_message_without_fields_takes_a_byte_in_cdr_and_none_in_ros_1():
    text = "uint8 a\na_msgs/Nothing nothing\nuint8 b\n" + "=" * 80 + "\nMSG: a_msgs/Nothing\n# empty\n"
    assert reader(text, ("a", "b"))(b"\0\1\0\0" + b"\1\0\2") == (1, 2)
    assert reader(text, ("a", "b"), "ros1")(b"\1\2") == (1, 2)


# --- paths ---------------------------------------------------------------------------------------------------------


def test_the_first_of_several_names_counts_and_a_missing_one_may_be_none():
    assert reader("uint8 k\nuint8 other", ("K|k", "other|k", "id|"))(b"\0\1\0\0\5\6") == (5, 6, None)


@pytest.mark.parametrize(
    ("wanted", "error"),
    [
        (("a.b|c",), "a_msgs/msg/Thing has no field a.b or c"),
        (("header",), "has no field header"),  # a message is no value
        (("header.stamp.sec.x",), "has no field header.stamp.sec.x"),
        (("rows",), "has no field rows"),
        ((("k", ("a",)),), "has no field k"),  # numbers are no messages
        ((("header", ("stamp",)),), "has no field header"),
        ((("rows", ("a",)),), "a_msgs/msg/Row has no field a"),
    ],
)
def test_a_wanted_field_must_be_there_and_of_its_kind(wanted, error):
    parts = [
        "uint8[] k\nHeader header\nRow[] rows\n",
        "MSG: std_msgs/Header\ntime stamp\n",
        "MSG: a_msgs/Row\nint8 b\n",
    ]
    with pytest.raises(CodecError, match=error):
        reader(("=" * 80 + "\n").join(parts), wanted)


# --- definitions ---------------------------------------------------------------------------------------------------


def test_definitions_in_idl_and_with_carriage_returns():
    parts = [
        "IDL: a_msgs/msg/Thing\n"
        "// generated from rosidl_adapter/resource/msg.idl.em\n\n"
        '#include "a_msgs/msg/Row.idl"\n\n'
        "module a_msgs { module msg { struct Thing { string name; sequence<a_msgs::msg::Row> rows; }; }; };\n",
        "IDL: a_msgs/msg/Row\nmodule a_msgs { module msg { struct Row { double value; }; }; };\n",
    ]
    text = ("=" * 80 + "\n") + ("=" * 80 + "\n").join(parts)
    data = Stack(4, {"a_msgs/msg/Thing": "string name\nRow[] rows", "a_msgs/msg/Row": "float64 value"}).rosbags_bytes(
        "a_msgs/msg/Thing", {"name": "x", "rows": [{"value": 1.5}, {"value": -2.0}]}
    )
    wanted = ("name", ("rows", ("value",)))
    definitions = parse(LoggedSchema("a_msgs/msg/Thing", "ros2idl", text.encode()))
    assert Reader(definitions, "a_msgs/msg/Thing", wanted, "cdr")(data) == ("x", [(1.5,), (-2.0,)])
    text = "string name\r\nRow[] rows\r\n" + "=" * 80 + "\r\nMSG: a_msgs/Row\r\nfloat64 value\r\n"
    assert reader(text, wanted)(data) == ("x", [(1.5,), (-2.0,)])


@pytest.mark.parametrize("encoding", ["ros2msg", "ros2idl"])
@pytest.mark.parametrize("text", [b"{'no': 'definition'}", b"\xff\xfe", b"float64", b"module { }"])
def test_a_definition_that_cannot_be_read_is_named(encoding, text):
    with pytest.raises(CodecError, match=r"the recording's definition of a_msgs/msg/Thing cannot be read: \S"):
        parse(LoggedSchema("a_msgs/msg/Thing", encoding, text))


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("a_msgs/Other other", "the recording's definition lacks a_msgs/msg/Other"),
        ("a_msgs/Thing[] other", "of a_msgs/msg/Thing has no end"),
        ("wstring name", "lacks a_msgs/msg/wstring"),
    ],
)
def test_a_definition_that_is_not_whole_is_named(text, error):
    with pytest.raises(CodecError, match=error):
        reader(text, ())


def test_a_definition_that_grows_without_bound_is_refused():
    parts = ["T0[] a\n", *(f"MSG: a_msgs/T{i}\nT{i + 1}[] a\nT{i + 1}[] b\n" for i in range(40))]
    text = ("=" * 80 + "\n").join([*parts, "MSG: a_msgs/T40\nuint8 a\n"])
    with pytest.raises(CodecError, match="has no end"):
        reader(text, ())


# --- bytes ---------------------------------------------------------------------------------------------------------

LIST = "string name\nfloat64[] numbers\nRow[] rows\n" + "=" * 80 + "\nMSG: a_msgs/Row\nuint8 a\nstring b\n"
WANTED = ("name", "numbers", ("rows", ("a", "b")))


@pytest.fixture
def listed():
    stack = Stack(4, {"a_msgs/msg/Thing": LIST.partition("=")[0], "a_msgs/msg/Row": "uint8 a\nstring b"})
    return stack.rosbags_bytes("a_msgs/msg/Thing", {"name": "x", "numbers": [1, 2], "rows": [{"a": 3, "b": "y"}] * 2})


def test_every_cut_is_noticed(listed):
    read, skip = reader(LIST, WANTED), reader(LIST, ())
    assert read(listed)[2] == [(3, "y"), (3, "y")]
    for end in range(len(listed)):
        for function in (read, skip):
            with pytest.raises(CodecError):
                function(listed[:end])


def test_writers_may_fill_up_to_four_bytes_but_no_more(listed):
    read = reader(LIST, WANTED)
    assert read(listed + b"\0\0\0")[0] == "x"
    with pytest.raises(CodecError, match=f"{len(listed) + 4} bytes where its definition takes {len(listed)}"):
        read(listed + b"\0\0\0\0")


@pytest.mark.parametrize("head", [b"\0\7\0\0", b"\1\1\0\0", b"\0\3\0\0", b"\0"])
def test_other_encapsulations_are_named(listed, head):
    with pytest.raises(CodecError, match=f"begins with {head.hex()}; wanted plain CDR"):
        reader(LIST, WANTED)(head + (listed[4:] if len(head) == 4 else b""))


def test_an_absurd_length_takes_no_memory(listed):
    at = listed.index(b"\2\0\0\0")  # of the numbers
    functions = [reader(LIST, WANTED), reader(LIST, ())]
    tracemalloc.start()
    try:
        for place in (4, at, listed.rindex(b"\2\0\0\0", 0, -10)):
            huge = listed[:place] + b"\xff\xff\xff\x7f" + listed[place + 4 :]
            for function in functions:
                with pytest.raises(CodecError):
                    function(huge)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_sequences_of_sequences_of_nothing_end():
    """30 sequences that claim 1000 empty items each: no bytes are missing, but there are more items than bytes."""
    text = "a_msgs/Many[] rows\n" + "=" * 80 + "\nMSG: a_msgs/Many\na_msgs/Nothing[] items\n" + "=" * 80
    text += "\nMSG: a_msgs/Nothing\n# empty\n"
    read, number = reader(text, (), "ros1"), (1000).to_bytes(4, "little")
    assert read((2).to_bytes(4, "little") + (2).to_bytes(4, "little") + (0).to_bytes(4, "little")) == ()
    with pytest.raises(CodecError, match="a sequence of 1000"):
        read((1030).to_bytes(4, "little") + 1030 * number)


@given(st.data())
@settings(max_examples=200)
def test_no_bytes_raise_anything_but_codec_errors(data):
    read = _READERS[data.draw(st.sampled_from(sorted(_READERS)))]
    with contextlib.suppress(CodecError):
        read(data.draw(st.binary(max_size=80).map(lambda rest: b"\0\1\0\0" + rest)))


_READERS = {encoding: reader(LIST, WANTED, encoding) for encoding in ("cdr", "ros1")}
