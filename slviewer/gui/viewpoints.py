"""Viewpoints of the browsers: each operator turns the 3D view alone; a new cloud is brought into every view."""

from collections.abc import Callable, Iterable

import numpy as np
import viser

_FROM = np.array([-0.45, -0.35, -0.82])
"""From a little to the left and above of where the camera looks from: depth is seen, and nothing is upside down."""
ASIDE = np.cross([0.0, 1.0, 0.0], -_FROM) / np.linalg.norm(_FROM[[0, 2]])
"""(3,): to the right as one looks from there, at the same distance."""
OVERVIEW = ((-430.0, -560.0, -820.0), (55.0, 40.0, 330.0))
"""Position and point looked at, mm: the rig and what stands at its working distance, in a narrow window too."""
FIELD_OF_VIEW = 0.75  # rad


class Viewpoints:
    """The viewpoints of all browsers; `clients()` gives those that are connected."""

    def __init__(self, clients: Callable[[], Iterable[viser.ClientHandle]]) -> None:
        self._clients = clients
        self._about = ""

    def overview(self) -> None:
        """Look at the whole rig again, where a cloud has been looked at."""
        if self._about:
            self._about = ""
            for client in self._clients():
                _look(client, *(np.array(each) for each in OVERVIEW))

    def at(self, about: str, points: np.ndarray | None) -> None:
        """Look at the points (..., 3) mm, unless what they are `about` is looked at already."""
        if points is None or about == self._about:
            return
        self._about = about
        for client in self._clients():
            bring(client, points)


def bring(client: viser.ClientHandle, points: np.ndarray) -> None:
    """Let one browser look at the points (..., 3) mm; nothing happens where none is valid."""
    flat = points.reshape(-1, 3)
    flat = flat[np.isfinite(flat[:, 2])][:: max(1, len(flat) // 20_000)]
    if not len(flat):
        return
    low, high = np.percentile(flat, [2, 98], axis=0)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    away = max(1.45 * size * max(1.0, 0.85 / client.camera.aspect), 50.0)  # the field of view is that of the height
    _look(client, middle + _FROM * away, middle)


def _look(client: viser.ClientHandle, position: np.ndarray, at: np.ndarray) -> None:
    with client.atomic():
        client.camera.position = tuple(position)  # which moves the point looked at along
        client.camera.look_at = tuple(at)
