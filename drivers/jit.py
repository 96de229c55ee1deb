"""The one way that kernels are compiled: for a generic processor, exact IEEE arithmetic, cached on disk.

No fastmath and no fused multiply-add, so that a result is the same to the bit on every machine of an
architecture and with the compiler switched off (``NUMBA_DISABLE_JIT=1``). Control and emulator re-export this
module; it knows neither.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from typing import Any, Final, TypeVar, cast

import numba
import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.core import config as numba_config
from numba.extending import intrinsic

from drivers.kernelcache import KernelCache

config: Any = numba_config  # its attributes are made at run time
numba_types: Any = types
carray: Any = numba.carray  # type: ignore[attr-defined]
COMPILED = not config.DISABLE_JIT
"""Only compiled kernels can follow an address or call the C library."""
config.CPU_NAME = "generic"
config.CPU_FEATURES = "+sse4.1" if binding.get_host_cpu_features().get("sse4.1") else ""
"""SSE4.1 rounds in one instruction where libm's ``rint`` is called without: the same bits."""

Function = TypeVar("Function", bound=Callable[..., Any])


def jit(function: Function) -> Function:
    """Compile with numba at the first call: exact IEEE arithmetic, generic processor, cached on disk.

    Callees go into their callers: left to itself LLVM calls most of them by their address, which takes the
    simulation 1.4 times as long. Compiling takes no longer, and the bits are the same.
    """
    compiled = numba.njit(fastmath=False, error_model="numpy", forceinline=True)
    return cast(Function, _cached(compiled(function)))


def inlined(function: Function) -> Function:
    """:func:`jit` for a function made at run time, which only kernels call: it is kept as a part of those."""
    return cast(Function, numba.njit(fastmath=False, error_model="numpy", forceinline=True)(function))


def waiting(function: Function) -> Function:
    """:func:`jit` for a kernel that waits: other threads of Python's run meanwhile."""
    return cast(Function, _cached(numba.njit(nogil=True, error_model="numpy")(function)))


def _cached(dispatcher: Any) -> Any:
    """The same with :mod:`drivers.kernelcache`; what is not compiled needs none."""
    if COMPILED:
        dispatcher._cache = KernelCache(dispatcher.py_func)
    return dispatcher


def entry(kernel: Function, *example: Any) -> Function:
    """The compiled form of ``kernel`` for arguments of the types of ``example``, which is called once.

    numba finds the form by the arguments' types at every call, which for records takes longer than the
    kernel. The result does not look: it must be given arguments of those very types. With the compiler off
    it is the kernel itself.
    """
    kernel(*example)
    forms: Any = getattr(kernel, "overloads", None)
    if forms is None:
        return kernel
    type_of: Any = numba.typeof
    return cast(Function, forms[tuple(type_of(argument) for argument in example)].entry_point)


def place_of(array: Any, dtype: Any) -> tuple[int, int]:
    """Address and length of a plain row of ``dtype``, which must outlive the use. Raises TypeError."""
    if array.dtype != dtype or array.ndim != 1 or not array.flags.c_contiguous:
        raise TypeError(f"{array.dtype} of shape {array.shape}: needs a plain row of {dtype}")
    return array.__array_interface__["data"][0], len(array)


def places_of(arrays: Mapping[str, Any], kinds: Mapping[str, Any]) -> Any:
    """:func:`place_of` for each of ``kinds`` in their order, 0 where there is no array of the name.

    With the compiler off the arrays themselves, one of none where there is no array.
    """
    if not COMPILED:
        return [arrays.get(name, np.zeros(0, dtype)) for name, dtype in kinds.items()]
    places = np.zeros((len(kinds), 2), np.int64)
    for index, (name, dtype) in enumerate(kinds.items()):
        if (array := arrays.get(name)) is not None:
            places[index] = place_of(array, dtype)
    return places


def _to_pointer(_typing: Any, address: Any) -> Any:
    """A pointer from its address."""

    def made(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], cgutils.voidptr_t)

    return numba_types.voidptr(address), made


_behind: Any = intrinsic(_to_pointer)


@jit
def array_at(places: Any, index: int, dtype: Any) -> Any:
    """The array at a place: row ``index`` of what :func:`places_of` returned.

    To unpack an array of numpy's costs a kernel of a few microseconds most of its time, above all from a cold
    cache; it unpacks one of places instead.
    """
    return carray(_behind(places[index, 0]), (places[index, 1],), dtype)


@jit
def places_at(places: Any, index: int) -> Any:
    """The table of places at a place: of its plain row, as :func:`place_of` takes it."""
    return carray(_behind(places[index, 0]), (places[index, 1] // 2, 2), np.int64)


CALL: Final = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)
"""A function of Python's that kernels call: two whole numbers to one."""


def _to_call(_typing: Any, address: Any, first: Any, second: Any) -> Any:
    """What the function at an address returns."""

    def made(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        word = ir.IntType(64)
        function = builder.inttoptr(args[0], ir.FunctionType(word, [word, word]).as_pointer())
        return builder.call(function, args[1:])

    word = numba_types.int64
    return word(word, word, word), made


_calling: Any = intrinsic(_to_call)


@jit
def call(address: int, first: int, second: int) -> Any:
    """Call the :data:`CALL` at an address."""
    return _calling(address, first, second)


def _interpreted_array_at(places: Any, index: int, dtype: Any) -> Any:
    return places[index]


def _interpreted_call(address: int, first: int, second: int) -> Any:
    return CALL(int(address))(int(first), int(second))


if not COMPILED:  # the interpreter follows no address
    array_at, call = _interpreted_array_at, _interpreted_call
