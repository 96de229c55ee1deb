"""A log that a second process reads is the log that one reads oneself: blocks, events, damage, errors."""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import threading
from collections.abc import Generator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from hil.log import ahead as module
from hil.log.ahead import ahead, forked
from hil.log.errors import LogError
from hil.log.reader import Block, Log, new_log, read_blocks
from hil.replay import replay
from hil.report.collect import collect

GOLDEN = sorted((Path(__file__).parents[1] / "golden" / "logs").rglob("*.mcap"))


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """A log that breaks off in the middle."""
    raw = next(path for path in GOLDEN if path.stem == "lockstep").read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(raw[: len(raw) * 2 // 3])
    return path


def known(log: Log) -> dict[str, Any]:
    return {name: value for name, value in asdict(log).items() if name not in ("ticks", "frames")}


def assert_same(path: Path) -> None:
    own, others = new_log(path), new_log(path)
    for ours, theirs in zip(read_blocks(own), forked(others, read_blocks), strict=True):
        assert ours.kind == theirs.kind and ours.records.dtype == theirs.records.dtype
        assert ours.records.tobytes() == theirs.records.tobytes()
        assert theirs.records.flags.writeable
        assert known(own) == known(others)
    assert known(own) == known(others)


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_blocks_and_all_that_gathers_on_the_way_are_the_same(path: Path) -> None:
    assert_same(path)


def test_damage_is_the_same(cut: Path) -> None:
    assert_same(cut)
    log = new_log(cut)
    assert len(list(forked(log, read_blocks))) > 0 and "damaged" in str(log.damage)


def test_blocks_larger_than_a_slot_go_through_the_pipe(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SLOT_BYTES", 4096)
    assert_same(GOLDEN[0])


def test_what_is_no_log_is_refused_with_the_same_words(tmp_path: Path) -> None:
    path = tmp_path / "no.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(LogError) as own:
        list(read_blocks(new_log(path)))
    with pytest.raises(LogError) as others:
        list(forked(new_log(path), read_blocks))
    assert str(own.value) == str(others.value)


def test_one_that_looks_no_further_leaves_no_process() -> None:
    before = psutil.Process().children()
    blocks = forked(new_log(GOLDEN[0]), read_blocks)
    next(blocks)
    assert len(psutil.Process().children()) == len(before) + 1
    blocks.close()
    assert psutil.Process().children() == before


def test_a_process_that_is_killed_is_told_of_and_what_it_read_stays(cut: Path) -> None:
    def through(log: Log) -> Generator[Block, None, None]:
        yield next(read_blocks(log))
        os.kill(os.getpid(), signal.SIGKILL)

    log, seen = new_log(cut), []
    with pytest.raises(LogError, match=r"cut\.mcap: the process that reads it was killed; is memory short\?"):
        seen.extend(forked(log, through))
        pytest.fail("it went on")
    assert log.tick_count > 0


def test_it_pays_for_a_long_log_without_other_threads_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []

    def through(log: Log) -> Generator[Block, None, int]:
        yield next(read_blocks(log))
        seen.append(os.getpid())
        return os.getpid()

    def went() -> bool:
        """True where another process went through it."""
        passing = ahead(new_log(GOLDEN[0]), through)
        next(passing)
        with pytest.raises(StopIteration) as end:
            next(passing)
        assert (seen == []) == (end.value.value != os.getpid())
        seen.clear()
        return bool(end.value.value != os.getpid())

    assert not went()
    monkeypatch.setattr(module, "WORTH_BYTES", 1)
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    assert went()
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    assert not went()
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setattr(threading, "active_count", lambda: 2)
    assert not went()


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_verdict_and_report_do_not_depend_on_it(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alone, report = replay(path), collect(path)
    monkeypatch.setattr(module, "_pays", lambda _: True)
    assert replay(path) == alone
    again = collect(path)
    assert again.verdict == report.verdict and known(again.log) == known(report.log)
    for one, other in zip(again.curves(), report.curves(), strict=True):
        np.testing.assert_array_equal(one, other)


BLOCKS = """
import resource, sys
import numpy as np
from hil.commands.common import keep_memory
if sys.argv[1] == "kept":
    keep_memory()
faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for turn in range(200):
    if turn == 20:
        begin = faults()
    blocks = [np.ones(430_000, np.uint8) for _ in range(5)]
    del blocks
print(faults() - begin)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries stay as they are")
def test_what_is_freed_is_kept_for_the_next_blocks() -> None:
    """Pages that the system clears anew, with blocks of the size of a log's."""
    found = {}
    for way in ("kept", "usual"):
        done = subprocess.run([sys.executable, "-c", BLOCKS, way], capture_output=True, text=True, check=True)
        found[way] = int(done.stdout)
    assert found["kept"] < 1000 and found["usual"] > 50_000, found
