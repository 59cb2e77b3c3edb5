"""The subcommands about models: which there are, their training and its windows, their evaluation."""

import json
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from replay.cli_common import console, errors, fail, progress, refuse_unwritable

MODELS = "Models"  # their panel in the help
LONG_STEP_S = 0.4
DRIVE_STEPS_S = (
    0.1,
    LONG_STEP_S,
)  # of the models that predict in replays, and of the windows that `pcgan windows` makes

app = typer.Typer()


class TrainingData(StrEnum):
    """What can be trained on."""

    eth_ucy = "eth_ucy"
    vci = "vci"
    drives = "drives"


class EvaluationData(StrEnum):
    """What can be evaluated on."""

    eth_ucy = "eth_ucy"
    vci = "vci"
    drives = "drives"
    all = "all"


class RecipeName(StrEnum):
    """How a method is built and trained."""

    paper = "paper"
    best = "best"


@app.command(rich_help_panel=MODELS)
def models(
    tables: Annotated[
        bool, typer.Option("--tables", metavar="", help="List the models of pcgan evaluate's tables, too.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", metavar="", help="Print JSON instead of a table.")] = False,
) -> None:
    """List the models that ship: how far they look ahead, and what they are for.

    **Examples**

    pcgan models

    pcgan models --tables --json
    """
    from pcgan.checkpoint import CheckpointError, shipped_models, table_models

    try:
        rows = [_row(path, "replay") for path in shipped_models().values()]
        rows += [_row(path, "tables") for path in table_models().values()] if tables else []
    except CheckpointError as error:
        fail(str(error))
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        _print_rows(rows)


@app.command(rich_help_panel=MODELS)
def train(
    method: Annotated[str, typer.Option(metavar="METHOD", help="sgan, srlstm, psgan or pcgan.")],
    data: Annotated[TrainingData, typer.Option(help="Scenes of pedestrians, clips with a vehicle, or drives.")],
    leave_out: Annotated[
        str | None, typer.Option(metavar="SCENE", help="Keep this scene of eth_ucy for the test: eth, hotel, ...")
    ] = None,
    recipe: Annotated[RecipeName, typer.Option(help="As published, or the strongest we found.")] = RecipeName.best,
    dt: Annotated[
        float | None, typer.Option(metavar="S", help="Step of drives, 0.1 or 0.4 s. [default: 0.1]", show_default=False)
    ] = None,
    vehicle: Annotated[
        bool, typer.Option("--vehicle/--no-vehicle", help="Whether pcgan is told of the vehicle.")
    ] = True,
    folder: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Checkpoint and curve go here.")] = Path(
        "runs"
    ),
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="Of the checkpoint. [default: such as pcgan_eth_ucy_hotel]")
    ] = None,
    windows: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE.npz", help="Learn from a tracker's windows of drives, too (pcgan windows)."),
    ] = None,
    trajectories: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE.csv", help="Learn from trajectories of your own, too (CSV or Parquet)."),
    ] = None,
    start_from: Annotated[Path | None, typer.Option(metavar="FILE", help="Fine-tune this checkpoint.")] = None,
    epochs: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Passes over the windows. [default: the recipe's]")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Of weights, order and noise.")] = 0,
) -> None:
    """Train a method on a data set; a run that was stopped goes on where it was.

    **Examples**

    pcgan train --method pcgan --data eth_ucy --leave-out hotel

    pcgan train --method sgan --data vci -o runs/baselines

    pcgan train --method pcgan --data drives --windows windows/tracked_10hz.npz
    """
    from pcgan.checkpoint import CheckpointError
    from pcgan.clips import ClipError, DataNotFound
    from pcgan.forecast import EXTRAPOLATIONS
    from pcgan.recipes import LEARNED, recipe_for
    from pcgan.train import TrainConfig
    from pcgan.train import train as train_model
    from pcgan.training_data import default_task, training_data
    from pcgan.windows_file import WindowsError

    if method in EXTRAPOLATIONS:
        fail(f"{method} is an extrapolation: there is nothing to train; methods that learn are {', '.join(LEARNED)}")
    if dt is not None and data is not TrainingData.drives:
        fail(f"--dt goes with --data drives: {data} has a step of its own")
    if dt is not None and dt not in DRIVE_STEPS_S:
        fail(f"--dt is one of {', '.join(map(str, DRIVE_STEPS_S))}, got {dt:g}")
    task = default_task(data, dt)
    rate = None if task.dt_s == default_task(data).dt_s else f"{1 / task.dt_s:g}hz"
    task = replace(task, uses_vehicle=task.uses_vehicle and vehicle)
    files = tuple(windows or ())
    lineage: dict[str, object] = {
        "method": method,
        "recipe_name": recipe.value,
        "data": data.value,
        "leave_out": leave_out,
        "windows": [file.name for file in files],
        "trajectories": [file.name for file in trajectories or ()],
    }
    try:
        chosen = recipe_for(method, recipe, task)
        chosen = chosen if epochs is None else replace(chosen, epochs=epochs)
        config = TrainConfig(
            chosen,
            folder,
            name or _run_name(method if vehicle else f"{method}_no_vehicle", recipe, data, leave_out, rate),
            seed=seed,
            start_from=start_from,
            lineage=lineage,
        )
        learnt_from = training_data(
            data,
            chosen,
            leave_out=leave_out,
            window_files=files,
            trajectory_files=tuple(trajectories or ()),
            seed=seed,
        )
        typer.echo(train_model(config, learnt_from, errors))
    except (DataNotFound, ClipError, WindowsError, CheckpointError, ValueError) as error:
        fail(str(error))
    except OSError as error:
        fail(f"{folder} cannot be written: {error.strerror or error}")


@app.command(rich_help_panel=MODELS)
def windows(
    folder: Annotated[
        Path, typer.Option("--output", "-o", metavar="FOLDER", help="The windows go here, a file per task.")
    ] = Path("windows"),
    seeds: Annotated[int, typer.Option(min=1, metavar="N", help="Drives per clip and vehicle.")] = 2,
) -> None:
    """Make training windows: drives simulated from the training clips, tracked by the real tracker.

    **Examples**

    pcgan windows

    pcgan windows -o windows --seeds 3
    """
    from pcgan.clips import ClipError, DataNotFound
    from pcgan.windows_file import WindowsError
    from replay.simulator import SimulationError
    from replay.training_windows import make_windows

    with progress() as bar:
        task = bar.add_task("tracking drives", total=None)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            counts = make_windows(
                folder, seeds, progress=lambda done, total: bar.update(task, completed=done, total=total)
            )
        except (ClipError, DataNotFound, SimulationError, WindowsError) as error:
            fail(str(error))
        except OSError as error:
            fail(f"{folder} cannot be written: {error.strerror or error}")
    for path, count in counts.items():
        typer.echo(f"{path}: {count} windows")


@app.command(rich_help_panel=MODELS)
def evaluate(
    data: Annotated[
        EvaluationData, typer.Option(metavar="DATA", help="Test scenes of eth_ucy, vci or drives, or all.")
    ] = EvaluationData.all,
    methods: Annotated[
        str | None, typer.Option(metavar="NAME,NAME", help="Methods, with commas between. [default: all]")
    ] = None,
    runs: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Checkpoints of your own runs. [default: those that ship]")
    ] = None,
    as_json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the results as JSON.")] = None,
    markdown: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the tables as Markdown.")] = None,
    html: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the tables as HTML.")] = None,
    note: Annotated[str, typer.Option(metavar="TEXT", help="Why the test scenes were looked at.")] = "",
) -> None:
    """Score the methods on the test scenes and set the figures beside the paper's.

    **Examples**

    pcgan evaluate --data eth_ucy --note "figures for the README"

    pcgan evaluate --data vci --methods cvm,pcgan --runs runs --json vci.json
    """
    from pcgan import evaluation
    from pcgan.checkpoint import CheckpointError
    from pcgan.clips import ClipError, DataNotFound
    from pcgan.report_style import ReportError

    refuse_unwritable(as_json, markdown, html)
    chosen = tuple(part.strip() for part in methods.split(",") if part.strip()) if methods is not None else ()
    if methods is not None and not chosen:
        fail("--methods wants names with commas between, for example cvm,pcgan")
    if runs is not None and not runs.is_dir():
        fail(f"--runs wants the folder of your checkpoints, and {runs} is none")
    with progress() as bar:
        task = bar.add_task("evaluating", total=None)

        def on_progress(what: str, done: int, total: int) -> None:
            bar.update(task, description=what, completed=done, total=total)

        try:
            drives = None
            if data in (EvaluationData.drives, EvaluationData.all):
                from replay.training_windows import held_out_windows

                drives = held_out_windows(progress=lambda done, total: on_progress("simulating drives", done, total))
            results = evaluation.evaluate(data.value, chosen, runs, on_progress, drives=drives)
        except (DataNotFound, ClipError, CheckpointError, ValueError) as error:
            fail(str(error))
    evaluation.show(results, console(minimum_width=140))
    writers = ((evaluation.write_json, as_json), (evaluation.write_markdown, markdown), (evaluation.write_html, html))
    try:
        evaluation.append_record(results, note)  # before the files: the look has happened, whatever becomes of them
        for write, path in writers:
            if path is not None:
                write(results, path)
                typer.echo(f"wrote {path}")
    except (ReportError, OSError) as error:
        fail(f"the results cannot be written: {error}")


def _run_name(method: str, recipe: RecipeName, data: TrainingData, leave_out: str | None, rate: str | None) -> str:
    """Returns what tells a run from its neighbours in a folder, e.g. pcgan_paper_eth_ucy_hotel."""
    paper = "paper" if recipe is RecipeName.paper else None
    scenes = leave_out.replace(",", "_") if leave_out else None
    return "_".join(part for part in (method, paper, data.value, scenes, rate) if part)


def _row(path: Path, use: str) -> dict[str, Any]:
    """Returns what there is to say of a checkpoint, from its header."""
    from pcgan.checkpoint import describe, find_model, sha256

    found = describe(path)
    config, training = found.config, found.training
    pooling = getattr(config, "pooling", None)  # tells PSGAN from PCGAN, which are one network otherwise
    return {
        "name": path.stem,
        "use": use,
        "default": path == find_model(None),
        "method": training.get("method") or ("psgan" if pooling == "social" else found.network),
        "recipe": getattr(config, "recipe", None),
        "dt_s": config.dt_s,
        "observed_steps": config.observed_steps,
        "predicted_steps": config.predicted_steps,
        "horizon_s": round(found.horizon_s, 6),
        "uses_vehicle": found.uses_vehicle,
        "data": training.get("data"),
        "leave_out": training.get("leave_out"),
        "size_bytes": path.stat().st_size,
        "sha256": sha256(path),
        "path": str(path),
    }


def _print_rows(rows: list[dict[str, Any]]) -> None:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD)
    for column, justify in (
        ("name", "left"),
        ("method", "left"),
        ("recipe", "left"),
        ("step s", "right"),
        ("ahead s", "right"),
        ("vehicle", "left"),
        ("kB", "right"),
        ("what for", "left"),
    ):
        table.add_column(column, justify=justify, no_wrap=True)  # type: ignore[arg-type]
    for row in rows:
        table.add_row(
            row["name"],
            row["method"],
            row["recipe"] or "",
            f"{row['dt_s']:.3g}",
            f"{row['horizon_s']:.3g}",
            "yes" if row["uses_vehicle"] else "no",
            f"{row['size_bytes'] / 1000:.0f}",
            _purpose(row),
        )
    console(minimum_width=140).print(table)


def _purpose(row: dict[str, Any]) -> str:
    if row["use"] == "replay":
        return "replays, the default" if row["default"] else "replays"
    tested = f", tested on {row['leave_out']}" if row["leave_out"] else ""
    return f"table of {row['data']}{tested}" if row["data"] else "tables"
