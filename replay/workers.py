"""Jobs spread over worker processes: whatever ends a worker, be it a segfault, costs at most the job it had."""

import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from replay.errors import ReplayError, one_line
from replay.interrupts import Interrupted, Interrupts

J = TypeVar("J")
R = TypeVar("R")

RETRIES = 2  # of a job whose worker died
STARTS_IN_A_ROW = 3  # of workers that are killed before they could begin
PATIENCE_S = 3.0  # for workers to tidy up when the run ends early
_CONTEXT = multiprocessing.get_context("spawn")  # a fork would copy locks that other threads hold, zenoh's among them


class WorkersError(ReplayError):
    """Worker processes that cannot be started."""


@dataclass(frozen=True)
class Failure:
    """Why a job has no result."""

    problem: str  # one line
    traceback: str = ""  # of errors that are no ReplayError
    transient: bool = False  # it may go well another time: of workers that died, say


def failure_of(error: BaseException) -> Failure:
    """Returns what is said of an exception: its line if a user can mend it, else also its type and traceback."""
    if isinstance(error, ReplayError):
        return Failure(str(error))
    line, name = one_line(" ".join(str(error).split())), type(error).__name__
    said = "".join(traceback.format_exception(error))
    return Failure(f"{name}: {line}" if line else name, said, transient=isinstance(error, (MemoryError, OSError)))


def usable_cpus() -> int:
    """Returns how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_jobs(work: Callable[[J], R], jobs: Sequence[J], workers: int) -> Generator[tuple[int, R | Failure], None, None]:
    """Yields each job's index with its result or Failure, as they finish; every job once.

    A job whose worker dies is begun again, after all others and up to RETRIES times: memory may have run out. One
    worker is a process of its own, too. Processes are spawned and reused; `work`, jobs and results are pickled, and a
    script that calls this needs the usual `if __name__ == "__main__":`. Ctrl-C does not reach the workers, which end
    when the caller stops iterating, whatever the reason, and when its process dies.

    Args:
        work: a function of a module; an exception from it becomes the job's Failure.
        jobs: handed out one by one, in order.
        workers: how many processes at most.

    Raises:
        WorkersError: workers cannot be started.
    """
    if workers < 1:
        raise ValueError(f"jobs need at least one worker, got {workers}")
    waiting, left, failed_starts = deque(range(len(jobs))), len(jobs), 0
    retried: Counter[int] = Counter()  # how often, by job
    team: list[_Worker] = []
    retired: list[_Worker] = []
    try:
        while left:
            while len(team) < min(workers, left):
                with _signals_held():  # which the new process inherits: no signal finds it half started, or unknown
                    team.append(_Worker(work))
            for worker in _heard_of(team):
                done = worker.job
                try:
                    outcome = worker.receive()
                except _Died as death:
                    team.remove(worker)
                    failed_starts += worker.starting
                    if worker.starting and (death.code >= 0 or failed_starts == STARTS_IN_A_ROW):
                        raise WorkersError(f"worker processes cannot be started: one {death}") from None
                    if done is not None and retried[done] < RETRIES:
                        retried[done] += 1
                        waiting.append(done)
                        continue
                    outcome = Failure(f"{RETRIES + 1} workers died of it; the last one {death}", transient=True)
                else:
                    failed_starts = 0
                    if not waiting:
                        worker.retire()
                        team.remove(worker)
                        retired.append(worker)
                    elif worker.give(waiting[0], jobs[waiting[0]]):
                        waiting.popleft()
                if done is not None:
                    left -= 1
                    yield done, outcome
    finally:
        _end(team, retired)


class _Died(Exception):
    """A worker has ended; `code` is its exit code, -N if signal N ended it."""

    def __init__(self, code: int):
        self.code = code
        ended = f"ended by itself with exit code {code}"
        if code < 0:
            known = -code in signal.valid_signals()
            ended = f"was ended by signal {-code}" + (f" ({signal.Signals(-code).name})" if known else "")
        super().__init__(ended + (", as the system does when memory runs out" if code == -signal.SIGKILL else ""))


class _Worker:
    """A worker process, as its caller sees it."""

    def __init__(self, work: Callable[[Any], Any]):
        self.job: int | None = None  # index of what it is doing
        self.starting = True
        self._pipe, theirs = _CONTEXT.Pipe()
        self._process = _CONTEXT.Process(target=_serve, args=(work, theirs), daemon=True)
        try:
            self._process.start()
        finally:
            theirs.close()

    @property
    def signs_of_life(self) -> tuple[Connection, int]:
        """What to wait for: a message, or the end."""
        return self._pipe, self._process.sentinel

    def give(self, index: int, job: object) -> bool:
        """Sends a job; returns False if the worker has died since it was last heard of."""
        try:
            self._pipe.send(job)
        except (BrokenPipeError, ConnectionResetError):
            return False
        self.job = index
        return True

    def receive(self) -> Any:
        """Returns the outcome of the job, or None of one that is ready for its first; raises _Died."""
        with suppress(EOFError, OSError):
            if self._pipe.poll():
                outcome = self._pipe.recv()
                self.job, self.starting = None, False
                return outcome
        self.retire()
        self._process.join()
        assert self._process.exitcode is not None, "a process that was waited for has an exit code"
        raise _Died(self._process.exitcode)

    def retire(self) -> None:
        """Has the worker end when it has nothing to do."""
        self._pipe.close()

    def end(self) -> None:
        """Asks a busy worker to tidy up and end; one that is starting is ended."""
        if self.starting:
            self._process.kill()
        else:
            self._process.terminate()

    def end_for_good(self, deadline_s: float) -> None:
        """Waits for the end until a time of the monotonic clock, then makes it happen."""
        self._process.join(max(0.0, deadline_s - time.monotonic()))
        self._process.kill()
        self._process.join()


def _heard_of(team: Sequence[_Worker]) -> list[_Worker]:
    """Waits until workers have something to say or have ended, and returns these."""
    heard = wait([sign for worker in team for sign in worker.signs_of_life])
    return [worker for worker in team if not set(heard).isdisjoint(worker.signs_of_life)]


def _end(team: Sequence[_Worker], retired: Sequence[_Worker]) -> None:
    """Ends workers that are not wanted any more, and waits for all; a second Ctrl-C does it at once."""
    deadline_s = time.monotonic() + PATIENCE_S
    try:
        for worker in team:
            worker.end()
        for worker in (*team, *retired):
            worker.end_for_good(deadline_s)
    except BaseException:
        for worker in (*team, *retired):
            worker.end_for_good(0.0)
        raise


@contextmanager
def _signals_held() -> Iterator[None]:
    """Keeps what `Interrupts` obeys waiting, for this thread and the processes it starts."""
    resource_tracker.ensure_running()  # whose own start would let go of them
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# --- in the worker -------------------------------------------------------------------------------------------------


def _serve(work: Callable[[Any], Any], pipe: Connection) -> None:
    """Does one job after the other, until the caller hangs up.

    What a terminal sends to all its processes stays blocked: Ctrl-C is the caller's business. SIGTERM interrupts a job,
    which tidies up, and ends this.
    """
    threading.Thread(target=_follow_parent, daemon=True).start()
    try:
        with Interrupts():
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
            pipe.send(None)
            while True:
                outcome = _outcome(work, pipe.recv())
                try:
                    pipe.send(outcome)
                except (BrokenPipeError, ConnectionResetError):
                    raise
                except Exception as error:  # it cannot be pickled: nothing has been sent
                    pipe.send(failure_of(error))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except Interrupted as interruption:
        signal.signal(interruption.signum, signal.SIG_DFL)
        signal.raise_signal(interruption.signum)


def _outcome(work: Callable[[Any], Any], job: object) -> Any:
    try:
        return work(job)
    except Interrupted:
        raise
    except BaseException as error:  # SystemExit, and what pytest raises, are no reason to end the worker
        return failure_of(error)


def _follow_parent() -> None:
    """Ends this process, whatever it is doing, when its caller's has died."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker is a child"
    parent.join()
    os._exit(1)
