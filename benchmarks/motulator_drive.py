"""Peer: motulator simulates the demo's motor under its own vector control at 1 kHz. Prints one JSON line.

A step of the speed at 0.2 s and one of the load at 1 s; ``--speed-pole`` is the bandwidth of its speed
control, in rad/s, and ``--response`` adds the speed at each instant that it keeps. Standalone, so that it
runs in an interpreter that has motulator and nothing of this project. Written for the interface of 0.5.
"""

from __future__ import annotations

import argparse
import json
import sys
import time

SECONDS = 2.0


def main() -> None:
    """Simulate a speed step and a load step; say how many seconds a second, and the response."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--speed-pole", type=float, metavar="RAD_S", help="default: motulator's own, 8 pi")
    parser.add_argument("--response", action="store_true")
    args = parser.parse_args()
    sys.path.pop(0)  # this folder, which has a motulator of its own
    try:
        from motulator.drive import model
        from motulator.drive.control import SpeedController, sm
        from motulator.drive.utils import SynchronousMachinePars
    except ImportError as error:
        sys.exit(f"not installed: {error}; pip install motulator==0.5.0")
    motor = SynchronousMachinePars(n_p=3, R_s=2.875, L_d=0.033, L_q=0.033, psi_f=0.8)
    converter, mechanics = model.VoltageSourceConverter(u_dc=560), model.StiffMechanicalSystem(J=0.011)
    drive = model.Drive(converter, model.SynchronousMachine(motor), mechanics)
    reference = sm.CurrentReferenceCfg(motor, nom_w_m=3 * 100, max_i_s=15)
    control = sm.CurrentVectorControl(motor, reference, T_s=1e-3, J=0.011, alpha_c=250, sensorless=False)
    if args.speed_pole:
        control.speed_ctrl = SpeedController(0.011, args.speed_pole)
    control.ref.w_m = lambda t: 3 * 80.0 * (t > 0.2)
    mechanics.tau_L = lambda t: 5.4 * (t > 1.0)
    simulation = model.Simulation(drive, control)
    begin, used = time.perf_counter(), time.process_time()
    simulation.simulate(t_stop=SECONDS)
    wall_s, core_s = time.perf_counter() - begin, time.process_time() - used
    speed = float(mechanics.data.w_M[-1])
    found = {"x_realtime": SECONDS / wall_s, "core_s_a_simulated_s": core_s / SECONDS}
    found["speed_at_end_rad_s"] = speed
    if args.response:
        found["t_s"], found["w_rad_s"] = mechanics.data.t.tolist(), mechanics.data.w_M.tolist()
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
