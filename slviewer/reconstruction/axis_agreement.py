"""Whether a capture belongs to a calibration: sizes, and what its second axis says of the first.

A camera ray and the projector ray of both measured coordinates must meet. By how much they miss
each other, as the distance of the projector point from its epipolar line, needs no depth: it
exposes exchanged axes, an inverted transform, another rig, and a rig that was bumped, whichever
axis depth is taken from.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMaps
from slviewer.fringe.sequence import Size
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import Floats, Floats32
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.triangulation import triangulate_pixels
from slviewer.geometry.vectors import lengths, subsample
from slviewer.reconstruction.cloud import Misfit, number_tiles
from slviewer.reconstruction.rig_change import bound_change, differentiate

SAMPLE = 20_000
"""Pixels compared; more do not change a median."""
LEAST_PIXELS = 200
"""Fewer say nothing about a rig."""
RAISED_RATIO = 3.0
"""Times the predicted misfit, beyond which noise and the calibration's own residuals do not explain
a median of thousands of pixels: the predicted sigma is then raised."""
REFUSED_RATIO = 6.0
REFUSED_PX = 2.0
"""A capture that misses its calibration by more than both does not belong to it: 2 px is also the
reprojection error at which a calibration itself is rejected."""
TILES = (12, 16)
"""Rows and columns of tiles in each of which the axes are compared: a second light path spoils a
part of an image."""
LEAST_IN_TILE = 20
"""Pixels, below which a tile says nothing."""
LEAST_IN_FRONT = 0.8
"""Share of the points that lie before both devices: all of them, by the right calibration, but for
decoding errors."""
LEAST_MEASURED = (0.5, 0.8)
"""Share of the decoded pixels of one axis whose point the projector could have lit: below the first
the capture is refused, below the second there is a warning."""
EXPLAINED = 0.25
"""A hypothesis explains a misfit that it brings down to this share, or below the limit of
refusal."""
DEPTHS = (0.7, 1.4)
"""Of the nearest and the farthest calibrated depth: beyond, no calibration of ours measures (as
``splined.model``)."""
_FLIPS = (
    (
        (True, False),
        "the x axis is reversed; number the projector's columns from the other end",
        "mirrored",
    ),
    (
        (False, True),
        "the y axis is reversed; number the projector's rows from the other end",
        "upside down and mirrored",
    ),
    (
        (True, True),
        (
            "the projector's image is turned by 180 degrees; number columns and rows from the other"
            " end, or switch off its ceiling mode"
        ),
        "turned by 180 degrees",
    ),
)
"""Coordinates (x, y) that run backwards, and what that says of the projector's and of the camera's
image."""
Direction = Literal["as stated", "inverted", "transposed", "transposed and inverted"]
REMEDIES: Mapping[Direction, str] = {
    "inverted": "R and T are inverted: they map the projector to the camera; import their inverse",
    "transposed": (
        "R is transposed, as MATLAB writes it for row vectors; import its transpose, and T as it is"
    ),
    "transposed and inverted": (
        "R is transposed, and R and T are inverted; import R as it is, and -R^T T for T"
    ),
}
"""What a file's R and T may be instead of the transform from camera to projector."""
OTHER_CALIBRATION = (
    "the calibration does not belong to this capture; import the projector's true size and axes, or"
    " calibrate this rig"
)
OTHER_RIG = (
    "the calibration is of another rig, or the rig was moved since: calibrate the rig as it stands"
)
LEAST_WITHIN = 0.5
"""Share of the points between these depths, below which the depths themselves are doubtful."""


class Calibration(Protocol):
    """Camera and projector rays of a calibration. ``rig``: its pinholes and their arrangement."""

    def undistort_pairs(self, pixels: Floats, projector: Floats) -> tuple[Floats, Floats]:
        """Undistorted normalised coordinates (n, 2) of camera ``pixels`` (n, 2) and of
        ``projector`` pixels (n, 2); NaN where not calibrated."""

    @property
    def pinholes(self) -> StereoRig:
        """Both lenses by their best pinhole and Brown models, and their arrangement."""

    @property
    def residual_px(self) -> float:
        """How far, in projector px, its own target poses miss their epipolar lines beyond noise (1
        sigma); 0 where it is not known."""


@dataclass(frozen=True)
class AxisAgreement:
    """How far projector points lie from the epipolar lines of their camera pixels, px of the
    projector.

    ``misfit_px``: 1.4826 times the median distance; ``predicted_px``: what noise and the
    calibration's residuals make of it (1 sigma). ``in_front``: share of the points that lie before
    both devices; ``depths_mm``: those of these points. ``known`` (n,) bool: the pixels that are
    calibrated, ``distance`` and ``variance`` (m,): the signed distance of each of these, and its
    variance by noise.
    """

    misfit_px: float
    predicted_px: float
    in_front: float
    depths_mm: Floats
    known: np.ndarray
    distance: Floats
    variance: Floats

    @property
    def ratio(self) -> float:
        """Ratio of the measured misfit to the predicted one."""
        return self.misfit_px / self.predicted_px

    @property
    def limit_px(self) -> float:
        """The misfit beyond which the capture cannot belong to the calibration."""
        return max(REFUSED_PX, REFUSED_RATIO * self.predicted_px)

    @property
    def is_refused(self) -> bool:
        """Whether the capture cannot belong to the calibration."""
        return self.misfit_px > self.limit_px or self.in_front < LEAST_IN_FRONT


@dataclass(frozen=True)
class CaptureCheck:
    """Result of a check. ``misfit``: what the axes contradict beyond what is predicted; None where
    they do so nowhere."""

    warnings: tuple[str, ...] = ()
    agreement: AxisAgreement | None = None
    misfit: Misfit | None = None


def check_sizes(name: str, camera: Size, projector: Size | None, calibrated: StereoRig) -> None:
    """Raise InputError where a capture's camera or projector has not the size that was
    calibrated."""
    for what, size, wanted, remedy in (
        (
            "camera image",
            camera,
            calibrated.camera.size,
            "use captures of the calibrated camera, at the same resolution and without cropping, or"
            " calibrate at this one",
        ),
        (
            "projector",
            projector,
            calibrated.projector.size,
            "import the capture with the projector's true size, or calibrate with patterns of the"
            " same size",
        ),
    ):
        if size is not None and tuple(size) != wanted:
            raise InputError(
                f"{name}: the capture was taken with a {what} of {_size(size)} px, the calibration"
                f" was made with {_size(wanted)}{_scale(size, wanted)}",
                remedy,
            )


def check_phases(
    name: str,
    phases: PhaseMaps,
    calibration: Calibration,
    depth_range: tuple[float, float] | None = None,
    accept: bool = False,
) -> CaptureCheck:
    """Check whether the decoded axes of a capture agree with each other by a calibration.

    ``depth_range`` mm: the calibrated depths. With both axes their misfit decides, with one the
    share of its pixels that the projector could have lit. Raises InputError, with the likely
    reason, where the capture cannot belong to the calibration, unless that is ``accept``-ed: then
    it is a warning.
    """
    warnings: list[str] = []

    def refuse(reason: str) -> None:
        """Raise InputError with the reason, or append it to the warnings where contradictions are
        accepted."""
        if not accept:
            raise InputError(reason)
        warnings.append(reason)

    rig = calibration.pinholes
    if len(phases) < 2:
        depths, share = measure_single_axis(phases, rig)
        if share < LEAST_MEASURED[0]:
            refuse(
                f"{name}: {100 * (1 - share):.0f} % of the decoded pixels meet no point that the"
                " calibrated projector could light:"
                f" {possible_directions(phases, rig) or OTHER_CALIBRATION}"
            )
        elif share < LEAST_MEASURED[1]:
            warnings.append(
                f"{name}: {100 * (1 - share):.0f} % of the decoded pixels meet no point that the"
                " calibrated projector could light: see that the calibration belongs to this rig"
            )
        return CaptureCheck((*warnings, *_depth_warning(name, depths, depth_range)))
    pixels, measured, sigma = sample_axes(phases)
    agreement = measure_axis_agreement(calibration, pixels, measured, sigma)
    if agreement is None:
        return CaptureCheck()
    if agreement.is_refused:
        refuse(
            f"{name}: {_describe_contradiction(agreement)}:"
            f" {likely_reason(agreement, rig, pixels, measured)}"
        )
    at = pixels[agreement.known], measured[agreement.known]
    excess, misfit = _map_misfit(calibration, at[0], agreement), None
    if agreement.ratio > RAISED_RATIO:
        everywhere = np.sqrt(agreement.misfit_px**2 - agreement.predicted_px**2)
        excess = np.maximum(0.0 if excess is None else excess, np.full(TILES, everywhere, "f4"))
        misfit = Misfit(excess, _bound_change(calibration, *at, agreement))
        if not agreement.is_refused:
            warnings.append(
                f"{name}: the x and y patterns disagree by {agreement.misfit_px:.2f} px with this"
                f" calibration, and noise explains {agreement.predicted_px:.2f} px: the uncertainty"
                f" of the points was raised by a factor of {agreement.ratio:.1f}; focus, zoom or a"
                " device may have moved since the calibration (run `slviewer check`), or the frames"
                " are disturbed"
            )
    elif excess is not None:
        misfit = Misfit(excess)
        warnings.append(
            f"{name}: in {100 * np.mean(excess > 0):.0f} % of the image the x and y patterns"
            f" disagree by up to {excess.max():.2f} px (elsewhere {agreement.misfit_px:.2f} px):"
            " the uncertainty of the points there was raised; look for reflections of the"
            " projector's light (a glossy table or wall, a shiny part, a deep corner), or for"
            " something that moved"
        )
    warnings += _depth_warning(name, agreement.depths_mm, depth_range)
    return CaptureCheck(tuple(warnings), agreement, misfit)


def _bound_change(
    calibration: Calibration, pixels: Floats, measured: Floats, agreement: AxisAgreement
) -> Floats:
    """Return what the misfit of the axes at calibrated camera ``pixels`` (m, 2) says of changes of
    the rig, as `bound_change`; ``measured`` (m, 2): their projector coordinates."""
    rig = calibration.pinholes
    changes = differentiate(
        rig,
        lambda other: epipolar_distance(
            other, other.camera.undistort(pixels), other.projector.undistort(measured)
        )[0],
    )
    values = np.column_stack([agreement.distance, agreement.variance, changes])
    values = np.column_stack([np.ones(len(values)), np.nan_to_num(values)])
    tile = number_tiles(pixels, rig.camera.size, TILES)
    sums = np.stack([np.bincount(tile, column) for column in values.T], axis=1)
    sums = sums[sums[:, 0] >= LEAST_IN_TILE]
    count = sums[:, :1]
    _, means, noises, effects = np.split(sums / count, [1, 2, 3], axis=1)
    sigma_px = np.sqrt(noises / count + calibration.residual_px**2)
    return bound_change(effects, means[:, 0], sigma_px[:, 0])


def _map_misfit(
    calibration: Calibration, pixels: Floats, agreement: AxisAgreement
) -> Floats32 | None:
    """Return the misfit of the axes in px of the projector for each of `TILES` of the image, beyond
    what is predicted there; 0 where noise and the calibration's residuals explain it, None where
    they do so everywhere.

    ``pixels`` (m, 2): those that are calibrated. What disturbs one axis disturbs the other about as
    much.
    """
    tile = number_tiles(pixels, calibration.pinholes.camera.size, TILES)
    excess = np.zeros(TILES, np.float32)
    for number in np.unique(tile):
        is_inside = tile == number
        predicted = float(np.median(agreement.variance[is_inside])) + calibration.residual_px**2
        misfit = robust_sigma(agreement.distance[is_inside], about=0.0) ** 2
        enough = np.count_nonzero(is_inside) >= LEAST_IN_TILE
        if enough and misfit > RAISED_RATIO**2 * predicted:
            excess.flat[number] = np.sqrt(misfit - predicted)
    return excess if excess.any() else None


def list_directions(rig: StereoRig) -> dict[Direction, StereoRig]:
    """Return what the rig is if R and T are as stated, inverted, transposed, or both."""
    R, t = rig.R, rig.t
    transforms: dict[Direction, tuple[Floats, Floats]] = {
        "as stated": (R, t),
        "inverted": (R.T, -R.T @ t),
        "transposed": (R.T, t),
        "transposed and inverted": (R, -R.T @ t),
    }
    return {
        direction: StereoRig(rig.camera, rig.projector, *transform)
        for direction, transform in transforms.items()
    }


def measure_axis_agreement(
    calibration: Calibration, pixels: Floats, measured: Floats, sigma: Floats
) -> AxisAgreement | None:
    """How far camera ``pixels`` (n, 2) and the projector coordinates ``measured`` there (n, 2) px,
    of noise ``sigma`` (n, 2) px, miss each other; None where fewer than 200 are calibrated."""
    rig = calibration.pinholes
    agreement = compute_agreement(
        rig, *calibration.undistort_pairs(pixels, measured), sigma, calibration.residual_px
    )
    return agreement if len(agreement.distance) >= LEAST_PIXELS else None


def epipolar_distance(rig: StereoRig, camera: Floats, projector: Floats) -> tuple[Floats, Floats]:
    """Return signed distances (n,) px of projector points from the epipolar lines of their camera
    rays, and the lines' unit normals (n, 2). ``camera``, ``projector`` (n, 2): undistorted
    normalised coordinates."""
    line = np.cross(rig.t, _rays(camera) @ rig.R.T)
    normal = line[:, :2] / np.diag(rig.projector.K)[:2]
    length = lengths(normal)
    with np.errstate(invalid="ignore", divide="ignore"):
        offset = np.einsum("ni,ni->n", line, _rays(projector))
        return offset / length, normal / length[:, None]


def ray_depths(rig: StereoRig, camera: Floats, projector: Floats) -> Floats:
    """(n, 2) mm: depths before camera and projector at which the rays of undistorted normalised
    coordinates (n, 2) come nearest to each other; negative behind a device."""
    a, b = _rays(camera) @ rig.R.T, _rays(projector)
    aa, bb, ab = (np.einsum("ni,ni->n", p, q) for p, q in ((a, a), (b, b), (a, b)))
    at, bt = a @ rig.t, b @ rig.t
    with np.errstate(invalid="ignore", divide="ignore"):
        determinant = aa * bb - ab * ab
        return np.column_stack(
            [(ab * bt - bb * at) / determinant, (aa * bt - ab * at) / determinant]
        )


def _rays(normalised: Floats) -> Floats:
    """Return the rays (n, 3) of undistorted normalised coordinates (n, 2)."""
    return np.column_stack([normalised, np.ones(len(normalised))])


def compute_agreement(
    rig: StereoRig, camera: Floats, projector: Floats, sigma: Floats, residual_px: float
) -> AxisAgreement:
    """Return the axis agreement of undistorted coordinates (n, 2) with noise ``sigma`` (n, 2)
    px."""
    distance, normal = epipolar_distance(rig, camera, projector)
    known = np.isfinite(distance)
    distance = distance[known]
    variance = np.sum((normal[known] * sigma[known]) ** 2, axis=1)
    if not known.any():
        return AxisAgreement(np.inf, 1.0, 0.0, np.empty(0), known, distance, variance)
    predicted = float(np.sqrt(np.median(variance) + residual_px**2))
    depths = ray_depths(rig, camera[known], projector[known])
    front = (depths > 0).all(axis=1)
    return AxisAgreement(
        misfit_px=robust_sigma(distance, about=0.0),
        predicted_px=max(predicted, 1e-6),
        in_front=float(front.mean()),
        depths_mm=depths[front, 0],
        known=known,
        distance=distance,
        variance=variance,
    )


def _sample_pixels(mask: np.ndarray) -> np.ndarray:
    """Return rows and columns (2, n) of at most `SAMPLE` pixels of a mask (h, w)."""
    return subsample(np.argwhere(mask), SAMPLE).T


def sample_axes(phases: PhaseMaps) -> tuple[Floats, Floats, Floats]:
    """Camera pixels (n, 2) that both axes decoded, the coordinates (n, 2) px there, and their
    errors (n, 2) px by noise and by blur at edges."""
    v, u = _sample_pixels(np.logical_and.reduce([phase.mask for phase in phases.values()]))
    both = phases["x"], phases["y"]
    measured = np.column_stack([phase.coordinate[v, u] for phase in both]).astype(float)
    errors = [np.hypot(phase.sigma_px[v, u], phase.edge_error_px[v, u]) for phase in both]
    return np.column_stack([u, v]).astype(float), measured, np.column_stack(errors).astype(float)


def measure_single_axis(phases: PhaseMaps, rig: StereoRig) -> tuple[Floats, float]:
    """Depths (n,) mm of one axis' points, and the share of the decoded pixels that have one."""
    ((axis, phase),) = phases.items()
    v, u = _sample_pixels(phase.mask)
    if len(v) < LEAST_PIXELS:
        return np.empty(0), 1.0
    points = triangulate_pixels(
        rig, np.column_stack([u, v]).astype(float), phase.coordinate[v, u], axis
    )
    known = np.isfinite(points[:, 2])
    return points[known, 2], float(known.mean())


def possible_directions(phases: PhaseMaps, rig: StereoRig) -> str:
    """Return in words what R and T may be instead: the directions that put the points of one axis
    before both devices and into the projector's field; empty without any."""
    directions = list_directions(rig)
    shares = {each: measure_single_axis(phases, directions[each])[1] for each in REMEDIES}
    return "; or ".join(REMEDIES[each] for each, s in shares.items() if s >= LEAST_MEASURED[1])


def _depth_warning(
    name: str, depths: Floats, depth_range: tuple[float, float] | None
) -> tuple[str, ...]:
    """Return a warning, in a tuple, where many ``depths`` (n,) mm are outside the range of the
    target poses."""
    if depth_range is None or len(depths) < LEAST_PIXELS:
        return ()
    near, far = depth_range
    outside = float(np.mean((depths < DEPTHS[0] * near) | (depths > DEPTHS[1] * far)))
    if outside <= 1 - LEAST_WITHIN:
        return ()
    return (
        (
            f"{name}: {100 * outside:.0f} % of the points lie nearer than {DEPTHS[0] * near:.0f} mm"
            f" or farther than {DEPTHS[1] * far:.0f} mm (median {np.median(depths):.0f} mm), and"
            f" the target poses lay at {near:.0f}-{far:.0f} mm: see that the calibration belongs to"
            " this capture; it says little at such depths"
        ),
    )


def _describe_contradiction(agreement: AxisAgreement) -> str:
    """Describe how the capture contradicts the calibration: epipolar misfit or negative depths."""
    if agreement.misfit_px > agreement.limit_px:
        return (
            f"the x and y patterns disagree by {agreement.misfit_px:.1f} px with this calibration,"
            f" and noise explains {agreement.predicted_px:.2f} px"
        )
    share = f"{100 * (1 - agreement.in_front):.0f} %"
    return f"by this calibration {share} of the points lie behind the camera or the projector"


def likely_reason(
    agreement: AxisAgreement, rig: StereoRig, pixels: Floats, measured: Floats
) -> str:
    """Return in words the hypothesis that explains the frames best."""
    best, reason = np.inf, ""
    for words, other, at, coordinates in _hypotheses(rig, pixels, measured):
        tried = compute_agreement(
            other,
            other.camera.undistort(at),
            other.projector.undistort(coordinates),
            np.zeros_like(at),
            0.0,
        )
        enough = (
            tried.known.sum() > 0.5 * agreement.known.sum() and tried.in_front >= LEAST_IN_FRONT
        )
        if enough and tried.misfit_px < best:
            best, reason = tried.misfit_px, words
    explained = agreement.limit_px
    if agreement.misfit_px > explained:
        explained = max(explained, EXPLAINED * agreement.misfit_px)
    if best < explained:
        return f"{reason} (then they disagree by {best:.1f} px)"
    return OTHER_RIG


def _hypotheses(
    rig: StereoRig, pixels: Floats, measured: Floats
) -> Iterator[tuple[str, StereoRig, Floats, Floats]]:
    """Yield each hypothesis of what is wrong, in words, with rig, pixels and coordinates corrected
    accordingly."""
    size, image = np.array(rig.projector.size), np.array(rig.camera.size)
    exchanged = "x and y are exchanged; exchange them in the description of the frames"
    yield exchanged, rig, pixels, measured[:, ::-1]
    for flip, of_projector, of_camera in _FLIPS:
        yield of_projector, rig, pixels, np.where(flip, size - 1 - measured, measured)
        reason = f"the camera's image is {of_camera}; record it as for the calibration"
        yield reason, rig, np.where(flip, image - 1 - pixels, pixels), measured
    directions = list_directions(rig)
    for direction, remedy in REMEDIES.items():
        yield remedy, directions[direction], pixels, measured
    camera, projector = (
        Lens(other.K, other.D, own.size)
        for own, other in ((rig.camera, rig.projector), (rig.projector, rig.camera))
    )
    reason = "the matrices of camera and projector are exchanged; import them the other way round"
    yield reason, StereoRig(camera, projector, rig.R, rig.t), pixels, measured
    inverse = directions["inverted"]
    reason = (
        "camera and projector are exchanged, as device 1 and 2 of the file; import the matrices the"
        " other way round, and the inverse of R and T"
    )
    yield reason, StereoRig(camera, projector, inverse.R, inverse.t), pixels, measured
    for factor, times, cure in ((2.0, "twice", "halve"), (0.5, "half", "double")):
        repair = f"{cure} fx, fy, cx and cy"
        reason = f"the camera's matrix is at {times} the pixel scale of the images: {repair}"
        yield reason, rig, (pixels + 0.5) * factor - 0.5, measured
        fewer = "half" if factor > 1 else "twice"
        for factors, which in (
            ((factor, factor), f"{fewer} as many columns and {fewer} as many rows"),
            ((factor, 1), f"{fewer} as many columns"),
            ((1, factor), f"{fewer} as many rows"),
        ):
            matrix = f", or correct its matrix: {repair}" if factors[0] == factors[1] else ""
            reason = (
                f"the patterns were described with {which} as the calibrated projector has; give"
                f" the projector's size and the fringe period as in the calibration{matrix}"
            )
            yield reason, rig, pixels, (measured + 0.5) * factors - 0.5


def _size(size: Size) -> str:
    """Format a size (width, height) px as "WxH"."""
    return f"{size[0]}x{size[1]}"


def _scale(size: Size, calibrated: Size) -> str:
    """Describe the ratio of two sizes where it is a quarter, half, twice or four times; empty
    otherwise."""
    words = {0.5: "half", 2.0: "twice", 0.25: "a quarter of", 4.0: "four times"}
    ratio = size[0] / calibrated[0]
    if ratio in words and size[1] == ratio * calibrated[1]:
        return f" (the capture's is {words[ratio]} the calibrated size)"
    return ""
