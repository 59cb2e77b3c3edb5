"""The table of what differs, in a pipe and in windows of any width."""

from io import StringIO

import pytest
from rich.console import Console

from replay.diff_result import Difference, FieldDifferences, Kind, LogDiff, Tolerances, TopicDiff
from replay.diff_table import print_diff, sparkline

FIRST = Difference(Kind.VALUE, "/pcgan/predictions", 12.4, 0, "track 7", "predictions.paths.x", "4.8", "4.9")
FIELD = FieldDifferences("predictions.mixture.correlations", 90_000, 1234, 0.058, 0.03, 0.05, 12.4)
CHANGED = TopicDiff(
    "/pcgan/predictions", (600, 599), False, False, FIRST, (FIELD,), 1, 20, 0.0, 426_083, 1234, 0.058, 0.03, 0.05,
    (0, 1, 2),
)  # fmt: skip
MISSING = TopicDiff("/tf", (9, 0), False, False, Difference(Kind.TOPIC, "/tf", 0.0, 0, "", "", "a.B", ""))
SAME = TopicDiff("/pcgan/tracks", (600, 600), identical=True, same=True)


def printed(diff: LogDiff, width: int, *, terminal: bool) -> list[str]:
    out = StringIO()
    print_diff(diff, Tolerances(), Console(file=out, width=width, force_terminal=terminal, color_system=None))
    return [line.rstrip() for line in out.getvalue().splitlines()]


def row(lines: list[str], name: str) -> list[str]:
    (found,) = [line for line in lines if line.split()[:1] == [name] and " vs " not in line]
    return found.split()


@pytest.mark.parametrize("width", [40, 80, 120, 200])
def test_a_window_has_the_columns_that_fit(width):
    lines = printed(LogDiff((CHANGED, SAME)), width, terminal=True)
    header = next(line for line in lines if line.startswith("topic"))
    whole = ["A", "B", "alone", "compared", "different", "first", "at", "largest", "p50", "p99", "when"]
    shown = header.split()[1:]
    assert [name for name in whole if name in shown] == shown
    if width == 200:
        assert shown == whole
    if width >= 80:
        assert {"different", "first", "largest"} <= {*shown}
        assert max(len(line) for line in lines[lines.index(header) :][:5]) <= width
    left_out = [line for line in lines if "not shown, as the window is narrow: " in line]
    assert bool(left_out) == (shown != whole)


def test_a_pipe_has_every_column_in_one_line_a_row():
    lines = printed(LogDiff((CHANGED, SAME)), 80, terminal=False)
    text = "/pcgan/predictions different 600 599 1 message, 20 items 426083 1234 12.400 s 0.058 0.03 0.05 ·▄█"
    assert " ".join(row(lines, "/pcgan/predictions")) == text
    text = f"{FIELD.field} 90000 1234 12.400 s 0.058 0.03 0.05"
    assert " ".join(row(lines, FIELD.field)) == text


def test_columns_with_nothing_in_them_are_left_out():
    assert printed(LogDiff((SAME,)), 80, terminal=False) == [
        "topic                       A    B",
        "──────────────────────────────────",
        "/pcgan/tracks  identical  600  600",
        "identical: the same bytes at the same times",
    ]


def test_a_topic_of_one_log_has_no_time_of_its_first_difference():
    assert row(printed(LogDiff((MISSING,)), 80, terminal=False), "/tf") == ["/tf", "different", "9", "0"]


def test_bars():
    assert sparkline([0, 0]) == ""
    assert sparkline([0, 1, 8]) == "·▁█"
    assert sparkline([1] + [0] * 59, 30) == "█" + "·" * 29
