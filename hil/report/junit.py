"""Verdicts of many logs as JUnit XML, the form that CI servers read."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from hil.replay import Verdict
from hil.report.view import verdict_text


def junit(results: list[tuple[Path, Verdict, float]]) -> str:
    """One test case a log: ``differs`` is a failure, ``cannot`` an error. Times in s."""
    verdicts = [verdict.verdict for _, verdict, _ in results]
    suite = ET.Element(
        "testsuite",
        name="hil replay",
        tests=str(len(results)),
        failures=str(verdicts.count("differs")),
        errors=str(verdicts.count("cannot")),
        time=f"{sum(seconds for *_, seconds in results):.3f}",
    )
    for path, verdict, seconds in results:
        case = ET.SubElement(suite, "testcase", classname="hil.replay", name=str(path), time=f"{seconds:.3f}")
        if verdict.verdict != "same":
            kind = "failure" if verdict.verdict == "differs" else "error"
            ET.SubElement(case, kind, message=verdict_text(verdict.as_dict()))
    ET.indent(suite)
    return ET.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"
