"""What logs of format 1 hold as bare bytes: the records of hil-drive 1a4c819, kept for ever.

From format 2 on a log says its parameters and states by name and needs no table here. A word is
``name:kind[shape]``, the kind f8 unless said otherwise; the records are aligned.
"""

from __future__ import annotations

import re
from typing import Final

import numpy as np

FORMAT: Final = 2
"""The format that is written. docs/log-format.md says when it is raised."""
TICK_FIELDS_1: Final = frozenset((*range(1, 9), *range(16, 36), *range(48, 68)))
"""Numbers of the tick's fields in format 1; an input that came later says what its absence means."""

_SAFETY = """
    T_s w_max i_trip u_max du_max T_L_max v_dc_min v_dc_max temperature_max i_continuous i2t_max
    power_window energy_max deviation_max soft_start_ticks:i8 trip_ticks:i8 guard_trip_ticks:i8
    hold_ticks:i8 quick_stop_ticks:i8 error_budget:i8 enable_ticks:i8 max_gap:i8 echo_lag:i8 frozen_ticks:i8
    repeat_ticks:i8 frozen_du w_error_max w_error_ticks:i8 i_d_max open_phase_min counter_modulus:i8
    shadow:i8 u_lsb T_L_lsb J
"""
_LAW = """
    kind:i8 coupling:i8 Ad:f8[3,3] Bd:f8[3,3] Ed:f8[3,3] gap_inverse:f8[64,3,3] max_gap:i8 lam:f8[2,3]
    lam_N:f8[2,3] theta:f8[2,3] N:i8[3] closed:f8[3,3] Bd_inv:f8[3,3] T_s J k_t n_p L_d L_q a_w e_w lam_w
    lam_q lam_d i_max T_L_max
"""
_SAFETY_STATE = """
    state:i8 reason:i8 armed_ticks:i8 word:i8 run_ticks:i8 stop_ticks:i8 stale:i8 crc_level:i8
    counter_level:i8 over:i8[8] clamped:i8 deviating:i8 lagging:i8 echo:i8 frozen:i8 repeats:i8
    uncontrolled:i8 seen:f8[3] seen_q seen_d i2t energy u_q u_d T_L counter:i8 sent_q:f8[256] sent_d:f8[256]
    sent_T:f8[256] ua_q ua_d ua_T
"""
_LAW_STATE = """
    x:f8[3] x_open:f8[3] c:f8[3] ua:f8[3] v:f8[3] h:f8[2,3] past:f8[1024,2,3] head:i8 d_hat:f8[3] gap:i8
    started:i8 filled:i8 x_p:f8[3] d_p:f8[3] work:f8[3] u:f8[3] i_q_ref
"""


def _dtype(text: str) -> np.dtype[np.void]:
    """The record that a table's words describe."""
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for word in text.split():
        found = re.fullmatch(r"(\w+)(?::(\w+))?(?:\[([\d,]+)\])?", word)
        assert found is not None, word  # noqa: S101 - a table of this file
        shape = tuple(int(part) for part in (found[3] or "").split(",") if part)
        fields.append((found[1], found[2] or "f8", shape))
    return np.dtype(fields, align=True)


FORMAT_1: Final = {
    "safety": _dtype(_SAFETY),
    "law": _dtype(_LAW),
    "safety_state": _dtype(_SAFETY_STATE),
    "law_state": _dtype(_LAW_STATE),
}
