"""How wide the predicted distributions are, fitted after training to windows that were not learnt from.

A network knows the people it learnt from better than those it meets. One number per predicted step widens (or narrows)
all it says about that step, so that its 90 % regions hold 90 % of the validation windows; where anything lies, and how
probable it is next to the rest, stays as it is. Fitting the likelihood instead narrows them: it gains where people are
easily predicted, and loses the regions' meaning elsewhere.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pcgan import distribution_metrics
from pcgan.batches import batches
from pcgan.checkpoint import Network
from pcgan.dataset import Windows
from pcgan.losses import local_future
from pcgan.mixture_density import GaussianMixture, log_likelihood
from pcgan.model import Generator
from pcgan.sgan import SganGenerator, fit_bandwidths
from pcgan.sr_lstm import fit_sigmas
from schemas.messages import FloatArray

LOG_SHIFTS = np.linspace(-0.4, 0.8, 13)  # 0.67 to 2.2 times as wide
SHARE = 0.9
MOST_PEDESTRIANS = 4000  # half a point of coverage is all that more would tell
_SAMPLES = 64


def calibrate(network: Network, windows: Windows) -> None:
    """Sets the widths of a network's distributions, in place; of SGAN and SR-LSTM to what is most likely."""
    if isinstance(network, Generator):
        fit_log_sigma_shift(network, windows)
    elif isinstance(network, SganGenerator):
        fit_bandwidths(network, windows, torch.Generator().manual_seed(0))
    else:
        fit_sigmas(network, windows)


@torch.no_grad()
def fit_log_sigma_shift(network: Generator, windows: Windows) -> None:
    """Sets a generator's `log_sigma_shift`: at each step, what makes the 90 % regions hold 90 %.

    Raises ValueError if nobody's future is known throughout.
    """
    network.log_sigma_shift.zero_()
    draws = torch.Generator().manual_seed(0)
    mixtures, targets = _some(network, windows, draws)
    held = np.zeros((len(LOG_SHIFTS), network.config.predicted_steps))
    for row, shift in zip(held, LOG_SHIFTS, strict=True):
        row[:] = _coverage(replace(mixtures, log_sigmas=mixtures.log_sigmas + shift), targets, draws)
    rising = np.maximum.accumulate(held, axis=0)  # wider regions hold more, but for the samples' noise
    shifts = [np.interp(SHARE, column, LOG_SHIFTS) for column in rising.T]
    network.log_sigma_shift.copy_(torch.tensor(shifts))


def _some(network: Generator, windows: Windows, draws: torch.Generator) -> tuple[GaussianMixture, Tensor]:
    """Returns the local mixtures (B, P, K) and futures (B, P, 2) of some pedestrians with a future known throughout."""
    parts, targets = [], []
    for batch in batches(windows, 4096):
        chosen = batch.known_throughout
        mixture = network.local_mixture(batch.observation)
        parts.append([part[chosen] for part in (mixture.log_weights, mixture.means, mixture.log_sigmas, mixture.rhos)])
        targets.append(local_future(network, batch)[chosen])
    if not sum(map(len, targets)):
        raise ValueError(f"nobody's future is known throughout, of {len(windows)} people to fit widths to")
    target = torch.cat(targets)
    few = torch.randperm(len(target), generator=draws)[:MOST_PEDESTRIANS]
    return GaussianMixture(*(torch.cat(part)[few] for part in zip(*parts, strict=True))), target[few]


def _coverage(mixture: GaussianMixture, target: Tensor, draws: torch.Generator) -> FloatArray:
    """(B, P, K), (B, P, 2) -> (P,): the share of pedestrians inside the region that should hold 90 %."""
    points = distribution_metrics.sample_paths(mixture, _SAMPLES, draws).transpose(1, 2)  # (B, P, M, 2)
    densities = distribution_metrics.densities(mixture, points)
    ranks = distribution_metrics.density_ranks(densities, log_likelihood(mixture, target).exp(), draws)
    return np.asarray((ranks <= SHARE).double().mean(dim=0).numpy())
