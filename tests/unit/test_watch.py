"""The list of runs, the note of a stop, sparklines: what `hil watch` is made of."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from hil.cli import main
from hil.log.records import EVENT_BYTES, pack_event_record
from hil.log.ring import Ring
from hil.runtime import registry
from hil.runtime.registry import WatchError, announced, ask_stop, choose, own_entry, runs, who_asked
from hil.signals import TICK, new_ticks
from hil.watch.feed import Feed
from hil.watch.look import Look, figures, unpack_events
from hil.watch.terminal import frame, sparkline


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(registry, "elsewhere", list)
    return tmp_path / "hil"


def entry(channel: str = "demo") -> registry.Entry:
    return own_entry(Path("/logs/a.mcap"), f"hil-local:{channel}", 1000, None)


def test_a_run_is_listed_while_it_runs_and_only_its_user_can_read_that(own_folder: Path) -> None:
    with announced(entry()):
        assert runs() == [entry()]
        assert own_folder.stat().st_mode & 0o777 == 0o700
        assert [f.stat().st_mode & 0o777 for f in own_folder.iterdir()] == [0o600]
        for name in (str(os.getpid()), "demo", "hil-local:demo", "/logs/a.mcap", "a", None):
            assert choose(name) == entry()
    assert runs() == [] and not list(own_folder.iterdir())


def test_what_a_dead_run_left_is_removed_also_when_its_pid_was_given_again(own_folder: Path) -> None:
    with announced(replace(entry(), start=entry().start - 1)):
        (own_folder / f"{os.getpid()}.stop").write_text("{}")
        assert runs() == [] and not list(own_folder.iterdir())


def test_a_damaged_entry_is_no_run(own_folder: Path) -> None:
    runs()
    for name, text in (("1.json", "{"), ("2.json", '{"pid": 2}'), ("3.json", "[]"), ("4.json", "\x00")):
        (own_folder / name).write_text(text)
    assert runs() == [] and not list(own_folder.iterdir())


def test_a_folder_that_others_can_open_is_refused_but_the_run_goes_on(own_folder: Path) -> None:
    own_folder.mkdir()
    own_folder.chmod(0o755)
    with pytest.raises(WatchError, match="only this user"):
        runs()
    with announced(entry()):
        assert not list(own_folder.iterdir())


def test_a_link_in_place_of_the_folder_is_refused(own_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    own_folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(WatchError):
        runs()


def test_refusals_say_which_or_why(own_folder: Path) -> None:
    with pytest.raises(WatchError, match="no run of this user"):
        choose(None)
    with pytest.raises(WatchError, match="no run with PID, channel or log 'other'"):
        choose("other")
    with pytest.raises(WatchError, match="is no hil run"):
        choose(str(os.getpid()))
    with pytest.raises(WatchError, match="there is none"):
        choose("99999999")
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        second = replace(entry("b"), pid=other.pid, start=registry.start_time(other.pid) or 0)
        with announced(entry()), announced(second):
            with pytest.raises(WatchError, match=rf"2 runs: say which(.|\n)*{other.pid} on hil-local:b"):
                choose(None)
            assert choose("b") == second
        other.communicate()


def test_a_stop_is_asked_once_and_says_who(own_folder: Path) -> None:
    asked: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: asked.append(number))
    try:
        with announced(entry()):
            assert ask_stop(entry(), "me", 5, 6)
            assert not ask_stop(entry(), "another", 7, 8)  # a second signal would be a quick stop
            assert who_asked(os.getpid()) == (5, 6, "me")
            assert who_asked(os.getpid()) is None
        assert not ask_stop(entry(), "too late", 7, 8)
        assert not ask_stop(replace(entry(), start=1), "another process", 7, 8)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert asked == [signal.SIGTERM]


def test_a_run_of_another_environment_is_seen_and_stopped(
    own_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a system unit's: it has no XDG_RUNTIME_DIR, its viewer has one."""
    other, asked = tmp_path / f"hil-{os.getuid()}", list[int]()
    monkeypatch.setattr(registry, "elsewhere", lambda: [other, tmp_path / "none", tmp_path / "open"])
    (tmp_path / "open").mkdir(mode=0o755)
    (tmp_path / "open" / "5.json").write_text("precious")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    before = signal.signal(signal.SIGTERM, lambda number, _: asked.append(number))
    try:
        with announced(entry()):
            assert (other / f"{os.getpid()}.json").is_file()
            monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
            assert runs() == [entry()] and choose("demo") == entry()
            assert ask_stop(entry(), "me", 5, 6) and not ask_stop(entry(), "another", 7, 8)
            monkeypatch.delenv("XDG_RUNTIME_DIR")
            assert who_asked(os.getpid()) == (5, 6, "me")
    finally:
        signal.signal(signal.SIGTERM, before)
    assert asked == [signal.SIGTERM] and runs() == []
    assert (tmp_path / "open" / "5.json").is_file(), "what others can write to is left alone"


@pytest.fixture
def ring() -> Iterator[Ring]:
    made = [Ring.create(name, size, 64) for name, size in (("ticks", TICK.itemsize), ("events", EVENT_BYTES))]
    yield made[0]
    for one in made:
        one.close()


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The viewer's clock [ns], for the test to set."""
    time_ns = [7_000_000_000]
    monkeypatch.setattr("hil.runtime.clock.RealClock.now_ns", lambda _: time_ns[0])
    return time_ns


@pytest.mark.parametrize(("age_s", "silent"), [(0.0, False), (0.299, False), (0.301, True), (90.0, True)])
def test_the_figures_of_a_loop_that_hangs_have_an_age(
    ring: Ring, now: list[int], age_s: float, silent: bool
) -> None:
    ticks = new_ticks(20)
    ticks["t_ns"] = now[0] - np.arange(20)[::-1] * 1_000_000
    now[0] += round(age_s * 1e9)
    for at in range(20):
        ring.push(ticks[at : at + 1].tobytes())
    look = Look(entry())
    found = figures(look, look.latest(20))
    assert found["silent"] == silent and found["age_s"] == age_s
    assert found["rate_hz"] == (round(19 / (0.019 + age_s), 1) if silent else 1000.0)
    shown = Console(width=100, record=True, file=io.StringIO())
    shown.print(frame(look, 100))
    text = shown.export_text()
    assert (f"no tick for {age_s:.1f} s" in text) == silent and ("1000 Hz of 1000" in text) != silent
    look.close()


def test_in_lockstep_the_age_counts_from_what_the_viewer_saw(ring: Ring, now: list[int]) -> None:
    look = Look(replace(entry(), clock="lockstep"))
    for _ in range(2):
        ring.push(new_ticks(1).tobytes())
        assert look.age_s(look.latest(1)) == 0.0
        now[0] += 400_000_000
        assert look.age_s(look.latest(1)) == 0.4 and look.is_silent(0.4)
    look.close()


def test_a_process_without_rings_is_refused() -> None:
    with pytest.raises(WatchError, match="no ring"):
        Look(entry())


def test_a_run_of_another_version_is_refused() -> None:
    other = Ring.create("ticks", TICK.itemsize + 8, 4)
    with pytest.raises(WatchError, match=f"process {os.getpid()} is of another version of hil"):
        Look(entry())
    other.close()


def test_events_come_back_from_their_records() -> None:
    raw = pack_event_record(1, 2, "state", "äh") + pack_event_record(3, 4, "stop", "")
    assert unpack_events(raw) == [(1, 2, "state", "äh"), (3, 4, "stop", "")]


def test_since_gives_each_record_once_and_skips_what_is_gone() -> None:
    ring, seen, got = Ring.create("t", 8, 8), 0, []
    sizes = (3, 0, 5, 1, 20, 2)  # 20 is more than it holds
    number = 0
    for size in sizes:
        for _ in range(size):
            ring.push(number.to_bytes(8, "little"))
            ring.take(final=True)
            number += 1
        raw, seen = ring.since(seen)
        got += np.frombuffer(raw, "<u8").tolist()
    ring.close()
    assert got == [*range(9), *range(22, 29), 29, 30]


def test_a_spike_shows_in_a_sparkline_and_a_constant_is_flat() -> None:
    values = np.zeros(3000)
    values[1234] = 9.0
    line = sparkline(values, 60, 1.0)
    assert len(line) == 60 and line.count("█") == 1 and line.count("▁") == 59
    assert len(set(sparkline(np.full(100, 7.0), 20, 1.0))) == 1
    assert sparkline(np.full(5, np.nan), 20, 1.0) == ""


def test_of_several_nodes_each_is_seen_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    rings = [Ring.create(name, TICK.itemsize, 100) for name in ("ticks", "ticks-1")]
    rings.append(Ring.create("events", EVENT_BYTES, 8))
    bench = replace(entry(), nodes=("motor", "load"), takes={"w": (-1.0, 1.0, 1.0)})
    for ring, w in zip(rings, (40.0, -7.0), strict=False):
        ticks = new_ticks(1)
        ticks["w"] = w
        ring.push(ticks.tobytes())
    seen = {}
    with announced(bench):
        assert [run.nodes for run in runs()] == [("motor", "load")], "the names come back as they were"
        for node in ("", "motor", "load"):
            look = Look(choose(None), node)
            seen[node, look.node] = float(look.latest(1)["w"][0])
            look.close()
        assert seen == {("", "motor"): 40.0, ("motor", "motor"): 40.0, ("load", "load"): -7.0}
        with pytest.raises(WatchError, match="has no node 'other'; it has motor and load"):
            Look(bench, "other")
        with pytest.raises(WatchError, match="has no node 'load'; it is of one drive: leave the node out"):
            Look(entry(), "load")
        assert main(["watch", "--json", "--node", "load"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert told["w"] == -7.0 and {name: one["w"] for name, one in told["nodes"].items()} == {
            "motor": 40.0, "load": -7.0
        }  # fmt: skip
        assert main(["watch", "--once", "--node", "load"]) == 0
        assert "node load (another: --node motor)" in capsys.readouterr().out
        assert main(["watch", "--foxglove", "--open", "--node", "load"]) == 2
        assert "has the ticks of all nodes; leave out --node load" in capsys.readouterr().err
        (status,) = Feed(None, "other").next()
        assert "has no node 'other'" in json.loads(status)["status"]
        feed = Feed(None, "load")
        opening = json.loads(feed.next()[0])["run"]
        assert opening["node"] == "load" and opening["takes"] == {}, "w is the motor's"
        assert feed.look is not None and feed.look.node == "load"
        assert feed.look.set({"w": 0.5}, "a test") == "refused: this run takes no set-point"
        feed.look.close()
    for ring in rings:
        ring.close()
