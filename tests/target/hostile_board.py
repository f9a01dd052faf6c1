"""Boards in scenes that are not made for them: clutter around the sheet, glare, a second board,
thermal contrast."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from rendered_board import View

from slviewer.target.board import Board
from slviewer.target.mark import neighbour_distance_mm

Disc = tuple[float, float, float, float]
"""Centre (x, y) and radius in pitches of the board's plane, and its albedo."""


@dataclass(frozen=True)
class Scene(View):
    """A board with ``discs`` in its plane, on the sheet and beside it; ``glare`` spots (u, v,
    radius px, grey levels); ``texture`` grey levels of a cloudy background; ``second`` the same
    board once more, smaller, seen so.
    """

    discs: tuple[Disc, ...] = ()
    glare: tuple[tuple[float, float, float, float], ...] = ()
    texture: float = 0.0
    contrast: float = 1.0
    second: View | None = None

    def albedo(self, board: Board, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        value = super().albedo(board, x, y)
        p = board.pitch_mm
        for a, b, radius, level in self.discs:
            value = np.where((x - a * p) ** 2 + (y - b * p) ** 2 < (radius * p) ** 2, level, value)
        return value

    def render(self, board: Board, seed: int = 0) -> np.ndarray:
        image = replace(self, noise=0.0).plain(board).astype(np.float64)
        rng = np.random.default_rng(seed)
        height, width = image.shape
        if self.second is not None:
            other = self.second.render(board).astype(np.float64)
            image = np.where(sheet_mask(self.second, board), other, image)
        if self.texture:
            cloudy = cv2.GaussianBlur(rng.normal(0, 1, (height, width)), (0, 0), 6)
            clear = ~sheet_mask(self, board)
            image += clear * self.texture * cloudy / cloudy.std()
        v, u = np.mgrid[:height, :width]
        for a, b, radius, level in self.glare:
            image += level * np.exp(-((u - a) ** 2 + (v - b) ** 2) / 2 / radius**2)
        image = 110 + self.contrast * (image - 110) if self.contrast != 1 else image
        image += rng.normal(0, self.noise, image.shape) if self.noise else 0.0
        return np.clip(np.round(image), 0, 255).astype(np.uint8)

    def plain(self, board: Board) -> np.ndarray:
        """The board and the discs alone."""
        return View.render(self, board)


def sheet_mask(view: View, board: Board) -> np.ndarray:
    """(h, w) bool: the pixels that see the board's sheet."""
    margin = view.sheet * board.pitch_mm
    (a, b), (c, d) = board.points[:, :2].min(0) - margin, board.points[:, :2].max(0) + margin
    corners = view.project(board, np.array([[a, b], [c, b], [c, d], [a, d]]))
    mask = np.zeros(view.size[::-1], np.uint8)
    cv2.fillConvexPoly(mask, np.round(corners).astype(np.int32), 1)
    return mask.astype(bool)


def blobs_around(
    board: Board, seed: int, count: int, sheet: float = 0.6, like: float = 0.25
) -> tuple[Disc, ...]:
    """Dark discs about as large as the board's circles, scattered beyond the edge of a sheet
    ``sheet`` pitches wide."""
    rng = np.random.default_rng(seed)
    low, high = (f(board.points[:, :2], axis=0) / board.pitch_mm for f in (np.min, np.max))
    near = neighbour_distance_mm(board) / board.pitch_mm
    discs: list[Disc] = []
    while len(discs) < count:
        x, y = rng.uniform(low - 4, high + 4)
        radius = near * like * rng.uniform(0.5, 1.5)
        outside = max(low[0] - x, x - high[0], low[1] - y, y - high[1]) - radius > sheet
        if outside and all(np.hypot(x - a, y - b) > radius + r + 0.05 for a, b, r, _ in discs):
            discs.append((float(x), float(y), float(radius), float(rng.uniform(0.03, 0.3))))
    return tuple(discs)


def lattice_around(board: Board, seed: int, share: float, jitter: float = 0.0) -> tuple[Disc, ...]:
    """Dark discs where one more row of circles would be, ``share`` of it, each up to ``jitter``
    pitches off."""
    rng = np.random.default_rng(seed)
    points = board.points[:, :2] / board.pitch_mm
    row = points[points[:, 1] == 0] - (0, 2 if board.kind == "acircles" else 1)
    radius = 0.25 * neighbour_distance_mm(board) / board.pitch_mm
    chosen = row[: max(1, round(share * len(row)))] + rng.uniform(
        -jitter, jitter, (max(1, round(share * len(row))), 2)
    )
    return tuple((float(x), float(y), float(radius), 0.08) for x, y in chosen)
