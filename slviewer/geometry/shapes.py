"""Planes and spheres fitted to points: least squares of the orthogonal distances."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from slviewer.errors import InputError
from slviewer.geometry.vectors import finite_rows

MIN_CAP_HEIGHT_RATIO = 4.0
"""A patch is fitted by a sphere only if its height over a plane is at least this many times the
fit's RMS residual."""


@dataclass(frozen=True, eq=False)
class Plane:
    """n . x = d (Letter eq. 12): unit ``normal`` (3,) that points towards the camera (n_z < 0),
    ``offset`` d in mm."""

    normal: np.ndarray
    offset: float

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (...) mm of points (..., 3), positive on the camera's side."""
        return np.asarray(points, dtype=np.float64) @ self.normal - self.offset


@dataclass(frozen=True, eq=False)
class Sphere:
    """``centre`` (3,) and ``radius``, mm."""

    centre: np.ndarray
    radius: float

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed radial distances (...) mm of points (..., 3), positive outside."""
        return _norms(np.asarray(points, dtype=np.float64) - self.centre) - self.radius


def fit_plane(points: np.ndarray, weights: np.ndarray | None = None) -> Plane:
    """Total least squares plane of points (n, 3) mm (Letter eq. 12), through their moments; NaN
    rows are excluded.

    ``weights``: (n,), one over each point's variance. Raises InputError for fewer than three
    points, and for points on one line or in a clump, which define no plane.
    """
    points, finite = _select_finite(points, 3, "a plane")
    w = np.ones(len(points)) if weights is None else np.asarray(weights, dtype=np.float64)[finite]
    if not w.sum() > 0:
        raise InputError(
            "All points of a plane fit have weight 0: give at least three of them a positive"
            " weight."
        )
    centroid = w @ points / w.sum()
    centred = points - centroid
    spread, directions = np.linalg.eigh((centred * w[:, None]).T @ centred)
    if spread[1] <= 1e-10 * spread[2] or spread[0] > 0.5 * spread[1]:
        raise InputError(
            f"The {len(points)} points lie on a line or in a clump, not on a plane: select a wider"
            " region."
        )
    normal = directions[:, 0]
    if normal[2] > 0 or (normal[2] == 0 and normal @ centroid > 0):
        normal = -normal
    return Plane(normal, float(normal @ centroid))


def fit_sphere(points: np.ndarray, radius: float | None = None) -> Sphere:
    """Sphere of least orthogonal distances to points (n, 3) mm, with the radius fixed if given; NaN
    rows are excluded.

    Levenberg-Marquardt from the algebraic fit. Raises InputError for fewer than four points, and
    for a patch that is flat, exactly or within its noise.
    """
    points, _ = _select_finite(points, 4, "a sphere")
    origin = points.mean(axis=0)
    points = points - origin  # better conditioned, and the size of the patch sets the scale
    spread = np.linalg.eigvalsh(points.T @ points / len(points))
    flat = InputError(
        f"The {len(points)} points are too flat to be a part of a sphere: select more of the"
        " sphere's cap."
    )
    if not spread[0] > 1e-14 * spread[2]:
        raise flat
    centre, start = _algebraic_sphere(points)
    centre, r, rms = _refine_sphere(
        points, centre, start if radius is None else radius, radius is not None
    )

    if not (
        np.isfinite(r) and 2.0 * np.sqrt(spread[1] * spread[2]) / r > MIN_CAP_HEIGHT_RATIO * rms
    ):
        raise flat
    return Sphere(centre + origin, r)


def _select_finite(points: np.ndarray, least: int, what: str) -> tuple[np.ndarray, np.ndarray]:
    """The finite rows as float64, and which they are; InputError for another shape or too few of
    them."""
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            f"Points of shape {points.shape} were given for {what}: they must be (n, 3)."
        )
    finite = finite_rows(points)
    if finite.sum() < least:
        raise InputError(
            f"{finite.sum()} points were measured, and {what} needs {least} at least: select a"
            " wider region."
        )
    return (points if finite.all() else points[finite]), finite


def _norms(vectors: np.ndarray) -> np.ndarray:
    """Lengths (...) of vectors (..., 3): `numpy.linalg.norm` along a short axis takes several times
    as long."""
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))


def _algebraic_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius from |x|^2 = 2 c.x + (r^2 - c^2), linear in the unknowns; points about
    their centroid."""
    scale = np.sqrt((points**2).sum(axis=1).mean())
    unit = points / scale
    design = np.column_stack([2.0 * unit, np.ones(len(unit))])
    solution = np.linalg.lstsq(design.T @ design, design.T @ (unit**2).sum(axis=1), rcond=None)[0]
    centre = solution[:3]
    return centre * scale, float(np.sqrt(max(solution[3] + centre @ centre, 1e-12)) * scale)


def _refine_sphere(
    points: np.ndarray, centre: np.ndarray, radius: float, fixed: bool
) -> tuple[np.ndarray, float, float]:
    """Levenberg-Marquardt on centre (and radius): (centre, radius, RMS of the radial distances)."""

    def distances(unknowns: np.ndarray) -> np.ndarray:
        """Return the radial distances (n,) mm of the points from the sphere of the unknowns."""
        return _norms(points - unknowns[:3]) - (radius if fixed else unknowns[3])

    def jacobian(unknowns: np.ndarray) -> np.ndarray:
        """Return the derivatives (n, 3 or 4) of the radial distances by centre and radius."""
        offsets = points - unknowns[:3]
        derivatives = np.full((len(points), len(unknowns)), -1.0)
        derivatives[:, :3] = -offsets / np.maximum(_norms(offsets), 1e-300)[:, None]
        return derivatives

    start = centre if fixed else np.append(centre, radius)
    fit = least_squares(
        distances, start, jacobian, method="lm", ftol=1e-14, xtol=1e-12, max_nfev=200
    )
    return (
        fit.x[:3],
        radius if fixed else float(fit.x[3]),
        float(np.sqrt(2 * fit.cost / len(points))),
    )
