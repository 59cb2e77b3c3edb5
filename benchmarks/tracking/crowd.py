"""The tracker on a simulated crowd: N people in 60 x 60 m, 10 Hz, p_detect 0.9, sigma 0.15 m, 5 clutter points a scan.

    python -m benchmarks.tracking.crowd                    # the table, on seeds nothing was tuned on
    python -m benchmarks.tracking.crowd --seeds 0 1 2 3    # the tuning seeds

People walk to random places around each other, sometimes stop, leave at the border and are replaced there.
"""

import argparse
import time
from dataclasses import dataclass

import numpy as np

from tracking.measurements import Measurements, make_measurements
from tracking.metrics import ScoredFrame, TrackingScore, score
from tracking.tracker import Tracker, TrackerParams

TUNING_SEEDS = (0, 1, 2, 3)
REPORT_SEEDS = (100, 101, 102, 103)
HALF_M, RATE_HZ, P_DETECT, SIGMA_M, CLUTTER = 30.0, 10, 0.9, 0.15, 5.0


@dataclass(frozen=True)
class CrowdScan:
    """One scan of a crowd with its truth."""

    stamp_ns: int
    ids: np.ndarray  # (A,)
    positions_m: np.ndarray  # (A, 2)
    measurements: Measurements


def crowd(N: int, scans: int, seed: int) -> list[CrowdScan]:
    """Returns scans of N people; the same arguments give the same crowd."""
    generator = np.random.default_rng([seed, N])
    dt = 1 / RATE_HZ
    ids, next_id = np.arange(N), N
    position, goal = generator.uniform(-HALF_M, HALF_M, (2, N, 2))
    speed = np.clip(generator.normal(1.3, 0.3, N), 0.4, 2.2)
    velocity = np.zeros((N, 2))
    pause = np.zeros(N)
    out = []
    for k in range(scans + 20):
        to_goal = goal - position
        distance = np.hypot(*to_goal.T)
        desired = to_goal / np.maximum(distance, 1e-6)[:, None] * (speed * (pause <= 0))[:, None]
        apart = position[:, None] - position[None]
        gap = np.hypot(apart[..., 0], apart[..., 1]) + 1e3 * np.eye(N)
        push = (apart / gap[..., None] * (2.0 * np.exp((0.5 - gap) / 0.3))[..., None]).sum(axis=1)
        velocity = velocity + dt * ((desired - velocity) / 0.7 + push) + generator.normal(0, 0.05, (N, 2))
        position = position + dt * velocity
        pause -= dt
        pause = np.where((pause <= 0) & (generator.random(N) < dt / 60), generator.uniform(1, 5, N), pause)
        arrived = np.flatnonzero(distance < 1.0)
        leaves = generator.random(len(arrived)) < 0.5
        # Half of those who arrive go on elsewhere; the others walk out over the border.
        goal[arrived] = generator.uniform(-HALF_M, HALF_M, (len(arrived), 2))
        edge = arrived[leaves]
        goal[edge] = np.sign(position[edge]) * (HALF_M + 3)
        outside = np.flatnonzero((np.abs(position) > HALF_M).any(axis=1))
        ids[outside] = next_id + np.arange(len(outside))
        next_id += len(outside)
        side, along = generator.integers(0, 4, len(outside)), generator.uniform(-HALF_M, HALF_M, len(outside))
        rim = (HALF_M - 0.1) * np.where(side % 2 == 0, 1, -1)
        position[outside] = np.where((side < 2)[:, None], np.stack([rim, along], 1), np.stack([along, rim], 1))
        goal[outside] = generator.uniform(-HALF_M, HALF_M, (len(outside), 2))
        velocity[outside] = 0
        if k < 20:
            continue
        seen = generator.random(N) < P_DETECT
        noisy = position[seen] + generator.normal(0, SIGMA_M, (int(seen.sum()), 2))
        clutter = generator.uniform(-HALF_M, HALF_M, (generator.poisson(CLUTTER), 2))
        z = np.concatenate([noisy, clutter])
        measurements = make_measurements(z, np.eye(2) * SIGMA_M**2)
        out.append(CrowdScan(round((k + 1) * dt * 1e9), ids.copy(), position.copy(), measurements))
    return out


def run(scans: list[CrowdScan], params: TrackerParams, settle: int = 10) -> tuple[TrackingScore, float]:
    """Returns the score past the first `settle` scans, and the tracker's CPU milliseconds per scan."""
    tracker = Tracker(params)
    frames, spent = [], 0.0
    for scan in scans:
        start = time.process_time()
        tracks = tracker.step(scan.measurements, scan.stamp_ns, P_DETECT)
        spent += time.process_time() - start
        frames.append(
            ScoredFrame(
                scan.ids,
                scan.positions_m,
                np.array([track.id for track in tracks], np.int64),
                np.array([track.state[:2] for track in tracks]).reshape(-1, 2),
            )
        )
    return score(frames[settle:]), 1e3 * spent / len(scans)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, nargs="+", default=[10, 30, 100, 200])
    parser.add_argument("--scans", type=int, default=300)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(REPORT_SEEDS))
    arguments = parser.parse_args()
    print("|   N | OSPA m | HOTA  | IDF1  | MOTA  | switches | ms per scan |\n|---|---|---|---|---|---|---|")
    for N in arguments.people:
        results = [run(crowd(N, arguments.scans, seed), TrackerParams()) for seed in arguments.seeds]
        ospa, hota, idf1, mota, switches = np.mean(
            [[s.ospa_m, s.hota, s.idf1, s.mota, s.id_switches] for s, _ in results], axis=0
        )
        milliseconds = np.mean([ms for _, ms in results])
        print(f"| {N:3} | {ospa:.3f} | {hota:.3f} | {idf1:.3f} | {mota:.3f} | {switches:.1f} | {milliseconds:.2f} |")


if __name__ == "__main__":
    main()
