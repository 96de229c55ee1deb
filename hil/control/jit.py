"""The one way that kernels are compiled: for a generic processor, exact IEEE arithmetic, cached on disk.

No fastmath and no processor features, so that a result is the same to the bit on every machine of an
architecture and with the compiler switched off (``NUMBA_DISABLE_JIT=1``).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

numba.config.CPU_NAME = "generic"
numba.config.CPU_FEATURES = ""

Function = TypeVar("Function", bound=Callable[..., Any])


def jit(function: Function) -> Function:
    """Compile ``function`` with numba at its first call."""
    return cast(Function, numba.njit(cache=True, fastmath=False, error_model="numpy")(function))
