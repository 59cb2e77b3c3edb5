"""The route of docs/usyd.md: a ROS 1 bag with points, converted by rosbags; boxes from the video beside it."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags import rosbag1

from replay import PredictorChoice, Replay
from replay.log_reader import LogReader
from replay.simulator import simulate
from replay.simulator.sensor_suite import CLUSTERS_TOPIC
from schemas import codec
from schemas.messages import CameraDetections
from tests.replay import foreign_ros as ros

ROOT = Path(__file__).parents[2]
FRAME_INFO = "std_msgs/Header header\nuint64 camera_timestamp\ntime ros_timestamp\nuint32 frame_counter"
POINTS, INFO = "/velodyne/front/points", "/gmsl/A0/camera_info"
BOXES, FRAMES = "/gmsl/A0/detections", "/gmsl/A0/frame_info"
CLOCK_NS = 7_000_000_000  # by which the cameras' clock is off
SIZE = 96, 64


def stamps_of(path, topic):
    return [codec.decode(CameraDetections, message.data).stamp_ns for message in LogReader([path]).messages({topic})]


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A 3 s bag as the vehicle records it, and the front camera's video, which begins two frames before the bag."""
    cv2 = pytest.importorskip("cv2")
    folder = tmp_path_factory.mktemp("usyd")
    drive = folder / "drive.mcap"
    simulate(drive, clip=None, vehicle=None, pedestrians=8, duration_s=3.0, seed=3, points=True)
    stack = ros.Stack(1, {"gmsl_frame_msg/msg/FrameInfo": FRAME_INFO})
    video = cv2.VideoWriter(str(folder / "Week1-A0.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30, SIZE)
    frames = 0
    with rosbag1.Writer(folder / "Week1.bag") as writer:
        connections = {}

        def write(topic, log_time_ns, full, values):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, full, typestore=stack.store)
            writer.write(connections[topic], log_time_ns, stack.rosbags_bytes(full, values))

        exposed_ns = iter(stamps_of(drive, BOXES))
        for topic, log_time_ns, full, values in ros.foreign_messages(drive, stack):
            if topic in (POINTS, INFO, "/tf", "/tf_static", "/vn100/odometry"):
                write(topic, log_time_ns, full, values)
            elif topic == BOXES:
                stamp_ns = next(exposed_ns)
                info = {
                    "header": ros.header(stamp_ns, values["header"]["frame_id"]),
                    "camera_timestamp": (stamp_ns - CLOCK_NS) // 1000,
                    "frame_counter": frames,
                }
                for _ in range((frames > 1) + (frames == 30)):  # one of them twice
                    write(FRAMES, log_time_ns, "gmsl_frame_msg/msg/FrameInfo", info)
                video.write(np.full((SIZE[1], SIZE[0], 3), 2 * frames, np.uint8))
                frames += 1
    video.release()
    return folder / "Week1.bag"


@pytest.fixture(scope="module")
def converted(bag):
    target = bag.parent / "week1"
    tool = Path(sys.executable).with_name("rosbags-convert")
    subprocess.run([tool, "--src", bag, "--dst", target, "--dst-storage", "mcap"], check=True, capture_output=True)
    return target / "week1.mcap"


def test_the_lidar_alone_gives_predictions_with_no_options(converted, model):
    with Replay([converted], None, PredictorChoice("inline", model)) as run:
        frames = list(run)
    assert run.roles.readings[POINTS].role == "points"
    assert run.roles.cameras == ()
    assert len(frames) >= 28
    assert run.refusals.total == 0
    assert sum(len(frame.predictions.predictions) for frame in frames) > 20


def test_boxes_come_from_the_video_by_frame_number_with_their_exposure_time(bag, converted, model):
    spec = importlib.util.spec_from_file_location("detect_video", ROOT / "examples" / "detect_video.py")
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    seen = []

    def detect(image):
        """Finds nobody but a grey value, which says which frame it is."""
        seen.append(round(float(image.mean()) / 2))
        return np.array([[1.0, 2, 30, 60], [5, 5, 9, 9]]), np.array([0.9, 0.1]), ["person", "kite"]

    output = bag.parent / "boxes.mcap"
    written = example.run(bag, output, detect, ["A0"], least_score=0.3)
    found = [codec.decode(CameraDetections, message.data) for message in LogReader([output]).messages()]
    assert len(found) == written == len(seen) > 80
    assert np.abs(np.array(seen) - np.arange(2, 2 + written)).max() <= 1  # the video is lossy
    assert all(each.labels == ("person",) for each in found)
    stamps_ns = stamps_of(bag.parent / "drive.mcap", BOXES)
    assert all(min(abs(each.stamp_ns - stamp_ns) for stamp_ns in stamps_ns) < 2_000 for each in found)

    with Replay([converted, output], None, PredictorChoice("inline", model)) as run:
        frames = list(run)
    assert run.roles.cameras == ("A0",)
    assert run.refusals.total == 0
    assert np.mean([len(frame.sensors.cameras) == 1 for frame in frames[2:-2]]) > 0.9
    assert CLUSTERS_TOPIC not in run.roles.readings
