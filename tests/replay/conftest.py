"""Builders for the tests of replay/: messages, frame results, a rig of one camera, and ways to run the command."""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from replay import PredictorChoice, Replay, cli, record
from replay.frame_result import FrameResult
from replay.simulator.sensor_suite import CLUSTERS_TOPIC, GROUND_TRUTH_TOPIC, ODOMETRY_TOPIC
from schemas import codec
from schemas import pcgan_v1_pb2 as pb
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
    Transform,
    VehicleHistory,
    VehiclePose,
)
from tracking.measurements import empty_measurements
from tracking.sensor_frame import SensorFrame

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
COVARIANCE = np.diag([0.04, 0.04, 0.09, 0.09])


class Outcome(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


@pytest.fixture
def pcgan(capfd, monkeypatch):
    """Runs the command in this process, as in a pipe; returns exit code, stdout and stderr."""
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "160")

    def run(*arguments: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["pcgan", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ending:
            cli.main()
        code = ending.value.code
        return Outcome(0 if code is None else code, *capfd.readouterr())

    return run


# A shell that runs the tests in the background has them ignore Ctrl-C, and children inherit that.
_START = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from replay.cli import main; main()"


@pytest.fixture
def start_pcgan():
    """Starts the command as a process of its own (its own session, too); whatever still runs at the end is killed."""
    started = []

    def start(*arguments: object, **options) -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, "-c", _START, *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            **options,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture(scope="session")
def shift_stamps():
    """Returns a change for `edit_log`: the stamps of some topics are off by so many ms, their log times are not."""
    kinds = {CLUSTERS_TOPIC: pb.LidarClusters, GROUND_TRUTH_TOPIC: pb.GroundTruthFrame, ODOMETRY_TOPIC: pb.VehiclePose}

    def change(offset_ms: float, *topics: str) -> Callable:
        def shifted(topic: str, data: bytes) -> bytes:
            message = kinds.get(topic, pb.CameraDetections).FromString(data)
            message.stamp_ns += round(offset_ms * MS)
            return message.SerializeToString(deterministic=True)

        return lambda log: [(topic, at, shifted(topic, data) if topic in topics else data) for topic, at, data in log]

    return change


@pytest.fixture(scope="session")
def recorded(short_drive, model, tmp_path_factory):
    """The short drive replayed in this process: path of the output, summary, frame results."""
    output, frames = tmp_path_factory.mktemp("recorded") / "out.mcap", []
    with_model = PredictorChoice("inline", model)
    summary = record(Replay([short_drive], None, with_model), output, on_frame=frames.append)
    return SimpleNamespace(path=output, summary=summary, frames=frames)


@pytest.fixture(scope="session")
def results(drive, model):
    """The 6 s drive's frame results, predicted in this process."""
    with Replay([drive], None, PredictorChoice("inline", model)) as run:
        return list(run)


@pytest.fixture(scope="session")
def digest():
    """Turns frame results into something that is equal only where log times, tracks and predictions are."""

    def of(frames: Sequence[FrameResult]) -> list[tuple[int, bytes, bytes]]:
        return [(f.log_time_ns, codec.encode(f.tracks), codec.encode(f.predictions)) for f in frames]

    return of


@pytest.fixture(scope="session")
def make():
    """Builders of single messages; times in ms after a fixed start."""
    return Make()


class Make:
    """Messages of a vehicle that drives along x at 2 m/s with one camera in front."""

    START_NS = START_NS
    MS = MS

    def stamp(self, at_ms: float) -> int:
        return START_NS + round(at_ms * MS)

    def pose(self, at_ms: float, x=None, quaternion=(0.0, 0.0, 0.0, 1.0), velocity=(2.0, 0.0, 0.0), child="base_link"):
        position = np.array([2e-3 * at_ms if x is None else x, 0.0, 0.0])
        return VehiclePose(
            self.stamp(at_ms), "odom", child, position, np.array(quaternion), np.array(velocity), np.zeros(3)
        )

    def scan(self, at_ms: float, centroids=((8.0, 0.0, -0.5),), frame="lidar"):
        centroids = np.array(centroids, float).reshape(-1, 3)
        sizes, points = np.tile((0.5, 0.5, 1.7), (len(centroids), 1)), np.full(len(centroids), 40)
        return LidarClusters(self.stamp(at_ms), frame, centroids, sizes, points)

    def boxes(self, at_ms: float, boxes=((900.0, 500.0, 960.0, 700.0),), frame="camera"):
        boxes = np.array(boxes, float).reshape(-1, 4)
        return CameraDetections(self.stamp(at_ms), frame, boxes, np.full(len(boxes), 0.9), ("person",) * len(boxes))

    def calibration(self, at_ms: float = 0.0, model="equidistant", coefficients=4, frame="camera"):
        K = np.array([[1176.0, 0, 962.0], [0, 1177.0, 612.0], [0, 0, 1]])
        return CameraCalibration(self.stamp(at_ms), frame, 1920, 1208, model, np.zeros(coefficients), K)

    def transform(self, parent: str, child: str, translation=(0.0, 0.0, 0.0), quaternion=(0.0, 0.0, 0.0, 1.0)):
        return Transform(START_NS, parent, child, np.array(translation, float), np.array(quaternion, float))

    def track(self, at_ms: float, id=1, state=(0.0, 0.0, 1.0, 0.0), coasting=False, covariance=COVARIANCE):
        state = np.array(state, float)
        history = TrackHistory(np.array([self.stamp(at_ms)]), state[None], np.array([coasting]))
        return Track(id, state, np.array(covariance), 0.9, 10**9, coasting, history)

    def prediction(self, track_id: int, points, *, sigma=0.5, fallback=False, probability=1.0):
        """A prediction of one path with a single-component mixture around it."""
        points = np.array(points, float)
        ones = np.ones((len(points), 1), np.float32)
        mixture = Mixture(
            ones,
            points[:, None].astype(np.float32),
            np.full((len(points), 1, 2), sigma, np.float32),
            np.zeros((len(points), 1), np.float32),
        )
        return Prediction(track_id, fallback, (ModalPath(probability, points),), mixture)

    def truth(self, at_ms: float, people=(), lidar_points=40):
        """A ground truth of (id, x, y) triples."""
        rows = np.array(people, float).reshape(-1, 3)
        count = len(rows)
        return GroundTruthFrame(
            self.stamp(at_ms),
            "odom",
            rows[:, 0].astype(np.int64),
            rows[:, 1:],
            np.zeros((count, 2)),
            np.full(count, lidar_points),
        )

    def result(self, at_ms: float, tracks=(), predictions=(), truth=None, epoch=0, dt_s=0.1, sequence=0):
        """A frame result with an empty scan around the given tracks and predictions."""
        stamp_ns = self.stamp(at_ms)
        vehicle = VehicleHistory(np.array([stamp_ns]), np.array([[0.0, 0.0, 0.0, 2.0, 0.0]]))
        sensors = SensorFrame(stamp_ns, self.scan(at_ms, ()), np.eye(4), np.eye(4), (), "odom")
        return FrameResult(
            stamp_ns + 50 * MS,
            sensors,
            empty_measurements(),
            TrackFrame(sequence, stamp_ns, "odom", vehicle, tuple(tracks), False, epoch),
            PredictionFrame(sequence, stamp_ns, "odom", "random", dt_s, tuple(predictions)),
            {},
            truth,
        )


@pytest.fixture
def mcap_content():
    """Reads a file with mcap's own reader: messages, metadata records and attachments."""
    from mcap.reader import make_reader

    def read(path: Path):
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            messages = [(channel.topic, m.log_time, m.data) for _, channel, m in reader.iter_messages()]
            metadata = {record.name: record.metadata for record in reader.iter_metadata()}
            attachments = {record.name: record.data for record in reader.iter_attachments()}
            header, summary = reader.get_header(), reader.get_summary()
        return SimpleNamespace(
            messages=messages, metadata=metadata, attachments=attachments, header=header, summary=summary
        )

    return read
