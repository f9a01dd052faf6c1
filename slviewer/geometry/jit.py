"""One decorator for the compiled kernels, whose cache never stands in the way.

numba refuses ``cache=True`` at import where no cache folder can be written (a read-only install, no home folder); such
a kernel is then compiled in memory at its first call instead.
"""

from collections.abc import Callable
from typing import Any

import numba


def kernel(*, parallel: bool = False, fastmath: bool = False) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: ``numba.njit`` that releases the GIL and caches its machine code where a folder can be written."""
    options: dict[str, Any] = {"parallel": parallel, "fastmath": fastmath, "nogil": True}

    def compile_lazily(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:  # "cannot cache function: no locator available"
            return numba.njit(**options)(function)

    return compile_lazily
