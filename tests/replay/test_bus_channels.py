"""What a message on the bus is: keys and encodings there and back, and definitions from whoever publishes."""

import time
from types import SimpleNamespace

import pytest
import zenoh

from pcgan import bus
from replay import bus_channels
from replay.bus_channels import BusChannel, Channels, announce, channel_of, known_channels, raw_message
from replay.decoders import decoders_for
from replay.logged_message import NO_SCHEMA, LoggedSchema, RawMessage

CAMERA_INFO = LoggedSchema("sensor_msgs/msg/CameraInfo", "ros2msg", b"std_msgs/Header header\n\xff\x00")
INFO = BusChannel("/a/info", CAMERA_INFO, "cdr", {"offered_qos_profiles": "- history: 3"})


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Two sessions that meet."""
    endpoint = f"unixsock-stream/{tmp_path_factory.mktemp('bus')}/bus"
    with bus.open_shared_session(listen=[endpoint]) as one, bus.open_shared_session(connect=[endpoint]) as other:
        yield one, other


@pytest.fixture
def sent(sessions):
    """Sends one message and returns the sample that the other session gets."""
    sender, receiver = sessions

    def send(key, data=b"x", encoding=None):
        with receiver.declare_subscriber(key) as subscriber, sender.declare_publisher(key) as publisher:
            while not publisher.matching_status.matching:
                time.sleep(0.005)
            publisher.put(data, encoding=encoding)  # once: a second one would be there for the next test
            return subscriber.recv()

    return send


def eventually(ask, wanted, timeout_s=5.0):
    """Asks until the answer is the wanted one; declarations take a moment to get around."""
    deadline_s = time.monotonic() + timeout_s
    while (answer := ask()) != wanted and time.monotonic() < deadline_s:
        time.sleep(0.02)
    return answer


# --- keys ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("topic", "namespace", "key"),
    [
        ("/tf", "", "tf"),
        ("/gmsl/A0/image", "car7", "car7/gmsl/A0/image"),
        ("/a", "/fleet/car7/", "fleet/car7/a"),
        ("/with space/ä", "", "with space/ä"),
    ],
)
def test_a_topic_becomes_a_key_and_a_topic_again(topic, namespace, key):
    assert bus_channels.key_of(topic, namespace) == key
    assert str(zenoh.KeyExpr(key)) == key
    assert bus_channels.topic_of(key, namespace) == topic


def test_a_key_outside_the_namespace_keeps_its_name():
    assert bus_channels.topic_of("car8/tf", "car7") == "/car8/tf"
    assert bus_channels.topic_of("car71/tf", "car7") == "/car71/tf"


@pytest.mark.parametrize("topic", ["", "/", "//a", "/a/", "/a//b", "/a*", "/$x", "/a?b", "/a#b"])
def test_a_topic_that_cannot_be_a_key_is_quoted(topic):
    with pytest.raises(
        ValueError, match=r"^topic '.*' cannot be a zenoh key: no part of it may be empty or hold one of"
    ):
        bus_channels.key_of(topic)


# --- encodings -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "schema_encoding", "encoding", "text"),
    [
        ("some.Thing", "protobuf", "protobuf", "application/protobuf;some.Thing"),
        ("sensor_msgs/msg/CameraInfo", "ros2msg", "cdr", "application/cdr;sensor_msgs/msg/CameraInfo"),
        ("foxglove.PoseInFrame", "jsonschema", "json", "application/json;foxglove.PoseInFrame"),
        ("sensor_msgs/CameraInfo", "ros1msg", "ros1", "application/x-ros1;sensor_msgs/CameraInfo"),
        ("x;y", "", "flatbuffer", "application/x-flatbuffer;x;y"),
        ("", "", "json", "application/json"),
        ("", "", "", "application/octet-stream"),
    ],
)
def test_an_encoding_says_schema_and_message_encoding(name, schema_encoding, encoding, text):
    schema = LoggedSchema(name, schema_encoding, b"")
    encoded = bus_channels.zenoh_encoding(schema, encoding)
    assert str(encoded) == text
    assert bus_channels.logged_schema(encoded) == (schema, encoding)
    assert bus_channels.logged_schema(text) == (schema, encoding)


def test_protobuf_is_said_as_the_predictor_says_it():
    schema = LoggedSchema("pcgan.v1.TrackFrame", "protobuf", b"")
    assert bus_channels.zenoh_encoding(schema, "protobuf") == bus.ENCODING.with_schema("pcgan.v1.TrackFrame")


@pytest.mark.parametrize("text", ["zenoh/bytes", "text/plain;utf-8", "image/png"])
def test_other_encodings_have_no_message_encoding(text):
    assert bus_channels.logged_schema(text)[1] == ""


@pytest.mark.parametrize("name", ["pcgan.v1.TrackFrame", "foxglove.CameraCalibration", "foxglove.Log"])
def test_definitions_that_everybody_knows_need_no_answer(name):
    schema, encoding = bus_channels.logged_schema(f"application/protobuf;{name}")
    assert name.rpartition(".")[2].encode() in schema.definition
    assert name == "foxglove.Log" or decoders_for(schema, encoding)


@pytest.mark.parametrize(
    "name", ["pcgan.v1.Nothing", "foxglove.Nothing", "foxglove.os.system", "foxglove.", "other.Log"]
)
def test_unknown_names_have_no_definition(name):
    assert bus_channels.well_known_definition(name) == b""


# --- definitions -----------------------------------------------------------------------------------------------------


def test_whoever_asks_gets_all_that_is_announced(sessions):
    one, other = sessions
    tf = BusChannel("tf", LoggedSchema("foxglove.FrameTransforms", "protobuf", bytes(range(256))), "protobuf")
    with announce(one, {"a/info": INFO}), announce(one, {"tf": tf}), announce(other, {"c": tf}):
        wanted = {"a/info": INFO, "tf": tf, "c": tf}
        assert eventually(lambda: known_channels(other), wanted) == wanted
        assert eventually(lambda: known_channels(one), wanted) == wanted
    assert eventually(lambda: known_channels(other), {}) == {}


def test_namespaces_are_apart(sessions):
    one, other = sessions
    with announce(one, {"car7/a/info": INFO}, "car7"):
        assert eventually(lambda: known_channels(other, "car7"), {"car7/a/info": INFO}) == {"car7/a/info": INFO}
        assert known_channels(other) == known_channels(other, "car8") == {}


@pytest.mark.parametrize(
    "nonsense",
    [b"\xff", b"[]", b"{}", b'{"channels": [{}]}', b'{"channels": 3}', b'{"channels": [["a", "b"]]}', b"[" * 100_000],
    ids=range(7),
)
def test_what_others_answer_is_refused_if_it_makes_no_sense(sessions, nonsense, caplog):
    one, other = sessions

    def answer(query):
        with query:
            query.reply("pcgan/channels/mad", nonsense)

    with announce(one, {"a/info": INFO}), one.declare_queryable("pcgan/channels/mad", answer):
        deadline_s = time.monotonic() + 5
        while not caplog.records and time.monotonic() < deadline_s:
            found = known_channels(other)
        assert found == {"a/info": INFO}
    assert "refused the channels on pcgan/channels/mad: " in caplog.text


def test_somebody_who_never_answers_costs_the_timeout_and_nothing_else(sessions):
    one, other = sessions
    kept = []
    with announce(one, {"a/info": INFO}), one.declare_queryable("pcgan/channels/silent", kept.append):
        assert eventually(lambda: known_channels(other, timeout_s=0.2), {"a/info": INFO}) == {"a/info": INFO}
        for _ in range(100):
            known_channels(other, timeout_s=0.2)
            if kept:
                break
        assert known_channels(other, timeout_s=0.2) == {"a/info": INFO}
    for query in kept:
        query.drop()


# --- samples ---------------------------------------------------------------------------------------------------------


def test_a_sample_is_what_was_announced(sent):
    sample = sent("a/info", b"\x00\x01bytes", bus_channels.zenoh_encoding(CAMERA_INFO, "cdr"))
    assert channel_of(sample, {"a/info": INFO}) == INFO
    assert raw_message(sample, {"a/info": INFO}, 123) == RawMessage(
        "/a/info", 123, CAMERA_INFO, "cdr", b"\x00\x01bytes"
    )


def test_a_sample_says_itself_what_nobody_announced(sent):
    sample = sent("car7/tracks", b"x", bus.ENCODING.with_schema("pcgan.v1.TrackFrame"))
    message = raw_message(sample, {}, 5, "car7")
    assert (message.topic, message.encoding, message.schema.name) == ("/tracks", "protobuf", "pcgan.v1.TrackFrame")
    assert message.schema.definition
    assert channel_of(sample, {}).metadata == {}


def test_a_sample_that_is_something_else_than_announced_goes_by_its_own_word(sent):
    sample = sent("a/info", b"{}", "application/json;foxglove.CameraCalibration")
    channel = channel_of(sample, {"a/info": INFO})
    assert channel.schema == LoggedSchema("foxglove.CameraCalibration", "jsonschema", b"")
    assert (channel.topic, channel.encoding) == ("/a/info", "json")


@pytest.mark.parametrize("text", ["zenoh/bytes", "application/cdr;other_msgs/msg/Unheard", "image/png"])
def test_what_cannot_be_read_keeps_its_encoding_for_a_recording(sent, text):
    channel = channel_of(sent("a/b", b"x", text), {})
    assert channel.metadata == {bus_channels.ENCODING_KEY: text}
    recorded = NO_SCHEMA  # such a channel is recorded without a schema
    assert str(bus_channels.zenoh_encoding(recorded, channel.encoding, channel.metadata)) == text


class Clock:
    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def asking(monkeypatch):
    """Channels on a clock of the test's own, that ask no bus but what it answers: (channels, clock, bus)."""
    clock = Clock()
    told = SimpleNamespace(channels={}, asked=0, takes_s=0.002)

    def known(*_):
        told.asked += 1
        clock.now_s += told.takes_s
        return dict(told.channels)

    monkeypatch.setattr(bus_channels, "known_channels", known)
    return Channels(None, clock=clock), clock, told


def sample_of(key, encoding):
    return SimpleNamespace(key_expr=key, encoding=zenoh.Encoding(encoding))


CDR = "application/cdr;sensor_msgs/msg/CameraInfo"


def test_a_publisher_that_tells_later_is_understood(asking):
    channels, clock, told = asking
    assert channels.of(sample_of("a/info", CDR)).schema.definition == b""
    told.channels = {"a/info": INFO}
    assert channels.of(sample_of("a/info", CDR)).schema.definition == b""  # it has only just been asked for
    clock.now_s += 1.1
    assert channels.of(sample_of("a/info", CDR)) == INFO
    assert told.asked == 2


def test_a_publisher_that_comes_again_with_another_definition_is_understood(asking):
    channels, clock, told = asking
    told.channels = {"a/info": INFO}
    assert channels.of(sample_of("a/info", CDR)) == INFO
    told.channels = {"a/info": INFO._replace(schema=CAMERA_INFO._replace(definition=b"new"))}
    clock.now_s += 11
    assert channels.of(sample_of("a/info", CDR)).schema.definition == b"new"
    told.channels = {"a/info": INFO._replace(schema=CAMERA_INFO._replace(name="other_msgs/msg/Info"))}
    renamed = "application/cdr;other_msgs/msg/Info"
    assert channels.of(sample_of("a/info", renamed)) == told.channels["a/info"]  # at once


def test_what_a_publisher_that_has_gone_said_holds_for_what_is_still_to_be_written(asking):
    channels, clock, told = asking
    told.channels = {"a/info": INFO}
    channels.of(sample_of("a/info", CDR))
    told.channels = {}
    for _ in range(3):
        clock.now_s += 11
        assert channels.of(sample_of("a/info", CDR)) == INFO
    assert told.asked == 4


def test_what_nobody_tells_is_asked_for_ever_more_seldom(asking):
    channels, clock, told = asking
    for _ in range(3600 * 5):
        clock.now_s += 0.2
        channels.of(sample_of("a/info", CDR))
    assert 60 <= told.asked <= 70


def test_a_flood_of_keys_and_slow_answers_cost_a_tenth_of_the_time_and_bounded_memory(asking, monkeypatch):
    monkeypatch.setattr(bus_channels, "MAX_FOUND", 50)
    channels, clock, told = asking
    told.takes_s, began_s = 1.0, clock.now_s
    for i in range(10_000):
        clock.now_s += 0.01
        channels.of(sample_of(f"flood/{i}", f"application/cdr;{i}"))
    assert 8 <= told.asked <= 14
    assert clock.now_s - began_s < 1.15 * 100
    assert len(channels._found) <= 50


def test_an_unknown_key_is_asked_for_once(sent, sessions, monkeypatch):
    one, other = sessions
    channels = Channels(other)
    asked = []
    monkeypatch.setattr(bus_channels, "known_channels", lambda *args: asked.append(args) or known_channels(*args))
    encoding = bus_channels.zenoh_encoding(CAMERA_INFO, "cdr")
    with announce(one, {"a/info": INFO}):
        eventually(lambda: known_channels(other), {"a/info": INFO})
        for _ in range(2):
            assert channels.of(sent("a/info", b"x", encoding)) == INFO
        assert channels.raw_message(sent("a/info", b"y", encoding), 7).log_time_ns == 7
        assert len(asked) == 1
        channels.of(sent("pcgan/tracks", b"x", bus.ENCODING.with_schema("pcgan.v1.TrackFrame")))
        assert len(asked) == 1  # everybody knows that one
        channels.of(sent("stranger"))
        channels.of(sent("stranger"))
        assert len(asked) == 2
