"""Laws of SR-LSTM: masks, moves, the vectorised refinement against a plain loop, and that it learns."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from pcgan.batches import Observation, batches
from pcgan.dataset import Windows
from pcgan.learners_baselines import SrLstmLearner
from pcgan.sr_lstm import SrLstm, SrLstmConfig, SrLstmMethod, StatesRefinement, fit_sigmas


def make_network(seed=0, social=True, **config):
    """A network with random weights; `social`: messages as strong as after training, which starts out near none."""
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(seed)
        network = SrLstm(SrLstmConfig(**config)).eval()
    if social:
        network.refine.phi_mp.weight.data.mul_(100)
    return network


def seeded(seed=3):
    return torch.Generator().manual_seed(seed)


def scene(A=5, T=8, seed=0, spread_m=3.0):
    generator = seeded(seed)
    velocity = torch.randn(A, 2, generator=generator)
    ages = torch.arange(T - 1, -1, -1) * 0.4
    start = spread_m * torch.randn(A, 1, 2, generator=generator)
    observed = start - ages[:, None] * velocity[:, None] + 0.02 * torch.randn(A, T, 2, generator=generator)
    seen, neighbours = torch.ones(A, T, dtype=torch.bool), torch.ones(A, A, dtype=torch.bool)
    return Observation(observed, seen, velocity, neighbours, None)


def first_of(observation, count):
    """The scene with only its first pedestrians."""
    return Observation(
        observation.observed[:count],
        observation.seen[:count],
        observation.velocity[:count],
        observation.neighbours[:count, :count],
        None,
    )


def padded(observation, rows):
    """The same scene among rows of padding in the middle of it."""
    A, T = observation.seen.shape
    neighbours = torch.zeros(A + rows, A + rows, dtype=torch.bool)
    neighbours[:A, :A] = observation.neighbours
    return Observation(
        observed=torch.cat([observation.observed, torch.randn(rows, T, 2, generator=seeded())]),
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


def made_windows(scenes=12, A=3, seed=0):
    """People who walk on and bend to their left, all of them alike."""
    rng = np.random.default_rng(seed)
    heading = rng.uniform(0, 2 * np.pi, (scenes * A, 1)) + 0.15 * 0.4 * np.arange(-7, 13)
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


@torch.no_grad()
def test_output_has_the_promised_shapes():
    network = make_network()
    assert network(scene()).shape == (5, 12, 2)
    assert network(batch_of(scene(seed=1), scene(seed=2))).shape == (2, 5, 12, 2)
    forecast = SrLstmMethod("sr_lstm", network).forecast(scene(), seeded())
    assert forecast.mixture.means.shape == (5, 12, 1, 2)
    torch.testing.assert_close(forecast.likeliest, network(scene()))
    assert SrLstm(SrLstmConfig(predicted_steps=1))(scene()).shape == (5, 1, 2)


def test_nobody_gets_no_paths():
    assert make_network()(first_of(scene(), 0)).shape == (0, 12, 2)


def test_moving_the_scene_moves_the_paths():
    network, still, shift = make_network().double(), scene(), torch.tensor([30.0, -7.0]).double()
    still = replace(still, observed=still.observed.double())
    moved = network(replace(still, observed=still.observed + shift))
    torch.testing.assert_close(moved, network(still) + shift)


def test_reordering_pedestrians_reorders_the_paths():
    network, straight, order = make_network(), scene(), torch.tensor([3, 0, 4, 2, 1])
    mixed = replace(straight, observed=straight.observed[order])
    torch.testing.assert_close(network(mixed), network(straight)[order], atol=1e-5, rtol=1e-5)


def test_padding_changes_nothing():
    network, few, many = make_network(), scene(3, seed=1), scene(6, seed=2)
    both = network(batch_of(padded(few, 3), many))
    torch.testing.assert_close(both[0, :3], network(few), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(both[1], network(many), atol=1e-5, rtol=1e-5)
    assert both.isfinite().all()


def test_somebody_not_seen_throughout_is_not_there():
    network, everybody = make_network(), scene()
    seen = everybody.seen.clone()
    seen[3:, 0] = False
    paths = network(replace(everybody, seen=seen))
    torch.testing.assert_close(paths[:3], network(first_of(everybody, 3)), atol=1e-5, rtol=1e-5)
    assert paths.isfinite().all()


@torch.no_grad()
def test_company_matters_within_the_neighbourhood_only():
    network, pair = make_network(), scene(2, spread_m=1.0)
    alone = network(first_of(pair, 1))
    assert alone.isfinite().all()
    assert (network(pair)[0] - alone[0]).abs().max() > 1e-4
    apart = pair.observed + torch.tensor([[0.0, 0.0], [60.0, 0.0]])[:, None]
    torch.testing.assert_close(network(replace(pair, observed=apart))[0], alone[0], atol=1e-5, rtol=1e-5)


def plain_refinement(refine, hidden, cell, out, place, near):
    """One scene's states refined as the paper has it, one pair at a time."""
    D = hidden.shape[-1]
    gate_i, gate_j, score_j = refine.phi_h.weight.split([D, D, 1])
    gate_weight = torch.cat([refine.gate_r.weight, gate_i, gate_j], dim=1)
    for _ in range(refine.refinements):
        cells = []
        for i in range(len(hidden)):
            others = near[i].nonzero()[:, 0].tolist()
            scores, gated = [], []
            for j in others:
                r = refine.phi_r(place[j] - place[i]).relu()
                gate = (gate_weight @ torch.cat([r, hidden[i], hidden[j]]) + refine.gate_r.bias).sigmoid()
                # With a term of h_i, as the paper has it, the attention is the same: it shifts all scores of i.
                scores.append(refine.score_r(r) + score_j @ hidden[j] + 3 * hidden[i].sum())
                gated.append(gate * hidden[j])
            if others:
                attention = torch.stack(scores).softmax(dim=0)  # (others, 1)
                cells.append(cell[i] + refine.phi_mp((attention * torch.stack(gated)).sum(dim=0)))
            else:
                cells.append(cell[i])
        cell = torch.stack(cells)
        hidden = out * cell.tanh()
    return hidden, cell


@pytest.mark.parametrize("refinements", [1, 2, 3])
def test_refinement_agrees_with_a_plain_loop(refinements):
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)
        refine = StatesRefinement(SrLstmConfig(refinements=refinements))
        refine.phi_mp.weight.data.mul_(100)
        hidden, cell, out = torch.randn(2, 5, 64).tanh(), torch.randn(2, 5, 64), torch.rand(2, 5, 64)
        place, near = 3 * torch.randn(2, 5, 2), torch.rand(2, 5, 5) < 0.6
        near[1, 2] = False
    refined = refine(hidden, cell, out, place, near)
    for s in range(2):
        plain = plain_refinement(refine, hidden[s], cell[s], out[s], place[s], near[s])
        torch.testing.assert_close((refined[0][s], refined[1][s]), plain, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(refined[1][1, 2], cell[1, 2])


@torch.no_grad()
def test_somebody_alone_gets_a_plain_autoregressive_lstm():
    network, alone = make_network(), scene(1)
    h, c = torch.zeros(1, 64), torch.zeros(1, 64)
    for velocity in (alone.observed[:, 1:] - alone.observed[:, :-1]).unbind(dim=1):
        h, c = network.cell(network.phi_e(velocity / 0.4).relu(), (h, c))
    place, path = alone.observed[:, -1], []
    for _ in range(12):
        velocity = network.phi_x(h)
        place = place + 0.4 * velocity
        path.append(place)
        h, c = network.cell(network.phi_e(velocity).relu(), (h, c))
    torch.testing.assert_close(network(alone), torch.stack(path, dim=1), atol=1e-5, rtol=1e-5)


def trained(epochs, seed=0):
    learner = SrLstmLearner(make_network(seed, social=False), 1e-2, epochs)
    losses = []
    for epoch in range(epochs):
        generator = seeded(epoch)
        losses += [learner.step(batch, epoch, generator) for batch in batches(made_windows(), 36, generator)]
    return learner, losses


def test_learner_learns_and_repeats_exactly():
    learner, losses = trained(25)
    assert losses[-1]["path"] < 0.3 * losses[0]["path"]
    assert trained(2)[1] == trained(2)[1]
    nobody = made_windows(scenes=2)
    nobody.future[:, -1] = np.nan
    [batch] = batches(nobody, 36)
    assert learner.step(batch, 0, seeded()) == {}


def test_gradient_reaches_every_weight():
    network = make_network(social=False)
    network(scene()).square().sum().backward()
    silent = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    assert silent == []
    assert all(p.grad.any() for p in network.parameters())


def test_sigmas_are_the_errors_where_the_future_is_known():
    network, windows = make_network(), made_windows(scenes=5)
    windows.future[:3, 6:] = np.nan
    fit_sigmas(network, windows)
    with torch.no_grad():
        path = torch.cat([network(b.observation)[b.real] for b in batches(windows, 1000)]).numpy()
    rows = np.concatenate([b.row[b.real].numpy() for b in batches(windows, 1000)])
    expected = np.sqrt(np.nanmean(np.square(path - windows.future[rows]), axis=(0, 2)))
    np.testing.assert_allclose(network.sigmas_m.numpy(), expected, rtol=1e-4)
    windows.seen[:, 0] = False
    with pytest.raises(ValueError, match="no window has a complete history"):
        fit_sigmas(network, windows)


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"observed_steps": 1}, "at least 2"),
        ({"refinements": 0}, "refinements"),
        ({"neighbourhood_m": 0.0}, "neighbourhood_m must be positive"),
        ({"dt_s": float("nan")}, "dt_s must be positive"),
    ],
)
def test_senseless_configuration_is_refused(fields, problem):
    with pytest.raises(ValueError, match=problem):
        SrLstmConfig(**fields)


def test_configuration_survives_a_dictionary():
    config = SrLstmConfig(refinements=1)
    assert SrLstmConfig.from_dict(asdict(config)) == config
    with pytest.raises(ValueError, match="hidden is '64', not a int"):
        SrLstmConfig.from_dict(asdict(config) | {"hidden": "64"})
    with pytest.raises(ValueError, match="differs in the fields"):
        SrLstmConfig.from_dict({"hidden": 64})
