"""The server of `pcgan report`: what it hands out, to whom, and rerun at a moment."""

import http.client
import socket
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import parse_qs, urlencode, urlsplit

import numpy as np
import pytest

from replay.report_server import AFTER_S, BEFORE_S, ReportError, ReportServer, Rerun, cut_clip
from replay.rerun_view import RerunView
from replay.rerun_viewer import ViewerError, rerun_program
from tests.replay.view_scenes import START_NS, crowd

pytest.importorskip("rerun", reason="rerun-sdk comes with pcgan[view]")
FRAMES, FIRST = 150, 60
MOMENT_NS = START_NS + (FIRST + 70) * 100_000_000  # 7 s after the first frame


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    """A folder with a page, and a recording of 15 s."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "index.html").write_text("the page")
    (folder / "rerun").mkdir()
    (folder / "rerun" / "index.html").write_text("how to open rerun")
    (folder / "cases").mkdir()
    with RerunView.to_file(folder / "cases" / "replay.rrd") as view:
        for result in crowd(people=4, frames=FRAMES, first=FIRST, cameras=False):
            view.show(result)
    return folder


@contextmanager
def serving(folder: Path, rerun: Rerun):
    with ReportServer(folder, rerun) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
            rerun.close()


@pytest.fixture(scope="module")
def server(page):
    with serving(page, Rerun(in_browser=True)) as running:
        yield running


def get(server, path, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders()), body


def moment(recording="cases/replay.rrd", stamp_ns=MOMENT_NS):
    return f"/rerun/index.html?{urlencode({'recording': recording, 'stamp_ns': stamp_ns})}"


def test_it_hands_out_the_page_on_loopback(server):
    assert server.url == f"http://127.0.0.1:{server.server_port}/"
    assert server.server_address[0] == "127.0.0.1"
    assert get(server, "/")[::2] == (200, b"the page")
    assert get(server, "/rerun/index.html")[::2] == (200, b"how to open rerun")


@pytest.mark.parametrize(
    "path",
    [
        "/nothing.html", "/cases/", "/../secret.rrd", "/%2e%2e/secret.rrd", "//etc/passwd", "/%00", f"/{300 * 'x'}",
        "/viewer/other.js", "/clips/none.rrd", "/clips/../x", "/clips/..%2fx", "/clips/%00",
    ],
    ids=lambda path: path[:20],
)  # fmt: skip
def test_what_is_not_there_is_not_found(server, path, capfd):
    assert get(server, path)[0] == 404
    assert capfd.readouterr() == ("", "")


def test_an_address_that_is_none_is_not_found(server, capfd):
    with socket.create_connection(("127.0.0.1", server.server_port)) as browser:
        browser.sendall(f"GET http://[x/ HTTP/1.0\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode())
        assert b" 404 " in browser.recv(100)
    assert capfd.readouterr() == ("", "")


def test_links_that_lead_out_of_the_folder_are_not_followed(server, page):
    (page.parent / "secret.rrd").write_text("secret")
    (page / "link.rrd").symlink_to(page.parent / "secret.rrd")
    (page / "folder").symlink_to(page.parent)
    for name in ("link.rrd", "folder/secret.rrd"):
        assert get(server, f"/{name}")[0] == get(server, moment(name))[0] == 404


def test_a_page_may_talk_to_this_server_alone(server):
    headers = get(server, "/")[1]
    assert headers["Content-Type"] == "text/html"
    assert headers["Content-Security-Policy"].startswith("default-src 'self';")


def test_a_browser_that_leaves_early_leaves_no_words(page, capfd):
    (page / "large.bin").write_bytes(bytes(20_000_000))
    with serving(page, Rerun(in_browser=True)) as server:
        with socket.create_connection(("127.0.0.1", server.server_port)) as browser:
            browser.sendall(f"GET /large.bin HTTP/1.0\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode())
            assert browser.recv(10)
        assert get(server, "/")[0] == 200
        for thread in [each for each in threading.enumerate() if "process_request" in each.name]:
            thread.join(10)
    (page / "large.bin").unlink()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("headers", [
    {"Host": "evil.example"},
    {"Host": "evil.example:80"},
    {"Sec_Fetch_Site": "cross-site"},
    {"Sec_Fetch_Site": "same-site"},
], ids=str)  # fmt: skip
def test_pages_of_other_sites_are_refused(server, headers):
    for path in ("/", moment()):
        assert get(server, path, **headers)[0] == 403


@pytest.mark.parametrize(("wanted", "words"), [
    ({"recording": "../outside.rrd"}, "there is no ../outside.rrd in the page's folder"),
    ({"recording": "/etc/passwd"}, "there is no /etc/passwd"),
    ({"recording": "index.html"}, "rerun"),
    ({"recording": "cases/none.rrd"}, "there is no cases/none.rrd"),
    ({"recording": "a\0b"}, "there is no a\\x00b"),
    ({"recording": ""}, "there is no "),
    ({"stamp_ns": str(2**63)}, "got '9223372036854775808'"),
    ({"stamp_ns": "-5"}, "got '-5'"),
    ({"stamp_ns": "now"}, "got 'now'"),
], ids=str)  # fmt: skip
def test_moments_that_cannot_be_opened_are_explained(server, page, wanted, words):
    (page.parent / "outside.rrd").write_bytes(b"")
    status, _, body = get(server, moment(**wanted))
    assert status == 404
    assert words in body.decode()


def test_a_moment_leads_to_the_viewer_with_a_clip_around_it(server, tmp_path):
    status, headers, _ = get(server, moment())
    assert status == 303
    location = urlsplit(headers["Location"])
    assert location.path == "/viewer/"
    (url,) = parse_qs(location.query)["url"]
    assert url.startswith(server.url)
    status, _, data = get(server, urlsplit(url).path)
    assert status == 200
    (tmp_path / "clip.rrd").write_bytes(data)
    assert_clip(tmp_path / "clip.rrd", MOMENT_NS)


def assert_clip(path: Path, moment_ns: int):
    """Asserts that a clip has the seconds around a moment, its layout and what holds at any time."""
    from rerun.chunk import RrdReader

    reader = RrdReader(str(path))
    assert len(reader.blueprints()) == 1
    chunks = reader.stream().to_chunks()
    static = {chunk.entity_path for chunk in chunks if chunk.is_static}
    assert "/legend" in static
    stamps = np.concatenate([
        chunk.to_record_batch().column("stamp").to_numpy(zero_copy_only=False).astype(np.int64)
        for chunk in chunks
        if not chunk.is_static and chunk.entity_path == "/counts/tracks"
    ])  # fmt: skip
    middle_ns = moment_ns // 10**9 * 10**9
    within = stamps[(stamps >= middle_ns - BEFORE_S * 10**9) & (stamps < middle_ns + AFTER_S * 10**9)]
    assert len(stamps) - len(within) <= 1  # and what held at its begin
    assert moment_ns in within
    assert len(within) == 10 * (BEFORE_S + AFTER_S)


@pytest.mark.parametrize("second", [0, 14], ids=["at the begin", "at the end"])
def test_a_clip_at_an_end_of_the_recording_is_shorter(page, tmp_path, second):
    from rerun.chunk import RrdReader

    name = cut_clip(page / "cases" / "replay.rrd", START_NS + FIRST * 100_000_000 + second * 10**9, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert len(RrdReader(str(tmp_path / name)).recordings()) == 1


def test_a_clip_is_cut_once(page, tmp_path):
    first = cut_clip(page / "cases" / "replay.rrd", MOMENT_NS, tmp_path)
    made_ns = (tmp_path / first).stat().st_mtime_ns
    assert cut_clip(page / "cases" / "replay.rrd", MOMENT_NS + 1000, tmp_path) == first
    assert (tmp_path / first).stat().st_mtime_ns == made_ns


def test_what_is_no_recording_cannot_be_cut(tmp_path):
    (tmp_path / "bad.rrd").write_bytes(b"no recording")
    (tmp_path / "clips").mkdir()
    with pytest.raises(ViewerError, match="rerun"):
        cut_clip(tmp_path / "bad.rrd", MOMENT_NS, tmp_path / "clips")
    assert list((tmp_path / "clips").iterdir()) == []


def test_a_folder_without_a_page_is_refused(tmp_path):
    with pytest.raises(ReportError, match="holds no page: `pcgan check SUITE --page"):
        ReportServer(tmp_path, Rerun(in_browser=True))


def test_a_port_in_use_is_named(server, page):
    with pytest.raises(ReportError, match=f"port {server.server_port} cannot be used"):
        ReportServer(page, Rerun(in_browser=True), server.server_port)


def test_clips_are_gone_in_the_end(page):
    rerun = Rerun(in_browser=True)
    rerun.open(page / "cases" / "replay.rrd", MOMENT_NS)
    assert len(list(rerun.clips.iterdir())) == 1
    rerun.close()
    assert not rerun.clips.exists()
    with pytest.raises(ViewerError, match="has ended"):
        rerun.open(page / "cases" / "replay.rrd", MOMENT_NS)
    assert not rerun.clips.exists()


@pytest.mark.slow
def test_the_viewer_for_browsers_may_talk_to_this_server_alone(server):
    for name, kind in (
        ("", "text/html"),
        ("re_viewer.js", "text/javascript"),
        ("re_viewer_bg.wasm", "application/wasm"),
    ):
        status, headers, body = get(server, f"/viewer/{name}")
        assert status == 200
        assert headers["Content-Type"].startswith(kind)
        assert len(body) > 10_000
        assert headers["Content-Security-Policy"].startswith("default-src 'self';")
    assert body.startswith(b"\0asm")


@pytest.mark.slow
def test_without_a_window_the_browser_has_to_do(page, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    rerun = Rerun()
    try:
        assert rerun.open(page / "cases" / "replay.rrd", MOMENT_NS) is not None
        assert rerun.in_browser
    finally:
        rerun.close()


@pytest.mark.slow
def test_a_window_shows_the_moment_and_nothing_else_moves(page):
    """Two moments after each other, in one window that nobody sees; its time stands still at each."""
    from rerun.experimental import ViewerClient

    rerun_program()
    with serving(page, Rerun(headless=True)) as server:
        for stamp_ns in (MOMENT_NS, MOMENT_NS + 3 * 10**9):
            status, _, _ = get(server, moment(stamp_ns=stamp_ns))
            if server.rerun.in_browser:
                pytest.skip("rerun cannot draw without a screen here")
            assert status == 204
            time.sleep(0.5)
            state = ViewerClient.connect(server.rerun.window.url).get_state()
            (shown,) = state.recordings
            assert (shown.current_timeline, shown.current_time) == ("stamp", stamp_ns)
