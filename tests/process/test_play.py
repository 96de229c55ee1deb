"""``hil play`` as a process: Ctrl-C ends it at once, and it says what it sent."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import can
import pytest

from hil.convert.export import export
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
