"""What every predictor gives: a mixture per pedestrian and step, and a few likely paths. And what needs no network.

A `Method` is asked with an observation; batches and single scenes look the same to it. Networks are methods in
`pcgan/methods.py`; here are the extrapolations they have to beat.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pcgan import batches
from pcgan.batches import Observation
from pcgan.dataset import Windows
from pcgan.mixture_density import GaussianMixture
from pcgan.modal_paths import ModalPaths

MIN_SIGMA_M = 0.01


@dataclass(frozen=True, eq=False)
class Forecast:
    """A prediction of all pedestrians of a batch, in scene coordinates; `...` is S, A or A alone."""

    mixture: GaussianMixture  # (..., P, K)
    paths: ModalPaths  # probabilities (..., L), falling, 0 where there is none; points (..., L, P, 2)
    samples: Tensor | None = None  # (..., N, P, 2) m, of methods that are scored by the mean error of samples

    @property
    def likeliest(self) -> Tensor:
        """(..., P, 2): the most probable path."""
        return self.paths.points[..., 0, :, :]


class Method(Protocol):
    """One predictor of the tables."""

    name: str

    def forecast(self, observation: Observation, generator: torch.Generator) -> Forecast:
        """Predicts everybody observed; `generator` is the source of whatever is drawn at random."""
        ...


class Extrapolation:
    """Straight on: `lin`, a least-squares line through what was observed; `cvm`, the last displacement repeated
    (Schoeller et al. 2020); `weighted`, the mean displacement with weights 0.5^age; `anchored`, the least-squares
    velocity carried on from the last position; `state`, the present velocity that the windows give (a tracker's).

    The mixture is one round Gaussian per step, as wide as the errors on the windows that `fitted` got.
    """

    def __init__(self, name: str, predicted_steps: int, dt_s: float, sigmas_m: Tensor | None = None):
        if name not in EXTRAPOLATIONS:
            raise ValueError(f"no extrapolation {name!r}; there are {EXTRAPOLATIONS}")
        self.name = name
        self.predicted_steps = predicted_steps
        self.dt_s = dt_s
        self.sigmas_m = torch.ones(predicted_steps) if sigmas_m is None else sigmas_m  # (P,)

    def fitted(self, windows: Windows) -> "Extrapolation":
        """Returns the same with sigmas that suit the windows: the root mean square error per axis at each step."""
        total, count = torch.zeros(self.predicted_steps), torch.zeros(self.predicted_steps)
        for batch in batches.batches(windows, 4096):
            square = (self.path(batch.observation) - batch.future).square().sum(dim=-1) / 2 * batch.known
            total += square.sum(dim=(0, 1))
            count += batch.known.sum(dim=(0, 1))
        sigmas = (total / count.clamp_min(1)).sqrt().clamp_min(MIN_SIGMA_M)
        return Extrapolation(self.name, self.predicted_steps, self.dt_s, sigmas)

    def path(self, observation: Observation) -> Tensor:
        """(..., A, P, 2) m."""
        observed, seen = observation.observed, observation.seen
        steps = torch.arange(1, self.predicted_steps + 1)[:, None] * self.dt_s  # (P, 1)
        start = observed[..., -1:, :]
        if self.name == "cvm":
            velocity = (observed[..., -1:, :] - observed[..., -2:-1, :]) / self.dt_s
        elif self.name == "weighted":
            velocity = batches.weighted_velocity(observed, seen, self.dt_s).unsqueeze(-2)
        elif self.name == "state":
            velocity = observation.velocity.unsqueeze(-2)
        else:
            level, velocity = _line(observed, seen, self.dt_s)
            start = level if self.name == "lin" else start
        return start + velocity * steps

    def forecast(self, observation: Observation, generator: torch.Generator) -> Forecast:  # noqa: ARG002
        """Predicts everybody observed; nothing is random."""
        path = self.path(observation)
        return certain_path(path, self.sigmas_m)


EXTRAPOLATIONS = ("lin", "cvm", "weighted", "anchored", "state")


def certain_path(path: Tensor, sigmas_m: Tensor) -> Forecast:
    """Returns a forecast of one path (..., A, P, 2), with a round Gaussian of sigmas (P,) around it."""
    one = path.new_zeros(*path.shape[:-1], 1)  # (..., P, 1)
    log_sigmas = sigmas_m.log()[:, None, None].expand(*path.shape[:-1], 1, 2)
    mixture = GaussianMixture(one, path.unsqueeze(-2), log_sigmas, one)
    return Forecast(mixture, ModalPaths(path.new_ones(*path.shape[:-2], 1), path.unsqueeze(-3)))


def mixture_of_samples(samples: Tensor, bandwidths_m: Tensor) -> GaussianMixture:
    """Returns sample paths (..., N, P, 2) as a mixture of N equal round Gaussians of sigmas (P,) at each step."""
    means = samples.transpose(-3, -2)  # (..., P, N, 2)
    N = means.shape[-2]
    log_weights = means.new_full(means.shape[:-1], -math.log(N))
    log_sigmas = bandwidths_m.log()[:, None, None].expand_as(means)
    return GaussianMixture(log_weights, means, log_sigmas, torch.zeros_like(log_weights))


def _line(observed: Tensor, seen: Tensor, dt_s: float) -> tuple[Tensor, Tensor]:
    """Returns the least-squares line's place at the last step and its velocity, (..., 1, 2) each, over seen steps."""
    weight = seen.to(observed.dtype).unsqueeze(-1)  # (..., T, 1)
    time = torch.arange(1 - observed.shape[-2], 1, dtype=observed.dtype)[:, None] * dt_s  # (T, 1), the last is 0
    total = weight.sum(dim=-2, keepdim=True)
    mean_time = (weight * time).sum(dim=-2, keepdim=True) / total
    mean = (weight * observed).sum(dim=-2, keepdim=True) / total
    spread = (weight * (time - mean_time).square()).sum(dim=-2, keepdim=True)
    velocity = (weight * (time - mean_time) * observed).sum(dim=-2, keepdim=True) / spread
    return mean - velocity * mean_time, velocity
