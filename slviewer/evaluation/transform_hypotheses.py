"""Whether R and T of a calibration made elsewhere have the direction and the unit that they are
taken to have: each that programs write is tried on what a capture shows.

Both axes of a capture determine the direction, by their epipolar lines, and nothing of the unit. A
board stands where the camera sees it, at the scale of its pitch, and a sphere has its radius: they
determine both. One axis at most excludes directions, by points behind a device or outside of its
field.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec
import numpy as np

from slviewer.errors import InputError
from slviewer.evaluation.fit import evaluate_spheres, finite_or_none
from slviewer.fringe.phase import PhaseMap, PhaseMaps
from slviewer.geometry.rig import LARGEST_BASELINE_MM, StereoRig
from slviewer.geometry.rigid import Floats
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.triangulation import points_from_depth, triangulate
from slviewer.geometry.vectors import lengths
from slviewer.reconstruction.axis_agreement import (
    EXPLAINED,
    LEAST_IN_FRONT,
    LEAST_MEASURED,
    LEAST_PIXELS,
    OTHER_CALIBRATION,
    OTHER_RIG,
    REFUSED_PX,
    REMEDIES,
    Direction,
    compute_agreement,
    likely_reason,
    list_directions,
    measure_single_axis,
    possible_directions,
    ray_depths,
    sample_axes,
)
from slviewer.records.calibration import Answer, Compared, TransformCheck

UNITS_MM = {"mm": 1.0, "cm": 10.0, "inch": 25.4, "m": 1000.0}
UNIT_TOLERANCE = 0.03
"""Share by which a length may differ from the known one: stated focal lengths are often wrong by 1
%."""
DISTINCT = 0.5
"""Share of every other direction's misfit, up to which a direction is determined."""
EQUAL_PX = 0.5
"""A direction that moves the projected points by less, as where R is nearly 1, is the same."""
FORM = 0.01
"""RMS deviation from a sphere, of its radius, up to which the points are one."""
SCALES = np.geomspace(3e-4, 3e3, 71)
"""Lengths of T, of the stated one, among which the best is refined."""


@dataclass(frozen=True)
class Fit:
    """How well a direction explains a capture: its ``misfit`` in px or mm, inf where points lie
    behind a device, and the ``limit`` up to which it does. ``scale``: of the length that T should
    have to the stated one, None where that is not measured."""

    misfit: float
    limit: float
    scale: float | None = None

    @property
    def unit(self) -> str:
        """The unit that T is in, "mm" where the scale is not measured, "" where none fits."""
        if self.scale is None:
            return "mm"
        near = (u for u, mm in UNITS_MM.items() if abs(self.scale / mm - 1) <= UNIT_TOLERANCE)
        return next(near, "")

    @property
    def is_possible(self) -> bool:
        """Whether the direction explains the capture, with T in one of the units."""
        return self.misfit <= self.limit and bool(self.unit)


Fits = Mapping[Direction, Fit]


def check_by_axes(name: str, rig: StereoRig, phases: PhaseMaps) -> TransformCheck:
    """Check R and T by a capture with both axes: the misfit is the distance from the epipolar
    lines, px. Raises InputError where too few pixels are decoded."""
    pixels, measured, sigma = sample_axes(phases)
    if len(pixels) < LEAST_PIXELS:
        raise InputError(f"{name}: {len(pixels)} pixels decode along both axes", "illuminate more")
    camera, projector = rig.camera.undistort(pixels), rig.projector.undistort(measured)
    depths = np.nan_to_num(ray_depths(rig, camera, projector)[:, 0])
    points = depths[:, None] * np.column_stack([camera, np.ones(len(camera))])
    tried = {
        direction: compute_agreement(other, camera, projector, sigma, 0.0)
        for direction, other in _list_distinct(rig, points).items()
    }
    fits: dict[Direction, Fit] = {
        direction: Fit(each.misfit_px if each.in_front >= LEAST_IN_FRONT else np.inf, each.limit_px)
        for direction, each in tried.items()
    }
    check = _make_check(name, "two axes", fits, float(np.median(depths)))
    if check.answer == "disagrees" and check.remedy == OTHER_RIG:
        remedy = likely_reason(tried["as stated"], rig, pixels, measured)
        return msgspec.structs.replace(check, remedy=remedy)
    return check


def check_by_board(name: str, rig: StereoRig, points: Floats, measured: Floats) -> TransformCheck:
    """Check R and T, and the length of T, by a board's features (n, 3) mm in the camera's frame and
    their projector coordinates (n, 2) px, a column of NaN for an axis without patterns. The misfit
    is the distance from the projected features, px."""
    from scipy.optimize import minimize_scalar  # half a second that few checks need

    known, fits = np.isfinite(measured), dict[Direction, Fit]()
    for direction, other in _list_distinct(rig, points).items():

        def misfit(log_scale: float, other: StereoRig = other) -> float:
            """Return the misfit with T longer by a factor, given as its logarithm."""
            moved = StereoRig(
                other.camera, other.projector, other.R, np.exp(log_scale) * other.t
            ).project(points)
            errors = np.nan_to_num((moved - measured)[known], nan=np.inf)
            return robust_sigma(errors, 0.0)

        tried = np.log(SCALES[SCALES * other.baseline_mm < LARGEST_BASELINE_MM])
        best = int(np.argmin([misfit(each) for each in tried]))
        ends = tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]
        found = minimize_scalar(misfit, bounds=ends, method="bounded", options={"xatol": 1e-5})
        fits[direction] = Fit(float(found.fun), REFUSED_PX, float(np.exp(found.x)))
    return _make_check(name, "board", fits, float(np.median(points[:, 2])))


def check_by_sphere(name: str, rig: StereoRig, phase: PhaseMap, radius_mm: float) -> TransformCheck:
    """Check R and T, with T in each unit, by a sphere of known radius. The misfit is the RMS
    deviation from a sphere, mm, inf where none of about that size is detected. Raises InputError
    where no direction shows one."""
    fits = dict[Direction, Fit]()
    for direction, other in list_directions(rig).items():
        tried = [Fit(np.inf, FORM * radius_mm)]
        for mm in UNITS_MM.values():
            scaled = StereoRig(rig.camera, rig.projector, other.R, mm * other.t)
            depth = triangulate(scaled, phase.coordinate, phase.axis)
            points = points_from_depth(rig.camera.rays(), depth)
            try:
                (ball,) = evaluate_spheres(points, 1, None, radius_mm)
            except InputError:
                continue
            scale = mm * radius_mm / ball.radius_mm
            tried.append(Fit(ball.rms_mm, FORM * radius_mm, scale))
        fits[direction] = min(tried, key=lambda fit: (not fit.is_possible, fit.misfit))
    if all(np.isinf(fit.misfit) for fit in fits.values()):
        raise InputError(
            f"{name}: no sphere of a radius of about {radius_mm:g} mm is in view, whatever R and T"
            " mean",
            "state the radius that was captured",
        )
    return msgspec.structs.replace(_make_check(name, "sphere", fits), unit="mm")


def check_by_single_axis(name: str, rig: StereoRig, phases: PhaseMaps) -> TransformCheck:
    """Check R and T by a capture with one axis, which contradicts them where points lie behind a
    device or outside of the projector's field, and confirms nothing."""
    depths, share = measure_single_axis(phases, rig)
    depth_mm = float(np.median(depths)) if len(depths) else None
    check = TransformCheck(
        capture=name, answer="undecided", evidence="single axis", depth_mm=depth_mm
    )
    if share >= LEAST_MEASURED[0]:
        return check
    remedy = possible_directions(phases, rig) or OTHER_CALIBRATION
    return msgspec.structs.replace(check, answer="disagrees", remedy=remedy)


def _make_check(
    name: str, evidence: Compared, fits: Fits, depth_mm: float | None = None
) -> TransformCheck:
    """Return the record of what the fits to a capture say."""
    answer, remedy = conclude_fits(fits)
    own = fits["as stated"]
    misfits: dict[str, float | None] = {
        each: finite_or_none(fit.misfit) for each, fit in fits.items()
    }
    return TransformCheck(
        capture=name,
        answer=answer,
        evidence=evidence,
        misfit=misfits.pop("as stated"),
        limit=own.limit,
        remedy=remedy,
        others=misfits,
        scale=own.scale,
        depth_mm=depth_mm,
    )


def conclude_fits(fits: Fits) -> tuple[Answer, str]:
    """Return whether R and T agree with a capture as they are stated, in mm, and what they most
    likely are instead, or may be; empty where they agree."""
    own = fits["as stated"]
    rivals: dict[Direction, Fit] = {
        each: fit for each, fit in fits.items() if each != "as stated" and fit.is_possible
    }
    best: Direction = min(rivals, key=lambda each: rivals[each].misfit, default="as stated")
    least = fits[best].misfit
    if own.is_possible and not _is_distinct(least, own.misfit):
        if own.unit != "mm":
            return "disagrees", f"T is in {own.unit}; import it with --unit {own.unit}"
        if best == "as stated" or own.misfit <= DISTINCT * least:
            return "agrees", ""
        return "undecided", f"it explains as well that {REMEDIES[best]}"
    others = (fit.misfit for each, fit in rivals.items() if each != best)
    if best != "as stated" and least <= DISTINCT * min(others, default=np.inf):
        unit = fits[best].unit
        in_unit = f", with --unit {unit}" if unit != "mm" else ""
        return "disagrees", REMEDIES[best] + in_unit
    if rivals:
        return "disagrees", " or ".join(REMEDIES[each] for each in rivals)
    if own.misfit <= own.limit and own.scale:
        return "disagrees", (
            f"T would have to be {own.scale:.4g} times as long, which no unit explains: check the"
            " known length, such as the board's pitch, and the camera's matrix"
        )
    return "disagrees", OTHER_RIG


def _is_distinct(least: float, misfit: float) -> bool:
    """Whether another direction explains a misfit that no noise does."""
    return misfit > EQUAL_PX and least < EXPLAINED * misfit


def _list_distinct(rig: StereoRig, points: Floats) -> dict[Direction, StereoRig]:
    """Return the directions that move what ``points`` (n, 3) mm project to, and the stated one."""
    directions = list_directions(rig)
    here, distinct = rig.project(points), dict[Direction, StereoRig]()
    for direction, other in directions.items():
        moved_px = lengths(other.project(points) - here)
        moved_px = moved_px[np.isfinite(moved_px)]
        is_same = 2 * len(moved_px) > len(points) and np.median(moved_px) < EQUAL_PX
        if direction == "as stated" or not is_same:
            distinct[direction] = other
    return distinct
