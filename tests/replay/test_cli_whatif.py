"""The command `pcgan whatif`: what it prints and writes, and every way it can end."""

import json
import socket

import pytest

from pcgan import bus
from pcgan.predictor import Predictor
from pcgan.predictor_process import what_if_key
from replay.simulator.sensor_suite import CLUSTERS_TOPIC
from schemas import codec
from schemas.messages import TrackFrame


def one_line(err):
    """Asserts that an error is one line of our own, and returns it."""
    (line,) = err.splitlines()
    assert line.startswith("pcgan: ")
    return line


@pytest.fixture
def whatif(pcgan, drive, model):
    """Runs the command on the 6 s drive, 3 s into it."""
    return lambda *arguments, log=drive, at=3: pcgan("whatif", log, "--at", at, "--model", model, *arguments)


def test_it_prints_and_writes_both_futures_and_the_same_again(whatif, tmp_path):
    outcome = whatif("--brake", "--deceleration", 2, "--json", tmp_path / "a.json", "--rrd", tmp_path / "a.rrd")
    assert (outcome.code, outcome.err) == (0, "")
    assert "\x1b" not in outcome.out
    assert "it drives on, or it brakes; within 1.2 s, by random" in outcome.out
    assert "the model sees the vehicle up to this moment only" in outcome.out
    assert f"wrote {tmp_path / 'a.json'}" in outcome.out
    figures = json.loads((tmp_path / "a.json").read_text())
    assert figures["files"] == ["drive.mcap"]
    assert figures["at_s"] == pytest.approx(3, abs=0.06)
    assert figures["hypothesis"] == {"kind": "brake", "deceleration_mps2": 2}
    assert (figures["model"], figures["horizon_s"], figures["refused"]) == ("random", 1.2, 0)
    driven, braked = figures["paths"]["driven_on"], figures["paths"]["supposed"]
    speed = figures["vehicle"]["speed_mps"]
    assert speed > 1.5
    moved = [
        ((path["x"][-1] - path["x"][0]) ** 2 + (path["y"][-1] - path["y"][0]) ** 2) ** 0.5 for path in (driven, braked)
    ]
    assert moved[0] == pytest.approx(1.2 * speed, rel=0.01)
    stop_s = min(speed / 2, 1.2)
    assert moved[1] == pytest.approx(speed * stop_s - stop_s**2, rel=0.01)
    assert len(figures["pedestrians"]) > 3
    assert (tmp_path / "a.rrd").stat().st_size > 10_000
    assert whatif("--brake", "--deceleration", 2, "--json", tmp_path / "b.json").code == 0
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


def test_a_vehicle_put_among_people_enters_nobodys_way_unless_it_is_there(whatif, tmp_path):
    """A supposed path to where somebody stands makes that somebody the most concerned."""
    assert whatif("--brake", "--json", tmp_path / "a.json").code == 0
    person = json.loads((tmp_path / "a.json").read_text())["pedestrians"][-1]
    plan = tmp_path / "plan.csv"
    plan.write_text(f"t,x,y,yaw\n0,{person['ahead_m']},{person['left_m']},0\n")
    outcome = whatif("--path", plan, "--json", tmp_path / "b.json")
    assert "it follows plan.csv" in outcome.out
    figures = json.loads((tmp_path / "b.json").read_text())
    assert figures["hypothesis"] == {"kind": "path", "file": "plan.csv"}
    found = {each["id"]: each for each in figures["pedestrians"]}[person["id"]]
    assert found["supposed"] == {"probability": 1.0, "time_s": 0.0}
    assert found["driven_on"] == person["driven_on"]
    assert "+100%" in outcome.out or found["driven_on"]["probability"] > 0.005


@pytest.mark.parametrize("side", ["left", "right"])
def test_swerving(whatif, side, tmp_path):
    arguments = ("--swerve", side, "--offset", 0.5, "--over", 1.2, "--json", tmp_path / "a.json")
    outcome = whatif(*arguments)
    assert outcome.code == 0
    assert f"it swerves {side}" in outcome.out
    hypothesis = json.loads((tmp_path / "a.json").read_text())["hypothesis"]
    assert hypothesis == {"kind": f"swerve {side}", "offset_m": 0.5, "over_s": 1.2}


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ((), "suppose one thing: --brake, --swerve left or right, or --path FILE"),
        (("--brake", "--swerve", "left"), "suppose one thing"),
        (("--swerve", "left", "--offset", 15), "the vehicle cannot shift 15 m within 2 s"),
        (("--path", "none.csv"), "none.csv cannot be read: No such file or directory"),
        (("--brake", "--rrd", "a.rrd", "--view"), "leave one of them out"),
        (("--brake", "--json", "nowhere/a.json"), "cannot be written"),
        (("--brake", "--start", 5), "--at 3 lies before the start, 5 s into the log"),
        (("--brake", "--connect", "nonsense"), "zenoh cannot be opened on nonsense"),
        (("--brake", "--namespace", "car7"), "--namespace is of a running predictor"),
    ],
)
def test_mistakes_are_one_line(whatif, arguments, problem, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = whatif(*arguments)
    assert outcome.code == 2
    assert problem in one_line(outcome.err)
    assert list(tmp_path.glob("a.*")) == []


def test_a_moment_past_the_end_is_an_error(whatif):
    outcome = whatif("--brake", at=60)
    assert outcome.code == 2
    assert "there is no frame within 1 s of 60 s" in one_line(outcome.err)


def test_refused_messages_are_exit_3(whatif, drive, edit_log):
    path = edit_log(drive, lambda log: [*log[:500], (CLUSTERS_TOPIC, log[499][1], b"\xff\xff\xff"), *log[500:]])
    outcome = whatif("--brake", log=path)
    assert outcome.code == 3
    assert "1 message was refused" in outcome.out


def test_a_running_predictor_is_asked(whatif, model, tmp_path):
    predictor = Predictor.from_checkpoint(model)

    def answer(query):
        with query:
            query.reply(
                str(query.key_expr), codec.encode(predictor.step(codec.decode(TrackFrame, query.payload.to_bytes())))
            )

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with bus.open_session(listen=[endpoint]) as session:
        question = session.declare_queryable(what_if_key("car7"), answer)
        asked = whatif("--brake", "--connect", endpoint, "--namespace", "car7", "--json", tmp_path / "asked.json")
        question.undeclare()
    assert (asked.code, asked.err) == (0, "")
    assert whatif("--brake", "--json", tmp_path / "own.json").code == 0
    assert (tmp_path / "asked.json").read_bytes() == (tmp_path / "own.json").read_bytes()
