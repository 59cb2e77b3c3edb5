"""The page of a check: what passed, what changed and by how much, and the worst moments with pictures. Plain files.

It needs no network, no server and no scripts: `index.html`, a page per case, and their pictures. Links to rerun work
once `pcgan report FOLDER` serves the folder; without that they lead to a page that says so.
"""

import hashlib
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from urllib.parse import quote, urlencode

from jinja2 import Environment, PackageLoader, StrictUndefined

from replay.check_result import CaseResult, ErrorSlice, Moment, MomentKind, Status, WorstOf, horizon_name
from replay.check_table import OWN_WAY, mean_figures
from replay.errors import OutputError
from replay.expectations import figures
from replay.moment_ranking import NEAR, RANGES, TURNING, Slice, range_slice
from replay.part_file import write_whole
from replay.reference import words

MOST_MOMENTS = 24  # of each kind, of all cases together; each case's own page has its own
MOST_OF_SLICE = 3  # of each kind within a slice, of all cases together
LONGEST_NAME = 60  # of a case's folder
HEADINGS = {
    MomentKind.ERROR: "Largest prediction errors",
    MomentKind.MISSED: "Missed people",
    MomentKind.SWITCH: "Id switches",
}
_SLICED = ("horizon", "range", "turning", "near the vehicle", "speed")
_HEARD = {Status.CHANGED: "bad", Status.UNMET: "bad", Status.ERROR: "bad", Status.UNREFERENCED: "warn"}


@dataclass(frozen=True)
class Figure:
    """A number of a replay's summary, and which way is better."""

    name: str  # dotted, as in an expectation
    label: str
    unit: str = ""
    better: int = 0  # 1: more is better, -1: less
    digits: int = 0

    def text(self, value: float | None) -> str:
        """Returns the number with its unit; a dash where there is none."""
        return "–" if value is None else f"{value:.{self.digits}f}{self.unit and ' ' + self.unit}"


FIGURES = (
    Figure("ground_truth.hota", "HOTA", "", 1, 3),
    Figure("ground_truth.mota", "MOTA", "", 1, 3),
    Figure("ground_truth.idf1", "IDF1", "", 1, 3),
    Figure("ground_truth.id_switches", "id switches", "", -1),
    Figure("ground_truth.missed", "missed", "", -1),
    Figure("ground_truth.false", "false", "", -1),
    Figure("ground_truth.ade_m", "ADE, truth", "m", -1, 3),
    Figure("ground_truth.fde_m", "FDE, truth", "m", -1, 3),
    Figure("ground_truth.nll", "NLL, truth", "", -1, 2),
    Figure("ade_m", "ADE, tracks", "m", -1, 3),
    Figure("fde_m", "FDE, tracks", "m", -1, 3),
    Figure("nll", "NLL, tracks", "", -1, 2),
    Figure("tracks", "tracks"),
    Figure("predictions", "predictions"),
    Figure("fallbacks", "fallbacks"),
    Figure("refused", "refused", "", -1),
)
_WITH_TRUTH = ("ground_truth.hota", "ground_truth.id_switches", "ground_truth.missed", "ground_truth.ade_m")
_WITHOUT = ("tracks", "ade_m", "fde_m")


@dataclass(frozen=True)
class Cell:
    """A figure of one case beside the reference's."""

    figure: Figure
    value: str
    was: str = ""  # the reference's, where it is another
    change: str = ""  # "+0.012"
    verdict: str = ""  # better, worse, or empty: neither


@dataclass(frozen=True)
class Card:
    """A moment as the page shows it."""

    moment: Moment
    case: str
    page: str  # link to the case's page
    picture: str  # link, or empty
    rerun: str  # link, or empty
    position: str  # "7.4 m away, ahead and to the left"
    errors_m: Mapping[str, float]  # by horizon
    slices: frozenset[Slice]  # what it is in, or stands for
    anchor: str = ""  # the card's name on its page
    worst_of: tuple[str, ...] = ()  # slices of which the page has nothing worse


@dataclass(frozen=True)
class Row:
    """A slice as the page shows it."""

    slice: ErrorSlice
    percent: float  # length of its bar
    anchor: str  # the card of its worst; empty if there is none


def case_folder(folder: Path, case: str, variant: str) -> Path:
    """Returns a case's own folder within the page's: a name that is safe in files and links, another for each case."""
    name = f"{case}--{variant}" if variant else case
    safe = re.sub(r"[^a-z0-9._-]+", "_", name.lower()).strip("._")[:LONGEST_NAME]
    if not safe or safe != name or "--" in case or "--" in variant:  # what was cut or replaced could make two cases one
        digest = hashlib.sha256("\0".join((case, variant)).encode(errors="replace")).hexdigest()
        safe = f"{safe or 'case'}-{digest[:8]}"
    return folder / "cases" / safe


def write_page(
    results: Sequence[CaseResult], folder: Path, *, title: str = "pcgan check", date: str | None = None
) -> Path:
    """Writes the page of a check into a folder, and returns its `index.html`.

    The same results give the same bytes. Pictures and recordings are linked where they lie within the folder.

    Raises:
        OutputError: the folder cannot be written.
    """
    environment = Environment(
        loader=PackageLoader("replay"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    common: dict[str, object] = {
        "title": title,
        "date": date,
        "version": version("pcgan"),
        "heard": _HEARD,
        "words": words,
        "ranges": RANGES,
        "near": NEAR,
        "turning": TURNING,
    }
    index = folder / "index.html"
    pages = {index: environment.get_template("check.html.j2").render(common | _index(results, folder))}
    for result in results:
        path = case_folder(folder, result.case, result.variant) / "index.html"
        pages[path] = environment.get_template("check_case.html.j2").render(common | _case(result, folder))
    pages[folder / "rerun" / "index.html"] = environment.get_template("check_rerun.html.j2").render(common)
    for path, text in pages.items():
        _write(path, text)
    return index


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
    write_whole(path, text.encode(errors="replace"))


# --- what the templates are filled with ------------------------------------------------------------------------------


def _index(results: Sequence[CaseResult], folder: Path) -> dict[str, object]:
    variants = list(dict.fromkeys(result.variant for result in results))
    own = [result for result in results if not variants or result.variant == variants[0]]
    shown = _figures_of(results)
    cards = _ranked([card for result in own for card in _cards(result, folder, folder)], MOST_MOMENTS)
    counts = {status: sum(result.status is status for result in results) for status in Status}
    return {
        "passed": sum(result.status.passed for result in results),
        "counts": {status: count for status, count in counts.items() if count},
        "models": sorted({_model(result.summary) for result in results} - {""}),
        "rows": [
            {
                "result": result,
                "page": _link(case_folder(folder, result.case, result.variant) / "index.html", folder),
                "cells": _cells(result, shown),
                "first": _first(result),
            }
            for result in results
        ],
        "figures": shown,
        "sweep": _sweep(results, variants),
        "variants": [variant or OWN_WAY for variant in variants],
        "cards": cards,
        "horizons": _horizons(cards),
        "cases": sorted({_name(result) for result in own if result.moments}),
        "headings": HEADINGS,
        "slices": _by_kind(_merged(result.slices for result in own), cards),
        "drawn": any(moment.picture for result in results for moment in result.moments),
        "any_rerun": any(result.recording for result in results),
    }


def _case(result: CaseResult, folder: Path) -> dict[str, object]:
    own = case_folder(folder, result.case, result.variant)
    cards = _ranked(_cards(result, folder, own), None)
    return {
        "result": result,
        "name": _name(result),
        "first": _first(result),
        "model": _model(result.summary),
        "cells": _cells(result, [figure for figure in FIGURES if figure.name in figures(result.summary)]),
        "cards": cards,
        "horizons": _horizons(cards),
        "cases": [],
        "headings": HEADINGS,
        "slices": _by_kind(_merged([result.slices]), cards),
        "drawn": any(moment.picture for moment in result.moments),
        "any_rerun": result.recording is not None,
        "home": "../../index.html",
    }


def _name(result: CaseResult) -> str:
    return f"{result.case}, {result.variant}" if result.variant else result.case


def _model(summary: Mapping[str, object]) -> str:
    model = summary.get("model")
    if not isinstance(model, Mapping) or not model.get("name"):
        return ""
    return f"{model['name']} ({str(model.get('sha256', ''))[:8]})"


def _first(result: CaseResult) -> str:
    """Returns what to say about a case in a line: its problem, or the first difference that is tolerated or not."""
    if result.problem:
        return result.problem
    first = result.diff.first if result.diff is not None else None
    return words(first) if first is not None else ""


def _figures_of(results: Sequence[CaseResult]) -> list[Figure]:
    known = {name for result in results for name in figures(result.summary)}
    wanted = _WITH_TRUTH if any(name in known for name in _WITH_TRUTH) else _WITHOUT
    return [figure for figure in FIGURES if figure.name in wanted and figure.name in known]


def _cells(result: CaseResult, shown: Sequence[Figure]) -> list[Cell]:
    now, before = figures(result.summary), figures(result.reference_summary)
    return [_cell(figure, now.get(figure.name), before.get(figure.name)) for figure in shown]


def _cell(figure: Figure, value: float | None, before: float | None) -> Cell:
    text, was = figure.text(value), figure.text(before)
    if value is None or before is None or text == was:
        return Cell(figure, text)
    gain = (value - before) * figure.better
    verdict = "better" if gain > 0 else "worse" if gain < 0 else ""
    return Cell(figure, text, was, f"{value - before:+.{figure.digits}f}".replace("-", "−"), verdict)


def _sweep(results: Sequence[CaseResult], variants: Sequence[str]) -> list[list[Cell]]:
    """Returns a row per figure with the mean of each variant, beside the first variant's; none without a sweep."""
    if len(variants) < 2:
        return []
    means = mean_figures(results)
    fine = [replace(figure, digits=max(figure.digits, 1)) for figure in FIGURES]  # a mean of counts is no whole number
    return [
        [_cell(figure, means[variant].get(figure.name), means[variants[0]].get(figure.name)) for variant in variants]
        for figure in fine
        if any(figure.name in means[variant] for variant in variants)
    ]


def _cards(result: CaseResult, folder: Path, page_folder: Path) -> list[Card]:
    page = _link(case_folder(folder, result.case, result.variant) / "index.html", page_folder)
    rerun = _link(folder / "rerun" / "index.html", page_folder)
    recording = _inside(result.recording, folder)
    return [
        Card(
            moment,
            _name(result),
            page,
            _link(moment.picture, page_folder) if moment.picture and _inside(moment.picture, folder) else "",
            f"{rerun}?{urlencode({'recording': recording, 'stamp_ns': moment.stamp_ns})}" if recording else "",
            _position(moment),
            {horizon_name(ahead_s): error_m for ahead_s, error_m in moment.horizon_errors_m}
            | {each.value: each.size for each in moment.worst_of if each.by == "horizon"},
            frozenset(
                [range_slice(moment.range_m), *[(each.by, each.value) for each in moment.worst_of]]
                + [NEAR] * moment.near_vehicle
                + [TURNING] * moment.turning
            ),
        )
        for moment in result.moments
    ]


def _ranked(cards: Iterable[Card], most: int | None) -> dict[MomentKind, list[Card]]:
    """Returns the worst of each kind and of each slice, worst first; of equals those near the vehicle first."""
    ordered = sorted(cards, key=lambda card: (-card.moment.size, card.moment.range_m, card.case, card.moment.stamp_ns))
    by_kind = {}
    for kind in MomentKind:
        found = [card for card in ordered if card.moment.kind is kind]
        slices = _slices_of(found)
        few = {number for numbers in slices.values() for number in numbers[:MOST_OF_SLICE]}
        by_kind[kind] = [
            replace(
                card,
                anchor=f"{kind.name.lower()}-{number + 1}",
                worst_of=tuple(
                    _spoken(each, card.moment)
                    for each in card.moment.worst_of
                    if slices[each.by, each.value][0] == number
                ),
            )
            for number, card in enumerate(found)
            if most is None or number < most or number in few
        ]
    return {kind: found for kind, found in by_kind.items() if found}


def _slices_of(cards: Sequence[Card]) -> dict[tuple[str, str], list[int]]:
    """Returns which cards are among the worst of each slice, worst first."""
    slices: dict[tuple[str, str], list[tuple[float, int]]] = {}
    for number, card in enumerate(cards):
        for each in card.moment.worst_of:
            slices.setdefault((each.by, each.value), []).append((-each.size, number))
    return {each: list(dict.fromkeys(number for _, number in sorted(found))) for each, found in slices.items()}


def _spoken(worst: WorstOf, moment: Moment) -> str:
    """Returns a slice in words, with the error there if it is not the moment's own."""
    words_of = {NEAR: f"{worst.value} of the vehicle", TURNING: f"turning {worst.value}"}
    ahead = " ahead" if worst.by == "horizon" else ""
    text = words_of.get((worst.by, worst.value), worst.value + ahead)
    return text if worst.size == moment.size else f"{text} ({worst.size:.2f} m)"


def _horizons(cards: Mapping[MomentKind, Sequence[Card]]) -> list[str]:
    """Returns the horizons that cards can be ordered by."""
    moments = [card.moment for found in cards.values() for card in found]
    names = {each.value for moment in moments for each in moment.worst_of if each.by == "horizon"}
    return sorted(names, key=_first_number)


def _position(moment: Moment) -> str:
    """Returns where somebody is as the vehicle sees it, in words."""
    along = "ahead" if moment.ahead_m >= 0 else "behind"
    aside = "left" if moment.left_m >= 0 else "right"
    if abs(moment.left_m) < 0.4 * abs(moment.ahead_m):
        where = along
    elif abs(moment.ahead_m) < 0.4 * abs(moment.left_m):
        where = f"on the {aside}"
    else:
        where = f"{along} on the {aside}"
    return f"{moment.range_m:.1f} m away, {where}"


def _merged(slices: Iterable[Sequence[ErrorSlice]]) -> list[ErrorSlice]:
    """Returns the slices of several cases as if they were one."""
    sums: dict[tuple[str, str], tuple[int, float, float]] = {}
    for each in (each for case in slices for each in case):
        count, total, worst = sums.get((each.by, each.value), (0, 0.0, 0.0))
        total += each.count * each.ade_m
        sums[each.by, each.value] = count + each.count, total, max(worst, each.worst_m)
    merged = [ErrorSlice(by, value, n, total / n, worst) for (by, value), (n, total, worst) in sums.items() if n]
    return sorted(merged, key=lambda each: _first_number(each.value))


def _first_number(text: str) -> float:
    """Returns what slices of one kind are ordered by: "10 to 20 m" comes before "over 30 m"; words come last."""
    found = re.search(r"\d+(\.\d+)?", text)
    return float(found[0]) if found else math.inf


def _by_kind(slices: Sequence[ErrorSlice], cards: Mapping[MomentKind, Sequence[Card]]) -> dict[str, list[Row]]:
    """Returns the slices by what they are of, each with the length of its bar and the card of its worst."""
    longest = max((each.ade_m for each in slices), default=0.0) or 1.0
    shown = cards.get(MomentKind.ERROR, [])
    anchors = {each: shown[numbers[0]].anchor for each, numbers in _slices_of(shown).items()}
    return {
        by: [
            Row(each, round(100 * each.ade_m / longest, 1), anchors.get((each.by, each.value), ""))
            for each in slices
            if each.by == by
        ]
        for by in sorted({each.by for each in slices}, key=lambda by: (_SLICED.index(by) if by in _SLICED else 99, by))
    }


def _inside(path: Path | None, folder: Path) -> str:
    """Returns a path relative to the folder it lies in; empty if it does not."""
    if path is None or not path.resolve().is_relative_to(folder.resolve()):
        return ""
    return path.resolve().relative_to(folder.resolve()).as_posix()


def _link(path: Path, page_folder: Path) -> str:
    """Returns a relative link from a page in that folder."""
    return quote(Path(os.path.relpath(path.resolve(), page_folder.resolve())).as_posix())
