"""Devices that work, and lie: late light, stale, lost and repeated frames, mains light, the wrong
screen.

`imperfect(rig)` wraps any rig, and what its `Imperfections` say may change at any time;
`resampled_rig` is a simulated rig whose display scales what it is given. With them it is proved
that the preflight names what is wrong.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from slviewer.devices.protocols import Camera, CameraSettings, Projector, Rig, check_frame
from slviewer.devices.simulated import SimulatedCamera, SimulatedProjector
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import InputError
from slviewer.fringe.sequence import PatternSequence
from slviewer.preflight.rig_under_test import SYSTEM_CLOCK, Clock


@dataclass
class Imperfections:
    """What is wrong.

    ``latency_ms`` from "shown" to light. ``frame_ms``: the camera runs by its own clock, 0: it
    waits for nobody. ``lag``: images that the camera is behind. ``elsewhere``: the projector's
    picture goes to another screen. ``room`` grey levels of even light in the room, of which
    ``mains_depth`` swings at ``mains_hz``; ``lamp_depth`` of the projector's own light does. Of
    every sequence's frames: those in ``late`` show the pattern before, those in ``repeated`` come
    twice as one image, ``dropped`` is lost and all that follow come too early, ``swapped`` has
    changed places with the one after it.
    """

    latency_ms: float = 0.0
    frame_ms: float = 0.0
    lag: int = 0
    elsewhere: bool = False
    room: float = 0.0
    mains_hz: float = 100.0
    mains_depth: float = 0.0
    lamp_depth: float = 0.0
    late: set[int] = field(default_factory=set)
    repeated: set[int] = field(default_factory=set)
    dropped: int | None = None
    swapped: int | None = None


class _Between:
    """What the projector was told and the light has not done yet, and whether the next image
    repeats the last."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.waiting: deque[tuple[float, Callable[[], None]]] = deque()
        self.repeat = False

    def act(self, now: float) -> None:
        """Let all happen that was due by `now`, in s of the clock."""
        while self.waiting and self.waiting[0][0] <= now:
            self.waiting.popleft()[1]()


class ImperfectCamera:
    """A camera whose images are stale or illuminated by more than the projector."""

    def __init__(self, camera: Camera, wrong: Imperfections, between: _Between) -> None:
        self._camera, self._wrong, self._between = camera, wrong, between
        self.name, self.size, self.dtype = camera.name, camera.size, camera.dtype
        self._taken: deque[np.ndarray] = deque(maxlen=8)

    def open(self) -> None:
        """Open the wrapped camera."""
        self._camera.open()
        self._taken.clear()

    def close(self) -> None:
        """Close the wrapped camera."""
        self._camera.close()

    def grab(self, out: np.ndarray) -> None:
        """The image that the imperfections leave of the wrapped camera's."""
        check_frame(self, out)
        clock = self._between.clock
        begin = clock.now()
        if self._wrong.frame_ms > 0:
            period = self._wrong.frame_ms / 1000
            begin = np.ceil(begin / period) * period
            clock.sleep(max(0.0, begin - clock.now()))
        self._between.act(begin)
        if self._between.repeat and self._taken:
            self._between.repeat = False
            out[:] = self._taken[-1]
            return
        self._camera.grab(out)
        self._light(out, begin)
        self._taken.append(out.copy())
        out[:] = self._taken[max(-len(self._taken), -1 - self._wrong.lag)]
        if self._wrong.frame_ms > 0:
            clock.sleep(max(0.0, begin + self._wrong.frame_ms / 1000 - clock.now()))

    def settings(self) -> CameraSettings:
        """The wrapped camera's."""
        return self._camera.settings()

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """The wrapped camera's."""
        return self._camera.apply(settings)

    def _light(self, out: np.ndarray, begin: float) -> None:
        wrong = self._wrong
        if not (wrong.room or wrong.lamp_depth):
            return
        exposure = (self._camera.settings().exposure_ms or 0.0) / 1000
        # A swing that is seen for a whole period of it, or several, adds nothing.
        middle = 2 * np.pi * wrong.mains_hz * (begin + exposure / 2)
        swing = float(np.sinc(wrong.mains_hz * exposure) * np.cos(middle))
        illuminated = out * (1 + wrong.lamp_depth * swing) + wrong.room * (
            1 + wrong.mains_depth * swing
        )
        np.copyto(out, np.clip(illuminated + 0.5, 0, np.iinfo(out.dtype).max), casting="unsafe")


class ImperfectProjector:
    """A projector whose light comes late, or not when it should."""

    def __init__(self, projector: Projector, wrong: Imperfections, between: _Between) -> None:
        self._projector, self._wrong, self._between = projector, wrong, between
        self.name, self.size = projector.name, projector.size
        self._frames = 0

    def open(self) -> None:
        """Open the wrapped projector."""
        self._between.waiting.clear()
        self._projector.open()

    def close(self) -> None:
        """Close the wrapped projector."""
        self._between.waiting.clear()
        self._projector.close()

    def load(self, sequence: PatternSequence) -> None:
        """Load the wrapped projector, after the light has done what it was told."""
        self._between.act(np.inf)
        self._projector.load(sequence)
        self._frames = len(sequence.frames)

    def show(self, index: int) -> None:
        """Say that it is shown; what is shown, and when, is another matter."""
        wrong, last = self._wrong, self._frames - 1
        if wrong.dropped is not None and index >= wrong.dropped:
            shown = min(index + 1, last)
        elif wrong.swapped is not None and index in (wrong.swapped, wrong.swapped + 1):
            shown = min(2 * wrong.swapped + 1 - index, last)
        else:
            shown = index - 1 if index in wrong.late else index
        self._between.repeat = index in wrong.repeated
        if shown >= 0:
            self._later(lambda: self._projector.show(shown))

    def show_level(self, grey: int | None) -> None:
        """The same with even light."""
        self._later(lambda: self._projector.show_level(grey))

    def _later(self, action: Callable[[], None]) -> None:
        if self._wrong.elsewhere:
            return
        if self._wrong.latency_ms <= 0:
            self._between.act(np.inf)
            action()
        else:
            self._between.waiting.append(
                (self._between.clock.now() + self._wrong.latency_ms / 1000, action)
            )


class _ResamplingProjector(SimulatedProjector):
    """Shows everything `zoom` times as large, by interpolation, as a display does that is not used
    pixel for pixel."""

    def __init__(self, world: SimulatedWorld, zoom: float) -> None:
        super().__init__(world)
        self._zoom = zoom

    def load(self, sequence: PatternSequence) -> None:
        """Compute all its patterns, and scale them."""
        super().load(sequence)
        self._profiles = [(axis, self._scaled(levels)) for axis, levels in self._profiles]

    def _scaled(self, levels: np.ndarray) -> np.ndarray:
        u = np.arange(len(levels))
        return np.rint(np.interp(u / self._zoom, u, levels)).astype(np.uint8)


def imperfect(
    rig: Rig, wrong: Imperfections | None = None, clock: Clock = SYSTEM_CLOCK
) -> tuple[Rig, Imperfections]:
    """`rig` with devices that lie, and what they lie about."""
    wrong, between = wrong or Imperfections(), _Between(clock)
    camera, projector = (
        ImperfectCamera(rig.camera, wrong, between),
        ImperfectProjector(rig.projector, wrong, between),
    )
    return Rig(rig.name, camera, projector, rig.settle_ms), wrong


def resampled_rig(world: SimulatedWorld, zoom: float) -> Rig:
    """The simulated rig before `world`, its patterns scaled by `zoom`."""
    if not 0.5 <= zoom <= 2:
        raise InputError(f"a zoom of {zoom:g} is not between 0.5 and 2")
    return Rig("simulated", SimulatedCamera(world), _ResamplingProjector(world, zoom))
