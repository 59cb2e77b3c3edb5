"""A check's results as JUnit XML, which every CI system shows: a suite per variant, a test case per log."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence

from replay.check_result import CaseResult, Judged, Status
from replay.reference import words

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # XML 1.0 has no way to write these


def junit_xml(results: Sequence[CaseResult], suite: str) -> bytes:
    """Returns the XML; what changed is a failure, what could not be replayed an error, with the first line as message.

    Args:
        results: in the order in which they are to appear.
        suite: its name; variants of a sweep are called SUITE.VARIANT.
    """
    root = ET.Element("testsuites", {"name": _legal(suite), **_totals(results)})
    for variant in dict.fromkeys(result.variant for result in results):
        members = [result for result in results if result.variant == variant]
        name = f"{suite}.{variant}" if variant else suite
        element = ET.SubElement(root, "testsuite", {"name": _legal(name), **_totals(members), "skipped": "0"})
        for result in members:
            _add_case(element, result, name)
    ET.indent(root)
    xml: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return xml + b"\n"


def _totals(results: Sequence[CaseResult]) -> dict[str, str]:
    errors = sum(result.status is Status.ERROR for result in results)
    failures = sum(not result.status.passed for result in results) - errors
    seconds = sum(result.wall_s for result in results)
    return {"tests": str(len(results)), "failures": str(failures), "errors": str(errors), "time": f"{seconds:.3f}"}


def _add_case(suite: ET.Element, result: CaseResult, name: str) -> None:
    attributes = {"classname": _legal(name), "name": _legal(result.case), "time": f"{result.wall_s:.3f}"}
    case = ET.SubElement(suite, "testcase", attributes)
    if not result.status.passed:
        kind = "error" if result.status is Status.ERROR else "failure"
        problem = ET.SubElement(case, kind, {"message": _legal(result.problem), "type": result.status.value})
        problem.text = _legal("\n".join([result.problem, *result.details.splitlines(), *_unmet_lines(result)]))
    ET.SubElement(case, "system-out").text = _legal("\n".join(_lines(result)))


def _lines(result: CaseResult) -> list[str]:
    """Returns what a reader of the CI's page needs to find the cause."""
    lines = [f"status: {result.status}", f"logs: {', '.join(result.logs)}"]
    lines += [f"since the reference: {change}" for change in (result.reference.changed if result.reference else ())]
    if result.diff is not None:
        lines += [f"first difference: {words(topic.first)}" for topic in result.diff.topics if topic.first is not None]
    return lines + [_judged_line(judged) for judged in result.judged]


def _unmet_lines(result: CaseResult) -> list[str]:
    """Returns what is not met of a case that failed for another reason; else the problem says it."""
    if result.status is Status.UNMET:
        return []
    return [_judged_line(judged) for judged in result.judged if not judged.met]


def _judged_line(judged: Judged) -> str:
    value = "the replay has no such figure" if judged.value is None else f"{judged.value:.6g}"
    return f"{'met' if judged.met else 'not met'}: {judged.text} ({value})"


def _legal(text: str) -> str:
    return _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text)
