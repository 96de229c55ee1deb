"""Twelve motors of 50 W to 100 kW on the demo's emulated drive, surface and interior, with their limits."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hil.config.shipped import find_config
from hil.config.tables import RunConfig, load_toml
from hil.config.toml import override, read_toml
from hil.identify.tune import written

Array = npt.NDArray[np.float64]
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
COGGING = '{kind="cogging", torque_n_m=0.05, order=36}'
MORE: dict[str, tuple[str, ...]] = {
    "1.5 kW interior": (f"load=[{COGGING}]",),
    "5.5 kW interior": ("coupling={inertia_ratio=1.0, resonance_hz=80.0}",),
}
"""What else the plant of a motor has: cogging of half the Coulomb friction, a soft coupling."""
WRONG = np.array([1.3, 0.7, 1.3, 0.7, 1.0, 1.3, 0.5])
"""What the configuration believes, over the truth."""


def bench(folder: Path, motor: dict[str, float], wrong: Array = WRONG) -> tuple[Path, RunConfig, list[str]]:
    """The demo with that motor's limits and frames: configuration, and settings of the plant.

    ``wrong``: what the configuration believes over the truth, R_s, L_d, L_q, psi_f, n_p, J, B_f.
    """
    shutil.copytree(find_config("demo.toml").parent, folder, dirs_exist_ok=True)
    for dbc in (folder / "drives").glob("hil_pmsm.dbc"):
        text = _scaled(dbc.read_text(encoding="utf-8"), motor["i_max"] / 15.0, motor["u_max"] / 300.0)
        dbc.write_text(text, encoding="utf-8")
    path = folder / "demo.toml"
    return path, load_toml(path, RunConfig, settings(motor, wrong)), plant(motor)


def written_bench(folder: Path, motor: dict[str, float], *more: str) -> Path:
    """The configuration of :func:`bench` as a file, whose emulator is that plant and ``more``."""
    path, _, _ = bench(folder, motor)
    rewrite(folder / "plants" / "demo.toml", [*plant(motor), *more])
    rewrite(path, settings(motor))
    return path


def rewrite(path: Path, texts: list[str]) -> None:
    """Put settings into a file."""
    data = read_toml(path)
    for text in texts:
        override(data, text, path.parent)
    path.write_text(written(data, path, path), encoding="utf-8")


def settings(motor: dict[str, float], wrong: Array = WRONG) -> list[str]:
    """What is believed of the motor, and its limits."""
    i, u, w = motor["i_max"], motor["u_max"], motor["w_max"]
    return [
        f"motor={_table(np.array([motor[name] for name in NAMES[:7]]) * wrong)}",
        f"limits={{w_max_rad_s={w}, i_max_a={i}, i_trip_a={1.33 * i}, u_max_v={u}, du_max_v={u}}}",
    ]


def plant(motor: dict[str, float]) -> list[str]:
    """The motor as it is, in the plant's file."""
    i, w = motor["i_max"], motor["w_max"]
    return [
        "load=[]",
        f"motor={_table([motor[name] for name in NAMES[:7]])}",
        f"friction={{coulomb_n_m={motor['coulomb']}}}",
        f"sensors={{w_noise_rad_s=0.01, i_noise_a={2e-3 * i / 15.0}}}",
        f"inverter={{v_dc_v=560.0, resolution_v={0.02 if motor['u_max'] > 100 else 0.002}}}",
        f"firmware={{i_trip_a={2 * i}, w_trip_rad_s={2 * w}}}",
    ]


def _scaled(text: str, i: float, u: float) -> str:
    """The frames with the resolution and range of currents and voltages scaled."""
    q, d, v = 0.001 * i, 0.01 * i, 0.01 * u
    text = text.replace("(0.001,0) [-32.767|32.767]", f"({q:.9g},0) [{-32767 * q:.9g}|{32767 * q:.9g}]")
    for name in ("VoltageQ : 32", "VoltageD : 48"):
        text = text.replace(
            f"{name}|16@1- (0.01,0) [-327.67|327.67]",
            f"{name}|16@1- ({v:.9g},0) [{-32767 * v:.9g}|{32767 * v:.9g}]",
        )
    return text.replace("(0.01,0) [-20.47|20.47]", f"({d:.9g},0) [{-2047 * d:.9g}|{2047 * d:.9g}]")


def _table(values: Any) -> str:
    """A motor as an inline table."""
    keys = ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "n_p", "J_kg_m2", "B_f_n_m_s")
    parts = [
        f"{key}={round(value) if key == 'n_p' else float(value)!r}"
        for key, value in zip(keys, values, strict=True)
    ]
    return "{" + ", ".join(parts) + "}"
