"""The discriminator reads whole paths; its losses at known logits are worked out by hand."""

import math

import pytest
import torch
from torch import nn

from pcgan.discriminator import Discriminator, discriminator_loss, generator_loss, listed
from pcgan.modal_paths import ModalPaths, modal_paths

LOG3 = math.log(3)  # the logit of 3/4
# Two pedestrians: the first has two paths, of probability 0.8 and 0.2, the second one.
OWNER = torch.tensor([0, 0, 1])
WEIGHTS = torch.tensor([0.8, 0.2, 1.0])


@pytest.fixture
def discriminator():
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(3)
        return Discriminator(0.4, hidden=8, mlp=8)


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_observed_part_read_once_is_each_whole_path_read(discriminator):
    """Whole paths, one after the other: their displacements, the last observed position being the origin."""
    observed, future, owner = normal(3, 8, 2), normal(7, 12, 2, seed=1), torch.tensor([2, 0, 0, 1, 2, 2, 0])
    observed = observed - observed[:, -1:]
    found = discriminator(observed, future, owner)
    assert found.shape == (7,)
    for logit, path, person in zip(found, future, owner, strict=True):
        whole = torch.cat([observed[person], path])  # (20, 2)
        _, (last, _) = discriminator.encoder(discriminator.phi(whole.diff(dim=0) / 0.4).unsqueeze(0))
        torch.testing.assert_close(logit, discriminator.mlp(last[0, 0])[0])


def test_logits_go_with_their_paths_in_any_order(discriminator):
    observed, future, owner = normal(2, 8, 2), normal(5, 12, 2, seed=1), torch.tensor([0, 1, 0, 1, 1])
    order = torch.tensor([3, 0, 4, 2, 1])
    found = discriminator(observed, future, owner)
    assert len(found.unique()) == 5
    torch.testing.assert_close(discriminator(observed, future[order], owner[order]), found[order])
    torch.testing.assert_close(discriminator(observed.flip(0), future, 1 - owner), found)


def test_no_path_no_logit(discriminator):
    assert discriminator(normal(2, 8, 2), normal(0, 12, 2), torch.zeros(0, dtype=torch.int64)).shape == (0,)


def test_losses_of_a_coin_toss():
    """Everything at 1/2: - log 1/2 for the real, and the same for the fakes, whatever their weights."""
    assert discriminator_loss(torch.zeros(2), torch.zeros(3), WEIGHTS).item() == pytest.approx(2 * math.log(2))
    assert generator_loss(torch.zeros(3), WEIGHTS, 2).item() == pytest.approx(math.log(2))


def test_losses_worked_out_by_hand():
    """D(real) = 3/4 and 1/2; D(fake) = 3/4 and 1/4 of weights 0.8 and 0.2, and 1/2."""
    real, fake = torch.tensor([LOG3, 0.0]), torch.tensor([LOG3, -LOG3, 0.0])
    told = -(math.log(3 / 4) + math.log(1 / 2)) / 2
    caught = -(0.8 * math.log(1 / 4) + 0.2 * math.log(3 / 4) + math.log(1 / 2)) / 2
    assert discriminator_loss(real, fake, WEIGHTS).item() == pytest.approx(told + caught)
    passed = -(0.8 * math.log(3 / 4) + 0.2 * math.log(1 / 4) + math.log(1 / 2)) / 2
    assert generator_loss(fake, WEIGHTS, 2).item() == pytest.approx(passed)


def test_losses_of_the_paper_have_the_weight_inside():
    real, fake = torch.tensor([LOG3, 0.0]), torch.tensor([LOG3, -LOG3, 0.0])
    told = -(math.log(3 / 4) + math.log(1 / 2)) / 2
    inside = (math.log(1 - 0.8 * 3 / 4) + math.log(1 - 0.2 / 4) + math.log(1 - 1 / 2)) / 2
    assert discriminator_loss(real, fake, WEIGHTS, as_paper=True).item() == pytest.approx(told - inside, abs=1e-5)
    assert generator_loss(fake, WEIGHTS, 2, as_paper=True).item() == pytest.approx(inside, abs=1e-5)


@pytest.mark.parametrize("as_paper", [False, True])
@pytest.mark.parametrize("logit", [-1e3, 1e3])
def test_losses_are_finite_at_certain_logits(logit, as_paper):
    certain = torch.full((2,), logit, requires_grad=True)
    for loss in (
        discriminator_loss(-certain, certain, torch.ones(2), as_paper=as_paper),
        generator_loss(certain, torch.ones(2), 2, as_paper=as_paper),
    ):
        (gradient,) = torch.autograd.grad(loss, certain)
        assert loss.isfinite()
        assert gradient.isfinite().all()


@pytest.mark.parametrize("as_paper", [False, True])
def test_better_fakes_please_the_generator_and_trouble_the_discriminator(as_paper):
    worse, better, real = torch.full((3,), -1.0), torch.full((3,), 1.0), torch.zeros(2)
    generator = [generator_loss(fake, WEIGHTS, 2, as_paper=as_paper) for fake in (worse, better)]
    assert generator[1] < generator[0]
    troubled = [discriminator_loss(real, fake, WEIGHTS, as_paper=as_paper) for fake in (worse, better)]
    assert troubled[1] > troubled[0]
    assert discriminator_loss(real + 1, worse, WEIGHTS, as_paper=as_paper) < troubled[0]


@pytest.mark.parametrize("as_paper", [False, True])
def test_gradients_reach_the_points_and_the_weights(discriminator, as_paper):
    """Two components far apart are two paths; what the generator minimises moves their means and their weights."""
    logits = (0.3 * normal(2, 1, 2)).expand(2, 12, 2).clone().requires_grad_()
    ahead = 0.3 * torch.arange(1, 13)[:, None, None] * torch.tensor([1.0, 0])  # (12, 1, 2)
    means = (torch.tensor([[0.0, 3.0], [0.0, -3.0]]) + ahead + 0.1 * normal(2, 12, 2, 2)).requires_grad_()
    points, probabilities, owner = listed(modal_paths(logits.softmax(dim=-1), means, 1.0))
    assert points.shape == (4, 12, 2)
    judged = discriminator(normal(2, 8, 2, seed=4), points, owner)
    generator_loss(judged, probabilities, 2, as_paper=as_paper).backward()
    assert (means.grad.abs().sum(dim=-1) > 0).all()
    assert (logits.grad[:, -1].abs() > 0).all()


def test_the_discriminator_learns_to_tell_walks_from_jitter(discriminator):
    """A few steps on straight walks against jumping ones; a loss of opposite sign would not get there."""
    walk = 0.5 * torch.arange(-7.0, 13)[:, None] * torch.tensor([1.0, 0])
    observed, real = walk[:8].expand(16, 8, 2), walk[8:].expand(16, 12, 2)
    owner = torch.arange(16).repeat(2)
    fake, weights = real.repeat(2, 1, 1) + normal(32, 12, 2), torch.tensor([0.6, 0.4]).repeat_interleave(16)
    for _ in range(30):
        judged = discriminator(observed, real, torch.arange(16)), discriminator(observed, fake, owner)
        parameters = list(discriminator.parameters())
        gradients = torch.autograd.grad(discriminator_loss(*judged, weights), parameters)
        with torch.no_grad():
            for parameter, gradient in zip(parameters, gradients, strict=True):
                parameter.sub_(0.5 * gradient)
    assert discriminator(observed, real, torch.arange(16)).mean() > 1
    assert discriminator(observed, fake, owner).mean() < -1


def test_listed_paths_keep_all_probability():
    probabilities = torch.tensor([[0.5, 0.3, 0.2, 0, 0], [1.0, 0, 0, 0, 0], [0.6, 0.4, 0, 0, 0]])
    points = normal(3, 5, 12, 2)
    found, weights, owner = listed(ModalPaths(probabilities, points))
    assert owner.tolist() == [0, 0, 0, 1, 2, 2]
    assert torch.bincount(owner, weights).tolist() == pytest.approx([1, 1, 1])
    assert torch.equal(found, torch.cat([points[0, :3], points[1, :1], points[2, :2]]))


def test_sizes_are_the_papers():
    network = Discriminator(0.1)
    assert (network.phi.out_features, network.encoder.hidden_size) == (16, 64)
    assert [layer.out_features for layer in network.mlp if isinstance(layer, nn.Linear)] == [64, 1]
