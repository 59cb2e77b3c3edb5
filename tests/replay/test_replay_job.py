"""One replay as a job: whole or not at all, in this process or another."""

import multiprocessing
import pickle

import pytest

from replay.errors import LogError, OutputError, PredictorError
from replay.interrupts import Interrupted
from replay.replay_job import ReplayJob, run_job
from replay.session import ReplaySettings
from tracking.tracker import TrackerParams


@pytest.fixture
def job(short_drive, model, tmp_path):
    return ReplayJob((short_drive,), tmp_path / "out.mcap", ReplaySettings(duration_s=0.5), model)


def test_a_job_gives_an_output_and_its_summary(job, mcap_content):
    summary = run_job(job)
    assert summary.complete
    assert summary.frames > 3
    topics = [topic for topic, _, _ in mcap_content(job.output).messages]
    assert topics.count("/pcgan/tracks") == topics.count("/pcgan/predictions") == summary.frames
    assert "/pcgan/scene" not in topics
    assert [path.name for path in job.output.parent.iterdir()] == ["out.mcap"]


@pytest.mark.slow
def test_another_process_gives_the_same_bytes(job, tmp_path):
    run_job(job)
    there = pickle.loads(pickle.dumps(job)).__class__((*job.logs,), tmp_path / "there.mcap", job.settings, job.model)
    process = multiprocessing.get_context("spawn").Process(target=run_job, args=(there,))
    process.start()
    process.join(60)
    assert process.exitcode == 0
    assert there.output.read_bytes() == job.output.read_bytes()


def test_every_frame_is_seen(job):
    seen = []
    summary = run_job(job, on_frame=seen.append)
    assert len(seen) == summary.frames


def test_a_job_that_is_interrupted_leaves_an_older_output_as_it_was(job):
    job.output.write_bytes(b"older")

    def interrupt(_):
        raise Interrupted(2)

    with pytest.raises(Interrupted):
        run_job(job, on_frame=interrupt)
    assert job.output.read_bytes() == b"older"
    assert [path.name for path in job.output.parent.iterdir()] == ["out.mcap"]


def test_what_cannot_be_done_says_why(job, tmp_path):
    with pytest.raises(LogError, match="nowhere"):
        run_job(ReplayJob((tmp_path / "nowhere.mcap",), job.output))
    with pytest.raises(PredictorError, match="nobody"):
        run_job(ReplayJob(job.logs, job.output, job.settings, "nobody"))
    with pytest.raises(OutputError, match="itself"):
        run_job(ReplayJob(job.logs, job.logs[0], job.settings, job.model))


def test_settings_count(job, tmp_path):
    tracker = TrackerParams(**{**job.settings.tracking.tracker.model_dump(), "confirm_existence": 0.999999})
    tracking = job.settings.tracking.model_copy(update={"tracker": tracker})
    other = ReplayJob(
        job.logs, tmp_path / "other.mcap", job.settings.model_copy(update={"tracking": tracking}), job.model
    )
    run_job(job)
    run_job(other)
    assert other.output.read_bytes() != job.output.read_bytes()
