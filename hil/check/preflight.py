"""Rows of `hil check` about the machine itself: real-time rights, clock, disk."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from hil.config.loop import BusTable, RealtimeTable
from hil.errors import HilError
from hil.log.recorder import check_folder
from hil.runtime import realtime

Verdict = Literal["pass", "warn", "fail"]
CLOCK_SOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
SLOW_CLOCKS = ("hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit")
WAKEUPS = 100
INLINE_SINCE = (6, 5)
"""Linux runs softirqs after an interrupt although ksoftirqd is runnable (commit d15121be7485)."""
_POLICY_AT = 38
"""Of what follows the name in /proc/PID/stat; proc(5) counts from the process number, and from 1."""


@dataclass(frozen=True, slots=True)
class Row:
    """One check: what was looked at, how it is, what was found, what to do."""

    check: str
    verdict: Verdict
    found: str
    remedy: str = ""

    def as_dict(self) -> dict[str, str]:
        """JSON form."""
        return asdict(self)


def row(check: str, good: bool, found: str, remedy: str, otherwise: Verdict = "fail") -> Row:
    """A row that passes when ``good``; only a row that does not pass has a remedy."""
    return Row(check, "pass", found) if good else Row(check, otherwise, found, remedy)


def realtime_rows(table: RealtimeTable) -> list[Row]:
    """What the operating system would grant; asked for and given back."""
    remedy = "real-time set-up in docs/deploy.md; without it ticks may be late"
    return [row(g.what, g.granted, g.detail, remedy, "warn") for g in realtime.probe(table)]


def clock_row(period_ns: int, source: Path = CLOCK_SOURCE) -> Row:
    """Clock source, and how late sleeps of one millisecond wake, against the loop's period."""
    name = source.read_text(encoding="ascii").strip() if source.is_file() else "unknown"
    late = sorted(_lateness_ns() for _ in range(WAKEUPS))
    p50, worst = late[WAKEUPS // 2], late[-1]
    found = f"{name}; wakes {p50 / 1e3:.0f} us late, at worst {worst / 1e3:.0f} us of {WAKEUPS}"
    if name in SLOW_CLOCKS:
        return Row("clock", "warn", found, "boot with a fast clock source (clocksource=tsc on x86)")
    remedy = "an idle machine, the performance governor, a core of its own ([realtime] cpu)"
    return row("clock", worst < period_ns // 2, found, remedy, "warn")


def sync_rows(bus: BusTable, cpu: int | None) -> list[Row]:
    """What a SYNC by the kernel needs, on the loop's core or on each that the loop may be on."""
    if bus.sync != "kernel":
        return []
    return [softirq_row(os.sched_getaffinity(0) if cpu is None else [cpu])]


def softirq_row(cores: Iterable[int], release: str | None = None, proc: Path = Path("/proc")) -> Row:
    """Can a load delay a SYNC by the kernel? A softirq sends it, which may have to wait for ksoftirqd."""
    said = release or os.uname().release
    known = re.match(r"(\d+)\.(\d+)", said)
    if known and tuple(map(int, known.groups())) >= INLINE_SINCE:
        return Row("softirqs", "pass", f"Linux {said} runs them at once")
    policies = softirq_policies(proc)
    waiting = sorted(core for core in cores if policies.get(core) not in (os.SCHED_FIFO, os.SCHED_RR))
    found = f"Linux {said}: ksoftirqd under FIFO" + (f" but on {waiting}" if waiting else "")
    remedy = "; ".join(f"chrt -f -p 1 $(pgrep -x ksoftirqd/{core})" for core in waiting)
    return row("softirqs", not waiting, found, f"else a load makes SYNC late: {remedy}", "warn")


def softirq_policies(proc: Path) -> dict[int, int]:
    """Scheduling policy of each core's ksoftirqd."""
    seen = {}
    for path in proc.glob("[0-9]*/stat"):
        try:
            head, _, rest = path.read_text(encoding="ascii", errors="replace").rpartition(") ")
        except OSError:  # it has gone meanwhile
            continue
        if (name := head.partition("(")[2]).startswith("ksoftirqd/"):
            seen[int(name.partition("/")[2])] = int(rest.split()[_POLICY_AT])
    return seen


def _lateness_ns() -> int:
    end = time.monotonic_ns() + 1_000_000
    time.sleep(0.001)
    return max(0, time.monotonic_ns() - end)


def disk_row(path: Path, needed_bytes: int) -> Row:
    """Can the log be written, and is there room for it."""
    try:
        check_folder(path, needed_bytes)
    except HilError as error:
        return Row("disk", "fail", str(error), "free some space or choose another [log] folder")
    return Row("disk", "pass", f"{path.parent} takes the {needed_bytes / 1e6:.0f} MB of this run")
