"""Viewpoints of the browsers: each turns its own 3D view; a new cloud is shown in every view."""

from collections.abc import Callable, Iterable

import numpy as np
import viser

_FROM = np.array([-0.45, -0.35, -0.82])
"""Viewing direction: from the upper left of the camera, so that depth is visible and nothing is
upside down."""
TO_THE_RIGHT = np.cross([0.0, 1.0, 0.0], -_FROM) / np.linalg.norm(_FROM[[0, 2]])
"""(3,): to the right in that view, at the same distance."""
OVERVIEW = ((-430.0, -560.0, -820.0), (55.0, 40.0, 330.0))
"""Camera position and target, mm: the rig and objects at its working distance, in a narrow window
too."""
FIELD_OF_VIEW = 0.75  # rad


class Viewpoints:
    """Moves the views of all browsers; `clients()` returns those that are connected."""

    def __init__(self, clients: Callable[[], Iterable[viser.ClientHandle]]) -> None:
        self._clients = clients
        self._shown = ""

    def overview(self) -> None:
        """Show the whole rig again, if a cloud was shown."""
        if self._shown:
            self._shown = ""
            for client in self._clients():
                _set_view(client, *(np.array(each) for each in OVERVIEW))

    def show(self, name: str, points: np.ndarray | None) -> None:
        """Move all views to the points (..., 3) mm, unless those of the same `name` are shown
        already."""
        if points is None or name == self._shown:
            return
        self._shown = name
        for client in self._clients():
            look_at_points(client, points)


def look_at_points(client: viser.ClientHandle, points: np.ndarray) -> None:
    """Move one browser's view to the points (..., 3) mm; nothing happens where none is valid."""
    flat = points.reshape(-1, 3)
    flat = flat[np.isfinite(flat[:, 2])][:: max(1, len(flat) // 20_000)]
    if not len(flat):
        return
    low, high = np.percentile(flat, [2, 98], axis=0)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    # the field of view is that of the height
    away = max(1.45 * size * max(1.0, 0.85 / client.camera.aspect), 50.0)
    _set_view(client, middle + _FROM * away, middle)


def _set_view(client: viser.ClientHandle, position: np.ndarray, at: np.ndarray) -> None:
    """Set one browser's camera position and target (3,) mm."""
    with client.atomic():
        client.camera.position = tuple(position)  # this also moves the target
        client.camera.look_at = tuple(at)
