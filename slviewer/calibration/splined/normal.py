"""The normal equations, summed pose by pose from rows that are never stored."""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numba
import numpy as np

from slviewer.calibration.splined.board_shape import HEIGHT_TERMS
from slviewer.calibration.splined.residuals import CAMERA, DENSE, HEIGHT, OFFSET, PROJECTOR, feature_row, sample_row
from slviewer.calibration.splined.unknowns import RIG, State
from slviewer.geometry.jit import kernel

MAX_LANES = 4
"""Largest number of matrices that threads fill in parallel; each has the size of the whole."""
_ROWS_ADDED = 128  # of two matrices at a time


class PoseData(NamedTuple):
    """What was observed, all poses one after another.

    Of pose i, features ``feature_from[i] : feature_from[i + 1]``: ``feature`` (n,) their indices on the board, and
    ``feature_px`` (n, 2), their pixels; and samples ``sample_from[i] : ...``: camera pixels ``sample_px`` (m, 2), and
    ``projector_px`` (m, 2), their projector coordinates, NaN for an axis not captured. ``points`` (f, 3) mm
    and ``frame`` (4,) are the board's.
    """

    feature_from: np.ndarray
    feature: np.ndarray
    feature_px: np.ndarray
    sample_from: np.ndarray
    sample_px: np.ndarray
    projector_px: np.ndarray
    points: np.ndarray
    frame: np.ndarray


class Workspace(NamedTuple):
    """Buffers of one thread for the kernels of ``residuals``."""

    camera_basis: np.ndarray
    projector_basis: np.ndarray
    by_point: np.ndarray
    by_lens: np.ndarray
    ray_by_lens: np.ndarray
    ray_by_field: np.ndarray
    terms: np.ndarray
    local: np.ndarray
    point: np.ndarray
    turned: np.ndarray
    normal: np.ndarray


@kernel()
def allocate_workspace():
    """Return a workspace of zeros."""
    return Workspace(
        np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((2, 3)), np.zeros((2, 9)), np.zeros((2, 9)), np.zeros((2, 2)),
        np.zeros((3, HEIGHT_TERMS)), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3),
    )  # fmt: skip


def predict_observations(state: State, data: PoseData) -> tuple[np.ndarray, np.ndarray]:
    """Predict the features (n, 2) px and the samples' projector coordinates (m, 2) px; NaN where not visible."""
    features, samples = np.empty_like(data.feature_px), np.empty_like(data.sample_px)
    model = state.rig, state.R_board, state.t_board, state.heights, state.offsets
    shares = _split_poses(state.layout.poses)
    with ThreadPoolExecutor(len(shares)) as threads:
        list(threads.map(lambda poses: _predict(*model, data, poses, features, samples), shares))
    return features, samples


def normal_equations(
    state: State, data: PoseData, residuals: tuple[np.ndarray, np.ndarray], weights: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return J'WJ (N, N), of which the upper triangle is filled, and J'W r (N,).

    ``residuals`` and ``weights``: of features (n, 2), and of samples (m, 2); what weighs 0 may be NaN.
    """
    layout = state.layout
    shares = _split_poses(layout.poses)
    matrices = [np.zeros((layout.size, layout.size)) for _ in shares]
    right = np.zeros((len(shares), layout.size))
    at = np.array(
        [layout.height, layout.offsets, layout.rig, layout.camera_field, layout.projector_field, layout.size], np.int64
    )
    model = state.rig, state.R_board, state.t_board, state.heights, state.offsets
    with ThreadPoolExecutor(len(shares)) as threads:
        list(
            threads.map(
                lambda poses, A, b: _accumulate(*model, data, *residuals, *weights, at, poses, A, b),
                shares, matrices, right,
            )
        )  # fmt: skip
    for first in range(0, layout.size, _ROWS_ADDED):
        upper = np.s_[first : first + _ROWS_ADDED, first:]
        for other in matrices[1:]:
            matrices[0][upper] += other[upper]
    return matrices[0], right.sum(0)


def _split_poses(poses: int) -> list[np.ndarray]:
    """The poses of each thread: a kernel's parallel loops take no structures."""
    lanes = max(1, min(MAX_LANES, numba.get_num_threads(), poses))
    return [np.arange(lane, poses, lanes) for lane in range(lanes)]


@kernel()
def _predict(rig, R, t, heights, offsets, data, poses, features, samples):
    """Fill the predicted ``features`` (n, 2) and ``samples`` (m, 2) px of some poses."""
    work = allocate_workspace()
    row, by_field = np.zeros((2, DENSE)), np.zeros((2, 2))
    for i in poses:
        for n in range(data.feature_from[i], data.feature_from[i + 1]):
            f = data.feature[n]
            u, v, _, _ = feature_row(rig, R[i], t[i], heights, data.frame, data.points[f], offsets[f], work, row)
            features[n, 0], features[n, 1] = u, v
        for n in range(data.sample_from[i], data.sample_from[i + 1]):
            px = data.sample_px[n]
            u, v, _, _, _, _ = sample_row(rig, R[i], t[i], heights, data.frame, px[0], px[1], work, row, by_field)
            samples[n, 0], samples[n, 1] = u, v


@kernel()
def _accumulate(rig, R, t, heights, offsets, data, feature_r, sample_r, feature_w, sample_w, at, poses, A, b):
    """Add the observations of some ``poses`` to the normal matrix A (upper triangle) and the right-hand side b."""
    work = allocate_workspace()
    row, by_field = np.zeros((2, DENSE)), np.zeros((2, 2))
    columns = np.empty(DENSE, np.int64)  # of a row's entries, in the order of the vector
    for c in range(HEIGHT_TERMS):
        columns[HEIGHT + c] = at[0] + c
    for c in range(RIG):
        columns[CAMERA + c] = at[2] + c
    for i in poses:
        for c in range(HEIGHT):
            columns[c] = 6 * i + c
        for n in range(data.feature_from[i], data.feature_from[i + 1]):
            w0, w1 = feature_w[n, 0], feature_w[n, 1]
            if w0 > 0.0 or w1 > 0.0:
                f, r = data.feature[n], feature_r[n]
                _, _, ci, cj = feature_row(rig, R[i], t[i], heights, data.frame, data.points[f], offsets[f], work, row)
                columns[OFFSET], columns[OFFSET + 1] = at[1] + 2 * f, at[1] + 2 * f + 1
                _add_dense(A, b, row, columns, PROJECTOR, w0, w1, r)
                _add_field(A, b, row, columns, PROJECTOR, w0, w1, r, rig.camera, ci, cj, work.camera_basis, at[3])
        columns[OFFSET], columns[OFFSET + 1] = at[1], at[1] + 1  # a sample's row has zeros there
        for n in range(data.sample_from[i], data.sample_from[i + 1]):
            w0, w1 = sample_w[n, 0], sample_w[n, 1]
            if w0 > 0.0 or w1 > 0.0:
                px, r = data.sample_px[n], sample_r[n]
                _, _, ci, cj, pi, pj = sample_row(
                    rig, R[i], t[i], heights, data.frame, px[0], px[1], work, row, by_field
                )
                _add_dense(A, b, row, columns, DENSE, w0, w1, r)
                _add_field(A, b, row, columns, DENSE, w0, w1, r, rig.projector, pi, pj, work.projector_basis, at[4])
                _add_through(A, b, row, columns, w0, w1, r, rig, ci, cj, pi, pj, by_field, work, at)


@kernel()
def _add_dense(A, b, row, columns, length, w0, w1, r):
    """Rows u and v against themselves."""
    r0, r1 = (r[0] if w0 > 0.0 else 0.0), (r[1] if w1 > 0.0 else 0.0)
    for a in range(length):
        p, q = w0 * row[0, a], w1 * row[1, a]
        if p == 0.0 and q == 0.0:
            continue
        target = A[columns[a]]
        b[columns[a]] += p * r0 + q * r1
        for c in range(a, length):
            target[columns[c]] += p * row[0, c] + q * row[1, c]


@kernel()
def _add_field(A, b, row, columns, length, w0, w1, r, device, i, j, basis, start):
    """Add the field of the device that observes the residual: u's coefficients are in row u alone, v's in row v."""
    stride = device.coefficients.shape[2]
    knots = stride * device.coefficients.shape[1]
    for k in range(2):
        w = w0 if k == 0 else w1
        if not w > 0.0:
            continue
        first = start + k * knots + j * stride + i
        for a in range(length):
            value = w * row[k, a]
            if value != 0.0:
                target = A[columns[a]]
                for m in range(4):
                    scaled = value * basis[2, m]
                    at = first + m * stride
                    for n in range(4):
                        target[at + n] += scaled * basis[0, n]
        for m in range(4):
            for n in range(4):
                one = first + m * stride + n
                value = w * basis[2, m] * basis[0, n]
                b[one] += value * r[k]
                target = A[one]
                for c in range(m, 4):
                    scaled = value * basis[2, c]
                    at = first + c * stride
                    for d in range(n if c == m else 0, 4):
                        target[at + d] += scaled * basis[0, d]


@kernel()
def _add_through(A, b, row, columns, w0, w1, r, rig, ci, cj, pi, pj, by_field, work, at):
    """The camera's field, through which both of a sample's rows look; against itself and the projector's field."""
    basis, other = work.camera_basis, work.projector_basis
    stride, across = rig.camera.coefficients.shape[2], rig.projector.coefficients.shape[2]
    knots, others = stride * rig.camera.coefficients.shape[1], across * rig.projector.coefficients.shape[1]
    r0, r1 = (r[0] if w0 > 0.0 else 0.0), (r[1] if w1 > 0.0 else 0.0)
    for k in range(2):  # component of the camera's field
        p, q = w0 * by_field[0, k], w1 * by_field[1, k]
        first = at[3] + k * knots + cj * stride + ci
        for a in range(DENSE):
            value = p * row[0, a] + q * row[1, a]
            if value != 0.0:
                target = A[columns[a]]
                for m in range(4):
                    scaled = value * basis[2, m]
                    for n in range(4):
                        target[first + m * stride + n] += scaled * basis[0, n]
        pull = p * r0 + q * r1
        for m in range(4):
            for n in range(4):
                one = first + m * stride + n
                value = basis[2, m] * basis[0, n]
                b[one] += pull * value
                target = A[one]
                for other_k in range(k, 2):
                    coupling = (p * by_field[0, other_k] + q * by_field[1, other_k]) * value
                    start = at[3] + other_k * knots + cj * stride + ci
                    for c in range(m if other_k == k else 0, 4):
                        scaled = coupling * basis[2, c]
                        for d in range(n if (other_k == k and c == m) else 0, 4):
                            target[start + c * stride + d] += scaled * basis[0, d]
                for other_k in range(2):
                    coupling = (p if other_k == 0 else q) * value
                    if coupling != 0.0:
                        start = at[4] + other_k * others + pj * across + pi
                        for c in range(4):
                            scaled = coupling * other[2, c]
                            for d in range(4):
                                target[start + c * across + d] += scaled * other[0, d]
