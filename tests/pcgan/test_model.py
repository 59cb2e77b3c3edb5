"""Laws of the generator: order, masks, turns, gaps, and whether the vehicle matters."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pcgan.batches import Observation, batches
from pcgan.dataset import filled_in
from pcgan.model import POOLINGS, ModelConfig

RECIPES_AND_POOLINGS = [(recipe, pooling) for recipe in ("paper", "best") for pooling in POOLINGS]
every_network = pytest.mark.parametrize(("recipe", "pooling"), RECIPES_AND_POOLINGS)


def of(observation, rows):
    """The observation of some of the pedestrians of one scene."""
    return Observation(
        observed=observation.observed[rows],
        seen=observation.seen[rows],
        velocity=observation.velocity[rows],
        neighbours=observation.neighbours[rows][:, rows],
        vehicle=None if observation.vehicle is None else observation.vehicle[rows],
    )


def driven(observation, *change):
    """The same with the vehicle's x, y, vx, vy changed."""
    return replace(observation, vehicle=observation.vehicle + torch.tensor(change, dtype=observation.vehicle.dtype))


def parts(mixture):
    return mixture.weights, mixture.means, mixture.log_sigmas, mixture.rhos


def assert_same(a, b, atol=2e-5):
    for x, y in zip(parts(a), parts(b), strict=True):
        torch.testing.assert_close(x, y, atol=atol, rtol=1e-4 if atol else 0)


def difference(a, b):
    return max((x - y).abs().max().item() for x, y in zip(parts(a), parts(b), strict=True))


def covariances(mixture):
    """(..., 2, 2) m^2."""
    sigma_x, sigma_y = mixture.log_sigmas.exp().unbind(-1)
    cross = mixture.rhos * sigma_x * sigma_y
    return torch.stack([sigma_x**2, cross, cross, sigma_y**2], dim=-1).unflatten(-1, (2, 2))


@every_network
def test_output_has_the_promised_shapes(make_generator, make_observation, recipe, pooling):
    mixture = make_generator(recipe=recipe, pooling=pooling)(make_observation(gaps=True))
    assert mixture.means.shape == (5, 12, 6, 2)
    assert mixture.rhos.shape == (5, 12, 6)
    torch.testing.assert_close(mixture.weights.sum(-1), torch.ones(5, 12))
    assert all(part.isfinite().all() for part in parts(mixture))


@every_network
def test_reordering_pedestrians_reorders_the_output(make_generator, make_observation, recipe, pooling):
    model = make_generator(recipe=recipe, pooling=pooling)
    observation = make_observation(gaps=True)
    order = torch.tensor([3, 0, 4, 2, 1])
    straight, reordered = model.local_mixture(observation), model.local_mixture(of(observation, order))
    torch.testing.assert_close(reordered.means, straight.means[order])
    torch.testing.assert_close(reordered.log_weights, straight.log_weights[order])


@every_network
def test_pedestrian_outside_the_mask_changes_nothing(make_generator, make_observation, recipe, pooling):
    model = make_generator(recipe=recipe, pooling=pooling)
    observation = make_observation(gaps=True)
    neighbours = observation.neighbours.clone()
    neighbours[:3, 3:] = neighbours[3:, :3] = False
    together = model(replace(observation, neighbours=neighbours))
    alone = model(of(observation, torch.arange(3)))
    torch.testing.assert_close(together.means[:3], alone.means)
    torch.testing.assert_close(together.log_sigmas[:3], alone.log_sigmas)


@pytest.mark.parametrize("recipe", ["paper", "best"])
@pytest.mark.parametrize("pooling", ["gvat", "social"])
def test_neighbour_inside_the_mask_matters(make_generator, make_observation, recipe, pooling):
    model = make_generator(recipe=recipe, pooling=pooling)
    observation = make_observation(3)
    moved = observation.observed.clone()
    moved[2] += torch.tensor([5.0, 1.0])
    before, after = model.local_mixture(observation), model.local_mixture(replace(observation, observed=moved))
    assert (before.means[0] - after.means[0]).abs().max() > 1e-6


def test_without_pooling_nobodys_place_matters_to_others(make_generator, make_observation):
    model = make_generator(pooling="none")
    observation = make_observation(3, vehicle=False)
    moved = observation.observed.clone()
    moved[2] += torch.tensor([5.0, 1.0])
    before, after = model.local_mixture(observation), model.local_mixture(replace(observation, observed=moved))
    torch.testing.assert_close(after.means[:2], before.means[:2])


def test_neighbours_motion_matters_in_best(make_generator, make_observation):
    """Who comes and who goes, at the same place with the same displacements behind: only `velocity` differs."""
    model = make_generator()
    observation = make_observation(3)
    turned = observation.velocity.clone()
    turned[2] *= -1
    before, after = model.local_mixture(observation), model.local_mixture(replace(observation, velocity=turned))
    assert (before.means[:2] - after.means[:2]).abs().flatten(1).max(dim=1).values.min() > 1e-6


# --- the vehicle -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("A", [1, 2])
@pytest.mark.parametrize("pooling", POOLINGS)
def test_vehicle_matters_in_best_even_to_one_or_two(make_generator, make_observation, A, pooling):
    """In float64, in which what cancels differs by 1e-15."""
    model = make_generator(recipe="best", pooling=pooling).double()
    observation = make_observation(A, dtype=torch.float64)
    here = model(observation)
    for other in (driven(observation, 0, 4, 0, 0), driven(observation, 0, 0, 3, 0), replace(observation, vehicle=None)):
        per_pedestrian = (here.means - model(other).means).abs().flatten(1).max(dim=1).values
        assert (per_pedestrian > 1e-6).all()


def test_vehicle_changes_who_is_heeded_in_best(make_generator, make_observation):
    """Not only its own layers: what GVAT pools changes too, by more than a constant."""
    model = make_generator()
    observation = make_observation(4)
    found = []
    model.gvat.register_forward_hook(lambda _module, _inputs, output: found.append(output))
    model(observation)
    model(driven(observation, 0, 4, 0, 0))
    assert (found[0] - found[1]).abs().flatten(1).max(dim=1).values.min() > 1e-4


def test_vehicle_cancels_in_the_papers_softmax(make_generator, make_observation):
    """The known flaw that `best` mends: kept, and shown to be there (DESIGN section 7)."""
    model = make_generator(recipe="paper").double()
    observation = make_observation(dtype=torch.float64)
    assert difference(model(observation), model(driven(observation, 60, 0, 0, 0))) < 1e-12
    assert difference(model(observation), model(replace(observation, vehicle=None))) < 1e-12


def test_missing_vehicle_is_none_or_nan(make_generator, make_observation):
    model, observation = make_generator(), make_observation()
    absent = torch.full_like(observation.vehicle, torch.nan)
    without = model.local_mixture(replace(observation, vehicle=None))
    assert_same(model.local_mixture(replace(observation, vehicle=absent)), without, atol=0)
    mixed = observation.vehicle.clone()  # each sees its own, and pools as it sees it
    mixed[1::2] = torch.nan
    mixed[4, 3, 2] = torch.nan  # one number missing: none
    each = model.local_mixture(replace(observation, vehicle=mixed))
    torch.testing.assert_close(each.means[[0, 2]], model.local_mixture(observation).means[[0, 2]])
    torch.testing.assert_close(each.means[[1, 3, 4]], without.means[[1, 3, 4]])


def test_absent_vehicle_leaves_gradients_finite(make_generator, make_observation):
    model = make_generator()
    observation = make_observation()
    vehicle = observation.vehicle.clone()
    vehicle[1:3] = torch.nan
    model(replace(observation, vehicle=vehicle)).means.square().sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())


@pytest.mark.parametrize("recipe", ["paper", "best"])
@pytest.mark.parametrize("pooling", ["gvat", "social"])
def test_network_without_vehicle_ignores_it(make_generator, make_observation, recipe, pooling):
    model = make_generator(recipe=recipe, pooling=pooling, uses_vehicle=False)
    observation = make_observation()
    assert_same(model(observation), model(replace(observation, vehicle=None)), atol=0)


# --- moving the scene ------------------------------------------------------------------------------------------------


def moved_scene(observation, angle, shift):
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    observed, velocity = observation.observed @ turn.T + shift, observation.velocity @ turn.T
    vehicle = torch.cat([observation.vehicle[..., :2] @ turn.T + shift, observation.vehicle[..., 2:] @ turn.T], -1)
    return replace(observation, observed=observed, velocity=velocity, vehicle=vehicle), turn


@pytest.mark.parametrize("pooling", POOLINGS)
@pytest.mark.parametrize("angle", [0.0, 0.7, -math.pi / 2])
def test_turning_the_scene_turns_the_output(make_generator, make_observation, pooling, angle):
    model = make_generator(pooling=pooling).double()
    observation = make_observation(gaps=True, dtype=torch.float64)
    shift = torch.tensor([7.0, -3.0], dtype=torch.float64)
    moved, turn = moved_scene(observation, angle, shift)
    still, turned = model(observation), model(moved)
    torch.testing.assert_close(turned.means, still.means @ turn.T + shift, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(turned.weights, still.weights, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(covariances(turned), turn @ covariances(still) @ turn.T, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("pooling", POOLINGS)
def test_shifting_the_scene_shifts_the_papers_output(make_generator, make_observation, pooling):
    model = make_generator(recipe="paper", pooling=pooling).double()
    observation = make_observation(gaps=True, dtype=torch.float64)
    shift = torch.tensor([7.0, -3.0], dtype=torch.float64)
    still, shifted = model(observation), model(moved_scene(observation, 0.0, shift)[0])
    torch.testing.assert_close(shifted.means, still.means + shift, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(covariances(shifted), covariances(still), atol=1e-9, rtol=1e-9)


# --- scenes in batches, gaps, edges ----------------------------------------------------------------------------------


@every_network
def test_padded_scenes_agree_with_single_ones(make_generator, make_windows, recipe, pooling):
    """And whatever stands in padding does not matter, be it NaN in the vehicle or people far off."""
    model = make_generator(recipe=recipe, pooling=pooling, dt_s=0.4)
    windows = make_windows(sizes=(3, 1, 5, 2), gaps=True)
    windows.vehicle[:3] = np.nan
    (batch,) = batches(windows, 1000)
    observation, padding = batch.observation, ~batch.real
    assert padding.any()
    junk = observation.observed.masked_fill(padding[..., None, None], 1e3)
    vehicle = observation.vehicle.masked_fill(padding[..., None, None], torch.nan)
    for together in (model(observation), model(replace(observation, observed=junk, vehicle=vehicle))):
        for s, A in enumerate(batch.real.sum(dim=1).tolist()):
            scene = Observation(observation.observed[s, :A], observation.seen[s, :A], observation.velocity[s, :A],
                                observation.neighbours[s, :A, :A], observation.vehicle[s, :A])  # fmt: skip
            alone = model(scene)
            torch.testing.assert_close(together.means[s, :A], alone.means, atol=1e-4, rtol=1e-4)
            torch.testing.assert_close(together.weights[s, :A], alone.weights, atol=1e-5, rtol=1e-4)
            torch.testing.assert_close(together.log_sigmas[s, :A], alone.log_sigmas, atol=1e-4, rtol=1e-4)


def test_what_stands_in_unseen_steps_matters_only_by_being_filled_in(make_generator, make_observation):
    model = make_generator()
    observation = make_observation(6, gaps=True)
    unseen = ~observation.seen.numpy()
    assert unseen[:, 0].any()
    junk = observation.observed.numpy().copy()
    junk[unseen] = np.random.default_rng(1).normal(0, 50, (int(unseen.sum()), 2))
    filled = torch.from_numpy(filled_in(junk, observation.seen.numpy())).float()
    assert_same(model(replace(observation, observed=filled)), model(observation))


def test_where_somebody_was_before_being_seen_is_not_known_to_the_wiggle_nor_the_velocity(
    make_generator, make_observation
):
    """Displacements from before the first seen step are masked there, even if they are not zero."""
    model = make_generator()
    observation = make_observation(3)
    seen = observation.seen.clone()
    seen[1, :4] = False
    moved = observation.observed.clone()
    moved[1, :4] += torch.tensor([3.0, -2.0]) * torch.arange(4)[:, None]
    a, b = replace(observation, seen=seen), replace(observation, seen=seen, observed=moved)
    torch.testing.assert_close(model.wiggle(b)[0], model.wiggle(a)[0])
    torch.testing.assert_close(model.wiggle(b)[1], model.wiggle(a)[1])


def test_an_unseen_step_is_told_from_a_seen_one_in_best_alone(make_generator, make_observation):
    observation = make_observation(2)
    seen = observation.seen.clone()
    seen[0, 4] = False
    gap = replace(observation, seen=seen)
    best, paper = make_generator(), make_generator(recipe="paper")
    assert difference(best(gap), best(observation)) > 1e-5
    assert difference(paper(gap), paper(observation)) == 0


@every_network
def test_lone_pedestrian_pools_zeros(make_generator, make_observation, recipe, pooling):
    """So it is predicted as among people who are not its neighbours."""
    model = make_generator(recipe=recipe, pooling=pooling, uses_vehicle=False)
    observation = make_observation(1)
    assert all(part.isfinite().all() for part in parts(model(observation)))
    module = model.gvat or model.social
    if module is None:
        return
    pairs = torch.randn(1, 1, 5 if recipe == "best" else 2)
    arguments = [torch.randn(1, 32), pairs, torch.zeros(1, 1, dtype=torch.bool)]
    pooled = module(*arguments, None) if pooling == "gvat" else module(*arguments)
    assert pooled.shape == (1, module.pooled_dim)
    assert not pooled.any()


@pytest.mark.parametrize("recipe", ["paper", "best"])
def test_crowd_of_five_hundred_is_predicted(make_generator, make_observation, recipe):
    with torch.inference_mode():
        mixture = make_generator(recipe=recipe)(make_observation(500, gaps=True, spread_m=40.0))
    assert all(part.isfinite().all() for part in parts(mixture))


@every_network
def test_people_at_rest_in_one_place_are_predicted(make_generator, recipe, pooling):
    everyone = torch.ones(2, 2, dtype=torch.bool)
    seen = torch.ones(2, 8, dtype=torch.bool)
    observation = Observation(torch.zeros(2, 8, 2), seen, torch.zeros(2, 2), everyone, torch.zeros(2, 8, 4))
    model = make_generator(recipe=recipe, pooling=pooling)
    mixture = model(observation)
    mixture.means.sum().backward()
    assert all(part.isfinite().all() for part in parts(mixture))
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())


def test_untrained_best_starts_near_the_extrapolation(make_generator, make_observation):
    observation = make_observation()
    mixture = make_generator()(observation)
    ahead = observation.observed[:, -1:] + observation.velocity[:, None] * (0.1 * torch.arange(1, 13))[:, None]
    assert (mixture.means - ahead.unsqueeze(2)).norm(dim=-1).max() < 0.6


def test_log_sigma_shift_widens_all_of_a_step_and_moves_nothing(make_generator, make_observation):
    model, observation = make_generator(), make_observation()
    before = model(observation)
    model.log_sigma_shift[3] = math.log(2)
    after = model(observation)
    torch.testing.assert_close(after.means, before.means, atol=0, rtol=0)
    torch.testing.assert_close(after.log_weights, before.log_weights, atol=0, rtol=0)
    factor = (covariances(after) / covariances(before)).mean(dim=(-1, -2, -3))  # (A, P)
    torch.testing.assert_close(factor, torch.where(torch.arange(12) == 3, 4.0, 1.0).expand(5, 12))


# --- wiggle ----------------------------------------------------------------------------------------------------------


def track(positions, seen=None):
    """One pedestrian alone, (T, 2)."""
    observed = torch.as_tensor(positions, dtype=torch.float64).unsqueeze(0)
    seen = torch.ones(1, observed.shape[1], dtype=torch.bool) if seen is None else torch.tensor([seen])
    return Observation(observed, seen, torch.zeros(1, 2), torch.ones(1, 1, dtype=torch.bool), None)


def test_wiggle_worked_out_by_hand(make_generator):
    """x = 0, 1, 3, 2 has displacements 1, 2, -1 and bends 1, -3; the first is not known if the first step is unseen."""
    model, walk = make_generator(), [[0, 0], [1, 0], [3, 0], [2, 0]]
    whole = [0.5 * math.log(10 / 4) + 3, -3 / 10]
    (found,) = model.wiggle(track(walk)).tolist()
    assert found == pytest.approx([*whole, *whole, 1], abs=1e-5)
    later = [0.5 * math.log(9 / 2) + 3, 0]
    (found,) = model.wiggle(track(walk, [False, True, True, True])).tolist()
    assert found == pytest.approx([*later, *later, 2 / 3], abs=1e-5)


def test_wiggle_is_pooled_over_the_scene(make_generator):
    """Two walks, bends 1, -3 and 0, 2: sums of squares 10 and 4, lagged -3 and 0; a third one is no neighbour."""
    walks = torch.tensor([[0.0, 1, 3, 2], [0, 1, 2, 5], [0, 9, -9, 9]]).double()
    neighbours = torch.tensor([[True, True, False], [True, True, False], [False, False, True]])
    observed = torch.stack([walks, torch.zeros(3, 4).double()], dim=-1)
    observation = Observation(observed, torch.ones(3, 4, dtype=torch.bool), torch.zeros(3, 2), neighbours, None)
    found = make_generator().wiggle(observation)
    pooled = [0.5 * math.log(14 / 8) + 3, -3 / 14]
    assert found[0].tolist() == pytest.approx([0.5 * math.log(2.5) + 3, -0.3, *pooled, 1], abs=1e-5)
    assert found[1].tolist() == pytest.approx([3, 0, *pooled, 1], abs=1e-5)
    assert found[2, :2].tolist() == found[2, 2:4].tolist()


def test_white_noise_bends_against_itself_and_a_smooth_curve_does_not(make_generator):
    """Second differences of white noise have autocorrelations 1, -2/3, 1/6; and are 6 times its variance."""
    time = torch.arange(2000, dtype=torch.float64) * 0.1
    straight = torch.stack([1.2 * time, 0.3 * time], dim=-1)
    noise = torch.from_numpy(np.random.default_rng(0).normal(0, 0.05, (2000, 2)))
    model = make_generator()
    (noisy,) = model.wiggle(track(straight + noise))
    assert noisy[1].item() == pytest.approx(-2 / 3, abs=0.03)
    assert noisy[0].item() == pytest.approx(math.log(0.05 * math.sqrt(6)) + 3, abs=0.03)
    (smooth,) = model.wiggle(track(5 * torch.stack([(0.3 * time).cos(), (0.3 * time).sin()], dim=-1)))
    assert smooth[1].item() > 0.95
    (line,) = model.wiggle(track(straight))
    assert line[1].item() == pytest.approx(0, abs=1e-6)


# --- configuration and gradients -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"recipe": "worst"}, "recipe must be one of"),
        ({"pooling": "max"}, r"pooling must be one of .*got 'max'"),
        ({"observed_steps": 1}, "at least 2"),
        ({"hidden": 0}, "hidden"),
        ({"hidden": 30}, "hidden must be a multiple of 4, got 30"),
        ({"components": 10}, "at most 9"),
        ({"dt_s": math.nan}, "dt_s must be positive"),
        ({"dt_s": 0.0}, "dt_s must be positive"),
    ],
)
def test_senseless_configuration_is_refused(fields, problem):
    with pytest.raises(ValueError, match=problem):
        ModelConfig(**fields)


CANCELLED = {"gvat.phi_r_vehicle.weight", "gvat.phi_u_self.weight", "gvat.phi_r_pair.bias", "gvat.phi_u_pair.bias"}


@every_network
def test_gradient_reaches_every_weight(make_generator, make_observation, recipe, pooling):
    """All of `best`; of the paper's network all but what its softmax cancels, the vehicle among it."""
    model = make_generator(recipe=recipe, pooling=pooling).double()
    mixture = model.local_mixture(make_observation(gaps=True, dtype=torch.float64))
    (mixture.means.square().sum() + mixture.log_weights[..., 0].sum() + mixture.log_sigmas.sum()).backward()
    gradients = {name: p.grad for name, p in model.named_parameters()}
    assert all(gradient.isfinite().all() for gradient in gradients.values())
    silent = {name for name, gradient in gradients.items() if gradient.abs().max() < 1e-12}
    assert silent == (CANCELLED if (recipe, pooling) == ("paper", "gvat") else set())
