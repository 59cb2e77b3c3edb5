"""One replay as a job that any process can do alone: what `pcgan check`, `pcgan batch` and the pytest plugin run."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from replay.frame_result import FrameResult
from replay.record import Summary, record, refuse_overwriting
from replay.rerun_view import View
from replay.session import PredictorChoice, Replay, ReplaySettings


@dataclass(frozen=True)
class ReplayJob:
    """What to replay, how, and where the output goes; can be sent to another process."""

    logs: tuple[Path, ...]
    output: Path
    settings: ReplaySettings = field(default_factory=ReplaySettings)
    model: str | Path | None = None  # name of a shipped model, or a file; None: the default
    salvage: bool = False
    emit: tuple[str, ...] = ("pcgan",)


def run_job(
    job: ReplayJob, view: View | None = None, on_frame: Callable[[FrameResult], None] = lambda _: None
) -> Summary:
    """Replays a log into its output, with the predictor in this process, and returns the summary.

    Raises LogError, OutputError or PredictorError; and whatever interrupted it, `Interrupted` of a signal among them:
    a job is done whole or not at all.
    """
    refuse_overwriting(job.logs, job.output)
    run = Replay(job.logs, job.settings, PredictorChoice("inline", job.model), salvage=job.salvage)
    unfinished = job.output.with_name(job.output.name + ".unfinished")  # so that an older output stays until then
    summary = record(run, unfinished, view, emit=job.emit, on_frame=on_frame)
    if summary.stopped is not None:
        unfinished.unlink()
        raise summary.stopped
    unfinished.replace(job.output)
    return summary
