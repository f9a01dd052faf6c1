"""Coded markers on scans: their corners in 3D, and the pose between two scans that they determine.

A corner lies where a smooth surface, fitted to the points around it, meets the corner's line of
sight; so neither the marker's own print nor the few points at its edges decide.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.rigid import (
    Floats,
    Mask,
    Uncertainty,
    fit_rigid,
    motion_jacobian,
    move_points,
)
from slviewer.geometry.robust import robust_sigma, tukey_weights
from slviewer.geometry.vectors import diagonal, lengths, rms_length, subsample
from slviewer.reconstruction.cloud import Cloud
from slviewer.registration.refusal import Refused
from slviewer.target.coded import detect_markers

CORNER_PX = 0.05
"""Standard deviation of a corner in the image, beyond which its own residuals speak."""
MOVED_SIGMAS, MOVED_SHARE, MOVED_MEDIANS = 6.0, 5e-4, 4.0
"""A marker whose corners are further from where the others put them, in standard deviations, over
all markers' extent, and in medians of all markers, has been moved."""
MOST_GAP = 0.005
"""Of the markers' extent: where their gaps are larger in the median, no motion explains them."""
LEAST_CORNER_POINTS = 40
_MOST_HYPOTHESES = 2000
_FIT_REACH = 0.75
"""Radius of the surface around a corner over the marker's side."""


@dataclass(frozen=True, eq=False)
class MeasuredMarkers:
    """Markers on a scan: numbers ``ids`` (n,), ``corners`` (n, 4, 3) mm in the scan's frame, their
    standard deviations ``sigma_mm`` (n, 4), and the numbers that were ``repeated`` and are
    excluded."""

    ids: np.ndarray
    corners: Floats
    sigma_mm: Floats
    repeated: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class MarkerPose:
    """The pose ``T`` (4, 4), T_reference_scan, that the markers ``ids`` of two scans determine,
    with the corners of both (m, 3) mm, their common standard deviations ``sigma_mm`` (m,), raised
    where their gaps are larger, and the numbers that have ``moved``."""

    T: Floats
    ids: tuple[int, ...]
    moved: tuple[int, ...]
    scan_corners: Floats
    reference_corners: Floats
    sigma_mm: Floats

    @property
    def rms_mm(self) -> float:
        """Root mean square distance of the corners."""
        return rms_length(move_points(self.T, self.scan_corners) - self.reference_corners)

    def inverse(self) -> "MarkerPose":
        """The pose of the reference on the scan."""
        return replace(
            self,
            T=np.asarray(np.linalg.inv(self.T), np.float64),
            scan_corners=self.reference_corners,
            reference_corners=self.scan_corners,
        )

    def normal_equations(self, T: Floats, centre: Floats, sigma_mm: float) -> tuple[Floats, Floats]:
        """Matrix (6, 6) and gradient (6,) of the corners' squared gaps at a pose ``T`` (4, 4), by a
        small rotation about ``centre`` (3,) and a shift, as those of residuals of ``sigma_mm``."""
        placed = move_points(T, self.scan_corners)
        weight = (sigma_mm / self.sigma_mm) ** 2
        J = motion_jacobian(placed - centre)
        H = np.einsum("mij,mik,m->jk", J, J, weight)
        return H, np.einsum("mij,mi,m->j", J, placed - self.reference_corners, weight)

    @property
    def uncertainty(self) -> Uncertainty:
        """Uncertainty of the pose about the corners' middle."""
        centre = move_points(self.T, self.scan_corners).mean(axis=0)
        return Uncertainty(np.linalg.inv(self.normal_equations(self.T, centre, 1.0)[0]), centre)


def measure_markers(cloud: Cloud) -> MeasuredMarkers:
    """Measure the corners of the coded markers that a scan's texture shows; raises InputError
    without a texture."""
    if cloud.texture is None:
        raise InputError(
            "A cloud without a texture shows no markers",
            "reconstruct the capture with its texture.",
        )
    grey = (
        cloud.texture
        if cloud.texture.ndim == 2
        else cv2.cvtColor(cloud.texture, cv2.COLOR_RGB2GRAY)
    )
    seen = detect_markers(np.asarray(grey, np.uint8))
    ids, corners = [], []
    for number, quad in zip(seen.ids, seen.corners, strict=True):
        measured = [_measure_corner(cloud, corner, quad) for corner in quad]
        if all(corner is not None for corner in measured):
            ids.append(int(number))
            corners.append(measured)
    placed = np.reshape(np.array(corners, float), (-1, 4, 4))
    return MeasuredMarkers(np.array(ids, int), placed[..., :3], placed[..., 3], seen.repeated)


def _measure_corner(
    cloud: Cloud, corner: Floats, quad: Floats
) -> tuple[float, float, float, float] | None:
    """Return the point mm at a corner (2,) px of a marker ``quad`` (4, 2) px: x, y, z, and its
    standard deviation; None where too little of the surface around it was measured."""
    reach = _FIT_REACH * float(lengths(quad - np.roll(quad, 1, axis=0)).mean())
    left, top = np.maximum(np.floor(corner - reach).astype(int), 0)
    right, bottom = np.ceil(corner + reach).astype(int) + 1
    window = np.s_[top:bottom, left:right]
    points = cloud.points[window].astype(np.float64)
    v, u = np.indices(points.shape[:2]) + np.array([top, left])[:, None, None]
    known = np.isfinite(points[..., 2]) & (np.hypot(u - corner[0], v - corner[1]) <= reach)
    if np.count_nonzero(known) < LEAST_CORNER_POINTS:
        return None
    x, y = (u[known] - corner[0]) / reach, (v[known] - corner[1]) / reach
    if (
        len({*zip(x > 0, y > 0, strict=True)}) < 4
    ):  # the surface ends here: it would be extrapolated
        return None
    points = points[known]
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    sigma = np.nan_to_num(cloud.sigma[window][known], nan=1.0)
    noise = np.maximum(sigma, 1e-6) / points[:, 2] ** 2
    weight = noise**-2.0
    for _ in range(3):  # a plane's 1/z is linear in the image
        A = basis * weight[:, None]
        covariance = np.linalg.inv(A.T @ basis)
        fitted = covariance @ (A.T @ (1 / points[:, 2]))
        residual = (1 / points[:, 2] - basis @ fitted) / noise
        spread = max(robust_sigma(residual, about=0.0), 1e-6)
        weight = noise**-2.0 * tukey_weights(residual, spread)
    z = 1 / fitted[0]
    sigma_z = spread * np.sqrt(covariance[0, 0]) * z**2
    rays, *_ = np.linalg.lstsq(basis, points[:, :2] / points[:, 2:], rcond=None)
    pitch = z * np.linalg.norm(rays[1:3]) / reach / np.sqrt(2)
    x, y = z * rays[0]
    return x, y, z, float(np.hypot(sigma_z, CORNER_PX * pitch))


def fit_marker_pose(scan: MeasuredMarkers, reference: MeasuredMarkers) -> MarkerPose | None:
    """Fit the pose that brings the markers of a scan onto those of a reference; None without common
    ones.

    Markers that contradict most of the others have been moved, and are excluded. Raises ``Refused``
    where it is undecidable which ones have.
    """
    common, mine, theirs = np.intersect1d(scan.ids, reference.ids, return_indices=True)
    if not len(common):
        return None
    p, q = scan.corners[mine], reference.corners[theirs]
    sigma = np.hypot(scan.sigma_mm[mine], reference.sigma_mm[theirs])
    steady = _select_steady(p, q, sigma)
    if len(common) > 1 and steady.sum() <= len(common) / 2:
        raise Refused(
            "picks",
            f"Of {len(common)} common markers only {int(steady.sum())} keep their places: glue the"
            " markers on, or scan without moving those beside the object.",
        )
    T = _fit_pose(p[steady], q[steady], sigma[steady])
    p, q, s = p[steady].reshape(-1, 3), q[steady].reshape(-1, 3), sigma[steady].ravel()
    gap = np.sum((move_points(T, p) - q) ** 2, axis=1) / (3 * s**2)
    s = s * np.sqrt(max(1.0, float(np.sum(gap)) / max(1.0, len(gap) - 2.0)))
    ids, moved = (tuple(common[which].tolist()) for which in (steady, ~steady))
    return MarkerPose(T, ids, moved, p, q, s)


def _select_steady(p: Floats, q: Floats, sigma: Floats) -> Mask:
    """Return which markers (n,) bool keep their places, by the least median of their gaps.

    A calibration that is not perfect leaves gaps too; so they are compared with the median one.
    """
    n = len(p)
    if n == 1:
        return np.ones(1, bool)
    pairs = np.stack(np.triu_indices(n, 1), axis=1)
    pairs = subsample(pairs, _MOST_HYPOTHESES)
    starts = fit_rigid(p[pairs].reshape(-1, 8, 3), q[pairs].reshape(-1, 8, 3))
    gaps = _largest_gaps(starts, p, q)
    gap = gaps[np.median(gaps, axis=1).argmin()]
    steady = gap <= np.median(gap)
    extent = diagonal(q.reshape(-1, 3))
    for _ in range(4):
        T = _fit_pose(p[steady], q[steady], sigma[steady])
        gap = _largest_gaps(T, p, q)
        usual = float(np.median(gap))
        limit = np.maximum(
            MOVED_SIGMAS * sigma.max(axis=1), max(MOVED_SHARE * extent, MOVED_MEDIANS * usual)
        )
        steady = gap < limit
        if steady.sum() < 2:
            break
    return steady & (usual < MOST_GAP * extent)


def _fit_pose(p: Floats, q: Floats, sigma: Floats) -> Floats:
    """Return the motion (4, 4) of weighted least squares that brings markers' corners (n, 4, 3) mm
    onto others."""
    return fit_rigid(p.reshape(-1, 3), q.reshape(-1, 3), sigma.ravel() ** -2.0)


def _largest_gaps(T: Floats, p: Floats, q: Floats) -> Floats:
    """Return the largest gap (..., n) mm of each marker's corners (n, 4, 3) after motions (..., 4,
    4)."""
    gaps = lengths(move_points(T, p.reshape(-1, 3)) - q.reshape(-1, 3))
    return gaps.reshape(*T.shape[:-2], -1, 4).max(axis=-1)


def marker_notes(measured: Mapping[str, MeasuredMarkers]) -> list[str]:
    """Warnings about markers that were excluded, and on scans that show none."""
    notes = []
    for name, markers in measured.items():
        if markers.repeated:
            numbers = ", ".join(map(str, markers.repeated))
            notes.append(
                f"{name} shows marker {numbers} more than once, which is ignored: use every number"
                " once"
            )
        if not len(markers.ids):
            notes.append(
                f"{name} shows no marker that could be measured: bring markers into view, at least"
                " 16 px wide"
            )
    return notes
