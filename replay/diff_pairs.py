"""Two logs read side by side: messages of one topic and log time belong together, of several the first with the first.

So a message that one log lacks shifts nothing that follows. Held in memory are the messages of one log time.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator
from itertools import groupby, zip_longest
from operator import attrgetter
from typing import NamedTuple

from replay.log_reader import LogReader
from replay.logged_message import RawMessage


class Pair(NamedTuple):
    """A message of both logs, or of one."""

    topic: str
    log_time_ns: int
    a: RawMessage | None
    b: RawMessage | None

    @property
    def identical(self) -> bool:
        """True if both logs have the same bytes of the same type."""
        return self.a is not None and self.b is not None and self.a[2:] == self.b[2:]


def pairs(a: LogReader, b: LogReader, topics: Collection[str] | None = None) -> Iterator[Pair]:
    """Yields the messages of two logs in order of log time."""
    log_time = attrgetter("log_time_ns")
    groups = [groupby(reader.messages(topics), key=log_time) for reader in (a, b)]
    heads = [_next(group) for group in groups]
    while any(head is not None for head in heads):
        at_ns = min(head[0] for head in heads if head is not None)
        found = [head[1] if head is not None and head[0] == at_ns else [] for head in heads]
        yield from _paired(at_ns, *found)
        heads = [_next(group) if head is not None and head[0] == at_ns else head
                 for head, group in zip(heads, groups, strict=True)]  # fmt: skip


def _next(group: Iterator[tuple[int, Iterator[RawMessage]]]) -> tuple[int, list[RawMessage]] | None:
    found = next(group, None)
    return None if found is None else (found[0], list(found[1]))


def _paired(at_ns: int, a: list[RawMessage], b: list[RawMessage]) -> Iterator[Pair]:
    by_topic: defaultdict[str, tuple[list[RawMessage], list[RawMessage]]] = defaultdict(lambda: ([], []))
    for log, messages in enumerate((a, b)):
        for message in messages:
            by_topic[message.topic][log].append(message)
    for topic, both in by_topic.items():
        for left, right in zip_longest(*both):
            yield Pair(topic, at_ns, left, right)
