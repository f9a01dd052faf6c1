"""Small simulated captures of six kinds, at qualities drawn at random, whose true projector
coordinates are known.

Everything that is shown, seen and described is stated by a `CaptureSetup`; a fault changes some of
its fields. The scene is ray-traced: the camera stands at the origin and looks along z; the scene is
about one unit of length away. Nothing here uses the code that decodes or checks captures.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, get_args
from zlib import crc32

import cv2
import numpy as np

from slviewer.fringe.patterns import profile
from slviewer.fringe.presets import PRESETS, bits_for, complementary, gray_bits, phase_steps
from slviewer.fringe.sequence import Axis, Frame, PatternSequence, Size
from slviewer.simulation.rig import look_along
from tests.proofs.hostile_frames import add_crosstalk, compress_jpeg, row_phase, scale_frames
from tests.proofs.pipelines import LINEAR, PIPELINES, TRUE_OF

CaptureKind = Literal["p18", "complementary", "multifrequency", "heterodyne", "gray", "micro"]
KINDS: tuple[CaptureKind, ...] = get_args(CaptureKind)
AXES: tuple[Axis, ...] = ("x", "y")
BLACK, FOREIGN = -1, -2
"""In place of the number of a pattern: an image without projector light, or of something else."""
SceneName = Literal["plane", "sphere", "step", "object"]
SCENES: tuple[SceneName, ...] = get_args(SceneName)
"""A tilted plane; a sphere before a plane; two planes, the nearer casting a shadow on the other; an
object that covers a fifth of the image."""
Texture = Literal["plain", "smooth", "printed"]
TEXTURES: tuple[Texture, ...] = get_args(Texture)
FOCAL = 1.1
"""Focal length of the camera, in widths of its image."""
_SUBPIXELS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
_EDGE_PX = 2.5  # by which the subpixels of a pixel differ at a depth edge, in camera pixels
_NEAR = 1e-6
_GRAZING = 0.05  # share of the light of a surface that faces the projector
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
FEW_STEPS = 4
"""Phase steps up to which a gamma shifts the phase."""
_TABLE = 8  # entries per projector pixel, of the table of a pattern
_DEFOCUS_PX = 0.4  # of the projector
_DARK_LIGHT = 0.004  # share of white that the projector emits at black


@dataclass(frozen=True)
class SceneView:
    """Camera, projector and scene. ``field``: width of the projector's field over the camera's.

    ``baseline``: position of the projector beside and above the camera; ``roll``: rad, of the
    projector about its axis; ``seed``: of the shape and the texture of the scene.
    """

    camera: Size
    projector: Size
    field: float
    baseline: tuple[float, float]
    roll: float
    scene: SceneName
    texture: Texture
    seed: int

    @property
    def pixels_per_column(self) -> float:
        """Camera pixels for each projector pixel, along the axis that has fewer."""
        return self.field * min(c / p for c, p in zip(self.camera, self.projector, strict=True))


@dataclass(frozen=True, eq=False)
class Geometry:
    """What each of the subpixels of the camera sees: maps (4, h, w) float32.

    ``u``, ``v``: projector column and row, px; anything where ``shade`` is 0.
    ``albedo``: 0 where there is no surface. ``shade``: projector light at white, 0 where it does
    not reach. ``edge_px``: difference of the subpixels of a pixel at a depth edge.
    """

    u: np.ndarray
    v: np.ndarray
    albedo: np.ndarray
    shade: np.ndarray
    edge_px: float

    def true_coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """Projector column and row (h, w) px of each pixel; NaN where not wholly illuminated, or at
        a depth edge."""
        is_known = (self.shade > 0).all(axis=0)
        for values in (self.u, self.v):
            is_known &= np.ptp(values, axis=0) < self.edge_px
        u, v = (np.where(is_known, each.mean(axis=0), np.nan) for each in (self.u, self.v))
        return u, v


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
    ``exposure``. ``ghost``: share of the image before. ``pipeline``: of `PIPELINES`, empty for a
    linear camera. ``motion_px`` of the scene in each image,
    along ``direction``. ``reversed``: axes along which the projector's image is mirrored.
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
    pipeline: str = ""

    @property
    def tolerated(self) -> frozenset[str]:
        """Causes that are true of the capture even without a fault."""
        steps = [f.steps for f in self.shown.frames if f.kind == "phase"]
        has_gamma = self.gamma > 1 and steps and min(steps) <= FEW_STEPS
        has_gamma = has_gamma or self.pipeline not in ("", LINEAR)
        return (frozenset({"gamma"}) if has_gamma else frozenset()) | TRUE_OF.get(
            self.pipeline, frozenset()
        )

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
        jpeg += self.pipeline and f", {self.pipeline}"
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
    size = view.projector
    if kind == "gray":
        least = LEAST_STRIPE * max(1.0, blur_px) / (2 * view.pixels_per_column)
        cells = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)
        return gray_code(size, min(cell for cell in cells if cell >= least))
    if kind == "complementary":
        return complementary(size, steps=4)
    if kind in ("p18", "micro"):
        return PRESETS[kind](size)
    frames: list[Frame] = []
    for axis, extent in zip(AXES, size, strict=True):
        longest, long = 1.1 * extent, 1.05 * extent
        # the longest covers the projector, or close ones, whose beats of 3 and 4 fringes have a
        # beat of one
        covering, close = (longest, (16 * longest) ** 0.5, 16.0), (long / 16, long / 19, long / 23)
        for period in covering if kind == "multifrequency" else close:
            frames += phase_steps(axis, 3, period)
    return PatternSequence(size, (*frames, Frame("texture")))


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


def draw_setup(kind: CaptureKind, seed: int, pipeline: str = "") -> CaptureSetup:
    """A sound capture of a kind, of a quality drawn at random, seen through a pipeline."""
    rng = np.random.default_rng([seed, crc32(kind.encode())])
    view = _draw_view(rng)
    blur, noise = float(rng.choice(BLURS_PX)), float(rng.choice(NOISES))
    while _measure_contrast(build_sequence(kind, view, blur), view, blur) < LEAST_CONTRAST[noise]:
        blur = max(b for b in (0.0, *BLURS_PX) if b < blur)
    bit_depth = int(rng.choice([8, 8, 10, 12]))
    if pipeline:
        bit_depth = 8  # the images' own: the pipeline states it
    full_scale = None if bit_depth == 8 else (1 << bit_depth) - 1
    sequence = replace(build_sequence(kind, view, blur), full_scale=full_scale)
    few = any(f.kind == "phase" and f.steps <= FEW_STEPS for f in sequence.frames)
    gamma = float(rng.choice([1.0, 1.6, 2.2], p=[0.9, 0.1, 0.0] if few else [0.4, 0.3, 0.3]))
    jpeg = 85 if bit_depth == 8 and rng.random() < 0.3 else 0
    ambient, exposure = float(rng.choice([0.0, 0.03, 0.15])), float(rng.uniform(0.6, 0.85))
    return CaptureSetup(
        kind, seed, view, sequence, sequence, gamma, blur, noise, bit_depth, jpeg, ambient,
        exposure, pipeline=pipeline,
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


def _tabulate_pattern(setup: CaptureSetup, index: int) -> tuple[Axis, np.ndarray]:
    """The axis of a pattern, and its light at each eighth of a projector pixel, 1 for white."""
    along, levels = profile(setup.shown, index)
    axis: Axis = along or "x"
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
    light = add_crosstalk(light, setup.ghost)
    if setup.gains:
        light = scale_frames(light, np.array(setup.gains))
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
    out = np.empty(light.shape, np.float32 if setup.pipeline else dtype)
    relative = setup.noise / 255
    for i, frame in enumerate(light):
        signal = frame * np.float32(gain)
        # half of the standard deviation of full scale remains without light
        variance = relative**2 * (0.25 + 0.75 * np.clip(signal, 0, 1))
        signal = signal + np.sqrt(variance) * rng.standard_normal(signal.shape, np.float32)
        out[i] = signal if setup.pipeline else np.clip(np.rint(signal * full), 0, full)
    if setup.pipeline:
        return PIPELINES[setup.pipeline](out, rng)
    return compress_jpeg(out, setup.jpeg) if setup.jpeg else out


@dataclass(frozen=True, eq=False)
class _Plane:
    """A plane, limited to ``x_range`` and to ``radius`` about its point."""

    point: np.ndarray
    normal: np.ndarray
    x_range: tuple[float, float] = (-np.inf, np.inf)
    radius: float = np.inf

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Distance (n,) along rays, in lengths of their directions; infinite where they miss."""
        normal = self.normal.astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((self.point - origin) @ normal) / (direction @ normal)
            x = origin[..., 0] + t * direction[..., 0]
            inside = (x >= self.x_range[0]) & (x <= self.x_range[1])
            if np.isfinite(self.radius):
                hit = origin + t[:, None] * direction
                inside &= np.linalg.norm(hit - self.point, axis=-1) <= self.radius
        return np.where(inside & (t > _NEAR), t, np.inf)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Normals (n, 3) towards the camera."""
        return np.broadcast_to(-self.normal, points.shape)


@dataclass(frozen=True, eq=False)
class _Sphere:
    """A sphere."""

    centre: np.ndarray
    radius: float

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Distance (n,) along rays, in lengths of their directions; infinite where they miss."""
        offset = origin - self.centre
        a = (direction * direction).sum(axis=-1)
        b = (direction * offset).sum(axis=-1)
        c = (offset * offset).sum(axis=-1) - self.radius**2
        root = b * b - a * c
        t = (-b - np.sqrt(np.maximum(root, 0))) / a
        return np.where((root > 0) & (t > _NEAR), t, np.inf)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Outward normals (n, 3)."""
        return (points - self.centre) / self.radius


_Surface = _Plane | _Sphere


def _tilted(rng: np.random.Generator, most: float) -> np.ndarray:
    """A unit vector along z, tilted by up to ``most`` about x and y."""
    normal = np.array([*rng.uniform(-most, most, 2), 1.0])
    return normal / np.linalg.norm(normal)


def _build_surfaces(view: SceneView, moved: np.ndarray) -> list[_Surface]:
    """The surfaces of a scene, displaced by ``moved`` (3,)."""
    rng = np.random.default_rng(view.seed)
    if view.scene == "plane":
        return [_Plane(np.array([0, 0, 1.0]) + moved, _tilted(rng, 0.4))]
    if view.scene == "sphere":
        centre = np.array([*rng.uniform(-0.08, 0.08, 2), 1.1])
        wall = _Plane(np.array([0, 0, 1.2]) + moved, _tilted(rng, 0.15))
        return [_Sphere(centre + moved, float(rng.uniform(0.22, 0.3))), wall]
    if view.scene == "step":
        edge, depth = float(rng.uniform(-0.1, 0.1)), float(rng.uniform(0.86, 0.94))
        front = _Plane(
            np.array([0, 0, depth]) + moved, _tilted(rng, 0.2), (edge + float(moved[0]), np.inf)
        )
        return [front, _Plane(np.array([0, 0, 1.1]) + moved, _tilted(rng, 0.15))]
    centre = np.array([*rng.uniform(-0.15, 0.15, 2), 1.0])
    if rng.random() < 0.5:
        return [_Sphere(centre + moved, 0.2)]
    return [_Plane(centre + moved, _tilted(rng, 0.35), radius=0.205)]


def _paint(view: SceneView, points: np.ndarray) -> np.ndarray:
    """Albedo (n,) of the surfaces at points (n, 3) that move with them."""
    rng = np.random.default_rng([view.seed, 1])
    if view.texture == "plain":
        return np.full(len(points), 0.9)
    x = (points[:, 0] - 0.2 * points[:, 2]).astype(np.float32)
    y = (points[:, 1] + 0.1 * points[:, 2]).astype(np.float32)
    waves = np.zeros(len(points), np.float32)
    for _ in range(5):
        kx, ky, start = rng.uniform([-30, -30, 0], [30, 30, 6.3]).astype(np.float32)
        waves += np.sin(kx * x + ky * y + start)
    if view.texture == "smooth":
        return np.clip(0.65 + 0.12 * waves, 0.3, 1.0)
    return np.where(waves > 0.6, 0.3, 0.9) * np.clip(1 + 0.04 * waves, 0.8, 1.2)


def _list_rays(camera: Size) -> np.ndarray:
    """Directions (n, 3) float32 of the rays of all subpixels."""
    width, height = camera
    x, y = np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2
    rays = np.ones((len(_SUBPIXELS), height, width, 3), np.float32)
    for k, (dx, dy) in enumerate(_SUBPIXELS):
        rays[k, ..., 0] = (x + dx)[None, :] / (FOCAL * width)
        rays[k, ..., 1] = (y + dy)[:, None] / (FOCAL * width)
    return rays.reshape(-1, 3)


def _project(
    view: SceneView, points: np.ndarray, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Projector column and row (n,) px of points (n, 3); ``centre`` of the projector (3,)."""
    rotation = look_along(np.array([0, 0, 1.0]) - centre, view.roll)
    x, y, z = (rotation.astype(np.float32) @ (points - centre).T).astype(np.float32)
    extent = np.array(view.camera) / (FOCAL * view.camera[0]) * view.field
    focal = np.array(view.projector) / extent * np.linalg.norm(centre - [0, 0, 1.0])
    middle = [(extent - 1) / 2 for extent in view.projector]
    return focal[0] * x / z + middle[0], focal[1] * y / z + middle[1]


@lru_cache(maxsize=3)
def trace_view(
    view: SceneView, displacement: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Geometry:
    """Trace the rays of all subpixels; ``displacement`` of the scene, in its unit of length."""
    moved, rays = np.array(displacement, np.float32), _list_rays(view.camera)
    surfaces = _build_surfaces(view, moved)
    distances = np.stack([surface.intersect(np.zeros(3), rays) for surface in surfaces])
    nearest, t = distances.argmin(axis=0), distances.min(axis=0)
    is_seen = np.isfinite(t)
    points = np.where(is_seen, t, 1.0)[:, None].astype(np.float32) * rays
    normals = np.zeros_like(points)
    for k, surface in enumerate(surfaces):
        chosen = nearest == k
        normals[chosen] = surface.normals(points[chosen])
    centre = np.array([*view.baseline, 0.0], np.float32)
    to_light = centre - points
    for k, surface in enumerate(surfaces):
        # a surface does not hide itself: its normals decide that
        others = is_seen & (nearest != k)
        is_blocked = surface.intersect(points[others], to_light[others]) < 1
        normals[others] *= ~is_blocked[:, None]
    squared = np.einsum("ni,ni->n", to_light, to_light)
    lambert = np.maximum(np.einsum("ni,ni->n", normals, to_light), 0) / squared**1.5
    u, v = _project(view, points, centre)
    width, height = view.projector
    inside = (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
    albedo = np.where(is_seen, _paint(view, points - moved), 0.0)
    shade = np.where(inside & (lambert > _GRAZING), albedo * lambert, 0.0)
    shape = (len(_SUBPIXELS), view.camera[1], view.camera[0])
    u, v, albedo, shade = (
        each.astype(np.float32).reshape(shape)
        for each in (np.clip(u, -1, width), np.clip(v, -1, height), albedo, shade)
    )
    return Geometry(u, v, albedo, shade, _EDGE_PX / view.pixels_per_column)
