"""How the control law's kernels are compiled: as those of the wire, by the one module for it."""

from __future__ import annotations

from drivers.jit import COMPILED, array_at, entry, jit, numba_types, place_of

__all__ = ["COMPILED", "array_at", "entry", "jit", "numba_types", "place_of"]
