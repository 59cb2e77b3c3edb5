"""Checks of whole suites: what is caught, what passes, what is written, and that nothing depends on the workers."""

import io
import pickle
import re
import shutil
import xml.etree.ElementTree as ET
from dataclasses import replace

import pytest
from rich.console import Console

from pcgan import checkpoint
from replay import check as check_module
from replay.check import CheckOptions, Rerun, check_suite, in_suite_words, is_page_or_free
from replay.check_page import case_folder, write_page
from replay.check_result import CaseResult, Judged, Moment, MomentKind, Status
from replay.check_table import mean_figures, print_check, print_sweep
from replay.errors import OutputError
from replay.junit import junit_xml
from replay.log_reader import checksum
from replay.reference import read_reference, reference_path
from replay.settings_file import SettingsError
from replay.suite import read_suite
from replay.workers import failure_of

TWO_CASES = """
logs:
  - {log: DRIVE, name: first, settings: {duration_s: 1.5}}
  - {log: DRIVE, name: second, settings: {start_s: 1, duration_s: 1.5}}
model: MODEL
"""


def jobs_here(work, jobs, workers):
    """Stands in for `run_jobs`, in this process: starting workers takes seconds, and has tests of its own."""
    assert workers >= 1
    for i, job in enumerate(jobs):
        try:
            yield i, pickle.loads(pickle.dumps(work(pickle.loads(pickle.dumps(job)))))
        except Exception as error:
            yield i, failure_of(error)


@pytest.fixture
def in_process(monkeypatch):
    monkeypatch.setattr(check_module, "run_jobs", jobs_here)


@pytest.fixture(scope="module")
def write_suite(short_drive, model):
    """Writes a suite about the short drive into a folder and reads it."""

    def write(folder, *lines):
        path = folder / "suite.yaml"
        path.write_text("\n".join(lines).replace("DRIVE", str(short_drive)).replace("MODEL", str(model)))
        return read_suite(path)

    return write


@pytest.fixture
def suite(tmp_path, write_suite):
    def make(text: str = TWO_CASES, *more: str):
        return write_suite(tmp_path, text, *more)

    return make


@pytest.fixture(scope="module")
def baseline(write_suite, tmp_path_factory):
    """The references of the suite of two cases."""
    made = write_suite(tmp_path_factory.mktemp("baseline"), TWO_CASES)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(check_module, "run_jobs", jobs_here)
        assert statuses(check_suite(made, CheckOptions(reason="baseline"))) == [Status.NEW] * 2
    return made.references


@pytest.fixture
def referenced(suite, baseline, in_process):  # noqa: ARG001  how it is run
    """The suite of two cases with its references written."""
    made = suite()
    shutil.copytree(baseline, made.references)
    return made


def statuses(done):
    return [result.status for result in done.results]


def references(suite):
    return {path.name: (checksum(path), path.stat().st_mtime_ns) for path in suite.references.iterdir()}


def with_settings(settings, case=""):
    """The suite of two cases with settings changed, of one case or of both."""
    if case:
        return TWO_CASES.replace(f"name: {case}, settings: {{", f"name: {case}, settings: {{{settings}, ")
    return f"{TWO_CASES}\nsettings: {{{settings}}}"


# --- references ------------------------------------------------------------------------------------------------------


def test_without_references_nothing_passes_and_nothing_is_written(suite, in_process):  # noqa: ARG001
    done = check_suite(suite(), CheckOptions())
    assert statuses(done) == [Status.UNREFERENCED] * 2
    assert not done.passed
    assert "--update --reason" in done.results[0].problem
    assert not suite().references.exists()


def test_what_changes_nothing_is_identical_and_references_stay_untouched(referenced):
    before = references(referenced)
    for reason in (None, "again"):
        done = check_suite(referenced, CheckOptions(reason=reason))
        assert statuses(done) == [Status.IDENTICAL] * 2
        assert done.passed
        assert done.references == ()
        assert references(referenced) == before


def test_a_changed_setting_of_the_tracker_is_caught_where_it_first_shows(referenced, suite):
    before = references(referenced)
    changed = suite(with_settings("tracking: {tracker: {confirm_hits: 5}}", "second"))
    done = check_suite(changed, CheckOptions())
    assert statuses(done) == [Status.IDENTICAL, Status.CHANGED]
    second = done.results[1]
    assert second.problem.startswith("/pcgan/tracks at ")
    assert ": only in the reference" in second.problem
    assert second.problem.startswith(str(second.diff.first).split(":")[0])
    assert second.reference.changed == ("tracking.tracker.confirm_hits 2 -> 5",)
    assert references(referenced) == before


def test_a_retrained_model_is_caught_where_it_first_predicts_otherwise(referenced, suite, model, tmp_path):  # noqa: ARG001
    network, trained = checkpoint.load_network(model)
    weights = {name: 1.01 * tensor for name, tensor in network.state_dict().items()}
    checkpoint.save(tmp_path / "retrained.safetensors", trained.config, weights, {"data": "none"})
    done = check_suite(suite(TWO_CASES.replace("MODEL", "retrained.safetensors")), CheckOptions(only=("first",)))
    (first,) = done.results
    assert first.status is Status.CHANGED
    assert re.match(
        r"/pcgan/predictions at 0\.\d+ s, track \d+, path 0 [a-z0-9 ]+: \S+ vs \S+ \(atol 0.0001\)$", first.problem
    )
    (cause,) = first.reference.changed
    assert re.match(r"model random \(\w{8}\) -> retrained \(\w{8}\)$", cause)


def test_a_model_of_another_rate_is_caught(referenced, suite):  # noqa: ARG001
    (first,) = check_suite(suite(TWO_CASES.replace("MODEL", "vehicle_2.5hz")), CheckOptions(only=("first",))).results
    assert first.status is Status.CHANGED
    assert first.problem == "/pcgan/predictions at 0.000 s, dt_s: 0.100 vs 0.400 (atol 0.0001)"


def test_update_writes_what_differs_or_is_missing_and_says_why(referenced, suite):
    untouched = references(referenced)["first.reference.mcap"]
    changed = suite(
        with_settings("tracking: {tracker: {confirm_hits: 5}}", "second").replace(
            "model:", "  - {log: DRIVE, name: third, settings: {duration_s: 0.8}}\nmodel:"
        )
    )
    done = check_suite(changed, CheckOptions(reason="five hits"))
    assert statuses(done) == [Status.IDENTICAL, Status.UPDATED, Status.NEW]
    assert [path.name for path in done.references] == ["second.reference.mcap", "third.reference.mcap"]
    assert done.passed
    assert references(changed)["first.reference.mcap"] == untouched
    stored = read_reference(reference_path(changed.references, "second"))
    assert stored.reason == "five hits"
    assert [each["reason"] for each in stored.former] == ["baseline"]
    assert statuses(check_suite(changed, CheckOptions())) == [Status.IDENTICAL] * 3
    assert not [path for path in changed.references.iterdir() if not path.name.endswith(".reference.mcap")]


def test_a_reference_that_cannot_be_read_is_its_cases_error(referenced):
    path = reference_path(referenced.references, "first")
    path.write_bytes(b"nonsense")
    done = check_suite(referenced, CheckOptions())
    assert statuses(done) == [Status.ERROR, Status.IDENTICAL]
    assert "first.reference.mcap" in done.results[0].problem
    assert done.results[0].details == ""
    done = check_suite(referenced, CheckOptions(reason="mended"))
    assert statuses(done) == [Status.UPDATED, Status.IDENTICAL]
    assert read_reference(path).reason == "mended"


def test_references_of_no_case_are_noted(referenced, suite):
    fewer = suite(TWO_CASES.replace("name: second", "name: other"))
    done = check_suite(fewer, CheckOptions(reason="renamed"))
    (note,) = done.notes
    assert "second.reference.mcap is the reference of no case in " in note
    assert reference_path(referenced.references, "second").exists()
    assert check_suite(fewer, CheckOptions(only=("other",))).notes == ()


def test_a_worker_that_fails_behind_its_replay_writes_no_reference(referenced, suite, monkeypatch):
    """Of such a case what was to become the reference is left, and must not become it."""
    before = references(referenced)
    changed = suite(with_settings("tracking: {tracker: {confirm_hits: 5}}"))

    def full(*_):
        raise OutputError("the disk is full")

    monkeypatch.setattr(check_module.Moments, "finish", full)
    done = check_suite(changed, CheckOptions(reason="five hits"))
    assert statuses(done) == [Status.ERROR] * 2
    assert done.results[0].problem == "the disk is full"
    assert done.references == ()
    assert references(referenced) == before


def test_nothing_is_written_over_a_recording(referenced, suite, short_drive, tmp_path):  # noqa: ARG001
    kept = tmp_path / "kept"
    kept.mkdir()
    recording = shutil.copy(short_drive, kept / "first.pcgan.mcap")
    before = checksum(recording)
    mine = suite(TWO_CASES.replace("DRIVE, name: first", "kept/first.pcgan.mcap, name: first"))
    with pytest.raises(
        OutputError, match=r"first\.pcgan\.mcap is a recording of the suite, which is never overwritten"
    ):
        check_suite(mine, CheckOptions(keep=kept))
    recording.rename(mine.references / "first.reference.mcap")
    mine = suite(TWO_CASES.replace("DRIVE, name: first", "references/first.reference.mcap, name: first"))
    with pytest.raises(OutputError, match=r"first\.reference\.mcap is a recording of the suite"):
        check_suite(mine, CheckOptions(reason="x"))
    assert checksum(mine.references / "first.reference.mcap") == before
    assert list(kept.iterdir()) == []


def test_references_that_cannot_be_written_are_told_in_a_line(suite, in_process, tmp_path):  # noqa: ARG001
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"the references' folder .*file is a file; choose another"):
        check_suite(suite(TWO_CASES, "references: file"), CheckOptions(reason="x"))
    with pytest.raises(OutputError, match="inside cannot be written: Not a directory"):
        check_suite(suite(TWO_CASES, "references: file/inside"), CheckOptions(reason="x"))


# --- expectations and errors -----------------------------------------------------------------------------------------


def test_expectations_are_judged(referenced, suite):
    asking = suite(TWO_CASES, "expect: [hota >= 1.5, no refused messages, ground_truth.nll <= 5]")
    done = check_suite(asking, CheckOptions())
    assert statuses(done) == [Status.UNMET] * 2
    first = done.results[0]
    assert [judged.met for judged in first.judged] == [False, True, False]
    assert first.judged[2].value is None  # too short a drive to score a prediction of 4.8 s
    assert first.problem.startswith("hota >= 1.5: it is 0.")
    assert first.problem.endswith("; ground_truth.nll <= 5: the replay has no such figure")
    assert first.reference is not None
    before = references(referenced)
    assert statuses(check_suite(asking, CheckOptions(reason="no"))) == [Status.UNMET] * 2
    assert references(referenced) == before


def test_a_reference_may_be_written_of_what_is_unmet(suite, in_process):  # noqa: ARG001
    asking = suite(TWO_CASES, "expect: [hota >= 1.5]")
    done = check_suite(asking, CheckOptions(reason="as it is"))
    assert statuses(done) == [Status.UNMET] * 2
    assert len(done.references) == 2


def test_writing_a_reference_does_not_meet_an_expectation(referenced, suite):  # noqa: ARG001
    asking = suite(with_settings("tracking: {tracker: {confirm_hits: 5}}", "second"), "expect: [hota >= 1.5]")
    done = check_suite(asking, CheckOptions(reason="five hits"))
    assert statuses(done) == [Status.UNMET] * 2
    assert [path.name for path in done.references] == ["second.reference.mcap"]
    assert done.results[1].problem.startswith("hota >= 1.5: it is 0.")
    assert not done.passed


def test_a_log_that_cannot_be_replayed_fails_alone(referenced, suite, tmp_path):  # noqa: ARG001
    (tmp_path / "damaged.mcap").write_bytes(b"\x89MCAP0\r\nnothing")
    broken = suite(TWO_CASES.replace("model:", "  - damaged.mcap\n  - gone.mcap\nmodel:"))
    steps = []
    done = check_suite(broken, CheckOptions(reason="x"), lambda done, every: steps.append((done, every)))
    assert [result.case for result in done.results] == ["first", "second", "damaged", "gone"]
    assert statuses(done) == [Status.IDENTICAL, Status.IDENTICAL, Status.ERROR, Status.ERROR]
    assert "damaged.mcap" in done.results[2].problem
    assert done.results[3].problem.endswith("gone.mcap is not there")
    assert all("\n" not in result.problem for result in done.results)
    assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_a_model_that_is_nowhere_is_every_cases_error(referenced, suite):  # noqa: ARG001
    done = check_suite(suite(TWO_CASES.replace("MODEL", "nobody")), CheckOptions())
    assert statuses(done) == [Status.ERROR] * 2
    assert "no checkpoint nobody" in done.results[0].problem


def test_only_some_cases(referenced):
    assert [result.case for result in check_suite(referenced, CheckOptions(only=("sec*",))).results] == ["second"]
    with pytest.raises(SettingsError, match=r"no case of .*suite\.yaml is called third; its cases are first, second"):
        check_suite(referenced, CheckOptions(only=("third",)))


# --- what else comes out ---------------------------------------------------------------------------------------------


def test_outputs_are_kept_where_they_are_wanted(referenced, tmp_path, mcap_content):
    kept = tmp_path / "outputs"
    done = check_suite(referenced, CheckOptions(keep=kept))
    assert sorted(path.name for path in kept.iterdir()) == ["first.pcgan.mcap", "second.pcgan.mcap"]
    assert [result.output for result in done.results] == [kept / "first.pcgan.mcap", kept / "second.pcgan.mcap"]
    assert mcap_content(kept / "first.pcgan.mcap").metadata["pcgan"]["complete"] == "true"
    assert check_suite(referenced, CheckOptions()).results[0].output is None


def test_a_sweep_tries_variants_side_by_side(referenced, suite):
    swept = suite(
        TWO_CASES,
        "expect: [tracks >= 1]",
        "sweep: {strict: {settings: {tracking: {tracker: {confirm_hits: 50}}}}, shipped: {model: vehicle_10hz}}",
    )
    assert [result.variant for result in check_suite(swept, CheckOptions()).results] == ["", ""]
    done = check_suite(swept, CheckOptions(sweep=True, reason="untouched"))
    assert [(result.case, result.variant) for result in done.results] == [
        (case, variant) for case in ("first", "second") for variant in ("", "strict", "shipped")
    ]
    assert statuses(done) == [Status.IDENTICAL, Status.UNMET, Status.MET] * 2
    assert done.references == ()
    assert done.results[1].reference is None
    assert [result.summary["model"]["name"] for result in done.results[:3]] == ["random", "random", "vehicle_10hz"]
    assert [(result.steps, result.step_s) for result in done.results[:3]] == [(12, 0.1), (0, 0.0), (12, 0.1)]
    mean = mean_figures(done.results)
    tracks = [result.summary["tracks"] for result in done.results if not result.variant]
    assert mean[""]["tracks"] == sum(tracks) / 2
    assert mean["strict"]["tracks"] == 0
    assert references(referenced).keys() == {"first.reference.mcap", "second.reference.mcap"}


def test_a_mean_is_over_the_cases_that_every_variant_has():
    def result(case, variant, **summary):
        return CaseResult(case, variant, (), Status.MET, summary=summary)

    results = [result("a", "", x=1, y=4), result("a", "v", x=2), result("b", "", x=3, y=6), result("b", "v", x=6, y=8)]
    assert mean_figures(results) == {"": {"x": 2, "y": 6}, "v": {"x": 4, "y": 8}}


def printed(show, results, width=None):
    """What is printed: in a terminal of some width, or without one in a pipe."""
    out = io.StringIO()
    terminal = {"force_terminal": True, "color_system": None, "width": width} if width else {}
    show(results, Console(file=out, **terminal))
    return [line.rstrip() for line in out.getvalue().splitlines()]


def test_a_column_for_each_figure_and_in_a_terminal_those_that_fit():
    figures = ("hota", "mota", "idf1", "ade_m", "ground_truth.ade_m", "id_switches", "missed", "false")
    met = tuple(Judged(f"{name} <= 0.9", 0.5, met=True) for name in figures)
    results = [
        CaseResult("a", "", (), Status.IDENTICAL, judged=met, summary={"ade_m": 0.5}),
        CaseResult("b", "", (), Status.UNMET, "x", judged=(Judged("hota <= 0.9", 0.5, met=True),)),
        CaseResult(
            "c",
            "",
            (),
            Status.UNMET,
            "x",
            judged=(
                Judged("false <= 0.4", 0.5, met=False),
                Judged("false >= 0.1", 0.5, met=True),
                Judged("no false", 0.5, met=False),
            ),
        ),
    ]
    piped = printed(print_check, results)
    assert piped[0].split() == ["ground_truth"]
    assert " ".join(piped[1].split()) == ("case status took s hota mota idf1 ade_m .ade_m id_switches missed false")
    assert piped[5].split() == ["c", "unmet", "✗", "0.500", "(<=", "0.4,", "==", "0)"]
    narrow = printed(print_check, results, 60)
    assert max(map(len, narrow[:5])) <= 60
    assert narrow[0].split() == ["case", "status", "hota", "mota", "false"]
    assert (
        narrow[5] == "not shown, as the window is narrow: idf1, ade_m, ground_truth.ade_m, id_switches, missed, took s"
    )
    assert printed(print_check, results, 20)[0].split() == ["case", "status"]  # whatever the window, no less


def test_a_sweep_compares_no_errors_of_models_that_look_ahead_otherwise():
    def result(variant, steps, step_s, **summary):
        return CaseResult("a", variant, (), Status.MET, summary=summary, steps=steps, step_s=step_s)

    lines = printed(
        print_sweep,
        [
            result("", 12, 0.4, tracks=5, ade_m=0.5, ground_truth={"nll": 1.5}),
            result("alike", 12, 0.4, tracks=6, ade_m=0.6, ground_truth={"nll": 1.5}),
            result("near", 12, 0.1, tracks=7, ade_m=0.25, ground_truth={"nll": 0.5}),
            result("nobody", 0, 0.0, tracks=0),
        ],
    )
    rows = {line.split()[0]: line.split()[1:] for line in lines if line}
    assert rows["tracks"] == ["5", "6", "(+1)", "7", "(+2)", "0", "(-5)"]
    assert rows["ade_m"] == ["0.500", "0.600", "(+0.100)", "0.250", "-"]
    assert rows["ground_truth.nll"] == ["1.500", "1.500", "0.500", "-"]
    assert lines[-1] == (
        "near: no differences of ade_m, fde_m, mhd_m, nll, as its model looks ahead 12 steps of 0.1 s, "
        "and the suite's 12 of 0.4 s"
    )


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        ("a.mcap is damaged; try --salvage", "a.mcap is damaged; say salvage: true in the suite"),
        ("none; use --tracks /objects", "none; use roles: {tracks: /objects} in the settings"),
        ("choose one with --role pose:=TOPIC", "choose one with roles: {pose: TOPIC} in the settings"),
        ("a.mcap is not there", "a.mcap is not there"),
    ],
)
def test_hints_are_what_a_suite_can_say(problem, words):
    assert in_suite_words(problem) == words


def test_a_page_takes_over_no_folder_of_something_else(tmp_path):
    assert is_page_or_free(tmp_path / "new")
    assert is_page_or_free(tmp_path)
    (tmp_path / ".pcgan-check-killed").mkdir()
    assert is_page_or_free(tmp_path)
    (tmp_path / "index.html").write_text("a page of pcgan?")
    assert not is_page_or_free(tmp_path)
    (tmp_path / "index.html").unlink()
    write_page([CaseResult("a", "", (), Status.MET)], tmp_path)
    assert is_page_or_free(tmp_path)
    (tmp_path / "index.html").write_text("<!DOCTYPE html>")
    assert not is_page_or_free(tmp_path)


def test_a_page_gets_recordings_of_what_changed(referenced, suite, tmp_path):  # noqa: ARG001
    pytest.importorskip("rerun")
    changed = suite(with_settings("tracking: {tracker: {confirm_hits: 5}}", "second"))
    page = tmp_path / "page"
    recordings = [case_folder(page, case, "") / "replay.rrd" for case in ("first", "second")]
    recordings[0].parent.mkdir(parents=True)
    recordings[0].touch()  # an older page left it behind
    done = check_suite(changed, CheckOptions(page=page, rerun=Rerun.CHANGED))
    assert [result.recording for result in done.results] == [None, recordings[1]]
    assert not recordings[0].exists()
    assert recordings[1].stat().st_size > 1000
    assert done.notes == ()
    assert write_page(done.results, page).is_file()


def test_pictures_replace_those_of_an_older_page(referenced, tmp_path, monkeypatch):
    page = tmp_path / "page"
    shown = case_folder(page, "first", "") / "pictures"
    shown.mkdir(parents=True)
    (shown / "old.png").touch()

    def with_picture(task):
        result = run_case(task)
        picture = task.folder / "pictures" / "new.png"
        picture.parent.mkdir(parents=True, exist_ok=True)
        picture.touch()
        assert (shown / "old.png").exists()  # until every case has been replayed
        moment = Moment(MomentKind.MISSED, 0, 0, 1, "", 0, -1, 0, 0, 0, 0, turning=False, near_vehicle=False)
        return replace(result, moments=(moment, replace(moment, picture=picture)))

    run_case = check_module.run_case
    monkeypatch.setattr(check_module, "run_case", with_picture)
    done = check_suite(referenced, CheckOptions(page=page, rerun=Rerun.NONE, only=("first",)))
    assert [moment.picture for moment in done.results[0].moments] == [None, shown / "new.png"]
    assert [path.relative_to(page).as_posix() for path in page.rglob("*") if path.is_file()] == [
        "cases/first/pictures/new.png"
    ]
    assert [path.name for path in page.iterdir()] == ["cases"]


@pytest.mark.parametrize(
    ("rerun", "page", "drawn"),
    [
        (Rerun.CHANGED, True, {Status.CHANGED, Status.UNMET}),
        (Rerun.ALL, True, set(Status) - {Status.ERROR}),
        (Rerun.NONE, True, set()),
        (Rerun.ALL, False, set()),
    ],
)
def test_who_gets_a_recording(tmp_path, rerun, page, drawn):
    options = CheckOptions(page=tmp_path if page else None, rerun=rerun)
    results = [CaseResult("a", "", (), status) for status in Status]
    assert {result.status for result in results if check_module.is_drawn(result, options)} == drawn


# --- worker processes ------------------------------------------------------------------------------------------------


def plain(done):
    """Everything that a check found, without times: as JSON and as JUnit XML."""
    rows = [{**result.as_json(), "wall_s": 0} for result in done.results]
    root = ET.fromstring(junit_xml(done.results, "suite"))
    for element in root.iter():
        element.attrib.pop("time", None)
    return rows, ET.tostring(root)


ALL_KINDS = (
    TWO_CASES.replace("model:", "  - gone.mcap\nmodel:"),
    "settings: {tracking: {tracker: {confirm_hits: 5}}}",
    "expect: [hota >= 0.5]",
)


def test_worker_processes_say_what_this_process_says(referenced, suite, monkeypatch):  # noqa: ARG001
    changed = suite(*ALL_KINDS)
    here = plain(check_suite(changed, CheckOptions()))
    monkeypatch.undo()  # from here on with processes
    assert plain(check_suite(changed, CheckOptions(workers=2))) == here
    assert [row["status"] for row in here[0]] == ["changed", "changed", "error"]


@pytest.mark.slow
def test_one_worker_and_two_say_the_same(referenced, suite, monkeypatch):  # noqa: ARG001
    monkeypatch.undo()
    one, two = (plain(check_suite(suite(*ALL_KINDS), CheckOptions(workers=n))) for n in (1, 2))
    assert one == two


@pytest.mark.slow
def test_twenty_repetitions_are_identical(suite, tmp_path):
    entries = [f"{{log: DRIVE, name: repetition {i}, settings: {{duration_s: 1}}}}" for i in range(20)]
    repeated = suite(f"{{logs: [{', '.join(entries)}], model: MODEL}}")
    done = check_suite(repeated, CheckOptions(workers=2, keep=tmp_path / "kept", reason="the first"))
    assert statuses(done) == [Status.NEW] * 20
    assert len({checksum(path) for path in (tmp_path / "kept").iterdir()}) == 1
    assert len({digest for digest, _ in references(repeated).values()}) == 1
    assert statuses(check_suite(repeated, CheckOptions(workers=1))) == [Status.IDENTICAL] * 20
