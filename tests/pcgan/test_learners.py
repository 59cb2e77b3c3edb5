"""One update of each network at a time: the likelihood first, and the discriminator only when its time has come."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pcgan.batches import batches
from pcgan.learners import GeneratorLearner, LossWeights
from pcgan.losses import likelihood_and_path

SMALL = {"hidden": 8, "embedding": 8, "mlp": 16, "components": 3, "dt_s": 0.4}
ADVERSARIAL = LossWeights(likelihood=0.1, path=0.0, adversarial=1.0, adversarial_from=2)


@pytest.fixture
def make_learner(make_generator):
    """Builds a learner with seeded weights."""

    def make(weights=ADVERSARIAL, learning_rate=1e-3, **config):
        generator = make_generator(**(SMALL | config))
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(1)
            return GeneratorLearner(generator, weights, learning_rate)

    return make


@pytest.fixture
def batch(make_windows):
    (batch,) = batches(make_windows((3, 1, 4, 2)), 1000)
    return batch


@pytest.fixture
def random():
    return torch.Generator().manual_seed(0)


def weights_of(learner, name):
    return torch.cat([p.detach().flatten().clone() for p in learner.modules[name].parameters()])


def moved(learner, name, before):
    return (weights_of(learner, name) - before).abs().max().item() > 0


def test_no_discriminator_without_its_weight(make_learner, batch, random):
    learner = make_learner(LossWeights())
    assert list(learner.modules) == ["generator"]
    assert len(learner.optimisers) == 1
    assert set(learner.step(batch, 50, random)) == {"nll", "path_m"}


def test_discriminator_takes_part_from_its_epoch_on(make_learner, batch, random):
    learner = make_learner()
    generator, discriminator = (weights_of(learner, name) for name in ("generator", "discriminator"))
    for epoch in (0, 1):
        assert set(learner.step(batch, epoch, random)) == {"nll", "path_m"}
    assert moved(learner, "generator", generator)
    assert not moved(learner, "discriminator", discriminator)
    assert set(learner.step(batch, 2, random)) == {"nll", "path_m", "discriminator", "adversarial"}
    assert moved(learner, "discriminator", discriminator)


@pytest.mark.parametrize(("silent", "other"), [("generator", "discriminator"), ("discriminator", "generator")])
def test_each_optimiser_moves_its_own_network_alone(make_learner, batch, random, silent, other):
    """With one learning rate at zero that network stays as it was, to the bit, and the other one moves."""
    learner = make_learner()
    learner.optimisers[list(learner.modules).index(silent)].param_groups[0]["lr"] = 0.0
    before = {name: weights_of(learner, name) for name in learner.modules}
    for _ in range(3):
        learner.step(batch, 5, random)
    assert torch.equal(weights_of(learner, silent), before[silent])
    assert moved(learner, other, before[other])


def test_generators_step_leaves_no_gradient_with_the_discriminator(make_learner, batch, random):
    """Its gradient is its own loss's: what the generator's backward pass would add is not there."""
    learner = make_learner()
    learner.step(batch, 5, random)
    assert all(p.requires_grad for p in learner.modules["discriminator"].parameters())
    with_generator = [p.grad.clone() for p in learner.modules["discriminator"].parameters()]
    other = make_learner(replace(ADVERSARIAL, adversarial=1e-9))  # the same discriminator loss at the first step
    other.step(batch, 5, random)
    for a, b in zip(with_generator, other.modules["discriminator"].parameters(), strict=True):
        torch.testing.assert_close(a, b.grad)


def test_generators_loss_is_made_up_as_its_weights_say(make_learner, batch, random):
    """The gradient that a step leaves is that of nll plus path before the discriminator, with its weights then too."""
    for epoch, likelihood in ((0, 1.0), (5, 0.1)):
        learner = make_learner(LossWeights(likelihood=0.1, path=2.0, adversarial=1e-9, adversarial_from=2))
        learner.clip = math.inf
        network = learner.modules["generator"]
        nll, path, _ = likelihood_and_path(network, batch)
        wanted = torch.autograd.grad(likelihood * nll + 2.0 * path, list(network.parameters()))
        losses = learner.step(batch, epoch, random)
        assert losses["nll"] == pytest.approx(nll.item())
        assert losses["path_m"] == pytest.approx(path.item())
        for p, gradient in zip(network.parameters(), wanted, strict=True):
            torch.testing.assert_close(p.grad, gradient, atol=1e-5, rtol=1e-4)


def test_likelihoods_weight_counts_without_a_discriminator(make_learner, batch, random):
    gradients = []
    for likelihood in (1.0, 0.5):
        learner = make_learner(LossWeights(likelihood=likelihood, path=0.0))
        learner.clip = math.inf
        learner.step(batch, 0, random)
        gradients.append(torch.cat([p.grad.flatten() for p in learner.modules["generator"].parameters()]))
    torch.testing.assert_close(gradients[1], 0.5 * gradients[0])


def test_gradients_are_clipped(make_learner, batch, random):
    learner = make_learner()
    learner.clip = 1e-3
    learner.step(batch, 5, random)
    for module in learner.modules.values():
        norm = torch.cat([p.grad.flatten() for p in module.parameters()]).norm()
        assert norm.item() == pytest.approx(1e-3, rel=1e-3)


def test_papers_form_of_the_adversarial_loss_differs(make_learner, batch, random):
    """It is log(1 - w D), at most 0; ours - w log D, at least 0. And it takes the generator elsewhere."""
    found, weights = [], []
    for as_paper in (False, True):
        learner = make_learner(replace(ADVERSARIAL, as_paper=as_paper))
        found.append(learner.step(batch, 5, random))
        weights.append(weights_of(learner, "generator"))
    assert found[0]["adversarial"] > 0 > found[1]["adversarial"]
    assert found[0]["nll"] == found[1]["nll"]
    assert not torch.equal(*weights)


def test_only_whole_paths_are_judged(make_learner, make_windows, random):
    """Who has gaps or an unknown end is learnt from by likelihood alone, and does not change what is judged."""
    windows = make_windows((3, 1, 4, 2))
    windows.future[4:, 7:] = np.nan
    windows.seen[2, 3] = False
    (batch,) = batches(windows, 1000)
    whole = batch.known_throughout & batch.observation.seen.all(dim=-1)
    assert int(whole.sum()) == 3
    found = make_learner().step(batch, 5, random)
    junk = batch.future.masked_fill(~whole[..., None, None], 50.0)
    other = make_learner().step(replace(batch, future=junk), 5, random)
    assert other["discriminator"] == pytest.approx(found["discriminator"])
    assert other["adversarial"] == pytest.approx(found["adversarial"])
    windows.future[:, 7:] = np.nan
    (batch,) = batches(windows, 1000)
    assert set(make_learner().step(batch, 5, random)) == {"nll", "path_m"}  # nobody to judge


@pytest.mark.parametrize("as_paper", [False, True])
def test_discriminator_learns_to_tell_made_paths_from_walks(make_learner, batch, random, as_paper):
    """A generator that does not learn meanwhile: its first paths go straight on, real walks do not.

    A coin toss has a loss of log 2 for the real paths and, as here most people have one path, log 2 for the others.
    """
    learner = make_learner(replace(ADVERSARIAL, as_paper=as_paper))
    learner.optimisers[0].param_groups[0]["lr"] = 0.0
    learner.optimisers[1].param_groups[0]["lr"] = 2e-2
    losses = [learner.step(batch, 5, random)["discriminator"] for _ in range(40)]
    assert losses[0] == pytest.approx(2 * math.log(2), abs=0.1)
    assert losses[-1] / 2 < 0.5 * math.log(2)


@pytest.mark.parametrize("as_paper", [False, True])
@pytest.mark.parametrize("recipe", ["best", "paper"])
def test_adversarial_run_stays_finite(make_learner, make_windows, random, recipe, as_paper):
    """And the likelihood still gets better while both networks play."""
    windows = make_windows((3, 1, 4, 2), gaps=True)
    learner = make_learner(replace(ADVERSARIAL, as_paper=as_paper), learning_rate=5e-3, recipe=recipe)
    losses = [learner.step(batch, 5, random) for _ in range(30) for batch in batches(windows, 1000)]
    assert all(math.isfinite(value) for loss in losses for value in loss.values())
    assert all(p.isfinite().all() for p in learner.modules.parameters())
    assert losses[-1]["nll"] < losses[0]["nll"]


def test_likelihood_and_path_are_learnt(make_learner, batch, random):
    learner = make_learner(LossWeights(), learning_rate=1e-2)
    losses = [learner.step(batch, 0, random) for _ in range(40)]
    assert losses[-1]["nll"] < losses[0]["nll"] - 3
    assert losses[-1]["path_m"] < 0.9 * losses[0]["path_m"]
