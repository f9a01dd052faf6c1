"""RANSAC detection of a plane or a sphere in a cluttered cloud: initial values for the
least-squares fits."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.shapes import Plane, Sphere, fit_plane, fit_sphere
from slviewer.geometry.vectors import diagonal, finite_rows, lengths, unit_vectors

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

    def hypotheses(triples: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return normals (k, 3) and offsets (k,) mm of the planes through point triples (k, 3,
        3)."""
        a, b, c = triples[:, 0], triples[:, 1], triples[:, 2]
        normals = np.cross(b - a, c - a)
        regular = lengths(normals) > 0
        normals = unit_vectors(normals[regular])
        return normals, np.einsum("ij,ij->i", normals, a[regular])

    def distances(sample: np.ndarray, normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return the signed distances (k, n) mm of the sample (n, 3) from each plane."""
        return normal @ sample.T - offset[:, None]

    return _search(points, 3, tolerance, hypotheses, distances, fit_plane, "plane")


def ransac_sphere(
    points: np.ndarray, tolerance: float, radius: float | None = None
) -> tuple[Sphere, np.ndarray]:
    """The sphere with most inliers among points (n, 3), to ``tolerance`` mm, and its inlier mask
    (n,) bool.

    With ``radius`` (mm), only spheres of about that size are considered and the result has exactly
    that radius; without, spheres larger than the cloud are excluded, because any flat patch would
    fit one.
    """
    finite = np.asarray(points, dtype=np.float64)[finite_rows(points)]
    extent = diagonal(finite) if len(finite) else 0.0
    low, high = (10.0 * tolerance, 0.5 * extent) if radius is None else (0.7 * radius, 1.4 * radius)

    def hypotheses(quads: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return centres (k, 3) and radii (k,) mm of the spheres through four points each (k, 4,
        3)."""
        origin = quads[:, :1]
        edges = quads[:, 1:] - origin
        regular = np.abs(np.linalg.det(edges)) > 1e-12 * lengths(edges).prod(axis=1)
        edges, origin = edges[regular], origin[regular, 0]
        offset = np.linalg.solve(2.0 * edges, (edges**2).sum(axis=2)[..., None])[..., 0]
        radii = lengths(offset)
        sized = (radii >= low) & (radii <= high)
        return (origin + offset)[sized], radii[sized]

    def distances(sample: np.ndarray, centre: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """Return the signed radial distances (k, n) mm of the sample (n, 3) from each sphere."""
        middle = sample.mean(axis=0)  # centred: the difference of squares loses no digits
        x, c = sample - middle, centre - middle
        squares = np.einsum("ij,ij->i", x, x) + np.einsum("ij,ij->i", c, c)[:, None] - 2.0 * c @ x.T
        return np.sqrt(np.maximum(squares, 0.0)) - radii[:, None]

    def fit(chosen: np.ndarray) -> Sphere:
        """Fit a sphere to the inliers (n, 3); InputError where its radius is outside the allowed
        range."""
        sphere = fit_sphere(chosen, radius)
        if not low <= sphere.radius <= high:
            raise InputError(
                f"The detected sphere has a radius of {sphere.radius:.1f} mm, too large for its"
                " cloud."
            )
        return sphere

    return _search(points, 4, tolerance, hypotheses, distances, fit, "sphere")


def _search(
    points: np.ndarray,
    needed: int,
    tolerance: float,
    hypotheses: Callable[[np.ndarray], tuple[np.ndarray, ...]],
    distances: Callable[..., np.ndarray],
    fit: Callable,
    what: str,
) -> tuple:
    """Hypotheses from neighbours at many scales, scored by truncated squares (MSAC); the best few
    refined."""
    points = np.asarray(points, dtype=np.float64)
    finite = finite_rows(points)
    valid = points[finite]
    if len(valid) < 3 * needed:
        raise InputError(
            f"{len(valid)} points were measured, too few to detect a {what}: check the capture's"
            " exposure."
        )
    rng = np.random.default_rng(0)
    sample = valid[rng.choice(len(valid), min(SAMPLE_SIZE, len(valid)), replace=False)]
    parameters = hypotheses(_minimal_sets(sample, needed, rng))
    # score in slices, so that the table of distances stays small
    scores = np.concatenate(
        [
            _score(distances(sample, *(p[i : i + 50] for p in parameters)), tolerance)
            for i in range(0, len(parameters[0]), 50)
        ]
        or [np.empty(0)]
    )
    best, best_score = None, np.inf
    for index in np.argsort(scores)[:REFINED_HYPOTHESES]:
        chosen = (
            np.abs(distances(sample, *(p[index : index + 1] for p in parameters))[0]) <= tolerance
        )
        try:
            for _ in range(5):
                before, shape = chosen, fit(sample[chosen])
                chosen = np.abs(shape.distance(sample)) <= tolerance
                if np.array_equal(chosen, before):
                    break
        except InputError:  # too few, or flat: this hypothesis was chance
            continue
        score = float(_score(shape.distance(sample), tolerance))
        if score < best_score:
            best, best_score = shape, score
    if best is None:
        raise InputError(
            f"No {what} was detected among {len(valid)} points to {tolerance:g} mm: "
            "check that it fills a good part of the view."
        )
    with np.errstate(invalid="ignore"):
        inliers = np.abs(best.distance(points)) <= tolerance
    shape = fit(points[inliers])
    with np.errstate(invalid="ignore"):
        return shape, np.abs(shape.distance(points)) <= tolerance


def _minimal_sets(sample: np.ndarray, size: int, rng: np.random.Generator) -> np.ndarray:
    """(HYPOTHESES, size, 3): each a random point and some of its nearest 1, 3, 10 or 25 % of the
    sample.

    Four points drawn anywhere lie on a shape that fills a tenth of the cloud once in ten thousand
    draws; four neighbours, often.
    """
    seeds = rng.choice(len(sample), HYPOTHESES)
    tree = cKDTree(sample)
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


def _score(residuals: np.ndarray, tolerance: float) -> np.ndarray:
    """Sum of squares truncated at the tolerance, along the last axis: fewer and larger residuals
    cost more."""
    return np.minimum((residuals / tolerance) ** 2, 1.0).sum(axis=-1)
