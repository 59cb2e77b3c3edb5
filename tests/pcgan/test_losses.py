"""Loss terms: by hand where they can be, the same in any coordinates, and only of what is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pcgan.batches import batches
from pcgan.discriminator import Discriminator, generator_loss, listed
from pcgan.losses import likelihood_and_path, local_future, local_observed
from pcgan.mixture_density import log_likelihood
from pcgan.modal_paths import ModalPaths, modal_paths


@pytest.fixture
def make_batch(make_windows):
    """Builds a batch of all scenes of random walks."""

    def make(sizes=(1, 3, 2), *, gaps=True, **options):
        (batch,) = batches(make_windows(sizes, gaps=gaps, **options), 1000)
        return batch

    return make


def double(batch):
    observation = replace(
        batch.observation,
        observed=batch.observation.observed.double(),
        velocity=batch.observation.velocity.double(),
        vehicle=batch.observation.vehicle.double(),
    )
    return replace(batch, observation=observation, future=batch.future.double())


def test_local_is_ahead_and_to_the_left_of_the_last_position(make_generator, make_batch):
    """Somebody at (3, 4) who walks along y: one metre ahead is (3, 5), two to the left (1, 4)."""
    batch = make_batch((1,), gaps=False)
    observation = batch.observation
    observation.observed[0, 0, -2:] = torch.tensor([[3.0, 3.5], [3, 4]])
    observation.velocity[0, 0] = torch.tensor([0, 1.25])
    batch.future[0, 0, :2] = torch.tensor([[3.0, 5], [1, 4]])
    best, paper = make_generator(), make_generator(recipe="paper")
    torch.testing.assert_close(local_future(best, batch)[0, 0, :2], torch.tensor([[1.0, 0], [0, 2]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(local_future(paper, batch)[0, 0, :2], torch.tensor([[0.0, 1], [-2, 0]]))
    observed = local_observed(best, batch)[0, 0, -2:]
    torch.testing.assert_close(observed, torch.tensor([[-0.5, 0], [0, 0]]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("recipe", ["best", "paper"])
def test_terms_are_those_of_a_plain_loop_in_scene_coordinates(make_generator, make_batch, recipe):
    """A density does not change with the frame, nor do distances: pedestrian by pedestrian, step by step."""
    generator, batch = make_generator(recipe=recipe, dt_s=0.4), make_batch()
    nll, distance, _ = likelihood_and_path(generator, batch)
    mixture = generator(batch.observation)
    density = log_likelihood(mixture, batch.future)  # (S, A, P)
    nlls, distances = [], []
    for s, a in batch.known.any(dim=-1).nonzero().tolist():
        known = batch.known[s, a]
        nlls.append(-density[s, a][known].sum().item())
        path = modal_paths(mixture.weights[s, a][None], mixture.means[s, a][None], generator.config.eps_m).points[0, 0]
        distances.append((path - batch.future[s, a])[known].norm(dim=-1).sum().item())
    assert len(nlls) == 6
    assert nll.item() == pytest.approx(np.mean(nlls), rel=1e-4)
    assert distance.item() == pytest.approx(np.mean(distances), rel=1e-4)


def test_what_is_not_known_does_not_matter(make_generator, make_batch):
    """Neither to the terms nor to their gradients, be it an unknown step, an unknown person or padding."""
    generator, batch = make_generator(dt_s=0.4), make_batch((2, 4, 1))
    batch = replace(batch, known=batch.known & (torch.arange(4) != 1)[:, None])
    assert not batch.known.all()
    junk = batch.future.masked_fill(~batch.known.unsqueeze(-1), 77.0)
    found = []
    for futures in (batch.future, junk):
        nll, distance, paths = likelihood_and_path(generator, replace(batch, future=futures))
        generator.zero_grad()
        (nll + distance).backward()
        gradients = torch.cat([p.grad.flatten() for p in generator.parameters()])
        found.append((nll.item(), distance.item(), gradients))
    assert len(paths.points) == int(batch.known.any(dim=-1).sum())
    assert found[0][:2] == pytest.approx(found[1][:2])
    torch.testing.assert_close(found[0][2], found[1][2])
    assert found[0][2].abs().max() > 0


def test_likelihood_of_one_round_gaussian_by_hand(make_generator, make_batch):
    """All means along the path straight on, sigma 1 m, futures 1 m beside it: log 2 pi + 1/2 per step, 1 m per step."""
    generator, batch = make_generator(dt_s=0.4), make_batch((2,), gaps=False)
    with torch.no_grad():
        for parameter in (*generator.phi_mdn.parameters(), *generator.velocity_weights.parameters()):
            parameter.zero_()
    observation = batch.observation
    ahead = observation.velocity.unsqueeze(2) * 0.4 * torch.arange(1, 13)[:, None]
    left = torch.stack([-observation.velocity[..., 1], observation.velocity[..., 0]], dim=-1)
    left = left / left.norm(dim=-1, keepdim=True)
    beside = replace(batch, future=observation.observed[..., -1:, :] + ahead + left.unsqueeze(2))
    nll, distance, paths = likelihood_and_path(generator, beside)
    assert nll.item() == pytest.approx(12 * (math.log(2 * math.pi) + 0.5), rel=1e-4)
    assert distance.item() == pytest.approx(12, rel=1e-4)
    torch.testing.assert_close(paths.probabilities[:, 0], torch.ones(2))


def test_terms_of_a_batch_are_the_mean_over_its_pedestrians(make_generator, make_windows):
    generator, windows = make_generator(dt_s=0.4), make_windows((2, 4, 1), gaps=True)
    (whole,) = batches(windows, 1000)
    one_by_one = list(batches(windows, 1))
    assert len(one_by_one) == 3
    counts = [int(batch.known.any(dim=-1).sum()) for batch in one_by_one]
    terms = np.array([[term.item() for term in likelihood_and_path(generator, batch)[:2]] for batch in one_by_one])
    found = [term.item() for term in likelihood_and_path(generator, whole)[:2]]
    assert found == pytest.approx((np.average(terms, axis=0, weights=counts)).tolist(), rel=1e-4)


@pytest.mark.parametrize("as_paper", [False, True])
@pytest.mark.parametrize(("recipe", "pooling"), [("best", "gvat"), ("best", "social"), ("paper", "gvat")])
def test_adversarial_gradient_reaches_the_parameters_through_multipac(
    make_generator, make_batch, recipe, pooling, as_paper
):
    """Central differences of the whole chain: network, MultiPAC, discriminator, loss; in float64, along directions."""
    generator = make_generator(recipe=recipe, pooling=pooling, dt_s=0.4).double()
    with torch.no_grad():
        generator.phi_mdn.weight.mul_(8 if recipe == "best" else 40)  # components that lie apart
    batch = double(make_batch((2, 3)))
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(1)
        discriminator = Discriminator(0.4).double().requires_grad_(False)
    chosen = batch.known.any(dim=-1)

    def loss():
        _, _, paths = likelihood_and_path(generator, batch)
        points, probabilities, owner = listed(ModalPaths(paths.probabilities, paths.points))
        judged = discriminator(local_observed(generator, batch)[chosen], points, owner)
        return generator_loss(judged, probabilities, len(paths.points), as_paper=as_paper), len(points)

    value, paths = loss()
    assert paths > int(chosen.sum())  # somebody has several
    value.backward()
    random = torch.Generator().manual_seed(2)
    for name in ("phi_e.weight", "mlp_dec.2.weight", "decoder.weight_hh_l0", "phi_mdn.weight", "phi_mdn.bias"):
        parameter = generator.get_parameter(name)
        direction = torch.randn(parameter.shape, generator=random, dtype=torch.float64)
        start, step, values = parameter.detach().clone(), 1e-6, []
        with torch.no_grad():
            for sign in (1, -1):
                parameter.copy_(start + sign * step * direction)
                values.append(loss()[0].item())
            parameter.copy_(start)
        slope = (values[0] - values[1]) / (2 * step)
        assert abs(slope) > 1e-6
        assert (parameter.grad * direction).sum().item() == pytest.approx(slope, rel=1e-4, abs=1e-8)
