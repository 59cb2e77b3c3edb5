"""The generator: LSTM encoder, pooling over neighbours, zero-feed LSTM decoder, mixture density head.

Pooling is GVAT, the paper's graph vehicle-pedestrian attention (PCGAN), or Social GAN's (PSGAN), or none. And there are
two recipes of one network (`ModelConfig.recipe`). `paper` keeps the equations of Eiffert et al. (RA-L 2020), including
that its vehicle cannot matter: every term of its attention that does not depend on the neighbour j cancels in the
softmax. `best`, which ships,

- works in each pedestrian's own heading frame, so turning the scene turns the answer;
- adds its means to an extrapolation, of a velocity that it weighs together from the observed displacements: how much to
  smooth, it learns to tell from how jittery the observed tracks are (`wiggle`);
- takes histories of any length, with gaps;
- lets the attention be non-linear, and puts neighbours' and the vehicle's relative motion into what is pooled.

Letters: A pedestrians, T observed steps, P predicted steps, K components, D hidden, E embedding; `...` is either
nothing (one scene) or S scenes padded to A pedestrians each, which `neighbours` keeps apart.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pcgan import mixture_density
from pcgan.batches import Observation, begun
from pcgan.mixture_density import RAW_PER_COMPONENT, GaussianMixture, mixture_from_raw
from pcgan.modal_paths import cluster_eps_m
from pcgan.network_config import check_sizes, config_from_dict

RECIPES = ("paper", "best")
POOLINGS = ("gvat", "social", "none")
WIGGLE_FEATURES, PAIR_FEATURES, VEHICLE_FEATURES = 5, 5, 6
MIN_WIGGLE_M = 1e-3
FAR_M = 5.0  # relative positions d enter as d / (5 m + |d|): near ones in detail, far ones as a direction
SLOW_MPS = 1e-6


@dataclass(frozen=True)
class ModelConfig:
    """Sizes and times of a generator; everything needed to build it again."""

    recipe: str = "best"
    pooling: str = "gvat"
    observed_steps: int = 8
    predicted_steps: int = 12
    dt_s: float = 0.1
    uses_vehicle: bool = True
    components: int = 6
    hidden: int = 32
    embedding: int = 16
    mlp: int = 64

    def __post_init__(self) -> None:
        if self.recipe not in RECIPES:
            raise ValueError(f"recipe must be one of {RECIPES}, got {self.recipe!r}")
        if self.pooling not in POOLINGS:
            raise ValueError(f"pooling must be one of {POOLINGS}, got {self.pooling!r}")
        check_sizes(self)
        if self.hidden % GVAT.HEADS:
            raise ValueError(f"hidden must be a multiple of {GVAT.HEADS}, got {self.hidden}")
        if self.components > 9:
            raise ValueError(f"components must be at most 9 (see modal_paths), got {self.components}")

    @property
    def horizon_s(self) -> float:
        """How far ahead the last predicted step is."""
        return self.predicted_steps * self.dt_s

    @property
    def eps_m(self) -> float:
        """MultiPAC's clustering distance for this horizon."""
        return cluster_eps_m(self.horizon_s)

    @staticmethod
    def from_dict(values: dict[str, Any]) -> "ModelConfig":
        """Builds a config from `asdict`'s result; raises ValueError naming unknown, missing or mistyped fields."""
        return config_from_dict(ModelConfig, values, "model")


class PaperGVAT(nn.Module):
    """Graph vehicle-pedestrian attention as published, equations 7-11.

    phi_u over a concatenation is three small projections, added: no (A, A, 2D) tensor. phi_gat has no bias, which a sum
    over neighbours would multiply by their number.
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.phi_r_pair = nn.Linear(2, config.embedding)
        self.phi_r_vehicle = nn.Linear(2, config.embedding, bias=False) if config.uses_vehicle else None
        self.phi_u_pair = nn.Linear(config.embedding, 1)
        self.phi_u_neighbour = nn.Linear(config.hidden, 1, bias=False)
        self.phi_u_self = nn.Linear(config.hidden, 1, bias=False)
        self.phi_gat = nn.Linear(config.hidden, config.hidden, bias=False)
        self.pooled_dim = config.hidden

    def forward(self, hidden: Tensor, pairs: Tensor, others: Tensor, vehicle: Tensor | None) -> Tensor:
        """Pools for every pedestrian; someone without neighbours gets zeros.

        Args:
            hidden: (..., A, D) the encoder's states.
            pairs: (..., A, A, 2) x_i - x_j, row i.
            others: (..., A, A) bool, False on the diagonal.
            vehicle: (..., A, 2) x_i - x_v, zeros where there is none; None for networks without.
        """
        r = self.phi_r_pair(pairs)  # (..., A, A, E)
        if self.phi_r_vehicle is not None and vehicle is not None:
            r = r + self.phi_r_vehicle(vehicle).unsqueeze(-2)  # the same for all j, so the softmax cancels it
        u = self.phi_u_pair(r).squeeze(-1)  # (..., A, A)
        u = u + self.phi_u_neighbour(hidden).transpose(-1, -2) + self.phi_u_self(hidden)  # + (1, A) + (A, 1)
        attention = u.masked_fill(~others, -1e9).softmax(dim=-1) * others  # an empty row is all zeros
        pooled: Tensor = self.phi_gat(attention @ hidden)  # (..., A, D): phi_gat is linear, so once after the sum
        return pooled


class GVAT(nn.Module):
    """Graph vehicle-pedestrian attention of `best`: what pedestrian i should know of its neighbours j.

    Every pair sends a message, by two layers from both encoder states, the pair's relative motion, and the vehicle as i
    sees it; as these layers are not linear, the vehicle does change who is heeded. The messages are pooled twice: by
    attention over the neighbours, a head per share of the message, and by the maximum, which says that somebody is
    there however many others are.
    """

    HEADS = 4

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.phi_pair = nn.Linear(PAIR_FEATURES, config.mlp)
        self.phi_neighbour = nn.Linear(config.hidden, config.mlp, bias=False)
        self.phi_self = nn.Linear(config.hidden, config.mlp, bias=False)
        self.phi_vehicle = nn.Linear(VEHICLE_FEATURES, config.mlp, bias=False) if config.uses_vehicle else None
        self.phi_message = nn.Linear(config.mlp, config.hidden)
        self.phi_u = nn.Linear(config.hidden, self.HEADS)
        self.pooled_dim = 2 * config.hidden

    def forward(self, hidden: Tensor, pairs: Tensor, others: Tensor, vehicle: Tensor | None) -> Tensor:
        """Pools for every pedestrian, (..., A, 2 D); someone without neighbours gets zeros.

        Args:
            hidden: (..., A, D) the encoder's states.
            pairs: (..., A, A, 5) features of j relative to i, row i.
            others: (..., A, A) bool, False on the diagonal.
            vehicle: (..., A, 6) the vehicle relative to i, zeros where there is none; None for networks without.
        """
        own = self.phi_self(hidden)  # (..., A, M)
        if self.phi_vehicle is not None and vehicle is not None:
            own = own + self.phi_vehicle(vehicle)
        message = (self.phi_pair(pairs) + self.phi_neighbour(hidden).unsqueeze(-3) + own.unsqueeze(-2)).relu()
        message = self.phi_message(message).relu()  # (..., A, A, D)
        u = F.leaky_relu(self.phi_u(message), 0.2).masked_fill(~others.unsqueeze(-1), -1e9)  # (..., A, A, heads)
        attention = u.softmax(dim=-2) * others.unsqueeze(-1)  # an empty row is all zeros
        shares = message.unflatten(-1, (self.HEADS, -1))  # (..., A, A, heads, D / heads)
        attended = (attention.unsqueeze(-1) * shares).sum(dim=-3).flatten(-2)  # (..., A, D)
        return torch.cat([attended, (message * others.unsqueeze(-1)).amax(dim=-2)], dim=-1)


class SocialPooling(nn.Module):
    """Social GAN's pooling (Gupta et al. 2018): an MLP over every neighbour's state and place, then the maximum.

    The MLP's first layer over a concatenation is two small projections, added. `best` puts its own pair features, which
    hold relative velocities, in place of the relative positions.
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        pair_dim = PAIR_FEATURES if config.recipe == "best" else 2
        self.phi_pair = nn.Linear(pair_dim, config.mlp)
        self.phi_neighbour = nn.Linear(config.hidden, config.mlp, bias=False)
        self.phi_out = nn.Linear(config.mlp, config.hidden)
        self.pooled_dim = config.hidden

    def forward(self, hidden: Tensor, pairs: Tensor, neighbours: Tensor) -> Tensor:
        """(..., A, D), (..., A, A, 5 or 2), (..., A, A) bool -> (..., A, D); zeros without neighbours."""
        r = (self.phi_pair(pairs) + self.phi_neighbour(hidden).unsqueeze(-3)).relu()  # (..., A, A, mlp)
        message: Tensor = self.phi_out(r).relu() * neighbours.unsqueeze(-1)  # (..., A, A, D), nothing below 0
        return message.amax(dim=-2)


class Generator(nn.Module):
    """Observed positions of all pedestrians of a scene -> a Gaussian mixture per pedestrian and predicted step."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.best = config.recipe == "best"
        D, E = config.hidden, config.embedding
        features, wiggle = (5, WIGGLE_FEATURES) if self.best else (2, 0)
        self.phi_e = nn.Linear(features, E)
        self.phi_d = nn.Linear(features, E)
        self.encoder = nn.LSTM(E, D, batch_first=True)
        attention = GVAT if self.best else PaperGVAT
        self.gvat = attention(config) if config.pooling == "gvat" else None
        self.social = SocialPooling(config) if config.pooling == "social" else None
        pooled = self.gvat.pooled_dim if self.gvat else self.social.pooled_dim if self.social else 0
        self.vehicle_layers: nn.Sequential | None = None
        if self.best and config.uses_vehicle:
            self.vehicle_layers = nn.Sequential(
                nn.Linear(D + VEHICLE_FEATURES, config.mlp // 2), nn.ReLU(), nn.Linear(config.mlp // 2, E), nn.ReLU()
            )
            pooled += E
        if self.best:
            weights = 2 * (config.observed_steps - 1)
            self.velocity_weights = nn.Sequential(
                nn.Linear(D + wiggle, config.mlp // 2), nn.ReLU(), nn.Linear(config.mlp // 2, weights)
            )
        self.mlp_dec = nn.Sequential(
            nn.Linear(D + wiggle + pooled, config.mlp), nn.ReLU(), nn.Linear(config.mlp, D), nn.ReLU()
        )
        self.decoder = nn.LSTM(E, D, batch_first=True)
        self.phi_mdn = nn.Linear(D, RAW_PER_COMPONENT * config.components)
        self.log_sigma_shift: Tensor  # widens all components of a step, fitted after training (calibration.py)
        self.register_buffer("log_sigma_shift", torch.zeros(config.predicted_steps))
        with torch.no_grad():  # start out as wide as people stray from their extrapolation, not 1 m
            self.phi_mdn.bias[3 * config.components : 5 * config.components].fill_(math.log(0.1 * config.horizon_s))
            if self.best:  # and with the present velocity as it is
                last = self.velocity_weights[-1]
                assert isinstance(last, nn.Linear)
                last.weight.mul_(0.1)
                last.bias.zero_()

    def forward(self, observation: Observation) -> GaussianMixture:
        """Returns the mixtures (..., A, P, K) in scene coordinates."""
        turn = self.scene_from_local(observation.velocity)  # (..., A, 2, 2)
        local = self.local_mixture(observation, turn)
        turned = mixture_density.rotate(local, turn.unsqueeze(-3)) if self.best else local
        means = turned.means + observation.observed[..., -1, None, None, :]
        return GaussianMixture(turned.log_weights, means, turned.log_sigmas, turned.rhos)

    def scene_from_local(self, velocity: Tensor) -> Tensor:
        """(..., 2) -> (..., 2, 2): rotation from a pedestrian's heading frame; the identity for `paper` and at rest."""
        speed = velocity.norm(dim=-1, keepdim=True)
        ahead = torch.tensor([1.0, 0.0], dtype=velocity.dtype, device=velocity.device)
        heading = torch.where(speed > SLOW_MPS, velocity / speed.clamp_min(SLOW_MPS), ahead) if self.best else (
            ahead.expand_as(velocity)
        )  # fmt: skip
        c, s = heading.unbind(-1)
        return torch.stack([c, -s, s, c], dim=-1).reshape(*velocity.shape[:-1], 2, 2)

    def local_mixture(self, observation: Observation, turn: Tensor | None = None) -> GaussianMixture:
        """As `forward`, but each pedestrian's mixtures relative to its last position, in its own heading frame.

        `turn` is `scene_from_local(velocity)`, for callers that need it themselves.
        """
        config = self.config
        observed, velocity = observation.observed, observation.velocity
        lead = observed.shape[:-2]  # (..., A)
        turn = self.scene_from_local(velocity) if turn is None else turn  # (..., A, 2, 2); d @ turn is in that frame
        steps = (observed[..., 1:, :] - observed[..., :-1, :]) @ turn / config.dt_s  # (..., A, T-1, 2) m/s
        present = observed[..., -1, :]  # (..., A, 2)
        neighbours = observation.neighbours
        others = neighbours & ~torch.eye(neighbours.shape[-1], dtype=torch.bool, device=neighbours.device)
        inputs = steps
        if self.best:
            valid = begun(observation.seen)  # (..., A, T-1)
            speed = velocity.norm(dim=-1)  # (..., A)
            flags = [speed.unsqueeze(-1).expand_as(valid), valid, observation.seen[..., 1:].to(valid.dtype)]
            inputs = torch.cat([steps, torch.stack(flags, dim=-1)], dim=-1)  # (..., T-1, 5)

        flat = inputs.reshape(-1, *inputs.shape[-2:])  # (B, T-1, 2 or 5) with B = all pedestrians
        _, (h, _) = self.encoder(self.phi_e(flat))
        hidden = h[0].reshape(*lead, config.hidden)  # (..., A, D)
        state = torch.cat([hidden, self.wiggle(observation)], dim=-1) if self.best else hidden
        pooled = self._pooled(hidden, present, velocity, turn, others, observation.vehicle)
        h0 = self.mlp_dec(torch.cat([state, *pooled], dim=-1)).reshape(1, -1, config.hidden)  # (1, B, D)

        zero_feed = flat.new_zeros(flat.shape[0], config.predicted_steps, config.embedding)
        zero_feed[:, 0] = self.phi_d(flat[:, -1])  # zero-feed, but for the first
        decoded, _ = self.decoder(zero_feed, (h0, torch.zeros_like(h0)))  # (B, P, D)
        mixture = mixture_from_raw(self.phi_mdn(decoded).reshape(*lead, config.predicted_steps, -1))
        mixture = replace(mixture, log_sigmas=mixture.log_sigmas + self.log_sigma_shift[:, None, None])
        if not self.best:
            return mixture
        # Offsets are velocities (m/s) on top of the base's, summed up over the steps.
        weights = self.velocity_weights(state).unflatten(-1, (-1, 2)) * valid.unsqueeze(-1)  # (..., A, T-1, 2)
        base = (weights * steps).sum(dim=-2)  # (..., A, 2)
        base = base + torch.stack([speed, torch.zeros_like(speed)], dim=-1)
        means = (mixture.means + base[..., None, None, :]).cumsum(dim=-3) * config.dt_s  # (..., A, P, K, 2)
        return replace(mixture, means=means)

    def wiggle(self, observation: Observation) -> Tensor:
        """Returns how jittery each pedestrian's observed track is, and the scene's altogether: (..., A, 5).

        Log of the size in m and the lag-1 autocorrelation of the second differences of the positions, own and pooled
        over the scene; and the share of observed steps there were. White noise gives -2/3, a smooth curve near 1.
        """
        positions, valid = observation.observed, begun(observation.seen)  # (..., A, T-1)
        steps = positions[..., 1:, :] - positions[..., :-1, :]
        bends = (steps[..., 1:, :] - steps[..., :-1, :]) * valid[..., :-1, None]  # (..., A, T-2, 2)
        square = bends.square().sum(dim=(-1, -2))  # (..., A)
        lagged = (bends[..., 1:, :] * bends[..., :-1, :]).sum(dim=(-1, -2))
        sums = torch.stack([square, lagged, 2 * valid[..., :-1].sum(dim=-1)], dim=-1)  # (..., A, 3)
        pooled = observation.neighbours.to(sums.dtype) @ sums  # (..., A, 3)
        features = []
        for square, lagged, count in (sums.unbind(-1), pooled.unbind(-1)):
            variance = square / count.clamp_min(1) + MIN_WIGGLE_M**2
            features += [0.5 * variance.log() + 3, lagged / (square + MIN_WIGGLE_M**2)]  # + 3: around 0 at 5 cm
        return torch.stack([*features, valid.mean(dim=-1)], dim=-1)

    def _pooled(
        self, hidden: Tensor, present: Tensor, velocity: Tensor, turn: Tensor, others: Tensor, vehicle: Tensor | None
    ) -> list[Tensor]:
        """What a pedestrian should know of the others, and of the vehicle: (..., A, some) each."""
        if self.best:
            pairs = self._pair_features(present, velocity, turn)  # (..., A, A, 5)
        else:
            pairs = present.unsqueeze(-2) - present.unsqueeze(-3)  # (..., A, A, 2) x_i - x_j
        found = seen = None
        if self.config.uses_vehicle:
            found, seen = self._vehicle_features(present, velocity, turn, vehicle)
        pooled = []
        if self.gvat is not None:
            pooled.append(self.gvat(hidden, pairs, others, found))
        if self.social is not None:
            pooled.append(self.social(hidden, pairs, others))
        if self.vehicle_layers is not None and found is not None and seen is not None:
            pooled.append(self.vehicle_layers(torch.cat([hidden, found], dim=-1)) * seen)
        return pooled

    def _pair_features(self, present: Tensor, velocity: Tensor, turn: Tensor) -> Tensor:
        """(..., A, 2), (..., A, 2), (..., A, 2, 2) -> (..., A, A, 5): j's relative position, velocity and nearness."""
        A = present.shape[-2]
        offset = present.unsqueeze(-3) - present.unsqueeze(-2)  # (..., A, A, 2) x_j - x_i
        motion = velocity.unsqueeze(-3) - velocity.unsqueeze(-2)
        distance = offset.norm(dim=-1, keepdim=True)  # (..., A, A, 1)
        turned = torch.cat([offset / (FAR_M + distance), motion], dim=-2) @ turn  # (..., A, 2A, 2)
        return torch.cat([turned[..., :A, :], turned[..., A:, :], 1 / (1 + distance)], dim=-1)

    def _vehicle_features(
        self, present: Tensor, velocity: Tensor, turn: Tensor, vehicle: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Returns the vehicle as each pedestrian sees it, (..., A, 6) or for `paper` (..., A, 2), and seen (..., A, 1).

        `best`: relative position and velocity, change of velocity over the observation, all in the heading frame.
        Zeros where there is no vehicle.
        """
        if vehicle is None:
            features = present.new_zeros(*present.shape[:-1], 6 if self.best else 2)
            return features, present.new_zeros(*present.shape[:-1], 1)
        found = vehicle.isfinite().flatten(-2).all(dim=-1, keepdim=True)  # (..., A or none, 1)
        first = torch.where(found, vehicle[..., 0, :], 0)  # (..., A or none, 4)
        last = torch.where(found, vehicle[..., -1, :], 0)
        if vehicle.dim() == present.dim():  # one for the scene: the same for all A
            found, first, last = found.unsqueeze(-2), first.unsqueeze(-2), last.unsqueeze(-2)
        seen = found.to(present.dtype)
        offset = last[..., :2] - present  # (..., A, 2)
        if not self.best:
            return -offset * seen, seen
        motion = last[..., 2:] - velocity
        change = (last[..., 2:] - first[..., 2:]).expand_as(motion)
        nearness = 1 / (FAR_M + offset.norm(dim=-1, keepdim=True))
        features = (torch.stack([offset * nearness, motion * 0.2, change], dim=-2) @ turn).flatten(-2)  # (..., A, 6)
        return features * seen, seen
