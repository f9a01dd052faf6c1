"""Information of target poses on the rig: the uncertainty in the working volume, and the gain of
one more pose."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, eigh, solve_triangular

from slviewer.calibration.guidance.coarse_rig import BOARD_SAMPLES, GuidanceModel
from slviewer.calibration.splined.board_shape import HEIGHT_TERMS
from slviewer.calibration.splined.normal import (
    ROW,
    allocate_workspace,
    dense_columns,
    fill_feature_fields,
    fill_sample_fields,
    set_feature_columns,
    set_sample_columns,
)
from slviewer.calibration.splined.posterior import compute_point_jacobian
from slviewer.calibration.splined.residuals import HEIGHT, feature_row, sample_row
from slviewer.calibration.splined.volume import (
    Volume,
    remove_rigid_motion,
    select_depth_axis,
    working_volume,
)
from slviewer.geometry.jit import kernel
from slviewer.geometry.rigid import Floats
from slviewer.geometry.vectors import finite_rows

NEGLIGIBLE = 1e-4
"""Share of the points' mean variance that gains neglect."""
POSE = HEIGHT
"""Number of a pose's unknowns; they come first in every row."""


@dataclass(frozen=True, eq=False)
class VolumeSensitivity:
    """Points of the working volume and the Jacobian (3 m, unknowns) of their errors, less their
    common rigid motion."""

    volume: Volume
    jacobian: Floats

    @classmethod
    def from_model(
        cls, model: GuidanceModel, depths_mm: tuple[float, float]
    ) -> "VolumeSensitivity":
        """Compute the Jacobian of a regular grid of points; ``depths_mm``: nearest and farthest
        board."""
        volume = working_volume(model.rig, depths_mm)
        by_rig = compute_point_jacobian(
            model.state, select_depth_axis(model.rig, volume), volume.pixels, volume.z
        ).toarray()
        known = finite_rows(by_rig.reshape(len(volume.z), -1))
        volume = Volume(
            volume.pixels[known], volume.z[known], volume.points[known], volume.projector[known]
        )
        by_rig = by_rig.reshape(len(known), 3, -1)[known].reshape(3 * len(volume.z), -1)
        jacobian = np.zeros((len(by_rig), model.layout.size))
        jacobian[:, model.layout.rig :] = remove_rigid_motion(by_rig.T, volume.points).T
        return cls(volume, jacobian)


@dataclass(frozen=True, eq=False)
class RigInformation:
    """Uncertainty of the rig after some poses.

    ``variances`` (m,) mm^2 of the volume's points. ``modes`` (n, n) float32: a factor of the
    unknowns' covariance, ``modes @ modes.T``, whose columns act on the volume independently of each
    other and with increasing effect; ``mode_rms_mm`` (k,) float32: RMS error over the volume's
    points by each of the last k modes.
    """

    variances: Floats
    modes: NDArray[np.float32]
    mode_rms_mm: NDArray[np.float32]

    @classmethod
    def from_rows(
        cls, model: GuidanceModel, rows: Sequence[Floats], sensitivity: VolumeSensitivity
    ) -> "RigInformation":
        """Combine the prior with the rows of each pose (see ``information_rows``)."""
        A = model.prior()
        if len(rows):
            J = np.concatenate(rows)
            A += J.T @ J
        scale = 1.0 / np.sqrt(np.diag(A))
        L = cholesky(A * scale * scale[:, None], lower=True, check_finite=False)
        factor = solve_triangular(L, np.diag(scale), lower=True, check_finite=False).T
        errors = sensitivity.jacobian @ factor
        variances = (errors**2).sum(axis=1).reshape(-1, 3).sum(axis=1)
        mode_variances, rotation = eigh(errors.T @ errors / len(variances), check_finite=False)
        mode_variances = np.maximum(mode_variances, 0.0)
        count = int((np.cumsum(mode_variances) > NEGLIGIBLE * mode_variances.sum()).sum())
        mode_rms = np.sqrt(mode_variances[-count:])
        return cls(variances, (factor @ rotation).astype(np.float32), mode_rms.astype(np.float32))

    @property
    def sigma_mm(self) -> float:
        """3D standard deviation of the volume's points, RMS over the volume."""
        return float(np.sqrt(self.variances.mean()))

    def gain(self, rows: Floats) -> float:
        """Return the decrease in mm^2 of the points' mean variance by one more pose with these
        information rows."""
        by_mode = rows.astype(np.float32) @ self.modes
        inner = (by_mode @ by_mode.T).astype(np.float64)
        inner[np.diag_indices(len(inner))] += 1.0
        weighted = by_mode[:, -len(self.mode_rms_mm) :] * self.mode_rms_mm
        L = cholesky(inner, lower=True, check_finite=False)
        return float(
            (
                solve_triangular(L, weighted.astype(np.float64), lower=True, check_finite=False)
                ** 2
            ).sum()
        )


def information_rows(model: GuidanceModel, T_camera_board: Floats) -> list[Floats]:
    """Compute the information of a flat board at each pose (k, 4, 4) mm on all unknowns but the
    pose itself.

    Returns J (rows, unknowns) of each pose: derivatives of features and samples over their standard
    deviations, with the pose projected out, so that J.T @ J is the information. Rows of what a
    device does not see are 0.
    """
    at = model.layout
    starts = at.starts + POSE
    widths = model.stereo.camera.size[0], model.stereo.projector.size[0]
    feature_sigma = model.expected.feature * widths[0] / np.sqrt(model.features_per_point)
    information = []
    for T, pixels in zip(T_camera_board, model.sample_pixels(T_camera_board), strict=True):
        sample_sigma = (
            model.expected.sample * widths[1] / np.sqrt(BOARD_SAMPLES / max(len(pixels), 1))
        )
        R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
        rows = np.zeros((2 * (len(model.points) + len(pixels)), POSE + at.size))
        pixels = np.ascontiguousarray(pixels)
        weights = 1.0 / feature_sigma, 1.0 / sample_sigma
        _fill_rows(model.rig, R, t, model.points, model.frame, pixels, *weights, starts, rows)
        basis, _ = np.linalg.qr(rows[:, :POSE])
        by_others = rows[:, POSE:]
        information.append(by_others - basis @ (basis.T @ by_others))
    return information


@kernel()
def _fill_rows(rig, R, t, points, frame, pixels, feature_weight, sample_weight, at, rows):
    """Fill ``rows`` with the weighted derivatives of a board's features (two rows each), then of
    its sample pixels.

    ``at``: indices at which height, offsets, rig, camera field and projector field start in a row.
    """
    work, row, by_field, cells = (
        allocate_workspace(),
        np.zeros((2, ROW)),
        np.zeros((2, 2)),
        np.zeros(4, np.int64),
    )
    heights, nowhere = np.zeros(HEIGHT_TERMS), np.zeros(2)
    columns = dense_columns(at)
    columns[:POSE] = np.arange(POSE)
    for n in range(points.shape[0]):
        u, _, ci, cj = feature_row(rig, R, t, heights, frame, points[n], nowhere, work, row)
        if np.isfinite(u):
            set_feature_columns(columns, rig, n, ci, cj, at)
            fill_feature_fields(row, work)
            _scatter_row(row, columns, feature_weight, rows[2 * n : 2 * n + 2])
    samples = rows[2 * points.shape[0] :]
    for n in range(pixels.shape[0]):
        u, _, ci, cj, pi, pj = sample_row(
            rig, R, t, heights, frame, pixels[n, 0], pixels[n, 1], work, row, by_field
        )
        if np.isfinite(u):
            cells[0], cells[1], cells[2], cells[3] = ci, cj, pi, pj
            set_sample_columns(columns, rig, cells, at)
            fill_sample_fields(row, work, by_field)
            _scatter_row(row, columns, sample_weight, samples[2 * n : 2 * n + 2])


@kernel()
def _scatter_row(row, columns, weight, out):
    """Add the weighted derivatives (2, ROW) of an observation to full rows (2, unknowns), each to
    its column."""
    for k in range(2):
        for c in range(ROW):
            out[k, columns[c]] += weight * row[k, c]
