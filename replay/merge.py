"""Recordings copied, message by message, into an output: behind `--merge`."""

import heapq
import json
import re
import struct
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import IO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.stream_reader import MAGIC_SIZE
from mcap.summary import Summary
from mcap.writer import Writer

from replay.errors import LogError


class Recordings:
    """Recordings that are being copied into an output, their messages in log-time order as the output grows.

    All that they hold is kept: messages with their times, topics without any, metadata of channels (such as what ROS 2
    publishers offered), attachments and metadata records. Topics that are the same in several files become one. Memory
    is bounded by the chunks that overlap in time.

    Raises LogError if a recording cannot be read, at once or when the damage is met.
    """

    def __init__(self, paths: Sequence[Path]):
        self._recordings = [_Recording(path) for path in paths]
        self._streams = [recording.messages() for recording in self._recordings]
        self._waiting = heapq.merge(*self._streams, key=attrgetter("log_time_ns"))
        self._held: _Copied | None = None  # the first message that is later than what was asked for so far
        self._schemas: dict[tuple[str, str, bytes], int] = {}  # id in the output
        self._channels: dict[tuple[str, str, int, tuple[tuple[str, str], ...]], int] = {}

    @property
    def all_ros2(self) -> bool:
        """True if every recording has the profile ros2 and nothing but CDR in it; also if there are none."""
        return all(each.is_ros2 for each in self._recordings)

    @property
    def named_qos(self) -> bool:
        """True if some topic's QoS policies are written by name, as rosbag2 does since Jazzy, and not by number."""
        offers = (channel.metadata.get("offered_qos_profiles", "") for channel in self._all_channels())
        return any(re.search(r"reliability['\"]?:\s*['\"]?[a-z]", offer) for offer in offers)

    @property
    def origins(self) -> str:
        """What the header of each recording said, as JSON; base names only."""
        return json.dumps(
            [
                {"name": each.path.name, "profile": each.header.profile, "library": each.header.library}
                for each in self._recordings
            ]
        )

    def start(self, writer: Writer) -> None:
        """Declares the recordings' topics in the output, those without messages, too."""
        for recording in self._recordings:
            for channel in sorted(recording.summary.channels.values(), key=attrgetter("id")):
                recording.numbers[channel.id] = self._declared(
                    writer, recording.summary.schemas.get(channel.schema_id), channel
                )

    def copy(self, writer: Writer, until_ns: int | None = None) -> None:
        """Writes the messages up to a log time that are not written yet; all of them if no time is given."""
        copied = self._held or next(self._waiting, None)
        while copied is not None and (until_ns is None or copied.log_time_ns <= until_ns):
            numbers, channel, message = copied.recording.numbers, copied.channel, copied.message
            if channel.id not in numbers:  # the summary does not know it
                numbers[channel.id] = self._declared(writer, copied.schema, channel)
            writer.add_message(
                numbers[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
            copied = next(self._waiting, None)
        self._held = copied

    def finish(self, writer: Writer, until_ns: int | None = None) -> None:
        """Writes the messages that are left, up to a log time if one is given, then attachments and metadata."""
        self.copy(writer, until_ns)
        for recording in self._recordings:
            for record in recording.records_outside_chunks():
                if isinstance(record, Attachment):
                    writer.add_attachment(
                        record.create_time, record.log_time, record.name, record.media_type, record.data
                    )
                else:
                    writer.add_metadata(record.name, record.metadata)

    def close(self) -> None:
        """Closes the recordings; what has not been copied stays uncopied."""
        for stream in self._streams:
            stream.close()

    def holds_metadata(self, name: str) -> bool:
        """Tells whether a recording has a metadata record of that name."""
        return any(index.name == name for each in self._recordings for index in each.summary.metadata_indexes)

    def _all_channels(self) -> Iterator[Channel]:
        for recording in self._recordings:
            yield from recording.summary.channels.values()

    def _declared(self, writer: Writer, schema: Schema | None, channel: Channel) -> int:
        """Returns the output's number of a recording's channel; declares it if that is new."""
        number = 0  # "no schema"
        if schema is not None:
            content = (schema.name, schema.encoding, schema.data)
            if content not in self._schemas:
                self._schemas[content] = writer.register_schema(*content)
            number = self._schemas[content]
        described = (channel.topic, channel.message_encoding, number, tuple(sorted(channel.metadata.items())))
        if described not in self._channels:
            self._channels[described] = writer.register_channel(
                channel.topic, channel.message_encoding, number, dict(channel.metadata)
            )
        return self._channels[described]


class _Copied(NamedTuple):
    """A message on its way."""

    log_time_ns: int
    recording: "_Recording"
    schema: Schema | None
    channel: Channel
    message: Message


@dataclass(eq=False)
class _Recording:
    """One recording, intact and with a summary: a replay has opened it before."""

    path: Path
    header: Header = field(init=False)
    summary: Summary = field(init=False)
    numbers: dict[int, int] = field(default_factory=dict)  # id of a channel here -> its id in the output

    def __post_init__(self) -> None:
        with _named(self.path), self.path.open("rb") as stream:
            reader = SeekingReader(stream, validate_crcs=True)
            summary = reader.get_summary()
            if summary is None:
                raise McapError("no summary section")
            self.header, self.summary = reader.get_header(), summary

    @property
    def is_ros2(self) -> bool:
        encodings = {channel.message_encoding for channel in self.summary.channels.values()}
        return self.header.profile == "ros2" and encodings <= {"cdr"}

    def messages(self) -> Generator[_Copied, None, None]:
        """Yields the messages in log-time order, or as they lie there if the file has no index."""
        with _named(self.path), self.path.open("rb") as stream:
            if self.summary.chunk_indexes:
                messages = SeekingReader(stream, validate_crcs=True).iter_messages()
            else:  # to put them in order, mcap would read them all into memory
                messages = NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False)
            for schema, channel, message in messages:
                yield _Copied(message.log_time, self, schema, channel, message)

    def records_outside_chunks(self) -> Iterator[Attachment | Metadata]:
        """Yields attachments and metadata records; whether they are indexed does not matter."""
        with _named(self.path), self.path.open("rb") as stream:
            stream.seek(MAGIC_SIZE)
            while (head := _head(stream))[0] != Opcode.DATA_END:
                opcode, end = head
                if opcode == Opcode.ATTACHMENT:
                    yield Attachment.read(ReadDataStream(stream))
                elif opcode == Opcode.METADATA:
                    yield Metadata.read(ReadDataStream(stream))
                stream.seek(end)


_RECORD = struct.Struct("<BQ")  # opcode, length of what follows


def _head(stream: IO[bytes]) -> tuple[int, int]:
    """Reads the opcode of the record that begins here, and where it ends."""
    opcode, length = _RECORD.unpack(stream.read(_RECORD.size))
    return opcode, stream.tell() + length


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Turns what goes wrong in reading into a LogError that names the file."""
    try:
        yield
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror or error}") from error
    except Exception as error:  # what mcap raises on damage has no common base
        raise LogError(f"{path} is damaged ({error!r}) and cannot be merged") from error
