"""`hil identify` asks before it arms on a bus that may be real, and ends without torque on an interrupt."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil.log.reader import open_log
from hil.signals import DriveState
from tests.process.test_arming import talk
from tests.process.test_run import call, flags, hil, wait_for_log

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]
COMMAND = 0x201


def on_a_real_bus(configs: Path, settings: Settings) -> list[str]:
    """On an interface that no machine has."""
    return ["identify", str(configs / "can0.toml"), *flags(settings()), "-c", "nonecan9"]


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (b"no\n", "the answer was not yes; nothing was sent"),
        (b"yes\n", "can't open bus socketcan:nonecan9"),
    ],
)
def test_a_real_bus_asks_with_the_limits_and_takes_the_answer(
    configs: Path, settings: Settings, answer: bytes, said: str
) -> None:
    code, shown = talk([*on_a_real_bus(configs, settings), "--arm"], answer)
    assert code == 2 and said in shown
    for limit in ("60 V", "5 A", "40 rad/s", "socketcan:nonecan9"):
        assert limit in shown
    if answer == b"no\n":
        assert "can't open bus" not in shown and "step sensors" not in shown


@pytest.mark.long
def test_without_arm_or_a_terminal_nothing_is_opened(configs: Path, settings: Settings) -> None:
    for words, said in (((), "arm with --arm"), (("--yes",), "arm with --arm"), (("--arm",), "terminal")):
        done = call(*on_a_real_bus(configs, settings), *words)
        assert done.returncode == 2 and said in done.stderr, done.stderr
        assert "can't open bus" not in done.stderr and not done.stdout
    done = call(*on_a_real_bus(configs, settings), "--arm", "--yes")
    assert done.returncode == 2 and "can't open bus" in done.stderr


def test_an_interrupt_in_the_midst_ends_it_without_torque(
    configs: Path, settings: Settings, tmp_path: Path
) -> None:
    """While torque grows and the shaft turns: this step ends as a stopped run does, the next never begins."""
    file = tmp_path / "motor.toml"
    words = ("identify", str(configs / "demo.toml"), "--emulated", "--steps", "spinning,inertia", "--json")
    with hil(*words, "-o", str(file), *flags(settings())) as process:
        log = wait_for_log(tmp_path)
        while log.stat().st_size < 400_000 and process.poll() is None:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        out, said = process.communicate(timeout=60)
    assert process.returncode == 1, said
    result = json.loads(out)
    assert "step spinning was stopped" in result["faults"] and result["file"] is None and not file.exists()
    assert [row["step"] for row in result["steps"]] == ["spinning"]
    assert list(tmp_path.glob("logs/*.mcap")) == [Path(result["logs"][0])]
    run = open_log(Path(result["logs"][0]))
    assert run.result["ended"] == "stop_requested" and np.abs(run.ticks["w"]).max() > 5.0
    assert run.ticks["state"][-1] == DriveState.SWITCH_ON_DISABLED
    stopped = run.ticks[run.ticks["reason"] != 0]
    assert len(stopped) and (stopped["u_q"] == 0).all() and (stopped["u_d"] == 0).all()
    sent = [frame.data for frame in run.frames if not frame.received and frame.can_id == COMMAND]
    assert sent[-1][4:8] == bytes(4), "the last command carries a voltage"
