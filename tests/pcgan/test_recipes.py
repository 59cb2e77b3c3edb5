"""Which network a method's recipe builds, how it is trained, and that every one of them can be."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from pcgan.batches import Augmentation, augment, batches
from pcgan.learners import GeneratorLearner, LossWeights
from pcgan.learners_baselines import SganLearner, SrLstmLearner
from pcgan.model import ModelConfig
from pcgan.recipes import LEARNED, RECIPES, Task, recipe_for
from pcgan.sgan import SganConfig
from pcgan.sr_lstm import SrLstmConfig

DRIVES = Task(observed_steps=8, predicted_steps=12, dt_s=0.1, uses_vehicle=True)
EVERY = [(method, recipe) for method in LEARNED for recipe in RECIPES]


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize(("method", "pooling"), [("pcgan", "gvat"), ("psgan", "social")])
def test_generators_of_both_recipes(method, pooling, recipe):
    """PCGAN is PSGAN with attention and the vehicle."""
    found = recipe_for(method, recipe, DRIVES)
    assert found.network == ModelConfig(recipe=recipe, pooling=pooling, dt_s=0.1, uses_vehicle=method == "pcgan")
    without = recipe_for(method, recipe, replace(DRIVES, uses_vehicle=False))
    assert not without.network.uses_vehicle
    assert replace(without, network=found.network, augmentation=found.augmentation) == found
    assert without.augmentation.hide_vehicle == 0  # who has none cannot learn to do without
    assert (found.augmentation.hide_vehicle > 0) == (recipe == "best" and found.network.uses_vehicle)


def test_paper_trains_by_likelihood_first_and_then_against_a_discriminator():
    found = recipe_for("pcgan", "paper")
    assert (found.epochs, found.learning_rate, found.batch_pedestrians) == (100, 1e-3, 128)
    assert (found.loss.path, found.loss.adversarial) == (0, 1)
    assert 0 < found.loss.adversarial_from < found.epochs
    assert found.augmentation == Augmentation()
    assert (found.ema, found.reversed_share, found.one_cycle) == (0, 0, False)
    assert found.complete_only


def test_best_trains_by_likelihood_and_the_path_on_varied_windows():
    found = recipe_for("pcgan")
    assert found.loss.path > 0
    assert found.loss.adversarial == 0
    assert found.augmentation.noise_m > 0
    assert found.augmentation.forget > 0
    assert found.ema > 0
    assert not found.complete_only


@pytest.mark.parametrize(("method", "config"), [("sgan", SganConfig), ("srlstm", SrLstmConfig)])
def test_baselines_have_one_recipe(method, config):
    found = recipe_for(method, "best", DRIVES)
    assert found == recipe_for(method, "paper", DRIVES)
    assert found.network == config(dt_s=0.1)
    assert found.complete_only


@pytest.mark.parametrize(("method", "recipe"), EVERY)
def test_task_decides_steps_and_their_length(method, recipe):
    network = recipe_for(method, recipe, Task(observed_steps=5, predicted_steps=9, dt_s=0.2)).network
    assert (network.observed_steps, network.predicted_steps, network.dt_s) == (5, 9, 0.2)
    network = recipe_for(method, recipe).network
    assert (network.observed_steps, network.predicted_steps, network.dt_s) == (8, 12, 0.4)


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match=r"recipe must be one of .*got 'worst'"):
        recipe_for("pcgan", "worst")
    with pytest.raises(ValueError, match=r"no method 'lin' that learns; there are .*sgan.*srlstm.*psgan.*pcgan"):
        recipe_for("lin")


@pytest.mark.parametrize(("method", "recipe"), EVERY)
def test_every_recipe_can_be_learnt(method, recipe, make_windows):
    """A step on varied windows with gaps and vehicles changes the generator and gives finite losses."""
    found = recipe_for(method, recipe, Task(uses_vehicle=True))
    if method == "sgan":
        found = replace(found, network=replace(found.network, pooling_hidden=32))
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)
        learner = found.learner()
    assert type(learner) is {"sgan": SganLearner, "srlstm": SrLstmLearner}.get(method, GeneratorLearner)
    assert isinstance(learner.modules, nn.ModuleDict)
    assert len(learner.optimisers) == len(learner.modules)
    rates = {group["lr"] for optimiser in learner.optimisers for group in optimiser.param_groups}
    assert rates == {found.learning_rate}
    before = {name: p.clone() for name, p in learner.modules["generator"].named_parameters()}
    random = torch.Generator().manual_seed(0)
    (batch,) = batches(make_windows((3, 1, 4, 2, 5), gaps=False), 1000)
    varied = augment(batch, found.augmentation, 0.4, random)
    losses = learner.step(varied, found.epochs - 1, random)
    assert losses
    assert np.isfinite(list(losses.values())).all()
    assert ("discriminator" in losses) == (method == "sgan" or (recipe == "paper" and method != "srlstm"))
    changed = [name for name, p in learner.modules["generator"].named_parameters() if not torch.equal(p, before[name])]
    assert len(changed) > len(before) / 2
    assert all(p.isfinite().all() for p in learner.modules.parameters())


def test_fresh_weights_draw_on_torchs_global_generator():
    found = []
    for seed in (0, 0, 1):
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed)
            learner = replace(recipe_for("pcgan"), loss=LossWeights(adversarial=1.0)).learner()
        found.append(torch.cat([p.flatten() for p in learner.modules.parameters()]))
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])
