"""The rerun view: what is in the recording, that two runs are equal, and that no half file gets its final name."""

import builtins
import io
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from replay import rerun_view, rerun_viewer
from replay.rerun_view import NullView, RerunView, ViewError
from schemas.messages import CompressedImage
from tests.replay.test_image_size import make_png
from tests.replay.view_scenes import START_NS, crowd

rr = pytest.importorskip("rerun", reason="rerun-sdk comes with pcgan[view]")
RERUN = Path(sys.executable).with_name("rerun")


def write(path: Path, frames, recording_id: str = "test") -> Path:
    with RerunView.to_file(path, recording_id) as view:
        for frame in frames:
            view.show(frame)
    return path


def rerun(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([RERUN, "rrd", *map(str, arguments)], capture_output=True, text=True, check=False)


def printed(path: Path) -> str:
    return rerun("print", path, "-vvv").stdout


def test_recording_is_complete_and_two_runs_are_equal(tmp_path, monkeypatch):
    monkeypatch.setattr(rerun_view, "FRAMES_PER_BATCH", 5)  # more than one batch, and one that is not full
    first, second = (write(tmp_path / name, crowd(people=12, frames=12)) for name in ("a.rrd", "b.rrd"))
    assert rerun("verify", first).returncode == 0
    compared = rerun("compare", "--unordered", first, second)
    assert compared.returncode == 0, compared.stderr
    other = write(tmp_path / "c.rrd", crowd(people=12, frames=12, seed=1))
    assert rerun("compare", "--unordered", first, other).returncode != 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.rrd", "b.rrd", "c.rrd"]


def test_recording_has_everything_under_stamp_and_frame_only(tmp_path):
    text = printed(write(tmp_path / "a.rrd", crowd(people=12, frames=3)))
    for entity in (
        "/map/vehicle", "/map/clusters", "/map/measurements", "/map/tracks/seen", "/map/tracks/coasting",
        "/map/tracks/tails", "/map/predictions/paths", "/map/predictions/mixture", "/map/predictions/fallback",
        "/map/ground_truth", "/cameras/A0/detections", "/cameras/B1/tracks", "/counts/tracks", "/legend",
    ):  # fmt: skip
        assert entity in text
    chunks = [chunk for chunk in text.split("\n\n") if "index_name: blueprint" not in chunk]
    times = {name for chunk in chunks for name in re.findall(r"index_name: (\w+)", chunk)}
    assert times == {"stamp", "frame"}  # no wall clock


def test_a_failed_run_leaves_its_part_and_its_own_error(tmp_path):
    def fail_after(frames):
        yield from frames
        raise KeyError("predictor")

    with pytest.raises(KeyError, match="predictor"):
        write(tmp_path / "a.rrd", fail_after(crowd(people=3, frames=3)))
    assert [path.name for path in tmp_path.iterdir()] == ["a.rrd.part"]
    assert rerun("verify", tmp_path / "a.rrd.part").returncode == 0  # up to there it is whole


def test_closing_early_and_twice(tmp_path):
    view = RerunView.to_file(tmp_path / "a.rrd")
    frame = next(crowd(people=3))
    view.show(frame)
    view.close()
    view.close()
    assert (tmp_path / "a.rrd").exists()
    with pytest.raises(ValueError, match="closed"):
        view.show(frame)


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(ViewError, match=r"nowhere.* cannot be written: No such file or directory$"):
        RerunView.to_file(tmp_path / "nowhere" / "a.rrd")


def test_without_rerun_the_error_says_what_to_install(tmp_path, monkeypatch):
    real = builtins.__import__

    def missing(name, *arguments, **options):
        if name == "rerun":
            raise ImportError(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ViewError, match=r'pip install "pcgan\[view\]"'):
        RerunView.to_file(tmp_path / "a.rrd")


def test_the_view_is_imported_without_rerun():
    code = "import sys, replay.rerun_view; sys.exit('rerun' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_frames_without_people_cameras_clusters_or_truth_are_drawn(tmp_path):
    bare = next(crowd(people=0, cameras=False))
    bare = replace(bare, ground_truth=None, predictions=replace(bare.predictions, predictions=()))
    path = write(tmp_path / "a.rrd", [bare, *crowd(people=5, frames=2, first=61), replace(bare, log_time_ns=1)])
    assert rerun("verify", path).returncode == 0


def test_a_map_far_from_the_origin_keeps_its_precision(tmp_path):
    """UTM coordinates in single precision would put people 0.25 m apart onto one spot."""
    frame = next(crowd(people=2, cameras=False))
    shift = np.array([334_000.0, 6_249_000.0])
    pose = frame.sensors.map_from_vehicle.copy()
    pose[:2, 3] += shift
    tracks = tuple(replace(track, state=np.append(shift, [0, 0])) for track in frame.tracks.tracks)
    far = replace(
        frame,
        sensors=replace(frame.sensors, map_from_vehicle=pose),
        tracks=replace(frame.tracks, tracks=tracks),
        predictions=replace(frame.predictions, predictions=()),
    )
    with RerunView.to_file(tmp_path / "a.rrd") as view:
        view.show(far)
    columns = [line for line in printed(tmp_path / "a.rrd").splitlines() if "334000" in line or "6249000" in line]
    assert columns == []


def test_small_images_are_stretched_to_the_calibration_and_logged_once(tmp_path):
    image = CompressedImage(START_NS, "A0", make_png(480, 302), "png")
    frames = [replace(frame, images={"A0": image}) for frame in crowd(people=2, frames=3)]
    text = printed(write(tmp_path / "a.rrd", frames))
    (chunk,) = [part for part in text.split("\n\n") if "/cameras/A0/image" in part and "EncodedImage:blob" in part][:1]
    assert "4.0, 4.0, 1.0" in text
    assert chunk


def test_null_view_shows_nothing():
    with NullView() as view:
        view.show(next(crowd(people=1)))


def test_a_viewer_without_a_screen_says_so(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    if sys.platform != "linux":
        pytest.skip("only on Linux does a viewer need these variables")
    with pytest.raises(ViewError, match="did not start; without a screen write a recording instead"):
        RerunView.spawn()


def test_a_missing_program_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(rerun_viewer.ViewerError, match=r'pip install "pcgan\[view\]"'):
        rerun_viewer.start_viewer()


@pytest.mark.slow
def test_picture_of_the_view_without_a_screen(tmp_path):
    from replay.rerun_screenshot import main, take_screenshot

    recording = write(tmp_path / "a.rrd", crowd(people=12, frames=10))
    try:
        take_screenshot(recording, tmp_path / "a.png", at_s=0.5, window_px=(800, 600))
    except rerun_viewer.ViewerError as error:
        if "cannot draw without a screen" in str(error):
            pytest.skip(str(error))
        raise
    from matplotlib.image import imread

    pixels = imread(io.BytesIO((tmp_path / "a.png").read_bytes()))
    assert pixels.shape[:2] == (600, 800)
    assert len(np.unique(pixels.reshape(-1, pixels.shape[-1]), axis=0)) > 100
    assert main([str(tmp_path / "none.rrd"), str(tmp_path / "b.png")]) == 2


@pytest.mark.slow
def test_a_live_view_reaches_its_viewer():
    from rerun.experimental import ViewerClient

    try:
        view = RerunView.spawn("live", headless=True)
    except ViewError as error:
        pytest.skip(str(error))
    assert view.viewer is not None
    try:
        with view:
            for frame in crowd(people=3, frames=5):
                view.show(frame)
        client = ViewerClient.connect(view.viewer.url)
        (recording,) = [shown for shown in client.get_state().recordings if shown.store_id.endswith(":live")]
        spans = {timeline.name: (timeline.start, timeline.end) for timeline in recording.timelines}
        assert spans["frame"] == (60, 64)
    finally:
        view.viewer.stop()
    assert view.viewer.process.poll() is not None


def test_a_recording_leaves_the_environment_as_it_was(tmp_path, monkeypatch):
    for chosen in (None, "debug"):
        monkeypatch.delenv("RUST_LOG", raising=False)
        if chosen is not None:
            monkeypatch.setenv("RUST_LOG", chosen)
        RerunView.to_file(tmp_path / f"{chosen}.rrd").close(complete=False)
        assert os.environ.get("RUST_LOG") == chosen
