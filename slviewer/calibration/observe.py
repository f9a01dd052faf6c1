"""Observation of one board pose: features in both devices, and the smoothed phase over the board
(Letter step 2).

An observation is small whatever the image size, so any number of poses fits in memory; frames and
phase maps are released. The board's pixels count where their phase is undisturbed: bright ones,
clear of the contrast edges, that agree with the board's plane.

The camera's lens and pixels mix bright and dark across an edge, and the phase of a bright pixel
there is that of a point farther inside the bright part: by half a blur's sigma at the edge, a tenth
at 1.3 sigma, a fortieth at 2 and a hundredth at 2.5, whatever the blur (measured on rendered boards
of known truth). The errors of opposite sides of a circle cancel, so that the error of a feature or
a smoothed surface is smallest where 2 sigma are excluded; with more, the loss of pixels adds more
noise.
"""

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TypeVar

import cv2
import numpy as np

from slviewer.calibration.local_fit import fit_local_values
from slviewer.errors import DetectionError, InputError
from slviewer.fringe.image_area import ImageArea, combine_areas
from slviewer.fringe.phase import PhaseMap, PhaseMaps
from slviewer.fringe.sequence import Axis, Size
from slviewer.geometry.polynomial import Polynomial2D, fit_polynomial
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.robust import RAYLEIGH_MEDIAN
from slviewer.geometry.splines import SplineSurface, fit_spline
from slviewer.geometry.vectors import finite_rows, lengths, rms
from slviewer.target.board import Board, Detection
from slviewer.target.detect import board_mask

T = TypeVar("T")
Result = TypeVar("Result")
READING_VERSION = 9
"""Version of ``observe``; observations that a session saved with another version are computed
again."""
SAMPLES = 30_000
"""Largest number of pixels in one smoothing fit; more change the result by less than the noise."""
AXES: tuple[Axis, ...] = ("x", "y")
CELLS_PER_WIDTH = 14
"""Spline cells along the image's longer side: half the wavelength of the finest relevant lens
distortion."""
CLEARANCE_SIGMAS = 2.0
"""Distance from an edge, in standard deviations of its blur, beyond which a bright pixel's phase is
undisturbed."""
MIN_CLEARANCE_PX = 1.0
"""Smallest clearance: the uncertainty of a mask's edge."""
MIN_CLEAR_SHARE = 0.25
"""Share of the bright pixels within half a pitch that must be clear of edges; otherwise the
clearance is reduced."""
SHARPEST_PX = 12**-0.5
"""Blur of an edge by the pixel area alone."""
EDGE_BAND = 0.25
"""Pixels whose brightness differs by this share of the contrast from dark and from bright belong to
an edge; with a Gaussian blur they are within 0.6745 sigma of it."""
MIN_FEATURES = 12
"""Nine unknowns, and some features more."""
OUTLIER_SIGMAS = 6.0
"""Features with a larger residual, in robust sigma, are outliers."""
MIN_OUTLIER_PX = 0.5
"""What the homography and one bend leave of a real lens is smaller: no feature is an outlier for
it."""
MIN_TOLERANCE_PX = 1.0
TOLERANCE_RATIO = 4.0
"""Tolerance of a pixel's coordinate: 1 px plus four times the largest residual of a feature. Beyond
the outermost features, lens distortion is several times as large as between them."""
COUNT = 4000
"""Number of blocks sampled from one pose; more resolve no finer distortion and slow the joint
adjustment down."""
MAX_BLOCK_PX = 5
"""Largest side of a block; over more pixels, the phase of a tilted board is not linear."""
MIN_FILL_SHARE = 0.5
"""Share of a block's pixels that must be bright."""
LIGHT = "light_"
"""Before the names of the arrays of an observation's ``light``."""


@dataclass(frozen=True)
class BoardPlane:
    """A homography from camera to projector, with the division model x / (1 + bend r^2) of the
    camera's distortion.

    ``centre`` px and ``radius`` px normalise camera pixels; ``reach`` (2,) px: tolerance of the
    projector's x and y coordinate at a pixel of the board.
    """

    H: np.ndarray
    bend: float
    centre: Floats
    radius: float
    reach: Floats

    @classmethod
    def fit(cls, camera: Floats, projector: Floats, size: Size) -> "BoardPlane | None":
        """Fit the map from camera to projector that a plane makes, robustly, to features at
        ``camera`` and ``projector`` pixels (n, 2), NaN where unknown.

        ``size``: (width, height) px of the camera. None where fewer than MIN_FEATURES inliers
        remain.
        """
        centre, radius = (np.array(size) - 1) / 2, float(np.hypot(*size)) / 2
        inlier = finite_rows(projector, camera)
        plane = None
        for _ in range(5):
            if np.count_nonzero(inlier) < MIN_FEATURES:
                return None
            plane = cls._fit_inliers(camera[inlier], projector[inlier], centre, radius)
            if plane is None:
                return None
            residual = lengths(plane.predict(camera[:, 0], camera[:, 1]) - projector)
            before, typical = inlier, np.median(residual[inlier])
            limit = max(OUTLIER_SIGMAS * typical / RAYLEIGH_MEDIAN, MIN_OUTLIER_PX)
            inlier = residual < limit
            if np.array_equal(inlier, before):
                break
        return plane

    @classmethod
    def _fit_inliers(
        cls, camera: Floats, projector: Floats, centre: Floats, radius: float
    ) -> "BoardPlane | None":
        """Fit the homography for a range of distortions, refined twice, and return the plane with
        the smallest RMS."""
        bends, step = np.linspace(-0.5, 0.3, 9), 0.1
        fits: list[tuple[float, BoardPlane]] = []
        normalised = (camera - centre) / radius
        squares = np.sum(normalised**2, axis=1, keepdims=True)
        for _ in range(3):
            for bend in bends:
                # undistorted by the division model
                H, _ = cv2.findHomography(normalised / (1 + bend * squares), projector)
                if H is None:
                    continue
                plane = cls(H, float(bend), centre, radius, np.zeros(2))
                residuals = plane.predict(camera[:, 0], camera[:, 1]) - projector
                reach = MIN_TOLERANCE_PX + TOLERANCE_RATIO * np.abs(residuals).max(0)
                fits.append((rms(residuals), replace(plane, reach=reach)))
            if not fits:
                return None
            _, best = min(fits, key=lambda fit: fit[0])
            bends = best.bend + np.linspace(-step, step, 7)
            step /= 3
        return best

    def predict(self, u: np.ndarray, v: np.ndarray) -> Floats:
        """Return the plane's projector coordinates (..., 2) px at camera pixels (u, v), which
        broadcast."""
        x, y = (u - self.centre[0]) / self.radius, (v - self.centre[1]) / self.radius
        scale = 1 + self.bend * (x * x + y * y)
        a, b, w = (h[0] * x + h[1] * y + h[2] * scale for h in self.H)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([a / w, b / w], axis=-1)

    def contains(self, coordinate: np.ndarray, along: int, origin: tuple[int, int]) -> Mask:
        """(h', w') bool: projector coordinates (h', w') px within the tolerance of the plane; False
        for NaN.

        ``along``: 0 for columns, 1 for rows; ``origin``: camera pixel (u0, v0) of the first
        coordinate.
        """
        height, width = coordinate.shape
        expected = self.predict(
            np.arange(width)[None] + origin[0], np.arange(height)[:, None] + origin[1]
        )
        with np.errstate(invalid="ignore"):
            return np.abs(coordinate - expected[..., along]) < self.reach[along]


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


def block_samples(
    phases: PhaseMaps,
    bright: Mapping[Axis, Mask],
    count: int = COUNT,
) -> Samples:
    """Average the projector coordinates over at most ``count`` blocks of the pixels that are
    ``bright`` (h, w) bool in every axis."""
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
        column, px = AXES.index(axis), phase.px_per_rad
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
            raise InputError(f"smoothing '{self.kind}' is unknown", "use 'spline' or 'polynomial'")
        if not 1 <= self.degree <= 20:
            raise InputError(
                f"a polynomial of degree {self.degree} cannot be fitted reliably", "use 1 to 20"
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
    detected, so that the numbering is unambiguous; ``others`` (k, n, 3) mm: further ``points`` that
    the image allows, where its border hides which features these are. ``samples``: unsmoothed phase
    at bright blocks; None in older observations. ``light``: of two cameras, where "projector"
    stands for the second one, the same features as the projector itself lit them; None where it lit
    one axis. ``area``: the part of the image that changed between the pose's frames.
    """

    name: str
    points: Floats
    camera: Floats
    projector: Floats
    surfaces: Mapping[Axis, SplineSurface | Polynomial2D]
    periods_px: Mapping[Axis, float]
    size: Size
    box: tuple[int, int, int, int]
    packed_region: np.ndarray = field(repr=False)
    slopes: Floats | None = field(default=None, repr=False)
    radius_mm: float = 0.0
    marked: bool = False
    others: Floats | None = field(default=None, repr=False)
    samples: Samples | None = field(default=None, repr=False)
    light: "Observation | None" = field(default=None, repr=False)
    area: ImageArea | None = field(default=None, repr=False)

    @property
    def region(self) -> Mask:
        """(v1 - v0, u1 - u0) bool over ``box`` = (u0, v0, u1, v1)."""
        return self.region_rows(0, self.box[3] - self.box[1])

    def region_rows(self, first: int, last: int) -> Mask:
        """Return rows ``first`` to ``last`` of the region, (last - first, width) bool."""
        width = self.box[2] - self.box[0]
        start, stop = first * width, last * width
        bits = np.unpackbits(self.packed_region[start // 8 : -(-stop // 8)])
        return bits[start % 8 :][: stop - start].view(bool).reshape(-1, width)

    def smoothed_phase(self, axis: Axis) -> Floats:
        """(v1 - v0, u1 - u0) float64 rad over ``box``: the smoothed absolute phase, NaN outside the
        region."""
        u0, v0, u1, v1 = self.box
        return np.where(
            self.region, self.surfaces[axis].evaluate_grid((v1 - v0, u1 - u0), (u0, v0)), np.nan
        )

    def coordinate(self, axis: Axis, u: np.ndarray, v: np.ndarray) -> Floats:
        """Return the smoothed projector coordinate (n,) px at camera pixels ``u``, ``v`` (n,)."""
        return self.surfaces[axis].evaluate(u, v) * (self.periods_px[axis] / (2 * np.pi))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return named arrays for saving."""
        names = ("points", "camera", "projector", "size", "box", "radius_mm", "marked")
        arrays = {name: np.asarray(getattr(self, name)) for name in names}
        arrays["region"] = self.packed_region
        for name in ("slopes", "others"):
            if (values := getattr(self, name)) is not None:
                arrays[name] = values
        if self.samples is not None:
            arrays |= {f"samples_{name}": values for name, values in vars(self.samples).items()}
        if self.area is not None:
            arrays |= self.area.to_arrays()
        for axis, surface in self.surfaces.items():
            trend = surface.trend if isinstance(surface, SplineSurface) else surface
            arrays |= {
                f"{axis}_period_px": np.array(self.periods_px[axis]),
                f"{axis}_trend": trend.coefficients,
                f"{axis}_extent": np.array(trend.box),
            }
            if isinstance(surface, SplineSurface):
                arrays[f"{axis}_spline"] = surface.coefficients
        if self.light is not None:
            own = self.light.to_arrays()
            arrays |= {f"{LIGHT}{name}": values for name, values in own.items()}
        return arrays

    @classmethod
    def from_arrays(cls, name: str, arrays: Mapping[str, np.ndarray]) -> "Observation":
        """Return the observation that ``to_arrays`` saved."""
        surfaces: dict[Axis, SplineSurface | Polynomial2D] = {}
        periods: dict[Axis, float] = {}
        for axis in AXES:
            if f"{axis}_trend" not in arrays:
                continue
            periods[axis] = float(arrays[f"{axis}_period_px"])
            trend = Polynomial2D(arrays[f"{axis}_trend"], tuple(arrays[f"{axis}_extent"].tolist()))
            spline = arrays.get(f"{axis}_spline")
            surfaces[axis] = trend if spline is None else SplineSurface(trend, spline)
        samples = None
        if "samples_camera" in arrays:
            samples = Samples(*(arrays[f"samples_{name}"] for name in Samples.__annotations__))
        of_light = {
            key.removeprefix(LIGHT): each for key, each in arrays.items() if key.startswith(LIGHT)
        }
        return cls(
            name,
            arrays["points"],
            arrays["camera"],
            arrays["projector"],
            surfaces,
            periods,
            tuple(arrays["size"].tolist()),
            tuple(arrays["box"].tolist()),
            arrays["region"],
            arrays.get("slopes"),
            float(arrays.get("radius_mm", 0.0)),
            bool(arrays.get("marked", False)),
            arrays.get("others"),
            samples,
            cls.from_arrays(name, of_light) if of_light else None,
            ImageArea.from_arrays(arrays),
        )


def combine_observed(observations: Iterable[Observation]) -> ImageArea | None:
    """Return the part of the camera's image that changes in these poses, as `combine_areas`
    does."""
    return combine_areas([o.area for o in observations])


def observe(
    name: str,
    board: Board,
    detection: Detection,
    phases: PhaseMaps,
    smoothing: Smoothing | None = None,
    area: ImageArea | None = None,
) -> Observation:
    """Compute the observation of one pose from its detected board and its decoded phase maps by
    axis. ``area``: the part of the image that changes, all of it if None.

    Raises DetectionError where too few pixels of the board carry a usable pattern.
    """
    height, width = next(iter(phases.values())).phase.shape
    inside = board_mask(board, detection, (height, width))
    pitch = pitch_px(board, detection)
    typical_pitch = float(np.median(pitch))
    u0, v0, u1, v1 = box = _bounding_box(inside)
    part = slice(v0, v1), slice(u0, u1)
    bright = _map_axes(lambda phase: bright_pixels(phase, inside, typical_pitch), phases)
    projector, _ = _projector_pixels(detection, phases, bright, pitch)
    plane = BoardPlane.fit(detection.pixels, projector, (width, height))
    for axis in phases:
        if plane:  # excludes objects in front of the board
            coordinate = phases[axis].coordinate[part]
            bright[axis][part] &= plane.contains(coordinate, AXES.index(axis), (u0, v0))
        if np.count_nonzero(bright[axis]) < 400:
            raise DetectionError(
                f"only {np.count_nonzero(bright[axis])} pixels of the board carry a usable {axis}"
                " pattern",
                "illuminate the whole board with the projector, and raise the exposure",
            )
    projector, slopes = _projector_pixels(detection, phases, bright, pitch)
    supported = inside.copy()
    weighted = {}
    for axis, phase in phases.items():
        weighted[axis] = phase.phase[part], _phase_weight(phase, bright[axis])[part]
        supported &= _is_near_bright(bright[axis], reach=typical_pitch)
    whole = (0, 0, width, height) if area is None else area.box
    side = int(height > width)  # a camera on its side has the same cells as one upright
    across = whole[2 + side] - whole[side]
    surfaces = smooth_axes(weighted, box, across, typical_pitch, smoothing or Smoothing())
    return Observation(
        name=name,
        points=board.points[detection.ids],
        camera=detection.pixels,
        projector=projector,
        surfaces=surfaces,
        periods_px={axis: phase.period_px for axis, phase in phases.items()},
        size=(width, height),
        box=box,
        packed_region=np.packbits(supported[part]),
        slopes=slopes,
        radius_mm=detection.radius_mm,
        marked=detection.marked,
        others=board.points[detection.others] if len(detection.others) else None,
        samples=block_samples(phases, bright),
        area=area,
    )


def pitch_px(board: Board, detection: Detection) -> Floats:
    """Return the board's pitch (n,) in camera px at each feature."""
    points = board.points[detection.ids][:, :2]
    H, _ = cv2.findHomography(points, detection.pixels)
    half = board.pitch_mm / 2
    steps = half * np.array([[[1, 0]], [[-1, 0]], [[0, 1]], [[0, -1]]])
    right, left, below, above = (cv2.perspectiveTransform(points[None] + s, H)[0] for s in steps)
    return np.minimum(lengths(right - left), lengths(below - above))


def _projector_pixels(
    detection: Detection,
    phases: PhaseMaps,
    bright: Mapping[Axis, Mask],
    pitch: Floats,
) -> tuple[Floats, Floats]:
    """Fit the projector coordinates (n, 2) px of the features, and their Jacobians (n, 2, 2) by
    camera pixels.

    NaN where too few bright pixels surround a feature.
    """
    projector = np.full((len(detection.ids), 2), np.nan)
    slopes = np.full((len(detection.ids), 2, 2), np.nan)
    for axis, phase in phases.items():
        coordinate, k = np.where(bright[axis], phase.coordinate, 0.0), AXES.index(axis)
        weight = _phase_weight(phase, bright[axis])
        projector[:, k], slopes[:, k] = fit_local_values(
            coordinate, weight, detection.pixels, 0.8 * pitch
        )
    return projector, slopes


def _map_axes(function: Callable[[T], Result], by_axis: Mapping[Axis, T]) -> dict[Axis, Result]:
    """Apply a function to what belongs to each axis, in parallel threads."""
    with ThreadPoolExecutor(max(1, len(by_axis))) as threads:
        return dict(zip(by_axis, threads.map(function, by_axis.values()), strict=True))


def _phase_weight(phase: PhaseMap, bright: Mask) -> Floats:
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
    """Fit a smooth surface to a board's absolute phase in each axis (step 2).

    ``weighted``: phase (v1 - v0, u1 - u0) rad and its weight over the ``box`` (u0, v0, u1, v1);
    ``width``: of the image's longer side, and ``pitch`` of the board, in px.
    """
    u0, v0, u1, v1 = box
    extent = (u0 - 0.5, v0 - 0.5, u1 - 0.5, v1 - 0.5)
    cell = max(width / CELLS_PER_WIDTH, 1.2 * pitch)
    cells = (max(1, round((u1 - u0) / cell)), max(1, round((v1 - v0) / cell)))

    def smooth(axis: tuple[np.ndarray, np.ndarray]) -> SplineSurface | Polynomial2D:
        """Return the surface of one axis."""
        phase, weight = axis
        v, u = np.nonzero(weight)
        if len(v) > SAMPLES:
            chosen = np.random.default_rng(0).choice(len(v), SAMPLES, replace=False)
            v, u = v[chosen], u[chosen]
        samples = u + u0, v + v0, phase[v, u].astype(float), weight[v, u], extent
        if smoothing.kind == "polynomial":
            return fit_polynomial(*samples, smoothing.degree, robust=True)
        return fit_spline(*samples, cells, robust=True)

    return _map_axes(smooth, weighted)


def _is_near_bright(bright: Mask, reach: float) -> Mask:
    """(h, w) bool: pixels that have bright ones within ``reach`` px on every side of a closing."""
    step = max(1, int(reach // 8))
    height, width = bright.shape
    shape = -(-width // step), -(-height // step)
    small = cv2.resize(bright.astype(np.uint8), shape, interpolation=cv2.INTER_AREA)
    size = 2 * int(np.ceil(reach / step)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    closed = cv2.morphologyEx(small, cv2.MORPH_CLOSE, disc)
    grown = cv2.dilate(closed, np.ones((3, 3), np.uint8))
    return cv2.resize(grown, (width, height), interpolation=cv2.INTER_NEAREST) > 0


def _bounding_box(mask: Mask) -> tuple[int, int, int, int]:
    """Return (u0, v0, u1, v1) px around a mask (h, w); raises DetectionError where it is empty."""
    u0, v0, width, height = cv2.boundingRect(mask.astype(np.uint8))
    if not width:
        raise DetectionError("the board's outline is outside the image", "move the board into view")
    return u0, v0, u0 + width, v0 + height


def bright_pixels(phase: PhaseMap, inside: Mask, pitch: float) -> Mask:
    """Select the valid pixels (h, w) bool of the board's bright parts at a distance from contrast
    edges.

    ``inside`` (h, w) bool: the board's pixels; ``pitch``: px. Bright pixels have more than half of
    the largest modulation within a pitch. The distance is 2 sigma of the edges' blur, less where
    few pixels would remain, as between the squares and markers of a ChArUco board.
    """
    modulation = np.where(inside & phase.mask, phase.modulation, 0).astype(np.float32)
    crest = _local_extreme(cv2.dilate, modulation, pitch)
    bright = (modulation > 0.5 * crest) & (modulation > 0)
    # a lone pixel lost to noise is not an edge
    dark = cv2.morphologyEx((~bright).view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    sigma = edge_blur_px(phase, inside, pitch)
    # px from the edge, half a px before the first dark pixel's middle
    apart = cv2.distanceTransform(1 - dark, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5
    clear = np.zeros_like(bright)
    window = (2 * int(pitch / 2) + 1,) * 2
    around = cv2.blur(bright.astype(np.float32), window)
    for share in (1.0, 0.8, 0.6, 0.3):
        few = cv2.blur(clear.astype(np.float32), window) < MIN_CLEAR_SHARE * around
        clear |= few & bright & (apart > max(share * CLEARANCE_SIGMAS * sigma, MIN_CLEARANCE_PX))
    return clear


def edge_blur_px(phase: PhaseMap, inside: Mask, pitch: float) -> float:
    """Estimate the blur of the board's contrast edges by lens and pixels, standard deviation in px.

    It is proportional to the area of intermediate pixels over the length of the edges.
    """
    modulation = np.asarray(phase.modulation, np.float32)
    crest, trough = (_local_extreme(of, modulation, pitch) for of in (cv2.dilate, cv2.erode))
    contrast = crest - trough
    # the board's outline is not an edge
    edged = cv2.erode(inside.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    edged &= contrast > 0.4 * crest
    level = np.clip((modulation - trough) / np.maximum(contrast, 1e-6), 0, 1)
    area = np.count_nonzero(edged & (level > EDGE_BAND) & (level < 1 - EDGE_BAND))
    across, down = cv2.Sobel(level, cv2.CV_32F, 1, 0), cv2.Sobel(level, cv2.CV_32F, 0, 1)
    steep = np.maximum(np.hypot(across, down), 1e-6)
    high = level > 0.5
    # an edge of length L with its normal at (n_u, n_v) crosses L n_u rows and L n_v columns
    rows = (high[:, 1:] != high[:, :-1]) & edged[:, 1:] & edged[:, :-1]
    columns = (high[1:] != high[:-1]) & edged[1:] & edged[:-1]
    across, down = np.abs(across) / steep, np.abs(down) / steep
    length = float(across[:, 1:][rows].sum() + down[1:][columns].sum())
    if length < pitch:
        return SHARPEST_PX
    return float(np.clip(area / length / (2 * 0.6745), SHARPEST_PX, pitch / 8))


def _local_extreme(
    of: Callable[..., np.ndarray], modulation: np.ndarray, pitch: float
) -> np.ndarray:
    """(h, w): the largest or smallest modulation within a pitch, by ``cv2.dilate`` or
    ``cv2.erode``."""
    shrink = max(1, int(pitch // 12))
    small = cv2.blur(modulation, (shrink, shrink))[::shrink, ::shrink] if shrink > 1 else modulation
    reach = 2 * int(np.ceil(0.7 * pitch / shrink)) + 1
    extreme = of(small, np.ones((reach, reach), np.uint8))
    return cv2.resize(extreme, modulation.shape[::-1], interpolation=cv2.INTER_LINEAR)
