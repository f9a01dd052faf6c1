"""An approximate rig from few poses: for predicting visibility and information, not for measuring."""

from collections.abc import Sequence

import cv2
import numpy as np

from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig

MIN_POSES = 3
MAX_FEATURES = 60
"""Of a pose."""
POSES_FOR_TWO_COEFFICIENTS = 6
"""Poses from which on two radial coefficients are told apart; fewer give one."""
MAX_DISAGREEMENT = 0.05, 0.1
"""Medians over the poses: of how far their arrangements turn from the common one, rad, and are away, of its length."""
_FOCALS = 0.4, 12.0  # of a lens, in widths of its image


def estimate_rig(
    points: Sequence[np.ndarray],
    camera: Sequence[np.ndarray],
    projector: Sequence[np.ndarray],
    sizes: tuple[tuple[int, int], tuple[int, int]],
) -> tuple[StereoRig, list[np.ndarray]] | None:
    """The rig and T_camera_board (4, 4) of every pose, from features ``points`` (n, 3) mm, ``camera`` and ``projector``
    (n, 2) px, NaN where unknown; None where the poses do not tell.

    ``sizes``: (width, height) px of camera and projector.
    """
    chosen = []
    for p, c, q in zip(points, camera, projector, strict=True):
        known = np.nonzero(np.isfinite(c).all(1) & np.isfinite(q).all(1))[0]
        if len(known) < 12:
            return None
        keep = known[np.unique(np.linspace(0, len(known) - 1, MAX_FEATURES).astype(int))]
        chosen.append([np.ascontiguousarray(a[keep], np.float32) for a in (p, c, q)])
    if len(chosen) < MIN_POSES:
        return None
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    if len(chosen) < POSES_FOR_TWO_COEFFICIENTS:
        flags |= cv2.CALIB_FIX_K2
    lenses, poses = [], []
    for k, size in enumerate(sizes):
        objects, images = [c[0] for c in chosen], [c[1 + k] for c in chosen]
        try:
            _, K, D, turns, shifts = cv2.calibrateCamera(objects, images, size, np.eye(3), np.zeros(5), flags=flags)
        except cv2.error:
            return None
        if not (np.isfinite(K).all() and all(_FOCALS[0] < f / size[0] < _FOCALS[1] for f in (K[0, 0], K[1, 1] / 2))):
            return None
        lenses.append(Lens(K, np.ravel(D)[:5], size))
        poses.append([_camera_matrix(r, t) for r, t in zip(turns, shifts, strict=True)])
    T = [there @ np.linalg.inv(here) for here, there in zip(*poses, strict=True)]
    t = np.median([each[:3, 3] for each in T], axis=0)
    u, _, v = np.linalg.svd(np.median([each[:3, :3] for each in T], axis=0))
    R = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    turned = np.median([np.linalg.norm(cv2.Rodrigues(each[:3, :3] @ R.T)[0]) for each in T])
    away = np.median([np.linalg.norm(each[:3, 3] - t) for each in T]) / max(float(np.linalg.norm(t)), 1e-9)
    if turned > MAX_DISAGREEMENT[0] or away > MAX_DISAGREEMENT[1] or any(pose[2, 3] <= 0 for pose in poses[0]):
        return None
    return StereoRig(lenses[0], lenses[1], R, t), poses[0]


def _camera_matrix(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    return T
