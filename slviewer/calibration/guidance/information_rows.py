"""Information of a pose on the rig: whitened rows of derivatives, with the pose itself projected out."""

import numpy as np

from slviewer.calibration.splined.board_shape import HEIGHT_TERMS
from slviewer.calibration.splined.normal import Workspace
from slviewer.calibration.splined.residuals import DENSE, HEIGHT, OFFSET, feature_row, sample_row
from slviewer.calibration.splined.unknowns import RIG, Arrangement, UnknownLayout
from slviewer.geometry.jit import kernel

POSE = HEIGHT
"""Unknowns of a pose; they lead every row."""


def pose_rows(
    rig: Arrangement,
    layout: UnknownLayout,
    T_camera_board: np.ndarray,
    points: np.ndarray,
    frame: np.ndarray,
    pixels: np.ndarray,
    sigma_px: tuple[float, float],
) -> np.ndarray:
    """(rows, unknowns): what a flat board at a pose tells of everything but the pose, each row in sigmas.

    ``points`` (f, 3) mm: the board's features, each seen with the first of ``sigma_px``; ``frame``: their rectangle;
    ``pixels`` (m, 2): camera pixels on the board, whose projector coordinates are known with the second. ``layout``
    is of no poses. What is not seen tells nothing.
    """
    R, t = np.ascontiguousarray(T_camera_board[:3, :3]), np.ascontiguousarray(T_camera_board[:3, 3])
    rows = np.zeros((2 * (len(points) + len(pixels)), POSE + layout.size))
    at = np.array([layout.height, layout.offsets, layout.rig, layout.camera_field, layout.projector_field]) + POSE
    pixels = np.ascontiguousarray(pixels, np.float64)
    _fill_rows(rig, R, t, points, frame, pixels, 1.0 / sigma_px[0], 1.0 / sigma_px[1], at, rows)
    basis, _ = np.linalg.qr(rows[:, :POSE])
    told = rows[:, POSE:]
    return np.asarray(told - basis @ (basis.T @ told))


@kernel()
def _fill_rows(rig, R, t, points, frame, pixels, feature_weight, sample_weight, at, rows):
    work = Workspace(
        np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((2, 3)), np.zeros((2, 9)), np.zeros((2, 9)), np.zeros((2, 2)),
        np.zeros((3, HEIGHT_TERMS)), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3),
    )  # fmt: skip
    row, by_field = np.zeros((2, DENSE)), np.zeros((2, 2))
    heights, nowhere = np.zeros(HEIGHT_TERMS), np.zeros(2)
    stride, across = rig.camera.coefficients.shape[2], rig.projector.coefficients.shape[2]
    knots, others = stride * rig.camera.coefficients.shape[1], across * rig.projector.coefficients.shape[1]
    for n in range(points.shape[0]):
        u, _, ci, cj = feature_row(rig, R, t, heights, frame, points[n], nowhere, work, row)
        if not np.isfinite(u):
            continue
        for k in range(2):
            out = rows[2 * n + k]
            _dense_rows(out, row[k], feature_weight, at)
            for c in range(2):
                out[at[1] + 2 * n + c] = feature_weight * row[k, OFFSET + c]
            _field_rows(out, feature_weight, work.camera_basis, at[3] + k * knots + cj * stride + ci, stride)
    for n in range(pixels.shape[0]):
        u, _, ci, cj, pi, pj = sample_row(rig, R, t, heights, frame, pixels[n, 0], pixels[n, 1], work, row, by_field)
        if not np.isfinite(u):
            continue
        for k in range(2):
            out = rows[2 * (points.shape[0] + n) + k]
            _dense_rows(out, row[k], sample_weight, at)
            for c in range(2):
                start = at[3] + c * knots + cj * stride + ci
                _field_rows(out, sample_weight * by_field[k, c], work.camera_basis, start, stride)
            _field_rows(out, sample_weight, work.projector_basis, at[4] + k * others + pj * across + pi, across)


@kernel()
def _dense_rows(out, row, weight, at):
    """Pose, height, and the rig's numbers."""
    for c in range(HEIGHT):
        out[c] = weight * row[c]
    for c in range(HEIGHT_TERMS):
        out[at[0] + c] = weight * row[HEIGHT + c]
    for c in range(RIG):
        out[at[2] + c] = weight * row[OFFSET + 2 + c]


@kernel()
def _field_rows(out, weight, basis, start, stride):
    for a in range(4):
        for b in range(4):
            out[start + a * stride + b] += weight * basis[2, a] * basis[0, b]
