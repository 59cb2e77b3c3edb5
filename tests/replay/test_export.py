"""Parquet against the messages it is made of: every cell, every unit; row groups; and every way it can go wrong."""

import itertools
import re
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from replay import export as module
from replay import log_writer
from replay.errors import LogError, OutputError, Refusals
from replay.export import MIXTURE_COLUMNS, PREDICTION_COLUMNS, TRACK_COLUMNS, export
from replay.log_reader import LogReader
from replay.log_writer import LogWriter
from schemas.messages import Mixture, ModalPath, Prediction

COVARIANCE = np.array([[1, 2, 3, 4], [2, 5, 6, 7], [3, 6, 8, 9], [4, 7, 9, 10]]) / 100
NAMES = ["x", "y", "vx", "vy"]


@pytest.fixture
def frames(make):
    """Tracks 4 and 9 in two frames; 4 has two paths, 9 falls back to one; nobody in a third frame."""

    def prediction(track_id, paths, corridor):
        rng = np.random.default_rng(track_id)
        weights = rng.dirichlet(np.ones(2), 3).astype(np.float32)
        sigmas = rng.uniform(0.1, 1, (3, 2, 2)).astype(np.float32)
        rhos = rng.uniform(-0.5, 0.5, (3, 2)).astype(np.float32)
        mixture = Mixture(weights, rng.normal(size=(3, 2, 2)).astype(np.float32), sigmas, rhos)
        chosen = tuple(ModalPath(1 / len(paths), np.array(path, float)) for path in paths)
        return Prediction(track_id, len(paths) == 1, chosen, mixture, *corridor)

    def frame(i):
        near = make.track(100 * i, id=4, state=(5.5, 1, 1, 0.25), covariance=COVARIANCE)
        far = make.track(100 * i, id=9, state=(-5, -1, 0, 0), coasting=True)
        left, right, ahead = ([(i + k, side * k) for k in (1, 2, 3)] for side in (1, -1, 0))
        predictions = [prediction(4, [left, right], (0.25, 1.5)), prediction(9, [ahead], (0.0, None))]
        return make.result(100 * i, [near, far], predictions, dt_s=0.4, sequence=i, epoch=1)

    return [frame(0), frame(1), make.result(200, sequence=2, epoch=1)]


@pytest.fixture
def output(frames, tmp_path):
    path = tmp_path / "drive.pcgan.mcap"
    with LogWriter(path) as writer:
        for frame in frames:
            writer.write(frame)
    return path


@pytest.fixture
def tables(output, tmp_path):
    done = export(LogReader([output]), tmp_path / "tables", mixtures=True)
    return {path.stem: pq.read_table(path) for path in done.paths}


def test_a_row_for_every_frame_and_track(tables, frames):
    expected = [(frame.tracks, track) for frame in frames for track in frame.tracks.tracks]
    found = tables["tracks"].to_pylist()
    assert len(found) == len(expected) == 4
    for row, (frame, track) in zip(found, expected, strict=True):
        assert (row["sequence"], row["stamp_ns"], row["epoch"]) == (frame.sequence, frame.stamp_ns, 1)
        assert (row["frame_id"], row["track_id"], row["coasting"]) == ("odom", track.id, track.coasting)
        assert [row[name] for name in NAMES] == track.state.tolist()
        assert (row["existence"], row["age_s"]) == (track.existence, 1.0)
        pairs = itertools.combinations_with_replacement(range(4), 2)
        for i, j in pairs:
            assert row[f"cov_{NAMES[i]}{NAMES[j]}"] == track.covariance[i, j]
    assert len(tables["tracks"].column_names) == 5 + 4 + 10 + 3


def test_a_row_for_every_step_of_every_path(tables, frames):
    expected = [
        (frame.predictions, prediction, rank, path, step)
        for frame in frames
        for prediction in frame.predictions.predictions
        for rank, path in enumerate(prediction.paths)
        for step in range(3)
    ]
    found = tables["predictions"].to_pylist()
    assert len(found) == len(expected) == 18
    for row, (frame, prediction, rank, path, step) in zip(found, expected, strict=True):
        assert row == {
            "sequence": frame.sequence,
            "stamp_ns": frame.stamp_ns,
            "frame_id": "odom",
            "model": "random",
            "track_id": prediction.track_id,
            "fallback": prediction.fallback,
            "corridor_probability": prediction.corridor_probability,
            "corridor_time_s": prediction.corridor_time_s,
            "path": rank,
            "probability": path.probability,
            "step": step + 1,
            "t_s": pytest.approx(0.4 * (step + 1)),
            "x": path.points_m[step, 0],
            "y": path.points_m[step, 1],
        }


def test_a_time_that_cannot_be_is_null(tables):
    times = tables["predictions"].column("corridor_time_s")
    assert times.null_count == 6
    assert {column: tables["predictions"].column(column).null_count for column in ("x", "t_s", "probability")} == {
        "x": 0, "t_s": 0, "probability": 0
    }  # fmt: skip


def test_a_row_for_every_component(tables, frames):
    expected = [
        (frame.predictions, prediction, step, component)
        for frame in frames
        for prediction in frame.predictions.predictions
        for step in range(3)
        for component in range(2)
    ]
    found = tables["mixtures"].to_pylist()
    assert len(found) == len(expected) == 24
    for row, (frame, prediction, step, component) in zip(found, expected, strict=True):
        mixture = prediction.mixture
        assert (row["sequence"], row["stamp_ns"], row["track_id"]) == (
            frame.sequence,
            frame.stamp_ns,
            prediction.track_id,
        )
        assert (row["step"], row["component"], row["t_s"]) == (step + 1, component, pytest.approx(0.4 * (step + 1)))
        assert row["weight"] == mixture.weights[step, component]
        assert [row["mean_x"], row["mean_y"]] == mixture.means_m[step, component].tolist()
        assert [row["sigma_x"], row["sigma_y"]] == mixture.sigmas_m[step, component].tolist()
        assert row["rho"] == mixture.rhos[step, component]


def test_tables_join_by_sequence_and_track(tables):
    joined = tables["predictions"].join(tables["tracks"], ["sequence", "track_id"], right_suffix=" of track")
    assert joined.num_rows == 18
    assert joined.column("vx").null_count == 0


@pytest.mark.parametrize(
    ("name", "columns"), [("tracks", TRACK_COLUMNS), ("predictions", PREDICTION_COLUMNS), ("mixtures", MIXTURE_COLUMNS)]
)
def test_columns_say_what_they_are(tables, name, columns):
    schema = tables[name].schema
    assert schema.names == [column.name for column in columns]
    for column in columns:
        said = {key.decode(): text.decode() for key, text in (schema.field(column.name).metadata or {}).items()}
        assert said.get("unit", "") == column.unit
        assert said.get("meaning", "") == column.meaning


def test_units_of_what_is_measured():
    units = {column.name: column.unit for column in (*TRACK_COLUMNS, *PREDICTION_COLUMNS, *MIXTURE_COLUMNS)}
    expected = {
        "m": ["x", "y", "mean_x", "mean_y", "sigma_x", "sigma_y"],
        "m/s": ["vx", "vy"],
        "s": ["age_s", "corridor_time_s", "t_s"],
        "ns": ["stamp_ns"],
        "m²": ["cov_xx", "cov_xy", "cov_yy"],
        "m²/s": ["cov_xvx", "cov_xvy", "cov_yvx", "cov_yvy"],
        "m²/s²": ["cov_vxvx", "cov_vxvy", "cov_vyvy"],
    }
    for unit, names in expected.items():
        assert [name for name in units if units[name] == unit] == names


def test_the_documents_name_every_column():
    text = (Path(__file__).parents[2] / "docs" / "cli.md").read_text().split("### The tables")[1].split("\n## ")[0]
    for name, table in module.TABLES.items():
        [line] = [line for line in text.splitlines() if line.startswith(f"| `{name}.parquet`")]
        documented = re.findall(r"`(\w+)`", line.split(" | ")[2])
        assert documented == [column.name for column in table.columns]


def test_identifiers_and_stamps_are_whole_numbers_of_64_bits(tables):
    for table in tables.values():
        assert table.schema.field("stamp_ns").type == pa.int64()
        assert table.schema.field("track_id").type == pa.uint64()
        assert table.schema.field("sequence").type == pa.uint64()


def test_without_mixtures_there_are_two_tables(output, tmp_path):
    done = export(LogReader([output]), tmp_path / "tables")
    assert {path.name for path in (tmp_path / "tables").iterdir()} == {"tracks.parquet", "predictions.parquet"}
    assert (done.rows, done.missing) == ({"tracks": 4, "predictions": 18}, [])


def test_the_same_again_is_byte_identical(output, tmp_path):
    for name in ("a", "b"):
        export(LogReader([output]), tmp_path / name, mixtures=True)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_a_whole_replay(recorded, tmp_path):
    done = export(LogReader([recorded.path]), tmp_path, mixtures=True)
    tracks = sum(len(frame.tracks.tracks) for frame in recorded.frames)
    steps = [
        sum(len(path.points_m) for prediction in frame.predictions.predictions for path in prediction.paths)
        for frame in recorded.frames
    ]
    assert (done.rows["tracks"], done.rows["predictions"]) == (tracks, sum(steps))
    assert done.rows["mixtures"] > tracks


def test_times_are_of_the_log(output, frames, tmp_path):
    export(LogReader([output]), tmp_path / "t", start_ns=frames[1].log_time_ns, end_ns=frames[2].log_time_ns)
    assert set(pq.read_table(tmp_path / "t" / "tracks.parquet").column("sequence").to_pylist()) == {1}


def test_progress_is_told(output, frames, tmp_path):
    told = []
    export(LogReader([output]), tmp_path / "t", on_message=told.append)
    assert told == [frame.log_time_ns for frame in frames for _ in range(2)]  # tracks and predictions


# --- other logs ------------------------------------------------------------------------------------------------------


def test_topics_are_found_by_what_they_hold(frames, make_log, logged, tmp_path):
    log = make_log(
        [
            logged("/mine/tracks", 1, frames[0].tracks),
            logged("/mine/predictions", 2, frames[0].predictions),
            logged("/mine/clusters", 3, frames[0].sensors.clusters),
        ]
    )
    assert export(LogReader([log]), tmp_path / "t").rows == {"tracks": 2, "predictions": 9}


def test_tracks_alone_are_a_table_alone(frames, make_log, logged, tmp_path):
    done = export(LogReader([make_log([logged("/mine", 1, frames[0].tracks)])]), tmp_path / "t", mixtures=True)
    assert (done.rows, done.missing) == ({"tracks": 2}, ["predictions", "mixtures"])
    assert [path.name for path in (tmp_path / "t").iterdir()] == ["tracks.parquet"]


def test_frames_without_anybody_are_tables_without_rows(make, make_log, logged, tmp_path):
    empty = make.result(0)
    log = make_log([logged("/t", 1, empty.tracks), logged("/p", 1, empty.predictions)])
    assert export(LogReader([log]), tmp_path / "t", mixtures=True).rows == {
        "tracks": 0, "predictions": 0, "mixtures": 0
    }  # fmt: skip
    assert pq.read_table(tmp_path / "t" / "tracks.parquet").num_rows == 0


def test_a_log_of_something_else_is_refused(make, make_log, logged, tmp_path):
    log = make_log([logged("/velodyne/front/clusters", 1, make.scan(0))])
    with pytest.raises(LogError, match=r"log\.mcap holds no tracks or predictions .* /velodyne/front/clusters"):
        export(LogReader([log]), tmp_path / "t")
    assert not (tmp_path / "t").exists()


def test_several_topics_of_tracks(frames, make_log, logged, tmp_path):
    """Ours is taken; if none is, nobody can know which is meant."""
    ours, theirs = logged("/pcgan/tracks", 1, frames[0].tracks), logged("/theirs", 1, frames[2].tracks)
    assert export(LogReader([make_log([theirs, ours])]), tmp_path / "t").rows == {"tracks": 2}
    log = make_log([theirs, logged("/others", 1, frames[0].tracks)])
    with pytest.raises(LogError, match=r"several topics hold a pcgan\.v1\.TrackFrame.*: /others, /theirs"):
        export(LogReader([log]), tmp_path / "other")


def test_what_cannot_be_decoded_is_counted(frames, make_log, logged, tmp_path):
    log = make_log([logged("/t", 1, frames[0].tracks), logged("/t", 2, b"\xff", "pcgan.v1.TrackFrame")])
    refusals = Refusals()
    assert export(LogReader([log]), tmp_path / "t", refusals=refusals).rows == {"tracks": 2}
    assert refusals.total == 1


# --- row groups, memory ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [1, 7, 1000])
def test_row_groups_change_nothing(output, tables, tmp_path, monkeypatch, rows):
    monkeypatch.setattr(module, "ROW_GROUP_ROWS", rows)
    export(LogReader([output]), tmp_path / "again", mixtures=True)
    for name, table in tables.items():
        assert pq.read_table(tmp_path / "again" / f"{name}.parquet").equals(table)
    groups = pq.ParquetFile(tmp_path / "again" / "predictions.parquet").num_row_groups
    assert groups == {1: 18, 7: 4, 1000: 1}[rows]


@pytest.mark.parametrize("messages", [1, 2])
def test_batches_change_nothing(output, tables, tmp_path, monkeypatch, messages):
    monkeypatch.setattr(module, "BATCH_MESSAGES", messages)
    export(LogReader([output]), tmp_path / "again", mixtures=True)
    for name, table in tables.items():
        file = pq.ParquetFile(tmp_path / "again" / f"{name}.parquet")
        assert file.num_row_groups == 1
        assert file.read().equals(table)


@pytest.mark.parametrize("people", [0, 1])
def test_frames_of_few_people_take_no_more_memory_than_their_rows(make, tmp_path, people):
    """A row group is some 100,000 rows, so that many frames of one person wait for it; those of nobody do not."""
    frame = make.result(0, [make.track(0, id=4)] * people).tracks
    with module._TableWriter(tmp_path / "tracks.parquet", module.TABLES["tracks"]) as writer:
        writer.open()
        tracemalloc.start()
        try:
            for _ in range(4000):
                writer.add(frame)
            waiting_bytes = tracemalloc.get_traced_memory()[0]
        finally:
            tracemalloc.stop()
        writer.finish()
        writer.rename()
    assert pq.read_metadata(tmp_path / "tracks.parquet").num_rows == writer.rows == 4000 * people
    assert waiting_bytes / 4000 < 4 * 200 * people + 20  # a row is some 200 bytes; three quarters for the last batch


def test_memory_does_not_grow_with_the_log(frames, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "ROW_GROUP_ROWS", 200)
    monkeypatch.setattr(log_writer, "CHUNK_BYTES", 20_000)
    peaks = []
    for count in (100, 400):
        with LogWriter(tmp_path / "log.mcap") as writer:
            for i in range(count):
                writer.write(replace(frames[0], log_time_ns=frames[0].log_time_ns + i))
        reader = LogReader([tmp_path / "log.mcap"])
        tracemalloc.start()
        try:
            export(reader, tmp_path / "t")
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


# --- trouble ---------------------------------------------------------------------------------------------------------


def test_until_all_are_whole_none_has_its_name(output, tmp_path):
    folder, seen = tmp_path / "t", set()
    export(LogReader([output]), folder, on_message=lambda _: seen.update(path.name for path in folder.iterdir()))
    assert seen == {"tracks.parquet.part", "predictions.parquet.part"}


@pytest.mark.parametrize("ending", [KeyboardInterrupt, RuntimeError])
def test_an_end_on_the_way_leaves_what_was_there_before(output, tmp_path, ending):
    (tmp_path / "t").mkdir()
    (tmp_path / "t" / "tracks.parquet").write_bytes(b"old")

    def stop(_):
        raise ending

    with pytest.raises(ending):
        export(LogReader([output]), tmp_path / "t", on_message=stop)
    assert [path.name for path in (tmp_path / "t").iterdir()] == ["tracks.parquet"]
    assert (tmp_path / "t" / "tracks.parquet").read_bytes() == b"old"


def test_an_end_while_files_are_opened_leaves_no_part(output, tmp_path, monkeypatch):
    opened = []

    def stop(*_, **__):
        opened.extend(path.name for path in (tmp_path / "t").iterdir())
        raise KeyboardInterrupt

    monkeypatch.setattr(pq, "ParquetWriter", stop)
    with pytest.raises(KeyboardInterrupt):
        export(LogReader([output]), tmp_path / "t")
    assert opened == ["tracks.parquet.part"]
    assert list((tmp_path / "t").iterdir()) == []


def test_an_older_export_is_replaced_but_not_mixed_with_this_one(output, tmp_path):
    export(LogReader([output]), tmp_path / "t", mixtures=True)
    with pytest.raises(OutputError, match=r"mixtures\.parquet is of another export"):
        export(LogReader([output]), tmp_path / "t")
    assert len(list((tmp_path / "t").iterdir())) == 3
    export(LogReader([output]), tmp_path / "t", mixtures=True)


def test_a_folder_under_a_tables_name(output, tmp_path):
    (tmp_path / "t" / "tracks.parquet").mkdir(parents=True)
    with pytest.raises(OutputError, match=r"tracks\.parquet cannot be written: Is a directory"):
        export(LogReader([output]), tmp_path / "t")


def test_a_file_where_the_folder_should_be(output, tmp_path):
    (tmp_path / "t").write_text("")
    with pytest.raises(OutputError, match=r"tracks\.parquet cannot be written: (File exists|Not a directory)"):
        export(LogReader([output]), tmp_path / "t")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("rows", [1, 1000])
def test_a_full_disk_is_one_error_and_no_table(output, tmp_path, monkeypatch, rows):
    monkeypatch.setattr(module, "ROW_GROUP_ROWS", rows)
    (tmp_path / "t").mkdir()
    (tmp_path / "t" / "predictions.parquet.part").symlink_to("/dev/full")
    with pytest.raises(OutputError, match=r"predictions\.parquet cannot be written: .*No space left on device"):
        export(LogReader([output]), tmp_path / "t")
    assert list((tmp_path / "t").iterdir()) == []


def test_without_pyarrow_it_says_what_to_install(output, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(OutputError, match=r"needs the package pyarrow.*pip install 'pcgan\[data\]'"):
        export(LogReader([output]), tmp_path / "t")
