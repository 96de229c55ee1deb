"""Motors of 50 W to 100 kW that nobody told, identified from simulated runs, within the limits."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.config import RunConfig, load_toml
from hil.identify.estimate import Parameter
from hil.identify.plan import STEPS
from hil.identify.session import Session, planned, setup_for
from hil.signals import Reason
from hil.simulate import simulate_ticks
from tests.conftest import CONFIGS

pytestmark = pytest.mark.compiled
GOALS = {"R_s": 0.02, "L_d": 0.02, "L_q": 0.02, "psi_f": 0.02, "J": 0.03, "coulomb": 0.1}
NAMES = ("R_s", "L_d", "L_q", "psi_f", "n_p", "J", "B_f", "coulomb", "i_max", "u_max", "w_max")
MOTORS: dict[str, tuple[float, ...]] = {
    # R_s ohm, L_d, L_q H, psi_f Wb, n_p, J kg m2, B_f N m s, coulomb N m; limits: A, V, rad/s
    "50 W surface": (0.60, 0.40e-3, 0.40e-3, 0.0065, 4, 3.0e-6, 2e-6, 0.003, 5, 14, 300),
    "200 W surface": (0.90, 2.5e-3, 2.5e-3, 0.020, 4, 2.0e-5, 1e-5, 0.01, 5, 60, 320),
    "400 W interior": (1.20, 4.0e-3, 7.0e-3, 0.045, 4, 4.0e-5, 2e-5, 0.02, 8, 150, 320),
    "750 W surface": (0.50, 3.2e-3, 3.2e-3, 0.070, 4, 1.2e-4, 5e-5, 0.04, 12, 170, 320),
    "1.5 kW interior": (1.00, 8.0e-3, 14e-3, 0.200, 3, 1.0e-3, 2e-4, 0.08, 12, 300, 200),
    "3 kW surface": (3.45, 29.7e-3, 29.7e-3, 0.760, 3, 0.01265, 4e-4, 0.2, 15, 300, 150),
    "5.5 kW interior": (0.70, 7.0e-3, 16e-3, 0.45, 4, 0.012, 1e-3, 0.3, 30, 300, 160),
    "11 kW surface": (0.25, 4.0e-3, 4.0e-3, 0.55, 4, 0.030, 2e-3, 0.5, 60, 310, 150),
    "22 kW interior": (0.09, 1.5e-3, 3.5e-3, 0.50, 4, 0.080, 4e-3, 0.8, 100, 310, 150),
    "45 kW interior": (0.035, 0.8e-3, 2.0e-3, 0.42, 4, 0.20, 8e-3, 1.5, 200, 310, 160),
    "75 kW surface": (0.020, 0.5e-3, 0.5e-3, 0.40, 4, 0.40, 0.01, 2.5, 300, 310, 160),
    "100 kW interior": (0.012, 0.3e-3, 0.9e-3, 0.36, 4, 0.60, 0.02, 3.0, 400, 310, 180),
}
WRONG = np.array([1.3, 0.7, 1.3, 0.7, 1.0, 1.3, 0.5])
"""What the configuration believes, over the truth."""


def bench(tmp_path: Path, motor: dict[str, float]) -> tuple[Path, RunConfig, list[str]]:
    """The demo with that motor's limits and frames: configuration, and settings of the plant."""
    shutil.copytree(CONFIGS, tmp_path, dirs_exist_ok=True)
    for dbc in (tmp_path / "drives").glob("hil_pmsm.dbc"):
        dbc.write_text(scaled(dbc.read_text(encoding="utf-8"), motor["i_max"] / 15.0), encoding="utf-8")
    i, u, w = motor["i_max"], motor["u_max"], motor["w_max"]
    believed = [motor[name] for name in NAMES[:7]] * WRONG
    settings = [
        f"motor={table(believed)}",
        f"limits={{w_max_rad_s={w}, i_max_a={i}, i_trip_a={1.33 * i}, u_max_v={u}, du_max_v={u}}}",
    ]
    friction = f"friction={{coulomb_n_m={motor['coulomb']}}}"
    noise = f"sensors={{w_noise_rad_s=0.01, i_noise_a={2e-3 * i / 15.0}}}"
    lsb = f"inverter={{v_dc_v=560.0, resolution_v={0.02 if u > 100 else 0.002}}}"
    trip = f"firmware={{i_trip_a={2 * i}, w_trip_rad_s={2 * w}}}"
    true = f"motor={table([motor[name] for name in NAMES[:7]])}"
    return tmp_path / "demo.toml", load_toml(tmp_path / "demo.toml", RunConfig, settings), [
        "load=[]", true, friction, noise, lsb, trip,
    ]  # fmt: skip


def scaled(text: str, share: float) -> str:
    """The frames with the resolution and range of the currents scaled."""
    q, d = 0.001 * share, 0.01 * share
    text = text.replace("(0.001,0) [-32.767|32.767]", f"({q:.9g},0) [{-32767 * q:.9g}|{32767 * q:.9g}]")
    return text.replace("(0.01,0) [-20.47|20.47]", f"({d:.9g},0) [{-2047 * d:.9g}|{2047 * d:.9g}]")


def table(values: Any) -> str:
    keys = ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "n_p", "J_kg_m2", "B_f_n_m_s")
    parts = [
        f"{key}={round(value) if key == 'n_p' else float(value)!r}"
        for key, value in zip(keys, values, strict=True)
    ]
    return "{" + ", ".join(parts) + "}"


@pytest.mark.parametrize("name", MOTORS)
def test_a_motor_that_nobody_told(tmp_path: Path, name: str) -> None:
    true = dict(zip(NAMES, MOTORS[name], strict=True))
    path, config, plant = bench(tmp_path, true)
    session = Session(path, config, config.motor)
    seconds = 0.0
    for step in planned(session, STEPS):
        ticks = simulate_ticks(setup_for(session, step), plant)
        assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED, step.name
        assert np.hypot(ticks["i_q"], ticks["i_d"]).max() < true["i_max"], step.name
        assert np.abs(ticks["w"]).max() < true["w_max"], step.name
        assert np.hypot(ticks["u_q"], ticks["u_d"]).max() <= true["u_max"], step.name
        session.note(step, ticks)
        seconds += len(ticks) / config.loop.rate_hz
    assert session.faults == [] and seconds < 60.0
    found: dict[str, Parameter] = session.estimate.parameters
    assert found["delay"].value == 1 and found["delay"].told
    off = {key: found[key].value / true[key] - 1.0 for key in GOALS}
    assert {key: share for key, share in off.items() if abs(share) > GOALS[key]} == {}
    assert all(found[key].told for key in GOALS)
    friction = found["coulomb"].value + found["B_f"].value * 0.5 * true["w_max"]
    assert friction == pytest.approx(true["coulomb"] + true["B_f"] * 0.5 * true["w_max"], rel=0.1)
