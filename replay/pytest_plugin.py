"""The pytest plugin: recorded drives as regression tests, in anybody's repository.

    def test_the_crossing(replay_log):
        replayed = replay_log("drives/crossing.mcap")
        assert replayed.scores.hota >= 0.8
        replayed.assert_matches_reference()

pytest imports this module in every run of everybody who has us installed. So it imports nothing of weight, and does
nothing until a test asks for `replay_log` or `replayed`.

PYTEST_DONT_REWRITE: the assertions in here are not for users to read.
"""

from __future__ import annotations

import argparse
import contextlib
import shlex
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from replay.errors import LogError, ReplayError

if TYPE_CHECKING:
    from replay.log_source import LogSource
    from replay.replay_cache import ReplayCache, Settings
    from replay.replayed import References, Replayed

MARKER = (
    "pcgan_log(*logs, model=None, settings=None, salvage=False, name=None): runs the test once per recording that the "
    "paths, globs and URLs find, each replayed as the fixture `replayed`"
)
OPTIONS = ("model", "settings", "salvage", "name")  # of the marker, as of `replay_log`
UPDATE_OPTIONS = ("--update-references", "--pcgan-update-references")  # the first that nobody else has
WORKER_KEY = "pcgan"  # of what a worker of pytest-xdist tells at its end


@dataclass
class Run:
    """What a test run has done so far."""

    update_option: str  # its name in this run
    cache: ReplayCache | None = None  # once somebody asked for a replay
    written: list[Path] = field(default_factory=list)  # references
    done: int = 0  # replays, found and wall_s: those of finished workers
    found: int = 0
    wall_s: float = 0.0

    def take(self, told: Mapping[str, Any]) -> None:
        """Adds what a worker did."""
        self.done += told["done"]
        self.found += told["found"]
        self.wall_s += told["wall_s"]
        self.written += map(Path, told["written"])

    def told(self) -> dict[str, Any]:
        """Returns everything as plain values, the cache's counts among it."""
        cache = self.cache
        own = (cache.done, cache.found, cache.wall_s) if cache is not None else (0, 0, 0.0)
        return {
            "done": self.done + own[0],
            "found": self.found + own[1],
            "wall_s": self.wall_s + own[2],
            "written": [str(path) for path in self.written],
        }


RUN = pytest.StashKey[Run]()
UPDATE_OPTION = pytest.StashKey[str]()


class ReplayLog:
    """The fixture `replay_log`: call it with a recording, get a `Replayed`."""

    def __init__(self, run: Run, references: References, folders: Sequence[Path]):
        assert run.cache is not None, "made by the fixture"
        self._cache = run.cache
        self._references = references
        self._folders = tuple(folders)

    def __call__(
        self,
        logs: str | Path | Sequence[str | Path],
        *,
        model: str | Path | None = None,
        settings: Settings = None,
        salvage: bool = False,
        name: str | None = None,
    ) -> Replayed:
        """Returns a recording's replay, done once in a test run; fails the test, in one line, if that is not possible.

        Relative paths begin in the test file's folder or, if there is nothing, in pytest's rootdir.

        Args:
            logs: paths, globs or fsspec URLs; all that they find is read as one recording.
            model: name of a shipped model, or a file. None: the default.
            settings: whole, as a dict, or the path of a profile in TOML or JSON.
            salvage: read every intact chunk of a damaged file.
            name: tells this variant of the recording, and its reference, from others.
        """
        __tracebackhide__ = True
        patterns = [logs] if isinstance(logs, str | Path) else list(logs)
        with _failing():
            sources = [source for pattern in patterns for source in _found([str(pattern)], self._folders)]
            return self.of(sources, model=model, settings=settings, salvage=salvage, name=name)

    def of(
        self,
        sources: Sequence[LogSource],
        *,
        model: str | Path | None = None,
        settings: Settings = None,
        salvage: bool = False,
        name: str | None = None,
    ) -> Replayed:
        """Does the same with recordings that were found before."""
        from replay.replay_cache import Asked, first_file, read_settings, variant_name

        __tracebackhide__ = True
        with _failing():
            weights = model if model is None else first_file(model, self._folders) or model
            asked = Asked(tuple(sources), read_settings(settings, *self._folders), weights, salvage)
            return self._cache.get(asked, variant_name(sources[0].name, name), self._references)


@pytest.fixture(scope="module")
def replay_log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ReplayLog:
    """Replays recorded drives: replay_log("drive.mcap", model=..., settings=...) gives tracks, predictions, scores."""
    from replay.replay_cache import ReplayCache
    from replay.replayed import References

    config, run = request.config, request.config.stash[RUN]
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if hasattr(config, "workerinput") else base  # by all workers of pytest-xdist
    if run.cache is None:
        run.cache = ReplayCache(shared / "pcgan-replays")
    folder = request.path.parent
    references = References(
        folder / config.getini("pcgan_references"),
        config.getoption("pcgan_reason") if config.getoption("pcgan_update", False) else None,
        f'pytest {shlex.quote(request.node.nodeid)} {run.update_option} --reference-reason "why"',
        run.written,
        shared / "pcgan-references.lock",
    )
    return ReplayLog(run, references, _folders(config, folder))


@pytest.fixture
def replayed(request: pytest.FixtureRequest, replay_log: ReplayLog) -> Replayed:
    """The replay of each recording that @pytest.mark.pcgan_log names."""
    if not hasattr(request, "param"):
        if request.node.get_closest_marker("pcgan_log") is not None:
            pytest.fail("a unittest.TestCase cannot run once per recording; use `replay_log` in it", pytrace=False)
        pytest.fail('`replayed` needs recordings: @pytest.mark.pcgan_log("drives/*.mcap")', pytrace=False)
    case: Case = request.param
    return replay_log.of([case.source], **case.options)


@dataclass(frozen=True)
class Case:
    """A recording that a marker has found, and how it is to be replayed."""

    source: LogSource
    options: Mapping[str, Any]

    @property
    def name(self) -> str:
        """The test's id."""
        variant = self.options.get("name")
        return self.source.name if variant is None else f"{self.source.name}-{variant}"


# --- hooks -----------------------------------------------------------------------------------------------------------


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds our options, but for the one that comes later, and our line of the ini file."""
    parser.getgroup("pcgan", "regression tests on recorded drives").addoption(
        "--reference-reason",
        metavar="TEXT",
        dest="pcgan_reason",
        help="why the new references are right; it is kept in them",
    )
    parser.addini("pcgan_references", "folder of the reference outputs, beside each test file", default="references")


@pytest.hookimpl(wrapper=True)
def pytest_load_initial_conftests(early_config: pytest.Config, parser: pytest.Parser) -> Generator[None]:
    """Adds the option that updates, when everybody else's are there.

    Its name is a common one. If a repository of somebody who merely has us installed used it for an option of its own,
    and ours came first, pytest would not start there.
    """
    yield
    for name in UPDATE_OPTIONS:
        with contextlib.suppress(argparse.ArgumentError):
            parser.getgroup("pcgan").addoption(
                name,
                action="store_true",
                dest="pcgan_update",
                help="write the references that are missing or differ, instead of failing; needs --reference-reason",
            )
            early_config.stash[UPDATE_OPTION] = name
            break


def pytest_configure(config: pytest.Config) -> None:
    """Registers the marker; refuses to update references without a reason."""
    config.addinivalue_line("markers", MARKER)
    run = config.stash[RUN] = Run(config.stash.get(UPDATE_OPTION, UPDATE_OPTIONS[0]))
    if config.getoption("pcgan_update", False) and not (config.getoption("pcgan_reason") or "").strip():
        raise pytest.UsageError(f"{run.update_option} needs --reference-reason TEXT: why the new references are right")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Makes a test of each recording that a marker finds."""
    marks = list(metafunc.definition.iter_markers("pcgan_log"))
    if not marks or "replayed" not in metafunc.fixturenames:
        return
    folders = _folders(metafunc.config, metafunc.definition.path.parent)
    cases = [case for mark in reversed(marks) for case in _cases(mark, folders)]
    metafunc.parametrize("replayed", cases, ids=[case.name for case in cases], indirect=True)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Tells pytest-xdist's controller what this worker did."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput[WORKER_KEY] = session.config.stash[RUN].told()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Adds up what the workers of pytest-xdist did."""
    if told := getattr(node, "workeroutput", {}).get(WORKER_KEY):
        node.config.stash[RUN].take(told)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Says what was replayed and which references are new; nothing in a run without either."""
    told = config.stash[RUN].told()
    if told["done"] or told["found"]:
        logs = "1 replay" if told["done"] == 1 else f"{told['done']} replays"
        terminalreporter.write_line(f"pcgan: {logs} in {told['wall_s']:.1f} s, {told['found']} from the cache")
    for path in sorted(set(told["written"])):  # two workers may have written the same
        shown = Path(path)
        with contextlib.suppress(ValueError):  # it lies elsewhere
            shown = shown.relative_to(config.invocation_params.dir)
        terminalreporter.write_line(f"pcgan: wrote the reference {shown}")


# --- recordings ------------------------------------------------------------------------------------------------------


def _folders(config: pytest.Config, folder: Path) -> tuple[Path, ...]:
    """Returns where relative paths begin: beside the test, then at the root."""
    return tuple(dict.fromkeys((folder, config.rootpath)))


def _cases(mark: pytest.Mark, folders: Sequence[Path]) -> list[Case]:
    if unknown := set(mark.kwargs) - set(OPTIONS):
        raise pytest.Collector.CollectError(f"pcgan_log takes {', '.join(OPTIONS)}, got {', '.join(sorted(unknown))}")
    if not mark.args:
        raise pytest.Collector.CollectError('pcgan_log needs a recording: pcgan_log("drives/*.mcap")')
    try:
        return [Case(source, mark.kwargs) for source in _found([str(log) for log in mark.args], folders)]
    except ReplayError as error:
        raise pytest.Collector.CollectError(f"pcgan_log: {error}") from error


def _found(patterns: Sequence[str], folders: Sequence[Path]) -> list[LogSource]:
    """Returns the recordings that patterns find in the first folder where all of them find one; raises LogError."""
    from replay.log_source import find_logs

    problems: list[str] = []
    for folder in folders:
        try:
            return find_logs(patterns, folder)
        except LogError as error:
            problems.append(str(error))
    local = any("://" not in pattern for pattern in patterns)
    raise LogError(problems[0] + (f"; looked in {' and '.join(map(str, folders))}" if local else ""))


@contextlib.contextmanager
def _failing() -> Iterator[None]:
    """Turns what a user can mend into a failed test of one line, without our insides."""
    __tracebackhide__ = True
    try:
        yield
    except ReplayError as error:
        raise pytest.fail.Exception(f"pcgan: {error}", pytrace=False) from None
