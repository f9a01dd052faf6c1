"""Observation of one board pose: features in both devices, and the smoothed phase over the board
(Letter step 2).

An observation is small whatever the image size, so any number of poses fits in memory; frames and
phase maps are released.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.calibration.board_plane import BoardPlane
from slviewer.calibration.edges import bright_pixels
from slviewer.calibration.local_fit import fit_local_values
from slviewer.errors import DetectionError, InputError
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.geometry.polynomial import Polynomial2D, fit_polynomial
from slviewer.geometry.rigid import Floats
from slviewer.geometry.splines import SplineSurface, fit_spline
from slviewer.geometry.vectors import lengths
from slviewer.target.board import Board
from slviewer.target.detect import Detection, board_mask

READING_VERSION = 4
"""Version of ``observe``; observations that a session saved with another version are computed
again."""
SAMPLES = 30_000
"""Largest number of pixels in one smoothing fit; more change the result by less than the noise."""
AXES: tuple[Axis, ...] = ("x", "y")
CELLS_PER_WIDTH = 14
"""Spline cells across the image: half the wavelength of the finest relevant lens distortion."""


COUNT = 4000
"""Number of blocks sampled from one pose; more resolve no finer distortion and slow the joint
adjustment down."""
MAX_BLOCK_PX = 5
"""Largest side of a block; over more pixels, the phase of a tilted board is not linear."""
MIN_FILL_SHARE = 0.5
"""Share of a block's pixels that must be bright."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Projector coordinates averaged over blocks of camera pixels.

    ``camera`` (n, 2) px: mean pixel of each block; ``projector`` (n, 2) px: mean projector
    coordinates; ``sigma`` (n, 2) px: their standard deviations predicted from the capture's noise.
    An axis that was not captured is NaN.
    """

    camera: Floats
    projector: Floats
    sigma: Floats

    def __post_init__(self) -> None:
        shapes = {a.shape for a in (self.camera, self.projector, self.sigma)}
        if len(shapes) != 1 or self.camera.ndim != 2 or self.camera.shape[1] != 2:
            raise InputError(
                f"samples of shapes {sorted(shapes)} do not match: give three arrays (n, 2)"
            )


def block_samples(
    phases: Mapping[Axis, PhaseMap],
    bright: Mapping[Axis, np.ndarray],
    axes: Sequence[Axis],
    count: int = COUNT,
) -> Samples:
    """Average the projector coordinates over at most ``count`` blocks of the pixels that are
    ``bright`` in every axis.

    ``bright``: (h, w) bool by axis; ``axes``: the columns of the result.
    """
    usable = np.logical_and.reduce(list(bright.values()))
    v, u = np.nonzero(usable)
    side = int(np.clip(np.sqrt(len(v) / count), 1, MAX_BLOCK_PX))
    across = usable.shape[1] // side + 1
    block = (v // side) * across + u // side
    filled = np.bincount(block)
    chosen = np.nonzero(filled >= max(1, MIN_FILL_SHARE * side * side))[0]
    if len(chosen) > count:
        chosen = np.sort(np.random.default_rng(0).choice(chosen, count, replace=False))
    inverse = 1.0 / filled[chosen]

    def mean(values: np.ndarray) -> np.ndarray:
        """Return the mean of the pixels' values in each chosen block."""
        return np.bincount(block, weights=values)[chosen] * inverse

    camera = np.stack([mean(u), mean(v)], axis=1)
    projector, sigma = np.full((2, len(chosen), 2), np.nan)
    for axis, phase in phases.items():
        column, px = axes.index(axis), phase.period_px / (2 * np.pi)
        projector[:, column] = mean(phase.phase[v, u].astype(float) * px)
        sigma[:, column] = np.sqrt(
            mean((phase.sigma_phase[v, u].astype(float) * px) ** 2) * inverse
        )
    return Samples(camera, projector, sigma)


@dataclass(frozen=True)
class Smoothing:
    """How step 2 smooths a board's phase.

    ``spline`` (default) keeps the local distortion that the model should learn; ``polynomial`` of
    degree 5 is close to the Letter's own, and removes part of it.
    """

    kind: str = "spline"
    degree: int = 5

    def __post_init__(self) -> None:
        if self.kind not in ("spline", "polynomial"):
            raise InputError(f"smoothing '{self.kind}' is unknown: use 'spline' or 'polynomial'")
        if not 1 <= self.degree <= 20:
            raise InputError(
                f"a polynomial of degree {self.degree} cannot be fitted reliably: use 1 to 20"
            )


@dataclass(frozen=True)
class Observation:
    """Features and phase of one pose of the board.

    ``camera`` and ``projector`` (n, 2) px correspond to ``points`` (n, 3) mm on the board; unknown
    projector coordinates are NaN. ``surfaces``: the smoothed absolute phase (rad) over the board by
    captured axis, valid in ``region``, the part of the board with measured phase close by.
    ``slopes`` (n, 2, 2): Jacobian of the projector coordinates by camera pixels at each feature.
    ``radius_mm``: of circles, whose pixels are the centroids of their images (see
    ``calibration.centres``); 0 where they are centres. ``marked``: whether the board's mark was
    detected, so that the numbering is unambiguous. ``samples``: unsmoothed phase at bright blocks;
    None in older observations.
    """

    name: str
    points: Floats
    camera: Floats
    projector: np.ndarray
    surfaces: Mapping[Axis, SplineSurface | Polynomial2D]
    periods_px: Mapping[Axis, float]
    size: tuple[int, int]
    box: tuple[int, int, int, int]
    packed_region: np.ndarray = field(repr=False)
    slopes: np.ndarray | None = field(default=None, repr=False)
    radius_mm: float = 0.0
    marked: bool = False
    samples: Samples | None = field(default=None, repr=False)

    @property
    def region(self) -> NDArray[np.bool_]:
        """(v1 - v0, u1 - u0) bool over ``box`` = (u0, v0, u1, v1)."""
        u0, v0, u1, v1 = self.box
        shape = (v1 - v0, u1 - u0)
        return (
            np.unpackbits(self.packed_region, count=shape[0] * shape[1]).view(bool).reshape(shape)
        )

    def smoothed_phase(self, axis: Axis) -> Floats:
        """(v1 - v0, u1 - u0) float64 rad over ``box``: the smoothed absolute phase, NaN outside the
        region."""
        u0, v0, u1, v1 = self.box
        return np.where(
            self.region, self.surfaces[axis].evaluate_grid((v1 - v0, u1 - u0), (u0, v0)), np.nan
        )

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return named arrays for saving."""
        arrays = {
            "points": self.points,
            "camera": self.camera,
            "projector": self.projector,
            "size": np.array(self.size),
            "box": np.array(self.box),
            "region": self.packed_region,
            "radius_mm": np.array(self.radius_mm),
            "marked": np.array(self.marked),
        }
        if self.slopes is not None:
            arrays["slopes"] = self.slopes
        if self.samples is not None:
            arrays |= {f"samples_{name}": values for name, values in vars(self.samples).items()}
        for axis, surface in self.surfaces.items():
            trend = surface.trend if isinstance(surface, SplineSurface) else surface
            arrays |= {
                f"{axis}_period_px": np.array(self.periods_px[axis]),
                f"{axis}_trend": trend.coefficients,
                f"{axis}_extent": np.array(trend.box),
            }
            if isinstance(surface, SplineSurface):
                arrays[f"{axis}_spline"] = surface.coefficients
        return arrays

    @classmethod
    def from_arrays(cls, name: str, arrays: Mapping[str, np.ndarray]) -> "Observation":
        """Return the observation that ``to_arrays`` saved."""
        surfaces: dict[Axis, SplineSurface | Polynomial2D] = {}
        captured: list[Axis] = [axis for axis in AXES if f"{axis}_trend" in arrays]
        for axis in captured:
            u0, v0, u1, v1 = (float(edge) for edge in arrays[f"{axis}_extent"])
            trend = Polynomial2D(arrays[f"{axis}_trend"], (u0, v0, u1, v1))
            spline = arrays.get(f"{axis}_spline")
            surfaces[axis] = trend if spline is None else SplineSurface(trend, spline)
        width, height = (int(n) for n in arrays["size"])
        left, top, right, bottom = (int(edge) for edge in arrays["box"])
        return cls(
            name,
            arrays["points"],
            arrays["camera"],
            arrays["projector"],
            surfaces,
            {axis: float(arrays[f"{axis}_period_px"]) for axis in captured},
            (width, height),
            (left, top, right, bottom),
            arrays["region"],
            arrays.get("slopes"),
            float(arrays.get("radius_mm", 0.0)),
            bool(arrays.get("marked", False)),
            (
                Samples(*(arrays[f"samples_{name}"] for name in Samples.__annotations__))
                if "samples_camera" in arrays
                else None
            ),
        )


def observe(
    name: str,
    board: Board,
    detection: Detection,
    phases: Mapping[Axis, PhaseMap],
    smoothing: Smoothing | None = None,
) -> Observation:
    """Compute the observation of one pose from its detected board and its decoded phase maps by
    axis.

    Raises DetectionError where too few pixels of the board carry a usable pattern.
    """
    smoothing = smoothing or Smoothing()
    any_phase = next(iter(phases.values()))
    height, width = any_phase.phase.shape
    inside = board_mask(board, detection, (height, width))
    pitch = pitch_px(board, detection)
    typical_pitch = float(np.median(pitch))
    box = _bounding_box(inside)
    with ThreadPoolExecutor(max(1, len(phases))) as threads:
        each = threads.map(
            lambda phase: bright_pixels(phase, inside, typical_pitch), phases.values()
        )
        bright = dict(zip(phases, each, strict=True))
    projector, _ = _projector_pixels(detection, phases, bright, pitch)
    plane = BoardPlane.fit(detection.pixels, projector, (width, height))
    for axis in phases:
        if plane:  # excludes objects in front of the board
            u0, v0, u1, v1 = box
            coordinate = phases[axis].coordinate[v0:v1, u0:u1]
            bright[axis][v0:v1, u0:u1] &= plane.contains(coordinate, AXES.index(axis), (u0, v0))
        if np.count_nonzero(bright[axis]) < 400:
            raise DetectionError(
                f"only {np.count_nonzero(bright[axis])} pixels of the board carry a usable {axis}"
                " pattern: illuminate the whole board with the projector, and raise the exposure"
            )
    projector, slopes = _projector_pixels(detection, phases, bright, pitch)
    u0, v0, u1, v1 = box
    supported = inside.copy()
    weighted = {}
    for axis, phase in phases.items():
        weighted[axis] = phase.phase[v0:v1, u0:u1], _phase_weight(phase, bright[axis])[v0:v1, u0:u1]
        supported &= _is_near_bright(bright[axis], reach=typical_pitch)
    surfaces = smooth_axes(weighted, box, width, typical_pitch, smoothing)
    return Observation(
        name=name,
        points=board.points[detection.ids],
        camera=np.asarray(detection.pixels, float),
        projector=projector,
        surfaces=surfaces,
        periods_px={axis: phase.period_px for axis, phase in phases.items()},
        size=(width, height),
        box=box,
        packed_region=np.packbits(supported[v0:v1, u0:u1]),
        slopes=slopes,
        radius_mm=detection.radius_mm,
        marked=detection.marked,
        samples=block_samples(phases, bright, AXES),
    )


def pitch_px(board: Board, detection: Detection) -> Floats:
    """Return the board's pitch (n,) in camera px at each feature."""
    points = board.points[detection.ids][:, :2]
    H, _ = cv2.findHomography(points, np.asarray(detection.pixels, float))
    half = board.pitch_mm / 2
    sides = []
    for step in (np.array([half, 0.0]), np.array([0.0, half])):
        ahead, behind = (cv2.perspectiveTransform((points + s)[None], H)[0] for s in (step, -step))
        sides.append(lengths(ahead - behind))
    return np.minimum(*sides)


def _projector_pixels(
    detection: Detection,
    phases: Mapping[Axis, PhaseMap],
    bright: Mapping[Axis, np.ndarray],
    pitch: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Fit the projector coordinates (n, 2) px of the features, and their Jacobians (n, 2, 2) by
    camera pixels.

    NaN where too few bright pixels surround a feature.
    """
    projector = np.full((len(detection.ids), 2), np.nan)
    slopes = np.full((len(detection.ids), 2, 2), np.nan)
    for axis, phase in phases.items():
        coordinate = np.where(bright[axis], phase.coordinate, 0.0)
        weight = _phase_weight(phase, bright[axis])
        values = fit_local_values(coordinate, weight, detection.pixels, 0.8 * pitch)
        projector[:, AXES.index(axis)], slopes[:, AXES.index(axis)] = values
    return projector, slopes


def _phase_weight(phase: PhaseMap, bright: np.ndarray) -> np.ndarray:
    """Return weights (h, w): the inverse variance of the phase of bright pixels over its maximum,
    else 0."""
    weight = np.where(bright, 1.0 / np.maximum(phase.sigma_phase, 1e-6) ** 2, 0.0)
    return weight / max(float(weight.max()), 1e-30)


def smooth_axes(
    weighted: Mapping[Axis, tuple[np.ndarray, np.ndarray]],
    box: tuple[int, int, int, int],
    width: int,
    pitch: float,
    smoothing: Smoothing,
) -> dict[Axis, SplineSurface | Polynomial2D]:
    """Run ``smooth_phase`` on each axis' (phase, weight) in parallel threads; see there for the
    parameters."""
    with ThreadPoolExecutor(max(1, len(weighted))) as threads:
        surfaces = threads.map(
            lambda pair: smooth_phase(pair[0], pair[1], box, width, pitch, smoothing),
            weighted.values(),
        )
        return dict(zip(weighted, surfaces, strict=True))


def smooth_phase(
    phase: np.ndarray,
    weight: np.ndarray,
    box: tuple[int, int, int, int],
    width: int,
    pitch: float,
    smoothing: Smoothing,
) -> SplineSurface | Polynomial2D:
    """Fit a smooth surface to a board's absolute phase (step 2).

    ``phase`` (v1 - v0, u1 - u0) rad and its ``weight`` over the ``box`` (u0, v0, u1, v1); ``width``
    of the image and ``pitch`` of the board in px.
    """
    u0, v0, u1, v1 = box
    v, u = np.nonzero(weight)
    if len(v) > SAMPLES:
        chosen = np.random.default_rng(0).choice(len(v), SAMPLES, replace=False)
        v, u = v[chosen], u[chosen]
    values, weights = phase[v, u].astype(float), weight[v, u]
    v, u = v + v0, u + u0
    extent = (u0 - 0.5, v0 - 0.5, u1 - 0.5, v1 - 0.5)
    if smoothing.kind == "polynomial":
        return fit_polynomial(u, v, values, weights, extent, smoothing.degree, robust=True)
    cell = max(width / CELLS_PER_WIDTH, 1.2 * pitch)
    cells = (max(1, round((u1 - u0) / cell)), max(1, round((v1 - v0) / cell)))
    return fit_spline(u, v, values, weights, extent, cells, robust=True)


def _is_near_bright(bright: np.ndarray, reach: float) -> np.ndarray:
    """(h, w) bool: pixels that have bright ones within ``reach`` px on every side of a closing."""
    step = max(1, int(reach // 8))
    height, width = bright.shape
    small = cv2.resize(
        bright.astype(np.uint8),
        (-(-width // step), -(-height // step)),
        interpolation=cv2.INTER_AREA,
    )
    size = 2 * int(np.ceil(reach / step)) + 1
    closed = cv2.morphologyEx(
        small, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    )
    grown = cv2.dilate(closed, np.ones((3, 3), np.uint8))
    return cv2.resize(grown, (width, height), interpolation=cv2.INTER_NEAREST) > 0


def _bounding_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Return (u0, v0, u1, v1) px around a mask (h, w); raises DetectionError where it is empty."""
    rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
    if not len(rows):
        raise DetectionError("the board's outline is outside the image: move the board into view")
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
