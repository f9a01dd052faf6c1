"""Live scanning: a short capture becomes a cloud while the next one is captured, and listeners get
the newest.

The devices' thread fills a `Stream`, and a thread of the live scan computes the clouds and calls
the listeners, which must return at once. Nothing is saved unless the operator saves it. What
moves during a capture is masked: there, even a handful of frames contradict each other."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.decode import decode
from slviewer.fringe.layout import to_eight_bits
from slviewer.fringe.motion_mask import mask_motion
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.geometry import cuda_device
from slviewer.geometry.rig import StereoRig
from slviewer.pipeline.cloud_corrections import scale_factor
from slviewer.pipeline.models import (
    accepts_rejected,
    check_accepted,
    load_model,
    load_stereo,
    preferred_model,
)
from slviewer.reconstruction.axis_agreement import check_sizes
from slviewer.reconstruction.onepass import OnePass, PassResult
from slviewer.reconstruction.onepass_cuda import has_pass, one_pass
from slviewer.reconstruction.reconstruct import Model
from slviewer.session.store import Session
from slviewer.wizard.acquisition import Acquisition, Stream
from slviewer.wizard.jobs import Notices, release_memory
from slviewer.wizard.service import Service
from slviewer.wizard.snapshot import LiveView

REPORTS_PER_S = 3.0
# rates are averages over this time, or over the last two clouds where these came more slowly
_AVERAGED_S = 2.0
_MOST_EVENTS = 1000  # whose times are remembered
_RELOAD_S = 1.0  # between two checks whether the calibration has changed
_RELEASE_S = 30.0  # between two releases of freed memory


@dataclass(frozen=True, eq=False)
class LiveCloud:
    """One cloud on the camera's grid: points (h, w, 3) float32 mm, NaN where not measured, and
    texture (h, w) uint8.

    `begun`: the time of its first frame, by `time.monotonic`. Its arrays are never written again.
    """

    number: int
    points: np.ndarray
    texture: np.ndarray
    begun: float


@dataclass(eq=False)
class LiveModel:
    """Reconstructs short captures: a sequence, a calibration, and the scale applied to it. For one
    thread at a time.

    ``calibrated``: the rig whose sizes the frames must have; ``depths_mm``: nearest and farthest
    depth that it was calibrated at, None where that is not known.
    """

    sequence: PatternSequence
    axis: Axis
    model: Model
    factor: float = 1.0
    calibrated: StereoRig | None = None
    depths_mm: tuple[float, float] | None = None
    _fast: OnePass | None = field(init=False, repr=False, default=None)
    _before: PassResult | None = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        if has_pass(self.model):
            self._fast = one_pass(self.sequence, self.model, self.axis)

    def cloud(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Reconstruct frames (n, h, w): (points (h, w, 3) float32 mm, texture (h, w) uint8), both
        new arrays.

        As in `reconstruct`, but what moved between the frames is NaN too. Raises InputError for
        frames of another sequence or camera.
        """
        if self.calibrated:
            height, width = frames.shape[1:]
            check_sizes(
                "the live scan", (width, height), self.sequence.projector_size, self.calibrated
            )
        if self._fast:
            before = self._before  # whose other arrays are used again
            out = None if before is None else replace(before, points=np.empty_like(before.points))
            scan = self._fast.run(frames, out=out)
            self._before, points = scan, scan.points
            phase, modulation, noise = scan.phase, scan.modulation, scan.light.noise
        else:
            decoded = decode(self.sequence, frames, self.axis)
            points = self.model.points(decoded)
            phase, modulation, noise = decoded.phase, decoded.modulation, decoded.noise
        mask_motion(self.sequence, frames, self.axis, phase, modulation, noise, points)
        if self.factor != 1.0:
            points *= np.float32(self.factor)
        return points, np.array(to_eight_bits(frames[-1], self.sequence.full_scale))

    def share_outside(self, points: np.ndarray) -> float:
        """Return the share of points (h, w, 3) mm, of every fourth row and column, outside the
        calibrated depths; 0 where these are not known, or there are no points."""
        z = points[::4, ::4, 2]
        z = z[np.isfinite(z)]
        if self.depths_mm is None or not len(z):
            return 0.0
        near, far = (self.factor * mm for mm in self.depths_mm)
        return float(np.mean((z < near) | (z > far)))


class LiveScan(Service):
    """A live scan, from its start to its end.

    `publish(cloud)` is called with every cloud on the scan's own thread, `changed()` when figures
    changed or it ended. `figures` and `count_shown` may be called from any thread.
    """

    def __init__(
        self,
        store: Session,
        axis: Axis,
        sequence: PatternSequence,
        acquisition: Acquisition,
        notices: Notices,
        publish: Callable[[LiveCloud], None],
        changed: Callable[[], None],
    ) -> None:
        super().__init__("slviewer live")
        self._store, self.axis, self._acquisition, self._notices = store, axis, acquisition, notices
        self._publish, self._changed = publish, changed
        self.stream = Stream(sequence, changed)
        # time and latency, s, of the latest clouds
        self._made: deque[tuple[float, float]] = deque(maxlen=_MOST_EVENTS)
        self._sent: deque[tuple[float, float]] = deque(maxlen=_MOST_EVENTS)
        self._points, self._outside, self._number, self._reported = 0, 0.0, 0, 0.0
        self._model: LiveModel | None = None  # of the calibration of this key, checked at that time
        self._key: tuple[object, ...] = ()
        self._loaded = 0.0

    def start(self) -> None:
        """Start capturing. Raises DeviceError if the rig is not ready, SlviewerError without a
        usable calibration."""
        self._load_model()
        self._acquisition.stream(self.stream)
        self._made.append((time.monotonic(), 0.0))  # the first cloud has a rate too
        self._thread.start()

    @property
    def is_running(self) -> bool:
        """Whether the live scan has not ended."""
        return not self.stream.has_ended

    def count_shown(self, cloud: LiveCloud) -> None:
        """Record that a cloud was sent to the browsers, for rate and latency."""
        now = time.monotonic()
        with self._condition:
            self._sent.append((now, now - cloud.begun))

    def figures(self) -> LiveView:
        """Return the rates and the median latency of the last seconds."""
        now = time.monotonic()
        with self._condition:
            rates = _compute_rate(self._made, now), _compute_rate(self._sent, now)
            late_s = [late for _, late in self._sent]
            return LiveView(
                *rates,
                1e3 * float(np.median(late_s)) if late_s else None,
                self._points,
                self._outside,
            )

    def _serve(self) -> None:
        """Compute and publish a cloud of each new capture until the stream ends; a failure ends it
        with a notice."""
        released = time.monotonic()
        while (shot := self.stream.wait_next()) is not None:
            card = cuda_device.find_device()
            try:
                live = self._load_model()
                points, texture = live.cloud(shot.frames)
            except Exception as error:
                self._notices.add_failure("Live", error)
                self._acquisition.stop_stream()
                return
            if card and cuda_device.find_device() is None:
                text = (
                    f"{card} failed, or did not measure what the processor does: the processor"
                    " goes on. The log has the reason."
                )
                self._notices.add("warning", text)
            now = time.monotonic()
            with self._condition:
                self._made.append((now, now - shot.begun))
                self._number += 1
                self._points = int(np.count_nonzero(np.isfinite(points[..., 2])))
                self._outside = live.share_outside(points)
            if not self.is_running:
                return
            self._publish(LiveCloud(self._number, points, texture, shot.begun))
            if now - self._reported > 1 / REPORTS_PER_S:
                self._reported = now
                self._changed()
            if now - released > _RELEASE_S:
                released = now
                release_memory()

    def _load_model(self) -> LiveModel:
        """Return the model, checked for changes at most a second ago. Raises SlviewerError where
        none is usable."""
        now, store = time.monotonic(), self._store
        if self._model and now - self._loaded <= _RELOAD_S:
            return self._model
        self._loaded = now
        name = preferred_model(store)
        factor = scale_factor(store, name)
        key = (
            name,
            factor,
            accepts_rejected(store),
            *sorted(store.input_hashes(f"calibration/{name}").items()),
        )
        if self._model and key == self._key:
            return self._model
        check_accepted(store, accepts_rejected(store))
        model = load_model(store, name)
        if self.axis not in model.axes:
            raise InputError(
                f"the {name} calibration has no axis {self.axis}, which a live scan needs",
                "capture a scan",
            )
        self._key, stereo = key, load_stereo(store)
        self._model = LiveModel(
            self.stream.sequence, self.axis, model, factor, stereo.rig, stereo.depth_range_mm
        )
        return self._model


def _compute_rate(events: deque[tuple[float, float]], now: float) -> float:
    """Return the rate per second of events, (time in s, latency), less where none has come for
    long; 0 for fewer than two. Those before the averaging window are removed, but the last two."""
    while len(events) > 2 and now - events[0][0] > _AVERAGED_S:
        events.popleft()
    if len(events) < 2:
        return 0.0
    first, last = events[0][0], events[-1][0]
    return (len(events) - 1) / max(last - first, now - last, 1e-6)
