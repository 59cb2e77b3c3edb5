"""SR-LSTM (Zhang et al., CVPR 2019): an LSTM whose states are refined at every step by messages from neighbours.

After each step of the LSTM every pedestrian's cell state gets a message, `refinements` times over:

    r_ij = relu(W_r (x_j - x_i))                                   relative place
    g_ij = sigmoid(W_g [r_ij, h_i, h_j] + b_g)                     motion gate: which of j's features matter to i
    a_ij = softmax_j(w_a [r_ij, h_i, h_j])                         pedestrian-wise attention over the neighbours
    c_i <- c_i + W_mp sum_j a_ij (g_ij * h_j)
    h_i <- o_i * tanh(c_i)

A neighbour is anybody else within 10 m at that step. The attention's score is linear, so its term of h_i is the same
for all j and cancels in the softmax: it is left out. Displacements go in and come out as velocities.

Whoever was not seen at every observed step is absent: nobody's neighbour and without neighbours; its path means
nothing.

Letters as in `pcgan.model`.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pcgan.batches import Observation, batches
from pcgan.dataset import Windows
from pcgan.forecast import MIN_SIGMA_M, Forecast, certain_path
from pcgan.network_config import check_sizes, config_from_dict

NO_NEIGHBOUR = -1e9


@dataclass(frozen=True)
class SrLstmConfig:
    """Sizes and times of an SR-LSTM; everything needed to build it again. The sizes are the authors'."""

    observed_steps: int = 8
    predicted_steps: int = 12
    dt_s: float = 0.4
    embedding: int = 32  # of displacements, and of relative places
    hidden: int = 64
    refinements: int = 2
    neighbourhood_m: float = 10.0

    def __post_init__(self) -> None:
        check_sizes(self)
        if not (math.isfinite(self.neighbourhood_m) and self.neighbourhood_m > 0):
            raise ValueError(f"neighbourhood_m must be positive, got {self.neighbourhood_m}")

    @staticmethod
    def from_dict(values: dict[str, Any]) -> "SrLstmConfig":
        """Builds a config from `asdict`'s result; raises ValueError naming unknown, missing or mistyped fields."""
        return config_from_dict(SrLstmConfig, values, "SR-LSTM")


class StatesRefinement(nn.Module):
    """The paper's states-refinement module, equations at the top of this file."""

    def __init__(self, config: SrLstmConfig):
        super().__init__()
        D, E = config.hidden, config.embedding
        self.refinements = config.refinements
        self.phi_r = nn.Linear(2, E)
        self.gate_r = nn.Linear(E, D)
        self.score_r = nn.Linear(E, 1, bias=False)
        self.phi_h = nn.Linear(D, 2 * D + 1, bias=False)  # the gate's terms of h_i and h_j, and the score's of h_j
        self.phi_mp = nn.Linear(D, D, bias=False)
        nn.init.orthogonal_(self.phi_mp.weight, gain=0.01)  # starts out as nearly a plain LSTM, as the authors' does

    def forward(self, hidden: Tensor, cell: Tensor, out: Tensor, place: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
        """Returns refined hidden and cell states, (S, A, D) each; who has no neighbours keeps its own.

        Args:
            hidden: (S, A, D) h of the LSTM's step.
            cell: (S, A, D) c.
            out: (S, A, D) the output gate o.
            place: (S, A, 2) m.
            near: (S, A, A) bool, row i: the neighbours of i.
        """
        D = hidden.shape[-1]
        at = F.linear(place, self.phi_r.weight)  # (S, A, E): the layer is linear, so of each place, not of each pair
        r = ((at + self.phi_r.bias).unsqueeze(-3) - at.unsqueeze(-2)).relu_()  # (S, A, A, E)
        gate_r, score_r = self.gate_r(r), self.score_r(r).squeeze(-1)  # the same for all refinements
        far = ~near
        for _ in range(self.refinements):
            gate_i, gate_j, score_j = self.phi_h(hidden).split_with_sizes([D, D, 1], dim=-1)
            score = score_r + score_j.transpose(-1, -2)  # (S, A, A)
            attention = score.masked_fill(far, NO_NEIGHBOUR).softmax(dim=-1) * near  # an empty row is all zeros
            gate = (gate_r + gate_i.unsqueeze(-2)).add_(gate_j.unsqueeze(-3)).sigmoid_()  # (S, A, A, D)
            message = attention.unsqueeze(-2) @ (gate * hidden.unsqueeze(-3))  # (S, A, 1, D)
            cell = cell + self.phi_mp(message.squeeze(-2))
            hidden = out * cell.tanh()
        return hidden, cell


class SrLstm(nn.Module):
    """Observed positions of all pedestrians of a scene -> one future path for each."""

    sigmas_m: Tensor

    def __init__(self, config: SrLstmConfig):
        super().__init__()
        self.config = config
        self.phi_e = nn.Linear(2, config.embedding)
        self.cell = nn.LSTMCell(config.embedding, config.hidden)
        self.refine = StatesRefinement(config)
        self.phi_x = nn.Linear(config.hidden, 2)
        self.register_buffer("sigmas_m", torch.ones(config.predicted_steps))  # (P,) see `fit_sigmas`

    def forward(self, observation: Observation) -> Tensor:
        """Returns paths (..., A, P, 2) m in scene coordinates."""
        config, observed = self.config, observation.observed
        S, (A, T) = math.prod(observed.shape[:-3]), observed.shape[-3:-1]
        here = observed.reshape(S, A, T, 2)  # one scene is a batch of one
        present = observation.seen.reshape(S, A, T).all(dim=-1)  # (S, A)
        others = observation.neighbours.reshape(S, A, A) & present.unsqueeze(-1) & present.unsqueeze(-2)
        others = others & ~torch.eye(A, dtype=torch.bool, device=observed.device)

        velocity = (here[..., 1:, :] - here[..., :-1, :]) / config.dt_s  # (S, A, T-1, 2) m/s
        given = self._inputs(velocity)  # (S, A, T-1, 4D)
        hidden = cell = here.new_zeros(*present.shape, config.hidden)
        for step in range(1, T):
            place = here[..., step, :]
            hidden, cell = self._step(given[..., step - 1, :], hidden, cell, place, others)
        place = here[..., -1, :]
        path = []
        for step in range(config.predicted_steps):
            ahead = self.phi_x(hidden)  # (S, A, 2) m/s
            place = place + ahead * config.dt_s
            path.append(place)
            if step + 1 < config.predicted_steps:
                hidden, cell = self._step(self._inputs(ahead), hidden, cell, place, others)
        return torch.stack(path, dim=-2).reshape(*observed.shape[:-2], config.predicted_steps, 2)

    def _inputs(self, velocity: Tensor) -> Tensor:
        """(..., 2) m/s -> (..., 4D): what a displacement adds to the LSTM's gates."""
        return F.linear(self.phi_e(velocity).relu(), self.cell.weight_ih, self.cell.bias_ih)

    def _step(
        self, inputs: Tensor, hidden: Tensor, cell: Tensor, place: Tensor, others: Tensor
    ) -> tuple[Tensor, Tensor]:
        """One step of the LSTM and the refinement of its states: h and c, (S, A, D) each."""
        gates = inputs + F.linear(hidden, self.cell.weight_hh, self.cell.bias_hh)  # (S, A, 4D)
        into, keep, new, out = gates.chunk(4, dim=-1)
        out = out.sigmoid()
        cell = keep.sigmoid() * cell + into.sigmoid() * new.tanh()
        hidden = out * cell.tanh()
        apart = place.unsqueeze(-2) - place.unsqueeze(-3)  # (S, A, A, 2)
        near = others & (apart.detach().square().sum(dim=-1) < self.config.neighbourhood_m**2)
        refined: tuple[Tensor, Tensor] = self.refine(hidden, cell, out, place, near)
        return refined


class SrLstmMethod:
    """SR-LSTM as a method of the tables: one path, with a round Gaussian of `sigmas_m` around it."""

    def __init__(self, name: str, network: SrLstm):
        self.name = name
        self.network = network

    @torch.no_grad()
    def forecast(self, observation: Observation, generator: torch.Generator) -> Forecast:  # noqa: ARG002
        """Predicts everybody observed; those without a complete history get finite values that mean nothing."""
        return certain_path(self.network(observation), self.network.sigmas_m)


@torch.no_grad()
def fit_sigmas(network: SrLstm, windows: Windows) -> None:
    """Sets `sigmas_m` to the root mean square error per axis at each step, over the windows' known futures."""
    total, count = torch.zeros_like(network.sigmas_m), torch.zeros_like(network.sigmas_m)
    for batch in batches(windows, 1024):
        weight = batch.known & batch.observation.seen.all(dim=-1, keepdim=True)  # (S, A, P)
        square = (network(batch.observation) - batch.future).square().sum(dim=-1) / 2 * weight
        total += square.sum(dim=(0, 1))
        count += weight.sum(dim=(0, 1))
    if not count.any():
        raise ValueError("no window has a complete history and a known future to fit sigmas to")
    network.sigmas_m.copy_((total / count.clamp_min(1)).sqrt().clamp_min(MIN_SIGMA_M))
