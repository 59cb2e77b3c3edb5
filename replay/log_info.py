"""What a recording holds, and what of it a replay would use: behind `pcgan info`."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from replay.decoders import DECODERS
from replay.errors import LogError
from replay.log_reader import ChannelInfo, LogReader, RawMessage
from replay.roles import assign_roles
from replay.session import Replay, ReplaySettings
from schemas import topics
from schemas.codec import CodecError


def describe_log(
    paths: Sequence[Path], remaps: Mapping[str, str] | None = None, *, salvage: bool = False, seconds: float = 60.0
) -> dict[str, Any]:
    """Returns a JSON-able description of a log: topics with rates, delays and roles, and what is missing.

    Delays and skews are taken from the first `seconds` of the log. Raises LogError if it cannot be read at all; a log
    that can be read but not replayed has `usable` False and says why in `problem`.
    """
    reader = LogReader(paths, salvage=salvage)
    try:
        roles = assign_roles(reader.channels, remaps)
        role_of, missing = _role_names(roles.topic_of), list(roles.missing)
        problem = _refused(paths, remaps, salvage=salvage)
    except LogError as error:
        problem, role_of, missing = str(error), {}, []
    timed = timings(reader, seconds)
    scans = next((timed[name][0] for name, role in role_of.items() if role == "lidar clusters"), None)
    duration_s = (reader.end_ns - reader.start_ns) / 1e9
    return {
        "files": [path.name for path in paths],
        "start_ns": reader.start_ns,
        "duration_s": duration_s,
        "usable": problem is None,
        "problem": problem,
        "missing": missing,
        "salvage_losses": reader.losses.notes,
        "topics": [_topic(channel, duration_s, role_of, timed, scans) for channel in reader.channels],
    }


def _refused(paths: Sequence[Path], remaps: Mapping[str, str] | None, *, salvage: bool) -> str | None:
    """Returns why a replay would refuse the log, or None."""
    try:
        Replay(paths, ReplaySettings(topics=dict(remaps or {})), salvage=salvage)
    except LogError as error:
        return str(error)
    return None


def print_info(description: dict[str, Any], console: Console) -> None:
    """Prints a description as a table."""
    console.print(f"{', '.join(description['files'])}: {description['duration_s']:.1f} s", markup=False)
    table = Table(box=box.SIMPLE_HEAD)
    for column in ("topic", "schema", "count", "Hz", "delay ms", "skew ms", "role"):
        table.add_column(column, justify="left" if column in ("topic", "schema", "role") else "right", no_wrap=True)
    for row in description["topics"]:
        delay = "" if row["delay_ms"] is None else f"{row['delay_ms']['p50']:.0f} / {row['delay_ms']['p99']:.0f}"
        skew = "" if row["skew_ms"] is None else f"{row['skew_ms']['p50']:.1f} / {row['skew_ms']['p99']:.1f}"
        rate = "" if row["rate_hz"] is None else f"{row['rate_hz']:.1f}"
        schema = row["schema"] or row["encoding"] or "-"
        table.add_row(row["topic"], schema, str(row["count"]), rate, delay, skew, row["role"] or "[dim]not used[/]")
    console.print(table)
    console.print("[dim]delay: log time after the sensor's stamp, p50 / p99; skew: to the nearest scan, p50 / p99[/]")
    for name in description["missing"]:
        console.print(f"missing: {name}", markup=False)
    for loss in description["salvage_losses"]:
        console.print(f"damaged: {loss}", markup=False)
    if description["problem"]:
        console.print(f"cannot be replayed: {description['problem']}", markup=False)


def _role_names(topic_of: Mapping[str, str]) -> dict[str, str]:
    return {topic_of[topic.name]: topic.role for topic in topics.INPUTS if topic.name in topic_of}


def _topic(
    channel: ChannelInfo,
    duration_s: float,
    role_of: Mapping[str, str],
    timings: Mapping[str, tuple[np.ndarray, np.ndarray]],
    scans_ns: np.ndarray | None,
) -> dict[str, Any]:
    stamps_ns, delays_ns = timings.get(channel.topic, (np.zeros(0, np.int64), np.zeros(0, np.int64)))
    role = role_of.get(channel.topic)
    skews_ns = np.zeros(0, np.int64)
    if scans_ns is not None and role in ("camera detections", "vehicle pose") and len(scans_ns) and len(stamps_ns):
        ordered = np.sort(stamps_ns)
        after = np.clip(np.searchsorted(ordered, scans_ns), 1, max(1, len(ordered) - 1))
        near = np.minimum(
            np.abs(ordered[np.minimum(after, len(ordered) - 1)] - scans_ns), np.abs(ordered[after - 1] - scans_ns)
        )
        skews_ns = near
    return {
        "topic": channel.topic,
        "schema": channel.schema_name,
        "encoding": channel.encoding,
        "count": channel.messages,
        "rate_hz": (channel.messages - 1) / duration_s if channel.messages > 1 and duration_s > 0 else None,
        "delay_ms": _percentiles_ms(delays_ns),
        "skew_ms": _percentiles_ms(skews_ns),
        "role": role,
    }


def timings(reader: LogReader, seconds: float) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Returns stamps and delays (log time minus stamp), in ns, of each topic whose messages we can decode."""
    known = {channel.topic for channel in reader.channels if channel.schema_name in DECODERS}
    rows: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for message in reader.messages(known, None, reader.start_ns + round(seconds * 1e9)):
        stamp_ns = _stamp(message)
        if stamp_ns is not None:
            rows[message.topic].append((stamp_ns, message.log_time_ns - stamp_ns))
    columns = {name: np.array(pairs, np.int64).T for name, pairs in rows.items()}
    return defaultdict(
        lambda: (np.zeros(0, np.int64), np.zeros(0, np.int64)),
        {name: (stamps, delays) for name, (stamps, delays) in columns.items()},
    )


def _stamp(message: RawMessage) -> int | None:
    try:
        decoded = DECODERS[message.schema_name][1](message.data)
    except CodecError:
        return None
    first = next(iter(decoded), None) if isinstance(decoded, tuple) else decoded
    return None if first is None else int(first.stamp_ns)


def _percentiles_ms(values_ns: np.ndarray) -> dict[str, float] | None:
    if len(values_ns) == 0:
        return None
    return {f"p{q}": round(float(np.percentile(values_ns, q)) / 1e6, 3) for q in (50, 99)}
