"""Our loop beside motulator's: the same motor, a step of speed and one of load, each in its own simulator.

    python -m benchmarks.motulator [--json] [--motulator PYTHON]

PYTHON is an interpreter that has motulator 0.5 (``pip install motulator==0.5.0`` in a virtual environment of
its own). Both know the motor exactly, measure without noise, sample at 1 kHz, act a tick late, and have a
supply of 560 V and 15 A. What each computes is not the same: motulator's speed control is a PI with two
degrees of freedom, without an observer of the load, its motor integrated by an adaptive Runge and Kutta; ours
goes through the frames' resolution, guard and supervisor.
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any, Final

import numpy as np

from benchmarks.__main__ import HERE, peer
from hil.config.shipped import find_config
from hil.report.metrics import operating
from hil.report.view import key_values, show
from hil.runtime.setup import Overrides, load_setup
from hil.sim.simulate import simulate_ticks

SPEED, LOAD, STEP_S, LOAD_S, END_S = 80.0, 5.4, 0.2, 1.0, 2.0
WITHIN: Final = 0.5
"""Speed error [rad/s] within which a step is over."""
SETTINGS: Final = (
    f'reference={{kind="step", w_rad_s={SPEED}, at_s={STEP_S}}}', f"loop.duration_s={END_S}",
    "limits.following_error_s=60.0", "limits.du_max_v=600.0",
)  # fmt: skip
PLANT: Final = (
    "motor={R_s_ohm=2.875, L_d_h=0.033, L_q_h=0.033, psi_f_wb=0.8, n_p=3, J_kg_m2=0.011}",
    f'load=[{{kind="step", torque_n_m={LOAD}, at_s={LOAD_S}}}]', "friction={coulomb_n_m=0.0}",
    "sensors={w_noise_rad_s=0.0, i_noise_a=0.0}", "inverter={v_dc_v=560.0}",
)  # fmt: skip


def judged(t: Any, w: Any) -> dict[str, float]:
    """Rise to 95 %, overshoot, dip, recovery and IAE of a response w (N,) [rad/s] at t (N,) [s]."""
    rising, loaded = (t >= STEP_S) & (t < LOAD_S), (t >= LOAD_S) & (t < END_S)
    error = np.abs(w[loaded] - SPEED)
    outside = t[loaded][error > WITHIN]
    return {
        "rise_ms": 1e3 * float(t[rising][w[rising] >= 0.95 * SPEED][0] - STEP_S),
        "overshoot_percent": 1e2 * max(float(w[rising].max()) / SPEED - 1.0, 0.0),
        "dip_rad_s": float(error.max()),
        "recovery_ms": 1e3 * float(outside[-1] - LOAD_S) if len(outside) else 0.0,
        "iae_rad": float(np.trapezoid(error, t[loaded])),
    }


def ours(config: str) -> dict[str, float]:
    """What `hil simulate` makes of it with the law of a shipped configuration."""
    own = operating(
        simulate_ticks(load_setup(find_config(config), Overrides(settings=SETTINGS)), list(PLANT))
    )
    return judged(own["t_ns"] * 1e-9, own["w"])


def theirs(python: str, *flags: str) -> dict[str, Any]:
    """What motulator makes of it; or what is ``missing``."""
    found = peer(python, str(HERE / "motulator_drive.py"), "--response", *flags)
    return found if "missing" in found else judged(np.array(found["t_s"]), np.array(found["w_rad_s"]))


def measure(python: str) -> dict[str, dict[str, Any]]:
    """Every loop, by name; motulator's with its own bandwidth and with the speed poles of ours."""
    return {
        "hil demo.toml": ours("demo.toml"),
        "hil rigid.toml": ours("rigid.toml"),
        "motulator, 8 pi rad/s": theirs(python),
        "motulator, 50 rad/s": theirs(python, "--speed-pole", "50"),
        "motulator, 117 rad/s": theirs(python, "--speed-pole", "117"),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.motulator", description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "--motulator", default=sys.executable, metavar="PYTHON", help="an interpreter that has motulator"
    )
    args = parser.parse_args()
    found = measure(args.motulator)
    if args.json:
        sys.stdout.write(json.dumps(found, indent=2) + "\n")
        return
    said = {
        name: ", ".join(
            f"{key} {item:.4g}" if isinstance(item, float) else f"{key}: {item}" for key, item in row.items()
        )
        for name, row in found.items()
    }
    show(key_values("a speed step of 80 rad/s and a load step of 5.4 N m", said))


if __name__ == "__main__":
    main()
