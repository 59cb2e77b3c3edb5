"""Tells a late message from a clock that was reset, and a reset from a single absurd stamp."""

from enum import Enum

BACK_NS = 1_000_000_000  # stamps that jump back by more than this ...
AHEAD_NS = 10_000_000_000  # ... or run ahead of the log's own time by more than this ...
IN_A_ROW = 3  # ... are absurd; so many in a row are a clock that was reset


class Verdict(Enum):
    """What to do with a message."""

    ACCEPT = "accept"
    REFUSE = "refuse"
    NEW_EPOCH = "new epoch"


class StampGuard:
    """Watches the stamps of one topic against the last one accepted.

    After a reset each topic starts from the message that showed it, `reference` (stamp, log time) in ns: what another
    sensor sent before the reset may still arrive, and must not look like a second one.
    """

    def __init__(self, reference: tuple[int, int] | None = None) -> None:
        self._last = reference
        self._ahead_ns = AHEAD_NS if reference is None else BACK_NS
        self._jumps = 0

    def check(self, stamp_ns: int, log_time_ns: int) -> Verdict:
        """Judges the next message of the topic."""
        last_stamp_ns, last_log_time_ns = self._last or (stamp_ns, log_time_ns)
        ahead_ns = self._ahead_ns + max(0, log_time_ns - last_log_time_ns)
        if -BACK_NS <= stamp_ns - last_stamp_ns <= ahead_ns:
            self._last = (max(stamp_ns, last_stamp_ns), log_time_ns)
            self._ahead_ns = AHEAD_NS
            self._jumps = 0
            return Verdict.ACCEPT
        self._jumps += 1
        return Verdict.REFUSE if self._jumps < IN_A_ROW else Verdict.NEW_EPOCH
