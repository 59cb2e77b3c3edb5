"""A recording copied, message by message, into an output: behind `--merge`."""

from pathlib import Path

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from replay.errors import LogError


def copy_recording(path: Path, writer: Writer) -> None:
    """Writes all that a recording holds into `writer`: messages with their times, attachments, metadata.

    One record at a time, so memory does not grow with the recording. Raises LogError if it turns out to be damaged.
    """
    schemas: dict[int, int] = {0: 0}  # id in the recording -> id in the output; 0 is "no schema"
    channels: dict[int, int] = {}
    with path.open("rb") as stream:
        records = StreamReader(stream, validate_crcs=True).records
        while True:
            try:
                record = next(records, None)
            except OSError:
                raise
            except Exception as error:  # what mcap raises on damage has no common base
                raise LogError(f"{path} is damaged ({error!r}) and cannot be merged") from error
            match record:
                case None:
                    return
                case Schema() if record.id not in schemas:
                    schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
                case Channel() if record.id not in channels:
                    channels[record.id] = writer.register_channel(
                        record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                    )
                case Message():
                    writer.add_message(
                        channels[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence
                    )
                case Attachment():
                    writer.add_attachment(
                        record.create_time, record.log_time, record.name, record.media_type, record.data
                    )
                case Metadata():
                    writer.add_metadata(record.name, record.metadata)
