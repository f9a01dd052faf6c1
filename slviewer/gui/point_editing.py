"""Selecting points of a scan in the 3D view, and deleting them so that they can be brought back."""

import threading
from collections.abc import Callable

import numpy as np
import viser

from slviewer.errors import InputError
from slviewer.gui.inputs import change
from slviewer.gui.panel import PanelContext
from slviewer.gui.widgets import Text, coloured, paragraph
from slviewer.pipeline.edit import SUPPORT
from slviewer.surface.selection import (
    SupportPlane,
    ViewCamera,
    select_connected,
    select_in_outline,
    select_support,
)
from slviewer.wizard.result_views import ScanCloud, nearest
from slviewer.wizard.snapshot import ScanView

OFF, RECTANGLE, LASSO, PART = "off", "rectangle", "lasso", "connected part"
_HINTS = {
    OFF: "",
    RECTANGLE: "Drag a rectangle over the points. To turn the view, choose “off”.",
    LASSO: "Click around the points, then Close outline.",
    PART: "Click a part of the surface.",
}
SELECTED = (225, 40, 120)
SHOWN_EDITS = 6
"""The last ones are listed; the report lists all."""
_SELECTION, _OUTLINE = "selection", "outline"


class PointEditing:
    """Inputs that select, hide and delete points of the scan that is shown, in a layer of the scene.

    ``redraw()`` is called when other points are to be shown; ``pick`` gets clicks while nothing is being selected.
    """

    def __init__(
        self,
        context: PanelContext,
        layer: str,
        redraw: Callable[[], None],
        pick: Callable[[np.ndarray, np.ndarray], None],
    ) -> None:
        self._context, self._layer, self._redraw, self._pick = context, layer, redraw, pick
        self._lock = threading.RLock()
        self._cloud: ScanCloud | None = None  # with the points that edits and region keep
        self._hidden: np.ndarray | None = None
        self._selected: np.ndarray | None = None
        self._what: list[str] = []
        self._plane: SupportPlane | None = None
        self._corners: list[tuple[float, float]] = []
        self._rays: list[np.ndarray] = []
        self._view: ViewCamera | None = None
        self._visible = False
        gui, operator = context.gui, context.operator
        with gui.add_folder("Edit points", expand_by_default=False):
            self._mode = gui.add_dropdown("Select by", (OFF, RECTANGLE, LASSO, PART))
            self._hint = Text(gui)
            self._close = context.button("Close outline", self._close_outline, viser.Icon.POLYGON, None, visible=False)
            context.button(
                "Select support", self._select_support, viser.Icon.TABLE,
                hint="The plane that the object stands on, and all below it",
            )  # fmt: skip
            context.button("Invert selection", self._invert, viser.Icon.SWITCH_HORIZONTAL)
            context.button("Select nothing", self._clear_selection, viser.Icon.X)
            self._status = Text(gui)
            self._hide = context.button("Hide selected", self._hide_selected, viser.Icon.EYE_OFF)
            self._show = context.button("Show hidden", self._show_hidden, viser.Icon.EYE, visible=False)
            self._delete = context.button(
                "Delete selected", self._delete_selected, viser.Icon.ERASER, "red",
                hint="The scan on disk stays as it is: Undo brings the points back",
            )  # fmt: skip
            self._undo = context.button(
                "Undo edit", lambda: operator.undo_edit(self._name), viser.Icon.ARROW_BACK_UP, "orange"
            )
            self._redo = context.button(
                "Redo edit", lambda: operator.redo_edit(self._name), viser.Icon.ARROW_FORWARD_UP
            )
            self._list = Text(gui)
        self._mode.on_update(context.callback(self._change_mode))
        self._draw_status()

    @property
    def _name(self) -> str:
        """The scan that is shown; empty where none is."""
        return "" if self._cloud is None else self._cloud.name

    @property
    def is_selecting(self) -> bool:
        """Whether clicks and drags select points."""
        return bool(self._mode.value != OFF)

    def set_cloud(self, cloud: ScanCloud | None) -> np.ndarray | None:
        """Set the scan that is shown, with NaN for what edits and region removed; returns the points (h, w, 3) to show,
        without hidden ones. What was selected or hidden stays for the same scan."""
        with self._lock:
            before, self._cloud = self._cloud, cloud
            same = before is not None and cloud is not None
            if not same or before.name != cloud.name or before.points.shape != cloud.points.shape:  # type: ignore[union-attr]
                self._hidden = None
                self._forget_selection()
            elif self._selected is not None:
                self._selected &= np.isfinite(cloud.points[..., 2])  # type: ignore[union-attr]
                self._plane = None  # other points may lie below it now
            self._draw_selection()
            return self._shown_points()

    def draw(self, scan: ScanView | None) -> None:
        """List the edits of the scan, and offer to undo and redo them."""
        change(self._undo, disabled=scan is None or not scan.edits)
        change(self._redo, disabled=scan is None or not scan.undone_edits)
        lines = [f"{i}. {words}" for i, words in enumerate(scan.edits, 1)] if scan else []
        self._list.set("".join(paragraph(coloured(line, "dim")) for line in lines[-SHOWN_EDITS:]))

    def show(self, visible: bool) -> None:
        """Take clicks and drags in the 3D view, or leave them."""
        self._visible = visible
        self._listen()

    # what is selected

    def _shown_points(self) -> np.ndarray | None:
        """Return the points (h, w, 3) that are shown, NaN elsewhere."""
        if self._cloud is None or self._hidden is None:
            return None if self._cloud is None else self._cloud.points
        return np.where(self._hidden[..., None], np.float32(np.nan), self._cloud.points)

    def _add(self, mask: np.ndarray, what: str, plane: SupportPlane | None = None) -> None:
        """Add pixels (h, w) to the selection, as far as their points are shown."""
        points = self._shown_points()
        if points is None:
            return
        first = self._selected is None
        shown = mask & np.isfinite(points[..., 2])
        self._selected = shown if self._selected is None else self._selected | shown
        self._plane = plane if first and self._hidden is None else None
        self._what = [*dict.fromkeys([*self._what, what])]
        self._draw_selection()

    def _forget_selection(self) -> None:
        """Select nothing, and forget the outline."""
        self._selected, self._what, self._plane = None, [], None
        self._forget_outline()

    def _forget_outline(self) -> None:
        """Forget the corners of the outline."""
        self._corners, self._rays, self._view = [], [], None
        self._context.scene.remove(self._layer, _OUTLINE)
        change(self._close, visible=False)

    def _draw_selection(self) -> None:
        """Draw the selected points over the others."""
        scene, points = self._context.scene, self._shown_points()
        if points is None or self._selected is None or not self._selected.any():
            scene.remove(self._layer, _SELECTION)
        else:
            chosen = np.where(self._selected[..., None], points, np.float32(np.nan))
            scene.cloud(self._layer, _SELECTION, chosen, SELECTED)
        self._draw_status()

    def _draw_status(self) -> None:
        """State how many points are selected, and offer what can be done with them."""
        points = self._shown_points()
        selected = 0 if self._selected is None else int(self._selected.sum())
        hidden = 0 if self._hidden is None else int((self._hidden & np.isfinite(self._cloud.points[..., 2])).sum())  # type: ignore[union-attr]
        total = 0 if points is None else int(np.isfinite(points[..., 2]).sum())
        text = f"{selected:,} of {total:,} points selected" + (f", {hidden:,} hidden" if hidden else "")
        self._status.set(paragraph(coloured(text, "plain" if selected else "dim")) if total else "")
        change(self._delete, disabled=not selected)
        change(self._hide, disabled=not selected)
        change(self._show, visible=bool(hidden))

    # the 3D view

    def _change_mode(self) -> None:
        """Take what the new way of selecting needs."""
        with self._lock:
            self._forget_outline()
            self._hint.write(_HINTS[self._mode.value], "dim")
        self._listen()

    def _listen(self) -> None:
        """Take the clicks or drags that the way of selecting needs."""
        scene, mode = self._context.scene, self._mode.value
        rectangles = self._visible and mode == RECTANGLE
        scene.on_rectangle(self._take_rectangle if rectangles else None)
        if mode == LASSO:
            scene.on_view_click(self._take_corner if self._visible else None)
        else:
            scene.on_pick(None if rectangles or not self._visible else self._take_click)

    def _take_click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Select the part that a ray meets, or pass the click on."""
        if self._mode.value != PART:
            self._pick(origin, direction)
            return
        with self._lock:
            points = self._shown_points()
            pixel = None if points is None else nearest(points, origin, direction)
            if points is not None and pixel is not None:
                self._add(select_connected(points, (pixel[1], pixel[0])), PART)

    def _take_rectangle(self, view: ViewCamera, low: np.ndarray, high: np.ndarray) -> None:
        """Select what a rectangle, from its lowest to its highest corner (2,), holds in a view."""
        with self._lock:
            points = self._shown_points()
            if points is not None:
                corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
                self._add(select_in_outline(points, view, corners), RECTANGLE)

    def _take_corner(self, view: ViewCamera, at: np.ndarray, ray: np.ndarray) -> None:
        """Add a corner of the outline, at (2,) in a view along a ray (3,); begin again where the view has moved."""
        with self._lock:
            if self._view is not None and not self._view.is_near(view):
                self._forget_outline()
                self._context.notify("info", "The view has moved: the outline begins again")
            points = self._shown_points()
            if points is None:
                return
            self._view = view
            self._corners.append((float(at[0]), float(at[1])))
            # drawn before the points, so that it stays visible
            away = 0.5 * float(np.nanmin(np.linalg.norm(points - view.position, axis=-1)))
            self._rays.append(view.position + away * ray / np.linalg.norm(ray))
            ends = np.array(self._rays)
            segments = np.stack([ends, np.roll(ends, -1, axis=0)], axis=1)
            self._context.scene.lines(self._layer, _OUTLINE, segments, SELECTED)
            change(self._close, visible=True, disabled=len(self._corners) < 3)

    def _close_outline(self) -> None:
        """Select what the outline holds."""
        with self._lock:
            points = self._shown_points()
            if points is None or self._view is None:
                return
            mask = select_in_outline(points, self._view, self._corners)
            self._forget_outline()
            self._add(mask, LASSO)

    # the buttons

    def _require_cloud(self) -> ScanCloud:
        """Return the scan that is shown; InputError where none is."""
        if self._cloud is None:
            raise InputError("no scan is shown: reconstruct one first")
        return self._cloud

    def _select_support(self) -> None:
        """Select the plane that the object stands on, and all below it."""
        with self._lock:
            cloud, points = self._require_cloud(), self._shown_points()
            assert points is not None
            plane, selected = select_support(points, cloud.sigma_z)
            self._add(selected, SUPPORT, plane)

    def _invert(self) -> None:
        """Select what was not selected, of the points that are shown."""
        with self._lock:
            self._require_cloud()
            points = self._shown_points()
            assert points is not None
            selected = np.zeros(points.shape[:2], bool) if self._selected is None else self._selected
            self._selected, self._plane = np.isfinite(points[..., 2]) & ~selected, None
            self._what = [f"all but {' and '.join(self._what)}"] if self._what else ["everything"]
            self._draw_selection()

    def _clear_selection(self) -> None:
        """Select nothing."""
        with self._lock:
            self._forget_selection()
            self._draw_selection()

    def _hide_selected(self) -> None:
        """Hide the selected points in this view; they are still used."""
        with self._lock:
            if self._selected is not None:
                self._hidden = self._selected if self._hidden is None else self._hidden | self._selected
            self._forget_selection()
            self._draw_selection()
        self._redraw()

    def _show_hidden(self) -> None:
        """Show the hidden points again."""
        with self._lock:
            self._hidden = None
            self._draw_selection()
        self._redraw()

    def _delete_selected(self) -> None:
        """Request that the selected points be deleted."""
        with self._lock:
            cloud, selected = self._require_cloud(), self._selected
            if selected is None or not selected.any():
                raise InputError("no point is selected: select some first")
            what, plane = " and ".join(self._what), self._plane
            if self._context.operator.delete_points(cloud.name, cloud.points, selected, what, plane):
                self._forget_selection()
                self._draw_selection()
