"""Picking the same places on a scan and on the reference, which stand side by side for it."""

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
from slviewer.gui.panel import Stage
from slviewer.gui.pictures import Painter, opened
from slviewer.gui.viewpoints import ASIDE
from slviewer.gui.widgets import Html, Words, block, boxed, cell, table, toned
from slviewer.registration.multiway import Pair
from slviewer.registration.picked import LEAST_PICKS, fit_picked_start
from slviewer.wizard.result_views import ScanCloud, nearest, scan_cloud

LAYER = "merge picks"
Side = Literal["scan", "onto"]
_SIDES: tuple[Side, Side] = ("scan", "onto")
_MARKS = dict(zip(_SIDES, SCAN_COLOURS, strict=False))
_WHERE = {"scan": "on the left", "onto": "on the right"}
_APART = 0.15
"""Of the wider one's width: the gap between the two clouds."""
_ROOM = 1.15
_BALL = 0.022
"""Of the width: the radius of a mark."""


@dataclass
class _Picks:
    """Pairs of places (3,) mm on a scan and on the reference, and the one place that waits for its counterpart."""

    versions: tuple[Any, Any]
    pairs: list[dict[Side, np.ndarray]] = field(default_factory=list)
    begun: dict[Side, np.ndarray] = field(default_factory=dict)

    def add(self, side: Side, point: np.ndarray) -> None:
        self.begun[side] = point  # a second click on the same cloud corrects the first
        if len(self.begun) == len(_SIDES):
            self.pairs.append(self.begun)
            self.begun = {}

    def undo(self) -> None:
        if self.begun:
            self.begun = {}
        elif self.pairs:
            self.pairs.pop()

    @property
    def points(self) -> tuple[np.ndarray, np.ndarray]:
        scan, onto = (np.array([pair[side] for pair in self.pairs]).reshape(-1, 3) for side in _SIDES)
        return scan, onto


@dataclass(frozen=True, eq=False)
class _SideBySide:
    """The two clouds (h, w, 3) mm in their cameras' frames, how far the scan's is moved to be drawn, and the width."""

    pair: Pair
    clouds: Mapping[Side, np.ndarray]
    colours: Mapping[Side, np.ndarray]
    shift: np.ndarray
    wide_mm: float

    def moved(self, side: Side) -> np.ndarray:
        return self.shift if side == "scan" else np.zeros(3)

    @cached_property
    def seen(self) -> np.ndarray:
        """(n, 3) mm: what to look at to see both as they are drawn, whole in a narrow window too."""
        points = np.concatenate([(self.clouds[side][::4, ::4] + self.moved(side)).reshape(-1, 3) for side in _SIDES])
        middle = np.nanmean(points, axis=0)
        return np.asarray(middle + _ROOM * (points - middle), np.float32)

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> tuple[Side, np.ndarray] | None:
        """What a ray meets first: on which cloud, and the point (3,) of it."""
        met = []
        for side in _SIDES:
            index = nearest(self.clouds[side], origin - self.moved(side), direction)
            if index is not None:
                point = self.clouds[side][index].astype(np.float64)
                met.append((float((point + self.moved(side) - origin) @ direction), side, point))
        return min(met, key=lambda one: one[0])[1:] if met else None


class PickBox:
    """Inputs and 3D view for picking; ``changed()`` is called after every click that was taken."""

    def __init__(self, stage: Stage, painter: Painter, changed: Callable[[], None]) -> None:
        self._stage, self._painter, self._changed = stage, painter, changed
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
        gui, safely = self._stage.gui, self._stage.safely
        self._scan = Choice(gui, "Pick on", "The scan whose places you pick on it and on the reference")
        self._scan.on_change(safely(self._changed))
        self._now = Words(gui)
        self._table = Words(gui)
        self._undo = gui.add_button("Undo last pair", icon=viser.Icon.ARROW_BACK_UP, color="gray", visible=False)
        self._undo.on_click(safely(self._take_back))

    def offer(self, versions: Mapping[str, Any], reference: str, labels: Mapping[str, str], on: bool) -> None:
        """Offer the scans that are to be merged, by name with what their clouds depend on; ``on``: show the inputs."""
        with self._lock:
            self._labels, self._reference = labels, reference
            self._names = [name for name in versions if name != reference]
            for pair in list(self._picks):
                # what was picked on a cloud that is no longer is no place on the new one
                if any(
                    versions.get(name, known) != known
                    for name, known in zip(pair, self._picks[pair].versions, strict=True)
                ):
                    self._picks.pop(pair)
            for name in self._names if reference else ():
                self._picks.setdefault((name, reference), _Picks((versions[name], versions[reference])))
            self._scan.offer([(name, labels.get(name, name)) for name in self._names])
            self._scan.show(on and len(self._names) > 1)
            self._offered = on

    @property
    def ready(self) -> bool:
        """Whether a scan has pairs enough, and none too few."""
        counts = [len(picks.pairs) for picks in self._current()]
        return max(counts, default=0) >= LEAST_PICKS and not any(0 < n < LEAST_PICKS for n in counts)

    def picked(self) -> dict[Pair, tuple[np.ndarray, np.ndarray]]:
        """The points (n, 3) mm on the scan and on the reference, by pair."""
        with self._lock:
            pairs = [(name, self._reference) for name in self._names]
            return {pair: self._picks[pair].points for pair in pairs if self._picks[pair].pairs}

    def show(self, on: bool) -> None:
        """Draw the two clouds and hear of clicks, or neither."""
        with self._lock:
            scene = self._stage.scene
            if on != self._on:
                if on or self._on:  # what was never asked for is not given back: it may be another step's
                    scene.on_pick(self._click if on else None)
                self._on = on
                scene.show(LAYER, on)
            self._say(self._offered)
            pair = self._pair
            if not on or pair is None:
                return
            operator, key = self._stage.operator, (pair, self._picks[pair].versions)
            self._painter.ask("picks", key, lambda: _side_by_side(opened(operator), pair), self._draw)
            self._mark()
            self._look()

    @property
    def seen(self) -> np.ndarray | None:
        """The points (n, 3) mm to look at."""
        return None if self._shown is None else self._shown.seen

    @property
    def _pair(self) -> Pair | None:
        pair = self._scan.value, self._reference
        return pair if pair in self._picks else None

    def _current(self) -> Sequence[_Picks]:
        with self._lock:
            return [
                self._picks[name, self._reference] for name in self._names if (name, self._reference) in self._picks
            ]

    # drawing

    def _draw(self, shown: _SideBySide) -> None:
        with self._lock:
            self._shown = shown
            for side in _SIDES:
                self._stage.scene.cloud(LAYER, side, shown.clouds[side] + shown.moved(side), shown.colours[side])
            self._stage.scene.show(LAYER, bool(self._on))
            self._mark()
            self._look()

    def _look(self) -> None:
        shown = self._shown
        if self._on and shown is not None and shown.pair == self._pair:
            self._stage.viewpoints.at(f"{LAYER} {shown.pair}", self.seen)

    def _mark(self) -> None:
        """The numbered places, on both clouds."""
        shown, scene = self._shown, self._stage.scene
        wanted: dict[str, tuple[np.ndarray, str, Side]] = {}
        ball = 0.0 if shown is None else _BALL * shown.wide_mm
        if shown is not None and shown.pair == self._pair:
            picks = self._picks[shown.pair]
            for k, pair in enumerate([*picks.pairs, picks.begun], 1):
                for side, point in pair.items():
                    wanted[f"{side} {k}"] = point + shown.moved(side), str(k), side
        for name in self._marked.keys() - wanted.keys():
            scene.remove(LAYER, name)
        for name, (point, text, side) in wanted.items():
            if self._marked.get(name) != tuple(point):
                scene.mark(LAYER, name, point, text, _MARKS[side], ball)
        self._marked = {name: tuple(point) for name, (point, _, _) in wanted.items()}

    def _say(self, on: bool) -> None:
        """What to click next, and how well the pairs go together."""
        pair = self._pair
        if not on or pair is None:
            self._now.set("")
            self._table.set("")
            change(self._undo, visible=False)
            return
        picks = self._picks[pair]
        if self._on:
            self._now.set(boxed(self._sentence(pair, picks), "info"))
        else:
            self._now.say("To pick more, show scan and reference side by side.", "dim")
        self._table.set(_pairs_words(picks) + self._others())
        change(self._undo, visible=bool(picks.pairs or picks.begun))

    def _sentence(self, pair: Pair, picks: _Picks) -> Html:
        called = {
            side: f"{patch(_MARKS[side])} <b>{cell(self._labels.get(name, name))}</b> {_WHERE[side]}"
            for side, name in zip(_SIDES, pair, strict=True)
        }
        number = f"Pair {len(picks.pairs) + 1}: "
        if picks.begun:
            missing = next(side for side in _SIDES if side not in picks.begun)
            return Html(f"{number}now click the same place on {called[missing]}.")
        if len(picks.pairs) >= LEAST_PICKS:
            return Html(f"{len(picks.pairs)} pairs: press Merge, or pick one more on both clouds.")
        return Html(
            f"{number}click a place on {called['scan']}, then the same place on {called['onto']}. "
            f"{LEAST_PICKS} pairs or more, well apart; corners and edges are best."
        )

    def _others(self) -> Html:
        """How many pairs the other scans have."""
        if len(self._names) < 2 or not any(picks.pairs for picks in self._current()):
            return Html("")
        words = []
        for name in self._names:
            n = len(self._picks[name, self._reference].pairs)
            counted = f"{n} pair{'s' * (n != 1)}" if n else "none, begins by its shape"
            words.append(
                f"{self._labels.get(name, name)}: {counted}" + (", too few yet" if 0 < n < LEAST_PICKS else "")
            )
        return block(toned("; ".join(words), "dim"))

    # clicks

    def _click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        shown, wish = self._shown, f"click {next(self._clicks)}"
        if shown is None:
            return

        def found(met: tuple[Side, np.ndarray] | None) -> None:
            self._painter.forget(wish)
            with self._lock:
                if met is None or shown.pair != self._pair or not self._on:
                    return
                self._picks[shown.pair].add(*met)
            self._changed()

        self._painter.ask(wish, None, lambda: shown.hit(origin, direction / np.linalg.norm(direction)), found)

    def _take_back(self) -> None:
        with self._lock:
            if (pair := self._pair) is not None:
                self._picks[pair].undo()
        self._changed()


def _pairs_words(picks: _Picks) -> Html:
    """How far the picked places stay apart at best, pair by pair."""
    n = len(picks.pairs)
    if n < LEAST_PICKS:
        return block(toned(f"{n} of {LEAST_PICKS} pairs picked", "dim"))
    try:
        _, apart = fit_picked_start(*picks.points)
    except SlviewerError as error:
        return boxed(str(error), "warning")
    rows = [(f"Pair {k}", f"{mm:.2f} mm") for k, mm in enumerate(apart, 1)]
    return table(("The pairs stay apart by", f"RMS {np.sqrt(np.mean(apart**2)):.2f} mm"), rows)


def _side_by_side(session: Any, pair: Pair) -> _SideBySide:
    """The scan moved beside the reference, to its left and as far away as one looks at it first."""
    found: dict[Side, ScanCloud] = {side: scan_cloud(session, name) for side, name in zip(_SIDES, pair, strict=True)}
    flat = {side: cloud.points[np.isfinite(cloud.points[..., 2])].astype(np.float64) for side, cloud in found.items()}
    wide = max(float(np.ptp(np.percentile(points @ ASIDE, [1, 99]))) for points in flat.values())
    shift = np.median(flat["onto"], axis=0) - np.median(flat["scan"], axis=0) - (1 + _APART) * wide * ASIDE
    painted: dict[Side, np.ndarray] = {}
    for side, cloud in found.items():
        texture = cloud.texture
        painted[side] = texture if texture.ndim == 3 else np.repeat(texture[..., None], 3, axis=2)
    return _SideBySide(pair, {side: cloud.points for side, cloud in found.items()}, painted, shift, wide)
