"""Does who is said to enter the vehicle's corridor do so, as often and as soon as predicted?

python -m benchmarks.corridor_calibration [--model NAME|FILE] [--json FILE]

Drives are simulated along the vehicles of DUT's validation clips, which the shipped weights have not learnt from, and
through made-up crowds. Every half second everybody tracked within 10 m of the vehicle's path, and not in its corridor
already, is asked for: does the person that the track stands for enter the corridor within the horizon? The corridor is
that of the present motion carried on, or of the path that the vehicle did drive, as a planner would know it.

Beside it, what one would use instead: the tracker's state carried straight on, as one trajectory that enters or does
not, and spread by the tracker's covariance, which is the predictor's own fallback.
"""

import argparse
import itertools
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from pcgan.checkpoint import find_model
from pcgan.corridor import Corridor, Futures, corridor_of, entries
from pcgan.dataset import VALIDATION_CLIPS
from pcgan.extrapolation import extrapolate
from pcgan.predictor import Predictor
from pcgan.vehicle_path import drive_on, motion_at
from replay import FrameResult, PredictorChoice, Replay
from replay.simulator import simulate
from schemas.messages import FloatArray, IntArray, VehiclePath

CROWDS = (1, 2)  # seeds
CROWD_S, CROWD_PEOPLE = 60.0, 40
EVERY_S = 0.5
NEAR_M = 10.0  # of the vehicle's path
SAME_M = 0.5  # between a track and its person
FINE_S = 0.1  # between positions of the truth
EDGES = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
OURS, STRAIGHT, SPREAD = "predictor", "straight on", "straight on, spread"
CARRIED_ON, DRIVEN = "present motion carried on", "path as driven later"


@dataclass(frozen=True, eq=False)
class Asked:
    """N questions: what was predicted, and what came."""

    probability: dict[str, FloatArray]  # method -> (N,)
    time_s: dict[str, FloatArray]  # method -> (N,)  NaN where the probability is 0
    entered_s: FloatArray  # (N,)  NaN for who did not enter


def drives(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yields the simulated drives, one after another."""
    for clip in VALIDATION_CLIPS:
        log = folder / f"{clip.replace('/', '_')}.mcap"
        simulate(log, clip=clip, vehicle=None, pedestrians=0, duration_s=None, seed=0)
        yield clip, log
    for seed in CROWDS:
        log = folder / f"crowd_{seed}.mcap"
        simulate(log, clip=None, vehicle=None, pedestrians=CROWD_PEOPLE, duration_s=CROWD_S, seed=seed)
        yield f"crowd {seed}", log


def questions(results: list[FrameResult], predictor: Predictor, corridor: str) -> Iterator[Asked]:
    """Yields what is asked of each frame of a drive, twice a second."""
    steps, horizon_s = predictor.config.predicted_steps, predictor.config.predicted_steps * predictor.dt_s
    stamps = np.array([result.tracks.stamp_ns for result in results])
    poses = np.array([result.tracks.vehicle_history.states[-1, :3] for result in results])
    where = _truth(results)
    next_ns = stamps[0]
    for result in results:
        tracks = result.tracks
        after_s = (stamps - tracks.stamp_ns) * 1e-9
        if tracks.stamp_ns < next_ns or after_s[-1] < horizon_s or not tracks.tracks:
            continue
        next_ns = tracks.stamp_ns + round(EVERY_S * 1e9)
        motion = motion_at(tracks.vehicle_history, tracks.stamp_ns)
        if motion is None:
            continue
        path = drive_on(motion, predictor.dt_s * np.arange(steps + 1))
        if corridor == DRIVEN:
            later = after_s >= 0
            path = VehiclePath(after_s[later], poses[later], path.front_m, path.rear_m, path.width_m)
        fine_s = FINE_S * np.arange(round(horizon_s / FINE_S) + 1)
        truth = _whom(result, where, tracks.stamp_ns + np.round(fine_s * 1e9).astype(np.int64))  # (A, F, 2)
        known = np.isfinite(truth).all(axis=(1, 2))
        entered, entered_s = entries(corridor_of(path, FINE_S, len(fine_s) - 1), certain(truth[known]))
        near = np.linalg.norm(truth[known, :1] - path.poses[:, :2], axis=-1).min(axis=1) < NEAR_M
        wanted = near & ~(entered_s == 0)
        rows = np.flatnonzero(known)[wanted]
        if len(rows) == 0:
            continue
        answer = predictor.step(replace(tracks, vehicle_path=path)).predictions
        states = np.array([tracks.tracks[row].state for row in rows])
        covariances = np.array([tracks.tracks[row].covariance for row in rows])
        probability, time_s = {}, {}
        probability[OURS] = np.array([answer[row].corridor_probability for row in rows])
        time_s[OURS] = np.array([answer[row].corridor_time_s for row in rows], float)
        swept = corridor_of(path, predictor.dt_s, steps)
        walked = states[:, None, :2] + predictor.dt_s * np.arange(steps + 1)[:, None] * states[:, None, 2:]
        probability[STRAIGHT], time_s[STRAIGHT] = entries(swept, certain(walked))
        probability[SPREAD], time_s[SPREAD] = spread(swept, states, covariances, predictor.dt_s, steps)
        yield Asked(probability, time_s, np.where(entered[wanted] > 0, entered_s[wanted], np.nan))


def certain(walked: FloatArray) -> Futures:
    """Returns futures (A, P + 1, 2) that are known for sure."""
    A, P = len(walked), walked.shape[1] - 1
    ones, none = np.ones((A, P, 1), np.float32), np.zeros((A, P, 1, 2), np.float32)
    paths = walked[:, None, 1:]
    return Futures(
        walked[:, 0], np.zeros((A, 2, 2)), np.ones((A, 1)), paths, ones, paths.swapaxes(1, 2), none, 0 * ones
    )


def spread(
    corridor: Corridor, states: FloatArray, covariances: FloatArray, dt_s: float, steps: int
) -> tuple[FloatArray, FloatArray]:
    """Returns the figures of the tracker's own state and covariance at constant velocity."""
    paths, sigmas, rhos = extrapolate(states, covariances, dt_s, steps)
    A = len(states)
    futures = Futures(
        states[:, :2],
        covariances[:, :2, :2],
        np.ones((A, 1)),
        paths[:, None],
        np.ones((A, steps, 1), np.float32),
        paths[:, :, None],
        sigmas[:, :, None].astype(np.float32),
        rhos[:, :, None].astype(np.float32),
    )
    return entries(corridor, futures)


def _truth(results: list[FrameResult]) -> dict[int, tuple[IntArray, FloatArray]]:
    """Returns where everybody was: id -> stamps (F,) and positions (F, 2)."""
    rows: dict[int, list[tuple[int, FloatArray]]] = {}
    for result in results:
        truth = result.ground_truth
        if truth is not None:
            for id, place in zip(truth.ids.tolist(), truth.positions_m, strict=True):
                rows.setdefault(id, []).append((truth.stamp_ns, place))
    return {id: (np.array([s for s, _ in seen]), np.array([p for _, p in seen])) for id, seen in rows.items()}


def _whom(result: FrameResult, where: dict[int, tuple[IntArray, FloatArray]], stamps_ns: IntArray) -> FloatArray:
    """Returns where the people that tracks stand for will be, (A, F, 2); NaN where that is not known."""
    found = np.full((len(result.tracks.tracks), len(stamps_ns), 2), np.nan)
    truth = result.ground_truth
    if truth is None or len(truth.ids) == 0:
        return found
    for row, track in enumerate(result.tracks.tracks):
        apart = np.linalg.norm(truth.positions_m - track.state[:2], axis=1)
        if apart.min() > SAME_M:
            continue
        stamps, places = where[int(truth.ids[apart.argmin()])]
        if stamps[-1] >= stamps_ns[-1]:
            found[row] = np.column_stack([np.interp(stamps_ns, stamps, places[:, i]) for i in range(2)])
    return found


def joined(parts: list[Asked]) -> Asked:
    """Returns all questions as one."""
    methods = parts[0].probability
    return Asked(
        {method: np.concatenate([part.probability[method] for part in parts]) for method in methods},
        {method: np.concatenate([part.time_s[method] for part in parts]) for method in methods},
        np.concatenate([part.entered_s for part in parts]),
    )


def figures(asked: Asked) -> dict[str, Any]:
    """Returns Brier scores, time errors of who entered as expected, and the predictor's reliability by bins."""
    entered = np.isfinite(asked.entered_s)
    scores = {}
    for method, probability in asked.probability.items():
        told = entered & (probability >= 0.5)
        late_s = asked.time_s[method][told] - asked.entered_s[told]
        scores[method] = {
            "brier": float(np.square(probability - entered).mean()),
            "expected": float(probability.sum()),
            "told": int(told.sum()),
            "time_error_s": float(np.abs(late_s).mean()) if told.any() else None,
            "time_bias_s": float(late_s.mean()) if told.any() else None,
        }
    ours = asked.probability[OURS]
    bins = []
    for low, high in itertools.pairwise(EDGES):
        inside = (ours >= low) & ((ours < high) | (high == 1))
        mean = (float(ours[inside].mean()), float(entered[inside].mean())) if inside.any() else (None, None)
        bins.append({"from": low, "to": high, "questions": int(inside.sum()), "predicted": mean[0], "came": mean[1]})
    return {"questions": len(entered), "entered": int(entered.sum()), "scores": scores, "reliability": bins}


def show(title: str, found: dict[str, Any], console: Console) -> None:
    """Prints both tables of one corridor."""
    share = found["entered"] / found["questions"]
    console.print(f"\n[bold]{title}[/]: {found['questions']} questions, {found['entered']} entered ({share:.1%})")
    table = Table("method", "Brier", "expected to enter", "found (at 0.5)", "time error s", "bias s")
    for method, score in found["scores"].items():
        times = ("" if score[name] is None else f"{score[name]:+.2f}" for name in ("time_error_s", "time_bias_s"))
        table.add_row(method, f"{score['brier']:.4f}", f"{score['expected']:.0f}", str(score["told"]), *times)
    table.add_row("always the share", f"{share * (1 - share):.4f}", f"{found['entered']}", "0", "", "")
    console.print(table)
    table = Table("probability", "questions", "predicted", "came")
    for each in found["reliability"]:
        means = ("" if each[name] is None else f"{each[name]:.3f}" for name in ("predicted", "came"))
        table.add_row(f"{each['from']:g} to {each['to']:g}", str(each["questions"]), *means)
    console.print(table)


def main() -> None:
    """Simulates, replays, asks, and prints what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", help="name or file of the weights; default: those of `pcgan replay`")
    parser.add_argument("--json", type=Path, help="write the figures to this file as well")
    arguments = parser.parse_args()
    console = Console(width=120)
    predictor = Predictor.from_checkpoint(find_model(arguments.model))
    parts: dict[tuple[str, str], list[Asked]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, log in drives(Path(folder)):
            with Replay([log], None, PredictorChoice("inline", arguments.model)) as run:
                results = list(run)
            kind = "DUT" if name.startswith("dut/") else "crowds"
            for corridor in (CARRIED_ON, DRIVEN):
                asked = list(questions(results, predictor, corridor))
                parts.setdefault((kind, corridor), []).extend(asked)
            console.print(f"{name}: {len(results)} frames", style="dim")
    found = {f"{kind}, {corridor}": figures(joined(asked)) for (kind, corridor), asked in parts.items()}
    for title, each in found.items():
        show(title, each, console)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
