"""The thread that owns camera and projector: it shows, grabs and saves, and computes nothing.

Between captures it grabs previews and offers the latest one. A capture is saved by its own
`save` before anything else happens, or it never existed. A fault ends the capture in which it
happens, with a notice; the devices are then closed, and opened again and again until they
answer, and the preview goes on. Other work that needs the open devices, such as a check of the rig,
is queued among the captures, and ends and fails as they do. A stream replaces the previews until
anything else is requested.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from slviewer.devices.capture import CapturedFrames, capture_with_texture, settle
from slviewer.devices.protocols import (
    CameraSettings,
    ImageProjector,
    Rig,
    list_changed_settings,
    list_notes,
    preview_interval,
    scene_state,
    stated_full_scale,
)
from slviewer.errors import Cancelled, DeviceError, SlviewerError, TurntableError
from slviewer.fringe.sequence import PatternSequence
from slviewer.geometry.cuda_device import allocate_frames
from slviewer.pipeline.operation import Progress
from slviewer.wizard.jobs import Notices, describe_failure
from slviewer.wizard.service import Service, Timing
from slviewer.wizard.snapshot import CaptureProgress, RigView

STREAM_PREVIEWS_PER_S = 4.0  # the clouds matter more then
UNSEEN_PREVIEW_S = 5.0
"""Between previews that nobody sees: by them a lost rig is noticed."""
_NOT_OPEN = "choose a rig first, and wait until its preview runs"
LIGHTS = {"white": 255, "grey": 128, "dark": None}
"""What the projector may show between captures, as grey levels; "pattern" is a sequence's first
frame, "image" an image."""


@dataclass(frozen=True, eq=False)
class ShownImage:
    """An image (h, w, 3) uint8 RGB for the projector. Equal to itself alone."""

    pixels: np.ndarray


Light = tuple[str, PatternSequence | ShownImage | None]

_STREAM = "stream"  # what it shows during a stream

T = TypeVar("T")


@dataclass(eq=False)
class LiveCapture:
    """One short capture: frames (n, h, w), the time of its first frame by `time.monotonic`, and the
    settings."""

    frames: np.ndarray
    begun: float
    settings: CameraSettings


class Stream:
    """A pattern sequence that is captured repeatedly; a reader gets the newest complete capture.

    `capture` is called by the thread that owns the devices, `wait_next` by one that reads, the
    others by any. At most three buffers exist: one being filled, one waiting, and one being read.
    `on_end` is called once, on the thread that ends it.
    """

    def __init__(self, sequence: PatternSequence, on_end: Callable[[], None]) -> None:
        self.sequence, self._on_end = sequence, on_end
        self._condition = threading.Condition()
        self._free: list[np.ndarray] = []
        self._waiting: LiveCapture | None = None
        self._read: LiveCapture | None = None
        self.has_ended = False
        self.captured = 0
        """Number of complete captures, including those that were not read."""

    def capture(
        self, rig: Rig, settings: CameraSettings, stopped: Callable[[], bool]
    ) -> np.ndarray | None:
        """Show and grab every frame of the sequence, which the rig's projector has loaded.

        Returns a copy of the last frame (h, w), or None, and drops the capture, once `stopped()`.
        Raises DeviceError.
        """
        count, (width, height) = len(self.sequence.frames), rig.camera.size
        shape, dtype = (count, height, width), rig.camera.dtype
        with self._condition:
            frames = self._free.pop() if self._free else None
        if frames is None or frames.shape != shape or frames.dtype != dtype:
            frames = allocate_frames(shape, dtype)
        begun = time.monotonic()
        for k in range(count):
            if stopped():
                break
            rig.projector.show(k)
            settle(rig)
            rig.camera.grab(frames[k])
        else:
            # a change during this exposure is reported at the next call
            rig.projector.show(count - 1)
            last = frames[-1].copy()
            with self._condition:
                self._recycle(self._waiting)  # it was not read
                self._waiting = LiveCapture(frames, begun, settings)
                self.captured += 1
                self._condition.notify_all()
            return last
        with self._condition:
            self._free.append(frames)
        return None

    def wait_next(self) -> LiveCapture | None:
        """Wait for the newest capture that was not read yet, and return it; None once the stream
        has ended.

        Its frames stay valid until the next call.
        """
        with self._condition:
            self._condition.wait_for(lambda: self.has_ended or self._waiting is not None)
            if self.has_ended:
                return None
            self._recycle(self._read)
            self._read, self._waiting = self._waiting, None
            return self._read

    def copy_latest(self) -> LiveCapture | None:
        """Return a copy of the capture that was read last; None before the first."""
        with self._condition:
            if self._read is None:
                return None
            return LiveCapture(self._read.frames.copy(), self._read.begun, self._read.settings)

    def end(self) -> None:
        """End the stream: no further captures, and waiting readers get None."""
        with self._condition:
            first, self.has_ended = not self.has_ended, True
            self._condition.notify_all()
        if first:
            self._on_end()

    def _recycle(self, shot: LiveCapture | None) -> None:
        """Return the buffer of a capture, if there is one, to the free list."""
        if shot:
            self._free.append(shot.frames)


@dataclass(frozen=True)
class _Task:
    """Work with the open rig; `frames`: of a capture, 0 for other work."""

    name: str
    work: Callable[[Rig, Progress], None]
    frames: int = 0


class Acquisition(Service):
    """Owns the devices and the queue of requests. Every method may be called from any thread, and
    returns at once.

    `offer(frame, full_scale, second)` gets every preview (h, w), a fresh array each, what the
    camera states as its full scale, and the second camera's frame or None; it must return at once
    too. `clock()` returns the time in s.
    """

    def __init__(
        self,
        notices: Notices,
        changed: Callable[[], None],
        offer: Callable[..., None],
        timing: Timing,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__("slviewer acquisition")
        self._notices, self._changed, self._offer = notices, changed, offer
        self._timing, self._clock = timing, clock
        self._requests: deque[_Task] = deque()
        self._wanted: Rig | None = None
        self._settings: CameraSettings | None = None
        self._light: Light = ("white", None)
        self._view = RigView()
        self._stream: Stream | None = None
        self._cancel = False
        self.is_seen = True
        """Whether somebody sees the previews: then each is grabbed, unless the camera states that
        its image is still the same."""
        self.is_followed = False
        """Whether each preview is judged, of a still image too, for a hands-free capture."""
        # the thread's own:
        self._rig: Rig | None = None
        self._is_open = False
        self._next_try = self._next_preview = self._grabbed = 0.0
        self._scene: object = None  # of the latest preview
        self._applied: CameraSettings | None = None
        self._shown: Light | None = None
        self._buffer: np.ndarray | None = None

    def use(self, rig: Rig | None, settings: CameraSettings | None = None, fault: str = "") -> None:
        """Use another rig, with these settings (its own where None), in white light; None: no rig,
        for the reason that is its ``fault``.

        The previous rig is closed; its running capture is cancelled, and waiting ones are dropped.
        """
        with self._condition:
            self._wanted, self._settings = rig, settings
            dropped = [request.name for request in self._requests]
            self._requests.clear()
            self._cancel = self._view.capture is not None
            self._light = ("white", None)  # a pattern is made for one projector
            self._view = RigView(
                "lost" if fault else "none", fault=fault, capture=self._view.capture
            )
            if rig:
                self._view = replace(
                    self._view, state="opening", name=rig.name, camera=rig.camera.size,
                    projector=rig.projector.size,
                    second=rig.second.size if rig.second else None,
                    turntable=rig.turntable.name if rig.turntable else "",
                )  # fmt: skip
                if not self._thread.ident:
                    self._thread.start()
            self._condition.notify_all()
        for name in dropped:
            self._notices.add("info", f"{name}: not captured, another rig was chosen")
        self.stop_stream()
        self._changed()

    def set_camera(self, settings: CameraSettings) -> None:
        """Set exposure and gain before the next frame; the view then has what the camera really
        uses."""
        with self._condition:
            self._settings, self._next_preview = settings, 0.0
            self._condition.notify_all()

    def set_delay(self, settle_ms: float) -> None:
        """Set the delay between showing and grabbing, from the next capture on; the devices stay
        open."""
        with self._condition:
            if self._wanted:
                settled = replace(self._wanted, settle_ms=settle_ms)
                self._rig = settled if self._rig is self._wanted else self._rig
                self._wanted = settled

    def set_light(self, light: str, pattern: PatternSequence | ShownImage | None = None) -> None:
        """Show one of LIGHTS between captures, the first frame of a `pattern`, or an image."""
        with self._condition:
            self._light = (light, None if light in LIGHTS else pattern)
            self._next_preview = 0.0
            self._condition.notify_all()
        self._change_view(light=light)

    def capture(
        self,
        name: str,
        sequence: PatternSequence,
        save: Callable[[CapturedFrames], object],
        exposures_ms: tuple[float, ...] = (),
    ) -> None:
        """Queue a capture, in each of the exposures where there are any; `save(captured)` is called
        with it, on this thread. Its frames are overwritten by the next one. Raises DeviceError
        where no rig is open."""
        frames = sequence.count_images(exposures_ms)

        def work(rig: Rig, _: Progress) -> None:
            """Capture the frames, and save them."""
            width, height = rig.camera.size
            shape, dtype = (frames, height, width), rig.camera.dtype
            out = self._buffer  # used again, to avoid page faults
            if out is None or out.shape != shape or out.dtype != dtype:
                out = self._buffer = None  # free it before the next one is allocated
                out = self._buffer = np.empty(shape, dtype)
            save(capture_with_texture(rig, sequence, exposures_ms, out, self._report_frame))

        self._queue(_Task(name, work, frames))

    def run_task(
        self, name: str, task: Callable[[Rig, Progress], T], done: Callable[[T], None]
    ) -> None:
        """Queue other work with the open rig; `done(result)` is called on this thread, and must
        return at once.

        The task may show, grab and set anything: light and settings are restored after it. Its
        progress appears in `view().capture`, and raises Cancelled. What the task raises is reported
        like a capture's fault. Raises DeviceError where no rig is open.
        """
        self._queue(_Task(name, lambda rig, progress: done(task(rig, progress))))

    def stream(self, stream: Stream) -> None:
        """Show and grab a stream repeatedly, in place of previews, until it is stopped.

        `stop_stream`, a request, another rig or a fault stop it, each of which calls
        `stream.end()`. Raises DeviceError where no rig is open or something else runs on it.
        """
        with self._condition:
            if self._view.state != "open":
                raise DeviceError(self._view.fault or _NOT_OPEN)
            if self._requests or self._view.capture:
                raise DeviceError("a capture is running", "wait for it, or cancel it")
            before, self._stream = self._stream, stream
            self._condition.notify_all()
        if before:
            before.end()

    def stop_stream(self) -> None:
        """End the stream, if there is one; the devices are free within a frame."""
        with self._condition:
            stream, self._stream = self._stream, None
            self._condition.notify_all()
        if stream:
            stream.end()

    def cancel(self) -> None:
        """Cancel the running capture or task, and those that wait."""
        with self._condition:
            self._requests.clear()
            self._cancel = self._view.capture is not None
        self._changed()

    @property
    def idle(self) -> bool:
        """Whether no capture and no task runs or waits."""
        with self._condition:
            return not self._requests and self._view.capture is None

    def names(self) -> list[str]:
        """Names of the captures and tasks that run or wait."""
        with self._condition:
            running = [] if self._view.capture is None else [self._view.capture.name]
            return running + [request.name for request in self._requests]

    def view(self) -> RigView:
        """Return the current state of the devices, with the number of waiting requests."""
        with self._condition:
            capture = self._view.capture
            if capture is None:
                return self._view
            return replace(self._view, capture=replace(capture, waiting=len(self._requests)))

    def close(self) -> None:
        """End a running capture, close the devices and join the thread."""
        self.cancel()
        self.stop_stream()
        super().close()

    def _queue(self, task: _Task) -> None:
        """Append a task to the queue, and end the stream. Raises DeviceError where no rig is
        open."""
        with self._condition:
            if self._view.state != "open":
                raise DeviceError(f"{task.name} is not possible: {self._view.fault or _NOT_OPEN}")
            self._requests.append(task)
        self.stop_stream()

    # on the thread

    def _serve(self) -> None:
        """Run the acquisition loop until closing: change rigs, open devices, serve requests,
        stream, grab previews."""
        while True:
            with self._condition:
                if self._closing:
                    break
                request = None
                if self._is_open and self._rig is self._wanted and self._requests:
                    request = self._requests.popleft()
                    self._cancel = False
                    progress = CaptureProgress(request.name, 0, request.frames, 0)
                    self._view = replace(self._view, capture=progress)
                wanted, stream = self._wanted, self._stream
            rig = self._rig
            try:
                if rig is not wanted:
                    self._close_devices()
                    self._rig, self._next_try = wanted, 0.0
                elif rig is None:
                    pass
                elif request:
                    self._serve_request(rig, request)
                    self._next_preview = 0.0
                elif not self._is_open:
                    if self._clock() >= self._next_try:
                        self._open_devices(rig)
                elif stream:
                    self._serve_stream(rig, stream)
                elif self._clock() >= self._next_preview:
                    least_s = 1 / self._timing.previews_per_s
                    self._next_preview = self._clock() + max(least_s, preview_interval(rig.camera))
                    self._prepare_devices(rig)
                    if self._needs_preview(rig):
                        self._grab_preview(rig)
            except Exception as error:
                self._handle_fault(error)
            self._wait_for_work()
        self._close_devices()

    def _wait_for_work(self) -> None:
        """Wait until the next preview or opening attempt is due, or a request arrives; do not wait
        while streaming."""
        with self._condition:
            if self._closing or self._requests or self._rig is not self._wanted:
                return
            if self._is_open and self._stream:
                return
            until = self._next_preview if self._is_open else self._next_try
            pause = self._timing.retry_s if self._rig is None else until - self._clock()
            if pause > 0:
                self._condition.wait(min(pause, self._timing.retry_s))

    def _open_devices(self, rig: Rig) -> None:
        """Open the rig's devices and grab a first preview; report a lost rig that answers again."""
        self._next_try = self._clock() + self._timing.retry_s
        rig.open()
        self._is_open, self._applied, self._shown = True, None, None
        self._grab_preview(rig)  # devices that open and then do not answer are not ready
        was_lost = bool(self.view().fault)
        self._update_view(state="open", fault="")
        if was_lost:
            self._notices.add("good", "the rig answers again")

    def _prepare_devices(self, rig: Rig) -> None:
        """Set camera and projector light as last requested."""
        self._apply_settings(rig)
        with self._condition:
            light = self._light
        if light != self._shown:
            name, pattern = light
            if pattern is None:
                rig.projector.show_level(LIGHTS.get(name, 255))
            elif isinstance(pattern, ShownImage):
                assert isinstance(rig.projector, ImageProjector)
                rig.projector.show_image(pattern.pixels)
            else:
                rig.projector.load(pattern)
                rig.projector.show(0)
            self._shown = light

    def _apply_settings(self, rig: Rig) -> None:
        """Apply changed camera settings; publish the applied exposure and gain, and the camera's
        notes."""
        with self._condition:
            settings = self._settings
        if self._applied is None or settings != self._applied:
            actual = rig.camera.settings() if settings is None else rig.camera.apply(settings)
            if rig.second is not None:
                rig.second.apply(actual)
            self._applied = settings or actual
            with self._condition:
                # another thread may have set it meanwhile
                self._settings = self._settings or actual
            notes = (
                *list_notes(rig.camera),
                *list_changed_settings(rig.camera, settings or actual, actual),
            )
            self._update_view(exposure_ms=actual.exposure_ms, gain=actual.gain, notes=notes)

    def _needs_preview(self, rig: Rig) -> bool:
        """Whether another preview may show somebody something new, or a lost rig."""
        scene = scene_state(rig.camera)
        if self.is_followed:
            return True
        if scene is not None and scene == self._scene:
            return False
        return self.is_seen or self._clock() - self._grabbed >= UNSEEN_PREVIEW_S

    def _grab_preview(self, rig: Rig) -> None:
        """Grab one frame (h, w) under the requested light, and offer it as a preview."""
        self._prepare_devices(rig)
        self._grabbed, self._scene = self._clock(), scene_state(rig.camera)
        width, height = rig.camera.size
        frame = np.empty((height, width), rig.camera.dtype)
        rig.camera.grab(frame)
        second = None
        if rig.second is not None:
            second = np.empty(rig.second.size[::-1], rig.second.dtype)
            rig.second.grab(second)
        self._offer(frame, stated_full_scale(rig.camera), second)

    def _serve_stream(self, rig: Rig, stream: Stream) -> None:
        """Capture a stream's sequence once, and show its white frame as preview. Aborted once
        `_stream` is another, which every request, change of the rig and fault causes."""
        self._apply_settings(rig)
        try:
            if self._shown != (_STREAM, stream.sequence):
                rig.projector.load(stream.sequence)
                self._shown = (_STREAM, stream.sequence)
            settings = CameraSettings(**self.view().exposure)
            white = stream.capture(
                rig, settings, lambda: bool(self._closing or self._stream is not stream)
            )
        except DeviceError:
            raise
        except SlviewerError as error:  # the patterns are wrong, not the devices
            self._notices.add("error", str(error))
            self.stop_stream()
            return
        if white is not None and self._clock() >= self._next_preview:
            self._next_preview = self._clock() + 1 / STREAM_PREVIEWS_PER_S
            self._offer(white, stated_full_scale(rig.camera), None)

    def _serve_request(self, rig: Rig, task: _Task) -> None:
        """Execute a queued task and report how it ended; a DeviceError is raised to the caller."""
        try:
            self._prepare_devices(rig)
            self._shown = None  # the task shows and sets its own from here on
            if not task.frames:
                self._applied = None
            task.work(rig, lambda share, stage: self._report_frame(round(100 * share), 100, stage))
        except Cancelled:
            self._notices.add("info", f"{task.name}: cancelled")
        except SlviewerError as error:
            # the disk, the patterns or the turntable: camera and projector work without these
            if isinstance(error, DeviceError) and not isinstance(error, TurntableError):
                raise
            self._notices.add("error", f"{task.name}: {error}")
        finally:
            self._change_view(capture=None)  # whichever rig is wanted by now

    def _report_frame(self, frame: int, frames: int, stage: str = "") -> None:
        """Publish the progress of the running capture, or the percent of a task and its stage.
        Raises Cancelled once it was cancelled."""
        if self._cancel:
            raise Cancelled("cancelled")
        with self._condition:
            if now := self._view.capture:
                progress = replace(now, frame=frame, frames=frames, stage=stage)
                self._view = replace(self._view, capture=progress)
        self._changed()

    def _handle_fault(self, error: Exception) -> None:
        """Report a device fault, close the devices, drop waiting requests and end the stream."""
        text = describe_failure("the rig", error)
        self._close_devices()
        with self._condition:
            first = not self._view.fault
            waiting = len(self._requests)
            self._requests.clear()
        self._update_view(state="lost", fault=text, capture=None)
        if first:
            dropped = f"; {waiting} waiting capture{'s' * (waiting > 1)} dropped" if waiting else ""
            self._notices.add("error", text + dropped)
        self.stop_stream()

    def _close_devices(self) -> None:
        """Close the open devices; what they raise is logged."""
        if self._rig and self._is_open:
            self._is_open = False
            try:
                self._rig.close()
            except Exception as error:  # no device may end the thread that could open it again
                describe_failure("closing the rig", error)

    def _update_view(self, **changes: Any) -> None:
        """Replace fields of the rig's view, unless another rig was chosen meanwhile, and notify."""
        with self._condition:
            if self._rig is self._wanted:
                self._view = replace(self._view, **changes)
        self._changed()

    def _change_view(self, **changes: Any) -> None:
        """Replace fields of the rig's view, and notify, without the lock: who is notified may hold
        one of its own, and ask for the view."""
        with self._condition:
            self._view = replace(self._view, **changes)
        self._changed()
