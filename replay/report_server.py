"""The page of a check served on loopback, and rerun beside it: a click on the page opens rerun at that moment.

Where there is a screen rerun's own window opens, with the whole recording and its time set to the moment. Elsewhere, as
over SSH, rerun's viewer runs in the browser and plays some seconds around the moment: an address can tell it what to
open, but not at what time (rerun 0.41).
"""

import hashlib
import mimetypes
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, quote, unquote, urlencode, urlsplit

import numpy as np

from replay.errors import ReplayError
from replay.rerun_viewer import HOST, Viewer, ViewerError, rerun_program, start_viewer, start_web_viewer

BEFORE_S, AFTER_S = 2, 5  # of a clip, around the moment
PATIENCE_S = 30.0
OPEN = "/rerun/index.html"  # what the page links to, with `recording` and `stamp_ns`
VIEWER, CLIPS = "/viewer/", "/clips/"
ASSETS = {  # of rerun's viewer for browsers
    "": "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
    "favicon.ico": "image/x-icon",
}
# rerun's page asks for fonts elsewhere and reports its use, and a page may come from somebody else: what is served here
# may talk to this server alone
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' blob: data:; worker-src 'self' blob:"
)


class ReportError(ReplayError):
    """A folder that cannot be served."""


class Rerun:
    """rerun, opened at moments: in one window of its own, or in the browser where there is no screen for a window."""

    def __init__(self, *, in_browser: bool = False, headless: bool = False):
        self.in_browser = in_browser
        self._headless = headless  # for tests: a window that nobody sees
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self.window: Viewer | None = None
        self._assets: dict[str, bytes] = {}
        self.clips = Path(tempfile.mkdtemp(prefix="pcgan-clips-"))

    def open(self, recording: Path, stamp_ns: int) -> str | None:
        """Shows a recording at a time, or returns the name of the clip that the browser has to show for that.

        Raises ViewerError if rerun cannot show it.
        """
        with self._open_for_use():
            if not self.in_browser and self._has_window():
                self._show(recording, stamp_ns)
                return None
            return cut_clip(recording, stamp_ns, self.clips)

    def asset(self, name: str) -> bytes:
        """Returns a file of rerun's viewer for browsers, one of ASSETS; raises ViewerError if there is none."""
        with self._open_for_use():
            if not self._assets:
                self._assets = _fetch_assets()
        return self._assets[name]

    def close(self) -> None:
        """Ends what was started, and removes the clips; whoever still waits for rerun gets a ViewerError."""
        self._closing.set()
        with self._lock:
            if self.window is not None:
                self.window.stop()
            shutil.rmtree(self.clips, ignore_errors=True)

    @contextmanager
    def _open_for_use(self) -> Iterator[None]:
        """Lets one request at a time use rerun, and none after `close`: what it started would stay."""
        with self._lock:
            if self._closing.is_set():
                raise ViewerError("pcgan report has ended")
            yield

    def _has_window(self) -> bool:
        """Opens a window if there is none, or none any more; where that fails the browser has to do."""
        if self.window is None or self.window.process.poll() is not None:
            try:
                self.window = start_viewer(headless=self._headless)
            except ViewerError:
                self.in_browser = True
        return not self.in_browser

    def _show(self, recording: Path, stamp_ns: int) -> None:
        from rerun.experimental import ViewerClient

        assert self.window is not None, "there is a window"
        try:
            client = ViewerClient.connect(self.window.url)
            client.open(str(recording))
            deadline = time.monotonic() + PATIENCE_S
            while not _is_loaded(client.get_state()):
                if self._closing.wait(0.05) or time.monotonic() > deadline:
                    raise ViewerError(f"rerun has not loaded {recording} yet; click again in a while")
            client.set_time("stamp", timestamp=np.datetime64(stamp_ns, "ns"), play_state="paused")
        except (RuntimeError, OSError, ValueError) as error:
            raise ViewerError(f"rerun does not show {recording}: {error}") from error


def _fetch_assets() -> dict[str, bytes]:
    """Returns the files of rerun's viewer for browsers, which only its own server hands out."""
    server, found = start_web_viewer(), {}
    try:
        for name in ASSETS:
            with urllib.request.urlopen(f"{server.url}/{name}", timeout=PATIENCE_S) as answer:
                found[name] = answer.read()
    except OSError as error:
        raise ViewerError(f"rerun's viewer for browsers cannot be had from its server: {error}") from error
    finally:
        server.stop()
    return found


def _is_loaded(state: Any) -> bool:
    """Returns whether the recording in front has its times: before that none can be set."""
    shown = [each for each in state.recordings if each.store_id == state.active_recording]
    return not state.loading and any(
        timeline.name == "stamp" and timeline.end is not None for each in shown for timeline in each.timelines
    )


def cut_clip(recording: Path, stamp_ns: int, folder: Path) -> str:
    """Writes the seconds around a moment as a recording of their own; returns its name in the folder.

    Raises ViewerError if rerun cannot.
    """
    # rerun names the parts by the times of their cuts; whole seconds have short names
    middle_s = stamp_ns // 10**9
    cuts_s = middle_s - BEFORE_S, middle_s + AFTER_S
    names = [datetime.fromtimestamp(cut, UTC).strftime("%Y-%m-%dT%H_%M_%SZ") for cut in cuts_s]
    name = f"{hashlib.sha256(str(recording).encode(errors='replace')).hexdigest()[:12]}-{middle_s}.rrd"
    if (folder / name).is_file():
        return name
    with tempfile.TemporaryDirectory(dir=folder) as parts:
        times = [argument for cut in cuts_s for argument in ("--time", str(cut * 10**9))]
        options = ("--recording-id", "clip", "--timeline", "stamp", *times)
        _rerun_rrd("split", "--output-dir", parts, *options, str(recording))
        found = list(Path(parts).glob("*" + "__".join(names) + ".rrd"))
        if len(found) != 1:
            raise ViewerError(f"rerun cut {recording} at {' and '.join(names)} into parts of other names")
        # A part lacks what holds at any time, such as colours, and has its layout switched on before the layout itself.
        # Merging puts that in order (rerun 0.41). The part between the cuts has "1" behind its id.
        always, whole = Path(parts) / "always.rrd", Path(parts) / name
        _write_static(recording, always, "clip1")
        _rerun_rrd("merge", str(found[0]), str(always), "-o", str(whole))
        whole.replace(folder / name)
    return name


def _write_static(recording: Path, path: Path, recording_id: str) -> None:
    """Writes what of a recording holds at any time."""
    from rerun.chunk import RrdReader

    try:
        reader = RrdReader(str(recording))
        application = reader.recordings()[0].application_id
        reader.stream().filter(is_static=True).write_rrd(
            str(path), application_id=application, recording_id=recording_id
        )
    except (RuntimeError, OSError, ValueError, IndexError) as error:
        raise ViewerError(f"rerun cannot read {recording}: {error}") from error


def _rerun_rrd(*arguments: str) -> None:
    command = [rerun_program(), "rrd", *arguments]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    if done.returncode:
        words = done.stderr.decode(errors="replace").strip().splitlines()
        raise ViewerError(f"`rerun rrd {arguments[0]}` failed: {words[-1] if words else 'it said nothing'}")


class ReportServer(ThreadingHTTPServer):
    """Serves a page's folder on loopback, and opens rerun where the page asks for it; `url` is the page's address."""

    daemon_threads = True

    def __init__(self, folder: Path, rerun: Rerun, port: int = 0):
        if not (folder / "index.html").is_file():
            raise ReportError(f"{folder} holds no page: `pcgan check SUITE --page {folder}` writes one")
        self.folder, self.rerun = folder.resolve(), rerun
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise ReportError(f"port {port} cannot be used: {error.strerror or error}") from error
        self.url = f"http://{HOST}:{self.server_port}/"

    def file(self, name: str) -> Path:
        """Returns a file of the folder by its relative path; raises ReportError if there is none of that name in it."""
        try:
            path = (self.folder / name).resolve()  # links are followed: none leads out of the folder
            found = path.is_relative_to(self.folder) and path.is_file()
        except (OSError, ValueError):  # no file can have such a name
            found = False
        if not found:
            raise ReportError(f"there is no {name} in the page's folder")
        return path

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Says nothing of a browser that has left before it had its answer."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    """Answers with the page's files, with rerun's viewer, or by opening a moment."""

    server: ReportServer

    def do_GET(self) -> None:
        try:
            address = urlsplit(self.path)
            if not self._is_for_us():
                self._answer(HTTPStatus.FORBIDDEN, b"this page is for the machine that it is on\n")
            elif address.path == OPEN and address.query:
                self._open(parse_qs(address.query))
            elif address.path.startswith(VIEWER):
                self._viewer(address.path.removeprefix(VIEWER))
            elif address.path.startswith(CLIPS):
                self._clip(unquote(address.path.removeprefix(CLIPS)))
            else:
                self._file(unquote(address.path).lstrip("/") or "index.html")
        except (ReplayError, ValueError) as error:  # an address may be none
            self._answer(HTTPStatus.NOT_FOUND, f"{error}\n".encode(errors="replace"))

    def _is_for_us(self) -> bool:
        """Refuses pages of other sites, and names of other hosts that were made to lead here."""
        port = self.server.server_port
        ours = self.headers.get("Host", "") in {f"{HOST}:{port}", f"localhost:{port}"}
        return ours and self.headers.get("Sec-Fetch-Site", "none") in {"none", "same-origin"}

    def _open(self, query: dict[str, list[str]]) -> None:
        name, stamp = (query.get(key, [""])[0] for key in ("recording", "stamp_ns"))
        if not re.fullmatch(r"[0-9]{1,19}", stamp) or int(stamp) >= 2**63:
            raise ReportError(f"stamp_ns must be a number of nanoseconds, got {stamp!r}")
        clip = self.server.rerun.open(self.server.file(name), int(stamp))
        if clip is None:
            self.send_response(HTTPStatus.NO_CONTENT)  # the browser stays where it is
        else:
            shown = f"http://{self.headers['Host']}{CLIPS}{quote(clip)}"
            self.send_response(HTTPStatus.SEE_OTHER)
            self.send_header(
                "Location", f"{VIEWER}?{urlencode({'url': shown, 'persist': 0, 'hide_welcome_screen': 1})}"
            )
        self.end_headers()

    def _viewer(self, name: str) -> None:
        if name not in ASSETS:
            raise ReportError(f"rerun's viewer has no {name}")
        self._answer(HTTPStatus.OK, self.server.rerun.asset(name), ASSETS[name])

    def _clip(self, name: str) -> None:
        path = self.server.rerun.clips / name
        if "/" in name or not path.is_file():
            raise ReportError(f"there is no clip {name}")
        self._answer(HTTPStatus.OK, path.read_bytes(), "application/octet-stream")

    def _file(self, name: str) -> None:
        path = self.server.file(name)
        kind, _ = mimetypes.guess_type(path.name)
        self._answer(HTTPStatus.OK, path.read_bytes(), kind or "application/octet-stream")

    def _answer(self, status: HTTPStatus, body: bytes, kind: str = "text/plain; charset=utf-8") -> None:
        self.send_response(status)
        for name, value in {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Content-Security-Policy": POLICY,
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-cache",  # the page may be written anew while it is served
        }.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Says nothing: the terminal is the user's."""
