"""Boards that are not quite flat, with features that are not quite where they should be."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.simulation.board_kernels import average_albedo, intersect
from slviewer.simulation.scenes import Points, Rays, Surface
from slviewer.target.board import Board


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
        xy = self.board.points[:, :2] + self.misplacement
        return np.concatenate([xy, self.height(xy)[:, None]], 1)

    def height(self, xy: np.ndarray) -> np.ndarray:
        """z (...) mm of the plate's surface at (..., 2) of the board's frame."""
        X, Y = np.moveaxis(2 * (xy - np.array(self.corner)) / np.array(self.plate) - 1, -1, 0)
        shape = self.shape
        return shape.bow_x_mm * (1 - X * X) + shape.bow_y_mm * (1 - Y * Y) + shape.twist_mm * X * Y

    def trace(self, rays: Rays) -> Surface:
        """Where the rays meet the plate; albedo averaged over each pixel."""
        bounds = np.array([*self.corner, *self.plate])
        shape = np.array([self.shape.bow_x_mm, self.shape.bow_y_mm, self.shape.twist_mm])
        origin, axes = -self.pose.R.T @ self.pose.t, np.ascontiguousarray(self.pose.R.T)
        xy, points, normals = intersect(
            np.ascontiguousarray(rays), origin, axes, self.pose.R, bounds, shape
        )
        board = self.board
        kind, pitch, cells = 0, 1.0, np.zeros((1, 1), np.int32)
        if board is not None and board.kind == "chessboard":
            kind, pitch = 2, board.pitch_mm
            cells = np.array([[board.columns, board.rows]], np.int32)
        elif board is not None:
            kind, pitch, cells = 1, board.pitch_mm, self._cells(board)
        circles = self.features[:, :2].copy()
        sheet = kind, pitch, cells, circles, self.diameter_mm / 2, self.white, self.dark
        albedo = average_albedo(xy, bounds, sheet)
        outside = albedo == 0
        points[outside], normals[outside] = np.nan, np.nan
        return Surface(points, normals, albedo)

    def occluded(self, points: Points, source: Points) -> np.ndarray:
        """Return all False: a nearly flat plate shades no part of itself."""
        return np.zeros(len(points), bool)

    def _cells(self, board: Board) -> np.ndarray:
        """(rows, columns) int32: in cells of a quarter pitch, the nearest circle: the only one that
        can be there."""
        step = board.pitch_mm / 4
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
            "the simulation does not print ChArUco boards: use circles, acircles or a chessboard"
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
