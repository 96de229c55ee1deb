"""The bench of a configuration: believed motor, load step, and the noise that its drive and frames have."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.config.design import elastic_shaft, law_spec, motor_model, speed_filter
from hil.control.law import CASCADE, FAC, MTPA, PI, SPEED, LawSpec, MotorModel
from hil.errors import HilError
from hil.report.metrics import RECOVERED_RAD_S, find_step, operating
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import Reason, TickArray
from hil.sim.emulate import load_plant
from hil.sim.simulate import simulate_ticks
from hil.tuning.current import Regulator
from hil.tuning.measure import Bench

LATEST: Final = 4.0
"""Deviations of its arrival after which a measurement counts as there: one of 30,000 comes later."""
QUIET_S: Final = 0.5
"""Time before the load step in which the noise of the command is measured."""
LEAST_DAMPING: Final = 0.2
"""Of an interval of the damping that reaches to 0 so much of the value is the lower end."""
UNTOLD: Final = dict.fromkeys(("J", "psi_f", "R_s", "L"), 0.3)
"""Spread where none is given."""


def speed_drive(path: Path, overrides: Overrides) -> Setup:
    """The setup of a drive under speed control. Raises HilError for any other law, or a bus unlike it."""
    setup = load_setup(path, overrides)
    code, kind = int(setup.machine.law["kind"][0]), setup.config.controller.kind
    if code == FAC:
        raise HilError(f"{path}: controller.kind fac commands the load; only speed drives can be tuned")
    if kind == "torque":
        raise HilError(f"{path}: controller.kind torque follows no speed; only speed drives can be tuned")
    if code == MTPA:
        raise HilError(
            f"{path}: controller.kind mtpa: tune it as cascade, whose poles it has, and put them in"
        )
    check_facts(setup)
    if code not in (CASCADE, PI, SPEED) or setup.machine.law["rows"][0]:
        raise HilError(f"{path}: controller.kind {kind} is no speed control; only that can be tuned")
    return setup


def check_facts(setup: Setup) -> None:
    """Refuse a bus that was identified as another than the laws predict. Raises HilError."""
    known, acts_after = setup.config.motor.identified, 1 + setup.config.drive.delay_ticks
    if known is not None and known.delay_ticks not in (None, acts_after):
        raise HilError(
            f"{setup.path}: the bus delays by {known.delay_ticks} ticks; the laws predict {acts_after}: a "
            "lower loop.rate_hz, or drive.delay_ticks of a drive with its own current loop"
        )
    if known is not None and known.echo_lag_ticks:
        raise HilError(
            f"{setup.path}: the drive's echo is off by {known.echo_lag_ticks} ticks, and the observer goes "
            "by it: leave drive.signals.echo out, then it goes by what was sent"
        )


def findings_of(setup: Setup) -> list[str]:
    """What the facts of the bus say of the configuration."""
    known, loop = setup.config.motor.identified, setup.config.loop
    if known is None or known.arrival_ms is None or known.arrival_jitter_ms is None or loop.pacing != "sync":
        return []
    latest = known.arrival_ms + LATEST * known.arrival_jitter_ms
    if latest * 1e6 <= loop.timeout_ns:
        return []
    return [
        f"measurements come up to {latest:.3g} ms after the deadline (jitter {known.arrival_jitter_ms:.3g}), "
        f"later than loop.feedback_timeout_us = {loop.timeout_ns * 1e-3:.0f}: the design has one in each tick"
    ]


def lsb_of(setup: Setup) -> tuple[float, float, float]:
    """Resolution of w [rad/s], i_q, i_d [A]: the frames', or a coarser one that was identified."""
    known, (w, i_q, i_d) = setup.config.motor.identified, setup.wire.x_lsb
    if known is None:
        return w, i_q, i_d
    return (
        max(w, known.w_lsb_rad_s or 0.0),
        max(i_q, known.i_q_lsb_a or 0.0),
        max(i_d, known.i_d_lsb_a or 0.0),
    )


def noise_of(setup: Setup, sensors: tuple[float, float], given: dict[str, float]) -> list[float]:
    """Deviations of w [rad/s], i_q, i_d [A], resolution included: as given, as identified, or the plant's."""
    known, out = setup.config.motor.identified, []
    told = (
        (None, None, None, None)
        if known is None
        else (known.w_noise_rad_s, known.i_q_noise_a, known.i_d_noise_a, known.i_noise_a)
    )
    rows = (("w_noise", sensors[0], told[0]), *(("i_noise", sensors[1], own or told[3]) for own in told[1:3]))
    for (name, plants, identified), lsb in zip(rows, lsb_of(setup), strict=True):
        least = lsb / math.sqrt(12)
        if name in given or identified is None:
            out.append(math.hypot(given.get(name, plants), least))
        else:
            out.append(max(identified, least))
    return out


def spec_in(setup: Setup) -> LawSpec:
    """The law's tuning as the run has it: with what the drive reports. Raises ControlDesignError."""
    return law_spec(setup.config, bool(setup.machine.law["told"][0]))


def takes_voltage(setup: Setup) -> bool:
    """False for a drive with a current loop of its own."""
    return setup.config.drive.takes == "voltage"


def bench_of(path: Path, setup: Setup, given: dict[str, float | None] | None = None, **more: Any) -> Bench:
    """The bench of a config; ``given`` replaces load [N m], w_noise [rad/s], i_noise [A] of the plant's file.

    An identified motor brings its own noise, resolution included. Else the resolution of frames and modulator
    counts as noise of q / sqrt(12). A soft coupling that was identified, else that of the plant's file, is
    the elastic shaft where none is given, and without one that which the observer knows. Raises HilError.
    """
    sensors, load, u_lsb, brake = (0.0, 0.0), None, 0.0, False
    known = identified_shafts(setup)
    if setup.config.emulator is not None:
        plant, _ = load_plant(path, setup.config)
        sensors = plant.sensors.w_noise_rad_s, plant.sensors.i_noise_a
        steps = [(abs(one.torque_n_m), one.kind) for one in plant.load if one.kind in ("step", "brake")]
        (load, kind), u_lsb = max(steps, default=(None, "")), plant.inverter.resolution_v
        brake = kind == "brake"
        if plant.coupling is not None and not more.get("shafts"):
            known = known or (_elastic(plant.masses),)
        if not takes_voltage(setup):
            more |= {"regulator": _regulator(plant.firmware, setup.config.loop.rate_hz)}
    if known and not more.get("shafts"):
        more |= {"shafts": known, "elastic": takes_voltage(setup)}
    if (given_shaft := elastic_shaft(setup.config.motor)) is not None:
        more |= {} if more.get("shafts") else {"shafts": (given_shaft.elastic,)}
        more |= {"known": given_shaft.elastic, "elastic": True} if takes_voltage(setup) else {}
    own = {name: value for name, value in (given or {}).items() if value is not None}
    more |= {} if takes_voltage(setup) else _own_loop(setup, more.get("spread", UNTOLD))
    motor, (w_noise, i_q_noise, i_d_noise) = motor_model(setup.config.motor), noise_of(setup, sensors, own)
    load = own.get("load", load)
    if load is None:
        load = 0.1 * motor.k_t * setup.config.limits.i_max_a
    return Bench(
        motor,
        1.0 / setup.config.loop.rate_hz,
        load,
        w_noise,
        i_q_noise,
        max(u_lsb, setup.wire.u_lsb) / math.sqrt(12) if takes_voltage(setup) else 0.0,
        _speed(setup),
        brake=brake,
        i_d_noise=i_d_noise,
        i_d_lsb=lsb_of(setup)[2],
        **more,
    )


def identified_shafts(setup: Setup) -> tuple[tuple[float, float, float], ...]:
    """The coupling that was identified, the corners of its intervals at the least damping; () for none."""
    known = setup.config.motor.identified
    if known is None or not (known.resonance_hz and known.resonance_damping and known.inertia_ratio):
        return ()
    hz, damping, ratio = known.resonance_hz, known.resonance_damping, known.inertia_ratio
    lows, highs = ({"resonance_hz": hz, "inertia_ratio": ratio} | ends for ends in (known.low, known.high))
    least = max(known.low.get("resonance_damping", damping), LEAST_DAMPING * damping)
    corners = [
        (min(low, 0.99 * value), max(high, 1.01 * value))
        for low, high, value in (
            (lows[key], highs[key], value) for key, value in (("resonance_hz", hz), ("inertia_ratio", ratio))
        )
    ]
    ends = [(f, least, 1.0 / (1.0 + r)) for f in corners[0] for r in corners[1]]
    return ((hz, damping, 1.0 / (1.0 + ratio)), *ends)


def _elastic(shaft: Any) -> tuple[float, float, float]:
    """Resonance [Hz], damping ratio d w_r / 2c, and the motor's share of J, of a plant's masses."""
    w_r = shaft.resonance_rad_s
    return w_r / (2.0 * math.pi), 0.5 * shaft.d * w_r / shaft.c, shaft.J_m / (shaft.J_m + shaft.J_l)


def _regulator(firmware: Any, rate_hz: float) -> Regulator | None:
    """The current loop of an emulated drive; None where a tick is no whole number of its samples."""
    period = firmware.current_period_us / 1e6
    count = 1.0 / (rate_hz * period)
    whole = count > 0.5 and abs(count - round(count)) < 1e-9 * count
    return Regulator(period, firmware.current_loop_rad_s) if whole else None


def _own_loop(setup: Setup, spread: dict[str, float]) -> dict[str, Any]:
    """What a drive's own current loop adds to the bench; R_s and L stay behind it.

    The observer knows how a command was rounded: that is no noise to it.
    """
    config, angle = setup.config, setup.binding.signal("angle")
    return {
        "inner": spec_in(setup).inner,
        "filter": speed_filter(config.drive.speed_filter, config.loop.rate_hz),
        "unit": config.command.unit,
        "theta_noise": angle.step / math.sqrt(12.0) if config.follows_angle and angle else None,
        "spread": {name: spread.get(name, 0.0) for name in ("J", "psi_f")},
    }


def _speed(setup: Setup) -> float:
    """The speed that the reference goes to [rad/s]."""
    reference = setup.config.reference
    if reference.kind == "table":
        return float(reference.w_rad_s[-1])
    return abs(reference.offset_rad_s if reference.kind == "sine" else reference.w_rad_s)


@dataclass(frozen=True, slots=True)
class Seen:
    """A load step in a simulated run: dip [rad/s], recovery [ms], IAE [rad]; the command's noise before it.

    That is of u_q [V], or of the current or torque that is asked for [A, N m].
    """

    dip: float
    recovery_ms: float
    iae: float
    u_noise: float
    ended: str


def seen_in(ticks: TickArray, T_s: float) -> Seen:
    """Judge a run with a load step. Raises HilError when it has none."""
    row = find_step(operating(ticks))
    own = operating(ticks)
    ended = Reason(int(ticks["reason"][-1])).name.lower()
    if ended != "stop_requested":
        return Seen(math.inf, math.inf, math.inf, math.inf, ended)
    if row is None:
        raise HilError("the plant's file has no load step of 0.5 N m and more; laws are compared by one")
    error = own["w"] - own["w_ref"]
    after = error[row : row + _settled(own, row)]
    outside = np.nonzero(np.abs(after) > RECOVERED_RAD_S)[0]
    recovery = (int(outside[-1]) + 1) * T_s * 1e3 if len(outside) else 0.0
    quiet = own["u_q_law"][max(0, row - round(QUIET_S / T_s)) : row]
    line = np.polyval(np.polyfit(np.arange(len(quiet)), quiet, 1), np.arange(len(quiet)))
    return Seen(
        float(np.abs(after).max()),
        recovery,
        float(np.abs(after).sum() * T_s),
        float(np.std(quiet - line)),
        ended,
    )


def _settled(own: TickArray, row: int) -> int:
    """Ticks after the step until load or reference change again, at most 0.4 s."""
    load = np.abs(np.diff(own["T_L_true"][row:])) > 0.5
    moving = np.abs(own["dw_ref"][row + 1 :]) > 0
    changed = np.nonzero(load | moving)[0]
    period_s = float(np.median(np.diff(own["t_ns"]))) * 1e-9
    return min(round(0.4 / period_s), int(changed[0]) + 1 if len(changed) else len(own) - row)


def plant_settings(bench: Bench) -> list[list[str]]:
    """The believed motor and the corners of the spread, on elastic shafts, as settings of the plant."""
    return [
        [_motor(motor), *coupled(at)]
        for motor, at in zip((bench.motor, *bench.corners()), bench.turns(), strict=True)
    ]


def _motor(m: MotorModel) -> str:
    """A motor as a setting."""
    motor = {"R_s_ohm": m.R_s, "L_d_h": m.L_d, "L_q_h": m.L_q, "psi_f_wb": m.psi_f, "n_p": m.n_p}
    motor |= {"J_kg_m2": m.J, "B_f_n_m_s": m.B_f}
    return f"motor={_inline(motor)}"


def coupled(at: tuple[float, float, float] | None) -> list[str]:
    """An elastic shaft (Hz, damping, motor's share of J) as a setting; none for a rigid one."""
    if at is None:
        return []
    hz, damping, share = at
    keys = {"inertia_ratio": (1.0 - share) / share, "resonance_hz": hz, "damping_ratio": damping}
    return [f"coupling={_inline(keys)}"]


def _inline(keys: dict[str, float]) -> str:
    return "{" + ", ".join(f"{name} = {value!r}" for name, value in keys.items()) + "}"


def simulated(path: Path, overrides: Overrides, plant: list[str]) -> Seen:
    """One run in `hil simulate`."""
    setup = load_setup(path, overrides)
    return seen_in(simulate_ticks(setup, plant), 1.0 / setup.config.loop.rate_hz)
