"""The command `pcgan track`: what it says, how it ends, and three processes that do live what a replay does."""

import os
import pty
import queue
import signal
import subprocess
import sys
import termios
import time
from contextlib import ExitStack

import pytest

from pcgan import bus
from pcgan.bus import any_alive_key
from pcgan.node_health import health_key
from replay.cli_live import health_line
from replay.log_reader import LogReader
from replay.player import LogPublisher, Player, Schedule, played_topics
from replay.topic_choice import TopicChoice
from schemas import codec, topics
from schemas.messages import NodeHealth, PredictionFrame, TrackFrame

PATIENCE_S = 30


class NoKeys:
    def press(self, timeout_s):
        time.sleep(timeout_s)


def play(session, log, namespace="", rate=1.0):
    """What `pcgan play` does, in this process."""
    reader = LogReader([log])
    with LogPublisher(session, played_topics(reader, TopicChoice(), {}, namespace), namespace) as publisher:
        schedule = Schedule(rate)
        schedule.restart(reader.start_ns)
        Player(schedule, NoKeys(), publisher.publish).play(reader.messages(None))
        time.sleep(0.5)  # what has been put leaves before its publisher does


class Heard:
    """Everything of one kind that comes, decoded."""

    def __init__(self, session, key, message_type):
        self._samples, self._type = queue.SimpleQueue(), message_type
        self._subscriber = session.declare_subscriber(key, self._samples.put)

    def next(self):
        return codec.decode(self._type, self._samples.get(timeout=PATIENCE_S).payload.to_bytes())

    def so_far(self):
        found = []
        while not self._samples.empty():
            found.append(self.next())
        return found


def said(process, words):
    """Waits for a line on standard error."""
    for line in process.stderr:
        if words in line:
            return line
    pytest.fail(f"it ended without saying {words!r}")


@pytest.fixture
def endpoint(tmp_path):
    return f"unixsock-stream/{tmp_path}/bus"


# --- how it begins and ends -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_it_says_what_it_listens_to_and_ends_with_0(start_pcgan, endpoint, signum):
    process = start_pcgan("track", "--listen", endpoint, "--role", "camera.left:=/left/boxes", "--role", "pose:=/odom")
    line = said(process, "tracking on")
    assert f"tracking on {endpoint}: LiDAR clusters /velodyne/front/clusters, vehicle pose /odom, " in line
    assert "camera detections left, transforms /tf_static /tf; Ctrl-C ends it" in line
    with bus.open_session(connect=[endpoint]) as session:
        assert Heard(session, health_key("track"), NodeHealth).next().frames == 0  # it runs
    process.send_signal(signum)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert out == ""
    assert "Traceback" not in err


def test_in_a_terminal_it_shows_how_it_is_doing(endpoint):
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(theirs, (24, 150))
    command = [sys.executable, "-m", "replay.cli", "track", "--listen", endpoint]
    with subprocess.Popen(command, stderr=theirs, env={**os.environ, "TERM": "xterm"}) as process:
        os.close(theirs)
        seen = ""
        deadline = time.monotonic() + PATIENCE_S
        while "0 refused" not in seen and time.monotonic() < deadline:
            seen += os.read(ours, 4096).decode(errors="replace")
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
    os.close(ours)
    assert "in 0/s, out 0.0/s, 0 ms (p99 0), 0 dropped, 0 late, 0 refused" in seen


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--listen", "nonsense"), "zenoh cannot be opened on nonsense: "),
        (("--role", "clusters:=/front/*"), "topic '/front/*' cannot be a zenoh key"),
        (("--role", "radar:=/radar"), "there is no role radar"),
        (("--profile", "gone.toml"), "gone.toml cannot be read"),
        (("--time-offset", "/camera:=-80"), "/camera can have no time offset"),
    ],
)
def test_what_cannot_work_is_one_line(pcgan, arguments, words):
    outcome = pcgan("track", *arguments)
    assert outcome.code == 2
    (line,) = outcome.err.splitlines()
    assert line.startswith("pcgan: ")
    assert words in line


def test_a_report_is_one_line():
    health = NodeHealth(1, "track", "", 61.0, 9.97, 12.4, 31.6, 600, 3, 2, 1, "/tf refused: no transform", 412.4)
    assert health_line(health) == (
        "in 412/s, out 10.0/s, 12 ms (p99 32), 3 dropped, 2 late, 1 refused; /tf refused: no transform"
    )
    assert not health_line(NodeHealth(1, "track", "", 1.0, 0, 0, 0, 0, 0, 0, 0)).endswith(";")


# --- three processes --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_live_nodes_do_what_a_replay_does(start_pcgan, endpoint, recorded, short_drive, model):
    """A drive played at its own rate through track and predict gives the replay's tracks and predictions.

    They are the same to the last bit unless something came so late that it was no longer waited for: on a machine that
    stalls, the positions of a frame may then differ a little. Nine of ten must be the very same, the others near.
    """
    predict = start_pcgan("predict", "--model", model, "--listen", endpoint, "--namespace", "car7")
    said(predict, "serving random")
    track = start_pcgan("track", "--connect", endpoint, "--namespace", "car7", "--deadline-ms", 5000)
    said(track, "tracking on")
    with bus.open_shared_session(connect=[endpoint]) as session:
        health = Heard(session, health_key("track", "car7"), NodeHealth)
        health.next()
        tracks = Heard(session, topics.zenoh_key(topics.TRACKS, "car7"), TrackFrame)
        predictions = Heard(session, topics.zenoh_key(topics.PREDICTIONS, "car7"), PredictionFrame)
        play(session, short_drive, "car7")
        live = {frame.stamp_ns: frame for frame in (predictions.next() for _ in recorded.frames)}
        live_tracks = {frame.stamp_ns: frame for frame in tracks.so_far()}
        health.next()
        assert (health.next().dropped, predictions.so_far()) == (0, [])
    same = 0
    for frame in recorded.frames:
        now, then = live_tracks[frame.tracks.stamp_ns], frame.tracks
        assert [track.id for track in now.tracks] == [track.id for track in then.tracks]
        for one, other in zip(now.tracks, then.tracks, strict=True):
            assert one.state[:2] == pytest.approx(other.state[:2], abs=0.1)
        answer = live[frame.tracks.stamp_ns]
        if codec.encode(now) == codec.encode(then):
            same += 1
            assert codec.encode(answer) == codec.encode(frame.predictions)
    assert same >= 0.9 * len(recorded.frames)
    for process in (track, predict):
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0


@pytest.mark.slow
def test_nodes_that_are_killed_and_started_again_pick_up(start_pcgan, endpoint, drive, model):
    """Each of the two in turn, without a word, in the middle of a drive."""

    def start_tracker():
        process = start_pcgan("track", "--connect", endpoint)
        said(process, "tracking on")
        return process

    def start_predictor():
        process = start_pcgan("predict", "--model", model, "--connect", endpoint)
        said(process, "serving")
        return process

    with ExitStack() as stack:
        session = stack.enter_context(bus.open_shared_session(listen=[endpoint]))
        predictions = Heard(session, topics.zenoh_key(topics.PREDICTIONS), PredictionFrame)
        nodes = {"track": start_tracker(), "predict": start_predictor()}
        while not list(session.liveliness().get(any_alive_key())):
            time.sleep(0.05)
        reader = LogReader([drive])
        publisher = stack.enter_context(LogPublisher(session, played_topics(reader, TopicChoice(), {})))
        schedule = Schedule(2.0)
        schedule.restart(reader.start_ns)
        player = Player(schedule, NoKeys(), publisher.publish)
        messages = reader.messages(None)
        starts = {"track": start_tracker, "predict": start_predictor}
        answered = []
        for part, victim in enumerate(("track", "predict", None), start=1):
            until_ns = reader.start_ns + part * 2_000_000_000
            player.play(upto(messages, until_ns))
            answered.append([frame.stamp_ns for frame in predictions.so_far()])
            if victim is not None:
                nodes[victim].kill()
                nodes[victim].wait()
                nodes[victim] = starts[victim]()
                schedule.jump_to(until_ns)
        time.sleep(1)
        answered[-1] += [frame.stamp_ns for frame in predictions.so_far()]
    assert all(len(stamps) >= 10 for stamps in answered)  # of 20 scans each


def upto(messages, until_ns):
    for message in messages:
        yield message
        if message.log_time_ns >= until_ns:
            return
