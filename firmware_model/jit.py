"""How the emulator's kernels are compiled: as the wire's. The emulator shares no control code."""

from __future__ import annotations

from drivers.jit import COMPILED, array_at, entry, inlined, jit, places_of, waiting

__all__ = ["COMPILED", "array_at", "entry", "inlined", "jit", "places_of", "waiting"]
