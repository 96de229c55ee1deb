"""Faults of the drive itself, on the plant's records between two kernels; and a black box of what was real.

Phase loss: with phase a open i_alpha = 0, so the current vector lies on the beta axis. With the electrical
angle theta, i_alpha = i_d cos - i_q sin and i_beta = i_d sin + i_q cos; after each short substep the current
is projected onto i_alpha = 0. For L_d = L_q that is exact, since the beta equation does not hold i_alpha.
theta counts from 0 at the beginning of the fault. Encoder slip by delta: the true voltage is the commanded
one turned by delta, the measured current the true one turned back. An encoder that counts the wrong way is
off by delta = -2 theta, with theta = 0 where the drive booted. Of two phases exchanged the drive sees the
mirror image: u' = e^{-2j theta} conj(u), and the same of i, as d + j q.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from firmware_model.config import Record, new_state
from firmware_model.drive import advance
from firmware_model.faults import (
    Bias,
    BrownOut,
    DcLink,
    EncoderReversed,
    EncoderSlip,
    ExtraLoad,
    Fault,
    FrozenValue,
    Noise,
    OverTemperature,
    PhaseLoss,
    PhaseSwap,
)
from firmware_model.jit import jit
from firmware_model.plant import ANGLE, LOAD_SPEED, TWIST, ErrorCode, State
from firmware_model.sensors import to_angle, to_wire

OPEN_PHASE_STEP_NS: Final = 50_000
_KEPT: Final = ("t_ns", "started", "temperature", "random", "syncs")
_SHAFT: Final = (ANGLE, LOAD_SPEED, TWIST)
"""Rows of the series whose coefficients 0 are states of the shaft: a supply that fails leaves them."""
_MEASURED: Final = (("w", "w_lsb", "w_top"), ("i_q", "i_q_lsb", "i_q_top"), ("i_d", "i_d_lsb", "i_d_top"))


@jit
def project(x: Any, theta: float) -> None:
    """Take the alpha component out of the current of x = (w, i_q, i_d)."""
    sin, cos = math.sin(theta), math.cos(theta)
    beta = x[2] * sin + x[1] * cos
    x[1], x[2] = beta * cos, beta * sin


@jit
def advance_open_phase(p: Any, s: Any, theta: Any, dt_ns: int) -> None:
    """Advance by dt_ns with phase a open; ``theta``: one electrical angle [rad], moved on in place."""
    left = dt_ns
    while left > 0:
        step = min(left, OPEN_PHASE_STEP_NS)
        before = s["x"][0]
        advance(p, s, step)
        theta[0] += p["n_p"] * 0.5 * (before + s["x"][0]) * step * 1e-9
        project(s["x"], theta[0])
        left -= step


class BlackBox:
    """What really was at the motor: worst values, until when the inverter gave voltage, what faults did."""

    def __init__(self, onset_ns: int, kinds: Sequence[str], acted: Counter[int]) -> None:
        self._onset_ns, self._kinds, self._acted = onset_ns, kinds, acted
        self.last_on_ns = -1
        self.closed = False
        self.worst = {"w_rad_s": 0.0, "i_a": 0.0, "u_v": 0.0}

    def look(self, s: Any) -> None:
        """Look at a plant state that was just advanced."""
        w, i_q, i_d = (abs(float(value)) for value in s["x"])
        u = math.hypot(float(s["u_q"]), float(s["u_d"]))
        if u > 0.0 and s["state"] == State.OPERATION_ENABLED.value:
            self.last_on_ns = int(s["t_ns"])
        if s["t_ns"] >= self._onset_ns and not self.closed:
            now = {"w_rad_s": w, "i_a": math.hypot(i_q, i_d), "u_v": u}
            self.worst = {name: max(value, now[name]) for name, value in self.worst.items()}

    def as_dict(self, s: Any) -> dict[str, Any]:
        """Worst values from the last fault on, end of the voltage [s], how the drive ended."""
        last_on_s = None if self.last_on_ns < 0 else self.last_on_ns * 1e-9
        state, error = State(int(s["state"])).name, ErrorCode(int(s["error"])).name
        acted = [[kind, self._acted[place]] for place, kind in enumerate(self._kinds)]
        return {**self.worst, "voltage_until_s": last_on_s, "state": state, "error": error, "acted": acted}


class PlantFaults:
    """Faults on one drive's records. :meth:`before` and :meth:`after` stand around each sample.

    ``acted`` counts by the fault's place in the script in how many samples each of them changed something.
    """

    def __init__(
        self, faults: Sequence[Fault], params: Record, echo_none: int, acted: Counter[int] | None = None
    ) -> None:
        self._faults, self._params, self._echo_none = faults, params, echo_none
        if any(isinstance(fault, (EncoderReversed, PhaseSwap)) for fault in faults):
            params["turns"] = 1  # they go by the shaft's angle
        self._own = params.copy()
        self._theta = np.zeros(1)
        self._frozen: dict[int, tuple[float, ...]] = {}
        self._off = False
        self._last_ns = 0
        onset_s = max((fault.at_s for fault in faults), default=0.0)
        self.acted = Counter[int]() if acted is None else acted
        self.box = BlackBox(round(onset_s * 1e9), [fault.kind for fault in faults], self.acted)

    def advance(self, s: Any, dt_ns: int) -> None:
        """Move the plant on by dt_ns; with a phase open in short substeps."""
        open_phases = [
            place
            for place, fault in enumerate(self._faults)
            if isinstance(fault, PhaseLoss) and fault.active(int(s["t_ns"]))
        ]
        if not open_phases:
            advance(self._params[0], s, dt_ns)
            return
        advance_open_phase(self._params[0], s, self._theta, dt_ns)
        if s["x"][1] != 0.0 or s["x"][2] != 0.0:  # without current nobody can tell an open phase
            self.acted.update(open_phases)

    def before(self, s: Any) -> bool:
        """Apply what acts on parameters and state; True when the drive has just booted again."""
        t_ns, p, own = int(s["t_ns"]), self._params[0], self._own[0]
        self.box.look(s)
        for name in ("v_dc", "w_noise", "i_noise"):
            p[name] = own[name]
        off = False
        for place, fault in enumerate(self._faults):
            if not fault.active(t_ns):
                continue
            changed = isinstance(fault, (OverTemperature, BrownOut))
            if isinstance(fault, DcLink):
                p["v_dc"] = s["v_dc"] = fault.v_dc_v  # the link stands there, with or without a capacitor
                changed = p["v_dc"] != own["v_dc"]
            elif isinstance(fault, Noise):
                p["w_noise"], p["i_noise"] = fault.w_noise_rad_s, fault.i_noise_a
                changed = p["w_noise"] != own["w_noise"] or p["i_noise"] != own["i_noise"]
            elif isinstance(fault, OverTemperature):
                s["temperature"] += fault.rate_k_s * (t_ns - self._last_ns) * 1e-9
            elif isinstance(fault, ExtraLoad):
                changed = fault.torque_n_m != 0.0
            self.acted[place] += bool(changed)
            off |= isinstance(fault, BrownOut)
        self._last_ns = t_ns
        return self._supply(s, off)

    def _supply(self, s: Any, off: bool) -> bool:
        """Without supply the firmware forgets everything; the rotor keeps turning, the winding its heat."""
        went, came = off and not self._off, self._off and not off
        self._off = off
        if went:
            fresh = new_state(self._params, self._echo_none)[0]
            for name in _KEPT:
                fresh[name] = s[name]
            fresh["x"][0] = s["x"][0]
            for row in _SHAFT:
                fresh["series"][row, 0] = s["series"][row, 0]
            for name in fresh.dtype.names:
                s[name] = fresh[name]
        return came

    def after(self, s: Any, out: Any) -> None:
        """Apply what acts on the sample and on the voltage that was just latched."""
        t_ns = int(s["t_ns"])
        for number, fault in enumerate(self._faults):
            if not fault.active(t_ns):
                continue
            before = self._seen(s, out)
            if isinstance(fault, EncoderSlip):
                self._slip(s, out, math.radians(fault.angle_deg))
            elif isinstance(fault, EncoderReversed):
                self._slip(s, out, -2.0 * self._electrical(s))
                self._set(out, -out["w"], out["i_q"], out["i_d"])
                p = self._params[0]
                out["theta"] = to_angle(-s["series"][ANGLE, 0], p["theta_lsb"], p["theta_counts"])
            elif isinstance(fault, PhaseSwap):
                self._swap(s, out, -2.0 * self._electrical(s))
            elif isinstance(fault, Bias):
                self._set(out, out["w"] + fault.w_rad_s, out["i_q"] + fault.i_q_a, out["i_d"] + fault.i_d_a)
            elif isinstance(fault, FrozenValue):
                held = self._frozen.setdefault(number, tuple(float(out[name]) for name, _, _ in _MEASURED))
                self._set(out, *held)
            self.acted[number] += bool(self._seen(s, out) != before)

    @staticmethod
    def _seen(s: Any, out: Any) -> tuple[float, ...]:
        """What :meth:`after` may change."""
        return (s["u_q"], s["u_d"], *(out[name] for name, _, _ in _MEASURED))

    def _slip(self, s: Any, out: Any, delta: float) -> None:
        s["u_q"], s["u_d"] = turned(s["u_q"], s["u_d"], delta)
        self._set(out, out["w"], *turned(out["i_q"], out["i_d"], -delta))

    def _swap(self, s: Any, out: Any, delta: float) -> None:
        s["u_q"], s["u_d"] = turned(-s["u_q"], s["u_d"], delta)
        self._set(out, out["w"], *turned(-out["i_q"], out["i_d"], delta))

    def _electrical(self, s: Any) -> float:
        """The rotor's electrical angle [rad]."""
        return float(self._params[0]["n_p"] * s["series"][ANGLE, 0])

    def _set(self, out: Any, *values: float) -> None:
        """Put measured values on the wire's grid into the sample."""
        p = self._params[0]
        for (name, lsb, top), value in zip(_MEASURED, values, strict=True):
            out[name] = to_wire(float(value), float(p[lsb]), float(p[top]))


def turned(q: float, d: float, delta: float) -> tuple[float, float]:
    """A dq vector turned by delta [rad] towards positive q."""
    sin, cos = math.sin(delta), math.cos(delta)
    return float(q * cos + d * sin), float(d * cos - q * sin)
