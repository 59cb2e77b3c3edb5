"""The protocols of the two tables: published counts, and no two sets that share anything."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from pcgan import protocols
from pcgan.clips import Clip, clip_names, load_clip
from pcgan.dataset import Windows, clip_windows, concatenate
from pcgan.protocols import (
    ETH_UCY_SCENES,
    ETH_UCY_SPEC,
    NEVER_TESTED,
    VCI_SHARES,
    VCI_SPEC,
    between,
    eth_ucy_fold,
    vci_split,
)

TRAINING_FILES = [*(file for files in ETH_UCY_SCENES.values() for file in files), *NEVER_TESTED]
COARSE_SPEC = replace(ETH_UCY_SPEC, stride_s=60.0)
cached_clip = functools.cache(load_clip)


def trajectories(windows: Windows, steps=12) -> int:
    """How many there are by the protocol's count: seen throughout, and known this far."""
    return int((windows.complete & windows.known[:, :steps].all(axis=1)).sum())


def person_steps(clip: Clip) -> set[tuple[str, int, int]]:
    return {(clip.name, person.id, int(frame)) for person in clip.pedestrians for frame in person.frames}


@pytest.fixture
def source_of(monkeypatch):
    """Tells the clip, or the part of one, that windows were cut from."""
    cut: list[tuple[Windows, Clip]] = []

    def recording(clip, spec):
        windows = clip_windows(clip, spec)
        cut.append((windows, clip))
        return windows

    monkeypatch.setattr(protocols, "clip_windows", recording)
    monkeypatch.setattr(protocols, "load_clip", cached_clip)

    def source(windows: Windows | None) -> list[Clip]:
        """Those of some windows; None: all that were cut."""
        return [clip for found, clip in cut if windows is None or found is windows]

    return source


# --- parts of a clip -------------------------------------------------------------------------------------------------


def test_parts_of_a_clip_are_half_open_and_make_it_up(make_clip):
    clip = make_clip(pedestrians=3, vehicles=2, frames=50)  # frames 1 to 50
    early, late = between(clip, 0, 20), between(clip, 20, np.inf)
    for whole, first, rest in zip(clip.pedestrians, early.pedestrians, late.pedestrians, strict=True):
        assert first.frames.tolist() == list(range(1, 20))
        assert rest.frames.tolist() == list(range(20, 51))
        for name in ("positions_m", "velocities_mps"):
            parts = np.concatenate([getattr(first, name), getattr(rest, name)])
            np.testing.assert_array_equal(parts, getattr(whole, name))
    for whole, first, rest in zip(clip.vehicles, early.vehicles, late.vehicles, strict=True):
        assert (len(first.frames), len(rest.frames)) == (19, 31)
        for name in ("frames", "positions_m", "yaw_rad", "speed_mps"):
            parts = np.concatenate([getattr(first, name), getattr(rest, name)])
            np.testing.assert_array_equal(parts, getattr(whole, name))
    assert (early.name, early.rate_hz) == (clip.name, clip.rate_hz)


def test_who_is_not_in_a_part_is_not_there(make_clip):
    clip = make_clip(pedestrians=2, vehicles=1, frames=50)
    one = between(clip, 10, 20).pedestrians[0]
    mixed = replace(clip, pedestrians=(one, clip.pedestrians[1]))
    assert [person.id for person in between(mixed, 20, 30).pedestrians] == [1]
    nobody = between(mixed, 51, np.inf)
    assert (nobody.pedestrians, nobody.vehicles) == ((), ())


# --- ETH/UCY, made ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", ETH_UCY_SCENES)
def test_no_step_of_anybody_is_in_two_sets(made_data, scene):
    split = eth_ucy_fold(scene, data_dir=made_data.folder)
    out = ETH_UCY_SCENES[scene]
    files = {file for file in TRAINING_FILES if file not in out}
    assert set(split.training) == set(split.validation) == files
    for file in files:
        first, rest = made_data.steps_of(split.training[file]), made_data.steps_of(split.validation[file])
        assert {person for person, _ in first} == {person for person, _ in rest} == made_data.people[file]
        assert max(time for _, time in first) < 30  # the cut is before the 30th step: nothing reaches over it
        assert min(time for _, time in rest) > 30
    assert {person for person, _ in made_data.steps_of(split.test)} == made_data.within(*out)
    assert {time for _, time in made_data.steps_of(split.test)} == set(range(1, 67))


def test_several_scenes_can_be_left_out_or_none(made_data):
    split = eth_ucy_fold(("hotel", "univ"), data_dir=made_data.folder)
    assert made_data.of(split.test) == made_data.within("biwi_hotel", "students001", "students003")
    assert set(split.training) == set(TRAINING_FILES) - {"biwi_hotel", "students001", "students003"}
    split = eth_ucy_fold((), data_dir=made_data.folder)
    assert set(split.training) == set(TRAINING_FILES)
    assert len(split.test) == 0
    assert split.test.future.shape == (0, 12, 2)


def test_ten_frame_file_is_tested_only(made_data):
    split = eth_ucy_fold("eth", data_dir=made_data.folder, ten_frame_eth=True)
    assert made_data.of(split.test) == made_data.people["biwi_eth"]
    split = eth_ucy_fold("hotel", data_dir=made_data.folder, ten_frame_eth=True)
    assert made_data.of(split.test) == made_data.people["biwi_hotel"]
    assert "biwi_eth" not in split.training
    assert "biwi_eth_6frame" in split.training


def test_unknown_scenes_are_named(made_data):
    with pytest.raises(ValueError, match=r"no scenes \['mall', 'zara3'\]; there are \['eth', 'hotel', 'univ'"):
        eth_ucy_fold(("zara3", "hotel", "mall"), data_dir=made_data.folder)


# --- ETH/UCY, public -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scene", "twenty_steps", "sixteen_steps"),
    [
        ("eth", 2614, 3781),
        ("hotel", 1197, 1881),
        ("univ", 24334, 27349),
        ("zara1", 2356, 2938),
        ("zara2", 5910, 6684),
    ],
)
def test_public_scenes_have_as_many_trajectories(public_data, scene, twenty_steps, sixteen_steps):
    """Counted by data/eth_ucy/README.md; `hotel` and `zara1` agree with published reports of others."""
    parts = [clip_windows(cached_clip(f"eth_ucy/{file}", public_data), ETH_UCY_SPEC) for file in ETH_UCY_SCENES[scene]]
    windows = concatenate(parts)
    assert trajectories(windows) == twenty_steps
    assert trajectories(windows, 8) == sixteen_steps


def test_sixteen_steps_of_their_own_count_the_same(public_data):
    spec = replace(ETH_UCY_SPEC, predicted_steps=8)
    assert trajectories(clip_windows(cached_clip("eth_ucy/crowds_zara01", public_data), spec), 8) == 2938


def test_ten_frame_eth_has_as_many_trajectories_as_most_papers_test(public_data):
    windows = clip_windows(cached_clip("eth_ucy/biwi_eth", public_data), ETH_UCY_SPEC)
    assert (trajectories(windows), trajectories(windows, 8)) == (364, 797)


@pytest.mark.parametrize("scene", ETH_UCY_SCENES)
def test_public_fold_shares_nothing(public_data, source_of, scene):
    """Sets of (file, person, frame): training, validation and test are disjoint and hold all of the files."""
    split = eth_ucy_fold(scene, COARSE_SPEC, public_data)
    training, validation = ([clip for part in side.values() for clip in source_of(part)]
                            for side in (split.training, split.validation))  # fmt: skip
    tested = [clip for clip in source_of(None) if clip.pedestrians and clip not in training + validation]
    assert [clip.name for clip in tested] == [f"eth_ucy/{file}" for file in ETH_UCY_SCENES[scene]]
    sets = [set().union(*map(person_steps, side)) for side in (training, validation, tested)]
    whole = set().union(*(person_steps(cached_clip(f"eth_ucy/{file}", public_data)) for file in TRAINING_FILES))
    assert sum(map(len, sets)) == len(whole)
    assert set().union(*sets) == whole
    assert 0.6 < len(sets[0]) / len(sets[0] | sets[1]) < 0.85  # most of it is trained on


# --- VCI -------------------------------------------------------------------------------------------------------------


def test_made_clips_are_each_in_one_set(made_data):
    split = vci_split(data_dir=made_data.folder)
    training, validation, test = (
        made_data.of(concatenate(list(split.training.values()))),
        made_data.of(concatenate(list(split.validation.values()))),
        made_data.of(split.test),
    )
    assert training == made_data.within(*split.training)
    assert validation == made_data.within(*split.validation)
    names = clip_names("dut", made_data.folder)
    assert not set(split.training) & set(split.validation)
    assert test == made_data.within(*(set(names) - set(split.training) - set(split.validation)))
    assert len(training) > len(validation) > 0


def test_largest_clips_go_where_most_is_lacking(made_data):
    """The same sets, filled by a plain loop."""
    split = vci_split(data_dir=made_data.folder)
    spec = replace(VCI_SPEC, most_vehicles=1)
    counts = {}
    for name in clip_names("dut", made_data.folder):
        counts[name] = trajectories(clip_windows(load_clip(name, made_data.folder), spec))
    filled, sets = [0, 0, 0], [set(), set(), set()]
    for name, count in sorted(counts.items(), key=lambda item: (-item[1], item[0])):
        lacking = [share * sum(counts.values()) - part for share, part in zip(VCI_SHARES, filled, strict=True)]
        chosen = lacking.index(max(lacking))
        filled[chosen] += count
        sets[chosen].add(name)
    assert [set(split.training), set(split.validation)] == sets[:2]
    assert trajectories(split.test) == filled[2]


def test_windows_of_two_vehicles_are_left_out_or_whole_clips(made_data):
    """intersection_02 has its vehicles in frames 1 to 60 and 41 to 100: a window, 39 frames long, is of frames 1 to 39,
    or of 61 to 99. In intersection_01 one comes after the other: clips of one vehicle leave it out, too.
    """
    split = vci_split(data_dir=made_data.folder)
    windows = concatenate([*split.training.values(), *split.validation.values(), split.test])
    here = windows.select(np.isin(made_data.each(windows), [*made_data.people["dut/intersection_02"]]))
    assert here.scene[-1] + 1 == 2
    strict = vci_split(data_dir=made_data.folder, one_vehicle_clips=True)
    found = made_data.of(concatenate([*strict.training.values(), *strict.validation.values(), strict.test]))
    one_vehicle = set(clip_names("dut", made_data.folder)) - {"dut/intersection_01", "dut/intersection_02"}
    assert found == made_data.within(*one_vehicle)


@pytest.fixture(scope="module")
def public_vci(public_data):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocols, "load_clip", cached_clip)
        return vci_split(data_dir=public_data)


def test_public_clips_are_each_in_one_set(public_data, public_vci, source_of):
    """Whole clips: what is in neither of the two named sets makes up the test set."""
    split = vci_split(replace(VCI_SPEC, stride_s=2.0), public_data)
    named = [name for side in (split.training, split.validation) for name in side]
    assert len(named) == len(set(named))
    rest = [clip for clip in source_of(None) if clip.name not in named]
    cut = concatenate([clip_windows(clip, replace(VCI_SPEC, stride_s=2.0, most_vehicles=1)) for clip in rest])
    assert len(cut) == len(split.test) > 0
    assert not set(public_vci.training) & set(public_vci.validation)
    assert set(public_vci.training) | set(public_vci.validation) < set(clip_names("dut", public_data))


def test_public_shares_are_near_those_of_the_paper(public_vci):
    counts = np.array([
        sum(map(trajectories, public_vci.training.values())),
        sum(map(trajectories, public_vci.validation.values())),
        trajectories(public_vci.test),
    ])  # fmt: skip
    np.testing.assert_allclose(counts / counts.sum(), VCI_SHARES, atol=0.02)
    assert counts.sum() > 30_000


@pytest.mark.parametrize("name", ["dut/intersection_09", "dut/intersection_15", "dut/roundabout_07"])
def test_public_windows_see_one_vehicle_at_most(public_data, name):
    """As many scenes as a plain loop finds, moment by moment; none at all in intersection_09."""
    clip = cached_clip(name, public_data)
    tracks = [set(p.frames.tolist()) for p in clip.pedestrians]
    vehicles = [set(v.frames.tolist()) for v in clip.vehicles]
    start, end = min(map(min, tracks + vehicles)), max(map(max, tracks + vehicles))
    found = alone = 0
    for begin in range(start, end + 1, 2):
        frames = range(begin, begin + 40, 2)
        somebody = any(
            frames[7] in track and track & set(frames[:7]) and track.issuperset(frames[8:]) for track in tracks
        )
        found += somebody
        alone += somebody and sum(bool(vehicle & set(frames)) for vehicle in vehicles) <= 1
    assert len(np.unique(clip_windows(clip, VCI_SPEC).scene)) == found
    assert len(np.unique(clip_windows(clip, replace(VCI_SPEC, most_vehicles=1)).scene)) == alone < found


@pytest.mark.usefixtures("source_of")
def test_public_clips_of_one_vehicle_are_another_reading(public_data):
    split = vci_split(replace(VCI_SPEC, stride_s=2.0), public_data, one_vehicle_clips=True)
    parts = split.training | split.validation
    assert all(len(cached_clip(name, public_data).vehicles) == 1 for name in parts)
    assert len(split.test) > 0
