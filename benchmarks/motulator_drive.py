"""Peer: motulator simulates the demo's motor under its own vector control at 1 kHz. Prints one JSON line.

Standalone, so that it runs in an interpreter that has motulator and nothing of this project. Written for the
interface of motulator 0.5.
"""

from __future__ import annotations

import json
import sys
import time

SECONDS = 2.0


def main() -> None:
    """Simulate a speed step and a load step; say how many seconds a second."""
    try:
        from motulator.drive import model
        from motulator.drive.control import sm
        from motulator.drive.utils import SynchronousMachinePars
    except ImportError as error:
        sys.exit(f"not installed: {error}; pip install motulator==0.5.0")
    motor = SynchronousMachinePars(n_p=3, R_s=2.875, L_d=0.033, L_q=0.033, psi_f=0.8)
    converter, mechanics = model.VoltageSourceConverter(u_dc=560), model.StiffMechanicalSystem(J=0.011)
    drive = model.Drive(converter, model.SynchronousMachine(motor), mechanics)
    reference = sm.CurrentReferenceCfg(motor, nom_w_m=3 * 100, max_i_s=15)
    control = sm.CurrentVectorControl(motor, reference, T_s=1e-3, J=0.011, alpha_c=250, sensorless=False)
    control.ref.w_m = lambda t: 3 * 80.0 * (t > 0.2)
    mechanics.tau_L = lambda t: 5.4 * (t > 1.0)
    simulation = model.Simulation(drive, control)
    begin, used = time.perf_counter(), time.process_time()
    simulation.simulate(t_stop=SECONDS)
    wall_s, core_s = time.perf_counter() - begin, time.process_time() - used
    speed = float(mechanics.data.w_M[-1])
    found = {"x_realtime": SECONDS / wall_s, "core_s_a_simulated_s": core_s / SECONDS}
    found["speed_at_end_rad_s"] = speed
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
