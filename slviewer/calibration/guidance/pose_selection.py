"""The pose that lowers the predicted sigma over the working volume most, among those that both devices would see."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from slviewer.calibration.guidance.coarse_rig import GuidanceBench
from slviewer.calibration.guidance.information import Information, Sensitivity
from slviewer.calibration.next_pose import depth_range

DEPTHS = (0.0, 0.2, 0.45, 0.75, 1.1, 1.45)
"""Where boards may be held, from nearest (0) over farthest (1) to beyond it, for the sake of what lies behind."""
TILTS_DEG = ((0, 0), (16, 0), (-16, 0), (0, 16), (0, -16), (22, 22), (22, -22), (-22, 22), (-22, -22), (32, 0),
             (-32, 0), (0, 32), (0, -32))  # fmt: skip
"""About x and y."""
DIRECTIONS = tuple((x, y) for x, y in product((-1.0, 0.0, 1.0), repeat=2))
"""The image's corners, edges and middle: a board goes as far there as it stays in view."""
_OFFSETS = 15  # places along each side that are tried
TRIALS = 56
"""Poses whose gain is computed, drawn from all; and near the best of them a fifth as many again."""


@dataclass(frozen=True, eq=False)
class Guidance:
    """The best poses T_camera_board (k, 4, 4), the best first; the predicted 3D sigma mm (RMS over the volume) with the
    poses had, and with the best one more."""

    poses: np.ndarray
    sigma_mm: float
    sigma_next_mm: float


def suggest_poses(bench: GuidanceBench, poses: Sequence[np.ndarray]) -> Guidance | None:
    """What to capture after ``poses`` T_camera_board (4, 4); None where no pose is in view of both devices."""
    candidates = candidate_poses(bench)
    if not len(candidates):
        return None
    sight = Sensitivity.from_bench(bench, depth_range(bench.board, bench.stereo.camera))
    information = Information.from_rows(bench, bench.rows(np.reshape(poses, (-1, 4, 4))), sight)
    rng = np.random.default_rng(len(poses))
    tried = rng.permutation(len(candidates))[:TRIALS]
    gains = dict(zip(tried.tolist(), map(information.gain, bench.rows(candidates[tried])), strict=True))
    best = max(gains, key=lambda i: gains[i])
    nearest = np.argsort([_pose_distance(candidates[best], T) for T in candidates])[: TRIALS // 5]
    more = [i for i in nearest.tolist() if i not in gains]
    gains |= dict(zip(more, map(information.gain, bench.rows(candidates[more])), strict=True))
    order = sorted(gains, key=lambda i: -gains[i])
    left = max(float(information.variances.mean()) - gains[order[0]], 0.0)
    return Guidance(candidates[order], information.sigma_mm, float(np.sqrt(left)))


def candidate_poses(bench: GuidanceBench) -> np.ndarray:
    """(k, 4, 4): poses at several depths and tilts, each in the middle of what both devices see and as far towards its
    corners and edges as keeps the board in view."""
    camera, board = bench.stereo.camera, bench.board
    near, far = depth_range(board, camera)
    middle = (board.points.min(0) + board.points.max(0)) / 2
    width, height = camera.size
    steps = np.linspace(0, 1, _OFFSETS)
    u, v = (a.ravel() for a in np.meshgrid(steps * (width - 1), steps * (height - 1)))
    rays = np.column_stack(
        [(u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1], np.ones(u.size)]
    )
    places = 2 * np.column_stack([u / (width - 1), v / (height - 1)]) - 1
    held = list(product(DEPTHS, TILTS_DEG))
    R = np.array([cv2.Rodrigues(np.radians(np.array([*tilt, 0.0])))[0] for _, tilt in held])
    depths = near + (far - near) * np.array([share for share, _ in held])
    T = np.tile(np.eye(4), (len(held), len(rays), 1, 1))
    T[..., :3, :3] = R[:, None]
    T[..., :3, 3] = depths[:, None, None] * rays - (R @ middle)[:, None]
    found = []
    for each, seen in zip(T, bench.in_view(T.reshape(-1, 4, 4)).reshape(T.shape[:2]), strict=True):
        if seen.any():
            found.append(each[seen][_select_spread(places[seen])])
    return np.concatenate(found) if found else np.zeros((0, 4, 4))


def _select_spread(places: np.ndarray) -> list[int]:
    """Which of the places (n, 2) lie farthest towards each of `DIRECTIONS`; the middle is theirs."""
    inward = 0.01 * (places**2).sum(1)
    off = ((places - (places.min(0) + places.max(0)) / 2) ** 2).sum(1)
    return sorted({int(np.argmax(places @ np.array(to) - inward) if any(to) else np.argmin(off)) for to in DIRECTIONS})


def _pose_distance(one: np.ndarray, other: np.ndarray) -> float:
    """How different two poses are: a tenth of the distance counts like 15 degrees."""
    shift = float(np.linalg.norm(one[:3, 3] - other[:3, 3])) / (0.1 * one[2, 3])
    turn = float(np.arccos(np.clip((np.trace(one[:3, :3].T @ other[:3, :3]) - 1) / 2, -1, 1)))
    return shift + turn / np.radians(15)
