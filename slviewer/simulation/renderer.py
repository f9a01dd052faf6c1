"""From a rig and a scene to the frames that its camera would take, and the truth behind them."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.ndimage import correlate1d
from scipy.sparse import csr_matrix

from slviewer.errors import InputError
from slviewer.fringe.patterns import profile
from slviewer.fringe.presets import AXES
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.geometry.jit import run_rows
from slviewer.simulation.concave import ConcaveScene
from slviewer.simulation.film import NORMAL_QUANTILES, ROWS, digitise, image_light, psf_taps
from slviewer.simulation.light import OFFSET, blur_levels, blurred_profile, window
from slviewer.simulation.rig import SimulatedRig
from slviewer.simulation.scenes import Scene

_EXPOSURE_QUANTILE = (
    0.995  # of the illuminated pixels; a few brighter ones do not decide an exposure
)

Map = np.ndarray
"""(h, w), or (h, w, 2 or 3): a value, or some, for each pixel."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What a perfect instrument would measure.

    points: (h, w, 3) float64 mm, camera frame, NaN where the camera's ray meets nothing. projector:
    (h, w, 2) float64 px (column, row) of those points, also beyond the projector's image. mask: (h,
    w) bool, where the projector's light arrives: inside its image, on a surface that faces it, in
    no shadow.
    """

    points: Map
    projector: Map
    mask: Map


@dataclass(frozen=True, eq=False)
class _Maps:
    """A scene at unit exposure, (h + 2 r, w + 2 r) float32 with r the PSF's radius.

    gain: full white light; even: the room's light, if it were as strong; level: blur, as a place
    among the tabulated `sigmas`; coordinates: projector px along each axis.
    """

    gain: Map
    even: Map
    level: Map
    sigmas: np.ndarray
    coordinates: dict[Axis, Map]
    truth: Truth


class Renderer:
    """Renders one scene with one rig: geometry once, then frame after frame of any pattern
    sequence.

    The exposure is set as an operator would: the brightest half percent of the illuminated surface
    reaches the sensor's `peak_level` in full white light. Defocus and pixel response blur the
    projected profile by the surface's depth; the camera's PSF blurs each frame. Silhouettes are not
    anti-aliased, printed edges are.
    """

    def __init__(self, rig: SimulatedRig, scene: Scene) -> None:
        self.rig = rig
        self.scene = scene
        self._concave = scene if isinstance(scene, ConcaveScene) else None
        self._indirect: dict[Axis, np.ndarray] = {}
        self._lights: dict[float, tuple[Map, Map]] = {}

    def truth(self) -> Truth:
        """What a perfect instrument would measure."""
        return self._maps.truth

    def capture(
        self,
        sequence: PatternSequence,
        seed: int = 0,
    ) -> np.ndarray:
        """(n, h, w) uint8: every frame of `sequence`; the same seed (and rig) gives the same
        frames."""
        rig = self.rig
        if tuple(sequence.projector) != rig.projector.size:
            raise InputError(
                f"the patterns are {sequence.projector[0]}x{sequence.projector[1]} px and the"
                f" simulated projector has {rig.projector.size[0]}x{rig.projector.size[1]}",
                "make them for this projector",
            )
        rng = np.random.default_rng([rig.seed, seed, 0xF0])
        keys = rng.integers(0, 2**32, (len(sequence.frames), 2), dtype=np.uint32)
        lamp = 1 + rig.light.flicker * rng.standard_normal(len(sequence.frames))
        width, height = rig.camera.size
        stack = np.empty((len(sequence.frames), height, width), np.uint8)
        for k, frame in enumerate(stack):
            self.frame(profile(sequence, k), keys[k], frame, lamp=lamp[k])
        return stack

    def frame(
        self,
        pattern: tuple[Axis | None, np.ndarray],
        keys: np.ndarray,
        out: Map,
        *,
        lamp: float = 1.0,
        exposure: float | None = None,
        gain: float = 1.0,
    ) -> None:
        """Fill `out` (h, w) uint8 with one frame of `pattern`, the axis and grey levels that
        `fringe.patterns.profile` gives, or no axis and an image (h, w, 3) uint8.

        `keys` (2,) uint32 decide the noise, `lamp` is the relative light of this frame, `exposure`
        replaces the renderer's own, and `gain` multiplies the signal and its noise before they
        become 8 bits.
        """
        light = self.light(
            pattern, lamp=lamp, exposure=(self.exposure if exposure is None else exposure) * gain
        )
        sensor = self.rig.sensor
        noise = np.array(
            [sensor.dark_level, gain**2 * sensor.read_variance, gain * sensor.shot_variance]
        )
        run_rows(digitise, len(out), light, noise, 255.0, NORMAL_QUANTILES, keys, out)

    def light(
        self,
        pattern: tuple[Axis | None, np.ndarray],
        *,
        lamp: float = 1.0,
        exposure: float | None = None,
    ) -> Map:
        """(h, w) float32: the light of one frame in grey levels above dark, before noise and
        clipping; as `frame`."""
        rig, maps, (varies, grey_levels) = self.rig, self._maps, pattern
        exposure = self.exposure if exposure is None else exposure
        illuminated, stray = self._light(exposure)
        if grey_levels.ndim == 3:
            return (
                self._blur(illuminated * np.float32(lamp) * self._image_light(grey_levels)) + stray
            )
        # Rows and columns are blurred alike in space, hence by different numbers of pixels.
        sigmas = maps.sigmas * (rig.rows_per_column if varies == "y" else 1.0)
        light_levels = (grey_levels / 255.0) ** rig.light.gamma
        light = blurred_profile(light_levels, sigmas)
        width, height = rig.camera.size
        out = np.empty((height, width), np.float32)
        run_rows(
            image_light, height, maps.coordinates[varies or "x"], maps.level, illuminated,
            np.float32(lamp) * light, OFFSET, self._taps, stray, out, multiple=ROWS,
        )  # fmt: skip
        if self._concave:
            indirect = self._indirect_light(varies or "x", (1 - rig.light.black) * light_levels)
            out += np.float32(lamp * exposure) * indirect
        return out

    def _image_light(self, image: np.ndarray) -> Map:
        """Light on the maps, 0 ... 1, of an image (h, w, 3) of the projector as a camera without
        colours sees it: with the same blur everywhere, and without interreflections."""
        maps, light = self._maps, self.rig.light
        blur = float(np.interp(np.median(maps.level), np.arange(len(maps.sigmas)), maps.sigmas))
        sharp = ((image / 255.0) ** light.gamma).mean(axis=2).astype(np.float32)
        blurred = cv2.GaussianBlur(sharp, (0, 0), blur, sigmaY=blur * self.rig.rows_per_column)
        u, v = (maps.coordinates[axis] for axis in AXES)
        return cv2.remap(blurred, u, v, cv2.INTER_LINEAR)

    def _indirect_light(self, axis: Axis, profile_light: np.ndarray) -> Map:
        """Light at unit exposure, (h, w) float32, that the surface throws on itself under a profile
        (n,) in 0 ... 1.

        The camera's PSF is neglected: this light varies slowly.
        """
        assert self._concave is not None
        if axis not in self._indirect:
            self._indirect[axis] = self._concave.light_matrix(self.rig, axis)
        values = self._indirect[axis] @ profile_light.astype(np.float32)
        reflected = self._maps.even[self._frame]
        return (self._pixel_weights @ values).reshape(reflected.shape) * reflected

    @cached_property
    def _pixel_weights(self) -> csr_matrix:
        """Weights of the vertices (h w, n) of a concave scene at each pixel."""
        assert self._concave is not None
        return self._concave.pixel_weights(self.rig.camera.rays(0))

    def room_light(self) -> Map:
        """(h, w) float32: grey levels of even room light as strong as full white light from the
        projector."""
        return self._blur(self._maps.even * np.float32(self.exposure))

    def _blur(self, light: Map) -> Map:
        """Return light on the maps, blurred by the camera's PSF, within the frame (h, w)."""
        for direction in (0, 1):
            light = correlate1d(light, self._taps, axis=direction)
        return np.ascontiguousarray(light[self._frame])

    def _light(self, exposure: float) -> tuple[Map, Map]:
        """Grey levels: of full white light as `_Maps.gain`, and of all that no pattern changes,
        blurred, (h, w)."""
        if exposure not in self._lights:
            maps, black = self._maps, self.rig.light.black
            stray = self._blur(exposure * (black * maps.gain + self.rig.light.ambient * maps.even))
            light = exposure * (1 - black) * maps.gain
            # an exposure is kept for many frames
            self._lights = {exposure: (light.astype(np.float32), stray.astype(np.float32))}
        return self._lights[exposure]

    @cached_property
    def exposure(self) -> float:
        """Grey levels of full white light on an albedo of 1 that faces the projector at its
        focus."""
        maps, sensor = self._maps, self.rig.sensor
        light = (maps.gain + self.rig.light.ambient * maps.even)[self._frame]
        if self._concave:
            light = light + self._indirect_light("x", np.ones(self.rig.projector.size[0]))
        illuminated = light[maps.truth.mask]
        if not illuminated.size:
            raise InputError(
                "nothing in the scene is illuminated by the projector",
                "move it to where both fields meet",
            )
        return (sensor.peak_level - sensor.dark_level) / float(
            np.quantile(illuminated, _EXPOSURE_QUANTILE)
        )

    @cached_property
    def _taps(self) -> np.ndarray:
        """(2 r + 1,) weights of the camera's point spread function in px at the present scale."""
        return psf_taps(self.rig.sensor.psf_px * self.rig.camera.scale)

    @property
    def _frame(self) -> tuple[slice, slice]:
        """The frame within the maps, which reach beyond it as far as the PSF does."""
        margin, (width, height) = len(self._taps) // 2, self.rig.camera.size
        return slice(margin, margin + height), slice(margin, margin + width)

    @cached_property
    def _maps(self) -> _Maps:
        """The traced scene: projector coordinates and light at unit exposure of every pixel."""
        rig, light = self.rig, self.rig.light
        rays = rig.camera.rays(len(self._taps) // 2)
        surface = self.scene.trace(rays)
        hit = np.isfinite(surface.points[..., 2])
        projector = rig.project(surface.points)
        to_source = rig.projector_centre - surface.points
        distance = np.linalg.norm(to_source, axis=-1)
        with np.errstate(invalid="ignore"):
            facing = np.nan_to_num((surface.normals * to_source).sum(-1) / distance).clip(min=0)
            depth = surface.points @ rig.R[2] + rig.t[2]
            blur = np.hypot(
                light.blur_px, light.defocus_px_mm * np.abs(1 / depth - 1 / light.focus_mm)
            )
            shade = np.nan_to_num(facing * (light.focus_mm / distance) ** 2)
        reached = facing > 0
        reached[reached] = ~self.scene.occluded(surface.points[reached], rig.projector_centre)
        columns, rows = rig.projector.size
        u, v = projector[..., 0], projector[..., 1]
        lens_falloff = (1 + (rays**2).sum(-1)) ** -2  # cos^4 of the angle to the camera's axis
        reflected = surface.albedo * lens_falloff
        illuminated = window(u, columns, blur) * window(v, rows, blur * rig.rows_per_column)
        with np.errstate(invalid="ignore"):
            inside = (u > -0.5) & (u < columns - 0.5) & (v > -0.5) & (v < rows - 0.5)
        sigmas, level = blur_levels(blur)
        surface_share = 1 - self._concave.indirect.scattered if self._concave else 1.0
        return _Maps(
            gain=(surface_share * reflected * shade * reached * illuminated).astype(np.float32),
            even=(reflected * hit).astype(np.float32),
            level=level,
            sigmas=sigmas,
            coordinates={
                axis: np.nan_to_num(place, posinf=0.0, neginf=0.0).astype(np.float32)
                for axis, place in zip(AXES, (u, v), strict=True)
            },
            truth=Truth(
                surface.points[self._frame],
                projector[self._frame],
                (hit & reached & inside)[self._frame],
            ),
        )
