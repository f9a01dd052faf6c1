"""Robust starts of fits: least median of squares over small samples."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.shapes import fit_plane, fit_sphere
from slviewer.geometry.vectors import lengths, unit_vectors
from slviewer.inspection.features import Feature, Kind

SAMPLE = 1000
HYPOTHESES = 400
POLISHED = 5
NEIGHBOURS = (12, 60)
NEAR = 2.5
"""Robust standard deviations: what lies nearer belongs to a hypothesis."""


def estimate_start(
    kind: Kind, points: np.ndarray, fit: Callable[[np.ndarray, Feature | None], Feature]
) -> Feature:
    """Estimate the shape that is closest to at least half of the points (n, 3); the same points
    give the same result.

    ``fit``: least squares over points, from a start. Raises InputError, the last one's, where no
    sample holds a shape.
    """
    rng = np.random.default_rng(0)
    sample = points[rng.choice(len(points), min(SAMPLE, len(points)), replace=False)]
    normals = local_normals(sample, points) if kind == "cylinder" else None
    # samples of the whole region show its curvature; noise would hide it from neighbours
    rated: list[tuple[float, int, Feature]] = []
    for n in range(HYPOTHESES if kind != "plane" else HYPOTHESES // 4):
        try:
            candidate = _fit_sample(kind, sample, normals, rng)
        except (InputError, np.linalg.LinAlgError):
            continue
        if candidate is not None:
            rated.append((_median_distance(candidate, sample), n, candidate))
    refused: InputError | None = None
    best: tuple[float, Feature] | None = None
    for rating, _, candidate in sorted(rated, key=lambda each: each[:2])[:POLISHED]:
        for _ in range(3):
            chosen = np.abs(candidate.distance(sample)) <= NEAR * 1.4826 * rating + 1e-9
            try:
                candidate = fit(sample[chosen], candidate)
            except InputError as error:
                refused = error
                break
            rating = _median_distance(candidate, sample)
        else:
            if best is None or rating < best[0]:
                best = rating, candidate
    if best is None:
        raise refused or InputError(
            f"No {kind} passes through the {len(points)} points: select another region."
        )
    return best[1]


def local_normals(sample: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(m, 3): unit normals at ``sample`` (m, 3), of either sign, from neighbours among ``points``
    (n, 3): about a tenth of the region across, so that the noise of a point does not tilt them."""
    thin = points[:: max(1, len(points) // 6000)]
    count = int(np.clip(len(thin) // 100, *NEIGHBOURS))
    _, near = cKDTree(thin).query(sample, k=min(count, len(thin)))
    patches = thin[near]
    patches = patches - patches.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", patches, patches))[1][:, :, 0]


def _fit_sample(
    kind: Kind, sample: np.ndarray, normals: np.ndarray | None, rng: np.random.Generator
) -> Feature | None:
    """Return the shape through a minimal sample of points; None where they do not determine it."""
    if kind == "cylinder":
        assert normals is not None
        return _cylinder_through(sample, normals, rng)
    some = sample[rng.integers(0, len(sample), 3 if kind == "plane" else 4)]
    if kind == "plane":
        plane = fit_plane(some)
        return Feature("plane", some.mean(axis=0), plane.normal)
    offset = _offset_of_centre(some, 1e-9)
    return (
        None
        if offset is None
        else Feature("sphere", some[0] + offset, None, float(np.linalg.norm(offset)))
    )


def _cylinder_through(
    sample: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> Feature | None:
    """Return the cylinder through a sample of three points with normals: two normals give the axis
    (Gauss map), and the circle through the points, projected along it, the rest."""
    i, j, k = rng.integers(0, len(sample), 3)
    axis = np.cross(normals[i], normals[j])
    length = np.linalg.norm(axis)
    if length < 0.05:
        return None
    axis /= length
    u = unit_vectors(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]))
    frame = np.stack([u, np.cross(axis, u)])
    flat = sample[[i, j, k]] @ frame.T
    offset = _offset_of_centre(flat, 1e-6)
    if offset is None:
        return None
    return Feature("cylinder", (flat[0] + offset) @ frame, axis, float(np.linalg.norm(offset)))


def _offset_of_centre(points: np.ndarray, flattest: float) -> np.ndarray | None:
    """Return the centre (k,) of the sphere (circle) through points (k + 1, k), relative to the
    first; None for points that are flatter than the share ``flattest``."""
    edges = points[1:] - points[0]
    if abs(np.linalg.det(edges)) <= flattest * lengths(edges).prod():
        return None
    return np.linalg.solve(2.0 * edges, (edges**2).sum(axis=1))


def _median_distance(feature: Feature, points: np.ndarray) -> float:
    """Return the median absolute distance in mm of points (n, 3) from a feature."""
    return float(np.median(np.abs(feature.distance(points))))


def fit_sphere_feature(points: np.ndarray) -> Feature:
    """The least-squares sphere of points (n, 3). Raises InputError where they are too flat for
    one."""
    sphere = fit_sphere(points)
    return Feature("sphere", sphere.centre, None, sphere.radius)


def fit_plane_feature(points: np.ndarray) -> Feature:
    """Return the least-squares plane of points (n, 3); its place is their centroid."""
    plane = fit_plane(points)
    middle = points.mean(axis=0)
    return Feature("plane", middle - plane.distance(middle) * plane.normal, plane.normal)
