"""Playing: when messages are due, what keys do, which topics go where, and what late subscribers get."""

import math
import time
from collections import defaultdict, deque
from itertools import pairwise

import pytest
import zenoh.ext
from mcap.writer import Writer

from pcgan import bus
from replay.bus_channels import BusChannel, known_channels
from replay.errors import LogError
from replay.keyboard import Key
from replay.log_reader import LogReader
from replay.logged_message import NO_SCHEMA, LoggedSchema, RawMessage
from replay.player import LogPublisher, Player, Schedule, play_log, played_topics, static_before
from replay.topic_choice import TopicChoice

S = 1_000_000_000
START_NS = 1_700_000_000 * S
ALL = TopicChoice()
TF = LoggedSchema("tf2_msgs/msg/TFMessage", "ros2msg", b"geometry_msgs/TransformStamped[] transforms")
LATCHED = "- history: 3\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline: ..."


class Clock:
    """A clock that only moves when somebody waits, and the keys that are pressed meanwhile."""

    def __init__(self, keys=()):
        self.now_s = 1000.0
        self.keys = deque(keys)  # (at this time, this key), in order
        self.waits_s = []

    def __call__(self):
        return self.now_s

    def press(self, timeout_s):
        self.waits_s.append(timeout_s)
        if self.keys and self.keys[0][0] <= self.now_s + timeout_s:
            at_s, key = self.keys.popleft()
            self.now_s = max(self.now_s, at_s)
            return key
        if math.isinf(timeout_s):
            raise AssertionError("waits for ever")
        self.now_s += timeout_s
        return None


def message(at_s, topic="/a", data=b"xy"):
    return RawMessage(topic, START_NS + round(at_s * S), NO_SCHEMA, "", data)


def played_at(times_s, keys=(), rate=1.0, paused=False, publishing_s=0.0, delay_s=0.0):
    """Plays messages of the given log times on a clock of its own; returns when each was published, and the tally."""
    clock = Clock((1000.0 + at_s, key) for at_s, key in keys)
    schedule, at = Schedule(rate, paused=paused, clock=clock), []

    def publish(_):
        at.append(round(clock.now_s - 1000.0, 6))
        clock.now_s += publishing_s

    player = Player(schedule, clock, publish)
    schedule.restart(START_NS, delay_s)
    player.play(map(message, times_s))
    assert not clock.keys
    return at, player.tally


# --- the schedule ----------------------------------------------------------------------------------------------------


def test_log_time_runs_at_the_rate():
    clock = Clock()
    schedule = Schedule(2.0, clock=clock)
    schedule.restart(START_NS)
    assert schedule.wait_s(START_NS + 3 * S) == pytest.approx(1.5)
    clock.now_s += 1.0
    assert schedule.position_ns == START_NS + 2 * S
    assert schedule.wait_s(START_NS + 3 * S) == pytest.approx(0.5)
    assert schedule.wait_s(START_NS + 1 * S) == pytest.approx(-0.5)


def test_a_pause_stops_log_time_where_it_is():
    clock = Clock()
    schedule = Schedule(clock=clock)
    schedule.restart(START_NS)
    clock.now_s += 1.0
    schedule.pause_or_resume()
    clock.now_s += 60.0
    assert schedule.position_ns == START_NS + S
    assert schedule.wait_s(START_NS) == math.inf
    schedule.pause_or_resume()
    assert schedule.wait_s(START_NS + 2 * S) == pytest.approx(1.0)


def test_another_rate_goes_on_from_where_it_is():
    clock = Clock()
    schedule = Schedule(1.0, clock=clock)
    schedule.restart(START_NS)
    clock.now_s += 4.0
    schedule.set_rate(0.5)
    assert schedule.position_ns == START_NS + 4 * S
    assert schedule.wait_s(START_NS + 5 * S) == pytest.approx(2.0)


def test_times_stay_exact_hours_into_a_log():
    clock = Clock()
    schedule = Schedule(clock=clock)
    schedule.restart(START_NS)
    clock.now_s += 36_000.0
    assert schedule.wait_s(START_NS + 36_000 * S + 1000) == pytest.approx(1e-6, abs=1e-9)


# --- the player ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate", "expected"), [(1.0, [0.0, 0.25, 2.0]), (4.0, [0.0, 0.0625, 0.5])])
def test_messages_go_out_when_they_are_due(rate, expected):
    at, tally = played_at([0.0, 0.25, 2.0], rate=rate)
    assert at == expected
    assert (tally.messages, tally.payload_bytes, tally.topics) == (3, 6, {"/a"})
    assert tally.most_late_s == pytest.approx(0.0, abs=1e-6)


def test_who_is_late_publishes_at_once_and_says_how_late():
    at, tally = played_at([0.0, 0.1, 0.2, 3.0], publishing_s=0.5)
    assert at == [0.0, 0.5, 1.0, 3.0]
    assert tally.most_late_s == pytest.approx(0.8)


def test_the_first_message_waits_for_the_delay():
    assert played_at([0.0, 1.0], delay_s=5.0, rate=2.0)[0] == [5.0, 5.5]


def test_space_pauses_and_goes_on():
    at, tally = played_at([0.0, 1.0, 2.0], keys=[(0.5, Key.PAUSE), (10.5, Key.PAUSE)])
    assert at == [0.0, 11.0, 12.0]
    assert tally.most_late_s == pytest.approx(0.0, abs=1e-6)  # a pause is not lateness


def test_the_right_arrow_steps_while_paused_and_only_then():
    keys = [(0.5, Key.STEP), (1.5, Key.PAUSE), (5.0, Key.STEP), (6.0, Key.STEP), (8.0, Key.PAUSE)]
    at, _ = played_at([0.0, 1.0, 2.0, 3.0, 4.0], keys=keys)
    assert at == [0.0, 1.0, 5.0, 6.0, 9.0]  # the log goes on from the last step


def test_it_can_begin_paused():
    assert played_at([0.0, 1.0], keys=[(3.0, Key.STEP), (7.0, Key.PAUSE)], paused=True)[0] == [3.0, 8.0]


def test_up_and_down_change_the_rate_by_a_tenth():
    assert played_at([0.0, 1.0, 2.1], keys=[(1.0, Key.FASTER)])[0] == [0.0, 1.0, 2.0]
    assert played_at([0.0, 1.0, 2.0], keys=[(1.0, Key.SLOWER)])[0] == [0.0, 1.0, 2.1]


def test_keys_are_heard_however_late_it_is():
    clock = Clock([(1000.35, Key.PAUSE), (1009.0, Key.PAUSE)])
    schedule, at = Schedule(1e6, clock=clock), []

    def publish(_):
        clock.now_s += 0.01
        at.append(clock.now_s)

    schedule.restart(START_NS)
    Player(schedule, clock, publish).play(message(0.01 * i) for i in range(100))
    assert len(at) == 100
    assert max(after - before for before, after in pairwise(at)) > 8


def test_the_position_is_shown_ten_times_a_second():
    clock, ticks = Clock(), []
    schedule = Schedule(clock=clock)
    schedule.restart(START_NS)
    player = Player(schedule, clock, lambda _: None, lambda _: ticks.append(clock.now_s))
    player.play(message(0.001 * i) for i in range(2001))
    assert len(ticks) == pytest.approx(20, abs=2)


# --- what is played --------------------------------------------------------------------------------------------------


@pytest.fixture
def write_log(tmp_path):
    """Writes a recording of rows (topic, seconds, data), with a schema and a channel's metadata by topic."""

    def write(rows, schemas=(), metadata=(), name="log.mcap"):
        schemas, metadata = dict(schemas), dict(metadata)
        channels = {}
        with (tmp_path / name).open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile="", library="pcgan tests")
            for topic, at_s, data in rows:
                if topic not in channels:
                    schema, encoding = schemas.get(topic, (NO_SCHEMA, "json"))
                    number = writer.register_schema(*schema) if schema.name else 0
                    channels[topic] = writer.register_channel(topic, encoding, number, metadata.get(topic, {}))
                at_ns = START_NS + round(at_s * S)
                writer.add_message(channels[topic], at_ns, data, at_ns)
            writer.finish()
        return LogReader([tmp_path / name])

    return write


def rows_of(topic, count, data=b"%d", period_s=0.1):
    return [(topic, i * period_s, data % i) for i in range(count)]


def test_topics_become_keys_with_what_the_file_says(write_log):
    reader = write_log(
        [*rows_of("/tf", 30), ("bare", 0.0, b"1")], {"/tf": (TF, "cdr")}, {"/tf": {"offered_qos_profiles": "x"}}
    )
    tf, bare = sorted(played_topics(reader, ALL, {}, "car7"), key=lambda topic: topic.key, reverse=True)
    assert (tf.key, tf.channel) == ("car7/tf", BusChannel("/tf", TF, "cdr", {"offered_qos_profiles": "x"}))
    assert (bare.key, bare.channel.topic) == ("car7/bare", "bare")


def test_topics_are_chosen_and_renamed(write_log):
    reader = write_log([("/tf", 0, b""), ("/tf_static", 0, b""), ("/image", 0, b"")])
    played = played_topics(reader, TopicChoice.of((), "tf"), {"tf": "/other/tf"})
    assert {(topic.source.topic, topic.key, topic.channel.topic) for topic in played} == {
        ("/tf", "other/tf", "/other/tf"),
        ("/tf_static", "tf_static", "/tf_static"),
    }


@pytest.mark.parametrize(
    ("choice", "remaps", "text"),
    [
        (TopicChoice.of(["/gone"]), {}, r"^the recording has no /gone; its topics are /b, /odd\*, /tf$"),
        (ALL, {"/gone": "/x"}, r"^the recording has no /gone; its topics are"),
        (TopicChoice.of((), "gone"), {}, r"^none of the recording's topics is chosen; they are /b, /odd\*, /tf$"),
        (
            TopicChoice.of(["/tf", "/b"]),
            {"/b": "/tf"},
            r"^/tf and /b would both be tf; rename one of them \(--remap\)$",
        ),
        (ALL, {}, r"^topic '/odd\*' cannot be a zenoh key: .*; leave it out \(--exclude-regex\) or rename it"),
    ],
)
def test_what_cannot_be_played_is_told_with_what_can(write_log, choice, remaps, text):
    reader = write_log([("/tf", 0, b""), ("/b", 0, b""), ("/odd*", 0, b"")])
    with pytest.raises(LogError, match=text):
        played_topics(reader, choice, remaps)
    assert played_topics(reader, TopicChoice.of((), None, "odd"), {})
    assert played_topics(reader, ALL, {"/odd*": "/even"})


def test_which_topics_are_kept_for_late_subscribers(write_log):
    calibration = LoggedSchema("foxglove.CameraCalibration", "protobuf", b"x")
    names = ["/tf", "/ns/tf_static", "/info", "/map", "/map2", "/few"]
    counts = [50, 50, 50, 200, 50, 3]
    reader = write_log(
        [row for name, count in zip(names, counts, strict=True) for row in rows_of(name, count)],
        {"/info": (calibration, "protobuf")},
        {
            "/map": {"offered_qos_profiles": LATCHED},
            "/map2": {"offered_qos_profiles": LATCHED.replace("ity: 1\n  dead", "ity: transient_local\n  dead")},
            "/tf": {"offered_qos_profiles": LATCHED.replace("durability: 1", "durability: 2")},
        },
    )
    cached = {topic.source.topic: topic.cached for topic in played_topics(reader, ALL, {})}
    assert cached == {"/tf": 0, "/ns/tf_static": 50, "/info": 1, "/map": 100, "/map2": 50, "/few": 3}


def test_what_static_topics_said_before_the_start_comes_first(write_log):
    calibration = LoggedSchema("foxglove.CameraCalibration", "protobuf", b"x")
    rows = [("/tf_static", 0.0, b"a"), ("/tf_static", 0.5, b"b"), *rows_of("/info", 300), *rows_of("/odometry", 300)]
    reader = write_log(sorted(rows, key=lambda row: row[1]), {"/info": (calibration, "protobuf")})
    played = played_topics(reader, ALL, {})

    def before(at_s):
        return [(m.topic, m.data) for m in static_before(reader, played, START_NS + round(at_s * S))]

    assert before(0.0) == []
    assert sorted(before(0.5)) == [("/info", b"4"), ("/tf_static", b"a")]
    assert sorted(before(2.05)) == [("/info", b"20"), ("/tf_static", b"a"), ("/tf_static", b"b")]
    assert sorted(before(25.0))[0] == ("/info", b"99")  # the first 10 s of a log are looked through, not all of it


class Played:
    """Takes what a log publishes, on a clock of its own."""

    def __init__(self, reader, choice=ALL, limit=10**9):
        self.clock = Clock()
        self.schedule = Schedule(clock=self.clock)
        self.at = []
        self._reader, self._topics, self._limit = reader, played_topics(reader, choice, {}), limit

    def run(self, **options):
        player = Player(self.schedule, self.clock, self._publish)
        play_log(self._reader, self._topics, player, self.schedule, **options)
        return self.at

    def _publish(self, message):
        if len(self.at) == self._limit:
            raise KeyboardInterrupt
        self.at.append((round(self.clock.now_s - 1000.0, 3), message.topic, message.data))


def test_a_part_of_a_log_with_its_static_topics(write_log):
    reader = write_log(sorted([("/tf_static", 0.0, b"s"), *rows_of("/a", 30)], key=lambda row: row[1]))
    at = Played(reader).run(start_offset_s=1.05, duration_s=0.3)
    assert at == [(0.0, "/tf_static", b"s"), (0.05, "/a", b"11"), (0.15, "/a", b"12"), (0.25, "/a", b"13")]


def test_a_chosen_topic_comes_at_its_time_in_the_log(write_log):
    reader = write_log([("/a", 0.0, b""), ("/b", 2.0, b"")])
    assert Played(reader, TopicChoice.of(["/b"])).run() == [(2.0, "/b", b"")]


def test_a_loop_begins_again_after_the_delay(write_log):
    played = Played(write_log([("/a", 0.0, b"1"), ("/a", 1.0, b"2")]), limit=5)
    with pytest.raises(KeyboardInterrupt):
        played.run(loop=True, delay_s=0.5)
    assert [at_s for at_s, _, _ in played.at] == [0.5, 1.5, 2.0, 3.0, 3.5]


def test_a_loop_over_nothing_ends(write_log):
    played = Played(write_log([("/a", 0.0, b"1"), *(("/a", 2.0, b"2") for _ in range(11))]))
    with pytest.raises(LogError, match="the chosen topics have no message in the part"):
        played.run(loop=True, start_offset_s=1.0, duration_s=0.5)


def test_a_start_behind_the_end_says_how_long_the_recording_is(write_log):
    played = Played(write_log(rows_of("/a", 30)))
    with pytest.raises(LogError, match=r"^nothing is left to play 4 s into the recording, which is 2\.900 s long$"):
        played.run(start_offset_s=4)


# --- on the bus ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Two sessions that meet: one listens, as whoever was started first."""
    endpoint = f"unixsock-stream/{tmp_path_factory.mktemp('bus')}/bus"
    with bus.open_shared_session(listen=[endpoint]) as one, bus.open_shared_session(connect=[endpoint]) as other:
        yield one, other


def gather(got, count, timeout_s=5.0):
    deadline_s = time.monotonic() + timeout_s
    while len(got) < count and time.monotonic() < deadline_s:
        time.sleep(0.01)
    return got


def test_messages_arrive_as_they_are_and_late_subscribers_get_what_is_static(write_log, sessions):
    listener, player = sessions
    rows = [("/tf_static", 0.0, b"\x00static one"), ("/tf_static", 0.0, b"static two"), *rows_of("/tf", 40, period_s=0)]
    reader = write_log(rows, {"/tf_static": (TF, "cdr"), "/tf": (TF, "cdr")})
    played = played_topics(reader, ALL, {}, "car7")
    early, late = defaultdict(list), []

    def take(sample):
        early[str(sample.key_expr)].append((sample.payload.to_bytes(), str(sample.encoding)))

    with LogPublisher(player, played, "car7") as publisher:
        assert not publisher.wait_for_subscriber(0.05)
        with listener.declare_subscriber("car7/**", take):
            assert publisher.wait_for_subscriber(5.0)
            for each in reader.messages():
                publisher.publish(each)
            gather(early["car7/tf"], 40)
        assert known_channels(listener, "car7")["car7/tf"] == BusChannel("/tf", TF, "cdr")
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        with zenoh.ext.declare_advanced_subscriber(
            listener, "car7/tf_static", lambda sample: late.append(sample.payload.to_bytes()), history=history
        ):
            assert gather(late, 2) == [b"\x00static one", b"static two"]
    encoding = "application/cdr;tf2_msgs/msg/TFMessage"
    assert early["car7/tf"] == [(b"%d" % i, encoding) for i in range(40)]
    assert early["car7/tf_static"] == [(data, encoding) for data in late]
