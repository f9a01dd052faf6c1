"""Computations in a process of their own: the same results, beside a program that goes on."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from slviewer.errors import Cancelled, InputError, SlviewerError
from slviewer.process import call_apart
from slviewer.registration.open3d_loader import fit_normals, fpfh_features, point_cloud
from slviewer.surface.meshing import MeshingPlan, build_mesh
from slviewer.surface.shapes import PointSet

pytestmark = pytest.mark.computes


def ball(count: int) -> PointSet:
    """Points (count, 3) of a ball of 100 mm radius, with normals."""
    places = np.random.default_rng(0).normal(size=(count, 3))
    places /= np.linalg.norm(places, axis=1)[:, None]
    return PointSet(100 * places, places.astype(np.float32))


def mesh_on_thread(points: PointSet, progress: Callable[..., object]) -> Any:
    """Mesh points as a job of the wizard does."""
    with ThreadPoolExecutor(1) as pool:
        job = pool.submit(call_apart, build_mesh, points, MeshingPlan(), progress=progress)
        return job.result()


def process_ids() -> list[int]:
    """Processes that compute for this one."""
    with open(f"/proc/self/task/{threading.get_native_id()}/children") as own:
        return [int(each) for each in own.read().split()]


@contextmanager
def ticking() -> Iterator[list[float]]:
    """For how many seconds another thread stands still each time, during the block."""
    gaps, ended = list[float](), threading.Event()

    def tick() -> None:
        """Measure for how long this thread stands still."""
        last = time.monotonic()
        while not ended.wait(0.02):
            gaps.append(time.monotonic() - last)
            last = time.monotonic()

    clock = threading.Thread(target=tick)
    clock.start()
    try:
        yield gaps
    finally:
        ended.set()
        clock.join()


def test_program_goes_on_beside_a_long_call_with_the_same_result() -> None:
    points, reports = ball(20_000), list[tuple[float, str]]()
    with ticking() as gaps:
        made = mesh_on_thread(points, lambda *report: reports.append(report))
    same = build_mesh(points, MeshingPlan())
    np.testing.assert_array_equal(made.mesh.faces, same.mesh.faces)
    np.testing.assert_allclose(made.mesh.vertices, same.mesh.vertices, atol=1e-6)
    stages = list(dict(reversed(reports)))
    assert stages == sorted(stages, reverse=True) and len(stages) >= 5 and reports[-1][0] == 1.0
    in_the_call = sum(stage == "meshing by poisson" for _, stage in reports)
    assert in_the_call > 2 and max(gaps) < 0.5  # 1.5 s with the lock held


def test_program_goes_on_beside_normals_and_features() -> None:
    cloud = point_cloud(ball(20_000).points)
    with ticking() as gaps:
        fit_normals(cloud, 30)
        features = fpfh_features(cloud, 5.0, 100)
    assert np.abs(np.sum(cloud.normals * ball(20_000).normals, axis=1)).min() > 0.999
    assert features.data.shape == (33, 20_000) and max(gaps) < 0.5  # 3 s with the lock held


def test_errors_of_the_call_arrive_as_they_are() -> None:
    with pytest.raises(InputError, match="5 points make no surface: at least 100 are needed"):
        mesh_on_thread(ball(5), lambda *_: None)


def test_cancelling_ends_a_call_that_cannot_be_interrupted() -> None:
    begun = list[float]()

    def cancel(share: float, stage: str) -> None:
        """Cancel in the middle of Poisson's method."""
        if stage == "meshing by poisson":
            begun.append(time.monotonic())
            if len(begun) == 2:
                raise Cancelled("cancelled")

    with pytest.raises(Cancelled):
        mesh_on_thread(ball(200_000), cancel)
    assert time.monotonic() - begun[0] < 2  # ten and more seconds to its end


@pytest.mark.skipif(not os.path.exists("/proc"), reason="finds the process in /proc")
def test_a_process_that_the_system_ends_is_an_error_with_a_remedy() -> None:
    def kill(share: float, stage: str) -> None:
        """End the process as a system without memory does."""
        for process in process_ids():
            os.kill(process, signal.SIGKILL)

    with pytest.raises(SlviewerError, match=r"ended early, with status -9: where memory was short"):
        mesh_on_thread(ball(200_000), kill)
