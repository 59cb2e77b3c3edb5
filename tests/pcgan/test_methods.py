"""A network behind the interface of the tables says what the network says, scene by scene or in batches."""

import pytest
import torch

from pcgan import checkpoint
from pcgan.batches import Observation, batches
from pcgan.checkpoint import CheckpointError
from pcgan.methods import GeneratorMethod, load_method, method_of
from pcgan.modal_paths import modal_paths
from pcgan.sgan import Sgan, SganConfig
from pcgan.sr_lstm import SrLstmConfig, SrLstmMethod


@pytest.fixture
def random():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def branching(make_generator):
    """A generator whose components lie apart, so that some people have several paths."""
    generator = make_generator(dt_s=0.4)
    with torch.no_grad():
        generator.phi_mdn.weight.mul_(8)
    return generator.requires_grad_(False)


def test_forecast_is_the_networks_mixture_and_multipacs_paths(branching, make_observation, random):
    observation = make_observation(6, gaps=True, dt_s=0.4)
    forecast = GeneratorMethod("pcgan", branching).forecast(observation, random)
    mixture = branching(observation)
    paths = modal_paths(mixture.weights, mixture.means, branching.config.eps_m)
    torch.testing.assert_close(forecast.mixture.means, mixture.means)
    L = forecast.paths.probabilities.shape[-1]
    assert L == (paths.probabilities > 0).sum(dim=-1).max() > 1
    assert not paths.probabilities[:, L:].any()
    torch.testing.assert_close(forecast.paths.probabilities, paths.probabilities[:, :L])
    torch.testing.assert_close(forecast.paths.points, paths.points[:, :L])
    torch.testing.assert_close(forecast.likeliest, paths.points[:, 0])
    assert forecast.samples is None


def test_batches_and_single_scenes_get_the_same(branching, make_windows, random):
    method = GeneratorMethod("pcgan", branching)
    (batch,) = batches(make_windows((3, 1, 5), gaps=True), 1000)
    together, observation = method.forecast(batch.observation, random), batch.observation
    assert together.paths.points.shape[:2] == together.mixture.rhos.shape[:2] == (3, 5)
    for s, A in enumerate(batch.real.sum(dim=1).tolist()):
        alone = method.forecast(
            Observation(observation.observed[s, :A], observation.seen[s, :A], observation.velocity[s, :A],
                        observation.neighbours[s, :A, :A], observation.vehicle[s, :A]), random
        )  # fmt: skip
        L = alone.paths.probabilities.shape[-1]
        torch.testing.assert_close(together.mixture.means[s, :A], alone.mixture.means, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(together.likeliest[s, :A], alone.likeliest, atol=1e-4, rtol=1e-4)
        probabilities = together.paths.probabilities[s, :A]
        torch.testing.assert_close(probabilities[:, :L], alone.paths.probabilities, atol=1e-5, rtol=0)
        assert not probabilities[:, L:].any()


def test_nothing_is_random_in_a_generators_answer(branching, make_observation, random):
    method, observation = GeneratorMethod("pcgan", branching), make_observation(3, dt_s=0.4)
    first, second = method.forecast(observation, random), method.forecast(observation, random)
    assert torch.equal(first.paths.points, second.paths.points)
    assert torch.equal(random.get_state(), torch.Generator().manual_seed(0).get_state())


@pytest.mark.parametrize(
    ("config", "type_"),
    [(None, GeneratorMethod), (SganConfig(pooling_hidden=16), Sgan), (SrLstmConfig(), SrLstmMethod)],
)
def test_every_kind_of_checkpoint_is_a_method(branching, tmp_path, make_observation, random, config, type_):
    network = branching if config is None else checkpoint.build(config).eval().requires_grad_(False)
    path = tmp_path / "made.safetensors"
    checkpoint.save(path, network.config, network.state_dict(), {})
    method = load_method(path)
    assert type(method) is type_
    assert method.name == "made"
    assert load_method(path, "PCGAN").name == "PCGAN"
    observation = make_observation(3, dt_s=0.4)
    found = method.forecast(observation, random)
    wanted = method_of("wanted", network).forecast(observation, torch.Generator().manual_seed(0))
    assert found.mixture.rhos.shape[:2] == (3, 12)
    torch.testing.assert_close(found.paths.points, wanted.paths.points)
    torch.testing.assert_close(found.mixture.log_sigmas, wanted.mixture.log_sigmas)


def test_what_is_no_checkpoint_is_no_method(tmp_path):
    with pytest.raises(CheckpointError, match=r"no checkpoint .*nothing"):
        load_method(tmp_path / "nothing.safetensors")
