"""Derivatives of measured points by the rig's unknowns, which turn their covariance into the
cloud's."""

import numpy as np
import scipy.sparse as sp

from slviewer.calibration.splined.residuals import fill_cross, project_to_device, undistort_ray
from slviewer.calibration.splined.unknowns import LENS, RIG, State
from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis
from slviewer.geometry.jit import kernel

MAX_ENTRIES = RIG + 48
"""A row's unknowns: lenses, rotation and translation; 16 knots of either component of the camera's
field, 16 of one of the projector's."""


def compute_point_jacobian(
    state: State, axis: Axis, pixels: np.ndarray, z: np.ndarray
) -> sp.csr_matrix:
    """Compute the Jacobian (3 n, unknowns) described in ``Bundle.point_jacobian``."""
    pixels, z = np.ascontiguousarray(pixels, np.float64), np.ascontiguousarray(z, np.float64)
    if pixels.ndim != 2 or pixels.shape[1] != 2 or z.shape != pixels.shape[:1]:
        raise InputError(
            f"pixels {pixels.shape} and depths {z.shape} were given: (n, 2) and (n,) are needed"
        )
    if axis not in ("x", "y"):
        raise InputError(
            f"the axis {axis!r} was given: it must be 'x' (projector columns) or 'y' (rows)"
        )
    at = state.layout
    starts = np.array([at.camera_field - at.rig, at.projector_field - at.rig], np.int64)
    values, columns = np.zeros((len(z), 3, MAX_ENTRIES)), np.zeros((len(z), MAX_ENTRIES), np.int64)
    _fill_rows(state.rig, 0 if axis == "x" else 1, pixels, z, starts, values, columns)
    indices = np.repeat(columns, 3, axis=0).ravel()
    pointers = np.arange(0, 3 * len(z) + 1) * MAX_ENTRIES
    return sp.csr_matrix((values.ravel(), indices, pointers), (3 * len(z), at.size - at.rig))


@kernel()
def _fill_rows(rig, row, pixels, depths, starts, values, columns):
    """Fill ``values`` (n, 3, MAX_ENTRIES) and ``columns`` (n, MAX_ENTRIES) of the points' sparse
    Jacobian."""
    basis, other = np.zeros((4, 4)), np.zeros((4, 4))
    by_point, by_lens = np.zeros((2, 3)), np.zeros((2, 9))
    ray_by_lens, ray_by_field = np.zeros((2, 9)), np.zeros((2, 2))
    X, V, m, by_turn = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    stride, across = rig.camera.coefficients.shape[2], rig.projector.coefficients.shape[2]
    knots, others = (
        stride * rig.camera.coefficients.shape[1],
        across * rig.projector.coefficients.shape[1],
    )
    for n in range(depths.shape[0]):
        z = depths[n]
        x, y, ci, cj = undistort_ray(
            rig.camera, pixels[n, 0], pixels[n, 1], basis, ray_by_lens, ray_by_field
        )
        for a in range(3):
            V[a] = z * (rig.R[a, 0] * x + rig.R[a, 1] * y + rig.R[a, 2])
            X[a] = V[a] + rig.t[a]
        u, _, pi, pj = project_to_device(rig.projector, X, other, by_point, by_lens)
        if not (np.isfinite(u) and np.isfinite(x)):
            values[n] = np.nan
            continue
        p = by_point[row]
        for a in range(3):
            m[a] = p[0] * rig.R[0, a] + p[1] * rig.R[1, a] + p[2] * rig.R[2, a]
        # the coordinate stays what was measured: dz (m . ray) = -(its change at fixed depth)
        per_z = -1.0 / (m[0] * x + m[1] * y + m[2])
        for c in range(RIG):
            columns[n, c] = c
        for c in range(LENS):
            dx, dy = ray_by_lens[0, c], ray_by_lens[1, c]
            dz = per_z * z * (m[0] * dx + m[1] * dy)
            values[n, 0, c], values[n, 1, c], values[n, 2, c] = x * dz + z * dx, y * dz + z * dy, dz
            _depth_direction(values[n], LENS + c, x, y, per_z * by_lens[row, c])
        fill_cross(V, p, per_z, by_turn)
        for a in range(3):
            _depth_direction(values[n], 2 * LENS + a, x, y, by_turn[a])
            _depth_direction(values[n], 2 * LENS + 3 + a, x, y, per_z * p[a])
        for a in range(4):
            for b in range(4):
                k, spline = 4 * a + b, basis[2, a] * basis[0, b]
                for component in range(2):
                    dx, dy = (
                        ray_by_field[0, component] * spline,
                        ray_by_field[1, component] * spline,
                    )
                    dz = per_z * z * (m[0] * dx + m[1] * dy)
                    c = RIG + 16 * component + k
                    columns[n, c] = starts[0] + component * knots + (cj + a) * stride + ci + b
                    values[n, 0, c], values[n, 1, c], values[n, 2, c] = (
                        x * dz + z * dx,
                        y * dz + z * dy,
                        dz,
                    )
                columns[n, RIG + 32 + k] = starts[1] + row * others + (pj + a) * across + pi + b
                _depth_direction(values[n], RIG + 32 + k, x, y, per_z * other[2, a] * other[0, b])


@kernel()
def _depth_direction(values, column, x, y, dz):
    """A change of depth alone moves the point along its ray."""
    values[0, column], values[1, column], values[2, column] = x * dz, y * dz, dz
