"""The command: help with examples, exit codes, one line for what went wrong, and silence in a pipe."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import pytest
import typer

from replay import cli
from replay.log_reader import checksum
from replay.simulator.sensor_suite import CLUSTERS_TOPIC, ODOMETRY_TOPIC


def _leaves(command, name=()):
    """Yields every command by the words that call it, groups such as `data` and what is in them."""
    for word, part in getattr(command, "commands", {}).items():
        yield (*name, word), part
        yield from _leaves(part, (*name, word))


COMMANDS = dict(sorted(_leaves(typer.main.get_command(cli.app))))


def one_line(err):
    """Asserts that an error is one line of our own, and returns it."""
    lines = [line for line in err.splitlines() if not line.startswith("note: ")]
    assert len(lines) == 1, err
    assert lines[0].startswith("pcgan: ")
    assert "Traceback" not in err
    return lines[0]


@pytest.fixture
def inline(pcgan, model):
    """Runs pcgan replay with the predictor in this process."""
    return lambda *arguments: pcgan("replay", *arguments, "--predictor", "inline", "--model", model)


# --- help ------------------------------------------------------------------------------------------------------------


def test_the_commands():
    words = {name[0] for name in COMMANDS}
    drives = {"replay", "simulate", "predict", "info", "inspect", "label", "export"}
    drives |= {"track", "play", "record", "whatif", "diff", "check", "report", "batch"}
    assert words == drives | {"models", "train", "windows", "evaluate", "data"}
    assert {("data", "list"), ("data", "get")} <= set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS, ids=" ".join)
def test_every_command_explains_itself_with_examples(pcgan, name):
    outcome = pcgan(*name, "--help")
    assert outcome.code == 0
    assert "Example" in outcome.out
    assert f"pcgan {' '.join(name)}" in outcome.out.split("Example")[1]
    for parameter in COMMANDS[name].params:
        if not getattr(parameter, "hidden", False) and parameter.opts[0].startswith("--"):
            assert parameter.opts[0] in outcome.out
            assert parameter.help, parameter.name


def test_pcgan_alone_lists_the_commands(pcgan):
    outcome = pcgan("--help")
    assert outcome.code == 0
    for name in COMMANDS:
        assert f"│ {name[0]} " in outcome.out
    for panel in ("Drives", "Regression", "Live", "Models", "Data"):
        assert f"─ {panel} ─" in outcome.out


def test_the_version_is_the_packages(pcgan):
    assert pcgan("--version") == (0, f"{version('pcgan')}\n", "")


@pytest.mark.parametrize("name", COMMANDS, ids=" ".join)
def test_examples_fit_a_terminal_of_80_columns(name):
    """Help is markdown: a line that is too long would wrap in mid-command."""
    for line in COMMANDS[name].help.splitlines():
        if line.strip().startswith("pcgan "):
            assert len(line.strip()) <= 78


def test_an_option_nobody_knows_is_exit_2(pcgan):
    outcome = pcgan("replay", "drive.mcap", "--sped", "2")
    assert outcome.code == 2
    assert "--sped" in outcome.err


# --- replay ----------------------------------------------------------------------------------------------------------


def test_a_replay_writes_what_it_says(inline, short_drive, recorded, tmp_path):
    outcome = inline(short_drive, "-o", tmp_path / "out.mcap", "--json", tmp_path / "summary.json")
    assert outcome.code == 0
    assert (tmp_path / "out.mcap").read_bytes() == recorded.path.read_bytes()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["complete"], summary["frames"]) == (True, len(recorded.frames))
    assert f"wrote {tmp_path / 'out.mcap'}" in outcome.out
    assert f"wrote {tmp_path / 'summary.json'}" in outcome.out
    assert {path.name for path in tmp_path.iterdir()} == {"out.mcap", "summary.json"}


def test_a_pipe_gets_no_escape_codes_and_no_progress(inline, short_drive, tmp_path):
    outcome = inline(short_drive, "-o", tmp_path / "out.mcap")
    assert "\x1b" not in outcome.out + outcome.err
    assert outcome.err == ""
    assert "replaying" not in outcome.out


def test_the_output_lies_beside_the_log_by_default(inline, edit_log, short_drive):
    path = edit_log(short_drive, lambda log: log, "mine.mcap")
    assert inline(path, "--duration", "0.5").code == 0
    assert (path.parent / "mine.pcgan.mcap").is_file()


def test_start_and_duration(inline, short_drive, tmp_path):
    outcome = inline(short_drive, "-o", tmp_path / "o", "--start", "1", "--duration", "1", "--json", tmp_path / "j")
    assert outcome.code == 0
    assert json.loads((tmp_path / "j").read_text())["frames"] == pytest.approx(10, abs=1)


def test_refused_messages_are_exit_3_with_a_closing_line(inline, short_drive, edit_log, tmp_path):
    def insert(log):
        return [*log[:500], (CLUSTERS_TOPIC, log[499][1], b"\xff\xff\xff"), *log[500:]]

    path = edit_log(short_drive, insert)
    outcome = inline(path, "-o", tmp_path / "out.mcap", "--json", tmp_path / "summary.json")
    assert outcome.code == 3
    assert f"{CLUSTERS_TOPIC} at " in outcome.out
    assert "1 message was refused" in outcome.out
    (row,) = json.loads((tmp_path / "summary.json").read_text())["refusals"]
    assert (row["topic"], row["count"]) == (CLUSTERS_TOPIC, 1)
    assert "not a pcgan.v1.LidarClusters" in row["reason"]

    outcome = inline(path, "-o", tmp_path / "strict.mcap", "--strict")
    assert outcome.code == 2
    assert "without --strict the run would go on" in one_line(outcome.err)
    assert not (tmp_path / "strict.mcap").exists()


def test_salvage_is_exit_3_and_without_it_exit_2(inline, short_drive, edit_log, tmp_path):
    path = edit_log(short_drive, lambda log: log, "damaged.mcap", chunk_size=20_000)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 4])
    outcome = inline(path, "-o", tmp_path / "out.mcap")
    assert outcome.code == 2
    assert f"{path} is not a readable MCAP file" in one_line(outcome.err)
    assert "try --salvage" in outcome.err
    assert not list(tmp_path.glob("out*"))
    outcome = inline(path, "-o", tmp_path / "out.mcap", "--salvage", "--json", tmp_path / "summary.json")
    assert outcome.code == 3
    assert "the file is damaged; every intact chunk was used" in outcome.out
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["salvage_losses"]
    assert summary["frames"] > 10


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot be read: No such file or directory"),
        (b"", "the file is empty"),
        (b"text" * 99, "is not a readable"),
    ],
    ids=["missing", "empty", "text"],
)
def test_a_log_that_is_none_is_one_line_and_nothing_is_written(inline, tmp_path, content, words):
    if content is not None:
        (tmp_path / "log.mcap").write_bytes(content)
    before = set(tmp_path.iterdir())
    outcome = inline(tmp_path / "log.mcap")
    assert outcome.code == 2
    assert words in one_line(outcome.err)
    assert "log.mcap" in outcome.err
    assert outcome.out == ""
    assert set(tmp_path.iterdir()) == before


def test_a_missing_topic_is_one_line_and_nothing_is_written(inline, short_drive, edit_log):
    path = edit_log(short_drive, lambda log: [m for m in log if m[0] not in (ODOMETRY_TOPIC, "/tf")])
    outcome = inline(path)
    assert outcome.code == 2
    assert "the log has no vehicle pose: looked for /vn100/odometry" in one_line(outcome.err)
    assert [each.name for each in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("option", ["/vn100/odometry", "a=b", ":=/odom", "pose:="])
def test_a_role_that_is_none_shows_an_example(inline, short_drive, option):
    outcome = inline(short_drive, "--role", option)
    assert outcome.code == 2
    assert one_line(outcome.err) == (f"pcgan: --role wants ROLE:=TOPIC, for example pose:=/odom; got {option!r}")


def test_a_role_is_used(inline, short_drive, edit_log, tmp_path):
    renamed = edit_log(short_drive, lambda log: log, topics={ODOMETRY_TOPIC: "/odom"})
    arguments = (renamed, "-o", tmp_path / "out.mcap", "--duration", "0.5", "--role")
    assert inline(*arguments, "pose:=/odom").code == 0
    outcome = inline(*arguments, f"pose:={CLUSTERS_TOPIC}")
    assert outcome.code == 2
    assert f"{CLUSTERS_TOPIC} cannot serve as vehicle pose" in one_line(outcome.err)


def test_a_profile_in_toml_gives_roles_and_settings(inline, short_drive, tmp_path, mcap_content):
    profile = tmp_path / "car.toml"
    profile.write_text(f'duration_s = 0.5\n[roles]\npose = "{ODOMETRY_TOPIC}"\n[sync]\nwait_ms = 250\n')
    assert inline(short_drive, "-o", tmp_path / "out.mcap", "--profile", profile).code == 0
    used = json.loads(mcap_content(tmp_path / "out.mcap").attachments["settings.json"])
    assert (used["duration_s"], used["roles"]["pose"], used["sync"]["wait_ms"]) == (0.5, ODOMETRY_TOPIC, 250)
    for text, words in (("[roles", "is not TOML"), ("speed = 1", "speed: there is nothing of this name")):
        profile.write_text(text)
        outcome = inline(short_drive, "--profile", profile)
        assert outcome.code == 2
        assert words in one_line(outcome.err)


@pytest.mark.parametrize("predictor", ["inline", "spawned"])
def test_a_corrupt_checkpoint_is_one_line_naming_the_file(pcgan, short_drive, tmp_path, predictor):
    (tmp_path / "bad.safetensors").write_bytes(b"no weights")
    arguments = ("--predictor", predictor, "--model", tmp_path / "bad.safetensors", "-o", tmp_path / "out.mcap")
    outcome = pcgan("replay", short_drive, *arguments)
    assert outcome.code == 2
    assert "bad.safetensors is not a readable safetensors file" in one_line(outcome.err)
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize(
    ("option", "value"), [("--connect", "tcp/127.0.0.1:1"), ("--zenoh-config", "tls.json5"), ("--namespace", "car7")]
)
def test_options_of_an_external_predictor_are_of_no_other(inline, short_drive, option, value):
    outcome = inline(short_drive, option, value)
    assert (outcome.code, one_line(outcome.err)) == (2, f"pcgan: {option} goes with --predictor external")


def test_options_that_exclude_each_other(inline, short_drive):
    outcome = inline(short_drive, "--rrd", "a.rrd", "--view")
    assert outcome.code == 2
    assert "--rrd and --view exclude each other" in one_line(outcome.err)


def test_a_view_that_cannot_be_written_is_one_line(inline, short_drive, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    outcome = inline(short_drive, "-o", tmp_path / "out.mcap", "--rrd", tmp_path / "no" / "such" / "out.rrd")
    assert outcome.code in (0, 2)
    if outcome.code == 2:
        one_line(outcome.err)
    else:
        assert (tmp_path / "no" / "such" / "out.rrd").is_file()


@pytest.mark.parametrize("option", ["--json", "--picture"])
def test_what_cannot_be_written_beside_the_output_is_one_line(inline, short_drive, tmp_path, option):
    outcome = inline(
        short_drive, "-o", tmp_path / "out.mcap", "--duration", "0.5", option, tmp_path / "no" / "file.png"
    )
    assert outcome.code == 2
    assert "file.png cannot be written" in one_line(outcome.err)
    assert list(tmp_path.iterdir()) == []  # said before the replay, not after


# --- the recording is never touched ----------------------------------------------------------------------------------


@pytest.mark.parametrize("option", ["-o", "--json", "--picture", "--rrd"])
def test_no_option_overwrites_the_recording(inline, short_drive, edit_log, tmp_path, option):
    path = edit_log(short_drive, lambda log: log, "mine.mcap")
    before = checksum(path)
    arguments = (option, path) if option == "-o" else ("-o", tmp_path / "out.mcap", option, path)
    outcome = inline(path, "--duration", "0.5", *arguments)
    assert checksum(path) == before
    assert outcome.code == 2
    assert "is the recording itself" in one_line(outcome.err)


# --- places that cannot be written -----------------------------------------------------------------------------------


def test_an_output_in_a_place_that_cannot_be_written(inline, short_drive, tmp_path):
    (tmp_path / "file").write_text("")
    outcome = inline(short_drive, "-o", tmp_path / "file" / "out.mcap")
    assert outcome.code == 2
    assert "out.mcap cannot be written: " in one_line(outcome.err)


@pytest.mark.parametrize("limit", [30_000, 150_000])
def test_a_full_disk_is_one_line_and_at_most_a_part(short_drive, model, tmp_path, limit, start_pcgan):
    """A limit on the size of files, which Python meets as OSError: what a full disk is, but only for this process."""

    def limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    process = start_pcgan(
        "replay",
        short_drive,
        "-o",
        tmp_path / "out.mcap",
        "--predictor",
        "inline",
        "--model",
        model,
        preexec_fn=limited,
    )
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2, err
    assert "out.mcap c" in one_line(err)
    assert "File too large" in err
    assert {path.name for path in tmp_path.iterdir()} <= {"out.mcap.part"}


# --- signals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("signum", "predictor", "code"), [(signal.SIGINT, "spawned", 130), (signal.SIGTERM, "inline", 143)]
)
def test_a_signal_in_mid_run(drive, model, tmp_path, start_pcgan, mcap_content, signum, predictor, code):
    """Ctrl-C reaches the whole process group, as in a terminal; the predictor lives in a session of its own."""
    process = start_pcgan(
        "replay", drive, "-o", tmp_path / "out.mcap", "--json", tmp_path / "summary.json", "--window", 1, "--rate", 1,
        "--predictor", predictor, "--model", model,
    )  # fmt: skip
    deadline = time.monotonic() + 60
    while not (tmp_path / "out.mcap.part").exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    time.sleep(1.0)
    assert process.poll() is None
    os.killpg(process.pid, signum) if signum == signal.SIGINT else process.send_signal(signum)
    out, err = process.communicate(timeout=30)
    assert process.returncode == code, err
    assert err == ""
    assert f"stopped early: {signal.Signals(signum).name} arrived; what was written is complete up to there" in out
    assert {path.name for path in tmp_path.iterdir()} == {"out.mcap", "summary.json"}
    content = mcap_content(tmp_path / "out.mcap")
    assert json.loads(content.metadata["pcgan"]["complete"]) is False
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["complete"] is False
    assert len(content.messages) == 4 * summary["frames"]
    assert 0 < summary["frames"] < 60


def test_a_reader_that_goes_away_is_no_traceback(short_drive):
    process = subprocess.Popen(
        [sys.executable, "-m", "replay.cli", "info", short_drive, "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    process.stdout.close()
    err = process.stderr.read().decode()
    process.stderr.close()
    assert process.wait(60) in (0, 1, 2)  # typer itself ends with 1
    assert "Traceback" not in err


# --- info ------------------------------------------------------------------------------------------------------------


def test_info_as_a_table_and_as_json(pcgan, short_drive):
    table = pcgan("info", short_drive)
    assert table.code == 0
    assert CLUSTERS_TOPIC in table.out
    assert "clusters" in table.out
    assert "\x1b" not in table.out + table.err
    outcome = pcgan("info", short_drive, "--json")
    assert outcome.code == 0
    description = json.loads(outcome.out)
    assert description["usable"] is True
    assert {row["topic"] for row in description["topics"]} >= {CLUSTERS_TOPIC, ODOMETRY_TOPIC}


def test_info_of_a_log_that_cannot_be_replayed_is_exit_2_with_its_topics(pcgan, short_drive, edit_log):
    path = edit_log(short_drive, lambda log: [m for m in log if m[0] != CLUSTERS_TOPIC])
    outcome = pcgan("info", path)
    assert outcome.code == 2
    assert ODOMETRY_TOPIC in outcome.out
    assert "cannot be replayed: the log has no LiDAR clusters" in outcome.out


def test_info_of_no_log_is_one_line(pcgan, tmp_path):
    outcome = pcgan("info", tmp_path / "gone.mcap")
    assert outcome.code == 2
    assert "gone.mcap cannot be read: No such file or directory" in one_line(outcome.err)


# --- simulate --------------------------------------------------------------------------------------------------------


def test_simulate_repeats_itself(pcgan, tmp_path):
    arguments = ("--pedestrians", 2, "--duration", 0.5, "--seed", 9)
    outcome = pcgan("simulate", tmp_path / "a.mcap", *arguments)
    assert outcome.code == 0
    assert "a.mcap: 0.5 s of crowd" in outcome.out
    assert outcome.err == ""
    assert pcgan("simulate", tmp_path / "b.mcap", *arguments).code == 0
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_a_drive_through_a_trajectory_file(pcgan, tmp_path):
    clip = tmp_path / "mine.csv"
    header = "id,stamp_ns,x,y,vx,vy,vehicle_x,vehicle_y,vehicle_yaw,vehicle_speed"
    rows = [f"1,{k * 10**8},{5 + 0.1 * k},2,1,0,{0.2 * k},0,0,2" for k in range(11)]
    clip.write_text("\n".join([header, *rows]) + "\n")
    outcome = pcgan("simulate", tmp_path / "out.mcap", "--clip", clip)
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out == f"{tmp_path / 'out.mcap'}: 1.0 s of mine.csv, 1 people, 10 scans\n"
    clip.write_text(f"{header}\n1,0,5,2,1\n")
    outcome = pcgan("simulate", tmp_path / "again.mcap", "--clip", clip)
    assert outcome.code == 2
    assert "mine.csv, row 1: 5 cells under 10 columns" in one_line(outcome.err)
    outcome = pcgan("simulate", tmp_path / "again.mcap", "--clip", tmp_path / "gone.csv")
    assert outcome.code == 2
    assert "there is no file " in one_line(outcome.err)
    assert not (tmp_path / "again.mcap").exists()


@pytest.mark.parametrize("clip", ["dut/nowhere_99", "nonsense", "other/clip", "../../etc/passwd"])
def test_an_unknown_clip_is_one_line(pcgan, tmp_path, clip):
    outcome = pcgan("simulate", tmp_path / "out.mcap", "--clip", clip)
    assert outcome.code == 2
    assert Path(clip).name in one_line(outcome.err) or "PCGAN_DATA" in outcome.err
    assert list(tmp_path.iterdir()) == []


def test_data_that_is_not_there_says_where_it_was_looked_for(pcgan, tmp_path, monkeypatch):
    monkeypatch.setenv("PCGAN_DATA", str(tmp_path / "nowhere"))
    monkeypatch.chdir(tmp_path)
    outcome = pcgan("simulate", tmp_path / "out.mcap", "--clip", "dut/roundabout_04")
    assert outcome.code == 2
    assert "PCGAN_DATA" in one_line(outcome.err) or "nowhere" in outcome.err
    assert list(tmp_path.iterdir()) == []


def test_a_drive_into_no_folder_is_one_line(pcgan, tmp_path):
    outcome = pcgan("simulate", tmp_path / "no" / "out.mcap", "--duration", 1)
    assert outcome.code == 2
    assert f"there is no folder {tmp_path / 'no'}" in one_line(outcome.err)


# --- predict ---------------------------------------------------------------------------------------------------------


def test_a_predictor_without_weights_names_the_file(pcgan, tmp_path):
    outcome = pcgan("predict", "--model", tmp_path / "gone.safetensors")
    assert outcome.code == 2
    assert "gone.safetensors" in one_line(outcome.err)


def test_a_predictor_on_an_endpoint_that_is_none_says_so(pcgan, model):
    outcome = pcgan("predict", "--model", model, "--listen", "nonsense")
    assert outcome.code == 2
    assert "zenoh cannot be opened on nonsense" in one_line(outcome.err)


def test_shipped_weights_load_where_they_ship():
    """The one test that looks at what ships; the others bring weights of their own."""
    from pcgan.checkpoint import shipped_models
    from pcgan.predictor import Predictor

    models = shipped_models()
    if not models:
        pytest.skip("no weights ship yet")
    for name, path in models.items():
        assert Predictor.from_checkpoint(path).model_name == name
