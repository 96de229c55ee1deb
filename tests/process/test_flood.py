"""Floods of seeded random frames against a running controller and the emulated drive, as real processes."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.local import pack_frame
from hil.log.reader import open_log
from hil.replay import replay
from hil.signals import DriveState, Reason
from tests.fuzz.client import DATABASE
from tests.fuzz.flood import (
    KINDS,
    Flooder,
    Kind,
    broken,
    damaged,
    datagrams,
    errors,
    flooder,
    foreign,
    forged,
    orders,
    twin,
)
from tests.process.test_run import flags, hil, only_log

pytestmark = [pytest.mark.process, pytest.mark.slow]
Settings = Callable[..., tuple[str, ...]]
COMMAND, FEEDBACK = DATABASE.message("COMMAND"), DATABASE.message("FEEDBACK")
SYNC = pack_frame(DATABASE.message("SYNC").send_id, b"\x01")
ENABLE_OPERATION = 0x0F
HARMLESS = (foreign, twin, broken)
STARVED = {Reason.STALE_FEEDBACK, Reason.COMMAND_LOST, Reason.LOOP_OVERRUN, Reason.FOLLOWING_ERROR}
"""What a flood that fills the sockets may end in: frames of the drive are lost, or the loop comes late."""
BROKEN_WORDS = {
    Reason.CRC_ERRORS,
    Reason.COUNTER_ERRORS,
    Reason.DRIVE_FAULT,
    Reason.FROZEN_FEEDBACK,
    *STARVED,
}
LIES = {
    Reason.OVER_SPEED,
    Reason.OVER_CURRENT,
    Reason.OVER_TEMPERATURE,
    Reason.DC_LINK_UNDER_VOLTAGE,
    Reason.DC_LINK_OVER_VOLTAGE,
    Reason.DRIVE_LEFT_OPERATION,
    Reason.CURRENT_UNCONTROLLED,
    Reason.I2T,
    *BROKEN_WORDS,
}
"""What forged measurements may look like."""


@dataclass
class Bench:
    """A drive, a run on its bus, and the node that floods it."""

    drive: subprocess.Popen[str]
    run: subprocess.Popen[str]
    node: Flooder
    folder: Path

    def until_moving(self) -> None:
        """Wait until the controller commands a voltage; kernels may have to be compiled first."""
        for _ in range(900):
            self.node.listen(0.1)
            if any(abs(COMMAND.decode(data)["VoltageQ"]) > 20.0 for data in self.commands()):
                self.node.heard.clear()
                return
        raise AssertionError("the run does not begin")

    def goes_on(self) -> bool:
        return self.run.poll() is None

    def commands(self) -> list[bytes]:
        """What the controller was heard to command; the flood itself is not heard."""
        return [f.data for f in self.node.heard if f.can_id | f.flags == COMMAND.send_id]

    def ended(self) -> tuple[int, dict[str, Any]]:
        """Exit code and result of the run, once it is over; an exception would be a traceback."""
        out, said = self.run.communicate(timeout=60)
        assert "Traceback" not in said, said
        self.node.listen(0.3)
        assert out, said
        return self.run.returncode, json.loads(out)

    def assert_log_and_wire_agree(self, result: dict[str, Any]) -> None:
        """The log is whole, replays, holds every command that was heard; from the stop on all are zero."""
        log, heard = open_log(only_log(self.folder)), self.commands()
        assert log.damage is None and log.result["ended"] == result["ended"]
        assert result["log_complete"] and result["dropped"] == 0
        assert len(log.ticks) == result["ticks"] and replay(log.path).verdict == "same"
        assert any(e["kind"] == "stop" and result["ended"].upper() in e["text"] for e in log.events)
        stopped = log.ticks[log.ticks["reason"] != 0]
        assert len(stopped) and not stopped["u_q"].any() and not stopped["u_d"].any()
        assert stopped["state"][-1] in (DriveState.FAULT, DriveState.SWITCH_ON_DISABLED)
        sent = [f.data for f in log.frames if not f.received and f.can_id == COMMAND.can_id]
        assert heard and (log.result["dropped_frames"] or sent[-len(heard) :] == heard)
        asked = [COMMAND.decode(data) for data in heard]
        first = next((k for k, c in enumerate(asked) if c["Controlword"] != ENABLE_OPERATION), len(asked))
        assert all(c["VoltageQ"] == c["VoltageD"] == 0.0 for c in asked[first:])

    def assert_drive_is_at_rest(self) -> None:
        """It answers a SYNC of ours and carries no current, sends no more, and ends as it should."""
        state = self.answer()
        assert state["State"] != DriveState.OPERATION_ENABLED
        assert abs(state["CurrentQ"]) < 0.1 and abs(state["CurrentD"]) < 0.1
        self.drive.send_signal(signal.SIGTERM)
        out, said = self.drive.communicate(timeout=30)
        assert self.drive.returncode == 0 and "Traceback" not in said, said
        assert out.startswith("emulator stopped: state ")

    def answer(self) -> dict[str, float]:
        """The drive's answer to a SYNC, after its watchdog's time and all that waits has passed."""
        end = time.monotonic() + 1.0
        for _ in range(100):
            self.node.heard.clear()
            self.node.send(SYNC)
            self.node.listen(0.1)
            answers = [f.data for f in self.node.heard if f.can_id | f.flags == FEEDBACK.send_id]
            if answers and time.monotonic() > end:
                return FEEDBACK.decode(answers[-1])
        raise AssertionError("the drive does not answer")


@pytest.fixture
def begin(configs: Path, settings: Settings, channel: str, tmp_path: Path) -> Iterator[Callable[[], Bench]]:
    """The drive runs and the node listens; calling it starts the controller."""
    own, path = settings("loop.duration_s=60.0", "reference.down_at_s=59.0"), configs / "demo.toml"
    for kind in KINDS:
        kind(random.Random(0))  # some frames need compiled code, which is not to be loaded in the flood
    with ExitStack() as stack:
        node = stack.enter_context(flooder(channel))
        drive = stack.enter_context(hil("emulate", str(path), *flags(own)))
        assert drive.stdout is not None and drive.stdout.readline().startswith("emulator ready")

        def start() -> Bench:
            run = stack.enter_context(hil("run", str(path), "--json", *flags(own)))
            return Bench(drive, run, node, tmp_path)

        yield start


def named(value: object) -> str:
    """Id of a case: its kinds of frames, the rest left out."""
    return "+".join(kind.__name__ for kind in value) if isinstance(value, tuple) else ""


@pytest.mark.long
@pytest.mark.parametrize("bursts", [True, False], ids=["bursts", "full-speed"])
def test_frames_of_nobody_are_ridden_through(begin: Callable[[], Bench], bursts: bool) -> None:
    """2500 frames a second are nothing; more than the sockets hold may end in a stop for what was lost."""
    bench = begin()
    bench.until_moving()
    bench.node.flood(datagrams(1, *HARMLESS), 2.0, bursts=bursts, goes_on=bench.goes_on)
    assert bench.goes_on() or not bursts
    bench.run.send_signal(signal.SIGINT)
    code, result = bench.ended()
    print(f"{bench.node.sent} frames, {result['ended']}")
    if code:
        assert not bursts and Reason[result["ended"].upper()] in STARVED, result
    else:
        assert result["ended"] == "stop_requested" and result["ok"]
    bench.assert_log_and_wire_agree(result)
    bench.assert_drive_is_at_rest()


@pytest.mark.corners
@pytest.mark.parametrize(
    ("kinds", "bursts", "reasons"),
    [
        ((damaged,), False, BROKEN_WORDS),
        ((forged,), False, LIES),
        ((orders,), True, {Reason.FOREIGN_COMMAND}),
        ((errors,), True, {Reason.BUS_DOWN, Reason.CRC_ERRORS}),
        (KINDS, False, {Reason.BUS_DOWN, Reason.FOREIGN_COMMAND, *LIES}),
    ],
    ids=named,
)
def test_a_flood_of_our_own_identifiers_ends_in_a_stop_that_tells_why(
    begin: Callable[[], Bench], kinds: tuple[Kind, ...], bursts: bool, reasons: set[Reason]
) -> None:
    bench = begin()
    bench.until_moving()
    bench.node.flood(datagrams(2, *kinds), 20.0, bursts=bursts, goes_on=bench.goes_on)
    code, result = bench.ended()
    print(f"{bench.node.sent} frames, {result['ended']}")
    assert code == 1 and Reason[result["ended"].upper()] in reasons, result
    bench.assert_log_and_wire_agree(result)
    bench.assert_drive_is_at_rest()


@pytest.mark.long
def test_a_bus_that_is_flooded_from_the_beginning_never_sees_a_voltage(begin: Callable[[], Bench]) -> None:
    """Forged commands are another controller's: the run hears them, sends nothing, and says so in a line."""
    bench = begin()
    bench.node.flood(datagrams(3, orders, twin, foreign), 60.0, bursts=True, goes_on=bench.goes_on)
    out, said = bench.run.communicate(timeout=60)
    bench.node.listen(0.3)
    assert bench.run.returncode == 2 and not out, said
    assert "another controller sends 0x" in said and "nothing was sent" in said and "Traceback" not in said
    assert not bench.commands()
    bench.assert_drive_is_at_rest()


@pytest.mark.long
def test_a_flood_of_answers_from_the_beginning_is_found_out_in_the_soft_start(
    begin: Callable[[], Bench],
) -> None:
    """Forged heartbeats and answers look like a drive; what comes with them ends the run before it turns."""
    bench = begin()
    bench.node.flood(datagrams(3, twin, forged, errors, broken), 60.0, bursts=True, goes_on=bench.goes_on)
    code, result = bench.ended()
    print(f"{bench.node.sent} frames, {result['ended']}")
    assert code == 1 and result["log_complete"]
    log = open_log(only_log(bench.folder))
    assert log.damage is None and replay(log.path).verdict == "same"
    assert np.hypot(log.ticks["u_q"], log.ticks["u_d"]).max() < 5.0 and (log.ticks["w_ref"] == 0.0).all()
    bench.assert_drive_is_at_rest()
