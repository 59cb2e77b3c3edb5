"""The main job: outputs that repeat byte for byte, survive their predictor, and never touch the recording."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import pytest

from pcgan.checkpoint import sha256
from replay import OutputError, PredictorChoice, PredictorError, Replay, ReplaySettings, record
from replay.log_reader import checksum
from replay.roles import RoleChoices
from replay.simulator.sensor_suite import CLUSTERS_TOPIC
from schemas import codec, topics
from schemas.messages import CameraDetections, LidarClusters, PredictionFrame, TrackFrame


def run(drive, model, mode="inline", settings=None, **options):
    return Replay([drive], settings, PredictorChoice(mode, model), **options)


# --- the output ------------------------------------------------------------------------------------------------------


def test_the_output_holds_what_the_frames_held(recorded, mcap_content):
    messages = mcap_content(recorded.path).messages
    assert Counter(topic for topic, _, _ in messages) == dict.fromkeys(
        (topic.name for topic in topics.OUTPUTS), len(recorded.frames)
    )
    tracks = [data for topic, _, data in messages if topic == topics.TRACKS.name]
    predictions = [data for topic, _, data in messages if topic == topics.PREDICTIONS.name]
    assert tracks == [codec.encode(frame.tracks) for frame in recorded.frames]
    assert predictions == [codec.encode(frame.predictions) for frame in recorded.frames]
    assert codec.decode(TrackFrame, tracks[-1]).tracks
    assert codec.decode(PredictionFrame, predictions[-1]).predictions


def test_lineage_says_what_the_output_came_from(recorded, short_drive, model, mcap_content):
    lineage = mcap_content(recorded.path).metadata["pcgan"]
    assert json.loads(lineage["inputs"]) == [{"name": "short.mcap", "sha256": checksum(short_drive)}]
    assert json.loads(lineage["complete"]) is True
    assert (lineage["model"], lineage["model_sha256"]) == ("random", sha256(model))
    assert lineage["version"]


def test_settings_in_the_output_can_be_used_again(short_drive, model, tmp_path, mcap_content):
    settings = ReplaySettings(start_s=1.0, duration_s=1.5, roles=RoleChoices(clusters=CLUSTERS_TOPIC))
    record(run(short_drive, model, settings=settings), tmp_path / "out.mcap")
    attached = mcap_content(tmp_path / "out.mcap").attachments["settings.json"]
    assert ReplaySettings.model_validate_json(attached) == settings
    record(run(short_drive, model, settings=ReplaySettings.model_validate_json(attached)), tmp_path / "again.mcap")
    assert (tmp_path / "out.mcap").read_bytes() == (tmp_path / "again.mcap").read_bytes()


def test_no_path_of_this_machine_is_in_the_output(recorded, short_drive, mcap_content):
    """Chunks are compressed, so their content is searched, too."""
    content = mcap_content(recorded.path)
    everything = [
        recorded.path.read_bytes(),
        *(data for _, _, data in content.messages),
        *content.attachments.values(),
        repr(content.metadata).encode(),
        *(schema.data for schema in content.summary.schemas.values()),
    ]
    for place in (str(short_drive.parent), str(Path.home()), str(Path.cwd()), str(recorded.path.parent), "/tmp"):
        assert not any(place.encode() in data for data in everything if place != "/"), place


def test_nothing_precedes_its_cause(recorded, short_drive, mcap_content):
    """Each output's log time is that of an input message, and not before the scan and detections it was made of."""
    logged, log_times = {}, set()
    for topic, at_ns, data in mcap_content(short_drive).messages:
        log_times.add(at_ns)
        if topic == CLUSTERS_TOPIC:
            logged[topic, codec.decode(LidarClusters, data).stamp_ns] = at_ns
        elif topic.endswith("/detections"):
            logged[topic.split("/")[2], codec.decode(CameraDetections, data).stamp_ns] = at_ns
    causes = 0
    for frame in recorded.frames:
        assert frame.log_time_ns in log_times
        assert frame.log_time_ns >= logged[CLUSTERS_TOPIC, frame.tracks.stamp_ns]
        for camera in frame.sensors.cameras:
            assert frame.log_time_ns >= logged[camera.name, camera.detections.stamp_ns]
            causes += 1
    assert causes > 100
    times = [at_ns for _, at_ns, _ in mcap_content(recorded.path).messages]
    assert times == sorted(times)


def test_a_merged_output_holds_the_recording_and_keeps_the_order(short_drive, model, recorded, tmp_path, mcap_content):
    before = checksum(short_drive)
    record(run(short_drive, model), tmp_path / "out.mcap", merge=True)
    merged, original = mcap_content(tmp_path / "out.mcap").messages, mcap_content(short_drive).messages
    ours = {topic.name for topic in topics.OUTPUTS}
    assert Counter(m for m in merged if m[0] not in ours) == Counter(original)
    assert [m for m in merged if m[0] in ours] == mcap_content(recorded.path).messages
    scans = {}
    for topic, at_ns, data in merged:
        if topic == CLUSTERS_TOPIC:
            scans[codec.decode(LidarClusters, data).stamp_ns] = at_ns
        elif topic == topics.TRACKS.name:
            assert scans[codec.decode(TrackFrame, data).stamp_ns] <= at_ns  # the scan has been read before
    assert checksum(short_drive) == before


def test_a_replay_of_a_merged_output_gives_the_same_again(short_drive, model, recorded, tmp_path, digest):
    record(run(short_drive, model), tmp_path / "merged.mcap", merge=True)
    with run(tmp_path / "merged.mcap", model) as again:
        assert digest(again) == digest(recorded.frames)
    with pytest.raises(OutputError, match=r"the recording already holds /pcgan/predictions.*replay it without --merge"):
        record(run(tmp_path / "merged.mcap", model), tmp_path / "twice.mcap", merge=True)


def test_somebody_elses_reader_finds_nothing_wrong(recorded):
    rerun = Path(sys.executable).with_name("rerun")
    if not rerun.exists():
        pytest.skip("rerun-sdk is not installed")
    checked = subprocess.run(
        [rerun, "mcap", "check", recorded.path], capture_output=True, text=True, timeout=60, check=False
    )
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_the_summary_counts_what_was_done(recorded):
    summary = recorded.summary.as_json()
    assert summary["complete"] is True
    assert summary["frames"] == len(recorded.frames) > 25
    assert summary["predictions"] == sum(len(frame.predictions.predictions) for frame in recorded.frames)
    assert summary["tracks"] == len({track.id for frame in recorded.frames for track in frame.tracks.tracks})
    assert summary["fallbacks"] == sum(p.fallback for f in recorded.frames for p in f.predictions.predictions)
    assert (summary["refused"], summary["refusals"], summary["salvage_losses"]) == (0, [], [])
    assert summary["predictor_restarts"] == 0
    assert summary["model"]["name"] == "random"
    assert set(summary["latency_ms"]) == {"read", "track", "predict", "write", "score"}
    assert summary["log_s"] == pytest.approx(3.0, abs=0.2)
    json.dumps(summary)


def test_without_an_output_nothing_is_written(short_drive, model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert record(run(short_drive, model, settings=ReplaySettings(duration_s=1.0))).frames > 5
    assert list(tmp_path.iterdir()) == []


# --- the same bytes again --------------------------------------------------------------------------------------------


def test_two_runs_are_byte_identical(short_drive, model, recorded, tmp_path):
    record(run(short_drive, model), tmp_path / "elsewhere.mcap")
    assert (tmp_path / "elsewhere.mcap").read_bytes() == recorded.path.read_bytes()


def test_the_folder_of_the_log_changes_nothing(short_drive, model, recorded, tmp_path):
    shutil.copy(short_drive, tmp_path / "short.mcap")
    shutil.copy(model, tmp_path / "random.safetensors")
    record(run(tmp_path / "short.mcap", tmp_path / "random.safetensors"), tmp_path / "out.mcap")
    assert (tmp_path / "out.mcap").read_bytes() == recorded.path.read_bytes()


@pytest.mark.parametrize("options", [{"window": 1}, {"window": 50}, {"rate": 30.0}, {"strict": True}], ids=str)
def test_how_it_is_run_changes_nothing(short_drive, model, recorded, tmp_path, options):
    record(run(short_drive, model, **options), tmp_path / "out.mcap")
    assert (tmp_path / "out.mcap").read_bytes() == recorded.path.read_bytes()


def test_salvaging_an_intact_log_changes_nothing(short_drive, model, recorded, tmp_path):
    summary = record(run(short_drive, model, salvage=True), tmp_path / "out.mcap")
    assert (tmp_path / "out.mcap").read_bytes() == recorded.path.read_bytes()
    assert summary.clean


def test_a_predictor_killed_three_times_changes_nothing(short_drive, model, recorded, tmp_path):
    replaying = run(short_drive, model, "spawned", window=4)
    killed = set()

    def kill(frame):
        if frame.tracks.sequence in (2, 11, 20):
            killed.add(replaying.predictor.pid)
            os.kill(replaying.predictor.pid, signal.SIGKILL)

    summary = record(replaying, tmp_path / "out.mcap", on_frame=kill)
    assert len(killed) == 3
    assert summary.as_json()["predictor_restarts"] >= 3
    assert summary.complete
    assert (tmp_path / "out.mcap").read_bytes() == recorded.path.read_bytes()


def test_a_predictor_killed_again_while_it_starts_changes_nothing(short_drive, model, recorded, tmp_path):
    replaying = run(short_drive, model, "spawned", window=4)
    killers = []

    def kill_the_next(old):
        while (new := replaying.predictor.pid) == old:
            time.sleep(0.001)
        os.kill(new, signal.SIGKILL)  # milliseconds old: Python has not even started

    def kill(frame):
        if frame.tracks.sequence == 5:
            old = replaying.predictor.pid
            killers.append(threading.Thread(target=kill_the_next, args=(old,)))
            killers[0].start()
            os.kill(old, signal.SIGKILL)

    summary = record(replaying, tmp_path / "out.mcap", on_frame=kill)
    killers[0].join(10)
    assert summary.stopped is None
    assert summary.as_json()["predictor_restarts"] == 2
    assert (tmp_path / "out.mcap").read_bytes() == recorded.path.read_bytes()


def test_two_spawned_replays_at_once_do_not_mix(short_drive, drive, model, recorded, results, digest):
    found = {}

    def work(name, path, window):
        with run(path, model, "spawned", window=window) as replaying:
            found[name] = digest(replaying)

    threads = [threading.Thread(target=work, args=each) for each in (("short", short_drive, 1), ("long", drive, 8))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert found["short"] == digest(recorded.frames)
    assert found["long"] == digest(results)


def test_a_replay_may_be_recorded_off_the_main_thread(short_drive, model, recorded, tmp_path):
    """Nobody but the main thread may set signal handlers; a user's worker thread records all the same."""
    failures = []

    def work():
        try:
            record(run(short_drive, model), tmp_path / "out.mcap")
        except Exception as error:
            failures.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(120)
    assert failures == []
    assert (tmp_path / "out.mcap").read_bytes() == recorded.path.read_bytes()


# --- ending early ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_a_valid_output(short_drive, model, recorded, tmp_path, mcap_content, signum):
    def interrupt(frame):
        if frame.tracks.sequence == 9:
            os.kill(os.getpid(), signum)

    summary = record(run(short_drive, model), tmp_path / "out.mcap", on_frame=interrupt)
    assert summary.stopped.signum == signum
    assert summary.as_json()["complete"] is False
    content = mcap_content(tmp_path / "out.mcap")
    assert content.messages == mcap_content(recorded.path).messages[:40]
    assert json.loads(content.metadata["pcgan"]["complete"]) is False
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap"]


def test_a_signal_ends_the_copy_of_the_recording_too(short_drive, model, tmp_path, mcap_content):
    seen = []

    def interrupt(frame):
        seen.append(frame.log_time_ns)
        if frame.tracks.sequence == 4:
            os.kill(os.getpid(), signal.SIGINT)

    record(run(short_drive, model), tmp_path / "out.mcap", merge=True, on_frame=interrupt)
    recorded_ns = [at for topic, at, _ in mcap_content(tmp_path / "out.mcap").messages if "pcgan" not in topic]
    assert recorded_ns == [at for _, at, _ in mcap_content(short_drive).messages if at <= seen[-1]]


def test_an_error_of_the_callers_own_leaves_a_part(short_drive, model, tmp_path):
    def fail(_):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        record(run(short_drive, model), tmp_path / "out.mcap", on_frame=fail)
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap.part"]


def test_a_recording_that_turns_out_damaged_leaves_a_part(short_drive, model, tmp_path):
    damaged = tmp_path / "damaged.mcap"
    data = bytearray(short_drive.read_bytes())
    data[len(data) // 3] ^= 0xFF
    damaged.write_bytes(data)
    from replay import LogError

    with pytest.raises(LogError, match=r"damaged\.mcap is damaged \(.*; try --salvage"):
        record(run(damaged, model), tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()
    assert bytes(data) == damaged.read_bytes()


# --- the recording is never touched ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["drive.mcap", "./drive.mcap", "sub/../drive.mcap", "link.mcap"])
def test_the_recording_itself_is_no_output(short_drive, model, tmp_path, name):
    (tmp_path / "sub").mkdir()
    shutil.copy(short_drive, tmp_path / "drive.mcap")
    (tmp_path / "link.mcap").symlink_to("drive.mcap")
    before = checksum(tmp_path / "drive.mcap")
    with pytest.raises(OutputError, match="is the recording itself, which is never overwritten; choose another output"):
        record(run(tmp_path / "drive.mcap", model), tmp_path / name)
    assert checksum(tmp_path / "drive.mcap") == before
    assert {path.name for path in tmp_path.iterdir()} == {"drive.mcap", "link.mcap", "sub"}


def test_a_hard_link_to_the_recording_is_replaced_not_written_through(short_drive, model, tmp_path):
    shutil.copy(short_drive, tmp_path / "drive.mcap")
    os.link(tmp_path / "drive.mcap", tmp_path / "out.mcap")
    before = checksum(tmp_path / "drive.mcap")
    with suppress(OutputError):  # refusing it would be fine, too
        record(run(tmp_path / "drive.mcap", model, settings=ReplaySettings(duration_s=1.0)), tmp_path / "out.mcap")
    assert checksum(tmp_path / "drive.mcap") == before


def test_a_recording_called_part_is_not_overwritten(short_drive, model, tmp_path):
    """An interrupted recording, out.mcap.part, replayed into out.mcap: the writer's own part has the same name."""
    shutil.copy(short_drive, tmp_path / "out.mcap.part")
    before = checksum(tmp_path / "out.mcap.part")
    with pytest.raises(OutputError, match="is the recording itself, which is never overwritten"):
        record(run(tmp_path / "out.mcap.part", model), tmp_path / "out.mcap")
    assert checksum(tmp_path / "out.mcap.part") == before


# --- predictors that fail --------------------------------------------------------------------------------------------


@pytest.fixture
def predictor_command(tmp_path, monkeypatch):
    """Replaces the predictor's process by a script of the test's: what a broken installation would be."""

    def use(code):
        script = tmp_path / "predictor.py"
        script.write_text(code)
        wrapper = tmp_path / "python"
        wrapper.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{script}" "$@"\n')
        wrapper.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(wrapper))

    return use


# Joins the bus as predictor and calls `step` for every frame; argv: ... predict --spawned FOLDER --connect ENDPOINT
DOUBLE = """
import os, sys, time
import numpy as np
from pcgan import bus
from pcgan.predictor_process import run
from schemas.messages import Mixture, ModalPath, Prediction, PredictionFrame

PATHS = (ModalPath(1.0, np.zeros((1, 2))),)
ONES = np.ones((1, 1), np.float32)
MIXTURE = Mixture(ONES, np.zeros((1, 1, 2), np.float32), np.ones((1, 1, 2), np.float32), 0 * ONES)

class Double:
    def step(self, frame):
        {step}
        answers = tuple(Prediction(track.id, True, PATHS, MIXTURE) for track in frame.tracks)
        return PredictionFrame(frame.sequence, frame.stamp_ns, frame.frame_id, "double", 0.1, answers)

session = bus.open_session(connect=[sys.argv[sys.argv.index("--connect") + 1]])
run(session, Double(), bus.ModelIdentity("double", "00"), end_with_stdin=True)
session.close()
"""


def test_a_predictor_that_always_dies_ends_it_with_a_valid_output(
    short_drive, tmp_path, predictor_command, mcap_content
):
    predictor_command(DOUBLE.format(step="if frame.sequence >= 5: print('out of memory', flush=True), os._exit(7)"))
    summary = record(run(short_drive, None, "spawned", window=2), tmp_path / "out.mcap")
    assert isinstance(summary.stopped, PredictorError)
    assert str(summary.stopped) == (
        "the predictor died (exit code 7: out of memory); 3 replacements gave no answer either"
    )
    assert summary.as_json()["predictor_restarts"] == 3
    content = mcap_content(tmp_path / "out.mcap")
    assert len(content.messages) == 4 * 5
    assert json.loads(content.metadata["pcgan"]["complete"]) is False


def test_a_predictor_that_never_starts_says_its_last_words(short_drive, tmp_path, predictor_command):
    predictor_command("print('pcgan: no weights today'); raise SystemExit(2)")
    with pytest.raises(PredictorError, match=r"^the predictor did not start \(exit code 2: pcgan: no weights today\)$"):
        record(run(short_drive, None, "spawned"), tmp_path / "out.mcap")
    assert not list(tmp_path.glob("out*"))


def test_an_external_predictor_gives_the_same_bytes(short_drive, model, recorded, tmp_path, start_pcgan):
    endpoint = f"unixsock-stream/{tmp_path}/bus" if len(str(tmp_path)) < 90 else "tcp/127.0.0.1:47447"
    server = start_pcgan("predict", "--listen", endpoint, "--model", model)
    choice = PredictorChoice("external", connect=endpoint)
    record(Replay([short_drive], None, choice), tmp_path / "out.mcap")
    assert (tmp_path / "out.mcap").read_bytes() == recorded.path.read_bytes()
    server.send_signal(signal.SIGINT)
    _, words = server.communicate(timeout=20)
    assert server.returncode == 0
    assert f"serving random on {endpoint}; Ctrl-C ends it" in words
