"""Messages in log-time order, out of chunks that overlap in time and out of files that no index orders."""

import heapq
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from operator import attrgetter

from replay.logged_message import RawMessage

# Files without an index come in file order: writers interleave sensors by less than this.
REORDER_NS = 2_000_000_000
log_time = attrgetter("log_time_ns")


def in_time_order(chunks: Iterable[tuple[int, Iterable[RawMessage]]]) -> Iterator[RawMessage]:
    """Yields the messages of chunks in log-time order; ties in the order of the chunks.

    A message waits only for the chunks that begin before it. (mcap's own reader keeps every message in a heap with a
    comparison in Python, which costs more than everything else there is to do with it.)

    Args:
        chunks: where each begins in time, rising, and its messages, which are read when its turn comes.
    """
    waiting: list[RawMessage] = []
    for start_ns, messages in chunks:
        ready = bisect_left(waiting, start_ns, key=log_time)
        yield from waiting[:ready]
        del waiting[:ready]
        waiting += messages
        waiting.sort(key=log_time)
    yield from waiting


def reordered(messages: Iterable[RawMessage]) -> Iterator[RawMessage]:
    """Sorts messages that are out of log-time order by less than REORDER_NS; stable."""
    waiting: list[tuple[int, int, RawMessage]] = []
    for index, message in enumerate(messages):
        heapq.heappush(waiting, (message.log_time_ns, index, message))
        while waiting[0][0] <= message.log_time_ns - REORDER_NS:
            yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]
