"""Checks of the numbering of a pose's features, and the size of the grid of circles that an image
shows."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.calibration.splined.half_turns import match_features, opposite_features
from slviewer.geometry.polynomial import monomials, scale_to_unit_square
from slviewer.geometry.rigid import Floats
from slviewer.geometry.vectors import lengths
from slviewer.target.blobs import detect_blobs
from slviewer.target.board import Board
from slviewer.target.images import SEARCH_PX, BoardImage, resize_image
from slviewer.target.lattice import Lattice, grow_lattices
from slviewer.target.planar import select_upright, to_image, x_direction

MISNUMBERED_PITCHES = 0.8
"""A residual of this many pitches shows that features are misnumbered."""
FIT_PITCHES = 0.25
"""Largest residual in pitches of correctly numbered features, after removal of lens distortion."""
_FULL_SHARE = 0.9  # least share of a lattice's nodes that are occupied in a whole grid
_INLIER_PITCHES = 0.25  # largest residual of inliers in the fit of homography and lens distortion


def describe_misnumbering(board: Board, points: Floats, pixels: Floats) -> str:
    """Describe how features with ``points`` (n, 3) mm at ``pixels`` (n, 2) are misnumbered; ""
    where they are not.

    Where the numbering of a whole grid does not fit, typical misnumberings (transposed, shifted)
    are tried.
    """
    columns, rows = board.features
    residual, is_mirrored = _measure_misfit(points, pixels, board.pitch_mm)
    is_whole = len(points) == columns * rows and board.kind in ("circles", "chessboard")
    if residual < MISNUMBERED_PITCHES:
        return "transposed or mirrored" if is_mirrored and is_whole else ""
    if not is_whole:
        return "mixed up"
    index = np.arange(columns * rows).reshape(rows, columns)
    hypotheses = {
        "transposed": [index.T, index.reshape(columns, rows).T],
        "shifted by a row": [np.roll(index, k, axis=0) for k in (1, -1, 2, -2)],
        "shifted by a column": [np.roll(index, k, axis=1) for k in (1, -1, 2, -2)],
        "shifted": [np.roll(index, k) for k in (1, -1)],
    }
    residuals = {
        description: min(
            _measure_misfit(points, pixels[order.ravel()], board.pitch_mm)[0] for order in orders
        )
        for description, orders in hypotheses.items()
    }
    best = min(residuals, key=lambda description: residuals[description])
    return best if residuals[best] < FIT_PITCHES else "mixed up"


def reconcile_marks(
    board: Board, observations: Sequence[Observation]
) -> tuple[list[Observation], str]:
    """Renumber poses of a board of circles so that all are numbered by its mark, or none; return
    them and a warning.

    A board has a mark in all poses that show it whole, or in none. Marks that only a minority of
    these shows are treated as clutter: their poses are renumbered by the rule for boards without a
    mark (``slviewer.target.planar``). The warning is "" where nothing was changed.
    """
    doubtful = [o.name for o in observations if o.marked]
    whole = [o for o in observations if _shows_whole(board, o)]
    if not doubtful or 2 * sum(o.marked for o in whole) >= len(whole):
        return list(observations), ""
    numbered = [_number_by_rule(board, o) if o.marked else o for o in observations]
    warning = (
        f"a mark was detected in {len(doubtful)} of {len(observations)} poses"
        f" ({', '.join(doubtful)}) only: treated as clutter next to the board, these poses are"
        " numbered like the others; if the board has a mark, keep it in view and uncovered"
    )
    return numbered, warning


def _shows_whole(board: Board, observation: Observation) -> bool:
    """Return whether a pose shows a board whole, but for features on the image's dead lines."""
    area = observation.area
    least = 1.0 if area is None or not len(area.lines) else _FULL_SHARE
    return len(observation.points) >= least * len(board.points)


def place_by_neighbours(observations: Sequence[Observation]) -> list[Observation]:
    """Renumber poses of which the image's border hides which features they show: as the next pose
    without such doubt, in order, is turned in the image, else as they are.

    Each place of the board is the same calibration but for the board's unevenness: they are a rigid
    motion apart.
    """
    certain = np.array([k for k, o in enumerate(observations) if o.others is None])
    placed = list(observations)
    for k, o in enumerate(observations):
        if o.others is None or not len(certain):
            continue
        beside = observations[certain[np.argmin(np.abs(certain - k))]]
        wanted = x_direction(beside.points, beside.camera)
        numberings = [o.points, *o.others]
        agreement = [x_direction(points, o.camera) @ wanted for points in numberings]
        placed[k] = replace(o, points=numberings[int(np.argmax(np.round(agreement, 2)))])
    return placed


def _number_by_rule(board: Board, observation: Observation) -> Observation:
    """Renumber an observation by the rule for boards without a mark."""
    partner = opposite_features(board.points)
    plain = replace(observation, marked=False)
    if partner is None:
        return plain
    ids, _ = match_features(observation.points, board.points)
    same, turned = np.full((2, len(board.points)), -1)
    same[ids] = turned[partner[ids]] = np.arange(len(ids))
    if select_upright(board, observation.camera, [same, turned]) is same:
        return plain
    order = turned[turned >= 0]
    return replace(
        plain,
        points=board.points[turned >= 0],
        camera=plain.camera[order],
        projector=plain.projector[order],
        slopes=None if plain.slopes is None else plain.slopes[order],
    )


def detect_grid_size(board: Board, image: np.ndarray) -> tuple[int, int] | None:
    """Detect the (columns, rows) of the grid of circles in an image, whatever the board's own; None
    without a grid.

    The longer side is given as the board's longer side. None for boards that are not a regular grid
    of circles.
    """
    if board.kind != "circles":
        return None
    grey = BoardImage.from_image(image).grey
    small = resize_image(grey, min(1.0, SEARCH_PX / max(grey.shape)))
    pitch = max(small.shape) / (min(board.columns, board.rows) - 1)
    most: Lattice | None = None
    for inverted in (False, True):
        for blobs in detect_blobs(small, pitch, inverted):
            for lattice in grow_lattices(blobs):
                longer, shorter = lattice.extent
                is_full = len(lattice) >= _FULL_SHARE * longer * shorter and shorter >= 3
                if is_full and (most is None or len(lattice) > len(most)):
                    most = lattice
            if most is not None and len(most) > len(board.points) / 2:
                longer, shorter = most.extent
                return (longer, shorter) if board.columns >= board.rows else (shorter, longer)
    return None


def _measure_misfit(points: Floats, pixels: Floats, pitch_mm: float) -> tuple[float, bool]:
    """Return (residual of the worst 1 % of the features in pitches, whether the homography is
    mirrored).

    Residuals are those of a homography and a cubic polynomial (lens distortion), fitted robustly to
    points (n, 3) mm and pixels (n, 2); inf where there is no homography.
    """
    board = np.asarray(points[:, :2], float) / pitch_mm
    scale = float(np.sqrt(np.ptp(pixels, axis=0).prod() / max(np.ptp(board, axis=0).prod(), 1e-9)))
    H, inliers = cv2.findHomography(
        board, np.asarray(pixels, float), cv2.RANSAC, 2 * _INLIER_PITCHES * max(scale, 1e-6)
    )
    if H is None or abs(np.linalg.det(H)) < 1e-12:
        return np.inf, False
    H = H * np.sign(board.mean(0) @ H[2, :2] + H[2, 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.nan_to_num(
            (pixels - to_image(H, board)) / max(scale, 1e-6), nan=1e6, posinf=1e6, neginf=-1e6
        )
    terms = monomials(scale_to_unit_square(board), 3)
    inlier = np.asarray(inliers).ravel() > 0
    residual = lengths(offset)
    for _ in range(3):
        if np.count_nonzero(inlier) < 2 * terms.shape[1]:
            residual = lengths(offset)
            break
        distortion = terms @ np.linalg.lstsq(terms[inlier], offset[inlier], rcond=None)[0]
        residual = lengths(offset - distortion)
        inlier = residual < max(_INLIER_PITCHES, 3 * float(np.median(residual[inlier])))
    return float(np.sort(residual)[-max(1, len(residual) // 100)]), bool(np.linalg.det(H) < 0)
