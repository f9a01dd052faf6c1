"""Evidence of each pose and of the calibration made from them, before it is judged."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slviewer.calibration.known_camera import CameraCheck
from slviewer.calibration.squareness import Squareness
from slviewer.calibration.stereo import MIN_TILT_SPREAD_DEG
from slviewer.errors import CalibrationRejected, InputError
from slviewer.fringe.sequence import Axis
from slviewer.records.record import from_plain
from slviewer.records.verdict import Finding

MIN_DEPTH_SHARE = 3e-5
"""Depth errors of a smaller share of the depth do not matter: 18 um at 600 mm, half the Letter
rig's noise floor."""


@dataclass(frozen=True)
class Ripple:
    """Ripple of one axis in projector px.

    ``rms_px``: RMS of all residuals that repeat with the fringe; ``waves``: waves per period of
    their strongest component; ``noise_px``: predicted noise of one camera pixel, median over the
    samples; ``mm_per_px``: change of depth by one projector px, in the axis that gives the depth;
    ``depth_mm``: median depth of the samples.
    """

    rms_px: float
    waves: int
    noise_px: float
    mm_per_px: float
    depth_mm: float

    @property
    def matters(self) -> bool:
        """Whether it is larger than the noise of a point and than `MIN_DEPTH_SHARE` of the
        depth."""
        return (
            self.rms_px > self.noise_px
            and self.rms_px * self.mm_per_px > MIN_DEPTH_SHARE * self.depth_mm
        )


@dataclass(frozen=True)
class AxisEvidence:
    """Measurements from the frames of one axis; NaN where not measurable.

    ``period_px``: fringe period by the sequence's description; ``period_seen_px``: measured, from
    the phases at the Gray code's edges. ``steps``: of the finest phase shift, 0 for Gray code
    alone. ``readable``, ``saturated``: share of the board's illuminated pixels (of the image's,
    where no board was detected) that are valid, and that clip. ``harmonic``: amplitude of the
    fringe's second harmonic over the first.
    """

    period_px: float
    steps: int
    readable: float
    saturated: float
    harmonic: float
    period_seen_px: float


@dataclass(frozen=True)
class PoseEvidence:
    """Evidence of one capture of the target.

    ``refused``: why its board or phase could not be read, "" where they could; ``misfit``: by which
    the board contradicts its description or is mirrored. ``grid``: columns and rows of the grid of
    circles detected where the given board does not fit it. ``findings``: of the examination of its
    frames. ``displaced``: number of frames by which the white frame is
    late (positive) or early. ``moved_px``: motion of the features in the camera between the frames
    of the two axes. ``numbering``: how the features are misnumbered, "" where they are not.
    ``turn`` (2, 2): mean Jacobian of the projector coordinates by camera pixels over the board.
    ``upright``: whether the board's mark or markers show that the camera's image is not mirrored.
    """

    name: str
    refused: str = ""
    grid: tuple[int, int] | None = None
    axes: Mapping[str, AxisEvidence] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    displaced: int = 0
    moved_px: float = np.nan
    numbering: str = ""
    turn: tuple[tuple[float, float], tuple[float, float]] | None = None
    misfit: Finding | None = None
    upright: bool = False

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "PoseEvidence":
        """Return the evidence that `records.record.to_plain` saved; None is read as NaN."""
        axes = {
            name: {k: np.nan if v is None else v for k, v in axis.items()}
            for name, axis in data["axes"].items()
        }
        moved = np.nan if data["moved_px"] is None else data["moved_px"]
        return from_plain({**data, "axes": axes, "moved_px": moved}, cls)


@dataclass(frozen=True)
class ExcludedPose:
    """RMS residuals in px of a pose that the fit excluded, under the calibration from the other
    poses."""

    camera_px: float
    projector_px: float


@dataclass(frozen=True)
class SolutionEvidence:
    """Evidence of a stereo calibration and of the poses it excluded.

    ``used``: names of the poses; ``excluded``: residuals of those that the fit excluded.
    ``median_pose_rms_px``: median over the poses of (camera, projector) reprojection RMS.
    ``focal_sigma``: relative standard deviation of the focal length by device; ``tilt_spread_deg``:
    the largest angle between two boards; ``empty_corners``: corners of the image that the projector
    illuminates and no pose covers; ``aspects``: fy / fx of camera and projector; ``squareness``:
    of the camera's pixels and the board's cells. ``ripple``: residuals that repeat with the fringe,
    by axis. ``constant``: the pixels that change in no frame of any pose, "" without any.
    ``places``: number of the poses, those at one place counted once; None in older evidence.
    """

    used: tuple[str, ...]
    excluded: Mapping[str, ExcludedPose]
    reprojection_px: float
    median_pose_rms_px: tuple[float, float]
    focal_sigma: Mapping[str, float]
    tilt_spread_deg: float
    empty_corners: tuple[str, ...]
    aspects: tuple[float, float]
    ripple: Mapping[Axis, Ripple] = field(default_factory=dict)
    squareness: Squareness | None = None
    constant: str = ""
    places: int | None = None


@dataclass(frozen=True)
class Evidence:
    """Evidence of a calibration: of each pose and of the solution.

    ``board``: its notation. ``excluded``: poses excluded before the fit, with the reason.
    ``refusal``: why no calibration could be made, or why it was rejected. ``contradiction``: why
    the sequence's description cannot be true. ``tilt_spread_deg``:
    the largest angle between two boards, estimated with a nominal lens; ``foreshortened_deg``: by
    their shapes alone. ``camera``: of a camera
    that is fixed, how the poses agree with it.
    """

    board: str
    projector: tuple[int, int]
    poses: tuple[PoseEvidence, ...]
    excluded: Mapping[str, str] = field(default_factory=dict)
    refusal: CalibrationRejected | None = None
    contradiction: InputError | None = None
    tilt_spread_deg: float = np.nan
    foreshortened_deg: float = 0.0
    solution: SolutionEvidence | None = None
    is_camera_fixed: bool = False
    camera: CameraCheck | None = None

    @property
    def tilts_undetermined(self) -> bool:
        """Whether the boards are so nearly parallel that a fit's angles and focal lengths are
        undetermined; beside a fixed camera, even parallel boards at several depths determine
        both."""
        return not self.is_camera_fixed and self.tilt_spread_deg < MIN_TILT_SPREAD_DEG

    @property
    def ripple(self) -> Mapping[Axis, Ripple]:
        """Residuals of the solution that repeat with the fringe, by axis; empty without one."""
        return self.solution.ripple if self.solution else {}

    @property
    def usable(self) -> tuple[PoseEvidence, ...]:
        """Evidence of the poses whose board and phase were read."""
        return tuple(pose for pose in self.poses if not pose.refused)
