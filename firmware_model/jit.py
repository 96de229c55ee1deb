"""How the emulator's kernels are compiled; the emulator shares no code with the controller."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

numba.config.CPU_NAME = "generic"
numba.config.CPU_FEATURES = ""

Function = TypeVar("Function", bound=Callable[..., Any])


def jit(function: Function) -> Function:
    """Compile with numba: exact IEEE arithmetic, generic processor, cached on disk."""
    return cast(Function, numba.njit(cache=True, fastmath=False, error_model="numpy")(function))
