"""The bus: keys that carry a model's identity, and sessions that open where they are told or say why not."""

import json
import socket
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
