"""The evaluation as one HTML page: tables, plots and pictured scenes, with nothing outside the file."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from pathlib import Path

from pcgan import paper_tables, report_curves, report_scenes, tables
from pcgan.report_scenes import SceneExample
from pcgan.report_style import ReportError
from pcgan.scores import Curves
from pcgan.tables import Cell, Layout, Results

__all__ = ["ReportData", "ReportError", "SceneExample", "html", "write_report"]


@dataclass(frozen=True, eq=False)
class ReportData:
    """What a report shows; what is empty is left out."""

    results: Results
    curves: Mapping[str, Mapping[str, Curves]]  # by data set, as its heading says, and method
    examples: Sequence[SceneExample]
    lineage: Mapping[str, str]  # models, seeds, commit, data: what the figures come from
    title: str = "Pedestrian prediction: every method against the paper"


@dataclass(frozen=True)
class _Section:
    anchor: str
    heading: str
    parts: tuple[str, ...]


def write_report(data: ReportData, path: Path) -> None:
    """Writes the page; raises ReportError if matplotlib is missing or the file cannot be written."""
    page = html(data)
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(page, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise ReportError(f"{path} cannot be written: {error.strerror or error}") from error


def html(data: ReportData) -> str:
    """Returns the page; raises ReportError if matplotlib is missing."""
    sections = list(_sections(data))
    contents = "".join(f'<li><a href="#{s.anchor}">{escape(s.heading)}</a></li>' for s in sections)
    body = "".join(
        f'<section id="{s.anchor}"><h2>{escape(s.heading)}</h2>{"".join(s.parts)}</section>' for s in sections
    )
    lineage = "".join(f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>" for key, value in data.lineage.items())
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(data.title)}</title><style>{_STYLE}</style></head><body>"
        f"<header><h1>{escape(data.title)}</h1><p>{_summary(data.results)}</p><nav><ol>{contents}</ol></nav></header>"
        f"<main>{body}</main><footer><h2>Where these figures come from</h2><dl>{lineage}</dl></footer></body></html>\n"
    )


def _sections(data: ReportData) -> Iterator[_Section]:
    for number, layout in enumerate(tables.layouts(data.results)):
        parts = (_paragraph(layout.explanation), _table(layout))
        yield _Section(f"table-{number + 1}", layout.title, parts)
    for number, (dataset, curves) in enumerate(data.curves.items()):
        if curves:
            yield _Section(f"curves-{number + 1}", f"Error, likelihood and calibration: {dataset}", _plots(curves))
    if data.examples:
        pictures = [
            _paragraph(
                "Scenes from above, chosen by a rule from test windows. Left: the mixtures of all steps, each shaded "
                "relative to its peak, and over them the tree of modal paths, a colour per pedestrian. Right: the most "
                "probable path of each method, and where few people take part, the whole tree of PSGAN and PCGAN. Grid "
                "lines are 1 m apart."
            )
        ]
        for example in data.examples:
            picture = _image(report_scenes.pictured(example, _main_method(example)), example.title)
            caption = f"<figcaption>{escape(example.caption)}</figcaption>"
            pictures.append(f"<h3>{escape(example.title)}</h3><figure>{picture}{caption}</figure>")
        yield _Section("scenes", "Pictured scenes", tuple(pictures))


def _summary(results: Results) -> str:
    """Returns the page's first words, as HTML."""
    if not tables.margins(results):
        return "Errors of the most probable path, likelihoods and calibration; best figures in bold."
    sentences = []
    if ours := results["pcgan"].get("mean", {}).get("12"):
        means = {metric: paper_tables.best("mean", "12", metric) for metric in ("ade", "fde")}
        figures = [f"{m.upper()} <b>{ours[m]:.3f} m</b> (against {best[0]:.3f} m)" for m, best in means.items() if best]
        sentences.append(
            f"After 12 steps PCGAN has {' and '.join(figures)}, mean over the five ETH/UCY scenes; in brackets the "
            "mean of each scene's best figure in the paper."
        )
    return " ".join([*sentences, escape(tables.margins_sentence(results))])


def _plots(curves: Mapping[str, Curves]) -> tuple[str, ...]:
    return (
        _paragraph("How error and negative log-likelihood grow with time, over everybody scored at the last step."),
        f"<figure>{_image(report_curves.against_time(curves), 'error and likelihood against time')}</figure>",
        _paragraph(
            "Calibration: a region of highest density that should hold so much of the probability holds so many of the "
            "truths. Above the diagonal the mixtures are too wide, below it too narrow."
        ),
        f"<figure>{_image(report_curves.reliability(curves), 'reliability of each method')}</figure>",
    )


def _main_method(example: SceneExample) -> str:
    """Returns whose mixtures are pictured: PCGAN's, or the last method's."""
    return "pcgan" if "pcgan" in example.forecasts else list(example.forecasts)[-1]


def _table(layout: Layout) -> str:
    has_source = any(row.source for row in layout.rows)
    lead = 2 if has_source else 1
    groups = [(name, len(list(run))) for name, run in groupby(first for first, _ in layout.columns)]
    starts = {sum(size for _, size in groups[:index]) for index in range(len(groups))}
    over = "".join(f'<th colspan="{size}" class="group">{escape(name)}</th>' for name, size in groups)
    under = "".join(
        f'<th class="{"start" if i in starts else ""}">{escape(second)}</th>'
        for i, (_, second) in enumerate(layout.columns)
    )
    lines = []
    previous = ""
    for row in layout.rows:
        first = row.label != previous
        previous = row.label
        kind = {"paper": "paper", "ours": "ours", "±": "spread", "": "ours" if not has_source else "margin"}[row.source]
        source = f"<th>{escape(row.source)}</th>" if has_source else ""
        cells = "".join(_cell(cell, i in starts) for i, cell in enumerate(row.cells))
        lines.append(
            f'<tr class="{kind}{" first" if first else ""}"><th>{escape(row.label) if first else ""}</th>'
            f"{source}{cells}</tr>"
        )
    notes = "".join(f"<p class='note'>{escape(note)}</p>" for note in layout.notes)
    blank = f'<th colspan="{lead}"></th>'
    return (
        f'<div class="scroll"><table><thead><tr>{blank}{over}</tr><tr>{blank}{under}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>{notes}"
    )


def _cell(cell: Cell, start: bool) -> str:
    kinds = ["start"] if start else []
    if cell.better is not None:
        kinds.append("better" if cell.better else "worse")
    text = f"<b>{escape(cell.text)}</b>" if cell.best else escape(cell.text)
    return f'<td class="{" ".join(kinds)}">{text}</td>'


def _image(address: str, description: str) -> str:
    return f'<img src="{address}" alt="{escape(description, quote=True)}">'


def _paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


_STYLE = """
:root{--ink:#1f2328;--faint:#6e7781;--line:#e3e6ea;--soft:#f6f8fa;--good:#116329;--bad:#9a6700}
*{box-sizing:border-box}
body{margin:0;color:var(--ink);background:#fff;font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
header,main,footer{max-width:1200px;margin:0 auto;padding:0 28px}
header{padding-top:40px}
h1{font-size:30px;line-height:1.2;margin:0 0 12px}
h2{font-size:20px;margin:48px 0 6px;padding-top:14px;border-top:1px solid var(--line)}
h3{font-size:16px;margin:32px 0 4px}
p{max-width:880px;margin:6px 0 14px}
a{color:#0b5cc4;text-decoration:none}a:hover{text-decoration:underline}
nav ol{columns:2;column-gap:36px;padding-left:22px;margin:18px 0 0;font-size:14.5px}
nav li{break-inside:avoid;margin:2px 0}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-size:13.5px;font-variant-numeric:tabular-nums}
th,td{padding:3px 7px;text-align:right;white-space:nowrap;font-weight:400}
thead th{font-weight:600;border-bottom:1px solid var(--line)}
thead tr:first-child th{border-bottom:0;padding-bottom:0}
th.group{text-align:center}
tbody th{text-align:left}tbody th:first-child{font-weight:600;padding-left:2px}
tbody th:nth-child(2){color:var(--faint);font-size:12px}
tr.first>*{border-top:1px solid var(--line)}
tr.paper td{color:var(--faint)}
tr.paper td b{color:var(--ink)}
tr.spread td,tr.spread th{color:var(--faint);font-size:12px}
tr.margin{background:var(--soft)}
td.start,thead th.start{padding-left:14px}
td b{font-weight:700}
td.better{color:var(--good)}td.worse{color:var(--bad)}
.note{font-size:13px;color:var(--faint);margin:2px 0}
figure{margin:10px 0 26px}
figure img{max-width:100%;height:auto;display:block}
figcaption{font-size:14px;color:var(--faint);max-width:880px;margin-top:4px}
footer{padding-bottom:60px;font-size:14px}
dl{display:grid;grid-template-columns:max-content 1fr;gap:4px 18px}
dt{color:var(--faint)}dd{margin:0;overflow-wrap:anywhere}
@media print{section{break-inside:avoid}nav{display:none}}
"""
