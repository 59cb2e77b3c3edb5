"""Learners of the baselines from the literature, Social GAN and SR-LSTM: one update from one batch each.

Only pedestrians with a complete history and a wholly known future are learned from; the others with a complete history
are their neighbours, and the rest are not there (`complete`).
"""

import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from pcgan.batches import Batch, Observation
from pcgan.sgan import SganDiscriminator, SganGenerator, adversarial_loss, last_velocity
from pcgan.sr_lstm import SrLstm

LEAST_RATE = 0.02  # of the first learning rate, in the last epoch


class SganLearner:
    """Social GAN: an adversarial loss on one sample, and the variety loss on the best of several.

    The best sample is found without gradients and drawn again with them: the gradient of a minimum is that of the
    sample that attains it. As the noise is a scene's, so is the choice of its best sample.

    `modules` holds "generator" and "discriminator", `optimisers` theirs in that order. With `epochs`, learning rates
    fall along a cosine over so many; without, they are the caller's business.
    """

    def __init__(
        self,
        generator: SganGenerator,
        learning_rate: float = 1e-3,
        epochs: int | None = None,
        *,
        best_of: int = 10,
        variety_weight: float = 1.0,
        judge_steps: int = 1,
        clip: float = 2.0,
    ):
        self.config = generator.config
        self.learning_rate, self.epochs = learning_rate, epochs
        self.best_of, self.variety_weight = best_of, variety_weight
        self.judge_steps, self.clip = judge_steps, clip
        self.modules = nn.ModuleDict({"generator": generator, "discriminator": SganDiscriminator(generator.config)})
        self.optimisers: list[torch.optim.Optimizer] = [
            torch.optim.Adam(self.modules[name].parameters(), lr=learning_rate)
            for name in ("generator", "discriminator")
        ]

    def step(self, batch: Batch, epoch: int, generator: torch.Generator) -> dict[str, float]:
        """Updates the discriminator, `judge_steps` times, then the generator; {} if there is nobody to learn from.

        Returns variety (m, root mean square distance of a scene's best sample), adversarial and discriminator (nats).
        """
        network, judge = self.modules["generator"], self.modules["discriminator"]
        assert isinstance(network, SganGenerator)
        assert isinstance(judge, SganDiscriminator)
        set_rates(self.optimisers, self.learning_rate, epoch, self.epochs)
        batch = complete(batch)
        if len(batch.future) == 0:
            return {}
        observation, chosen = batch.observation, batch.known_throughout
        scene = chosen.nonzero()[:, 0]  # (B,)
        last = observation.observed[..., -1:, :]
        past = (observation.observed - last)[chosen]  # (B, T, 2)
        future = (batch.future - last)[chosen]  # (B, P, 2)
        velocity = last_velocity(observation, self.config.dt_s)[chosen].unsqueeze(1)  # (B, 1, 2)
        noise = torch.randn(len(batch.future), self.best_of + 1, self.config.noise_dim, generator=generator)
        context = network.encode(observation)[chosen].unsqueeze(1)  # (B, 1, C)
        with torch.no_grad():
            tried = network.decode(context, velocity, noise[scene, : self.best_of])  # (B, N, P, 2)
            errors = path_distance(tried, future.unsqueeze(1))  # (B, N)
            best = errors.new_zeros(len(noise), self.best_of).index_add(0, scene, errors).argmin(dim=1)  # (S,)
        noise = torch.stack([noise[torch.arange(len(noise)), best], noise[:, -1]], dim=1)  # (S, 2, Z)
        paths = network.decode(context, velocity, noise[scene])  # (B, 2, P, 2)
        real, fake = torch.cat([past, future], dim=1), torch.cat([past, paths[:, 1]], dim=1)  # (B, T + P, 2)

        for _ in range(self.judge_steps):
            real_logits, fake_logits = judge(torch.cat([real, fake.detach()])).chunk(2)
            d_loss = adversarial_loss(real_logits, real=True) + adversarial_loss(fake_logits, real=False)
            _update(self.optimisers[1], d_loss)
        judge.requires_grad_(False)
        adversarial = adversarial_loss(judge(fake), real=True)
        judge.requires_grad_(True)
        variety = path_distance(paths[:, 0], future).mean()
        _update(self.optimisers[0], adversarial + self.variety_weight * variety, network, self.clip)
        return {"variety": variety.item(), "adversarial": adversarial.item(), "discriminator": d_loss.item()}


class SrLstmLearner:
    """SR-LSTM: the mean distance of its path.

    `modules` holds "generator". With `epochs`, the learning rate falls along a cosine over so many; without, it is the
    caller's business.
    """

    def __init__(
        self, generator: SrLstm, learning_rate: float = 1.5e-3, epochs: int | None = None, *, clip: float = 1.0
    ):
        self.config = generator.config
        self.learning_rate, self.epochs, self.clip = learning_rate, epochs, clip
        self.modules = nn.ModuleDict({"generator": generator})
        self.optimisers: list[torch.optim.Optimizer] = [torch.optim.Adam(generator.parameters(), lr=learning_rate)]

    def step(self, batch: Batch, epoch: int, generator: torch.Generator) -> dict[str, float]:  # noqa: ARG002
        """Updates the network; returns path (m, mean over steps and pedestrians), {} without anybody to learn from."""
        network = self.modules["generator"]
        assert isinstance(network, SrLstm)
        set_rates(self.optimisers, self.learning_rate, epoch, self.epochs)
        batch = complete(batch)
        if len(batch.future) == 0:
            return {}
        chosen = batch.known_throughout
        error = network(batch.observation)[chosen] - batch.future[chosen]  # (B, P, 2)
        loss = error.square().sum(dim=-1).add(1e-6).sqrt().mean()
        _update(self.optimisers[0], loss, network, self.clip)
        return {"path": loss.item()}


def complete(batch: Batch) -> Batch:
    """Returns the batch without those whose history has gaps, without scenes of nobody whose future is wholly known,
    and with only the padding that is then needed; S may be 0.
    """
    present = batch.real & batch.observation.seen.all(dim=-1)  # (S, A)
    scenes = (present & batch.known_throughout).any(dim=-1).nonzero()[:, 0]  # (S',)
    present = present[scenes]
    A = int(present.sum(dim=-1).max()) if len(scenes) else 0
    order = present.to(torch.uint8).argsort(dim=-1, descending=True, stable=True)[:, :A]  # (S', A') those present first
    index = (scenes[:, None], order)
    there = present.gather(-1, order)
    old = batch.observation
    observation = Observation(
        observed=old.observed[index],
        seen=old.seen[index],
        velocity=old.velocity[index],
        neighbours=there[:, :, None] & there[:, None, :],
        vehicle=None,
    )
    return replace(
        batch,
        observation=observation,
        future=batch.future[index],
        known=batch.known[index] & there[..., None],
        annotated=batch.annotated[index] & there,
        row=batch.row[index],
    )


def path_distance(paths: Tensor, futures: Tensor) -> Tensor:
    """(..., P, 2), (..., P, 2) m -> (...): the L2 norm of the whole difference over sqrt(P), in m."""
    return (paths - futures).square().sum(dim=-1).mean(dim=-1).add(1e-6).sqrt()


def set_rates(optimisers: list[torch.optim.Optimizer], first: float, epoch: int, epochs: int | None) -> None:
    """Sets learning rates to a cosine from `first` down to 0.02 of it; leaves them alone without `epochs`."""
    if epochs is None:
        return
    fraction = min(1.0, epoch / max(1, epochs - 1))
    rate = first * (LEAST_RATE + (1 - LEAST_RATE) * 0.5 * (1 + math.cos(math.pi * fraction)))
    for optimiser in optimisers:
        for group in optimiser.param_groups:
            group["lr"] = rate


def _update(
    optimiser: torch.optim.Optimizer, loss: Tensor, network: nn.Module | None = None, clip: float = math.inf
) -> None:
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    if network is not None:
        nn.utils.clip_grad_norm_(network.parameters(), clip)
    optimiser.step()
