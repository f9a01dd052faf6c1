"""Whether the features of a pose are numbered as the board's are, and how many circles the board really has."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.calibration.splined.half_turns import opposite_features
from slviewer.target.blobs import find_blobs
from slviewer.target.board import Board
from slviewer.target.images import SEARCH_PX, BoardImage, resize_image
from slviewer.target.lattice import grow_lattices
from slviewer.target.numbering import select_upright
from slviewer.target.planar import to_image

MISNUMBERED_PITCHES = 0.8
"""Features that lie so many pitches off their places on the board are numbered as others."""
FIT_PITCHES = 0.25
"""How far, in pitches, features of the right numbers may lie off; what a lens bends smoothly does not count."""
_FULL_SHARE = 0.9  # of the nodes within a lattice's extent, for it to be a whole grid
_CLEAR_RATIO = 0.25  # pitches within which features count while the board's plane and the lens's bend are sought


def describe_misnumbering(board: Board, points: np.ndarray, pixels: np.ndarray) -> str:
    """How the features of a pose at ``pixels`` (n, 2) are misnumbered, in words; empty where they are not.

    ``points`` (n, 3) mm are where the numbering says they are. Other numberings of the whole grid are tried where the
    one given does not fit, or is a mirror image.
    """
    columns, rows = board.features
    off, mirrored = _measure_misfit(points, pixels, board.pitch_mm)
    whole = len(points) == columns * rows and board.kind in ("circles", "chessboard")
    if off < MISNUMBERED_PITCHES:
        return "transposed or mirrored" if mirrored and whole else ""
    if not whole:
        return "mixed up"
    index = np.arange(columns * rows).reshape(rows, columns)
    stories = {
        "transposed": [index.T, np.arange(columns * rows).reshape(columns, rows).T],
        "shifted by a row": [np.roll(index, k, axis=0) for k in (1, -1, 2, -2)],
        "shifted by a column": [np.roll(index, k, axis=1) for k in (1, -1, 2, -2)],
        "shifted": [np.roll(index.ravel(), k).reshape(rows, columns) for k in (1, -1)],
    }
    best, least = "mixed up", FIT_PITCHES
    for story, orders in stories.items():
        for order in orders:
            left, _ = _measure_misfit(points, pixels[order.ravel()], board.pitch_mm)
            if left < least:
                best, least = story, left
    return best


def reconcile_marks(board: Board, observations: Sequence[Observation]) -> tuple[list[Observation], str]:
    """The observations of a board of circles numbered alike, and a warning; empty where the poses agree on the mark.

    A board has a mark in all poses or in none. What a minority of them takes for one is something else: these poses are
    numbered by the rule for boards without a mark (``slviewer.target.numbering``), as the others are.
    """
    doubtful = [o.name for o in observations if o.marked]
    if not doubtful or 2 * len(doubtful) >= len(observations):
        return list(observations), ""
    numbered = [_number_by_rule(board, o) if o.marked else o for o in observations]
    return numbered, (
        f"a mark was detected in {len(doubtful)} of {len(observations)} poses ({', '.join(doubtful)}) only: taken for "
        "clutter beside the board, these poses are numbered like the others; if the board has a mark, keep it in view "
        "and uncovered"
    )


def _number_by_rule(board: Board, observation: Observation) -> Observation:
    """The observation, numbered as without a detected mark."""
    partner = opposite_features(board.points)
    plain = replace(observation, marked=False)
    if partner is None or len(observation.points) != len(board.points):
        return plain
    same = np.arange(len(board.points))
    if np.array_equal(select_upright(board, observation.camera, [same, partner]), same):
        return plain
    slopes = None if observation.slopes is None else observation.slopes[partner]
    return replace(plain, camera=observation.camera[partner], projector=observation.projector[partner], slopes=slopes)


def detect_grid_size(board: Board, image: np.ndarray) -> tuple[int, int] | None:
    """Columns and rows of the grid of circles that an image shows, the longer side along the board's longer one; None
    where no whole grid is seen, or the board has no circles in columns and rows.
    """
    if board.kind != "circles":
        return None
    grey = BoardImage.from_image(image).grey
    small = resize_image(grey, min(1.0, SEARCH_PX / max(grey.shape)))
    pitch = max(small.shape) / (min(board.columns, board.rows) - 1)
    most: tuple[int, tuple[int, int]] | None = None
    for inverted in (False, True):
        for blobs in find_blobs(small, pitch, inverted):
            for lattice in grow_lattices(blobs):
                longer, shorter = lattice.extent
                count = len(lattice.nodes)
                is_full = count >= _FULL_SHARE * longer * shorter
                if is_full and min(longer, shorter) >= 3 and (not most or count > most[0]):
                    most = count, (longer, shorter)
            if most and most[0] > len(board.points) / 2:
                longer, shorter = most[1]
                return (longer, shorter) if board.columns >= board.rows else (shorter, longer)
    return None


def _measure_misfit(points: np.ndarray, pixels: np.ndarray, pitch_mm: float) -> tuple[float, bool]:
    """(pitches that the worst features lie off the plane of the others, whether the plane is mirrored).

    A cubic of the place on the board, which is how lenses bend it, is taken away first.
    """
    board = np.asarray(points[:, :2], float) / pitch_mm
    scale = float(np.sqrt(np.ptp(pixels, axis=0).prod() / max(np.ptp(board, axis=0).prod(), 1e-9)))
    H, near = cv2.findHomography(board, np.asarray(pixels, float), cv2.RANSAC, 2 * _CLEAR_RATIO * max(scale, 1e-6))
    if H is None or abs(np.linalg.det(H)) < 1e-12:
        return np.inf, False
    H = H * np.sign(board.mean(0) @ H[2, :2] + H[2, 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        left = np.nan_to_num((pixels - to_image(H, board)) / max(scale, 1e-6), nan=1e6, posinf=1e6, neginf=-1e6)
    x, y = (2 * (board - board.min(0)) / np.maximum(np.ptp(board, axis=0), 1e-9) - 1).T
    terms = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    counts = np.asarray(near).ravel() > 0
    for _ in range(3):
        if np.count_nonzero(counts) < 2 * terms.shape[1]:
            break
        off = np.linalg.norm(left - terms @ np.linalg.lstsq(terms[counts], left[counts], rcond=None)[0], axis=1)
        counts = off < max(_CLEAR_RATIO, 3 * float(np.median(off[counts])))
    else:
        return float(np.sort(off)[-max(1, len(off) // 100)]), bool(np.linalg.det(H) < 0)
    return float(np.sort(np.linalg.norm(left, axis=1))[-max(1, len(left) // 100)]), bool(np.linalg.det(H) < 0)
