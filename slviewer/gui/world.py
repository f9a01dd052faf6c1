"""What stands before the simulated rig, where there is one: chosen, brought to a distance, and turned."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from slviewer.gui.inputs import Follows, change
from slviewer.gui.panel import Stage
from slviewer.gui.widgets import Words
from slviewer.wizard.snapshot import Snapshot

NEAREST_MM, FARTHEST_MM = 250.0, 1500.0
_GIZMO = "thing"


class Stand:
    """A folder of a panel that offers `things` of the simulated world; with real devices it is not there."""

    def __init__(self, stage: Stage, layer: str, things: Sequence[str]) -> None:
        self._stage, self._layer, self._things = stage, layer, tuple(things)
        self._T = np.eye(4)
        self._standing = self._handled = ""
        gui = stage.gui
        with gui.add_folder("Simulated rig", visible=False) as self._folder:
            self._says = Words(gui)
            self._thing = gui.add_dropdown("Before the rig", ("something else", *self._things))
            self._distance = gui.add_number(
                "At, mm",
                600.0,
                min=NEAREST_MM,
                max=FARTHEST_MM,
                step=5.0,
                hint="Distance from the camera",
            )
            self._turn = gui.add_number("Turned, °", 0.0, min=-90.0, max=90.0, step=5.0)
            self._handles = gui.add_checkbox("3D handles", False, hint="To drag and turn it in the 3D view")
        self._drawn = [Follows(each) for each in (self._thing, self._distance, self._turn)]
        self._thing.on_update(stage.safely_with(self._choose))
        self._handles.on_update(stage.safely(self._draw_handles))
        self._distance.on_update(self._typed(self._distance, "distance_mm"))
        self._turn.on_update(self._typed(self._turn, "turn_deg"))

    def draw(self, snapshot: Snapshot) -> None:
        """Show what stands there."""
        world = snapshot.world
        change(self._folder, visible=world is not None)
        if world is None:
            self._standing = ""
            self._draw_handles()
            return
        fits = world.standing in self._things
        self._says.say(
            "" if fits else f"The {world.standing} stands before the rig: choose what to capture instead.", "warning"
        )
        for number in (self._distance, self._turn):
            change(number, disabled=not fits)
        T = np.asarray(world.T_camera_thing, float)
        self._standing, self._T = world.standing if fits else "", T
        self._draw_handles()
        drawn = (
            world.standing if fits else "something else",
            round(float(np.clip(T[2, 3], NEAREST_MM, FARTHEST_MM)), 1),
            round(float(np.clip(world.turn_deg, -90, 90)), 1),
        )
        for follows, value in zip(self._drawn, drawn, strict=True):
            follows.tell(value)

    def _draw_handles(self) -> None:
        scene, wanted = self._stage.scene, self._standing if self._handles.value else ""
        if not wanted:
            scene.remove(self._layer, _GIZMO)
        elif wanted != self._handled:
            scene.gizmo(self._layer, _GIZMO, self._T, lambda T: None, self._place)
        else:
            scene.move(self._layer, _GIZMO, self._T)
        self._handled = wanted

    def _place(self, T: np.ndarray) -> None:
        self._stage.safely(lambda: self._stage.operator.place(self._standing, T))(None)

    def _choose(self, event: Any) -> None:
        if event.client_id is not None and self._thing.value in self._things:
            self._stage.operator.place(self._thing.value)

    def _typed(self, number: Any, what: str) -> Callable[[Any], None]:
        """Bring it to where somebody typed; not where a number was drawn, nor where its first digits would be."""

        def changed(event: Any) -> None:
            if event.client_id is not None and number.min <= number.value <= number.max:
                value = number.value  # now: until this has its turn, a snapshot from before may be drawn over it
                self._stage.safely(lambda: self._stage.operator.bring(**{what: value}))(event)

        return changed
