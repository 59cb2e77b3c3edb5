"""Recording: what lies in the file, what survives a kill and a full disk, and that losses are counted."""

import json
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import zenoh
import zenoh.ext
from mcap.reader import make_reader

from pcgan import bus
from replay import recorder
from replay.bus_channels import ENCODING_KEY, BusChannel, announce, zenoh_encoding
from replay.errors import OutputError
from replay.log_reader import LogReader
from replay.logged_message import LoggedSchema
from replay.recorder import BusWriter, Inbox, record_bus
from replay.topic_choice import TopicChoice

STRING = LoggedSchema("std_msgs/msg/String", "ros2msg", b"string data")
TALK = BusChannel("/talk", STRING, "cdr", {"offered_qos_profiles": "- depth: 1"})
ALL = TopicChoice()


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Two sessions that meet: the recorder's, and somebody's who publishes."""
    endpoint = f"unixsock-stream/{tmp_path_factory.mktemp('bus')}/bus"
    with bus.open_shared_session(listen=[endpoint]) as one, bus.open_shared_session(connect=[endpoint]) as other:
        yield one, other


@pytest.fixture
def recording(sessions, tmp_path):
    """Records while entered, from when a publisher of `key` is heard; afterwards there are summary and content."""

    @contextmanager
    def record(choice=ALL, key="talk", **options):
        ready, stop, outcome = threading.Event(), threading.Event(), SimpleNamespace(path=tmp_path / "out.mcap")

        def run():
            outcome.summary = record_bus(
                sessions[0], outcome.path, choice, stop=stop.is_set, on_ready=ready.set, **options
            )

        thread = threading.Thread(target=run)
        thread.start()
        try:
            assert ready.wait(10)
            with sessions[1].declare_publisher(key) as probe:
                while not probe.matching_status.matching:
                    time.sleep(0.005)
            yield outcome
            list(sessions[1].get("nobody"))  # goes the way of what was put, and comes back when that has come
        finally:
            stop.set()
            thread.join(10)
        with outcome.path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            outcome.rows = list(reader.iter_messages())
            outcome.metadata = {record.name: record.metadata for record in reader.iter_metadata()}

    return record


def data_of(outcome):
    return [(channel.topic, message.data) for _, channel, message in outcome.rows]


def test_samples_lie_in_the_file_with_what_they_are(recording, sessions):
    before_ns = time.time_ns()
    with announce(sessions[1], {"talk": TALK}), recording() as outcome:
        for i in range(50):
            sessions[1].put("talk", b"%d" % i, encoding=zenoh_encoding(STRING, "cdr"))
        sessions[1].put("pcgan/tracks", b"t", encoding=bus.ENCODING.with_schema("pcgan.v1.TrackFrame"))
        sessions[1].put("raw", b"r", encoding="application/cdr;other_msgs/msg/Unheard")
    assert data_of(outcome) == [("/talk", b"%d" % i) for i in range(50)] + [("/pcgan/tracks", b"t"), ("/raw", b"r")]
    (talk, channel, message), (tracks, _, _), (none, raw, _) = outcome.rows[0], outcome.rows[-2], outcome.rows[-1]
    assert LoggedSchema(talk.name, talk.encoding, talk.data) == STRING
    assert (channel.message_encoding, channel.metadata) == ("cdr", TALK.metadata)
    assert (tracks.name, b"TrackFrame" in tracks.data) == ("pcgan.v1.TrackFrame", True)
    assert none is None
    assert raw.metadata == {ENCODING_KEY: "application/cdr;other_msgs/msg/Unheard"}
    assert before_ns < message.publish_time <= message.log_time < time.time_ns()  # both clocks are this machine's
    assert [row[2].sequence for row in outcome.rows[:50]] == list(range(50))
    summary = outcome.summary
    assert summary.messages == Counter({"/talk": 50, "/pcgan/tracks": 1, "/raw": 1})
    assert summary.schemas["/talk"] == "std_msgs/msg/String"
    assert summary.payload_bytes == sum(len(data) for _, data in data_of(outcome))
    assert summary.dropped.total() == 0
    assert json.loads(outcome.metadata["pcgan record"]["dropped"]) == {}
    assert [info.messages for info in LogReader([outcome.path]).channels] == [1, 1, 50]


def test_only_what_is_chosen(recording, sessions):
    keys = ["car7/tf", "car7/tf_static", "car7/image", "car8/tf", "tf"]
    with recording(TopicChoice.of((), "tf", "static"), "car7/tf", namespace="car7") as outcome:
        for key in keys:
            sessions[1].put(key, key)
    assert data_of(outcome) == [("/tf", b"car7/tf")]


def test_names_are_subscribed_to_one_by_one(recording, sessions):
    with recording(TopicChoice.of(["/tf,image"]), "tf") as outcome:
        for key in ("tf", "tf_static", "image"):
            sessions[1].put(key, key)
        sessions[1].delete("tf")
    assert data_of(outcome) == [("/tf", b"tf"), ("/image", b"image")]


def test_what_was_said_before_is_recorded_once_and_first(recording, sessions):
    cache = zenoh.ext.CacheConfig(max_samples=10)
    with zenoh.ext.declare_advanced_publisher(sessions[1], "tf_static", cache=cache) as publisher:
        publisher.put(b"one")
        publisher.put(b"two")
        time.sleep(0.1)
        with recording() as outcome:
            publisher.put(b"three")
            sessions[1].put("talk", b"now")
    assert data_of(outcome) == [
        ("/tf_static", b"one"),
        ("/tf_static", b"two"),
        ("/tf_static", b"three"),
        ("/talk", b"now"),
    ]
    published_ns = [message.publish_time for _, _, message in outcome.rows]
    assert published_ns == sorted(published_ns)


def test_it_ends_after_the_duration(sessions, tmp_path):
    began_s = time.monotonic()
    summary = record_bus(sessions[0], tmp_path / "out.mcap", ALL, duration_s=0.3)
    assert 0.3 <= time.monotonic() - began_s < 5
    assert summary.messages.total() == 0
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap"]


def test_what_there_is_no_room_for_is_counted_and_the_rest_kept(recording, sessions):
    with recording(queue_bytes=100_000) as outcome:
        sessions[1].put("big", bytes(200_000))
        sessions[1].put("small", b"1")
    assert data_of(outcome) == [("/small", b"1")]
    assert outcome.summary.dropped == {"big": 1}
    assert json.loads(outcome.metadata["pcgan record"]["dropped"]) == {"big": 1}


def test_a_flood_of_keys_ends_nothing(recording, sessions, monkeypatch):
    monkeypatch.setattr(recorder, "MAX_CHANNELS", 3)
    with recording() as outcome:
        for i in range(20):
            sessions[1].put(f"flood/{i}", b"x")
        sessions[1].put("flood/0", b"y")
    assert data_of(outcome) == [("/flood/0", b"x"), ("/flood/1", b"x"), ("/flood/2", b"x"), ("/flood/0", b"y")]
    assert outcome.summary.dropped == {"others": 17}


def test_the_inbox_counts_bytes_and_gives_their_place_back():
    def sample(key, size):
        return SimpleNamespace(key_expr=key, payload=bytes(size), attachment=None, kind=zenoh.SampleKind.PUT)

    inbox = Inbox(lambda key: key != "unwanted", max_bytes=10_000)
    for key, size in [("a", 4000), ("unwanted", 9000), ("b", 4000), ("a", 4000), ("c", 10), ("b", 4000)]:
        inbox.put(sample(key, size))
    assert inbox.dropped == {"a": 1, "b": 1}
    assert [arrival.sample.key_expr for arrival in inbox.take(0)] == ["a", "b", "c"]
    attached = sample("a", 10)
    attached.attachment = bytes(10_000)
    inbox.put(attached)
    assert inbox.dropped["a"] == 2
    inbox.put(sample("a", 9000))
    arrivals = list(inbox.take(0))
    assert len(arrivals) == 1
    assert abs(time.time_ns() - arrivals[0].arrival_ns) < 10**10
    assert list(inbox.take(0.01)) == []


# --- the file --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("taken", ["out.mcap", "out.mcap.part"])
def test_nothing_is_overwritten(tmp_path, taken):
    (tmp_path / taken).write_bytes(b"mine")
    with pytest.raises(OutputError, match=rf"{taken} is there already; choose another name, or move it away$"):
        BusWriter(tmp_path / "out.mcap")
    assert (tmp_path / taken).read_bytes() == b"mine"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(OutputError, match=r"gone.out\.mcap cannot be written: No such file or directory"):
        BusWriter(tmp_path / "gone" / "out.mcap")


def test_after_an_error_the_part_stays(tmp_path):
    def fail_while_writing():
        with BusWriter(tmp_path / "out.mcap") as writer:
            writer.write(TALK, 1, 1, b"x")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_while_writing()
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap.part"]


_KILLED = """
import os, signal, sys
from pathlib import Path
from replay.bus_channels import BusChannel
from replay.logged_message import LoggedSchema
from replay.recorder import BusWriter

writer = BusWriter(Path(sys.argv[1]))
channel = BusChannel("/a", LoggedSchema("x", "jsonschema", b"{}"), "json")
for i in range(3000):
    writer.write(channel, i + 1, i + 1, b"%d" % i + bytes(1000))
writer.flush()
for i in range(10):
    writer.write(channel, 10_000 + i, 1, b"lost")
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_kill_loses_the_open_chunk_alone(tmp_path):
    killed = subprocess.run([sys.executable, "-c", _KILLED, str(tmp_path / "out.mcap")], check=False, timeout=60)
    assert killed.returncode == -signal.SIGKILL
    messages = list(LogReader([tmp_path / "out.mcap.part"], salvage=True).messages())
    assert [message.data for message in messages] == [b"%d" % i + bytes(1000) for i in range(3000)]


_FULL = """
import resource, signal, sys
from pathlib import Path
from replay.bus_channels import BusChannel
from replay.errors import OutputError
from replay.logged_message import NO_SCHEMA
from replay.recorder import BusWriter
import os

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))  # as a full disk: writing fails
try:
    with BusWriter(Path(sys.argv[1])) as writer:
        for i in range(100):
            writer.write(BusChannel("/a", NO_SCHEMA, ""), i + 1, i + 1, os.urandom(100_000))
            writer.flush()
except OutputError as error:
    print(error)
"""


def test_a_full_disk_is_one_line_and_the_part_stays(tmp_path):
    full = subprocess.run(
        [sys.executable, "-c", _FULL, str(tmp_path / "out.mcap")],
        check=False,
        timeout=60,
        capture_output=True,
        text=True,
    )
    assert full.stdout.startswith(f"{tmp_path / 'out.mcap'} cannot be written: File too large; what was is in out.mcap")
    assert (len(full.stdout.splitlines()), full.stderr) == (1, "")
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap.part"]
    kept = LogReader([tmp_path / "out.mcap.part"], salvage=True)
    assert len(list(kept.messages())) >= 8
