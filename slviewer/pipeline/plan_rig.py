"""Plan a rig: what a camera and a projector will measure at a distance, from their data sheets."""

import math
import re
import tomllib
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, Literal

import numpy as np

from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.evaluation.fit import evaluate_plane
from slviewer.evaluation.rig_plan import (
    DARK_LEVEL,
    PEAK_LEVEL,
    PlannedCamera,
    PlannedLight,
    PlannedProjector,
    RigPlan,
    predict_rig,
)
from slviewer.fringe.decode import decode
from slviewer.fringe.presets import complementary
from slviewer.fringe.sequence import one_axis
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
                raise InputError(f"{name} = {value:g} is impossible: give {low:g} to {high:g}")
        if not 1 <= self.baseline_mm <= 3 * self.distance:
            raise InputError(
                f"a baseline of {self.baseline_mm:g} mm is impossible at {self.distance:g} mm: give"
                f" 1 to {3 * self.distance:g} mm"
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
                f"camera {text}: give the angle of view as 70deg, or a known camera with --lens"
            )
        what = f"{text}, noise as 2 Mpx machine vision"
        entry = {key: value for key, value in entry.items() if key not in ("pixel_um", "lens_mm")}
        entry["view_deg"] = float(view[3])
    width, height = entry["size"]
    if "pixel_um" in entry:
        millimetres = entry["lens_mm"] if lens is None else lens
        if not 1 <= millimetres <= 1000:
            raise InputError(f"a lens of {millimetres:g} mm is impossible: give 1 to 1000 mm")
        focal, aperture = millimetres * 1000 / entry["pixel_um"], millimetres / entry["f_number"]
        what += f", lens {millimetres:g} mm at f/{entry['f_number']:g}"
    elif lens is not None:
        raise InputError(
            "the lens of this camera is given by its angle of view: omit --lens, or name another"
            " camera"
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
            f"a throw ratio of {ratio:g} is impossible: give distance over width, 0.1 to 20"
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
        raise InputError(f"no {kind} is called {text!r}: use {', '.join(known)}, or {notation}")
    return known[text], None


def _size(field: tuple[float, float]) -> str:
    """Return a width and height in mm as text."""
    return f"{field[0]:.0f} x {field[1]:.0f}"


def _sigma(millimetres: float) -> str:
    """Return a small length in µm or mm."""
    return f"{1000 * millimetres:.0f} µm" if millimetres < 0.9995 else f"{millimetres:.2f} mm"
