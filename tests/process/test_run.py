"""Real processes on the default bus: the loop, its stops, its refusals, and what the log proves of them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from hil.log.check import seal
from hil.log.reader import open_log
from hil.replay import replay
from hil.runtime.session import run
from hil.runtime.setup import Overrides, load_setup
from hil.signals import FIELDS, DriveState, Reason, RxFlag
from hil.sim.demo import emulator_process
from hil.sim.simulate import simulate_ticks

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]


@contextmanager
def hil(*words: str) -> Iterator[subprocess.Popen[str]]:
    """A hil command as a process, killed at the latest when the test ends."""
    process = subprocess.Popen(
        [sys.executable, "-m", "hil.cli", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def flags(settings: tuple[str, ...]) -> list[str]:
    return [word for setting in settings for word in ("--set", setting)]


def call(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "hil.cli", *words], capture_output=True, text=True, timeout=120, check=False
    )


def only_log(folder: Path) -> Path:
    logs = sorted(folder.glob("logs/*.mcap"))
    assert len(logs) == 1
    return logs[0]


def wait_for_log(folder: Path) -> Path:
    """The log of a run that has begun, once it has some size."""
    for _ in range(1500):
        logs = sorted(folder.glob("logs/*.mcap"))
        if logs and logs[0].stat().st_size > 50_000:
            return logs[0]
        time.sleep(0.05)
    raise AssertionError("the run does not begin")


def voltages_after_stop(path: Path) -> Any:
    """Voltages of all ticks from the first with a reason on."""
    ticks = open_log(path).ticks
    stopped = ticks[ticks["reason"] != 0]
    return np.abs(stopped["u_q"]) + np.abs(stopped["u_d"])


def test_the_demo_says_what_happened(configs: Path, settings: Settings) -> None:
    done = call("demo", str(configs / "demo.toml"), "--json", *flags(settings("loop.duration_s=4.0")))
    result = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    assert result["replay"] == {
        "verdict": "same",
        "ticks": result["ticks"],
        "first_difference": None,
        "why": "",
        "notes": [],
    }
    assert set(result["lateness_us"]) == {"p50", "p99", "p999", "max"}
    assert result["ticks"] + result["skipped"] >= 3990
    assert 2.0 < result["dip_rad_s"] < 8.0 and 20 < result["recovery_ms"] < 300
    assert Path(result["log"]).is_file()


PLL = '{kind="pll",pole_1_rad_s=1000.0,pole_2_rad_s=1000.0}'


@pytest.mark.corners
@pytest.mark.parametrize(
    ("name", "more", "plant"),
    [
        ("demo.toml", (), ()),
        ("current.toml", (), ()),
        ("current.toml", (f"drive.speed_filter={PLL}",), ("firmware.speed_pll_rad_s=1000.0",)),
    ],
)
def test_lockstep_twice_and_simulated_are_the_same_to_the_bit(
    configs: Path, settings: Settings, name: str, more: tuple[str, ...], plant: tuple[str, ...]
) -> None:
    path, own = configs / name, settings('loop.clock="lockstep"', "loop.duration_s=3.0", *more)
    overrides, logged = Overrides(settings=own), []
    setup = load_setup(path, overrides)
    for cores in ({0}, {0, 1}):
        with emulator_process(path, overrides, plant):
            os.sched_setaffinity(0, cores & set(range(os.cpu_count() or 1)))
            logged.append(open_log(Path(run(setup).log)).ticks)
    os.sched_setaffinity(0, set(range(os.cpu_count() or 1)))
    simulated = simulate_ticks(setup, list(plant))
    seal(simulated)  # what the log's writer adds
    assert len(simulated) > 3000
    for field in FIELDS:
        first = logged[0][field.name].tobytes()
        assert first == logged[1][field.name].tobytes(), field.name
        assert first == simulated[field.name].tobytes(), field.name


@pytest.mark.corners
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_stop_safely(
    configs: Path, settings: Settings, tmp_path: Path, number: signal.Signals
) -> None:
    own = settings("loop.duration_s=60.0")
    path = configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own)), hil("run", str(path), *flags(own)) as process:
        wait_for_log(tmp_path)
        process.send_signal(number)
        process.communicate(timeout=30)
        assert process.returncode == 0
    log = open_log(only_log(tmp_path))
    assert log.damage is None and log.result["ended"] == "stop_requested"
    assert (voltages_after_stop(log.path) == 0).all()
    assert log.ticks["state"][-1] == DriveState.SWITCH_ON_DISABLED


def test_a_killed_run_leaves_a_readable_log_and_a_drive_at_rest(
    configs: Path, settings: Settings, tmp_path: Path, channel: str
) -> None:
    own = settings("loop.duration_s=60.0", "guardian.enabled=false")  # the drive's own watchdog alone
    path = configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own)), hil("run", str(path), *flags(own)) as process:
        log_file = wait_for_log(tmp_path)
        process.kill()
        process.communicate()
        killed_ns = time.monotonic_ns()
        with can.Bus(interface="hil-local", channel=channel) as bus:
            assert emergency_of(bus) == 0x8130
    time.sleep(1.0)  # the writer notices the end of its input and finishes
    log = open_log(log_file)
    assert log.damage is None and log.result["ended"] == "controller died"
    assert killed_ns - int(log.ticks["t_ns"][-1]) < 1_000_000_000
    assert replay(log_file).verdict == "same"


def emergency_of(bus: can.BusABC) -> int:
    """Ask the drive with a SYNC what state it is in; return the error code of its emergency message."""
    for counter in range(1, 100):
        bus.send(can.Message(arbitration_id=0x80, data=[counter], is_extended_id=False))
        while (message := bus.recv(0.02)) is not None:
            if message.arbitration_id == 0x81:
                return int.from_bytes(message.data[:2], "little")
    raise AssertionError("no emergency message")


def test_a_drive_that_dies_ends_the_run(configs: Path, settings: Settings, tmp_path: Path) -> None:
    own = settings("loop.duration_s=60.0")
    path = configs / "demo.toml"
    with (
        emulator_process(path, Overrides(settings=own)) as pid,
        hil("run", str(path), *flags(own)) as process,
    ):
        wait_for_log(tmp_path)
        os.kill(pid, signal.SIGKILL)
        out, _ = process.communicate(timeout=30)
        assert process.returncode == 1
        assert "stale feedback" in out
    log = open_log(only_log(tmp_path))
    assert log.result["ended"] == "stale_feedback" and log.ticks["state"][-1] == DriveState.FAULT
    assert (voltages_after_stop(log.path) == 0).all()


def test_without_a_drive_nothing_is_sent(configs: Path, settings: Settings, channel: str) -> None:
    with can.Bus(interface="hil-local", channel=channel) as bus:
        done = call("run", str(configs / "demo.toml"), *flags(settings("drive.heartbeat_timeout_s=0.3")))
        assert bus.recv(0.1) is None
    assert done.returncode == 2
    waiting, refusal = done.stderr.splitlines()
    assert waiting.startswith("hil: waiting for the drive")
    assert refusal.startswith("hil: no drive heard on hil-local:") and "start it: hil emulate" in refusal


def test_a_real_bus_is_refused_without_arm(configs: Path, settings: Settings) -> None:
    done = call("run", str(configs / "demo.toml"), *flags(settings()), "-i", "socketcan", "-c", "can0")
    assert done.returncode == 2 and "arm with --arm" in done.stderr


@pytest.mark.corners
@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("loop.rate_hzz=1", "unknown key; did you mean 'rate_hz'?"),
        ('drive.dbc="none.dbc"', "can't be read"),
        ("observer.speed.gamma_2_rad_s=25.0", "equal poles in channel 0"),
        ("observer.speed.delay_ms=0.1", "shorter than a tick"),
        ('log.folder="/proc/none"', "can't be"),
    ],
)
def test_refusals_are_one_clear_line(configs: Path, settings: Settings, override: str, said: str) -> None:
    done = call("run", str(configs / "demo.toml"), *flags(settings(override)))
    assert done.returncode == 2
    assert said in done.stderr and "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_frame_flood_and_a_second_master_end_safely(
    configs: Path, settings: Settings, tmp_path: Path, channel: str
) -> None:
    own = settings("loop.duration_s=60.0")
    path = configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own)), hil("run", str(path), *flags(own)) as process:
        wait_for_log(tmp_path)
        with can.Bus(interface="hil-local", channel=channel) as bus:
            for k in range(300):  # foreign ids: ridden through
                bus.send(can.Message(arbitration_id=0x500 + k % 64, data=os.urandom(8), is_extended_id=False))
            time.sleep(0.2)
            assert process.poll() is None
            bus.send(can.Message(arbitration_id=0x201, data=bytes(8), is_extended_id=False))
        process.communicate(timeout=30)
        assert process.returncode == 1
    log = open_log(only_log(tmp_path))
    assert log.result["ended"] == Reason.FOREIGN_COMMAND.name.lower()
    assert (voltages_after_stop(log.path) == 0).all()


def test_one_flipped_bit_is_found(configs: Path, settings: Settings, tmp_path: Path) -> None:
    from hil.replay import compare, machine_of, replayed

    done = call("simulate", str(configs / "demo.toml"), "--json", "--duration", "2", *flags(settings()))
    log = open_log(Path(json.loads(done.stdout)["log"]))
    ticks = log.ticks.copy()
    assert compare(ticks, replayed(machine_of(log), ticks)) is None
    row = 1234
    pattern = ticks["w"][row : row + 1].copy().view(np.uint64)
    ticks["w"][row] = (pattern ^ np.uint64(1)).view(np.float64)[0]
    found = compare(ticks, replayed(machine_of(log), ticks))
    assert found is not None
    assert found.tick == row and found.field in ("d_hat_w", "d_hat_q") and found.ulp > 0


@pytest.mark.corners
@pytest.mark.parametrize("pacing", ["timer", "feedback"])
def test_a_drive_that_takes_no_sync(configs: Path, settings: Settings, pacing: str, tmp_path: Path) -> None:
    own = settings(f'loop.pacing="{pacing}"', "loop.duration_s=2.0", "reference.w_rad_s=30.0")
    path = configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own), ('pacing="cyclic"',)):
        result = run(load_setup(path, Overrides(settings=own)))
    assert Reason(result.outcome.reason) == Reason.STOP_REQUESTED
    ticks = open_log(Path(result.log)).ticks
    fresh = (ticks["rx_flags"] & int(RxFlag.FRESH)) != 0
    # two free clocks: where they meet, a frame that misses its tick by its jitter is taken by the next one
    assert fresh.mean() > 0.5
    assert abs(ticks["w"][1500] - 30.0) < 1.0
    assert replay(Path(result.log)).verdict == "same"


LOADED = """
import sys
from hil import cli
code = cli.main(sys.argv[1:])
import can  # as a run has it, which must not bring the rest
print(code, *sorted({name.split(".")[0] for name in sys.modules} | set(sys.modules)))
"""
NOT_FOR_A_LOOP = (
    "asammdf", "coverage", "dask", "distributed", "firmware_model", "h5py", "IPython", "matplotlib",
    "mcap.writer", "numba.np.arrayobj", "openpyxl", "pandas", "PIL", "plotly", "polars", "pyarrow", "rerun",
    "rich", "scipy.io", "scipy.linalg", "scipy.optimize", "scipy.signal", "scipy.special", "scipy.stats",
    "textual", "websockets",
)  # fmt: skip
"""What takes long to load and is for exports, campaigns, pages, the terminal, the drive, compiling."""


def loaded(*words: str) -> list[str]:
    """Exit code of a command, then what its process has loaded."""
    command = [sys.executable, "-c", LOADED, *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout.split()


def test_a_run_loads_nothing_that_is_for_other_commands(configs: Path, settings: Settings) -> None:
    """All that comes before arming: kernels, log, guardian, client; then no drive is there."""
    own = settings("drive.heartbeat_timeout_s=0.1", "log.split_s=60.0")
    code, *modules = loaded("run", str(configs / "demo.toml"), *flags(own))
    assert code == "2" and {"hil.runtime.fused", "hil.runtime.guardian", "hil.log.recorder"} <= set(modules)
    assert not set(NOT_FOR_A_LOOP) & set(modules)


def test_an_emulated_drive_loads_no_exports_either(tmp_path: Path) -> None:
    (tmp_path / "empty.toml").write_text("")
    code, *modules = loaded("emulate", str(tmp_path / "empty.toml"))
    assert code == "2" and "hil.sim.emulate" in modules
    assert not {"asammdf", "coverage", "matplotlib", "pandas"} & set(modules)


@pytest.mark.long
@pytest.mark.parametrize("name", ["demo.toml", "cia402.toml"])
def test_a_simulation_loads_what_reads_mf4_no_more_than_a_run(configs: Path, name: str) -> None:
    """Nor does any command that a bus or its DBC is read for: python-can is imported in one way."""
    _, *modules = loaded("simulate", str(configs / name), "--no-log", "--set", "loop.duration_s=0.1")
    assert {"can", "cantools"} <= set(modules) and not {"asammdf", "pandas"} & set(modules)
