"""Runs with a DBC that is not quite the drive's: what is named, what ends the run, what goes on."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.bus import BusSettings, open_link
from hil.log.reader import open_log
from hil.runtime.setup import Overrides
from hil.sim.demo import emulator_process
from tests.process.test_run import call, flags

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]
LOCKSTEP = 'loop.clock="lockstep"'


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.mark.corners
@pytest.mark.parametrize("last", [14, 12])
def test_a_run_goes_on_where_the_counter_wraps(configs: Path, settings: Settings, last: int) -> None:
    """The drive's own DBC counts to 15; the run's to less, as AUTOSAR's does."""
    own = configs / "drives/own.dbc"
    text = (configs / "drives/hil_pmsm.dbc").read_text()
    begin = text.index("BO_ 513 COMMAND")
    own.write_text(text[:begin] + text[begin:].replace("[0|15]", f"[0|{last}]", 1))
    asked = settings('drive.dbc="drives/own.dbc"', LOCKSTEP, "loop.duration_s=0.5")
    with emulator_process(configs / "demo.toml", Overrides(settings=asked)):
        done = call("run", str(configs / "demo.toml"), "--json", *flags(asked))
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    (path,) = (configs.parent / "logs").glob("*.mcap")
    ticks = open_log(path).ticks
    counters = ticks["counter"][ticks["send"] != 0]
    assert counters.max() == last and abs(ticks["u_q"]).max() > 1.0


@pytest.mark.long
def test_feedback_of_another_length_is_named_before_arming(
    configs: Path, settings: Settings, channel: str
) -> None:
    """A drive that sends by its own clock is heard before anything is sent."""
    own = settings('loop.pacing="feedback"')
    link, over = open_link(BusSettings("hil-local", channel)), threading.Event()

    def speak() -> None:
        while not over.wait(0.01):
            link.send(0x181, bytes(6))

    thread = threading.Thread(target=speak)
    thread.start()
    try:
        done = call("run", str(configs / "demo.toml"), *flags(own))
        checked = call("check", str(configs / "demo.toml"), *flags((*own, "drive.heartbeat_timeout_s=0.5")))
    finally:
        over.set()
        thread.join()
    assert done.returncode != 0 and "FEEDBACK: length 6, DBC 8" in done.stderr
    assert "nothing was sent" in done.stderr and "Traceback" not in done.stderr
    sent = []
    while (frame := link.receive(0)) is not None:
        sent.append(frame)
    link.close()
    assert sent == []
    assert checked.returncode == 1 and "FEEDBACK: length 6, DBC 8" in checked.stdout.replace("\n", " ")


@pytest.mark.long
def test_feedback_of_another_length_ends_a_run_with_both_lengths(configs: Path, settings: Settings) -> None:
    """A drive that answers SYNC is heard in the run's first ticks."""
    edit(configs / "plants/demo.toml", "hil_pmsm.dbc", "theirs.dbc")
    theirs = configs / "drives/theirs.dbc"
    theirs.write_text((configs / "drives/hil_pmsm.dbc").read_text())
    own = configs / "drives/hil_pmsm.dbc"
    edit(own, "BO_ 641 STATUS: 8 Drive", "BO_ 641 STATUS: 7 Drive")
    edit(own, " SG_ ErrorCode : 48|16@1+ (1,0) [0|65535]", " SG_ ErrorCode : 48|8@1+ (1,0) [0|255]")
    asked = settings(LOCKSTEP, "loop.duration_s=2.0", "feedback.error_budget=3")
    with emulator_process(configs / "demo.toml", Overrides(settings=asked)):
        done = call("run", str(configs / "demo.toml"), "--json", *flags(asked))
    assert done.returncode != 0 and "STATUS: length 8, DBC 7" in done.stderr
    (path,) = (configs.parent / "logs").glob("*.mcap")
    assert ("length", "STATUS: length 8, DBC 7") in [(e["kind"], e["text"]) for e in open_log(path).events]


@pytest.mark.long
def test_an_emulator_that_speaks_another_protocol_is_refused(configs: Path, settings: Settings) -> None:
    edit(configs / "inverter.toml", 'plant = "plants/inverter.toml"', 'plant = "plants/demo.toml"')
    for command in ("emulate", "demo"):
        done = call(command, str(configs / "inverter.toml"), *flags(settings()))
        assert done.returncode != 0 and "Traceback" not in done.stderr
        assert "the emulated drive knows no MotorState (0x18FF1000, 12 bytes)" in done.stderr, done.stderr


def test_an_emulator_that_counts_otherwise_says_so(configs: Path, settings: Settings) -> None:
    edit(
        configs / "drives/hil_pmsm.dbc",
        "SG_ Counter : 8|4@1+ (1,0) [0|15]",
        "SG_ Counter : 8|4@1+ (1,0) [1|15]",
    )
    done = call("emulate", str(configs / "demo.toml"), *flags(settings()))
    assert done.returncode != 0 and "Traceback" not in done.stderr
    assert "COMMAND.Counter begins with 1 by the DBC; the emulated drive counts from 0" in done.stderr


def test_an_emulator_that_can_t_send_a_half_float_says_so(configs: Path, settings: Settings) -> None:
    """A real drive's 16-bit float is read; ours writes floats of 32 and 64 bits alone."""
    path = configs / "drives/hil_pmsm.dbc"
    edit(path, "DcLinkVoltage : 16|16@1+ (0.1,0) [0|6553.5]", "DcLinkVoltage : 16|16@1- (1,0) [0|6553.5]")
    path.write_text(path.read_text() + "SIG_VALTYPE_ 641 DcLinkVoltage : 1;\n")
    done = call("emulate", str(configs / "demo.toml"), *flags(settings()))
    assert done.returncode != 0 and "Traceback" not in done.stderr
    assert "STATUS.DcLinkVoltage is a float of 16 bits, which the emulated drive can't send" in done.stderr
