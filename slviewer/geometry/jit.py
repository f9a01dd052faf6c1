"""One decorator for the compiled kernels, whose cache never stands in the way, and never gives back stale code."""

import threading
from collections.abc import Callable
from typing import Any

import numba

from slviewer.geometry.jit_cache import folder_for

_LOCK = threading.Lock()
_SETTINGS: Any = numba.config


def kernel(
    *, parallel: bool = False, fastmath: bool | frozenset[str] = False
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: ``numba.njit`` that releases the GIL and caches its machine code where a folder can be written.

    Where none can, a kernel is compiled in memory at its first call.
    """
    options: dict[str, Any] = {
        "parallel": parallel,
        "fastmath": fastmath if isinstance(fastmath, bool) else set(fastmath),
        "nogil": True,
    }

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
