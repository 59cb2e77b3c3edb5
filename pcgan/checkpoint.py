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

FORMAT_VERSION = 1
WEIGHTS_FOLDER = Path(__file__).parent / "weights"
DEFAULT_CHECKPOINT = WEIGHTS_FOLDER / "vehicle_10hz.safetensors"
MAX_BYTES = 64 << 20  # a generator has 0.1 MB; what is far larger is something else


class CheckpointError(ValueError):
    """A file that is not a checkpoint this version can use; the message names the file and what differs."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A file's content: the configuration, what is known of the training, and all tensors by name."""

    name: str
    config: ModelConfig
    training: dict[str, Any]  # data, seed, epochs, figures: for people and model cards
    tensors: dict[str, Tensor]


def shipped_models() -> dict[str, Path]:
    """Returns the checkpoints that come with the package, by name, sorted."""
    return {path.stem: path for path in sorted(WEIGHTS_FOLDER.glob("*.safetensors"))}


def sha256(path: Path) -> str:
    """Returns the SHA-256 of a file in hex: what logs and predictions name a checkpoint by."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def save(path: Path, config: ModelConfig, tensors: Mapping[str, Tensor], training: Mapping[str, Any]) -> None:
    """Writes a checkpoint; an existing file is replaced only once the new one is complete."""
    contiguous = {name: tensor.detach().contiguous().clone() for name, tensor in sorted(tensors.items())}
    header = {
        "format": FORMAT_VERSION,
        "name": path.stem,
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
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(f"{path} is not a readable safetensors file: {error}") from error
    if "pcgan" not in metadata:
        raise CheckpointError(f"{path} has no pcgan entry in its header; its entries are {sorted(metadata)}")
    try:
        header = json.loads(metadata["pcgan"])
        version = header["format"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path} has a header that cannot be read: {error!r}") from error
    if version != FORMAT_VERSION:
        raise CheckpointError(f"{path} is of checkpoint format {version}; this version reads {FORMAT_VERSION}")
    try:
        config = ModelConfig.from_dict(header["config"])
        name, training, digest = str(header["name"]), dict(header["training"]), header["tensors_sha256"]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(f"{path}: {error}") from error
    if digest != _digest(tensors):
        raise CheckpointError(f"{path} is corrupt: its weights are not those that were saved")
    return Checkpoint(name, config, training, tensors)


def _digest(tensors: Mapping[str, Tensor]) -> str:
    """Returns the SHA-256 of named tensors, in hex; safetensors itself has no checksum."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(name.encode() + tensor.detach().contiguous().numpy().tobytes())
    return digest.hexdigest()


def load_generator(path: Path) -> tuple[Generator, Checkpoint]:
    """Returns the generator in a checkpoint, ready for inference, and the checkpoint.

    Raises CheckpointError as `load` does, and if names, shapes or types of the weights are not the configuration's, or
    one is not finite.
    """
    checkpoint = load(path)
    generator = Generator(checkpoint.config)
    wanted = generator.state_dict()
    if differing := sorted(wanted.keys() ^ checkpoint.tensors.keys()):
        raise CheckpointError(f"{path} and its configuration differ in the weights {differing}")
    for name, tensor in checkpoint.tensors.items():
        if tensor.shape != wanted[name].shape or tensor.dtype != wanted[name].dtype:
            found, needed = f"{tensor.dtype} {tuple(tensor.shape)}", f"{wanted[name].dtype} {tuple(wanted[name].shape)}"
            raise CheckpointError(f"{path}: weight {name} is {found}, its configuration needs {needed}")
        if not torch.isfinite(tensor).all():
            raise CheckpointError(f"{path}: weight {name} holds NaN or infinity")
    generator.load_state_dict(checkpoint.tensors)
    return generator.eval(), checkpoint
