"""Clips are read as published, but with y up."""

import gzip

import numpy as np
import pytest

from pcgan import clips

PEDESTRIANS = """id,frame,label,x_est,y_est,vx_est,vy_est
7,11,ped,1.5,2.5,0.5,-1.0
7,10,ped,1.0,2.0,0.5,-1.0
3,10,ped,0.0,-1.0,0.0,1.0
"""
VEHICLES = """id,frame,label,x_est,y_est,psi_est,vel_est
0,4,veh,10.0,5.0,0.25,3.0
"""


@pytest.fixture
def data_dir(tmp_path):
    folder = tmp_path / "dut" / "trajectories_filtered"
    folder.mkdir(parents=True)
    (folder / "crossing_01_traj_ped_filtered.csv").write_text(PEDESTRIANS)
    with gzip.open(folder / "crossing_01_traj_veh_filtered.csv.gz", "wt") as stream:
        stream.write(VEHICLES)
    (folder / "lonely_02_traj_veh_filtered.csv").write_text(VEHICLES)
    scenario = tmp_path / "citr" / "p2p_uni"
    scenario.mkdir(parents=True)
    with gzip.open(scenario / "walk_01_traj_ped_filtered.csv.gz", "wt") as stream:
        stream.write(PEDESTRIANS)
    return tmp_path


def test_y_axis_points_up(data_dir):
    clip = clips.load_clip("dut/crossing_01", data_dir)
    assert [p.id for p in clip.pedestrians] == [3, 7]
    walker = clip.pedestrians[1]
    assert walker.frames.tolist() == [10, 11]
    assert walker.positions_m.tolist() == [[1.0, -2.0], [1.5, -2.5]]
    assert walker.velocities_mps.tolist() == [[0.5, 1.0], [0.5, 1.0]]
    (vehicle,) = clip.vehicles
    assert vehicle.positions_m.tolist() == [[10.0, -5.0]]
    assert vehicle.yaw_rad.tolist() == [-0.25]
    assert vehicle.speed_mps.tolist() == [3.0]


def test_gzipped_clip_without_vehicle_file(data_dir):
    clip = clips.load_clip("citr/p2p_uni/walk_01", data_dir)
    assert clip.vehicles == ()
    assert clip.rate_hz == pytest.approx(29.97, abs=1e-3)
    assert clips.clip_names("citr", data_dir) == ("citr/p2p_uni/walk_01",)


def test_names_hold_only_clips_with_pedestrians(data_dir):
    assert clips.clip_names("dut", data_dir) == ("dut/crossing_01",)
    with pytest.raises(clips.DataNotFound, match="lonely_02_traj_ped"):
        clips.load_clip("dut/lonely_02", data_dir)


def test_unknown_and_absent_data_sets_are_named(data_dir):
    with pytest.raises(ValueError, match="no data set 'nuscenes'"):
        clips.load_clip("nuscenes/1", data_dir)
    with pytest.raises(clips.DataNotFound, match="not on this machine"):
        clips.clip_names("dut", data_dir / "citr")


def test_data_folder_follows_the_environment(data_dir, monkeypatch):
    monkeypatch.setenv("PCGAN_DATA", str(data_dir))
    assert clips.data_folder() == data_dir
    monkeypatch.setenv("PCGAN_DATA", str(data_dir / "nowhere"))
    with pytest.raises(clips.DataNotFound, match=r"PCGAN_DATA is .*nowhere"):
        clips.data_folder()


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("id,frame,x\n1,2,3\n", "has columns"),
        (PEDESTRIANS + "7,14,ped,1,2,0,0\n", "track 7 are not contiguous"),
        (PEDESTRIANS + "8,1,ped,nan,2,0,0\n", "NaN"),
        (PEDESTRIANS + "8,1,ped,one,2,0,0\n", "not numbers"),
    ],
)
def test_damaged_file_is_refused_by_name(data_dir, content, problem):
    path = data_dir / "dut" / "trajectories_filtered" / "bad_01_traj_ped_filtered.csv"
    path.write_text(content)
    with pytest.raises(clips.ClipError, match=problem) as caught:
        clips.load_clip("dut/bad_01", data_dir)
    assert "bad_01_traj_ped_filtered.csv" in str(caught.value)


def test_cut_gzip_is_refused(data_dir):
    path = data_dir / "citr" / "p2p_uni" / "walk_01_traj_ped_filtered.csv.gz"
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(clips.ClipError, match="cannot be read"):
        clips.load_clip("citr/p2p_uni/walk_01", data_dir)


def test_public_data_have_the_published_counts(public_data):
    names = clips.clip_names("dut", public_data)
    assert len(names) == 27
    clip = clips.load_clip("dut/roundabout_04", public_data)
    assert len(clip.pedestrians) == 155
    assert len(clip.vehicles) == 2
    walker = clip.pedestrians[0]
    displacement = np.diff(walker.positions_m, axis=0) * clip.rate_hz
    assert np.abs(displacement - walker.velocities_mps[1:]).max() < 0.6  # the signs of y and vy agree
    vehicle = clip.vehicles[0]
    heading = np.arctan2(*np.diff(vehicle.positions_m, axis=0).sum(axis=0)[::-1])
    assert abs(np.angle(np.exp(1j * (heading - np.median(vehicle.yaw_rad))))) < 0.3
    assert len(clips.clip_names("citr", public_data)) == 38
    assert len(clips.load_clip("citr/vci_front/front_interaction_01", public_data).vehicles) == 1


# --- ETH and UCY -----------------------------------------------------------------------------------------------------


@pytest.fixture
def eth_ucy(tmp_path):
    """Writes a file of ETH/UCY and loads it."""
    (tmp_path / "eth_ucy").mkdir()

    def load(content, name="biwi_hotel"):
        (tmp_path / "eth_ucy" / f"{name}.txt").write_text(content)
        return clips.load_clip(f"eth_ucy/{name}", tmp_path)

    return load


WALKS = """780.0\t2.0\t1.0\t2.0
790.0\t2.0\t1.4\t2.0
790.0\t1.0\t9.0\t9.0
800.0\t2.0\t1.4\t2.8
800.0\t1.0\t9.0\t8.6
"""


def test_frames_count_annotation_steps(eth_ucy):
    clip = eth_ucy(WALKS)
    assert (clip.rate_hz, clip.vehicles) == (2.5, ())
    assert [p.id for p in clip.pedestrians] == [1, 2]
    walker = clip.pedestrians[1]
    assert walker.frames.tolist() == [78, 79, 80]
    assert walker.positions_m.tolist() == [[1, 2], [1.4, 2], [1.4, 2.8]]  # as published, y up


def test_velocities_look_back(eth_ucy):
    """That of a step is the displacement up to it; the first has the second's."""
    walker = eth_ucy(WALKS).pedestrians[1]
    np.testing.assert_allclose(walker.velocities_mps, [[1, 0], [1, 0], [0, 2]], atol=1e-9)


def test_six_frame_file_counts_steps_of_six(eth_ucy):
    clip = eth_ucy("780 1 0 0\n786 1 0.4 0\n792 1 0.8 0\n", "biwi_eth_6frame")
    assert clip.pedestrians[0].frames.tolist() == [130, 131, 132]
    with pytest.raises(clips.ClipError, match=r"biwi_eth\.txt: the frames of track 1 are not contiguous"):
        eth_ucy("780 1 0 0\n786 1 0.4 0\n", "biwi_eth")


def test_person_annotated_once_stands(eth_ucy):
    (person,) = eth_ucy("780 1 3 4\n").pedestrians
    assert person.positions_m.tolist() == [[3, 4]]
    assert person.velocities_mps.tolist() == [[0, 0]]


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("780 1 0 0\n800 1 0 0\n", "track 1 are not contiguous"),
        ("780 1 0 0\n780 1 0 0\n", "track 1 are not contiguous"),
        ("780 1 0\n", "needs rows of four finite numbers"),
        ("780 1 0 nan\n", "needs rows of four finite numbers"),
        ("780 1 0 here\n", "not numbers"),
    ],
)
def test_damaged_annotation_is_refused_by_name(eth_ucy, content, problem):
    with pytest.raises(clips.ClipError, match=problem) as caught:
        eth_ucy(content)
    assert "biwi_hotel.txt" in str(caught.value)


def test_absent_scene_is_named(eth_ucy, tmp_path):
    eth_ucy(WALKS)
    assert clips.clip_names("eth_ucy", tmp_path) == ("eth_ucy/biwi_hotel",)
    with pytest.raises(clips.DataNotFound, match=r"'eth_ucy/mall' is not in .*no mall\.txt"):
        clips.load_clip("eth_ucy/mall", tmp_path)


@pytest.mark.parametrize(
    ("file", "people", "rows", "speed_mps"),
    [
        ("biwi_eth", 360, 5492, 2.29),  # interpolated to 0.67 s, read as 0.4 s
        ("biwi_eth_6frame", 360, 8908, 1.38),
        ("biwi_hotel", 389, 6543, 1.04),
        ("students001", 415, 21813, None),
        ("students003", 434, 17953, None),
        ("crowds_zara01", 148, 5153, 1.07),
        ("crowds_zara02", 204, 9722, None),
        ("crowds_zara03", 137, 5005, None),
        ("uni_examples", 118, 2747, None),
    ],
)
def test_public_scenes_have_the_published_counts(public_data, file, people, rows, speed_mps):
    clip = clips.load_clip(f"eth_ucy/{file}", public_data)
    assert len(clip.pedestrians) == people
    assert sum(len(p.frames) for p in clip.pedestrians) == rows
    if speed_mps is not None:
        steps = np.concatenate([p.velocities_mps[1:] for p in clip.pedestrians])
        assert np.linalg.norm(steps, axis=1).mean() == pytest.approx(speed_mps, abs=0.02)


def test_public_scenes_are_all_there(public_data):
    assert len(clips.clip_names("eth_ucy", public_data)) == 9
