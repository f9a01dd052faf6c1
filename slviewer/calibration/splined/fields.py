"""Displacements over an image as uniform cubic B-splines: what a lens does that Brown's polynomial
cannot express.

A point that pinhole and Brown put at pixel p is imaged at p + W(p). ``coefficients`` (2, ny + 3, nx
+ 3) px hold W for ny x nx equal cells of the image, from its outer edge (-0.5) on; beyond the image
W stays what it is at the edge.
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from slviewer.geometry.brown import distort_to_px, undistort_point
from slviewer.geometry.jit import kernel, run_rows
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.splines import bending_energy
from slviewer.geometry.vectors import finite_rows

CELLS_ACROSS = 26
"""Of any image: half a wavelength of the finest distortion that matters holds two or three
cells."""
RIDGE = 0.05
"""Of the squared coefficients, relative to their squared second differences: without data, W is
nothing."""


class Device(NamedTuple):
    """A camera or projector in the compiled kernels: a ``Lens``'s ten ``numbers``, its field's
    ``coefficients``, and the image's ``size`` (2,) float64 px."""

    numbers: Floats
    coefficients: Floats
    size: Floats

    @classmethod
    def from_lens(cls, lens: Lens, cells_across: int | None = None) -> "Device":
        """Return a lens's device with W = 0, on square cells, ``CELLS_ACROSS`` by default."""
        across = CELLS_ACROSS if cells_across is None else cells_across
        width, height = lens.size
        down = int(np.clip(round(across * height / width), 6, 2 * across))
        return cls(lens.parameters, np.zeros((2, down + 3, across + 3)), np.array(lens.size, float))


def roughness(coefficients: Floats) -> Floats:
    """(n, n): the prior's quadratic form of one component's n coefficients, second differences and
    a small ridge."""
    rows, columns = coefficients.shape[1:]
    return (bending_energy(columns, rows) + RIDGE * sp.eye(rows * columns)).toarray()


def undistort(device: Device, pixels: Floats) -> Floats:
    """Undistorted normalised coordinates (n, 2) of ``pixels`` (n, 2); NaN for NaN and where the
    inversion fails."""
    rays = np.empty((len(pixels), 2))
    run_rows(_undistort_all, len(pixels), device, np.ascontiguousarray(pixels, np.float64), rays)
    return rays


def in_image(device: Device, pixels: Floats) -> Mask:
    """(n,) bool: whether ``pixels`` (n, 2) are in a device's image; False for NaN."""
    return np.asarray(((pixels >= -0.5) & (pixels <= device.size - 0.5)).all(axis=1))


def in_illuminated_cells(device: Device, pixels: Floats, illuminated: Mask) -> Mask:
    """(n,) bool: whether ``pixels`` (n, 2) are in cells (rows, columns) bool that target poses
    illuminated.

    Pixels outside the image count to the cell at its edge; False for NaN.
    """
    shape = np.array(illuminated.shape[::-1])
    known = finite_rows(pixels)
    place = np.where(known[:, None], (pixels + 0.5) / device.size * shape, 0.0)
    cells = np.clip(place, 0, shape - 1).astype(int)
    return illuminated[cells[:, 1], cells[:, 0]] & known


@kernel()
def spline_basis(position, length, cells, weights, slopes):
    """The cell of a position px, with the four splines' values and slopes a px there."""
    x = (position + 0.5) * cells / length
    rate = cells / length
    if not x > 0.0:
        x, rate = 0.0, 0.0
    elif x > cells:
        x, rate = float(cells), 0.0
    cell = min(int(x), cells - 1)
    f = x - cell
    g = 1.0 - f
    weights[0] = g * g * g / 6.0
    weights[1] = (3.0 * f * f * f - 6.0 * f * f + 4.0) / 6.0
    weights[2] = (3.0 * g * g * g - 6.0 * g * g + 4.0) / 6.0
    weights[3] = f * f * f / 6.0
    slopes[0] = -0.5 * g * g * rate
    slopes[1] = (1.5 * f * f - 2.0 * f) * rate
    slopes[2] = (2.0 * g - 1.5 * g * g) * rate
    slopes[3] = 0.5 * f * f * rate
    return cell


@kernel()
def displacement(device, u, v, basis):
    """(du, dv, their slopes ddu/du, ddu/dv, ddv/du, ddv/dv, first column, first row) of W at a
    pixel.

    ``basis`` (4, 4) is filled with the values and slopes of the splines across, then down.
    """
    c = device.coefficients
    i = spline_basis(u, device.size[0], c.shape[2] - 3, basis[0], basis[1])
    j = spline_basis(v, device.size[1], c.shape[1] - 3, basis[2], basis[3])
    du = dv = duu = duv = dvu = dvv = 0.0
    for a in range(4):
        su = sv = tu = tv = 0.0
        for b in range(4):
            cu, cv = c[0, j + a, i + b], c[1, j + a, i + b]
            su += basis[0, b] * cu
            sv += basis[0, b] * cv
            tu += basis[1, b] * cu
            tv += basis[1, b] * cv
        du += basis[2, a] * su
        dv += basis[2, a] * sv
        duu += basis[2, a] * tu
        dvu += basis[2, a] * tv
        duv += basis[3, a] * su
        dvv += basis[3, a] * sv
    return du, dv, duu, duv, dvu, dvv, i, j


@kernel()
def remove_displacement(device, u, v, basis):
    """The pixel (u, v) less the displacement that brought it there: q with q + W(q) = (u, v)."""
    x, y = u, v
    for _ in range(20):
        du, dv, duu, duv, dvu, dvv, _, _ = displacement(device, x, y, basis)
        eu, ev = u - x - du, v - y - dv
        determinant = (1.0 + duu) * (1.0 + dvv) - duv * dvu
        x += ((1.0 + dvv) * eu - duv * ev) / determinant
        y += ((1.0 + duu) * ev - dvu * eu) / determinant
        if abs(eu) + abs(ev) < 1e-7:  # the last step squares this
            break
    return x, y


@kernel()
def distort_to_pixel(device, x, y, basis):
    """The pixel of an undistorted normalised point, without derivatives; NaN past the fold of
    Brown's polynomial."""
    u, v = distort_to_px(x, y, device.numbers)
    if np.isnan(u):
        return u, v
    du, dv, _, _, _, _, _, _ = displacement(device, u, v, basis)
    return u + du, v + dv


@kernel()
def dot_row(R, k, v):
    """Return the scalar product of row ``k`` of R (3, 3) and v (3,), summed in order."""
    return R[k, 0] * v[0] + R[k, 1] * v[1] + R[k, 2] * v[2]


@kernel()
def dot_column(R, k, v):
    """Return the scalar product of column ``k`` of R (3, 3) and v (3,), summed in order."""
    return R[0, k] * v[0] + R[1, k] * v[1] + R[2, k] * v[2]


@kernel()
def project_point(rig, x, y, z, basis):
    """Return the projector's pixel of the point (x z, y z, z) mm in the camera's frame; NaN behind
    the projector."""
    ray = x, y, 1.0
    X2 = z * dot_row(rig.R, 2, ray) + rig.t[2]
    if not X2 > 0.0:
        return np.nan, np.nan
    X0, X1 = z * dot_row(rig.R, 0, ray) + rig.t[0], z * dot_row(rig.R, 1, ray) + rig.t[1]
    return distort_to_pixel(rig.projector, X0 / X2, X1 / X2, basis)


@kernel()
def undistort_pixel(device, u, v, basis):
    """Return the undistorted normalised point imaged at a pixel, without derivatives; NaN where the
    inversion fails."""
    k = device.numbers
    x, y = remove_displacement(device, u, v, basis)
    return undistort_point((x - k[2]) / k[0], (y - k[3]) / k[1], k)


@kernel()
def _undistort_all(first, last, device, pixels, rays):
    """Fill ``rays`` (n, 2) with the undistorted normalised coordinates of pixels ``first`` to
    ``last``; NaN where not possible."""
    basis = np.zeros((4, 4))
    for n in range(first, last):
        rays[n, 0], rays[n, 1] = np.nan, np.nan
        if np.isfinite(pixels[n, 0]) and np.isfinite(pixels[n, 1]):
            rays[n, 0], rays[n, 1] = undistort_pixel(device, pixels[n, 0], pixels[n, 1], basis)
