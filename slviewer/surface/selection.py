"""Selecting points of an organised cloud by an outline in a view, by connection, and by their
supporting plane; and edits that delete the selected points.

Every function returns a mask (h, w) of the camera's pixels, so that a selection made in any view of
the cloud applies to the same pixels after another calibration. Edits are stored as operations:
nothing is removed from the scan itself. An operation names pixels of the camera, or a plane in its
frame, not points: it applies in the same way to the cloud that another calibration makes of the
same frames.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.shapes import ransac_plane
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


@dataclass(frozen=True, eq=False)
class ViewCamera:
    """The pinhole of a 3D view: ``position`` (3,) mm, ``R_scene_view`` (3, 3) with z along the
    viewing direction, x to the right and y down, ``fov_rad`` of its height, and ``aspect``, width
    over height."""

    position: np.ndarray
    R_scene_view: np.ndarray
    fov_rad: float
    aspect: float

    def project(self, points: np.ndarray) -> Floats:
        """Project points (..., 3) mm to (..., 2): 0 ... 1 from the left and from the top; NaN
        behind the view."""
        local = (points - self.position) @ self.R_scene_view
        depth = np.where(local[..., 2] > 0, local[..., 2], np.nan)
        reach = np.tan(self.fov_rad / 2)
        return 0.5 + local[..., :2] / depth[..., None] / (2 * reach * np.array([self.aspect, 1.0]))


def select_in_outline(
    points: np.ndarray, view: ViewCamera, outline: Sequence[tuple[float, float]] | np.ndarray
) -> Mask:
    """Mask (h, w) of the points (h, w, 3) mm that a view shows inside a closed outline (n, 2), in
    its 0 ... 1.

    What is hidden behind other points is selected too. InputError for fewer than 3 corners.
    """
    corners = np.asarray(outline, np.float64)
    if corners.ndim != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise InputError(f"the outline has {len(corners)} corners", "draw at least 3")

    def fill(raster: np.ndarray, path: np.ndarray, _: float) -> np.ndarray:
        """Fill the outline."""
        return np.asarray(cv2.fillPoly(raster, [path], 1))

    return _select_drawn(points, view, corners, 0.0, fill)


def select_along_path(
    points: np.ndarray, view: ViewCamera, path: np.ndarray, radius: float
) -> Mask:
    """Mask (h, w) of the points (h, w, 3) mm that a view shows within ``radius``, a share of its
    height, of a path (n, 2), in its 0 ... 1: what a round brush meets.

    What is hidden behind other points is selected too. InputError for a path that is none.
    """
    path = np.asarray(path, np.float64)
    if path.ndim != 2 or not len(path) or not np.isfinite(path).all():
        raise InputError("the brush has no path", "draw over the points")

    def widen(raster: np.ndarray, path: np.ndarray, scale: float) -> np.ndarray:
        """Mark what is within the radius of the path."""
        cv2.polylines(raster, [path], False, 1)
        raster[path[:, 1], path[:, 0]] = 1  # of a path of one point too
        distance = cv2.distanceTransform(1 - raster, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        return np.asarray(distance <= radius * scale)

    return _select_drawn(points, view, path, radius, widen)


def _select_drawn(
    points: np.ndarray,
    view: ViewCamera,
    path: np.ndarray,
    margin: float,
    draw: Callable[[np.ndarray, np.ndarray, float], np.ndarray],
) -> Mask:
    """Mask (h, w) of the points (h, w, 3) mm that a view shows in what ``draw(raster, path (n, 2)
    px, px a height of the view)`` marks, at most ``margin`` heights away from the path."""
    stretch = np.array([view.aspect, 1.0])  # to heights of the view: circles are round
    path = path * stretch
    low = path.min(axis=0) - margin
    scale = (_RASTER - 1) / max(float((path.max(axis=0) + margin - low).max()), 1e-9)
    raster = np.zeros((_RASTER, _RASTER), np.uint8)
    marked = draw(raster, np.rint((path - low) * scale).astype(np.int32), scale)
    at = (view.project(points.astype(np.float64)) * stretch - low) * scale
    inside = ((at >= 0) & (at <= _RASTER - 1)).all(axis=-1)
    pixel = np.rint(np.where(inside[..., None], at, 0)).astype(int)
    return inside & (marked[pixel[..., 1], pixel[..., 0]] != 0)


def select_polygon(shape: tuple[int, ...], corners: np.ndarray) -> Mask:
    """Mask (h, w) of the camera's pixels within a polygon of pixels (n, 2), (u, v). InputError
    below 3 corners."""
    corners = np.asarray(corners, np.float64)
    if corners.ndim != 2 or corners.shape[0] < 3 or corners.shape[1] != 2:
        raise InputError(
            f"a polygon of {corners.size // 2} corners was given", "give u v of at least 3"
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
        raise InputError(f"no point was measured at pixel ({u}, {v})", "pick one on the surface")
    index = np.arange(h * w).reshape(h, w)
    pairs = []
    for down, right in _STEPS:
        a = np.s_[: h - down, max(0, -right) : w - max(0, right)]
        b = np.s_[down:, max(0, right) : w + min(0, right)]
        depth = np.minimum(points[a][..., 2], points[b][..., 2])
        near = lengths(points[a] - points[b]) < JUMP * depth
        joined = near & valid[a] & valid[b]
        pairs.append(np.stack([index[a][joined], index[b][joined]], axis=1))
    labels = label_connected(np.concatenate(pairs), h * w).reshape(h, w)
    return valid & (labels == labels[v, u])


@dataclass(frozen=True)
class SupportPlane:
    """The plane that an object stands on: points p with ``normal`` p = ``offset_mm``, the normal
    (3,) pointing to the camera's side. What is at most ``margin_mm`` above it belongs to it."""

    normal: tuple[float, float, float]
    offset_mm: float
    margin_mm: float

    def select_below(self, points: np.ndarray) -> Mask:
        """Mask (h, w) of the points (h, w, 3) mm on the plane and below it."""
        return points @ np.array(self.normal) - self.offset_mm <= self.margin_mm


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
            f" plane to {tolerance:.2f} mm, {100 * PLANE_SHARE:.0f} % are needed",
            "select the points with an outline",
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


_MAX_PIXELS = 1 << 32


@dataclass(frozen=True, eq=False)
class Edit:
    """Points that are deleted: those at ``pixels`` (h, w) bool, or those on ``plane`` and below,
    one of both.

    ``what``: how they were selected, in words; ``points``: how many it deleted when it was made;
    ``made``: when, as text that sorts by time, the same for edits of several scans that were made
    together; empty where unknown.
    """

    what: str
    points: int
    pixels: Mask | None = None
    plane: SupportPlane | None = None
    made: str = ""

    def __post_init__(self) -> None:
        if (self.pixels is None) == (self.plane is None):
            raise InputError("an edit deletes pixels, or what is below a plane", "give one of them")

    @property
    def kind(self) -> Literal["pixels", "plane"]:
        """What the edit names its points by."""
        return "plane" if self.pixels is None else "pixels"

    def select(self, points: np.ndarray) -> Mask:
        """Mask (h, w) of the points (h, w, 3) mm that the edit deletes. InputError for pixels of
        another size."""
        if self.plane is not None:
            return self.plane.select_below(points)
        assert self.pixels is not None
        if self.pixels.shape != points.shape[:2]:
            (h, w), (rows, columns) = self.pixels.shape, points.shape[:2]
            raise InputError(
                f"the edit {self.what!r} is of {w}x{h} pixels, the scan has {columns}x{rows}",
                "undo the edit",
            )
        return self.pixels

    def text(self) -> str:
        """Describe the edit in a line."""
        return describe_edit(self.what, self.points)


def describe_edit(what: str, points: int) -> str:
    """Describe an edit in a line: how its points were selected, and how many it deleted."""
    return f"{what}: {points:,} points deleted"


@dataclass(frozen=True, eq=False)
class EditHistory:
    """The edits of a scan in the order in which they were made, of which the first ``applied`` are
    in effect; those after them were undone. A new edit replaces those that were undone."""

    edits: tuple[Edit, ...] = ()
    applied: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.applied <= len(self.edits):
            raise InputError(
                f"{self.applied} of {len(self.edits)} edits are stated to be in effect"
            )

    @property
    def active(self) -> tuple[Edit, ...]:
        """The edits in effect."""
        return self.edits[: self.applied]

    @property
    def undone(self) -> tuple[Edit, ...]:
        """The edits that `redo` brings back, the next one first."""
        return self.edits[self.applied :]

    def add(self, edit: Edit) -> "EditHistory":
        """Return the history with one more edit; what was undone is forgotten."""
        return EditHistory((*self.active, edit), self.applied + 1)

    def undo(self, count: int = 1) -> "EditHistory":
        """Return the history without the effect of its last edits. InputError where there are
        fewer."""
        if not 1 <= count <= self.applied:
            raise InputError(
                f"{self.applied} edits are in effect: {count} of them cannot be undone"
            )
        return replace(self, applied=self.applied - count)

    def redo(self, count: int = 1) -> "EditHistory":
        """Return the history with undone edits in effect again. InputError where there are
        fewer."""
        if not 1 <= count <= len(self.undone):
            raise InputError(
                f"{len(self.undone)} edits are undone: {count} of them cannot be redone"
            )
        return replace(self, applied=self.applied + count)

    def keep_mask(self, points: np.ndarray) -> Mask:
        """Mask (h, w) of the measured points (h, w, 3) mm that no edit in effect deletes."""
        kept = finite_rows(points)
        for edit in self.active:
            kept &= ~edit.select(points)
        return kept


def make_edit(
    points: np.ndarray, selected: Mask, what: str, plane: SupportPlane | None = None, made: str = ""
) -> Edit:
    """Return the edit that deletes the ``selected`` (h, w) ones of points (h, w, 3) mm: with every
    later calibration, also those at selected pixels that are NaN now.

    ``plane``: what the selection is everything below of, where it is; the edit is then stored as
    this plane. InputError where nothing is selected.
    """
    count = int(np.count_nonzero(selected & finite_rows(points)))
    if not count:
        raise InputError("no point is selected", "select some first")
    return Edit(what, count, selected if plane is None else None, plane, made)


def pack_mask(mask: Mask) -> np.ndarray:
    """Compress a mask (h, w) to bytes (n,), which `unpack_mask` reads."""
    return np.frombuffer(zlib.compress(np.packbits(mask).tobytes(), 6), np.uint8)


def unpack_mask(packed: np.ndarray, size: Sequence[int]) -> Mask:
    """Return the mask (h, w) of bytes (n,) from `pack_mask`; ``size`` is (w, h). InputError where
    they do not fit."""
    w, h = size
    if not 0 < w * h <= _MAX_PIXELS:
        raise InputError(f"a mask of {w}x{h} pixels is stated")
    needed = (w * h + 7) // 8
    reader = zlib.decompressobj()
    try:
        body = reader.decompress(np.asarray(packed, np.uint8).tobytes(), needed + 1)
    except zlib.error as error:
        raise InputError(f"the mask of an edit cannot be read ({error})") from error
    if len(body) != needed:
        raise InputError(
            f"the mask of an edit holds {len(body)} bytes, {needed} are needed for {w}x{h} pixels"
        )
    return np.unpackbits(np.frombuffer(body, np.uint8), count=w * h).astype(bool).reshape(h, w)
