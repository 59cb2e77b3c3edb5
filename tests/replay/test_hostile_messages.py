"""Any bytes, as any known message: what comes out keeps every promise that the rest relies on, or is a CodecError.

The promises are written down here once more, field by field, so that no decoder is measured by its own checks.
"""

import contextlib
import json
import struct
from dataclasses import replace
from random import Random

import numpy as np
import pytest
from google.protobuf.json_format import MessageToJson
from hypothesis import given, settings
from hypothesis import strategies as st

from pcgan.predictor import Predictor
from replay import ros
from replay.decoders import decoders_for
from replay.live_tracker import LiveTracker
from replay.log_reader import LogReader
from replay.logged_message import LoggedSchema
from schemas import codec
from schemas.codec import LARGEST, CodecError
from schemas.messages import (
    CameraCalibration,
    CameraDetections,
    CompressedImage,
    GroundTruthFrame,
    LidarClusters,
    Mixture,
    ModalPath,
    NodeHealth,
    ObjectTracks,
    PointCloud,
    Prediction,
    PredictionFrame,
    TrackFrame,
    Transform,
    VehiclePath,
    VehiclePose,
)
from tests.replay import foreign_ros as foreign
from tests.replay.foreign_foxglove import plain
from tests.replay.foreign_ros import header, rotation
from tests.replay.ros_samples import (
    CAMERA_INFO,
    CLOUD,
    POINTS,
    STACKS,
    TRACKED,
    camera_info,
    cloud,
    tracked,
    two_boxes,
    two_boxes_3d,
)
from tests.replay.test_foxglove_json import FOXGLOVE, MOUNT, OURS, POSE, STAMP_NS

# --- the promises --------------------------------------------------------------------------------------------------


def within(values, low=-LARGEST, high=LARGEST):
    array = np.asarray(values, float)
    return bool(((array >= low) & (array <= high)).all())


def within_or_unknown(values, high=LARGEST):
    array = np.asarray(values, float)
    return within(array[~np.isnan(array)], high=high)


def keeps_its_promises(message):
    """Asserts everything that the stages take for granted of a message."""
    if isinstance(message, tuple):
        for each in message:
            keeps_its_promises(each)
        return
    static = isinstance(message, Transform)
    assert type(message.stamp_ns) is int
    assert (0 if static else 1) <= message.stamp_ns < 2**63
    _PROMISES[type(message)](message)


def _detections(message):
    M = len(message.labels)
    assert message.boxes_px.shape == (M, 4)
    assert message.scores.shape == (M,)
    assert within(message.scores, 0, 1)
    assert within(message.boxes_px, high=2 * LARGEST, low=-2 * LARGEST)
    assert (message.boxes_px[:, 2:] >= message.boxes_px[:, :2]).all()


def _clusters(message):
    M = len(message.points)
    assert message.centroids_m.shape == message.sizes_m.shape == (M, 3)
    assert within(message.centroids_m)
    assert within(message.sizes_m, 0, 4 * LARGEST)  # a box around a turned one is larger
    assert message.points.dtype.kind == "i"
    assert (message.points >= 0).all()


def _cloud(message):
    assert message.points_m.ndim == 2
    assert message.points_m.shape[1] == 3
    assert within(message.points_m, -4 * LARGEST, 4 * LARGEST)  # moved by a pose


def _unit(quaternion):
    assert quaternion.shape == (4,)
    assert abs(np.linalg.norm(quaternion) - 1) < 1e-9


def _pose(message):
    for vector in (message.position_m, message.velocity_mps, message.angular_velocity_radps):
        assert vector.shape == (3,)
    assert within(message.position_m)
    assert within_or_unknown(message.velocity_mps)
    assert within_or_unknown(message.angular_velocity_radps)
    _unit(message.quaternion_xyzw)


def _transform(message):
    assert message.parent_frame_id
    assert message.child_frame_id
    assert message.translation_m.shape == (3,)
    assert within(message.translation_m)
    _unit(message.quaternion_xyzw)


def _calibration(message):
    assert message.width_px > 0
    assert message.height_px > 0
    assert message.intrinsics_px.shape == (3, 3)
    assert within(message.intrinsics_px)
    assert within(message.distortion)


def _object_tracks(message):
    A = len(message.ids)
    assert len(set(message.ids)) == A == len(message.labels)
    assert message.positions_m.shape == message.velocities_mps.shape == (A, 3)
    assert message.covariances.shape == (A, 4, 4)
    assert within(message.positions_m)
    assert within_or_unknown(message.velocities_mps, 4 * LARGEST)
    assert within_or_unknown(message.covariances, 10 * LARGEST)
    assert message.existence.shape == (A,)
    assert within(message.existence, 0, 1)


def _truth(message):
    A = len(message.ids)
    assert message.positions_m.shape == message.velocities_mps.shape == (A, 2)
    assert message.lidar_points.shape == (A,)
    assert within(message.positions_m)
    assert within(message.velocities_mps)
    assert (message.lidar_points >= 0).all()


def _track_frame(message):
    _history(message.vehicle_history.stamps_ns, message.vehicle_history.states, 5)
    assert len({track.id for track in message.tracks}) == len(message.tracks)
    for track in message.tracks:
        assert 0 <= track.id < 2**63
        assert track.state.shape == (4,)
        assert track.covariance.shape == (4, 4)
        assert within(track.state)
        assert within(track.covariance)
        assert 0 <= track.existence <= 1
        assert track.age_ns >= 0
        _history(track.history.stamps_ns, track.history.states, 4)
        assert track.history.coasting.shape == (len(track.history.stamps_ns),)
    if message.vehicle_path is not None:
        _path(message.vehicle_path)


def _history(stamps_ns, states, width):
    assert states.shape == (len(stamps_ns), width)
    assert within(states)
    assert (stamps_ns > 0).all()
    assert (np.diff(stamps_ns) > 0).all()


def _path(path):
    assert path.poses.shape == (len(path.times_s), 3)
    assert within(path.times_s, 0)
    assert within(path.poses)
    assert (np.diff(path.times_s) > 0).all()
    for size in (path.front_m, path.rear_m, path.width_m):
        assert 0 <= size <= LARGEST


def _prediction_frame(message):
    assert 0 < message.dt_s <= LARGEST
    assert len({prediction.track_id for prediction in message.predictions}) == len(message.predictions)
    for prediction in message.predictions:
        assert 0 <= prediction.track_id < 2**63
        P, K = prediction.mixture.weights.shape
        assert prediction.mixture.rhos.shape == (P, K)
        assert prediction.mixture.means_m.shape == prediction.mixture.sigmas_m.shape == (P, K, 2)
        assert within(prediction.mixture.means_m)
        assert within(prediction.mixture.weights, 0)
        assert within(np.abs(prediction.mixture.rhos), 0, 1)
        assert (prediction.mixture.sigmas_m > 0).all()
        assert within(prediction.mixture.sigmas_m)
        assert prediction.paths
        for path in prediction.paths:
            assert 0 <= path.probability <= 1
            assert path.points_m.shape == (P, 2)
            assert within(path.points_m)
        assert 0 <= prediction.corridor_probability <= 1
        assert prediction.corridor_time_s is None or 0 <= prediction.corridor_time_s <= LARGEST
    if message.vehicle_path is not None:
        _path(message.vehicle_path)


def _health(message):
    for name in ("uptime_s", "rate_hz", "input_hz", "latency_p50_ms", "latency_p99_ms"):
        assert within(getattr(message, name))
    for name in ("frames", "dropped", "late", "refused"):
        assert getattr(message, name) >= 0


def _image(message):
    assert message.data


_PROMISES = {
    CameraDetections: _detections,
    LidarClusters: _clusters,
    PointCloud: _cloud,
    VehiclePose: _pose,
    Transform: _transform,
    CameraCalibration: _calibration,
    ObjectTracks: _object_tracks,
    GroundTruthFrame: _truth,
    TrackFrame: _track_frame,
    PredictionFrame: _prediction_frame,
    NodeHealth: _health,
    CompressedImage: _image,
}

# --- a sound message of every kind, in every family ------------------------------------------------------------------

PATH = VehiclePath(np.array([0.0, 0.5, 1.0]), np.array([[0.0, 0, 0], [1, 0, 0.1], [2, 0, 0.2]]), 2.5, 0.9, 1.6)
ONES = np.ones((2, 1), np.float32)
MIXTURE = Mixture(ONES, np.ones((2, 1, 2), np.float32), np.full((2, 1, 2), 0.5, np.float32), 0 * ONES)
PREDICTION = Prediction(7, False, (ModalPath(1.0, np.array([[1.0, 2.0], [1.5, 2.0]])),), MIXTURE, 0.25, 1.5)
HEALTH = NodeHealth(STAMP_NS, "track", "random", 3.5, 10.0, 12.0, 30.0, 35, 1, 2, 3, "a problem", 200.0)
MESSAGES = {
    **OURS,
    "pcgan.v1.TrackFrame": replace(OURS["pcgan.v1.TrackFrame"], vehicle_path=PATH),
    "pcgan.v1.PredictionFrame": PredictionFrame(4, STAMP_NS, "odom", "random", 0.4, (PREDICTION,), PATH),
    "pcgan.v1.NodeHealth": HEALTH,
}


def _samples():
    """Returns name -> decoder and bytes."""
    found = {}

    def add(name, encoding, data):
        for way in decoders_for(LoggedSchema(name, "", b""), encoding):
            found[f"{encoding} {name}"] = (way.decode, data)

    for name, message in MESSAGES.items():
        add(name, "protobuf", codec.encode(message))
        add(name, "json", MessageToJson(codec.to_protobuf(message)).encode())
    for name, message in FOXGLOVE.items():
        add(name, "protobuf", message.SerializeToString())
        add(name, "json", json.dumps(plain(message)).encode())
    for stack in STACKS.values():
        for full, values in _ros_messages(stack).items():
            for way in ros.decoders(stack.schema(full), stack.encoding):
                if way.message != "ObjectTracks" or stack.vision_msgs > 1:  # in 1.x nothing has an id
                    name = f"vision_msgs {stack.vision_msgs}, {full.rpartition('/')[2]} as {way.message}"
                    found[name] = (way.decode, stack.rosbags_bytes(full, values))
    return found


def _ros_messages(stack):
    ids = {"tracking_id" if stack.vision_msgs == 2 else "id": "b"} if stack.vision_msgs > 1 else {}
    return {
        "vision_msgs/msg/Detection2DArray": two_boxes(stack),
        "vision_msgs/msg/Detection3DArray": two_boxes_3d(stack, **ids),
        CAMERA_INFO: camera_info(stack),
        "nav_msgs/msg/Odometry": foreign.odometry(stack, POSE),
        "geometry_msgs/msg/PoseStamped": {"header": header(STAMP_NS, "map"), "pose": {"orientation": rotation()}},
        CLOUD: cloud(POINTS, height=2),
        "tf2_msgs/msg/TFMessage": foreign.tf_message(stack, (MOUNT, MOUNT)),
        "sensor_msgs/msg/CompressedImage": {"header": header(STAMP_NS, "a"), "data": [1, 2], "format": "png"},
    } | ({TRACKED: tracked()} if stack.vision_msgs == 4 else {})


SAMPLES = _samples()
NUMBERS = (
    float("nan"),
    float("inf"),
    float("-inf"),
    -1.0,
    -1e-12,
    1e9,
    1.0000001e9,
    -2e9,
    1e38,
    1e300,
    5e-324,
    2.0,
    0.0,
)
ABSURD = [
    *(struct.pack(form, number) for number in NUMBERS for form in ("<d", ">d")),
    *(struct.pack("<f", number) for number in NUMBERS if not 1e38 < abs(number) < float("inf")),
    *(struct.pack(form, number) for number in (0, 1, 2**31 - 1, 2**32 - 1) for form in ("<I", ">I")),
    *(struct.pack("<Q", number) for number in (0, 2**53, 2**63 - 1, 2**63, 2**64 - 1)),
    b"NaN", b"1e999", b"-1", b"null", b"1" * 400, b"[[", b'"', b"{}", b"\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01",
]  # fmt: skip


@pytest.mark.parametrize("name", SAMPLES)
def test_sound_messages_keep_the_promises(name):
    decode, data = SAMPLES[name]
    keeps_its_promises(decode(data))


def test_every_message_of_the_codec_and_every_dataclass_is_among_the_samples():
    assert MESSAGES.keys() == codec.MESSAGE_TYPES.keys()
    decoded = [decode(data) for decode, data in SAMPLES.values()]
    assert {type(m[0] if isinstance(m, tuple) else m) for m in decoded} == _PROMISES.keys()


@st.composite
def damaged(draw, data):
    """A message with bytes and numbers in it replaced, cut, or said twice."""
    wire = bytearray(data)
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, max(0, len(wire) - 1)))
        new = draw(st.one_of(st.sampled_from(ABSURD), st.binary(min_size=1, max_size=4)))
        match draw(st.integers(0, 9)):
            case 0:
                del wire[at:]
            case 1:
                wire[at:at] = new
            case 2:
                wire += wire[at:]
            case _:
                wire[at : at + len(new)] = new
    return bytes(wire)


@pytest.mark.parametrize("name", SAMPLES)
@given(st.data())
@settings(max_examples=15)
def test_a_damaged_message_keeps_its_promises_or_is_refused(name, data):
    decode, sound = SAMPLES[name]
    with contextlib.suppress(CodecError):
        keeps_its_promises(decode(data.draw(damaged(sound))))


@pytest.mark.slow
@pytest.mark.parametrize("name", SAMPLES)
def test_thousands_of_damaged_messages_keep_their_promises_or_are_refused(name):
    """Without hypothesis, which would take minutes to choose as many."""
    decode, sound = SAMPLES[name]
    random, refused = Random(name), 0
    for _ in range(3000):
        wire = bytearray(sound)
        for _ in range(random.choice((1, 1, 2))):
            at, new = random.randrange(len(wire)), random.choice(ABSURD)
            if random.random() < 0.3:
                wire[at] ^= 1 << random.randrange(8)
            else:
                wire[at : at + len(new)] = new
        try:
            keeps_its_promises(decode(bytes(wire)))
        except CodecError:
            refused += 1
    assert refused > 0


# --- who takes them --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def predictor(model):
    return Predictor.from_checkpoint(model)


@given(data=st.data())
@settings(max_examples=60)
def test_whatever_track_frame_decodes_is_answered_with_a_frame_that_decodes(predictor, data):
    """A stranger's frame, too, as the predictor process takes it from the bus."""
    sound = codec.encode(MESSAGES["pcgan.v1.TrackFrame"])
    try:
        frame = codec.decode(TrackFrame, data.draw(damaged(sound)))
    except CodecError:
        return
    answer = codec.decode(PredictionFrame, codec.encode(predictor.step(frame)))
    keeps_its_promises(answer)
    assert (answer.sequence, answer.stamp_ns) == (frame.sequence, frame.stamp_ns)


@pytest.fixture(scope="module")
def messages(short_drive):
    return list(LogReader([short_drive]).messages(None, None, LogReader([short_drive]).start_ns + 600_000_000))


@given(seed=st.integers(0, 2**32))
@settings(max_examples=8)
def test_a_live_tracker_refuses_what_makes_no_sense_counts_it_and_goes_on(messages, seed):
    """As the track node takes them from the bus: any message may be damaged; the tracks of the others are sound."""
    random, tracker = Random(seed), LiveTracker()
    tracked = []
    for message in messages:
        if random.random() < 0.2:
            wire = bytearray(message.data)
            at, new = random.randrange(len(wire)), random.choice((*ABSURD, b""))
            wire[at : at + len(new)] = new
            message = message._replace(data=bytes(wire[: random.choice((len(wire), len(wire), at))]))  # noqa: PLW2901
        tracked += tracker.push(message)
    assert tracker.refused > 0
    for each in tracked:
        keeps_its_promises(codec.decode(TrackFrame, codec.encode(each.tracks)))
