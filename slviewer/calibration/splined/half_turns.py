"""Detection of poses numbered from the board's other end: a grid of circles looks the same turned
by 180 degrees.

Printing errors of the circles identify the board. Each pose's estimate of them is compared with the
others': of its part that changes sign under a half turn, less the smooth part that lens distortion
may cause. That part agrees between poses of one numbering, and has the opposite sign in a pose
numbered from the other end.
"""

from itertools import pairwise

import numpy as np
import scipy

from slviewer.calibration.splined.normal import predict_observations
from slviewer.calibration.splined.residuals import PoseData
from slviewer.calibration.splined.unknowns import State
from slviewer.errors import InputError
from slviewer.geometry.polynomial import monomials, scale_to_unit_square
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.vectors import box_middle, diagonal, finite_rows, lengths, unit_vectors
from slviewer.target.board import Board

DECISION_SIGMAS = 5.0
"""Least anticorrelation with the other poses, in sigmas of chance, of a pose that counts as
turned."""
SMOOTH_DEGREE = 4
"""Degree of the polynomials that are removed as possible lens distortion."""
SAME_PLACE = 5e-6
"""Of a board's diagonal: features so near to each other are one."""
_STEP = 5e-5  # of that diagonal


def is_numbering_ambiguous(notation: str) -> bool:
    """Whether a board, by its notation, looks the same turned by 180 degrees unless its mark is
    detected."""
    try:
        return Board.parse(notation).kind in ("circles", "acircles")
    except InputError:  # a calibration made elsewhere
        return False


def opposite_features(points: Floats) -> np.ndarray | None:
    """Return the index (f,) of the feature opposite to each of ``points`` (f, 3) mm; None without
    that symmetry."""
    middle = box_middle(points)
    away = lengths((2 * middle - points)[:, None, :2] - points[None, :, :2])
    partner = np.argmin(away, axis=1)
    is_symmetric = np.array_equal(partner[partner], np.arange(len(points)))
    same = SAME_PLACE * diagonal(points)
    return partner if is_symmetric and away.min(axis=1).max() < same else None


def match_features(points: Floats, board: Floats) -> tuple[np.ndarray, Mask]:
    """Return the index (n,) of the feature of a ``board`` (f, 3) mm that is nearest to each of
    ``points`` (n, 3) on it, and whether it is the same one, (n,) bool."""
    distances, feature = scipy.spatial.cKDTree(board[:, :2]).query(points[:, :2])
    return feature, distances < SAME_PLACE * diagonal(board)


def detect_half_turns(state: State, data: PoseData, residuals: Floats, certain: Mask) -> Mask:
    """Detect the poses (p,) bool numbered from the other end than the ``certain`` (p,) bool ones,
    or than most.

    ``residuals`` (n, 2) px: of the features. All False for boards without the symmetry and for
    fewer than three poses.
    """
    partner = opposite_features(data.points)
    count = state.layout.poses
    if partner is None or count < 3 or certain.all():
        return np.zeros(count, bool)
    places = _measure_offsets(state, data, residuals)
    # the opposite circle's offset is reversed by the turn: the antisymmetric part is the mean of
    # both
    odd = (places + places[:, partner]) / 2
    basis, _ = np.linalg.qr(monomials(scale_to_unit_square(data.points[:, :2]), SMOOTH_DEGREE))
    odd = odd - np.einsum("fk,gk,pgc->pfc", basis, basis, odd, optimize=True)
    reversed_part = odd.reshape(count, -1)
    unit = unit_vectors(reversed_part)
    alike = unit @ unit.T
    np.fill_diagonal(alike, 0.0)
    signs = np.sign(np.linalg.eigh(alike)[1][:, -1])
    signs[signs == 0] = 1.0
    chosen = signs[certain].sum() if certain.any() else signs.sum()
    signs = signs if chosen >= 0 else -signs
    total = signs @ reversed_part
    others = total - signs[:, None] * reversed_part
    agree = np.einsum("pn,pn->p", unit, unit_vectors(others))
    # of two features that are each other's opposite only one counts, and what is smooth does not
    freedom = max(len(data.points) - (SMOOTH_DEGREE + 1) * (SMOOTH_DEGREE + 2) // 2, 1)
    return (agree * np.sqrt(freedom) < -DECISION_SIGMAS) & ~certain


def renumber_poses(state: State, data: PoseData, poses: np.ndarray) -> tuple[State, PoseData]:
    """Return state and data with the given ``poses`` (p,) bool numbered from the board's other
    end."""
    partner = opposite_features(data.points)
    if partner is None or not poses.any():
        return state, data
    middle = box_middle(data.points)
    feature, R, t = data.feature.copy(), state.R_board.copy(), state.t_board.copy()
    for i in np.nonzero(poses)[0]:
        part = slice(data.feature_from[i], data.feature_from[i + 1])
        feature[part] = partner[feature[part]]
        t[i] += 2 * R[i] @ np.array([middle[0], middle[1], 0.0])
        R[i] = R[i] @ np.diag([-1.0, -1.0, 1.0])
    return state._replace(R_board=R, t_board=t), data._replace(feature=feature)


def _measure_offsets(state: State, data: PoseData, residuals: Floats) -> Floats:
    """Return the offset (p, f, 2) mm of each feature on the board by each pose; 0 where missing or
    an outlier."""
    # the samples' predictions are not needed
    data = data._replace(sample_from=np.zeros_like(data.sample_from))
    step = _STEP * diagonal(data.points)
    here, right, below = (
        predict_observations(state._replace(offsets=state.offsets + moved), data)[0]
        for moved in ((0.0, 0.0), (step, 0.0), (0.0, step))
    )
    J = np.stack([right - here, below - here], axis=2) / step  # of px by mm
    usable = finite_rows(J.reshape(len(J), -1), residuals)
    usable[usable] &= np.abs(np.linalg.det(J[usable])) > 1e-9
    deviations = np.zeros_like(residuals)
    deviations[usable] = np.linalg.solve(J[usable], residuals[usable][..., None])[..., 0]
    deviations[usable] += state.offsets[data.feature[usable]]
    places = np.zeros((state.layout.poses, len(data.points), 2))
    for i, (first, last) in enumerate(pairwise(data.feature_from)):
        each = deviations[first:last]
        limit = 6 * 1.4826 * np.median(np.abs(each), axis=0)
        is_inlier = (np.abs(each) <= limit).all(axis=1, keepdims=True)
        places[i, data.feature[first:last]] = each * is_inlier
    return places
