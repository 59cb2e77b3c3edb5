"""Checkpoints come back as they went in; what does not fit is refused, saying what differs."""

import json
import pickle
from dataclasses import asdict

import pytest
import safetensors.torch
import torch

from pcgan import checkpoint
from pcgan.checkpoint import CheckpointError
from pcgan.model import ModelConfig


@pytest.fixture
def saved(tmp_path, make_generator):
    generator = make_generator(dt_s=0.4)
    path = tmp_path / "small.safetensors"
    checkpoint.save(path, generator.config, generator.state_dict(), {"seed": 0})
    return path, generator


def rewrite(path, change_header=None, change_tensors=None):
    header = {"format": 1, "name": "x", "config": asdict(ModelConfig(dt_s=0.4)), "training": {}}
    tensors = safetensors.torch.load_file(path)
    if change_tensors:
        change_tensors(tensors)
    header["tensors_sha256"] = checkpoint._digest(tensors)
    if change_header:
        change_header(header)
    safetensors.torch.save_file(tensors, path, metadata={"pcgan": json.dumps(header)})


def test_round_trip(saved):
    path, generator = saved
    loaded, content = checkpoint.load_generator(path)
    assert content.config == generator.config
    assert content.name == "small"
    assert content.training == {"seed": 0}
    for name, tensor in generator.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor)
    assert not loaded.training


def test_equal_weights_have_equal_bytes(saved, tmp_path):
    path, generator = saved
    again = tmp_path / "again" / "small.safetensors"
    checkpoint.save(again, generator.config, generator.state_dict(), {"seed": 0})
    assert again.read_bytes() == path.read_bytes()
    assert checkpoint.sha256(again) == checkpoint.sha256(path)
    assert len(checkpoint.sha256(path)) == 64
    assert list(again.parent.iterdir()) == [again]  # no .part left


def test_missing_file_names_the_shipped_ones(tmp_path):
    with pytest.raises(CheckpointError, match=r"no checkpoint .*nothing"):
        checkpoint.load_generator(tmp_path / "nothing.safetensors")


@pytest.mark.parametrize("kept", [0, 4, 200, 20_000])
def test_cut_file_is_refused(saved, kept):
    path, _ = saved
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(CheckpointError, match="not a readable safetensors file"):
        checkpoint.load_generator(path)


def test_pickle_is_never_opened(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (pytest.fail, ("a checkpoint was unpickled",))

    path = tmp_path / "bomb.safetensors"
    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(CheckpointError, match="not a readable"):
        checkpoint.load_generator(path)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda h: h.update(format=2), "format 2; this version reads 1"),
        (lambda h: h["config"].update(hidden=16), r"weight .* is .*its configuration needs"),
        (lambda h: h["config"].update(colour="red"), "colour"),
        (lambda h: h["config"].pop("dt_s"), "dt_s"),
        (lambda h: h["config"].update(hidden="32"), "hidden is '32', not a int"),
        (lambda h: h["config"].update(recipe="paper"), "differ in the weights"),
        (lambda h: h["config"].update(uses_vehicle=False), "gvat.phi_vehicle"),
        (lambda h: h["config"].update(dt_s=-1.0), "dt_s must be positive"),
        (lambda h: h.pop("config"), "config"),
        (lambda h: h.update(config=[1]), "small.safetensors"),
    ],
)
def test_header_that_differs_is_refused(saved, change, problem):
    path, _ = saved
    rewrite(path, change)
    with pytest.raises(CheckpointError, match=problem):
        checkpoint.load_generator(path)


@pytest.mark.parametrize("place", [0.5, 0.9, 0.999])
def test_a_flipped_bit_in_the_weights_is_refused(saved, place):
    path, _ = saved
    data = bytearray(path.read_bytes())
    data[int(len(data) * place)] ^= 1
    path.write_bytes(data)
    with pytest.raises(CheckpointError, match=r"small\.safetensors is corrupt: its weights are not those"):
        checkpoint.load_generator(path)


def test_weights_that_differ_are_refused(saved):
    path, _ = saved
    rewrite(path, change_tensors=lambda t: t["phi_mdn.bias"].fill_(torch.nan))
    with pytest.raises(CheckpointError, match=r"phi_mdn\.bias holds NaN"):
        checkpoint.load_generator(path)
    rewrite(path, change_tensors=lambda t: t.update({"phi_mdn.bias": torch.zeros(36, dtype=torch.float64)}))
    with pytest.raises(CheckpointError, match="float64"):
        checkpoint.load_generator(path)


def test_other_safetensors_are_refused(tmp_path):
    path = tmp_path / "other.safetensors"
    safetensors.torch.save_file({"a": torch.zeros(1)}, path, metadata={"format": "pt"})
    with pytest.raises(CheckpointError, match="no pcgan entry"):
        checkpoint.load(path)


def test_shipped_models_load_and_are_small():
    shipped = checkpoint.shipped_models()
    assert checkpoint.DEFAULT_CHECKPOINT in shipped.values()
    for name, path in shipped.items():
        _, content = checkpoint.load_generator(path)
        assert content.name == name
        assert path.stat().st_size < 500_000
        assert path.with_suffix(".md").is_file(), "a shipped model needs a model card"
