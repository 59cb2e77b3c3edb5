"""What `pcgan check` prints: a line per case, then what is wrong in words; of a sweep, the variants side by side."""

from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from statistics import fmean

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from replay.check_result import CaseResult, Judged, Status
from replay.expectations import Expectation, figures, known_figures, parse_expectation
from replay.reference import words

MOST_CHANGES = 6  # settings that differ from the reference's; the JSON has all
SWEEP_FIGURES = (
    "tracks",
    "ground_truth.hota",
    "ground_truth.id_switches",
    "ground_truth.missed",
    "ground_truth.false",
    "ade_m",
    "nll",
    "ground_truth.ade_m",
    "ground_truth.nll",
)  # shown of every sweep, beside what is expected
ERRORS = frozenset({"ade_m", "fde_m", "mhd_m", "nll"})  # over as far as the model looks ahead
WIDEST = 1000
OWN_WAY = "suite"  # how the suite's own settings are called beside its variants
_STYLES = {Status.CHANGED: "red", Status.UNMET: "red", Status.ERROR: "red", Status.UNREFERENCED: "yellow"}


def print_check(results: Sequence[CaseResult], console: Console) -> None:
    """Prints the cases, what is wrong with them, and how many went how."""
    variants = list(dict.fromkeys(result.variant for result in results))
    own = [result for result in results if not result.variant]
    _print_cases(own, console)
    if len(variants) > 1:
        print_sweep(results, console)
    for result in results:
        for line in _problem_lines(result):
            console.print(line, soft_wrap=True, highlight=False)
    counts = Counter(result.status for result in results)
    parts = [f"{counts[status]} {status}" for status in Status if counts[status]]
    of = _counted(len(own), "case")
    of = f"{len(results)} replays of {of}" if len(variants) > 1 else of
    console.print(f"[bold]{of}[/]: {', '.join(parts)}", soft_wrap=True, highlight=False)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


# --- a line per case -------------------------------------------------------------------------------------------------


def _print_cases(results: Sequence[CaseResult], console: Console) -> None:
    """Prints a row per case, in a terminal with the columns for which there is room: those with something wrong first.

    A pipe gets all.
    """
    missed = {_figure(judged): False for result in results for judged in result.judged}
    for result in results:
        for judged in result.judged:
            missed[_figure(judged)] |= not judged.met
    shown, took_s, dropped = list(missed), True, list[str]()
    table = _case_table(results, shown, took_s=took_s)
    while console.is_terminal and _width(table, console) > console.width and (shown or took_s):
        if took_s:
            took_s = False
            dropped.append("took s")
        else:
            least = next((each for each in reversed(shown) if not missed[each]), shown[-1])
            shown.remove(least)
            dropped.append(_name(least))
        table = _case_table(results, shown, took_s=took_s)
    _print_whole(table, console)
    if dropped:
        line = f"not shown, as the window is narrow: {', '.join(dropped[::-1])}"
        console.print(f"[dim]{escape(line)}[/]", highlight=False, soft_wrap=True)


def _case_table(results: Sequence[CaseResult], shown: Sequence[str], *, took_s: bool) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 2, 0, 0))
    for column in ("case", "status"):
        table.add_column(column, no_wrap=True)
    for column in (*(["took s"] if took_s else []), *(_name(figure).replace(".", "\n.") for figure in shown)):
        table.add_column(escape(column), justify="right", no_wrap=True)
    for result in results:
        before = figures(result.reference_summary)
        took = f"{result.wall_s:.1f}" if result.summary else ""
        table.add_row(
            escape(result.case),
            Text(result.status, _STYLES.get(result.status, "green")),
            *([took] if took_s else []),
            *(_figure_cell([each for each in result.judged if _figure(each) == figure], before) for figure in shown),
        )
    return table


def _figure(judged: Judged) -> str:
    return parse_expectation(judged.text).figure


def _name(figure: str) -> str:
    """Returns a figure's name as short as an expectation may have it."""
    short = figure.removeprefix("ground_truth.")
    return figure if short in known_figures() else short


def _print_whole(table: Table, console: Console) -> None:
    """Prints a table with all its columns, if need be wider than the console."""
    console.width = max(console.width, _width(table, console))
    console.print(table)


def _width(table: Table, console: Console) -> int:
    return console.measure(table, options=console.options.update(width=WIDEST)).maximum


def _figure_cell(judged: Sequence[Judged], before: Mapping[str, float]) -> Text:
    """Returns a figure, what was asked for if it is not that, and what the reference had if that is otherwise."""
    if not judged:
        return Text()
    value = judged[0].value
    cell = Text(_number(value))
    if bounds := [f"{wanted.symbol} {wanted.number:g}" for wanted in _missed(judged)]:
        cell = Text(f"✗ {_number(value)} ({', '.join(bounds)})", "red")
    former = before.get(_figure(judged[0]))
    if former is not None and _number(former) != _number(value):
        cell.append(f"\nwas {_number(former)}", "dim")
    return cell


def _missed(judged: Sequence[Judged]) -> list[Expectation]:
    return [parse_expectation(each.text) for each in judged if not each.met]


def _problem_lines(result: CaseResult) -> Iterator[str]:
    """Yields what there is to know about a case that did not pass; rich markup."""
    if result.status.passed or result.status is Status.UNREFERENCED:  # of which the table says all
        return
    name = f"{result.case}, {result.variant}" if result.variant else result.case
    yield f"[{_STYLES[result.status]}]{escape(name)}: {result.status}[/]: {escape(result.problem)}"
    if result.details:
        yield "  that is a fault of ours, not of the log; --json and --junit hold the traceback"
    if result.diff is not None:
        first = result.diff.first
        for topic in result.diff.topics:
            if topic.first is not None and topic.first != first:
                yield f"  {escape(words(topic.first))}"
    unmet = [judged for judged in result.judged if not judged.met]
    if unmet and result.status is not Status.UNMET:
        yield f"  not met: {escape(', '.join(f'{each.text} ({_number(each.value)})' for each in unmet))}"
    changed = result.reference.changed if result.reference is not None else ()
    for change in changed[:MOST_CHANGES]:
        yield f"  since the reference: {escape(change)}"
    if len(changed) > MOST_CHANGES:
        yield f"  and {_counted(len(changed) - MOST_CHANGES, 'more change')} of settings; --json has them all"


# --- variants side by side -------------------------------------------------------------------------------------------


def print_sweep(results: Sequence[CaseResult], console: Console) -> None:
    """Prints figures by variant, each beside its difference from the suite's own way: per case, and their mean."""
    variants = list(dict.fromkeys(result.variant for result in results))
    wanted = _sweep_figures(results)
    values = {(result.case, result.variant): figures(result.summary) for result in results}
    otherwise = _looking_otherwise(results)
    cases = list(dict.fromkeys(result.case for result in results))
    for case in cases:
        console.print()
        found = {name: values[case, name] for name in variants}
        _print_whole(_sweep_table(case, wanted, variants, found, otherwise), console)
    if len(cases) > 1:
        mean = mean_figures(results)
        whole = sum(all(values[case, name] for name in variants) for case in cases)
        console.print()
        _print_whole(_sweep_table(f"mean of {_counted(whole, 'case')}", wanted, variants, mean, otherwise), console)
    console.print()
    for line in otherwise.values():
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _looking_otherwise(results: Sequence[CaseResult]) -> dict[str, str]:
    """Returns the variants whose errors are not to be compared with the suite's, and why not."""
    own = {result.case: (result.steps, result.step_s) for result in results if not result.variant and result.steps}
    found: dict[str, str] = {}
    for result in results:
        steps, step_s = own.get(result.case, (0, 0.0))
        if steps and result.steps and (result.steps, result.step_s) != (steps, step_s):
            found.setdefault(
                result.variant,
                f"{result.variant}: no differences of {', '.join(sorted(ERRORS))}, as its model looks ahead "
                f"{result.steps} steps of {result.step_s:g} s, and the suite's {steps} of {step_s:g} s",
            )
    return found


def mean_figures(results: Sequence[CaseResult]) -> dict[str, dict[str, float]]:
    """Returns variant -> figure -> mean over the cases in which every variant has that figure."""
    variants = list(dict.fromkeys(result.variant for result in results))
    by_case: dict[str, dict[str, dict[str, float]]] = {}
    for result in results:
        by_case.setdefault(result.case, {})[result.variant] = figures(result.summary)
    means: dict[str, dict[str, float]] = {name: {} for name in variants}
    for figure in {figure for case in by_case.values() for found in case.values() for figure in found}:
        rows = [case for case in by_case.values() if all(figure in case.get(name, {}) for name in variants)]
        if rows:
            for name in variants:
                means[name][figure] = fmean(row[name][figure] for row in rows)
    return {name: dict(sorted(found.items())) for name, found in means.items()}


def _sweep_figures(results: Sequence[CaseResult]) -> list[str]:
    asked = [parse_expectation(judged.text).figure for result in results for judged in result.judged]
    return list(dict.fromkeys([*asked, *SWEEP_FIGURES]))


def _sweep_table(
    title: str,
    wanted: Sequence[str],
    variants: Sequence[str],
    found: Mapping[str, Mapping[str, float]],
    otherwise: Container[str],
) -> Table:
    table = Table(
        title=escape(title),
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 2, 0, 0),
    )
    table.add_column("figure", no_wrap=True)
    for name in variants:
        table.add_column(escape(name or OWN_WAY), justify="right", no_wrap=True)
    for figure in wanted:
        values = [found[name].get(figure) for name in variants]
        if all(value is None for value in values):
            continue
        base = found[variants[0]].get(figure)
        error = figure.rpartition(".")[2] in ERRORS
        bases = [None if error and name in otherwise else base for name in variants]
        table.add_row(figure, *map(_delta_cell, values, bases))
    return table


def _delta_cell(value: float | None, base: float | None) -> Text:
    cell = Text(_number(value))
    if value is not None and base is not None and value != base:
        change = f"{value - base:+.3f}" if isinstance(value - base, float) else f"{value - base:+d}"
        cell.append(f" ({change})", "dim")
    return cell


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else f"{value}"
