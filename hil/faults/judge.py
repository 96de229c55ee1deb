"""Judge a run by its log: what the reaction was, when the motor was safe, what was worst, what is missing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.faults.matrix import Expect, Stall
from hil.log.reader import Log
from hil.signals import DriveState, Reason, Request, TickArray

AS_EXPECTED, NOT_EXPECTED = "as expected", "not as expected"
SETTLED_TICKS: Final = 50
"""Over these last ticks before the planned stop a run that rode through must hold its speed."""
STALL_SLACK_MS: Final = 1.0
"""A loop that is stopped in its sleep notices so much less of a stall: its period at most."""
ReadCommand = Callable[[bytes], tuple[float, ...]]


@dataclass(slots=True)
class Result:
    """One row of the table. ``traces``: t [s], w, w_ref, i, u for the page."""

    fault: str
    expected: str
    reaction: str = ""
    time_to_safe_ms: float | None = None
    w_worst_rad_s: float = float("nan")
    i_worst_a: float = float("nan")
    u_worst_v: float = float("nan")
    log: str = ""
    replay: str = ""
    why: list[str] = field(default_factory=list)
    path: str = ""
    onset_s: float = 0.0
    stop_s: float | None = None
    clock: str = ""
    traces: dict[str, npt.NDArray[np.float64]] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """As expected when nothing stands against it."""
        return NOT_EXPECTED if self.why else AS_EXPECTED

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        names = ("fault", "expected", "reaction", "time_to_safe_ms", "verdict", "w_worst_rad_s", "i_worst_a")
        more = ("u_worst_v", "log", "replay", "clock", "why", "path")
        return {name: getattr(self, name) for name in (*names, *more)}


@dataclass(frozen=True, slots=True)
class Evidence:
    """What a run left: log, black box of the drive, Reason that the controller ended with, onset.

    ``host``: the fault of the host, ``host_acted``: False when it was seen not to act.
    """

    log: Log
    box: dict[str, Any]
    ended: int | None
    onset_s: float
    host: Any = None
    host_acted: bool = True
    asked: bool = False
    """The drive is asked by its command: what goes out at a tick's begin is the last tick's."""


def faulty_stop(ticks: TickArray) -> int | None:
    """Index of the first tick with a reason to stop other than the planned end."""
    planned = (ticks["reason"] == 0) | (ticks["reason"] == int(Reason.STOP_REQUESTED))
    at = np.nonzero(~planned)[0]
    return int(at[0]) if len(at) else None


def judge(
    result: Result,
    expect: Expect,
    evidence: Evidence,
    u_max: float,
    read_command: ReadCommand,
    command_id: int,
) -> None:
    """Fill in what the log and the drive's black box say, and hold it against ``expect``."""
    log, box, onset_s = evidence.log, evidence.box, evidence.onset_s
    ticks = log.ticks
    if len(ticks) == 0:
        result.why.append("the log holds no tick")
        return
    t_s = (ticks["t_ns"] - ticks["t_ns"][0]) * 1e-9
    stop = faulty_stop(ticks)
    result.onset_s, result.stop_s = onset_s, None if stop is None else float(t_s[stop])
    result.w_worst_rad_s, result.i_worst_a = box["w_rad_s"], box["i_a"]
    after = ticks[t_s >= onset_s]
    if len(after):
        result.u_worst_v = float(np.hypot(after["u_q"], after["u_d"]).max())
    result.traces = traces(ticks, t_s)
    reason = evidence.ended if stop is None else int(ticks["reason"][stop])
    if reason in (None, int(Reason.STOP_REQUESTED)):
        _judge_ride(result, expect, ticks)
    else:
        _judge_stop(result, expect, ticks, t_s, Reason(reason), box)
    _judge_faults(result, evidence)
    _judge_limits(result, expect, u_max)
    _judge_log(result, expect, log)
    _judge_frames(result, log, command_id, read_command, evidence.asked)


def judge_together(result: Result, judged: Mapping[str, Result], cause: str | None) -> None:
    """What is true of all nodes of a run, into ``result``; the reaction is that of ``cause``.

    Of several nodes all stop in the same tick.
    """
    first = judged[cause] if cause else next(iter(judged.values()))
    for name in ("reaction", "log", "onset_s", "stop_s", "traces"):
        setattr(result, name, getattr(first, name))
    for name in ("w_worst_rad_s", "i_worst_a", "u_worst_v"):
        setattr(result, name, max(getattr(one, name) for one in judged.values()))
    safe_ms = [one.time_to_safe_ms for one in judged.values() if one.time_to_safe_ms is not None]
    result.time_to_safe_ms = max(safe_ms, default=None)
    for name, one in judged.items():
        result.why += [f"{name}: {why}" if name else why for why in one.why]
        if one.stop_s != first.stop_s:
            result.why.append(f"{name}: did not stop in the same tick")


def _judge_stop(
    result: Result,
    expect: Expect,
    ticks: TickArray,
    t_s: npt.NDArray[np.float64],
    reason: Reason,
    box: dict[str, Any],
) -> None:
    name = reason.name.lower()
    result.reaction = f"stop: {name}"
    nonzero = np.nonzero((ticks["u_q"] != 0) | (ticks["u_d"] != 0))[0]
    commanded_s = float(t_s[nonzero[-1]]) if len(nonzero) else 0.0
    safe_s = max(commanded_s, box["voltage_until_s"] or 0.0)
    result.time_to_safe_ms = max(0.0, (safe_s - result.onset_s) * 1e3)
    if expect.reaction != "stop":
        result.why.append(f"stopped with {name}")
        return
    if name not in expect.reason:
        result.why.append(f"reason {name}")
    if expect.within_ms is not None and result.time_to_safe_ms > expect.within_ms:
        result.why.append(f"safe after {result.time_to_safe_ms:.1f} ms")
    stopped = int(ticks["state"][-1]) in (int(DriveState.FAULT), int(DriveState.SWITCH_ON_DISABLED))
    if expect.log == "complete" and not stopped:
        result.why.append(f"ended in {DriveState(int(ticks['state'][-1])).name}")


def _judge_ride(result: Result, expect: Expect, ticks: TickArray) -> None:
    result.reaction = "ride through"
    running = ticks[(ticks["state"] == int(DriveState.OPERATION_ENABLED)) & (ticks["reason"] == 0)]
    running = running[running["request"] < int(Request.RAMP_DOWN)]  # the ramp to rest is none of the ride
    if expect.reaction == "stop":
        result.why.append("did not stop")
    if len(running) < SETTLED_TICKS or int(ticks["reason"][-1]) != Reason.STOP_REQUESTED:
        result.why.append("did not run to its planned end")
        return
    last = running[-SETTLED_TICKS:]
    off = float(np.abs(last["w"] - last["w_ref"]).max())
    if expect.reaction == "ride through" and off > expect.w_error_rad_s:
        result.why.append(f"speed off by {off:.2f} rad/s in the end")


def _judge_faults(result: Result, evidence: Evidence) -> None:
    """A fault that did nothing proves nothing, whatever came of the run."""
    idle = [kind for kind, times in evidence.box["acted"] if not times]
    host, ticks = evidence.host, evidence.log.ticks
    if host is not None and not evidence.host_acted:
        idle.append(host.kind)
    elif isinstance(host, Stall) and silence_ms(ticks) < host.for_ms - STALL_SLACK_MS:
        idle.append(f"{host.kind}, the loop was silent for {silence_ms(ticks):.1f} ms at most")
    if idle:
        result.why.append(f"did nothing: {', '.join(idle)}")


def silence_ms(ticks: TickArray) -> float:
    """Longest time between the wake-ups of two ticks that follow each other."""
    woken_ns = ticks["t_ns"] + ticks["lateness_ns"]
    return float(np.diff(woken_ns).max(initial=0)) * 1e-6


def _judge_limits(result: Result, expect: Expect, u_max: float) -> None:
    bounds = (
        ("speed", result.w_worst_rad_s, expect.w_max_rad_s),
        ("current", result.i_worst_a, expect.i_max_a),
        ("voltage", result.u_worst_v, u_max * 1.0001),  # the wire's rounding
    )
    for what, value, most in bounds:
        if most is not None and value > most:
            result.why.append(f"{what} reached {value:.1f}")


def _judge_log(result: Result, expect: Expect, log: Log) -> None:
    if log.damage is None and not log.gaps and "ended" in log.result:
        result.log = "complete"
    else:
        result.log = f"{len(log.ticks)} ticks readable"
    if expect.log == "complete" and result.log != "complete":
        result.why.append(f"log: {log.damage or 'ticks are missing'}")


def _judge_frames(
    result: Result, log: Log, command_id: int, read_command: ReadCommand, asked: bool = False
) -> None:
    """No logged command frame carries voltage from the tick of the stop on.

    That tick begins when the loop woke up for it: a late tick before it may send past its nominal time. Where
    the drive is ``asked`` by its command, that tick's own goes out once it is computed.
    """
    reasons = log.ticks["reason"] != 0
    if not reasons.any():
        return
    tick = log.ticks[int(np.argmax(reasons))]
    stop_ns = int(tick["t_ns"]) + max(0, int(tick["lateness_ns"]))
    if asked:
        stop_ns = int(tick["t_ns"]) + max(0, int(tick["computed_ns"])) + 1
    sent = [f for f in log.frames if not f.received and f.can_id == command_id and f.t_ns >= stop_ns]
    if any(any(value != 0.0 for value in read_command(frame.data)) for frame in sent):
        result.why.append("voltage was sent after the stop")


def traces(ticks: TickArray, t_s: npt.NDArray[np.float64], most: int = 400) -> dict[str, Any]:
    """Thinned signals for the page."""
    every = max(1, len(ticks) // most)
    thin = ticks[::every]
    return {
        "t": t_s[::every],
        "w": thin["w"].copy(),
        "w_ref": np.where(thin["state"] == int(DriveState.OPERATION_ENABLED), thin["w_ref"], np.nan),
        "i": np.hypot(thin["i_q"], thin["i_d"]),
        "u": np.hypot(thin["u_q"], thin["u_d"]),
    }
