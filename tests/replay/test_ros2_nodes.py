"""`pcgan track` and `pcgan predict` as ROS 2 nodes: a drive that a reference node publishes comes back predicted."""

import contextlib
import threading
import time

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic

from pcgan import bus
from replay import autoware, ros2_nodes
from replay.errors import LogError
from replay.logged_message import LoggedSchema
from replay.roles import RoleChoices
from replay.ros2_bus import Ros2Node
from replay.ros2_nodes import Ros2Sensors, graph_roles, published_channels
from replay.ros_type_hash import type_hash
from replay.track_node import SensorInbox
from schemas import codec
from schemas.messages import CameraCalibration, CameraDetections, TrackFrame
from tests.replay import foreign_ros as ros
from tests.replay.rmw_reference import ReferenceNode, wait_until

DOMAIN = 3
STACK = ros.Stack(4)
PREDICTED = autoware.PREDICTED_OBJECTS.message
MADE = {
    "vision_msgs/msg/Detection2DArray": lambda frame: ros.detection_array(
        STACK, CameraDetections(1, frame, np.empty((0, 4)), np.empty(0), ())
    ),
    "sensor_msgs/msg/CameraInfo": lambda frame: ros.camera_info(
        STACK, CameraCalibration(1, frame, 1280, 720, "plumb_bob", np.zeros(5), np.diag([800.0, 800.0, 1.0]))
    ),
}  # type -> values of a message of a frame


@pytest.fixture
def endpoint(tmp_path):
    return f"unixsock-stream/{tmp_path}/router"


@pytest.fixture
def router(endpoint):
    """What stands for ROS 2's zenoh router, with the ROS side of the bus."""
    with bus.open_shared_session(listen=[endpoint]) as session:
        yield session


@pytest.fixture
def drive_node(router, short_drive):
    """A ROS node that has announced the drive's topics; its messages by log time, with how to publish each."""
    with ReferenceNode(router, DOMAIN, "drive") as node:
        put, messages = {}, []
        for topic, log_time_ns, full, values in ros.foreign_messages(short_drive, STACK):
            if topic not in put:
                latched = topic == "/tf_static" or full.endswith("CameraInfo")
                put[topic] = node.publisher(topic, full, type_hash(STACK.schema(full)), latched=latched)
            messages.append((log_time_ns, put[topic], STACK.rosbags_bytes(full, values)))
        node.messages = messages
        yield node


def play(messages, rate=1.0):
    """Publishes messages as they were logged."""
    first_ns, began_s = messages[0][0], time.monotonic()
    for log_time_ns, put, data in messages:
        time.sleep(max(0.0, began_s + (log_time_ns - first_ns) * 1e-9 / rate - time.monotonic()))
        put(data)


@pytest.mark.usefixtures("drive_node")
def test_roles_come_from_the_graph(endpoint):
    with bus.open_shared_session(connect=[endpoint]) as session:
        roles = graph_roles(session, DOMAIN, RoleChoices(), settled_s=0)
        assert roles.scans == "/velodyne/front/clusters"
        assert roles.pose == "/vn100/odometry"
        assert roles.cameras == ("A0", "A1", "A2", "A3", "B0", "B1")
        with pytest.raises(LogError, match=f"in ROS domain {DOMAIN}: there is no topic /odom"):
            graph_roles(session, DOMAIN, RoleChoices(pose="/odom"), wait_s=0)
        with pytest.raises(LogError, match=r"in ROS domain 99: there is no LiDAR clusters .*; its topics are none"):
            graph_roles(session, 99, RoleChoices(), wait_s=0)


@contextlib.contextmanager
def in_thread(work):
    """Calls again and again until the end of the block."""
    ended = threading.Event()

    def loop():
        while not ended.wait(0.02):
            work()

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def announce(node, topic, full, *, latched=False):
    return node.publisher(topic, full, type_hash(STACK.schema(full)), latched=latched)


@pytest.fixture
def lidar_and_pose(router):
    """A ROS node that has announced the least there must be."""
    with ReferenceNode(router, DOMAIN, "lidar") as node:
        announce(node, "/clusters", "vision_msgs/msg/Detection3DArray")
        announce(node, "/odometry", "nav_msgs/msg/Odometry")
        yield node


def test_what_comes_up_while_the_graph_settles_is_listened_to(endpoint, lidar_and_pose):
    """A camera and the mounts come up one after another, each sooner than things are settled."""
    late = [
        ("/front/boxes", "vision_msgs/msg/Detection2DArray"),
        ("/front/camera_info", "sensor_msgs/msg/CameraInfo"),
        ("/mounts", "tf2_msgs/msg/TFMessage"),
    ]

    def come_up():
        for topic, full in late:
            time.sleep(0.5)
            announce(lidar_and_pose, topic, full)

    thread = threading.Thread(target=come_up)
    with bus.open_shared_session(connect=[endpoint]) as session:
        thread.start()
        roles = graph_roles(session, DOMAIN, RoleChoices(), settled_s=1.0)
        thread.join()
    assert roles.cameras == ("front",)
    assert roles.readings.keys() == {"/clusters", "/odometry", "/tf_static", "/tf", *(topic for topic, _ in late)}


@pytest.mark.usefixtures("lidar_and_pose")
def test_a_graph_that_never_settles_is_taken_as_it_is_in_the_end(endpoint):
    with bus.open_shared_session(connect=[endpoint]) as session:
        assert graph_roles(session, DOMAIN, RoleChoices(), wait_s=0.5, settled_s=60).scans == "/clusters"


def test_the_usual_transforms_are_listened_to_before_anybody_publishes_them(endpoint, lidar_and_pose):
    with bus.open_shared_session(connect=[endpoint]) as session:
        roles = graph_roles(session, DOMAIN, RoleChoices(), settled_s=0)
        assert roles.topics("transforms") == ("/tf_static", "/tf")
        assert roles.readings["/tf"].why == "the usual name"
        announce(lidar_and_pose, "/tf", "tf2_msgs/msg/TFMessage")
        announce(lidar_and_pose, "/mounts", "tf2_msgs/msg/TFMessage")
        wait_until(lambda: len(published_channels(session, DOMAIN)) == 4)
        roles = graph_roles(session, DOMAIN, RoleChoices(pose="/tf"), settled_s=0)
        assert (roles.pose, set(roles.topics("transforms"))) == ("/tf", {"/tf_static", "/mounts"})
        roles = graph_roles(session, DOMAIN, RoleChoices(transforms=("/mounts",)), settled_s=0)
        assert roles.topics("transforms") == ("/mounts",)


def test_boxes_and_calibrations_that_no_name_brings_together_are_paired_by_their_frames(endpoint, lidar_and_pose):
    """As Autoware names them: /rois0 and /camera0/camera_info; here numbered crosswise, one calibration latched."""
    camera_info = "sensor_msgs/msg/CameraInfo"
    boxes = "vision_msgs/msg/Detection2DArray"
    puts = []
    for topic, full, frame in (
        ("/rois0", boxes, "left"),
        ("/rois1", boxes, "right"),
        ("/camera0/camera_info", camera_info, "right"),
        ("/camera1/camera_info", camera_info, "left"),
    ):
        put = announce(lidar_and_pose, topic, full, latched=topic.startswith("/camera1"))
        data = STACK.rosbags_bytes(full, STACK.filled(full, MADE[full](frame)))
        puts.append((put, data))
    latched, said = puts.pop()
    latched(said)
    with bus.open_shared_session(connect=[endpoint]) as session, in_thread(lambda: [put(data) for put, data in puts]):
        roles = graph_roles(session, DOMAIN, RoleChoices(), settled_s=0)
    of_camera = {name: roles.topics("camera", "calibration", camera=name) for name in roles.cameras}
    assert of_camera == {
        "rois0": ("/rois0", "/camera1/camera_info"),
        "rois1": ("/rois1", "/camera0/camera_info"),
    }


def test_a_silent_topic_has_no_frame(endpoint, lidar_and_pose, monkeypatch):
    monkeypatch.setattr(ros2_nodes, "LISTEN_S", 0.2)
    with bus.open_shared_session(connect=[endpoint]) as session:
        began_s = time.monotonic()
        assert ros2_nodes.frame_heard(session, DOMAIN, "/clusters") is None
        assert 0.2 <= time.monotonic() - began_s < 1.5
    wait_until(lambda: not lidar_and_pose.others("NN"))


def test_topics_of_types_nobody_knows_are_listed_and_of_no_use(endpoint, drive_node):
    drive_node.publisher("/strange", "my_msgs/msg/Thing", "RIHS01_" + "0" * 64)
    with bus.open_shared_session(connect=[endpoint]) as session, Ros2Node(session, DOMAIN, "listener"):
        by_topic = {channel.topic: channel for channel in published_channels(session, DOMAIN)}
    assert by_topic["/strange"].schema.name == "my_msgs/msg/Thing"
    assert by_topic["/strange"].encoding == "unknown"
    assert by_topic["/vn100/odometry"].encoding == "cdr"


def test_what_was_latched_before_we_came_reaches_a_tracker_that_starts_late(endpoint, drive_node):
    for _, put, data in drive_node.messages[:100]:
        put(data)
    inbox, arrived = SensorInbox(), set()
    with bus.open_shared_session(connect=[endpoint]) as session, Ros2Node(session, DOMAIN, "late") as node:
        sensors = Ros2Sensors(node, graph_roles(session, DOMAIN, RoleChoices(), settled_s=0))
        sensors.listen(inbox)
        wanted = {"/tf_static", *(f"/gmsl/{camera}/camera_info" for camera in ("A0", "A1", "A2", "A3", "B0", "B1"))}
        wait_until(lambda: arrived.update(each.message.topic for each in inbox.drain(0.1)[0]) or arrived >= wanted)
    assert arrived == wanted
    assert sensors.refused == 0


@pytest.mark.slow
def test_a_drive_on_ros_topics_comes_back_as_predicted_objects(router, endpoint, drive_node, start_pcgan):
    definition = autoware.definition(PREDICTED)
    hash_ = type_hash(LoggedSchema(PREDICTED, "ros2msg", definition.encode()))
    answers = drive_node.subscribe(autoware.PREDICTED_OBJECTS.name, PREDICTED, hash_)
    frames = []
    tracks = router.declare_subscriber("pcgan/tracks", lambda sample: frames.append(sample.payload.to_bytes()))
    options = ("--ros2-domain", DOMAIN, "--connect", endpoint)
    nodes = [start_pcgan("predict", *options), start_pcgan("track", *options)]
    wait_until(lambda: len(drive_node.others("MS")) >= 15, 60)
    wait_until(lambda: drive_node.others("MP", autoware.PREDICTED_OBJECTS.name), 60)
    play(drive_node.messages)
    wait_until(lambda: len(answers) >= 15, 20)  # of 30 scans; live, a busy machine leaves some out
    assert {token["node"] for token in drive_node.others("NN")} == {"pcgan_track", "pcgan_predict"}
    decode = generate_dynamic(PREDICTED, definition)[PREDICTED]
    of_stamp = {frame.stamp_ns: frame for frame in (codec.decode(TrackFrame, data) for data in frames)}
    people = 0
    for sample in answers:
        message = decode(sample.payload.to_bytes())
        frame = of_stamp[message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec]
        assert len(message.objects) == len(frame.tracks)
        for found, track in zip(message.objects, frame.tracks, strict=True):
            at = found.kinematics.initial_pose_with_covariance.pose.position
            np.testing.assert_allclose([at.x, at.y], track.state[:2], atol=1e-9)
            assert found.classification[0].label == 7
            people += len(found.kinematics.predicted_paths) > 0
    assert people > 50
    tracks.undeclare()
    for node in nodes:
        node.terminate()
        assert node.wait(10) == 0
