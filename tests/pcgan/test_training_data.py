"""What a run learns from: never a scene that is left out or held out, each drawn as the recipe says."""

from dataclasses import replace

import numpy as np
import pytest

from pcgan.clips import DataNotFound, load_clip
from pcgan.dataset import HELD_OUT_CLIPS, VALIDATION_CLIPS, WindowSpec, clip_windows, concatenate
from pcgan.protocols import ETH_UCY_SCENES, NEVER_TESTED, eth_ucy_fold, vci_split
from pcgan.recipes import Task, recipe_for
from pcgan.training_data import FILTERED_COPIES, default_task, training_data
from pcgan.trajectory_file import save_trajectories
from pcgan.windows_file import WindowsError, save_windows

TRAINING_CLIPS = ("dut/intersection_01", "dut/intersection_02")  # of the made data
FILES = [*(file for files in ETH_UCY_SCENES.values() for file in files), *NEVER_TESTED]


def recipe_of(data="eth_ucy", task=None, **changes):
    return replace(recipe_for("psgan", "best", task or default_task(data)), **changes)


@pytest.fixture
def window_file(tmp_path):
    """Writes a tracker's windows: 3 scenes of one person each, walking at 1, 2 and 3 m/s."""

    def write(clips=("dut/intersection_01", VALIDATION_CLIPS[0], "dut/intersection_02"), dt_s=0.1, name="tracked"):
        walks = np.zeros((3, 20, 2))
        walks[..., 0] = np.array([[1.0], [2], [3]]) * dt_s * np.arange(20)
        path = tmp_path / f"{name}.npz"
        save_windows(
            path,
            observed=walks[:, :8],
            seen=np.ones((3, 8), bool),
            velocity=np.array([[1.0, 0], [2, 0], [3, 0]]),
            future=walks[:, 8:],
            scene=np.arange(3),
            vehicle=np.full((3, 8, 4), np.nan),
            clips=list(clips),
            dt_s=dt_s,
        )
        return path

    return write


# --- ETH/UCY ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", ETH_UCY_SCENES)
def test_left_out_scene_is_nowhere(made_data, scene):
    found = training_data("eth_ucy", recipe_of(), leave_out=scene, data_dir=made_data.folder)
    others = made_data.within(*FILES) - made_data.within(*ETH_UCY_SCENES[scene])
    assert made_data.of(found.training) == others
    assert list(found.validation) == ["scenes"]
    assert made_data.of(found.validation["scenes"]) == others


def test_several_scenes_or_none_are_left_out(made_data):
    found = training_data("eth_ucy", recipe_of(), leave_out="eth,zara2", data_dir=made_data.folder)
    out = made_data.within("biwi_eth_6frame", "crowds_zara02")
    assert made_data.of(found.training) == made_data.within(*FILES) - out
    everything = training_data("eth_ucy", recipe_of(), data_dir=made_data.folder)
    assert made_data.of(everything.training) == made_data.within(*FILES)


def test_training_never_reaches_over_the_cut(made_data):
    """Not backwards, either: the step along y tells the time, of which 30 is the cut."""
    found = training_data("eth_ucy", recipe_of(reversed_share=0.5), leave_out="eth", data_dir=made_data.folder)
    assert max(abs(time) for _, time in made_data.steps_of(found.training)) == 29
    assert min(time for _, time in made_data.steps_of(found.validation["scenes"])) == 31


@pytest.mark.parametrize(("reversed_share", "share"), [(0.0, 1.0), (0.3, 1.0), (0.25, 0.5)])
def test_scenes_are_drawn_as_the_recipe_says(made_data, reversed_share, share):
    """A crowded file's with a share of their own; those that run backwards make up theirs."""
    recipe = recipe_of(reversed_share=reversed_share, crowd_share=0.2, share=share)
    found = training_data("eth_ucy", recipe, leave_out="hotel", data_dir=made_data.folder)
    first = np.flatnonzero(np.diff(found.training.scene, prepend=-1))  # each scene's first person
    assert len(found.share) == len(first)
    crowded = np.isin(made_data.each(found.training), [*made_data.within("students001", "students003")])[first]
    backwards = found.training.velocity[first, 0] < 0
    assert 0 < crowded.sum() < len(first)
    assert backwards.any() == (reversed_share > 0)
    expected = share * np.where(crowded, 0.2, 1.0) * np.where(backwards, reversed_share, 1 - reversed_share)
    np.testing.assert_allclose(found.share, expected)
    if reversed_share > 0:  # drawn scenes are backwards in this share: as many are there of both
        assert found.share[backwards].sum() / found.share.sum() == pytest.approx(reversed_share, abs=0.1)


def test_complete_only_leaves_out_who_is_not_there_throughout(made_data):
    whole = training_data("eth_ucy", recipe_of(complete_only=True), leave_out="eth", data_dir=made_data.folder)
    assert whole.training.complete.all()
    assert whole.training.known.all()
    parts = training_data("eth_ucy", recipe_of(complete_only=False), leave_out="eth", data_dir=made_data.folder)
    assert not parts.training.complete.all()
    assert not parts.training.known.all()
    wanted = parts.training.complete & parts.training.known.all(axis=1)
    assert wanted.sum() == len(whole.training)
    assert len(whole.share) == whole.training.scene[-1] + 1
    assert len(whole.validation["scenes"]) == len(parts.validation["scenes"])  # validation is everybody's


def test_validation_runs_forwards(made_data):
    found = training_data("eth_ucy", recipe_of(reversed_share=0.5), leave_out="eth", data_dir=made_data.folder)
    ahead = np.diff(found.validation["scenes"].observed[..., 0], axis=1)
    assert (ahead >= 0).all()
    assert np.diff(found.training.observed[..., 0], axis=1).min() < 0


# --- VCI -------------------------------------------------------------------------------------------------------------


def test_test_clips_of_vci_are_in_neither_set(made_data):
    found = training_data("vci", recipe_of("vci"), data_dir=made_data.folder)
    split = vci_split(data_dir=made_data.folder)
    assert made_data.of(found.training) == made_data.within(*split.training)
    assert made_data.of(found.validation["vci"]) == made_data.within(*split.validation)
    assert not made_data.of(split.test) & (made_data.of(found.training) | made_data.of(found.validation["vci"]))
    assert (found.share == 1).all()


# --- drives ----------------------------------------------------------------------------------------------------------


def test_drives_learn_from_training_clips_alone(made_data):
    found = training_data("drives", recipe_of("drives"), data_dir=made_data.folder)
    assert made_data.of(found.training) == made_data.within(*TRAINING_CLIPS)
    assert set(found.validation) == {"clean", "filtered"}
    for windows in found.validation.values():
        assert made_data.of(windows) == made_data.within(*VALIDATION_CLIPS)
    assert found.validation["clean"].annotated.all()
    assert not found.validation["filtered"].annotated.any()
    scenes = found.training.scene[-1] + 1
    clean = len(np.unique(found.training.scene[found.training.annotated]))
    assert 0 < (scenes - clean) <= FILTERED_COPIES * clean  # a filter takes a while to settle


def test_noise_follows_the_seed_in_training_alone(made_data):
    recipe = recipe_of("drives")
    one, two, other = (training_data("drives", recipe, data_dir=made_data.folder, seed=n) for n in (1, 1, 2))
    np.testing.assert_array_equal(one.training.observed, two.training.observed)
    assert not np.array_equal(one.training.observed, other.training.observed)
    np.testing.assert_array_equal(one.validation["filtered"].observed, other.validation["filtered"].observed)


def test_a_trackers_windows_join(made_data, window_file):
    recipe, path = recipe_of("drives"), window_file()
    without = training_data("drives", recipe, data_dir=made_data.folder)
    found = training_data("drives", recipe, window_files=(path,), data_dir=made_data.folder)
    assert len(found.training) == len(without.training) + 2
    assert found.training.velocity[-2:, 0].tolist() == [1, 3]
    assert set(found.validation) == {"clean", "filtered", "tracked"}
    assert found.validation["tracked"].velocity.tolist() == [[2, 0]]
    assert len(found.share) == found.training.scene[-1] + 1


def test_trajectories_of_ones_own_join(made_data, make_clip, tmp_path):
    path = tmp_path / "mine.csv"
    save_trajectories(make_clip(pedestrians=3, frames=100, rate_hz=20.0), path)
    recipe = recipe_of("drives")
    without = training_data("drives", recipe, data_dir=made_data.folder)
    found = training_data("drives", recipe, trajectory_files=(path,), data_dir=made_data.folder)
    added = found.training.select(np.arange(len(found.training)) >= len(without.training))
    assert len(added) > 0
    assert not added.annotated.any()  # what a tracker saw has noise of its own
    np.testing.assert_array_less(np.linalg.norm(added.velocity, axis=1), 1.7)
    assert set(found.validation) == set(without.validation)
    with pytest.raises(DataNotFound, match=r"nobody\.csv"):
        training_data("drives", recipe, trajectory_files=(tmp_path / "nobody.csv",), data_dir=made_data.folder)


def test_a_file_without_validation_clips_validates_nothing(made_data, window_file):
    path = window_file(TRAINING_CLIPS[:1] * 3)
    found = training_data("drives", recipe_of("drives"), window_files=(path,), data_dir=made_data.folder)
    assert set(found.validation) == {"clean", "filtered"}
    assert found.training.velocity[-3:, 0].tolist() == [1, 2, 3]


def test_drives_at_the_rate_of_eth_ucy_learn_from_it_too(made_data):
    recipe = recipe_of(task=Task(dt_s=0.4, predicted_steps=1, observed_steps=4))
    found = training_data("drives", recipe, data_dir=made_data.folder)
    assert set(found.validation) == {"clean", "filtered", "scenes"}
    people = made_data.each(found.training.select(found.training.annotated))
    assert set(people.tolist()) == made_data.within(*FILES, *TRAINING_CLIPS)


@pytest.mark.parametrize("held_out", [*HELD_OUT_CLIPS, "citr/p2p_uni/walk_01"])
def test_held_out_clips_are_refused(made_data, window_file, tmp_path, held_out):
    """Whatever wrote the file."""
    with np.load(window_file()) as file:
        arrays = dict(file)
    np.savez(tmp_path / "sneaky.npz", **(arrays | {"clip": np.array([held_out, *arrays["clip"][1:]])}))
    with pytest.raises(ValueError, match=f"held-out clips may not be trained or validated on: {held_out}"):
        training_data("drives", recipe_of("drives"), window_files=(tmp_path / "sneaky.npz",), data_dir=made_data.folder)


def test_windows_of_another_rate_are_refused(made_data, window_file):
    with pytest.raises(WindowsError, match=r"tracked\.npz has .* 0\.4\); the model needs \(8, 12, 0\.1\)"):
        training_data("drives", recipe_of("drives"), window_files=(window_file(dt_s=0.4),), data_dir=made_data.folder)


# --- names -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "options", "problem"),
    [
        ("nuscenes", {}, r"no data 'nuscenes' to train on; there are \('eth_ucy', 'vci', "),
        (
            "eth_ucy",
            {"leave_out": "mall"},
            r"no scenes \['mall'\]; there are \['eth', 'hotel', 'univ', 'zara1', 'zara2'",
        ),
        ("eth_ucy", {"leave_out": "eth, hotel"}, r"no scenes \[' hotel'\]"),
        ("vci", {"leave_out": "eth"}, "only scenes of eth_ucy can be left out, not of vci"),
        (
            "vci",
            {"window_files": ("w.npz",)},
            "go with the data 'drives', not with 'vci'",
        ),
    ],
)
def test_what_does_not_exist_is_named(made_data, data, options, problem):
    with pytest.raises(ValueError, match=problem):
        training_data(data, recipe_of(), data_dir=made_data.folder, **options)


def test_absent_data_are_named(tmp_path):
    for data in ("eth_ucy", "vci", "drives"):
        with pytest.raises(DataNotFound, match="not on this machine"):
            training_data(data, recipe_of(data), data_dir=tmp_path)


def test_a_recipe_that_no_clip_is_long_enough_for_is_refused(made_data):
    recipe = recipe_of(task=Task(observed_steps=8, predicted_steps=40, dt_s=0.1), complete_only=True)
    with pytest.raises(ValueError, match="no training window has a known future"):
        training_data("drives", recipe, data_dir=made_data.folder)


def test_tasks_are_the_protocols():
    assert (default_task("eth_ucy").dt_s, default_task("eth_ucy").uses_vehicle) == (0.4, False)
    assert default_task("vci").dt_s == pytest.approx(1 / 12, rel=0.01)
    assert (default_task("drives").dt_s, default_task("drives").uses_vehicle) == (0.1, True)
    assert {(default_task(data).observed_steps, default_task(data).predicted_steps) for data in ("eth_ucy", "vci")} == {
        (8, 12)
    }
    with pytest.raises(ValueError, match="no data 'kitti'"):
        default_task("kitti")


# --- public data -----------------------------------------------------------------------------------------------------


def paths_of(windows):
    """Whole paths as displacements to the millimetre, of who moves."""
    whole = windows.select(windows.complete & windows.known.all(axis=1))
    steps = np.diff(np.concatenate([whole.observed, whole.future], axis=1), axis=1).reshape(len(whole), -1)
    return set(map(bytes, np.round(steps[np.abs(steps).max(axis=1) > 0.1] * 1000).astype(np.int16)))


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["zara1", "hotel"])
def test_public_paths_of_the_left_out_scene_are_nowhere(public_data, scene):
    """By their shape: a path of the test scene is neither trained on nor validates; training ones do not validate."""
    found = training_data("eth_ucy", recipe_of(reversed_share=0.0), leave_out=scene, data_dir=public_data)
    test, training = paths_of(eth_ucy_fold(scene, data_dir=public_data).test), paths_of(found.training)
    validation = paths_of(found.validation["scenes"])
    assert min(map(len, (test, training, validation))) > 500
    assert not test & training
    assert not test & validation
    assert not training & validation


@pytest.mark.slow
def test_public_drives_have_no_held_out_clip(public_data):
    found = training_data("drives", recipe_of("drives"), data_dir=public_data)
    spec = WindowSpec(8, 12, 0.1)
    held_out = paths_of(concatenate([clip_windows(load_clip(name, public_data), spec) for name in HELD_OUT_CLIPS]))
    clean = found.training.select(found.training.annotated)
    assert min(len(held_out), len(paths_of(clean))) > 1000
    assert not held_out & paths_of(clean)
    assert not held_out & paths_of(found.validation["clean"])
    assert not paths_of(clean) & paths_of(found.validation["clean"])
