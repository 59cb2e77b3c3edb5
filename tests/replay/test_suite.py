"""Suite files: what they may say, what becomes of it, and how mistakes in them are told."""

import json
from pathlib import Path

import fsspec
import pytest

from replay.diff_result import Tolerances
from replay.settings_file import SettingsError
from replay.suite import read_suite


@pytest.fixture
def suite(tmp_path):
    """Writes a suite among four logs (of which only the names matter here) and reads it."""
    for name in ("drives/a.mcap", "drives/b.mcap", "drives/c.pcgan.mcap", "other/a.mcap"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()

    def make(text: str, name: str = "suite.yaml"):
        (tmp_path / name).write_text(text)
        return read_suite(tmp_path / name)

    return make


def names(suite):
    return [case.name for case in suite.cases]


def test_a_glob_is_a_case_for_each_log(suite, tmp_path):
    found = suite("logs: [drives/*.mcap]")
    assert names(found) == ["a", "b"]  # and not the output of a replay
    assert [case.shown for case in found.cases] == [("drives/a.mcap",), ("drives/b.mcap",)]
    assert found.references == tmp_path / "references"
    assert found.tolerances == Tolerances()
    assert (found.model, found.salvage, dict(found.sweep)) == (None, False, {})


def test_names_are_given_found_and_told_apart(suite):
    found = suite("logs: [drives/a.mcap, other/a.mcap, {log: drives/b.mcap, name: crossing}]")
    assert names(found) == ["drives-a", "other-a", "crossing"]
    assert names(suite("logs: [drives/a.mcap, {log: drives/a.mcap, name: again}]")) == ["a", "again"]


def test_files_that_belong_together_are_one_case(suite):
    for text in (
        "{log: [drives/a.mcap, drives/b.mcap], name: both}",
        "{log: drives/*.mcap, name: both, together: true}",
    ):
        (case,) = suite(f"logs: [{text}]").cases
        assert case.name == "both"
        assert case.shown == ("drives/a.mcap", "drives/b.mcap")


def test_settings_are_merged_from_the_profile_to_the_case(suite, tmp_path):
    (tmp_path / "car.toml").write_text("start_s = 1.0\nduration_s = 5.0\n[tracking.tracker]\nconfirm_hits = 4\n")
    found = suite("""
        profile: car.toml
        settings: {duration_s: 4, tracking: {tracker: {confirm_existence: 0.6}}}
        logs:
          - drives/a.mcap
          - {log: drives/b.mcap, settings: {tracking: {tracker: {confirm_hits: 3}}}}
        sweep:
          eager: {settings: {tracking: {tracker: {confirm_hits: 1}}}}
    """)
    a, b = (case.settings for case in found.cases)
    assert (a.start_s, a.duration_s) == (b.start_s, b.duration_s) == (1, 4)
    assert [each.tracking.tracker.confirm_existence for each in (a, b)] == [0.6, 0.6]
    assert [each.tracking.tracker.confirm_hits for each in (a, b)] == [4, 3]
    eager = [found.settings_of(case, found.sweep["eager"]) for case in found.cases]
    assert [each.tracking.tracker.confirm_hits for each in eager] == [1, 1]
    assert eager[0].tracking.tracker.confirm_existence == 0.6


def test_expectations_of_suite_and_case_add_up(suite):
    found = suite("""
        expect: [hota >= 0.8, no refused messages]
        logs: [drives/a.mcap, {log: drives/b.mcap, expect: ["id_switches <= 2", "hota >= 0.8"]}]
    """)
    assert [[each.text for each in case.expect] for case in found.cases] == [
        ["hota >= 0.8", "no refused messages"],
        ["hota >= 0.8", "no refused messages", "id_switches <= 2"],
    ]


def test_a_model_may_lie_beside_the_suite(suite, tmp_path):
    (tmp_path / "mine.safetensors").touch()
    found = suite("{model: mine.safetensors, logs: [drives/a.mcap], sweep: {x: {model: vehicle_10hz}}}")
    assert found.model == str(tmp_path / "mine.safetensors")
    assert found.sweep["x"].model == "vehicle_10hz"  # a name


def test_toml_and_json_say_the_same(suite, tmp_path):
    plain = {
        "logs": ["drives/a.mcap", {"log": "drives/b.mcap", "settings": {"start_s": 2}}],
        "tolerances": {"atol": 0.01, "ignore": ["tracks.existence"]},
        "references": "golden",
        "expect": ["hota >= 0.5"],
    }
    from_json = suite(json.dumps(plain), "suite.json")
    from_toml = suite(
        'logs = ["drives/a.mcap", {log = "drives/b.mcap", settings = {start_s = 2}}]\n'
        'references = "golden"\nexpect = ["hota >= 0.5"]\n'
        'tolerances = {atol = 0.01, ignore = ["tracks.existence"]}\n',
        "suite.toml",
    )
    assert from_json.cases == from_toml.cases
    assert from_json.tolerances == from_toml.tolerances == Tolerances(atol=0.01, ignore=("tracks.existence",))
    assert from_json.references == from_toml.references == tmp_path / "golden"


def test_a_log_that_is_not_there_is_its_own_cases_problem(suite):
    found = suite("logs: [drives/a.mcap, {log: drives/gone.mcap, name: gone}, 'nothing/*.mcap']")
    assert [bool(case.problem) for case in found.cases] == [False, True, True]
    assert found.cases[1].problem.endswith("drives/gone.mcap is not there")
    assert "nothing/*.mcap finds no file" in found.cases[2].problem


def test_keys_in_a_url_are_not_shown(suite):
    fsspec.filesystem("memory").pipe("/bucket/a.mcap?key=secret", b"")
    (case,) = suite("logs: ['memory://bucket/a.mcap?key=secret']").cases
    fsspec.filesystem("memory").store.clear()
    assert case.logs[0].url.endswith("a.mcap?key=secret")
    assert (case.name, case.shown) == ("a", ("memory:///bucket/a.mcap",))


@pytest.mark.parametrize("log", ["~nobody-here/a.mcap", "a" * 5000, f"{'a' * 5000}*", "a\\0b", "http://[::1/a.mcap"])
def test_a_log_that_cannot_even_be_looked_for_is_its_own_cases_problem(suite, log):
    good, bad = suite(f'{{logs: [drives/a.mcap, "{log}"], model: "{"m" * 5000}"}}').cases
    assert not good.problem
    assert bad.problem


def test_a_suite_is_found_wherever_one_stands(suite, tmp_path, monkeypatch):
    suite("logs: [drives/a.mcap]")
    monkeypatch.chdir(tmp_path / "other")
    (case,) = read_suite(Path("../suite.yaml")).cases
    assert case.shown == ("drives/a.mcap",)
    assert case.logs[0].path.is_file()


# each line holds the one before nine times: written out, the last one fills a disk
BOMB = "logs: [drives/a.mcap]\nexpect:\n- &a0 [x]\n" + "".join(
    f"- &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
)


def test_a_single_text_is_a_list_of_one(suite):
    listed = suite(
        "logs: ['drives/*.mcap', {log: drives/a.mcap, name: x, expect: [tracks >= 5]}]\nexpect: [hota >= 0.8]"
    )
    single = suite("logs: ['drives/*.mcap', {log: drives/a.mcap, name: x, expect: tracks >= 5}]\nexpect: hota >= 0.8")
    assert single == listed
    assert suite("logs: drives/*.mcap").cases == suite("logs: [drives/*.mcap]").cases != ()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("logs: [drives/a.mcap]\nexpct: []", "suite.yaml: expct: there is nothing of this name; did you mean expect?"),
        ("logs: []", "suite.yaml: logs: "),
        ("expect: []", "suite.yaml: logs: Field required"),
        (
            "logs: [drives/a.mcap, {lgo: x}]",
            "suite.yaml: logs[1].lgo: there is nothing of this name; did you mean log?",
        ),
        ("logs: [drives/a.mcap]\nexpect: [hota >= 0.8, hoat >= 1]", "suite.yaml: expect[1]: no replay has a figure"),
        ("logs: [drives/a.mcap]\nexpect: hoat >= 0.8", "suite.yaml: expect[0]: no replay has a figure called hoat"),
        ("logs: [drives/a.mcap]\nexpect: {hota: 0.8}", "suite.yaml: expect: Input should be"),
        (
            "logs: [drives/a.mcap]\nsettings: {tracking: {trackr: {}}}",
            "suite.yaml: settings.tracking.trackr: there is nothing of this name; did you mean tracker?",
        ),
        (
            "logs: [{log: drives/a.mcap, settings: {start_s: -1}}]",
            "suite.yaml: logs[0].settings.start_s: Input should be",
        ),
        (
            "logs: [drives/a.mcap]\nsweep: {x: {settings: {tracking: {tracker: {confirm_hits: 0}}}}}",
            "suite.yaml: sweep.x.settings.tracking.tracker.confirm_hits: Input should be",
        ),
        (
            "logs: [drives/a.mcap]\nsweep: {x: {modle: y}}",
            "suite.yaml: sweep.x.modle: there is nothing of this name; did you",
        ),
        ("logs: [drives/a.mcap]\nsweep: {a/b: {}}", "suite.yaml: sweep.a/b: 'a/b' cannot be part of a file's name"),
        ("logs: [drives/a.mcap]\ntolerances: {atol: -1}", "suite.yaml: tolerances.atol: Input should be"),
        ("logs: [{log: drives/a.mcap, name: ../a}]", "suite.yaml: logs[0].name: '../a' cannot"),
        ("logs: [{log: drives/*.mcap, name: x}]", "logs[0]: drives/*.mcap finds 2 logs, which cannot all be called x"),
        ("logs: [{log: drives/a.mcap, name: b}, drives/b.mcap]", "2 cases are called b ("),
        ("logs: [{log: drives/a.mcap, name: B}, drives/b.mcap]", "2 cases are called B or b ("),
        (
            "logs: [drives/a.mcap, {log: drives/b.mcap, name: A.Eager}]\nsweep: {eager: {}}",
            "suite.yaml: the files of a, eager and of A.Eager would have one name; rename one",
        ),
        ("logs: [drives/a.mcap]\nsweep: {x: {}, X: {}}", "the files of a, x and of a, X would have one name"),
        (f"logs: [{{log: drives/a.mcap, name: {'é' * 60}}}]", "is too long for the names of files; 100 bytes are"),
        ('logs: [drives/a.mcap]\nreferences: "a\\0b"', "suite.yaml: references: String should match"),
        (BOMB, "expect[0]: an expectation reads like 'hota >= 0.8' or 'no refused messages', got a list"),
        ("logs: ['drives/*.mcap', drives/a.mcap]", "drives/a.mcap is among the logs twice; give one of them a name"),
        ("logs: [drives/a.mcap\nexpect: []", "suite.yaml is not YAML: line 2, column "),
        ("logs: [drives/a.mcap]\nlogs: []", "suite.yaml is not YAML: line 2, column 1: found duplicate key"),
        ("- drives/a.mcap", "suite.yaml must hold names and values at its top, and holds a list"),
        ("", "suite.yaml must hold names and values at its top, and holds nothing"),
        ("logs: [drives/a.mcap]\nprofile: gone.toml", "gone.toml cannot be read: No such file"),
    ],
)
def test_mistakes_name_file_and_place(suite, text, words):
    with pytest.raises(SettingsError) as refusal:
        suite(text)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_mistakes_in_other_files(suite, tmp_path):
    with pytest.raises(SettingsError, match=r"suite\.txt must end in .yaml, .yml, .toml or .json"):
        suite("logs: []", "suite.txt")
    with pytest.raises(SettingsError, match=r"suite\.toml is not TOML: .*line 1"):
        suite("logs = ]", "suite.toml")
    with pytest.raises(SettingsError, match=r"gone\.yaml cannot be read: No such file"):
        read_suite(tmp_path / "gone.yaml")
    (tmp_path / "car.toml").write_text("strat_s = 1")
    with pytest.raises(SettingsError, match=r"car\.toml: strat_s: there is nothing of this name; did you mean start_s"):
        suite("logs: [drives/a.mcap]\nprofile: car.toml")
    (tmp_path / "latin.yaml").write_bytes(b"logs: [\xe9]")
    with pytest.raises(SettingsError, match=r"latin\.yaml is not YAML: 'utf-8' codec"):
        read_suite(tmp_path / "latin.yaml")
