"""What runs inside the bench machine."""

import sys
from pathlib import Path
from typing import Any

IN_MACHINE = "hil.bench_machine=1" in Path("/proc/cmdline").read_text()

if IN_MACHINE:
    # python-can and numba import these where they are; that takes half a minute there, and nothing needs them
    absent: dict[str, Any] = {"asammdf": None, "coverage": None}
    sys.modules.update(absent)
