"""Checkpoints: safetensors with the whole configuration in the header. Nothing is ever unpickled.

The header holds one entry, `pcgan`, a JSON object with sorted keys: one entry, because safetensors writes several in an
order that changes from run to run, and equal weights should have equal checksums.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from pcgan.model import Generator, ModelConfig
from pcgan.sgan import SganConfig, SganGenerator
from pcgan.sr_lstm import SrLstm, SrLstmConfig

FORMAT_VERSION = 2
NetworkConfig = ModelConfig | SganConfig | SrLstmConfig
Network = Generator | SganGenerator | SrLstm
_KINDS: dict[str, type[NetworkConfig]] = {"pcgan": ModelConfig, "sgan": SganConfig, "srlstm": SrLstmConfig}
WEIGHTS_FOLDER = Path(__file__).parent / "weights"
TABLE_WEIGHTS = WEIGHTS_FOLDER / "tables"
DEFAULT_CHECKPOINT = WEIGHTS_FOLDER / "vehicle_2.5hz.safetensors"
MAX_BYTES = 64 << 20  # a generator has 0.1 MB; what is far larger is something else
MAX_SIZE = 10_000  # of anything that a configuration counts; a layer has some hundreds


class CheckpointError(ValueError):
    """A file that is not a checkpoint this version can use; the message names the file and what differs."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A file's content: the configuration, what is known of the training, and all tensors by name."""

    name: str
    config: NetworkConfig
    training: dict[str, Any]  # data, seed, epochs, figures: for people and model cards
    tensors: dict[str, Tensor]


@dataclass(frozen=True)
class Description:
    """What a checkpoint's header says, without its weights."""

    name: str
    network: str  # pcgan, sgan or srlstm
    config: NetworkConfig
    training: dict[str, Any]

    @property
    def horizon_s(self) -> float:
        """How far ahead the last predicted step is."""
        return self.config.predicted_steps * self.config.dt_s

    @property
    def uses_vehicle(self) -> bool:
        """Whether the vehicle's motion is an input."""
        return isinstance(self.config, ModelConfig) and self.config.uses_vehicle


def shipped_models() -> dict[str, Path]:
    """Returns the checkpoints that come with the package and predict in replays, by name, sorted."""
    return _checkpoints(WEIGHTS_FOLDER)


def table_models() -> dict[str, Path]:
    """Returns the checkpoints behind the tables of `pcgan evaluate`, by name, sorted."""
    return _checkpoints(TABLE_WEIGHTS)


def find_model(name_or_path: str | Path | None) -> Path:
    """Returns the file of a shipped model or a file itself; None is the default. Raises CheckpointError for others."""
    if name_or_path is None:
        return DEFAULT_CHECKPOINT
    shipped, tables = shipped_models(), table_models()
    if (path := Path(name_or_path)).is_file():
        return path
    if found := (shipped | tables).get(str(name_or_path)):
        return found
    raise CheckpointError(f"no checkpoint {name_or_path}; shipped models are {sorted(shipped)}")


def model_for_horizon(horizon_s: float) -> Path:
    """Returns the shipped model with the shortest horizon of at least horizon_s.

    Raises CheckpointError, naming the horizons there are, if it is beyond all of them.
    """
    horizons = {path: describe(path).horizon_s for path in shipped_models().values()}
    far_enough = {path: horizon for path, horizon in horizons.items() if horizon >= horizon_s - 1e-6}
    if not far_enough:
        there_are = ", ".join(f"{path.stem} ({horizon:g} s)" for path, horizon in horizons.items())
        raise CheckpointError(f"no shipped model looks {horizon_s:g} s ahead; there are {there_are}")
    return min(far_enough, key=lambda path: (far_enough[path], path))


def describe(path: Path) -> Description:
    """Returns what a checkpoint's header says; weights are neither read nor checked. Raises CheckpointError."""
    try:
        with safe_open(path, framework="np") as file:
            header = _header(path, file.metadata())
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is not a readable safetensors file: {error}") from error
    return _description(path, header)


def _checkpoints(folder: Path) -> dict[str, Path]:
    return {path.stem: path for path in sorted(folder.glob("*.safetensors"))}


def sha256(path: Path) -> str:
    """Returns the SHA-256 of a file in hex: what logs and predictions name a checkpoint by."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def save(path: Path, config: NetworkConfig, tensors: Mapping[str, Tensor], training: Mapping[str, Any]) -> None:
    """Writes a checkpoint; an existing file is replaced only once the new one is complete."""
    contiguous = {name: tensor.detach().contiguous().clone() for name, tensor in sorted(tensors.items())}
    header = {
        "format": FORMAT_VERSION,
        "name": path.stem,
        "network": next(kind for kind, type_ in _KINDS.items() if isinstance(config, type_)),
        "config": asdict(config),
        "training": dict(training),
        "tensors_sha256": _digest(contiguous),
    }
    data = safetensors.torch.save(contiguous, metadata={"pcgan": json.dumps(header, sort_keys=True)})
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part")
    part.write_bytes(data)
    part.replace(path)


def load(path: Path) -> Checkpoint:
    """Returns a checkpoint's content, without checking the tensors against a model.

    Raises CheckpointError if the file is missing, corrupt, of another format version, or its configuration is not one.
    """
    if not path.is_file():
        raise CheckpointError(f"no checkpoint {path}; shipped models are {sorted(shipped_models())}")
    if path.stat().st_size > MAX_BYTES:
        raise CheckpointError(f"{path} has {path.stat().st_size} bytes, more than any checkpoint ({MAX_BYTES})")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata()
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(f"{path} is not a readable safetensors file: {error}") from error
    header = _header(path, metadata)
    described = _description(path, header)
    if header.get("tensors_sha256") != _digest(tensors):
        raise CheckpointError(f"{path} is corrupt: its weights are not those that were saved")
    return Checkpoint(described.name, described.config, described.training, tensors)


def _header(path: Path, metadata: Mapping[str, str] | None) -> dict[str, Any]:
    """Returns our entry of a file's metadata, of the right format version."""
    if "pcgan" not in (metadata := metadata or {}):
        raise CheckpointError(f"{path} has no pcgan entry in its header; its entries are {sorted(metadata)}")
    try:
        header: dict[str, Any] = json.loads(metadata["pcgan"])
        version = header["format"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:  # ValueError: no JSON, or thousands of digits
        raise CheckpointError(f"{path} has a header that cannot be read: {error!r:.200}") from error
    if version != FORMAT_VERSION:
        raise CheckpointError(f"{path} is of checkpoint format {version}; this version reads {FORMAT_VERSION}")
    return header


def _description(path: Path, header: Mapping[str, Any]) -> Description:
    try:
        network = str(header["network"])
        if network not in _KINDS:
            raise ValueError(f"network {network!r} is of no known kind; there are {', '.join(_KINDS)}")
        config = _KINDS[network].from_dict(header["config"])
        for name, value in asdict(config).items():
            if isinstance(value, int | float) and abs(value) > MAX_SIZE:
                raise ValueError(f"{name} is {value!s:.20}, more than any network has ({MAX_SIZE})")
        return Description(str(header["name"]), network, config, dict(header["training"]))
    except KeyError as error:
        raise CheckpointError(f"{path} has no {error} in its header") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(f"{path}: {error}") from error


def _digest(tensors: Mapping[str, Tensor]) -> str:
    """Returns the SHA-256 of named tensors, in hex; safetensors itself has no checksum."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(name.encode() + tensor.detach().contiguous().numpy().tobytes())
    return digest.hexdigest()


def build(config: NetworkConfig) -> Network:
    """Returns the network of a configuration, with fresh weights."""
    if isinstance(config, SganConfig):
        return SganGenerator(config)
    return SrLstm(config) if isinstance(config, SrLstmConfig) else Generator(config)


def load_network(path: Path) -> tuple[Network, Checkpoint]:
    """Returns the network in a checkpoint, ready for inference, and the checkpoint.

    Raises CheckpointError as `load` does, and if names, shapes or types of the weights are not the configuration's, or
    one is not finite.
    """
    checkpoint = load(path)
    with torch.device("meta"):  # takes no memory: the header may claim any size
        wanted = build(checkpoint.config).state_dict()
    if differing := sorted(wanted.keys() ^ checkpoint.tensors.keys()):
        raise CheckpointError(f"{path} and its configuration differ in the weights {differing}")
    for name, tensor in checkpoint.tensors.items():
        if tensor.shape != wanted[name].shape or tensor.dtype != wanted[name].dtype:
            found, needed = f"{tensor.dtype} {tuple(tensor.shape)}", f"{wanted[name].dtype} {tuple(wanted[name].shape)}"
            raise CheckpointError(f"{path}: weight {name} is {found}, its configuration needs {needed}")
        if not torch.isfinite(tensor).all():
            raise CheckpointError(f"{path}: weight {name} holds NaN or infinity")
    network = build(checkpoint.config)
    network.load_state_dict(checkpoint.tensors)
    return network.eval(), checkpoint


def load_generator(path: Path) -> tuple[Generator, Checkpoint]:
    """Returns a PCGAN or PSGAN generator and its checkpoint; raises CheckpointError as `load_network` does."""
    network, checkpoint = load_network(path)
    if not isinstance(network, Generator):
        raise CheckpointError(f"{path} is a {type(network).__name__}; what is needed is a PCGAN or PSGAN generator")
    return network, checkpoint
