"""Widths fitted after training: a generator that knows how its futures are drawn is put right where it is not."""

import math

import numpy as np
import pytest
import torch

from pcgan import checkpoint
from pcgan.batches import batches
from pcgan.calibration import LOG_SHIFTS, calibrate, fit_log_sigma_shift
from pcgan.dataset import concatenate
from pcgan.distribution_metrics import sample_paths
from pcgan.methods import method_of
from pcgan.scores import score_method
from pcgan.sgan import SganConfig
from pcgan.sr_lstm import SrLstmConfig

ABOUT = 0.1  # what 800 people tell: 3 standard errors of a coverage of 90 %, over its slope


@pytest.fixture
def generator(make_generator):
    return make_generator(dt_s=0.4, hidden=8, embedding=8, mlp=16).requires_grad_(False)


@pytest.fixture
def windows(make_windows, generator):
    """Scenes whose futures are drawn from what the generator predicts; the vehicle is far off."""
    made = make_windows((3, 1, 2, 4) * 80)
    draws = torch.Generator().manual_seed(0)
    for batch in batches(made, 4096):
        drawn = sample_paths(generator(batch.observation), 1, draws)[..., 0, :, :]
        real = batch.real
        made.future[batch.row[real].numpy()] = drawn[real].numpy()
    return made


def made_wider(generator, factor):
    """Makes all sigmas wider by a factor, in the network's own weights."""
    K = generator.config.components
    generator.phi_mdn.bias[3 * K : 5 * K] += math.log(factor)


@pytest.mark.parametrize("factor", [0.5, 1.0, 1.4])
def test_sigmas_that_are_too_narrow_or_too_wide_are_put_right(generator, windows, factor):
    """At every step; and the regions that should hold 50 % or 90 % do so again."""
    made_wider(generator, factor)
    before = score_method(method_of("made", generator), windows, 12, torch.Generator().manual_seed(0))
    fit_log_sigma_shift(generator, windows)
    after = score_method(method_of("made", generator), windows, 12, torch.Generator().manual_seed(0))
    np.testing.assert_allclose(generator.log_sigma_shift, -math.log(factor), atol=ABOUT)
    assert after.coverage_50 == pytest.approx(0.5, abs=0.05)
    assert after.coverage_90 == pytest.approx(0.9, abs=0.02)
    if factor != 1:
        assert abs(after.coverage_50 - 0.5) < 0.5 * abs(before.coverage_50 - 0.5)
        assert abs(after.coverage_90 - 0.9) < 0.5 * abs(before.coverage_90 - 0.9)
        assert after.nll < before.nll
    assert after.ade == before.ade  # nothing moves


@pytest.mark.parametrize(("factor", "end"), [(5.0, 0), (0.1, -1)])
def test_beyond_the_grid_its_end_is_taken(generator, windows, factor, end):
    made_wider(generator, factor)
    fit_log_sigma_shift(generator, windows)
    np.testing.assert_allclose(generator.log_sigma_shift, LOG_SHIFTS[end], atol=1e-6)


def test_each_step_is_fitted_for_itself(generator, windows):
    """Futures that stray twice as far from the path at one step widen that step alone."""
    method = method_of("made", generator)
    for batch in batches(windows, 4096):
        path = method.forecast(batch.observation, torch.Generator()).likeliest[batch.real].numpy()
        rows = batch.row[batch.real].numpy()
        windows.future[rows, 4] = path[:, 4] + 2 * (windows.future[rows, 4] - path[:, 4])
    fit_log_sigma_shift(generator, windows)
    assert generator.log_sigma_shift[4] == pytest.approx(math.log(2), abs=1.5 * ABOUT)
    np.testing.assert_allclose(np.delete(generator.log_sigma_shift.numpy(), 4), 0, atol=ABOUT)


def test_fitting_twice_changes_nothing(generator, make_windows):
    """What was fitted before does not count: it is taken back first. And the draws have a seed."""
    windows = make_windows((3, 1, 2, 4) * 3)
    fit_log_sigma_shift(generator, windows)
    once = generator.log_sigma_shift.clone()
    assert once.abs().max() > 0.05
    torch.rand(7)  # whatever the global generator has been up to
    fit_log_sigma_shift(generator, windows)
    assert torch.equal(generator.log_sigma_shift, once)


def test_people_with_an_unknown_future_do_not_count(generator, windows):
    made_wider(generator, 0.5)
    windows = windows.select(windows.scene < 100)
    fit_log_sigma_shift(generator, windows)
    alone = generator.log_sigma_shift.clone()
    lost = windows.select(windows.scene < 40)
    lost.future[:] += 50.0
    lost.future[:, 9:] = np.nan
    fit_log_sigma_shift(generator, concatenate([lost, windows]))
    torch.testing.assert_close(generator.log_sigma_shift, alone, atol=0.01, rtol=0)
    with pytest.raises(ValueError, match="nobody's future is known throughout"):
        fit_log_sigma_shift(generator, lost)
    assert torch.isfinite(generator.log_sigma_shift).all()


@pytest.mark.parametrize(
    ("config", "buffer"), [(SganConfig(pooling_hidden=16), "bandwidths_m"), (SrLstmConfig(hidden=8), "sigmas_m")]
)
def test_baselines_get_widths_too(make_windows, config, buffer):
    """Both then have a higher likelihood than before, and the same weights, and the same whenever it is asked for."""
    windows = make_windows((3, 1, 2, 4) * 4)
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)
        network = checkpoint.build(config)
    method, weights = method_of("made", network), [p.detach().clone() for p in network.parameters()]
    before = score_method(method, windows, 12, torch.Generator().manual_seed(0)).nll
    calibrate(network, windows)
    fitted = dict(network.named_buffers())[buffer].clone()
    assert (fitted > 0).all()
    assert score_method(method, windows, 12, torch.Generator().manual_seed(0)).nll < before
    assert all(torch.equal(p, w) for p, w in zip(network.parameters(), weights, strict=True))
    calibrate(network, windows)
    assert torch.equal(dict(network.named_buffers())[buffer], fitted)


def test_generator_is_calibrated_by_its_own_rule(generator, make_windows):
    windows = make_windows((3, 1, 2, 4))
    calibrate(generator, windows)
    found = generator.log_sigma_shift.clone()
    assert found.any()
    fit_log_sigma_shift(generator, windows)
    assert torch.equal(generator.log_sigma_shift, found)
