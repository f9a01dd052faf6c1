"""The rig under test: projects light, grabs and times images, and shares results between the
checks."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slviewer.devices.protocols import Rig, find_full_scale, report_driver_faults
from slviewer.fringe.layout import image_white
from slviewer.geometry.robust import robust_sigma

_PIXELS = 150_000
"""So many pixels of an image are looked at."""
_SETTLE_S = 0.35
_DISCARDED_GRABS = 4
"""What a reference waits for: longer than any projector and camera take between them."""
_MEAN = 8
_SIGMAS = 6.0
# one period of 100 Hz, over which images begin: at an even pace they may all see one phase
_SPREAD_S = 0.01
_GOLDEN = 0.618034


@dataclass(frozen=True)
class Clock:
    """Time in seconds that never runs backwards, and how to wait."""

    now: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep


SYSTEM_CLOCK = Clock()


class RigUnderTest:
    """An open rig. Images come as (h, w) float32 grey levels of every `stride`-th row and column.

    ``settle_ms`` and ``stale`` are the results of the latency check: the time to wait after a
    change, and how many images to throw away. ``dark`` and ``white`` are the references,
    ``illuminated`` (h, w) bool lit by the projector; ``noise`` of one grey level, and ``unsteady``,
    by how much whole images differ, as a share of the white light (rms).
    """

    def __init__(self, rig: Rig, tick: Callable[[str], None], clock: Clock = SYSTEM_CLOCK) -> None:
        self.rig, self._tick, self.clock = rig, tick, clock
        width, height = rig.camera.size
        self._frame = np.empty((height, width), rig.camera.dtype)
        self.stride = max(1, math.ceil(math.sqrt(width * height / _PIXELS)))
        self.settle_ms = rig.settle_ms
        self.stale = 0
        self.frame_ms = 0.0
        self.noise, self.unsteady = 0.0, 0.0
        shape = self._frame[:: self.stride, :: self.stride].shape
        self.dark, self.white = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self.illuminated = np.zeros(shape, bool)

    def grab(self) -> np.ndarray:
        """Grab the next image, sampled."""
        with report_driver_faults(self.rig.camera):
            self.rig.camera.grab(self._frame)
        return self._frame[:: self.stride, :: self.stride].astype(np.float32)

    def grab_timed(self) -> tuple[float, np.ndarray]:
        """The start time of grabbing, s of the clock, and the image (h, w), sampled."""
        start_s = self.clock.now()
        return start_s, self.grab()

    def grab_spread(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Start times (n,) s and images (n, h, w) of the next ``count`` images, spread over the
        mains period."""
        timed = []
        for k in range(count):
            self.clock.sleep(_SPREAD_S * (k * _GOLDEN % 1))
            timed.append(self.grab_timed())
        start_s, images = zip(*timed, strict=True)
        return np.array(start_s), np.stack(images)

    def show(self, grey: int | None, doing: str) -> None:
        """Project even light of a grey level, without waiting for it. May raise Cancelled."""
        self._tick(doing)
        with report_driver_faults(self.rig.projector):
            self.rig.projector.show_level(grey)

    def read_exposure_ms(self) -> float | None:
        """The camera's exposure; None where it is unknown."""
        with report_driver_faults(self.rig.camera):
            return self.rig.camera.settings().exposure_ms

    def grab_mean(self, grey: int | None, doing: str, images: int = 1) -> np.ndarray:
        """The mean of ``images`` images (h, w) under even light, after it has settled."""
        self.show(grey, doing)
        self.wait()
        return np.mean([self.grab() for _ in range(images)], axis=0) if images > 1 else self.grab()

    def wait(self) -> None:
        """Wait until the light has settled, and discard images that are older."""
        self.clock.sleep(self.settle_ms / 1000)
        for _ in range(self.stale):
            self.grab()

    def measure_references(self) -> None:
        """Measure the dark and white images with long waits, since the rig's delays are not known
        yet."""
        bursts = []
        for grey, doing in ((None, "dark"), (255, "white light")):
            self.show(grey, doing)
            end, passed = self.clock.now() + _SETTLE_S, 0
            while self.clock.now() < end or passed < _DISCARDED_GRABS:
                self.grab()
                passed += 1
                self.clock.sleep(max(0.0, min(0.02, end - self.clock.now())))
            bursts.append(self.grab_spread(_MEAN)[1])
        dark, white = bursts
        self.dark, self.white = dark.mean(axis=0), white.mean(axis=0)
        self.noise = robust_sigma(white[1] - white[0]) / math.sqrt(2)
        # Light that flickers lifts whole images, and must not pass for the projector's.
        swing = max(float(np.std([np.median(image) for image in images])) for images in bursts)
        self.illuminated = self.white - self.dark > max(
            _SIGMAS * self.noise, 0.02 * self.full, 3 * swing
        )
        if self.illuminated.any():
            self.unsteady = max(map(self.measure_unsteadiness, bursts))

    def measure_unsteadiness(self, images: np.ndarray) -> float:
        """By how much images (n, h, w) under even light differ as a whole, as a share of the white
        light (rms)."""
        return float(np.std([self.share(image, self.illuminated) for image in images]))

    @property
    def full(self) -> float:
        """The grey level at which the camera clips."""
        stated = find_full_scale(self.rig.camera, int(max(self.white.max(), self.dark.max())))
        image = np.rint(self.white[::4, ::4]).astype(self.rig.camera.dtype)
        return image_white(image, int(stated))

    @property
    def clip(self) -> float:
        """The grey level from which a pixel is saturated: mean levels of several images are a
        little below the one at which the camera clips."""
        return 0.985 * self.full

    @property
    def contrast(self) -> float:
        """Grey levels of the projector's white light: median over the illuminated pixels."""
        return (
            float(np.median((self.white - self.dark)[self.illuminated]))
            if self.illuminated.any()
            else 0.0
        )

    def usable(self) -> np.ndarray:
        """(h, w) bool: illuminated, and not clipped in white light."""
        return self.illuminated & (self.white < self.clip) & (self.dark < 0.9 * self.full)

    def share(self, image: np.ndarray, where: np.ndarray) -> float:
        """The projector's light in an image, 0 for dark, 1 for white, summed over some pixels."""
        light, span = ((each - self.dark)[where].sum(dtype=float) for each in (image, self.white))
        return float(light / span) if span else 0.0
