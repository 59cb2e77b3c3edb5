"""Training learns, is repeatable, goes on where it stopped, and leaves something usable when stopped."""

import csv
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
import torch
from rich.console import Console

from pcgan import checkpoint, train
from pcgan.checkpoint import CheckpointError
from pcgan.clips import DataNotFound
from pcgan.dataset import WindowSpec, clip_windows, concatenate
from pcgan.evaluate import extrapolation_scores, score
from pcgan.train import TrainConfig, TrainData
from pcgan.windows_file import save_windows

SPEC = WindowSpec(8, 12, 0.1, 0.2)


@pytest.fixture
def quiet():
    return Console(file=StringIO())


@pytest.fixture
def data(make_clip):
    training = concatenate([clip_windows(make_clip(seed=seed), SPEC) for seed in range(3)])
    return TrainData(training, {"made": clip_windows(make_clip(seed=9), SPEC)})


@pytest.fixture
def config(tmp_path):
    return TrainConfig(output_dir=tmp_path / "run", epochs=3, batch_pedestrians=40, seed=4)


def weights(path):
    return checkpoint.load(path).tensors


def test_overfits_a_tiny_batch(make_clip, tmp_path, quiet):
    """Curving walkers are learnt by heart: far better than any extrapolation of their velocity."""
    windows = clip_windows(make_clip(pedestrians=5, frames=60, seed=1, turn_radps=1.0), SPEC)
    config = TrainConfig(tmp_path, epochs=100, noise_m=0.0, learning_rate=1e-2, ema=0.9, path_weight=100.0)
    path = train.train(config, TrainData(windows, {}), quiet)
    generator, _ = checkpoint.load_generator(path)
    learnt, straight = score(generator, windows), extrapolation_scores(windows, 0.1)
    assert learnt.ade < 0.3 * straight.ade
    assert learnt.fde < 0.3 * straight.fde
    assert learnt.nll < straight.nll - 1


def test_equal_seeds_give_equal_weights(config, data, quiet):
    first = train.train(config, data, quiet)
    again = train.train(replace(config, output_dir=config.output_dir / "again"), data, quiet)
    other = train.train(replace(config, output_dir=config.output_dir / "other", seed=5), data, quiet)
    assert first.read_bytes() == again.read_bytes()
    assert first.read_bytes() != other.read_bytes()


def test_interrupted_run_goes_on_as_if_it_had_not_stopped(config, data, quiet, monkeypatch):
    whole = train.train(replace(config, output_dir=config.output_dir / "whole"), data, quiet)
    real, calls = train._loss, []

    def stop_in_second_epoch(*args):
        calls.append(1)
        if len(calls) == batches_per_epoch + 2:
            raise KeyboardInterrupt
        return real(*args)

    batches_per_epoch = sum(1 for _ in train.batches(data.training, config.batch_pedestrians))
    assert batches_per_epoch > 2
    monkeypatch.setattr(train, "_loss", stop_in_second_epoch)
    stopped = train.train(config, data, quiet)
    assert checkpoint.load(stopped).training["epochs_done"] == 1
    monkeypatch.setattr(train, "_loss", real)
    resumed = train.train(config, data, quiet)
    assert resumed == stopped
    assert resumed.read_bytes() == whole.read_bytes()
    curve = list(csv.DictReader((config.output_dir / "model_curve.csv").read_text().splitlines()))
    assert [row["epoch"] for row in curve] == ["1", "2", "3"]
    assert float(curve[-1]["made_ade"]) < 1


def test_stop_before_the_first_epoch_leaves_a_usable_checkpoint(config, data, quiet, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "_loss", stop)
    generator, content = checkpoint.load_generator(train.train(config, data, quiet))
    assert content.training["epochs_done"] == 0
    assert generator.config == config.model


def test_other_settings_do_not_resume(config, data, quiet):
    train.train(replace(config, epochs=1), data, quiet)
    with pytest.raises(CheckpointError, match=r"other settings \(epochs, learning_rate\)"):
        train.train(replace(config, learning_rate=1e-4), data, quiet)


def test_fine_tuning_starts_from_the_given_weights(config, data, quiet):
    first = train.train(config, data, quiet)
    tuned = replace(config, output_dir=config.output_dir / "tuned", start_from=first, epochs=1, learning_rate=0.0)
    for name, tensor in weights(train.train(tuned, data, quiet)).items():
        torch.testing.assert_close(tensor, weights(first)[name])
    other_model = replace(tuned, model=replace(config.model, hidden=16), output_dir=config.output_dir / "other")
    with pytest.raises(CheckpointError, match="hidden=16"):
        train.train(other_model, data, quiet)


def test_trackers_windows_alone_are_enough(tmp_path, config, data):
    w = data.training
    first = np.flatnonzero(np.diff(w.scene, prepend=-1))
    clips = ["dut/roundabout_01" if i % 4 else "dut/roundabout_02" for i in range(len(first))]
    file = tmp_path / "tracked.npz"
    save_windows(file, observed=w.observed, velocity=w.velocity, future=w.future, scene=w.scene,
                 vehicle=w.vehicle[first], clips=clips, dt_s=0.1)  # fmt: skip
    loaded = train.load_data(replace(config, clips=False, windows=(file,)))
    assert len(loaded.training) + len(loaded.validation["tracked"]) == len(w)
    with pytest.raises(ValueError, match="neither clips nor window files"):
        train.load_data(replace(config, clips=False))


def test_missing_clips_are_said_to_be_missing(tmp_path, config):
    with pytest.raises(DataNotFound):
        train.load_data(replace(config, data_dir=tmp_path))


def test_public_data_give_the_documented_sets(config, public_data):
    data = train.load_data(replace(config, filtered_copies=1, data_dir=public_data))
    assert set(data.validation) == {"clean", "filtered"}
    assert len(data.training) > 40_000
    straight = train.baselines(data, 0.1)["clean"]
    assert straight["present velocity"].ade < straight["last displacement"].ade < 0.15


def test_one_cycle_rises_and_falls():
    factors = [train.one_cycle(f) for f in (0.0, 0.15, 0.3, 0.65, 1.0)]
    assert factors == pytest.approx([0.04, 0.52, 1.0, 0.5005, 0.001])
