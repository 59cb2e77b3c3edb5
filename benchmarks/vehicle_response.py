"""Do predictions react to the vehicle as people do? Held against all of DUT, and against its held-out clips.

python -m benchmarks.vehicle_response [--runs DIR]

Taken are people whom a moving vehicle comes up to: ahead of it, near its line of travel, to be reached within the
horizon. "Away" is the direction across that line, to the side they are on. How far away do they move, beyond carrying
on straight: in truth, as predicted, as predicted by the same network if the vehicle were not there, or if it came past
them on their other side? That is asked of everybody in their scene, and of each alone, and in pairs. Of the clips
outside the held-out ones the network has learnt from most.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from pcgan import checkpoint
from pcgan.batches import batches
from pcgan.clips import clip_names, load_clip
from pcgan.dataset import Windows, clip_windows, concatenate
from pcgan.evaluation import append_lines, as_line
from pcgan.forecast import Extrapolation, Method
from pcgan.methods import load_method
from pcgan.protocols import LONG_DUT_SPEC, long_dut_split
from pcgan.scores import quick_scores, scorable
from schemas.messages import BoolArray, FloatArray, IntArray

BESIDE_M, DRIVING_MPS = 3.0, 1.0
PARALLEL = 0.85  # cosine of 32 degrees
FEWEST = 5
HELD_OUT = "held-out clips"


def approached(windows: Windows) -> tuple[dict[str, BoolArray], FloatArray, FloatArray]:
    """Returns who is approached how (N,), the direction away (N, 2), and how far beside the line they are (N,) in m."""
    place, velocity = windows.vehicle[:, -1, :2], windows.vehicle[:, -1, 2:]
    speed = np.linalg.norm(velocity, axis=1)
    heading = velocity / np.maximum(speed, 1e-6)[:, None]
    offset = windows.observed[:, -1] - place
    ahead = (offset * heading).sum(axis=1)
    left = np.stack([-heading[:, 1], heading[:, 0]], axis=1)
    beside = (offset * left).sum(axis=1)
    along = (windows.velocity * heading).sum(axis=1)  # m/s in the vehicle's direction
    course = along / np.maximum(np.linalg.norm(windows.velocity, axis=1), 1e-6)  # cosine
    horizon_s = windows.future.shape[1] * windows.dt_s
    with np.errstate(invalid="ignore"):
        met = (speed > DRIVING_MPS) & (ahead > 0) & (np.abs(beside) < BESIDE_M) & (ahead < horizon_s * (speed - along))
    met &= scorable(windows, windows.future.shape[1])
    kinds = {
        "from behind": met & (course > PARALLEL),
        "head-on": met & (course < -PARALLEL),
        "across": met & (np.abs(course) <= PARALLEL),
    }
    return kinds, left * np.sign(beside)[:, None], np.abs(beside)


def last_points(method: Method, windows: Windows) -> FloatArray:
    """Returns the last predicted point (N, 2) of everybody, most probable path."""
    out = np.zeros((len(windows), 2))
    with torch.inference_mode():
        for batch in batches(windows, 2048):
            real = batch.real
            forecast = method.forecast(batch.observation, torch.Generator().manual_seed(0))
            out[batch.row[real].numpy()] = forecast.likeliest[real][:, -1].numpy()
    return out


def in_company(windows: Windows, chosen: BoolArray, people: int) -> tuple[Windows, IntArray]:
    """Returns scenes of each chosen pedestrian with the nearest others, `people` in all, and the chosen one's rows."""
    rows, scenes = [], []
    own = np.flatnonzero(chosen)
    for index, row in enumerate(own):
        mates = np.flatnonzero(windows.scene == windows.scene[row])
        apart = np.linalg.norm(windows.observed[mates, -1] - windows.observed[row, -1], axis=1)
        rows.append(mates[np.argsort(apart, kind="stable")[:people]])  # the first is the pedestrian
        scenes.append(np.full(len(rows[-1]), index))
    taken = np.concatenate(rows)
    mine = np.cumsum([0, *(len(r) for r in rows[:-1])])
    parts = {n: getattr(windows, n)[taken] for n in ("observed", "seen", "velocity", "future", "vehicle", "annotated")}
    return Windows(**parts, scene=np.concatenate(scenes), dt_s=windows.dt_s), mine


def on_the_other_side(windows: Windows) -> Windows:
    """Returns the windows with every vehicle moved across its line of travel to pass each one on the other side."""
    _, away, beside = approached(windows)
    vehicle = windows.vehicle.copy()
    vehicle[:, :, :2] += (2 * beside[:, None] * away)[:, None]
    return replace(windows, vehicle=vehicle.astype(np.float32))


def without_vehicle(windows: Windows) -> Windows:
    """Returns the windows with no vehicle in sight."""
    return replace(windows, vehicle=np.full_like(windows.vehicle, np.nan))


def main() -> None:
    """Prints how far people move away, and how far they are predicted to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, help="folder of networks; default: those that ship")
    arguments = parser.parse_args()
    folder = arguments.runs or checkpoint.TABLE_WEIGHTS
    console = Console(width=140)
    path = next(iter(sorted(folder.glob("pcgan_dut_long*.safetensors"))))
    method = load_method(path)
    everything = concatenate([clip_windows(load_clip(name), LONG_DUT_SPEC) for name in clip_names("dut")])
    for title, windows in ((HELD_OUT, long_dut_split().test), ("all of DUT", everything)):
        straight = last_points(Extrapolation("weighted", LONG_DUT_SPEC.predicted_steps, LONG_DUT_SPEC.dt_s), windows)
        kinds, away, _ = approached(windows)
        columns = ("truth", "predicted", "no vehicle", "other side", "alone", "in twos")
        table = Table("approached", "people", *columns, title=f"Metres moved away from the vehicle in 4.8 s, {title}")
        moved = {
            "truth": windows.future[:, -1],
            "predicted": last_points(method, windows),
            "no vehicle": last_points(method, without_vehicle(windows)),
            "other side": last_points(method, on_the_other_side(windows)),
        }
        chosen = np.logical_or.reduce(list(kinds.values()))
        for people, column in ((1, "alone"), (2, "in twos")):
            some, mine = in_company(windows, chosen, people)
            moved[column] = np.zeros_like(straight)
            ahead = last_points(method, some)[mine] - some.observed[mine, -1]
            moved[column][chosen] = ahead + windows.observed[chosen, -1]
        for kind, rows in kinds.items():
            if rows.sum() < FEWEST:
                table.add_row(kind, str(rows.sum()))
                continue
            cells = []
            for points in moved.values():
                amount = ((points - straight)[rows] * away[rows]).sum(axis=1)
                cells.append(f"{amount.mean():+.3f} ± {amount.std() / np.sqrt(len(amount)):.3f}")
            table.add_row(kind, str(rows.sum()), *cells)
        console.print(table)
        if title == HELD_OUT:
            look = as_line(path.stem, path, "dut_long@12", quick_scores(method, windows), "benchmarks.vehicle_response")
            append_lines([look])
        here = quick_scores(method, windows, among=chosen)
        gone = quick_scores(method, without_vehicle(windows), among=chosen)
        console.print(
            f"these {here.pedestrians} people, same network: ADE/FDE/NLL {here.ade:.3f}/{here.fde:.3f}/{here.nll:.2f} "
            f"with the vehicle, {gone.ade:.3f}/{gone.fde:.3f}/{gone.nll:.2f} if it is hidden\n"
        )


if __name__ == "__main__":
    main()
