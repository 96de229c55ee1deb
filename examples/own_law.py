"""A law of one's own: the cascade with its poles in a fixed ratio, one key instead of two.

``register`` adds it to this process. A package makes it known everywhere by an entry point (docs/extend.md).

python examples/own_law.py
"""

from pathlib import Path

from hil.control.laws import cascade
from hil.control.registry import Key, Law, register

CONFIG = Path(__file__).parents[1] / "configs" / "demo.toml"


def design(values, plan):
    """The current loop two times as fast as the speed loop."""
    w = values["bandwidth_rad_s"]
    given = {"speed_pole_rad_s": w, "current_pole_rad_s": 2.0 * w, "current_d_pole_rad_s": None}
    return cascade.design(given, plan)


register(
    Law("ratio", "poles 1 : 2", cascade.CODE, design, {"bandwidth_rad_s": Key("pole of the speed error")})
)

import hil  # noqa: E402 - what is registered stands before the first configuration

for bandwidth in (60.0, 120.0):
    log = hil.simulate(CONFIG, {"controller": {"kind": "ratio", "bandwidth_rad_s": bandwidth}})
    dip = hil.metrics(log)["dip_rad_s"]
    print(f"bandwidth {bandwidth:.0f} rad/s: dip {dip:.2f} rad/s, replay {hil.replay(log).verdict}")
