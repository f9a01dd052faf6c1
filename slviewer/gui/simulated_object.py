"""The object before the simulated rig: chosen, moved and turned."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from slviewer.gui.inputs import SessionValue, change
from slviewer.gui.panel import PanelContext
from slviewer.gui.widgets import Text
from slviewer.wizard.snapshot import Snapshot

NEAREST_MM, FARTHEST_MM = 250.0, 1500.0
_OTHER = "other"
_GIZMO = "simulated object"


class SimulatedObject:
    """Inputs that place and move an object in front of the simulated rig; hidden with real
    devices."""

    def __init__(self, context: PanelContext, layer: str, things: Sequence[str]) -> None:
        self._context, self._layer, self._things = context, layer, tuple(things)
        self._T = np.eye(4)
        self._standing = self._handled = ""
        gui = context.gui
        with gui.add_folder("Simulated rig", visible=False) as self._folder:
            self._note = Text(gui)
            self._thing: Any = gui.add_dropdown("Object", (_OTHER, *self._things))
            hint = "From the camera"
            self._distance = gui.add_number(
                "Depth, mm", 600.0, min=NEAREST_MM, max=FARTHEST_MM, step=5.0, hint=hint
            )
            self._turn = gui.add_number("Turn, °", 0.0, min=-90.0, max=90.0, step=5.0)
            self._handles = gui.add_checkbox(
                "3D handles", False, hint="To move and turn it in the 3D view"
            )
        self._values = [SessionValue(each) for each in (self._thing, self._distance, self._turn)]
        self._thing.on_update(context.callback(self._request_choice, by_user=True))
        self._handles.on_update(context.callback(self._draw_handles))
        self._distance.on_update(self._make_number_callback(self._distance, "distance_mm"))
        self._turn.on_update(self._make_number_callback(self._turn, "turn_deg"))

    def draw(self, snapshot: Snapshot) -> None:
        """Show the object in view, its depth and turn."""
        world = snapshot.world
        change(self._folder, visible=world is not None)
        if world is None:
            self._standing = ""
            self._draw_handles()
            return
        fits = world.standing in self._things
        self._note.write(
            "" if fits else f"In view: the {world.standing}. Choose an object to capture.",
            "warning",
        )
        for number in (self._distance, self._turn):
            change(number, disabled=not fits)
        self._standing, self._T = world.standing if fits else "", world.T_camera_object
        self._draw_handles()
        values = (
            world.standing if fits else _OTHER,
            round(float(np.clip(self._T[2, 3], NEAREST_MM, FARTHEST_MM)), 1),
            round(float(np.clip(world.turn_deg, -90, 90)), 1),
        )
        for shown, value in zip(self._values, values, strict=True):
            shown.update(value)

    def _draw_handles(self) -> None:
        """Add, move or remove the 3D handles of the object in view."""
        scene, wanted = self._context.scene, self._standing if self._handles.value else ""
        if not wanted:
            scene.remove(self._layer, _GIZMO)
        elif wanted != self._handled:
            scene.gizmo(self._layer, _GIZMO, self._T, lambda T: None, self._request_place)
        else:
            scene.move(self._layer, _GIZMO, self._T)
        self._handled = wanted

    def _request_place(self, T: np.ndarray) -> None:
        """Request that the object be moved to T (4, 4) mm."""
        self._context.callback(lambda: self._context.operator.place(self._standing, T))(None)  # type: ignore[arg-type]

    def _request_choice(self) -> None:
        """Request that the chosen object be placed in view."""
        if self._thing.value in self._things:
            self._context.operator.place(self._thing.value)

    def _make_number_callback(self, number: Any, what: str) -> Callable[[Any], None]:
        """Return a callback that moves the object by a number entered in a browser, if it is within
        its limits."""

        def changed(event: Any) -> None:
            """Move the object, if a browser has set a valid number."""
            if event.client_id is not None and number.min <= number.value <= number.max:
                # read now: an older snapshot may be drawn over it before the callback's turn
                value = number.value
                self._context.callback(lambda: self._context.operator.move_object(**{what: value}))(
                    event
                )

        return changed
