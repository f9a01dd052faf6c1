"""Other people's programs on this machine: `fringes` decodes as many frames, `small-gicp` aligns the same clouds."""

from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from slviewer.errors import SlviewerError
from slviewer.validation.bench_floors import fastest, median, row

INSTALL = "pip install 'slviewer[bench]'"


def missing(package: str) -> str:
    """How to install a peer that is absent, in words; empty where it is here."""
    try:
        version(package)
    except PackageNotFoundError:
        return f"{package} is not installed, and is not compared with: {INSTALL}"
    return ""


def fringes_row(frames: int, size: tuple[int, int], ours: float) -> dict[str, Any]:
    """Decoding by `fringes` of as many frames of (width, height), shared among three periods; ``ours`` seconds took our
    kernel. It makes its arrays itself: brightness and modulation of each period, and coordinates."""
    from fringes import Fringes

    width, height = size
    coder = Fringes()
    coder.X = coder.Y = 912
    coder.D = 1
    coder.K = 3
    coder.v = [1, 8, 57]
    coder.N = [frames // 3 + (i < frames % 3) for i in range(3)]
    levels = np.random.default_rng(0).integers(0, 256, (int(coder.T), height, width)).astype(np.uint8)
    seconds = fastest(lambda: coder.decode(levels), 3)
    note = f"{seconds / ours:.0f} times our kernel; three periods, coordinates from them, in arrays of its own"
    return row(f"decode {len(levels)} frames, fringes {version('fringes')}", seconds, note=note, target=">= 100 times")


def icp_rows(points: np.ndarray) -> list[dict[str, Any]]:
    """Aligning a cloud (n, 3) mm with itself, moved by 2 mm and one degree: ours, then `small-gicp`."""
    import small_gicp

    from slviewer.registration.pairwise import register

    turn = np.radians(1.0)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    T[:3, 3] = 1.5, -1.0, 1.0
    middle = points.mean(0)
    moved = (points - middle) @ T[:3, :3].T + T[:3, 3] + middle
    count = f"{len(points) / 1e6:.2f} M points"

    def theirs() -> object:
        return small_gicp.align(
            points.astype(np.float64),
            moved.astype(np.float64),
            registration_type="PLANE_ICP",
            downsampling_resolution=0.5,
            max_correspondence_distance=8.0,
            num_threads=2,
        )

    rows = [row(f"align {count}, slviewer", _taken(lambda: register(moved, points, initial=np.eye(4))))]
    note = "point to plane, voxels of 0.5 mm, two threads, without a judgement of the result"
    return [*rows, row(f"align {count}, small-gicp {version('small-gicp')}", median(theirs, 1), note=note)]


def _taken(work: Callable[[], object]) -> float:
    """Median seconds; a cloud that may slide on itself is refused after the same work."""

    def tried() -> None:
        with suppress(SlviewerError):
            work()

    return median(tried, 1)
