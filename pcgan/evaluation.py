"""The whole evaluation: every method on every test scene, from shipped weights or from one's own runs.

ETH/UCY: a network per fold, tested on the scene it was trained without. VCI: networks trained on the split's training
clips, at 12 Hz; and a long task on DUT, at 2.5 Hz. Where there are runs of several seeds, figures are means over them.
"""

import csv
import json
import re
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from pcgan import checkpoint, tables
from pcgan.checkpoint import CheckpointError
from pcgan.clips import load_clip
from pcgan.dataset import Windows, WindowSpec, clip_windows, concatenate, training_clip_names
from pcgan.forecast import EXTRAPOLATIONS, Extrapolation, Method
from pcgan.methods import load_method
from pcgan.protocols import (
    ETH_UCY_SCENES,
    ETH_UCY_SPEC,
    LONG_DUT_SPEC,
    VCI_SPEC,
    Split,
    eth_ucy_fold,
    long_dut_split,
    vci_split,
)
from pcgan.report import ReportData, SceneExample, write_report
from pcgan.report_curves import mean_curves
from pcgan.scene_choice import Scene, busiest, oncoming_pair, turning_group, vehicle_from_behind
from pcgan.scores import Curves, Measured, QuickScores, measure, near_vehicle
from pcgan.training_data import VALIDATION_NOISE_M

DATA = ("eth_ucy", "vci", "drives", "all")
LEARNED = ("sgan", "srlstm", "psgan", "pcgan", "psgan_paper", "pcgan_paper")
METHODS = {
    "eth_ucy": ("lin", "cvm", "weighted", *LEARNED),
    "vci": ("lin", "cvm", "anchored", "weighted", *LEARNED, "pcgan_no_vehicle"),
    "drives": ("lin", "cvm", "weighted", "state", "pcgan"),
}
# Windows of simulated drives, by the name of their file -> scene of the results, and PCGAN's network, which is the one
# that predicts in replays.
DRIVES = {"tracked_10hz": ("usyd", "vehicle_10hz"), "tracked_2.5hz": ("usyd_long", "vehicle_2.5hz")}
HORIZONS = (8, 12)
RECORD = Path(__file__).parents[1] / "benchmarks" / "test_runs.csv"  # there in a checkout alone
_SEED = re.compile(r"_s\d+$")


@dataclass(eq=False)
class Evaluation:
    """Everything that was measured."""

    results: dict[str, dict[str, dict[str, dict[str, float]]]] = field(default_factory=dict)
    curves: dict[str, dict[str, Curves]] = field(default_factory=dict)  # by data set and method
    examples: list[SceneExample] = field(default_factory=list)
    weights: dict[str, str] = field(default_factory=dict)  # name of each network used -> SHA-256
    used: dict[tuple[int, str, str], str] = field(default_factory=dict)  # seed, method, scene -> SHA-256
    runs: list[dict[str, dict[str, dict[str, dict[str, float]]]]] = field(default_factory=list)  # by seed


@dataclass(frozen=True, eq=False)
class _Task:
    """Test windows, and what the networks for them are called."""

    data: str  # heading of its curves
    scene: str  # of the results
    weights: str  # METHOD_<weights>[_sSEED].safetensors
    split: Split
    horizons: tuple[int, ...]
    shipped: str | None = None  # PCGAN for this, where it is a network that predicts in replays


def evaluate(
    data: str,
    methods: tuple[str, ...] = (),
    runs: Path | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    *,
    drives: Mapping[str, Windows] | None = None,
    data_dir: Path | None = None,
) -> Evaluation:
    """Measures methods on the test scenes.

    Args:
        data: `eth_ucy`, `vci`, `drives` or `all`.
        methods: which; empty: all that there are.
        runs: folder of one's own networks, named as `benchmarks/train_all.py` names them; None: those that ship.
        progress: called with what is being measured, how much is done, and how much there is.
        drives: windows of simulated drives, by the keys of `DRIVES`; without them `all` leaves drives out.
        data_dir: where the data sets are; None: where they are usually looked for.

    Raises DataNotFound without the data, ValueError for names that do not exist, CheckpointError for a network that is
    asked for by name and not there.
    """
    if data not in DATA:
        raise ValueError(f"no data {data!r} to evaluate on; there are {DATA}")
    wanted = ("eth_ucy", "vci", *(("drives",) if drives else ())) if data == "all" else (data,)
    known = {method for name in wanted for method in METHODS[name]}
    if unknown := sorted(set(methods) - known):
        raise ValueError(f"no methods {unknown} on {data}; there are {sorted(known)}")
    folder = checkpoint.TABLE_WEIGHTS if runs is None else runs
    todo = [
        (task, method, path)
        for name in wanted
        for task in _tasks(name, drives or {}, data_dir)
        for method in METHODS[name]
        if method in methods or not methods
        for path in _paths(folder, method, task)
    ]
    if missing := sorted(set(methods) - {method for _, method, _ in todo}):
        raise CheckpointError(f"no networks of {', '.join(missing)} for {data} in {folder}")
    evaluation = Evaluation()
    parts: dict[tuple[str, str], list[Curves]] = {}
    pictured: dict[str, dict[str, Method]] = {}
    generator = torch.Generator()
    for done, (task, method, path) in enumerate(todo):
        if progress is not None:
            progress(f"{method} on {task.scene}", done, len(todo))
        asked = _method(method, path, task)
        measured = measure(asked, task.split.test, task.horizons, generator.manual_seed(0))
        seed = _seed(path)
        while len(evaluation.runs) <= seed:
            evaluation.runs.append({})
        _note(evaluation.runs[seed], method, task, measured)
        if path is not None:
            digest = evaluation.weights[path.stem] = checkpoint.sha256(path)
            evaluation.used[seed, method, task.scene] = digest
        if seed == 0:
            parts.setdefault((task.data, method), []).append(measured.curves())
            pictured.setdefault(task.weights, {})[method] = asked
    if progress is not None:
        progress("pictures", len(todo), len(todo))
    evaluation.results = tables.combine(evaluation.runs)
    for (heading, method), curves in parts.items():
        evaluation.curves.setdefault(heading, {})[method] = mean_curves(curves)
    evaluation.examples = list(_examples({task.weights: task for task, _, _ in todo}, pictured))
    return evaluation


def show(evaluation: Evaluation, console: Console) -> None:
    """Prints the tables, and in how many cells of the paper's Table 1 PCGAN is better than anything there."""
    for layout in tables.layouts(evaluation.results):
        console.print(tables.rich_table(layout))
        console.print()
    if tables.margins(evaluation.results):
        console.print(tables.margins_sentence(evaluation.results))


def write_json(evaluation: Evaluation, path: Path) -> None:
    """Writes `{method: {scene: {"8": {...}, "12": {...}}}}`."""
    path.write_text(json.dumps(evaluation.results, indent=1, sort_keys=True) + "\n")


def write_markdown(evaluation: Evaluation, path: Path) -> None:
    """Writes the tables as Markdown."""
    text = "\n\n".join(tables.markdown(layout) for layout in tables.layouts(evaluation.results))
    if tables.margins(evaluation.results):
        text += f"\n\n{tables.margins_sentence(evaluation.results)}"
    path.write_text(text + "\n")


def write_html(evaluation: Evaluation, path: Path) -> None:
    """Writes the report; raises ReportError."""
    networks = ", ".join(f"{name} {digest[:12]}" for name, digest in sorted(evaluation.weights.items()))
    seeds = f"{len(evaluation.runs)}" if len(evaluation.runs) > 1 else "one per network"
    lineage = {"commit": commit(), "networks": networks, "seeds": seeds}
    write_report(ReportData(evaluation.results, evaluation.curves, evaluation.examples, lineage), path)


def append_record(evaluation: Evaluation, note: str, path: Path = RECORD) -> int:
    """Adds a line per network and test scene to the record of every look at test scenes; returns how many.

    Nothing is written where there is no record: outside a checkout.
    """
    lines: list[dict[str, object]] = []
    for seed, run in enumerate(evaluation.runs):
        for method, scenes in run.items():
            for scene, horizons in scenes.items():
                for horizon, figures in horizons.items():
                    lines.append({
                        "commit": commit(), "model": method, "drive": f"{scene}@{horizon}", "seed": seed,
                        "weights": evaluation.used.get((seed, method, scene.removesuffix("_near")), "")[:12],
                        **{f"truth_{name}_m": round(figures[name], 4) for name in ("ade", "fde", "mhd")},
                        "truth_nll": round(figures["nll"], 4), "truth_scored": figures["pedestrians"], "note": note,
                    })  # fmt: skip
    return append_lines(lines, path)


def append_lines(lines: Sequence[Mapping[str, object]], path: Path = RECORD) -> int:
    """Adds lines, by the record's columns, to the record; returns how many, 0 where there is none."""
    if not path.is_file():
        return 0
    with path.open(newline="") as stream:
        columns = next(csv.reader(stream))
    with path.open("a", newline="") as stream:
        csv.DictWriter(stream, columns, restval="", lineterminator="\n").writerows(lines)
    return len(lines)


def as_line(name: str, path: Path, scene: str, found: QuickScores, note: str) -> dict[str, object]:
    """Returns a look's line for the record."""
    return {
        "commit": commit(), "model": name, "weights": checkpoint.sha256(path)[:12], "drive": scene,
        "truth_ade_m": round(found.ade, 4), "truth_fde_m": round(found.fde, 4), "truth_mhd_m": round(found.mhd, 4),
        "truth_nll": round(found.nll, 4), "truth_scored": found.pedestrians, "note": note,
    }  # fmt: skip


def commit() -> str:
    """Returns the commit looked at, with a plus sign if files differ from it; "unknown" outside a checkout."""
    described = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    done = subprocess.run(described, capture_output=True, text=True, check=False, cwd=Path(__file__).parent)
    return done.stdout.strip() or "unknown"


# --- pieces --------------------------------------------------------------------------------------------------------


def _tasks(name: str, drives: Mapping[str, Windows], data_dir: Path | None) -> Iterable[_Task]:
    if name == "eth_ucy":
        for scene in ETH_UCY_SCENES:
            fold = eth_ucy_fold(scene, ETH_UCY_SPEC, data_dir)
            yield _Task("ETH/UCY", scene, f"eth_ucy_{scene}", fold, HORIZONS)
        fast = eth_ucy_fold("eth", ETH_UCY_SPEC, data_dir, ten_frame_eth=True)
        yield _Task("ETH/UCY, ETH from 10 frames", "eth_10frame", "eth_ucy_eth", fast, HORIZONS)
    elif name == "vci":
        yield _Task("VCI, 12 Hz", "vci", "vci", vci_split(VCI_SPEC, data_dir), (VCI_SPEC.predicted_steps,))
        long = long_dut_split(LONG_DUT_SPEC, data_dir)
        yield _Task("DUT, 2.5 Hz", "dut_long", "dut_long", long, (LONG_DUT_SPEC.predicted_steps,))
    else:
        for key, windows in drives.items():
            scene, network = DRIVES[key]
            T, P = windows.observed.shape[1], windows.future.shape[1]
            split = Split(_clips_as_tracked(WindowSpec(T, P, windows.dt_s), data_dir), {}, windows)
            yield _Task(f"Simulated drives, {1 / windows.dt_s:g} Hz", scene, key, split, (P,), network)


def _clips_as_tracked(spec: WindowSpec, data_dir: Path | None) -> dict[str, Windows]:
    """Returns training clips as a filter would see them: what extrapolations of tracks take their widths from."""
    rng = np.random.default_rng(0)
    names = training_clip_names(data_dir)
    return {name: clip_windows(load_clip(name, data_dir), spec, VALIDATION_NOISE_M, rng) for name in names}


def _paths(folder: Path, method: str, task: _Task) -> list[Path | None]:
    """Returns a method's networks for a task, by seed; one without a seed in its name counts as the first.

    What needs no network has None. Not every method has a network for every task.
    """
    if method in EXTRAPOLATIONS:
        return [None]
    stem = f"{method}_{task.weights}"
    if task.shipped is not None:
        stem, folder = task.shipped, folder.parent if folder == checkpoint.TABLE_WEIGHTS else folder
    found = [path for path in sorted(folder.glob(f"{stem}*.safetensors")) if _SEED.sub("", path.stem) == stem]
    return list(found)


def _seed(path: Path | None) -> int:
    found = _SEED.search(path.stem) if path is not None else None
    return int(found[0][2:]) if found else 0


def _method(name: str, path: Path | None, task: _Task) -> Method:
    if path is not None:
        return load_method(path, name)
    windows = task.split.test
    plain = Extrapolation(name, windows.future.shape[1], windows.dt_s)
    return plain.fitted(concatenate(list(task.split.training.values())))


def _note(run: dict[str, dict[str, dict[str, dict[str, float]]]], method: str, task: _Task, measured: Measured) -> None:
    scenes = run.setdefault(method, {})
    scenes[task.scene] = measured.figures()
    near = near_vehicle(task.split.test)
    with suppress(ValueError):  # nobody near whose future is known to the end
        scenes[f"{task.scene}_near"] = measured.figures(near)


def _examples(tasks: Mapping[str, _Task], methods: Mapping[str, Mapping[str, Method]]) -> Iterable[SceneExample]:
    """Yields the paper's kinds of scene, with what every method says of them."""
    for name, heading, chosen, choose in (
        (
            "eth_ucy_zara1",
            "Oncoming pair",
            "They walk towards each other; who gives way, and to which side?",
            oncoming_pair,
        ),
        ("eth_ucy_zara2", "Oncoming pair", "The same in another scene.", oncoming_pair),
        ("eth_ucy_univ", "Group turning", "People close together who change their heading.", turning_group),
        ("eth_ucy_hotel", "Busy moment", "As many people as there are at a time.", busiest),
        ("vci", "Vehicle from behind", "A vehicle comes up behind people who walk ahead of it.", vehicle_from_behind),
        ("tracked_2.5hz", "A simulated drive", "What a replay sees: tracks, 4.8 s ahead.", busiest),
    ):
        if name not in tasks or "pcgan" not in methods.get(name, {}):
            continue
        scene: Scene | None = choose(tasks[name].split.test)
        if scene is None:
            continue
        with torch.inference_mode():
            forecasts = {
                method: asked.forecast(scene.observation(), torch.Generator().manual_seed(0))
                for method, asked in methods[name].items()
            }
        yield SceneExample(f"{heading} ({tasks[name].scene})", chosen, scene, forecasts)
