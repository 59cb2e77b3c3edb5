"""Tracks and predictions of a recording as Parquet, for people who work with tables.

tracks.parquet has a row per frame and track, predictions.parquet one per frame, track, path and step; `sequence`,
`stamp_ns` and `track_id` join them. Mixtures, if they are wanted, have a row per frame, track, step and component.
Every column says in its metadata what it is and in which unit.
"""

import errno
import importlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from replay.errors import LogError, OutputError, Refusals
from replay.log_reader import LogReader
from schemas import codec, topics
from schemas.codec import CodecError
from schemas.messages import PredictionFrame, TrackFrame
from schemas.topics import Topic

ROW_GROUP_ROWS = 1 << 17  # about 10 MB in memory
BATCH_MESSAGES = 256  # whose rows become one piece of a row group: arrays of a row or two take 50 times their size
Columns = Mapping[str, NDArray[Any]]


class Column(NamedTuple):
    """A column of a table, and what its metadata says."""

    name: str
    type: str  # a type of pyarrow
    unit: str  # empty: none
    meaning: str


_FRAME = (
    Column("sequence", "uint64", "", "number of the frame; the same in all tables, from 0 on in each replay"),
    Column("stamp_ns", "int64", "ns", "stamp of the LiDAR scan, since the Unix epoch"),
)
_STATE = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}
# the upper triangle of a covariance: names as in trajectory files, where in the matrix, unit
_COVARIANCE = {
    f"cov_{a}{b}": ((i, j), ("m²", "m²/s", "m²/s²")[a.startswith("v") + b.startswith("v")])
    for i, a in enumerate(_STATE)
    for j, b in enumerate(_STATE)
    if i <= j
}

TRACK_COLUMNS = (
    *_FRAME,
    Column("epoch", "uint32", "", "counts clock resets; ids are unique within an epoch"),
    Column("frame_id", "string", "", "odometry frame"),
    Column("track_id", "uint64", "", ""),
    *(Column(name, "float64", unit, "state at the stamp, odometry frame") for name, unit in _STATE.items()),
    *(Column(name, "float64", unit, "covariance of the state") for name, (_, unit) in _COVARIANCE.items()),
    Column("existence", "float64", "", "probability that the pedestrian is there"),
    Column("age_s", "float64", "s", "since the first measurement"),
    Column("coasting", "bool_", "", "no measurement is behind this state"),
)
PREDICTION_COLUMNS = (
    *_FRAME,
    Column("frame_id", "string", "", "odometry frame"),
    Column("model", "string", "", "which weights predicted"),
    Column("track_id", "uint64", "", ""),
    Column("fallback", "bool_", "", "extrapolated: the track is too young, or coasting"),
    Column("corridor_probability", "float64", "", "of entering the vehicle's corridor; the same for all paths"),
    Column("corridor_time_s", "float64", "s", "expected time to that, null where it cannot be; the same for all paths"),
    Column("path", "uint32", "", "0 is the likeliest"),
    Column("probability", "float64", "", "of the path; the paths of a prediction sum to 1"),
    Column("step", "uint32", "", "from 1 on; step 0 would be the present state, which is in the tracks"),
    Column("t_s", "float64", "s", "after the stamp"),
    Column("x", "float64", "m", "odometry frame"),
    Column("y", "float64", "m", "odometry frame"),
)
MIXTURE_COLUMNS = (
    *_FRAME,
    Column("track_id", "uint64", "", ""),
    Column("step", "uint32", "", "from 1 on"),
    Column("t_s", "float64", "s", "after the stamp"),
    Column("component", "uint32", "", "of the bivariate Gaussian mixture, from 0 on"),
    Column("weight", "float32", "", "the components of a step sum to 1"),
    Column("mean_x", "float32", "m", "odometry frame"),
    Column("mean_y", "float32", "m", "odometry frame"),
    Column("sigma_x", "float32", "m", "standard deviation"),
    Column("sigma_y", "float32", "m", "standard deviation"),
    Column("rho", "float32", "", "correlation of x and y"),
)


@dataclass(frozen=True)
class Table:
    """A table: its columns, the messages it is made of, and how a message becomes rows."""

    columns: tuple[Column, ...]
    source: Topic
    message: type
    rows: Callable[[Any], Columns]


@dataclass
class Exported:
    """What was written: rows by table, the files, and tables for which there are no messages."""

    rows: dict[str, int] = field(default_factory=dict)
    paths: list[Path] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)


def export(
    reader: LogReader,
    folder: Path,
    *,
    mixtures: bool = False,
    start_ns: int | None = None,
    end_ns: int | None = None,
    refusals: Refusals | None = None,
    on_message: Callable[[int], None] = lambda _: None,
) -> Exported:
    """Writes the tables of a recording into a folder, which is made if it is not there; one row group at a time.

    Each table is written as NAME.part, and all are renamed when all are whole; after an error, or Ctrl-C, nothing of
    them is left. What cannot be decoded is counted in `refusals`.

    Args:
        reader: the recording, such as an output of `pcgan replay`; it may hold either message alone.
        folder: where the tables go.
        mixtures: write mixtures.parquet, too.
        start_ns: leave out messages logged earlier.
        end_ns: leave out messages logged at this time or later.
        refusals: counts what is refused.
        on_message: called with the log time of each message that has been read.

    Raises:
        LogError: there is neither a TrackFrame nor a PredictionFrame, or several topics of one type to choose from.
        OutputError: the tables cannot be written, or the folder holds one that would not be replaced.
    """
    refusals = Refusals() if refusals is None else refusals
    wanted = {name: table for name, table in TABLES.items() if mixtures or name != "mixtures"}
    topic_of = {name: _topic_of(reader, table) for name, table in wanted.items()}
    if not any(topic_of.values()):
        names = ", ".join(path.name for path in reader.paths)
        found = ", ".join(sorted({channel.topic for channel in reader.channels}))
        raise LogError(f"{names} holds no tracks or predictions of pcgan replay to export; its topics are {found}")
    done = Exported(missing=[name for name, topic in topic_of.items() if topic is None])
    done.paths = table_paths(folder, [name for name, topic in topic_of.items() if topic])
    for stale in table_paths(folder, TABLES):
        if stale.exists() and stale not in done.paths:
            raise OutputError(f"{stale} is of another export and would stay beside this one; remove it first")
    with ExitStack() as stack:
        writers = [stack.enter_context(_TableWriter(path, wanted[path.stem])) for path in done.paths]
        for writer in writers:
            writer.open()
        writers_of = {
            topic: [writer for writer in writers if topic_of[writer.path.stem] == topic]
            for topic in topic_of.values()
            if topic is not None
        }
        for raw in reader.messages(set(writers_of), start_ns, end_ns):
            try:
                message: object = codec.decode(writers_of[raw.topic][0].table.message, raw.data)
            except CodecError as error:
                refusals.add(raw.topic, raw.log_time_ns, str(error))
            else:
                for writer in writers_of[raw.topic]:
                    writer.add(message)
            on_message(raw.log_time_ns)
        for writer in writers:
            writer.finish()
        for writer in writers:
            writer.rename()
            done.rows[writer.path.stem] = writer.rows
    return done


def table_paths(folder: Path, names: Iterable[str]) -> list[Path]:
    """Returns the files of some tables in a folder."""
    return [folder / f"{name}.parquet" for name in names]


def _topic_of(reader: LogReader, table: Table) -> str | None:
    """Returns the topic a table is made of, ours if there are several; None if there is none."""
    schema = codec.schema_name(table.message)
    kinds = {channel.topic: (channel.schema.name, channel.encoding) for channel in reader.channels}
    found = [topic for topic, kind in kinds.items() if kind == (schema, "protobuf")]
    if len(found) > 1 and table.source.name not in found:
        raise LogError(f"several topics hold a {schema}, and none is called {table.source.name}: {', '.join(found)}")
    return table.source.name if table.source.name in found else found[0] if found else None


# --- rows ----------------------------------------------------------------------------------------------------------


def track_rows(frame: TrackFrame) -> Columns:
    """Returns a row for each track of a frame."""
    tracks = frame.tracks
    states = np.array([track.state for track in tracks], float).reshape(-1, 4)
    covariances = np.array([track.covariance for track in tracks], float).reshape(-1, 4, 4)
    return {
        "sequence": np.full(len(tracks), frame.sequence, np.uint64),
        "stamp_ns": np.full(len(tracks), frame.stamp_ns, np.int64),
        "epoch": np.full(len(tracks), frame.epoch, np.uint32),
        "frame_id": np.full(len(tracks), frame.frame_id, object),
        "track_id": np.array([track.id for track in tracks], np.uint64),
        **{name: states[:, i] for i, name in enumerate(_STATE)},
        **{name: covariances[:, i, j] for name, ((i, j), _) in _COVARIANCE.items()},
        "existence": np.array([track.existence for track in tracks], float),
        "age_s": np.array([track.age_ns for track in tracks], float) / 1e9,
        "coasting": np.array([track.coasting for track in tracks], bool),
    }


def prediction_rows(frame: PredictionFrame) -> Columns:
    """Returns a row for each step of each path of each prediction of a frame."""
    paths = [(prediction, rank, path) for prediction in frame.predictions for rank, path in enumerate(prediction.paths)]
    lengths = np.array([len(path.points_m) for _, _, path in paths], np.int64)
    points = np.concatenate([np.zeros((0, 2)), *(path.points_m for _, _, path in paths)])
    steps = _counted(lengths) + 1
    times = [np.nan if prediction.corridor_time_s is None else prediction.corridor_time_s for prediction, _, _ in paths]

    def repeated(values: Sequence[Any], dtype: Any) -> NDArray[Any]:
        return np.repeat(np.array(values, dtype), lengths)

    return {
        "sequence": np.full(len(points), frame.sequence, np.uint64),
        "stamp_ns": np.full(len(points), frame.stamp_ns, np.int64),
        "frame_id": np.full(len(points), frame.frame_id, object),
        "model": np.full(len(points), frame.model, object),
        "track_id": repeated([prediction.track_id for prediction, _, _ in paths], np.uint64),
        "fallback": repeated([prediction.fallback for prediction, _, _ in paths], bool),
        "corridor_probability": repeated([prediction.corridor_probability for prediction, _, _ in paths], float),
        "corridor_time_s": repeated(times, float),
        "path": repeated([rank for _, rank, _ in paths], np.uint32),
        "probability": repeated([path.probability for _, _, path in paths], float),
        "step": steps.astype(np.uint32),
        "t_s": steps * frame.dt_s,
        "x": points[:, 0],
        "y": points[:, 1],
    }


def mixture_rows(frame: PredictionFrame) -> Columns:
    """Returns a row for each component of each step of each prediction of a frame."""
    mixtures = [prediction.mixture for prediction in frame.predictions]
    shapes = [mixture.weights.shape for mixture in mixtures]  # (P, K)
    sizes = [P * K for P, K in shapes]
    none = np.zeros(0, np.int64)
    steps = np.concatenate([none, *(np.repeat(np.arange(1, P + 1), K) for P, K in shapes)])
    components = np.concatenate([none, *(np.tile(np.arange(K), P) for P, K in shapes)])

    def joined(parts: Iterable[NDArray[Any]]) -> NDArray[np.float32]:
        return np.concatenate([np.zeros(0, np.float32), *(part.ravel() for part in parts)]).astype(np.float32)

    return {
        "sequence": np.full(len(steps), frame.sequence, np.uint64),
        "stamp_ns": np.full(len(steps), frame.stamp_ns, np.int64),
        "track_id": np.repeat(np.array([p.track_id for p in frame.predictions], np.uint64), sizes),
        "step": steps.astype(np.uint32),
        "t_s": steps * frame.dt_s,
        "component": components.astype(np.uint32),
        "weight": joined(mixture.weights for mixture in mixtures),
        "mean_x": joined(mixture.means_m[..., 0] for mixture in mixtures),
        "mean_y": joined(mixture.means_m[..., 1] for mixture in mixtures),
        "sigma_x": joined(mixture.sigmas_m[..., 0] for mixture in mixtures),
        "sigma_y": joined(mixture.sigmas_m[..., 1] for mixture in mixtures),
        "rho": joined(mixture.rhos for mixture in mixtures),
    }


def _counted(lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """[2, 3] -> [0, 1, 0, 1, 2]."""
    ends = np.cumsum(lengths)
    counted: NDArray[np.int64] = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - lengths, lengths)
    return counted


TABLES: dict[str, Table] = {
    "tracks": Table(TRACK_COLUMNS, topics.TRACKS, TrackFrame, track_rows),
    "predictions": Table(PREDICTION_COLUMNS, topics.PREDICTIONS, PredictionFrame, prediction_rows),
    "mixtures": Table(MIXTURE_COLUMNS, topics.PREDICTIONS, PredictionFrame, mixture_rows),
}


# --- Parquet -------------------------------------------------------------------------------------------------------


class _TableWriter:
    """Writes one table as NAME.part, a row group at a time; a context manager that leaves no part behind.

    It opens the file when it has been entered (`open`), so that an interruption on the way leaves none, either.
    """

    def __init__(self, path: Path, table: Table):
        self.path, self.table, self.rows = path, table, 0
        self._part = path.with_name(path.name + ".part")
        self._stream: IO[bytes] | None = None
        self._writer: Any = None
        self._waiting: list[Columns] = []  # of messages that are in no batch yet
        self._batches: list[Any] = []
        self._waiting_rows = 0  # of both
        self._pa, self._parquet = _pyarrow()
        self._schema = self._pa.schema([_arrow_field(self._pa, column) for column in table.columns])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for held in (self._writer, self._stream):
            if held is not None:
                with suppress(OSError):  # the error that ended it is the one to hear about
                    held.close()
        with suppress(OSError):  # once renamed, there is no part
            self._part.unlink()

    def open(self) -> None:
        """Begins the file; makes its folder if that is not there."""
        with self._writing():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self.path.is_dir():
                raise IsADirectoryError(errno.EISDIR, "Is a directory")
            self._stream = self._part.open("wb")
            self._writer = self._parquet.ParquetWriter(self._stream, self._schema, compression="zstd")

    def add(self, message: object) -> None:
        """Adds the rows of a message."""
        columns = self.table.rows(message)
        rows = len(columns["sequence"])
        if rows == 0:
            return
        self._waiting.append(columns)
        self._waiting_rows += rows
        if self._waiting_rows >= ROW_GROUP_ROWS:
            self._write()
        elif len(self._waiting) >= BATCH_MESSAGES:
            self._batch()

    def finish(self) -> None:
        """Writes what is left and the file's end."""
        self._write()
        assert self._stream is not None, "a table is finished after it was opened"
        with self._writing():
            self._writer.close()
            self._stream.flush()
            os.fsync(self._stream.fileno())

    def rename(self) -> None:
        """Gives the file its name."""
        with self._writing():
            self._part.replace(self.path)

    def _write(self) -> None:
        if self._waiting_rows == 0:
            return
        self._batch()
        with self._writing():
            self._writer.write_table(self._pa.Table.from_batches(self._batches, self._schema), ROW_GROUP_ROWS)
        self.rows += self._waiting_rows
        self._batches, self._waiting_rows = [], 0

    def _batch(self) -> None:
        if not self._waiting:
            return
        arrays = [
            self._pa.array(
                np.concatenate([columns[column.name] for columns in self._waiting]),
                getattr(self._pa, column.type)(),
                from_pandas=True,  # NaN is null
            )
            for column in self.table.columns
        ]
        self._batches.append(self._pa.RecordBatch.from_arrays(arrays, schema=self._schema))
        self._waiting = []

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(f"{self.path} cannot be written: {error.strerror or error}") from error


def _arrow_field(pa: Any, column: Column) -> Any:
    said = {"unit": column.unit, "meaning": column.meaning}
    return pa.field(
        column.name, getattr(pa, column.type)(), metadata={name: text for name, text in said.items() if text}
    )


def _pyarrow() -> tuple[Any, Any]:
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        raise OutputError(
            "pcgan export needs the package pyarrow, which is not installed: pip install 'pcgan[data]'"
        ) from error
