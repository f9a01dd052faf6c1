"""Merge: choose scans and the one whose place the others take, and see them before and after."""

import threading
from typing import Any

import numpy as np
import viser

from slviewer.gui.inputs import Choice, change, titled
from slviewer.gui.panel import Stage
from slviewer.gui.pictures import Painter, opened
from slviewer.gui.steps.verify import likely
from slviewer.gui.views import bring_button
from slviewer.gui.widgets import Html, Words, block, cell, meter, table, toned
from slviewer.workflow.wizard import looking
from slviewer.workflow.wizard.snapshot import MergeView, ScanView, SessionView, Snapshot

LAYER = "merge"
VIEWS = ("after, coloured by scan", "before, coloured by scan", "merged points in their own colours")
SCAN_COLOURS = ((91, 143, 208), (224, 161, 60), (99, 178, 138), (200, 113, 143), (143, 131, 201), (120, 120, 120))
_LOW = 0.3
"""Overlap below which an alignment is doubted."""


class Panel:
    """The seventh step."""

    key = "merge"

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._painter = Painter(stage.failed)
        self._lock = threading.RLock()
        self._snapshot: Snapshot | None = None
        self._boxes: dict[str, viser.GuiCheckboxHandle] = {}
        self._points: np.ndarray | None = None
        self._visible = False

    def build(self) -> None:
        gui, operator, safely = self._stage.gui, self._stage.operator, self._stage.safely
        with gui.add_folder("Scans to merge") as self._scans_folder:
            self._none = Words(gui)
        self._reference = Choice(gui, "Reference", "The others are brought to its place")
        self._merge = gui.add_button("Merge", icon=viser.Icon.LAYERS_INTERSECT)
        self._merge.on_click(safely(self._ask_merge))
        self._undo = gui.add_button("Undo this merge", icon=viser.Icon.ARROW_BACK_UP, color="orange", visible=False)
        self._undo.on_click(safely(lambda: operator.undo_merge()))
        self._result = Words(gui)
        self._view = gui.add_dropdown("Show in 3D", VIEWS)
        self._view.on_update(safely(self._refresh))
        self._reference.on_change(safely(self._refresh))
        self._legend = Words(gui)
        bring_button(self._stage, lambda: self._points)

    def draw(self, snapshot: Snapshot) -> None:
        with self._lock:
            self._snapshot = snapshot
            session = snapshot.session
            scans = mergeable(session) if session else []
            self._draw_boxes(scans)
            merge = session.merge if session else None
            preferred = merge.reference if merge else scans[-1].name if scans else ""
            self._reference.offer([(scan.name, titled(scan.name, scan.label)) for scan in scans], preferred)
            change(self._undo, visible=merge is not None)
            self._result.set(merge_words(merge, {scan.name: scan.label for scan in scans}) if merge else "")
            self._refresh()

    def shown(self, visible: bool) -> None:
        self._visible = visible
        self._stage.scene.show(LAYER, visible)
        self._look()

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

    def _chosen(self) -> list[str]:
        return [name for name, box in self._boxes.items() if box.value]

    def _refresh(self) -> None:
        """Offer what can be merged now, and ask for the clouds."""
        with self._lock:
            snapshot = self._snapshot
            session = snapshot.session if snapshot else None
            if snapshot is None or session is None:
                return
            names = list(dict.fromkeys([*self._chosen(), *filter(None, [self._reference.value])]))
            busy = snapshot.job is not None and not snapshot.job.background
            change(self._merge, label=f"Merge {len(names)} scans", disabled=busy or len(names) < 2)
            merge, view = session.merge, self._view.value
            if merge is None:
                view = VIEWS[1]
            change(self._view, visible=merge is not None)
            shown = list(merge.scans) if merge is not None else names
            made = {scan.name: (scan.points, scan.model) for scan in session.scans if scan.cloud != "absent"}
            places = (
                {name: pair[2] for name, pair in merge.pairs.items()} if merge is not None and view == VIEWS[0] else {}
            )
            key = (
                view,
                merge.name if merge else "",
                tuple((name, made[name]) for name in shown if name in made),
                tuple((name, T.tobytes()) for name, T in places.items()),
            )
            labels = {scan.name: scan.label for scan in session.scans}
            self._painter.ask(
                "clouds",
                key,
                lambda: self._load(view, merge, [n for n in shown if n in made], places, labels),
                self._draw_clouds,
            )

    def _load(
        self,
        view: str,
        merge: MergeView | None,
        names: list[str],
        places: dict[str, np.ndarray],
        labels: dict[str, str],
    ) -> list[tuple[str, np.ndarray, Any]]:
        """(name, points (n, 3), colours) to draw; on the painter's thread."""
        session = opened(self._stage.operator)
        if view == VIEWS[2] and merge is not None:
            whole = looking.merged_cloud(session, merge.name)
            colours = whole.colours
            if colours is not None and colours.ndim == 1:
                colours = np.repeat(colours[:, None], 3, axis=1)
            return [("merged", whole.points, (150, 150, 150) if colours is None else colours)]
        things = []
        for i, name in enumerate(names):
            cloud = looking.scan_cloud(session, name)
            rows, columns = cloud.thinned(60_000)
            points = cloud.points[rows, columns].reshape(-1, 3)
            T = places.get(name, np.eye(4))
            moved = (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
            things.append((labels.get(name, name), moved, SCAN_COLOURS[i % len(SCAN_COLOURS)]))
        return things

    def _draw_clouds(self, things: list[tuple[str, np.ndarray, Any]]) -> None:
        scene = self._stage.scene
        for name in set(scene.names(LAYER)) - {name for name, _, _ in things}:
            scene.remove(LAYER, name)
        self._points = np.concatenate([points for _, points, _ in things]) if things else None
        words = []
        for name, points, colours in things:
            scene.cloud(LAYER, name, points, colours)
            if isinstance(colours, tuple):
                patch = f'<span style="color:rgb{colours};font-size:1.3em">■</span>'
                words.append(f"<span>{patch} {cell(name)}</span>")
        scene.show(LAYER, self._visible)
        legend = f'<div style="display:flex;flex-wrap:wrap;gap:0 1em;align-items:center">{"".join(words)}</div>'
        self._legend.set(block(Html(legend)) if words else "")
        self._look()

    def _look(self) -> None:
        if self._visible:
            self._stage.eyes.at(f"{LAYER} {self._view.value}", self._points)

    # requests

    def _ask_merge(self) -> None:
        reference = self._reference.value
        names = [name for name in self._chosen() if name != reference]
        self._stage.operator.merge([*names, reference], reference)


def mergeable(session: SessionView) -> list[ScanView]:
    """Scans of objects that are reconstructed; planes and spheres that were captured to verify are none."""
    return [scan for scan in session.scans if scan.cloud != "absent" and likely(scan) == "scan"]


def merge_words(merge: MergeView, labels: dict[str, str]) -> Html:
    """How each scan lies on the reference."""
    reference = labels.get(merge.reference, merge.reference)
    rows = []
    for name, (rms, overlap, T) in merge.pairs.items():
        moved = f"{np.linalg.norm(T[:3, 3]):.1f} mm"
        turned = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
        share = Html(f"{100 * overlap:.0f} %{meter(overlap, 'good' if overlap >= _LOW else 'warning')}")
        rows.append(
            (labels.get(name, name), toned(f"{rms:.3f} mm", "plain", bold=True), share, f"{moved}, {turned:.1f}°")
        )
    said = table((f"On {reference}", "RMS", "overlap", "moved by"), rows)
    stale = toned("Scans or calibration have changed since: merge again.", "warning") if merge.stale else ""
    points = block(Html(f"Merged: <b>{merge.points:,} points</b> in the place of {cell(reference)}. {stale}"))
    return Html(said + points)
