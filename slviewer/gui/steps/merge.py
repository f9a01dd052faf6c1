"""Merge: choose scans, the one whose place the others take, and where to begin; see them before and after."""

import threading
from typing import Any

import numpy as np
import viser

from slviewer.gui.inputs import Choice, change, titled
from slviewer.gui.merge_picking import PickBox
from slviewer.gui.merge_views import AFTER, BEFORE, MERGED, Drawn, merged_drawn, scans_drawn
from slviewer.gui.merge_words import merge_words, refusal_words, turn_words
from slviewer.gui.panel import Stage
from slviewer.gui.pictures import Painter, opened
from slviewer.gui.steps.verify import likely
from slviewer.gui.widgets import Words
from slviewer.wizard.snapshot import MergeView, ScanView, SessionView, Snapshot

LAYER = "merge"
SHAPES, TURNTABLE, LYING, PICKED = "by their shapes", "on a turntable", "as they lie", "by points that I pick"
STARTS = (SHAPES, TURNTABLE, LYING, PICKED)
SIDE_BY_SIDE = "scan and reference side by side, to pick on"
_SAYS = {
    SHAPES: "",
    LYING: "Neither the object nor the camera was moved between the scans, or hardly; what is left is refined.",
}


class Panel:
    """The seventh step."""

    key = "merge"

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._painter = Painter(stage.failed)
        self._lock = threading.RLock()
        self._snapshot: Snapshot | None = None
        self._boxes: dict[str, viser.GuiCheckboxHandle] = {}
        self._picks = PickBox(stage, self._painter, self._refresh)
        self._merged: int | None = None
        self._drawn: Drawn | None = None
        self._visible = False
        self._shows: bool | None = None

    def build(self) -> None:
        gui, operator, safely = self._stage.gui, self._stage.operator, self._stage.safely
        with gui.add_folder("Scans to merge") as self._scans_folder:
            self._none = Words(gui)
        with gui.add_folder("Alignment", visible=False) as self._start_folder:
            self._reference = Choice(gui, "Reference", "The others are brought to its place")
            self._reference.on_change(safely(self._refresh))
            self._start = gui.add_dropdown("Begin", STARTS, hint="Alignment is refined from there in any case")
            self._start.on_update(safely(self._choose_start))
            hint = "By which the table turns from each scan to the next"
            self._angle: Any = gui.add_number("Angle, °", 30.0, min=1.0, max=180.0, step=0.5, hint=hint)
            self._angle.on_update(safely(self._refresh))
            self._start_says = Words(gui)
            self._picks.build()
            self._merge = gui.add_button("Merge", icon=viser.Icon.LAYERS_INTERSECT)
            self._merge.on_click(safely(self._ask_merge))
            self._refusal = Words(gui)
        self._result = Words(gui)
        self._undo = gui.add_button("Undo this merge", icon=viser.Icon.ARROW_BACK_UP, color="orange", visible=False)
        self._undo.on_click(safely(lambda: operator.undo_merge()))
        self._view = Choice(gui, "Show in 3D")
        self._view.on_change(safely(self._refresh))
        self._legend = Words(gui)
        self._stage.bring_button(lambda: self._seen)

    def draw(self, snapshot: Snapshot) -> None:
        with self._lock:
            self._snapshot = snapshot
            session = snapshot.session
            scans = mergeable(session) if session else []
            self._draw_boxes(scans)
            merge = session.merge if session else None
            preferred = merge.reference if merge else scans[-1].name if scans else ""
            self._reference.offer([(scan.name, titled(scan.name, scan.label)) for scan in scans], preferred)
            change(self._start_folder, visible=len(scans) > 1)
            change(self._undo, visible=merge is not None)
            labels = {scan.name: scan.label for scan in scans}
            self._result.set(merge_words(merge, labels) if merge else "")
            self._refusal.set(refusal_words(snapshot.not_merged, labels, merge) if snapshot.not_merged else "")
            self._offer_views(merge)
            number = int(merge.name) if merge is not None else 0
            if self._merged is not None and number > self._merged:
                self._view.choose(AFTER)  # just made: this is what the operator wants to see
            self._merged = number
            self._refresh()

    def shown(self, visible: bool) -> None:
        with self._lock:
            self._visible = visible
            self._show_layers()

    # drawing

    def _draw_boxes(self, scans: list[ScanView]) -> None:
        """One check box a scan, made and taken away as scans come and go."""
        gui, names = self._stage.gui, [scan.name for scan in scans]
        labels = [scan.label for scan in scans]
        self._none.say(
            "" if scans else "No scan is reconstructed yet: capture two or more in the step Scan.", "warning"
        )
        for name in [name for name in self._boxes if name not in names]:
            self._boxes.pop(name).remove()
        for scan in scans:
            label = scan.label if labels.count(scan.label) == 1 else titled(scan.name, scan.label)
            if scan.name not in self._boxes:
                with self._scans_folder:
                    box = gui.add_checkbox(label, True)
                box.on_update(self._stage.safely(self._refresh))
                self._boxes[scan.name] = box
            change(self._boxes[scan.name], label=label)

    def _offer_views(self, merge: MergeView | None) -> None:
        views = [BEFORE] if merge is None else [AFTER, BEFORE, *MERGED]
        if self._start.value == PICKED:
            views.append(SIDE_BY_SIDE)
        self._view.offer([(view, view) for view in views])
        self._view.show(len(views) > 1)

    def _choose_start(self) -> None:
        with self._lock:
            self._offer_views(self._snapshot.session.merge if self._snapshot and self._snapshot.session else None)
            if self._start.value == PICKED:
                self._view.choose(SIDE_BY_SIDE)
            self._refresh()

    def _chosen(self) -> list[str]:
        """The scans to merge with the reference, in the order in which they were taken."""
        scans = mergeable(self._snapshot.session) if self._snapshot and self._snapshot.session else []
        boxes, reference = self._boxes, self._reference.value
        return [s.name for s in scans if s.name == reference or (s.name in boxes and boxes[s.name].value)]

    @property
    def _seen(self) -> np.ndarray | None:
        if self._picking:
            return self._picks.seen
        return None if self._drawn is None else self._drawn.points

    @property
    def _picking(self) -> bool:
        return self._start.value == PICKED and self._view.value == SIDE_BY_SIDE

    def _refresh(self) -> None:
        """Offer what can be merged now, and ask for the clouds."""
        with self._lock:
            snapshot = self._snapshot
            session = snapshot.session if snapshot else None
            if snapshot is None or session is None:
                return
            names, start = self._chosen(), self._start.value
            made = {scan.name: (scan.points, scan.model) for scan in session.scans if scan.cloud != "absent"}
            labels = {scan.name: scan.label for scan in session.scans}
            change(self._angle, visible=start == TURNTABLE)
            self._start_says.set(turn_words(names, float(self._angle.value), labels) if start == TURNTABLE else "")
            if start in _SAYS:
                self._start_says.say(_SAYS[start], "dim")
            versions = {name: made[name] for name in names}
            self._picks.offer(versions, self._reference.value, labels, start == PICKED)
            busy = snapshot.job is not None and not snapshot.job.background
            ready = len(names) > 1 and (start != PICKED or self._picks.ready)
            change(self._merge, label=f"Merge {len(names)} scans", disabled=busy or not ready)
            self._show_layers()
            if not self._picking:
                self._ask_clouds(session, names, made, labels)

    def _ask_clouds(
        self, session: SessionView, names: list[str], made: dict[str, tuple[int, str]], labels: dict[str, str]
    ) -> None:
        merge, view, operator = session.merge, self._view.value, self._stage.operator
        shown = [name for name in (merge.scans if merge is not None else names) if name in made]
        places = {name: pair[2] for name, pair in merge.pairs.items()} if merge is not None and view == AFTER else {}
        key = (
            view,
            merge.name if merge else "",
            tuple((name, made[name], labels[name]) for name in shown),
            tuple((name, T.tobytes()) for name, T in places.items()),
        )

        def make() -> Drawn:
            store = opened(operator)
            if merge is not None and view in MERGED:
                return merged_drawn(store, merge.name, view, [labels.get(name, name) for name in merge.scans])
            return scans_drawn(store, shown, places, labels)

        self._painter.ask("clouds", key, make, self._draw_clouds)

    def _draw_clouds(self, drawn: Drawn) -> None:
        scene = self._stage.scene
        for name in set(scene.names(LAYER)) - set(drawn.clouds):
            scene.remove(LAYER, name)
        for name, (points, painted) in drawn.clouds.items():
            scene.cloud(LAYER, name, points, painted)
        with self._lock:
            self._drawn = drawn
            self._show_layers()

    def _show_layers(self) -> None:
        """The clouds, or the two that are picked on; and what the browsers look at."""
        picking = self._picking
        if self._shows != (shows := self._visible and not picking):
            self._shows = shows
            self._stage.scene.show(LAYER, shows)
        self._picks.show(self._visible and picking)
        self._legend.set("" if picking or self._drawn is None else self._drawn.legend)
        if self._visible and not picking and self._drawn is not None:
            self._stage.viewpoints.at(f"{LAYER} {self._drawn.about}", self._drawn.points)

    # requests

    def _ask_merge(self) -> None:
        merge, start, reference, names = (
            self._stage.operator.merge,
            self._start.value,
            self._reference.value,
            self._chosen(),
        )
        if start == TURNTABLE:
            merge(names, reference, start="turntable", angle=float(self._angle.value))
        elif start == LYING:
            merge(names, reference, start="identity")
        elif start == PICKED:
            merge(names, reference, picked=self._picks.picked())
        else:
            merge(names, reference)


def mergeable(session: SessionView) -> list[ScanView]:
    """Scans of objects that are reconstructed; planes and spheres that were captured to verify are none."""
    return [scan for scan in session.scans if scan.cloud != "absent" and likely(scan) == "scan"]
