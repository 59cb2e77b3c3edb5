"""The golden logs: each holds what its name says, and replays as its reference says.

Byte for byte is asked only between runs on one machine. Against the references, which another machine may have made,
the suite's tolerances hold (docs/regression.md says why these).
"""

import ast
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rich.console import Console

from pcgan import checkpoint, train
from pcgan.dataset import WindowSpec, clip_windows
from pcgan.recipes import Task, recipe_for
from pcgan.train import TrainConfig
from pcgan.training_data import TrainData
from replay.check import CheckOptions, check_suite
from replay.check_result import CaseResult, Status
from replay.diff import diff_logs
from replay.diff_result import Tolerances
from replay.replay_job import ReplayJob, run_job
from replay.simulator.sensor_suite import CLUSTERS_TOPIC, GROUND_TRUTH_TOPIC, ODOMETRY_TOPIC, START_NS, TF_TOPIC
from replay.suite import Suite, Variant, read_suite
from schemas import codec
from schemas.messages import GroundTruthFrame, VehiclePose
from tests.golden import make, scenes

SUITE = make.FOLDER / "suite.yaml"
CLEARLY_SEEN = 10  # LiDAR points


@dataclass
class Content:
    """What a golden log holds."""

    times_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))  # log times by topic
    yaws_rad: list[float] = field(default_factory=list)
    positions_m: list[np.ndarray] = field(default_factory=list)  # of the vehicle
    points: dict[int, list[int]] = field(default_factory=lambda: defaultdict(list))  # person -> LiDAR points by scan
    near: list[int] = field(default_factory=list)  # people within 30 m, by scan

    def longest_gap_s(self, topic: str) -> tuple[float, float]:
        """Returns the ends of the longest time without a message of a topic."""
        times = self.times_s[topic]
        i = int(np.argmax(np.diff(times)))
        return times[i], times[i + 1]


@cache
def content(name: str) -> Content:
    """Reads a golden log."""
    found = Content()
    with (make.LOG_FOLDER / f"{name}.mcap").open("rb") as stream:
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            found.times_s[channel.topic].append((message.log_time - START_NS) / 1e9)
            if channel.topic == ODOMETRY_TOPIC:
                pose = codec.decode(VehiclePose, message.data)
                found.yaws_rad.append(2 * np.arctan2(pose.quaternion_xyzw[2], pose.quaternion_xyzw[3]))
                found.positions_m.append(pose.position_m[:2])
            elif channel.topic == GROUND_TRUTH_TOPIC and found.positions_m:
                truth = codec.decode(GroundTruthFrame, message.data)
                distances_m = np.linalg.norm(truth.positions_m - found.positions_m[-1], axis=1)
                found.near.append(int((distances_m < 30).sum()))
                for person, points in zip(truth.ids.tolist(), truth.lidar_points.tolist(), strict=True):
                    found.points[person].append(points)
    return found


def hidden_s(points: list[int]) -> list[float]:
    """Returns how long somebody was out of sight each time, between times at which the LiDAR saw them clearly."""
    found, seen, start = [], False, 0
    for count, scans in groupby(points, key=lambda each: min(each, CLEARLY_SEEN + 1)):
        length = len(list(scans))
        if count == 0 and seen and max(points[start + length :], default=0) > CLEARLY_SEEN:
            found.append(length / 10)
        seen = seen or count > CLEARLY_SEEN
        start += length
    return found


# --- what they hold ------------------------------------------------------------------------------------------------


def test_all_are_small():
    logs = sorted(make.LOG_FOLDER.iterdir())
    assert [path.stem for path in logs] == sorted(make.LOGS)
    sizes = [path.stat().st_size for path in logs]
    assert max(sizes) < 1_000_000
    assert sum(sizes) < 5_000_000


def test_sparse_holds_a_handful():
    near = content("sparse").near
    assert 3 <= min(near) <= max(near) <= 8
    assert len(near) > 130  # scans: over 13 s


def test_dense_holds_a_crowd():
    assert min(content("dense").near) >= 60


def test_turning_turns():
    found = content("turning")
    yaws = np.unwrap(found.yaws_rad)
    assert np.degrees(yaws[-1] - yaws[0]) > 80
    assert sum(max(points) > CLEARLY_SEEN for points in found.points.values()) >= 12


def test_occlusion_hides_people_and_shows_them_again():
    found = content("occlusion")
    gone = {person: [each for each in hidden_s(points) if 1 <= each <= 3] for person, points in found.points.items()}
    assert sum(1 for each in gone.values() if each) >= 5
    assert sum(map(len, gone.values())) >= 7


def test_dropout_has_its_gaps():
    found = content("dropout")
    for gap in make.GAPS:
        for topic in gap.topics:
            inside = [at for at in found.times_s[topic] if gap.from_s <= at < gap.until_s]
            assert not inside
            assert min(found.times_s[topic]) < gap.from_s < gap.until_s < max(found.times_s[topic])
    assert np.subtract(*found.longest_gap_s("/gmsl/A0/detections")[::-1]) == pytest.approx(3.0, abs=0.1)
    assert np.subtract(*found.longest_gap_s("/gmsl/B1/detections")[::-1]) == pytest.approx(2.0, abs=0.1)
    assert np.subtract(*found.longest_gap_s(CLUSTERS_TOPIC)[::-1]) == pytest.approx(1.1, abs=0.1)
    assert np.subtract(*found.longest_gap_s(ODOMETRY_TOPIC)[::-1]) == pytest.approx(0.5, abs=0.05)
    assert np.subtract(*found.longest_gap_s(TF_TOPIC)[::-1]) == pytest.approx(0.5, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", make.LOGS)
def test_are_made_again(name, tmp_path):
    for folder in ("first", "second"):
        (tmp_path / folder).mkdir()
        make.LOGS[name](tmp_path / folder / f"{name}.mcap")
    made = (tmp_path / "first" / f"{name}.mcap").read_bytes()
    assert made == (tmp_path / "second" / f"{name}.mcap").read_bytes()
    assert [path.name for path in (tmp_path / "first").iterdir()] == [f"{name}.mcap"], "nothing else is left"
    committed = make.LOG_FOLDER / f"{name}.mcap"
    if made != committed.read_bytes():  # another CPU, or another release of zstd
        diff = diff_logs([committed], [tmp_path / "first" / f"{name}.mcap"], Tolerances(atol=1e-6))
        assert diff.same, diff.first


# --- how they replay -----------------------------------------------------------------------------------------------


@cache
def suite() -> Suite:
    """Reads the golden suite."""
    return read_suite(SUITE)


def check(plan: Suite, *only: str, workers: int = 1, keep: Path | None = None) -> dict[str, CaseResult]:
    """Checks cases of a suite, as `pcgan check` does."""
    return {each.case: each for each in check_suite(plan, CheckOptions(workers, only, keep=keep)).results}


def with_settings(changes: Mapping[str, Any]) -> Suite:
    """Returns the suite with some settings changed in every case."""
    variant = Variant(settings=changes)
    return replace(
        suite(), cases=tuple(replace(case, settings=suite().settings_of(case, variant)) for case in suite().cases)
    )


def outputs(folder: Path) -> dict[str, bytes]:
    """Returns the bytes of every output that was kept in a folder."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.parametrize("name", make.LOGS)
def test_replays_as_its_reference(name):
    result = check(suite(), name)[name]
    assert result.status in {Status.IDENTICAL, Status.CLOSE}, result.problem
    assert result.reference.changed == (), "the reference is of another model, or of other settings"
    assert all(judged.met for judged in result.judged)


def test_references_are_small():
    sizes = [path.stat().st_size for path in suite().references.iterdir()]
    assert len(sizes) == len(make.LOGS)
    assert max(sizes) < 1_000_000


@pytest.mark.slow
def test_a_worker_and_this_process_give_the_same_bytes(tmp_path):
    check(suite(), "turning", keep=tmp_path / "kept")
    again = tmp_path / "again.mcap"
    run_job(ReplayJob((make.LOG_FOLDER / "turning.mcap",), again, model=suite().model))
    assert outputs(tmp_path / "kept") == {"turning.pcgan.mcap": again.read_bytes()}


@pytest.mark.slow
def test_any_number_of_workers_and_of_repetitions_gives_the_same(tmp_path):
    """On one worker and two, twenty times, the first seconds of all logs: the same outputs, figures and differences."""
    plan = with_settings({"duration_s": 3.0})  # so they differ from their references
    first = None
    for repetition in range(20):
        folder = tmp_path / str(repetition)
        results = check(plan, workers=1 + repetition % 2, keep=folder)
        said = {name: {**result.as_json(), "wall_s": None, "output": None} for name, result in results.items()}
        assert list(said) == list(make.LOGS)
        assert len(outputs(folder)) == len(make.LOGS)
        first = first or (said, outputs(folder))
        assert (said, outputs(folder)) == first, f"repetition {repetition}"
        shutil.rmtree(folder)


# --- what they catch -----------------------------------------------------------------------------------------------

DIFFERENCE = r"/pcgan/\w+ at \d+\.\d{3} s.*"  # "/pcgan/tracks at 12.400 s, track 7, position: 4.812 vs 4.870 ..."
THRESHOLDS = {
    "confirm_hits": {"tracker": {"confirm_hits": 3}},
    "publish_existence": {"tracker": {"publish_existence": 0.6}},
    "merge_distance": {"tracker": {"filter": {"merge_distance": 0.45}}},
    "clutter_per_m2": {"tracker": {"filter": {"clutter_per_m2": 0.002}}},
    "p_detect": {"visibility": {"p_detect": 0.9}},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", THRESHOLDS)
def test_changed_threshold_is_caught(name):
    results = check(with_settings({"tracking": THRESHOLDS[name]}), workers=2)
    caught = [each for each in results.values() if each.status is Status.CHANGED]
    assert any(re.fullmatch(DIFFERENCE, result.problem) for result in caught)
    for result in caught:
        assert re.fullmatch(rf"{DIFFERENCE}|the paths are the same, their mixtures are not: .*", result.problem)
        assert any(name in each for each in result.reference.changed)


@pytest.mark.slow
def test_retrained_model_is_caught(tmp_path):
    """Retrained in earnest, if only for an epoch on one drive's people."""
    weights = suite().model
    config = checkpoint.describe(Path(weights)).config
    spec = WindowSpec(config.observed_steps, config.predicted_steps, config.dt_s, config.dt_s)
    windows = clip_windows(scenes.turning_clip(), spec)
    recipe = replace(recipe_for("pcgan", "best", Task(dt_s=config.dt_s, uses_vehicle=True)), network=config, epochs=1)
    data = TrainData(windows, np.ones(int(windows.scene[-1]) + 1), {})
    run = TrainConfig(recipe, tmp_path, Path(weights).stem, start_from=Path(weights))
    retrained = train.train(run, data, Console(file=io.StringIO()))

    result = check(replace(suite(), model=str(retrained)), "turning")["turning"]
    assert result.status is Status.CHANGED
    assert re.fullmatch(DIFFERENCE, result.problem)
    assert result.problem.startswith("/pcgan/predictions at ")
    assert {topic.topic: topic.same for topic in result.diff.topics}["/pcgan/tracks"]
    assert any(each.startswith("model ") for each in result.reference.changed)


# --- another CPU, other code ---------------------------------------------------------------------------------------

PROJECT = make.FOLDER.parents[1]
CHANGED_LINE = ("tracking/camera_only.py", "SAME_AS_CLUSTER = 16.0", "SAME_AS_CLUSTER = 9.0")


def check_elsewhere(folder: Path, **environment: str) -> dict[str, dict]:
    """Runs `pcgan check` on the golden suite in a folder and environment of its own; returns its JSON by case."""
    command = [sys.executable, "-c", "from replay.cli import main; main()", "check", str(SUITE), "--workers", "2"]
    options = ["--keep", "outputs", "--json", "check.json"]
    everything = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    done = subprocess.run([*command, *options], cwd=folder, env=everything, capture_output=True, text=True, check=False)
    assert done.returncode in {0, 1}, done.stderr
    return {each["case"]: each for each in json.loads((folder / "check.json").read_text())["cases"]}


@pytest.mark.slow
def test_another_cpu_passes(tmp_path):
    """With the BLAS kernels of a CPU without AVX; where there is no OpenBLAS nothing changes."""
    results = check_elsewhere(tmp_path, OPENBLAS_CORETYPE="Prescott")
    assert len(results) == len(make.LOGS)
    assert {each["status"] for each in results.values()} <= {"identical", "close"}


@pytest.fixture
def edited_project(tmp_path):
    """Copies the packages and changes some modules' source; checks the golden suite with that copy."""

    def edit(changed: Mapping[str, str], folder: str) -> dict[str, dict]:
        copy = tmp_path / folder
        for package in ("schemas", "tracking", "pcgan", "replay"):
            shutil.copytree(PROJECT / package, copy / package, ignore=shutil.ignore_patterns("__pycache__"))
        for name, source in changed.items():
            (copy / name).write_text(source)
        return check_elsewhere(copy, PYTHONPATH=str(copy))

    return edit


class _Renamed(ast.NodeTransformer):
    """Gives other names to some functions, classes and constants of a module."""

    def __init__(self, names: Mapping[str, str]):
        self._names = names

    def visit_Name(self, node: ast.Name) -> ast.Name:
        return ast.copy_location(ast.Name(self._names.get(node.id, node.id), node.ctx), node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.name = self._names.get(node.name, node.name)
        return self.generic_visit(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        node.name = self._names.get(node.name, node.name)
        return self.generic_visit(node)


def refactored(source: str) -> str:
    """Returns a module without comments, laid out anew, its private functions and classes under other names."""
    tree = ast.parse(source)
    private = [
        node.name
        for node in tree.body
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and re.match(r"_[^_]", node.name)
    ]
    tree = _Renamed({name: f"_other{name}" for name in private}).visit(tree)
    return ast.unparse(ast.fix_missing_locations(tree))


@pytest.mark.slow
def test_refactor_that_changes_nothing_passes_byte_for_byte(edited_project, tmp_path):
    """With every module of tracking, and the network's, rewritten."""
    modules = [*sorted((PROJECT / "tracking").glob("*.py")), PROJECT / "pcgan/inference.py"]
    sources = {str(path.relative_to(PROJECT)): path.read_text() for path in modules}
    rewritten = {name: refactored(source) for name, source in sources.items()}
    assert sum("_other_" in source for source in rewritten.values()) > 5

    before, after = edited_project({}, "before"), edited_project(rewritten, "after")
    assert {each["status"] for each in before.values()} <= {"identical", "close"}
    assert {name: each["status"] for name, each in after.items()} == {n: each["status"] for n, each in before.items()}
    assert len(before) == len(make.LOGS)
    assert outputs(tmp_path / "before/outputs") == outputs(tmp_path / "after/outputs")


@pytest.mark.slow
def test_changed_line_of_the_tracker_is_caught(edited_project):
    """A threshold that is no setting, but a number in the code."""
    name, line, other = CHANGED_LINE
    source = (PROJECT / name).read_text()
    assert source.count(line) == 1
    results = edited_project({name: source.replace(line, other)}, "changed")
    caught = [each for each in results.values() if each["status"] == "changed"]
    assert caught
    assert all(re.fullmatch(DIFFERENCE, each["problem"]) for each in caught)
    assert not any(each["reference"]["changed"] for each in caught), "neither settings nor weights are others"
