"""Why runs end: one table of all reasons, with the value that led to it, its limit, and what to do.

``run``, ``simulate``, ``report`` and every JSON speak from it, and ``docs/stop-reasons.md`` is it:

    python -m hil.tick.reasons > docs/stop-reasons.md
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from hil.signals import DriveState, GuardFlag, Reason
from hil.tick.errorcodes import words

ASKED: Final = (Reason.STOP_REQUESTED, Reason.QUICK_STOP_REQUESTED)
Look = Callable[[Any, Any, Any], Any]
"""Of parameters, state (None where it is not known) and the tick of the stop."""


@dataclass(frozen=True, slots=True)
class Cause:
    """A reason: what it means, what was too much of what [unit], the key of the limit, what to do."""

    what: str
    remedy: str
    key: str = ""
    unit: str = ""
    value: Look = lambda p, s, t: None
    limit: Look = lambda p, s, t: None
    detail: Look = lambda p, s, t: ""
    fault: bool = True


@dataclass(frozen=True, slots=True)
class End:
    """How a run ended. ``value`` and ``limit`` are None where there is none; ``t_s``: since tick 0."""

    reason: str
    what: str
    value: float | None
    limit: float | None
    unit: str
    key: str
    t_s: float
    remedy: str
    detail: str = ""

    @property
    def text(self) -> str:
        """One line: what, value, limit, time."""
        parts = [f"{self.what}{self.detail and f' ({self.detail})'}"]
        if self.value is not None:
            parts[0] += f": {self.value:.6g} {self.unit}".rstrip()
        if self.limit is not None:
            named = f"{self.key} = " if self.key else ""
            parts.append(f"limit {named}{self.limit:.6g} {self.unit}".rstrip())
        return ", ".join([*parts, f"at {self.t_s:.3f} s"])

    def as_dict(self) -> dict[str, Any]:
        """JSON form; a number that is not finite is text there."""
        out = {name: getattr(self, name) for name in self.__slots__} | {"text": self.text}
        return {k: v if not isinstance(v, float) or math.isfinite(v) else repr(v) for k, v in out.items()}


def _state(name: str, scale: Look = lambda p, s, t: 1.0) -> Look:
    return lambda p, s, t: None if s is None else abs(float(s[name])) * scale(p, s, t)


def _limit(name: str, scale: Look = lambda p, s, t: 1.0) -> Look:
    return lambda p, s, t: float(p[name]) * scale(p, s, t)


def _period_s(p: Any, s: Any, t: Any) -> float:
    return float(p["T_s"])


def _period_ms(p: Any, s: Any, t: Any) -> float:
    return 1e3 * float(p["T_s"])


def _hold_ms(p: Any, s: Any, t: Any) -> float:
    return (float(p["hold_ticks"]) + float(p["scheduled"])) * _period_ms(p, s, t)


def _hottest(p: Any, s: Any, t: Any) -> float:
    return max((float(t[n]) for n in _TEMPERATURES if math.isfinite(t[n])), default=math.nan)


def _no_numbers(p: Any, s: Any, t: Any) -> str:
    judged = _MEASURED + (("theta",) if p["theta_jump"] > 0.0 else ())  # others follow no angle
    names = [n for n in judged if not math.isfinite(t[n])]
    return ", ".join(f"{name} is {float(t[name])}" for name in names)


def _flags(p: Any, s: Any, t: Any) -> str:
    return ", ".join(f.name.lower().replace("_", " ") for f in GuardFlag if int(t["guard_flags"]) & f)


def _oldest(s: Any, p: Any) -> int:
    """The slow message that is most overdue."""
    rows = range(int(p["messages"]))
    return max(rows, key=lambda i: float(s["age"][i]) - float(p["age_max"][i]), default=0)


def _age(p: Any, s: Any, t: Any) -> float | None:
    return None if s is None else float(s["age"][_oldest(s, p)]) * float(p["T_s"])


def _age_max(p: Any, s: Any, t: Any) -> float | None:
    return None if s is None else float(p["age_max"][_oldest(s, p)]) * float(p["T_s"])


def _never_came(p: Any, s: Any, t: Any) -> str:
    if s is None:
        return ""
    row = _oldest(s, p)
    return f"slow message {row + 1} of the map" + ("" if int(s["came"]) >> row & 1 else ", it never came")


def _drive(p: Any, s: Any, t: Any) -> str:
    state = int(t["drive_state"])
    name = DriveState(state).name if state in tuple(DriveState) else str(state)
    return f"it is in {name}, error {words(int(t['drive_error']))}"


_TEMPERATURES: Final = ("temperature_motor", "temperature_inverter")
_MEASURED: Final = ("w", "i_q", "i_d", "v_dc", *_TEMPERATURES)

CAUSES: Final[dict[Reason, Cause]] = {
    Reason.STOP_REQUESTED: Cause(
        "a stop was asked for: the end of loop.duration_s, Ctrl-C, SIGTERM or the watch page",
        "nothing to do", fault=False),
    Reason.QUICK_STOP_REQUESTED: Cause(
        "a quick stop was asked for: a second Ctrl-C or signal", "nothing to do", fault=False),
    Reason.STALE_FEEDBACK: Cause(
        "no fresh feedback", "look at cable, supply and node id; candump shows whether the drive still sends",
        "feedback.hold_ticks", "ms", _state("stale_at", _period_ms), _hold_ms,
        fault=False),
    Reason.NOT_A_NUMBER: Cause(
        "a measured signal is no number", "look at the drive's sensor, and at the signal's type in the DBC",
        detail=_no_numbers),
    Reason.CRC_ERRORS: Cause(
        "damaged frames",
        "look at termination, shielding and bitrate, and at E2E profile and data ids in the DBC",
        "feedback.error_budget", "frames", lambda p, s, t: None if s is None else float(s["crc_level"]) / 4,
        _limit("error_budget")),
    Reason.COUNTER_ERRORS: Cause(
        "frames repeated, lost or out of order", "look for a second sender, a gateway or an overloaded bus",
        "feedback.error_budget", "frames",
        lambda p, s, t: None if s is None else float(s["counter_level"]) / 4, _limit("error_budget")),
    Reason.OVER_SPEED: Cause(
        "too fast", "lower the reference, or look at load and encoder before the limit is raised",
        "limits.w_max_rad_s", "rad/s", lambda p, s, t: abs(float(t["w"])), _limit("w_max")),
    Reason.OVER_CURRENT: Cause(
        "too much current", "look at encoder offset, motor parameters and load; lower i_max_a or the poles",
        "limits.i_trip_a", "A", lambda p, s, t: math.hypot(t["i_q"], t["i_d"]), _limit("i_trip")),
    Reason.OVER_TEMPERATURE: Cause(
        "too hot", "let it cool down; look at load and cooling", "limits.temperature_max_c", "degC",
        _hottest, _limit("temperature_max")),
    Reason.DC_LINK_UNDER_VOLTAGE: Cause(
        "DC link too low", "look at supply and precharge", "limits.v_dc_min_v", "V",
        lambda p, s, t: float(t["v_dc"]), _limit("v_dc_min")),
    Reason.DC_LINK_OVER_VOLTAGE: Cause(
        "DC link too high", "brake more slowly, or look at the brake resistor", "limits.v_dc_max_v", "V",
        lambda p, s, t: float(t["v_dc"]), _limit("v_dc_max")),
    Reason.DRIVE_FAULT: Cause(
        "the drive reports a fault",
        "look the error code up in its manual and clear the cause", detail=_drive),
    Reason.DRIVE_LEFT_OPERATION: Cause(
        "the drive left operation by itself", "look at its enable input, its own trips and its supply",
        detail=_drive),
    Reason.ENABLE_TIMEOUT: Cause(
        "the drive was not enabled in time",
        "hil check says what it sends; look at its enable input and at a fault that is not reset",
        "feedback.enable_timeout_s", "s",
        lambda p, s, t: None if s is None else float(s["armed_ticks"] + s["armed_gaps"]) * float(p["T_s"]),
        _limit("enable_ticks", _period_s), _drive),
    Reason.BUS_DOWN: Cause(
        "the bus is down (bus-off, or the interface)", "look at the cable and at ip -details link show"),
    Reason.SEND_FAILED: Cause(
        "the bus takes no frame",
        "is another node there to acknowledge, and is the queue (txqueuelen) long enough?"),
    Reason.FOREIGN_COMMAND: Cause(
        "somebody else commands the drive", "stop the other controller, or give this run another node id"),
    Reason.LOG_FAILED: Cause(
        "the log can't be written", "look at the disk's room and rights in log.folder", fault=False),
    Reason.GUARD_PERSISTENT: Cause(
        "the guard had to change the command for too long",
        "look at the law's tuning, and at the limits of the command",
        "limits.guard_trip_ticks", "ms", _state("clamped", _period_ms),
        _limit("guard_trip_ticks", _period_ms), _flags),
    Reason.LOOP_OVERRUN: Cause(
        "the loop was late",
        "give it real-time rights and a processor of its own (docs/deploy.md), or a lower rate",
        "loop.max_gap_ticks", "periods", lambda p, s, t: float(t["gap"]), _limit("max_gap")),
    Reason.CONTROLLER_ERROR: Cause(
        "the law asked for what is no number", "look at the tuning; the log replays to this tick",
        detail=lambda p, s, t: f"u_q {float(t['u_q_law'])}, u_d {float(t['u_d_law'])}"),
    Reason.I2T: Cause(
        "too much current for too long",
        "lower the load, or give i_continuous_a and i2t_max_a2s what the motor bears",
        "limits.i2t_max_a2s", "A2s", _state("i2t"), _limit("i2t_max")),
    Reason.ENERGY: Cause(
        "too much power for too long, in or out", "lower the load, or brake more slowly",
        "limits.energy_max_j", "J", _state("energy"), _limit("energy_max")),
    Reason.GUARDIAN: Cause(
        "the guardian stopped the drive: the loop was silent for longer than guardian.timeout_ms",
        "look at what held the loop up: other load on its processor, a debugger, SIGSTOP"),
    Reason.GUARDIAN_LOST: Cause(
        "the guardian process is gone", "look at who killed it (dmesg: out of memory?)"),
    Reason.COMMAND_LOST: Cause(
        "the drive does not answer to the last command",
        "commands are lost, or what comes is old: look at the bus load",
        "feedback.hold_ticks", "ms", _state("lagging", _period_ms), _hold_ms),
    Reason.FROZEN_FEEDBACK: Cause(
        "the readings stand still although the voltage moved",
        "look at encoder, current sensors and firmware",
        "feedback.frozen_ticks or repeat_ticks", "periods",
        lambda p, s, t: None if s is None else float(max(s["frozen"], s["repeats"])),
        lambda p, s, t: float(min(p["frozen_ticks"], p["repeat_ticks"]))),
    Reason.FOLLOWING_ERROR: Cause(
        "the speed is too far off its reference for following_error_s",
        "look at load, voltage (is the law saturated before?) and encoder; slow the reference down",
        "limits.following_error_rad_s", "rad/s",
        lambda p, s, t: abs(float(t["w_ref"]) - float(t["w"])), _limit("w_error_max"), _flags),
    Reason.ANGLE_ERROR: Cause(
        "the angle is too far off its reference for following_error_s",
        "look at load and current (is the law saturated before?); slow the move down",
        "limits.following_error_rad", "rad",
        lambda p, s, t: abs(float(t["theta_error"])), _limit("theta_error_max"), _flags),
    Reason.ANGLE_JUMP: Cause(
        "the measured angle moved by what the speed does not tell",
        "look at the encoder, its cable and its resolution, and at the angle's unit and sign",
        "", "rad", _state("slip"), _limit("theta_jump")),
    Reason.CURRENT_UNCONTROLLED: Cause(
        "i_d is far from its reference, 0 for most laws, most of the time",
        "look for an open phase or a wrong rotor angle",
        "limits.i_d_max_a or open_phase_min_a", "A",
        lambda p, s, t: abs(float(t["i_d"]) - (0.0 if s is None else float(s["i_d_ref"]))),
        lambda p, s, t: float(min(p["i_d_max"], max(p["open_phase_min"], abs(float(t["i_q"])) / 3.0)))),
    Reason.STALE_STATUS: Cause(
        "a slow message of the drive (DC link, temperatures) stopped or never came",
        "look at what the drive sends; status_timeout_s or GenMsgCycleTime in the DBC say how long to wait",
        "feedback.status_timeout_s", "s", _age, _age_max, _never_came),
    Reason.NODE_STOPPED: Cause(
        "another node of this run stopped, and all stop with it",
        "look at why the other one stopped: hil replay LOG and hil report LOG name it", fault=False),
}  # fmt: skip


def explain(safety: Any, state: Any, tick: Any, first_k: int = 0) -> End | None:
    """Why a run ended, by the first tick that has a reason; None where none has."""
    code = int(tick["reason"])
    if code == 0 or code not in tuple(Reason):
        return None
    reason, p = Reason(code), safety[0]
    s = None if state is None else state[0]
    cause = CAUSES[reason]
    t_s = (int(tick["k"]) - first_k) * float(p["T_s"])
    value, limit = cause.value(p, s, tick), cause.limit(p, s, tick)
    name, detail = reason.name.lower(), cause.detail(p, s, tick)
    return End(name, cause.what, value, limit, cause.unit, cause.key, t_s, cause.remedy, detail)


def remedy_of(ended: str) -> str:
    """What to do about a reason by its name; empty for what is none."""
    known = ended.upper() in Reason.__members__ and ended.upper() != "NONE"
    return CAUSES[Reason[ended.upper()]].remedy if known else ""


def page() -> str:
    """``docs/stop-reasons.md``."""
    rows = [
        f"| `{reason.name.lower()}` | {c.what} | {f'`{c.key}`' if c.key else ''} | {c.unit} "
        f"| {'fault' if c.fault else 'quick stop'} | {c.remedy} |"
        for reason, c in CAUSES.items()
    ]
    return "\n".join([HEAD, *rows, ""])


HEAD: Final = """# Why runs end

Every end has a reason, which latches: the first one stays. `hil run`, `hil simulate` and `hil report` say it
with the value that led to it, its limit, the time since the first tick and what to do; with `--json` it is
the object `end` (`reason`, `what`, `value`, `limit`, `unit`, `key`, `t_s`, `remedy`, `detail`, `text`). The
page is made from the table in `hil/tick/reasons.py` by `python -m hil.tick.reasons`; a test holds them
together.

In every stop the voltage is 0 from the tick on in which the reason is seen. A quick stop ends in SWITCH ON
DISABLED, a fault in FAULT; nothing leads back to operation but a new run.

| reason | what it means | limit | unit | ends as | what to do |
|---|---|---|---|---|---|"""


if __name__ == "__main__":
    print(page(), end="")  # noqa: T201
