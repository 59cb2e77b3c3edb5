"""Replays drives simulated from clips that nobody trained on, and keeps a record of every such look.

python -m benchmarks.held_out [--model NAME|FILE ...] [--note TEXT]

Each model that ships, or those given, 1.2 s and 4.8 s ahead, beside the tracker's own state carried on. The drives:
dut/roundabout_04, dut/intersection_08 (its moving vehicle) and CITR clips with a vehicle. Nothing may be
chosen on them, so every run appends commit, model and figures to benchmarks/test_runs.csv, which is committed.
"""

import argparse
import csv
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from pcgan.checkpoint import shipped_models
from replay import PredictorChoice, Replay, record
from replay.simulator import simulate
from replay.training_windows import HELD_OUT_DRIVES

RECORD = Path(__file__).with_name("test_runs.csv")
SEED = 0
ERRORS = ("ade_m", "fde_m", "mhd_m", "nll")


def main() -> None:
    """Scores the drives, prints a table and appends the figures to the record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", action="append", help="name or file, may be repeated; default: all that ship")
    parser.add_argument("--note", default="", help="why the drives were looked at")
    arguments = parser.parse_args()
    models = arguments.model or list(shipped_models())
    rows = [row(clip, vehicle, model, arguments.note) for model in models for clip, vehicle in HELD_OUT_DRIVES]
    with RECORD.open("a", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0], lineterminator="\n")
        if stream.tell() == 0:
            writer.writeheader()
        writer.writerows(rows)
    show(rows)


def row(clip: str, vehicle: int | None, model: str, note: str) -> dict[str, Any]:
    """Returns one drive's figures as a row of the record."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "drive.mcap"
        simulate(log, clip=clip, vehicle=vehicle, pedestrians=0, duration_s=None, seed=SEED)
        figures: Mapping[str, Any] = record(Replay([log], predictor=PredictorChoice("inline", model))).as_json()
    truth = figures["ground_truth"]
    return {
        "commit": commit(),
        "model": figures["model"]["name"],
        "weights": figures["model"]["sha256"][:12],
        "drive": clip if vehicle is None else f"{clip}:{vehicle}",
        "seed": SEED,
        "tracks": figures["tracks"],
        "predictions": figures["predictions"],
        "fallbacks": figures["fallbacks"],
        **{f"truth_{name}": round(truth[name], 4) for name in ERRORS},
        **{f"truth_tracker_{name}": round(truth["tracker"][name], 4) for name in ERRORS},
        "truth_scored": truth["scored"],
        **{f"self_{name}": round(figures[name], 4) for name in ERRORS},
        **{f"self_tracker_{name}": round(figures["tracker"][name], 4) for name in ERRORS},
        "self_scored": figures["scored"],
        **{name: round(truth[name], 4) for name in ("hota", "mota", "idf1", "gospa_m")},
        "id_switches": truth["id_switches"],
        "note": note,
    }


def commit() -> str:
    """Returns the commit looked at, with a plus sign if files differ from it."""
    described = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    return subprocess.run(described, capture_output=True, text=True, check=True, cwd=RECORD.parent).stdout.strip()


def show(rows: list[dict[str, Any]]) -> None:
    """Prints the rows as a table."""
    errors = ("predictor ADE / FDE / NLL", "tracker extrapolated")
    table = Table("model", "drive", "HOTA", "MOTA", "IDs", *errors, "scored")
    for found in rows:
        ours, theirs = (
            " / ".join(f"{found[f'{prefix}_{name}']:.3f}" for name in ("ade_m", "fde_m", "nll"))
            for prefix in ("truth", "truth_tracker")
        )
        table.add_row(
            found["model"],
            found["drive"],
            f"{found['hota']:.3f}",
            f"{found['mota']:.3f}",
            str(found["id_switches"]),
            ours,
            theirs,
            str(found["truth_scored"]),
        )
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
