"""Training learns, is repeatable, goes on where it stopped, and leaves something usable when stopped."""

import csv
import json
from dataclasses import replace
from io import StringIO
from itertools import pairwise

import numpy as np
import pytest
import torch
from rich.console import Console
from safetensors import safe_open

from pcgan import checkpoint, train
from pcgan.batches import Augmentation
from pcgan.checkpoint import CheckpointError
from pcgan.dataset import WindowSpec, clip_windows, concatenate
from pcgan.forecast import Extrapolation
from pcgan.learners import LossWeights
from pcgan.methods import load_method
from pcgan.model import ModelConfig
from pcgan.recipes import Recipe, Task, recipe_for
from pcgan.scores import quick_scores
from pcgan.sgan import SganConfig
from pcgan.sr_lstm import SrLstmConfig
from pcgan.train import TrainConfig
from pcgan.training_data import TrainData

SPEC = WindowSpec(8, 12, 0.1, 0.2)
SMALL = {"hidden": 8, "embedding": 8, "mlp": 16, "components": 3, "dt_s": 0.4}
BEST = Recipe(
    ModelConfig(**SMALL), epochs=3, learning_rate=3e-3, batch_pedestrians=8, one_cycle=True, ema=0.9,
    augmentation=Augmentation(0.02, 0.3, 0.2, 0.1), share=0.8,
)  # fmt: skip
PAPER = Recipe(
    ModelConfig(**SMALL, recipe="paper", pooling="social"), epochs=3, batch_pedestrians=8,
    loss=LossWeights(0.1, 0.0, 1.0, adversarial_from=1),
)  # fmt: skip
SGAN = Recipe(SganConfig(pooling_hidden=16, mlp=16), epochs=3, batch_pedestrians=8, complete_only=True)
SR_LSTM = Recipe(SrLstmConfig(hidden=8, embedding=8), epochs=3, batch_pedestrians=8, complete_only=True)
RECIPES = {"best": BEST, "adversarial": PAPER, "sgan": SGAN, "srlstm": SR_LSTM}
every_recipe = pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)


@pytest.fixture
def quiet():
    return Console(file=StringIO(), width=500)


@pytest.fixture
def data(make_windows):
    training = concatenate([make_windows((3, 1, 2, 4), seed=1), make_windows((2, 3), gaps=True, seed=2)])
    return TrainData(training, np.full(6, 0.9), {"made": make_windows((2, 3), seed=9)})


@pytest.fixture
def make_config(tmp_path):
    def make(recipe=BEST, folder="run", **options):
        return TrainConfig(recipe, tmp_path / folder, **({"seed": 4} | options))

    return make


@pytest.fixture
def stop_at(monkeypatch):
    """Makes the n-th batch from now end in Ctrl-C; without a number, none."""
    real = train.augment

    def stop(number=None):
        calls = []

        def counted(*args):
            calls.append(1)
            if len(calls) == number:
                raise KeyboardInterrupt
            return real(*args)

        monkeypatch.setattr(train, "augment", counted)

    return stop


def weights(path):
    return checkpoint.load(path).tensors


def curve_of(config):
    return list(csv.DictReader((config.output_dir / f"{config.name}_curve.csv").read_text().splitlines()))


# --- learning --------------------------------------------------------------------------------------------------------


def test_tiny_set_is_learnt_by_heart(make_clip, make_config, quiet):
    """Curving walkers, far better than any extrapolation of their velocity."""
    windows = clip_windows(make_clip(pedestrians=5, frames=60, seed=1, turn_radps=1.0), SPEC)
    recipe = replace(
        recipe_for("pcgan", "best", Task(dt_s=0.1, uses_vehicle=True)),
        epochs=60, learning_rate=1e-2, ema=0.9, augmentation=Augmentation(), loss=LossWeights(path=100.0),
    )  # fmt: skip
    data = TrainData(windows, np.ones(int(windows.scene[-1]) + 1), {"itself": windows})
    path = train.train(make_config(recipe), data, quiet)
    learnt = quick_scores(load_method(path), windows)
    straight = quick_scores(Extrapolation("weighted", 12, 0.1).fitted(windows), windows)
    assert learnt.ade < 0.4 * straight.ade
    assert learnt.fde < 0.4 * straight.fde
    assert learnt.nll < straight.nll - 1


@every_recipe
def test_every_method_is_trained_and_predicts(make_config, data, quiet, recipe):
    path = train.train(make_config(recipe, name="made"), data, quiet)
    _, content = checkpoint.load_network(path)
    assert content.config == recipe.network
    assert content.training["epochs_done"] == 3
    assert content.training["calibrated"]
    assert content.training["validation"]["made"]["pedestrians"] == 5
    assert np.isfinite(quick_scores(load_method(path), data.validation["made"]).nll)


# --- repeatable ------------------------------------------------------------------------------------------------------


@every_recipe
def test_equal_seeds_give_equal_bytes(make_config, data, quiet, recipe):
    """Wherever they go, and whatever torch's global generator has been up to."""
    first = train.train(make_config(recipe), data, quiet)
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(99)
        again = train.train(make_config(recipe, "again"), data, quiet)
    other = train.train(make_config(recipe, "other", seed=5), data, quiet)
    assert first.read_bytes() == again.read_bytes()
    assert first.read_bytes() != other.read_bytes()


def test_every_epoch_varies_the_windows_anew(make_config, data, quiet, monkeypatch):
    """With the same scenes in one batch: they are turned, mirrored and stretched by other draws every time."""
    seen, real = [], train.augment

    def recorded(*args):
        varied = real(*args)
        seen.append(varied.observation.observed.norm(dim=-1).flatten().sort().values)
        return varied

    monkeypatch.setattr(train, "augment", recorded)
    data.share[:] = 1.0
    train.train(make_config(replace(BEST, batch_pedestrians=1000)), data, quiet)
    assert len(seen) == BEST.epochs
    assert all((a - b).abs().max() > 0.01 for a, b in pairwise(seen))


def test_scene_that_is_never_drawn_is_not_learnt_from(make_config, data, quiet):
    """Its positions are not even numbers."""
    data.training.observed[data.training.scene == 2] = np.nan
    data.share[2] = 0.0
    path = train.train(make_config(), data, quiet)
    assert all(tensor.isfinite().all() for tensor in weights(path).values())


def test_batch_of_unknown_futures_is_passed_over(make_config, data, quiet):
    data.training.future[data.training.scene != 0] = np.nan
    path = train.train(make_config(replace(BEST, share=1.0, batch_pedestrians=1)), data, quiet)
    assert all(tensor.isfinite().all() for tensor in weights(path).values())


# --- stopping and going on -------------------------------------------------------------------------------------------


@every_recipe
def test_interrupted_run_goes_on_as_if_it_had_not_stopped(make_config, data, quiet, stop_at, recipe):
    """Ctrl-C reaches the caller; the last saved epoch's checkpoint is there, and the rest gives the same bytes."""
    stop_at()
    whole, config = train.train(make_config(recipe, "whole"), data, quiet), make_config(recipe)
    per_epoch = train._batches_per_epoch(config, data)
    assert per_epoch >= 2
    stop_at(2 * per_epoch)
    with pytest.raises(KeyboardInterrupt):
        train.train(config, data, quiet)
    _, content = checkpoint.load_network(config.path)
    done = content.training["epochs_done"]
    assert 1 <= done < 3
    assert "calibrated" not in content.training
    assert f"stopped in epoch {done + 1} of 3; {config.path} holds what was reached" in quiet.file.getvalue()
    stop_at()
    assert train.train(config, data, quiet).read_bytes() == whole.read_bytes()
    assert curve_of(config) == curve_of(make_config(recipe, "whole"))
    assert [row["epoch"] for row in curve_of(config)] == ["1", "2", "3"]


def test_stop_between_validations_goes_on_from_the_last_one(make_config, data, quiet, stop_at):
    """Of 25 epochs every other one ends in a validation, and the last."""
    recipe = replace(BEST, epochs=25, batch_pedestrians=40, share=1.0)
    stop_at()
    whole, config = train.train(make_config(recipe, "whole"), data, quiet), make_config(recipe)
    wanted = [*map(str, range(2, 25, 2)), "25"]
    assert [row["epoch"] for row in curve_of(make_config(recipe, "whole"))] == wanted
    assert train._batches_per_epoch(config, data) == 1
    stop_at(6)  # five epochs are complete, four are saved
    with pytest.raises(KeyboardInterrupt):
        train.train(config, data, quiet)
    assert checkpoint.load(config.path).training["epochs_done"] == 4
    stop_at()
    assert train.train(config, data, quiet).read_bytes() == whole.read_bytes()
    assert [row["epoch"] for row in curve_of(config)] == wanted


MOMENTS = [("_validate", 2), ("_append_curve", 2), ("_save_weights", 2), ("_save_weights", 3), ("_save_state", 3),
           ("_calibrate", 1)]  # fmt: skip


@pytest.mark.parametrize(("part", "call"), MOMENTS)
def test_stop_at_any_moment_of_saving_loses_nothing(make_config, data, quiet, monkeypatch, part, call):
    """The curve, the weights and the state are written one after the other: none is relied on without the others."""
    whole, config = train.train(make_config(folder="whole"), data, quiet), make_config()
    real, calls = getattr(train, part), []

    def stop(*args):
        calls.append(1)
        if len(calls) == call:
            raise KeyboardInterrupt
        return real(*args)

    with monkeypatch.context() as patched:
        patched.setattr(train, part, stop)
        with pytest.raises(KeyboardInterrupt):
            train.train(config, data, quiet)
    checkpoint.load_network(config.path)
    assert train.train(config, data, quiet).read_bytes() == whole.read_bytes()
    assert curve_of(config) == curve_of(make_config(folder="whole"))


def test_stop_in_the_first_epoch_leaves_nothing_in_the_way(make_config, data, quiet, stop_at):
    stop_at()
    whole, config = train.train(make_config(folder="whole"), data, quiet), make_config()
    stop_at(1)
    with pytest.raises(KeyboardInterrupt):
        train.train(config, data, quiet)
    assert "stopped in epoch 1 of 3; nothing was saved yet" in quiet.file.getvalue()
    assert not config.path.exists()
    stop_at()
    assert train.train(config, data, quiet).read_bytes() == whole.read_bytes()


def test_complete_run_is_left_alone(make_config, data, quiet, stop_at):
    config = make_config()
    done = train.train(config, data, quiet).read_bytes()
    stop_at(1)
    assert train.train(config, data, quiet).read_bytes() == done
    config.path.unlink()  # even its weights come back, from the state
    assert train.train(config, data, quiet).read_bytes() == done


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"recipe": replace(BEST, learning_rate=1e-4)}, "recipe"),
        ({"recipe": replace(BEST, loss=LossWeights(path=1.0))}, "recipe"),
        ({"recipe": replace(BEST, epochs=4)}, "recipe"),
        ({"recipe": replace(BEST, network=ModelConfig(**SMALL, pooling="none"))}, "network"),
        ({"recipe": SGAN}, "recipe"),
        ({"seed": 5}, "seed"),
        ({"lineage": {"data": "vci"}}, "data"),
    ],
)
def test_other_settings_do_not_resume(make_config, data, quiet, change, named):
    train.train(make_config(lineage={"data": "drives", "windows": ["a.npz"]}), data, quiet)
    other = make_config(**({"lineage": {"data": "drives", "windows": ["a.npz"]}} | change))
    with pytest.raises(CheckpointError, match=rf"run with other settings \(.*{named}.*\); choose another folder"):
        train.train(other, data, quiet)


def test_same_settings_resume_with_their_lineage(make_config, data, quiet, stop_at):
    config = make_config(lineage={"data": "drives", "leave_out": None, "windows": ["a.npz", "b.npz"]})
    stop_at(train._batches_per_epoch(config, data) + 2)
    with pytest.raises(KeyboardInterrupt):
        train.train(config, data, quiet)
    stop_at()
    content = checkpoint.load(train.train(config, data, quiet))
    assert content.training["windows"] == ["a.npz", "b.npz"]
    assert content.training["recipe"]["learning_rate"] == BEST.learning_rate


def test_runs_of_other_names_share_a_folder(make_config, data, quiet):
    first, second = make_config(name="first"), make_config(name="second", seed=5)
    for config in (first, second):
        assert train.train(config, data, quiet) == config.output_dir / f"{config.name}.safetensors"
    assert {file.name for file in first.output_dir.iterdir()} == {
        f"{name}{rest}" for name in ("first", "second") for rest in (".safetensors", "_state.safetensors", "_curve.csv")
    }


# --- what is saved ---------------------------------------------------------------------------------------------------


def test_curve_has_a_line_per_validation_and_a_column_per_figure(make_config, data, quiet):
    config = make_config(PAPER)
    path = train.train(config, data, quiet)
    rows = curve_of(config)
    assert [row["epoch"] for row in rows] == ["1", "2", "3"]
    assert [bool(row["adversarial"]) for row in rows] == [False, True, True]  # a column that comes later
    assert all(float(row["nll"]) and float(row["path_m"]) for row in rows)
    last = checkpoint.load(path).training["validation"]["made"]
    for figure, value in last.items():
        assert float(rows[-1][f"made_{figure}"]) == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("ema", [0.0, 0.5])
def test_average_over_the_run_is_what_is_saved(make_config, data, quiet, monkeypatch, ema):
    """By a plain loop over the weights after every step; decay 0 saves the last ones."""
    seen, real = [], train._Run.update_average

    def recorded(run, decay):
        seen.append({name: p.detach().clone() for name, p in run.generator.named_parameters()})
        real(run, decay)

    monkeypatch.setattr(train._Run, "update_average", recorded)
    config = make_config(replace(BEST, ema=ema))
    saved = weights(train.train(config, data, quiet))
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(config.seed)
        average = dict(BEST.learner().modules["generator"].named_parameters())
    for step, now in enumerate(seen, start=1):
        decay = min(ema, (1 + step) / (10 + step))
        average = {name: decay * average[name].detach() + (1 - decay) * now[name] for name in now}
    for name, mean in average.items():
        torch.testing.assert_close(saved[name], mean)
        assert torch.equal(saved[name], seen[-1][name]) == (ema == 0.0)


def test_widths_are_fitted_to_the_validation_windows(make_config, data, quiet):
    fitted = checkpoint.load(train.train(make_config(), data, quiet))
    assert fitted.tensors["log_sigma_shift"].any()
    without = checkpoint.load(train.train(make_config(folder="without"), replace(data, validation={}), quiet))
    assert not without.tensors["log_sigma_shift"].any()
    assert "calibrated" not in without.training
    for name, tensor in without.tensors.items():
        assert name == "log_sigma_shift" or torch.equal(tensor, fitted.tensors[name])


def test_checkpoint_says_what_it_comes_from_but_no_folder(make_config, data, quiet, tmp_path):
    path = train.train(make_config(lineage={"data": "vci"}), data, quiet)
    with safe_open(path, framework="np") as file:
        header = file.metadata()["pcgan"]
    assert str(tmp_path) not in header
    training = json.loads(header)["training"]
    assert training["data"] == "vci"
    assert training["seed"] == 4
    assert training["recipe"]["augmentation"]["noise_m"] == 0.02
    assert training["start_from"] is None


# --- fine-tuning -----------------------------------------------------------------------------------------------------


def test_fine_tuning_starts_from_the_given_weights(make_config, data, quiet):
    first = train.train(make_config(), data, quiet)
    recipe = replace(BEST, epochs=1, learning_rate=0.0)
    tuned = train.train(make_config(recipe, "tuned", start_from=first, seed=8), data, quiet)
    for name, tensor in weights(tuned).items():
        torch.testing.assert_close(tensor, weights(first)[name])
    assert checkpoint.load(tuned).training["start_from"] == checkpoint.sha256(first)
    moved = train.train(make_config(replace(BEST, epochs=1), "moved", start_from=first), data, quiet)
    assert any(not torch.equal(tensor, weights(first)[name]) for name, tensor in weights(moved).items())


def test_fine_tuning_of_another_network_is_refused(make_config, data, quiet):
    first = train.train(make_config(replace(BEST, epochs=1)), data, quiet)
    other = replace(BEST, network=replace(BEST.network, hidden=16))
    with pytest.raises(CheckpointError, match=r"model\.safetensors has .*hidden=8.* the run wants .*hidden=16"):
        train.train(make_config(other, "other", start_from=first), data, quiet)
    with pytest.raises(CheckpointError, match=r"has ModelConfig.* the run wants SganConfig"):
        train.train(make_config(SGAN, "sgan", start_from=first), data, quiet)
    with pytest.raises(CheckpointError, match=r"no checkpoint .*nowhere"):
        train.train(make_config(folder="none", start_from=first.with_name("nowhere")), data, quiet)


def test_one_cycle_rises_and_falls():
    factors = [train.one_cycle(f) for f in (0.0, 0.15, 0.3, 0.65, 1.0)]
    assert factors == pytest.approx([0.04, 0.52, 1.0, 0.5005, 0.001])


def test_learning_rates_follow_the_cycle(make_config, data, quiet, monkeypatch):
    """From the recipe's rate, also in a run that goes on."""
    rates, real = [], train._Run.set_rate

    def recorded(run, factor):
        real(run, factor)
        rates.append((factor, run.learner.optimisers[0].param_groups[0]["lr"]))

    monkeypatch.setattr(train._Run, "set_rate", recorded)
    train.train(make_config(), data, quiet)
    assert len(rates) > 3
    assert all(rate == pytest.approx(factor * BEST.learning_rate) for factor, rate in rates)
    assert max(factor for factor, _ in rates) > 0.5
