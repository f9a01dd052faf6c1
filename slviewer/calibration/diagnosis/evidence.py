"""Evidence of each pose and of the calibration made from them, before it is judged."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slviewer.calibration.diagnosis.ripple import Ripple
from slviewer.calibration.soundness import MIN_TILT_SPREAD_DEG
from slviewer.fringe.contradiction import Contradiction
from slviewer.fringe.sequence import Axis
from slviewer.fringe.suspect import Suspect
from slviewer.records import from_plain


@dataclass(frozen=True)
class AxisEvidence:
    """Measurements from the frames of one axis; NaN where not measurable.

    ``period_px`` as described; ``period_seen_px`` by where the Gray code's edges fall in the phase. ``saturated``:
    share of the board's illuminated pixels (of all, where no board was detected) that clip. ``harmonic``: second
    harmonic over the fringe; ``steps`` of the finest phase shift, 0 for Gray code alone.
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

    ``refused``: why its board or its phase could not be read; empty where they could. ``grid``: columns and rows of the
    circles that were seen, where the board that was given could not be laid over them. ``displaced``: how many frames
    late (positive) or early the white frame came. ``moved_px``: by how much the features moved in the camera from the
    frames of one axis to those of the other. ``numbering``: how the features are misnumbered, in words.
    ``turn`` (2, 2): how the projector's coordinates change a camera pixel, in the mean over the board.
    ``contradictions``: between a refused capture and its description.
    """

    name: str
    refused: str = ""
    grid: tuple[int, int] | None = None
    axes: Mapping[str, AxisEvidence] = field(default_factory=dict)
    suspects: tuple[Suspect, ...] = ()
    displaced: int = 0
    moved_px: float = np.nan
    numbering: str = ""
    turn: tuple[tuple[float, float], tuple[float, float]] | None = None
    contradictions: tuple[Contradiction, ...] = ()

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "PoseEvidence":
        """The inverse of `records.to_plain`; what was not measured may be None instead of NaN."""
        axes = {name: {k: np.nan if v is None else v for k, v in axis.items()} for name, axis in data["axes"].items()}
        moved = np.nan if data["moved_px"] is None else data["moved_px"]
        return from_plain({**data, "axes": axes, "moved_px": moved}, cls)


@dataclass(frozen=True)
class ExcludedPose:
    """A pose that the fit excluded: residuals in px, RMS, by the calibration that the others gave."""

    camera_px: float
    projector_px: float


@dataclass(frozen=True)
class SolutionEvidence:
    """Evidence of a stereo calibration and of the poses it excluded.

    ``focal_sigma``: relative uncertainty of the focal lengths; ``tilt_spread_deg``: the largest angle between two
    boards; ``empty_corners`` of the image, by name, that no pose reached and the projector lights; ``aspect`` fy / fx
    of the projector; ``centre_off``: how far its principal point lies from the middle, in widths and heights.
    ``ripple``: residuals that repeat with the fringe, by axis.
    """

    used: tuple[str, ...]
    strayed: Mapping[str, ExcludedPose]
    reprojection_px: float
    usual_px: tuple[float, float]
    focal_sigma: Mapping[str, float]
    tilt_spread_deg: float
    empty_corners: tuple[str, ...]
    aspect: float
    centre_off: tuple[float, float]
    ripple: Mapping[Axis, Ripple] = field(default_factory=dict)


@dataclass(frozen=True)
class Evidence:
    """All evidence of a calibration. ``refusal``: why no calibration could be made, or why one that was made is none;
    empty otherwise. ``contradiction``: why the sequence's description cannot be true. ``board`` in its notation.
    ``set_aside``: poses excluded from the fit, and why. ``tilt_spread_deg``: roughly the largest angle between two
    boards, before any fit.
    """

    board: str
    projector: tuple[int, int]
    poses: tuple[PoseEvidence, ...]
    set_aside: Mapping[str, str] = field(default_factory=dict)
    refusal: str = ""
    contradiction: str = ""
    tilt_spread_deg: float = np.nan
    solution: SolutionEvidence | None = None

    @property
    def tilts_undetermined(self) -> bool:
        """Whether the boards are so nearly parallel that a fit's angles and focal lengths are
        undetermined."""
        return self.tilt_spread_deg < MIN_TILT_SPREAD_DEG

    @property
    def usable(self) -> tuple[PoseEvidence, ...]:
        """Poses whose board and phase were read."""
        return tuple(pose for pose in self.poses if not pose.refused)
