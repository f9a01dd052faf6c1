"""Inputs of the region of interest, and its box in 3D, which is moved and turned by a handle."""

import numpy as np
import viser

from slviewer.errors import InputError
from slviewer.gui.inputs import SessionValue, change
from slviewer.gui.panel import PanelContext
from slviewer.gui.widgets import Text
from slviewer.surface.region_of_interest import RegionOfInterest
from slviewer.wizard.snapshot import SessionView

ON, OFF = (20, 150, 140), (150, 150, 150)
_BOX, _HANDLE = "region", "region handle"
_HANDLE_SHARE = 0.6
"""Of the longest side of the box: the size of its handle."""


class RegionInputs:
    """Inputs that show and set the session's region of interest, drawn in a layer of the scene."""

    def __init__(self, context: PanelContext, layer: str) -> None:
        self._context, self._layer = context, layer
        self._region: RegionOfInterest | None = None
        self._scan = ""
        self._drawn: object = None
        gui, operator = context.gui, context.operator
        with gui.add_folder("Region of interest", expand_by_default=False):
            self._text = Text(gui)
            self._on = gui.add_checkbox(
                "Use region", False, hint="Ignores all points outside of a box, in every scan"
            )
            self._automatic = context.button(
                "Automatic region",
                lambda: operator.fit_region(self._scan),
                viser.Icon.BOX,
                hint="Box around this scan",
            )
            self._handles = gui.add_checkbox(
                "Handles", False, hint="Arrows move the box in 3D, rings turn it"
            )
            self._centre = gui.add_vector3("Centre (mm)", (0.0, 0.0, 0.0), step=0.1)
            self._size = gui.add_vector3(
                "Size (mm)", (1.0, 1.0, 1.0), min=(0.1, 0.1, 0.1), step=0.1
            )
            self._turn = gui.add_vector3("Turn (°)", (0.0, 0.0, 0.0), step=0.1)
        self._on_value = SessionValue(self._on)
        self._on.on_update(context.callback(self._switch, by_user=True))
        self._values = [SessionValue(each) for each in (self._centre, self._size, self._turn)]
        for each in (self._centre, self._size, self._turn):
            each.on_update(context.callback(self._set_from_numbers, by_user=True))
        self._handles.on_update(context.callback(self._draw_box))

    def draw(self, session: SessionView | None, scan: str) -> None:
        """Show the region of a session; ``scan``: the one that the automatic region is put
        around."""
        self._scan = scan
        self._region = region = session.region if session else None
        is_on = bool(session and session.region_is_on)
        self._on_value.update(is_on)
        for handle in (self._handles, self._centre, self._size, self._turn):
            change(handle, visible=region is not None)
        change(self._automatic, disabled=not scan)
        if region is None:
            self._text.write(
                "All points are used. The automatic region is a box around this scan.", "dim"
            )
        else:
            for shown, value in zip(
                self._values, (region.centre_mm, region.size_mm, region.rotation_deg), strict=True
            ):
                shown.update(tuple(round(number, 1) for number in value))
            self._text.write("" if is_on else "The region is off: all points are used.", "dim")
        self._draw_box(is_on)

    def _draw_box(self, is_on: bool | None = None) -> None:
        """Draw the box, and its handle where it is wanted."""
        scene, region = self._context.scene, self._region
        is_on = bool(self._on.value) if is_on is None else is_on
        drawn = (region, is_on, self._handles.value)
        if drawn == self._drawn:
            return
        self._drawn = drawn
        if region is None:
            scene.remove(self._layer, _BOX)
            scene.remove(self._layer, _HANDLE)
            return
        scene.lines(self._layer, _BOX, region.edges(), ON if is_on else OFF)
        if self._handles.value:
            longest = max(region.size_mm)
            scene.gizmo(
                self._layer, _HANDLE, region.T_camera_box, self._preview, self._place,
                scale_mm=_HANDLE_SHARE * longest,
            )  # fmt: skip
        else:
            scene.remove(self._layer, _HANDLE)

    def _preview(self, T: np.ndarray) -> None:
        """Draw the box at T (4, 4) while its handle is dragged."""
        if self._region is not None:
            moved = RegionOfInterest.placed(T, self._region.size_mm)
            self._context.scene.lines(self._layer, _BOX, moved.edges(), ON)

    def _place(self, T: np.ndarray) -> None:
        """Request the region at T (4, 4), where its handle was dragged to."""
        region, operator = self._region, self._context.operator
        if region is not None:
            self._context.callback(
                lambda: operator.set_region(RegionOfInterest.placed(T, region.size_mm))
            )(None)

    def _switch(self) -> None:
        """Switch the region on or off; without one, take the automatic one."""
        operator = self._context.operator
        if self._region is None and self._on.value:
            if self._scan:
                operator.fit_region(self._scan)
        else:
            operator.switch_region(bool(self._on.value))

    def _set_from_numbers(self) -> None:
        """Request the region of the numbers that were entered; nothing happens while they are no
        box."""
        try:
            region = RegionOfInterest(self._centre.value, self._size.value, self._turn.value)
        except InputError:
            return
        self._context.operator.set_region(region, bool(self._on.value))
