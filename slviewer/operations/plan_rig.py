"""Plan a rig: what a camera and a projector can measure, predicted from their data sheets before
they are bought or mounted.

Noise is propagated as decoding and the stereo model do it (`PhaseMap.sigma_phase`, `depth_per_px`);
what is assumed of devices is blur, noise and light. Errors of a calibration are not part of the
prediction.
"""

import math
import re
import tomllib
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.ndimage import label

from slviewer.calibration.next_pose import nominal_lens
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.evaluation.fit import evaluate_plane
from slviewer.fringe.decode import decode
from slviewer.fringe.presets import complementary
from slviewer.fringe.sequence import one_axis
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.triangulation import depth_per_px
from slviewer.geometry.vectors import lengths, unit_vectors
from slviewer.pipeline.operation import Callbacks, takes_settings
from slviewer.reconstruction.reconstruct import reconstruct_cloud
from slviewer.simulation.assets import asset
from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.lens import SimulatedLens
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import Illumination, Sensor, SimulatedRig

ANGLE_DEG = 22.0
"""Between both axes, where no baseline is given."""
_VIEW = re.compile(r"(\d+)x(\d+):(\d+(?:\.\d+)?)(mm|deg)?")
_MIN_COVERAGE = 0.8
_ANGLES_DEG = 12.0, 35.0
"""Angles beyond which a baseline is named as too short or too long."""
_CHECKED_PX = 500_000
"""So many camera pixels are simulated."""
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
    optics = _Optics(view, camera, projector, light, distance)
    is_lit = optics.is_lit(distance)
    coverage = float(is_lit.mean())
    if coverage < 0.02:
        raise InputError(
            f"at {distance:g} mm the projector illuminates {100 * coverage:.0f} % of what the"
            " camera sees",
            "choose another distance, lens or baseline",
        )
    away = float(np.hypot(distance, baseline))
    camera_px, projector_px = distance / camera.focal_px, away / projector.focal_px[0]
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


@dataclass(frozen=True)
class _Optics:
    """Light, blur and noise of a rig with few camera pixels (h, w), whose lenses are focused at
    ``focus`` mm."""

    rig: StereoRig
    camera: PlannedCamera
    projector: PlannedProjector
    light: PlannedLight
    focus: float

    def plane_points(self, z: float) -> Map:
        """Return the points (h, w, 3) mm where the camera's rays meet the plane at depth z."""
        rays = self.rig.camera.rays()
        return np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2) * z

    def is_lit(self, z: float) -> Map:
        """Return which camera pixels (h, w) see the projector's picture on the plane at depth
        z."""
        return self.rig.projector.contains(self.rig.project(self.plane_points(z)))

    def blur_px(self, z: float) -> Map:
        """Return the Gaussian sigma (h, w) of a fringe on the plane at depth z, in projector
        columns.

        A disc of defocus of diameter d has the sigma d / 4; a pixel of the projector or the camera
        counts as 1 / sqrt(12).
        """
        depths = self.rig.to_projector(self.plane_points(z))[..., 2]
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
        to_projector = -self.rig.R.T @ self.rig.t - self.plane_points(z)
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
    is_lit = optics.is_lit(z)
    if is_lit.mean() < _USABLE_COVERAGE * coverage:
        return False
    return bool(np.nanmedian(optics.predict_sigma(z, period, is_lit)[0]) <= _USABLE_SIGMA * sigma)


@dataclass(frozen=True)
class PlannedRig:
    """A prediction, and with a check ``measured``, the RMS in mm of a simulated plane in the middle
    of the view, and ``expected``, the prediction for that part."""

    camera: str
    projector: str
    plan: RigPlan
    light: PlannedLight
    measured: float | None = None
    expected: float | None = None

    def text(self) -> str:
        """Return the plan as lines of text with units and advice."""
        plan = self.plan
        lines = [
            f"camera     {self.camera}",
            f"projector  {self.projector}",
            (
                f"distance   {plan.distance:.0f} mm, baseline {plan.baseline:.0f} mm, angle"
                f" {plan.angle_deg:.0f} degrees"
            ),
            "",
            f"camera sees          {_size(plan.camera_field)} mm, {plan.camera_px:.3f} mm a pixel",
            (
                f"projector lights     {_size(plan.projector_field)} mm, {plan.projector_px:.3f} mm"
                " a column"
            ),
            f"coverage             {100 * plan.coverage:.0f} % of the camera's view",
            f"depth range          {plan.depth_range[0]:.0f} to {plan.depth_range[1]:.0f} mm",
            (
                f"fringe period        {plan.period_px:.0f} columns,"
                f" {plan.period_px * plan.projector_px:.1f} mm; modulation {plan.modulation:.0f}"
                " grey levels"
            ),
            (
                f"noise of a point     {_sigma(plan.sigma_middle)} in the middle,"
                f" {_sigma(plan.sigma_corner)} at the border ({self.light.steps} steps, one sigma,"
                " of depth)"
            ),
        ]
        if self.measured is not None and self.expected is not None:
            lines.append(
                f"simulated            {_sigma(self.measured)} RMS from a plane in the middle,"
                f" predicted {_sigma(self.expected)}"
            )
        return "\n".join([*lines, *(f"! {advice}" for advice in self.advice())])

    def advice(self) -> list[str]:
        """Return what to change, a sentence each."""
        plan, (least_deg, most_deg) = self.plan, _ANGLES_DEG
        ratio = plan.camera_px / plan.projector_px
        wide = any(np.less(plan.projector_field, plan.camera_field))
        change = (
            "a longer lens for the camera, or a greater throw" if wide else "a shorter baseline"
        )
        rules = (
            (
                plan.coverage < _MIN_COVERAGE,
                f"the projector lights {100 * plan.coverage:.0f} % of what the camera sees: choose"
                f" {change}",
            ),
            (
                ratio > 1.5,
                f"a camera pixel covers {ratio:.1f} projector columns: choose a longer lens or more"
                " camera pixels",
            ),
            (
                plan.angle_deg < least_deg,
                f"the angle of {plan.angle_deg:.0f} degrees is small: a longer baseline lowers the"
                " noise",
            ),
            (
                plan.angle_deg > most_deg,
                f"the angle of {plan.angle_deg:.0f} degrees is large: much of a part will be hidden"
                " from one",
            ),
            (
                plan.modulation < 20,
                f"a modulation of {plan.modulation:.0f} grey levels is weak: expose longer, or"
                " darken the room",
            ),
        )
        return [advice for applies, advice in rules if applies]


@dataclass(frozen=True)
class RigPlanSettings(Callbacks):
    """The devices of a rig, and how they are used.

    Args:
        camera: webcam-1080p, global-shutter-2mp, machine-vision-5mp, or its size and width of view:
            1920x1080:70deg.
        projector: pocket-720p, projector-1080p, lightcrafter4500, or its size and throw ratio:
            1920x1080:1.4.
        distance: Working distance from the camera, mm.
        baseline: Between camera and projector, mm; by default for an angle of 22 degrees.
        lens: Focal length of the camera's lens, mm, for a camera whose pixel size is known.
        steps: Phase steps.
        period: Fringe period in projector columns, by default the one with the least noise.
        reflectance: Of the object; 1 is white paper, to which the exposure is set.
        ambient: Room light as a share of the projector's.
        check: Measure a plane with this rig in the simulation, whose lenses and light are other
            code.

    Raises InputError for unknown devices and impossible figures.
    """

    camera: str
    projector: str
    distance: float
    _: KW_ONLY
    baseline: float | None = None
    lens: float | None = None
    steps: int = 8
    period: float | None = None
    reflectance: float = 1.0
    ambient: float = 0.06
    check: bool = False

    def __post_init__(self) -> None:
        for name, low, high in (
            ("distance", 10, 1e5), ("steps", 3, 64), ("reflectance", 0.01, 1), ("ambient", 0, 5),
            ("period", 3, 1000),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"{name} = {value:g} is impossible", f"give {low:g} to {high:g}")
        if not 1 <= self.baseline_mm <= 3 * self.distance:
            raise InputError(
                f"a baseline of {self.baseline_mm:g} mm is impossible at {self.distance:g} mm",
                f"give 1 to {3 * self.distance:g} mm",
            )

    @property
    def baseline_mm(self) -> float:
        """The baseline, or the one for the usual angle."""
        if self.baseline is not None:
            return self.baseline
        return math.tan(math.radians(ANGLE_DEG)) * self.distance


@takes_settings(RigPlanSettings)
def plan_rig(settings: RigPlanSettings) -> PlannedRig:
    """Predict field, depth range, fringe period and noise of a camera and a projector before they
    are mounted.

    The noise is that of a single point; errors of the calibration are not included.
    """
    camera, camera_text = _read_camera(settings.camera, settings.lens)
    projector, projector_text = _read_projector(settings.projector)
    light = PlannedLight(settings.steps, settings.reflectance, settings.ambient)
    plan = predict_rig(
        camera, projector, settings.distance, settings.baseline_mm, light, settings.period
    )
    planned = PlannedRig(camera_text, projector_text, plan, light)
    if not settings.check:
        return planned
    settings.progress(0.05, "simulating the rig before a plane")
    measured, expected = _simulate_plane(camera, projector, plan, light)
    return replace(planned, measured=measured, expected=expected)


def _simulate_plane(
    camera: PlannedCamera, projector: PlannedProjector, plan: RigPlan, light: PlannedLight
) -> tuple[float, float]:
    """Return the RMS in mm of a plane that the simulated rig captured, in the middle of the
    camera's view, with the true calibration; and the one predicted."""
    share = min(1.0, np.sqrt(_CHECKED_PX / np.prod(camera.size)))
    size = (int(camera.size[0] * share) // 2 * 2, int(camera.size[1] * share) // 2 * 2)
    cut = predict_rig(
        replace(camera, size=size), projector, plan.distance, plan.baseline, light, plan.period_px
    )
    rig = cut.rig
    camera_lens, projector_lens = (
        SimulatedLens(
            lens.size, (lens.K[0, 0], lens.K[1, 1]), (lens.K[0, 2], lens.K[1, 2]), (0.0,) * 5
        )
        for lens in (rig.camera, rig.projector)
    )
    focus = float(rig.to_projector(np.array([0.0, 0.0, plan.distance]))[2])
    blur = projector.blur_px, focus, projector.focal_px[0] * projector.aperture_mm / 4
    # the renderer exposes for what it sees
    peak = DARK_LEVEL + (PEAK_LEVEL - DARK_LEVEL) * light.reflectance
    sensor = Sensor(camera.blur_px, DARK_LEVEL, camera.read_variance, camera.shot_variance, peak)
    illumination = Illumination(light.ambient, projector.black, 1.0, 0.0, *blur)
    simulated = SimulatedRig(camera_lens, projector_lens, rig.R, rig.t, sensor, illumination)
    plate = blank_board(
        Pose(np.eye(3), np.array([0.0, 0.0, plan.distance])), (4 * plan.camera_field[0],) * 2
    )
    sequence = one_axis(complementary(projector.size, light.steps, plan.period_px), "x")
    phase = decode(sequence, Renderer(simulated, plate).capture(sequence), "x")
    cloud = reconstruct_cloud(StereoModel.from_rig(rig), {"x": phase}, "x")
    measured = evaluate_plane(cloud.points, np.isfinite(cloud.points[..., 2])).rms_mm
    return float(measured), cut.sigma_rms


def _read_camera(text: str, lens: float | None) -> tuple[PlannedCamera, str]:
    """Return a camera by its name, or by size and angle of view, and its description."""
    entry, view = _read_device(
        "camera", text, "global-shutter-2mp", "size and angle of view as in 1920x1080:70deg"
    )
    what = str(entry["what"])
    if view:
        if view[4] == "mm":
            raise InputError(
                f"camera {text}", "give the angle of view as 70deg, or a known camera with --lens"
            )
        what = f"{text}, noise as 2 Mpx machine vision"
        entry = {key: value for key, value in entry.items() if key not in ("pixel_um", "lens_mm")}
        entry["view_deg"] = float(view[3])
    width, height = entry["size"]
    if "pixel_um" in entry:
        millimetres = entry["lens_mm"] if lens is None else lens
        if not 1 <= millimetres <= 1000:
            raise InputError(f"a lens of {millimetres:g} mm is impossible", "give 1 to 1000 mm")
        focal, aperture = millimetres * 1000 / entry["pixel_um"], millimetres / entry["f_number"]
        what += f", lens {millimetres:g} mm at f/{entry['f_number']:g}"
    elif lens is not None:
        raise InputError(
            "the lens of this camera is given by its angle of view",
            "omit --lens, or name another camera",
        )
    else:
        focal = width / 2 / np.tan(np.radians(entry["view_deg"]) / 2)
        aperture = entry.get("aperture_mm", 3.0)
    noise = entry["blur_px"], entry["full_well"], entry["read_noise"]
    return PlannedCamera((width, height), focal, aperture, *noise), what


def _read_projector(text: str) -> tuple[PlannedProjector, str]:
    """Return a projector by its name, or by size and throw ratio, and its description."""
    entry, view = _read_device(
        "projector", text, "projector-1080p", "size and throw ratio as in 1920x1080:1.4"
    )
    ratio, what = entry["throw_ratio"], entry["what"]
    if view:
        ratio, what = float(view[3]), f"{text}, as a common projector"
    if not 0.1 <= ratio <= 20:
        raise InputError(
            f"a throw ratio of {ratio:g} is impossible", "give distance over width, 0.1 to 20"
        )
    width, height = entry["size"]
    focal = (width * ratio, width * ratio / entry.get("row_pitch", 1.0))
    optics = entry["offset"], entry["aperture_mm"], entry["blur_px"], entry["black"]
    return PlannedProjector((width, height), focal, *optics), what


def _read_device(
    kind: Literal["camera", "projector"], text: str, typical: str, notation: str
) -> tuple[dict[str, Any], re.Match[str] | None]:
    """Return the data of a device by its name; or, where ``text`` is its size and view, those of
    the ``typical`` one of that size, and the match of `_VIEW`. Raises InputError for others."""
    known = tomllib.loads(asset("planning/devices.toml").read_text(encoding="utf-8"))[kind]
    if view := _VIEW.fullmatch(text):
        return {**known[typical], "size": [int(view[1]), int(view[2])]}, view
    if text not in known:
        raise InputError(f"no {kind} is called {text!r}", f"use {', '.join(known)}, or {notation}")
    return known[text], None


def _size(field: tuple[float, float]) -> str:
    """Return a width and height in mm as text."""
    return f"{field[0]:.0f} x {field[1]:.0f}"


def _sigma(millimetres: float) -> str:
    """Return a small length in µm or mm."""
    return f"{1000 * millimetres:.0f} µm" if millimetres < 0.9995 else f"{millimetres:.2f} mm"
