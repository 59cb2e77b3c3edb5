"""The pytest plugin, run as its users run it: in a repository of their own, by pytest."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

import replay.replay_cache  # noqa: F401  pytester unloads what a run has loaded: this is there before
from replay.reference import read_reference
from replay.simulator import simulate

pytest_plugins = ["pytester"]

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "regression-tests"
PLUGIN = ("-p", "replay.pytest_plugin")  # by name: found or not among what is installed, it is loaded once
STRICT = """
[pytest]
addopts = --strict-markers --strict-config --import-mode=importlib
filterwarnings = error
"""


@pytest.fixture(scope="module")
def shortest_drive(tmp_path_factory) -> Path:
    """A drive of 13 scans past three people: what is in it does not matter here."""
    path = tmp_path_factory.mktemp("drives") / "short.mcap"
    simulate(path, clip=None, vehicle=None, pedestrians=3, duration_s=1.3, seed=4)
    return path


@pytest.fixture
def repository(pytester, shortest_drive, monkeypatch):
    """A repository with a drive, where every warning is an error and only the plugins that are named are loaded."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    pytester.makefile(".ini", pytest=STRICT)
    (pytester.path / "tests").mkdir()
    shutil.copy(shortest_drive, pytester.path / "tests" / "short.mcap")
    return pytester.path


@pytest.fixture
def run(pytester, repository):
    """Runs pytest on a test file, in this process."""

    def run(test: str, *arguments: str) -> pytest.RunResult:
        (repository / "tests" / "test_drives.py").write_text(f"import pytest\n{test}")
        return pytester.runpytest_inprocess(*PLUGIN, *arguments)

    return run


def summary_of(result: pytest.RunResult) -> list[str]:
    """Returns what the plugin says at the end."""
    return [line for line in result.outlines if line.startswith("pcgan: ") and "Failed" not in line]


# --- loading -------------------------------------------------------------------------------------------------------


def test_loading_the_plugin_imports_nothing_of_weight():
    heavy = ("numpy", "scipy", "torch", "mcap", "zenoh", "pydantic", "fsspec", "replay.session")
    program = f"import sys, replay.pytest_plugin; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("[]\n", "")


def test_a_run_that_replays_nothing_says_nothing(run):
    result = run("def test_something_else():\n    pass")
    result.assert_outcomes(passed=1)
    assert "pcgan:" not in result.stdout.str()


def test_options_ini_and_marker_are_described(run):
    run("")
    described = run("", "--help").stdout.str() + run("", "--markers").stdout.str() + run("", "--fixtures").stdout.str()
    for name in ("--update-references", "--reference-reason=TEXT", "pcgan_references (string)", "pcgan_log(*logs"):
        assert name in described
    assert re.search(r"^replay_log \[module scope\]", described, re.MULTILINE)


# --- fixtures and marker -------------------------------------------------------------------------------------------


def test_all_tests_of_a_drive_share_a_replay(run):
    result = run(
        """
def test_tracks(replay_log):
    replayed = replay_log("short.mcap")
    assert len(replayed.tracks) == len(replayed.predictions) == 13
    assert replayed.scores.hota > 0.5

def test_the_same_again(replay_log):
    assert replay_log(["short.mcap"]) is replay_log("*.mcap", settings={})

@pytest.mark.pcgan_log("*.mcap")
class TestEvery:
    def test_all(self, replayed):
        assert replayed.refused == 0
        assert replayed.name == "short"

    def test_nothing_of_it(self):
        pass
""",
        "-v",
    )
    result.assert_outcomes(passed=4)
    assert any("TestEvery::test_all[short] PASSED" in line for line in result.outlines)
    assert len(said := summary_of(result)) == 1
    assert re.fullmatch(r"pcgan: 1 replay in \d+\.\d s, 3 from the cache", said[0])


def test_each_marker_adds_its_recordings_with_its_own_settings(run, repository, model):
    (repository / "early.toml").write_text("duration_s = 1.0\n")
    shutil.copy(model, repository / "tests" / "mine.safetensors")
    shutil.copy(repository / "tests" / "short.mcap", repository / "tests" / "other.mcap")
    result = run(
        """
pytestmark = pytest.mark.pcgan_log("*.mcap", settings={"duration_s": 1.0})

@pytest.mark.pcgan_log("short.mcap", settings="early.toml", model="mine.safetensors", name="mine")
def test_it(replayed):
    assert len(replayed.tracks) < 11
    assert (replayed.summary["model"]["name"] == "random") == (replayed.name == "short-mine")
""",
        "-v",
    )
    result.assert_outcomes(passed=3)
    ids = re.findall(r"test_it\[(.*)\] PASSED", result.stdout.str())
    assert ids == ["other", "short", "short-mine"]


def test_a_repositorys_own_fixture_may_be_called_replayed(run):
    result = run(
        """
@pytest.fixture(scope="module")
def replayed(replay_log):
    return replay_log("short.mcap")

def test_it(replayed):
    assert replayed.name == "short"
"""
    )
    result.assert_outcomes(passed=1)


def test_relative_paths_begin_beside_the_test_and_then_at_the_root(run, repository):
    shutil.copy(repository / "tests" / "short.mcap", repository / "root.mcap")
    result = run(
        """
def test_it(replay_log, request):
    assert replay_log("short.mcap").logs == (str(request.path.parent / "short.mcap"),)
    assert replay_log("root.mcap").logs == (str(request.config.rootpath / "root.mcap"),)
"""
    )
    result.assert_outcomes(passed=1)


# --- what goes wrong -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "said"),
    [
        ('replay_log("none.mcap")', "none.mcap is not there; looked in"),
        ('replay_log("test_drives.py")', "test_drives.py is not a readable MCAP file"),
        ('replay_log("short.mcap", model="none")', "no checkpoint none; shipped models are"),
        ('replay_log("short.mcap", settings={"start": 1})', "settings: start: there is nothing of this name"),
        ('replay_log("short.mcap", settings="none.toml")', "none.toml cannot be read: No such file"),
    ],
)
def test_what_cannot_be_replayed_fails_the_test_in_one_line(run, call, said):
    result = run(f"def test_it(replay_log):\n    {call}")
    result.assert_outcomes(failed=1)
    begin = next(i for i, line in enumerate(result.outlines) if line.strip("_") == " test_it ")
    end = next(i for i, line in enumerate(result.outlines) if "short test summary" in line)
    (line,) = result.outlines[begin + 1 : end]
    assert line.startswith("pcgan: ")
    assert said in line


def test_a_test_case_of_unittest_asks_for_replay_log(run):
    result = run(
        """
import unittest

class TestOne(unittest.TestCase):
    @pytest.fixture(autouse=True)
    def replay(self, replay_log):
        self.replayed = replay_log("short.mcap")

    def test_it(self):
        assert self.replayed.refused == 0

@pytest.mark.pcgan_log("short.mcap")
@pytest.mark.usefixtures("replayed")
class TestEach(unittest.TestCase):
    def test_it(self):
        pass
"""
    )
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["a unittest.TestCase cannot run once per recording; use `replay_log` in it"])


def test_replayed_without_a_marker_says_what_is_missing(run):
    result = run("def test_it(replayed):\n    pass")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(['`replayed` needs recordings: @pytest.mark.pcgan_log("drives/[*].mcap")'])


@pytest.mark.parametrize(
    ("marker", "said"),
    [
        ('pcgan_log("none/*.mcap")', "pcgan_log: none/*.mcap finds no file; looked in "),
        ("pcgan_log()", 'pcgan_log needs a recording: pcgan_log("drives/*.mcap")'),
        ('pcgan_log("short.mcap", modle="a")', "pcgan_log takes model, settings, salvage, name, got modle"),
    ],
)
def test_a_marker_that_finds_nothing_or_makes_no_sense_stops_the_collection(run, marker, said):
    result = run(f"@pytest.mark.{marker}\ndef test_it(replayed):\n    pass")
    result.assert_outcomes(errors=1)
    begin = next(i for i, line in enumerate(result.outlines) if "ERROR collecting" in line)
    assert result.outlines[begin + 1].startswith(said)
    assert "short test summary" in result.outlines[begin + 2]


# --- references ----------------------------------------------------------------------------------------------------

MATCHES = """
@pytest.mark.pcgan_log("short.mcap", settings={"tracking": {"tracker": {"confirm_hits": HITS}}})
def test_it(replayed):
    replayed.assert_matches_reference()
"""


def test_references_are_written_matched_missed_and_mended(run, repository):
    reference = repository / "tests" / "references" / "short.reference.mcap"
    usual, changed = MATCHES.replace("HITS", "2"), MATCHES.replace("HITS", "3")
    update = ("--update-references", "--reference-reason")

    missing = run(usual)
    missing.assert_outcomes(failed=1)
    missing.stdout.fnmatch_lines(
        [
            ">       replayed.assert_matches_reference()",
            f"E       AssertionError: short has no reference {reference}",
            'E       if this output is right: pytest tests/test_drives.py --update-references --reference-reason "why"',
        ]
    )
    assert "replayed.py" not in missing.stdout.str()  # of our insides nothing

    written = run(usual, *update, "first version")
    written.assert_outcomes(passed=1)
    assert summary_of(written)[1:] == ["pcgan: wrote the reference tests/references/short.reference.mcap"]
    assert read_reference(reference).reason == "first version"

    differs = run(changed)
    differs.assert_outcomes(failed=1)
    text = differs.stdout.str()
    assert re.search(r"^E +/pcgan/tracks at \d\.\d{3} s, track \d+", text, re.MULTILINE)
    assert re.search(r"^E +tracking\.tracker\.confirm_hits 2 -> 3$", text, re.MULTILINE)

    mended = run(changed, *update, "three hits confirm a track")
    mended.assert_outcomes(passed=1)
    assert len(summary_of(mended)) == 2
    assert read_reference(reference).reason == "three hits confirm a track"
    run(changed).assert_outcomes(passed=1)


def test_an_update_needs_a_reason(run):
    for arguments in (["--update-references"], ["--update-references", "--reference-reason", " "]):
        result = run(MATCHES.replace("HITS", "2"), *arguments)
        assert result.ret == pytest.ExitCode.USAGE_ERROR
        result.stderr.fnmatch_lines(["ERROR: --update-references needs --reference-reason TEXT: why *"])


def test_an_option_of_the_same_name_in_somebody_elses_conftest_is_left_alone(run, pytester):
    """Whoever merely has pcgan installed must not notice."""
    pytester.makeconftest(
        """
def pytest_addoption(parser):
    parser.addoption("--update-references", action="store_true")
"""
    )
    theirs = run("def test_it(request):\n    assert request.config.option.update_references", "--update-references")
    theirs.assert_outcomes(passed=1)
    missing = run(MATCHES.replace("HITS", "2"), "--update-references")
    missing.assert_outcomes(failed=1)
    missing.stdout.fnmatch_lines(['*: pytest tests/test_drives.py --pcgan-update-references --reference-reason "why"'])
    ours = run(MATCHES.replace("HITS", "2"), "--pcgan-update-references", "--reference-reason", "first")
    ours.assert_outcomes(passed=1)
    assert len(summary_of(ours)) == 2


def test_the_folder_of_references_is_set_in_the_ini_file(run, repository):
    (repository / "pytest.ini").write_text(STRICT + "pcgan_references = ../expected\n")
    run(MATCHES.replace("HITS", "2"), "--update-references", "--reference-reason", "first").assert_outcomes(passed=1)
    assert [path.name for path in (repository / "expected").iterdir()] == ["short.reference.mcap"]


# --- several processes ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_workers_of_xdist_share_replays_and_tell_what_they_did(pytester, repository):
    (repository / "tests" / "test_drives.py").write_text(
        "import pytest\n"
        '@pytest.mark.parametrize("name", ["a", "b"])\n'
        "def test_it(replay_log, name):\n"
        '    replay_log("short.mcap", name=name).assert_matches_reference()\n'
    )
    arguments = [
        "-p",
        "xdist.plugin",
        "-n",
        "2",
        "-p",
        "no:cacheprovider",
        "--update-references",
        "--reference-reason",
        "first",
    ]
    result = pytester.runpytest_subprocess(*PLUGIN, *arguments)
    result.assert_outcomes(passed=2)
    counts, *written = summary_of(result)
    assert re.fullmatch(r"pcgan: 1 replay in \d+\.\d s, 1 from the cache", counts)
    assert written == [f"pcgan: wrote the reference tests/references/short-{name}.reference.mcap" for name in "ab"]


# --- the example ---------------------------------------------------------------------------------------------------


@pytest.fixture
def elsewhere(tmp_path):
    """Runs commands in a copy of the example, in an environment of its own into which pip has installed the project.

    Of this environment it has the dependencies, through a .pth file: installing them takes minutes. The checkout, and
    what is installed of it here, it does not see.
    """
    source, example, env = tmp_path / "source", tmp_path / "repository", tmp_path / "venv"
    for package in ("schemas", "tracking", "pcgan", "replay"):
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    shutil.copytree(EXAMPLE, example, ignore=shutil.ignore_patterns("drives", "references", "out", "__pycache__"))
    path = os.pathsep.join([str(env / "bin"), os.environ["PATH"]])
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PYTEST"))}

    def run(*command: object) -> subprocess.CompletedProcess[str]:
        environment = {**clean, "PATH": path, "OMP_NUM_THREADS": "1"}
        return subprocess.run(command, cwd=example, env=environment, capture_output=True, text=True, check=False)

    subprocess.run([sys.executable, "-m", "venv", "--without-pip", env], check=True)
    (packages,) = env.glob("lib/python*/site-packages")
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    pip = [sys.executable, "-m", "pip", "--python", env / "bin" / "python", "--disable-pip-version-check"]
    installed = run(*pip, "install", "--quiet", "--no-deps", "--no-build-isolation", "--force-reinstall", source)
    assert installed.returncode == 0, installed.stderr
    assert Path(run("python", "-c", "import replay; print(replay.__file__)").stdout).is_relative_to(packages)
    return example, run


def test_the_workflow_in_the_docs_is_the_examples():
    docs = (ROOT / "docs" / "regression.md").read_text()
    documented = re.findall(r"^```yaml\n(name: regression\n.*?)^```$", docs, re.MULTILINE | re.DOTALL)
    assert documented == [(EXAMPLE / ".github" / "workflows" / "regression.yml").read_text()]


@pytest.mark.slow
def test_the_example_works_in_a_repository_of_its_own(elsewhere):
    example, run = elsewhere
    update = ("python", "-m", "pytest", "--update-references", "--reference-reason")
    assert run("./get_drives.sh").returncode == 0
    first = run(*update, "first version")
    assert first.returncode == 0, first.stdout
    assert "pcgan: wrote the reference tests/references/crossing.reference.mcap" in first.stdout
    again = run("python", "-m", "pytest", "-n", "2", "--basetemp=out")
    assert again.returncode == 0, again.stdout
    assert "10 passed" in again.stdout
    assert len(list(example.glob("out/pcgan-replays/*/*.pcgan.mcap"))) == 3

    tests = example / "tests" / "test_drives.py"
    changed = tests.read_text().replace('"drives/*.mcap"', '"drives/*.mcap", settings="hits.toml"', 1)
    tests.write_text(changed)
    (example / "hits.toml").write_text("tracking.tracker.confirm_hits = 3\n")
    differs = run("python", "-m", "pytest")
    assert differs.returncode == 1
    assert "2 failed, 8 passed" in differs.stdout
    for said in (r"/pcgan/tracks at \d+\.\d{3} s, track \d+", r"tracking\.tracker\.confirm_hits 2 -> 3"):
        assert len(re.findall(rf"^E +{said}", differs.stdout, re.MULTILINE)) == 2
    assert run(*update, "three hits confirm a track").returncode == 0
    assert run("python", "-m", "pytest").returncode == 0
