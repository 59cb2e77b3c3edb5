"""The subcommand `pcgan inspect`: why somebody was missed, and whether the recording itself is in order."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import Progress

from replay.cli_common import (
    DRIVES,
    Duration,
    Log,
    PedestrianLabels,
    ProfileFile,
    RoleOptions,
    Salvage,
    Start,
    TimeOffsets,
    closing_lines,
    console,
    ended_by_signals,
    fail,
    note_missing,
    progress,
    refuse_unwritable,
    refused_figures,
    settings_of,
    write_json,
)

if TYPE_CHECKING:
    from replay.inspection import Inspected
    from replay.session import Replay

app = typer.Typer()

AFTER_S = 1.0  # a frame is known so long after its scan at the latest


@app.command(rich_help_panel=DRIVES)
def inspect(
    logs: Log,
    at: Annotated[
        float | None, typer.Option(min=0, metavar="S", help="Take the frame nearest this time apart.")
    ] = None,
    frames: Annotated[bool, typer.Option("--frames", metavar="", help="Take every frame apart.")] = False,
    start: Start = None,
    duration: Duration = None,
    as_json: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write all of it as JSON, every frame included.")
    ] = None,
    rrd: Annotated[
        Path | None, typer.Option("--rrd", metavar="FILE", help="Draw it all into a rerun recording.")
    ] = None,
    salvage: Salvage = False,
    role: RoleOptions = None,
    pedestrian_label: PedestrianLabels = None,
    time_offset: TimeOffsets = None,
    profile: ProfileFile = None,
) -> None:
    """Say why pedestrians were missed, and check a recording's stamps and camera mounts.

    Without **--at** and **--frames**: the recording's check, and whom to look at, when. Times are seconds into the log.

    **Examples**

    pcgan inspect drive.mcap

    pcgan inspect drive.mcap --at 12.3

    pcgan inspect drive.mcap --start 60 --duration 10 --rrd why.rrd

    pcgan inspect drive.mcap --time-offset /gmsl/A1/detections:=-80

    **Exit codes**: 0 all well, 2 an error, 3 messages were refused or lost, 130 Ctrl-C, 143 SIGTERM.
    """
    from replay.camera_check import CameraWatch
    from replay.inspection_summary import InspectionLog
    from replay.inspection_table import print_frame, print_recording, print_summary
    from replay.inspection_view import view
    from replay.record import refuse_overwriting
    from replay.recording_check import check_stamps, report
    from replay.session import Replay

    if at is not None and (frames or duration is not None):
        fail("--at shows one frame: leave out --frames and --duration")
    written = [path for path in (as_json, rrd) if path is not None]
    refuse_overwriting(logs, *written)
    refuse_unwritable(*written)
    settings = settings_of(
        profile,
        start=start,
        duration=duration,
        roles=role,
        time_offsets=time_offset,
        pedestrian_labels=pedestrian_label,
    )
    if at is not None:
        if at < settings.start_s:
            fail(f"--at {at:g} lies before the start, {settings.start_s:g} s into the log")
        settings = settings.model_copy(update={"duration_s": at - settings.start_s + AFTER_S})
    run = Replay(logs, settings, salvage=salvage, images=rrd is not None)
    note_missing(run)
    whole = not frames and at is None
    out, params = console(minimum_width=100), run.settings.tracking.fusion
    watch, log, kept = CameraWatch(params), InspectionLog(), list[Any]()
    with ended_by_signals(), view(rrd, "+".join(path.stem for path in logs), params) as shown, progress() as bar:
        for each in _frames(run, at, bar):
            watch.add(each.frame, each.measurements, each.labels, each.report.at_s)
            log.add(each.report)
            shown.show_inspected(each)
            if not whole:
                print_frame(each.report, out)
            if as_json is not None:
                kept.append(_plain(each.report))
        stamps = check_stamps(run.reader, run.roles, run.settings.sync, run.offsets_ns) if whole else None
    figures: dict[str, Any] = {"files": [path.name for path in logs], "frames": kept, **refused_figures(run)}
    if stamps is not None:
        recording, summary = report(stamps, watch.checks(run.roles)), log.summary()
        print_recording(recording, out)
        print_summary(summary, out)
        figures |= {"recording": _plain(recording), "summary": _plain(summary)}
    if as_json is not None:
        write_json(as_json, figures, indent=None)
    raise typer.Exit(closing_lines(run, written, out))


def _frames(run: "Replay", at_s: float | None, bar: Progress) -> Iterator["Inspected"]:
    """Yields the frames to be shown: all that are not there to warm the tracker up, or the one nearest `at_s`."""
    from replay.inspection import inspect_frames

    task = bar.add_task("inspecting", total=(run.end_ns - run.start_ns) / 1e9)
    nearest = None
    for each in inspect_frames(run):
        bar.update(task, completed=each.report.at_s - run.settings.start_s)
        if each.frame.log_time_ns < run.start_ns:
            continue
        if at_s is None:
            yield each
        elif nearest is None or abs(each.report.at_s - at_s) < abs(nearest.report.at_s - at_s):
            nearest = each
    if at_s is None:
        return
    if nearest is None or abs(nearest.report.at_s - at_s) > AFTER_S:
        fail(f"there is no frame within {AFTER_S:g} s of --at {at_s:g}")
    yield nearest


def _plain(value: Any) -> Any:
    """Returns a report as JSON takes it, with as many digits as its numbers deserve."""
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return round(value, 4) if isinstance(value, float) else value
