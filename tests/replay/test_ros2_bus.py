"""Our ROS 2 node against the reference node, two sessions over loopback: what each sees and gets of the other.

The reference follows the specification and shares no code with ours; no ROS 2 installation takes part.
"""

import json
import logging
import socket
import time
from types import SimpleNamespace

import numpy as np
import pytest
import zenoh

from pcgan import bus
from replay import autoware, rmw_zenoh, ros2_bus
from replay.decoders import decoders_for
from replay.logged_message import LoggedSchema
from replay.rmw_zenoh import LATCHED, EntityKind, QoS
from replay.ros2_bus import Ros2Node
from replay.ros_type_hash import definition_of
from tests.replay import rmw_reference
from tests.replay.rmw_reference import DETECTIONS, PREDICTED, STRING, ReferenceNode, wait_until

DOMAIN = 7
BOXES = "/camera/boxes"
TEXT = definition_of(STRING, rmw_reference.rihs01(STRING))
BOXES_HASH = rmw_reference.rihs01(DETECTIONS)


@pytest.fixture
def sessions(tmp_path):
    """Two peers: ours, as the nodes open it, and that of the ROS side."""
    endpoint = f"unixsock-stream/{tmp_path}/ros"
    with bus.open_session(listen=[endpoint]) as ours, bus.open_session(connect=[endpoint]) as theirs:
        yield ours, theirs


@pytest.fixture
def node(sessions):
    with Ros2Node(sessions[0], DOMAIN, "pcgan_predict") as node:
        yield node


@pytest.fixture
def ros(sessions):
    with ReferenceNode(sessions[1], DOMAIN, "detector") as ros:
        yield ros


def text(words: str) -> bytes:
    cdr = rmw_reference.Cdr()
    cdr.text(words)
    return cdr.bytes()


def subscribed(node, ros, topic, *, qos=None):
    """Subscribes, and waits until the publisher that is there knows of it."""
    messages = []
    subscription = node.subscribe(topic, messages.append, qos)
    wait_until(lambda: ros.others("MS", topic))
    return subscription, messages


def test_boxes_of_a_ros_detector_are_read_with_the_definition_of_their_hash(node, ros):
    put = ros.publisher(BOXES, DETECTIONS, BOXES_HASH)
    subscription, messages = subscribed(node, ros, BOXES)
    stamp_ns = 1_700_000_000_123_456_789
    before = time.time_ns()
    put(rmw_reference.detections(stamp_ns, "camera", [("person", 0.75, 320.0, 240.0, 40.0, 100.0)]))
    wait_until(lambda: messages)
    (message,) = messages
    assert message.topic == BOXES
    assert message.encoding == "cdr"
    assert before <= message.log_time_ns <= time.time_ns()
    (decoder,) = decoders_for(message.schema, message.encoding)
    found = decoder.decode(message.data)
    assert (found.stamp_ns, found.frame_id, found.labels) == (stamp_ns, "camera", ("person",))
    np.testing.assert_allclose(found.boxes_px, [[300, 190, 340, 290]])
    np.testing.assert_allclose(found.scores, [0.75])
    assert (subscription.received, subscription.refused, subscription.lost) == (1, 0, 0)


def test_the_ros_graph_shows_our_node_and_what_it_reads(node, ros, sessions):
    ros.publisher(BOXES, DETECTIONS, BOXES_HASH)
    subscribed(node, ros, BOXES)
    (ours,) = ros.others("NN")
    assert ours | {"node_id": "", "entity_id": ""} == {
        "admin": "@ros2_lv",
        "domain": "7",
        "session": str(sessions[0].zid()),
        "node_id": "",
        "entity_id": "",
        "kind": "NN",
        "enclave": "%",
        "namespace": "%",
        "node": "pcgan_predict",
    }
    assert ours["node_id"] == ours["entity_id"]
    (reads,) = ros.others("MS", BOXES)
    assert (reads["type"], reads["hash"], reads["qos"]) == (rmw_reference.dds(DETECTIONS), BOXES_HASH, "::,10:,:,:,,")
    assert reads["node_id"] == ours["node_id"] != reads["entity_id"]


def test_two_types_under_one_name_are_both_read(node, ros):
    put_boxes = ros.publisher("/mixed", DETECTIONS, BOXES_HASH)
    put_text = ros.publisher("/mixed", STRING, rmw_reference.rihs01(STRING))
    messages = []
    node.subscribe("/mixed", messages.append)
    wait_until(lambda: len(ros.others("MS", "/mixed")) == 2)
    put_boxes(rmw_reference.detections(1, "camera", []))
    put_text(text("hello"))
    wait_until(lambda: len(messages) == 2)
    assert {message.schema.name for message in messages} == {DETECTIONS, STRING}


def test_humbles_messages_are_read_without_a_hash(node, ros):
    put = ros.publisher("/chatter", STRING, rmw_zenoh.TYPE_HASH_NOT_SUPPORTED)
    _, messages = subscribed(node, ros, "/chatter")
    put(text("hello"))
    wait_until(lambda: messages)
    assert messages[0].schema == TEXT


def test_predicted_objects_arrive_as_a_ros_subscriber_expects_them(node, ros, make):
    topic = autoware.PREDICTED_OBJECTS.name
    schema = LoggedSchema(PREDICTED, "ros2msg", autoware.definition(PREDICTED).encode())
    publisher = node.publisher(topic, schema)
    samples = ros.subscribe(topic, PREDICTED, rmw_reference.rihs01(PREDICTED))
    wait_until(lambda: ros.others("MP", topic))
    result = make.result(0, [make.track(0)], [make.prediction(1, [[0.1, 0.0], [0.2, 0.0]])])
    payload = autoware.predicted_objects(result.tracks, result.predictions, 0.0)

    def put_until_met():  # what is put before the two sessions have exchanged their declarations is lost
        publisher.put(payload, 1_700_000_000_000_000_001)
        return samples

    wait_until(put_until_met)
    first = len(samples) - 1
    for stamp_ns in (5, 6):
        publisher.put(payload, stamp_ns)
    wait_until(lambda: len(samples) >= first + 3)
    last = samples[-1]
    (token,) = ros.others("MP", topic)
    assert str(last.key_expr) == f"7/pcgan/predicted_objects/{token['type']}/{token['hash']}"
    assert last.payload.to_bytes() == payload
    sequences = [int.from_bytes(sample.attachment.to_bytes()[:8], "little") for sample in samples]
    assert sequences == list(range(sequences[0], sequences[0] + len(samples)))
    gid = rmw_zenoh.gid_of(rmw_zenoh.parse_token("/".join(token.values())))
    assert last.attachment.to_bytes() == rmw_reference.attachment(sequences[-1], 6, gid)


def test_a_publisher_counts_from_one_and_stamps_with_now(node, sessions):
    publisher = node.publisher("/chatter", TEXT)
    samples = []
    with sessions[0].declare_subscriber(
        rmw_reference.key(DOMAIN, "/chatter", STRING, rmw_reference.rihs01(STRING)), samples.append
    ):
        before = time.time_ns()
        publisher.put(text("a"))
        publisher.put(text("b"))
        wait_until(lambda: len(samples) == 2)
    first, second = (rmw_zenoh.decode_attachment(sample.attachment.to_bytes()) for sample in samples)
    assert (first.sequence, second.sequence) == (1, 2)
    assert before <= first.stamp_ns <= second.stamp_ns <= time.time_ns()
    assert first.gid == second.gid


def test_subscribers_with_and_without_hashes_get_every_message_alike(node, ros):
    keys = (rmw_reference.rihs01(STRING), rmw_zenoh.TYPE_HASH_NOT_SUPPORTED)
    received = [ros.subscribe("/chatter", STRING, hash_) for hash_ in keys]
    publisher = node.publisher("/chatter", TEXT)

    def put_until_met():  # what is put before the two sessions have exchanged their declarations is lost
        publisher.put(text("are you there?"))
        return all(received)

    wait_until(put_until_met)
    sent = [text(str(i)) for i in range(20)]
    for data in sent:
        publisher.put(data)
    wait_until(lambda: all(samples[-1].payload.to_bytes() == sent[-1] for samples in received))
    hashed, humble = ([sample.payload.to_bytes() for sample in samples[-20:]] for samples in received)
    assert hashed == humble == sent
    hashed, humble = ([sample.attachment.to_bytes() for sample in samples[-20:]] for samples in received)
    assert hashed == humble
    sequences = [rmw_zenoh.decode_attachment(data).sequence for data in hashed]
    assert sequences == list(range(sequences[0], sequences[0] + 20))
    assert [token["hash"] for token in ros.others("MP", "/chatter")] == [keys[0]]


def test_we_read_our_own_messages_once(node, sessions):
    messages = []
    subscription = node.subscribe("/chatter", messages.append)
    publisher = node.publisher("/chatter", TEXT)
    copies = []
    with sessions[0].declare_subscriber(
        rmw_reference.key(DOMAIN, "/chatter", STRING, rmw_zenoh.TYPE_HASH_NOT_SUPPORTED), copies.append
    ):
        for words in ("a", "b"):
            publisher.put(text(words))
        wait_until(lambda: len(copies) == 2)
    assert [message.data for message in messages] == [text("a"), text("b")]
    assert (subscription.received, subscription.refused, subscription.lost) == (2, 0, 0)


def test_a_late_subscriber_gets_what_was_latched(node, ros):
    """As with /tf_static: the transforms are published once, before we are there, and once more by a late one."""
    put = ros.publisher("/latched", STRING, rmw_reference.rihs01(STRING), latched=True)
    put(text("early"))
    _, messages = subscribed(node, ros, "/latched", qos=LATCHED)
    wait_until(lambda: messages)
    put(text("now"))
    wait_until(lambda: len(messages) == 2)
    late = ros.publisher("/latched", STRING, rmw_reference.rihs01(STRING), latched=True)
    late(text("late"))
    wait_until(lambda: len(messages) >= 3)
    assert [message.data for message in messages] == [text("early"), text("now"), text("late")]


@pytest.mark.parametrize("hash_", [rmw_reference.rihs01(STRING), rmw_zenoh.TYPE_HASH_NOT_SUPPORTED])
def test_a_late_ros_subscriber_gets_what_we_latched(node, ros, hash_):
    node.publisher("/latched", TEXT, QoS(1, transient_local=True)).put(text("early"))
    samples = ros.subscribe("/latched", STRING, hash_, latched=True)
    wait_until(lambda: samples)
    assert samples[0].payload.to_bytes() == text("early")
    assert ros.others("MP", "/latched")[0]["qos"] == ":1:,1:,:,:,,"


def test_an_unknown_definition_is_complained_of_once_and_counted(node, ros, caplog):
    put = ros.publisher("/radar", "acme_msgs/msg/Radar", "RIHS01_" + "0" * 64)
    messages = []
    subscription = node.subscribe("/radar", messages.append)
    with caplog.at_level(logging.WARNING):
        wait_until(lambda: "/radar cannot be read: no definition of acme_msgs/msg/Radar" in caplog.text)
        for _ in range(2):
            put(b"\x00\x01\x00\x00")
        wait_until(lambda: subscription.refused == 2)
    assert not messages
    assert caplog.text.count("cannot be read") == 1
    assert not ros.others("MS", "/radar")


def test_a_message_without_rmw_zenohs_attachment_is_refused(node, ros, sessions, caplog):
    ros.publisher(BOXES, DETECTIONS, BOXES_HASH)
    subscription, messages = subscribed(node, ros, BOXES)
    key = rmw_reference.key(DOMAIN, BOXES, DETECTIONS, BOXES_HASH)
    with caplog.at_level(logging.WARNING):
        sessions[1].put(key, rmw_reference.detections(1, "camera", []))
        sessions[1].put(key, rmw_reference.detections(1, "camera", []), attachment=b"mine")
        sessions[1].put(f"7{BOXES}/not/ros", b"")
        wait_until(lambda: subscription.refused == 3)
    assert not messages
    assert "refused a message on /camera/boxes: an attachment has 33 bytes, got 0" in caplog.text
    assert "refused a message on /camera/boxes: '7/camera/boxes/not/ros' is not DOMAIN/TOPIC/TYPE/HASH" in caplog.text


def test_strangers_fill_neither_the_memory_nor_the_log(monkeypatch, caplog):
    """A flood of made-up types, publishers and attachments, and the known type is still read."""
    monkeypatch.setattr(ros2_bus, "MAX_PUBLISHERS", 10)
    messages, announced = [], []
    subscription = ros2_bus.Ros2Subscription("/a", messages.append, lambda *kind: announced.append(kind))

    def put(type_hash, attachment):
        key = f"7/a/{rmw_zenoh.dds_name(STRING)}/{type_hash}"
        subscription.on_sample(
            SimpleNamespace(key_expr=key, attachment=zenoh.ZBytes(attachment), payload=zenoh.ZBytes(b"x"))
        )

    known = rmw_reference.rihs01(STRING)
    put(known, rmw_reference.attachment(1, 0, bytes(16)))
    for i in range(100):
        put(known, b"nonsense")
        put(f"RIHS01_{i:064x}", rmw_reference.attachment(1, 0, i.to_bytes(16)))
    put(known, rmw_reference.attachment(1, 0, bytes(16)))
    assert (len(messages), subscription.refused) == (2, 200)
    assert announced == [(STRING, known)]
    assert caplog.text.count("cannot be read") < ros2_bus.MAX_TYPES
    assert caplog.text.count("refused a message") == 3
    assert "refused a message on /a (100 times): an attachment has 33 bytes, got 8" in caplog.text
    assert len(subscription._sequences) <= 10


def test_numbers_that_a_publisher_skips_are_lost_messages(node, ros, sessions):
    ros.publisher("/chatter", STRING, rmw_reference.rihs01(STRING))
    subscription, messages = subscribed(node, ros, "/chatter")
    key = rmw_reference.key(DOMAIN, "/chatter", STRING, rmw_reference.rihs01(STRING))
    for sequence, gid in ((5, b"a" * 16), (6, b"a" * 16), (9, b"a" * 16), (1, b"b" * 16), (1, b"a" * 16)):
        sessions[1].put(key, text("x"), attachment=rmw_reference.attachment(sequence, 0, gid))
    wait_until(lambda: len(messages) == 5)
    assert (subscription.received, subscription.lost) == (5, 2)  # a restarted publisher counts from 1 again


def test_nothing_of_another_domain_is_seen(node, sessions):
    messages = []
    subscription = node.subscribe("/chatter", messages.append)
    with ReferenceNode(sessions[1], 8, "stranger") as stranger, ReferenceNode(sessions[1], DOMAIN, "talker") as talker:
        strange = stranger.publisher("/chatter", STRING, rmw_reference.rihs01(STRING))
        put = talker.publisher("/chatter", STRING, rmw_reference.rihs01(STRING))
        wait_until(lambda: talker.others("MS", "/chatter"))
        strange(text("from elsewhere"))
        put(text("from here"))
        wait_until(lambda: messages)
        assert [message.data for message in messages] == [text("from here")]
        assert not stranger.others("NN")
    assert subscription.refused == 0


def test_a_closed_node_leaves_the_graph(sessions, ros):
    with Ros2Node(sessions[0], DOMAIN, "short_lived") as node:
        node.publisher("/chatter", TEXT)
        node.subscribe("/chatter", lambda _: None)
        wait_until(lambda: ros.others("NN") and ros.others("MP") and ros.others("MS"))
    wait_until(lambda: not (ros.others("NN") or ros.others("MP") or ros.others("MS")))


def test_a_node_that_outlives_its_session_closes_in_silence(tmp_path):
    session = bus.open_session(listen=[f"unixsock-stream/{tmp_path}/alone"])
    node = Ros2Node(session, DOMAIN, "late")
    node.publisher("/chatter", TEXT)
    session.close()
    node.close()


def test_the_graph_lists_what_is_published(node, ros, sessions, caplog):
    ros.publisher(BOXES, DETECTIONS, BOXES_HASH)
    node.publisher("/chatter", TEXT, QoS(5, reliable=False))
    wait_until(lambda: ros.others("MP", "/chatter"))
    nonsense = sessions[1].liveliness().declare_token(f"@ros2_lv/{DOMAIN}/nonsense")
    found = []

    def is_told():
        found[:] = ros2_bus.graph(sessions[0], DOMAIN)
        return "'@ros2_lv/7/nonsense' is no liveliness token of rmw_zenoh" in caplog.text

    with caplog.at_level(logging.WARNING):
        wait_until(is_told)  # a token reaches one session before the other
    nonsense.undeclare()
    published = {e.endpoint.topic: e.endpoint for e in found if e.endpoint and e.endpoint.kind == EntityKind.PUBLISHER}
    assert published.keys() == {BOXES, "/chatter"}
    assert published[BOXES].type_hash == BOXES_HASH
    assert published["/chatter"].qos == QoS(5, reliable=False)
    assert {e.node.name for e in found if e.endpoint is None} == {"detector", "pcgan_predict"}


def test_mistakes_are_named_before_anything_is_declared(node):
    with pytest.raises(ValueError, match="no fully qualified ROS 2 topic"):
        node.publisher("chatter", TEXT)
    with pytest.raises(ValueError, match="no fully qualified ROS 2 topic"):
        node.subscribe("/**", lambda _: None)
    with pytest.raises(ValueError, match="only where delivery is reliable"):
        node.publisher("/chatter", TEXT, QoS(1, reliable=False, transient_local=True))


# --- through a router, as ROS 2 has it ------------------------------------------------------------------------------


def ros_session(**settings) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in ({"scouting/multicast/enabled": False} | settings).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def test_through_ros_2s_router_both_sides_meet():
    """With the settings of rmw_zenoh's DEFAULT_*_CONFIG.json5 files: the ROS nodes are peers that gossip."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        router = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    gossip = {"scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]}}
    with (
        ros_session(mode="router", **{"listen/endpoints": [router]}),
        ros_session(
            mode="peer", **{"connect/endpoints": [router], "listen/endpoints": ["tcp/127.0.0.1:0"]}, **gossip
        ) as theirs,
        ros2_bus.open_session(router) as ours,
        Ros2Node(ours, DOMAIN, "pcgan_predict") as node,
        ReferenceNode(theirs, DOMAIN, "talker") as ros,
    ):
        put = ros.publisher("/chatter", STRING, rmw_reference.rihs01(STRING))
        _, messages = subscribed(node, ros, "/chatter")
        put(text("hello"))
        wait_until(lambda: messages)
        samples = ros.subscribe("/answer", STRING, rmw_reference.rihs01(STRING))
        answer = node.publisher("/answer", TEXT)

        def put_until_met():
            answer.put(text("hello yourself"))
            return samples

        wait_until(put_until_met)


def test_without_a_router_the_error_says_how_to_start_one():
    with pytest.raises(bus.BusError, match=r"no zenoh router at tcp/127.0.0.1:1 .*ros2 run rmw_zenoh_cpp rmw_zenohd"):
        ros2_bus.open_session("tcp/127.0.0.1:1")
