"""Step 7: choose scans, the reference and the initial alignment; merge, and compare before with
after."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import viser

from slviewer.gui.inputs import Choice, change, display_name, scan_options
from slviewer.gui.merge_html import merge_failure_html, merge_html, turntable_html
from slviewer.gui.merge_picking import PointPicker
from slviewer.gui.merge_views import (
    AFTER,
    BEFORE,
    MERGED,
    SHOWN,
    ColouredClouds,
    colour_merge,
    colour_scans,
)
from slviewer.gui.panel import PanelContext, StepPanel
from slviewer.gui.point_editing import PointEditing
from slviewer.gui.steps.verify import shape_of
from slviewer.gui.widgets import Text
from slviewer.pipeline.merge import StartKind
from slviewer.pipeline.stored_records import Stored
from slviewer.records.merge import Merge
from slviewer.wizard.snapshot import ScanView, SessionView, Snapshot

LAYER, EDITS = "merge", "merge edits"
FEATURES, MARKERS, PLACED, TURNTABLE = "features", "markers", "places while scanning", "turntable"
CURRENT, PICKED = "current position", "picked points"
STARTS: dict[str, StartKind] = {
    FEATURES: "features",
    MARKERS: "markers",
    PLACED: "placed",
    TURNTABLE: "turntable",
    CURRENT: "identity",
    PICKED: "features",
}
"""Initial alignments by what they are called here; picked points take the place of features."""
SIDE_BY_SIDE = "side by side, to pick"
_START_NOTES = {
    MARKERS: (
        "For coded markers on or beside the object, three or more in common: slviewer target"
        " markers:0-23:20 draws them."
    ),
    CURRENT: "For scans between which neither the object nor the camera moved, or hardly.",
}


class MergePanel(StepPanel):
    """Panel of the step Merge."""

    key = "merge"

    def __init__(self, context: PanelContext) -> None:
        super().__init__(context)
        self._boxes: dict[str, viser.GuiCheckboxHandle] = {}
        self._picker = PointPicker(context, self._painter, self._refresh)
        self._merged: int | None = None
        self._clouds: ColouredClouds | None = None
        self._layer_shown: bool | None = None
        self._is_start_chosen = False

    def build(self) -> None:
        """Create the inputs of scans, alignment and view."""
        gui, context, operator = self._gui, self._context, self._operator
        with gui.add_folder("Scans") as self._scans_folder:
            self._none = Text(gui)
        with gui.add_folder("Alignment", visible=False) as self._alignment_folder:
            self._reference = Choice(gui, "Reference", "The other scans are moved to it")
            self._reference.on_change(context.callback(self._refresh))
            self._start: Any = gui.add_dropdown(
                "Start from", tuple(STARTS), hint="Initial alignment, which is then refined"
            )
            self._start.on_update(context.callback(self._change_start))
            self._start.on_update(context.callback(self._keep_start, by_user=True))
            self._angle: Any = gui.add_number(
                "Angle, °",
                30.0,
                min=1.0,
                max=180.0,
                step=0.5,
                hint="Of the turntable, from each scan to the next",
            )
            self._angle.on_update(context.callback(self._refresh))
            self._start_note = Text(gui)
            self._picker.build()
            self._merge = context.button(
                "Merge", self._request_merge, viser.Icon.LAYERS_INTERSECT, None
            )
            self._failure = Text(gui)
        self._result = Text(gui)
        self._undo = context.button(
            "Undo merge", operator.undo_merge, viser.Icon.ARROW_BACK_UP, "orange", visible=False
        )
        self._view = Choice(gui, "3D view")
        self._view.on_change(context.callback(self._refresh))
        self._legend = Text(gui)
        context.view_button(self._get_shown_points)
        self._editing = PointEditing(context, EDITS, self._redraw)

    def draw(self, snapshot: Snapshot) -> None:
        """Show the scans and the merge of a snapshot."""
        with self._lock:
            self._snapshot = snapshot
            session = snapshot.session
            scans = _list_mergeable(session)
            self._draw_boxes(scans)
            merge = session.merge if session else None
            preferred = merge.record.reference if merge else scans[-1].name if scans else ""
            self._reference.offer(scan_options(scans), preferred)
            change(self._alignment_folder, visible=len(scans) > 1)
            change(self._undo, visible=merge is not None)
            labels = {scan.name: scan.label for scan in scans}
            self._result.set(merge_html(merge, labels) if merge else "")
            failure = snapshot.merge_failure
            self._failure.set(
                merge_failure_html(failure, labels, merge, snapshot.merge_refusal)
                if failure
                else ""
            )
            self._offer_views(merge)
            self._propose_start(scans)
            number = int(merge.name) if merge is not None else 0
            if self._merged is not None and number > self._merged:
                self._view.choose(AFTER)  # show what was just merged
            self._merged = number
            self._refresh()

    def show(self, visible: bool) -> None:
        """Show or hide the panel's layers."""
        with self._lock:
            self._visible = visible
            self._show_layers()

    # drawing

    def _draw_boxes(self, scans: list[ScanView]) -> None:
        """Update the check boxes, one per scan."""
        names, labels = [scan.name for scan in scans], [scan.label for scan in scans]
        self._none.write(
            "" if scans else "No reconstructed scan yet: capture two or more in the step Scan.",
            "warning",
        )
        for name in [name for name in self._boxes if name not in names]:
            self._boxes.pop(name).remove()
        for scan in scans:
            label = (
                scan.label if labels.count(scan.label) == 1 else display_name(scan.name, scan.label)
            )
            if scan.name not in self._boxes:
                with self._scans_folder:
                    box = self._gui.add_checkbox(label, True)
                box.on_update(self._context.callback(self._refresh))
                self._boxes[scan.name] = box
            change(self._boxes[scan.name], label=label)

    def _offer_views(self, merge: Stored[Merge] | None) -> None:
        """Offer the 3D views: before and after the merge, merged, or side by side to pick
        points."""
        views = [BEFORE] if merge is None else [AFTER, BEFORE, *MERGED]
        if self._start.value == PICKED:
            views.append(SIDE_BY_SIDE)
        self._view.offer([(view, view) for view in views])
        self._view.set_visible(len(views) > 1)

    def _keep_start(self) -> None:
        """Keep the operator's choice of the initial alignment."""
        self._is_start_chosen = True

    def _propose_start(self, scans: list[ScanView]) -> None:
        """Choose the initial alignment that the chosen scans bring along, unless the operator chose
        one."""
        if self._is_start_chosen:
            return
        names = set(self._list_chosen())
        chosen = [scan for scan in scans if scan.name in names]
        if not chosen:
            return
        turned = self._get_stored_angles([scan.name for scan in chosen]) is not None
        placed = all(scan.is_placed for scan in chosen)
        start = TURNTABLE if turned else PLACED if placed else FEATURES
        if self._start.value != start:
            self._start.value = start

    def _change_start(self) -> None:
        """Update the views for another initial alignment; picked points are shown side by side."""
        with self._lock:
            self._offer_views(self._session.merge if self._session else None)
            if self._start.value == PICKED:
                self._view.choose(SIDE_BY_SIDE)
            self._refresh()

    def _list_chosen(self) -> list[str]:
        """List the scans to merge, with the reference, in the order of their capture."""
        scans = _list_mergeable(self._session)
        boxes, reference = self._boxes, self._reference.value
        return [
            s.name
            for s in scans
            if s.name == reference or (s.name in boxes and boxes[s.name].value)
        ]

    def _get_stored_angles(self, names: list[str]) -> list[float] | None:
        """Return the angles, deg, that are stored with scans of one turn; None where they are of
        several or of none."""
        scans = {scan.name: scan for scan in self._session.scans} if self._session else {}
        steps = [step for name in names if (step := scans[name].turn_step) is not None]
        same = len(steps) == len(names) and len({step.turn for step in steps}) == 1
        return [step.deg for step in steps] if same else None

    def _get_shown_points(self) -> np.ndarray | None:
        """Return the shown points (n, 3) mm; None where none are."""
        if self._is_picking:
            return self._picker.points
        return None if self._clouds is None else self._clouds.points

    @property
    def _is_picking(self) -> bool:
        """Whether points are picked on two scans side by side."""
        return bool(self._start.value == PICKED and self._view.value == SIDE_BY_SIDE)

    def _refresh(self) -> None:
        """Update inputs and notes for the current choice, and request the clouds."""
        with self._lock:
            snapshot, session = self._snapshot, self._session
            if snapshot is None or session is None:
                return
            names, start = self._list_chosen(), self._start.value
            versions = {
                scan.name: (scan.figures.points, scan.figures.model, session.restriction(scan.name))
                for scan in session.scans
                if scan.cloud != "absent"
            }
            labels = {scan.name: scan.label for scan in session.scans}
            self._draw_start(names, labels)
            chosen = {name: versions[name] for name in names}
            self._picker.offer(chosen, self._reference.value, labels, start == PICKED)
            ready = len(names) > 1 and (start != PICKED or self._picker.is_ready)
            change(
                self._merge,
                label=f"Merge {len(names)} scans",
                disabled=snapshot.is_busy or not ready,
            )
            shown = self._list_shown(session, names, versions)
            editable = self._view.value not in MERGED and not self._is_picking
            self._editing.draw(
                [scan for scan in session.scans if scan.name in shown] if editable else []
            )
            self._show_layers()
            if not self._is_picking:
                self._request_clouds(session, names, versions, labels)

    def _draw_start(self, names: list[str], labels: dict[str, str]) -> None:
        """Show the angles or the note of the chosen initial alignment."""
        start, stored = self._start.value, self._get_stored_angles(names)
        change(self._angle, visible=start == TURNTABLE and stored is None)
        if start == TURNTABLE:
            given = [k * float(self._angle.value) for k in range(len(names))]
            self._start_note.set(turntable_html(names, given if stored is None else stored, labels))
        else:
            self._start_note.write(_START_NOTES.get(start, ""), "dim")

    def _request_clouds(
        self,
        session: SessionView,
        names: list[str],
        versions: Mapping[str, Any],
        labels: dict[str, str],
    ) -> None:
        """Request the clouds of the chosen view."""
        merge, view, context = session.merge, self._view.value, self._context
        shown = self._list_shown(session, names, versions)
        poses = (
            {n: np.array(p.T_reference_scan) for n, p in merge.record.pairs.items()}
            if merge is not None and view == AFTER
            else {}
        )
        key = (
            view,
            merge.name if merge else "",
            tuple((name, versions[name], labels[name]) for name in shown),
            tuple((name, T.tobytes()) for name, T in poses.items()),
        )

        def make() -> ColouredClouds:
            """Load and colour the merged surface or the scans."""
            if merge is not None and view in MERGED:
                return colour_merge(
                    context.session,
                    merge.name,
                    view,
                    [labels.get(name, name) for name in merge.record.scans],
                )
            return colour_scans(context.session, shown, poses, labels)

        self._painter.request("clouds", key, make, self._draw_clouds)

    def _list_shown(
        self, session: SessionView, names: list[str], versions: Mapping[str, Any]
    ) -> list[str]:
        """List the scans in the 3D view: those of the merge, else those to merge."""
        return [
            name
            for name in (session.merge.record.scans if session.merge is not None else names)
            if name in versions
        ]

    def _redraw(self) -> None:
        """Draw the clouds again, as other points of them are hidden."""
        if self._clouds is not None:
            self._draw_clouds(self._clouds)

    def _draw_clouds(self, clouds: ColouredClouds) -> None:
        """Draw the loaded clouds, and remove others."""
        for name in set(self._scene.names(LAYER)) - set(clouds.clouds):
            self._scene.remove(LAYER, name)
        shown = self._editing.set_scans(clouds.scans) or [
            points for points, _ in clouds.clouds.values()
        ]
        for points, (name, (_, painted)) in zip(shown, clouds.clouds.items(), strict=True):
            self._scene.cloud(LAYER, name, points, painted, SHOWN)
        with self._lock:
            self._clouds = clouds
            self._show_layers()

    def _show_layers(self) -> None:
        """Show the clouds, or the two scans to pick on, with their legend."""
        picking = self._is_picking
        shown = self._visible and not picking
        if self._layer_shown != shown:
            self._layer_shown = shown
            for layer in (LAYER, EDITS):
                self._scene.show(layer, shown)
        if picking:  # the one that stops taking clicks comes first
            self._editing.show(False)
        self._picker.show(self._visible and picking)
        self._editing.show(shown)
        self._legend.set("" if picking or self._clouds is None else self._clouds.legend)
        if shown and self._clouds is not None:
            self._context.viewpoints.show(f"{LAYER} {self._clouds.view}", self._clouds.points)

    def _request_merge(self) -> None:
        """Request the merge of the chosen scans by the chosen initial alignment."""
        start, names = self._start.value, self._list_chosen()
        needs_angle = start == TURNTABLE and self._get_stored_angles(names) is None
        self._operator.merge(
            names,
            self._reference.value,
            start=STARTS[start],
            angle=float(self._angle.value) if needs_angle else None,
            picked=self._picker.picked() if start == PICKED else None,
        )


def _list_mergeable(session: SessionView | None) -> list[ScanView]:
    """List the reconstructed scans of objects, without captured planes and spheres."""
    scans = session.scans if session else ()
    return [scan for scan in scans if scan.cloud != "absent" and shape_of(scan) == "scan"]
