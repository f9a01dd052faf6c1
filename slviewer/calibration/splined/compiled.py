"""Fast inversion of the splined model: a rational function per pixel, plus a coarse grid of
corrections.

Along a camera ray depth is nearly a rational function of the projector's coordinate s, the Letter's
eq. 9: the function through three exact points of each pixel, ``z0 = (c0 + c1 s)/(1 + c2 s)``, has
errors of some hundredths of a millimetre. They vary slowly, and a grid over (u, v, z0) corrects
them.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from slviewer.calibration.splined.correction_grid import evaluate
from slviewer.calibration.splined.unknowns import (
    Arrangement,
    in_illuminated_cells,
    in_image,
    project_point,
    undistort,
    undistort_pixel,
)
from slviewer.fringe.sequence import Axis
from slviewer.geometry.jit import kernel, run_rows
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rigid import Floats, Floats32, Mask

GRID_CELLS_ACROSS = 100
"""Number of grid cells along the image's longer side: 16 px each at 1600."""
DEPTHS = 65
MAX_CORRECTION = 0.02
"""Largest correction over the depth range; beyond it, the coordinate is nearly constant or not
monotonic in depth."""
MIN_SLOPE = 3.0
"""Smallest change of the coordinate, px, over a change of depth as large as the depth; below it,
noise of 0.03 px would be a hundredth of the depth."""
_UNSEEN = (np.nan,) * 5
MARGIN = 0.25
"""Distance beyond the projector's image, over its size, up to which rays are evaluated."""


@dataclass(frozen=True, eq=False)
class CompiledAxis:
    """Fast inversion of one axis.

    ``coefficients`` (3, h, w) float32: rational function of the coordinate minus ``centre`` px.
    ``grid`` (nv, nu, nz) float32 mm: corrections at nodes ``step`` px and (far - near)/(nz - 1) mm
    apart, from pixel (0, 0) and ``near``. ``supported_grid``: ``grid`` with NaN where no target
    pose illuminated the camera's or the projector's cell. NaN where the projector does not see the
    ray, or where the coordinate hardly changes with depth.
    """

    coefficients: Floats32
    centre: float
    grid: Floats32
    supported_grid: Floats32
    step: int
    near: float
    far: float

    def depth(
        self, phase: np.ndarray, px_per_rad: float, rays: np.ndarray, supported: bool
    ) -> np.ndarray:
        """Return points (h, w, 3) float32 mm from absolute phase (h, w) rad; NaN where invalid or
        beyond near and far.

        ``rays`` (2, h, w): from ``pixel_rays``; ``supported``: only points that target poses
        support.
        """
        out = np.empty((*phase.shape, 3), np.float32)
        grid = self.supported_grid if supported else self.grid
        numbers = np.array(
            [px_per_rad, self.centre, self.near, (grid.shape[2] - 1) / (self.far - self.near)],
            np.float32,
        )
        phase = np.ascontiguousarray(phase, np.float32)
        run_rows(
            evaluate, len(phase), phase, numbers, self.coefficients, rays, grid, self.step, out
        )
        return out

    def depth_per_px(self, phase: np.ndarray, px_per_rad: float) -> np.ndarray:
        """Return |dz/ds| (h, w) float32 mm per px of the rational function at a phase map (h, w)
        rad."""
        c0, c1, c2 = self.coefficients
        s = phase * np.float32(px_per_rad) - np.float32(self.centre)
        return np.abs(c1 - c0 * c2) / (1 + c2 * s) ** 2


def pixel_rays(rig: Arrangement) -> Floats:
    """Return the undistorted normalised coordinates (2, h, w) float64 of the camera pixels."""
    width, height = (int(n) for n in rig.camera.size)
    rays = undistort(rig.camera, grid_points(np.arange(width), np.arange(height)))
    return np.ascontiguousarray(rays.T).reshape(2, height, width)


def compile_axis(
    rig: Arrangement,
    axis: Axis,
    rays: np.ndarray,
    depths: tuple[float, float],
    illuminated: tuple[Mask, Mask],
) -> CompiledAxis:
    """Compile one axis for depths between the two ``depths`` mm.

    ``rays`` (2, h, w): from ``pixel_rays``; ``illuminated``: the camera's and the projector's cells
    (rows, columns) bool that target poses illuminated.
    """
    near, far = depths
    row = 0 if axis == "x" else 1
    width, height = (int(n) for n in rig.camera.size)
    centre = (float(rig.projector.size[row]) - 1) / 2
    coefficients = np.empty((3, height, width), np.float32)
    ray = rig, row, centre, near, far
    run_rows(_fit_rational, height, *ray, rays, coefficients)
    step = max(2, -(-max(width, height) // GRID_CELLS_ACROSS))
    shape = (height - 1) // step + 2, (width - 1) // step + 2, DEPTHS
    grid, projected = np.full(shape, np.nan, np.float32), np.full((*shape, 2), np.nan)
    run_rows(_tabulate, shape[0], *ray, step, grid, projected)
    nodes = step * grid_points(np.arange(shape[1]), np.arange(shape[0]))
    at_camera = in_illuminated_cells(rig.camera, nodes, illuminated[0]).reshape(*shape[:2], 1)
    lit = projected.reshape(-1, 2)
    lit = in_image(rig.projector, lit) & in_illuminated_cells(rig.projector, lit, illuminated[1])
    known = np.isfinite(grid) & at_camera & lit.reshape(shape)
    # a pixel needs its eight nodes: dilating the known nodes by one gives each pixel about its own
    # support
    unknown = scipy.ndimage.binary_erosion(~known, np.ones((3, 3, 3), bool), border_value=1)
    supported_grid = np.where(unknown, np.float32(np.nan), grid)
    return CompiledAxis(coefficients, centre, grid, supported_grid, step, near, far)


@kernel()
def _project_depth(rig, x, y, z, basis):
    """Return the projector pixel (u, v) of the point (x z, y z, z); NaN far outside its image."""
    u, v = project_point(rig, x, y, z, basis)
    width, height = rig.projector.size[0], rig.projector.size[1]
    if (
        -MARGIN * width <= u <= (1.0 + MARGIN) * width
        and -MARGIN * height <= v <= (1.0 + MARGIN) * height
    ):
        return u, v
    return np.nan, np.nan


@kernel()
def _depth_interval(rig, x, y, near, far, basis):
    """Return the first and last depth from ``near`` to ``far`` at which a ray is near the
    projector's image, or NaN."""
    first = last = np.nan
    for k in range(33):
        z = near + (far - near) * k / 32.0
        u, _ = _project_depth(rig, x, y, z, basis)
        if np.isfinite(u):
            if not np.isfinite(first):
                first = z
            last = z
        elif np.isfinite(first):
            break
    step = (far - near) / 32.0  # to the edge itself, so that neighbouring pixels agree
    if first > near:
        first = _locate_edge(rig, x, y, first, first - step, basis)
    if last < far:
        last = _locate_edge(rig, x, y, last, last + step, basis)
    return first, last


@kernel()
def _locate_edge(rig, x, y, inside, outside, basis):
    """Return the depth next to ``outside`` at which a ray is near the projector's image, by
    bisection."""
    for _ in range(20):
        middle = 0.5 * (inside + outside)
        if np.isfinite(_project_depth(rig, x, y, middle, basis)[0]):
            inside = middle
        else:
            outside = middle
    return inside


@kernel()
def _interpolate_rational(rig, row, centre, x, y, near, far, basis):
    """Return (c0, c1, c2, first depth, last depth) of the ray (x, y, 1); NaN without a rational
    function."""
    first, last = near, far
    if np.isnan(_project_depth(rig, x, y, near, basis)[0]) or np.isnan(
        _project_depth(rig, x, y, far, basis)[0]
    ):
        first, last = _depth_interval(rig, x, y, near, far, basis)
        if not last - first > 1e-3 * (far - near):
            return _UNSEEN
    # nodes of Chebyshev's polynomial in 1/z, in which the coordinate is nearly linear
    middle, half = 0.5 * (1.0 / last + 1.0 / first), 0.433 * (1.0 / first - 1.0 / last)
    z0, z1, z2 = 1.0 / (middle - half), 1.0 / middle, 1.0 / (middle + half)
    s0 = _project_depth(rig, x, y, z0, basis)[row] - centre
    s1 = _project_depth(rig, x, y, z1, basis)[row] - centre
    s2 = _project_depth(rig, x, y, z2, basis)[row] - centre
    # c0 + c1 s - c2 s z = z at the three, less the first
    m00, m01, r0 = s1 - s0, s0 * z0 - s1 * z1, z1 - z0
    m10, m11, r1 = s2 - s0, s0 * z0 - s2 * z2, z2 - z0
    determinant = m00 * m11 - m01 * m10
    if not (abs(determinant) > 0.0 and abs(s2 - s0) > MIN_SLOPE * abs(z2 / z0 - 1.0)):
        return _UNSEEN
    c1 = (r0 * m11 - m01 * r1) / determinant
    c2 = (m00 * r1 - r0 * m10) / determinant
    return z0 - c1 * s0 + c2 * s0 * z0, c1, c2, first, last


@kernel()
def _fit_rational(start, stop, rig, row, centre, near, far, rays, coefficients):
    """Fill the ``coefficients`` (3, h, w) of the rational functions of the pixels in rows ``start``
    to ``stop``; NaN without one."""
    basis = np.zeros((4, 4))
    for v in range(start, stop):
        for u in range(rays.shape[2]):
            c0, c1, c2, _, _ = _interpolate_rational(
                rig, row, centre, rays[0, v, u], rays[1, v, u], near, far, basis
            )
            coefficients[0, v, u], coefficients[1, v, u], coefficients[2, v, u] = c0, c1, c2


@kernel()
def _tabulate(start, stop, rig, row, centre, near, far, step, grid, projected):
    """Fill rows ``start`` to ``stop`` of ``grid`` with exact depth minus rational function at its
    nodes, and ``projected`` (nv, nu, nz, 2) with their projector pixels."""
    basis = np.zeros((4, 4))
    for j in range(start, stop):
        for i in range(grid.shape[1]):
            u, v = float(i * step), float(j * step)
            x, y = undistort_pixel(rig.camera, u, v, basis)
            c0, c1, c2, first, last = _interpolate_rational(
                rig, row, centre, x, y, near, far, basis
            )
            if np.isnan(c0):
                continue
            for k in range(grid.shape[2]):
                target = near + (far - near) * k / (grid.shape[2] - 1.0)
                z = min(max(target, first), last)
                pu, pv, change = np.nan, np.nan, np.inf
                for _ in range(12):
                    pu, pv = _project_depth(rig, x, y, z, basis)
                    s = (pu if row == 0 else pv) - centre
                    change = target - (c0 + c1 * s) / (1.0 + c2 * s)
                    z = min(max(z + change, first), last)
                    if not abs(change) > 1e-6 * target:  # the next one is a thousandth of it
                        break
                s = (pu if row == 0 else pv) - centre
                correction = z - (c0 + c1 * s) / (1.0 + c2 * s)
                settled = abs(change) < 2e-6 * target or z in (first, last)
                if settled and abs(correction) < MAX_CORRECTION * (last - first):
                    grid[j, i, k] = correction
                    projected[j, i, k, 0], projected[j, i, k, 1] = pu, pv
