"""A small renderer of boards with known feature positions: supersampled, in perspective, shaded,
blurred and noisy."""

from dataclasses import dataclass

import cv2
import numpy as np

from slviewer.target.board import Board
from slviewer.target.mark import mark_geometry


@dataclass(frozen=True)
class View:
    """How a board is seen.

    ``fill`` is the width or height of the board over the image's; ``tilt`` deg about an axis at
    ``axis`` deg in the image; ``roll`` deg clockwise in the image; ``shift`` px; ``marked`` a dot
    beside the first circle; ``k1`` radial distortion in normalised coordinates; ``shade`` the ratio
    of brightest to darkest light; ``hide`` a rectangle of the board in mm that shows paper.
    """

    size: tuple[int, int] = (640, 480)
    fill: float = 0.75
    tilt: float = 0.0
    axis: float = 90.0
    roll: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)
    k1: float = 0.0
    shade: float = 1.0
    blur: float = 0.7
    noise: float = 0.0
    paper: float = 190.0
    ink: float = 0.08
    diameter: float = 0.5
    inverted: bool = False
    marked: bool = False
    sheet: float = 1.3
    hide: tuple[float, float, float, float] | None = None
    supersample: int = 8

    def homography(self, board: Board) -> np.ndarray:
        """(3, 3): board mm to undistorted px."""
        width, height = self.size
        low, high = board.points[:, :2].min(0), board.points[:, :2].max(0)
        middle, extent = (low + high) / 2, high - low
        axis, tilt, roll = np.deg2rad([self.axis, self.tilt, self.roll])
        R = (
            cv2.Rodrigues(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))[0]
            @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
        )
        spread = np.abs(R[:2, :2]) @ extent
        focal = 1.6 * width
        depth = focal * max(spread[0] / width, spread[1] / height) / self.fill
        T = np.array([0.0, 0.0, depth]) - R @ np.array([*middle, 0.0])
        K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
        return (
            np.array([[1, 0, self.shift[0]], [0, 1, self.shift[1]], [0, 0, 1.0]])
            @ K
            @ np.c_[R[:, :2], T]
        )

    def project(self, board: Board, points: np.ndarray) -> np.ndarray:
        """(n, 2) px of board points (n, 2) mm, distortion included."""
        ideal = cv2.perspectiveTransform(
            np.asarray(points, float)[None, :, :2], self.homography(board)
        )[0]
        seen = ideal.copy()
        for _ in range(30):
            seen -= self._undistort(seen) - ideal
        return seen

    def _undistort(self, pixels: np.ndarray) -> np.ndarray:
        width, height = self.size
        offset = pixels - np.array([(width - 1) / 2, (height - 1) / 2])
        radius2 = (offset**2).sum(-1, keepdims=True) / width**2
        return pixels + offset * self.k1 * radius2

    def gain(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Light at a pixel: a slope across the image times vignetting, 1 at its brightest, 1 /
        shade at its darkest."""
        width, height = self.size
        along = (u / width + 0.4 * v / height) / 1.4
        away = ((u - width / 2) ** 2 + (v - height / 2) ** 2) / (width**2 + height**2) * 4
        return self.shade ** (-(0.7 * along + 0.3 * away))

    def truth(self, board: Board) -> np.ndarray:
        return self.project(board, board.points)

    def render(self, board: Board, seed: int = 0) -> np.ndarray:
        """(h, w) uint8."""
        width, height = self.size
        s = self.supersample
        inverse = np.linalg.inv(self.homography(board))
        # a sheared grid of samples: an edge along a pixel row meets s² different heights rather
        # than s
        b, a = np.meshgrid(np.arange(s), np.arange(s), indexing="ij")
        fine_u, fine_v = ((a + (b + 0.5) / s) / s - 0.5, (b + (a + 0.5) / s) / s - 0.5)
        image = np.empty((height, width))
        for v0 in range(0, height, 32):
            rows = np.arange(v0, min(v0 + 32, height))
            u = (
                np.arange(width)[None, None, :, None]
                + fine_u[None, :, None, :]
                + np.zeros((len(rows), 1, 1, 1))
            )
            v = rows[:, None, None, None] + fine_v[None, :, None, :] + np.zeros((1, 1, width, 1))
            if self.k1:
                u, v = np.moveaxis(self._undistort(np.stack([u, v], -1)), -1, 0)
            x, y, w = (row[0] * u + row[1] * v + row[2] for row in inverse)
            albedo = self.albedo(board, x / w, y / w)
            image[rows] = albedo.mean((1, 3))
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        image = self.paper * image * self.gain(u, v)
        if self.blur:
            image = cv2.GaussianBlur(image, (0, 0), self.blur)
        image += (
            np.random.default_rng(seed).normal(0, self.noise, image.shape) if self.noise else 0.0
        )
        return np.clip(np.round(image), 0, 255).astype(np.uint8)

    def albedo(self, board: Board, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        dark = dark_parts(board, x, y, self.diameter)
        mark = mark_geometry(board)
        if self.marked and mark is not None:
            dark |= (x - mark.x) ** 2 + (y - mark.y) ** 2 < mark.radius**2
        if self.hide is not None:
            dark &= ~(
                (x > self.hide[0]) & (y > self.hide[1]) & (x < self.hide[2]) & (y < self.hide[3])
            )
        margin = self.sheet * board.pitch_mm
        low, high = board.points[:, :2].min(0) - margin, board.points[:, :2].max(0) + margin
        on_sheet = (x > low[0]) & (y > low[1]) & (x < high[0]) & (y < high[1])
        light = np.where(dark != self.inverted, self.ink, 1.0)
        return np.where(on_sheet, light, 0.45)


def dark_parts(board: Board, x: np.ndarray, y: np.ndarray, diameter: float) -> np.ndarray:
    """Bool: where a board is printed; ``diameter`` of circles over their distance."""
    p = board.pitch_mm
    if board.kind == "circles":
        j, i = (
            np.clip(np.round(c / p), 0, n - 1) for c, n in ((x, board.columns), (y, board.rows))
        )
        return (x - j * p) ** 2 + (y - i * p) ** 2 < (diameter * p / 2) ** 2
    if board.kind == "acircles":
        dark = np.zeros(x.shape, bool)
        for first in (0, 1):
            i = (
                np.clip(2 * np.round((y / p - first) / 2), 0, 2 * ((board.rows - 1 - first) // 2))
                + first
            )
            j = np.clip(np.round((x / p - first) / 2), 0, board.columns - 1)
            dark |= (x - (2 * j + first) * p) ** 2 + (y - i * p) ** 2 < (diameter * p / 2**0.5) ** 2
        return dark
    columns, rows = board.features
    j, i = np.floor(x / p).astype(int), np.floor(y / p).astype(int)
    inside = (j >= -1) & (j < columns) & (i >= -1) & (i < rows)
    dark = inside & ((i + j) % 2 == 0)
    if board.kind == "charuco":
        cells = _marker_sheet(board)
        scale = cells.shape[1] / (board.columns * p)
        row = np.clip(((y + p) * scale).astype(int), 0, cells.shape[0] - 1)
        column = np.clip(((x + p) * scale).astype(int), 0, cells.shape[1] - 1)
        dark = inside & (cells[row, column] == 0)
    return dark


def _marker_sheet(board: Board) -> np.ndarray:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    ids = np.arange(board.columns * board.rows // 2) + board.first_id
    charuco = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.pitch_mm, board.marker_mm, dictionary, ids
    )
    charuco.setLegacyPattern(board.legacy)
    return charuco.generateImage((112 * board.columns, 112 * board.rows), marginSize=0)
