"""The whole tracking stage on a recorded drive: milliseconds per scan, each scan's best of several runs.

OMP_NUM_THREADS=1 python -m benchmarks.tracking.stage out/drive20.mcap
"""

import argparse
import time
from pathlib import Path

import numpy as np

from replay.session import Replay
from tracking.pipeline import TrackingStage
from tracking.sensor_frame import SensorFrame


def milliseconds(frames: list[SensorFrame], runs: int) -> np.ndarray:
    """Returns each frame's fastest step, (N,) ms: what the machine does beside this only ever adds."""
    best = np.full(len(frames), np.inf)
    for _ in range(runs):
        stage = TrackingStage()
        for k, frame in enumerate(frames):
            start = time.perf_counter()
            stage.step(frame)
            best[k] = min(best[k], time.perf_counter() - start)
    return 1e3 * best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--runs", type=int, default=15)
    arguments = parser.parse_args()
    frames = [frame.sensors for frame in Replay([arguments.log]).frames() if not frame.late]
    ms = milliseconds(frames, arguments.runs)
    clusters = np.mean([len(frame.clusters.points) for frame in frames])
    print(f"{len(frames)} scans of {clusters:.0f} clusters: mean {ms.mean():.2f} ms, slowest {ms.max():.2f} ms")


if __name__ == "__main__":
    main()
