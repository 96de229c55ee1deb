"""The experiments: which steps there are, what the shaft will do, and the run configuration of each.

Every step is a run like any other, by the ``identify`` law: same loop, guard, supervisor, guardian and log.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pydantic import TypeAdapter

from hil.config.design import inner_loop
from hil.config.law import ControllerTable, ObserverTable
from hil.config.motor import MotorTable
from hil.config.reference import StepReference
from hil.config.tables import RunConfig
from hil.control.speedfilter import order_of
from hil.errors import HilError

STEPS: Final = ("sensors", "standstill", "spinning", "inertia", "shaft")
PASSES: Final = 14
SPEED_SHARE: Final = 0.6
"""Speed of the experiments as a share of w_max_rad_s and of what the voltage gives."""
CURRENT_SHARE: Final = 0.5
"""Torque current of the experiments as a share of i_max_a."""
REVERSALS: Final = (0.45, 0.8, 0.55, 0.8, 0.6, 0.8, 0.5, 0.8, 0.45, 0.8, 0.55)
"""Speeds at which the step ``shaft`` reverses its torque, as shares of the fastest: at times that differ."""
REVERSAL_S: Final = 0.06
"""Time from one of them to the next, about."""


@dataclass(frozen=True, slots=True)
class Step:
    """One run: its name, what it does in words, its table of the ``identify`` law, its length [s]."""

    name: str
    words: str
    controller: dict[str, Any]
    seconds: float


@dataclass(frozen=True, slots=True)
class Skipped:
    """A step that the limits do not allow, and which."""

    name: str
    why: str


def chosen(text: str | None) -> tuple[str, ...]:
    """The steps that were asked for, in their order. Raises HilError for one there is not."""
    names = [name.strip() for name in text.split(",") if name.strip()] if text is not None else list(STEPS)
    unknown = [name for name in names if name not in STEPS]
    if unknown or not names:
        raise HilError(f"--steps: no step {', '.join(unknown) or text!r}; there are {', '.join(STEPS)}")
    return tuple(name for name in STEPS if name in names)


def _rows(*rows: tuple[float, float, float, float, float]) -> dict[str, Any]:
    """(q, d, w, slew, for) of each row as the law's columns."""
    names = ("q", "d", "w_rad_s", "slew_a_s", "for_s")
    return {name: [float(row[j]) for row in rows] for j, name in enumerate(names)}


def top_speed(config: RunConfig, motor: MotorTable) -> float:
    """Speed of the experiments [rad/s]: within w_max, and within half the voltage by the believed psi_f.

    Of a drive with a current loop of its own the voltage is that of v_dc_min_v, where there is one.
    """
    most = (
        config.command.most if config.drive.takes == "voltage" else config.limits.v_dc_min_v / math.sqrt(3.0)
    )
    by_voltage = 0.8 * (most or math.inf) / (motor.n_p * motor.psi_f_wb)
    return SPEED_SHARE * min(config.limits.w_max_rad_s, by_voltage)


def _at_rest(config: RunConfig, passes: float) -> dict[str, Any]:
    """What both steps without lasting torque share."""
    most = 0.5 * config.limits.w_max_rad_s
    return {"passes": passes, "w_most_rad_s": most, "w_wrong_rad_s": most}


def sensors(config: RunConfig, motor: MotorTable) -> Step:
    """At rest without voltage: noise, resolution, and whether something drives the shaft."""
    table = _rows((0, 0, 0, 0, 0.3)) | _at_rest(config, 1.0)
    return Step("sensors", "no voltage; the shaft stays where it is", table, 0.3)


def _pulses(T: float) -> list[tuple[float, float, float, float, float]]:
    """Rows of one pass: long pulses along d for R_s and L_d, short ones along q that leave no speed."""
    on, off, short = 0.03, 0.05, max(0.003, 2 * T)
    d: list[tuple[float, float]] = [(1, on), (0, off), (-1, on), (0, off)]
    d += [(sign, n * short) for sign, n in ((1, 1), (-1, 2), (1, 3), (-1, 3), (1, 2), (-1, 1))]
    q: list[tuple[float, float]] = [(1, short), (-1, 2 * short), (1, short), (0, 6 * short)]
    q += [(-1, short), (1, 2 * short), (-1, short), (0, 6 * short)]
    return [(0, u, 0, 0, t) for u, t in d] + [(0, 0, 0, 0, 0.02)] + [(u, 0, 0, 0, t) for u, t in q]


def standstill(config: RunConfig, motor: MotorTable) -> Step | Skipped:
    """Voltage pulses along d and q that grow until the currents reach half their limits."""
    limits, T = config.limits, 1.0 / config.loop.rate_hz
    i_d = min(CURRENT_SHARE * limits.i_max_a, 0.7 * (limits.i_d_max_a or limits.i_max_a))
    most = 0.45 * min(2.0 * config.command.most, config.command.step)
    rows = _pulses(T)
    table = (
        _rows(*rows)
        | _at_rest(config, float(PASSES))
        | {
            "u_start_v": most / 1000.0,
            "u_most_v": most,
            "i_q_goal_a": 0.8 * CURRENT_SHARE * limits.i_max_a,
            "i_d_goal_a": i_d,
        }
    )
    words = f"voltage pulses up to {i_d:.3g} A along d, short ones along q; the shaft trembles"
    return Step("standstill", words, table, PASSES * sum(row[4] for row in rows))


def _torque(config: RunConfig, motor: MotorTable) -> dict[str, Any]:
    """What both turning steps share."""
    w = top_speed(config, motor)
    return {
        "w_most_rad_s": min(1.4 * w, 0.95 * config.limits.w_max_rad_s),
        "w_wrong_rad_s": 0.05 * w,
        "current_pole_rad_s": 0.2 * config.loop.rate_hz,
    }


def spinning(config: RunConfig, motor: MotorTable) -> Step | Skipped:
    """Torque that grows slowly until the shaft turns; then it coasts."""
    w, i = top_speed(config, motor), CURRENT_SHARE * config.limits.i_max_a
    seconds = 2.5
    rows = ((i, 0, 0.6 * w, i / seconds, seconds), (0, 0, 0.2 * w, 1e6, 0.5))
    table = _rows(*rows) | _torque(config, motor) | {"i_brake_a": 0.2 * i}
    words = f"torque grows up to {i:.3g} A until the shaft turns at {0.6 * w:.3g} rad/s, forward, then coasts"
    return Step("spinning", words, table, seconds + 0.5 + 1.5)


def inertia(config: RunConfig, motor: MotorTable) -> Step | Skipped:
    """Run-up and run-down in both directions, coasting between."""
    w, most = top_speed(config, motor), CURRENT_SHARE * config.limits.i_max_a
    k_t = 1.5 * motor.n_p * motor.psi_f_wb
    i = min(max(motor.J_kg_m2 * w / (0.3 * k_t), 0.2 * most), most)
    rows = []
    for share in (1.0, -1.0, 0.6, -0.6):
        q = share * i
        rows += [(q, 0, w * share / abs(share), 20 * i, 1.5), (0, 0, 0.15 * w, 20 * i, 0.7)]
    table = _rows(*rows) | _torque(config, motor) | {"i_brake_a": 0.5 * i}
    words = f"run-up to {w:.3g} rad/s and run-down, in both directions, with up to {i:.3g} A"
    return Step("inertia", words, table, 4 * 2.2 + 1.5)


def shaft(config: RunConfig, motor: MotorTable) -> Step | Skipped:
    """Torque that reverses at speeds between which the shaft keeps turning, in both directions.

    Its steps ring what a soft coupling has behind it.
    """
    w, most = top_speed(config, motor), CURRENT_SHARE * config.limits.i_max_a
    k_t, span = 1.5 * motor.n_p * motor.psi_f_wb, 0.25 * w
    first = min(max(motor.J_kg_m2 * w / (0.3 * k_t), 0.2 * most), most)
    i = min(motor.J_kg_m2 * span / (REVERSAL_S * k_t) + 0.05 * most, most)
    slew, rows = i / 0.005, []
    for way in (1.0, -1.0):
        rows.append((way * first, 0.0, way * 0.8 * w, 20 * first, 1.5))
        up = [j % 2 == 1 for j in range(len(REVERSALS))]
        rows += [
            (way * i * (1.0 if rises else -1.0), 0.0, way * share * w, slew, 0.4)
            for share, rises in zip(REVERSALS, up, strict=True)
        ]
        rows.append((0.0, 0.0, 0.15 * w, slew, 0.3))
    table = _rows(*rows) | _torque(config, motor) | {"i_brake_a": 0.5 * i}
    words = f"torque of {i:.3g} A that reverses at speeds from {0.45 * w:.3g} to {0.8 * w:.3g} rad/s"
    return Step("shaft", f"{words}, in both directions", table, 2 * (1.5 + 0.15 * len(REVERSALS)) + 1.0)


def own_shaft(config: RunConfig, motor: MotorTable) -> Step | Skipped:
    """Left out: behind a current loop of its own the design rests on no shaft."""
    return Skipped("shaft", f"a drive that takes a {config.drive.takes}: its inertia alone is told")


def excites_shaft(config: RunConfig) -> bool:
    """Whether a run is the step ``shaft``, by its configuration."""
    law: Any = config.controller
    return (
        law.kind == "identify"
        and config.drive.takes == "voltage"
        and len(law.q) > len(REVERSALS)
        and not law.passes
    )


def _fastest(config: RunConfig) -> float:
    """Change of the current in a tick [A] that the guard lets pass, with room."""
    u_i = config.drive_k_t if config.drive.takes == "torque" else 1.0
    return 0.9 * config.command.step / u_i


def own_sensors(config: RunConfig, motor: MotorTable) -> Step:
    """:func:`sensors` of a drive with a current loop of its own: no current is asked for."""
    table = _rows((0, 0, -1, 0, 0.3)) | _torque(config, motor)
    return Step("sensors", "no current; the shaft stays where it is", table, 0.3)


def own_standstill(config: RunConfig, motor: MotorTable) -> Step | Skipped:
    """Short pulses of q current that leave no speed: the lag of the drive's loop, and the delay."""
    T, g = 1.0 / config.loop.rate_hz, 1.5 * motor.n_p * motor.psi_f_wb / motor.J_kg_m2
    short = max(0.005, 4 * T)
    i = min(CURRENT_SHARE * config.limits.i_max_a, 0.1 * top_speed(config, motor) / (g * short))
    slew, never = _fastest(config) / T, 2.0 * config.limits.w_max_rad_s
    rows = []
    for share in (1.0, -1.0, 0.7, -0.5):
        rows += [(s * share * i, 0, s * share * never, slew, n * short) for s, n in ((1, 1), (-1, 2), (1, 1))]
        rows += [(0, 0, -1, slew, 8 * short)]
    words = f"short pulses of current up to {i:.3g} A; the shaft trembles"
    return Step("standstill", words, _rows(*rows) | _torque(config, motor), 4 * 12 * short + 0.1)


def own_spinning(config: RunConfig, motor: MotorTable) -> Step | Skipped:
    """:func:`spinning`, at whose end no step is faster than the guard lets pass."""
    step = spinning(config, motor)
    assert isinstance(step, Step)  # noqa: S101 - what it skips is decided before
    slew = step.controller["slew_a_s"][0]
    most = _fastest(config) * config.loop.rate_hz
    brake = min(step.controller["i_brake_a"], _fastest(config))
    table = step.controller | {"slew_a_s": [min(slew, most), most], "i_brake_a": brake}
    return Step(step.name, step.words, table, step.seconds)


def own_inertia(config: RunConfig, motor: MotorTable) -> Step | Skipped:
    """:func:`inertia` with pulses at speed, that tell lag and delay by the speed alone."""
    w, most = top_speed(config, motor), CURRENT_SHARE * config.limits.i_max_a
    k_t = 1.5 * motor.n_p * motor.psi_f_wb
    i = min(max(motor.J_kg_m2 * w / (0.3 * k_t), 0.2 * most), most)
    slew, short = _fastest(config) * config.loop.rate_hz, max(0.01, 8.0 / config.loop.rate_hz)
    never = 2.0 * config.limits.w_max_rad_s
    rows: list[tuple[float, float, float, float, float]] = []
    for share in (1.0, -1.0, 0.6, -0.6):
        q, way = share * i, math.copysign(1.0, share)
        rows.append((q, 0, way * w, slew, 1.5))
        rows += [(s * q, 0, s * way * never, slew, n * short) for s, n in ((-0.8, 1), (0.8, 1), (-0.8, 2))]
        rows.append((0, 0, 0.15 * w, slew, 0.7))
    brake = min(0.5 * i, _fastest(config))
    words = f"run-up to {w:.3g} rad/s and run-down, in both directions, with up to {i:.3g} A"
    table = _rows(*rows) | _torque(config, motor) | {"i_brake_a": brake}
    return Step("inertia", words, table, 4 * (2.2 + 4 * short) + 1.5)


Maker = Callable[[RunConfig, MotorTable], Step | Skipped]
MAKE: Final[dict[str, Maker]] = {
    "sensors": sensors,
    "standstill": standstill,
    "spinning": spinning,
    "inertia": inertia,
    "shaft": shaft,
}
OWN_LOOP: Final[dict[str, Maker]] = {
    "sensors": own_sensors,
    "standstill": own_standstill,
    "spinning": own_spinning,
    "inertia": own_inertia,
    "shaft": own_shaft,
}
"""The same of a drive that takes a current or a torque."""


def make(name: str, config: RunConfig, motor: MotorTable) -> Step | Skipped:
    """A step with what is believed of the motor so far; Skipped when a limit does not allow it."""
    limits, w = config.limits, top_speed(config, motor)
    continuous = limits.i_continuous_a
    if name in ("spinning", "inertia", "shaft") and w < 20.0 * _still(config):
        return Skipped(name, f"limits allow {w:.3g} rad/s, too slow to tell from noise: w_max_rad_s, u_max_v")
    if name in ("inertia", "shaft") and continuous and limits.i2t_max_a2s:
        excess = (CURRENT_SHARE * limits.i_max_a) ** 2 - continuous**2
        if 6.0 * excess > limits.i2t_max_a2s:
            return Skipped(name, f"i2t_max_a2s = {limits.i2t_max_a2s:g} allows no run-up of 6 s")
    return (MAKE if config.drive.takes == "voltage" else OWN_LOOP)[name](config, motor)


def _still(config: RunConfig) -> float:
    return 1e-3 * config.limits.w_max_rad_s


def config_of(config: RunConfig, step: Step, motor: MotorTable, log_name: str) -> RunConfig:
    """The run of a step. Its currents and speed are no reference's, so what judges those is left out:

    following_error_rad_s, and where i_d is driven i_d_max_a and open_phase_min_a. All other limits stay.
    """
    own_loop = config.drive.takes != "voltage"
    if config.feedback_every > 1:
        raise HilError(
            "feedback.period_ms: hil identify needs a measurement in each tick; lower loop.rate_hz to their "
            "rate for it (--set), or let the drive send more often"
        )
    turns = step.controller.get("passes", 0.0) == 0.0
    w_run = top_speed(config, motor) if turns else 1e-3
    adapter: Any = TypeAdapter(ControllerTable)
    controller = adapter.validate_python({"kind": "identify", "w_run_rad_s": w_run, **step.controller})
    D = 15e3 / config.loop.rate_hz  # ms: 15 ticks
    longer = D + order_of(inner_loop(config)) * 1e3 / config.loop.rate_hz
    window = {"kind": "ftdob", "gamma_1_rad_s": 300.0 / D, "gamma_2_rad_s": 700.0 / D, "delay_ms": longer}
    observer = {"speed": window} if own_loop else {"speed": window, "current": window}
    dropped: dict[str, Any] = {"following_error_rad_s": None}
    if not turns:
        dropped |= {"i_d_max_a": None, "open_phase_min_a": None}
    changes = {
        "motor": motor,
        "controller": controller,
        "observer": ObserverTable.model_validate(observer),
        "limits": config.limits.model_copy(update=dropped),
        "reference": StepReference(kind="step", w_rad_s=w_run),
        "loop": config.loop.model_copy(update={"duration_s": step.seconds + 0.2, "shadow": False}),
        "log": config.log.model_copy(update={"name": log_name}),
        "stop": config.stop.model_copy(update={"ramp_rad_s2": None}),
    }
    return config.model_copy(update=changes)
