"""Our tracker beside Stone Soup's GM-PHD filter and SORT on filterpy: the same scenes, one process, one thread.

    python -m benchmarks.tracking.compare            # about 15 minutes; writes results.json and docs/images/
    python -m benchmarks.tracking.compare --quick    # about a minute; writes nothing
    python -m benchmarks.tracking.compare --tuning   # on the tuning seeds; writes nothing
    python -m benchmarks.tracking.compare --show     # docs/tracking.md's table, of the results that are there

Stone Soup gets fewer scans and, in large crowds, one seed: it would take hours. CPU time is that of `step` alone; its
ratios are over the same scans: those that Stone Soup gets, where one of the two is Stone Soup.
"""

import argparse
import json
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.progress import Progress
from threadpoolctl import threadpool_limits

from benchmarks.tracking import peers
from benchmarks.tracking.peers import Ours, Peer, Sort, StoneSoupPhd
from benchmarks.tracking.scenarios import (
    CROWD,
    DENSE_CLUTTER,
    REPORT_SEEDS,
    TUNING_SEEDS,
    VO_MA,
    Scan,
    Sensor,
    crowd,
    vo_ma,
)
from tracking.metrics import ScoredFrame, gospa, ospa2, score

RESULTS = Path(__file__).with_name("results.json")
PLOT = Path(__file__).parents[2] / "docs" / "images" / "tracking_cost.png"
OURS, SORT, STONE_SOUP, STONE_SOUP_TREES = "ours", "SORT", "Stone Soup", "Stone Soup, k-d trees"
AS_PUBLISHED = ", process noise as published"
PEOPLE = (10, 30, 100, 200)
VO_MA_SCANS = 100  # as in the paper
CROWD_SEEDS = 4
LARGE_CROWD = 100  # from here on Stone Soup gets one seed
SETTLING_SCANS = 10  # of a crowd, which starts with everybody there: neither scored nor timed


@dataclass(frozen=True)
class Case:
    """A scenario, with how its scans are made (of how many and a seed) and its trackers by name."""

    name: str
    sensor: Sensor
    people: int
    make: Callable[[int, int], list[Scan]]
    trackers: dict[str, Callable[[], Peer]]
    settling: int
    window_scans: int  # of OSPA(2)


class Scans(NamedTuple):
    """Which scans of a scenario a tracker gets."""

    seeds: tuple[int, ...]
    per_seed: int


@dataclass(frozen=True)
class Outcome:
    """A tracker's scores on a scenario, means over seeds. Names as in `tracking.metrics`."""

    scenario: str
    people: int
    clutter: float
    tracker: str
    seeds: tuple[int, ...]
    scans: int
    ospa_m: float
    ospa2_m: float
    gospa_m: float
    gospa_missed_m: float
    gospa_false_m: float
    hota: float
    idf1: float
    id_switches: float
    mota: float
    cpu_ms: float  # per step
    cpu_ms_on_stone_soups_scans: float


def cases(people: Sequence[int] = PEOPLE) -> Iterator[Case]:
    """Yields every scenario."""
    as_published: dict[str, Callable[[], Peer]] = {
        OURS: lambda: Ours(VO_MA, peers.OURS_VO_MA),
        SORT: lambda: Sort(VO_MA, peers.SORT_VO_MA),
        STONE_SOUP: lambda: StoneSoupPhd(VO_MA, peers.STONE_SOUP_VO_MA),
    }
    tuned: dict[str, Callable[[], Peer]] = {
        OURS: lambda: Ours(VO_MA, peers.OURS_VO_MA_TUNED),
        SORT: lambda: Sort(VO_MA, peers.SORT_VO_MA_TUNED),
        STONE_SOUP: lambda: StoneSoupPhd(VO_MA, peers.STONE_SOUP_VO_MA_TUNED),
    }
    for noise, vo_ma_trackers in (("", tuned), (AS_PUBLISHED, as_published)):
        for name, spawning in (("Vo & Ma", False), ("Vo & Ma, spawning", True)):
            yield Case(
                name + noise, VO_MA, 2 + spawning,
                lambda scans, seed, spawning=spawning: vo_ma(scans, seed, spawning=spawning),
                vo_ma_trackers, 0, 10,
            )  # fmt: skip
    for sensor in (CROWD, DENSE_CLUTTER):
        trackers: dict[str, Callable[[], Peer]] = {
            OURS: partial(Ours, sensor, peers.OURS_CROWD),
            SORT: partial(Sort, sensor, peers.SORT_CROWD),
            STONE_SOUP: partial(StoneSoupPhd, sensor, peers.STONE_SOUP_CROWD),
            STONE_SOUP_TREES: partial(StoneSoupPhd, sensor, peers.STONE_SOUP_CROWD_TREES),
        }
        for N in people:
            # OSPA(2) over 3.6 s, the history that a published track carries.
            make = partial(crowd, N, sensor=sensor)
            yield Case("crowd", sensor, N, make, trackers, settling=SETTLING_SCANS, window_scans=36)


def run(peer: Peer, scans: Sequence[Scan], settling: int) -> tuple[list[ScoredFrame], float]:
    """Returns where people and tracks were after the settling scans, and the CPU milliseconds of a step there."""
    for scan in scans[:settling]:
        peer.step(scan.measured_m, scan.stamp_ns)
    rest = scans[settling:]
    start = time.process_time()
    answers = [peer.step(scan.measured_m, scan.stamp_ns) for scan in rest]
    cpu_ms = 1e3 * (time.process_time() - start) / max(1, len(rest))
    return [ScoredFrame(scan.ids, scan.truth_m, *answer) for scan, answer in zip(rest, answers, strict=True)], cpu_ms


def scores(frames: Sequence[ScoredFrame], cutoff_m: float, window_scans: int) -> dict[str, float]:
    """Returns the scores of one run by the names of `Outcome`.

    HOTA's similarity ends at the cutoff; the gate of IDF1 and MOTA is half of it.
    """
    scale = cutoff_m / 2  # `score` is made for people: similarity ends at 2 m
    small = [
        ScoredFrame(frame.truth_ids, frame.truth_m / scale, frame.track_ids, frame.tracks_m / scale) for frame in frames
    ]
    result = score(small)
    parts = [gospa(frame.truth_m, frame.tracks_m, cutoff_m) for frame in frames]
    return {
        "ospa_m": result.ospa_m * scale,
        "ospa2_m": ospa2(frames, cutoff_m, window_scans=window_scans),
        "gospa_m": float(np.mean([part.total for part in parts])),
        "gospa_missed_m": float(np.mean([part.missed for part in parts])),
        "gospa_false_m": float(np.mean([part.false for part in parts])),
        "hota": result.hota,
        "idf1": result.idf1,
        "id_switches": float(result.id_switches),
        "mota": result.mota,
    }


def evaluate(case: Case, tracker: str, scans: Scans, stone_soups: Scans) -> Outcome:
    """Runs one tracker on one scenario, with every seed; and again on Stone Soup's scans, only to time it there."""
    rows = []
    for seed in scans.seeds:
        frames, cpu_ms = run(case.trackers[tracker](), case.make(scans.per_seed, seed), case.settling)
        rows.append({**scores(frames, case.sensor.cutoff_m, case.window_scans), "cpu_ms": cpu_ms})
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    again_ms = means["cpu_ms"] if scans == stone_soups else _time(case, tracker, stone_soups)
    return Outcome(
        case.name, case.people, case.sensor.clutter, tracker, scans.seeds, scans.per_seed, **means,
        cpu_ms_on_stone_soups_scans=again_ms,
    )  # fmt: skip


def _time(case: Case, tracker: str, scans: Scans) -> float:
    """Returns the CPU milliseconds of a step: the median of five runs, since few scans are soon over."""
    runs = [
        np.mean(
            [run(case.trackers[tracker](), case.make(scans.per_seed, seed), case.settling)[1] for seed in scans.seeds]
        )
        for _ in range(5)
    ]
    return float(np.median(runs))


# --- what comes out ---------------------------------------------------------------------------------------------------

HEADINGS = (
    "scenario", "tracker", "scans x seeds", "OSPA m", "OSPA(2) m", "GOSPA m (missed, false)", "HOTA", "IDF1", "MOTA",
    "id switches", "CPU ms", "times SORT's", "times Stone Soup's",
)  # fmt: skip
SHORT_HEADINGS = tuple(name for name in HEADINGS if name not in ("scans x seeds", "GOSPA m (missed, false)", "MOTA"))


def markdown(outcomes: Sequence[Outcome], headings: Sequence[str] = HEADINGS) -> str:
    """Returns the table; ratios are CPU time over that of the same scenario's SORT and Stone Soup, without trees."""
    found = {(o.scenario, o.people, o.clutter, o.tracker): o for o in outcomes}
    lines = ["| " + " | ".join(headings) + " |", "|---" * len(headings) + "|"]
    for o in outcomes:
        sort, soup = (
            f"{cost(o, found[key]):.3g}" if (key := (o.scenario, o.people, o.clutter, other)) in found else "-"
            for other in (SORT, STONE_SOUP)
        )
        name = f"{o.people} people, {o.clutter:g} clutter" if o.scenario == "crowd" else o.scenario
        values = (
            name, o.tracker, f"{o.scans} x {len(o.seeds)}", f"{o.ospa_m:.3g}", f"{o.ospa2_m:.3g}",
            f"{o.gospa_m:.3g} ({o.gospa_missed_m:.2g}, {o.gospa_false_m:.2g})", f"{o.hota:.3f}", f"{o.idf1:.3f}",
            f"{o.mota:.3f}", f"{o.id_switches:.1f}", f"{o.cpu_ms:.3g}", sort, soup,
        )  # fmt: skip
        cells = dict(zip(HEADINGS, values, strict=True))
        lines.append("| " + " | ".join(cells[heading] for heading in headings) + " |")
    return "\n".join(lines)


def read_results(path: Path = RESULTS) -> list[Outcome]:
    """Returns the outcomes of an earlier run."""
    rows = json.loads(path.read_text())["outcomes"]
    return [Outcome(**{**row, "seeds": tuple(row["seeds"])}) for row in rows]


def targets(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Returns what our tracker has to reach, with what it did; scenarios that were not run are left out."""
    found = {(o.scenario, o.people, o.clutter, o.tracker): o for o in outcomes}
    spawning, hundred = ("Vo & Ma, spawning", 3, VO_MA.clutter), ("crowd", 100, CROWD.clutter)
    as_published = ("Vo & Ma, spawning" + AS_PUBLISHED, 3, VO_MA.clutter)
    dense = ("crowd", 200, DENSE_CLUTTER.clutter)
    wanted: list[tuple[str, tuple[str, int, float], str, Callable[[Outcome, Outcome], float], float]] = [
        ("Vo & Ma with spawning: OSPA in m", spawning, OURS, lambda ours, _: ours.ospa_m, 12.4),
        (f"Vo & Ma with spawning{AS_PUBLISHED}: OSPA in m", as_published, OURS, lambda ours, _: ours.ospa_m, 12.4),
        ("100 people: OSPA in m", hundred, OURS, lambda ours, _: ours.ospa_m, 0.16),
        ("100 people: 1 - HOTA", hundred, OURS, lambda ours, _: 1 - ours.hota, 0.1),
        ("100 people: CPU, times Stone Soup's", hundred, STONE_SOUP, cost, 1 / 300),
        ("100 people: CPU, times SORT's", hundred, SORT, cost, 1.0),
        ("200 people, 20 clutter: CPU, times SORT's", dense, SORT, cost, 2.0),
    ]
    rows = []
    for text, case, other, value, limit in wanted:
        if (*case, OURS) in found and (*case, other) in found:
            reached = value(found[*case, OURS], found[*case, other])
            rows.append({"target": text, "limit": limit, "reached": reached, "met": reached <= limit})
    return rows


def cost(one: Outcome, other: Outcome) -> float:
    """Returns the ratio of their CPU times over the same scans: Stone Soup's, unless both had the same anyway."""
    if (one.scans, one.seeds) == (other.scans, other.seeds):
        return one.cpu_ms / other.cpu_ms
    return one.cpu_ms_on_stone_soups_scans / other.cpu_ms_on_stone_soups_scans


def as_json(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Returns everything needed to repeat and to read the results."""
    return {
        "outcomes": [asdict(outcome) for outcome in outcomes],
        "targets": targets(outcomes),
        "sensors": {name: asdict(sensor) for name, sensor in (("crowd", CROWD), ("Vo & Ma", VO_MA))},
        "parameters": {
            "crowd": {
                OURS: peers.OURS_CROWD.model_dump(),
                SORT: asdict(peers.SORT_CROWD),
                STONE_SOUP: asdict(peers.STONE_SOUP_CROWD),
                STONE_SOUP_TREES: asdict(peers.STONE_SOUP_CROWD_TREES),
            },
            "Vo & Ma": {
                OURS: peers.OURS_VO_MA_TUNED.model_dump(),
                SORT: asdict(peers.SORT_VO_MA_TUNED),
                STONE_SOUP: asdict(peers.STONE_SOUP_VO_MA_TUNED),
            },
            f"Vo & Ma{AS_PUBLISHED}": {
                OURS: peers.OURS_VO_MA.model_dump(),
                SORT: asdict(peers.SORT_VO_MA),
                STONE_SOUP: asdict(peers.STONE_SOUP_VO_MA),
            },
        },
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("numpy", "scipy", "stonesoup", "filterpy")},
        },
    }


def draw_cost(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draws CPU time against the number of people, with 5 clutter points a scan."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for tracker, colour in (
        (STONE_SOUP, "#9aa0a6"),
        (STONE_SOUP_TREES, "#5f6368"),
        (SORT, "#e8912d"),
        (OURS, "#1f6feb"),
    ):
        those = [o for o in outcomes if o.tracker == tracker and o.scenario == "crowd" and o.clutter == CROWD.clutter]
        if not those:
            continue
        N, cpu_ms = [o.people for o in those], [o.cpu_ms for o in those]
        axes.loglog(N, cpu_ms, "o-", color=colour, markersize=4, linewidth=2)
        axes.annotate(tracker, (N[-1], cpu_ms[-1]), (6, 0), textcoords="offset points", va="center", color=colour)
    axes.axhline(100, color="#d0d0d0", linewidth=1, zorder=0)
    axes.annotate("10 Hz", (PEOPLE[0], 100), (0, 3), textcoords="offset points", color="#8a8a8a", fontsize=8)
    axes.set(xlabel="people", ylabel="CPU ms per scan, one thread", xlim=(PEOPLE[0] * 0.9, PEOPLE[-1] * 4))
    axes.set_xticks(PEOPLE, [str(N) for N in PEOPLE])
    axes.minorticks_off()
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150)


def scans_of(case: Case, seeds: Sequence[int], scans: int, stone_soup_scans: int) -> tuple[Scans, Scans]:
    """Returns which scans of a scenario the trackers get, and which Stone Soup gets."""
    if case.name != "crowd":
        every = Scans(tuple(seeds), VO_MA_SCANS)
        return every, every
    given = tuple(seeds[:CROWD_SEEDS])
    return Scans(given, scans), Scans(given[:1] if case.people >= LARGE_CROWD else given, stone_soup_scans)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, nargs="+", default=list(PEOPLE), help="sizes of the crowds")
    parser.add_argument("--scans", type=int, default=300, help="of a crowd")
    parser.add_argument("--stone-soup-scans", type=int, default=40, help="of a crowd, for Stone Soup")
    parser.add_argument(
        "--trackers", nargs="+", choices=[OURS, SORT, STONE_SOUP, STONE_SOUP_TREES], help="these only; writes nothing"
    )
    parser.add_argument("--tuning", action="store_true", help="the tuning seeds")
    parser.add_argument("--quick", action="store_true", help="small crowds, few scans, one tuning seed")
    parser.add_argument("--show", action="store_true", help="run nothing: the short table of results.json")
    arguments = parser.parse_args()
    if arguments.show:
        print(markdown(read_results(), SHORT_HEADINGS))
        return
    seeds = TUNING_SEEDS if arguments.tuning else REPORT_SEEDS
    people, scans, soup_scans = arguments.people, arguments.scans, arguments.stone_soup_scans
    if arguments.quick:
        people, scans, soup_scans, seeds = [N for N in people if N <= 30], 60, 20, TUNING_SEEDS[:1]
    outcomes = []
    plan = [(case, tracker) for case in cases(people) for tracker in arguments.trackers or case.trackers
            if tracker in case.trackers]  # fmt: skip
    with threadpool_limits(1), Progress() as progress:
        task = progress.add_task("", total=len(plan))
        for case, tracker in plan:
            progress.update(task, description=f"{case.name}, {case.people} people, {tracker}")
            given, stone_soups = scans_of(case, seeds, scans, soup_scans)
            outcomes.append(
                evaluate(case, tracker, stone_soups if tracker.startswith(STONE_SOUP) else given, stone_soups)
            )
            progress.advance(task)
    print(markdown(outcomes))
    for row in targets(outcomes):
        print(
            f"{'met   ' if row['met'] else 'MISSED'} {row['target']}: {row['reached']:.3g}, at most {row['limit']:.3g}"
        )
    if not (arguments.quick or arguments.tuning or arguments.trackers):
        RESULTS.write_text(json.dumps(as_json(outcomes), indent=1) + "\n")
        draw_cost(outcomes, PLOT)


if __name__ == "__main__":
    main()
