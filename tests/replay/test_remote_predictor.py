"""Predictors on the bus: answers in order whatever happens to them, and clear words when there can be none.

The predictors here are small ones of the test's own, served in this process; the real one is in test_record.
"""

import threading
import time

import pytest

from pcgan import bus
from pcgan.predictor_process import Inbox, serve
from replay.errors import PredictorError
from replay.remote_predictor import InlinePredictor, RemotePredictor
from schemas import codec, topics
from schemas.messages import PredictionFrame, TrackFrame

MODEL = bus.ModelIdentity("double", "00")


class Double:
    """Answers with a time step of its own, by which it is known, and remembers what it was asked."""

    def __init__(self, dt_s=0.1):
        self.dt_s, self.seen = dt_s, []

    def step(self, frame):
        self.seen.append(frame.sequence)
        return PredictionFrame(frame.sequence, frame.stamp_ns, frame.frame_id, MODEL.name, self.dt_s)


class Server:
    """A predictor on the bus, in a thread with a session of its own."""

    def __init__(self, endpoint, predictor, model=MODEL):
        self.session = bus.open_session(connect=[endpoint])
        self.inbox = Inbox()
        self.thread = threading.Thread(target=serve, args=(self.session, predictor, model, self.inbox))
        self.thread.start()

    def stop(self):
        self.inbox.close()
        self.thread.join(20)
        if not self.session.is_closed():
            self.session.close()


@pytest.fixture
def endpoint(tmp_path):
    return f"unixsock-stream/{tmp_path}/bus"


@pytest.fixture
def server(endpoint):
    started = []

    def start(predictor=None, model=MODEL):
        started.append(Server(endpoint, predictor or Double(), model))
        return started[-1]

    yield start
    for each in started:
        each.stop()


@pytest.fixture
def asker(endpoint):
    """Makes a RemotePredictor on a bus that listens at the endpoint, as `spawned` does."""
    made = []

    def make(**options):
        made.append(RemotePredictor(bus.open_session(listen=[endpoint]), **{"startup_s": 10, "hang_s": 6, **options}))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def frame(make):
    return lambda sequence: TrackFrame(sequence, make.stamp(sequence), "odom")


def ask(predictor, frames, make):
    for each in frames:
        predictor.ask(each, make.pose(0))


def ready(predictor):
    predictor._wait_until_ready()
    return predictor


def test_answers_come_in_the_order_of_the_questions(asker, server, frame, make):
    predictor, _ = asker(), server()
    ready(predictor)
    ask(predictor, map(frame, range(20)), make)
    assert [predictor.answer().sequence for _ in range(20)] == list(range(20))
    assert predictor.model == MODEL
    assert predictor.restarts == 0


def test_the_pose_goes_out_on_its_own_key(asker, server, frame, make):
    predictor, double = asker(), server()
    with double.session.declare_subscriber(topics.zenoh_key(topics.VEHICLE_POSE)) as poses:
        ready(predictor)
        time.sleep(0.3)
        ask(predictor, [frame(0)], make)
        predictor.answer()
        assert poses.try_recv().payload.to_bytes() == codec.encode(make.pose(0))


def test_answers_to_others_are_ignored(asker, server, frame, make):
    """Another replay's answer to the same sequence comes first; so does one without any run id."""
    predictor, double = asker(), server()
    ready(predictor)
    stranger = PredictionFrame(0, make.stamp(0), "odom", "stranger", 0.1)
    publisher = double.session.declare_publisher(topics.zenoh_key(topics.PREDICTIONS))
    for attachment in (b"somebody", None):
        publisher.put(codec.encode(stranger), attachment=attachment)
    time.sleep(0.3)
    ask(predictor, [frame(0)], make)
    assert predictor.answer().model == "double"
    publisher.undeclare()


def test_of_two_answers_the_first_counts(asker, server, frame, make):
    predictor, one, two = asker(), server(Double(0.1)), server(Double(0.2))
    ready(predictor)
    time.sleep(0.3)
    ask(predictor, map(frame, range(10)), make)
    answers = [predictor.answer() for _ in range(10)]
    assert [answer.sequence for answer in answers] == list(range(10))
    assert {answer.dt_s for answer in answers} <= {0.1, 0.2}
    assert one.thread.is_alive()
    assert two.thread.is_alive()


def test_when_the_predictor_leaves_the_next_one_gets_what_is_unanswered(asker, server, frame, make):
    predictor, first = asker(), server()
    ready(predictor)
    ask(predictor, [frame(0)], make)
    assert predictor.answer().sequence == 0
    first.stop()
    ask(predictor, map(frame, range(1, 6)), make)  # nobody hears these
    server(Double(0.2))
    asked_s = time.monotonic()
    answers = [predictor.answer() for _ in range(5)]
    assert time.monotonic() - asked_s < 4  # known from its token, not from silence
    assert [answer.sequence for answer in answers] == [1, 2, 3, 4, 5]
    assert {answer.dt_s for answer in answers} == {0.2}
    assert predictor.restarts == 1


class Deaf(Double):
    """Loses the first frames it gets: answers to nothing anybody waits for."""

    def __init__(self, lost):
        super().__init__()
        self.lost = lost

    def step(self, frame):
        if self.lost:
            self.lost -= 1
            return PredictionFrame(10**6, frame.stamp_ns, frame.frame_id, "lost", 0.1)
        return super().step(frame)


def test_silence_is_asked_again_in_order(asker, server, frame, make):
    predictor, deaf = asker(hang_s=0.5), Deaf(lost=3)
    server(deaf)
    ready(predictor)
    ask(predictor, map(frame, range(3)), make)
    assert [predictor.answer().sequence for _ in range(3)] == [0, 1, 2]
    assert predictor.restarts == 1
    assert deaf.seen == [0, 1, 2]


def test_silence_for_ever_is_an_error_that_says_so(asker, server, frame, make):
    predictor = asker(hang_s=0.2, max_failures=2)
    server(Deaf(lost=100))
    ready(predictor)
    ask(predictor, [frame(0)], make)
    text = r"^the predictor did not answer within 0\.2 s; 2 replacements gave no answer either$"
    with pytest.raises(PredictorError, match=text):
        predictor.answer()


def test_failures_are_counted_in_a_row(asker, server, frame, make):
    """Each frame needs two attempts; every answer starts the count anew."""

    class EverySecond(Double):
        def step(self, frame):
            self.seen.append(frame.sequence)
            lost = len(self.seen) % 2
            return PredictionFrame(10**6 if lost else frame.sequence, frame.stamp_ns, "odom", MODEL.name, 0.1)

    predictor = asker(hang_s=0.2, max_failures=1)
    server(EverySecond())
    ready(predictor)
    for sequence in range(3):
        ask(predictor, [frame(sequence)], make)
        assert predictor.answer().sequence == sequence
    assert predictor.restarts == 3


def test_no_predictor_at_all_says_how_to_start_one(endpoint):
    with pytest.raises(PredictorError, match=r"^no predictor was ready within 0\.3 s; start one with: pcgan predict$"):
        RemotePredictor.external(endpoint, startup_s=0.3)


def test_a_predictor_with_other_weights_is_no_replacement(asker, server, frame, make):
    predictor, first = asker(), server()
    ready(predictor)
    first.stop()
    server(Double(), bus.ModelIdentity("other", "11"))
    ask(predictor, [frame(0)], make)
    with pytest.raises(PredictorError, match=r"^the new predictor runs other, the one before ran double$"):
        predictor.answer()


def test_an_answer_that_makes_no_sense_is_an_error(asker, server, frame, make):
    class Mad(Double):
        def step(self, frame):
            return PredictionFrame(frame.sequence, frame.stamp_ns, "odom", "mad", -1.0)

    predictor = asker()
    server(Mad())
    ready(predictor)
    ask(predictor, [frame(0)], make)
    with pytest.raises(PredictorError, match=r"^the predictor's answer makes no sense: PredictionFrame dt_s"):
        predictor.answer()


def test_external_finds_a_predictor_that_listens(tmp_path, frame, make):
    endpoint, inbox = f"unixsock-stream/{tmp_path}/server", Inbox()
    with bus.open_session(listen=[endpoint]) as session:
        thread = threading.Thread(target=serve, args=(session, Double(), MODEL, inbox), kwargs={"namespace": "car7"})
        thread.start()
        with RemotePredictor.external(endpoint, namespace="car7", startup_s=10) as predictor:
            assert predictor.pid is None
            ask(predictor, [frame(0)], make)
            assert predictor.answer().sequence == 0
        with pytest.raises(PredictorError, match="no predictor was ready"):
            RemotePredictor.external(endpoint, namespace="car8", startup_s=0.5)
        inbox.close()
        thread.join(20)


def test_an_endpoint_that_cannot_be_is_a_predictor_error():
    with pytest.raises(PredictorError, match="zenoh cannot be opened on nonsense"):
        RemotePredictor.external("nonsense", startup_s=0.3)


def test_inline_answers_in_order(model, frame, make):
    predictor = InlinePredictor(model)
    ask(predictor, map(frame, range(3)), make)
    assert [predictor.answer().sequence for _ in range(3)] == [0, 1, 2]
    assert predictor.model.name == "random"
    predictor.close()


def test_an_inline_predictor_without_weights_names_the_file(tmp_path):
    with pytest.raises(PredictorError, match=r"no checkpoint .*gone\.safetensors"):
        InlinePredictor(tmp_path / "gone.safetensors")
