"""Autoware's messages, field by field, as two other readers see them; identities; limits; conventions."""

import math
from dataclasses import fields, is_dataclass
from importlib.resources import files
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.interfaces import QosDurability, QosHistory, QosLiveliness, QosReliability
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from replay import autoware
from replay.drawing import PERSON_HEIGHT_M, PERSON_RADIUS_M
from schemas.messages import ModalPath, Prediction, PredictionFrame, TrackFrame

GROUND_M = 0.25
MIDDLE_M = GROUND_M + PERSON_HEIGHT_M / 2
COVARIANCE = np.array([[0.04, 0.01, 0, 0], [0.01, 0.09, 0, 0], [0, 0, 0.16, 0.02], [0, 0, 0.02, 0.25]])


def other_decoder(message):
    """mcap-ros2-support's decoder, made of the definition that travels in the file and of nothing else."""
    schema = Schema(id=1, name=message, encoding="ros2msg", data=autoware.definition(message).encode())
    return DecoderFactory().decoder_for("cdr", schema)


def decoded(data, message):
    """The message as mcap-ros2-support reads it; rosbags, which knows the definition by its text, reads the same."""
    seen = other_decoder(message)(data)
    assert plain(embedded(message).deserialize_cdr(data, message)) == plain(seen)
    return seen


def embedded(message):
    """A typestore that knows what the message's embedded definition says, and nothing else."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(autoware.definition(message), message))
    return store


def constant(name):
    """The value of "Type.NAME", as the embedded definition of TrackedObjects says."""
    kind, name = name.split(".")
    return getattr(embedded(autoware.TRACKED_OBJECTS.message).types[f"{autoware.PACKAGE}/msg/{kind}"], name)


def plain(value):
    """Any decoder's message as lists and dicts."""
    if isinstance(value, bytes | np.ndarray):
        return list(value)
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    names = [field.name for field in fields(value)] if is_dataclass(value) else getattr(value, "__slots__", ())
    # rosbags counts constants and the type's name among the fields
    shown = [name for name in names if not name.isupper() and not name.startswith("__")]
    return {name: plain(getattr(value, name)) for name in shown} if shown else value


@pytest.fixture
def scene(make):
    """A pedestrian who walks up and to the right with two paths, and one who stands and has no prediction."""
    walker = make.track(0, id=7, state=(3.0, 4.0, 0.6, 0.8), covariance=COVARIANCE)
    stander = make.track(0, id=8, state=(-1.0, 2.0, 0.1, -0.05), covariance=COVARIANCE)
    prediction = make.prediction(7, [(3.24, 4.32), (3.24, 5.0), (3.24, 5.0)])
    turn = ModalPath(0.25, np.array([(2.0, 4.0), (1.0, 4.0), (0.0, 4.0)]))
    prediction = Prediction(
        7, False, (ModalPath(0.75, prediction.paths[0].points_m), turn), prediction.mixture, 0.125, 1.5
    )
    tracks = TrackFrame(5, make.stamp(1234.5), "odom", tracks=(walker, stander), epoch=2)
    predictions = PredictionFrame(5, tracks.stamp_ns, "odom", "random", 0.4, (prediction,))
    return SimpleNamespace(tracks=tracks, predictions=predictions)


@pytest.fixture
def tracked(scene):
    return decoded(autoware.tracked_objects(scene.tracks, GROUND_M), autoware.TRACKED_OBJECTS.message)


@pytest.fixture
def predicted(scene):
    data = autoware.predicted_objects(scene.tracks, scene.predictions, GROUND_M)
    return decoded(data, autoware.PREDICTED_OBJECTS.message)


def yaw(pose):
    assert (pose.orientation.x, pose.orientation.y) == (0, 0)
    return 2 * math.atan2(pose.orientation.z, pose.orientation.w)


def place(pose):
    return pose.position.x, pose.position.y, pose.position.z


def assert_is_walker(pose, twist, acceleration):
    """Position of the middle, heading along the velocity, the velocity straight ahead, covariances turned with it."""
    assert place(pose.pose) == (3, 4, MIDDLE_M)
    assert yaw(pose.pose) == pytest.approx(math.atan2(0.8, 0.6))
    linear, angular = twist.twist.linear, twist.twist.angular
    assert (linear.x, linear.y, linear.z) == pytest.approx((1, 0, 0))
    assert (angular.x, angular.y, angular.z) == (0, 0, 0)
    # by hand, with the unit vectors ahead (0.6, 0.8) and to the left (-0.8, 0.6)
    ahead = 0.36 * 0.16 + 2 * 0.48 * 0.02 + 0.64 * 0.25
    left = 0.64 * 0.16 - 2 * 0.48 * 0.02 + 0.36 * 0.25
    both = 0.48 * (0.25 - 0.16) + (0.36 - 0.64) * 0.02
    expected = np.zeros((6, 6))
    expected[:2, :2] = [[ahead, both], [both, left]]
    np.testing.assert_allclose(np.reshape(twist.covariance, (6, 6)), expected, atol=1e-15)
    expected[:2, :2] = COVARIANCE[:2, :2]
    expected[5, 5] = left  # at 1 m/s: left of the velocity's end, seen from its beginning
    np.testing.assert_allclose(np.reshape(pose.covariance, (6, 6)), expected, atol=1e-15)
    accel = acceleration.accel
    assert {accel.linear.x, accel.linear.y, accel.linear.z, accel.angular.x, accel.angular.y, accel.angular.z} == {0}
    assert set(acceleration.covariance) == {0}


def test_a_walking_track_field_by_field(tracked, make):
    assert (tracked.header.stamp.sec, tracked.header.stamp.nanosec) == divmod(make.stamp(1234.5), 10**9)
    assert tracked.header.frame_id == "odom"
    walker, _ = tracked.objects
    assert bytes(walker.object_id.uuid) == autoware.object_id(2, 7).bytes
    assert walker.existence_probability == np.float32(0.9)
    [pedestrian] = walker.classification
    assert (pedestrian.label, pedestrian.probability) == (constant("ObjectClassification.PEDESTRIAN"), 1)
    assert walker.shape.type == constant("Shape.CYLINDER")
    assert walker.shape.footprint.points == []
    size = walker.shape.dimensions
    assert (size.x, size.y, size.z) == (2 * PERSON_RADIUS_M, 2 * PERSON_RADIUS_M, PERSON_HEIGHT_M)
    kinematics = walker.kinematics
    assert_is_walker(
        kinematics.pose_with_covariance, kinematics.twist_with_covariance, kinematics.acceleration_with_covariance
    )
    assert kinematics.orientation_availability == constant("TrackedObjectKinematics.AVAILABLE")
    assert kinematics.is_stationary is False


def test_who_stands_has_a_velocity_but_no_heading(tracked):
    kinematics = tracked.objects[1].kinematics
    assert kinematics.orientation_availability == constant("TrackedObjectKinematics.UNAVAILABLE")
    assert kinematics.is_stationary is True
    assert yaw(kinematics.pose_with_covariance.pose) == 0
    assert kinematics.pose_with_covariance.covariance[35] == pytest.approx(math.pi**2 / 3)
    linear = kinematics.twist_with_covariance.twist.linear
    assert (linear.x, linear.y) == pytest.approx((0.1, -0.05))
    np.testing.assert_allclose(
        np.reshape(kinematics.twist_with_covariance.covariance, (6, 6))[:2, :2], COVARIANCE[2:, 2:]
    )


@pytest.mark.parametrize(("speed", "moves"), [(autoware.MOVING_MPS, True), (autoware.MOVING_MPS - 1e-9, False)])
def test_the_heading_begins_at_a_speed(make, speed, moves):
    frame = TrackFrame(0, make.stamp(0), "odom", tracks=(make.track(0, state=(0, 0, 0, speed)),))
    [walker] = decoded(autoware.tracked_objects(frame, 0), autoware.TRACKED_OBJECTS.message).objects
    assert walker.kinematics.is_stationary is not moves
    assert yaw(walker.kinematics.pose_with_covariance.pose) == pytest.approx(math.pi / 2 if moves else 0)


def test_predicted_objects_are_the_tracked_ones(tracked, predicted):
    assert plain(predicted.header) == plain(tracked.header)
    for before, after in zip(tracked.objects, predicted.objects, strict=True):
        for field in ("object_id", "existence_probability", "classification", "shape"):
            assert plain(getattr(before, field)) == plain(getattr(after, field))
        for field in ("pose_with_covariance", "twist_with_covariance", "acceleration_with_covariance"):
            assert plain(getattr(before.kinematics, field)) == plain(getattr(after.kinematics, f"initial_{field}"))
    assert predicted.objects[1].kinematics.predicted_paths == []  # there is no prediction of it


def test_a_path_begins_with_the_present_pose(predicted):
    straight, turn = predicted.objects[0].kinematics.predicted_paths
    assert (straight.confidence, turn.confidence) == (0.75, 0.25)
    for path in (straight, turn):
        assert (path.time_step.sec, path.time_step.nanosec) == (0, 400_000_000)
    assert [place(pose) for pose in straight.path] == [
        (3, 4, MIDDLE_M), (3.24, 4.32, MIDDLE_M), (3.24, 5, MIDDLE_M), (3.24, 5, MIDDLE_M)
    ]  # fmt: skip
    # each looks where it goes next; who stays keeps looking there
    headings = [math.atan2(0.32, 0.24), math.pi / 2, math.pi / 2, math.pi / 2]
    assert [yaw(pose) for pose in straight.path] == pytest.approx(headings)
    assert [yaw(pose) for pose in turn.path] == pytest.approx([math.pi] * 4)


def test_a_longer_time_step_has_seconds(scene):
    frame = PredictionFrame(5, scene.tracks.stamp_ns, "odom", "random", 1.25, scene.predictions.predictions)
    data = autoware.predicted_objects(scene.tracks, frame, 0)
    step = decoded(data, autoware.PREDICTED_OBJECTS.message).objects[0].kinematics.predicted_paths[0].time_step
    assert (step.sec, step.nanosec) == (1, 250_000_000)


def test_no_more_than_a_hundred_paths_of_a_hundred_poses(make):
    """The likeliest are kept, and the beginning of each."""
    points = np.column_stack([np.arange(1.0, 151.0), np.zeros(150)])
    one = make.prediction(1, points)
    probabilities = np.linspace(2, 0, 120) / 120
    paths = tuple(ModalPath(probability, points) for probability in probabilities)
    frame = TrackFrame(0, make.stamp(0), "odom", tracks=(make.track(0),))
    predictions = PredictionFrame(0, make.stamp(0), "odom", "random", 0.1, (Prediction(1, False, paths, one.mixture),))
    data = autoware.predicted_objects(frame, predictions, 0)
    found = decoded(data, autoware.PREDICTED_OBJECTS.message).objects[0].kinematics.predicted_paths
    assert [path.confidence for path in found] == [np.float32(probability) for probability in probabilities[:100]]
    assert {len(path.path) for path in found} == {100}
    assert [pose.position.x for pose in found[0].path] == list(range(100))


def test_nobody_is_an_empty_list(make):
    frame = TrackFrame(0, make.stamp(0), "odom")
    predictions = PredictionFrame(0, make.stamp(0), "odom", "random", 0.4)
    assert decoded(autoware.tracked_objects(frame, 0), autoware.TRACKED_OBJECTS.message).objects == []
    data = autoware.predicted_objects(frame, predictions, 0)
    assert decoded(data, autoware.PREDICTED_OBJECTS.message).objects == []


def test_equal_frames_give_equal_bytes(scene):
    first, again = (autoware.predicted_objects(scene.tracks, scene.predictions, GROUND_M) for _ in range(2))
    assert first == again
    assert first[:4] == b"\x00\x01\x00\x00"  # CDR, little-endian, on every machine


# --- identities ------------------------------------------------------------------------------------------------------


def test_object_ids_show_epoch_and_id():
    assert str(autoware.object_id(0, 42)) == "00000000-0000-8000-8000-00000000002a"
    assert str(autoware.object_id(3, 42)) == "00000000-0003-8000-8000-00000000002a"
    assert (autoware.object_id(1, 1).version, autoware.object_id(1, 1).variant) == (8, "specified in RFC 4122")


def test_object_ids_differ_between_tracks_and_between_epochs():
    ids = [0, 1, 2, 2**32, 2**62 - 1]
    epochs = [0, 1, 2**16, 2**32 - 1]
    assert len({autoware.object_id(epoch, number) for epoch in epochs for number in ids}) == len(ids) * len(epochs)


# --- what rosbag2 wants of a channel ---------------------------------------------------------------------------------


@pytest.mark.parametrize("named_qos", [False, True])
def test_offered_qos_is_reliable_volatile_and_keeps_ten(named_qos):
    text = autoware.channel_metadata(autoware.TRACKED_OBJECTS.message, named_qos=named_qos)["offered_qos_profiles"]
    [qos] = parse_qos(text)
    assert (qos.history, qos.depth) == (QosHistory.KEEP_LAST, 10)
    assert (qos.reliability, qos.durability) == (QosReliability.RELIABLE, QosDurability.VOLATILE)
    assert qos.liveliness == QosLiveliness.AUTOMATIC
    assert not qos.avoid_ros_namespace_conventions
    forever_ns = 2**63 - 1
    for time in (qos.deadline, qos.lifespan, qos.liveliness_lease_duration):
        assert time.sec * 10**9 + time.nsec == forever_ns
    assert ("reliability: reliable" in text) is named_qos


@pytest.mark.parametrize("topic", [autoware.TRACKED_OBJECTS, autoware.PREDICTED_OBJECTS], ids=lambda topic: topic.name)
def test_the_type_hash_is_that_of_the_embedded_definition(topic):
    metadata = autoware.channel_metadata(topic.message, named_qos=False)
    assert metadata["topic_type_hash"] == embedded(topic.message).hash_rihs01(topic.message)


# --- the definitions themselves --------------------------------------------------------------------------------------

# Fields as autowarefoundation/autoware_msgs has them, at the commit named.
UPSTREAM = {
    "PredictedPath": "geometry_msgs/Pose[] path, builtin_interfaces/Duration time_step, float32 confidence",  # ef441a7
    "PredictedObjects": "std_msgs/Header header, PredictedObject[] objects",  # c8f8534
    "Shape": "uint8 type, geometry_msgs/Polygon footprint, geometry_msgs/Vector3 dimensions",  # c8f8534
    "ObjectClassification": "uint8 label, float32 probability",  # 3dffd27
    "TrackedObject": "unique_identifier_msgs/UUID object_id, float32 existence_probability, "
    "ObjectClassification[] classification, TrackedObjectKinematics kinematics, Shape shape",  # 50e4060
    "TrackedObjectKinematics": "geometry_msgs/PoseWithCovariance pose_with_covariance, "
    "geometry_msgs/TwistWithCovariance twist_with_covariance, "
    "geometry_msgs/AccelWithCovariance acceleration_with_covariance, uint8 orientation_availability, "
    "bool is_stationary",  # 50e4060
}


@pytest.mark.parametrize("name", UPSTREAM)
def test_definitions_have_the_fields_of_autowares_package(name):
    def fields_of(lines):
        return [tuple(line.split()) for line in lines if line.split() and "=" not in line and "#" not in line]

    shipped = files("replay") / "ros_definitions" / "autoware_perception_msgs" / f"{name}.msg"
    assert fields_of(shipped.read_text().splitlines()) == fields_of(UPSTREAM[name].split(", "))
