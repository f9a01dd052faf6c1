"""Which pixels of an organised cloud show the plane or the sphere, found in the cloud itself.

RANSAC says where the shape is; the largest patch of connected pixels within a tolerance says how
far it reaches. The tolerance is many times wider than any form error worth measuring, so that
finding the shape never flatters it: what is wrong by less stays in, and what is wrong by more,
inside the patch, stays in too, to be counted as set aside. Where a cloud is noisier than that (Gray
code alone), the tolerances follow its expected noise.
"""

from collections.abc import Callable

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.evaluation.fit import Fitted
from slviewer.geometry.shapes import (
    Plane,
    Sphere,
    fit_plane,
    fit_sphere,
    ransac_plane,
    ransac_sphere,
)
from slviewer.geometry.vectors import finite_rows

RANSAC_TOLERANCE_MM = 1.0  # or twice the noise
PATCH_TOLERANCE_MM = 3.0  # or six times the noise
SPHERE_TOLERANCE = 0.04  # of its radius, if that is less
RIM_PX = 2  # mixed pixels at an object's outline show neither the object nor what is behind it
LEAST_PIXELS = 200
_SAMPLE = 40_000


def find_plane(
    points: np.ndarray, sigma_z: np.ndarray | None = None, start: Plane | None = None
) -> tuple[Plane, np.ndarray]:
    """Detect the plane with most pixels of a cloud ``(h, w, 3)``, and its region ``(h, w)`` bool.

    ``sigma_z`` ``(h, w)`` mm is the expected noise. The region is one patch without its outermost
    two pixels; isolated pixels and small holes inside it belong to it, whether something was
    measured there or not. A roughly known plane to ``start`` from spares the search. The plane that
    comes back is a start for fits, not a result. Raises ``InputError`` where no plane fills a
    patch.
    """
    measured = measured_pixels(points, None)
    reach = max(PATCH_TOLERANCE_MM, 6.0 * _typical_noise(sigma_z, measured))
    first = start or start_plane(points, measured, sigma_z)
    return _grow_patch(points, measured, first, fit_plane, lambda shape: reach, "flat")


def find_sphere(
    points: np.ndarray,
    mask: np.ndarray | None = None,
    sigma_z: np.ndarray | None = None,
    radius: float | None = None,
    start: Sphere | None = None,
) -> tuple[Sphere, np.ndarray]:
    """Detect the sphere with most pixels, and its region, as ``find_plane``; ``radius`` in mm
    narrows the search."""
    measured = measured_pixels(points, mask)
    noise = _typical_noise(sigma_z, measured)

    def reach(shape: Sphere) -> float:
        """Return the tolerance in mm for points on a sphere: by its radius, and at least six sigma
        of noise."""
        return max(min(PATCH_TOLERANCE_MM, SPHERE_TOLERANCE * shape.radius), 6.0 * noise)

    first = start or start_sphere(points, measured, sigma_z, radius)
    return _grow_patch(points, measured, first, fit_sphere, reach, "round")


def find_spheres(
    points: np.ndarray, count: int, sigma_z: np.ndarray | None = None, radius: float | None = None
) -> list[tuple[Sphere, np.ndarray]]:
    """``count`` spheres of one cloud and their regions, from left to right in the image."""
    free = measured_pixels(points, None)
    spheres = []
    for _ in range(count):
        sphere, region = find_sphere(points, free, sigma_z, radius)
        spheres.append((sphere, region))
        free &= ~cv2.dilate(
            region.astype(np.uint8), np.ones((4 * RIM_PX + 1,) * 2, np.uint8)
        ).astype(bool)
    return sorted(spheres, key=lambda each: float(np.nonzero(each[1])[1].mean()))


def start_plane(points: np.ndarray, mask: np.ndarray, sigma_z: np.ndarray | None = None) -> Plane:
    """Estimate the plane that most points under ``mask`` agree with, by RANSAC."""
    measured = measured_pixels(points, mask)
    tolerance = max(RANSAC_TOLERANCE_MM, 2.0 * _typical_noise(sigma_z, measured))
    return ransac_plane(sample_points(points, measured), tolerance)[0]


def start_sphere(
    points: np.ndarray,
    mask: np.ndarray,
    sigma_z: np.ndarray | None = None,
    radius: float | None = None,
) -> Sphere:
    """Estimate the sphere that most points under ``mask`` agree with, by RANSAC."""
    measured = measured_pixels(points, mask)
    tolerance = max(RANSAC_TOLERANCE_MM, 2.0 * _typical_noise(sigma_z, measured))
    return ransac_sphere(sample_points(points, measured), tolerance, radius)[0]


def _typical_noise(sigma_z: np.ndarray | None, measured: np.ndarray) -> float:
    """Median noise of the measured pixels in mm; 0 where none is known."""
    if sigma_z is None:
        return 0.0
    if sigma_z.shape != measured.shape:
        raise InputError(
            f"The noise map has shape {sigma_z.shape} and the cloud {measured.shape}: they must"
            " agree."
        )
    known = sigma_z[measured & np.isfinite(sigma_z)]
    return float(np.median(known)) if known.size else 0.0


def measured_pixels(points: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Return which pixels ``(h, w)`` of a cloud hold a point, under a mask if there is one;
    ``InputError`` if too few do."""
    if points.ndim != 3 or points.shape[2] != 3:
        raise InputError(
            f"The cloud has shape {points.shape}: an organised cloud (h, w, 3) is needed."
        )
    if mask is not None and mask.shape != points.shape[:2]:
        raise InputError(
            f"The mask has shape {mask.shape} and the cloud {points.shape[:2]}: they must agree."
        )
    measured = finite_rows(points)
    measured = measured if mask is None else measured & mask
    if np.count_nonzero(measured) < LEAST_PIXELS:
        raise InputError(
            f"{np.count_nonzero(measured)} points were measured where the shape is looked for: at"
            f" least {LEAST_PIXELS} are needed; check that it is in view and illuminated."
        )
    return measured


def sample_points(points: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return some 40,000 of the measured points, (n, 3) float64."""
    chosen = points[measured]
    return chosen[:: -(-len(chosen) // _SAMPLE)].astype(np.float64)


def _grow_patch(
    points: np.ndarray,
    measured: np.ndarray,
    shape: Fitted,
    fit: Callable[[np.ndarray], Fitted],
    tolerance: Callable[[Fitted], float],
    kind: str,
) -> tuple[Fitted, np.ndarray]:
    """Alternate between a patch of agreeing pixels and least squares over it, until the patch is
    stable."""
    patch = np.zeros_like(measured)
    for _ in range(20):
        before = patch
        agreeing = measured & (
            np.abs(shape.distance(np.where(measured[..., None], points, 0.0))) < tolerance(shape)
        )
        patch = _largest_patch(agreeing)
        region = _remove_rim(patch)
        shown = np.count_nonzero(region & agreeing)
        if shown < LEAST_PIXELS or shown < 0.5 * np.count_nonzero(region & measured):
            raise InputError(
                f"The largest {kind} patch has {shown} of {np.count_nonzero(measured)} measured"
                " pixels: check that the shape fills a good part of the view, and that the cloud"
                " is not mere noise."
            )
        if np.count_nonzero(patch ^ before) <= 1e-4 * np.count_nonzero(patch):
            break
        shape = fit(sample_points(points, patch & agreeing))
    return shape, region


def _largest_patch(agreeing: np.ndarray) -> np.ndarray:
    """Return the largest 4-connected patch; gaps of up to four unmeasured pixels do not cut it, and
    small holes are filled."""
    closed = cv2.morphologyEx(agreeing.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=4)
    if count < 2:
        return np.zeros_like(agreeing)
    patch = labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        (~patch).astype(np.uint8), connectivity=8
    )
    small = stats[:, cv2.CC_STAT_AREA] < 0.005 * np.count_nonzero(patch)
    h, w = patch.shape
    inside = (
        (stats[:, 0] > 0)
        & (stats[:, 1] > 0)
        & (stats[:, 0] + stats[:, 2] < w)
        & (stats[:, 1] + stats[:, 3] < h)
    )
    holes = small & inside
    holes[0] = False  # label 0 is the patch itself
    return patch | holes[labels]


def _remove_rim(patch: np.ndarray) -> np.ndarray:
    """Return the patch without its outermost pixels, where it ends inside the image."""
    kernel = np.ones((2 * RIM_PX + 1,) * 2, np.uint8)
    return cv2.erode(patch.astype(np.uint8), kernel, borderValue=1).astype(bool)
