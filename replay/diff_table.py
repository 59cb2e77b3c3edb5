"""What a comparison of two logs found, for people: the first difference of each topic, and where the others are."""

from collections.abc import Mapping, Sequence

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from replay.diff_result import FieldDifferences, Kind, LogDiff, Tolerances, TopicDiff
from replay.errors import one_line

MOST_FIELDS = 12  # of a topic
MOST_TRACKS = 8
SPARKS = "▁▂▃▄▅▆▇█"
SPARK_WIDTH = 30
_UNIT = 1e-4  # smaller sizes are written with a power of ten


def print_diff(diff: LogDiff, tolerances: Tolerances, console: Console) -> None:
    """Prints the first difference of each topic, figures of all, and what it comes to."""
    for first in diff.firsts:
        console.print(str(first), markup=False, highlight=False, soft_wrap=True)
    if diff.firsts:
        console.print()
    rows = [row for topic in diff.topics for row in _rows(topic)]
    columns = [column for column in _COLUMNS if any(row.get(column) for row in rows)]
    dropped = []
    while _width(table := _table(rows, columns), console) > console.width and console.is_terminal and columns[4:]:
        dropped.append(next(column for column in _LEAST_FIRST if column in columns))
        columns.remove(dropped[-1])
    console.width = max(console.width, _width(table, console))
    console.print(table)
    legend = [
        "alone: messages, and tracks or other items in them, that one log has" if "alone" in columns else "",
        f"when: how many messages differ, from 0 to {diff.span_s:.1f} s" if "when" in columns else "",
        f"not shown, as the window is narrow: {', '.join(dropped[::-1])}" if dropped else "",
    ]
    if any(legend):
        console.print(f"[dim]{'; '.join(filter(None, legend))}[/]", highlight=False, soft_wrap=True)
    if diff.renumbered:
        console.print(renumbered_line(diff), markup=False, highlight=False, soft_wrap=True)
    for loss in diff.losses:
        console.print(f"damaged: {loss}", markup=False, highlight=False, soft_wrap=True)
    console.print(verdict(diff, tolerances), highlight=False, soft_wrap=True)


def renumbered_line(diff: LogDiff) -> str:
    """Returns what is said of tracks whose numbers differ."""
    count = len(diff.renumbered)
    shown = ", ".join(f"{a} is {b}" for a, b in list(diff.renumbered.items())[:MOST_TRACKS])
    more = f" and {count - MOST_TRACKS} more" if count > MOST_TRACKS else ""
    have = "track has another number" if count == 1 else "tracks have other numbers"
    left_out = f"; left out, as they follow the numbers: {', '.join(diff.left_out)}" if diff.left_out else ""
    return f"{count} {have} in the second log, and were compared by where they are: {shown}{more}{left_out}"


def verdict(diff: LogDiff, tolerances: Tolerances) -> str:
    """Returns the last line."""
    if diff.identical:
        return "[green]identical[/]: the same bytes at the same times"
    limits = f"atol {tolerances.atol:g}, rtol {tolerances.rtol:g}"
    limits += f", share {tolerances.share:g}" if tolerances.share else ""
    if diff.same:
        largest = max(topic.within for topic in diff.topics)
        covered = f"; the largest difference is {size_in_words(largest)}" if largest else ""
        return f"[green]the same[/] within {limits}{covered}"
    different = sum(not topic.same for topic in diff.topics)
    return f"[red]different[/]: {different} of {len(diff.topics)} topics ({limits})"


def sparkline(when: Sequence[int], width: int = SPARK_WIDTH) -> str:
    """Returns counts over time as a row of bars, a dot for none; empty if there are none at all."""
    if not any(when):
        return ""
    step = max(1, len(when) // width)
    parts = [sum(when[start : start + step]) for start in range(0, len(when), step)]
    highest = max(parts)
    return "".join("·" if part == 0 else SPARKS[-(-part * len(SPARKS) // highest) - 1] for part in parts)


def size_in_words(size: float | None) -> str:
    """Returns the size of a difference with three digits."""
    if size is None:
        return ""
    return f"{size:.3g}" if size >= _UNIT or size == 0 else f"{size:.2e}"


_COLUMNS = ("topic", "is", "A", "B", "alone", "compared", "different", "first at", "largest", "p50", "p99", "when")
_LEAST_FIRST = ("p50", "p99", "compared", "when", "alone", "A", "B", "largest", "first at")  # to go without


def _rows(topic: TopicDiff) -> list[dict[str, str]]:
    """Returns a topic's row, and those of its fields, each by the columns that have something in them."""
    state = "identical" if topic.identical else "[green]same[/]"
    first = topic.first if topic.first is not None and topic.first.kind is not Kind.TOPIC else None
    rows = [
        {
            "topic": escape(one_line(topic.topic)),
            "is": state if topic.same else "[red]different[/]",
            "A": str(topic.messages[0]),
            "B": str(topic.messages[1]),
            "alone": _alone(topic),
            "compared": str(topic.values or ""),
            "different": str(topic.different or ""),
            "first at": f"{first.at_s:.3f} s" if first is not None else "",
            **_sizes(topic),
            "when": sparkline(topic.when),
        }
    ]
    for each in topic.fields[:MOST_FIELDS]:
        name = escape(one_line(each.field)) if each.field else "(undecoded)"
        counts = {"compared": str(each.values), "different": str(each.different)}
        rows.append({"topic": f"[dim]  {name}[/]", **counts, "first at": f"{each.first_at_s:.3f} s", **_sizes(each)})
    if len(topic.fields) > MOST_FIELDS:
        rows.append({"topic": f"[dim]  and {len(topic.fields) - MOST_FIELDS} more fields, in --json[/]"})
    return rows


def _sizes(found: TopicDiff | FieldDifferences) -> dict[str, str]:
    return {name: size_in_words(getattr(found, name)) for name in ("largest", "p50", "p99")}


def _table(rows: Sequence[Mapping[str, str]], columns: Sequence[str]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
    for column in columns:
        words = column in ("topic", "is", "alone", "when")
        table.add_column("" if column == "is" else column, justify="left" if words else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(row.get(column, "") for column in columns))
    return table


def _width(table: Table, console: Console) -> int:
    return console.measure(table, options=console.options.update(width=1000)).maximum


def _alone(topic: TopicDiff) -> str:
    parts = [(topic.stamps, "message"), (topic.items, "item")]
    return ", ".join(f"{count} {name}{'s' if count > 1 else ''}" for count, name in parts if count)
