"""Selecting points of a scan in the 3D view, and deleting them so that they can be brought back."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import viser

from slviewer.errors import InputError
from slviewer.evaluation.render import format_count
from slviewer.gui.inputs import change
from slviewer.gui.panel import PanelContext
from slviewer.gui.widgets import Text, coloured, paragraph
from slviewer.pipeline.edit import SUPPORT, Selection
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


@dataclass(eq=False)
class _EditedScan:
    """A scan that is shown, at ``T`` (4, 4) mm of the 3D view: its cloud with NaN for what edits
    and region removed, its points (h, w, 3) mm in the view's frame, and masks (h, w) of those that
    are hidden and selected.

    ``plane``: what the selection is everything below of, where it is.
    """

    cloud: ScanCloud
    T: np.ndarray
    points: np.ndarray
    hidden: np.ndarray
    selected: np.ndarray
    plane: SupportPlane | None = None

    @classmethod
    def at(cls, cloud: ScanCloud, T: np.ndarray | None) -> "_EditedScan":
        """Return the scan of a cloud at T (4, 4); None: in its own frame."""
        pose = np.eye(4) if T is None else T
        points = (
            cloud.points
            if T is None
            else (cloud.points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        )
        none = np.zeros(cloud.points.shape[:2], bool)
        return cls(cloud, pose, points, none, none.copy())

    @property
    def shown(self) -> np.ndarray:
        """Mask (h, w) of the points that are shown."""
        return np.asarray(np.isfinite(self.points[..., 2]) & ~self.hidden)

    @property
    def shown_points(self) -> np.ndarray:
        """The points (h, w, 3) mm in the view's frame, NaN where they are not shown."""
        return (
            np.where(self.hidden[..., None], np.float32(np.nan), self.points)
            if self.hidden.any()
            else self.points
        )

    def update(self, other: "_EditedScan") -> bool:
        """Take over what was hidden and selected of the same scan before; returns whether it is the
        same."""
        if other.cloud.name != self.cloud.name or other.points.shape != self.points.shape:
            return False
        # no plane: others may lie below it now
        self.hidden, self.selected = (
            other.hidden,
            other.selected & self.shown,
        )
        return True


class PointEditing:
    """Inputs that select, hide and delete points of the scans that are shown, drawn in a layer of
    the scene.

    ``redraw()`` is called when other points are to be shown; ``pick`` gets clicks while nothing is
    being selected.
    """

    def __init__(
        self,
        context: PanelContext,
        layer: str,
        redraw: Callable[[], None],
        pick: Callable[[np.ndarray, np.ndarray], None] | None = None,
    ) -> None:
        self._context, self._layer, self._redraw, self._pick = context, layer, redraw, pick
        self._lock = threading.RLock()
        self._scans: list[_EditedScan] = []
        self._what: list[str] = []
        self._corners: list[tuple[float, float]] = []
        self._rays: list[np.ndarray] = []
        self._view: ViewCamera | None = None
        self._visible = False
        gui, operator = context.gui, context.operator
        with gui.add_folder("Edit points", expand_by_default=False) as self._folder:
            self._mode = gui.add_dropdown("Select by", (OFF, RECTANGLE, LASSO, PART))
            self._hint = Text(gui)
            self._close = context.button(
                "Close outline", self._close_outline, viser.Icon.POLYGON, None, visible=False
            )
            context.button(
                "Select support", self._select_support, viser.Icon.TABLE,
                hint="The plane that the object stands on, and all below it",
            )  # fmt: skip
            context.button("Invert selection", self._invert, viser.Icon.SWITCH_HORIZONTAL)
            context.button("Select nothing", self._clear_selection, viser.Icon.X)
            self._status = Text(gui)
            self._hide = context.button("Hide selected", self._hide_selected, viser.Icon.EYE_OFF)
            self._show = context.button(
                "Show hidden", self._show_hidden, viser.Icon.EYE, visible=False
            )
            self._delete = context.button(
                "Delete selected", self._delete_selected, viser.Icon.ERASER, "red",
                hint="The scan on disk stays as it is: Undo brings the points back",
            )  # fmt: skip
            self._undo = context.button(
                "Undo edit",
                lambda: operator.undo_edit(*self._names),
                viser.Icon.ARROW_BACK_UP,
                "orange",
            )
            self._redo = context.button(
                "Redo edit", lambda: operator.redo_edit(*self._names), viser.Icon.ARROW_FORWARD_UP
            )
            self._list = Text(gui)
        self._mode.on_update(context.callback(self._change_mode))
        self._draw_status()

    @property
    def _names(self) -> list[str]:
        """The scans that are shown."""
        return [scan.cloud.name for scan in self._scans]

    def set_scans(self, scans: Sequence[tuple[ScanCloud, np.ndarray | None]]) -> list[np.ndarray]:
        """Set the scans that are shown, with NaN for what edits and region removed, at T (4, 4)
        each (None: in its own frame); returns the points (h, w, 3) mm to show of each, without
        hidden ones.

        What was selected or hidden stays for the same scans.
        """
        with self._lock:
            before, self._scans = self._scans, [_EditedScan.at(cloud, T) for cloud, T in scans]
            same = len(before) == len(self._scans)
            if not (
                same and all(now.update(old) for now, old in zip(self._scans, before, strict=True))
            ):
                for scan in self._scans:
                    scan.hidden[:] = scan.selected[:] = False
                self._forget_selection()
            self._draw_selection()
            return [scan.shown_points for scan in self._scans]

    def draw(self, scans: Sequence[ScanView]) -> None:
        """List the edits of scans, and offer to undo and redo them; without scans nothing is
        offered."""
        change(self._folder, visible=bool(scans))
        change(self._undo, disabled=not any(scan.edits for scan in scans))
        change(self._redo, disabled=not any(scan.undone_edits for scan in scans))
        titles = ["" if len(scans) == 1 else f"{scan.label}, " for scan in scans]
        lines = [
            f"{title}{i}. {words}"
            for title, scan in zip(titles, scans, strict=True)
            for i, words in enumerate(scan.edits, 1)
        ]
        self._list.set("".join(paragraph(coloured(line, "dim")) for line in lines[-SHOWN_EDITS:]))

    def show(self, visible: bool) -> None:
        """Take clicks and drags in the 3D view, or leave them."""
        if visible != self._visible:  # otherwise they may be another step's
            self._visible = visible
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

    def _forget_selection(self) -> None:
        """Select nothing, and forget the outline."""
        for scan in self._scans:
            scan.selected = np.zeros_like(scan.selected)
            scan.plane = None
        self._what = []
        self._forget_outline()

    def _forget_outline(self) -> None:
        """Forget the corners of the outline."""
        self._corners, self._rays, self._view = [], [], None
        self._context.scene.remove(self._layer, _OUTLINE)
        self._hint.write(_HINTS[self._mode.value], "dim")
        change(self._close, visible=False)

    def _draw_selection(self) -> None:
        """Draw the selected points over the others."""
        scene = self._context.scene
        chosen = [scan.points[scan.selected] for scan in self._scans]
        if any(map(len, chosen)):
            scene.cloud(self._layer, _SELECTION, np.concatenate(chosen), SELECTED)
        else:
            scene.remove(self._layer, _SELECTION)
        self._draw_status()

    def _draw_status(self) -> None:
        """State how many points are selected, and offer what can be done with them."""
        selected = sum(int(scan.selected.sum()) for scan in self._scans)
        total = sum(int(scan.shown.sum()) for scan in self._scans)
        hidden = sum(
            int((scan.hidden & np.isfinite(scan.points[..., 2])).sum()) for scan in self._scans
        )
        text = f"{selected:,} of {total:,} points selected" + (
            f", {hidden:,} hidden" if hidden else ""
        )
        self._status.set(paragraph(coloured(text, "plain" if selected else "dim")) if total else "")
        change(self._delete, disabled=not selected)
        change(self._hide, disabled=not selected)
        change(self._show, visible=bool(hidden))

    # the 3D view

    def _change_mode(self) -> None:
        """Take what the new way of selecting needs, then show its hint."""
        self._listen()
        with self._lock:
            self._forget_outline()

    def _listen(self) -> None:
        """Take the clicks or drags that the way of selecting needs."""
        scene, mode = self._context.scene, self._mode.value
        rectangles = self._visible and mode == RECTANGLE
        scene.on_rectangle(self._take_rectangle if rectangles else None)
        if mode == LASSO:
            scene.on_view_click(self._take_corner if self._visible else None)
        else:
            wanted = self._visible and (mode == PART or (mode == OFF and self._pick is not None))
            scene.on_pick(self._take_click if wanted else None)

    def _take_click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Select the part that a ray meets, or pass the click on."""
        if self._mode.value != PART:
            if self._pick is not None:
                self._pick(origin, direction)
            return
        with self._lock:
            met = []
            for i, scan in enumerate(self._scans):
                pixel = nearest(scan.shown_points, origin, direction)
                if pixel is not None:
                    met.append((float((scan.points[pixel] - origin) @ direction), i, pixel))
            if met:
                _, i, (v, u) = min(met)
                masks = [np.zeros_like(scan.selected) for scan in self._scans]
                masks[i] = select_connected(self._scans[i].shown_points, (u, v))
                self._add(masks, PART)

    def _select_outline(self, view: ViewCamera, corners: np.ndarray, what: str) -> None:
        """Select what an outline (n, 2) holds in a view."""
        self._add([select_in_outline(scan.points, view, corners) for scan in self._scans], what)

    def _take_rectangle(self, view: ViewCamera, low: np.ndarray, high: np.ndarray) -> None:
        """Select what a rectangle, from its lowest to its highest corner (2,), holds in a view."""
        with self._lock:
            self._select_outline(
                view, np.array([low, [high[0], low[1]], high, [low[0], high[1]]]), RECTANGLE
            )

    def _take_corner(self, view: ViewCamera, at: np.ndarray, ray: np.ndarray) -> None:
        """Add a corner of the outline, at (2,) in a view along a ray (3,); begin again where the
        view has moved."""
        with self._lock:
            if self._view is not None and not self._view.is_near(view):
                self._forget_outline()
                self._context.notify("info", "The view has moved: the outline begins again")
            if not self._scans:
                return
            self._view = view
            self._corners.append((float(at[0]), float(at[1])))
            # drawn before the points, so that it stays visible
            away = 0.5 * min(
                float(np.nanmin(np.linalg.norm(s.points - view.position, axis=-1)))
                for s in self._scans
            )
            self._rays.append(view.position + away * ray / np.linalg.norm(ray))
            ends = np.array(self._rays)
            segments = np.stack([ends, np.roll(ends, -1, axis=0)], axis=1)
            self._context.scene.lines(self._layer, _OUTLINE, segments, SELECTED)
            count = format_count(len(self._corners), "corner")
            self._hint.write(f"{_HINTS[LASSO]} {count} set.", "dim")
            change(self._close, visible=True, disabled=len(self._corners) < 3)

    def _close_outline(self) -> None:
        """Select what the outline holds."""
        with self._lock:
            if self._scans and self._view is not None:
                view, corners = self._view, np.array(self._corners)
                self._forget_outline()
                self._select_outline(view, corners, LASSO)

    # the buttons

    def _require_scans(self) -> list[_EditedScan]:
        """Return the scans that are shown; InputError where none is."""
        if not self._scans:
            raise InputError("no scan is shown: reconstruct one first")
        return self._scans

    def _select_support(self) -> None:
        """Select the plane that the object stands on, and all below it, in each scan."""
        with self._lock:
            supports = []
            for scan in self._require_scans():
                visible = np.where(scan.shown[..., None], scan.cloud.points, np.float32(np.nan))
                supports.append(select_support(visible, scan.cloud.sigma_z))
            self._add([mask for _, mask in supports], SUPPORT, [plane for plane, _ in supports])

    def _invert(self) -> None:
        """Select what was not selected, of the points that are shown."""
        with self._lock:
            for scan in self._require_scans():
                scan.selected, scan.plane = scan.shown & ~scan.selected, None
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
            for scan in self._scans:
                scan.hidden = scan.hidden | scan.selected
            self._forget_selection()
            self._draw_selection()
        self._redraw()

    def _show_hidden(self) -> None:
        """Show the hidden points again."""
        with self._lock:
            for scan in self._scans:
                scan.hidden = np.zeros_like(scan.hidden)
            self._draw_selection()
        self._redraw()

    def _delete_selected(self) -> None:
        """Request that the selected points be deleted."""
        with self._lock:
            selections = [
                Selection(scan.cloud.name, scan.cloud.points, scan.selected, scan.plane)
                for scan in self._require_scans()
            ]
            if not any(each.selected.any() for each in selections):
                raise InputError("no point is selected: select some first")
            if self._context.operator.delete_points(selections, " and ".join(self._what)):
                self._forget_selection()
                self._draw_selection()
