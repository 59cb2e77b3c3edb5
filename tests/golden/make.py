"""Makes the golden logs: python -m tests.golden.make [NAME ...] [-o FOLDER]

They are simulated, seconds long, and the same bytes each time: sparse, dense, turning, occlusion and dropout. Whoever
changes one writes its reference anew: pcgan check tests/golden/suite.yaml --update --reason "why".
"""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from mcap.reader import make_reader
from mcap.writer import Writer

from replay.simulator import drive, simulate
from replay.simulator.sensor_suite import CLUSTERS_TOPIC, ODOMETRY_TOPIC, START_NS, TF_TOPIC
from schemas.topics import CAMERAS
from tests.golden import scenes

FOLDER = Path(__file__).parent
LOG_FOLDER = FOLDER / "logs"


class Gap(NamedTuple):
    """Some topics' messages are missing from one time to another, in seconds of log time after the log's start."""

    topics: tuple[str, ...]
    from_s: float
    until_s: float

    @property
    def length_s(self) -> float:
        """How long they are missing."""
        return self.until_s - self.from_s


DETECTIONS = tuple(f"/gmsl/{camera}/detections" for camera in CAMERAS)
GAPS = (
    Gap(DETECTIONS[:1], 3.0, 6.0),
    Gap((CLUSTERS_TOPIC,), 6.5, 7.5),
    Gap((ODOMETRY_TOPIC, TF_TOPIC), 9.0, 9.5),
    Gap(DETECTIONS, 11.0, 13.0),
)


def sparse(output: Path) -> None:
    """A handful of people around a slow vehicle."""
    simulate(output, clip=None, vehicle=None, pedestrians=5, duration_s=14.0, seed=21)


def dense(output: Path) -> None:
    """A crowd."""
    simulate(output, clip=None, vehicle=None, pedestrians=75, duration_s=8.0, seed=22)


def turning(output: Path) -> None:
    """The vehicle turns left at a crossing."""
    drive.simulate(scenes.turning(), output, seed=23)


def occlusion(output: Path) -> None:
    """People pass behind a car, bushes, a pole and other people."""
    drive.simulate(scenes.occlusion(), output, seed=24)


def dropout(output: Path) -> None:
    """A crowd seen by sensors that fall silent: one camera, the LiDAR, the odometry, and all cameras."""
    whole = output.with_name(f"{output.name}.whole")
    try:
        simulate(whole, clip=None, vehicle=None, pedestrians=12, duration_s=15.0, seed=25)
        leave_out(whole, output, GAPS)
    finally:
        whole.unlink(missing_ok=True)


LOGS: Mapping[str, Callable[[Path], None]] = {
    make.__name__: make for make in (sparse, dense, turning, occlusion, dropout)
}


def leave_out(log: Path, output: Path, gaps: tuple[Gap, ...]) -> None:
    """Copies a recording without the messages that fall into gaps, as if they had never come."""
    with log.open("rb") as source, output.open("wb") as copy:
        reader = make_reader(source)
        writer = Writer(copy)
        writer.start(profile="", library=drive.LIBRARY)
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        channels: dict[str, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.topic not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            at_s = (message.log_time - START_NS) / 1e9
            if not any(channel.topic in gap.topics and gap.from_s <= at_s < gap.until_s for gap in gaps):
                writer.add_message(
                    channels[channel.topic], message.log_time, message.data, message.publish_time, message.sequence
                )
        writer.finish()


def main() -> None:
    """Makes the logs asked for, or all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(LOGS)}; all of them if none is given")
    parser.add_argument("-o", "--output", type=Path, default=LOG_FOLDER, metavar="FOLDER")
    arguments = parser.parse_args()
    if unknown := [name for name in arguments.names if name not in LOGS]:
        parser.error(f"there is no golden log {unknown[0]!r}; there are {', '.join(LOGS)}")
    arguments.output.mkdir(parents=True, exist_ok=True)
    for name in arguments.names or LOGS:
        path = arguments.output / f"{name}.mcap"
        LOGS[name](path)
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
