"""The whole evaluation on made data: every method and scene is there, seeds are combined, looks are recorded."""

import csv
import json

import numpy as np
import pytest
import torch

from pcgan import checkpoint, evaluation
from pcgan.checkpoint import CheckpointError
from pcgan.dataset import WindowSpec, clip_windows
from pcgan.protocols import ETH_UCY_SCENES
from pcgan.recipes import Task, recipe_for


def save_network(folder, name, method, recipe="best", seed=0, **task):
    """A network of random weights under the name of a run."""
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(seed)
        recipe = recipe_for(method, recipe, Task(**task))
        network = checkpoint.build(recipe.network)
    checkpoint.save(folder / f"{name}.safetensors", recipe.network, network.state_dict(), {})


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two seeds of PCGAN and one of its paper recipe and of SGAN for two scenes, and a state that is not a network."""
    folder = tmp_path_factory.mktemp("runs")
    for scene in ("eth", "hotel"):
        for seed in (0, 1):
            save_network(folder, f"pcgan_eth_ucy_{scene}_s{seed}", "pcgan", seed=seed)
        save_network(folder, f"pcgan_paper_eth_ucy_{scene}_s0", "pcgan", "paper", seed=2)
        save_network(folder, f"sgan_eth_ucy_{scene}", "sgan", seed=3)
    save_network(folder, "pcgan_eth_ucy_eth_s0_state", "pcgan", seed=4)
    return folder


@pytest.fixture(scope="module")
def found(made_data, runs):
    """An evaluation of ETH/UCY, all methods."""
    return evaluation.evaluate("eth_ucy", (), runs, data_dir=made_data.folder)


def test_every_scene_and_horizon_has_its_figures(found):
    assert set(found.results["cvm"]) == {*ETH_UCY_SCENES, "mean", "eth_10frame"}
    assert set(found.results["pcgan"]) == {"eth", "hotel", "eth_10frame"}  # no mean of two scenes
    assert set(found.results["pcgan"]["eth"]) == {"8", "12"}
    figures = found.results["pcgan"]["eth"]["12"]
    assert {"ade", "fde", "mhd", "nll", "min_ade_20", "coverage_90", "collision_rate"} <= figures.keys()
    assert all(np.isfinite(value) for value in figures.values())


def test_seeds_are_combined_and_names_are_not_mixed_up(found):
    assert "ade_std" in found.results["pcgan"]["eth"]["12"]
    assert "ade_std" not in found.results["pcgan_paper"]["eth"]["12"]
    first, second = (run["pcgan"]["eth"]["12"]["ade"] for run in found.runs)
    assert first != second
    assert found.results["pcgan"]["eth"]["12"]["ade"] == pytest.approx((first + second) / 2)
    assert not any(name.endswith("_state") for name in found.weights)
    assert found.used[0, "pcgan", "eth"] != found.used[0, "pcgan_paper", "eth"]


def test_made_walkers_are_straight_enough_for_extrapolation(found):
    """They speed up sideways by 1 mm a step and step: after 12 steps the last displacement is 78 mm behind."""
    assert found.results["cvm"]["hotel"]["12"]["fde"] == pytest.approx(0.078, abs=2e-3)


def test_curves_are_of_the_first_seed(found):
    assert set(found.curves["ETH/UCY"]) == {"lin", "cvm", "weighted", "sgan", "pcgan", "pcgan_paper"}


def test_outputs_are_written(found, tmp_path):
    evaluation.write_json(found, tmp_path / "r.json")
    loaded = json.loads((tmp_path / "r.json").read_text())
    assert loaded["pcgan"]["hotel"]["8"]["ade"] == pytest.approx(found.results["pcgan"]["hotel"]["8"]["ade"])
    evaluation.write_markdown(found, tmp_path / "r.md")
    assert "PCGAN is better than the best of all the paper's methods in" in (tmp_path / "r.md").read_text()
    evaluation.write_html(found, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert "<html" in page
    assert "pcgan_eth_ucy_eth_s1" in page


def test_every_look_at_a_network_is_recorded(found, tmp_path):
    record = tmp_path / "test_runs.csv"
    columns = evaluation.RECORD.read_text().splitlines()[0] if evaluation.RECORD.is_file() else "commit,model,drive"
    record.write_text(columns + "\n")
    count = evaluation.append_record(found, "a look, with a comma", record)
    rows = list(csv.DictReader(record.read_text().splitlines()))
    assert len(rows) == count
    wanted = {
        (method, f"{scene}@{horizon}", str(seed))
        for seed, run in enumerate(found.runs)
        for method, scenes in run.items()
        for scene, horizons in scenes.items()
        for horizon in horizons
    }
    assert {(row["model"], row["drive"], row["seed"]) for row in rows} == wanted
    assert {row["note"] for row in rows} == {"a look, with a comma"}
    assert next(row for row in rows if row["model"] == "pcgan")["weights"]
    assert evaluation.append_record(found, "", tmp_path / "nothing.csv") == 0


def test_simulated_drives_are_scored_on_windows_that_are_given(made_data, make_clip, tmp_path):
    save_network(tmp_path, "vehicle_10hz_s0", "pcgan", dt_s=0.1, uses_vehicle=True)
    windows = clip_windows(make_clip(frames=120), WindowSpec(8, 12, 0.1))
    drives = {"tracked_10hz": windows}
    found = evaluation.evaluate("drives", (), tmp_path, drives=drives, data_dir=made_data.folder)
    assert set(found.results) == {"lin", "cvm", "weighted", "state", "pcgan"}
    assert "usyd" in found.results["pcgan"]


def test_what_does_not_exist_is_refused(made_data, runs):
    with pytest.raises(ValueError, match="no data 'mars'"):
        evaluation.evaluate("mars", data_dir=made_data.folder)
    with pytest.raises(ValueError, match=r"no methods \['wgan'\]"):
        evaluation.evaluate("eth_ucy", ("wgan",), runs, data_dir=made_data.folder)
    with pytest.raises(CheckpointError, match=r"no networks of srlstm for eth_ucy in "):
        evaluation.evaluate("eth_ucy", ("srlstm",), runs, data_dir=made_data.folder)
