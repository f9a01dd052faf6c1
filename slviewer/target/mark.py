"""The mark that orients a board of circles: a dot next to its first circle.

A symmetric grid looks the same turned by 180 degrees. The dot is outside the grid, on the first
circle's diagonal, too far away to disturb the measurement of the circles; half as wide as a circle,
it is never detected as one.

Other objects near a board (a screw, a label, a warm spot in a thermal image) are not accepted as
the mark: a dot must have the position, size, polarity and contrast of the printed one, and be on
the board's paper.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from slviewer.geometry.rigid import Floats
from slviewer.geometry.vectors import lengths
from slviewer.target.board import Board
from slviewer.target.planar import fit_grid_map, fit_homography, jacobians, to_image

OFFSET = 5 / 8
RADIUS = 1 / 8
PAPER_WIDTH = 1 / 8
"""Offset of the dot to the left of and above the first circle, its radius, and the width of paper
around it, in distances between neighbouring circles."""
PREDICTING_CIRCLES = 16
"""Number of circles that predict the dot's position; farther ones predict the local distortion less
well."""
MAX_CUT_OFF = 0.3
"""Largest share of the paper around a dot that may be outside the image."""
PRESENT = 0.4
ABSENT = 0.2
"""Contrast of a dot relative to a circle's: above PRESENT there is a dot, below ABSENT there is
none."""
MAX_OFFSET = 0.4
"""Largest distance of the dot's centroid from its predicted position, in its radii: lens distortion
over one pitch."""
SIZES = (0.6, 1.5)
"""Smallest and largest ratio of the radius at half contrast to the printed one, after blur and ink
spread."""
MAX_PAPER_CHANGE = 0.5
"""Largest brightness difference of the paper around the dot and around the first circle, over the
circle's contrast."""
_RADII = np.linspace(0.0, 2.2, 12)
_ANGLES = 20


@dataclass(frozen=True)
class Mark:
    """A dot at (x, y) mm on the board, and its radius."""

    x: float
    y: float
    radius: float


def mark_geometry(board: Board) -> Mark | None:
    """Return the position and radius of a board's printed mark; None for chessboards and
    ChArUco."""
    if board.kind not in ("circles", "acircles"):
        return None
    apart = neighbour_distance_mm(board)
    return Mark(-OFFSET * apart, -OFFSET * apart, RADIUS * apart)


def neighbour_distance_mm(board: Board) -> float:
    """Return the distance in mm between a circle and its nearest neighbour."""
    return board.pitch_mm * (2**0.5 if board.kind == "acircles" else 1.0)


def select_numbering_by_mark(
    board: Board, image: np.ndarray, centres: Floats, numberings: list[np.ndarray]
) -> np.ndarray | None:
    """Select the one of several valid numberings whose first circle has the mark next to it.

    ``image`` (h, w) float32; ``centres`` (m, 2) px; ``numberings``: (n,) indices into them, -1 for
    circles that are hidden. None where no numbering, or more than one, has a mark.
    """
    mark = mark_geometry(board)
    if mark is None:
        return None
    dots = [_detect_dot(board, mark, image, centres, order) for order in numberings]
    contrasts = np.array([contrast for contrast, _ in dots])
    best = int(np.argmax(contrasts))
    others = np.delete(contrasts, best)
    is_marked = contrasts[best] > PRESENT and dots[best][1] and (others < ABSENT).all()
    return numberings[best] if is_marked else None


def is_mark_mirrored(
    board: Board, image: np.ndarray, centres: Floats, numberings: list[np.ndarray]
) -> bool:
    """Whether the mark is where a mirror image of the board has it; arguments as of
    ``select_numbering_by_mark``."""
    columns, rows = board.features
    mirrored = [order.reshape(rows, columns)[::-1].ravel() for order in numberings]
    return select_numbering_by_mark(board, image, centres, mirrored) is not None


def _detect_dot(
    board: Board, mark: Mark, image: np.ndarray, centres: Floats, order: np.ndarray
) -> tuple[float, bool]:
    """Return the contrast at the mark's position over the first circle's, and whether a dot there
    may be the mark; arguments as of ``select_numbering_by_mark``."""
    if order[0] < 0:
        return 0.0, False
    seen = np.flatnonzero(order >= 0)
    points, pixels = board.points[seen, :2], centres[order[seen]]
    centre = np.array([mark.x, mark.y])
    near = np.argsort(lengths(points - centre))[:PREDICTING_CIRCLES]
    H = fit_homography(points[near], pixels[near])
    bent = fit_grid_map(board.nodes[seen], pixels).to_image(centre[None] / board.pitches)[0]
    if not np.linalg.det(jacobians(H, np.stack([centre, points[0]]))).prod() > 0:
        return 0.0, False  # behind the camera
    shift = np.eye(3)
    shift[:2, 2] = bent - to_image(H, centre[None])[0]
    dot = _measure_profile(image, shift @ H, centre, mark.radius)
    circle = _measure_profile(image, H, points[0], 2 * mark.radius)
    if dot is None or circle is None or abs(circle.contrast) < 0.05:
        return 0.0, False
    same_paper = abs(dot.paper - circle.paper) < MAX_PAPER_CHANGE * abs(circle.difference)
    is_mark = (
        dot.off < MAX_OFFSET and SIZES[0] < dot.size < SIZES[1] and same_paper and dot.is_alone
    )
    return dot.contrast / circle.contrast, is_mark


@dataclass(frozen=True)
class _Profile:
    """Radial profile of a dot.

    ``paper``: grey level of the paper around it, and ``difference``: that less the level of its
    middle; ``contrast``: the difference over the larger, negative for bright dots. ``off``:
    distance of its centroid from the predicted position, and ``size``: its radius at half contrast,
    both over its nominal radius.
    ``is_alone``: whether there is paper on all sides.
    """

    paper: float
    difference: float
    contrast: float
    off: float
    size: float
    is_alone: bool


def _measure_profile(
    image: np.ndarray, H: Floats, centre: Floats, radius: float
) -> _Profile | None:
    """Measure the profile around a point ``centre`` (2,) mm of the board, out to 2.2 radii; None
    where cut off, and without contrast.

    The paper's level is the quantile of the outer rings that differs least from the dot, so that an
    edge is not a dot.
    """
    angles = np.arange(_ANGLES) * 2 * np.pi / _ANGLES
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    offsets = _RADII[:, None, None] * radius * directions
    u, v = to_image(H, centre + offsets.reshape(-1, 2)).astype(np.float32).T
    levels = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderValue=np.nan)
    levels = levels.reshape(len(_RADII), _ANGLES)
    inner, outer = levels[_RADII <= 0.6], levels[_RADII >= 1.8]
    if np.isnan(inner).any() or np.isnan(outer).mean() > MAX_CUT_OFF:
        return None
    own = float(inner.mean())
    flat = outer[np.isfinite(outer)]
    ring = outer.mean(axis=0) if len(flat) == outer.size else flat
    paper = float(np.quantile(flat, 0.2 if own < np.median(flat) else 0.8))
    difference = paper - own
    if abs(difference) < 1e-3:
        return None
    share = np.nan_to_num((paper - levels) / difference, nan=0.0)
    middle = float(np.median(ring))
    is_alone = bool(np.abs(ring - middle).max() < 0.5 * abs(difference))
    # weighted by the area of each sample
    ink = np.clip(share, 0.0, 1.0) * (_RADII < 1.9)[:, None] * _RADII[:, None]
    centroid = np.einsum("ra,r,ac->c", ink, _RADII, directions) / max(float(ink.sum()), 1e-9)
    means = share.mean(axis=1) / max(float(share[:2].mean()), 1e-9)
    below = np.nonzero(means < 0.5)[0]
    size = float(_RADII[below[0]]) if len(below) else np.inf
    contrast = difference / max(paper, own, 1.0)
    return _Profile(paper, difference, contrast, float(lengths(centroid)), size, is_alone)
