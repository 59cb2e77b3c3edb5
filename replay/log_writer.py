"""Results out: a sidecar MCAP that anybody's tools can read, byte-identical for equal inputs, settings and weights.

Written as NAME.part and renamed when it is whole. It holds no clock, no path and no random number.

FORMATS says what can be written: pcgan (our protobuf messages), foxglove (a drawing), autoware (ROS 2). A file of ROS 2
messages alone has MCAP's profile ros2, so that rosbag2 opens it.
"""

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from replay import autoware
from replay.errors import OutputError
from replay.frame_result import FrameResult
from replay.logged_message import LoggedSchema
from replay.merge import Recordings
from replay.part_file import open_part, part_of
from replay.scene_update import scene_update_bytes
from schemas import codec, topics
from schemas.topics import Topic

CHUNK_BYTES = 1 << 20  # in LZ4: zstd makes the file a third smaller and costs about 0.5 ms a frame
DEFAULT_FORMATS = ("pcgan", "foxglove")


@dataclass(frozen=True)
class Output:
    """A topic of the output, and what it says about a frame."""

    topic: Topic
    encoding: str
    encode: Callable[[FrameResult], bytes]

    def schema(self) -> LoggedSchema:
        """Returns the definition that travels inside the file."""
        name = self.topic.message
        if self.encoding == MessageEncoding.CDR:
            return LoggedSchema(name, SchemaEncoding.ROS2, autoware.definition(name).encode())
        message_type = _PROTOBUF[name]
        definition = build_file_descriptor_set(message_type).SerializeToString(deterministic=True)
        return LoggedSchema(message_type.DESCRIPTOR.full_name, SchemaEncoding.Protobuf, definition)


def outputs(formats: Sequence[str]) -> tuple[Output, ...]:
    """Returns what is written in some formats, in the order of FORMATS; raises OutputError if one is unknown."""
    if unknown := [name for name in formats if name not in FORMATS]:
        raise OutputError(f"there is no output format {unknown[0]!r}; known are {', '.join(FORMATS)}")
    if not formats:
        raise OutputError(f"no output format given; known are {', '.join(FORMATS)}")
    return tuple(output for name, members in FORMATS.items() if name in formats for output in members)


class LogWriter:
    """Writes one FrameResult after the other; a context manager.

    On a clean end, and on Ctrl-C, the file is closed and takes its final name. After any other error it stays as
    NAME.part. Raises OutputError if the file cannot be written, or if another process is writing it.

    Of merged recordings everything is copied; after Ctrl-C, or if `describe` says that the end came early, messages up
    to the last frame only, since the rest may take long.

    Args:
        path: the output.
        merge: recordings to copy into it, each message before the first of ours that is later; nothing of them is
            changed, and what their headers said goes into the metadata record "pcgan".
        emit: formats to write, of FORMATS.
    """

    def __init__(self, path: Path, merge: Sequence[Path] = (), emit: Sequence[str] = DEFAULT_FORMATS):
        self._outputs = outputs(emit)
        self._path = path
        self._part = part_of(path)
        self._recordings = Recordings(merge)
        self._lineage = {"merged": self._recordings.origins} if merge else {}
        self._settings = b""
        self._complete = True
        self._channels: dict[str, int] = {}
        self._sequence = 0
        self._last_ns = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream: IO[bytes] = open_part(path)
        except OSError as error:
            raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        with self._writing():
            self._writer.start(profile="ros2" if self._is_ros2 else "", library="pcgan")
            for output in self._outputs:
                self._register(output)
            self._recordings.start(self._writer)

    @property
    def _is_ros2(self) -> bool:
        """True if every message of the file will be one of ROS 2."""
        return self._recordings.all_ros2 and all(output.encoding == MessageEncoding.CDR for output in self._outputs)

    def write(self, result: FrameResult) -> None:
        """Appends what is said about a frame, at the frame's log time, behind what was recorded up to then."""
        at_ns = result.log_time_ns
        with self._writing():
            self._recordings.copy(self._writer, until_ns=at_ns)
        for output in self._outputs:
            data = output.encode(result)
            with self._writing():
                self._writer.add_message(self._channels[output.topic.name], at_ns, data, at_ns, self._sequence)
        self._sequence += 1
        self._last_ns = at_ns

    def describe(self, lineage: Mapping[str, str], settings: bytes, *, complete: bool = True) -> None:
        """Sets what goes into the metadata record "pcgan" and the attachment settings.json when the file is closed."""
        self._lineage, self._settings, self._complete = {**self._lineage, **lineage}, settings, complete

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        whole = error is None or isinstance(error, KeyboardInterrupt)
        try:
            if whole:
                complete = self._complete and error is None
                self._recordings.finish(self._writer, None if complete else self._last_ns)
            self._finish()
            if whole:
                self._part.replace(self._path)
        except OSError as failure:
            if whole:  # else the first error is the one to hear about
                raise OutputError(f"{self._path} could not be finished: {failure.strerror or failure}") from failure
        finally:
            self._recordings.close()
            with contextlib.suppress(OSError):  # on a full disk closing fails again, with nothing new to say
                self._stream.close()

    def _finish(self) -> None:
        if self._settings:
            self._writer.add_attachment(
                create_time=self._last_ns,
                log_time=self._last_ns,
                name="settings.json",
                media_type="application/json",
                data=self._settings,
            )
        if self._is_ros2 and not self._recordings.named_qos and not self._recordings.holds_metadata("rosbag2"):
            # with no such record rosbag2 takes the file for one of its newest version and looks for QoS by name
            self._writer.add_metadata("rosbag2", {"serialized_metadata": ""})
        if self._lineage:
            self._writer.add_metadata("pcgan", dict(sorted(self._lineage.items())))
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def _register(self, output: Output) -> None:
        schema = self._writer.register_schema(*output.schema())
        metadata = {}
        if output.encoding == MessageEncoding.CDR:
            metadata = autoware.channel_metadata(output.topic.message, named_qos=self._recordings.named_qos)
        name = output.topic.name
        self._channels[name] = self._writer.register_channel(name, output.encoding, schema, metadata)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(f"{self._path} cannot be written: {error.strerror or error}") from error


def _ground_m(result: FrameResult) -> float:
    return float(result.sensors.map_from_vehicle[2, 3])


_PROTOBUF: dict[str, type[Message]] = {
    **{message_type.__name__: codec.protobuf_type(message_type) for message_type in codec.MESSAGE_TYPES.values()},
    topics.SCENE.message: SceneUpdate,
}
FORMATS: Mapping[str, tuple[Output, ...]] = {
    "pcgan": (
        Output(topics.TRACKS, MessageEncoding.Protobuf, lambda result: codec.encode(result.tracks)),
        Output(topics.VEHICLE_POSE, MessageEncoding.Protobuf, lambda result: codec.encode(result.vehicle_pose)),
        Output(topics.PREDICTIONS, MessageEncoding.Protobuf, lambda result: codec.encode(result.predictions)),
    ),
    "foxglove": (Output(topics.SCENE, MessageEncoding.Protobuf, scene_update_bytes),),
    "autoware": (
        Output(
            autoware.TRACKED_OBJECTS,
            MessageEncoding.CDR,
            lambda result: autoware.tracked_objects(result.tracks, _ground_m(result)),
        ),
        Output(
            autoware.PREDICTED_OBJECTS,
            MessageEncoding.CDR,
            lambda result: autoware.predicted_objects(result.tracks, result.predictions, _ground_m(result)),
        ),
    ),
}
