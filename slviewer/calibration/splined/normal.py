"""The normal equations, summed pose by pose from rows that are never stored, the prior of the
unknowns, normal distributions that regularise the adjustment, and the equations' factor."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numba
import numpy as np
import scipy.linalg

from slviewer.calibration.splined.residuals import (
    CAMERA,
    CAMERA_FIELD,
    FIELD,
    HEIGHT,
    OFFSET,
    PROJECTOR_FIELD,
    ROW,
    PoseData,
    allocate_workspace,
    feature_row,
    sample_row,
)
from slviewer.calibration.splined.unknowns import (
    GAUGE,
    GAUGE_PX,
    HEIGHT_SIGMA,
    HEIGHT_TERMS,
    OFFSET_SIGMA,
    RIG,
    State,
    UnknownLayout,
    offset_gauge,
    roughness,
)
from slviewer.errors import CalibrationRejected
from slviewer.geometry.jit import kernel, run_rows
from slviewer.geometry.rigid import Floats
from slviewer.geometry.vectors import diagonal

MAX_LANES = 4
"""Largest number of matrices that threads fill in parallel; each has the size of the whole."""
_ROWS_ADDED = 128  # of two matrices at a time
POSE_SIGMA = np.array([1.0, 1.0, 1.0, 4.0, 4.0, 4.0])
"""rad, and over the board's diagonal: holds a pose that was excluded as a whole."""
FIRST_STRENGTH = 10.0
"""Initial strength of the fields' priors in 1/px^2: displacements of some tenths of a pixel."""
PROBES = 24
"""Random vectors that estimate a trace: to a percent of it."""
STRENGTH_BOUNDS = (1e-1, 1e6)
"""Bounds of a prior's strength, 1/px^2: a field of px and no prior, or no field."""


ObservedValues = tuple[Floats, Floats]
"""A value of each coordinate of all features, (n, 2), and of all samples, (m, 2)."""


class Sums(NamedTuple):
    """Sums of one thread over observations in the same cells, before they are added to the normal
    equations A (N, N) and b (N,).

    ``rows`` (4, ROW), ``w`` and ``r`` (4,): those of two observations, added at once, their weights
    and residuals; ``S`` (ROW, ROW) and ``s`` (ROW,): their weighted products; ``columns`` (ROW,):
    of a row's entries, in the order of the vector of unknowns; ``at``: see ``dense_columns``.
    """

    rows: Floats
    w: Floats
    r: Floats
    S: Floats
    s: Floats
    columns: np.ndarray
    at: np.ndarray
    A: Floats
    b: Floats


def predict_observations(state: State, data: PoseData) -> ObservedValues:
    """Predict the features (n, 2) px and the samples' projector coordinates (m, 2) px; NaN where
    not visible."""
    features, samples = np.empty_like(data.feature_px), np.empty_like(data.sample_px)
    run_rows(_predict, state.layout.poses, state, data, features, samples)
    return features, samples


def normal_equations(
    state: State, data: PoseData, residuals: ObservedValues, weights: ObservedValues
) -> tuple[Floats, Floats]:
    """Return J'WJ (N, N), of which the upper triangle is filled, and J'W r (N,).

    ``residuals`` and ``weights``: of features (n, 2), and of samples (m, 2); what weighs 0 may be
    NaN.
    """
    layout = state.layout
    # a kernel's parallel loops take no structures
    lanes = max(1, min(MAX_LANES, numba.get_num_threads(), layout.poses))
    shares = [np.arange(lane, layout.poses, lanes) for lane in range(lanes)]
    matrices = [np.zeros((layout.size, layout.size)) for _ in shares]
    right = np.zeros((len(shares), layout.size))
    observed = data, residuals, weights, _sort_by_cell(state, data)
    with ThreadPoolExecutor(len(shares)) as threads:
        list(
            threads.map(
                lambda *share: _accumulate(state, *observed, layout.starts, *share),
                shares, matrices, right,
            )
        )  # fmt: skip
    for first in range(0, layout.size, _ROWS_ADDED):
        upper = np.s_[first : first + _ROWS_ADDED, first:]
        for other in matrices[1:]:
            matrices[0][upper] += other[upper]
    return matrices[0], right.sum(0)


@dataclass(frozen=True, eq=False)
class Prior:
    """Normal distributions: of the fields' coefficients by their roughness (``forms``, times
    ``strengths``), of the board's height and offsets by what boards are like, and of the poses
    widely.

    ``board_mm``: the diagonal of the board's features. ``features_per_point``: how many of them
    each offset of the state represents. ``camera_gauge``: unit rows of what the camera's field
    lacks, where its lens is held. ``camera_strength``: where the camera's field is held too, what
    it was calibrated with.
    """

    forms: tuple[Floats, Floats]
    board_mm: float
    gauge: Floats
    camera_gauge: Floats | None = None
    strengths: tuple[float, float] = (FIRST_STRENGTH, FIRST_STRENGTH)
    features_per_point: float = 1.0
    camera_strength: float | None = None

    @classmethod
    def build(
        cls,
        state: State,
        points: Floats,
        camera_gauge: Floats | None = None,
        camera_strength: float | None = None,
    ) -> "Prior":
        """Build the prior for the fields' knots and the board's features at ``points`` (f, 3)
        mm."""
        camera, projector = (roughness(device.coefficients) for device in state.rig[:2])
        strengths = camera_strength or FIRST_STRENGTH, FIRST_STRENGTH
        return cls(
            (camera, projector), diagonal(points), offset_gauge(points), camera_gauge, strengths,
            camera_strength=camera_strength,
        )  # fmt: skip

    def add(self, A: Floats, b: Floats, state: State) -> None:
        """Add to the upper triangle and the right-hand side."""
        at, order = state.layout, np.arange(len(b))
        pose = np.tile((POSE_SIGMA * np.repeat([1.0, self.board_mm], 3)) ** -2, at.poses)
        A[order[: at.height], order[: at.height]] += pose
        height, offsets = order[at.height : at.offsets], slice(at.offsets, at.rig)
        sigma = HEIGHT_SIGMA * self.board_mm
        A[height, height] += sigma**-2
        b[height] -= state.heights / sigma**2
        form = (
            np.eye(at.rig - at.offsets) * self.features_per_point / OFFSET_SIGMA**2
            + self.gauge.T @ self.gauge / GAUGE**2
        ) / self.board_mm**2
        A[offsets, offsets] += form
        b[offsets] -= form @ state.offsets.ravel()
        for first, field, form, strength in self._fields(state):
            n = len(form)
            for k in range(2):
                block = slice(first + k * n, first + (k + 1) * n)
                A[block, block] += strength * form
                b[block] -= strength * (form @ field[k])
        if self.camera_gauge is not None:
            block = slice(at.camera_field, at.projector_field)
            A[block, block] += self.camera_gauge.T @ self.camera_gauge / GAUGE_PX**2

    def cost(self, state: State) -> float:
        """Half the prior's chi square at a state."""
        heights, offsets = state.heights / HEIGHT_SIGMA, state.offsets / OFFSET_SIGMA
        total = (np.sum(heights**2) + np.sum(offsets**2)) / self.board_mm**2
        for _, field, form, strength in self._fields(state):
            total += strength * float(np.sum(field * (field @ form)))
        return 0.5 * float(total)

    def update_strengths(self, state: State, solve: Callable[[Floats], Floats]) -> "Prior":
        """Return the prior with its strengths updated by MacKay's fixed point, which maximises the
        evidence.

        The prior is exp(-strength/2 c'Fc) for each component c of a field, F its form; ``solve``
        applies the inverse of the normal matrix.
        """
        updated = []
        for first, field, form, strength in self._fields(state):
            signs = np.random.default_rng(0).choice([-1.0, 1.0], (*field.shape, PROBES))
            right = np.zeros((state.layout.size, PROBES))
            part = slice(first, first + field.size)
            right[part] = signs.reshape(-1, PROBES)
            spread = solve(right)[part].reshape(signs.shape)
            trace = float(np.sum(spread * (form @ signs))) / PROBES
            determined = max(field.size - strength * trace, 1.0)
            energy = float(np.sum(field * (field @ form)))
            updated.append(float(np.clip(determined / max(energy, 1e-12), *STRENGTH_BOUNDS)))
        return replace(self, strengths=(self.camera_strength or updated[0], updated[1]))

    def _fields(self, state: State) -> Iterator[tuple[int, Floats, Floats, float]]:
        """Iterate over both fields: first unknown, coefficients (2, n), quadratic form (n, n), and
        strength."""
        firsts = state.layout.camera_field, state.layout.projector_field
        fields = [device.coefficients.reshape(2, -1) for device in state.rig[:2]]
        return zip(firsts, fields, self.forms, self.strengths, strict=True)


class BlockFactor:
    """Cholesky factor of a normal matrix (N, N), given by its upper triangle, which stays as it is.

    The ``separable`` blocks of the unknowns are eliminated one by one, and what is left is
    factorised as a whole: less than half the operations of a factor without regard to the zeros
    between the blocks. ``damping``: factor by which the diagonal of lenses and relative pose is
    increased. Raises CalibrationRejected as `factorize` does.
    """

    def __init__(self, A: Floats, layout: UnknownLayout, damping: float = 0.0) -> None:
        """Factorise the matrix."""
        first, second = slice(0, layout.offsets), slice(layout.rig, layout.projector_field)
        self._rest = np.r_[first, second]
        rest = np.block(
            [[A[first, first], A[first, second]], [A[first, second].T, A[second, second]]]
        )
        rig = layout.offsets + np.arange(RIG)
        rest[rig, rig] *= 1 + damping
        self._eliminated = []
        for block in layout.separable:
            factor = factorize(A[block, block].copy())
            after = A[block, second].T if block.start < second.start else A[second, block]
            coupling = np.concatenate([A[first, block], after])
            coupling = scipy.linalg.blas.dtrsm(1.0, factor, coupling.T, lower=1, overwrite_b=1)
            rest = scipy.linalg.blas.dsyrk(
                -1.0, coupling, 1.0, rest.T, trans=1, lower=1, overwrite_c=1
            ).T
            self._eliminated.append((block, factor, coupling))
        self._rest_factor = factorize(rest)

    def solve(self, right: Floats) -> Floats:
        """Return the solution for a right-hand side (N,) or several (N, k)."""
        out = np.empty_like(right)
        for block, factor, _ in self._eliminated:
            out[block] = scipy.linalg.solve_triangular(
                factor, right[block], lower=True, check_finite=False
            )
        rest = right[self._rest] - sum(c.T @ out[block] for block, _, c in self._eliminated)
        out[self._rest] = rest = scipy.linalg.cho_solve(
            (self._rest_factor, True), rest, check_finite=False
        )
        for block, factor, coupling in self._eliminated:
            out[block] = scipy.linalg.solve_triangular(
                factor, out[block] - coupling @ rest, lower=True, trans=1, check_finite=False
            )
        return out


def factorize(A: Floats) -> Floats:
    """Return the lower Cholesky factor of a matrix given by its upper triangle in C order;
    overwrites A.

    Raises CalibrationRejected where the matrix is not positive definite.
    """
    factor, failed = scipy.linalg.lapack.dpotrf(A.T, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise CalibrationRejected(
            "the poses leave the joint adjustment undetermined",
            "capture the board in more positions and tilts",
        )
    return factor


def _sort_by_cell(state: State, data: PoseData) -> np.ndarray:
    """Indices (m,) of the samples, pose by pose, with those in the same cell of both fields one
    after another."""
    keys = []
    for device, px in (
        (state.rig.projector, data.projector_px),
        (state.rig.camera, data.sample_px),
    ):
        cells = np.array(device.coefficients.shape[:0:-1]) - 3
        keys += list(np.nan_to_num((px + 0.5) * cells / device.size).astype(np.int64).T)
    return np.lexsort([*keys, data.poses[1]])


@kernel()
def _predict(first, last, state, data, features, samples):
    """Fill the predicted ``features`` (n, 2) and ``samples`` (m, 2) px of poses ``first`` to
    ``last``."""
    work = allocate_workspace()
    for i in range(first, last):
        for n in range(data.feature_from[i], data.feature_from[i + 1]):
            features[n, 0], features[n, 1] = feature_row(
                state, i, data.points, data.frame, data.feature[n], work
            )
        for n in range(data.sample_from[i], data.sample_from[i + 1]):
            samples[n, 0], samples[n, 1] = sample_row(state, i, data.frame, data.sample_px[n], work)


@kernel()
def _accumulate(state, data, residuals, weights, order, at, poses, A, b):
    """Add the observations of some ``poses`` to the normal matrix A (upper triangle) and the
    right-hand side b.

    ``residuals`` and ``weights``: of features (n, 2) and samples (m, 2). Samples are taken in
    ``order`` (m,); those in the same cells of both fields are summed before they are added to A.
    """
    work = allocate_workspace()
    sums = Sums(
        np.zeros((4, ROW)), np.zeros(4), np.zeros(4), np.zeros((ROW, ROW)), np.zeros(ROW),
        dense_columns(at), at, A, b
    )  # fmt: skip
    for i in poses:
        for c in range(HEIGHT):
            sums.columns[c] = 6 * i + c
        _add_features(state, i, data, residuals[0], weights[0], work, sums)
        part = order[data.sample_from[i] : data.sample_from[i + 1]]
        _add_samples(state, i, data, part, residuals[1], weights[1], work, sums)


@kernel()
def _add_features(state, pose, data, residuals, weights, work, sums):
    """Add the features of one ``pose``, whose ``residuals`` and ``weights`` are (n, 2)."""
    for n in range(data.feature_from[pose], data.feature_from[pose + 1]):
        if weights[n, 0] > 0.0 or weights[n, 1] > 0.0:
            f = data.feature[n]
            feature_row(state, pose, data.points, data.frame, f, work)
            fill_feature_fields(work)
            set_feature_columns(sums.columns, state.rig, f, work.cells, sums.at)
            _set_rows(sums, 0, work.row, weights[n], residuals[n])
            _add_rows(sums, PROJECTOR_FIELD)
            _move_sums(sums, PROJECTOR_FIELD)


@kernel()
def _add_samples(state, pose, data, part, residuals, weights, work, sums):
    """Add the samples of one ``pose``, whose indices are ``part`` (k,)."""
    cells = -1, -1, -1, -1
    first = 0
    for n in part:
        if weights[n, 0] > 0.0 or weights[n, 1] > 0.0:
            sample_row(state, pose, data.frame, data.sample_px[n], work)
            own = work.cells[0, 0], work.cells[0, 1], work.cells[1, 0], work.cells[1, 1]
            if own != cells:
                _add_rows(sums, ROW)
                _move_sums(sums, ROW)
                first = 0
                cells = own
                set_sample_columns(sums.columns, state.rig, work.cells, sums.at)
            fill_sample_fields(work)
            _set_rows(sums, first, work.row, weights[n], residuals[n])
            if first == 2:
                _add_rows(sums, ROW)
            first = 2 - first
    _add_rows(sums, ROW)
    _move_sums(sums, ROW)


@kernel()
def dense_columns(at):
    """Return the columns (ROW,) of a row's entries in the vector of unknowns, of height and rig;
    the others are 0.

    ``at``: first columns of height, offsets, rig, camera's field, and projector's field.
    """
    columns = np.zeros(ROW, np.int64)
    for c in range(HEIGHT_TERMS):
        columns[HEIGHT + c] = at[0] + c
    for c in range(RIG):
        columns[CAMERA + c] = at[2] + c
    return columns


@kernel()
def set_feature_columns(columns, rig, feature, cells, at):
    """Fill in the columns of a feature's offset, and of the camera's field in the first of the
    ``cells``."""
    columns[OFFSET], columns[OFFSET + 1] = at[1] + 2 * feature, at[1] + 2 * feature + 1
    _set_field_columns(columns, CAMERA_FIELD, rig.camera, cells[0], at[3])


@kernel()
def set_sample_columns(columns, rig, cells, at):
    """Fill in the columns of both fields in their ``cells`` (2, 2)."""
    set_feature_columns(columns, rig, 0, cells, at)  # a sample's row has zeros at the offset
    _set_field_columns(columns, PROJECTOR_FIELD, rig.projector, cells[1], at[4])


@kernel()
def _set_field_columns(columns, first, device, cell, start):
    """Fill in the columns of the coefficients of both components that reach a ``cell`` (column,
    row) of a device's field."""
    stride = device.coefficients.shape[2]
    knots = stride * device.coefficients.shape[1]
    for k in range(2):
        for m in range(4):
            for n in range(4):
                columns[first + k * FIELD + 4 * m + n] = (
                    start + k * knots + (cell[1] + m) * stride + cell[0] + n
                )


@kernel()
def fill_feature_fields(work):
    """Fill in the derivatives of a feature by the camera's field; u's coefficients are in row u
    alone, v's in row v."""
    for k in range(2):
        _fill_field(work.row, CAMERA_FIELD + k * FIELD, work.camera_basis, 1.0 - k, float(k))


@kernel()
def fill_sample_fields(work):
    """Fill in the derivatives of a sample by both fields; both rows look through the camera's."""
    row, by = work.row, work.by_field
    for k in range(2):
        _fill_field(row, CAMERA_FIELD + k * FIELD, work.camera_basis, by[0, k], by[1, k])
        _fill_field(row, PROJECTOR_FIELD + k * FIELD, work.projector_basis, 1.0 - k, float(k))


@kernel()
def _fill_field(row, first, basis, by_u, by_v):
    """Fill in the derivatives of u and v by one component's coefficients; ``by_u``, ``by_v``: by
    its displacement."""
    for m in range(4):
        for n in range(4):
            value = basis[2, m] * basis[0, n]
            row[0, first + 4 * m + n] = by_u * value
            row[1, first + 4 * m + n] = by_v * value


@kernel()
def _set_rows(sums, first, row, weight, residual):
    """Fill in rows ``first`` and ``first`` + 1 with the two of an observation, their weights and
    residuals."""
    for k in range(2):
        for c in range(ROW):
            sums.rows[first + k, c] = row[k, c]
        sums.w[first + k] = weight[k]
        sums.r[first + k] = residual[k] if weight[k] > 0.0 else 0.0


@kernel(fastmath=True)
def _add_rows(sums, length):
    """Add the weighted products of four rows with themselves to S (upper triangle), and with the
    residuals to s.

    Then the weights are set to zero.
    """
    rows, w, r, S, s = sums.rows, sums.w, sums.r, sums.S, sums.s
    for a in range(length):
        p0, p1, p2, p3 = w[0] * rows[0, a], w[1] * rows[1, a], w[2] * rows[2, a], w[3] * rows[3, a]
        s[a] += p0 * r[0] + p1 * r[1] + p2 * r[2] + p3 * r[3]
        target = S[a, a:length]
        u0, u1, u2, u3 = rows[0, a:length], rows[1, a:length], rows[2, a:length], rows[3, a:length]
        for c in range(target.size):
            target[c] += p0 * u0[c] + p1 * u1[c] + p2 * u2[c] + p3 * u3[c]
    w[:] = 0.0


@kernel()
def _move_sums(sums, length):
    """Add S (upper triangle) and s to A and b, each entry to its column, and set them to zero."""
    S, s, columns, A, b = sums.S, sums.s, sums.columns, sums.A, sums.b
    for a in range(length):
        target, source, column = A[columns[a]], S[a, a:length], columns[a:length]
        b[columns[a]] += s[a]
        s[a] = 0.0
        for c in range(source.size):
            target[column[c]] += source[c]
        source[:] = 0.0
