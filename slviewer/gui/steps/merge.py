"""Step 7: choose scans, the reference and the initial alignment; merge, and compare before with
after."""

import viser

from slviewer.gui.colouring import ALIGNED_COLOURINGS, DISTANCE, MERGE_COLOURINGS
from slviewer.gui.merge_views import (
    AFTER,
    BEFORE,
    MERGED,
    SHOWN,
    ColouredClouds,
    PointPicker,
    colour_merge,
    colour_scans,
    merge_failure_html,
    merge_html,
    turntable_html,
)
from slviewer.gui.panel import (
    ReconstructAllButton,
    StepPanel,
    display_name,
    scan_labels,
    scan_options,
)
from slviewer.gui.point_editing import PointEditing
from slviewer.gui.widgets import Text
from slviewer.pipeline.merge import StartKind
from slviewer.records.record import format_count
from slviewer.wizard.snapshot import ScanView, SessionView

FEATURES, MARKERS, PLACED, TURNTABLE = "features", "markers", "places while scanning", "turntable"
CURRENT, PICKED, MACHINE = "current position", "picked points", "machine's poses"
KEPT = "machine's poses, kept"
STARTS: dict[str, StartKind] = {
    FEATURES: "features",
    MARKERS: "markers",
    PLACED: "placed",
    TURNTABLE: "turntable",
    CURRENT: "identity",
    MACHINE: "machine",
    KEPT: "machine",
    PICKED: "features",
}
"""Initial alignments by what they are called here; picked points take the place of features."""
SIDE_BY_SIDE = "side by side, to pick"
_START_NOTES = {
    MARKERS: (
        "For coded markers on or beside the object, three or more in common: slviewer target"
        " markers:0-23:20 draws them."
    ),
    KEPT: "The surfaces do not move the scans; where they place them elsewhere is stated.",
    CURRENT: "For scans between which neither the object nor the camera moved, or hardly.",
}


class MergePanel(StepPanel):
    """Panel of the step Merge."""

    key = "merge"

    _merged: int | None = None
    _clouds: ColouredClouds | None = None
    _is_start_chosen = False

    def build(self) -> None:
        """Create the inputs of scans, alignment and view."""
        gui, operator = self._gui, self._operator
        self._boxes: dict[str, viser.GuiCheckboxHandle] = {}
        self._view = self.choice("3D view")
        self._colour = self.choice("Colour")
        self._legend = Text(gui)
        self._result = Text(gui)
        with gui.add_folder("Scans") as self._scans_folder:
            self._none = Text(gui)
            ReconstructAllButton(self)
        with gui.add_folder("Alignment") as self._alignment_folder:
            self._reference = self.choice("Reference", "The other scans are moved to it")
            self._start = self.dropdown(
                "Start from", STARTS, "Initial alignment, which is then refined", self._change_start
            )
            self._angle = self.number(
                "Angle, °", 30.0, 1.0, 180.0, 0.5, "Of the turntable, from each scan to the next"
            )
            self._start_note = Text(gui)
            self._picker = PointPicker(self)
            self._merge = self.button("Merge", self._request_merge, "layers-intersect", None)
            self._failure = Text(gui)
        self._undo = self.button("Undo merge", operator.undo_merge, "arrow-back-up")
        self._editing = PointEditing(self, self._redraw)

    def draw(self) -> None:
        """Show the scans and the merge, and request the clouds of the chosen view."""
        session, merge, failure = self.session, self.session.merge, self.snapshot.merge_failure
        scans = _list_mergeable(session)
        self._draw_boxes(scans)
        preferred = merge.record.reference if merge else scans[-1].name if scans else ""
        self._reference.offer(scan_options(scans), preferred)
        self._alignment_folder.visible = len(scans) > 1
        self._undo.visible = merge is not None
        labels = scan_labels(session)
        self._result.set(merge_html(merge, labels) if merge else "")
        self._failure.set(
            merge_failure_html(failure, labels, merge, self.snapshot.merge_refusal)
            if failure
            else ""
        )
        self._propose_start()
        self._offer_views()
        number = int(merge.name) if merge else 0
        if self._merged is not None and number > self._merged:
            self._view.choose(MERGED)  # show what was just merged
            self._offer_colours()
            self._colour.choose(DISTANCE)
        self._merged = number
        self._offer_colours()
        self._draw_choice(labels)

    def show(self, visible: bool) -> None:
        """Show or hide the panel's layers."""
        super().show(visible)
        self._show_layers()

    # drawing

    def _draw_boxes(self, scans: list[ScanView]) -> None:
        """Update the check boxes, one per scan."""
        labels = [scan.label for scan in scans]
        recorded = self.session.pending_scans
        text = "No scan yet: capture two or more in the step Scan."
        if recorded:
            text = f"{format_count(len(recorded), 'scan')} not reconstructed yet."
        self._none.write(text if recorded or not scans else "", "warning")
        for name in self._boxes.keys() - {scan.name for scan in scans}:
            self._boxes.pop(name).remove()
        for scan in scans:
            label = scan.label
            if labels.count(label) > 1:
                label = display_name(scan.name, label)
            if scan.name not in self._boxes:
                with self._scans_folder:
                    self._boxes[scan.name] = self.checkbox(label, "Merge this scan", True)
            self._boxes[scan.name].label = label

    def _offer_views(self) -> None:
        """Offer the 3D views: before and after the merge, merged, or side by side to pick
        points."""
        views = [MERGED, AFTER, BEFORE] if self.session.merge else [BEFORE]
        if self._start.value == PICKED:
            views.append(SIDE_BY_SIDE)
        self._view.offer_names(views)
        self._view.handle.visible = len(views) > 1

    def _offer_colours(self) -> None:
        """Offer what can colour the points of the chosen view."""
        merged = self._view.value == MERGED
        self._colour.offer_names(MERGE_COLOURINGS if merged else ALIGNED_COLOURINGS)
        self._colour.handle.visible = not self._is_picking

    def _propose_start(self) -> None:
        """Choose the initial alignment that the chosen scans bring along, unless the operator chose
        one."""
        chosen = self._list_chosen()
        if self._is_start_chosen or not chosen:
            return
        turned = self._get_stored_angles(chosen) is not None
        placed = all(scan.is_placed for scan in chosen)
        self._start.value = TURNTABLE if turned else PLACED if placed else FEATURES

    def _change_start(self) -> None:
        """Keep the operator's choice of the initial alignment; points are picked side by side."""
        self._is_start_chosen = True
        self._offer_views()
        if self._start.value == PICKED:
            self._view.choose(SIDE_BY_SIDE)

    def _list_chosen(self) -> list[ScanView]:
        """List the scans to merge, with the reference, in the order of their capture."""
        boxes, reference = self._boxes, self._reference.value
        return [
            scan
            for scan in _list_mergeable(self.session)
            if scan.name == reference or (scan.name in boxes and boxes[scan.name].value)
        ]

    @staticmethod
    def _get_stored_angles(scans: list[ScanView]) -> list[float] | None:
        """Return the angles, deg, that are stored with scans of one turn; None where they are of
        several or of none."""
        steps = [scan.turn_step for scan in scans]
        turns = {step.turn if step else "" for step in steps}
        if len(turns) != 1 or "" in turns:
            return None
        return [step.deg for step in steps if step]

    @property
    def _is_picking(self) -> bool:
        """Whether points are picked on two scans side by side."""
        return bool(self._start.value == PICKED and self._view.value == SIDE_BY_SIDE)

    def _draw_choice(self, labels: dict[str, str]) -> None:
        """Update inputs and notes for the current choice, and request the clouds."""
        session = self.session
        scans, start = self._list_chosen(), self._start.value
        names = [scan.name for scan in scans]
        self._versions = {
            scan.name: (scan.figures.points, scan.figures.model, session.restriction(scan.name))
            for scan in session.scans
            if scan.cloud != "absent"
        }
        self._draw_start(scans, labels)
        chosen = {name: self._versions[name] for name in names}
        self._picker.offer(chosen, self._reference.value, labels, start == PICKED)
        ready = len(names) > 1 and (start != PICKED or self._picker.is_ready)
        self._merge.label = f"Merge {len(names)} scans"
        self._merge.disabled = self.snapshot.is_busy or not ready
        # those of the merge, else those to merge
        listed = session.merge.record.scans if session.merge else names
        shown = [
            scan for scan in session.scans if scan.name in self._versions and scan.name in listed
        ]
        editable = self._view.value != MERGED and not self._is_picking
        self._editing.offer(shown if editable else [])
        self._show_layers()
        if not self._is_picking:
            self._request_clouds([name for name in listed if name in self._versions], labels)

    def _draw_start(self, scans: list[ScanView], labels: dict[str, str]) -> None:
        """Show the angles or the note of the chosen initial alignment."""
        start, stored = self._start.value, self._get_stored_angles(scans)
        self._angle.visible = start == TURNTABLE and stored is None
        if start == TURNTABLE:
            angles = stored or [k * float(self._angle.value) for k in range(len(scans))]
            self._start_note.set(turntable_html([scan.name for scan in scans], angles, labels))
        else:
            self._start_note.write(_START_NOTES.get(start, ""), "dim")

    def _request_clouds(self, shown: list[str], labels: dict[str, str]) -> None:
        """Request the clouds of the chosen view: the merged surface, or these scans."""
        merge, view, context = self.session.merge, self._view.value, self.context
        colour = self._colour.value
        poses = merge.record.poses if merge and view == AFTER else {}
        key = (
            view,
            colour,
            merge.name if merge else "",
            tuple((name, self._versions[name], labels[name]) for name in shown),
            tuple((name, T.tobytes()) for name, T in poses.items()),
        )

        def make() -> ColouredClouds:
            """Load and colour the merged surface or the scans."""
            if merge and view == MERGED:
                titles = [labels.get(name, name) for name in merge.record.scans]
                return colour_merge(context.session, merge, colour, titles)
            return colour_scans(context.session, shown, poses, labels, colour)

        self.painter.request(self._draw_clouds, key, make)

    def _redraw(self) -> None:
        """Draw the clouds again, as other points of them are hidden."""
        if self._clouds:
            self._draw_clouds(self._clouds)

    def _draw_clouds(self, clouds: ColouredClouds) -> None:
        """Draw the loaded clouds, and remove others."""
        before = self._clouds.clouds if self._clouds else {}
        self.layer.remove(*(f"cloud {name}" for name in before.keys() - clouds.clouds.keys()))
        scans = [(scan, clouds.clouds[scan.name][0]) for scan in clouds.scans]
        shown = self._editing.set_scans(scans) or [points for points, _ in clouds.clouds.values()]
        labels = scan_labels(self.session)
        for points, (name, (_, painted)) in zip(shown, clouds.clouds.items(), strict=True):
            title = labels.get(name, name)
            self.layer.cloud(f"cloud {name}", points, painted, SHOWN, title)
        self._clouds = clouds
        self._show_layers()

    def _show_layers(self) -> None:
        """Show the clouds, or the two scans to pick on, with their legend."""
        picking = self._is_picking
        shown = self._visible and not picking
        self.layer.show(shown)
        if picking:  # the one that stops taking clicks comes first
            self._editing.show(False)
        self._picker.show(self._visible and picking)
        self._editing.show(shown)
        self._legend.set("" if picking or self._clouds is None else self._clouds.legend)
        if shown and self._clouds:
            self.show_points(self._clouds.view, self._clouds.points)

    def _request_merge(self) -> None:
        """Request the merge of the chosen scans by the chosen initial alignment."""
        start, scans = self._start.value, self._list_chosen()
        needs_angle = start == TURNTABLE and self._get_stored_angles(scans) is None
        self._operator.merge(
            [scan.name for scan in scans],
            self._reference.value,
            start=STARTS[start],
            fixed=start == KEPT,
            angle=float(self._angle.value) if needs_angle else None,
            picked=self._picker.picked() if start == PICKED else None,
        )


def _list_mergeable(session: SessionView) -> list[ScanView]:
    """List the reconstructed scans of objects, without captured planes and spheres."""
    return [scan for scan in session.scans if scan.cloud != "absent" and scan.shape == "scan"]
