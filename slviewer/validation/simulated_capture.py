"""Small simulated captures of six kinds, at qualities drawn at random, whose true projector
coordinates are known.

Everything that is shown, seen and described is stated by a `CaptureSetup`; a fault changes some of
its fields. Nothing here uses the code that decodes or checks captures.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args
from zlib import crc32

import cv2
import numpy as np

from slviewer.fringe.presets import bits_for, complementary, gray_bits, micro, p18, phase_steps
from slviewer.fringe.sequence import Axis, Frame, PatternSequence, Size
from slviewer.simulation.hostile_frames import add_crosstalk, compress_jpeg, row_phase, scale_frames
from slviewer.validation.simulated_scene import (
    FOCAL,
    SCENES,
    TEXTURES,
    Geometry,
    SceneView,
    trace_view,
)

CaptureKind = Literal["p18", "complementary", "multifrequency", "heterodyne", "gray", "micro"]
KINDS: tuple[CaptureKind, ...] = get_args(CaptureKind)
AXES: tuple[Axis, ...] = ("x", "y")
BLACK, FOREIGN = -1, -2
"""In place of the number of a pattern: an image without projector light, or of something else."""
SIZES: tuple[tuple[Size, Size], ...] = (
    ((320, 240), (320, 240)),
    ((400, 300), (480, 360)),
    ((480, 360), (608, 684)),
)
"""Camera and projector."""
BLURS_PX = (0.5, 2.0, 4.0)
NOISES = (0.5, 4.0)
"""Standard deviation of a bright grey level, in 255ths of full scale."""
LEAST_CONTRAST = {0.5: 0.25, 4.0: 0.5}
"""Contrast of the finest fringes after the blur that a sound capture has, by its noise."""
LEAST_STRIPE = 2.5
"""Width of the narrowest stripes of Gray code alone in a sound capture: in camera pixels, and in
standard deviations of the blur."""
COSINE = (127.5, 127.5)
"""Mean and amplitude of the cosines, in grey levels."""
FEW_STEPS = 4
"""Phase steps up to which a gamma shifts the phase."""
_TABLE = 8  # entries per projector pixel, of the table of a pattern
_DEFOCUS_PX = 0.4  # of the projector
_DARK_LIGHT = 0.004  # share of white that the projector emits at black


@dataclass(frozen=True)
class CaptureSetup:
    """A capture: ``shown`` by the projector, and ``described`` to the program.

    Quality: ``gamma`` of the projector; ``blur_px`` of the camera, standard deviation; ``noise`` as
    in `NOISES`; ``bit_depth``; quality of ``jpeg``, 0 for none; ``ambient``: light of the room as a
    share of the projector's; ``exposure``: share of full scale of the brightest pixels.

    ``order``: number of the pattern that each image shows, `BLACK` or `FOREIGN`. ``copies``: pairs
    (image, image of which it is a copy). ``gains`` of each image. ``flicker``: depth of bands along
    the rows. ``room_step``: (image from which on a lamp is on, its light as a share of the mean
    grey level). ``clipped_share`` of the illuminated pixels saturated under white, instead of
    ``exposure``. ``ghost``: share of the image before. ``motion_px`` of the scene in each image,
    along ``direction``. ``reversed``: axes along which the projector's image is mirrored. ``wave``:
    mean and amplitude of the cosines, in grey levels clipped to 0 ... 255.
    """

    kind: CaptureKind
    seed: int
    view: SceneView
    shown: PatternSequence
    described: PatternSequence
    gamma: float
    blur_px: float
    noise: float
    bit_depth: int
    jpeg: int
    ambient: float
    exposure: float
    order: tuple[int, ...] = ()
    copies: tuple[tuple[int, int], ...] = ()
    gains: tuple[float, ...] = ()
    flicker: float = 0.0
    room_step: tuple[int, float] = (0, 0.0)
    clipped_share: float = 0.0
    ghost: float = 0.0
    motion_px: tuple[float, ...] = ()
    direction: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reversed: tuple[Axis, ...] = ()
    wave: tuple[float, float] = COSINE

    @property
    def tolerated(self) -> frozenset[str]:
        """Causes that are true of the capture even without a fault."""
        steps = [f.steps for f in self.shown.frames if f.kind == "phase"]
        has_gamma = self.gamma > 1 and steps and min(steps) <= FEW_STEPS
        return frozenset({"gamma"}) if has_gamma else frozenset()

    @property
    def displacements(self) -> list[tuple[float, float, float]]:
        """Displacement of the scene in each image."""
        per_px, (x, y, z) = 1 / (FOCAL * self.view.camera[0]), self.direction
        motion = self.motion_px or [0.0] * len(self.shown.frames)
        return [(s * x * per_px, s * y * per_px, s * z * per_px) for s in motion]

    def text(self) -> str:
        """The quality in one line."""
        noise = "low" if self.noise == min(NOISES) else "high"
        jpeg = f", JPEG {self.jpeg}" if self.jpeg else ""
        return (
            f"{self.view.scene}, {self.view.texture}, gamma {self.gamma:g}, blur"
            f" {self.blur_px:g} px, {noise} noise, {self.bit_depth} bits{jpeg}"
        )


@dataclass(frozen=True, eq=False)
class SimulatedCapture:
    """Images (n, h, w) uint8 or uint16, and the true coordinate (h, w) px of each axis, NaN where
    unknown."""

    stack: np.ndarray
    truth: dict[Axis, np.ndarray]


def build_sequence(kind: CaptureKind, view: SceneView, blur_px: float) -> PatternSequence:
    """The patterns of one kind for the projector of a view, x before y; of Gray cells, two of which
    are a stripe, those that the camera resolves."""
    least = LEAST_STRIPE * max(1.0, blur_px) / (2 * view.pixels_per_column)
    cell = min(cell for cell in (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0) if cell >= least)
    builders: dict[CaptureKind, Callable[[Size], PatternSequence]] = {
        "p18": p18,
        "complementary": partial(complementary, steps=4),
        "multifrequency": partial(_three_periods, periods_of=_covering_periods),
        "heterodyne": partial(_three_periods, periods_of=_close_periods),
        "gray": partial(gray_code, cell_px=cell),
        "micro": micro,
    }
    return builders[kind](view.projector)


def _three_periods(
    size: Size, periods_of: Callable[[int], tuple[float, float, float]]
) -> PatternSequence:
    """3 steps of the three periods px that an axis of each extent has."""
    frames: list[Frame] = []
    for axis, extent in zip(AXES, size, strict=True):
        for period in periods_of(extent):
            frames += phase_steps(axis, 3, period)
    return PatternSequence(size, (*frames, Frame("texture")))


def _covering_periods(extent: int) -> tuple[float, float, float]:
    """Periods of which the longest covers the projector."""
    longest = 1.1 * extent
    return longest, (16 * longest) ** 0.5, 16.0


def _close_periods(extent: int) -> tuple[float, float, float]:
    """Close periods, whose beats of 3 and 4 fringes have a beat of one."""
    long = 1.05 * extent
    return long / 16, long / 19, long / 23


def gray_code(size: Size, cell_px: float) -> PatternSequence:
    """Gray code alone in cells of ``cell_px``, each bit followed by its inverse, then white and
    black."""
    frames: list[Frame] = []
    for axis, extent in zip(AXES, size, strict=True):
        for bit in gray_bits(axis, bits_for(extent / cell_px)):
            frames += [bit, replace(bit, kind="inverse")]
    return PatternSequence(
        size, (*frames, Frame("white"), Frame("black")), gray_origin_px=-0.5, gray_cell_px=cell_px
    )


def draw_setup(kind: CaptureKind, seed: int) -> CaptureSetup:
    """A sound capture of a kind, of a quality drawn at random."""
    rng = np.random.default_rng([seed, crc32(kind.encode())])
    view = _draw_view(rng)
    blur, noise = float(rng.choice(BLURS_PX)), float(rng.choice(NOISES))
    while _measure_contrast(build_sequence(kind, view, blur), view, blur) < LEAST_CONTRAST[noise]:
        blur = max(b for b in (0.0, *BLURS_PX) if b < blur)
    bit_depth = int(rng.choice([8, 8, 10, 12]))
    full_scale = None if bit_depth == 8 else (1 << bit_depth) - 1
    sequence = replace(build_sequence(kind, view, blur), full_scale=full_scale)
    few = any(f.kind == "phase" and f.steps <= FEW_STEPS for f in sequence.frames)
    gamma = float(rng.choice([1.0, 1.6, 2.2], p=[0.9, 0.1, 0.0] if few else [0.4, 0.3, 0.3]))
    jpeg = 85 if bit_depth == 8 and rng.random() < 0.3 else 0
    ambient, exposure = float(rng.choice([0.0, 0.03, 0.15])), float(rng.uniform(0.6, 0.85))
    return CaptureSetup(
        kind, seed, view, sequence, sequence, gamma, blur, noise, bit_depth, jpeg, ambient, exposure
    )  # fmt: skip


def _draw_view(rng: np.random.Generator) -> SceneView:
    """Camera, projector and scene, drawn at random."""
    camera, projector = SIZES[rng.integers(len(SIZES))]
    length = float(rng.uniform(0.18, 0.3))
    left, right, above = (-length, 0.0), (length, 0.0), (0.0, -length)
    return SceneView(
        camera,
        projector,
        float(rng.uniform(0.85, 1.15)),
        (left, right, above)[rng.integers(3)],
        float(rng.uniform(-0.06, 0.06)),
        SCENES[rng.integers(len(SCENES))],
        TEXTURES[rng.integers(len(TEXTURES))],
        int(rng.integers(1 << 30)),
    )


def _measure_contrast(sequence: PatternSequence, view: SceneView, blur_px: float) -> float:
    """Contrast of the finest fringes after the camera's blur, 1 without any."""
    least = np.inf
    for axis, c, p in zip(AXES, view.camera, view.projector, strict=True):
        if periods := sequence.periods_px(axis):
            least = min(least, periods[-1] * view.field * c / p)
    return float(np.exp(-2 * (np.pi * blur_px / least) ** 2))


def render_capture(setup: CaptureSetup) -> SimulatedCapture:
    """Render the images of a capture, with independent noise in each."""
    order = setup.order or range(len(setup.shown.frames))
    light = np.empty((len(order), *setup.view.camera[::-1]), np.float32)
    tables = {k: _tabulate_pattern(setup, k) for k in {k for k in order if k >= 0}}
    for i, k in enumerate(order):
        geometry = trace_view(setup.view, setup.displacements[i])
        light[i] = _illuminate(setup, geometry, tables.get(k))
        if k == FOREIGN:
            light[i] = _photograph_another_scene(setup, i)
        if setup.blur_px:
            light[i] = cv2.GaussianBlur(light[i], (0, 0), setup.blur_px)
    stack = _record(setup, _disturb(setup, light))
    for image, source in setup.copies:
        stack[image] = stack[source]
    truth: dict[Axis, np.ndarray] = {}
    for which, axis in enumerate(AXES):  # of the middle of the time in which its images are taken
        own = [i for i, f in enumerate(setup.shown.frames) if f.axis == axis]
        middle = setup.displacements[own[len(own) // 2]]
        truth[axis] = trace_view(setup.view, middle).true_coordinates()[which]
    return SimulatedCapture(stack, truth)


def pattern_levels(
    sequence: PatternSequence, frame: Frame, wave: tuple[float, float] = COSINE
) -> np.ndarray:
    """Grey levels (extent,) float64 that the projector shows along the axis of a frame."""
    if frame.axis is None:
        return np.full(sequence.projector[0], 0.0 if frame.kind == "black" else 255.0)
    u = np.arange(sequence.extent(frame.axis), dtype=np.float64)
    if frame.kind == "phase":
        turns = u / frame.period_px + sequence.sign(frame.axis) * frame.step / frame.steps
        angle = 2 * np.pi * turns + sequence.offset_rad(frame.axis)
        return np.clip(np.floor(wave[0] + wave[1] * np.cos(angle) + 0.5), 0, 255)
    bits = sum(f.kind == "gray" and f.axis == frame.axis for f in sequence.frames)
    halves = 2 if frame.kind == "complementary" else 1
    cells = (u - sequence.origin_px(frame.axis)) / sequence.gray_cell(frame.axis)
    code = np.floor(halves * cells - 0.5 / sequence.gray_cell(frame.axis) * halves + 1e-9)
    code = code.astype(np.int64)
    place = 0 if frame.kind == "complementary" else bits - 1 - frame.bit
    is_white = ((code ^ (code >> 1)) >> place) & 1 == (0 if frame.kind == "inverse" else 1)
    return np.where(is_white, 255.0, 0.0)


def _tabulate_pattern(setup: CaptureSetup, index: int) -> tuple[Axis, np.ndarray]:
    """The axis of a pattern, and its light at each eighth of a projector pixel, 1 for white."""
    frame = setup.shown.frames[index]
    axis: Axis = frame.axis or "x"
    levels = pattern_levels(setup.shown, frame, setup.wave)
    if axis in setup.reversed:
        levels = levels[::-1]
    light = _DARK_LIGHT + (1 - _DARK_LIGHT) * (levels / 255) ** setup.gamma
    fine = np.repeat(light, _TABLE).astype(np.float32)[None]
    return axis, cv2.GaussianBlur(
        fine, (0, 0), _DEFOCUS_PX * _TABLE, borderType=cv2.BORDER_REPLICATE
    )[0]


def _illuminate(
    setup: CaptureSetup, geometry: Geometry, table: tuple[Axis, np.ndarray] | None
) -> np.ndarray:
    """Light (h, w) at the camera's pixels under a pattern, or without the projector's light."""
    room = setup.ambient * geometry.albedo.mean(axis=0)
    if table is None:
        return room
    axis, values = table
    coordinates, total = geometry.u if axis == "x" else geometry.v, np.zeros_like(room)
    for coordinate, shade in zip(coordinates, geometry.shade, strict=True):
        places = ((coordinate + np.float32(0.5)) * np.float32(_TABLE)).astype(np.int32)
        total += values.take(places, mode="clip") * shade
    return total / len(coordinates) + room


def _photograph_another_scene(setup: CaptureSetup, image: int) -> np.ndarray:
    """A picture (h, w) that has nothing to do with the patterns, about as bright."""
    rng = np.random.default_rng([setup.seed, image, 7])
    coarse = rng.uniform(0, 1, (7, 9)).astype(np.float32)
    return cv2.resize(coarse, setup.view.camera, interpolation=cv2.INTER_CUBIC).clip(0, 1)


def _disturb(setup: CaptureSetup, light: np.ndarray) -> np.ndarray:
    """Light (n, h, w) with ghosts, gains, flicker and the lamp of the room."""
    if setup.ghost:
        light = add_crosstalk(light, setup.ghost)
    if setup.gains:
        light = scale_frames(light, np.array(setup.gains))
    if setup.flicker:
        phase = row_phase(light, 1.7, 0.37 * np.arange(len(light))[:, None])
        light = light * (1 + setup.flicker * np.sin(phase)).astype(np.float32)
    first, share = setup.room_step
    if share:
        albedo = trace_view(setup.view).albedo.mean(axis=0)
        lamp = share * float(light[:, albedo > 0].mean()) / float(albedo[albedo > 0].mean())
        light = light.copy()
        light[first:] += np.float32(lamp) * albedo
    return light


def _record(setup: CaptureSetup, light: np.ndarray) -> np.ndarray:
    """The images (n, h, w) that the camera records of light (n, h, w); white where the projector
    reaches sets the exposure."""
    geometry = trace_view(setup.view, setup.displacements[0])
    white = geometry.shade.mean(axis=0) + setup.ambient * geometry.albedo.mean(axis=0)
    known = white[(geometry.shade > 0).all(axis=0)]
    share, level = (setup.clipped_share, 1.0) if setup.clipped_share else (0.01, setup.exposure)
    gain = level / float(np.quantile(known, 1 - share))
    full = (1 << setup.bit_depth) - 1
    rng = np.random.default_rng([setup.seed, crc32(setup.kind.encode()), 3])
    dtype = np.uint8 if setup.bit_depth == 8 else np.uint16
    out = np.empty(light.shape, dtype)
    relative = setup.noise / 255
    for i, frame in enumerate(light):
        signal = frame * np.float32(gain)
        # half of the standard deviation of full scale remains without light
        variance = relative**2 * (0.25 + 0.75 * np.clip(signal, 0, 1))
        signal = signal + np.sqrt(variance) * rng.standard_normal(signal.shape, np.float32)
        out[i] = np.clip(np.rint(signal * full), 0, full)
    return compress_jpeg(out, setup.jpeg) if setup.jpeg else out
