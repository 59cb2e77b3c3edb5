"""The predictor as a process: a thin zenoh shell around `Predictor.step`, which knows no sockets.

Track frames come in on one key, predictions go out on another, each with the attachment of its question, so that two
replays on one bus do not mix. A frame carries all the history it needs: a predictor may be restarted at will.
"""

import logging
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Protocol

import zenoh
from threadpoolctl import threadpool_limits

from pcgan.bus import ENCODING, MAX_PAYLOAD_BYTES, ModelIdentity, alive_key
from schemas import codec, topics
from schemas.messages import PredictionFrame, TrackFrame

log = logging.getLogger(__name__)

_MATCH_TIMEOUT_S = 5.0


class Steps(Protocol):
    """What `serve` needs of a predictor."""

    def step(self, frame: TrackFrame) -> PredictionFrame:
        """Predicts one frame."""
        ...


class Refused(Exception):
    """A payload that is no usable track frame."""


class Inbox:
    """Carries samples from zenoh's callback thread to the main loop; None ends the loop.

    Nothing else happens in the callback: a blocking put inside one would stop zenoh itself.
    """

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[zenoh.Sample | None] = queue.SimpleQueue()

    def put(self, sample: zenoh.Sample) -> None:
        """Queues one sample."""
        self._queue.put(sample)

    def close(self) -> None:
        """Lets the loop end after what is already queued."""
        self._queue.put(None)

    def get(self) -> zenoh.Sample | None:
        """Waits for the next sample."""
        return self._queue.get()


def serve(
    session: zenoh.Session,
    predictor: Steps,
    model: ModelIdentity,
    inbox: Inbox,
    *,
    namespace: str = "",
    on_ready: Callable[[], None] | None = None,
) -> int:
    """Answers every TrackFrame with the PredictionFrame of its sequence until the inbox is closed.

    Malformed and oversize payloads are refused, logged and counted; the count is returned.
    """
    refused = 0
    served: bytes | None = None  # whose frame was answered last
    publisher = session.declare_publisher(
        topics.zenoh_key(topics.PREDICTIONS, namespace),
        encoding=ENCODING.with_schema(codec.schema_name(PredictionFrame)),
        congestion_control=zenoh.CongestionControl.BLOCK,
    )
    with session.declare_subscriber(topics.zenoh_key(topics.TRACKS, namespace), inbox.put):
        token = session.liveliness().declare_token(alive_key(model, str(session.zid()), namespace))
        if on_ready is not None:
            on_ready()
        while (sample := inbox.get()) is not None:
            try:
                frame = _frame_of(sample)
            except Refused as error:
                refused += 1
                log.warning("refused a message on %s: %s", sample.key_expr, error)
                continue
            try:
                answer = codec.encode(predictor.step(frame))
            except Exception:  # a stranger's frame must not end the service for everybody else
                refused += 1
                log.exception("could not answer frame %d on %s", frame.sequence, sample.key_expr)
                continue
            run = sample.attachment.to_bytes() if sample.attachment is not None else b""
            if run != served:  # somebody new asks: what is put before zenoh knows of him is lost
                _wait_for_match(publisher)
                served = run
            publisher.put(answer, attachment=sample.attachment)
        token.undeclare()  # type: ignore[no-untyped-call]
    publisher.undeclare()  # type: ignore[no-untyped-call]
    return refused


def run(
    session: zenoh.Session, predictor: Steps, model: ModelIdentity, *, namespace: str = "", end_with_stdin: bool
) -> int:
    """Serves until SIGINT, SIGTERM or, for a spawned predictor, until whoever spawned it closes its stdin."""
    inbox = Inbox()
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, lambda *_: inbox.close())
    if end_with_stdin:
        threading.Thread(target=_close_with_stdin, args=(inbox,), daemon=True).start()
    with threadpool_limits(1):  # sums in BLAS depend on how many threads share them
        return serve(session, predictor, model, inbox, namespace=namespace)


def _close_with_stdin(inbox: Inbox) -> None:
    while sys.stdin.buffer.read(4096):
        pass
    inbox.close()


def _frame_of(sample: zenoh.Sample) -> TrackFrame:
    payload = sample.payload.to_bytes()
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
