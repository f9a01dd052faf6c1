"""What the step Merge shows: clouds of the scans and of the merged surface, the merge in figures,
and why one failed; and the same points, picked on a scan and on the reference side by side."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from slviewer.errors import SlviewerError
from slviewer.evaluation import letter
from slviewer.geometry.rigid import move_points
from slviewer.geometry.vectors import rms
from slviewer.gui.colouring import (
    DISTANCE,
    SCAN,
    SCAN_COLOURS,
    TEXTURE,
    PointValues,
    merge_values,
    paint_points,
    patch,
    shade,
)
from slviewer.gui.panel import PanelPart, StepPanel
from slviewer.gui.scene import TO_THE_RIGHT, Click
from slviewer.gui.widgets import (
    Html,
    Text,
    alert,
    help_link,
    note,
    paragraph,
    records_html,
    table,
    to_html,
)
from slviewer.pipeline.operation import Stored
from slviewer.reconstruction.reconstruct import cloud_normals
from slviewer.records.merge import Merge
from slviewer.records.record import use_labels
from slviewer.registration.multiway import Pair
from slviewer.registration.refusal import Reason
from slviewer.registration.spread import measure_spread
from slviewer.registration.start import LEAST_PICKS, fit_picked_start
from slviewer.session.store import Session
from slviewer.wizard import result_views

MERGED, AFTER, BEFORE = "merged", "scans, aligned", "scans, as captured"
SHOWN = 60_000
"""Points of each cloud that are drawn."""


@dataclass(frozen=True, eq=False)
class ColouredClouds:
    """Clouds by name, points (..., 3) mm and colours each, with a legend; `view` changes with their
    positions.

    ``scans``: for clouds of scans, in the same order, what they were made from.
    """

    view: str
    clouds: Mapping[str, tuple[np.ndarray, np.ndarray]]
    legend: Html
    scans: tuple[result_views.ScanCloud, ...] = ()

    @cached_property
    def points(self) -> np.ndarray | None:
        """All points (n, 3) mm; None where there are none."""
        return (
            np.concatenate([points.reshape(-1, 3) for points, _ in self.clouds.values()])
            if self.clouds
            else None
        )


def colour_scans(
    session: Session,
    names: Sequence[str],
    places: Mapping[str, np.ndarray],
    titles: Mapping[str, str],
    colour: str,
) -> ColouredClouds:
    """Load scans, coloured by one of ALIGNED_COLOURINGS, at their ``places`` (4, 4), or as captured
    where they have none."""
    scans = tuple(result_views.load_scan_cloud(session, name) for name in names)
    legend = Html("")
    clouds: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    categories = {SCAN: ([titles.get(name, name) for name in names], SCAN_COLOURS)}
    for i, cloud in enumerate(scans):
        T = places.get(cloud.name, np.eye(4)).astype(np.float32)
        points = move_points(T, cloud.points)
        values = {TEXTURE: cloud.texture, SCAN: np.full(points.shape[:2], i)}
        normals = cloud_normals(cloud) @ T[:3, :3].T
        painted, legend = paint_points(
            PointValues(points, normals, values, categories=categories), colour
        )
        clouds[cloud.name] = points, painted
    return ColouredClouds("after" if places else "before", clouds, legend, scans)


def colour_merge(
    session: Session, merge: Stored[Merge], colour: str, titles: Sequence[str]
) -> ColouredClouds:
    """Load the surface of a merge, coloured by one of MERGE_COLOURINGS; ``titles`` are those of its
    scans, in order."""
    surface, spread = result_views.merged_cloud(session, merge.name), None
    if colour == DISTANCE and surface.normals is not None:
        aligned = []
        for name, T in merge.record.poses.items():
            if not session.has_result(f"clouds/{name}"):  # deleted since
                continue
            measured = result_views.load_scan_cloud(session, name).measured
            aligned.append(move_points(T, measured))
        spread = measure_spread(surface.points, surface.normals, aligned)
    painted, legend = paint_points(merge_values(surface, titles, spread), colour)
    return ColouredClouds("merged", {"merged": (surface.points, painted)}, legend)


def merge_html(merge: Stored[Merge], labels: Mapping[str, str]) -> Html:
    """Describe a merge: the registered pairs, their loops, and what was excluded."""
    html = records_html([merge], labels, named=False)
    if len(merge.record.scans) == 3:
        html += _letter_html(merge.record)
    return html + paragraph(help_link("merge")) if merge.record.refused else html


def merge_failure_html(
    why: str,
    labels: Mapping[str, str],
    merge: Stored[Merge] | None = None,
    refusal: Reason | None = None,
) -> Html:
    """Describe why the last merge failed, with its ``refusal``; ``merge``: the previous one, which
    is still shown."""
    still = "" if merge is None else " The previous merge is shown below."
    link = help_link(f"merge-{refusal}" if refusal else "merge")
    return alert(
        Html(f"<b>Not merged.</b> {to_html(use_labels(why, labels) + still)} {link}"), "error"
    )


def turntable_html(
    names: Sequence[str], table_deg: Sequence[float], labels: Mapping[str, str]
) -> Html:
    """List the turntable angle of each scan."""
    turned = [
        f"{labels.get(name, name)} at {deg:g}°" for name, deg in zip(names, table_deg, strict=True)
    ]
    if len(turned) > 4:
        turned = [*turned[:3], "…", turned[-1]]
    return note(f"{', '.join(turned)}. Direction and axis of the turntable are estimated.")


def _letter_html(merge: Merge) -> Html:
    """Compare the point-to-point RMS with the Letter's for its own three scans."""
    theirs = " and ".join(f"{mm:.2f}" for mm in letter.EXPERIMENT_3_ICP_RMS_MM.values())
    ours = [
        pair.point_to_point_rms_mm
        for pair in merge.registered
        if merge.reference in (pair.scan, pair.onto)
    ]
    here = " and ".join(f"{mm:.2f}" for mm in ours if mm is not None)
    here = f"; here {here} mm" if here else ""
    return note(f"Point-to-point RMS: {theirs} mm in the Letter{here}.")


Side = Literal["scan", "onto"]
_Key = tuple[Pair, Any, Any]
"""What picked points belong to: a scan and the reference, and the versions of their clouds."""
_SIDES: tuple[Side, Side] = ("scan", "onto")
_MARKS = dict(zip(_SIDES, SCAN_COLOURS, strict=False))
_WHERE = {"scan": "on the left", "onto": "on the right"}
_APART = 0.15
"""Gap between the two clouds, as a share of the wider one's width."""
_MARGIN = 1.15
_BALL = 0.022
"""Radius of a mark, as a share of the width."""


@dataclass
class _Picks:
    """Pairs of points (3,) mm on a scan and on the reference, and a point without counterpart
    yet."""

    pairs: list[dict[Side, np.ndarray]] = field(default_factory=list)
    begun: dict[Side, np.ndarray] = field(default_factory=dict)

    def add(self, side: Side, point: np.ndarray) -> None:
        """Add a point on one cloud; it replaces a waiting one there, or completes a pair."""
        self.begun[side] = point  # a second click on the same cloud corrects the first
        if len(self.begun) == len(_SIDES):
            self.pairs.append(self.begun)
            self.begun = {}

    def undo(self) -> None:
        """Remove the waiting point, else the last pair."""
        if self.begun:
            self.begun = {}
        elif self.pairs:
            self.pairs.pop()

    @property
    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """The points (n, 3) mm of the pairs, on the scan and on the reference."""
        scan, onto = (
            np.array([pair[side] for pair in self.pairs]).reshape(-1, 3) for side in _SIDES
        )
        return scan, onto


@dataclass(frozen=True, eq=False)
class _SideBySide:
    """Two clouds (h, w, 3) mm in their cameras' frames, the shift that draws the scan beside, and
    the width."""

    key: _Key
    clouds: Mapping[Side, np.ndarray]
    colours: Mapping[Side, np.ndarray]
    shift: np.ndarray
    wide_mm: float

    def offset(self, side: Side) -> np.ndarray:
        """Return the shift (3,) mm at which a cloud is drawn."""
        return self.shift if side == "scan" else np.zeros(3)

    @cached_property
    def points(self) -> np.ndarray:
        """Both clouds as they are drawn, (n, 3) mm, with a margin for narrow windows."""
        points = np.concatenate(
            [(self.clouds[side][::4, ::4] + self.offset(side)).reshape(-1, 3) for side in _SIDES]
        )
        middle = np.nanmean(points, axis=0)
        return np.asarray(middle + _MARGIN * (points - middle), np.float32)

    def hit(self, click: Click) -> tuple[Side, np.ndarray] | None:
        """Return the cloud that a click meets first, and the point (3,) mm on it; None where it
        misses both."""
        met = click.find_first([self.clouds[side] + self.offset(side) for side in _SIDES])
        if met is None:
            return None
        side = _SIDES[met[0]]
        return side, self.clouds[side][met[1]].astype(np.float64)


class PointPicker(PanelPart):
    """Inputs and 3D view to pick points."""

    def __init__(self, panel: StepPanel) -> None:
        super().__init__(panel)
        self._layer = self._scene.layer("merge picks")
        # points picked on an earlier version of a cloud are not on the new one
        self._picks = defaultdict[_Key, _Picks](_Picks)
        self._keys: dict[str, _Key] = {}
        self._labels: Mapping[str, str] = {}
        self._reference = ""
        self._shown: _SideBySide | None = None
        self._marked: list[tuple[Side, str, tuple[float, ...], float]] = []
        self._offered = False
        self._on: bool | None = None
        self._scan = self.choice("Scan", "To be picked on together with the reference")
        self._note = Text(self._gui)
        self._table = Text(self._gui)
        self._undo = self.button("Undo last point", self._undo_point, "arrow-back-up")

    def offer(
        self, versions: Mapping[str, Any], reference: str, labels: Mapping[str, str], on: bool
    ) -> None:
        """Offer the scans to merge, {name: version of its cloud}; ``on``: show the inputs."""
        self._labels, self._reference, self._offered = labels, reference, on
        self._keys = {
            name: ((name, reference), version, versions[reference])
            for name, version in versions.items()
            if name != reference
        }
        self._scan.offer({labels.get(name, name): name for name in self._keys})
        self._scan.handle.visible = on and len(self._keys) > 1

    @property
    def _current(self) -> dict[str, _Picks]:
        """The points that are picked on each scan and the reference, by the scan."""
        return {name: self._picks[key] for name, key in self._keys.items()}

    @property
    def _key(self) -> _Key | None:
        """The chosen scan and the reference; None where they cannot be picked on."""
        return self._keys.get(self._scan.value)

    @property
    def is_ready(self) -> bool:
        """Whether at least one scan has enough pairs, and none has too few."""
        counts = [len(picks.pairs) for picks in self._current.values()]
        return any(counts) and not any(0 < n < LEAST_PICKS for n in counts)

    def picked(self) -> dict[Pair, tuple[np.ndarray, np.ndarray]]:
        """Return the points (n, 3) mm on the scan and on the reference, by pair."""
        return {
            (name, self._reference): picks.points
            for name, picks in self._current.items()
            if picks.pairs
        }

    def show(self, on: bool) -> None:
        """Draw the two clouds and react to clicks, or stop both."""
        if on != self._on:
            if on or self._on:  # otherwise the clicks may be another step's
                self._scene.on_click(self._handle_click if on else None)
            self._on = on
            self._layer.show(on)
        self._draw_note()
        key = self._key
        if not on or key is None:
            return
        self._painter.request(
            self._draw_clouds, key, lambda: _load_side_by_side(self.context.session, key)
        )
        self._draw_marks()
        self._show_view()

    # drawing

    def _draw_clouds(self, shown: _SideBySide) -> None:
        """Draw the two loaded clouds side by side with their marks."""
        self._shown = shown
        for side in _SIDES:
            points = shown.clouds[side] + shown.offset(side)
            self._layer.cloud(side, points, shown.colours[side])
        self._draw_marks()
        self._show_view()

    def _show_view(self) -> None:
        """Move the browsers' views to the two clouds, if they are shown."""
        shown = self._shown
        if self._on and shown and shown.key == self._key:
            self.panel.show_points(str(shown.key[0]), shown.points)

    def _draw_marks(self) -> None:
        """Draw the numbered points on both clouds."""
        shown, self._marked, marked = self._shown, [], self._marked
        if shown and shown.key == self._key:
            picks = self._picks[shown.key]
            self._marked = [
                (side, str(k), tuple(point + shown.offset(side)), _BALL * shown.wide_mm)
                for k, pair in enumerate([*picks.pairs, picks.begun], 1)
                for side, point in pair.items()
            ]
        if self._marked != marked:
            self._layer.remove(*(f"{side} {k}" for side, k, *_ in marked))
            for side, k, place, ball in self._marked:
                self._layer.mark(f"{side} {k}", np.array(place), k, _MARKS[side], ball)

    def _draw_note(self) -> None:
        """Show what to click next, and the residuals of the pairs."""
        key = self._key
        if not self._offered or key is None:
            self._note.set("")
            self._table.set("")
            self._undo.visible = False
            return
        picks = self._picks[key]
        if self._on:
            self._note.write(self._format_instruction(key[0], picks), "info")
        else:
            self._note.write("To pick more, choose the 3D view side by side.", "dim")
        self._table.set(_residuals_html(picks) + self._counts_html())
        self._undo.visible = bool(picks.pairs or picks.begun)

    def _format_instruction(self, pair: Pair, picks: _Picks) -> Html:
        """Describe the next click for a pair of scans."""
        scan, onto = [
            f"{patch(_MARKS[side])} <b>{to_html(self._labels.get(name, name))}</b> {_WHERE[side]}"
            for side, name in zip(_SIDES, pair, strict=True)
        ]
        number = f"Pair {len(picks.pairs) + 1}: "
        if picks.begun:
            missing = onto if "scan" in picks.begun else scan
            return Html(f"{number}click the same point on {missing}.")
        if len(picks.pairs) >= LEAST_PICKS:
            return Html(f"{len(picks.pairs)} pairs: press Merge, or pick another pair.")
        return Html(
            f"{number}click a point on {scan}, then the same point on {onto}. "
            f"At least {LEAST_PICKS} pairs, far apart; corners are best."
        )

    def _counts_html(self) -> Html:
        """List the number of pairs of each scan; empty for a single one."""
        counts = {name: len(picks.pairs) for name, picks in self._current.items()}
        if len(counts) < 2 or not any(counts.values()):
            return Html("")
        parts = []
        for name, n in counts.items():
            counted = f"{n} pair{'s' * (n != 1)}" if n else "none (aligned by features)"
            few = ", too few" if 0 < n < LEAST_PICKS else ""
            parts.append(f"{self._labels.get(name, name)}: {counted}{few}")
        return note("; ".join(parts))

    # clicks

    def _handle_click(self, click: Click) -> None:
        """Add the point that a click meets, computed on the painter's thread."""
        shown = self._shown
        if shown is None:
            return

        def add(met: tuple[Side, np.ndarray] | None) -> None:
            """Add the point that was met, unless another pair is shown by now."""
            if met and shown.key == self._key and self._on:
                self._picks[shown.key].add(*met)
                self.redraw()

        self._painter.request_once(add, lambda: shown.hit(click))

    def _undo_point(self) -> None:
        """Remove the last point or pair of the shown scans."""
        if key := self._key:
            self._picks[key].undo()


def _residuals_html(picks: _Picks) -> Html:
    """Return a table of the residual distance of each pair after the best rigid alignment."""
    n = len(picks.pairs)
    if n < LEAST_PICKS:
        return note(f"{n} of {LEAST_PICKS} pairs picked")
    try:
        _, residuals_mm = fit_picked_start(*picks.points)
    except SlviewerError as error:
        return alert(str(error), "warning")
    column = f"RMS {rms(residuals_mm):.2f}"
    pairs = [(f"Pair {k}", f"{mm:.2f}") for k, mm in enumerate(residuals_mm, 1)]
    return table(("Residual, mm", column), pairs)


def _load_side_by_side(session: Session, key: _Key) -> _SideBySide:
    """Load two scans, the first moved to the left of the reference, at the same distance from the
    viewpoint."""
    names = zip(_SIDES, key[0], strict=True)
    loaded = {side: result_views.load_scan_cloud(session, name) for side, name in names}
    clouds = {side: cloud.points for side, cloud in loaded.items()}
    flat = [points[np.isfinite(points[..., 2])].astype(np.float64) for points in clouds.values()]
    wide = max(float(np.ptp(np.percentile(points @ TO_THE_RIGHT, [1, 99]))) for points in flat)
    scan, onto = (np.median(points, axis=0) for points in flat)
    shift = onto - scan - (1 + _APART) * wide * TO_THE_RIGHT
    painted = {side: shade(cloud.texture, cloud_normals(cloud)) for side, cloud in loaded.items()}
    return _SideBySide(key, clouds, painted, shift, wide)
