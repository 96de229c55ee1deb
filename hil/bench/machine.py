"""What machine the figures are of: kernel, processor, governor, versions."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any


def machine_facts() -> dict[str, Any]:
    """Facts without which a figure of time says nothing."""
    load = os.getloadavg()[0]
    return {
        "kernel": platform.release(),
        "preemption": _preemption(platform.version()),
        "processor": _cpuinfo("model name"),
        "virtual": "hypervisor" in _cpuinfo("flags").split(),
        "cores": os.cpu_count(),
        "governor": _first_line(Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")) or "not told",
        "idle": _first_line(Path("/sys/devices/system/cpu/cpuidle/current_driver")) or "not told",
        "load_average": round(load, 2),
        "python": platform.python_version(),
        "numba": version("numba"),
        "numpy": version("numpy"),
        "python-can": version("python-can"),
    }


def _preemption(text: str) -> str:
    """The kernel's preemption model out of its version line."""
    return next((word for word in ("PREEMPT_RT", "PREEMPT_DYNAMIC", "PREEMPT") if word in text), "none")


def _cpuinfo(key: str) -> str:
    """The first processor's entry of that name, "" when there is none."""
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        name, _, value = line.partition(":")
        if name.strip() == key:
            return value.strip()
    return ""


def _first_line(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def resident_kib(pid: int) -> int:
    """Memory that a process has in use [KiB]; 0 when it has gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="utf-8").split()[1])
    except (OSError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024
