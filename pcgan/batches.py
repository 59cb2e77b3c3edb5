"""Batches of scenes for training and scoring: padded tensors, and what is varied at random in them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pcgan.dataset import Windows
from schemas.messages import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Observation:
    """What a predictor may see: S scenes padded to A pedestrians each, or one scene without the leading axis."""

    observed: Tensor  # (S, A, T, 2) m, oldest first, any origin near the scene; filled in where not seen
    seen: Tensor  # (S, A, T) bool, whether somebody was seen at that step; always at the last one
    velocity: Tensor  # (S, A, 2) m/s, present
    neighbours: Tensor  # (S, A, A) bool, who shares a scene with whom; False from and to padding
    vehicle: Tensor | None  # (S, A, T, 4) x, y, vx, vy, the one each pedestrian sees, NaN where there is none


@dataclass(frozen=True, eq=False)
class Batch:
    """S scenes padded to A pedestrians; float32 tensors without NaN but for the vehicle's."""

    observation: Observation
    future: Tensor  # (S, A, P, 2) 0 where not known
    known: Tensor  # (S, A, P) bool, real pedestrians at steps where their future is known
    annotated: Tensor  # (S, A) bool
    row: Tensor  # (S, A) int64, the pedestrian's row in the windows

    @property
    def real(self) -> Tensor:
        """(S, A) bool: not padding."""
        return self.observation.neighbours.diagonal(dim1=-2, dim2=-1)

    @property
    def known_throughout(self) -> Tensor:
        """(S, A) bool: the future is known at every step."""
        return self.known.all(dim=-1)


def batches(
    windows: Windows, pedestrians: int, generator: torch.Generator | None = None, share: FloatArray | None = None
) -> Iterator[Batch]:
    """Yields scenes in batches of about this many pedestrians, counting padding.

    With a generator the scenes come shuffled; scenes of like size share a batch, to pad little. Without, all of them,
    in order of size. `share` (scenes,) is the probability with which each scene is drawn at all.
    """
    if len(windows) == 0:
        return
    first = np.flatnonzero(np.diff(windows.scene, prepend=-1))  # (scenes,) row of each scene's first pedestrian
    sizes = np.diff(first, append=len(windows))
    shuffle = np.arange(len(first))
    if generator is not None:
        shuffle = torch.randperm(len(first), generator=generator).numpy()
        if share is not None:
            shuffle = shuffle[torch.rand(len(first), generator=generator).numpy() < share[shuffle]]
    by_size = shuffle[np.argsort(sizes[shuffle], kind="stable")]
    groups: list[IntArray] = []
    start = 0
    while start < len(by_size):
        stop = start + 1
        while stop < len(by_size) and (stop + 1 - start) * sizes[by_size[stop]] <= pedestrians:
            stop += 1
        groups.append(by_size[start:stop])
        start = stop
    known = windows.known
    future = np.nan_to_num(windows.future)
    order = range(len(groups)) if generator is None else torch.randperm(len(groups), generator=generator).tolist()
    for index in order:
        scenes = groups[index]
        slot = np.arange(sizes[scenes].max())  # (A,)
        real = slot < sizes[scenes][:, None]  # (S, A)
        rows = np.where(real, first[scenes][:, None] + slot, first[scenes][:, None])  # padding repeats the first one
        observation = Observation(
            observed=torch.from_numpy(windows.observed[rows]),
            seen=torch.from_numpy(windows.seen[rows]),
            velocity=torch.from_numpy(windows.velocity[rows]),
            neighbours=torch.from_numpy(real[:, :, None] & real[:, None, :]),
            vehicle=torch.from_numpy(windows.vehicle[rows]),
        )
        yield Batch(
            observation,
            future=torch.from_numpy(future[rows]),
            known=torch.from_numpy(real[..., None] & known[rows]),
            annotated=torch.from_numpy(real & windows.annotated[rows]),
            row=torch.from_numpy(rows),
        )


@dataclass(frozen=True)
class Augmentation:
    """What is varied in a scene at random. Turning and mirroring always are."""

    noise_m: float = 0.0  # half of the annotated scenes get observation noise of a standard deviation up to this
    scale: float = 0.0  # everything is stretched by a factor of 1 - scale to 1 + scale
    forget: float = 0.0  # this share of pedestrians lose up to all but 2 of their oldest observed steps
    hide_vehicle: float = 0.0  # this share of scenes lose their vehicle


def augment(batch: Batch, how: Augmentation, dt_s: float, generator: torch.Generator) -> Batch:
    """Returns the batch with each scene varied; noise touches what is observed and the velocity, never the future."""
    seen, S = batch.observation.seen, len(batch.future)
    observed, velocity = batch.observation.observed, batch.observation.velocity
    angle = torch.rand(S, generator=generator) * (2 * torch.pi)
    mirror = torch.where(torch.rand(S, generator=generator) < 0.5, -1.0, 1.0)
    factor = 1 + how.scale * (2 * torch.rand(S, generator=generator) - 1)
    c, s = factor * angle.cos(), factor * angle.sin()
    turn = torch.stack([c, s, -s * mirror, c * mirror], dim=-1).reshape(S, 1, 2, 2)  # (S, 1, 2, 2) for row vectors
    observed, velocity = observed @ turn, velocity @ turn.squeeze(1)
    vehicle = batch.observation.vehicle
    if vehicle is not None:
        T = observed.shape[-2]
        turned = torch.cat([vehicle[..., :2], vehicle[..., 2:]], dim=-2) @ turn
        vehicle = torch.cat([turned[..., :T, :], turned[..., T:, :]], dim=-1)
        if how.hide_vehicle > 0:
            hidden = torch.rand(S, generator=generator) < how.hide_vehicle
            vehicle = vehicle.masked_fill(hidden[:, None, None, None], torch.nan)
    if how.noise_m > 0:
        sigma = torch.rand(S, generator=generator) * how.noise_m * (torch.rand(S, generator=generator) < 0.5)
        noise = (sigma[:, None] * batch.annotated)[..., None, None]  # (S, A, 1, 1)
        observed = observed + noise * torch.randn(observed.shape, generator=generator)
    if how.forget > 0:
        steps = observed.shape[-2]
        first = torch.randint(0, steps - 1, seen.shape[:-1], generator=generator)  # (S, A)
        first = torch.where(torch.rand(first.shape, generator=generator) < how.forget, first, 0)
        first = torch.maximum(first, seen.to(torch.uint8).argmax(dim=-1)).clamp(max=steps - 2)
        latest = torch.where(seen, torch.arange(steps), 0).cummax(dim=-1).values  # (S, A, T) seen at or before a step
        first = latest.gather(-1, first.unsqueeze(-1)).squeeze(-1)  # in a gap: nobody may begin unseen
        begun = torch.arange(steps) >= first.unsqueeze(-1)  # (S, A, T)
        start = observed.gather(-2, first[..., None, None].expand(*first.shape, 1, 2))
        observed = torch.where(begun.unsqueeze(-1), observed, start)
        seen = seen & begun
    if how.noise_m > 0 or how.forget > 0:
        estimate = weighted_velocity(observed, seen, dt_s)
        velocity = torch.where(batch.annotated.unsqueeze(-1), estimate, velocity)
    observation = replace(batch.observation, observed=observed, seen=seen, velocity=velocity, vehicle=vehicle)
    return replace(batch, observation=observation, future=batch.future @ turn)


def weighted_velocity(observed: Tensor, seen: Tensor, dt_s: float) -> Tensor:
    """(..., T, 2) m, (..., T) -> (..., 2) m/s: as `dataset.weighted_velocity`, in torch."""
    T = observed.shape[-2]
    weights = 0.5 ** torch.arange(T - 2, -1, -1) * begun(seen)  # (..., T-1)
    steps = (observed[..., 1:, :] - observed[..., :-1, :]) / dt_s
    total = weights.sum(dim=-1, keepdim=True).clamp_min(1e-9)
    return (steps * (weights / total).unsqueeze(-1)).sum(dim=-2)


def begun(seen: Tensor) -> Tensor:
    """(..., T) bool -> (..., T-1): 1 for displacements after the first seen step, 0 for those that only fill in."""
    return (seen.cumsum(dim=-1)[..., :-1] > 0).to(torch.get_default_dtype())
