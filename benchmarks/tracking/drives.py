"""Fusion and tracking on simulated drives: by sensors, beside other trackers, and with each step of it taken out.

    python -m benchmarks.tracking.drives              # the ten reported drives, every variant; writes drives.json
    python -m benchmarks.tracking.drives --sensors    # the three sensor set-ups alone
    python -m benchmarks.tracking.drives --peers      # ours beside SORT and Stone Soup alone
    python -m benchmarks.tracking.drives --tuning     # the drives that settings may be chosen on; writes nothing
    python -m benchmarks.tracking.drives --show       # docs/tracking.md's tables, of the drives.json that is there

A vehicle of a DUT clip records; everybody in the clip walks as annotated. People with fewer than 4 LiDAR points are
neither misses nor, if tracked, false tracks. All in one process on one thread, with the same noise. Two of the ten
drives are held out from all training, too: looks at them go to benchmarks/test_runs.csv.
"""

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress
from scipy.optimize import linear_sum_assignment
from threadpoolctl import threadpool_limits

from benchmarks.tracking.variants import (
    DRIVE_SENSOR,
    FILTER_STEPS,
    FUSION_STEPS,
    LEAST_PROBABILITY,
    PEERS,
    SENSORS,
    VARIANTS,
    PeerVariant,
    Variant,
    arrays,
)
from pcgan.evaluation import append_lines, commit
from replay.inspection import inspect_frames
from replay.score import MIN_LIDAR_POINTS, scored_frame
from replay.session import Replay
from replay.simulator import simulate
from replay.time_sync import SyncedFrame
from replay.training_windows import HELD_OUT_DRIVES
from tracking.metrics import ScoredFrame, TrackingScore, drop_ignored, ospa2, score

RESULTS = Path(__file__).with_name("drives.json")
Drive = tuple[str, int | None]  # clip, and its vehicle that records; None: the one that drives
TUNING_DRIVES: tuple[Drive, ...] = (
    ("dut/intersection_04", 0),
    ("dut/intersection_04", 2),
    ("dut/intersection_07", 1),
    ("dut/intersection_07", 2),
    ("dut/intersection_11", 0),
    ("dut/roundabout_01", 1),
    ("dut/roundabout_05", 0),
    ("dut/roundabout_05", 3),
    ("dut/roundabout_06", 0),
)
REPORT_DRIVES: tuple[Drive, ...] = (
    ("dut/intersection_05", None),
    ("dut/intersection_06", None),
    ("dut/intersection_08", 2),
    ("dut/intersection_09", None),
    ("dut/intersection_10", None),
    ("dut/roundabout_02", None),
    ("dut/roundabout_04", None),
    ("dut/roundabout_07", None),
    ("dut/roundabout_10", None),
    ("dut/roundabout_11", None),
)
NEW_S = 0.3  # two scans confirm a person, if both are hits
MATCH_M = 1.0
BESIDE_M = 1.2  # nearer to somebody than this, a track that is nobody's is a second one
NEAR_M = 25.0  # people whom the LiDAR hardly sees are counted as found or not up to here
OSPA_CUTOFF_M, OSPA2_SCANS = 2.0, 36  # OSPA(2) over 3.6 s, the history that a published track carries


@dataclass(frozen=True)
class Result:
    """One variant on one drive."""

    variant: str
    drive: str
    score: TrackingScore
    people: int  # positions of people with enough LiDAR points
    ospa2_m: float
    hidden_found: float  # share of the others, up to 25 m away, that had a track within 1 m
    tracker_ms: float  # CPU of a scan, without fusion
    stage_ms: float  # and with it


@contextmanager
def recorded(drive: Drive, seed: int) -> Iterator[Replay]:
    """Simulates a drive and yields its replay; the recording is gone afterwards."""
    clip, vehicle = drive
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "drive.mcap"
        simulate(log, clip=clip, vehicle=vehicle, pedestrians=0, duration_s=None, seed=seed)
        yield Replay([log])


def remaining_errors(replay: Replay) -> Counter[str]:
    """Counts by cause what keeps a drive from a score of 1: people missed, and tracks that are nobody's, per scan."""
    causes: Counter[str] = Counter()
    first_seen: dict[int, float] = {}
    for inspected in inspect_frames(replay):
        report, truth = inspected.report, inspected.frame.ground_truth
        if truth is None:
            continue
        for person in report.people or ():
            if person.lidar_points < MIN_LIDAR_POINTS:
                continue
            causes["people"] += 1
            since_s = report.at_s - first_seen.setdefault(person.id, report.at_s)
            if person.miss is not None:
                causes["missed: " + ("seen for less than 0.3 s" if since_s < NEW_S else person.miss)] += 1
        tracks = inspected.tracks.tracks
        scored = drop_ignored(scored_frame(*arrays(tracks), truth))
        paired = scored.distances() < MATCH_M
        rows, columns = linear_sum_assignment(paired, maximize=True)
        nobodys = np.setdiff1d(np.arange(len(scored.track_ids)), columns[paired[rows, columns]])
        labels = inspected.labels
        measured = dict(zip(labels.ids.tolist(), labels.measurement.tolist(), strict=True))
        apart = np.linalg.norm(scored.tracks_m[:, None] - truth.positions_m, axis=-1).min(axis=1, initial=np.inf)
        for track in nobodys:
            coasting = measured[int(scored.track_ids[track])] < 0
            where = "beside somebody" if apart[track] < BESIDE_M else "where nobody is"
            causes[f"false: {'not measured now' if coasting else 'measured'}, {where}"] += 1
    return causes


def run(frames: Sequence[SyncedFrame], drive: str, variant: Variant | PeerVariant) -> Result:
    """Tracks a drive and scores the tracks."""
    steps = list(variant.track(frames))
    scored: list[ScoredFrame] = []
    hidden = found = 0
    for step in steps:
        truth = step.frame.ground_truth
        if truth is None:
            continue
        scored.append(scored_frame(step.ids, step.positions_m, truth))
        near = np.hypot(*(truth.positions_m - step.frame.sensors.map_from_lidar[:2, 3]).T) < NEAR_M
        unseen = scored[-1].ignored & near
        hidden += int(unseen.sum())
        found += int((unseen & (scored[-1].distances().min(axis=1, initial=np.inf) < MATCH_M)).sum())
    fusion_ms = 1e3 * float(np.mean([step.fusion_s for step in steps]))
    tracker_ms = 1e3 * float(np.mean([step.tracker_s for step in steps]))
    return Result(
        variant.name,
        drive,
        score(scored, OSPA_CUTOFF_M, MATCH_M),
        people=sum(int((~frame.ignored).sum()) for frame in scored),
        ospa2_m=ospa2(scored, OSPA_CUTOFF_M, window_scans=OSPA2_SCANS),
        hidden_found=found / max(1, hidden),
        tracker_ms=tracker_ms,
        stage_ms=fusion_ms + tracker_ms,
    )


def name_of(drive: Drive) -> str:
    """Returns how a drive is called in tables."""
    clip, vehicle = drive
    return clip if vehicle is None else f"{clip}:{vehicle}"


def evaluate(
    drives: Sequence[Drive], variants: Sequence[Variant | PeerVariant], seed: int
) -> tuple[list[Result], dict[str, Counter[str]]]:
    """Returns every variant's result on every drive, and each drive's remaining errors with nothing changed."""
    found: list[Result] = []
    errors: dict[str, Counter[str]] = {}
    with threadpool_limits(1), Progress() as progress:
        task = progress.add_task("", total=len(drives) * (len(variants) + 1))
        for drive in drives:
            name = name_of(drive)
            progress.update(task, description=name)
            with recorded(drive, seed) as replay:
                frames = list(replay.frames())
                errors[name] = remaining_errors(replay)
            progress.advance(task)
            for variant in variants:
                found.append(run(frames, name, variant))
                progress.advance(task)
    return found, errors


# --- what comes out ---------------------------------------------------------------------------------------------------

COLUMNS = {  # digits shown
    "OSPA m": 3, "OSPA(2) m": 3, "GOSPA m": 2, "HOTA": 3, "DetA": 3, "AssA": 3, "MOTA": 3, "IDF1": 3, "switches": 1,
    "missed %": 1, "false %": 1, "error m": 3, "hidden found %": 0, "tracker ms": 2, "stage ms": 2,
}  # fmt: skip
Figures = Mapping[str, Any]  # variant, drive, people, and COLUMNS


def figures(result: Result) -> Figures:
    """Returns what is written of a result."""
    s, people = result.score, result.people
    values = (
        s.ospa_m, result.ospa2_m, s.gospa_m, s.hota, s.det_a, s.ass_a, s.mota, s.idf1, s.id_switches,
        100 * s.missed / people, 100 * s.false / people, s.localisation_m,
        100 * result.hidden_found, result.tracker_ms, result.stage_ms,
    )  # fmt: skip
    columns = dict(zip(COLUMNS, (round(value, 5) for value in values), strict=True))
    return {"variant": result.variant, "drive": result.drive, "people": people, **columns}


def markdown(heading: str, names: Sequence[str], rows: Sequence[Figures]) -> str:
    """Returns a table of means over drives, one line per variant named."""
    lines = [f"| {heading} | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for name in names:
        those = [row for row in rows if row["variant"] == name]
        cells = [f"{np.mean([row[column] for row in those]):.{digits}f}" for column, digits in COLUMNS.items()]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def drive_table(rows: Sequence[Figures]) -> str:
    """Returns a table of HOTA, MOTA and switches, one line per drive and one column per sensor set-up."""
    found = {(row["drive"], row["variant"]): row for row in rows}
    names = [variant.name for variant in SENSORS if any(row["variant"] == variant.name for row in rows)]
    lines = ["| HOTA / MOTA / switches | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for drive in dict.fromkeys(row["drive"] for row in rows):
        those = [found[drive, name] for name in names]
        cells = [f"{row['HOTA']:.3f} / {row['MOTA']:.3f} / {row['switches']:.0f}" for row in those]
        lines.append(f"| {drive} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def error_table(errors: Iterable[Mapping[str, int]]) -> str:
    """Returns a table of causes, in percent of the positions of people with enough LiDAR points."""
    total: Counter[str] = Counter()
    for causes in errors:
        total.update(causes)
    people = total.pop("people")
    lines = ["| what is wrong | % of people's positions |", "|---|---|"]
    lines += [f"| {cause} | {100 * count / people:.2f} |" for cause, count in total.most_common()]
    return "\n".join(lines)


def tables(rows: Sequence[Figures], errors: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Returns tables of what was run: sensors and peers, steps of fusion and of the filter, drives, errors."""
    groups = {
        "sensors and trackers": (*SENSORS, *PEERS),
        "changed in fusion": (SENSORS[0], *FUSION_STEPS),
        "changed in the filter": (SENSORS[0], *FILTER_STEPS),
    }
    there = {row["variant"] for row in rows}
    named = {heading: [v.name for v in variants if v.name in there] for heading, variants in groups.items()}
    compared = [markdown(heading, names, rows) for heading, names in named.items() if len(names) > 1]
    return [*compared, drive_table(rows), error_table(errors.values())]


def as_json(rows: Sequence[Figures], errors: Mapping[str, Mapping[str, int]], seed: int) -> dict[str, Any]:
    """Returns everything needed to repeat and to read the results."""
    return {
        "seed": seed,
        "results": rows,
        "errors": errors,
        "peers": {
            "sensor": asdict(DRIVE_SENSOR),
            "least_probability": LEAST_PROBABILITY,
            "parameters": {peer.name: asdict(peer.params) for peer in PEERS},
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tuning", action="store_true", help="the drives that settings may be chosen on")
    parser.add_argument("--sensors", action="store_true", help="the three sensor set-ups only")
    parser.add_argument("--peers", action="store_true", help="all sensors, ours and the other trackers only")
    parser.add_argument("--show", action="store_true", help="run nothing: the tables of drives.json")
    parser.add_argument("--seed", type=int, default=0, help="of the sensors' noise")
    parser.add_argument("--note", default="", help="why the held-out drives were looked at")
    arguments = parser.parse_args()
    if arguments.show:
        written = json.loads(RESULTS.read_text())
        print("\n\n".join(tables(written["results"], written["errors"])))
        return
    drives = TUNING_DRIVES if arguments.tuning else REPORT_DRIVES
    variants: Sequence[Variant | PeerVariant] = VARIANTS
    if arguments.sensors or arguments.peers:
        variants = (*(SENSORS if arguments.sensors else SENSORS[:1]), *(PEERS if arguments.peers else ()))
    found, errors = evaluate(drives, variants, arguments.seed)
    rows = [figures(result) for result in found]
    print("\n\n".join(tables(rows, errors)))
    if arguments.tuning:
        return
    held_out = {name_of(drive) for drive in HELD_OUT_DRIVES}
    append_lines([
        {
            "commit": commit(), "model": f"tracker, {r.variant}", "drive": r.drive, "seed": arguments.seed,
            "hota": round(r.score.hota, 4), "mota": round(r.score.mota, 4), "idf1": round(r.score.idf1, 4),
            "gospa_m": round(r.score.gospa_m, 4), "id_switches": r.score.id_switches, "note": arguments.note,
        }
        for r in found if r.drive in held_out and r.variant in {v.name for v in SENSORS}
    ])  # fmt: skip
    if variants is VARIANTS:
        RESULTS.write_text(json.dumps(as_json(rows, errors, arguments.seed), indent=1) + "\n")


if __name__ == "__main__":
    main()
