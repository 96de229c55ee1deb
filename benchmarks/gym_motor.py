"""Peer: gym-electric-motor steps its PMSM with speed control at 1 kHz, uncontrolled. Prints one JSON line.

Its step alone is timed, with no controller: what one costs comes on top. Standalone, so that it runs in an
interpreter that has gym-electric-motor and nothing of this project.
"""

from __future__ import annotations

import json
import sys
import time
import warnings

STEPS = 2000


def main() -> None:
    """Step the environment with no voltage; say how many seconds a second."""
    warnings.simplefilter("ignore")
    try:
        import gym_electric_motor
    except ImportError as error:
        sys.exit(f"not installed: {error}; pip install gym-electric-motor")
    environment = gym_electric_motor.make("Cont-SC-PMSM-v0", tau=1e-3)
    environment.reset(seed=1)
    action = environment.action_space.sample() * 0
    begin = time.perf_counter()
    for _ in range(STEPS):
        _, _, terminated, truncated, _ = environment.step(action)
        if terminated or truncated:
            environment.reset()
    wall_s = time.perf_counter() - begin
    sys.stdout.write(json.dumps({"x_realtime": STEPS * 1e-3 / wall_s}) + "\n")


if __name__ == "__main__":
    main()
