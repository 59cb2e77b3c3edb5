"""The report is one whole page: every cell, every picture, nothing from outside."""

import base64
import re
import struct
import sys
from html import unescape
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from pcgan import report_scenes, tables
from pcgan.forecast import Extrapolation, Forecast, certain_path
from pcgan.modal_paths import ModalPaths
from pcgan.paper_tables import SCENES
from pcgan.report import ReportData, ReportError, SceneExample, html, write_report
from pcgan.report_curves import mean_curves
from pcgan.scene_choice import Scene
from pcgan.scores import SHARES, Curves

METHODS = ("lin", "cvm", "weighted", "psgan", "pcgan", "pcgan_paper")


def make_results():
    rng = np.random.default_rng(0)

    def figures():
        return {name: float(rng.uniform(0.1, 0.9)) for name in (*tables.FIGURE_NAMES, "true_collision_rate")}

    scenes = (*SCENES, "vci", "vci_near", "dut_long")
    runs = [{m: {s: {"8": figures(), "12": figures()} for s in scenes} for m in METHODS} for _ in range(2)]
    return tables.combine(runs)


def make_curves(offset=0.0):
    times = 0.4 * np.arange(1, 13)
    return Curves(times, 0.2 * times + offset, times - 2, SHARES, SHARES**0.8)


@pytest.fixture(scope="module")
def example():
    """Two people meet, a third stands by, a vehicle comes; PCGAN forks."""
    steps = np.arange(-7, 13)[:, None] * [0.4, 0.0]
    walks = np.stack([steps, [5.0, 0.2] - steps, 0 * steps + [2.0, -3.0]]).astype(np.float32)
    vehicle = np.full((3, 8, 4), np.nan, np.float32)
    vehicle[:2] = [-6.0, 0.0, 3.0, 0.5]
    future = walks[:, 8:].copy()
    future[2, 3:] = np.nan
    velocity = np.float32([[1, 0], [-1, 0], [0, 0]])
    scene = Scene(walks[:, :8], np.ones((3, 8), bool), velocity, future, vehicle, np.array([0, 1]), 0.4)
    observation = scene.observation()
    cvm = Extrapolation("cvm", 12, 0.4, torch.linspace(0.1, 0.8, 12))
    path = cvm.path(observation)
    side = torch.linspace(0, 1.5, 12)[:, None] * torch.tensor([0.0, 1.0])
    fork = ModalPaths(torch.tensor([0.7, 0.3, 0.0]).expand(3, 3), torch.stack([path, path + side, path], dim=-3))
    forked = Forecast(certain_path(path, cvm.sigmas_m).mixture, fork)
    forecasts = {"cvm": cvm.forecast(observation, torch.Generator()), "psgan": forked, "pcgan": forked}
    return SceneExample("Oncoming <pair>", "Two & one.", scene, forecasts)


@pytest.fixture(scope="module")
def data(example):
    curves = {method: make_curves(0.1 * i) for i, method in enumerate(METHODS)}
    lineage = {"models": "pcgan-eth <v1>", "seeds": "0, 1", "commit": "abc1234", "data": "ETH/UCY, sha256 00ff"}
    return ReportData(make_results(), {"ETH/UCY": curves, "VCI": dict(list(curves.items())[:2])}, [example], lineage)


@pytest.fixture(scope="module")
def page(data):
    return html(data)


def images(page):
    return re.findall(r'<img src="data:image/([^;]+);base64,([^"]+)"', page)


def test_every_cell_is_there(data, page):
    page = unescape(re.sub(r"</?b>", "", page))
    for layout in tables.layouts(data.results):
        assert layout.title in page
        assert layout.explanation in page
        for row in layout.rows:
            assert row.label in page
            for cell in row.cells:
                assert f">{cell.text}</td>" in page, (layout.title, row.label, cell)
        assert all(note in page for note in layout.notes)
    assert tables.margins_sentence(data.results) in page


def test_the_best_of_each_column_is_bold(data, page):
    bold = sum(cell.best for layout in tables.layouts(data.results) for row in layout.rows for cell in row.cells)
    assert len(re.findall(r"<td[^>]*><b>", page)) == bold > 30


def test_tables_have_as_many_cells_in_each_line(page):
    for table in re.findall(r"<table>.*?</table>", page, re.DOTALL):
        root = ElementTree.fromstring(table)
        widths = {sum(int(cell.get("colspan", 1)) for cell in line) for line in root.iter("tr")}
        assert len(widths) == 1


def test_pictures_are_whole(page):
    """Two plots for each data set as SVG, and each scene as a PNG."""
    kinds = []
    for kind, text in images(page):
        kinds.append(kind)
        content = base64.b64decode(text, validate=True)
        if kind == "svg+xml":
            assert ElementTree.fromstring(content).tag.endswith("svg")
        else:
            assert content.startswith(b"\x89PNG")
            assert content.endswith(b"IEND\xaeB`\x82")
            width, height = struct.unpack(">II", content[16:24])
            assert width > 1200
            assert height > 300
    assert kinds == ["svg+xml"] * 4 + ["png"]


def test_nothing_is_loaded_from_outside(page):
    page = re.sub(r"base64,[^\"]+", "", page)
    assert "http" not in page
    assert "<script" not in page
    assert "<link" not in page
    assert not re.search(r"url\(", page)


def test_contents_lead_somewhere_and_text_is_escaped(data, page):
    anchors = re.findall(r'href="#([^"]+)"', page)
    assert len(anchors) == len(tables.layouts(data.results)) + 3
    assert all(f'id="{anchor}"' in page for anchor in anchors)
    assert "Oncoming &lt;pair&gt;" in page
    assert "Two &amp; one." in page
    assert "pcgan-eth &lt;v1&gt;" in page
    assert all(value.split()[0] in page for value in data.lineage.values())


def test_equal_data_give_equal_pages(data, page):
    assert html(data) == page


def test_an_empty_report_is_a_page_too(tmp_path):
    path = tmp_path / "report.html"
    write_report(ReportData({}, {}, [], {}), path)
    assert path.read_text().startswith("<!DOCTYPE html>")
    assert list(tmp_path.iterdir()) == [path]


def test_a_scene_without_our_method_shows_another(example, data):
    others = SceneExample(example.title, example.caption, example.scene, {"cvm": example.forecasts["cvm"]})
    page = html(ReportData(data.results, {}, [others], {}))
    assert len(images(page)) == 1
    assert report_scenes.pictured(others, "cvm").startswith("data:image/png;base64,")


def test_mean_of_curves():
    mean = mean_curves([make_curves(0.0), make_curves(0.2)])
    np.testing.assert_allclose(mean.error_m, make_curves(0.1).error_m)
    np.testing.assert_allclose(mean.coverage, make_curves().coverage)


def test_a_folder_that_is_not_there_is_named(data, tmp_path):
    with pytest.raises(ReportError, match=r"report\.html cannot be written: No such file"):
        write_report(data, tmp_path / "none" / "report.html")


def test_without_matplotlib_the_error_says_what_to_install(data, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ReportError, match=r"needs matplotlib.*pcgan\[view\]"):
        html(data)
