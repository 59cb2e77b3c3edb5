"""A predictor that answers wrongly: twice, late, out of order, to others, with garbage, or not at all.

What is merely untidy changes no byte of an output; what is wrong ends the replay with one line that says so, and an
output that is valid up to there. Predictors here speak to the bus themselves, as `serve` would never do.
"""

import json
import queue
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import zenoh

from pcgan import bus
from pcgan.predictor import Predictor
from replay import PredictorChoice, PredictorError, Replay, record
from replay.remote_predictor import MAX_WAITING_ANSWERS, RemotePredictor
from schemas import codec, topics
from schemas.messages import PredictionFrame, TrackFrame

MODEL = bus.ModelIdentity("double", "00")
PATIENCE_S = 20


class Wild:
    """A predictor on the bus that puts whatever `react` says: (payload, attachment) of any number of answers."""

    def __init__(self, session, react, model=MODEL):
        self.asked = []
        self._waiting = queue.SimpleQueue()
        self._closed = False
        self._react = react
        self._publisher = session.declare_publisher(
            topics.zenoh_key(topics.PREDICTIONS), congestion_control=zenoh.CongestionControl.BLOCK
        )
        self._subscriber = session.declare_subscriber(topics.zenoh_key(topics.TRACKS), self._waiting.put)
        self._token = session.liveliness().declare_token(bus.alive_key(model, str(session.zid())))
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        while (sample := self._waiting.get()) is not None:
            frame = codec.decode(TrackFrame, sample.payload.to_bytes())
            self.asked.append(frame.sequence)
            for payload, attachment in self._react(frame, sample.attachment.to_bytes()):
                while not (self._publisher.matching_status.matching or self._closed):
                    time.sleep(0.002)
                self._publisher.put(payload, attachment=attachment)

    def close(self):
        self._closed = True
        self._waiting.put(None)
        self._thread.join(PATIENCE_S)


@pytest.fixture
def wild(tmp_path):
    """Starts a wild predictor on a session of its own; returns it with the endpoint that leads to it."""
    endpoint, started = f"unixsock-stream/{tmp_path}/wild", []

    def start(react, model=MODEL):
        started.append(Wild(session, react, model))
        return started[-1], endpoint

    with bus.open_session(listen=[endpoint]) as session:
        yield start
        for each in started:
            each.close()


@pytest.fixture
def frame(make):
    return lambda sequence: TrackFrame(
        sequence, make.stamp(sequence), "odom", tracks=(make.track(0, 1), make.track(0, 2))
    )


@pytest.fixture
def right(make):
    """What a predictor should say of a frame."""

    def answer(frame, **changes):
        predictions = tuple(make.prediction(track.id, [[1.0, 2.0]]) for track in frame.tracks)
        return replace(
            PredictionFrame(frame.sequence, frame.stamp_ns, frame.frame_id, MODEL.name, 0.1, predictions), **changes
        )

    return answer


@contextmanager
def asking(endpoint, **options):
    with RemotePredictor.external(endpoint, **{"startup_s": 10.0, "hang_s": 10.0, **options}) as predictor:
        yield predictor


def ask(predictor, frames, make):
    for each in frames:
        predictor.ask(each, make.pose(0))


# --- untidy: nothing changes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("untidy", ["twice", "out of order", "late", "all of it"])
def test_an_untidy_predictor_gives_the_same_bytes(wild, model, short_drive, recorded, tmp_path, untidy):
    """Twice: a second answer, and other figures in it. Out of order: newest first. Late: after it was asked again."""
    predictor, rng, held = Predictor.from_checkpoint(model), np.random.default_rng(1), []

    def react(frame, run):
        answer = predictor.step(frame)
        answers = [(codec.encode(answer), run)]
        if untidy in ("twice", "all of it"):
            answers += [(codec.encode(replace(answer, dt_s=9.0)), run)] * 2
        if untidy in ("out of order", "all of it"):
            held.append(answers)
            if len(held) < 3 and frame.sequence < len(recorded.frames) - 2:  # the last ones are not held back
                return
            answers = [each for several in reversed(held) for each in several]
            held.clear()
        if untidy in ("late", "all of it") and rng.random() < 0.1:
            time.sleep(0.4)
        yield from answers

    fake, endpoint = wild(react, bus.ModelIdentity(predictor.model_name, predictor.checksum))
    replaying = Replay([short_drive], None, PredictorChoice("external", connect=endpoint), window=5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            RemotePredictor.__init__, "__kwdefaults__", {**RemotePredictor.__init__.__kwdefaults__, "hang_s": 0.2}
        )
        summary = record(replaying, tmp_path / "out.mcap")
    assert summary.stopped is None
    assert (tmp_path / "out.mcap").read_bytes() == recorded.path.read_bytes()
    if untidy == "late":
        assert len(fake.asked) > len(recorded.frames)  # it was given up, and asked again


def test_answers_that_are_nobodys_are_ignored(wild, frame, right, make):
    """To what was never asked, to what has been answered, of another run, of none."""

    def react(asked, run):
        lie = right(asked, dt_s=9.0)
        yield codec.encode(replace(lie, sequence=10**6)), run
        yield codec.encode(lie), b"somebody"
        yield codec.encode(lie), None
        yield codec.encode(right(asked)), run
        yield codec.encode(replace(lie, stamp_ns=1)), run  # the frame has its answer

    _, endpoint = wild(react)
    with asking(endpoint) as predictor:
        for sequence in range(5):
            ask(predictor, [frame(sequence)], make)
            answer = predictor.answer()
            assert (answer.sequence, answer.dt_s) == (sequence, 0.1)
        assert predictor.restarts == 0


def test_a_flood_of_answers_fills_no_memory_and_loses_none(wild, frame, right, make):
    """What the flood leaves no room for is asked again."""
    flooded = []

    def react(asked, run):
        if not flooded:
            flooded.append(asked)
            useless = codec.encode(right(asked, sequence=10**6))
            yield from [(useless, run)] * (2 * MAX_WAITING_ANSWERS)
        yield codec.encode(right(asked)), run

    fake, endpoint = wild(react)
    with asking(endpoint, hang_s=1.0) as predictor:
        ask(predictor, [frame(0)], make)
        deadline = time.monotonic() + PATIENCE_S
        while predictor._inbox.qsize() < MAX_WAITING_ANSWERS and time.monotonic() < deadline:
            time.sleep(0.01)  # nobody takes what comes
        time.sleep(0.3)
        assert predictor._inbox.qsize() == MAX_WAITING_ANSWERS
        assert predictor.answer().sequence == 0
    assert fake.asked == [0, 0]


# --- wrong: one line, and an output that is valid up to there ---------------------------------------------------------


def other(predictions, **changes):
    return (replace(predictions[0], **changes), *predictions[1:])


LIES = {
    "garbage": (b"\xff\xfe garbage", r"^the predictor's answer makes no sense: .*PredictionFrame"),
    "nothing": (b"", r"^the predictor's answer makes no sense: PredictionFrame"),
    "stamp": (
        lambda a: replace(a, stamp_ns=a.stamp_ns + 1),
        r"^the predictor's answer to frame 3 is to another question",
    ),
    "frame": (
        lambda a: replace(a, frame_id="map"),
        r"is to another question: 'map' at \d+ ns, asked was 'odom' at \d+ ns$",
    ),
    "none": (lambda a: replace(a, predictions=()), r"is to another question: tracks none, asked were 1, 2$"),
    "fewer": (lambda a: replace(a, predictions=a.predictions[:1]), r"tracks 1, asked were 1, 2$"),
    "more": (
        lambda a: replace(a, predictions=a.predictions * 2),
        r"makes no sense: PredictionFrame has two predictions of one track$",
    ),
    "order": (lambda a: replace(a, predictions=a.predictions[::-1]), r"tracks 2, 1, asked were 1, 2$"),
    "track": (lambda a: replace(a, predictions=other(a.predictions, track_id=7)), r"tracks 7, 2, asked were 1, 2$"),
    "NaN": (
        lambda a: replace(a, predictions=other(a.predictions, corridor_probability=float("nan"))),
        r"^the predictor's answer makes no sense: ",
    ),
    "model": (
        lambda a: replace(a, model="impostor"),
        r"^the predictor's answer to frame 3 is of the weights impostor, and it said that it runs double$",
    ),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lie_is_an_error_that_names_it(wild, frame, right, make, lie):
    change, text = LIES[lie]

    def react(asked, run):
        answer = right(asked)
        if asked.sequence == 3:
            answer = change if isinstance(change, bytes) else change(answer)
        yield answer if isinstance(answer, bytes) else codec.encode(answer), run

    _, endpoint = wild(react)
    with asking(endpoint) as predictor:
        ask(predictor, map(frame, range(4)), make)
        assert [predictor.answer().sequence for _ in range(3)] == [0, 1, 2]
        with pytest.raises(PredictorError, match=text):
            predictor.answer()


def test_a_lie_in_mid_run_leaves_an_output_valid_up_to_there(
    wild, model, short_drive, recorded, tmp_path, mcap_content
):
    predictor = Predictor.from_checkpoint(model)

    def react(frame, run):
        answer = predictor.step(frame)
        if frame.sequence == 12:
            answer = replace(answer, predictions=answer.predictions[1:])
        yield codec.encode(answer), run

    _, endpoint = wild(react, bus.ModelIdentity(predictor.model_name, predictor.checksum))
    choice = PredictorChoice("external", connect=endpoint)
    summary = record(Replay([short_drive], None, choice, window=1), tmp_path / "out.mcap")
    assert isinstance(summary.stopped, PredictorError)
    content = mcap_content(tmp_path / "out.mcap")
    assert content.messages == mcap_content(recorded.path).messages[: 4 * 12]
    assert json.loads(content.metadata["pcgan"]["complete"]) is False
