"""What the 'letter' preset puts before its rig: target poses, planes, spheres and objects, the same
every time."""

import tomllib
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from slviewer.errors import InputError
from slviewer.geometry.vectors import box_middle
from slviewer.simulation.assets import asset
from slviewer.simulation.boards import (
    FLAT,
    BoardScene,
    BoardShape,
    Pose,
    blank_board,
    printed_board,
)
from slviewer.simulation.mesh import MeshScene, demo_object
from slviewer.simulation.rig import SimulatedRig
from slviewer.simulation.scenes import Scene, Spheres, sphere
from slviewer.target.board import Board

_LEFT_FREE_PX = 12.0  # between the outermost circles' rims and the image's edge, at full resolution

_PLANS = tomllib.loads(asset("simulation/plans.toml").read_text(encoding="utf-8"))


def letter_plan(
    rig: SimulatedRig, board: Board | None = None, poses: int = 25, shape: BoardShape = FLAT
) -> dict[str, Scene]:
    """Every capture of the preset by name: pose_01 ..., plane_01 ... plane_10, sphere_1 ...
    sphere_6, object_r1 ... r3.

    `board` defaults to the Letter's circles:21x16:9, and `shape` to a flat plate with its circles
    in place. The rig's seed draws the target poses and the misplacement.
    """
    board = board or Board.parse("circles:21x16:9")
    targets = {
        f"pose_{i:02d}": printed_board(board, pose, shape, rig.seed)
        for i, pose in enumerate(target_poses(rig, board, poses), 1)
    }
    return {**targets, **planes(), **spheres(), **objects()}


def target_poses(rig: SimulatedRig, board: Board, n: int = 25) -> list[Pose]:
    """`n` poses at 500 ... 700 mm, tilted by up to 28 degrees, that together reach the image's
    corners.

    Every feature stays in the camera's view and in the projector's light. The poses are drawn by
    the rig's seed and do not depend on its scale. Raises `InputError` for a board too large for
    that.
    """
    smooth = np.zeros((0, 6))  # what is in view is not a matter of tenths of a pixel
    camera = replace(rig.camera, scale=1.0, waves=smooth)
    projector = replace(rig.projector, waves=smooth)
    rig = replace(rig, camera=camera, projector=projector)
    rng = np.random.default_rng([rig.seed, 0x705E])
    middle = box_middle(board.points)
    # Spread evenly and without pattern: depths, tilts and directions are each shuffled strata.
    depths = 512 + 176 * (rng.permutation(n) + 0.5) / n
    tilts = np.radians(6 + 22 * (rng.permutation(n) + 0.5) / n)
    towards = rng.permutation(n) * 2 * np.pi / n + rng.uniform(0, 2 * np.pi)
    offsets = _list_directions(n)
    poses = []
    for i in range(n):
        axis = tilts[i] * np.array([np.cos(towards[i]), np.sin(towards[i]), 0])
        R = rotation(axis) @ rotation(np.array([0, 0, np.radians(rng.uniform(-8, 8))]))
        poses.append(
            _place_board(rig, board, R, middle, depths[i], offsets[i], rng.uniform(0.95, 1))
        )
    return poses


def planes() -> dict[str, BoardScene]:
    """The blank plate at ten poses whose shares in R1/R2/R3 resemble the Letter's Table 1."""
    return {
        f"plane_{i:02d}": blank_board(pose_at((tilt_x, tilt_y, 0), (x, y, z)))
        for i, (z, x, y, tilt_x, tilt_y) in enumerate(_PLANS["planes"], 1)
    }


def spheres() -> dict[str, Spheres]:
    """The sphere of 196 mm diameter, twice in each of R1, R2 and R3, as in the Letter's Table 2."""
    return {f"sphere_{i}": sphere(centre) for i, centre in enumerate(_PLANS["spheres"], 1)}


def objects(
    plan: Literal["objects", "moved_objects", "shown_objects"] = "objects",
) -> dict[str, MeshScene]:
    """Return the demo object at three depths, each time turned a little.

    In R1, R2 and R3 as in the Letter's experiment 3; ``moved_objects``: turned there by up to 15
    degrees from one to the next, and placed beside the axis; ``shown_objects``: near, middle and
    far of the depths that the wizard's suggested poses calibrate.
    """
    return {
        name: demo_object(pose_at(turns, middle)) for name, (middle, turns) in _PLANS[plan].items()
    }


def rotation(vector: np.ndarray) -> np.ndarray:
    """(3, 3): the turn about `vector` by its length in rad."""
    return Rotation.from_rotvec(vector).as_matrix()


def pose_at(turns_deg: Sequence[float], place_mm: ArrayLike) -> Pose:
    """Return the pose turned by a rotation vector, at a place in the camera's frame."""
    return Pose(rotation(np.radians(turns_deg)), np.array(place_mm))


def _list_directions(n: int) -> np.ndarray:
    """(n, 2) in -1 ... 1: position of each board in the field of view; corners most, then edges,
    then the middle."""
    corners = [(-1, -1), (1, 1), (1, -1), (-1, 1)]
    others = [(0, 0), (1, 0), (0, -1), (-1, 0), (0, 1)]
    cycle = [place for other in others for place in (*corners, other)]
    return np.resize(np.array(cycle, float), (n, 2))


def _place_board(
    rig: SimulatedRig,
    board: Board,
    R: np.ndarray,
    middle: np.ndarray,
    depth: float,
    offset: np.ndarray,
    share: float,
) -> Pose:
    """The pose with its middle at `depth`, as far towards `offset` as keeps the board in view,
    times `share`."""
    place = np.array([0.0, 0.0, depth])
    rim = ((board.points == board.points.min(0)) | (board.points == board.points.max(0)))[
        :, :2
    ].any(1)
    features = (board.points[rim] - middle) @ R.T
    if not _is_in_view(rig, board, features + place):
        raise InputError(
            f"the board {board} does not fit into the view at {depth:.0f} mm",
            f"take a smaller one, {np.ptp(board.points[:, 0]):.0f} x"
            f" {np.ptp(board.points[:, 1]):.0f} mm is too much",
        )
    for direction in (0, 1):  # first along x, then as far along y as is left
        reach, step = 0.0, 3.0
        while step > 0.02:
            trials = np.tile(place, (60, 1))
            trials[:, direction] = offset[direction] * (reach + step * np.arange(60))
            visible = _is_in_view(rig, board, features + trials[:, None])
            reach += step * (len(visible) - 1 if visible.all() else int(np.argmin(visible)) - 1)
            step /= 50
        place[direction] = offset[direction] * reach * share
    return Pose(R, place - R @ middle)


def _is_in_view(rig: SimulatedRig, board: Board, points: np.ndarray) -> np.ndarray:
    """(...) bool: whether all features, (..., n, 3) mm in the camera frame, lie in both images, a
    margin inside."""
    radius = board.pitch_mm / 4  # circles are half a pitch wide
    fits = np.ones(points.shape[:-2], bool)
    for pixels, lens, depths in (
        (rig.camera.project(points), rig.camera, points[..., 2:]),
        (rig.project(points), rig.projector, (points @ rig.R.T + rig.t)[..., 2:]),
    ):
        margin = _LEFT_FREE_PX + radius * np.array(lens.focal_px) / depths
        fits &= ((pixels > margin) & (pixels < np.array(lens.full_size) - 1 - margin)).all((-2, -1))
    return fits
