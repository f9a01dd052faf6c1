"""Coverage of the poses so far, and the next pose that improves it most.

A calibration needs the target in every part of the image, near and far, and tilted in several directions. Poses are
T_camera_board (4, 4) mm; before a calibration they are approximate, from a nominal lens, which is good enough here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.target.board import Board

COLUMNS, ROWS = 4, 3
"""Cells of the image."""
THIRDS = ("near", "at middle distance", "far")
TILTS = ("facing", "top away", "right away", "bottom away", "left away")
FACING_DEG = 8.0
"""Tilts below count as facing the camera."""
GOAL_POSES = 2
"""Poses that each third and each tilt should have."""
CELL_GOAL = 4
"""Poses that each cell should have: a pixel-wise fit takes four at least."""
NOMINAL_FOCAL = 1.5
"""In widths of the image, where nothing is known of the lens: between a phone's and a machine lens's."""

_NEAR_FILL, _DEPTH_RATIO = (
    0.9,
    1.45,
)  # nearest: the squarely held board fills so much of the image; farthest: times this
_CELL_SHARE = 0.5  # of a cell that the board must cover
_FREE = 0.015  # of the image's width, left free around the board
_FINE = 5  # samples along each side of a cell


@dataclass(frozen=True, eq=False)
class Coverage:
    """How many poses cover each cell of the image (3, 4), each third of the depths (3,), each of `TILTS` (5,)."""

    cells: np.ndarray
    depths: np.ndarray
    tilts: np.ndarray
    range_mm: tuple[float, float]

    @property
    def share(self) -> float:
        """0 ... 1: how much of the goal is reached, the image, the depths and the tilts counting alike."""
        goals = ((self.cells, CELL_GOAL), (self.depths, GOAL_POSES), (self.tilts, GOAL_POSES))
        return float(np.mean([np.minimum(n, goal).mean() / goal for n, goal in goals]))


@dataclass(frozen=True, eq=False)
class Suggestion:
    """The next pose, T_camera_board (4, 4) mm, its outline (4, 2) in camera px, and the same in words."""

    T_camera_board: np.ndarray
    outline_px: np.ndarray
    sentence: str


def nominal_lens(size: tuple[int, int], focal_px: float | None = None) -> Lens:
    """A lens without distortion; `focal_px` is guessed where it is not known."""
    width, height = size
    f = focal_px or NOMINAL_FOCAL * width
    return Lens(np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]]), np.zeros(5), size)


def estimated_lens(points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], size: tuple[int, int]) -> Lens:
    """A lens from features (n, 3) mm and (n, 2) px of several tilted boards; the nominal one where they do not
    determine it.

    One focal length, no distortion: enough to place boards with, long before a calibration is possible.
    """
    if len(points) >= 2:
        objects, images = ([np.asarray(a, np.float32) for a in arrays] for arrays in (points, pixels))
        f = float(cv2.initCameraMatrix2D(objects, images, size, aspectRatio=1.0)[0, 0])
        if np.isfinite(f) and 0.5 < f / size[0] < 8:
            return nominal_lens(size, f)
    return nominal_lens(size)


def approximate_pose(points: np.ndarray, pixels: np.ndarray, lens: Lens) -> np.ndarray | None:
    """T_camera_board (4, 4) mm from features (n, 3) mm and (n, 2) px; None where they give none."""
    if len(points) < 4:
        return None
    try:
        found, rotation, t = cv2.solvePnP(
            np.asarray(points, float), np.asarray(pixels, float), lens.K, lens.D, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], np.ravel(t)
    return T if found and np.isfinite(T).all() and T[2, 3] > 0 else None


def depth_range(board: Board, lens: Lens) -> tuple[float, float]:
    """(near, far) mm to hold the board at: from filling the image to two thirds of that."""
    sides = np.ptp(board.outline()[:, :2], axis=0)
    near = float(np.max(sides * lens.K[[0, 1], [0, 1]] / (_NEAR_FILL * np.array(lens.size))))
    return near, _DEPTH_RATIO * near


def coverage(board: Board, lens: Lens, poses: Sequence[np.ndarray]) -> Coverage:
    """What `poses` cover together."""
    span = depth_range(board, lens)
    cells, depths, tilts = np.zeros((ROWS, COLUMNS), int), np.zeros(3, int), np.zeros(len(TILTS), int)
    for T in poses:
        seen, third, tilt = _classify(board, lens, T, span)
        cells += seen
        depths[third] += 1
        tilts[tilt] += 1
    return Coverage(cells, depths, tilts, span)


def outline_px(board: Board, lens: Lens, T: np.ndarray) -> np.ndarray:
    """(4, 2) px: the board's outline in the image, NaN behind the camera."""
    return lens.project(_place_board(T, board.outline()))


def suggest(
    board: Board,
    lens: Lens,
    poses: Sequence[np.ndarray],
    *,
    illuminated: Callable[[np.ndarray], np.ndarray] | None = None,
    skip: int = 0,
) -> Suggestion:
    """The pose that adds most to what `poses` cover, with the whole board in view.

    `illuminated(points (n, 3) mm) -> (n,) bool` says which points the projector reaches, where that is known
    (`projector_reach` learns it). `skip` passes over so many of the best: those that were tried and refused.
    """
    have = coverage(board, lens, poses)
    taken = [_signature(T, board, have.range_mm) for T in poses]
    ranked = []
    for T in _candidates(board, lens, have.range_mm, len(poses), illuminated):
        seen, third, tilt = _classify(board, lens, T, have.range_mm)
        lacks = (
            (seen * np.maximum(CELL_GOAL - have.cells, 0)).sum() / (CELL_GOAL * seen.size)
            + max(GOAL_POSES - have.depths[third], 0) / GOAL_POSES
            + max(GOAL_POSES - have.tilts[tilt], 0) / GOAL_POSES
        )
        here = _signature(T, board, have.range_mm)
        apart = min((float(np.linalg.norm(here - other)) for other in taken), default=1.0)
        ranked.append((lacks + 0.2 * apart, T))
    if not ranked:
        raise InputError(f"the board {board} cannot be held so that the camera sees all of it: take a smaller board")
    ranked.sort(key=lambda entry: -entry[0])
    return describe_suggestion(board, lens, ranked[skip % len(ranked)][1])


def describe_suggestion(board: Board, lens: Lens, T_camera_board: np.ndarray) -> Suggestion:
    """A pose as a suggestion: its outline and its words."""
    corners = outline_px(board, lens, T_camera_board)
    _, third, tilt = _classify(board, lens, T_camera_board, depth_range(board, lens))
    return Suggestion(T_camera_board, corners, _describe_pose(third, tilt, corners.mean(0), lens.size))


def projector_reach(
    points: np.ndarray, pixels: np.ndarray, size: tuple[int, int], margin: float = 0.02
) -> Callable[[np.ndarray], np.ndarray] | None:
    """Which points the projector reaches, learnt from camera-frame `points` (n, 3) mm whose projector `pixels` (n, 2)
    are known; None where they do not tell (a single plane). Linear resection of the projector, without distortion.
    """
    known = np.isfinite(pixels).all(1) & np.isfinite(points).all(1)
    points, pixels = points[known], pixels[known]
    if len(points) < 12:
        return None
    middle, scale = points.mean(0), points.std()
    unit = np.array(size, float)
    X = np.column_stack([(points - middle) / scale, np.ones(len(points))])
    u = pixels / unit - 0.5
    none = np.zeros_like(X)
    rows = np.concatenate([np.hstack([X, none, -u[:, :1] * X]), np.hstack([none, X, -u[:, 1:] * X])])
    _, singular, basis = np.linalg.svd(rows, full_matrices=False)
    if singular[-2] < 1e-3 * singular[0]:  # a plane leaves several solutions
        return None
    P = basis[-1].reshape(3, 4)

    def reaches(points: np.ndarray) -> np.ndarray:
        h = np.column_stack([(points - middle) / scale, np.ones(len(points))]) @ P.T
        return (np.abs(h[:, :2] / h[:, 2:]) < 0.5 - margin).all(1)

    return reaches if reaches(points).mean() > 0.8 else None


def _candidates(
    board: Board,
    lens: Lens,
    span: tuple[float, float],
    count: int,
    illuminated: Callable[[np.ndarray], np.ndarray] | None,
) -> list[np.ndarray]:
    """Poses in every third, tilt and direction, each as far out as keeps the whole board in view and in the light."""
    angle = np.radians((18.0, 25.0, 14.0)[count % 3])
    near, far = span
    middle = (board.points.min(0) + board.points.max(0)) / 2
    width, height = lens.size
    found = []
    # Before two poses have shown the projector's field of view, the middle of the image is most likely inside it.
    places = list(product((-1, 0, 1), (-1, 0, 1))) if illuminated is not None else [(0, 0)]
    for third, tilt, place in product(range(3), range(len(TILTS)), places):
        R = _tilt_rotation(tilt, angle)
        depth = near + (far - near) * (third + 0.5) / 3
        out = np.array([place[0] * width, place[1] * height]) / 2
        for share in np.linspace(1, 0, 11) if place != (0, 0) else (0.0,):
            u, v = np.array([(width - 1) / 2, (height - 1) / 2]) + share * out
            ray = np.array([(u - lens.K[0, 2]) / lens.K[0, 0], (v - lens.K[1, 2]) / lens.K[1, 1], 1.0])
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = R, depth * ray - R @ middle
            if _in_view(board, lens, T, illuminated):
                if share > 0.15 or place == (0, 0):
                    found.append(T)
                break
    return found


def _in_view(board: Board, lens: Lens, T: np.ndarray, illuminated: Callable[[np.ndarray], np.ndarray] | None) -> bool:
    corners = _place_board(T, board.outline())
    pixels = lens.project(corners)
    free = _FREE * lens.size[0]
    if not (np.isfinite(pixels).all() and (pixels > free).all() and (pixels < np.array(lens.size) - 1 - free).all()):
        return False
    return illuminated is None or bool(illuminated(corners).all())


def _classify(board: Board, lens: Lens, T: np.ndarray, span: tuple[float, float]) -> tuple[np.ndarray, int, int]:
    """(cells (3, 4) bool, third, tilt) of one pose."""
    u, v = np.meshgrid(*((np.arange(n * _FINE) + 0.5) / (n * _FINE) for n in (COLUMNS, ROWS)))
    samples = np.stack([u, v], -1).reshape(-1, 2) * np.array(lens.size)
    corners = outline_px(board, lens, T)
    inside = np.zeros(len(samples), bool)
    if np.isfinite(corners).all():
        sides = np.roll(corners, -1, 0) - corners
        away = samples[:, None] - corners
        turns = sides[:, 0] * away[..., 1] - sides[:, 1] * away[..., 0]
        inside = (turns > 0).all(1) | (turns < 0).all(1)
    cells = inside.reshape(ROWS, _FINE, COLUMNS, _FINE).mean((1, 3)) >= _CELL_SHARE
    near, far = span
    third = int(np.clip(3 * (_board_middle(T, board)[2] - near) / (far - near), 0, 2))
    return cells, third, _classify_tilt(T)


def _classify_tilt(T: np.ndarray) -> int:
    normal = T[:3, 2] * (1 if T[2, 2] >= 0 else -1)
    if np.degrees(np.arccos(np.clip(normal[2], -1, 1))) < FACING_DEG:
        return 0
    # the side towards which depth grows: dz/dx = -n_x/n_z, dz/dy = -n_y/n_z, and up in the image is -y
    right, top = -normal[0], normal[1]
    return (1 if top > 0 else 3) if abs(top) >= abs(right) else (2 if right > 0 else 4)


def _tilt_rotation(tilt: int, angle: float) -> np.ndarray:
    turns = {0: (0, 0), 1: (-angle, 0), 2: (0, -angle), 3: (angle, 0), 4: (0, angle)}[tilt]
    return cv2.Rodrigues(np.array([turns[0], turns[1], 0.0]))[0]


def _signature(T: np.ndarray, board: Board, span: tuple[float, float]) -> np.ndarray:
    """What makes two poses alike: place across, depth and tilt, each about 1 over what is of use."""
    x, y, z = _board_middle(T, board)
    reach = np.ptp(board.points[:, 0]) / 2
    return np.array([x / reach, y / reach, (z - span[0]) / (span[1] - span[0]), *(T[:2, 2] / np.sin(np.radians(25)))])


def _board_middle(T: np.ndarray, board: Board) -> np.ndarray:
    return _place_board(T, ((board.points.min(0) + board.points.max(0)) / 2)[None])[0]


def _place_board(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


def _describe_pose(third: int, tilt: int, middle_px: np.ndarray, size: tuple[int, int]) -> str:
    across, down = middle_px / np.array(size) - 0.5
    where = [
        word
        for word, here in (
            ("top", down < -0.06),
            ("bottom", down > 0.06),
            ("left", across < -0.06),
            ("right", across > 0.06),
        )
        if here
    ]
    attitude = "Face the camera squarely" if tilt == 0 else f"Tilt the {TILTS[tilt].removesuffix(' away')} away"
    return f"{attitude}, {THIRDS[third]}, {'to the ' + ' '.join(where) if where else 'in the middle'}"
