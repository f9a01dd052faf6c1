"""Whether the features of a pose are numbered as the board's are, and how many circles the board really has."""

import cv2
import numpy as np

from slviewer.target.blobs import find_blobs
from slviewer.target.board import Board
from slviewer.target.images import SEARCH_PX, BoardImage, resized
from slviewer.target.lattice import grow_lattices
from slviewer.target.planar import to_image

FITS = 0.12
"""How far, in pitches, features may lie from their places on the board: lenses bend it less."""
_BETTER = 0.25  # of what the numbering as given leaves, for another one to be believed
_FULL = 0.9  # of the nodes within a lattice's extent, for it to be a whole grid


def misnumbered(board: Board, points: np.ndarray, pixels: np.ndarray) -> str:
    """How the features of a pose at ``pixels`` (n, 2) are misnumbered, in words; empty where they are not.

    ``points`` (n, 3) mm are where the numbering says they are. Other numberings of the whole grid are tried where the
    one given does not fit, or is a mirror image.
    """
    columns, rows = board.features
    off, mirrored = _misfit(points, pixels, board.pitch_mm)
    whole = len(points) == columns * rows and board.kind in ("circles", "chessboard")
    if off < FITS:
        return "transposed" if mirrored and whole else ""
    if not whole:
        return "mixed up"
    index = np.arange(columns * rows).reshape(rows, columns)
    stories = {
        "transposed": [index.T, np.arange(columns * rows).reshape(columns, rows).T],
        "shifted by a row": [np.roll(index, k, axis=0) for k in (1, -1, 2, -2)],
        "shifted by a column": [np.roll(index, k, axis=1) for k in (1, -1, 2, -2)],
        "shifted": [np.roll(index.ravel(), k).reshape(rows, columns) for k in (1, -1)],
    }
    best, least = "mixed up", max(_BETTER * off, FITS)
    for story, orders in stories.items():
        for order in orders:
            left, _ = _misfit(points, pixels[order.ravel()], board.pitch_mm)
            if left < least:
                best, least = story, left
    return best


def seen_grid(board: Board, image: np.ndarray) -> tuple[int, int] | None:
    """Columns and rows of the grid of circles that an image shows, the longer side along the board's longer one; None
    where no whole grid is seen, or the board has no circles in columns and rows.
    """
    if board.kind != "circles":
        return None
    grey = BoardImage.of(image).grey
    small = resized(grey, min(1.0, SEARCH_PX / max(grey.shape)))
    pitch = max(small.shape) / (min(board.columns, board.rows) - 1)
    most: tuple[int, tuple[int, int]] | None = None
    for inverted in (False, True):
        for blobs in find_blobs(small, pitch, inverted):
            for lattice in grow_lattices(blobs):
                longer, shorter = lattice.extent
                count = len(lattice.nodes)
                if min(longer, shorter) >= 3 and count >= _FULL * longer * shorter and (not most or count > most[0]):
                    most = count, (longer, shorter)
            if most and most[0] > len(board.points) / 2:
                longer, shorter = most[1]
                return (longer, shorter) if board.columns >= board.rows else (shorter, longer)
    return None


def _misfit(points: np.ndarray, pixels: np.ndarray, pitch_mm: float) -> tuple[float, bool]:
    """(pitches that the worst feature lies off the plane of the others, whether the plane is mirrored)."""
    board = np.asarray(points[:, :2], float) / pitch_mm
    scale = float(np.sqrt(np.ptp(pixels, axis=0).prod() / max(np.ptp(board, axis=0).prod(), 1e-9)))
    H, _ = cv2.findHomography(board, np.asarray(pixels, float), cv2.RANSAC, 2 * FITS * max(scale, 1e-6))
    if H is None or abs(np.linalg.det(H)) < 1e-12:
        return np.inf, False
    H = H * np.sign(board.mean(0) @ H[2, :2] + H[2, 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(pixels - to_image(H, board), axis=1) / max(scale, 1e-6)
    worst = float(np.sort(np.nan_to_num(off, nan=np.inf))[-max(1, len(off) // 100)])
    return worst, bool(np.linalg.det(H) < 0)
