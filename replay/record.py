"""The main job: a replay written down, viewed, scored and summed up."""

import concurrent.futures
import json
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Self

from replay.errors import LogError, OutputError, PredictorError
from replay.frame_result import FrameResult
from replay.interrupts import Interrupted, Interrupts
from replay.log_reader import checksum
from replay.log_writer import DEFAULT_FORMATS, LogWriter, outputs
from replay.part_file import part_of, same_file
from replay.rerun_view import NullView, View
from replay.score import ReplayScore
from replay.session import Replay

CHECKSUM_PATIENCE_S = 3.0  # for the recordings' checksums, where a replay ends early


@dataclass
class Summary:
    """What a replay did; `as_json` is what `--json` writes."""

    frames: int = 0
    track_ids: set[tuple[int, int]] = field(default_factory=set)  # (epoch, id)
    predictions: int = 0
    fallbacks: int = 0
    log_s: float = 0.0
    wall_s: float = 0.0
    startup_s: float = 0.0
    restarts: int = 0
    model: dict[str, str] = field(default_factory=dict)
    refused: int = 0
    refusals: list[dict[str, object]] = field(default_factory=list)
    first_refusals: list[str] = field(default_factory=list)
    salvage_losses: list[str] = field(default_factory=list)
    unmatched_labels: list[str] = field(default_factory=list)  # all that were seen, if none means a pedestrian
    latency_ms: dict[str, dict[str, float]] = field(default_factory=dict)
    score: dict[str, object] = field(default_factory=dict)
    complete: bool = False
    stopped: BaseException | None = None  # what ended the replay before the log did

    @property
    def clean(self) -> bool:
        """True if nothing was refused or lost."""
        return not self.refused and not self.salvage_losses

    def as_json(self) -> dict[str, object]:
        """Returns everything under the names that users rely on."""
        return {
            "complete": self.complete,
            "frames": self.frames,
            "tracks": len(self.track_ids),
            "predictions": self.predictions,
            "fallbacks": self.fallbacks,
            "refused": self.refused,
            "refusals": self.refusals,
            "salvage_losses": self.salvage_losses,
            "unmatched_labels": self.unmatched_labels,
            "predictor_restarts": self.restarts,
            "model": self.model,
            "log_s": round(self.log_s, 3),
            "wall_s": round(self.wall_s, 3),
            "startup_s": round(self.startup_s, 3),
            "realtime_factor": round(self.log_s / self.wall_s, 2) if self.wall_s else None,
            "latency_ms": self.latency_ms,
            **self.score,
        }


def record(
    run: Replay,
    output: Path | None = None,
    view: View | None = None,
    *,
    merge: bool = False,
    emit: Sequence[str] = DEFAULT_FORMATS,
    on_frame: Callable[[FrameResult], None] = lambda _: None,
) -> Summary:
    """Replays a log into an MCAP file and a view, and scores it; with `merge` the file holds the recording, too.

    `emit` names the forms in which tracks and predictions are written (`log_writer.FORMATS`).

    Ctrl-C, SIGTERM and a predictor that fails for good end it early: the outputs are then complete up to the last
    frame, and the summary's `stopped` holds the reason. Raises LogError or OutputError for anything else, a recording
    that was changed meanwhile among it; the output then stays as NAME.part.
    """
    if output is not None:
        refuse_overwriting(run.reader.paths, output)
    held = {channel.topic for channel in run.reader.channels} & {each.topic.name for each in outputs(emit)}
    if merge and held:
        raise OutputError(f"the recording already holds {', '.join(sorted(held))}; replay it without --merge")
    summary = Summary(salvage_losses=run.reader.losses.notes)
    score = ReplayScore()
    last_ns = run.start_ns
    started = time.perf_counter()
    with ExitStack() as stack:
        checksums = stack.enter_context(_Checksums(run.reader.paths))
        interrupts = stack.enter_context(Interrupts())
        stack.enter_context(run)
        ready = time.perf_counter()
        writer = (
            stack.enter_context(LogWriter(output, run.reader.paths if merge else (), emit))
            if output is not None
            else None
        )
        shown = stack.enter_context(view or NullView())
        try:
            for result in run:
                with interrupts.shield():
                    if writer is not None:
                        with run.clock.measure("write"):
                            writer.write(result)
                    shown.show(result)
                    with run.clock.measure("score"):
                        score.add(result)
                    _count(summary, result)
                    last_ns = result.log_time_ns
                on_frame(result)
            summary.complete = True
            last_ns = run.end_ns
        except (Interrupted, PredictorError) as error:
            summary.stopped = error
        interrupts.ignore()  # the outputs are being closed; that takes no time worth interrupting
        if writer is not None:
            digests = checksums.result(None if summary.complete else CHECKSUM_PATIENCE_S)
            run.reader.require_unchanged()
            lineage = _lineage(run, digests, complete=summary.complete)
            writer.describe(lineage, _settings(run), complete=summary.complete)
    summary.wall_s = time.perf_counter() - ready
    summary.startup_s = ready - started
    summary.log_s = (last_ns - run.start_ns) / 1e9
    summary.refused, summary.refusals = run.refusals.total, run.refusals.as_json()
    summary.first_refusals = run.refusals.first
    summary.unmatched_labels = run.labels.unmatched
    summary.restarts = run.predictor.restarts
    summary.model = {"name": run.predictor.model.name, "sha256": run.predictor.model.checksum}
    summary.latency_ms = run.clock.as_json()
    summary.score = score.as_json()
    return summary


def refuse_overwriting(recordings: Sequence[Path], *outputs: Path) -> None:
    """Raises OutputError if an output, or the part it is written as, is a recording, or if two of them are one file."""
    written = [path for output in outputs for path in (output, part_of(output))]
    for one in written:
        if any(same_file(one, recording) for recording in recordings):
            raise OutputError(f"{one} is the recording itself, which is never overwritten; choose another output")
        if sum(same_file(one, other) for other in written) > 1:
            raise OutputError(f"{one} would be written twice, the second time over the first; choose another name")


class _Checksums:
    """The recordings' SHA-256, computed while they are replayed; left off with the block."""

    def __init__(self, paths: Sequence[Path]):
        self._paths = paths
        self._abandoned = threading.Event()

    def __enter__(self) -> Self:
        self._pool = concurrent.futures.ThreadPoolExecutor(1)
        self._digests = self._pool.submit(lambda: [checksum(path, self._abandoned) for path in self._paths])
        return self

    def __exit__(self, *_: object) -> None:
        self._abandoned.set()
        self._pool.shutdown()

    def result(self, patience_s: float | None) -> list[str | None]:
        """Waits, for ever or so long; of what is not known by then None.

        Of a huge recording it takes minutes, which nobody has who pressed Ctrl-C.
        """
        concurrent.futures.wait([self._digests], timeout=patience_s)
        self._abandoned.set()
        try:
            return self._digests.result()
        except OSError as error:
            raise LogError(f"{error.filename} cannot be read any more: {error.strerror or error}") from error


def _count(summary: Summary, result: FrameResult) -> None:
    summary.frames += 1
    summary.track_ids.update((result.tracks.epoch, track.id) for track in result.tracks.tracks)
    summary.predictions += len(result.predictions.predictions)
    summary.fallbacks += sum(prediction.fallback for prediction in result.predictions.predictions)


def _lineage(run: Replay, checksums: list[str | None], *, complete: bool) -> dict[str, str]:
    """What the output came from; base names only, so that the folder a log lies in changes nothing."""
    inputs = [{"name": path.name, "sha256": digest} for path, digest in zip(run.reader.paths, checksums, strict=True)]
    return {
        "complete": json.dumps(complete),
        "inputs": json.dumps(inputs),
        "model": run.predictor.model.name,
        "model_sha256": run.predictor.model.checksum,
        "version": version("pcgan"),
    }


def _settings(run: Replay) -> bytes:
    return json.dumps(run.settings.model_dump(mode="json"), indent=2, sort_keys=True).encode()
