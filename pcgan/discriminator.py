"""The discriminator: is this the path of a person, or one that the generator made up?"""

import torch
from torch import Tensor, nn

from pcgan.modal_paths import ModalPaths


class Discriminator(nn.Module):
    """LSTM over the displacements of a whole path, observed and future, then an MLP to one logit.

    Sizes of the paper: embedding 16, hidden 64, MLP 64. The logit is linear; the losses below take it as it is.
    """

    def __init__(self, dt_s: float, embedding: int = 16, hidden: int = 64, mlp: int = 64):
        super().__init__()
        self.dt_s = dt_s
        self.phi = nn.Linear(2, embedding)
        self.encoder = nn.LSTM(embedding, hidden, batch_first=True)
        self.mlp = nn.Sequential(nn.Linear(hidden, mlp), nn.ReLU(), nn.Linear(mlp, 1))

    def forward(self, observed: Tensor, future: Tensor, owner: Tensor) -> Tensor:
        """Judges R paths of B pedestrians.

        Args:
            observed: (B, T, 2) m, relative to the last observed position.
            future: (R, P, 2) m, likewise.
            owner: (R,) whose path it is, 0..B-1.

        Returns (R,) logits. The observed part is read once for all paths of a pedestrian.
        """
        past = observed[:, 1:] - observed[:, :-1]  # (B, T-1, 2)
        _, (h, c) = self.encoder(self.phi(past / self.dt_s))
        steps = torch.diff(future, dim=-2, prepend=torch.zeros_like(future[:, :1])) / self.dt_s  # (R, P, 2)
        _, (last, _) = self.encoder(self.phi(steps), (h[:, owner], c[:, owner]))
        logits: Tensor = self.mlp(last[0]).squeeze(-1)
        return logits


def discriminator_loss(real: Tensor, fake: Tensor, weights: Tensor, *, as_paper: bool = False) -> Tensor:
    """Returns what the discriminator minimises: how badly it tells (B,) real from (R,) fake logits, per pedestrian.

    Fakes count by the probabilities (R,) of their paths: - log D(real) - sum w log(1 - D(fake)). The paper puts w
    inside, log(1 - w D), which mutes unlikely paths; `as_paper` does so.
    """
    if as_paper:
        against = -torch.log1p(-weights * fake.sigmoid() * (1 - 1e-6))
    else:
        against = weights * nn.functional.softplus(fake)
    return nn.functional.softplus(-real).mean() + against.sum() / len(real)


def generator_loss(fake: Tensor, weights: Tensor, pedestrians: int, *, as_paper: bool = False) -> Tensor:
    """Returns what the generator minimises over (R,) logits of its paths: - sum w log D, or the paper's log(1 - w D).

    Per pedestrian. Both the paths and their probabilities `weights` carry gradients, through MultiPAC.
    """
    if as_paper:
        return torch.log1p(-weights * fake.sigmoid() * (1 - 1e-6)).sum() / pedestrians
    return (weights * nn.functional.softplus(-fake)).sum() / pedestrians


def listed(paths: ModalPaths) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the modal paths there are of (B, L): points (R, P, 2), probabilities (R,), whose they are (R,)."""
    owner, slot = (paths.probabilities > 0).nonzero(as_tuple=True)
    return paths.points[owner, slot], paths.probabilities[owner, slot], owner
