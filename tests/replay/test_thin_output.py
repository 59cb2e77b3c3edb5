"""Thinned messages: what is gone, what is kept, and how exactly."""

import numpy as np
import pytest

from replay.logged_message import NO_SCHEMA, RawMessage
from replay.thin_output import GRID, TOPICS, thinned
from schemas import codec
from schemas import pcgan_v1_pb2 as pb
from schemas.messages import TrackFrame, VehiclePose


@pytest.fixture
def raw(recorded):
    """A late message of each topic."""
    frame = recorded.frames[-1]
    messages = dict(zip(TOPICS, (frame.tracks, frame.predictions, frame.vehicle_pose), strict=True))
    return {topic: RawMessage(topic, 1, NO_SCHEMA, "protobuf", codec.encode(each)) for topic, each in messages.items()}


def on_grid(values):
    return bool((np.asarray(values) / GRID == np.round(np.asarray(values) / GRID)).all())


def test_tracks_keep_their_present_state(raw):
    whole, thin = (
        codec.decode(TrackFrame, data) for data in (raw["/pcgan/tracks"].data, thinned(raw["/pcgan/tracks"]))
    )
    assert (thin.stamp_ns, thin.sequence, thin.frame_id, thin.epoch) == (
        whole.stamp_ns,
        whole.sequence,
        whole.frame_id,
        whole.epoch,
    )
    assert len(whole.tracks) == len(thin.tracks) > 1
    assert len(whole.vehicle_history.stamps_ns) > len(thin.vehicle_history.stamps_ns) == 0
    for before, after in zip(whole.tracks, thin.tracks, strict=True):
        assert (before.id, before.age_ns, before.coasting) == (after.id, after.age_ns, after.coasting)
        for name in ("state", "covariance", "existence"):
            np.testing.assert_allclose(getattr(after, name), getattr(before, name), rtol=0, atol=GRID / 2)
            assert on_grid(getattr(after, name))
        assert after.history.stamps_ns.tolist() == [whole.stamp_ns]
    assert any(len(track.history.stamps_ns) > 10 for track in whole.tracks)


def test_predictions_keep_their_paths(raw):
    message = raw["/pcgan/predictions"]
    whole, thin = pb.PredictionFrame.FromString(message.data), pb.PredictionFrame.FromString(thinned(message))
    assert (whole.stamp_ns, whole.model, whole.dt_s) == (thin.stamp_ns, thin.model, thin.dt_s)
    assert len(whole.predictions) == len(thin.predictions) > 1
    for before, after in zip(whole.predictions, thin.predictions, strict=True):
        assert before.mixture.ByteSize() > after.mixture.ByteSize() == 0
        assert (before.track_id, before.fallback) == (after.track_id, after.fallback)
        assert before.HasField("corridor_time_s") == after.HasField("corridor_time_s")
        for path, kept in zip(before.paths, after.paths, strict=True):
            for name in ("x", "y", "probability"):
                np.testing.assert_allclose(getattr(kept, name), getattr(path, name), rtol=0, atol=GRID / 2)
                assert on_grid(getattr(kept, name))


def test_poses_stay_poses(raw):
    message = raw["/pcgan/vehicle_pose"]
    whole, thin = (codec.decode(VehiclePose, data) for data in (message.data, thinned(message)))
    np.testing.assert_allclose(thin.position_m, whole.position_m, rtol=0, atol=GRID / 2)
    np.testing.assert_allclose(thin.quaternion_xyzw, whole.quaternion_xyzw, rtol=0, atol=GRID)
    assert (thin.frame_id, thin.child_frame_id) == (whole.frame_id, whole.child_frame_id)


def test_thinning_twice_is_thinning_once(raw):
    """Of predictions it cannot be done: the codec wants a mixture, and a thin one is for comparisons alone."""
    for topic in ("/pcgan/tracks", "/pcgan/vehicle_pose"):
        once = thinned(raw[topic])
        assert thinned(raw[topic]._replace(data=once)) == once
