"""A rerun viewer in a process of its own. It listens on loopback only: rerun's own `spawn` opens it to the network."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from replay.errors import ReplayError

HOST = "127.0.0.1"
START_LIMIT_S = 30.0
GRACE_S = 1.0  # it listens before it has a window: one that lives on this long has got it
MESA = "apt-get install --no-install-recommends mesa-vulkan-drivers libgl1-mesa-dri"


class ViewerError(ReplayError):
    """A viewer that cannot be started."""


@dataclass(frozen=True)
class Viewer:
    """A running viewer that takes recordings at `url`. It is the leader of its own process group."""

    process: subprocess.Popen[bytes]
    url: str

    def stop(self, patience_s: float = 5.0) -> None:
        """Ends the viewer and what it started: `rerun` on the path is only a shim around the real program."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, number)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(patience_s)
                break


def start_viewer(*, headless: bool = False, window_size: tuple[int, int] | None = None) -> Viewer:
    """Starts a viewer on a free loopback port and waits until it listens.

    Args:
        headless: draw without a screen; needs a Vulkan driver, if only Mesa's software one.
        window_size: width and height in pixels.

    Raises:
        ViewerError: rerun is not installed, or its viewer ends or stays silent; with its last words.
    """
    port = _free_port()
    command = [rerun_program(), "--bind", HOST, "--port", str(port), "--hide-welcome-screen", "--expect-data-soon"]
    command += ["--headless"] if headless else []
    command += ["--window-size", "{}x{}".format(*window_size)] if window_size else []
    return _start(command, port, f"rerun+http://{HOST}:{port}/proxy", headless=headless)


def start_web_viewer() -> Viewer:
    """Starts a server on a free loopback port that hands out the viewer for browsers; `url` is its address.

    Raises ViewerError if rerun is not installed, or its server ends or stays silent.
    """
    port = _free_port()
    url = f"http://{HOST}:{port}"
    # with something to show named, rerun opens no port for programs that log
    command = [rerun_program(), "--serve-web", "--bind", HOST, "--web-viewer-port", str(port), f"{url}/none.rrd"]
    return _start(command, port, url, headless=False)


def _start(command: list[str], port: int, url: str, *, headless: bool) -> Viewer:
    """Starts rerun and waits until it listens; raises ViewerError with its last words if it does not."""
    # An own session keeps Ctrl-C in the terminal from closing what the user is looking at.
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        )
        viewer = Viewer(process, url)
        deadline = time.monotonic() + START_LIMIT_S
        while process.poll() is None and time.monotonic() < deadline and not _listens(port):
            time.sleep(0.05)
        with suppress(subprocess.TimeoutExpired):
            process.wait(GRACE_S)
        if process.poll() is None and _listens(port):
            return viewer
        viewer.stop()
        output.seek(0)
        words = re.sub(r"\x1b\[[0-9;]*m", "", output.read().decode(errors="replace")).strip().splitlines()
    raise ViewerError(_explain(words[-1] if words else "it said nothing", headless))


@contextmanager
def headless_viewer(window_size: tuple[int, int]) -> Iterator[Viewer]:
    """Runs a viewer without a screen for as long as the block lasts."""
    viewer = start_viewer(headless=True, window_size=window_size)
    try:
        yield viewer
    finally:
        viewer.stop()


def rerun_program() -> str:
    """Returns the path of the program "rerun"; raises ViewerError if it is not installed."""
    beside = Path(sys.executable).with_name("rerun")
    found = str(beside) if beside.exists() else shutil.which("rerun")
    if found is None:
        raise ViewerError('the program "rerun" is not installed: pip install "pcgan[view]"')
    return found


def _explain(last_words: str, headless: bool) -> str:
    if headless:
        return f"rerun cannot draw without a screen here; on Debian: {MESA} (rerun: {last_words})"
    return f"rerun's viewer did not start; without a screen write a recording instead (rerun: {last_words})"


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex((HOST, port)) == 0
