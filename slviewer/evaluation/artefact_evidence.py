"""What a fit to an artefact rests on: the share of the visible surface that was measured, what was
excluded, and deviations that neighbouring points share, which no noise explains.

A fit excludes stray points, and its patch ends where a surface departs from the shape. Points that
depart in one place are not strays: inside a ball, or behind a plate, they belong to the artefact.
"""

import cv2
import numpy as np

from slviewer.evaluation.fit import ShapeResult
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.shapes import Sphere
from slviewer.geometry.vectors import thin_out, unit_vectors
from slviewer.reconstruction.cloud import Map, Points
from slviewer.records.acceptance import SurfaceEvidence

VISIBLE, VISIBLE_ALONE = (np.cos(np.radians(angle)) for angle in (60.0, 45.0))
"""A ball's surface is expected where camera and projector see it no flatter than this, where the
projector's place is not known the camera: beyond, blur and dim fringes cost points of every
ball."""
PATCH = 0.005
"""Share of the surface over which deviations are averaged: what departs over less is a speck."""
LEAST_IN_PATCH = 0.7
"""Share of the pixels of an averaged patch that must be measured."""
LUMP = 0.15
"""Of a ball's radius, of a plate's width: what rises less from the surface belongs to it; what
rises more, such as the bar before a ball, covers it."""


def collect_evidence(
    result: ShapeResult, points: Points, projector: Floats | None, plate: Mask | None = None
) -> SurfaceEvidence:
    """Return what the fit of a ball or a plane to a cloud (h, w, 3) mm rests on.

    ``projector`` (3,) mm: its centre, where that is known; ``plate`` (h, w) bool: the plane's
    pixels, if these are known.
    """
    evaluated = np.isfinite(result.error_map)
    if isinstance(result.shape, Sphere):
        expected, total = _expect_ball(result.sphere, points, evaluated, projector)
        width_mm = result.shape.radius
    else:
        expected = _fill_hull(evaluated) if plate is None else plate
        total = int(np.count_nonzero(expected))
        width_mm = float(np.linalg.norm(np.ptp(points[evaluated], axis=0))) / np.sqrt(2)
    distance = np.full(expected.shape, np.nan)
    distance[expected] = result.shape.distance(points[expected].astype(np.float64))
    inside = isinstance(result.shape, Sphere) & (distance < 0)  # nothing else can be there
    others = np.isfinite(distance) & ~evaluated & ~inside
    own = np.isfinite(distance) & (evaluated | inside | _select_lumps(others, distance, width_mm))
    low, high = _shared_deviations(np.where(own, distance, np.nan), total)
    measured = int(np.count_nonzero(own))
    return SurfaceEvidence(
        measured=min(1.0, measured / max(total, 1)),
        covered=min(1.0, int(np.count_nonzero(others & ~own)) / max(total, 1)),
        excluded=1.0 - int(np.count_nonzero(own & result.inliers)) / max(measured, 1),
        lowest_mm=low,
        highest_mm=high,
    )


def _expect_ball(
    ball: Sphere, points: Points, evaluated: Mask, projector: Floats | None
) -> tuple[Mask, int]:
    """Return the pixels (h, w) bool where a ball is visible for camera and projector, and how many
    these are with those beyond the image's border."""
    at = np.argwhere(evaluated)[:, ::-1]
    chosen = thin_out(at, 4000)
    known = points[chosen[:, 1], chosen[:, 0]].astype(np.float64)
    pixels = chosen.astype(np.float64)
    ray: Floats = known[:, :2] / known[:, 2:]
    to_pixel, to_ray = (
        np.linalg.lstsq(_quadratics(a), b, rcond=None)[0] for a, b in ((ray, pixels), (pixels, ray))
    )
    edges = ball.centre + ball.radius * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    middle, *sides = _quadratics(edges[:, :2] / edges[:, 2:]) @ to_pixel
    reach = int(1.3 * max(np.linalg.norm(side - middle) for side in sides)) + 2
    first = np.round(middle).astype(int) - reach
    grid = np.indices((2 * reach + 1,) * 2).reshape(2, -1)[::-1].T + first
    rays = np.column_stack([_quadratics(grid.astype(float)) @ to_ray, np.ones(len(grid))])
    b, rr = rays @ ball.centre, np.sum(rays**2, axis=1)
    with np.errstate(invalid="ignore"):
        z = (b - np.sqrt(b**2 - rr * (ball.centre @ ball.centre - ball.radius**2))) / rr
    surface = rays * z[:, None]
    normal = (surface - ball.centre) / ball.radius
    flattest = VISIBLE_ALONE if projector is None else VISIBLE
    visible = -np.sum(normal * unit_vectors(rays), axis=1) > flattest
    if projector is not None:
        visible &= np.sum(normal * unit_vectors(projector - surface), axis=1) > flattest
    u, v = grid[visible].T
    height, width = evaluated.shape
    in_image = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    expected = np.zeros_like(evaluated)
    expected[v[in_image], u[in_image]] = True
    return expected, len(u)


def _quadratics(places: Floats) -> Floats:
    """Return the terms (n, 6) of a polynomial of second order at places (n, 2), of the order of
    1."""
    x, y = places.T
    return np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])


def _fill_hull(patch: Mask) -> Mask:
    """Return the convex hull (h, w) bool of a patch."""
    corners = cv2.convexHull(np.argwhere(patch)[:, ::-1].astype(np.int32))
    return np.asarray(cv2.fillConvexPoly(patch.astype(np.uint8), corners, 1)) > 0


def _select_lumps(others: Mask, distance: Map, width_mm: float) -> Mask:
    """Return those ``others`` (h, w) bool that rise so little from the surface that they belong to
    it."""
    number, labels = cv2.connectedComponents(others.astype(np.uint8))
    chosen = np.zeros_like(others)
    for label in range(1, number):
        own = labels == label
        if np.percentile(np.abs(distance[own]), 95) < LUMP * width_mm:
            chosen |= own
    return chosen


def _shared_deviations(distance: Map, total: int) -> tuple[float, float]:
    """Return the lowest and the highest deviation, mm, in the mean of a patch of neighbours; 0
    where no patch is measured. ``distance`` (h, w) mm, NaN where nothing is."""
    side = max(3, int(np.sqrt(PATCH * total)) | 1)
    known = np.isfinite(distance)
    share = cv2.blur(known.astype(np.float64), (side, side), borderType=cv2.BORDER_CONSTANT)
    sums = cv2.blur(np.nan_to_num(distance), (side, side), borderType=cv2.BORDER_CONSTANT)
    enough = known & (share >= LEAST_IN_PATCH)
    means = sums[enough] / share[enough]
    return (float(means.min()), float(means.max())) if len(means) else (0.0, 0.0)
