"""Open3D, imported when it is first needed, also on a machine without libusb.

Open3D's wheels for Linux are linked against ``libusb-1.0.so.0`` (for depth cameras that nobody here
uses), which bare machines lack. The package ``libusb-package`` carries it; once loaded into the
process under its own name, the dynamic linker is content with it.
"""

import ctypes
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from slviewer.errors import SlviewerError
from slviewer.geometry.rigid import Floats

_NOTEBOOK_DRAWING = "open3d.visualization.draw_plotly"
"""Imports Dash and Plotly: nearly half of Open3D's import time."""


class _Unused(ModuleType):
    """A module whose every name is None, in place of one that is not used."""

    def __getattr__(self, name: str) -> None:
        if name.startswith("__"):
            raise AttributeError(name)


@cache
def open3d() -> Any:
    """Return the ``open3d`` module, quiet below errors; the first import needs half a second.

    Raises ``SlviewerError`` with the remedy where it cannot be imported.
    """
    _supply_libusb()
    sys.modules.setdefault(_NOTEBOOK_DRAWING, _Unused(_NOTEBOOK_DRAWING))
    try:
        with _uninterrupted():
            import open3d as module
    except (ImportError, OSError) as error:
        package = "open3d-cpu" if sys.platform == "linux" else "open3d"
        raise SlviewerError(
            f"Open3D, which aligns scans and casts rays, cannot be imported ({error})",
            f"run 'pip install {package} libusb-package' in the environment that runs slviewer.",
        ) from error
    # Open3D brings a TBB older than numba wants; numba then takes another threading layer, and need
    # not say so
    warnings.filterwarnings("ignore", message="The TBB threading layer requires")
    module.utility.set_verbosity_level(module.utility.VerbosityLevel.Error)
    return module


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Context manager: delay Ctrl-C to the end of the block, because an interrupted import of
    Open3D is reported as a missing package, or ends the process with its own messages."""
    # signals come to the main thread alone
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came = False

    def keep(*_: object) -> None:
        """Store the signal until the end of the block."""
        nonlocal came
        came = True

    before = signal.signal(signal.SIGINT, keep)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)
    if came:
        signal.raise_signal(signal.SIGINT)


def _supply_libusb() -> None:
    """Load a libusb into the process if the system has none; do nothing where none can be found."""
    if not sys.platform.startswith("linux"):
        return
    try:
        ctypes.CDLL("libusb-1.0.so.0")
    except OSError:
        try:
            import libusb_package

            path = libusb_package.get_library_path()
            if path is not None:
                ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
        except (ImportError, OSError):
            return  # the import of Open3D says what is missing, in its own words


def point_cloud(points: Floats, normals: Floats | None = None) -> Any:
    """Return Open3D's cloud of points (n, 3), with normals (n, 3) if they are given."""
    to_vectors = open3d().utility.Vector3dVector
    cloud = open3d().geometry.PointCloud(to_vectors(points))
    if normals is not None:
        cloud.normals = to_vectors(normals)
    return cloud


def fit_normals(cloud: Any, neighbours: int) -> None:
    """Fit the unit normals of Open3D's cloud to so many ``neighbours``, towards those it has.

    By the tensor API, here and in `fpfh_features`: the other one computes the same, but no thread
    of the program runs meanwhile.
    """
    tensors = _to_tensors(cloud)
    tensors.estimate_normals(neighbours)
    cloud.normals = open3d().utility.Vector3dVector(tensors.point.normals.numpy())


def fpfh_features(cloud: Any, radius: float, most: int) -> Any:
    """Return the FPFH features of Open3D's cloud with normals, of at most so many neighbours within
    ``radius`` mm."""
    pipelines = open3d().t.pipelines.registration
    features = open3d().pipelines.registration.Feature()
    features.data = pipelines.compute_fpfh_feature(_to_tensors(cloud), most, radius).numpy().T
    return features


def _to_tensors(cloud: Any) -> Any:
    """Return Open3D's cloud as one of its tensor API."""
    return open3d().t.geometry.PointCloud.from_legacy(cloud, open3d().core.Dtype.Float64)


def raycasting_scene(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """Return Open3D's ray-casting scene of the triangles ``faces`` (m, 3) of vertices (n, 3)."""
    scene, tensor = open3d().t.geometry.RaycastingScene(), open3d().core.Tensor
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    return scene


def align_icp(
    scan: Any,
    reference: Any,
    T: Floats,
    gate: float,
    loss: Any,
    settled: float,
    iterations: int,
) -> Floats:
    """(4, 4): Open3D's point-to-plane ICP of two of its clouds from the pose ``T``, with pairs up
    to ``gate`` mm apart.

    Ends after ``iterations``, or where fitness and RMSE change by less than the share ``settled``.
    """
    pipeline = open3d().pipelines.registration
    criteria = pipeline.ICPConvergenceCriteria(settled, settled, iterations)
    method = pipeline.TransformationEstimationPointToPlane(loss)
    return np.array(
        pipeline.registration_icp(scan, reference, gate, T, method, criteria).transformation
    )
