"""Picking the same points on a scan and on the reference, which are shown side by side."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from typing import Any, Literal

import numpy as np

from slviewer.errors import SlviewerError
from slviewer.gui.merge_views import SCAN_COLOURS, patch
from slviewer.gui.panel import Choice, PanelPart, StepPanel
from slviewer.gui.scene import TO_THE_RIGHT, Click
from slviewer.gui.widgets import Html, Text, alert, note, table, to_html
from slviewer.registration.multiway import Pair
from slviewer.registration.start import LEAST_PICKS, fit_picked_start
from slviewer.session.store import Session
from slviewer.wizard.result_views import load_scan_cloud

Side = Literal["scan", "onto"]
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

    versions: tuple[Any, Any]
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

    pair: Pair
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
    """Inputs and 3D view to pick points; ``changed()`` is called after every accepted click."""

    def __init__(self, panel: StepPanel, changed: Callable[[], None]) -> None:
        super().__init__(panel)
        self._panel, self._changed = panel, changed
        self._layer = self._scene.layer("merge picks")
        self._clicks = count()
        self._picks: dict[Pair, _Picks] = {}
        self._current: dict[str, _Picks] = {}
        self._labels: Mapping[str, str] = {}
        self._reference = ""
        self._shown: _SideBySide | None = None
        self._marked: dict[tuple[Side, int], tuple[float, ...]] = {}
        self._offered = False
        self._on: bool | None = None
        self._scan = Choice(
            self._context, "Scan", changed, hint="To be picked on together with the reference"
        )
        self._note = Text(self._gui)
        self._table = Text(self._gui)
        self._undo = self._context.button("Undo last point", self._undo_point, "arrow-back-up")

    def offer(
        self, versions: Mapping[str, Any], reference: str, labels: Mapping[str, str], on: bool
    ) -> None:
        """Offer the scans to merge, {name: version of its cloud}; ``on``: show the inputs. Drops
        outdated points."""
        with self._lock:
            self._labels, self._reference, self._offered = labels, reference, on
            # points picked on an earlier cloud are not on the new one
            self._picks = {
                pair: picks
                for pair, picks in self._picks.items()
                if all(
                    versions.get(name, known) == known
                    for name, known in zip(pair, picks.versions, strict=True)
                )
            }
            self._current = {
                name: self._picks.setdefault(
                    (name, reference), _Picks((version, versions[reference]))
                )
                for name, version in versions.items()
                if name != reference
            }
            self._scan.offer((name, labels.get(name, name)) for name in self._current)
            self._scan.handle.visible = on and len(self._current) > 1

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
        with self._lock:
            if on != self._on:
                if on or self._on:  # otherwise the clicks may be another step's
                    self._scene.on_click(self._handle_click if on else None)
                self._on = on
                self._layer.show(on)
            self._draw_note()
            pair = self._pair
            if not on or pair is None:
                return
            self._painter.request(
                "picks",
                (pair, self._picks[pair].versions),
                lambda: _load_side_by_side(self._context.session, pair),
                self._draw_clouds,
            )
            self._draw_marks()
            self._show_view()

    @property
    def _pair(self) -> Pair | None:
        """The chosen scan and the reference; None where they cannot be picked on."""
        pair = self._scan.value, self._reference
        return pair if pair in self._picks else None

    # drawing

    def _draw_clouds(self, shown: _SideBySide) -> None:
        """Draw the two loaded clouds side by side with their marks."""
        with self._lock:
            self._shown = shown
            for side in _SIDES:
                points = shown.clouds[side] + shown.offset(side)
                self._layer.cloud(side, points, shown.colours[side])
            self._draw_marks()
            self._show_view()

    def _show_view(self) -> None:
        """Move the browsers' views to the two clouds, if they are shown."""
        shown = self._shown
        if self._on and shown is not None and shown.pair == self._pair:
            self._panel.show_points(str(shown.pair), shown.points)

    def _draw_marks(self) -> None:
        """Draw the numbered points on both clouds."""
        shown = self._shown
        wanted: dict[tuple[Side, int], tuple[float, ...]] = {}
        if shown is not None and shown.pair == self._pair:
            picks = self._picks[shown.pair]
            for k, pair in enumerate([*picks.pairs, picks.begun], 1):
                for side, point in pair.items():
                    place = point + shown.offset(side)
                    wanted[side, k] = tuple(place)
                    if wanted[side, k] != self._marked.get((side, k)):
                        ball = _BALL * shown.wide_mm
                        self._layer.mark(f"{side} {k}", place, str(k), _MARKS[side], ball)
        gone = self._marked.keys() - wanted.keys()
        self._layer.remove(*(f"{side} {k}" for side, k in gone))
        self._marked = wanted

    def _draw_note(self) -> None:
        """Show what to click next, and the residuals of the pairs."""
        pair = self._pair
        if not self._offered or pair is None:
            self._note.set("")
            self._table.set("")
            self._undo.visible = False
            return
        picks = self._picks[pair]
        if self._on:
            self._note.write(self._format_instruction(pair, picks), "info")
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
        shown, slot = self._shown, f"click {next(self._clicks)}"
        if shown is None:
            return

        def add(met: tuple[Side, np.ndarray] | None) -> None:
            """Add the point that was met, unless another pair is shown by now."""
            self._painter.cancel(slot)
            with self._lock:
                if met is None or shown.pair != self._pair or not self._on:
                    return
                self._picks[shown.pair].add(*met)
            self._changed()

        self._painter.request(slot, None, lambda: shown.hit(click), add)

    def _undo_point(self) -> None:
        """Remove the last point or pair of the shown scans."""
        with self._lock:
            if (pair := self._pair) is not None:
                self._picks[pair].undo()
        self._changed()


def _residuals_html(picks: _Picks) -> Html:
    """Return a table of the residual distance of each pair after the best rigid alignment."""
    n = len(picks.pairs)
    if n < LEAST_PICKS:
        return note(f"{n} of {LEAST_PICKS} pairs picked")
    try:
        _, residuals_mm = fit_picked_start(*picks.points)
    except SlviewerError as error:
        return alert(str(error), "warning")
    rms = f"RMS {np.sqrt(np.mean(residuals_mm**2)):.2f}"
    pairs = [(f"Pair {k}", f"{mm:.2f}") for k, mm in enumerate(residuals_mm, 1)]
    return table(("Residual, mm", rms), pairs)


def _load_side_by_side(session: Session, pair: Pair) -> _SideBySide:
    """Load two scans, the first moved to the left of the reference, at the same distance from the
    viewpoint."""
    loaded = {side: load_scan_cloud(session, name) for side, name in zip(_SIDES, pair, strict=True)}
    clouds = {side: cloud.points for side, cloud in loaded.items()}
    flat = [points[np.isfinite(points[..., 2])].astype(np.float64) for points in clouds.values()]
    wide = max(float(np.ptp(np.percentile(points @ TO_THE_RIGHT, [1, 99]))) for points in flat)
    scan, onto = (np.median(points, axis=0) for points in flat)
    shift = onto - scan - (1 + _APART) * wide * TO_THE_RIGHT
    painted = {side: cloud.texture for side, cloud in loaded.items()}
    return _SideBySide(pair, clouds, painted, shift, wide)
