"""The law torque on a drive that takes voltages: a table of torques, by the least current, within limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.config.design import law_spec
from hil.config.tables import RunConfig, load_toml
from hil.control.law import MTPA, SPEED, ask, design_law, is_saturated, new_law_state, observe
from hil.control.mtpa import least_current, most_torque
from hil.errors import HilError
from hil.replay import replay
from hil.report.metrics import operating
from hil.runtime.setup import Overrides, load_setup
from hil.signals import Reason
from hil.sim.demo import closed_loop
from hil.sim.simulate import simulate_ticks
from hil.tuning.bench import speed_drive
from tests.conftest import CONFIGS

PATH = CONFIGS / "salient.toml"
TABLE = (
    'controller={kind="torque", torque_n_m=[0.0, 20.0, -12.0], for_s=[0.2, 0.4, 0.6], slew_n_m_s=1000.0}',
    'reference={kind="step", w_rad_s=0.0}',
    "limits.following_error_rad_s=1000.0",
    "loop.duration_s=1.3",
)
HEAVY = "motor={R_s_ohm=2.875, L_d_h=0.033, L_q_h=0.066, psi_f_wb=0.8, n_p=3, J_kg_m2=0.5}"
SMOOTH = ("load=[]", "friction.coulomb_n_m=0.0", "friction.static_n_m=0.0")


def row(torque: float, slew: float, *more: str) -> tuple[Any, Any]:
    table = f'controller={{kind="torque", torque_n_m=[{torque}], for_s=[0.01], slew_n_m_s={slew}}}'
    p = design_law(law_spec(load_toml(PATH, RunConfig, (table, *more))), 1e-3)[0]
    return p, new_law_state()[0]


def asked(p: Any, s: Any, w: float, w_ref: float = 0.0) -> tuple[float, float]:
    observe(p, s, w, 0.0, 0.0, True, 1)
    s["started"] = 0  # each measurement begins anew: no estimate
    ask(p, s, w_ref, 0.0, 0.0, 180.0)
    return float(s["i_d_ref"]), float(s["i_q_ref"])


@pytest.mark.parametrize("torque", [20.0, -12.0])
def test_the_torque_is_made_by_the_least_current_and_reached_at_its_slew(torque: float) -> None:
    p, s = row(torque, 5000.0)
    assert p["kind"] == MTPA
    for tick in range(1, 11):
        T = np.sign(torque) * min(5.0 * tick, abs(torque))
        assert asked(p, s, 5.0) == pytest.approx(least_current(0.8, 0.033, T / 4.5), rel=1e-9)
        assert not is_saturated(p, s, 1e9)
    assert asked(p, s, 5.0) == (0.0, 0.0)  # after the last row


def test_another_speed_than_none_asked_for_ends_it() -> None:
    p, s = row(20.0, 1e9)
    assert asked(p, s, 5.0)[1] > 5.0
    assert asked(p, s, 5.0, w_ref=1.0) == (0.0, 0.0) and asked(p, s, 5.0) == (0.0, 0.0)


def test_more_than_current_and_voltage_make_is_cut_and_flagged() -> None:
    for w in (5.0, 100.0):
        p, s = row(90.0, 1e9)
        i_d, i_q = asked(p, s, w)
        most_d, most_q = most_torque(p, 3.0 * float(s["x_p"][0]), 0.92 * 180.0, 1.0)
        assert (i_d, i_q) == pytest.approx((most_d, most_q), rel=1e-9)
        assert is_saturated(p, s, 1e9)


def test_a_torque_that_brakes_gives_no_more_back_than_may_be() -> None:
    p, s = row(-20.0, 1e9, "limits.p_regen_max_w=100.0")
    i_d, i_q = asked(p, s, 40.0)
    w = 3.0 * float(s["x_p"][0])
    back = 1.5 * (2.875 * (i_d**2 + i_q**2) + w * (0.8 - 0.033 * i_d) * i_q)
    assert back == pytest.approx(-100.0, rel=1e-9) and is_saturated(p, s, 1e9)


def test_a_drive_with_a_current_loop_keeps_its_own_kernel() -> None:
    table = 'controller={kind="torque", torque_n_m=[1.0], for_s=[1.0]}'
    config = load_toml(CONFIGS / "current.toml", RunConfig, (table,))
    assert design_law(law_spec(config), 1e-3)["kind"][0] == SPEED


def test_there_is_no_speed_to_tune() -> None:
    with pytest.raises(HilError, match="torque follows no speed; only speed drives can be tuned"):
        speed_drive(PATH, Overrides(settings=TABLE))


@pytest.mark.compiled
def test_on_the_emulated_drive_each_row_is_the_motors_torque() -> None:
    own = operating(simulate_ticks(load_setup(PATH, Overrides(settings=TABLE)), [HEAVY, *SMOOTH]))
    torque = 4.5 * (0.8 - 0.033 * own["i_d"]) * own["i_q"]
    start = int(own["t_ns"][0])
    for begin, end, wanted in ((0.0, 0.19, 0.0), (0.3, 0.59, 20.0), (0.7, 1.19, -12.0)):
        now = (own["t_ns"] - start > begin * 1e9) & (own["t_ns"] - start < end * 1e9)
        assert torque[now].mean() == pytest.approx(wanted, abs=0.03)
    assert np.abs(own["i_d_ref"]).max() > 1.0 and not own["guard_flags"].any()


@pytest.mark.compiled
def test_on_the_bus_in_lockstep_it_replays_to_the_bit(tmp_path: Path) -> None:
    own = (
        'loop.clock="lockstep"',
        "loop.duration_s=0.8",
        "controller.torque_n_m=[0.0, 3.0, -3.0]",
        f'log.folder="{tmp_path}"',
    )
    _, result, log = closed_loop(PATH, Overrides(settings=(*TABLE, *own)))
    assert result.outcome.reason == Reason.STOP_REQUESTED
    assert np.abs(operating(log.ticks)["i_q"]).max() > 0.7
    assert replay(Path(result.log)).verdict == "same"
