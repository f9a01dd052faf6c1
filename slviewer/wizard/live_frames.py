"""The frames of a live scan: short captures one after the other, in a few buffers; only the newest
counts."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slviewer.devices.capture import settle
from slviewer.devices.protocols import CameraSettings, Rig
from slviewer.fringe.sequence import PatternSequence
from slviewer.geometry.cuda_device import allocate_frames


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
