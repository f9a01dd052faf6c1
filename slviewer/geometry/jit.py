"""One decorator for the compiled kernels, whose cache never stands in the way, and never gives back stale code."""

import threading
from collections.abc import Callable
from typing import Any

import numba
from llvmlite import ir
from numba.core import cgutils
from numba.extending import intrinsic

from slviewer.geometry.jit_cache import folder_for

_LOCK = threading.Lock()
_SETTINGS: Any = numba.config


def kernel(*, parallel: bool = False, fastmath: bool = False) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: ``numba.njit`` that releases the GIL and caches its machine code where a folder can be written.

    Where none can, a kernel is compiled in memory at its first call.
    """
    options: dict[str, Any] = {"parallel": parallel, "fastmath": fastmath, "nogil": True}

    def compile_lazily(function: Callable[..., Any]) -> Callable[..., Any]:
        folder = folder_for(function.__module__)
        if folder is None:
            return numba.njit(**options)(function)
        with _LOCK:  # numba reads the setting while it decorates; others' kernels keep their own place
            before, _SETTINGS.CACHE_DIR = _SETTINGS.CACHE_DIR, str(folder)
            try:
                return numba.njit(cache=True, **options)(function)
            finally:
                _SETTINGS.CACHE_DIR = before

    return compile_lazily


def _fused(_typing: Any, a: Any, b: Any, c: Any) -> Any:
    """``a b + c`` of float32, rounded once, in compiled code.

    A compiler that is merely allowed to do so decides anew for code that is kept and for code that was just made, and
    the last bit differs.
    """

    def build(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        kind = arguments[0].type
        function = builder.module.declare_intrinsic("llvm.fma", [kind], ir.FunctionType(kind, [kind] * 3))
        return builder.call(function, arguments)

    return numba.float32(numba.float32, numba.float32, numba.float32), build


fma: Any = intrinsic(_fused)


def _signed(_typing: Any, level: Any) -> Any:
    """A grey level as a number that holds sums and differences of eight such: int16 of uint8, int32 of uint16."""

    def build(_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.zext(arguments[0], ir.IntType(signature.return_type.bitwidth))

    return numba.types.Integer.from_bitwidth(2 * level.bitwidth, True)(level), build


def _plus(_typing: Any, a: Any, b: Any) -> Any:
    """``a + b``, of integers as wide as both: Python's own grow to 64 bits, of which few fit a register."""
    return a(a, a), lambda _context, builder, _signature, arguments: builder.add(*arguments)


def _less(_typing: Any, a: Any, b: Any) -> Any:
    """``a - b``, of integers as wide as both."""
    return a(a, a), lambda _context, builder, _signature, arguments: builder.sub(*arguments)


def _prefetch(_typing: Any, array: Any, index: Any) -> Any:
    """Have the cache line of an array's element (one index, in one dimension) brought near; nothing waits for it."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        view = context.make_array(signature.args[0])(context, builder, arguments[0])
        byte, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
        at = builder.bitcast(builder.gep(view.data, [arguments[1]]), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, flag, flag, flag])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [at, flag(0), flag(1), flag(1)])  # to read; into the outer caches; data
        return context.get_dummy_value()

    return numba.types.void(array, index), build


signed: Any = intrinsic(_signed)
plus: Any = intrinsic(_plus)
less: Any = intrinsic(_less)
prefetch: Any = intrinsic(_prefetch)
