"""Laws of Social GAN: masks, moves, the vectorised parts against plain loops, and that it learns."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from torch import nn

from pcgan import sgan
from pcgan.batches import Batch, Observation, batches
from pcgan.dataset import Windows
from pcgan.learners_baselines import SganLearner, complete
from pcgan.sgan import (
    SAMPLES,
    PoolHidden,
    Sgan,
    SganConfig,
    SganDiscriminator,
    SganGenerator,
    adversarial_loss,
    fit_bandwidths,
    last_velocity,
    together,
)


def make_network(seed=0, **config):
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(seed)
        return SganGenerator(SganConfig(**config)).eval()


def scene(A=5, T=8, seed=0, spread_m=4.0):
    generator = torch.Generator().manual_seed(seed)
    velocity = torch.randn(A, 2, generator=generator)
    ages = torch.arange(T - 1, -1, -1) * 0.4
    start = spread_m * torch.randn(A, 1, 2, generator=generator)
    observed = start - ages[:, None] * velocity[:, None] + 0.02 * torch.randn(A, T, 2, generator=generator)
    seen, neighbours = torch.ones(A, T, dtype=torch.bool), torch.ones(A, A, dtype=torch.bool)
    return Observation(observed, seen, velocity, neighbours, None)


def padded(observation, rows):
    """The same scene among rows of padding that is far from harmless."""
    A, T = observation.seen.shape
    neighbours = torch.zeros(A + rows, A + rows, dtype=torch.bool)
    neighbours[:A, :A] = observation.neighbours
    return Observation(
        observed=torch.cat([observation.observed, 50 * torch.randn(rows, T, 2, generator=seeded())]),
        seen=torch.cat([observation.seen, torch.ones(rows, T, dtype=torch.bool)]),
        velocity=torch.cat([observation.velocity, torch.ones(rows, 2)]),
        neighbours=neighbours,
        vehicle=None,
    )


def batch_of(*observations):
    return Observation(
        observed=torch.stack([o.observed for o in observations]),
        seen=torch.stack([o.seen for o in observations]),
        velocity=torch.stack([o.velocity for o in observations]),
        neighbours=torch.stack([o.neighbours for o in observations]),
        vehicle=None,
    )


def made_windows(scenes=30, A=3, seed=0):
    """People who walk on and bend to their left, all of them alike."""
    rng = np.random.default_rng(seed)
    time_s = 0.4 * np.arange(-7, 13)
    heading = rng.uniform(0, 2 * np.pi, (scenes * A, 1)) + 0.15 * time_s
    steps = 0.4 * 1.3 * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    paths = np.cumsum(steps, axis=1)
    paths += rng.normal(0, 4, (scenes * A, 1, 2)) - paths[:, 7:8]
    N = scenes * A
    return Windows(
        observed=paths[:, :8].astype(np.float32),
        seen=np.ones((N, 8), bool),
        velocity=(steps[:, 7] / 0.4).astype(np.float32),
        future=paths[:, 8:].astype(np.float32),
        vehicle=np.full((N, 8, 4), np.nan, np.float32),
        scene=np.repeat(np.arange(scenes), A),
        annotated=np.ones(N, bool),
        dt_s=0.4,
    )


def noise_of(*shape, seed=1):
    return torch.randn(*shape, 8, generator=torch.Generator().manual_seed(seed))


def seeded(seed=3):
    return torch.Generator().manual_seed(seed)


def test_output_has_the_promised_shapes():
    network, one, two = make_network(), scene(), batch_of(scene(seed=1), scene(seed=2))
    with torch.no_grad():
        assert network(one, noise_of()).shape == (5, 12, 2)
        assert network(two, noise_of(2)).shape == (2, 5, 12, 2)
        assert network.sample(one, 7, seeded()).shape == (5, 7, 12, 2)
        assert network.sample(two, 7, seeded(), copies=True).shape == (2, 5, 7, 12, 2)
    forecast = Sgan("sgan", network).forecast(two, seeded())
    assert forecast.samples.shape == (2, 5, SAMPLES, 12, 2)
    assert forecast.mixture.means.shape == (2, 5, 12, SAMPLES, 2)
    torch.testing.assert_close(forecast.paths.probabilities.sum(-1), torch.ones(2, 5))
    torch.testing.assert_close(forecast.mixture.means.transpose(-3, -2), forecast.paths.points)


@pytest.mark.parametrize("copies", [True, False])
def test_nobody_gets_no_paths(copies):
    nobody = scene_without_last(scene(), 5)
    forecast = Sgan("sgan", make_network(), copies=copies).forecast(nobody, seeded())
    assert forecast.samples.shape == (0, SAMPLES, 12, 2)


def test_moving_the_scene_moves_the_paths():
    network, still, shift = make_network().double(), scene(), torch.tensor([30.0, -7.0]).double()
    still = replace(still, observed=still.observed.double())
    moved = network(replace(still, observed=still.observed + shift), noise_of().double())
    torch.testing.assert_close(moved, network(still, noise_of().double()) + shift)


@pytest.mark.parametrize("grad", [True, False])
def test_padding_changes_nothing(grad):
    network = make_network()
    few, many = scene(3, seed=1), scene(6, seed=2)
    with torch.set_grad_enabled(grad):
        together_ = network(batch_of(padded(few, 3), many), noise_of(2))
        torch.testing.assert_close(together_[0, :3], network(few, noise_of(2)[0]), atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(together_[1], network(many, noise_of(2)[1]), atol=1e-5, rtol=1e-5)
    assert together_.isfinite().all()


@pytest.mark.parametrize("grad", [True, False])
def test_somebody_not_seen_throughout_is_not_there(grad):
    network, all_five = make_network(), scene()
    seen = all_five.seen.clone()
    seen[3:, 0] = False
    with torch.set_grad_enabled(grad):
        paths = network(replace(all_five, seen=seen), noise_of())
        without = scene_without_last(all_five, 2)
        torch.testing.assert_close(paths[:3], network(without, noise_of()), atol=1e-5, rtol=1e-5)
    assert paths.isfinite().all()


def scene_without_last(observation, count):
    A = len(observation.seen) - count
    return Observation(
        observation.observed[:A], observation.seen[:A], observation.velocity[:A], observation.neighbours[:A, :A], None
    )


def test_somebody_alone_is_predicted_and_company_matters():
    network = make_network()
    with torch.no_grad():
        alone = network(scene_without_last(scene(), 4), noise_of())
        assert alone.isfinite().all()
        assert (alone[0] - network(scene(), noise_of())[0]).abs().max() > 1e-4


def test_reordering_pedestrians_reorders_the_paths():
    network, straight, order = make_network(), scene(), torch.tensor([3, 0, 4, 2, 1])
    mixed = replace(straight, observed=straight.observed[order], velocity=straight.velocity[order])
    with torch.no_grad():
        torch.testing.assert_close(network(mixed, noise_of()), network(straight, noise_of())[order])


@pytest.mark.parametrize("observation", [scene(), batch_of(scene(seed=1), scene(seed=2))])
def test_copies_of_the_scene_and_of_the_decoder_give_the_same_samples(observation):
    network = make_network()
    with torch.no_grad():
        copied = network.sample(observation, 6, seeded(), copies=True)
        shared = network.sample(observation, 6, seeded())
        noise = torch.randn(*observation.observed.shape[:-3], 6, 8, generator=seeded())
        singly = torch.stack([network(observation, noise[..., n, :]) for n in range(6)], dim=-3)
    torch.testing.assert_close(copied, shared, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(singly, shared, atol=1e-5, rtol=1e-5)
    assert shared.std(dim=-3).min() > 0


def test_samples_repeat_with_their_generator():
    method = Sgan("sgan", make_network())
    first, again, other = (method.forecast(scene(), seeded(s)).samples for s in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_decoder_agrees_with_a_plain_autoregressive_loop():
    network = make_network()
    context, velocity, noise = torch.randn(4, 34, generator=seeded()).split([24, 2, 8], dim=1)
    cell = nn.LSTMCell(16, 32)
    cell.load_state_dict({name.removesuffix("_l0"): part for name, part in network.decoder.state_dict().items()})
    with torch.no_grad():
        h, c, x, place, path = torch.cat([context, noise], 1), torch.zeros(4, 32), velocity, torch.zeros(4, 2), []
        for _ in range(12):
            h, c = cell(network.phi_d(x), (h, c))
            x = network.phi_x(h)
            place = place + 0.4 * x
            path.append(place)
        torch.testing.assert_close(network.decode(context, velocity, noise), torch.stack(path, 1), atol=1e-5, rtol=1e-4)


def plain_pool(pool, hidden, place, near):
    """The pooling as the paper has it: a concatenation for every pair, then the maximum."""
    pooled = []
    for i in range(len(hidden)):
        outs = [torch.zeros(pool.mlp_out.out_features)]
        for j in near[i].nonzero()[:, 0].tolist():
            r = pool.phi_r(place[j] - place[i])
            weight = torch.cat([pool.mlp_r.weight, pool.mlp_h.weight], dim=1)
            first = (weight @ torch.cat([r, hidden[j]]) + pool.mlp_r.bias).relu()
            outs.append(pool.mlp_out(first).relu())
        pooled.append(torch.stack(outs).amax(dim=0))
    return torch.stack(pooled)


@pytest.mark.parametrize("chunk", [1, 3 * 6 * 512, 1 << 20])
def test_pooling_and_its_gradient_agree_with_a_plain_loop(monkeypatch, chunk):
    monkeypatch.setattr(sgan, "CHUNK", chunk)
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)
        pool = PoolHidden(SganConfig())
        hidden, place = torch.randn(3, 6, 32, requires_grad=True), 3 * torch.randn(3, 6, 2)
        near = torch.rand(3, 6, 6) < 0.6
        near[1, 2] = False
        direction = torch.randn(3, 6, 8)
    results = []
    for pooled in (
        pool(hidden, place, near),
        torch.stack([plain_pool(pool, hidden[s], place[s], near[s]) for s in range(3)]),
    ):
        pool.zero_grad()
        hidden.grad = None
        (pooled * direction).sum().backward()
        results.append([pooled.detach(), hidden.grad, *(p.grad for p in pool.parameters())])
    with torch.no_grad():
        torch.testing.assert_close(pool(hidden, place, near), results[1][0], atol=1e-5, rtol=1e-5)
    for vectorised, plain in zip(*results, strict=True):
        torch.testing.assert_close(vectorised, plain, atol=1e-4, rtol=1e-4)
    assert not results[0][0][1, 2].any()


def test_best_sample_alone_has_the_gradient_of_the_variety_loss():
    """What the learner relies on: the minimum over k samples, and its winner drawn again, have one gradient."""
    network, observation = make_network(), scene()
    future, noise = torch.randn(5, 12, 2, generator=seeded()), noise_of(4)
    velocity = last_velocity(observation, 0.4)

    def losses(of):
        context = network.encode(observation).unsqueeze(1)
        ahead = network.decode(context, velocity.unsqueeze(1), of)
        return (ahead - future.unsqueeze(1)).square().sum(dim=(0, 2, 3))

    gradients = []
    for loss in (lambda: losses(noise).min(), lambda: losses(noise[losses(noise).argmin()].unsqueeze(0)).sum()):
        network.zero_grad()
        loss().backward()
        gradients.append([p.grad.clone() for p in network.parameters()])
    for all_samples, winner in zip(*gradients, strict=True):
        torch.testing.assert_close(all_samples, winner, atol=1e-4, rtol=1e-3)


def trained(epochs, seed=0):
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(seed)
        learner = SganLearner(SganGenerator(SganConfig()), 1e-2, epochs)
    losses = []
    for epoch in range(epochs):
        generator = torch.Generator().manual_seed(epoch)
        losses += [learner.step(batch, epoch, generator) for batch in batches(made_windows(), 45, generator)]
    return learner, losses


def test_discriminator_sees_displacements_only():
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)
        judge = SganDiscriminator(SganConfig())
    paths = torch.randn(6, 20, 2, generator=seeded())
    logits = judge(paths)
    assert logits.shape == (6,)
    torch.testing.assert_close(judge(paths + torch.tensor([3.0, -5.0])), logits, atol=1e-5, rtol=1e-5)


def test_adversarial_loss_is_binary_cross_entropy():
    logits = torch.tensor([0.0, 2.0])
    probability = logits.sigmoid()
    torch.testing.assert_close(adversarial_loss(logits, real=True), -probability.log().mean())
    torch.testing.assert_close(adversarial_loss(logits, real=False), -(1 - probability).log().mean())


def test_learner_learns_and_repeats_exactly():
    learner, losses = trained(15)
    assert losses[-1]["variety"] < 0.3 * losses[0]["variety"]
    assert all(np.isfinite(list(values.values())).all() for values in losses)
    assert losses[0].keys() == {"variety", "adversarial", "discriminator"}
    _, once = trained(2)
    other, again = trained(2)
    assert once == again
    for name in ("generator", "discriminator"):
        fresh = make_network() if name == "generator" else SganDiscriminator(learner.config)
        assert other.modules[name].state_dict().keys() == fresh.state_dict().keys()
        assert all(p.requires_grad for p in other.modules[name].parameters())


def test_learner_leaves_out_whoever_it_cannot_learn_from():
    [batch] = batches(made_windows(scenes=4), 100)
    seen, known = batch.observation.seen.clone(), batch.known.clone()
    seen[0, 0, 0] = False  # one of scene 0 is not seen throughout
    known[1, 2, -1] = False  # one of scene 1 has no known end, but is a neighbour
    known[2] = False  # nobody in scene 2 has
    left: Batch = complete(replace(batch, observation=replace(batch.observation, seen=seen), known=known))
    assert left.row.shape == (3, 3)
    assert left.real.sum(dim=1).tolist() == [2, 3, 3]
    assert left.known_throughout.sum(dim=1).tolist() == [2, 2, 3]
    assert left.row[0, :2].tolist() == batch.row[0, 1:].tolist()
    assert together(left.observation)[0].sum() == 2 * 2  # and the row of padding that is left has no part
    nobody = replace(batch, known=torch.zeros_like(batch.known))
    assert SganLearner(make_network()).step(nobody, 0, seeded()) == {}


def test_learning_rate_falls_along_a_cosine():
    learner = SganLearner(make_network(), 1e-3, epochs=11)
    [batch] = batches(made_windows(scenes=2), 100)
    rates = []
    for epoch in (0, 5, 10):
        learner.step(batch, epoch, seeded())
        rates.append([group["lr"] for optimiser in learner.optimisers for group in optimiser.param_groups])
    np.testing.assert_allclose(rates, [[1e-3] * 2, [0.51e-3] * 2, [0.02e-3] * 2])


def test_bandwidths_are_fitted_where_the_future_is_known():
    network, windows = make_network(), made_windows(scenes=5)
    fit_bandwidths(network, windows, seeded())
    fitted = network.bandwidths_m.clone()
    assert (fitted > 0).all()
    assert fitted[-1] > fitted[0]  # further ahead an untrained network is further off
    windows.future[:, 6:] = np.nan
    fit_bandwidths(network, windows, seeded())
    torch.testing.assert_close(network.bandwidths_m[:6], fitted[:6])
    windows.seen[:, 0] = False
    with pytest.raises(ValueError, match="no window has a complete history"):
        fit_bandwidths(network, windows, seeded())


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"observed_steps": 1}, "at least 2"),
        ({"bottleneck": 0}, "bottleneck"),
        ({"noise_dim": 32}, "noise_dim must be below"),
        ({"dt_s": float("nan")}, "dt_s must be positive"),
    ],
)
def test_senseless_configuration_is_refused(fields, problem):
    with pytest.raises(ValueError, match=problem):
        SganConfig(**fields)


def test_configuration_survives_a_dictionary():

    config = SganConfig(bottleneck=32)
    assert SganConfig.from_dict(asdict(config)) == config
    with pytest.raises(ValueError, match="mlp is '64', not a int"):
        SganConfig.from_dict(asdict(config) | {"mlp": "64"})
    with pytest.raises(ValueError, match="differs in the fields"):
        SganConfig.from_dict({"mlp": 64})
