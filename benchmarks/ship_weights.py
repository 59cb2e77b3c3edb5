"""Puts the first seed of every run where it ships from: networks of the tables, and the two that predict in replays.

python -m benchmarks.ship_weights [--runs DIR]

Names lose their seed. Networks of the tables go to pcgan/weights/tables, vehicle_10hz and vehicle_2.5hz to
pcgan/weights.
"""

import argparse
from pathlib import Path

from pcgan import checkpoint

REPLAY = ("vehicle_10hz", "vehicle_2.5hz")
SEED = "_s0"
LARGEST_BYTES = 500_000


def main() -> None:
    """Copies and lists."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where the checkpoints are (runs)")
    arguments = parser.parse_args()
    for path in sorted(arguments.runs.glob(f"*{SEED}.safetensors")):
        name = path.stem.removesuffix(SEED)
        folder = checkpoint.WEIGHTS_FOLDER if name in REPLAY else checkpoint.TABLE_WEIGHTS
        network, found = checkpoint.load_network(path)
        wanted = found.training["recipe"]["epochs"]
        if found.training["epochs_done"] != wanted or not found.training.get("calibrated"):
            print(f"{path.name}: left out, {found.training['epochs_done']} of {wanted} epochs are done")
            continue
        target = folder / f"{name}.safetensors"
        checkpoint.save(target, found.config, network.state_dict(), found.training)
        size = target.stat().st_size
        if size > LARGEST_BYTES:
            raise SystemExit(f"{target.name} has {size} bytes, more than {LARGEST_BYTES}")
        print(f"{target.name}: {size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
