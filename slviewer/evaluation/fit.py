"""One least-squares shape in one cloud: its residuals, and those that noise alone would cause."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.shapes import Plane, Sphere
from slviewer.geometry.vectors import finite_rows, rms, unit_vectors
from slviewer.records.verification import MAX_EXCLUDED

Fitted = TypeVar("Fitted", Plane, Sphere)

MAX_SIGMA = 5.0
LEAST_POINTS = 100


@dataclass(frozen=True, eq=False)
class ShapeResult:
    """Distances of a cloud from its own best plane or sphere.

    ``points`` pixels were evaluated; of these ``excluded`` lie beyond 5 robust sigma and count
    neither in the fit nor in ``rms_mm``, the root mean square of the perpendicular (radial)
    distances. ``noise_floor_mm`` is what that would be from the cloud's expected noise alone, over
    the same pixels; NaN where none is known. ``error_map`` ``(h, w)`` float32, mm, NaN where
    nothing was evaluated, holds every distance, those excluded too: positive towards the camera for
    a plane, outwards for a sphere. ``inliers`` ``(h, w)`` bool says which pixels counted.
    """

    rms_mm: float
    noise_floor_mm: float
    points: int
    excluded: int
    error_map: np.ndarray
    inliers: np.ndarray

    @property
    def excluded_share(self) -> float:
        """Share of the points that were excluded as outliers."""
        return self.excluded / self.points

    @property
    def warning(self) -> str | None:
        """A warning if so many points were excluded that the RMS is not representative of the
        shape."""
        if self.excluded_share <= MAX_EXCLUDED:
            return None
        return (
            f"{100 * self.excluded_share:.1f} % of the points are outliers, beyond {MAX_SIGMA:g}"
            " robust standard deviations, and not part of the RMS: look at the error map before"
            " you trust it."
        )


class Shape(Protocol):
    """A surface with distances from it."""

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (n,) mm of points (n, 3)."""


AnyShape = TypeVar("AnyShape", bound=Shape)


def fit_settled(
    fit: Callable[[np.ndarray, AnyShape], AnyShape], points: np.ndarray, start: AnyShape
) -> tuple[AnyShape, np.ndarray]:
    """Fit a shape to points (n, 3) mm, those beyond 5 robust sigma excluded, repeated until the set
    is stable.

    ``fit(points, shape)`` is a least-squares fit that may start from a shape. Returns the shape and
    which points were used, (n,) bool.
    """
    shape, inliers = start, np.zeros(len(points), dtype=bool)
    for _ in range(30):
        before, inliers = inliers, within_sigmas(shape.distance(points), points)
        if np.count_nonzero(inliers ^ before) <= 1e-5 * len(points):
            break
        shape = fit(points[inliers], shape)
    return shape, inliers


def within_sigmas(residuals: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n,) bool: the residuals (n,) mm within 5 robust sigma of their median.

    Sigma is that of *all* residuals, so that it does not shrink from round to round until only the
    best are left; of exact points it is nothing but rounding, which excludes none of them.
    """
    reach = max(MAX_SIGMA * robust_sigma(residuals), 1e-9 * float(np.abs(points).max()))
    return np.abs(residuals - np.median(residuals)) <= reach


def fit_shape(
    points: np.ndarray,
    mask: np.ndarray,
    sigma_z: np.ndarray | None,
    start: Fitted,
    fit: Callable[[np.ndarray], Fitted],
) -> tuple[Fitted, ShapeResult]:
    """Fit the shape to the measured pixels under ``mask`` of a cloud ``(h, w, 3)``, and evaluate
    the residuals."""
    evaluated = mask & finite_rows(points)
    chosen = points[evaluated].astype(np.float64)
    if len(chosen) < LEAST_POINTS:
        raise InputError(
            f"{len(chosen)} points were measured in the region: at least {LEAST_POINTS} are needed."
        )
    shape, is_inlier = fit_settled(lambda some, _: fit(some), chosen, start)
    residuals = shape.distance(chosen)

    error_map = np.full(points.shape[:2], np.nan, dtype=np.float32)
    error_map[evaluated] = residuals
    inliers = np.zeros(points.shape[:2], dtype=bool)
    inliers[evaluated] = is_inlier
    floor = (
        float("nan") if sigma_z is None else noise_floor(shape, chosen[is_inlier], sigma_z[inliers])
    )
    error = rms(residuals[is_inlier])
    return shape, ShapeResult(
        error, floor, len(chosen), int(np.count_nonzero(~is_inlier)), error_map, inliers
    )


def noise_floor(shape: Plane | Sphere, points: np.ndarray, sigma_z: np.ndarray) -> float:
    """Root mean square of ``sigma_z |n . r|`` over points (n, 3), r = (x/z, y/z, 1), n the shape's
    normal there; mm.

    ``sigma_z`` (n,) is the expected noise of each depth; an error of z moves the point along its
    ray r.
    """
    known = np.isfinite(sigma_z)
    if not known.any():
        return float("nan")
    points, sigma_z = points[known], sigma_z[known].astype(np.float64)
    rays = points / points[:, 2:]
    if isinstance(shape, Plane):
        along = rays @ shape.normal
    else:
        along = np.sum(unit_vectors(points - shape.centre) * rays, axis=1)
    return rms(sigma_z * along)
