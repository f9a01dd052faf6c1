"""From a phase known modulo some projector px to an absolute one, by the depths between which the
scene lies."""

from dataclasses import dataclass, replace

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import Floats
from slviewer.geometry.triangulation import check_map, points_from_depth
from slviewer.geometry.vectors import thin_out

SAMPLE = 4000
"""Pixels for which the largest unique depth range is computed; neighbours differ little."""


@dataclass(frozen=True)
class Resolved:
    """An absolute phase, and the evidence for it.

    ``outside``: share of the decoded pixels that have no depth in the range, and are masked as
    OUTSIDE. ``spacing_mm``: distance in depth of the next candidates, in the median: a surface
    outside of the range is displaced by about that.
    """

    phase: PhaseMap
    outside: float
    spacing_mm: float


def resolve_phase(rig: StereoRig, phase: PhaseMap, depth_range_mm: tuple[float, float]) -> Resolved:
    """The absolute phase whose points lie between two depths (near, far) mm of the camera's frame.

    Between them a camera pixel's ray covers a stretch of the projector's columns (rows); where that
    is shorter than what the phase tells apart, one candidate is left at most. Raises InputError,
    with a range that is narrow enough, where the stretch is longer at any decoded pixel.
    """
    near, far = depth_range_mm
    if not 0 < near < far < np.inf:
        raise InputError(
            f"depths from {near:g} to {far:g} mm are not a range",
            "give the nearest depth first, both positive",
        )
    reach = phase.unambiguous_px
    rays = rig.camera.rays()
    check_map(rig.camera.size, phase.phase, "phases")
    low, high = _coordinate_range(rig, rays, near, far, phase.axis)
    stretch = (high - low)[phase.mask]
    longest = float(np.nanmax(stretch, initial=0.0))
    if longest >= reach:
        limit = _unique_far(rig, rays[phase.mask], near, far, phase.axis, reach)
        narrower = f", such as {near:.0f} to {limit:.0f} mm" if limit - near >= 1 else ""
        raise InputError(
            f"axis {phase.axis}: between {near:.0f} and {far:.0f} mm a camera pixel sees up to"
            f" {longest:.0f} px of the projector, and the phase repeats every {reach:g} px: up to"
            f" {int(longest // reach) + 1} depths fit. State a narrower depth range{narrower}, or"
            " capture with Gray code or a longer period"
        )
    coordinate = phase.coordinate.astype(np.float64)
    order = np.ceil((low - coordinate) / reach)
    inside = phase.mask & (coordinate + order * reach <= high)
    turns = (order * reach).astype(np.float32)
    absolute = phase.phase + np.float32(2 * np.pi / phase.period_px) * turns
    reason = np.where(phase.mask & ~inside, np.uint8(Reason.OUTSIDE), phase.reason)
    outside = float(np.mean(~inside[phase.mask])) if stretch.size else 0.0
    usual = float(np.nanmedian(stretch)) if stretch.size else np.nan
    return Resolved(
        replace(
            phase,
            phase=np.where(inside, absolute, np.float32(np.nan)),
            reason=reason,
            unambiguous_px=float(np.inf),
        ),
        outside,
        (far - near) * reach / usual if usual > 0 else np.inf,
    )


def _coordinate_range(
    rig: StereoRig, rays: Floats, near: float, far: float, axis: str
) -> tuple[Floats, Floats]:
    """Return the lowest and the highest projector coordinate (...,) px of rays (..., 2) between two
    depths."""
    row = 0 if axis == "x" else 1
    at_near, at_far = (
        rig.project(points_from_depth(rays, np.full(rays.shape[:-1], depth)))[..., row]
        for depth in (near, far)
    )
    return np.minimum(at_near, at_far), np.maximum(at_near, at_far)


def _unique_far(
    rig: StereoRig, rays: Floats, near: float, far: float, axis: str, reach: float
) -> float:
    """Return the depth in mm up to which the phase is unique from ``near`` on."""
    rays = thin_out(rays, SAMPLE)
    least, most = near, far
    for _ in range(30):
        middle = 0.5 * (least + most)
        low, high = _coordinate_range(rig, rays, near, middle, axis)
        if np.nanmax(high - low) < 0.98 * reach:
            least = middle
        else:
            most = middle
    return float(np.floor(least))
