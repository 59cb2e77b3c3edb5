"""The closing summary of a replay, for people."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from replay.class_labels import unmatched_line
from replay.errors import ReplayError, refused_line
from replay.record import Summary


def print_summary(summary: Summary, written: Sequence[Path], console: Console) -> None:
    """Prints what a replay did, how good it was and where the results are."""
    figures: dict[str, Any] = summary.as_json()
    speed = f", {figures['realtime_factor']:.1f} times real time" if summary.wall_s else ""
    console.print(
        f"[bold]{summary.frames}[/] frames, [bold]{len(summary.track_ids)}[/] tracks, "
        f"[bold]{summary.predictions}[/] predictions ({summary.fallbacks} of them extrapolated) "
        f"of {summary.log_s:.1f} s in {summary.wall_s:.1f} s{speed}",
        soft_wrap=True,
    )
    console.print(_errors_table(figures))
    truth = figures.get("ground_truth")
    if truth:
        console.print(
            f"tracks against ground truth: HOTA {truth['hota']:.3f}, MOTA {truth['mota']:.3f}, "
            f"IDF1 {truth['idf1']:.3f}, GOSPA {truth['gospa_m']:.2f} m, {truth['id_switches']} id switches",
            soft_wrap=True,
        )
        console.print(
            f"of {truth['people_seen']} people seen for 2 s or more, {truth['people_tracked']} were tracked "
            f"and {truth['people_predicted']} predicted by the network"
        )
    stages = ", ".join(f"{stage} {ms['p50']:.1f}/{ms['p99']:.1f}" for stage, ms in summary.latency_ms.items())
    console.print(
        f"[dim]latency p50/p99 in ms: {stages} (predict: from asking to answer, with up to a window in line)[/]",
        soft_wrap=True,
    )
    if summary.restarts:
        console.print(f"the predictor was replaced {summary.restarts} times; nothing was lost")
    for line in summary.first_refusals[:5]:
        console.print(line, markup=False)
    if summary.refused:
        console.print(refused_line(summary.refused))
    if summary.unmatched_labels:
        console.print(f"[yellow]{escape(unmatched_line(summary.unmatched_labels))}[/]", soft_wrap=True)
    for line in summary.salvage_losses[:5]:
        console.print(line, markup=False)
    if summary.salvage_losses:
        console.print("[yellow]the file is damaged[/]; every intact chunk was used")
    if summary.stopped is not None:
        reason = str(summary.stopped) if isinstance(summary.stopped, ReplayError) else f"{summary.stopped} arrived"
        console.print(f"[yellow]stopped early[/]: {reason}; what was written is complete up to there")
    for path in written:
        console.print(f"wrote {path}", markup=False, highlight=False)


def _errors_table(figures: dict[str, Any]) -> Table:
    table = Table(title="prediction errors", title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("against", "predictor", "ADE m", "FDE m", "MHD m", "NLL", "scored"):
        table.add_column(column, justify="left" if column in ("against", "predictor") else "right", no_wrap=True)
    rows = [("later tracks", figures)]
    if "ground_truth" in figures:
        rows.append(("ground truth", figures["ground_truth"]))
    for against, part in rows:
        share = part.get("scored_share")
        scored = f"{part.get('scored', 0)} ({share:.0%})" if share is not None else "0"
        table.add_row(against, figures["model"].get("name", "predictor"), *_cells(part), scored)
        table.add_row("", "extrapolated track", *_cells(part.get("tracker", {})), "")
    return table


def _cells(errors: dict[str, Any]) -> list[str]:
    values = [errors.get(name) for name in ("ade_m", "fde_m", "mhd_m", "nll")]
    return ["-" if value is None else f"{value:.3f}" for value in values]
