"""How long the predictor takes to answer one frame of N pedestrians, on one thread.

Frames are made up: people within 60 x 60 m, each with 37 samples of history at 10 Hz, and a vehicle. `step` is the
prediction alone; `bytes` is what the predictor process does per frame: decode, step, encode.

    OMP_NUM_THREADS=1 python benchmarks/predictor_latency.py
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pcgan.predictor import Predictor
from schemas import codec
from schemas.messages import Track, TrackFrame, TrackHistory, VehicleHistory

COUNTS = (1, 5, 20, 30, 50, 100, 200)
STAMP_NS = 1_700_000_000_000_000_000
SAMPLES = 37


@dataclass(frozen=True)
class Latency:
    """Milliseconds per frame of N pedestrians."""

    N: int
    step_median_ms: float
    step_best_ms: float
    bytes_median_ms: float
    bytes_best_ms: float


def make_frame(N: int, seed: int = 0) -> TrackFrame:
    """Returns a frame of N tracks, all seen long enough for the network; the same arguments give the same frame."""
    rng = np.random.default_rng([seed, N])
    ages_s = np.arange(SAMPLES - 1, -1, -1)[:, None] / 10  # (H, 1)
    stamps_ns = STAMP_NS - np.round(ages_s[:, 0] * 1e9).astype(np.int64)
    tracks = []
    for id in range(N):
        velocity = rng.normal(0, 1, 2)
        points = rng.uniform(-30, 30, 2) - ages_s * velocity + rng.normal(0, 0.02, (SAMPLES, 2))
        states = np.concatenate([points, np.tile(velocity, (SAMPLES, 1))], axis=1)
        history = TrackHistory(stamps_ns, states, np.zeros(SAMPLES, bool))
        tracks.append(Track(id, states[-1], 0.05 * np.eye(4), 0.99, 3_600_000_000, False, history))
    vehicle = np.concatenate([ages_s * [-5, 0, 0], np.tile([5.0, 0.0], (SAMPLES, 1))], axis=1)
    return TrackFrame(1, STAMP_NS, "odom", VehicleHistory(stamps_ns, vehicle), tuple(tracks))


def milliseconds(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Returns the median and the least time of a call, after some to warm up."""
    for _ in range(20):
        call()
    spent = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        spent.append(1e3 * (time.perf_counter() - start))
    return float(np.median(spent)), min(spent)


def measure(predictor: Predictor, N: int, repeats: int) -> Latency:
    """Returns the predictor's latency for N pedestrians."""
    frame = make_frame(N)
    data = codec.encode(frame)
    step = milliseconds(lambda: predictor.step(frame), repeats)
    answer = milliseconds(lambda: codec.encode(predictor.step(codec.decode(TrackFrame, data))), repeats)
    return Latency(N, *step, *answer)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="a checkpoint; default: the one that ships")
    parser.add_argument("--repeats", type=int, default=300)
    parser.add_argument("--json", type=Path, help="write the figures to this file as well")
    arguments = parser.parse_args()
    predictor = Predictor.from_checkpoint(arguments.model)
    print("|   N | step median ms | step best ms | bytes median ms | bytes best ms |\n|---|---|---|---|---|")
    rows = []
    for N in COUNTS:
        row = measure(predictor, N, arguments.repeats)
        print(
            f"| {N:3} | {row.step_median_ms:.2f} | {row.step_best_ms:.2f}"
            f" | {row.bytes_median_ms:.2f} | {row.bytes_best_ms:.2f} |"
        )
        rows.append(row)
    if arguments.json is not None:
        figures = {"model": predictor.model_name, "checksum": predictor.checksum, "rows": [asdict(row) for row in rows]}
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
