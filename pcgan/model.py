"""The generator: LSTM encoder, graph vehicle-pedestrian attention, zero-feed LSTM decoder, mixture density head.

Two recipes of one network (`ModelConfig.recipe`). `paper` keeps the equations of Eiffert et al. (RA-L 2020), including
that its vehicle cannot matter: every term of its attention that does not depend on the neighbour j cancels in the
softmax. `best`, which ships, works in each pedestrian's own heading frame (turning the scene turns the answer), adds
its means to an extrapolation of the present velocity, lets the attention be non-linear, and puts neighbours' and the
vehicle's relative motion into what is pooled.

Letters: A pedestrians, T observed steps, P predicted steps, K components, D hidden, E embedding; `...` is either
nothing (one scene) or S scenes padded to A pedestrians each, which `neighbours` keeps apart.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pcgan import mixture_density
from pcgan.mixture_density import RAW_PER_COMPONENT, GaussianMixture, mixture_from_raw
from pcgan.modal_paths import cluster_eps_m

RECIPES = ("paper", "best")
FAR_M = 5.0  # relative positions d enter as d / (5 m + |d|): near ones in detail, far ones as a direction
SLOW_MPS = 1e-6


@dataclass(frozen=True)
class ModelConfig:
    """Sizes and times of a generator; everything needed to build it again."""

    recipe: str = "best"
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
        sizes = {name: value for name, value in asdict(self).items() if type(value) is int}
        if small := {name: value for name, value in sizes.items() if value < 1}:
            raise ValueError(f"sizes must be positive, got {small}")
        if self.observed_steps < 2:
            raise ValueError(f"observed_steps must be at least 2 for a displacement, got {self.observed_steps}")
        if self.components > 9:
            raise ValueError(f"components must be at most 9 (see modal_paths), got {self.components}")
        if not (math.isfinite(self.dt_s) and self.dt_s > 0):
            raise ValueError(f"dt_s must be positive, got {self.dt_s}")

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
        wanted = asdict(ModelConfig())
        if unknown := sorted(values.keys() ^ wanted.keys()):
            raise ValueError(f"model configuration differs in the fields {unknown}")
        for name, default in wanted.items():
            if type(values[name]) is not type(default):
                raise ValueError(f"model configuration {name} is {values[name]!r}, not a {type(default).__name__}")
        return ModelConfig(**values)


class GVAT(nn.Module):
    """Graph vehicle-pedestrian attention: what pedestrian i should know of its neighbours j and of the vehicle.

    Equations 7-11 of the paper. phi_u over a concatenation is three small projections, added: no (A, A, 2D) tensor.
    phi_gat has no bias, which a sum over neighbours would multiply by their number.
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.best = config.recipe == "best"
        pair_dim, vehicle_dim = (5, 6) if self.best else (2, 2)
        self.phi_r_pair = nn.Linear(pair_dim, config.embedding)
        self.phi_r_vehicle = nn.Linear(vehicle_dim, config.embedding, bias=False) if config.uses_vehicle else None
        self.phi_u_pair = nn.Linear(config.embedding, 1)
        self.phi_u_neighbour = nn.Linear(config.hidden, 1, bias=False)
        self.phi_u_self = nn.Linear(config.hidden, 1, bias=False)
        self.phi_gat = nn.Linear(config.hidden, config.hidden, bias=False)
        self.pooled_dim = config.hidden
        if self.best:
            self.phi_value = nn.Linear(config.embedding, config.embedding, bias=False)
            self.pooled_dim += config.embedding
        if self.best and config.uses_vehicle:
            self.phi_vehicle = nn.Linear(vehicle_dim, config.embedding)
            self.pooled_dim += config.embedding

    def forward(
        self, hidden: Tensor, pairs: Tensor, neighbours: Tensor, vehicle: Tensor | None, seen: Tensor | None
    ) -> Tensor:
        """Pools for every pedestrian; someone without neighbours and without a vehicle in sight gets zeros.

        Args:
            hidden: (..., A, D) the encoder's states.
            pairs: (..., A, A, 5 or 2) features of j relative to i, row i.
            neighbours: (..., A, A) bool, False on the diagonal.
            vehicle: (..., A, 6 or 2) features of the vehicle relative to i; None for networks without.
            seen: (..., A, 1) 1 where there is a vehicle, else 0.
        """
        r = self.phi_r_pair(pairs)  # (..., A, A, E)
        if self.phi_r_vehicle is not None and vehicle is not None:
            r = r + self.phi_r_vehicle(vehicle).unsqueeze(-2)  # the same for all j
        if self.best:
            r = r.relu()
        u = self.phi_u_pair(r).squeeze(-1)  # (..., A, A)
        u = u + self.phi_u_neighbour(hidden).transpose(-1, -2) + self.phi_u_self(hidden)  # + (1, A) + (A, 1)
        if self.best:
            u = F.leaky_relu(u, 0.2)
        attention = u.masked_fill(~neighbours, -1e9).softmax(dim=-1) * neighbours  # an empty row is all zeros
        pooled = [self.phi_gat(attention @ hidden)]  # (..., A, D): phi_gat is linear, so once after the sum
        if self.best:
            pooled.append(self.phi_value((attention.unsqueeze(-2) @ r).squeeze(-2)))  # (..., A, E)
        if self.best and vehicle is not None and seen is not None:
            pooled.append(self.phi_vehicle(vehicle).relu() * seen)  # (..., A, E)
        return torch.cat(pooled, dim=-1)  # (..., A, pooled_dim)


class Generator(nn.Module):
    """Observed positions of all pedestrians of a scene -> a Gaussian mixture per pedestrian and predicted step."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.best = config.recipe == "best"
        D, E = config.hidden, config.embedding
        self.phi_e = nn.Linear(3 if self.best else 2, E)
        self.phi_d = nn.Linear(3 if self.best else 2, E)
        self.encoder = nn.LSTM(E, D, batch_first=True)
        self.gvat = GVAT(config)
        self.mlp_dec = nn.Sequential(
            nn.Linear(D + self.gvat.pooled_dim, config.mlp), nn.ReLU(), nn.Linear(config.mlp, D), nn.ReLU()
        )
        self.decoder = nn.LSTM(E, D, batch_first=True)
        self.phi_mdn = nn.Linear(D, RAW_PER_COMPONENT * config.components)
        with torch.no_grad():  # start out as wide as people stray from their extrapolation, not 1 m
            self.phi_mdn.bias[3 * config.components : 5 * config.components].fill_(math.log(0.1 * config.horizon_s))

    def forward(
        self, observed: Tensor, velocity: Tensor, neighbours: Tensor, vehicle: Tensor | None
    ) -> GaussianMixture:
        """Returns the mixtures (..., A, P, K) in scene coordinates.

        Args:
            observed: (..., A, T, 2) positions in m, oldest first, any origin near the scene.
            velocity: (..., A, 2) present velocity in m/s.
            neighbours: (..., A, A) bool, who shares a scene with whom; the diagonal does not matter.
            vehicle: x, y, vx, vy over the observation as (..., A, T, 4), the vehicle each pedestrian sees, or
                (..., T, 4), one for the scene; NaN where there is none. None if there is none at all.
        """
        turn = self.scene_from_local(velocity)  # (..., A, 2, 2)
        local = self.local_mixture(observed, velocity, neighbours, vehicle, turn)
        turned = mixture_density.rotate(local, turn.unsqueeze(-3)) if self.best else local
        means = turned.means + observed[..., -1, None, None, :]
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

    def local_mixture(
        self,
        observed: Tensor,
        velocity: Tensor,
        neighbours: Tensor,
        vehicle: Tensor | None,
        turn: Tensor | None = None,
    ) -> GaussianMixture:
        """As `forward`, but each pedestrian's mixtures relative to its last position, in its own heading frame.

        `turn` is `scene_from_local(velocity)`, for callers that need it themselves.
        """
        config, lead = self.config, observed.shape[:-2]  # (..., A)
        turn = self.scene_from_local(velocity) if turn is None else turn  # (..., A, 2, 2); d @ turn is in that frame
        steps = (observed[..., 1:, :] - observed[..., :-1, :]) @ turn / config.dt_s  # (..., A, T-1, 2) m/s
        present = observed[..., -1, :]  # (..., A, 2)
        neighbours = neighbours & ~torch.eye(neighbours.shape[-1], dtype=torch.bool, device=neighbours.device)
        seen: Tensor | None = None
        features: Tensor | None = None
        if self.best:
            speed = velocity.norm(dim=-1)  # (..., A)
            steps = torch.cat([steps, speed[..., None, None].expand(*steps.shape[:-1], 1)], dim=-1)  # (..., T-1, 3)
            pairs = self._pair_features(present, velocity, turn)  # (..., A, A, 5)
        else:
            pairs = present.unsqueeze(-2) - present.unsqueeze(-3)  # (..., A, A, 2) x_i - x_j
        if config.uses_vehicle:
            features, seen = self._vehicle_features(present, velocity, turn, vehicle)

        flat = steps.reshape(-1, *steps.shape[-2:])  # (B, T-1, 2 or 3) with B = all pedestrians
        _, (h, _) = self.encoder(self.phi_e(flat))
        hidden = h[0].reshape(*lead, config.hidden)  # (..., A, D)
        g = self.gvat(hidden, pairs, neighbours, features, seen)  # (..., A, pooled)
        h0 = self.mlp_dec(torch.cat([hidden, g], dim=-1)).reshape(1, -1, config.hidden)  # (1, B, D)

        inputs = flat.new_zeros(flat.shape[0], config.predicted_steps, config.embedding)  # zero-feed, but for the first
        inputs[:, 0] = self.phi_d(flat[:, -1])
        decoded, _ = self.decoder(inputs, (h0, torch.zeros_like(h0)))  # (B, P, D)
        mixture = mixture_from_raw(self.phi_mdn(decoded).reshape(*lead, config.predicted_steps, -1))
        if not self.best:
            return mixture
        # Offsets are velocities (m/s) on top of the present one, summed up over the steps.
        means = mixture.means.cumsum(dim=-3) * config.dt_s  # (..., A, P, K, 2)
        times_s = torch.arange(1, config.predicted_steps + 1, dtype=speed.dtype, device=speed.device) * config.dt_s
        ahead = speed[..., None] * times_s  # (..., A, P)
        means = means + torch.stack([ahead, torch.zeros_like(ahead)], dim=-1).unsqueeze(-2)
        return GaussianMixture(mixture.log_weights, means, mixture.log_sigmas, mixture.rhos)

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
