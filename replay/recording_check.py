"""What of a recording is not as it should be: stamps against the log's clock and the scans, cameras against the LiDAR.

`check_stamps` and `camera_check.CameraWatch` measure, `report` says in words what is significantly wrong.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from replay.camera_check import CameraCheck, Estimate, median_and_mad
from replay.log_info import timings
from replay.log_reader import LogReader
from replay.roles import SCANS, STAMPED, Roles
from replay.stamp_guard import StampGuard, Verdict
from replay.time_sync import SyncSettings
from schemas.messages import FloatArray, IntArray

# when a significant figure becomes a verdict
YAW_DEG, PITCH_DEG, OFFSET_S, HEIGHT_RATIO = 1.0, 1.0, 0.020, 1.15
DELAY_MS = 30.0  # against the other cameras
MATCHED_SHARE, MANY_BOXES = 0.25, 100  # of a camera whose boxes have next to nothing to do with the clusters
GAP_S = 0.5  # poses further apart bracket no scan
EVIDENCE_SHARE = 0.95  # of the scans, with detections near enough


@dataclass(frozen=True)
class TopicTiming:
    """One sensor's stamps: against each other, against the log's clock, against the scans."""

    topic: str  # name in the log
    role: str
    messages: int  # without the refused ones
    refused: int  # absurd stamps
    rate_hz: float | None  # by its stamps
    jitter_ms: float | None  # robust sigma of the time from stamp to stamp
    delay_ms: tuple[float, float] | None  # log time after the stamp: median, 99th percentile; between clock resets
    skew_ms: tuple[float, float] | None  # from a scan to the nearest message; cameras and poses only
    scans_with: float | None  # share of the scans with a message near enough; cameras only
    gaps: int  # more than three periods without a message, or 0.5 s at the log's ends
    longest_gap_s: float
    longest_gap_at_s: float | None  # seconds into the log


@dataclass(frozen=True)
class ClockReset:
    """The sensors' clock was set."""

    at_s: float  # seconds into the log
    by_s: float  # negative: back


@dataclass(frozen=True)
class StampCheck:
    """What the stamps of a recording look like."""

    topics: tuple[TopicTiming, ...]
    clock_resets: tuple[ClockReset, ...]


@dataclass(frozen=True)
class RecordingReport:
    """All that was found, and in words what should be looked at."""

    topics: tuple[TopicTiming, ...]
    clock_resets: tuple[ClockReset, ...]
    cameras: tuple[CameraCheck, ...]
    verdicts: tuple[str, ...]


# --- stamps -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Stamps:
    """The messages of one topic that a replay would take, in the log's order."""

    stamps_ns: IntArray  # (N,)
    delays_ns: IntArray  # (N,)  log time minus stamp
    epochs: IntArray  # (N,)  how many clock resets lie before the message
    refused: int  # messages with absurd stamps, which are left out


def check_stamps(
    reader: LogReader, roles: Roles, sync: SyncSettings, offsets_ns: Mapping[str, int], seconds: float = math.inf
) -> StampCheck:
    """Returns the timing of each topic with stamps that count, over the first `seconds` of the log.

    Stamps are those of the log plus the topic's time offset (`offsets_ns`).
    """
    span_s = min(seconds, (reader.end_ns - reader.start_ns) / 1e9 + 1)
    end_ns = min(reader.end_ns, reader.start_ns + round(span_s * 1e9))
    found = timings(reader, span_s)
    used, resets, usual = _as_replayed({name: found[name] for name in roles.topics(*STAMPED, "truth")}, offsets_ns)
    return StampCheck(
        tuple(
            _timing(
                roles.readings[name].role,
                name,
                used[name],
                used[roles.scans],
                sync,
                (reader.start_ns, end_ns),
                usual,
            )
            for name in roles.topics(*STAMPED)
        ),
        tuple(ClockReset((at_ns - reader.start_ns) / 1e9, by_ns / 1e9) for at_ns, by_ns in resets),
    )


def _as_replayed(
    found: Mapping[str, tuple[IntArray, IntArray]], offsets_ns: Mapping[str, int]
) -> tuple[dict[str, _Stamps], list[tuple[int, float]], int]:
    """Runs stamps through the guards in log order, as TimeSync does.

    Args:
        found: topic -> stamps and delays (N,), in the log's order.
        offsets_ns: topic -> what is added to stamps.

    Returns:
        what is left of each topic, (log time, by how much in ns) of each clock reset, and the epoch whose stamps agree
        best with the log's clock.
    """
    names = list(found)
    offset = {name: offsets_ns.get(name, 0) for name in names}
    stamps = np.concatenate([found[name][0] + offset[name] for name in names])
    delays = np.concatenate([found[name][1] - offset[name] for name in names])
    topic = np.repeat(np.arange(len(names)), [len(found[name][0]) for name in names])
    order = np.argsort(stamps + delays, kind="stable")
    epochs = np.full(len(order), -1)  # -1: refused
    guards: dict[int, StampGuard] = {}
    reference: tuple[int, int] | None = None
    resets_ns: list[int] = []
    columns = (topic[order].tolist(), stamps[order].tolist(), (stamps + delays)[order].tolist())
    for row, which, stamp_ns, log_time_ns in zip(order.tolist(), *columns, strict=True):
        verdict = guards.setdefault(which, StampGuard(reference)).check(stamp_ns, log_time_ns)
        if verdict is Verdict.REFUSE:
            continue
        if verdict is Verdict.NEW_EPOCH:
            resets_ns.append(log_time_ns)
            reference = (stamp_ns, log_time_ns)
            guards = {which: StampGuard(reference)}
            guards[which].check(stamp_ns, log_time_ns)
        epochs[row] = len(resets_ns)
    behind_ns = [float(np.median(delays[epochs == epoch])) for epoch in range(len(resets_ns) + 1) if len(epochs)]
    used = {}
    for which, name in enumerate(names):
        mine = order[(topic == which)[order] & (epochs >= 0)[order]]
        used[name] = _Stamps(stamps[mine], delays[mine], epochs[mine], int((topic == which).sum()) - len(mine))
    resets = [(at_ns, -by_ns) for at_ns, by_ns in zip(resets_ns, np.diff(behind_ns).tolist(), strict=True)]
    return used, resets, int(np.abs(behind_ns).argmin()) if behind_ns else 0


def _timing(
    role: str,
    topic: str,
    mine: _Stamps,
    scans: _Stamps,
    sync: SyncSettings,
    span_ns: tuple[int, int],
    usual: int,
) -> TopicTiming:
    """Returns the timing of one topic.

    Args:
        role: of the topic.
        topic: its name in the log.
        mine: its messages.
        scans: the LiDAR's.
        sync: how near detections have to be.
        span_ns: log times of the first and last message of any topic.
        usual: epoch whose delays are looked at: those before and after a clock reset do not compare.
    """
    order = np.lexsort((mine.stamps_ns, mine.epochs))
    steps_ns = np.diff(mine.stamps_ns[order])[np.diff(mine.epochs[order]) == 0]
    steps_ns = steps_ns[steps_ns > 0]
    rate = jitter = None
    many_ns = GAP_S * 1e9
    if len(steps_ns):
        period_ns, mad_ns = median_and_mad(steps_ns)
        rate, jitter, many_ns = 1e9 / period_ns, 1.4826 * mad_ns / 1e6, 3 * period_ns
    from_ns, waits_ns = _waits(mine, *span_ns)
    longest = int(waits_ns.argmax()) if len(waits_ns) else None
    skews_ms = _skews_ms(scans, mine) if role in ("camera", "pose") else np.zeros(0)
    near = None
    if role == "camera" and len(skews_ms):
        near = float((skews_ms <= sync.camera_tolerance_ms).mean())
    return TopicTiming(
        topic,
        role,
        len(mine.stamps_ns),
        mine.refused,
        rate,
        jitter,
        _median_and_p99(mine.delays_ns[mine.epochs == usual] / 1e6),
        _median_and_p99(skews_ms[np.isfinite(skews_ms)]),
        near,
        int((waits_ns > many_ns).sum()),
        0.0 if longest is None else float(waits_ns[longest]) / 1e9,
        None if longest is None else float(from_ns[longest] - span_ns[0]) / 1e9,
    )


def _waits(mine: _Stamps, start_ns: int, end_ns: int) -> tuple[IntArray, IntArray]:
    """Returns log times (W,) and how long the next message took after them (W,), in ns.

    That is by stamps and by log times, whichever is less: messages may be logged late, and clocks be set. From the
    log's start and to its end it counts if it is long; sensors do not all start and stop at once.
    """
    log_ns = mine.stamps_ns + mine.delays_ns
    waits_ns = np.minimum(np.diff(log_ns), np.where(np.diff(mine.epochs) == 0, np.diff(mine.stamps_ns), end_ns))
    if len(log_ns) == 0:
        return np.array([start_ns]), np.array([end_ns - start_ns])
    from_ns = np.concatenate([[start_ns], log_ns])
    waits_ns = np.concatenate([[log_ns[0] - start_ns], waits_ns, [end_ns - log_ns[-1]]])
    counts = np.ones(len(waits_ns), bool)
    counts[[0, -1]] = waits_ns[[0, -1]] > GAP_S * 1e9
    return from_ns[counts], waits_ns[counts]


def _skews_ms(scans: _Stamps, mine: _Stamps) -> FloatArray:
    """Returns the time (S,) from each scan to the nearest message of its epoch, in ms; infinite without one."""
    skews = [np.zeros(0)]
    for epoch in np.unique(scans.epochs):
        scans_ns, stamps_ns = scans.stamps_ns[scans.epochs == epoch], np.sort(mine.stamps_ns[mine.epochs == epoch])
        if len(stamps_ns) == 0:
            skews.append(np.full(len(scans_ns), np.inf))
            continue
        after = np.minimum(np.searchsorted(stamps_ns, scans_ns), len(stamps_ns) - 1)
        before = np.maximum(after - 1, 0)
        nearest_ns = np.minimum(np.abs(stamps_ns[after] - scans_ns), np.abs(stamps_ns[before] - scans_ns))
        skews.append(nearest_ns / 1e6)
    return np.concatenate(skews)


def _median_and_p99(values: FloatArray) -> tuple[float, float] | None:
    return (float(np.median(values)), float(np.percentile(values, 99))) if len(values) else None


# --- verdicts ---------------------------------------------------------------------------------------------------------


def report(stamps: StampCheck, cameras: Sequence[CameraCheck]) -> RecordingReport:
    """Puts the checks together and says in words what is significantly wrong, and what would mend it."""
    lines = [_reset_verdict(reset) for reset in stamps.clock_resets]
    lines += [*_timing_verdicts(stamps.topics), *_offset_verdicts(stamps.topics, cameras)]
    for check in cameras:
        lines += _mount_verdicts(check)
    return RecordingReport(stamps.topics, stamps.clock_resets, tuple(cameras), tuple(lines))


def _reset_verdict(reset: ClockReset) -> str:
    where, by_s = "back" if reset.by_s < 0 else "forward", abs(reset.by_s)
    return f"the clock was set {where} by {by_s:.1f} s, at {reset.at_s:.1f} s into the log: tracks begin anew there"


def _timing_verdicts(timing: Sequence[TopicTiming]) -> list[str]:
    lines = []
    for topic in timing:
        if topic.longest_gap_s > GAP_S and topic.role != "image":
            lines.append(
                f"{topic.topic}: no message for {topic.longest_gap_s:.1f} s, from {topic.longest_gap_at_s:.1f} s on"
            )
        if topic.scans_with is not None and topic.scans_with < EVIDENCE_SHARE:
            lines.append(f"{topic.topic}: only {topic.scans_with:.0%} of the scans have detections near enough in time")
    return lines


def _offset_verdicts(timing: Sequence[TopicTiming], cameras: Sequence[CameraCheck]) -> list[str]:
    """Says whose stamps are off. Where every camera's are off alike, they are the LiDAR's."""
    of_role = defaultdict(list)
    for topic in timing:
        of_role[topic.role].append(topic)
    lines = []
    found_of = {c.topic: c.time_offset_ms for c in cameras if c.time_offset_ms and c.time_offset_observable}
    common = _common(list(found_of.values()))
    if common is not None and common.exceeds(1e3 * OFFSET_S):
        scans = next(t for role in SCANS for t in of_role[role]).topic
        lines.append(
            f"{scans}: its stamps are about {abs(common.value):.0f} ms (± {2 * common.error:.0f}) "
            f"{_late(-common.value)}, by how the boxes of every camera move against the clusters: "
            f"try --time-offset {scans}:={-common.value:.0f}"
        )
        found_of = {}
    for check in cameras:
        found = found_of.get(check.topic)
        if found is not None and found.exceeds(1e3 * OFFSET_S):
            lines.append(
                f"{check.camera}: its stamps are about {abs(found.value):.0f} ms (± {2 * found.error:.0f}) "
                f"{_late(found.value)}, by how its boxes move against the clusters: "
                f"try --time-offset {check.topic}:={found.value:.0f}"
            )
    for topic in timing:
        if topic.delay_ms is None:
            continue
        delays = [t.delay_ms[0] for t in of_role[topic.role] if t.delay_ms is not None]
        usual = float(np.median(delays)) if len(delays) >= 3 else None
        if usual is not None and abs(topic.delay_ms[0] - usual) > DELAY_MS:
            apart = topic.delay_ms[0] - usual
            lines.append(
                f"{topic.topic}: logged {topic.delay_ms[0]:.0f} ms after its stamps, cameras usually {usual:.0f} ms: "
                f"its stamps may be {abs(apart):.0f} ms {_late(apart)}"
            )
        elif topic.delay_ms[0] < 0:
            lines.append(f"{topic.topic}: logged {-topic.delay_ms[0]:.0f} ms before its stamps: another clock?")
    return lines


def _common(estimates: Sequence[Estimate]) -> Estimate | None:
    """Returns what three or more estimates agree on within their errors, or None."""
    if len(estimates) < 3:
        return None
    values, errors = (np.array([getattr(e, name) for e in estimates]) for name in ("value", "error"))
    weights = 1 / np.maximum(errors, 1.0) ** 2
    mean = float(values @ weights / weights.sum())
    agree = np.abs(values - mean) <= np.maximum(3 * errors, 0.25 * abs(mean))
    return Estimate(mean, float(weights.sum() ** -0.5)) if agree.all() else None


def _late(offset_ms: float) -> str:
    """What stamps are to which this has to be added."""
    return "too late" if offset_ms < 0 else "too early"


def _mount_verdicts(check: CameraCheck) -> list[str]:
    lines = []
    if check.since_s is not None:
        lines.append(
            f"{check.camera}: its calibration changes on the way; its boxes are checked from {check.since_s:.1f} s on, "
            "against the last one"
        )
    if check.boxes_seen >= MANY_BOXES and check.boxes < MATCHED_SHARE * check.boxes_seen:
        lines.append(
            f"{check.camera}: only {check.boxes} of {check.boxes_seen} boxes have a person's cluster near them: its "
            "calibration or mount may be another camera's, or its boxes of another image size"
        )
    if check.yaw_deg is not None and check.yaw_deg.exceeds(YAW_DEG):
        yaw = check.yaw_deg.value
        there, back = ("left", "right") if yaw > 0 else ("right", "left")
        lines.append(
            f"{check.camera}: boxes lie {abs(yaw):.1f} deg (± {2 * check.yaw_deg.error:.1f}) {there} of the clusters: "
            f"its extrinsic rotation about the vertical is off; turn it {abs(yaw):.1f} deg to the {back}"
        )
    if check.pitch_deg is not None and check.pitch_deg.exceeds(PITCH_DEG):
        pitch = check.pitch_deg.value
        there, back = ("above", "down") if pitch > 0 else ("below", "up")
        lines.append(
            f"{check.camera}: boxes lie {abs(pitch):.1f} deg (± {2 * check.pitch_deg.error:.1f}) {there} the clusters: "
            f"its extrinsic pitch, or the height of the ground, is off; turn it {abs(pitch):.1f} deg {back}"
        )
    if check.height_log_ratio is not None and check.height_log_ratio.exceeds(math.log(HEIGHT_RATIO)):
        lines.append(
            f"{check.camera}: boxes are {math.exp(check.height_log_ratio.value):.2f} times as high as people at the "
            "clusters' distance: its intrinsics, or boxes of another image size"
        )
    return lines
