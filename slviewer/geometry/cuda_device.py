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
_NO_DEVICE = 100  # CUDA_ERROR_NO_DEVICE
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
        count, reason, level = _asked_driver()
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
        _LOG.warning("the CUDA device cannot be used, and the processor computes: %s", _first_line(error))
        return None
    _LOG.info("clouds are computed on %s", name)
    return name


def _asked_driver() -> tuple[int, str, int]:
    """How many devices the driver has; if none, why, and whether that is a matter for the log's INFO or WARNING."""
    count = ctypes.c_int()
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        code = driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count))
    except (OSError, AttributeError) as error:
        return 0, f"there is no driver ({_first_line(error)})", logging.INFO
    if code not in (0, _NO_DEVICE):
        return 0, f"its driver answers with error {code}: install the graphics card's driver anew", logging.WARNING
    return count.value, "the driver has none", logging.INFO


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
