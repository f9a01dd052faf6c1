"""Decorator for the compiled kernels, with a cache that is optional and never returns stale machine
code."""

import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
from filelock import FileLock
from llvmlite import ir
from numba.core import cgutils
from numba.core.compiler_lock import global_compiler_lock
from numba.extending import intrinsic

from slviewer.geometry.jit_cache import cache_folder


class CompiledKernel(NamedTuple):
    """A kernel, ``module:name``, that was compiled or loaded for arguments of these types, and the
    seconds of processor time that it took, with what it calls."""

    name: str
    arguments: tuple[Any, ...]
    seconds: float


COMPILED: list[CompiledKernel] = []
"""What this process has compiled or loaded, in order, but for what only other kernels called."""
_CALLERS: list[str] = []
"""Kernels that are being compiled, each called by the one before."""
POINTS = 256
"""So many points are worth a thread of `run_rows`."""
_LOCK = threading.Lock()
_SETTINGS: Any = numba.config


def kernel(*, fastmath: bool = False) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: ``numba.njit`` that releases the GIL and caches its machine code where a folder
    can be written.

    Where none can, a kernel is compiled in memory at its first call.
    """
    options: dict[str, Any] = {"fastmath": fastmath, "nogil": True}

    def compile_lazily(function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function compiled by numba at its first call, with its cache in the module's
        folder."""
        folder = cache_folder(function.__module__)
        if folder is None:
            return numba.njit(**options)(function)
        with (
            _LOCK
            # numba reads the setting while it decorates; kernels of other packages keep their own
            # folder
        ):
            before, _SETTINGS.CACHE_DIR = _SETTINGS.CACHE_DIR, str(folder)
            try:
                compiled = numba.njit(cache=True, **options)(function)
            finally:
                _SETTINGS.CACHE_DIR = before
        lock = folder / f"{function.__qualname__}.lock"
        name = f"{function.__module__}:{function.__qualname__}"
        compiled.compile = _compile_once(compiled.compile, name, lock)
        return compiled

    return compile_lazily


def _compile_once(
    compile_here: Callable[[Any], Any], name: str, path: Path
) -> Callable[[Any], Any]:
    """Wrap a dispatcher's ``compile(signature)``: what one process compiles, others wait for, and
    load."""

    def compile_or_load(signature: Any) -> Any:
        """Compile while this process holds the kernel's lock; without it where the disk has no
        locks."""
        # in the order in which numba takes its own for callees
        with (
            global_compiler_lock,
            ExitStack() as stack,
        ):
            with suppress(OSError, NotImplementedError):
                # of this process, were it forked
                stack.enter_context(FileLock(path, thread_local=False))
            _CALLERS.append(name)
            begun = time.thread_time()
            try:
                compiled = compile_here(signature)
            finally:
                _CALLERS.pop()
            if not _CALLERS:
                COMPILED.append(CompiledKernel(name, signature, time.thread_time() - begun))
            return compiled

    return compile_or_load


def run_rows(function: Callable[..., Any], rows: int, *arguments: Any, multiple: int = 1) -> None:
    """Call a kernel ``function(first, last, *arguments)`` for ranges of rows that together are
    ``rows``, side by side.

    As many threads work as numba's own parallel loops would use, which take the compiler three
    times as long. The ranges begin at multiples of ``multiple``.
    """
    blocks = -(-rows // multiple)
    threads = max(1, min(numba.get_num_threads(), blocks))
    bounds = [min(rows, multiple * (blocks * i // threads)) for i in range(threads + 1)]
    others: list[Future[Any]] = []
    for first, last in pairwise(bounds[1:]):
        try:
            others.append(_threads(os.getpid()).submit(function, first, last, *arguments))
        except RuntimeError:  # the interpreter ends
            function(first, last, *arguments)
    try:
        function(bounds[0], bounds[1], *arguments)
    finally:  # no thread writes to the arrays any more once this has returned
        errors = [other.exception() for other in others]
    for error in errors:
        if error is not None:
            raise error


@cache
def _threads(process: int) -> ThreadPoolExecutor:
    """Threads of this process: those of a parent do not survive a fork."""
    return ThreadPoolExecutor(_SETTINGS.NUMBA_NUM_THREADS, thread_name_prefix="kernel")


def read_only(array: np.ndarray) -> np.ndarray:
    """View of an array that cannot be written: a kernel is compiled once for arrays that can be and
    that cannot."""
    view = array.view()
    view.flags.writeable = False
    return view


def _fused_multiply_add(_typing: Any, a: Any, b: Any, c: Any) -> Any:
    """``a b + c`` of float32, rounded once, in compiled code.

    A compiler that is merely allowed to fuse may decide differently for cached and for newly
    compiled code, and then the last bit differs.
    """

    def build(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        """Emit a call of LLVM's ``fma`` intrinsic."""
        kind = arguments[0].type
        function = builder.module.declare_intrinsic(
            "llvm.fma", [kind], ir.FunctionType(kind, [kind] * 3)
        )
        return builder.call(function, arguments)

    return numba.float32(numba.float32, numba.float32, numba.float32), build


fma: Any = intrinsic(_fused_multiply_add)


def _to_signed(_typing: Any, level: Any) -> Any:
    """Grey level as a signed integer of twice the width (uint8 -> int16, uint16 -> int32)."""

    def build(_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        """Emit a zero extension to the width of the signed type."""
        return builder.zext(arguments[0], ir.IntType(signature.return_type.bitwidth))

    return numba.types.Integer.from_bitwidth(2 * level.bitwidth, True)(level), build


def _add_fixed_width(_typing: Any, a: Any, b: Any) -> Any:
    """``a + b`` in the operands' own integer width: numba widens to 64 bits, of which few fit a
    vector register."""
    return a(a, a), lambda _context, builder, _signature, arguments: builder.add(*arguments)


def _subtract_fixed_width(_typing: Any, a: Any, b: Any) -> Any:
    """``a - b`` in the operands' own integer width."""
    return a(a, a), lambda _context, builder, _signature, arguments: builder.sub(*arguments)


def _prefetch(_typing: Any, array: Any, index: Any) -> Any:
    """Prefetch the cache line of a 1-D array's element without waiting for it."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        """Emit a call of LLVM's ``prefetch`` intrinsic for the element's address."""
        view = context.make_array(signature.args[0])(context, builder, arguments[0])
        byte, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
        at = builder.bitcast(builder.gep(view.data, [arguments[1]]), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, flag, flag, flag])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        # to read; into the outer caches; data
        builder.call(function, [at, flag(0), flag(1), flag(1)])
        return context.get_dummy_value()

    return numba.types.void(array, index), build


to_signed: Any = intrinsic(_to_signed)
add_fixed_width: Any = intrinsic(_add_fixed_width)
subtract_fixed_width: Any = intrinsic(_subtract_fixed_width)
prefetch: Any = intrinsic(_prefetch)
