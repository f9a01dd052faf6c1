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
from slviewer.target.numbering import check_grid, upright


@dataclass(frozen=True)
class _Grid:
    blobs: Blobs
    numberings: list[np.ndarray]


def detect_circles(board: Board, image: BoardImage) -> np.ndarray:
    """(n, 2) float64 px of every circle of the board; raises DetectionError with how many were seen."""
    most = Lattice(np.zeros((0, 2), int), np.zeros(0, int))
    for blobs in _attempts(board, image.grey):
        for lattice in grow_lattices(blobs):
            numberings = lay_pattern(board, lattice)
            if numberings:
                _refuse_larger(board, lattice, numberings)
                return _centres(board, image, _Grid(blobs, numberings))
            if len(lattice.nodes) > len(most.nodes):
                most = lattice
    raise DetectionError(_not_found(board, image, most))


def _attempts(board: Board, grey: np.ndarray) -> Iterator[Blobs]:
    """Blobs at the search resolution, then coarser, where noise averages out, then in the full image."""
    first = min(1.0, SEARCH_PX / max(grey.shape))
    for factor in dict.fromkeys((first, first / 2, 1.0)):
        small = resized(grey, factor)
        scale = np.array(grey.shape[::-1]) / np.array(small.shape[::-1])
        pitch = max(small.shape) / (min(board.columns, board.rows) - 1)
        for blobs in find_blobs(small, pitch):
            yield blobs.scaled(scale)


def _refuse_larger(board: Board, lattice: Lattice, numberings: list[np.ndarray]) -> None:
    extra = len(lattice.nodes) - len(board.points)
    places = {tuple(np.sort(numbering)) for numbering in numberings}
    if len(places) > 1 or extra >= min(board.columns, board.rows) / 3:
        raise DetectionError(
            f"{len(lattice.nodes)} circles in one grid found where {board} has {len(board.points)}: "
            "check the board's columns and rows"
        )


def _centres(board: Board, image: BoardImage, grid: _Grid) -> np.ndarray:
    blobs = grid.blobs
    chosen = upright(board, [blobs.centres[numbering] for numbering in grid.numberings])
    order = next(n for n in grid.numberings if np.array_equal(blobs.centres[n], chosen))
    pixels = refine_centres(image.deep, chosen, blobs.covariances[order], blobs.inverted)
    lost = np.isnan(pixels).any(1)
    if lost.any():
        raise DetectionError(
            f"{np.count_nonzero(lost)} of {len(pixels)} circles are too close to their neighbours or too faint to "
            "measure: move the board closer, or focus the camera"
        )
    check_grid(board, pixels, np.arange(len(pixels)), "circles")
    return pixels


def _not_found(board: Board, image: BoardImage, most: Lattice) -> str:
    count, total = len(most.nodes), len(board.points)
    if count < 6:
        return f"no grid of circles found where {board} has {total}: {advice(image.grey)}"
    if count >= total:
        longer, shorter = most.extent
        return (
            f"{count} circles found in a grid of {longer}x{shorter} that does not hold all of {board}: "
            "check the board's columns and rows, and that nothing covers it"
        )
    return f"{count} of {total} circles found: {advice(image.grey)}"
