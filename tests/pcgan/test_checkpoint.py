"""Checkpoints come back as they went in; what does not fit is refused, saying what differs."""

import json
import pickle
from dataclasses import asdict

import pytest
import safetensors.torch
import torch

from pcgan import checkpoint
from pcgan.checkpoint import CheckpointError
from pcgan.model import Generator, ModelConfig
from pcgan.sgan import SganConfig, SganGenerator
from pcgan.sr_lstm import SrLstm, SrLstmConfig

KINDS = {
    "pcgan": (ModelConfig(hidden=8, embedding=4, mlp=8), Generator),
    "psgan": (ModelConfig(hidden=8, embedding=4, mlp=8, pooling="social", recipe="paper"), Generator),
    "sgan": (SganConfig(pooling_hidden=16, mlp=8), SganGenerator),
    "srlstm": (SrLstmConfig(hidden=8, embedding=4), SrLstm),
}


@pytest.fixture
def saved(tmp_path, make_generator):
    generator = make_generator(dt_s=0.4)
    path = tmp_path / "small.safetensors"
    checkpoint.save(path, generator.config, generator.state_dict(), {"seed": 0})
    return path, generator


def rewrite(path, change_header=None, change_tensors=None):
    header = {"format": 2, "name": "x", "network": "pcgan", "config": asdict(ModelConfig(dt_s=0.4)), "training": {}}
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


@pytest.fixture
def save_kind(tmp_path):
    """Saves a network of one of the kinds with random weights and buffers."""

    def save(kind):
        config, _ = KINDS[kind]
        path = tmp_path / f"{kind}.safetensors"
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(3)
            network = checkpoint.build(config)
            for buffer in network.buffers():
                buffer.copy_(torch.rand(buffer.shape))
        checkpoint.save(path, config, network.state_dict(), {"data": "vci"})
        return path, network

    return save


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_network_comes_back(save_kind, kind):
    """Weights and what was fitted after training, which are buffers; and the header alone says what it is."""
    path, network = save_kind(kind)
    loaded, content = checkpoint.load_network(path)
    config, type_ = KINDS[kind]
    assert type(loaded) is type_
    assert content.config == loaded.config == config
    assert len(list(network.buffers())) == 1
    for name, tensor in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor)
    assert not loaded.training
    described = checkpoint.describe(path)
    assert (described.name, described.config, described.training) == (kind, config, {"data": "vci"})
    assert described.network == ("pcgan" if type_ is Generator else kind)
    assert described.horizon_s == pytest.approx(12 * config.dt_s)
    assert described.uses_vehicle == (type_ is Generator)


@pytest.mark.parametrize(("kind", "name"), [("sgan", "SganGenerator"), ("srlstm", "SrLstm")])
def test_other_networks_are_no_generator(save_kind, kind, name):
    path, _ = save_kind(kind)
    with pytest.raises(CheckpointError, match=rf"{kind}\.safetensors is a {name}; .* PCGAN or PSGAN generator"):
        checkpoint.load_generator(path)


def test_network_of_a_kind_has_a_config_of_that_kind(save_kind):
    path, _ = save_kind("pcgan")
    rewrite(path, lambda h: h.update(network="srlstm"))
    with pytest.raises(CheckpointError, match="SR-LSTM configuration differs in the fields"):
        checkpoint.load_network(path)


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
        (lambda h: h.update(format=1), r"small\.safetensors is of checkpoint format 1; this version reads 2"),
        (lambda h: h.update(format=3), "format 3; this version reads 2"),
        (lambda h: h.pop("format"), "header that cannot be read"),
        (lambda h: h.update(network="wgan"), r"network 'wgan' .*pcgan, sgan, srlstm"),
        (lambda h: h.pop("network"), "network"),
        (lambda h: h["config"].update(hidden=16), r"weight .* is .*its configuration needs"),
        (lambda h: h["config"].update(colour="red"), "colour"),
        (lambda h: h["config"].pop("dt_s"), "dt_s"),
        (lambda h: h["config"].update(hidden="32"), "hidden is '32', not a int"),
        (lambda h: h["config"].update(recipe="paper"), "differ in the weights"),
        (lambda h: h["config"].update(uses_vehicle=False), "gvat.phi_vehicle"),
        (lambda h: h["config"].update(pooling="social"), "differ in the weights"),
        (lambda h: h["config"].update(dt_s=-1.0), "dt_s must be positive"),
        (lambda h: h["config"].update(hidden=10**9), r"hidden is 1000000000, more than any network has \(10000\)"),
        (lambda h: h["config"].update(predicted_steps=10**400), "predicted_steps is 1000.*, more than any network has"),
        (lambda h: h["config"].update(hidden=10_000, embedding=10_000), r"weight .* its configuration needs"),
        (lambda h: h.pop("config"), "config"),
        (lambda h: h.update(config=[1]), "small.safetensors"),
    ],
)
def test_header_that_differs_is_refused(saved, change, problem):
    path, _ = saved
    rewrite(path, change)
    with pytest.raises(CheckpointError, match=problem):
        checkpoint.load_generator(path)


@pytest.mark.parametrize("text", ["{", "1" * 5000, "[" * 100_000, "[]", "null"], ids=lambda text: text[:5])
def test_header_that_is_no_json_object_is_refused(tmp_path, text):
    path = tmp_path / "odd.safetensors"
    safetensors.torch.save_file({"w": torch.zeros(2)}, path, {"pcgan": text})
    with pytest.raises(CheckpointError, match=r"odd\.safetensors has a header that cannot be read") as refusal:
        checkpoint.describe(path)
    assert len(str(refusal.value)) < 500


def test_format_of_before_is_refused_by_its_header_alone(saved):
    """As files of format 1 were: no kind of network, other fields in the configuration."""
    path, _ = saved

    def older(header):
        header.update(format=1)
        del header["network"], header["config"]["pooling"]

    rewrite(path, older)
    for look in (checkpoint.describe, checkpoint.load, checkpoint.load_network, checkpoint.load_generator):
        with pytest.raises(CheckpointError, match=r"small\.safetensors is of checkpoint format 1; this version"):
            look(path)


def test_what_is_far_too_large_is_not_read(saved, monkeypatch):
    path, _ = saved
    monkeypatch.setattr(checkpoint, "MAX_BYTES", 1000)
    with pytest.raises(CheckpointError, match=r"bytes, more than any checkpoint \(1000\)"):
        checkpoint.load(path)


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


# --- models that ship ------------------------------------------------------------------------------------------------


def test_shipped_models_load_and_are_small():
    shipped = checkpoint.shipped_models()
    assert checkpoint.DEFAULT_CHECKPOINT in shipped.values()
    for name, path in shipped.items():
        _, content = checkpoint.load_generator(path)
        assert content.name == name
        assert path.stat().st_size < 500_000
        assert path.with_suffix(".md").is_file(), "a shipped model needs a model card"


def test_models_of_the_tables_load():
    for name, path in checkpoint.table_models().items():
        _, content = checkpoint.load_network(path)
        assert content.name == name


def test_model_is_found_by_name_or_path(saved):
    path, _ = saved
    name, shipped = next(iter(checkpoint.shipped_models().items()))
    assert checkpoint.find_model(path) == path
    assert checkpoint.find_model(str(path)) == path
    assert checkpoint.find_model(name) == shipped
    assert checkpoint.find_model(None) == checkpoint.DEFAULT_CHECKPOINT
    with pytest.raises(CheckpointError, match=rf"nobody.*shipped models are .*{name}"):
        checkpoint.find_model("nobody")


def test_model_for_a_horizon_is_the_shortest_that_reaches(tmp_path, monkeypatch):
    for name, config in {"near": ModelConfig(), "far": ModelConfig(dt_s=0.4)}.items():
        checkpoint.save(tmp_path / f"{name}.safetensors", config, {}, {})
    monkeypatch.setattr(checkpoint, "WEIGHTS_FOLDER", tmp_path)
    wanted = {0.5: "near", 1.2: "near", 1.3: "far", 4.8: "far"}
    assert {h: checkpoint.model_for_horizon(h).stem for h in wanted} == wanted
    with pytest.raises(CheckpointError, match=r"5 s ahead; there are far \(4\.8 s\), near \(1\.2 s\)"):
        checkpoint.model_for_horizon(5.0)
