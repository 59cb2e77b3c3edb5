"""The zenoh bus between replay, live nodes and predictor: one place for its settings and keys.

Everything binds to loopback or a private socket, multicast scouting off, unless a zenoh configuration file says more.
"""

import json
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import zenoh

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
MAX_PAYLOAD_BYTES = 16 * 2**20  # a frame of 1000 tracks has 2 MB; anything larger than this is no frame
ENCODING = zenoh.Encoding.APPLICATION_PROTOBUF
SETTLED = "pcgan/settled"  # nobody answers there
_ALIVE = "pcgan/predictor"
_LONGEST_REASON = 300  # zenoh may quote a whole configuration, passwords and all
_MOMENT_S = 0.1  # 0.05 was enough for all of 2000 messages of 20 KB


class BusError(Exception):
    """A zenoh session that cannot be opened as asked."""


@dataclass(frozen=True)
class ModelIdentity:
    """Which weights a predictor runs."""

    name: str
    checksum: str  # SHA-256 of the checkpoint file, hexadecimal


def open_session(
    *, listen: Sequence[str] = (), connect: Sequence[str] = (), config_file: Path | None = None
) -> zenoh.Session:
    """Opens a peer that listens and connects where it is told, and nowhere else.

    A configuration file is taken as it is (TLS, access control, scouting); endpoints given here replace the file's.
    Raises BusError if the file is unusable or an endpoint cannot be listened on. Connecting is retried in the
    background.
    """
    return _open(listen, connect, config_file)


def open_shared_session(
    *, listen: Sequence[str] = (), connect: Sequence[str] = (), config_file: Path | None = None, wait_s: float = 10.0
) -> zenoh.Session:
    """Opens a session on the bus that all programs of ours on a machine share, whichever is started first.

    Without arguments the first one listens on DEFAULT_ENDPOINT and routes between the others, which connect there; when
    it ends, they wait for the next that listens. An endpoint to listen on makes this session such a router, endpoints
    to connect to make it one of the others. With a configuration file its own mode holds. Messages are timestamped, as
    zenoh's caches for late subscribers need it.

    Raises BusError as `open_session`, and if nothing listens where to connect within wait_s.
    """
    if config_file is not None:
        return _open(listen, connect, config_file, _TIMESTAMPS)
    if listen:
        return _open(listen, connect, None, _ROUTER)
    there = _config((), connect or [DEFAULT_ENDPOINT], None, _CLIENT)
    deadline_s = time.monotonic() + wait_s
    while True:
        try:
            if not connect:
                return _open([DEFAULT_ENDPOINT], (), None, _ROUTER)
        except BusError:  # most likely the endpoint is taken, by one of ours
            pass
        try:
            return zenoh.open(there)
        except zenoh.ZError as error:  # nobody there yet; or somebody left between our two attempts
            if time.monotonic() >= deadline_s:
                raise _bus_error(connect or [DEFAULT_ENDPOINT], None, error) from error
            time.sleep(0.1)


def settle(session: zenoh.Session, timeout_s: float = 60.0) -> None:
    """Waits until what was put has gone to where the session is connected; call it before closing a session.

    A session that is closed drops what it has not sent yet, and damages the message that it is just sending: 30 to 40
    of 2000 were lost on a busy machine, and one arrived with other bytes. To a router a query goes the same way behind
    them, and ends when it has been seen; that takes `timeout_s` at most, where a subscriber stalls. Peers and clients
    are asked nothing that nobody answers: they are left a moment instead.
    """
    for _ in session.get(SETTLED, timeout=timeout_s):
        pass
    if any(link.whatami != zenoh.WhatAmI.ROUTER for link in session.info.transports()):
        time.sleep(_MOMENT_S)


_TIMESTAMPS = {"timestamping/enabled": True}
_ROUTER = _TIMESTAMPS | {"mode": "router"}
# Peers that meet at a router without gossip are not routed to each other (0 of 5 messages), clients are (5 of 5).
# A client that cannot connect blocks in zenoh.open for as long as its time-out: better to fail at once, and to retry
# here, where Ctrl-C is heard. Once it is connected, zenoh itself looks for the next router.
_CLIENT = _TIMESTAMPS | {
    "mode": "client",
    "connect/timeout_ms": 0,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
}


def _open(
    listen: Sequence[str],
    connect: Sequence[str],
    config_file: Path | None,
    changes: Mapping[str, object] = MappingProxyType({}),
) -> zenoh.Session:
    config = _config(listen, connect, config_file, changes)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise _bus_error((*listen, *connect), config_file, error) from error


def _config(
    listen: Sequence[str], connect: Sequence[str], config_file: Path | None, changes: Mapping[str, object]
) -> zenoh.Config:
    try:
        config = zenoh.Config.from_file(str(config_file)) if config_file else _loopback_config()
        if listen or not config_file:
            config.insert_json5("listen/endpoints", json.dumps(list(listen)))
        if connect or not config_file:
            config.insert_json5("connect/endpoints", json.dumps(list(connect)))
        for key, value in changes.items():
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        raise _bus_error((*listen, *connect), config_file, error) from error
    return config


def _bus_error(endpoints: Sequence[str], config_file: Path | None, error: zenoh.ZError) -> BusError:
    where = ", ".join(endpoints) or str(config_file)
    return BusError(f"zenoh cannot be opened on {where}: {plain_reason(error)}")


def plain_reason(error: zenoh.ZError) -> str:
    """Returns what zenoh complains of, without the places in its source and without files it was given."""
    reason = re.sub(r"\s+at /\S+\.rs:\d+\.", "", str(error))  # where zenoh's source lay when it was compiled
    return reason if len(reason) < _LONGEST_REASON else f"{reason[:_LONGEST_REASON]}..."


def _loopback_config() -> zenoh.Config:
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # with BLOCK, zenoh closes a transport whose peer stalls for 5 s and then drops in silence
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,
        # zenoh's 2 lose live messages of 200 KB when a listener stalls for 0.3 s; with 16 none of 150 is lost
        "transport/link/tx/queue/size/data": 16,
        "transport/shared_memory/enabled": False,  # runs must repeat exactly
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def alive_key(model: ModelIdentity, session_id: str, namespace: str = "") -> str:
    """Returns the key of the liveliness token by which a predictor says that it serves, and with which weights."""
    return under(namespace, f"{_ALIVE}/{model.name}/{model.checksum}/{session_id}")


def any_alive_key(namespace: str = "") -> str:
    """Returns the key expression that matches every predictor's token."""
    return under(namespace, f"{_ALIVE}/*/*/*")


def model_of(key: str) -> ModelIdentity:
    """Reads the model's identity back from a token's key."""
    name, checksum, _ = key.rsplit("/", 3)[-3:]
    return ModelIdentity(name, checksum)


def under(namespace: str, key: str) -> str:
    """Returns a key or key expression under a namespace."""
    namespace = namespace.strip("/")
    return f"{namespace}/{key}" if namespace else key
