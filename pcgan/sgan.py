"""Social GAN (Gupta et al., CVPR 2018), variant SGAN-P: neighbours are pooled once, between encoder and decoder.

The equations are the paper's; sizes are those of the authors' training script, the bottleneck of 8 that of their models
with pooling. Two linear layers in a row are multiplied out where that saves work and changes nothing: the place of a
neighbour goes through `phi_r` and the first layer of the pooling's MLP, and the decoder's output through `phi_x` and
`phi_d` back into it. Displacements go in and come out as velocities, so that weights suit any `dt_s`.

Whoever was not seen at every observed step is absent: pooled by nobody, and its own paths mean nothing.

Letters as in `pcgan.model`, and N samples, Z numbers of noise, M units of the pooling's MLP.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pcgan.batches import Observation, batches
from pcgan.dataset import Windows
from pcgan.forecast import MIN_SIGMA_M, Forecast, mixture_of_samples
from pcgan.mixture_density import log_likelihood
from pcgan.modal_paths import ModalPaths
from pcgan.network_config import check_sizes, config_from_dict

SAMPLES = 20
BANDWIDTH_FACTORS = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.15)
CHUNK = 1 << 19  # numbers of the pooling's widest layer at a time: what a core's cache holds


@dataclass(frozen=True)
class SganConfig:
    """Sizes and times of a Social GAN; everything needed to build it again."""

    observed_steps: int = 8
    predicted_steps: int = 12
    dt_s: float = 0.4
    embedding: int = 16
    hidden: int = 32  # of the encoder
    decoder_hidden: int = 32
    noise_dim: int = 8
    pooling_hidden: int = 512
    bottleneck: int = 8
    mlp: int = 64
    discriminator_hidden: int = 64

    def __post_init__(self) -> None:
        check_sizes(self)
        if self.noise_dim >= self.decoder_hidden:
            raise ValueError(
                f"noise_dim must be below decoder_hidden, which it is part of, got {self.noise_dim} and "
                f"{self.decoder_hidden}"
            )

    @staticmethod
    def from_dict(values: dict[str, Any]) -> "SganConfig":
        """Builds a config from `asdict`'s result; raises ValueError naming unknown, missing or mistyped fields."""
        return config_from_dict(SganConfig, values, "Social GAN")


class PoolHidden(nn.Module):
    """The paper's pooling module: an MLP over every pedestrian's relative place and state, then the maximum.

    As in the authors' code a pedestrian pools itself, too. The MLP's first layer over [phi_r(x_j - x_i), h_j] is a term
    of j plus a term of i.
    """

    def __init__(self, config: SganConfig):
        super().__init__()
        self.phi_r = nn.Linear(2, config.embedding)
        self.mlp_r = nn.Linear(config.embedding, config.pooling_hidden)
        self.mlp_h = nn.Linear(config.hidden, config.pooling_hidden, bias=False)
        self.mlp_out = nn.Linear(config.pooling_hidden, config.bottleneck)

    def forward(self, hidden: Tensor, place: Tensor, neighbours: Tensor) -> Tensor:
        """(S, A, D), (S, A, 2) m, (S, A, A) bool -> (S, A, bottleneck); zeros for who has nobody to pool."""
        at = F.linear(place, self.mlp_r.weight @ self.phi_r.weight)  # (S, A, M)
        of_j = at + self.mlp_h(hidden)
        of_i = self.mlp_r(self.phi_r.bias) - at
        pooled: Tensor
        with torch.no_grad():
            pooled, winner = self._search(of_j, of_i, neighbours)
        if not torch.is_grad_enabled():
            return pooled
        # Only who attains a maximum has a part in its gradient: one of A for each of the few pooled features.
        S, A, M = of_j.shape
        index = (winner + A * torch.arange(S)[:, None, None]).flatten()
        first = of_j.flatten(0, 1).index_select(0, index).reshape(S, A, -1, M) + of_i.unsqueeze(2)
        out = (first.relu_() * self.mlp_out.weight).sum(dim=-1) + self.mlp_out.bias  # (S, A, bottleneck)
        pooled = out.relu() * neighbours.gather(-1, winner)  # where all are 0 the winner may be nobody
        return pooled

    def _search(self, of_j: Tensor, of_i: Tensor, neighbours: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the maxima (S, A, bottleneck) and whose they are, working on what fits a core's cache at a time."""
        S, A, M = of_j.shape
        scenes, rows = max(1, CHUNK // max(1, A * A * M)), max(1, min(A, CHUNK // max(1, A * M)))
        pooled = of_j.new_empty(S, A, self.mlp_out.out_features)
        winner = torch.empty(pooled.shape, dtype=torch.int64)
        for start in range(0, S, scenes):
            for row in range(0, A, rows):
                s, i = slice(start, start + scenes), slice(row, row + rows)
                first = (of_j[s].unsqueeze(1) + of_i[s, i].unsqueeze(2)).relu_()  # (s, i, A, M)
                out = self.mlp_out(first).relu_() * neighbours[s, i].unsqueeze(-1)  # nothing is below 0
                pooled[s, i], winner[s, i] = out.max(dim=2)
        return pooled, winner


class SganGenerator(nn.Module):
    """Observed positions of all pedestrians of a scene, and noise that they share -> one future path for each."""

    bandwidths_m: Tensor

    def __init__(self, config: SganConfig):
        super().__init__()
        self.config = config
        D, E = config.decoder_hidden, config.embedding
        self.phi_e = nn.Linear(2, E)
        self.encoder = nn.LSTM(E, config.hidden, batch_first=True)
        self.pool = PoolHidden(config)
        self.mlp_dec = nn.Sequential(
            nn.Linear(config.hidden + config.bottleneck, config.mlp), nn.ReLU(),
            nn.Linear(config.mlp, D - config.noise_dim), nn.ReLU(),
        )  # fmt: skip
        self.phi_d = nn.Linear(2, E)
        self.decoder = nn.LSTM(E, D, batch_first=True)
        self.phi_x = nn.Linear(D, 2)
        self.register_buffer("bandwidths_m", torch.ones(config.predicted_steps))  # (P,) see `fit_bandwidths`

    def forward(self, observation: Observation, noise: Tensor) -> Tensor:
        """Returns paths (..., A, P, 2) m in scene coordinates for noise (..., Z), the same for a whole scene."""
        ahead = self.decode(self.encode(observation), last_velocity(observation, self.config.dt_s), noise.unsqueeze(-2))
        return observation.observed[..., -1:, :] + ahead

    def encode(self, observation: Observation) -> Tensor:
        """Returns what each pedestrian knows of itself and of the others, (..., A, decoder_hidden - Z)."""
        observed = observation.observed
        lead = observed.shape[:-2]  # (..., A)
        steps = (observed[..., 1:, :] - observed[..., :-1, :]) / self.config.dt_s  # (..., A, T-1, 2) m/s
        _, (h, _) = self.encoder(self.phi_e(steps.flatten(0, -3)))
        hidden = h[0].reshape(*lead, self.config.hidden)  # (..., A, D)
        S, A = math.prod(lead[:-1]), lead[-1]
        near = together(observation).reshape(S, A, A)
        place = observed[..., -1, :].reshape(S, A, 2)
        pooled = self.pool(hidden.reshape(S, A, self.config.hidden), place, near)
        context: Tensor = self.mlp_dec(torch.cat([hidden, pooled.reshape(*lead, self.config.bottleneck)], dim=-1))
        return context

    def decode(self, context: Tensor, velocity: Tensor, noise: Tensor) -> Tensor:
        """Returns paths (..., P, 2) m relative to the last observed position.

        Args:
            context: (..., decoder_hidden - Z) from `encode`.
            velocity: (..., 2) m/s over the last observed displacement.
            noise: (..., Z); leading axes of the three broadcast.

        Each step's output x = phi_x(h) is the next one's input phi_d(x), both linear: so the recurrence is one of h
        alone, with weights U + W phi_d phi_x, and runs in one call. Only the first input is not the output before it.
        """
        lead = (context[..., 0] + noise[..., 0]).shape  # broadcast
        h0 = torch.cat([context.expand(*lead, -1), noise.expand(*lead, -1)], dim=-1).flatten(0, -2)  # (B, D)
        W, U, bias_in, bias_recurrent = self.decoder.all_weights[0]  # (4D, E), (4D, D), (4D,), (4D,)
        into = W @ self.phi_d.weight  # (4D, 2)
        recurrent = U + into @ self.phi_x.weight  # (4D, D)
        bias = bias_in + W @ self.phi_d.bias + into @ self.phi_x.bias
        inputs = h0.new_zeros(len(h0), self.config.predicted_steps, 2)
        inputs[:, 0] = velocity.expand(*lead, 2).reshape(-1, 2) - self.phi_x(h0)
        state = (h0.unsqueeze(0), torch.zeros_like(h0).unsqueeze(0))
        weights = (into, recurrent, bias, bias_recurrent)
        h, _, _ = torch.lstm(inputs, state, weights, True, 1, 0.0, False, False, True)  # (B, P, D)
        ahead: Tensor = self.phi_x(h).cumsum(dim=-2) * self.config.dt_s
        return ahead.reshape(*lead, self.config.predicted_steps, 2)

    def sample(
        self, observation: Observation, count: int, generator: torch.Generator, *, copies: bool = False
    ) -> Tensor:
        """Draws `count` futures of each scene: (..., A, N, P, 2) m in scene coordinates.

        With `copies` the scene goes through the whole network `count` times, in one batch: what the authors' generator
        does. Without, only the decoder runs that often; the samples are the same but for rounding.
        """
        observed = observation.observed
        noise = torch.randn(*observed.shape[:-3], count, self.config.noise_dim, generator=generator)  # (..., N, Z)
        if copies:
            return self.forward(copied(observation, count), noise).transpose(-4, -3)
        velocity = last_velocity(observation, self.config.dt_s)
        ahead = self.decode(self.encode(observation).unsqueeze(-2), velocity.unsqueeze(-2), noise.unsqueeze(-3))
        return observed[..., -1, None, None, :] + ahead


class SganDiscriminator(nn.Module):
    """Is this the path of a person, or a made-up one? Each path is judged on its own (the authors' type `local`)."""

    def __init__(self, config: SganConfig):
        super().__init__()
        self.dt_s = config.dt_s
        self.phi_e = nn.Linear(2, config.embedding)
        self.encoder = nn.LSTM(config.embedding, config.discriminator_hidden, batch_first=True)
        self.mlp = nn.Sequential(
            nn.Linear(config.discriminator_hidden, config.mlp), nn.ReLU(), nn.Linear(config.mlp, 1)
        )

    def forward(self, paths: Tensor) -> Tensor:
        """(B, T + P, 2) m, observed and future -> (B,) logits, above 0 for real."""
        steps = (paths[:, 1:] - paths[:, :-1]) / self.dt_s  # (B, T + P - 1, 2) m/s
        _, (h, _) = self.encoder(self.phi_e(steps))
        logits: Tensor = self.mlp(h[0]).squeeze(-1)
        return logits


def adversarial_loss(logits: Tensor, *, real: bool) -> Tensor:
    """Returns the mean binary cross-entropy, in nats, of logits (...) that ought to say real, or made up."""
    return F.binary_cross_entropy_with_logits(logits, torch.full_like(logits, float(real)))


def together(observation: Observation) -> Tensor:
    """(..., A, A) bool: who may pool whom; nobody pools padding or somebody not seen throughout."""
    return observation.neighbours & observation.seen.all(dim=-1).unsqueeze(-2)


def last_velocity(observation: Observation, dt_s: float) -> Tensor:
    """Returns the last observed displacement over the time it took, (..., A, 2) m/s."""
    return (observation.observed[..., -1, :] - observation.observed[..., -2, :]) / dt_s


def copied(observation: Observation, count: int) -> Observation:
    """Returns each scene `count` times, as views: (..., A, ...) -> (..., N, A, ...)."""

    def copy(tensor: Tensor, own: int) -> Tensor:
        lead = tensor.shape[: tensor.dim() - own]
        return tensor.unsqueeze(-own - 1).expand(*lead, count, *tensor.shape[tensor.dim() - own :])

    return replace(
        observation,
        observed=copy(observation.observed, 3),
        seen=copy(observation.seen, 2),
        velocity=copy(observation.velocity, 2),
        neighbours=copy(observation.neighbours, 2),
        vehicle=None,
    )


class Sgan:
    """Social GAN as a method of the tables: 20 samples, of which the mean error of the first 10 is reported.

    Its mixture is the samples', smoothed by `bandwidths_m`; its paths are the samples in the order they were drawn,
    none likelier than another.
    """

    def __init__(self, name: str, network: SganGenerator, *, copies: bool = False):
        self.name = name
        self.network = network
        self.copies = copies

    @torch.no_grad()
    def forecast(self, observation: Observation, generator: torch.Generator) -> Forecast:
        """Predicts everybody observed; those without a complete history get finite values that mean nothing."""
        samples = self.network.sample(observation, SAMPLES, generator, copies=self.copies)  # (..., A, N, P, 2)
        mixture = mixture_of_samples(samples, self.network.bandwidths_m)
        equal = samples.new_full(samples.shape[:-2], 1 / SAMPLES)
        return Forecast(mixture, ModalPaths(equal, samples), samples)


@torch.no_grad()
def fit_bandwidths(network: SganGenerator, windows: Windows, generator: torch.Generator) -> None:
    """Sets `bandwidths_m` to what makes the windows' futures likeliest at each step.

    Candidates are multiples of the root mean square error per axis of the samples' mean at that step.
    """
    paths, futures, known = [], [], []
    for batch in batches(windows, 1024):
        chosen = batch.observation.seen.all(dim=-1) & batch.known.any(dim=-1)  # (S, A)
        paths.append(network.sample(batch.observation, SAMPLES, generator)[chosen])
        futures.append(batch.future[chosen])
        known.append(batch.known[chosen])
    if not sum(map(len, paths)):
        raise ValueError("no window has a complete history and a known future to fit bandwidths to")
    samples, future, weight = torch.cat(paths), torch.cat(futures), torch.cat(known).to(torch.float32)
    total = weight.sum(dim=0).clamp_min(1)  # (P,)
    square = (samples.mean(dim=1) - future).square().sum(dim=-1) / 2  # (B, P)
    scale = ((square * weight).sum(dim=0) / total).sqrt()
    candidates = (torch.tensor(BANDWIDTH_FACTORS)[:, None] * scale).clamp_min(MIN_SIGMA_M)  # (factors, P)
    mean = [(log_likelihood(mixture_of_samples(samples, c), future) * weight).sum(dim=0) / total for c in candidates]
    best = torch.stack(mean).argmax(dim=0)  # (P,)
    network.bandwidths_m.copy_(candidates.gather(0, best[None])[0])
