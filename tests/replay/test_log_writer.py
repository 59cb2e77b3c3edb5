"""Results out: what the file holds, its name while it is not whole, and places that cannot be written."""

import os
from contextlib import contextmanager
from pathlib import Path

import pytest

from replay.errors import OutputError
from replay.log_writer import LogWriter
from schemas import codec, topics
from schemas.messages import PredictionFrame, TrackFrame, VehiclePose


@pytest.fixture
def frame(make):
    def made(i):
        track = make.track(100 * i, id=4, state=(5 + 0.1 * i, 1, 1, 0))
        prediction = make.prediction(4, [[5 + 0.1 * i + 0.1 * k, 1] for k in range(1, 13)])
        return make.result(100 * i, [track], [prediction], sequence=i)

    return made


def written(path, frames, lineage=None, settings=b"", ending=None):
    with LogWriter(path) as writer:
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
    from mcap.reader import make_reader
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
