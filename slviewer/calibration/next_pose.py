"""Coverage of the image, depths and tilts by target poses, and the next pose that improves it most.

A calibration needs the target in every part of the image, near and far, and tilted in several
directions. Poses are T_camera_board (4, 4) mm; before a calibration they are approximate, from a
nominal lens, which is good enough here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
import scipy

from slviewer.calibration.board_pose import solve_pose
from slviewer.errors import InputError
from slviewer.fringe.sequence import Size
from slviewer.geometry.lens import Lens
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rigid import Floats, Mask, move_points, rigid_transform
from slviewer.geometry.vectors import box_middle, finite_rows, lengths
from slviewer.target.board import Board

COLUMNS, ROWS = 4, 3
"""Cells of the image."""
THIRDS = ("near", "at middle distance", "far")
TILTS = ("facing", "top away", "right away", "bottom away", "left away")
_TILT_AXES = ((0, 0), (-1, 0), (0, -1), (1, 0), (0, 1))  # about which the board is turned for each
FACING_DEG = 8.0
"""Tilts below count as facing the camera."""
GOAL_POSES = 2
"""Poses that each third and each tilt should have."""
CELL_GOAL = 4
"""Poses that each cell should have: a pixel-wise fit takes four at least."""
NOMINAL_FOCAL = 1.5
"""In widths of the image, where nothing is known of the lens: between a phone's and a machine
lens's."""

# nearest: the squarely held board fills so much of the image; farthest: times this
_NEAR_FILL, _DEPTH_RATIO = 0.9, 1.45
_CELL_SHARE = 0.5  # of a cell that the board must cover
_REACH_MARGIN = 0.02  # of the projector's image, inside which points are reached
_FREE = 0.015  # of the image's width, left free around the board
_FINE = 5  # samples along each side of a cell


Illumination = Callable[[np.ndarray], np.ndarray]
"""Tells which points (n, 3) mm in the camera's frame the projector reaches, (n,) bool."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """Number of poses that cover each cell of the image (3, 4), each third of the depths (3,), and
    each tilt (5,).

    ``range_mm``: nearest and farthest recommended depth. ``second``: the cells (3, 4) of a second
    camera's image, which the goal does not count; None without one.
    """

    cells: np.ndarray
    depths: np.ndarray
    tilts: np.ndarray
    range_mm: tuple[float, float]
    second: np.ndarray | None = None

    @property
    def share(self) -> float:
        """Share of the goal that is reached, 0 to 1; image, depths and tilts have equal weight."""
        goals = ((self.cells, CELL_GOAL), (self.depths, GOAL_POSES), (self.tilts, GOAL_POSES))
        return float(np.mean([np.minimum(n, goal).mean() / goal for n, goal in goals]))


@dataclass(frozen=True, eq=False)
class Suggestion:
    """A recommended pose, T_camera_board (4, 4) mm, its outline (4, 2) in camera px, and an
    instruction in words."""

    T_camera_board: Floats
    outline_px: Floats
    sentence: str


def nominal_lens(size: Size, focal_px: float | None = None) -> Lens:
    """Return a lens without distortion; without `focal_px` a typical focal length is assumed."""
    width, height = size
    f = focal_px or NOMINAL_FOCAL * width
    return Lens.from_parameters((f, f, (width - 1) / 2, (height - 1) / 2), size)


def estimated_lens(points: Sequence[Floats], pixels: Sequence[Floats], size: Size) -> Lens:
    """Estimate a lens of one focal length, undistorted, from points (n, 3) mm and pixels (n, 2) of
    several boards.

    Returns the nominal lens for fewer than two boards, and where the estimate is not plausible.
    """
    if len(points) >= 2:
        objects, images = ([a.astype(np.float32) for a in arrays] for arrays in (points, pixels))
        f = float(cv2.initCameraMatrix2D(objects, images, size, aspectRatio=1.0)[0, 0])
        if np.isfinite(f) and 0.5 < f / size[0] < 8:
            return nominal_lens(size, f)
    return nominal_lens(size)


def approximate_pose(points: Floats, pixels: Floats, lens: Lens) -> Floats | None:
    """Estimate T_camera_board (4, 4) mm from points (n, 3) mm and pixels (n, 2); None where there
    is no solution."""
    if len(points) < 4:
        return None
    T = solve_pose(points, pixels, lens.K, lens.D, cv2.SOLVEPNP_IPPE)
    return None if T is None or T[2, 3] <= 0 else T


def depth_range(board: Board, lens: Lens) -> tuple[float, float]:
    """Return the nearest and farthest recommended depth of the board in mm; at the nearest it fills
    the image."""
    sides = np.ptp(board.outline()[:, :2], axis=0)
    near = float(np.max(sides * lens.K[[0, 1], [0, 1]] / (_NEAR_FILL * np.array(lens.size))))
    return near, _DEPTH_RATIO * near


def count_coverage(board: Board, lens: Lens, poses: Sequence[Floats]) -> Coverage:
    """Count how often `poses`, T_camera_board (4, 4) mm each, cover the cells, depths and tilts."""
    covered, thirds, tilts = _classify(board, lens, np.reshape(poses, (-1, 4, 4)))
    depths = np.bincount(thirds, minlength=len(THIRDS))
    tilts = np.bincount(tilts, minlength=len(TILTS))
    return Coverage(covered.sum(axis=0), depths, tilts, depth_range(board, lens))


def count_cells(poses: Sequence[Floats], size: Size) -> np.ndarray:
    """Count the poses with features, at pixels (n, 2), in each cell (3, 4) of an image of ``size``
    (width, height)."""
    counts = np.zeros((ROWS, COLUMNS), int)
    for pixels in poses:
        place = ((pixels[:, ::-1] + 0.5) * (ROWS, COLUMNS) / size[::-1]).astype(int)
        row, column = np.clip(place, 0, (ROWS - 1, COLUMNS - 1)).T
        covered = np.zeros_like(counts)
        covered[row, column] = 1
        counts += covered
    return counts


def place_board(board: Board, lens: Lens, R: Floats, depths: Floats, pixels: Floats) -> Floats:
    """Return poses (..., 4, 4) of the board turned by ``R`` (..., 3, 3), with its middle at
    ``depths`` (...) mm on the rays of ``pixels`` (..., 2), without distortion."""
    rays = np.concatenate(
        [(pixels - lens.K[:2, 2]) / np.diag(lens.K)[:2], np.ones((*pixels.shape[:-1], 1))], axis=-1
    )
    t = depths[..., None] * rays - R @ box_middle(board.points)
    return rigid_transform(np.broadcast_to(R, (*t.shape, 3)), t)


def outline_px(board: Board, lens: Lens, T: Floats) -> Floats:
    """(..., 4, 2) px: the board's outline in the image at poses T (..., 4, 4), NaN behind the
    camera."""
    return lens.project(move_points(T, board.outline()))


def suggest(
    board: Board,
    lens: Lens,
    poses: Sequence[Floats],
    *,
    illuminated: Illumination | None = None,
    skip: int = 0,
) -> Suggestion:
    """Suggest the pose that improves the coverage by `poses` most, with the whole board in view.

    `illuminated(points (n, 3) mm) -> (n,) bool`: whether the projector reaches points in the
    camera's frame, where that is known (see `projector_reach`). `skip`: number of better
    suggestions to skip, which were refused before. Raises InputError where no pose shows the whole
    board.
    """
    current = count_coverage(board, lens, poses)
    candidates = _list_candidates(board, lens, len(poses), illuminated)
    if not len(candidates):
        raise InputError(
            f"the board {board} cannot be held so that the camera sees all of it",
            "take a smaller board",
        )
    covered, thirds, tilts = _classify(board, lens, candidates)
    gain = (
        (covered * np.maximum(CELL_GOAL - current.cells, 0)).sum(axis=(1, 2))
        / (CELL_GOAL * current.cells.size)
        + np.maximum(GOAL_POSES - current.depths[thirds], 0) / GOAL_POSES
        + np.maximum(GOAL_POSES - current.tilts[tilts], 0) / GOAL_POSES
    )
    new, existing = (
        _describe_numerically(np.reshape(each, (-1, 4, 4)), board, current.range_mm)
        for each in (candidates, poses)
    )
    distance = lengths(new[:, None] - existing).min(axis=1) if len(poses) else 1.0
    order = np.argsort(-(gain + 0.2 * distance), kind="stable")
    return describe_suggestion(board, lens, candidates[order[skip % len(order)]])


def describe_suggestion(board: Board, lens: Lens, T_camera_board: Floats) -> Suggestion:
    """Return a suggestion for a given pose, with its outline and instruction."""
    corners = outline_px(board, lens, T_camera_board)
    _, thirds, tilts = _classify(board, lens, T_camera_board[None])
    across, down = corners.mean(0) / np.array(lens.size) - 0.5
    offsets = {"top": -down, "bottom": down, "left": -across, "right": across}
    where = " ".join(word for word, offset in offsets.items() if offset > 0.06)
    place = f"to the {where}" if where else "in the middle"
    attitude = f"Tilt the {TILTS[tilts[0]]}" if tilts[0] else "Face the camera squarely"
    return Suggestion(T_camera_board, corners, f"{attitude}, {THIRDS[thirds[0]]}, {place}")


def projector_reach(points: Floats, pixels: Floats, size: Size) -> Illumination | None:
    """Estimate the projector's field of view by linear resection (DLT) from points (n, 3) mm and
    pixels (n, 2).

    Points are in the camera's frame. Returns a function points (k, 3) mm -> (k,) bool, or None
    where the points do not determine the projection, as on a single plane.
    """
    known = finite_rows(pixels, points)
    points, pixels = points[known], pixels[known]
    if len(points) < 12:
        return None
    middle, scale = points.mean(0), points.std()

    def homogeneous(points: Floats) -> Floats:
        """Return normalised homogeneous coordinates (k, 4) of points (k, 3) mm."""
        return np.column_stack([(points - middle) / scale, np.ones(len(points))])

    X, u = homogeneous(points), pixels / np.array(size, float) - 0.5
    none = np.zeros_like(X)
    rows = np.concatenate(
        [np.hstack([X, none, -u[:, :1] * X]), np.hstack([none, X, -u[:, 1:] * X])]
    )
    _, singular, basis = np.linalg.svd(rows, full_matrices=False)
    if singular[-2] < 1e-3 * singular[0]:  # a plane leaves several solutions
        return None
    P = basis[-1].reshape(3, 4)

    def reaches(points: Floats) -> np.ndarray:
        """(k,) bool: whether points (k, 3) mm project into the projector's image less a margin."""
        h = homogeneous(points) @ P.T
        return (np.abs(h[:, :2] / h[:, 2:]) < 0.5 - _REACH_MARGIN).all(1)

    return reaches if reaches(points).mean() > 0.8 else None


def _list_candidates(
    board: Board, lens: Lens, count: int, illuminated: Illumination | None
) -> Floats:
    """Return poses (k, 4, 4) at every depth, tilt and direction, each as far off-centre as the
    whole board is visible.

    `count`: number of poses so far, which selects the tilt angle.
    """
    angle = np.radians((18.0, 25.0, 14.0)[count % 3])
    near, far = depth_range(board, lens)
    # Before two poses have shown the projector's field of view, the middle of the image is most
    # likely inside it.
    places = np.array(list(product((-1, 0, 1), repeat=2)) if illuminated is not None else [(0, 0)])
    shares = np.linspace(1, 0, 11)  # of the way from the image's middle to its border
    size = np.array(lens.size)
    pixels = (size - 1) / 2 + shares[:, None] * (places * size / 2)[:, None]
    depths = near + (far - near) * (np.arange(3) + 0.5) / 3
    R = scipy.spatial.transform.Rotation.from_rotvec(
        [(angle * x, angle * y, 0.0) for x, y in _TILT_AXES]
    ).as_matrix()
    # by depth, tilt, place and share
    T = place_board(board, lens, R[:, None, None], depths[:, None, None, None], pixels)
    visible = _is_visible(board, lens, T.reshape(-1, 4, 4), illuminated).reshape(T.shape[:-2])
    farthest = visible.argmax(axis=-1)
    far_enough = (shares[farthest] > 0.15) | (places == 0).all(axis=1)
    chosen = np.take_along_axis(T, farthest[..., None, None, None], axis=3)[..., 0, :, :]
    return chosen[visible.any(axis=-1) & far_enough]


def _is_visible(board: Board, lens: Lens, T: Floats, illuminated: Illumination | None) -> Mask:
    """(n,) bool: whether the board's outline at poses (n, 4, 4) is inside the image, with a margin,
    and illuminated."""
    corners = move_points(T, board.outline())
    inside = np.asarray(
        lens.contains(lens.project(corners), _FREE * lens.size[0] + 0.5).all(axis=1)
    )
    if illuminated is not None:
        inside[inside] = illuminated(corners[inside].reshape(-1, 3)).reshape(-1, 4).all(axis=1)
    return inside


def _classify(board: Board, lens: Lens, T: Floats) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the covered cells (n, 3, 4) bool, third of the depths (n,), index in `TILTS` (n,) of
    poses (n, 4, 4)."""
    samples = grid_points(
        *((np.arange(n * _FINE) + 0.5) / (n * _FINE) for n in (COLUMNS, ROWS))
    ) * np.array(lens.size)
    corners = outline_px(board, lens, T)[:, None]
    sides = np.roll(corners, -1, -2) - corners
    away = samples[:, None] - corners
    turns = sides[..., 0] * away[..., 1] - sides[..., 1] * away[..., 0]
    inside = (turns > 0).all(-1) | (turns < 0).all(-1)  # not for corners of NaN
    cells = inside.reshape(-1, ROWS, _FINE, COLUMNS, _FINE).mean((2, 4)) >= _CELL_SHARE
    near, far = depth_range(board, lens)
    thirds = np.clip(3 * (_board_middle(T, board)[:, 2] - near) / (far - near), 0, 2).astype(int)
    normal = T[:, :3, 2] * np.where(T[:, 2, 2] >= 0, 1, -1)[:, None]
    # the side towards which depth grows: dz/dx = -n_x/n_z, dz/dy = -n_y/n_z, and up in the image is
    # -y
    right, top = -normal[:, 0], normal[:, 1]
    tilted = np.where(
        np.abs(top) >= np.abs(right), np.where(top > 0, 1, 3), np.where(right > 0, 2, 4)
    )
    facing = np.degrees(np.arccos(np.clip(normal[:, 2], -1, 1))) < FACING_DEG
    return cells, thirds, np.where(facing, 0, tilted)


def _describe_numerically(T: Floats, board: Board, span: tuple[float, float]) -> Floats:
    """Return descriptors (n, 5) of poses (n, 4, 4), to compare them: position, depth and tilt in
    units of about 1."""
    middle = _board_middle(T, board)
    reach = np.ptp(board.points[:, 0]) / 2
    depth = (middle[:, 2:] - span[0]) / (span[1] - span[0])
    return np.hstack([middle[:, :2] / reach, depth, T[:, :2, 2] / np.sin(np.radians(25))])


def _board_middle(T: Floats, board: Board) -> Floats:
    """Return the middle (n, 3) mm of the board's features at poses (n, 4, 4), in the camera's
    frame."""
    return move_points(T, box_middle(board.points)[None])[:, 0]
