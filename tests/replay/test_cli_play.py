"""The commands `pcgan play` and `pcgan record`: a log there and back again, keys, signals, and errors in one line."""

import json
import os
import pty
import re
import signal
import termios
import time
from collections import defaultdict

import pytest
from mcap.reader import make_reader

from pcgan import bus


def one_line(err):
    """Asserts that an error is one line of our own, perhaps after the one that says where we play, and returns it."""
    *before, line = err.splitlines()
    assert all(words.startswith("playing ") for words in before)
    assert line.startswith("pcgan: ")
    return line


def content(path):
    """What lies in a file by topic: schema, message encoding, channel metadata, and the messages' bytes in order."""
    channels, messages = {}, defaultdict(list)
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            schema_of = (schema.name, schema.encoding, schema.data) if schema else None
            channels[channel.topic] = (schema_of, channel.message_encoding, channel.metadata)
            messages[channel.topic].append(message.data)
    return channels, messages


@pytest.fixture
def endpoint(tmp_path):
    return f"unixsock-stream/{tmp_path}/bus"


@pytest.fixture
def recorder(start_pcgan, endpoint, tmp_path):
    """Starts pcgan record, and waits until it listens; stops it with a signal and returns code and output."""

    def start(*arguments):
        process = start_pcgan("record", "-o", tmp_path / "out.mcap", "--listen", endpoint, *arguments)
        assert process.stderr.readline() == f"recording {endpoint} into {tmp_path / 'out.mcap'}; Ctrl-C ends it\n"

        def stop(signum=signal.SIGINT):
            process.send_signal(signum)
            out, err = process.communicate(timeout=30)
            return process.returncode, out, err

        return stop

    return start


@pytest.fixture
def listener(endpoint):
    """Collects what is played: (key, bytes)."""
    got = []
    with (
        bus.open_shared_session(listen=[endpoint]) as session,
        session.declare_subscriber("**", lambda sample: got.append((str(sample.key_expr), sample.payload.to_bytes()))),
    ):
        yield got


# --- there and back --------------------------------------------------------------------------------------------------


def test_a_log_played_fast_and_recorded_is_the_same_log(pcgan, recorder, endpoint, short_drive, tmp_path):
    stop = recorder("--all")
    outcome = pcgan("play", short_drive, "--rate", 1000, "--connect", endpoint)
    count = sum(map(len, content(short_drive)[1].values()))
    topics = len(content(short_drive)[0])
    assert (outcome.code, outcome.err) == (0, f"playing {topics} topics on {endpoint}\n")
    code, out, err = stop()
    assert (code, err) == (0, "")
    assert content(tmp_path / "out.mcap") == content(short_drive)
    assert re.match(
        rf"played {count} messages of {topics} topics, 0\.\d MB, in \d\.\d s; at most .* ms late\n$", outcome.out
    )
    assert re.search(rf"^recorded {count} messages of {topics} topics, 0\.\d MB, in .* s; 0 lost$", out, re.MULTILINE)
    assert re.search(r"^ +30 /velodyne/front/clusters  pcgan.v1.LidarClusters$", out, re.MULTILINE)
    assert out.endswith(f"wrote {tmp_path / 'out.mcap'}\n")
    assert {path.name for path in tmp_path.iterdir()} >= {"out.mcap"}
    assert not (tmp_path / "out.mcap.part").exists()


def test_namespaces_and_names_on_both_sides(pcgan, recorder, endpoint, short_drive, tmp_path):
    stop = recorder("--topics", "/other/tf,/tf_static", "--namespace", "car7")
    arguments = ("play", short_drive, "--rate", 1000, "--connect", endpoint, "--namespace", "car7")
    assert pcgan(*arguments, "-e", "^/tf", "--remap", "/tf:=/other/tf").code == 0
    assert stop(signal.SIGTERM)[0] == 0
    channels, messages = content(tmp_path / "out.mcap")
    original = content(short_drive)
    assert messages == {"/other/tf": original[1]["/tf"], "/tf_static": original[1]["/tf_static"]}
    assert channels["/other/tf"] == original[0]["/tf"]


# --- play ------------------------------------------------------------------------------------------------------------


def test_a_part_of_a_log_in_real_time(pcgan, listener, endpoint, short_drive):
    arguments = ("--start-offset", 1, "--playback-duration", 0.5, "--topics", "/velodyne/front/clusters", "--rate", 2)
    began_s = time.monotonic()
    assert pcgan("play", short_drive, "--connect", endpoint, *arguments, "--delay", 0.2).code == 0
    assert time.monotonic() - began_s > 0.2 + 0.4 / 2
    clusters = content(short_drive)[1]["/velodyne/front/clusters"]
    assert {key for key, _ in listener} == {"velodyne/front/clusters"}
    first = clusters.index(listener[0][1])
    assert [data for _, data in listener] == clusters[first : first + 5]
    assert 8 <= first <= 11


def test_topics_and_names_may_be_listed_as_for_ros2_bag(pcgan, recorder, endpoint, short_drive, tmp_path):
    stop = recorder("--all")
    played = pcgan("play", short_drive, "-r", 1000, "--connect", endpoint, "--topics", "/tf", "/vn100/odometry")
    assert played.code == 0
    remapped = ("-e", "^/tf", "--remap", "/tf_static:=/a/tf_static", "/tf:=/b")
    assert pcgan("play", short_drive, "-r", 1000, "--connect", endpoint, *remapped).code == 0
    assert stop()[0] == 0
    assert set(content(tmp_path / "out.mcap")[0]) == {"/tf", "/vn100/odometry", "/a/tf_static", "/b"}


def test_it_waits_for_a_subscriber_and_says_if_none_comes(pcgan, endpoint, short_drive):
    arguments = ("play", short_drive, "--rate", 1000, "--listen", endpoint, "--wait-for-subscribers", 0.2)
    outcome = pcgan(*arguments)
    assert outcome.code == 0
    assert outcome.err.endswith("\nnote: nobody subscribed within 0.2 s\n")


def test_a_loop_ends_with_ctrl_c(start_pcgan, listener, endpoint, short_drive):
    process = start_pcgan("play", short_drive, "--loop", "--rate", 100, "--connect", endpoint)
    static = ("tf_static", content(short_drive)[1]["/tf_static"][0])
    deadline_s = time.monotonic() + 30
    while listener.count(static) < 3 and time.monotonic() < deadline_s:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert re.fullmatch(rf"playing \d+ topics on {endpoint}\n", err)
    assert out.startswith("played ")
    assert listener.count(static) >= 3


def test_sigterm_is_143(start_pcgan, listener, endpoint, short_drive):
    process = start_pcgan("play", short_drive, "--connect", endpoint)
    while not listener:
        time.sleep(0.02)
    process.terminate()
    process.communicate(timeout=30)
    assert process.returncode == 143


@pytest.mark.parametrize(("signum", "code"), [(None, 0), (signal.SIGTERM, 143)])
def test_keys_at_a_terminal_and_the_terminal_afterwards(start_pcgan, listener, endpoint, short_drive, signum, code):
    typing, terminal = pty.openpty()
    before = termios.tcgetattr(terminal)
    process = start_pcgan("play", short_drive, "--start-paused", "--rate", 50, "--connect", endpoint, stdin=terminal)

    def come(count):
        deadline_s = time.monotonic() + 30
        while len(listener) < count and time.monotonic() < deadline_s:
            time.sleep(0.02)
        time.sleep(0.2)
        return len(listener)

    while termios.tcgetattr(terminal)[3] & termios.ICANON:  # until it listens to keys
        time.sleep(0.02)
    assert come(0) == 0
    os.write(typing, b"\x1b[C")
    assert come(1) == 1
    os.write(typing, b"\x1b[C\x1b[C")
    assert come(3) == 3
    if signum is None:
        os.write(typing, b" ")
    else:
        process.send_signal(signum)
    out, err = process.communicate(timeout=30)
    assert process.returncode == code
    assert re.fullmatch(rf"playing \d+ topics on {endpoint}\n", err)
    assert out.startswith("played ")
    assert termios.tcgetattr(terminal) == before
    os.close(typing)
    os.close(terminal)


@pytest.mark.parametrize("command", [("play", "--loop"), ("record", "--all", "-o")])
def test_whom_the_configuration_turns_away_is_told(start_pcgan, endpoint, short_drive, tmp_path, command):
    (tmp_path / "users.txt").write_text("us:secret\n")
    config = {
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {
            "auth": {"usrpwd": {"user": "us", "password": "secret", "dictionary_file": str(tmp_path / "users.txt")}}
        },
    }
    (tmp_path / "zenoh.json5").write_text(json.dumps(config))
    file = short_drive if command[0] == "play" else tmp_path / "out.mcap"
    process = start_pcgan(*command, file, "--zenoh-config", tmp_path / "zenoh.json5")
    assert str(tmp_path / "zenoh.json5") in process.stderr.readline()
    with bus.open_session(connect=[endpoint]):
        assert process.stderr.readline() == "refused a peer: no user and password\n"
    process.terminate()
    out, _ = process.communicate(timeout=30)
    assert (process.returncode, out.split()[0]) == ((143, "played") if command[0] == "play" else (0, "recorded"))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--start-paused",), "--start-paused wants a terminal"),
        (("--topics", "/gone"), "the recording has no /gone; its topics are /gmsl/A0/camera_info, "),
        (("--regex", "gone"), "none of the recording's topics is chosen"),
        (("--regex", "("), "'(' is no regular expression"),
        (("--remap", "/tf"), "--remap wants OLD:=NEW, for example /tf:=/other/tf; got '/tf'"),
        (("--start-offset", "99"), "nothing is left to play 99 s into the recording"),
        (("--connect", "nonsense"), "zenoh cannot be opened on nonsense"),
    ],
)
def test_what_cannot_be_played_is_told_in_one_line(pcgan, short_drive, endpoint, arguments, text):
    where = () if "--connect" in arguments else ("--listen", endpoint)
    outcome = pcgan("play", short_drive, *where, *arguments)
    assert outcome.code == 2
    assert text in one_line(outcome.err)


def test_a_log_that_is_none_is_told_in_one_line(pcgan, tmp_path):
    (tmp_path / "no.mcap").write_bytes(b"no")
    outcome = pcgan("play", tmp_path / "no.mcap")
    assert outcome.code == 2
    assert "no.mcap is not a readable MCAP file" in one_line(outcome.err)


# --- record ----------------------------------------------------------------------------------------------------------


def test_a_recording_ends_after_its_duration(pcgan, endpoint, tmp_path):
    outcome = pcgan("record", "-o", tmp_path / "o.mcap", "-a", "--duration", 0.2, "--listen", endpoint)
    assert outcome.code == 0
    assert re.match(r"recorded 0 messages of 0 topics, 0\.0 MB, in 0\.\d s; 0 lost\nwrote .*o\.mcap\n$", outcome.out)
    assert content(tmp_path / "o.mcap") == ({}, {})


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((), "nothing to record is chosen: --topics NAMES, --regex REGEX, or --all"),
        (("-x", "image"), "nothing to record is chosen"),
        (("--all", "--topics", "/tf"), "--all records everything"),
        (("--all", "-x", "("), "'(' is no regular expression"),
        (("--topics", "/a*"), "topic '/a*' cannot be a zenoh key"),
    ],
)
def test_what_cannot_be_recorded_is_told_in_one_line(pcgan, endpoint, tmp_path, arguments, text):
    outcome = pcgan("record", "-o", tmp_path / "o.mcap", "--listen", endpoint, *arguments)
    assert outcome.code == 2
    assert text in one_line(outcome.err)
    assert not list(tmp_path.glob("o.mcap*"))


def test_a_recording_is_never_overwritten(pcgan, endpoint, tmp_path):
    (tmp_path / "o.mcap").write_bytes(b"mine")
    outcome = pcgan("record", "-o", tmp_path / "o.mcap", "--all", "--listen", endpoint)
    assert outcome.code == 2
    assert "o.mcap is there already" in one_line(outcome.err)
    assert (tmp_path / "o.mcap").read_bytes() == b"mine"
