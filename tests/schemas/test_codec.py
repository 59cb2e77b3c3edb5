"""The codec: everything comes back as it went in, the bytes are protobuf's own, and nonsense is refused by name."""

from contextlib import suppress
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from schemas import codec
from schemas import pcgan_v1_pb2 as pb
from schemas.codec import CodecError
from schemas.messages import (
    CameraCalibration,
    CameraDetections,
    GroundTruthFrame,
    LidarClusters,
    Mixture,
    ModalPath,
    Prediction,
    PredictionFrame,
    Track,
    TrackFrame,
    TrackHistory,
    VehicleHistory,
    VehiclePose,
)

STAMP_NS = 1_700_000_000_123_456_789

# --- random messages -----------------------------------------------------------------------------------------------

COUNTS = st.integers(0, 5)
STAMPS = st.integers(1, 2**62)
IDS = st.integers(0, 2**63 - 1)
NAMES = st.text(max_size=12)
PROBABILITIES = st.floats(0, 1)


def doubles(*shape):
    return npst.arrays(np.float64, shape, elements=st.floats(-1e9, 1e9))


def floats(*shape, low=-1e6, high=1e6):
    """float32 numbers, as they lie on the wire, in the float64 arrays that decoding gives."""
    values = npst.arrays(np.float32, shape, elements=st.floats(np.float32(low), np.float32(high), width=32))
    return values.map(lambda array: array.astype(float))


def counts(*shape):
    return npst.arrays(np.int64, shape, elements=st.integers(0, 2**32 - 1))


def rising_stamps(count):
    return st.lists(STAMPS, min_size=count, max_size=count, unique=True).map(lambda s: np.array(sorted(s), np.int64))


@st.composite
def camera_detections(draw):
    M = draw(COUNTS)
    low, size = draw(floats(M, 2)), draw(floats(M, 2, low=0))
    boxes = np.hstack([low, (low + size).astype(np.float32)])
    labels = tuple(draw(st.lists(NAMES, min_size=M, max_size=M)))
    return CameraDetections(draw(STAMPS), draw(NAMES), boxes, draw(floats(M, low=0, high=1)), labels)


@st.composite
def lidar_clusters(draw):
    M = draw(COUNTS)
    return LidarClusters(draw(STAMPS), draw(NAMES), draw(floats(M, 3)), draw(floats(M, 3, low=0)), draw(counts(M)))


@st.composite
def vehicle_poses(draw):
    quaternion = draw(npst.arrays(float, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 0.1))
    quaternion = quaternion / np.linalg.norm(quaternion)
    position, velocity, rate = draw(doubles(3)), draw(doubles(3)), draw(doubles(3))
    return VehiclePose(draw(STAMPS), draw(NAMES), draw(NAMES), position, quaternion, velocity, rate)


@st.composite
def ground_truths(draw):
    A = draw(COUNTS)
    ids = np.array(draw(st.lists(IDS, min_size=A, max_size=A, unique=True)), np.int64)
    return GroundTruthFrame(draw(STAMPS), draw(NAMES), ids, draw(doubles(A, 2)), draw(doubles(A, 2)), draw(counts(A)))


@st.composite
def tracks(draw, id):
    H = draw(COUNTS)
    history = TrackHistory(draw(rising_stamps(H)), draw(doubles(H, 4)), draw(npst.arrays(bool, H)))
    age_ns, coasting = draw(st.integers(0, 2**62)), draw(st.booleans())
    return Track(id, draw(doubles(4)), draw(doubles(4, 4)), draw(PROBABILITIES), age_ns, coasting, history)


@st.composite
def track_frames(draw):
    H = draw(COUNTS)
    ids = draw(st.lists(IDS, max_size=3, unique=True))
    return TrackFrame(
        draw(st.integers(0, 2**63 - 1)),
        draw(STAMPS),
        draw(NAMES),
        VehicleHistory(draw(rising_stamps(H)), draw(doubles(H, 5))),
        tuple(draw(tracks(id)) for id in ids),
        draw(st.booleans()),
        draw(st.integers(0, 2**32 - 1)),
    )


@st.composite
def predictions(draw, id, P, K):
    leaves = draw(st.integers(1, 3))
    paths = tuple(ModalPath(draw(PROBABILITIES), draw(doubles(P, 2))) for _ in range(leaves))
    mixture = Mixture(
        draw(floats(P, K, low=0, high=1)).astype(np.float32),
        draw(floats(P, K, 2)).astype(np.float32),
        draw(floats(P, K, 2, low=0.015625)).astype(np.float32),
        draw(floats(P, K, low=-0.875, high=0.875)).astype(np.float32),
    )
    return Prediction(id, draw(st.booleans()), paths, mixture)


@st.composite
def prediction_frames(draw):
    P, K = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    ids = draw(st.lists(IDS, max_size=2, unique=True))
    answered = tuple(draw(predictions(id, P, K)) for id in ids)
    dt_s = draw(st.floats(0.01, 10))
    return PredictionFrame(draw(st.integers(0, 2**63 - 1)), draw(STAMPS), draw(NAMES), draw(NAMES), dt_s, answered)


ANY_MESSAGE = st.one_of(
    camera_detections(), lidar_clusters(), vehicle_poses(), ground_truths(), track_frames(), prediction_frames()
)


def assert_same(found, expected, where=""):
    if is_dataclass(expected):
        assert type(found) is type(expected), where
        for item in fields(expected):
            assert_same(getattr(found, item.name), getattr(expected, item.name), f"{where}.{item.name}")
    elif isinstance(expected, tuple):
        assert len(found) == len(expected), where
        for i, (one, other) in enumerate(zip(found, expected, strict=True)):
            assert_same(one, other, f"{where}[{i}]")
    elif where.endswith(".quaternion_xyzw"):  # brought back to length 1
        np.testing.assert_allclose(found, expected, atol=1e-15, err_msg=where)
    elif isinstance(expected, np.ndarray):
        np.testing.assert_array_equal(found, expected, err_msg=where)
        assert found.shape == expected.shape, where
    else:
        assert found == expected, where


@given(ANY_MESSAGE)
@settings(max_examples=150, deadline=None)
def test_every_message_comes_back_as_it_went_in(message):
    assert_same(codec.decode(type(message), codec.encode(message)), message)


@given(ANY_MESSAGE)
@settings(max_examples=60, deadline=None)
def test_bytes_are_what_protobuf_itself_writes(message):
    """Packed arrays are merged in as bytes; parsed and written again by protobuf they must not change."""
    data = codec.encode(message)
    parsed = codec.protobuf_type(type(message)).FromString(data)
    assert parsed.SerializeToString(deterministic=True) == data


@given(lidar_clusters())
@settings(max_examples=50, deadline=None)
def test_packed_arrays_are_what_extend_gives(clusters):
    expected = pb.LidarClusters(stamp_ns=clusters.stamp_ns, frame_id=clusters.frame_id)
    for name, column in zip("xyz", clusters.centroids_m.T, strict=True):
        getattr(expected, name).extend(column.tolist())
    for name, column in zip(("size_x", "size_y", "size_z"), clusters.sizes_m.T, strict=True):
        getattr(expected, name).extend(column.tolist())
    expected.points.extend(clusters.points.tolist())
    assert codec.encode(clusters) == expected.SerializeToString(deterministic=True)


@given(track_frames())
@settings(max_examples=50, deadline=None)
def test_track_frames_are_what_extend_gives(frame):
    expected = pb.TrackFrame(
        sequence=frame.sequence,
        stamp_ns=frame.stamp_ns,
        frame_id=frame.frame_id,
        pose_extrapolated=frame.pose_extrapolated,
        epoch=frame.epoch,
    )
    expected.vehicle_history.SetInParent()
    expected.vehicle_history.stamp_ns.extend(frame.vehicle_history.stamps_ns.tolist())
    for name, column in zip(("x", "y", "yaw", "vx", "vy"), frame.vehicle_history.states.T, strict=True):
        getattr(expected.vehicle_history, name).extend(column.tolist())
    for track in frame.tracks:
        x, y, vx, vy = track.state.tolist()
        message = expected.tracks.add(
            id=track.id, x=x, y=y, vx=vx, vy=vy, existence=track.existence, age_ns=track.age_ns, coasting=track.coasting
        )
        message.covariance.extend(track.covariance.ravel().tolist())
        message.history.SetInParent()
        message.history.stamp_ns.extend(track.history.stamps_ns.tolist())
        for name, column in zip(("x", "y", "vx", "vy"), track.history.states.T, strict=True):
            getattr(message.history, name).extend(column.tolist())
        message.history.coasting.extend(track.history.coasting.tolist())
    assert pb.TrackFrame.FromString(codec.encode(frame)) == expected


def test_a_long_array_has_a_length_of_several_bytes():
    """300 clusters: 1200 bytes an array, so that the wire's length takes two bytes."""
    clusters = LidarClusters(STAMP_NS, "lidar", np.ones((300, 3)), np.ones((300, 3)), np.arange(300))
    assert_same(codec.decode(LidarClusters, codec.encode(clusters)), clusters)


def test_arrays_that_are_no_view_of_their_own_memory_are_written_in_order():
    """Columns of a Fortran array, and a reversed view, are written as they read."""
    centroids = np.asfortranarray(np.arange(12.0).reshape(4, 3))[::-1]
    clusters = LidarClusters(STAMP_NS, "lidar", centroids, np.ones((4, 3)), np.arange(8)[::2])
    assert_same(codec.decode(LidarClusters, codec.encode(clusters)), clusters)


def test_equal_messages_give_equal_bytes():
    def frame():
        return LidarClusters(STAMP_NS, "lidar", np.ones((2, 3)), np.ones((2, 3)), np.array([3, 4]))

    assert codec.encode(frame()) == codec.encode(frame())


def test_what_has_no_protobuf_is_a_type_error():
    calibration = CameraCalibration(1, "c", 1, 1, "plumb_bob", np.zeros(4), np.eye(3))
    with pytest.raises(TypeError, match=r"CameraCalibration has no pcgan\.v1 protobuf"):
        codec.encode(calibration)


def test_schema_names_are_versioned():
    assert codec.schema_name(TrackFrame) == "pcgan.v1.TrackFrame"
    assert all(name.startswith("pcgan.v1.") for name in codec.MESSAGE_TYPES)
    assert codec.MESSAGE_TYPES["pcgan.v1.LidarClusters"] is LidarClusters


# --- what is refused -----------------------------------------------------------------------------------------------


def detections(**changes):
    values = {"x_min": [1], "y_min": [2], "x_max": [3], "y_max": [4], "score": [0.5], "label": ["person"]}
    return pb.CameraDetections(**{"stamp_ns": STAMP_NS, **values, **changes})


def clusters(**changes):
    values = {name: [1.0] for name in ("x", "y", "z", "size_x", "size_y", "size_z")}
    return pb.LidarClusters(**{"stamp_ns": STAMP_NS, **values, "points": [5], **changes})


def pose(**changes):
    return pb.VehiclePose(**{"stamp_ns": STAMP_NS, "qw": 1.0, **changes})


def truth(**changes):
    values = {"id": [1], "x": [0], "y": [0], "vx": [0], "vy": [0], "lidar_points": [3]}
    return pb.GroundTruthFrame(**{"stamp_ns": STAMP_NS, **values, **changes})


def track(history=None, **changes):
    values = {"id": 1, "existence": 0.5, "covariance": np.eye(4).ravel().tolist()}
    return pb.Track(**{**values, "history": pb.TrackHistory(**(history or {})), **changes})


def track_frame(*tracks, **changes):
    return pb.TrackFrame(**{"stamp_ns": STAMP_NS, "tracks": tracks, **changes})


def mixture(steps=2, components=1, **changes):
    count = steps * components
    values = {name: [1.0] * count for name in ("weight", "x", "y", "sigma_x", "sigma_y")}
    return pb.Mixture(**{"components": components, **values, "rho": [0.0] * count, **changes})


def prediction_frame(mix=None, paths=None, **changes):
    paths = [pb.ModalPath(probability=1, x=[0, 0], y=[0, 0])] if paths is None else paths
    predicted = pb.Prediction(track_id=1, paths=paths, mixture=mix or mixture())
    return pb.PredictionFrame(**{"stamp_ns": STAMP_NS, "dt_s": 0.1, "predictions": [predicted], **changes})


NAN, INF = float("nan"), float("inf")
STEP = {"stamp_ns": [1], "x": [0], "y": [0], "vx": [0], "vy": [0], "coasting": [False]}
TWO = {name: values * 2 for name, values in STEP.items()}

REFUSED = {
    "detections without a stamp": (CameraDetections, detections(stamp_ns=0), r"CameraDetections has no stamp"),
    "detections before 1970": (CameraDetections, detections(stamp_ns=-5), r"has no stamp \(stamp_ns -5\)"),
    "one coordinate too few": (
        CameraDetections,
        detections(y_max=[]),
        "CameraDetections arrays differ in length: x_min 1, y_min 1, x_max 1, y_max 0, score 1",
    ),
    "a label too few": (CameraDetections, detections(label=[]), "has 1 boxes but 0 labels"),
    "a NaN box": (CameraDetections, detections(x_max=[NAN]), r"CameraDetections\.x_max holds NaN or infinity"),
    "an infinite score": (CameraDetections, detections(score=[INF]), r"CameraDetections\.score holds NaN or infinity"),
    "a box of negative width": (CameraDetections, detections(x_max=[0]), "has a box of negative size"),
    "a box of negative height": (CameraDetections, detections(y_max=[1]), "has a box of negative size"),
    "a score above 1": (CameraDetections, detections(score=[1.5]), "has a score outside 0 to 1"),
    "a score below 0": (CameraDetections, detections(score=[-0.1]), "has a score outside 0 to 1"),
    "clusters without a stamp": (LidarClusters, clusters(stamp_ns=0), "LidarClusters has no stamp"),
    "clusters of two lengths": (LidarClusters, clusters(z=[1, 2]), "LidarClusters arrays differ in length"),
    "a point count too few": (LidarClusters, clusters(points=[]), "has 1 clusters but 0 point counts"),
    "a NaN centroid": (LidarClusters, clusters(x=[NAN]), r"LidarClusters\.x holds NaN or infinity"),
    "an infinite size": (LidarClusters, clusters(size_z=[INF]), r"LidarClusters\.size_z holds NaN or infinity"),
    "a negative size": (LidarClusters, clusters(size_y=[-1]), "has a cluster of negative size"),
    "a pose without a stamp": (VehiclePose, pose(stamp_ns=0), "VehiclePose has no stamp"),
    "a NaN position": (VehiclePose, pose(y=NAN), r"VehiclePose[ .]y is not finite"),
    "an infinite rate": (VehiclePose, pose(wz=-INF), r"VehiclePose[ .]wz is not finite"),
    "no rotation": (VehiclePose, pose(qw=0), r"quaternion \[0\.0, 0\.0, 0\.0, 0\.0\] has length 0 instead of 1"),
    "a long quaternion": (VehiclePose, pose(qx=1), "has length 1.41 instead of 1"),
    "a truth without a stamp": (GroundTruthFrame, truth(stamp_ns=0), "GroundTruthFrame has no stamp"),
    "an id too few": (GroundTruthFrame, truth(id=[]), "GroundTruthFrame arrays differ in length"),
    "a truth of two lengths": (GroundTruthFrame, truth(vx=[]), "GroundTruthFrame arrays differ in length: x 1, y 1"),
    "a NaN truth": (GroundTruthFrame, truth(x=[NAN]), r"GroundTruthFrame\.x holds NaN or infinity"),
    "tracks without a stamp": (TrackFrame, track_frame(stamp_ns=0), "TrackFrame has no stamp"),
    "two tracks of one id": (TrackFrame, track_frame(track(), track()), "TrackFrame has two tracks of one id"),
    "an id beyond 63 bits": (TrackFrame, track_frame(track(id=2**63)), "a track of the id 9223372036854775808"),
    "a NaN track": (TrackFrame, track_frame(track(vx=NAN)), r"Track\.vx holds NaN"),
    "existence above 1": (TrackFrame, track_frame(track(existence=1.1)), r"existence \[?1\.1\]? is outside 0 to 1"),
    "existence below 0": (TrackFrame, track_frame(track(existence=-1)), "is outside 0 to 1"),
    "a covariance of 9": (TrackFrame, track_frame(track(covariance=[1] * 9)), "has 9 entries instead of 16"),
    "a NaN covariance": (TrackFrame, track_frame(track(covariance=[NAN] * 16)), "covariance holds NaN or infinity"),
    "a NaN history": (TrackFrame, track_frame(track({**STEP, "x": [NAN]})), r"TrackHistory\.x holds NaN or infinity"),
    "a stamp too few": (TrackFrame, track_frame(track({**STEP, "stamp_ns": []})), "has 1 states but 0 stamps"),
    "a coasting flag too few": (
        TrackFrame,
        track_frame(track({**STEP, "coasting": []})),
        "TrackHistory arrays differ in length",
    ),
    "an age below 0": (TrackFrame, track_frame(track(age_ns=-1)), "Track has the age -1 ns"),
    "a history from before 1970": (
        TrackFrame,
        track_frame(track({**STEP, "stamp_ns": [-5]})),
        r"TrackHistory has no stamp for every state \(stamp_ns -5\)",
    ),
    "stamps that stand still": (TrackFrame, track_frame(track(TWO)), "TrackHistory stamps do not rise"),
    "a vehicle going back in time": (
        TrackFrame,
        track_frame(vehicle_history=pb.VehicleHistory(**{k: [2.0, 1.0] for k in ("x", "y", "yaw", "vx", "vy")},
                                                      stamp_ns=[2, 1])),
        "VehicleHistory stamps do not rise",
    ),
    "predictions without a stamp": (PredictionFrame, prediction_frame(stamp_ns=0), "PredictionFrame has no stamp"),
    "no time step": (PredictionFrame, prediction_frame(dt_s=0), r"dt_s 0\.0 is not positive"),
    "an infinite time step": (PredictionFrame, prediction_frame(dt_s=INF), "dt_s inf is not positive"),
    "a NaN time step": (PredictionFrame, prediction_frame(dt_s=NAN), "dt_s nan is not positive"),
    "an absurd time step": (PredictionFrame, prediction_frame(dt_s=1e300), r"dt_s is 1e\+300, more than 1e\+09"),
    "an absurd time to the corridor": (
        PredictionFrame,
        prediction_frame(
            predictions=[
                pb.Prediction(
                    track_id=4,
                    paths=[pb.ModalPath(probability=1, x=[0, 0], y=[0, 0])],
                    mixture=mixture(),
                    corridor_time_s=1e30,
                )
            ]
        ),
        r"corridor_time_s 1e\+30 makes no sense",
    ),
    "a prediction without a path": (PredictionFrame, prediction_frame(paths=[]), "Prediction has no path"),
    "a probability above 1": (
        PredictionFrame,
        prediction_frame(paths=[pb.ModalPath(probability=2, x=[0, 0], y=[0, 0])]),
        r"ModalPath probability 2\.0 is outside 0 to 1",
    ),
    "a path of two lengths": (
        PredictionFrame,
        prediction_frame(paths=[pb.ModalPath(probability=1, x=[0, 0], y=[0])]),
        "ModalPath arrays differ in length: x 2, y 1",
    ),
    "paths of different lengths": (
        PredictionFrame,
        prediction_frame(
            paths=[pb.ModalPath(probability=0.5, x=[0] * n, y=[0] * n) for n in (2, 3)]
        ),
        "Prediction has a path that is not 2 steps long",
    ),
    "a mixture without components": (
        PredictionFrame,
        prediction_frame(pb.Mixture(weight=[1, 1], x=[0, 0], y=[0, 0], sigma_x=[1, 1], sigma_y=[1, 1], rho=[0, 0])),
        "Mixture has 2 entries for 0 components",
    ),
    "a mixture of another horizon": (PredictionFrame, prediction_frame(mixture(steps=3)), "that is not 3 steps long"),
    "a NaN mixture": (PredictionFrame, prediction_frame(mixture(rho=[NAN, 0])), r"Mixture\.rho holds NaN or infinity"),
    "a mixture without spread": (PredictionFrame, prediction_frame(mixture(sigma_x=[0, 1])), "sigma that is not pos"),
    "a correlation above 1": (PredictionFrame, prediction_frame(mixture(rho=[1.5, 0])), "Mixture has a correlation"),
    "a negative weight": (PredictionFrame, prediction_frame(mixture(weight=[-1, 1])), "Mixture has a .*weight"),
    "two predictions of one track": (
        PredictionFrame,
        prediction_frame(
            predictions=[
                pb.Prediction(track_id=4, paths=[pb.ModalPath(probability=1, x=[0, 0], y=[0, 0])], mixture=mixture())
            ]
            * 2
        ),
        "PredictionFrame has two predictions of one track",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_a_message_that_makes_no_sense_is_refused_by_name(case):
    message_type, message, text = REFUSED[case]
    with pytest.raises(CodecError, match=text):
        codec.decode(message_type, message.SerializeToString())


@pytest.mark.parametrize("message", [detections(), clusters(), pose(), truth(), track_frame(track(STEP))], ids=str)
def test_what_the_refused_messages_were_made_from_is_fine(message):
    codec.decode(codec.MESSAGE_TYPES[message.DESCRIPTOR.full_name], message.SerializeToString())


def test_a_plain_prediction_is_fine():
    assert codec.decode(PredictionFrame, prediction_frame().SerializeToString()).predictions[0].track_id == 1


@pytest.mark.parametrize("message_type", codec.MESSAGE_TYPES.values(), ids=lambda t: t.__name__)
@pytest.mark.parametrize("data", [b"\xff\xff\xff", b"\x0a\x7fshort", b"not protobuf"], ids=["tag", "length", "text"])
def test_bytes_that_are_no_protobuf_are_refused(message_type, data):
    with pytest.raises(CodecError, match=rf"not a pcgan\.v1\.{message_type.__name__}|has no stamp"):
        codec.decode(message_type, data)


@given(st.binary(max_size=200), st.sampled_from(sorted(codec.MESSAGE_TYPES)))
@settings(max_examples=300, deadline=None)
def test_random_bytes_raise_nothing_but_codec_errors(data, name):
    try:
        message = codec.decode(codec.MESSAGE_TYPES[name], data)
    except CodecError:
        return
    assert message.stamp_ns > 0


@given(ANY_MESSAGE, st.data())
@settings(max_examples=100, deadline=None)
def test_a_flipped_bit_raises_nothing_but_codec_errors(message, data):
    wire = bytearray(codec.encode(message))
    place = data.draw(st.integers(0, len(wire) - 1))
    wire[place] ^= 1 << data.draw(st.integers(0, 7))
    with suppress(CodecError):
        assert codec.decode(type(message), bytes(wire)).stamp_ns > 0


def test_empty_bytes_are_a_message_without_a_stamp():
    with pytest.raises(CodecError, match="has no stamp"):
        codec.decode(LidarClusters, b"")


def test_a_quaternion_a_little_off_is_brought_to_length_1():
    found = codec.decode(VehiclePose, pose(qw=1.01).SerializeToString())
    np.testing.assert_allclose(found.quaternion_xyzw, [0, 0, 0, 1], atol=1e-15)


# --- other people's senders ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "unknown",
    [b"\x7d\x00\x00\x80\x3f", b"\x82\x02\x03abc", b"\xf8\x01\x05", b"\xf9\x01" + bytes(8)],
    ids=["fixed32", "two-byte tag", "varint", "fixed64"],
)
def test_fields_of_a_newer_sender_are_passed_over(unknown):
    """A field we do not know, of any wire type and anywhere, changes nothing that we do know."""
    frame = pb.TrackFrame(stamp_ns=STAMP_NS)
    track = frame.tracks.add(id=3, x=1, covariance=[1.0] * 16, existence=0.5)
    track.history.MergeFrom(pb.TrackHistory(stamp_ns=[5, 6], x=[1, 2], y=[3, 4], vx=[0, 0], vy=[0, 0], coasting=[0, 1]))
    plain = codec.decode(TrackFrame, frame.SerializeToString())
    track.history.MergeFromString(unknown)
    track.MergeFromString(unknown)
    frame.MergeFromString(unknown)
    newer = codec.decode(TrackFrame, frame.SerializeToString())
    assert_same(newer, plain)


@pytest.mark.parametrize("where", ["x", "vx"])
def test_absurdly_large_numbers_are_refused(where):
    frame = pb.TrackFrame(stamp_ns=STAMP_NS)
    frame.tracks.add(id=3, covariance=[1.0] * 16, existence=0.5, **{where: 1e30})
    with pytest.raises(CodecError, match=rf"Track\.{where} holds 1e\+30, more than 1e\+09"):
        codec.decode(TrackFrame, frame.SerializeToString())
