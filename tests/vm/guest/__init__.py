"""What runs inside the bench machine."""

import sys
from pathlib import Path
from typing import Any

IN_MACHINE = "hil.bench_machine=1" in Path("/proc/cmdline").read_text()

# python-can and numba import these where they are; that takes half a minute there, and nothing needs them
ABSENT = ("asammdf", "coverage")

if IN_MACHINE:
    absent: dict[str, Any] = dict.fromkeys(ABSENT)
    sys.modules.update(absent)
