"""The unknowns of the adjustment, their order in its vector, and their compiled functions: devices
with displacement fields, the board's shape, and the poses.

Displacements over an image are uniform cubic B-splines: what a lens does that Brown's polynomial
cannot express. A point that pinhole and Brown put at pixel p is imaged at p + W(p).
``coefficients`` (2, ny + 3, nx + 3) px hold W for ny x nx equal cells of the image, from its outer
edge (-0.5) on; beyond the image W stays what it is at the edge.

The board has a smooth height, and features that are not quite where they should be. The height is a
sum of products of Legendre polynomials of degrees 2 to 4 in all over the features' rectangle: bow
both ways, twist, and what bends in itself. Constants and slopes are missing because the pose has
them.
"""

from typing import NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from slviewer.geometry.brown import distort_to_px, fold_radius_squared, undistort_point
from slviewer.geometry.jit import kernel, run_rows
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.splines import bending_energy
from slviewer.geometry.vectors import diagonal, finite_rows, unit_vectors

CELLS_ACROSS = 26
"""Of any image: half a wavelength of the finest distortion that matters holds two or three
cells."""
RIDGE = 0.05
"""Of the squared coefficients, relative to their squared second differences: without data, W is
nothing."""
HEIGHT_DEGREES = np.array([(i, total - i) for total in (2, 3, 4) for i in range(total, -1, -1)])
"""(12, 2): of the polynomials in x and y."""
HEIGHT_TERMS = len(HEIGHT_DEGREES)
HEIGHT_SIGMA = 1 / np.array([{2: 750, 3: 2250, 4: 4500}[i + j] for i, j in HEIGHT_DEGREES.tolist()])
"""(12,): prior standard deviation of a board's departure from a plane, over its features' diagonal:
0.3, 0.1 and 0.05 mm at 225 mm."""
OFFSET_SIGMA = 1 / 7500
"""Of a printed feature along x and along y: 0.03 mm at 225 mm."""
GAUGE = 5e-9
"""How nearly the offsets' common shift, turn and growth are held at nothing: the poses and the
pitch have those."""
GAUGE_PX = 1e-6
"""The same of what a held lens has, in the camera's field."""
LENS = 9
"""fx fy cx cy k1 k2 p1 p2 k3."""
RIG = 2 * LENS + 6
"""Both lenses, then rotation and translation."""


class Device(NamedTuple):
    """A camera or projector in the compiled kernels: a ``Lens``'s ten ``numbers``, its field's
    ``coefficients``, and the image's ``size`` (2,) float64 px."""

    numbers: Floats
    coefficients: Floats
    size: Floats

    @classmethod
    def from_lens(cls, lens: Lens, cells_across: int | None) -> "Device":
        """Return a lens's device with W = 0, on square cells; ``cells_across``: of its longer side,
        ``CELLS_ACROSS`` by default."""
        across = CELLS_ACROSS if cells_across is None else cells_across
        cells, side = np.full(2, across), long_side(lens)
        other = across * lens.size[1 - side] / lens.size[side]
        cells[1 - side] = np.clip(round(other), 6, 2 * across)
        columns, rows = cells.tolist()
        size = np.array(lens.size, float)
        return cls(lens.parameters, np.zeros((2, rows + 3, columns + 3)), size)


def long_side(lens: Lens) -> int:
    """Return 0 where a lens sees more along its image's width, 1 along its height; a camera on its
    side has the same cells as one upright."""
    wide, high = np.array(lens.size) / np.diag(lens.K)[:2]
    return int(high > wide)


def roughness(coefficients: Floats) -> Floats:
    """(n, n): the prior's quadratic form of one component's n coefficients, second differences and
    a small ridge."""
    rows, columns = coefficients.shape[1:]
    return (bending_energy(columns, rows) + RIDGE * scipy.sparse.eye(rows * columns)).toarray()


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


class Arrangement(NamedTuple):
    """Camera and projector, with X_p = R X_c + t, for the compiled kernels."""

    camera: Device
    projector: Device
    R: Floats
    t: Floats


class UnknownLayout(NamedTuple):
    """Order of the unknowns: number of ``poses`` (6 each), then the index of the first unknown of
    ``height``, ``offsets`` (2 each), and the ``rig``: both lenses (9 each), rotation and
    translation, ``camera_field`` and ``projector_field`` (u's coefficients, then v's); and the
    number of unknowns.

    The rig's unknowns are last, so that the last block of a Cholesky factor is their information
    with all others marginalised out.
    """

    poses: int
    height: int
    offsets: int
    rig: int
    camera_field: int
    projector_field: int
    size: int

    @property
    def starts(self) -> NDArray[np.int64]:
        """(5,): the first unknown of height, offsets, rig, camera's field, and projector's field,
        for the kernels."""
        return np.array(self[1:-1], np.int64)

    @property
    def separable(self) -> tuple[slice, ...]:
        """Blocks of which no two share an observation or a prior: offsets, and u and v of the
        projector's field."""
        v = (self.projector_field + self.size) // 2
        return slice(self.offsets, self.rig), slice(self.projector_field, v), slice(v, self.size)


class State(NamedTuple):
    """The unknowns' values, for the compiled kernels too. ``R_board`` (p, 3, 3), ``t_board``
    (p, 3): board to camera; ``heights`` (12,) and ``offsets`` (f, 2) mm: the board's shape."""

    rig: Arrangement
    R_board: Floats
    t_board: Floats
    heights: Floats
    offsets: Floats

    @classmethod
    def from_rig(
        cls,
        rig: StereoRig,
        T: Floats,
        features: int,
        cells_across: int | None = None,
        camera_cells: int | None = None,
    ) -> "State":
        """Return the initial state of a rig and poses ``T`` (p, 4, 4), board to camera: no
        displacement, a flat board.

        ``cells_across``: cells of each displacement field across its image; by default
        ``unknowns.CELLS_ACROSS``. ``camera_cells``: the same of the camera's alone.
        """
        camera = Device.from_lens(rig.camera, camera_cells or cells_across)
        projector = Device.from_lens(rig.projector, cells_across)
        return cls(
            Arrangement(camera, projector, rig.R.copy(), rig.t.copy()),
            np.ascontiguousarray(T[:, :3, :3]),
            np.ascontiguousarray(T[:, :3, 3]),
            np.zeros(HEIGHT_TERMS),
            np.zeros((features, 2)),
        )

    @property
    def layout(self) -> UnknownLayout:
        """Order of the unknowns."""
        poses, fields = len(self.t_board), [device.coefficients.size for device in self.rig[:2]]
        bounds = np.cumsum([6 * poses, HEIGHT_TERMS, 2 * len(self.offsets), RIG, *fields])
        return UnknownLayout(poses, *bounds.tolist())

    def step(self, step: Floats) -> "State":
        """Return the state after a step (N,) in the order of ``layout``; rotation vectors apply
        from the left."""
        at = self.layout
        pose = step[: at.height].reshape(-1, 6)
        rig, s = self.rig, step[at.rig :]
        fields = step[at.camera_field : at.projector_field], step[at.projector_field :]
        return self._replace(
            rig=Arrangement(
                _step_device(rig.camera, s[:LENS], fields[0]),
                _step_device(rig.projector, s[LENS : 2 * LENS], fields[1]),
                rotate_left(rig.R, s[2 * LENS : 2 * LENS + 3]),
                rig.t + s[2 * LENS + 3 : RIG],
            ),
            R_board=np.array(
                [rotate_left(R, w) for R, w in zip(self.R_board, pose[:, :3], strict=True)]
            ),
            t_board=self.t_board + pose[:, 3:],
            heights=self.heights + step[at.height : at.offsets],
            offsets=self.offsets + step[at.offsets : at.rig].reshape(-1, 2),
        )


def pinhole_lens(device: Device) -> Lens:
    """Return the pinhole and Brown lens of a device, without its displacement field."""
    return Lens.from_parameters(device.numbers[:LENS], (int(device.size[0]), int(device.size[1])))


def rotate_left(R: Floats, vector: Floats) -> Floats:
    """Rotate R (3, 3) from the left by a rotation vector (3,); the result is orthonormalised."""
    u, _, v = np.linalg.svd(cv2.Rodrigues(np.ascontiguousarray(vector))[0] @ R)
    return u @ v


def _step_device(device: Device, numbers: Floats, coefficients: Floats) -> Device:
    """Return a device with steps added to its nine lens parameters and its spline coefficients."""
    k = device.numbers[:LENS] + numbers
    return Device(
        np.append(k, fold_radius_squared(k[4:])),
        device.coefficients + coefficients.reshape(device.coefficients.shape),
        device.size,
    )


def board_frame(points: Floats) -> Floats:
    """(4,) mm: middle x, middle y, half width, half height of the features' rectangle."""
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    return np.concatenate([(low + high) / 2, np.maximum(high - low, 1e-5 * diagonal(points)) / 2])


def offset_gauge(points: Floats) -> Floats:
    """(4, 2n) unit rows: what offsets (x0, y0, x1, y1, ...) have of a shift in x and y, a turn and
    a growth."""
    x, y = (points[:, :2] - points[:, :2].mean(0)).T
    one, none = np.ones_like(x), np.zeros_like(x)
    rows = np.array(
        [np.stack(pair, 1).ravel() for pair in ((one, none), (none, one), (-y, x), (x, y))]
    )
    return unit_vectors(rows)


@kernel()
def height_terms(x, y, frame, terms):
    """Fills (3, 12): the polynomials, and their slopes along x and along y, at a board point
    (mm)."""
    a, b = (x - frame[0]) / frame[2], (y - frame[1]) / frame[3]
    pa, pb = np.empty(5), np.empty(5)
    da, db = np.empty(5), np.empty(5)
    for p, d, s in ((pa, da, a), (pb, db, b)):
        p[0], p[1], d[0], d[1] = 1.0, s, 0.0, 1.0
        for n in range(1, 4):
            p[n + 1] = ((2 * n + 1) * s * p[n] - n * p[n - 1]) / (n + 1)
            d[n + 1] = d[n - 1] + (2 * n + 1) * p[n]
    k = 0
    for total in range(2, 5):
        for i in range(total, -1, -1):
            j = total - i
            terms[0, k] = pa[i] * pb[j]
            terms[1, k] = da[i] * pb[j] / frame[2]
            terms[2, k] = pa[i] * db[j] / frame[3]
            k += 1


@kernel()
def height_at(x, y, frame, heights, terms):
    """(z, dz/dx, dz/dy) of the board's surface at a board point; leaves the terms."""
    height_terms(x, y, frame, terms)
    z = zx = zy = 0.0
    for k in range(heights.shape[0]):
        z += heights[k] * terms[0, k]
        zx += heights[k] * terms[1, k]
        zy += heights[k] * terms[2, k]
    return z, zx, zy


@kernel()
def _heights(points, frame, heights, out):
    """Fill ``out`` (n,) mm with the heights of the board's surface at ``points`` (n, 2) mm."""
    terms = np.empty((3, heights.shape[0]))
    for i in range(points.shape[0]):
        out[i], _, _ = height_at(points[i, 0], points[i, 1], frame, heights, terms)


def board_heights(points: Floats, frame: Floats, heights: Floats) -> Floats:
    """(n,) mm: z of the board's surface at board points (n, 2); positive away from the camera."""
    out = np.empty(len(points))
    _heights(np.ascontiguousarray(points[:, :2], np.float64), frame, heights, out)
    return out


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
