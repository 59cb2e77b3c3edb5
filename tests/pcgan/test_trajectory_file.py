"""Trajectories from files: a round trip, the grid, the gaps, and what is wrong with a file told by its name."""

import gzip

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcgan import clips
from pcgan.clips import Clip, ClipError, Trajectory, VehicleTrajectory
from pcgan.trajectory_file import COLUMNS, load_trajectories, read_rows, save_trajectories

START_NS = 1_700_000_000_123_456_789
HEADER = "id,stamp_ns,x,y,vx,vy"
SUFFIXES = [".csv", ".csv.gz", ".parquet"]


def walk(id, first, count, rate_hz=10.0, seed=0):
    rng = np.random.default_rng([id, seed])
    velocities = rng.normal(0, 1, (count, 2))
    return Trajectory(id, np.arange(first, first + count), np.cumsum(velocities, axis=0) / rate_hz, velocities)


def drive(id, first, count, seed=0):
    rng = np.random.default_rng([id, seed])
    yaws = np.arctan2(*np.split(rng.normal(size=(2, count)), 2))[0]
    return VehicleTrajectory(id, np.arange(first, first + count), rng.normal(0, 9, (count, 2)), yaws, np.ones(count))


def lines(path, *rows, header=HEADER):
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def row(id, time_s, x=0.0, y=0.0, vx=0.0, vy=0.0, start_ns=START_NS):
    return f"{id},{start_ns + round(time_s * 1e9)},{x},{y},{vx},{vy}"


def assert_same(found: Clip, wanted: Clip, shift: int = 0):
    assert found.rate_hz == pytest.approx(wanted.rate_hz, rel=1e-12)
    assert [p.id for p in found.pedestrians] == sorted(p.id for p in wanted.pedestrians)
    for a, b in zip(found.pedestrians, sorted(wanted.pedestrians, key=lambda p: p.id), strict=True):
        assert a.frames.tolist() == (b.frames - shift).tolist()
        np.testing.assert_allclose(a.positions_m, b.positions_m, atol=1e-6)
        np.testing.assert_allclose(a.velocities_mps, b.velocities_mps, atol=1e-6)
    for a, b in zip(found.vehicles, wanted.vehicles, strict=True):
        assert a.frames.tolist() == (b.frames - shift).tolist()
        np.testing.assert_allclose(a.positions_m, b.positions_m, atol=1e-5)
        np.testing.assert_allclose(np.exp(1j * a.yaw_rad), np.exp(1j * b.yaw_rad), atol=1e-5)
        np.testing.assert_allclose(a.speed_mps, b.speed_mps, atol=1e-6)


# --- round trip ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_clip_survives_the_file(tmp_path, suffix):
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    path = tmp_path / f"drive{suffix}"
    clip = Clip(path.name, 10.0, (walk(7, 4, 20), walk(3, 0, 12)), (drive(0, 0, 30),))  # the vehicle alone at the end
    save_trajectories(clip, path, START_NS)
    assert_same(load_trajectories(path), clip)
    assert_same(clips.load_clip(str(path)), clip)
    assert load_trajectories(path).name == path.name


@settings(max_examples=40, deadline=None)
@given(
    rate_hz=st.sampled_from([2.5, 10.0, 12.0, 24000 / 1001, 25.0, 30000 / 1001]),
    tracks=st.lists(st.tuples(st.integers(0, 60), st.integers(2, 40)), min_size=1, max_size=5),
    with_vehicle=st.booleans(),
    start_ns=st.integers(0, 2**61),
    seed=st.integers(0, 9),
)
def test_round_trip_at_the_usual_rates(tmp_path_factory, rate_hz, tracks, with_vehicle, start_ns, seed):
    path = tmp_path_factory.mktemp("round") / "t.csv"
    people = tuple(walk(id, first, count, rate_hz, seed) for id, (first, count) in enumerate(tracks))
    clip = Clip("t.csv", rate_hz, people, (drive(0, 0, 101, seed),) if with_vehicle else ())
    save_trajectories(clip, path, start_ns)
    shift = 0 if with_vehicle else min(first for first, _ in tracks)  # frame 0 is the first stamp
    assert_same(load_trajectories(path), clip, shift)


def test_public_clip_survives_the_file(tmp_path, public_data):
    clip = clips.load_clip("citr/vci_front/front_interaction_01", public_data)
    save_trajectories(clip, tmp_path / "t.csv.gz")
    first = min(*(p.frames[0] for p in clip.pedestrians), clip.vehicles[0].frames[0])
    assert_same(load_trajectories(tmp_path / "t.csv.gz"), clip, shift=first)


def test_the_same_clip_gives_the_same_bytes(tmp_path):
    clip = Clip("t", 10.0, (walk(1, 0, 9),), ())
    for name in ("a.csv.gz", "b.csv.gz"):
        save_trajectories(clip, tmp_path / name)
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()
    header, first = gzip.decompress((tmp_path / "a.csv.gz").read_bytes()).decode().splitlines()[:2]
    assert header == ",".join(COLUMNS)
    assert first.endswith(",,,,,,,")  # neither covariance nor vehicle


def test_one_vehicle_is_chosen_of_several(tmp_path):
    clip = Clip("two", 10.0, (walk(1, 0, 9),), (drive(0, 0, 9), drive(4, 0, 9)))
    with pytest.raises(ValueError, match=r"two has vehicles \[0, 4\].*choose vehicle_id"):
        save_trajectories(clip, tmp_path / "t.csv")
    with pytest.raises(ValueError, match=r"two has no vehicle 2; its vehicles are \[0, 4\]"):
        save_trajectories(clip, tmp_path / "t.csv", vehicle_id=2)
    save_trajectories(clip, tmp_path / "t.csv", vehicle_id=4)
    (vehicle,) = load_trajectories(tmp_path / "t.csv").vehicles
    np.testing.assert_allclose(vehicle.positions_m, clip.vehicles[1].positions_m, atol=1e-6)
    with pytest.raises(ValueError, match="two people of one id at a time"):
        save_trajectories(Clip("t", 10.0, (walk(1, 0, 9), walk(1, 8, 9)), ()), tmp_path / "t.csv")
    with pytest.raises(ValueError, match="must end in"):
        save_trajectories(Clip("t", 10.0, (walk(1, 0, 9),), ()), tmp_path / "t.txt")


# --- the grid --------------------------------------------------------------------------------------------------------


def test_stamps_that_jitter_are_interpolated_to_the_grid(tmp_path):
    """Along a straight path at constant speed, linear interpolation is exact wherever the stamps fall."""
    rng = np.random.default_rng(5)
    times = np.arange(40) / 10 + np.concatenate([[0], rng.uniform(-0.012, 0.012, 39)])
    path = lines(tmp_path / "t.csv", *(row(1, t, x=1 + 1.5 * t, y=-2 * t, vx=1.5, vy=-2) for t in times))
    clip = load_trajectories(path)
    assert clip.rate_hz == 10.0
    (walker,) = clip.pedestrians
    grid_s = walker.frames / 10
    assert set(range(1, 39)) <= set(walker.frames.tolist()) <= set(range(40))
    np.testing.assert_allclose(walker.positions_m, np.stack([1 + 1.5 * grid_s, -2 * grid_s], -1), atol=1e-6)
    np.testing.assert_allclose(walker.velocities_mps, [[1.5, -2]] * len(grid_s))


@pytest.mark.parametrize(
    ("step_s", "rate_hz"), [(0.1003, 10.0), (0.4, 2.5), (1 / 23.976, 24000 / 1001), (0.35, 1 / 0.35)]
)
def test_the_rate_is_the_nearest_usual_one(tmp_path, step_s, rate_hz):
    path = lines(tmp_path / "t.csv", *(row(1, k * step_s, x=k) for k in range(9)))
    assert load_trajectories(path).rate_hz == pytest.approx(rate_hz, rel=1e-8)


def test_a_track_is_cut_where_the_gap_exceeds_half_a_second(tmp_path):
    times = [0.0, 0.1, 0.2, 0.3, 0.8, 0.9, 1.0, 1.1, 1.7, 1.8]  # a gap of 0.5 s, which is bridged, and one of 0.6 s
    path = lines(tmp_path / "t.csv", *(row(5, t, x=t) for t in times), row(6, 0.4, x=9))
    clip = load_trajectories(path)
    assert [p.id for p in clip.pedestrians] == [5, 5, 6]
    assert [p.frames.tolist() for p in clip.pedestrians] == [list(range(12)), [17, 18], [4]]
    np.testing.assert_allclose(clip.pedestrians[0].positions_m[:, 0], np.arange(12) / 10, atol=1e-9)


def test_rows_may_come_in_any_order(tmp_path):
    rows = [row(id, t, x=id + t) for id in (1, 2) for t in (0.0, 0.1, 0.2, 0.3)]
    wanted = load_trajectories(lines(tmp_path / "a.csv", *rows))
    found = load_trajectories(lines(tmp_path / "b.csv", *np.random.default_rng(0).permutation(rows)))
    assert_same(found, wanted)


def test_stamps_keep_every_nanosecond(tmp_path):
    path = lines(tmp_path / "t.csv", *(f"1,{START_NS + k},0,0,0,0" for k in range(3)))
    assert (read_rows(path).stamps_ns - START_NS).tolist() == [0, 1, 2]


def test_the_vehicle_turns_through_pi_and_is_there_while_nobody_is_seen(tmp_path):
    vehicle = "vehicle_x,vehicle_y,vehicle_yaw,vehicle_speed"
    rows = [
        *(f"1,{k * 100_000_000},0,0,0,0,{k},0,{yaw},2" for k, yaw in ((0, 3.1), (1, 3.14), (2, -3.1))),
        *(f",{k * 100_000_000},,,,,{k},0,-3.1,2" for k in (4, 5)),  # 3 is missing
    ]
    clip = load_trajectories(lines(tmp_path / "t.csv", *rows, header=f"{HEADER},{vehicle}"))
    (found,) = clip.vehicles
    assert found.id == 0
    assert found.frames.tolist() == [0, 1, 2, 3, 4, 5]
    assert found.positions_m[:, 0].tolist() == pytest.approx(range(6))
    assert found.yaw_rad.tolist() == pytest.approx([3.1, 3.14, -3.1, -3.1, -3.1, -3.1])
    assert [p.frames.tolist() for p in clip.pedestrians] == [[0, 1, 2]]


def test_covariances_are_read_further_columns_are_not(tmp_path):
    header = f"note,{HEADER},cov_xx,cov_xy,cov_yy"
    path = lines(tmp_path / "t.csv", "a,1,0,0,0,0,0,0.1,0.01,0.2", "b,1,100000000,0,0,0,0,,,", header=header)
    covs = read_rows(path).position_covs
    assert covs[0].tolist() == [0.1, 0.01, 0.2]
    assert np.isnan(covs[1]).all()
    assert load_trajectories(path).vehicles == ()


# --- wrong files -----------------------------------------------------------------------------------------------------

VEHICLE_HEADER = f"{HEADER},vehicle_x,vehicle_y,vehicle_yaw,vehicle_speed"


@pytest.mark.parametrize(
    ("header", "rows", "problem"),
    [
        ("id,stamp_ns,x,y", ["1,0,0,0"], "has no column vx, vy; its columns are id, stamp_ns, x, y"),
        (f"{HEADER},x", ["1,0,0,0,0,0,0"], "has a column twice: x"),
        (f"{HEADER},vehicle_x", ["1,0,0,0,0,0,0"], "has vehicle_x but not all of vehicle_x, vehicle_y"),
        (HEADER, [], "holds no rows"),
        (HEADER, ["1,0,0,0,0"], "row 1: 5 cells under 6 columns"),
        (HEADER, ["1,0,0,0,0,0", "1,1,one,0,0,0"], "row 2: x is 'one', not a number"),
        (HEADER, ["1,0,0,nan,0,0"], "row 1: y is 'nan'; NaN and infinity are not wanted"),
        (HEADER, ["1,0,0,0,0,-inf"], "row 1: vy is '-inf'; NaN and infinity"),
        (HEADER, ["1,0,0,0,,0"], "row 1: vx is empty"),
        (HEADER, ["1.5,0,0,0,0,0"], "row 1: id is '1.5', not a whole number"),
        (HEADER, ["-1,0,0,0,0,0"], "row 1: an id below 0"),
        (HEADER, ["1,1.7e18,0,0,0,0"], "row 1: stamp_ns is '1.7e18', not a whole number"),
        (HEADER, ["1,99999999999999999999,0,0,0,0"], "row 1: stamp_ns is '99999999999999999999', not a whole"),
        (HEADER, ["1,,0,0,0,0"], "row 1: stamp_ns is '', not a whole number"),
        (HEADER, [",0,0,0,0,0"], "row 1: a position without id"),
        (HEADER, ["1,0,,,,"], "row 1: an id without x, y, vx, vy"),
        (HEADER, [",0,,,,"], "row 1: neither a person nor the vehicle"),
        (HEADER, ["4,0,0,0,0,0", "4,100,0,0,0,0", "4,100,1,0,0,0"], "id 4 has two rows of stamp_ns 100"),
        (HEADER, ["1,0,0,0,0,0", "2,0,0,0,0,0"], "holds a single stamp"),
        (HEADER, ["1,0,0,0,0,0", "1,1000000000,0,0,0,0"], "median step of its stamps is 1 s"),
        (
            VEHICLE_HEADER,
            ["1,0,0,0,0,0,5,5,0,1", "2,0,0,0,0,0,6,5,0,1", "1,100000000,0,0,0,0,5,5,0,1"],
            "the vehicle is in two places at stamp_ns 0",
        ),
    ],
)
def test_what_is_wrong_is_told_with_the_file(tmp_path, header, rows, problem):
    path = lines(tmp_path / "wrong.csv", *rows, header=header)
    with pytest.raises(ClipError) as caught:
        load_trajectories(path)
    assert problem in str(caught.value)
    assert "wrong.csv" in str(caught.value)


def test_files_that_are_no_tables(tmp_path):
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "cut.csv.gz").write_bytes(gzip.compress(b"id,stamp_ns\n" * 99)[:30])
    (tmp_path / "latin.csv").write_bytes(b"id,stamp_ns,\xe4\n")
    for name, problem in (
        ("empty.csv", "is empty; it needs a header"),
        ("cut.csv.gz", "cannot be read"),
        ("latin.csv", "cannot be read"),
    ):
        with pytest.raises(ClipError, match=problem) as caught:
            load_trajectories(tmp_path / name)
        assert name in str(caught.value)
    with pytest.raises(clips.DataNotFound, match=r"there is no file .*nowhere\.csv"):
        clips.load_clip(str(tmp_path / "nowhere.csv"))
    with pytest.raises(ClipError, match=r"must end in \.csv"):
        load_trajectories(tmp_path / "t.txt")


def test_parquet_that_is_none_and_parquet_with_float_stamps(tmp_path):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    (tmp_path / "bad.parquet").write_bytes(b"PAR1 and nothing else")
    with pytest.raises(ClipError, match=r"bad\.parquet cannot be read"):
        load_trajectories(tmp_path / "bad.parquet")
    columns = {name: [0.0, 1.0] for name in HEADER.split(",")} | {"id": [1, 1]}
    parquet.write_table(pa.table(columns), str(tmp_path / "float.parquet"))
    with pytest.raises(ClipError, match=r"float\.parquet, row 1: stamp_ns is 0.0, not a whole number"):
        load_trajectories(tmp_path / "float.parquet")


def test_parquet_without_pyarrow_is_one_clear_error(tmp_path, monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(name)

    monkeypatch.setattr("pcgan.trajectory_file.importlib.import_module", missing)
    (tmp_path / "t.parquet").write_bytes(b"")
    with pytest.raises(ClipError, match="needs the package pyarrow, which is not installed"):
        load_trajectories(tmp_path / "t.parquet")
    save_trajectories(Clip("t", 10.0, (walk(1, 0, 9),), ()), tmp_path / "t.csv")  # needs none
