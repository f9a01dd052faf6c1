"""From absolute phase and a calibration to an organised cloud, and to the triangles of its grid."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap, PhaseMaps
from slviewer.fringe.sequence import Axis
from slviewer.geometry.jit import kernel, run_rows
from slviewer.geometry.vectors import finite_rows
from slviewer.reconstruction.cloud import Cloud, Map, Points

EDGE_SIGMAS = 10.0
"""Standard deviations of noise, beyond which the error that blur makes at an edge masks a pixel;
smaller ones are part of its uncertainty."""

JUMP = 0.01
"""A neighbour this much nearer or deeper (share of the depth) belongs to another surface."""


class Model(Protocol):
    """Interface of a calibration for reconstruction, whichever it is."""

    @property
    def name(self) -> str:
        """Name of the model, such as stereo or pixelwise."""
        ...

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes it was calibrated for."""

    def points(self, phase: PhaseMap) -> Points:
        """(h, w, 3) float32 mm in the camera's frame, NaN where invalid."""

    def sigma_z(self, phase: PhaseMap, points: Points) -> Map:
        """(h, w) mm: predicted standard deviation of depth."""


@runtime_checkable
class KnowsErrors(Protocol):
    """A calibration that knows its own uncertainty."""

    def excess_px(self, axis: Axis) -> float:
        """Scatter of the phase beyond its predicted noise, in projector px (1 sigma)."""

    def sigma_calibration(self, axis: Axis, points: Points) -> Map:
        """(h, w) float32 mm: standard deviation of the depth of organised points due to the
        calibration."""


@runtime_checkable
class KnowsSupport(Protocol):
    """A calibration that knows which pixels look through parts of camera and projector that target
    poses illuminated."""

    def points(self, phase: PhaseMap, supported: bool = True) -> Points:
        """As `Model`; unless ``supported``, those of other pixels too."""

    def support(self, phase: PhaseMap) -> np.ndarray:
        """(h, w) bool: the measured pixels that target poses support."""


def reconstruct_cloud(
    model: Model,
    phases: PhaseMaps,
    axis: Axis | None = None,
    texture: np.ndarray | None = None,
    *,
    extrapolates: bool = False,
) -> Cloud:
    """Reconstruct the organised cloud of a capture: points, predicted sigmas and texture on the
    camera's grid.

    ``phases``: the capture's absolute phase maps by axis. ``axis``: the one that depth is taken
    from; None selects the one with the smaller median predicted sigma_z over the pixels that both
    measure, or, where there are none, the one that measures more pixels. ``texture``: (h, w) or (h,
    w, 3), uint8 or uint16. ``extrapolates``: also points that no target pose supports, marked as
    such; the others are the same.

    Raises InputError where the capture or the model lacks the axis.
    """
    if axis is not None:
        if axis not in phases:
            raise InputError(
                f"The capture holds no axis {axis}, only {_join_axes(phases)}",
                "choose one of these.",
            )
        if axis not in model.axes:
            raise InputError(
                f"The {model.name} calibration has no axis {axis}, only {_join_axes(model.axes)}",
                f"choose one of these, or calibrate with captures of axis {axis}.",
            )
    axes = [shared for shared in model.axes if shared in phases] if axis is None else [axis]
    if not axes:
        raise InputError(
            f"The capture holds axis {_join_axes(phases)} and the {model.name} calibration"
            f" {_join_axes(model.axes)}",
            "capture along an axis that is calibrated, or calibrate with the captured one.",
        )
    cloud = _select_axis([_measure(model, phases[each], extrapolates) for each in axes])
    sigma = None
    if isinstance(model, KnowsErrors):
        sigma = model.sigma_calibration(cloud.axis, cloud.points)
    return replace(cloud, texture=texture, sigma_calibration=sigma)


def normals(points: Points, reach: int = 2) -> Points:
    """Unit normals (h, w, 3) float32 of an organised cloud, towards the camera; NaN where
    neighbours are missing.

    The cross product of the surface's differences along rows and columns: central differences,
    averaged by least squares over the valid pixels of a window of 2 ``reach`` + 1, because two
    neighbours alone would show little but their noise. Neighbours across a depth jump are excluded.
    """
    points = np.ascontiguousarray(points, dtype=np.float32)
    out = np.empty_like(points)
    run_rows(_normals, len(points), points, reach, out)
    return out


def cloud_normals(cloud: Cloud) -> Points:
    """Return the unit normals (h, w, 3) of a cloud: its own, or those of its grid."""
    return normals(cloud.points) if cloud.normals is None else cloud.normals


def _measure(model: Model, phase: PhaseMap, extrapolates: bool) -> Cloud:
    """Return the points of one axis, without those where the camera's blur spoils the phase at an
    edge.

    Their standard deviation is from the phase noise and from what the calibration's own phases
    scatter by beyond theirs; what blur makes at edges is not known for Gray code alone.
    """
    if phase.is_relative:
        raise InputError(
            f"The phase of axis {phase.axis} repeats every {phase.unambiguous_px:g} px",
            "resolve it by a depth range.",
        )
    phase, remaining_px = phase.correct_edges()
    extrapolated = None
    if extrapolates and isinstance(model, KnowsSupport):
        points = model.points(phase, supported=False)
        extrapolated = np.isfinite(points[..., 2]) & ~model.support(phase)
    else:
        points = model.points(phase)
    sigma = model.sigma_z(phase, points)
    noise_px = np.maximum(phase.sigma_px, np.float32(1e-9))
    per_px = sigma / noise_px
    excess = model.excess_px(phase.axis) if isinstance(model, KnowsErrors) else 0.0
    if excess > 0.0:
        noise_px = np.hypot(noise_px, np.float32(excess))
        sigma = per_px * noise_px
    edges = None
    if phase.steps:
        edges, spoilt = per_px * remaining_px, remaining_px > EDGE_SIGMAS * noise_px
        points[spoilt], sigma[spoilt] = np.nan, np.nan
        if extrapolated is not None:
            extrapolated &= ~spoilt
    if extrapolated is not None and not extrapolated.any():
        extrapolated = None
    return Cloud(
        points, phase.axis, model.name, sigma, sigma_edges=edges, extrapolated=extrapolated
    )


def _select_axis(clouds: Sequence[Cloud]) -> Cloud:
    """Return the cloud of the axis with the lowest median sigma where both are valid, else the one
    with most valid pixels; what is extrapolated is not."""
    valid = [
        np.isfinite(cloud.points[..., 2])
        & np.isfinite(cloud.sigma_z)
        & (True if cloud.extrapolated is None else ~cloud.extrapolated)
        for cloud in clouds
    ]
    both = np.logical_and.reduce(valid)
    if both.any():
        return min(clouds, key=lambda cloud: float(np.median(cloud.sigma_z[both])))
    return clouds[int(np.argmax([each.sum() for each in valid]))]


def _join_axes(axes: PhaseMaps | tuple[Axis, ...]) -> str:
    """Format axis names as text: "x and y"."""
    return " and ".join(sorted(axes)) or "none"


@kernel()
def _normals(first, last, points, reach, out):
    """Per pixel, fits p = p0 + a du + b dv to the window's valid points; the normal is along a x
    b."""
    height, width = points.shape[0], points.shape[1]
    for y in range(first, last):
        for x in range(width):
            out[y, x, 0] = out[y, x, 1] = out[y, x, 2] = np.nan
            z = points[y, x, 2]
            if not np.isfinite(z):
                continue
            n = su = sv = suu = suv = svv = 0.0
            p0 = p1 = p2 = u0 = u1 = u2 = v0 = v1 = v2 = 0.0
            for j in range(max(y - reach, 0), min(y + reach + 1, height)):
                for i in range(max(x - reach, 0), min(x + reach + 1, width)):
                    if not abs(points[j, i, 2] - z) <= JUMP * z:  # False for NaN too
                        continue
                    du, dv = float(i - x), float(j - y)
                    d0 = float(points[j, i, 0]) - points[y, x, 0]
                    d1 = float(points[j, i, 1]) - points[y, x, 1]
                    d2 = float(points[j, i, 2]) - z
                    n += 1.0
                    su, sv = su + du, sv + dv
                    suu, suv, svv = suu + du * du, suv + du * dv, svv + dv * dv
                    p0, p1, p2 = p0 + d0, p1 + d1, p2 + d2
                    u0, u1, u2 = u0 + du * d0, u1 + du * d1, u2 + du * d2
                    v0, v1, v2 = v0 + dv * d0, v1 + dv * d1, v2 + dv * d2
            # about the mean of the window's valid pixels
            suu, suv, svv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
            determinant = suu * svv - suv * suv
            if not determinant > 1e-6:  # all neighbours on one line of pixels
                continue
            u0, u1, u2 = u0 - su * p0 / n, u1 - su * p1 / n, u2 - su * p2 / n
            v0, v1, v2 = v0 - sv * p0 / n, v1 - sv * p1 / n, v2 - sv * p2 / n
            a0, a1, a2 = svv * u0 - suv * v0, svv * u1 - suv * v1, svv * u2 - suv * v2
            b0, b1, b2 = suu * v0 - suv * u0, suu * v1 - suv * u1, suu * v2 - suv * u2
            n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
            length = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            if not length > 0.0:
                continue
            if n0 * points[y, x, 0] + n1 * points[y, x, 1] + n2 * z > 0.0:
                length = -length
            out[y, x, 0], out[y, x, 1], out[y, x, 2] = n0 / length, n1 / length, n2 / length


def triangulate_grid(points: Points, max_jump: float | None = None) -> np.ndarray:
    """Faces (m, 3) int32 of an organised cloud (h, w, 3) mm, numbering its valid points row by row.

    (The vertices are ``points[np.isfinite(points).all(axis=-1)]``.) Each square of four
    neighbouring pixels gives two triangles, cut along the diagonal with the smaller step in depth,
    or one where only three are valid. Triangles whose depths differ by more than ``max_jump`` mm,
    by default ``JUMP`` of the median depth, are excluded: there the surface ends. Faces turn
    counter-clockwise as the camera sees them from outside: their normals point towards it.
    """
    valid = finite_rows(points)
    index = np.cumsum(valid, dtype=np.int32).reshape(valid.shape) - 1
    z = np.where(valid, points[..., 2], np.nan)
    if max_jump is None:
        max_jump = JUMP * float(np.median(z[valid])) if valid.any() else 0.0
    corners = (np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:])
    depths, numbers = (np.stack([grid[corner] for corner in corners]) for grid in (z, index))
    falling, rising = np.abs(depths[0] - depths[3]), np.abs(depths[1] - depths[2])
    # a diagonal with an invalid end has a NaN step: the other one is cut along
    along_rising = np.isfinite(rising) & ~(falling < rising)
    along_falling = np.isfinite(falling) & ~along_rising
    faces = []
    for chosen, *triangle in (
        (along_rising, 0, 2, 1),
        (along_rising, 1, 2, 3),
        (along_falling, 0, 2, 3),
        (along_falling, 0, 3, 1),
    ):
        # False where a corner is NaN
        selected = chosen & (np.ptp(depths[triangle], axis=0) <= max_jump)
        faces.append(numbers[triangle][:, selected])
    return np.ascontiguousarray(np.concatenate(faces, axis=1).T)
