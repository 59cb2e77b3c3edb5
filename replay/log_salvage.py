"""What is left of a damaged MCAP file: every intact chunk, wherever it is, found by its own lengths and CRC.

A first pass walks from record to record. Where one is not what it claims to be, it looks byte by byte for the next
that is. What it found, by place and time, is what is read afterwards.
"""

import heapq
import re
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from replay.errors import one_line
from replay.file_bytes import FileBytes
from replay.logged_message import ChannelInfo, LoggedSchema, RawMessage
from replay.mcap_records import (
    MAGIC,
    MESSAGE,
    PRIVATE,
    RECORD,
    DamageError,
    begins_as_chunk,
    chunk_content,
    chunk_head,
    crc_of,
    declared,
    parsed,
    record_at,
    records_in,
)
from replay.message_order import in_time_order, log_time, reordered

# Records whose fields say how long they are; of the others only what follows tells whether their length is right.
_KINDS: dict[int, type[McapRecord]] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.MESSAGE_INDEX: MessageIndex,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA: Metadata,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
    Opcode.DATA_END: DataEnd,
}
_LONGEST = 1 << 26  # of a record that has to be read to be believed
_ONLY_IN_SUMMARY = tuple(
    bytes([opcode])
    for opcode in (
        Opcode.FOOTER,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.STATISTICS,
        Opcode.METADATA_INDEX,
        Opcode.SUMMARY_OFFSET,
    )
)
# Where a record may begin: an opcode and a length below 4 GiB; or the magic before and behind a recording.
_PERHAPS = re.compile(rb"(?=[\x01-\x0f].{4}\x00{4})|(?=" + re.escape(MAGIC) + rb")", re.DOTALL)
_IN_A_ROW = 2  # so many records, each where the one before it ends, are no accident
_NEAR_NS = 60_000_000_000
_EFFORT = 50  # times its size: so much of a file is read in search of records; more would be somebody's trap
_KEPT_NOTES = 200
_NAMED = 8  # topics in a note


@dataclass
class Losses:
    """What `--salvage` could not read."""

    chunks: int = 0
    notes: list[str] = field(default_factory=list)


class _Extent(NamedTuple):
    """An intact chunk, or a run of messages outside of chunks."""

    at: int
    end: int
    part: int
    start_ns: int  # of the messages themselves
    end_ns: int


class _Place(NamedTuple):
    """A channel's number, and the recording it counts in: a file may be several, one behind the other."""

    part: int
    channel: int


_Declared = tuple[str, LoggedSchema, str]  # topic, schema, encoding


class SalvagedFile:
    """A damaged MCAP file; bad chunks are left out and counted once, and what remains is in log-time order.

    A topic may be declared in a chunk that is lost, and again in the summary at the end, so the file is walked through
    before anything is read.
    """

    def __init__(self, path: Path, losses: Losses):
        self._path = path
        survey = _Survey()
        if path.stat().st_size == 0:
            survey.note("the file is empty")
        else:
            with _viewed(path) as view:
                survey.walk(view)
        counts = survey.conclude()
        losses.chunks += survey.bad_chunks
        losses.notes += [f"{path.name}: {note}" for note in survey.notes]
        self._chunks = sorted(survey.chunks, key=lambda chunk: (chunk.start_ns, chunk.at))
        self._runs = survey.runs
        self._declared = {place: found for place in counts if (found := survey.declared(place)) is not None}
        self.channels = tuple(ChannelInfo(*found, counts[place]) for place, found in self._declared.items())
        extents = self._chunks + self._runs
        self.start_ns = min((extent.start_ns for extent in extents), default=0)
        self.end_ns = max((extent.end_ns for extent in extents), default=0)

    def messages(
        self, topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[RawMessage]:
        """Yields the messages of some topics, start_ns <= log time < end_ns, in log-time order."""

        def wanted(extents: list[_Extent]) -> Iterator[_Extent]:
            for extent in extents:
                if (start_ns is None or extent.end_ns >= start_ns) and (end_ns is None or extent.start_ns < end_ns):
                    yield extent

        with _viewed(self._path) as view:
            chunks = ((chunk.start_ns, self._inside(view, chunk)) for chunk in wanted(self._chunks))
            loose = (message for run in wanted(self._runs) for message in self._along(view, run))
            for message in heapq.merge(in_time_order(chunks), reordered(loose), key=log_time):
                if (
                    (topics is None or message.topic in topics)
                    and (start_ns is None or message.log_time_ns >= start_ns)
                    and (end_ns is None or message.log_time_ns < end_ns)
                ):
                    yield message

    def _inside(self, view: FileBytes, chunk: _Extent) -> Iterator[RawMessage]:
        content = chunk_content(view, chunk_head(view, chunk.at))
        for opcode, begin, end in records_in(content):
            if opcode == Opcode.MESSAGE:
                yield from self._message(chunk.part, content[begin:end])

    def _along(self, view: FileBytes, run: _Extent) -> Iterator[RawMessage]:
        at = run.at
        while at < run.end:
            opcode, end = record_at(view, at)
            if opcode == Opcode.MESSAGE:
                yield from self._message(run.part, view[at + RECORD.size : end])
            at = end

    def _message(self, part: int, body: bytes) -> Iterator[RawMessage]:
        channel, _, log_time_ns, _ = MESSAGE.unpack_from(body)
        if (found := self._declared.get(_Place(part, channel))) is not None:
            topic, schema, encoding = found
            yield RawMessage(topic, log_time_ns, schema, encoding, body[MESSAGE.size :])


@contextmanager
def _viewed(path: Path) -> Iterator[FileBytes]:
    with path.open("rb") as stream:
        yield FileBytes(stream)


class _Survey:
    """What a walk through a file finds."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.bad_chunks = 0
        self.chunks: list[_Extent] = []
        self.runs: list[_Extent] = []
        self._unkept_notes = 0
        self._inside: Counter[_Place] = Counter()  # messages in chunks
        self._outside: Counter[_Place] = Counter()  # messages outside
        self._channels: dict[_Place, tuple[bool, Channel]] = {}  # whether under a CRC, and the declaration
        self._schemas: dict[_Place, tuple[bool, Schema]] = {}
        self._recorded: dict[int, int] = {}  # part -> messages by its statistics
        self._seen: set[tuple[int, int, int, int]] = set()  # what tells a chunk from others
        self._part, self._part_at = 0, 0
        self._chunked: set[int] = set()  # parts in which a damaged chunk has been
        self._closed = False  # the last record was the end of a recording
        self._summary_at = 0
        self._in_summary: list[Channel | Schema] = []

    def note(self, text: str) -> None:
        """Keeps what is to be said of a loss; of very many the first."""
        if len(self.notes) < _KEPT_NOTES:
            self.notes.append(text)
        else:
            self._unkept_notes += 1

    # --- walking -----------------------------------------------------------------------------------------------------

    def walk(self, view: FileBytes) -> None:
        """Goes from record to record through the file."""
        self._view = view
        self._effort = _EFFORT * len(view) + _LONGEST
        self._ends_well = view[-len(MAGIC) :] == MAGIC
        at: int | None = 0
        last = 0
        while at is not None and at < len(view):
            last = at
            if self._effort < 0:
                self.note(f"so much is damaged that the search was given up at byte {at}")
                return
            at = self._step(at)
        if at is None or not self._closed:
            self.note(f"nothing readable after byte {last}")

    def _step(self, at: int) -> int | None:
        """Takes what is at an offset; returns where to go on, None if there is nothing more."""
        if self._view[at : at + len(MAGIC)] == MAGIC:
            return self._magic(at)
        if at == 0:
            self.note("it does not begin as an MCAP file does")
        was_closed, self._closed = self._closed, False
        try:
            opcode, end = record_at(self._view, at)
            if opcode == Opcode.CHUNK:
                return self._chunk(at)
            if opcode in _KINDS:
                record = self._parsed(opcode, at, end)
                following = self._behind(at, end)
                self._take(record, at, end)
                return end + len(MAGIC) if self._closed else following
            if opcode == Opcode.MESSAGE:
                following = self._behind(at, end)
                self._message(at, end)
                return following
            if opcode == Opcode.ATTACHMENT or opcode >= PRIVATE:
                return self._behind(at, end)
            raise DamageError("its header makes no sense")
        except DamageError as error:
            opcode = self._view[at]
            self.bad_chunks += opcode == Opcode.CHUNK
            if begins_as_chunk(self._view, at):
                self._chunked.add(self._part)
            what = "chunk" if opcode == Opcode.CHUNK else "what stands behind the end," if was_closed else "record"
            self.note(f"{what} at byte {at} is damaged ({error})")
            return self._beyond(at)

    def _magic(self, at: int) -> int:
        """Takes the magic in front of a recording, which is a part of the file."""
        if at > 0:
            self.note(f"another recording begins at byte {at}")
        self._part, self._part_at, self._closed = self._part + 1, at, False
        return at + len(MAGIC)

    def _beyond(self, at: int) -> int | None:
        """Returns where the next record begins behind the damaged one at an offset.

        A chunk of which nothing but the content is wrong is stepped over, unless another, wholly intact one lies in it.
        """
        stop = None
        try:
            head = chunk_head(self._view, at) if self._view[at] == Opcode.CHUNK else None
            if head is not None and head.is_whole and self._follows(head.end):
                stop = head.end
        except DamageError:
            pass
        place = at
        while (found := self._view.search(_PERHAPS, place + 1)) is not None:
            place = found
            if stop is not None and place >= stop:
                return stop
            if self._effort < 0:
                return place
            if self._is_chunk(place) if stop is not None else self._begins(place):
                return place
        return stop

    def _begins(self, at: int) -> bool:
        """Tells whether what is at an offset is so much like a record that it will be one."""
        if self._view[at : at + len(MAGIC)] == MAGIC:
            return True
        try:
            opcode, end = record_at(self._view, at)
            if opcode == Opcode.CHUNK:
                return chunk_head(self._view, at).is_whole
            if opcode in _KINDS:
                self._parsed(opcode, at, end)
            elif opcode != Opcode.MESSAGE or end - at < RECORD.size + MESSAGE.size:
                return False
            elif self._is_near(at):
                return True
        except DamageError:
            return False
        return self._follows(end, _IN_A_ROW)

    def _is_near(self, at: int) -> bool:
        """Tells whether what may be a message has the two times of one.

        It was published about when it was logged, or is of a known channel and of the time of the messages before it.
        """
        channel, _, log_time_ns, published_ns = MESSAGE.unpack(self._body_head(at))
        if log_time_ns > 0 and abs(published_ns - log_time_ns) < _NEAR_NS:
            return True
        known = _Place(self._part, channel) in self._channels
        return known and bool(self.runs) and abs(log_time_ns - self.runs[-1].end_ns) < _NEAR_NS

    def _body_head(self, at: int) -> bytes:
        """Returns what would stand before a message's data."""
        return self._view[at + RECORD.size : at + RECORD.size + MESSAGE.size]

    def _is_chunk(self, at: int) -> bool:
        """Tells whether there is a chunk at an offset whose CRC proves it."""
        if self._view[at] != Opcode.CHUNK:
            return False
        try:
            head = chunk_head(self._view, at)
            if not head.is_whole or not head.crc:
                return False
            self._effort -= head.end - at
            chunk_content(self._view, head)
        except DamageError:
            return False
        return True

    def _holds_another(self, at: int, end: int) -> bool:
        """Tells whether a chunk seems to begin between the beginning and the end of one."""
        while (found := self._view.search(_PERHAPS, at + 1, end + RECORD.size)) is not None and found < end:
            at = found
            if self._view[at] == Opcode.CHUNK and self._begins(at):
                return True
        return False

    def _follows(self, at: int, records: int = 1) -> bool:
        """Tells whether records go on at an offset, or whether the file ends there, or is cut in one of them."""
        for _ in range(records):
            if self._view[at : at + len(MAGIC)] == MAGIC:
                return True
            if at + RECORD.size > len(self._view):
                return not self._ends_well
            opcode, length = RECORD.unpack(self._view[at : at + RECORD.size])
            if not (1 <= opcode <= max(Opcode) or opcode >= PRIVATE) or length >> 32:
                return False
            at += RECORD.size + length
            if at > len(self._view):
                return not self._ends_well
        return True

    # --- records -----------------------------------------------------------------------------------------------------

    def _chunk(self, at: int) -> int | None:
        """Takes the chunk at an offset; returns where to go on. Raises DamageError if it is not what was written."""
        head = chunk_head(self._view, at)
        if not head.is_whole and not head.crc:
            raise DamageError("its lengths contradict each other")
        self._effort -= head.end - at
        content = chunk_content(self._view, head)
        counts: Counter[_Place] = Counter()
        declarations: list[Channel | Schema] = []
        times = []
        for opcode, begin, end in records_in(content):
            match opcode:
                case Opcode.MESSAGE:
                    channel, _, log_time_ns, _ = MESSAGE.unpack_from(content, begin)
                    counts[_Place(self._part, channel)] += 1
                    times.append(log_time_ns)
                case Opcode.CHANNEL:
                    declarations.append(parsed(Channel, content[begin:end]))
                case Opcode.SCHEMA:
                    declarations.append(parsed(Schema, content[begin:end]))
        if not head.crc and not self._follows(head.end) and self._holds_another(at, head.end):
            raise DamageError("another chunk begins in it")
        key = (head.start_ns, head.end_ns, len(content), zlib.crc32(content))
        for record in declarations:
            self._declare(record, guarded=bool(head.crc))
        if times and key in self._seen:
            self.note(f"chunk at byte {at} is a copy of one before it")
        elif times:
            self.chunks.append(_Extent(at, head.end, self._part, min(times), max(times)))
            self._inside += counts
        self._seen.add(key)
        # where the two lengths differ, one of them is wrong, though the content is not
        ends = (end for end in sorted((head.record_end, head.end)) if self._follows(end))
        return head.end if head.is_whole else next(ends, None) or self._beyond(at)

    def _parsed(self, opcode: int, at: int, end: int) -> McapRecord:
        if end - at > _LONGEST:
            raise DamageError(f"it claims {end - at} bytes")
        self._effort -= end - at
        return parsed(_KINDS[opcode], self._view[at + RECORD.size : end], exact=True)

    def _behind(self, at: int, end: int) -> int | None:
        """Returns where to go on behind a record; raises DamageError if another one begins in it."""
        astray = self._view[at] == Opcode.MESSAGE and self._view[end : end + 1] in _ONLY_IN_SUMMARY
        if not astray and self._follows(end, _IN_A_ROW):
            return end
        following = self._beyond(at)
        if following is not None and following < end:
            raise DamageError(f"it claims {end - at} bytes, but another record begins in it")
        if following == end or self._follows(end):
            return end
        self.note(f"record at byte {end} is damaged (its header makes no sense)")
        return following

    def _take(self, record: McapRecord, at: int, end: int) -> None:
        """Keeps what a record outside of chunks says."""
        match record:
            case Channel() | Schema():
                self._declare(record, guarded=False)
                self._in_summary.append(record)
            case Statistics():
                self._recorded[self._part] = record.message_count
            case DataEnd():
                self._check_data(record, at)
                self._summary_at, self._in_summary = end, []
            case Footer():
                if record.summary_crc and crc_of(self._view, self._summary_at, end - 4) == record.summary_crc:
                    for declaration in self._in_summary:
                        self._declare(declaration, guarded=True)
                self._closed = self._view[end : end + len(MAGIC)] == MAGIC

    def _message(self, at: int, end: int) -> None:
        """Keeps a message outside of chunks: alone, or in a row with those before it."""
        if end - at < RECORD.size + MESSAGE.size:
            raise DamageError("it is too short for a message")
        channel, _, log_time_ns, _ = MESSAGE.unpack(self._body_head(at))
        self._outside[_Place(self._part, channel)] += 1
        run = _Extent(at, end, self._part, log_time_ns, log_time_ns)
        if self.runs and self.runs[-1].end == at and self.runs[-1].part == self._part:
            last = self.runs.pop()
            run = last._replace(end=end, start_ns=min(last.start_ns, log_time_ns), end_ns=max(last.end_ns, log_time_ns))
        self.runs.append(run)

    def _check_data(self, record: DataEnd, at: int) -> None:
        """Says so if messages that no chunk guards are not what was written; a file need not have that CRC."""
        loose = any(place.part == self._part for place in self._outside)
        if loose and record.data_section_crc and crc_of(self._view, self._part_at, at) != record.data_section_crc:
            self.note("the CRC of all its data is wrong: messages outside of chunks may not be what was written")

    # --- declarations ------------------------------------------------------------------------------------------------

    def _declare(self, record: Channel | Schema, *, guarded: bool) -> None:
        """Takes a declaration; the first counts, for no number may be declared twice, but one under a CRC before it."""
        place = _Place(self._part, record.id)
        known: dict[_Place, tuple[bool, Channel]] | dict[_Place, tuple[bool, Schema]]
        known = self._channels if isinstance(record, Channel) else self._schemas
        before = known.get(place)
        if before is None or (guarded and not before[0]):
            known[place] = (guarded, record)  # type: ignore[assignment]
        elif before[0] == guarded and before[1] != record:
            what, names = ("channel", "topic") if isinstance(record, Channel) else ("schema", "name")
            name, other = getattr(before[1], names), getattr(record, names)
            self.note(one_line(f"{what} {record.id} is declared twice, as {name!r}, which is used, and as {other!r}"))

    def declared(self, place: _Place) -> _Declared | None:
        """Returns what is known of a channel; None if nothing is.

        Of a part that has lost its own declaration, that of the others counts if they agree.
        """
        if place in self._channels:
            return self._described(place)
        others = {self._described(other) for other in self._channels if other.channel == place.channel}
        return others.pop() if len(others) == 1 else None

    def _described(self, place: _Place) -> _Declared:
        _, channel = self._channels[place]
        _, schema = self._schemas.get(_Place(place.part, channel.schema_id), (False, None))
        return declared(channel, schema)

    def conclude(self) -> Counter[_Place]:
        """Returns how many messages there are of each channel, and notes what is missing."""
        chunked = self._chunked | {place.part for place in self._inside}
        loose = Counter({place: count for place, count in self._outside.items() if place.part in chunked})
        if loose:
            # a damaged opcode makes a message of an index, and inside of a damaged chunk there are damaged messages
            self.note(f"{loose.total()} messages outside of chunks, which nothing guards, are left out")
            self.runs = [run for run in self.runs if run.part not in chunked]
            self._outside -= loose
        counts = self._inside + self._outside
        recorded = sum(self._recorded.values())
        if not self.notes and counts.total() < recorded:
            # a damaged record header hides a whole chunk without a trace of it
            self.note(f"{recorded - counts.total()} of {recorded} recorded messages are missing")
        if undeclared := sum(count for place, count in counts.items() if self.declared(place) is None):
            self.note(f"{undeclared} messages of topics whose declaration is lost")
        unproved = [place for place in counts if place in self._channels and not self._channels[place][0]]
        if self.notes and unproved:
            names = ", ".join(sorted({self._channels[place][1].topic for place in unproved})[:_NAMED])
            self.note(
                f"no CRC guards the declaration of {len(unproved)} topics, which may be misnamed: {one_line(names)}"
            )
        if self._unkept_notes:
            self.notes.append(f"{self._unkept_notes} more places are damaged")
        return counts
