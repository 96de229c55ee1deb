"""A run in parts: each a log by itself, all together the run, and what is there after a kill at a split."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.cli import main
from hil.log.check import seal
from hil.log.errors import LogError
from hil.log.parts import grouped
from hil.log.reader import open_log
from hil.log.recorder import check_folder
from hil.log.recover import recover
from hil.log.split import Limits, SplitFile
from hil.replay import replay
from hil.runtime.session import run
from hil.runtime.setup import Overrides, load_setup
from hil.signals import FIELDS
from hil.sim.demo import emulator_process, own_channel
from hil.sim.simulate import simulate, simulate_ticks
from hil.tuning.verify import same_run
from tests.conftest import CONFIGS
from tests.logfiles import HEADER, some_frames, some_ticks
from tests.process.test_run import flags, hil

pytestmark = pytest.mark.process
AT_ONCE = "stop.ramp_rad_s2=0.0"
"""No ramp before the stop, which would make the run longer."""
Settings = Callable[..., tuple[str, ...]]


@pytest.fixture(scope="module")
def whole() -> Any:
    """Three seconds and a bit, simulated without a log."""
    ticks = simulate_ticks(
        load_setup(CONFIGS / "demo.toml", Overrides(settings=("loop.duration_s=3.2", AT_ONCE)))
    )
    seal(ticks)  # what the log's writer adds
    return ticks


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The same as parts of a second."""
    folder = tmp_path_factory.mktemp("parts")
    settings = ("loop.duration_s=3.2", AT_ONCE, "log.split_s=1.0", f'log.folder="{folder}"', 'log.name="a"')
    simulate(load_setup(CONFIGS / "demo.toml", Overrides(settings=settings)), [])
    return sorted(folder.glob("*.mcap"))


def same_ticks(a: Any, b: Any) -> bool:
    return len(a) == len(b) and all(a[f.name].tobytes() == b[f.name].tobytes() for f in FIELDS)


def test_parts_are_the_run_and_each_replays_alone(parts: list[Path], whole: Any) -> None:
    assert [path.name for path in parts] == [f"a.{n:03d}.mcap" for n in range(4)]
    logs = [open_log(path) for path in parts]
    assert same_ticks(np.concatenate([log.ticks for log in logs]), whole)
    assert [len(log.ticks) for log in logs[:3]] == [1000] * 3
    for path, log in zip(parts, logs, strict=True):
        assert log.damage is None and {"config.json", "controller.json", "drive.dbc"} <= set(log.attachments)
        verdict = replay(path)
        assert (verdict.verdict, verdict.ticks) == ("same", len(log.ticks)), path.name
    assert [log.result["ended"] for log in logs] == [
        "goes on in a.001.mcap", "goes on in a.002.mcap", "goes on in a.003.mcap", "stop_requested",
    ]  # fmt: skip


def test_a_part_whose_state_is_not_its_own_differs(parts: list[Path], tmp_path: Path) -> None:
    """The check above can fail: the kept state of another part is found out."""
    from hil.log.mcapfile import RunFile

    log, other = open_log(parts[2]), open_log(parts[1])
    state = json.loads(log.attachments["state.json"]) | {
        name: json.loads(other.attachments["state.json"])[name] for name in ("safety_state", "law_state")
    }
    attachments = log.attachments | {"state.json": json.dumps(state)}
    with RunFile(tmp_path / "x.mcap", {"metadata": log.metadata["run"], "attachments": attachments}) as file:
        file.add_ticks(log.ticks)
        file.finish({"ended": "x"})
    assert replay(tmp_path / "x.mcap").verdict == "differs"


def test_commands_take_parts_as_one_run(parts: list[Path], whole: Any, tmp_path: Path, capsys: Any) -> None:
    names = [str(path) for path in reversed(parts)]
    assert main(["replay", *names, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ticks"] == len(whole)
    assert main(["info", *names, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["counts"]["/tick"] == len(whole) and "stop_requested" in found["result"]["result"]
    assert main(["report", *names, "-o", str(tmp_path / "r.html"), "--json"]) == 0
    (shown,) = json.loads(capsys.readouterr().out)["runs"]
    assert shown["ticks"] == len(whole) and shown["replay"]["verdict"] == "same" and shown["damage"] is None
    assert main(["export", *names, "-o", str(tmp_path / "a.csv")]) == 0
    assert len((tmp_path / "a.csv").read_text().splitlines()) == len(whole) + 1
    capsys.readouterr()
    assert main(["report", str(parts[1]), "-o", str(tmp_path / "p.html"), "--json"]) == 0
    (shown,) = json.loads(capsys.readouterr().out)["runs"]
    checks = {check["name"]: check["outcome"] for check in shown["checks"]}
    assert checks["ended"] == checks["log"] == checks["replay"] == "pass", checks


def test_another_controller_over_the_parts_is_as_over_the_whole(
    parts: list[Path], whole: Any, tmp_path: Path, capsys: Any
) -> None:
    settings = ("loop.duration_s=3.2", AT_ONCE, f'log.folder="{tmp_path}"', 'log.name="one"')
    one = simulate(load_setup(CONFIGS / "demo.toml", Overrides(settings=settings)), [])["log"]
    new = tmp_path / "new.toml"
    text = (CONFIGS / "demo.toml").read_text().replace("delay_ms = 22.0", "delay_ms = 40.0")
    new.write_text(text.replace('"drives/', f'"{CONFIGS}/drives/'))
    found = []
    for name, logs in (("a", [one]), ("b", [str(path) for path in reversed(parts)]), ("c", [str(parts[2])])):
        out = tmp_path / f"{name}.mcap"
        assert main(["replay", *logs, "--config", str(new), "-o", str(out), "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out))
        assert replay(out).verdict == "same"
    assert found[0]["ticks"] == found[1]["ticks"] == len(whole)
    for a, b in zip(found[0]["rows"], found[1]["rows"], strict=True):
        assert a == b | {"rms": pytest.approx(b["rms"], rel=1e-12)}  # the blocks that are summed are others
    assert same_ticks(open_log(tmp_path / "a.mcap").ticks, open_log(tmp_path / "b.mcap").ticks)
    assert found[2]["ticks"] == 1000 and found[0]["rows"][0]["rms"] > 0
    assert main(["replay", str(parts[0]), one, "--config", str(new)]) == 2
    assert "no parts of one run" in capsys.readouterr().err


def test_a_part_that_is_missing_is_a_gap(parts: list[Path]) -> None:
    verdict = replay((parts[0], parts[2]))
    assert verdict.verdict == "cannot" and "1000 records are missing before tick 2000" in verdict.why
    assert verdict.ticks == 1000


def test_a_damaged_part_is_recovered_as_that_part(parts: list[Path], whole: Any, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(parts[1].read_bytes()[: parts[1].stat().st_size * 9 // 10])
    out = tmp_path / "out.mcap"
    found = recover(tmp_path / "cut.mcap", out)
    assert 100 < found.ticks < 1000 and replay(out).verdict == "same"
    assert grouped([parts[0], out]) == [(parts[0], out)]
    assert same_ticks(open_log((parts[0], out)).ticks, whole[: 1000 + found.ticks])


def test_other_runs_are_not_joined(parts: list[Path], tmp_path: Path, capsys: Any) -> None:
    settings = ("loop.duration_s=1.5", "log.split_s=1.0", f'log.folder="{tmp_path}"', 'log.name="a"')
    setup = load_setup(CONFIGS / "demo.toml", Overrides(settings=settings))
    simulate(setup, [])
    others = sorted(tmp_path.glob("*.mcap"))
    assert grouped([*parts, *others]) == [tuple(parts), tuple(others)]
    assert (
        main(["info", str(parts[0]), str(others[0])]) == 2
        and "no parts of one run" in capsys.readouterr().err
    )
    with pytest.raises(LogError, match="exists already"):
        simulate(setup, [])
    with pytest.raises(LogError, match="exists already"):
        check_folder(tmp_path / "a.mcap", 0)


class NoState:
    """Follows nothing."""

    def feed(self, ticks: Any) -> None:
        """Take no note."""

    def state(self) -> str:
        """Nothing is known."""
        return "{}"


@pytest.mark.parametrize("limits", [Limits(0.35, float("inf")), Limits(float("inf"), 0.05)], ids=["s", "mb"])
def test_every_frame_is_in_one_part_and_with_its_ticks(tmp_path: Path, limits: Limits) -> None:
    """Handed over in uneven pieces, frames before the ticks that they belong to, as the writer does."""
    ticks, frames, rng = some_ticks(1000), some_frames(4000), np.random.default_rng(4)
    file, at, given = SplitFile(tmp_path / "a.mcap", HEADER, limits, NoState(), 4096), 0, 0
    while at < len(ticks):
        end = min(at + int(rng.integers(1, 60)), len(ticks))
        upto = min(end * 4 + int(rng.integers(0, 8)), len(frames))
        file.add_frames(frames[given:upto])
        file.add_ticks(ticks[at:end])
        at, given = end, upto
    file.add_frames(frames[given:])
    file.finish({"ended": "x"})
    paths = sorted(tmp_path.glob("*.mcap"))
    logs = [open_log(path) for path in paths]
    assert len(paths) >= 3 and file.ticks == 1000 and file.frames == 4000
    assert same_ticks(np.concatenate([log.ticks for log in logs]), ticks), "seed 4"
    assert [f.t_ns for log in logs for f in log.frames] == frames["t_ns"].tolist()
    if limits.seconds < 1:
        for log in logs:
            assert log.frames[0].t_ns == log.ticks["t_ns"][0]


def test_lost_ticks_leave_the_next_part_without_a_state(
    parts: list[Path], whole: Any, tmp_path: Path
) -> None:
    from hil.replay.snapshot import StateFollower

    log = open_log(parts[0])
    header = {"metadata": log.metadata["run"], "attachments": log.attachments}
    file = SplitFile(tmp_path / "a.mcap", header, Limits(1.0, float("inf")), StateFollower(header), 1 << 18)
    file.add_ticks(np.concatenate([whole[:500], whole[510:2500]]))
    file.finish({"ended": "x"})
    first, second, _ = sorted(tmp_path.glob("*.mcap"))
    assert "10 records are missing before tick 510" in replay(first).why
    assert replay(second).verdict == "cannot" and "ticks were lost before this part" in replay(second).why


@pytest.mark.long
def test_a_run_on_the_bus_in_parts(configs: Path, settings: Settings, tmp_path: Path) -> None:
    """The same ticks and frames as the run in one file, the writer splitting beside the loop."""
    logs = []
    for more in (("log.split_s=1.0",), ()):
        own = settings(
            'loop.clock="lockstep"', "loop.duration_s=2.5", AT_ONCE, f'log.name="x{len(logs)}"', *more
        )
        overrides = Overrides(settings=own)
        setup = load_setup(configs / "demo.toml", overrides)
        with emulator_process(configs / "demo.toml", overrides):
            result = run(setup)
        assert result.complete and result.dropped == 0
        logs.append(open_log(sorted((tmp_path / "logs").glob(f"x{len(logs)}*.mcap"))))
    split, one = logs
    assert len(split.parts) == 3 and same_ticks(split.ticks, one.ticks)
    # heartbeats come by the clock on the wall, and so any number of them
    assert [f for f in split.frames if f.can_id != 0x701] == [f for f in one.frames if f.can_id != 0x701]
    assert split.events == one.events
    assert all(replay(path).verdict == "same" for path in split.parts)


def writer_of(pid: int) -> int:
    """The writer process of a controller."""
    for entry in Path("/proc").iterdir():
        try:
            child = entry.name.isdigit() and f"\nPPid:\t{pid}\n" in (entry / "status").read_text()
            if child and b"hil.log.writer" in (entry / "cmdline").read_bytes():
                return int(entry.name)
        except OSError:
            continue
    raise AssertionError("there is no writer")


@pytest.mark.long
@pytest.mark.parametrize("who", ["writer", "controller"])
def test_killed_right_at_a_split(configs: Path, settings: Settings, tmp_path: Path, who: str) -> None:
    """The moment at which the second part appears; what was written before is there and replays."""
    own = settings("loop.duration_s=60.0", "log.split_s=1.0", 'log.name="k"')
    path, second = configs / "demo.toml", tmp_path / "logs" / "k.001.mcap"
    with emulator_process(path, Overrides(settings=own)), hil("run", str(path), *flags(own)) as process:
        end = time.monotonic() + 100
        while not (tmp_path / "logs" / "k.000.mcap").exists() and time.monotonic() < end:
            time.sleep(0.02)
        victim = writer_of(process.pid) if who == "writer" else process.pid
        while not second.exists() and time.monotonic() < end:
            time.sleep(0.0005)
        os.kill(victim, signal.SIGKILL)
        process.communicate(timeout=60)
        for _ in range(400):  # the writer outlives the controller and finishes the file
            if who == "writer" or open_log(second).result:
                break
            time.sleep(0.05)
    found = sorted((tmp_path / "logs").glob("k.*.mcap"))
    log = open_log(found)
    assert len(found) >= 2 and log.ticks["k"][-1] >= 950
    assert log.gaps == [] and replay(found).verdict == "same"
    assert all(replay(one).verdict == "same" for one in found if len(open_log(one).ticks))
    if who == "controller":
        assert log.damage is None and log.result["ended"] == "controller died"


@pytest.mark.long
def test_an_adaptive_window_is_the_same_on_the_bus_and_in_a_part_that_begins_in_its_growth(
    tmp_path: Path,
) -> None:
    """All that the window knows is in the law's state: length, dwell, how long a measurement stood still."""
    one = (
        '{kind="adaptive", delay_ms=40.0, short_ms=12.0, first_ms=2.0, w_noise_rad_s=0.0104, '
        "i_noise_a=0.0036}"
    )
    settings = (
        "loop.duration_s=2.4", AT_ONCE, f"observer.speed={one}", f"observer.current={one}", "log.split_s=1.0",
        f'log.folder="{tmp_path}"', 'log.name="a"', 'loop.clock="lockstep"',
    )  # fmt: skip
    plant = ('load=[{kind="step", torque_n_m=5.4, at_s=1.99}]',)
    overrides = Overrides(settings=settings, channel=own_channel("adaptive"))
    with emulator_process(CONFIGS / "rigid.toml", overrides, plant):
        run(load_setup(CONFIGS / "rigid.toml", overrides))
    parts = sorted(tmp_path.glob("*.mcap"))
    assert [replay(path).verdict for path in parts] == ["same"] * 3
    bus = np.concatenate([open_log(path).ticks for path in parts])
    simulated = simulate_ticks(load_setup(CONFIGS / "rigid.toml", overrides), list(plant))
    assert len(bus) > 2300 and same_run(simulated, bus)
    state = json.loads(open_log(parts[2]).attachments["state.json"])["law_state"]
    assert 2 <= state["length"][0] < 40, "the part begins while the window grows"
