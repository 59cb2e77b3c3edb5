"""The predictor's zenoh shell, with a predictor that is a plain object: answers, overload, health, queries, its end."""

import queue
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
import zenoh

from pcgan import bus, node_health, predictor_process
from pcgan.node_health import health_key
from pcgan.predictor_process import MAX_LIVE_RUNS, Inbox, serve, what_if_key
from schemas import codec, topics
from schemas.messages import NodeHealth, PredictionFrame, TrackFrame, VehiclePath

MODEL = bus.ModelIdentity("double", "00")
STAMP_NS = 1_700_000_000_000_000_000
PATIENCE_S = 20


class Double:
    """Answers a frame with its own sequence and as many predictions as there were tracks: none."""

    def __init__(self):
        self.seen = []

    def step(self, frame):
        self.seen.append(frame.sequence)
        return PredictionFrame(frame.sequence, frame.stamp_ns, frame.frame_id, "double", 0.1)


class Gated(Double):
    """A slow predictor: it takes one frame for each permission."""

    def __init__(self):
        super().__init__()
        self.busy = threading.Semaphore(0)
        self.permission = threading.Semaphore(0)

    def step(self, frame):
        self.busy.release()
        assert self.permission.acquire(timeout=PATIENCE_S)
        return super().step(frame)


class Client:
    """Somebody on the bus who publishes track frames and collects predictions."""

    def __init__(self, session, namespace="", inbox=None):
        self._session = session
        self._inbox = inbox  # of whom it asks
        self._namespace = namespace
        self._answers = queue.SimpleQueue()
        self._subscriber = session.declare_subscriber(
            topics.zenoh_key(topics.PREDICTIONS, namespace), self._answers.put
        )
        self._publisher = session.declare_publisher(
            topics.zenoh_key(topics.TRACKS, namespace), congestion_control=zenoh.CongestionControl.BLOCK
        )

    def put(self, payload, attachment=b"run one"):
        self._publisher.put(payload, attachment=attachment)

    def ask(self, sequence, attachment=b"run one"):
        self.put(frame_bytes(sequence), attachment)

    def ask_live(self, sequence, attachment=b"live"):
        """Asks on the same key as a live tracker does."""
        key = topics.zenoh_key(topics.TRACKS, self._namespace)
        self._session.put(
            key, frame_bytes(sequence), attachment=attachment, congestion_control=zenoh.CongestionControl.DROP
        )

    def until_waiting(self, count):
        """Returns once so many wait for their turn."""
        until(lambda: len(self._inbox) >= count)

    def what_if(self, payload, timeout=PATIENCE_S):
        return list(self._session.get(what_if_key(self._namespace), payload=payload, timeout=timeout))

    def health(self):
        """Returns the node's next report."""
        with self._session.declare_subscriber(health_key("predict", self._namespace)) as subscriber:
            return codec.decode(NodeHealth, subscriber.recv().payload.to_bytes())

    def answer(self):
        return self._answers.get(timeout=PATIENCE_S)

    def answered(self, count):
        """Returns the sequences of so many answers, in their order."""
        samples = [self.answer() for _ in range(count)]
        return [codec.decode(PredictionFrame, sample.payload.to_bytes()).sequence for sample in samples]

    def is_matched(self):
        return self._publisher.matching_status.matching

    def matched(self):
        until(self.is_matched)

    def silent(self):
        return self._answers.empty()


@pytest.fixture
def quick_reports(monkeypatch):
    """Nodes report ten times a second."""
    monkeypatch.setattr(node_health, "REPORT_EVERY_NS", 100_000_000)


def until(condition):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def frame_bytes(sequence, **fields):
    return codec.encode(TrackFrame(sequence, STAMP_NS + sequence, "odom", **fields))


@contextmanager
def serving(folder, predictor, namespace="", **options):
    """Yields a client and, once left, the number of refused payloads in the list it also yields."""
    endpoint, inbox, counts = f"unixsock-stream/{folder}/bus", Inbox(), []
    with bus.open_session(listen=[endpoint]) as session, bus.open_session(connect=[endpoint]) as other:
        thread = threading.Thread(
            target=lambda: counts.append(serve(session, predictor, MODEL, inbox, namespace=namespace, **options))
        )
        thread.start()
        try:
            client = Client(other, namespace, inbox)
            client.matched()
            yield client, counts
        finally:
            inbox.close()
            thread.join(PATIENCE_S)
            assert not thread.is_alive()


def test_every_frame_is_answered_with_its_sequence_stamp_and_attachment(tmp_path):
    with serving(tmp_path, Double()) as (client, counts):
        for sequence in range(5):
            client.ask(sequence, b"run %d" % sequence)
        for sequence in range(5):
            sample = client.answer()
            frame = codec.decode(PredictionFrame, sample.payload.to_bytes())
            assert (frame.sequence, frame.stamp_ns) == (sequence, STAMP_NS + sequence)
            assert sample.attachment.to_bytes() == b"run %d" % sequence
    assert counts == [0]


def test_the_answer_says_what_it_is(tmp_path):
    with serving(tmp_path, Double()) as (client, _):
        client.ask(1)
        assert str(client.answer().encoding) == "application/protobuf;pcgan.v1.PredictionFrame"


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\xff\xff\xff", "not a pcgan.v1.TrackFrame"),
        (b"", "TrackFrame has no stamp"),
        (b"hello, predictor", "TrackFrame"),
        (bytes(bus.MAX_PAYLOAD_BYTES + 1), "16777217 bytes are more than a track frame can have"),
    ],
    ids=["no protobuf", "empty", "text", "oversize"],
)
def test_what_is_no_frame_is_refused_logged_and_counted(tmp_path, caplog, payload, reason):
    predictor = Double()
    with serving(tmp_path, predictor) as (client, counts):
        client.put(payload)
        client.ask(3)  # the next one is answered
        assert codec.decode(PredictionFrame, client.answer().payload.to_bytes()).sequence == 3
        assert client.silent()
    assert counts == [1]
    assert predictor.seen == [3]
    (record,) = [record for record in caplog.records if record.name == "pcgan.predictor_process"]
    assert "refused a message on pcgan/tracks" in record.getMessage()
    assert reason in record.getMessage()


def test_a_frame_without_an_attachment_is_answered_without_one(tmp_path):
    with serving(tmp_path, Double()) as (client, _):
        client.ask(1, None)
        assert client.answer().attachment is None


def test_a_namespace_keeps_two_predictors_apart(tmp_path):
    (tmp_path / "a").mkdir()
    predictor = Double()
    with serving(tmp_path / "a", predictor, "car7") as (client, _):
        client.ask(1)
        assert str(client.answer().key_expr) == "car7/pcgan/predictions"
    assert predictor.seen == [1]


def test_while_it_serves_it_holds_a_token(tmp_path):
    endpoint, inbox, news = f"unixsock-stream/{tmp_path}/bus", Inbox(), queue.SimpleQueue()
    with bus.open_session(listen=[endpoint]) as session, bus.open_session(connect=[endpoint]) as other:
        watch = other.liveliness().declare_subscriber(
            bus.any_alive_key(), lambda sample: news.put((sample.kind, str(sample.key_expr))), history=True
        )
        ready = threading.Event()
        thread = threading.Thread(target=serve, args=(session, Double(), MODEL, inbox), kwargs={"on_ready": ready.set})
        thread.start()
        kind, key = news.get(timeout=PATIENCE_S)
        assert ready.wait(PATIENCE_S)
        assert kind == zenoh.SampleKind.PUT
        assert bus.model_of(key) == MODEL
        inbox.close()
        assert news.get(timeout=PATIENCE_S) == (zenoh.SampleKind.DELETE, key)
        thread.join(PATIENCE_S)
        watch.undeclare()


def test_what_is_queued_is_answered_before_the_end(tmp_path):
    predictor = Double()
    with serving(tmp_path, predictor) as (client, counts):
        client.ask(1)
        client.answer()
        for sequence in range(2, 30):
            client.ask(sequence)
        assert client.answered(28) == list(range(2, 30))
    assert predictor.seen == list(range(1, 30))
    assert counts == [0]


# --- overload -------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("quick_reports")
def test_of_live_frames_that_wait_only_the_newest_is_answered(tmp_path):
    predictor = Gated()
    with serving(tmp_path, predictor) as (client, _):
        client.ask_live(0)
        assert predictor.busy.acquire(timeout=PATIENCE_S)
        for sequence in range(1, 20):
            client.ask_live(sequence)
        client.ask(1000)  # comes by the same way: once it has arrived, all have
        client.until_waiting(2)
        predictor.permission.release(3)
        assert client.answered(3) == [0, 1000, 19]
        predictor.permission.release()
        client.ask_live(20)  # what is not overtaken is answered
        assert client.answered(1) == [20]
        health = client.health()
        assert (health.dropped, health.frames, health.refused) == (18, 4, 0)
    assert predictor.seen == [0, 1000, 19, 20]


def test_frames_of_a_replay_are_all_answered_in_order_while_live_ones_are_passed_over(tmp_path):
    predictor = Gated()
    with serving(tmp_path, predictor) as (client, counts):
        client.ask(0)
        assert predictor.busy.acquire(timeout=PATIENCE_S)
        for sequence in range(1, 30):
            client.ask(sequence)
            client.ask_live(1000 + sequence)
        client.ask(30)
        client.until_waiting(31)
        predictor.permission.release(32)
        answered = client.answered(32)
    assert [sequence for sequence in answered if sequence < 1000] == list(range(31))
    assert [sequence for sequence in answered if sequence >= 1000] == [1029]
    assert answered.index(1029) == 1  # live and replay take turns
    assert counts == [0]


def test_an_answer_goes_out_as_its_question_came_in(tmp_path):
    with serving(tmp_path, Double()) as (client, _):
        client.ask(1)
        assert client.answer().congestion_control == zenoh.CongestionControl.BLOCK
        client.ask_live(2)
        assert client.answer().congestion_control == zenoh.CongestionControl.DROP


def test_live_frames_of_another_run_are_not_overtaken(tmp_path):
    """Vehicles whose scans come at the same moment do not take each other's turn."""
    predictor = Gated()
    with serving(tmp_path, predictor) as (client, _):
        client.ask(0)
        assert predictor.busy.acquire(timeout=PATIENCE_S)
        for vehicle in (1, 2, 3):
            for sequence in (10, 20):
                client.ask_live(vehicle + sequence, b"vehicle %d" % vehicle)
        client.ask(99)
        client.until_waiting(4)
        predictor.permission.release(5)
        assert sorted(client.answered(5)) == [0, 21, 22, 23, 99]


class Put:
    """As much of a zenoh sample as the inbox looks at."""

    key_expr = "pcgan/tracks"

    def __init__(self, payload=b"frame", attachment=None, congestion_control=zenoh.CongestionControl.DROP):
        self.payload = payload
        self.attachment = None if attachment is None else zenoh.ZBytes(attachment)
        self.congestion_control = congestion_control


def taken(inbox):
    found = []
    while (waiting := inbox.take(0)) is not None:
        found.append(waiting.message)
    return found


def test_the_inbox_keeps_few_live_frames_however_many_runs_there_are():
    """Somebody who attaches another id to every frame does not fill the memory."""
    inbox = Inbox()
    puts = [Put(attachment=b"%d" % k) for k in range(1000)]
    for put in puts:
        inbox.put(put)
    assert taken(inbox) == puts[-MAX_LIVE_RUNS:]
    assert inbox.passed_over() == (1000 - MAX_LIVE_RUNS, 0)
    assert inbox.passed_over() == (0, 0)


def test_a_burst_of_frames_that_must_be_answered_does_not_fill_the_memory(monkeypatch):
    room = 3 * (30 + predictor_process._MESSAGE_BYTES)
    monkeypatch.setattr(predictor_process, "MAX_WAITING_BYTES", room)
    inbox = Inbox()
    puts = [Put(bytes(30), congestion_control=zenoh.CongestionControl.BLOCK) for _ in range(5)]
    for put in puts:
        inbox.put(put)
    assert taken(inbox) == puts[:3]
    assert inbox.passed_over() == (0, 2)
    inbox.put(puts[4])  # there is room again
    large = Put(bytes(room), congestion_control=zenoh.CongestionControl.BLOCK)
    inbox.put(large)
    assert taken(inbox) == [puts[4]]
    inbox.put(large)  # one alone is let in: whoever sent it is told why it is refused
    assert taken(inbox) == [large]


@pytest.mark.parametrize(("payload", "attachment"), [(b"", b""), (b"", bytes(2**20)), (bytes(2**20), b"")])
@pytest.mark.parametrize("congestion_control", [zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP])
def test_nothing_that_strangers_send_fills_the_memory(monkeypatch, payload, attachment, congestion_control):
    """Neither a flood of empty messages nor what hides in attachments, whatever it says it is."""
    monkeypatch.setattr(predictor_process, "MAX_WAITING_BYTES", 3 * 2**20)
    monkeypatch.setattr(predictor_process, "MAX_PAYLOAD_BYTES", 2**19)
    inbox = Inbox()
    for i in range(10_000):
        inbox.put(Put(payload, attachment + b"%d" % i, congestion_control=congestion_control))
    waiting = taken(inbox)
    assert sum(512 + len(put.payload) + len(put.attachment.to_bytes()) for put in waiting) <= 3 * 2**20
    assert sum(inbox.passed_over()) == 10_000 - len(waiting)


def test_what_is_turned_away_is_refused_and_told(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(predictor_process, "MAX_WAITING_BYTES", 3 * (len(frame_bytes(1)) + 600))
    predictor = Gated()
    with serving(tmp_path, predictor) as (client, counts):
        client.ask(0)
        assert predictor.busy.acquire(timeout=PATIENCE_S)
        for sequence in range(1, 10):
            client.ask(sequence)
        client.ask_live(99)
        client.until_waiting(4)
        assert client.what_if(frame_bytes(50)) == []  # at once, and not after a timeout
        predictor.permission.release(5)
        assert sorted(client.answered(5)) == [0, 1, 2, 3, 99]
    assert counts == [7]
    assert "frames wait to be answered" in caplog.text


def test_an_inbox_that_is_closed_ends_when_it_is_empty():
    inbox = Inbox()
    inbox.put(Put())
    inbox.close()
    assert not inbox.ended
    assert inbox.take(PATIENCE_S) is not None
    assert inbox.ended
    start = time.monotonic()
    assert inbox.take(PATIENCE_S) is None
    assert time.monotonic() - start < 1


@pytest.mark.usefixtures("quick_reports")
def test_frames_that_took_too_long_are_answered_and_counted_as_late(tmp_path):
    class Slow(Double):
        def step(self, frame):
            time.sleep(0.03 if frame.sequence % 2 else 0)
            return super().step(frame)

    with serving(tmp_path, Slow(), deadline_ms=25) as (client, _):
        for sequence in range(4):
            client.ask_live(sequence)
            assert client.answered(1) == [sequence]
        health = client.health()
        assert (health.frames, health.dropped) == (4, 0)
        assert health.late >= 2
        assert health.latency_p99_ms == 0 or health.latency_p99_ms > 25


def test_a_predictor_that_dies_and_comes_again_goes_on_answering(tmp_path):
    """Live, nobody waits for answers: what was asked meanwhile is lost, the next frame is answered."""
    endpoint, answers = f"unixsock-stream/{tmp_path}/bus", queue.SimpleQueue()
    with bus.open_session(listen=[endpoint]) as session:
        client = Client(session)
        for life in (1, 2):
            with bus.open_session(connect=[endpoint]) as own:
                inbox = Inbox()
                thread = threading.Thread(target=serve, args=(own, Double(), MODEL, inbox))
                thread.start()
                client.matched()
                client.ask_live(life)
                answers.put(client.answered(1))
                own.close()  # without a word, as after SIGKILL
                inbox.close()
                thread.join(PATIENCE_S)
            until(lambda: not client.is_matched())
            client.ask_live(100)
    assert [answers.get_nowait() for _ in range(2)] == [[1], [2]]


# --- health -----------------------------------------------------------------------------------------------------------


def test_whoever_listens_hears_within_a_second_or_two_how_it_is_doing(tmp_path):
    seen = []
    with serving(tmp_path, Double(), "car7", on_health=seen.append) as (client, _):
        client.put(b"nonsense")
        client.ask(1)
        client.answer()
        start = time.monotonic()
        health = client.health()  # a subscriber that comes late
        assert time.monotonic() - start < 2
        assert (health.node, health.model) == ("predict", "double")
        assert (health.frames, health.refused, health.dropped) == (1, 1, 0)
        assert "not a pcgan.v1.TrackFrame" in health.problem
        assert abs(health.stamp_ns - time.time_ns()) < 5e9
        assert client.health().uptime_s > health.uptime_s  # it goes on without frames
    assert health in seen


# --- what if ----------------------------------------------------------------------------------------------------------


def path():
    return VehiclePath(np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [5, 0, 0]]), 3.0, 1.0, 1.8)


class Follows(Double):
    """Returns the path it was asked about."""

    def step(self, frame):
        super().step(frame)
        return PredictionFrame(frame.sequence, frame.stamp_ns, "odom", "double", 0.1, (), frame.vehicle_path)


def test_a_query_is_answered_under_its_supposed_path(tmp_path):
    with serving(tmp_path, Follows(), "car7") as (client, _):
        [reply] = client.what_if(frame_bytes(7, vehicle_path=path()))
        frame = codec.decode(PredictionFrame, reply.ok.payload.to_bytes())
        assert frame.sequence == 7
        np.testing.assert_array_equal(frame.vehicle_path.poses, path().poses)
        assert str(reply.ok.encoding) == "application/protobuf;pcgan.v1.PredictionFrame"
        assert str(reply.ok.key_expr) == "car7/pcgan/predict"
        assert client.silent()  # who only listens to predictions hears nothing of what was supposed


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (None, "a query's payload must be a pcgan.v1.TrackFrame, and this one has none"),
        (b"\xff\xff\xff", "not a pcgan.v1.TrackFrame"),
        (bytes(bus.MAX_PAYLOAD_BYTES + 1), "16777217 bytes are more than a track frame can have"),
    ],
    ids=["none", "no protobuf", "oversize"],
)
def test_a_query_that_makes_no_sense_gets_one_line_and_is_counted(tmp_path, payload, reason):
    with serving(tmp_path, Double()) as (client, counts):
        [reply] = client.what_if(payload)
        assert reply.ok is None
        words = reply.err.payload.to_string()
        assert reason in words
        assert "\n" not in words
        [reply] = client.what_if(frame_bytes(1))  # the next one is answered
        assert reply.ok is not None
    assert counts == [1]


def test_a_query_that_the_predictor_cannot_answer_gets_one_line(tmp_path):
    class Fails(Double):
        def step(self, _):
            raise ValueError("tracks [7] hold NaN\nor infinity")

    with serving(tmp_path, Fails()) as (client, counts):
        [reply] = client.what_if(frame_bytes(1))
        assert reply.err.payload.to_string() == "cannot be predicted: tracks [7] hold NaN or infinity"
    assert counts == [1]


def test_whoever_gave_up_waiting_does_not_stop_the_others(tmp_path):
    predictor = Gated()
    with serving(tmp_path, predictor) as (client, counts):
        client.ask(0)
        assert predictor.busy.acquire(timeout=PATIENCE_S)
        [reply] = client.what_if(frame_bytes(1), timeout=0.2)
        assert reply.ok is None  # a timeout
        predictor.permission.release(4)
        client.ask_live(2)
        assert sorted(client.answered(2)) == [0, 2]
        [reply] = client.what_if(frame_bytes(3))
        assert codec.decode(PredictionFrame, reply.ok.payload.to_bytes()).sequence == 3
    assert counts == [0]


def test_queries_wait_in_line_with_a_replay(tmp_path):
    predictor = Gated()
    with serving(tmp_path, predictor) as (client, _):
        client.ask(0)
        assert predictor.busy.acquire(timeout=PATIENCE_S)
        threads = [threading.Thread(target=client.what_if, args=(frame_bytes(10),)) for _ in range(3)]
        for thread in threads:
            thread.start()
        client.until_waiting(3)
        predictor.permission.release(4)
        for thread in threads:
            thread.join(PATIENCE_S)
            assert not thread.is_alive()
    assert predictor.seen == [0, 10, 10, 10]
