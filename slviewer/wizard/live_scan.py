"""Scanning live: short captures become clouds while the next is taken, and whoever looks gets the newest.

The devices' thread fills a `Stream`, a thread of this file's makes clouds of it, and each listener hears of them on
that thread, and must return at once. Nothing is saved but what the operator keeps.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from slviewer.devices.capture import Taken
from slviewer.errors import InputError
from slviewer.fringe.presets import short
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.pipeline.capture import keep
from slviewer.pipeline.models import check_accepted, insisted, load_model, load_stereo, preferred
from slviewer.pipeline.scale import scale_factor
from slviewer.session.store import Session
from slviewer.wizard.capture_requests import check_space, depth_axis, next_name
from slviewer.wizard.engine import Engine
from slviewer.wizard.live_frames import Shot, Stream
from slviewer.wizard.live_measuring import Measuring
from slviewer.wizard.snapshot import LiveView

TOLD_PER_S = 3.0
_OVER_S = 2.0  # figures are those of so many seconds
_LOOK_S = 1.0  # so often it is asked whether the calibration is another by now


@dataclass(frozen=True, eq=False)
class LiveCloud:
    """One cloud on the camera's grid: points (h, w, 3) float32 mm, NaN where not measured, and texture (h, w).

    `begun`: when the first of its frames was asked for, by `time.monotonic`. Its arrays are never written again.
    """

    number: int
    points: np.ndarray
    texture: np.ndarray
    begun: float


class Live:
    """A live scan, from its start to its end. `figures` and `shown` may be called from any thread."""

    def __init__(self, engine: Engine, axis: Axis, sequence: PatternSequence) -> None:
        self._engine, self._store, self.axis = engine, engine.store, axis
        self.stream = Stream(sequence, self._ended)
        self._lock = threading.Lock()
        self._made: deque[float] = deque()
        self._sent: deque[tuple[float, float]] = deque()
        self._points, self._number, self._told = 0, 0, 0.0
        self._model: Calibrated | None = None
        self._thread = threading.Thread(target=self._serve, name="slviewer live", daemon=True)

    def start(self) -> None:
        """Begin. Raises DeviceError where the rig cannot, SlviewerError where the session has no calibration to use."""
        self._model = Calibrated(self._store, self.stream.sequence, self.axis)
        self._engine.acquisition.stream(self.stream)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return not self.stream.over

    def shown(self, cloud: LiveCloud) -> None:
        """A cloud was sent to those who look."""
        now = time.monotonic()
        with self._lock:
            self._sent.append((now, now - cloud.begun))
            _forget(self._sent, now)

    def figures(self) -> LiveView:
        """Rates of the last two seconds."""
        now = time.monotonic()
        with self._lock:
            _forget(self._made, now)
            _forget(self._sent, now)
            behind = float(np.median([late for _, late in self._sent])) if self._sent else None
            return LiveView(
                clouds_per_s=_rate(self._made),
                shown_per_s=_rate([at for at, _ in self._sent]),
                behind_ms=None if behind is None else 1e3 * behind,
                points=self._points,
            )

    def _serve(self) -> None:
        while (shot := self.stream.next()) is not None:
            try:
                cloud = self._cloud(shot)
            except Exception as error:
                self._engine.notices.fail("Live", error)
                self._engine.acquisition.unstream()
                return
            now = time.monotonic()
            with self._lock:
                self._made.append(now)
                _forget(self._made, now)
            if not self.running:
                return
            for listener in self._engine.live_listeners:
                listener(cloud)
            if now - self._told > 1 / TOLD_PER_S:
                self._told = now
                self._engine.teller.changed()

    def _cloud(self, shot: Shot) -> LiveCloud:
        assert self._model is not None
        points, texture = self._model.current().cloud(shot.frames)
        self._number += 1
        self._points = int(np.count_nonzero(np.isfinite(points[..., 2])))
        return LiveCloud(self._number, points, texture, shot.begun)

    def _ended(self) -> None:
        self._engine.teller.changed()


class Calibrated:
    """The calibration that the session uses, also when it becomes another one meanwhile."""

    def __init__(self, store: Session, sequence: PatternSequence, axis: Axis) -> None:
        self._store, self._sequence, self._axis = store, sequence, axis
        self._key: tuple[object, ...] = ()
        self._looked = 0.0
        self._current = self._load()

    def current(self) -> Measuring:
        """As it is now, or was up to a second ago. Raises SlviewerError where there is none to use any more."""
        if time.monotonic() - self._looked > _LOOK_S:
            self._current = self._load()
        return self._current

    def _load(self) -> Measuring:
        store = self._store
        self._looked = time.monotonic()
        name = preferred(store)
        factor = scale_factor(store, name)
        key = (name, factor, insisted(store), *sorted(store.input_hashes(f"calibration/{name}").items()))
        if key == self._key:
            return self._current
        check_accepted(store, insisted(store))
        model = load_model(store, name)
        if self._axis not in model.axes:
            raise InputError(
                f"the {name} calibration has no axis {self._axis}, which a live scan needs: capture a scan"
            )
        self._key = key
        return Measuring(self._sequence, self._axis, model, factor, load_stereo(store).rig)


def start_live(engine: Engine) -> None:
    """Begin to scan live, in place of what runs so. Raises InputError, DeviceError, SlviewerError."""
    view = engine.teller.now().session
    if view is None or view.calibration is None:
        raise InputError("calibrate first: without a calibration nothing can be measured live")
    bench = engine.bench
    if bench is None:
        raise InputError("no rig is chosen: choose one in the step Rig")
    if bench.reel is not None:
        raise InputError("a recording answers to its own patterns alone: choose a real rig or the simulated one")
    axis = depth_axis(view.calibration)
    sequence = replace(short(bench.rig.projector.size, axis), levels=engine.reader.levels())
    live = Live(engine, axis, sequence)
    live.start()
    engine.live = live


def keep_live(engine: Engine, label: str, follow: Callable[[str], object]) -> None:
    """Save the capture of the latest live cloud as a scan, before this returns, and `follow(name)` then."""
    live, store = engine.live, engine.store
    shot = live.stream.kept() if live is not None and live.running else None
    if live is None or shot is None:
        raise InputError("nothing is scanned live: press Live first, and wait for a cloud")
    name = next_name(engine, "scan")
    check_space(engine, name, len(shot.frames))
    taken = Taken(shot.frames, shot.settings)
    source = engine.acquisition.view().name
    keep(store, name, "scan", live.stream.sequence, taken, source=source, purpose="scan")
    if label.strip():
        store.decide("names", {**(store.decision("names") or {}), name: label.strip()})
    engine.queue_unfinished()
    follow(name)


def _rate(times: "deque[float] | list[float]") -> float:
    """Per second, over the time that they span; 0 for fewer than two."""
    return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 0.0


def _forget(times: "deque[float] | deque[tuple[float, float]]", now: float) -> None:
    while times and now - (times[0][0] if isinstance(times[0], tuple) else times[0]) > _OVER_S:
        times.popleft()
