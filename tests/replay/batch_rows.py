"""Rows of a batch, to be compared: with those of a batch that was done here, one log after the other."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from replay.batch import RESULTS
from replay.batch_table import TIMINGS, Row


def in_this_process(work: Callable[[Any], Any], jobs: Sequence[Any], workers: int = 1) -> Iterator[tuple[int, Any]]:  # noqa: ARG001
    """Stands in for `run_jobs`: worker processes cost seconds each, and have tests of their own."""
    for i, job in enumerate(jobs):
        yield i, work(job)


def untimed(rows: Sequence[Row]) -> list[Row]:
    """Returns rows without what differs from run to run."""
    return [{name: value for name, value in row.items() if name not in TIMINGS} for row in rows]


def rows_of(folder: Path) -> list[Row]:
    """Returns what a batch's table holds, without what differs from run to run."""
    return untimed(pq.read_table(folder / RESULTS).to_pylist())
