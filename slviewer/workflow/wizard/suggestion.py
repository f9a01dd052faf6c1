"""Where the target has been and should be held next, from the poses of a session."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from slviewer.calibration.next_pose import (
    Coverage,
    Suggestion,
    approximate_pose,
    coverage,
    estimated_lens,
    nominal_lens,
    projector_reach,
    suggest,
)
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.target.board import Board


@dataclass(frozen=True, eq=False)
class Features:
    """What a pose's observation says of its board: points (n, 3) mm, camera and projector (n, 2) px."""

    points: np.ndarray
    camera: np.ndarray
    projector: np.ndarray


@dataclass(frozen=True, eq=False)
class Plan:
    """Poses as far as they are known, what they cover, and what should come next."""

    lens: Lens
    poses: Mapping[str, np.ndarray]
    coverage: Coverage
    suggestion: Suggestion | None


def plan(
    board: Board,
    camera: tuple[int, int],
    projector: tuple[int, int],
    features: Mapping[str, Features],
    stereo: StereoModel | None,
    focal_px: float | None,
    refused: int,
) -> Plan:
    """The plan after poses with these `features`.

    The lens is the calibrated one if there is a `stereo` calibration of this camera, else one of `focal_px`, else what
    the poses tell. `refused`: so many suggestions were tried in vain and are passed over.
    """
    calibrated = stereo is not None and stereo.rig.camera.size == camera
    if stereo is not None and calibrated:
        lens = stereo.rig.camera
    elif focal_px is not None:
        lens = nominal_lens(camera, focal_px)
    else:
        lens = estimated_lens([f.points for f in features.values()], [f.camera for f in features.values()], camera)
    poses = {}
    for name, seen in features.items():
        known = stereo.poses.get(name) if stereo is not None and calibrated else None
        T = approximate_pose(seen.points, seen.camera, lens) if known is None else known
        if T is not None:
            poses[name] = T
    lit = None
    if poses:
        points = np.concatenate([features[n].points @ T[:3, :3].T + T[:3, 3] for n, T in poses.items()])
        lit = projector_reach(points, np.concatenate([features[n].projector for n in poses]), projector)
    placed = list(poses.values())
    try:
        suggestion = suggest(board, lens, placed, lit=lit, skip=refused)
    except InputError:  # nothing fits: the operator's own poses decide
        suggestion = None
    return Plan(lens, poses, coverage(board, lens, placed), suggestion)
