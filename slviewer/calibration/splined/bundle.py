"""The result of the joint adjustment: the estimated unknowns, their information matrix, and the
derivatives of measured points by the rig's unknowns, which turn their covariance into the
cloud's."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from slviewer.calibration.known_camera import CameraCheck
from slviewer.calibration.splined.normal import (
    dense_columns,
    fill_sample_fields,
    set_sample_columns,
)
from slviewer.calibration.splined.residual_noise import Noise
from slviewer.calibration.splined.residuals import (
    CAMERA,
    CAMERA_FIELD,
    FIELD,
    HEIGHT,
    ROW,
    allocate_workspace,
    sample_row,
)
from slviewer.calibration.splined.unknowns import HEIGHT_TERMS, LENS, State
from slviewer.fringe.image_area import ImageArea
from slviewer.fringe.sequence import Axis
from slviewer.geometry.jit import kernel
from slviewer.geometry.rigid import Floats, Floats32, Mask
from slviewer.geometry.vectors import box_middle


@dataclass(frozen=True)
class PoseFit:
    """Residuals of one pose: RMS px of its features in the camera and of its samples in the
    projector, without outliers, the trust in each, 0 ... 1, which undisturbed poses have of 0.8 or
    more, and the RMS px of the pattern in each, as `shared_rms` returns it."""

    camera_rms_px: float
    projector_rms_px: float
    camera_trust: float
    projector_trust: float
    camera_pattern_px: float = 0.0
    projector_pattern_px: float = 0.0


@dataclass(frozen=True, eq=False)
class Bundle:
    """Result of the joint adjustment of ``poses``.

    ``points`` (f, 3) mm: the board's features, without the offsets in the state. ``strengths``
    1/px^2: of the camera's and the projector's prior. ``excluded``: poses not used, with the
    reason. ``camera_poses`` and ``projector_poses``: how many poses illuminated each cell of the
    fields (rows, columns). ``half_turned_poses``: poses whose numbering was corrected by half a
    turn. ``camera``: of one that was held, how the poses agree with it. ``area``: the part of the
    camera's image that changes, all of it if None.

    ``packed_factor``: the lower triangle of ``factor``, row by row, float32.
    """

    state: State
    poses: tuple[str, ...]
    points: Floats
    noise: Noise
    strengths: tuple[float, float]
    fits: Mapping[str, PoseFit]
    excluded: Mapping[str, str]
    depth_range_mm: tuple[float, float]
    camera_poses: np.ndarray
    projector_poses: np.ndarray
    packed_factor: Floats32
    steps: int
    half_turned_poses: tuple[str, ...] = ()
    camera: CameraCheck | None = None
    area: ImageArea | None = None

    @cached_property
    def factor(self) -> Floats32:
        """(n, n) float32, lower triangular: factor @ factor.T is the information (inverse
        covariance) of the rig's n unknowns in the order of ``UnknownLayout`` from ``rig`` on, with
        poses and board marginalised out.
        """
        layout = self.state.layout
        n = layout.size - layout.rig
        factor = np.zeros((n, n), np.float32)
        factor[np.tri(n, dtype=bool)] = self.packed_factor
        return factor

    @property
    def illuminated(self) -> tuple[Mask, Mask]:
        """Cells (rows, columns) bool of the camera's and of the projector's field that target poses
        illuminated."""
        return self.camera_poses > 0, self.projector_poses > 0

    def numbered_points(self, pose: str, points: Floats) -> Floats:
        """Return a pose's features (n, 3) mm as the adjustment numbers them: from the board's other
        end where it turned the pose."""
        is_turned = pose in self.half_turned_poses
        return 2 * box_middle(self.points) - points if is_turned else points

    def point_jacobian(self, axis: Axis, pixels: Floats, z: Floats) -> "scipy.sparse.csr_matrix":
        """Return the Jacobian (3 n, unknowns) of measured points, mm per unit of the rig's
        unknowns.

        The points are those at camera ``pixels`` (n, 2) and depths ``z`` (n,) mm, measured from the
        phase of one axis; rows: x, y, z of the first point, then of the next. NaN where the
        projector cannot see the point.
        """
        return compute_point_jacobian(self.state, axis, pixels, z)

    def whiten(self, jacobian: "scipy.sparse.csr_matrix | np.ndarray") -> np.ndarray:
        """Return Y (unknowns, m), where Y.T @ Y is the covariance of the values with ``jacobian``
        (m, unknowns)."""
        dense = jacobian if isinstance(jacobian, np.ndarray) else jacobian.toarray()
        right = np.asarray(dense, self.factor.dtype).T
        return scipy.linalg.solve_triangular(self.factor, right, lower=True, check_finite=False)


def compute_point_jacobian(
    state: State, axis: Axis, pixels: Floats, z: Floats
) -> "scipy.sparse.csr_matrix":
    """Compute the Jacobian (3 n, unknowns) described in ``Bundle.point_jacobian``."""
    pixels, z = np.ascontiguousarray(pixels, np.float64), np.ascontiguousarray(z, np.float64)
    at, entries = state.layout, ROW - CAMERA
    values, columns = np.zeros((len(z), 3, entries)), np.zeros((len(z), entries), np.int64)
    plane = State(state.rig, np.eye(3)[None], np.zeros((1, 3)), np.zeros(HEIGHT_TERMS), z[:0, None])
    _fill_rows(plane, "xy".index(axis), pixels, z, at.starts - at.rig, values, columns)
    indices = np.repeat(columns, 3, axis=0).ravel()
    pointers = np.arange(0, 3 * len(z) + 1) * entries
    return scipy.sparse.csr_matrix(
        (values.ravel(), indices, pointers), (3 * len(z), at.size - at.rig)
    )


@kernel()
def _fill_rows(plane, axis, pixels, depths, at, values, columns):
    """Fill ``values`` (n, 3, entries) and ``columns`` (n, entries) of the points' sparse Jacobian.

    Each point is seen on a ``plane`` that faces the camera. Its depth changes so that the
    projector's coordinate stays what was measured.
    """
    work, frame = allocate_workspace(), np.array([0.0, 0.0, 1.0, 1.0])
    all_columns = dense_columns(at)
    for n in range(depths.shape[0]):
        z = plane.t_board[0, 2] = depths[n]
        u, _ = sample_row(plane, 0, frame, pixels[n], work)
        dx, dy, dz = values[n, 0], values[n, 1], values[n, 2]
        if not np.isfinite(u):
            for c in range(dz.size):
                dx[c] = dy[c] = dz[c] = np.nan
            continue
        fill_sample_fields(work)
        set_sample_columns(all_columns, plane.rig, work.cells, at)
        x, y = work.local[0] / z, work.local[1] / z
        row = work.row[axis]
        for c in range(dz.size):
            columns[n, c] = all_columns[CAMERA + c]
            dz[c] = -row[CAMERA + c] / row[HEIGHT - 1]  # over the change by a shift along z
            dx[c], dy[c] = x * dz[c], y * dz[c]
        for c in range(LENS):  # the ray changes too
            dx[c] += z * work.ray_by_lens[0, c]
            dy[c] += z * work.ray_by_lens[1, c]
        for k in range(2 * FIELD):
            basis, component = work.camera_basis, k // FIELD
            spline = z * basis[2, k % FIELD // 4] * basis[0, k % 4]
            dx[CAMERA_FIELD - CAMERA + k] += spline * work.ray_by_field[0, component]
            dy[CAMERA_FIELD - CAMERA + k] += spline * work.ray_by_field[1, component]
