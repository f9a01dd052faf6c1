"""Selecting points of a scan in the 3D view, and deleting them so that they can be brought back;
and the region of interest, a box that is moved and turned by a handle."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.gui.panel import PanelPart, StepPanel
from slviewer.gui.scene import Click, Drag, DragShape
from slviewer.gui.widgets import Text, note
from slviewer.pipeline.edit import SUPPORT, Selection
from slviewer.surface.region_of_interest import RegionOfInterest
from slviewer.surface.selection import (
    SupportPlane,
    select_along_path,
    select_connected,
    select_in_outline,
    select_support,
)
from slviewer.wizard.result_views import ScanCloud
from slviewer.wizard.snapshot import ScanView

OFF, BRUSH, PART = "off", "brush", "connected part"
_DRAGS: dict[str, DragShape] = {"rectangle": "rectangle", "lasso": "lasso", BRUSH: "brush"}
_DRAG_HINT = (
    " All points inside are added, also hidden ones behind; with Shift they are taken away. Ctrl"
    " and drag turns the view, the right button moves it."
)
_HINTS = {
    OFF: "",
    "rectangle": "Drag a rectangle over the points." + _DRAG_HINT,
    "lasso": "Drag a line around the points, and release." + _DRAG_HINT,
    BRUSH: "Drag over the points." + _DRAG_HINT,
    PART: "Click a part of the surface.",
}
SELECTED = (225, 40, 120)
SHOWN_EDITS = 6
"""The last ones are listed; the report lists all."""
_SELECTION = "selection"
REGION_ON, REGION_OFF = (20, 150, 140), (150, 150, 150)
_BOX, _HANDLE = "region", "region handle"
_HANDLE_SHARE = 0.6
"""Of the longest side of the box: the size of its handle."""


@dataclass(eq=False)
class _EditedScan:
    """A scan that is shown: its cloud with NaN for what edits and region removed, its points (h, w,
    3) mm in the frame of the 3D view, and masks (h, w) of those that are hidden and selected.

    ``plane``: what the selection is everything below of, where it is.
    """

    cloud: ScanCloud
    points: np.ndarray
    hidden: np.ndarray
    selected: np.ndarray
    plane: SupportPlane | None = None

    @property
    def shown(self) -> np.ndarray:
        """Mask (h, w) of the points that are shown."""
        return np.asarray(np.isfinite(self.points[..., 2]) & ~self.hidden)

    @property
    def shown_points(self) -> np.ndarray:
        """The points (h, w, 3) mm in the view's frame, NaN where they are not shown."""
        return np.where(self.hidden[..., None], np.float32(np.nan), self.points)


class PointEditing(PanelPart):
    """Inputs that select, hide and delete points of the scans that are shown, drawn in a layer of
    the scene.

    ``changed()`` is called when other points are to be shown; ``pick`` gets clicks while nothing is
    being selected.
    """

    def __init__(
        self,
        panel: StepPanel,
        changed: Callable[[], None],
        pick: Callable[[Click], None] | None = None,
    ) -> None:
        self._changed, self._pick = changed, pick
        self._scans: list[_EditedScan] = []
        self._what: list[str] = []
        self._visible = False
        super().__init__(panel)

    def build(self) -> None:
        """Create the inputs."""
        gui, operator = self._gui, self._operator
        with gui.add_folder("Edit points", expand_by_default=False) as self._folder:
            self._mode = self.dropdown("Select by", _HINTS, do=self._change_mode)
            self._size: Any = gui.add_slider(
                "Brush (%)", 1, 30, 1, 6, hint="Its diameter, in % of the view's height"
            )
            self._size.visible = False
            self.react(self._size.on_update, self._listen)
            self._hint = Text(gui)
            self.button(
                "Select support", self._select_support, "table",
                hint="The plane that the object stands on, and all below it",
            )  # fmt: skip
            self.button("Invert selection", self._invert, "switch-horizontal")
            self.button("Select nothing", self._clear_selection, "x")
            self._status = Text(gui)
            self._hide = self.button("Hide selected", self._hide_selected, "eye-off")
            self._show = self.button("Show hidden", self._show_hidden, "eye")
            self._delete = self.button(
                "Delete selected", self._delete_selected, "eraser",
                hint="The scan on disk stays as it is: Undo brings the points back",
            )  # fmt: skip
            self._undo = self.button(
                "Undo edit", lambda: operator.undo_edit(*self._names), "arrow-back-up"
            )
            self._redo = self.button(
                "Redo edit", lambda: operator.redo_edit(*self._names), "arrow-forward-up"
            )
            self._list = Text(gui)
        keys = {"rectangle": "R", "lasso": "L", BRUSH: "B", PART: "P", OFF: "escape"}
        self._keys = [
            self.command(f"Select points by: {mode}", partial(self._choose_mode, mode), key)
            for mode, key in keys.items()
        ]
        self._keys.append(
            self.command("Delete the selected points", self._delete_selected, "delete")
        )
        self._offer_keys()
        self._draw_status()

    def _offer_keys(self) -> None:
        """Let the keys act while points of the step can be edited."""
        for key in self._keys:
            key.disabled = not (self._visible and self._folder.visible)

    @property
    def _names(self) -> list[str]:
        """The scans that are shown."""
        return [scan.cloud.name for scan in self._scans]

    def set_scans(self, scans: Sequence[tuple[ScanCloud, np.ndarray]]) -> list[np.ndarray]:
        """Set the scans that are shown, with NaN for what edits and region removed, and their
        points (h, w, 3) mm in the frame of the view; returns those to show of each, without hidden
        ones.

        What was selected or hidden stays for the same scans.
        """
        before = self._scans
        self._scans = [
            _EditedScan(cloud, points, *np.zeros((2, *points.shape[:2]), bool))
            for cloud, points in scans
        ]
        old, new = (
            [(scan.cloud.name, scan.points.shape) for scan in each]
            for each in (before, self._scans)
        )
        if old == new:
            for scan, earlier in zip(self._scans, before, strict=True):
                scan.hidden = earlier.hidden
                # no plane: others may lie below it now
                scan.selected = earlier.selected & scan.shown
            self._draw_selection()
        else:
            self._clear_selection()
        return [scan.shown_points for scan in self._scans]

    def offer(self, scans: Sequence[ScanView]) -> None:
        """List the edits of scans, and offer to undo and redo them; without scans nothing is
        offered."""
        self._folder.visible = bool(scans)
        self._offer_keys()
        self._undo.disabled = not any(scan.edits for scan in scans)
        self._redo.disabled = not any(scan.undone_edits for scan in scans)
        titles = ["" if len(scans) == 1 else f"{scan.label}, " for scan in scans]
        lines = [
            f"{title}{i}. {words}"
            for title, scan in zip(titles, scans, strict=True)
            for i, words in enumerate(scan.edits, 1)
        ]
        self._list.set("".join(map(note, lines[-SHOWN_EDITS:])))

    def show(self, visible: bool) -> None:
        """Take clicks and drags in the 3D view, or leave them."""
        if visible != self._visible:  # otherwise they may be another step's
            self._visible = visible
            self._offer_keys()
            self._listen()

    # what is selected

    def _add(
        self, masks: Sequence[np.ndarray], what: str, planes: Sequence[SupportPlane] | None = None
    ) -> None:
        """Add pixels (h, w) of each scan to the selection, as far as their points are shown."""
        for i, (scan, mask) in enumerate(zip(self._scans, masks, strict=True)):
            is_all = not self._what and not scan.hidden.any()
            scan.plane = planes[i] if planes is not None and is_all else None
            scan.selected |= mask & scan.shown
        self._what = [*dict.fromkeys([*self._what, what])]
        self._draw_selection()

    def _clear_selection(self) -> None:
        """Select nothing."""
        for scan in self._scans:
            scan.selected = np.zeros_like(scan.selected)
            scan.plane = None
        self._what = []
        self._draw_selection()

    def _draw_selection(self) -> None:
        """Draw the selected points over the others."""
        chosen = [scan.points[scan.selected] for scan in self._scans]
        if any(map(len, chosen)):
            self._layer.cloud(_SELECTION, np.concatenate(chosen), SELECTED)
        else:
            self._layer.remove(_SELECTION)
        self._draw_status()

    def _draw_status(self) -> None:
        """State how many points are selected, and offer what can be done with them."""
        selected = sum(int(scan.selected.sum()) for scan in self._scans)
        total = sum(int(scan.shown.sum()) for scan in self._scans)
        hidden = sum(
            int((scan.hidden & np.isfinite(scan.points[..., 2])).sum()) for scan in self._scans
        )
        suffix = f", {hidden:,} hidden" if hidden else ""
        text = f"{selected:,} of {total:,} points selected{suffix}"
        self._status.set(note(text, "plain" if selected else "dim") if total else "")
        self._delete.disabled = self._hide.disabled = not selected
        self._show.visible = bool(hidden)

    # the 3D view

    def _choose_mode(self, mode: str) -> None:
        """Select by another way, as in the dropdown."""
        self._mode.value = mode
        self._change_mode()

    def _change_mode(self) -> None:
        """Take the clicks or drags that the way of selecting needs, then show its hint."""
        self._listen()
        self._size.visible = self._mode.value == BRUSH
        self._hint.write(_HINTS[self._mode.value], "dim")

    def _listen(self) -> None:
        """Take the clicks or drags that the way of selecting needs, else leave them."""
        mode = self._mode.value if self._visible else ""
        shape = _DRAGS.get(mode, "")
        self._scene.on_drag(shape, self._take_drag if shape else None, self._size.value / 100)
        self._scene.on_click({OFF: self._pick, PART: self._select_part}.get(mode))

    def _select_part(self, click: Click) -> None:
        """Select the part that a click meets."""
        clouds = [scan.shown_points for scan in self._scans]
        met = click.find_first(clouds)
        if met:
            i, (v, u) = met
            masks = [np.zeros_like(scan.selected) for scan in self._scans]
            masks[i] = select_connected(clouds[i], (u, v))
            self._add(masks, PART)

    def _take_drag(self, drag: Drag) -> None:
        """Add what a shape holds to the selection, or take it away."""
        mode, radius = self._mode.value, self._size.value / 200
        masks = [
            select_along_path(scan.points, drag.view, drag.path, radius)
            if mode == BRUSH
            else select_in_outline(scan.points, drag.view, drag.path)
            for scan in self._scans
        ]
        if not drag.removes:
            self._add(masks, mode)
            return
        for scan, mask in zip(self._scans, masks, strict=True):
            scan.selected, scan.plane = scan.selected & ~mask, None
        self._draw_selection()

    # the buttons

    def _require_scans(self) -> list[_EditedScan]:
        """Return the scans that are shown; InputError where none is."""
        if not self._scans:
            raise InputError("no scan is shown", "reconstruct one first")
        return self._scans

    def _select_support(self) -> None:
        """Select the plane that the object stands on, and all below it, in each scan."""
        supports = []
        for scan in self._require_scans():
            visible = np.where(scan.shown[..., None], scan.cloud.points, np.float32(np.nan))
            supports.append(select_support(visible, scan.cloud.sigma_z))
        self._add([mask for _, mask in supports], SUPPORT, [plane for plane, _ in supports])

    def _invert(self) -> None:
        """Select what was not selected, of the points that are shown."""
        for scan in self._require_scans():
            scan.selected, scan.plane = scan.shown & ~scan.selected, None
        self._what = [f"all but {' and '.join(self._what)}"] if self._what else ["everything"]
        self._draw_selection()

    def _hide_selected(self) -> None:
        """Hide the selected points in this view; they are still used."""
        for scan in self._scans:
            scan.hidden = scan.hidden | scan.selected
        self._clear_selection()
        self._changed()

    def _show_hidden(self) -> None:
        """Show the hidden points again."""
        for scan in self._scans:
            scan.hidden = np.zeros_like(scan.hidden)
        self._draw_selection()
        self._changed()

    def _delete_selected(self) -> None:
        """Request that the selected points be deleted."""
        selections = [
            Selection(scan.cloud.name, scan.cloud.points, scan.selected, scan.plane)
            for scan in self._require_scans()
        ]
        if not any(each.selected.any() for each in selections):
            raise InputError("no point is selected", "select some first")
        if self._operator.delete_points(selections, " and ".join(self._what)):
            self._clear_selection()


class RegionInputs(PanelPart):
    """Inputs that show and set the session's region of interest, drawn in a layer of the scene."""

    _region: RegionOfInterest | None = None
    _scan = ""
    _drawn: object = None

    def build(self) -> None:
        """Create the inputs."""
        gui = self._gui
        with gui.add_folder("Region of interest", expand_by_default=False):
            self._text = Text(gui)
            self._on = self.setting(
                self.checkbox("Use region", "Ignores all points outside of a box, in every scan"),
                self._switch,
            )
            self._automatic = self.button(
                "Automatic region",
                lambda: self._operator.fit_region(self._scan),
                "box",
                hint="Box around this scan",
            )
            self._handles = self.checkbox("Handles", "Arrows move the box in 3D, rings turn it")
            self._centre = gui.add_vector3(
                "Centre (mm)", (0.0, 0.0, 0.0), step=0.1, hint="Of the region, x, y and z"
            )
            self._size = gui.add_vector3(
                "Size (mm)", (1.0, 1.0, 1.0), min=(0.1, 0.1, 0.1), step=0.1, hint="Of the region"
            )
            self._turn = gui.add_vector3(
                "Turn (°)", (0.0, 0.0, 0.0), step=0.1, hint="About x, y and z"
            )
        self._numbers = [
            self.setting(each, self._set_from_numbers)
            for each in (self._centre, self._size, self._turn)
        ]

    def offer(self, scan: str) -> None:
        """Show the region of the session; ``scan``: the one that the automatic region is put
        around."""
        session, self._scan = self.panel.session, scan
        self._region = region = session.region
        self._on.update(session.region_is_on)
        for handle in (self._handles, self._centre, self._size, self._turn):
            handle.visible = region is not None
        self._automatic.disabled = not scan
        if region is None:
            self._text.write(
                "All points are used. The automatic region is a box around this scan.", "dim"
            )
        else:
            values = region.centre_mm, region.size_mm, region.rotation_deg
            for number, value in zip(self._numbers, values, strict=True):
                number.update(tuple(round(each, 1) for each in value))
            is_off = "" if session.region_is_on else "The region is off: all points are used."
            self._text.write(is_off, "dim")
        drawn = (region, session.region_is_on, self._handles.value)
        if drawn != self._drawn:
            self._drawn = drawn
            self._draw_box(region, session.region_is_on)

    def _draw_box(self, region: RegionOfInterest | None, is_on: bool) -> None:
        """Draw the box, and its handle where it is wanted."""
        if region is None or not self._handles.value:
            self._layer.remove(_HANDLE)
        if region is None:
            self._layer.remove(_BOX)
            return
        self._layer.lines(_BOX, region.edges(), REGION_ON if is_on else REGION_OFF)
        if self._handles.value:
            size = _HANDLE_SHARE * max(region.size_mm)
            self._layer.gizmo(
                _HANDLE, region.T_camera_box, self._preview, self._place, scale_mm=size
            )

    def _preview(self, T: np.ndarray) -> None:
        """Draw the box at T (4, 4) while its handle is dragged."""
        if self._region:
            moved = RegionOfInterest.placed(T, self._region.size_mm)
            self._layer.lines(_BOX, moved.edges(), REGION_ON)

    def _place(self, T: np.ndarray) -> None:
        """Request the region at T (4, 4), where its handle was dragged to."""
        if self._region:
            self._operator.set_region(RegionOfInterest.placed(T, self._region.size_mm))

    def _switch(self, on: bool) -> None:
        """Switch the region on or off; without one, take the automatic one."""
        if self._region is not None or not on:
            self._operator.switch_region(on)
        elif self._scan:
            self._operator.fit_region(self._scan)

    def _set_from_numbers(self, _: object) -> None:
        """Request the region of the numbers that were entered; nothing happens while they are no
        box."""
        try:
            region = RegionOfInterest(self._centre.value, self._size.value, self._turn.value)
        except InputError:
            return
        self._operator.set_region(region, bool(self._on.handle.value))
