"""Laws and tunings side by side, on motors of different inertia: a table of dip and recovery.

python examples/sweep_laws.py
"""

from itertools import product
from pathlib import Path

import hil

CONFIG = Path(__file__).parents[1] / "configs" / "demo.toml"
LAWS = {
    "cascade, slow": {"kind": "cascade", "speed_pole_rad_s": 60.0, "current_pole_rad_s": 254.0},
    "cascade, shipped": {"kind": "cascade", "speed_pole_rad_s": 117.0, "current_pole_rad_s": 254.0},
    "PI": {
        "kind": "pi",
        "speed_gain_as_rad": 0.35,
        "speed_integral_a_rad": 5.0,
        "current_gain_v_a": 8.0,
        "current_integral_v_as": 700.0,
    },
}
INERTIAS = [0.010, 0.015]

rows = hil.sweep(CONFIG, {"controller": list(LAWS.values()), "plant:motor.J_kg_m2": INERTIAS})
for (law, J), row in zip(product(LAWS, INERTIAS), rows, strict=True):
    dip, recovery = row["dip_rad_s"], row["recovery_ms"]
    back = "not back" if recovery is None else f"back in {recovery:3.0f} ms"
    print(f"{law:16}  J = {J:.3f} kg m^2  dip {dip:.2f} rad/s, {back}")
