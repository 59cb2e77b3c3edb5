"""What a training loop turns: networks, their optimisers, and one update from one batch."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import nn

from pcgan.batches import Batch
from pcgan.discriminator import Discriminator, discriminator_loss, generator_loss, listed
from pcgan.losses import likelihood_and_path, local_future, local_observed
from pcgan.modal_paths import ModalPaths
from pcgan.model import Generator


class Learner(Protocol):
    """A method in training. `modules["generator"]` is what predicts later; the others only help to train it."""

    modules: nn.ModuleDict
    optimisers: list[torch.optim.Optimizer]

    def step(self, batch: Batch, epoch: int, generator: torch.Generator) -> dict[str, float]:
        """Updates everything once and returns the losses by name."""
        ...


@dataclass(frozen=True)
class LossWeights:
    """What a generator minimises: likelihood L_lh, the most probable path's distance, and the adversarial L_adv."""

    likelihood: float = 1.0  # the paper's alpha, once the discriminator takes part
    path: float = 8.0  # per m and step
    adversarial: float = 0.0
    adversarial_from: int = 10  # epochs before that are likelihood and path alone
    as_paper: bool = False  # the paper's form of L_adv


class GeneratorLearner:
    """PCGAN or PSGAN: likelihood first, then against a discriminator that sees the modal paths."""

    def __init__(self, generator: Generator, weights: LossWeights, learning_rate: float, clip: float = 1.0):
        self.weights, self.clip = weights, clip
        self.modules = nn.ModuleDict({"generator": generator})
        self.optimisers: list[torch.optim.Optimizer] = [torch.optim.Adam(generator.parameters(), lr=learning_rate)]
        if weights.adversarial > 0:
            self.modules["discriminator"] = Discriminator(generator.config.dt_s)
            parameters = self.modules["discriminator"].parameters()
            self.optimisers.append(torch.optim.Adam(parameters, lr=learning_rate))

    def step(self, batch: Batch, epoch: int, generator: torch.Generator) -> dict[str, float]:  # noqa: ARG002
        """Updates the generator, and, once its time has come, the discriminator."""
        network, weights = self.modules["generator"], self.weights
        assert isinstance(network, Generator)
        nll, distance, paths = likelihood_and_path(network, batch)
        losses = {"nll": nll.item(), "path_m": distance.item()}
        against = weights.adversarial > 0 and epoch >= weights.adversarial_from
        loss = nll * (weights.likelihood if against or weights.adversarial == 0 else 1.0) + weights.path * distance
        if against:
            discriminator = self.modules["discriminator"]
            chosen = batch.known.any(dim=-1)
            whole = batch.known_throughout[chosen] & batch.observation.seen[chosen].all(dim=-1)  # (B,)
            observed = local_observed(network, batch)[chosen][whole]
            real = local_future(network, batch)[chosen][whole]
            points, probabilities, owner = listed(ModalPaths(paths.probabilities[whole], paths.points[whole]))
            if len(real) > 0:
                everybody = torch.cat([torch.arange(len(real)), owner])
                judged = discriminator(observed, torch.cat([real, points.detach()]), everybody)
                true, false = judged[: len(real)], judged[len(real) :]
                d_loss = discriminator_loss(true, false, probabilities.detach(), as_paper=weights.as_paper)
                self._update(1, "discriminator", d_loss)
                discriminator.requires_grad_(False)
                judged = discriminator(observed, points, owner)
                adversarial = generator_loss(judged, probabilities, len(real), as_paper=weights.as_paper)
                discriminator.requires_grad_(True)
                loss = loss + weights.adversarial * adversarial
                losses |= {"discriminator": d_loss.item(), "adversarial": adversarial.item()}
        self._update(0, "generator", loss)
        return losses

    def _update(self, index: int, name: str, loss: torch.Tensor) -> None:
        self.optimisers[index].zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.modules[name].parameters(), self.clip)
        self.optimisers[index].step()
