"""What a recording holds, and what of it a replay would use: behind `pcgan info`."""

import contextlib
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from replay.class_labels import ClassLabels, unmatched_line
from replay.decoders import decoders_for
from replay.errors import LogError
from replay.log_reader import LogReader
from replay.logged_message import ChannelInfo, RawMessage
from replay.roles import MESSAGES, SCANS, WHAT, Reading, assign_roles
from replay.session import Replay, ReplaySettings, frame_named
from schemas.codec import CodecError

_NO_TIME_NS = 2**63  # what 64 bits with a sign do not hold: nobody's clock


def describe_log(
    paths: Sequence[Path], settings: ReplaySettings | None = None, *, salvage: bool = False, seconds: float = 60.0
) -> dict[str, Any]:
    """Returns a JSON-able description of a log: topics with rates, delays and roles, why, and what is missing.

    Delays and skews are taken from the first `seconds` of the log. Raises LogError if it cannot be read at all; a log
    that can be read but not replayed has `usable` False and says why in `problem`.
    """
    reader = LogReader(paths, salvage=salvage)
    settings = settings or ReplaySettings()
    readings: Mapping[str, Reading] = {}
    missing: Sequence[str] = ()
    problem = None
    try:
        roles = assign_roles(reader.channels, settings.roles, partial(frame_named, reader))
        readings, missing = roles.readings, roles.missing
        Replay(paths, settings, salvage=salvage)
    except LogError as error:
        problem = str(error)
    labels = ClassLabels(settings.tracking.fusion.pedestrian_labels)
    classed = {name for name, reading in readings.items() if reading.role in ("camera", "tracks")}
    timed = timings(reader, seconds, lambda topic, message: labels.see(message) if topic in classed else None)
    scans = next((timed[name][0] for name, reading in readings.items() if reading.role in SCANS), None)
    duration_s = (reader.end_ns - reader.start_ns) / 1e9
    return {
        "files": [path.name for path in paths],
        "start_ns": reader.start_ns,
        "duration_s": duration_s,
        "usable": problem is None,
        "problem": problem,
        "missing": list(missing),
        "salvage_losses": reader.losses.notes,
        "labels": dict(labels.counts.most_common()),
        "unmatched_labels": labels.unmatched,
        "topics": [
            _topic(channel, duration_s, readings.get(channel.topic), timed, scans) for channel in reader.channels
        ],
    }


def print_info(description: dict[str, Any], console: Console) -> None:
    """Prints a description as a table."""
    console.print(f"{', '.join(description['files'])}: {description['duration_s']:.1f} s", markup=False)
    table = Table(box=box.SIMPLE_HEAD)
    for column in ("topic", "schema", "count", "Hz", "delay ms", "skew ms", "role", "why"):
        words = column in ("topic", "schema", "role", "why")
        table.add_column(column, justify="left" if words else "right", no_wrap=True)
    for row in description["topics"]:
        delay = "" if row["delay_ms"] is None else delays_text(row["delay_ms"]["p50"], row["delay_ms"]["p99"])
        skew = "" if row["skew_ms"] is None else f"{row['skew_ms']['p50']:.1f} / {row['skew_ms']['p99']:.1f}"
        rate = "" if row["rate_hz"] is None else f"{row['rate_hz']:.1f}"
        schema = row["schema"] or row["encoding"] or "-"
        camera = f" {row['camera']}" if row["camera"] else ""
        role = escape(f"{row['role']}{camera}") if row["role"] else "[dim]not used[/]"
        could = f"[dim]could be {' or '.join(row['could_be'])}[/]" if row["could_be"] else ""
        why = escape(row["why"]) if row["why"] else could
        table.add_row(escape(row["topic"]), escape(schema), str(row["count"]), rate, delay, skew, role, why)
    console.width = max(console.width, console.measure(table).maximum)
    console.print(table)
    if any(row["could_be"] for row in description["topics"]):
        console.print("[dim]a topic that could play a role is given it with --role ROLE:=TOPIC[/]")
    console.print("[dim]delay: log time after the stamp; skew: from a scan to the nearest message; each p50 / p99[/]")
    if description["labels"]:
        counts = ", ".join(f"{label or '(none)'} {count}" for label, count in list(description["labels"].items())[:20])
        console.print(f"labels: {counts}", markup=False, soft_wrap=True)
    if description["unmatched_labels"]:
        console.print(unmatched_line(description["unmatched_labels"]), markup=False, soft_wrap=True)
    for name in description["missing"]:
        console.print(f"missing: {name}", markup=False)
    for loss in description["salvage_losses"]:
        console.print(f"damaged: {loss}", markup=False)
    if description["problem"]:
        console.print(f"cannot be replayed: {description['problem']}", markup=False)


def delays_text(p50_ms: float, p99_ms: float) -> str:
    """Returns two delays in ms; in s or days where a recording was made long after its sensors' stamps."""
    for unit_ms, unit in ((86_400_000, " d"), (1000, " s")):
        if abs(p50_ms) > 100 * unit_ms:
            return f"{p50_ms / unit_ms:.0f} / {p99_ms / unit_ms:.0f}{unit}"
    return f"{p50_ms:.0f} / {p99_ms:.0f}"


def _topic(
    channel: ChannelInfo,
    duration_s: float,
    reading: Reading | None,
    timings: Mapping[str, tuple[np.ndarray, np.ndarray]],
    scans_ns: np.ndarray | None,
) -> dict[str, Any]:
    stamps_ns, delays_ns = timings.get(channel.topic, (np.zeros(0, np.int64), np.zeros(0, np.int64)))
    role = reading.role if reading else None
    skews_ns = np.zeros(0, np.int64)
    if scans_ns is not None and role in ("camera", "pose") and len(scans_ns) and len(stamps_ns):
        ordered = np.sort(stamps_ns)
        after = np.clip(np.searchsorted(ordered, scans_ns), 1, max(1, len(ordered) - 1))
        near = np.minimum(
            np.abs(ordered[np.minimum(after, len(ordered) - 1)] - scans_ns), np.abs(ordered[after - 1] - scans_ns)
        )
        skews_ns = near
    return {
        "topic": channel.topic,
        "schema": channel.schema.name,
        "encoding": channel.encoding,
        "count": channel.messages,
        "rate_hz": (channel.messages - 1) / duration_s if channel.messages > 1 and duration_s > 0 else None,
        "delay_ms": _percentiles_ms(delays_ns),
        "skew_ms": _percentiles_ms(skews_ns),
        "role": role,
        "camera": reading.camera if reading else None,
        "why": reading.why if reading else None,
        "could_be": [] if reading else _could_be(channel),
    }


def _could_be(channel: ChannelInfo) -> list[str]:
    messages = {way.message for way in decoders_for(channel.schema, channel.encoding)}
    return [role for role in WHAT if messages & set(MESSAGES[role])]


def timings(
    reader: LogReader, seconds: float, see: Callable[[str, object], None] = lambda *_: None
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Returns stamps and delays (log time minus stamp), in ns, of each topic whose messages we can decode.

    `see` is shown each of them, with its topic.
    """
    known = {channel.topic for channel in reader.channels if decoders_for(channel.schema, channel.encoding)}
    rows: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for message in reader.messages(known, None, reader.start_ns + round(seconds * 1e9)):
        decoded = _decoded(message)
        see(message.topic, decoded)
        stamp_ns = _stamp(decoded)
        if stamp_ns is not None and message.log_time_ns < _NO_TIME_NS:
            rows[message.topic].append((stamp_ns, message.log_time_ns - stamp_ns))
    columns = {name: np.array(pairs, np.int64).T for name, pairs in rows.items()}
    return defaultdict(
        lambda: (np.zeros(0, np.int64), np.zeros(0, np.int64)),
        {name: (stamps, delays) for name, (stamps, delays) in columns.items()},
    )


def _decoded(message: RawMessage) -> object:
    """Returns what a message holds, read in the usual way; None if it does not decode."""
    for way in decoders_for(message.schema, message.encoding)[:1]:  # a topic may have messages of several schemas
        with contextlib.suppress(CodecError):
            return way.decode(message.data)
    return None


def _stamp(decoded: Any) -> int | None:
    """Returns a message's stamp; None if it has none, as static transforms may."""
    first = next(iter(decoded), None) if isinstance(decoded, tuple) else decoded
    return None if first is None else int(first.stamp_ns) or None


def _percentiles_ms(values_ns: np.ndarray) -> dict[str, float] | None:
    if len(values_ns) == 0:
        return None
    return {f"p{q}": round(float(np.percentile(values_ns, q)) / 1e6, 3) for q in (50, 99)}
