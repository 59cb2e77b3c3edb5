"""Results out: what the file holds, in which formats, its name while it is not whole, places that cannot be written."""

import os
from contextlib import contextmanager
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader as Rosbag2Reader

from replay import autoware
from replay.errors import OutputError
from replay.log_writer import DEFAULT_FORMATS, FORMATS, LogWriter, outputs
from schemas import codec, topics
from schemas.messages import PredictionFrame, TrackFrame, VehiclePose


@pytest.fixture
def frame(make):
    def made(i):
        track = make.track(100 * i, id=4, state=(5 + 0.1 * i, 1, 1, 0))
        prediction = make.prediction(4, [[5 + 0.1 * i + 0.1 * k, 1] for k in range(1, 13)])
        return make.result(100 * i, [track], [prediction], sequence=i)

    return made


def written(path, frames, lineage=None, settings=b"", ending=None, emit=DEFAULT_FORMATS):
    with LogWriter(path, emit=emit) as writer:
        for frame in frames:
            writer.write(frame)
        if lineage:
            writer.describe(lineage, settings)
        if ending:
            raise ending
    return path


def test_every_frame_gives_four_messages_at_its_log_time(tmp_path, frame, mcap_content):
    frames = [frame(i) for i in range(5)]
    content = mcap_content(written(tmp_path / "out.mcap", frames))
    names = [topics.TRACKS.name, topics.VEHICLE_POSE.name, topics.PREDICTIONS.name, topics.SCENE.name]
    assert [topic for topic, _, _ in content.messages] == names * 5
    assert [at for _, at, _ in content.messages[::4]] == [f.log_time_ns for f in frames]
    assert content.header.profile == ""
    assert content.header.library.startswith("pcgan")


def test_messages_come_back_through_the_codec(tmp_path, frame, mcap_content):
    sent = frame(3)
    data = {topic: data for topic, _, data in mcap_content(written(tmp_path / "out.mcap", [sent])).messages}
    assert codec.encode(codec.decode(TrackFrame, data["/pcgan/tracks"])) == codec.encode(sent.tracks)
    assert codec.encode(codec.decode(PredictionFrame, data["/pcgan/predictions"])) == codec.encode(sent.predictions)
    assert codec.decode(VehiclePose, data["/pcgan/vehicle_pose"]).stamp_ns == sent.tracks.stamp_ns


def test_schemas_travel_inside_the_file(tmp_path, frame):
    """Somebody without our code decodes the file by the descriptors in it."""
    from mcap_protobuf.decoder import DecoderFactory

    path = written(tmp_path / "out.mcap", [frame(0)])
    with path.open("rb") as stream:
        decoded = {
            channel.topic: message
            for _, channel, _, message in make_reader(
                stream, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        }
    assert decoded["/pcgan/predictions"].predictions[0].track_id == 4
    assert len(decoded["/pcgan/predictions"].predictions[0].paths[0].x) == 12
    assert decoded["/pcgan/tracks"].tracks[0].history.stamp_ns
    assert decoded["/pcgan/scene"].DESCRIPTOR.full_name == "foxglove.SceneUpdate"


def test_lineage_and_settings_are_there_to_be_read(tmp_path, frame, mcap_content):
    path = written(tmp_path / "out.mcap", [frame(0)], {"b": "2", "a": "1"}, b'{"x": 1}')
    content = mcap_content(path)
    assert content.metadata == {"pcgan": {"a": "1", "b": "2"}}
    assert content.attachments == {"settings.json": b'{"x": 1}'}


def test_equal_results_give_equal_bytes_whatever_the_file_is_called(tmp_path, frame):
    one = written(tmp_path / "one.mcap", [frame(i) for i in range(30)], {"b": "2", "a": "1"}, b"{}")
    other = written(tmp_path / "sub" / "other.mcap", [frame(i) for i in range(30)], {"a": "1", "b": "2"}, b"{}")
    assert one.read_bytes() == other.read_bytes()


def test_no_frame_at_all_is_a_valid_file(tmp_path, mcap_content):
    content = mcap_content(written(tmp_path / "out.mcap", []))
    assert content.messages == []
    assert {channel.topic for channel in content.summary.channels.values()} == {t.name for t in topics.OUTPUTS}


def test_until_it_is_whole_the_file_is_called_part(tmp_path, frame):
    with LogWriter(tmp_path / "out.mcap") as writer:
        writer.write(frame(0))
        assert [path.name for path in tmp_path.iterdir()] == ["out.mcap.part"]
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap"]


def test_an_old_output_stays_until_the_new_one_is_whole(tmp_path, frame):
    path = tmp_path / "out.mcap"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError):
        written(path, [frame(0)], ending=RuntimeError)
    assert path.read_bytes() == b"old"
    assert (tmp_path / "out.mcap.part").exists()


def test_after_an_error_the_part_holds_what_was_written(tmp_path, frame, mcap_content):
    with pytest.raises(RuntimeError):
        written(tmp_path / "out.mcap", [frame(0), frame(1)], ending=RuntimeError)
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap.part"]
    assert len(mcap_content(tmp_path / "out.mcap.part").messages) == 8


def test_ctrl_c_closes_the_file_under_its_name(tmp_path, frame, mcap_content):
    with pytest.raises(KeyboardInterrupt):
        written(tmp_path / "out.mcap", [frame(0)], ending=KeyboardInterrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap"]
    assert len(mcap_content(tmp_path / "out.mcap").messages) == 4


def test_missing_folders_are_made(tmp_path, frame):
    assert written(tmp_path / "a" / "b" / "out.mcap", [frame(0)]).is_file()


# --- formats ---------------------------------------------------------------------------------------------------------

AUTOWARE_TOPICS = [autoware.TRACKED_OBJECTS.name, autoware.PREDICTED_OBJECTS.name]


def test_every_format_adds_its_topics_at_the_frames_log_time(tmp_path, frame, mcap_content):
    frames = [frame(i) for i in range(3)]
    content = mcap_content(written(tmp_path / "out.mcap", frames, emit=tuple(FORMATS)))
    names = [topic.name for topic in topics.OUTPUTS if topic != topics.SCENE] + [topics.SCENE.name, *AUTOWARE_TOPICS]
    assert [topic for topic, _, _ in content.messages] == names * 3
    assert [at for _, at, _ in content.messages] == [f.log_time_ns for f in frames for _ in names]
    assert content.header.profile == ""  # protobuf is in it, too


def test_more_formats_change_nothing_of_the_others(tmp_path, frame, mcap_content):
    frames = [frame(i) for i in range(3)]
    usual = mcap_content(written(tmp_path / "usual.mcap", frames)).messages
    more = mcap_content(
        written(tmp_path / "more.mcap", frames, emit=("autoware", "foxglove", "pcgan", "pcgan"))
    ).messages
    assert [message for message in more if message[0] not in AUTOWARE_TOPICS] == usual


def test_formats_may_be_named_in_any_order(tmp_path, frame):
    one = written(tmp_path / "one.mcap", [frame(0)], emit=("autoware", "pcgan"))
    assert one.read_bytes() == written(tmp_path / "other.mcap", [frame(0)], emit=("pcgan", "autoware")).read_bytes()


def test_autoware_alone_is_a_ros2_file(tmp_path, frame, mcap_content):
    """Two other libraries read it: rosbags, which takes nothing but the profile ros2, and mcap-ros2-support."""
    sent = frame(3)
    path = written(tmp_path / "out.mcap", [sent], {"model": "m"}, b"{}", emit=["autoware"])
    content = mcap_content(path)
    assert content.header.profile == "ros2"
    assert {schema.encoding for schema in content.summary.schemas.values()} == {"ros2msg"}
    assert set(content.metadata) == {"pcgan", "rosbag2"}
    with Rosbag2Reader(path) as bag:
        assert [connection.topic for connection in bag.connections] == AUTOWARE_TOPICS
        assert [data for _, _, data in bag.messages()] == [data for _, _, data in content.messages]
        for connection in bag.connections:
            assert connection.ext.offered_qos_profiles[0].depth == 10
    with path.open("rb") as stream:
        decoded = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    stamps = [message.decoded_message.header.stamp for message in decoded]
    assert [(stamp.sec, stamp.nanosec) for stamp in stamps] == [divmod(sent.tracks.stamp_ns, 10**9)] * 2
    first = decoded[0].decoded_message.objects[0].kinematics.pose_with_covariance.pose.position
    assert (first.x, first.y) == tuple(sent.tracks.tracks[0].state[:2])


def test_an_autoware_file_is_byte_identical_again(tmp_path, frame):
    one, other = (
        written(tmp_path / name, [frame(i) for i in range(5)], emit=["autoware"]) for name in ("one", "other")
    )
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize(("emit", "problem"), [(["ros3"], "no output format 'ros3'"), ([], "no output format given")])
def test_formats_nobody_knows_are_refused_before_anything_is_written(tmp_path, emit, problem):
    with pytest.raises(OutputError, match=f"{problem}.*pcgan, foxglove, autoware"):
        LogWriter(tmp_path / "out.mcap", emit=emit)
    assert list(tmp_path.iterdir()) == []


def test_the_usual_outputs_are_those_of_the_table_of_topics():
    assert tuple(output.topic for output in outputs(DEFAULT_FORMATS)) == topics.OUTPUTS


# --- places that cannot be written -----------------------------------------------------------------------------------


@contextmanager
def as_nobody():
    """Gives up root's rights for a while: root may write anywhere."""
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)


def test_a_folder_without_write_permission(tmp_path):
    tmp_path.chmod(0o555)
    try:
        with as_nobody(), pytest.raises(OutputError, match=r"out\.mcap cannot be written: Permission denied"):
            LogWriter(tmp_path / "out.mcap")
    finally:
        tmp_path.chmod(0o755)
    assert list(tmp_path.iterdir()) == []


def test_a_file_where_a_folder_should_be(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"file/out\.mcap cannot be written: (File exists|Not a directory)"):
        LogWriter(tmp_path / "file" / "out.mcap")


def test_a_folder_under_the_outputs_own_name(tmp_path):
    """Found out before a long run, not after it."""
    (tmp_path / "out.mcap").mkdir()
    with pytest.raises(OutputError, match=r"out\.mcap .*: Is a directory"):
        LogWriter(tmp_path / "out.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("frames", [0, 1, 400])
def test_a_full_disk_is_one_error_and_no_output(tmp_path, frame, frames):
    """The part is a link to a device that is always full."""
    (tmp_path / "out.mcap.part").symlink_to("/dev/full")
    with pytest.raises(OutputError, match=r"out\.mcap c.* No space left on device"):
        written(tmp_path / "out.mcap", [frame(i) for i in range(frames)])
    assert not (tmp_path / "out.mcap").exists()
