"""The cases of a suite, replayed in worker processes, compared with their references and judged: `pcgan check`.

A worker does a case whole (`run_case`) in a scratch folder. References, outputs that are kept, and the page's pictures
and recordings are put in their places when every case has been replayed: whoever presses Ctrl-C finds all as it was.
Results come in the suite's order, whatever the number of workers.
"""

import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, TypeVar

from replay.check_result import CaseResult, Judged, Status
from replay.diff_result import Tolerances
from replay.errors import OutputError
from replay.expectations import Expectation
from replay.frame_result import FrameResult
from replay.interrupts import Interrupts
from replay.log_reader import LogReader
from replay.log_source import LogSource, local_copy
from replay.moments import Moments
from replay.part_file import write_whole
from replay.reference import ENDING, BadReference, Comparison, compare, reference_path, write_reference
from replay.replay_job import ReplayJob, run_job
from replay.rerun_view import RerunView
from replay.session import ReplaySettings
from replay.settings_file import SettingsError
from replay.suite import Case, Suite, Variant
from replay.workers import Failure, run_jobs

T = TypeVar("T")
OUTPUT_ENDING = ".pcgan.mcap"
SCRATCH = ".pcgan-check-"  # how the names of folders begin that vanish
PICTURES, RECORDING = "pictures", "replay.rrd"  # in a case's own folder in the page


class Rerun(StrEnum):
    """Which cases of a page get a rerun recording."""

    CHANGED = "changed"  # those that differ from their reference or do not meet an expectation
    ALL = "all"
    NONE = "none"


@dataclass(frozen=True)
class CheckOptions:
    """What a check does beside replaying and comparing."""

    workers: int = 1
    only: tuple[str, ...] = ()  # names or globs of cases; empty: all
    reason: str | None = None  # why differing and missing references are written; None: they are not
    keep: Path | None = None  # folder for the outputs
    page: Path | None = None  # folder of the page, for pictures and recordings
    rerun: Rerun = Rerun.ALL
    sweep: bool = False  # try the suite's variants, too


@dataclass(frozen=True)
class Check:
    """What came of it."""

    results: tuple[CaseResult, ...]  # case by case in the suite's order, the suite's own way before its variants
    references: tuple[Path, ...] = ()  # written
    notes: tuple[str, ...] = ()  # what else there is to say, a line each

    @property
    def passed(self) -> bool:
        """True unless somebody has to look at it."""
        return all(result.status.passed for result in self.results)


@dataclass(frozen=True)
class Task:
    """One case in one way; what a worker is sent."""

    case: str
    variant: str
    logs: tuple[LogSource, ...]
    shown: tuple[str, ...]
    settings: ReplaySettings
    model: str | None
    salvage: bool
    expect: tuple[Expectation, ...]
    tolerances: Tolerances
    reference: Path | None  # None: it is compared with nothing
    scratch: Path
    reason: str | None = None  # a reference that would differ is written as `candidate`
    keep: bool = False  # the output stays
    page: Path | None = None  # what the worker takes for the page's folder

    @property
    def name(self) -> str:
        """The case's name, and the variant's."""
        return f"{self.case}.{self.variant}" if self.variant else self.case

    @property
    def output(self) -> Path:
        """Where the worker writes the output."""
        return self.scratch / f"{self.name}{OUTPUT_ENDING}"

    @property
    def candidate(self) -> Path:
        """Where the worker writes what may become the reference."""
        return self.scratch / f"{self.name}{ENDING}"

    @property
    def folder(self) -> Path | None:
        """The case's own folder in the page."""
        return None if self.page is None else self.folder_in(self.page)

    def folder_in(self, page: Path) -> Path:
        """Returns the case's own folder in a page's."""
        from replay.check_page import case_folder  # templates are loaded only where there is a page

        return case_folder(page, self.case, self.variant)


def check_suite(
    suite: Suite, options: CheckOptions, on_progress: Callable[[int, int], None] = lambda _done, _all: None
) -> Check:
    """Replays a suite's cases and says what came of each; see CheckOptions for what else is done.

    Args:
        suite: what `read_suite` returned.
        options: see there.
        on_progress: is told how many replays have been judged, and how many there are.

    Raises:
        SettingsError: `only` names no case.
        OutputError: a reference or an output cannot be written, or would be written over a recording.
    """
    cases = _chosen(suite, options.only)
    with ExitStack() as stack:
        scratch = stack.enter_context(_scratch(options.keep))
        page = None if options.page is None else stack.enter_context(_scratch(options.page))
        tasks = [task for case in cases for task in _tasks(suite, case, options, scratch, page)]
        _refuse_overwriting(suite, tasks, options)
        problems = {case.name: case.problem for case in cases if case.problem}
        results = {
            i: _error(task, Failure(problems[task.case])) for i, task in enumerate(tasks) if task.case in problems
        }
        on_progress(len(results), len(tasks))
        todo = [i for i in range(len(tasks)) if i not in results]
        for i, outcome in _done([tasks[i] for i in todo], run_case, options.workers):
            task = tasks[todo[i]]
            results[todo[i]] = _error(task, outcome) if isinstance(outcome, Failure) else outcome
            on_progress(len(results), len(tasks))
        notes = []
        wanted = [i for i in todo if is_drawn(results[i], options)]
        for i, drawn in _done([tasks[i] for i in wanted], draw_case, options.workers):
            if isinstance(drawn, Failure):
                notes.append(f"{tasks[wanted[i]].name} has no rerun recording: {drawn.problem}")
            else:
                results[wanted[i]] = replace(results[wanted[i]], recording=drawn)
        written = []
        with Interrupts() as interrupts, _one_line():
            interrupts.ignore()  # all references of a check are written, or none
            if options.page is not None:
                for i, task in enumerate(tasks):
                    results[i] = _in_page(results[i], task, options.page)
            for i, task in enumerate(tasks):
                # of a worker that failed behind its replay a candidate is left, too
                if task.reference is not None and task.candidate.exists() and results[i].status is not Status.ERROR:
                    results[i] = _accepted(results[i], known=task.reference.exists())
                    task.reference.parent.mkdir(parents=True, exist_ok=True)
                    write_whole(task.reference, task.candidate.read_bytes())
                    written.append(task.reference)
                if options.keep is not None and task.output.exists():
                    kept = options.keep / task.output.name
                    task.output.replace(kept)
                    results[i] = replace(results[i], output=kept)
    if not options.only and not problems:
        notes += [f"{path} is the reference of no case in {suite.path}" for path in _stale(suite)]
    return Check(tuple(results[i] for i in range(len(tasks))), tuple(written), tuple(sorted(notes)))


def is_drawn(result: CaseResult, options: CheckOptions) -> bool:
    """Tells whether a case gets a rerun recording for the page."""
    if options.page is None or result.status is Status.ERROR:
        return False
    changed = result.status in {Status.CHANGED, Status.UNMET}
    return options.rerun is Rerun.ALL or (options.rerun is Rerun.CHANGED and changed)


def _chosen(suite: Suite, only: Sequence[str]) -> list[Case]:
    for pattern in only:
        if not any(fnmatchcase(case.name, pattern) for case in suite.cases):
            names = ", ".join(case.name for case in suite.cases)
            raise SettingsError(f"no case of {suite.path} is called {pattern}; its cases are {names}")
    return [case for case in suite.cases if not only or any(fnmatchcase(case.name, pattern) for pattern in only)]


def _refuse_overwriting(suite: Suite, tasks: Sequence[Task], options: CheckOptions) -> None:
    """Raises OutputError of what could not be written, or would be written over a recording, before it is too late."""
    recordings = {source.path.resolve() for case in suite.cases for source in case.logs if source.path is not None}
    targets = [task.reference for task in tasks if options.reason is not None and task.reference is not None]
    targets += [options.keep / task.output.name for task in tasks if options.keep is not None]
    with _one_line():
        if suite.references.exists() and not suite.references.is_dir():
            raise OutputError(f"the references' folder {suite.references} is a file; choose another")
        for target in targets:
            if target.resolve() in recordings:
                raise OutputError(f"{target} is a recording of the suite, which is never overwritten; rename the case")


@contextmanager
def _one_line() -> Iterator[None]:
    """Turns an OSError into an OutputError that names the file."""
    try:
        yield
    except OSError as error:
        name = error.filename2 or error.filename
        raise OutputError(f"{name} cannot be written: {error.strerror or error}") from error


def _tasks(suite: Suite, case: Case, options: CheckOptions, scratch: Path, page: Path | None) -> Iterator[Task]:
    variants = {"": Variant(), **(suite.sweep if options.sweep else {})}
    for name, variant in variants.items():
        yield Task(
            case.name,
            name,
            case.logs,
            case.shown,
            suite.settings_of(case, variant),
            variant.model or suite.model,
            suite.salvage,
            case.expect,
            suite.tolerances,
            None if name else reference_path(suite.references, case.name),
            scratch,
            options.reason,
            options.keep is not None,
            page,
        )


@contextmanager
def _scratch(beside: Path | None) -> Iterator[Path]:
    """Gives a folder that vanishes, in the one that its files go to: renaming them is then no copying.

    Folders that were made for it and are empty at the end vanish, too.
    """
    missing = [] if beside is None else [each for each in (beside, *beside.parents) if not each.exists()]
    try:
        if beside is not None:
            beside.mkdir(parents=True, exist_ok=True)
        folder = tempfile.TemporaryDirectory(prefix=SCRATCH, dir=beside, ignore_cleanup_errors=True)
    except OSError as error:
        raise OutputError(f"{beside or tempfile.gettempdir()} cannot be written: {error.strerror or error}") from error
    try:
        with folder as name:
            yield Path(name)
    finally:
        with suppress(OSError):  # the first that is not empty ends it
            for made in missing:
                made.rmdir()


def _in_page(result: CaseResult, task: Task, page: Path) -> CaseResult:
    """Moves a case's pictures and recording into the page, over those of an older one; returns where they are now."""
    assert task.folder is not None, "a page has a folder for each case"
    drawn, shown = task.folder, task.folder_in(page)
    if (shown / PICTURES).exists():
        shutil.rmtree(shown / PICTURES)
    (shown / RECORDING).unlink(missing_ok=True)
    for name in (PICTURES, RECORDING):
        if (drawn / name).exists():
            shown.mkdir(parents=True, exist_ok=True)
            (drawn / name).replace(shown / name)

    def moved(path: Path | None) -> Path | None:
        return None if path is None else shown / path.relative_to(drawn)

    moments = tuple(replace(moment, picture=moved(moment.picture)) for moment in result.moments)
    return replace(result, moments=moments, recording=moved(result.recording))


def is_page_or_free(folder: Path) -> bool:
    """Tells whether a folder may become a page's: it is not there, is empty, or holds an older page."""
    index, rerun = folder / "index.html", folder / "rerun" / "index.html"
    with _one_line():
        if not folder.exists() or all(each.name.startswith(SCRATCH) for each in folder.iterdir()):
            return True
        written = index.is_file() and rerun.is_file() and (folder / "cases").is_dir()  # by `write_page`
        return written and b"pcgan" in index.read_bytes()


def _done(tasks: Sequence[Task], work: Callable[[Task], T], workers: int) -> Iterator[tuple[int, T | Failure]]:
    if tasks:
        with closing(run_jobs(work, tasks, min(workers, len(tasks)))) as outcomes:
            yield from outcomes


def _error(task: Task, failure: Failure) -> CaseResult:
    problem = in_suite_words(failure.problem)
    return CaseResult(task.case, task.variant, task.shown, Status.ERROR, problem, details=failure.traceback)


def in_suite_words(problem: str) -> str:
    """Returns an error with what a suite says in place of options that only other commands have."""
    problem = problem.replace("try --salvage", "say salvage: true in the suite")
    problem = re.sub(r"--tracks ([^\s;,]+)", r"roles: {tracks: \1} in the settings", problem)
    return re.sub(r"--role ([a-z_]+):=([^\s;,]+)", r"roles: {\1: \2} in the settings", problem)


def _accepted(result: CaseResult, *, known: bool) -> CaseResult:
    """Returns the result of a case whose reference is being written; what it does not meet, it still does not meet."""
    if unmet := _unmet(result.judged):
        return replace(result, status=Status.UNMET, problem=unmet)
    return replace(result, status=Status.UPDATED if known else Status.NEW, problem="")


def _stale(suite: Suite) -> tuple[Path, ...]:
    wanted = {reference_path(suite.references, case.name) for case in suite.cases}
    return tuple(path for path in sorted(suite.references.glob(f"*{ENDING}")) if path not in wanted)


# --- in a worker -----------------------------------------------------------------------------------------------------


def run_case(task: Task) -> CaseResult:
    """Replays a case and judges it; raises what `run_job` and `compare` raise."""
    started = time.perf_counter()
    with ExitStack() as stack:
        paths = tuple(stack.enter_context(local_copy(source, task.scratch)) for source in task.logs)
        moments = Moments(LogReader(paths, salvage=task.salvage).start_ns)
        ahead: list[tuple[int, float]] = []  # how far the first prediction looks; all of a replay look as far

        def on_frame(frame: FrameResult) -> None:
            moments.add(frame)
            if not ahead and frame.predictions.predictions:
                steps = len(frame.predictions.predictions[0].mixture.weights)
                ahead.append((steps, frame.predictions.dt_s))

        summary = run_job(_job(task, paths), on_frame=on_frame).as_json()
    judged = tuple(expectation.judge(summary) for expectation in task.expect)
    comparison = _compared(task, summary)
    if task.reason is not None and comparison.status in {Status.CHANGED, Status.UNREFERENCED}:
        _write_candidate(task, summary)
    if not task.keep:
        task.output.unlink()
    worst, slices = moments.finish(None if task.folder is None else task.folder / PICTURES)
    status, problem = _status(comparison, judged)
    steps, step_s = ahead[0] if ahead else (0, 0.0)
    return CaseResult(
        task.case,
        task.variant,
        task.shown,
        status,
        problem,
        summary,
        judged,
        comparison.reference,
        comparison.reference_summary,
        comparison.diff,
        tuple(worst),
        tuple(slices),
        wall_s=time.perf_counter() - started,
        log_s=float(str(summary["log_s"])),
        steps=steps,
        step_s=step_s,
    )


def draw_case(task: Task) -> Path:
    """Replays a case once more, into a rerun recording, and returns that; replays repeat, so this shows the same."""
    assert task.folder is not None, "recordings belong to a page"
    task.folder.mkdir(parents=True, exist_ok=True)
    recording = task.folder / RECORDING
    again = replace(task, scratch=task.scratch / "again")
    with ExitStack() as stack:
        paths = tuple(stack.enter_context(local_copy(source, task.scratch)) for source in task.logs)
        run_job(_job(again, paths), RerunView.to_file(recording, task.name))
    again.output.unlink()
    return recording


def _job(task: Task, paths: tuple[Path, ...]) -> ReplayJob:
    return ReplayJob(paths, task.output, task.settings, task.model, task.salvage)


def _compared(task: Task, summary: dict[str, Any]) -> Comparison:
    """Compares with the reference; one that cannot be read is an error, unless it is about to be written anew."""
    if task.reference is None:
        return Comparison(Status.MET)
    try:
        return compare(task.reference, task.output, summary, task.tolerances)
    except BadReference as error:
        if task.reason is None:
            raise
        return Comparison(Status.CHANGED, str(error))


def _write_candidate(task: Task, summary: dict[str, Any]) -> None:
    """Writes what is to become the reference, beside a copy of the one before, whose reasons it keeps."""
    assert task.reference is not None
    assert task.reason is not None
    if task.reference.exists():
        shutil.copyfile(task.reference, task.candidate)
    write_reference(task.candidate, task.output, summary, task.reason)


def _status(comparison: Comparison, judged: Sequence[Judged]) -> tuple[Status, str]:
    unmet = _unmet(judged)
    if comparison.status is Status.CHANGED or not unmet:
        return comparison.status, comparison.problem
    return Status.UNMET, unmet


def _unmet(judged: Sequence[Judged]) -> str:
    return "; ".join(unmet_text(each) for each in judged if not each.met)


def unmet_text(judged: Judged) -> str:
    """Returns what is said of an expectation that is not met."""
    if judged.value is None:
        return f"{judged.text}: the replay has no such figure"
    return f"{judged.text}: it is {judged.value:.6g}"
