"""The place of one rig in the frame of another, from what both see at once: a board, spheres, or
the surface of a part; with its uncertainty."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.errors import InputError
from slviewer.geometry.rigid import (
    Floats,
    adjoint,
    coverage_radius,
    fit_rigid,
    invert,
    motion_jacobian,
    move_points,
    rigid_transform,
    turn_about,
)
from slviewer.geometry.shapes import ransac_sphere
from slviewer.registration.machine_places import at_point

MAX_RATIO = 3.0
"""Residuals over their prediction above which captures do not show one place."""
CLEARER = 5.0
"""Times smaller residuals by which one orientation of a symmetric board is chosen."""
LEAST_SPHERES, MOST_SPHERES, LEAST_SHARE = 3, 8, 0.02
MATCHED_SIGMAS = 6.0


@dataclass(frozen=True, eq=False)
class Sighting:
    """One measurement of ``T`` (4, 4) T_reference_rig, mm, with the ``covariance`` (6, 6) of a
    small turn (rad) about ``middle`` (3,) and shift (mm), in the reference's frame. ``others``:
    further T that a symmetric board allows."""

    name: str
    T: Floats
    covariance: Floats
    middle: Floats
    others: tuple[Floats, ...] = ()

    def difference(self, T: Floats) -> Floats:
        """Return the small motion (6,) from another transform to this one, about the middle."""
        D = self.T @ invert(T)
        turn = Rotation.from_matrix(D[:3, :3]).as_rotvec()
        shift = D[:3, :3] @ self.middle + D[:3, 3] - self.middle
        return np.concatenate([turn, shift])


@dataclass(frozen=True, eq=False)
class RigFit:
    """The place ``T`` (4, 4) T_reference_rig of a rig, with its ``covariance`` (6, 6) about the
    ``middle`` (3,); ``residuals`` (n, 6) of the sightings; ``ratio``: these over their prediction,
    by which the covariance is raised, None of a single sighting."""

    T: Floats
    covariance: Floats
    middle: Floats
    residuals: Floats
    ratio: float | None

    @property
    def U_mm(self) -> float:
        """Expanded uncertainty (k = 2) of the translation at the middle."""
        return coverage_radius(self.covariance[3:, 3:])

    @property
    def U_deg(self) -> float:
        """Expanded uncertainty (k = 2) of the rotation."""
        return float(np.degrees(coverage_radius(self.covariance[:3, :3])))


def sight_board(
    name: str,
    reference: tuple[Floats, Floats],
    rig: tuple[Floats, Floats],
    symmetry: int = 1,
) -> Sighting:
    """Return the sighting of one board, T_camera_board (4, 4) mm and covariance (6, 6) by the
    reference and by the rig; ``symmetry``: in how many orientations about its z axis it looks the
    same."""
    (own, own_covariance), (other, other_covariance) = reference, rig
    turned = adjoint(rigid_transform(own[:3, :3], np.zeros(3)))
    angles = np.arange(1, symmetry) * 2 * np.pi / symmetry
    ways = [rigid_transform(Rotation.from_euler("z", a).as_matrix(), np.zeros(3)) for a in angles]
    return Sighting(
        name,
        own @ invert(other),
        turned @ (own_covariance + other_covariance) @ turned.T,
        own[:3, 3],
        tuple(own @ way @ invert(other) for way in ways),
    )


def fit_rig(sightings: Sequence[Sighting]) -> RigFit:
    """Fit the place of a rig to its sightings, weighted by their uncertainty.

    Raises InputError where they contradict each other, or where a symmetric board leaves several
    places.
    """
    fits = [_combine(chosen) for chosen in _list_orientations(sightings)]
    fits.sort(key=lambda fit: fit.ratio or 0.0)
    if len(fits) > 1 and not (fits[0].ratio or 1) * CLEARER < (fits[1].ratio or 1):
        raise InputError(
            "the board looks the same after a turn, so that its captures allow several places of"
            " the rig",
            "capture it in two or more tilts, or use a board with a mark or a ChArUco board",
        )
    best = fits[0]
    if best.ratio is not None and best.ratio > MAX_RATIO:
        shifts = np.linalg.norm(best.residuals[:, 3:], axis=1)
        worst = int(np.argmax(shifts))
        raise InputError(
            f"the {len(sightings)} captures do not show one place of the rig:"
            f" {sightings[worst].name} is {shifts[worst]:.3g} mm off the others, {best.ratio:.1f}"
            " times what is predicted",
            "name captures that all rigs took of the object in one place, and see that no rig moved"
            " between them",
        )
    return best


def _list_orientations(sightings: Sequence[Sighting]) -> list[list[Sighting]]:
    """Return the sightings in every orientation of the first one's board, the others turned so
    that they come nearest."""
    first, *rest = sightings
    found = []
    for T in (first.T, *first.others):
        chosen = [replace(first, T=T)]
        for each in rest:
            ways = [replace(each, T=way) for way in (each.T, *each.others)]
            chosen.append(min(ways, key=lambda way: float(np.linalg.norm(way.difference(T)[:3]))))
        found.append(chosen)
    return found


def _combine(sightings: Sequence[Sighting]) -> RigFit:
    """Return the weighted mean of sightings."""
    T = sightings[0].T
    middle: Floats = np.mean([each.middle for each in sightings], axis=0)
    weights = [np.linalg.inv(each.covariance) for each in sightings]
    J = [adjoint(rigid_transform(np.eye(3), middle - each.middle)) for each in sightings]
    N = np.sum([j.T @ W @ j for j, W in zip(J, weights, strict=True)], axis=0)
    for _ in range(5):
        pulls = [
            j.T @ W @ each.difference(T) for j, W, each in zip(J, weights, sightings, strict=True)
        ]
        step = np.linalg.solve(N, np.sum(pulls, axis=0))
        T = turn_about(step[:3], middle, step[3:]) @ T
    residuals = np.array([each.difference(T) for each in sightings])
    squared = sum(float(r @ W @ r) for r, W in zip(residuals, weights, strict=True))
    freedom = residuals.size - 6
    ratio = float(np.sqrt(squared / freedom)) if freedom else None
    covariance: Floats = max(1.0, ratio or 1.0) ** 2 * np.linalg.inv(N)
    return RigFit(T, covariance, middle, residuals, ratio)


def find_spheres(points: Floats, radius: float, sigma_mm: float) -> tuple[Floats, Floats]:
    """Return the centres (k, 3) mm of spheres of a radius in the points (n, 3) mm, and their
    standard deviations (k,), each axis; those of fewer than 2 % of the points are skipped."""
    centres, sigmas = list[Floats](), list[float]()
    left, tolerance = np.asarray(points, np.float64), MATCHED_SIGMAS * sigma_mm
    least = max(50, int(LEAST_SHARE * len(left)))
    while len(centres) < MOST_SPHERES and len(left) >= least:
        try:
            sphere, inliers = ransac_sphere(left, tolerance, radius)
        except InputError:
            break
        if inliers.sum() < least:
            break
        normals = (left[inliers] - sphere.centre) / radius
        distances = np.linalg.norm(left[inliers] - sphere.centre, axis=1)
        scatter = max(sigma_mm, float(np.std(distances)))
        covariance = scatter**2 * np.linalg.inv(normals.T @ normals)
        centres.append(sphere.centre)
        sigmas.append(float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])))
        apart = np.linalg.norm(left - sphere.centre, axis=1)
        left = left[apart > radius + 4 * tolerance]
    return np.array(centres).reshape(-1, 3), np.array(sigmas)


def sight_spheres(
    name: str, reference: tuple[Floats, Floats], rig: tuple[Floats, Floats]
) -> Sighting:
    """Return the sighting of several spheres, centres (k, 3) mm and standard deviations (k,) by the
    reference and by the rig, matched by their distances.

    Raises InputError for fewer than three in common, and where they can be matched in several ways.
    """
    (own, own_sigma), (other, other_sigma) = reference, rig
    count = min(len(own), len(other))
    if count < LEAST_SPHERES:
        raise InputError(
            f"{name}: {len(own)} and {len(other)} spheres were detected",
            "three or more must be in view of both rigs; give their radius by --radius",
        )
    matched = sorted(
        (
            (float(np.abs(_distances(own[list(a)]) - _distances(other[list(b)])).max()), a, b)
            for a, b in _list_matches(len(own), len(other), count)
        ),
        key=lambda each: each[0],
    )
    limit = MATCHED_SIGMAS * float(np.hypot(own_sigma.max(), other_sigma.max())) * np.sqrt(2)
    limit = max(limit, 1e-3 * float(_distances(own).max()))
    good = [each for each in matched if each[0] <= limit]
    if not good:
        raise InputError(
            f"{name}: the distances between the spheres differ by {matched[0][0]:.3g} mm or more",
            "do both rigs look at the same spheres?",
        )
    if len(good) > 1:
        raise InputError(
            f"{name}: the spheres can be matched in {len(good)} ways",
            "place them at distances that all differ",
        )
    _, a, b = good[0]
    sigmas = np.hypot(own_sigma[list(a)], other_sigma[list(b)])
    T = fit_rigid(other[list(b)], own[list(a)], 1 / sigmas**2)
    residuals = own[list(a)] - move_points(T, other[list(b)])
    middle = np.average(own[list(a)], axis=0, weights=1 / sigmas**2)
    J = motion_jacobian(own[list(a)] - middle) / sigmas[:, None, None]
    N = np.einsum("nij,nik->jk", J, J)
    excess = np.sum((residuals / sigmas[:, None]) ** 2) / max(3 * count - 6, 1)
    return Sighting(name, T, max(1.0, float(excess)) * np.linalg.inv(N), middle)


def place_of_scan(T: Floats, covariance: Floats, middle: Floats) -> Floats:
    """Return the covariance (6, 6) of a rig's place in its own frame, as `MachinePlace` has it,
    from that about the ``middle`` in the reference's."""
    J = adjoint(invert(T))
    return J @ at_point(covariance, -middle) @ J.T


def _distances(points: Floats) -> Floats:
    """(k, k): the distances between points (k, 3)."""
    return np.linalg.norm(points[:, None] - points, axis=2)


def _list_matches(
    own: int, other: int, count: int
) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Return the ways in which the fewer spheres are some of the others."""
    few = tuple(range(count))
    if own <= other:
        return [(few, each) for each in permutations(range(other), count)]
    return [(each, few) for each in permutations(range(own), count)]
