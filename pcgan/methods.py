"""Every method of the tables by name, behind the one interface of `pcgan/forecast.py`."""

from pathlib import Path

import torch

from pcgan import checkpoint
from pcgan.batches import Observation
from pcgan.forecast import Forecast, Method
from pcgan.modal_paths import ModalPaths, modal_paths
from pcgan.model import Generator
from pcgan.sgan import Sgan, SganGenerator
from pcgan.sr_lstm import SrLstm, SrLstmMethod


class GeneratorMethod:
    """PCGAN or PSGAN: one forward pass gives the mixtures, MultiPAC the paths."""

    def __init__(self, name: str, generator: Generator):
        self.name = name
        self.network = generator

    def forecast(self, observation: Observation, generator: torch.Generator) -> Forecast:  # noqa: ARG002
        """Predicts everybody observed; nothing is random."""
        mixture = self.network(observation)
        lead = mixture.rhos.shape[:-2]  # (..., A)
        flat = modal_paths(mixture.weights.flatten(0, -3), mixture.means.flatten(0, -4), self.network.config.eps_m)
        most = int((flat.probabilities > 0).sum(dim=-1).max()) if len(flat.probabilities) else 1
        P = mixture.rhos.shape[-2]
        probabilities = flat.probabilities[:, :most].reshape(*lead, most)
        paths = ModalPaths(probabilities, flat.points[:, :most].reshape(*lead, most, P, 2))
        return Forecast(mixture, paths)


def method_of(name: str, network: checkpoint.Network) -> Method:
    """Returns a network as a method."""
    if isinstance(network, SganGenerator):
        return Sgan(name, network)
    return SrLstmMethod(name, network) if isinstance(network, SrLstm) else GeneratorMethod(name, network)


def load_method(path: Path, name: str | None = None) -> Method:
    """Returns the method in a checkpoint; raises CheckpointError."""
    network, found = checkpoint.load_network(path)
    return method_of(name or found.name, network)
