"""Training: one flat loop for every method, seeded and resumable.

What is minimised is the learner's business (`learners.py`); what is learnt from, the data's (`training_data.py`). The
last epoch's weights are saved, or their average over the run (EMA) where the recipe says so: no epoch is picked. At the
end the widths of the predicted distributions are fitted to the validation windows (`calibration.py`).
"""

import copy
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor, nn

from pcgan import checkpoint
from pcgan.batches import augment, batches
from pcgan.calibration import calibrate
from pcgan.checkpoint import CheckpointError
from pcgan.dataset import Windows, concatenate
from pcgan.learners import Learner
from pcgan.methods import method_of
from pcgan.recipes import Recipe
from pcgan.scores import QuickScores, quick_scores
from pcgan.training_data import TrainData

VALIDATIONS = 10  # a run looks at its validation windows about this often


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides what comes out of a training run, but for the windows themselves."""

    recipe: Recipe
    output_dir: Path
    name: str = "model"  # of the checkpoint in output_dir
    seed: int = 0
    start_from: Path | None = None  # fine-tune this checkpoint instead of starting at random
    lineage: dict[str, object] = field(default_factory=dict)  # data, method, recipe: for people and model cards

    @property
    def path(self) -> Path:
        """Where the weights go."""
        return self.output_dir / f"{self.name}.safetensors"


class _Run:
    """What changes while a run goes on: networks, optimisers, the average, and how far it has come."""

    def __init__(self, config: TrainConfig):
        with torch.random.fork_rng(devices=()):  # torch's own initialisers draw from the global generator only
            torch.manual_seed(config.seed)
            self.learner: Learner = config.recipe.learner()
        self.epoch = self.step = 0
        if config.start_from is not None:
            network, start = checkpoint.load_network(config.start_from)
            if start.config != config.recipe.network:
                raise CheckpointError(f"{config.start_from} has {start.config}, the run wants {config.recipe.network}")
            self.generator.load_state_dict(network.state_dict())
        self.average = copy.deepcopy(self.generator)

    @property
    def generator(self) -> nn.Module:
        return self.learner.modules["generator"]

    def set_rate(self, factor: float) -> None:
        """Sets all learning rates to a factor of what they began with."""
        for optimiser in self.learner.optimisers:
            for group in optimiser.param_groups:
                group["lr"] = group.setdefault("initial_lr", group["lr"]) * factor

    def update_average(self, decay: float) -> None:
        decay = min(decay, (1 + self.step) / (10 + self.step))  # short runs forget their random start, too
        with torch.no_grad():
            for mean, now in zip(self.average.parameters(), self.generator.parameters(), strict=True):
                mean.lerp_(now, 1 - decay)

    def tensors(self) -> dict[str, Tensor]:
        """Returns everything that a stopped run needs to go on."""
        tensors = {f"modules.{name}": tensor for name, tensor in self.learner.modules.state_dict().items()}
        tensors |= {f"average.{name}": tensor for name, tensor in self.average.state_dict().items()}
        for number, optimiser in enumerate(self.learner.optimisers):
            for index, entries in optimiser.state_dict()["state"].items():
                tensors |= {f"optimiser.{number}.{index}.{name}": tensor for name, tensor in entries.items()}
        return tensors

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        def part(prefix: str) -> dict[str, Tensor]:
            return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}

        self.learner.modules.load_state_dict(part("modules."))
        self.average.load_state_dict(part("average."))
        for number, optimiser in enumerate(self.learner.optimisers):
            entries: dict[int, dict[str, Tensor]] = {}
            for name, tensor in part(f"optimiser.{number}.").items():
                index, _, rest = name.partition(".")
                entries.setdefault(int(index), {})[rest] = tensor
            optimiser.load_state_dict({"state": entries, "param_groups": optimiser.state_dict()["param_groups"]})


def train(config: TrainConfig, data: TrainData, console: Console | None = None) -> Path:
    """Trains a network and returns the path of its checkpoint, `<output_dir>/<name>.safetensors`.

    A run that stopped goes on after the last epoch that ended in a validation, and then gives what it would have given
    without the stop; one that is complete is left alone. Ctrl-C ends it early, with KeyboardInterrupt: the checkpoint
    of the last validation stays. `<name>_curve.csv` gets a line per validation. Runs on one thread.

    Raises CheckpointError if `start_from`, or the state to resume from, does not fit.
    """
    torch.set_num_threads(1)  # batches are small: more threads wait for each other
    config.output_dir.mkdir(parents=True, exist_ok=True)
    recipe, run = config.recipe, _Run(config)
    state_path = config.output_dir / f"{config.name}_state.safetensors"
    if state_path.exists():
        _restore(state_path, config, run)
    total = recipe.epochs * _batches_per_epoch(config, data)
    every = max(1, recipe.epochs // VALIDATIONS)
    console = console or Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(f"training {config.name}", total=recipe.epochs, completed=run.epoch)
        try:
            while run.epoch < recipe.epochs:
                losses = _epoch(config, data, run, total)
                run.epoch += 1
                progress.advance(task)
                if run.epoch % every == 0 or run.epoch == recipe.epochs:
                    scores = _validate(run, data.validation)
                    _append_curve(config, run.epoch, losses, scores)
                    _save_weights(config, run, scores)
                    _save_state(state_path, config, run)  # last: what it promises is there
                    progress.update(task, description=_describe(config.name, scores))
            if not config.path.exists():
                _save_weights(config, run, _validate(run, data.validation))
        except KeyboardInterrupt:
            left = f"{config.path} holds what was reached" if config.path.exists() else "nothing was saved yet"
            progress.console.print(f"stopped in epoch {run.epoch + 1} of {recipe.epochs}; {left}")
            raise
    if data.validation and not checkpoint.load(config.path).training.get("calibrated"):
        _calibrate(config, data)
    return config.path


def one_cycle(fraction: float, warm_up: float = 0.3) -> float:
    """Returns the learning rate's factor at a fraction of the run: cosine from 0.04 up to 1, then down to 0.001."""
    if fraction < warm_up:
        return 0.04 + (1 - 0.04) * 0.5 * (1 - math.cos(math.pi * fraction / warm_up))
    return 0.001 + (1 - 0.001) * 0.5 * (1 + math.cos(math.pi * (fraction - warm_up) / (1 - warm_up)))


def _epoch(config: TrainConfig, data: TrainData, run: _Run, total: int) -> dict[str, float]:
    """Goes through the training windows once; returns the mean of every loss."""
    recipe = config.recipe
    generator = torch.Generator().manual_seed(config.seed * 100_003 + run.epoch)
    sums: dict[str, list[float]] = {}
    for batch in batches(data.training, recipe.batch_pedestrians, generator, data.share):
        if not batch.known.any():
            continue
        varied = augment(batch, recipe.augmentation, recipe.network.dt_s, generator)
        if recipe.one_cycle:
            run.set_rate(one_cycle(min(1.0, run.step / total)))
        for name, loss in run.learner.step(varied, run.epoch, generator).items():
            sums.setdefault(name, []).append(loss)
        run.step += 1
        run.update_average(recipe.ema)
    return {name: float(np.mean(values)) for name, values in sums.items()}


def _batches_per_epoch(config: TrainConfig, data: TrainData) -> int:
    generator = torch.Generator().manual_seed(config.seed)
    return max(1, sum(1 for _ in batches(data.training, config.recipe.batch_pedestrians, generator, data.share)))


def _validate(run: _Run, sets: Mapping[str, Windows]) -> dict[str, QuickScores]:
    run.average.eval()
    method = method_of("validated", run.average)  # type: ignore[arg-type]
    return {name: quick_scores(method, windows, torch.Generator().manual_seed(0)) for name, windows in sets.items()}


def _calibrate(config: TrainConfig, data: TrainData) -> None:
    network, found = checkpoint.load_network(config.path)
    calibrate(network, concatenate(list(data.validation.values())))
    checkpoint.save(config.path, found.config, network.state_dict(), found.training | {"calibrated": True})


def _save_weights(config: TrainConfig, run: _Run, scores: Mapping[str, QuickScores]) -> None:
    validation = {name: asdict(score) for name, score in scores.items()}
    training = _summary(config) | {"epochs_done": run.epoch, "validation": validation}
    checkpoint.save(config.path, config.recipe.network, run.average.state_dict(), training)


def _summary(config: TrainConfig) -> dict[str, object]:
    """What decides a run, without this machine's folders."""
    start = checkpoint.sha256(config.start_from) if config.start_from else None
    recipe = {name: value for name, value in asdict(config.recipe).items() if name != "network"}
    return {"recipe": recipe, "seed": config.seed, "start_from": start, **config.lineage}


def _save_state(path: Path, config: TrainConfig, run: _Run) -> None:
    progress = {"epoch": run.epoch, "step": run.step}
    checkpoint.save(path, config.recipe.network, run.tensors(), _summary(config) | progress)


def _restore(path: Path, config: TrainConfig, run: _Run) -> None:
    state = checkpoint.load(path)
    then = {name: value for name, value in state.training.items() if name not in ("epoch", "step")}
    now = _summary(config)
    if state.config != config.recipe.network or then != now:
        differing = sorted(name for name in now if then.get(name) != now[name]) or ["network"]
        raise CheckpointError(f"{path} is of a run with other settings ({', '.join(differing)}); choose another folder")
    run.restore(state.tensors)
    run.epoch, run.step = int(state.training["epoch"]), int(state.training["step"])


def _append_curve(
    config: TrainConfig, epoch: int, losses: Mapping[str, float], scores: Mapping[str, QuickScores]
) -> None:
    """Adds a line; lines from epochs that a resumed run repeats go, and a column that comes later starts empty."""
    path = config.output_dir / f"{config.name}_curve.csv"
    row: dict[str, float] = {"epoch": epoch, **losses}
    for name, score in scores.items():
        row |= {f"{name}_{figure}": value for figure, value in asdict(score).items()}
    rows = [line for line in _curve(path) if int(float(line["epoch"])) < epoch] if path.exists() else []
    rows.append({name: f"{value:.6g}" for name, value in row.items()})
    names = list(dict.fromkeys(name for line in rows for name in line))
    lines = [",".join(names), *(",".join(line.get(name, "") for name in names) for line in rows)]
    path.write_text("\n".join(lines) + "\n")


def _curve(path: Path) -> Iterator[dict[str, str]]:
    header, *lines = path.read_text().splitlines()
    for line in lines:
        yield dict(zip(header.split(","), line.split(","), strict=True))


def _describe(name: str, scores: Mapping[str, QuickScores]) -> str:
    return f"training {name} " + ", ".join(f"{key} {s.ade:.3f}/{s.fde:.3f}" for key, s in scores.items())
