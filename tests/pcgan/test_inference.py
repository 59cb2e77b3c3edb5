"""The numpy generator against the torch one, which is the source, and its MultiPAC against the torch MultiPAC."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcgan import inference, mixture_density, modal_paths
from pcgan.inference import LocalMixture, NumpyGenerator

CONFIGS = {
    "best": {},
    "best without vehicle": {"uses_vehicle": False},
    "paper": {"recipe": "paper"},
    "paper without vehicle": {"recipe": "paper", "uses_vehicle": False},
    "other sizes": {"hidden": 20, "embedding": 12, "mlp": 40, "components": 4, "observed_steps": 5,
                    "predicted_steps": 9, "dt_s": 0.4},
}  # fmt: skip


@pytest.fixture
def make_scene():
    """Builds observed (A, T, 2), velocity (A, 2) and the vehicle (T, 4) of a scene in float32, pedestrians first."""

    def make(A, T=8, seed=0):
        rng = np.random.default_rng(seed)
        velocity = rng.normal(0, 1, (A, 2))
        ages = np.arange(T - 1, -1, -1)[:, None] * 0.1
        observed = rng.uniform(-20, 20, (A, 1, 2)) - ages * velocity[:, None] + rng.normal(0, 0.02, (A, T, 2))
        vehicle = np.concatenate([[2, -3] - ages * [5, 0], np.full((T, 2), [5, 0]) + 0.1 * rng.normal(size=(T, 2))], 1)
        return observed.astype(np.float32), velocity.astype(np.float32), vehicle.astype(np.float32)

    return make


def both(generator, observed, velocity, vehicle):
    """The local mixtures of the torch and of the numpy generator, and the heading."""
    numpy_generator = NumpyGenerator(generator)
    heading = numpy_generator.heading(np.ascontiguousarray(velocity.T))
    found = numpy_generator.local_mixture(
        np.ascontiguousarray(observed.T), np.ascontiguousarray(velocity.T), vehicle, heading
    )
    with torch.inference_mode():
        everyone = torch.ones(len(velocity), len(velocity), dtype=torch.bool)
        seen = None if vehicle is None else torch.from_numpy(vehicle)
        wanted = generator.local_mixture(torch.from_numpy(observed), torch.from_numpy(velocity), everyone, seen)
    return wanted, found, heading


def assert_same(wanted, found, atol):
    np.testing.assert_allclose(found.weights.T, wanted.weights, atol=atol)
    np.testing.assert_allclose(found.means_m.T, wanted.means, atol=atol)
    np.testing.assert_allclose(found.sigmas_m.T, wanted.log_sigmas.exp(), atol=atol)
    np.testing.assert_allclose(found.rhos.T, wanted.rhos, atol=atol)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
@pytest.mark.parametrize("A", [1, 2, 3, 30, 130])  # 130: several blocks everywhere
@pytest.mark.parametrize("with_vehicle", [True, False])
def test_generator_agrees_with_the_torch_one(make_generator, make_scene, config, A, with_vehicle):
    generator = make_generator(seed=A, **config)
    observed, velocity, vehicle = make_scene(A, generator.config.observed_steps, seed=A)
    wanted, found, _ = both(generator, observed, velocity, vehicle if with_vehicle else None)
    assert found.means_m.dtype == found.weights.dtype == np.float32
    assert_same(wanted, found, atol=1e-5)


def test_agreement_outlasts_larger_weights(make_generator, make_scene):
    generator = make_generator()
    with torch.no_grad():
        for weights in generator.parameters():
            weights.mul_(3)  # gates, attention and sigmas at their limits
    wanted, found, _ = both(generator, *make_scene(30))
    assert_same(wanted, found, atol=1e-5)


def test_somebody_at_rest_has_the_scene_for_a_frame(make_generator, make_scene):
    observed, velocity, vehicle = make_scene(4)
    velocity[1] = 0
    wanted, found, heading = both(make_generator(), observed, velocity, vehicle)
    assert heading[:, 1].tolist() == [1, 0]
    np.testing.assert_allclose(np.hypot(*heading), 1, atol=1e-6)
    assert_same(wanted, found, atol=1e-5)


def test_mixture_turns_into_the_scene_as_in_torch(make_generator, make_scene):
    generator = make_generator()
    observed, velocity, vehicle = make_scene(20)
    wanted, found, heading = both(generator, observed, velocity, vehicle)
    turn = generator.scene_from_local(torch.from_numpy(velocity))
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


def test_last_bits_do_not_depend_on_how_many_threads_blas_may_use():
    script = """
import hashlib
import numpy as np
import torch
from pcgan.inference import NumpyGenerator
from pcgan.model import Generator, ModelConfig
torch.manual_seed(0)
generator = NumpyGenerator(Generator(ModelConfig()))
rng = np.random.default_rng(0)
for A in (30, 230):
    velocity = rng.normal(size=(2, A)).astype(np.float32)
    observed = rng.normal(scale=9, size=(2, 8, A)).astype(np.float32)
    vehicle = rng.normal(size=(8, 4)).astype(np.float32)
    mixture = generator.local_mixture(observed, velocity, vehicle, generator.heading(velocity))
    print(A, *(hashlib.sha256(np.ascontiguousarray(part)).hexdigest() for part in vars(mixture).values()))
"""
    answers = [
        subprocess.run(
            [sys.executable, "-c", script],
            env={**os.environ, "OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for threads in ("1", "8")
    ]
    assert answers[0].count("\n") == 2
    assert answers[0] == answers[1]
