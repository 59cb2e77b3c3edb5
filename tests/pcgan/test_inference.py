"""The numpy generator against the torch one, which is the source, and its MultiPAC against the torch MultiPAC."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from threadpoolctl import threadpool_limits

from pcgan import inference, mixture_density, modal_paths
from pcgan.inference import LocalMixture, NumpyGenerator
from pcgan.model import POOLINGS

SIZES = {"hidden": 20, "embedding": 12, "mlp": 40, "components": 4, "observed_steps": 5, "predicted_steps": 9,
         "dt_s": 0.4}  # fmt: skip
CONFIGS = {
    f"{recipe} {pooling}{'' if uses_vehicle else ' without vehicle'}": {
        "recipe": recipe,
        "pooling": pooling,
        "uses_vehicle": uses_vehicle,
    }
    for recipe in ("best", "paper")
    for pooling in POOLINGS
    for uses_vehicle in (True, False)
} | {"best other sizes": SIZES, "social other sizes": SIZES | {"pooling": "social"}}
every_config = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)


def last(array):
    """A torch tensor, pedestrians first, as the numpy version has it: pedestrians last."""
    return np.ascontiguousarray(array.numpy().T)


def both(generator, observation):
    """The local mixtures of the torch and of the numpy generator, and the heading."""
    numpy_generator = NumpyGenerator(generator)
    velocity = last(observation.velocity)
    heading = numpy_generator.heading(velocity)
    vehicle = None if observation.vehicle is None else observation.vehicle[0].numpy()
    found = numpy_generator.local_mixture(
        last(observation.observed), last(observation.seen), velocity, vehicle, heading
    )
    with torch.inference_mode():
        return generator.local_mixture(observation), found, heading


def assert_same(wanted, found, atol):
    np.testing.assert_allclose(found.weights.T, wanted.weights, atol=atol)
    np.testing.assert_allclose(found.means_m.T, wanted.means, atol=atol)
    np.testing.assert_allclose(found.sigmas_m.T, wanted.log_sigmas.exp(), atol=atol)
    np.testing.assert_allclose(found.rhos.T, wanted.rhos, atol=atol)


def loud(generator):
    """The same with a calibration, and with base velocities that differ clearly from the present ones."""
    P = generator.config.predicted_steps
    generator.log_sigma_shift.copy_(0.3 * torch.randn(P, generator=torch.Generator().manual_seed(5)))
    if generator.best:
        with torch.no_grad():
            generator.velocity_weights[-1].weight.mul_(10)
    return generator


@every_config
@pytest.mark.parametrize("A", [1, 2, 3, 30, 130])  # 130: several blocks everywhere
def test_generator_agrees_with_the_torch_one(make_generator, make_observation, config, A):
    """With and without a vehicle, seen throughout and with gaps."""
    generator = loud(make_generator(seed=A, **config))
    T = generator.config.observed_steps
    for vehicle, gaps in ((True, True), (False, True), (True, False)):
        observation = make_observation(A, T=T, seed=A, gaps=gaps, vehicle=vehicle, spread_m=20.0)
        wanted, found, _ = both(generator, observation)
        assert found.means_m.dtype == found.weights.dtype == np.float32
        assert_same(wanted, found, atol=1e-5)


@pytest.mark.parametrize("pooling", POOLINGS)
def test_agreement_outlasts_larger_weights(make_generator, make_observation, pooling):
    generator = make_generator(pooling=pooling)
    with torch.no_grad():
        for weights in generator.parameters():
            weights.mul_(3)  # gates, attention and sigmas at their limits
    wanted, found, _ = both(generator, make_observation(30, gaps=True))
    assert_same(wanted, found, atol=5e-5)


def test_somebody_at_rest_has_the_scene_for_a_frame(make_generator, make_observation):
    observation = make_observation(4)
    observation.velocity[1] = 0
    wanted, found, heading = both(make_generator(), observation)
    assert heading[:, 1].tolist() == [1, 0]
    np.testing.assert_allclose(np.hypot(*heading), 1, atol=1e-6)
    assert_same(wanted, found, atol=1e-5)


def test_two_people_in_one_place_are_told_apart(make_generator, make_observation):
    """No distance, no division by zero."""
    observation = make_observation(3)
    observation.observed[1] = observation.observed[0]
    wanted, found, _ = both(make_generator(), observation)
    assert_same(wanted, found, atol=1e-5)


def test_vehicle_far_off_or_where_somebody_stands(make_generator, make_observation):
    observation = make_observation(3)
    for place in (observation.observed[1, -1], torch.tensor([5_000.0, -9_000.0])):
        vehicle = observation.vehicle.clone()
        vehicle[..., :2] += place - vehicle[0, -1, :2]
        wanted, found, _ = both(make_generator(), replace(observation, vehicle=vehicle))
        assert np.isfinite(found.means_m).all()
        assert_same(wanted, found, atol=1e-5)


def test_inputs_are_left_alone(make_generator, make_observation):
    """Blocks are worked on in place; the arrays that came in are not."""
    generator, observation = NumpyGenerator(make_generator()), make_observation(5, gaps=True)
    inputs = [last(part) for part in (observation.observed, observation.seen, observation.velocity)]
    inputs.append(observation.vehicle[0].numpy())
    before = [array.copy() for array in inputs]
    heading = generator.heading(inputs[2])
    first = generator.local_mixture(*inputs, heading)
    kept = [array.copy() for array in vars(first).values()]
    inference.modal_paths(first.weights, first.means_m, 1.0)
    inference.to_scene(first, heading)
    second = generator.local_mixture(*inputs, heading)
    for array, copy in zip(inputs, before, strict=True):
        np.testing.assert_array_equal(array, copy)
    for array, copy, again in zip(vars(first).values(), kept, vars(second).values(), strict=True):
        np.testing.assert_array_equal(array, copy)
        np.testing.assert_array_equal(again, copy)


@pytest.mark.parametrize("recipe", ["best", "paper"])
def test_mixture_turns_into_the_scene_as_in_torch(make_generator, make_observation, recipe):
    generator, observation = make_generator(recipe=recipe), make_observation(20, gaps=True)
    wanted, found, heading = both(generator, observation)
    turn = generator.scene_from_local(observation.velocity)
    with torch.inference_mode():
        assert_same(mixture_density.rotate(wanted, turn.unsqueeze(1)), inference.to_scene(found, heading), atol=1e-5)


def test_needle_across_the_axes_keeps_a_correlation_below_one():
    one = np.ones((1, 1, 1), np.float32)
    needle = LocalMixture(one, np.zeros((2, 1, 1, 1), np.float32), np.stack([20 * one, 0.007 * one]), 0 * one)
    turned = inference.to_scene(needle, np.full((2, 1), np.sqrt(0.5), np.float32))
    assert turned.rhos.item() == pytest.approx(0.9999)
    assert turned.sigmas_m.ravel() == pytest.approx(20 * np.sqrt([0.5, 0.5]))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    A=st.integers(1, 9),
    K=st.integers(1, 9),
    P=st.integers(1, 6),
    spread=st.floats(0.1, 4),
)
def test_modal_paths_are_those_of_torch(seed, A, K, P, spread):
    rng = np.random.default_rng(seed)
    weights = rng.dirichlet(np.full(K, 0.7), (A, P)).astype(np.float32)
    means = np.cumsum(rng.normal(0, spread, (A, P, K, 2)), axis=1).astype(np.float32)
    wanted = modal_paths.modal_paths(torch.from_numpy(weights), torch.from_numpy(means), eps_m=1.0)
    probabilities, points = inference.modal_paths(
        np.ascontiguousarray(weights.T), np.ascontiguousarray(means.T), eps_m=1.0
    )
    L = len(probabilities)
    assert (wanted.probabilities > 0).sum(dim=1).max() == L
    np.testing.assert_array_equal(probabilities.T > 0, wanted.probabilities[:, :L] > 0)
    np.testing.assert_allclose(probabilities.T, wanted.probabilities[:, :L], atol=1e-6)
    there = probabilities.T > 0
    np.testing.assert_allclose(points.T[there], wanted.points[:, :L][torch.from_numpy(there)], atol=1e-5)


@pytest.mark.parametrize("pooling", ["gvat", "social"])
@pytest.mark.parametrize("A", [30, 230])
def test_last_bits_do_not_depend_on_how_many_threads_blas_may_use(make_generator, make_observation, pooling, A):
    generator, observation = make_generator(pooling=pooling), make_observation(A, gaps=True)
    answers = []
    for threads in (1, 8):
        with threadpool_limits(threads, "blas"):
            _, found, _ = both(generator, observation)
        answers.append([part.tobytes() for part in vars(found).values()])
    assert answers[0] == answers[1]
