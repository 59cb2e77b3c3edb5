"""Batches of scenes for training: padded tensors, and what is varied at random in them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pcgan.dataset import Windows
from schemas.messages import IntArray


@dataclass(frozen=True, eq=False)
class Batch:
    """S scenes padded to A pedestrians; float32 tensors without NaN but for the vehicle's."""

    observed: Tensor  # (S, A, T, 2)
    velocity: Tensor  # (S, A, 2)
    future: Tensor  # (S, A, P, 2) 0 where not known
    vehicle: Tensor  # (S, A, T, 4) NaN where there is none
    neighbours: Tensor  # (S, A, A) bool, False from and to padding
    known: Tensor  # (S, A) bool, real pedestrians whose future is known
    annotated: Tensor  # (S, A) bool


def batches(windows: Windows, pedestrians: int, generator: torch.Generator | None = None) -> Iterator[Batch]:
    """Yields all scenes, in batches of about this many pedestrians counting padding.

    With a generator the scenes come shuffled; scenes of like size share a batch, to pad little. Without, in order of
    size.
    """
    if len(windows) == 0:
        return
    first = np.flatnonzero(np.diff(windows.scene, prepend=-1))  # (scenes,) row of each scene's first pedestrian
    sizes = np.diff(first, append=len(windows))
    shuffle = np.arange(len(first)) if generator is None else torch.randperm(len(first), generator=generator).numpy()
    by_size = shuffle[np.argsort(sizes[shuffle], kind="stable")]
    groups: list[IntArray] = []
    start = 0
    while start < len(by_size):
        stop = start + 1
        while stop < len(by_size) and (stop + 1 - start) * sizes[by_size[stop]] <= pedestrians:
            stop += 1
        groups.append(by_size[start:stop])
        start = stop
    order = range(len(groups)) if generator is None else torch.randperm(len(groups), generator=generator).tolist()
    known = windows.known
    for index in order:
        scenes = groups[index]
        slot = np.arange(sizes[scenes].max())  # (A,)
        real = slot < sizes[scenes][:, None]  # (S, A)
        rows = np.where(real, first[scenes][:, None] + slot, first[scenes][:, None])  # padding repeats the first one
        yield Batch(
            observed=torch.from_numpy(windows.observed[rows]),
            velocity=torch.from_numpy(windows.velocity[rows]),
            future=torch.from_numpy(np.nan_to_num(windows.future[rows])),
            vehicle=torch.from_numpy(windows.vehicle[rows]),
            neighbours=torch.from_numpy(real[:, :, None] & real[:, None, :]),
            known=torch.from_numpy(real & known[rows]),
            annotated=torch.from_numpy(real & windows.annotated[rows]),
        )


def augment(batch: Batch, noise_m: float, dt_s: float, generator: torch.Generator) -> Batch:
    """Returns the batch with each scene turned at random and mirrored half of the time; half of the annotated scenes
    get observation noise of a standard deviation uniform in 0..noise_m, and their present velocity from it.
    """
    S = len(batch.observed)
    angle = torch.rand(S, generator=generator) * (2 * torch.pi)
    mirror = torch.where(torch.rand(S, generator=generator) < 0.5, -1.0, 1.0)
    c, s = angle.cos(), angle.sin()
    turn = torch.stack([c, s, -s * mirror, c * mirror], dim=-1).reshape(S, 1, 2, 2)  # (S, 1, 2, 2) for row vectors
    observed, velocity = batch.observed @ turn, batch.velocity @ turn.squeeze(1)
    vehicle = torch.cat([batch.vehicle[..., :2], batch.vehicle[..., 2:]], dim=-2) @ turn
    T = observed.shape[-2]
    if noise_m > 0:
        sigma = torch.rand(S, generator=generator) * noise_m * (torch.rand(S, generator=generator) < 0.5)
        noisy = (sigma[:, None] * batch.annotated)[..., None, None]  # (S, A, 1, 1)
        observed = observed + noisy * torch.randn(observed.shape, generator=generator)
        weights = 0.5 ** torch.arange(T - 2, -1, -1)
        weights = (weights / weights.sum() / dt_s)[:, None]  # (T-1, 1)
        estimate = ((observed[..., 1:, :] - observed[..., :-1, :]) * weights).sum(dim=-2)
        velocity = torch.where(noisy[..., 0] > 0, estimate, velocity)
    return Batch(
        observed=observed,
        velocity=velocity,
        future=batch.future @ turn,
        vehicle=torch.cat([vehicle[..., :T, :], vehicle[..., T:, :]], dim=-1),
        neighbours=batch.neighbours,
        known=batch.known,
        annotated=batch.annotated,
    )
