"""The documents against the code: commands parse, snippets run, options, fields and settings match, links resolve."""

import re
import shlex
import shutil
import socket
import subprocess
import sys
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest
import typer
from google.protobuf.descriptor import FieldDescriptor

from pcgan.checkpoint import DEFAULT_CHECKPOINT
from pcgan.dataset import HELD_OUT_CLIPS, VALIDATION_CLIPS
from replay import PredictorChoice, Replay
from replay.cli import app
from replay.object_tracks import ObjectTracksParams
from replay.record import Summary, record
from replay.roles import WHAT, schemas_for
from replay.session import ReplaySettings
from replay.simulator.sensor_model import SensorModelV1
from replay.time_sync import SyncSettings
from schemas import pcgan_v1_pb2 as pb
from schemas import topics
from tracking.metrics import TrackingScore
from tracking.pipeline import TrackingSettings
from tracking.segmentation import SegmentationParams

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md")]
PAGES += sorted(DOCS.glob("*.md"))
COMMANDS = typer.main.get_command(app).commands  # `data` is a group, with commands of its own

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def blocks(page, language):
    """The contents of a page's fenced code blocks."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def shell_lines(page):
    """The commands of a page's sh blocks, without comments."""
    lines = [line for block in blocks(page, "sh") for line in block.splitlines()]
    return [line for line in (line.split("  #")[0].strip() for line in lines) if line]


def sections(page, level=2):
    """Heading -> text of each section of a level."""
    parts = re.split(rf"^{'#' * level} (.+)$", page.read_text(), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def rows(text):
    """The cells of a text's table rows, without headings' rules."""
    lines = [line for line in text.splitlines() if line.startswith("|") and not line.startswith("|---")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def code_of(cell):
    return re.findall(r"`([^`]+)`", cell)


def anchors(page):
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


# --- commands ---------------------------------------------------------------------------------------------------------


def command_of(words):
    """The command that the words after `pcgan` call, its name, and what is left of the words: its arguments."""
    name, *rest = words
    command, path = COMMANDS[name], name
    while hasattr(command, "commands"):
        name, *rest = rest
        command, path = command.commands[name], f"{path} {name}"
    return command, path, rest


def leaves(name, command):
    """Every command by the words after `pcgan`; of a group, what is in it."""
    if not hasattr(command, "commands"):
        return {name: command}
    return {
        path: leaf for word, part in command.commands.items() for path, leaf in leaves(f"{name} {word}", part).items()
    }


LEAVES = {path: leaf for name, command in COMMANDS.items() for path, leaf in leaves(name, command).items()}
SHELL = [(page.name, line) for page in PAGES for line in shell_lines(page)]


def test_every_subcommand_is_shown_somewhere():
    shown = {command_of(shlex.split(line)[1:])[1] for _, line in SHELL if line.startswith("pcgan ")}
    assert shown == set(LEAVES)
    readme = {shlex.split(line)[1] for name, line in SHELL if name == "README.md" and line.startswith("pcgan ")}
    assert {"info", "replay", "predict"} <= readme


@pytest.mark.parametrize(("page", "line"), SHELL, ids=lambda value: value)
def test_shown_commands_exist_and_parse(page, line):  # noqa: ARG001  names the page where it fails
    program, *arguments = shlex.split(line.split(" | ")[0])
    if program == "pcgan":
        command, name, rest = command_of(arguments)
        assert command.make_context(name, rest).params is not None
    elif program == "make":
        assert re.search(rf"^{arguments[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif program == "python":
        script = f"{arguments[1].replace('.', '/')}.py" if arguments[0] == "-m" else arguments[0]
        assert (ROOT / script).is_file()
    else:
        assert program in {"rosbags-convert", "rerun", "apt-get", "mkdir", "ruff", "mypy", "pytest"}


@pytest.mark.parametrize("name", sorted({*COMMANDS, *LEAVES}))
def test_help_of_every_command(name, capsys):
    with pytest.raises(SystemExit) as ending:
        typer.main.get_command(app).main([*name.split(), "--help"], prog_name="pcgan")
    assert ending.value.code == 0
    assert f"pcgan {name}" in capsys.readouterr().out


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_cli_page_has_every_option_and_no_other(name):
    section = sections(DOCS / "cli.md")[f"pcgan {name}"].split("\n### ")[0]
    table = [row for row in rows(section) if row[0] != "option"]
    documented = [word for row in table for word in code_of(row[0])]
    wanted = []
    for parameter in (each for leaf in leaves(name, COMMANDS[name]).values() for each in leaf.params):
        is_argument = not parameter.opts[0].startswith("-")
        if not getattr(parameter, "hidden", False):
            wanted += [parameter.metavar] if is_argument else [*parameter.opts, *parameter.secondary_opts]
    assert sorted(documented) == sorted(wanted)
    assert all(len(row) == 2 and row[1] for row in table)


def test_cli_page_has_every_key_of_the_summary(short_drive, model):
    summary = record(Replay([short_drive], predictor=PredictorChoice("inline", model))).as_json()
    truth = summary["ground_truth"]
    assert set(truth) > {field.name for field in fields(TrackingScore)}
    table = rows(sections(DOCS / "cli.md", 3)["The summary"].split("\n## ")[0])
    keys = {word for row in table for cell in row for word in code_of(cell)}
    assert not set(summary) - keys
    assert not set(truth) - keys
    assert not set(summary["latency_ms"]) - keys
    documented = {word for row in table[1:] for word in code_of(row[0])}
    assert documented == set(Summary().as_json()) | set(summary)


# --- messages and topics ----------------------------------------------------------------------------------------------


def type_name(field):
    plain = {
        getattr(FieldDescriptor, f"TYPE_{kind.upper()}"): kind
        for kind in ("double", "float", "uint32", "uint64", "fixed32", "fixed64", "sfixed64", "bool", "string")
    }
    name = field.message_type.name if field.message_type else plain[field.type]
    return f"repeated {name}" if field.is_repeated else name


@pytest.mark.parametrize("name", sorted(pb.DESCRIPTOR.message_types_by_name))
def test_messages_page_has_every_field_and_no_other(name):
    table = rows(sections(DOCS / "messages.md")[name])
    assert table[0] == ["field", "type", "unit", "meaning"]
    documented = {code_of(row[0])[0]: row[1] for row in table[1:]}
    wanted = {field.name: type_name(field) for field in pb.DESCRIPTOR.message_types_by_name[name].fields}
    assert documented == wanted


def spelled_out(text):
    """`/gmsl/{A0,A1}/image` -> both names."""
    found = re.fullmatch(r"(.*)\{(.+)\}(.*)", text)
    return [found[1] + part + found[3] for part in found[2].split(",")] if found else [text]


def test_recording_page_has_every_role_with_every_message_it_may_be():
    table = rows(sections(DOCS / "recording.md")["Roles"].split("```")[0])[1:]
    documented = {code_of(row[0])[0]: {*code_of(row[3]), *code_of(row[4])} for row in table}
    assert documented == {role: set(schemas_for(role)) for role in WHAT}
    defaults = {(code_of(row[0])[0], name) for row in table for cell in code_of(row[2]) for name in spelled_out(cell)}
    assert defaults == {(topic.role, topic.name) for topic in topics.INPUTS}


def test_the_profile_shown_is_one():
    (text,) = blocks(DOCS / "recording.md", "toml")
    shown = ReplaySettings.model_validate(tomllib.loads(text))
    assert shown.roles.cameras["front"].detections == "/yolo/front"


def test_readme_has_every_output():
    table = {code_of(row[0])[0]: code_of(row[1])[0] for row in rows(sections(ROOT / "README.md")["What comes out"])
             if row[0].startswith("`/")}  # fmt: skip
    wanted = {t.name: t.message if "." in t.message else f"pcgan.v1.{t.message}" for t in topics.OUTPUTS}
    assert table == wanted


# --- settings, figures and names that the pages quote -----------------------------------------------------------------


def settings_of(model, prefix=""):
    for name, field in model.model_fields.items():
        if hasattr(type(field.default), "model_fields"):
            yield from settings_of(type(field.default), f"{prefix}{name}.")
        else:
            yield prefix + name, field.default


def shown_default(value):
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, tuple | dict):
        return ", ".join(value) or "none"
    if value is None or isinstance(value, str):
        return value or "none"
    return f"{value:g}"


def test_tracking_page_has_every_setting_with_its_default():
    table = rows(sections(DOCS / "tracking.md")["Settings"])
    documented = {code_of(row[0])[0]: row[1] for row in table if row[0].startswith("`")}
    wanted = dict([*settings_of(TrackingSettings), *settings_of(SyncSettings)])
    shown = {name: shown_default(value) for name, value in wanted.items()}
    assert documented == shown
    assert all(row[2] for row in table)


@pytest.mark.parametrize(
    ("page", "heading", "model"),
    [("tracking.md", "Points", SegmentationParams), ("recording.md", "Another tracker's tracks", ObjectTracksParams)],
)
def test_pages_have_every_setting_of_other_inputs(page, heading, model):
    table = rows(sections(DOCS / page)[heading])
    documented = {code_of(row[0])[0]: row[1] for row in table if row[0].startswith("`")}
    assert documented == {name: shown_default(value) for name, value in settings_of(model)}
    assert all(row[2] for row in table)


def test_simulator_page_quotes_the_frozen_model():
    text = (DOCS / "simulator.md").read_text()
    assert f"version {SensorModelV1().version}" in text
    assert SensorModelV1().checksum() in text


def test_held_out_clips_are_named():
    text = (DOCS / "prediction.md").read_text()
    assert all(f"`{clip}`" in text for clip in HELD_OUT_CLIPS)
    assert len(VALIDATION_CLIPS) == 5
    assert "Five more DUT clips" in text


def test_every_benchmark_is_described():
    files = [path for path in (ROOT / "benchmarks").rglob("*.py") if path.name != "__init__.py"]
    text = (DOCS / "benchmarks.md").read_text()
    assert [path for path in files if f"`{path.relative_to(ROOT).as_posix()}`" not in text] == []


# --- snippets ---------------------------------------------------------------------------------------------------------

SNIPPETS = [
    pytest.param(code, id=f"{page.name}-{i}")
    for page in PAGES
    for i, code in enumerate(blocks(page, "python"))
    if "bus.open_session" not in code
]


@pytest.fixture
def folder(tmp_path, monkeypatch, short_drive):
    """The current folder, with a drive.mcap in it."""
    shutil.copy(short_drive, tmp_path / "drive.mcap")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("code", SNIPPETS)
def test_snippets_run(code, folder, capsys):  # noqa: ARG001  runs in the folder
    exec(compile(code, "snippet", "exec"), {"__name__": "snippet"})
    assert bool(capsys.readouterr().out) == ("print(" in code)


@pytest.mark.slow
def test_the_client_snippet_gets_answers_from_the_command(folder):
    [code] = [c for page in PAGES for c in blocks(page, "python") if "bus.open_session" in c]
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    assert "tcp/127.0.0.1:7447" in code
    (folder / "client.py").write_text(code.replace("tcp/127.0.0.1:7447", endpoint) + "print(answer.model)\n")
    command = [sys.executable, "-m", "replay.cli", "predict", "--listen", endpoint]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert "serving" in server.stderr.readline()
        client = subprocess.run(
            [sys.executable, "client.py"], timeout=60, check=True, capture_output=True, text=True, cwd=folder
        )
        assert client.stdout.strip() == DEFAULT_CHECKPOINT.stem
        server.terminate()
        assert server.wait(10) == 0
    finally:
        server.kill()
        server.communicate()


# --- links and manners ------------------------------------------------------------------------------------------------


@every_page
def test_links_resolve(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("https://"):
            continue
        name, _, anchor = target.partition("#")
        linked = (page.parent / name).resolve() if name else page
        assert linked.exists(), target
        assert linked.is_relative_to(ROOT), target
        assert not anchor or anchor in anchors(linked), target


def test_every_page_of_docs_is_linked():
    linked = {t for page in PAGES for t in re.findall(r"\]\(([^)\s#]+)", page.read_text())}
    assert {path.name for path in DOCS.glob("*.md")} <= {Path(target).name for target in linked}


@every_page
def test_no_machine_paths_and_no_registries(page):
    text = page.read_text()
    assert not re.search(r"(?<![\w.$}])/(home|root|tmp|work|Users|mnt)/", text)
    assert not re.search(r"pypi|download\.pytorch|anaconda|conda-forge", text, re.IGNORECASE)
