"""Faults that hit whole processes: kills, signals, a predictor that hangs, a link that is cut.

Faults at random moments, many of them, are `python -m benchmarks.faults`; the last test here runs one of each kind.
"""

import json
import os
import pty
import queue
import re
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from benchmarks import faults
from benchmarks.faults import Link, Running, free_port, listens, send
from pcgan import bus
from pcgan.bus import any_alive_key
from replay import PredictorChoice, Replay, record
from replay.log_reader import LogReader
from replay.player import LogPublisher, Player, Schedule, played_topics
from replay.remote_predictor import RemotePredictor
from replay.simulator import simulate
from replay.topic_choice import TopicChoice
from schemas import codec, topics
from schemas.messages import PredictionFrame

OLDER = b"an older output"
PATIENCE_S = 60


def rows(path, **options):
    return [(m.topic, m.log_time_ns, m.data) for m in LogReader([path], **options).messages()]


def until(condition, what, patience_s=PATIENCE_S):
    deadline = time.monotonic() + patience_s
    while not (found := condition()):
        assert time.monotonic() < deadline, f"{what} within {patience_s} s"
        time.sleep(0.01)
    return found


@pytest.fixture
def running():
    """Ends what a test has started, whatever became of the test."""
    started = []

    def begin(*arguments, **options):
        started.append(Running(*arguments, **options))
        return started[-1]

    yield begin
    for each in started:
        each.end()


# --- kill -9 ----------------------------------------------------------------------------------------------------------

_SMALL_CHUNKS = "import replay.log_writer; replay.log_writer.CHUNK_BYTES = 20_000"


def test_a_replay_that_is_killed_leaves_a_readable_part_and_nothing_else(running, drive, model, results, tmp_path):
    """Of its output, of the older one, of its predictor, of its socket."""
    output = tmp_path / "out.mcap"
    output.write_bytes(OLDER)
    arguments = ("replay", drive, "-o", output, "--model", model, "--window", 1)
    replaying = running(tmp_path, *arguments, before=_SMALL_CHUNKS)
    part = tmp_path / "out.mcap.part"
    until(lambda: (part.exists() and part.stat().st_size > 150_000) or replaying.ended, "nothing was written")
    assert replaying.predictors()
    assert len(list(replaying.temporary.iterdir())) == 1
    replaying.process.kill()
    assert replaying.wait()[0] == -signal.SIGKILL
    assert replaying.left_over() == []
    assert output.read_bytes() == OLDER
    salvaged = rows(part, salvage=True)
    tracks = [data for topic, _, data in salvaged if topic == topics.TRACKS.name]
    predictions = [data for topic, _, data in salvaged if topic == topics.PREDICTIONS.name]
    assert 5 < len(predictions) <= len(results)
    assert tracks == [codec.encode(frame.tracks) for frame in results[: len(tracks)]]
    assert predictions == [codec.encode(frame.predictions) for frame in results[: len(predictions)]]


@pytest.mark.slow
def test_a_predictor_killed_four_times_in_a_row_ends_in_one_line_and_a_valid_output(
    running, drive, model, results, tmp_path
):
    output, killed = tmp_path / "out.mcap", set()
    arguments = ("replay", drive, "-o", output, "--model", model, "--window", 1, "--rate", 2)
    replaying = running(tmp_path, *arguments)
    until((tmp_path / "out.mcap.part").exists, "nothing was written")
    time.sleep(0.7)
    while not replaying.ended:
        for pid in replaying.predictors():
            if pid not in killed and send(pid, signal.SIGKILL):
                killed.add(pid)
        time.sleep(0.001)
    code, said = replaying.wait()
    assert (code, len(killed)) == (2, 4)
    text = r"stopped early: the predictor .*killed by SIGKILL\).*; 3 replacements gave no answer either"
    assert re.search(text, " ".join(said.split())), said
    assert "Traceback" not in said
    found = rows(output)
    predictions = [data for topic, _, data in found if topic == topics.PREDICTIONS.name]
    assert 0 < len(predictions) < len(results)
    assert predictions == [codec.encode(frame.predictions) for frame in results[: len(predictions)]]
    assert replaying.left_over() == []


# --- signals ----------------------------------------------------------------------------------------------------------

_UP = "print('up', flush=True)"


@pytest.mark.parametrize("delay_s", [0.1, 0.3])  # the first milliseconds are Python's own
def test_ctrl_c_while_python_imports_is_quiet(delay_s):
    """By itself Python prints a traceback of half its modules."""
    process = subprocess.Popen(
        [sys.executable, "-c", f"import replay.__main__ as entry; {_HEARS}; {_UP}; entry.main()", "--help"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout.readline() == "up\n"
    time.sleep(delay_s)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, err) == (130, "")
    assert "Usage" not in out


_HEARS = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"  # a background shell has it ignored


@pytest.fixture(scope="module")
def long_drive(tmp_path_factory):
    """A drive of which every command has some seconds to do."""
    path = tmp_path_factory.mktemp("drives") / "long.mcap"
    simulate(path, clip=None, vehicle=None, pedestrians=12, duration_s=40.0, seed=6)
    return path


COMMANDS = [  # what other tests of the commands leave out
    ("simulate to/out.mcap --duration 600", signal.SIGINT),
    ("label long.mcap -o to/out.csv --json to/labels.json", signal.SIGHUP),
    ("whatif long.mcap --at 39 --brake --json to/futures.json", signal.SIGINT),
]


@pytest.mark.slow
@pytest.mark.parametrize(("command", "signum"), COMMANDS)
def test_other_commands_leave_nothing_half_written(running, long_drive, tmp_path, command, signum):
    """Twice in a row, as impatient people do."""
    (tmp_path / "to").mkdir()
    places = {"to/": f"{tmp_path}/to/", "long.mcap": str(long_drive)}
    words = [re.sub("to/|long.mcap", lambda found: places[found[0]], word) for word in command.split()]
    process = running(tmp_path, *words)
    time.sleep(2.0)
    for _ in range(2):
        if not process.ended:
            process.process.send_signal(signum)
    code, said = process.wait()
    assert code in (128 + signum, -signum, 0), said
    assert "Traceback" not in said
    assert code == 0 or all(path.suffix == ".part" for path in (tmp_path / "to").iterdir())


@pytest.mark.slow
def test_a_terminal_that_is_closed_leaves_a_valid_output(drive, model, results, tmp_path):
    """Its programs get SIGHUP and, when they say how it went, an error."""
    output = tmp_path / "out.mcap"
    child, terminal = pty.fork()
    if child == 0:  # pragma: no cover  in the other process
        arguments = ["replay", str(drive), "-o", str(output), "--model", str(model), "--rate", "1"]
        os.execv(sys.executable, [sys.executable, "-m", "replay", *arguments])
    until((tmp_path / "out.mcap.part").exists, "nothing was written")
    time.sleep(1.0)
    os.close(terminal)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 128 + signal.SIGHUP
    predictions = [data for topic, _, data in rows(output) if topic == topics.PREDICTIONS.name]
    assert 0 < len(predictions) < len(results)
    assert predictions == [codec.encode(frame.predictions) for frame in results[: len(predictions)]]
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap"]


# --- a predictor that hangs, a link that is cut -----------------------------------------------------------------------


@pytest.mark.slow
def test_a_predictor_that_is_stopped_for_good_is_replaced(running, short_drive, model, recorded, tmp_path):
    """Its patience is cut from 30 to 3 s."""
    patience = "import replay.remote_predictor as p; p.RemotePredictor.__init__.__kwdefaults__['hang_s'] = 3.0"
    arguments = ("replay", short_drive, "-o", tmp_path / "out.mcap", "--model", model, "--rate", 1)
    replaying = running(tmp_path, *arguments, "--json", tmp_path / "summary.json", before=patience)
    until((tmp_path / "out.mcap.part").exists, "nothing was written")
    time.sleep(0.7)
    assert send(replaying.predictor(), signal.SIGSTOP)
    code, said = replaying.wait()
    assert code == 0, said
    assert (tmp_path / "out.mcap").read_bytes() == recorded.path.read_bytes()
    assert json.loads((tmp_path / "summary.json").read_text())["predictor_restarts"] == 1
    assert replaying.left_over() == []


@pytest.mark.slow
def test_a_predictor_that_hangs_while_it_starts_is_replaced(short_drive, model, recorded, tmp_path, monkeypatch):
    """The first one sleeps for ever. Patience is cut from 60 to 12 s."""
    wrapper = tmp_path / "python"
    slept = f'[ -e "{tmp_path}/slept" ] || {{ touch "{tmp_path}/slept"; exec sleep 1000; }}'
    wrapper.write_text(f'#!/bin/sh\n{slept}\nexec "{sys.executable}" "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(wrapper))
    monkeypatch.setitem(RemotePredictor.__init__.__kwdefaults__, "startup_s", 12.0)
    summary = record(Replay([short_drive], None, PredictorChoice("spawned", model)), tmp_path / "out.mcap")
    assert summary.stopped is None
    assert summary.restarts == 1
    assert (tmp_path / "out.mcap").read_bytes() == recorded.path.read_bytes()


@pytest.fixture
def served(running, model, tmp_path):
    """A predictor that listens, and a link to it."""
    port = free_port()
    predictor = running(tmp_path, "predict", "--model", model, "--listen", f"tcp/127.0.0.1:{port}")
    until(lambda: listens(port), "nobody listened")
    link = Link(port)
    yield SimpleNamespace(port=port, link=link, predictor=predictor)
    link.close()


@pytest.mark.slow
@pytest.mark.parametrize(("how", "for_s"), [("cut", 3.0), ("stalled", 3.0), ("stalled", 13.0)])
def test_a_link_that_is_cut_and_restored_changes_nothing(running, served, short_drive, recorded, tmp_path, how, for_s):
    """Stalled for longer than zenoh's lease of 10 s, a link is given up, and another one made."""
    output = tmp_path / "out.mcap"
    arguments = ("replay", short_drive, "-o", output, "--rate", 1, "--json", tmp_path / "summary.json")
    replaying = running(tmp_path, *arguments, "--predictor", "external", "--connect", served.link.endpoint)
    until((tmp_path / "out.mcap.part").exists, "nothing was written")
    time.sleep(0.8)
    served.link.cut() if how == "cut" else served.link.stall()
    time.sleep(for_s)
    assert not replaying.ended
    served.link.restore()
    code, said = replaying.wait()
    assert code == 0, said
    assert output.read_bytes() == recorded.path.read_bytes()
    again = how == "cut" or for_s > 10
    assert (json.loads((tmp_path / "summary.json").read_text())["predictor_restarts"] > 0) == again
    assert (served.link.connections > 1) == again


class NoKeys:
    def press(self, timeout_s):
        time.sleep(timeout_s)


@pytest.mark.slow
def test_live_nodes_meet_again_when_their_link_is_restored(running, served, drive, tmp_path):
    """The tracker is cut off for 2 of 6 s: what it did not hear then is lost, and the rest is answered."""
    tracker = running(tmp_path, "track", "--connect", served.link.endpoint)
    with bus.open_shared_session(connect=[f"tcp/127.0.0.1:{served.port}"]) as session:
        heard = queue.SimpleQueue()
        subscriber = session.declare_subscriber(topics.zenoh_key(topics.PREDICTIONS), heard.put)
        until(lambda: list(session.liveliness().get(any_alive_key())), "no predictor")
        until(lambda: list(session.liveliness().get("pcgan/tracker/*")), "no tracker")
        reader, schedule = LogReader([drive]), Schedule(1.0)
        with LogPublisher(session, played_topics(reader, TopicChoice(), {})) as publisher:
            schedule.restart(reader.start_ns)
            player, messages, stamps_s = Player(schedule, NoKeys(), publisher.publish), reader.messages(), []
            for end_s, act in ((2.0, served.link.cut), (4.0, served.link.restore), (7.0, lambda: None)):
                player.play(upto(messages, reader.start_ns + round(end_s * 1e9)))
                act()
            time.sleep(1.0)
        while not heard.empty():
            frame = codec.decode(PredictionFrame, heard.get().payload.to_bytes())
            stamps_s.append((frame.stamp_ns - reader.start_ns) / 1e9)
        subscriber.undeclare()
    assert not tracker.ended
    assert len([stamp for stamp in stamps_s if stamp < 2.0]) >= 10
    assert not [stamp for stamp in stamps_s if 2.2 < stamp < 3.8]
    assert len([stamp for stamp in stamps_s if stamp > 4.0]) >= 5
    assert stamps_s == sorted(set(stamps_s))  # none twice


def upto(messages, until_ns):
    for message in messages:
        yield message
        if message.log_time_ns >= until_ns:
            return


# --- recording --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["killed", "disk full"])
def test_a_recording_keeps_what_came_before_the_last_second(running, tmp_path, fault):
    output, port = tmp_path / "out.mcap", free_port()
    recorder = running(tmp_path, "record", "-o", output, "--all", "--listen", f"tcp/127.0.0.1:{port}")
    part = tmp_path / "out.mcap.part"
    until(lambda: listens(port) and part.exists(), "nothing was recorded")
    with (
        bus.open_shared_session(connect=[f"tcp/127.0.0.1:{port}"]) as session,
        session.declare_publisher("talk") as publisher,
    ):
        until(lambda: publisher.matching_status.matching, "nobody listened")
        put = []
        if fault == "disk full":
            import resource

            resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (300_000, 300_000))
        while (not put or time.monotonic() < put[0][0] + 4.0) and not recorder.ended:
            put.append((time.monotonic(), os.urandom(10_000)))
            publisher.put(put[-1][1])
            time.sleep(0.05)
    killed_s = time.monotonic()
    if fault == "killed":
        recorder.process.kill()
    code, said = recorder.wait()
    kept = [data for topic, _, data in rows(part, salvage=True) if topic == "/talk"]
    assert kept == [data for _, data in put[: len(kept)]]
    if fault == "killed":
        assert code == -signal.SIGKILL
        assert len(kept) >= len([at_s for at_s, _ in put if at_s < killed_s - 2.0]) > 10
    else:
        assert code == 2
        line = said.splitlines()[-1]
        assert line == f"pcgan: {output} cannot be written: File too large; what was is in out.mcap.part"
        assert "Traceback" not in said
        assert len(kept) >= 20
    assert not output.exists()


# --- all of them ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_faults_at_random_moments():
    outcomes = faults.run(repeats=1, seed=7, at_once=2)
    assert len(outcomes) == len(faults.FAULTS)
    assert [problem for outcome in outcomes for problem in outcome.forbidden] == [], faults.report(outcomes)
