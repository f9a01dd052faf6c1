"""One scan as registration takes it: its points, which of them can be trusted to lie on the
surface, and what is computed of them once: downsampled clouds, normals, search trees, features."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats
from slviewer.geometry.vectors import lengths, median_spacing, thin_out
from slviewer.registration.open3d_loader import fit_normals, fpfh_features, open3d, point_cloud

LEAST_POINTS = 500
FINEST = 1 / 200
"""Thinned to one point in such a share of the object's size: the noise of several pixels is
averaged."""
_GRAZING = np.cos(np.radians(75.0))
_RIM_PX = 2
"""So near to the edge of the measured surface, a pixel may have seen two surfaces at once."""
_STEEPEST = 6.0
"""Rise over the pixels' pitch beyond which neighbours do not belong to one surface, or to one seen
too obliquely."""
_NOISE = 4.0
"""Standard deviations that noise alone may add to a step."""


def away_from_edges(points: np.ndarray, sigma_z: np.ndarray | None = None) -> np.ndarray:
    """Return the pixels (h, w) bool of an organised cloud (h, w, 3) mm that are two pixels or more
    inside the surface.

    Edges are invalid pixels, the image's border, and steps that are steep for the pixels' pitch and
    exceed the noise ``sigma_z`` (h, w) mm of both pixels, where it is known.
    """
    inside = np.isfinite(points[..., 2])
    noise = np.zeros(inside.shape)
    if sigma_z is not None:
        noise = _NOISE * np.nan_to_num(sigma_z, posinf=0.0)
    for before, after in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        pitch = lengths((points[after] - points[before])[..., :2])
        known = pitch[np.isfinite(pitch)]
        if not known.size:
            continue
        rise = np.abs(points[after][..., 2] - points[before][..., 2])
        is_step = rise > _STEEPEST * float(np.median(known)) + np.hypot(noise[before], noise[after])
        inside[before] &= ~is_step
        inside[after] &= ~is_step
    return binary_erosion(inside, np.ones((3, 3), bool), _RIM_PX)


@dataclass(frozen=True, eq=False)
class PreparedScan:
    """One scan's points away from edges, which alone decide how it lies.

    ``points`` (n, 3) float64 mm in the frame of the scan's camera; ``fine``: Open3D's cloud of
    them, thinned to ``voxel`` mm, with unit normals towards the camera, without what is seen at
    grazing angles; ``spacing``: median distance in mm of a point to the next; ``size``: longest
    side in mm; ``sigma_mm``: expected error of a point.
    """

    points: Floats
    fine: Any
    voxel: float
    spacing: float
    size: float
    sigma_mm: float | None
    _thinned: dict[float, Any] = field(default_factory=dict)
    _features: dict[float, Any] = field(default_factory=dict)

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree of all points."""
        return cKDTree(self.points, 32, balanced_tree=False, compact_nodes=False)

    @cached_property
    def fine_points(self) -> Floats:
        """(m, 3) float64 mm: points of the thinned cloud."""
        return np.asarray(self.fine.points)

    @cached_property
    def fine_normals(self) -> Floats:
        """(m, 3) float64: normals of the thinned cloud."""
        return np.asarray(self.fine.normals)

    @cached_property
    def fine_tree(self) -> cKDTree:
        """Search tree of the thinned cloud's points."""
        return cKDTree(self.fine_points)

    @cached_property
    def fine_spacing(self) -> float:
        """Median distance in mm between neighbours of the thinned cloud."""
        return median_spacing(self.fine_tree, 2000)

    @cached_property
    def smooth(self) -> tuple[Floats, Floats]:
        """Points (k, 3) mm, thinned to an eightieth of the size, and normals (k, 3) fitted to some
        thirty of them, which show the shape and not the noise; towards either side."""
        cloud = open3d().geometry.PointCloud(self.thinned(self.size / 80.0).points)
        fit_normals(cloud, 30)
        return np.asarray(cloud.points), np.asarray(cloud.normals)

    def features(self, voxel: float) -> Any:
        """Return Open3D's FPFH features of the cloud thinned to ``voxel`` mm; cached."""
        if voxel not in self._features:
            self._features[voxel] = fpfh_features(self.thinned(voxel), 5.0 * voxel, 100)
        return self._features[voxel]

    def thinned(self, voxel: float) -> Any:
        """Return Open3D's cloud thinned to ``voxel`` mm, with unit normals; cached."""
        if voxel <= self.voxel:
            return self.fine
        key = float(f"{voxel:.3g}")
        if key not in self._thinned:
            cloud = self.fine.voxel_down_sample(key)
            cloud.normalize_normals()
            self._thinned[key] = cloud
        return self._thinned[key]


def prepare_scan(
    name: str,
    points: np.ndarray,
    normals: np.ndarray | None = None,
    sigma_mm: float | None = None,
    has_camera: bool = True,
) -> PreparedScan:
    """Prepare the points ``(n, 3)`` mm of one scan, in the frame of its camera, for registration.

    ``normals`` ``(n, 3)`` point to the camera and are estimated where missing; unless it
    ``has_camera``, the points were seen from anywhere. ``name`` is for errors. Raises
    ``InputError`` for points that cannot be used.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"The {name} has shape {points.shape}", "give its valid points as (n, 3).")
    if len(points) < LEAST_POINTS:
        raise InputError(
            f"The {name} has {len(points)} points",
            f"at least {LEAST_POINTS} are needed to align it.",
        )
    if not np.isfinite(points).all():
        raise InputError(
            f"The {name} holds points that are not finite", "exclude its invalid pixels first."
        )
    if normals is not None and normals.shape != points.shape:
        raise InputError(
            f"The {name} has {len(points)} points and normals of shape {normals.shape}",
            "give one each.",
        )
    points = np.ascontiguousarray(points, dtype=np.float64)
    size = measure_size(points)
    if not size > 0:
        raise InputError(
            f"Nearly all points of the {name} are one", "give those that were measured, each once."
        )
    voxel = FINEST * size
    fine = _make_cloud(points, normals, voxel, has_camera)
    if len(fine.points) < LEAST_POINTS // 5:
        raise InputError(
            f"Nearly all of the {len(points)} points of the {name} are seen at grazing angles or"
            f" have no normal ({len(fine.points)} places are left)",
            "turn the object towards the camera.",
        )
    spacing = median_spacing(cKDTree(np.asarray(fine.points)), 2000)
    spacing /= np.sqrt(len(points) / len(fine.points))
    return PreparedScan(points, fine, voxel, float(spacing), size, sigma_mm)


def measure_size(points: np.ndarray) -> float:
    """Return the longest side in mm of the points' bounding box between their 1st and 99th
    percentiles."""
    low, high = np.percentile(thin_out(points, 100_000), (1.0, 99.0), axis=0)
    return float((high - low).max())


def _make_cloud(points: Floats, normals: np.ndarray | None, voxel: float, has_camera: bool) -> Any:
    """Return Open3D's cloud thinned to ``voxel`` mm, with unit normals towards the camera at the
    origin, if it has one."""
    # a NaN normal weighs nothing in a voxel's mean
    finite = None if normals is None else np.nan_to_num(np.asarray(normals, dtype=np.float64))
    cloud = point_cloud(points, finite).voxel_down_sample(voxel)
    if normals is None:
        fit_normals(cloud, 30)
        cloud.orient_normals_towards_camera_location(np.zeros(3))
    else:
        known = lengths(np.asarray(cloud.normals)) > 0.1
        cloud = cloud.select_by_index(np.flatnonzero(known))
        cloud.normalize_normals()
    if not has_camera:
        return cloud
    seen = np.asarray(cloud.points)
    facing = -np.sum(np.asarray(cloud.normals) * seen, axis=1) / lengths(seen)
    return cloud.select_by_index(np.flatnonzero(facing > _GRAZING))
