"""Simulated camera, projector and turntable: drivers that capture the content of a
`SimulatedWorld`."""

from collections.abc import Callable
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np

from slviewer.devices.drivers import Driver
from slviewer.devices.protocols import (
    CameraDriver,
    CameraSettings,
    Openable,
    Rig,
    check_angle,
    check_image,
    check_index,
    check_level,
    check_sequence,
)
from slviewer.devices.world import SecondView, Shown, SimulatedWorld
from slviewer.errors import InputError
from slviewer.fringe.patterns import profile
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.target.board import Board

AUTO = CameraSettings(exposure_ms=1.0, gain=1.0)
"""At 1 ms the brightest half percent of the illuminated scene reach the sensor's `peak_level` in
white light, near or far.
"""

_EXPOSURES_MS = (0.01, 100.0)
_GAINS = (1.0, 16.0)
_WHITE = (
    0.85  # albedo of the plate for which the camera is exposed while the projector lights nothing
)


class SimulatedCamera(CameraDriver):
    """Simulated 8-bit camera with the rig's noise; light grows with the exposure, and saturates at
    255."""

    dtype = np.dtype(np.uint8)

    def __init__(
        self, world: SimulatedWorld | SecondView, name: str = "the simulated camera"
    ) -> None:
        super().__init__(name)
        self.size = world.rig.camera.size
        self.world = world
        self._settings = AUTO
        self._last_grab: tuple[Shown | None, int] = (None, 0)

    def _fill(self, out: np.ndarray) -> None:
        """Render the current scene under the projected pattern; every frame has its own noise."""
        shown = self.world.shown
        grabs = self._last_grab[1] + 1 if self._last_grab[0] is shown else 0
        self._last_grab = (shown, grabs)
        keys = np.random.default_rng([*shown.seed, grabs]).integers(0, 2**32, 2, dtype=np.uint32)
        renderer = self.world.renderer(shown.preview)
        width, height = renderer.rig.camera.size
        frame = out if (width, height) == self.size else np.empty((height, width), np.uint8)
        assert self._settings.exposure_ms is not None and self._settings.gain is not None
        exposure = _estimate_white_level(renderer) * self._settings.exposure_ms
        renderer.frame(
            shown.pattern, keys, frame, lamp=shown.lamp, exposure=exposure, gain=self._settings.gain
        )
        if frame is not out:
            cv2.resize(frame, self.size, dst=out, interpolation=cv2.INTER_LINEAR)

    @property
    def scene_state(self) -> object:
        """What stands before the camera, how it is rendered and lit, and the camera's settings."""
        shown = self.world.shown
        return self.world.renderer(shown.preview), shown, self._settings

    def _read_settings(self) -> CameraSettings:
        return self._settings

    def _read_lens(self) -> dict[str, float]:
        """Return the focal length as the focus: px of the camera at full resolution."""
        return {"focus": self.world.rig.camera.focal_px[0]}

    def _write_settings(self, settings: CameraSettings) -> None:
        """Set exposure and gain, limited to 0.01 ... 100 ms and 1 ... 16 times."""
        before = self._settings
        exposure_ms, gain = settings.exposure_ms or before.exposure_ms, settings.gain or before.gain
        assert exposure_ms is not None and gain is not None
        self._settings = CameraSettings(
            float(np.clip(exposure_ms, *_EXPOSURES_MS)), float(np.clip(gain, *_GAINS))
        )


class SimulatedProjector(Openable):
    """Projects patterns into the world. The same captures in the same order have the same noise,
    previews or not."""

    def __init__(self, world: SimulatedWorld) -> None:
        super().__init__("the simulated projector")
        self.size = world.rig.projector.size
        self.world = world
        self._sequence: PatternSequence | None = None
        self._profiles: list[tuple[Axis | None, np.ndarray]] = []
        self._loads, self._shows = 0, 0

    def _start(self) -> None:
        """Start dark, with nothing loaded, and end so."""
        self._sequence = None
        self.show_level(None)
        self._claimed.callback(self.show_level, None)

    def load(self, sequence: PatternSequence) -> None:
        """Compute all patterns of a sequence. Raises InputError for an invalid one, or one for
        another projector."""
        self.check_open()
        check_sequence(self, sequence)
        self._profiles = [profile(sequence, k) for k in range(len(sequence.frames))]
        self._sequence = sequence
        self._loads, self._shows = self._loads + 1, 0

    def show(self, index: int) -> None:
        """Show frame `index`."""
        self.check_open()
        check_index(self, self._sequence, index)
        self.show_pattern(self._profiles[index], preview=False)

    def show_level(self, grey: int | None) -> None:
        """Show even light, for previews."""
        self.check_open()
        self.show_pattern((None, np.full(self.size[0], check_level(grey), np.uint8)), preview=True)

    def show_image(self, image: np.ndarray) -> None:
        """Show an image (h, w, 3), of which a camera without colours sees the mean light."""
        self.check_open()
        self.show_pattern((None, check_image(self, image)), preview=True)

    def show_pattern(self, pattern: tuple[Axis | None, np.ndarray], preview: bool) -> None:
        """Show a pattern, as `Shown` has it, with the lamp's flicker and the noise seed of this
        frame."""
        self._shows += 1
        rig = self.world.rig
        seed = (rig.seed, self._loads, self._shows, 0xDE)
        lamp = 1 + rig.light.flicker * float(np.random.default_rng(seed).standard_normal())
        self.world.shown = Shown(pattern, lamp, seed, preview)


class SimulatedTurntable(Openable):
    """Turns what stands before the simulated rig; each stop is off by a normal error of
    `repeatability_deg`."""

    limits_deg = None
    is_absolute = True

    def __init__(
        self,
        world: SimulatedWorld,
        repeatability_deg: Annotated[float, msgspec.Meta(ge=0, le=10)] = 0.02,
    ) -> None:
        super().__init__("the simulated turntable")
        self.world, self._repeatability_deg = world, repeatability_deg
        self._position_deg = world.table_deg
        self._rng = np.random.default_rng((world.rig.seed, 0x7A))

    def position_deg(self) -> float:
        """Return the nominal angle."""
        self.check_open()
        return self._position_deg

    def turn_to(self, deg: float, check: Callable[[], None] = lambda: None) -> None:
        """Turn at once, nearly to the angle."""
        self.check_open()
        check_angle(self, deg)
        check()
        self.world.turn_table(deg + self._repeatability_deg * float(self._rng.standard_normal()))
        self._position_deg = deg


def simulated_rig(world: SimulatedWorld, cameras: Literal[1, 2] = 1) -> Rig:
    """Return the camera and projector that view `world`, or two cameras."""
    second = None
    if cameras == 2:
        second = SimulatedCamera(world.from_second_camera(), "the second simulated camera")
    return Rig("simulated", SimulatedCamera(world), SimulatedProjector(world), second=second)


def preset_rig(
    preset: str = "letter", scale: float = 1.0, seed: int = 0, board: str = "circles:21x16:9"
) -> Rig:
    """Return a preset's rig with a board, such as "circles:21x16:9"; `scale` multiplies the
    camera's size."""
    if preset != "letter":
        raise InputError(f"no rig preset is called {preset!r}", "use letter")
    return simulated_rig(SimulatedWorld(letter(scale, seed), Board.parse(board)))


DRIVER = Driver(
    "simulated",
    "a rig that exists in numbers only, with known truth, and a turntable before it",
    rig=preset_rig,
    turntable=SimulatedTurntable,
)


def _estimate_white_level(renderer: Renderer) -> float:
    """Return the grey level of full white light on an albedo of 1, from the brightness of the
    scene."""
    if renderer.truth().mask.any():
        return renderer.exposure
    sensor, light = renderer.rig.sensor, renderer.rig.light
    return (sensor.peak_level - sensor.dark_level) / (_WHITE * (1 + light.ambient))
