"""The mark that tells which way round a board of circles is: a dot beside its first circle.

A symmetric grid looks the same turned by 180 degrees. The dot lies outside the grid, on the first circle's diagonal, so
far from it that neither finding nor measuring circles meets it; half as wide as a circle, it is never taken for one.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from slviewer.target.board import Board
from slviewer.target.planar import fit_homography, jacobians, to_image

PLACE = 5 / 8
RADIUS = 1 / 8
QUIET = 1 / 8
"""How far the dot lies left of and above the first circle, its radius and the paper around it, in distances between
neighbouring circles."""
NEAREST = 16
"""Circles by which the dot's place in the image is told; farther ones know less of the lens there."""
CUT_OFF = 0.3
"""Share of the paper around a dot that may lie outside the image."""
SEEN = 0.4
ABSENT = 0.2
"""Contrast of a dot over a circle's, above which it is there, and below which it is not."""


@dataclass(frozen=True)
class Mark:
    """A dot at (x, y) mm on the board, and its radius."""

    x: float
    y: float
    radius: float


def mark_of(board: Board) -> Mark | None:
    """Where a board's mark is printed; None for chessboards and ChArUco."""
    if board.kind not in ("circles", "acircles"):
        return None
    apart = neighbours_mm(board)
    return Mark(-PLACE * apart, -PLACE * apart, RADIUS * apart)


def neighbours_mm(board: Board) -> float:
    """Distance between a circle and its nearest neighbour."""
    return board.pitch_mm * (2**0.5 if board.kind == "acircles" else 1.0)


def marked_numbering(
    board: Board, image: np.ndarray, centres: np.ndarray, numberings: list[np.ndarray]
) -> np.ndarray | None:
    """Of equally valid numberings, (n,) indices into ``centres`` (m, 2) px, the one beside whose first circle the mark
    lies; None where none or several have something there.

    ``image`` (h, w) float32.
    """
    mark = mark_of(board)
    if mark is None:
        return None
    contrasts = np.array([_contrast(board, mark, image, centres[order]) for order in numberings])
    best = int(np.argmax(contrasts))
    others = np.delete(contrasts, best)
    return numberings[best] if contrasts[best] > SEEN and (others < ABSENT).all() else None


def _contrast(board: Board, mark: Mark, image: np.ndarray, pixels: np.ndarray) -> float:
    """How much the mark's place differs from the paper around it, over how much the first circle does."""
    points = board.points[:, :2]
    centre = np.array([mark.x, mark.y])
    near = np.argsort(np.linalg.norm(points - centre, axis=1))[:NEAREST]
    H = fit_homography(points[near], pixels[near])
    if not np.linalg.det(jacobians(H, centre[None]))[0] > 0:
        return 0.0
    dot = _darkness(image, H, centre, mark.radius)
    circle = _darkness(image, H, points[0], 2 * mark.radius)
    return dot / circle if abs(circle) > 0.05 else 0.0


def _darkness(image: np.ndarray, H: np.ndarray, centre: np.ndarray, radius: float) -> float:
    """Brightness of the paper around a dot less its own, over the larger; negative for bright dots.

    The fifth of the ring that is least like paper counts: an edge that runs through is no dot.
    """
    inner = _around(image, H, centre, radius * np.array([0.0, 0.3, 0.6]))
    outer = _around(image, H, centre, radius * np.array([1.8, 2.2]))
    if np.isnan(inner).any() or np.isnan(outer).mean() > CUT_OFF:
        return 0.0
    outer = outer[np.isfinite(outer)]
    own = float(inner.mean())
    paper = float(np.quantile(outer, 0.2 if own < np.median(outer) else 0.8))
    return (paper - own) / max(paper, own, 1.0)


def _around(image: np.ndarray, H: np.ndarray, centre: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """(n,) the image on circles about a point of the board; NaN outside it."""
    angles = np.arange(20) * 2 * np.pi / 20
    rings = radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    pixels = to_image(H, centre + rings.reshape(-1, 2)).astype(np.float32)
    return cv2.remap(
        image, pixels[:, 0], pixels[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
    ).ravel()
