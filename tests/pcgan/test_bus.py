"""The bus: keys that carry a model's identity, and sessions that open where they are told or say why not."""

import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zenoh

from pcgan import bus

MODEL = bus.ModelIdentity("vehicle_10hz", "ab" * 32)


@pytest.mark.parametrize("namespace", ["", "car7", "/fleet/car7/"])
def test_a_token_carries_the_model(namespace):
    key = bus.alive_key(MODEL, "session9", namespace)
    assert bus.model_of(key) == MODEL
    assert not key.startswith("/")
    assert zenoh.KeyExpr(bus.any_alive_key(namespace)).includes(zenoh.KeyExpr(key))


def test_tokens_of_other_namespaces_are_not_matched():
    key = zenoh.KeyExpr(bus.alive_key(MODEL, "s", "car8"))
    assert not zenoh.KeyExpr(bus.any_alive_key("car7")).includes(key)
    assert not zenoh.KeyExpr(bus.any_alive_key()).includes(key)


def test_two_sessions_meet_on_a_private_socket(tmp_path):
    endpoint = f"unixsock-stream/{tmp_path}/bus"
    with bus.open_session(listen=[endpoint]) as one, bus.open_session(connect=[endpoint]) as other:
        publisher = other.declare_publisher("a/b")
        with one.declare_subscriber("a/b") as subscriber:
            for _ in range(200):
                publisher.put(b"hello")
                if (sample := subscriber.try_recv()) is not None:
                    break
                time.sleep(0.02)
            assert sample.payload.to_bytes() == b"hello"


def listening_ports():
    """Returns the TCP ports and bound UDP ports of this process, from Linux's own tables."""
    ours = {str(link.readlink()) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()}
    ports = set()
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in (Path("/proc/net") / table).read_text().splitlines()[1:]:
            fields = line.split()
            if (fields[3] == "0A" or "udp" in table) and f"socket:[{fields[9]}]" in ours:
                ports.add((table, int(fields[1].split(":")[1], 16)))
    return ports


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs Linux's table of sockets")
def test_nothing_listens_but_where_it_was_told(tmp_path):
    before = listening_ports()
    with bus.open_session(listen=[f"unixsock-stream/{tmp_path}/bus"]):
        assert listening_ports() == before
    with bus.open_session(listen=["tcp/127.0.0.1:0"]):
        assert [table for table, _ in listening_ports() - before] == ["tcp"]


def test_an_endpoint_that_is_taken_is_named():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(bus.BusError, match=rf"zenoh cannot be opened on {endpoint}: "):
            bus.open_session(listen=[endpoint])


def test_an_endpoint_that_is_none_is_named():
    with pytest.raises(bus.BusError, match="zenoh cannot be opened on nonsense: "):
        bus.open_session(listen=["nonsense"])


def test_a_configuration_file_that_cannot_be_used_is_named(tmp_path):
    path = tmp_path / "zenoh.json5"
    for text in (None, "{ not json", '{"mode": "emperor"}'):
        if text is not None:
            path.write_text(text)
        with pytest.raises(bus.BusError, match=r"zenoh cannot be opened on .*zenoh\.json5: "):
            bus.open_session(config_file=path)


def test_a_configuration_file_says_where_to_listen_unless_told_otherwise(tmp_path):
    path = tmp_path / "zenoh.json5"
    listen = [f"unixsock-stream/{tmp_path}/of_the_file"]
    path.write_text(json.dumps({
        "mode": "peer",
        "listen": {"endpoints": listen},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }))  # fmt: skip
    with bus.open_session(config_file=path):
        assert (tmp_path / "of_the_file").exists()
    with bus.open_session(config_file=path, listen=[f"unixsock-stream/{tmp_path}/told"]):
        assert (tmp_path / "told").exists()


# --- the bus that all programs share ----------------------------------------------------------------------------------


def heard(sender, receiver, timeout_s=10.0):
    """Tells whether what one session puts reaches the other."""
    deadline_s = time.monotonic() + timeout_s
    with receiver.declare_subscriber("a/b") as subscriber:
        while time.monotonic() < deadline_s:
            sender.put("a/b", b"hello")
            if subscriber.try_recv() is not None:
                return True
            time.sleep(0.01)
    return False


@pytest.fixture
def shared(tmp_path, monkeypatch):
    """Opens sessions on a default endpoint of the test's own."""
    monkeypatch.setattr(bus, "DEFAULT_ENDPOINT", f"unixsock-stream/{tmp_path}/default")
    opened = []

    def open_one(**options):
        opened.append(bus.open_shared_session(**options))
        return opened[-1]

    yield open_one
    for session in opened:
        if not session.is_closed():
            session.close()


def test_three_programs_without_options_hear_each_other(shared):
    one, two, three = shared(), shared(), shared()
    for sender, receiver in ((one, two), (two, one), (two, three), (three, two)):
        assert heard(sender, receiver)


def test_when_the_first_one_ends_the_others_meet_at_the_next(shared):
    first, two, three = shared(), shared(), shared()
    first.close()
    shared()
    assert heard(two, three)
    assert heard(three, two)


def test_whoever_is_told_to_listen_routes_between_those_who_connect(shared, tmp_path):
    endpoint = f"unixsock-stream/{tmp_path}/told"
    shared(listen=[endpoint])
    one, two, alone = shared(connect=[endpoint]), shared(connect=[endpoint]), shared()
    assert heard(one, two)
    assert not heard(one, alone, timeout_s=0.3)


def test_a_session_of_its_own_can_talk_to_the_shared_bus(shared, tmp_path):
    """`pcgan replay --predictor external` opens one with `open_session`."""
    endpoint = f"unixsock-stream/{tmp_path}/told"
    router, client = shared(listen=[endpoint]), shared(connect=[endpoint])
    with bus.open_session(connect=[endpoint]) as peer:
        for other in (router, client):
            assert heard(peer, other)
            assert heard(other, peer)


def test_messages_on_the_shared_bus_are_timestamped(shared, tmp_path):
    path = tmp_path / "zenoh.json5"
    path.write_text(json.dumps({"mode": "peer", "scouting": {"multicast": {"enabled": False}}}))
    for session in (shared(), shared(), shared(config_file=path, listen=[f"unixsock-stream/{tmp_path}/file"])):
        with session.declare_subscriber("own") as subscriber:
            session.put("own", b"x")
            assert subscriber.recv().timestamp is not None


def test_nobody_to_connect_to_is_an_error_after_a_while(shared, tmp_path):
    began_s = time.monotonic()
    with pytest.raises(
        bus.BusError, match=r"^zenoh cannot be opened on unixsock-stream/.*: Unable to connect"
    ) as error:
        shared(connect=[f"unixsock-stream/{tmp_path}/nobody"], wait_s=0.3)
    assert 0.3 <= time.monotonic() - began_s < 5
    assert ".rs:" not in str(error.value)


def test_an_endpoint_that_is_none_is_named_at_once(shared):
    began_s = time.monotonic()
    for options in ({"listen": ["nonsense"]}, {"connect": ["nonsense"]}):
        with pytest.raises(bus.BusError, match="zenoh cannot be opened on nonsense: "):
            shared(**options)
    assert time.monotonic() - began_s < 5


_PUTS_AND_LEAVES = """
import sys
import time
import zenoh
from pcgan import bus

opened, side, endpoint = sys.argv[1:]
session = getattr(bus, opened)(**{side: [endpoint]})
publisher = session.declare_publisher("a/b", congestion_control=zenoh.CongestionControl.BLOCK)
while not publisher.matching_status.matching:
    time.sleep(0.01)
for i in range(2000):
    publisher.put(i.to_bytes(4, "big") * 5000)
bus.settle(session)
session.close()
"""


@pytest.mark.parametrize(
    ("opened", "side", "ours"),
    [
        ("open_shared_session", "connect", "listen"),
        ("open_shared_session", "listen", "connect"),
        ("open_session", "connect", "listen"),
    ],
    ids=["client", "router", "peer"],
)
def test_what_was_put_before_leaving_arrives_whole(tmp_path, opened, side, ours):
    """Without `settle` some of the last messages are lost, and one is damaged."""
    endpoint, got = f"unixsock-stream/{tmp_path}/told", []

    def take(sample):
        time.sleep(0.0002)  # so that the other side has a queue when it leaves
        data = sample.payload.to_bytes()
        got.append(int.from_bytes(data[:4], "big") if data == data[:4] * 5000 else None)

    with (
        subprocess.Popen([sys.executable, "-c", _PUTS_AND_LEAVES, opened, side, endpoint]) as process,
        getattr(bus, opened)(**{ours: [endpoint]}) as session,
        session.declare_subscriber("a/b", take),
    ):
        assert process.wait(60) == 0
        deadline_s = time.monotonic() + 10
        while len(got) < 2000 and time.monotonic() < deadline_s:
            time.sleep(0.02)
    assert got == list(range(2000))
