"""Saturation of the emulated motor's q axis: against another solver, and none without its key."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from firmware_model import drive
from firmware_model.config import PlantConfig
from firmware_model.registry import PlantError
from firmware_model.saturation import flux_of
from firmware_model.shaft import refuse_uncoupled
from tests.unit.test_firmware_model import FREE, MOTOR, plant

SATURATION = 6.0
LOAD = [{"kind": "fan", "k_n_m_s2": 1e-4}]


def flux(i_q: float) -> float:
    """psi_q [Wb] by the definition, solved by bracketing."""
    half = 0.5 * SATURATION
    return 0.033 * float(brentq(lambda a: a + a**3 / half**2 - i_q, -abs(i_q) - 1, abs(i_q) + 1, xtol=1e-14))


@pytest.mark.parametrize("current", [-20.0, -3.0, 0.0, 1e-9, 0.1, 6.0, 40.0])
def test_the_flux_is_the_root_of_its_cubic_and_half_at_the_current_of_the_key(current: float) -> None:
    p, _ = plant(motor=MOTOR | {"L_q_saturation_a": SATURATION})
    assert 0.033 * flux_of(p[0], current) == pytest.approx(flux(current), rel=1e-13, abs=1e-16)
    assert flux_of(p[0], SATURATION) == pytest.approx(SATURATION / 2, rel=1e-14)


@pytest.mark.parametrize("more", [{}, {"load": LOAD}, {"friction": {"coulomb_n_m": 0.3}}])
def test_series_follows_dop853_in_the_fluxes(more: dict[str, Any]) -> None:
    p, s = plant(motor=MOTOR | {"L_q_saturation_a": SATURATION}, firmware=FREE, substep_us=100, **more)
    start = np.array([40.0, 9.0, -3.0])
    s["x"], s["u_q"], s["u_d"] = start, 110.0, -30.0
    fan, coulomb = 1e-4 if "load" in more else 0.0, 0.3 if "friction" in more else 0.0

    def f(t: float, x: Any) -> list[float]:
        w, psi_q, i_d = x
        i_q = psi_q / 0.033 * (1 + (psi_q / (0.033 * 0.5 * SATURATION)) ** 2)
        T = 4.5 * ((0.7 + 0.02 * i_d) * i_q - psi_q * i_d) - 2e-3 * w - fan * w * abs(w) - coulomb
        emf = 3 * w * (0.02 * i_d + 0.7)
        return [T / 0.011, 110.0 - 2 * i_q - emf, (-30.0 - 2 * i_d + 3 * w * psi_q) / 0.02]

    drive.advance(p[0], s[0], 20_000_000)
    begin = [40.0, flux(9.0), -3.0]
    exact = solve_ivp(f, (0.0, 0.02), begin, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    assert flux(s["x"][0, 1]) == pytest.approx(exact[1], abs=1e-11)
    np.testing.assert_allclose(s["x"][0, ::2], exact[::2], rtol=0, atol=1e-9)


def test_without_the_key_nothing_varies_and_with_an_endless_one_the_motor_is_the_same() -> None:
    p, s = plant(firmware=FREE)
    q, r = plant(motor=MOTOR | {"L_q_saturation_a": 1e9}, firmware=FREE)
    assert (p["L_q_saturation"], p["varying"]) == (0.0, 0) and q["varying"] == 1
    for record in (s, r):
        record["x"], record["u_q"] = np.array([40.0, 9.0, -3.0]), 110.0
    drive.advance(p[0], s[0], 20_000_000)
    drive.advance(q[0], r[0], 20_000_000)
    np.testing.assert_allclose(s["x"], r["x"], rtol=1e-12)


def test_two_motors_on_one_shaft_refuse_it() -> None:
    config = PlantConfig.model_validate(
        {"dbc": "none.dbc", "motor": MOTOR | {"L_q_saturation_a": SATURATION}}
    )
    with pytest.raises(PlantError, match=r"plant of one: motor\.L_q_saturation_a: not on a shaft"):
        refuse_uncoupled({"one": config})
