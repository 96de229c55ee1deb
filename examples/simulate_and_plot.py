"""Simulate the demo with a slower speed loop beside the shipped one, print figures, draw both.

python examples/simulate_and_plot.py [FOLDER]
"""

import sys
from pathlib import Path

import hil

CONFIG = Path(__file__).parents[1] / "configs" / "demo.toml"
OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "logs")

shipped = hil.simulate(CONFIG)
slower = hil.simulate(CONFIG, {"controller.speed_pole_rad_s": 40.0})
for name, log in (("shipped", shipped), ("slower", slower)):
    figures = hil.metrics(log)
    print(f"{name}: dip {figures['dip_rad_s']:.2f} rad/s, back in {1e3 * figures['recovery_s']:.0f} ms")

OUT.mkdir(exist_ok=True)
hil.plot(shipped, slower, path=OUT / "simulate_and_plot.png")
print(f"picture: {OUT / 'simulate_and_plot.png'}")
