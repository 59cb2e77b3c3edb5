"""Laws of the generator: order, masks, turns, and whether the vehicle matters."""

import math

import pytest
import torch

from pcgan.model import Generator, ModelConfig


def scene(A=5, T=8, seed=0, spread_m=4.0):
    generator = torch.Generator().manual_seed(seed)
    velocity = torch.randn(A, 2, generator=generator)
    ages = torch.arange(T - 1, -1, -1) * 0.1
    start = spread_m * torch.randn(A, 1, 2, generator=generator)
    observed = start - ages[:, None] * velocity[:, None] + 0.02 * torch.randn(A, T, 2, generator=generator)
    x = 3 - ages * 5
    vehicle = torch.stack([x, torch.full_like(x, -2), torch.full_like(x, 5), torch.zeros_like(x)], -1)  # (T, 4)
    return observed, velocity, torch.ones(A, A, dtype=torch.bool), vehicle


def assert_same(a, b, atol=2e-5):
    for x, y in zip(
        (a.weights, a.means, a.log_sigmas, a.rhos), (b.weights, b.means, b.log_sigmas, b.rhos), strict=True
    ):
        torch.testing.assert_close(x, y, atol=atol, rtol=1e-4)


def difference(a, b):
    return ((a.means - b.means).abs().max() + (a.weights - b.weights).abs().max()).item()


@pytest.mark.parametrize("recipe", ["paper", "best"])
def test_output_has_the_promised_shapes(make_generator, recipe):
    observed, velocity, neighbours, vehicle = scene()
    mixture = make_generator(recipe=recipe)(observed, velocity, neighbours, vehicle)
    assert mixture.means.shape == (5, 12, 6, 2)
    assert mixture.rhos.shape == (5, 12, 6)
    torch.testing.assert_close(mixture.weights.sum(-1), torch.ones(5, 12))
    assert all(torch.isfinite(part).all() for part in (mixture.log_weights, mixture.means, mixture.log_sigmas))


@pytest.mark.parametrize("recipe", ["paper", "best"])
def test_reordering_pedestrians_reorders_the_output(make_generator, recipe):
    model = make_generator(recipe=recipe)
    observed, velocity, neighbours, vehicle = scene()
    order = torch.tensor([3, 0, 4, 2, 1])
    straight = model.local_mixture(observed, velocity, neighbours, vehicle)
    reordered = model.local_mixture(observed[order], velocity[order], neighbours, vehicle)
    torch.testing.assert_close(reordered.means, straight.means[order])
    torch.testing.assert_close(reordered.log_weights, straight.log_weights[order])


@pytest.mark.parametrize("recipe", ["paper", "best"])
def test_pedestrian_outside_the_mask_changes_nothing(make_generator, recipe):
    model = make_generator(recipe=recipe)
    observed, velocity, neighbours, vehicle = scene()
    alone = model(observed[:3], velocity[:3], neighbours[:3, :3], vehicle)
    neighbours = neighbours.clone()
    neighbours[:3, 3:] = neighbours[3:, :3] = False
    together = model(observed, velocity, neighbours, vehicle)
    torch.testing.assert_close(together.means[:3], alone.means)


@pytest.mark.parametrize("recipe", ["paper", "best"])
def test_neighbour_inside_the_mask_matters(make_generator, recipe):
    model = make_generator(recipe=recipe)
    observed, velocity, neighbours, vehicle = scene(3)
    moved = observed.clone()
    moved[2] += torch.tensor([5.0, 1.0])
    before = model.local_mixture(observed, velocity, neighbours, vehicle)
    after = model.local_mixture(moved, velocity, neighbours, vehicle)
    assert (before.means[0] - after.means[0]).abs().max() > 1e-6


@pytest.mark.parametrize("A", [1, 2])
def test_vehicle_matters_in_best_even_to_one_or_two(make_generator, A):
    model = make_generator(recipe="best")
    observed, velocity, neighbours, vehicle = scene(A)
    here = model(observed, velocity, neighbours, vehicle)
    elsewhere = model(observed, velocity, neighbours, vehicle + torch.tensor([0.0, 4.0, 0.0, 0.0]))
    faster = model(observed, velocity, neighbours, vehicle + torch.tensor([0.0, 0.0, 3.0, 0.0]))
    nowhere = model(observed, velocity, neighbours, None)
    for other in (elsewhere, faster, nowhere):
        per_pedestrian = (here.means - other.means).abs().flatten(1).max(dim=1).values
        assert (per_pedestrian > 1e-5).all()


def test_vehicle_cancels_in_the_papers_softmax(make_generator):
    """The known flaw that `best` mends: kept, and shown to be there (DESIGN section 7)."""
    model = make_generator(recipe="paper")
    observed, velocity, neighbours, vehicle = scene(5)
    far = model(observed, velocity, neighbours, vehicle + torch.tensor([60.0, 0.0, 0.0, 0.0]))
    assert difference(model(observed, velocity, neighbours, vehicle), far) < 1e-5


def test_missing_vehicle_is_none_or_nan(make_generator):
    model = make_generator()
    observed, velocity, neighbours, vehicle = scene()
    absent = torch.full_like(vehicle, torch.nan)
    assert_same(model(observed, velocity, neighbours, absent), model(observed, velocity, neighbours, None), atol=0)
    mixed = torch.stack([vehicle, absent, vehicle, absent, vehicle])  # (A, T, 4): each sees its own
    each = model.local_mixture(observed, velocity, torch.eye(5, dtype=torch.bool), mixed)
    with_vehicle = model.local_mixture(observed, velocity, torch.eye(5, dtype=torch.bool), vehicle)
    without = model.local_mixture(observed, velocity, torch.eye(5, dtype=torch.bool), None)
    torch.testing.assert_close(each.means[0::2], with_vehicle.means[0::2])
    torch.testing.assert_close(each.means[1::2], without.means[1::2])


def test_network_without_vehicle_ignores_it(make_generator):
    model = make_generator(uses_vehicle=False)
    observed, velocity, neighbours, vehicle = scene()
    assert_same(model(observed, velocity, neighbours, vehicle), model(observed, velocity, neighbours, None), atol=0)


@pytest.mark.parametrize("angle", [0.7, 2.0, -math.pi / 2])
def test_turning_the_scene_turns_the_output(make_generator, angle):
    model = make_generator().double()
    observed, velocity, neighbours, vehicle = (x.double() if x.is_floating_point() else x for x in scene())
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    shift = torch.tensor([7.0, -3.0]).double()
    moved_vehicle = torch.cat([vehicle[:, :2] @ turn.T + shift, vehicle[:, 2:] @ turn.T], -1)
    still = model(observed, velocity, neighbours, vehicle)
    turned = model(observed @ turn.T + shift, velocity @ turn.T, neighbours, moved_vehicle)
    torch.testing.assert_close(turned.means, still.means @ turn.T + shift, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(turned.weights, still.weights)
    still_area = still.log_sigmas.sum(-1) + 0.5 * (1 - still.rhos**2).log()  # log sqrt det of the covariance
    turned_area = turned.log_sigmas.sum(-1) + 0.5 * (1 - turned.rhos**2).log()
    torch.testing.assert_close(turned_area, still_area, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("recipe", ["paper", "best"])
def test_padded_scenes_agree_with_single_ones(make_generator, recipe):
    model = make_generator(recipe=recipe)
    first, second = scene(3, seed=1), scene(5, seed=2)
    observed = torch.stack([torch.cat([first[0], second[0][:2]]), second[0]])  # two padding rows in the first scene
    velocity = torch.stack([torch.cat([first[1], second[1][:2]]), second[1]])
    neighbours = torch.ones(2, 5, 5, dtype=torch.bool)
    neighbours[0, :, 3:] = neighbours[0, 3:] = False
    vehicle = torch.stack([first[3], second[3]])  # (S, T, 4)
    batched = model(observed, velocity, neighbours, vehicle)
    torch.testing.assert_close(batched.means[0, :3], model(*first).means, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(batched.means[1], model(*second).means, atol=1e-5, rtol=1e-5)


def test_lone_pedestrian_pools_zeros(make_generator):
    gvat = make_generator(uses_vehicle=False).gvat
    pooled = gvat(torch.randn(1, 32), torch.randn(1, 1, 5), torch.zeros(1, 1, dtype=torch.bool), None, None)
    assert not pooled.any()


def test_standing_pedestrian_is_predicted(make_generator):
    observed = torch.zeros(2, 8, 2)
    mixture = make_generator()(observed, torch.zeros(2, 2), torch.ones(2, 2, dtype=torch.bool), None)
    assert torch.isfinite(mixture.means).all()


def test_untrained_best_starts_near_the_extrapolation(make_generator):
    observed, velocity, neighbours, vehicle = scene()
    mixture = make_generator()(observed, velocity, neighbours, vehicle)
    ahead = observed[:, -1:] + velocity[:, None] * (0.1 * torch.arange(1, 13))[:, None]
    assert (mixture.means - ahead.unsqueeze(2)).norm(dim=-1).max() < 0.6


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"recipe": "worst"}, "recipe must be one of"),
        ({"observed_steps": 1}, "at least 2"),
        ({"hidden": 0}, "hidden"),
        ({"components": 10}, "at most 9"),
        ({"dt_s": math.nan}, "dt_s must be positive"),
    ],
)
def test_senseless_configuration_is_refused(fields, problem):
    with pytest.raises(ValueError, match=problem):
        ModelConfig(**fields)


def test_gradient_reaches_every_weight():
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)
        model = Generator(ModelConfig())
    observed, velocity, neighbours, vehicle = scene()
    mixture = model.local_mixture(observed, velocity, neighbours, vehicle)
    (mixture.means.square().sum() + mixture.log_weights.sum() + mixture.log_sigmas.sum()).backward()
    silent = [name for name, p in model.named_parameters() if p.grad is None or not torch.isfinite(p.grad).all()]
    assert silent == []
