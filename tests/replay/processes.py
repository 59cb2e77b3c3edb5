"""Processes of a test, as /proc shows them: who descends from whom, who still runs, and waiting for that to change."""

import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path


def descendants(pid: int) -> list[int]:
    """Returns the ids of a process's children, and theirs."""
    with suppress(OSError):  # it has ended
        tasks = list(Path(f"/proc/{pid}/task").iterdir())
        children = [int(child) for task in tasks for child in (task / "children").read_text().split()]
        return [each for child in children for each in (child, *descendants(child))]
    return []


def command_of(pid: int) -> str:
    """Returns a process's command line; empty once it has ended."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").replace("\0", " ")
    return ""


def processes_with(word: str) -> list[int]:
    """Returns the ids of processes whose command names something, such as a folder of a test's own."""
    return [
        int(each.name) for each in Path("/proc").iterdir() if each.name.isdigit() and word in command_of(int(each.name))
    ]


def is_running(pid: int) -> bool:
    """Tells whether there is such a process that is not just waiting to be buried."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def kill(pid: int) -> None:
    """Ends a process at once, if it has not ended by itself."""
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def wait_for(condition: Callable[[], object], patience_s: float = 120.0) -> None:
    """Returns when a condition holds; fails if it does not."""
    deadline_s = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline_s, "it did not happen"
        time.sleep(0.01)
