"""Where a browser looks from: everybody turns the 3D view for himself, and a button brings a cloud before his eyes."""

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from slviewer.gui.panel import Stage

_FROM = np.array([-0.45, -0.35, -0.82])
"""From a little to the left and above of where the camera looks from: depth is seen, and nothing is upside down."""


def bring_button(stage: Stage, points: Callable[[], np.ndarray | None]) -> viser.GuiButtonHandle:
    """A button that turns the view of whoever clicks it to the points (..., 3) mm that it is given then, if any."""
    button = stage.gui.add_button("Bring into view", icon=viser.Icon.FOCUS_2, color="gray")
    button.on_click(stage.safely_with(lambda event: _bring(event, points())))
    return button


def _bring(event: Any, points: np.ndarray | None) -> None:
    if event.client is None or points is None:
        return
    flat = points.reshape(-1, 3)
    flat = flat[np.isfinite(flat[:, 2])][:: max(1, len(flat) // 20_000)]
    if not len(flat):
        return
    low, high = np.percentile(flat, [2, 98], axis=0)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    camera = event.client.camera
    with event.client.atomic():
        camera.position = tuple(middle + _FROM * max(1.45 * size, 50.0))  # which moves the point looked at along
        camera.look_at = tuple(middle)
