"""One controller and one emulated drive a bus; a real bus is armed by a person and in real time alone."""

from __future__ import annotations

import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import can
import pytest

from hil.log.reader import open_log
from hil.runtime.claim import ClaimedError, claimed
from hil.runtime.setup import Overrides
from hil.signals import RxFlag
from hil.sim.demo import emulator_process
from tests.process.test_run import call, flags, hil, only_log, wait_for_log

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]


def test_a_second_run_is_refused_and_the_first_goes_on(
    configs: Path, settings: Settings, tmp_path: Path
) -> None:
    path = configs / "demo.toml"
    own = settings("loop.duration_s=60.0")
    second = settings("loop.duration_s=60.0", f'log.folder="{tmp_path / "second"}"')
    with emulator_process(path, Overrides(settings=own)), hil("run", str(path), *flags(own)) as process:
        log = wait_for_log(tmp_path)
        done = call("run", str(path), *flags(second))
        assert done.returncode == 2 and f"process {process.pid} sends 0x201 on hil-local:" in done.stderr
        assert "nothing was sent" in done.stderr
        size = log.stat().st_size
        time.sleep(0.5)
        assert process.poll() is None and log.stat().st_size > size
        process.terminate()
        assert process.wait(30) == 0
    found = open_log(only_log(tmp_path))
    assert found.result["ended"] == "stop_requested"
    assert not (found.ticks["rx_flags"] & int(RxFlag.FOREIGN_COMMAND)).any()
    assert not list((tmp_path / "second").glob("*"))


@pytest.mark.corners
@pytest.mark.parametrize("frame", [(0x080, b"\1"), (0x201, bytes(8))])
def test_a_controller_elsewhere_is_heard_and_left_alone(
    configs: Path, settings: Settings, channel: str, frame: tuple[int, bytes]
) -> None:
    path, ends = configs / "demo.toml", threading.Event()
    own = settings()

    def master() -> None:
        with can.Bus(interface="hil-local", channel=channel) as bus:
            while not ends.wait(0.02):
                bus.send(can.Message(arbitration_id=frame[0], data=frame[1], is_extended_id=False))

    thread = threading.Thread(target=master)
    with emulator_process(path, Overrides(settings=own)):
        thread.start()
        try:
            done = call("run", str(path), *flags(own))
        finally:
            ends.set()
            thread.join()
    assert done.returncode == 2 and f"another controller sends 0x{frame[0]:X}" in done.stderr, done.stderr
    assert "nothing was sent" in done.stderr


def test_a_second_emulator_of_a_node_says_so(configs: Path, settings: Settings) -> None:
    path, own = configs / "demo.toml", settings()
    with emulator_process(path, Overrides(settings=own)) as pid:
        done = call("emulate", str(path), *flags(own))
    assert done.returncode == 2
    assert f"hil: process {pid} sends node 1 on hil-local:" in done.stderr and "already" in done.stderr


def test_a_name_is_free_once_its_process_is_killed() -> None:
    script = (
        "import time\nfrom hil.runtime.claim import claimed\n"
        "with claimed('hil-local', 'c', ['x']): print(1, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == b"1\n"
        with pytest.raises(ClaimedError, match=f"process {holder.pid} sends x on hil-local:c already"):
            claimed("hil-local", "c", ["x"]).__enter__()
        with claimed("hil-local", "other", ["x"]), claimed("hil-local", "c", ["y"]):
            pass
        holder.kill()
        holder.wait()
        with claimed("hil-local", "c", ["x"]):
            pass


def test_a_bus_of_one_process_is_nobody_elses() -> None:
    with claimed("virtual", "c", ["x"]), claimed("virtual", "c", ["x"]):
        pass


@pytest.mark.corners
@pytest.mark.parametrize(
    "words", [["--lockstep"], ["--set", 'loop.clock="lockstep"'], ["--lockstep", "--shadow"]]
)
def test_lockstep_on_a_real_bus_is_refused(configs: Path, settings: Settings, words: list[str]) -> None:
    own = flags(settings())
    done = call("run", str(configs / "can0.toml"), *own, "-c", "nonecan9", "--arm", "--yes", *words)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "keeps its own time: nothing was sent" in done.stderr


@pytest.mark.corners
@pytest.mark.parametrize("stdin", ["</dev/null", "<&-", "<<<yes"])
def test_without_a_terminal_arm_alone_is_refused(configs: Path, settings: Settings, stdin: str) -> None:
    words = ["run", str(configs / "can0.toml"), *flags(settings()), "-c", "nonecan9", "--arm"]
    line = shlex.join([sys.executable, "-m", "hil.cli", *words]) + f" {stdin}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=180, check=False)
    assert done.returncode == 2, done.stderr
    assert "no terminal to ask on; nothing was sent; --yes" in done.stderr and "can't open" not in done.stderr
