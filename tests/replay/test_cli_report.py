"""The command `pcgan report`: what it says and how it ends; what it serves is tested with its server."""

import os
import re
import signal
import socket
import urllib.request

import pytest

pytest.importorskip("rerun", reason="rerun-sdk comes with pcgan[view]")


@pytest.fixture
def page(tmp_path):
    (tmp_path / "index.html").write_text("the page")
    return tmp_path


def one_line(err):
    """Asserts that an error is one line of our own, and returns it."""
    (line,) = err.splitlines()
    assert line.startswith("pcgan: ")
    return line


@pytest.mark.parametrize("signum", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_it_serves_the_page_until_it_is_told_to_end(start_pcgan, page, signum):
    process = start_pcgan("report", page, "--no-browser")
    line = process.stderr.readline()
    assert line.endswith("; Ctrl-C ends it\n")
    (url,) = re.findall(r"http://127\.0\.0\.1:\d+/", line)
    with urllib.request.urlopen(url, timeout=10) as answer:
        assert answer.read() == b"the page"
    os.kill(process.pid, signum)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (0, "", "")


def test_a_folder_without_a_page_is_an_error(pcgan, tmp_path):
    outcome = pcgan("report", tmp_path / "nothing", "--no-browser")
    assert outcome.code == 2
    assert "nothing holds no page" in one_line(outcome.err)


def test_a_port_in_use_is_an_error(pcgan, page):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        outcome = pcgan("report", page, "--no-browser", "--port", port)
    assert outcome.code == 2
    assert f"port {port} cannot be used" in one_line(outcome.err)
