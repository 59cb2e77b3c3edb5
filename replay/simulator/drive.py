"""Streams a simulated drive into an MCAP file, message by message in order of log time.

Every stamp comes from the simulated sensors and a fixed start, never from the clock: the same arguments give the same
bytes. Memory does not grow with the drive's length: what is held back is only what has not reached the log yet.
"""

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration as FoxgloveCalibration
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms as FoxgloveTransforms
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud as FoxglovePointCloud
from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from replay.simulator.motion import Motion, SimulationError
from replay.simulator.rig import Rig, campus_rig
from replay.simulator.sensor_model import SensorModelV1
from replay.simulator.sensor_suite import (
    CLUSTERS_TOPIC,
    GROUND_TRUTH_TOPIC,
    NS_PER_S,
    ODOMETRY_TOPIC,
    POINTS_TOPIC,
    START_NS,
    TF_STATIC_TOPIC,
    TF_TOPIC,
    SensorSuite,
)
from schemas import codec
from schemas.messages import CameraDetections, GroundTruthFrame, LidarClusters, VehiclePose

METADATA = "pcgan.simulation"
LIBRARY = "pcgan simulate"

Progress = Callable[[float], None]


@dataclass(frozen=True)
class DriveSummary:
    """What a simulated drive holds."""

    output: Path
    motion: str
    duration_s: float
    scans: int
    pedestrians: int  # different people within the ground truth's range
    messages: dict[str, int]  # per topic


def simulate(
    motion: Motion,
    output: Path,
    seed: int,
    *,
    duration_s: float | None = None,
    settings: dict[str, object] | None = None,
    model: SensorModelV1 | None = None,
    points: bool = False,
    progress: Progress | None = None,
) -> DriveSummary:
    """Writes a drive through a motion and returns what it holds.

    Args:
        motion: who is where.
        output: the file; written as NAME.part beside it and renamed when complete, removed if anything goes wrong.
        seed: of all sensor randomness; not negative.
        duration_s: stops earlier than the motion.
        settings: what the motion was made from, for the metadata record "pcgan.simulation".
        points: the LiDAR's raw points, too, on a topic of their own; no other message changes.
        progress: called now and then with the fraction that is done.

    Raises SimulationError for a seed or a folder that cannot be; OSError if writing fails.
    """
    if seed < 0:
        raise SimulationError(f"a seed must be 0 or more, got {seed}")
    if not output.parent.is_dir():
        raise SimulationError(f"cannot write {output}: there is no folder {output.parent}")
    duration = motion.duration_s if duration_s is None else min(duration_s, motion.duration_s)
    partial = output.with_name(f"{output.name}.part")
    sensors = model or SensorModelV1()
    metadata = {
        "motion": motion.name,
        "seed": str(seed),
        "duration_s": repr(duration),
        "settings": json.dumps(settings or {}, sort_keys=True),
        "sensor_model": sensors.to_json(),
        "sensor_model_checksum": sensors.checksum(),
        "sensor_model_version": str(sensors.version),
    }
    try:
        with partial.open("wb") as stream:
            suite = SensorSuite(motion, duration, seed, sensors, campus_rig(), points=points)
            messages = _write(stream, suite, metadata, duration, progress)
        partial.replace(output)
    finally:
        partial.unlink(missing_ok=True)
    return DriveSummary(output, motion.name, duration, suite.scans, len(suite.people), dict(sorted(messages.items())))


def _write(
    stream: BinaryIO, suite: SensorSuite, metadata: dict[str, str], duration_s: float, progress: Progress | None
) -> Counter[str]:
    """Writes all messages of a vehicle's sensors to a stream; returns how many there are per topic."""
    writer = Writer(stream, compression=CompressionType.ZSTD, enable_crcs=True)
    writer.start(profile="", library=LIBRARY)
    writer.add_metadata(METADATA, metadata)
    channels = _register(writer, suite.rig, points=suite.has_points)
    written: Counter[str] = Counter()
    reported = 0
    for logged in suite.logged():
        writer.add_message(
            channels[logged.topic], logged.log_time_ns, logged.data, logged.log_time_ns, written[logged.topic]
        )
        written[logged.topic] += 1
        second = (logged.log_time_ns - START_NS) // NS_PER_S
        if progress is not None and second > reported:
            reported = second
            progress(min(1.0, second / duration_s))
    writer.finish()  # type: ignore[no-untyped-call]
    if progress is not None:
        progress(1.0)
    return written


def _register(writer: Writer, rig: Rig, *, points: bool) -> dict[str, int]:
    """Registers every topic with its schema, in a fixed order; returns the channels' ids."""
    ours: list[tuple[str, type]] = [
        *((f"/gmsl/{camera.name}/detections", CameraDetections) for camera in rig.cameras),
        (CLUSTERS_TOPIC, LidarClusters),
        (ODOMETRY_TOPIC, VehiclePose),
        (GROUND_TRUTH_TOPIC, GroundTruthFrame),
    ]
    topics: list[tuple[str, type[Message]]] = [
        *((topic, codec.protobuf_type(message)) for topic, message in ours),
        *((f"/gmsl/{camera.name}/camera_info", FoxgloveCalibration) for camera in rig.cameras),
        (TF_TOPIC, FoxgloveTransforms),
        (TF_STATIC_TOPIC, FoxgloveTransforms),
        *([(POINTS_TOPIC, FoxglovePointCloud)] if points else []),
    ]
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    for topic, protobuf_type in topics:
        name = protobuf_type.DESCRIPTOR.full_name
        if name not in schemas:
            schemas[name] = register_schema(writer, protobuf_type)
        channels[topic] = writer.register_channel(topic, "protobuf", schemas[name])
    return channels
