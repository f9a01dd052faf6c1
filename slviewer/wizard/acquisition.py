"""The one thread that owns camera and projector: it shows, grabs, saves, and computes nothing of its own.

Between captures it grabs previews and hands on the latest one. A capture is saved by the request's own `save` before
anything else happens, or it never existed. A fault ends the capture in which it happens, with a sentence; the devices
are then closed and opened again, every `RETRY_S` until they answer, and the preview goes on. Other work that needs the
open devices, such as a check of the rig, takes its turn among the captures, and ends and fails as they do. A stream
takes the place of the previews until anything else is asked for.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from slviewer.devices.capture import Taken, take
from slviewer.devices.protocols import CameraSettings, Rig
from slviewer.errors import Cancelled, DeviceError, SlviewerError
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.feedback import Progress
from slviewer.wizard.live_frames import Stream
from slviewer.wizard.notices import Notices, words_for
from slviewer.wizard.snapshot import CaptureProgress, RigView

RETRY_S = 2.0
PREVIEWS_PER_S = 10.0
PREVIEWS_OF_STREAM_PER_S = 4.0  # the clouds are what is looked at then
LIGHTS = {"white": 255, "grey": 128, "dark": None}
"""What the projector may show between captures, as grey levels; "pattern" is a sequence's first frame."""

_STREAM = "stream"  # what a stream lights by, among the lights

T = TypeVar("T")


@dataclass(frozen=True)
class CaptureRequest:
    """`save(taken)` must put the capture on disk, and is called on the acquisition thread; `saved` after it.

    The frames that are taken, in each of `exposures_ms` where there are any, are this thread's own and overwritten by
    the next capture.
    """

    name: str
    sequence: PatternSequence
    save: Callable[[Taken], None]
    saved: Callable[[], None]
    exposures_ms: tuple[float, ...] = ()

    @property
    def frames(self) -> int:
        """How many are taken."""
        return len(self.sequence.frames) * max(1, len(self.exposures_ms))


@dataclass(frozen=True)
class _Task:
    """Work with the open rig that is no capture."""

    name: str
    work: Callable[[Rig, Progress], Any]
    done: Callable[[Any], None]


class Acquisition:
    """The devices and what is asked of them. Every method may be called from any thread, and returns at once.

    `offer(frame)` is given every preview (h, w), a fresh array each, and must return at once too.
    """

    def __init__(self, notices: Notices, changed: Callable[[], None], offer: Callable[[np.ndarray], None]) -> None:
        self._notices, self._changed, self._offer = notices, changed, offer
        self._condition = threading.Condition()
        self._requests: deque[CaptureRequest | _Task] = deque()
        self._wanted: Rig | None = None
        self._settings: CameraSettings | None = None
        self._light: tuple[str, PatternSequence | None] = ("white", None)
        self._view = RigView()
        self._stream: Stream | None = None
        self._cancel = False
        self._closing = False
        self._thread: threading.Thread | None = None
        # the thread's own:
        self._rig: Rig | None = None
        self._is_open = False
        self._next_try = 0.0
        self._next_preview = 0.0  # of a stream
        self._applied: CameraSettings | None = None
        self._lit: tuple[str, PatternSequence | None] | None = None
        self._buffer: np.ndarray | None = None

    def use(self, rig: Rig | None, settings: CameraSettings | None = None) -> None:
        """Take another rig, with these settings (its own where None), in white light; None: no rig.

        What runs with the one before is cancelled, what waits is not taken, and it is closed.
        """
        with self._condition:
            self._wanted, self._settings = rig, settings
            given_up = [request.name for request in self._requests]
            stream, self._stream = self._stream, None
            self._requests.clear()
            self._cancel = self._view.capture is not None
            self._light = ("white", None)  # a pattern is made for one projector
            self._view = RigView(light="white", capture=self._view.capture)
            if rig is not None:
                self._view = replace(
                    self._view, state="opening", name=rig.name, camera=rig.camera.size, projector=rig.projector.size
                )
            if self._thread is None and rig is not None:
                self._thread = threading.Thread(target=self._serve, name="slviewer acquisition", daemon=True)
                self._thread.start()
            self._condition.notify_all()
        for name in given_up:
            self._notices.tell("info", f"{name}: not taken, another rig was chosen")
        if stream is not None:
            stream.ended()
        self._changed()

    def apply(self, settings: CameraSettings) -> None:
        """Set exposure and gain before the next frame; the view then says what the camera really took."""
        with self._condition:
            self._settings = settings
            self._condition.notify_all()

    def set_delay(self, settle_ms: float) -> None:
        """Wait so long between "shown" and the grab from the next capture on; the devices stay open."""
        with self._condition:
            if self._wanted is not None:
                settled = replace(self._wanted, settle_ms=settle_ms)
                self._rig = settled if self._rig is self._wanted else self._rig
                self._wanted = settled

    def shine(self, light: str, pattern: PatternSequence | None = None) -> None:
        """Show one of LIGHTS between captures, or the first frame of `pattern`."""
        with self._condition:
            self._light = (light, None if light in LIGHTS else pattern)
            self._view = replace(self._view, light=light)
            self._condition.notify_all()
        self._changed()

    def capture(self, request: CaptureRequest) -> None:
        """Queue a capture. Raises DeviceError where no rig is open."""
        self._queue(request, "captured")

    def run(self, name: str, task: Callable[[Rig, Progress], T], done: Callable[[T], None]) -> None:
        """Queue other work with the open rig; `done(result)` is called on this thread, and must return at once.

        The task may show, grab and set what it likes: the light and the settings of before are restored after it. Its
        progress is seen in `view().capture`, and cancels it. What it raises is told as a capture's fault is. Raises
        DeviceError where no rig is open.
        """
        self._queue(_Task(name, task, done), "done")

    def stream(self, stream: Stream) -> None:
        """Show and grab this over and over, in place of previews: until `unstream`, a request, another rig or a fault,
        each of which calls `stream.ended()`. Raises DeviceError where no rig is open or something else runs on it.
        """
        with self._condition:
            if self._view.state != "open":
                raise DeviceError(self._view.fault or "choose a rig first, and wait until its preview runs")
            if self._requests or self._view.capture is not None:
                raise DeviceError("a capture is on its way: wait for it, or cancel it")
            before, self._stream = self._stream, stream
            self._condition.notify_all()
        if before is not None:
            before.ended()

    def unstream(self) -> None:
        """End the stream, if there is one; its devices are free within a frame."""
        with self._condition:
            stream, self._stream = self._stream, None
            self._condition.notify_all()
        if stream is not None:
            stream.ended()

    def cancel(self) -> None:
        """Stop the capture or the task that runs, and forget those that wait."""
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
        """Captures and tasks that run or wait."""
        with self._condition:
            running = [] if self._view.capture is None else [self._view.capture.name]
            return running + [request.name for request in self._requests]

    def view(self) -> RigView:
        """The devices as they are now."""
        with self._condition:
            capture = self._view.capture
            if capture is None:
                return self._view
            return replace(self._view, capture=replace(capture, waiting=len(self._requests)))

    def close(self) -> None:
        """End a running capture, close the devices and join the thread."""
        with self._condition:
            self._closing, self._cancel = True, True
            self._requests.clear()
            self._condition.notify_all()
        self.unstream()
        if self._thread is not None:
            self._thread.join(5.0)

    def _queue(self, request: CaptureRequest | _Task, done: str) -> None:
        with self._condition:
            if self._view.state != "open":
                why = self._view.fault or "choose a rig first, and wait until its preview runs"
                raise DeviceError(f"{request.name} cannot be {done}: {why}")
            self._requests.append(request)
            self._condition.notify_all()
        self.unstream()

    # on the thread

    def _serve(self) -> None:
        preview = 0.0
        while True:
            with self._condition:
                if self._closing:
                    break
                request = None
                if self._is_open and self._rig is self._wanted and self._requests:
                    request = self._requests.popleft()
                    self._cancel = False
                    n = request.frames if isinstance(request, CaptureRequest) else 0
                    self._view = replace(self._view, capture=CaptureProgress(request.name, 0, n, 0))
                wanted, stream = self._wanted, self._stream
            try:
                if self._rig is not wanted:
                    self._close_devices()
                    self._rig, self._next_try = wanted, 0.0
                elif request is not None:
                    self._serve_request(request)
                    preview = 0.0
                elif wanted is not None and not self._is_open:
                    if time.monotonic() >= self._next_try:
                        self._open_devices()
                elif self._is_open and stream is not None:
                    self._flow(stream)
                elif self._is_open and time.monotonic() >= preview:
                    preview = time.monotonic() + 1 / PREVIEWS_PER_S
                    self._preview()
            except Exception as error:
                self._lose(error)
            self._sleep(preview)
        self._close_devices()

    def _sleep(self, preview: float) -> None:
        with self._condition:
            if self._closing or self._requests or self._rig is not self._wanted:
                return
            if self._is_open and self._stream is not None:
                return
            until = preview if self._is_open else self._next_try
            pause = RETRY_S if self._rig is None else until - time.monotonic()
            if pause > 0:
                self._condition.wait(min(pause, RETRY_S))

    def _open_devices(self) -> None:
        assert self._rig is not None
        self._next_try = time.monotonic() + RETRY_S
        self._rig.open()
        self._is_open, self._applied, self._lit = True, None, None
        self._preview()  # devices that open and then do not answer are not well
        back = self.view().fault
        self._say(state="open", fault="")
        if back:
            self._notices.tell("good", "the rig answers again")

    def _prepare(self) -> None:
        """Light and settings as they were asked for last."""
        assert self._rig is not None
        self._set_camera()
        with self._condition:
            light = self._light
        if light != self._lit:
            name, pattern = light
            if pattern is None:
                self._rig.projector.show_level(LIGHTS.get(name, 255))
            else:
                self._rig.projector.load(pattern)
                self._rig.projector.show(0)
            self._lit = light

    def _set_camera(self) -> None:
        """Settings as they were asked for last."""
        assert self._rig is not None
        with self._condition:
            settings = self._settings
        if self._applied is None or settings != self._applied:
            taken = self._rig.camera.settings() if settings is None else self._rig.camera.apply(settings)
            self._applied = settings
            if settings is None:
                self._applied = taken
                with self._condition:
                    self._settings = self._settings or taken  # somebody may have set it meanwhile
            notes = tuple(getattr(self._rig.camera, "notes", ()))  # of drivers that keep some
            self._say(exposure_ms=taken.exposure_ms, gain=taken.gain, notes=notes)

    def _preview(self) -> None:
        assert self._rig is not None
        self._prepare()
        width, height = self._rig.camera.size
        frame = np.empty((height, width), self._rig.camera.dtype)
        self._rig.camera.grab(frame)
        self._offer(frame)

    def _flow(self, stream: Stream) -> None:
        """One round of a stream, broken off where something else is wanted."""
        assert self._rig is not None
        self._set_camera()
        try:
            if self._lit != (_STREAM, stream.sequence):
                self._rig.projector.load(stream.sequence)
                self._lit = (_STREAM, stream.sequence)
            view = self.view()
            settings = CameraSettings(view.exposure_ms, view.gain)
            white = stream.take(self._rig, settings, lambda: bool(self._closing or self._stream is not stream))
        except DeviceError:
            raise
        except SlviewerError as error:  # the patterns: the devices are well
            self._notices.tell("error", str(error))
            self.unstream()
            return
        if white is not None and time.monotonic() >= self._next_preview:
            self._next_preview = time.monotonic() + 1 / PREVIEWS_OF_STREAM_PER_S
            self._offer(white)

    def _serve_request(self, request: CaptureRequest | _Task) -> None:
        try:
            self._prepare()
            self._lit = None  # what is shown and set from here on is the request's
            if isinstance(request, CaptureRequest):
                self._take(request)
            else:
                self._do(request)
        except Cancelled:
            kept = ", nothing is kept of it" if isinstance(request, CaptureRequest) else ""
            self._notices.tell("info", f"{request.name}: cancelled{kept}")
        except DeviceError:
            raise
        except SlviewerError as error:  # the disk refused, or the patterns: the devices are well
            self._notices.tell("error", f"{request.name}: {error}")
        finally:
            with self._condition:
                self._view = replace(self._view, capture=None)  # whichever rig is wanted by now
            self._changed()

    def _take(self, request: CaptureRequest) -> None:
        assert self._rig is not None
        taken = take(self._rig, request.sequence, request.exposures_ms, self._frames(request.frames), self._count)
        request.save(taken)
        request.saved()

    def _do(self, task: _Task) -> None:
        assert self._rig is not None
        self._applied = None
        task.done(task.work(self._rig, self._share))

    def _frames(self, count: int) -> np.ndarray:
        """One buffer for all captures of one size: page faults of a fresh one would cost the frame rate."""
        assert self._rig is not None
        width, height = self._rig.camera.size
        shape, dtype = (count, height, width), self._rig.camera.dtype
        if self._buffer is None or self._buffer.shape != shape or self._buffer.dtype != dtype:
            self._buffer = None  # before the next one is made
            self._buffer = np.empty(shape, dtype)
        return self._buffer

    def _count(self, frame: int, frames: int) -> None:
        self._progress(frame=frame, frames=frames)

    def _share(self, share: float, doing: str) -> None:
        self._progress(frame=round(100 * share), frames=100, doing=doing)

    def _progress(self, **changes: object) -> None:
        if self._cancel:
            raise Cancelled("cancelled")
        with self._condition:
            current = self._view.capture
            if current is not None:
                self._view = replace(self._view, capture=replace(current, **changes))  # type: ignore[arg-type]
        self._changed()

    def _lose(self, error: Exception) -> None:
        """Give the devices up until they open again."""
        sentence = words_for("the rig", error)
        self._close_devices()
        with self._condition:
            first = not self._view.fault
            waiting = len(self._requests)
            self._requests.clear()
            stream, self._stream = self._stream, None
            if self._rig is self._wanted:
                self._view = replace(self._view, state="lost", fault=sentence, capture=None)
        if first:
            also = {0: "", 1: "; the capture that waited is not taken"}.get(
                waiting, f"; the {waiting} captures that waited are not taken"
            )
            self._notices.tell("error", sentence + also)
        if stream is not None:
            stream.ended()
        self._changed()

    def _close_devices(self) -> None:
        if self._rig is not None and self._is_open:
            self._is_open = False
            try:
                self._rig.close()
            except Exception as error:  # no device may end the thread that could open it again
                words_for("closing the rig", error)

    def _say(self, **changes: object) -> None:
        with self._condition:
            if self._rig is self._wanted:
                self._view = replace(self._view, **changes)  # type: ignore[arg-type]
        self._changed()
