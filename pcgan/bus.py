"""The zenoh bus between replay, live nodes and predictor: one place for its settings and keys.

Everything binds to loopback or a private socket, multicast scouting off, unless a zenoh configuration file says more.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import zenoh

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
MAX_PAYLOAD_BYTES = 16 * 2**20  # a frame of 1000 tracks has 2 MB; anything larger than this is no frame
ENCODING = zenoh.Encoding.APPLICATION_PROTOBUF
_ALIVE = "pcgan/predictor"


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
    try:
        config = zenoh.Config.from_file(str(config_file)) if config_file else _loopback_config()
        if listen or not config_file:
            config.insert_json5("listen/endpoints", json.dumps(list(listen)))
        if connect or not config_file:
            config.insert_json5("connect/endpoints", json.dumps(list(connect)))
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join((*listen, *connect)) or str(config_file)
        raise BusError(f"zenoh cannot be opened on {where}: {error}") from error


def _loopback_config() -> zenoh.Config:
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # with BLOCK, zenoh closes a transport whose peer stalls for 5 s and then drops in silence
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,
        "transport/shared_memory/enabled": False,  # runs must repeat exactly
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def alive_key(model: ModelIdentity, session_id: str, namespace: str = "") -> str:
    """Returns the key of the liveliness token by which a predictor says that it serves, and with which weights."""
    return _under(namespace, f"{_ALIVE}/{model.name}/{model.checksum}/{session_id}")


def any_alive_key(namespace: str = "") -> str:
    """Returns the key expression that matches every predictor's token."""
    return _under(namespace, f"{_ALIVE}/*/*/*")


def model_of(key: str) -> ModelIdentity:
    """Reads the model's identity back from a token's key."""
    name, checksum, _ = key.rsplit("/", 3)[-3:]
    return ModelIdentity(name, checksum)


def _under(namespace: str, key: str) -> str:
    namespace = namespace.strip("/")
    return f"{namespace}/{key}" if namespace else key
