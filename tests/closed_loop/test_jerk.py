"""Feed-forward of the reference's jerk: S-curves of a motor as it is believed, without noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hil.errors import HilError
from hil.runtime.setup import Overrides, load_setup
from hil.sim.simulate import simulate_ticks
from tests.conftest import CONFIGS

MATCHED = (
    "motor={R_s_ohm=2.875,L_d_h=0.033,L_q_h=0.033,psi_f_wb=0.8,n_p=3,J_kg_m2=0.011,B_f_n_m_s=2e-4}",
    "load=[]", "friction={}", "sensors={}", "inverter={v_dc_v=540.0,resolution_v=0.0}",
)  # fmt: skip
FED = "controller.jerk_feedforward=true"
S_CURVE = ("reference.rate_rad_s2=200.0", "reference.jerk_rad_s3=10000.0", "reference.down_at_s=1.9")
RAMP = ('reference={kind="ramp", w_rad_s=80.0, rate_rad_s2=1500.0, at_s=0.2, down_at_s=1.5}',)


def run(name: str, *settings: str, plant: tuple[str, ...] = MATCHED) -> Any:
    overrides = Overrides(settings=("loop.duration_s=2.0", *settings))
    return simulate_ticks(load_setup(CONFIGS / f"{name}.toml", overrides), list(plant))


def off(ticks: Any) -> float:
    """Largest |w - w*| of the move up [rad/s]."""
    t = np.arange(len(ticks)) * 1e-3
    moving = (t > 0.21) & (t < 1.2)
    return float(np.abs(ticks["w"] - ticks["w_ref"])[moving].max())


@pytest.mark.parametrize(("name", "most"), [("demo", 0.1), ("rigid", 0.1), ("current", 0.04)])
def test_an_s_curve_is_followed_closer(name: str, most: float) -> None:
    """The resolution of w is 0.01 rad/s; where the jerk jumps a tick passes before it is seen."""
    fed = off(run(name, *S_CURVE, FED))
    assert fed < most and fed < 0.25 * off(run(name, *S_CURVE))


def test_field_weakening_keeps_it() -> None:
    salient = MATCHED[1:]
    assert off(run("salient", *S_CURVE, FED, plant=salient)) < 0.5 * off(
        run("salient", *S_CURVE, plant=salient)
    )


@pytest.mark.parametrize("name", ["demo", "current"])
def test_a_jump_of_the_slope_asks_for_no_more_than_the_limit(name: str) -> None:
    """1500 rad/s2 take 4.6 A; the limit is 4 A."""
    ticks = run(name, *RAMP, FED, "limits.i_max_a=4.0", "limits.following_error_s=60")
    plain = run(name, *RAMP, "limits.i_max_a=4.0", "limits.following_error_s=60")
    assert np.abs(ticks["i_q"]).max() < np.abs(plain["i_q"]).max() + 0.05
    assert (ticks["reason"][-1], plain["reason"][-1]) == (1, 1)


def test_without_the_key_nothing_changes_and_other_laws_refuse_it() -> None:
    same = run("demo", *S_CURVE, "controller.jerk_feedforward=false")
    assert (same["u_q"] == run("demo", *S_CURVE)["u_q"]).all()
    gains = 'controller={kind="deadbeat", speed_pole_rad_s=60.0, jerk_feedforward=true}'
    with pytest.raises(HilError, match=r"jerk_feedforward"):
        load_setup(CONFIGS / "demo.toml", Overrides(settings=(gains,)))
