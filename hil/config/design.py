"""From a run configuration to the records that the kernel runs on."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from hil.config.limits import LimitsTable
from hil.config.motor import MotorTable
from hil.config.reference import ReferenceTable
from hil.config.setpoint_design import setpoint_params
from hil.config.tables import RunConfig
from hil.control.cogging import Harmonics
from hil.control.errors import ControlDesignError
from hil.control.jit import COMPILED, entry, place_of
from hil.control.law import ChannelSpec, LawSpec, MotorModel, design_law, new_law_state
from hil.control.references import move, reference
from hil.control.regen import RegenLimit
from hil.control.registry import InnerLoop, Shaft, SpeedFilter
from hil.control.speedfilter import MOST_AVERAGE
from hil.log.named import to_named
from hil.signals import TickArray, new_ticks
from hil.tick.guard import MEASURED, MOST_MESSAGES, NO_ANGLE, NO_I_D, NO_I_Q, SAFETY_PARAMS
from hil.tick.kernel import PLACED, new_safety_state, step, whole, whole_at
from hil.tick.setpoint import new_setpoint_state, no_setpoint, prepare

CYCLIC_ECHO_LAG = 3
"""Commands by which the echo of a drive that sends by its own clock may be behind."""
NO_CYCLE_S = 1.0
"""Age that a slow message may reach when neither DBC nor configuration say how often it comes [s]."""
NEVER = SHADOW_WAITS = 2**62
"""Ticks for which a shadow run waits until somebody else enables the drive: for ever."""

Record = npt.NDArray[np.void]


@dataclass(frozen=True, slots=True)
class SlowMessage:
    """A message that the drive sends besides its measurements: its parts, and its cycle, 0 where not known.

    ``cycle_s`` is in seconds, or for a drive that is paced by SYNC ``cycle_syncs`` in SYNCs.
    """

    name: str
    parts: tuple[str, ...]
    cycle_s: float = 0.0
    cycle_syncs: float = 0.0

    def cycle_ticks(self, rate_hz: float) -> float:
        """Its cycle in periods of the loop."""
        return self.cycle_syncs or self.cycle_s * rate_hz


@dataclass(frozen=True, slots=True)
class WireFacts:
    """What the kernel must know of the wire: command resolution [V, N m], counter, measurement LSBs.

    ``slow``: the slow messages in the order of their bits in ``missing``; ``measured``: parts that come with
    each measurement. Both are empty in logs that lack them.
    """

    u_lsb: float
    T_L_lsb: float
    counter_modulus: int
    x_lsb: tuple[float, float, float]
    u_top: float
    T_L_top: float = math.inf
    slow: tuple[SlowMessage, ...] = ()
    measured: tuple[str, ...] = ()
    theta_span: float = 0.0
    """Of the angle's counter until it begins anew [rad], where that is no whole number of turns; else 0."""

    @property
    def absent(self) -> int:
        """Currents that the drive does not report; a log that lacks ``measured`` is of one that does."""
        absent = (NO_I_Q if "i_q" not in self.measured else 0) | (NO_I_D if "i_d" not in self.measured else 0)
        return absent if self.measured else 0


@dataclass(frozen=True, slots=True)
class Machine:
    """Parameters and states of one controller; :meth:`step` runs a tick in place."""

    safety: Record
    safety_state: Record
    law: Record
    law_state: Record
    reference: Record
    setpoint: Record = field(default_factory=no_setpoint)
    setpoint_state: Record = field(default_factory=new_setpoint_state)

    def prepare(self, ticks: TickArray) -> None:
        """Write this tick's reference."""
        prepare(self.reference, self.setpoint, self.setpoint_state, self.safety_state, self.law, ticks)

    def step(self, ticks: TickArray) -> None:
        """Run one tick."""
        step(self.safety, self.safety_state, self.law, self.law_state, ticks)

    def looped(self) -> Callable[[TickArray], None]:
        """:meth:`prepare` and :meth:`step` as one compiled call, for a loop's tick."""
        if not COMPILED:
            return partial(whole, *self._records())
        other = self.fresh()
        call = partial(entry(whole_at, other.places(), new_ticks()), self.places())
        call.__dict__["alive"] = self  # the places are of its records
        return call

    def _records(self) -> tuple[Record, ...]:
        setpoint = self.setpoint, self.setpoint_state
        return self.reference, *setpoint, self.safety, self.safety_state, self.law, self.law_state

    def places(self) -> npt.NDArray[np.int64]:
        """Where its records are, for :func:`hil.tick.kernel.whole_at`; it must outlive their use."""
        rows = zip(self._records(), PLACED, strict=True)
        return np.array([place_of(record, dtype) for record, dtype in rows], np.int64)

    def fresh(self) -> Machine:
        """The same controller before its first tick."""
        states = {
            "safety_state": new_safety_state(),
            "law_state": new_law_state(),
            "setpoint_state": new_setpoint_state(),
        }
        return replace(self, **states)

    def at_once(self) -> Machine:
        """The same controller, whose stops are without a ramp."""
        setpoint = self.setpoint.copy()
        setpoint["stop_ticks"] = 0
        return replace(self, setpoint=setpoint)

    def to_json(self) -> str:
        """The parameters by name, exact to the bit: a design's exponentials differ between processors."""
        records = {"safety": self.safety, "law": self.law, "reference": self.reference}
        return json.dumps({name: to_named(record) for name, record in records.items()})

    def warm_up(self) -> None:
        """Compile every kernel on copies, before anything is armed."""
        other, ticks = self.fresh(), new_ticks()
        other.prepare(ticks)
        other.step(ticks)


def motor_model(table: MotorTable) -> MotorModel:
    """The motor that the controller believes in."""
    return MotorModel(
        table.R_s_ohm, table.L_d_h, table.L_q_h, table.psi_f_wb, table.n_p, table.J_kg_m2, table.B_f_n_m_s
    )


def _values(table: Any) -> dict[str, Any]:
    """The keys of a law's or an observer's table, without what every one has."""
    keys: dict[str, Any] = table.model_dump(
        exclude={"kind", "compensate_coupling", "anticogging", "known_load"}
    )
    return keys


def speed_filter(given: Any, rate_hz: int) -> SpeedFilter | None:
    """What a table ``speed_filter`` means; None for nothing. Raises ControlDesignError.

    A mean that the observer is to know is one over whole periods; any other is taken for the nearest.
    """
    if given.kind == "first-order":
        return SpeedFilter((given.pole_rad_s,))
    if given.kind == "pll":
        return SpeedFilter((given.pole_1_rad_s, given.pole_2_rad_s))
    if given.kind == "none":
        return None
    periods = given.window_ms * 1e-3 * rate_hz
    if periods > MOST_AVERAGE + 0.5:
        raise ControlDesignError(
            f"drive.speed_filter.window_ms = {given.window_ms:g}: {periods:g} periods, and {MOST_AVERAGE} "
            "are kept at most; lower loop.rate_hz, or set a shorter window in the drive"
        )
    known = getattr(given, "modelled", False)
    if known and (round(periods) < 1 or abs(periods - round(periods)) > 1e-6 * periods):
        raise ControlDesignError(
            f"drive.speed_filter.window_ms = {given.window_ms:g}: no whole number of periods at {rate_hz} "
            "Hz; change loop.rate_hz, or the drive's window"
        )
    return SpeedFilter(ticks=round(periods)) if round(periods) else None


def inner_loop(config: RunConfig, told: bool = True) -> InnerLoop | None:
    """What the drive makes of a command; None for voltages. ``told``: it reports i_q.

    A torque is made a current by the drive's own constant: k_u is the motor's over the drive's.
    """
    drive = config.drive
    if drive.takes == "voltage":
        return None
    u_i = config.drive_k_t if drive.takes == "torque" else 1.0
    given = speed_filter(drive.speed_filter, config.loop.rate_hz)
    known = given if getattr(drive.speed_filter, "modelled", False) else None
    lag, every = drive.current_lag_ms * 1e-3, config.feedback_every
    shaft = elastic_shaft(config.motor)
    return InnerLoop(config.k_t / u_i, u_i, lag, drive.delay_ticks, told, known, every, shaft)


def elastic_shaft(motor: MotorTable) -> Shaft | None:
    """The shaft that the observer is to know."""
    given = motor.shaft
    if given is None:
        return None
    return Shaft(2.0 * math.pi * given.resonance_hz, given.damping_ratio, 1.0 / (1.0 + given.inertia_ratio))


ANGLE_JUMP = 0.5
"""What the measured angle may lately have moved by that the speed does not tell [rad]."""
OTHER_MOTOR = 0.1
"""Share by which the torque constant of a file's motor may be off, as its identification may be."""


def known_cogging(config: RunConfig) -> Harmonics | None:
    """The load torque over the angle that is to be compensated. Raises ControlDesignError."""
    given = config.controller.anticogging
    if given is None:
        return None
    motor, where = config.motor, "controller.anticogging"
    _follows_speed(config, where)
    named = given.motor and motor.name and given.motor != motor.name
    if named or given.n_p != motor.n_p or abs(given.k_t_n_m_a / config.k_t - 1.0) > OTHER_MOTOR:
        raise ControlDesignError(
            f"{where}: learned of a motor {given.motor!r} with n_p = {given.n_p}, "
            f"k_t = {given.k_t_n_m_a:.4g} N m/A; the configuration's is {motor.name!r} with "
            f"{motor.n_p}, {config.k_t:.4g}; learn it of this one"
        )
    most = min(config.k_t * config.limits.i_max_a, config.limits.torque_max_n_m or math.inf)
    if given.known.peak > most:
        raise ControlDesignError(
            f"{where}: its peak is {given.known.peak:.4g} N m, the limits allow {most:.4g} N m "
            f"(i_max_a, torque_max_n_m); learn it anew, or take it out"
        )
    known: Harmonics = given.known
    _each_tick(config, where)
    return known


def _follows_speed(config: RunConfig, where: str) -> None:
    """Refuse a load that is known beforehand where the law gives the torque that it is commanded."""
    if not config.follows_speed:
        raise ControlDesignError(
            f"{where}: the law {config.controller.kind} follows no speed, and gives what it is "
            "commanded; leave the key out"
        )


def _each_tick(config: RunConfig, where: str) -> None:
    """Refuse what goes by the angle where that is not measured in each tick."""
    inner = inner_loop(config)
    if inner is not None and inner.every > 1:
        raise ControlDesignError(f"{where}: needs the angle in each tick; leave it or feedback.period_ms out")


def known_over_angle(config: RunConfig) -> Harmonics | None:
    """What is known over the angle in all: cogging, and a weight's torque. Raises ControlDesignError."""
    cogging, weight = known_cogging(config), known_weight(config)
    if cogging is None or weight is None:
        return weight if cogging is None else cogging
    if 1 in cogging.orders:
        raise ControlDesignError(
            "controller.known_load.gravity_n_m: the table of controller.anticogging has order 1, in which "
            "the weight's torque is already; leave gravity_n_m out"
        )
    return Harmonics((*weight.orders, *cogging.orders), (*weight.a, *cogging.a), (*weight.b, *cogging.b))


def known_weight(config: RunConfig) -> Harmonics | None:
    """The torque of a weight over the angle. Raises ControlDesignError for a known load that can not be."""
    given, where = config.controller.known_load, "controller.known_load"
    if given is None:
        return None
    _follows_speed(config, where)
    most = min(config.k_t * config.limits.i_max_a, config.limits.torque_max_n_m or math.inf)
    w = config.limits.w_max_rad_s
    for key, peak, at in (
        ("quadratic_n_m_s2", given.quadratic_n_m_s2 * w * w, f" at limits.w_max_rad_s = {w:g}"),
        ("gravity_n_m", given.gravity_n_m, ""),
    ):
        if peak > most:
            raise ControlDesignError(
                f"{where}.{key}: {peak:.4g} N m{at}, the limits allow {most:.4g} N m (i_max_a, "
                "torque_max_n_m); "
                "is it in N m?"
            )
    if not given.gravity_n_m:
        return None
    _each_tick(config, f"{where}.gravity_n_m")
    weight: Harmonics = given.over_angle
    return weight


def by_angle(config: RunConfig) -> str:
    """The key of what needs the shaft's angle; empty where nothing does."""
    controller = config.controller
    if config.follows_angle:
        return "controller.kind position"
    if controller.anticogging is not None:
        return "controller.anticogging"
    known = controller.known_load
    return "controller.known_load.gravity_n_m" if known is not None and known.gravity_n_m else ""


def regen_limit(limits: LimitsTable) -> RegenLimit | None:
    """What may go back to the DC link."""
    if limits.p_regen_max_w is None:
        return None
    ends = (limits.v_dc_regen_from_v or math.inf, limits.v_dc_regen_max_v or math.inf)
    return RegenLimit(limits.p_regen_max_w, *ends)


def law_spec(config: RunConfig, told: bool = True) -> LawSpec:
    """The law's tuning. Raises ControlDesignError only when designed. ``told``: the drive reports i_q."""
    controller, observer = config.controller, config.observer
    current = observer.speed if observer.current is None else observer.current
    return LawSpec(
        kind=controller.kind,
        motor=motor_model(config.motor),
        speed=ChannelSpec(observer.speed.kind, more=_values(observer.speed)),
        current=ChannelSpec(current.kind, more=_values(current)),
        inner=inner_loop(config, told),
        i_max=config.limits.i_max_a,
        T_L_max=config.limits.T_L_max_n_m,
        coupling=controller.compensate_coupling,
        cogging=known_over_angle(config),
        k_w2=controller.known_load.quadratic_n_m_s2 if controller.known_load else 0.0,
        shaft=elastic_shaft(config.motor) if config.drive.takes == "voltage" else None,
        regen=regen_limit(config.limits),
        more=_values(controller),
    )


def safety_params(config: RunConfig, wire: WireFacts) -> Record:
    """Limits and times as the guard and the supervisor use them."""
    limits, feedback = config.limits, config.feedback
    rate = config.loop.rate_hz
    p = np.zeros(1, SAFETY_PARAMS)
    values: dict[str, float] = {
        "T_s": 1.0 / rate,
        "w_max": limits.w_max_rad_s,
        "i_trip": limits.i_trip_a,
        "u_max": min(config.command.most, wire.u_top),
        "du_max": config.command.step,
        "T_L_max": min(limits.T_L_max_n_m, wire.T_L_top),
        "v_dc_min": limits.v_dc_min_v,
        "v_dc_max": limits.v_dc_max_v,
        "temperature_max": limits.temperature_max_c,
        "power_window": limits.power_window_s,
        "trip_ticks": limits.trip_ticks,
        "guard_trip_ticks": limits.guard_trip_ticks,
        "soft_start_ticks": round(limits.soft_start_s * rate),
        "hold_ticks": feedback.hold_ticks,
        "quick_stop_ticks": feedback.quick_stop_ticks,
        "error_budget": feedback.error_budget,
        "enable_ticks": SHADOW_WAITS if config.loop.shadow else round(feedback.enable_timeout_s * rate),
        "shadow": config.loop.shadow,
        "max_gap": config.loop.max_gap_ticks,
        "echo_lag": 0 if config.loop.pacing == "sync" else CYCLIC_ECHO_LAG,
        "frozen_ticks": feedback.frozen_ticks,
        "w_error_ticks": max(1, round(limits.following_error_s * rate)),
        "repeat_ticks": feedback.repeat_ticks or NEVER,
        "frozen_du": frozen_voltage(config, wire),
        "counter_modulus": wire.counter_modulus,
        "u_lsb": wire.u_lsb,
        "T_L_lsb": wire.T_L_lsb,
        "J": config.motor.J_kg_m2,
    }
    for name, value in (values | _optional(limits)).items():
        p[name] = value
    _slow_messages(p, config, wire)
    if inner := inner_loop(config):
        p["k_u"], p["u_i"], p["absent"] = inner.k_u, inner.u_i, wire.absent
        p["scheduled"] = inner.every - 1
    p["absent"] |= 0 if "angle" in wire.measured else NO_ANGLE
    p["theta_jump"] = ANGLE_JUMP if config.follows_angle else 0.0
    if config.loop.shadow:  # command and reference are somebody else's, not ours
        for name in ("deviation_max", "w_error_max", "theta_error_max", "i_d_max", "open_phase_min"):
            p[name] = math.inf
    return p


def age_limit(config: RunConfig, message: SlowMessage) -> int:
    """Age that a slow message may reach [periods]: as configured, else five cycles and what is ridden out.

    Without a cycle time in the DBC it is NO_CYCLE_S.
    """
    rate, given = config.loop.rate_hz, config.feedback.status_timeout_s
    if given is not None:
        return max(1, round(given * rate))
    cycle = message.cycle_ticks(rate)
    if cycle <= 0.0:
        return round(NO_CYCLE_S * rate)
    return math.ceil(5.0 * cycle) + config.feedback.hold_ticks + config.loop.max_gap_ticks


def _slow_messages(p: Record, config: RunConfig, wire: WireFacts) -> None:
    """Ages, and which message carries what may be NaN; logs without these facts keep their old rules."""
    p["rules"], p["messages"] = 1, min(len(wire.slow), MOST_MESSAGES)
    for index, message in enumerate(wire.slow[:MOST_MESSAGES]):
        p["age_max"][0, index] = age_limit(config, message)
    for row, part in enumerate(("v_dc", "temperature_motor", "temperature_inverter")):
        bits = [1 << index for index, message in enumerate(wire.slow) if part in message.parts]
        p["carried_by"][0, row] = MEASURED if part in wire.measured else sum(bits)


def frozen_voltage(config: RunConfig, wire: WireFacts) -> float:
    """Change of voltage [V] that moves a current by 20 steps of the wire within a tick: 20 LSB L / T_s.

    Of a drive with a current loop: what moves i_q by that, or the speed where it does not report i_q.
    """
    motor, steps = config.motor, 20.0
    if inner := inner_loop(config):
        speed = motor.J_kg_m2 * wire.x_lsb[0] * config.loop.rate_hz / inner.k_u
        return max(steps * (speed if wire.absent & NO_I_Q else wire.x_lsb[1] * inner.u_i), 10.0 * wire.u_lsb)
    lsb = max(motor.L_q_h * wire.x_lsb[1], motor.L_d_h * wire.x_lsb[2])
    return max(steps * lsb * config.loop.rate_hz, 10.0 * wire.u_lsb)


def _optional(limits: LimitsTable) -> dict[str, float]:
    """Limits that a config may leave out: then they never trip."""

    def or_never(value: float | None) -> float:
        return math.inf if value is None else value

    return {
        "i_continuous": limits.i_continuous_a or limits.i_max_a,
        "i2t_max": or_never(limits.i2t_max_a2s),
        "energy_max": or_never(limits.energy_max_j),
        "i_d_max": or_never(limits.i_d_max_a),
        "open_phase_min": or_never(limits.open_phase_min_a),
        "w_error_max": or_never(limits.following_error_rad_s),
        "theta_error_max": or_never(limits.following_error_rad),
        "deviation_max": or_never(limits.applied_deviation_max_v),
    }


def reference_record(table: ReferenceTable) -> Record:
    """The reference profile of the config."""
    if table.kind == "move":
        jerk = table.jerk_rad_s3 or math.inf
        return move(table.way, table.w_rad_s, table.rate_rad_s2, jerk, table.at_s)
    given = table.model_dump(exclude={"kind", "t_s"}, exclude_none=True)
    names = {
        "w_rad_s": "w",
        "amplitude_rad_s": "w",
        "at_s": "at",
        "down_at_s": "down_at",
        "rate_rad_s2": "rate",
        "jerk_rad_s3": "jerk",
        "offset_rad_s": "offset",
        "frequency_hz": "frequency",
        "i_q_a": "i_q",
    }
    if table.kind == "table":
        return reference("table", i_q=table.i_q_a, table=(table.t_s, table.w_rad_s))
    return reference(table.kind, **{names[key]: value for key, value in given.items()})


def build(config: RunConfig, wire: WireFacts) -> Machine:
    """Design the controller of a run. Raises ControlDesignError."""
    told = not wire.absent & NO_I_Q
    if (key := by_angle(config)) and "angle" not in wire.measured:
        remedy = 'take "speed"' if config.follows_angle else "leave this out"
        raise ControlDesignError(
            f"{key}: the drive reports no angle; name it in drive.signals.angle, or {remedy}"
        )
    law = design_law(law_spec(config, told), 1.0 / config.loop.rate_hz)
    if config.follows_angle:
        _each_tick(config, key)
        law["theta_span"] = wire.theta_span
    return Machine(
        safety_params(config, wire),
        new_safety_state(),
        law,
        new_law_state(),
        reference_record(config.reference),
        setpoint_params(config),
        new_setpoint_state(),
    )
