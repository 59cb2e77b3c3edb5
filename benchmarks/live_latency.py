"""How long after a scan's clusters are published its prediction arrives, and whether any are lost, with live nodes.

python -m benchmarks.live_latency [--seconds 60] [--people 30 100] [--json F]

For each number of people a drive is simulated and played at its own rate: `pcgan play`, `pcgan track` and
`pcgan predict`, each the command itself in a process of its own, and this process listens. Times are from the
publication of the cluster message, by its timestamp, to the arrival of what came of it here. A scan has to wait for
the cameras and the pose that belong to it; how long, the recording says, and no machine could be faster: that is told
apart.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from rich.console import Console
from rich.table import Table

from pcgan import bus
from pcgan.node_health import health_key
from replay import Replay
from replay.bus_channels import key_of
from replay.log_reader import LogReader
from replay.simulator import simulate
from replay.simulator.sensor_suite import CLUSTERS_TOPIC
from schemas import codec, topics
from schemas import pcgan_v1_pb2 as pb
from schemas.messages import LidarClusters, NodeHealth

STARTUP_S = 60.0
SETTLED_S = 2.0  # scans from before the nodes have heard all they need are told apart
TAIL_S = 2.0  # how long after the end of the drive the last answers are waited for


def main() -> None:
    """Measures, prints a table, and writes JSON if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60, help="of each drive (60)")
    parser.add_argument("--people", type=int, nargs="+", default=[30, 100], help="around the vehicle (30 100)")
    parser.add_argument("--seed", type=int, default=1, help="of the drives (1)")
    parser.add_argument("--json", type=Path, help="write the figures to this file as well")
    arguments = parser.parse_args()
    console = Console(width=140)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        log = Path(name) / "drive.mcap"
        for people in arguments.people:
            console.print(f"simulating {arguments.seconds:g} s with {people} people", style="dim")
            simulate(
                log, clip=None, vehicle=None, pedestrians=people, duration_s=arguments.seconds, seed=arguments.seed
            )
            console.print("playing them", style="dim")
            rows.append({"people": people, **measure(log, f"unixsock-stream/{name}/bus{people}")})
    console.print(table(rows))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


def measure(log: Path, endpoint: str) -> dict[str, Any]:
    """Plays a drive through the live nodes and returns the figures."""
    with (
        command("predict", "--listen", endpoint),
        bus.open_shared_session(connect=[endpoint], wait_s=STARTUP_S) as session,
        command("track", "--connect", endpoint),
    ):
        listener = Listener(session)
        listener.wait_for_nodes()
        with command("play", log, "--connect", endpoint, "--exclude-regex", "simulation") as play:
            if play.wait() != 0:
                raise SystemExit(f"pcgan play ended with {play.returncode}")
        time.sleep(TAIL_S)
    return listener.figures(log)


@contextmanager
def command(*words: object) -> Iterator[subprocess.Popen[bytes]]:
    """Runs a pcgan command until the block is left."""
    process = subprocess.Popen(
        [sys.executable, "-m", "replay.cli", *map(str, words)],
        stdout=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait()


class Listener:
    """Notes by the scan's stamp when clusters were published, and when their tracks and predictions arrived here."""

    def __init__(self, session: zenoh.Session):
        self._session = session
        self.published_ns: dict[int, int] = {}
        self.tracks_ns: dict[int, int] = {}
        self.predictions_ns: dict[int, int] = {}
        self.tracks: list[int] = []  # people per frame
        self.health: dict[str, list[NodeHealth]] = {"track": [], "predict": []}
        for key, take in (
            (key_of(CLUSTERS_TOPIC), self._on_clusters),
            (topics.zenoh_key(topics.TRACKS), self._on_tracks),
            (topics.zenoh_key(topics.PREDICTIONS), self._on_predictions),
            (health_key("track"), lambda sample: self._on_health("track", sample)),
            (health_key("predict"), lambda sample: self._on_health("predict", sample)),
        ):
            session.declare_subscriber(key, take)

    def wait_for_nodes(self) -> None:
        """Returns once both nodes have said how they are."""
        deadline_s = time.monotonic() + STARTUP_S
        while not all(self.health.values()):
            if time.monotonic() > deadline_s:
                raise SystemExit("the nodes did not start")
            time.sleep(0.05)

    def _on_clusters(self, sample: zenoh.Sample) -> None:
        arrived_ns = time.time_ns()
        stamp_ns = pb.LidarClusters.FromString(sample.payload.to_bytes()).stamp_ns
        at_ns = arrived_ns if sample.timestamp is None else round(sample.timestamp.get_time().timestamp() * 1e9)
        self.published_ns[stamp_ns] = at_ns

    def _on_tracks(self, sample: zenoh.Sample) -> None:
        arrived_ns = time.time_ns()
        frame = pb.TrackFrame.FromString(sample.payload.to_bytes())
        self.tracks_ns[frame.stamp_ns] = arrived_ns
        self.tracks.append(len(frame.tracks))

    def _on_predictions(self, sample: zenoh.Sample) -> None:
        arrived_ns = time.time_ns()
        self.predictions_ns[pb.PredictionFrame.FromString(sample.payload.to_bytes()).stamp_ns] = arrived_ns

    def _on_health(self, node: str, sample: zenoh.Sample) -> None:
        self.health[node].append(codec.decode(NodeHealth, sample.payload.to_bytes()))

    def figures(self, log: Path) -> dict[str, Any]:
        """Returns latencies in ms, what was lost, and what the nodes themselves say."""
        waits_ms = sensor_waits_ms(log)
        scans = sorted(waits_ms)
        settled = [stamp for stamp in scans if stamp >= scans[0] + SETTLED_S * 1e9]
        whole = [stamp for stamp in settled if stamp in self.published_ns and stamp in self.predictions_ns]
        to_tracks = [self.tracks_ns[s] - self.published_ns[s] for s in whole if s in self.tracks_ns]
        to_predictions = [self.predictions_ns[s] - self.tracks_ns[s] for s in whole if s in self.tracks_ns]
        total_ms = np.array([self.predictions_ns[s] - self.published_ns[s] for s in whole]) * 1e-6
        own_ms = total_ms - [waits_ms[s] for s in whole]
        return {
            "scans": len(scans),
            "tracks_per_frame": float(np.mean(self.tracks)),
            "lost_at_the_start": sum(s not in self.predictions_ns for s in scans) - (len(settled) - len(whole)),
            "lost": len(settled) - len(whole),
            "total_ms": percentiles(total_ms),
            "sensors_ms": percentiles(np.array([waits_ms[s] for s in whole])),
            "beyond_sensors_ms": percentiles(own_ms),
            "to_tracks_ms": percentiles(np.array(to_tracks) * 1e-6),
            "tracks_to_predictions_ms": percentiles(np.array(to_predictions) * 1e-6),
            **{
                f"{node}_{count}": getattr(reports[-1], count)
                for node, reports in self.health.items()
                for count in ("frames", "dropped", "late", "refused")
            },
        }


def sensor_waits_ms(log: Path) -> dict[int, float]:
    """Returns for each scan how long, in the recording, it waits for the pose and the cameras that belong to it."""
    arrived_ns = {
        codec.decode(LidarClusters, message.data).stamp_ns: message.log_time_ns
        for message in LogReader([log]).messages({CLUSTERS_TOPIC})
    }
    frames = Replay([log]).frames()
    return {f.sensors.stamp_ns: (f.log_time_ns - arrived_ns[f.sensors.stamp_ns]) * 1e-6 for f in frames if not f.late}


def percentiles(values_ms: np.ndarray) -> dict[str, float]:
    """Returns the 50th and 99th percentile and the largest."""
    return dict(zip(("p50", "p99", "most"), np.percentile(values_ms, (50, 99, 100)).tolist(), strict=True))


def table(rows: list[dict[str, Any]]) -> Table:
    """Returns the rows as a table."""
    columns = ("people", "tracks a frame", "scans", "lost", "dropped", "late")
    times = ("total ms", "waiting for sensors", "beyond that", "tracks to prediction")
    title = "from the publication of a scan's clusters to its prediction: p50 / p99 / most"
    shown = Table(*columns, *times, title=title)
    for row in rows:
        names = ("total_ms", "sensors_ms", "beyond_sensors_ms", "tracks_to_predictions_ms")
        shown.add_row(
            str(row["people"]),
            f"{row['tracks_per_frame']:.1f}",
            str(row["scans"]),
            f"{row['lost']} (+{row['lost_at_the_start']})",
            f"{row['track_dropped']} + {row['predict_dropped']}",
            f"{row['track_late']} + {row['predict_late']}",
            *(" / ".join(f"{row[name][each]:.1f}" for each in ("p50", "p99", "most")) for name in names),
        )
    return shown


if __name__ == "__main__":
    main()
