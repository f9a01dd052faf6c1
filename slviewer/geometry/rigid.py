"""Rigid motions as matrices (4, 4), and their uncertainty: ``T_b_a`` maps points of frame a into
frame b."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
_K2 = 0.9545
"""Share of all errors within twice the standard deviation of a single number."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of a registered pose (1 sigma).

    ``covariance`` (6, 6): of a small rotation vector (rad) about ``centre`` (3,) mm, the middle of
    the overlap in the reference's frame, and of the translation (mm) there. ``noise`` (6, 6): the
    part of it that is drawn anew with each measurement; None where all of it is.
    """

    covariance: np.ndarray
    centre: np.ndarray
    noise: np.ndarray | None = None

    @property
    def shift_mm(self) -> float:
        """Root of the expected squared translation of the overlap's middle."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))

    @property
    def turn_deg(self) -> float:
        """Root of the expected squared rotation angle."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance[:3, :3]))))


def rigid_transform(R: Floats, t: Floats) -> Floats:
    """(..., 4, 4): the motion X -> R X + t of rotations ``R`` (..., 3, 3) and shifts ``t`` (..., 3)
    mm."""
    T = np.zeros((*np.shape(R)[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def invert(T: Floats) -> Floats:
    """(..., 4, 4): the inverse of motions."""
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    return rigid_transform(R, -(R @ T[..., :3, 3:])[..., 0])


def transform_from_rvec(rvec: ArrayLike, tvec: ArrayLike) -> Floats:
    """(4, 4): the motion of a rotation vector (rad) and a translation (mm) as OpenCV returns them,
    of any shape."""
    return rigid_transform(_rotation_matrix(rvec), np.ravel(tvec))


def _rotation_matrix(rvec: ArrayLike) -> Floats:
    """(3, 3): the rotation by a vector of three rad, of any shape."""
    return np.asarray(cv2.Rodrigues(np.ravel(rvec).astype(np.float64))[0])


def turn_about(rotation: Floats, centre: Floats, shift: Floats | float = 0.0) -> Floats:
    """(4, 4): the turn by a rotation vector (3,) rad about ``centre`` (3,) mm, then the shift (3,)
    mm."""
    R = _rotation_matrix(rotation)
    return rigid_transform(R, centre - R @ centre + shift)


def move_points(T: NDArray[np.floating], points: np.ndarray) -> Floats:
    """(..., n, 3): points (n, 3) mm moved by each motion ``T`` (..., 4, 4); NaN stays NaN."""
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def motion_jacobian(arm: Floats) -> Floats:
    """Return the derivatives (m, 3, 6) of points by a small rotation (rad) about a centre and a
    shift (mm).

    ``arm`` (m, 3) mm: the points less the centre.
    """
    J = np.zeros((len(arm), 3, 6))
    J[:, :, 3:] = np.eye(3)
    for k, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):  # rotation x arm
        J[:, a, k], J[:, b, k] = -arm[:, b], arm[:, a]
    return J


def distance_jacobian(arm: Floats, normals: Floats) -> Floats:
    """Return the derivatives (n, 6) of points' distances along ``normals`` (n, 3), by a small
    rotation (rad) about a centre and a shift (mm).

    ``arm`` (n, 3) mm: the points less the centre.
    """
    return np.hstack([np.cross(arm, normals), normals])


def nearest_rotation(M: Floats) -> Floats:
    """(3, 3): the rotation nearest to a matrix (3, 3) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(M)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def rotation_angle(R: Floats) -> Floats:
    """(...,) rad: the angle of rotations (..., 3, 3), 0 to pi."""
    across = [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]]
    sine = np.sqrt(sum(each**2 for each in across))
    return np.arctan2(sine, np.trace(R, axis1=-2, axis2=-1) - 1)


def largest_angle_deg(directions: Floats) -> float:
    """Return the largest angle in degrees between two of the unit vectors (n, 3)."""
    return float(np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1).min())))


def fit_rigid(points: Floats, targets: Floats, weights: Floats | None = None) -> Floats:
    """(..., 4, 4): the motion of least squares that brings points (..., n, 3) onto ``targets``
    (..., n, 3), in order.

    Kabsch's algorithm; the points must be finite, three or more and not on one line. ``weights``:
    (n,), one over each pair's variance.
    """
    p0, q0 = (np.average(each, axis=-2, weights=weights) for each in (points, targets))
    p, q = points - p0[..., None, :], targets - q0[..., None, :]
    if weights is not None:
        p = p * weights[:, None]
    U, _, Vt = np.linalg.svd(np.swapaxes(p, -1, -2) @ q)
    Vt[..., 2, :] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]
    R = np.swapaxes(U @ Vt, -1, -2)
    return rigid_transform(R, q0 - (R @ p0[..., None])[..., 0])


def move_by(T: Floats, step: Floats) -> Floats:
    """Return a transform (4, 4) turned about its origin and shifted, in the frame it maps to."""
    R = _rotation_matrix(step[:3])
    return rigid_transform(R @ T[:3, :3], T[:3, 3] + step[3:])


def adjoint(T: Floats) -> Floats:
    """Return (..., 6, 6): maps small motions from the frame that ``T`` (..., 4, 4) maps from to the
    one that it maps to."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    J = np.zeros((*T.shape[:-2], 6, 6))
    J[..., :3, :3] = J[..., 3:, 3:] = R
    cross = np.zeros_like(R)
    for k, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):
        cross[..., a, b], cross[..., b, a] = -t[..., k], t[..., k]
    J[..., 3:, :3] = cross @ R
    return J


def coverage_radius(covariance: Floats) -> float:
    """Return the length that the error of a vector exceeds in 4.55 % of all cases, as k = 2 is of a
    single number; ``covariance`` (3, 3). By Satterthwaite's approximation of a sum of squares."""
    from scipy.special import gammaincinv

    total, squares = np.trace(covariance), np.trace(covariance @ covariance)
    return float(np.sqrt(squares / total * 2 * gammaincinv(total**2 / squares / 2, _K2)))
