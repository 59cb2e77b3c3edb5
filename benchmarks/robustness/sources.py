"""The recordings that are damaged: one short drive in every form that we read, small enough to replay in 50 ms."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from benchmarks.robustness.mcap_map import McapMap, read_map
from replay import PredictorChoice, Replay, record
from replay.simulator import simulate
from tests.replay import foreign_foxglove, foreign_ros

CHUNK_BYTES = 1500  # a dozen chunks or so
LENGTH_S = 0.7  # long enough for people to be tracked and predicted
CAMERAS = ("A0", "A1")  # of six; more would only be more of the same


class Record(NamedTuple):
    """A message with everything a file says about it."""

    topic: str
    schema: tuple[str, str, bytes]  # name, encoding, definition
    encoding: str
    log_time_ns: int
    data: bytes


@dataclass(frozen=True)
class Source:
    """An intact recording."""

    name: str
    map: McapMap
    records: tuple[Record, ...]
    guarded: bool = True  # every message is under a CRC
    output: bool = False  # of a replay: to be exported, not to be replayed


_NONE, _LZ4, _ZSTD = CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD
_Rewrite = Callable[[Path, Path], Path]
_ours = None
_KINDS: dict[str, tuple[_Rewrite | None, dict[str, object]]] = {
    "pcgan, zstd": (_ours, {"compression": _ZSTD}),
    "pcgan, lz4": (_ours, {"compression": _LZ4}),
    "pcgan, uncompressed": (_ours, {"compression": _NONE}),
    "pcgan, no message index": (_ours, {"compression": _NONE, "index_types": IndexType.ALL & ~IndexType.MESSAGE}),
    "pcgan, no CRCs": (_ours, {"compression": _NONE, "enable_crcs": False}),
    "pcgan, no chunks": (_ours, {"use_chunking": False}),
    "pcgan, no chunks, data CRC": (_ours, {"use_chunking": False, "enable_data_crcs": True}),
    "ROS 2, CDR": (foreign_ros.as_ros2, {"compression": _ZSTD}),
    "ROS 1": (foreign_ros.as_ros1, {"compression": _LZ4}),
    "Foxglove protobuf": (foreign_foxglove.as_foxglove, {"compression": _ZSTD}),
    "Foxglove JSON": (foreign_foxglove.as_foxglove_json, {"compression": _LZ4}),
}
OUTPUT = "output of a replay"
UNGUARDED = ("pcgan, no CRCs", "pcgan, no chunks", "pcgan, no chunks, data CRC")


def make_sources(folder: Path) -> list[Source]:
    """Writes every kind of recording into a folder."""
    whole, drive = folder / "whole.mcap", folder / "drive.mcap"
    simulate(whole, clip=None, vehicle=None, pedestrians=3, duration_s=LENGTH_S, seed=4)
    write(drive, (record for record in read(whole) if "gmsl" not in record.topic or record.topic[6:8] in CAMERAS))
    sources = []
    for number, (name, (rewrite, options)) in enumerate(_KINDS.items()):
        form = drive if rewrite is None else rewrite(drive, folder / f"form{number}.mcap")
        records = tuple(read(form))
        path = write(folder / f"source{number}.mcap", records, **options)
        sources.append(Source(name, read_map(path.read_bytes()), records, name not in UNGUARDED))
    record(
        Replay([drive], None, PredictorChoice("inline")), folder / "out.mcap", emit=("pcgan", "foxglove", "autoware")
    )
    records = tuple(read(folder / "out.mcap"))
    path = write(folder / "source_out.mcap", records)
    sources.append(Source(OUTPUT, read_map(path.read_bytes()), records, output=True))
    return sources


def read(path: Path) -> Iterable[Record]:
    """Yields what a file holds, by mcap's own reader."""
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            yield Record(
                channel.topic,
                (schema.name, schema.encoding, schema.data),
                channel.message_encoding,
                message.log_time,
                message.data,
            )


def write(path: Path, records: Iterable[Record], **options: object) -> Path:
    """Writes messages in the order given; options are of mcap's writer."""
    schemas: dict[tuple[str, str, bytes], int] = {}
    channels: dict[tuple[str, tuple[str, str, bytes], str], int] = {}
    with path.open("wb") as stream:
        writer = Writer(stream, **{"chunk_size": CHUNK_BYTES, **options})  # type: ignore[arg-type]
        writer.start(profile="", library="robustness")
        for topic, schema, encoding, log_time_ns, data in records:
            if schema not in schemas:
                schemas[schema] = writer.register_schema(*schema)
            if (topic, schema, encoding) not in channels:
                channels[topic, schema, encoding] = writer.register_channel(topic, encoding, schemas[schema])
            writer.add_message(channels[topic, schema, encoding], log_time_ns, data, log_time_ns)
        writer.finish()
    return path
