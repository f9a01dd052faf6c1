"""The CUDA device: used where it was asked for, probed once a process, reported once in the log.

Nothing of CUDA is imported before the driver itself reports a device.
"""

import ctypes
import importlib.util
import logging
import os
import sys
import threading
from types import FunctionType
from typing import Any

import numpy as np

_LOG = logging.getLogger("slviewer.cuda")
_LOCK = threading.Lock()
_NO_DEVICE = 100  # CUDA_ERROR_NO_DEVICE
_cached_name: list[str | None] = []  # empty until the first call of `find_device`
_wanted: list[bool] = []  # whether it was asked for


def use_device(on: bool = True) -> None:
    """Let the CUDA device compute from now on, or the processor; one that failed stays unused."""
    _wanted[:] = [on]


def is_present() -> bool:
    """Whether `use_device` can have an effect: numba-cuda is installed, and the driver has a
    device that has not failed."""
    if importlib.util.find_spec("numba_cuda") is None or _cached_name == [None]:
        return False
    return _count_devices()[0] > 0


def find_device() -> str | None:
    """The name of the device that computes; None where none was asked for (`use_device`), there is
    none, or it failed before.

    It needs the package numba-cuda (``pip install 'slviewer[cuda]'``); without it, no device is
    searched for. A driver that does not work is logged once. ``CUDA_VISIBLE_DEVICES=`` hides the
    devices, as from any program.
    """
    with _LOCK:
        if _wanted != [True]:
            return None
        if not _cached_name:
            _cached_name.append(_probe_device())
        return _cached_name[0]


def disable_device(error: Exception) -> None:
    """Log that the device failed; from now on `find_device` returns None."""
    with _LOCK:
        if _cached_name != [None]:
            _LOG.warning(
                "The graphics card failed, and the processor takes over: %s", _first_line(error)
            )
        _cached_name[:] = [None]


def allocate_frames(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Return an uninitialised array, in page-locked memory where there is a device, for transfers
    at full speed."""
    if find_device() is not None:
        from numba import cuda

        try:
            return cuda.pinned_array(shape, dtype)
        except Exception as error:
            disable_device(error)
    return np.empty(shape, dtype)


def _probe_device() -> str | None:
    """Return the name of a CUDA device that runs a kernel, simulated ones included; None without
    one."""
    simulated = os.environ.get("NUMBA_ENABLE_CUDASIM", "0") not in ("", "0")
    if not simulated:
        if importlib.util.find_spec("numba_cuda") is None:
            return None
        count, reason, level = _count_devices()
        if count == 0:
            _LOG.log(level, "no CUDA device is used: %s", reason)
            return None
    try:
        from numba import cuda

        if simulated:
            return "the CUDA simulator"
        name = cuda.current_context().device.name
        name = name.decode() if isinstance(name, bytes) else str(name)
    except Exception as error:
        _LOG.warning(
            "The graphics card cannot be used, and the processor computes: %s", _first_line(error)
        )
        return None
    _LOG.info("clouds are computed on %s", name)
    return name


def _count_devices() -> tuple[int, str, int]:
    """Return the number of CUDA devices, and where it is 0 the reason and the log level to report
    it at."""
    count = ctypes.c_int()
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        code = driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count))
    except (OSError, AttributeError) as error:
        return 0, f"there is no driver ({_first_line(error)})", logging.INFO
    if code not in (0, _NO_DEVICE):
        return (
            0,
            f"its driver reports error {code}: reinstall the graphics card's driver",
            logging.WARNING,
        )
    return count.value, "the driver has none", logging.INFO


def _first_line(error: Exception) -> str:
    """Return the first line of an error's message, or its type where it has none."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def device_function(function: Any) -> Any:
    """Convert a function compiled by numba for the processor, and those that it calls, for use in
    CUDA kernels.

    A rule for one pixel is written once: what such a function calls must exist on both sides
    (``math``, not ``numpy``).
    """
    from numba import cuda

    python = function.py_func
    names = dict(python.__globals__)
    for name in python.__code__.co_names:
        if hasattr(names.get(name), "py_func"):
            names[name] = device_function(names[name])
    twin = FunctionType(
        python.__code__, names, python.__name__, python.__defaults__, python.__closure__
    )
    twin.__module__ = python.__module__
    return cuda.jit(device=True)(twin)
