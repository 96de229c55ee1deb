"""Two axes in one configuration: motors that nothing couples, each with its own speed, one SYNC, one log."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil.log.reader import open_log
from hil.runtime.setup import Overrides
from hil.sim.demo import emulator_process
from tests.process.test_run import call, flags

pytestmark = [pytest.mark.process, pytest.mark.slow]
REFERENCE = """[drive.reference]
kind = "s-curve"
w_rad_s = {w}
rate_rad_s2 = 200.0
jerk_rad_s3 = 1e4
at_s = 0.05
down_at_s = 100.0

"""
SPEEDS = {"motor": 20.0, "load": -30.0}


def axes(configs: Path) -> Path:
    """`configs/dyno.toml` with a speed loop in the second node, too, and each motor's own inertia."""
    text = (configs / "dyno.toml").read_text(encoding="utf-8").replace("0.022 ", "0.011 ")
    shared, first, second = text.split("[[drive]]")
    loop = first[first.index("[drive.controller]") : first.index("[drive.limits]")]
    before, rest = second.split("[drive.controller]")
    second = before + loop + rest[rest.index("[drive.limits]") :]
    parts = []
    for part, w in zip((first, second), SPEEDS.values(), strict=True):
        begin, end = part.index("[drive.reference]"), part.index("[drive.emulator]")
        parts.append(part[:begin] + REFERENCE.format(w=w) + part[end:])
    path = configs / "axes.toml"
    path.write_text("[[drive]]".join((shared, *parts)), encoding="utf-8")
    return path


@pytest.mark.long
def test_two_axes_turn_by_themselves(configs: Path, settings: Callable[..., tuple[str, ...]]) -> None:
    """Two emulators, each with its own motor: each axis comes to its own speed, and both replay."""
    path, own = axes(configs), settings("loop.duration_s=0.9", "loop.rate_hz=500")
    of = {name: (*own, f'node="{name}"') for name in SPEEDS}
    with (
        emulator_process(path, Overrides(settings=of["motor"])),
        emulator_process(path, Overrides(settings=of["load"])),
    ):
        for name in SPEEDS:
            done = call("configure", str(path), *flags(of[name]))
            assert done.returncode == 0, done.stdout + done.stderr
        ran = call("run", str(path), "--json", *flags(own))
    assert ran.returncode == 0, ran.stderr
    result = json.loads(ran.stdout)
    for name, w in SPEEDS.items():
        ticks = open_log(Path(result["log"]), node=name).ticks
        asked = ticks["w"][(ticks["k"] > 300) & (ticks["k"] < 440)]
        assert np.abs(asked - w).max() < 1.0, name
    done = call("replay", result["log"], "--json")
    told = json.loads(done.stdout)["nodes"]
    assert {name: one["verdict"] for name, one in told.items()} == dict.fromkeys(SPEEDS, "same")
