"""What the unknowns predict, with analytic derivatives: features in the camera, and the projector's
coordinates of what a camera pixel sees on the board.

Derivatives follow the vector of ``unknowns``, with a small dense row for pose (6), height (12),
offset (2) and rig (24), and for each field the splines' values at one place, from which a row's
entries are products.
"""

from typing import NamedTuple

import numpy as np

from slviewer.calibration.splined.unknowns import (
    HEIGHT_TERMS,
    displacement,
    dot_column,
    dot_row,
    height_at,
    remove_displacement,
)
from slviewer.geometry.brown import distort_point, undistort_point
from slviewer.geometry.jit import kernel
from slviewer.geometry.rigid import Floats

POSE, HEIGHT, OFFSET, CAMERA, PROJECTOR, TURN, SHIFT, DENSE = 0, 6, 18, 20, 29, 38, 41, 44
"""Index of each group's first entry in a dense row, and the row's length."""
FIELD = 16
CAMERA_FIELD, PROJECTOR_FIELD, ROW = DENSE, DENSE + 2 * FIELD, DENSE + 4 * FIELD
"""Coefficients of one component of a field that reach a place; index of each field's first entry in
a whole row, behind the dense part; and the row's length."""


class PoseData(NamedTuple):
    """What was observed, all poses one after another.

    Of pose i, features ``feature_from[i] : feature_from[i + 1]``: ``feature`` (n,) their indices on
    the board, and ``feature_px`` (n, 2), their pixels; and samples ``sample_from[i] : ...``: camera
    pixels ``sample_px`` (m, 2), and ``projector_px`` (m, 2), their projector coordinates, NaN for
    an axis not captured. ``points`` (f, 3) mm and ``frame`` (4,) are the board's.
    """

    feature_from: np.ndarray
    feature: np.ndarray
    feature_px: Floats
    sample_from: np.ndarray
    sample_px: Floats
    projector_px: Floats
    points: Floats
    frame: Floats

    @property
    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """The pose of each feature (n,) and of each sample (m,)."""
        feature, sample = (
            np.repeat(np.arange(len(start) - 1), np.diff(start))
            for start in (self.feature_from, self.sample_from)
        )
        return feature, sample

    def means(self, features: Floats, samples: Floats) -> Floats:
        """Return the means (p, 2) over each pose of its features' values (n,) and its samples'
        (m,)."""
        means = []
        for values, pose in zip((features, samples), self.poses, strict=True):
            counts = np.bincount(pose, minlength=len(self.feature_from) - 1)
            means.append(np.bincount(pose, values, len(counts)) / np.maximum(counts, 1))
        return np.stack(means, axis=1)


class Workspace(NamedTuple):
    """Buffers of one thread for the kernels: ``row`` (2, ROW) holds the derivatives of an
    observation, ``by_field`` (2, 2) those of a sample by the camera's displacement, and ``cells``
    (2, 2) int the first column and row of the camera's and of the projector's field."""

    row: Floats
    by_field: Floats
    cells: np.ndarray
    camera_basis: Floats
    projector_basis: Floats
    by_point: Floats
    by_lens: Floats
    ray_by_lens: Floats
    ray_by_field: Floats
    terms: Floats
    local: Floats
    point: Floats
    turned: Floats
    normal: Floats
    by_pixel: Floats


@kernel()
def allocate_workspace():
    """Return a workspace of zeros."""
    return Workspace(
        np.zeros((2, ROW)), np.zeros((2, 2)), np.zeros((2, 2), np.int64),
        np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((2, 3)),
        np.zeros((2, 9)), np.zeros((2, 9)), np.zeros((2, 2)), np.zeros((3, HEIGHT_TERMS)),
        np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3),
    )  # fmt: skip


@kernel()
def _fill_pixel_by_lens(x, y, xd, yd, k, by_lens):
    """Fill ``by_lens`` (2, 9) with the derivatives of a pixel, before its displacement, by the
    lens's numbers ``k``.

    (x, y): the undistorted normalised point; (xd, yd): the distorted one.
    """
    r2 = x * x + y * y
    by_lens[:, :4] = 0.0
    by_lens[0, 0], by_lens[1, 1], by_lens[0, 2], by_lens[1, 3] = xd, yd, 1.0, 1.0
    power = r2
    for c in (4, 5, 8):
        by_lens[0, c], by_lens[1, c] = k[0] * x * power, k[1] * y * power
        power *= r2
    by_lens[0, 6], by_lens[1, 6] = k[0] * 2.0 * x * y, k[1] * (r2 + 2.0 * y * y)
    by_lens[0, 7], by_lens[1, 7] = k[0] * (r2 + 2.0 * x * x), k[1] * 2.0 * x * y


@kernel()
def fill_cross(a, b, scale, out):
    """Fill ``out`` (3,) with the cross product of a and b (3,), times ``scale``."""
    out[0] = scale * (a[1] * b[2] - a[2] * b[1])
    out[1] = scale * (a[2] * b[0] - a[0] * b[2])
    out[2] = scale * (a[0] * b[1] - a[1] * b[0])


@kernel()
def project_to_device(device, X, basis, by_point, by_lens, cell):
    """Return the pixel (u, v) of a point X (3,) in the device's frame.

    Fills ``by_point`` (2, 3), ``by_lens`` (2, 9) and the field's ``cell`` (2,); the derivative by
    the field's coefficients is ``basis``'s product.
    """
    k = device.numbers
    inverse = 1.0 / X[2]
    x, y = X[0] * inverse, X[1] * inverse
    if not (X[2] > 0.0 and x * x + y * y < k[9]):
        return np.nan, np.nan
    xd, yd, dxx, dxy, dyy = distort_point(x, y, k)
    u, v = k[0] * xd + k[2], k[1] * yd + k[3]
    du, dv, duu, duv, dvu, dvv, cell[0], cell[1] = displacement(device, u, v, basis)
    _fill_pixel_by_lens(x, y, xd, yd, k, by_lens)
    # d(u, v before displacement) by x, y
    ux, uy, vx, vy = k[0] * dxx, k[0] * dxy, k[1] * dxy, k[1] * dyy
    by_point[0, 0], by_point[0, 1] = ux * inverse, uy * inverse
    by_point[1, 0], by_point[1, 1] = vx * inverse, vy * inverse
    by_point[0, 2] = -(ux * x + uy * y) * inverse
    by_point[1, 2] = -(vx * x + vy * y) * inverse
    for row in (by_point, by_lens):
        for c in range(row.shape[1]):
            a, b = row[0, c], row[1, c]
            row[0, c] = (1.0 + duu) * a + duv * b
            row[1, c] = dvu * a + (1.0 + dvv) * b
    return u + du, v + dv


@kernel()
def undistort_ray(device, u, v, basis, by_lens, by_field, cell):
    """Return the undistorted normalised point (x, y) that a camera pixel sees.

    Fills ``by_lens`` (2, 9), ``by_field`` (2, 2), by a displacement along u and v where the field
    is evaluated, and the field's ``cell`` (2,).
    """

    k = device.numbers
    qu, qv = remove_displacement(device, u, v, basis)
    xd, yd = (qu - k[2]) / k[0], (qv - k[3]) / k[1]
    x, y = undistort_point(xd, yd, k)
    if not np.isfinite(x):
        return np.nan, np.nan
    _, _, duu, duv, dvu, dvv, cell[0], cell[1] = displacement(device, qu, qv, basis)
    _, _, dxx, dxy, dyy = distort_point(x, y, k)
    determinant = dxx * dyy - dxy * dxy
    ixx, ixy, iyy = dyy / determinant, -dxy / determinant, dxx / determinant
    _fill_pixel_by_lens(x, y, xd, yd, k, by_lens)
    for c in range(9):  # the point moves so that the pixel stays
        a, b = -by_lens[0, c] / k[0], -by_lens[1, c] / k[1]
        by_lens[0, c] = ixx * a + ixy * b
        by_lens[1, c] = ixy * a + iyy * b
    # q + W(q) = pixel: dq = -(1 + dW)^-1 dW's coefficients
    scale = -1.0 / ((1.0 + duu) * (1.0 + dvv) - duv * dvu)
    quu, quv, qvu, qvv = scale * (1.0 + dvv), -scale * duv, -scale * dvu, scale * (1.0 + duu)
    for c in range(2):
        a = (quu if c == 0 else quv) / k[0]
        b = (qvu if c == 0 else qvv) / k[1]
        by_field[0, c] = ixx * a + ixy * b
        by_field[1, c] = ixy * a + iyy * b
    return x, y


@kernel()
def feature_row(state, pose, points, frame, f, work):
    """Return the pixel (u, v) where the camera sees feature ``f`` of the board at a pose.

    Fills ``work.row`` but for the fields' part, and the camera's basis and cell.
    """
    R, t = state.R_board[pose], state.t_board[pose]
    x, y = points[f, 0] + state.offsets[f, 0], points[f, 1] + state.offsets[f, 1]
    z, zx, zy = height_at(x, y, frame, state.heights, work.terms)
    L, X, row = work.local, work.point, work.row
    for a in range(3):
        L[a] = dot_row(R, a, (x, y, z))
        X[a] = L[a] + t[a]
    u, v = project_to_device(
        state.rig.camera, X, work.camera_basis, work.by_point, work.by_lens, work.cells[0]
    )
    row[:] = 0.0
    if not np.isfinite(u):
        return u, v
    for k in range(2):
        by_point = work.by_point[k]
        # a turn w moves the point by w x L
        fill_cross(L, by_point, 1.0, row[k, POSE : POSE + 3])
        for a in range(3):
            row[k, POSE + 3 + a] = by_point[a]
        along = dot_column(R, 2, by_point)
        for c in range(HEIGHT_TERMS):
            row[k, HEIGHT + c] = along * work.terms[0, c]
        row[k, OFFSET] = dot_column(R, 0, by_point) + along * zx
        row[k, OFFSET + 1] = dot_column(R, 1, by_point) + along * zy
        for c in range(9):
            row[k, CAMERA + c] = work.by_lens[k, c]
    return u, v


@kernel()
def sample_row(state, pose, frame, pixel, work):
    """Return the pixel (u_p, v_p) where the projector lights what a camera ``pixel`` (2,) sees of
    the board at a pose.

    Fills ``work.row`` but for the fields' part, ``work.by_field``, and both bases and cells.
    """
    rig, R, t = state.rig, state.R_board[pose], state.t_board[pose]
    row, M, N = work.row, work.by_pixel, work.normal
    row[:] = 0.0
    x, y = undistort_ray(
        rig.camera, pixel[0], pixel[1], work.camera_basis, work.ray_by_lens, work.ray_by_field,
        work.cells[0],
    )  # fmt: skip
    ray = x, y, 1.0
    facing = dot_column(R, 2, ray)
    if not (np.isfinite(x) and facing != 0.0):
        return np.nan, np.nan
    s = dot_column(R, 2, t) / facing
    X, V, Y = work.point, work.turned, work.local
    # onto the bent surface: the bow is a thousandth of the distance, so this squares fast
    for _ in range(4):
        Y[0], Y[1], Y[2] = s * x - t[0], s * y - t[1], s - t[2]
        z, zx, zy = height_at(
            dot_column(R, 0, Y), dot_column(R, 1, Y), frame, state.heights, work.terms
        )
        for a in range(3):
            N[a] = R[a, 2] - R[a, 0] * zx - R[a, 1] * zy
        facing = N[0] * ray[0] + N[1] * ray[1] + N[2]
        error = dot_column(R, 2, Y) - z
        s -= error / facing
        if abs(error) < 1e-10:
            break
    # point s (x, y, 1), moved along the ray by the surface's motion, and across it by the ray's
    for a in range(3):
        V[a] = s * dot_row(rig.R, a, ray)
        X[a] = V[a] + rig.t[a]
    pu, pv = project_to_device(
        rig.projector, X, work.projector_basis, work.by_point, work.by_lens, work.cells[1]
    )
    if not np.isfinite(pu):
        return np.nan, np.nan
    for k in range(2):
        by_point = work.by_point[k]
        fill_cross(V, by_point, 1.0, row[k, TURN:SHIFT])
        for a in range(3):
            row[k, SHIFT + a] = by_point[a]
            M[a] = dot_column(rig.R, a, by_point)
        along = (M[0] * x + M[1] * y + M[2]) / facing
        fill_cross(Y, N, along, row[k, POSE : POSE + 3])
        for a in range(3):
            row[k, POSE + 3 + a] = along * N[a]
        for c in range(HEIGHT_TERMS):
            row[k, HEIGHT + c] = along * work.terms[0, c]
        ex, ey = s * (M[0] - along * N[0]), s * (M[1] - along * N[1])
        for c in range(9):
            row[k, CAMERA + c] = ex * work.ray_by_lens[0, c] + ey * work.ray_by_lens[1, c]
            row[k, PROJECTOR + c] = work.by_lens[k, c]
        for c in range(2):
            work.by_field[k, c] = ex * work.ray_by_field[0, c] + ey * work.ray_by_field[1, c]
    return pu, pv
