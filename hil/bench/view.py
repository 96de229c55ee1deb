"""The bench for people: rows of a table, and the ratios to an earlier one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

from hil.errors import HilError

COMPARED: Final = {
    "rate_hz": "higher",
    "bare_rate_hz": "higher",
    "rate_ratio": "higher",
    "processor_us": "lower",
    "bare_processor_us": "lower",
    "processor_ratio": "lower",
    "tick_us.sync, receive, check, decode": "lower",
    "tick_us.control": "lower",
    "tick_us.guard": "lower",
    "tick_us.encode, send": "lower",
    "tick_us.sleep": "lower",
    "wall_us.exchange": "lower",
    "record_us": "lower",
    "lateness_us.p50": "lower",
    "lateness_us.p999": "lower",
    "cyclictest_us.p999": "lower",
    "without_fifo.in_time": "higher",
    "replay_x_realtime": "higher",
    "simulate_x_realtime": "higher",
    "start_s": "lower",
}
"""What is compared, and which way is better."""


def rows(result: dict[str, Any]) -> list[tuple[str, str]]:
    """Names and texts, ratios first."""
    tick, wall, machine = result["tick_us"], result["wall_us"], result["machine"]
    plain = result["without_fifo"]
    out = [
        ("processor time a tick", f"{result['processor_ratio']:.2f} x the bare loop's: " + _cost(result)),
        ("rate", _rate(result)),
        *([("in time, median second", _at_rates(result["in_time_at"]))] if result["in_time_at"] else []),
        ("lateness at p99.9", _lateness_ratio(result)),
        ("lateness", _percentiles(result["lateness_us"])),
        ("cyclictest", _percentiles(result["cyclictest_us"]) + f" ({result['cyclictest']})"),
        ("processor time by phase", _phases(tick)),
        ("phases as they pass, median", _phases(wall)),
        ("without FIFO rights", f"{100 * plain['in_time']:.2f} % in time at {plain['rate_hz']} Hz"),
        ("replay", f"{result['replay_x_realtime']:.0f} x real time, from file to verdict"),
        ("simulation", f"{result['simulate_x_realtime']:.0f} simulated seconds a second, log included"),
        ("start to armed", f"{result['start_s']:.2f} s"),
        ("run", _run(result)),
    ]
    out += [("granted", _grants(result["grants"]))] if result["grants"] else []
    return [*out, ("machine", ", ".join(f"{name} {value}" for name, value in machine.items()))]


def _phases(phases: dict[str, float]) -> str:
    return ", ".join(f"{name} {us:.1f}" for name, us in phases.items()) + " us"


def _cost(result: dict[str, Any]) -> str:
    return f"{result['processor_us']:.1f} us of {result['bare_processor_us']:.1f} us"


def _rate(result: dict[str, Any]) -> str:
    ratio = result["rate_ratio"]
    text = f"{ratio:.2f} x the bare loop's: " if ratio is not None else ""
    text += f"{result['rate_hz']} Hz of {result['bare_rate_hz']} Hz, 99.9 % in time in the best second"
    return text if result["tried"] else text + " (other rates not tried)"


def _at_rates(at: dict[str, dict[str, float]]) -> str:
    """Both loops by turns at each rate."""
    each = [f"{rate} Hz {100 * of['hil']:.2f} ({100 * of['bare']:.2f})" for rate, of in at.items()]
    return ", ".join(each) + " %, in brackets the bare loop by turns with it"


def _lateness_ratio(result: dict[str, Any]) -> str:
    ratio = result["lateness_ratio_p999"]
    return "no cyclictest to compare with" if ratio is None else f"{ratio:.2f} x cyclictest's"


def _percentiles(lateness: dict[str, Any] | None) -> str:
    if lateness is None:
        return "none"
    text = " / ".join(f"{lateness[name]:.0f}" for name in ("p50", "p99", "p999", "max"))
    return f"{text} us (p50 / p99 / p99.9 / max) of {lateness['samples']}"


def _run(result: dict[str, Any]) -> str:
    return (
        f"{result['ticks']} ticks at {result['run_rate_hz']} Hz, {result['skipped']} periods skipped, "
        f"{result['dropped']} records dropped, memory grew by {result['growth_kib']} KiB"
    )


def _grants(grants: list[dict[str, Any]]) -> str:
    return ", ".join(
        f"{grant['what']}: {grant['detail'] if grant['granted'] else 'no, ' + grant['detail']}"
        for grant in grants
    )


def read_result(path: Path) -> dict[str, Any]:
    """An earlier ``--json`` output. Raises HilError."""
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise HilError(f"{path}: is no output of hil bench --json ({error})") from error
    if not isinstance(earlier, dict) or "tick_us" not in earlier:
        raise HilError(f"{path}: is no output of hil bench --json (no tick_us in it)")
    return earlier


def value_at(result: dict[str, Any], key: str) -> float | None:
    """The number at a dotted key; None where there is none."""
    value: Any = result
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def ratios(result: dict[str, Any], earlier: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Now, then and now over then of every figure that both have."""
    out: dict[str, dict[str, Any]] = {}
    for key, better in COMPARED.items():
        now, then = value_at(result, key), value_at(earlier, key)
        if now is not None and then:
            out[key] = {"now": now, "then": then, "ratio": now / then, "better": better}
    return out


def ratio_rows(compared: dict[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """The comparison as rows of a table."""
    return [
        (key, f"{one['ratio']:.3f} x ({one['better']} is better): {one['then']:.4g}, now {one['now']:.4g}")
        for key, one in compared.items()
    ]
