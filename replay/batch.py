"""A corpus replayed: an output and a row for each log, each done once, whatever interrupts or kills the batch.

The folder of a batch holds NAME.pcgan.mcap for each log, results.parquet, and rows/NAME.json: the row of a log, written
when its output is whole, and what it was made of. A log is done if that is still the same.
"""

import fcntl
import hashlib
import json
import os
import shutil
import socket
import time
import uuid
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from replay.batch_table import DONE, FAILED, Row, empty_row, figures, pyarrow, write_table
from replay.errors import LogError, OutputError, PredictorError, ReplayError
from replay.interrupts import Interrupted, Interrupts
from replay.log_reader import checksum
from replay.log_source import OUTPUT_ENDING, LogSource, UnreachableError, identity, local_copy
from replay.log_writer import outputs as formats
from replay.part_file import NO_LOCKS, write_whole
from replay.record import Summary, record
from replay.replay_job import ReplayJob, run_job
from replay.session import PredictorChoice, Replay, ReplaySettings
from replay.workers import Failure, failure_of

RESULTS, ROWS, COPIES, LOCK = "results.parquet", "rows", ".batch.copies", ".batch.lock"


@dataclass(frozen=True)
class Batch:
    """What is done with every log, and the folder in which all of it ends up."""

    folder: Path
    settings: ReplaySettings = field(default_factory=ReplaySettings)
    model: str | Path | None = None  # name of a shipped model, or a file; None: the default
    salvage: bool = False
    emit: tuple[str, ...] = ("pcgan",)
    outputs: bool = True  # False: rows alone
    retry_failed: bool = False  # also logs that would fail again


@dataclass(frozen=True)
class BatchJob:
    """One log of a batch, as it is sent to a worker."""

    source: LogSource  # by absolute path
    url: str  # as it was given
    batch: Batch
    mark: str  # what the lock file holds: a worker elsewhere knows by it whether it sees the same folder
    model_sha256: str
    version: str

    @property
    def output(self) -> Path:
        """Where the log's output goes."""
        return self.batch.folder / f"{self.source.name}{OUTPUT_ENDING}"


@dataclass(frozen=True)
class JobDone:
    """What came of a log."""

    figures: Row
    input_sha256: str
    output_sha256: str | None
    output_bytes: int | None
    wall_s: float


@dataclass
class BatchResult:
    """A batch as far as it went; rows are in the order of the logs."""

    rows: list[Row] = field(default_factory=list)
    fresh: set[str] = field(default_factory=set)  # names of the logs that this run has replayed, or tried to
    wall_s: float = 0.0
    stopped: Interrupted | None = None

    @property
    def done(self) -> list[Row]:
        """Rows of logs that went through."""
        return [row for row in self.rows if row["status"] == DONE]

    @property
    def failed(self) -> list[Row]:
        """Rows of logs that did not."""
        return [row for row in self.rows if row["status"] == FAILED]


Outcomes = Generator[tuple[int, JobDone | Failure], None, None]
Runner = Callable[[Callable[[BatchJob], JobDone | Failure], Sequence[BatchJob]], Outcomes]  # such as `run_jobs`


def run_batch(
    batch: Batch, sources: Sequence[LogSource], run: Runner, on_rows: Callable[[Sequence[Row]], None] = lambda _: None
) -> BatchResult:
    """Replays what is not done yet, and writes results.parquet with a row for every log that is done or has failed.

    Ctrl-C and SIGTERM end it early: rows and table then hold what was done, and the result's `stopped` says so. A run
    that cannot begin leaves the table of an earlier one as it is. One batch at a time may have the folder.

    Args:
        batch: what to do.
        sources: the logs, with unique names.
        run: does jobs and yields outcomes with their indices, as `workers.run_jobs` does.
        on_rows: called with the rows that are there already, then with each new one.

    Raises:
        OutputError: the folder cannot be written, another batch has it, or an output would take the place of a log.
        PredictorError: there are no such weights.
        WorkersError: `run` has none.
    """
    pyarrow()  # now, not after a night of work
    formats(batch.emit)
    batch = replace(batch, folder=batch.folder.absolute(), model=_absolute_model(batch.model))
    model_sha256 = _model_sha256(batch.model)
    result, started = BatchResult(), time.monotonic()
    with Interrupts() as interrupts, _only_batch_in(batch.folder) as mark:
        _sweep(batch.folder)
        _make(batch.folder / COPIES)
        rows: dict[str, Row] = {}
        jobs: list[BatchJob] = []
        keys: list[dict[str, Any]] = []
        for source in sources:
            job = BatchJob(_absolute(source), source.url, batch, mark, model_sha256, version("pcgan"))
            key = _key(job)
            if (row := _row_before(job, key)) is not None:
                rows[source.name] = row | {"url": source.url}
            else:
                jobs.append(job)
                keys.append(key)
        _refuse_overwriting(jobs, sources)
        on_rows(list(rows.values()))
        begun = True
        try:
            with closing(run(replay_one, jobs)) as outcomes:
                for i, outcome in outcomes:
                    name = jobs[i].source.name
                    with interrupts.shield():
                        rows[name] = _settled(jobs[i], keys[i], outcome)
                        result.fresh.add(name)
                    on_rows([rows[name]])
        except Interrupted as interruption:
            result.stopped = interruption
        except BaseException:
            begun = bool(result.fresh)
            raise
        finally:
            interrupts.ignore()
            result.rows = [rows[source.name] for source in sources if source.name in rows]
            _sweep(batch.folder)  # first: it makes room on a full disk
            if begun:
                write_table(result.rows, batch.folder / RESULTS)
    result.wall_s = time.monotonic() - started
    return result


def _model_sha256(model: str | Path | None) -> str:
    from pcgan.checkpoint import CheckpointError, find_model, sha256

    try:
        return sha256(find_model(model))
    except (CheckpointError, OSError) as error:
        raise PredictorError(str(error)) from error


def _absolute(source: LogSource) -> LogSource:
    """Returns the source as a worker finds it, whose working folder may be another one."""
    return source if source.path is None else replace(source, url=str(source.path.absolute()))


def _absolute_model(model: str | Path | None) -> str | Path | None:
    return Path(model).absolute() if model is not None and Path(model).is_file() else model


# --- in the worker -------------------------------------------------------------------------------------------------


def replay_one(job: BatchJob) -> JobDone | Failure:
    """Replays a log into its output; what a user can mend is a Failure."""
    started = time.perf_counter()
    copy: Path | None = None
    try:
        _refuse_elsewhere(job)
        _forget(job)
        with local_copy(job.source, job.batch.folder / COPIES) as copy:
            summary = _replayed(job, copy)
            input_sha256 = checksum(copy)
        if summary.model["sha256"] != job.model_sha256:
            job.output.unlink(missing_ok=True)
            raise PredictorError(
                f"the worker's weights {summary.model['name']} have the SHA-256 {summary.model['sha256'][:12]}, "
                f"those here {job.model_sha256[:12]}: install the same pcgan on all machines"
            )
        assert input_sha256 is not None, "nobody abandons this checksum"
        output = job.output if job.batch.outputs else None
        return JobDone(
            figures(summary.as_json()),
            input_sha256,
            checksum(output) if output else None,
            output.stat().st_size if output else None,
            round(time.perf_counter() - started, 3),
        )
    except ReplayError as error:
        failure = failure_of(error)
        transient = not isinstance(error, LogError) or isinstance(error, UnreachableError)
        said = failure.problem if copy is None else failure.problem.replace(str(copy), job.url)
        return replace(failure, problem=said, transient=transient)


def _replayed(job: BatchJob, log: Path) -> Summary:
    batch = job.batch
    if batch.outputs:
        return run_job(ReplayJob((log,), job.output, batch.settings, batch.model, batch.salvage, batch.emit))
    choice = PredictorChoice("inline", batch.model)
    summary = record(Replay((log,), batch.settings, choice, salvage=batch.salvage), None)
    if summary.stopped is not None:
        raise summary.stopped
    return summary


def _refuse_elsewhere(job: BatchJob) -> None:
    """Raises OutputError on a machine that does not see the batch's folder, or runs another version."""
    host = socket.gethostname()
    try:
        shared = (job.batch.folder / LOCK).read_text() == job.mark
    except OSError:
        shared = False
    if not shared:
        raise OutputError(f"{job.batch.folder} on {host} is not the folder of this batch: all machines must share it")
    if (here := version("pcgan")) != job.version:
        raise PredictorError(
            f"{host} has pcgan {here}, this batch is of {job.version}: install the same on all machines"
        )


# --- what was done before ------------------------------------------------------------------------------------------


def _key(job: BatchJob) -> dict[str, Any]:
    """Returns all that an output is made of, as JSON has it; of a log that cannot be reached, None for its identity."""
    try:
        log = identity(job.source)
    except UnreachableError:
        log = None
    batch = job.batch
    settings = json.dumps(batch.settings.model_dump(mode="json"), sort_keys=True)
    return {
        "url": job.source.url,
        "log": log,
        "settings_sha256": hashlib.sha256(settings.encode()).hexdigest(),
        "model_sha256": job.model_sha256,
        "salvage": batch.salvage,
        "emit": list(batch.emit) if batch.outputs else None,
        "version": job.version,
    }


def _row_before(job: BatchJob, key: dict[str, Any]) -> Row | None:
    """Returns the row of a log that need not be replayed again; one that cannot be reached now is as it was."""
    before = _journal(job)
    if not before or before["key"] is None:
        return None
    unreachable = {"log": None} if key["log"] is None else {}
    if before["key"] | unreachable != key:
        return None
    row: Row = before["row"]
    if row["status"] == FAILED:
        return None if job.batch.retry_failed or before["transient"] else row
    if not job.batch.outputs:
        return row
    with suppress(OSError):
        if job.output.stat().st_size == before["output_bytes"]:
            return row
    return None


def _journal(job: BatchJob) -> dict[str, Any]:
    """Returns what rows/NAME.json holds; nothing if it is not there, or is not ours."""
    with suppress(OSError, ValueError):
        held = json.loads(_journal_path(job).read_text())
        if isinstance(held, dict) and {"key", "row", "transient", "output_bytes"} <= held.keys():
            return held
    return {}


def _forget(job: BatchJob) -> None:
    """Has the log count as done no more: killed when its output is just replaced, that would pass for the old one."""
    if before := _journal(job):
        _write_journal(job, before | {"key": None})


def _write_journal(job: BatchJob, held: dict[str, Any]) -> None:
    write_whole(_journal_path(job), (json.dumps(held, indent=1) + "\n").encode())


def _journal_path(job: BatchJob) -> Path:
    return job.batch.folder / ROWS / f"{job.source.name}.json"


def _settled(job: BatchJob, key: dict[str, Any], outcome: JobDone | Failure) -> Row:
    """Writes down what came of a log, and returns its row."""
    named: dict[str, Any] = {"name": job.source.name, "url": job.url, "version": job.version}
    traceback, transient, output_bytes = "", False, None
    if isinstance(outcome, Failure):
        row = empty_row(**named, status=FAILED, problem=outcome.problem)
        traceback, transient = outcome.traceback, outcome.transient
        if _journal(job).get("output_bytes") is not None:  # an output of ours, of other settings or another log
            job.output.unlink(missing_ok=True)
    else:
        checksums = {"input_sha256": outcome.input_sha256, "output_sha256": outcome.output_sha256}
        row = empty_row(**named, **outcome.figures, **checksums, status=DONE, wall_s=outcome.wall_s)
        output_bytes = outcome.output_bytes
    held = {"key": key, "row": row, "transient": transient, "output_bytes": output_bytes, "traceback": traceback}
    _write_journal(job, held)
    return row


# --- the folder ----------------------------------------------------------------------------------------------------


@contextmanager
def _only_batch_in(folder: Path) -> Iterator[str]:
    """Makes the folder and keeps other batches out of it until the block ends, or this process does; gives its mark."""
    mark = json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "id": uuid.uuid4().hex})
    _make(folder)
    _make(folder / ROWS)
    try:
        number = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise OutputError(f"{folder} cannot be written: {error.strerror or error}") from error
    with os.fdopen(number, "r+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(f"another batch is at work in {folder}{_said_by(file.read())}") from None
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise OutputError(f"{folder / LOCK} cannot be locked: {error.strerror or error}") from error
        try:
            file.truncate()
            os.write(number, mark.encode())  # not kept to be written at the end, should the disk be full
        except OSError as error:
            raise OutputError(f"{folder / LOCK} cannot be written: {error.strerror or error}") from error
        yield mark


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder} cannot be written: {error.strerror or error}") from error


def _refuse_overwriting(jobs: Sequence[BatchJob], sources: Sequence[LogSource]) -> None:
    """Raises OutputError if a log, such as an older output, would be overwritten by the output of another one."""
    logs = {os.path.realpath(source.url) for source in sources if source.path is not None}
    for job in jobs:
        if job.batch.outputs and os.path.realpath(job.output) in logs:
            raise OutputError(f"{job.output} is to be replayed, and overwritten by an output: choose another folder")


def _said_by(mark: str) -> str:
    with suppress(ValueError, KeyError, TypeError):
        held = json.loads(mark)
        return f": process {held['pid']} on {held['host']}; wait for it, or choose another folder"
    return "; wait for it, or choose another folder"


def _sweep(folder: Path) -> None:
    """Removes what workers that were killed have left half done."""
    for pattern in (f"*{OUTPUT_ENDING}.unfinished", f"*{OUTPUT_ENDING}.unfinished.part", f"{ROWS}/*.json.part"):
        for path in folder.glob(pattern):
            with suppress(OSError):
                path.unlink()
    shutil.rmtree(folder / COPIES, ignore_errors=True)
