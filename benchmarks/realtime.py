"""How fast a replay is, and whether its memory grows with the log.

python -m benchmarks.realtime [--pedestrians 30] [--minutes 1 10] [--repeats 3] [--formats pcgan ros2 foxglove json]
                              [--without-truth] [--json F]

Each replay is the command itself, in a process of its own with its predictor, on a simulated drive without --rrd. With
several formats the same drive is written as other stacks write it, and the replays take turns.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import Writer
from rich.console import Console
from rich.table import Table

from replay.simulator import simulate
from tests.replay import foreign_foxglove, foreign_ros

_MEASURED = """
import resource, sys
from replay.cli import main
sys.argv = ["pcgan", *sys.argv[1:]]
try:
    main()
finally:
    own = resource.getrusage(resource.RUSAGE_SELF)
    child = resource.getrusage(resource.RUSAGE_CHILDREN)
    print("rusage", own.ru_maxrss, child.ru_maxrss, own.ru_utime + own.ru_stime, child.ru_utime + child.ru_stime)
"""


def main() -> None:
    """Measures, prints a table and writes JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pedestrians", type=int, default=30)
    parser.add_argument("--minutes", type=float, nargs="+", default=[1.0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--without-truth", action="store_true", help="as a real drive: no ground truth, so no scores of the whole drive"
    )
    parser.add_argument("--formats", nargs="+", choices=sorted(FORMATS), default=["pcgan"])
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for minutes in arguments.minutes:
            log = folder / "drive.mcap"
            simulate(log, clip=None, vehicle=None, pedestrians=arguments.pedestrians, duration_s=60 * minutes, seed=1)
            if arguments.without_truth:
                log = drop_truth(log, folder / "recorded.mcap")
            logs = {name: FORMATS[name](log, folder / f"{name}.mcap") for name in arguments.formats}
            for _ in range(arguments.repeats):
                rows += [{"minutes": minutes, "format": name, **measure(each, folder)} for name, each in logs.items()]
    show(rows)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


FORMATS: dict[str, Callable[[Path, Path], Path]] = {
    "pcgan": lambda log, _: log,
    "ros2": foreign_ros.as_ros2,
    "foxglove": foreign_foxglove.as_foxglove,
    "json": foreign_foxglove.as_foxglove_json,
}  # as the tests' writers make them; that of ROS 2 has no ground truth


def drop_truth(log: Path, output: Path) -> Path:
    """Copies a drive without its ground truth."""
    with log.open("rb") as stream, output.open("wb") as copy:
        writer = Writer(copy)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.topic == "/simulation/ground_truth" or schema is None:
                continue
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return output


def measure(log: Path, folder: Path) -> dict[str, Any]:
    """Replays once and returns speed, memory and CPU time."""
    summary = folder / "summary.json"
    command = [sys.executable, "-c", _MEASURED, "replay", str(log), "-o", str(folder / "out.mcap")]
    done = subprocess.run(
        [*command, "--json", str(summary)], capture_output=True, text=True, check=True, env={**os.environ}
    )
    _, own_kib, child_kib, own_s, child_s = done.stdout.split("rusage")[-1].join(["rusage ", ""]).split()
    figures = json.loads(summary.read_text())
    return {
        "frames": figures["frames"],
        "tracks_per_frame": figures["predictions"] / figures["frames"],
        "realtime_factor": figures["realtime_factor"],
        "wall_s": figures["wall_s"],
        "startup_s": figures["startup_s"],
        "replay_cpu_ms_per_frame": 1e3 * float(own_s) / figures["frames"],
        "predictor_cpu_ms_per_frame": 1e3 * float(child_s) / figures["frames"],
        "replay_peak_mib": int(own_kib) / 1024,
        "predictor_peak_mib": int(child_kib) / 1024,
        "latency_ms": figures["latency_ms"],
    }


def show(rows: list[dict[str, Any]]) -> None:
    """Prints the rows as a table."""
    table = Table(
        "minutes", "format", "tracks a frame", "times real time", "replay CPU ms", "predictor CPU ms", "replay MiB"
    )
    for row in rows:
        table.add_row(
            f"{row['minutes']:g}",
            row["format"],
            f"{row['tracks_per_frame']:.1f}",
            f"{row['realtime_factor']:.1f}",
            f"{row['replay_cpu_ms_per_frame']:.2f}",
            f"{row['predictor_cpu_ms_per_frame']:.2f}",
            f"{row['replay_peak_mib']:.0f}",
        )
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
