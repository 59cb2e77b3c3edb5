"""Loss terms of the generator."""

from torch import Tensor

from pcgan.batches import Batch
from pcgan.mixture_density import log_likelihood
from pcgan.modal_paths import ModalPaths, modal_paths
from pcgan.model import Generator


def local_future(generator: Generator, batch: Batch) -> Tensor:
    """Returns the futures (S, A, P, 2) relative to the last observed position, in each pedestrian's own frame."""
    observation = batch.observation
    offset = batch.future - observation.observed[..., -1:, :]
    return offset @ generator.scene_from_local(observation.velocity)


def likelihood_and_path(generator: Generator, batch: Batch) -> tuple[Tensor, Tensor, ModalPaths]:
    """Returns the two terms that the futures ask for, each summed over known steps, mean over pedestrians.

    The negative log-likelihood in nats; the distance in m of the most probable modal path; and the modal paths of all
    (B,) pedestrians with a known step, in their own frames.
    """
    mixture = generator.local_mixture(batch.observation)
    chosen = batch.known.any(dim=-1)  # (S, A)
    known = batch.known[chosen].to(mixture.means.dtype)  # (B, P)
    target = local_future(generator, batch)[chosen]  # (B, P, 2)
    nll = -(log_likelihood(mixture, local_future(generator, batch))[chosen] * known).sum(dim=-1).mean()
    paths = modal_paths(mixture.weights[chosen], mixture.means[chosen], generator.config.eps_m)
    distance = (paths.points[:, 0] - target).square().sum(dim=-1).add(1e-6).sqrt()  # (B, P)
    return nll, (distance * known).sum(dim=-1).mean(), paths


def local_observed(generator: Generator, batch: Batch) -> Tensor:
    """Returns what was observed (S, A, T, 2), in the same frames."""
    observed = batch.observation.observed
    return (observed - observed[..., -1:, :]) @ generator.scene_from_local(batch.observation.velocity)
