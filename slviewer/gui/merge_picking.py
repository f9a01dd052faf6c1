"""Picking the same points on a scan and on the reference, which are shown side by side."""

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from typing import Any, Literal

import numpy as np
import viser

from slviewer.errors import SlviewerError
from slviewer.gui.inputs import Choice, change
from slviewer.gui.merge_views import SCAN_COLOURS, patch
from slviewer.gui.panel import PanelContext
from slviewer.gui.pictures import Painter
from slviewer.gui.viewpoints import TO_THE_RIGHT
from slviewer.gui.widgets import Html, Text, alert, coloured, paragraph, table, to_html
from slviewer.registration.multiway import Pair
from slviewer.registration.start import LEAST_PICKS, fit_picked_start
from slviewer.session.store import Session
from slviewer.wizard.result_views import ScanCloud, load_scan_cloud, nearest

LAYER = "merge picks"
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

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> tuple[Side, np.ndarray] | None:
        """Return the cloud that a ray meets first, and the point (3,) mm on it; None where it
        misses both."""
        met = []
        for side in _SIDES:
            index = nearest(self.clouds[side], origin - self.offset(side), direction)
            if index is not None:
                point = self.clouds[side][index].astype(np.float64)
                met.append((float((point + self.offset(side) - origin) @ direction), side, point))
        return min(met, key=lambda one: one[0])[1:] if met else None


class PointPicker:
    """Inputs and 3D view to pick points; ``changed()`` is called after every accepted click."""

    def __init__(
        self, context: PanelContext, painter: Painter, changed: Callable[[], None]
    ) -> None:
        self._context, self._painter, self._changed = context, painter, changed
        self._lock = threading.RLock()
        self._clicks = count()
        self._picks: dict[Pair, _Picks] = {}
        self._labels: Mapping[str, str] = {}
        self._names: list[str] = []
        self._reference = ""
        self._shown: _SideBySide | None = None
        self._marked: dict[str, tuple[float, ...]] = {}
        self._offered = False
        self._on: bool | None = None

    def build(self) -> None:
        """Create the inputs."""
        gui, context = self._context.gui, self._context
        self._scan = Choice(gui, "Scan", "To be picked on together with the reference")
        self._scan.on_change(context.callback(self._changed))
        self._note = Text(gui)
        self._table = Text(gui)
        self._undo = context.button(
            "Undo last point", self._undo_point, viser.Icon.ARROW_BACK_UP, visible=False
        )

    def offer(
        self, versions: Mapping[str, Any], reference: str, labels: Mapping[str, str], on: bool
    ) -> None:
        """Offer the scans to merge, {name: version of its cloud}; ``on``: show the inputs. Drops
        outdated points."""
        with self._lock:
            self._labels, self._reference = labels, reference
            self._names = [name for name in versions if name != reference]
            for pair in list(self._picks):
                # points picked on an earlier cloud are not on the new one
                if any(
                    versions.get(name, known) != known
                    for name, known in zip(pair, self._picks[pair].versions, strict=True)
                ):
                    self._picks.pop(pair)
            for name in self._names if reference else ():
                self._picks.setdefault(
                    (name, reference), _Picks((versions[name], versions[reference]))
                )
            self._scan.offer([(name, labels.get(name, name)) for name in self._names])
            self._scan.set_visible(on and len(self._names) > 1)
            self._offered = on

    @property
    def is_ready(self) -> bool:
        """Whether at least one scan has enough pairs, and none has too few."""
        counts = [len(picks.pairs) for picks in self._list_current_picks()]
        return max(counts, default=0) >= LEAST_PICKS and not any(
            0 < n < LEAST_PICKS for n in counts
        )

    def picked(self) -> dict[Pair, tuple[np.ndarray, np.ndarray]]:
        """Return the points (n, 3) mm on the scan and on the reference, by pair."""
        with self._lock:
            pairs = [(name, self._reference) for name in self._names]
            return {pair: self._picks[pair].points for pair in pairs if self._picks[pair].pairs}

    def show(self, on: bool) -> None:
        """Draw the two clouds and react to clicks, or stop both."""
        with self._lock:
            scene = self._context.scene
            if on != self._on:
                if on or self._on:  # otherwise the clicks may be another step's
                    scene.on_pick(self._handle_click if on else None)
                self._on = on
                scene.show(LAYER, on)
            self._draw_note(self._offered)
            pair = self._pair
            if not on or pair is None:
                return
            key = (pair, self._picks[pair].versions)
            self._painter.request(
                "picks",
                key,
                lambda: _load_side_by_side(self._context.session, pair),
                self._draw_clouds,
            )
            self._draw_marks()
            self._show_view()

    @property
    def points(self) -> np.ndarray | None:
        """The shown points (n, 3) mm; None where none are."""
        return None if self._shown is None else self._shown.points

    @property
    def _pair(self) -> Pair | None:
        """The chosen scan and the reference; None where they cannot be picked on."""
        pair = self._scan.value, self._reference
        return pair if pair in self._picks else None

    def _list_current_picks(self) -> Sequence[_Picks]:
        """List the picks of all offered scans with the current reference."""
        with self._lock:
            return [
                self._picks[name, self._reference]
                for name in self._names
                if (name, self._reference) in self._picks
            ]

    # drawing

    def _draw_clouds(self, shown: _SideBySide) -> None:
        """Draw the two loaded clouds side by side with their marks."""
        with self._lock:
            self._shown = shown
            for side in _SIDES:
                self._context.scene.cloud(
                    LAYER, side, shown.clouds[side] + shown.offset(side), shown.colours[side]
                )
            self._context.scene.show(LAYER, bool(self._on))
            self._draw_marks()
            self._show_view()

    def _show_view(self) -> None:
        """Move the browsers' views to the two clouds, if they are shown."""
        shown = self._shown
        if self._on and shown is not None and shown.pair == self._pair:
            self._context.viewpoints.show(f"{LAYER} {shown.pair}", shown.points)

    def _draw_marks(self) -> None:
        """Draw the numbered points on both clouds."""
        shown, scene = self._shown, self._context.scene
        wanted: dict[str, tuple[np.ndarray, str, Side]] = {}
        ball = 0.0 if shown is None else _BALL * shown.wide_mm
        if shown is not None and shown.pair == self._pair:
            picks = self._picks[shown.pair]
            for k, pair in enumerate([*picks.pairs, picks.begun], 1):
                for side, point in pair.items():
                    wanted[f"{side} {k}"] = point + shown.offset(side), str(k), side
        for name in self._marked.keys() - wanted.keys():
            scene.remove(LAYER, name)
        for name, (point, text, side) in wanted.items():
            if self._marked.get(name) != tuple(point):
                scene.mark(LAYER, name, point, text, _MARKS[side], ball)
        self._marked = {name: tuple(point) for name, (point, _, _) in wanted.items()}

    def _draw_note(self, on: bool) -> None:
        """Show what to click next, and the residuals of the pairs."""
        pair = self._pair
        if not on or pair is None:
            self._note.set("")
            self._table.set("")
            change(self._undo, visible=False)
            return
        picks = self._picks[pair]
        if self._on:
            self._note.set(alert(self._format_instruction(pair, picks), "info"))
        else:
            self._note.write("To pick more, choose the 3D view side by side.", "dim")
        self._table.set(_residuals_html(picks) + self._counts_html())
        change(self._undo, visible=bool(picks.pairs or picks.begun))

    def _format_instruction(self, pair: Pair, picks: _Picks) -> Html:
        """Describe the next click for a pair of scans."""
        names = {
            side: (
                f"{patch(_MARKS[side])} <b>{to_html(self._labels.get(name, name))}</b>"
                f" {_WHERE[side]}"
            )
            for side, name in zip(_SIDES, pair, strict=True)
        }
        number = f"Pair {len(picks.pairs) + 1}: "
        if picks.begun:
            missing = next(side for side in _SIDES if side not in picks.begun)
            return Html(f"{number}click the same point on {names[missing]}.")
        if len(picks.pairs) >= LEAST_PICKS:
            return Html(f"{len(picks.pairs)} pairs: press Merge, or pick another pair.")
        return Html(
            f"{number}click a point on {names['scan']}, then the same point on {names['onto']}. "
            f"At least {LEAST_PICKS} pairs, far apart; corners are best."
        )

    def _counts_html(self) -> Html:
        """List the number of pairs of each scan; empty for a single one."""
        if len(self._names) < 2 or not any(picks.pairs for picks in self._list_current_picks()):
            return Html("")
        parts = []
        for name in self._names:
            n = len(self._picks[name, self._reference].pairs)
            counted = f"{n} pair{'s' * (n != 1)}" if n else "none (aligned by features)"
            parts.append(
                f"{self._labels.get(name, name)}: {counted}"
                + (", too few" if 0 < n < LEAST_PICKS else "")
            )
        return paragraph(coloured("; ".join(parts), "dim"))

    # clicks

    def _handle_click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Add the point that a clicked ray meets, computed on the painter's thread."""
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

        self._painter.request(
            slot, None, lambda: shown.hit(origin, direction / np.linalg.norm(direction)), add
        )

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
        return paragraph(coloured(f"{n} of {LEAST_PICKS} pairs picked", "dim"))
    try:
        _, residuals_mm = fit_picked_start(*picks.points)
    except SlviewerError as error:
        return alert(str(error), "warning")
    rows = [(f"Pair {k}", f"{mm:.2f}") for k, mm in enumerate(residuals_mm, 1)]
    return table(("Residual, mm", f"RMS {np.sqrt(np.mean(residuals_mm**2)):.2f}"), rows)


def _load_side_by_side(session: Session, pair: Pair) -> _SideBySide:
    """Load two scans, the first moved to the left of the reference, at the same distance from the
    viewpoint."""
    clouds: dict[Side, ScanCloud] = {
        side: load_scan_cloud(session, name) for side, name in zip(_SIDES, pair, strict=True)
    }
    flat = {
        side: cloud.points[np.isfinite(cloud.points[..., 2])].astype(np.float64)
        for side, cloud in clouds.items()
    }
    wide = max(
        float(np.ptp(np.percentile(points @ TO_THE_RIGHT, [1, 99]))) for points in flat.values()
    )
    shift = (
        np.median(flat["onto"], axis=0)
        - np.median(flat["scan"], axis=0)
        - (1 + _APART) * wide * TO_THE_RIGHT
    )
    painted = {side: cloud.texture for side, cloud in clouds.items()}
    return _SideBySide(
        pair, {side: cloud.points for side, cloud in clouds.items()}, painted, shift, wide
    )
