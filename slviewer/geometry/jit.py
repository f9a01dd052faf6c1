"""One decorator for the compiled kernels, whose cache never stands in the way, and never gives back stale code."""

import threading
from collections.abc import Callable
from typing import Any

import numba
from llvmlite import ir
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
