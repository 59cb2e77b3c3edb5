"""The predictor's zenoh shell, with a predictor that is a plain object: answers, attachments, refusals, its end."""

import queue
import threading
from contextlib import contextmanager

import pytest
import zenoh

from pcgan import bus
from pcgan.predictor_process import Inbox, serve
from schemas import codec, topics
from schemas.messages import PredictionFrame, TrackFrame

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


class Client:
    """Somebody on the bus who publishes track frames and collects predictions."""

    def __init__(self, session, namespace):
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
        self.put(codec.encode(TrackFrame(sequence, STAMP_NS + sequence, "odom")), attachment)

    def answer(self):
        return self._answers.get(timeout=PATIENCE_S)

    def matched(self):
        for _ in range(PATIENCE_S * 100):
            if self._publisher.matching_status.matching:
                return
            threading.Event().wait(0.01)
        pytest.fail("the predictor never subscribed")

    def silent(self):
        return self._answers.empty()


@contextmanager
def serving(folder, predictor, namespace=""):
    """Yields a client and, once left, the number of refused payloads in the list it also yields."""
    endpoint, inbox, counts = f"unixsock-stream/{folder}/bus", Inbox(), []
    with bus.open_session(listen=[endpoint]) as session, bus.open_session(connect=[endpoint]) as other:
        thread = threading.Thread(
            target=lambda: counts.append(serve(session, predictor, MODEL, inbox, namespace=namespace))
        )
        thread.start()
        try:
            client = Client(other, namespace)
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
        assert [
            codec.decode(PredictionFrame, client.answer().payload.to_bytes()).sequence for _ in range(2, 30)
        ] == list(range(2, 30))
    assert predictor.seen == list(range(1, 30))
    assert counts == [0]
