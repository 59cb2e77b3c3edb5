"""Inspections as tables, for people: one frame, a stretch of a log, the recording itself."""

import math
from collections.abc import Iterable, Sequence

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from replay.camera_check import CameraCheck, Estimate
from replay.inspection import BoxReport, BoxScore, ClusterReport, FrameReport, Miss, NearMiss, Outcome, PersonReport
from replay.inspection_summary import InspectionSummary, PersonSummary, Spell, UntrackedBoxes, UntrackedCluster
from replay.log_info import delays_text
from replay.recording_check import RecordingReport, TopicTiming

MOST_ROWS = 12  # of a list whose tail is seldom read; the JSON has all
NEAR_LOG_RATIO = 0.7  # a box twice or half a person's height is somebody else's
HARDLY = -1.0  # log-odds by size: whatever is less likely than this, and touches no box, gets no row of its own
_STYLE = {Outcome.TRACKED: "green", Outcome.UNCONFIRMED: "yellow", Outcome.FADED: "yellow"}


def _print_table(
    console: Console,
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str | Text]],
    *,
    words: Sequence[str] = (),
    wraps: Sequence[str] = (),
) -> None:
    """Prints a table after an empty line; columns in `words` or `wraps` hold words, those in `wraps` may take lines."""
    table = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 1, 0, 0),
    )
    for column in columns:
        left = column in words or column in wraps
        table.add_column(column, justify="left" if left else "right", no_wrap=column not in wraps, overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print()
    console.print(table)


# --- one frame --------------------------------------------------------------------------------------------------------


def print_frame(report: FrameReport, console: Console) -> None:
    """Prints what every cluster, box, track and person of a frame came to."""
    boxes, cameras = _counted(len(report.boxes), "pedestrian box", "pedestrian boxes"), len(report.cameras)
    console.print(
        f"[bold]{report.at_s:.2f} s[/] into the log, scan of {report.stamp_ns / 1e9:.3f} s: "
        f"{_counted(len(report.clusters), 'measurement')}, {boxes} in {_counted(cameras, 'camera')}, "
        f"{_counted(report.tracks, 'track')}",
        soft_wrap=True,
    )
    if report.people is not None:
        columns = ("person", "ahead m", "left m", "points", "tracked")
        _print_table(console, "people (ground truth)", columns, map(_person_row, report.people), wraps=("tracked",))
    _print_clusters(report.clusters, console)
    left_over = [b for b in report.boxes if b.cluster is None]
    if left_over:
        columns = ("box", "score", "from px", "to px", "why")
        rows = map(_box_row, left_over)
        _print_table(console, "boxes without a cluster", columns, rows, words=("box",), wraps=("why",))
    if report.unmeasured:
        _print_table(
            console,
            "tracks without a measurement",
            ("track", "ahead m", "left m", "existence", "hidden"),
            (
                (str(t.id), f"{t.ahead_m:.1f}", f"{t.left_m:.1f}", _short(t.existence), _short(t.hidden))
                for t in report.unmeasured
            ),
        )
    console.print()


def _person_row(person: PersonReport) -> tuple[str | Text, ...]:
    if person.miss is None:
        word = Text(person.reason, "green")
    elif person.miss == Miss.FEW_POINTS:
        word = Text(f"no track, and none due: {person.reason}", "dim")
    else:
        word = Text("MISSED: ", "bold red").append(person.reason, "red")
    return str(person.id), f"{person.ahead_m:.1f}", f"{person.left_m:.1f}", str(person.lidar_points), word


def _box_row(found: BoxReport) -> tuple[str, ...]:
    x0, y0, x1, y1 = found.corners_px
    name, score = f"{found.camera}:{found.box}", _short(found.score)
    return name, score, f"{x0:.0f}, {y0:.0f}", f"{x1:.0f}, {y1:.0f}", escape(found.why)


def _print_clusters(clusters: Sequence[ClusterReport], console: Console) -> None:
    _print_table(
        console,
        "clusters, nearest first",
        ("#", "ahead m", "left m", "points", "w x h m", "size", "scan", "what came of it", "boxes"),
        (_cluster_row(c) for c in clusters if not _hardly(c)),
        wraps=("what came of it", "boxes"),
    )
    hardly = sorted(c.cluster for c in clusters if _hardly(c))
    if hardly:
        rows = ", ".join(map(str, hardly))
        _note(console, f"and {len(hardly)} of no person's size, with no box on them: {rows}")
    _note(console, "size: log-odds of a person by size alone; scan: probability of one by this scan, boxes included;")
    _note(console, "boxes: camera:row, the detector's score, and how well the box fits the cluster, 1.1 at most")


def _hardly(cluster: ClusterReport) -> bool:
    unlikely = cluster.size_log_odds is not None and cluster.size_log_odds < HARDLY
    return unlikely and not cluster.boxes and not cluster.near_misses and cluster.outcome is not Outcome.TRACKED


def _tells(miss: NearMiss, cluster: ClusterReport) -> bool:
    """Whether a near miss is worth a line: in a crowd, boxes of people far nearer or farther touch every cluster."""
    has_box = any(found.camera == miss.camera for found in cluster.boxes)
    return miss.fit > 0 or (not has_box and abs(miss.height_log_ratio) < NEAR_LOG_RATIO)


def _cluster_row(c: ClusterReport) -> tuple[str | Text, ...]:
    name = "camera" if c.cluster < 0 else f"{c.cluster}{'abc'[c.part] if c.parts > 1 else ''}"
    boxes = Text(", ".join(map(_matched_box, c.boxes)))
    for miss in filter(lambda miss: _tells(miss, c), c.near_misses):
        boxes.append("; " if boxes else "").append(f"not {miss.camera}:{miss.box}, {miss.why}", "dim")
    return (
        name,
        f"{c.ahead_m:.1f}",
        f"{c.left_m:.1f}",
        str(c.points) if c.cluster >= 0 else "",
        f"{c.width_m:.1f} x {c.height_m:.1f}" if c.cluster >= 0 else "",
        "" if c.size_log_odds is None else f"{c.size_log_odds:+.1f}",
        "" if c.pedestrian_probability is None else _short(c.pedestrian_probability),
        Text(c.reason, _STYLE.get(c.outcome, "red")),
        boxes,
    )


def _matched_box(found: BoxScore) -> str:
    fit = "" if found.fit is None else f" fit {_short(found.fit)}"
    return f"{found.camera}:{found.box} {_short(found.score)}{fit}"


# --- a stretch of a log -----------------------------------------------------------------------------------------------


def print_summary(summary: InspectionSummary, console: Console) -> None:
    """Prints who was missed and why; without ground truth, what looked like people and was not tracked."""
    console.print(
        f"{_counted(summary.frames, 'frame')}, {summary.from_s:.1f} to {summary.to_s:.1f} s of the log", soft_wrap=True
    )
    if summary.has_truth:
        _print_people(summary, console)
    else:
        _print_suspects(summary, console)


def _print_people(summary: InspectionSummary, console: Console) -> None:
    missed = [person for person in summary.people if person.missed_s > 0]
    share = summary.missed_s / summary.seen_s if summary.seen_s else 0.0
    console.print(
        f"{_counted(len(summary.people), 'person', 'people')} had 4 LiDAR points or more, "
        f"for {summary.seen_s:.1f} s altogether; "
        f"for [bold]{summary.missed_s:.1f} s[/] of that, {share:.1%}, they were not tracked",
        soft_wrap=True,
    )
    if missed:
        rows = ((why, f"{s:.1f}", f"{s / summary.missed_s:.0%}") for why, s in summary.reasons.items() if s >= 0.05)
        _print_table(console, "not tracked, by reason", ("why", "s", "share"), rows, words=("why",))
        _print_table(
            console,
            "missed longest",
            ("person", "missed s", "of s", "longest s", "look at", "tracks", "why"),
            map(_missed_row, missed[:MOST_ROWS]),
            words=("look at",),
            wraps=("tracks", "why"),
        )
        _and_more(len(missed), "people", console)
        _note(console, "pcgan inspect LOG.mcap --at S takes the frame at a time apart")
    if summary.switches:
        _print_table(
            console,
            "id switches",
            ("person", "track before", "after", "look at"),
            ((str(s.person), str(s.before), str(s.after), f"--at {s.at_s:.2f}") for s in summary.switches[:MOST_ROWS]),
            words=("look at",),
        )
        _and_more(len(summary.switches), "switches", console)


def _missed_row(person: PersonSummary) -> tuple[str, ...]:
    spell = person.longest
    return (
        str(person.id),
        f"{person.missed_s:.1f}",
        f"{person.seen_s:.1f}",
        f"{spell.length_s:.1f}" if spell else "",
        _look_at(spell),
        ", ".join(map(str, person.track_ids)) or "none",
        ", ".join(f"{reason} {seconds:.1f} s" for reason, seconds in person.reasons.items() if seconds >= 0.05),
    )


def _print_suspects(summary: InspectionSummary, console: Console) -> None:
    console.print("no ground truth; what looked like a person for half a second or longer and was not tracked:")
    if not summary.boxes and not summary.clusters:
        console.print("nothing did")
    if summary.boxes:
        _print_table(
            console,
            "boxes",
            ("camera", "s", "look at", "score", "at px", "why"),
            map(_suspect_box_row, summary.boxes[:MOST_ROWS]),
            words=("camera", "look at", "why"),
        )
        _and_more(len(summary.boxes), "boxes", console)
    if summary.clusters:
        _print_table(
            console,
            "clusters",
            ("s", "look at", "ahead m", "left m", "scan", "why"),
            map(_suspect_cluster_row, summary.clusters[:MOST_ROWS]),
            words=("look at", "why"),
        )
        _and_more(len(summary.clusters), "clusters", console)


def _suspect_box_row(found: UntrackedBoxes) -> tuple[str, ...]:
    (x, y), spell = found.middle_px, found.spell
    length, score = f"{spell.length_s:.1f}", _short(found.score)
    return found.camera, length, _look_at(spell), score, f"{x:.0f}, {y:.0f}", spell.reason


def _suspect_cluster_row(found: UntrackedCluster) -> tuple[str, ...]:
    ahead, left, spell = f"{found.ahead_m:.1f}", f"{found.left_m:.1f}", found.spell
    return f"{spell.length_s:.1f}", _look_at(spell), ahead, left, _short(found.pedestrian_probability), spell.reason


def _look_at(spell: Spell | None) -> str:
    return f"--at {spell.look_at_s:.2f}" if spell else ""


def _and_more(count: int, what: str, console: Console) -> None:
    if count > MOST_ROWS:
        _note(console, f"and {count - MOST_ROWS} more {what}: --json has them")


# --- the recording ----------------------------------------------------------------------------------------------------


def print_recording(report: RecordingReport, console: Console) -> None:
    """Prints how the sensors' stamps and the cameras' mounts look, and what is wrong with them."""
    columns = ("topic", "Hz", "jitter ms", "delay ms", "skew ms", "scans with", "gaps", "longest s")
    _print_table(console, "stamps", columns, map(_timing_row, report.topics), words=("topic",))
    _note(console, "delay: log time after the stamp, skew: from a scan to the nearest message, each median / p99;")
    _note(console, "scans with: detections near enough in time; gaps: longer than three periods")
    if report.cameras:
        _print_table(
            console,
            "cameras against the LiDAR",
            ("camera", "boxes", "right px", "left deg", "yaw off deg", "pitch off deg", "height", "offset ms"),
            map(_camera_row, report.cameras),
            words=("camera",),
        )
        _note(
            console, "boxes: that fit a cluster, of all; right, left: of its cluster a box lies so far, median ± MAD;"
        )
        _note(console, "height: of a box, in a person's at that distance; offset: to be added to the stamps;")
        _note(console, "yaw, pitch, offset: ± two standard errors")
    console.print()
    for verdict in report.verdicts:
        console.print(Text("! ", "bold red").append(verdict, "red"), soft_wrap=True)
    if not report.verdicts:
        told = [check.camera for check in report.cameras if check.yaw_deg is not None]
        has_cameras = any(topic.role == "camera" for topic in report.topics)
        why = "there are too few boxes on people" if has_cameras else "there are no cameras"
        mounts = f"the mounts of {', '.join(told)}" if told else f"no mount: {why}"
        console.print(f"nothing wrong was found; checked: the stamps, {mounts}", soft_wrap=True)
    console.print()


def _timing_row(topic: TopicTiming) -> tuple[str, ...]:
    return (
        topic.topic,
        _number(topic.rate_hz, ".1f"),
        _number(topic.jitter_ms, ".1f"),
        "" if topic.delay_ms is None else delays_text(*topic.delay_ms),
        _both(topic.skew_ms, ".1f", " / "),
        _number(topic.scans_with, ".0%"),
        str(topic.gaps),
        f"{topic.longest_gap_s:.2f}",
    )


def _camera_row(check: CameraCheck) -> tuple[str, ...]:
    ratio = "" if check.height_log_ratio is None else f"x {math.exp(check.height_log_ratio.value):.2f}"
    offset = _estimate(check.time_offset_ms, ".0f")
    return (
        check.camera,
        f"{check.boxes} / {check.boxes_seen}",
        _both(check.residual_px, ".1f", " ± "),
        _both(check.residual_deg, ".2f", " ± "),
        _estimate(check.yaw_deg, ".2f") or "too few",
        _estimate(check.pitch_deg, ".2f"),
        ratio,
        offset if check.time_offset_observable or not offset else "not observable",
    )


def _counted(count: int, one: str, several: str = "") -> str:
    return f"{count} {one if count == 1 else several or f'{one}s'}"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _both(values: tuple[float, float] | None, form: str, between: str) -> str:
    return "" if values is None else between.join(format(value, form) for value in values)


def _estimate(estimate: Estimate | None, form: str) -> str:
    return "" if estimate is None else f"{format(estimate.value, '+' + form)} ± {format(2 * estimate.error, form)}"


def _short(value: float) -> str:
    """Shows a probability in two digits: .07, 1.00."""
    return f"{value:.2f}".removeprefix("0")


def _note(console: Console, text: str) -> None:
    console.print(text, style="dim", markup=False, soft_wrap=True)
