"""Live clouds in the browsers: each gets the newest as soon as it has drawn the previous one.

A browser that stalls gets nothing more until it has caught up, and delays no other.
"""

from functools import partial
from typing import Any

import numpy as np
import viser

from slviewer.gui.colouring import shade
from slviewer.gui.panel import PanelContext, start_worker
from slviewer.gui.scene import add_points, spacing, thin
from slviewer.reconstruction.reconstruct import normals
from slviewer.server.viewers import Viewers
from slviewer.wizard.live_scan import LiveCloud

LAYER = "live"
MOST_POINTS, FEWEST_POINTS = 60_000, 15_000
# a browser that takes longer, or less, for a cloud is sent fewer points, or more
_SLOW_S, _QUICK_S = 0.09, 0.05


class LiveScreen:
    """Draws live clouds on a thread of its own. Every method may be called from any thread."""

    def __init__(self, context: PanelContext) -> None:
        self._context = context
        context.scene.layer(LAYER)
        self._viewers = Viewers(context.server.viser, self._wake)
        self._pass_on = start_worker("slviewer live screen")
        self._cloud: LiveCloud | None = None
        self._nodes: dict[int, Any] = {}
        self._drawn: dict[int, int] = {}
        self._limit, self._counted = MOST_POINTS, 0
        self._is_in_view = False
        self.points = 0
        """Number of points drawn of the last cloud."""

    def offer(self, cloud: LiveCloud) -> None:
        """Set the cloud to draw next, in place of one that is still waiting."""
        self._cloud = cloud
        self._wake()

    def clear(self) -> None:
        """Remove the live cloud."""
        self._cloud, self._is_in_view = None, False
        self._wake()

    def _wake(self) -> None:
        """Draw soon: there is another cloud, or a browser has drawn what it was sent."""
        self._pass_on(partial(self._context.run, self._draw))

    def _draw(self) -> None:
        """Send the latest cloud to the browsers that are ready for it, or remove it from all."""
        cloud = self._cloud
        if cloud is None:
            self._remove_cloud()
            return
        clients = [c for c in self._viewers.ready() if self._drawn.get(c.client_id) != cloud.number]
        if not clients:
            return
        self._adapt_limit()
        measured = np.count_nonzero(np.isfinite(cloud.points[..., 2]))
        step = int(max(np.sqrt(measured / self._limit), 1))  # normals of all points take too long
        points, texture = cloud.points[::step, ::step], cloud.texture[::step, ::step]
        points, colours = thin(points, shade(texture, normals(points, 1)), self._limit)
        self.points = len(points)
        if not len(points):
            self._remove_cloud()
            return
        for client in clients:
            self._send_cloud(client, points, colours)
            self._drawn[client.client_id] = cloud.number
        if not self._is_in_view:
            self._is_in_view = True
            self._context.viewpoints.show(f"{LAYER} {cloud.begun}", points)
        if cloud.number != self._counted:
            self._counted = cloud.number
            self._context.operator.count_live_shown(cloud)

    def _send_cloud(
        self, client: viser.ClientHandle, points: np.ndarray, colours: np.ndarray
    ) -> None:
        """Send points (n, 3) mm with colours to one browser, as a new or an updated node."""
        number = client.client_id
        with client.atomic():
            if number not in self._nodes:
                path = f"/{LAYER}/cloud"
                self._nodes[number] = add_points(client.scene, path, points, colours)
            else:
                node = self._nodes[number]
                node.points, node.colors, node.point_size = points, colours, spacing(points)
            self._viewers.sent(client)

    def _remove_cloud(self) -> None:
        """Remove the cloud from all browsers."""
        nodes, self._nodes, self._drawn = self._nodes, {}, {}
        for node in nodes.values():
            node.remove()

    def _adapt_limit(self) -> None:
        """Adapt the number of points to the slowest browser, and forget browsers that have
        disconnected."""
        slowest = self._viewers.slowest_s()
        if slowest > _SLOW_S:
            self._limit = max(int(0.8 * self._limit), FEWEST_POINTS)
        elif slowest < _QUICK_S:
            self._limit = min(int(1.1 * self._limit), MOST_POINTS)
        for gone in self._nodes.keys() - self._viewers.here():
            del self._nodes[gone], self._drawn[gone]
