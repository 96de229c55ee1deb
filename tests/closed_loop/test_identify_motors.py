"""Motors of 50 W to 100 kW that nobody told, identified from simulated runs, within the limits.

One has cogging, one is on a soft coupling.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.motors import MORE, MOTORS, NAMES, bench
from hil.identify.estimate import Parameter
from hil.identify.plan import STEPS
from hil.identify.session import Session, planned, setup_for
from hil.signals import Reason
from hil.sim.simulate import simulate_ticks

pytestmark = [pytest.mark.compiled, pytest.mark.slow]
GOALS = {"R_s": 0.02, "L_d": 0.02, "L_q": 0.02, "psi_f": 0.02, "J": 0.03, "coulomb": 0.1}


@pytest.mark.long
@pytest.mark.parametrize("name", MOTORS)
def test_a_motor_that_nobody_told(tmp_path: Path, name: str) -> None:
    true = dict(zip(NAMES, MOTORS[name], strict=True))
    path, config, plant = bench(tmp_path, true)
    session = Session(path, config, config.motor)
    seconds = 0.0
    for step in planned(session, STEPS):
        ticks = simulate_ticks(setup_for(session, step), [*plant, *MORE.get(name, ())])
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
