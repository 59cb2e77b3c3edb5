"""JUnit XML: what CI systems look for, and what people find there."""

import dataclasses
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from replay.check_result import CaseResult, Judged, Reference, Status
from replay.diff_result import Difference, Kind, LogDiff, TopicDiff
from replay.junit import junit_xml

# What Jenkins, GitLab and GitHub's actions take: element -> attributes it must have, those it may have, its children.
SCHEMA = {
    "testsuites": ({"tests", "failures", "errors", "time"}, {"name"}, {"testsuite"}),
    "testsuite": ({"name", "tests", "failures", "errors", "skipped", "time"}, set(), {"testcase"}),
    "testcase": ({"name", "classname", "time"}, set(), {"failure", "error", "system-out"}),
    "failure": ({"message", "type"}, set(), set()),
    "error": ({"message", "type"}, set(), set()),
    "system-out": (set(), set(), set()),
}


def assert_valid(element):
    required, optional, children = SCHEMA[element.tag]
    assert required <= set(element.keys()) <= required | optional
    for child in element:
        assert child.tag in children
        assert_valid(child)
    if element.tag in ("testsuites", "testsuite"):
        cases = list(element.iter("testcase"))
        assert int(element.get("tests")) == len(cases)
        assert int(element.get("failures")) == sum(case.find("failure") is not None for case in cases)
        assert int(element.get("errors")) == sum(case.find("error") is not None for case in cases)
        assert float(element.get("time")) == pytest.approx(sum(float(case.get("time")) for case in cases), abs=0.01)


@pytest.fixture
def changed():
    first = Difference(Kind.VALUE, "/pcgan/tracks", 1.5, 0, "track 7 x", "tracks.x", "1.0", "1.2", 0.2, 1e-4)
    diff = LogDiff((TopicDiff("/pcgan/tracks", (9, 9), identical=False, same=False, first=first),))
    reference = Reference(Path("r.mcap"), "0.1", "m", "abc", "because", changed=("confirm_hits 2 -> 4",))
    judged = (Judged("hota >= 0.8", 0.75, met=False), Judged("ade_m <= 1", None, met=False))
    return CaseResult(
        "crossing", "", ("a.mcap",), Status.CHANGED, str(first), {}, judged, reference, {}, diff, wall_s=1.25
    )


@pytest.fixture
def results(changed):
    return [
        CaseResult("quiet", "", ("q.mcap",), Status.IDENTICAL, wall_s=0.5),
        changed,
        CaseResult("gone", "", ("g.mcap",), Status.ERROR, "g.mcap is not there", details="Traceback\n  line 1"),
        CaseResult("new", "", ("n.mcap",), Status.UNREFERENCED, "it has no reference"),
    ]


def test_the_shape_that_ci_systems_read(results):
    variants = [dataclasses.replace(result, variant="eager", status=Status.MET) for result in results[:2]]
    data = junit_xml([*results, *variants], "suite")
    assert data.startswith(b"<?xml version='1.0' encoding='utf-8'?>\n<testsuites ")
    root = ET.fromstring(data)
    assert_valid(root)
    assert [suite.get("name") for suite in root] == ["suite", "suite.eager"]
    assert [case.get("name") for case in root[0]] == ["quiet", "crossing", "gone", "new"]
    assert (root.get("tests"), root.get("failures"), root.get("errors")) == ("6", "2", "1")


def test_what_a_reader_finds(results):
    quiet, changed, gone, new = ET.fromstring(junit_xml(results, "suite"))[0]
    assert quiet.find("failure") is None
    assert quiet.find("error") is None
    failure = changed.find("failure")
    assert failure.get("type") == "changed"
    assert failure.get("message") == "/pcgan/tracks at 1.500 s, track 7 x: 1.0 vs 1.2 (atol 0.0001)"
    assert failure.text.splitlines() == [
        "/pcgan/tracks at 1.500 s, track 7 x: 1.0 vs 1.2 (atol 0.0001)",
        "not met: hota >= 0.8 (0.75)",
        "not met: ade_m <= 1 (the replay has no such figure)",
    ]
    assert changed.find("system-out").text.splitlines() == [
        "status: changed",
        "logs: a.mcap",
        "since the reference: confirm_hits 2 -> 4",
        "first difference: /pcgan/tracks at 1.500 s, track 7 x: 1.0 vs 1.2 (atol 0.0001)",
        "not met: hota >= 0.8 (0.75)",
        "not met: ade_m <= 1 (the replay has no such figure)",
    ]
    assert gone.find("error").get("message") == "g.mcap is not there"
    assert gone.find("error").text.splitlines() == ["g.mcap is not there", "Traceback", "  line 1"]
    assert new.find("failure").get("message") == "it has no reference"


def test_what_is_met_is_no_failure_and_what_is_not_is_said_once(changed):
    judged = (Judged("hota >= 0.8", 0.75, met=False), Judged("tracks >= 1", 4, met=True))
    met = dataclasses.replace(changed, judged=judged[1:])
    unmet = dataclasses.replace(changed, status=Status.UNMET, problem="hota >= 0.8: it is 0.75", judged=judged)
    failures = ET.fromstring(junit_xml([met, unmet], "suite")).iter("failure")
    assert [failure.text for failure in failures] == [met.problem, unmet.problem]


def test_what_xml_cannot_hold_is_replaced(changed):
    odd = dataclasses.replace(changed, case="a<b>&\x00\x1b", problem='"quoted" \ud800 ]]>')
    case = ET.fromstring(junit_xml([odd], "s\x07")).find("testsuite/testcase")
    assert case.get("name") == "a<b>&\N{REPLACEMENT CHARACTER}\N{REPLACEMENT CHARACTER}"
    assert case.find("failure").get("message") == '"quoted" \N{REPLACEMENT CHARACTER} ]]>'


def test_nothing_is_a_suite_of_nothing():
    root = ET.fromstring(junit_xml([], "suite"))
    assert_valid(root)
    assert list(root) == []
