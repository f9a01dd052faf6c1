"""How to mesh, as an operator chooses it: which surface, which holes, how many triangles, how smooth."""

from collections.abc import Callable
from typing import Any, get_args

from slviewer.gui.inputs import Choice, change
from slviewer.gui.panel import Stage
from slviewer.surface.meshing import MeshingPlan, Method

METHODS: dict[Method, str] = {
    "grid": "between neighbouring pixels",
    "poisson": "fitted to all points (Poisson)",
    "volume": "mean in small cells (volume)",
}
SMALL, OPEN, SIZED, CLOSED = "fill the smallest", "leave open", "fill up to a size", "close all: watertight"
SMOOTHING = {"none": 0, "light": 5, "strong": 20}
"""Rounds of each."""


class MeshInputs:
    """The inputs of a plan, inside the folder that is open; shown where there is something to mesh."""

    def __init__(self, stage: Stage, changed: Callable[[], None]) -> None:
        gui = stage.gui
        self._method = Choice(gui, "Surface", "Between pixels shows each point; a fitted surface evens out noise")
        self._holes = gui.add_dropdown("Holes", (SMALL, OPEN, SIZED, CLOSED))
        self._size = gui.add_number("Up to, mm", 2.0, min=0.1, max=500.0, step=0.1, visible=False)
        self._thin = gui.add_number(
            "Triangles", 0, min=0, max=50_000_000, step=1000, hint="At most so many; 0: as many as there are"
        )
        self._smooth = gui.add_dropdown(
            "Smoothing", tuple(SMOOTHING), hint="Evens out noise; how far it moved the surface is told"
        )
        self._method.on_change(stage.safely(changed))
        for handle in (self._holes, self._size, self._thin, self._smooth):
            handle.on_update(stage.safely(changed))

    def draw(self, visible: bool, merged: bool) -> None:
        """Show or hide them; merged points have no pixels to lay triangles between."""
        offered = [(name, said) for name, said in METHODS.items() if not (merged and name == "grid")]
        self._method.offer(offered)
        self._method.show(visible)
        inputs: list[Any] = [self._holes, self._thin, self._smooth]
        for handle in inputs:
            change(handle, visible=visible)
        change(self._size, visible=visible and self._holes.value == SIZED)

    @property
    def triangles(self) -> int | None:
        """How many at most; None: as many as there are."""
        return max(4, round(self._thin.value)) if self._thin.value >= 1 else None

    def plan(self) -> MeshingPlan:
        """What is chosen."""
        holes = self._holes.value
        chosen = next((name for name in get_args(Method) if name == self._method.value), None)
        # pixels see one side only: a surface between them never closes
        method = None if holes == CLOSED and chosen == "grid" else chosen
        sizes = {OPEN: 0.0, SIZED: float(self._size.value)}
        return MeshingPlan(method, sizes.get(holes), self.triangles, SMOOTHING[self._smooth.value], holes == CLOSED)
