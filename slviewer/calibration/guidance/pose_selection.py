"""Selection of the next pose: the visible one that lowers the predicted sigma over the working
volume most."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.calibration.guidance.coarse_rig import GuidanceModel
from slviewer.calibration.guidance.information import (
    RigInformation,
    VolumeSensitivity,
    information_rows,
)
from slviewer.calibration.next_pose import depth_range
from slviewer.geometry.rigid import Floats, rigid_transform, rotation_angle
from slviewer.geometry.vectors import box_middle, lengths

DEPTHS = (0.0, 0.2, 0.45, 0.75, 1.1, 1.45)
"""Candidate depths, from nearest (0) to farthest (1) recommended depth, and beyond it."""
TILTS_DEG = ((0, 0), (16, 0), (-16, 0), (0, 16), (0, -16), (22, 22), (22, -22), (-22, 22),
(-22, -22), (32, 0),
             (-32, 0), (0, 32), (0, -32))  # fmt: skip
"""Candidate tilts about x and y."""
DIRECTIONS = tuple((x, y) for x, y in product((-1.0, 0.0, 1.0), repeat=2))
"""Directions from the image's centre in which the farthest visible pose is a candidate; (0, 0): the
most central."""
_OFFSETS = 15  # positions along each side of the image that are tested for visibility
TRIALS = 56
"""Default number of randomly drawn candidates whose gain is computed; a fifth as many more near the
best of them."""


@dataclass(frozen=True, eq=False)
class Guidance:
    """Recommended poses: T_camera_board (k, 4, 4) mm, the best first.

    ``sigma_mm``: predicted 3D standard deviation (RMS over the volume) from the poses so far;
    ``sigma_next_mm``: with the best pose added.
    """

    poses: np.ndarray
    sigma_mm: float
    sigma_next_mm: float


def suggest_poses(
    model: GuidanceModel, poses: Sequence[Floats], trials: int = TRIALS
) -> Guidance | None:
    """Recommend the next poses after ``poses``, T_camera_board (4, 4) mm each; None where no pose
    is visible.

    ``trials``: number of drawn candidates.
    """
    candidates = list_candidate_poses(model)
    if not len(candidates):
        return None
    sensitivity = VolumeSensitivity.from_model(model, depth_range(model.board, model.stereo.camera))
    rows = information_rows(model, np.reshape(poses, (-1, 4, 4)))
    information = RigInformation.from_rows(model, rows, sensitivity)

    def compute_gains(indices: list[int]) -> dict[int, float]:
        """Return the gain of each of these candidates by its index."""
        return {
            i: information.gain(rows)
            for i, rows in zip(indices, information_rows(model, candidates[indices]), strict=True)
        }

    gains = compute_gains(
        np.random.default_rng(len(poses)).permutation(len(candidates))[:trials].tolist()
    )
    best = max(gains, key=lambda i: gains[i])
    nearest = np.argsort(_pose_distances(candidates[best], candidates))[: trials // 5]
    gains |= compute_gains([i for i in nearest.tolist() if i not in gains])
    order = sorted(gains, key=lambda i: -gains[i])
    next_variance = max(float(information.variances.mean()) - gains[order[0]], 0.0)
    return Guidance(candidates[order], information.sigma_mm, float(np.sqrt(next_variance)))


def list_candidate_poses(model: GuidanceModel) -> Floats:
    """Return visible poses T_camera_board (k, 4, 4) mm at several depths and tilts.

    At each depth and tilt: the most central pose, and the farthest visible ones towards the image's
    corners and edges.
    """
    camera, board = model.stereo.camera, model.board
    near, far = depth_range(board, camera)
    middle = box_middle(board.points)
    width, height = camera.size
    steps = np.linspace(0, 1, _OFFSETS)
    u, v = (a.ravel() for a in np.meshgrid(steps * (width - 1), steps * (height - 1)))
    rays = np.column_stack(
        [
            (u - camera.K[0, 2]) / camera.K[0, 0],
            (v - camera.K[1, 2]) / camera.K[1, 1],
            np.ones(u.size),
        ]
    )
    places = 2 * np.column_stack([u / (width - 1), v / (height - 1)]) - 1
    attitudes = list(product(DEPTHS, TILTS_DEG))
    R = Rotation.from_rotvec([(*tilt, 0.0) for _, tilt in attitudes], degrees=True).as_matrix()
    depths = near + (far - near) * np.array([share for share, _ in attitudes])
    t = depths[:, None, None] * rays - (R @ middle)[:, None]
    T = rigid_transform(np.broadcast_to(R[:, None], (*t.shape, 3)), t)
    candidates = [np.zeros((0, 4, 4))]
    for poses, visible in zip(
        T, model.is_visible(T.reshape(-1, 4, 4)).reshape(T.shape[:2]), strict=True
    ):
        if visible.any():
            candidates.append(poses[visible][_select_extremes(places[visible])])
    return np.concatenate(candidates)


def _select_extremes(places: Floats) -> list[int]:
    """Return the indices of the places (n, 2), in image units of -1 to 1, farthest in each of
    ``DIRECTIONS``.

    For direction (0, 0): the place nearest to the centre of their bounding box.
    """
    penalty = 0.01 * (places**2).sum(1)  # of two equally far places the more central one
    off_centre = ((places - box_middle(places)) ** 2).sum(1)
    return sorted(
        {
            int(np.argmax(places @ np.array(d) - penalty) if any(d) else np.argmin(off_centre))
            for d in DIRECTIONS
        }
    )


def _pose_distances(T: Floats, others: Floats) -> Floats:
    """Return distances (n,) of a pose (4, 4) to others (n, 4, 4): shift over 0.1 depth, plus turn
    over 15 degrees."""
    translations = lengths(T[:3, 3] - others[:, :3, 3]) / (0.1 * T[2, 3])
    return translations + rotation_angle(T[:3, :3].T @ others[:, :3, :3]) / np.radians(15)
