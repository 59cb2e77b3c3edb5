"""How fast a replay runs; results never depend on it."""

import time


class Pacer:
    """Lets log time pass at `rate` times real time; without a rate, as fast as possible."""

    def __init__(self, rate: float | None = None):
        self._rate = rate
        self._start: tuple[int, float] | None = None

    def wait_for(self, log_time_ns: int) -> None:
        """Sleeps until the log time is due; the first call starts the clock."""
        if self._rate is None:
            return
        if self._start is None:
            self._start = (log_time_ns, time.monotonic())
        first_ns, started_s = self._start
        due_s = started_s + (log_time_ns - first_ns) * 1e-9 / self._rate
        time.sleep(max(0.0, due_s - time.monotonic()))
