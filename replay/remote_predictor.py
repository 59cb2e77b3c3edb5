"""Predictors the pipeline can ask: one in this process, or one on the bus, spawned or already running.

All three take track frames with `ask` and give their answers in the same order with `answer`. The one on the bus loses
nothing: what a predictor that died left unanswered is sent again, in order, and the first answer to a sequence counts.
"""

import contextlib
import queue
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections import OrderedDict, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Protocol, Self

import zenoh

from pcgan.bus import ENCODING, BusError, ModelIdentity, any_alive_key, model_of, open_session, settle
from replay.errors import PredictorError
from replay.private_folder import PrivateFolder
from schemas import codec, topics
from schemas.messages import PredictionFrame, TrackFrame, VehiclePose

MAX_WAITING_ANSWERS = 4096
_POLL_S = 0.05


class AskedPredictor(Protocol):
    """What the pipeline needs of a predictor."""

    @property
    def model(self) -> ModelIdentity:
        """The weights that answer."""
        ...

    @property
    def restarts(self) -> int:
        """How often a predictor had to be replaced."""
        ...

    def ask(self, frame: TrackFrame, pose: VehiclePose) -> None:
        """Sends a frame, and the vehicle's pose for whoever else listens; does not wait."""
        ...

    def answer(self) -> PredictionFrame:
        """Waits for the answer to the oldest unanswered frame; raises PredictorError if there can be none."""
        ...

    def close(self) -> None:
        """Ends what was started."""
        ...


class InlinePredictor:
    """The predictor in this process, without zenoh."""

    restarts = 0

    def __init__(self, model: str | Path | None = None):
        from pcgan.checkpoint import CheckpointError, find_model  # torch is loaded only here
        from pcgan.predictor import Predictor

        try:
            self._predictor = Predictor.from_checkpoint(find_model(model))
        except CheckpointError as error:
            raise PredictorError(str(error)) from error
        self.model = ModelIdentity(self._predictor.model_name, self._predictor.checksum)
        self._asked: deque[TrackFrame] = deque()

    def ask(self, frame: TrackFrame, pose: VehiclePose) -> None:  # noqa: ARG002  nobody else listens
        """Keeps the frame until its answer is wanted."""
        self._asked.append(frame)

    def answer(self) -> PredictionFrame:
        """Predicts the oldest frame asked."""
        return self._predictor.step(self._asked.popleft())

    def close(self) -> None:
        """Does nothing."""


@dataclass(frozen=True)
class _Question:
    """A frame that was asked, and what its answer must agree with."""

    stamp_ns: int
    frame_id: str
    tracks: tuple[int, ...]
    payload: bytes

    def contradicted_by(self, answer: PredictionFrame) -> str | None:
        """Returns what an answer says that does not go with the question, or None."""
        if (answer.stamp_ns, answer.frame_id) != (self.stamp_ns, self.frame_id):
            return f"{answer.frame_id!r} at {answer.stamp_ns} ns, asked was {self.frame_id!r} at {self.stamp_ns} ns"
        answered = tuple(prediction.track_id for prediction in answer.predictions)
        if answered != self.tracks:
            return f"tracks {_listed(answered)}, asked were {_listed(self.tracks)}"
        return None


class StartError(PredictorError):
    """A spawned predictor does not serve; `hopeless` if it ended by itself, since another one would do the same."""

    def __init__(self, problem: str, *, hopeless: bool):
        super().__init__(problem)
        self.hopeless = hopeless


class Child:
    """A predictor process of our own, in its own process session so that Ctrl-C does not reach it."""

    def __init__(self, endpoint: str, folder: Path, model: str | Path | None, log: IO[bytes]):
        command = [sys.executable, "-m", "replay.cli", "predict", "--spawned", str(folder), "--connect", endpoint]
        if model is not None:
            command += ["--model", str(model)]
        self._log = log
        self._log_start = log.tell()
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=log, stderr=log, start_new_session=True, close_fds=True
        )
        self.pid = self._process.pid

    def died(self) -> str | None:
        """Returns how the process ended, with its last words; None while it lives."""
        code = self._process.poll()
        if code is None:
            return None
        self._log.seek(self._log_start)
        words = self._log.read().decode(errors="replace").strip().splitlines()
        how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        return f"{how}{': ' + words[-1] if words else ''}"

    @property
    def killed(self) -> bool:
        """True if a signal has ended it: another one may do better."""
        return (self._process.poll() or 0) < 0

    def kill(self) -> None:
        """Ends it at once; what it was doing is lost."""
        self._process.kill()
        self.stop()

    def stop(self, patience_s: float = 5.0) -> None:
        """Closes its stdin, which ends it; kills it if it takes too long."""
        with contextlib.suppress(OSError):
            if self._process.stdin is not None:
                self._process.stdin.close()
        try:
            self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class RemotePredictor:
    """A predictor on the bus. `RemotePredictor.spawned` starts one; `RemotePredictor.external` uses a running one.

    Raises PredictorError if none is ready within `startup_s`, if one has been replaced `max_failures` times in a row
    without an answer, or if an answer makes no sense.
    """

    def __init__(
        self,
        session: zenoh.Session,
        *,
        namespace: str = "",
        startup_s: float = 60.0,
        hang_s: float = 30.0,
        max_failures: int = 3,
    ):
        self._session = session
        self._startup_s = startup_s
        self._hang_s = hang_s
        self._max_failures = max_failures
        self._run = secrets.token_bytes(8)  # tells our answers from another replay's; never in an output
        self._child: Child | None = None
        self._child_arguments: tuple[str, str | Path | None] | None = None
        self._folder: PrivateFolder | None = None
        self._log: IO[bytes] | None = None
        self._unanswered: OrderedDict[int, _Question] = OrderedDict()
        self._answers: dict[int, PredictionFrame] = {}
        self._alive: dict[str, ModelIdentity] = {}
        self._model: ModelIdentity | None = None
        self._left = False
        self._failures = 0
        self.restarts = 0
        self._inbox: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self._news: queue.SimpleQueue[tuple[zenoh.SampleKind, str]] = queue.SimpleQueue()
        self._subscriber = session.declare_subscriber(topics.zenoh_key(topics.PREDICTIONS, namespace), self._hear)
        self._watch = session.liveliness().declare_subscriber(
            any_alive_key(namespace), lambda sample: self._news.put((sample.kind, str(sample.key_expr))), history=True
        )
        self._publisher = session.declare_publisher(
            topics.zenoh_key(topics.TRACKS, namespace),
            encoding=ENCODING.with_schema(codec.schema_name(TrackFrame)),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        self._pose_publisher = session.declare_publisher(
            topics.zenoh_key(topics.VEHICLE_POSE, namespace),
            encoding=ENCODING.with_schema(codec.schema_name(VehiclePose)),
        )

    @classmethod
    def spawned(cls, model: str | Path | None = None, **options: float) -> Self:
        """Starts a predictor process of our own on a private socket and waits until it serves."""
        folder = PrivateFolder()
        endpoint = _private_endpoint(folder.path)
        try:
            predictor = cls(_opened(listen=[endpoint]), **options)  # type: ignore[arg-type]
        except BaseException:
            folder.remove()
            raise
        predictor._folder = folder
        predictor._log = (folder.path / "predictor.log").open("w+b")
        predictor._child_arguments = (endpoint, model)
        try:
            predictor._start_child()
            try:
                predictor._wait_until_ready()
            except StartError as error:
                if error.hopeless:  # it has said why it cannot start
                    raise
                predictor._replace(str(error))
        except BaseException:
            predictor.close()
            raise
        return predictor

    @classmethod
    def external(
        cls, connect: str | None = None, config_file: Path | None = None, namespace: str = "", **options: float
    ) -> Self:
        """Uses a predictor that is already running behind an endpoint, e.g. tcp/127.0.0.1:7447."""
        session = _opened(connect=[connect] if connect else [], config_file=config_file)
        predictor = cls(session, namespace=namespace, **options)  # type: ignore[arg-type]
        try:
            predictor._wait_until_ready()
        except BaseException:
            predictor.close()
            raise
        return predictor

    @property
    def model(self) -> ModelIdentity:
        """The weights that answer, as the predictor itself says."""
        assert self._model is not None, "the predictor is ready before anybody can ask"
        return self._model

    @property
    def pid(self) -> int | None:
        """Process id of a spawned predictor."""
        return self._child.pid if self._child else None

    def ask(self, frame: TrackFrame, pose: VehiclePose) -> None:
        """Publishes a frame and the vehicle's pose; the frame stays on record until it is answered."""
        self._pose_publisher.put(codec.encode(pose), attachment=self._run)
        payload = codec.encode(frame)
        tracks = tuple(track.id for track in frame.tracks)
        self._unanswered[frame.sequence] = _Question(frame.stamp_ns, frame.frame_id, tracks, payload)
        self._publisher.put(payload, attachment=self._run)

    def answer(self) -> PredictionFrame:
        """Waits for the answer to the oldest unanswered frame, replacing a predictor that dies or hangs."""
        sequence = next(iter(self._unanswered))
        deadline = time.monotonic() + self._hang_s
        while sequence not in self._answers:
            with contextlib.suppress(queue.Empty):
                sample = self._inbox.get(timeout=_POLL_S)
                self._read_news()  # who answers has said before with which weights
                self._take(sample)
                if sequence in self._answers:
                    break
            reason = self._trouble(time.monotonic() > deadline)
            if reason is not None:
                self._replace(reason)
                deadline = time.monotonic() + self._hang_s
        self._failures = 0
        del self._unanswered[sequence]
        return self._answers.pop(sequence)

    def close(self) -> None:
        """Ends the session and, if it was spawned, the predictor."""
        if self._folder is not None:
            self._folder.give_up()
        if self._child is not None:
            self._child.stop()
        elif self._unanswered:  # a run that was broken off: a plain close would damage a frame on its way to others'
            settle(self._session, timeout_s=2.0)
        self._session.close()  # type: ignore[no-untyped-call]
        if self._log is not None:
            self._log.close()
        if self._folder is not None:
            self._folder.remove()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()

    def _hear(self, sample: zenoh.Sample) -> None:
        """Queues an answer of this run; others' are ignored, and do not pile up while nobody asks.

        Nor does a flood: what there is no room for counts as unanswered, and is asked again.
        """
        ours = sample.attachment is not None and sample.attachment.to_bytes() == self._run
        if ours and self._inbox.qsize() < MAX_WAITING_ANSWERS:
            self._inbox.put(sample)

    def _take(self, sample: zenoh.Sample) -> None:
        """Files an answer; second answers to one sequence, and answers to what nobody asked, are ignored.

        Raises PredictorError if it is none to its question: nothing wrong may get into an output unnoticed.
        """
        try:
            frame = codec.decode(PredictionFrame, sample.payload.to_bytes())
        except codec.CodecError as error:
            raise PredictorError(f"the predictor's answer makes no sense: {error}") from error
        question = self._unanswered.get(frame.sequence)
        if question is None or frame.sequence in self._answers:
            return
        if (problem := question.contradicted_by(frame)) is not None:
            raise PredictorError(f"the predictor's answer to frame {frame.sequence} is to another question: {problem}")
        if self._model is not None and frame.model != self._model.name:
            raise PredictorError(
                f"the predictor's answer to frame {frame.sequence} is of the weights {frame.model}, "
                f"and it said that it runs {self._model.name}"
            )
        self._answers[frame.sequence] = frame

    def _trouble(self, silent: bool) -> str | None:
        """Returns why no answer can be expected, or None."""
        self._read_news()
        if self._child is not None and (ending := self._child.died()) is not None:
            return f"the predictor died ({ending})"
        if self._left or not self._alive:
            self._left = False
            return "the predictor has left the bus"
        return f"the predictor did not answer within {self._hang_s:g} s" if silent else None

    def _replace(self, reason: str) -> None:
        """Waits for another predictor, starting it if it is ours, and sends it all that is unanswered, in order."""
        self._failures += 1
        if self._failures > self._max_failures:
            raise PredictorError(f"{reason}; {self._max_failures} replacements gave no answer either")
        self.restarts += 1
        if self._child is not None:
            self._child.kill()
            self._alive.clear()
            self._start_child()
        try:
            self._wait_until_ready()
        except StartError as error:  # one that dies while it starts is one failure more, not the end
            self._replace(str(error))
            return
        for sequence, question in self._unanswered.items():
            if sequence not in self._answers:
                self._publisher.put(question.payload, attachment=self._run)

    def _start_child(self) -> None:
        assert self._child_arguments is not None
        assert self._log is not None
        assert self._folder is not None
        endpoint, model = self._child_arguments
        self._log.seek(0, 2)
        self._child = Child(endpoint, self._folder.path, model, self._log)

    def _wait_until_ready(self) -> None:
        """Waits for a predictor's token and for zenoh to have matched our publisher: what is put before is lost."""
        deadline = time.monotonic() + self._startup_s
        while True:
            self._read_news()
            if self._alive and _matched(self._publisher):
                break
            if self._child is not None and (ending := self._child.died()) is not None:
                raise StartError(f"the predictor did not start ({ending})", hopeless=not self._child.killed)
            if time.monotonic() > deadline:
                if self._child is not None:
                    raise StartError(f"the predictor was not ready within {self._startup_s:g} s", hopeless=False)
                raise PredictorError(
                    f"no predictor was ready within {self._startup_s:g} s; start one with: pcgan predict"
                )
            time.sleep(0.005)
        self._left = False
        models = set(self._alive.values())
        if len(models) > 1:
            raise PredictorError(f"predictors of different weights are on the bus: {sorted(m.name for m in models)}")
        self._model = models.pop()

    def _read_news(self) -> None:
        for kind, key in _drained(self._news):
            if kind == zenoh.SampleKind.PUT:
                found = model_of(key)
                if self._model is not None and found != self._model:
                    raise PredictorError(f"the new predictor runs {found.name}, the one before ran {self._model.name}")
                self._alive[key] = found
            elif self._alive.pop(key, None) is not None:
                self._left = True  # what it had not answered is lost, even if another has come since


def _listed(ids: Sequence[int]) -> str:
    """Returns some ids in words; many of them would fill a screen."""
    return f"{', '.join(map(str, ids[:8]))}{f' and {len(ids) - 8} more' if len(ids) > 8 else ''}" or "none"


def _drained(news: "queue.SimpleQueue[tuple[zenoh.SampleKind, str]]") -> Iterator[tuple[zenoh.SampleKind, str]]:
    with contextlib.suppress(queue.Empty):
        while True:
            yield news.get_nowait()


def _matched(publisher: zenoh.Publisher) -> bool:
    # zenoh's stubs take the status for a bool; as an object it is always true
    return bool(publisher.matching_status.matching)  # type: ignore[attr-defined]


def _opened(
    listen: list[str] | None = None, connect: list[str] | None = None, config_file: Path | None = None
) -> zenoh.Session:
    try:
        return open_session(listen=listen or (), connect=connect or (), config_file=config_file)
    except BusError as error:
        raise PredictorError(str(error)) from error


def _private_endpoint(folder: Path) -> str:
    """Returns a socket in a folder only we can enter; a loopback port where there are no Unix sockets."""
    path = folder / "bus"
    if hasattr(socket, "AF_UNIX") and len(str(path)) < 100:  # sockaddr_un holds 108 bytes
        return f"unixsock-stream/{path}"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
