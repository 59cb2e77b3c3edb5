"""Tracks from raw points beside tracks from the simulator's own clusters, of the same drives, LiDAR only; and the time.

    python -m benchmarks.segmentation              # two crowds, and eight of the reported drives of DUT's clips
    python -m benchmarks.segmentation --tuning     # the drives that settings were chosen on
    python -m benchmarks.segmentation --held-out --note "why"    # the two that nothing was; into test_runs.csv

The points are cast into the scenes that the clusters are drawn from, with as much clutter. What the simulated clusters
miss and merge is a frozen model of a good clustering stage; the points are segmented by `tracking.segmentation`.
Cameras are left out. Times are CPU milliseconds of `segment` on one thread: the mean over a drive's scans, and for one
scan made as large as 25 000 points.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from benchmarks.tracking.drives import REPORT_DRIVES, Drive, Result, name_of, run
from benchmarks.tracking.variants import Variant
from pcgan.evaluation import append_lines, commit
from replay import foxglove
from replay.session import Replay
from replay.simulator import simulate
from replay.simulator.sensor_suite import POINTS_TOPIC
from replay.time_sync import SyncedFrame
from replay.training_windows import HELD_OUT_DRIVES
from schemas.messages import LidarClusters, PointCloud
from tracking.segmentation import SegmentationParams, segment
from tracking.sensor_frame import SensorFrame

FULL_SCAN_POINTS = 25_000
REPEATS = 20


@dataclass(frozen=True)
class Crowd:
    """A simulated crowd to drive through."""

    pedestrians: int
    duration_s: float
    seed: int


HELD_OUT: tuple[Drive, ...] = tuple(drive for drive in REPORT_DRIVES if drive[0] in dict(HELD_OUT_DRIVES))
REPORTED: tuple[Crowd | Drive, ...] = (
    Crowd(20, 60.0, 1),
    Crowd(40, 60.0, 2),
    *(drive for drive in REPORT_DRIVES if drive not in HELD_OUT),
)
TUNING: tuple[Crowd | Drive, ...] = (
    Crowd(20, 25.0, 11),
    Crowd(40, 15.0, 12),
    ("dut/intersection_04", 0),
    ("dut/intersection_07", 1),
    ("dut/roundabout_05", 0),
)


@dataclass(frozen=True)
class Row:
    """What one drive gave."""

    drive: str
    points_per_scan: float
    segment_ms: float
    from_clusters: Result
    from_points: Result


def title(drive: Crowd | Drive) -> str:
    """Returns how a drive is called in tables."""
    return f"crowd of {drive.pedestrians}" if isinstance(drive, Crowd) else name_of(drive)


@contextmanager
def recorded(drive: Crowd | Drive) -> Iterator[Path]:
    """Simulates a drive with points and yields the log, which is gone afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "drive.mcap"
        if isinstance(drive, Crowd):
            simulate(
                log,
                clip=None,
                vehicle=None,
                pedestrians=drive.pedestrians,
                duration_s=drive.duration_s,
                seed=drive.seed,
                points=True,
            )
        else:
            clip, vehicle = drive
            simulate(log, clip=clip, vehicle=vehicle, pedestrians=0, duration_s=None, seed=0, points=True)
        yield log


def clouds(log: Path) -> list[PointCloud]:
    """Returns the points of all scans of a log."""
    with log.open("rb") as stream:
        messages = make_reader(stream).iter_messages(topics=[POINTS_TOPIC])
        return [foxglove.decode("foxglove.PointCloud", message.data) for _, _, message in messages]


def cpu_ms(work: Callable[[], object]) -> float:
    """Returns the CPU milliseconds that a piece of work takes."""
    start = time.process_time()
    work()
    return 1e3 * (time.process_time() - start)


def full_scan(scans: Sequence[PointCloud]) -> PointCloud:
    """Returns the largest scan with as many points of its successors added as make 25 000 of it.

    Successors are seen with other columns and from a little farther on: denser ground, and things a little wider.
    """
    largest = max(range(len(scans)), key=lambda k: len(scans[k].points_m))
    points = np.concatenate([scan.points_m for scan in scans[largest : largest + 4]])
    return replace(scans[largest], points_m=points[:FULL_SCAN_POINTS])


def compare(drive: Crowd | Drive, params: SegmentationParams) -> tuple[Row, PointCloud]:
    """Returns a drive's figures, and a scan of 25 000 points of it."""
    with recorded(drive) as log:
        frames: list[SyncedFrame] = list(Replay([log]).frames())
        scans = clouds(log)
    segmented: dict[int, LidarClusters] = {}
    spent_ms = cpu_ms(lambda: segmented.update({scan.stamp_ns: segment(scan, params) for scan in scans}))
    variants = (
        Variant("simulated clusters", frame=_without_cameras),
        Variant("segmented points", frame=lambda frame: _with_clusters(frame, segmented)),
    )
    from_clusters, from_points = (run(frames, title(drive), variant) for variant in variants)
    points_per_scan = float(np.mean([len(scan.points_m) for scan in scans]))
    return Row(title(drive), points_per_scan, spent_ms / len(scans), from_clusters, from_points), full_scan(scans)


def _without_cameras(frame: SensorFrame) -> SensorFrame:
    return replace(frame, cameras=())


def _with_clusters(frame: SensorFrame, of_stamp: Mapping[int, LidarClusters]) -> SensorFrame:
    return replace(frame, cameras=(), clusters=of_stamp[frame.clusters.stamp_ns])


def table(rows: Sequence[Row]) -> Table:
    """Returns the rows and their means as a table; each cell has the clusters' figure, then the points'."""
    shown = Table("drive", "points", "segment ms", "HOTA", "MOTA", "missed %", "false %", "switches", "error m")
    for row in rows:
        shown.add_row(row.drive, f"{row.points_per_scan:.0f}", f"{row.segment_ms:.1f}", *_cells([row]))
    points, spent_ms = (np.mean([getattr(row, name) for row in rows]) for name in ("points_per_scan", "segment_ms"))
    shown.add_row("mean", f"{points:.0f}", f"{spent_ms:.1f}", *_cells(rows))
    return shown


def _cells(rows: Sequence[Row]) -> list[str]:
    pairs = zip(
        *(_figures([row.from_clusters for row in rows]), _figures([row.from_points for row in rows])), strict=True
    )
    digits = (3, 3, 1, 1, 0, 3)
    return [f"{a:.{n}f} / {b:.{n}f}" for (a, b), n in zip(pairs, digits, strict=True)]


def _figures(results: Sequence[Result]) -> list[float]:
    """Returns mean HOTA, MOTA, percent missed, percent false, switches and error in m."""
    each = [
        (
            r.score.hota,
            r.score.mota,
            100 * r.score.missed / r.people,
            100 * r.score.false / r.people,
            r.score.id_switches,
            r.score.localisation_m,
        )
        for r in results
    ]
    return np.mean(each, axis=0).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--tuning", action="store_true", help="the drives that settings were chosen on")
    which.add_argument("--held-out", action="store_true", help="the drives that nothing was chosen on")
    parser.add_argument("--note", default="", help="why the held-out drives were looked at")
    arguments = parser.parse_args()
    if arguments.held_out and not arguments.note:
        parser.error("held-out drives are looked at for a reason: say it with --note")
    drives = TUNING if arguments.tuning else HELD_OUT if arguments.held_out else REPORTED
    params, rows = SegmentationParams(), []
    with threadpool_limits(1):
        for drive in drives:
            row, full = compare(drive, params)
            rows.append(row)
        full_ms = [cpu_ms(lambda: segment(full, params)) for _ in range(REPEATS)]
    Console(width=160).print(table(rows))
    print("each cell: simulated clusters / segmented points; both LiDAR only")
    print(f"segment, {len(full.points_m)} points: {np.median(full_ms):.1f} ms CPU, {max(full_ms):.1f} ms at most")
    if arguments.held_out:
        append_lines([line(row.from_points, arguments.note) for row in rows])


def line(result: Result, note: str) -> dict[str, object]:
    """Returns a look at a held-out drive, for the record."""
    return {
        "commit": commit(), "model": "tracker, LiDAR only, from points", "drive": result.drive, "seed": 0,
        "hota": round(result.score.hota, 4), "mota": round(result.score.mota, 4), "idf1": round(result.score.idf1, 4),
        "gospa_m": round(result.score.gospa_m, 4), "id_switches": result.score.id_switches, "note": note,
    }  # fmt: skip


if __name__ == "__main__":
    main()
