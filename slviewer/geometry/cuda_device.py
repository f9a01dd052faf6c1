"""Whether there is a CUDA device to compute with: the one place that decides, asked once, and told once.

Nothing of CUDA is imported before the driver itself has said that it has a device.
"""

import ctypes
import importlib.util
import logging
import os
import sys
import threading
from typing import Any

import numpy as np

_LOG = logging.getLogger("slviewer.cuda")
_LOCK = threading.Lock()
_found: list[str | None] = []  # empty until somebody asks


def device() -> str | None:
    """The name of the device that computes; None where there is none, or where it failed before.

    It needs the package numba-cuda (``pip install 'slviewer[cuda]'``); without it, nothing is looked for. A driver
    that does not work is told in the log, once. ``CUDA_VISIBLE_DEVICES=`` hides the devices, as from any program.
    """
    with _LOCK:
        if not _found:
            _found.append(_look())
        return _found[0]


def give_up(error: Exception) -> None:
    """Say that the device failed; from now on there is none."""
    with _LOCK:
        if _found != [None]:
            _LOG.warning("the CUDA device failed, and the processor takes over: %s", _first_line(error))
        _found[:] = [None]


def frame_room(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array of undefined values; where there is a device, in memory that it copies from and to at full speed."""
    if device() is not None:
        from numba import cuda

        try:
            return cuda.pinned_array(shape, dtype)
        except Exception as error:
            give_up(error)
    return np.empty(shape, dtype)


def _look() -> str | None:
    simulated = os.environ.get("NUMBA_ENABLE_CUDASIM", "0") not in ("", "0")
    if not simulated:
        if importlib.util.find_spec("numba_cuda") is None:
            return None
        if reason := _driver_fails():
            _LOG.info("no CUDA device is used: %s", reason)
            return None
    try:
        from numba import cuda

        if simulated:
            return "the CUDA simulator"
        name = cuda.current_context().device.name
        name = name.decode() if isinstance(name, bytes) else str(name)
    except Exception as error:
        _LOG.warning("the CUDA device cannot be used, and the processor computes: %s", _first_line(error))
        return None
    _LOG.info("clouds are computed on %s", name)
    return name


def _driver_fails() -> str:
    """What the driver lacks, in words; empty where it has a device. Some milliseconds without one."""
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        code = driver.cuInit(0)
        count = ctypes.c_int()
        if code == 0:
            code = driver.cuDeviceGetCount(ctypes.byref(count))
    except (OSError, AttributeError) as error:
        return f"there is no driver ({_first_line(error)})"
    if code != 0:
        return f"the driver answers with error {code}"
    return "" if count.value else "the driver has no device"


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
