"""Boards that are not quite flat, with features that are not quite where they should be."""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.simulation.scenes import Points, Rays, Surface, directions_of
from slviewer.target.board import Board

_FIXED_POINT = 6
"""Steps, each of which gains the factor slope x tan(incidence), about 1e-3 for some tenths of a mm
of bow."""
_SAMPLES = 8


@dataclass(frozen=True, eq=False)
class Pose:
    """T_camera_board: X_camera = R X_board + t, mm."""

    R: np.ndarray
    t: Points

    def __post_init__(self) -> None:
        if self.R.shape != (3, 3) or self.t.shape != (3,):
            raise InputError(
                f"a pose needs R (3, 3) and t (3,), got the shapes {self.R.shape} and"
                f" {self.t.shape}"
            )

    @property
    def matrix(self) -> np.ndarray:
        """T_camera_board (4, 4), mm."""
        return np.block([[self.R, self.t[:, None]], [np.zeros(3), 1.0]])

    def to_camera(self, points: Points) -> np.ndarray:
        """Board-frame points (..., 3) in the camera frame."""
        return points @ self.R.T + self.t


@dataclass(frozen=True)
class BoardShape:
    """How far a board departs from a plane, mm: z = bow_x (1 - X^2) + bow_y (1 - Y^2) + twist X Y.

    X and Y run from -1 to 1 over the board; z points away from the camera. `misplaced_mm` is the
    standard deviation of each circle's offset in x and y.
    """

    bow_x_mm: float = 0.0
    bow_y_mm: float = 0.0
    twist_mm: float = 0.0
    misplaced_mm: float = 0.0


FLAT = BoardShape()


@dataclass(frozen=True, eq=False)
class BoardScene:
    """A white plate at `pose`, printed with `board`'s features, or blank if `board` is None.

    The plate reaches from `corner` to `corner + size` (x, y) in the board's frame, where the first
    feature is the origin; `misplacement` (n, 2) mm is what has been added to the printed circles.
    Circles are `diameter_mm` wide.
    """

    pose: Pose
    board: Board | None
    corner: tuple[float, float]
    plate: tuple[float, float]
    shape: BoardShape
    misplacement: np.ndarray
    diameter_mm: float = 0.0
    white: float = 0.85
    dark: float = 0.09

    @cached_property
    def features(self) -> np.ndarray:
        """True positions (n, 3) mm of the features in the board's frame, bow and misplacement
        included."""
        if self.board is None:
            return np.zeros((0, 3))
        x, y = (self.board.points[:, :2] + self.misplacement).T
        return np.stack([x, y, self._height(*self._relative(x, y))], 1)

    def place(self, across: float, down: float) -> np.ndarray:
        """Place (3,) mm in the camera's frame at these shares of the plate's width and height."""
        (x, y), (width, height) = self.corner, self.plate
        return self.pose.to_camera(np.array([x + across * width, y + down * height, 0.0]))

    def _height(self, X: np.ndarray, Y: np.ndarray) -> np.ndarray:
        """z (...) mm of the plate's surface at X and Y (...), -1 to 1 over the plate."""
        shape = self.shape
        return shape.bow_x_mm * (1 - X * X) + shape.bow_y_mm * (1 - Y * Y) + shape.twist_mm * X * Y

    def _relative(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """X and Y (...), -1 to 1 over the plate, of places in the board's frame."""
        (left, top), (width, height) = self.corner, self.plate
        return (x - left) / (width / 2) - 1, (y - top) / (height / 2) - 1

    def intersect(self, rays: Rays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places x and y in the board's frame, and depths, (h, w) mm each, at which the rays meet
        the plate or what continues it; NaN behind the camera."""
        origin = -self.pose.R.T @ self.pose.t
        r, s = rays[..., 0], rays[..., 1]
        way_x, way_y, way_z = (row[0] * r + row[1] * s + row[2] for row in self.pose.R.T)
        z = np.zeros(r.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            for _ in range(_FIXED_POINT):
                depth = (z - origin[2]) / way_z
                depth[depth <= 0] = np.nan
                x, y = origin[0] + depth * way_x, origin[1] + depth * way_y
                if self.shape == FLAT:
                    break
                z = self._height(*self._relative(x, y))
        return x, y, depth

    def trace(self, rays: Rays) -> Surface:
        """Where the rays meet the plate; albedo averaged over each pixel."""
        shape, (width, height) = self.shape, self.plate
        x, y, depth = self.intersect(rays)
        X, Y = self._relative(x, y)
        zx = (-2 * shape.bow_x_mm * X + shape.twist_mm * Y) / (width / 2)
        zy = (-2 * shape.bow_y_mm * Y + shape.twist_mm * X) / (height / 2)
        # (zx, zy, -1) looks back at the camera, because the board's z points away from it
        facing = np.stack([row[0] * zx + row[1] * zy - row[2] for row in self.pose.R], axis=-1)
        normals = facing / np.sqrt(1 + zx * zx + zy * zy)[..., None]
        points = directions_of(rays) * depth[..., None]
        albedo = self._average_albedo(np.stack([x, y]))
        outside = albedo == 0
        points[outside], normals[outside] = np.nan, np.nan
        return Surface(points, normals, albedo)

    def _average_albedo(self, xy: np.ndarray) -> np.ndarray:
        """Mean albedo (h, w) float32 of each pixel; `xy` (2, h, w) are the board coordinates of the
        pixels' centres. A pixel whose centre and corners agree is taken as uniform; others are
        sampled 8x8 times."""
        down, along = np.gradient(xy, axis=(1, 2))
        albedo, mixed = self._albedo(*xy), np.zeros(xy.shape[1:], bool)
        for a, b in product((-0.5, 0.5), repeat=2):
            mixed |= self._albedo(*(xy + a * along + b * down)) != albedo
        xy, along, down = xy[:, mixed], along[:, mixed], down[:, mixed]
        places = product((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5, repeat=2)
        total = sum(self._albedo(*(xy + a * along + b * down)) for a, b in places)
        albedo[mixed] = total / _SAMPLES**2
        return albedo.astype(np.float32)

    def _albedo(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Albedo (...) at places of the board's frame; 0 outside the plate."""
        right, below, board = x - self.corner[0], y - self.corner[1], self.board
        inside = (right >= 0) & (right <= self.plate[0]) & (below >= 0) & (below <= self.plate[1])
        albedo = np.where(inside, self.white, 0.0)
        if board is None:
            return albedo
        if board.kind == "chessboard":
            column, row = (
                np.floor(each[inside] / pitch)
                for each, pitch in zip((x, y), board.pitches, strict=True)
            )
            dark = (column >= -1) & (column < board.columns) & ((column + row) % 2 == 0)
            dark &= (row >= -1) & (row < board.rows)
        else:
            columns, rows = (
                np.minimum((4 * each[inside] / board.pitch_mm).astype(int), count - 1)
                for each, count in zip((right, below), self._cells.shape[::-1], strict=True)
            )
            nearest = self._cells[rows, columns]
            dx, dy = x[inside] - self.features[nearest, 0], y[inside] - self.features[nearest, 1]
            dark = dx * dx + dy * dy < (self.diameter_mm / 2) ** 2
        albedo[inside] = np.where(dark, self.dark, self.white)
        return albedo

    def occluded(self, points: Points, source: Points) -> np.ndarray:
        """Return all False: a nearly flat plate shades no part of itself."""
        return np.zeros(len(points), bool)

    @cached_property
    def _cells(self) -> np.ndarray:
        """(rows, columns) int32: in cells of a quarter pitch, the nearest circle: the only one that
        can be there."""
        assert self.board is not None
        step = self.board.pitch_mm / 4
        shape = [int(np.ceil(length / step)) for length in reversed(self.plate)]
        middle = np.array(self.corner) + (np.moveaxis(np.indices(shape)[::-1], 0, -1) + 0.5) * step
        return cKDTree(self.features[:, :2]).query(middle)[1].astype(np.int32)


def printed_board(board: Board, pose: Pose, shape: BoardShape = FLAT, seed: int = 0) -> BoardScene:
    """Return the scene of `board` printed on a plate, 1.5 pitches around its outer features.

    `seed` draws the circles' misplacement, the same for every pose of one board. Circles are half a
    pitch wide. Raises `InputError` for ChArUco boards, which the simulation does not print.
    """
    if board.kind == "charuco":
        raise InputError(
            "the simulation does not print ChArUco boards", "use circles, acircles or a chessboard"
        )
    margin = 1.5 * board.pitch_mm
    low, high = board.points[:, :2].min(0) - margin, board.points[:, :2].max(0) + margin
    corner, plate = ((float(x), float(y)) for x, y in (low, high - low))
    misplacement, diameter = np.zeros((len(board.points), 2)), 0.0
    if board.kind != "chessboard":  # its corners share edges, so that they cannot move one by one
        draws = np.random.default_rng([seed, 0xB0A]).normal(0, 1, misplacement.shape)
        misplacement, diameter = draws * shape.misplaced_mm, board.pitch_mm / 2
    return BoardScene(pose, board, corner, plate, shape, misplacement, diameter)


def blank_board(pose: Pose, size: tuple[float, float] = (220.0, 176.0)) -> BoardScene:
    """A white plate of `size` mm whose middle is the origin of its frame."""
    return BoardScene(pose, None, (-size[0] / 2, -size[1] / 2), size, FLAT, np.zeros((0, 2)))
