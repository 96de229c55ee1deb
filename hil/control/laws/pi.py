"""PI cascade with anti-windup and decoupling of back-EMF and cross-coupling: what drives ship, as a baseline.

    i_q* = limit(k_w e_w + I_w + J dw*/k_t),  I_w <- I_w + T_s k_iw (e_w + (i_q* - asked) / k_w)
    u_q  = k_c (i_q* - i_q) + I_q + n_p w (psi_f + L_d i_d),  u_d = -k_c i_d + I_d - n_p w L_q i_q
and (u_q, u_d) limited to the circle. The integrators take the error that the limited output stands for
(realizable reference), so none winds up. The observer runs beside it, for the log alone.
"""

from __future__ import annotations

from typing import Any

from hil.control.registry import Key, Law, Plan, Values

CODE = 2


def design(values: Values, _plan: Plan) -> dict[str, Any]:
    """The gains as they are given."""
    current = (values["current_gain_v_a"], values["current_integral_v_as"])
    return {
        "k_p": (values["speed_gain_as_rad"], current[0], current[0]),
        "k_i": (values["speed_integral_a_rad"], current[1], current[1]),
    }


MEMBER = Law(
    "pi",
    "PI cascade with anti-windup; uses no estimate",
    CODE,
    design,
    {
        "speed_gain_as_rad": Key("proportional gain of the speed"),
        "speed_integral_a_rad": Key("integral gain of the speed", above=None, least=0.0),
        "current_gain_v_a": Key("proportional gain of the currents"),
        "current_integral_v_as": Key("integral gain of the currents", above=None, least=0.0),
    },
)
