"""``hil play`` as a process: Ctrl-C ends it at once, and it says what it sent."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

import can
import pytest

from hil.exchange.export import export
from hil.log.reader import open_log
from tests.logfiles import some_ticks, write_log
from tests.unit.test_play import bus_frames

pytestmark = pytest.mark.process


def test_ctrl_c_ends_it_and_the_figures_are_printed(tmp_path: Path, channel: str) -> None:
    write_log(tmp_path / "run.mcap", some_ticks(100), bus_frames(100))
    with can.Bus(interface="hil-local", channel=channel) as bus:
        words = ["play", str(tmp_path / "run.mcap"), "-i", "hil-local", "-c", channel]
        process = subprocess.Popen(
            [sys.executable, "-m", "hil.cli", *words, "--loop", "1000000", "--json"],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            for _ in range(3):  # the first may be on the bus before it is counted
                assert bus.recv(60.0) is not None
            process.send_signal(signal.SIGINT)
            out, _ = process.communicate(timeout=30)
        finally:
            process.kill()
    found = json.loads(out)
    assert process.returncode == 130 and found["interrupted"] and found["frames sent"] >= 1


def heard_for(bus: can.BusABC, seconds: float) -> list[can.Message]:
    """Everything that comes until there is silence for so long."""
    got = []
    while (message := bus.recv(seconds)) is not None:
        got.append(message)
    return got


def wait_for_keys(terminal: int) -> None:
    """Until the program takes single keys; what was typed before is dropped."""
    for _ in range(1200):
        if not termios.tcgetattr(terminal)[3] & termios.ICANON:
            return
        time.sleep(0.05)
    raise AssertionError("it never asked for keys")


def test_paused_single_steps_and_going_on_at_a_terminal(tmp_path: Path, channel: str) -> None:
    """Nothing is sent while paused, n sends one frame, space plays, space pauses, Ctrl-C ends."""
    frames = bus_frames(3000)
    write_log(tmp_path / "run.mcap", some_ticks(3000), frames)
    ours, theirs = pty.openpty()
    words = ["play", str(tmp_path / "run.mcap"), "-i", "hil-local", "-c", channel, "--paused", "--json"]
    with can.Bus(interface="hil-local", channel=channel) as bus:
        process = subprocess.Popen(
            [sys.executable, "-m", "hil.cli", *words], stdin=theirs, stdout=subprocess.PIPE, text=True
        )
        try:
            wait_for_keys(theirs)
            os.write(ours, b"n")
            first = bus.recv(10.0)
            assert first is not None and first.data[0] == 0
            assert heard_for(bus, 0.5) == [], "paused"
            os.write(ours, b"nn")
            assert [message.data[0] for message in heard_for(bus, 0.5)] == [1, 2]
            os.write(ours, b" ")
            playing = [bus.recv(10.0) for _ in range(200)]
            os.write(ours, b" ")
            rest = heard_for(bus, 0.5)
            stamps = [message.timestamp for message in playing if message is not None]
            assert len(stamps) == 200 and 0.15 < stamps[-1] - stamps[0] < 2.0, "200 periods of 1 ms"
            assert len(rest) < 2700, "paused before the end"
            process.send_signal(signal.SIGINT)
            out, _ = process.communicate(timeout=30)
        finally:
            process.kill()
            process.communicate()
            os.close(ours)
            os.close(theirs)
    found = json.loads(out)
    assert process.returncode == 130 and found["interrupted"]
    assert found["frames sent"] == 3 + 200 + len(rest)


@pytest.mark.corners
@pytest.mark.parametrize("ending", [".log", ".asc", ".blf"])
def test_python_cans_player_plays_what_we_export(tmp_path: Path, channel: str, ending: str) -> None:
    frames = bus_frames(60)
    write_log(tmp_path / "run.mcap", some_ticks(60), frames)
    recording = tmp_path / f"run{ending}"
    export(tmp_path / "run.mcap", recording)
    sent = [(f.can_id, f.data) for f in open_log(tmp_path / "run.mcap").frames]
    with can.Bus(interface="hil-local", channel=channel) as bus:
        words = ("-i", "hil-local", "-c", channel, "--ignore-timestamps", "-g", "0.002", str(recording))
        player = subprocess.Popen([sys.executable, "-m", "can.player", *words], stdout=subprocess.DEVNULL)
        try:
            got = []
            while len(got) < len(sent) and (message := bus.recv(30.0)) is not None:
                got.append((message.arbitration_id, bytes(message.data)))
            assert player.wait(30) == 0
        finally:
            player.kill()
            player.wait()
    assert got == sent
