"""Selecting points of an organised cloud: by an outline in a view, by connection, and by their
supporting plane.

Every function returns a mask (h, w) of the camera's pixels, so that a selection made in any view of
the cloud applies to the same pixels after another calibration.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.errors import InputError
from slviewer.geometry.ransac import ransac_plane
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.vectors import finite_rows, lengths
from slviewer.reconstruction.reconstruct import JUMP
from slviewer.surface.shapes import label_connected

PLANE_SHARE = 0.1
"""Of the points that must lie on a plane for it to be taken as what supports the object."""
PLANE_TOLERANCE = 0.002
"""Of the median depth: how far points of the supporting plane may be from it, unless noise moves
them farther."""
_RASTER = 2048
_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class ViewCamera:
    """The pinhole of a 3D view: ``position`` (3,) mm, ``R_scene_view`` (3, 3) with z along the
    viewing direction, x to the right and y down, ``fov_rad`` of its height, and ``aspect``, width
    over height."""

    position: np.ndarray
    R_scene_view: np.ndarray
    fov_rad: float
    aspect: float

    def project(self, points: np.ndarray) -> NDArray[np.float64]:
        """Project points (..., 3) mm to (..., 2): 0 ... 1 from the left and from the top; NaN
        behind the view."""
        local = (points - self.position) @ self.R_scene_view
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = np.where(local[..., 2] > 0, local[..., 2], np.nan)
        reach = np.tan(self.fov_rad / 2)
        return np.asarray(
            0.5 + local[..., :2] / depth[..., None] / (2 * reach * np.array([self.aspect, 1.0]))
        )

    def is_near(self, other: "ViewCamera") -> bool:
        """Whether another view shows a scene at the same place of the picture, to about a pixel."""
        scale = max(float(np.linalg.norm(self.position)), 1.0)
        moved = np.linalg.norm(self.position - other.position) / scale
        turned = np.abs(self.R_scene_view - other.R_scene_view).max()
        return bool(moved < 1e-3 and turned < 1e-3 and abs(self.aspect - other.aspect) < 1e-3)


def select_in_outline(
    points: np.ndarray, view: ViewCamera, outline: Sequence[tuple[float, float]] | np.ndarray
) -> Mask:
    """Mask (h, w) of the points (h, w, 3) mm that a view shows inside a closed outline (n, 2), in
    its 0 ... 1.

    What is hidden behind other points is selected too. InputError for fewer than 3 corners.
    """
    corners = np.asarray(outline, np.float64)
    if corners.ndim != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise InputError(f"the outline has {len(corners)} corners: draw at least 3")
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.maximum(high - low, 1e-9)
    raster = np.zeros((_RASTER, _RASTER), np.uint8)
    cv2.fillPoly(raster, [np.rint((corners - low) / size * (_RASTER - 1)).astype(np.int32)], 1)
    with np.errstate(invalid="ignore"):
        at = (view.project(points.astype(np.float64)) - low) / size
        inside = ((at >= 0) & (at <= 1)).all(axis=-1)
    pixel = np.rint(np.where(inside[..., None], at, 0) * (_RASTER - 1)).astype(int)
    return np.asarray(inside & (raster[pixel[..., 1], pixel[..., 0]] == 1))


def select_polygon(shape: tuple[int, ...], corners: np.ndarray) -> Mask:
    """Mask (h, w) of the camera's pixels within a polygon of pixels (n, 2), (u, v). InputError
    below 3 corners."""
    corners = np.asarray(corners, np.float64)
    if corners.ndim != 2 or corners.shape[0] < 3 or corners.shape[1] != 2:
        raise InputError(
            f"a polygon of {corners.size // 2} corners was given: give u v of at least 3"
        )
    mask = np.zeros(shape[:2], np.uint8)
    cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], 1)
    return mask == 1


def select_connected(
    points: np.ndarray, seed: tuple[int, int], candidates: Mask | None = None
) -> Mask:
    """Mask (h, w) of the part of the surface that the pixel ``seed`` (u, v) belongs to.

    Neighbouring pixels of points (h, w, 3) mm are connected where their distance is below ``JUMP``
    of their depth. ``candidates`` (h, w): the points to consider, by default all. InputError for a
    seed that is none of them.
    """
    valid = finite_rows(points)
    if candidates is not None:
        valid &= candidates
    u, v = seed
    h, w = valid.shape
    if not (0 <= u < w and 0 <= v < h and valid[v, u]):
        raise InputError(f"no point was measured at pixel ({u}, {v}): pick one on the surface")
    index = np.arange(h * w).reshape(h, w)
    pairs = []
    for down, right in _STEPS:
        a = np.s_[: h - down, max(0, -right) : w - max(0, right)]
        b = np.s_[down:, max(0, right) : w + min(0, right)]
        with np.errstate(invalid="ignore"):
            depth = np.minimum(points[a][..., 2], points[b][..., 2])
            near = lengths(points[a] - points[b]) < JUMP * depth
        joined = near & valid[a] & valid[b]
        pairs.append(np.stack([index[a][joined], index[b][joined]], axis=1))
    labels = label_connected(np.concatenate(pairs), h * w).reshape(h, w)
    return np.asarray(valid & (labels == labels[v, u]))


@dataclass(frozen=True)
class SupportPlane:
    """The plane that an object stands on: points p with ``normal`` p = ``offset_mm``, the normal
    (3,) pointing to the camera's side. What is at most ``margin_mm`` above it belongs to it."""

    normal: tuple[float, float, float]
    offset_mm: float
    margin_mm: float

    def select_below(self, points: np.ndarray) -> Mask:
        """Mask (h, w) of the points (h, w, 3) mm on the plane and below it."""
        with np.errstate(invalid="ignore"):
            return np.asarray(points @ np.array(self.normal) - self.offset_mm <= self.margin_mm)


def detect_support(
    points: np.ndarray, sigma_mm: float, margin_mm: float | None = None
) -> SupportPlane:
    """Detect the plane with most points of a cloud (h, w, 3) mm of a median noise ``sigma_mm``.

    Its margin is by default three robust standard deviations of its points, at least
    ``PLANE_TOLERANCE`` of their depth. InputError where less than ``PLANE_SHARE`` of the points lie
    on any plane.
    """
    flat = points[finite_rows(points)].astype(np.float64)
    depth = float(np.median(flat[:, 2])) if len(flat) else 0.0
    tolerance = max(PLANE_TOLERANCE * depth, 3 * sigma_mm if np.isfinite(sigma_mm) else 0.0, 1e-6)
    plane, inliers = ransac_plane(flat, tolerance)
    share = inliers.mean()
    if share < PLANE_SHARE:
        raise InputError(
            f"no supporting plane: at most {100 * share:.0f} % of the {len(flat)} points lie on one"
            f" plane to {tolerance:.2f} mm, {100 * PLANE_SHARE:.0f} % are needed: select the points"
            " with an outline"
        )
    if margin_mm is None:
        margin_mm = max(3 * robust_sigma(plane.distance(flat[inliers]), about=0.0), tolerance)
    side = -1 if plane.offset > 0 else 1  # the camera, in the origin, is on the positive side
    x, y, z = (side * plane.normal).tolist()
    return SupportPlane((x, y, z), side * plane.offset, margin_mm)


def select_support(
    points: np.ndarray, sigma_z: np.ndarray, margin_mm: float | None = None
) -> tuple[SupportPlane, Mask]:
    """Detect the support of a cloud (h, w, 3) mm of the noise ``sigma_z`` (h, w) mm, as
    `detect_support` does; returns it with the mask (h, w) of the points on it and below."""
    plane = detect_support(points, float(np.nanmedian(sigma_z)), margin_mm)
    return plane, plane.select_below(points)
