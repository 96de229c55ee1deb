"""The short form of `make soak`, and that it can fail: a leak, lost descriptors, a run that ended early."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.soak.run import Track, findings, process_findings, show

pytestmark = [pytest.mark.process, pytest.mark.alone, pytest.mark.slow]


@pytest.mark.long
def test_twenty_seconds_lose_nothing_and_grow_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = findings(20.0, tmp_path)
    show(found, 20.0)
    assert all(one.good for one in found), capsys.readouterr().out


@pytest.mark.parametrize(
    ("memory", "descriptors", "threads", "bad"),
    [
        ([1000] * 20, [5] * 20, [2] * 20, []),
        ([1000 + 100 * k for k in range(20)], [5] * 20, [2] * 20, ["controller: private memory"]),
        ([1000] * 20, [5] * 10 + [6] * 10, [2] * 20, ["controller: descriptors"]),
        ([1000] * 20, [5] * 20, [2] * 10 + [3] * 10, ["controller: threads"]),
        ([1000] * 7, [5] * 7, [2] * 7, ["controller"]),
    ],
)
def test_what_grows_is_bad(
    memory: list[int], descriptors: list[int], threads: list[int], bad: list[str]
) -> None:
    found = process_findings("controller", Track(1, memory, descriptors, threads), 600.0)
    assert [one.what for one in found if not one.good] == bad
