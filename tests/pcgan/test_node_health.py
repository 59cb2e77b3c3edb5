"""The meter of a live node, with a clock of the test's own: what it counts, when it reports, what is worth a line."""

import pytest

from pcgan.node_health import HealthMeter, health_key
from schemas import codec
from schemas.messages import NodeHealth

MS = 1_000_000
SECOND = 1_000_000_000
NOON_NS = 1_700_000_000 * SECOND


class Clock:
    def __init__(self):
        self.now_ns = 5 * SECOND

    def __call__(self):
        return self.now_ns

    def pass_ms(self, ms):
        self.now_ns += round(ms * MS)


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def meter(clock):
    return HealthMeter("predict", "vehicle_10hz", deadline_ms=100, clock_ns=clock, stamp_ns=lambda: NOON_NS)


def frames(meter, clock, *latencies_ms, every_ms=100):
    """Publishes frames one after the other, each so long after it arrived."""
    for latency_ms in latencies_ms:
        clock.pass_ms(every_ms)
        meter.published(clock() - round(latency_ms * MS))


def test_a_report_is_due_once_a_second(meter, clock):
    assert meter.wait_s == 1
    clock.pass_ms(999)
    assert meter.report() is None
    assert meter.wait_s == pytest.approx(0.001)
    clock.pass_ms(11)
    assert meter.wait_s == 0
    assert meter.report().uptime_s == pytest.approx(1.010)
    assert meter.wait_s == pytest.approx(0.990)  # a late report does not put off the next
    assert meter.report() is None


def test_after_a_stall_the_missed_reports_are_not_made_up_for(meter, clock):
    clock.pass_ms(5500)
    assert meter.report() is not None
    assert meter.wait_s == 1
    assert meter.report() is None


def test_rate_and_latencies_are_those_since_the_last_report(meter, clock):
    frames(meter, clock, *[10] * 9, 60)
    health = meter.report()
    assert (health.rate_hz, health.frames) == (10, 10)
    assert health.latency_p50_ms == pytest.approx(10)
    assert health.latency_p99_ms == pytest.approx(10 + 0.91 * 50)  # between the ninth and the tenth of ten
    frames(meter, clock, 20, 20, every_ms=500)
    health = meter.report()
    assert (health.rate_hz, health.frames) == (2, 12)
    assert health.latency_p50_ms == health.latency_p99_ms == pytest.approx(20)


def test_a_rate_is_over_the_time_that_has_really_passed(meter, clock):
    frames(meter, clock, *[10] * 20)  # 2 s without asking for a report
    assert meter.report().rate_hz == 10


def test_an_idle_node_reports_zeros(meter, clock):
    clock.pass_ms(1000)
    assert meter.report() == NodeHealth(NOON_NS, "predict", "vehicle_10hz", 1.0, 0.0, 0.0, 0.0, 0, 0, 0, 0, "")


def test_frames_after_their_deadline_are_late(meter, clock):
    frames(meter, clock, 99.9, 100, 100.1, 250)
    assert meter.late == 2


def test_counts_go_on_from_report_to_report(meter, clock):
    for _ in range(2):
        meter.dropped += 3
        meter.refuse("not a pcgan.v1.TrackFrame")
        frames(meter, clock, 150, every_ms=1000)
        health = meter.report()
    assert (health.frames, health.dropped, health.late, health.refused) == (2, 6, 2, 2)


def test_a_problem_is_told_for_ten_seconds(meter, clock):
    meter.refuse("first")
    meter.trouble("no transform joins 'base_link' and 'lidar'")
    told = []
    for _ in range(12):
        clock.pass_ms(1000)
        told.append(meter.report().problem)
    assert told == ["no transform joins 'base_link' and 'lidar'"] * 9 + [""] * 3
    assert meter.refused == 1


def test_in_a_flood_one_line_a_second_of_a_kind_is_worth_saying(meter, clock):
    worth = []
    for k in range(2500):
        worth.append(meter.refuse(f"refused {k}", kind="flood"))
        clock.pass_ms(1)
        if k == 30:
            assert meter.refuse("something else", kind="rare")
    assert [k for k, line in enumerate(worth) if line] == [0, 1000, 2000]
    assert meter.refused == 2501


def test_the_same_words_are_worth_a_line_a_minute(meter, clock):
    worth = []
    for _ in range(130):
        worth.append(meter.refuse("schema foo.Bar is no clusters"))
        clock.pass_ms(1000)
    assert [second for second, line in enumerate(worth) if line] == [0, 60, 120]
    assert meter.refuse("something else")


@pytest.mark.parametrize(
    ("namespace", "key"), [("", "pcgan/health/track"), ("/fleet/car7/", "fleet/car7/pcgan/health/track")]
)
def test_the_key_is_under_the_namespace(namespace, key):
    assert health_key("track", namespace) == key


def test_a_report_can_be_sent(meter, clock):
    frames(meter, clock, *[10] * 10)
    health = meter.report()
    assert codec.decode(NodeHealth, codec.encode(health)) == health


def test_the_clock_only_has_to_go_forward():
    """By default that is the monotonic clock; the stamp is the time of day."""
    meter = HealthMeter("track")
    assert meter.wait_s <= 1
    meter.published(meter.clock_ns() - 3 * MS)
    assert meter.frames == 1
    assert meter.late == 0


def test_what_comes_in_is_counted_per_second(meter, clock):
    meter.took(30)
    clock.pass_ms(2000)
    meter.took(10)
    assert meter.report().input_hz == 20
    clock.pass_ms(1000)
    assert meter.report().input_hz == 0


def test_a_problem_that_is_over_is_no_longer_reported(meter, clock):
    meter.trouble("no vehicle pose on /odom")
    clock.pass_ms(1000)
    assert meter.report().problem == "no vehicle pose on /odom"
    meter.well()
    clock.pass_ms(1000)
    assert meter.report().problem == ""
