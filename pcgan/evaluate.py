"""Scores a generator on windows, beside two extrapolations that need no training."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pcgan import metrics
from pcgan.batches import batches
from pcgan.dataset import Windows
from pcgan.mixture_density import log_likelihood
from pcgan.modal_paths import modal_paths
from pcgan.model import Generator
from schemas.messages import FloatArray


@dataclass(frozen=True)
class Scores:
    """Means over all pedestrians with a known future; distances in m, likelihood in nats per step."""

    pedestrians: int
    ade: float  # of the most probable modal path
    fde: float
    mhd: float
    nll: float
    mean_paths: float  # modal paths per pedestrian


@torch.inference_mode()
def score(generator: Generator, windows: Windows, pedestrians: int = 2048) -> Scores:
    """Returns a generator's scores; raises ValueError if no window has a known future."""
    paths, truths, nlls, counts = [], [], [], []
    for batch in batches(windows, pedestrians):
        mixture = generator.local_mixture(batch.observed, batch.velocity, batch.neighbours, batch.vehicle)
        known = batch.known
        target = local_future(generator, batch.observed, batch.velocity, batch.future)  # (S, A, P, 2)
        modal = modal_paths(mixture.weights[known], mixture.means[known], generator.config.eps_m)
        paths.append(modal.points[:, 0].numpy())
        truths.append(target[known].numpy())
        nlls.append(
            -log_likelihood(mixture, local_future(generator, batch.observed, batch.velocity, batch.future))[known]
        )
        counts.append((modal.probabilities > 0).sum(dim=-1))
    if not truths or not sum(map(len, truths)):
        raise ValueError("no window has a known future")
    predicted, true = np.concatenate(paths), np.concatenate(truths)
    return Scores(
        pedestrians=len(true),
        nll=float(torch.cat(nlls).mean()),
        mean_paths=float(torch.cat(counts).float().mean()),
        **_path_errors(predicted, true),
    )


def extrapolation_scores(windows: Windows, dt_s: float, last_displacement: bool = False) -> Scores:
    """Returns the scores of constant velocity: the windows' own present velocity, or the last displacement.

    The windows' velocity is the tracker's state for a tracker's windows and the weighted velocity for annotated ones.
    The likelihood is of a single round Gaussian per step with the standard deviation that suits these windows best, so
    it flatters the baseline.
    """
    known = windows.known
    if not known.any():
        raise ValueError("no window has a known future")
    present, true = windows.observed[known, -1], windows.future[known]
    velocity = (present - windows.observed[known, -2]) / dt_s if last_displacement else windows.velocity[known]
    times_s = dt_s * np.arange(1, true.shape[1] + 1)[:, None]
    predicted = present[:, None] + velocity[:, None] * times_s
    variance = np.square(predicted - true).mean(axis=(0, 2)).clip(1e-6)  # (P,) m^2; 1 mm at least
    nll = float((np.log(2 * np.pi * variance) + 1).mean())
    return Scores(pedestrians=len(true), nll=nll, mean_paths=1.0, **_path_errors(predicted, true))


def near_vehicle(windows: Windows, distance_m: float = 5.0) -> Windows:
    """Returns the windows with only those futures known whose pedestrian comes this near to a vehicle.

    Near means at any observed step; the vehicle's future is not part of the windows. Neighbours stay in their scenes.
    """
    apart = np.linalg.norm(windows.vehicle[:, :, :2] - windows.observed, axis=-1)  # (N, T) NaN without a vehicle
    near = (apart <= distance_m).any(axis=1)
    return replace(windows, future=np.where(near[:, None, None], windows.future, np.nan))


def local_future(generator: Generator, observed: Tensor, velocity: Tensor, future: Tensor) -> Tensor:
    """Returns futures (..., A, P, 2) relative to the last observed position, in each pedestrian's own frame."""
    return (future - observed[..., -1:, :]) @ generator.scene_from_local(velocity)


def _path_errors(predicted: FloatArray, true: FloatArray) -> dict[str, float]:
    return {
        "ade": float(metrics.ade(predicted, true).mean()),
        "fde": float(metrics.fde(predicted, true).mean()),
        "mhd": float(metrics.mhd(predicted, true).mean()),
    }
