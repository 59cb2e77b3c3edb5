"""The predictor as a process: a thin zenoh shell around `Predictor.step`, which knows no sockets.

Track frames come in on one key, predictions go out on another, each with the attachment of its question, so that two
replays on one bus do not mix. A frame carries all the history it needs: a predictor may be restarted at will.

How a frame was put says what it is worth. One put with `CongestionControl.BLOCK` is a replay's: all of them are
answered, in order. One put with `CongestionControl.DROP`, zenoh's default, is live: of those that wait only the newest
of its run (its attachment) is answered, since the others are the past, and what was passed over is counted. An answer
goes out as its question came in. A query on `pcgan/predict` is answered like a replay's frame. Where both wait, they
take turns.
"""

import logging
import queue
import signal
import sys
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple, Protocol

import zenoh
from threadpoolctl import threadpool_limits

from pcgan.bus import ENCODING, MAX_PAYLOAD_BYTES, ModelIdentity, alive_key
from pcgan.node_health import DEFAULT_DEADLINE_MS, HealthMeter, health_key
from schemas import codec, topics
from schemas.messages import NodeHealth, PredictionFrame, TrackFrame
from schemas.topics import Topic

log = logging.getLogger(__name__)

MAX_WAITING_BYTES = 256 * 2**20  # of frames that all have to be answered, and queries: what comes then is refused
MAX_LIVE_RUNS = 16  # live runs that may have a frame waiting at a time
_MESSAGE_BYTES = 512  # what one takes beside its payload and attachment
_MATCH_TIMEOUT_S = 5.0
_ANSWERS = ENCODING.with_schema(codec.schema_name(PredictionFrame))


def what_if_key(namespace: str = "") -> str:
    """Returns the key that answers queries: a TrackFrame, with a supposed vehicle path or without, as the payload."""
    return topics.zenoh_key(Topic("/pcgan/predict", "what if", "TrackFrame"), namespace)


class Steps(Protocol):
    """What `serve` needs of a predictor."""

    def step(self, frame: TrackFrame) -> PredictionFrame:
        """Predicts one frame."""
        ...


OnAnswer = Callable[[TrackFrame, PredictionFrame], None]  # told of every frame's answer, not of queries


class Refused(Exception):
    """A payload that is no usable track frame."""


class Waiting(NamedTuple):
    """A frame or a query that waits for its turn."""

    arrived_ns: int
    message: zenoh.Sample | zenoh.Query


class Inbox:
    """Carries frames and queries from zenoh's callback threads to the main loop.

    Nothing else happens in a callback, and it never waits: a callback that blocks for longer than a link's lease (10 s)
    makes zenoh close the link and lose what is on it in silence. So what waits is bounded by being refused.
    """

    def __init__(self, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock_ns = clock_ns
        self._lock = threading.Lock()
        self._tokens: queue.SimpleQueue[None] = queue.SimpleQueue()  # one for each that waits, and one for the end
        self._in_order: deque[Waiting] = deque()
        self._live: OrderedDict[bytes, Waiting] = OrderedDict()  # run -> its newest frame
        self._bytes = 0
        self._live_is_next = True
        self._closed = False
        self._overtaken = 0
        self._turned_away = 0

    def put(self, sample: zenoh.Sample) -> None:
        """Queues a sample; a live one takes the place of its predecessor if that still waits."""
        waiting = Waiting(self._clock_ns(), sample)
        if sample.congestion_control != zenoh.CongestionControl.DROP or _size(waiting) > MAX_PAYLOAD_BYTES:
            self._queue(waiting)  # what is too large is refused in its turn, and bounded until then
            return
        run = _attached(sample)
        with self._lock:
            if run not in self._live and len(self._live) < MAX_LIVE_RUNS:
                self._live[run] = waiting
                self._tokens.put(None)
                return
            if run not in self._live:
                self._live.popitem(last=False)
            self._live[run] = waiting
            self._overtaken += 1

    def ask(self, query: zenoh.Query) -> None:
        """Queues a query."""
        if not self._queue(Waiting(self._clock_ns(), query)):
            query.drop()  # type: ignore[no-untyped-call]  # without a reply whoever asked knows at once

    def close(self) -> None:
        """Lets the loop end after what is already queued; takes no lock, so that a signal's handler may call it."""
        self._closed = True
        self._tokens.put(None)

    @property
    def ended(self) -> bool:
        """Closed, and empty."""
        return self._closed and not len(self)

    def __len__(self) -> int:
        return len(self._in_order) + len(self._live)

    def take(self, timeout_s: float) -> Waiting | None:
        """Waits for what is to be answered next; None if nothing came in time, or it is closed and empty."""
        if self.ended:
            return None
        with suppress(queue.Empty):
            self._tokens.get(timeout=timeout_s)
        with self._lock:
            if self._live and (self._live_is_next or not self._in_order):
                self._live_is_next = False
                return self._live.popitem(last=False)[1]
            self._live_is_next = True
            if not self._in_order:
                return None
            waiting = self._in_order.popleft()
            self._bytes -= _size(waiting)
            return waiting

    def passed_over(self) -> tuple[int, int]:
        """Returns how many live frames were overtaken, and how many messages turned away, since the last call."""
        with self._lock:
            counts = self._overtaken, self._turned_away
            self._overtaken = self._turned_away = 0
        return counts

    def _queue(self, waiting: Waiting) -> bool:
        """Queues what has to be answered in order, unless too much waits already."""
        with self._lock:
            if self._bytes and self._bytes + _size(waiting) > MAX_WAITING_BYTES:
                self._turned_away += 1
                return False
            self._bytes += _size(waiting)
            self._in_order.append(waiting)
        self._tokens.put(None)
        return True


def serve(
    session: zenoh.Session,
    predictor: Steps,
    model: ModelIdentity,
    inbox: Inbox,
    *,
    namespace: str = "",
    deadline_ms: float = DEFAULT_DEADLINE_MS,
    on_ready: Callable[[], None] | None = None,
    on_answer: OnAnswer | None = None,
    on_health: Callable[[NodeHealth], None] | None = None,
) -> int:
    """Answers track frames and queries until the inbox is closed, and says once a second how it is doing.

    Malformed and oversize payloads are refused, logged and counted; the count is returned. Frames answered more than
    `deadline_ms` after they arrived are answered all the same, and counted as late.
    """
    meter = HealthMeter("predict", model.name, deadline_ms=deadline_ms)
    answers = _Answers(session, namespace)
    health_publisher = session.declare_publisher(
        health_key("predict", namespace), encoding=ENCODING.with_schema(codec.schema_name(NodeHealth))
    )
    # in the network's own thread: otherwise there is another queue, of zenoh's, before the inbox
    put = zenoh.handlers.Callback(inbox.put, indirect=False)
    ask = zenoh.handlers.Callback(inbox.ask, indirect=False)
    with (
        session.declare_queryable(answers.what_if_key, ask),
        session.declare_subscriber(topics.zenoh_key(topics.TRACKS, namespace), put),  # last: who sees it may ask, too
    ):
        token = session.liveliness().declare_token(alive_key(model, str(session.zid()), namespace))
        if on_ready is not None:
            on_ready()
        while not inbox.ended:
            waiting = inbox.take(meter.wait_s)
            if waiting is not None:
                meter.took(1)
                _answer(waiting, predictor, answers, meter, on_answer)
            _count(inbox, meter)
            health = meter.report()
            if health is not None:
                health_publisher.put(codec.encode(health))
                if on_health is not None:
                    on_health(health)
        token.undeclare()  # type: ignore[no-untyped-call]
    answers.close()
    health_publisher.undeclare()  # type: ignore[no-untyped-call]
    return meter.refused


def run(
    session: zenoh.Session,
    predictor: Steps,
    model: ModelIdentity,
    *,
    namespace: str = "",
    deadline_ms: float = DEFAULT_DEADLINE_MS,
    end_with_stdin: bool,
    on_answer: OnAnswer | None = None,
    on_health: Callable[[NodeHealth], None] | None = None,
) -> int:
    """Serves until SIGINT, SIGTERM or, for a spawned predictor, until whoever spawned it closes its stdin."""
    inbox = Inbox()
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, lambda *_: inbox.close())
    if end_with_stdin:
        threading.Thread(target=_close_with_stdin, args=(inbox,), daemon=True).start()
    with threadpool_limits(1):  # sums in BLAS depend on how many threads share them
        return serve(
            session,
            predictor,
            model,
            inbox,
            namespace=namespace,
            deadline_ms=deadline_ms,
            on_answer=on_answer,
            on_health=on_health,
        )


class _Answers:
    """Where answers go: to all who listen, as their question came, or to whoever queried."""

    def __init__(self, session: zenoh.Session, namespace: str):
        key = topics.zenoh_key(topics.PREDICTIONS, namespace)
        block, drop = zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
        self._blocking = session.declare_publisher(key, encoding=_ANSWERS, congestion_control=block)
        self._live = session.declare_publisher(key, encoding=_ANSWERS, congestion_control=drop)
        self._served: bytes | None = None  # whose frame was answered in order last
        self.what_if_key = what_if_key(namespace)

    def send(self, message: zenoh.Sample | zenoh.Query, payload: bytes) -> None:
        """Answers a frame or a query."""
        if isinstance(message, zenoh.Query):
            with suppress(zenoh.ZError):  # whoever asked has given up
                message.reply(self.what_if_key, payload, encoding=_ANSWERS)
        elif message.congestion_control == zenoh.CongestionControl.DROP:
            self._live.put(payload, attachment=message.attachment)
        else:
            if _attached(message) != self._served:  # somebody new asks: what is put before zenoh knows of him is lost
                _wait_for_match(self._blocking)
                self._served = _attached(message)
            self._blocking.put(payload, attachment=message.attachment)

    def close(self) -> None:
        """Withdraws the publishers."""
        self._blocking.undeclare()  # type: ignore[no-untyped-call]
        self._live.undeclare()  # type: ignore[no-untyped-call]


def _answer(
    waiting: Waiting, predictor: Steps, answers: _Answers, meter: HealthMeter, on_answer: OnAnswer | None
) -> None:
    """Answers what waits; refuses what makes no sense, with one line to whoever queried."""
    message = waiting.message
    try:
        frame = _frame_of(message)
        answer = predictor.step(frame)
        answers.send(message, codec.encode(answer))
        meter.published(waiting.arrived_ns)
        if on_answer is not None and isinstance(message, zenoh.Sample):
            on_answer(frame, answer)
    except Refused as error:
        problem = str(error)
        if meter.refuse(problem, kind="refused"):
            log.warning("refused a message on %s: %s", message.key_expr, problem)
    except Exception as error:  # a stranger's frame must not end the service for everybody else
        problem = f"cannot be predicted: {error}"
        if meter.refuse(problem, kind="failed"):
            log.exception("could not answer a frame on %s", message.key_expr)
    else:
        problem = ""
    if isinstance(message, zenoh.Query):
        with suppress(zenoh.ZError):  # likewise
            if problem:
                message.reply_err(" ".join(problem.split()).encode())
            message.drop()  # type: ignore[no-untyped-call]  # until then whoever asked waits for more


def _count(inbox: Inbox, meter: HealthMeter) -> None:
    """Takes over what the inbox has left out."""
    overtaken, turned_away = inbox.passed_over()
    meter.dropped += overtaken
    for _ in range(turned_away):
        problem = f"more than {MAX_WAITING_BYTES // 2**20} MiB of frames wait to be answered"
        if meter.refuse(problem, kind="full"):
            log.warning("refused a message: %s", problem)


def _close_with_stdin(inbox: Inbox) -> None:
    while sys.stdin.buffer.read(4096):
        pass
    inbox.close()


def _attached(sample: zenoh.Sample) -> bytes:
    return sample.attachment.to_bytes() if sample.attachment is not None else b""


def _size(waiting: Waiting) -> int:
    parts = waiting.message.payload, waiting.message.attachment
    return _MESSAGE_BYTES + sum(len(part) for part in parts if part is not None)


def _frame_of(message: zenoh.Sample | zenoh.Query) -> TrackFrame:
    if message.payload is None:
        raise Refused("a query's payload must be a pcgan.v1.TrackFrame, and this one has none")
    payload = message.payload.to_bytes()
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise Refused(f"{len(payload)} bytes are more than a track frame can have ({MAX_PAYLOAD_BYTES})")
    try:
        return codec.decode(TrackFrame, payload)
    except codec.CodecError as error:
        raise Refused(str(error)) from error


def _wait_for_match(publisher: zenoh.Publisher) -> None:
    deadline = time.monotonic() + _MATCH_TIMEOUT_S
    # zenoh's stubs take the status for a bool; as an object it is always true
    while not publisher.matching_status.matching and time.monotonic() < deadline:  # type: ignore[attr-defined]
        time.sleep(0.002)
