"""The live tracker on the bus: a played drive gives the tracks of its replay, whatever else comes along."""

import queue
import threading
import time
from contextlib import contextmanager
from itertools import islice

import pytest
import zenoh
import zenoh.ext

from pcgan import bus, node_health
from pcgan.node_health import health_key
from replay import foxglove, track_node
from replay.bus_channels import key_of, zenoh_encoding
from replay.log_reader import LogReader
from replay.logged_message import LoggedSchema, RawMessage
from replay.roles import live_roles
from replay.session import ReplaySettings
from replay.simulator.sensor_suite import CLUSTERS_TOPIC, ODOMETRY_TOPIC, TF_STATIC_TOPIC
from replay.track_node import SensorInbox, TrackNode, alive_key
from schemas import codec, topics
from schemas.messages import NodeHealth, TrackFrame, VehiclePose

PATIENCE_S = 20
UNHURRIED_MS = 60_000  # drives are played here as fast as it goes: no scan may be left out for that
SENSORS = set(live_roles().readings)


def until(condition):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


class World:
    """The rest of the vehicle: sensors that publish, and somebody who listens to what the node says."""

    def __init__(self, session, namespace=""):
        self.session, self.namespace = session, namespace
        self.tracks, self.poses, self.runs = queue.SimpleQueue(), queue.SimpleQueue(), set()
        self._publishers = {}
        self._subscribers = [
            session.declare_subscriber(topics.zenoh_key(topics.TRACKS, namespace), self._on_tracks),
            session.declare_subscriber(topics.zenoh_key(topics.VEHICLE_POSE, namespace), self.poses.put),
        ]

    def _on_tracks(self, sample):
        self.runs.add(sample.attachment.to_bytes())
        self.tracks.put(sample)

    def send(self, message):
        encoding = zenoh_encoding(message.schema, message.encoding)
        self._publishers[message.topic].put(message.data, encoding=encoding)

    def play(self, log, node):
        """Publishes a drive as fast as it goes; its scans once the node knows the mounts and calibrations.

        The node asks for old ones first, so that these may come a little later than what was published after them.
        """
        messages = LogReader([log]).messages(SENSORS)
        static = list(islice(messages, 7))  # mounts, and the calibrations of six cameras
        assert {m.topic for m in static} == {m.topic for m in static if "info" in m.topic or "static" in m.topic}
        for message in static:
            self.send(message)
        until(lambda: {m.topic for m in static} <= set(node.tracker._heard_ns))
        for message in messages:
            self.send(message)

    def ready(self):
        """Returns once the node listens to all sensors: what is put earlier is lost."""
        for topic in SENSORS - set(self._publishers):
            self._publishers[topic] = self.session.declare_publisher(
                key_of(topic, self.namespace), congestion_control=zenoh.CongestionControl.BLOCK
            )
        until(lambda: all(publisher.matching_status.matching for publisher in self._publishers.values()))

    def received(self, count):
        return [self.tracks.get(timeout=PATIENCE_S).payload.to_bytes() for _ in range(count)]

    def health(self):
        with self.session.declare_subscriber(health_key("track", self.namespace)) as subscriber:
            return codec.decode(NodeHealth, subscriber.recv().payload.to_bytes())


@contextmanager
def tracking(folder, namespace="", settings=None, deadline_ms=UNHURRIED_MS, **options):
    """Runs a node on a bus of its own; yields the world and the node."""
    endpoint = f"unixsock-stream/{folder}/bus"
    with bus.open_session(listen=[endpoint]) as session:
        world = World(session, namespace)
        with node_on(endpoint, namespace, settings, deadline_ms, **options) as node:
            world.ready()
            yield world, node


@contextmanager
def node_on(endpoint, namespace="", settings=None, deadline_ms=UNHURRIED_MS, **options):
    with bus.open_session(connect=[endpoint]) as session:
        inbox = SensorInbox()
        node = TrackNode(session, inbox, settings, namespace=namespace, deadline_ms=deadline_ms)
        ready = threading.Event()
        thread = threading.Thread(target=lambda: node.serve(on_ready=ready.set, **options))
        thread.start()
        try:
            assert ready.wait(PATIENCE_S)
            yield node
        finally:
            inbox.close()
            thread.join(PATIENCE_S)
            assert not thread.is_alive()


@pytest.fixture
def quick_reports(monkeypatch):
    """Nodes report ten times a second."""
    monkeypatch.setattr(node_health, "REPORT_EVERY_NS", 100_000_000)


@pytest.fixture
def sensor(make):
    """Turns a message into what is published."""

    def published(topic, message):
        if isinstance(message, bytes):
            schema, data = LoggedSchema("pcgan.v1.LidarClusters", "protobuf", b""), message
        elif isinstance(message, tuple):
            schema, data = LoggedSchema("foxglove.FrameTransforms", "protobuf", b""), foxglove.encode(message)
        else:
            schema = LoggedSchema(codec.schema_name(type(message)), "protobuf", b"")
            data = codec.encode(message)
        return RawMessage(topic, 0, schema, "protobuf", data)

    def mounts():
        return published(TF_STATIC_TOPIC, (make.transform("base_link", "lidar"),))

    def scans(world, first_ms, last_ms):
        for at_ms in range(first_ms, last_ms, 10):
            world.send(published(ODOMETRY_TOPIC, make.pose(at_ms)))
            if at_ms % 100 == 0:
                world.send(published(CLUSTERS_TOPIC, make.scan(at_ms)))

    published.mounts, published.scans = mounts, scans
    return published


# --- live is replay ---------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("quick_reports")
def test_a_played_drive_gives_the_tracks_and_poses_of_its_replay(tmp_path, recorded, short_drive):
    with tracking(tmp_path, "car7") as (world, node):
        world.play(short_drive, node)
        frames = world.received(len(recorded.frames))
        assert frames == [codec.encode(frame.tracks) for frame in recorded.frames]
        poses = [world.poses.get(timeout=PATIENCE_S) for _ in recorded.frames]
        assert [p.payload.to_bytes() for p in poses] == [codec.encode(frame.vehicle_pose) for frame in recorded.frames]
        health = world.health()
        assert (health.node, health.frames, health.dropped, health.refused) == ("track", len(frames), 0, 0)
        assert health.problem == ""


def test_what_goes_out_says_what_it_is_and_holds_up_nobody(tmp_path, recorded, short_drive):
    with tracking(tmp_path) as (world, node):
        world.play(short_drive, node)
        frame, pose = world.tracks.get(timeout=PATIENCE_S), world.poses.get(timeout=PATIENCE_S)
        assert str(frame.key_expr) == "pcgan/tracks"
        assert str(frame.encoding) == "application/protobuf;pcgan.v1.TrackFrame"
        assert str(pose.encoding) == "application/protobuf;pcgan.v1.VehiclePose"
        assert frame.attachment.to_bytes() == pose.attachment.to_bytes()
        assert frame.congestion_control == pose.congestion_control == zenoh.CongestionControl.DROP
        world.received(len(recorded.frames) - 1)


def test_a_node_that_is_killed_and_started_again_goes_on(tmp_path, make, sensor):
    """Its tracks begin anew; mounts that their publisher keeps are asked for again."""
    endpoint = f"unixsock-stream/{tmp_path}/bus"
    config = tmp_path / "timestamps.json5"  # what is kept must have a time
    config.write_text('{mode: "peer", timestamping: {enabled: true}, scouting: {multicast: {enabled: false}}}')
    with bus.open_session(listen=[endpoint], config_file=config) as session:
        world = World(session)
        mounts = sensor.mounts()
        keeper = zenoh.ext.declare_advanced_publisher(
            session,
            key_of(TF_STATIC_TOPIC),
            encoding=zenoh_encoding(mounts.schema, "protobuf"),
            cache=zenoh.ext.CacheConfig(max_samples=10),
            publisher_detection=True,
        )
        keeper.put(mounts.data)
        for life in (1, 2):
            with node_on(endpoint) as node:
                world.ready()
                until(lambda: node.tracker._sync._tree.frames)
                sensor.scans(world, 2000 * life, 2000 * life + 700)
                first = codec.decode(TrackFrame, world.received(1)[0])
                assert first.stamp_ns > make.stamp(2000 * life - 1)
                assert (first.sequence, first.epoch) == (0, 0)
            until(lambda: not world._publishers[CLUSTERS_TOPIC].matching_status.matching)
            sensor.scans(world, 2000 * life + 700, 2000 * life + 1000)  # lost
            while not world.tracks.empty():
                world.tracks.get()
        assert len(world.runs) == 2


# --- what is missing, what makes no sense -----------------------------------------------------------------------------


@pytest.mark.usefixtures("quick_reports")
def test_what_is_missing_is_said_once_and_waited_for(tmp_path, sensor, caplog, monkeypatch):
    monkeypatch.setattr(track_node, "PATIENCE_NS", 0)
    with tracking(tmp_path) as (world, node):
        assert world.health().problem == (
            "no LiDAR clusters on /velodyne/front/clusters; no vehicle pose on /vn100/odometry"
        )
        sensor.scans(world, 0, 900)
        until(lambda: node.meter.refused >= 1)
        health = world.health()
        assert health.problem.startswith("no transform joins 'base_link' and 'lidar'")
        assert health.frames == 0
        world.health()
        world.send(sensor.mounts())
        sensor.scans(world, 900, 1500)
        assert world.received(1)
        world.health()
    lines = [record.getMessage() for record in caplog.records]
    assert [line.partition(":")[0] for line in lines] == ["waiting", "waiting", "what was missing is there"]
    assert "no transform joins" in lines[1]


def test_a_flood_of_nonsense_is_refused_counted_and_told_in_few_words(tmp_path, sensor, caplog):
    with tracking(tmp_path) as (world, node):
        world.send(sensor.mounts())
        for k in range(300):
            world.send(sensor(CLUSTERS_TOPIC, b"\xff nonsense %d" % k))
        sensor.scans(world, 0, 900)
        assert world.received(1)
        until(lambda: node.meter.refused == 300)
        assert "not a pcgan.v1.LidarClusters" in world.health().problem
    assert 1 <= len(caplog.records) <= 4


@pytest.mark.usefixtures("quick_reports")
def test_a_message_that_nobody_foresaw_does_not_end_the_node(tmp_path, sensor, caplog, monkeypatch):
    with tracking(tmp_path) as (world, node):
        real = node.tracker.take

        def take(message):
            if b"poison" in message.data:
                raise ZeroDivisionError("never thought of")
            real(message)

        monkeypatch.setattr(node.tracker, "take", take)
        world.send(sensor.mounts())
        world.send(sensor(CLUSTERS_TOPIC, b"poison"))
        sensor.scans(world, 0, 900)
        assert world.received(1)
        until(lambda: node.meter.refused == 1)
        assert "never thought of" in world.health().problem
    assert "could not use a message" in caplog.text


def test_a_topic_that_zenoh_cannot_carry_is_a_clear_error(tmp_path):
    settings = ReplaySettings.model_validate({"roles": {"clusters": "/front/*/clusters"}})
    with (
        bus.open_session(listen=[f"unixsock-stream/{tmp_path}/bus"]) as session,
        pytest.raises(ValueError, match=r"'/front/\*/clusters' cannot be a zenoh key"),
    ):
        TrackNode(session, SensorInbox(), settings).serve()


# --- overload ---------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("quick_reports")
def test_a_tracker_that_is_too_slow_keeps_to_the_newest_and_counts(tmp_path, make, sensor, monkeypatch):
    with tracking(tmp_path, deadline_ms=20) as (world, node):
        real = node.tracker.track
        slow = threading.Event()

        def track():
            if slow.is_set():
                time.sleep(0.06)
            return real()

        monkeypatch.setattr(node.tracker, "track", track)
        world.send(sensor.mounts())
        sensor.scans(world, 0, 300)
        until(lambda: node.meter.frames >= 1)
        slow.set()
        sensor.scans(world, 300, 4500)  # at once
        until(lambda: node.tracker.waiting == 0 and node.meter.frames + node.meter.dropped >= 44)
        world.health()
        stamps = []
        while not world.tracks.empty():
            stamps.append(codec.decode(TrackFrame, world.tracks.get().payload.to_bytes()).stamp_ns)
        assert stamps == sorted(stamps)
        assert stamps[-1] >= make.stamp(4300)  # the newest that was complete
        assert node.meter.dropped >= 20
        assert len(stamps) == node.meter.frames
        assert node.meter.frames + node.meter.dropped == len(range(0, 4500, 100)) - len(
            [ms for ms in (4400,) if make.stamp(ms) > stamps[-1]]
        )
        assert node.meter.late >= 1


class Clock:
    def __init__(self):
        self.now_ns = 0

    def __call__(self):
        self.now_ns += 1
        return self.now_ns


def message(topic, data=b"x"):
    return RawMessage(topic, 0, LoggedSchema("s", "protobuf", b""), "protobuf", data)


def test_the_inbox_gives_everything_in_the_order_of_arrival():
    inbox = SensorInbox(Clock())
    for topic in "abacab":
        inbox.put(message(topic))
    arrivals, now_ns = inbox.drain(0)
    assert [(a.arrived_ns, a.message.topic) for a in arrivals] == list(enumerate("abacab", 1))
    assert now_ns == 7
    assert inbox.drain(0)[0] == []


def test_a_flood_on_one_topic_pushes_out_its_own_oldest_only(monkeypatch):
    monkeypatch.setattr(track_node, "MAX_WAITING", 5)
    inbox = SensorInbox(Clock())
    inbox.put(message("/vn100/odometry"))
    for k in range(100):
        inbox.put(message("/flood", b"%d" % k))
    arrivals, _ = inbox.drain(0)
    assert [a.message.data for a in arrivals] == [b"x", b"95", b"96", b"97", b"98", b"99"]
    assert (inbox.pushed_out(), inbox.pushed_out()) == (95, 0)
    inbox.put(message("/flood"))  # after it was drained there is room again
    assert len(inbox.drain(0)[0]) == 1


def test_large_messages_are_bounded_by_their_bytes(monkeypatch):
    monkeypatch.setattr(track_node, "MAX_WAITING_BYTES", 100)
    inbox = SensorInbox(Clock())
    for k in range(10):
        inbox.put(message("/points", bytes([k] * 40)))
    assert [a.message.data[0] for a in inbox.drain(0)[0]] == [8, 9]
    inbox.put(message("/points", bytes(1000)))  # one is always let in
    assert len(inbox.drain(0)[0]) == 1


def test_waiting_for_messages_ends_with_the_first():
    inbox = SensorInbox()
    timer = threading.Timer(0.05, inbox.put, (message("/a"),))
    timer.start()
    start = time.monotonic()
    assert len(inbox.drain(PATIENCE_S)[0]) == 1
    assert time.monotonic() - start < PATIENCE_S / 2
    timer.join()
    assert inbox.drain(0.01)[0] == []


def test_the_clock_gives_the_time_of_day():
    clock_ns = track_node.steady_clock()
    first = clock_ns()
    assert abs(first - time.time_ns()) < 1e9
    assert clock_ns() >= first


def test_while_it_tracks_it_holds_a_token(tmp_path):
    with tracking(tmp_path, "car7") as (world, _):
        found = [str(reply.ok.key_expr) for reply in world.session.liveliness().get(alive_key("*", "car7"))]
        assert len(found) == 1
        assert found[0].startswith("car7/pcgan/tracker/")


def test_poses_are_those_the_scans_were_tracked_in(tmp_path, sensor):
    with tracking(tmp_path) as (world, _):
        world.send(sensor.mounts())
        sensor.scans(world, 0, 600)
        pose = codec.decode(VehiclePose, world.poses.get(timeout=PATIENCE_S).payload.to_bytes())
        frame = codec.decode(TrackFrame, world.received(1)[0])
        assert pose.stamp_ns == frame.stamp_ns
        assert pose.position_m[0] == pytest.approx(frame.vehicle_history.states[-1, 0])
