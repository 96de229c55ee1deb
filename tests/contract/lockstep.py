"""A shipped configuration against its emulated drive in lockstep, through the load step."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hil.replay import Verdict, replay
from hil.runtime.setup import Overrides
from hil.signals import DriveState, Reason
from hil.sim.demo import closed_loop


def held_in_lockstep(path: Path, folder: Path) -> Verdict:
    """Run it, see that the load is held and that nothing is commanded after the stop; replay its log."""
    own = ('loop.clock="lockstep"', "loop.duration_s=3.5", f'log.folder="{folder}"')
    _, result, log = closed_loop(path, Overrides(settings=own))
    ticks = log.ticks
    assert result.outcome.reason == Reason.STOP_REQUESTED and result.outcome.skipped == 0
    on = ticks[ticks["state"] == int(DriveState.OPERATION_ENABLED)]
    assert 2.0 < np.abs(on["w"] - on["w_ref"]).max() < 5.0
    late = on[(on["t_ns"] > 2_800_000_000) & (on["t_ns"] < 3_400_000_000)]
    assert np.abs(late["w"] - late["w_ref"]).max() < 0.3
    assert not ticks["u_q"][ticks["reason"] != 0].any()
    return replay(Path(result.log))
