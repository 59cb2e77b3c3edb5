"""Numbers with digits enough to differ, and differences in words."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from replay.diff_result import Difference, Kind
from replay.diff_words import numbers_in_words, others_in_words


@pytest.mark.parametrize(
    ("a", "b", "texts"),
    [
        (4.812, 4.870, ("4.812", "4.870")),
        (4.8121, 4.8124, ("4.8121", "4.8124")),
        (-0.00001, 0.00001, ("-0.00001", "0.00001")),
        (1.0, 2.0, ("1.000", "2.000")),
        (123456.0, 123456.25, ("123456.000", "123456.250")),
        (1e300, 2e300, ("1e+300", "2e+300")),
        (float("nan"), 1.5, ("nan", "1.5")),
        (float("inf"), float("-inf"), ("inf", "-inf")),
        (1.0, 1.0 + 2**-52, ("1", "1.0000000000000002")),
    ],
)
def test_numbers(a, b, texts):
    assert numbers_in_words(a, b) == texts


@given(st.floats(allow_nan=False), st.floats(allow_nan=False))
def test_numbers_that_differ_are_never_written_alike(a, b):
    if a != b:
        one, other = numbers_in_words(a, b)
        assert one != other
        assert max(len(one), len(other)) <= 25


@pytest.mark.parametrize(
    ("a", "b", "texts"),
    [
        ("odom", "map", ("odom", "map")),
        ("", "map", ('""', "map")),
        (True, False, ("true", "false")),
        (b"ab", b"ac", ("2 bytes", "2 bytes, unlike from byte 1 on")),
        (b"a", b"", ("1 byte", "0 bytes, unlike from byte 0 on")),
        (1, "1", ("1 (int)", "1 (str)")),
        ("x" * 100 + "left", "x" * 100 + "right", ("…xxxxxxxxxxleft", "…xxxxxxxxxxright")),
    ],
)
def test_others(a, b, texts):
    assert others_in_words(a, b) == texts


@pytest.mark.parametrize(
    ("difference", "text"),
    [
        (
            (Kind.VALUE, "track 7, path 1 step 3", "4.812", "4.870", 0.058, 1e-4),
            "/pcgan/predictions at 12.400 s, track 7, path 1 step 3: 4.812 vs 4.870 (atol 0.0001)",
        ),
        ((Kind.VALUE, "frame_id", "odom", "map"), "/pcgan/predictions at 12.400 s, frame_id: odom vs map"),
        ((Kind.VALUE, "track 7, corridor_time_s", "", "3.1"),
         "/pcgan/predictions at 12.400 s, track 7, corridor_time_s: nothing vs 3.1"),
        ((Kind.VALUE, "frame_id", "od\nom", "\x1b[2J"),
         r"/pcgan/predictions at 12.400 s, frame_id: od\nom vs \x1b[2J"),
        ((Kind.ITEM, "track 7", "there", ""), "/pcgan/predictions at 12.400 s, track 7: only in the first log"),
        ((Kind.ITEM, "track 7", "", "there"), "/pcgan/predictions at 12.400 s, track 7: only in the second log"),
        ((Kind.ITEM, "track 7, path 0", "12 values", "10 values"),
         "/pcgan/predictions at 12.400 s, track 7, path 0: 12 values vs 10 values"),
        ((Kind.TOPIC, "", "a.B (protobuf)", ""), "/pcgan/predictions: a.B (protobuf) vs no messages"),
    ],
)  # fmt: skip
def test_differences(difference, text):
    kind, where, a, b, *numbers = difference
    assert str(Difference(kind, "/pcgan/predictions", 12.4, 0, where, "", a, b, *numbers)) == text
