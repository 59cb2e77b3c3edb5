"""How a live node is doing: rates, latencies and counts, from what the node tells a meter. Knows no sockets."""

import time
from collections.abc import Callable

import numpy as np

from schemas import topics
from schemas.messages import NodeHealth
from schemas.topics import Topic

REPORT_EVERY_NS = 1_000_000_000
PROBLEM_LASTS_NS = 10_000_000_000  # what went wrong is told for so long, and then held to be over
SAME_AGAIN_NS = 60_000_000_000  # the same words again are worth a line only after so long
DEFAULT_DEADLINE_MS = 100.0  # one scan's time at 10 Hz


def health_key(node: str, namespace: str = "") -> str:
    """Returns the zenoh key of a node's health, e.g. car7/pcgan/health/track."""
    return topics.zenoh_key(Topic(f"/pcgan/health/{node}", "health", "NodeHealth"), namespace)


class HealthMeter:
    """Counts what a node does and gives a report once a second; one thread's.

    `clock_ns` only ever goes forward and times everything; `stamp_ns` is the time of day, for the report's stamp.
    """

    def __init__(
        self,
        node: str,
        model: str = "",
        *,
        deadline_ms: float = DEFAULT_DEADLINE_MS,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        stamp_ns: Callable[[], int] = time.time_ns,
    ):
        self.clock_ns = clock_ns
        self.frames = 0
        self.dropped = 0
        self.late = 0
        self.refused = 0
        self._node = node
        self._model = model
        self._deadline_ns = round(deadline_ms * 1e6)
        self._stamp_ns = stamp_ns
        self._started_ns = self._reported_ns = clock_ns()
        self._due_ns = self._started_ns + REPORT_EVERY_NS
        self._latencies_ns: list[int] = []  # since the last report
        self._taken = 0  # likewise
        self._problem = ""
        self._problem_ns = 0
        self._told: dict[str, tuple[int, str]] = {}  # kind of problem -> when it was last worth a line, and which

    def published(self, arrived_ns: int) -> None:
        """Counts a frame whose result has just gone out; `arrived_ns` is when what it came of arrived, by our clock."""
        latency_ns = self.clock_ns() - arrived_ns
        self._latencies_ns.append(latency_ns)
        self.frames += 1
        self.late += latency_ns > self._deadline_ns

    def took(self, messages: int) -> None:
        """Counts messages that came in."""
        self._taken += messages

    def refuse(self, problem: str, *, kind: str = "") -> bool:
        """Counts a message that is of no use; True if it is worth a line.

        In a flood that is one line a second of a kind, and one a minute of the same words.
        """
        self.refused += 1
        return self.trouble(problem, kind=kind)

    def trouble(self, problem: str, *, kind: str = "") -> bool:
        """Notes what is wrong, without counting anything; True if it is worth a line, as of `refuse`."""
        now_ns = self.clock_ns()
        self._problem, self._problem_ns = problem, now_ns
        if kind in self._told:
            told_ns, told = self._told[kind]
            if now_ns - told_ns < (SAME_AGAIN_NS if problem == told else REPORT_EVERY_NS):
                return False
        self._told[kind] = now_ns, problem
        return True

    def well(self) -> None:
        """Notes that what was wrong no longer is."""
        self._problem = ""

    @property
    def wait_s(self) -> float:
        """How long it is until the next report; 0 if it is due."""
        return max(0, self._due_ns - self.clock_ns()) * 1e-9

    def report(self) -> NodeHealth | None:
        """Returns how the node has done since the last report; None while the next one is not due."""
        now_ns = self.clock_ns()
        if now_ns < self._due_ns:
            return None
        latencies_ms = np.array(self._latencies_ns or [0]) * 1e-6
        p50_ms, p99_ms = np.percentile(latencies_ms, (50, 99)).tolist()
        health = NodeHealth(
            stamp_ns=self._stamp_ns(),
            node=self._node,
            model=self._model,
            uptime_s=(now_ns - self._started_ns) * 1e-9,
            rate_hz=len(self._latencies_ns) / ((now_ns - self._reported_ns) * 1e-9),
            latency_p50_ms=p50_ms,
            latency_p99_ms=p99_ms,
            frames=self.frames,
            dropped=self.dropped,
            late=self.late,
            refused=self.refused,
            problem=self._problem if now_ns - self._problem_ns < PROBLEM_LASTS_NS else "",
            input_hz=self._taken / ((now_ns - self._reported_ns) * 1e-9),
        )
        self._latencies_ns.clear()
        self._taken = 0
        self._reported_ns = now_ns
        self._due_ns += REPORT_EVERY_NS
        if self._due_ns <= now_ns:  # after a stall what was missed is not made up for
            self._due_ns = now_ns + REPORT_EVERY_NS
        return health
