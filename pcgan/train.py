"""Training: one flat loop, seeded, resumable, on annotated clips, a tracker's windows, or both.

The loss is the negative log-likelihood of the mixtures (summed over the predicted steps, mean over pedestrians) plus
the distance of the most probable modal path, which is what a single-output error measures. Weights are averaged over
the run (EMA), and it is the average that is saved.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from pcgan import checkpoint
from pcgan.batches import Batch, augment, batches
from pcgan.checkpoint import CheckpointError
from pcgan.clips import load_clip
from pcgan.dataset import (
    VALIDATION_CLIPS,
    Windows,
    WindowSpec,
    clip_windows,
    concatenate,
    training_clip_names,
)
from pcgan.evaluate import Scores, extrapolation_scores, local_future, score
from pcgan.mixture_density import log_likelihood
from pcgan.modal_paths import modal_paths
from pcgan.model import Generator, ModelConfig
from pcgan.windows_file import load_windows

VALIDATION_NOISE_M = 0.06


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides what comes out of a training run."""

    output_dir: Path
    model: ModelConfig = field(default_factory=ModelConfig)
    name: str = "model"  # of the checkpoint in output_dir
    clips: bool = True  # train on the annotated DUT clips
    windows: tuple[Path, ...] = ()  # and on these .npz files of a tracker's windows
    data_dir: Path | None = None
    start_from: Path | None = None  # fine-tune this checkpoint instead of starting at random
    epochs: int = 30
    batch_pedestrians: int = 256
    learning_rate: float = 3e-3
    path_weight: float = 8.0  # of the most probable path's distance, per m and step
    ema: float = 0.999
    filtered_copies: int = 2  # per clip, as a tracker with noise of filter_noise_m would see it
    filter_noise_m: tuple[float, float] = (0.03, 0.10)
    noise_m: float = 0.01  # observation noise on annotated windows, up to
    stride_s: float = 0.2
    seed: int = 0

    @property
    def spec(self) -> WindowSpec:
        """How windows are cut for this model."""
        model = self.model
        return WindowSpec(model.observed_steps, model.predicted_steps, model.dt_s, self.stride_s)


@dataclass(frozen=True, eq=False)
class TrainData:
    """What a run learns from, and the sets it is judged on, by name; none of them holds a held-out clip."""

    training: Windows
    validation: dict[str, Windows]


def train(config: TrainConfig, data: TrainData | None = None, console: Console | None = None) -> Path:
    """Trains a generator and returns the path of its checkpoint, `<output_dir>/<name>.safetensors`.

    A run that stopped goes on where its last complete epoch ended, and then gives what it would have given without the
    stop. Ctrl-C ends it early and leaves the checkpoint of the last complete epoch (of the first one's beginning, if
    there was none). `<name>_curve.csv` gets a line per epoch. Runs on one torch thread.

    Raises DataNotFound if clips are wanted and missing, WindowsError for unusable window files, CheckpointError if
    `start_from` or the state to resume from does not fit.
    """
    torch.set_num_threads(1)  # batches are small: more threads wait for each other
    data = load_data(config) if data is None else data
    path, state_path = config.output_dir / f"{config.name}.safetensors", _state_path(config)
    model = _new_generator(config)
    optimiser = torch.optim.Adam(model.parameters(), lr=config.learning_rate)
    average = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    epoch = step = 0
    if state_path.exists():
        epoch, step = _restore(state_path, config, model, optimiser, average)
    total = config.epochs * sum(1 for _ in batches(data.training, config.batch_pedestrians))
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    console = console or Console(stderr=True)
    with Progress(*columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("training", total=total, completed=step)
        try:
            while epoch < config.epochs:
                generator = torch.Generator().manual_seed(config.seed * 100_003 + epoch)
                losses = []
                for batch in batches(data.training, config.batch_pedestrians, generator):
                    varied = augment(batch, config.noise_m, config.model.dt_s, generator)
                    loss = _loss(model, varied, config.path_weight)
                    optimiser.zero_grad()
                    loss.backward()  # type: ignore[no-untyped-call]
                    torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
                    for group in optimiser.param_groups:
                        group["lr"] = config.learning_rate * one_cycle(step / total)
                    optimiser.step()
                    step += 1
                    decay = min(config.ema, (1 + step) / (10 + step))  # short runs forget their random start, too
                    for name, tensor in model.state_dict().items():
                        average[name].lerp_(tensor, 1 - decay)
                    losses.append(loss.item())
                    progress.advance(task)
                epoch += 1
                scores = _validate(config.model, average, data.validation)
                _append_curve(config, epoch, float(np.mean(losses)), scores)
                _save_state(config, model=model, optimiser=optimiser, average=average, epoch=epoch, step=step)
                _save_average(path, config, average, epoch, scores)
                progress.update(task, description=_describe(epoch, scores))
        except KeyboardInterrupt:
            progress.console.print(f"stopped in epoch {epoch + 1}; {path} is that of epoch {epoch}")
    if not path.exists():  # stopped in the first epoch, or removed after the last
        _save_average(path, config, average, epoch, {})
    return path


def load_data(config: TrainConfig) -> TrainData:
    """Returns the windows a run needs, split by clip. Validation: clean clips, filtered ones, the tracker's windows."""
    if not config.clips and not config.windows:
        raise ValueError("nothing to train on: neither clips nor window files")
    training: list[Windows] = []
    validation: dict[str, Windows] = {}
    if config.clips:
        rng = np.random.default_rng(config.seed)
        for name in training_clip_names(config.data_dir):
            clip = load_clip(name, config.data_dir)
            training.append(clip_windows(clip, config.spec))
            for _ in range(config.filtered_copies):
                training.append(clip_windows(clip, config.spec, float(rng.uniform(*config.filter_noise_m)), rng))
        clips = [load_clip(name, config.data_dir) for name in VALIDATION_CLIPS]
        rng = np.random.default_rng(12345)  # the same validation noise whatever the seed of the run
        validation["clean"] = concatenate([clip_windows(clip, config.spec) for clip in clips])
        noisy = [clip_windows(clip, config.spec, VALIDATION_NOISE_M, rng) for clip in clips]
        validation["filtered"] = concatenate(noisy)
    for file in config.windows:
        train_part, validation_part = load_windows(file, config.spec)
        training.append(train_part)
        if validation_part.known.any():
            validation[file.stem] = validation_part
    data = TrainData(concatenate(training), validation)
    if not data.training.known.any():
        raise ValueError("no training window has a known future; are the clips or drives long enough?")
    return data


def baselines(data: TrainData, dt_s: float) -> dict[str, dict[str, Scores]]:
    """Returns per validation set the scores of extrapolating the present velocity and the last displacement."""
    return {
        name: {
            "present velocity": extrapolation_scores(windows, dt_s),
            "last displacement": extrapolation_scores(windows, dt_s, last_displacement=True),
        }
        for name, windows in data.validation.items()
    }


def one_cycle(fraction: float, warm_up: float = 0.3) -> float:
    """Returns the learning rate's factor at a fraction of the run: cosine from 0.04 up to 1, then down to 0.001."""
    if fraction < warm_up:
        return 0.04 + (1 - 0.04) * 0.5 * (1 - math.cos(math.pi * fraction / warm_up))
    return 0.001 + (1 - 0.001) * 0.5 * (1 + math.cos(math.pi * (fraction - warm_up) / (1 - warm_up)))


def _loss(model: Generator, batch: Batch, path_weight: float) -> Tensor:
    """Returns the loss of a batch: a scalar, in nats per pedestrian."""
    mixture = model.local_mixture(batch.observed, batch.velocity, batch.neighbours, batch.vehicle)
    target = local_future(model, batch.observed, batch.velocity, batch.future)  # (S, A, P, 2)
    known = batch.known
    likelihood = log_likelihood(mixture, target)[known].sum(dim=-1).mean()
    paths = modal_paths(mixture.weights[known], mixture.means[known], model.config.eps_m)
    distance = (paths.points[:, 0] - target[known]).square().sum(dim=-1).add(1e-6).sqrt()  # (B, P)
    return path_weight * distance.sum(dim=-1).mean() - likelihood


def _new_generator(config: TrainConfig) -> Generator:
    if config.start_from is not None:
        model, start = checkpoint.load_generator(config.start_from)
        if start.config != config.model:
            raise CheckpointError(f"{config.start_from} has {start.config}, the run wants {config.model}")
        return model.train()
    with torch.random.fork_rng(devices=()):  # torch's own initialisers draw from the global generator only
        torch.manual_seed(config.seed)
        return Generator(config.model)


def _validate(config: ModelConfig, average: Mapping[str, Tensor], sets: Mapping[str, Windows]) -> dict[str, Scores]:
    model = Generator(config).eval()
    model.load_state_dict(average)
    return {name: score(model, windows) for name, windows in sets.items()}


def _save_average(
    path: Path, config: TrainConfig, average: Mapping[str, Tensor], epoch: int, scores: Mapping[str, Scores]
) -> None:
    checkpoint.save(path, config.model, average, _summary(config) | {
        "epochs_done": epoch, "validation": {name: asdict(s) for name, s in scores.items()},
    })  # fmt: skip


def _summary(config: TrainConfig) -> dict[str, object]:
    """What decides a run, without this machine's folders."""
    values = asdict(config)
    for name in ("output_dir", "data_dir", "model"):
        del values[name]
    values["windows"] = [file.name for file in config.windows]
    values["start_from"] = checkpoint.sha256(config.start_from) if config.start_from else None
    values["filter_noise_m"] = list(config.filter_noise_m)
    return values


def _state_path(config: TrainConfig) -> Path:
    return config.output_dir / f"{config.name}_state.safetensors"


def _save_state(
    config: TrainConfig,
    *,
    model: Generator,
    optimiser: torch.optim.Adam,
    average: Mapping[str, Tensor],
    epoch: int,
    step: int,
) -> None:
    tensors = {f"model.{name}": tensor for name, tensor in model.state_dict().items()}
    tensors |= {f"average.{name}": tensor for name, tensor in average.items()}
    for index, entries in optimiser.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": tensor for name, tensor in entries.items()}
    checkpoint.save(_state_path(config), config.model, tensors, _summary(config) | {"epoch": epoch, "step": step})


def _restore(
    path: Path, config: TrainConfig, model: Generator, optimiser: torch.optim.Adam, average: dict[str, Tensor]
) -> tuple[int, int]:
    """Loads a run's state into its parts and returns the epoch and step it had reached."""
    state = checkpoint.load(path)
    then = {name: value for name, value in state.training.items() if name not in ("epoch", "step")}
    now = _summary(config)
    if state.config != config.model or then != now:
        differing = sorted(name for name in now if then.get(name) != now[name]) or ["model"]
        raise CheckpointError(f"{path} is of a run with other settings ({', '.join(differing)}); choose another folder")
    tensors: dict[str, dict[str, Tensor]] = {"model": {}, "average": {}, "adam": {}}
    for name, tensor in state.tensors.items():
        part, _, rest = name.partition(".")
        tensors[part][rest] = tensor
    model.load_state_dict(tensors["model"])
    average.update(tensors["average"])
    entries: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors["adam"].items():
        index, _, rest = name.partition(".")
        entries.setdefault(int(index), {})[rest] = tensor
    optimiser.load_state_dict({"state": entries, "param_groups": optimiser.state_dict()["param_groups"]})
    return int(state.training["epoch"]), int(state.training["step"])


def _append_curve(config: TrainConfig, epoch: int, loss: float, scores: Mapping[str, Scores]) -> None:
    path = config.output_dir / f"{config.name}_curve.csv"
    row: dict[str, float] = {"epoch": epoch, "loss": loss}
    for name, s in scores.items():
        row |= {f"{name}_ade": s.ade, f"{name}_fde": s.fde, f"{name}_nll": s.nll, f"{name}_paths": s.mean_paths}
    config.output_dir.mkdir(parents=True, exist_ok=True)
    earlier = path.read_text().splitlines()[:epoch] if epoch > 1 and path.exists() else [",".join(row)]
    line = ",".join(f"{value:.6g}" for value in row.values())
    path.write_text("\n".join([*earlier, line]) + "\n")


def _describe(epoch: int, scores: Mapping[str, Scores]) -> str:
    parts = [f"{name} {s.ade:.3f}/{s.fde:.3f} nll {s.nll:.2f}" for name, s in scores.items()]
    return f"epoch {epoch}: " + ", ".join(parts)
