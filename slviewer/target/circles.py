"""Find a grid of circles, dark on bright or bright on dark."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from slviewer.errors import DetectionError
from slviewer.target.blobs import Blobs, find_blobs
from slviewer.target.board import Board
from slviewer.target.centroid import refine_centres
from slviewer.target.images import SEARCH_PX, BoardImage, advice, resized
from slviewer.target.lattice import Lattice, grow_lattices, lay_pattern
from slviewer.target.mark import marked_numbering
from slviewer.target.numbering import check_grid, upright
from slviewer.target.planar import fit_homography, jacobians

GOOD_PART = 1 / 3
"""Share of the board's circles in one lattice that no clutter has."""
ROUND = 0.97
"""Roundness between that of squares, 0.955, and of circles well resolved, 0.985 and more on real photographs."""
PARTLY_COVERED = 0.96
"""Roundness below which a piece of a circle is missing."""
WELL_SHAPED_PX = 60.0
"""Area of a circle from which on its roundness can be judged."""
RESOLVED_PX = 80.0
"""Area of a circle beyond which more pixels do not help to find it."""


@dataclass(frozen=True)
class _Seen:
    """A lattice among blobs."""

    lattice: Lattice
    blobs: Blobs

    def __len__(self) -> int:
        return len(self.lattice.nodes)


def detect_circles(board: Board, image: BoardImage) -> tuple[np.ndarray, float, bool]:
    """((n, 2) float64 px of every circle, their radius in mm, whether the board's mark was seen); raises DetectionError
    with how many circles were."""
    most: _Seen | None = None
    for seen in _attempts(board, image.grey):
        numberings = lay_pattern(board, seen.lattice)
        if numberings:
            _refuse_larger(board, seen.lattice, numberings)
            marked = marked_numbering(board, image.deep, seen.blobs.centres, numberings)
            order = upright(board, seen.blobs.centres, numberings) if marked is None else marked
            blobs = seen.blobs.chosen(order)
            _refuse_misshapen(board, blobs)
            pixels = _centres(board, image, blobs)
            return pixels, _radius(board, blobs), marked is not None
        if most is None or len(seen) > len(most):
            most = seen
    raise DetectionError(_not_found(board, image, most))


def _attempts(board: Board, grey: np.ndarray) -> Iterator[_Seen]:
    """Lattices at the search resolution, then coarser, where noise averages out, then in the full image; at last twice
    as large, if circles of a few pixels have been seen.

    Once a good part of the board has been seen, its circles are known to be dark or bright, and to be large enough for
    the search resolution or not, and what remains to be tried is little.
    """
    first = min(1.0, SEARCH_PX / max(grey.shape))
    colours = [False, True]
    resolved = False
    for factor in dict.fromkeys((first, first / 2, 1.0, 2.0)):
        if (resolved and factor > first) or (len(colours) > 1 and factor > 1):
            return
        small = resized(grey, factor)
        scale = np.array(grey.shape[::-1]) / np.array(small.shape[::-1])
        pitch = max(small.shape) / (min(board.columns, board.rows) - 1)
        for inverted in colours:
            for blobs in find_blobs(small, pitch, inverted):
                for lattice in grow_lattices(blobs):
                    if len(lattice.nodes) > GOOD_PART * len(board.points):
                        colours = [inverted]
                        resolved |= float(np.median(blobs.areas[lattice.blobs])) > RESOLVED_PX
                    yield _Seen(lattice, blobs.scaled(scale))
            if colours == [inverted]:
                break


def _refuse_larger(board: Board, lattice: Lattice, numberings: list[np.ndarray]) -> None:
    extra = len(lattice.nodes) - len(board.points)
    places = {tuple(np.sort(numbering)) for numbering in numberings}
    if len(places) > 1 or extra >= min(board.columns, board.rows) / 3:
        raise DetectionError(
            f"{len(lattice.nodes)} circles in one grid found where {board} has {len(board.points)}: "
            "check the board's columns and rows"
        )


def _refuse_misshapen(board: Board, blobs: Blobs) -> None:
    large = blobs.areas > WELL_SHAPED_PX
    if large.all() and np.median(blobs.roundness) < ROUND:
        raise DetectionError(f"a grid of squares found where {board} has circles: check the board's kind")
    covered = np.count_nonzero(large & (blobs.roundness < PARTLY_COVERED))
    if covered:
        raise DetectionError(
            f"{covered} of {len(blobs.areas)} circles are partly covered, or reflect: "
            "uncover the board, and turn it away from the lights"
        )


def _centres(board: Board, image: BoardImage, blobs: Blobs) -> np.ndarray:
    pixels = refine_centres(image.deep, blobs)
    lost = np.isnan(pixels).any(1)
    if lost.any():
        raise DetectionError(
            f"{np.count_nonzero(lost)} of {len(pixels)} circles are too close to their neighbours or too faint to "
            "measure: move the board closer, or focus the camera"
        )
    check_grid(board, pixels, np.arange(len(pixels)), "circles")
    return pixels


def _radius(board: Board, blobs: Blobs) -> float:
    """mm, by the areas of the blobs and how large a square millimetre is where they lie."""
    points = board.points[:, :2]
    scale = np.linalg.det(jacobians(fit_homography(points, blobs.centres), points))
    return float(np.sqrt(np.median(blobs.areas / scale) / np.pi))


def _not_found(board: Board, image: BoardImage, most: _Seen | None) -> str:
    total = len(board.points)
    if most is None or len(most) < 6:
        return f"no grid of circles found where {board} has {total}: {advice(image.grey)}"
    if len(most) >= total:
        longer, shorter = most.lattice.extent
        return (
            f"{len(most)} circles found in a grid of {longer}x{shorter} that does not hold all of {board}: "
            "check the board's columns and rows, and that nothing covers it"
        )
    return f"{len(most)} of {total} circles found: {advice(image.grey)}"
