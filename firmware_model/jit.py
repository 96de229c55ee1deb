"""How the emulator's kernels are compiled: as the wire's. The emulator shares no control code."""

from __future__ import annotations

from drivers.jit import cache_folder, jit

__all__ = ["cache_folder", "jit"]
