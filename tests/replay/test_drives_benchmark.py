"""The drives benchmark: its variants change what they say, and tuning and reporting share no drive."""

import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("stonesoup")
from benchmarks.tracking.drives import (
    COLUMNS,
    REPORT_DRIVES,
    TUNING_DRIVES,
    as_json,
    figures,
    main,
    run,
    tables,
)
from benchmarks.tracking.variants import FILTER_STEPS, FUSION_STEPS, PEERS, SENSORS, VARIANTS, Variant
from replay.session import Replay


@pytest.fixture(scope="module")
def frames(drive):
    return list(Replay([drive]).frames())


@pytest.fixture(scope="module")
def found(frames):
    return {variant.name: run(frames, "crowd", variant) for variant in VARIANTS}


def test_no_clip_is_both_tuned_on_and_reported():
    assert not {clip for clip, _ in TUNING_DRIVES} & {clip for clip, _ in REPORT_DRIVES}
    assert len(set(REPORT_DRIVES)) == 10
    kinds = [clip.split("_")[0] for clip, _ in REPORT_DRIVES]
    assert kinds.count("dut/intersection") == kinds.count("dut/roundabout") == 5


def test_scores_are_of_the_sensors_named(found):
    fused, lidar, cameras = (found[variant.name].score for variant in SENSORS)
    assert fused.hota > 0.7
    assert fused.mota > max(lidar.mota, cameras.mota)
    assert cameras.localisation_m > 1.5 * fused.localisation_m
    assert all(0 <= result.hidden_found <= 1 for result in found.values())
    assert all(0 < result.tracker_ms < result.stage_ms for result in found.values())


@pytest.mark.parametrize("peer", PEERS, ids=lambda peer: peer.name)
def test_peers_follow_people_on_the_same_measurements(found, peer):
    result = found[peer.name]
    assert result.score.hota > 0.6
    assert result.people == found[SENSORS[0].name].people
    assert result.ospa2_m >= result.score.ospa_m > 0


def test_peers_take_a_drive_with_late_and_empty_scans(frames):
    nothing = replace(frames[0].sensors, cameras=(), clusters=replace(
        frames[0].sensors.clusters,
        centroids_m=np.zeros((0, 3)), sizes_m=np.zeros((0, 3)), points=np.zeros(0, np.int64),
    ))  # fmt: skip
    some = [replace(frames[0], sensors=nothing), replace(frames[1], late=True), frames[2]]
    for peer in PEERS:
        steps = list(peer.track(some))
        assert [step.frame for step in steps] == [some[0], some[2]]
        assert steps[0].positions_m.shape == (0, 2)


def test_every_variant_but_none_is_named_twice():
    assert len({variant.name for variant in VARIANTS}) == len(VARIANTS)
    assert (*SENSORS, *PEERS, *FUSION_STEPS, *FILTER_STEPS) == VARIANTS


@pytest.mark.parametrize("variant", [*SENSORS, *FUSION_STEPS, *FILTER_STEPS], ids=lambda variant: variant.name)
def test_every_variants_settings_are_there(variant):
    assert variant.make_settings()


def test_a_variant_of_a_setting_that_is_not_there_is_an_error():
    with pytest.raises(KeyError):
        Variant("nonsense", {"fusion.nonsense": 1}).make_settings()


def test_patches_are_undone(frames, found):
    again = run(frames, "crowd", SENSORS[0])
    assert again.score == found[SENSORS[0].name].score


ERRORS = {"crowd": Counter({"people": 400, "missed: clutter": 2, "false: measured, where nobody is": 4})}


@pytest.fixture(scope="module")
def rows(found):
    return [figures(result) for result in found.values()]


def test_tables_have_a_line_per_variant_drive_and_error(rows):
    trackers, fusion, filter, drives, errors = (table.splitlines() for table in tables(rows, ERRORS))
    assert len(trackers) == 2 + len(SENSORS) + len(PEERS)
    assert len(fusion) == 2 + 1 + len(FUSION_STEPS)
    assert len(filter) == 2 + 1 + len(FILTER_STEPS)
    assert {line.count("|") for line in (*trackers, *fusion, *filter)} == {len(COLUMNS) + 2}
    assert len(drives) == 3
    assert drives[2].count("|") == len(SENSORS) + 2
    assert errors[2:] == ["| false: measured, where nobody is | 1.00 |", "| missed: clutter | 0.50 |"]
    assert ERRORS["crowd"]["people"] == 400  # left as it was


def test_tables_of_what_was_not_run_are_left_out(rows):
    assert len(tables([row for row in rows if row["variant"] == SENSORS[0].name], ERRORS)) == 2


def test_results_are_complete_and_finite(rows, tmp_path, monkeypatch, capsys):
    written = json.loads(json.dumps(as_json(rows, ERRORS, 0)))
    assert set(written) == {"seed", "results", "errors", "peers"}
    assert {row["variant"] for row in written["results"]} == {variant.name for variant in VARIANTS}
    assert all(set(row) == {"variant", "drive", "people", *COLUMNS} for row in written["results"])
    assert np.isfinite([[row[column] for column in COLUMNS] for row in written["results"]]).all()
    assert set(written["peers"]["parameters"]) == {peer.name for peer in PEERS}
    results = tmp_path / "drives.json"
    results.write_text(json.dumps(written))
    monkeypatch.setattr("benchmarks.tracking.drives.RESULTS", results)
    monkeypatch.setattr("sys.argv", ["drives", "--show"])
    main()
    assert capsys.readouterr().out == "\n\n".join(tables(rows, ERRORS)) + "\n"
