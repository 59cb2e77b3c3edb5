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
