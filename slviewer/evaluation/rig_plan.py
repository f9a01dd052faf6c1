"""What a camera and a projector can measure, predicted from their data sheets before they are
bought or mounted.

Noise is propagated as decoding and the stereo model do it (`PhaseMap.sigma_phase`, `depth_per_px`);
what is assumed of devices is blur, noise and light. Errors of a calibration are not part of the
prediction.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import label

from slviewer.calibration.next_pose import nominal_lens
from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.triangulation import depth_per_px
from slviewer.geometry.vectors import lengths, unit_vectors

PEAK_LEVEL, DARK_LEVEL, FULL_LEVEL = 215.0, 3.0, 255.0
"""Grey levels of a white surface, as the rig check sets the exposure; without light; and the
highest."""
_GRID = 64
"""Columns of camera pixels that are computed."""
_MIN_PERIOD_PX, _MIN_CAMERA_PX = 6.0, 6.0
"""Shortest fringe in projector columns, which grey levels still shape well, and in camera
pixels."""
_BRIGHT_QUANTILE = 0.995
"""The brightest half percent of what is illuminated decides the exposure."""
_DEPTHS = np.linspace(0.5, 2.0, 151)
"""Distances that are examined, as shares of the working distance."""
_USABLE_COVERAGE, _USABLE_SIGMA = 0.6, 2.0
"""Of the depth range: share of the view that the projector must illuminate, and noise over that at
the distance."""

Map = np.ndarray
"""(h, w): a value for each of a few camera pixels."""


@dataclass(frozen=True)
class PlannedCamera:
    """A camera: ``focal_px``; ``aperture_mm``, diameter of its pupil; ``blur_px``, Gaussian sigma
    in focus; ``full_well`` and ``read_noise`` in electrons."""

    size: tuple[int, int]
    focal_px: float
    aperture_mm: float
    blur_px: float
    full_well: float
    read_noise: float

    @property
    def shot_variance(self) -> float:
        """Variance of shot noise in grey levels squared for each grey level."""
        return FULL_LEVEL / self.full_well

    @property
    def read_variance(self) -> float:
        """Variance of read noise in grey levels squared, without rounding."""
        return (self.read_noise * FULL_LEVEL / self.full_well) ** 2


@dataclass(frozen=True)
class PlannedProjector:
    """A projector: ``focal_px`` of columns and of rows; ``offset``: its picture's middle above its
    axis, as a share of its height; ``aperture_mm``; ``blur_px``, Gaussian sigma in focus in
    columns; ``black``: light of black over white.
    """

    size: tuple[int, int]
    focal_px: tuple[float, float]
    offset: float
    aperture_mm: float
    blur_px: float
    black: float


@dataclass(frozen=True)
class RigPlan:
    """What a rig is predicted to measure at its working distance, lengths in mm.

    ``camera_field``, ``projector_field``: width and height of what each covers; ``camera_px``,
    ``projector_px``: size of a pixel (a column) on the object; ``coverage``: share of the camera's
    view that the projector illuminates; ``depth_range``: nearest and furthest distance at which it
    is usable. ``period_px``: recommended fringe period in projector columns; ``modulation``: its
    amplitude in grey levels. ``sigma_middle``, ``sigma_corner``: standard deviation of the depth of
    one point due to noise, in the middle and the median of the corners of what is covered;
    ``sigma_rms``: over all of it.
    """

    rig: StereoRig
    distance: float
    baseline: float
    angle_deg: float
    camera_field: tuple[float, float]
    projector_field: tuple[float, float]
    camera_px: float
    projector_px: float
    coverage: float
    depth_range: tuple[float, float]
    period_px: float
    modulation: float
    sigma_middle: float
    sigma_corner: float
    sigma_rms: float


@dataclass(frozen=True)
class PlannedLight:
    """``steps`` of the phase shift; ``reflectance`` of the object, 1 for white paper; ``ambient``
    room light over the projector's."""

    steps: int = 8
    reflectance: float = 1.0
    ambient: float = 0.06


def place(
    camera: PlannedCamera, projector: PlannedProjector, distance: float, baseline: float
) -> StereoRig:
    """Return the rig whose projector stands ``baseline`` mm to the right of the camera, its
    picture's middle on the camera's axis at ``distance`` mm."""
    columns, rows = projector.size
    fx, fy = projector.focal_px
    # rows count downwards: the axis meets the picture's plane below its middle
    lens = Lens.from_parameters(
        (fx, fy, (columns - 1) / 2, (rows - 1) / 2 + projector.offset * rows), projector.size
    )
    centre = np.array([baseline, 0.0, 0.0])
    aim = np.array([0.0, 0.0, distance]) - centre
    z = unit_vectors(aim)
    x = unit_vectors(np.cross([0.0, 1.0, 0.0], z))
    R = np.stack([x, np.cross(z, x), z])
    # so that the picture's middle, not the axis, is aimed
    tilt = np.arctan(projector.offset * rows / fy)
    R = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]) @ R
    return StereoRig(nominal_lens(camera.size, camera.focal_px), lens, R, -R @ centre)


def predict_rig(
    camera: PlannedCamera,
    projector: PlannedProjector,
    distance: float,
    baseline: float,
    light: PlannedLight,
    period_px: float | None = None,
) -> RigPlan:
    """Predict what a rig measures at a distance, mm.

    ``period_px``: of the fringes, by default the best.

    Raises InputError where the projector does not illuminate what the camera sees there.
    """
    rig = place(camera, projector, distance, baseline)
    view = replace(rig, camera=_thin(rig.camera))
    is_lit = _is_illuminated(view, distance)
    coverage = float(is_lit.mean())
    if coverage < 0.02:
        raise InputError(
            f"at {distance:g} mm the projector illuminates {100 * coverage:.0f} % of what the"
            " camera sees: choose another distance, lens or baseline"
        )
    away = float(np.hypot(distance, baseline))
    camera_px, projector_px = distance / camera.focal_px, away / projector.focal_px[0]
    optics = _Optics(view, camera, projector, light, distance)
    # the noise, period / modulation, is least at 2 pi blur: the modulation falls as
    # exp(-2 pi² blur² / period²)
    least_noise = 2 * np.pi * float(np.median(optics.blur_px(distance)[is_lit]))
    shortest = max(_MIN_PERIOD_PX, _MIN_CAMERA_PX * (camera_px / projector_px))
    period = period_px or float(np.ceil(max(least_noise, shortest)))
    sigmas, modulation = optics.predict_sigma(distance, period, is_lit)
    middle, corner = _middle_and_corner(sigmas)
    depths = distance * _DEPTHS
    is_usable = np.array([_is_usable(optics, z, period, coverage, middle) for z in depths])
    at = int(np.argmin(np.abs(depths - distance)))
    is_usable[at] = True
    runs = label(is_usable)[0]
    usable = depths[runs == runs[at]]
    columns, rows = projector.size
    return RigPlan(
        rig=rig,
        distance=distance,
        baseline=baseline,
        angle_deg=float(np.degrees(np.arctan2(baseline, distance))),
        camera_field=(camera.size[0] * camera_px, camera.size[1] * camera_px),
        projector_field=(columns * projector_px, rows * away / projector.focal_px[1]),
        camera_px=camera_px,
        projector_px=projector_px,
        coverage=coverage,
        depth_range=(float(usable[0]), float(usable[-1])),
        period_px=period,
        modulation=modulation,
        sigma_middle=middle,
        sigma_corner=corner,
        sigma_rms=float(np.sqrt(np.nanmean(sigmas**2))),
    )


def _thin(lens: Lens) -> Lens:
    """Return the lens with `_GRID` columns, which has the same view."""
    width, height = lens.size
    share = _GRID / width
    rows = max(2, round(height * share))
    focal_px = lens.K[0, 0] * share, lens.K[1, 1] * (rows / height)
    return Lens.from_parameters((*focal_px, (_GRID - 1) / 2, (rows - 1) / 2), (_GRID, rows))


def _plane_points(rig: StereoRig, z: float) -> Map:
    """Return the points (h, w, 3) mm where the camera's rays meet the plane at depth z."""
    rays = rig.camera.rays()
    return np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2) * z


def _is_illuminated(rig: StereoRig, z: float) -> Map:
    """Return which camera pixels (h, w) see the projector's picture on the plane at depth z."""
    return rig.projector.contains(rig.project(_plane_points(rig, z)))


@dataclass(frozen=True)
class _Optics:
    """Light, blur and noise of a rig with few camera pixels (h, w), whose lenses are focused at
    ``focus`` mm."""

    rig: StereoRig
    camera: PlannedCamera
    projector: PlannedProjector
    light: PlannedLight
    focus: float

    def blur_px(self, z: float) -> Map:
        """Return the Gaussian sigma (h, w) of a fringe on the plane at depth z, in projector
        columns.

        A disc of defocus of diameter d has the sigma d / 4; a pixel of the projector or the camera
        counts as 1 / sqrt(12).
        """
        depths = self.rig.to_projector(_plane_points(self.rig, z))[..., 2]
        focused = self.rig.to_projector(np.array([0.0, 0.0, self.focus]))[2]
        camera, projector = self.camera, self.projector
        of_projector = (
            projector.focal_px[0] * projector.aperture_mm / 4 * (1 / depths - 1 / focused)
        )
        of_camera = camera.focal_px * camera.aperture_mm / 4 * (1 / z - 1 / self.focus)
        columns_per_px = (z / camera.focal_px) / (depths / projector.focal_px[0])
        camera_sigma = np.sqrt(camera.blur_px**2 + of_camera**2 + 1 / 12) * columns_per_px
        return np.sqrt(projector.blur_px**2 + of_projector**2 + 1 / 12 + camera_sigma**2)

    def light_on(self, z: float, is_lit: Map) -> tuple[Map, Map]:
        """Return the projector's light (h, w) that returns from a white plane at depth z, and the
        room's, as shares of the brightest white: cosine of the incidence, square of the distance,
        cos^4 of the camera's lens.
        """
        points = _plane_points(self.rig, z)
        centre = -self.rig.R.T @ self.rig.t
        to_projector = centre - points
        away = lengths(to_projector)
        even = (1 + (self.rig.camera.rays() ** 2).sum(axis=2)) ** -2
        lit = -to_projector[..., 2] / away * even * (z / away) ** 2
        brightest = np.quantile((lit + self.light.ambient * even)[is_lit], _BRIGHT_QUANTILE)
        return lit / brightest, self.light.ambient * even / brightest

    def predict_sigma(self, z: float, period: float, is_lit: Map) -> tuple[Map, float]:
        """Return the standard deviation (h, w) mm of depth on the plane at depth z, NaN where not
        ``is_lit`` (h, w), and the median modulation in grey levels. The exposure is chosen for a
        white surface at that depth.
        """
        lit, room = (
            part * (PEAK_LEVEL - DARK_LEVEL) * self.light.reflectance
            for part in self.light_on(z, is_lit)
        )
        black, camera = self.projector.black, self.camera
        modulation = lit * (1 - black) / 2 * np.exp(-2 * (np.pi * self.blur_px(z) / period) ** 2)
        variance = (
            camera.read_variance + camera.shot_variance * (lit * (1 + black) / 2 + room) + 1 / 12
        )
        sigma_phase = np.sqrt(2 / self.light.steps * variance) / modulation
        sigmas = (
            depth_per_px(self.rig, "x", np.full(is_lit.shape, float(z)))
            * sigma_phase
            * period
            / (2 * np.pi)
        )
        return np.where(is_lit, sigmas, np.nan), float(np.median(modulation[is_lit]))


def _middle_and_corner(sigmas: Map) -> tuple[float, float]:
    """Return the median of a map (h, w) in its middle, and that of the outermost tenth of what is
    not NaN."""
    rows, columns = np.nonzero(np.isfinite(sigmas))
    values = sigmas[rows, columns]
    height, width = sigmas.shape
    radius = np.hypot((rows - (height - 1) / 2) / height, (columns - (width - 1) / 2) / width)
    near, far = (radius <= np.quantile(radius, 0.1)), (radius >= np.quantile(radius, 0.9))
    return float(np.median(values[near])), float(np.median(values[far]))


def _is_usable(optics: _Optics, z: float, period: float, coverage: float, sigma: float) -> bool:
    """Whether at depth z enough is illuminated, and the noise is not far above `sigma`, that of the
    distance."""
    is_lit = _is_illuminated(optics.rig, z)
    if is_lit.mean() < _USABLE_COVERAGE * coverage:
        return False
    return bool(np.nanmedian(optics.predict_sigma(z, period, is_lit)[0]) <= _USABLE_SIGMA * sigma)
