"""The tracker benchmark: scenarios are what they say, every tracker tracks, and the results say how they came about."""

import json
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stonesoup")
from benchmarks.tracking import compare, peers
from benchmarks.tracking.compare import (
    Outcome,
    Scans,
    as_json,
    cases,
    cost,
    draw_cost,
    evaluate,
    markdown,
    run,
    scans_of,
    scores,
    targets,
)
from benchmarks.tracking.scenarios import (
    CROWD,
    DENSE_CLUTTER,
    PAIR_GAP_M,
    REPORT_SEEDS,
    TUNING_SEEDS,
    VO_MA,
    Scan,
    crowd,
    vo_ma,
    walk,
)
from tracking.metrics import ScoredFrame

# --- scenarios --------------------------------------------------------------------------------------------------------


def test_no_reported_seed_is_a_tuning_seed():
    assert not set(TUNING_SEEDS) & set(REPORT_SEEDS)
    assert len(set(REPORT_SEEDS)) == 10


@pytest.mark.parametrize("sensor", [CROWD, DENSE_CLUTTER], ids=["5", "20"])
def test_crowd_is_measured_as_its_sensor_says(sensor):
    scans = crowd(30, 200, 5, sensor)
    counts = np.array([len(scan.measured_m) for scan in scans])
    assert counts.mean() == pytest.approx(30 * sensor.p_detect + sensor.clutter, rel=0.05)
    assert all(len(scan.ids) == len(set(scan.ids.tolist())) == 30 for scan in scans)
    assert np.diff([scan.stamp_ns for scan in scans]).tolist() == [100_000_000] * 199
    nearest = [
        np.hypot(*(scan.measured_m[:, None] - scan.truth_m[None]).transpose(2, 0, 1)).min(axis=0) for scan in scans
    ]
    near = np.concatenate(nearest)
    # Rayleigh, but for the misses: the median of a distance is 1.18 sigma; with a tenth missed, rather more.
    assert np.median(near) == pytest.approx(1.28 * sensor.sigma_m, rel=0.08)


@pytest.mark.parametrize("N", [10, 30, 100])
def test_a_third_of_the_crowd_walks_in_pairs(N):
    P = round(N / 6)
    truth = list(walk(N, 200, 4))
    positions = np.array([places for _, places in truth])
    gaps = np.hypot(*(positions[:, :P] - positions[:, P : 2 * P]).transpose(2, 0, 1))
    assert np.median(gaps) == pytest.approx(PAIR_GAP_M, abs=0.03)
    assert (np.abs(gaps - PAIR_GAP_M) < 0.2).mean() > 0.9
    # Side by side: what is between them is square to where they go.
    velocity, between = np.diff(positions[:, :P], axis=0), (positions[:, P : 2 * P] - positions[:, :P])[1:]
    walking = np.hypot(*velocity.transpose(2, 0, 1)) > 0.05
    cosine = (velocity * between).sum(2)[walking] / (np.linalg.norm(velocity, axis=2) * gaps[1:])[walking]
    assert np.median(np.abs(cosine)) < 0.25
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=2) / CROWD.dt_s
    assert 0.9 < np.median(speeds) < 1.6


def test_crowd_is_repeatable_and_its_truth_does_not_depend_on_the_clutter():
    one, again, dense = crowd(12, 20, 3), crowd(12, 20, 3), crowd(12, 20, 3, DENSE_CLUTTER)
    assert np.array_equal(one[-1].measured_m, again[-1].measured_m)
    assert np.array_equal(one[-1].truth_m, dense[-1].truth_m)
    assert not np.array_equal(one[-1].truth_m, crowd(12, 20, 4)[-1].truth_m)


def test_vo_ma_is_the_papers():
    assert VO_MA.clutter_per_m2 == 12.5e-6
    scans = vo_ma(100, 0, spawning=True)
    assert [len(scan.ids) for scan in scans] == [2] * 65 + [3] * 35
    assert scans[0].truth_m.tolist() == [[250, 250], [-250, -250]]
    apart = [np.hypot(*(scan.truth_m[0] - scan.truth_m[1])) for scan in scans]
    assert int(np.argmin(apart)) + 1 in (53, 54)
    assert scans[65].truth_m[2].tolist() == scans[65].truth_m[0].tolist()  # spawned where the first one is
    assert np.abs(np.concatenate([scan.truth_m for scan in scans])).max() < 1000
    expected = 50 + 0.98 * np.mean([len(scan.ids) for scan in scans])
    assert np.mean([len(scan.measured_m) for scan in scans]) == pytest.approx(expected, rel=0.05)
    assert all(len(scan.ids) == 2 for scan in vo_ma(100, 0, spawning=False))


# --- trackers ---------------------------------------------------------------------------------------------------------


def two_walkers(scans=25):
    """Two people, seen at every scan and without noise, and one false measurement at each."""
    generator = np.random.default_rng(0)
    out = []
    for k in range(1, scans + 1):
        truth = np.array([[0.1 * k, 0.0], [5.0, -0.1 * k]])
        measured = np.concatenate([truth, generator.uniform(-30, -10, (1, 2))])
        out.append(Scan(k * 100_000_000, np.array([4, 8]), truth, measured))
    return out


CASES = {case.name: case for case in cases((10,))}


@pytest.mark.parametrize("tracker", list(CASES["crowd"].trackers))
def test_every_tracker_follows_two_people(tracker):
    frames, cpu_ms = run(CASES["crowd"].trackers[tracker](), two_walkers(), settling=10)
    assert len(frames) == 15
    assert cpu_ms > 0
    found = scores(frames, CROWD.cutoff_m, 36)
    assert found["ospa_m"] < 0.1
    assert found["hota"] > 0.9
    assert found["id_switches"] == 0
    assert found["ospa2_m"] >= found["ospa_m"] - 1e-9


@pytest.mark.parametrize("tracker", list(CASES["crowd"].trackers))
def test_every_tracker_takes_empty_scans(tracker):
    peer = CASES["crowd"].trackers[tracker]()
    for k in range(1, 4):
        ids, positions = peer.step(np.zeros((0, 2)), k * 100_000_000)
        assert (ids.shape, positions.shape) == ((0,), (0, 2))


@pytest.mark.parametrize("tracker", list(CASES["Vo & Ma, spawning"].trackers))
def test_every_tracker_follows_the_papers_targets(tracker):
    outcome = evaluate(CASES["Vo & Ma, spawning"], tracker, Scans((0,), 60), Scans((0,), 60))
    assert outcome.cpu_ms_on_stone_soups_scans == outcome.cpu_ms
    assert outcome.ospa_m < 30
    assert outcome.mota > 0.7


def test_a_tracker_is_timed_again_on_the_scans_that_stone_soup_gets():
    given, stone_soups = scans_of(CASES["crowd"], (0, 1), 20, 13)
    assert (given, stone_soups) == (Scans((0, 1), 20), Scans((0, 1), 13))
    outcome = evaluate(CASES["crowd"], compare.SORT, given, stone_soups)
    assert (outcome.seeds, outcome.scans) == given
    assert 0 < outcome.cpu_ms_on_stone_soups_scans != outcome.cpu_ms


def test_in_large_crowds_stone_soup_gets_one_seed():
    (large,) = (case for case in cases((100,)) if case.sensor == CROWD)
    assert scans_of(large, REPORT_SEEDS, 300, 40) == (Scans(REPORT_SEEDS[:4], 300), Scans(REPORT_SEEDS[:1], 40))
    given, stone_soups = scans_of(CASES["Vo & Ma"], REPORT_SEEDS, 300, 40)
    assert given == stone_soups == Scans(REPORT_SEEDS, 100)


def test_stone_soups_births_follow_the_sensor():
    far = np.array([500.0, 0.0])
    scans = two_walkers()
    at_home, moved = (peers.StoneSoupPhd(CROWD, peers.STONE_SOUP_CROWD) for _ in range(2))
    for scan in scans:
        _, here = at_home.step(scan.measured_m, scan.stamp_ns)
        _, there = moved.step(scan.measured_m + far, scan.stamp_ns, far)
    assert len(here) == 2
    assert np.sort(there, axis=0) == pytest.approx(np.sort(here + far, axis=0))


def test_stone_soups_trees_change_little_but_its_time():
    scans = crowd(8, 15, 0)
    plain, trees = (
        run(peers.StoneSoupPhd(CROWD, params), scans, 0)[0]
        for params in (peers.STONE_SOUP_CROWD, peers.STONE_SOUP_CROWD_TREES)
    )
    assert scores(trees, 2.0, 10)["ospa_m"] == pytest.approx(scores(plain, 2.0, 10)["ospa_m"], abs=0.05)


# --- results ----------------------------------------------------------------------------------------------------------


def test_scores_scale_with_the_cutoff():
    """50 times the distances with 50 times the cutoff: the shares stay, the distances grow."""
    frames = [ScoredFrame(np.array([1]), np.array([[k, 0.0]]), np.array([5]), np.array([[k, 0.5]])) for k in range(5)]
    large = [ScoredFrame(f.truth_ids, 50 * f.truth_m, f.track_ids, 50 * f.tracks_m) for f in frames]
    small, big = scores(frames, 2.0, 3), scores(large, 100.0, 3)
    distances = {name for name in small if name.endswith("_m")}
    assert big == pytest.approx({name: value * (50 if name in distances else 1) for name, value in small.items()})


def outcome(tracker, **changes):
    given = {field.name: 0.5 for field in fields(Outcome)}
    given |= {"scenario": "crowd", "people": 100, "clutter": 5.0, "tracker": tracker, "seeds": (100,), "scans": 300}
    return Outcome(**(given | changes))


def test_results_are_complete_and_targets_are_judged(tmp_path):
    outcomes = [
        outcome(compare.OURS, ospa_m=0.11, hota=0.92, cpu_ms=1.5, cpu_ms_on_stone_soups_scans=1.2),
        outcome(compare.SORT, cpu_ms=3.0),
        outcome(compare.STONE_SOUP, scans=40, cpu_ms=300.0, cpu_ms_on_stone_soups_scans=300.0),
    ]
    written = json.loads(json.dumps(as_json(outcomes)))
    assert set(written) == {"outcomes", "targets", "sensors", "parameters", "versions"}
    assert set(written["outcomes"][0]) == set(asdict(outcomes[0]))
    assert set(written["versions"]) == {"python", "numpy", "scipy", "stonesoup", "filterpy"}
    assert {row["target"]: row["met"] for row in targets(outcomes)} == {
        "100 people: OSPA in m": True,
        "100 people: 1 - HOTA": True,
        "100 people: CPU, times Stone Soup's": False,
        "100 people: CPU, times SORT's": True,
    }
    table = markdown(outcomes).splitlines()
    assert len(table) == 5
    assert len({line.count("|") for line in table}) == 1
    assert table[2].endswith("| 1.5 | 0.5 | 0.004 |")
    draw_cost(outcomes, tmp_path / "cost.png")
    assert (tmp_path / "cost.png").stat().st_size > 1000


def test_cost_is_over_the_same_scans():
    ours = outcome(compare.OURS, cpu_ms=2.0, cpu_ms_on_stone_soups_scans=1.0)
    assert cost(ours, outcome(compare.SORT, cpu_ms=4.0, cpu_ms_on_stone_soups_scans=1.0)) == 0.5
    soup = outcome(compare.STONE_SOUP, scans=40, cpu_ms=100.0, cpu_ms_on_stone_soups_scans=100.0)
    assert (cost(ours, soup), cost(soup, ours)) == (0.01, 100)


def test_vo_ma_is_judged_with_process_noise_tuned_and_as_published():
    spawning = [
        outcome(compare.OURS, scenario="Vo & Ma, spawning" + noise, people=3, clutter=VO_MA.clutter, ospa_m=ospa_m)
        for noise, ospa_m in (("", 12.0), (compare.AS_PUBLISHED, 14.0))
    ]
    assert [(row["limit"], row["reached"], row["met"]) for row in targets(spawning)] == [
        (12.4, 12.0, True),
        (12.4, 14.0, False),
    ]


def test_committed_results_are_of_the_reported_seeds_and_todays_parameters():
    results = json.loads(compare.RESULTS.read_text())
    today = json.loads(json.dumps(as_json([])))
    assert results["parameters"] == today["parameters"]
    assert results["sensors"] == today["sensors"]
    assert {seed for row in results["outcomes"] for seed in row["seeds"]} <= set(REPORT_SEEDS)
    shown = {(row["scenario"], row["people"], row["clutter"], row["tracker"]) for row in results["outcomes"]}
    assert shown == {(case.name, case.people, case.sensor.clutter, name) for case in cases() for name in case.trackers}


def test_docs_show_the_committed_results():
    page = (Path(__file__).parents[2] / "docs" / "tracking.md").read_text()
    assert markdown(compare.read_results(), compare.SHORT_HEADINGS) in page
