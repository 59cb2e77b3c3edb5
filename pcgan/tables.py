"""Our results beside the paper's, cell by cell: laid out once, then printed to a terminal, as Markdown or as HTML.

Results are plain nested dictionaries, as in the JSON file: method -> scene -> horizon in steps, as a string -> figure.
Scenes are eth, hotel, univ, zara1, zara2 and their "mean"; vci, vci_near (within 5 m of the vehicle) and dut_long
(2.5 Hz, 4.8 s); usyd, which are simulated drives. With several seeds a figure is their mean, and "<figure>_std" their
standard deviation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from pcgan import paper_tables
from pcgan.paper_tables import METRICS, SCENES

Figures = Mapping[str, float]
Results = Mapping[str, Mapping[str, Mapping[str, Figures]]]
Column = tuple[str, str, str]  # scene, horizon, metric

METHOD_NAMES = {
    "lin": "Lin",
    "cvm": "CVM",
    "weighted": "weighted velocity",
    "sgan": "SGAN",
    "srlstm": "SR-LSTM",
    "psgan": "PSGAN",
    "pcgan": "PCGAN",
    "sgan_paper": "SGAN, paper recipe",
    "srlstm_paper": "SR-LSTM, paper recipe",
    "psgan_paper": "PSGAN, paper recipe",
    "pcgan_paper": "PCGAN, paper recipe",
    "pcgan_no_vehicle": "PCGAN without vehicle",
    "anchored": "anchored fit",
    "state": "tracker's state",
}
SCENE_NAMES = {
    "eth": "ETH",
    "hotel": "Hotel",
    "univ": "Univ",
    "zara1": "Zara1",
    "zara2": "Zara2",
    "mean": "mean",
    "eth_10frame": "ETH, 10-frame file",
    "vci": "VCI",
    "vci_near": "VCI <5m",
    "dut_long": "DUT 4.8s",
    "dut_long_near": "DUT 4.8s <5m",
    "usyd": "USyd",
    "usyd_near": "USyd <5m",
    "usyd_long": "USyd 4.8s",
    "usyd_long_near": "USyd 4.8s <5m",
}
VEHICLE_SCENES = ("vci", "vci_near", "dut_long", "dut_long_near", "usyd", "usyd_near", "usyd_long", "usyd_long_near")
FIGURE_NAMES = {  # in two lines
    "ade": ("", "ADE"),
    "fde": ("", "FDE"),
    "mhd": ("", "MHD"),
    "min_ade": ("min", "ADE"),
    "min_fde": ("min", "FDE"),
    "min_ade_20": ("min20", "ADE"),
    "min_fde_20": ("min20", "FDE"),
    "nll": ("", "NLL"),
    "kde_nll": ("KDE", "NLL"),
    "miss_rate": ("missed", "%"),
    "collision_rate": ("collide", "%"),
    "coverage_50": ("in 50", "%"),
    "coverage_90": ("in 90", "%"),
    "coverage_95": ("in 95", "%"),
    "area_90_m2": ("area", "m²"),
    "modal_paths": ("modal", "paths"),
}
_WANTED = {"coverage_50": 0.5, "coverage_90": 0.9, "coverage_95": 0.95}  # best is nearest
_NEITHER = ("area_90_m2", "modal_paths")  # neither high nor low is good in itself
_NOT_COMPARED = ("usyd",)  # ours are other drives than the paper's
_MARKS = "¹²³"
_PERCENT = ("miss_rate", "collision_rate", *_WANTED)


@dataclass(frozen=True)
class Cell:
    """One figure, or none."""

    text: str = ""
    best: bool = False  # the best of its column
    better: bool | None = None  # in rows of differences: on our side or not


@dataclass(frozen=True)
class Row:
    """A line of a table: whose figures, and where from."""

    label: str
    source: str  # "paper", "ours", "±" or ""
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Layout:
    """A table to be printed."""

    title: str
    explanation: str
    columns: tuple[tuple[str, str], ...]  # two lines of heading; equal first lines side by side are one
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Margin:
    """One cell of Table 1: ours against the best of all the paper's methods."""

    scene: str
    horizon: str
    metric: str
    ours: float
    best: float
    best_method: str

    @property
    def margin_m(self) -> float:
        """By how much ours is better; negative where it is worse."""
        return self.best - self.ours

    @property
    def won(self) -> bool:
        """Whether ours is better."""
        return self.ours < self.best


def combine(runs: Sequence[Results]) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    """Returns one set of results of those of several seeds: means, and where there are two or more, spreads.

    A run need not hold every method. The mean over the five scenes is added per run, so that its spread is its own.
    """
    complete = [_with_mean(run) for run in runs]
    combined: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for method, scene, horizon in dict.fromkeys(
        (m, s, h) for run in complete for m in run for s in run[m] for h in run[m][s]
    ):
        cells = [run[method][scene][horizon] for run in complete if horizon in run.get(method, {}).get(scene, {})]
        figures: dict[str, float] = {}
        for name in cells[0]:
            values = [cell[name] for cell in cells]
            figures[name] = float(np.mean(values))
            if len(values) > 1 and name != "pedestrians":
                figures[f"{name}_std"] = float(np.std(values, ddof=1))
        combined.setdefault(method, {}).setdefault(scene, {})[horizon] = figures
    return combined


def margins(results: Results, method: str = "pcgan") -> tuple[Margin, ...]:
    """Returns ours against the best of the paper in each of the 30 cells of Table 1 that the results have."""
    found = []
    for scene, horizon, metric in paper_tables.table_1_cells():
        ours, best = _figure(results, method, scene, horizon, metric), paper_tables.best(scene, horizon, metric)
        if ours is not None and best is not None:
            found.append(Margin(scene, horizon, metric, ours, *best))
    return tuple(found)


def margins_sentence(results: Results, method: str = "pcgan") -> str:
    """Returns in words where ours is better than the best of all the paper's methods, and where it is not."""
    cells = margins(results, method)
    lost = sorted((cell for cell in cells if not cell.won), key=lambda cell: cell.margin_m)
    sentence = (
        f"{METHOD_NAMES.get(method, method)} is better than the best of all the paper's methods in "
        f"{len(cells) - len(lost)} of {len(cells)} cells."
    )
    if lost:
        misses = [f"{c.metric.upper()} {SCENE_NAMES[c.scene]}@{c.horizon} by {-c.margin_m:.3f} m" for c in lost]
        sentence += f" Not in: {', '.join(misses)}."
    return sentence


def table_1(results: Results, metric: str) -> Layout:
    """Returns the paper's Table 1 for one metric, both horizons: the paper's figures, and ours below them."""
    columns = [(scene, horizon, metric) for scene in (*SCENES, "mean") for horizon in ("8", "12")]
    return _beside_the_paper(
        results,
        columns,
        title=f"ETH/UCY: {metric.upper()} in m after 8 and 12 steps (3.2 and 4.8 s)",
        explanation=f"{_MEANINGS[metric]} Each scene is predicted by a model that was trained without it.",
        names=tuple((SCENE_NAMES[scene], f"@{horizon}") for scene, horizon, _ in columns),
    )


def table_2(results: Results) -> Layout:
    """Returns the paper's Table 2, and beside it the windows near the vehicle and the long task."""
    scenes = [
        scene for scene in ("vci", "vci_near", "dut_long", "usyd") if _has(results, scene) or scene in ("vci", "usyd")
    ]
    columns = [(scene, "12", metric) for scene in scenes for metric in METRICS]
    return _beside_the_paper(
        results,
        columns,
        title="Vehicle and crowd: errors in m after 12 steps",
        explanation=(
            "VCI is DUT at 12 Hz, 1.0 s ahead; the paper's split is unknown, ours keeps whole clips apart. "
            "“<5m” counts only people who come that near to the vehicle; “4.8s” is the long task, at 2.5 Hz on clips "
            "held out from everything. "
            "USyd is not public: ours are simulated drives, and not to be compared with the paper's."
        ),
        names=tuple((SCENE_NAMES[scene], metric.upper()) for scene, _, metric in columns),
    )


def figures_table(results: Results, scene: str, horizon: str) -> Layout:
    """Returns every figure of all our methods on one scene, or on the mean of the five."""
    methods = [method for method in _ordered(results) if horizon in results[method].get(scene, {})]
    columns = [name for name in FIGURE_NAMES if any(name in results[m][scene][horizon] for m in methods)]
    values = {(m, name): results[m][scene][horizon].get(name) for m in methods for name in columns}
    best = {name: _best_of(name, [values[m, name] for m in methods]) for name in columns}
    rows = []
    for m in methods:
        cells = [Cell(_text(name, values[m, name]), _same(name, values[m, name], best[name])) for name in columns]
        rows.append(Row(METHOD_NAMES.get(m, m), "", tuple(cells)))
    truth = [results[m][scene][horizon].get("true_collision_rate") for m in methods]
    known = [value for value in truth if value is not None]
    notes = (f"What people really did: {100 * known[0]:.1f} % collide.",) if known else ()
    where = "mean of the five scenes" if scene == "mean" else SCENE_NAMES.get(scene, scene)
    return Layout(
        f"All figures: {where}, {horizon} steps",
        "Errors in m; min: of the modal path nearest to the truth; min20: of the nearest of 20 samples. NLL: nats per "
        "step, of the mixture; KDE NLL: of a kernel estimate from samples. Missed: more than 2 m off at the end. "
        "Collide: nearer than 0.2 m to somebody. In 50, 90, 95: steps within the region that should hold so many per "
        "cent; area: of the 90 % one. Modal paths: per pedestrian.",
        tuple(FIGURE_NAMES[name] for name in columns),
        tuple(rows),
        notes,
    )


def layouts(results: Results) -> tuple[Layout, ...]:
    """Returns every table that the results can fill."""
    tables: list[Layout] = []
    if any(_has(results, scene) for scene in SCENES):
        tables += [table_1(results, metric) for metric in METRICS]
    if any(_has(results, scene) for scene in VEHICLE_SCENES):
        tables.append(table_2(results))
    for scene in ("mean", "eth_10frame", *VEHICLE_SCENES):
        if _has(results, scene, "12"):
            tables.append(figures_table(results, scene, "12"))
    if not _has(results, "mean", "12"):
        tables += [figures_table(results, scene, "12") for scene in SCENES if _has(results, scene, "12")]
    return tuple(tables)


def rich_table(layout: Layout) -> Table:
    """Returns a table for a terminal of 140 columns; the best of each column is bold."""
    table = Table(title=layout.title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("", no_wrap=True)
    if any(row.source for row in layout.rows):
        table.add_column("", no_wrap=True, style="dim")
    for name in layout.columns:
        table.add_column("\n".join(name), justify="right", no_wrap=True)
    previous = ""
    for row in layout.rows:
        label = "" if row.label == previous else row.label
        previous = row.label
        cells = [Text(cell.text, style=_style(cell, row)) for cell in row.cells]
        sources = [row.source] if len(table.columns) == len(cells) + 2 else []
        table.add_row(label, *sources, *cells)
    if layout.notes:
        table.caption, table.caption_justify = "\n".join(layout.notes), "left"
    return table


def markdown(layout: Layout) -> str:
    """Returns a table as Markdown, with its title as a heading."""
    lines = [f"### {layout.title}", "", layout.explanation, ""]
    has_source = any(row.source for row in layout.rows)
    head = ["", *([""] if has_source else []), *(" ".join(name).strip() for name in layout.columns)]
    lines.append("| " + " | ".join(head) + " |")
    lines.append("|---" * (len(head) - len(layout.columns)) + "|---:" * len(layout.columns) + "|")
    for row in layout.rows:
        cells = [f"**{cell.text}**" if cell.best else cell.text for cell in row.cells]
        lines.append("| " + " | ".join([row.label, *([row.source] if has_source else []), *cells]) + " |")
    if layout.notes:
        lines += ["", *(f"{note}  " for note in layout.notes)]
    return "\n".join(lines) + "\n"


_MEANINGS = {
    "ade": "ADE: distance between the most probable path and the truth, mean over the steps.",
    "fde": "FDE: distance between the most probable path and the truth at the last step.",
    "mhd": "MHD: modified Hausdorff distance; it forgives a path that is right but early or late.",
}


def _beside_the_paper(
    results: Results, columns: Sequence[Column], title: str, explanation: str, names: tuple[tuple[str, str], ...]
) -> Layout:
    """Lays out figures of (scene, horizon, metric) columns: for each method the paper's, ours, and our spread."""
    paper = {m: [paper_tables.figure(m, *column) for column in columns] for m in paper_tables.METHODS}
    ours = {m: [_figure(results, m, *column) for column in columns] for m in _ordered(results)}
    ours = {m: values for m, values in ours.items() if any(value is not None for value in values)}
    best = []
    for i, (scene, _, _) in enumerate(columns):
        rivals = paper if scene in _NOT_COMPARED else paper | {f"our {m}": values for m, values in ours.items()}
        best.append(_best_of("ade", [values[i] for values in rivals.values()]))
    notes: dict[str, str] = {}
    rows = []
    for m in dict.fromkeys((*METHOD_NAMES, *ours)):
        label = METHOD_NAMES.get(m, m)
        if m in paper:
            cells = [_paper_cell(m, c, v, t, notes) for c, v, t in zip(columns, paper[m], best, strict=True)]
            rows.append(Row(label, "paper", tuple(cells)))
        if m in ours:
            cells = [
                Cell(_text("ade", value), column[0] not in _NOT_COMPARED and _same("ade", value, top))
                for column, value, top in zip(columns, ours[m], best, strict=True)
            ]
            rows.append(Row(label, "ours", tuple(cells)))
            spread = [_figure(results, m, scene, horizon, f"{metric}_std") for scene, horizon, metric in columns]
            if any(value is not None for value in spread):
                rows.append(Row(label, "±", tuple(Cell("" if v is None else f"{v:.3f}") for v in spread)))
    if "pcgan" in ours:
        cells = [_difference(column, value) for column, value in zip(columns, ours["pcgan"], strict=True)]
        rows.append(Row("PCGAN − paper's best", "", tuple(cells)))
    return Layout(title, explanation, names, tuple(rows), tuple(f"{mark} {reason}" for reason, mark in notes.items()))


def _paper_cell(method: str, column: Column, value: float | None, best: float | None, notes: dict[str, str]) -> Cell:
    """Returns a printed figure, marked where it is suspect; `notes` collects the reasons and their marks."""
    if value is None:
        return Cell()
    reason = paper_tables.suspect(method, *column)
    if reason is not None and reason not in notes:
        notes[reason] = _MARKS[len(notes)]
    mark = "" if reason is None else notes[reason]
    return Cell(f"{value:.2f}{mark}", best is not None and round(value, 2) <= round(best, 3))


def _difference(column: Column, ours: float | None) -> Cell:
    """Returns ours minus the best of the paper."""
    best = None if column[0] in _NOT_COMPARED else paper_tables.best(*column)
    if ours is None or best is None:
        return Cell()
    return Cell(f"{ours - best[0]:+.3f}", better=ours < best[0])


def _with_mean(run: Results) -> Results:
    """Adds the mean over the five scenes to each method that has them all."""
    extended = {}
    for method, scenes in run.items():
        extended[method] = dict(scenes)
        if all(scene in scenes for scene in SCENES):
            means: dict[str, dict[str, float]] = {}
            for horizon in scenes[SCENES[0]]:
                cells = [scenes[scene][horizon] for scene in SCENES]
                means[horizon] = {name: float(np.mean([cell[name] for cell in cells])) for name in cells[0]}
                if "pedestrians" in means[horizon]:
                    means[horizon]["pedestrians"] = sum(cell["pedestrians"] for cell in cells)
            extended[method]["mean"] = means
    return extended


def _figure(results: Results, method: str, scene: str, horizon: str, name: str) -> float | None:
    return results.get(method, {}).get(scene, {}).get(horizon, {}).get(name)


def _has(results: Results, scene: str, horizon: str | None = None) -> bool:
    return any(scene in scenes and (horizon is None or horizon in scenes[scene]) for scenes in results.values())


def _ordered(results: Results) -> list[str]:
    return [m for m in METHOD_NAMES if m in results] + sorted(m for m in results if m not in METHOD_NAMES)


def _best_of(name: str, values: Sequence[float | None]) -> float | None:
    """Returns the best value of a figure, as it is printed; None if there is nothing to win."""
    found = [value for value in values if value is not None]
    if len(found) < 2 or name in _NEITHER:
        return None
    return min(found, key=lambda value: abs(value - _WANTED[name]) if name in _WANTED else value)


def _same(name: str, value: float | None, best: float | None) -> bool:
    return value is not None and best is not None and _text(name, value) == _text(name, best)


def _text(name: str, value: float | None) -> str:
    if value is None:
        return ""
    if name in _PERCENT:
        return f"{100 * value:.1f}"
    return f"{value:.2f}" if name in ("nll", "kde_nll", *_NEITHER) else f"{value:.3f}"


def _style(cell: Cell, row: Row) -> str:
    if cell.better is not None:
        return "green" if cell.better else "yellow"
    return "bold" if cell.best else "dim" if row.source == "±" else ""
