"""All that a panel draws: frozen, plain values, taken at one moment."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slviewer.calibration.diagnosis.verdict import Verdict
from slviewer.calibration.next_pose import Coverage, Suggestion
from slviewer.geometry.lens import Lens
from slviewer.pipeline.check_results import Preflight
from slviewer.session.measurements import Measurement

Level = Literal["info", "good", "warning", "error"]
PoseState = Literal["judging", "good", "refused", "excluded", "used", "left out"]
StepState = Literal["blocked", "ready", "done"]
RigState = Literal["none", "opening", "open", "lost"]


@dataclass(frozen=True)
class Notice:
    """One sentence for the operator; `number` counts up and never repeats."""

    number: int
    level: Level
    text: str
    time: datetime


@dataclass(frozen=True)
class JobView:
    """What the worker does now: `share` 0 ... 1, `doing` in words, since how many seconds, and how many jobs wait."""

    name: str
    share: float
    doing: str
    seconds: float
    can_cancel: bool
    background: bool
    waiting: int


@dataclass(frozen=True)
class CaptureProgress:
    """A capture on its way: frames taken, of how many, and how many captures wait behind it.

    Other work with the devices says what it is `doing`, and its `frame` of `frames` are percent.
    """

    name: str
    frame: int
    frames: int
    waiting: int
    doing: str = ""


@dataclass(frozen=True)
class RigView:
    """The devices: `camera` and `projector` sizes are (width, height) px; what a device does not tell is None."""

    state: RigState = "none"
    name: str = ""
    simulated: bool = False
    camera: tuple[int, int] | None = None
    projector: tuple[int, int] | None = None
    exposure_ms: float | None = None
    gain: float | None = None
    light: str = "white"  # what the projector shows between captures
    fault: str = ""  # why it is lost, in a sentence
    capture: CaptureProgress | None = None
    choice: Mapping[str, Any] | None = None  # what the operator chose
    page: bool = False  # whether it needs the projector page
    notes: tuple[str, ...] = ()  # what its camera could not be set to


@dataclass(frozen=True, eq=False)
class PoseView:
    """One target pose. `T_camera_board` (4, 4) mm is calibrated where `calibrated`, else approximate, None if unknown;
    `rms_px` is (camera, projector) reprojection; `thumbnail` a JPEG, empty until it is made; `board_px` (4, 2) the
    board's outline in the camera's px.
    """

    name: str
    state: PoseState
    why: str
    created: str
    T_camera_board: np.ndarray | None
    calibrated: bool
    board_px: np.ndarray | None
    rms_px: tuple[float, float] | None
    thumbnail: bytes = field(repr=False)


@dataclass(frozen=True)
class SplinedView:
    """What the joint adjustment found: residual noise px of the camera and along the projector's x and y, each device's
    local distortion px RMS, the board's lowest and highest place and its features' misplacement in mm, and the shares
    of both devices' cells that target poses lit. `left_out`: poses that contradict the others, with the reason; `trust`
    of each pose in camera and projector, 0 ... 1. `turned`: poses whose board was numbered from its other end.
    """

    noise_px: Mapping[str, float]
    local_px: Mapping[str, float]
    height_mm: tuple[float, float]
    misplaced_mm: float
    lit: Mapping[str, float]
    left_out: Mapping[str, str]
    trust: Mapping[str, tuple[float, float]]
    turned: tuple[str, ...] = ()


@dataclass(frozen=True)
class ModelFigures:
    """One model on poses that it was not made from, RMS: as `evaluation.crossvalidation.HeldOut` has them."""

    model: str
    plane_mm: float
    board_mm: float
    scale_ppm: float
    camera_px: float
    projector_px: float


@dataclass(frozen=True)
class ComparisonView:
    """The models compared on `poses` poses, each left out with its fold; `failed`: {model: why it is not judged}."""

    models: tuple[ModelFigures, ...]
    poses: int
    folds: int
    failed: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """The session's calibration; `stale` says in a sentence what changed since, empty where nothing did.

    `target` is empty for one made elsewhere.
    `fit_rms_mm`: {axis: {z, x, y: median mm}} of the pixel-wise fit, empty where there is none.
    `best` is the model that is used, `recommended` the one that would be if the operator had not `chosen` (empty: he
    has not). `rejected` says why it was, empty where it was not; `insisted`: it is used all the same.
    `scales`: {model: what correction of scale was applied, in words}. `lacks`: what the poses lack for the splined
    model, empty where they allow it.
    """

    models: tuple[str, ...]
    best: str
    stale: str
    target: str
    poses: tuple[str, ...]
    left_out: Mapping[str, str]
    reprojection_px: Mapping[str, float]
    pose_rms_px: Mapping[str, tuple[float, float]]
    depth_range_mm: tuple[float, float] | None
    baseline_mm: float
    K_camera: np.ndarray
    D_camera: np.ndarray
    K_projector: np.ndarray
    D_projector: np.ndarray
    R: np.ndarray
    t: np.ndarray
    focal_sigma_px: Mapping[str, float]
    fit_rms_mm: Mapping[str, Mapping[str, float]]
    recommended: str = ""
    chosen: str = ""
    rejected: str = ""
    insisted: bool = False
    features_set_aside: int = 0
    splined: SplinedView | None = None
    comparison: ComparisonView | None = None
    scales: Mapping[str, str] = field(default_factory=dict)
    lacks: str = ""

    @property
    def refused(self) -> str:
        """Why later steps do not use it; empty where they do."""
        return "" if self.insisted else self.rejected


@dataclass(frozen=True)
class VerificationRow:
    """One capture of a plane or a sphere, measured by one model; what is not known is None."""

    capture: str
    label: str
    shape: Literal["plane", "sphere"]
    model: str
    rms_mm: float
    noise_floor_mm: float | None
    radius_mm: float | None
    points: int
    set_aside: int
    coverage: float | None
    incidence: Mapping[str, float] | None  # percent in R1, R2, R3
    stale: bool
    masked: float | None = None  # share of the shape that looks where no target pose was; None: the model masks nothing


@dataclass(frozen=True)
class CentreDistance:
    """How far apart two spheres' centres are by one model."""

    captures: tuple[str, str]
    model: str
    distance_mm: float


@dataclass(frozen=True, eq=False)
class ScanView:
    """One capture that is no target pose. `cloud` says whether it is reconstructed: no, yes, or by an older
    calibration; `label` is the operator's name for it.
    """

    name: str
    label: str
    purpose: Literal["scan", "plane", "sphere"]
    created: str
    cloud: Literal["absent", "fresh", "stale"]
    model: str
    points: int
    depth_mm: tuple[float, float] | None
    noise_mm: float | None
    thumbnail: bytes = field(repr=False)
    masked: float | None = None  # share of the pixels that look where no target pose was; None: nothing is masked so
    scale: str = ""  # what correction of scale is in the cloud


@dataclass(frozen=True)
class MergedPair:
    """How one scan lies on another: RMS along the normal, and from point to point; the overlap, 0 ... 1; one standard
    deviation of the pose, and how far the overlap's middle was moved. None where a merge of before did not keep it.
    """

    scan: str
    onto: str
    rms_mm: float
    overlap: float
    sigma_mm: float | None
    sigma_deg: float | None
    moved_mm: float | None
    turned_deg: float
    point_mm: float | None = None


@dataclass(frozen=True)
class MergedLoop:
    """How far the pairs round these scans fail to lead back: as registered, and as adjusted together."""

    scans: tuple[str, ...]
    error_mm: float
    error_deg: float
    left_mm: float
    left_deg: float


@dataclass(frozen=True, eq=False)
class MergeView:
    """The current merge: `pairs` maps each scan but the reference to (RMS mm, overlap 0 ... 1, T_reference_scan).

    `registered`: the pairs that it was made from; `loops` that these close, the worst first; `dropped`: pairs that the
    others contradict, and `refused` ones that did not register, in sentences. `stray`: how many pixels of all scans lie
    on no surface, by what they are; `shared`: the share of the points that more than one scan measured.
    """

    name: str
    reference: str
    scans: tuple[str, ...]
    points: int
    pairs: Mapping[str, tuple[float, float, np.ndarray]]
    stale: bool
    registered: tuple[MergedPair, ...] = ()
    loops: tuple[MergedLoop, ...] = ()
    dropped: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    stray: Mapping[str, int] = field(default_factory=dict)
    shared: float | None = None


@dataclass(frozen=True)
class ExportView:
    """A file made for other programs."""

    name: str
    path: Path
    bytes: int


@dataclass(frozen=True)
class StepView:
    """One step: what to do now, in a sentence; `wrong`: what is wrong and how to mend it; `because`: why it waits."""

    key: str
    title: str
    now: str
    state: StepState
    because: str
    wrong: tuple[str, ...]


@dataclass(frozen=True)
class Space:
    """Free disk space, and what the next capture needs; None where no rig says."""

    free_bytes: int
    capture_bytes: int | None

    @property
    def enough(self) -> bool:
        return self.capture_bytes is None or self.free_bytes > 2 * self.capture_bytes


@dataclass(frozen=True, eq=False)
class WorldView:
    """The simulated world: what stands there, its T_camera_thing (4, 4) mm, and its turn about the vertical."""

    standing: Literal["board", "plane", "sphere", "object"]
    T_camera_thing: np.ndarray
    turn_deg: float


@dataclass(frozen=True)
class Foreseen:
    """The 3D standard deviation mm that a calibration from the poses so far is predicted to have over the working
    volume; ``next_mm``: with the suggested pose besides. None before enough is known of the rig.

    ``wanted_mm``: what the operator wants, or a default; ``enough``: it is reached, and no pose is asked for.
    """

    sigma_mm: float | None
    next_mm: float | None
    wanted_mm: float
    enough: bool


@dataclass(frozen=True, eq=False)
class SessionView:
    """What the session's files say."""

    folder: Path
    target: str  # notation of the board, empty until one is chosen
    patterns: str  # name of the pattern sequence
    poses: tuple[PoseView, ...] = ()
    lens: Lens | None = None  # calibrated, or a guess to place boards with; None before sizes are known
    coverage: Coverage | None = None
    suggestion: Suggestion | None = None
    foreseen: Foreseen | None = None  # None before sizes are known
    planning: bool = False  # whether a better suggestion is being thought of: these two are of fewer poses
    calibration: CalibrationView | None = None
    verdict: Verdict | None = None  # on the last attempt to calibrate, also where nothing came of it
    verdict_of_calibration: bool = True  # whether that attempt made `calibration`
    verifications: tuple[VerificationRow, ...] = ()
    distances: tuple[CentreDistance, ...] = ()
    scans: tuple[ScanView, ...] = ()
    merge: MergeView | None = None
    merges: int = 0  # how many undo can take back
    measurements: tuple[Measurement, ...] = ()
    deleted_measurements: int = 0  # how many can be brought back
    nominals: tuple[str, ...] = ()  # names of the nominal models that were uploaded
    exports: tuple[ExportView, ...] = ()
    deleted_poses: tuple[str, ...] = ()  # what can be brought back, the last deleted first
    deleted_scans: tuple[str, ...] = ()
    linear: bool = False  # whether patterns pass the table of grey levels that makes the light proportional
    exposures_ms: tuple[float, ...] = ()  # of every capture; empty: a single one, the camera's

    @property
    def enough(self) -> bool:
        """Whether the poses reach the accuracy wanted."""
        return self.foreseen is not None and self.foreseen.enough


@dataclass(frozen=True)
class LiveView:
    """A live scan: clouds made a second, and of those shown a second; `behind_ms`: from the first frame's light of a
    cloud until it is sent to the screens, the median, None where nobody looks; `points` of the latest cloud.
    """

    clouds_per_s: float
    shown_per_s: float
    behind_ms: float | None
    points: int


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Everything at one moment; `version` grows with each change. `session` is None until one is open."""

    version: int
    session: SessionView | None
    rig: RigView
    world: WorldView | None  # None for real devices
    job: JobView | None
    notices: tuple[Notice, ...]
    steps: tuple[StepView, ...]
    space: Space | None
    hands_free: bool
    autopilot: str  # what it does now; empty where it rests
    preflight: Preflight | None = None  # what the last check of the rig in use said
    live: LiveView | None = None  # None while nothing is scanned live
    not_merged: str = ""  # why the latest merge that was asked for was refused, or failed

    def step(self, key: str) -> StepView:
        """The step called `key`."""
        return next(step for step in self.steps if step.key == key)

    def pose(self, name: str) -> PoseView | None:
        """The pose called `name`, if there is one."""
        poses = self.session.poses if self.session else ()
        return next((pose for pose in poses if pose.name == name), None)

    def scan(self, name: str) -> ScanView | None:
        """The scan called `name`, if there is one."""
        scans = self.session.scans if self.session else ()
        return next((scan for scan in scans if scan.name == name), None)


@dataclass(frozen=True, eq=False)
class BoardSeen:
    """The board in the preview: features (n, 2) and outline (4, 2), camera px; `still_s` since it moved last; `taken`:
    when the picture was, by the monotonic clock: the search takes its time."""

    pixels: np.ndarray
    outline: np.ndarray
    still_s: float
    T_camera_board: np.ndarray | None
    taken: float


@dataclass(frozen=True, eq=False)
class PreviewView:
    """The latest frame as a panel shows it, apart from the snapshot since it changes many times a second.

    `image` (h, w) uint8 is `scale` times the camera's size. `histogram` (64,) are shares of the pixels by grey level.
    `board` is None where none is seen or none is looked for, and `missing` then says why. `countdown_s`: seconds until
    a hands-free capture, None where none is coming.
    """

    number: int
    image: np.ndarray
    scale: float
    saturated: float
    brightest: float  # 99.5th percentile, as a share of the camera's range
    histogram: np.ndarray
    board: BoardSeen | None
    missing: str
    countdown_s: float | None
    frames_per_s: float
