"""Planes and spheres: fitted to points by least squares of the orthogonal distances, and detected
in a cluttered cloud by RANSAC, for initial values of these fits."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import scipy

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.vectors import diagonal, finite_rows, lengths, unit_vectors

MIN_CAP_HEIGHT_RATIO = 4.0
"""A patch is fitted by a sphere only if its height over a plane is at least this many times the
fit's RMS residual."""


@dataclass(frozen=True, eq=False)
class Plane:
    """n . x = d (Letter eq. 12): unit ``normal`` (3,) that points towards the camera (n_z < 0),
    ``offset`` d in mm."""

    normal: Floats
    offset: float

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (...) mm of points (..., 3), positive on the camera's side."""
        return np.asarray(points, dtype=np.float64) @ self.normal - self.offset


@dataclass(frozen=True, eq=False)
class Sphere:
    """``centre`` (3,) and ``radius``, mm."""

    centre: Floats
    radius: float

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed radial distances (...) mm of points (..., 3), positive outside."""
        return _norms(np.asarray(points, dtype=np.float64) - self.centre) - self.radius


AnyShape = TypeVar("AnyShape", Plane, Sphere)


def fit_plane(points: np.ndarray) -> Plane:
    """Total least squares plane of points (n, 3) mm (Letter eq. 12), through their moments; NaN
    rows are excluded.

    Raises InputError for fewer than three points, and for points on one line or in a clump, which
    define no plane.
    """
    points = _select_finite(points, 3, "a plane")
    centroid = points.mean(axis=0)
    centred = points - centroid
    spread, directions = np.linalg.eigh(centred.T @ centred)
    if spread[1] <= 1e-10 * spread[2] or spread[0] > 0.5 * spread[1]:
        raise InputError(
            f"The {len(points)} points lie on a line or in a clump, not on a plane",
            "select a wider region.",
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
    points = _select_finite(points, 4, "a sphere")
    origin = points.mean(axis=0)
    points = points - origin  # better conditioned, and the size of the patch sets the scale
    spread = np.linalg.eigvalsh(points.T @ points / len(points))
    flat = InputError(
        f"The {len(points)} points are too flat to be a part of a sphere",
        "select more of the sphere's cap.",
    )
    if not spread[0] > 1e-14 * spread[2]:
        raise flat
    centre, start = _algebraic_sphere(points)

    def distances(unknowns: Floats) -> Floats:
        """Return the radial distances (n,) mm of the points from the sphere of the unknowns."""
        return _norms(points - unknowns[:3]) - (unknowns[3] if radius is None else radius)

    def jacobian(unknowns: Floats) -> Floats:
        """Return the derivatives (n, 3 or 4) of the radial distances by centre and radius."""
        offsets = points - unknowns[:3]
        derivatives = np.full((len(points), len(unknowns)), -1.0)
        derivatives[:, :3] = -offsets / np.maximum(_norms(offsets), 1e-300)[:, None]
        return derivatives

    unknowns = np.append(centre, start) if radius is None else centre
    fit = scipy.optimize.least_squares(
        distances, unknowns, jacobian, method="lm", ftol=1e-14, xtol=1e-12, max_nfev=200
    )
    r, rms = float(fit.x[3]) if radius is None else radius, np.sqrt(2 * fit.cost / len(points))
    if not (
        np.isfinite(r) and 2.0 * np.sqrt(spread[1] * spread[2]) / r > MIN_CAP_HEIGHT_RATIO * rms
    ):
        raise flat
    return Sphere(fit.x[:3] + origin, r)


def _select_finite(points: np.ndarray, least: int, what: str) -> np.ndarray:
    """The finite rows as float64; InputError for another shape or too few of them."""
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            f"Points of shape {points.shape} were given for {what}", "they must be (n, 3)."
        )
    finite = finite_rows(points)
    if finite.sum() < least:
        raise InputError(
            f"{finite.sum()} points were measured, and {what} needs {least} at least",
            "select a wider region.",
        )
    return points[finite]


def _norms(vectors: np.ndarray) -> np.ndarray:
    """Lengths (...) of vectors (..., 3): `numpy.linalg.norm` along a short axis takes several times
    as long."""
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))


def _algebraic_sphere(points: Floats) -> tuple[Floats, float]:
    """Centre and radius from |x|^2 = 2 c.x + (r^2 - c^2), linear in the unknowns; points about
    their centroid."""
    scale = np.sqrt((points**2).sum(axis=1).mean())
    unit = points / scale
    design = np.column_stack([2.0 * unit, np.ones(len(unit))])
    solution = np.linalg.lstsq(design.T @ design, design.T @ (unit**2).sum(axis=1), rcond=None)[0]
    centre = solution[:3]
    return centre * scale, float(np.sqrt(max(solution[3] + centre @ centre, 1e-12)) * scale)


SAMPLE_SIZE = 3000
"""Points of the subsample that hypotheses are drawn from and scored on."""
HYPOTHESES = 400
REFINED_HYPOTHESES = 12
"""How many of the best hypotheses are refined by least squares before the best is chosen."""


def ransac_plane(points: np.ndarray, tolerance: float) -> tuple[Plane, np.ndarray]:
    """The plane with most inliers among points (n, 3), to ``tolerance`` mm, and its inlier mask
    (n,) bool.

    Draws from a subsample and ends with least squares over all inliers; deterministic. NaN rows are
    excluded. Raises InputError where no plane is detected.
    """

    def hypotheses(triples: Floats) -> Iterable[Plane]:
        """Return the planes through point triples (k, 3, 3), turned either way."""
        a, b, c = triples[:, 0], triples[:, 1], triples[:, 2]
        normals = np.cross(b - a, c - a)
        regular = lengths(normals) > 0
        normals = unit_vectors(normals[regular])
        return map(Plane, normals, np.einsum("ij,ij->i", normals, a[regular]))

    return _search(points, 3, tolerance, hypotheses, fit_plane, "plane")


def ransac_sphere(
    points: np.ndarray, tolerance: float, radius: float | None = None
) -> tuple[Sphere, np.ndarray]:
    """The sphere with most inliers among points (n, 3), to ``tolerance`` mm, and its inlier mask
    (n,) bool.

    With ``radius`` (mm), only spheres of about that size are considered and the result has exactly
    that radius. Otherwise a sphere larger than the cloud is accepted only if no smaller one is
    detected and its cap rises far more than the tolerance: any flat patch would fit one.
    """
    finite = np.asarray(points, dtype=np.float64)[finite_rows(points)]
    extent = diagonal(finite) if len(finite) else 0.0
    least, half = 10.0 * tolerance, 0.5 * extent
    if radius is not None:
        return _search_sphere(points, tolerance, (0.7 * radius, 1.4 * radius), radius)
    try:
        return _search_sphere(points, tolerance, (least, half))
    except InputError as error:
        try:
            return _search_sphere(
                points, tolerance, (half, half * extent / (4 * least)), None, least
            )
        except InputError:
            raise error from None


def _search_sphere(
    points: np.ndarray,
    tolerance: float,
    radii: tuple[float, float],
    radius: float | None = None,
    least_rise: float = 0.0,
) -> tuple[Sphere, np.ndarray]:
    """As ``ransac_sphere``, among spheres of these ``radii``, of which the inliers show a cap of
    ``least_rise`` mm at least."""
    low, high = radii

    def hypotheses(quads: Floats) -> Iterable[Sphere]:
        """Return the spheres through four points each (k, 4, 3)."""
        origin = quads[:, :1]
        edges = quads[:, 1:] - origin
        regular = np.abs(np.linalg.det(edges)) > 1e-12 * lengths(edges).prod(axis=1)
        edges, origin = edges[regular], origin[regular, 0]
        offset = np.linalg.solve(2.0 * edges, (edges**2).sum(axis=2)[..., None])[..., 0]
        radii = lengths(offset)
        sized = (radii >= low) & (radii <= high)
        return map(Sphere, (origin + offset)[sized], radii[sized])

    def fit(chosen: Mask) -> Sphere:
        """Fit a sphere to the inliers (n, 3); InputError where its radius is outside the allowed
        range, or its cap is too flat."""
        sphere = fit_sphere(chosen, radius)
        # of a disc the diameter is four standard deviations, and a cap rises by its square / 8 R
        rise = 2.0 * np.linalg.eigvalsh(np.cov(chosen.T))[1] / sphere.radius
        if not low <= sphere.radius <= high or rise < least_rise:
            raise InputError(
                f"The detected sphere has a radius of {sphere.radius:.1f} mm, too large for its"
                " cloud."
            )
        return sphere

    return _search(points, 4, tolerance, hypotheses, fit, "sphere")


def _search(
    points: np.ndarray,
    needed: int,
    tolerance: float,
    hypotheses: Callable[[Floats], Iterable[AnyShape]],
    fit: Callable[[np.ndarray], AnyShape],
    what: str,
) -> tuple[AnyShape, Mask]:
    """Hypotheses from neighbours at many scales, scored by truncated squares (MSAC); the best few
    refined."""
    points = np.asarray(points, dtype=np.float64)
    valid = points[finite_rows(points)]
    if len(valid) < 3 * needed:
        raise InputError(
            f"{len(valid)} points were measured, too few to detect a {what}",
            "check the capture's exposure.",
        )
    rng = np.random.default_rng(0)
    sample = valid[rng.choice(len(valid), min(SAMPLE_SIZE, len(valid)), replace=False)]

    def score(shape: AnyShape) -> float:
        """Return the sum of squares truncated at the tolerance: fewer and larger residuals cost
        more."""
        return float(np.minimum((shape.distance(sample) / tolerance) ** 2, 1.0).sum())

    refined = []
    drawn = hypotheses(_minimal_sets(sample, needed, rng))
    for shape in sorted(drawn, key=score)[:REFINED_HYPOTHESES]:
        chosen = np.abs(shape.distance(sample)) <= tolerance
        try:
            for _ in range(5):
                before, shape = chosen, fit(sample[chosen])
                chosen = np.abs(shape.distance(sample)) <= tolerance
                if np.array_equal(chosen, before):
                    break
        except InputError:  # too few, or flat: this hypothesis was chance
            continue
        refined.append(shape)
    if not refined:
        raise InputError(
            f"No {what} was detected among {len(valid)} points to {tolerance:g} mm",
            "check that it fills a good part of the view.",
        )
    best = min(refined, key=score)
    shape = fit(points[np.abs(best.distance(points)) <= tolerance])
    return shape, np.abs(shape.distance(points)) <= tolerance


def _minimal_sets(sample: Floats, size: int, rng: np.random.Generator) -> Floats:
    """(HYPOTHESES, size, 3): each a random point and some of its nearest 1, 3, 10 or 25 % of the
    sample.

    Four points drawn anywhere lie on a shape that fills a tenth of the cloud once in ten thousand
    draws; four neighbours, often.
    """
    seeds = rng.choice(len(sample), HYPOTHESES)
    tree = scipy.spatial.cKDTree(sample)
    sets = np.empty((HYPOTHESES, size, 3))
    for share, group in zip(
        (0.01, 0.03, 0.1, 0.25), np.array_split(np.arange(HYPOTHESES), 4), strict=True
    ):
        count = min(max(3 * size, round(share * len(sample))), len(sample))
        _, neighbours = tree.query(sample[seeds[group]], k=count)
        picks = rng.integers(1, count, (len(group), size - 1))
        sets[group, 0] = sample[seeds[group]]
        sets[group, 1:] = sample[np.take_along_axis(neighbours, picks, axis=1)]
    return sets
