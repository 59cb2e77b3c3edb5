"""rmw_zenoh's keys, tokens, QoS and attachments, against what its authors and others who met it have published.

Sources: ros2/rmw_zenoh docs/design.md (commit 99a6a2b) and rmw_zenoh_cpp/src/detail (liveliness_utils.cpp 3411fde,
qos.cpp 7efeee2, attachment_helpers.cpp 534747d); for GIDs the vectors that RaftROS captured from simplified_xxhash3.cpp
(8c1fe8e) and keeps in its tests, TestZenohROSCodec.
"""

import pytest
import zenoh
import zenoh.ext
from hypothesis import given
from hypothesis import strategies as st

from replay import rmw_zenoh
from replay.rmw_zenoh import Attachment, Endpoint, Entity, EntityKind, Node, QoS, RmwZenohError, TopicKey
from tests.replay import rmw_reference

STRING = "std_msgs/msg/String"
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
ADD_HASH = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"

# --- keys of data: the examples of design.md ------------------------------------------------------------------------

KEYS = [
    (f"0/chatter/std_msgs::msg::dds_::String_/{HASH}", TopicKey(0, "/chatter", STRING, HASH)),
    (f"0/robot1/chatter/std_msgs::msg::dds_::String_/{HASH}", TopicKey(0, "/robot1/chatter", STRING, HASH)),
    (
        f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{ADD_HASH}",
        TopicKey(2, "/add_two_ints", "example_interfaces/srv/AddTwoInts", ADD_HASH),
    ),
    (
        "0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported",  # Humble
        TopicKey(0, "/chatter", STRING, rmw_zenoh.TYPE_HASH_NOT_SUPPORTED),
    ),
]


@pytest.mark.parametrize(("text", "key"), KEYS)
def test_a_key_names_domain_topic_type_and_hash(text, key):
    assert str(key) == text
    assert rmw_zenoh.parse_topic_key(text) == key
    assert zenoh.KeyExpr(rmw_zenoh.any_type_key(key.domain, key.topic)).includes(zenoh.KeyExpr(text))


NAMES = st.from_regex(r"(/[A-Za-z_][A-Za-z0-9_]{0,9}){1,4}", fullmatch=True)


@given(st.integers(0, 232), NAMES)
def test_keys_and_tokens_are_read_back(domain, topic):
    key = TopicKey(domain, topic, "sensor_msgs/msg/PointCloud2", HASH)
    assert rmw_zenoh.parse_topic_key(str(key)) == key
    assert str(key) == rmw_reference.key(domain, topic, key.type_name, HASH)
    node = Node(domain, "a5", 3, "talker", topic, topic)
    entity = Entity(node, Endpoint(7, EntityKind.PUBLISHER, topic, key.type_name, HASH, QoS(1, transient_local=True)))
    assert rmw_zenoh.parse_token(str(entity)) == entity
    token = zenoh.KeyExpr(str(entity))
    assert zenoh.KeyExpr(rmw_zenoh.any_token(domain)).includes(token)
    assert zenoh.KeyExpr(rmw_zenoh.any_publisher_token(domain, topic)).includes(token)
    assert not zenoh.KeyExpr(rmw_zenoh.any_publisher_token(domain, topic + "s")).includes(token)


def test_a_topic_is_not_another_with_more_to_its_name():
    longer = zenoh.KeyExpr(str(TopicKey(0, "/camera/left", STRING, HASH)))
    assert not zenoh.KeyExpr(rmw_zenoh.any_type_key(0, "/camera")).intersects(longer)


@pytest.mark.parametrize(
    "key",
    [
        "pcgan/tracks",
        "",
        f"0/std_msgs::msg::dds_::String_/{HASH}",
        f"x/chatter/std_msgs::msg::dds_::String_/{HASH}",
        f"0/chatter/std_msgs/msg/String/{HASH}",
        f"0/chatter/std_msgs::msg::dds_::String/{HASH}",
        "0/chatter/std_msgs::msg::dds_::String_/RIHS01_df66",
        f"0/chatter/std_msgs::msg::dds_::String_/{HASH.upper()}",
        f"0/chatter/std_msgs::msg::dds_::String_/{HASH}/_buf_cpu",  # Lyrical's, for its own buffers
    ],
)
def test_other_keys_are_refused(key):
    with pytest.raises(RmwZenohError, match="rmw_zenoh"):
        rmw_zenoh.parse_topic_key(key)


@pytest.mark.parametrize(
    "topic", ["chatter", "/", "/a//b", "/a/", "/1a", "/a/*", "/**", "/a/$*", "/a b", "/a%b", "~/a"]
)
def test_a_topic_that_ros_would_not_take_never_becomes_a_key(topic):
    with pytest.raises(ValueError, match="no fully qualified ROS 2 topic"):
        rmw_zenoh.any_type_key(0, topic)


@pytest.mark.parametrize("name", ["std_msgs/String", "String", "std_msgs/msg/", "std_msgs/msg/Str*", "a/b/c/d"])
def test_a_type_that_ros_would_not_take_never_becomes_a_key(name):
    with pytest.raises(ValueError, match="no ROS 2 type name"):
        rmw_zenoh.dds_name(name)


# --- tokens: the examples of design.md ------------------------------------------------------------------------------

LISTENER = Node(2, "aac3178e146ba6f1fc6e6a4085e77f21", 0, "listener")
TALKER = Node(2, "8b20917502ee955ac4476e0266340d5c", 0, "talker")
SERVER = Node(2, "f9980ee0495eaafb3e38f0d19e2eae12", 0, "add_two_ints_server")
CLIENT = Node(2, "e1dc8d1b45ae8717fce78689cc655685", 0, "add_two_ints_client")
ADD = ("/add_two_ints", "example_interfaces/srv/AddTwoInts", ADD_HASH)
TOKENS = [
    ("@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener", Entity(LISTENER)),
    (
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/"
        f"{HASH}/::,10:,:,:,,",
        Entity(LISTENER, Endpoint(10, EntityKind.SUBSCRIPTION, "/chatter", STRING, HASH, QoS(10))),
    ),
    (
        "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
        f"{HASH}/::,7:,:,:,,",
        Entity(TALKER, Endpoint(10, EntityKind.PUBLISHER, "/chatter", STRING, HASH, QoS(7))),
    ),
    (
        "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server/%add_two_ints/"
        f"example_interfaces::srv::dds_::AddTwoInts_/{ADD_HASH}/::,10:,:,:,,",
        Entity(SERVER, Endpoint(10, EntityKind.SERVICE, *ADD, QoS(10))),
    ),
    (
        "@ros2_lv/2/e1dc8d1b45ae8717fce78689cc655685/0/10/SC/%/%/add_two_ints_client/%add_two_ints/"
        f"example_interfaces::srv::dds_::AddTwoInts_/{ADD_HASH}/::,10:,:,:,,",
        Entity(CLIENT, Endpoint(10, EntityKind.CLIENT, *ADD, QoS(10))),
    ),
]


@pytest.mark.parametrize(("token", "entity"), TOKENS, ids=[entity.node.name for _, entity in TOKENS])
def test_tokens_are_those_of_the_design_document(token, entity):
    assert str(entity) == token
    assert rmw_zenoh.parse_token(token) == entity


def test_chunks_that_newer_releases_add_are_ignored():
    """rmw_zenoh reads the chunks it knows; Lyrical appends one for publishers with buffers of their own."""
    token, entity = TOKENS[2]
    assert rmw_zenoh.parse_token(token + "/cpu:") == entity


@pytest.mark.parametrize(
    ("token", "why"),
    [
        ("@ros2_lv/2/ab/0/0/NN/%/%", "no liveliness token"),
        ("@ros2_lv/2/ab/0/0/NN/%//listener", "no liveliness token"),
        ("@other/2/ab/0/0/NN/%/%/listener", "no liveliness token"),
        ("@ros2_lv/two/ab/0/0/NN/%/%/listener", "is no number"),
        ("@ros2_lv/2/ab/0/x/NN/%/%/listener", "is no number"),
        ("@ros2_lv/2/ab/0/0/XX/%/%/listener", "kind 'XX', not one of NN, MP, MS, SS, SC"),
        (f"@ros2_lv/2/ab/0/1/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{HASH}", "ends before"),
        (f"@ros2_lv/2/ab/0/1/MP/%/%/talker/%chatter/String/{HASH}/::,7:,:,:,,", "no type name"),
        (f"@ros2_lv/2/ab/0/1/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{HASH}/::,7", "no QoS"),
    ],
)
def test_what_is_no_token_is_refused(token, why):
    with pytest.raises(RmwZenohError, match=why):
        rmw_zenoh.parse_token(token)


# --- quality of service: defaults of qos.cpp, numbers of rmw/types.h ------------------------------------------------


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (QoS(42), "::,:,:,:,,"),
        (QoS(10), "::,10:,:,:,,"),
        (QoS(5, reliable=False), "2::,5:,:,:,,"),
        (QoS(1, transient_local=True), ":1:,1:,:,:,,"),
        (QoS(42, keep_all=True), "::2,:,:,:,,"),
    ],
)
def test_qos_leaves_out_what_is_default(qos, text):
    assert str(qos) == text
    assert rmw_zenoh.parse_qos(text) == qos


def test_qos_may_say_everything():
    """The example in liveliness_utils.hpp: reliable, volatile, keep last 10, with a deadline and a lifespan."""
    assert rmw_zenoh.parse_qos("1:2:1,10:0,0:60,3000:1,0,0") == QoS(10)


@pytest.mark.parametrize("text", ["", "::,10", "::,x:,:,:,,", "3::,10:,:,:,,", ":0:,10:,:,:,,", "::,-1:,:,:,,"])
def test_other_qos_is_refused(text):
    with pytest.raises(RmwZenohError, match="rmw_zenoh"):
        rmw_zenoh.parse_qos(text)


# --- attachments and GIDs -------------------------------------------------------------------------------------------

GOLDEN = bytes.fromhex("080706050403020118171615141312111000112233445566778899aabbccddeeff")


def test_an_attachment_is_sequence_stamp_and_gid():
    """8 + 8 + 1 + 16 bytes (design.md, Publishers); the bytes are RaftROS's golden attachment."""
    attachment = Attachment(0x0102030405060708, 0x1112131415161718, bytes.fromhex("00112233445566778899aabbccddeeff"))
    assert attachment.encode() == GOLDEN
    assert rmw_zenoh.decode_attachment(GOLDEN) == attachment


@given(*[st.integers(-(2**63), 2**63 - 1)] * 2, st.binary(min_size=16, max_size=16))
def test_an_attachment_is_what_zenohs_own_serializer_writes(sequence, stamp_ns, gid):
    """AttachmentData::serialize_to_zbytes serialises the three one after the other."""
    ours = Attachment(sequence, stamp_ns, gid).encode()
    theirs = zenoh.ext.z_serialize((zenoh.ext.Int64(sequence), zenoh.ext.Int64(stamp_ns), gid))
    assert ours == theirs.to_bytes() == rmw_reference.attachment(sequence, stamp_ns, gid)
    assert rmw_zenoh.decode_attachment(ours) == (sequence, stamp_ns, gid)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "33 bytes, got 0"),
        (GOLDEN[:-1], "33 bytes, got 32"),
        (GOLDEN + b"\0", "33 bytes, got 34"),
        (GOLDEN[:16] + b"\x0f" + GOLDEN[17:], "this one says 15"),
        (b"\x0fsequence_number" + b"\0" * 60, "update it"),  # the layout before April 2025, with names
    ],
)
def test_any_other_attachment_is_refused(data, why):
    with pytest.raises(RmwZenohError, match=why):
        rmw_zenoh.decode_attachment(data)


def test_a_gid_of_another_size_is_a_mistake():
    with pytest.raises(ValueError, match="16 bytes, got 4"):
        Attachment(1, 2, b"1234").encode()


RAFT = Node(23, "aac3178e146ba6f1fc6e6a4085e77f21", 0, "raft_fixture", "/raft_test")
CHATTER = ("/raft_test/chatter", STRING, HASH, QoS(5, reliable=False))


@pytest.mark.parametrize(
    ("entity", "gid"),
    [
        (
            Entity(Node(0, "1", 0, "a"), Endpoint(0, EntityKind.PUBLISHER, "/b", "a/msg/B", HASH, QoS(42))),
            "d6944d1f878b2ccca940730c04a67353",
        ),
        (Entity(RAFT, Endpoint(1, EntityKind.PUBLISHER, *CHATTER)), "e4f56c26790a63265397a613657e3aab"),
        (Entity(RAFT, Endpoint(2, EntityKind.SUBSCRIPTION, *CHATTER)), "3747c389aa1c3b32ca6f32a904ff7c18"),
    ],
)
def test_a_gid_is_the_hash_of_the_token(entity, gid):
    assert rmw_zenoh.gid_of(entity).hex() == gid
