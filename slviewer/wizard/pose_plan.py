"""Where the target has been and should be held next, from the poses of a session.

The first poses are spread by what they cover; from the third on the rig is known well enough to ask its information
what it lacks most.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from slviewer.calibration.guidance.coarse_rig import ExpectedNoise, GuidanceBench
from slviewer.calibration.guidance.initial_rig import MIN_POSES as LEAST_FOR_A_RIG
from slviewer.calibration.guidance.initial_rig import estimate_rig
from slviewer.calibration.guidance.pose_selection import Guidance, suggest_poses
from slviewer.calibration.next_pose import (
    Coverage,
    Suggestion,
    approximate_pose,
    coverage,
    depth_range,
    describe_suggestion,
    estimated_lens,
    nominal_lens,
    projector_reach,
    suggest,
)
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.target.board import Board


@dataclass(frozen=True, eq=False)
class PoseFeatures:
    """What a pose's observation says of its board: points (n, 3) mm, camera and projector (n, 2) px; and how noisy the
    projector's coordinates of its bright places are, px (NaN: not known)."""

    points: np.ndarray
    camera: np.ndarray
    projector: np.ndarray
    noise_px: float = np.nan


USUAL_SIGMA = 4e-5
"""Of the middle depth, wanted where nobody says: less than a camera's noise does to a single point, so that more poses
would hardly show in a scan."""
LEAST_POSES = 8
"""Before which none is enough: what is not as it should be shows in what poses have in common."""


@dataclass(frozen=True, eq=False)
class PosePlan:
    """Poses as far as they are known, what they cover, and what should come next.

    ``sigma_mm``: the 3D standard deviation that a calibration from these poses is predicted to have over the working
    volume (RMS), None before the rig is known well enough; ``sigma_next_mm``: with the suggested pose besides.
    ``usual_mm``: what suffices where nobody says.
    """

    lens: Lens
    poses: Mapping[str, np.ndarray]
    coverage: Coverage
    suggestion: Suggestion | None
    usual_mm: float
    sigma_mm: float | None = None
    sigma_next_mm: float | None = None

    def reaches(self, wanted_mm: float) -> bool:
        """Whether a sigma is reached, and no pose need follow."""
        return self.sigma_mm is not None and self.sigma_mm <= wanted_mm and len(self.poses) >= LEAST_POSES


def plan(
    board: Board,
    camera: tuple[int, int],
    projector: tuple[int, int],
    features: Mapping[str, PoseFeatures],
    stereo: StereoModel | None,
    focal_px: float | None,
    refused: int,
) -> PosePlan:
    """The plan after poses with these `features`.

    The rig is the calibrated one if there is a `stereo` calibration of this camera, else what the poses tell; the lens,
    before they tell anything, is one of `focal_px`. `refused`: so many suggestions were tried in vain and are passed
    over.
    """
    seen = list(features.values())
    known: tuple[StereoRig, dict[str, np.ndarray]] | None = None
    if _calibrated(stereo, camera):
        assert stereo is not None
        known = stereo.rig, dict(stereo.poses)
    else:
        rough = estimate_rig(
            [f.points for f in seen], [f.camera for f in seen], [f.projector for f in seen], (camera, projector)
        )
        if rough is not None:
            known = rough[0], dict(zip(features, rough[1], strict=True))
    lens = _lens(seen, camera, focal_px) if known is None else known[0].camera
    poses = _placed(features, lens, {} if known is None else known[1])
    usual = USUAL_SIGMA * float(np.mean(depth_range(board, lens)))
    covered = coverage(board, lens, list(poses.values()))
    guidance: Guidance | None = None
    if known is not None:
        expected = ExpectedNoise().with_noise(np.array([f.noise_px for f in seen]) / projector[0])
        try:
            guidance = suggest_poses(GuidanceBench(known[0], board, expected), list(poses.values()))
        except (InputError, np.linalg.LinAlgError):  # devices that share no view: what covers most may mend it
            guidance = None
    if guidance is None:
        return PosePlan(lens, poses, covered, _spread(board, lens, projector, features, poses, refused), usual)
    T = guidance.poses[refused % len(guidance.poses)]
    next_mm = guidance.sigma_next_mm
    return PosePlan(lens, poses, covered, describe_suggestion(board, lens, T), usual, guidance.sigma_mm, next_mm)


def takes_time(features: Mapping[str, PoseFeatures], stereo: StereoModel | None, camera: tuple[int, int]) -> bool:
    """Whether `plan` has to ask a rig's information, rather than what poses cover."""
    return _calibrated(stereo, camera) or len(features) >= LEAST_FOR_A_RIG


def plan_at_hand(
    board: Board,
    camera: tuple[int, int],
    projector: tuple[int, int],
    features: Mapping[str, PoseFeatures],
    stereo: StereoModel | None,
    focal_px: float | None,
    refused: int,
    before: PosePlan | None,
) -> PosePlan:
    """What can be said at once, as in `plan`: where the poses are by the calibration, or by the lens of the plan
    `before`, and a suggestion by what they cover."""
    if _calibrated(stereo, camera):
        assert stereo is not None
        lens, known = stereo.rig.camera, dict(stereo.poses)
    elif before is not None:
        lens, known = before.lens, dict(before.poses)
    else:
        lens, known = _lens(list(features.values()), camera, focal_px), {}
    poses = _placed(features, lens, known)
    usual = USUAL_SIGMA * float(np.mean(depth_range(board, lens)))
    covered = coverage(board, lens, list(poses.values()))
    return PosePlan(lens, poses, covered, _spread(board, lens, projector, features, poses, refused), usual)


def _calibrated(stereo: StereoModel | None, camera: tuple[int, int]) -> bool:
    return stereo is not None and stereo.rig.camera.size == camera


def _lens(seen: list[PoseFeatures], camera: tuple[int, int], focal_px: float | None) -> Lens:
    if focal_px is not None:
        return nominal_lens(camera, focal_px)
    return estimated_lens([f.points for f in seen], [f.camera for f in seen], camera)


def _placed(features: Mapping[str, PoseFeatures], lens: Lens, known: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """T_camera_board (4, 4) of each pose: as `known`, else as the lens says; without those that it cannot tell."""
    poses = {}
    for name, one in features.items():
        T = known[name] if name in known else approximate_pose(one.points, one.camera, lens)
        if T is not None:
            poses[name] = T
    return poses


def _spread(
    board: Board,
    lens: Lens,
    projector: tuple[int, int],
    features: Mapping[str, PoseFeatures],
    poses: Mapping[str, np.ndarray],
    refused: int,
) -> Suggestion | None:
    """What poses cover least, where little is known of the rig."""
    lit = None
    if poses:
        points = np.concatenate([features[n].points @ T[:3, :3].T + T[:3, 3] for n, T in poses.items()])
        lit = projector_reach(points, np.concatenate([features[n].projector for n in poses]), projector)
    try:
        return suggest(board, lens, list(poses.values()), lit=lit, skip=refused)
    except InputError:  # nothing fits: the operator's own poses decide
        return None
