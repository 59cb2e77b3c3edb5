"""Who may ask the predictor and who may not, with the example configurations of docs/zenoh as they are documented.

Only their paths, ports and passwords are filled in. The predictor is the real command, in a process of its own, so that
its stderr is what an operator would read; certificates are made for the test.
"""

import json
import queue
import re
import socket
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
import trustme
import zenoh
import zenoh.ext

from pcgan import bus
from pcgan.predictor_process import what_if_key
from replay.bus_channels import BusChannel, announce, known_channels
from replay.errors import PredictorError
from replay.logged_message import NO_SCHEMA
from replay.remote_predictor import RemotePredictor
from schemas import codec, topics
from schemas.messages import PredictionFrame, TrackFrame

DOCS = Path(__file__).parents[2] / "docs" / "zenoh"
TRACKS, PREDICTIONS = topics.zenoh_key(topics.TRACKS), topics.zenoh_key(topics.PREDICTIONS)
WHAT_IF = what_if_key()
LISTENERS, ALL = ("tls_predict", "password_predict"), sorted(path.stem for path in DOCS.glob("*.json5"))


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """A folder as /etc/pcgan would be, with the certificates of an intruder's own authority under `foreign`."""
    folder = tmp_path_factory.mktemp("etc")
    for part in (folder, folder / "foreign"):
        part.mkdir(exist_ok=True)
        authority = trustme.CA()
        authority.cert_pem.write_to_path(str(part / "ca.pem"))
        for name in ("predict", "replay", "viewer"):
            issued = authority.issue_cert("127.0.0.1", common_name=name)
            (part / f"{name}.pem").write_bytes(b"".join(pem.bytes() for pem in issued.cert_chain_pems))
            issued.private_key_pem.write_to_path(str(part / f"{name}.key"))
    users = {"predict": "p", "replay": "r", "viewer": "v", "track": "t", "sensors": "s"}
    (folder / "users.txt").write_text("".join(f"{name}:secret-{end}\n" for name, end in users.items()))
    return folder


@pytest.fixture
def filled(certificates, tmp_path):
    """Writes an example of docs/zenoh with its paths, port and passwords filled in; `changes` replaces more text."""
    port = free_port()

    def fill(name: str, **changes: str) -> Path:
        text = (DOCS / f"{name}.json5").read_text()
        usual = {
            "/etc/pcgan": str(certificates),
            ":7447": f":{port}",
            "PREDICT-PASSWORD": "secret-p",
            "REPLAY-PASSWORD": "secret-r",
        }
        for old, new in (*changes.items(), *usual.items()):
            text = text.replace(old, new)
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}_{name}.json5"
        path.write_text(text)
        return path

    return fill


def as_client(path: Path) -> zenoh.Session:
    """Opens a configuration as a client: a peer passes on what clients send, not what other peers send."""
    config = zenoh.Config.from_file(str(path))
    for key, value in {"mode": "client", "connect/timeout_ms": 100}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@pytest.fixture
def predictor(start_pcgan, filled, model):
    """Starts `pcgan predict` with an example; returns a handle that knows what it has said on stderr so far."""

    def start(name: str, **changes: str) -> SimpleNamespace:
        process = start_pcgan("predict", "--model", model, "--zenoh-config", filled(name, **changes))
        said: list[str] = []
        threading.Thread(target=lambda: said.extend(iter(process.stderr.readline, "")), daemon=True).start()
        handle = SimpleNamespace(process=process, said=said)
        wait_for(handle, "serving random")
        return handle

    return start


def wait_for(predictor: SimpleNamespace, text: str, timeout_s: float = 30.0) -> str:
    """Waits until the predictor has said something; returns the line."""
    deadline = time.monotonic() + timeout_s
    while True:
        for line in tuple(predictor.said):
            if text in line:
                return line
        assert predictor.process.poll() is None, predictor.said
        assert time.monotonic() < deadline, f"the predictor never said {text!r}: {predictor.said}"
        time.sleep(0.02)


def asker(config: Path) -> RemotePredictor:
    """Returns what asks the predictor in `pcgan replay --predictor external`."""
    return RemotePredictor(bus.open_session(config_file=config), startup_s=10, hang_s=5, max_failures=1)


REFUSED = {
    "no certificate": (
        "tls",
        {"connect_": "// connect_", "enable_mtls: true": "enable_mtls: false"},
        "no certificates",
    ),
    "another authority's": ("tls", {"pcgan/replay": "pcgan/foreign/replay"}, "UnknownIssuer"),
    "no encryption": ("tls", {'"tls"': '"tcp"', "tls/": "tcp/"}, "corrupt message"),
    "wrong password": ("password", {"REPLAY-PASSWORD": "guess"}, "wrong password"),
    "unknown user": ("password", {'"replay"': '"mallory"'}, "unknown user"),
    "no credentials": ("password", {"auth:": "// auth:"}, "no user and password"),
}


@pytest.fixture
def opened():
    """Opens sessions from files, as peers; all are closed at the end, or the interpreter would wait for them."""
    with ExitStack() as sessions:
        yield lambda config: sessions.enter_context(bus.open_session(config_file=config))


@pytest.mark.parametrize("kind", ["tls", "password"])
def test_who_may_ask_is_answered_and_intruders_get_nothing_and_are_named(kind, predictor, filled, make, opened):
    running = predictor(f"{kind}_predict")
    fake = codec.encode(PredictionFrame(3, make.stamp(0), "odom", "fake", 0.1))
    intruders, got = [], []
    for of_kind, changes, _ in REFUSED.values():
        if of_kind == kind:
            config = filled(f"{kind}_replay", **changes)
            with pytest.raises(zenoh.ZError):
                as_client(config).close()
            intruders.append(opened(config))  # as a peer, which goes on trying
            intruders[-1].declare_subscriber("**", got.append, allowed_origin=zenoh.Locality.REMOTE)

    seen: list[bytes] = []
    victim = opened(filled(f"{kind}_replay"))
    watching = victim.declare_subscriber(PREDICTIONS, lambda sample: seen.append(sample.payload.to_bytes()))
    with asker(filled(f"{kind}_replay")) as asking:
        for sequence in range(3):
            for intruder in intruders:
                intruder.put(TRACKS, codec.encode(TrackFrame(666, make.stamp(0), "odom")))
                intruder.put(PREDICTIONS, fake)
            asking.ask(TrackFrame(sequence, make.stamp(0), "odom", tracks=(make.track(0),)), make.pose(0))
            answer = asking.answer()
            assert (answer.sequence, answer.model) == (sequence, "random")
    assert [codec.decode(PredictionFrame, data).sequence for data in seen] == [0, 1, 2]
    assert not got
    watching.undeclare()
    with pytest.raises(PredictorError, match="no predictor"):  # what somebody with a typo in his password reads
        RemotePredictor(intruders[0], startup_s=0.5)._wait_until_ready()

    for of_kind, _, why in REFUSED.values():
        if of_kind == kind:
            line = wait_for(running, why)
            assert line.startswith("refused a peer: "), line


@pytest.mark.parametrize("kind", ["tls", pytest.param("password", marks=pytest.mark.slow)])  # their rules are the same
def test_who_may_only_look_can_neither_ask_nor_pretend_to_be_the_predictor(kind, predictor, filled, make, opened):
    predictor(f"{kind}_predict")
    seen, looked, spied = [], [], []
    victim = opened(filled(f"{kind}_replay"))
    watching = victim.declare_subscriber(PREDICTIONS, lambda sample: seen.append(sample.payload.to_bytes()))
    as_viewer = {"pcgan/replay": "pcgan/viewer", '"replay"': '"viewer"', "REPLAY-PASSWORD": "secret-v"}
    fake = codec.encode(PredictionFrame(4, make.stamp(0), "odom", "fake", 0.1))
    with as_client(filled(f"{kind}_replay", **as_viewer)) as viewer, asker(filled(f"{kind}_replay")) as asking:
        looking = viewer.declare_subscriber(PREDICTIONS, looked.append, allowed_origin=zenoh.Locality.REMOTE)
        spying = viewer.declare_subscriber(TRACKS, spied.append, allowed_origin=zenoh.Locality.REMOTE)
        sequence = 0
        while not looked or sequence < 3:  # until a rightful question's answer reaches the viewer, too
            for _ in range(5):
                viewer.put(TRACKS, codec.encode(TrackFrame(666, make.stamp(0), "odom")))
                viewer.put(PREDICTIONS, fake)
            asking.ask(TrackFrame(sequence, make.stamp(0), "odom"), make.pose(0))
            asking.answer()
            sequence += 1
            assert sequence < 100
        looking.undeclare()
        spying.undeclare()
        what_if = codec.encode(TrackFrame(7, make.stamp(0), "odom"))
        allowed = [reply.ok for reply in victim.get(WHAT_IF, payload=what_if, timeout=5) if reply.ok]
        assert [codec.decode(PredictionFrame, sample.payload.to_bytes()).sequence for sample in allowed] == [7]
        assert not [reply for reply in viewer.get(WHAT_IF, payload=what_if, timeout=1) if reply.ok]
    watching.undeclare()
    assert [codec.decode(PredictionFrame, data).sequence for data in seen] == list(range(sequence))
    assert not spied


def test_sensors_and_a_tracker_come_in_with_the_rules_of_the_documentation(predictor, filled, start_pcgan, short_drive):
    """Who comes late gets what was said before; whoever may only sense cannot pretend to be the tracker."""
    [block] = re.findall("```json5\n(.*?)```", (DOCS.parent / "security.md").read_text(), re.DOTALL)
    _, rules, subjects, policies = re.split("// more .*\n", block)
    more = {"rules: [\n": rules, "subjects: [\n": subjects, "policies: [\n": policies}
    predictor("password_predict", **{place: place + text for place, text in more.items()})

    def client(user: str) -> Path:
        changes = {'"replay"': f'"{user}"', "REPLAY-PASSWORD": f"secret-{user[0]}", 'mode: "peer"': 'mode: "client"'}
        return filled("password_replay", **changes)

    played = start_pcgan(
        "play", short_drive, "--loop", "--exclude-regex", "simulation", "--zenoh-config", client("sensors")
    )
    played.stderr.readline()
    time.sleep(1)
    tracking = start_pcgan("track", "--zenoh-config", client("track"))
    tracking.stderr.readline()
    key, told = "gmsl/late/camera_info", BusChannel("/gmsl/late/camera_info", NO_SCHEMA, "json")
    with ExitStack() as ends:
        early = ends.enter_context(bus.open_shared_session(config_file=client("sensors")))
        ends.enter_context(announce(early, {key: told}))
        cache = zenoh.ext.CacheConfig(max_samples=1)
        said = ends.enter_context(zenoh.ext.declare_advanced_publisher(early, key, cache=cache))
        said.put(b"before")
        late = ends.enter_context(bus.open_shared_session(config_file=client("track")))
        heard = queue.SimpleQueue()
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        ends.enter_context(zenoh.ext.declare_advanced_subscriber(late, key, heard.put, history=history))
        assert heard.get(timeout=10).payload.to_bytes() == b"before"
        assert known_channels(late)[key] == told

    frames, forged = queue.SimpleQueue(), codec.encode(TrackFrame(666, 1, "odom"))
    with as_client(client("viewer")) as viewer, as_client(client("sensors")) as intruder:
        with viewer.declare_subscriber(PREDICTIONS, lambda sample: frames.put(sample.payload.to_bytes())):
            people = 0
            for _ in range(100):
                intruder.put(TRACKS, forged)
                frame = codec.decode(PredictionFrame, frames.get(timeout=30))
                assert frame.sequence != 666
                people += len(frame.predictions)
                if people > 20:
                    break
        assert people > 20
    for process in (tracking, played):
        process.terminate()
        process.wait(10)
    assert "calibration" not in tracking.stderr.read()


def test_without_access_control_the_same_fake_would_arrive(tmp_path):
    """The control of the test above: it is the rules that stop a client's fake, not the lack of a way."""
    endpoint = f"unixsock-stream/{tmp_path}/bus"
    with bus.open_session(listen=[endpoint]), bus.open_session(connect=[endpoint]) as victim:
        path = tmp_path / "client.json5"
        path.write_text(json.dumps({"mode": "client", "connect": {"endpoints": [endpoint]}}))
        with as_client(path) as intruder, victim.declare_subscriber(PREDICTIONS) as seen:
            deadline = time.monotonic() + 10
            while seen.try_recv() is None:
                intruder.put(PREDICTIONS, b"fake")
                assert time.monotonic() < deadline
                time.sleep(0.01)


# --- where sessions listen ------------------------------------------------------------------------------------------


def sockets() -> set[tuple[str, str]]:
    """Returns this process's listening TCP and bound UDP sockets with their addresses, as Linux lists them."""
    ours = {str(link.readlink()) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()}
    found = set()
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in (Path("/proc/net") / table).read_text().splitlines()[1:]:
            _, local, _, state, *_, inode = line.split()[:10]
            if (state == "0A" or "udp" in table) and f"socket:[{inode}]" in ours:
                found.add((table, local))
    return found


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs Linux's table of sockets")
@pytest.mark.parametrize("name", ["default", *(name for name in ALL if name != "ros2")])
def test_sessions_listen_on_loopback_at_most(name, filled):
    before = sockets()
    options = {"config_file": filled(name)} if name != "default" else {"listen": [f"tcp/127.0.0.1:{free_port()}"]}
    with bus.open_session(**options) as session:
        opened = sockets() - before
        listens = name == "default" or name in LISTENERS
        assert [(table, local.split(":")[0]) for table, local in opened] == [("tcp", "0100007F")] * listens
        assert not list(session.info.peers_zid())


@pytest.mark.parametrize("name", ALL)
def test_no_example_scouts_or_takes_part_in_gossip(name, filled):
    config = zenoh.Config.from_file(str(filled(name)))
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False
    if name != "ros2":  # a client does not gossip
        assert json.loads(config.get_json("scouting/gossip/enabled")) is False
    assert json.loads(config.get_json("transport/shared_memory/enabled")) is False


def test_the_examples_have_the_same_rules():
    def rules(name):
        return re.sub(
            "cert_common_names|usernames", "", (DOCS / f"{name}.json5").read_text().partition("access_control")[2]
        )

    assert rules("tls_predict") == rules("password_predict") != ""
