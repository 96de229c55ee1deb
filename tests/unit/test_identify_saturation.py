"""An L_q that saturates, in the estimate: found at several currents, left alone where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hil.config.tables import RunConfig, load_toml
from hil.control.linalg import Array
from hil.identify.data import Samples
from hil.identify.estimate import Estimate, bent, chord, note_saturation
from hil.identify.fit import Shaft, bending, fit
from hil.identify.model import L_Q, SATURATION, J
from hil.identify.motorfile import toml_of
from tests.conftest import CONFIGS
from tests.unit import test_identify_fit as plain
from tests.unit.test_identify_fit import COULOMB_TRUE, GUESS, LOAD_TRUE, TRUE, T, noisy

pytestmark = pytest.mark.compiled
TRUE_S = 0.1
"""1/A2: L_q has halved at 6.3 A, and at the 2.3 A that flow here it is 23 % less."""


def saturating(x: Array, u: Array, way: float) -> Array:
    """A period of the motor, in its fluxes: i_q = phi + s phi^3."""
    m = TRUE
    start = np.roots([TRUE_S, 0.0, 1.0, -x[1]])
    phi = float(start[np.abs(start.imag).argmin()].real)

    def slope(_: float, x: Array) -> list[float]:
        w, f, d = x
        q = f + TRUE_S * f**3
        torque = 1.5 * m.n_p * ((m.psi_f + m.L_d * d) * q - m.L_q * f * d)
        return [
            (torque - m.B_f * w - COULOMB_TRUE * way - LOAD_TRUE) / m.J,
            (u[0] - m.R_s * q - m.n_p * w * (m.L_d * d + m.psi_f)) / m.L_q,
            (u[1] - m.R_s * d + m.n_p * w * m.L_q * f) / m.L_d,
        ]

    w, f, d = solve_ivp(slope, (0.0, T), [x[0], phi, x[2]], rtol=1e-9, atol=1e-9).y[:, -1]
    return np.array([w, f + TRUE_S * f**3, d])


@pytest.fixture(scope="module")
def samples() -> Samples:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plain, "tick", saturating)
        return noisy(plain.simulated(0, noise=(0.0, 0.0)), 1)


def test_a_saturating_l_q_is_found_at_more_than_one_current(samples: Samples) -> None:
    first = fit(samples, GUESS, Shaft(0.1))
    assert abs(first.value[L_Q] / TRUE.L_q - 1.0) > 0.03  # a constant one is a wrong one
    found = bent(samples, GUESS, first)
    assert found.value[SATURATION] == pytest.approx(TRUE_S, abs=float(found.half[SATURATION]))
    assert found.value[SATURATION] == pytest.approx(TRUE_S, rel=0.1)
    assert found.value[L_Q] == pytest.approx(TRUE.L_q, rel=0.02)
    assert found.value[J] == pytest.approx(TRUE.J, rel=0.03)
    for phi in (0.0, 0.5, 1.5):
        value, half = chord(found, phi + TRUE_S * phi**3)
        true = TRUE.L_q / (1.0 + TRUE_S * phi**2)
        assert abs(value - true) < 1.5 * half and value == pytest.approx(true, rel=0.02)


def test_it_is_told_in_figures_and_the_motor_file_covers_both_ends(samples: Samples) -> None:
    found = bent(samples, GUESS, fit(samples, GUESS, Shaft(0.1)))
    out = Estimate(samples=samples)
    out.put("L_q", float(found.value[L_Q]), 0.0)
    note_saturation(out, found)
    p = out.parameters["L_q_saturation"]
    assert p.low < 2.0 / np.sqrt(TRUE_S) < p.high and p.unit == "A"
    currents, values = ([row[key] for row in out.saturation] for key in ("i_q_a", "value"))
    assert currents[0] == 0.0 and currents[2] == 2.0 * currents[1] and values == sorted(values, reverse=True)
    assert "L_q saturates: " in out.findings[0] and out.as_dict()["saturation"] == out.saturation
    config = load_toml(CONFIGS / "demo.toml", RunConfig)
    text = toml_of(out, config.motor, config, [])
    assert "L_q_saturation_a = 6." in text
    low = text.partition("[identified.low]")[2].partition("[identified.high]")[0]
    assert float(low.partition("L_q_h = ")[2].split()[0]) == pytest.approx(out.saturation[2]["low"], rel=1e-5)


def test_a_constant_l_q_stays_one_to_the_bit() -> None:
    constant = noisy(plain.simulated(0, noise=(0.0, 0.0)), 1)
    found = fit(constant, GUESS, Shaft(0.1))
    assert bent(constant, GUESS, found) is found and found.saturation == 0.0
    assert bending(constant, TRUE, Shaft(COULOMB_TRUE, LOAD_TRUE), found.sigma) == 0.0
