"""What `pcgan batch` says of each log: a row of results.parquet, every column with its unit and meaning."""

import importlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from replay.errors import OutputError
from replay.part_file import write_whole

Row = dict[str, Any]  # by column; None where there is nothing to say
DONE, FAILED = "done", "failed"


class Column(NamedTuple):
    """A column, what its metadata says, and where its value stands in the summary of a replay."""

    name: str
    type: str  # of pyarrow
    unit: str  # empty: none
    meaning: str
    path: tuple[str, ...] = ()  # empty: it is no figure of the summary


def _errors(prefix: str, path: tuple[str, ...], of: str) -> tuple[Column, ...]:
    return (
        Column(f"{prefix}ade_m", "float64", "m", f"mean error of the likeliest path, {of}", (*path, "ade_m")),
        Column(f"{prefix}fde_m", "float64", "m", f"its error at the last step, {of}", (*path, "fde_m")),
        Column(f"{prefix}mhd_m", "float64", "m", f"modified Hausdorff distance, {of}", (*path, "mhd_m")),
        Column(f"{prefix}nll", "float64", "", f"negative log likelihood of the mixture, {of}", (*path, "nll")),
    )


def _scored(prefix: str, path: tuple[str, ...]) -> tuple[Column, ...]:
    return (
        Column(f"{prefix}scored", "int64", "", "predictions that these errors are of", (*path, "scored")),
        Column(f"{prefix}scored_share", "float64", "", "of all predictions", (*path, "scored_share")),
    )


def _tracking(name: str, type: str, unit: str, meaning: str) -> Column:
    return Column(name, type, unit, meaning, ("ground_truth", name))


COLUMNS = (
    Column("name", "string", "", "of the log in this batch; names the output"),
    Column("url", "string", "", "path or URL"),
    Column("status", "string", "", f"{DONE} or {FAILED}; a log that failed has no figures"),
    Column("problem", "string", "", "why it failed, in one line"),
    Column("frames", "int64", "", "LiDAR scans", ("frames",)),
    Column("log_s", "float64", "s", "replayed, by log time", ("log_s",)),
    Column("tracks", "int64", "", "different ones", ("tracks",)),
    Column("predictions", "int64", "", "one per frame and track", ("predictions",)),
    Column("fallbacks", "int64", "", "predictions that are extrapolated", ("fallbacks",)),
    Column("refused", "int64", "", "messages", ("refused",)),
    Column("lost", "int64", "", "damages that --salvage left out"),
    Column("unmatched_labels", "string", "", "all that the detector gave, if none means a pedestrian"),
    *_errors("", (), "against where the tracks were later"),
    *_scored("", ()),
    *_errors("tracker_", ("tracker",), "of the extrapolated track, against the same"),
    *_errors("truth_", ("ground_truth",), "against ground truth"),
    *_scored("truth_", ("ground_truth",)),
    *_errors("truth_tracker_", ("ground_truth", "tracker"), "of the extrapolated track, against ground truth"),
    _tracking("people_seen", "int64", "", "people whom the LiDAR saw for 2 s or more"),
    _tracking("people_tracked", "int64", "", "of these, those with a track at some time"),
    _tracking("people_predicted", "int64", "", "of these, those whom the network predicted at some time"),
    _tracking("hota", "float64", "", "higher order tracking accuracy"),
    _tracking("det_a", "float64", "", "detection accuracy, of HOTA"),
    _tracking("ass_a", "float64", "", "association accuracy, of HOTA"),
    _tracking("idf1", "float64", "", "share of positions with the right identity"),
    _tracking("mota", "float64", "", "multiple object tracking accuracy; may be negative"),
    _tracking("id_switches", "int64", "", "times a person's track became another one"),
    _tracking("missed", "int64", "", "people without a track, summed over frames"),
    _tracking("false", "int64", "", "tracks without a person, summed over frames"),
    _tracking("ospa_m", "float64", "m", "optimal subpattern assignment distance, mean over frames"),
    _tracking("gospa_m", "float64", "m", "generalised OSPA, mean over frames"),
    _tracking("localisation_m", "float64", "m", "mean distance of tracks from their people"),
    Column("truth_frames", "int64", "", "frames with ground truth", ("ground_truth", "frames")),
    Column("model", "string", "", "which weights predicted", ("model", "name")),
    Column("model_sha256", "string", "", "of their file", ("model", "sha256")),
    Column("version", "string", "", "of pcgan"),
    Column("input_sha256", "string", "", "of the log"),
    Column("output_sha256", "string", "", "of the output"),
    Column("replay_s", "float64", "s", "wall time of the replay; differs from run to run, as does the next"),
    Column("wall_s", "float64", "s", "wall time of all: fetching, loading the weights, replaying, checksums"),
)
TIMINGS = ("replay_s", "wall_s")  # all that differs between two runs on one machine


def empty_row(**values: object) -> Row:
    """Returns a row with some values, and None for the rest."""
    row: Row = dict.fromkeys((column.name for column in COLUMNS), None)
    assert set(values) <= set(row), f"no such column: {set(values) - set(row)}"
    return {**row, **values}


def figures(summary: Mapping[str, Any]) -> Row:
    """Returns what a replay's summary (`Summary.as_json`) says, by column; None for what it does not hold."""
    found = {column.name: _at(summary, column.path) for column in COLUMNS if column.path}
    labels = ", ".join(summary["unmatched_labels"]) or None
    return found | {
        "lost": len(summary["salvage_losses"]), "unmatched_labels": labels, "replay_s": summary["wall_s"]
    }  # fmt: skip


def _at(summary: Mapping[str, Any], path: tuple[str, ...]) -> Any:
    value: Any = summary
    for name in path:
        value = None if value is None else value.get(name)
    return value


def write_table(rows: Sequence[Row], path: Path) -> None:
    """Writes rows as Parquet, in place of an older table only when it is whole; raises OutputError."""
    pa, parquet = pyarrow()
    said = [{"unit": column.unit, "meaning": column.meaning} for column in COLUMNS]
    schema = pa.schema(
        pa.field(column.name, getattr(pa, column.type)(), metadata={name: text for name, text in said.items() if text})
        for column, said in zip(COLUMNS, said, strict=True)
    )
    data = io.BytesIO()
    parquet.write_table(pa.Table.from_pylist(list(rows), schema), data, compression="zstd")
    write_whole(path, data.getvalue())


def pyarrow() -> tuple[Any, Any]:
    """Returns pyarrow and its Parquet part; raises OutputError if it is not installed."""
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        raise OutputError(
            "pcgan batch needs the package pyarrow, which is not installed: pip install 'pcgan[data]'"
        ) from error
