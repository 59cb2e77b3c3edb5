"""The paper's figures, and ours laid out beside them."""

import numpy as np
import pytest
from rich.console import Console

from pcgan import paper_tables, tables
from pcgan.paper_tables import METRICS, SCENES
from pcgan.tables import combine, layouts, margins, margins_sentence, markdown, rich_table, table_1, table_2


def cell(ade, **more):
    return {"pedestrians": 100, "ade": ade, "fde": 2 * ade, "mhd": 0.9 * ade, "nll": 1.0, **more}


def run(method="pcgan", offset=0.0, scenes=SCENES):
    return {method: {scene: {"8": cell(0.2 + offset), "12": cell(0.4 + offset)} for scene in scenes}}


def text_of(layout, width=140):
    console = Console(width=width, color_system=None)
    with console.capture() as capture:
        console.print(rich_table(layout))
    return capture.get()


def test_the_papers_bests_are_those_of_the_design():
    assert paper_tables.best("mean", "12", "ade")[0] == pytest.approx(0.446)
    assert paper_tables.best("mean", "12", "fde")[0] == pytest.approx(0.928)
    assert paper_tables.best("hotel", "12", "ade") == (0.33, "cvm")
    assert paper_tables.figure("pcgan", "mean", "12", "ade") == pytest.approx(0.52)
    assert paper_tables.figure("sgan", "hotel", "8", "ade") > paper_tables.figure("sgan", "hotel", "8", "fde")
    assert paper_tables.suspect("sgan", "hotel", "8", "ade")
    assert paper_tables.suspect("cvm", "hotel", "8", "ade") is None


def test_the_papers_tables_are_whole():
    assert len(list(paper_tables.table_1_cells())) == 30
    for scene, horizon, metric in paper_tables.table_1_cells():
        assert all(paper_tables.figure(m, scene, horizon, metric) > 0 for m in paper_tables.METHODS)
    for scene in ("vci", "usyd"):
        assert all(paper_tables.figure(m, scene, "12", metric) for m in paper_tables.METHODS for metric in METRICS)
        assert paper_tables.figure("cvm", scene, "8", "ade") is None
    assert paper_tables.figure("weighted", "eth", "12", "ade") is None
    assert paper_tables.best("vci_near", "12", "ade") is None


def test_seeds_become_mean_and_spread():
    results = combine([run(offset=0.0), run(offset=0.02), {"lin": run()["pcgan"]}])
    found = results["pcgan"]["eth"]["12"]
    assert found["ade"] == pytest.approx(0.41)
    assert found["ade_std"] == pytest.approx(np.std([0.4, 0.42], ddof=1))
    assert "pedestrians_std" not in found
    assert "ade_std" not in results["lin"]["eth"]["12"]
    assert results["pcgan"]["mean"]["12"]["fde"] == pytest.approx(0.82)
    assert results["pcgan"]["mean"]["12"]["pedestrians"] == 500


def test_the_mean_needs_all_five_scenes_and_has_the_spread_of_means():
    """Two seeds whose errors go opposite ways in two scenes: the scenes spread, their mean does not."""
    first, second = run(), run()
    for scene, sign in (("eth", 1), ("hotel", -1)):
        second["pcgan"][scene]["12"] = cell(0.4 + 0.1 * sign)
    found = combine([first, second])["pcgan"]
    assert found["eth"]["12"]["ade_std"] > 0.05
    assert found["mean"]["12"]["ade_std"] == pytest.approx(0, abs=1e-12)
    assert "mean" not in combine([run(scenes=("eth", "vci"))])["pcgan"]


def test_cells_won_and_lost():
    """0.4 m at 12 steps: better than the paper's best ADE on ETH and Univ (.65, .53), not on Hotel (.33)."""
    found = {(m.scene, m.horizon, m.metric): m for m in margins(run())}
    assert len(found) == 30
    assert found["eth", "12", "ade"].won
    assert found["eth", "12", "ade"].margin_m == pytest.approx(0.25)
    hotel = found["hotel", "12", "ade"]
    assert not hotel.won
    assert (hotel.best, hotel.best_method) == (0.33, "cvm")
    assert not found["zara1", "12", "ade"].won  # a draw is no win
    won = sum(margin.won for margin in found.values())
    sentence = margins_sentence(run())
    assert f"{won} of 30 cells" in sentence
    assert "ADE Hotel@12 by 0.070 m" in sentence
    assert margins_sentence(run(offset=-0.2)).endswith("30 of 30 cells.")
    assert margins({}) == ()


def test_ours_stand_below_the_papers():
    results = combine([run(offset=0.0), run(offset=0.02), run("weighted"), run("pcgan_paper", 0.5)])
    layout = table_1(results, "ade")
    rows = {(row.label, row.source): row.cells for row in layout.rows}
    eth_12 = layout.columns.index(("ETH", "@12"))
    assert rows["PCGAN", "paper"][eth_12].text == "0.65"
    assert rows["PCGAN", "ours"][eth_12].text == "0.410"
    assert rows["PCGAN", "±"][eth_12].text == "0.014"
    assert rows["weighted velocity", "ours"][eth_12].best
    assert not rows["PCGAN", "ours"][eth_12].best
    assert rows["PCGAN, paper recipe", "ours"][eth_12].text == "0.900"
    difference = rows["PCGAN − paper's best", ""][eth_12]
    assert (difference.text, difference.better) == ("-0.240", True)
    hotel_12 = layout.columns.index(("Hotel", "@12"))
    assert rows["CVM", "paper"][hotel_12].best  # the best of all, ours included
    assert rows["SGAN", "paper"][layout.columns.index(("Hotel", "@8"))].text == "0.55²"
    assert len(layout.notes) == 3


@pytest.mark.parametrize("metric", METRICS)
def test_the_terminals_table_is_whole_at_140_columns(metric):
    results = combine([run(offset=0.0), run(offset=0.02), run("lin"), run("sgan_paper")])
    text = text_of(table_1(results, metric))
    assert "…" not in text
    assert all(f"{paper_tables.figure('sgan', s, '12', metric):.2f}" in text for s in SCENES)


def test_every_table_is_whole_at_140_columns():
    figures = dict.fromkeys(tables.FIGURE_NAMES, 1.2345) | {"true_collision_rate": 0.02}
    scenes = (*SCENES, "vci", "vci_near", "dut_long", "usyd")
    results = combine([{m: {s: {"8": figures, "12": figures} for s in scenes} for m in tables.METHOD_NAMES}] * 2)
    found = layouts(results)
    assert len(found) == 3 + 1 + 5
    for layout in found:
        assert "…" not in text_of(layout), layout.title
        assert max(len(line.rstrip()) for line in text_of(layout).splitlines()) <= 140


def test_vehicle_table_shows_what_there_is():
    results = combine([run(scenes=("vci", "vci_near"))])
    layout = table_2(results)
    assert ("VCI <5m", "ADE") in layout.columns
    assert ("VCI 4.8s", "ADE") not in layout.columns
    rows = {(row.label, row.source): row.cells for row in layout.rows}
    assert rows["PCGAN", "paper"][layout.columns.index(("VCI", "FDE"))].text == "0.15"
    assert rows["PCGAN", "paper"][layout.columns.index(("VCI <5m", "FDE"))].text == ""
    assert [layout.title for layout in layouts(results)] == [
        "Vehicle and crowd: errors in m after 12 steps",
        "All figures: VCI, 12 steps",
        "All figures: VCI <5m, 12 steps",
    ]


def test_simulated_drives_are_not_held_against_the_papers():
    layout = table_2(combine([run("pcgan", -0.39, scenes=("vci", "usyd"))]))
    rows = {(row.label, row.source): row.cells for row in layout.rows}
    vci, usyd = layout.columns.index(("VCI", "ADE")), layout.columns.index(("USyd", "ADE"))
    assert rows["PCGAN", "ours"][usyd].text == rows["PCGAN", "ours"][vci].text == "0.010"
    assert rows["PCGAN", "ours"][vci].best
    assert not rows["PCGAN", "paper"][vci].best
    assert not rows["PCGAN", "ours"][usyd].best
    assert rows["PCGAN", "paper"][usyd].best
    assert rows["PCGAN − paper's best", ""][usyd].text == ""


def test_best_coverage_is_the_nearest_to_its_share():
    results = {
        name: {"mean": {"12": cell(0.4, coverage_90=held, area_90_m2=area)}}
        for name, held, area in (("lin", 0.97, 1.0), ("cvm", 0.88, 2.0), ("weighted", 0.6, 3.0))
    }
    layout = tables.figures_table(results, "mean", "12")
    held = layout.columns.index(("in 90", "%"))
    area = layout.columns.index(("area", "m²"))
    assert [row.cells[held].best for row in layout.rows] == [False, True, False]
    assert not any(row.cells[area].best for row in layout.rows)
    assert layout.rows[1].cells[held].text == "88.0"


def test_markdown_has_every_cell_and_bold_bests():
    layout = table_1(combine([run()]), "fde")
    text = markdown(layout)
    assert text.startswith("### ETH/UCY: FDE in m")
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in lines} == {len(layout.columns) + 3}
    assert "| PCGAN | ours | **0.400** | **0.800** |" in text
    assert "| CVM | paper | 0.87 | 1.34 |" in text
    assert layout.notes[0] in text
