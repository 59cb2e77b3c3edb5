"""The commands about models: what ships, training on a small data set, its windows, and the shell of the evaluation."""

import json
import signal
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pcgan import checkpoint
from pcgan.dataset import VALIDATION_CLIPS
from pcgan.model import ModelConfig
from pcgan.training_data import DATA
from replay import cli_models, training_windows

CLIPS = ("dut/intersection_01", *VALIDATION_CLIPS)


def one_line(err):
    """Asserts that an error is one line of our own, and returns it."""
    assert err.count("\n") == 1, err
    assert err.startswith("pcgan: ")
    return err.strip()


def save(path, config, training=None):
    """Writes a checkpoint of random weights."""
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(7)
        checkpoint.save(path, config, checkpoint.build(config).state_dict(), training or {"data": "none"})
    return path


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """A folder of weights in place of the one that ships: near ahead, far ahead (the default), and one of a table."""
    folder = tmp_path / "weights"
    far = save(folder / "far.safetensors", ModelConfig(dt_s=0.4))
    save(folder / "near.safetensors", ModelConfig(dt_s=0.1))
    lineage = {"method": "psgan", "recipe_name": "paper", "data": "eth_ucy", "leave_out": "hotel"}
    config = ModelConfig(recipe="paper", pooling="social", dt_s=0.4, uses_vehicle=False)
    save(folder / "tables" / "psgan_paper_eth_ucy_hotel.safetensors", config, lineage)
    monkeypatch.setattr(checkpoint, "WEIGHTS_FOLDER", folder)
    monkeypatch.setattr(checkpoint, "TABLE_WEIGHTS", folder / "tables")
    monkeypatch.setattr(checkpoint, "DEFAULT_CHECKPOINT", far)
    return folder


@pytest.fixture
def clips(tmp_path, monkeypatch):
    """A data folder with one DUT clip to train on and those to validate on: four people and a car, 3.5 s each."""
    frames = np.arange(84)
    for number, name in enumerate(CLIPS):
        path = tmp_path / "data" / "dut" / "trajectories_filtered" / name.removeprefix("dut/")
        path.parent.mkdir(parents=True, exist_ok=True)
        people = [
            f"{id},{frame},ped,{3 + id + 0.05 * frame:.3f},{id + 0.1 * number:.3f},1.2,0"
            for id in range(4)
            for frame in frames
        ]
        car = [f"0,{frame},veh,{-4 + 0.04 * frame:.3f},-3,0,0.96" for frame in frames]
        rows = (("ped", "id,frame,label,x_est,y_est,vx_est,vy_est", people),
                ("veh", "id,frame,label,x_est,y_est,psi_est,vel_est", car))  # fmt: skip
        for kind, header, lines in rows:
            path.with_name(f"{path.name}_traj_{kind}_filtered.csv").write_text("\n".join([header, *lines]) + "\n")
    monkeypatch.setenv("PCGAN_DATA", str(tmp_path / "data"))
    return tmp_path / "data"


# --- models ----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("shipped")
def test_models_are_listed_with_what_they_are_for(pcgan):
    outcome = pcgan("models")
    assert outcome.code == 0
    lines = [line.split() for line in outcome.out.splitlines()]
    assert ["far", "pcgan", "best", "0.4", "4.8", "yes"] in [line[:6] for line in lines]
    assert ["near", "pcgan", "best", "0.1", "1.2", "yes"] in [line[:6] for line in lines]
    assert outcome.out.count("the default") == 1
    assert "hotel" not in outcome.out
    tables = pcgan("models", "--tables").out
    assert "table of eth_ucy, tested on hotel" in tables
    assert "\x1b" not in tables


def test_models_as_json(pcgan, shipped):
    outcome = pcgan("models", "--tables", "--json")
    assert outcome.code == 0
    far, near, table = json.loads(outcome.out)
    assert (far["name"], far["default"], far["use"]) == ("far", True, "replay")
    assert (near["name"], near["default"], near["horizon_s"]) == ("near", False, 1.2)
    assert near["size_bytes"] == (shipped / "near.safetensors").stat().st_size
    assert near["sha256"] == checkpoint.sha256(shipped / "near.safetensors")
    assert (table["use"], table["method"], table["recipe"]) == ("tables", "psgan", "paper")
    assert (table["data"], table["leave_out"], table["uses_vehicle"]) == ("eth_ucy", "hotel", False)


def test_a_broken_model_is_one_line_that_names_it(pcgan, shipped):
    (shipped / "near.safetensors").write_bytes(b"no weights")
    outcome = pcgan("models")
    assert outcome.code == 2
    assert "near.safetensors is not a readable safetensors file" in one_line(outcome.err)


# --- the model of a replay -------------------------------------------------------------------------------------------


def replayed(pcgan, log, folder, *arguments):
    """Runs half a second of a replay; returns the name of the model that answered."""
    outcome = pcgan("replay", log, "-o", folder / "out.mcap", "--json", folder / "summary.json", "--duration", "0.5",
                    "--predictor", "inline", *arguments)  # fmt: skip
    assert outcome.code == 0, outcome.err
    return json.loads((folder / "summary.json").read_text())["model"]["name"]


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ((), "far"),
        (("--model", "near"), "near"),
        (("--horizon", "0.5"), "near"),
        (("--horizon", "1.2"), "near"),
        (("--horizon", "1.3"), "far"),
        (("--horizon", "4.8"), "far"),
    ],
    ids=str,
)
@pytest.mark.usefixtures("shipped")
def test_a_replay_takes_the_model_that_was_asked_for(pcgan, short_drive, tmp_path, arguments, name):
    assert replayed(pcgan, short_drive, tmp_path, *arguments) == name


def test_a_file_goes_before_a_name(pcgan, short_drive, shipped, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(tmp_path / "mine.safetensors", ModelConfig()).rename(tmp_path / "near")
    assert replayed(pcgan, short_drive, tmp_path, "--model", "near") == "mine"
    assert replayed(pcgan, short_drive, tmp_path, "--model", shipped / "far.safetensors") == "far"


@pytest.mark.usefixtures("shipped")
def test_models_that_there_are_not(pcgan, short_drive, tmp_path):
    for command in (("predict",), ("replay", short_drive, "-o", tmp_path / "out.mcap", "--predictor", "inline")):
        outcome = pcgan(*command, "--model", "nearer")
        assert outcome.code == 2
        assert one_line(outcome.err) == "pcgan: no checkpoint nearer; shipped models are ['far', 'near']"
        outcome = pcgan(*command, "--horizon", "5")
        assert outcome.code == 2
        wanted = "pcgan: no shipped model looks 5 s ahead; there are far (4.8 s), near (1.2 s)"
        assert one_line(outcome.err) == wanted
        outcome = pcgan(*command, "--horizon", "1", "--model", "near")
        assert outcome.code == 2
        assert "--model and --horizon exclude each other" in one_line(outcome.err)
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("option", ["--model", "--horizon"])
def test_an_external_predictor_has_its_own_weights(pcgan, short_drive, option):
    outcome = pcgan("replay", short_drive, "--predictor", "external", option, "1")
    assert outcome.code == 2
    assert one_line(outcome.err) == f"pcgan: {option}: an external predictor has its own weights"


def test_a_name_reaches_a_spawned_predictor(pcgan, short_drive, tmp_path):
    """What ships does not matter: the name is one that the new process does not know."""
    outcome = pcgan("replay", short_drive, "-o", tmp_path / "out.mcap", "--model", "nobody")
    assert outcome.code == 2
    assert "no checkpoint nobody; shipped models are" in one_line(outcome.err)


# --- train -----------------------------------------------------------------------------------------------------------


def test_the_choices_are_those_of_the_library():
    from pcgan.recipes import RECIPES

    assert tuple(cli_models.TrainingData) == DATA
    assert tuple(cli_models.EvaluationData) == (*DATA, "all")
    assert tuple(cli_models.RecipeName) == RECIPES


@pytest.mark.usefixtures("clips")
def test_training_writes_a_checkpoint_that_says_where_it_comes_from(pcgan, tmp_path):
    arguments = ("train", "--method", "pcgan", "--data", "drives", "--epochs", 1, "-o", tmp_path / "new" / "runs")
    outcome = pcgan(*arguments)
    path = tmp_path / "new" / "runs" / "pcgan_drives.safetensors"
    assert (outcome.code, outcome.out, outcome.err) == (0, f"{path}\n", "")
    found = checkpoint.describe(path)
    assert isinstance(found.config, ModelConfig)
    assert (found.config.dt_s, found.config.uses_vehicle, found.config.recipe) == (0.1, True, "best")
    lineage = {name: found.training[name] for name in ("method", "recipe_name", "data", "leave_out", "windows")}
    wanted = {"method": "pcgan", "recipe_name": "best", "data": "drives", "leave_out": None, "windows": []}
    assert lineage == wanted
    assert found.training["recipe"]["epochs"] == found.training["epochs_done"] == 1
    before = path.read_bytes()
    assert pcgan(*arguments).out == f"{path}\n"  # complete: left alone
    assert path.read_bytes() == before
    outcome = pcgan(*arguments, "--seed", 1)
    assert outcome.code == 2
    assert "of a run with other settings (seed)" in one_line(outcome.err)


@pytest.mark.usefixtures("clips")
def test_training_from_a_checkpoint_with_a_name_of_its_own(pcgan, tmp_path):
    start = save(tmp_path / "start.safetensors", ModelConfig(recipe="paper", dt_s=0.1))
    arguments = ("train", "--method", "pcgan", "--data", "drives", "--epochs", 1, "-o", tmp_path / "runs")
    outcome = pcgan(*arguments, "--start-from", start, "--recipe", "paper", "--name", "tuned")
    assert (outcome.code, outcome.out) == (0, f"{tmp_path / 'runs' / 'tuned.safetensors'}\n")
    assert checkpoint.describe(tmp_path / "runs" / "tuned.safetensors").training["start_from"]
    outcome = pcgan(*arguments, "--start-from", start)
    assert outcome.code == 2
    assert "start.safetensors has " in one_line(outcome.err)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (("pcgan", "best", "eth_ucy", "hotel", None), "pcgan_eth_ucy_hotel"),
        (("psgan", "paper", "eth_ucy", "univ,zara1", None), "psgan_paper_eth_ucy_univ_zara1"),
        (("sgan", "best", "vci", None, None), "sgan_vci"),
        (("pcgan", "best", "drives", None, "2.5hz"), "pcgan_drives_2.5hz"),
    ],
)
def test_names_of_runs(arguments, name):
    method, recipe, data, leave_out, rate = arguments
    found = cli_models._run_name(method, cli_models.RecipeName(recipe), cli_models.TrainingData(data), leave_out, rate)
    assert found == name


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--method", "cvm", "--data", "vci"), "cvm is an extrapolation: there is nothing to train"),
        (("--method", "gan", "--data", "vci"), "no method 'gan' that learns"),
        (("--method", "pcgan", "--data", "vci", "--dt", "0.1"), "--dt goes with --data drives"),
        (("--method", "pcgan", "--data", "drives", "--dt", "0.2"), "--dt is one of 0.1, 0.4, got 0.2"),
        (("--method", "pcgan", "--data", "vci", "--leave-out", "eth"), "only scenes of eth_ucy can be left out"),
        (("--method", "pcgan", "--data", "eth_ucy", "--windows", "w.npz"), "go with the data 'drives'"),
        (("--method", "pcgan", "--data", "eth_ucy", "--leave-out", "oval"), "no scenes ['oval']"),
        (("--method", "pcgan", "--data", "eth_ucy"), "data set 'eth_ucy' is not on this machine"),
        (("--method", "pcgan", "--data", "drives", "--windows", "gone.npz"), "gone.npz is not a readable .npz"),
        (("--method", "pcgan", "--data", "drives", "--start-from", "gone"), "no checkpoint gone"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
@pytest.mark.usefixtures("clips")
def test_training_that_cannot_be_is_one_line(pcgan, tmp_path, arguments, words):
    outcome = pcgan("train", *arguments, "-o", tmp_path / "runs")
    assert outcome.code == 2
    assert words in one_line(outcome.err)


@pytest.mark.usefixtures("clips")
def test_a_run_into_a_place_that_cannot_be_written(pcgan, tmp_path):
    (tmp_path / "file").write_text("")
    outcome = pcgan("train", "--method", "pcgan", "--data", "drives", "-o", tmp_path / "file" / "runs")
    assert outcome.code == 2
    assert "runs cannot be written: " in one_line(outcome.err)


@pytest.mark.usefixtures("clips")
def test_ctrl_c_ends_a_training_with_a_line(start_pcgan, tmp_path):
    process = start_pcgan(
        "train", "--method", "pcgan", "--data", "drives", "--epochs", 300, "-o", tmp_path / "runs", "--name", "run"
    )
    deadline = time.monotonic() + 120
    while not (tmp_path / "runs" / "run.safetensors").exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, ""), err
    assert err.startswith("stopped in epoch ")
    assert err.endswith(f"{tmp_path / 'runs' / 'run.safetensors'} holds what was reached\n")


# --- windows ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("clips")
def test_windows_are_made_and_trained_on(pcgan, tmp_path):
    outcome = pcgan("windows", "-o", tmp_path / "new" / "windows", "--seeds", 1)
    assert (outcome.code, outcome.err) == (0, "")
    lines = [line.split(": ") for line in outcome.out.splitlines()]
    assert sorted(path for path, _ in lines) == sorted(map(str, (tmp_path / "new" / "windows").glob("*.npz")))
    [found] = [(path, count) for path, count in lines if "tracked_10hz" in path]
    assert int(found[1].removesuffix(" windows")) > 0
    arguments = ("train", "--method", "pcgan", "--data", "drives", "--epochs", 1, "-o", tmp_path / "runs")
    assert pcgan(*arguments, "--windows", found[0]).code == 0
    training = checkpoint.describe(tmp_path / "runs" / "pcgan_drives.safetensors").training
    assert training["windows"] == ["tracked_10hz.npz"]


def test_windows_without_data_or_place_are_one_line(pcgan, tmp_path, monkeypatch):
    monkeypatch.setenv("PCGAN_DATA", str(tmp_path / "nowhere"))
    outcome = pcgan("windows", "-o", tmp_path / "windows")
    assert outcome.code == 2
    assert "PCGAN_DATA is " in one_line(outcome.err)
    (tmp_path / "file").write_text("")
    outcome = pcgan("windows", "-o", tmp_path / "file" / "windows")
    assert outcome.code == 2
    assert "windows cannot be written: " in one_line(outcome.err)


# --- evaluate --------------------------------------------------------------------------------------------------------


@pytest.fixture
def evaluation(monkeypatch):
    """Stands in for pcgan.evaluation, which takes minutes: keeps what it was asked."""
    import pcgan

    calls = SimpleNamespace(asked=[], records=[])

    def evaluate(data, methods, runs, progress, *, drives):
        calls.asked.append((data, methods, runs, drives))
        progress("cvm on vci", 1, 2)
        if "nothing" in methods:
            raise ValueError("no method 'nothing'")
        return {"figures": 1}

    stand_in = SimpleNamespace(
        evaluate=evaluate,
        show=lambda results, console: console.print("a table", len(results)),
        write_json=lambda results, path: path.write_text(json.dumps(results)),
        write_markdown=lambda results, path: path.write_text(f"| {len(results)} |"),
        write_html=lambda results, path: path.write_text(f"<b>{len(results)}</b>"),
        append_record=lambda results, note: calls.records.append((results, note)),
    )
    monkeypatch.setitem(sys.modules, "pcgan.evaluation", stand_in)
    monkeypatch.setattr(pcgan, "evaluation", stand_in, raising=False)
    monkeypatch.setattr(training_windows, "held_out_windows", lambda progress: progress(0, 4) or "simulated drives")
    return calls


def test_an_evaluation_is_shown_written_and_recorded(pcgan, evaluation, tmp_path):
    files = [tmp_path / name for name in ("results.json", "results.md", "results.html")]
    outcome = pcgan("evaluate", "--data", "vci", "--methods", "cvm, pcgan", "--runs", tmp_path, "--note", "figures",
                    "--json", files[0], "--markdown", files[1], "--html", files[2])  # fmt: skip
    assert (outcome.code, outcome.err) == (0, "")
    assert evaluation.asked == [("vci", ("cvm", "pcgan"), tmp_path, None)]
    assert evaluation.records == [({"figures": 1}, "figures")]
    assert outcome.out == "".join(["a table 1\n", *(f"wrote {file}\n" for file in files)])
    assert [file.read_text() for file in files] == ['{"figures": 1}', "| 1 |", "<b>1</b>"]


def test_an_evaluation_is_of_everything_unless_told(pcgan, evaluation):
    assert pcgan("evaluate").code == 0
    assert evaluation.asked == [("all", (), None, "simulated drives")]
    assert evaluation.records == [({"figures": 1}, "")]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--methods", "nothing"), "no method 'nothing'"),
        (("--methods", ","), "--methods wants names with commas between"),
        (("--runs", "no-such-folder"), "no-such-folder is none"),
        (("--json", "no/such/file.json"), "file.json cannot be written"),
        (("--html", "."), "cannot be written"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_evaluation_that_cannot_be_is_one_line(pcgan, evaluation, arguments, words):
    outcome = pcgan("evaluate", *arguments)
    assert outcome.code == 2
    assert words in one_line(outcome.err)
    assert evaluation.records == []
