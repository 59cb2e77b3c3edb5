"""A recording inside the output: nothing lost, in the order of time, and a header that is true."""

import contextlib
import json
import tracemalloc

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as Ros2Writer
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from replay import autoware
from replay.errors import LogError
from replay.log_writer import LogWriter
from schemas import topics

ROS2 = get_typestore(Stores.ROS2_JAZZY)
TWIST = "geometry_msgs/msg/Twist"
VECTOR = ROS2.types["geometry_msgs/msg/Vector3"]
A_TWIST = bytes(ROS2.serialize_cdr(ROS2.types[TWIST](VECTOR(1.0, 2.0, 3.0), VECTOR(0.0, 0.0, 0.5)), TWIST))
FOREVER = QosTime(9223372036, 854775807)
LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    FOREVER,
    FOREVER,
    QosLiveliness.AUTOMATIC,
    FOREVER,
    avoid_ros_namespace_conventions=False,
)
ALL_CDR = ("autoware",)


@pytest.fixture
def frame(make):
    def made(i):
        prediction = make.prediction(4, [[5 + 0.1 * k, 1] for k in range(1, 13)])
        return make.result(100 * i, [make.track(100 * i, id=4, state=(5, 1, 1, 0))], [prediction], sequence=i)

    return made


@pytest.fixture
def ros2_bag(tmp_path, make):
    """A recording by rosbags, as rosbag2 would make it: one topic latched, one without messages."""

    def made(version, name="bag"):
        with Rosbag2Writer(tmp_path / name, version=version, storage_plugin=StoragePlugin.MCAP) as bag:
            twist = bag.add_connection("/twist", TWIST, typestore=ROS2, offered_qos_profiles=[LATCHED])
            bag.add_connection("/silent", TWIST, typestore=ROS2, offered_qos_profiles=[LATCHED])
            for i in range(20):
                bag.write(twist, make.stamp(30 * i), A_TWIST)
        return tmp_path / name / f"{name}.mcap"

    return made


@pytest.fixture
def recording(tmp_path, make):
    """A recording of anybody's: 40 messages from 0 ms on, every 10 ms; writer options as of mcap.writer.Writer."""

    def made(name="log.mcap", profile="", encoding="json", at_ms=range(0, 400, 10), topic="/speed", **options):
        path = tmp_path / name
        with path.open("wb") as stream:
            writer = Writer(stream, **{"chunk_size": 200, "compression": CompressionType.ZSTD, **options})
            writer.start(profile=profile, library="somebody 1.0")
            schema = writer.register_schema("Speed", "jsonschema", b'{"type": "object"}')
            channel = writer.register_channel(topic, encoding, schema, {"unit": "m/s"})
            bare = writer.register_channel("/bare", "text", 0)
            writer.add_attachment(7, 8, "notes.txt", "text/plain", b"sunny")
            for number, at in enumerate(at_ms):
                writer.add_message(channel, make.stamp(at), b"%d" % number, make.stamp(at) - 5, number)
            writer.add_message(bare, make.stamp(max(at_ms)), b"end", make.stamp(max(at_ms)), 99)
            writer.add_metadata("weather", {"sun": "yes"})
            writer.finish()
        return path

    return made


def written(path, frames, merge, **options):
    with LogWriter(path, merge, **options) as writer:
        for each in frames:
            writer.write(each)
    return path


def rows(path, *names):
    """Topic, log time, publish time, sequence and bytes of every message, in log-time order."""
    with path.open("rb") as stream:
        found = [
            (channel.topic, message.log_time, message.publish_time, message.sequence, message.data)
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
        ]
    return [row for row in found if not names or row[0] in names]


def in_file_order(path):
    """Topic and log time of every message, as they lie in the file."""
    topic_of, found = {}, []
    with path.open("rb") as stream:
        for record in StreamReader(stream, validate_crcs=True).records:
            if type(record).__name__ == "Channel":
                topic_of[record.id] = record.topic
            elif type(record).__name__ == "Message":
                found.append((topic_of[record.channel_id], record.log_time))
    return found


def channels(content):
    return {channel.topic: channel for channel in content.summary.channels.values()}


# --- nothing is lost -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
    ],
    ids=["zstd", "plain", "no chunks", "no index", "chunk index only"],
)
def test_messages_attachments_and_metadata_are_kept(recording, frame, tmp_path, mcap_content, options):
    source = recording(**options)
    out = written(tmp_path / "out.mcap", [frame(i) for i in range(3)], [source])
    assert rows(out, "/speed", "/bare") == rows(source)
    assert [row[1] for row in rows(out)] == sorted(row[1] for row in rows(out))
    content = mcap_content(out)
    assert content.attachments["notes.txt"] == b"sunny"
    assert content.metadata["weather"] == {"sun": "yes"}
    assert channels(content)["/speed"].metadata == {"unit": "m/s"}
    assert channels(content)["/bare"].schema_id == 0
    schema = content.summary.schemas[channels(content)["/speed"].schema_id]
    assert (schema.name, schema.encoding, schema.data) == ("Speed", "jsonschema", b'{"type": "object"}')


def test_our_own_messages_are_those_of_an_output_that_is_not_merged(recording, frame, tmp_path):
    frames, ours = [frame(i) for i in range(3)], [topic.name for topic in topics.OUTPUTS]
    alone, merged = (written(tmp_path / name, frames, merge) for name, merge in (("a", []), ("b", [recording()])))
    assert rows(merged, *ours) == rows(alone)


def test_a_topic_without_messages_is_kept(ros2_bag, frame, tmp_path, mcap_content):
    out = written(tmp_path / "out.mcap", [frame(0)], [ros2_bag(9)])
    content = mcap_content(out)
    counts = content.summary.statistics.channel_message_counts
    assert counts.get(channels(content)["/silent"].id, 0) == 0
    assert counts[channels(content)["/twist"].id] == 20


# --- order -----------------------------------------------------------------------------------------------------------


def test_the_file_itself_is_in_the_order_of_time(recording, frame, tmp_path):
    """So a reader that streams, or one without the index, gets a prediction with what it is made of, not before."""
    out = written(tmp_path / "out.mcap", [frame(i) for i in range(3)], [recording()])
    order = in_file_order(out)
    times = [at for _, at in order]
    assert times == sorted(times)
    first = order.index((topics.TRACKS.name, frame(0).log_time_ns))
    assert order[first - 1] == ("/speed", frame(0).log_time_ns)  # of what is logged at one time, the recording's first


def test_several_recordings_are_put_into_the_order_of_time(recording, frame, tmp_path, mcap_content):
    even = recording("even.mcap", at_ms=range(0, 400, 20))
    odd = recording("odd.mcap", at_ms=range(10, 400, 20))
    other = recording("other.mcap", at_ms=range(5, 400, 20), topic="/other")
    out = written(tmp_path / "out.mcap", [frame(i) for i in range(3)], [even, odd, other])
    times = [at for _, at in in_file_order(out)]
    assert times == sorted(times)
    assert [row[1] for row in rows(out, "/speed")] == [row[1] for row in rows(recording("all.mcap"), "/speed")]
    names = [channel.topic for channel in mcap_content(out).summary.channels.values()]
    assert len(names) == len(set(names))  # what is the same topic in two files is one in the output


def test_topics_that_differ_stay_apart(recording, frame, tmp_path, mcap_content):
    one, other = recording("one.mcap"), recording("other.mcap", encoding="text")
    content = mcap_content(written(tmp_path / "out.mcap", [frame(0)], [one, other]))
    found = [channel.message_encoding for channel in content.summary.channels.values() if channel.topic == "/speed"]
    assert found == ["json", "text"]


# --- ROS 2: profile, QoS, origin -------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [8, 9])
def test_a_ros2_recording_with_ros2_outputs_stays_one(ros2_bag, frame, tmp_path, mcap_content, version):
    source = ros2_bag(version)
    out = written(tmp_path / "out.mcap", [frame(i) for i in range(3)], [source], emit=ALL_CDR)
    content, original = mcap_content(out), mcap_content(source)
    assert (content.header.profile, content.header.library) == ("ros2", "pcgan")
    for topic in ("/twist", "/silent"):
        assert channels(content)[topic].metadata == channels(original)[topic].metadata
    assert content.metadata["rosbag2"] == original.metadata["rosbag2"]
    with Rosbag2Reader(out) as bag:
        offered = {connection.topic: connection.ext.offered_qos_profiles for connection in bag.connections}
        assert offered["/twist"] == [LATCHED]
        [ours] = offered[autoware.TRACKED_OBJECTS.name]
        assert (ours.history, ours.depth, ours.reliability) == (QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE)
        assert [data for connection, _, data in bag.messages() if connection.topic == "/twist"] == [A_TWIST] * 20
    # rosbag2 reads all of a file's QoS by number up to version 8, all by name from 9 on
    texts = {
        channels(content)[topic].metadata["offered_qos_profiles"] for topic in ("/twist", "/pcgan/tracked_objects")
    }
    assert {"reliability: reliable" in text for text in texts} == {version == 9}


def test_other_readers_decode_a_merged_ros2_file(ros2_bag, frame, tmp_path):
    out = written(tmp_path / "out.mcap", [frame(0), frame(1)], [ros2_bag(9)], emit=ALL_CDR)
    with out.open("rb") as stream:
        decoded = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert len(decoded) == 24
    predicted = [message.decoded_message for message in decoded if message.channel.topic == "/pcgan/predicted_objects"]
    assert [len(message.objects[0].kinematics.predicted_paths[0].path) for message in predicted] == [13, 13]


def test_with_protobuf_outputs_it_is_no_ros2_file_any_more(ros2_bag, frame, tmp_path, mcap_content):
    content = mcap_content(written(tmp_path / "out.mcap", [frame(0)], [ros2_bag(9)], emit=("pcgan", "autoware")))
    assert content.header.profile == ""


@pytest.mark.parametrize(("profile", "encoding"), [("ros2", "json"), ("", "cdr")])
def test_a_recording_that_is_not_all_ros2_makes_no_ros2_file(
    recording, frame, tmp_path, mcap_content, profile, encoding
):
    source = recording(profile=profile, encoding=encoding)
    assert mcap_content(written(tmp_path / "out.mcap", [frame(0)], [source], emit=ALL_CDR)).header.profile == ""


def test_a_ros2_recording_without_rosbag2s_record_gets_one(recording, frame, tmp_path, mcap_content):
    """Or rosbag2 would take the file for one of its newest version and look for our QoS by name."""
    source = recording(profile="ros2", encoding="cdr")
    with_text = tmp_path / "out.mcap"  # its second topic is no CDR
    assert "rosbag2" not in mcap_content(written(with_text, [frame(0)], [source], emit=ALL_CDR)).metadata
    with (tmp_path / "cdr.mcap").open("wb") as stream:
        writer = Ros2Writer(stream)
        schema = writer.register_msgdef(TWIST, ROS2.generate_msgdef(TWIST, ros_version=2)[0])
        vector = {"x": 0.0, "y": 0.0, "z": 0.0}
        writer.write_message("/twist", schema, {"linear": vector, "angular": vector}, frame(0).log_time_ns)
        writer.finish()
    content = mcap_content(written(tmp_path / "out.mcap", [frame(0)], [tmp_path / "cdr.mcap"], emit=ALL_CDR))
    assert content.header.profile == "ros2"
    assert content.metadata["rosbag2"] == {"serialized_metadata": ""}


def test_what_the_headers_said_is_in_the_lineage(recording, ros2_bag, frame, tmp_path, mcap_content):
    with LogWriter(tmp_path / "out.mcap", [recording(), ros2_bag(9)]) as writer:
        writer.write(frame(0))
        writer.describe({"model": "m"}, b"{}")
    lineage = mcap_content(tmp_path / "out.mcap").metadata["pcgan"]
    assert lineage["model"] == "m"
    first, second = json.loads(lineage["merged"])
    assert first == {"name": "log.mcap", "profile": "", "library": "somebody 1.0"}
    assert (second["name"], second["profile"]) == ("bag.mcap", "ros2")
    assert second["library"].startswith("rosbags-")


# --- trouble ---------------------------------------------------------------------------------------------------------


def test_equal_inputs_give_equal_bytes(recording, ros2_bag, frame, tmp_path):
    sources = [recording(), ros2_bag(9)]
    one, other = (written(tmp_path / name, [frame(i) for i in range(5)], sources) for name in ("one", "other"))
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("told", [True, False], ids=["by its caller", "by Ctrl-C"])
def test_an_early_end_copies_no_more_than_up_to_the_last_frame(recording, frame, tmp_path, mcap_content, told):
    source, out = recording(), tmp_path / "out.mcap"
    frames = [frame(0), frame(1)]
    with contextlib.suppress(KeyboardInterrupt), LogWriter(out, [source]) as writer:
        for each in frames:
            writer.write(each)
        if not told:
            raise KeyboardInterrupt
        writer.describe({}, b"", complete=False)
    until = [row for row in rows(source) if row[1] <= frames[-1].log_time_ns]
    assert 0 < len(until) < len(rows(source))
    assert rows(out, "/speed", "/bare") == until
    assert mcap_content(out).attachments.keys() == mcap_content(source).attachments.keys() > set()


def test_no_frame_at_all_is_the_recording(recording, tmp_path):
    source = recording()
    assert rows(written(tmp_path / "out.mcap", [], [source])) == rows(source)


def test_damage_is_named_and_leaves_a_part(recording, frame, tmp_path):
    source = recording(compression=CompressionType.NONE, chunk_size=10_000)
    data = bytearray(source.read_bytes())
    at = data.index(b"17", 500)
    data[at] ^= 1
    source.write_bytes(data)
    with pytest.raises(LogError, match=r"log\.mcap is damaged .* and cannot be merged"):
        written(tmp_path / "out.mcap", [frame(i) for i in range(6)], [source])
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("content", [b"", b"no mcap at all, but long enough to be one of some kind"])
def test_what_is_no_recording_is_refused_before_anything_is_written(tmp_path, content):
    (tmp_path / "log.mcap").write_bytes(content)
    with pytest.raises(LogError, match=r"log\.mcap"):
        LogWriter(tmp_path / "out.mcap", [tmp_path / "log.mcap"])
    assert not (tmp_path / "out.mcap.part").exists()


def test_memory_does_not_grow_with_the_recording(frame, tmp_path, make):
    """The copy runs along with the frames and holds a chunk or two: 1 MB each of a recording of 30 MB."""
    noise = np.random.default_rng(0)
    with (tmp_path / "log.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/noise", "text", 0)
        for i in range(600):
            writer.add_message(channel, make.stamp(10 * i), noise.bytes(50_000), make.stamp(10 * i))
        writer.finish()
    tracemalloc.start()
    try:
        written(tmp_path / "out.mcap", [frame(i) for i in range(60)], [tmp_path / "log.mcap"])
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert (tmp_path / "out.mcap").stat().st_size > 30e6
    assert peak < 12e6
