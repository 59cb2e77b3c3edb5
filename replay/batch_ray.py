"""The jobs of a batch as Ray tasks: on a local Ray, or on a cluster that is there already."""

import importlib
import itertools
import logging
import os
import signal
import socket
import threading
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent import futures
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any, TypeVar

from replay.interrupts import Interrupted
from replay.workers import RETRIES, Failure, WorkersError, failure_of

J = TypeVar("J")
R = TypeVar("R")

LOCAL = "local"  # the address of a Ray that is started for this batch and ended after it
TOKENS = "one with token authentication wants RAY_AUTH_MODE=token and its RAY_AUTH_TOKEN here, too"
CONNECT_S = 10.0  # Ray itself would try for minutes
OBJECT_STORE_BYTES = 100 << 20  # of a local Ray: jobs and rows are small, logs stay in files


def run_jobs_on_ray(
    work: Callable[[J], R], jobs: Sequence[J], address: str, workers: int | None = None
) -> Generator[tuple[int, R | Failure], None, None]:
    """Yields each job's index with its result or Failure, as they finish; as `workers.run_jobs`, on Ray.

    A job whose worker or node dies is begun again, up to RETRIES times. Every node must have pcgan installed, and see
    files under the same paths. When the caller stops iterating, running tasks are ended.

    Args:
        work: a function of a module; an exception from it becomes the job's Failure.
        jobs: handed out in order.
        address: LOCAL, "auto" (the cluster of this machine, or of RAY_ADDRESS), or HOST:PORT of a head node.
        workers: how many jobs at a time; None: as many as there are processors.

    Raises:
        WorkersError: Ray is not installed, or cannot be reached.
    """
    with _ray(address, workers) as ray:
        task = ray.remote(num_cpus=1, max_retries=RETRIES)(_outcome)
        work_there = ray.put(work)
        waiting = iter(enumerate(jobs))
        running: dict[Future[Any], tuple[int, Any]] = {}
        try:
            while True:
                for i, job in itertools.islice(waiting, None if workers is None else workers - len(running)):
                    reference = task.remote(work_there, job)
                    running[reference.future()] = i, reference
                if not running:
                    return
                # ray.wait would make every signal a KeyboardInterrupt, and forget which one it was
                for each in futures.wait(running, return_when=futures.FIRST_COMPLETED).done:
                    i, _ = running.pop(each)
                    yield i, _result(ray, each)
        finally:
            for _, reference in running.values():
                ray.cancel(reference, force=True)


def _outcome(work: Callable[[Any], Any], job: object) -> Any:
    try:
        return work(job)
    except Interrupted:
        raise
    except BaseException as error:
        return failure_of(error)


def _result(ray: Any, finished: Future[Any]) -> Any:
    try:
        return finished.result()
    except ray.exceptions.RayError as error:  # its worker died, or its node, again and again
        line = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        return Failure(f"Ray gave up after {RETRIES} retries: {line}", transient=True)


def _refuse_unreachable(address: str) -> None:
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        raise WorkersError(f"a Ray is {LOCAL}, auto or HOST:PORT of its head node, got {address!r}")
    try:
        socket.create_connection((host, int(port)), timeout=CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise WorkersError(f"no Ray at {address}: {getattr(error, 'strerror', None) or error}") from error


def import_ray() -> Any:
    """Returns the module ray, without its usual talk; raises WorkersError if it is not installed."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # else it warns of a change to come
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise WorkersError("--ray needs the package ray, which is not installed: pip install 'pcgan[ray]'") from error


@contextmanager
def _ray(address: str, workers: int | None) -> Iterator[Any]:
    """Gives the module ray, connected; disconnects, or ends a local Ray, afterwards."""
    ray = import_ray()
    if address not in {LOCAL, "auto"}:
        _refuse_unreachable(address)
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    if address == LOCAL:
        quiet |= {"num_cpus": workers, "include_dashboard": False, "object_store_memory": OBJECT_STORE_BYTES}
    try:
        with warnings.catch_warnings(), _own_sigterm():
            warnings.simplefilter("ignore")
            ray.init(address=address, **quiet)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError, ray.exceptions.RayError) as error:
        hint = "" if address in {LOCAL, "auto"} else f"; {TOKENS}"
        raise WorkersError(f"no Ray at {address}: {' '.join(str(error).split())}{hint}") from error
    try:
        yield ray
    finally:
        ray.shutdown()


@contextmanager
def _own_sigterm() -> Iterator[None]:
    """Puts back the handler of SIGTERM, in whose place Ray sets one that exits."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)
