"""The loop in lockstep over a drive that is wholly of strangers: plant, firmware and frames by am-sdk."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.bus import open_link
from drivers.errors import NodeError
from drivers.sdo import Sdo
from hil.log.reader import open_log
from hil.signals import DriveState
from tests import amdrive
from tests.amdrive import CONFIG, DBC, FRICTION_N_M, LOAD_N_M, LOAD_S, NODE, SAG_S
from tests.canopen import bus_of
from tests.conftest import ROOT
from tests.process.test_run import call, flags

pytestmark = [pytest.mark.process, pytest.mark.beside]
Settings = Callable[..., tuple[str, ...]]


@contextlib.contextmanager
def am_drive(channel: str, *words: str) -> Iterator[None]:
    """The drive as a process of its own."""
    command = [sys.executable, "-m", "tests.amdrive", channel, *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "ready\n"
            yield
        finally:
            process.terminate()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "am.dbc").write_text(DBC, encoding="utf-8")
    config = tmp_path / "am.toml"
    config.write_text(CONFIG, encoding="utf-8")
    return config


def ran(path: Path, own: tuple[str, ...]) -> tuple[int, dict[str, Any], Any]:
    """Exit code, what is said, and the log's ticks in operation."""
    command = [sys.executable, "-m", "hil.cli", "run", str(path), "--json", *flags(own)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)  # it may compile
    assert done.stdout, done.stderr
    result = json.loads(done.stdout)
    ticks = open_log(Path(result["log"])).ticks
    return done.returncode, result, ticks[ticks["state"] == DriveState.OPERATION_ENABLED]


@pytest.mark.long
def test_the_loop_holds_a_strangers_motor(path: Path, settings: Settings, channel: str) -> None:
    """Their dry friction is the first load, a step of 4 N m the second: each within 2 % of the step."""
    with am_drive(channel):
        code, result, on = ran(path, settings())
    assert (code, result["ended"]) == (0, "stop_requested")
    k, load = on["k"], on["T_L_hat"]
    step = round(1e3 * LOAD_S)
    before, risen, held = (
        (k > low) & (k < high) for low, high in ((100, 495), (step + 18, 1050), (800, 1050))
    )
    assert np.abs(load[before] - FRICTION_N_M).max() < 0.02 * LOAD_N_M
    assert np.abs(load[risen] - FRICTION_N_M - LOAD_N_M).max() < 0.02 * LOAD_N_M
    assert (
        np.abs(on["w"][held] - 5.0).max() < 0.02 and 0.5 < 5.0 - on["w"][(k >= step) & (k < 1050)].min() < 1.0
    )
    replayed = call("replay", result["log"])
    assert replayed.returncode == 0, replayed.stdout


def test_a_trip_of_theirs_ends_the_run(path: Path, settings: Settings, channel: str) -> None:
    """Their supply falls to 20 V: it trips, and says it in its state alone."""
    with am_drive(channel, "trips"):
        code, result, on = ran(path, settings("limits.v_dc_min_v=0.0"))
    assert (code, result["ended"]) == (1, "drive_fault")
    assert abs(int(on["k"][-1]) - round(1e3 * SAG_S)) < 5


def test_their_dictionary_and_its_aborts(channel: str) -> None:
    """Rated torque [mN m]; read-only, not there, and of another length are refused."""
    with am_drive(channel), contextlib.closing(open_link(bus_of(channel))) as link:
        sdo = Sdo(link, NODE, "here", 10.0)
        assert sdo.read_int(0x6076) == 34100 and sdo.optional_int(0x1234) is None
        assert (sdo.read_int(0x2902, 2), sdo.read_int(0x2902, 3)) == (amdrive.GROUP, amdrive.SLOT // 16)
        for index, size, said in (
            (0x6041, 2, "0x06010002"),
            (0x1234, 2, "0x06020000"),
            (0x60E0, 4, "0x06070010"),
        ):
            with pytest.raises(NodeError, match=f"{index:04X}h.*abort {said}, "):
                sdo.write(index, 0, 1, size)
