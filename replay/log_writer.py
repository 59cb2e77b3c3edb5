"""Results out: a sidecar MCAP that anybody's tools can read, byte-identical for equal inputs, settings and weights.

Written as NAME.part and renamed when it is whole. It holds no clock, no path and no random number.
"""

import contextlib
import errno
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from replay.errors import OutputError
from replay.frame_result import FrameResult
from replay.merge import copy_recording
from replay.scene_update import scene_update_bytes
from schemas import codec, topics
from schemas.messages import PredictionFrame, TrackFrame, VehiclePose
from schemas.topics import Topic

CHUNK_BYTES = 1 << 20  # in LZ4: zstd makes the file a third smaller and costs about 0.5 ms a frame


class LogWriter:
    """Writes one FrameResult after the other; a context manager.

    On a clean end, and on Ctrl-C, the file is closed and takes its final name. After any other error it stays as
    NAME.part. Raises OutputError if the file cannot be written.

    Args:
        path: the output.
        merge: recordings to copy into it when it is closed; nothing of them is changed.
    """

    def __init__(self, path: Path, merge: Sequence[Path] = ()):
        self._path = path
        self._merge = merge
        self._part = path.with_name(path.name + ".part")
        self._lineage: Mapping[str, str] = {}
        self._settings = b""
        self._channels: dict[str, int] = {}
        self._sequence = 0
        self._last_ns = 0
        try:
            if path.is_dir():
                raise IsADirectoryError(errno.EISDIR, "Is a directory")
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream: IO[bytes] = self._part.open("wb")
        except OSError as error:
            raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._guarded(lambda: self._writer.start(profile="", library="pcgan"))
        for topic, message_type in _OUTPUTS:
            self._register(topic, message_type)

    def write(self, result: FrameResult) -> None:
        """Appends the frame's tracks, vehicle pose, predictions and drawing, at the frame's log time."""
        self._put(topics.TRACKS, result.log_time_ns, codec.encode(result.tracks))
        self._put(topics.VEHICLE_POSE, result.log_time_ns, codec.encode(result.vehicle_pose))
        self._put(topics.PREDICTIONS, result.log_time_ns, codec.encode(result.predictions))
        self._put(topics.SCENE, result.log_time_ns, scene_update_bytes(result))
        self._sequence += 1
        self._last_ns = result.log_time_ns

    def describe(self, lineage: Mapping[str, str], settings: bytes) -> None:
        """Sets what goes into the metadata record "pcgan" and the attachment settings.json when the file is closed."""
        self._lineage, self._settings = lineage, settings

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        whole = error is None or isinstance(error, KeyboardInterrupt)
        try:
            if whole:
                for recording in self._merge:
                    copy_recording(recording, self._writer)
            self._finish()
            if whole:
                self._part.replace(self._path)
        except OSError as failure:
            if whole:  # else the first error is the one to hear about
                raise OutputError(f"{self._path} could not be finished: {failure.strerror or failure}") from failure
        finally:
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
        if self._lineage:
            self._writer.add_metadata("pcgan", dict(sorted(self._lineage.items())))
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def _register(self, topic: Topic, message_type: type[Message]) -> None:
        schema = self._writer.register_schema(
            message_type.DESCRIPTOR.full_name,
            "protobuf",
            build_file_descriptor_set(message_type).SerializeToString(deterministic=True),
        )
        self._channels[topic.name] = self._writer.register_channel(topic.name, "protobuf", schema)

    def _put(self, topic: Topic, log_time_ns: int, data: bytes) -> None:
        self._guarded(
            lambda: self._writer.add_message(
                self._channels[topic.name], log_time_ns, data, publish_time=log_time_ns, sequence=self._sequence
            )
        )

    def _guarded(self, write: Callable[[], object]) -> None:
        try:
            write()
        except OSError as error:
            raise OutputError(f"{self._path} cannot be written: {error.strerror or error}") from error


_OUTPUTS: tuple[tuple[Topic, type[Message]], ...] = (
    (topics.TRACKS, codec.protobuf_type(TrackFrame)),
    (topics.VEHICLE_POSE, codec.protobuf_type(VehiclePose)),
    (topics.PREDICTIONS, codec.protobuf_type(PredictionFrame)),
    (topics.SCENE, SceneUpdate),
)
