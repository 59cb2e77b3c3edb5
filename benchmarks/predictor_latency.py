"""How long a prediction of one scene of N pedestrians takes, on one thread, beside what one would use instead.

OMP_NUM_THREADS=1 python -m benchmarks.predictor_latency [--only-ours]

Scenes are made up: people within 60 x 60 m, each with 37 samples of history at 10 Hz, and a vehicle. Ours: `network`,
the mixtures and modal paths; `step`, a whole track frame; `bytes`, what the predictor process does per frame: decode,
step, encode. The others, in the same process: Social GAN with 20 samples, as a batch of 20 copies of the scene (how its
authors' generator is sampled at a time), with the copies' common part computed once, and one after another; SR-LSTM.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from pcgan import checkpoint, inference
from pcgan.batches import Observation
from pcgan.inference import NumpyGenerator
from pcgan.predictor import Predictor
from pcgan.sgan import SganConfig, SganGenerator
from pcgan.sr_lstm import SrLstm, SrLstmConfig
from schemas import codec
from schemas.messages import FloatArray, Track, TrackFrame, TrackHistory, VehicleHistory

COUNTS = (1, 5, 20, 50, 100, 200, 500)
SAMPLED = 20
STAMP_NS = 1_700_000_000_000_000_000
SAMPLES = 37


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


def milliseconds(call: Callable[[], object], seconds: float) -> tuple[float, float]:
    """Returns the median and the least time of a call, repeated for about so long, after some to warm up."""
    for _ in range(3):
        call()
    spent: list[float] = []
    while sum(spent) < 1e3 * seconds or len(spent) < 5:
        start = time.perf_counter()
        call()
        spent.append(1e3 * (time.perf_counter() - start))
    return float(np.median(spent)), min(spent)


def our_calls(path: Path | None, N: int) -> dict[str, Callable[[], object]]:
    """Returns what our predictor does for N pedestrians."""
    predictor = Predictor.from_checkpoint(path)
    network = NumpyGenerator(checkpoint.load_generator(checkpoint.find_model(path))[0])
    config, frame = network.config, make_frame(N)
    data = codec.encode(frame)
    observed, velocity, vehicle = scene(N, config.observed_steps)
    observed_t, velocity_t = np.ascontiguousarray(observed.T), np.ascontiguousarray(velocity.T)
    seen = np.ones((config.observed_steps, N), bool)

    def predict() -> object:
        heading = network.heading(velocity_t)
        local = network.local_mixture(observed_t, seen, velocity_t, vehicle if config.uses_vehicle else None, heading)
        return inference.modal_paths(local.weights, local.means_m, config.eps_m)

    return {
        "network": predict,
        "step": lambda: predictor.step(frame),
        "bytes": lambda: codec.encode(predictor.step(codec.decode(TrackFrame, data))),
    }


def other_calls(N: int) -> dict[str, Callable[[], object]]:
    """Returns what the others do; weights are random, which costs the same as trained ones."""
    sgan, sr_lstm = SganGenerator(SganConfig()).eval(), SrLstm(SrLstmConfig()).eval()
    observed, velocity, _ = scene(N, 8)
    everybody = torch.ones(N, N, dtype=torch.bool)
    seen = torch.ones(N, 8, dtype=torch.bool)
    observation = Observation(torch.from_numpy(observed), seen, torch.from_numpy(velocity), everybody, None)
    draws = torch.Generator().manual_seed(0)
    return {
        "SGAN 20 in a batch": lambda: sgan.sample(observation, SAMPLED, draws, copies=True),
        "SGAN 20, encoded once": lambda: sgan.sample(observation, SAMPLED, draws, copies=False),
        "SGAN 20 in turn": lambda: [sgan.sample(observation, 1, draws, copies=True) for _ in range(SAMPLED)],
        "SR-LSTM": lambda: sr_lstm(observation),
    }


def scene(N: int, T: int, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns observed (N, T, 2) m, velocity (N, 2) m/s and a vehicle (T, 4), float32."""
    rng = np.random.default_rng([seed, N])
    velocity = rng.normal(0, 1, (N, 2))
    ages_s = 0.4 * np.arange(T - 1, -1, -1)[:, None]
    observed = rng.uniform(-30, 30, (N, 1, 2)) - ages_s * velocity[:, None] + rng.normal(0, 0.02, (N, T, 2))
    vehicle = np.concatenate([ages_s * [-5, 0], np.tile([5.0, 0.0], (T, 1))], axis=1)
    return observed.astype(np.float32), velocity.astype(np.float32), vehicle.astype(np.float32)


def main() -> None:
    """Measures, prints a table of least times, and writes both if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="a checkpoint; default: the one that ships")
    parser.add_argument("--only-ours", action="store_true", help="leave the others out")
    parser.add_argument("--seconds", type=float, default=2.0, help="for each figure (2)")
    parser.add_argument("--json", type=Path, help="write the figures to this file as well")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    console = Console(width=140)
    figures: dict[str, dict[str, tuple[float, float]]] = {}
    with torch.inference_mode():
        for N in COUNTS:
            calls = our_calls(arguments.model, N) | ({} if arguments.only_ours else other_calls(N))
            figures[str(N)] = {name: milliseconds(call, arguments.seconds) for name, call in calls.items()}
            console.print(f"N = {N} measured", style="dim")
    names = list(next(iter(figures.values())))
    table = Table("N", *names, title="ms per scene, least of many (median)")
    for N, row in figures.items():
        table.add_row(N, *(f"{row[name][1]:.2f} ({row[name][0]:.2f})" for name in names))
    console.print(table)
    if not arguments.only_ours:
        ratios = Table("N", *names[3:], title="times as long as our network")
        for N, row in figures.items():
            ratios.add_row(N, *(f"{row[name][1] / row['network'][1]:.1f}" for name in names[3:]))
        console.print(ratios)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"median_and_least_ms": figures}, indent=1) + "\n")


if __name__ == "__main__":
    main()
