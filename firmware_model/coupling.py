"""A soft coupling: the motor and what it drives are two inertias, J = J_m + J_l, on a spring with a damper.

    J_m dw/dt = T - T_f - B_f w - T_k,  J_l dw_l/dt = T_k - T_L,  dphi/dt = w - w_l
    T_k = c phi + d (w - w_l)
so with the load held the motor swings at sqrt(c / J_m), with the motor held the load at sqrt(c / J_l) (the
anti-resonance of w over T), and both free at w_r = sqrt(c (1 / J_m + 1 / J_l)). The load's speed w_l and the
twist phi are two rows of the motor's Taylor series (:mod:`firmware_model.motor`), coefficient by coefficient.
Load torques act behind the coupling. Friction, brakes and what goes by the shaft's angle, as cogging, act on
the motor, whose angle that is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from pydantic import model_validator

from firmware_model.jit import jit
from firmware_model.plant import LOAD_SPEED, TWIST
from firmware_model.series import evaluate
from firmware_model.tables import NonNegative, Positive, Table

DAMPING: Final = 0.01
"""Damping ratio of a coupling that says none: steel with a bolted joint."""
REACH: Final = 0.2
"""Largest r h of a substep h, r the shaft's fastest rate: the series leaves about (r h)^9 / 9! = 1e-12."""
FASTEST_RAD_S: Final = REACH / 10e-6
"""Fastest rate of a shaft: substeps of 10 us. What is stiffer is rigid to any drive."""


@dataclass(frozen=True, slots=True)
class Masses:
    """Inertias before and behind the coupling [kg m2], its stiffness [N m/rad] and damping [N m s/rad].

    A rigid shaft has all of its inertia before it.
    """

    J_m: float
    J_l: float = 0.0
    c: float = 0.0
    d: float = 0.0

    @property
    def resonance_rad_s(self) -> float:
        """w_r, of two inertias."""
        return math.sqrt(self.c * (1.0 / self.J_m + 1.0 / self.J_l))

    @property
    def rate_rad_s(self) -> float:
        """Bound of both poles of s^2 + d (1/J_m + 1/J_l) s + w_r^2."""
        return max(self.resonance_rad_s, self.d * (1.0 / self.J_m + 1.0 / self.J_l))

    @property
    def substep_ns(self) -> float:
        """Longest substep that the series resolves; infinite for a rigid shaft."""
        return math.inf if self.J_l == 0.0 else math.floor(REACH / self.rate_rad_s * 1e9)


class Coupling(Table):
    """A soft coupling between the motor and its load; of each pair of keys one is given.

    Load torques act behind it. Friction, brakes and cogging act on the motor.
    """

    J_load_kg_m2: Positive | None = None
    """What of the motor table's J_kg_m2, which is both together, lies behind the coupling."""
    inertia_ratio: Positive | None = None
    """Or J_l / J_m, the load's inertia over the motor's own."""
    stiffness_n_m_rad: Positive | None = None
    """Stiffness c: torque over twist."""
    resonance_hz: Positive | None = None
    """Or where it resonates with both ends free: (c (1/J_m + 1/J_l))^1/2 / 2 pi."""
    damping_n_m_s_rad: NonNegative | None = None
    """Damping d: torque over the difference of speeds."""
    damping_ratio: NonNegative | None = None
    """Or the resonance's damping ratio; left out both: 0.01."""

    @model_validator(mode="after")
    def _one_of_each(self) -> Coupling:
        for one, other in (("J_load_kg_m2", "inertia_ratio"), ("stiffness_n_m_rad", "resonance_hz")):
            if (getattr(self, one) is None) == (getattr(self, other) is None):
                raise ValueError(f"give one of {one} and {other}")
        if self.damping_n_m_s_rad is not None and self.damping_ratio is not None:
            raise ValueError("give one of damping_n_m_s_rad and damping_ratio, or neither")
        return self

    def masses(self, J: float) -> Masses:
        """Both ends of a shaft of J [kg m2] together. Raises ValueError for what can't be or is as rigid."""
        J_l = self._behind(J)
        J_e = (J - J_l) * J_l / J
        c, w_r = self.stiffness_n_m_rad, self.resonance_hz
        if c is None:
            c = (2.0 * math.pi * (w_r or 0.0)) ** 2 * J_e
        d = self.damping_n_m_s_rad
        if d is None:
            d = 2.0 * (DAMPING if self.damping_ratio is None else self.damping_ratio) * math.sqrt(c * J_e)
        found = Masses(J - J_l, J_l, c, d)
        if found.rate_rad_s > FASTEST_RAD_S:
            raise ValueError(_too_stiff(found))
        return found

    def _behind(self, J: float) -> float:
        """J_l [kg m2]."""
        if self.inertia_ratio is not None:
            J_l = J * self.inertia_ratio / (1.0 + self.inertia_ratio)
        else:
            J_l = self.J_load_kg_m2 or 0.0
        if not 0.0 < J_l < J:
            raise ValueError(
                f"J_load_kg_m2 = {J_l:g} must be less than motor.J_kg_m2 = {J:g}, motor and load together"
            )
        return J_l


def _too_stiff(shaft: Masses) -> str:
    """Why the series does not resolve it, and what to do."""
    most = FASTEST_RAD_S / (2.0 * math.pi)
    if shaft.resonance_rad_s > FASTEST_RAD_S:
        at = shaft.resonance_rad_s / (2.0 * math.pi)
        return f"resonance at {at:.0f} Hz: above {most:.0f} Hz a shaft counts as rigid; leave the table out"
    return (
        f"damping d (1/J_m + 1/J_l) = {shaft.rate_rad_s:.0f} 1/s: above {FASTEST_RAD_S:.0f} 1/s a shaft "
        "counts as rigid; lessen it or leave the table out"
    )


@jit
def coupling_torque(p: Any, twist: float, slip: float) -> float:
    """T_k [N m] of the twist [rad] and the difference of speeds [rad/s]; or a coefficient of it."""
    return float(p["stiffness"] * twist + p["damping"] * slip)


@jit
def twisted(p: Any, c: Any, T_L: float, k: int) -> float:
    """Coefficient k of T_k under the load torque's; coefficients k + 1 of w_l and phi go to their rows."""
    slip, share = c[0, k] - c[LOAD_SPEED, k], 1.0 / (k + 1)
    T = coupling_torque(p, c[TWIST, k], slip)
    c[TWIST, k + 1] = slip * share
    c[LOAD_SPEED, k + 1] = (T - T_L) / p["J_load"] * share
    return T


@jit
def load_speed(p: Any, s: Any) -> float:
    """Speed at which the loads turn [rad/s]."""
    return float(s["series"][LOAD_SPEED, 0] if p["J_load"] > 0.0 else s["x"][0])


@jit
def far_end(p: Any, c: Any, h: float) -> None:
    """Move the load's speed and the twist on by h [s], in place; coefficients 0 are the states."""
    if p["J_load"] > 0.0:
        c[LOAD_SPEED, 0] = evaluate(c[LOAD_SPEED], h)
        c[TWIST, 0] = evaluate(c[TWIST], h)
